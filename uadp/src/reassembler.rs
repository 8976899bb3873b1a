//! Reassembles chunks (OPC 10000-14, 7.2.4.4.4).

mod open;

use alloc::collections::{BTreeMap, VecDeque};
use alloc::vec::Vec;
use core::time::Duration;

use crate::publisher_id::OwnedPublisherId;
use crate::{
    Chunk, DataSetMessage, DecodeError, NetworkHeader, NetworkMessage, NetworkMessageType,
};
use open::{ChunkInsertion, CompletedWhole, KeyRef, OpenWhole};

/// Collects chunk NetworkMessages until a whole is complete (OPC 10000-14, 7.2.4.4.4).
///
/// A whole is identified by PublisherId, WriterGroupId, NetworkMessage type, DataSetWriterId,
/// MessageSequenceNumber and security mode, so unsigned chunks never become part of a signed whole.
/// Chunks may arrive in any order and have different sizes, although the standard requires equal
/// sizes except for the last chunk.
///
/// Every host that can send to a group can send chunks with the ids of any writer. With
/// [`receive_from`](Self::receive_from) a whole is also identified by its sender, such as an
/// address, so that a sender cannot add chunks to the wholes of another sender. Each sender has
/// separate limits. If all senders together reach a limit, a whole of the sender that holds the
/// most is given up.
///
/// Memory is allocated for received bytes only, not for TotalSize. A datagram allocates its chunk
/// and about a hundred bytes; the last chunk of a whole also uses a reusable buffer for the whole.
/// At a limit, the oldest whole of the sender that holds the most is given up. A repeated chunk is
/// rejected, also after its whole is complete, for [`age`](ReassemblyLimits::age). Different bytes
/// at the same offset start a new whole, so that data of a restarted publisher is never mixed with
/// earlier data. A different TotalSize is rejected while the earlier whole is incomplete, at most
/// for [`age`](ReassemblyLimits::age).
///
/// # Publishers that chunk the NetworkMessage
/// UA-.NETStandard sends chunks without payload header, and splits the encoded NetworkMessage
/// instead of a DataSetMessage. A whole without [`writer_id`](Reassembled::writer_id) that is not a
/// discovery message may be such a message: decode its [`bytes`](Reassembled::bytes) with
/// [`NetworkMessage::decode`].
///
/// See [`ChunkEncoder`](crate::ChunkEncoder) for an example.
#[derive(Debug)]
pub struct Reassembler<S = ()> {
    limits: ReassemblyLimits,
    /// Incomplete wholes, oldest first.
    open: VecDeque<OpenWhole<S>>,
    /// Completed wholes, in the order of completion, to detect repeated chunks.
    done: VecDeque<CompletedWhole<S>>,
    /// Cost of all entries in `open` and `done`.
    held: usize,
    /// The last completed whole.
    whole: Vec<u8>,
    counters: ReassemblyCounters,
    /// Wholes to return from [`poll_given_up`](Self::poll_given_up).
    given_up: VecDeque<IncompleteWhole<S>>,
}

/// Limits of a [`Reassembler`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct ReassemblyLimits {
    /// Maximum bytes of a whole, as in its TotalSize. Default 16 MiB.
    pub whole: u32,
    /// Maximum bytes of all incomplete wholes, including overhead. Default 64 MiB.
    pub total: usize,
    /// Maximum bytes of the incomplete wholes of a sender, including overhead. Default 64 MiB.
    pub total_per_sender: usize,
    /// Maximum number of incomplete wholes, and of remembered completed wholes. Default 64.
    pub open: usize,
    /// Maximum number of incomplete wholes of a sender. Default 64.
    pub open_per_sender: usize,
    /// Maximum number of incomplete wholes of a DataSetWriter, so that a writer with lost chunks
    /// does not displace the wholes of other writers. Default 4.
    pub open_per_writer: usize,
    /// Maximum number of chunks of a whole. Default 32768.
    pub pieces: usize,
    /// Maximum time from the first chunk of a whole to the last. Default 2 s.
    pub age: Duration,
}

/// A completed whole.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Reassembled<'r> {
    /// Headers of the NetworkMessage with the last received chunk.
    pub header: NetworkHeader<'r>,
    /// Type of the message.
    pub message_type: NetworkMessageType,
    /// The DataSetWriter; `None` without payload header.
    pub writer_id: Option<u16>,
    /// MessageSequenceNumber of the whole.
    pub message_sequence_number: u16,
    /// The bytes: a DataSetMessage, or the body of a discovery message.
    pub bytes: &'r [u8],
}

/// Reason why a chunk was rejected.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum ChunkRefusal {
    /// The message is not a chunk, is sealed, or is malformed.
    #[error(transparent)]
    Malformed(#[from] DecodeError),
    /// The whole would exceed [`ReassemblyLimits::whole`].
    #[error("a message of {total_size} bytes exceeds the limit")]
    TooBig {
        /// TotalSize of the whole.
        total_size: u32,
    },
    /// The TotalSize differs from the earlier chunks.
    #[error("TotalSize {found} after {expected}")]
    TotalSize {
        /// TotalSize of the first chunk.
        expected: u32,
        /// TotalSize of this chunk.
        found: u32,
    },
    /// The chunk was received before.
    #[error("a repeated chunk")]
    Duplicate,
    /// The chunk overlaps another chunk.
    #[error("a chunk that overlaps other chunks")]
    Overlap,
    /// The whole has reached [`ReassemblyLimits::pieces`].
    #[error("too many chunks of a message")]
    TooManyPieces,
}

/// Counters of chunks and wholes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub struct ReassemblyCounters {
    /// Completed wholes.
    pub completed: u64,
    /// Accepted chunks.
    pub chunks: u64,
    /// Chunks rejected as [`ChunkRefusal::Malformed`].
    pub malformed: u64,
    /// Chunks rejected as [`ChunkRefusal::TooBig`].
    pub too_big: u64,
    /// Chunks rejected as [`ChunkRefusal::TotalSize`].
    pub total_size: u64,
    /// Chunks rejected as [`ChunkRefusal::Duplicate`].
    pub duplicates: u64,
    /// Chunks rejected as [`ChunkRefusal::Overlap`].
    pub overlaps: u64,
    /// Chunks rejected as [`ChunkRefusal::TooManyPieces`].
    pub too_many_pieces: u64,
    /// Wholes given up because of [`ReassemblyLimits::age`].
    pub expired: u64,
    /// Wholes given up because of [`ReassemblyLimits::total`] or
    /// [`ReassemblyLimits::total_per_sender`].
    pub out_of_bytes: u64,
    /// Wholes given up because of [`ReassemblyLimits::open`] or
    /// [`ReassemblyLimits::open_per_sender`].
    pub out_of_places: u64,
    /// Wholes given up because of [`ReassemblyLimits::open_per_writer`].
    pub superseded: u64,
    /// Wholes given up because a chunk at the offset of an earlier chunk had different bytes, so
    /// that the number is in use again. That chunk starts a new whole.
    pub contradicted: u64,
}

/// An incomplete whole that was given up.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct IncompleteWhole<S = ()> {
    /// Sender of its chunks.
    pub sender: S,
    /// PublisherId in its chunks.
    pub publisher_id: Option<OwnedPublisherId>,
    /// The WriterGroup.
    pub writer_group_id: Option<u16>,
    /// The DataSetWriter; `None` without payload header.
    pub writer_id: Option<u16>,
    /// MessageSequenceNumber of the whole.
    pub message_sequence_number: u16,
    /// Received bytes.
    pub received: u32,
    /// TotalSize of the whole.
    pub total_size: u32,
    /// Reason for giving it up.
    pub why: GiveUp,
}

/// Reason why a whole was given up.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum GiveUp {
    /// The time of [`ReassemblyLimits::age`] passed.
    Expired,
    /// It was the oldest whole of its sender, which held the most bytes when
    /// [`ReassemblyLimits::total`] was reached, or which reached
    /// [`ReassemblyLimits::total_per_sender`].
    OutOfBytes,
    /// It was the oldest whole of its sender, which had the most wholes when
    /// [`ReassemblyLimits::open`] was reached, or which reached
    /// [`ReassemblyLimits::open_per_sender`].
    OutOfPlaces,
    /// It was the oldest whole of its writer, which reached [`ReassemblyLimits::open_per_writer`].
    Superseded,
    /// A chunk at the offset of an earlier chunk had different bytes.
    Contradicted,
}

/// Result of accepting a chunk.
enum Step {
    Incomplete,
    /// The chunk is the complete whole.
    Alone,
    /// The complete whole is in the buffer.
    Complete,
}

impl Default for ReassemblyLimits {
    fn default() -> Self {
        Self {
            whole: 16 << 20,
            total: 64 << 20,
            total_per_sender: 64 << 20,
            open: 64,
            open_per_sender: 64,
            open_per_writer: 4,
            pieces: 32768,
            age: Duration::from_secs(2),
        }
    }
}

impl<S> Default for Reassembler<S> {
    fn default() -> Self {
        Self::new(ReassemblyLimits::default())
    }
}

impl Reassembler {
    /// Handles a chunk as [`receive_from`](Reassembler::receive_from), with a single sender.
    ///
    /// # Errors
    /// As [`receive_from`](Reassembler::receive_from).
    pub fn receive<'r>(
        &'r mut self,
        message: &NetworkMessage<'r>,
        now: Duration,
    ) -> Result<Option<Reassembled<'r>>, ChunkRefusal> {
        self.receive_from((), message, now)
    }
}

impl<S> Reassembler<S> {
    /// Creates an empty reassembler. The limits [`open`](ReassemblyLimits::open),
    /// [`open_per_sender`](ReassemblyLimits::open_per_sender) and
    /// [`open_per_writer`](ReassemblyLimits::open_per_writer) are at least 1.
    #[must_use]
    pub const fn new(limits: ReassemblyLimits) -> Self {
        Self {
            limits,
            open: VecDeque::new(),
            done: VecDeque::new(),
            held: 0,
            whole: Vec::new(),
            given_up: VecDeque::new(),
            counters: ReassemblyCounters {
                completed: 0,
                chunks: 0,
                malformed: 0,
                too_big: 0,
                total_size: 0,
                duplicates: 0,
                overlaps: 0,
                too_many_pieces: 0,
                expired: 0,
                out_of_bytes: 0,
                out_of_places: 0,
                superseded: 0,
                contradicted: 0,
            },
        }
    }

    /// Gives up expired wholes.
    pub fn expire(&mut self, now: Duration) {
        let age = self.limits.age;
        let is_old = |since: Duration| now.saturating_sub(since) >= age;
        while self.open.front().is_some_and(|open| is_old(open.since)) {
            self.give_up(0, GiveUp::Expired);
        }
        while self.done.front().is_some_and(|done| is_old(done.at)) {
            self.forget_oldest();
        }
    }

    /// Returns the time of the next [`expire`](Self::expire), or `None` if no whole is incomplete.
    #[must_use]
    pub fn poll_timeout(&self) -> Option<Duration> {
        let oldest = self.open.front()?;
        Some(oldest.since.saturating_add(self.limits.age))
    }

    /// Returns the next whole that was given up. Call it after each
    /// [`receive_from`](Self::receive_from) and [`expire`](Self::expire) until it returns `None`.
    /// About [`ReassemblyLimits::open`] entries are kept; older entries are dropped.
    pub fn poll_given_up(&mut self) -> Option<IncompleteWhole<S>> {
        self.given_up.pop_front()
    }

    /// Returns the counters of chunks and wholes.
    #[must_use]
    pub const fn counters(&self) -> &ReassemblyCounters {
        &self.counters
    }

    /// Returns the bytes held for incomplete wholes, including overhead. The value never exceeds
    /// [`ReassemblyLimits::total`]; the buffer of the last whole is not included.
    #[must_use]
    pub const fn held(&self) -> usize {
        self.held
    }

    /// Takes the buffer with the last completed whole. The buffer is empty if the whole was a
    /// single chunk.
    #[must_use]
    pub fn take_whole(&mut self) -> Vec<u8> {
        core::mem::take(&mut self.whole)
    }

    fn complete(&mut self, at: usize, now: Duration) -> Step {
        let Some(open) = self.open.remove(at) else {
            return Step::Incomplete;
        };
        self.held -= open.cost();
        open.write(&mut self.whole);
        self.remember(open.done(now));
        Step::Complete
    }

    /// Rejects a repeated chunk of the completed whole at `at`. Otherwise removes the whole,
    /// because its number is in use again.
    fn forget_unless_same(&mut self, at: usize, chunk: &Chunk<'_>) -> Result<(), ChunkRefusal> {
        if self.done.get(at).is_some_and(|done| done.had(chunk)) {
            return Err(ChunkRefusal::Duplicate);
        }
        if let Some(done) = self.done.remove(at) {
            self.held -= done.cost();
        }
        Ok(())
    }

    fn remember(&mut self, done: CompletedWhole<S>) {
        if self.done.len() >= self.limits.open {
            self.forget_oldest();
        }
        if self.held + done.cost() <= self.limits.total && self.done.len() < self.limits.open {
            self.held += done.cost();
            self.done.push_back(done);
        }
    }

    /// Removes the oldest completed whole. Returns false if there is none.
    fn forget_oldest(&mut self) -> bool {
        let Some(done) = self.done.pop_front() else {
            return false;
        };
        self.held -= done.cost();
        true
    }

    fn give_up(&mut self, at: usize, why: GiveUp) {
        let Some(open) = self.open.remove(at) else {
            return;
        };
        self.held -= open.cost();
        self.counters.count_given_up(why);
        // A single call gives up at most the open wholes, so a caller that polls after each call
        // misses no entry.
        if self.given_up.len() > self.limits.open {
            self.given_up.pop_front();
        }
        self.given_up.push_back(open.given_up(why));
    }
}

impl<S: Copy + Ord> Reassembler<S> {
    /// Handles a chunk. Returns the whole if this was the last missing chunk. `now` counts from any
    /// fixed time.
    ///
    /// # Errors
    /// [`ChunkRefusal`] if the chunk is rejected. Other chunks are not affected.
    pub fn receive_from<'r>(
        &'r mut self,
        sender: S,
        message: &NetworkMessage<'r>,
        now: Duration,
    ) -> Result<Option<Reassembled<'r>>, ChunkRefusal> {
        self.expire(now);
        let (chunk, step) = match self.take(sender, message, now) {
            Ok(taken) => taken,
            Err(refusal) => {
                self.counters.count(refusal);
                return Err(refusal);
            }
        };
        self.counters.chunks += 1;
        let bytes = match step {
            Step::Incomplete => return Ok(None),
            Step::Alone => chunk.data,
            Step::Complete => &self.whole,
        };
        self.counters.completed += 1;
        Ok(Some(Reassembled {
            header: message.header(),
            message_type: message.message_type(),
            writer_id: chunk.writer_id,
            message_sequence_number: chunk.message_sequence_number,
            bytes,
        }))
    }

    fn take<'r>(
        &mut self,
        sender: S,
        message: &NetworkMessage<'r>,
        now: Duration,
    ) -> Result<(Chunk<'r>, Step), ChunkRefusal> {
        let chunk = message.chunk()?;
        if chunk.total_size > self.limits.whole {
            return Err(ChunkRefusal::TooBig {
                total_size: chunk.total_size,
            });
        }
        let key = KeyRef::of(message, &chunk, sender);
        if let Some(at) = self.done.iter().position(|done| key.is(&done.key)) {
            self.forget_unless_same(at, &chunk)?;
        }
        let at = match self.open.iter().position(|open| key.is(&open.key)) {
            Some(at) => self.extend(at, &chunk, &key, now)?,
            None if chunk.data.len() == chunk.total_size as usize => {
                self.whole.clear();
                self.remember(CompletedWhole::alone(key.to_key(), &chunk, now));
                return Ok((chunk, Step::Alone));
            }
            None => self.begin(&key, &chunk, now)?,
        };
        let step = match self.open.get(at) {
            Some(open) if open.is_complete() => self.complete(at, now),
            _ => {
                self.make_room(sender);
                Step::Incomplete
            }
        };
        Ok((chunk, step))
    }

    /// Adds the chunk to the whole at `at`. Returns the new index of the whole.
    fn extend(
        &mut self,
        at: usize,
        chunk: &Chunk<'_>,
        key: &KeyRef<'_, S>,
        now: Duration,
    ) -> Result<usize, ChunkRefusal> {
        let pieces = self.limits.pieces;
        let Some(open) = self.open.get_mut(at) else {
            return self.begin(key, chunk, now);
        };
        if open.total_size != chunk.total_size {
            return Err(ChunkRefusal::TotalSize {
                expected: open.total_size,
                found: chunk.total_size,
            });
        }
        let before = open.cost();
        match open.insert(chunk, pieces) {
            ChunkInsertion::Taken => {
                self.held += open.cost() - before;
                Ok(at)
            }
            ChunkInsertion::Duplicate => Err(ChunkRefusal::Duplicate),
            ChunkInsertion::Overlap => Err(ChunkRefusal::Overlap),
            ChunkInsertion::TooMany => Err(ChunkRefusal::TooManyPieces),
            ChunkInsertion::Contradiction => {
                self.give_up(at, GiveUp::Contradicted);
                self.begin(key, chunk, now)
            }
        }
    }

    /// Starts a whole with its first chunk. Returns the index of the whole.
    fn begin(
        &mut self,
        key: &KeyRef<'_, S>,
        chunk: &Chunk<'_>,
        now: Duration,
    ) -> Result<usize, ChunkRefusal> {
        let mut open = OpenWhole::new(key.to_key(), chunk.total_size, now);
        if let ChunkInsertion::TooMany = open.insert(chunk, self.limits.pieces) {
            return Err(ChunkRefusal::TooManyPieces);
        }
        let of_writer = |other: &OpenWhole<S>| key.is_writer_of(&other.key);
        if self.open.iter().filter(|open| of_writer(open)).count() >= self.limits.open_per_writer
            && let Some(oldest) = self.open.iter().position(of_writer)
        {
            self.give_up(oldest, GiveUp::Superseded);
        }
        let of_sender = |other: &OpenWhole<S>| other.key.sender == key.sender;
        if self.open.iter().filter(|open| of_sender(open)).count() >= self.limits.open_per_sender
            && let Some(oldest) = self.open.iter().position(of_sender)
        {
            self.give_up(oldest, GiveUp::OutOfPlaces);
        }
        if self.open.len() >= self.limits.open
            && let Some(oldest) = self.oldest_of_greediest(key.sender, |_| 1)
        {
            self.give_up(oldest, GiveUp::OutOfPlaces);
        }
        self.held += open.cost();
        self.open.push_back(open);
        Ok(self.open.len() - 1)
    }

    /// Gives up the oldest wholes of `sender` until it is within its own limit. Then removes
    /// completed wholes, and gives up the oldest wholes of the sender that holds the most, until
    /// the rest is within the total limit.
    fn make_room(&mut self, sender: S) {
        let most = self.limits.total_per_sender;
        while self.held > most {
            let of_sender = |open: &&OpenWhole<S>| open.key.sender == sender;
            let held: usize = self
                .open
                .iter()
                .filter(of_sender)
                .map(OpenWhole::cost)
                .sum();
            let oldest = self.open.iter().position(|open| of_sender(&open));
            let Some(oldest) = oldest.filter(|_| held > most) else {
                break;
            };
            self.give_up(oldest, GiveUp::OutOfBytes);
        }
        while self.held > self.limits.total {
            if self.forget_oldest() {
                continue;
            }
            let Some(oldest) = self.oldest_of_greediest(sender, OpenWhole::cost) else {
                return;
            };
            self.give_up(oldest, GiveUp::OutOfBytes);
        }
    }

    /// Returns the oldest whole of the sender with the greatest sum of `weight`. If several senders
    /// have the greatest sum and `sender` is among them, it is `sender`: no other sender makes
    /// space for a sender that holds as much.
    fn oldest_of_greediest(
        &self,
        sender: S,
        weight: impl Fn(&OpenWhole<S>) -> usize,
    ) -> Option<usize> {
        let mut sums: BTreeMap<S, usize> = BTreeMap::new();
        for open in &self.open {
            *sums.entry(open.key.sender).or_default() += weight(open);
        }
        let most = sums.values().max()?;
        let greediest = |open: &OpenWhole<S>| sums.get(&open.key.sender) == Some(most);
        let own = |open: &OpenWhole<S>| open.key.sender == sender && greediest(open);
        let mut open = self.open.iter();
        let oldest = open.position(own);
        oldest.or_else(|| self.open.iter().position(greediest))
    }
}

impl<'r> Reassembled<'r> {
    /// Decodes the DataSetMessage.
    ///
    /// # Errors
    /// [`DecodeError::Misread`] for a discovery message; otherwise as [`NetworkMessage::messages`]
    /// for a malformed message.
    pub fn data_set_message(&self) -> Result<DataSetMessage<'r>, DecodeError> {
        match self.message_type {
            NetworkMessageType::DataSet => DataSetMessage::decode(self.writer_id, self.bytes),
            NetworkMessageType::Probe => Err(DecodeError::Misread("a discovery probe")),
            NetworkMessageType::Announcement => {
                Err(DecodeError::Misread("a discovery announcement"))
            }
        }
    }
}

impl ReassemblyCounters {
    const fn count_given_up(&mut self, why: GiveUp) {
        let counter = match why {
            GiveUp::Expired => &mut self.expired,
            GiveUp::OutOfBytes => &mut self.out_of_bytes,
            GiveUp::OutOfPlaces => &mut self.out_of_places,
            GiveUp::Superseded => &mut self.superseded,
            GiveUp::Contradicted => &mut self.contradicted,
        };
        *counter += 1;
    }

    const fn count(&mut self, refusal: ChunkRefusal) {
        let counter = match refusal {
            ChunkRefusal::Malformed(_) => &mut self.malformed,
            ChunkRefusal::TooBig { .. } => &mut self.too_big,
            ChunkRefusal::TotalSize { .. } => &mut self.total_size,
            ChunkRefusal::Duplicate => &mut self.duplicates,
            ChunkRefusal::Overlap => &mut self.overlaps,
            ChunkRefusal::TooManyPieces => &mut self.too_many_pieces,
        };
        *counter += 1;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A signed chunk of DataSetWriter 10: two of four bytes of a whole, and a signature of one
    /// byte.
    const SIGNED: [u8; 26] = [
        0xC1, 0x90, 0x01, 10, 0, // flags, DataSetWriterId
        0x01, 7, 0, 0, 0, 1, 0xEE, // signed, token 7, a nonce of one byte
        5, 0, 0, 0, 0, 0, 4, 0, 0, 0, 1, 2, // the chunk
        0xFF, 0xFF, // signature
    ];

    #[test]
    fn an_unsigned_chunk_does_not_get_into_a_signed_whole() {
        let mut reassembler = Reassembler::default();
        let sealed = NetworkMessage::decode(&SIGNED).unwrap();
        let (payload, _) = sealed.payload().split_at(12);
        let opened = sealed.opened(payload, &[]);
        assert_eq!(reassembler.receive(&opened, Duration::ZERO), Ok(None));

        let unsigned = [0xC1, 0x80, 0x01, 10, 0, 5, 0, 2, 0, 0, 0, 4, 0, 0, 0, 9, 9];
        let unsigned = NetworkMessage::decode(&unsigned).unwrap();
        assert_eq!(unsigned.chunk().unwrap().message_sequence_number, 5);
        assert_eq!(reassembler.receive(&unsigned, Duration::ZERO), Ok(None));
        assert_eq!(reassembler.counters().completed, 0);
    }
}
