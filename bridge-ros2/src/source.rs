//! A topic of the domain whose values are ours to send out.

use std::collections::{BTreeMap, BTreeSet};

use bridge_node::PublisherKey;
use bytes::Bytes;
use mappings::TopicId;
use messages::{Selection, TypeHash, TypeName};
use rustdds::{GUID, RTPSEntity};

use crate::definitions::Definition;
use crate::graph::Endpoint;
use crate::inbox::SlotId;
use crate::qos::Requested;

/// A topic somebody in the domain writes, and which of our values it holds.
#[derive(Debug)]
pub(crate) struct Source {
    pub(crate) dds_topic: String,
    pub(crate) message_type: TypeName,
    /// The hash of the type that counts among those its writers announce; others of it are strangers.
    pub(crate) announced: Option<TypeHash>,
    /// What it is read as.
    pub(crate) definition: Option<Definition>,
    /// Which values are made of a message; one unless a mapping ties several variables to one topic.
    pub(crate) values: Vec<(TopicId, Selection)>,
    pub(crate) reading: Reading,
    /// Whether somebody writes it, in our type.
    pub(crate) live: bool,
    /// Writers of this topic with another type, or another definition of it. RustDDS matches by topic name alone, so their
    /// samples come too. With what they are dropped for.
    pub(crate) strangers: BTreeMap<GUID, &'static str>,
    /// Transient-local writers that have sent something, with what they sent last.
    latched: BTreeMap<GUID, Latched>,
    /// The key for the next of them.
    next_key: u32,
    /// The writers there are that are transient-local.
    durable: BTreeSet<GUID>,
    /// Transient-local writers that have sent something and gone. One that comes back, as after the network was out for
    /// longer than its lease, is to be read again.
    lapsed: BTreeSet<GUID>,
}

/// A transient-local writer that has sent something.
#[derive(Debug)]
struct Latched {
    key: PublisherKey,
    last: Bytes,
}

/// What there is of a reader.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Reading {
    /// To be made when there is room for another endpoint.
    Pending,
    /// In the inbox.
    Open { slot: SlotId, requested: Requested },
}

impl Source {
    pub(crate) fn new(dds_topic: String, message_type: TypeName) -> Self {
        Self {
            dds_topic,
            message_type,
            announced: None,
            definition: None,
            values: Vec::new(),
            reading: Reading::Pending,
            live: false,
            strangers: BTreeMap::new(),
            latched: BTreeMap::new(),
            next_key: 0,
            durable: BTreeSet::new(),
            lapsed: BTreeSet::new(),
        }
    }

    /// What the writer of a sample is called to the Router, if it is transient-local.
    pub(crate) fn latched_by(&mut self, writer: GUID, sample: &Bytes) -> Option<PublisherKey> {
        let Reading::Open { requested, .. } = self.reading else {
            return None;
        };
        // A transient-local reader is matched with no other writers, be they met or not.
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

    /// The last sample of each transient-local writer, for values that come to be made of it.
    pub(crate) fn latched(&self) -> impl Iterator<Item = (PublisherKey, &Bytes)> {
        self.latched.values().map(|known| (known.key, &known.last))
    }

    /// The transient-local writers that have gone; `writers` are there.
    pub(crate) fn gone(&mut self, writers: &[Endpoint]) -> Vec<PublisherKey> {
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

    /// The transient-local writers among `writers` that had gone and were not read since.
    pub(crate) fn returned(&self, writers: &[Endpoint]) -> Vec<GUID> {
        let returned = writers.iter().map(|writer| writer.guid);
        returned.filter(|guid| self.lapsed.contains(guid)).collect()
    }

    /// A writer that had returned is being read again.
    pub(crate) fn reread(&mut self, writer: GUID) {
        self.lapsed.remove(&writer);
    }

    /// Sorts the writers the topic has by now into ours and strangers; returns ours.
    pub(crate) fn meet(&mut self, writers: &[Endpoint]) -> Vec<Endpoint> {
        let dds_type = self.message_type.dds();
        let (ours, strangers): (Vec<_>, Vec<_>) = writers
            .iter()
            .cloned()
            .partition(|writer| writer.is_of(&dds_type, self.announced));
        let why = |writer: &Endpoint| match writer.type_name == dds_type {
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

/// Why samples of a writer are dropped whose type has another name.
pub(crate) const OTHER_TYPE: &str = "publisher of another type";
/// Why those of one are that announces another hash than the one that counts.
pub(crate) const OTHER_DEFINITION: &str = "publisher of another definition";
/// How many writers are remembered that have gone: more do not come back at once.
const MAX_LAPSED: usize = 1024;

/// The prefix all endpoints of a participant share.
pub(crate) fn same_participant(endpoint: GUID, participant: &impl RTPSEntity) -> bool {
    endpoint.prefix == participant.guid().prefix
}
