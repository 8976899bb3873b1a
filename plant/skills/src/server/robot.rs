//! A robot as defined by OPC 40010-1, beside its skills: the running skill is the program of its
//! only task control.
//!
//! The axes, the speed override, the load at the flange and the safety state are shown from the
//! values of the component (`measured`), and so are the motors of its power trains
//! (`power_trains`).

mod measured;
mod power_trains;

use std::future::Future;

use futures_util::future::{join_all, select_all};
use plant_opcua::server::{IdRange, Instance, InstanceError, InstanceSpec, OpcUaServer};
use plant_opcua::types::{DataValue, LocalizedText, NodeId, QualifiedName, StatusCode, Variant};

use crate::component::Robot;
use crate::model::DEVICES;
use crate::shown::is_work;
use crate::skill::Skill;
use crate::values::LiveValue;
use crate::yaml::{YamlFinding, YamlFindingCode};

/// Returns a finding if there is a robot and the types of OPC 40010-1 are missing.
pub(super) fn lacks_types(server: &OpcUaServer, robot: Option<&Robot>) -> Option<YamlFinding> {
    let robot = robot?;
    if server.find_type(ROBOTICS, SYSTEM).is_some() {
        return None;
    }
    let message = "a robot is shown by the types of OPC 40010-1, and they are not there";
    let help = "Opc.Ua.Robotics.NodeSet2.xml and Opc.Ua.Di.NodeSet2.xml stand under `nodesets`";
    Some(YamlFinding::error(YamlFindingCode::NodeSet, robot.place, message).with_help(help))
}

/// Creates the motion device system in the DeviceSet of OPC 10000-100. The returned future updates
/// its task control, and the nodes with values of the component.
pub(super) fn serve(
    server: &OpcUaServer,
    (name, robot): (&str, &Robot),
    (skills, values): (&[Skill], &[LiveValue]),
    ids: &mut IdRange,
) -> Result<impl Future<Output = ()> + use<>, InstanceError> {
    let mut maker = Maker { server, ids };
    let devices = server.namespace(DEVICES).unwrap_or_default();
    let system = maker.make(SYSTEM, name, NodeId::new(devices, DEVICE_SET), &[])?;
    let arm = maker.make(
        "MotionDeviceType",
        name,
        within(&system, "MotionDevices")?,
        measured::load_nodes(values),
    )?;
    let controller = format!("{name}-controller");
    let parent = within(&system, "Controllers")?;
    let controller = maker.make("ControllerType", &controller, parent, &[])?;
    let task = maker.make(
        "TaskControlType",
        "TaskControl",
        within(&controller, "TaskControls")?,
        &["ParameterSet/ExecutionMode"],
    )?;
    let robotics = server.namespace(ROBOTICS).unwrap_or_default();
    let controls = NodeId::new(robotics, CONTROLS);
    server.add_reference(&task.node_id, &controls, &arm.node_id);
    for device in [&arm, &controller] {
        show_plate(server, device, robot);
    }
    show(server, &arm, "MotionDeviceCategory", robot.category);
    let (axes, axis_nodes) = measured::axes(&mut maker, &arm, (values, robot.axes))?;
    let of = (values, robot.axes);
    let motors = power_trains::power_trains(&mut maker, &arm, &axis_nodes, of)?;
    let load = measured::load(server, &arm, values)?;
    let safety = measured::safety(&mut maker, &system, values)?;
    let speed = measured::speed(server, &arm, values);
    // The controller has no users.
    show_unsupported(server, &controller, "CurrentUser/Level");
    if speed.is_none() {
        show_unsupported(server, &arm, "ParameterSet/SpeedOverride");
    }
    show(server, &task, "ComponentName", LocalizedText::from(name));
    show(server, &task, "ParameterSet/ExecutionMode", CYCLE);
    let task = keep(server.clone(), task, skills.to_vec());
    let measured = axes.into_iter().chain(motors).chain(load);
    let measured = measured.chain(safety).chain(speed);
    Ok(async move {
        tokio::join!(task, join_all(measured));
    })
}

/// Shows the nameplate of a device.
fn show_plate(server: &OpcUaServer, device: &Instance, robot: &Robot) {
    for (name, text) in [
        ("Manufacturer", &robot.manufacturer),
        ("Model", &robot.model),
    ] {
        show(server, device, name, LocalizedText::from(text.as_str()));
    }
    for (name, text) in [
        ("ProductCode", &robot.product_code),
        ("SerialNumber", &robot.serial_number),
    ] {
        show(server, device, name, text.as_str());
    }
}

/// Shows the running skill at each change.
async fn keep(server: OpcUaServer, task: Instance, skills: Vec<Skill>) {
    let mut watches: Vec<_> = skills.iter().map(Skill::watch).collect();
    let mut before = None;
    loop {
        let shown = watches
            .iter_mut()
            .map(|watch| watch.borrow_and_update().state);
        let running = skills
            .iter()
            .zip(shown)
            .filter(|(_, state)| is_work(*state));
        let names: Vec<&str> = running
            .map(|(skill, _)| skill.facts().name.as_str())
            .collect();
        let names = names.join(", ");
        if before.as_ref() != Some(&names) {
            show(
                &server,
                &task,
                "ParameterSet/TaskProgramLoaded",
                !names.is_empty(),
            );
            show(
                &server,
                &task,
                "ParameterSet/TaskProgramName",
                names.as_str(),
            );
            before = Some(names);
        }
        if watches.is_empty() {
            return;
        }
        let changes = watches.iter_mut().map(|watch| Box::pin(watch.changed()));
        if select_all(changes).await.0.is_err() {
            return;
        }
    }
}

fn show(server: &OpcUaServer, of: &Instance, path: &str, value: impl Into<Variant>) {
    if let Some(node) = of.node(path) {
        // The node exists as long as the server.
        let _shown = server.show(node, value);
    }
}

/// Shows the status BadNotSupported for a node whose data the robot does not provide.
fn show_unsupported(server: &OpcUaServer, of: &Instance, path: &str) {
    let unknown = DataValue {
        status: Some(StatusCode::BadNotSupported),
        ..DataValue::null()
    };
    if let Some(node) = of.node(path) {
        // The node exists as long as the server.
        let _shown = server.show_value(node, unknown);
    }
}

fn within(of: &Instance, name: &str) -> Result<NodeId, InstanceError> {
    let node = of.node(name).cloned();
    node.ok_or_else(|| InstanceError::NoOptional(name.to_owned()))
}

struct Maker<'a> {
    server: &'a OpcUaServer,
    ids: &'a mut IdRange,
}

impl Maker<'_> {
    fn make(
        &mut self,
        of_type: &str,
        name: &str,
        parent: NodeId,
        optional: &[&str],
    ) -> Result<Instance, InstanceError> {
        let none = || InstanceError::NoType(NodeId::null());
        let of_type = self.server.find_type(ROBOTICS, of_type).ok_or_else(none)?;
        let id = self.ids.next();
        let name = QualifiedName::new(id.namespace, name);
        let spec = InstanceSpec {
            optional: optional.iter().map(|path| (*path).to_owned()).collect(),
            ..InstanceSpec::new(of_type, id, name, parent)
        };
        self.server.instantiate(&spec, &mut |_| self.ids.next())
    }
}

const ROBOTICS: &str = "http://opcfoundation.org/UA/Robotics/";
const SYSTEM: &str = "MotionDeviceSystemType";
/// DeviceSet (OPC 10000-100, 4.9).
const DEVICE_SET: u32 = 5001;
/// The ReferenceType Controls (OPC 40010-1, 8.2).
const CONTROLS: u32 = 4002;
/// A value of ExecutionModeEnumeration (OPC 40010-1, 7.11.3): a skill runs once and ends.
const CYCLE: i32 = 0;
