//! What is remembered of one DataSetWriter of another space.

use std::collections::VecDeque;
use std::net::SocketAddr;
use std::time::{Duration, Instant};

use mappings::Lasting;
use uadp::{BuiltinType, DataSetMessage, SequenceOrder, Timestamp};

use crate::base::Base;
use crate::confirm::Receipt;
use crate::counters::Reason;
use crate::output::Kept;
use crate::place::Place;
use crate::settings::Local;
use crate::writer::MAX_KEPT;

/// The state of a topic we receive.
#[derive(Debug)]
pub(crate) struct Reader {
    /// Sequence number of the newest DataSetMessage taken.
    sequence: Option<u16>,
    /// The Timestamp of the last one that was no repetition.
    stamp: Option<Timestamp>,
    /// Who sent it; `None` before the first.
    from: Option<SocketAddr>,
    /// How often that was another than before, since it was asked.
    moved: u64,
    /// When anything was last heard of the writer, keep-alives included.
    heard: Instant,
    /// When the topic's value was last known to hold: the local side took one, or the writer repeated it or had nothing new.
    good: Instant,
    /// Why the newest message since then was dropped.
    dropped: Option<Reason>,
    /// Whether the topic is held to be silent.
    silent: bool,
    /// The samples that were handed on, in this order, as far as their stamps are fine enough to tell them apart; at
    /// most [`MAX_KNOWN`].
    known: VecDeque<Known>,
    /// `Some` while the writer repeats several values side by side, as it does for several latched publishers: when it
    /// last repeated another than the newest.
    several: Option<Instant>,
    /// Whether the writer repeats its values as states, which is learnt from its messages.
    lasting: bool,
    /// Whether the writer was seen to send a sample right after it was taken, so that its stamps tell stored values from
    /// new ones.
    prompt: bool,
    /// Whether different values came under the same stamp, so that the stamp identifies no sample.
    still: bool,
    /// Whether the writer has ended or timed out since its last message, so that it may number its messages anew.
    over: bool,
    /// A stored value that was found to be no state.
    withdrawn: Option<Timestamp>,
    /// A sample that waits for its local type.
    pub(crate) held: Option<Box<Held>>,
    /// The newest event, where this space confirms it.
    pub(crate) receipt: Option<Receipt>,
    /// The state that delta frames change.
    pub(crate) base: Option<Box<Base>>,
    /// Whether the writer has sent a delta frame.
    pub(crate) deltas: bool,
    /// Whether the local side lacks the value: it was not handed on, or not taken.
    pub(crate) owed: bool,
    /// When the writer was last asked what the fields of its messages are.
    pub(crate) asked_layout: Option<Instant>,
    /// When the port was last asked for the local type.
    pub(crate) asked: Option<Instant>,
    /// Builtin type of each field, and whether it is an array, of a sample of the present version.
    pub(crate) shape: Option<Vec<(BuiltinType, bool)>>,
    /// The major version its messages have (OPC 10000-14, 6.2.3.2.6).
    major_version: Option<u32>,
    /// When what it is said to be was last taken, and how often it was another by then.
    renamed: Option<(Instant, u32)>,
    /// What the port is to be told of the topic.
    pub(crate) news: News,
}

/// What the port is to be told of a topic, in this order.
#[derive(Debug, Default)]
pub(crate) struct News {
    /// Whether the topic stands in the Router's list of those with news.
    pub(crate) queued: bool,
    /// Whether its writer is silent has changed.
    pub(crate) silence: bool,
    /// It is to be asked for a local type.
    pub(crate) ask: Option<Ask>,
}

/// When the port is asked for the local type of a topic.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Ask {
    /// Where its writer says what it is: there is a type.
    IfDescribed,
    /// In any case: there is none.
    Always,
}

/// A sample that was handed on.
#[derive(Debug)]
struct Known {
    stamp: Timestamp,
    heard: Instant,
    repeated: bool,
    /// Whether it is one of the topic's values now.
    live: bool,
    /// How it was handed on.
    handed: Handed,
}

/// How a sample was handed to the local side.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Handed {
    /// Not at all: it was stored by its writer, and may be an event.
    No,
    /// To present subscribers.
    Once,
    /// For subscribers that come late, too.
    Lasting,
}

/// How the values of a topic reach the local side.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Handling {
    /// The last value is shown, event or state.
    Shown,
    /// Each value is published once into ROS.
    Event,
    /// The value is published into ROS and stored there for subscribers that come late.
    State,
    /// A state where its writer repeats it as one, else an event.
    AsSource,
}

impl Handling {
    pub(crate) const fn of(local: Local, lasting: Lasting) -> Self {
        match (local, lasting) {
            (Local::Fields, _) => Self::Shown,
            (_, Lasting::Event) => Self::Event,
            (_, Lasting::State) => Self::State,
            (_, Lasting::AsSource) => Self::AsSource,
        }
    }
}

/// What a message that is taken is to the others of its writer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Admitted {
    /// Messages that are missing before it.
    pub(crate) missing: u16,
    /// What it is to the topic's other values.
    pub(crate) kept: Kept,
    /// Whether subscribers that come late get it.
    pub(crate) lasting: bool,
}

/// A sample that came before its local type was known; the newest one is kept.
#[derive(Debug)]
pub(crate) struct Held {
    pub(crate) fields: Vec<u8>,
    pub(crate) source: Option<Timestamp>,
    pub(crate) instance: Option<Timestamp>,
    pub(crate) status: u16,
    pub(crate) lasting: bool,
    /// When an event is too old to be handed on, and a large sample is removed.
    pub(crate) until: Instant,
}

impl Held {
    /// Whether it counts against the bytes that large samples share.
    pub(crate) const fn is_large(&self) -> bool {
        self.fields.len() > MAX_SMALL
    }

    /// When the sample is removed, if it is large.
    pub(crate) fn expires(&self) -> Option<Instant> {
        self.is_large().then_some(self.until)
    }
}

impl Reader {
    pub(crate) const fn new(from: Option<SocketAddr>, now: Instant) -> Self {
        Self {
            sequence: None,
            stamp: None,
            from,
            moved: 0,
            heard: now,
            good: now,
            dropped: None,
            silent: false,
            known: VecDeque::new(),
            several: None,
            lasting: false,
            prompt: false,
            still: false,
            over: false,
            withdrawn: None,
            held: None,
            receipt: None,
            base: None,
            deltas: false,
            owed: true,
            asked_layout: None,
            asked: None,
            shape: None,
            major_version: None,
            renamed: None,
            news: News {
                queued: false,
                silence: false,
                ask: None,
            },
        }
    }

    /// When anything was last heard of the writer.
    pub(crate) const fn heard_at(&self) -> Instant {
        self.heard
    }

    /// Whether anything was ever heard of the writer.
    pub(crate) const fn was_heard(&self) -> bool {
        self.from.is_some()
    }

    /// Whether the topic is held to be silent.
    pub(crate) const fn is_silent(&self) -> bool {
        self.silent
    }

    /// How often its values came from another address than before, since this was asked.
    pub(crate) const fn take_moved(&mut self) -> u64 {
        std::mem::replace(&mut self.moved, 0)
    }

    /// Takes note that the writer lives.
    pub(crate) const fn heard(&mut self, now: Instant) {
        self.heard = now;
    }

    /// Takes note that the topic has a good value, and says whether it was silent before.
    pub(crate) fn is_good(&mut self, now: Instant) -> bool {
        self.good = now;
        self.dropped = None;
        std::mem::take(&mut self.silent)
    }

    /// Takes note that the writer lives and says nothing else: its last value holds, unless a newer one was dropped. Says
    /// whether the topic was silent before and is not now.
    pub(crate) fn lives(&mut self, now: Instant) -> bool {
        match self.dropped {
            // Those say nothing against the value there is.
            None | Some(Reason::Duplicate | Reason::Stale) => self.is_good(now),
            Some(_) => false,
        }
    }

    /// Takes note that a message of the writer was dropped, if that leaves the topic with an old value.
    pub(crate) const fn dropped(&mut self, reason: Reason) {
        let says_nothing = matches!(reason, Reason::Duplicate | Reason::Stale);
        if reason.is_loss() && !(says_nothing && self.dropped.is_some()) {
            self.dropped = Some(reason);
        }
    }

    /// Whether what comes from there may be of the writer: of one that was not heard for `timeout` nobody knows.
    pub(crate) fn may_be(&self, from: SocketAddr, now: Instant, timeout: Duration) -> bool {
        self.from.is_none_or(|known| known == from)
            || now.saturating_duration_since(self.heard) >= timeout
    }

    /// Takes note of the version of a message, and says whether what was known of the content is no longer true.
    pub(crate) fn is_changed(&mut self, major_version: Option<u32>) -> bool {
        let before = std::mem::replace(&mut self.major_version, major_version);
        let changed = before.is_some() && before != major_version;
        if changed {
            self.shape = None;
        }
        changed
    }

    /// Whether the topic may be said to be something now, and something else if anything is `known` of it: the port opens
    /// it anew for that, and whoever can send under the writer's address could have it do nothing else. The first word is
    /// taken, and the first other one; from then on each is waited for twice as long as the one before.
    pub(crate) fn may_be_renamed(&mut self, known: bool, now: Instant) -> bool {
        let (since, times) = match self.renamed {
            Some(renamed) => renamed,
            None if known => (now, 0),
            None => {
                self.renamed = Some((now, 0));
                return true;
            }
        };
        let passed = now.saturating_duration_since(since);
        let wait = match times.checked_sub(1) {
            Some(again) => RENAME_AFTER * (1_u32 << again.min(MOST_DOUBLINGS)),
            None => Duration::ZERO,
        };
        if passed < wait {
            return false;
        }
        let forgiven = passed >= RENAME_AFTER * (1_u32 << MOST_DOUBLINGS);
        let times = if forgiven { 1 } else { times.saturating_add(1) };
        self.renamed = Some((now, times));
        true
    }

    /// Whether the topic has just been without a good value for `timeout`. True once per silence.
    pub(crate) fn fell_silent(&mut self, now: Instant, timeout: Duration) -> bool {
        let fell = !self.silent && now.saturating_duration_since(self.good) >= timeout;
        self.silent |= fell;
        if fell {
            // Who comes back may send something else.
            self.shape = None;
            self.over = true;
            self.receipt = None;
        }
        fell
    }

    /// Takes note that the writer says it has ended, and says whether the topic was not silent before.
    pub(crate) fn leave(&mut self) -> bool {
        self.shape = None;
        self.over = true;
        self.receipt = None;
        !std::mem::replace(&mut self.silent, true)
    }

    /// Why the newest message since the last good value was dropped, if one was.
    pub(crate) const fn loss(&self) -> Option<Reason> {
        self.dropped
    }

    /// When silence is to be looked for again; `None` while the topic is silent.
    pub(crate) fn due(&self, timeout: Duration) -> Option<Instant> {
        (!self.silent).then(|| self.good + timeout)
    }

    /// Admits a message into the sequence.
    ///
    /// The order of the sequence numbers is that of OPC 10000-14, 7.2.3. A writer that starts over looks old by its
    /// numbers; its stamps or its new address show it. A writer whose clock was set back seems to repeat older
    /// values; that its numbers go on and the sample is fresh tells.
    ///
    /// # Errors
    /// The reason to drop it: it came before under this number, a newer one came before, it repeats a value that the local
    /// side has, or it is a stored value that may be an event.
    pub(crate) fn admit(
        &mut self,
        place: Place,
        message: Option<&DataSetMessage<'_>>,
        handling: Handling,
        now: Instant,
    ) -> Result<Admitted, Reason> {
        let moved = self.from.is_some_and(|from| from != place.from);
        let again = place.stamp.is_some() && place.stamp == self.stamp;
        let restarted = moved
            || (self.over && !again && !self.came_before(&place, handling))
            || matches!((place.stamp, self.stamp), (Some(new), Some(last)) if new > last);
        let first = self.sequence.is_none() || moved || self.over;
        let mut next = false;
        let missing = match (self.sequence, place.sequence) {
            (Some(last), Some(sequence)) => match SequenceOrder::of_u16(last, sequence) {
                // The local side does not have it yet.
                SequenceOrder::Same if handling == Handling::Shown && self.owed => 0,
                SequenceOrder::Same if !restarted => return Err(self.again(&place)),
                SequenceOrder::Older { .. } if !restarted => return Err(Reason::Stale),
                SequenceOrder::Newer { missed } => {
                    next = true;
                    u16::try_from(missed).unwrap_or(u16::MAX)
                }
                SequenceOrder::Same | SequenceOrder::Older { .. } | SequenceOrder::Invalid => 0,
            },
            (_, _) => 0,
        };
        self.sequence = place.sequence;
        self.over = false;
        self.from = Some(place.from);
        self.moved += u64::from(moved);
        if moved {
            self.lasting = false;
            self.prompt = false;
            self.still = false;
        }
        self.prompt |= place.is_fresh();
        if next && self.is_set_back(place) {
            self.forget_all();
            self.stamp = None;
        }
        let stamp = place.instance().filter(|_| !self.still);
        let same = stamp.is_none_or(|stamp| self.is_same(stamp, message));
        if !same {
            // Another value under the same stamp.
            self.still = true;
            self.known.clear();
        }
        let stamp = stamp.filter(|_| same);
        let kept = match stamp {
            // Newer than all before, as nearly every sample is.
            Some(stamp) if self.several.is_none() && self.stamp.is_none_or(|last| stamp > last) => {
                Kept::Alone
            }
            Some(stamp) => self.recognise((stamp, &place), handling, now)?,
            None => Kept::Alone,
        };
        if kept != Kept::Again {
            self.stamp = place.stamp.or(self.stamp);
        }
        let lasting = match handling {
            Handling::State => true,
            Handling::AsSource => self.lasting,
            Handling::Shown | Handling::Event => false,
        };
        let into_ros = matches!(handling, Handling::Event | Handling::AsSource);
        // Clients of an OPC UA server set the stamps of its values.
        let is_stored = place.is_stored() && stamp.is_some() && !place.by_clients;
        if into_ros && !lasting && is_stored && (first || self.prompt) {
            if let Some(stamp) = stamp {
                self.note(stamp, (kept, Handed::No), now);
            }
            return Err(Reason::Repeat);
        }
        Ok(Admitted {
            missing,
            kept,
            lasting,
        })
    }

    /// The newest message came once more under its number: its writer sends events again in case they were lost, and stored
    /// values for readers that show them.
    fn again(&mut self, place: &Place) -> Reason {
        let (Some(stamp), Some(last)) = (place.instance(), self.stamp) else {
            return Reason::Duplicate;
        };
        if stamp != last {
            return Reason::Duplicate;
        }
        if place.is_stored() && std::mem::take(&mut self.lasting) {
            self.withdrawn = Some(stamp);
        }
        Reason::Repeat
    }

    /// Whether a sample was handed on, as its stamp says. After the end of a writer that tells a datagram which the network
    /// held back from the first one of a writer that starts over. A stored value of the latter is no event.
    fn came_before(&self, place: &Place, handling: Handling) -> bool {
        let is_known = |stamp| self.known.iter().any(|known| known.stamp == stamp);
        let stored = place.is_stored() && handling != Handling::Event;
        !stored && place.instance().is_some_and(is_known)
    }

    /// The value that the local side is to store no longer.
    pub(crate) const fn take_withdrawn(&mut self) -> Option<Timestamp> {
        self.withdrawn.take()
    }

    /// Whether a message under the stamp of the newest one has its value, as far as that is known.
    fn is_same(&self, stamp: Timestamp, message: Option<&DataSetMessage<'_>>) -> bool {
        if self.stamp != Some(stamp) {
            return true;
        }
        match (&self.base, message) {
            (Some(base), Some(message)) => base.is_same(message, stamp),
            (_, _) => true,
        }
    }

    /// Whether a sample that follows the last one was taken before it, by a clock that was set back in between.
    fn is_set_back(&self, place: Place) -> bool {
        let older = matches!((place.stamp, self.stamp), (Some(new), Some(last)) if new < last);
        let known = || {
            self.known
                .iter()
                .any(|known| Some(known.stamp) == place.stamp)
        };
        older && place.is_fresh() && !known()
    }

    /// What a sample is that may be a repetition.
    fn recognise(
        &mut self,
        (stamp, place): (Timestamp, &Place),
        handling: Handling,
        now: Instant,
    ) -> Result<Kept, Reason> {
        let newest = self.stamp == Some(stamp);
        let older = self.stamp.is_some_and(|last| stamp < last);
        let known = self.known.iter_mut().find(|known| known.stamp == stamp);
        // An older value is repeated after a newer one: they live side by side.
        if (known.is_some() && !newest) || (known.is_none() && older) {
            self.several = Some(now);
        }
        let Some(known) = known else {
            return Ok(if self.several.is_some() {
                Kept::Beside
            } else {
                Kept::Alone
            });
        };
        known.heard = now;
        known.repeated = true;
        // Only states are repeated under numbers of their own.
        self.lasting = true;
        let handed = known.handed;
        match (handling, handed) {
            (Handling::Event, _) if place.is_stored() => Err(Reason::Repeat),
            // The same event twice under one stamp.
            (Handling::Event, _) | (_, Handed::No) => {
                self.known.retain(|known| known.stamp != stamp);
                Ok(match self.several {
                    Some(_) => Kept::Beside,
                    None => Kept::Alone,
                })
            }
            (Handling::AsSource, Handed::Once) => Ok(Kept::Again),
            (_, Handed::Once | Handed::Lasting) if known.live => Err(Reason::Repeat),
            (_, Handed::Once | Handed::Lasting) => Ok(Kept::Again),
        }
    }

    /// Takes note that a sample is handed on, so that its repetitions are known. Gives the one that had to be
    /// forgotten for it, if that was still one of the topic's values.
    pub(crate) fn delivered(
        &mut self,
        instance: Option<Timestamp>,
        (kept, lasting): (Kept, bool),
        now: Instant,
    ) -> Option<Timestamp> {
        self.owed = false;
        let Some(stamp) = instance.filter(|_| !self.still) else {
            self.known.clear();
            return None;
        };
        let handed = match lasting {
            true => Handed::Lasting,
            false => Handed::Once,
        };
        self.note(stamp, (kept, handed), now)
    }

    fn note(
        &mut self,
        stamp: Timestamp,
        (kept, handed): (Kept, Handed),
        now: Instant,
    ) -> Option<Timestamp> {
        let mut repeated = false;
        match kept {
            Kept::Again => {
                if let Some(known) = self.known.iter_mut().find(|known| known.stamp == stamp) {
                    known.live = true;
                    known.handed = handed;
                }
                return None;
            }
            Kept::Alone => {
                // Of one value at a time only the last one can be live.
                if let Some(last) = self.known.back_mut() {
                    last.live = false;
                }
            }
            // Where a newer one came before, it is a repetition that we know the first of only now.
            Kept::Beside => repeated = self.known.iter().any(|known| known.stamp > stamp),
        }
        let evicted = (self.known.len() >= MAX_KNOWN).then(|| self.evict());
        self.known.push_back(Known {
            stamp,
            heard: now,
            repeated,
            live: true,
            handed,
        });
        evicted
            .flatten()
            .filter(|known| known.live)
            .map(|known| known.stamp)
    }

    /// The local side no longer stores any value of the writer, which has ended or timed out. A repetition brings the value
    /// back.
    pub(crate) fn withdraw(&mut self) {
        for known in &mut self.known {
            known.live = false;
        }
    }

    /// Removes the oldest one; among several values rather one that was never repeated.
    fn evict(&mut self) -> Option<Known> {
        let seldom = match self.several {
            Some(_) => self.known.iter().position(|known| !known.repeated),
            None => None,
        };
        self.known.remove(seldom.unwrap_or(0))
    }

    /// Among several values, the next one that the writer has not repeated for `after` while it did others. To be
    /// asked after each key frame until there is none.
    pub(crate) fn retire(&mut self, now: Instant, after: Duration) -> Option<Timestamp> {
        let several = self.several?;
        let ended = now.saturating_duration_since(several) >= after;
        let newest = self.stamp;
        let mut live = self.known.iter_mut().filter(|known| known.live);
        let gone = live.find(|known| {
            now.saturating_duration_since(known.heard) >= after
                || (ended && Some(known.stamp) != newest)
        });
        if let Some(gone) = gone {
            gone.live = false;
            return Some(gone.stamp);
        }
        let mut live = self.known.iter().filter(|known| known.live);
        if let (last, None) = (live.next(), live.next()) {
            self.several = None;
            self.stamp = last.map(|known| known.stamp).or(self.stamp);
        }
        None
    }

    /// Forgets that a sample was handed on: it was not after all, and its repetition is welcome.
    pub(crate) fn forget(&mut self, instance: Option<Timestamp>) {
        self.owed = true;
        self.known.retain(|known| Some(known.stamp) != instance);
    }

    /// Forgets what was handed on: the local type changed, and the next repetition is wanted.
    pub(crate) fn forget_all(&mut self) {
        self.owed = true;
        self.known.clear();
        self.several = None;
        self.receipt = None;
    }
}

/// The size up to which a sample of each topic may wait for its local type: whoever sends to the group can invent topics, and
/// all of them together must not hold more than some megabytes.
const MAX_SMALL: usize = 4_096;
/// Samples whose repetitions are known: as many as a writer keeps.
const MAX_KNOWN: usize = MAX_KEPT;
/// How long the second other word on what a topic is has to wait for, and how often that is doubled.
const RENAME_AFTER: Duration = Duration::from_secs(10);
const MOST_DOUBLINGS: u32 = 8;

#[cfg(test)]
mod tests {
    use super::*;

    fn address(port: u16) -> SocketAddr {
        ([127, 0, 0, 1], port).into()
    }

    fn place(sequence: u16, stamp: i128) -> Place {
        Place {
            sequence: Some(sequence),
            stamp: Some(Timestamp::from_unix_nanos(stamp)),
            fine: true,
            sent: None,
            from: address(1),
            held_back: Duration::ZERO,
            by_clients: false,
        }
    }

    /// Admits a message that is shown.
    fn admit(reader: &mut Reader, place: Place, now: Instant) -> Result<(u16, Kept), Reason> {
        let admitted = reader.admit(place, None, Handling::Shown, now)?;
        Ok((admitted.missing, admitted.kept))
    }

    #[expect(
        clippy::disallowed_methods,
        reason = "a test needs some instant to count from"
    )]
    fn reader() -> (Reader, Instant) {
        let now = Instant::now();
        (Reader::new(Some(address(1)), now), now)
    }

    #[test]
    fn numbers_wrap_and_gaps_are_counted() {
        let (mut reader, now) = reader();
        assert_eq!(
            admit(&mut reader, place(65_534, 1000), now),
            Ok((0, Kept::Alone))
        );
        assert_eq!(
            admit(&mut reader, place(65_535, 2000), now),
            Ok((0, Kept::Alone))
        );
        assert_eq!(
            admit(&mut reader, place(2, 3000), now),
            Ok((2, Kept::Alone)),
            "0 and 1 are missing"
        );
    }

    #[test]
    fn old_and_equal_numbers_are_dropped_unless_the_writer_started_over() {
        let (mut reader, now) = reader();
        assert_eq!(hear(&mut reader, 500, 9000, now), Ok(Kept::Alone));
        assert_eq!(
            admit(&mut reader, place(500, 9000), now),
            Err(Reason::Repeat),
            "sent again under its number"
        );
        assert_eq!(
            admit(&mut reader, place(499, 8000), now),
            Err(Reason::Stale)
        );
        assert_eq!(
            admit(&mut reader, place(0, 10_000), now),
            Ok((0, Kept::Alone)),
            "a newer stamp tells of a restart"
        );
        let moved = Place {
            from: address(2),
            ..place(0, 10_000)
        };
        assert_eq!(
            admit(&mut reader, moved, now),
            Ok((0, Kept::Alone)),
            "another address tells of a restart"
        );
    }

    #[test]
    fn a_datagram_that_comes_after_the_end_of_its_writer_is_handed_on_once() {
        for handling in [Handling::Event, Handling::AsSource, Handling::Shown] {
            let (mut reader, now) = reader();
            let admit = |reader: &mut Reader, place: Place| {
                let admitted = reader.admit(place, None, handling, now)?;
                reader.delivered(place.instance(), (admitted.kept, admitted.lasting), now);
                Ok(admitted.kept)
            };
            assert_eq!(admit(&mut reader, place(7, 1000)), Ok(Kept::Alone));
            assert_eq!(admit(&mut reader, place(8, 2000)), Ok(Kept::Alone));
            assert!(reader.leave());
            // The network held both back.
            assert_eq!(admit(&mut reader, place(7, 1000)), Err(Reason::Stale));
            assert_eq!(admit(&mut reader, place(8, 2000)), Err(Reason::Repeat));
            // The next writer starts over, with a clock that was set back.
            assert_eq!(admit(&mut reader, place(0, 500)).err(), None);
        }
    }

    #[test]
    fn a_repeated_key_frame_is_known_by_its_stamp() {
        let (mut reader, now) = reader();
        let first = place(1, 1000);
        assert_eq!(admit(&mut reader, first, now), Ok((0, Kept::Alone)));
        reader.delivered(first.instance(), (Kept::Alone, false), now);
        assert_eq!(admit(&mut reader, place(2, 1000), now), Err(Reason::Repeat));
        assert_eq!(
            admit(&mut reader, place(3, 2000), now),
            Ok((0, Kept::Alone)),
            "another sample"
        );
        let (mut coarse, now) = self::reader();
        let stamp_without_picoseconds = Place {
            fine: false,
            ..place(1, 1000)
        };
        assert_eq!(
            admit(&mut coarse, stamp_without_picoseconds, now),
            Ok((0, Kept::Alone))
        );
        coarse.delivered(
            stamp_without_picoseconds.instance(),
            (Kept::Alone, false),
            now,
        );
        let next = Place {
            sequence: Some(2),
            ..stamp_without_picoseconds
        };
        assert_eq!(
            admit(&mut coarse, next, now),
            Ok((0, Kept::Alone)),
            "a coarse stamp may be shared by two samples"
        );
    }

    const PERIOD: Duration = Duration::from_secs(1);

    /// Plays a key frame through, as the Router does.
    fn hear(reader: &mut Reader, sequence: u16, stamp: i128, now: Instant) -> Result<Kept, Reason> {
        let place = place(sequence, stamp);
        let (_, kept) = admit(reader, place, now)?;
        reader.delivered(place.instance(), (kept, false), now);
        Ok(kept)
    }

    #[test]
    fn of_several_values_repeated_side_by_side_each_is_handed_on_once() {
        let (mut reader, start) = reader();
        let first: Vec<_> = [1000, 2000, 3000]
            .into_iter()
            .zip(1..)
            .map(|(stamp, sequence)| hear(&mut reader, sequence, stamp, start))
            .collect();
        assert_eq!(first, [Ok(Kept::Alone); 3]);
        let mut round = |turn: u16| -> Vec<_> {
            let now = start + PERIOD * u32::from(turn);
            [1000, 2000, 3000]
                .into_iter()
                .zip(turn * 3 + 1..)
                .map(|(stamp, sequence)| hear(&mut reader, sequence, stamp, now))
                .collect()
        };
        let kept_again = [Ok(Kept::Again), Ok(Kept::Again), Err(Reason::Repeat)];
        assert_eq!(
            round(1),
            kept_again,
            "the older ones were not given up after all"
        );
        for turn in 2..20 {
            assert_eq!(round(turn), [Err(Reason::Repeat); 3]);
        }
    }

    #[test]
    fn who_comes_late_gets_all_values_wherever_in_the_round_it_begins() {
        let (mut reader, now) = reader();
        let heard: Vec<_> = [2000, 3000, 1000, 2000, 3000, 1000]
            .into_iter()
            .zip(7..)
            .map(|(stamp, sequence)| hear(&mut reader, sequence, stamp, now))
            .collect();
        let repeat = Err(Reason::Repeat);
        let expected = [
            Ok(Kept::Alone),
            Ok(Kept::Alone),
            Ok(Kept::Beside),
            Ok(Kept::Again),
            repeat,
            repeat,
        ];
        assert_eq!(heard, expected);
    }

    #[test]
    fn a_value_that_is_no_longer_repeated_is_retired_and_one_value_is_a_state_again() {
        let (mut reader, start) = reader();
        let mut sequence = 0;
        let mut retired = Vec::new();
        for turn in 0..12_u32 {
            let now = start + PERIOD * turn;
            // From turn 4 on an update of the first takes its place, from turn 8 on the second has gone.
            let first = if turn < 4 { 1000 } else { 3000 };
            for stamp in [first, 2000].into_iter().filter(|s| turn < 8 || *s != 2000) {
                sequence += 1;
                let _what = hear(&mut reader, sequence, stamp, now);
                while let Some(gone) = reader.retire(now, PERIOD * 3) {
                    retired.push((turn, gone.unix_nanos()));
                }
            }
        }
        assert_eq!(retired, [(6, 1000), (10, 2000)]);
        let next = hear(&mut reader, sequence + 1, 4000, start + PERIOD * 12);
        assert_eq!(next, Ok(Kept::Alone));
    }

    #[test]
    fn a_clock_that_is_set_back_makes_no_older_value_of_a_newer_one() {
        let (mut reader, now) = reader();
        let sent_at = |sequence, stamp: i128, sent: i128| Place {
            sent: Some(Timestamp::from_unix_nanos(sent)),
            ..place(sequence, stamp)
        };
        let (second, soon) = (1_000_000_000, 50_000);
        let mut hear = |place: Place| {
            let (_, kept) = admit(&mut reader, place, now)?;
            reader.delivered(place.instance(), (kept, false), now);
            Ok(kept)
        };
        let first = hear(sent_at(1, 1000 * second, 1000 * second + soon));
        assert_eq!(first, Ok(Kept::Alone));
        let set_back = hear(sent_at(2, 900 * second, 900 * second + soon));
        assert_eq!(set_back, Ok(Kept::Alone));
        let next = hear(sent_at(3, 901 * second, 901 * second + soon));
        assert_eq!(next, Ok(Kept::Alone));
        let repeated = hear(sent_at(4, 901 * second, 902 * second));
        assert_eq!(repeated, Err(Reason::Repeat));
        // What was taken before and is sent only now is another value beside it, as of several latched publishers.
        let beside = hear(sent_at(5, 890 * second, 903 * second));
        assert_eq!(beside, Ok(Kept::Beside));
    }

    #[test]
    fn nothing_is_retired_while_the_writer_says_nothing_at_all() {
        let (mut reader, start) = reader();
        for (sequence, stamp) in (0..).zip([1000, 2000, 1000, 2000]) {
            let _what = hear(&mut reader, sequence, stamp, start);
        }
        let later = start + PERIOD * 60;
        assert_eq!(hear(&mut reader, 4, 1000, later), Err(Reason::Repeat));
        let gone = reader.retire(later, PERIOD * 3);
        assert_eq!(gone.map(Timestamp::unix_nanos), Some(2000));
        assert_eq!(reader.retire(later, PERIOD * 3), None);
    }

    #[test]
    fn a_fast_topic_beside_a_latched_value_does_not_push_that_out() {
        let (mut reader, now) = reader();
        let mut sequence = 0_u16;
        let mut stamp = 1000;
        let mut heard_anew = 0;
        for turn in 0..2000 {
            sequence += 1;
            if turn % 100 == 0 {
                let of_latched = hear(&mut reader, sequence, 1000, now);
                heard_anew += usize::from(of_latched != Err(Reason::Repeat));
            } else {
                stamp += 1;
                assert!(hear(&mut reader, sequence, stamp, now).is_ok());
            }
        }
        // Handed on first, and once more when it turns out that it stays beside the others.
        assert!(heard_anew <= 2, "{heard_anew}");
    }

    #[test]
    fn silence_is_told_once_and_ends_with_the_next_message() {
        let (mut reader, start) = reader();
        let timeout = Duration::from_secs(3);
        let early = start + Duration::from_millis(2999);
        assert!(!reader.fell_silent(early, timeout));
        assert!(reader.fell_silent(start + timeout, timeout));
        assert!(!reader.fell_silent(start + timeout * 2, timeout));
        assert_eq!(reader.due(timeout), None);
        assert!(reader.lives(start + timeout * 3));
        assert!(!reader.lives(start + timeout * 3));
        assert!(reader.fell_silent(start + timeout * 4, timeout));
        assert_eq!(reader.loss(), None);
    }

    #[test]
    fn who_only_repeats_itself_on_two_ways_lives_and_who_is_not_understood_does_not() {
        let (mut reader, start) = reader();
        let timeout = Duration::from_secs(3);
        reader.dropped(Reason::Duplicate);
        assert!(!reader.lives(start + timeout), "it never was silent");
        assert!(!reader.fell_silent(start + timeout, timeout));
        reader.dropped(Reason::Overflow);
        assert!(!reader.lives(start + timeout * 2));
        assert!(!reader.fell_silent(start + timeout * 2, timeout));
        reader.dropped(Reason::Mismatch);
        reader.dropped(Reason::Duplicate);
        reader.heard(start + timeout * 3);
        assert!(!reader.lives(start + timeout * 3));
        assert!(reader.fell_silent(start + timeout * 3, timeout));
        assert_eq!(reader.loss(), Some(Reason::Mismatch));
        assert!(!reader.lives(start + timeout * 4));
        assert!(!reader.may_be(address(2), start + timeout * 4, timeout * 2));
        assert!(reader.is_good(start + timeout * 4));
    }
}
