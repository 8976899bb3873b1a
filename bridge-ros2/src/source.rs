//! A topic of the domain that this bridge reads and publishes in the space.

use std::collections::{BTreeMap, BTreeSet};

use bridge_node::PublisherKey;
use bytes::Bytes;
use mappings::TopicId;
use messages::{Selection, TypeHash, TypeName};
use ros2_node::graph::RemoteEndpoint;
use ros2_node::inbox::SlotId;
use ros2_node::qos::Requested;
use rustdds::{GUID, RTPSEntity};

use crate::definitions::TypeDefinition;

/// A topic that other nodes write, and the values of our space that it holds.
#[derive(Debug)]
pub(crate) struct Ros2Source {
    pub(crate) dds_topic: String,
    pub(crate) message_type: TypeName,
    /// The hash of the type that applies among the announced hashes; writers with another hash are
    /// strangers.
    pub(crate) announced: Option<TypeHash>,
    /// The definition with which the topic is read.
    pub(crate) definition: Option<TypeDefinition>,
    /// The values made of a message; a single value unless the mapping binds several variables to
    /// the topic.
    pub(crate) values: Vec<(TopicId, Selection)>,
    pub(crate) reading: ReaderState,
    /// Whether the topic has a publisher of our type.
    pub(crate) live: bool,
    /// Writers of this topic with another type or another definition of it, with the reason for
    /// their drops. RustDDS matches by topic name alone, so their samples are received too.
    pub(crate) strangers: BTreeMap<GUID, &'static str>,
    /// Transient-local writers that have sent a sample, with the last sample.
    latched: BTreeMap<GUID, Latched>,
    /// The key for the next transient-local writer.
    next_key: u32,
    /// The present transient-local writers.
    durable: BTreeSet<GUID>,
    /// Lost transient-local writers that have sent a sample. A writer that returns, such as after a
    /// network outage longer than its lease, has to be read again.
    lapsed: BTreeSet<GUID>,
}

/// A transient-local writer that has sent a sample.
#[derive(Debug)]
struct Latched {
    key: PublisherKey,
    last: Bytes,
}

/// The state of the reader.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum ReaderState {
    /// Created when there is room for another endpoint.
    Pending,
    /// In the inbox.
    Open { slot: SlotId, requested: Requested },
}

impl Ros2Source {
    pub(crate) fn new(dds_topic: String, message_type: TypeName) -> Self {
        Self {
            dds_topic,
            message_type,
            announced: None,
            definition: None,
            values: Vec::new(),
            reading: ReaderState::Pending,
            live: false,
            strangers: BTreeMap::new(),
            latched: BTreeMap::new(),
            next_key: 0,
            durable: BTreeSet::new(),
            lapsed: BTreeSet::new(),
        }
    }

    /// Returns the Router's key of the sample's writer, if the writer is transient-local.
    pub(crate) fn latched_by(&mut self, writer: GUID, sample: &Bytes) -> Option<PublisherKey> {
        let ReaderState::Open { requested, .. } = self.reading else {
            return None;
        };
        // A transient-local reader is matched only with transient-local writers, whether recorded
        // or not.
        if !requested.is_transient_local() && !self.durable.contains(&writer) {
            return None;
        }
        let next_key = &mut self.next_key;
        let latched = self.latched.entry(writer).or_insert_with(|| {
            let key = PublisherKey(*next_key);
            *next_key = next_key.wrapping_add(1);
            Latched {
                key,
                last: Bytes::new(),
            }
        });
        latched.last.clone_from(sample);
        Some(latched.key)
    }

    /// Returns the last sample of each transient-local writer, for values that are added later.
    pub(crate) fn latched(&self) -> impl Iterator<Item = (PublisherKey, &Bytes)> {
        self.latched.values().map(|known| (known.key, &known.last))
    }

    /// Returns the transient-local writers that were lost; `writers` are present.
    pub(crate) fn gone(&mut self, writers: &[RemoteEndpoint]) -> Vec<PublisherKey> {
        let mut gone = Vec::new();
        let lapsed = &mut self.lapsed;
        self.latched.retain(|guid, latched| {
            let there = writers.iter().any(|writer| writer.guid == *guid);
            if !there {
                gone.push(latched.key);
                lapsed.insert(*guid);
            }
            there
        });
        while self.lapsed.len() > MAX_LAPSED {
            self.lapsed.pop_first();
        }
        gone
    }

    /// Returns the transient-local writers among `writers` that were lost and not read after their
    /// return.
    pub(crate) fn returned(&self, writers: &[RemoteEndpoint]) -> Vec<GUID> {
        let returned = writers.iter().map(|writer| writer.guid);
        returned.filter(|guid| self.lapsed.contains(guid)).collect()
    }

    /// Records that a returned writer is read again.
    pub(crate) fn reread(&mut self, writer: GUID) {
        self.lapsed.remove(&writer);
    }

    /// Sorts the present writers of the topic into ours and strangers; returns ours.
    pub(crate) fn meet(&mut self, writers: &[RemoteEndpoint]) -> Vec<RemoteEndpoint> {
        let dds_type = self.message_type.dds();
        let (ours, strangers): (Vec<_>, Vec<_>) = writers
            .iter()
            .cloned()
            .partition(|writer| writer.is_of(&dds_type, self.announced));
        let why = |writer: &RemoteEndpoint| match writer.type_name == dds_type {
            true => OTHER_DEFINITION,
            false => OTHER_TYPE,
        };
        let strangers = strangers.iter().map(|writer| (writer.guid, why(writer)));
        self.strangers = strangers.collect();
        let durable = ours.iter().filter(|writer| writer.transient_local);
        self.durable = durable.map(|writer| writer.guid).collect();
        ours
    }
}

/// The reason for dropping the samples of a writer of another type name.
pub(crate) const OTHER_TYPE: &str = "publisher of another type";
/// The reason for dropping the samples of a writer that announces another hash than the applicable
/// hash.
pub(crate) const OTHER_DEFINITION: &str = "publisher of another definition";
/// Maximum number of remembered lost writers: more do not return at once.
const MAX_LAPSED: usize = 1024;

/// Returns whether the endpoint belongs to the participant, by their common prefix.
pub(crate) fn same_participant(endpoint: GUID, participant: &impl RTPSEntity) -> bool {
    endpoint.prefix == participant.guid().prefix
}
