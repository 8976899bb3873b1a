//! Large messages of other spaces, reassembled from their chunks.

use std::net::SocketAddr;
use std::time::{Duration, Instant};

use mappings::{PubSub, SpaceId, TopicId};
use uadp::discovery::Announcement;
use uadp::{
    ChunkRefusal, DecodeError, GiveUp, GivenUp, NetworkMessage, NetworkMessageType,
    OwnedPublisherId, Reassembler, ReassemblyLimits,
};

use super::receive::{number_of, sent};
use super::{About, Router, Values};
use crate::counters::Reason;
use crate::settings::Now;
use crate::topic::{Role, Topic};

/// The chunks of all topics.
#[derive(Debug)]
pub(super) struct Chunks {
    reassembler: Reassembler<SocketAddr>,
    /// The origin of time for the reassembler.
    start: Instant,
}

impl Chunks {
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

    /// Returns whether a message is incomplete.
    pub(super) const fn is_open(&self) -> bool {
        self.reassembler.held() > 0
    }

    /// Returns the time at which the oldest incomplete message expires.
    pub(super) fn due(&self) -> Option<Instant> {
        Some(self.start + self.reassembler.poll_timeout()?)
    }

    fn since_start(&self, now: Now) -> Duration {
        now.monotonic.saturating_duration_since(self.start)
    }
}

impl Router {
    /// Stores a chunk of another space. A complete message is handled as any other message.
    pub(super) fn handle_chunk(
        &mut self,
        message: &NetworkMessage<'_>,
        (space, namespace): (SpaceId, u16),
        from: SocketAddr,
        now: Now,
    ) {
        let writer_id = message.writer_ids().and_then(|mut ids| ids.next());
        let topic = writer_id.and_then(|id| TopicId::new(u16::from(space.get()), namespace, id));
        if writer_id.is_some() && topic.is_none() {
            self.values
                .count(About::sender(from), Reason::NotInSpace, 1, String::new);
            return;
        }
        if topic.is_some_and(|topic| !self.values.hear(topic, from, now)) {
            return;
        }
        // Taken out of `self` during the handling of the complete message, to avoid a copy.
        let mut chunks = self
            .chunks
            .take()
            .unwrap_or_else(|| Box::new(Chunks::new(self.values.mapping.pubsub(), now.monotonic)));
        let since = chunks.since_start(now);
        let received = chunks.reassembler.receive_from(from, message, since);
        let large = matches!(&received, Ok(Some(whole)) if whole.bytes.len() > MAX_SPARE);
        match received {
            Ok(None) => {}
            Ok(Some(whole)) if whole.message_type == NetworkMessageType::Announcement => {
                match Announcement::decode_body(whole.bytes) {
                    Ok(announcement) => self.learn(&announcement, (space, from), now),
                    Err(error) => self.values.drop_undecoded(None, from, &error),
                }
            }
            Ok(Some(whole)) => match topic {
                Some(topic) => match whole.data_set_message() {
                    Ok(message) => {
                        self.values.handle_message(
                            topic,
                            &message,
                            (from, sent(&whole.header)),
                            now,
                        );
                    }
                    Err(error) => self.values.drop_undecoded(Some(topic), from, &error),
                },
                // Without a payload header the chunks contain an encoded NetworkMessage.
                None => match NetworkMessage::decode(whole.bytes) {
                    Ok(message) if message.is_chunk() => {
                        self.values.drop_undecoded(None, from, &CHUNK_IN_CHUNKS);
                    }
                    Ok(message) if self.is_smuggled(&message, namespace) => {
                        let cause = (Reason::Unsecured, "in chunks");
                        self.values.count(About::sender(from), cause, 1, || {
                            "a message of a secured group in chunks of another".to_owned()
                        });
                    }
                    Ok(message) => self.handle_network_message(&message, from, now),
                    Err(error) => self.values.drop_undecoded(None, from, &error),
                },
            },
            Err(refusal) => {
                let about = About {
                    topic,
                    from: Some(from),
                };
                let most = self.values.mapping.pubsub().max_message >> 20;
                let cause = (reason_of(refusal), case_of(refusal));
                self.values.count(about, cause, 1, || told(refusal, most));
            }
        }
        if large {
            // The buffer is freed, because another message of this size may never be received.
            drop(chunks.reassembler.take_whole());
        }
        self.count_given_up(&mut chunks.reassembler);
        self.chunks = Some(chunks);
    }

    /// Returns whether a message was sent in chunks of a namespace with another security than its
    /// own namespace.
    fn is_smuggled(&self, message: &NetworkMessage<'_>, chunked_in: u16) -> bool {
        let Some(guard) = &self.guard else {
            return false;
        };
        let data = message.message_type() == NetworkMessageType::DataSet;
        let namespace = message.group().and_then(|group| group.writer_group_id);
        let alike = namespace.is_some_and(|namespace| guard.is_alike(namespace, chunked_in));
        !data || !alike
    }

    /// Gives up messages with overdue chunks.
    pub(super) fn expire_chunks(&mut self, now: Now) {
        if self.chunks.as_ref().and_then(|chunks| chunks.due()) > Some(now.monotonic) {
            return;
        }
        if let Some(mut chunks) = self.chunks.take() {
            let since = chunks.since_start(now);
            chunks.reassembler.expire(since);
            self.count_given_up(&mut chunks.reassembler);
            self.chunks = Some(chunks);
        }
    }

    fn count_given_up(&mut self, reassembler: &mut Reassembler<SocketAddr>) {
        while let Some(given_up) = reassembler.poll_given_up() {
            let reason = match given_up.why {
                GiveUp::Expired | GiveUp::Superseded | GiveUp::Contradicted => Reason::Incomplete,
                GiveUp::OutOfBytes | GiveUp::OutOfPlaces => Reason::NoRoom,
            };
            let about = About {
                topic: topic_of(&given_up),
                from: Some(given_up.sender),
            };
            self.values.count(about, (reason, why(given_up.why)), 1, || {
                format!(
                    "of a message of {} bytes only {} came ({}); a larger receive buffer may help, see \
                     net.core.rmem_max",
                    given_up.total_size,
                    given_up.received,
                    why(given_up.why)
                )
            });
        }
    }
}

impl Values {
    /// Records a message of the writer of a topic. Returns false if there is no room for the topic.
    fn hear(&mut self, topic: TopicId, from: SocketAddr, now: Now) -> bool {
        let Some(Topic {
            role: Role::Theirs(reader),
            ..
        }) = self.entry(topic, from, now)
        else {
            return false;
        };
        reader.heard(now.monotonic);
        if reader.lives(now.monotonic) {
            self.tell_returned(topic);
        }
        true
    }
}

fn topic_of(given_up: &GivenUp<SocketAddr>) -> Option<TopicId> {
    let publisher = given_up.publisher_id.as_ref().map(OwnedPublisherId::as_id);
    let (number, _) = number_of(publisher);
    let space = u16::try_from(number).ok()?;
    TopicId::new(space, given_up.writer_group_id?, given_up.writer_id?)
}

const fn why(why: GiveUp) -> &'static str {
    match why {
        GiveUp::Expired => "waited for until receive_timeout",
        GiveUp::Superseded => "two newer ones of its writer were begun",
        GiveUp::Contradicted => "its writer started over",
        GiveUp::OutOfBytes => "unfinished messages of its sender took up all the bytes for them",
        GiveUp::OutOfPlaces => "too many messages of its sender were unfinished",
    }
}

const fn reason_of(refusal: ChunkRefusal) -> Reason {
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

const fn case_of(refusal: ChunkRefusal) -> &'static str {
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

fn told(refusal: ChunkRefusal, most: u32) -> String {
    if let ChunkRefusal::TooBig { total_size } = refusal {
        format!("a message of {total_size} bytes; `pubsub.max_message` allows {most} MiB")
    } else {
        refusal.to_string()
    }
}

/// The maximum size of a buffer that is reused for complete messages. It exceeds the size of
/// images.
const MAX_SPARE: usize = 16 << 20;
const CHUNK_IN_CHUNKS: DecodeError = DecodeError::Misread("a chunk in chunks");
/// The maximum number of incomplete messages per sender. Datagrams of this many large topics may be
/// interleaved.
const MAX_OPEN: usize = 512;
/// The minimum average number of bytes per chunk: the smallest datagram without its headers.
const LEAST_PIECE: usize = 256;
