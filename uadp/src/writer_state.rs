//! When a DataSetWriter sends what, and the state it is in (OPC 10000-14, 6.2.4 and 6.2.6).

use std::time::Duration;

use crate::{
    ConfigurationVersion, DataSetHeader, MessageKind, PubSubState, SequenceCounter, StateEvent,
    StateMachine, StateRefused,
};

/// Numbers the DataSetMessages of one DataSetWriter, says when which kind is due, and keeps its state
/// (OPC 10000-14, 6.2.1, 6.2.4.3, 6.2.6.2 and 6.2.6.3).
///
/// Time is a parameter: how long it is since a start that is the same for all calls. [`poll`](Self::poll) is called
/// when [`poll_timeout`](Self::poll_timeout) says so, and for events also when there is one. What it names is encoded
/// with the numbers of [`header`](Self::header), sent, and told to [`sent`](Self::sent).
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
    /// Metadata changed and was not announced.
    unannounced: bool,
    /// When the next PublishingInterval begins.
    next_interval: Duration,
    /// PublishingIntervals since the one with the last key frame; `None` when one is needed at once.
    intervals: Option<u32>,
    /// When a DataSetMessage was last sent, or a keep-alive last due.
    spoken_at: Duration,
}

/// The parameters of a DataSetWriter and its WriterGroup that say when it sends.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct WriterSettings {
    publishing_interval: Duration,
    keep_alive_time: Duration,
    key_frame_count: u32,
}

/// Parameters the standard does not allow together.
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
    /// Without a PublishingInterval there is nothing to count key frames by (OPC 10000-14, 6.2.6.2).
    #[error("KeyFrameCount {0} without PublishingInterval")]
    KeyFrameCount(u32),
}

impl WriterSettings {
    /// PublishingInterval, KeepAliveTime and KeyFrameCount. A KeyFrameCount of 0 is for events, 1 sends key frames
    /// only (OPC 10000-14, 6.2.4.3); with a PublishingInterval of zero events are due at once.
    ///
    /// # Errors
    /// [`WriterSettingsError`] when the standard does not allow them.
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

    /// PublishingInterval (OPC 10000-14, 6.2.6.2).
    #[must_use]
    pub const fn publishing_interval(&self) -> Duration {
        self.publishing_interval
    }

    /// KeepAliveTime (OPC 10000-14, 6.2.6.3).
    #[must_use]
    pub const fn keep_alive_time(&self) -> Duration {
        self.keep_alive_time
    }

    /// KeyFrameCount (OPC 10000-14, 6.2.4.3).
    #[must_use]
    pub const fn key_frame_count(&self) -> u32 {
        self.key_frame_count
    }
}

impl DataSetWriterState {
    /// A writer in Disabled, below a WriterGroup in the given state. Its first message has sequence number 0.
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

    /// The same writer, going on with the sequence number and the version of an earlier life, so that readers take it
    /// for the same at once (OPC 10000-14, 7.2.3).
    #[must_use]
    pub const fn resuming(self, sequence: SequenceCounter, version: ConfigurationVersion) -> Self {
        Self {
            sequence,
            version,
            ..self
        }
    }

    /// What is to be sent now. `changed` says whether a field changed since the last DataSetMessage, of a writer of
    /// events whether one waits. A kind is named once per PublishingInterval or KeepAliveTime, sent or not; a key
    /// frame that was due and not sent is due again with the next interval.
    ///
    /// A delta frame bigger than a key frame would be is to be sent as one (OPC 10000-14, 7.2.4.5.6).
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

    /// Takes note that a DataSetMessage was sent with the numbers of [`header`](Self::header).
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

    /// When [`poll`](Self::poll) has something to say, or a PublishingInterval begins; `None` unless Operational.
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

    /// The numbers of the next DataSetMessage, whatever its kind: a keep-alive has the number of the message after it
    /// (OPC 10000-14, 7.2.4.5.8). Which of them go on the wire is for the DataSetMessageContentMask to say
    /// (6.3.1.3.2).
    #[must_use]
    pub fn header(&self) -> DataSetHeader {
        DataSetHeader {
            sequence_number: Some(self.sequence.peek()),
            major_version: Some(self.version.major),
            minor_version: Some(self.version.minor),
            ..DataSetHeader::default()
        }
    }

    /// The version of the metadata.
    #[must_use]
    pub const fn version(&self) -> ConfigurationVersion {
        self.version
    }

    /// The sequence numbers, for [`resuming`](Self::resuming).
    #[must_use]
    pub const fn sequence(&self) -> SequenceCounter {
        self.sequence
    }

    /// The metadata changed as [`ConfigurationVersion::changed`] says, at the VersionTime `at`: a key frame and an
    /// announcement are due.
    pub fn change_metadata(&mut self, at: u32) {
        self.set_version(self.version.changed(at));
    }

    /// Fields were added at the end, at the VersionTime `at`: a key frame and an announcement are due.
    pub fn extend_metadata(&mut self, at: u32) {
        self.set_version(self.version.extended(at));
    }

    /// True once after the metadata changed: it is to be announced without being asked for
    /// (OPC 10000-14, 7.2.4.6.4).
    #[must_use = "the announcement is not asked for again"]
    pub const fn take_announcement(&mut self) -> bool {
        std::mem::replace(&mut self.unannounced, false)
    }

    /// Enables the writer; the new state, Paused or PreOperational.
    ///
    /// # Errors
    /// [`StateRefused`] when it is enabled.
    pub const fn enable(&mut self) -> Result<PubSubState, StateRefused> {
        self.machine.enable()
    }

    /// Disables the writer. Its sequence numbers go on when it is enabled again.
    ///
    /// # Errors
    /// [`StateRefused`] when it is disabled.
    pub const fn disable(&mut self) -> Result<PubSubState, StateRefused> {
        self.machine.disable()
    }

    /// All is there that the writer needs, network and keys: Operational, and a key frame is due.
    ///
    /// # Errors
    /// [`StateRefused`] outside of PreOperational.
    pub fn ready(&mut self, now: Duration) -> Result<PubSubState, StateRefused> {
        let state = self.machine.handle(StateEvent::Ready)?;
        self.start(now);
        Ok(state)
    }

    /// Something is wrong: Error, and nothing is sent.
    ///
    /// # Errors
    /// [`StateRefused`] in Disabled, Paused and Error.
    pub const fn fail(&mut self) -> Result<PubSubState, StateRefused> {
        self.machine.handle(StateEvent::Fail)
    }

    /// Nothing is wrong any more: Operational, and a key frame is due.
    ///
    /// # Errors
    /// [`StateRefused`] outside of Error.
    pub fn resolve(&mut self, now: Duration) -> Result<PubSubState, StateRefused> {
        let state = self.machine.handle(StateEvent::Resolve)?;
        self.start(now);
        Ok(state)
    }

    /// Takes note of the WriterGroup's state; the own state that follows.
    pub const fn set_parent(&mut self, parent: PubSubState) -> PubSubState {
        self.machine.set_parent(parent)
    }

    /// The state of the DataSetWriter.
    #[must_use]
    pub const fn state(&self) -> PubSubState {
        self.machine.state()
    }

    /// When it sends.
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

    /// Whether a PublishingInterval began since the last call. Intervals that passed unnoticed count for the key
    /// frames; the grid they lie on stays.
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

    /// The kind of DataSetMessage that is due, apart from keep-alives.
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
