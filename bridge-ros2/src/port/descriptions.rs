//! The requests for type descriptions to the nodes that use the types.

use std::collections::{BTreeMap, HashMap};

use messages::{DescribedType, TypeHash, TypeName};
use ros2_node::service::{ServiceError, ServicePeers};
use ros2_node::type_description::NotDescribed;
use tokio::task::{Id, JoinError, JoinSet};
use tokio::time::Instant;

use super::inquiry::Inquiry;

/// The requested type descriptions and the state of each inquiry.
pub(super) struct TypeDescriptions {
    pub(super) peers: ServicePeers,
    pub(super) asked: BTreeMap<WantedType, Inquiry>,
    pub(super) calls: PendingCalls,
}

/// The pending calls.
#[derive(Default)]
pub(super) struct PendingCalls {
    tasks: JoinSet<DescriptionAnswer>,
    /// The type and the service of each pending call.
    asking: HashMap<Id, (WantedType, String)>,
}

/// A type as an endpoint announces it.
pub(super) type WantedType = (TypeName, TypeHash);
/// The type with the types that it references, or the reason for the failure.
pub(super) type DescriptionAnswer = Result<Vec<DescribedType>, NoDescription>;

/// The reason why a node has not described a type.
#[derive(Debug, thiserror::Error)]
pub(super) enum NoDescription {
    #[error(transparent)]
    Call(#[from] ServiceError),
    #[error(transparent)]
    Answer(#[from] NotDescribed),
    #[error("the call was broken off: {0}")]
    BrokenOff(JoinError),
}

impl TypeDescriptions {
    pub(super) fn new(peers: ServicePeers) -> Self {
        Self {
            peers,
            asked: BTreeMap::new(),
            calls: PendingCalls::default(),
        }
    }

    /// Returns whether a response may have arrived or a request is due.
    pub(super) fn is_asking(&self, now: Instant) -> bool {
        self.calls.len() > 0 || self.asked.values().any(|inquiry| inquiry.is_open(now))
    }
}

impl PendingCalls {
    /// Begins a call of a service for the description of a type.
    pub(super) fn begin(
        &mut self,
        wanted: WantedType,
        service: String,
        call: impl Future<Output = DescriptionAnswer> + Send + 'static,
    ) {
        let task = self.tasks.spawn(call);
        self.asking.insert(task.id(), (wanted, service));
    }

    /// Returns the number of pending calls.
    pub(super) fn len(&self) -> usize {
        self.tasks.len()
    }

    /// Returns a finished call: the requested type, the called service, and the response. An
    /// aborted call counts as failed, so that no endpoint waits for it forever.
    pub(super) fn ended(&mut self) -> Option<(WantedType, String, DescriptionAnswer)> {
        loop {
            let (task, answer) = match self.tasks.try_join_next_with_id()? {
                Ok(ended) => ended,
                Err(error) => (error.id(), Err(NoDescription::BrokenOff(error))),
            };
            if let Some((wanted, service)) = self.asking.remove(&task) {
                return Some((wanted, service, answer));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn a_call_that_is_broken_off_has_failed() {
        let wanted = |name: &str| -> WantedType {
            let name: TypeName = name.parse().unwrap();
            let hash = messages::TypeRegistry::bundle(messages::Dialect::Ros2).type_hash(&name);
            (name, hash.unwrap())
        };
        let (panics, hangs) = (wanted("std_msgs/Bool"), wanted("std_msgs/String"));
        let mut calls = PendingCalls::default();
        calls.begin(panics.clone(), "/panics".to_owned(), async {
            panic!("as the test wants it")
        });
        calls.begin(hangs.clone(), "/hangs".to_owned(), std::future::pending());
        // The runtime of a test has one thread, so both tasks get their turn.
        tokio::task::yield_now().await;
        calls.tasks.abort_all();
        tokio::task::yield_now().await;
        let mut ended = BTreeMap::new();
        while let Some((wanted, service, answer)) = calls.ended() {
            ended.insert(wanted, (service, answer.is_err()));
        }
        let failed = |service: &str| (service.to_owned(), true);
        let expected = [(panics, failed("/panics")), (hangs, failed("/hangs"))];
        assert_eq!(ended, BTreeMap::from(expected));
        assert_eq!((calls.len(), calls.asking.len()), (0, 0));
    }
}
