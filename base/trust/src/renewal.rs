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
/// itself. A failed renewal is repeated with growing pauses: from half a minute to an hour, and of a self-made certificate, which
/// peers do not trust yet, from 2 s to a minute.
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
        let again = self.failed.map(|(at, times)| at + self.pause(times));
        let next = again.map_or_else(|| self.due(), |again| again.max(self.due()));
        if now < next {
            return Step::Wait { until: next };
        }
        match now > self.until {
            true => Step::Late,
            false => Step::Ask,
        }
    }

    /// Returns the pause after so many failures: twice as long each time.
    fn pause(&self, times: u32) -> Duration {
        let (first, longest) = match self.is_self_made {
            true => SELF_MADE_PAUSES,
            false => PAUSES,
        };
        let factor = 1_u32.checked_shl(times.saturating_sub(1));
        first
            .saturating_mul(factor.unwrap_or(u32::MAX))
            .min(longest)
    }

    /// It was asked for, in vain.
    pub fn failed(&mut self, now: Duration) {
        let times = self.failed.map_or(0, |(_, times)| times);
        self.failed = Some((now, times.saturating_add(1)));
    }
}

/// Returns whether people should replace a certificate that no program renews, such as the certificate of an authority: less
/// than a fifth of its life is left, or less than a year of a life of more than two years.
#[must_use]
pub fn is_near_end(certificate: &Certificate, now: Duration) -> bool {
    let (from, until) = certificate.validity();
    let life = until.saturating_sub(from);
    let early = match life > YEAR * 2 {
        true => YEAR.max(life / 5),
        false => life / 5,
    };
    now + early >= until
}

/// The first and the longest pause after a failure.
const PAUSES: (Duration, Duration) = (Duration::from_secs(30), Duration::from_secs(3600));
/// The same for a certificate that the application has made itself.
const SELF_MADE_PAUSES: (Duration, Duration) = (Duration::from_secs(2), Duration::from_secs(60));
const YEAR: Duration = Duration::from_secs(365 * 86_400);
