//! Announcements of the metadata of topics of the own space.

use mappings::TopicId;
use messages::{MessageType, Selection};
use uadp::discovery::{Announced, Announcement, DataSetMetaDataType};
use uadp::{PublisherId, SecurityHeader};

use super::{About, Router};
use crate::counters::Reason;
use crate::description::{Description, Source, mapped_leaves};
use crate::network::announcement_chunks;
use crate::output::Output;
use crate::settings::Now;
use crate::topic::{Role, Topic};

impl Router {
    /// Announces a topic of the own space with a known type, and again after each change. Without
    /// `message` the mapping or the local side describes the topic.
    pub(super) fn describe(
        &mut self,
        topic: TopicId,
        message: Option<(&MessageType, &Selection)>,
        now: Now,
    ) {
        let period = self.values.mapping.pubsub().metadata_period;
        let Some(Topic {
            plan,
            said,
            description,
            announce_at,
            ..
        }) = self.values.topics.get_mut(&topic)
        else {
            return;
        };
        let said = said.as_deref();
        let variable = self
            .values
            .mapping
            .variable(topic)
            .filter(|_| said.is_none());
        let mapped = match (message, variable) {
            (None, Some(variable)) => mapped_leaves(variable),
            (Some(_), _) | (None, None) => Vec::new(),
        };
        let leaves = match (message, plan) {
            (Some(_), Some(plan)) => plan.leaves(),
            (None, _) if said.is_some() => said.map_or(&[][..], |said| &said.fields),
            (None, _) if !mapped.is_empty() => &mapped,
            (Some(_), None) => return,
            (None, _) => {
                // Neither the mapping nor the local side describes the fields any more.
                return self.forget_described(topic);
            }
        };
        let source = Source {
            topic,
            message,
            leaves,
            variable,
            said,
            namespaces: self.values.mapping.namespaces(),
        };
        match Description::new(source, description.as_deref(), now.utc) {
            Ok(new) if new.differs(description.as_deref()) => {
                *description = Some(Box::new(new));
                *announce_at = Some(now.monotonic + period);
            }
            Ok(_) => return,
            Err(error) => {
                *description = None;
                self.values
                    .count(About::topic(topic), Reason::MetaData, 1, || {
                        format!("what it consists of cannot be announced: {error}")
                    });
                return;
            }
        }
        let (_, namespace, writer_id) = topic.triple();
        let discovery = self.discovery(now);
        let topics = discovery.writers.entry(writer_id).or_default();
        if !topics.contains(&topic) {
            topics.push(topic);
        }
        discovery.announcer.add_writer(namespace, writer_id);
        discovery.plan(topic, now);
        self.values.schedule(topic);
    }

    /// Plans the next announcement of a topic, if it is due and the topic has a producer.
    pub(super) fn announce_again(&mut self, topic: TopicId, now: Now) {
        let period = self.values.mapping.pubsub().metadata_period;
        let Some(Topic {
            role: Role::Ours(writer),
            announce_at: Some(at),
            ..
        }) = self.values.topics.get_mut(&topic)
        else {
            return;
        };
        if *at > now.monotonic {
            return;
        }
        *at = now.monotonic + period;
        if writer.is_live() {
            self.discovery(now).plan(topic, now);
        }
    }

    pub(super) fn announce(&mut self, topic: TopicId, sequence_number: u16, now: Now) {
        if self.values.is_withheld(topic) {
            return;
        }
        let mut bytes = self.values.buffer();
        let Some(Topic {
            description: Some(description),
            counters,
            ..
        }) = self.values.topics.get_mut(&topic)
        else {
            return;
        };
        let body_at = description.write(sequence_number, &mut bytes);
        counters.announced += 1;
        self.send_announcement(topic, sequence_number, (bytes, body_at), now);
    }

    /// Sends an announcement about a topic, in chunks if it is larger than a datagram.
    pub(super) fn send_announcement(
        &mut self,
        topic: TopicId,
        sequence_number: u16,
        (bytes, body_at): (Vec<u8>, usize),
        now: Now,
    ) {
        let (max_datagram, _) = self.values.sizes();
        if bytes.len() <= usize::from(max_datagram) {
            self.values.tell(Output::Discovery { bytes });
            return;
        }
        let body = bytes.get(body_at..).unwrap_or_default();
        match announcement_chunks(topic.space, sequence_number, body, (max_datagram, now.utc)) {
            Ok(chunks) => {
                for bytes in chunks {
                    self.values.tell(Output::Discovery { bytes });
                }
            }
            Err(error) => self
                .values
                .count(About::topic(topic), Reason::TooBig, 1, || error.to_string()),
        }
        self.values.recycle(bytes);
    }

    /// Responds to a probe for a DataSetWriter that does not exist.
    pub(super) fn deny(&mut self, writer_id: u16, sequence_number: u16) {
        let announcement = Announcement {
            sequence_number,
            announced: Announced::DataSetMetaData {
                writer_id,
                meta_data: DataSetMetaDataType::default(),
                status: BAD_NOT_FOUND,
            },
        };
        let mut bytes = self.values.buffer();
        let publisher = PublisherId::UInt16(self.values.settings.own.into());
        if announcement
            .encode(publisher, SecurityHeader::NONE, &mut bytes)
            .is_ok()
        {
            self.values.tell(Output::Discovery { bytes });
        }
    }
}

/// Bad_NotFound (OPC 10000-6, A.2).
pub(super) const BAD_NOT_FOUND: uadp::StatusCode = uadp::StatusCode(0x803E_0000);
