//! The reports of a program at the broker: its status, and the retained messages of earlier runs.

use std::collections::{BTreeMap, BTreeSet};
use std::time::{Duration, Instant};

use uadp::discovery::{
    AnnouncedContent, Announcement, ConnectionState, CyclicStatus, DataSetWriterDataType,
    PubSubConnectionDataType, PubSubGroupDataType, WireArray, WriterGroupDataType,
};
use uadp::{DateTime, PublisherId, Scalar, SecurityHeader, Timestamp, Variant};

use crate::topics::Address;

/// The own status, and topics to clear.
#[derive(Debug, Default)]
pub(crate) struct BrokerReports {
    next_status: Option<Instant>,
    /// Whether the broker reports the end of the program, so that the status is not cyclic.
    has_will: bool,
    sequence: u16,
    /// Retained topics of the own PublisherId that this run did not publish, and the time at which
    /// they are cleared.
    strays: BTreeMap<String, Instant>,
    /// The own groups and their writers.
    groups: BTreeMap<u16, BTreeSet<u16>>,
    /// The time at which the connection is announced, because a writer was added.
    connection_due: Option<Instant>,
}

impl BrokerReports {
    pub(crate) fn new(has_will: bool) -> Self {
        Self {
            has_will,
            ..Self::default()
        }
    }

    /// Returns the status of a program that failed.
    pub(crate) fn failed(&mut self, publisher: u16) -> Option<Vec<u8>> {
        self.encode(publisher, ConnectionState::ERROR, None)
    }

    /// Returns the status to publish, if it is due.
    pub(crate) fn status(
        &mut self,
        publisher: u16,
        (now, utc): (Instant, Timestamp),
    ) -> Option<Vec<u8>> {
        if self.next_status.is_some_and(|next| next > now) {
            return None;
        }
        if self.has_will {
            // A broker may have lost the retained status.
            self.next_status = Some(now + STATUS_REPEATED);
            return self.encode(publisher, ConnectionState::OPERATIONAL, None);
        }
        self.next_status = Some(now + STATUS_PERIOD);
        let period = i64::try_from(STATUS_PERIOD.as_nanos() / 100).unwrap_or(i64::MAX);
        let cyclic = CyclicStatus {
            next_report_time: DateTime(utc.time.0.saturating_add(period)),
            timestamp: utc.time,
        };
        self.encode(publisher, ConnectionState::OPERATIONAL, Some(cyclic))
    }

    /// Returns the last status. Another program of the PublisherId, if there is one, replaces it.
    pub(crate) fn last_status(&mut self, publisher: u16) -> Option<Vec<u8>> {
        self.encode(publisher, ConnectionState::DISABLED, None)
    }

    /// Records the writer of an own value.
    pub(crate) fn uses(&mut self, address: Address, now: Instant) {
        let (Some(group), Some(writer)) = (address.group, address.writer) else {
            return;
        };
        let known: usize = self.groups.values().map(BTreeSet::len).sum();
        if known < MAX_WRITERS && self.groups.entry(group).or_default().insert(writer) {
            self.connection_due.get_or_insert(now + SETTLE);
        }
    }

    /// Returns the announcement of the connection with its groups and writers, if writers were
    /// added (OPC 10000-14, 7.3.4.7).
    pub(crate) fn connection(&mut self, publisher: u16, now: Instant) -> Option<Vec<u8>> {
        self.connection_due.take_if(|due| *due <= now)?;
        let name = |id: &u16| id.to_string();
        let names: Vec<NamedGroup> = self
            .groups
            .iter()
            .map(|(group, writers)| {
                let writers = writers.iter().map(|writer| (*writer, name(writer)));
                (*group, name(group), writers.collect())
            })
            .collect();
        let writers: Vec<Vec<DataSetWriterDataType<'_>>> = names
            .iter()
            .map(|(_, _, writers)| {
                writers
                    .iter()
                    .map(|(id, name)| DataSetWriterDataType {
                        name: Some(name),
                        enabled: true,
                        data_set_writer_id: *id,
                        ..DataSetWriterDataType::default()
                    })
                    .collect()
            })
            .collect();
        let groups: Vec<WriterGroupDataType<'_>> = names
            .iter()
            .zip(&writers)
            .map(|((id, name, _), writers)| WriterGroupDataType {
                group: PubSubGroupDataType {
                    name: Some(name),
                    enabled: true,
                    ..PubSubGroupDataType::default()
                },
                writer_group_id: *id,
                data_set_writers: WireArray::new(writers),
                ..WriterGroupDataType::default()
            })
            .collect();
        let connection_name = name(&publisher);
        let connections = [PubSubConnectionDataType {
            name: Some(&connection_name),
            enabled: true,
            publisher_id: Variant::Scalar(Scalar::UInt16(publisher)),
            transport_profile_uri: Some(PROFILE),
            writer_groups: WireArray::new(&groups),
            ..PubSubConnectionDataType::default()
        }];
        self.sequence = self.sequence.wrapping_add(1);
        let announcement = Announcement {
            sequence_number: self.sequence,
            announced: AnnouncedContent::PubSubConnections(WireArray::new(&connections)),
        };
        let mut bytes = Vec::new();
        announcement
            .encode(
                PublisherId::UInt16(publisher),
                SecurityHeader::NONE,
                &mut bytes,
            )
            .ok()?;
        Some(bytes)
    }

    /// Publishes the status again at the next opportunity.
    pub(crate) const fn hurry(&mut self) {
        self.next_status = None;
    }

    fn encode(
        &mut self,
        publisher: u16,
        state: ConnectionState,
        cyclic: Option<CyclicStatus>,
    ) -> Option<Vec<u8>> {
        self.sequence = self.sequence.wrapping_add(1);
        let announcement = Announcement {
            sequence_number: self.sequence,
            announced: AnnouncedContent::ApplicationStatus { state, cyclic },
        };
        let mut bytes = Vec::new();
        let publisher = PublisherId::UInt16(publisher);
        announcement
            .encode(publisher, SecurityHeader::NONE, &mut bytes)
            .ok()?;
        Some(bytes)
    }

    /// Records a retained topic of the own PublisherId.
    pub(crate) fn stray(&mut self, topic: &str, now: Instant) {
        if self.strays.len() < MAX_STRAYS {
            let at = self.strays.entry(topic.to_owned());
            at.or_insert(now + STRAY);
        }
    }

    /// Returns the stray topics that are due.
    pub(crate) fn take_strays(&mut self, now: Instant) -> Vec<String> {
        let due = self.strays.iter().filter(|(_, at)| **at <= now);
        let due: Vec<String> = due.map(|(topic, _)| topic.clone()).collect();
        for topic in &due {
            self.strays.remove(topic);
        }
        due
    }
}

/// A group with its name, and its writers with their names.
type NamedGroup = (u16, String, Vec<(u16, String)>);

/// The interval of the status.
const STATUS_PERIOD: Duration = Duration::from_secs(2);
/// The interval of a status that is not cyclic.
const STATUS_REPEATED: Duration = Duration::from_secs(30);
/// The time in which a program announces its topics after its start.
const STRAY: Duration = Duration::from_secs(60);
const MAX_STRAYS: usize = 16_384;
/// The time in which further writers are collected.
const SETTLE: Duration = Duration::from_secs(1);
const MAX_WRITERS: usize = 8192;
const PROFILE: &str = "http://opcfoundation.org/UA-Profile/Transport/pubsub-mqtt-uadp";

#[cfg(test)]
mod tests {
    use uadp::NetworkMessage;

    use super::*;
    use crate::topics::TopicMessageType;

    #[test]
    #[expect(clippy::disallowed_methods, reason = "some instant to count from")]
    fn a_program_with_a_will_has_no_cyclic_status() {
        let (now, utc) = (Instant::now(), Timestamp::from_unix_nanos(0));
        for has_will in [false, true] {
            let mut reports = BrokerReports::new(has_will);
            let bytes = reports.status(1, (now, utc)).unwrap();
            let status = NetworkMessage::decode(&bytes).unwrap();
            let (state, cyclic) = crate::address::status(&status).unwrap();
            assert_eq!(state, ConnectionState::OPERATIONAL);
            assert_eq!(cyclic.is_some(), !has_will);
            let next = reports.status(1, (now + STATUS_PERIOD, utc));
            assert_eq!(next.is_some(), !has_will);
            assert!(reports.status(1, (now + STATUS_REPEATED, utc)).is_some());
        }
    }

    #[test]
    #[expect(clippy::disallowed_methods, reason = "some instant to count from")]
    fn the_connection_names_groups_and_writers_by_their_decimal_ids() {
        let mut reports = BrokerReports::default();
        let now = Instant::now();
        assert_eq!(reports.connection(1, now), None);
        for writer in [11, 10, 11] {
            let address = Address {
                kind: TopicMessageType::Data,
                publisher: 1,
                group: Some(2),
                writer: Some(writer),
            };
            reports.uses(address, now);
        }
        assert_eq!(reports.connection(1, now), None);
        let bytes = reports.connection(1, now + SETTLE).unwrap();
        let message = NetworkMessage::decode(&bytes).unwrap();
        let AnnouncedContent::PubSubConnections(connections) =
            Announcement::decode(&message).unwrap().announced
        else {
            panic!("another announcement");
        };
        let connection = connections.iter().next().unwrap();
        let group = connection.writer_groups.iter().next().unwrap();
        assert_eq!((group.group.name, group.writer_group_id), (Some("2"), 2));
        let writers = group
            .data_set_writers
            .iter()
            .map(|of| of.name.map(str::to_owned));
        assert_eq!(
            writers.collect::<Vec<_>>(),
            [Some("10".to_owned()), Some("11".to_owned())]
        );
        assert_eq!(reports.connection(1, now + SETTLE), None);
    }
}
