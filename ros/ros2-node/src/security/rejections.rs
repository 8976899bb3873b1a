//! Reports participants that DDS Security rejects, so that an operator learns why a robot is
//! missing.

use std::collections::{BTreeMap, VecDeque};
use std::time::Duration;

#[cfg(feature = "security")]
use rustdds::AuthenticationStatus;
use rustdds::DomainParticipantStatusEvent;
use tokio::time::Instant;

use crate::node::ParticipantPrefix;

/// The participants under authentication, and the rejected participants.
#[derive(Debug, Default)]
pub struct Rejections {
    /// Participants under authentication, with the start time.
    waiting: BTreeMap<ParticipantPrefix, Instant>,
    /// Participants that were logged, oldest first.
    told: VecDeque<ParticipantPrefix>,
}

/// A participant that is not admitted.
#[derive(Debug, PartialEq, Eq)]
pub struct Rejection {
    participant: ParticipantPrefix,
    why: &'static str,
}

impl Rejections {
    /// Records a discovery event; the caller logs and counts the returned participant.
    #[cfg(feature = "security")]
    pub fn note(
        &mut self,
        event: &DomainParticipantStatusEvent,
        now: Instant,
    ) -> Option<Rejection> {
        if let DomainParticipantStatusEvent::ParticipantLost { id, .. } = event {
            let gone: ParticipantPrefix = id.as_ref().try_into().ok()?;
            self.waiting.remove(&gone);
        }
        let DomainParticipantStatusEvent::Authentication {
            participant,
            status,
        } = event
        else {
            return None;
        };
        self.turn(participant.as_ref().try_into().ok()?, *status, now)
    }

    /// Returns `None`: without DDS Security no participant is rejected.
    #[cfg(not(feature = "security"))]
    pub const fn note(
        &mut self,
        _event: &DomainParticipantStatusEvent,
        _now: Instant,
    ) -> Option<Rejection> {
        None
    }

    #[cfg(feature = "security")]
    fn turn(
        &mut self,
        participant: ParticipantPrefix,
        status: AuthenticationStatus,
        now: Instant,
    ) -> Option<Rejection> {
        match status {
            AuthenticationStatus::Authenticating => {
                if self.waiting.len() < MAX_WAITING {
                    self.waiting.entry(participant).or_insert(now);
                }
                None
            }
            AuthenticationStatus::Authenticated | AuthenticationStatus::Unauthenticated => {
                self.waiting.remove(&participant);
                None
            }
            AuthenticationStatus::Rejected => {
                self.waiting.remove(&participant);
                let why = "it has no DDS Security, other governance settings, or no permission in this domain";
                Some(Rejection { participant, why })
            }
        }
    }

    /// Returns whether the participant was not logged yet, and records it as logged. Each attempt
    /// may use another identity, so the oldest entries are dropped.
    pub fn is_new(&mut self, rejection: &Rejection) -> bool {
        let is_new = !self.told.contains(&rejection.participant);
        if is_new {
            if self.told.len() >= MAX_TOLD {
                self.told.pop_front();
            }
            self.told.push_back(rejection.participant);
        }
        is_new
    }

    /// Returns the participants that failed to authenticate in time, once each.
    pub fn overdue(&mut self, now: Instant) -> Vec<Rejection> {
        let late = |since: &Instant| now.saturating_duration_since(*since) > PATIENCE;
        let overdue = self.waiting.iter().filter(|(_, since)| late(since));
        let rejections: Vec<Rejection> = overdue
            .map(|(participant, _)| Rejection {
                participant: *participant,
                why: "it did not authenticate; its certificate may come from another identity CA",
            })
            .collect();
        for rejection in &rejections {
            self.waiting.remove(&rejection.participant);
        }
        rejections
    }
}

impl std::fmt::Display for Rejection {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("participant ")?;
        for byte in self.participant {
            write!(f, "{byte:02x}")?;
        }
        write!(f, " is rejected: {}", self.why)
    }
}

/// The time limit of a handshake of three messages, each repeated every second.
const PATIENCE: Duration = Duration::from_secs(8);
/// Maximum number of logged participants that are remembered.
const MAX_TOLD: usize = 256;
/// Maximum number of participants under authentication: any host can claim an identity.
#[cfg(feature = "security")]
const MAX_WAITING: usize = 1024;

#[cfg(all(test, feature = "security"))]
mod tests {
    use super::*;

    #[test]
    fn the_log_names_each_once_however_many_come() {
        let mut rejections = Rejections::default();
        let rejection = |number: u32| {
            let mut participant = [0; 12];
            participant[..4].copy_from_slice(&number.to_le_bytes());
            Rejection {
                participant,
                why: "of the test",
            }
        };
        for number in 0..10_000 {
            assert!(rejections.is_new(&rejection(number)), "{number}");
            assert!(!rejections.is_new(&rejection(number)), "{number}");
        }
        assert!(rejections.told.len() <= MAX_TOLD);
    }

    #[test]
    fn who_does_not_prove_itself_in_time_is_told_once() {
        let (mut rejections, start) = (Rejections::default(), Instant::now());
        let mut turn = |who: u8, status, at| rejections.turn([who; 12], status, at);
        assert_eq!(turn(1, AuthenticationStatus::Authenticating, start), None);
        assert_eq!(turn(2, AuthenticationStatus::Authenticating, start), None);
        assert_eq!(turn(2, AuthenticationStatus::Authenticated, start), None);
        let refused = turn(3, AuthenticationStatus::Rejected, start).unwrap();
        assert!(refused.to_string().contains("030303"), "{refused}");
        assert_eq!(rejections.overdue(start + PATIENCE), []);
        let late = start + PATIENCE + Duration::from_millis(1);
        let overdue = rejections.overdue(late);
        assert!(matches!(overdue.as_slice(), [one] if one.participant == [1; 12]));
        assert_eq!(rejections.overdue(late), []);
    }
}
