//! The links of the local side that are lost, as they are reported to the port.

use std::collections::BTreeMap;
use std::net::IpAddr;
use std::time::{Duration, Instant};

/// Decides which lost links are reported.
#[derive(Debug, Default)]
pub(crate) struct LinkLoss {
    /// The lost addresses, and when they were lost.
    lost: BTreeMap<IpAddr, Instant>,
    reported: Vec<IpAddr>,
    /// How long a check takes, as a mean in which longer times count less.
    cost: Duration,
}

impl LinkLoss {
    /// Returns the addresses that have been lost for `patience`, at each call while the loss lasts.
    /// Returns an empty list once when all links are back, and `None` if there is nothing new.
    pub(super) fn look(
        &mut self,
        lost: &[IpAddr],
        patience: Duration,
        now: Instant,
    ) -> Option<&[IpAddr]> {
        self.lost.retain(|address, _| lost.contains(address));
        for address in lost {
            self.lost.entry(*address).or_insert(now);
        }
        let is_due = |since: &Instant| now.duration_since(*since) >= patience;
        let due = self.lost.iter().filter(|(_, since)| is_due(since));
        let before = std::mem::replace(&mut self.reported, due.map(|(one, _)| *one).collect());
        let is_told = !self.reported.is_empty() || !before.is_empty();
        is_told.then_some(&self.reported)
    }

    /// Returns whether a link is lost, reported or not.
    pub(super) fn is_lost(&self) -> bool {
        !self.lost.is_empty()
    }

    /// Notes how long a check of the links took.
    pub(super) fn took(&mut self, cost: Duration) {
        let more = cost.saturating_sub(self.cost);
        self.cost = cost.min(self.cost + more / 8);
    }

    /// Returns the time to the next check: `period`, or longer on a host with so many interfaces
    /// that the checks would take more than a fiftieth of the time.
    pub(super) fn pause(&self, period: Duration) -> Duration {
        period.max(self.cost.saturating_mul(50).min(LONGEST_PAUSE))
    }
}

const LONGEST_PAUSE: Duration = Duration::from_millis(250);

#[cfg(test)]
mod tests {
    use super::*;

    const PATIENCE: Duration = Duration::from_millis(200);

    fn address(last: u8) -> IpAddr {
        IpAddr::from([10, 0, 0, last])
    }

    #[test]
    fn a_link_that_is_lost_for_a_moment_is_not_reported_unless_there_is_no_patience() {
        let start = crate::clock::now().monotonic;
        let at = |ms| start + Duration::from_millis(ms);
        let lost = [address(1)];
        let mut links = LinkLoss::default();
        for (ms, now_lost, told) in [
            (0, &lost[..], None),
            (100, &lost[..], None),
            (150, &[][..], None),
            (300, &lost[..], None),
            (500, &lost[..], Some(&lost[..])),
            (600, &lost[..], Some(&lost[..])),
            (700, &[][..], Some(&[][..])),
            (800, &[][..], None),
        ] {
            assert_eq!(links.look(now_lost, PATIENCE, at(ms)), told, "{ms}");
        }
        let at_once = links.look(&lost, Duration::ZERO, at(900));
        assert_eq!(at_once, Some(&lost[..]));
    }

    #[test]
    fn each_link_has_its_own_patience() {
        let start = crate::clock::now().monotonic;
        let at = |ms| start + Duration::from_millis(ms);
        let mut links = LinkLoss::default();
        let (first, both) = ([address(1)], [address(1), address(2)]);
        assert_eq!(links.look(&first, PATIENCE, at(0)), None);
        assert_eq!(links.look(&first, PATIENCE, at(200)), Some(&first[..]));
        assert_eq!(links.look(&both, PATIENCE, at(300)), Some(&first[..]));
        assert_eq!(links.look(&first, PATIENCE, at(400)), Some(&first[..]));
    }

    #[test]
    fn checks_of_many_interfaces_take_a_bounded_share_of_the_time() {
        let mut links = LinkLoss::default();
        let period = Duration::from_millis(25);
        assert_eq!(links.pause(period), period);
        // The process was not scheduled for a moment.
        links.took(Duration::from_millis(4));
        assert_eq!(links.pause(period), period);
        for _ in 0..20 {
            links.took(Duration::from_millis(3));
        }
        assert!(links.pause(period) > Duration::from_millis(100));
        for _ in 0..20 {
            links.took(Duration::from_millis(30));
        }
        assert_eq!(links.pause(period), Duration::from_millis(250));
    }
}
