//! The configuration of a component: set by the admitted client only, refused with the field and
//! the reason, and kept over a restart.

use std::io::Write as _;
use std::process::{Command, Stdio};

use serde_json::json;
use system_tests::{Cell, Peer, StartedChild, program};

use super::{ENDPOINT, SOON, component_started};

const PASSWORD: &str = "correct horse battery";
const ARM: &str = "component: arm
application_uri: urn:ua-bridge:system-tests:component
namespace: 9
security: [Basic256Sha256]
skills:
  - {name: Grasp, type: GraspSkillType, driver: {simulated: {duration: 50 ms}}}
configurable:
  - {name: ForceLimit, limits: Force, unit: N, range: [5, 50]}
  - {name: Product, type: String}
";

#[test]
fn an_administrator_configures_a_component_and_a_restart_keeps_it() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let yaml = cell.file("arm.yaml", ARM);
    let store = cell.folder().join("store");
    let mut user = Command::new(program("ua-server"))
        .args(["user", "add", "chief", "--role", "configure_admin", "--pki"])
        .arg(&store)
        .stdin(Stdio::piped())
        .spawn()
        .unwrap();
    writeln!(user.stdin.take().unwrap(), "{PASSWORD}").unwrap();
    assert!(user.wait().unwrap().success());
    let start = || {
        let args = ["--endpoint", ENDPOINT, "--lds", "none", "--interface", "lo"];
        let child = component_started(&yaml, &args)
            .args(["--trust-any-client-certificate", "--pki"])
            .args([&store])
            .start();
        system_tests::eventually("the component serves", SOON, || {
            std::net::TcpStream::connect(ENDPOINT.trim_start_matches("opc.tcp://")).ok()
        });
        child
    };
    let folder = cell.folder().join("pairs").display().to_string();
    let arm = start();
    let configure = |fields: &str, more: &[&str]| {
        let secured = ["--security", "Basic256Sha256", "--certificates", &folder];
        let args = [&[ENDPOINT, "--fields", fields], &secured[..], more].concat();
        let lines = cell.asyncua_once("opcua_configure.py", &args);
        lines.last().cloned().unwrap_or_default()
    };
    let chief = ["--user", "chief", "--password", PASSWORD];
    let refused = configure(r#"{"ForceLimit": 20.0}"#, &[]);
    assert_eq!(refused["fault"], "BadUserAccessDenied", "{refused}");
    let wrong = configure(r#"{"Product": "A", "ForceLimit": 70.0}"#, &chief);
    let answer = json!(["refused", "ForceLimit", "expected 5 to 50 N, found 70"]);
    assert_eq!(wrong["answer"], answer, "{wrong}");
    assert_eq!(wrong["shown"], json!({"ForceLimit": null, "Product": null}));
    let set = configure(r#"{"Product": "A", "ForceLimit": 20.0}"#, &chief);
    assert_eq!(set["answer"], json!(["configured", "", ""]), "{set}");
    let shown = json!({"ForceLimit": 20.0, "Product": "A"});
    assert_eq!(set["shown"], shown);
    drop(arm);
    let _arm = start();
    let again = configure("{}", &chief);
    assert_eq!(again["shown"], shown, "{again}");
    let mut run = StartedChild::new("ua-space", &program("ua-space"))
        .args(["call", "arm.Grasp.Reset", "--interface", "lo"])
        .start();
    assert!(run.wait_for_end(SOON).success(), "{run}");
    let mut run = StartedChild::new("ua-space", &program("ua-space"))
        .args(["call", "arm.Grasp", "Force=45", "--interface", "lo"])
        .start();
    assert!(run.wait_for_end(SOON).success(), "{run}");
    let last = configure("{}", &chief);
    assert_eq!(last["force"], 20.0, "{last}");
}
