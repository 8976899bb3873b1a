//! When a certificate is to be asked for anew.

use std::time::Duration;

use crate::certificate::Certificate;

/// What is to be done about a certificate now.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Step {
    /// Nothing before that time.
    Wait {
        /// When to look again.
        until: Duration,
    },
    /// A new one is to be asked for now.
    Ask,
    /// The same, and it is over already: others refuse it.
    Late,
}

/// The plan for the renewal of a certificate: when four fifths of its life are over, or at once if the application has made it
/// itself. A failed renewal is repeated with growing pauses.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Renewal {
    from: Duration,
    until: Duration,
    /// Whether no authority has issued it.
    is_self_made: bool,
    /// When it was asked for last in vain, and how often that was.
    failed: Option<(Duration, u32)>,
}

impl Renewal {
    /// The plan for a certificate.
    #[must_use]
    pub fn of(certificate: &Certificate) -> Self {
        let (from, until) = certificate.validity();
        Self {
            from,
            until,
            is_self_made: certificate.is_self_signed(),
            failed: None,
        }
    }

    /// When it is to be asked for the first time.
    #[must_use]
    pub fn due(&self) -> Duration {
        let life = self.until.saturating_sub(self.from);
        match self.is_self_made {
            true => self.from,
            false => self.from + life / 5 * 4,
        }
    }

    /// The last moment of the certificate.
    #[must_use]
    pub const fn until(&self) -> Duration {
        self.until
    }

    /// What is left of the certificate's life; nothing when it is over.
    #[must_use]
    pub const fn left(&self, now: Duration) -> Duration {
        self.until.saturating_sub(now)
    }

    /// What is to be done.
    #[must_use]
    pub fn step(&self, now: Duration) -> Step {
        let again = self.failed.map(|(at, times)| at + pause(times));
        let next = again.map_or_else(|| self.due(), |again| again.max(self.due()));
        if now < next {
            return Step::Wait { until: next };
        }
        match now > self.until {
            true => Step::Late,
            false => Step::Ask,
        }
    }

    /// It was asked for, in vain.
    pub fn failed(&mut self, now: Duration) {
        let times = self.failed.map_or(0, |(_, times)| times);
        self.failed = Some((now, times.saturating_add(1)));
    }
}

/// From half a minute on twice as long each time, up to an hour.
fn pause(times: u32) -> Duration {
    let doubled = FIRST_PAUSE.saturating_mul(
        1_u32
            .checked_shl(times.saturating_sub(1))
            .unwrap_or(u32::MAX),
    );
    doubled.min(LONGEST_PAUSE)
}

const FIRST_PAUSE: Duration = Duration::from_secs(30);
const LONGEST_PAUSE: Duration = Duration::from_secs(3600);
