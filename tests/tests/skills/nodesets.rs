//! The NodeSets by domain with the loaders of other stacks.

use serde_json::json;
use system_tests::{Cell, Peer};

use super::EXAMPLES;

/// The files in the order in which they are loaded, with a type of each and its supertype.
const DOMAINS: [(&str, &str, &str); 6] = [
    ("Device", "SkillType", "ProgramStateMachineType"),
    ("Robotics", "PtpMoveSkillType", "MoveSkillType"),
    ("Gripper", "GraspSkillType", "GripperSkillType"),
    ("ToolChanger", "ChangeToolSkillType", "ToolSkillType"),
    ("Composite", "PickAndPlaceSkillType", "SkillType"),
    ("Process", "ExecuteProcessSkillType", "SkillType"),
];

#[test]
fn the_nodesets_of_all_domains_are_loaded_by_asyncua_and_node_opcua() {
    let Some(cell) = Cell::with(&[Peer::Python, Peer::NodeOpcua]) else {
        return;
    };
    let file = |domain: &str| format!("{EXAMPLES}/nodesets/UaBridge.{domain}.NodeSet2.xml");
    let files = DOMAINS.map(|(domain, ..)| file(domain));
    let schema = test_data::foreign("nodesets/UANodeSet.xsd");
    let schema = schema
        .as_ref()
        .map(|path| ["--xsd", path.to_str().unwrap()]);
    let options = schema.into_iter().flatten();
    let args: Vec<&str> = options.chain(files.iter().map(String::as_str)).collect();
    let loaded = cell.asyncua_once("opcua_import.py", &args);
    assert_eq!(loaded.len(), DOMAINS.len());
    for ((domain, name, supertype), file) in DOMAINS.iter().zip(&loaded) {
        assert_eq!(file["complaints"], json!([]), "{domain}");
        let faults = &file["faults"];
        assert!(*faults == json!([]) || faults.is_null(), "{faults}");
        assert_eq!(file["types"][*name], json!([supertype]), "{domain}");
    }
    // node-opcua orders the files by their models.
    let reversed: Vec<&str> = files.iter().rev().map(String::as_str).collect();
    let types = cell.node_opcua_once("nodesets.js", &reversed).remove(0);
    for (domain, name, supertype) in DOMAINS {
        assert_eq!(types[name], json!(supertype), "{domain}: {types}");
    }
}
