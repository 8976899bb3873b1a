//! Schedule and state of a DataSetWriter (OPC 10000-14, 6.2.4 and 6.2.6).

use std::time::Duration;

use crate::{
    ConfigurationVersion, DataSetHeader, MessageKind, PubSubState, SequenceCounter, StateEvent,
    StateMachine, StateRefused,
};

/// Numbers the DataSetMessages of a DataSetWriter, schedules their kinds, and keeps the state of
/// the writer (OPC 10000-14, 6.2.1, 6.2.4.3, 6.2.6.2 and 6.2.6.3).
///
/// Times are parameters that count from any fixed time. The caller calls [`poll`](Self::poll) at
/// [`poll_timeout`](Self::poll_timeout), and for event writers also when there is an event. It
/// encodes the returned kind with the numbers of [`header`](Self::header), sends the message, and
/// calls [`sent`](Self::sent).
/// ```
/// use std::time::Duration;
/// use uadp::{DataSetWriterState, MessageKind, PubSubState, WriterSettings};
///
/// let at = Duration::from_millis;
/// let settings = WriterSettings::new(at(100), at(300), 3)?; // a key frame, then two delta frames
/// let mut writer = DataSetWriterState::new(settings, PubSubState::Operational);
/// writer.enable()?;
/// writer.ready(at(0))?;
///
/// let mut sent = Vec::new();
/// for (now, changed) in [(0, true), (100, true), (200, false), (300, false), (400, true)] {
///     if let Some(kind) = writer.poll(at(now), changed) {
///         sent.push((now, kind, writer.header().sequence_number));
///         writer.sent(kind, at(now));
///     }
/// }
/// assert_eq!(sent, [
///     (0, MessageKind::KeyFrame, Some(0)),
///     (100, MessageKind::DeltaFrame, Some(1)),
///     (300, MessageKind::KeyFrame, Some(2)),
///     (400, MessageKind::DeltaFrame, Some(3)),
/// ]);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug, Clone)]
pub struct DataSetWriterState {
    settings: WriterSettings,
    machine: StateMachine,
    sequence: SequenceCounter,
    version: ConfigurationVersion,
    /// The metadata changed and was not announced yet.
    unannounced: bool,
    /// Start of the next PublishingInterval.
    next_interval: Duration,
    /// Number of PublishingIntervals after the last key frame; `None` if a key frame is due.
    intervals: Option<u32>,
    /// Time of the last DataSetMessage, or at which a keep-alive was last due.
    spoken_at: Duration,
}

/// Timing parameters of a DataSetWriter and its WriterGroup.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct WriterSettings {
    publishing_interval: Duration,
    keep_alive_time: Duration,
    key_frame_count: u32,
}

/// Combination of parameters that the standard does not permit.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum WriterSettingsError {
    /// KeepAliveTime is zero or below the PublishingInterval (OPC 10000-14, 6.2.6.3).
    #[error("KeepAliveTime {keep_alive_time:?} below PublishingInterval {publishing_interval:?}")]
    KeepAliveTime {
        /// The KeepAliveTime.
        keep_alive_time: Duration,
        /// The PublishingInterval.
        publishing_interval: Duration,
    },
    /// A KeyFrameCount needs a PublishingInterval to count (OPC 10000-14, 6.2.6.2).
    #[error("KeyFrameCount {0} without PublishingInterval")]
    KeyFrameCount(u32),
}

impl WriterSettings {
    /// Creates settings from PublishingInterval, KeepAliveTime and KeyFrameCount. A KeyFrameCount
    /// of 0 is for events, 1 sends key frames only (OPC 10000-14, 6.2.4.3). With a
    /// PublishingInterval of zero events are due immediately.
    ///
    /// # Errors
    /// [`WriterSettingsError`] if the standard does not permit the values.
    pub fn new(
        publishing_interval: Duration,
        keep_alive_time: Duration,
        key_frame_count: u32,
    ) -> Result<Self, WriterSettingsError> {
        if keep_alive_time.is_zero() || keep_alive_time < publishing_interval {
            return Err(WriterSettingsError::KeepAliveTime {
                keep_alive_time,
                publishing_interval,
            });
        }
        if publishing_interval.is_zero() && key_frame_count != 0 {
            return Err(WriterSettingsError::KeyFrameCount(key_frame_count));
        }
        Ok(Self {
            publishing_interval,
            keep_alive_time,
            key_frame_count,
        })
    }

    /// Returns the PublishingInterval (OPC 10000-14, 6.2.6.2).
    #[must_use]
    pub const fn publishing_interval(&self) -> Duration {
        self.publishing_interval
    }

    /// Returns the KeepAliveTime (OPC 10000-14, 6.2.6.3).
    #[must_use]
    pub const fn keep_alive_time(&self) -> Duration {
        self.keep_alive_time
    }

    /// Returns the KeyFrameCount (OPC 10000-14, 6.2.4.3).
    #[must_use]
    pub const fn key_frame_count(&self) -> u32 {
        self.key_frame_count
    }
}

impl DataSetWriterState {
    /// Creates a writer in Disabled, below a WriterGroup in the given state. Its first message has
    /// sequence number 0.
    #[must_use]
    pub const fn new(settings: WriterSettings, parent: PubSubState) -> Self {
        Self {
            settings,
            machine: StateMachine::new(parent),
            sequence: SequenceCounter::starting_at(0),
            version: ConfigurationVersion { major: 0, minor: 0 },
            unannounced: false,
            next_interval: Duration::ZERO,
            intervals: None,
            spoken_at: Duration::ZERO,
        }
    }

    /// Continues with the sequence number and version of an earlier instance, so that readers
    /// immediately accept its messages (OPC 10000-14, 7.2.3).
    #[must_use]
    pub const fn resuming(self, sequence: SequenceCounter, version: ConfigurationVersion) -> Self {
        Self {
            sequence,
            version,
            ..self
        }
    }

    /// Returns the kind of message that is due. `changed` states whether a field changed after the
    /// last DataSetMessage, or for event writers whether an event is pending. A kind is returned
    /// once per PublishingInterval or KeepAliveTime, even if it is not sent. A key frame that was
    /// due and not sent is due again in the next interval.
    ///
    /// Send a key frame instead of a delta frame that would be larger (OPC 10000-14, 7.2.4.5.6).
    pub fn poll(&mut self, now: Duration, changed: bool) -> Option<MessageKind> {
        if self.machine.state() != PubSubState::Operational {
            return None;
        }
        let begins = self.begin_interval(now);
        if let Some(kind) = self.data_due(begins, changed) {
            return Some(kind);
        }
        if now < self.keep_alive_at() {
            return None;
        }
        self.spoken_at = now;
        Some(MessageKind::KeepAlive)
    }

    /// Records that a DataSetMessage was sent with the numbers of [`header`](Self::header).
    pub const fn sent(&mut self, kind: MessageKind, now: Duration) {
        self.spoken_at = now;
        match kind {
            MessageKind::KeyFrame => {
                self.intervals = Some(0);
                self.sequence.advance(1);
            }
            MessageKind::DeltaFrame | MessageKind::Event => self.sequence.advance(1),
            MessageKind::KeepAlive => {}
        }
    }

    /// Returns the time of the next message or of the next PublishingInterval; `None` unless
    /// Operational.
    #[must_use]
    pub fn poll_timeout(&self) -> Option<Duration> {
        if self.machine.state() != PubSubState::Operational {
            return None;
        }
        let keep_alive = self.keep_alive_at();
        Some(match self.settings.publishing_interval {
            Duration::ZERO => keep_alive,
            _ => keep_alive.min(self.next_interval),
        })
    }

    /// Returns the numbers of the next DataSetMessage of any kind. A keep-alive has the number of
    /// the message after it (OPC 10000-14, 7.2.4.5.8). The DataSetMessageContentMask selects the
    /// encoded fields (6.3.1.3.2).
    #[must_use]
    pub fn header(&self) -> DataSetHeader {
        DataSetHeader {
            sequence_number: Some(self.sequence.peek()),
            major_version: Some(self.version.major),
            minor_version: Some(self.version.minor),
            ..DataSetHeader::default()
        }
    }

    /// Returns the version of the metadata.
    #[must_use]
    pub const fn version(&self) -> ConfigurationVersion {
        self.version
    }

    /// Returns the sequence numbers, for [`resuming`](Self::resuming).
    #[must_use]
    pub const fn sequence(&self) -> SequenceCounter {
        self.sequence
    }

    /// Changes the version as [`ConfigurationVersion::changed`], at the VersionTime `at`: a key
    /// frame and an announcement are due.
    pub fn change_metadata(&mut self, at: u32) {
        self.set_version(self.version.changed(at));
    }

    /// Changes the version for fields added at the end, at the VersionTime `at`: a key frame and an
    /// announcement are due.
    pub fn extend_metadata(&mut self, at: u32) {
        self.set_version(self.version.extended(at));
    }

    /// Returns true once after the metadata changed: it has to be announced without a probe
    /// (OPC 10000-14, 7.2.4.6.4).
    #[must_use = "the announcement is not asked for again"]
    pub const fn take_announcement(&mut self) -> bool {
        std::mem::replace(&mut self.unannounced, false)
    }

    /// Enables the writer, and returns the new state, Paused or PreOperational.
    ///
    /// # Errors
    /// [`StateRefused`] if the writer is enabled already.
    pub const fn enable(&mut self) -> Result<PubSubState, StateRefused> {
        self.machine.enable()
    }

    /// Disables the writer. Its sequence numbers continue when it is enabled again.
    ///
    /// # Errors
    /// [`StateRefused`] if the writer is disabled already.
    pub const fn disable(&mut self) -> Result<PubSubState, StateRefused> {
        self.machine.disable()
    }

    /// Reports that network and keys are available: the writer becomes Operational, and a key frame
    /// is due.
    ///
    /// # Errors
    /// [`StateRefused`] outside of PreOperational.
    pub fn ready(&mut self, now: Duration) -> Result<PubSubState, StateRefused> {
        let state = self.machine.handle(StateEvent::Ready)?;
        self.start(now);
        Ok(state)
    }

    /// Reports an error: the writer changes to Error and sends nothing.
    ///
    /// # Errors
    /// [`StateRefused`] in Disabled, Paused and Error.
    pub const fn fail(&mut self) -> Result<PubSubState, StateRefused> {
        self.machine.handle(StateEvent::Fail)
    }

    /// Reports that the error is resolved: the writer becomes Operational, and a key frame is due.
    ///
    /// # Errors
    /// [`StateRefused`] outside of Error.
    pub fn resolve(&mut self, now: Duration) -> Result<PubSubState, StateRefused> {
        let state = self.machine.handle(StateEvent::Resolve)?;
        self.start(now);
        Ok(state)
    }

    /// Sets the state of the WriterGroup, and returns the resulting state of the writer.
    pub const fn set_parent(&mut self, parent: PubSubState) -> PubSubState {
        self.machine.set_parent(parent)
    }

    /// Returns the state of the DataSetWriter.
    #[must_use]
    pub const fn state(&self) -> PubSubState {
        self.machine.state()
    }

    /// Returns the settings.
    #[must_use]
    pub const fn settings(&self) -> &WriterSettings {
        &self.settings
    }

    fn start(&mut self, now: Duration) {
        self.next_interval = now;
        self.spoken_at = now;
        self.intervals = None;
    }

    const fn set_version(&mut self, version: ConfigurationVersion) {
        self.version = version;
        self.unannounced = true;
        self.intervals = None;
    }

    /// Returns true if a PublishingInterval started after the last call. Skipped intervals count
    /// for the key frames; the interval grid is unchanged.
    fn begin_interval(&mut self, now: Duration) -> bool {
        let interval = self.settings.publishing_interval;
        if interval.is_zero() || now < self.next_interval {
            return false;
        }
        let since = now.saturating_sub(self.next_interval).as_nanos();
        let passed = since / interval.as_nanos() + 1;
        let into = since % interval.as_nanos();
        let into = Duration::from_nanos(u64::try_from(into).unwrap_or_default());
        self.next_interval = now.saturating_add(interval).saturating_sub(into);
        let passed = u32::try_from(passed).unwrap_or(u32::MAX);
        self.intervals = self.intervals.map(|count| count.saturating_add(passed));
        true
    }

    /// Returns the kind of DataSetMessage that is due, except keep-alives.
    fn data_due(&self, begins: bool, changed: bool) -> Option<MessageKind> {
        match self.settings.key_frame_count {
            0 => {
                let at_once = self.settings.publishing_interval.is_zero();
                (changed && (begins || at_once)).then_some(MessageKind::Event)
            }
            _ if !begins => None,
            count if self.intervals.is_none_or(|passed| passed >= count) => {
                Some(MessageKind::KeyFrame)
            }
            _ => changed.then_some(MessageKind::DeltaFrame),
        }
    }

    const fn keep_alive_at(&self) -> Duration {
        self.spoken_at.saturating_add(self.settings.keep_alive_time)
    }
}
