//! Names of the space, and the YAML document that ties them to ROS topics and OPC UA nodes.

mod alarm;
mod broker;
mod call;
mod carriers;
mod check;
mod code;
mod diagnostic;
mod difference;
mod document;
mod endpoint;
mod environment;
mod ethernet;
mod findings;
mod include;
mod key_text;
mod loss;
mod mapping;
mod node_id;
mod nodesets;
mod pattern;
mod permission;
mod pubsub;
mod quality;
mod read;
mod remote;
mod schema;
mod secret;
mod security;
mod server;
mod surroundings;
mod topic;
mod tree;
mod unit;
mod variables;

pub use alarm::{Alarm, AlarmLimits, AlarmTrigger, AlarmValue};
pub use broker::{Broker, BrokerAddress, MessageMapping, MqttVersion, TopicForm};
pub use call::{
    Assigned, Assignment, Call, CallBinding, CallKind, CallTarget, ExecutedBy, FieldMap,
    MethodTarget,
};
pub use carriers::{CarrierMedium, ConfiguredCarrier, ForwardedName, SharedMemoryGroup, UdpGroup};
pub use check::{Checked, TypeOrigin, TypeUse};
pub use code::{Code, UnknownCode};
pub use diagnostic::{Diagnostic, Severity, Span};
pub use difference::Difference;
pub use documents::{harmless_json, is_obeyed, nearest};
pub use endpoint::Endpoint;
pub use environment::{Environment, LiveNode, LiveRemote, LiveServer, LiveSpace, LiveTopic};
pub use ethernet::{EthernetGroup, MacAddress};

pub use include::CheckedText;
pub use loss::{Loss, LossAction, Motion};
pub use mapping::{
    Binding, Lasting, Mapping, Meaning, Overflow, Publish, ServiceBinding, ServiceRole, Space,
    Trigger, UaField, Variable,
};
pub use node_id::{ExpandedNodeIdText, Identifier, NamespaceText, NodeIdError, NodeIdText};
pub use nodesets::{NodeSetFault, NodeSetNode, NodeSetType, NodeSets};
pub use pattern::{Pattern, PatternFault, PatternReason, PatternVariable};
pub use permission::{Anonymous, Permissions, Role};
pub use pubsub::{PubSub, PublisherIdRule};
pub use quality::{Ages, Confirm, ConfirmingValues, History};
pub use remote::{
    Access, FindSkills, NodeSource, NodeTarget, Password, RemoteServer, ServerSecurityPolicy,
    SkillsPlace, User,
};
pub use schema::schema;
pub use secret::masked;
pub use security::{GroupMode, GroupPolicy, KeySource, Replay, SecurityGroup, ServedKeys};
pub use server::{Server, ServerLimits};
pub use surroundings::{FileReaders, OpenTypeFiles, PathFault, PathFaultKind, Surroundings};
pub use topic::{NamePart, SpaceId, TopicError, TopicId};
pub use unit::Unit;
