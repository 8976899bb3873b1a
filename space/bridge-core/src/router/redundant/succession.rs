//! The last takeover, and the events that precede it: the former active bridge may have delivered
//! them.

use std::time::Duration;

use mappings::Lasting;

use crate::place::SequencePosition;
use crate::redundancy::{SenderClocks, SentAt};
use crate::settings::Now;

/// A takeover by this program.
#[derive(Debug, Clone, Copy)]
pub(super) struct Succession {
    /// The time of the takeover.
    pub(super) at: Now,
    /// Whether another bridge may have been active before.
    pub(super) is_of_another: bool,
}

impl Succession {
    /// Returns the relation of a received message to this takeover, as long as the network may
    /// still hold messages that precede it.
    pub(super) fn relation(
        self,
        place: &SequencePosition,
        clocks: &SenderClocks,
        now: Now,
    ) -> Option<SinceTakeover> {
        let Self { at, is_of_another } = self;
        if now.monotonic.saturating_duration_since(at.monotonic) >= HELD_AT_MOST {
            return None;
        }
        let sent_at = place
            .sent
            .and_then(|sent| clocks.sent_at(place.from, sent, at.monotonic));
        Some(SinceTakeover {
            at,
            is_of_another,
            sent_at,
            now,
        })
    }
}

/// The relation of a received message to the last takeover.
#[derive(Debug, Clone, Copy)]
pub(in crate::router) struct SinceTakeover {
    at: Now,
    is_of_another: bool,
    /// The time at which the message was sent, if the clock of its sender was known before the
    /// takeover.
    sent_at: Option<SentAt>,
    now: Now,
}

impl SinceTakeover {
    /// Returns whether an event was first sent before the takeover: the former active bridge may
    /// have delivered it. `within` is the time for which a command is repeated until it is
    /// confirmed; `None` for other events.
    ///
    /// A command that cannot be dated counts as earlier for a second after another bridge was
    /// active.
    pub(in crate::router) fn is_preceded_by(
        self,
        place: &SequencePosition,
        (lasting, within): (Lasting, Option<Duration>),
    ) -> bool {
        let age = place.stamp.zip(place.sent).map(|(stamp, sent)| {
            let age = sent.unix_nanos() - stamp.unix_nanos();
            Duration::from_nanos(u64::try_from(age.max(0)).unwrap_or(u64::MAX))
        });
        // The repetitions of an event end after this time. A longer age is that of a stored state,
        // or the stamp is from another clock.
        let longest = within.unwrap_or_default().max(OLDEST_EVENT);
        let is_event = match lasting {
            Lasting::State => false,
            Lasting::Event => true,
            Lasting::AsSource => age.is_none_or(|age| age < longest),
        };
        if !is_event {
            return false;
        }
        let (Some(age), Some(sent)) = (age, place.sent) else {
            let is_command = within.is_some() && self.is_of_another;
            let passed = self.now.monotonic - self.at.monotonic;
            return is_command && passed < CLOCKS_DIFFER;
        };
        let age = age.min(longest);
        let first = match (self.sent_at, within.filter(|_| self.is_of_another)) {
            (Some(SentAt::BeforeStart), _) => None,
            (Some(SentAt::Since(sent)), _) => sent.checked_sub(age),
            // Only the clocks of the two hosts can be compared.
            (None, Some(_)) => {
                let age = i128::try_from(age.as_nanos()).unwrap_or(i128::MAX);
                let since = sent.unix_nanos() - age - self.at.utc.unix_nanos();
                return since < i128::try_from(CLOCKS_DIFFER.as_nanos()).unwrap_or(i128::MAX);
            }
            (None, None) => self.now.monotonic.checked_sub(age),
        };
        first.is_none_or(|first| first + SLACK < self.at.monotonic)
    }
}

/// The age from which a value is a stored state and no event. Events without confirmation are
/// repeated for a shorter time.
const OLDEST_EVENT: Duration = Duration::from_millis(500);
/// The time by which the clocks of the writer and of the network may differ. The former active
/// bridge has sent nothing for longer at a takeover.
const SLACK: Duration = Duration::from_millis(5);
/// The time by which the clocks of two hosts may differ.
const CLOCKS_DIFFER: Duration = Duration::from_secs(1);
/// The longest time for which a network holds a datagram back.
const HELD_AT_MOST: Duration = Duration::from_secs(10);
