//! Reassembly of large messages of other spaces from their chunks.

use std::net::SocketAddr;
use std::time::{Duration, Instant};

use mappings::{PubSub, TopicId};
use uadp::{
    ChunkRefusal, GiveUp, IncompleteWhole, NetworkMessage, OwnedPublisherId, Reassembled,
    Reassembler, ReassemblyLimits,
};

use super::about::DropSite;
use super::values::TopicQueues;
use crate::counters::Reason;
use crate::network::number_of;
use crate::settings::Now;

/// The received chunks of large messages.
#[derive(Debug, Default)]
pub(super) struct Reassembly {
    /// `None` before the first chunk, and while a complete message is handled.
    chunks: Option<Box<TopicChunks>>,
}

/// The chunks of all topics.
#[derive(Debug)]
pub(super) struct TopicChunks {
    reassembler: Reassembler<SocketAddr>,
    /// The origin of time for the reassembler.
    start: Instant,
}

impl Reassembly {
    /// Takes the chunks out for the handling of a complete message, to avoid a copy.
    pub(super) fn take(&mut self, pubsub: &PubSub, now: Now) -> Box<TopicChunks> {
        let chunks = self.chunks.take();
        chunks.unwrap_or_else(|| Box::new(TopicChunks::new(pubsub, now.monotonic)))
    }

    /// Puts the chunks back, and counts the messages that were given up.
    pub(super) fn put_back(&mut self, mut chunks: Box<TopicChunks>, values: &mut TopicQueues) {
        chunks.count_given_up(values);
        self.chunks = Some(chunks);
    }

    /// Returns the time at which the oldest incomplete message expires.
    pub(super) fn due(&self) -> Option<Instant> {
        let chunks = self.chunks.as_ref()?;
        Some(chunks.start + chunks.reassembler.poll_timeout()?)
    }

    /// Gives up messages with overdue chunks.
    pub(super) fn expire(&mut self, values: &mut TopicQueues, now: Now) {
        if self.due() > Some(now.monotonic) {
            return;
        }
        if let Some(chunks) = &mut self.chunks {
            let since = chunks.since_start(now);
            chunks.reassembler.expire(since);
            chunks.count_given_up(values);
        }
    }

    /// Applies changed limits. If they differ, incomplete messages are given up.
    pub(super) fn renew(&mut self, values: &mut TopicQueues, before: &PubSub) {
        let limits = |pubsub: &PubSub| (pubsub.max_message, pubsub.receive_timeout);
        if limits(before) == limits(values.mapping.pubsub()) {
            return;
        }
        let chunks = self.chunks.take();
        if chunks.is_some_and(|chunks| chunks.reassembler.held() > 0) {
            values.count(DropSite::NOTHING, Reason::Incomplete, 1, || {
                "the mapping has other limits for large messages now".to_owned()
            });
        }
    }
}

impl TopicChunks {
    fn new(pubsub: &PubSub, start: Instant) -> Self {
        let whole = pubsub.max_message;
        let bytes = usize::try_from(whole).unwrap_or(usize::MAX);
        let limits = ReassemblyLimits {
            whole,
            // Per sender: two of the largest messages with their overhead, or very many smaller
            // messages. In total twice as much, so that a single sender does not displace messages
            // of other senders.
            total: bytes.saturating_mul(5),
            total_per_sender: bytes.saturating_mul(5) / 2,
            open: 2 * MAX_OPEN,
            open_per_sender: MAX_OPEN,
            // A message in progress, and a message with a lost chunk.
            open_per_writer: 2,
            pieces: bytes / LEAST_PIECE,
            age: pubsub.receive_timeout,
        };
        Self {
            reassembler: Reassembler::new(limits),
            start,
        }
    }

    fn since_start(&self, now: Now) -> Duration {
        now.monotonic.saturating_duration_since(self.start)
    }

    /// Stores a chunk, and returns the message if it is complete.
    pub(super) fn receive<'r>(
        &'r mut self,
        message: &NetworkMessage<'r>,
        from: SocketAddr,
        now: Now,
    ) -> Result<Option<Reassembled<'r>>, ChunkRefusal> {
        let since = self.since_start(now);
        self.reassembler.receive_from(from, message, since)
    }

    /// Frees the buffer of the last complete message.
    pub(super) fn free(&mut self) {
        drop(self.reassembler.take_whole());
    }

    fn count_given_up(&mut self, values: &mut TopicQueues) {
        while let Some(given_up) = self.reassembler.poll_given_up() {
            let reason = match given_up.why {
                GiveUp::Expired | GiveUp::Superseded | GiveUp::Contradicted => Reason::Incomplete,
                GiveUp::OutOfBytes | GiveUp::OutOfPlaces => Reason::NoRoom,
            };
            let about = DropSite {
                topic: topic_of(&given_up),
                from: Some(given_up.sender),
            };
            values.count(about, (reason, why(given_up.why)), 1, || {
                format!(
                    "received only {1} of the {0} bytes of a message ({2}); a larger receive buffer may help, see net.core.rmem_max",
                    given_up.total_size,
                    given_up.received,
                    why(given_up.why)
                )
            });
        }
    }
}

fn topic_of(given_up: &IncompleteWhole<SocketAddr>) -> Option<TopicId> {
    let publisher = given_up.publisher_id.as_ref().map(OwnedPublisherId::as_id);
    let (number, _) = number_of(publisher);
    let space = u16::try_from(number).ok()?;
    TopicId::new(space, given_up.writer_group_id?, given_up.writer_id?)
}

const fn why(why: GiveUp) -> &'static str {
    match why {
        GiveUp::Expired => "waited for until receive_timeout",
        GiveUp::Superseded => "two newer messages of its writer started",
        GiveUp::Contradicted => "its writer restarted",
        GiveUp::OutOfBytes => "unfinished messages of its sender reached the limit of bytes",
        GiveUp::OutOfPlaces => "too many messages of its sender were unfinished",
    }
}

pub(super) const fn reason_of(refusal: ChunkRefusal) -> Reason {
    if matches!(
        refusal,
        ChunkRefusal::TooBig { .. } | ChunkRefusal::TooManyPieces
    ) {
        Reason::TooBig
    } else if matches!(refusal, ChunkRefusal::Duplicate) {
        Reason::Duplicate
    } else {
        Reason::Malformed
    }
}

pub(super) const fn case_of(refusal: ChunkRefusal) -> &'static str {
    match refusal {
        ChunkRefusal::Malformed(error) => error.subject(),
        ChunkRefusal::TooBig { .. } => "total size",
        ChunkRefusal::TotalSize { .. } => "another total size",
        ChunkRefusal::Duplicate => "duplicate",
        ChunkRefusal::Overlap => "overlap",
        ChunkRefusal::TooManyPieces => "pieces",
        _ => "chunk",
    }
}

pub(super) fn told(refusal: ChunkRefusal, most: u32) -> String {
    if let ChunkRefusal::TooBig { total_size } = refusal {
        format!("a message of {total_size} bytes; `pubsub.max_message` allows {most} MiB")
    } else {
        refusal.to_string()
    }
}

/// The maximum number of incomplete messages per sender. Datagrams of this many large topics may be
/// interleaved.
const MAX_OPEN: usize = 512;
/// The minimum average number of bytes per chunk: the smallest datagram without its headers.
const LEAST_PIECE: usize = 256;
