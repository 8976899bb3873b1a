//! The axes, the speed, the load and the safety state of a robot of OPC 40010-1, from values of its
//! component.

use std::future::Future;
use std::pin::Pin;

use plant_opcua::server::{Instance, InstanceError, OpcUaServer};
use plant_opcua::types::{
    DataValue, ExtensionObject, NodeId, StatusCode, ThreeDCartesianCoordinates, ThreeDFrame,
    ThreeDOrientation, Variant,
};

use super::{Maker, show, within};
use crate::server::show::date_time;
use crate::server::values::{engineering_unit, status};
use crate::value::SkillValue;
use crate::values::{LiveValue, NewestState};

/// Updates nodes at each change of a value.
pub(super) type NodeUpdates = Pin<Box<dyn Future<Output = ()> + Send>>;

/// Creates an axis for each joint of the value `JointPositions`, with the speeds of the value
/// `JointSpeeds`. Returns the updates of the axes, and the axes.
pub(super) fn axes(
    maker: &mut Maker<'_>,
    arm: &Instance,
    (values, count): (&[LiveValue], usize),
) -> Result<(Vec<NodeUpdates>, Vec<NodeId>), InstanceError> {
    let Some(positions) = named(values, "JointPositions") else {
        return Ok((Vec::new(), Vec::new()));
    };
    let speeds = named(values, "JointSpeeds");
    let shown = [(Some(positions), POSITION), (speeds, SPEED)];
    let optional: &[&str] = if speeds.is_some() { &[SPEED] } else { &[] };
    let parent = within(arm, "Axes")?;
    let mut axes = Vec::new();
    for number in 1..=count {
        let name = format!("Axis_{number}");
        let axis = maker.make("AxisType", &name, parent.clone(), optional)?;
        show(maker.server, &axis, "MotionProfile", ROTARY);
        for (value, path) in shown {
            show_unit(maker.server, &axis, (value, path));
        }
        axes.push(axis);
    }
    let mut updates = Vec::new();
    for (value, path) in shown {
        let Some(value) = value else { continue };
        let nodes = axes.iter().map(|axis| within(axis, path));
        let nodes = nodes.collect::<Result<_, _>>()?;
        updates.push(keep(maker.server, nodes, value, numbers(count)));
    }
    let axes = axes.into_iter().map(|axis| axis.node_id);
    Ok((updates, axes.collect()))
}

/// Returns a function that gives the numbers of an array, one for each joint.
pub(super) fn numbers(
    count: usize,
) -> impl Fn(Option<&SkillValue>) -> Vec<Option<Variant>> + Send + 'static {
    move |value| {
        let numbers = value.and_then(SkillValue::as_f64s).unwrap_or_default();
        let at = |joint: usize| numbers.get(joint).copied().map(Variant::Double);
        (0..count).map(at).collect()
    }
}

/// Shows the unit of a value at an analog item.
pub(super) fn show_unit(
    server: &OpcUaServer,
    of: &Instance,
    (value, path): (Option<&LiveValue>, &str),
) {
    if let Some(unit) = value.and_then(|value| value.facts().unit.as_ref()) {
        let unit = ExtensionObject::from_message(engineering_unit(unit));
        let path = format!("{path}/EngineeringUnits");
        show(server, of, &path, Variant::from(unit));
    }
}

/// Returns the optional nodes of a motion device with the load of the values `LoadMass` and
/// `LoadCenter`. There is no load without its mass.
pub(super) fn load_nodes(values: &[LiveValue]) -> &'static [&'static str] {
    match (named(values, "LoadMass"), named(values, "LoadCenter")) {
        (None, _) => &[],
        (Some(_), None) => &["FlangeLoad"],
        (Some(_), Some(_)) => &["FlangeLoad", CENTER],
    }
}

/// Returns the updates of the load at the flange.
pub(super) fn load(
    server: &OpcUaServer,
    arm: &Instance,
    values: &[LiveValue],
) -> Result<Vec<NodeUpdates>, InstanceError> {
    let (mass, center) = (named(values, "LoadMass"), named(values, "LoadCenter"));
    let Some(value) = mass else {
        return Ok(Vec::new());
    };
    show_unit(server, arm, (mass, "FlangeLoad/Mass"));
    let mass = |value: Option<&SkillValue>| {
        let number = value.and_then(SkillValue::as_f64);
        vec![number.map(Variant::Double)]
    };
    let node = within(arm, "FlangeLoad/Mass")?;
    let mut updates = vec![keep(server, vec![node], value, mass)];
    if let Some(value) = center {
        let nodes = CENTER_NODES.map(|path| within(arm, &format!("{CENTER}{path}")));
        let nodes = nodes.into_iter().collect::<Result<_, _>>()?;
        updates.push(keep(server, nodes, value, center_parts));
    }
    Ok(updates)
}

/// Returns the values of [`CENTER_NODES`]. The frame of the centre is parallel to the frame of the
/// flange.
fn center_parts(value: Option<&SkillValue>) -> Vec<Option<Variant>> {
    let numbers = value.and_then(SkillValue::as_f64s).unwrap_or_default();
    let &[x, y, z] = numbers.as_slice() else {
        return vec![None; CENTER_NODES.len()];
    };
    let coordinates = || ThreeDCartesianCoordinates { x, y, z };
    let orientation = || ThreeDOrientation {
        a: 0.0,
        b: 0.0,
        c: 0.0,
    };
    let structures = [
        ExtensionObject::from_message(ThreeDFrame {
            cartesian_coordinates: coordinates(),
            orientation: orientation(),
        }),
        ExtensionObject::from_message(coordinates()),
        ExtensionObject::from_message(orientation()),
    ];
    let structures = structures.map(Variant::from).into_iter();
    let numbers = [x, y, z, 0.0, 0.0, 0.0].map(Variant::Double);
    structures.chain(numbers).map(Some).collect()
}

/// Returns the update of SpeedOverride from the value `SpeedScaling`, if there is such a value.
pub(super) fn speed(
    server: &OpcUaServer,
    arm: &Instance,
    values: &[LiveValue],
) -> Option<NodeUpdates> {
    let node = arm.node("ParameterSet/SpeedOverride")?.clone();
    let value = named(values, "SpeedScaling")?;
    let percent = |value: Option<&SkillValue>| {
        let number = value.and_then(SkillValue::as_f64);
        vec![number.map(Variant::Double)]
    };
    Some(keep(server, vec![node], value, percent))
}

/// Creates the safety state of the value `SafetyMode`. Returns its update, if there is such a
/// value.
pub(super) fn safety(
    maker: &mut Maker<'_>,
    system: &Instance,
    values: &[LiveValue],
) -> Result<Option<NodeUpdates>, InstanceError> {
    let Some(value) = named(values, "SafetyMode") else {
        return Ok(None);
    };
    let parent = within(system, "SafetyStates")?;
    let state = maker.make("SafetyStateType", "SafetyState", parent, &[])?;
    show(maker.server, &state, "ParameterSet/OperationalMode", OTHER);
    let nodes = ["EmergencyStop", "ProtectiveStop"];
    let nodes = nodes.map(|name| within(&state, &format!("ParameterSet/{name}")));
    let nodes: Vec<NodeId> = nodes.into_iter().collect::<Result<_, _>>()?;
    let stops = |value: Option<&SkillValue>| {
        let mode = value.and_then(SkillValue::as_f64);
        let stops = mode.map(|mode| [EMERGENCY, PROTECTIVE].map(|modes| modes.contains(&mode)));
        match stops {
            Some(stops) => stops.map(|stops| Some(Variant::Boolean(stops))).to_vec(),
            None => vec![None, None],
        }
    };
    Ok(Some(keep(maker.server, nodes, value, stops)))
}

pub(super) fn named<'a>(values: &'a [LiveValue], name: &str) -> Option<&'a LiveValue> {
    values.iter().find(|value| value.facts().name == name)
}

/// Shows the parts of a value at nodes, with the status and time of the value.
pub(super) fn keep(
    server: &OpcUaServer,
    nodes: Vec<NodeId>,
    value: &LiveValue,
    parts: impl Fn(Option<&SkillValue>) -> Vec<Option<Variant>> + Send + 'static,
) -> NodeUpdates {
    let (server, value) = (server.clone(), value.clone());
    Box::pin(async move {
        let mut readings = value.watch();
        loop {
            let reading = readings.borrow_and_update().clone();
            let parts = parts(reading.value.as_ref().ok());
            let status = status(value.facts(), &reading);
            let shown = nodes.iter().cloned().zip(parts);
            let shown = shown.map(|(node, part)| (node, shown_part(part, status, &reading)));
            if let Err(status) = server.show_all(shown.collect()) {
                tracing::warn!(value = value.facts().name, %status, "cannot show a robot");
            }
            if readings.changed().await.is_err() {
                return;
            }
        }
    })
}

/// Returns a part of a value; a part that a good value lacks is Bad.
fn shown_part(part: Option<Variant>, status: StatusCode, reading: &NewestState) -> DataValue {
    let status = match part {
        None if !status.is_bad() => StatusCode::BadNoData,
        Some(_) | None => status,
    };
    DataValue {
        value: Some(part.unwrap_or_default()),
        status: Some(status),
        source_timestamp: Some(date_time(reading.at)),
        ..DataValue::null()
    }
}

/// Nodes of an axis (OPC 40010-1, 7.3).
const POSITION: &str = "ParameterSet/ActualPosition";
const SPEED: &str = "ParameterSet/ActualSpeed";
/// The centre of mass of a load, and the nodes of its frame (OPC 40010-1, 7.9).
const CENTER: &str = "FlangeLoad/CenterOfMass";
const CENTER_NODES: [&str; 9] = [
    "",
    "/CartesianCoordinates",
    "/Orientation",
    "/CartesianCoordinates/X",
    "/CartesianCoordinates/Y",
    "/CartesianCoordinates/Z",
    "/Orientation/A",
    "/Orientation/B",
    "/Orientation/C",
];
/// A value of AxisMotionProfileEnumeration (OPC 40010-1, 7.3.3.2).
const ROTARY: i32 = 1;
/// A value of OperationalModeEnumeration (OPC 40010-1, 7.7.3.4): values do not contain the mode.
const OTHER: i32 = 0;
/// The modes of `SafetyMode` with a protective stop, and with an emergency stop.
const PROTECTIVE: [f64; 2] = [3.0, 5.0];
const EMERGENCY: [f64; 2] = [6.0, 7.0];
