//! A writer that never waits.
//!
//! RustDDS stops a reliable writer while its send window is full ([`Offered::policies`]): samples it does not take
//! then wait here, in a queue as long as the topic's overflow policy says, and go out when the window opens.
//!
//! Samples wait, too, from the time the first reader was seen until it has answered: it is known here before our writer
//! is known there, and what is written in between is history, which a volatile reader does not get.

use std::collections::VecDeque;
use std::time::Duration;

use bridge_node::policy::NO_SUBSCRIBER;
use bridge_node::{Handover, Reason};
use rustdds::dds::WriteError;
use rustdds::{DataWriterStatus, GUID, StatusEvented, Timestamp};
use tokio::time::Instant;

use crate::graph::Endpoint;
use crate::limits;
use crate::qos::Offered;
use crate::raw::{Payload, Writer};

/// The writing end of one topic.
pub struct Outlet {
    writer: Writer,
    offered: Offered,
    joined: Instant,
    audience: Audience,
    /// Samples for which the send window had no room, oldest first.
    waiting: VecDeque<Sample>,
    /// Whether a sample was dropped that would have come late, and that was not told.
    has_late: bool,
    /// Since when the send window has no room.
    full_since: Option<Instant>,
    /// Bytes written since every reader had acknowledged everything.
    in_flight: usize,
    /// Of a state topic, the value its readers have: another writer has to begin with it.
    last: Option<Sample>,
    /// Since when the writer's history holds a sample that no reader is to find there, once those that are present have it.
    to_forget: Option<Instant>,
    /// Writers that were replaced, oldest first, while their readers may lack something of what they wrote.
    former: VecDeque<Former>,
}

/// A writer that writes nothing any more, and repairs what it has written.
pub struct Former {
    writer: Writer,
    until: Instant,
}

#[derive(Debug, Clone)]
struct Sample {
    payload: Payload,
    source: Option<Timestamp>,
    /// Whether readers that come late get it.
    lasting: bool,
    /// When it would come late.
    until: Option<Instant>,
}

/// Who listens.
#[derive(Debug)]
enum Audience {
    /// No reader. The history holds the last state alone, for transient-local readers that come; volatile readers get nothing
    /// that was written before. The history of RustDDS as published would keep all values without acknowledgement: there the
    /// state is held back until transient-local readers, and no others, have come.
    Nobody { held: Option<Sample> },
    /// Somebody, whom a sample of at most that size reaches.
    Present {
        /// Until what is written reaches them; none when it does.
        settling: Option<Settling>,
        /// How many there are, as far as they were seen.
        seen: usize,
        sample_size: usize,
    },
}

/// Waiting for readers to learn of the writer.
#[derive(Debug, Clone, Copy)]
struct Settling {
    since: Instant,
    /// How long to wait for one that says nothing.
    patience: Duration,
}

/// Why a sample was not delivered.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum Refusal {
    /// The send window is full, and the waiting room too: the oldest waiting sample made room for this one.
    Overflow,
    /// Larger than this many bytes, which is what readers of this topic receive for certain ([`limits`]). Not written.
    TooLarge(usize),
    /// An event, and no reader is present.
    NoReader,
    /// It waited for its readers until it would have come late.
    Late,
    /// RustDDS failed; it does so only when one of its threads has died.
    Failed,
}

impl Refusal {
    /// Returns the counter and the label under which it is counted.
    #[must_use]
    pub fn cause(self) -> (Reason, &'static str) {
        let reason = match self {
            Self::Overflow => Reason::Overflow,
            Self::NoReader => Reason::NoSubscriber,
            Self::TooLarge(_) | Self::Late | Self::Failed => Reason::NotPublished,
        };
        (reason, self.label())
    }

    /// The label under which it is counted.
    #[must_use]
    pub fn label(self) -> &'static str {
        match self {
            Self::Overflow => "subscriber too slow",
            Self::TooLarge(_) => "too large for DDS",
            Self::NoReader => NO_SUBSCRIBER,
            Self::Late => "subscriber not ready in time",
            Self::Failed => "DDS writer failed",
        }
    }
}

impl Outlet {
    /// Wraps a writer created with the policies of `offered` in a domain joined at `joined`
    /// ([`Domain::joined`](crate::domain::Domain::joined)).
    #[must_use]
    pub fn new(writer: Writer, offered: Offered, joined: Instant) -> Self {
        Self {
            writer,
            offered,
            joined,
            audience: Audience::Nobody { held: None },
            waiting: VecDeque::new(),
            has_late: false,
            full_since: None,
            in_flight: 0,
            last: None,
            to_forget: None,
            former: VecDeque::new(),
        }
    }

    /// Whether another writer should take over ([`replace_writer`](Self::replace_writer)): a reader of a state topic
    /// has acknowledged nothing for so long that the others see an old value. Events are worth waiting for instead. The patched
    /// RustDDS goes on without a reader that is silent, and one that is not is being served.
    #[must_use]
    pub fn is_stuck(&self, now: Instant) -> bool {
        !limits::PATCHED
            && self.offered == Offered::KeepLatest
            && self
                .full_since
                .is_some_and(|since| now.duration_since(since) >= STUCK_AFTER)
    }

    /// Puts a new writer of the same topic and policies in place. What waits is written once its readers know it.
    pub fn replace_writer(&mut self, writer: Writer, now: Instant) {
        // Not for the reader because of which it is replaced.
        let patience = if self.is_stuck(now) { SETTLE } else { PATIENCE };
        let before = std::mem::replace(&mut self.writer, writer);
        self.full_since = None;
        let in_flight = std::mem::take(&mut self.in_flight);
        self.former
            .extend(Former::of(before, self.offered, in_flight, now));
        if self.former.len() > MOST_FORMER {
            self.former.pop_front();
        }
        // What is held back is newer than the last that was written.
        if self.waiting.is_empty() && !matches!(self.audience, Audience::Nobody { held: Some(_) }) {
            self.waiting.extend(self.last.clone());
        }
        if let Audience::Present { settling, .. } = &mut self.audience {
            *settling = Some(Settling {
                since: now,
                patience,
            });
        }
    }

    /// Gives the topic up, but for what its readers may lack of what was written; what waits is dropped.
    pub fn give_up(self, now: Instant) -> Option<Former> {
        Former::of(self.writer, self.offered, self.in_flight, now)
    }

    /// The writer's GUID.
    #[must_use]
    pub fn guid(&self) -> GUID {
        self.writer.guid()
    }

    /// Whether samples wait for room, or to be forgotten; [`flush`](Self::flush) sees to both.
    #[must_use]
    pub fn is_waiting(&self) -> bool {
        !self.waiting.is_empty() || self.to_forget.is_some()
    }

    /// Whether readers that come late get a value that is not older than `source`.
    #[must_use]
    pub fn stores_newer_than(&self, source: Option<Timestamp>) -> bool {
        let held = match &self.audience {
            Audience::Nobody { held } => held.as_ref(),
            Audience::Present { .. } => None,
        };
        held.or(self.last.as_ref())
            .is_some_and(|stored| stored.source >= source)
    }

    /// Removes the values written so far from the history. Present readers still get them, late readers do not.
    pub fn forget_stored(&mut self, now: Instant) {
        if let Audience::Nobody { held } = &mut self.audience {
            *held = None;
        }
        for sample in &mut self.waiting {
            sample.lasting = false;
        }
        if self.last.take().is_some() {
            self.to_forget = Some(now);
        }
        self.look_back(now);
    }

    /// Clears the history of samples that no reader is to find there, once the readers that are present have acknowledged them
    /// or had the time to.
    fn look_back(&mut self, now: Instant) {
        let Some(since) = self.to_forget else {
            return;
        };
        if now.saturating_duration_since(since) >= STUCK_AFTER || self.is_acknowledged() {
            self.forget_written();
            self.to_forget = None;
        }
    }

    /// Whether a writer that was replaced is still there; [`set_readers`](Self::set_readers) lets go of it.
    #[must_use]
    pub fn is_repairing(&self) -> bool {
        !self.former.is_empty()
    }

    /// Writes a sample, or queues it. Never waits. Of a state topic readers that come late get it, too.
    ///
    /// # Errors
    /// [`Refusal`]: one sample was lost, this or an older one.
    pub fn offer(
        &mut self,
        payload: Payload,
        source: Option<Timestamp>,
        now: Instant,
    ) -> Result<(), Refusal> {
        let lasting = self.offered == Offered::KeepLatest;
        self.offer_sample(
            Sample {
                payload,
                source,
                lasting,
                until: None,
            },
            now,
        )
    }

    /// As [`offer`](Self::offer), of an event: for the readers that are present.
    ///
    /// # Errors
    /// [`Refusal`]: one sample was lost, this or an older one; [`Refusal::NoReader`] without a
    /// present reader.
    pub fn offer_once(
        &mut self,
        payload: Payload,
        source: Option<Timestamp>,
        now: Instant,
    ) -> Result<(), Refusal> {
        self.offer_sample(
            Sample {
                payload,
                source,
                lasting: false,
                until: None,
            },
            now,
        )?;
        match self.audience {
            Audience::Nobody { .. } => Err(Refusal::NoReader),
            Audience::Present { .. } => Ok(()),
        }
    }

    /// As [`offer_once`](Self::offer_once), of a command: without readers it is not written, and after `within` it is dropped.
    ///
    /// # Errors
    /// [`Refusal`]: one sample was lost, this or an older one.
    pub fn offer_in_time(
        &mut self,
        payload: Payload,
        source: Option<Timestamp>,
        (now, within): (Instant, Duration),
    ) -> Result<(), Refusal> {
        if matches!(self.audience, Audience::Nobody { .. }) {
            self.notice_matches(now);
        }
        if matches!(self.audience, Audience::Nobody { .. }) {
            return Ok(());
        }
        self.offer_sample(
            Sample {
                payload,
                source,
                lasting: false,
                until: Some(now + within),
            },
            now,
        )
    }

    /// Returns the handover of the sample that was offered last.
    #[must_use]
    pub fn handover(&self) -> Handover {
        match self.audience {
            Audience::Nobody { .. } => Handover::Nobody,
            Audience::Present { .. } if self.waiting.is_empty() => Handover::Done,
            Audience::Present { .. } => Handover::Waiting,
        }
    }

    fn offer_sample(&mut self, sample: Sample, now: Instant) -> Result<(), Refusal> {
        if matches!(self.audience, Audience::Nobody { .. }) {
            self.notice_matches(now);
        }
        match &mut self.audience {
            Audience::Nobody { .. } if self.offered == Offered::KeepLatest => {
                return self.store(sample, now);
            }
            Audience::Nobody { .. } => {}
            Audience::Present { sample_size, .. } if sample.payload.len() > *sample_size => {
                return Err(Refusal::TooLarge(*sample_size));
            }
            Audience::Present { .. } => {}
        }
        if !self.is_settled(now) {
            let bytes: usize = self.waiting.iter().map(|s| s.payload.len()).sum();
            if self.waiting.len() < self.settling_room() && bytes < MAX_IN_FLIGHT {
                self.waiting.push_back(sample);
                return Ok(());
            }
            // Readers that have answered must not lose samples for one that says nothing.
            self.settle();
        }
        self.flush_waiting(now)?;
        if !self.waiting.is_empty() {
            return self.queue(sample, self.offered.waiting_room());
        }
        match self.write(sample, now)? {
            Some(unsent) => self.queue(unsent, self.offered.waiting_room()),
            None => Ok(()),
        }
    }

    /// Sends what waits, as far as there is room.
    ///
    /// # Errors
    /// [`Refusal::Failed`], with the sample lost.
    pub fn flush(&mut self, now: Instant) -> Result<(), Refusal> {
        self.flush_waiting(now)?;
        match std::mem::take(&mut self.has_late) {
            true => Err(Refusal::Late),
            false => Ok(()),
        }
    }

    fn flush_waiting(&mut self, now: Instant) -> Result<(), Refusal> {
        self.look_back(now);
        let before = self.waiting.len();
        let is_late = |sample: &Sample| sample.until.is_some_and(|until| until <= now);
        self.waiting.retain(|sample| !is_late(sample));
        self.has_late |= self.waiting.len() < before;
        if self.waiting.is_empty() || !self.is_settled(now) {
            return Ok(());
        }
        while let Some(sample) = self.waiting.pop_front() {
            if let Some(unsent) = self.write(sample, now)? {
                self.waiting.push_front(unsent);
                break;
            }
        }
        Ok(())
    }

    /// Takes note of the readers the domain has for this topic by now, and gives the first of them the value that was
    /// held back.
    ///
    /// # Errors
    /// [`Refusal`] of the value held back.
    pub fn set_readers(&mut self, readers: &[Endpoint], now: Instant) -> Result<(), Refusal> {
        // Statuses are read so that their channel never fills up; the snapshot is the newer knowledge.
        while self.writer.try_recv_status().is_some() {}
        self.former.retain(|former| !former.is_done(now));
        if readers.is_empty() {
            self.former.clear();
            if !matches!(self.audience, Audience::Nobody { .. }) {
                self.leave_alone(now);
            }
            return Ok(());
        }
        match self.greet(now, readers.len(), limits::sample_size(readers)) {
            // A volatile reader is not given what was written before it came.
            Some(held) if readers.iter().all(|reader| reader.transient_local) => {
                self.offer_sample(held, now)
            }
            Some(_) | None => Ok(()),
        }
    }

    /// Stores a state for readers that come, in place of the state before. An event is dropped, because no reader is present.
    fn store(&mut self, sample: Sample, now: Instant) -> Result<(), Refusal> {
        self.forget_written();
        self.to_forget = None;
        self.last = None;
        let mut rest = None;
        if sample.lasting {
            rest = match limits::PATCHED {
                true => self.write(sample, now)?,
                false => Some(sample),
            };
        }
        if let Audience::Nobody { held } = &mut self.audience {
            *held = rest;
        }
        Ok(())
    }

    /// Whether what is written now reaches the readers there are. Asked for the first time when there is something to
    /// write; readers that come later join a stream that waits for nobody.
    fn is_settled(&mut self, now: Instant) -> bool {
        self.former.retain(|former| !former.is_done(now));
        // What is repaired is older than what is written now.
        let repaired = self.former.is_empty();
        let Audience::Present { settling, seen, .. } = &mut self.audience else {
            return true;
        };
        settling.take_if(|settling| {
            repaired && settling.is_over(&self.writer, *seen, self.joined, now)
        });
        settling.is_none()
    }

    /// How many samples may wait for readers to learn of the writer. Of a state topic as many as go out at once then: an old
    /// value must not stand before a newer one.
    fn settling_room(&self) -> usize {
        match self.offered {
            Offered::KeepLatest => SETTLING_STATES,
            Offered::DropOldest(_) => SETTLING_EVENTS,
        }
    }

    fn settle(&mut self) {
        if let Audience::Present { settling, .. } = &mut self.audience {
            *settling = None;
        }
    }

    /// How many samples wait, which go with it.
    #[must_use]
    pub fn waiting(&self) -> u64 {
        u64::try_from(self.waiting.len()).unwrap_or(u64::MAX)
    }

    /// Nobody listens any more.
    fn leave_alone(&mut self, now: Instant) {
        let mut held = None;
        if self.offered == Offered::KeepLatest {
            held = self.waiting.drain(..).next_back();
        }
        self.audience = Audience::Nobody { held: None };
        if let Some(held) = held {
            // A writer that fails says so at the next value.
            let _stored = self.store(held, now);
        }
    }

    /// Whether the readers that are present have all that was written.
    fn is_acknowledged(&self) -> bool {
        #[cfg(feature = "patched-dds")]
        let acknowledged = self.writer.unacknowledged().samples == 0;
        #[cfg(not(feature = "patched-dds"))]
        let acknowledged = false;
        acknowledged
    }

    /// Takes back what was written, for a newer value that is not.
    fn forget_written(&self) {
        #[cfg(feature = "patched-dds")]
        self.writer.keep_last(0);
    }

    /// A reader may match between two snapshots; what comes after the match is for it.
    fn notice_matches(&mut self, now: Instant) {
        while let Some(status) = self.writer.try_recv_status() {
            if let DataWriterStatus::PublicationMatched { current, .. } = status
                && current.count() > 0
            {
                // The value held back is older than the one about to be written, which replaces it.
                drop(self.greet(now, 1, limits::TO_ANY));
            }
        }
    }

    /// Takes note of readers; returns the value that was held back from nobody.
    fn greet(&mut self, now: Instant, number: usize, size: usize) -> Option<Sample> {
        match &mut self.audience {
            Audience::Present {
                seen, sample_size, ..
            } => {
                (*seen, *sample_size) = (number, size);
                None
            }
            Audience::Nobody { held } => {
                let held = held.take();
                self.audience = Audience::Present {
                    settling: Some(Settling {
                        since: now,
                        patience: PATIENCE,
                    }),
                    seen: number,
                    sample_size: size,
                };
                held
            }
        }
    }

    fn queue(&mut self, sample: Sample, room: usize) -> Result<(), Refusal> {
        let overflow = self.waiting.len() >= room;
        if overflow {
            self.waiting.pop_front();
        }
        self.waiting.push_back(sample);
        if overflow {
            Err(Refusal::Overflow)
        } else {
            Ok(())
        }
    }

    /// Gives a sample to RustDDS; returns it when the send window is full.
    fn write(&mut self, sample: Sample, now: Instant) -> Result<Option<Sample>, Refusal> {
        let Sample {
            payload,
            source,
            lasting,
            until,
        } = sample;
        let size = payload.len();
        if !self.has_room(size) {
            self.full_since.get_or_insert(now);
            return Ok(Some(Sample {
                payload,
                source,
                lasting,
                until,
            }));
        }
        let is_state = self.offered == Offered::KeepLatest;
        let kept = (is_state && lasting).then(|| Sample {
            payload: payload.clone(),
            source,
            lasting,
            until,
        });
        let mut written = self.writer.write(payload, source);
        if let Err(WriteError::WouldBlock { data }) = written {
            written = if self.makes_room() {
                self.writer.write(data, source)
            } else {
                Err(WriteError::WouldBlock { data })
            };
        }
        match written {
            Ok(()) => {
                self.full_since = None;
                self.in_flight += size;
                // The newest sample pushes the one before out of the history.
                self.to_forget = (is_state && !lasting).then_some(now);
                self.last = kept;
                Ok(None)
            }
            Err(WriteError::WouldBlock { data }) => {
                self.full_since.get_or_insert(now);
                Ok(Some(Sample {
                    payload: data,
                    source,
                    lasting,
                    until,
                }))
            }
            Err(
                WriteError::Serialization { .. }
                | WriteError::Poisoned { .. }
                | WriteError::Io(_)
                | WriteError::Internal { .. },
            ) => Err(Refusal::Failed),
        }
    }

    /// Whether there is memory for another sample of that size, or some is made.
    #[cfg(feature = "patched-dds")]
    fn has_room(&mut self, size: usize) -> bool {
        while self.in_flight + size > MAX_IN_FLIGHT {
            let lacked = self.writer.unacknowledged().bytes;
            self.in_flight = lacked;
            if lacked > 0 && lacked + size > MAX_IN_FLIGHT && !self.makes_room() {
                return false;
            }
            if lacked == 0 {
                break;
            }
        }
        true
    }

    /// Whether there is memory for another sample of that size.
    #[cfg(not(feature = "patched-dds"))]
    fn has_room(&mut self, size: usize) -> bool {
        // Long before there is none: readers acknowledge one sample in several, so that now all may be acknowledged and at
        // the next sample not.
        if self.in_flight > MAX_IN_FLIGHT / 2 {
            // The answer is immediate with a wait of zero.
            match self.writer.wait_for_acknowledgments(Duration::ZERO) {
                Ok(true) => self.in_flight = 0,
                Ok(false) => return self.in_flight + size <= MAX_IN_FLIGHT,
                // Writing fails, too.
                Err(_) => {}
            }
        }
        true
    }

    /// Gives up the oldest value that a silent reader lacks, if it is a state's: the others must not see an old one because
    /// of it. One that is only slow says so again and again, and gets what it has begun to receive.
    fn makes_room(&self) -> bool {
        #[cfg(feature = "patched-dds")]
        if self.offered == Offered::KeepLatest {
            let lacked = self.writer.unacknowledged();
            let given_up = lacked.silent_for >= STUCK_AFTER || lacked.stalled_for >= SLOWEST;
            if lacked.samples > 0 && given_up {
                self.writer.keep_last(lacked.samples - 1);
                return true;
            }
        }
        false
    }
}

impl Former {
    /// Where every value counts and there may be somebody who lacks one. Of a state only the last value does, with which the
    /// next writer begins: an old one must not reach anybody beside it.
    fn of(writer: Writer, offered: Offered, in_flight: usize, now: Instant) -> Option<Self> {
        (matches!(offered, Offered::DropOldest(_)) && in_flight > 0).then(|| Self {
            writer,
            until: now + REPAIRED_WITHIN,
        })
    }

    /// Whether its readers have all of what it wrote, or have had the time to ask for it.
    #[must_use]
    pub fn is_done(&self, now: Instant) -> bool {
        // The answer is immediate with a wait of zero.
        let acknowledged = self.writer.wait_for_acknowledgments(Duration::ZERO);
        now >= self.until || !matches!(acknowledged, Ok(false))
    }
}

impl std::fmt::Debug for Former {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Former")
            .field("writer", &self.writer.guid())
            .finish_non_exhaustive()
    }
}

impl std::fmt::Debug for Outlet {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Outlet")
            .field("writer", &self.guid())
            .field("offered", &self.offered)
            .field("audience", &self.audience)
            .field("waiting", &self.waiting.len())
            .finish_non_exhaustive()
    }
}

impl Settling {
    /// Whether the readers get what is written now: those that acknowledge say so.
    #[cfg(feature = "patched-dds")]
    fn is_over(&self, writer: &Writer, seen: usize, joined: Instant, now: Instant) -> bool {
        let readers = writer.matched_readers();
        let age = now.saturating_duration_since(self.since);
        let told = readers.silent + readers.greeting == 0 && readers.in_step > 0;
        // Readers that were there before us are not all known yet when the first of them has answered, and those that were
        // seen may not have matched yet.
        let all = readers.in_step >= seen && now.saturating_duration_since(joined) >= SETTLE;
        let some = readers.in_step + readers.greeting + readers.best_effort > 0;
        told && readers.best_effort == 0 && all
            || some && readers.silent == 0 && age >= SETTLE
            || age >= self.patience
    }

    /// Whether the readers most likely get what is written now.
    #[cfg(not(feature = "patched-dds"))]
    fn is_over(&self, _writer: &Writer, _seen: usize, _joined: Instant, now: Instant) -> bool {
        now.saturating_duration_since(self.since) >= SETTLE.min(self.patience)
    }
}

/// How long peers take to learn of our writer after we learned of their reader: 30 to 190 ms measured.
const SETTLE: Duration = Duration::from_millis(250);
/// How long to wait for a first reader that has not said anything: what tells it of us may have been lost, and said again.
const PATIENCE: Duration = Duration::from_secs(3);
/// Samples that may wait for that, by what the topic carries.
const SETTLING_STATES: usize = 128;
const SETTLING_EVENTS: usize = 512;
/// How long a state topic may lag behind for the sake of one reader that says nothing. A reader that was killed, or lost its
/// radio link, holds up RustDDS' writer until its lease ends, 10 to 20 s later.
const STUCK_AFTER: Duration = Duration::from_millis(500);
/// How long it may lag behind for the sake of one that is heard, and takes nothing: its program may have no room for more.
#[cfg(feature = "patched-dds")]
const SLOWEST: Duration = Duration::from_secs(10);
/// How long a writer that was replaced stays for those that lack something. What it waits for is a repair or two; a reader
/// that was killed acknowledges nothing.
const REPAIRED_WITHIN: Duration = Duration::from_secs(1);
/// Writers of a topic that are kept so.
const MOST_FORMER: usize = 2;
/// Memory a topic may take for readers that do not acknowledge; the send window counts samples, whatever their size.
const MAX_IN_FLIGHT: usize = 64 * 1024 * 1024;
