//! Servers that multicast does not reach: `ua-lds` and `ua-station` find a component of another
//! network at the Global Discovery Server, where it is registered.

use std::process::Command;
use std::time::Duration;

use nix::sys::signal::Signal;
use skills::{ClientOptions, ParameterType, RunnableSkill as _, SkillClient};
use system_tests::{Cell, HERE, Peer, StartedChild, THERE, eventually, metrics, program};

use super::{LDS, SOON, STATUS, list, on_network};

/// Timeout of programs that make keys and restart on a loaded machine.
const LATER: Duration = Duration::from_secs(90);
const STATION: &str = "opc.tcp://127.0.0.1:4870";
const COMPONENT: &str = "
component: far
application_uri: 'urn:ua-bridge:system-tests:far'
namespace: 9
security: [None]
skills:
  - {name: Grasp, type: GraspSkillType, driver: {simulated: {duration: 50 ms}}}
  - {name: Release, type: ReleaseSkillType, driver: {simulated: {duration: 50 ms}}}
";

/// Runs a command of `ua-gds`, and returns its output.
fn administrator(args: &[&str], pki: &str) -> String {
    let mut command = Command::new(program("ua-gds"));
    let done = command.args(args).args(["--pki", pki]).output().unwrap();
    assert!(done.status.success(), "{args:?}: {done:?}");
    String::from_utf8(done.stdout).unwrap().trim().to_owned()
}

/// Runs a skill of the component through the station, as a client without a user name.
fn run_through_station() -> bool {
    let runtime = tokio::runtime::Builder::new_current_thread();
    let runtime = { runtime }.enable_all().build().unwrap();
    runtime.block_on(async {
        let limit = tokio::time::Instant::now() + SOON;
        loop {
            assert!(tokio::time::Instant::now() < limit, "no skill is found");
            tokio::time::sleep(Duration::from_millis(50)).await;
            let Ok(client) = SkillClient::connect(STATION, &ClientOptions::default()).await else {
                continue;
            };
            let found = client
                .skills_of(&ParameterType::own("ReleaseSkillType"))
                .await;
            if let Some(found) = found.unwrap_or_default().pop() {
                assert_eq!(found.component, "far");
                let outcome = client.handle(&found).run(Vec::new(), SOON).await.unwrap();
                client.close().await;
                return outcome.succeeded;
            }
            client.close().await;
        }
    })
}

#[test]
fn a_component_beyond_multicast_is_listed_and_run_while_the_gds_lists_it() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let cable = cell.cable();
    cable.lay(HERE);
    let store = |name: &str| cell.folder().join(name).to_str().unwrap().to_owned();
    let (pki, url) = (store("gds"), format!("opc.tcp://{HERE}:4841"));
    administrator(&["ca", "init", "--name", "Cell authority"], &pki);
    let invited = |name: &str| administrator(&["invite", name, "--endpoint", &url], &pki);
    let gds = StartedChild::new("ua-gds", &program("ua-gds"))
        .args(["--endpoint", &url, "--pki", &pki])
        .start();
    // The discovery servers know the certificate of the GDS, and have none of the plant.
    let invitation = invited("nobody");
    let (pinned, _token) = invitation.split_once(",token=").unwrap();
    let asks = ["--gds", pinned, "--gds-period", "1", "--interface", "lo"];
    let _lds = StartedChild::new("ua-lds", &program("ua-lds"))
        .args(asks)
        .args(["--gds-servers", "%", "--metrics", STATUS])
        .args(["--pki", &store("lds-pki")])
        .start();
    let _station = StartedChild::new("ua-station", &program("ua-station"))
        .args([
            "--name",
            "station",
            "--endpoint",
            "opc.tcp://127.0.0.1:4850",
        ])
        .args(["--upper-interface", "lo", "--upper-lds", LDS])
        .args(["--upper-endpoint", STATION, "--allow-unsecured"])
        .args(asks)
        .args(["--gds-servers", "f%", "--pki", &store("station-pki")])
        .start();
    // mDNS of the component ends at its own host.
    let _far = StartedChild::new("ua-component", &program("ua-component"))
        .args([cell.file("far.yaml", COMPONENT)])
        .args(["--endpoint", &format!("opc.tcp://{THERE}:4850")])
        .args(["--lds", "none", "--interface", "lo"])
        .args(["--pki", &store("far-pki")])
        .args(["--gds", &invited("far")])
        .beyond(&cable)
        .start();
    let far = eventually("ua-lds lists the component", LATER, || on_network("far"));
    assert_eq!(far["source"], "gds", "{far}");
    let lines = cell.asyncua_once("opcua_discovery.py", &["find", LDS]);
    let network = list(&lines, "network");
    let found = network.iter().find(|one| one["name"] == "far").unwrap();
    let its_url = found["url"].as_str().unwrap();
    assert!(its_url.contains(&format!("{THERE}:4850")), "{found}");
    assert!(run_through_station());
    // Ten periods after the last answer.
    gds.signal(Signal::SIGKILL);
    eventually("the last answer expires, with a reason", SOON, || {
        let status = metrics(STATUS)?["gds"].clone();
        let is_removed = on_network("far").is_none() && status["listed"] == 0;
        (is_removed && status["reason"].is_string()).then_some(())
    });
    assert!(on_network("ua-lds").is_some(), "multicast is not affected");
}
