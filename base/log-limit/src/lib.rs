//! Limits how often a message with an external cause is logged: a peer in a loop must not fill the
//! log.
//!
//! [`Throttle`] limits a message, [`LogLimit`] a message for each of many causes. Both count
//! the suppressed messages, and return the count with the next logged message. Time is a parameter;
//! there is no clock.

mod record;

use std::collections::HashMap;
use std::time::{Duration, Instant};

pub use record::{LogRecord, LogSink};

/// Admits one message per period, or a few, and counts the others.
#[derive(Debug)]
pub struct Throttle {
    period: Duration,
    most: u32,
    /// Start of the period, and the number of messages admitted in it.
    began: Option<(Instant, u32)>,
    suppressed: u64,
}

impl Throttle {
    /// Creates a throttle that admits one message per period.
    #[must_use]
    pub const fn new(period: Duration) -> Self {
        Self::several(1, period)
    }

    /// Creates a throttle that admits that many messages per period.
    #[must_use]
    pub const fn several(most: u32, period: Duration) -> Self {
        Self {
            period,
            most,
            began: None,
            suppressed: 0,
        }
    }

    /// Returns the number of messages suppressed after the last admitted message if this message is
    /// to be logged, or `None` if it is suppressed too.
    pub fn admit(&mut self, now: impl Into<Instant>) -> Option<u64> {
        let now = now.into();
        let (began, used) = match self.began {
            Some((began, used)) if now.saturating_duration_since(began) < self.period => {
                (began, used)
            }
            _ => (now, 0),
        };
        if used < self.most {
            self.began = Some((began, used + 1));
            Some(std::mem::take(&mut self.suppressed))
        } else {
            self.suppressed += 1;
            None
        }
    }

    /// Returns the number of messages suppressed after the last admitted message.
    #[must_use]
    pub const fn suppressed(&self) -> u64 {
        self.suppressed
    }

    fn is_over(&self, now: Instant) -> bool {
        self.began
            .is_none_or(|(began, _)| now.saturating_duration_since(began) >= self.period)
    }
}

/// Admits a message once per period for each cause, for at most [`MOST`] causes. Further causes
/// share another message.
#[derive(Debug)]
pub struct LogLimit {
    every: Duration,
    causes: HashMap<String, Throttle>,
    others: Throttle,
}

impl LogLimit {
    /// Creates a limit that admits one message of each cause in that time.
    #[must_use]
    pub fn every(every: Duration) -> Self {
        Self {
            every,
            causes: HashMap::new(),
            others: Throttle::new(every),
        }
    }

    /// Returns the number of messages of this cause that were suppressed after the last admitted
    /// message if this message is to be logged, or `None` if it is suppressed too.
    pub fn admit(&mut self, cause: &str, now: impl Into<Instant>) -> Option<u64> {
        let now = now.into();
        if let Some(known) = self.causes.get_mut(cause) {
            return known.admit(now);
        }
        if self.causes.len() >= MOST {
            let others = &mut self.others;
            self.causes.retain(|_, known| {
                let stays = !known.is_over(now);
                if !stays {
                    others.suppressed += known.suppressed;
                }
                stays
            });
        }
        if self.causes.len() >= MOST {
            return self.others.admit(now);
        }
        let known = self.causes.entry(cause.to_owned());
        known
            .or_insert_with(|| Throttle::new(self.every))
            .admit(now)
    }
}

/// Maximum number of distinguished causes.
pub const MOST: usize = 256;

#[cfg(test)]
mod tests {
    #![expect(
        clippy::disallowed_methods,
        reason = "a test needs some instant to count from"
    )]
    use super::*;

    #[test]
    fn one_message_per_period_passes_with_the_number_of_suppressed_ones() {
        let start = Instant::now();
        let mut throttle = Throttle::new(Duration::from_secs(10));
        let lines = [0, 1, 9, 10].map(|at| throttle.admit(start + Duration::from_secs(at)));
        assert_eq!(lines, [Some(0), None, None, Some(2)]);
    }

    #[test]
    fn of_several_per_period_the_rest_is_counted() {
        let start = Instant::now();
        let mut throttle = Throttle::several(2, Duration::from_secs(10));
        let lines = [0, 1, 2, 9].map(|at| throttle.admit(start + Duration::from_secs(at)));
        assert_eq!(lines, [Some(0), Some(0), None, None]);
        assert_eq!(throttle.suppressed(), 2);
        let lines = [10, 11, 12].map(|at| throttle.admit(start + Duration::from_secs(at)));
        assert_eq!(lines, [Some(2), Some(0), None]);
    }

    #[test]
    fn each_cause_passes_once_per_period() {
        let (mut limit, first) = (LogLimit::every(Duration::from_secs(1)), Instant::now());
        let after = |ms| first + Duration::from_millis(ms);
        assert_eq!(limit.admit("a", first), Some(0));
        assert_eq!(limit.admit("a", after(1)), None);
        assert_eq!(limit.admit("b", after(2)), Some(0));
        assert_eq!(limit.admit("a", after(999)), None);
        assert_eq!(limit.admit("a", after(1000)), Some(2));
        assert_eq!(limit.admit("a", after(3000)), Some(0));
    }

    #[test]
    fn further_causes_share_one_message_and_are_counted() {
        let (mut limit, first) = (LogLimit::every(Duration::from_secs(1)), Instant::now());
        let admitted =
            (0..10_000).filter(|number| limit.admit(&number.to_string(), first).is_some());
        assert_eq!(admitted.count(), MOST + 1);
        let later = first + Duration::from_secs(2);
        assert_eq!(limit.admit("10000", later), Some(0));
        assert_eq!(limit.causes.len(), 1);
        assert_eq!(limit.others.suppressed(), 10_000 - 257);
    }
}
