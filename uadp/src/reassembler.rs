//! Putting chunks together again (OPC 10000-14, 7.2.4.4.4).

mod open;

use std::collections::{BTreeMap, VecDeque};
use std::time::Duration;

use crate::publisher_id::OwnedPublisherId;
use crate::{
    Chunk, DataSetMessage, DecodeError, NetworkHeader, NetworkMessage, NetworkMessageType,
};
use open::{Done, Insertion, KeyRef, Open};

/// Collects chunk NetworkMessages until a whole is complete (OPC 10000-14, 7.2.4.4.4).
///
/// A whole is known by PublisherId, WriterGroupId, NetworkMessage type, DataSetWriterId, MessageSequenceNumber and
/// how it is secured, so that nothing unsigned gets into what was signed. Chunks may come in any order and in uneven
/// pieces, although the standard has all but the last equally long.
///
/// Whoever can send to a group can make up chunks of any writer. With [`receive_from`](Self::receive_from) a whole is
/// known by its sender as well, an address or whatever `S` is: nobody gets a chunk into what another sends. Each sender
/// has limits of its own, and where all together reach one, the sender that holds most gives way.
///
/// Only what has arrived is held: TotalSize reserves nothing. A datagram makes it hold its own piece and about a
/// hundred bytes, the last piece of a whole in addition one buffer for the whole, which is used again. When a limit
/// is reached the whole that was begun first is given up, of the sender that holds most. The same chunk once more is refused, for
/// [`age`](ReassemblyLimits::age) also after the whole was complete. Other bytes in the same place begin a new whole,
/// so that a publisher that starts over mixes nothing; another TotalSize is refused while the earlier whole is
/// incomplete, for [`age`](ReassemblyLimits::age) at most.
///
/// # Publishers that chunk the NetworkMessage
/// UA-.NETStandard sends no payload header with its chunks and cuts up the encoded NetworkMessage instead of one
/// DataSetMessage. A whole without [`writer_id`](Reassembled::writer_id) that is no discovery message may be such
/// a one: read it with [`NetworkMessage::decode`] from [`bytes`](Reassembled::bytes).
///
/// An example stands at [`Chunks`](crate::Chunks).
#[derive(Debug)]
pub struct Reassembler<S = ()> {
    limits: ReassemblyLimits,
    /// In the order they were begun.
    open: VecDeque<Open<S>>,
    /// Completed ones, whose chunks may come again; in the order they were completed.
    done: VecDeque<Done<S>>,
    /// Cost of all in `open` and `done`.
    held: usize,
    /// The whole that was completed last.
    whole: Vec<u8>,
    counters: ReassemblyCounters,
    /// What [`poll_given_up`](Self::poll_given_up) hands out.
    given_up: VecDeque<GivenUp<S>>,
}

/// What a [`Reassembler`] may hold.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct ReassemblyLimits {
    /// Bytes of one whole, as its TotalSize says. Default 16 MiB.
    pub whole: u32,
    /// Bytes of all incomplete wholes, their bookkeeping included. Default 64 MiB.
    pub total: usize,
    /// The same of one sender's. Default 64 MiB.
    pub total_per_sender: usize,
    /// Incomplete wholes, and completed ones that are remembered. Default 64.
    pub open: usize,
    /// Incomplete wholes of one sender. Default 64.
    pub open_per_sender: usize,
    /// Incomplete wholes of one DataSetWriter, so that one that loses chunks does not push out the others'.
    /// Default 4.
    pub open_per_writer: usize,
    /// Pieces of one whole. Default 32768.
    pub pieces: usize,
    /// How long a whole may take from its first chunk to its last. Default 2 s.
    pub age: Duration,
}

/// A whole that is complete.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Reassembled<'r> {
    /// The headers of the NetworkMessage with the chunk that came last.
    pub header: NetworkHeader<'r>,
    /// What the bytes are.
    pub message_type: NetworkMessageType,
    /// The DataSetWriter; `None` without payload header.
    pub writer_id: Option<u16>,
    /// The number of the whole among those of the DataSetWriter.
    pub message_sequence_number: u16,
    /// The bytes: one DataSetMessage, or the body of a discovery message.
    pub bytes: &'r [u8],
}

/// Why a chunk was not taken.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum ChunkRefusal {
    /// It is no chunk, sealed, or malformed.
    #[error(transparent)]
    Malformed(#[from] DecodeError),
    /// The whole would be bigger than [`ReassemblyLimits::whole`].
    #[error("a whole of {total_size} bytes")]
    TooBig {
        /// Bytes it would have.
        total_size: u32,
    },
    /// Its TotalSize is not that of the chunks before.
    #[error("TotalSize {found} after {expected}")]
    TotalSize {
        /// What the first chunk said.
        expected: u32,
        /// What this one says.
        found: u32,
    },
    /// It came before.
    #[error("a chunk once more")]
    Duplicate,
    /// It covers a part of another chunk.
    #[error("a chunk over others")]
    Overlap,
    /// The whole has [`ReassemblyLimits::pieces`] already.
    #[error("too many chunks of one whole")]
    TooManyPieces,
}

/// What became of the chunks and wholes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub struct ReassemblyCounters {
    /// Wholes handed out.
    pub completed: u64,
    /// Chunks taken.
    pub chunks: u64,
    /// Chunks refused as [`ChunkRefusal::Malformed`].
    pub malformed: u64,
    /// Chunks refused as [`ChunkRefusal::TooBig`].
    pub too_big: u64,
    /// Chunks refused as [`ChunkRefusal::TotalSize`].
    pub total_size: u64,
    /// Chunks refused as [`ChunkRefusal::Duplicate`].
    pub duplicates: u64,
    /// Chunks refused as [`ChunkRefusal::Overlap`].
    pub overlaps: u64,
    /// Chunks refused as [`ChunkRefusal::TooManyPieces`].
    pub too_many_pieces: u64,
    /// Wholes given up because of [`ReassemblyLimits::age`].
    pub expired: u64,
    /// Wholes given up because of [`ReassemblyLimits::total`] or [`ReassemblyLimits::total_per_sender`].
    pub out_of_bytes: u64,
    /// Wholes given up because of [`ReassemblyLimits::open`] or [`ReassemblyLimits::open_per_sender`].
    pub out_of_places: u64,
    /// Wholes given up because of [`ReassemblyLimits::open_per_writer`].
    pub superseded: u64,
    /// Wholes given up because a chunk in the place of an earlier one had other bytes: the number is in use again.
    /// That chunk begins a new whole.
    pub contradicted: u64,
}

/// A whole that did not become complete.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct GivenUp<S = ()> {
    /// Where its chunks came from.
    pub sender: S,
    /// Who sent it, as it says.
    pub publisher_id: Option<OwnedPublisherId>,
    /// The WriterGroup.
    pub writer_group_id: Option<u16>,
    /// The DataSetWriter; `None` without payload header.
    pub writer_id: Option<u16>,
    /// The number of the whole among those of the DataSetWriter.
    pub message_sequence_number: u16,
    /// Bytes that had arrived.
    pub received: u32,
    /// Bytes it would have had.
    pub total_size: u32,
    /// Why it was not waited for any longer.
    pub why: GiveUp,
}

/// Why a whole was given up.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum GiveUp {
    /// [`ReassemblyLimits::age`] had passed.
    Expired,
    /// Its sender held most when [`ReassemblyLimits::total`] was reached, or reached
    /// [`ReassemblyLimits::total_per_sender`], and began it first.
    OutOfBytes,
    /// Its sender had most when [`ReassemblyLimits::open`] was reached, or reached
    /// [`ReassemblyLimits::open_per_sender`], and began it first.
    OutOfPlaces,
    /// [`ReassemblyLimits::open_per_writer`] was reached, and it was the writer's oldest.
    Superseded,
    /// A chunk in the place of an earlier one had other bytes.
    Contradicted,
}

/// What taking a chunk led to.
enum Step {
    Incomplete,
    /// The chunk is the whole.
    Alone,
    /// The whole stands in the buffer.
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
    /// As [`receive_from`](Reassembler::receive_from), where all chunks come from one sender.
    ///
    /// # Errors
    /// As there.
    pub fn receive<'r>(
        &'r mut self,
        message: &NetworkMessage<'r>,
        now: Duration,
    ) -> Result<Option<Reassembled<'r>>, ChunkRefusal> {
        self.receive_from((), message, now)
    }
}

impl<S> Reassembler<S> {
    /// Holds nothing. [`open`](ReassemblyLimits::open), [`open_per_sender`](ReassemblyLimits::open_per_sender) and
    /// [`open_per_writer`](ReassemblyLimits::open_per_writer) count as 1 when they are 0.
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

    /// Gives up the wholes that are too old.
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

    /// When [`expire`](Self::expire) has something to give up; `None` while no whole is incomplete.
    #[must_use]
    pub fn poll_timeout(&self) -> Option<Duration> {
        let oldest = self.open.front()?;
        Some(oldest.since.saturating_add(self.limits.age))
    }

    /// The next whole that was given up; to be asked after each [`receive_from`](Self::receive_from) and
    /// [`expire`](Self::expire) until there is none. No more than [`ReassemblyLimits::open`] are kept for who does not.
    pub fn poll_given_up(&mut self) -> Option<GivenUp<S>> {
        self.given_up.pop_front()
    }

    /// What became of the chunks and wholes so far.
    #[must_use]
    pub const fn counters(&self) -> &ReassemblyCounters {
        &self.counters
    }

    /// Bytes held for incomplete wholes with their bookkeeping, never more than [`ReassemblyLimits::total`]; the
    /// buffer of the last whole is not among them.
    #[must_use]
    pub const fn held(&self) -> usize {
        self.held
    }

    /// Moves out the buffer with the whole that was completed last; empty when that was a single chunk.
    #[must_use]
    pub fn take_whole(&mut self) -> Vec<u8> {
        std::mem::take(&mut self.whole)
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

    /// Refuses a chunk of the completed whole at `at`; else its number is in use again.
    fn forget_unless_same(&mut self, at: usize, chunk: &Chunk<'_>) -> Result<(), ChunkRefusal> {
        if self.done.get(at).is_some_and(|done| done.had(chunk)) {
            return Err(ChunkRefusal::Duplicate);
        }
        if let Some(done) = self.done.remove(at) {
            self.held -= done.cost();
        }
        Ok(())
    }

    fn remember(&mut self, done: Done<S>) {
        if self.done.len() >= self.limits.open {
            self.forget_oldest();
        }
        if self.held + done.cost() <= self.limits.total && self.done.len() < self.limits.open {
            self.held += done.cost();
            self.done.push_back(done);
        }
    }

    /// Makes the place of the oldest completed whole free; false when there is none.
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
        // One call gives up no more than were open, so that nothing is lost to who asks after each.
        if self.given_up.len() > self.limits.open {
            self.given_up.pop_front();
        }
        self.given_up.push_back(open.given_up(why));
    }
}

impl<S: Copy + Ord> Reassembler<S> {
    /// Takes a chunk; the whole when it was the last that was missing. `now` is the time since a start that is the
    /// same for all calls.
    ///
    /// # Errors
    /// [`ChunkRefusal`] when the chunk is not taken. It says nothing of the other chunks.
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
                self.remember(Done::alone(key.to_key(), &chunk, now));
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

    /// Puts the chunk into the whole at `at`; where the whole then stands.
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
            Insertion::Taken => {
                self.held += open.cost() - before;
                Ok(at)
            }
            Insertion::Duplicate => Err(ChunkRefusal::Duplicate),
            Insertion::Overlap => Err(ChunkRefusal::Overlap),
            Insertion::TooMany => Err(ChunkRefusal::TooManyPieces),
            Insertion::Contradiction => {
                self.give_up(at, GiveUp::Contradicted);
                self.begin(key, chunk, now)
            }
        }
    }

    /// Begins a whole with its first chunk; where it stands.
    fn begin(
        &mut self,
        key: &KeyRef<'_, S>,
        chunk: &Chunk<'_>,
        now: Duration,
    ) -> Result<usize, ChunkRefusal> {
        let mut open = Open::new(key.to_key(), chunk.total_size, now);
        if let Insertion::TooMany = open.insert(chunk, self.limits.pieces) {
            return Err(ChunkRefusal::TooManyPieces);
        }
        let of_writer = |other: &Open<S>| key.is_writer_of(&other.key);
        if self.open.iter().filter(|open| of_writer(open)).count() >= self.limits.open_per_writer
            && let Some(oldest) = self.open.iter().position(of_writer)
        {
            self.give_up(oldest, GiveUp::Superseded);
        }
        let of_sender = |other: &Open<S>| other.key.sender == key.sender;
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

    /// Forgets completed wholes, then gives up what the sender that holds most began first, until the rest fits; before
    /// that what `sender` began first, until what it holds is within its own limit.
    fn make_room(&mut self, sender: S) {
        let most = self.limits.total_per_sender;
        while self.held > most {
            let of_sender = |open: &&Open<S>| open.key.sender == sender;
            let held: usize = self.open.iter().filter(of_sender).map(Open::cost).sum();
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
            let Some(oldest) = self.oldest_of_greediest(sender, Open::cost) else {
                return;
            };
            self.give_up(oldest, GiveUp::OutOfBytes);
        }
    }

    /// What the sender began first of whose incomplete wholes `weight` gives the greatest sum. Of several it is `sender`:
    /// nobody makes place for who holds as much.
    fn oldest_of_greediest(&self, sender: S, weight: impl Fn(&Open<S>) -> usize) -> Option<usize> {
        let mut sums: BTreeMap<S, usize> = BTreeMap::new();
        for open in &self.open {
            *sums.entry(open.key.sender).or_default() += weight(open);
        }
        let most = sums.values().max()?;
        let greediest = |open: &Open<S>| sums.get(&open.key.sender) == Some(most);
        let own = |open: &Open<S>| open.key.sender == sender && greediest(open);
        let mut open = self.open.iter();
        let oldest = open.position(own);
        oldest.or_else(|| self.open.iter().position(greediest))
    }
}

impl<'r> Reassembled<'r> {
    /// Reads the header of the DataSetMessage.
    ///
    /// # Errors
    /// [`DecodeError::Misread`] for a discovery message, else as
    /// [`NetworkMessage::messages`] for a message that is malformed.
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

    /// A signed chunk of DataSetWriter 10: two bytes of a whole of four, and a signature of one byte.
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
