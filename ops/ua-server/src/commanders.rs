//! The sessions that wrote commands last. A robot is stopped when the session of its commander is
//! lost.

use std::collections::{HashMap, HashSet};
use std::sync::Arc;
use std::time::Duration;

use mappings::{Mapping, TopicId};
use opcua::server::node_manager::RequestContext;
use tokio::time::{Interval, MissedTickBehavior, interval};

/// Reports if the session of a write still exists.
pub(crate) struct Commander(Box<dyn Fn() -> bool + Send + Sync>);

impl Commander {
    /// Returns the session of a request, for each write of the request.
    pub(crate) fn of(context: &RequestContext) -> Box<dyn Fn() -> Self + Send + Sync> {
        // The type of the library's sessions has no public name.
        let session = Arc::downgrade(&context.session);
        Box::new(move || {
            let session = session.clone();
            Self(Box::new(move || {
                session
                    .upgrade()
                    .is_some_and(|session| session.read().is_activated())
            }))
        })
    }

    /// Returns a commander that is never lost, for a topic without reaction to the loss.
    pub(crate) fn lasting() -> Self {
        Self(Box::new(|| true))
    }

    fn lasts(&self) -> bool {
        (self.0)()
    }
}

impl std::fmt::Debug for Commander {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Commander").finish_non_exhaustive()
    }
}

/// The commanders of the topics with `on_loss`.
#[derive(Debug)]
pub(crate) struct Commanders {
    /// The topics that the mapping stops when their commander is lost.
    stopped: HashSet<TopicId>,
    last: HashMap<TopicId, Commander>,
    look: Interval,
}

impl Commanders {
    pub(crate) fn new(mapping: &Mapping) -> Self {
        let mut look = interval(LOOK);
        look.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let mut commanders = Self {
            stopped: HashSet::new(),
            last: HashMap::new(),
            look,
        };
        commanders.follow(mapping);
        commanders
    }

    /// Switches to another mapping.
    pub(crate) fn follow(&mut self, mapping: &Mapping) {
        let variables = mapping.variables().iter();
        let stopped = variables.filter(|variable| variable.loss.is_some());
        self.stopped = stopped.map(|variable| variable.topic).collect();
        self.last.retain(|topic, _| self.stopped.contains(topic));
    }

    /// Records the session that wrote a topic.
    pub(crate) fn wrote(&mut self, topic: TopicId, commander: Commander) {
        if self.stopped.contains(&topic) {
            self.last.insert(topic, commander);
        }
    }

    /// Returns the topics of lost commanders, each once. Cancel-safe; waits until there is such a
    /// topic.
    pub(crate) async fn lost(&mut self) -> Vec<TopicId> {
        loop {
            if self.last.is_empty() {
                std::future::pending::<()>().await;
            }
            self.look.tick().await;
            let lost = self.last.extract_if(|_, commander| !commander.lasts());
            let lost: Vec<TopicId> = lost.map(|(topic, _)| topic).collect();
            if !lost.is_empty() {
                return lost;
            }
        }
    }
}

/// Interval between two checks of the sessions.
const LOOK: Duration = Duration::from_millis(100);
