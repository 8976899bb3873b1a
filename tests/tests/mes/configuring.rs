//! The configuration of a product in AutomationML, split over its components by the MES.

use std::fs;
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use serde_json::{Value, json};
use system_tests::{Cell, Child, StartedChild, eventually, program};

use super::{EXAMPLES, SOON, rows, start};

const PASSWORD: &str = "correct horse battery";
const FIELDS: [(&str, &str, &str); 2] = [
    (
        "parallel-gripper.yaml",
        "urn:example:gripper",
        "configurable:
  - {name: GripForce, sets: Force, unit: N, range: [5, 50]}
  - {name: Product, type: String}
",
    ),
    (
        "robot.yaml",
        "urn:example:robot",
        "configurable:\n  - {name: SpeedLimit, limits: MaxVelocity, unit: m/s, range: [0.01, 1]}\n",
    ),
];

fn store(cell: &Cell, name: &str) -> PathBuf {
    cell.folder().join(format!("{name}.store"))
}

fn ua_server(arguments: &[&str], input: &str) {
    let mut child = Command::new(program("ua-server"))
        .args(arguments)
        .stdin(Stdio::piped())
        .spawn()
        .unwrap();
    writeln!(child.stdin.take().unwrap(), "{input}").unwrap();
    assert!(child.wait().unwrap().success(), "{arguments:?}");
}

/// Starts a secured component that a user may configure, and waits for its certificate.
fn component(cell: &Cell, (file, _, fields): (&str, &str, &str)) -> Child {
    let pki = store(cell, file);
    let pki = pki.to_str().unwrap();
    let chief = ["user", "add", "chief", "--role", "configure_admin"];
    ua_server(&[&chief[..], &["--pki", pki]].concat(), PASSWORD);
    let fields = format!("{fields}skills:\n");
    let changes = [
        ("security: [None]", "security: [Basic256Sha256]"),
        ("skills:\n", fields.as_str()),
    ];
    let more = ["--pki", pki, "--trust-any-client-certificate"];
    let child = start(cell, "ua-component", file, &changes, &more);
    let certificate = Path::new(pki).join("own/cert.der");
    eventually("the component has a certificate", SOON, || {
        certificate.exists().then_some(())
    });
    let mes = store(cell, "mes");
    let trusted = certificate.to_str().unwrap();
    ua_server(&["trust", trusted, "--pki", mes.to_str().unwrap()], "");
    child
}

/// Configures a product. Returns the exit code and the response.
fn configure(document: &Path, more: &[&str]) -> (i32, Value) {
    let mut child = StartedChild::new("ua-space", &program("ua-space"))
        .args(["configure", document.to_str().unwrap(), "--json"])
        .args(more)
        .start();
    let code = child.wait_for_end(SOON).code().unwrap();
    let response = child.json_lines().pop();
    (code, response.unwrap_or_else(|| json!(child.to_string())))
}

/// Returns the stored configuration of a component.
fn stored(cell: &Cell, file: &str) -> Value {
    let text = fs::read_to_string(store(cell, file).join("configuration.json"));
    text.map_or_else(|_| json!({}), |text| serde_json::from_str(&text).unwrap())
}

#[test]
fn a_product_is_configured_at_all_its_components_or_at_none() {
    let Some(cell) = Cell::with(&[]) else { return };
    let [gripper, robot] = FIELDS;
    let _gripper = component(&cell, gripper);
    let robot_runs = component(&cell, robot);
    let capabilities = Path::new(EXAMPLES).join("capabilities.ttl");
    fs::copy(capabilities, cell.folder().join("capabilities.ttl")).unwrap();
    let _password = cell.file("chief.password", PASSWORD);
    let user = "user: {name: chief, password_file: chief.password}\nprocesses:\n";
    let pki = store(&cell, "mes");
    let more = ["--pki", pki.to_str().unwrap()];
    let _mes = start(
        &cell,
        "ua-mes",
        "mes.yaml",
        &[("processes:\n", user)],
        &more,
    );
    eventually("both components are in the graph", SOON, || {
        let there = rows("components");
        let is_there = |name: &str| there.iter().any(|row| row["name"] == name);
        (is_there("parallel-gripper") && is_there("robot")).then_some(())
    });
    let outcomes = |response: &Value| {
        let components = response["components"].as_array().cloned();
        let all = components.unwrap_or_default();
        all.iter()
            .map(|one| one["outcome"].clone())
            .collect::<Vec<_>>()
    };
    let product = Path::new(EXAMPLES).join("product.aml");

    let (code, checked) = configure(&product, &["--check"]);
    assert_eq!(
        (code, &checked["outcome"]),
        (0, &json!("checked")),
        "{checked}"
    );
    assert_eq!(stored(&cell, gripper.0), json!({}));

    // The robot refuses its field, so the gripper keeps its configuration.
    let text = fs::read_to_string(&product).unwrap();
    let wrong = cell.file("wrong.aml", &text.replace("0.25", "7"));
    let (code, refused) = configure(&wrong, &[]);
    assert_eq!(
        (code, &refused["outcome"]),
        (1, &json!("refused")),
        "{refused}"
    );
    assert_eq!(outcomes(&refused), ["accepted", "refused"]);
    let reason = "SpeedLimit: expected 0.01 to 1 m/s, found 7";
    assert_eq!(refused["components"][1]["reason"], reason);
    assert_eq!(stored(&cell, gripper.0), json!({}));

    // A field in another unit is refused, although its number is in the range.
    let other_unit = cell.file("unit.aml", &text.replace("Unit=\"N\"", "Unit=\"kN\""));
    let (code, refused) = configure(&other_unit, &[]);
    assert_eq!(code, 1, "{refused}");
    assert_eq!(outcomes(&refused), ["refused", "accepted"]);
    let reason = "GripForce: expected the unit N, found kN";
    assert_eq!(refused["components"][0]["reason"], reason);
    assert_eq!(stored(&cell, gripper.0), json!({}));

    let (code, configured) = configure(&product, &[]);
    assert_eq!(
        (code, &configured["outcome"]),
        (0, &json!("configured")),
        "{configured}"
    );
    assert_eq!(outcomes(&configured), ["configured", "configured"]);
    let both = [gripper.0, robot.0].map(|file| stored(&cell, file));
    let expected = [
        json!({"GripForce": 40.0, "Product": "4711"}),
        json!({"SpeedLimit": 0.25}),
    ];
    assert_eq!(both, expected);

    // Without the robot nothing is set.
    drop(robot_runs);
    let other = cell.file("other.aml", &text.replace("<Value>40<", "<Value>30<"));
    let (code, refused) = configure(&other, &[]);
    assert_eq!(
        (code, &refused["outcome"]),
        (1, &json!("refused")),
        "{refused}"
    );
    assert_eq!(outcomes(&refused), ["accepted", "not_reached"]);
    assert_eq!(stored(&cell, gripper.0)["GripForce"], 40.0);
}
