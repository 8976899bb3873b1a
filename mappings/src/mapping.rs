//! What the document says once it is checked: every name resolved, every default filled in.

use std::collections::{BTreeMap, HashMap};
use std::net::{Ipv4Addr, SocketAddr};
use std::num::NonZeroU16;
use std::path::PathBuf;
use std::time::Duration;

use messages::{Leaf, Selection, TypeName};
use uadp::BuiltinType;

use crate::call::{Call, CallBinding};
use crate::endpoint::Endpoint;
use crate::loss::Loss;
use crate::node_id::NodeIdText;
use crate::pattern::{Pattern, PatternFault, PatternReason, PatternVariable};
use crate::permission::{Anonymous, Permissions};
use crate::quality::{Ages, Confirm, History};
use crate::remote::{FindSkills, NodeSource, NodeTarget, RemoteServer};
use crate::security::SecurityGroup;
use crate::topic::{SpaceId, TopicId};
use crate::unit::Unit;

/// The checked mapping of one cell. Immutable: a changed file makes a new one.
///
/// `Mapping::default()` is zero configuration: the PubSub defaults, no space declared (each ROS 2 space is then the
/// DDS domain of its number), no variable.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Mapping {
    pubsub: PubSub,
    spaces: Vec<Space>,
    namespaces: BTreeMap<u16, String>,
    server: Server,
    servers: Vec<RemoteServer>,
    variables: Vec<Variable>,
    by_topic: HashMap<TopicId, usize>,
    calls: Vec<Call>,
    patterns: Vec<Pattern>,
    type_paths: Vec<PathBuf>,
    pub(crate) security: Vec<SecurityGroup>,
}

impl Mapping {
    pub(crate) fn new(
        pubsub: PubSub,
        spaces: Vec<Space>,
        namespaces: BTreeMap<u16, String>,
        server: Server,
        variables: Vec<Variable>,
    ) -> Self {
        let by_topic = variables
            .iter()
            .enumerate()
            .map(|(at, v)| (v.topic, at))
            .collect();
        Self {
            pubsub,
            spaces,
            namespaces,
            server,
            servers: Vec::new(),
            variables,
            by_topic,
            calls: Vec::new(),
            patterns: Vec::new(),
            type_paths: Vec::new(),
            security: Vec::new(),
        }
    }

    /// A mapping without variables, for a program that has no document: what it writes it describes itself.
    #[must_use]
    pub fn made(pubsub: PubSub, namespaces: BTreeMap<u16, String>) -> Self {
        Self {
            pubsub,
            namespaces,
            ..Self::default()
        }
    }

    pub(crate) fn with_type_paths(mut self, paths: Vec<PathBuf>) -> Self {
        self.type_paths = paths;
        self
    }

    /// Folders and files whose definitions count before those built in. Those written relative to the mapping are below
    /// its folder.
    #[must_use]
    pub fn type_paths(&self) -> &[PathBuf] {
        &self.type_paths
    }

    /// The same with those calls, of topics that no variable has.
    #[must_use]
    pub fn with_calls(mut self, calls: Vec<Call>) -> Self {
        self.calls = calls;
        self
    }

    /// In the order of the document.
    #[must_use]
    pub fn calls(&self) -> &[Call] {
        &self.calls
    }

    /// The call of a topic, which is of an action that of its goal.
    #[must_use]
    pub fn call(&self, topic: TopicId) -> Option<&Call> {
        self.calls.iter().find(|call| call.topic == topic)
    }

    /// Every call that is executed in that space.
    pub fn executed_in(&self, space: SpaceId) -> impl Iterator<Item = &Call> {
        let calls = self.calls.iter();
        calls.filter(move |call| call.topic.space == space)
    }

    /// Every call that is asked for in that space under a name of the mapping.
    pub fn asked_in(&self, space: SpaceId) -> impl Iterator<Item = (&Call, &CallBinding)> {
        let calls = self.calls.iter();
        calls.filter_map(move |call| Some((call, call.binding(space)?)))
    }

    pub(crate) fn with_patterns(mut self, patterns: Vec<Pattern>) -> Self {
        self.patterns = patterns;
        self
    }

    /// The rules for topics that are not named, in the order of the document.
    #[must_use]
    pub fn patterns(&self) -> &[Pattern] {
        &self.patterns
    }

    /// The variable a ROS topic of a space becomes by the first pattern about it and its type, where that is known. `None` for a topic without a pattern, one
    /// that a variable is bound to, and the names of the space (`/ua_1_2_10`).
    ///
    /// # Errors
    /// The pattern makes no node of it, or one that a variable or call of the mapping has. Two topics that become one node are
    /// the caller's to tell.
    #[must_use]
    pub fn matching(
        &self,
        space: SpaceId,
        ros_topic: &str,
        message_type: Option<&TypeName>,
    ) -> Option<Result<PatternVariable, PatternFault>> {
        let name = ros_topic.strip_prefix('/').unwrap_or(ros_topic);
        if name.parse::<TopicId>().is_ok()
            || self.bindings(space).any(|(_, b)| b.ros_topic == ros_topic)
        {
            return None;
        }
        let patterns = self.patterns.iter().filter(|pattern| {
            let wanted = pattern.message_type.as_ref();
            pattern.origin() == space
                && (message_type.is_none() || wanted.is_none() || wanted == message_type)
        });
        let (pattern, made) = patterns
            .filter_map(|pattern| Some((pattern, pattern.matches(ros_topic)?)))
            .next()?;
        Some(made.and_then(|made| match self.holder(&made) {
            Some(name) => {
                let why = PatternReason::Taken(made.topic, name.to_owned());
                Err(pattern.fault(ros_topic, why))
            }
            None => Ok(made),
        }))
    }

    /// The name of the variable or call that has the topic or the node already.
    fn holder(&self, made: &PatternVariable) -> Option<&str> {
        let mut variables = self.variables.iter();
        let variable = variables.find(|v| v.topic == made.topic || v.node == made.node);
        if let Some(variable) = variable {
            return Some(&variable.name);
        }
        let mut calls = self.calls.iter();
        let call = calls.find(|c| c.node == made.node || c.topics().any(|t| t == made.topic));
        call.map(|call| call.name.as_str())
    }

    /// How NetworkMessages travel.
    #[must_use]
    pub const fn pubsub(&self) -> &PubSub {
        &self.pubsub
    }

    /// The declared ROS spaces, ordered by id.
    #[must_use]
    pub fn spaces(&self) -> &[Space] {
        &self.spaces
    }

    /// The declared space of that id.
    #[must_use]
    pub fn space(&self, id: SpaceId) -> Option<&Space> {
        self.spaces.iter().find(|space| space.id == id)
    }

    /// The DDS domain of a ROS 2 space, declared or not; `None` for the OPC UA side and ROS 1.
    #[must_use]
    pub fn domain_of(&self, id: SpaceId) -> Option<u16> {
        if !id.is_ros2() {
            return None;
        }
        self.space(id)
            .map_or_else(|| Some(id.into()), |space| space.domain)
    }

    /// The ROS 2 space whose values live in that DDS domain: the declared one, else the one of the domain's number.
    /// `None` for a domain below 2 or above 232 that no space declares, and when the space of that number is
    /// declared for another domain.
    #[must_use]
    pub fn space_of_domain(&self, domain: u16) -> Option<SpaceId> {
        if let Some(space) = self
            .spaces
            .iter()
            .find(|space| space.domain == Some(domain))
        {
            return Some(space.id);
        }
        SpaceId::new(domain).filter(|id| id.is_ros2() && self.space(*id).is_none())
    }

    /// Namespace index -> namespace URI. An index is only as good as the URI a server has at it.
    #[must_use]
    pub const fn namespaces(&self) -> &BTreeMap<u16, String> {
        &self.namespaces
    }

    /// The OPC UA server of the cell.
    #[must_use]
    pub const fn server(&self) -> &Server {
        &self.server
    }

    pub(crate) fn with_servers(mut self, servers: Vec<RemoteServer>) -> Self {
        self.servers = servers;
        self
    }

    /// The OPC UA servers that exist already, in the order of the document.
    #[must_use]
    pub fn servers(&self) -> &[RemoteServer] {
        &self.servers
    }

    /// In the order of the document.
    #[must_use]
    pub fn variables(&self) -> &[Variable] {
        &self.variables
    }

    /// The variable of a topic.
    #[must_use]
    pub fn variable(&self, topic: TopicId) -> Option<&Variable> {
        self.variables.get(*self.by_topic.get(&topic)?)
    }

    /// Every binding to a ROS topic of one space. A ROS topic occurs more than once only where its fields are read by
    /// several variables; a topic that is written occurs once.
    pub fn bindings(&self, space: SpaceId) -> impl Iterator<Item = (&Variable, &Binding)> {
        self.variables
            .iter()
            .filter_map(move |v| Some((v, v.binding(space)?)))
    }

    /// Every binding to a service of one space.
    pub fn services(&self, space: SpaceId) -> impl Iterator<Item = (&Variable, &ServiceBinding)> {
        self.variables.iter().filter_map(move |v| {
            let service = v.service.as_deref()?;
            (service.space == space).then_some((v, service))
        })
    }
}

/// A ROS service tied to a variable.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ServiceBinding {
    /// Whose ROS graph the service is in.
    pub space: SpaceId,
    /// What is done with it.
    pub role: ServiceRole,
}

/// How a service and a variable are tied.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum ServiceRole {
    /// Values that arrive from other spaces call the service. `space` is not the variable's origin.
    Call {
        /// Name of the service, with its leading `/`.
        service: String,
        /// The type of the service.
        service_type: TypeName,
        /// The request, always [`Selection::Template`]; without a field in it no value crosses.
        request: Selection,
        /// Which values call; [`Trigger::Any`] where the request has the value in it.
        when: Trigger,
        /// How long the service may take.
        timeout: Duration,
    },
    /// The value is what the service answers to the calls of another variable. `space` is this variable's origin.
    Answer {
        /// The variable with the [`ServiceRole::Call`].
        of: TopicId,
        /// What of the response is the value.
        selection: Selection,
    },
    /// The value is what the service answers when it is asked regularly. `space` is this variable's origin.
    Poll {
        /// Name of the service, with its leading `/`.
        service: String,
        /// The type of the service.
        service_type: TypeName,
        /// The request, always [`Selection::Template`] without a field.
        request: Selection,
        /// What of the response is the value.
        selection: Selection,
        /// From call to call.
        every: Duration,
        /// How long the service may take.
        timeout: Duration,
    },
}

/// Which values call a service.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Trigger {
    /// Each one.
    Any,
    /// Those equal to the literal.
    Equals(String),
}

/// How NetworkMessages travel between the spaces.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PubSub {
    /// Group or host the NetworkMessages are sent to, and its UDP port.
    pub address: SocketAddr,
    /// Name or address of the network interface; `None` lets the operating system choose.
    pub interface: Option<String>,
    /// Hops a multicast datagram may travel; 1 stays on the link.
    pub ttl: u8,
    /// When a received PublisherId is taken for a space.
    pub publisher_id: PublisherIdRule,
    /// A value that does not change is sent again after this time, which heals a lost datagram.
    pub key_frame_period: Duration,
    /// A writer that has nothing to say says so after this time.
    pub keep_alive_period: Duration,
    /// A writer that is silent for this long counts as gone; longer than `keep_alive_period`.
    pub receive_timeout: Duration,
    /// What a writer has in its messages is announced this often, beside when it begins and when it is asked for
    /// (DataSetMetaData: OPC 10000-14, 7.2.4.6.4).
    pub metadata_period: Duration,
    /// Bytes of the largest NetworkMessage that is sent as one datagram; a larger one goes in chunks of as much
    /// (OPC 10000-14, 7.2.4.4.4).
    pub max_datagram: u16,
    /// Bytes of the largest DataSetMessage that is sent, or put together from chunks.
    pub max_message: u32,
    /// The most DataSetMessages of one WriterGroup that share a NetworkMessage, as far as they are waiting to be sent and fit
    /// [`max_datagram`](Self::max_datagram) and an Ethernet frame; 1 is each alone.
    pub messages_per_datagram: u8,
}

impl PubSub {
    /// The largest UDP payload over IPv4.
    pub const LARGEST_DATAGRAM: u16 = 65_507;
    /// Room for the headers of a chunk and some of the message.
    pub const SMALLEST_DATAGRAM: u16 = 512;

    /// 239.192.0.40:4840. The group is of the IPv4 organization-local scope (RFC 2365, 6.2), so no router
    /// leaks it to the world; the port is the one registered for OPC UA over UDP (OPC 10000-14, 7.3.2).
    pub const ADDRESS: SocketAddr =
        SocketAddr::new(std::net::IpAddr::V4(Ipv4Addr::new(239, 192, 0, 40)), 4840);
    /// Reads `opc.udp://<group or host by number>:<port>`; the port is 4840 when left out (OPC 10000-14, 7.3.2).
    #[must_use]
    pub fn parse_address(url: &str) -> Option<SocketAddr> {
        let rest = url.strip_prefix("opc.udp://")?;
        let rest = rest.strip_suffix('/').unwrap_or(rest);
        let alone = || {
            rest.trim_start_matches('[')
                .trim_end_matches(']')
                .parse()
                .ok()
        };
        rest.parse()
            .ok()
            .or_else(|| Some(SocketAddr::new(alone()?, Self::ADDRESS.port())))
    }

    /// The group OPC 10000-14, 7.3.2.1 keeps for discovery messages: no data belongs there.
    pub const DISCOVERY_GROUP: Ipv4Addr = Ipv4Addr::new(224, 0, 2, 14);
}

impl Default for PubSub {
    fn default() -> Self {
        Self {
            address: Self::ADDRESS,
            interface: None,
            ttl: 1,
            publisher_id: PublisherIdRule::Exact,
            key_frame_period: Duration::from_secs(1),
            keep_alive_period: Duration::from_secs(1),
            receive_timeout: Duration::from_secs(3),
            metadata_period: Duration::from_secs(30),
            max_datagram: Self::LARGEST_DATAGRAM,
            max_message: 64 << 20,
            messages_per_datagram: 1,
        }
    }
}

/// When a received PublisherId is taken for a space.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum PublisherIdRule {
    /// Only a UInt16 of the space's number: type and value must be equal (OPC 10000-14, 7.2.4.4.2).
    #[default]
    Exact,
    /// The space's number in any unsigned integer type, for publishers that cannot send UInt16.
    AnyWidth,
}

/// A ROS side of the cell.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Space {
    /// 1 or above.
    pub id: SpaceId,
    /// The DDS domain of a ROS 2 space; `None` for ROS 1.
    pub domain: Option<u16>,
}

/// The OPC UA server of the cell.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Server {
    /// Where clients connect.
    pub endpoint: Endpoint,
    /// ApplicationUri of the server.
    pub application_uri: String,
    /// The security policies it offers, without repetition and not empty; `None` where the document says nothing.
    pub security: Option<Vec<SecurityPolicy>>,
    /// What users without a name may be.
    pub anonymous: Anonymous,
    /// Whether other servers are refused at hosts that their trusted certificates do not name.
    pub refuse_other_hosts: bool,
    /// When uncertain values of other programs are bad, where they do not say it themselves.
    pub bad_after: Option<Duration>,
    /// How much is kept of what was.
    pub history: History,
    /// How much clients may take up.
    pub limits: ServerLimits,
    /// Which servers with skills it speaks for when they are found, if any.
    pub find_skills: Option<FindSkills>,
    /// NodeSet2 files whose nodes it has beside those of the mapping.
    pub nodesets: Vec<PathBuf>,
}

/// How much clients may take up of the server; `None` is left to the server.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ServerLimits {
    /// Sessions at once.
    pub sessions: Option<u16>,
    /// Sessions of one client address, while less than an eighth of the sessions is free.
    pub sessions_per_address: Option<u16>,
    /// Connections.
    pub connections: Option<u16>,
    /// Connections of one client address.
    pub connections_per_address: Option<u16>,
    /// Subscriptions of a session.
    pub subscriptions: Option<u16>,
    /// Monitored items of a subscription.
    pub items: Option<u16>,
    /// Nodes that one request reads or writes, or items that it makes.
    pub operations: Option<u16>,
}

impl Server {
    /// The security policies it offers. Where the document says nothing these are all there are, and
    /// [`SecurityPolicy::None`] only for a server that listens on a loopback address.
    #[must_use]
    pub fn policies(&self, is_loopback: bool) -> Vec<SecurityPolicy> {
        if let Some(told) = &self.security {
            return told.clone();
        }
        let all = SecurityPolicy::ALL.iter().copied();
        all.filter(|policy| is_loopback || *policy != SecurityPolicy::None)
            .collect()
    }
}

impl Default for Server {
    fn default() -> Self {
        Self {
            endpoint: Endpoint::default(),
            application_uri: "urn:ua-bridge:server".to_owned(),
            security: None,
            anonymous: Anonymous::Usual,
            refuse_other_hosts: false,
            bad_after: None,
            history: History::default(),
            limits: ServerLimits::default(),
            find_skills: None,
            nodesets: Vec::new(),
        }
    }
}

/// A SecurityPolicy of OPC 10000-7.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum SecurityPolicy {
    /// Neither signed nor encrypted.
    None,
    /// `http://opcfoundation.org/UA/SecurityPolicy#Basic256Sha256`
    Basic256Sha256,
    /// `http://opcfoundation.org/UA/SecurityPolicy#Aes128_Sha256_RsaOaep`
    Aes128Sha256RsaOaep,
    /// `http://opcfoundation.org/UA/SecurityPolicy#Aes256_Sha256_RsaPss`
    Aes256Sha256RsaPss,
}

impl SecurityPolicy {
    /// Every policy, the weakest first.
    pub const ALL: &'static [Self] = &[
        Self::None,
        Self::Aes128Sha256RsaOaep,
        Self::Basic256Sha256,
        Self::Aes256Sha256RsaPss,
    ];

    /// The name in the URI's fragment.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::None => "None",
            Self::Basic256Sha256 => "Basic256Sha256",
            Self::Aes128Sha256RsaOaep => "Aes128_Sha256_RsaOaep",
            Self::Aes256Sha256RsaPss => "Aes256_Sha256_RsaPss",
        }
    }
}

/// One value of the space: an OPC UA node, the topic that carries it, and the ROS topics tied to it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Variable {
    /// Origin, namespace index, and the node's numeric identifier or alias.
    pub topic: TopicId,
    /// The OPC UA node.
    pub node: NodeIdText,
    /// BrowseName and DisplayName of the node, behind the folders it stands in, which dots part.
    pub name: String,
    /// Builtin type and whether it is an array; `None` when the variable has several fields, or when neither the
    /// document nor a known ROS type says it.
    pub value_type: Option<(BuiltinType, bool)>,
    /// One per DataSet field. Empty when nothing is known before a message or a type arrives.
    pub fields: Vec<Leaf>,
    /// Which field of its DataSet is the value, where its writer is none of the bridges and sends several.
    pub ua_field: Option<UaField>,
    /// At most one per space.
    pub bindings: Vec<Binding>,
    /// The service tied to it, in a space where no topic is.
    pub service: Option<Box<ServiceBinding>>,
    /// What its queue does when full.
    pub overflow: Overflow,
    /// Whether readers that come late get its last value.
    pub lasting: Lasting,
    /// Which of its values its origin sends.
    pub publish: Publish,
    /// What its numbers mean.
    pub meaning: Meaning,
    /// Who may read and write it at the server.
    pub permissions: Permissions,
    /// How old it may become.
    pub ages: Ages,
    /// How many past values are kept; `None` as many as of all.
    pub history: Option<u16>,
    /// What is published when its commander is lost.
    pub loss: Option<Box<Loss>>,
    /// The value that says that a written value has arrived.
    pub confirm: Option<Box<Confirm>>,
    /// How long a value is sent again until each bridge that it is [for](Self::destinations) has confirmed it; `None` where none
    /// does.
    pub confirmed_within: Option<Duration>,
    /// The node of another OPC UA server it comes from; its origin is the OPC UA side then.
    pub from: Option<Box<NodeSource>>,
    /// The node of another OPC UA server it is written to.
    pub to: Option<Box<NodeTarget>>,
}

/// One field of a DataSet (OPC 10000-14, 6.2.3.2.3).
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum UaField {
    /// By its place in the DataSetMessages, from 0.
    Place(u16),
    /// By its name in the DataSetMetaData that the writer announces.
    Name(String),
}

/// What the numbers of a variable mean, as far as it is said.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Meaning {
    /// Their unit of measure.
    pub unit: Option<&'static Unit>,
    /// The lowest and the highest to be expected, by their bits.
    pub(crate) range: Option<(u64, u64)>,
    /// Texts of single values.
    pub texts: BTreeMap<i64, String>,
    /// What it is, for people.
    pub description: Option<String>,
    /// Digits behind the decimal point that are worth showing.
    pub precision: Option<u8>,
}

impl Meaning {
    pub(crate) fn new(
        unit: Option<&'static Unit>,
        range: Option<(f64, f64)>,
        texts: BTreeMap<i64, String>,
    ) -> Self {
        Self {
            unit,
            range: range.map(|(low, high)| (low.to_bits(), high.to_bits())),
            texts,
            ..Self::default()
        }
    }

    /// The lowest and the highest value to be expected.
    #[must_use]
    pub fn range(&self) -> Option<(f64, f64)> {
        let (low, high) = self.range?;
        Some((f64::from_bits(low), f64::from_bits(high)))
    }
}

/// Which values of a variable are sent: by default each.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Publish {
    /// Only those that differ from the one sent last, by more than the deadband.
    pub on_change: bool,
    /// By its bits.
    deadband: u64,
    /// At least this long from one to the next; the newest of those in between follows when it is over.
    pub period: Duration,
}

impl Publish {
    /// `deadband` is 0 or greater.
    #[must_use]
    pub const fn new(on_change: bool, deadband: f64, period: Duration) -> Self {
        Self {
            on_change,
            deadband: deadband.to_bits(),
            period,
        }
    }

    /// By how much a number may differ from the one sent last without being sent itself.
    #[must_use]
    pub const fn deadband(&self) -> f64 {
        f64::from_bits(self.deadband)
    }
}

impl Variable {
    /// The binding to a ROS topic of that space.
    #[must_use]
    pub fn binding(&self, space: SpaceId) -> Option<&Binding> {
        self.bindings.iter().find(|binding| binding.space == space)
    }

    /// The other spaces whose topics or services get its values.
    pub fn destinations(&self) -> impl Iterator<Item = SpaceId> {
        let called = self.service.as_ref();
        let called = called.filter(|of| matches!(of.role, ServiceRole::Call { .. }));
        let topics = self.bindings.iter().map(|binding| binding.space);
        let all = topics.chain(called.map(|of| of.space));
        all.filter(|space| *space != self.topic.space)
    }
}

/// A ROS topic tied to a variable: read when `space` is the variable's origin, written otherwise.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Binding {
    /// Whose ROS graph the topic is in.
    pub space: SpaceId,
    /// With its leading `/`.
    pub ros_topic: String,
    /// The type of the topic.
    pub message_type: TypeName,
    /// One field of the message, all of them, or the message as it is.
    pub selection: Selection,
}

/// What a queue does when it is full.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Overflow {
    /// One place: a newer value replaces the one that waits. For states.
    #[default]
    KeepLatest,
    /// That many places: the oldest goes. For events.
    DropOldest(NonZeroU16),
}

/// Whether the last value of a variable is stored for readers that come late.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Lasting {
    /// A state: the last value is repeated while its producer is alive, and latched on the ROS side.
    State,
    /// An event or a command: delivered once, to the subscribers that are present.
    Event,
    /// A state where the ROS publisher is latched or transient-local, else an event on the ROS side. OPC UA clients see the
    /// last value in both cases.
    #[default]
    AsSource,
}

impl From<Overflow> for Lasting {
    /// The kind of a value whose queue is declared.
    fn from(overflow: Overflow) -> Self {
        match overflow {
            Overflow::KeepLatest => Self::State,
            Overflow::DropOldest(_) => Self::Event,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn id(n: u16) -> SpaceId {
        SpaceId::new(n).unwrap()
    }

    #[test]
    fn without_a_document_a_ros_2_space_is_the_domain_of_its_number() {
        let mapping = Mapping::default();
        assert_eq!(mapping.domain_of(id(7)), Some(7));
        assert_eq!(mapping.domain_of(SpaceId::ROS1), None);
        assert_eq!(mapping.domain_of(SpaceId::UA), None);
        assert_eq!(mapping.space_of_domain(7), Some(id(7)));
        assert_eq!(mapping.space_of_domain(0), None);
        assert_eq!(mapping.space_of_domain(1), None);
        assert_eq!(mapping.space_of_domain(233), None);
        assert!(mapping.variables().is_empty());
    }

    #[test]
    fn a_declared_domain_takes_the_place_of_the_number() {
        let spaces = vec![
            Space {
                id: SpaceId::ROS1,
                domain: None,
            },
            Space {
                id: id(40),
                domain: Some(0),
            },
            Space {
                id: id(41),
                domain: Some(7),
            },
        ];
        let mapping = Mapping {
            spaces,
            ..Mapping::default()
        };
        assert_eq!(mapping.domain_of(id(40)), Some(0));
        assert_eq!(mapping.space_of_domain(0), Some(id(40)));
        assert_eq!(mapping.space_of_domain(7), Some(id(41)));
        assert_eq!(
            mapping.space_of_domain(40),
            None,
            "space 40 lives in domain 0"
        );
    }

    #[test]
    fn the_default_group_stays_within_the_organization() {
        let SocketAddr::V4(address) = PubSub::default().address else {
            panic!("IPv4")
        };
        // RFC 2365, 6.2: 239.192.0.0/14
        assert_eq!(address.ip().octets()[0], 239);
        assert_eq!(address.ip().octets()[1] & 0b1111_1100, 192);
        assert!(PubSub::default().receive_timeout > PubSub::default().keep_alive_period);
    }
}
