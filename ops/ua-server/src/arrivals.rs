//! Writes that are answered when the bridges confirm them (`confirm: bridge` in the mapping).
//!
//! Each write is sent at once. A write supersedes the pending writes of its topic, because their
//! values are not sent again.

use std::collections::HashMap;
use std::time::Duration;

use bridge_node::ConfirmedArrival;
use mappings::{Mapping, TopicId};
use opcua::sync::{Mutex, RwLock};
use opcua::types::StatusCode;
use tokio::sync::oneshot;
use tracing::warn;

/// The topics of the mapping that bridges confirm, and the pending writes.
#[derive(Default)]
pub(crate) struct Arrivals {
    within: RwLock<HashMap<TopicId, Duration>>,
    waiting: Mutex<HashMap<TopicId, Vec<PendingWrite>>>,
}

/// A pending write.
#[derive(Debug)]
pub(crate) struct PendingWrite {
    /// The written field of the topic, or `None` for all fields.
    field: Option<usize>,
    answer: oneshot::Sender<StatusCode>,
}

/// The future answer to a write.
#[derive(Debug)]
pub(crate) struct Awaiting {
    answer: oneshot::Receiver<StatusCode>,
    within: Duration,
}

impl Awaiting {
    /// Waits for the answer.
    ///
    /// # Errors
    /// Returns `BadTimeout` if it is unknown whether the value has arrived, and
    /// `BadRequestCancelledByRequest` if a newer value superseded it.
    pub(crate) async fn arrived(self) -> Result<(), StatusCode> {
        match tokio::time::timeout(self.within + GRACE, self.answer).await {
            Ok(Ok(StatusCode::Good)) => Ok(()),
            Ok(Ok(status)) => Err(status),
            // The mapping was reloaded, or the server stopped.
            Ok(Err(_)) | Err(_) => Err(StatusCode::BadTimeout),
        }
    }
}

impl Arrivals {
    /// Sets the topics of a mapping.
    pub(crate) fn follow(&self, mapping: &Mapping) {
        let variables = mapping.variables().iter();
        let wanted = variables.filter_map(|variable| {
            let by_bridges = variable.confirm.is_none();
            let within = variable.confirmed_within.filter(|_| by_bridges)?;
            Some((variable.topic, within))
        });
        *self.within.write() = wanted.collect();
    }

    /// Registers a write of a field, or of all fields, that is answered when it is confirmed.
    /// Returns `None` for topics that bridges do not confirm.
    pub(crate) fn await_write(
        &self,
        topic: TopicId,
        field: Option<usize>,
    ) -> Option<(PendingWrite, Awaiting)> {
        let within = self.within.read().get(&topic).copied()?;
        let (told, answer) = oneshot::channel();
        let awaited = PendingWrite {
            field,
            answer: told,
        };
        Some((awaited, Awaiting { answer, within }))
    }

    /// Records that a write is sent. Earlier writes are answered as superseded, except writes of
    /// other fields, because the new write contains their values.
    pub(crate) fn sent(&self, topic: TopicId, write: Option<PendingWrite>) {
        let mut waiting = self.waiting.lock();
        let field = write.as_ref().and_then(|write| write.field);
        let writes = waiting.entry(topic).or_default();
        let superseded = writes.extract_if(.., |before| {
            field.is_none() || before.field.is_none() || before.field == field
        });
        for before in superseded {
            // The client may be lost.
            let _gone = before.answer.send(SUPERSEDED);
        }
        writes.extend(write);
        if writes.is_empty() {
            waiting.remove(&topic);
        }
    }

    /// Answers the writes that wait for the newest value of a topic.
    pub(crate) fn settled(&self, topic: TopicId, arrival: &ConfirmedArrival) {
        let Some(writes) = self.waiting.lock().remove(&topic) else {
            return;
        };
        let status = match arrival {
            ConfirmedArrival::Confirmed => StatusCode::Good,
            ConfirmedArrival::NotSent => StatusCode::BadCommunicationError,
            ConfirmedArrival::Unknown(spaces) => {
                let spaces: Vec<String> = spaces.iter().map(ToString::to_string).collect();
                warn!(
                    %topic,
                    spaces = spaces.join(", "),
                    "a write is not confirmed, and its outcome is unknown: the bridge of the space or its subscriber is missing"
                );
                StatusCode::BadTimeout
            }
        };
        for write in writes {
            // The client may be lost.
            let _gone = write.answer.send(status);
        }
    }
}

/// The answer to a write that was superseded by a newer write of the same value.
const SUPERSEDED: StatusCode = StatusCode::BadRequestCancelledByRequest;
/// Extra time beyond the limit of the mapping, because the value also waits in the queue before it
/// is sent.
const GRACE: Duration = Duration::from_secs(5);

#[cfg(test)]
mod tests {
    use mappings::SpaceId;

    use super::*;

    const MAPPING: &str = "
spaces: [{id: 1}]
namespaces: {2: urn:cell}
variables:
  - {node: ns=2;i=30, name: drive, origin: 0, ros: {space: 1, topic: /cmd_vel, type: geometry_msgs/Twist}}
  - {node: ns=2;i=31, name: other, type: Double, origin: 0}
  - {node: ns=2;i=32, name: sent, type: Double, origin: 0, confirm: none, ros: {space: 1, topic: /sent, type: std_msgs/Float64}}
";

    fn topic(identifier: u16) -> TopicId {
        TopicId::new(0, 2, identifier).unwrap()
    }

    fn arrivals() -> Arrivals {
        let arrivals = Arrivals::default();
        let checked = Mapping::from_yaml(MAPPING, "cell.yaml");
        arrivals.follow(&checked.mapping.unwrap());
        arrivals
    }

    fn write(arrivals: &Arrivals, field: Option<usize>) -> Awaiting {
        let (awaited, awaiting) = arrivals.await_write(topic(30), field).unwrap();
        arrivals.sent(topic(30), Some(awaited));
        awaiting
    }

    #[test]
    fn values_that_go_to_no_other_space_or_are_said_to_need_none_are_not_awaited() {
        let arrivals = arrivals();
        for (identifier, wanted) in [(30, true), (31, false), (32, false), (33, false)] {
            let awaited = arrivals.await_write(topic(identifier), None);
            assert_eq!(awaited.is_some(), wanted, "{identifier}");
        }
    }

    #[tokio::test]
    async fn a_write_is_answered_by_what_became_of_its_value() {
        let arrivals = arrivals();
        let unknown = ConfirmedArrival::Unknown(vec![SpaceId::ROS1]);
        for (arrival, wanted) in [
            (ConfirmedArrival::Confirmed, Ok(())),
            (unknown, Err(StatusCode::BadTimeout)),
            (
                ConfirmedArrival::NotSent,
                Err(StatusCode::BadCommunicationError),
            ),
        ] {
            let awaiting = write(&arrivals, None);
            arrivals.settled(topic(31), &ConfirmedArrival::Confirmed);
            arrivals.settled(topic(30), &arrival);
            assert_eq!(awaiting.arrived().await, wanted);
            assert!(arrivals.waiting.lock().is_empty());
        }
    }

    #[tokio::test]
    async fn a_newer_write_ends_the_one_before_unless_it_has_its_value() {
        for (first, second, wanted) in [
            (None, None, Err(SUPERSEDED)),
            (Some(0), Some(0), Err(SUPERSEDED)),
            (Some(0), None, Err(SUPERSEDED)),
            (Some(0), Some(5), Ok(())),
        ] {
            let arrivals = arrivals();
            let before = write(&arrivals, first);
            let after = write(&arrivals, second);
            arrivals.settled(topic(30), &ConfirmedArrival::Confirmed);
            assert_eq!(before.arrived().await, wanted);
            assert_eq!(after.arrived().await, Ok(()));
        }
    }
}
