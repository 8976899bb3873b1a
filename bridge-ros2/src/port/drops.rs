//! Reports drops that belong to no topic: drops of the node, its clock and its services.

use std::collections::BTreeMap;

use bridge_core::Reason;
use bridge_node::PortEvent;

/// The reported counts, by reason and cause.
#[derive(Debug, Default)]
pub(super) struct Drops(BTreeMap<(&'static str, &'static str), u64>);

impl Drops {
    /// Returns the increases above the reported counts.
    pub(super) fn since(
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
