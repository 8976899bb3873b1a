//! An incomplete whole.

use alloc::boxed::Box;
use alloc::collections::BTreeMap;
use alloc::vec::Vec;
use core::hash::Hasher;
use core::time::Duration;

use super::{GiveUp, IncompleteWhole};
use crate::hashing::DefaultHasher;
use crate::publisher_id::OwnedPublisherId;
use crate::{Chunk, NetworkMessage, NetworkMessageType, PublisherId};

/// Identity of a whole.
#[derive(Debug)]
pub(super) struct WholeKey<S> {
    /// Sender of its chunks.
    pub(super) sender: S,
    publisher_id: Option<OwnedPublisherId>,
    writer: Writer,
    message_sequence_number: u16,
}

/// A [`WholeKey`] for lookups, which borrows the PublisherId.
#[derive(Debug, Clone, Copy)]
pub(super) struct KeyRef<'a, S> {
    pub(super) sender: S,
    publisher_id: Option<PublisherId<'a>>,
    writer: Writer,
    message_sequence_number: u16,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Writer {
    group_id: Option<u16>,
    message_type: NetworkMessageType,
    writer_id: Option<u16>,
    signed: bool,
    encrypted: bool,
}

/// A whole during reassembly.
#[derive(Debug)]
pub(super) struct OpenWhole<S> {
    pub(super) key: WholeKey<S>,
    pub(super) total_size: u32,
    /// Time of its first chunk.
    pub(super) since: Duration,
    /// Pieces by offset, without overlaps.
    pieces: BTreeMap<u32, Box<[u8]>>,
    /// Total bytes of the pieces.
    received: u32,
}

/// A completed whole, with the digests of its chunks.
#[derive(Debug)]
pub(super) struct CompletedWhole<S> {
    pub(super) key: WholeKey<S>,
    /// Time of completion.
    pub(super) at: Duration,
    total_size: u32,
    /// Offsets of the pieces in ascending order, and their digests.
    pieces: Box<[(u32, u64)]>,
}

/// Result of inserting a chunk.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum ChunkInsertion {
    Taken,
    /// The same bytes are present.
    Duplicate,
    /// Different bytes are present at the same offset.
    Contradiction,
    /// A part of the range is present.
    Overlap,
    TooMany,
}

impl<'a, S: Copy + Eq> KeyRef<'a, S> {
    pub(super) fn of(message: &NetworkMessage<'a>, chunk: &Chunk<'_>, sender: S) -> Self {
        let header = message.header();
        let security = message.security().unwrap_or_default();
        Self {
            sender,
            publisher_id: header.publisher_id,
            writer: Writer {
                group_id: header.group.and_then(|group| group.writer_group_id),
                message_type: message.message_type(),
                writer_id: chunk.writer_id,
                signed: security.signed,
                encrypted: security.encrypted,
            },
            message_sequence_number: chunk.message_sequence_number,
        }
    }

    pub(super) fn is(&self, key: &WholeKey<S>) -> bool {
        self.message_sequence_number == key.message_sequence_number && self.is_writer_of(key)
    }

    pub(super) fn is_writer_of(&self, key: &WholeKey<S>) -> bool {
        let publisher_id = key.publisher_id.as_ref().map(OwnedPublisherId::as_id);
        self.writer == key.writer && self.publisher_id == publisher_id && self.sender == key.sender
    }

    pub(super) fn to_key(self) -> WholeKey<S> {
        WholeKey {
            sender: self.sender,
            publisher_id: self.publisher_id.map(Into::into),
            writer: self.writer,
            message_sequence_number: self.message_sequence_number,
        }
    }
}

impl<S> WholeKey<S> {
    /// Returns the approximate bytes that the key uses.
    pub(super) fn cost(&self) -> usize {
        let text = match &self.publisher_id {
            Some(OwnedPublisherId::String(text)) => text.len(),
            Some(
                OwnedPublisherId::Byte(_)
                | OwnedPublisherId::UInt16(_)
                | OwnedPublisherId::UInt32(_)
                | OwnedPublisherId::UInt64(_),
            )
            | None => 0,
        };
        text + size_of::<S>() + KEY_COST
    }
}

impl<S> OpenWhole<S> {
    pub(super) const fn new(key: WholeKey<S>, total_size: u32, since: Duration) -> Self {
        Self {
            key,
            total_size,
            since,
            pieces: BTreeMap::new(),
            received: 0,
        }
    }

    /// Adds the piece, unless it is present or the whole has `limit` pieces.
    pub(super) fn insert(&mut self, chunk: &Chunk<'_>, limit: usize) -> ChunkInsertion {
        match self.pieces.get(&chunk.offset) {
            Some(piece) if **piece == *chunk.data => return ChunkInsertion::Duplicate,
            Some(piece) if piece.len() == chunk.data.len() => return ChunkInsertion::Contradiction,
            Some(_) => return ChunkInsertion::Overlap,
            None => {}
        }
        let Ok(len) = u32::try_from(chunk.data.len()) else {
            return ChunkInsertion::Overlap;
        };
        if self.overlaps(chunk.offset, len) {
            return ChunkInsertion::Overlap;
        }
        if self.pieces.len() >= limit {
            return ChunkInsertion::TooMany;
        }
        self.pieces.insert(chunk.offset, chunk.data.into());
        self.received += len;
        ChunkInsertion::Taken
    }

    fn overlaps(&self, offset: u32, len: u32) -> bool {
        let before = self.pieces.range(..offset).next_back();
        let after = self.pieces.range(offset..).next();
        before.is_some_and(|(at, piece)| *at as usize + piece.len() > offset as usize)
            || after.is_some_and(|(at, _)| *at - offset < len)
    }

    /// Returns true if no piece is missing. Pieces do not overlap, so the number of bytes suffices.
    pub(super) const fn is_complete(&self) -> bool {
        self.received == self.total_size
    }

    /// Replaces the contents of `out` with the pieces.
    pub(super) fn write(&self, out: &mut Vec<u8>) {
        out.clear();
        out.reserve_exact(self.received as usize);
        for piece in self.pieces.values() {
            out.extend_from_slice(piece);
        }
    }

    /// Converts the whole to the entry that is remembered after completion.
    pub(super) fn done(self, at: Duration) -> CompletedWhole<S> {
        let Self {
            key,
            total_size,
            pieces,
            ..
        } = self;
        let digests: Vec<_> = pieces
            .iter()
            .map(|(at, piece)| (*at, digest(piece)))
            .collect();
        drop(pieces);
        CompletedWhole {
            key,
            at,
            total_size,
            // The copy reuses the memory of the pieces. Behind them it would keep the allocator
            // from releasing their memory.
            pieces: digests.as_slice().into(),
        }
    }

    /// Converts the whole to the entry that reports it as given up.
    pub(super) fn given_up(self, why: GiveUp) -> IncompleteWhole<S> {
        IncompleteWhole {
            sender: self.key.sender,
            publisher_id: self.key.publisher_id,
            writer_group_id: self.key.writer.group_id,
            writer_id: self.key.writer.writer_id,
            message_sequence_number: self.key.message_sequence_number,
            received: self.received,
            total_size: self.total_size,
            why,
        }
    }

    /// Returns the approximate bytes that the whole uses.
    pub(super) fn cost(&self) -> usize {
        self.key.cost() + self.received as usize + self.pieces.len() * PIECE_COST
    }
}

impl<S> CompletedWhole<S> {
    /// Creates the entry of a whole with a single chunk.
    pub(super) fn alone(key: WholeKey<S>, chunk: &Chunk<'_>, at: Duration) -> Self {
        Self {
            key,
            at,
            total_size: chunk.total_size,
            pieces: Box::new([(chunk.offset, digest(chunk.data))]),
        }
    }

    /// Returns true if the chunk is a piece of the whole.
    pub(super) fn had(&self, chunk: &Chunk<'_>) -> bool {
        let pieces = &self.pieces;
        let found = pieces.binary_search_by_key(&chunk.offset, |(at, _)| *at);
        let piece = found.ok().and_then(|at| pieces.get(at));
        self.total_size == chunk.total_size
            && piece.is_some_and(|(_, known)| *known == digest(chunk.data))
    }

    /// Returns the approximate bytes that the entry uses.
    pub(super) fn cost(&self) -> usize {
        self.key.cost() + self.pieces.len() * size_of::<(u32, u64)>()
    }
}

fn digest(piece: &[u8]) -> u64 {
    let mut hasher = DefaultHasher::new();
    hasher.write(piece);
    hasher.finish()
}

/// Bytes of a key with its queue entry, and of the empty collections of a whole.
const KEY_COST: usize = 160;
/// Bytes of a piece with its tree entry and the allocator overhead.
const PIECE_COST: usize = 96;
