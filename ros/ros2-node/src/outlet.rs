//! A writer that never waits.
//!
//! RustDDS stops a reliable writer while its send window is full ([`Offered::policies`]). Refused
//! samples then wait in a queue until the window opens; the topic's overflow policy sets the length
//! of the queue.
//!
//! Samples also wait from the discovery of the first reader until it has responded: the reader is
//! known here before our writer is known there. Samples written in between are history, which a
//! volatile reader does not receive.

mod audience;
mod former;
mod outcome;
mod settling;
mod unreceived;
mod waiting;

use std::collections::VecDeque;
use std::time::Duration;

use rustdds::dds::WriteError;
use rustdds::{DataWriterStatus, GUID, StatusEvented, Timestamp};
use tokio::time::Instant;

use self::audience::TopicReaders;
pub use self::former::Former;
pub use self::outcome::{OutletProgress, OutletRefusal};
use self::settling::{PATIENCE, SETTLE, Settling};
use self::unreceived::UnreceivedSamples;
use self::waiting::{UnsentSamples, WaitingSample};
use crate::graph::RemoteEndpoint;
use crate::limits;
use crate::qos::Offered;
use crate::raw::{Payload, PayloadWriter};

/// The writing end of a topic.
pub struct Outlet {
    writer: PayloadWriter,
    offered: Offered,
    joined: Instant,
    audience: TopicReaders,
    /// Samples for which the send window had no room.
    waiting: UnsentSamples,
    /// The time since when the send window has no room.
    full_since: Option<Instant>,
    /// Bytes written after the last time that every reader had acknowledged everything.
    in_flight: usize,
    /// For a state topic, the value that its readers have: another writer has to start with it.
    last: Option<WaitingSample>,
    /// The time since when the writer's history holds a sample that no late reader may receive.
    /// Cleared once the present readers have the sample.
    to_forget: Option<Instant>,
    /// Replaced writers, oldest first, while their readers may miss some of their samples.
    former: VecDeque<Former>,
    /// The samples that readers have not acknowledged while a link is lost.
    unreceived: UnreceivedSamples,
}

impl Outlet {
    /// Wraps a writer created with the policies of `offered` in a domain joined at `joined`
    /// ([`Domain::joined`](crate::domain::Domain::joined)).
    #[must_use]
    pub fn new(writer: PayloadWriter, offered: Offered, joined: Instant) -> Self {
        Self {
            writer,
            offered,
            joined,
            audience: TopicReaders::Nobody { held: None },
            waiting: UnsentSamples::default(),
            full_since: None,
            in_flight: 0,
            last: None,
            to_forget: None,
            former: VecDeque::new(),
            unreceived: UnreceivedSamples::default(),
        }
    }

    /// Returns whether another writer should take over ([`replace_writer`](Self::replace_writer)):
    /// a reader of a state topic has not acknowledged for so long that the other readers see an old
    /// value. Event topics wait instead. The patched RustDDS continues without a silent reader, and
    /// serves a slow reader.
    #[must_use]
    pub fn is_stuck(&self, now: Instant) -> bool {
        !limits::PATCHED
            && self.offered == Offered::KeepLatest
            && self
                .full_since
                .is_some_and(|since| now.duration_since(since) >= STUCK_AFTER)
    }

    /// Installs a new writer of the same topic and policies. Waiting samples are written once its
    /// readers know it.
    pub fn replace_writer(&mut self, writer: PayloadWriter, now: Instant) {
        // Without the full wait for the reader that caused the replacement.
        let patience = if self.is_stuck(now) { SETTLE } else { PATIENCE };
        let before = std::mem::replace(&mut self.writer, writer);
        self.full_since = None;
        let in_flight = std::mem::take(&mut self.in_flight);
        self.former
            .extend(Former::of(before, self.offered, in_flight, now));
        if self.former.len() > MOST_FORMER {
            self.former.pop_front();
        }
        // A held value is newer than the last written value.
        let is_held = matches!(self.audience, TopicReaders::Nobody { held: Some(_) });
        if let Some(last) = &self.last
            && self.waiting.is_empty()
            && !is_held
        {
            self.waiting.push(last.clone());
        }
        if let TopicReaders::Present { settling, .. } = &mut self.audience {
            *settling = Some(Settling {
                since: now,
                patience,
            });
        }
    }

    /// Gives the topic up and drops waiting samples; returns the writer if its readers may miss
    /// written samples.
    pub fn give_up(self, now: Instant) -> Option<Former> {
        Former::of(self.writer, self.offered, self.in_flight, now)
    }

    /// Returns the GUID of the writer.
    #[must_use]
    pub fn guid(&self) -> GUID {
        self.writer.guid()
    }

    /// Returns whether samples wait for room or for removal; [`flush`](Self::flush) handles both.
    #[must_use]
    pub fn is_waiting(&self) -> bool {
        !self.waiting.is_empty() || self.to_forget.is_some()
    }

    /// Returns whether late readers receive a value that is not older than `source`.
    #[must_use]
    pub fn stores_newer_than(&self, source: Option<Timestamp>) -> bool {
        let held = match &self.audience {
            TopicReaders::Nobody { held } => held.as_ref(),
            TopicReaders::Present { .. } => None,
        };
        held.or(self.last.as_ref())
            .is_some_and(|stored| stored.source >= source)
    }

    /// Removes the written values from the history. Present readers still receive them, late
    /// readers do not.
    pub fn forget_stored(&mut self, now: Instant) {
        if let TopicReaders::Nobody { held } = &mut self.audience {
            *held = None;
        }
        self.waiting.forget();
        if self.last.take().is_some() {
            self.to_forget = Some(now);
        }
        self.look_back(now);
    }

    /// Clears the history of samples that late readers must not receive, once the present readers
    /// have acknowledged them or had the time to do so.
    fn look_back(&mut self, now: Instant) {
        let Some(since) = self.to_forget else {
            return;
        };
        if now.saturating_duration_since(since) >= STUCK_AFTER || self.is_acknowledged() {
            self.forget_written();
            self.to_forget = None;
        }
    }

    /// Returns whether a replaced writer is still kept; [`set_readers`](Self::set_readers) drops
    /// it.
    #[must_use]
    pub fn is_repairing(&self) -> bool {
        !self.former.is_empty()
    }

    /// Writes a sample, or queues it. Never waits. On a state topic, late readers receive it too.
    ///
    /// # Errors
    /// [`OutletRefusal`]: one sample was lost, this sample or an older sample.
    pub fn offer(
        &mut self,
        payload: Payload,
        source: Option<Timestamp>,
        now: Instant,
    ) -> Result<(), OutletRefusal> {
        let lasting = self.offered == Offered::KeepLatest;
        self.offer_sample(
            WaitingSample {
                payload,
                source,
                lasting,
                until: None,
            },
            now,
        )
    }

    /// Offers an event as [`offer`](Self::offer) does: only the present readers receive it.
    ///
    /// # Errors
    /// [`OutletRefusal`]: one sample was lost, this sample or an older sample;
    /// [`OutletRefusal::NoReader`] without a present reader.
    pub fn offer_once(
        &mut self,
        payload: Payload,
        source: Option<Timestamp>,
        now: Instant,
    ) -> Result<(), OutletRefusal> {
        self.offer_sample(
            WaitingSample {
                payload,
                source,
                lasting: false,
                until: None,
            },
            now,
        )?;
        match self.audience {
            TopicReaders::Nobody { .. } => Err(OutletRefusal::NoReader),
            TopicReaders::Present { .. } => Ok(()),
        }
    }

    /// Offers a command as [`offer_once`](Self::offer_once) does: it is not written without
    /// readers, and is dropped after `within`.
    ///
    /// # Errors
    /// [`OutletRefusal`]: one sample was lost, this sample or an older sample.
    pub fn offer_in_time(
        &mut self,
        payload: Payload,
        source: Option<Timestamp>,
        (now, within): (Instant, Duration),
    ) -> Result<(), OutletRefusal> {
        if matches!(self.audience, TopicReaders::Nobody { .. }) {
            self.notice_matches(now);
        }
        if matches!(self.audience, TopicReaders::Nobody { .. }) {
            return Ok(());
        }
        self.offer_sample(
            WaitingSample {
                payload,
                source,
                lasting: false,
                until: Some(now + within),
            },
            now,
        )
    }

    /// Returns the progress of the samples that were offered.
    #[must_use]
    pub fn progress(&self) -> OutletProgress {
        match self.audience {
            TopicReaders::Nobody { .. } => OutletProgress::NoReader,
            TopicReaders::Present { .. } if self.waiting.is_empty() && !self.is_uncertain() => {
                OutletProgress::Written
            }
            TopicReaders::Present { .. } => OutletProgress::Waiting,
        }
    }

    /// Returns whether a reader out of reach may have missed the last sample.
    fn is_uncertain(&self) -> bool {
        let is_followed = self.unreceived.is_followed();
        self.unreceived.is_dropped() || (is_followed && !self.is_acknowledged())
    }

    fn offer_sample(&mut self, sample: WaitingSample, now: Instant) -> Result<(), OutletRefusal> {
        if matches!(self.audience, TopicReaders::Nobody { .. }) {
            self.notice_matches(now);
        }
        match &mut self.audience {
            TopicReaders::Nobody { .. } if self.offered == Offered::KeepLatest => {
                return self.store(sample, now);
            }
            TopicReaders::Nobody { .. } => {}
            TopicReaders::Present { sample_size, .. } if sample.payload.len() > *sample_size => {
                return Err(OutletRefusal::TooLarge(*sample_size));
            }
            TopicReaders::Present { .. } => {}
        }
        if !self.is_settled(now) {
            if self.waiting.len() < self.settling_room() && self.waiting.bytes() < MAX_IN_FLIGHT {
                self.waiting.push(sample);
                return Ok(());
            }
            // Readers that have responded must not lose samples because of a silent reader.
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

    /// Sends the waiting samples as the send window allows.
    ///
    /// # Errors
    /// [`OutletRefusal::Failed`], with the sample lost, or [`OutletRefusal::Late`] if a waiting
    /// sample has expired.
    pub fn flush(&mut self, now: Instant) -> Result<(), OutletRefusal> {
        self.flush_waiting(now)?;
        if self.waiting.take_late() {
            return Err(OutletRefusal::Late);
        }
        Ok(())
    }

    fn flush_waiting(&mut self, now: Instant) -> Result<(), OutletRefusal> {
        self.look_back(now);
        self.waiting.drop_expired(now);
        if self.waiting.is_empty() || !self.is_settled(now) {
            return Ok(());
        }
        while let Some(sample) = self.waiting.pop() {
            if let Some(unsent) = self.write(sample, now)? {
                self.waiting.put_back(unsent);
                break;
            }
        }
        Ok(())
    }

    /// Updates the readers of the topic, and sends the held value to the first readers.
    ///
    /// # Errors
    /// [`OutletRefusal`] of the held value.
    pub fn set_readers(
        &mut self,
        readers: &[RemoteEndpoint],
        now: Instant,
    ) -> Result<(), OutletRefusal> {
        // Statuses are read so that their channel never fills up; the snapshot is newer.
        while self.writer.try_recv_status().is_some() {}
        self.former.retain(|former| !former.is_done(now));
        if readers.is_empty() {
            self.former.clear();
            if !matches!(self.audience, TopicReaders::Nobody { .. }) {
                self.leave_alone(now);
            }
            return Ok(());
        }
        match self.greet(now, readers.len(), limits::sample_size(readers)) {
            // A volatile reader does not receive values written before it appeared.
            Some(held) if readers.iter().all(|reader| reader.transient_local) => {
                self.offer_sample(held, now)
            }
            Some(_) | None => Ok(()),
        }
    }

    /// Stores a state for later readers, in place of the former state. An event is dropped, because
    /// no reader is present.
    fn store(&mut self, sample: WaitingSample, now: Instant) -> Result<(), OutletRefusal> {
        self.forget_written();
        self.to_forget = None;
        self.last = None;
        let mut rest = None;
        if sample.lasting {
            rest = if limits::PATCHED {
                self.write(sample, now)?
            } else {
                Some(sample)
            };
        }
        if let TopicReaders::Nobody { held } = &mut self.audience {
            *held = rest;
        }
        Ok(())
    }

    /// Returns whether written samples reach the present readers. The wait is checked only when
    /// there is a sample to write; later readers join a stream that does not wait.
    fn is_settled(&mut self, now: Instant) -> bool {
        self.former.retain(|former| !former.is_done(now));
        // Repaired samples are older than new samples.
        let repaired = self.former.is_empty();
        let TopicReaders::Present { settling, seen, .. } = &mut self.audience else {
            return true;
        };
        settling.take_if(|settling| {
            repaired && settling.is_over(&self.writer, *seen, self.joined, now)
        });
        settling.is_none()
    }

    /// Returns how many samples may wait for readers to discover the writer. The number for a state
    /// topic fits the send window, so that all samples are sent at once and no old value stays
    /// visible before a newer value.
    fn settling_room(&self) -> usize {
        match self.offered {
            Offered::KeepLatest => SETTLING_STATES,
            Offered::DropOldest(_) => SETTLING_EVENTS,
        }
    }

    fn settle(&mut self) {
        if let TopicReaders::Present { settling, .. } = &mut self.audience {
            *settling = None;
        }
    }

    /// Returns the number of waiting samples, which are lost with the outlet.
    #[must_use]
    pub fn waiting(&self) -> u64 {
        u64::try_from(self.waiting.len()).unwrap_or(u64::MAX)
    }

    /// Drops the waiting samples and returns their number, and removes the written values from the
    /// history: with `at_once` also for present readers that have not acknowledged them.
    pub fn drop_waiting(&mut self, at_once: bool, now: Instant) -> u64 {
        let count = self.waiting();
        self.waiting.clear();
        self.forget_stored(now);
        if at_once {
            self.forget_written();
            self.to_forget = None;
        }
        count
    }

    /// Drops the events that readers have not acknowledged for 0.3 s, and returns their number: DDS
    /// would repeat them to readers out of reach when these are within reach again. To be called
    /// repeatedly while a link is lost (`is_lost`), and once when it is back.
    pub fn drop_unreceived_events(&mut self, is_lost: bool, now: Instant) -> u64 {
        if self.offered == Offered::KeepLatest {
            return 0;
        }
        let dropped = self.unreceived.look(self.unacknowledged(), now);
        if let Some(dropped) = dropped {
            self.keep_last(dropped.kept);
        }
        if !is_lost {
            self.unreceived.end();
        }
        dropped.map_or(0, |dropped| {
            u64::try_from(dropped.count).unwrap_or(u64::MAX)
        })
    }

    /// Returns the number of samples that present readers have not acknowledged, and for how long
    /// the last of these readers was silent; 0 with the published RustDDS.
    fn unacknowledged(&self) -> (usize, Duration) {
        #[cfg(feature = "patched-dds")]
        let lacked = {
            let lacked = self.writer.unacknowledged();
            (lacked.samples, lacked.silent_for)
        };
        #[cfg(not(feature = "patched-dds"))]
        let lacked = (0, Duration::ZERO);
        lacked
    }

    /// Handles the loss of the last reader.
    fn leave_alone(&mut self, now: Instant) {
        let mut held = None;
        if self.offered == Offered::KeepLatest {
            held = self.waiting.take_newest();
        }
        self.audience = TopicReaders::Nobody { held: None };
        if let Some(held) = held {
            // A writer that fails reports it at the next value.
            let _stored = self.store(held, now);
        }
    }

    /// Returns whether the present readers have acknowledged all written samples; always false with
    /// the published RustDDS.
    fn is_acknowledged(&self) -> bool {
        cfg!(feature = "patched-dds") && self.unacknowledged().0 == 0
    }

    /// Removes the written samples from the history. Does nothing with the published RustDDS.
    fn forget_written(&self) {
        self.keep_last(0);
    }

    /// Removes the written samples from the history but the last ones. Does nothing with the
    /// published RustDDS.
    fn keep_last(&self, samples: usize) {
        #[cfg(feature = "patched-dds")]
        self.writer.keep_last(samples);
        #[cfg(not(feature = "patched-dds"))]
        let _unpatched = samples;
    }

    /// Handles matches between two snapshots: samples written after a match are for the matched
    /// reader.
    fn notice_matches(&mut self, now: Instant) {
        while let Some(status) = self.writer.try_recv_status() {
            if let DataWriterStatus::PublicationMatched { current, .. } = status
                && current.count() > 0
            {
                // The new value replaces the older held value.
                drop(self.greet(now, 1, limits::TO_ANY));
            }
        }
    }

    /// Records the readers; returns the value that was held while there was no reader.
    fn greet(&mut self, now: Instant, number: usize, size: usize) -> Option<WaitingSample> {
        match &mut self.audience {
            TopicReaders::Present {
                seen, sample_size, ..
            } => {
                (*seen, *sample_size) = (number, size);
                None
            }
            TopicReaders::Nobody { held } => {
                let held = held.take();
                self.audience = TopicReaders::Present {
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

    fn queue(&mut self, sample: WaitingSample, room: usize) -> Result<(), OutletRefusal> {
        let overflow = self.waiting.len() >= room;
        if overflow {
            self.waiting.pop();
        }
        self.waiting.push(sample);
        if overflow {
            Err(OutletRefusal::Overflow)
        } else {
            Ok(())
        }
    }

    /// Passes a sample to RustDDS; returns it if the send window is full.
    fn write(
        &mut self,
        sample: WaitingSample,
        now: Instant,
    ) -> Result<Option<WaitingSample>, OutletRefusal> {
        let WaitingSample {
            payload,
            source,
            lasting,
            until,
        } = sample;
        let size = payload.len();
        if !self.has_room(size) {
            self.full_since.get_or_insert(now);
            return Ok(Some(WaitingSample {
                payload,
                source,
                lasting,
                until,
            }));
        }
        let is_state = self.offered == Offered::KeepLatest;
        let kept = (is_state && lasting).then(|| WaitingSample {
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
                self.unreceived.wrote();
                // The newest sample removes the former sample from the history.
                self.to_forget = (is_state && !lasting).then_some(now);
                self.last = kept;
                Ok(None)
            }
            Err(WriteError::WouldBlock { data }) => {
                self.full_since.get_or_insert(now);
                Ok(Some(WaitingSample {
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
            ) => Err(OutletRefusal::Failed),
        }
    }

    /// Returns whether there is memory for another sample of the size, if necessary after making
    /// room.
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

    /// Returns whether there is memory for another sample of the size.
    #[cfg(not(feature = "patched-dds"))]
    fn has_room(&mut self, size: usize) -> bool {
        // Checked long before the limit: readers acknowledge several samples at once, so the writer
        // may find all samples acknowledged now and not at the next sample.
        if self.in_flight > MAX_IN_FLIGHT / 2 {
            // A wait of zero returns immediately.
            match self.writer.wait_for_acknowledgments(Duration::ZERO) {
                Ok(true) => self.in_flight = 0,
                Ok(false) => return self.in_flight + size <= MAX_IN_FLIGHT,
                // The write fails, too.
                Err(_) => {}
            }
        }
        true
    }

    /// Gives up the oldest state value that a silent reader misses, so that the other readers do
    /// not see an old value. A slow reader acknowledges repeatedly, and receives the sample it has
    /// begun to receive.
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

/// Samples that may wait during that time, for state topics and event topics.
const SETTLING_STATES: usize = 128;
const SETTLING_EVENTS: usize = 512;
/// How long a state topic may lag because of one silent reader. A reader that was killed or lost
/// its radio link blocks RustDDS's writer until its lease expires, 10 to 20 s later.
const STUCK_AFTER: Duration = Duration::from_millis(500);
/// How long a state topic may lag because of a reader that responds but accepts no sample: its
/// process may have no room.
#[cfg(feature = "patched-dds")]
const SLOWEST: Duration = Duration::from_secs(10);
/// Maximum number of replaced writers of a topic.
const MOST_FORMER: usize = 2;
/// Memory limit of a topic for readers that do not acknowledge; the send window counts samples of
/// any size.
const MAX_IN_FLIGHT: usize = 64 * 1024 * 1024;
