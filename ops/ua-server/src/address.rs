//! The nodes of the address space: folders, variables and their attributes. Values are kept
//! elsewhere.

use std::collections::{HashMap, HashSet};

use mappings::{SpaceId, TopicId};
use opcua::nodes::{NodeType, ObjectBuilder, VariableBuilder};
use opcua::server::address_space::{AccessLevel, AddressSpace};
use opcua::types::{LocalizedText, NodeId, ObjectId, QualifiedName, VariableTypeId};

use crate::layout::{APPLICATION, Layout, TopicNode, VariableShape};
use crate::properties;

/// Adds a variable without a value under `folder` for each node of a topic.
pub(crate) fn add_topic(address_space: &mut AddressSpace, topic: &TopicNode, folder: &NodeId) {
    let access = access(topic);
    let (own_name, _) = topic.parts();
    let name = |node: &NodeId, text: &str| QualifiedName::new(node.namespace, text);
    let (type_, rank) = if topic.compound {
        (VariableShape(None).data_type(), 1)
    } else {
        let open = (
            VariableShape(None).data_type(),
            VariableShape(None).value_rank(),
        );
        let only = topic.fields.first();
        only.map_or(open, |field| (field.data_type(), field.shape.value_rank()))
    };
    let description = topic.meaning.description.clone();
    let description = description.unwrap_or_else(|| topic.topic.to_string());
    VariableBuilder::new(
        &topic.node,
        name(&topic.node, own_name),
        LocalizedText::from(own_name),
    )
    .description(LocalizedText::from(description))
    .data_type(type_)
    .value_rank(rank)
    .array_dimensions(&dimensions(rank))
    .minimum_sampling_interval(ON_CHANGE)
    .access_level(access)
    .user_access_level(access)
    .historizing(topic.historizing)
    .has_type_definition(VariableTypeId::BaseDataVariableType)
    .organized_by(folder.clone())
    .insert(address_space);
    if !topic.compound {
        properties::add(address_space, topic);
        return;
    }
    for field in &topic.fields {
        VariableBuilder::new(
            &field.node,
            name(&field.node, &field.name),
            LocalizedText::from(field.name.as_str()),
        )
        .data_type(field.data_type())
        .value_rank(field.shape.value_rank())
        .array_dimensions(&dimensions(field.shape.value_rank()))
        .minimum_sampling_interval(ON_CHANGE)
        .access_level(access)
        .user_access_level(access)
        .historizing(topic.historizing)
        .has_type_definition(VariableTypeId::BaseDataVariableType)
        .component_of(topic.node.clone())
        .insert(address_space);
    }
}

/// Changes the DataType and the ValueRank of a variable.
pub(crate) fn retype(address_space: &mut AddressSpace, node: &NodeId, shape: VariableShape) {
    if let Some(NodeType::Variable(variable)) = address_space.find_mut(node) {
        variable.set_data_type(shape.data_type());
        variable.set_value_rank(shape.value_rank());
        variable.set_array_dimensions(&dimensions(shape.value_rank()));
    }
}

/// Returns the ArrayDimensions of arrays of any length (OPC 10000-3, 5.6.2).
fn dimensions(rank: i32) -> Vec<u32> {
    vec![0; usize::try_from(rank).unwrap_or_default()]
}

/// The MinimumSamplingInterval of values that are reported on change.
const ON_CHANGE: f64 = 0.0;

pub(crate) fn access(topic: &TopicNode) -> AccessLevel {
    let mut level = AccessLevel::CURRENT_READ;
    level.set(AccessLevel::HISTORY_READ, topic.historizing);
    level.set(AccessLevel::CURRENT_WRITE, topic.writable());
    level
}

pub(crate) fn add_folders(layout: &Layout, address_space: &mut AddressSpace) {
    let objects = ObjectId::ObjectsFolder.into();
    add_folder(&root(), "UaSpace", objects, address_space);
    add_folder(&unmapped_folder(), "Unmapped", root(), address_space);
    let spaces: HashSet<SpaceId> = layout
        .topics
        .iter()
        .map(|topic| topic.topic.space)
        .collect();
    for space in spaces {
        add_folder(
            &origin_folder(space),
            &origin_name(space),
            root(),
            address_space,
        );
    }
}

/// Returns the rank of each node among the children of its parent: spaces by their numbers,
/// variables as in the mapping, and fields as in the message.
pub(crate) fn order(layout: &Layout) -> HashMap<NodeId, usize> {
    let mut order = HashMap::from([
        (root(), 1),
        (alarms_folder(), usize::MAX - 3),
        (programs_folder(), usize::MAX - 2),
        (components_folder(), usize::MAX - 1),
        (unmapped_folder(), usize::MAX),
    ]);
    for (at, topic) in (1..).zip(&layout.topics) {
        let space = topic.topic.space;
        order.insert(origin_folder(space), usize::from(space.get()) + 1);
        let places = topic.places();
        order.extend(places.map(|(node, field)| (node.clone(), field.map_or(at, |at| at + 1))));
    }
    order
}

pub(crate) fn add_folder(
    node: &NodeId,
    name: &str,
    parent: NodeId,
    address_space: &mut AddressSpace,
) {
    ObjectBuilder::new(
        node,
        QualifiedName::new(node.namespace, name),
        LocalizedText::from(name),
    )
    .is_folder()
    .organized_by(parent)
    .insert(address_space);
}

pub(crate) fn root() -> NodeId {
    NodeId::new(APPLICATION, "UaSpace")
}

pub(crate) fn origin_name(space: SpaceId) -> String {
    match space {
        SpaceId::UA => "OPC UA".to_owned(),
        SpaceId::ROS1 => "ROS 1".to_owned(),
        other => format!("ROS 2 space {other}"),
    }
}

pub(crate) fn origin_folder(space: SpaceId) -> NodeId {
    NodeId::new(APPLICATION, format!("UaSpace.{space}"))
}

pub(crate) fn unmapped_folder() -> NodeId {
    NodeId::new(APPLICATION, "UaSpace.Unmapped")
}

/// Returns the folder of the conditions, which is the notifier of their events.
pub(crate) fn alarms_folder() -> NodeId {
    NodeId::new(APPLICATION, "UaSpace.Alarms")
}

/// Returns the folder of the servers found in the network.
pub(crate) fn components_folder() -> NodeId {
    NodeId::new(APPLICATION, "UaSpace.Components")
}

/// Returns the folder of the calls of other spaces.
pub(crate) fn calls_folder() -> NodeId {
    NodeId::new(APPLICATION, "UaSpace.Calls")
}

/// Returns the node of an object that contains calls or further such objects. `names` are the names
/// of its parents and its own name.
pub(crate) fn call_object(names: &[&str]) -> NodeId {
    NodeId::new(APPLICATION, format!("UaSpace.Calls/{}", names.join("/")))
}

/// Returns the folder of the actions of other spaces.
pub(crate) fn programs_folder() -> NodeId {
    NodeId::new(APPLICATION, "UaSpace.Programs")
}

/// Returns the node of an object that contains Programs or further such objects. `names` are the
/// names of its parents and its own name.
pub(crate) fn program_folder(names: &[&str]) -> NodeId {
    NodeId::new(APPLICATION, format!("UaSpace.Programs/{}", names.join("/")))
}

/// Returns a node of the Program of an action. The Program itself has an empty path.
pub(crate) fn program(action: TopicId, path: &str) -> NodeId {
    let dot = if path.is_empty() { "" } else { "." };
    NodeId::new(APPLICATION, format!("{action}.program{dot}{path}"))
}

/// Returns the node of a call that the mapping does not name. A value may have the same name.
pub(crate) fn unmapped_call(topic: TopicId) -> NodeId {
    NodeId::new(APPLICATION, format!("{topic}.call"))
}
