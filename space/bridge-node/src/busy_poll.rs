//! Looking for the next sample instead of sleeping until it comes, where samples follow each other closely.
//!
//! Waking a thread costs more than all a bridge does with a small sample where an idle core is halted, as in most
//! virtual machines, and the wait until it runs is most of a round trip. In a closed loop the next sample is there before
//! the core has gone to sleep and come back. But what looks takes a core: where programs that hand samples to each other
//! have no core each, they wait for those that look.

use std::time::{Duration, Instant};

/// Whether a loop that has nothing to do goes on looking, for a short while after each sample.
///
/// It takes no time from a quiet bridge: it begins after 16 samples less than 500 us apart, and looking in
/// vain for a whole window takes that much credit away again. What it costs at most is a window for every 16
/// samples, and all of one core while each window ends with a sample.
#[derive(Debug)]
pub struct BusyPoll {
    window: Duration,
    /// One for each sample that came soon after the one before.
    credit: u32,
    /// When the last sample came.
    last: Option<Instant>,
    /// When there was nothing left to do after it.
    idle: Option<Instant>,
}

impl BusyPoll {
    /// Looks for as long as `window` after each sample; never, if that is zero.
    #[must_use]
    pub const fn new(window: Duration) -> Self {
        Self {
            window,
            credit: 0,
            last: None,
            idle: None,
        }
    }

    /// Takes note of a sample.
    pub fn arrived(&mut self, at: Instant) {
        if self.window.is_zero() {
            return;
        }
        let soon = self
            .last
            .is_some_and(|last| at.saturating_duration_since(last) <= SHORT);
        self.credit = match soon {
            true => (self.credit + 1).min(MOST),
            false => 0,
        };
        self.last = Some(at);
        self.idle = None;
    }

    /// Whether to look again now, rather than to sleep. `clock` is read only when it matters.
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

/// Samples further apart are nothing to stay awake for.
const SHORT: Duration = Duration::from_micros(500);
/// How many samples less than 500 us apart are worth one window.
const WORTH_IT: u32 = 16;
/// So that one window in vain does not end it in the midst of a loop.
const MOST: u32 = 2 * WORTH_IT;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::clock::now;

    const WINDOW: Duration = Duration::from_micros(200);

    /// Samples `apart` from each other, looked for after each until the next; returns how long that was in all, and when
    /// it ended.
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
