//! Calls of other spaces, as services of the graph.

use super::Ros1Port;
use crate::services::Ros1Graph;

impl Ros1Port {
    /// Offers the calls that are known as services.
    pub(super) fn offer_calls(&mut self) {
        let mut graph = Ros1Graph {
            node: &self.node,
            definitions: &mut self.definitions,
        };
        let (all, most) = (|_| true, usize::MAX);
        let calls = &mut self.calls;
        let events = calls.offer_waiting(&mut graph, &mut self.policy, all, most);
        self.events.extend(events);
    }
}
