//! Requests and responses that are larger than a datagram: split into chunks, and sent at the pace
//! of all chunks.

use std::collections::{BTreeMap, VecDeque};

use mappings::TopicId;
use uadp::action::{ActionKind, ActionToSend};
use uadp::{
    ChunkBudget, ChunkEncoder, ChunkError, Extras, GroupHeader, NetworkHeader, NetworkMessageType,
    PublisherId, Whole,
};

/// The messages to send in chunks. Each request or response is queued at most once, so the queue is
/// limited by the state of the Requestor and the Responder.
#[derive(Debug, Default)]
pub(super) struct Chunking {
    /// Messages in the order in which they were due. They are sent one after another, because a
    /// receiver stores few incomplete messages per sender.
    waiting: VecDeque<Large>,
    /// The last assigned MessageSequenceNumber.
    next: u16,
    /// The assigned MessageSequenceNumbers for repetitions, and their messages in the order of
    /// assignment.
    numbers: BTreeMap<Of, u16>,
    given: VecDeque<Of>,
    /// Whether the queue has given way to a chunk of a value after its last chunk.
    pub(super) gave_way: bool,
}

/// Identifies a message by the number of its call.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Of {
    Request(u64),
    Response(u64),
}

/// A message that is sent in chunks.
#[derive(Debug)]
struct Large {
    topic: TopicId,
    of: Of,
    number: u16,
    bytes: Vec<u8>,
    offset: usize,
}

impl Of {
    pub(super) const fn message(action: &ActionToSend<'_>) -> Self {
        match action.action.kind {
            ActionKind::Request => Self::Request(action.call),
            ActionKind::Response => Self::Response(action.call),
        }
    }
}

impl Chunking {
    pub(super) fn is_empty(&self) -> bool {
        self.waiting.is_empty()
    }

    /// Queues a message, unless a message of the same call is still queued. A repetition has the
    /// MessageSequenceNumber of the first transmission, so that its chunks replace lost chunks
    /// (OPC 10000-14, 7.2.4.4.4).
    pub(super) fn push(&mut self, topic: TopicId, of: Of, bytes: Vec<u8>) {
        if self.waiting.iter().any(|large| large.of == of) {
            return;
        }
        let number = match self.numbers.get(&of) {
            Some(number) => *number,
            None => self.give(of),
        };
        self.waiting.push_back(Large {
            topic,
            of,
            number,
            bytes,
            offset: 0,
        });
    }

    fn give(&mut self, of: Of) -> u16 {
        if self.given.len() >= MOST_NUMBERS
            && let Some(oldest) = self.given.pop_front()
        {
            self.numbers.remove(&oldest);
        }
        self.next = self.next.wrapping_add(1);
        self.numbers.insert(of, self.next);
        self.given.push_back(of);
        self.next
    }

    /// Appends the next chunk.
    pub(super) fn write(
        &mut self,
        most: usize,
        start: &NetworkHeader<'_>,
        out: &mut Vec<u8>,
    ) -> Option<(TopicId, Result<(), ChunkError>)> {
        let large = self.waiting.front_mut()?;
        let topic = large.topic;
        let written = large.write(most, start, out);
        if written.is_err() || large.offset >= large.bytes.len() {
            self.waiting.pop_front();
        }
        Some((topic, written))
    }
}

impl Large {
    /// Appends the next chunk. The whole NetworkMessage is split, because it contains the
    /// ActionHeader (OPC 10000-14, 7.2.4.4.4).
    fn write(
        &mut self,
        most: usize,
        start: &NetworkHeader<'_>,
        out: &mut Vec<u8>,
    ) -> Result<(), ChunkError> {
        let (space, namespace, _) = self.topic.triple();
        let header = NetworkHeader {
            publisher_id: Some(PublisherId::UInt16(space)),
            group: Some(GroupHeader {
                writer_group_id: Some(namespace),
                ..GroupHeader::default()
            }),
            ..*start
        };
        let whole = Whole {
            message_type: NetworkMessageType::DataSet,
            writer_id: None,
            message_sequence_number: self.number,
            bytes: &self.bytes,
        };
        let budget = ChunkBudget {
            network_message: most,
            trailer: 0,
        };
        let extras = Extras::default();
        let mut chunks =
            ChunkEncoder::new(&header, &extras, whole, budget)?.resumed_at(self.offset);
        chunks.append(out, &extras).transpose()?;
        self.offset = chunks.offset();
        Ok(())
    }
}

/// The maximum number of stored MessageSequenceNumbers. It exceeds the number of calls that wait
/// for a response at the same time.
const MOST_NUMBERS: usize = 2_048;
