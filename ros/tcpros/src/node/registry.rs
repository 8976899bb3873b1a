//! The topics and services of a node.

use std::collections::HashMap;
use std::sync::Arc;

use crate::publisher::PublishedTopic;
use crate::service::OfferedService;
use crate::subscription::TopicFeed;

/// The topics and services of a node, by their resolved names.
#[derive(Debug, Default)]
pub(super) struct Registry {
    pub(super) publications: HashMap<String, Arc<PublishedTopic>>,
    pub(super) subscriptions: HashMap<String, Subscribed>,
    pub(super) services: HashMap<String, Arc<OfferedService>>,
    pub(super) generation: u64,
    pub(super) closed: bool,
}

impl Registry {
    /// Returns all registrations that the master should have.
    pub(super) fn wanted(&self) -> Vec<Registration> {
        let published = self.publications.values().map(|hub| Registration {
            name: hub.topic.clone(),
            kind: ResourceKind::Published,
            generation: hub.generation,
            type_name: hub.topic_type.name.clone(),
        });
        let subscribed = self
            .subscriptions
            .iter()
            .map(|(topic, entry)| Registration {
                name: topic.clone(),
                kind: ResourceKind::Subscribed,
                generation: entry.generation,
                type_name: entry
                    .feeds
                    .iter()
                    .find_map(|feed| feed.wanted.type_name.clone())
                    .unwrap_or_else(|| "*".to_owned()),
            });
        let offered = self.services.values().map(|served| Registration {
            name: served.service.clone(),
            kind: ResourceKind::Service,
            generation: served.generation,
            type_name: String::new(),
        });
        published.chain(subscribed).chain(offered).collect()
    }

    pub(super) const fn next_generation(&mut self) -> u64 {
        self.generation += 1;
        self.generation
    }
}

/// A subscribed topic.
#[derive(Debug)]
pub(super) struct Subscribed {
    pub(super) generation: u64,
    /// Number of received lists of publishers.
    pub(super) updates: u64,
    /// The last received list of publishers.
    pub(super) publishers: Vec<String>,
    pub(super) feeds: Vec<Arc<TopicFeed>>,
}

/// The registration of a topic or service, with its version.
#[derive(Clone, Debug)]
pub(crate) struct Registration {
    pub(crate) name: String,
    pub(crate) kind: ResourceKind,
    pub(crate) generation: u64,
    /// Type of a topic; empty for a service, because its type is not registered.
    pub(crate) type_name: String,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(crate) enum ResourceKind {
    Published,
    Subscribed,
    Service,
}
