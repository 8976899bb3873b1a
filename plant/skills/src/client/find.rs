//! Finds the skills of a server by their types.

use std::collections::{HashMap, HashSet};

use futures_util::{StreamExt, TryStreamExt, stream};
use plant_opcua::client::{Browse, OpcUaClient};
use plant_opcua::types::{
    AttributeId, EUInformation, NodeClass, NodeClassMask, NodeId, ObjectId, ObjectTypeId,
    QualifiedName, Range, ReferenceDescription, ReferenceTypeId, VariableId, Variant,
};

use super::fields::FoundConfiguration;
use super::found::{FoundParameter, FoundSkill, FoundType, Nodes, texts};
use super::packed::Packed;
use super::stations::STATION_FOLDERS;
use super::{grip, lost};
use crate::model::{
    CURRENT_TOOL, MOVER_ENDPOINT, NAMESPACE, OUTCOME, SKILL_TYPE, SkillType, TOOL_PLATE_OFFSET,
    alias,
};
use crate::parameters::ParameterType;
use crate::server::{CONFIGURATION, SET_FIELDS};
use crate::skill_fault::SkillFault;
use crate::tool_state::ToolState;
use crate::value::{Builtin, SkillValue, ValueShape};
use crate::variant::{builtin_of, from_variant};

/// Returns all instances of a type and its subtypes, by the names of this crate or of the earlier
/// system.
pub(super) async fn skills(
    client: &OpcUaClient,
    wanted: &ParameterType,
) -> Result<Vec<FoundSkill>, SkillFault> {
    let SkillTypes { roots, wanted } = skill_types(client, wanted).await?;
    match roots.is_empty() {
        true => Ok(Vec::new()),
        false => all(client, &wanted, &roots).await,
    }
}

/// Returns all skills, and the configurations that can be set, also of components without skills.
pub(super) async fn skills_and_configurations(
    client: &OpcUaClient,
) -> Result<(Vec<FoundSkill>, Vec<FoundConfiguration>), SkillFault> {
    let SkillTypes { roots, wanted } = skill_types(client, &ParameterType::own(SKILL_TYPE)).await?;
    // Other servers are not searched: each component has names of this namespace.
    if roots.is_empty() && client.namespace(NAMESPACE).is_none() {
        return Ok((Vec::new(), Vec::new()));
    }
    let below = instances(client, &wanted).await?;
    let skills = read_all(client, &roots, below.instances).await?;
    let configurations = configurations(client, below.configurations).await?;
    Ok((skills, configurations))
}

/// The types of skills of a server.
struct SkillTypes {
    /// SkillType, in each of its namespaces.
    roots: Vec<NodeId>,
    /// The wanted type and its subtypes.
    wanted: HashSet<NodeId>,
}

async fn skill_types(
    client: &OpcUaClient,
    wanted: &ParameterType,
) -> Result<SkillTypes, SkillFault> {
    let wanted = known_as(wanted).unwrap_or_else(|| wanted.clone());
    let mut roots = Vec::new();
    let mut types = HashSet::new();
    for of in programs(client).await? {
        let name = of.name.as_ref();
        let known = name.map(|name| known_as(name).unwrap_or_else(|| name.clone()));
        if known == Some(ParameterType::own(SKILL_TYPE)) {
            roots.push(of.id.clone());
        }
        if known.as_ref() == Some(&wanted) && !types.contains(&of.id) {
            types.extend(
                client
                    .subtypes(&of.id)
                    .await
                    .map_err(|error| lost(&error))?,
            );
        }
    }
    Ok(SkillTypes {
        roots,
        wanted: types,
    })
}

/// Returns all Programs, including Programs that are not skills.
pub(super) async fn all_programs(client: &OpcUaClient) -> Result<Vec<FoundSkill>, SkillFault> {
    let root: NodeId = ObjectTypeId::ProgramStateMachineType.into();
    let types = programs(client).await?.into_iter().map(|of| of.id);
    all(client, &types.collect(), &[root]).await
}

async fn all(
    client: &OpcUaClient,
    types: &HashSet<NodeId>,
    roots: &[NodeId],
) -> Result<Vec<FoundSkill>, SkillFault> {
    if types.is_empty() {
        return Ok(Vec::new());
    }
    let instances = instances(client, types).await?.instances;
    read_all(client, roots, instances).await
}

async fn read_all(
    client: &OpcUaClient,
    roots: &[NodeId],
    instances: Vec<Instance>,
) -> Result<Vec<FoundSkill>, SkillFault> {
    let shared = Shared::of(client, roots, &instances).await?;
    let reads = instances
        .into_iter()
        .map(|instance| read(client, &shared, instance));
    stream::iter(reads).buffered(AT_ONCE).try_collect().await
}

/// Data that several skills share and that is read once.
#[derive(Default)]
struct Shared {
    /// The supertypes of each type, by NodeId.
    chains: HashMap<NodeId, Vec<FoundType>>,
    /// Name and number in the space of each component, by the NodeId of its object.
    components: HashMap<NodeId, (String, Option<u16>)>,
    /// The ApplicationUris of the servers that a station shows, by the NodeIds of their objects.
    behind: HashMap<NodeId, Option<String>>,
}

impl Shared {
    async fn of(
        client: &OpcUaClient,
        roots: &[NodeId],
        instances: &[Instance],
    ) -> Result<Self, SkillFault> {
        let mut shared = Self::default();
        for instance in instances {
            let of = &instance.reference.type_definition.node_id;
            if !shared.chains.contains_key(of) {
                let chain = chain(client, roots, of).await?;
                shared.chains.insert(of.clone(), chain);
            }
            shared.add_component(client, &instance.above).await?;
        }
        Ok(shared)
    }

    /// Reads the component that the lowest of these objects is or belongs to.
    async fn add_component(
        &mut self,
        client: &OpcUaClient,
        above: &[(NodeId, String)],
    ) -> Result<(), SkillFault> {
        if let Some(node) = behind(above)
            && !self.behind.contains_key(node)
        {
            let uri = shown_uri(client, node).await?;
            self.behind.insert(node.clone(), uri);
        }
        if let Some((node, name)) = component_of(above)
            && !self.components.contains_key(node)
        {
            let number = number_of(client, node).await?;
            self.components.insert(node.clone(), (name.clone(), number));
        }
        Ok(())
    }
}

/// Returns the configurations with the method that sets their fields.
async fn configurations(
    client: &OpcUaClient,
    candidates: Vec<Instance>,
) -> Result<Vec<FoundConfiguration>, SkillFault> {
    let mut shared = Shared::default();
    let mut found = Vec::new();
    for Instance { reference, above } in candidates {
        let object = reference.node_id.node_id;
        let methods = Browse {
            classes: NodeClassMask::METHOD,
            ..Browse::hierarchical()
        };
        let methods = client.browse(&object, methods).await;
        let mut methods = methods.map_err(|error| lost(&error))?.into_iter();
        if !methods.any(|method| name_of(&method) == SET_FIELDS) {
            continue;
        }
        shared.add_component(client, &above).await?;
        let component = component_of(&above).and_then(|(node, _)| shared.components.get(node));
        let (component, namespace) = component.cloned().unwrap_or_default();
        found.push(FoundConfiguration {
            component,
            behind: behind(&above).and_then(|node| shared.behind.get(node)?.clone()),
            namespace,
            object,
        });
    }
    Ok(found)
}

/// Returns the type of this crate that is the equivalent of a type of the earlier system.
fn known_as(name: &ParameterType) -> Option<ParameterType> {
    alias::of(name).map(|known| ParameterType::own(known.name))
}

/// A subtype of ProgramStateMachineType.
struct ProgramType {
    id: NodeId,
    name: Option<ParameterType>,
}

/// Returns ProgramStateMachineType and its subtypes. The list is empty if the server does not have
/// the type.
async fn programs(client: &OpcUaClient) -> Result<Vec<ProgramType>, SkillFault> {
    let root: NodeId = ObjectTypeId::ProgramStateMachineType.into();
    let class = client
        .read_attributes(&[(root.clone(), AttributeId::NodeClass)])
        .await
        .map_err(|error| lost(&error))?;
    if class.first().is_none_or(|class| class.value.is_none()) {
        return Ok(Vec::new());
    }
    let ids = client.subtypes(&root).await.map_err(|error| lost(&error))?;
    let names = names(client, &ids).await?;
    let both = ids.into_iter().zip(names);
    Ok(both.map(|(id, name)| ProgramType { id, name }).collect())
}

async fn names(
    client: &OpcUaClient,
    nodes: &[NodeId],
) -> Result<Vec<Option<ParameterType>>, SkillFault> {
    let what: Vec<_> = nodes
        .iter()
        .map(|node| (node.clone(), AttributeId::BrowseName))
        .collect();
    let values = client
        .read_attributes(&what)
        .await
        .map_err(|error| lost(&error))?;
    let mut namespaces = client.namespaces();
    let index_of = |value: &Option<Variant>| match value {
        Some(Variant::QualifiedName(name)) => usize::from(name.namespace_index),
        _ => 0,
    };
    let last = values.iter().map(|value| index_of(&value.value)).max();
    if last.is_some_and(|last| last >= namespaces.len()) {
        // A station adds the namespaces of components that come.
        let all: NodeId = VariableId::Server_NamespaceArray.into();
        namespaces = texts(value(client, &all).await?);
    }
    let name = |value: Option<Variant>| match value {
        Some(Variant::QualifiedName(name)) => Some(ParameterType {
            namespace: namespaces.get(usize::from(name.namespace_index))?.clone(),
            name: name.name.as_ref().to_owned(),
        }),
        _ => None,
    };
    Ok(values.into_iter().map(|value| name(value.value)).collect())
}

/// An instance and the objects above it.
struct Instance {
    reference: ReferenceDescription,
    above: Vec<(NodeId, String)>,
}

/// The objects below Objects, level by level, in the order of the server.
#[derive(Default)]
struct ObjectsBelow {
    /// The instances of types.
    instances: Vec<Instance>,
    /// The objects with the name of the configuration of a component.
    configurations: Vec<Instance>,
}

/// Returns the instances of these types, and the configurations of components.
async fn instances(
    client: &OpcUaClient,
    types: &HashSet<NodeId>,
) -> Result<ObjectsBelow, SkillFault> {
    let mut found = ObjectsBelow::default();
    let mut seen: HashSet<NodeId> = HashSet::from([ObjectId::Server.into()]);
    let mut level: Vec<Vec<(NodeId, String)>> =
        vec![vec![(ObjectId::ObjectsFolder.into(), "Objects".to_owned())]];
    for _ in 0..DEEPEST {
        let mut next = Vec::new();
        for above in level {
            let Some((node, _)) = above.last() else {
                continue;
            };
            let what = Browse {
                classes: NodeClassMask::OBJECT,
                ..Browse::hierarchical()
            };
            let mut below = client
                .browse(node, what)
                .await
                .map_err(|error| lost(&error))?;
            below.sort_by_key(|reference| order(&reference.node_id.node_id));
            for reference in below {
                let id = reference.node_id.node_id.clone();
                if seen.len() >= MOST_OBJECTS || !seen.insert(id.clone()) {
                    continue;
                }
                let name = name_of(&reference);
                let is_instance = types.contains(&reference.type_definition.node_id);
                let list = match (is_instance, name == CONFIGURATION) {
                    (true, _) => Some(&mut found.instances),
                    (false, true) => Some(&mut found.configurations),
                    (false, false) => None,
                };
                if let Some(list) = list {
                    let above = above.clone();
                    list.push(Instance { reference, above });
                }
                if is_instance {
                    continue;
                }
                next.push(above.iter().cloned().chain([(id, name)]).collect());
            }
        }
        level = next;
    }
    Ok(found)
}

/// Returns the sort key of a node: its numeric identifier, if it has one, then its text.
fn order(id: &NodeId) -> (u16, u32, String) {
    (
        id.namespace,
        id.as_u32().unwrap_or(u32::MAX),
        id.to_string(),
    )
}

async fn read(
    client: &OpcUaClient,
    shared: &Shared,
    instance: Instance,
) -> Result<FoundSkill, SkillFault> {
    let Instance { reference, above } = instance;
    let skill = reference.node_id.node_id.clone();
    let mut nodes = Nodes {
        skill: skill.clone(),
        component: component_of(&above)
            .map(|(node, _)| node.clone())
            .unwrap_or_default(),
        children: Vec::new(),
    };
    let children = client
        .browse(&skill, Browse::hierarchical())
        .await
        .map_err(|error| lost(&error))?;
    for child in &children {
        nodes
            .children
            .push((name_of(child), child.node_id.node_id.clone()));
    }
    for group in ["CurrentState", "FinalResultData"] {
        let Some(node) = nodes.get(group).cloned() else {
            continue;
        };
        let below = client
            .browse(&node, Browse::hierarchical())
            .await
            .map_err(|error| lost(&error))?;
        for child in below {
            nodes.children.push((
                format!("{group}/{}", name_of(&child)),
                child.node_id.node_id.clone(),
            ));
        }
    }
    let mut strange = Vec::new();
    let parameters = group(client, nodes.get("ParameterSet"), &[], &mut strange).await?;
    let results = nodes.get("FinalResultData");
    let results = group(client, results, &OUTCOME, &mut strange).await?;
    let capabilities = match nodes.get("Capabilities") {
        Some(node) => texts(value(client, node).await?),
        None => Vec::new(),
    };
    let component = component_of(&above).and_then(|(node, _)| shared.components.get(node));
    let (component, namespace) = component.cloned().unwrap_or_default();
    let types = shared.chains.get(&reference.type_definition.node_id);
    let grasps = ParameterType::own("GraspSkillType");
    let is_grasp = types.is_some_and(|types| types.iter().any(|of| of.name == grasps));
    let grip_point = match is_grasp {
        true => grip::read(client, &nodes, &parameters, &above).await?,
        false => None,
    };
    let tool_state = tool_state(client, &nodes).await?;
    let workspace = grip::workspace(client, &nodes).await?;
    let own = skill
        .as_u32()
        .filter(|_| client.namespaces().get(usize::from(skill.namespace)) == Some(&uri(client)));
    let number = own
        .filter(|id| id % IDS_PER_SKILL == 0)
        .and_then(|id| u16::try_from(id / IDS_PER_SKILL).ok());
    Ok(FoundSkill {
        component,
        behind: behind(&above).and_then(|node| shared.behind.get(node)?.clone()),
        namespace,
        number: number.filter(|number| *number > 0),
        name: name_of(&reference),
        node: text_of(client, &skill),
        types: types.cloned().unwrap_or_default(),
        parameters,
        results,
        capabilities,
        tool_state,
        grip_point,
        workspace,
        strange,
        nodes,
    })
}

/// Reads the state of the tool changer of a skill; `None` if the skill has no such properties.
async fn tool_state(client: &OpcUaClient, nodes: &Nodes) -> Result<Option<ToolState>, SkillFault> {
    let Some(plate) = nodes.get(TOOL_PLATE_OFFSET) else {
        return Ok(None);
    };
    let mut texts = [None, None];
    for (text, name) in texts.iter_mut().zip([CURRENT_TOOL, MOVER_ENDPOINT]) {
        if let Some(node) = nodes.get(name) {
            let value = value(client, node).await?;
            *text = value.and_then(|value| value.as_str().map(str::to_owned));
        }
    }
    let plate = value(client, plate)
        .await?
        .and_then(|value| value.as_f64s());
    let [current, mover] = texts;
    Ok(Some(ToolState {
        plate: plate
            .and_then(|plate| plate.try_into().ok())
            .unwrap_or_default(),
        current,
        mover: mover.unwrap_or_default(),
    }))
}

/// Returns the object of the server to which a skill belongs, where a station shows the skills of
/// other servers: the nearest object in a folder of a station.
fn behind(above: &[(NodeId, String)]) -> Option<&NodeId> {
    // Objects, then pairs of a folder and a server.
    let pairs = above.get(1..)?.chunks_exact(2);
    let shown = pairs.take_while(|pair| {
        let mut folders = STATION_FOLDERS.iter();
        pair.first()
            .is_some_and(|(_, name)| folders.any(|folder| name == folder))
    });
    shown
        .filter_map(|pair| pair.last())
        .last()
        .map(|(node, _)| node)
}

/// Reads the ApplicationUri of a server that a station shows.
async fn shown_uri(client: &OpcUaClient, node: &NodeId) -> Result<Option<String>, SkillFault> {
    let properties = Browse::of(ReferenceTypeId::HasProperty);
    let properties = client.browse(node, properties).await;
    let properties = properties.map_err(|error| lost(&error))?;
    // Each station has this property in a namespace of its own.
    let mut properties = properties.iter();
    let Some(property) = properties.find(|one| one.browse_name.name.as_ref() == "ApplicationUri")
    else {
        return Ok(None);
    };
    let value = value(client, &property.node_id.node_id).await?;
    Ok(value.and_then(|value| value.as_str().map(str::to_owned)))
}

/// Returns the object above the folder Skills, and its name.
fn component_of(above: &[(NodeId, String)]) -> Option<&(NodeId, String)> {
    above.iter().rev().find(|(_, name)| name != "Skills")
}

/// Reads the number of a component in the space.
async fn number_of(client: &OpcUaClient, component: &NodeId) -> Result<Option<u16>, SkillFault> {
    let Some(index) = client.namespace(NAMESPACE) else {
        return Ok(None);
    };
    let path = [QualifiedName::new(index, "NamespaceNumber")];
    let number = match client.translate(component, &path).await {
        Ok(node) => value(client, &node).await?,
        // Components of other vendors do not have this property.
        Err(_) => None,
    };
    Ok(match number {
        Some(SkillValue::UInt16(number)) => Some(number),
        _ => None,
    })
}

async fn chain(
    client: &OpcUaClient,
    roots: &[NodeId],
    own: &NodeId,
) -> Result<Vec<FoundType>, SkillFault> {
    let mut ids = vec![own.clone()];
    ids.extend(client.supertypes(own).await.map_err(|error| lost(&error))?);
    if let Some(last) = ids.iter().rposition(|id| roots.contains(id)) {
        ids.truncate(last + 1);
    }
    let names = names(client, &ids).await?;
    let found = |(id, name): (&NodeId, Option<ParameterType>)| {
        let name = name?;
        let identifier = id.identifier.to_string();
        // A station shows a type under an identifier of its own, which contains that of the type.
        let shown = format!("s=Types/{};", name.namespace);
        Some(FoundType {
            identifier: match identifier.strip_prefix(&shown) {
                Some(own) => own.to_owned(),
                None => identifier,
            },
            name,
        })
    };
    let mut types: Vec<FoundType> = ids.iter().zip(names).filter_map(found).collect();
    // A type of the earlier system also has the types of its equivalent in this crate.
    let known = types.iter().find_map(|of| alias::of(&of.name));
    types.extend(known.into_iter().flat_map(SkillType::chain).map(own_type));
    Ok(types)
}

fn own_type(of: &'static SkillType) -> FoundType {
    FoundType {
        name: ParameterType::own(of.name),
        identifier: format!("i={}", of.id),
    }
}

/// Reads the variables of a group with their current values.
async fn group(
    client: &OpcUaClient,
    node: Option<&NodeId>,
    without: &[&str],
    strange: &mut Vec<String>,
) -> Result<Vec<FoundParameter>, SkillFault> {
    let Some(node) = node else {
        return Ok(Vec::new());
    };
    let below = client
        .browse(node, Browse::hierarchical())
        .await
        .map_err(|error| lost(&error))?;
    let mut variables: Vec<ReferenceDescription> = below
        .into_iter()
        .filter(|child| {
            child.node_class == NodeClass::Variable
                && !without.contains(&child.browse_name.name.as_ref())
        })
        .collect();
    variables.sort_by_key(|child| order(&child.node_id.node_id));
    let mut found = Vec::new();
    for child in variables {
        let id = child.node_id.node_id.clone();
        let attributes = [
            AttributeId::DataType,
            AttributeId::ValueRank,
            AttributeId::Value,
        ];
        let what = attributes.map(|attribute| (id.clone(), attribute));
        let mut values = client
            .read_attributes(&what)
            .await
            .map_err(|error| lost(&error))?
            .into_iter();
        let mut next = || values.next().and_then(|value| value.value);
        let data_type = match next() {
            Some(Variant::NodeId(of)) => Some(of),
            _ => None,
        };
        let array = matches!(next(), Some(Variant::Int32(rank)) if rank >= 0);
        let value = next();
        let packed = data_type.as_deref().and_then(|of| Packed::of(of, array));
        let shape = match packed {
            Some(_) => Some(ValueShape {
                builtin: Builtin::Double,
                array: true,
            }),
            None => {
                let builtin = data_type.as_deref().and_then(builtin_of);
                builtin.map(|builtin| ValueShape { builtin, array })
            }
        };
        let Some(shape) = shape else {
            let data_type =
                data_type.map_or_else(|| "nothing".to_owned(), |of| text_of(client, &of));
            strange.push(format!(
                "{} is of the DataType {data_type}, and a skill is told Booleans, numbers, texts and positions",
                name_of(&child)
            ));
            continue;
        };
        let mut parameter = FoundParameter {
            name: name_of(&child),
            shape,
            default: None,
            unit: unit(client, &id).await?,
            range: range(client, &id).await?,
            node: text_of(client, &id),
            id,
            packed,
        };
        parameter.default = value.as_ref().and_then(|value| parameter.shown(value));
        found.push(parameter);
    }
    Ok(found)
}

async fn unit(client: &OpcUaClient, node: &NodeId) -> Result<Option<String>, SkillFault> {
    let unit = property::<EUInformation>(client, node, "EngineeringUnits").await?;
    Ok(unit.map(|unit| unit.display_name.text.as_ref().to_owned()))
}

async fn range(client: &OpcUaClient, node: &NodeId) -> Result<Option<(f64, f64)>, SkillFault> {
    let range = property::<Range>(client, node, "EURange").await?;
    Ok(range.map(|range| (range.low, range.high)))
}

/// Returns the structure of a property; `None` if there is no such property.
async fn property<T: Clone + Send + Sync + 'static>(
    client: &OpcUaClient,
    node: &NodeId,
    name: &str,
) -> Result<Option<T>, SkillFault> {
    let Ok(node) = client.translate(node, &[QualifiedName::new(0, name)]).await else {
        return Ok(None);
    };
    let read = client.read(&[node]).await.map_err(|error| lost(&error))?;
    let value = read.into_iter().next().and_then(|value| value.value);
    let Some(Variant::ExtensionObject(object)) = value else {
        return Ok(None);
    };
    Ok(object.inner_as::<T>().cloned())
}

async fn value(client: &OpcUaClient, node: &NodeId) -> Result<Option<SkillValue>, SkillFault> {
    let values = client
        .read(std::slice::from_ref(node))
        .await
        .map_err(|error| lost(&error))?;
    Ok(values
        .first()
        .and_then(|value| value.value.as_ref())
        .and_then(from_variant))
}

fn name_of(reference: &ReferenceDescription) -> String {
    reference.browse_name.name.as_ref().to_owned()
}

/// Formats a NodeId with the URI of its namespace.
fn text_of(client: &OpcUaClient, node: &NodeId) -> String {
    match client.namespaces().get(usize::from(node.namespace)) {
        Some(uri) => format!("nsu={uri};{}", node.identifier),
        None => node.to_string(),
    }
}

/// Returns the namespace of a server's own nodes, which has index 1.
fn uri(client: &OpcUaClient) -> String {
    client.namespaces().into_iter().nth(1).unwrap_or_default()
}

/// Number of identifiers per skill.
const IDS_PER_SKILL: u32 = 100;
/// Number of skills that are read concurrently; servers commonly accept more requests per session.
const AT_ONCE: usize = 8;
/// Maximum depth of the search for skills below Objects. Each station adds two levels.
const DEEPEST: usize = 20;
/// Maximum number of objects that are searched.
const MOST_OBJECTS: usize = 4_096;
