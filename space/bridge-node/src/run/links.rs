//! The links of the local side that are lost, as they are reported to the port.

use std::net::IpAddr;
use std::time::{Duration, Instant};

/// Decides which lost links are reported.
#[derive(Debug, Default)]
pub(crate) struct LinkLoss {
    /// When the links were lost.
    since: Option<Instant>,
    reported: Vec<IpAddr>,
    /// How long the last check took.
    cost: Duration,
}

impl LinkLoss {
    /// Returns what the port is told: the lost addresses, once the loss lasts for `patience` and
    /// repeatedly while it lasts, and an empty list when the links are back.
    pub(super) fn look(
        &mut self,
        lost: Vec<IpAddr>,
        patience: Duration,
        now: Instant,
    ) -> Option<&[IpAddr]> {
        let was_reported = !self.reported.is_empty();
        if lost.is_empty() {
            self.since = None;
            self.reported.clear();
            return was_reported.then_some(&self.reported);
        }
        let since = *self.since.get_or_insert(now);
        if !was_reported && now.duration_since(since) < patience {
            return None;
        }
        self.reported = lost;
        Some(&self.reported)
    }

    /// Notes how long a check of the links took.
    pub(super) const fn took(&mut self, cost: Duration) {
        self.cost = cost;
    }

    /// Returns the time to the next check: `period`, or longer on a host with so many interfaces
    /// that the checks would take more than a fiftieth of the time.
    pub(super) fn pause(&self, period: Duration) -> Duration {
        period.max(self.cost.saturating_mul(50))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_link_that_is_lost_for_a_moment_is_not_reported_unless_there_is_no_patience() {
        let start = crate::clock::now().monotonic;
        let at = |ms| start + Duration::from_millis(ms);
        let patience = Duration::from_millis(200);
        let lost = || vec![IpAddr::from([10, 0, 0, 1])];
        let mut links = LinkLoss::default();
        assert_eq!(links.look(lost(), patience, at(0)), None);
        assert_eq!(links.look(lost(), patience, at(100)), None);
        assert_eq!(links.look(Vec::new(), patience, at(150)), None);
        assert_eq!(links.look(lost(), patience, at(300)), None);
        assert_eq!(links.look(lost(), patience, at(500)), Some(&*lost()));
        assert_eq!(links.look(lost(), patience, at(600)), Some(&*lost()));
        assert_eq!(links.look(Vec::new(), patience, at(700)), Some(&[][..]));
        assert_eq!(links.look(Vec::new(), patience, at(800)), None);
        let at_once = links.look(lost(), Duration::ZERO, at(900));
        assert_eq!(at_once, Some(&*lost()));
    }

    #[test]
    fn checks_of_many_interfaces_take_a_bounded_share_of_the_time() {
        let mut links = LinkLoss::default();
        let period = Duration::from_millis(25);
        assert_eq!(links.pause(period), period);
        links.took(Duration::from_millis(20));
        assert_eq!(links.pause(period), Duration::from_secs(1));
    }
}
