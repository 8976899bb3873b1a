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

const SENSOR: (&str, &str, &str) = (
    "vacuum-sensor.yaml",
    "urn:example:vacuum-sensor",
    "configurable:\n  - {name: ReportingPeriod, period: all, range: [50, 5000]}\n",
);

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
    // A sensor has no skills.
    let before = if file == SENSOR.0 {
        "values:\n"
    } else {
        "skills:\n"
    };
    let fields = format!("{fields}{before}");
    let changes = [
        ("security: [None]", "security: [Basic256Sha256]"),
        (before, fields.as_str()),
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

/// Starts the MES as the user chief, and waits until it knows components.
fn mes(cell: &Cell, names: [&str; 2]) -> Child {
    let capabilities = Path::new(EXAMPLES).join("capabilities.ttl");
    fs::copy(capabilities, cell.folder().join("capabilities.ttl")).unwrap();
    let _password = cell.file("chief.password", PASSWORD);
    let user = "user: {name: chief, password_file: chief.password}\nprocesses:\n";
    let pki = store(cell, "mes");
    let more = ["--pki", pki.to_str().unwrap()];
    let changes = [("processes:\n", user)];
    let mes = start(cell, "ua-mes", "mes.yaml", &changes, &more);
    eventually("both components are in the graph", SOON, || {
        let there = rows("components");
        let is_there = |name: &&str| there.iter().any(|row| row["name"] == **name);
        names.iter().all(is_there).then_some(())
    });
    mes
}

fn outcomes(response: &Value) -> Vec<Value> {
    let components = response["components"].as_array().cloned();
    let all = components.unwrap_or_default();
    all.iter().map(|one| one["outcome"].clone()).collect()
}

#[test]
fn a_product_is_configured_at_all_its_components_or_at_none() {
    let Some(cell) = Cell::with(&[]) else { return };
    let [gripper, robot] = FIELDS;
    let _gripper = component(&cell, gripper);
    let robot_runs = component(&cell, robot);
    let _mes = mes(&cell, ["parallel-gripper", "robot"]);
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

/// Writes the file of a product with a gripper and a sensor.
fn gripper_and_sensor(cell: &Cell, force: f64, period: f64) -> PathBuf {
    let fields = [
        (FIELDS[0].1, "GripForce", "N", force),
        (SENSOR.1, "ReportingPeriod", "ms", period),
    ];
    let elements = fields.map(|(uri, field, unit, value)| {
        format!(
            "<InternalElement Name=\"{field}\" ID=\"{field}\">
              <Attribute Name=\"ApplicationUri\"><Value>{uri}</Value></Attribute>
              <Attribute Name=\"{field}\" Unit=\"{unit}\" AttributeDataType=\"xs:double\">
                <Value>{value}</Value></Attribute>
            </InternalElement>"
        )
    });
    let text = format!(
        "<CAEXFile FileName=\"product.aml\" SchemaVersion=\"3.0\" xmlns=\"http://www.dke.de/CAEX\">
          <InstanceHierarchy Name=\"Cover\">{}</InstanceHierarchy></CAEXFile>",
        elements.concat()
    );
    cell.file("product.aml", &text)
}

#[test]
fn a_sensor_without_skills_is_configured_with_a_gripper_or_neither_of_them_is() {
    let Some(cell) = Cell::with(&[]) else { return };
    let gripper = FIELDS[0];
    let _gripper = component(&cell, gripper);
    let sensor = component(&cell, SENSOR);
    let _mes = mes(&cell, ["parallel-gripper", "vacuum-sensor"]);
    let run = |force, period, more: &[&str]| {
        let (code, response) = configure(&gripper_and_sensor(&cell, force, period), more);
        (code, outcomes(&response), response)
    };
    let stored = || [gripper.0, SENSOR.0].map(|file| stored(&cell, file));

    let (code, checked, response) = run(20.0, 100.0, &["--check"]);
    assert_eq!(
        (code, checked),
        (0, vec![json!("accepted"); 2]),
        "{response}"
    );
    let (code, refused, response) = run(20.0, 7.0, &[]);
    assert_eq!((code, &refused[1]), (1, &json!("refused")), "{response}");
    let reason = "ReportingPeriod: expected 50 to 5000 ms, found 7";
    assert_eq!(response["components"][1]["reason"], reason);
    assert_eq!(stored(), [json!({}), json!({})]);
    let (code, set, response) = run(20.0, 100.0, &[]);
    assert_eq!((code, set), (0, vec![json!("configured"); 2]), "{response}");
    let first = [
        json!({"GripForce": 20.0}),
        json!({"ReportingPeriod": 100.0}),
    ];
    assert_eq!(stored(), first);

    // The sensor accepts its field, and then cannot store it: the gripper is set back.
    let blocked = store(&cell, SENSOR.0).join("configuration.json.new");
    fs::create_dir(&blocked).unwrap();
    let (code, back, response) = run(30.0, 200.0, &[]);
    assert_eq!((code, &response["outcome"]), (1, &json!("set_back")));
    assert_eq!(back, ["set_back", "refused"], "{response}");
    assert_eq!(stored(), first);
    fs::remove_dir(&blocked).unwrap();

    // Without the sensor nothing is set.
    drop(sensor);
    let (code, refused, response) = run(30.0, 200.0, &[]);
    assert_eq!((code, &response["outcome"]), (1, &json!("refused")));
    assert_eq!(refused, ["accepted", "not_reached"], "{response}");
    assert_eq!(stored(), first);
}
