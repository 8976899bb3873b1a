use skills::conformance;

use super::simulator::{SchmalzFaults, SchmalzSettings, SchmalzSimulator, ServedMaster};
use super::*;

struct Bench {
    simulator: SchmalzSimulator,
    serving: ServedMaster,
}

async fn bench(part: bool) -> Bench {
    let settings = SchmalzSettings {
        part,
        time_scale: 10.0,
        ..SchmalzSettings::default()
    };
    let simulator = SchmalzSimulator::new(settings);
    let serving = ServedMaster::start(&simulator, "127.0.0.1:0")
        .await
        .unwrap();
    Bench { simulator, serving }
}

impl Bench {
    fn driver(&self, of: &str) -> Arc<dyn Driver> {
        let timing = SchmalzTiming {
            grasp: Duration::from_millis(600),
            release: Duration::from_millis(600),
        };
        let gripper =
            SchmalzGripper::new(&self.serving.address().to_string(), "master1port1", timing);
        gripper
            .driver(&[ParameterType::own(of)], &PeerAccess::default())
            .unwrap()
    }

    async fn run(&self, of: &str) -> (bool, String) {
        let outcome = conformance::run_once(of, self.driver(of), Vec::new())
            .await
            .unwrap();
        (outcome.succeeded, outcome.message)
    }
}

#[tokio::test]
async fn its_drivers_are_as_drivers_should_be() {
    for of in ["GraspSkillType", "ReleaseSkillType"] {
        let bench = bench(true).await;
        conformance::check(of, bench.driver(of), Vec::new)
            .await
            .unwrap_or_else(|why| panic!("{of}: {why}"));
    }
}

#[tokio::test]
async fn it_holds_a_part_from_grasp_to_release_and_says_the_vacuum_if_there_is_none() {
    let full = bench(true).await;
    assert_eq!(full.run("GraspSkillType").await, (true, String::new()));
    assert!(full.simulator.holds());
    assert_eq!(full.run("ReleaseSkillType").await, (true, String::new()));
    assert!(!full.simulator.holds());
    let empty = bench(false).await;
    let told = "no part is held after 600ms: the vacuum is 40 mbar, not in the range of control"
        .to_owned();
    assert_eq!(empty.run("GraspSkillType").await, (false, told));
}

#[tokio::test]
async fn silence_damaged_answers_and_a_gripper_without_power_are_told_and_do_not_last() {
    let bench = bench(true).await;
    let at = format!("http://{}", bench.serving.address());
    let none = SchmalzFaults::default();
    for (faults, told) in [
        (
            SchmalzFaults {
                silent: true,
                ..none
            },
            format!("no answer from {at} within 400 ms"),
        ),
        (
            SchmalzFaults {
                unplugged: true,
                ..none
            },
            format!("{at} refuses with 404 Not Found: IO-Link Device is not accessible"),
        ),
        (
            SchmalzFaults {
                broken: true,
                ..none
            },
            "the gripper says that it does not work properly".to_owned(),
        ),
    ] {
        bench.simulator.set_faults(faults);
        assert_eq!(bench.run("GraspSkillType").await, (false, told));
    }
    bench.simulator.set_faults(SchmalzFaults {
        damaged: true,
        ..none
    });
    let (_, told) = bench.run("GraspSkillType").await;
    assert!(
        told.starts_with(&format!("the answer of {at} is damaged: ")),
        "{told}"
    );
    bench.simulator.set_faults(none);
    assert!(bench.run("GraspSkillType").await.0);
    bench.simulator.reboot();
    assert!(bench.run("GraspSkillType").await.0);
}

#[tokio::test]
async fn its_values_follow_the_part_and_are_unknown_while_it_is_unplugged() {
    let bench = bench(true).await;
    let gripper: Arc<dyn Device> = Arc::new(SchmalzGripper::new(
        &bench.serving.address().to_string(),
        "master1port1",
        SchmalzTiming::default(),
    ));
    let values = crate::sensors::tests::measured(gripper);
    values
        .until("PartPresent", |value| *value == Ok(false.into()))
        .await;
    bench.run("GraspSkillType").await;
    values
        .until("PartPresent", |value| *value == Ok(true.into()))
        .await;
    values
        .until("Vacuum", |value| {
            value
                .as_ref()
                .is_ok_and(|mbar| mbar.as_f64().is_some_and(|mbar| mbar > 100.0))
        })
        .await;
    bench.simulator.set_faults(SchmalzFaults {
        unplugged: true,
        ..SchmalzFaults::default()
    });
    values.until("Vacuum", Result::is_err).await;
    bench.simulator.set_faults(SchmalzFaults::default());
    values
        .until("PartPresent", |value| *value == Ok(true.into()))
        .await;
}
