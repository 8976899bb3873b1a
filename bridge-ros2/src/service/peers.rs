//! Who else offers and calls services in a domain.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use rustdds::{DomainParticipant, GUID, RTPSEntity};
use tokio::time::Instant;

use crate::domain::Domain;

/// The endpoints of other participants on the topics of services, shared by all services of a process: RustDDS'
/// discovery is copied once for all that look at the same time.
///
/// Our own endpoints are left out: that we call a service does not make it available.
#[derive(Clone)]
pub struct ServicePeers(Arc<Shared>);

struct Shared {
    participant: DomainParticipant,
    seen: Mutex<Option<(Instant, Arc<Snapshot>)>>,
}

/// An endpoint and the DDS name of its type.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Peer {
    pub(super) guid: GUID,
    pub(super) type_name: String,
}

/// The endpoints at one moment, by topic.
#[derive(Debug, Default)]
pub(super) struct Snapshot {
    readers: BTreeMap<String, Vec<Peer>>,
    writers: BTreeMap<String, Vec<Peer>>,
}

impl ServicePeers {
    /// Of that domain. It keeps the participant: drop it before [`Domain::leave`].
    #[must_use]
    pub fn new(domain: &Domain) -> Self {
        Self(Arc::new(Shared {
            participant: domain.participant().clone(),
            seen: Mutex::default(),
        }))
    }

    /// What is known, no older than `age`.
    pub(super) fn look(&self, now: Instant, age: Duration) -> Arc<Snapshot> {
        let mut seen = self.0.seen.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((at, snapshot)) = seen.as_ref()
            && now.saturating_duration_since(*at) < age
        {
            return Arc::clone(snapshot);
        }
        let snapshot = Arc::new(Snapshot::of(&self.0.participant));
        *seen = Some((now, Arc::clone(&snapshot)));
        snapshot
    }

    /// Whether an endpoint is one of ours.
    pub(super) fn is_own(&self, endpoint: GUID) -> bool {
        endpoint.prefix == self.0.participant.guid().prefix
    }
}

impl std::fmt::Debug for ServicePeers {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("ServicePeers").finish_non_exhaustive()
    }
}

impl Snapshot {
    fn of(participant: &DomainParticipant) -> Self {
        let own = participant.guid().prefix;
        let mut snapshot = Self::default();
        for reader in participant.discovered_readers() {
            let guid = reader.reader_proxy.remote_reader_guid;
            let data = reader.subscription_topic_data;
            if guid.prefix != own && is_service(data.topic_name()) {
                let peers = snapshot.readers.entry(data.topic_name().clone());
                peers.or_default().push(Peer {
                    guid,
                    type_name: data.type_name().clone(),
                });
            }
        }
        for writer in participant.discovered_writers() {
            let guid = writer.writer_proxy.remote_writer_guid;
            let data = writer.publication_topic_data;
            if guid.prefix != own && is_service(&data.topic_name) {
                let peers = snapshot.writers.entry(data.topic_name);
                peers.or_default().push(Peer {
                    guid,
                    type_name: data.type_name,
                });
            }
        }
        snapshot
    }

    pub(super) fn readers(&self, topic: &str) -> &[Peer] {
        self.readers.get(topic).map_or(&[], Vec::as_slice)
    }

    pub(super) fn writers(&self, topic: &str) -> &[Peer] {
        self.writers.get(topic).map_or(&[], Vec::as_slice)
    }
}

fn is_service(topic: &str) -> bool {
    topic.starts_with("rq/") || topic.starts_with("rr/")
}
