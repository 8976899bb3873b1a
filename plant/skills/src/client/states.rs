//! The states of the skills of a server, as the server publishes them.

use std::time::Duration;

use plant_opcua::client::{ClientSubscription, MonitoredWatch, Notice};
use program::ProgramMachineState;

use super::SkillClient;
use super::found::FoundSkill;
use super::handle::{STATE_PATHS, state_in};

impl SkillClient {
    /// Subscribes to the states of skills of the server, each by its position.
    #[must_use]
    pub fn states(&self, skills: &[FoundSkill]) -> SkillStates {
        let mut watches = Vec::new();
        let mut of = Vec::new();
        for (at, skill) in skills.iter().enumerate() {
            let mut paths = STATE_PATHS.iter();
            if let Some(node) = paths.find_map(|path| skill.nodes.get(path)) {
                watches.push(MonitoredWatch::Value(node.clone()));
                of.push(at);
            }
        }
        SkillStates {
            subscription: self.client.subscribe(watches, STATES, MOST_STATES),
            of,
        }
    }
}

/// The states of skills, as the server publishes them.
pub struct SkillStates {
    subscription: ClientSubscription,
    of: Vec<usize>,
}

impl SkillStates {
    /// Returns the next state, with the position of its skill; `None` when the client is closed.
    pub async fn next(&mut self) -> Option<(usize, ProgramMachineState)> {
        loop {
            let Notice::Value { watch, value } = self.subscription.next().await? else {
                continue;
            };
            let state = value.value.as_ref().and_then(state_in);
            if let (Some(at), Some(state)) = (self.of.get(watch), state) {
                return Some((*at, state));
            }
        }
    }
}

/// Publishing interval of the states of skills.
const STATES: Duration = Duration::from_millis(50);
/// Maximum number of states that wait to be read.
const MOST_STATES: usize = 4096;
