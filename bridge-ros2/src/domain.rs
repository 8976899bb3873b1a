//! Being in a DDS domain: the participant, the ROS node it stands for, and the making of endpoints.

use std::collections::{BTreeMap, BTreeSet};
use std::net::{IpAddr, Ipv4Addr};
use std::path::PathBuf;
use std::pin::Pin;
use std::sync::{Mutex, PoisonError};
use std::task::{Context, Poll};
use std::time::Duration;

#[cfg(feature = "security")]
use rustdds::DomainParticipantSecurityConfigFiles;
use rustdds::dds::CreateError;
use rustdds::policy::{Durability, History, ResourceLimits};
use rustdds::{
    DomainParticipant, DomainParticipantBuilder, DomainParticipantStatusListener, GUID, Publisher,
    QosPolicies, QosPolicyBuilder, RTPSEntity, Subscriber, Topic, TopicKind,
};
use thiserror::Error;
use tokio::task::JoinHandle;
use tokio::time::Instant;
use tracing::warn;

use crate::clock::{self, RosClock};
use crate::discovery_info::{self, NodeEntities};
#[cfg(feature = "patched-dds")]
use crate::driver;
use crate::graph::{BRIDGE_TYPE, Graph, bridge_topic};
use crate::node::{Channels, Node, NodeOptions, ParticipantPrefix, Services};
use crate::qos::{Offered, Requested};
use crate::raw::{Opaque, Payload, RawReader, RawWriter, Reader, Writer};
use crate::rosout;
use crate::security::{Enclave, SecurityError};
use crate::service::peers::{changes_of, offered};

/// Which domain to join and how.
#[derive(Debug, Clone)]
pub struct DomainOptions {
    /// The DDS domain, 0..=232.
    pub domain: u16,
    /// Addresses of the interfaces to use; all when empty.
    pub networks: Vec<IpAddr>,
    /// Hosts to announce ourselves to by unicast, beside multicast.
    pub peers: Vec<IpAddr>,
    /// The ROS node it is there; a name alone is one in the root namespace.
    pub node: NodeOptions,
    /// The enclave by whose files it is secured, if it is.
    pub enclave: Option<Enclave>,
}

impl DomainOptions {
    /// Whether discovery is confined to this machine.
    #[must_use]
    pub fn is_local(&self) -> bool {
        !self.networks.is_empty() && self.networks.iter().all(IpAddr::is_loopback)
    }
}

/// Where discovery may go, as the environment of ROS says.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum DiscoveryRange {
    /// As far as multicast carries.
    Subnet,
    /// This machine.
    Localhost,
}

impl DiscoveryRange {
    /// Reads the values of `ROS_AUTOMATIC_DISCOVERY_RANGE` and of its predecessor `ROS_LOCALHOST_ONLY`, which wins
    /// when it is set, as in rcl.
    ///
    /// # Errors
    /// [`DomainError::DiscoveryRange`] for a range in which no bridge can work, or that ROS does not know.
    pub fn from_env(
        range: Option<&str>,
        localhost_only: Option<&str>,
    ) -> Result<Self, DomainError> {
        if localhost_only == Some("1") {
            return Ok(Self::Localhost);
        }
        match range {
            None | Some("" | "SUBNET" | "SYSTEM_DEFAULT") => Ok(Self::Subnet),
            Some("LOCALHOST") => Ok(Self::Localhost),
            Some(other) => Err(DomainError::DiscoveryRange(other.to_owned())),
        }
    }

    /// The addresses to use when no interface was asked for.
    #[must_use]
    pub fn networks(self) -> Vec<IpAddr> {
        match self {
            Self::Subnet => Vec::new(),
            Self::Localhost => vec![IpAddr::V4(Ipv4Addr::LOCALHOST)],
        }
    }
}

/// Why the domain cannot be joined, or an endpoint not be made.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum DomainError {
    /// Not a domain id (RTPS 2.5, 9.6.2.3: the ports of the next one would not fit).
    #[error("there is no DDS domain {0}: domains are 0 to 232")]
    Domain(u16),
    /// A node name that ROS would not take.
    #[error("`{name}` is not a ROS node name: {why}")]
    NodeName {
        /// The name.
        name: String,
        /// What is wrong with it.
        why: &'static str,
    },
    /// A discovery range in which nobody is found.
    #[error(
        "ROS_AUTOMATIC_DISCOVERY_RANGE is `{0}`: a bridge needs SUBNET (the default) or LOCALHOST"
    )]
    DiscoveryRange(String),
    /// Peers were given to a RustDDS that knows only multicast.
    #[error(
        "a list of peers needs RustDDS with this project's patches, as `cargo xtask dist` builds it"
    )]
    Peers,
    /// RustDDS could not open its sockets or start its threads.
    #[error("cannot join DDS domain {domain}: {source}")]
    Join {
        /// The domain.
        domain: u16,
        /// What RustDDS says.
        source: CreateError,
    },
    /// The files of the enclave are wrong.
    #[error("the bridge cannot be secured: {0}")]
    Security(#[from] SecurityError),
    /// RustDDS does not join with these files.
    #[error("the enclave in {} does not let the bridge into domain {domain}: {why}", .folder.display())]
    Enclave {
        /// Where the files are.
        folder: PathBuf,
        /// The domain.
        domain: u16,
        /// What RustDDS says.
        why: CreateError,
    },
    /// The ROS node could not be created.
    #[error("cannot create the ROS node: {0}")]
    Node(#[from] std::io::Error),
    /// A reader or writer could not be created.
    #[error("cannot create an endpoint of `{topic}`: {source}")]
    Endpoint {
        /// The DDS topic.
        topic: String,
        /// What RustDDS says.
        source: CreateError,
    },
}

/// A participant of a domain that is a ROS node there.
///
/// The node shows up in `ros2 node list` with the readers and writers made here, publishes the program's warnings on
/// `/rosout`, and with `use_sim_time` follows `/clock`.
pub struct Domain {
    // Dropped in this order: first the node withdraws its name, while the participant can still say so.
    node: Node,
    domain: u16,
    joined: Instant,
    /// The type hashes to announce, by DDS type name.
    type_hashes: Mutex<BTreeMap<String, String>>,
    publisher: Publisher,
    subscriber: Subscriber,
    participant: DomainParticipant,
    /// The task that is the participant's traffic, until its end was told.
    traffic: Option<JoinHandle<&'static str>>,
}

impl Domain {
    /// Joins; returns when the discovery thread runs. Blocks for some milliseconds.
    ///
    /// Called in a tokio runtime, and with the patched RustDDS, the domain's traffic is a task of that runtime: nothing
    /// is sent or heard while the runtime does not run, and the domain is to be left by [`leave`](Self::leave), which lets
    /// it run on until the goodbye is sent. Outside of one it has a thread of its own.
    ///
    /// # Panics
    /// In a runtime without IO or time.
    ///
    /// # Errors
    /// [`DomainError`].
    pub fn join(options: &DomainOptions) -> Result<Self, DomainError> {
        if options.domain > MAX_DOMAIN {
            return Err(DomainError::Domain(options.domain));
        }
        if let Some(why) = options.node.fault() {
            return Err(DomainError::NodeName {
                name: options.node.full_name(),
                why,
            });
        }
        let failed = |source| DomainError::Join {
            domain: options.domain,
            source,
        };
        let (participant, traffic) = join(options)?;
        let none = QosPolicies::qos_none();
        let publisher = participant.create_publisher(&none).map_err(failed)?;
        let subscriber = participant.create_subscriber(&none).map_err(failed)?;
        let names = (discovery_info::TOPIC, discovery_info::TYPE);
        let [heard, told] = [INFO_DEPTH, 1].map(|depth| with_hash(&info_qos(depth), INFO_HASH));
        let topic = create_topic(&participant, names, &told).map_err(failed)?;
        let channels = Channels {
            participant: participant.guid().to_bytes(),
            info_reader: subscriber
                .create_simple_datareader_no_key(&topic, Some(heard))
                .map_err(failed)?,
            info_writer: publisher
                .create_datawriter_no_key(&topic, Some(told))
                .map_err(failed)?,
        };
        let domain = Self {
            node: Node::start(options.node.clone(), channels)?,
            domain: options.domain,
            joined: Instant::now(),
            type_hashes: Mutex::default(),
            publisher,
            subscriber,
            participant,
            traffic,
        };
        domain.serve()?;
        Ok(domain)
    }

    /// What every ROS node has beside its name.
    fn serve(&self) -> Result<(), DomainError> {
        for (dds_type, hash) in [(rosout::TYPE, LOG_HASH), (clock::TYPE, CLOCK_HASH)] {
            self.learn_type_hash(dds_type, hash);
        }
        let clock = self.node.options().use_sim_time.then(|| {
            let newest = QosPolicyBuilder::new()
                .best_effort()
                .history(History::KeepLast { depth: 1 })
                .build();
            self.open_reader(clock::TOPIC, clock::TYPE, &newest)
        });
        self.node.serve(Services {
            rosout: self.open_writer(rosout::TOPIC, rosout::TYPE, &rosout::qos())?,
            clock: clock.transpose()?,
        });
        Ok(())
    }

    /// Announces this type hash (`RIHS01_` and 64 hex digits) for endpoints of that DDS type that are made from now
    /// on. RustDDS as published has no place for it; see [`can_announce_type_hashes`].
    pub fn learn_type_hash(&self, dds_type: &str, hash: impl Into<String>) {
        self.type_hashes
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .insert(dds_type.to_owned(), hash.into());
    }

    /// When it was joined. Participants that were there before become known in the 250 ms from then on.
    #[must_use]
    pub fn joined(&self) -> Instant {
        self.joined
    }

    /// Ready, once, when nothing is sent or heard any more, though the domain was not left: with the reason. It never is
    /// where the domain's traffic has a thread of its own.
    pub fn poll_end(&mut self, cx: &mut Context<'_>) -> Poll<String> {
        let Some(traffic) = &mut self.traffic else {
            return Poll::Pending;
        };
        let end = std::task::ready!(Pin::new(traffic).poll(cx));
        self.traffic = None;
        let why = end.map_or_else(|panic| panic.to_string(), str::to_owned);
        Poll::Ready(format!(
            "the DDS traffic of domain {} has ended: {why}",
            self.domain
        ))
    }

    /// What others have in the domain by now. Nodes of participants that are gone are forgotten with it.
    pub fn graph(&self) -> Graph {
        let graph = Graph::snapshot(&self.participant);
        self.node
            .retain(|prefix| graph.participants().contains(prefix));
        graph
    }

    /// Another number than before means that [`graph`](Self::graph) may be another. RustDDS as published does not say it.
    #[must_use]
    pub fn changes(&self) -> Option<u64> {
        changes_of(&self.participant)
    }

    /// The services others offer, by their names, with the types they have, as `std_srvs/SetBool`; a name that is none of
    /// ROS as it is. Those that actions are made of are left out, and those of the other bridges in `graph`.
    #[must_use]
    pub fn services(&self, graph: &Graph) -> BTreeMap<String, BTreeSet<String>> {
        offered(&self.participant, graph)
    }

    /// The readers and writers made here that were not announced to the domain: RustDDS' discovery drops what does not
    /// fit into its queue. They are to be made anew.
    #[must_use]
    pub fn unannounced(&self, graph: &Graph) -> BTreeSet<GUID> {
        self.node.unannounced(graph.own())
    }

    /// The nodes of others, as they told.
    #[must_use]
    pub fn nodes(&self) -> Vec<NodeEntities> {
        self.node.others()
    }

    /// The full name of the node an endpoint of others belongs to, if it told.
    #[must_use]
    pub fn owner(&self, endpoint: GUID) -> Option<String> {
        self.node.owner(endpoint)
    }

    /// The full names of the nodes a participant is, as it told.
    pub(crate) fn nodes_of(&self, participant: &ParticipantPrefix) -> Vec<String> {
        self.node.nodes_of(participant)
    }

    /// Whether the node's own thread has ended, by a panic: nobody is told of our nodes any more.
    pub(crate) fn is_mute(&self) -> bool {
        self.node.is_mute()
    }

    /// How many lists of nodes, of those that others publish, could not be read.
    #[must_use]
    pub fn malformed_lists(&self) -> u64 {
        self.node.malformed_lists()
    }

    /// The node's clock.
    #[must_use]
    pub fn clock(&self) -> RosClock {
        self.node.clock()
    }

    /// The participant, for its discovery snapshot.
    #[must_use]
    pub fn participant(&self) -> &DomainParticipant {
        &self.participant
    }

    /// The participant's own GUID.
    #[must_use]
    pub fn guid(&self) -> GUID {
        self.participant.guid()
    }

    /// The node's full ROS name.
    #[must_use]
    pub fn node_name(&self) -> String {
        self.node.options().full_name()
    }

    /// Discovery events of the participant.
    #[must_use]
    pub fn status_listener(&self) -> DomainParticipantStatusListener {
        self.participant.status_listener()
    }

    /// Makes the reader of a ROS topic that asks for `requested`. `topic` and `type_name` are DDS names.
    ///
    /// # Errors
    /// [`DomainError::Endpoint`].
    pub fn reader(
        &self,
        topic: &str,
        type_name: &str,
        requested: Requested,
    ) -> Result<Reader, DomainError> {
        self.open_reader(topic, type_name, &requested.policies())
    }

    /// Makes the writer of a ROS topic that offers `offered`. `topic` and `type_name` are DDS names.
    ///
    /// # Errors
    /// [`DomainError::Endpoint`].
    pub fn writer(
        &self,
        topic: &str,
        type_name: &str,
        offered: Offered,
    ) -> Result<Writer, DomainError> {
        self.open_writer(topic, type_name, &offered.policies())
    }

    /// Makes a reader of any DDS topic, which is the node's until dropped. Samples arrive as bytes.
    ///
    /// # Errors
    /// [`DomainError::Endpoint`].
    pub fn open_reader(
        &self,
        topic: &str,
        type_name: &str,
        qos: &QosPolicies,
    ) -> Result<Reader, DomainError> {
        let qos = self.with_type_hash(type_name, qos);
        create_topic(&self.participant, (topic, type_name), &qos)
            .and_then(|topic| -> Result<RawReader, CreateError> {
                self.subscriber
                    .create_simple_datareader_no_key::<Payload, Opaque>(&topic, Some(qos))
            })
            .map(|reader| self.node.list_reader(reader))
            .map_err(|source| endpoint_error(topic, source))
    }

    /// Makes a writer of any DDS topic, which is the node's until dropped. Samples are given as bytes.
    ///
    /// # Errors
    /// [`DomainError::Endpoint`].
    pub fn open_writer(
        &self,
        topic: &str,
        type_name: &str,
        qos: &QosPolicies,
    ) -> Result<Writer, DomainError> {
        let qos = self.with_type_hash(type_name, qos);
        create_topic(&self.participant, (topic, type_name), &qos)
            .and_then(|topic| -> Result<RawWriter, CreateError> {
                self.publisher
                    .create_datawriter_no_key::<Payload, Opaque>(&topic, Some(qos))
            })
            .map(|writer| self.node.list_writer(writer))
            .map_err(|source| endpoint_error(topic, source))
    }

    /// Tells other bridges that this participant is one too, for as long as the writer returned is there. It is on no
    /// node's list.
    ///
    /// # Errors
    /// [`DomainError::Endpoint`].
    pub(crate) fn announce_bridge(&self, space: u16) -> Result<RawWriter, DomainError> {
        let qos = QosPolicyBuilder::new()
            .reliable(rustdds::Duration::ZERO)
            .build();
        // It is no topic of ROS; rmw_cyclonedds looks for a hash nevertheless, and each node of it would warn.
        let qos = with_hash(&qos, PRESENCE_HASH);
        let name = bridge_topic(space);
        create_topic(&self.participant, (&name, BRIDGE_TYPE), &qos)
            .and_then(|topic| -> Result<RawWriter, CreateError> {
                self.publisher.create_datawriter_no_key(&topic, Some(qos))
            })
            .map_err(|source| endpoint_error(&name, source))
    }

    /// The policies with the type hash, if it is known.
    fn with_type_hash(&self, type_name: &str, qos: &QosPolicies) -> QosPolicies {
        let hashes = self
            .type_hashes
            .lock()
            .unwrap_or_else(PoisonError::into_inner);
        hashes
            .get(type_name)
            .map_or_else(|| qos.clone(), |hash| with_hash(qos, hash))
    }

    /// Leaves the domain, after `endpoints` (readers and writers) were disposed. Returns after [`LEAVE_WITHIN`] at the
    /// latest: RustDDS joins its threads when a participant goes, and has no bound for that.
    ///
    /// The return value says whether everything was disposed in time.
    pub async fn leave(self, endpoints: impl Send + 'static) -> bool {
        let (done, left) = tokio::sync::oneshot::channel();
        let thread = std::thread::Builder::new()
            .name("leave-domain".to_owned())
            .spawn(move || {
                drop(endpoints);
                drop(self);
                // Nobody waits any more when the time is over.
                done.send(()).ok();
            });
        match thread {
            Ok(_detached) => tokio::time::timeout(LEAVE_WITHIN, left)
                .await
                .is_ok_and(|left| left.is_ok()),
            Err(_no_thread) => false,
        }
    }
}

impl std::fmt::Debug for Domain {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Domain")
            .field("domain", &self.domain)
            .field("node", &self.node_name())
            .finish_non_exhaustive()
    }
}

/// A participant, and its traffic where that is a task.
type Joined = (DomainParticipant, Option<JoinHandle<&'static str>>);

fn join(options: &DomainOptions) -> Result<Joined, DomainError> {
    let domain = options.domain;
    let builder = participant(options)?;
    let Some(enclave) = &options.enclave else {
        return build(builder).map_err(|source| DomainError::Join { domain, source });
    };
    for advice in enclave.check()? {
        warn!("{advice}");
    }
    build(secured(builder, enclave)).map_err(|why| DomainError::Enclave {
        folder: enclave.folder.clone(),
        domain,
        why,
    })
}

#[cfg(feature = "security")]
fn secured(builder: DomainParticipantBuilder, enclave: &Enclave) -> DomainParticipantBuilder {
    let files = DomainParticipantSecurityConfigFiles::with_ros_default_names(
        &enclave.folder,
        String::new(),
    );
    builder.builtin_security(files)
}

#[cfg(not(feature = "security"))]
fn secured(
    builder: DomainParticipantBuilder,
    _nothing_to_secure_with: &Enclave,
) -> DomainParticipantBuilder {
    builder
}

/// In a runtime, which needs its IO driver, the participant's traffic is a task of it; else a thread.
#[cfg(feature = "patched-dds")]
fn build(builder: DomainParticipantBuilder) -> Result<Joined, CreateError> {
    if tokio::runtime::Handle::try_current().is_err() {
        return Ok((builder.build()?, None));
    }
    let (participant, event_loop) = builder.build_with_event_loop()?;
    let traffic = driver::spawn(event_loop).map_err(|error| CreateError::OutOfResources {
        reason: format!("the event loop cannot be watched: {error}"),
    })?;
    Ok((participant, Some(traffic)))
}

#[cfg(not(feature = "patched-dds"))]
fn build(builder: DomainParticipantBuilder) -> Result<Joined, CreateError> {
    Ok((builder.build()?, None))
}

fn participant(options: &DomainOptions) -> Result<DomainParticipantBuilder, DomainError> {
    // Announcements to 127.0.0.1 find peers on this machine without multicast; they would contradict a choice of
    // other interfaces.
    let mut builder = DomainParticipantBuilder::new(options.domain)
        .same_host_loopback(options.networks.is_empty() || options.is_local());
    if !options.networks.is_empty() {
        builder = builder.with_only_networks(options.networks.iter().copied());
    }
    #[cfg(feature = "patched-dds")]
    let builder = {
        let enclave = options.enclave.as_ref();
        let name = enclave.map_or("/", |enclave| enclave.name.as_str());
        builder.user_data(format!("enclave={name};").into_bytes())
    };
    with_peers(builder, &options.peers)
}

/// The policies with a type hash in the endpoint's user data, as every rmw of DDS puts it there (REP-2016).
#[cfg(feature = "patched-dds")]
fn with_hash(qos: &QosPolicies, hash: &str) -> QosPolicies {
    let user_data = QosPolicyBuilder::new().user_data(format!("typehash={hash};").into_bytes());
    qos.modify_by(&user_data.build())
}

#[cfg(not(feature = "patched-dds"))]
fn with_hash(qos: &QosPolicies, _hash: &str) -> QosPolicies {
    qos.clone()
}

fn create_topic(
    participant: &DomainParticipant,
    (name, type_name): (&str, &str),
    qos: &QosPolicies,
) -> Result<Topic, CreateError> {
    participant.create_topic(name.to_owned(), type_name.to_owned(), qos, TopicKind::NoKey)
}

/// The policies of `ros_discovery_info`, as rmw_dds_common has them.
fn info_qos(depth: i32) -> QosPolicies {
    QosPolicyBuilder::new()
        .reliable(rustdds::Duration::ZERO)
        .durability(Durability::TransientLocal)
        .history(History::KeepLast { depth })
        .resource_limits(ResourceLimits {
            max_samples: INFO_DEPTH,
            max_instances: 1,
            max_samples_per_instance: INFO_DEPTH,
        })
        .build()
}

/// Whether peers can be told of type hashes: RustDDS as published has no user data of its own.
#[must_use]
pub const fn can_announce_type_hashes() -> bool {
    cfg!(feature = "patched-dds")
}

// When this does not compile: the feature `patched-dds` is on, but RustDDS is as published. `cargo xtask` builds with
// both, and `cargo xtask patches` prints the flags to do so by hand.
#[cfg(feature = "patched-dds")]
fn with_peers(
    builder: DomainParticipantBuilder,
    peers: &[IpAddr],
) -> Result<DomainParticipantBuilder, DomainError> {
    Ok(builder.initial_peers(peers.iter().copied()))
}

#[cfg(not(feature = "patched-dds"))]
fn with_peers(
    builder: DomainParticipantBuilder,
    peers: &[IpAddr],
) -> Result<DomainParticipantBuilder, DomainError> {
    if peers.is_empty() {
        Ok(builder)
    } else {
        Err(DomainError::Peers)
    }
}

fn endpoint_error(topic: &str, source: CreateError) -> DomainError {
    DomainError::Endpoint {
        topic: topic.to_owned(),
        source,
    }
}

/// Lists of nodes a reader keeps until they are read, which is at once; and those RustDDS may keep unacknowledged.
const INFO_DEPTH: i32 = 256;
/// The type hashes of `rcl_interfaces/msg/Log`, `rosgraph_msgs/msg/Clock` and
/// `rmw_dds_common/msg/ParticipantEntitiesInfo`.
const LOG_HASH: &str = "RIHS01_e28ce254ca8abc06abf92773b74602cdbf116ed34fbaf294fb9f81da9f318eac";
const CLOCK_HASH: &str = "RIHS01_692f7a66e93a3c83e71765d033b60349ba68023a8c689a79e48078bcb5c58564";
const INFO_HASH: &str = "RIHS01_91a0593bacdcc50ea9bdcf849a938b128412cc1ea821245c663bcd26f83c295e";
/// The hash of `ua_bridge/msg/Presence`, of which there is never a message: one without fields.
const PRESENCE_HASH: &str =
    "RIHS01_d26c7c581663814e80adf6b78455270594107240f359b8e34121972bd039d589";
/// The highest domain whose ports fit into 16 bits.
pub const MAX_DOMAIN: u16 = 232;
/// How long [`Domain::leave`] takes at most.
pub const LEAVE_WITHIN: Duration = Duration::from_secs(2);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_older_variable_wins_as_in_rcl() {
        assert_eq!(
            DiscoveryRange::from_env(Some("SUBNET"), Some("1")).unwrap(),
            DiscoveryRange::Localhost
        );
        assert_eq!(
            DiscoveryRange::from_env(Some("LOCALHOST"), Some("0")).unwrap(),
            DiscoveryRange::Localhost
        );
        assert_eq!(
            DiscoveryRange::from_env(None, None).unwrap(),
            DiscoveryRange::Subnet
        );
    }

    #[test]
    fn a_range_without_discovery_is_refused_by_name() {
        let error = DiscoveryRange::from_env(Some("OFF"), None).unwrap_err();
        assert!(error.to_string().contains("`OFF`"), "{error}");
    }
}
