//! `ua-space init` and `ua-space check --environment` on third-party graphs, domains and servers.

use std::fs;
use std::path::{Path, PathBuf};
use std::time::Duration;

use mappings::{ExecutedBy, Mapping};
use serde_json::Value;
use system_tests::{Cell, Child, Peer, SERVER_ENDPOINT, StartedChild, eventually, program};

const SOON: Duration = Duration::from_secs(40);
const ALL: &[Peer] = &[Peer::Ros1, Peer::Python];
const SNAPSHOTS: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/init");

/// An ended `ua-space` in a cell's network.
struct Ended {
    code: i32,
    child: Child,
}

impl Ended {
    /// Returns the whole output.
    fn text(&self) -> String {
        self.child.lines().join("\n")
    }

    /// Returns the list that was printed as JSON.
    fn list(&self) -> Vec<Value> {
        let lines = self.child.lines();
        let mut lists = lines
            .iter()
            .filter_map(|line| serde_json::from_str(line).ok());
        lists.next().unwrap_or_else(|| panic!("{}", self.text()))
    }

    fn object(&self) -> Value {
        self.child.json_lines().pop().unwrap_or_default()
    }
}

fn ua_space(args: &[&str]) -> Ended {
    let mut child = StartedChild::new("ua-space", &program("ua-space"))
        .args(args)
        .env("ROS_MASTER_URI", "http://127.0.0.1:11311")
        .start();
    let code = child.wait_for_end(SOON).code().unwrap();
    Ended { code, child }
}

/// Checks that the written mapping equals the snapshot and has no diagnostics.
fn like_snapshot(file: &Path, name: &str) {
    let folder = file.parent().unwrap().to_str().unwrap();
    let written = fs::read_to_string(file).unwrap().replace(folder, "FOLDER");
    let snapshot = Path::new(SNAPSHOTS).join(name);
    if std::env::var_os("UA_REFRESH").is_some() {
        fs::create_dir_all(SNAPSHOTS).unwrap();
        fs::write(&snapshot, &written).unwrap();
    }
    let expected = fs::read_to_string(&snapshot).unwrap_or_default();
    assert!(
        written == expected,
        "{name} differs; if it is better than before: UA_REFRESH=1\n{written}"
    );
    let checked = ua_space(&["check", "--json", file.to_str().unwrap()]);
    assert_eq!(checked.code, 0, "{}", checked.text());
    assert_eq!(checked.object()["findings"], serde_json::json!([]));
}

fn path(cell: &Cell, name: &str) -> PathBuf {
    cell.folder().join(name)
}

/// Waits until the graph has its last topic, because `ready` of a peer is printed before the master
/// lists its topics.
fn settled(args: &[&str], wanted: &str) {
    eventually(wanted, SOON, || {
        ua_space(args).text().contains(wanted).then_some(())
    });
}

#[test]
fn a_model_gives_the_topics_that_another_parser_counts() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let model = test_data::own("sysml/line.uml").display().to_string();
    let judged = cell.asyncua_once("sysml_judge.py", &[&model]);
    let file = path(&cell, "of-model.yaml");
    let name = file.to_str().unwrap();
    let ended = ua_space(&["init", "--model", &model, "-o", name, "--json"]);
    assert_eq!(ended.code, 0, "{}", ended.text());
    let sum = ended.object();
    assert_eq!(sum["variables"], judged[0]["properties"], "{sum}");
    assert_eq!(sum["calls"], judged[0]["calls"], "{sum}");
    let text = fs::read_to_string(&file).unwrap();
    let mapping = Mapping::from_yaml(&text, name).mapping.unwrap();
    let bindings = mapping.variables().iter().flat_map(|one| &one.bindings);
    let topics = bindings.map(|binding| binding.ros_topic.clone());
    let calls = mapping
        .calls()
        .iter()
        .filter_map(|call| match &call.executed {
            ExecutedBy::Ros(target) => Some(target.name.clone()),
            ExecutedBy::OpcUa(_) | ExecutedBy::Acknowledging | ExecutedBy::Elsewhere => None,
        });
    let mut names: Vec<String> = topics.chain(calls).collect();
    names.sort();
    assert_eq!(Value::from(names), judged[0]["names"]);
}

#[test]
fn a_mapping_of_two_graphs_and_a_server_ties_what_belongs_together() {
    let Some(cell) = Cell::with(ALL) else {
        return;
    };
    let _master = cell.roscore();
    let _robots = (
        cell.rospy("assembly_line_ros1.py", &["--more"]),
        cell.cyclone("assembly_line_ros2.py", &["--more"]),
    );
    let _server = cell.asyncua("opcua_line.py", &[SERVER_ENDPOINT]);
    settled(&["init", "--ros1"], "/conveyor/start");
    let file = path(&cell, "cell.yaml");
    let name = file.to_str().unwrap();
    let looks = [
        "init",
        "--ros1",
        "--ros2",
        "2",
        "--opcua",
        SERVER_ENDPOINT,
        "-o",
        name,
    ];
    let ended = ua_space(&[&looks[..], &["--json"]].concat());
    assert_eq!(ended.code, 0, "{}", ended.text());
    assert_eq!(ended.object()["changed"], true);
    like_snapshot(&file, "cell.yaml");

    // Without changes, the file is not written, although writing is allowed.
    let before = fs::read(&file).unwrap();
    let again = ua_space(&[&looks[..], &["--merge", "--json"]].concat());
    assert_eq!(again.code, 0, "{}", again.text());
    assert_eq!(again.object()["changed"], false);
    assert_eq!(fs::read(&file).unwrap(), before);
    everything_is_there(name);
}

/// Checks that everything in the mapping is present, except the cell's own server, which is not
/// started yet.
fn everything_is_there(name: &str) {
    let ended = ua_space(&["check", "--environment", "--json", name]);
    assert_eq!(ended.code, 69, "{}", ended.text());
    let told = ended.object();
    let asked = told["environment"].as_array().unwrap();
    let away = asked.iter().filter(|one| one["there"] == false);
    let away: Vec<&Value> = away.map(|one| &one["whom"]).collect();
    assert_eq!(away, ["OPC UA server opc.tcp://127.0.0.1:4841"], "{told}");
    // The checked environments: the graphs, and the server for its Method and for its nodes.
    assert_eq!(asked.len(), 5, "{told}");
    // A robot reads whether the conveyor runs, and that server allows no writes to it.
    let findings = told["findings"].as_array().unwrap().iter();
    let found: Vec<(&Value, bool)> = findings
        .map(|one| {
            let message = one["message"].as_str().unwrap();
            (&one["code"], message.contains("line;i=10` of the server"))
        })
        .collect();
    assert_eq!(found, [(&Value::from("M129"), true)], "{told}");
}

#[test]
fn what_is_new_is_put_behind_what_somebody_has_edited() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let set = path(&cell, "line.xml");
    let export = [SERVER_ENDPOINT, "--export", set.to_str().unwrap()];
    let _server = cell.asyncua("opcua_line.py", &export);
    let of_set = path(&cell, "set.yaml");
    let look = [
        "init",
        "--nodeset",
        set.to_str().unwrap(),
        "-o",
        of_set.to_str().unwrap(),
    ];
    let ended = ua_space(&look);
    assert_eq!(ended.code, 0, "{}", ended.text());
    like_snapshot(&of_set, "nodeset.yaml");
    let ended = ua_space(&look);
    assert!(
        ended.code == 0 && ended.text().ends_with("nothing is new"),
        "{}",
        ended.text()
    );

    // A server and the NodeSet file it was made from have the same nodes.
    let of_server = path(&cell, "server.yaml");
    let ended = ua_space(&[
        "init",
        "--opcua",
        SERVER_ENDPOINT,
        "-o",
        of_server.to_str().unwrap(),
    ]);
    assert_eq!(ended.code, 0, "{}", ended.text());
    let nodes = |file: &Path| {
        let text = fs::read_to_string(file).unwrap();
        let (_, nodes) = text.split_once("variables:").unwrap();
        let calls = "\n# What one space executes";
        let (nodes, calls) = nodes.split_once(calls).unwrap_or((nodes, ""));
        // Only a running server has values.
        let nodes = nodes.lines().filter(|line| !line.contains(" from: {"));
        (nodes.collect::<Vec<_>>().join("\n"), calls.to_owned())
    };
    let (of_server, of_file) = (nodes(&of_server), nodes(&of_set));
    assert_eq!(of_server.0, of_file.0);
    // Only a running server can be called.
    assert!(of_server.1.contains("name: Line.Start"), "{}", of_server.1);
    assert_eq!(of_file.1, "");

    // Edits are kept, and a node that the edited file lacks is appended.
    let edited = fs::read_to_string(&of_set)
        .unwrap()
        .replace("name: Mode", "name: Betriebsart   # renamed")
        .replace("  - node: ns=2;i=10\n", "  - node: ns=2;i=2000\n");
    fs::write(&of_set, &edited).unwrap();
    let refused = ua_space(&look);
    assert_eq!(refused.code, 74, "{}", refused.text());
    assert!(refused.text().contains("1 variable"), "{}", refused.text());
    assert_eq!(fs::read_to_string(&of_set).unwrap(), edited);
    let merged = ua_space(&[&look[..], &["--merge"]].concat());
    assert_eq!(merged.code, 0, "{}", merged.text());
    let after = fs::read_to_string(&of_set).unwrap();
    let added = after.strip_prefix(&edited).unwrap();
    assert!(added.contains("node: ns=2;i=10\n"), "{added}");
}

#[test]
fn a_server_that_announces_itself_to_nobody_is_found_where_somebody_asks_for_that() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    // At port 4840, the server would be queried as the discovery server of this host.
    let endpoint = "opc.tcp://127.0.0.1:4841";
    let _server = cell.asyncua("opcua_line.py", &[endpoint]);
    let look = ["discover", "--seconds", "1", "--json"];
    let ended = ua_space(&look);
    assert_eq!((ended.code, ended.list().len()), (0, 0), "{}", ended.text());
    let scan = ["--scan", "127.0.0.0/30", "--port", "4840,4841"];
    let ended = ua_space(&[&look[..], &scan].concat());
    assert_eq!(ended.code, 0, "{}", ended.text());
    let told = ended.list();
    let [found] = told.as_slice() else {
        panic!("{told:?}")
    };
    assert_eq!(found["kind"], "server");
    assert_eq!(found["uri"], "urn:freeopcua:python:server");
    assert_eq!(found["security"], serde_json::json!(["None"]));
    assert_eq!(found["foundBy"], serde_json::json!(["scan"]));
    let url = found["urls"][0].as_str().unwrap();
    assert!(url.starts_with(endpoint), "{found}");
    // Scans of too many addresses are refused.
    let ended = ua_space(&["discover", "--scan", "127.0.0.0/8"]);
    assert_eq!(ended.code, 64, "{}", ended.text());
    assert!(
        ended.text().contains("use /16 or a smaller range"),
        "{}",
        ended.text()
    );
    // A mapping of the discovered servers.
    let file = path(&cell, "found.yaml");
    let init = ["init", "--discover", "-o", file.to_str().unwrap()];
    let ended = ua_space(&[&init[..], &["--seconds", "1", "--wait", "1"], &scan].concat());
    assert_eq!(ended.code, 0, "{}", ended.text());
    let text = fs::read_to_string(&file).unwrap();
    let mapping = Mapping::from_yaml(&text, "found.yaml").mapping.unwrap();
    let [server] = mapping.servers() else {
        panic!("{text}")
    };
    assert_eq!(server.access.endpoint.port, 4841, "{text}");
    let from = mapping.variables().iter().filter(|one| one.from.is_some());
    assert_eq!(from.count(), 5, "{text}");
}

#[test]
fn who_is_not_there_is_named_and_nothing_is_written() {
    let Some(cell) = Cell::with(&[]) else { return };
    let file = path(&cell, "cell.yaml");
    let name = file.to_str().unwrap();
    let set = cell.file(
        "broken.xml",
        "<UANodeSet>\n<UAVariable NodeId='ns=1;q=1'/></UANodeSet>",
    );
    for (looks, code, said) in [
        (&["--ros1"][..], 69, "http://127.0.0.1:11311"),
        (&["--ros2", "3", "--wait", "1"], 69, "DDS domain 3"),
        (&["--opcua", SERVER_ENDPOINT], 69, SERVER_ENDPOINT),
        (&["--opcua", "http://here"], 64, "opc.tcp://"),
        (&["--nodeset", set.to_str().unwrap()], 65, "broken.xml:2"),
        (&["--nodeset", "/nowhere.xml"], 74, "/nowhere.xml"),
        (&[], 64, "--nodeset"),
    ] {
        let ended = ua_space(&[&["init", "-o", name], looks].concat());
        assert_eq!(ended.code, code, "{}", ended.text());
        assert!(ended.text().contains(said), "{}", ended.text());
        assert!(!file.exists());
    }
    let mapping = cell.file(
        "two.yaml",
        "spaces: [{id: 1}, {id: 3}]\nserver: {endpoint: 'opc.tcp://127.0.0.1:4849'}\n",
    );
    let check = ["check", "--environment", "--wait", "1", "--json"];
    let ended = ua_space(&[&check[..], &[mapping.to_str().unwrap()]].concat());
    assert_eq!(ended.code, 69, "{}", ended.text());
    let told = ended.object();
    let asked = told["environment"].as_array().unwrap();
    let absent = asked
        .iter()
        .filter(|one| one["there"] == false && one["why"].is_string());
    assert_eq!((asked.len(), absent.count()), (3, 3), "{told}");
    // The environment of an invalid mapping is not checked.
    let mapping = cell.file("faulty.yaml", "spaces: 1\n");
    let ended = ua_space(&[&check[..], &[mapping.to_str().unwrap()]].concat());
    assert_eq!(
        (ended.code, &ended.object()["environment"]),
        (78, &Value::Null)
    );
}

#[test]
fn values_named_alike_become_the_nodes_of_our_own_server() {
    let Some(cell) = Cell::with(ALL) else {
        return;
    };
    let _master = cell.roscore();
    let _robots = (
        cell.rospy("assembly_line_ros1.py", &[]),
        cell.cyclone("assembly_line_ros2.py", &[]),
    );
    let shipped = concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/../mappings/assembly-line.yaml"
    );
    let _server = cell.ua_server(&[shipped]);
    let file = path(&cell, "cell.yaml");
    let name = file.to_str().unwrap();
    let looks = ["--ros1", "--ros2", "2", "--opcua", SERVER_ENDPOINT];
    let ended = ua_space(&[&["init", "-o", name][..], &looks].concat());
    assert_eq!(ended.code, 0, "{}", ended.text());
    let read = |file: &str| {
        let checked = Mapping::from_yaml(&fs::read_to_string(file).unwrap(), file);
        assert!(checked.findings.is_empty());
        checked.mapping.unwrap()
    };
    let (written, shipped) = (read(name), read(shipped));
    // Variables with the same name are written as in the shipped mapping: node, origin, topics of
    // both sides.
    for topic in ["ua_1_2_10", "ua_2_2_20", "ua_2_2_21"] {
        let topic = topic.parse().unwrap();
        assert_eq!(written.variable(topic), shipped.variable(topic));
    }
    // /storage/covers and CoversInStorage have different names and are separate values.
    let covers = written
        .variables()
        .iter()
        .filter(|one| one.name.contains("Covers"));
    assert_eq!(covers.count(), 6);
}

const ELSEWHERE: &str = r#"
spaces: [{id: 1}, {id: 2}]
server: {endpoint: "opc.tcp://127.0.0.1:4840"}
namespaces: {2: "urn:ua-bridge:system-tests:line"}
variables:
  - {node: ns=2;i=10, name: Running, origin: 1, ros: {topic: /conveyor/runing, type: std_msgs/Bool}}
  - {node: ns=2;i=11, name: Covers, origin: 1, ros: {topic: /storage/covers, type: std_msgs/Int32}}
  - {node: ns=2;i=12, name: Park, origin: 2, ros: {topic: /park/busy, type: std_msgs/UInt32}}
  - {node: ns=2;i=13, name: Start, type: Boolean, origin: 0, ros: {space: 1, call: /conveyor/strat, type: std_srvs/SetBool, field: data}}
  - {node: ns=2;i=14, name: Grip, type: Boolean, origin: 0, ros: {space: 2, call: /arm/grip, type: std_srvs/SetBool, field: data}}
  - {node: ns=2;i=15, name: Gripp, type: Boolean, origin: 0, ros: {space: 2, call: /arm/gripp, type: std_srvs/SetBool, field: data}}
  - {node: ns=2;i=16, name: Home, type: Boolean, origin: 0, ros: {space: 2, call: /arm/home, type: std_srvs/Trigger, when: true}}
patterns:
  - {topics: "/robot*/pose", origin: 1, node: "ns=2;i=20{1}", name: "Robot{1}Pose"}
"#;

#[test]
fn what_is_named_otherwise_than_it_is_there_is_found() {
    let Some(cell) = Cell::with(ALL) else {
        return;
    };
    let _master = cell.roscore();
    let _robots = (
        cell.rospy("assembly_line_ros1.py", &["--more"]),
        cell.cyclone("assembly_line_ros2.py", &[]),
    );
    let serves = |service: &str| {
        let offered = ["serve", service, "std_srvs/SetBool", "--domain", "2"];
        cell.cyclone("ros2_service.py", &offered)
    };
    let _services = (serves("/arm/grip"), serves("/arm/home"));
    // On that server, the namespace has another index.
    let before = ["--before", "urn:ua-bridge:system-tests:before"];
    let _server = cell.asyncua("opcua_line.py", &[&[SERVER_ENDPOINT][..], &before].concat());
    settled(&["init", "--ros1"], "/conveyor/start");
    let mapping = cell.file("cell.yaml", ELSEWHERE);
    let file = mapping.to_str().unwrap();
    let ended = ua_space(&["check", "--environment", "--json", file]);
    assert_eq!(ended.code, 0, "{}", ended.text());
    let told = ended.object();
    let findings = told["findings"].as_array().unwrap().iter();
    let found: Vec<(&str, u64, &str)> = findings
        .map(|one| {
            (
                one["code"].as_str().unwrap(),
                one["line"].as_u64().unwrap(),
                one["help"].as_str().unwrap(),
            )
        })
        .collect();
    let expected = [
        ("M123", 4, "the server has this URI at index 3"),
        ("M121", 6, "did you mean `/conveyor/running`?"),
        ("M122", 7, "type: std_msgs/UInt32"),
        ("M122", 8, "type: std_msgs/Bool"),
        ("M124", 9, "did you mean `/conveyor/start`?"),
        ("M124", 11, "did you mean `/arm/grip`?"),
        ("M122", 12, "type: std_srvs/SetBool"),
        ("M120", 14, "check that a robot with such topics runs"),
    ];
    assert_eq!(found.len(), expected.len(), "{found:?}");
    for (found, expected) in found.iter().zip(expected) {
        assert_eq!((found.0, found.1), (expected.0, expected.1), "{found:?}");
        assert!(found.2.contains(expected.2), "{found:?}");
    }
    // Only the graphs are checked.
    let ended = ua_space(&["check", "--environment=ros1,ros2", "--json", file]);
    assert_eq!(ended.object()["environment"].as_array().unwrap().len(), 2);
}
