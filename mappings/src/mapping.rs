//! The checked document: every name resolved, every default filled in.

use std::collections::{BTreeMap, HashMap};
use std::num::NonZeroU16;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use messages::{Leaf, Selection, TypeName};
use uadp::BuiltinType;

use crate::alarm::Alarm;
use crate::call::{Call, CallBinding};
use crate::loss::{Loss, Motion};
use crate::node_id::NodeIdText;
use crate::pattern::{Pattern, PatternFault, PatternReason, PatternVariable};
use crate::permission::Permissions;
use crate::pubsub::PubSub;
use crate::quality::{Ages, Confirm};
use crate::remote::{NodeSource, NodeTarget, RemoteServer};
use crate::security::SecurityGroup;
use crate::server::Server;
use crate::topic::{SpaceId, TopicId};
use crate::unit::Unit;

/// The checked mapping of one cell. It is immutable: a changed file makes a new mapping.
///
/// `Mapping::default()` is zero configuration: the PubSub defaults, no declared space (each ROS 2
/// space is then the DDS domain of its number), no variable.
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

    /// Returns a mapping without variables, for a program without a document, which describes its
    /// own values.
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

    /// Returns the folders and files with definitions that take precedence over the built-in
    /// definitions. Paths that are relative to the mapping are below its folder.
    #[must_use]
    pub fn type_paths(&self) -> &[PathBuf] {
        &self.type_paths
    }

    /// Returns the mapping with other calls; no variable may have one of their topics.
    #[must_use]
    pub fn with_calls(mut self, calls: Vec<Call>) -> Self {
        self.calls = calls;
        self
    }

    /// Returns the calls, in the order of the document.
    #[must_use]
    pub fn calls(&self) -> &[Call] {
        &self.calls
    }

    /// Returns the call of a topic; for an action it is the topic of its goal.
    #[must_use]
    pub fn call(&self, topic: TopicId) -> Option<&Call> {
        self.calls.iter().find(|call| call.topic == topic)
    }

    /// Returns every call that is executed in the space.
    pub fn executed_in(&self, space: SpaceId) -> impl Iterator<Item = &Call> {
        let calls = self.calls.iter();
        calls.filter(move |call| call.topic.space == space)
    }

    /// Returns every call that the space offers under a name of the mapping.
    pub fn asked_in(&self, space: SpaceId) -> impl Iterator<Item = (&Call, &CallBinding)> {
        let calls = self.calls.iter();
        calls.filter_map(move |call| Some((call, call.binding(space)?)))
    }

    pub(crate) fn with_patterns(mut self, patterns: Vec<Pattern>) -> Self {
        self.patterns = patterns;
        self
    }

    /// Returns the patterns, in the order of the document.
    #[must_use]
    pub fn patterns(&self) -> &[Pattern] {
        &self.patterns
    }

    /// Returns the variable that a ROS topic of a space becomes by the first pattern that matches
    /// the topic and, if it is known, its type. Returns `None` for a topic without a pattern, for a
    /// topic bound to a variable, and for the names of the space (`/ua_1_2_10`).
    ///
    /// # Errors
    /// The pattern makes no valid node, or makes a node that a variable or call of the mapping has.
    /// The caller has to detect two topics that become the same node.
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

    /// Returns the name of the variable or call that has the topic or the node already.
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

    /// Returns the settings for NetworkMessages.
    #[must_use]
    pub const fn pubsub(&self) -> &PubSub {
        &self.pubsub
    }

    /// Returns the declared ROS spaces, ordered by id.
    #[must_use]
    pub fn spaces(&self) -> &[Space] {
        &self.spaces
    }

    /// Returns the declared space with the id.
    #[must_use]
    pub fn space(&self, id: SpaceId) -> Option<&Space> {
        self.spaces.iter().find(|space| space.id == id)
    }

    /// Returns the DDS domain of a ROS 2 space, declared or not; `None` for the OPC UA side and ROS
    /// 1.
    #[must_use]
    pub fn domain_of(&self, id: SpaceId) -> Option<u16> {
        if !id.is_ros2() {
            return None;
        }
        self.space(id)
            .map_or_else(|| Some(id.into()), |space| space.domain)
    }

    /// Returns the ROS 2 space of a DDS domain: the space declared with this domain, else the space
    /// with the domain's number. Returns `None` for a domain below 2 or above 232 that no space
    /// declares, and if the space with that number is declared with another domain.
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

    /// Returns namespace index -> namespace URI. An index is valid only at a server with this URI
    /// at the index.
    #[must_use]
    pub const fn namespaces(&self) -> &BTreeMap<u16, String> {
        &self.namespaces
    }

    /// Returns the OPC UA server of the cell.
    #[must_use]
    pub const fn server(&self) -> &Server {
        &self.server
    }

    /// Returns the mapping for the redundant server of a rank, which counts from 1. It has the
    /// ApplicationUri of the rank, and the endpoint of the rank if it is named. Returns `None` if
    /// the mapping has no such server.
    #[must_use]
    pub fn for_rank(&self, rank: u8) -> Option<Self> {
        let at = usize::from(rank).checked_sub(1)?;
        let uri = self.server.redundant.get(at)?.clone();
        let mut mapping = self.clone();
        mapping.server.application_uri = uri;
        if let Some(endpoint) = self.server.redundant_endpoints.get(at) {
            mapping.server.endpoint = endpoint.clone();
        }
        Some(mapping)
    }

    pub(crate) fn with_servers(mut self, servers: Vec<RemoteServer>) -> Self {
        self.servers = servers;
        self
    }

    /// Returns the existing OPC UA servers, in the order of the document.
    #[must_use]
    pub fn servers(&self) -> &[RemoteServer] {
        &self.servers
    }

    /// Returns the variables, in the order of the document.
    #[must_use]
    pub fn variables(&self) -> &[Variable] {
        &self.variables
    }

    /// Returns the variable of a topic.
    #[must_use]
    pub fn variable(&self, topic: TopicId) -> Option<&Variable> {
        self.variables.get(*self.by_topic.get(&topic)?)
    }

    /// Returns every binding to a ROS topic of one space. A ROS topic occurs more than once only if
    /// several variables read its fields; a topic that is written occurs once.
    pub fn bindings(&self, space: SpaceId) -> impl Iterator<Item = (&Variable, &Binding)> {
        self.variables
            .iter()
            .filter_map(move |v| Some((v, v.binding(space)?)))
    }

    /// Returns every binding to a service of one space.
    pub fn services(&self, space: SpaceId) -> impl Iterator<Item = (&Variable, &ServiceBinding)> {
        self.variables.iter().filter_map(move |v| {
            let service = v.service.as_deref()?;
            (service.space == space).then_some((v, service))
        })
    }

    /// Returns the SecurityGroups, in the order of the document. Without groups, all messages are
    /// sent in clear.
    #[must_use]
    pub fn security(&self) -> &[SecurityGroup] {
        &self.security
    }

    /// Returns the mapping with other SecurityGroups.
    #[must_use]
    pub fn with_security(mut self, groups: Vec<SecurityGroup>) -> Self {
        self.security = groups;
        self
    }

    /// Returns the group of a namespace, secured or not.
    #[must_use]
    pub fn group_of(&self, namespace: u16) -> Option<&SecurityGroup> {
        let named = |group: &&SecurityGroup| group.namespaces.contains(&namespace);
        let rest = |group: &&SecurityGroup| group.namespaces.is_empty();
        let found = self.security.iter().find(named);
        found.or_else(|| self.security.iter().find(rest))
    }
}

/// A ROS service tied to a variable.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ServiceBinding {
    /// Space of the ROS graph with the service.
    pub space: SpaceId,
    /// Role of the service.
    pub role: ServiceRole,
}

/// Role of a service that is tied to a variable.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum ServiceRole {
    /// Values that arrive from other spaces call the service. `space` is not the variable's origin.
    Call {
        /// Name of the service, with its leading `/`.
        service: String,
        /// The type of the service.
        service_type: TypeName,
        /// Request, always [`Selection::Template`]; no value crosses if it has no field.
        request: Selection,
        /// Values that call; [`Trigger::Any`] if the request contains the value.
        when: Trigger,
        /// Longest time that the service may take.
        timeout: Duration,
    },
    /// The value is the service's response to the calls of another variable. `space` is this
    /// variable's origin.
    Answer {
        /// Variable with the [`ServiceRole::Call`].
        of: TopicId,
        /// Part of the response that is the value.
        selection: Selection,
    },
    /// The value is the response of a service that is called at regular intervals. `space` is this
    /// variable's origin.
    Poll {
        /// Name of the service, with its leading `/`.
        service: String,
        /// The type of the service.
        service_type: TypeName,
        /// Request, always [`Selection::Template`] without a field.
        request: Selection,
        /// Part of the response that is the value.
        selection: Selection,
        /// Period of the calls.
        every: Duration,
        /// Longest time that the service may take.
        timeout: Duration,
    },
}

/// Values that call a service.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Trigger {
    /// Every value.
    Any,
    /// Values equal to the literal.
    Equals(String),
}

/// ROS side of the cell.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Space {
    /// Id of the space, 1 or above.
    pub id: SpaceId,
    /// The DDS domain of a ROS 2 space; `None` for ROS 1.
    pub domain: Option<u16>,
}

/// Value of the space: an OPC UA node, the topic that carries it, and the ROS topics tied to it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Variable {
    /// Origin, namespace index, and the node's numeric identifier or alias.
    pub topic: TopicId,
    /// The OPC UA node.
    pub node: NodeIdText,
    /// BrowseName and DisplayName of the node, after the folders that contain it; dots separate
    /// them.
    pub name: String,
    /// Builtin type, and `true` for an array. `None` if the variable has several fields, or if
    /// neither the document nor a known ROS type provides it.
    pub value_type: Option<(BuiltinType, bool)>,
    /// Fields of the DataSet. Empty if they are not known before a message or a type arrives.
    pub fields: Vec<Leaf>,
    /// Field of the DataSet that is the value, if its writer is not a bridge and sends several
    /// fields.
    pub ua_field: Option<UaField>,
    /// Bindings to ROS topics, at most one per space.
    pub bindings: Vec<Binding>,
    /// Service tied to it, in a space where no topic is bound.
    pub service: Option<Box<ServiceBinding>>,
    /// Reaction of its queue when the queue is full.
    pub overflow: Overflow,
    /// Whether late subscribers get its last value.
    pub lasting: Lasting,
    /// Values that its origin sends.
    pub publish: Publish,
    /// Meaning of its numbers. Variables without any share it.
    pub meaning: Arc<Meaning>,
    /// Roles that may read and write it at the server. Variables with the default roles share them.
    pub permissions: Arc<Permissions>,
    /// Maximum ages of its values.
    pub ages: Ages,
    /// Its alarm at the server.
    pub alarm: Option<Box<Alarm>>,
    /// `true` if the server makes its values, as a DiagnosticArray, of its conditions.
    pub reports_alarms: bool,
    /// Number of past values that are kept; `None` for the number of the server's history.
    pub history: Option<u16>,
    /// Reaction to the loss of its commander.
    pub loss: Option<Box<Loss>>,
    /// Value that confirms that a written value has arrived.
    pub confirm: Option<Box<Confirm>>,
    /// Time for which a value is sent again until each bridge of its
    /// [destinations](Self::destinations) has confirmed it; `None` if bridges do not confirm it.
    pub confirmed_within: Option<Duration>,
    /// Node of another OPC UA server that it comes from; its origin is then the OPC UA side.
    pub from: Option<Box<NodeSource>>,
    /// Node of another OPC UA server that it is written to.
    pub to: Option<Box<NodeTarget>>,
}

/// Field of a DataSet (OPC 10000-14, 6.2.3.2.3).
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum UaField {
    /// Index in the DataSetMessages, from 0.
    Place(u16),
    /// Name in the DataSetMetaData that the writer announces.
    Name(String),
}

/// Meaning of the numbers of a variable, as far as the document names it.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Meaning {
    /// Unit of measure.
    pub unit: Option<&'static Unit>,
    /// Lowest and highest expected value, as bits.
    pub(crate) range: Option<(u64, u64)>,
    /// Texts of single values.
    pub texts: BTreeMap<i64, String>,
    /// Description for users.
    pub description: Option<String>,
    /// Number of digits after the decimal point that are worth showing.
    pub precision: Option<u8>,
    /// Whether its fields are copied into message headers (PromotedField: OPC 10000-14, 6.2.3.2.5).
    pub promoted: bool,
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

    /// Returns the lowest and the highest expected value.
    #[must_use]
    pub fn range(&self) -> Option<(f64, f64)> {
        let (low, high) = self.range?;
        Some((f64::from_bits(low), f64::from_bits(high)))
    }
}

/// Values of a variable that are sent; the default is all.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Publish {
    /// `true` if only values are sent that differ from the last sent value, by more than the
    /// deadband.
    pub on_change: bool,
    /// Deadband, as bits.
    deadband: u64,
    /// Shortest time between two values. The newest of the values in between is sent at its end.
    pub period: Duration,
}

impl Publish {
    /// Creates the rule; `deadband` is 0 or greater.
    #[must_use]
    pub const fn new(on_change: bool, deadband: f64, period: Duration) -> Self {
        Self {
            on_change,
            deadband: deadband.to_bits(),
            period,
        }
    }

    /// Returns the difference up to which a number equals the last sent number and is not sent.
    #[must_use]
    pub const fn deadband(&self) -> f64 {
        f64::from_bits(self.deadband)
    }
}

impl Variable {
    /// Returns the binding to a ROS topic of the space.
    #[must_use]
    pub fn binding(&self, space: SpaceId) -> Option<&Binding> {
        self.bindings.iter().find(|binding| binding.space == space)
    }

    /// Returns the ROS topics and services that it is bound to, each with its space.
    pub fn ros_names(&self) -> impl Iterator<Item = (SpaceId, &str)> {
        let topics = self.bindings.iter();
        let topics = topics.map(|binding| (binding.space, binding.ros_topic.as_str()));
        let service = self.service.as_deref().and_then(|bound| match &bound.role {
            ServiceRole::Call { service, .. } | ServiceRole::Poll { service, .. } => {
                Some((bound.space, service.as_str()))
            }
            ServiceRole::Answer { .. } => None,
        });
        topics.chain(service)
    }

    /// Returns whether its values may act where they arrive: they call a service, are written to
    /// another server, command a movement, are confirmed, or have a reaction to the loss of their
    /// commander. Values whose origin is the OPC UA side are commands too.
    #[must_use]
    pub fn is_command(&self) -> bool {
        let calls = self.service.as_deref();
        let calls = calls.is_some_and(|of| matches!(of.role, ServiceRole::Call { .. }));
        let moves = |binding: &Binding| Motion::of(&binding.message_type).is_some();
        calls
            || self.to.is_some()
            || self.bindings.iter().any(moves)
            || self.loss.is_some()
            || self.confirmed_within.is_some()
    }

    /// Returns the other spaces with topics or services that get its values.
    pub fn destinations(&self) -> impl Iterator<Item = SpaceId> {
        let called = self.service.as_ref();
        let called = called.filter(|of| matches!(of.role, ServiceRole::Call { .. }));
        let topics = self.bindings.iter().map(|binding| binding.space);
        let all = topics.chain(called.map(|of| of.space));
        all.filter(|space| *space != self.topic.space)
    }
}

/// Binding of a ROS topic to a variable: read if `space` is the variable's origin, written
/// otherwise.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Binding {
    /// Space of the ROS graph with the topic.
    pub space: SpaceId,
    /// Name of the topic, with its leading `/`.
    pub ros_topic: String,
    /// Type of the topic.
    pub message_type: TypeName,
    /// One field of the message, several or all fields, or the raw message.
    pub selection: Selection,
}

/// Reaction of a queue when it is full.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Overflow {
    /// A queue of one value: a newer value replaces the waiting value. For states.
    #[default]
    KeepLatest,
    /// A queue of this size: the oldest value is dropped. For events.
    DropOldest(NonZeroU16),
}

/// Whether the last value of a variable is stored for late subscribers.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Lasting {
    /// A state: the last value is repeated while its producer is alive, and latched on the ROS
    /// side.
    State,
    /// An event or a command: delivered once, to the subscribers that are present.
    Event,
    /// A state if the ROS publisher is latched or transient-local, else an event on the ROS side.
    /// OPC UA clients see the last value in both cases.
    #[default]
    AsSource,
}

impl From<Overflow> for Lasting {
    /// Returns the kind of a value with a declared queue.
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
    fn values_that_move_or_are_written_to_a_server_are_commands() {
        let text = "namespaces: {2: urn:cell}
spaces: [{id: 1}]
servers: [{name: plc, endpoint: 'opc.tcp://192.168.0.10:4840'}]
variables:
  - node: ns=2;i=30
    name: Robot.Ready
    type: Boolean
    origin: 1
    ros: {topic: /robot/ready, type: std_msgs/Bool}
  - node: ns=2;i=31
    name: Robot.Done
    type: Boolean
    origin: 1
    ros: {topic: /robot/done, type: std_msgs/Bool}
    to: {server: plc, node: \"nsu=urn:plc;s=Press.RobotDone\"}
  - node: ns=2;i=32
    name: Robot.Velocity
    origin: 1
    ros: {topic: /cmd_vel, type: geometry_msgs/Twist}
";
        let checked = Mapping::from_yaml(text, "cell.yaml");
        let mapping = checked.mapping.as_ref();
        let mapping = mapping.unwrap_or_else(|| panic!("{}", checked.render(text)));
        let of = |name: &str| {
            let mut variables = mapping.variables().iter();
            variables.find(|one| one.name == name).unwrap().is_command()
        };
        assert!(!of("Robot.Ready"));
        assert!(of("Robot.Done"));
        assert!(of("Robot.Velocity"));
    }
}
