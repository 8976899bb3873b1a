//! Skills over worse networks: a link that is interrupted during a run, and one that loses and
//! delays frames.

use std::time::Duration;

use discovery::{MdnsInterface, WatchSettings};
use skills::{ClientOptions, Detector, ParameterType, SkillClient, SkillHandle};
use system_tests::{Cell, HERE, StartedChild, THERE, WIRE, WireEffect, program};
use tokio::time::{Instant, sleep};

use super::SOON;

/// A component for the other end of a cable or wire.
fn far(cell: &Cell) -> StartedChild {
    let yaml = "{component: far, application_uri: 'urn:ua-bridge:system-tests:far', namespace: 9,
        security: [None], skills: [
          {name: Grasp, type: GraspSkillType, driver: {simulated: {duration: 5 s}}},
          {name: Release, type: ReleaseSkillType, driver: {simulated: {duration: 50 ms}}}]}";
    let endpoint = format!("opc.tcp://{THERE}:4850");
    StartedChild::new("ua-component", &program("ua-component"))
        .args([cell.file("far.yaml", yaml)])
        .args([
            "--endpoint",
            &endpoint,
            "--lds",
            "none",
            "--interface",
            WIRE,
        ])
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
    let found = client.skills_of(&ParameterType::own(of)).await.unwrap();
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
    let _component = far(&cell).beyond(&cable).start();
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

#[test]
fn runs_over_a_lossy_and_slow_link_happen_once_each_and_their_outcomes_are_known() {
    let Some(cell) = Cell::with(&[]) else { return };
    let host = cell.host(WireEffect {
        loss: 0.05,
        delay: Duration::from_millis(50),
    });
    let _component = far(&cell).on(&host).start();
    on_this_host(async || {
        // A lost frame is sent again after 200 ms and more.
        let client = connected(Duration::from_secs(10)).await;
        let release = one(&client, "ReleaseSkillType").await;
        let mut before = None;
        for _ in 0..20 {
            let outcome = skills::RunnableSkill::run(&release, Vec::new(), SOON)
                .await
                .unwrap();
            assert!(outcome.succeeded, "{outcome:?}");
            assert!(
                before.is_none_or(|before| outcome.run == before + 1),
                "a Start took effect twice, or a run is missing: {before:?} {outcome:?}"
            );
            before = Some(outcome.run);
        }
        client.close().await;
    });
}

#[test]
fn a_component_and_its_skills_are_found_over_a_lossy_and_slow_link() {
    let Some(cell) = Cell::with(&[]) else { return };
    let host = cell.host(WireEffect {
        loss: 0.05,
        delay: Duration::from_millis(50),
    });
    on_this_host(async || {
        let settings = WatchSettings {
            mdns: Some(MdnsInterface::parse(WIRE)),
            ..WatchSettings::default()
        };
        let mut watcher = discovery::watch(settings).unwrap();
        let detector = Detector::new(ClientOptions {
            within: Duration::from_secs(10),
            ..ClientOptions::default()
        });
        let began = Instant::now();
        let _component = far(&cell).on(&host).start();
        let mut announced = None;
        let mut changes = detector.changes();
        while detector
            .of_type(&ParameterType::own("GraspSkillType"))
            .is_empty()
        {
            tokio::select! {
                found = watcher.next() => match found.unwrap() {
                    discovery::ServerChange::Seen(known) => {
                        announced.get_or_insert_with(|| began.elapsed());
                        detector.seen(&known.name, &known.url);
                    }
                    discovery::ServerChange::Restarted(_) => {}
                    discovery::ServerChange::Gone { known, loss } => panic!("{known:?}: {loss:?}"),
                },
                changed = changes.changed() => changed.unwrap(),
                () = sleep(FOUND_WITHIN) => {}
            }
            assert!(began.elapsed() < FOUND_WITHIN, "{announced:?}");
        }
        println!(
            "announced after {announced:?}, its skill after {:?}",
            began.elapsed()
        );
    });
}

/// Time from the start of a component to its first skill, on a loaded machine.
const FOUND_WITHIN: Duration = Duration::from_secs(20);
