//! Large messages of other spaces.

use std::net::SocketAddr;

use mappings::{SpaceId, TopicId};
use uadp::discovery::Announcement;
use uadp::{DecodeError, NetworkMessage, NetworkMessageType};

use super::reassembly::{case_of, reason_of, told};
use super::receive::sent;
use super::{DropSite, Router, TopicQueues};
use crate::counters::Reason;
use crate::settings::Now;

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
                .count(DropSite::sender(from), Reason::NotInSpace, 1, String::new);
            return;
        }
        if topic.is_some_and(|topic| !self.values.hear(topic, from, now)) {
            return;
        }
        // Taken out of `self` during the handling of the complete message, to avoid a copy.
        let mut chunks = self.reassembly.take(self.values.mapping.pubsub(), now);
        let received = chunks.receive(message, from, now);
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
                    Ok(message) if self.security.is_smuggled(&message, namespace) => {
                        let cause = (Reason::Unsecured, "in chunks");
                        self.values.count(DropSite::sender(from), cause, 1, || {
                            "a message of a secured group in chunks of another".to_owned()
                        });
                    }
                    Ok(message) => self.handle_network_message(&message, from, now),
                    Err(error) => self.values.drop_undecoded(None, from, &error),
                },
            },
            Err(refusal) => {
                let about = DropSite {
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
            chunks.free();
        }
        self.reassembly.put_back(chunks, &mut self.values);
    }
}

impl TopicQueues {
    /// Records a message of the writer of a topic. Returns false if there is no room for the topic.
    fn hear(&mut self, topic: TopicId, from: SocketAddr, now: Now) -> bool {
        let Some(at) = self.entry(topic, from, now) else {
            return false;
        };
        let Some(reader) = self.topics.reader(at) else {
            return false;
        };
        reader.heard(now.monotonic);
        if reader.lives(now.monotonic) {
            self.tell_returned(at);
        }
        true
    }
}

/// The maximum size of a buffer that is reused for complete messages. It exceeds the size of
/// images.
const MAX_SPARE: usize = 16 << 20;
const CHUNK_IN_CHUNKS: DecodeError = DecodeError::Misread("a chunk in chunks");
