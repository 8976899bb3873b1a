//! Reports drops that belong to no topic: drops of the node, its clock and its services.

use std::collections::BTreeMap;

use bridge_core::Reason;
use bridge_node::PortEvent;
use ros2_node::service::{ServiceCounters, ServiceServer};

use super::Ros2Port;

/// The reported counts, by reason and cause.
#[derive(Debug, Default)]
pub(super) struct Drops(BTreeMap<(&'static str, &'static str), u64>);

impl Drops {
    /// Returns the increases above the reported counts.
    fn since(
        &mut self,
        totals: impl IntoIterator<Item = (Reason, &'static str, u64)>,
    ) -> Vec<PortEvent> {
        let mut events = Vec::new();
        for (reason, why, total) in totals {
            let told = self.0.entry((reason.label(), why)).or_default();
            let count = total.saturating_sub(*told);
            // The total falls when a service is removed.
            *told = total;
            if count > 0 {
                events.push(PortEvent::Dropped { reason, why, count });
            }
        }
        events
    }
}

impl Ros2Port {
    /// Reports the drops after the last report.
    pub(super) fn report_drops(&mut self) {
        let served = self.parameters.counters().plus(self.told_types.counters());
        let calls = self.calls.servers().map(ServiceServer::counters);
        let calls = calls.fold(ServiceCounters::default(), ServiceCounters::plus);
        let totals = [
            (Reason::Malformed, "request of a call", calls.malformed),
            (
                Reason::CallFailed,
                "call without a response",
                calls.failures,
            ),
            (Reason::Overflow, "request of a call", calls.overflowed),
            (
                Reason::NotPublished,
                "response to a call",
                calls.undelivered,
            ),
            (
                Reason::Malformed,
                "list of nodes",
                self.domain.malformed_lists(),
            ),
            (Reason::Malformed, "clock", self.clock.malformed()),
            (Reason::Malformed, "service request", served.malformed),
            // Services of the bridge fail only at a request that they cannot decode.
            (
                Reason::Malformed,
                "body of a service request",
                served.failures,
            ),
            (Reason::Overflow, "service request", served.overflowed),
            (Reason::NotPublished, "service reply", served.undelivered),
        ];
        self.events.extend(self.drops.since(totals));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_drop_is_reported_once() {
        let mut drops = Drops::default();
        let mut counts = |malformed, failed| {
            let totals = [
                (Reason::Malformed, "clock", malformed),
                (Reason::Overflow, "clock", failed),
            ];
            let events = drops.since(totals).into_iter();
            let counts = events.map(|event| {
                let PortEvent::Dropped { reason, count, .. } = event else {
                    panic!("{event:?}");
                };
                (reason, count)
            });
            counts.collect::<Vec<_>>()
        };
        assert_eq!(counts(0, 0), []);
        let (malformed, overflow) = (Reason::Malformed, Reason::Overflow);
        assert_eq!(counts(3, 1), [(malformed, 3), (overflow, 1)]);
        assert_eq!(counts(3, 1), []);
        assert_eq!(counts(4, 1), [(malformed, 1)]);
    }
}
