//! The axes, the speed and the safety state of a robot of OPC 40010-1, from values of its
//! component.

use std::future::Future;
use std::pin::Pin;

use plant_opcua::server::{Instance, InstanceError, OpcUaServer};
use plant_opcua::types::{DataValue, ExtensionObject, NodeId, StatusCode, Variant};

use super::{Maker, show, within};
use crate::server::show::date_time;
use crate::server::values::{engineering_unit, status};
use crate::value::SkillValue;
use crate::values::{LiveValue, NewestState};

/// Updates nodes at each change of a value.
pub(super) type NodeUpdates = Pin<Box<dyn Future<Output = ()> + Send>>;

/// Creates an axis for each joint of the value `JointPositions`. Returns the update of the axes, if
/// there is such a value.
pub(super) fn axes(
    maker: &mut Maker<'_>,
    arm: &Instance,
    (values, count): (&[LiveValue], usize),
) -> Result<Option<NodeUpdates>, InstanceError> {
    let Some(value) = named(values, "JointPositions") else {
        return Ok(None);
    };
    let parent = within(arm, "Axes")?;
    let mut nodes = Vec::new();
    for number in 1..=count {
        let name = format!("Axis_{number}");
        let axis = maker.make("AxisType", &name, parent.clone(), &[])?;
        show(maker.server, &axis, "MotionProfile", ROTARY);
        if let Some(unit) = &value.facts().unit {
            let unit = ExtensionObject::from_message(engineering_unit(unit));
            let path = "ParameterSet/ActualPosition/EngineeringUnits";
            show(maker.server, &axis, path, Variant::from(unit));
        }
        nodes.push(within(&axis, "ParameterSet/ActualPosition")?);
    }
    let positions = move |value: Option<&SkillValue>| -> Vec<Option<Variant>> {
        let numbers = value.and_then(SkillValue::as_f64s).unwrap_or_default();
        let at = |axis: usize| numbers.get(axis).copied().map(Variant::Double);
        (0..count).map(at).collect()
    };
    Ok(Some(keep(maker.server, nodes, value, positions)))
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

fn named<'a>(values: &'a [LiveValue], name: &str) -> Option<&'a LiveValue> {
    values.iter().find(|value| value.facts().name == name)
}

/// Shows the parts of a value at nodes, with the status and time of the value.
fn keep(
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

/// A value of AxisMotionProfileEnumeration (OPC 40010-1, 7.3.3.2).
const ROTARY: i32 = 1;
/// A value of OperationalModeEnumeration (OPC 40010-1, 7.7.3.4): values do not contain the mode.
const OTHER: i32 = 0;
/// The modes of `SafetyMode` with a protective stop, and with an emergency stop.
const PROTECTIVE: [f64; 2] = [3.0, 5.0];
const EMERGENCY: [f64; 2] = [6.0, 7.0];
