//! The other participants that offer and call services in a domain.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use rustdds::{DomainParticipant, GUID, RTPSEntity};
use tokio::time::Instant;

use crate::domain::Domain;
use crate::graph::{Graph, RemoteEndpoint};

use super::ServiceMapping;

/// The endpoints of other participants on the topics of services and actions. All users in a
/// process share a single copy of RustDDS's discovery data.
///
/// The bridge's own endpoints are left out: a client of the bridge does not make a service
/// available.
#[derive(Clone)]
pub struct ServicePeers(Arc<PeersShared>);

struct PeersShared {
    participant: DomainParticipant,
    seen: Mutex<Option<SeenGraph>>,
}

struct SeenGraph {
    at: Instant,
    /// The change count of discovery at the copy; see [`changes_of`].
    changes: Option<u64>,
    snapshot: Arc<Snapshot>,
}

/// A snapshot of the endpoints, by DDS topic.
#[derive(Debug, Default)]
pub struct Snapshot {
    readers: BTreeMap<String, Vec<RemoteEndpoint>>,
    writers: BTreeMap<String, Vec<RemoteEndpoint>>,
}

impl ServicePeers {
    /// Returns the service peers of the domain. The value holds the participant: drop it before
    /// [`Domain::leave`].
    #[must_use]
    pub fn new(domain: &Domain) -> Self {
        Self(Arc::new(PeersShared {
            participant: domain.participant().clone(),
            seen: Mutex::default(),
        }))
    }

    /// Returns a snapshot no older than `age`. Discovery data is not copied again while its change
    /// count stays the same: with thousands of endpoints, a copy costs more than all other work of
    /// an idle bridge.
    #[must_use]
    pub fn look(&self, now: Instant, age: Duration) -> Arc<Snapshot> {
        let mut seen = self.0.seen.lock().unwrap_or_else(PoisonError::into_inner);
        let fresh = seen
            .as_ref()
            .filter(|seen| now.saturating_duration_since(seen.at) < age);
        if let Some(fresh) = fresh {
            return Arc::clone(&fresh.snapshot);
        }
        // The count is read before the copy, so that a change in between causes another copy.
        let changes = changes_of(&self.0.participant);
        if let Some(seen) = seen.as_mut()
            && changes.is_some()
            && seen.changes == changes
        {
            seen.at = now;
            return Arc::clone(&seen.snapshot);
        }
        let snapshot = Arc::new(Snapshot::of(&self.0.participant));
        *seen = Some(SeenGraph {
            at: now,
            changes,
            snapshot: Arc::clone(&snapshot),
        });
        snapshot
    }

    /// Returns a snapshot that has all changes so far. With the published RustDDS, which does not
    /// count changes, the snapshot may be 100 ms old.
    ///
    /// A pass that is made because of a change must not judge by an older snapshot, since it is not
    /// made again.
    #[must_use]
    pub fn current(&self, now: Instant) -> Arc<Snapshot> {
        let age = changes_of(&self.0.participant).map_or(SEEN, |_| Duration::ZERO);
        self.look(now, age)
    }

    /// Returns the mapping of the vendor of the endpoint's participant.
    pub(crate) fn mapping_of(&self, endpoint: GUID) -> ServiceMapping {
        ServiceMapping::of(vendor_of(&self.0.participant, endpoint))
    }

    /// Returns whether the endpoint belongs to this participant.
    pub(crate) fn is_own(&self, endpoint: GUID) -> bool {
        endpoint.prefix == self.0.participant.guid().prefix
    }
}

impl std::fmt::Debug for ServicePeers {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("ServicePeers").finish_non_exhaustive()
    }
}

/// Returns the change count of discovery; a new count means that discovery data may have changed.
/// The published RustDDS does not provide it.
#[cfg(feature = "patched-dds")]
pub(crate) fn changes_of(participant: &DomainParticipant) -> Option<u64> {
    Some(participant.discovered_changes())
}

#[cfg(not(feature = "patched-dds"))]
pub(crate) fn changes_of(_participant: &DomainParticipant) -> Option<u64> {
    None
}

/// Returns the vendor of the endpoint's participant, as announced by the participant. GUIDs start
/// with the vendor number (RTPS 2.5, 8.2.4.1) unless DDS Security generates them (DDS Security 1.1,
/// 9.3.3).
#[cfg(feature = "patched-dds")]
fn vendor_of(participant: &DomainParticipant, endpoint: GUID) -> [u8; 2] {
    let told = participant.vendor_of(endpoint.prefix);
    told.unwrap_or_else(|| vendor_in(endpoint))
}

#[cfg(not(feature = "patched-dds"))]
fn vendor_of(_participant: &DomainParticipant, endpoint: GUID) -> [u8; 2] {
    vendor_in(endpoint)
}

fn vendor_in(endpoint: GUID) -> [u8; 2] {
    let [a, b, ..] = endpoint.to_bytes();
    [a, b]
}

impl Snapshot {
    fn of(participant: &DomainParticipant) -> Self {
        let own = participant.guid().prefix;
        let mut snapshot = Self::default();
        for reader in participant.discovered_readers() {
            if reader.reader_proxy.remote_reader_guid.prefix != own
                && is_wanted(reader.subscription_topic_data.topic_name())
            {
                let (topic, endpoint) = RemoteEndpoint::of_reader(reader);
                snapshot.readers.entry(topic).or_default().push(endpoint);
            }
        }
        for writer in participant.discovered_writers() {
            if writer.writer_proxy.remote_writer_guid.prefix != own
                && is_wanted(&writer.publication_topic_data.topic_name)
            {
                let (topic, endpoint) = RemoteEndpoint::of_writer(writer);
                snapshot.writers.entry(topic).or_default().push(endpoint);
            }
        }
        snapshot
    }

    /// Returns the readers of a DDS topic of a service or action.
    #[must_use]
    pub fn readers(&self, topic: &str) -> &[RemoteEndpoint] {
        self.readers.get(topic).map_or(&[], Vec::as_slice)
    }

    /// Returns the writers of a DDS topic of a service or action.
    #[must_use]
    pub fn writers(&self, topic: &str) -> &[RemoteEndpoint] {
        self.writers.get(topic).map_or(&[], Vec::as_slice)
    }

    /// Returns the offered services, each with the readers of its requests.
    pub fn offered(&self) -> impl Iterator<Item = (&str, &[RemoteEndpoint])> {
        named(&self.readers, service_name)
    }

    /// Returns the called services, each with the writers of its requests.
    pub fn called(&self) -> impl Iterator<Item = (&str, &[RemoteEndpoint])> {
        named(&self.writers, service_name)
    }

    /// Returns the served actions, each with the readers of its goals.
    pub fn served_actions(&self) -> impl Iterator<Item = (&str, &[RemoteEndpoint])> {
        named(&self.readers, action_name)
    }

    /// Returns the actions that receive goals from clients, each with the writers of its goals.
    pub fn called_actions(&self) -> impl Iterator<Item = (&str, &[RemoteEndpoint])> {
        named(&self.writers, action_name)
    }
}

/// Returns the names without leading slash that `name` extracts from request topics.
fn named(
    topics: &BTreeMap<String, Vec<RemoteEndpoint>>,
    name: impl Fn(&str) -> Option<&str>,
) -> impl Iterator<Item = (&str, &[RemoteEndpoint])> {
    topics.iter().filter_map(move |(topic, endpoints)| {
        let name = name(topic.strip_prefix("rq/")?.strip_suffix("Request")?)?;
        Some((name, endpoints.as_slice()))
    })
}

fn service_name(name: &str) -> Option<&str> {
    (!name.contains("/_action/")).then_some(name)
}

fn action_name(name: &str) -> Option<&str> {
    name.strip_suffix("/_action/send_goal")
}

/// Returns the services, with their types, that are offered by participants other than
/// `participant` and the bridges in `graph`.
pub(crate) fn offered(
    participant: &DomainParticipant,
    graph: &Graph,
) -> BTreeMap<String, BTreeSet<String>> {
    let mut services: BTreeMap<String, BTreeSet<String>> = BTreeMap::new();
    for (name, endpoints) in Snapshot::of(participant).offered() {
        let others = endpoints.iter().filter(|one| !graph.is_bridge(one.guid));
        for one in others {
            let types = services.entry(format!("/{name}")).or_default();
            types.insert(service_type(&one.type_name));
        }
    }
    services
}

/// Converts `std_srvs::srv::dds_::SetBool_Request_` to `std_srvs/SetBool`.
#[must_use]
pub fn service_type(request: &str) -> String {
    let parts = request.split_once("::srv::dds_::");
    let named = parts.and_then(|(package, rest)| Some((package, rest.strip_suffix("_Request_")?)));
    named.map_or_else(
        || request.to_owned(),
        |(package, name)| format!("{package}/{name}"),
    )
}

/// Converts `nav2_msgs::action::dds_::NavigateToPose_SendGoal_Request_` to
/// `nav2_msgs/NavigateToPose`.
#[must_use]
pub fn action_type(request: &str) -> String {
    let parts = request.split_once("::action::dds_::");
    let named =
        parts.and_then(|(package, rest)| Some((package, rest.strip_suffix("_SendGoal_Request_")?)));
    named.map_or_else(
        || request.to_owned(),
        |(package, name)| format!("{package}/{name}"),
    )
}

/// Maximum age of a current snapshot without change counts.
const SEEN: Duration = Duration::from_millis(100);

fn is_wanted(topic: &str) -> bool {
    topic.starts_with("rq/") || topic.starts_with("rr/") || topic.contains("/_action/")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_service_is_named_as_its_file_is() {
        let of = ["std_srvs::srv::dds_::SetBool_Request_", "SomethingElse"];
        assert_eq!(of.map(service_type), ["std_srvs/SetBool", "SomethingElse"]);
    }

    #[test]
    fn an_action_is_named_as_its_file_is() {
        let of = [
            "nav2_msgs::action::dds_::NavigateToPose_SendGoal_Request_",
            "nav2_msgs::action::dds_::NavigateToPose_GetResult_Request_",
        ];
        assert_eq!(of.map(action_type), ["nav2_msgs/NavigateToPose", of[1]]);
        assert_eq!(action_name("arm/_action/send_goal"), Some("arm"));
        assert_eq!(action_name("arm/_action/cancel_goal"), None);
        assert_eq!(service_name("arm/_action/send_goal"), None);
        assert_eq!(service_name("arm/stop"), Some("arm/stop"));
    }
}
