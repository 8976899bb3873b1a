//! Acceptance of DataSetMessages by a DataSetReader, and the state of the reader (OPC 10000-14,
//! 6.2.9).

mod record;
mod verdict;

use std::time::Duration;

use crate::{
    ConfigurationVersion, DataSetHeader, DataSetMessage, GroupHeader, MessageKind, NetworkHeader,
    PubSubState, StateEvent, StateMachine, StateRefused, Timestamp,
};
use record::{Numbers, Record};
pub use verdict::{Accepted, ReaderCounters, ReaderDrop};

/// Decides by their headers which DataSetMessages of a DataSetWriter are accepted, and keeps the
/// state of the DataSetReader (OPC 10000-14, 6.2.1, 6.2.9 and 7.2.3).
///
/// Times are parameters that count from any fixed time.
///
/// # New messages
/// The DataSetMessageSequenceNumber identifies new messages, by the window of OPC 10000-14, 7.2.3.
/// Without it the SequenceNumber of the group header does, which does not reveal lost messages.
/// Without both, every message is new (6.2.9.6). A writer that changes from one number to the other
/// has a new configuration (7.2.4.5.4), so its numbers start over. A keep-alive carries the number
/// of the next message (7.2.4.5.8). A late message is dropped, or accepted once with
/// [`accept_late`](ReaderSettings::accept_late). A heartbeat is handled as any key frame.
///
/// # Restarted writers
/// The sequence numbers of a restarted writer look old or invalid. The writer is accepted again if
/// its Timestamp is later than the Timestamp of the newest message, or if no new message was
/// received for [`forget_after`](ReaderSettings::forget_after), which is twice the
/// MessageReceiveTimeout (7.2.3). After that time any sequence number is accepted.
///
/// # State
/// An enabled reader is PreOperational until the first key frame or event, then Operational (6.2.1,
/// Table 2). If no new message arrives for the MessageReceiveTimeout, the reader is in Error until
/// the next message. Then it is Operational again, or PreOperational if it needs a key frame first.
/// again, or PreOperational when a key frame is needed first.
/// ```
/// use std::time::Duration;
/// use uadp::{
///     Arrival, DataSetHeader, DataSetReaderState, MessageKind, PubSubState, ReaderDrop, ReaderSettings,
/// };
///
/// let settings = ReaderSettings {
///     message_receive_timeout: Duration::from_secs(1),
///     ..ReaderSettings::default()
/// };
/// let mut reader = DataSetReaderState::new(settings, PubSubState::Operational);
/// reader.enable(Duration::ZERO)?;
/// assert_eq!(reader.state(), PubSubState::PreOperational);
///
/// let message = |sequence_number, kind| Arrival {
///     header: DataSetHeader { sequence_number: Some(sequence_number), ..DataSetHeader::default() },
///     ..Arrival::of_kind(kind)
/// };
/// let at = Duration::from_millis;
/// let delta = reader.receive(&message(4, MessageKind::DeltaFrame), at(0));
/// assert_eq!(delta, Err(ReaderDrop::NeedsKeyFrame));
/// let accepted = reader.receive(&message(7, MessageKind::KeyFrame), at(10)).unwrap();
/// assert_eq!(accepted.missed, 2);
/// assert_eq!(reader.state(), PubSubState::Operational);
/// let again = reader.receive(&message(7, MessageKind::KeyFrame), at(20));
/// assert_eq!(again, Err(ReaderDrop::Duplicate));
///
/// assert_eq!(reader.poll_timeout(), Some(at(1010)));
/// reader.handle_timeout(at(1010));
/// assert_eq!(reader.state(), PubSubState::Error);
/// reader.receive(&message(8, MessageKind::KeepAlive), at(1500)).unwrap();
/// assert_eq!(reader.state(), PubSubState::Operational);
/// # Ok::<(), uadp::StateRefused>(())
/// ```
#[derive(Debug, Clone)]
pub struct DataSetReaderState {
    settings: ReaderSettings,
    machine: StateMachine,
    record: Option<Record>,
    /// Timestamp of the newest message with a Timestamp.
    stamp: Option<Timestamp>,
    /// Time of the last new message, including messages that were dropped for their content.
    new_at: Duration,
    /// Start of the MessageReceiveTimeout.
    alive_at: Duration,
    basis: Option<Basis>,
    mismatch: Option<Mismatch>,
    counters: ReaderCounters,
}

/// Settings of a [`DataSetReaderState`]. The default has no timeout and checks no versions.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub struct ReaderSettings {
    /// MessageReceiveTimeout (OPC 10000-14, 6.2.9.6). Zero disables the timeout.
    pub message_receive_timeout: Duration,
    /// ConfigurationVersion of the DataSetMetaData that decodes the messages; `None` if they are
    /// decoded without metadata (OPC 10000-14, 6.2.9.4).
    pub metadata: Option<ConfigurationVersion>,
    /// Expected GroupVersion of the group header (OPC 10000-14, 6.3.1.4.1).
    pub group_version: Option<u32>,
    /// Expected NetworkMessageNumber of the group header (OPC 10000-14, 6.3.1.4.2).
    pub network_message_number: Option<u16>,
    /// Accepts messages that arrive after newer messages, at most 64 behind. Use it for events,
    /// because no event should be lost. A late key frame or delta frame would replace new values
    /// with old values.
    pub accept_late: bool,
}

/// Header fields of a DataSetMessage that the reader uses.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Arrival {
    /// The group header.
    pub group: GroupHeader,
    /// Index of the DataSetMessage in its NetworkMessage.
    pub position: usize,
    /// Timestamp of the DataSetMessage, or else of the NetworkMessage.
    pub timestamp: Option<Timestamp>,
    /// The header of the DataSetMessage.
    pub header: DataSetHeader,
    /// Kind of the payload.
    pub kind: MessageKind,
}

/// Values that delta frames apply to.
#[derive(Debug, Clone, Copy)]
struct Basis {
    /// Major version of the key frame.
    major_version: Option<u32>,
    /// No message was missed after the key frame.
    complete: bool,
}

/// Messages arrive that need other metadata.
#[derive(Debug, Clone, Copy)]
struct Mismatch {
    major_version: u32,
    since: Duration,
}

impl ReaderSettings {
    /// Returns the time without new messages after which the writer counts as restarted: twice the
    /// MessageReceiveTimeout (OPC 10000-14, 7.2.3), or 10 s without timeout.
    #[must_use]
    pub const fn forget_after(&self) -> Duration {
        match self.message_receive_timeout {
            Duration::ZERO => Duration::from_secs(10),
            timeout => timeout.saturating_mul(2),
        }
    }
}

impl Arrival {
    /// Returns the header fields of `message` at `position` of the NetworkMessage.
    #[must_use]
    pub fn of(network: &NetworkHeader<'_>, position: usize, message: &DataSetMessage<'_>) -> Self {
        let stamp = |time, picoseconds: Option<u16>| Timestamp {
            time,
            picoseconds: picoseconds.unwrap_or_default(),
        };
        let header = message.header();
        let own = header.timestamp.map(|time| stamp(time, header.picoseconds));
        let network_stamp = network
            .timestamp
            .map(|time| stamp(time, network.picoseconds));
        Self {
            group: network.group.unwrap_or_default(),
            position,
            timestamp: own.or(network_stamp),
            header,
            kind: message.kind,
        }
    }

    /// Returns a message without header fields.
    #[must_use]
    pub fn of_kind(kind: MessageKind) -> Self {
        Self {
            group: GroupHeader::default(),
            position: 0,
            timestamp: None,
            header: DataSetHeader::default(),
            kind,
        }
    }
}

impl DataSetReaderState {
    /// Creates a reader in Disabled, below a ReaderGroup in the given state.
    #[must_use]
    pub const fn new(settings: ReaderSettings, parent: PubSubState) -> Self {
        Self {
            settings,
            machine: StateMachine::new(parent),
            record: None,
            stamp: None,
            new_at: Duration::ZERO,
            alive_at: Duration::ZERO,
            basis: None,
            mismatch: None,
            counters: ReaderCounters::NONE,
        }
    }

    /// Decides whether a message is accepted. Accepted messages have to be processed, keep-alives
    /// as a sign of life.
    ///
    /// # Errors
    /// [`ReaderDrop`] if the message has to be dropped.
    pub fn receive(&mut self, arrival: &Arrival, now: Duration) -> Result<Accepted, ReaderDrop> {
        self.handle_timeout(now);
        let verdict = self.judge(arrival, now);
        match &verdict {
            Ok(accepted) => self.counters.accepted(accepted, arrival.kind),
            Err(reason) => self.counters.dropped(*reason),
        }
        verdict
    }

    /// Checks the MessageReceiveTimeout. Returns true if the state changed to Error.
    pub fn handle_timeout(&mut self, now: Duration) -> bool {
        let failed = self.poll_timeout().is_some_and(|at| now >= at)
            && self.machine.settle(StateEvent::Fail);
        if failed {
            self.counters.timeouts += 1;
        }
        failed
    }

    /// Returns the time of the next [`handle_timeout`](Self::handle_timeout).
    #[must_use]
    pub fn poll_timeout(&self) -> Option<Duration> {
        let timeout = self.settings.message_receive_timeout;
        if timeout.is_zero() {
            return None;
        }
        let since = match self.machine.state() {
            PubSubState::Operational => Some(self.alive_at),
            PubSubState::PreOperational => self.mismatch.map(|mismatch| mismatch.since),
            PubSubState::Disabled | PubSubState::Paused | PubSubState::Error => None,
        };
        since.map(|since| since.saturating_add(timeout))
    }

    /// Enables the reader, and returns the new state.
    ///
    /// # Errors
    /// [`StateRefused`] if the reader is enabled already.
    pub fn enable(&mut self, now: Duration) -> Result<PubSubState, StateRefused> {
        let before = self.machine.state();
        let state = self.machine.enable()?;
        self.start_if_active(before, now);
        Ok(state)
    }

    /// Disables the reader. Its information about the writer is dropped when it is enabled again.
    ///
    /// # Errors
    /// [`StateRefused`] if the reader is disabled already.
    pub const fn disable(&mut self) -> Result<PubSubState, StateRefused> {
        self.machine.disable()
    }

    /// Sets the state of the ReaderGroup, and returns the resulting state of the reader.
    pub fn set_parent(&mut self, parent: PubSubState, now: Duration) -> PubSubState {
        let before = self.machine.state();
        self.machine.set_parent(parent);
        self.start_if_active(before, now);
        self.machine.state()
    }

    /// Sets the metadata version. Delta frames are dropped until the next key frame.
    pub fn set_metadata(&mut self, metadata: Option<ConfigurationVersion>) {
        self.settings.metadata = metadata;
        self.mismatch = None;
        self.basis = None;
    }

    /// Returns the major version of the missing metadata, for which messages are dropped.
    #[must_use]
    pub fn metadata_needed(&self) -> Option<u32> {
        self.mismatch.map(|mismatch| mismatch.major_version)
    }

    /// Returns the state of the DataSetReader.
    #[must_use]
    pub const fn state(&self) -> PubSubState {
        self.machine.state()
    }

    /// Returns the settings.
    #[must_use]
    pub const fn settings(&self) -> &ReaderSettings {
        &self.settings
    }

    /// Returns the counters of messages.
    #[must_use]
    pub const fn counters(&self) -> &ReaderCounters {
        &self.counters
    }

    /// Returns the time of the last new message, including keep-alives. Before the first message it
    /// is the time at which the reader became active.
    #[must_use]
    pub const fn heard_at(&self) -> Duration {
        self.new_at
    }

    fn judge(&mut self, arrival: &Arrival, now: Duration) -> Result<Accepted, ReaderDrop> {
        if !self.machine.state().is_active() {
            return Err(ReaderDrop::Inactive);
        }
        if !arrival.header.valid {
            return Err(ReaderDrop::Invalid);
        }
        self.check_layout(&arrival.group)?;
        let mut accepted = self.place(arrival, now)?;
        self.new_at = now;
        if !accepted.late {
            self.stamp = arrival.timestamp.or(self.stamp);
        }
        self.counters.placed(&accepted);
        accepted.minor_version = self.check_version(&arrival.header, now)?;
        let needs_key_frame = self.rebase(arrival, accepted);
        self.revive(arrival.kind, now);
        if needs_key_frame {
            return Err(ReaderDrop::NeedsKeyFrame);
        }
        accepted.incomplete = arrival.kind == MessageKind::DeltaFrame
            && self.basis.is_some_and(|basis| !basis.complete);
        Ok(accepted)
    }

    fn check_layout(&self, group: &GroupHeader) -> Result<(), ReaderDrop> {
        let found = group.group_version;
        if let Some(expected) = self.settings.group_version
            && found != Some(expected)
        {
            return Err(ReaderDrop::GroupVersion { expected, found });
        }
        let found = group.network_message_number;
        if let Some(expected) = self.settings.network_message_number
            && found != Some(expected)
        {
            return Err(ReaderDrop::NetworkMessageNumber { expected, found });
        }
        Ok(())
    }

    /// Places the message in the sequence and records it.
    fn place(&mut self, arrival: &Arrival, now: Duration) -> Result<Accepted, ReaderDrop> {
        let Some((of, number)) = Numbers::of(arrival) else {
            return Ok(Accepted::default());
        };
        let silent = now.saturating_sub(self.new_at) >= self.settings.forget_after();
        if silent && !self.settings.message_receive_timeout.is_zero() {
            self.forget();
        }
        let Some(record) = self.record.filter(|record| record.of == of) else {
            self.record = Some(Record::first(of, number, arrival));
            return Ok(Accepted::default());
        };
        let placed = record.place(number, arrival, self.settings.accept_late);
        let is_behind = placed.as_ref().map_or(true, |(_, accepted)| accepted.late);
        if is_behind && (silent || self.is_later(arrival.timestamp)) {
            self.forget();
            self.record = Some(Record::first(of, number, arrival));
            return Ok(Accepted {
                restarted: true,
                ..Accepted::default()
            });
        }
        let (record, accepted) = placed?;
        self.record = Some(record);
        Ok(accepted)
    }

    /// Returns true if a message is later than the newest message. A Timestamp of 0 counts as
    /// missing.
    fn is_later(&self, stamp: Option<Timestamp>) -> bool {
        matches!((stamp, self.stamp), (Some(new), Some(last)) if last.time.0 != 0 && new > last)
    }

    /// Drops the information about the writer, which may have restarted.
    const fn forget(&mut self) {
        self.record = None;
        self.stamp = None;
        self.basis = None;
    }

    /// Checks the version. Returns the minor version if it differs.
    fn check_version(
        &mut self,
        header: &DataSetHeader,
        now: Duration,
    ) -> Result<Option<u32>, ReaderDrop> {
        let Some(metadata) = self.settings.metadata else {
            return Ok(None);
        };
        let expected = metadata.major;
        if let Some(found) = header.major_version
            && found != expected
        {
            let since = match self.mismatch {
                Some(mismatch) => mismatch.since,
                None => {
                    self.alive_at = now;
                    now
                }
            };
            self.mismatch = Some(Mismatch {
                major_version: found,
                since,
            });
            return Err(ReaderDrop::MajorVersion { expected, found });
        }
        self.mismatch = None;
        Ok(header
            .minor_version
            .filter(|found| *found != metadata.minor))
    }

    /// Updates the base of delta frames. Returns true for a delta frame without base.
    fn rebase(&mut self, arrival: &Arrival, accepted: Accepted) -> bool {
        if accepted.missed > 0
            && let Some(basis) = &mut self.basis
        {
            basis.complete = false;
        }
        let major_version = arrival.header.major_version;
        match (arrival.kind, self.basis) {
            (MessageKind::KeyFrame | MessageKind::Event, basis) => {
                let complete = !accepted.late || basis.is_some_and(|basis| basis.complete);
                self.basis = Some(Basis {
                    major_version,
                    complete,
                });
                false
            }
            (MessageKind::DeltaFrame, Some(basis)) => basis.major_version != major_version,
            (MessageKind::DeltaFrame, None) => true,
            (MessageKind::KeepAlive, _) => false,
        }
    }

    /// Updates the state after a new message.
    fn revive(&mut self, kind: MessageKind, now: Duration) {
        self.alive_at = now;
        let event = match (self.machine.state(), kind, self.basis) {
            (PubSubState::PreOperational, MessageKind::KeyFrame | MessageKind::Event, _) => {
                StateEvent::Ready
            }
            (PubSubState::Error, _, Some(_)) => StateEvent::Resolve,
            (PubSubState::Error, _, None) => StateEvent::Restart,
            _ => return,
        };
        self.machine.settle(event);
    }

    fn start_if_active(&mut self, before: PubSubState, now: Duration) {
        if !before.is_active() && self.machine.state().is_active() {
            self.forget();
            self.mismatch = None;
            self.new_at = now;
            self.alive_at = now;
        }
    }
}
