//! Busy polling for the next sample instead of sleeping until it arrives, if samples follow each
//! other closely.
//!
//! On an idle core that is halted, as in most virtual machines, waking a thread costs more than all
//! the work of a bridge for a small sample. The wait until the thread runs is most of a round trip.
//! In a closed loop the next sample arrives before the core has gone to sleep and come back. Busy
//! polling takes a whole core: if programs that exchange samples do not have a core each, they wait
//! for the polling programs.

use std::time::{Duration, Instant};

/// Decides whether an idle loop keeps polling for a short while after each sample.
///
/// It takes no time from a quiet bridge: polling starts after 16 samples less than 500 us apart,
/// and each window without a sample takes away that much credit. The maximal cost is one window for
/// every 16 samples, or one core while each window ends with a sample.
#[derive(Debug)]
pub struct BusyPoll {
    window: Duration,
    /// Incremented by each sample that arrives soon after the previous sample.
    credit: u32,
    /// Time of the last sample.
    last: Option<Instant>,
    /// Time when the loop became idle after the last sample.
    idle: Option<Instant>,
}

impl BusyPoll {
    /// Polls for up to `window` after each sample; never, if `window` is zero.
    #[must_use]
    pub const fn new(window: Duration) -> Self {
        Self {
            window,
            credit: 0,
            last: None,
            idle: None,
        }
    }

    /// Records a sample.
    pub fn arrived(&mut self, at: Instant) {
        if self.window.is_zero() {
            return;
        }
        let soon = self
            .last
            .is_some_and(|last| at.saturating_duration_since(last) <= SHORT);
        self.credit = if soon { (self.credit + 1).min(MOST) } else { 0 };
        self.last = Some(at);
        self.idle = None;
    }

    /// Returns whether to poll again instead of sleeping. `clock` is read only if necessary.
    pub fn looks(&mut self, clock: impl FnOnce() -> Instant) -> bool {
        if self.credit < WORTH_IT {
            return false;
        }
        let now = clock();
        let idle = *self.idle.get_or_insert(now);
        if now.saturating_duration_since(idle) < self.window {
            return true;
        }
        self.credit -= WORTH_IT;
        false
    }
}

/// Samples further apart than this do not start polling.
const SHORT: Duration = Duration::from_micros(500);
/// Number of samples less than 500 us apart that pay for one window.
const WORTH_IT: u32 = 16;
/// The maximal credit. It covers two windows, so that one window without a sample does not end
/// polling in the middle of a loop.
const MOST: u32 = 2 * WORTH_IT;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::clock::now;

    const WINDOW: Duration = Duration::from_micros(200);

    /// Feeds samples `apart` from each other, and polls after each until the next. Returns the
    /// total time of polling, and the time of its end.
    fn stream(
        poll: &mut BusyPoll,
        from: Instant,
        apart: Duration,
        samples: u32,
    ) -> (Duration, Instant) {
        let mut looked = Duration::ZERO;
        let mut at = from;
        for _ in 0..samples {
            poll.arrived(at);
            let step = Duration::from_micros(5);
            let mut now = at;
            while now < at + apart && poll.looks(|| now) {
                now += step;
                looked += step;
            }
            at += apart;
        }
        (looked, at)
    }

    #[test]
    fn a_closed_loop_is_looked_for_all_the_time_but_for_its_beginning() {
        let mut poll = BusyPoll::new(WINDOW);
        let apart = Duration::from_micros(60);
        let (looked, _) = stream(&mut poll, now().monotonic, apart, 1000);
        assert_eq!(looked, apart * (1000 - WORTH_IT));
    }

    #[test]
    fn a_topic_of_1_khz_costs_nothing() {
        let mut poll = BusyPoll::new(WINDOW);
        let (looked, _) = stream(&mut poll, now().monotonic, Duration::from_millis(1), 1000);
        assert_eq!(looked, Duration::ZERO);
    }

    #[test]
    fn looking_in_vain_costs_a_window_for_sixteen_samples() {
        let mut poll = BusyPoll::new(WINDOW);
        let (looked, _) = stream(&mut poll, now().monotonic, Duration::from_micros(300), 1600);
        assert!(
            looked > Duration::ZERO && looked <= WINDOW * 100,
            "{looked:?}"
        );
    }

    #[test]
    fn a_loop_that_ends_is_looked_for_once_or_twice() {
        let mut poll = BusyPoll::new(WINDOW);
        let (_, mut later) = stream(&mut poll, now().monotonic, Duration::from_micros(60), 1000);
        let ended = later;
        for _ in 0..10 {
            while poll.looks(|| later) {
                later += Duration::from_micros(5);
            }
        }
        assert!(
            later > ended && later - ended <= WINDOW * 2,
            "{:?}",
            later - ended
        );
    }

    #[test]
    fn without_a_window_it_sleeps() {
        let mut poll = BusyPoll::new(Duration::ZERO);
        let (looked, _) = stream(&mut poll, now().monotonic, Duration::from_micros(60), 1000);
        assert_eq!(looked, Duration::ZERO);
    }
}
