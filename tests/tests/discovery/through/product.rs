//! The configuration of a product, whose components are behind two stations.

use std::fs;
use std::path::{Path, PathBuf};

use nix::sys::signal::Signal;
use serde_json::{Value, json};
use system_tests::{Cell, Child, StartedChild, eventually, http_get, program};

use super::super::SOON;
use super::{GRIPPER, LEVELS, ROBOT, Tower, component_started, station, station_started, tower};

/// The components in the order in which they are set: name, ApplicationUri, skill type, fields.
pub(super) const COMPONENTS: [(&str, &str, &str, &str); 2] = [
    (
        "gripper",
        GRIPPER,
        "GraspSkillType",
        "{name: GripForce, sets: Force, unit: N, range: [5, 50]}",
    ),
    (
        "robot",
        ROBOT,
        "PtpMoveSkillType",
        "{name: SpeedLimit, limits: MaxVelocity, unit: m/s, range: [0.01, 1]}",
    ),
];

/// Starts a component with a field, whose store is in the folder of the cell.
fn start(cell: &Cell, tower: &Tower, at: usize) -> Child {
    let (name, uri, of, field) = COMPONENTS[at];
    let yaml = format!(
        "{{component: {name}, application_uri: '{uri}', namespace: {}, security: [None],
          configurable: [{field}], skills: [{{name: Work, type: {of}, driver: simulated}}]}}",
        6 + at
    );
    let file = cell.file(&format!("{name}.yaml"), &yaml);
    component_started(&file, &tower.devices[at], [21, 22][at])
        .env("XDG_STATE_HOME", cell.folder())
        .start()
}

/// Returns the path of the stored configuration of a component.
fn store(cell: &Cell, name: &str) -> PathBuf {
    let stores = cell.folder().join("ua-bridge/pki");
    stores.join(name).join("configuration.json")
}

/// Returns the stored configurations of both components.
fn stored(cell: &Cell) -> [Value; 2] {
    COMPONENTS.map(|(name, ..)| {
        let text = fs::read_to_string(store(cell, name));
        text.map_or_else(|_| json!({}), |text| serde_json::from_str(&text).unwrap())
    })
}

/// Writes the file of a product.
pub(super) fn product(cell: &Cell, force: f64, speed: f64) -> PathBuf {
    let [gripper, robot] = [
        (GRIPPER, "GripForce", force),
        (ROBOT, "SpeedLimit", speed),
    ]
    .map(|(uri, field, value)| {
        format!(
            "<InternalElement Name=\"{field}\" ID=\"{field}\">
              <Attribute Name=\"ApplicationUri\"><Value>{uri}</Value></Attribute>
              <Attribute Name=\"{field}\" AttributeDataType=\"xs:double\"><Value>{value}</Value></Attribute>
            </InternalElement>"
        )
    });
    let text = format!(
        "<CAEXFile FileName=\"product.aml\" SchemaVersion=\"3.0\" xmlns=\"http://www.dke.de/CAEX\">
          <InstanceHierarchy Name=\"Cover\">{gripper}{robot}</InstanceHierarchy></CAEXFile>"
    );
    cell.file("product.aml", &text)
}

/// Starts to configure a product by the MES.
pub(super) fn configure(tower: &Tower, product: &Path, more: &[&str]) -> Child {
    StartedChild::new("ua-space", &program("ua-space"))
        .args(["configure", product.to_str().unwrap(), "--json"])
        .args(more)
        .at(&tower.client)
        .start()
}

/// Returns the exit code and the response, when the product is configured.
pub(super) fn ended(mut child: Child) -> (i32, Value) {
    let code = child.wait_for_end(SOON * 2).code().unwrap();
    let response = child.json_lines().pop();
    (code, response.unwrap_or_else(|| json!(child.to_string())))
}

pub(super) fn outcomes(response: &Value) -> Vec<&str> {
    let components = response["components"].as_array().unwrap();
    let outcomes = components
        .iter()
        .map(|one| one["outcome"].as_str().unwrap());
    outcomes.collect()
}

/// Waits until the MES has both components in its graph.
pub(super) fn both_are_known(tower: &Tower) {
    eventually("both components are known to the MES", SOON * 3, || {
        let path = "/ask/components";
        let page = tower.client.within(|| http_get("127.0.0.1:8087", path))?;
        let page: Value = serde_json::from_str(&page).ok()?;
        let rows = page["rows"].as_array()?;
        let is_there = |name: &str| rows.iter().any(|row| row["name"] == name);
        COMPONENTS
            .iter()
            .all(|(name, ..)| is_there(name))
            .then_some(())
    });
}

/// Waits until both components accept their fields: each station has registered at the one above,
/// and each component at its station, which may configure it then.
pub(super) fn both_are_supervised(cell: &Cell, tower: &Tower) {
    let wanted = product(cell, 20.0, 0.5);
    let accepted = eventually("both components accept their fields", SOON, || {
        let (code, checked) = ended(configure(tower, &wanted, &["--check"]));
        (code == 0).then_some(checked)
    });
    assert_eq!(outcomes(&accepted), ["accepted"; 2], "{accepted}");
}

#[test]
fn a_product_is_configured_behind_two_stations_at_all_its_components_or_at_none() {
    let Some(cell) = Cell::with(&[]) else { return };
    let tower = tower(&cell);
    let _low = station(&tower, 0);
    let _high = station_started(&tower, 1)
        .env("UA_ANONYMOUS", "operator,configure_admin")
        .start();
    let [_gripper, robot] = [0, 1].map(|at| start(&cell, &tower, at));
    let mes = format!(
        "mes: mes\napplication_uri: urn:ua-bridge:system-tests:mes\nnamespace: 50\n\
         endpoint: opc.tcp://{}.50:0\nsecurity: [None]\nprocesses: []\n",
        LEVELS[2]
    );
    let _mes = StartedChild::new("ua-mes", &program("ua-mes"))
        .args([cell.file("mes.yaml", &mes)])
        .args(["--interface", "top0", "--lds", "none"])
        .at(&tower.client)
        .start();
    both_are_known(&tower);

    // All fields are checked before the first one is set.
    both_are_supervised(&cell, &tower);
    let (code, refused) = ended(configure(&tower, &product(&cell, 20.0, 7.0), &[]));
    let expected = (1, vec!["accepted", "refused"]);
    assert_eq!((code, outcomes(&refused)), expected, "{refused}");
    let reason = "SpeedLimit: expected 0.01 to 1 m/s, found 7";
    assert_eq!(refused["components"][1]["reason"], reason);
    assert_eq!(stored(&cell), [json!({}), json!({})]);
    let (code, set) = ended(configure(&tower, &product(&cell, 20.0, 0.5), &[]));
    assert_eq!((code, outcomes(&set)), (0, vec!["configured"; 2]), "{set}");
    let first = [json!({"GripForce": 20.0}), json!({"SpeedLimit": 0.5})];
    assert_eq!(stored(&cell), first);

    // The robot accepts its field, and then cannot store it.
    let blocked = store(&cell, "robot").with_extension("json.new");
    fs::create_dir(&blocked).unwrap();
    let (code, back) = ended(configure(&tower, &product(&cell, 30.0, 0.4), &[]));
    assert_eq!((code, &back["outcome"]), (1, &json!("set_back")), "{back}");
    assert_eq!(outcomes(&back), ["set_back", "refused"], "{back}");
    let reason = back["components"][1]["reason"].as_str().unwrap();
    assert!(reason.contains("cannot write"), "{back}");
    assert_eq!(stored(&cell), first);
    fs::remove_dir(&blocked).unwrap();

    is_lost_in_between(&cell, &tower, robot, &first);
}

/// Kills the robot after the gripper is set and before the robot is.
fn is_lost_in_between(cell: &Cell, tower: &Tower, mut robot: Child, before: &[Value; 2]) {
    let mut tries = 0;
    let lost = loop {
        let setting = configure(tower, &product(cell, 40.0, 0.3), &[]);
        let limit = std::time::Instant::now() + SOON;
        while stored(cell)[0] == before[0] {
            assert!(std::time::Instant::now() < limit, "{setting}");
        }
        robot.signal(Signal::SIGKILL);
        let (code, response) = ended(setting);
        robot.wait_for_end(SOON);
        robot = start(cell, tower, 1);
        if code != 0 {
            break response;
        }
        // The robot was set before it was killed.
        tries += 1;
        assert!(tries < 5, "{response}");
        both_are_known(tower);
        let again = eventually("the robot is configured again", SOON * 2, || {
            let (code, again) = ended(configure(tower, &product(cell, 20.0, 0.5), &[]));
            (code == 0).then_some(again)
        });
        assert_eq!(outcomes(&again), ["configured"; 2], "{again}");
    };
    let [gripper, robot_outcome] = outcomes(&lost)[..] else {
        panic!("{lost}");
    };
    assert_eq!(gripper, "set_back", "{lost}");
    assert!(["unknown", "refused"].contains(&robot_outcome), "{lost}");
    assert_eq!(lost["components"][1]["component"], ROBOT);
    assert!(lost["components"][1]["reason"].is_string(), "{lost}");
    assert_eq!(stored(cell), *before, "{lost}");
    // When it is back, the product is configured.
    let set = eventually("the product is configured", SOON * 2, || {
        let (code, set) = ended(configure(tower, &product(cell, 40.0, 0.3), &[]));
        (code == 0).then_some(set)
    });
    assert_eq!(outcomes(&set), ["configured"; 2], "{set}");
    let expected = [json!({"GripForce": 40.0}), json!({"SpeedLimit": 0.3})];
    assert_eq!(stored(cell), expected);
}
