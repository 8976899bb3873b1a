//! Announcements of topics of the own space, and probes, as outputs.

use mappings::{SpaceId, TopicId};
use uadp::discovery::{AnnouncedContent, Announcement, DataSetMetaDataType, Probe};
use uadp::{PublisherId, SecurityHeader};

use super::about::DropSite;
use super::values::TopicQueues;
use crate::counters::Reason;
use crate::network::announcement_chunks;
use crate::output::Output;
use crate::settings::Now;
use crate::topic::Topic;

impl TopicQueues {
    /// Sends the announcement of a topic of the own space.
    pub(super) fn announce(&mut self, topic: TopicId, sequence_number: u16, now: Now) {
        if self.is_withheld(topic) {
            return;
        }
        let mut bytes = self.buffer();
        let Some(Topic {
            description: Some(description),
            counters,
            ..
        }) = self.topics.get_mut(&topic)
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
        let (max_datagram, _) = self.sizes();
        if bytes.len() <= usize::from(max_datagram) {
            self.tell(Output::Discovery { bytes });
            return;
        }
        let body = bytes.get(body_at..).unwrap_or_default();
        match announcement_chunks(topic.space, sequence_number, body, (max_datagram, now.utc)) {
            Ok(chunks) => {
                for bytes in chunks {
                    self.tell(Output::Discovery { bytes });
                }
            }
            Err(error) => self.count(DropSite::topic(topic), Reason::TooBig, 1, || {
                error.to_string()
            }),
        }
        self.recycle(bytes);
    }

    /// Responds to a probe for a DataSetWriter that does not exist.
    pub(super) fn deny(&mut self, writer_id: u16, sequence_number: u16) {
        let announcement = Announcement {
            sequence_number,
            announced: AnnouncedContent::DataSetMetaData {
                writer_id,
                meta_data: DataSetMetaDataType::default(),
                status: BAD_NOT_FOUND,
            },
        };
        let mut bytes = self.buffer();
        let publisher = PublisherId::UInt16(self.settings.own.into());
        if announcement
            .encode(publisher, SecurityHeader::NONE, &mut bytes)
            .is_ok()
        {
            self.tell(Output::Discovery { bytes });
        }
    }

    /// Sends a probe to a Publisher, or to all applications.
    pub(super) fn send_probe(&mut self, probe: &Probe<'_>, space: Option<SpaceId>) {
        let mut bytes = self.buffer();
        let publisher = space.map(|space| PublisherId::UInt16(space.into()));
        if probe
            .encode(publisher, SecurityHeader::NONE, &mut bytes)
            .is_ok()
        {
            self.tell(Output::Discovery { bytes });
        }
    }
}

/// Bad_NotFound (OPC 10000-6, A.2).
pub(super) const BAD_NOT_FOUND: uadp::StatusCode = uadp::StatusCode(0x803E_0000);
