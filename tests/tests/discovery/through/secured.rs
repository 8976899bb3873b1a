//! The configuration of a product behind two stations, over secured channels only.

use std::fs;
use std::path::PathBuf;
use std::process::Command;
use std::time::Duration;

use plant_opcua::client::ClientUser;
use serde_json::{Value, json};
use skills::{ClientOptions, SkillClient};
use system_tests::{Cell, Child, StartedChild, eventually, program};

use super::super::SOON;
use super::product::{
    COMPONENTS, both_are_known, both_are_supervised, configure, ended, outcomes, product,
};
use super::{GRIPPER, LEVELS, ROBOT, Tower, component_started, on_top, tower, upper};

const PASSWORD: &str = "correct horse battery";
const STATIONS: [&str; 2] = ["station-low", "station-high"];

/// The certificate store of a program.
fn store(cell: &Cell, name: &str) -> PathBuf {
    cell.folder().join(format!("{name}.pki"))
}

/// Waits for the certificate of a program, and makes others trust it.
fn trusted_by(cell: &Cell, name: &str, others: &[&str]) {
    let certificate = store(cell, name).join("own/cert.der");
    eventually("there is a certificate", SOON, || {
        certificate.exists().then_some(())
    });
    for other in others {
        let trusts = Command::new(program("ua-server"))
            .arg("trust")
            .args([&certificate])
            .arg("--pki")
            .arg(store(cell, other))
            .output()
            .unwrap();
        assert!(trusts.status.success(), "{other} and {name}: {trusts:?}");
    }
}

/// Creates a user in the store of a station.
fn add_user(cell: &Cell, station: &str, (name, role): (&str, &str)) {
    let password = cell.file("password", PASSWORD);
    let added = Command::new(program("ua-server"))
        .args(["user", "add", name, "--role", role, "--pki"])
        .arg(store(cell, station))
        .stdin(fs::File::open(password).unwrap())
        .output()
        .unwrap();
    assert!(added.status.success(), "{added:?}");
}

fn station(cell: &Cell, tower: &Tower, at: usize) -> Child {
    StartedChild::new(STATIONS[at], &program("ua-station"))
        .args(["--name", STATIONS[at], "--interface", "lower0"])
        .args(["--endpoint", &format!("opc.tcp://{}.1:4840", LEVELS[at])])
        .args(["--upper-interface", "upper0", "--upper-lds", "uri=urn:*"])
        .args(["--upper-endpoint", &upper(at), "--pki"])
        .args([&store(cell, STATIONS[at])])
        .at(&tower.stations[at])
        .start()
}

fn component(cell: &Cell, tower: &Tower, at: usize) -> Child {
    let (name, uri, of, field) = COMPONENTS[at];
    let yaml = format!(
        "{{component: {name}, application_uri: '{uri}', namespace: {}, security: [Basic256Sha256],
          configurable: [{field}], skills: [{{name: Work, type: {of}, driver: simulated}}]}}",
        6 + at
    );
    let file = cell.file(&format!("{name}.yaml"), &yaml);
    component_started(&file, &tower.devices[at], [21, 22][at])
        .args(["--pki"])
        .args([&store(cell, name)])
        .start()
}

/// Starts the MES as a user of the upper station.
fn mes(cell: &Cell, tower: &Tower, user: &str) -> Child {
    let yaml = format!(
        "mes: mes\napplication_uri: urn:ua-bridge:system-tests:mes\nnamespace: 50\n\
         endpoint: opc.tcp://{}.50:0\nsecurity: [Basic256Sha256]\n\
         user: {{name: {user}, password_file: password}}\nprocesses: []\n",
        LEVELS[2]
    );
    StartedChild::new("ua-mes", &program("ua-mes"))
        .args([cell.file("mes.yaml", &yaml)])
        .args(["--interface", "top0", "--lds", "none", "--pki"])
        .args([&store(cell, "mes")])
        .at(&tower.client)
        .start()
}

/// Returns the stored configurations of both components.
fn stored(cell: &Cell) -> [Value; 2] {
    COMPONENTS.map(|(name, ..)| {
        let text = fs::read_to_string(store(cell, name).join("configuration.json"));
        text.map_or_else(|_| json!({}), |text| serde_json::from_str(&text).unwrap())
    })
}

/// Checks a field of the gripper as a client that is no server of the level, with the store
/// `panel`. Returns the reason if that is refused.
fn checked(cell: &Cell, tower: &Tower, user: &str) -> Result<(), String> {
    let options = ClientOptions {
        application_uri: "urn:ua-bridge:system-tests:panel".to_owned(),
        pki: Some(store(cell, "panel")),
        user: Some(ClientUser {
            name: user.to_owned(),
            password: PASSWORD.to_owned(),
        }),
        within: Duration::from_secs(10),
        ..ClientOptions::default()
    };
    on_top(tower, async || {
        let client = SkillClient::connect(&upper(1), &options).await;
        let client = client.map_err(|fault| fault.to_string())?;
        let (_, configurations) = client.skills_and_configurations().await.unwrap();
        let mut all = configurations.iter();
        let gripper = all.find(|one| one.behind.as_deref() == Some(GRIPPER));
        let handle = client.configuration(gripper.unwrap());
        let fields = [("GripForce".to_owned(), Some(20.0.into()))];
        let checked = handle.set_fields(&fields, true).await;
        client.close().await;
        checked.map(drop).map_err(|fault| fault.to_string())
    })
}

/// Asserts that a reason names the denied call and the missing role.
fn names_the_role(reason: &str) {
    for part in ["BadUserAccessDenied", "SetFields", "configure_admin"] {
        assert!(reason.contains(part), "{reason}");
    }
}

#[test]
fn over_secured_channels_only_a_user_with_the_role_configures_behind_two_stations() {
    let Some(cell) = Cell::with(&[]) else { return };
    let tower = tower(&cell);
    add_user(&cell, STATIONS[1], ("otto", "operator"));
    add_user(&cell, STATIONS[1], ("chief", "configure_admin"));
    let [low, high] = STATIONS;
    let mut upper_station = station(&cell, &tower, 1);
    trusted_by(&cell, high, &[low, "mes"]);
    let _low = station(&cell, &tower, 0);
    trusted_by(&cell, low, &[high, "gripper", "robot"]);
    let _components = [0, 1].map(|at| component(&cell, &tower, at));
    trusted_by(&cell, "gripper", &[low]);
    trusted_by(&cell, "robot", &[low]);

    // A stranger has the password, and no certificate that the station trusts.
    trusted_by(&cell, high, &["panel"]);
    let fault = checked(&cell, &tower, "chief").unwrap_err();
    assert!(fault.starts_with("its component is lost"), "{fault}");
    let reason =
        "rejected a client whose certificate is not trusted; to trust it: `ua-server trust";
    upper_station.wait_for_line(reason, SOON);
    trusted_by(&cell, "panel", &[high]);

    // An operator sees the components, and does not configure them.
    let operated = mes(&cell, &tower, "otto");
    trusted_by(&cell, "mes", &[high]);
    both_are_known(&tower);
    let wanted = product(&cell, 20.0, 0.5);
    let (code, refused) = ended(configure(&tower, &wanted, &[]));
    assert_eq!(
        (code, outcomes(&refused)),
        (1, vec!["refused"; 2]),
        "{refused}"
    );
    for (at, name) in [(0, GRIPPER), (1, ROBOT)] {
        let of = &refused["components"][at];
        assert_eq!(of["component"], name, "{refused}");
        names_the_role(of["reason"].as_str().unwrap());
    }
    names_the_role(&checked(&cell, &tower, "otto").unwrap_err());
    eventually("the stations are registered", SOON, || {
        checked(&cell, &tower, "chief").ok()
    });
    assert_eq!(stored(&cell), [json!({}), json!({})]);
    drop(operated);

    let _mes = mes(&cell, &tower, "chief");
    both_are_known(&tower);
    both_are_supervised(&cell, &tower);
    let (code, set) = ended(configure(&tower, &wanted, &[]));
    assert_eq!((code, outcomes(&set)), (0, vec!["configured"; 2]), "{set}");
    let expected = [json!({"GripForce": 20.0}), json!({"SpeedLimit": 0.5})];
    assert_eq!(stored(&cell), expected);
}
