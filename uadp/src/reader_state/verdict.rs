//! What becomes of a message, and how often.

use crate::MessageKind;

/// How an accepted message stands to the ones before.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub struct Accepted {
    /// Messages of the writer that should have come before it and did not.
    pub missed: u16,
    /// It came after newer ones.
    pub late: bool,
    /// The writer started over.
    pub restarted: bool,
    /// Messages were missed since the last key frame: fields that are not in this delta frame may be old.
    pub incomplete: bool,
    /// Its minor version, where that is not the one of the metadata: it may have more fields or fewer at the end
    /// (OPC 10000-14, 6.2.3.2.6).
    pub minor_version: Option<u32>,
}

/// Why a DataSetMessage was dropped.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, thiserror::Error)]
#[non_exhaustive]
pub enum ReaderDrop {
    /// The reader is Disabled or Paused.
    #[error("the reader is not active")]
    Inactive,
    /// The publisher says it is not valid (OPC 10000-14, 7.2.4.5.4).
    #[error("marked as not valid")]
    Invalid,
    /// The table of readers is full of writers that live.
    #[error("no place for another writer")]
    TableFull,
    /// The PublisherId is too long to be kept in a table.
    #[error("a PublisherId of {len} bytes")]
    PublisherIdTooLong {
        /// Its length.
        len: usize,
    },
    /// Another GroupVersion than the configured one, or none.
    #[error("GroupVersion {found:?} where {expected} is configured")]
    GroupVersion {
        /// The configured one.
        expected: u32,
        /// That of the group header.
        found: Option<u32>,
    },
    /// Another NetworkMessageNumber than the configured one, or none.
    #[error("NetworkMessageNumber {found:?} where {expected} is configured")]
    NetworkMessageNumber {
        /// The configured one.
        expected: u16,
        /// That of the group header.
        found: Option<u16>,
    },
    /// It came before.
    #[error("received before")]
    Duplicate,
    /// It is older than the newest one, or a keep-alive that is.
    #[error("{behind} behind the newest message")]
    Stale {
        /// How many numbers behind.
        behind: u16,
    },
    /// Its number is neither newer nor older (OPC 10000-14, 7.2.3).
    #[error("a sequence number out of the window")]
    OutOfWindow,
    /// It is to be decoded with other metadata, which is needed now (OPC 10000-14, 6.2.9.4).
    #[error("major version {found} where the metadata has {expected}")]
    MajorVersion {
        /// Major version of the metadata.
        expected: u32,
        /// Major version of the message.
        found: u32,
    },
    /// A delta frame, and no key frame before it that it belongs to.
    #[error("a delta frame before its key frame")]
    NeedsKeyFrame,
}

/// What became of the messages of a writer.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub struct ReaderCounters {
    /// Messages accepted, keep-alives included.
    pub accepted: u64,
    /// Keep-alives accepted.
    pub keep_alives: u64,
    /// Messages missed, by the gaps in the sequence numbers. Those that came late are among them.
    pub missed: u64,
    /// Messages accepted after newer ones.
    pub late: u64,
    /// How often the writer started over.
    pub restarts: u64,
    /// How often the MessageReceiveTimeout passed.
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

    /// Counts what the sequence number of a message told, whether it is accepted in the end or not.
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
            // The tables count these: there is no reader then.
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
