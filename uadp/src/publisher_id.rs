//! An owned PublisherId, independent of the datagram.

use alloc::boxed::Box;
use core::fmt;

use crate::PublisherId;

/// Owned form of a [`PublisherId`]. Two ids are equal if their type and value are equal
/// (OPC 10000-14, 7.2.4.4.2).
#[derive(Clone, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[expect(missing_docs, reason = "the names are those of the builtin types")]
pub enum OwnedPublisherId {
    Byte(u8),
    UInt16(u16),
    UInt32(u32),
    UInt64(u64),
    String(Box<str>),
}

impl OwnedPublisherId {
    /// Returns the borrowed form.
    #[must_use]
    pub const fn as_id(&self) -> PublisherId<'_> {
        match self {
            Self::Byte(id) => PublisherId::Byte(*id),
            Self::UInt16(id) => PublisherId::UInt16(*id),
            Self::UInt32(id) => PublisherId::UInt32(*id),
            Self::UInt64(id) => PublisherId::UInt64(*id),
            Self::String(id) => PublisherId::String(id),
        }
    }
}

impl From<PublisherId<'_>> for OwnedPublisherId {
    fn from(id: PublisherId<'_>) -> Self {
        match id {
            PublisherId::Byte(id) => Self::Byte(id),
            PublisherId::UInt16(id) => Self::UInt16(id),
            PublisherId::UInt32(id) => Self::UInt32(id),
            PublisherId::UInt64(id) => Self::UInt64(id),
            PublisherId::String(id) => Self::String(id.into()),
        }
    }
}

impl fmt::Debug for OwnedPublisherId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.as_id().fmt(f)
    }
}
