//! The membership in a DDS domain: the participant, its ROS node, and the creation of endpoints.

mod range;

use std::collections::{BTreeMap, BTreeSet};
use std::net::IpAddr;
use std::path::PathBuf;
use std::pin::Pin;
use std::sync::{Arc, Mutex, PoisonError};
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

pub use self::range::DiscoveryRange;
use crate::clock::{self, Ros2Clock};
use crate::discovery_info::{self, NodeEntities};
#[cfg(feature = "patched-dds")]
use crate::driver;
use crate::graph::{BRIDGE_TYPE, Graph, bridge_topic};
use crate::node::{Channels, DomainNode, NodeOptions, NodeServices, ParticipantPrefix};
use crate::qos::{Offered, Requested};
use crate::raw::{Opaque, Payload, PayloadReader, PayloadWriter, RawReader, RawWriter};
use crate::rosout::{self, Rosout};
use crate::security::{DdsSecurityError, Enclave};
use crate::service::peers::{changes_of, offered};

/// The domain to join and its network settings.
#[derive(Debug, Clone)]
pub struct DomainOptions {
    /// The DDS domain, 0..=232.
    pub domain: u16,
    /// Addresses of the interfaces to use; empty means all interfaces.
    pub networks: Vec<IpAddr>,
    /// Hosts to which the participant is announced by unicast, in addition to multicast.
    pub peers: Vec<IpAddr>,
    /// The ROS node of the participant; a name without a namespace belongs to the root namespace.
    pub node: NodeOptions,
    /// The enclave that secures the participant, if any.
    pub enclave: Option<Enclave>,
}

impl DomainOptions {
    /// Returns whether discovery is confined to this machine.
    #[must_use]
    pub fn is_local(&self) -> bool {
        !self.networks.is_empty() && self.networks.iter().all(IpAddr::is_loopback)
    }
}

/// The reason for which a domain cannot be joined or an endpoint not be created.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum DomainError {
    /// Not a domain id (RTPS 2.5, 9.6.2.3: the ports of a higher domain would not fit).
    #[error("the DDS domain {0} does not exist: domains are 0 to 232")]
    Domain(u16),
    /// A node name that is invalid in ROS.
    #[error("`{name}` is not a ROS node name: {why}")]
    NodeName {
        /// The invalid name.
        name: String,
        /// The fault of the name.
        why: &'static str,
    },
    /// A discovery range without discovery of other nodes.
    #[error(
        "ROS_AUTOMATIC_DISCOVERY_RANGE is `{0}`: a bridge needs SUBNET (the default) or LOCALHOST"
    )]
    DiscoveryRange(String),
    /// Peers were given, but the published RustDDS supports only multicast.
    #[error(
        "this build does not support a list of peers (--ros-peer, ROS_STATIC_PEERS): use a build with the \
         patched RustDDS, as `cargo xtask dist` makes it"
    )]
    Peers,
    /// RustDDS could not open its sockets or start its threads.
    #[error("cannot join DDS domain {domain}: {source}")]
    Join {
        /// The DDS domain.
        domain: u16,
        /// The error of RustDDS.
        source: CreateError,
    },
    /// The files of the enclave are invalid.
    #[error("cannot set up DDS Security: {0}")]
    Security(#[from] DdsSecurityError),
    /// RustDDS cannot join with these files.
    #[error("cannot join domain {domain} with the enclave in {}: {why}", .folder.display())]
    Enclave {
        /// The folder of the files.
        folder: PathBuf,
        /// The DDS domain.
        domain: u16,
        /// The error of RustDDS.
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
        /// The error of RustDDS.
        source: CreateError,
    },
}

/// A participant of a domain that is a ROS node there.
///
/// `ros2 node list` shows the node with the readers and writers created here. The node publishes
/// the records of [`Domain::rosout`], and with `use_sim_time` follows `/clock`.
pub struct Domain {
    // Fields are dropped in this order: the node withdraws its name first, while the participant
    // can still announce it.
    node: DomainNode,
    domain: u16,
    joined: Instant,
    /// The type hashes to announce, by DDS type name.
    type_hashes: Mutex<BTreeMap<String, String>>,
    publisher: Publisher,
    subscriber: Subscriber,
    participant: DomainParticipant,
    /// The task of the participant's traffic, until its end was reported.
    traffic: Option<JoinHandle<&'static str>>,
}

impl Domain {
    /// Joins the domain; returns when the discovery thread runs. Blocks for some milliseconds.
    ///
    /// In a tokio runtime, and with the patched RustDDS, the domain's traffic is a task of this
    /// runtime: nothing is sent or received while the runtime does not run. The domain has to be
    /// left with [`leave`](Self::leave), which keeps the traffic running until the departure is
    /// announced. Outside of a runtime, the traffic has its own thread.
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
            node: DomainNode::start(options.node.clone(), channels)?,
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

    /// Creates the endpoints that every ROS node has in addition to its name.
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
        self.node.serve(NodeServices {
            rosout: self.open_writer(rosout::TOPIC, rosout::TYPE, &rosout::qos())?,
            clock: clock.transpose()?,
        });
        Ok(())
    }

    /// Sets the type hash (`RIHS01_` and 64 hex digits) that is announced with endpoints of this
    /// DDS type created later. The published RustDDS cannot announce it; see
    /// [`can_announce_type_hashes`].
    pub fn learn_type_hash(&self, dds_type: &str, hash: impl Into<String>) {
        self.type_hashes
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .insert(dds_type.to_owned(), hash.into());
    }

    /// Returns the time of joining. Participants that were present before are discovered within 250
    /// ms after it.
    #[must_use]
    pub fn joined(&self) -> Instant {
        self.joined
    }

    /// Returns ready, once and with the reason, when the traffic has ended although the domain was
    /// not left. Never returns ready if the traffic has its own thread.
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

    /// Returns the endpoints of other participants. Hides the nodes of lost participants until the
    /// participants return.
    pub fn graph(&self) -> Graph {
        let graph = Graph::snapshot(&self.participant);
        self.node
            .retain(|prefix| graph.participants().contains(prefix));
        graph
    }

    /// Returns the change count of discovery; a new count means that [`graph`](Self::graph) may
    /// have changed. The published RustDDS does not provide it.
    #[must_use]
    pub fn changes(&self) -> Option<u64> {
        changes_of(&self.participant)
    }

    /// Returns the services of other participants by name, with their types, such as
    /// `std_srvs/SetBool`; a type name outside of ROS is returned unchanged. Services of actions
    /// are left out, as are services of the other bridges in `graph`.
    #[must_use]
    pub fn services(&self, graph: &Graph) -> BTreeMap<String, BTreeSet<String>> {
        offered(&self.participant, graph)
    }

    /// Returns the local readers and writers that were not announced to the domain: the discovery
    /// of RustDDS drops commands that do not fit its queue. These endpoints have to be recreated.
    #[must_use]
    pub fn unannounced(&self, graph: &Graph) -> BTreeSet<GUID> {
        self.node.unannounced(graph.own())
    }

    /// Returns the announced nodes of other participants.
    #[must_use]
    pub fn nodes(&self) -> Vec<NodeEntities> {
        self.node.others()
    }

    /// Returns the full name of the node that owns a remote endpoint, if it was announced.
    #[must_use]
    pub fn owner(&self, endpoint: GUID) -> Option<String> {
        self.node.owner(endpoint)
    }

    /// Returns the full names of the nodes of a participant, as announced.
    #[must_use]
    pub fn nodes_of(&self, participant: &ParticipantPrefix) -> Vec<String> {
        self.node.nodes_of(participant)
    }

    /// Returns whether the node's thread has ended by a panic, so that nodes are no longer
    /// announced.
    #[must_use]
    pub fn is_mute(&self) -> bool {
        self.node.is_mute()
    }

    /// Returns how many node lists of other participants could not be decoded.
    #[must_use]
    pub fn malformed_lists(&self) -> u64 {
        self.node.malformed_lists()
    }

    /// Returns the queue of log records that the node publishes on `/rosout`. The program passes
    /// its warnings and errors to it.
    #[must_use]
    pub fn rosout(&self) -> Option<Arc<Rosout>> {
        self.node.rosout()
    }

    /// Returns the clock of the node.
    #[must_use]
    pub fn clock(&self) -> Ros2Clock {
        self.node.clock()
    }

    /// Returns the participant, for its discovery data.
    #[must_use]
    pub fn participant(&self) -> &DomainParticipant {
        &self.participant
    }

    /// Returns the GUID of the participant.
    #[must_use]
    pub fn guid(&self) -> GUID {
        self.participant.guid()
    }

    /// Returns the full ROS name of the node.
    #[must_use]
    pub fn node_name(&self) -> String {
        self.node.options().full_name()
    }

    /// Returns the listener for discovery events of the participant.
    #[must_use]
    pub fn status_listener(&self) -> DomainParticipantStatusListener {
        self.participant.status_listener()
    }

    /// Creates the reader of a ROS topic with the `requested` QoS. `topic` and `type_name` are DDS
    /// names.
    ///
    /// # Errors
    /// [`DomainError::Endpoint`].
    pub fn reader(
        &self,
        topic: &str,
        type_name: &str,
        requested: Requested,
    ) -> Result<PayloadReader, DomainError> {
        self.open_reader(topic, type_name, &requested.policies())
    }

    /// Creates the writer of a ROS topic with the `offered` QoS. `topic` and `type_name` are DDS
    /// names.
    ///
    /// # Errors
    /// [`DomainError::Endpoint`].
    pub fn writer(
        &self,
        topic: &str,
        type_name: &str,
        offered: Offered,
    ) -> Result<PayloadWriter, DomainError> {
        self.open_writer(topic, type_name, &offered.policies())
    }

    /// Creates a reader of any DDS topic, which belongs to the node until dropped. Samples are
    /// received as bytes.
    ///
    /// # Errors
    /// [`DomainError::Endpoint`].
    pub fn open_reader(
        &self,
        topic: &str,
        type_name: &str,
        qos: &QosPolicies,
    ) -> Result<PayloadReader, DomainError> {
        let qos = self.with_type_hash(type_name, qos);
        create_topic(&self.participant, (topic, type_name), &qos)
            .and_then(|topic| -> Result<RawReader, CreateError> {
                self.subscriber
                    .create_simple_datareader_no_key::<Payload, Opaque>(&topic, Some(qos))
            })
            .map(|reader| self.node.list_reader(reader))
            .map_err(|source| endpoint_error(topic, source))
    }

    /// Creates a writer of any DDS topic, which belongs to the node until dropped. Samples are
    /// passed as bytes.
    ///
    /// # Errors
    /// [`DomainError::Endpoint`].
    pub fn open_writer(
        &self,
        topic: &str,
        type_name: &str,
        qos: &QosPolicies,
    ) -> Result<PayloadWriter, DomainError> {
        let qos = self.with_type_hash(type_name, qos);
        create_topic(&self.participant, (topic, type_name), &qos)
            .and_then(|topic| -> Result<RawWriter, CreateError> {
                self.publisher
                    .create_datawriter_no_key::<Payload, Opaque>(&topic, Some(qos))
            })
            .map(|writer| self.node.list_writer(writer))
            .map_err(|source| endpoint_error(topic, source))
    }

    /// Announces to other bridges that this participant is a bridge, for as long as the returned
    /// writer exists. The writer belongs to no node.
    ///
    /// # Errors
    /// [`DomainError::Endpoint`].
    pub fn announce_bridge(&self, space: u16) -> Result<RawWriter, DomainError> {
        let qos = QosPolicyBuilder::new()
            .reliable(rustdds::Duration::ZERO)
            .build();
        // The topic is not a ROS topic; rmw_cyclonedds reads a hash nevertheless, and each of its
        // nodes would log a warning.
        let qos = with_hash(&qos, PRESENCE_HASH);
        let name = bridge_topic(space);
        create_topic(&self.participant, (&name, BRIDGE_TYPE), &qos)
            .and_then(|topic| -> Result<RawWriter, CreateError> {
                self.publisher.create_datawriter_no_key(&topic, Some(qos))
            })
            .map_err(|source| endpoint_error(&name, source))
    }

    /// Returns the policies with the type hash, if it is known.
    fn with_type_hash(&self, type_name: &str, qos: &QosPolicies) -> QosPolicies {
        let hashes = self
            .type_hashes
            .lock()
            .unwrap_or_else(PoisonError::into_inner);
        hashes
            .get(type_name)
            .map_or_else(|| qos.clone(), |hash| with_hash(qos, hash))
    }

    /// Leaves the domain after `endpoints` (readers and writers) were disposed. Returns after
    /// [`LEAVE_WITHIN`] at the latest: RustDDS joins its threads without a time limit when a
    /// participant is dropped.
    ///
    /// Returns whether everything was disposed in time.
    pub async fn leave(self, endpoints: impl Send + 'static) -> bool {
        let (done, left) = tokio::sync::oneshot::channel();
        let thread = std::thread::Builder::new()
            .name("leave-domain".to_owned())
            .spawn(move || {
                drop(endpoints);
                drop(self);
                // The receiver is dropped after the time limit.
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

/// A participant, and its traffic if it is a task.
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

/// Builds the participant. In a runtime, which needs its IO driver, the traffic is a task of the
/// runtime; otherwise it has a thread.
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
    // Announcements to 127.0.0.1 find peers on this machine without multicast; they would
    // contradict a choice of other interfaces.
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

/// Returns the policies with a type hash in the endpoint's user data, where every DDS-based rmw
/// places it (REP-2016).
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

/// Returns the policies of `ros_discovery_info`, as in rmw_dds_common.
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

/// Returns whether endpoints can announce type hashes: the published RustDDS cannot set user data.
#[must_use]
pub const fn can_announce_type_hashes() -> bool {
    cfg!(feature = "patched-dds")
}

// A compile error here means that the feature `patched-dds` is on, but RustDDS is the published
// version. `cargo xtask` builds with both, and `cargo xtask patches` prints the flags for a manual
// build.
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

/// Node lists that a reader keeps until they are read, which happens at once, and that RustDDS may
/// keep unacknowledged.
const INFO_DEPTH: i32 = 256;
/// The type hashes of `rcl_interfaces/msg/Log`, `rosgraph_msgs/msg/Clock` and
/// `rmw_dds_common/msg/ParticipantEntitiesInfo`.
const LOG_HASH: &str = "RIHS01_e28ce254ca8abc06abf92773b74602cdbf116ed34fbaf294fb9f81da9f318eac";
const CLOCK_HASH: &str = "RIHS01_692f7a66e93a3c83e71765d033b60349ba68023a8c689a79e48078bcb5c58564";
const INFO_HASH: &str = "RIHS01_91a0593bacdcc50ea9bdcf849a938b128412cc1ea821245c663bcd26f83c295e";
/// The hash of `ua_bridge/msg/Presence`, a type without fields of which no message is ever sent.
const PRESENCE_HASH: &str =
    "RIHS01_d26c7c581663814e80adf6b78455270594107240f359b8e34121972bd039d589";
/// The highest DDS domain: its ports still fit into 16 bits.
pub const MAX_DOMAIN: u16 = 232;
/// The time limit of [`Domain::leave`].
pub const LEAVE_WITHIN: Duration = Duration::from_secs(2);
