//! The schedule for the renewal of a certificate.

use std::time::Duration;

use crate::certificate::Certificate;

/// The next step of a renewal.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RenewalStep {
    /// Wait until a later time.
    Wait {
        /// The time of the next check.
        until: Duration,
    },
    /// Request a new certificate.
    Ask,
    /// Request a new certificate; the present certificate has expired, and peers refuse it.
    Late,
}

/// The schedule for the renewal of a certificate: after four fifths of its lifetime, or at once for
/// a self-made certificate. A failed renewal is repeated with growing pauses from 30 s to an hour.
/// For a self-made certificate, which peers do not trust yet, the pauses grow from 2 s to a minute.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Renewal {
    from: Duration,
    until: Duration,
    /// Whether the certificate is self-signed.
    is_self_made: bool,
    /// The time of the last failure, and the number of failures.
    failed: Option<(Duration, u32)>,
}

impl Renewal {
    /// Creates the schedule for a certificate.
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

    /// Returns the time of the first request.
    #[must_use]
    pub fn due(&self) -> Duration {
        let life = self.until.saturating_sub(self.from);
        if self.is_self_made {
            self.from
        } else {
            self.from + life / 5 * 4
        }
    }

    /// Returns the end of the validity.
    #[must_use]
    pub const fn until(&self) -> Duration {
        self.until
    }

    /// Returns the remaining lifetime; zero after the expiry.
    #[must_use]
    pub const fn left(&self, now: Duration) -> Duration {
        self.until.saturating_sub(now)
    }

    /// Returns the next step.
    #[must_use]
    pub fn step(&self, now: Duration) -> RenewalStep {
        let again = self.failed.map(|(at, times)| at + self.pause(times));
        let next = again.map_or_else(|| self.due(), |again| again.max(self.due()));
        if now < next {
            return RenewalStep::Wait { until: next };
        }
        if now > self.until {
            RenewalStep::Late
        } else {
            RenewalStep::Ask
        }
    }

    /// Returns the pause after this number of failures. The pause doubles with each failure.
    fn pause(&self, times: u32) -> Duration {
        let (first, longest) = if self.is_self_made {
            SELF_MADE_PAUSES
        } else {
            PAUSES
        };
        let factor = 1_u32.checked_shl(times.saturating_sub(1));
        first
            .saturating_mul(factor.unwrap_or(u32::MAX))
            .min(longest)
    }

    /// Records a failed renewal.
    pub fn failed(&mut self, now: Duration) {
        let times = self.failed.map_or(0, |(_, times)| times);
        self.failed = Some((now, times.saturating_add(1)));
    }
}

/// Returns whether an operator should replace a certificate that is not renewed automatically, such
/// as the certificate of an authority. This is the case if less than a fifth of its lifetime is
/// left, or less than a year of a lifetime of more than two years.
#[must_use]
pub fn is_near_end(certificate: &Certificate, now: Duration) -> bool {
    let (from, until) = certificate.validity();
    let life = until.saturating_sub(from);
    let early = if life > YEAR * 2 {
        YEAR.max(life / 5)
    } else {
        life / 5
    };
    now + early >= until
}

/// The first and the longest pause after a failure.
const PAUSES: (Duration, Duration) = (Duration::from_secs(30), Duration::from_secs(3600));
/// The first and the longest pause for a self-made certificate.
const SELF_MADE_PAUSES: (Duration, Duration) = (Duration::from_secs(2), Duration::from_secs(60));
const YEAR: Duration = Duration::from_secs(365 * 86_400);
