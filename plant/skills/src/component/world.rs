//! The objects of the cell that the YAML of a component lists, and grip points.

use std::collections::BTreeMap;
use std::sync::Arc;

use super::texts::read_name;
use crate::grip::{GripPoint, GripType, PartShape};
use crate::parameters::shortened;
use crate::workspace::{RobotWorkspace, Zone};
use crate::yaml::{DocumentKind, DocumentNode, YamlFindingCode, YamlReader, whole};

/// An object of the cell.
#[derive(Debug, Clone, PartialEq)]
pub struct WorldObject {
    /// The pose of its centre in the frame of the robot's base; its z axis points up.
    pub pose: [f64; 6],
    /// Its shape, if it is known.
    pub shape: Option<PartShape>,
    /// Its mass, kg.
    pub mass: Option<f64>,
}

/// The objects of the cell by their ObjectIds.
pub type World = Arc<BTreeMap<String, WorldObject>>;

/// Reads the table `world`: objects by their ObjectId.
pub(super) fn read_world(
    node: &DocumentNode,
    reader: &mut YamlReader<'_>,
) -> BTreeMap<String, WorldObject> {
    let DocumentKind::Map(pairs) = &node.kind else {
        reader.wrong(node, "a map from ObjectIds to objects");
        return BTreeMap::new();
    };
    let mut world = BTreeMap::new();
    for (key, value) in pairs {
        let Some(id) = reader.text(key, "an ObjectId").map(str::to_owned) else {
            continue;
        };
        let Some(object) = read_object(value, reader) else {
            continue;
        };
        if world.insert(id, object).is_some() {
            let message = "the object is listed twice".to_owned();
            reader.refuse::<()>(key, YamlFindingCode::DuplicateKey, message);
        }
    }
    world
}

fn read_object(node: &DocumentNode, reader: &mut YamlReader<'_>) -> Option<WorldObject> {
    let keys = ["pose", "box", "cylinder", "sphere", "mass"];
    let [pose, cuboid, cylinder, sphere, mass] = reader.map(node, keys)?;
    let pose = reader.needed(pose, "pose", node.place)?;
    let pose = read_numbers(pose, (-1000.0, 1000.0), reader);
    let shape = shape(node, [cuboid, cylinder, sphere], reader);
    let mass = match mass {
        Some(node) => Some(reader.number(node, (0.0, 10_000.0))?),
        None => None,
    };
    Some(WorldObject {
        pose: pose?,
        shape: shape?,
        mass,
    })
}

/// Reads the shape of a part: `{box: [x, y, z]}`, `{cylinder: [diameter, height]}` or
/// `{sphere: diameter}`, in m.
pub fn read_shape(node: &DocumentNode, reader: &mut YamlReader<'_>) -> Option<PartShape> {
    let given = reader.map(node, ["box", "cylinder", "sphere"])?;
    let read = shape(node, given, reader)?;
    read.or_else(|| {
        let message = "a shape is one of `box`, `cylinder` and `sphere`".to_owned();
        reader.refuse(node, YamlFindingCode::WrongValue, message)
    })
}

/// Reads an optional shape; `None` after an error.
fn shape(
    node: &DocumentNode,
    given: [Option<&DocumentNode>; 3],
    reader: &mut YamlReader<'_>,
) -> Option<Option<PartShape>> {
    match given {
        [None, None, None] => Some(None),
        [Some(cuboid), None, None] => {
            let lengths = read_numbers(cuboid, LENGTHS, reader)?;
            Some(Some(PartShape::Box(lengths)))
        }
        [None, Some(cylinder), None] => {
            let [diameter, height] = read_numbers(cylinder, LENGTHS, reader)?;
            Some(Some(PartShape::Cylinder { diameter, height }))
        }
        [None, None, Some(sphere)] => {
            let diameter = reader.number(sphere, LENGTHS)?;
            Some(Some(PartShape::Sphere(diameter)))
        }
        _ => {
            let message = "an object has one shape: `box`, `cylinder` or `sphere`".to_owned();
            reader.refuse(node, YamlFindingCode::WrongValue, message)
        }
    }
}

/// Reads the reach and the zones of a robot. `None` after an error.
pub(super) fn read_workspace(
    [reach, zones]: [Option<&DocumentNode>; 2],
    reader: &mut YamlReader<'_>,
) -> Option<Option<RobotWorkspace>> {
    if reach.is_none() && zones.is_none() {
        return Some(None);
    }
    let reach = reach.map(|node| reader.number(node, (0.01, 100.0)));
    let nodes = zones.map(|node| reader.list(node)).unwrap_or_default();
    let mut read: Vec<Zone> = Vec::new();
    let mut is_whole = true;
    for node in nodes {
        let zone = read_zone(node, reader);
        is_whole &= zone.is_some();
        let Some(zone) = zone else { continue };
        if read.iter().any(|known| known.name == zone.name) {
            let message = format!("there is a zone `{}` already", shortened(&zone.name));
            reader.refuse::<()>(node, YamlFindingCode::NameTwice, message);
        }
        read.push(zone);
    }
    let workspace = RobotWorkspace {
        reach: whole(reach)?,
        zones: read,
    };
    is_whole.then_some(Some(workspace))
}

fn read_zone(node: &DocumentNode, reader: &mut YamlReader<'_>) -> Option<Zone> {
    let [name, bounds] = reader.map(node, ["name", "box"])?;
    let name = reader.needed(name, "name", node.place);
    let name = name.and_then(|node| read_name(node, reader));
    let bounds = reader.needed(bounds, "box", node.place)?;
    let [low_x, low_y, low_z, high_x, high_y, high_z] =
        read_numbers(bounds, (-1000.0, 1000.0), reader)?;
    let (low, high) = ([low_x, low_y, low_z], [high_x, high_y, high_z]);
    if low.iter().zip(high).any(|(low, high)| *low > high) {
        let message = "`box` is the smallest x, y, z and the largest x, y, z, in this order";
        return reader.refuse(bounds, YamlFindingCode::WrongValue, message.to_owned());
    }
    Some(Zone {
        name: name?,
        low,
        high,
    })
}

/// Reads the grip point of a grasp skill.
pub(super) fn read_grip_point(
    node: &DocumentNode,
    reader: &mut YamlReader<'_>,
) -> Option<GripPoint> {
    let [offset, grip_type, opening] = reader.map(node, ["offset", "type", "opening"])?;
    let offset = reader.needed(offset, "offset", node.place)?;
    let offset = read_numbers(offset, (-10.0, 10.0), reader);
    let grip_type = match grip_type {
        Some(node) => Some(read_grip_type(node, reader)?),
        None => None,
    };
    let opening = match opening {
        Some(node) => {
            let [low, high] = read_numbers(node, (0.0, 10.0), reader)?;
            if low > high {
                let message = "`opening` is the smallest and the largest width, in this order";
                return reader.refuse(node, YamlFindingCode::WrongValue, message.to_owned());
            }
            Some((low, high))
        }
        None => None,
    };
    Some(GripPoint {
        offset: offset?,
        grip_type,
        opening,
    })
}

fn read_grip_type(node: &DocumentNode, reader: &mut YamlReader<'_>) -> Option<GripType> {
    let text = reader.text(node, "the type of a grip point")?;
    let known = GripType::ALL.into_iter().find(|of| of.name() == text);
    known.or_else(|| {
        let names = GripType::ALL.map(GripType::name).join(", ");
        let message = format!("expected one of {names}, found `{}`", shortened(text));
        reader.refuse(node, YamlFindingCode::WrongValue, message)
    })
}

/// Reads a list of `N` numbers.
pub fn read_numbers<const N: usize>(
    node: &DocumentNode,
    range: (f64, f64),
    reader: &mut YamlReader<'_>,
) -> Option<[f64; N]> {
    let nodes = reader.list(node);
    let numbers: Vec<f64> = nodes
        .iter()
        .filter_map(|node| reader.number(node, range))
        .collect();
    if numbers.len() < nodes.len() {
        return None;
    }
    let count = numbers.len();
    numbers.try_into().ok().or_else(|| {
        let message = format!("expected {N} numbers, found {count}");
        reader.refuse(node, YamlFindingCode::WrongValue, message)
    })
}

/// Lengths of parts, m.
const LENGTHS: (f64, f64) = (0.0001, 10.0);
