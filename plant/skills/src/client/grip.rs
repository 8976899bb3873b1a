//! Reads the grip point of a grasp skill: its own properties, its parameters, or the grip points of
//! its gripper in the earlier system.

use plant_opcua::client::{Browse, OpcUaClient};
use plant_opcua::types::{DataTypeId, NodeId, ReferenceDescription, Variant};

use super::found::{FoundParameter, Nodes, texts};
use super::lost;
use super::packed::Packed;
use crate::grip::{GripPoint, GripType};
use crate::model::{
    GRIP_POINT_OFFSET, GRIP_POINT_OPENING, GRIP_POINT_TYPE, REACH, ZONE_BOUNDS, ZONE_NAMES,
};
use crate::skill_fault::SkillFault;
use crate::value::SkillValue;
use crate::variant::from_variant;
use crate::workspace::RobotWorkspace;

/// Returns the grip point of a grasp skill; `above` are the objects above it, with their names.
pub(super) async fn read(
    client: &OpcUaClient,
    nodes: &Nodes,
    parameters: &[FoundParameter],
    above: &[(NodeId, String)],
) -> Result<Option<GripPoint>, SkillFault> {
    let names = [GRIP_POINT_OFFSET, GRIP_POINT_TYPE, GRIP_POINT_OPENING];
    let own = names.map(|name| nodes.get(name).cloned());
    if own[0].is_some() {
        return values(client, own).await.map(grip_point);
    }
    let given = names.map(|name| {
        let parameter = parameters.iter().find(|parameter| parameter.name == name);
        parameter.and_then(|parameter| parameter.default.clone())
    });
    if given[0].is_some() {
        return Ok(grip_point(given));
    }
    for (object, _) in above.iter().rev() {
        let Some(folder) = child(client, object, "GripPoints").await? else {
            continue;
        };
        let first = below(client, &folder).await?.into_iter().next();
        let Some(first) = first else { continue };
        let members = below(client, &first.node_id.node_id).await?;
        let member = |name: &str| {
            let mut members = members.iter();
            let found = members.find(|member| member.browse_name.name.as_ref() == name);
            found.map(|member| member.node_id.node_id.clone())
        };
        let nodes = ["Offset", "Type", "Range"].map(member);
        return values(client, nodes).await.map(grip_point);
    }
    Ok(None)
}

/// Returns the workspace of a move, if its component states it.
pub(super) async fn workspace(
    client: &OpcUaClient,
    nodes: &Nodes,
) -> Result<Option<RobotWorkspace>, SkillFault> {
    let own = [REACH, ZONE_NAMES, ZONE_BOUNDS].map(|name| nodes.get(name).cloned());
    if own.iter().all(Option::is_none) {
        return Ok(None);
    }
    let [reach, names, bounds] = values(client, own).await?;
    let reach = reach.and_then(|reach| reach.as_f64());
    let bounds = bounds.and_then(|bounds| bounds.as_f64s());
    let names = texts(names);
    Ok(Some(RobotWorkspace::of(
        reach,
        names,
        &bounds.unwrap_or_default(),
    )))
}

fn grip_point([offset, grip_type, opening]: [Option<SkillValue>; 3]) -> Option<GripPoint> {
    let number = grip_type.and_then(|value| value.as_f64());
    #[expect(clippy::cast_possible_truncation, reason = "an enumeration value")]
    let number = number.map(|number| number as i64);
    let opening: Option<[f64; 2]> = opening.and_then(|value| value.as_f64s()?.try_into().ok());
    Some(GripPoint {
        offset: offset?.as_f64s()?.try_into().ok()?,
        grip_type: number.and_then(GripType::of_number),
        opening: opening.map(|[low, high]| (low, high)),
    })
}

async fn values(
    client: &OpcUaClient,
    nodes: [Option<NodeId>; 3],
) -> Result<[Option<SkillValue>; 3], SkillFault> {
    let mut values = [None, None, None];
    for (value, node) in values.iter_mut().zip(nodes) {
        let Some(node) = node else { continue };
        let read = client.read(&[node]).await.map_err(|error| lost(&error))?;
        let read = read.into_iter().next().and_then(|read| read.value);
        *value = read.as_ref().and_then(plain);
    }
    Ok(values)
}

/// Converts numbers, and the structures of frames and ranges.
fn plain(variant: &Variant) -> Option<SkillValue> {
    from_variant(variant).or_else(|| {
        let structures = [DataTypeId::ThreeDFrame, DataTypeId::Range];
        let mut packed = structures
            .into_iter()
            .filter_map(|of| Packed::of(&of.into(), false));
        packed.find_map(|packed| packed.unpack(variant))
    })
}

async fn below(
    client: &OpcUaClient,
    node: &NodeId,
) -> Result<Vec<ReferenceDescription>, SkillFault> {
    let below = client.browse(node, Browse::hierarchical()).await;
    below.map_err(|error| lost(&error))
}

async fn child(
    client: &OpcUaClient,
    node: &NodeId,
    name: &str,
) -> Result<Option<NodeId>, SkillFault> {
    let below = below(client, node).await?;
    let mut below = below.into_iter();
    let found = below.find(|child| child.browse_name.name.as_ref() == name);
    Ok(found.map(|child| child.node_id.node_id))
}
