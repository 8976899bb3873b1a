//! The server's description of itself and of its values, for clients that read everything.

use super::*;

const MAPPING: &str = "
namespaces:
  2: urn:ua-bridge:system-tests
spaces:
  - id: 2
variables:
  - node: ns=2;i=10
    name: Oven.Temperature
    type: Double
    origin: 2
    unit: degC
    range: [0, 300]
    precision: 2
    description: Of the hot end
    history: 2
  - {node: ns=2;i=30, name: Setpoint, type: Double, origin: 0, history: 0}
server:
  security: [None]
  history: {values: 1, megabytes: 1}
  limits: {sessions: 7}
";

fn served() -> Option<(Cell, Child)> {
    let cell = Cell::with(&[Peer::Python])?;
    let mapping = cell.file("identity.yaml", MAPPING);
    let server = cell.ua_server(&[mapping.to_str().unwrap()]);
    eventually("the server answers clients", SOON, || {
        cell.asyncua_try("opcua_read.py", &[SERVER_ENDPOINT, "ns=0;i=2258"])
    });
    Some((cell, server))
}

#[test]
fn each_node_has_what_its_class_has_and_the_importer_of_asyncua_takes_what_its_exporter_wrote() {
    let Some((cell, _server)) = served() else {
        return;
    };
    assert_eq!(write(&cell, "ns=2;i=30", "Double", "5"), "Good");
    let mut watch = watch(&cell, TEMPERATURE_NODE);
    let group = UadpSocket::join();
    group.send(&key_frame(TEMPERATURE, 1, 21.5, DataSetHeader::default()));
    shows(&mut watch, "Good", &json!(21.5));
    let tree = cell.asyncua_started("opcua_tree.py", &[SERVER_ENDPOINT, "--export"]);
    let mut tree = tree.start();
    assert!(tree.wait_for_end(SOON * 3).success());
    let mut told = tree.json_lines();
    let trip = told.pop().unwrap();
    assert_eq!(trip["differ"], json!([]), "{trip}");
    assert_eq!(trip["exported"], trip["imported"], "{trip}");
    assert!(trip["exported"].as_u64().unwrap() > 10, "{trip}");
    let sum = told.pop().unwrap();
    assert_eq!(sum["bad"], 0, "{told:?}");
    assert!(sum["nodes"].as_u64().unwrap() > 2000, "{sum}");
}

#[test]
fn a_client_is_told_which_build_and_limits_and_namespaces_the_server_has_and_who_is_connected() {
    let Some((cell, _server)) = served() else {
        return;
    };
    let told = cell.asyncua_once("opcua_tree.py", &[SERVER_ENDPOINT, "--server"]);
    let told = &told[0];
    let build = &told["build"];
    assert_eq!(build["ProductUri"], "urn:ua-bridge:server", "{told}");
    assert_eq!(build["SoftwareVersion"], env!("CARGO_PKG_VERSION"));
    assert!(build["BuildDate"].as_str().unwrap() > "2024", "{told}");
    assert_eq!(told["state"], 0, "running: {told}");
    assert_eq!(told["sessions"], 7, "{told}");
    assert_eq!(told["connected"], 1, "{told}");
    let namespaces = told["namespaces"].as_array().unwrap();
    for uri in ["http://opcfoundation.org/UA/", "urn:ua-bridge:system-tests"] {
        assert!(namespaces.contains(&json!(uri)), "{uri} of {told}");
    }
}

/// Bits of PermissionType (OPC 10000-3, 8.55).
const BROWSE: u64 = 1;
const READ_ROLE_PERMISSIONS: u64 = 2;
const READ: u64 = 32;
const WRITE: u64 = 64;
const READ_HISTORY: u64 = 128;
const CALL: u64 = 4096;

#[test]
fn clients_read_profiles_roles_and_permissions() {
    let Some((cell, _server)) = served() else {
        return;
    };
    let method = "ns=0;i=15215";
    let nodes = [
        "--roles",
        TEMPERATURE_NODE,
        "ns=2;i=30",
        method,
        "ns=2;i=9999",
    ];
    let arguments = [&[SERVER_ENDPOINT][..], &nodes].concat();
    let told = cell.asyncua_once("opcua_tree.py", &arguments);
    let told = &told[0];
    let profile = |name: &str| json!(format!("http://opcfoundation.org/UA-Profile/Server/{name}"));
    let profiles = told["profiles"].as_array().unwrap();
    // The server has fewer than 50 sessions, and no security.
    assert_eq!(profiles[0], profile("MicroEmbeddedDevice2017"));
    for name in ["Methods", "HistoricalRawData", "ACAlarm"] {
        assert!(profiles.contains(&profile(name)), "{name} of {told}");
    }
    assert_eq!(told["monitored"], told["profiles"]);
    assert_eq!(told["stamped"], true, "{told}");
    assert_eq!(told["rate"], 0.0, "values are reported on change");

    let roles = told["roles"].as_object().unwrap();
    let names: Vec<&str> = roles.keys().map(String::as_str).collect();
    let known = [
        "Anonymous",
        "AuthenticatedUser",
        "ConfigureAdmin",
        "Engineer",
        "Observer",
        "Operator",
        "SecurityAdmin",
    ];
    assert_eq!(names, known, "{told}");
    for role in roles.values() {
        assert_eq!(role["parts"], json!(["Identities"]), "{told}");
    }
    let anonymous = json!([["Anonymous", ""]]);
    assert_eq!(roles["Operator"]["identities"], anonymous);
    assert_eq!(roles["Engineer"]["identities"], json!([]));

    let seen = BROWSE | READ_ROLE_PERMISSIONS;
    let read = seen | READ | READ_HISTORY;
    let (observer, operator, engineer) = (15_668, 15_680, 16_036);
    let of = |node: &str| &told["permissions"][node];
    for node in [TEMPERATURE_NODE, "ns=2;i=30"] {
        let user = json!([[observer, read], [operator, read | WRITE]]);
        assert_eq!(of(node)["UserRolePermissions"], user, "{told}");
        let all = of(node)["RolePermissions"].as_array().unwrap();
        assert!(all.contains(&json!([engineer, read | WRITE])), "{told}");
        assert_eq!(all.len(), 5, "{told}");
        assert_eq!(of(node)["AccessRestrictions"], 0, "{told}");
    }
    // CurrentRead and HistoryRead; CurrentRead and CurrentWrite.
    assert_eq!(of(TEMPERATURE_NODE)["AccessLevelEx"], 5, "{told}");
    assert_eq!(of("ns=2;i=30")["AccessLevelEx"], 3, "{told}");
    let keys = of(method);
    assert_eq!(keys["AccessRestrictions"], 2, "EncryptionRequired: {told}");
    assert_eq!(keys["AccessLevelEx"], "BadAttributeIdInvalid", "{told}");
    let user = json!([[observer, seen | CALL], [operator, seen | CALL]]);
    assert_eq!(keys["UserRolePermissions"], user, "{told}");
    assert_eq!(of("ns=2;i=9999")["RolePermissions"], "BadNodeIdUnknown");
}

#[test]
fn a_value_has_its_description_and_precision_and_as_much_history_as_was_asked_for() {
    let Some((cell, _server)) = served() else {
        return;
    };
    let mut watch = watch(&cell, TEMPERATURE_NODE);
    let group = UadpSocket::join();
    for (sequence, value) in [(1, 1.5), (2, 2.5), (3, 3.5)] {
        group.send(&key_frame(
            TEMPERATURE,
            sequence,
            value,
            DataSetHeader::default(),
        ));
        shows(&mut watch, "Good", &json!(value));
    }
    assert_eq!(write(&cell, "ns=2;i=30", "Double", "5"), "Good");
    let about = |node: &str, attribute: &str| json!({"node": node, "attribute": attribute});
    let raw = |node: &str| json!({"node": node, "start": 0, "count": 10});
    let questions = json!([
        about(TEMPERATURE_NODE, "Description"),
        about(TEMPERATURE_NODE, "Historizing"),
        about("ns=2;i=30", "Historizing"),
        raw(TEMPERATURE_NODE),
        raw("ns=2;i=30"),
        {"node": TEMPERATURE_NODE, "property": "ValuePrecision"},
    ]);
    let told = cell.asyncua_once(
        "opcua_history.py",
        &[SERVER_ENDPOINT, &questions.to_string()],
    );
    let text = told[0]["value"].as_str().unwrap();
    assert!(text.contains("Of the hot end"), "{text}");
    assert_eq!(
        [&told[1]["value"], &told[2]["value"]],
        [&json!(true), &json!(false)]
    );
    let values = told[3]["values"].as_array().unwrap();
    let values: Vec<&Value> = values.iter().map(|one| &one[1]).collect();
    assert_eq!(values, [2.5, 3.5]);
    assert_eq!(told[4]["status"], "BadUserAccessDenied");
    assert_eq!(told[5]["value"], 2.0);
}
