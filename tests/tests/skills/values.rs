//! The values of a component: asyncua and a subscriber of the space see the same values, with their
//! units, and why they are unknown while the device is lost.

use serde_json::{Value, json};
use system_tests::{Cell, Child, Peer, StartedChild, eventually, program};

use super::{ENDPOINT, SOON, component};

const MASTER: &str = "127.0.0.1:8091";
const SENSOR: &str = "component: cup
application_uri: urn:ua-bridge:system-tests:component
namespace: 9
device: {schmalz_ecbpi: {master: \"127.0.0.1:8091\"}}
values:
  - {device: Vacuum, period: 50 ms}
  - {name: Part, device: PartPresent, period: 50 ms}
  - {name: Raw, io_link: {master: \"127.0.0.1:8091\", byte: 2, as: uint16, scale: 0.001}, unit: bar, range: [0, 1]}
  - {name: Grasps, runs: Grasp}
skills:
  - {name: Grasp, type: GraspSkillType, driver: device}
";

fn gripper() -> Child {
    StartedChild::new("ua-component", &program("ua-component"))
        .args(["simulate", "schmalz-ecbpi", "--listen", MASTER])
        .start()
}

/// Returns the newest change of a value at a client, with its status.
fn newest(client: &Child, name: &str) -> Option<(Value, Value)> {
    let lines = client.json_lines();
    let line = lines.iter().rfind(|line| line["changed"] == name)?;
    Some((line["value"].clone(), line["status"].clone()))
}

#[test]
fn values_reach_opc_ua_and_the_space_and_are_bad_while_the_device_is_lost() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let device = gripper();
    let yaml = cell.file("cup.yaml", SENSOR);
    let _component = component(&yaml);
    let mut client = cell.asyncua("opcua_values.py", &[ENDPOINT]);
    let values = client.wait_for_json("the values", SOON, |line| line.get("values").cloned());
    let expected = json!({
        "Vacuum": {"node": "ns=1;i=11", "range": [0.0, 1000.0], "unit": ["mbar", 5_063_250], "type": 2368, "data_type": 5, "rank": -1},
        "Part": {"node": "ns=1;i=12", "type": 63, "data_type": 1, "rank": -1},
        "Raw": {"node": "ns=1;i=13", "range": [0.0, 1.0], "unit": ["bar", 4_342_098], "type": 2368, "data_type": 11, "rank": -1},
        "Grasps": {"node": "ns=1;i=14", "type": 63, "data_type": 7, "rank": -1},
    });
    assert_eq!(values, expected);
    let follow = |name: &str| {
        StartedChild::new("ua-space", &program("ua-space"))
            .args(["echo", name, "--json", "--interface", "lo"])
            .start()
    };
    let (part, vacuum) = (follow("ua_0_9_12"), follow("cup.Vacuum"));
    let good = json!("Good");
    eventually("no part is there", SOON, || {
        (newest(&client, "Part")? == (json!(false), good.clone())).then_some(())
    });
    let mut start = StartedChild::new("ua-space", &program("ua-space"))
        .args(["skills", "start", "cup.Grasp", "--interface", "lo"])
        .start();
    assert!(start.wait_for_end(SOON).success(), "{start}");
    eventually("the part is there, and the run is counted", SOON, || {
        let part = newest(&client, "Part")? == (json!(true), good.clone());
        let grasps = newest(&client, "Grasps")? == (json!(1), good.clone());
        let raw = newest(&client, "Raw")?.0.as_f64()? > 0.1;
        (part && grasps && raw).then_some(())
    });
    eventually("the space has the part", SOON, || {
        let lines = part.json_lines();
        let held = |line: &&Value| line["value"].to_string().contains("true");
        lines.iter().find(held).map(drop)
    });
    drop(device);
    eventually("the client sees why the values are unknown", SOON, || {
        let lost = newest(&client, "Vacuum")?.1 == "BadNoCommunication";
        let why = newest(&client, "Vacuum.Reason")?.0;
        let known = newest(&client, "Grasps")? == (json!(1), good.clone());
        (lost && known && why.as_str()?.contains(MASTER)).then_some(())
    });
    eventually("the space has the status", SOON, || {
        let lines = vacuum.json_lines();
        // BadNoCommunication
        let bad = |line: &&Value| line["value"].to_string().contains("2150694912");
        lines.iter().find(bad).map(drop)
    });
    let _device = gripper();
    eventually("the values are known again", SOON, || {
        (newest(&client, "Vacuum")?.1 == good).then_some(())
    });
}
