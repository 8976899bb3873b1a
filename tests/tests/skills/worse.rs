//! Skills over worse networks: a link that is interrupted during a run.

use std::time::Duration;

use skills::{ClientOptions, SkillClient, SkillHandle, TypeName};
use system_tests::{Cable, Cell, Child, HERE, Started, THERE, WIRE, program};
use tokio::time::{Instant, sleep};

use super::SOON;

/// A component at the other end of a cable.
fn there(cell: &Cell, cable: &Cable) -> Child {
    let yaml = "{component: far, application_uri: 'urn:ua-bridge:system-tests:far', namespace: 9,
        security: [None], skills: [
          {name: Grasp, type: GraspSkillType, driver: {simulated: {duration: 5 s}}},
          {name: Release, type: ReleaseSkillType, driver: {simulated: {duration: 50 ms}}}]}";
    let endpoint = format!("opc.tcp://{THERE}:4850");
    Started::new("ua-component", &program("ua-component"))
        .args([cell.file("far.yaml", yaml)])
        .args([
            "--endpoint",
            &endpoint,
            "--lds",
            "none",
            "--interface",
            WIRE,
        ])
        .beyond(cable)
        .start()
}

/// Connects to the component with a time limit for each response.
async fn connected(within: Duration) -> SkillClient {
    let options = ClientOptions {
        within,
        ..ClientOptions::default()
    };
    let endpoint = format!("opc.tcp://{THERE}:4850");
    let limit = Instant::now() + SOON;
    loop {
        match SkillClient::connect(&endpoint, &options).await {
            Ok(client) => return client,
            Err(fault) => assert!(Instant::now() < limit, "{fault}"),
        }
    }
}

async fn one(client: &SkillClient, of: &str) -> SkillHandle {
    let found = client.skills_of(&TypeName::own(of)).await.unwrap();
    client.handle(&found[0])
}

fn on_this_host<T>(what: impl AsyncFnOnce() -> T) -> T {
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .unwrap();
    runtime.block_on(what())
}

#[test]
fn a_run_goes_on_while_the_link_is_gone_and_its_outcome_is_read_afterwards() {
    let Some(cell) = Cell::with(&[]) else { return };
    let cable = cell.cable();
    cable.lay(HERE);
    let _component = there(&cell, &cable);
    on_this_host(async || {
        // A caller that waits for its run by number gets the outcome after the link is back.
        let client = connected(Duration::from_secs(2)).await;
        let grasp = one(&client, "GraspSkillType").await;
        let run = grasp.execute(Vec::new(), None).await.unwrap();
        let gone = async {
            cable.cut();
            sleep(Duration::from_secs(3)).await;
            cable.mend();
        };
        let (outcome, ()) = tokio::join!(grasp.wait(run, SOON), gone);
        let outcome = outcome.unwrap();
        assert_eq!((outcome.run, outcome.succeeded), (run, true), "{outcome:?}");
        client.close().await;
    });
}
