//! The ROS node of a participant: its name, its announcements, and the announcements of other
//! nodes.
//!
//! One thread serves the node, so that it works independently of other polls. The thread sleeps
//! until there is work: a new or removed endpoint, a node list of another participant, a message of
//! `/clock`, or a warning for `/rosout`.

mod teller;

use std::collections::{BTreeMap, BTreeSet};
use std::ops::Deref;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::{JoinHandle, Thread};
use std::time::Duration;

use rustdds::{GUID, RTPSEntity};
use tokio::time::Instant;

use crate::clock::Ros2Clock;
use crate::discovery_info::{GidLength, GuidBytes, NodeEntities};
use crate::raw::{PayloadReader, PayloadWriter, RawReader, RawWriter};
use crate::rosout::Rosout;

use teller::NodeThread;

/// The name and the options of a node.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NodeOptions {
    /// The namespace, `/` or for example `/cell/left`.
    pub namespace: String,
    /// The name without namespace.
    pub name: String,
    /// The length of the Gids that the node writes; `None` selects the length that most other
    /// participants write.
    pub gid: Option<GidLength>,
    /// Whether the node's clock follows `/clock`.
    pub use_sim_time: bool,
}

impl NodeOptions {
    /// Returns the name with its namespace.
    #[must_use]
    pub fn full_name(&self) -> String {
        format!("{}/{}", self.namespace.trim_end_matches('/'), self.name)
    }

    /// Returns the logger name of its messages on `/rosout`, as in rcl: the full name with dots.
    fn logger(&self) -> String {
        self.full_name().trim_start_matches('/').replace('/', ".")
    }

    /// Returns the reason for which the names are invalid in ROS (`rmw_validate_node_name`,
    /// `rmw_validate_namespace`).
    pub(crate) fn fault(&self) -> Option<&'static str> {
        let is_token = |text: &str| {
            text.starts_with(|c: char| c.is_ascii_alphabetic() || c == '_')
                && text.bytes().all(|b| b.is_ascii_alphanumeric() || b == b'_')
        };
        let parts = self.namespace.strip_prefix('/');
        if !is_token(&self.name) {
            Some("a name has letters, digits and `_`, and does not begin with a digit")
        } else if !parts.is_some_and(|parts| parts.is_empty() || parts.split('/').all(is_token)) {
            Some("a namespace is `/`, or names with a `/` before each")
        } else if self.name.len() > 255 || self.namespace.len() > 245 {
            Some("a name has up to 255 characters, a namespace up to 245")
        } else {
            None
        }
    }
}

/// Creates the options of a node in the root namespace.
impl From<&str> for NodeOptions {
    fn from(name: &str) -> Self {
        Self {
            namespace: "/".to_owned(),
            name: name.to_owned(),
            gid: None,
            use_sim_time: false,
        }
    }
}

/// A reader or writer that is on its node's list as long as it exists.
pub struct Listed<E> {
    endpoint: E,
    entry: ListedEndpoint,
}

impl<E> Listed<E> {
    /// Returns the GUID of the endpoint.
    pub fn guid(&self) -> GUID {
        self.entry.guid
    }
}

impl<E> Deref for Listed<E> {
    type Target = E;

    fn deref(&self) -> &E {
        &self.endpoint
    }
}

/// An entry in the node's list, removed when dropped.
struct ListedEndpoint {
    node: Arc<NodeShared>,
    guid: GUID,
    kind: EndpointKind,
}

#[derive(Debug, Clone, Copy)]
enum EndpointKind {
    Reader,
    Writer,
}

impl Drop for ListedEndpoint {
    fn drop(&mut self) {
        self.node.change(|own| {
            own.unseen.remove(&self.guid);
            own.of(self.kind).remove(&self.guid.to_bytes())
        });
    }
}

/// The node. Its own thread announces it until it is dropped; then its name is withdrawn.
pub(crate) struct DomainNode {
    shared: Arc<NodeShared>,
    thread: Option<JoinHandle<()>>,
}

/// The endpoints that announce nodes, which are not on the node's list.
pub(crate) struct Channels {
    pub(crate) participant: GuidBytes,
    pub(crate) info_reader: RawReader,
    pub(crate) info_writer: RawWriter,
}

/// Endpoints of the node that its thread serves.
pub(crate) struct NodeServices {
    pub(crate) rosout: PayloadWriter,
    pub(crate) clock: Option<PayloadReader>,
}

struct NodeShared {
    options: NodeOptions,
    clock: Ros2Clock,
    own: Mutex<Own>,
    others: Mutex<Others>,
    services: Mutex<Option<(NodeServices, Arc<Rosout>)>>,
    stop: AtomicBool,
    thread: Mutex<Option<Thread>>,
}

/// The announcements of this node.
#[derive(Debug, Default)]
struct Own {
    readers: BTreeSet<GuidBytes>,
    writers: BTreeSet<GuidBytes>,
    changed: bool,
    /// The endpoints that were not seen as announced, with the time of their creation.
    unseen: BTreeMap<GUID, Instant>,
}

/// The announcements of other participants.
#[derive(Debug, Default)]
struct Others {
    participants: BTreeMap<ParticipantPrefix, (GidLength, Vec<NodeEntities>)>,
    malformed: u64,
    /// Participants with an expired lease. They may return, and do not repeat their announcements
    /// then.
    absent: BTreeSet<ParticipantPrefix>,
    /// Participants with a duplicate node name that was logged.
    doubles: BTreeSet<ParticipantPrefix>,
}

/// The GUID prefix of all entities of a participant.
pub type ParticipantPrefix = [u8; 12];

impl DomainNode {
    /// Starts the thread that announces the node.
    ///
    /// # Errors
    /// If the thread cannot be started.
    pub(crate) fn start(options: NodeOptions, channels: Channels) -> std::io::Result<Self> {
        let shared = Arc::new(NodeShared {
            clock: Ros2Clock::new(options.use_sim_time),
            options,
            own: Mutex::new(Own {
                changed: true,
                ..Own::default()
            }),
            others: Mutex::default(),
            services: Mutex::default(),
            stop: AtomicBool::new(false),
            thread: Mutex::default(),
        });
        let teller = NodeThread::new(Arc::clone(&shared), channels);
        let thread = std::thread::Builder::new()
            .name("ros-node".to_owned())
            .spawn(move || teller.run())?;
        *lock(&shared.thread) = Some(thread.thread().clone());
        Ok(Self {
            shared,
            thread: Some(thread),
        })
    }

    /// Starts to publish the process's warnings and to read `/clock`.
    pub(crate) fn serve(&self, services: NodeServices) {
        let Some(thread) = lock(&self.shared.thread).clone() else {
            return;
        };
        let rosout = Arc::new(Rosout::new(self.shared.clock.clone(), thread.clone()));
        *lock(&self.shared.services) = Some((services, rosout));
        thread.unpark();
    }

    pub(crate) fn options(&self) -> &NodeOptions {
        &self.shared.options
    }

    /// Returns the queue of `/rosout`, once the node serves it.
    pub(crate) fn rosout(&self) -> Option<Arc<Rosout>> {
        let services = lock(&self.shared.services);
        services.as_ref().map(|(_, rosout)| Arc::clone(rosout))
    }

    pub(crate) fn clock(&self) -> Ros2Clock {
        self.shared.clock.clone()
    }

    pub(crate) fn list_reader(&self, endpoint: RawReader) -> PayloadReader {
        let guid = endpoint.guid();
        self.list(endpoint, guid, EndpointKind::Reader)
    }

    pub(crate) fn list_writer(&self, endpoint: RawWriter) -> PayloadWriter {
        let guid = endpoint.guid();
        self.list(endpoint, guid, EndpointKind::Writer)
    }

    fn list<E>(&self, endpoint: E, guid: GUID, kind: EndpointKind) -> Listed<E> {
        lock(&self.shared.own).unseen.insert(guid, Instant::now());
        self.shared
            .change(|own| own.of(kind).insert(guid.to_bytes()));
        Listed {
            endpoint,
            entry: ListedEndpoint {
                node: Arc::clone(&self.shared),
                guid,
                kind,
            },
        }
    }

    /// Returns the nodes of other participants.
    pub(crate) fn others(&self) -> Vec<NodeEntities> {
        let others = lock(&self.shared.others);
        others
            .present()
            .flat_map(|(_, nodes)| nodes.iter().cloned())
            .collect()
    }

    /// Returns the number of node lists that could not be decoded.
    pub(crate) fn malformed_lists(&self) -> u64 {
        lock(&self.shared.others).malformed
    }

    /// Returns the full name of the remote node that owns this endpoint.
    pub(crate) fn owner(&self, endpoint: GUID) -> Option<String> {
        let guid = endpoint.to_bytes();
        let others = lock(&self.shared.others);
        let (_, nodes) = others.participants.get(endpoint.prefix.as_ref())?;
        nodes
            .iter()
            .find(|node| node.readers.contains(&guid) || node.writers.contains(&guid))
            .map(NodeEntities::full_name)
    }

    /// Returns the full names of the nodes of a remote participant.
    pub(crate) fn nodes_of(&self, participant: &ParticipantPrefix) -> Vec<String> {
        let others = lock(&self.shared.others);
        let told = others.participants.get(participant);
        let nodes = told.into_iter().flat_map(|(_, nodes)| nodes);
        nodes.map(NodeEntities::full_name).collect()
    }

    /// Returns whether the thread has ended, which does not happen before the drop unless it
    /// panics.
    pub(crate) fn is_mute(&self) -> bool {
        self.thread.as_ref().is_none_or(JoinHandle::is_finished)
    }

    /// Records the announced endpoints of this node, and returns the endpoints with an overdue
    /// announcement.
    pub(crate) fn unannounced(&self, announced: &BTreeSet<GUID>) -> BTreeSet<GUID> {
        let mut own = lock(&self.shared.own);
        own.unseen.retain(|guid, _| !announced.contains(guid));
        if announced.is_empty() {
            // RustDDS does not receive its own announcements here, so nothing can be concluded.
            return BTreeSet::new();
        }
        let now = Instant::now();
        let late = |since: &Instant| now.duration_since(*since) >= ANNOUNCED_WITHIN;
        own.unseen
            .iter()
            .filter(|(_, since)| late(since))
            .map(|(guid, _)| *guid)
            .collect()
    }

    /// Updates the present participants. The nodes of absent participants are kept for their
    /// return.
    pub(crate) fn retain(&self, alive: impl Fn(&ParticipantPrefix) -> bool) {
        let mut others = lock(&self.shared.others);
        let absent: BTreeSet<_> = others
            .participants
            .keys()
            .filter(|prefix| !alive(prefix))
            .copied()
            .collect();
        let changed = others.absent != absent;
        others.absent = absent;
        others.doubles.retain(|prefix| alive(prefix));
        drop(others);
        if changed {
            self.shared.wake();
        }
    }
}

impl Drop for DomainNode {
    fn drop(&mut self) {
        self.shared.stop.store(true, Ordering::Release);
        self.shared.wake();
        if let Some(thread) = self.thread.take() {
            // The thread does not panic; if it did, its name would be withdrawn with the
            // participant.
            thread.join().unwrap_or_default();
        }
    }
}

impl NodeShared {
    fn change(&self, change: impl FnOnce(&mut Own) -> bool) {
        let mut own = lock(&self.own);
        own.changed |= change(&mut own);
        drop(own);
        self.wake();
    }

    fn wake(&self) {
        if let Some(thread) = &*lock(&self.thread) {
            thread.unpark();
        }
    }
}

impl Own {
    fn of(&mut self, kind: EndpointKind) -> &mut BTreeSet<GuidBytes> {
        match kind {
            EndpointKind::Reader => &mut self.readers,
            EndpointKind::Writer => &mut self.writers,
        }
    }
}

impl Others {
    /// Returns whether there was room.
    fn insert(
        &mut self,
        prefix: ParticipantPrefix,
        length: GidLength,
        nodes: Vec<NodeEntities>,
    ) -> bool {
        let full = self.participants.len() >= MAX_PARTICIPANTS;
        if full && !self.participants.contains_key(&prefix) {
            let Some(gone) = self.absent.pop_first() else {
                return false;
            };
            self.participants.remove(&gone);
        }
        self.absent.remove(&prefix);
        self.participants.insert(prefix, (length, nodes));
        true
    }

    /// Returns the announcements of the present participants.
    fn present(&self) -> impl Iterator<Item = &(GidLength, Vec<NodeEntities>)> {
        let there = |(prefix, told)| (!self.absent.contains(prefix)).then_some(told);
        self.participants.iter().filter_map(there)
    }

    /// Returns the length that most participants write; the newer length in a tie.
    fn majority(&self) -> GidLength {
        let older = self
            .present()
            .filter(|(length, _)| *length == GidLength::Bytes24);
        if older.count() * 2 > self.present().count() {
            GidLength::Bytes24
        } else {
            GidLength::Bytes16
        }
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl<E> std::fmt::Debug for Listed<E>
where
    E: std::fmt::Debug,
{
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        self.endpoint.fmt(f)
    }
}

/// The time limit of an announcement: RustDDS's discovery empties a full queue in less.
const ANNOUNCED_WITHIN: Duration = Duration::from_secs(3);
/// Maximum number of participants with recorded nodes.
const MAX_PARTICIPANTS: usize = 4096;

#[cfg(test)]
mod tests {
    use super::*;

    fn options(namespace: &str, name: &str) -> NodeOptions {
        NodeOptions {
            namespace: namespace.to_owned(),
            ..NodeOptions::from(name)
        }
    }

    #[test]
    fn names_are_those_of_ros() {
        assert_eq!(options("/", "bridge").full_name(), "/bridge");
        assert_eq!(
            options("/cell/left", "bridge").full_name(),
            "/cell/left/bridge"
        );
        assert_eq!(options("/cell/left", "bridge").logger(), "cell.left.bridge");
        for good in [options("/", "_b1"), options("/a/b_c", "B")] {
            assert_eq!(good.fault(), None, "{good:?}");
        }
        for bad in [
            options("/", ""),
            options("/", "1b"),
            options("/", "a/b"),
            options("/", "a-b"),
            options("", "a"),
            options("a", "a"),
            options("/a/", "a"),
            options("/a//b", "a"),
            options("/", &"a".repeat(256)),
        ] {
            assert!(bad.fault().is_some(), "{bad:?}");
        }
    }

    #[test]
    fn gids_are_written_as_most_others_write_them() {
        let mut others = Others::default();
        assert_eq!(others.majority(), GidLength::Bytes16);
        let mut join = |number, length| {
            others.participants.insert([number; 12], (length, vec![]));
            others.majority()
        };
        assert_eq!(join(1, GidLength::Bytes24), GidLength::Bytes24);
        assert_eq!(join(2, GidLength::Bytes16), GidLength::Bytes16);
        assert_eq!(join(3, GidLength::Bytes24), GidLength::Bytes24);
    }
}
