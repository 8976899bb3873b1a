//! Results and counters of received messages.

use crate::MessageKind;

/// Relation of an accepted message to earlier messages.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub struct Accepted {
    /// Number of missed messages of the writer before this message.
    pub missed: u16,
    /// The message arrived after newer messages.
    pub late: bool,
    /// The writer has restarted.
    pub restarted: bool,
    /// Messages were missed after the last key frame: fields that are not in this delta frame may
    /// be outdated.
    pub incomplete: bool,
    /// Minor version of the message if it differs from the metadata: there may be more or fewer
    /// fields at the end (OPC 10000-14, 6.2.3.2.6).
    pub minor_version: Option<u32>,
}

/// Reason why a DataSetMessage was dropped.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, thiserror::Error)]
#[non_exhaustive]
pub enum ReaderDrop {
    /// The reader is Disabled or Paused.
    #[error("the reader is not active")]
    Inactive,
    /// The publisher marks the message as invalid (OPC 10000-14, 7.2.4.5.4).
    #[error("marked as not valid")]
    Invalid,
    /// The table of readers is full of active writers.
    #[error("the limit of writers is reached")]
    TableFull,
    /// The PublisherId is too long for the table.
    #[error("a PublisherId of {len} bytes")]
    PublisherIdTooLong {
        /// Length of the PublisherId.
        len: usize,
    },
    /// The GroupVersion is missing or differs from the configuration.
    #[error("GroupVersion {found:?} where {expected} is configured")]
    GroupVersion {
        /// Configured GroupVersion.
        expected: u32,
        /// GroupVersion of the group header.
        found: Option<u32>,
    },
    /// The NetworkMessageNumber is missing or differs from the configuration.
    #[error("NetworkMessageNumber {found:?} where {expected} is configured")]
    NetworkMessageNumber {
        /// Configured NetworkMessageNumber.
        expected: u16,
        /// NetworkMessageNumber of the group header.
        found: Option<u16>,
    },
    /// The message was received before.
    #[error("received before")]
    Duplicate,
    /// The message or keep-alive is older than the newest message.
    #[error("{behind} behind the newest message")]
    Stale {
        /// Distance to the newest sequence number.
        behind: u16,
    },
    /// The sequence number is neither newer nor older (OPC 10000-14, 7.2.3).
    #[error("a sequence number outside the window")]
    OutOfWindow,
    /// The message needs other metadata (OPC 10000-14, 6.2.9.4).
    #[error("major version {found} where the metadata has {expected}")]
    MajorVersion {
        /// Major version of the metadata.
        expected: u32,
        /// Major version of the message.
        found: u32,
    },
    /// The message is a delta frame without a preceding matching key frame.
    #[error("a delta frame before its key frame")]
    NeedsKeyFrame,
}

/// Counters of the messages of a writer.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub struct ReaderCounters {
    /// Accepted messages, including keep-alives.
    pub accepted: u64,
    /// Accepted keep-alives.
    pub keep_alives: u64,
    /// Missed messages, from gaps in the sequence numbers, including messages that arrived late.
    pub missed: u64,
    /// Accepted late messages.
    pub late: u64,
    /// Restarts of the writer.
    pub restarts: u64,
    /// Passed MessageReceiveTimeouts.
    pub timeouts: u64,
    /// Dropped as [`ReaderDrop::Inactive`].
    pub inactive: u64,
    /// Dropped as [`ReaderDrop::Invalid`].
    pub invalid: u64,
    /// Dropped as [`ReaderDrop::GroupVersion`] or [`ReaderDrop::NetworkMessageNumber`].
    pub other_layout: u64,
    /// Dropped as [`ReaderDrop::Duplicate`].
    pub duplicates: u64,
    /// Dropped as [`ReaderDrop::Stale`].
    pub stale: u64,
    /// Dropped as [`ReaderDrop::OutOfWindow`].
    pub out_of_window: u64,
    /// Dropped as [`ReaderDrop::MajorVersion`].
    pub major_version: u64,
    /// Dropped as [`ReaderDrop::NeedsKeyFrame`].
    pub needs_key_frame: u64,
}

impl ReaderCounters {
    pub(super) const NONE: Self = Self {
        accepted: 0,
        keep_alives: 0,
        missed: 0,
        late: 0,
        restarts: 0,
        timeouts: 0,
        inactive: 0,
        invalid: 0,
        other_layout: 0,
        duplicates: 0,
        stale: 0,
        out_of_window: 0,
        major_version: 0,
        needs_key_frame: 0,
    };

    /// Counts missed messages and restarts, which apply even if the message is dropped later.
    pub(super) fn placed(&mut self, accepted: &Accepted) {
        self.missed += u64::from(accepted.missed);
        self.restarts += u64::from(accepted.restarted);
    }

    pub(super) fn accepted(&mut self, accepted: &Accepted, kind: MessageKind) {
        self.accepted += 1;
        self.late += u64::from(accepted.late);
        self.keep_alives += u64::from(kind == MessageKind::KeepAlive);
    }

    pub(super) const fn dropped(&mut self, reason: ReaderDrop) {
        let counter = match reason {
            // The tables count these, because there is no reader.
            ReaderDrop::TableFull | ReaderDrop::PublisherIdTooLong { .. } => return,
            ReaderDrop::Inactive => &mut self.inactive,
            ReaderDrop::Invalid => &mut self.invalid,
            ReaderDrop::GroupVersion { .. } | ReaderDrop::NetworkMessageNumber { .. } => {
                &mut self.other_layout
            }
            ReaderDrop::Duplicate => &mut self.duplicates,
            ReaderDrop::Stale { .. } => &mut self.stale,
            ReaderDrop::OutOfWindow => &mut self.out_of_window,
            ReaderDrop::MajorVersion { .. } => &mut self.major_version,
            ReaderDrop::NeedsKeyFrame => &mut self.needs_key_frame,
        };
        *counter += 1;
    }
}
