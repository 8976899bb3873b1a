//! Being in a DDS domain: the participant, the ROS node it stands for, and the making of endpoints.

use std::net::{IpAddr, Ipv4Addr};
use std::time::Duration;

use ros2_client::{Context, Node, NodeName, NodeOptions};
use rustdds::dds::CreateError;
use rustdds::{
    DomainParticipant, DomainParticipantBuilder, DomainParticipantStatusListener, GUID, Publisher,
    QosPolicies, RTPSEntity, Subscriber, Topic, TopicKind,
};
use thiserror::Error;

use crate::qos::{Offered, Requested};
use crate::raw::{Opaque, Payload, Reader, Writer};

/// Which domain to join and how.
#[derive(Debug, Clone)]
pub struct DomainOptions {
    /// The DDS domain, 0..=232.
    pub domain: u16,
    /// Addresses of the interfaces to use; all when empty.
    pub networks: Vec<IpAddr>,
    /// Hosts to announce ourselves to by unicast, beside multicast.
    pub peers: Vec<IpAddr>,
    /// The ROS name of the node, without namespace.
    pub node: String,
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
        why: String,
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
    /// The ROS node could not be created.
    #[error("cannot create the ROS node: {0}")]
    Node(String),
    /// A reader or writer could not be created.
    #[error("cannot create an endpoint of `{topic}`: {source}")]
    Endpoint {
        /// The DDS topic.
        topic: String,
        /// What RustDDS says.
        source: CreateError,
    },
}

/// A participant of a domain under the name of a ROS node.
///
/// The node shows up in `ros2 node list`. Its parameter services are off: `ros2-client` speaks one vendor's dialect of
/// services, and calls from another vendor's nodes would hang.
pub struct Domain {
    // Dropped in this order: first the node withdraws its name, while the participant can still say so.
    node: Node,
    context: Context,
    publisher: Publisher,
    subscriber: Subscriber,
    participant: DomainParticipant,
}

impl Domain {
    /// Joins; returns when the discovery thread runs. Blocks for some milliseconds.
    ///
    /// # Errors
    /// [`DomainError`].
    pub fn join(options: &DomainOptions) -> Result<Self, DomainError> {
        if options.domain > MAX_DOMAIN {
            return Err(DomainError::Domain(options.domain));
        }
        let name = NodeName::new("/", &options.node).map_err(|why| DomainError::NodeName {
            name: options.node.clone(),
            why: format!("{why:?}"),
        })?;
        let failed = |source| DomainError::Join {
            domain: options.domain,
            source,
        };
        // Announcements to 127.0.0.1 find peers on this machine without multicast; they would contradict a choice of
        // other interfaces.
        let mut builder = DomainParticipantBuilder::new(options.domain)
            .same_host_loopback(options.networks.is_empty() || options.is_local());
        if !options.networks.is_empty() {
            builder = builder.with_only_networks(options.networks.iter().copied());
        }
        let participant = with_peers(builder, &options.peers)?
            .build()
            .map_err(failed)?;
        let none = QosPolicies::qos_none();
        let publisher = participant.create_publisher(&none).map_err(failed)?;
        let subscriber = participant.create_subscriber(&none).map_err(failed)?;
        let context = Context::from_domain_participant(participant.clone())
            .map_err(|error| DomainError::Node(error.to_string()))?;
        let node = context
            .new_node(
                name,
                NodeOptions::new()
                    .start_parameter_services(false)
                    .enable_rosout(true),
            )
            .map_err(|error| DomainError::Node(error.to_string()))?;
        Ok(Self {
            node,
            context,
            publisher,
            subscriber,
            participant,
        })
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
        self.node.fully_qualified_name()
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

    /// Makes a reader of any DDS topic. Samples arrive as bytes.
    ///
    /// # Errors
    /// [`DomainError::Endpoint`].
    pub fn open_reader(
        &self,
        topic: &str,
        type_name: &str,
        qos: &QosPolicies,
    ) -> Result<Reader, DomainError> {
        self.topic(topic, type_name, qos)
            .and_then(|topic| {
                self.subscriber
                    .create_simple_datareader_no_key::<Payload, Opaque>(&topic, Some(qos.clone()))
            })
            .map_err(|source| endpoint_error(topic, source))
    }

    /// Makes a writer of any DDS topic. Samples are given as bytes.
    ///
    /// # Errors
    /// [`DomainError::Endpoint`].
    pub fn open_writer(
        &self,
        topic: &str,
        type_name: &str,
        qos: &QosPolicies,
    ) -> Result<Writer, DomainError> {
        self.topic(topic, type_name, qos)
            .and_then(|topic| {
                self.publisher
                    .create_datawriter_no_key::<Payload, Opaque>(&topic, Some(qos.clone()))
            })
            .map_err(|source| endpoint_error(topic, source))
    }

    fn topic(&self, name: &str, type_name: &str, qos: &QosPolicies) -> Result<Topic, CreateError> {
        self.participant
            .create_topic(name.to_owned(), type_name.to_owned(), qos, TopicKind::NoKey)
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
            .field("domain", &self.context.domain_id())
            .field("node", &self.node_name())
            .finish_non_exhaustive()
    }
}

// When this does not compile: the feature `patched-dds` is on, but RustDDS is as published. `cargo xtask` builds with
// both, and `cargo xtask dds` prints the flags to do so by hand.
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
