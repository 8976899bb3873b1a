//! The power trains of a robot of OPC 40010-1: a motor for each joint, from the values
//! `JointTemperatures` and `JointCurrents` of its component.
//!
//! Gears and drives are optional and not shown, because no value has their data.

use plant_opcua::server::{Instance, InstanceError, VariableSpec};
use plant_opcua::types::{
    DataTypeId, DataValue, LocalizedText, NodeId, QualifiedName, ReferenceTypeId, StatusCode,
    Variant,
};

use super::measured::{NodeUpdates, keep, named, numbers, show_unit};
use super::{Maker, ROBOTICS, show_unsupported, within};
use crate::server::values::{describe, variable_type};
use crate::value::{Builtin, ValueShape};
use crate::values::{LiveValue, ValueFacts};

/// Creates a power train with a motor for each joint, if there is a value of the motors. Each moves
/// the axis with its number. Returns the updates of the motors.
pub(super) fn power_trains(
    maker: &mut Maker<'_>,
    arm: &Instance,
    axes: &[NodeId],
    (values, count): (&[LiveValue], usize),
) -> Result<Vec<NodeUpdates>, InstanceError> {
    let temperatures = named(values, "JointTemperatures");
    let currents = named(values, "JointCurrents");
    if temperatures.is_none() && currents.is_none() {
        return Ok(Vec::new());
    }
    let parent = within(arm, "PowerTrains")?;
    let (mut motors, mut current_nodes) = (Vec::new(), Vec::new());
    for number in 1..=count {
        let name = format!("PowerTrain_{number}");
        let train = maker.make("PowerTrainType", &name, parent.clone(), &[])?;
        let name = format!("Motor_{number}");
        let motor = maker.make("MotorType", &name, train.node_id.clone(), &[])?;
        // The robot has a nameplate, its motors have none.
        for property in NAMEPLATE {
            show_unsupported(maker.server, &motor, property);
        }
        match temperatures {
            Some(_) => show_unit(maker.server, &motor, (temperatures, TEMPERATURE)),
            None => show_unsupported(maker.server, &motor, TEMPERATURE),
        }
        if let Some(value) = currents {
            current_nodes.push(add_current(maker, &motor, value)?);
        }
        if let Some(axis) = number.checked_sub(1).and_then(|at| axes.get(at)) {
            let robotics = maker.server.namespace(ROBOTICS).unwrap_or_default();
            let of = |id: u32| NodeId::new(robotics, id);
            maker.server.add_reference(&train.node_id, &of(MOVES), axis);
            maker
                .server
                .add_reference(axis, &of(REQUIRES), &train.node_id);
        }
        motors.push(motor);
    }
    let mut updates = Vec::new();
    if let Some(value) = temperatures {
        let nodes = motors.iter().map(|motor| within(motor, TEMPERATURE));
        let nodes = nodes.collect::<Result<_, _>>()?;
        updates.push(keep(maker.server, nodes, value, numbers(count)));
    }
    if let Some(value) = currents {
        updates.push(keep(maker.server, current_nodes, value, numbers(count)));
    }
    Ok(updates)
}

/// Adds the current of a motor, which OPC 40010-1 does not define: it has a name of the component.
fn add_current(
    maker: &mut Maker<'_>,
    motor: &Instance,
    value: &LiveValue,
) -> Result<NodeId, InstanceError> {
    let facts = ValueFacts {
        name: CURRENT.to_owned(),
        shape: ValueShape::scalar(Builtin::Double),
        unit: value.facts().unit.clone(),
        range: None,
        about: "The current of the motor.".to_owned(),
    };
    let node = maker.ids.next();
    maker.server.add_variable(&VariableSpec {
        node_id: node.clone(),
        browse_name: QualifiedName::new(node.namespace, CURRENT),
        display_name: LocalizedText::new("", CURRENT),
        type_definition: variable_type(&facts).into(),
        parent: within(motor, "ParameterSet")?,
        reference: ReferenceTypeId::HasComponent.into(),
        data_type: DataTypeId::Double.into(),
        value_rank: -1,
        value: DataValue::new_now_status(Variant::Empty, StatusCode::BadWaitingForInitialData),
        writable: false,
    })?;
    describe(maker.server, &node, &facts, maker.ids)?;
    Ok(node)
}

/// Mandatory properties of a motor (OPC 40010-1, 7.5).
const NAMEPLATE: [&str; 4] = ["Manufacturer", "Model", "ProductCode", "SerialNumber"];
/// A mandatory variable of a motor (OPC 40010-1, 7.5).
const TEMPERATURE: &str = "ParameterSet/MotorTemperature";
const CURRENT: &str = "MotorCurrent";
/// The ReferenceTypes Moves, from a power train to its axis, and Requires, from an axis to its
/// power train (OPC 40010-1, 8).
const MOVES: u32 = 18_178;
const REQUIRES: u32 = 18_179;
