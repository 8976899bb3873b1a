//! Composites in a cell with secured channels only.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use plant_opcua::certificates;
use plant_opcua::pki::Pki;
use plant_opcua::users::{Roles, StoredUser, UserRole, Users, hashed};

use super::{PeerAccess, Remote};
use crate::component::{Component, DriverSetup};
use crate::conformance;
use crate::server::{ComponentServer, ServeSettings};
use crate::shown::RunOutcome;
use crate::value::SkillValue;

const ROBOT: &str = include_str!("../../../../examples/plant/robot.yaml");
const GRIPPER: &str = include_str!("../../../../examples/plant/parallel-gripper.yaml");
const PASSWORD: &str = "a password of a test";

struct Secured {
    folder: PathBuf,
}

impl Drop for Secured {
    fn drop(&mut self) {
        // The folder of a failed test is left to the operating system.
        let _removed = std::fs::remove_dir_all(&self.folder);
    }
}

impl Secured {
    fn new(name: &str) -> Self {
        let folder = std::env::temp_dir().join(format!("{name}-{}", std::process::id()));
        Self { folder }
    }

    /// Creates the certificate store of a component.
    fn store(&self, name: &str, uri: &str) {
        let store = Pki::open(self.folder.join(name)).unwrap();
        store.ensure_own_at(uri, &["127.0.0.1".to_owned()]).unwrap();
    }

    fn trusts(&self, name: &str, other: &str) {
        let certificate = self.folder.join(other).join("own/cert.der");
        let path = certificate.to_str().unwrap();
        certificates::trust(&self.folder.join(name), path).unwrap();
    }

    /// Adds a user that may run the skills of a component.
    fn add_operator(&self, name: &str, user: &str) {
        let mut users = Users::default();
        let operator = StoredUser {
            roles: Roles::of(&[UserRole::Operator]),
            credential: hashed(PASSWORD.as_bytes()).unwrap(),
        };
        users.put(user, operator).unwrap();
        users.write(&self.folder.join(name).join("users")).unwrap();
    }

    fn serve(&self, name: &str, text: &str) -> ComponentServer {
        let text = text.replace("[None]", "[Basic256Sha256]");
        let component = Component::from_yaml(&text, Path::new("")).unwrap();
        let settings = ServeSettings {
            pki: Some(self.folder.join(name)),
            ..ServeSettings::default()
        };
        let server = ComponentServer::build(&component, &settings, |_, _| Vec::new()).unwrap();
        server.start();
        server
    }

    /// Runs PickAndPlace of a composite with these partners.
    async fn run(&self, partners: &str, user: &str) -> RunOutcome {
        std::fs::write(self.folder.join("password"), PASSWORD).unwrap();
        let text = format!(
            "component: handling\napplication_uri: urn:test:handling\nnamespace: 25\nsecurity: [Basic256Sha256]\n{user}\n\
             skills:\n  - name: Place\n    type: PickAndPlaceSkillType\n    driver: {{pick_and_place: {partners}}}\n"
        );
        let component = Component::from_yaml(&text, &self.folder);
        let component =
            component.unwrap_or_else(|findings| panic!("{}", findings.render("x", &text)));
        let peers = PeerAccess::of_component(&component, Some(&self.folder.join("handling")));
        let DriverSetup::PickAndPlace(partners) = component.skills[0].driver.clone() else {
            panic!("another driver");
        };
        let driver = Arc::new(Remote::new(partners, Arc::default(), peers));
        let pose = |y: f64| SkillValue::from([0.4, y, 0.1, 0.0, 0.0, 0.0]);
        let parameters = vec![
            ("PickPosition".to_owned(), pose(0.2)),
            ("PlacePosition".to_owned(), pose(-0.2)),
        ];
        let ran = conformance::run_once("PickAndPlaceSkillType", driver, parameters);
        tokio::time::timeout(Duration::from_secs(120), ran)
            .await
            .unwrap()
            .unwrap()
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_composite_of_a_secured_cell_uses_trusted_partners_as_its_user_and_refuses_others() {
    let cell = Secured::new("secured-composite");
    let parts = [
        ("robot", "urn:example:robot"),
        ("gripper", "urn:example:gripper"),
        ("handling", "urn:test:handling"),
    ];
    for (name, uri) in parts {
        cell.store(name, uri);
    }
    cell.trusts("robot", "handling");
    cell.trusts("gripper", "handling");
    cell.trusts("handling", "robot");
    cell.add_operator("robot", "handling");
    cell.add_operator("gripper", "handling");
    let fast = ROBOT.replace("{reach: 1.3}", "{reach: 1.3, time_scale: 20}");
    let robot = cell.serve("robot", &fast);
    let own = GRIPPER.replace("400 ms", "20 ms") + "anonymous: off\n";
    let gripper = cell.serve("gripper", &own);
    let partners = format!(
        "{{robot: \"{}\", gripper: \"{}\", within: 20 s}}",
        robot.url(),
        gripper.url()
    );
    let user = "user: {name: handling, password_file: password}";

    let untrusted = cell.run(&partners, user).await;
    let expected = ["BadCertificateUntrusted", gripper.url()];
    for part in expected {
        assert!(untrusted.message.contains(part), "{}", untrusted.message);
    }
    assert!(!untrusted.succeeded);
    assert_eq!(robot.skills()[0].shown().run, 0, "the robot has moved");

    cell.trusts("handling", "gripper");
    let anonymous = cell.run(&partners, "").await;
    let expected = "does not admit anonymous users";
    assert!(
        !anonymous.succeeded && anonymous.message.contains(expected),
        "{}",
        anonymous.message
    );
    let done = cell.run(&partners, user).await;
    assert!(done.succeeded, "{}", done.message);
    assert_eq!(gripper.skills()[0].shown().run, 1);
    robot.stop().await;
    gripper.stop().await;
}
