//! A robot for clients of OPC 40010-1, which know no skills.

use std::io::Write as _;

use serde_json::{Value, json};
use system_tests::{Cell, Peer, StartedChild, eventually, program};

use super::{ENDPOINT, SOON, component};

const ROBOT: &str = "component: arm
application_uri: urn:ua-bridge:system-tests:component
namespace: 6
security: [None]
robot: {manufacturer: Universal Robots, model: UR5, serial_number: '20195501', category: articulated_robot}
skills:
  - {name: Grasp, type: GraspSkillType, driver: {simulated: {duration: 400 ms}}}
  - {name: PtpMove, type: PtpMoveSkillType, driver: simulated}
";

#[test]
fn a_client_that_knows_robots_and_no_skills_sees_what_it_is_and_which_program_runs() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    // NodeSets of the OPC Foundation.
    let files = ["Robotics", "Di"].map(|name| format!("nodesets/Opc.Ua.{name}.NodeSet2.xml"));
    let [Some(robotics), Some(di)] = files.map(|file| test_data::foreign(&file)) else {
        return;
    };
    let nodesets = format!("nodesets: ['{}', '{}']\n", robotics.display(), di.display());
    let yaml = cell.file("arm.yaml", &format!("{nodesets}{ROBOT}"));
    let _arm = component(&yaml);
    let mut client = cell.asyncua("opcua_robot.py", &[ENDPOINT]);
    let plate = json!({
        "Manufacturer": "Universal Robots", "Model": "UR5", "ProductCode": "", "SerialNumber": "20195501",
    });
    let mut arm = plate.clone();
    arm["MotionDeviceCategory"] = json!(1);
    let seen = client.wait_for_json("the robot", SOON, |line| {
        line.get("system").map(|_| line.clone())
    });
    let expected = json!({
        "system": "arm",
        "types": [1004, 1003, 1011],
        "arm": arm,
        // No driver has these two properties.
        "speed": {"SpeedOverride": "BadNotSupported"},
        "controller": plate,
        "user": {"Level": "BadNotSupported"},
        "task": {"ComponentName": "arm"},
        "mode": {"ExecutionMode": 0},
        "controls": true,
    });
    assert_eq!(seen, expected);
    for (name, expected) in [
        ("TaskProgramName", json!(["", "Grasp", ""])),
        ("TaskProgramLoaded", json!([false, true, false])),
    ] {
        eventually(&format!("{name} is told: {expected}"), SOON, || {
            let lines = client.json_lines();
            let told = lines.iter().filter(|line| line["changed"] == name);
            let told: Vec<&Value> = told.map(|line| &line["value"]).collect();
            (json!(told) == expected).then_some(())
        });
    }
}

/// A UR with all its values, behind its simulator.
const MEASURED: &str = "component: arm
application_uri: urn:ua-bridge:system-tests:component
namespace: 6
security: [None]
robot: {manufacturer: Universal Robots, model: UR5, category: articulated_robot}
device: {universal_robot: {host: 127.0.0.1}}
values: [{device: all}]
skills:
  - {name: PtpMove, type: PtpMoveSkillType, driver: device}
";

/// The power trains of the simulated robot: PowerTrainType and MotorType. RTDE has no nameplates of
/// motors, and nothing about gears.
fn power_trains() -> Vec<Value> {
    let unknown = "BadNotSupported";
    let train = |(number, temperature, current): (usize, f64, f64)| {
        json!({
            "name": format!("PowerTrain_{number}"),
            "types": [16794, 1019],
            "motor": format!("Motor_{number}"),
            "others": [],
            "temperature": [temperature, "\u{b0}C"],
            "current": [current, "A"],
            "vendor": true,
            "plate": {
                "Manufacturer": unknown, "Model": unknown,
                "ProductCode": unknown, "SerialNumber": unknown,
            },
            "moves": [format!("Axis_{number}")],
        })
    };
    let trains = [
        (1, 28.0, 0.0),
        (2, 29.5, -2.5),
        (3, 29.0, -1.5),
        (4, 31.0, -0.25),
        (5, 31.5, 0.125),
        (6, 32.0, 0.0),
    ];
    trains.map(train).to_vec()
}

#[test]
fn a_client_that_knows_robots_sees_the_axes_the_speed_the_load_and_the_safety_state_of_a_ur() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    // NodeSets of the OPC Foundation.
    let files = ["Robotics", "Di"].map(|name| format!("nodesets/Opc.Ua.{name}.NodeSet2.xml"));
    let [Some(robotics), Some(di)] = files.map(|file| test_data::foreign(&file)) else {
        return;
    };
    let _simulator = StartedChild::new("universal-robot", &program("ua-component"))
        .args(["simulate", "universal-robot"])
        .start();
    eventually("the simulator serves", SOON, || {
        std::net::TcpStream::connect("127.0.0.1:30004").ok()
    });
    // The programmer of the robot has set the mass of the tool.
    let mut secondary = std::net::TcpStream::connect("127.0.0.1:30002").unwrap();
    secondary
        .write_all(b"set_payload(1.5, [0, 0.01, 0.05])\n")
        .unwrap();
    let nodesets = format!("nodesets: ['{}', '{}']\n", robotics.display(), di.display());
    let yaml = cell.file("arm.yaml", &format!("{nodesets}{MEASURED}"));
    let _arm = component(&yaml);
    let seen = eventually("the values of the robot are shown", SOON, || {
        let lines = cell.asyncua_try("opcua_robot.py", &[ENDPOINT, "--values"])?;
        let seen = lines
            .iter()
            .find(|line| line.get("axes").is_some())?
            .clone();
        // A value that has not arrived yet is the name of its status.
        let axes = seen["axes"].as_array()?;
        let has_axes = axes
            .iter()
            .all(|axis| axis[1][0].is_number() && axis[2][0].is_number());
        let has_motors = seen["trains"]
            .as_array()?
            .iter()
            .all(|train| train["temperature"][0].is_number() && train["current"][0].is_number());
        let has_load = seen["load"]["mass"][0].is_number() && seen["load"]["center"].is_array();
        let safety = seen["safety"]["SafetyState"].as_object()?;
        let has_safety = safety
            .values()
            .all(|value| value.is_boolean() || value.is_number());
        (has_axes && has_motors && has_load && has_safety && seen["speed"].is_number())
            .then_some(seen)
    });
    let axis = |number: usize| {
        let name = format!("Axis_{number}");
        let train = format!("PowerTrain_{number}");
        json!([name, [0.0, "rad"], [0.0, "rad/s"], 1, [train]])
    };
    let axes: Vec<Value> = (1..=6).map(axis).collect();
    let expected = json!({
        "axes": axes,
        "trains": power_trains(),
        "speed": 100.0,
        "load": {
            "type": 1018,
            "mass": [1.5, "kg"],
            "center": [0.0, 0.01, 0.05],
            "parts": [{"X": 0.0, "Y": 0.01, "Z": 0.05}, {"A": 0.0, "B": 0.0, "C": 0.0}],
        },
        "safety": {"SafetyState": {"EmergencyStop": false, "ProtectiveStop": false, "OperationalMode": 0}},
    });
    assert_eq!(seen, expected);
}

#[test]
fn a_robot_without_the_types_for_it_is_told_where_they_belong() {
    let Some(cell) = Cell::with(&[]) else {
        return;
    };
    let yaml = cell.file("arm.yaml", ROBOT);
    let mut arm = super::component_started(&yaml, &["--interface", "lo", "--lds", "none"]).start();
    arm.wait_for_line(
        "error[P016]: a robot is shown by the types of OPC 40010-1",
        SOON,
    );
    arm.wait_for_line("arm.yaml:5:", SOON);
    arm.wait_for_line("stand under `nodesets`", SOON);
}
