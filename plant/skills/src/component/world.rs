//! The objects of the cell that the YAML of a component lists, and grip points.

use crate::grip::{GripPoint, GripType, PartShape};
use crate::parameters::shortened;
use crate::yaml::{Code, Node, Reader};

/// Reads the shape of a part: `{box: [x, y, z]}`, `{cylinder: [diameter, height]}` or
/// `{sphere: diameter}`, in m.
pub fn read_shape(node: &Node, reader: &mut Reader<'_>) -> Option<PartShape> {
    let given = reader.map(node, ["box", "cylinder", "sphere"])?;
    let read = shape(node, given, reader)?;
    read.or_else(|| {
        let message = "a shape is one of `box`, `cylinder` and `sphere`".to_owned();
        reader.refuse(node, Code::WrongValue, message)
    })
}

/// Reads an optional shape; `None` after an error.
fn shape(
    node: &Node,
    given: [Option<&Node>; 3],
    reader: &mut Reader<'_>,
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
            reader.refuse(node, Code::WrongValue, message)
        }
    }
}

/// Reads the grip point of a grasp skill.
pub(super) fn read_grip_point(node: &Node, reader: &mut Reader<'_>) -> Option<GripPoint> {
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
                return reader.refuse(node, Code::WrongValue, message.to_owned());
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

fn read_grip_type(node: &Node, reader: &mut Reader<'_>) -> Option<GripType> {
    let text = reader.text(node, "the type of a grip point")?;
    let known = GripType::ALL.into_iter().find(|of| of.name() == text);
    known.or_else(|| {
        let names = GripType::ALL.map(GripType::name).join(", ");
        let message = format!("expected one of {names}, found `{}`", shortened(text));
        reader.refuse(node, Code::WrongValue, message)
    })
}

/// Reads a list of `N` numbers.
pub fn read_numbers<const N: usize>(
    node: &Node,
    range: (f64, f64),
    reader: &mut Reader<'_>,
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
        reader.refuse(node, Code::WrongValue, message)
    })
}

/// Lengths of parts, m.
const LENGTHS: (f64, f64) = (0.0001, 10.0);
