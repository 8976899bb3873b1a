//! The other participants of the domain: their endpoints, by topic.
//!
//! RustDDS reports discovery as events too, but on a channel that drops events when it is full, and
//! its graph events name built-in entities. A snapshot of its database is complete at that moment.

use std::collections::{BTreeMap, BTreeSet};
use std::ops::RangeInclusive;
use std::sync::Arc;

use messages::TypeHash;
use rustdds::discovery::{DiscoveredReaderData, DiscoveredWriterData};
use rustdds::policy::{Durability, Reliability};
use rustdds::{DomainParticipant, GUID, QosPolicies, RTPSEntity};

use crate::node::ParticipantPrefix;

/// A writer or reader of another participant.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RemoteEndpoint {
    /// The GUID of the endpoint.
    pub guid: GUID,
    /// The DDS name of its type, such as `std_msgs::msg::dds_::String_`.
    pub type_name: String,
    /// Offered (writer) or requested (reader) reliability.
    pub reliable: bool,
    /// Offered or requested durability is transient-local or stronger.
    pub transient_local: bool,
    /// The hash of its type, which nodes announce since ROS 2 Iron.
    pub type_hash: Option<TypeHash>,
    /// All offered or requested policies.
    pub qos: Arc<QosPolicies>,
}

impl RemoteEndpoint {
    /// Returns a discovered writer and its DDS topic.
    pub(crate) fn of_writer(writer: DiscoveredWriterData) -> (String, Self) {
        let data = writer.publication_topic_data;
        let qos = Arc::new(data.qos());
        let endpoint = Self {
            guid: writer.writer_proxy.remote_writer_guid,
            type_name: data.type_name,
            // The default of a writer is reliable, the default of a reader is best effort (DDS 1.4,
            // 2.2.3.14).
            reliable: data.reliability != Some(Reliability::BestEffort),
            transient_local: is_durable(data.durability),
            type_hash: type_hash(&writer.user_data),
            qos,
        };
        (data.topic_name, endpoint)
    }

    /// Returns a discovered reader and its DDS topic.
    pub(crate) fn of_reader(reader: DiscoveredReaderData) -> (String, Self) {
        let data = reader.subscription_topic_data;
        let qos = data.qos();
        let endpoint = Self {
            guid: reader.reader_proxy.remote_reader_guid,
            type_name: data.type_name().clone(),
            reliable: matches!(qos.reliability(), Some(Reliability::Reliable { .. })),
            transient_local: is_durable(qos.durability()),
            type_hash: type_hash(&reader.user_data),
            qos: Arc::new(qos),
        };
        (data.topic_name().clone(), endpoint)
    }

    /// Returns whether the endpoint has the type, and the definition with the hash. An unknown hash
    /// on either side matches.
    #[must_use]
    pub fn is_of(&self, dds_type: &str, hash: Option<TypeHash>) -> bool {
        let differ = self.type_hash.zip(hash).is_some_and(|(a, b)| a != b);
        self.type_name == dds_type && !differ
    }

    /// Returns whether the endpoint belongs to Fast DDS, by the vendor in its GUID (eProsima is
    /// 01.0f in the OMG's list).
    #[must_use]
    pub fn is_fast_dds(&self) -> bool {
        self.guid.prefix.as_ref().starts_with(&[0x01, 0x0f])
    }
}

/// The endpoints of other participants on ROS topics (`rt/...`), by DDS topic name.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Graph {
    writers: BTreeMap<String, Vec<RemoteEndpoint>>,
    readers: BTreeMap<String, Vec<RemoteEndpoint>>,
    /// Participants with any endpoint.
    participants: BTreeSet<ParticipantPrefix>,
    /// The bridge's own endpoints that were received as announcements: RustDDS receives its own
    /// multicast.
    own: BTreeSet<GUID>,
    /// Participants of other bridges, with the number of the space that each serves.
    bridges: BTreeMap<ParticipantPrefix, u16>,
}

impl Graph {
    /// Returns the endpoints that `participant` has discovered; its own endpoints are left out.
    #[must_use]
    pub fn snapshot(participant: &DomainParticipant) -> Self {
        let prefix = participant.guid().prefix;
        let mut own = BTreeSet::new();
        let mut foreign = |(_, endpoint): &(String, RemoteEndpoint)| {
            let foreign = endpoint.guid.prefix != prefix;
            if !foreign {
                own.insert(endpoint.guid);
            }
            foreign
        };
        // The copies of all announcements of writers are freed before those of readers are made.
        let writers = participant.discovered_writers().into_iter();
        let writers = writers.map(RemoteEndpoint::of_writer);
        let writers: Vec<_> = writers.filter(&mut foreign).collect();
        let readers = participant.discovered_readers().into_iter();
        let readers = readers.map(RemoteEndpoint::of_reader);
        let readers: Vec<_> = readers.filter(&mut foreign).collect();
        Self {
            own,
            ..Self::from_endpoints(writers, readers)
        }
    }

    /// Sorts endpoints by topic. Leaves out topics outside of ROS, and writers of bridges: their
    /// values of the space would return to the space under another name, or loop forever.
    pub fn from_endpoints(
        writers: impl IntoIterator<Item = (String, RemoteEndpoint)>,
        readers: impl IntoIterator<Item = (String, RemoteEndpoint)>,
    ) -> Self {
        let mut participants = BTreeSet::new();
        let mut bridges = BTreeMap::new();
        let mut note = |endpoint: &RemoteEndpoint| participants.extend(prefix(endpoint.guid));
        let mut writers = by_topic(writers.into_iter().inspect(|(topic, writer)| {
            note(writer);
            bridges.extend(prefix(writer.guid).zip(bridge_of(topic, &writer.type_name)));
        }));
        let readers = by_topic(readers.into_iter().inspect(|(_, reader)| note(reader)));
        if !bridges.is_empty() {
            writers.retain(|_, writers| {
                writers.retain(|one| !prefix(one.guid).is_some_and(|of| bridges.contains_key(&of)));
                !writers.is_empty()
            });
        }
        Self {
            writers,
            readers,
            participants,
            own: BTreeSet::new(),
            bridges,
        }
    }

    /// Returns whether the endpoint belongs to another bridge.
    #[must_use]
    pub fn is_bridge(&self, guid: GUID) -> bool {
        !self.bridges.is_empty() && prefix(guid).is_some_and(|of| self.bridges.contains_key(&of))
    }

    /// Returns whether another bridge serves the space in the same domain, so that its values
    /// belong to that bridge.
    #[must_use]
    pub fn is_at_home(&self, space: u16) -> bool {
        self.bridges.values().any(|other| *other == space)
    }

    /// Returns the other bridges, each with its announced space.
    pub fn bridges(&self) -> impl Iterator<Item = (ParticipantPrefix, u16)> {
        self.bridges.iter().map(|(bridge, space)| (*bridge, *space))
    }

    /// Returns the writers of a topic, in the order of their GUIDs.
    #[must_use]
    pub fn writers(&self, topic: &str) -> &[RemoteEndpoint] {
        self.writers.get(topic).map_or(&[], Vec::as_slice)
    }

    /// Returns the readers of a topic, in the order of their GUIDs.
    #[must_use]
    pub fn readers(&self, topic: &str) -> &[RemoteEndpoint] {
        self.readers.get(topic).map_or(&[], Vec::as_slice)
    }

    /// Returns the bridge's own endpoints that were announced. Also empty if RustDDS cannot receive
    /// its own announcements, such as without multicast.
    #[must_use]
    pub fn own(&self) -> &BTreeSet<GUID> {
        &self.own
    }

    /// Returns whether a reader or writer of a ROS topic has this GUID.
    #[must_use]
    pub fn holds(&self, guid: GUID) -> bool {
        self.writers
            .values()
            .chain(self.readers.values())
            .flatten()
            .any(|endpoint| endpoint.guid == guid)
    }

    /// Returns the GUID prefixes of the participants with any reader or writer, inside or outside
    /// of ROS.
    #[must_use]
    pub fn participants(&self) -> &BTreeSet<ParticipantPrefix> {
        &self.participants
    }

    /// Returns the topics that have a reader.
    pub fn read_topics(&self) -> impl Iterator<Item = &str> {
        self.readers.keys().map(String::as_str)
    }

    /// Returns the topics that have a writer.
    pub fn written_topics(&self) -> impl Iterator<Item = &str> {
        self.writers.keys().map(String::as_str)
    }
}

/// Returns the DDS name of a ROS topic with a leading slash.
#[must_use]
pub fn dds_topic(ros_topic: &str) -> String {
    format!("{TOPIC_PREFIX}{}", ros_topic.trim_start_matches('/'))
}

/// Returns the ROS name of a DDS topic without the leading slash, or `None` for a topic outside of
/// ROS.
#[must_use]
pub fn ros_topic(dds_topic: &str) -> Option<&str> {
    dds_topic.strip_prefix(TOPIC_PREFIX)
}

/// Returns the DDS topic on which a writer announces a bridge and its space. The topic is outside
/// of ROS, so ROS tools do not show it.
#[must_use]
pub fn bridge_topic(space: u16) -> String {
    format!("{BRIDGE_PREFIX}{space}")
}

/// Returns the space of the bridge that such a writer announces. Spaces of OPC UA and of ROS 1
/// belong to no domain.
fn bridge_of(dds_topic: &str, dds_type: &str) -> Option<u16> {
    let space = dds_topic.strip_prefix(BRIDGE_PREFIX)?.parse().ok()?;
    let is_said =
        ROS2_SPACES.contains(&space) && dds_type == BRIDGE_TYPE && dds_topic == bridge_topic(space);
    is_said.then_some(space)
}

fn prefix(guid: GUID) -> Option<ParticipantPrefix> {
    guid.prefix.as_ref().try_into().ok()
}

fn by_topic(
    endpoints: impl IntoIterator<Item = (String, RemoteEndpoint)>,
) -> BTreeMap<String, Vec<RemoteEndpoint>> {
    let mut topics: BTreeMap<String, Vec<RemoteEndpoint>> = BTreeMap::new();
    for (topic, endpoint) in endpoints {
        if ros_topic(&topic).is_some() {
            topics.entry(topic).or_default().push(endpoint);
        }
    }
    for endpoints in topics.values_mut() {
        endpoints.sort_by_key(|endpoint| endpoint.guid);
    }
    topics
}

/// Returns the hash of `typehash=RIHS01_..;` in an endpoint's user data (REP-2016).
fn type_hash(user_data: &[u8]) -> Option<TypeHash> {
    let text = String::from_utf8_lossy(user_data);
    let (_, behind) = text.split_once("typehash=")?;
    behind.split(';').next()?.parse().ok()
}

fn is_durable(durability: Option<Durability>) -> bool {
    durability.is_some_and(|durability| durability != Durability::Volatile)
}

/// The prefix of ROS 2 topic names (design.ros2.org, topic and service names).
const TOPIC_PREFIX: &str = "rt/";
/// The spaces that can belong to a domain.
const ROS2_SPACES: RangeInclusive<u16> = 2..=232;
const BRIDGE_PREFIX: &str = "ua_bridge_";
/// The type of the bridge topic, on which no sample is ever sent.
pub const BRIDGE_TYPE: &str = "ua_bridge::Presence_";

#[cfg(test)]
mod tests {
    use super::*;

    fn writer(topic: &str, participant: u8) -> (String, RemoteEndpoint) {
        let endpoint = RemoteEndpoint {
            guid: GUID::from_bytes([participant; 16]),
            type_name: "std_msgs::msg::dds_::Bool_".into(),
            reliable: true,
            transient_local: false,
            type_hash: None,
            qos: Arc::default(),
        };
        (topic.to_owned(), endpoint)
    }

    fn marker(topic: &str, participant: u8) -> (String, RemoteEndpoint) {
        let (topic, mut endpoint) = writer(topic, participant);
        endpoint.type_name = BRIDGE_TYPE.into();
        (topic, endpoint)
    }

    #[test]
    fn what_another_bridge_writes_is_no_source() {
        let (marker, of_bridge) = (marker("ua_bridge_3", 7), writer("rt/ua_2_5_10", 7));
        let of_robot = writer("rt/ua_2_5_10", 8);
        let all = [marker, of_bridge.clone(), of_robot.clone()];
        let graph = Graph::from_endpoints(all, []);
        assert_eq!(
            graph.writers("rt/ua_2_5_10"),
            std::slice::from_ref(&of_robot.1)
        );
        assert!(graph.is_bridge(of_bridge.1.guid) && !graph.is_bridge(of_robot.1.guid));
        assert!(graph.is_at_home(3) && !graph.is_at_home(2));
    }

    #[test]
    fn a_writer_that_no_bridge_would_have_keeps_no_value_of_a_space_out() {
        let markers = [
            // The number of no ROS 2 space.
            marker("ua_bridge_0", 1),
            marker("ua_bridge_1", 2),
            marker("ua_bridge_233", 3),
            // A spelling that bridges do not use.
            marker("ua_bridge_+3", 4),
            marker("ua_bridge_03", 5),
            marker("rt/ua_bridge_3", 6),
            // Another type.
            writer("ua_bridge_3", 7),
        ];
        let guids = markers.clone().map(|(_, marker)| marker.guid);
        let graph = Graph::from_endpoints(markers, []);
        assert!((0..=u16::MAX).all(|space| !graph.is_at_home(space)));
        assert!(guids.iter().all(|guid| !graph.is_bridge(*guid)));
    }
}
