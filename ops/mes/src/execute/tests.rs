mod compensation;
mod composite;
mod fakes;
mod flow;
mod loops;
mod losses;
mod queries;
mod stops;
mod tools;
mod unknown;

use std::collections::VecDeque;
use std::sync::atomic::AtomicU64;

use knowledge::{Knowledge, KnowledgeSource, SourceKind, ValueQueryFault};
use skills::{ParameterType, RunOutcome, SkillFault, SkillValue};

use self::fakes::{Fakes, failed, unconfirmed};
use super::*;
use crate::plan::ShownTools;
use crate::process::{By, GivenParameter, Need, ParameterQuery, ProcessStep, ResultOf};

fn offer(component: &str, name: &str, of: &str) -> Offer {
    Offer {
        is_skill: true,
        component: format!("urn:example:{component}"),
        skill: format!("urn:example:{component}#{name}"),
        component_name: component.into(),
        name: name.into(),
        types: vec![ParameterType::own(of).to_string()],
        capabilities: vec![],
        closure: vec![],
        endpoint: String::new(),
        node: String::new(),
        since_ms: 1,
    }
}

fn gripper(name: &str) -> Vec<Offer> {
    vec![
        offer(name, "Grasp", "GraspSkillType"),
        offer(name, "Release", "ReleaseSkillType"),
    ]
}

/// The component of the skills of `gripper("gripper")`.
const GRIPPER: &str = "urn:example:gripper";

fn plant(offers: Vec<Offer>) -> Fakes {
    let robot = [
        offer("robot", "Ptp", "PtpMoveSkillType"),
        offer("robot", "Lin", "LinearMoveSkillType"),
    ];
    Fakes {
        offers: Mutex::new(robot.into_iter().chain(offers).collect()),
        changed: watch::channel(0).0,
        lost: watch::channel(vec![]).0,
        dies_at: Mutex::new(None),
        fails_at: None,
        ends: None,
        halted_at: Mutex::new(None),
        halts: watch::channel(0).0,
        unreachable: None,
        silent_tools: None,
        meets: None,
        found: Mutex::default(),
        silent_queries: watch::channel(0).0,
        journal: Mutex::default(),
        kept: Mutex::default(),
        clock: AtomicU64::new(1000),
        leases: Mutex::default(),
        spare: Mutex::default(),
        powers: None,
        tools: ShownTools::default(),
        mover: None,
        mishaps: Mutex::default(),
    }
}

fn process() -> Process {
    let need = |role: SkillRole| Need {
        role,
        capability: None,
        skill_type: role.skill_type(),
    };
    let step = |name: &str, last| ProcessStep {
        name: name.into(),
        needs: [SkillRole::Ptp, SkillRole::Linear, last].map(need).into(),
        ..ProcessStep::default()
    };
    Process {
        iri: "urn:example:process:move-part".into(),
        name: "Move a part".into(),
        work: StepJob::PickAndPlace(skills::Job {
            pick: [0.0; 6],
            place: [1.0; 6],
            approach: 0.05,
            shape: None,
        }),
        steps: vec![
            step("pick", SkillRole::Grasp),
            step("place", SkillRole::Release),
        ],
        loops: vec![],
        within: Duration::from_secs(5),
        wait: Duration::from_millis(300),
    }
}

async fn executed(fakes: Fakes, process: &Process) -> (ProcessRun, Arc<Fakes>, Vec<&'static str>) {
    let fakes = Arc::new(fakes);
    let steps = Mutex::new(Vec::new());
    let plant: Arc<dyn Plant> = Arc::new(Arc::clone(&fakes));
    let teller = |step: &'static str| steps.lock().unwrap().push(step);
    let run = tokio::time::timeout(
        Duration::from_secs(20),
        execute(&plant, process, 1, &teller),
    )
    .await
    .unwrap();
    let told = steps.into_inner().unwrap();
    (run, fakes, told)
}

/// A process that grasps and releases.
fn grasps() -> Process {
    let alone = |step: usize, of: &str| ProcessStep {
        name: format!("step {step}"),
        needs: vec![Need {
            role: SkillRole::Alone(step),
            capability: None,
            skill_type: Some(ParameterType::own(of)),
        }],
        ..ProcessStep::default()
    };
    Process {
        steps: vec![alone(0, "GraspSkillType"), alone(1, "ReleaseSkillType")],
        work: StepJob::Sequence,
        ..process()
    }
}

#[tokio::test]
async fn a_sequence_gives_each_step_what_it_needs_and_never_does_one_twice() {
    let mut process = grasps();
    process.steps[0].parameters.push(GivenParameter {
        name: "Force".into(),
        value: 12.into(),
        unit: None,
        result: None,
        query: None,
    });
    let (run, fakes, _) = executed(plant(gripper("gripper")), &process).await;
    assert_eq!(run.outcome, How::Done, "{run:?}");
    assert_eq!(
        *fakes.journal.lock().unwrap(),
        ["gripper.Grasp 1", "gripper.Release", "closed"]
    );
    let mut fakes = plant([gripper("gripper"), gripper("other")].concat());
    fakes.fails_at = Some("gripper.Release");
    let (run, ..) = executed(fakes, &process).await;
    assert_eq!((run.outcome, run.plans.len()), (How::Failed, 1));
    assert!(
        run.reason
            .unwrap()
            .contains("step 1: gripper.Release nothing was gripped")
    );
}

#[tokio::test]
async fn a_run_that_is_given_up_does_not_go_on_in_the_records() {
    let fakes = plant(gripper("gripper"));
    *fakes.dies_at.lock().unwrap() = Some("gripper.Grasp");
    let fakes = Arc::new(fakes);
    let as_plant: Arc<dyn Plant> = Arc::new(Arc::clone(&fakes));
    let slow = Process {
        wait: Duration::from_secs(600),
        ..process()
    };
    let told = |_: &'static str| {};
    let run = execute(&as_plant, &slow, 1, &told);
    let given_up = tokio::time::timeout(Duration::from_millis(200), run).await;
    assert!(given_up.is_err());
    let kept = fakes.kept.lock().unwrap();
    let run = kept.last().unwrap();
    assert_eq!(
        (run.outcome, run.reason.as_deref()),
        (How::Failed, Some("it was given up in the middle"))
    );
    assert!(run.ended_ms.is_some() && run.waits_for.is_none());
}

#[tokio::test]
async fn what_became_of_a_run_can_be_asked_for() {
    let fakes = plant(gripper("gripper"));
    *fakes.dies_at.lock().unwrap() = Some("gripper.Grasp");
    *fakes.spare.lock().unwrap() = gripper("vacuum");
    let (run, ..) = executed(fakes, &process()).await;
    let knowledge = Knowledge::new().unwrap();
    knowledge
        .replace(
            &KnowledgeSource::new(SourceKind::Run, &run.run),
            &run.triples(),
            1,
        )
        .unwrap();
    knowledge
        .replace(
            &KnowledgeSource::new(SourceKind::Process, "p"),
            &process().triples(&|_| None),
            1,
        )
        .unwrap();
    let runs = knowledge.ask("runs", &[]).unwrap();
    assert_eq!(
        (&runs.rows[0]["outcome"], &runs.rows[0]["plans"]),
        (&"done".into(), &2.into())
    );
    let steps = knowledge
        .ask("run-steps", &[("run".into(), run.run.clone())])
        .unwrap();
    assert_eq!(steps.rows.len(), 12);
    let values = knowledge
        .ask("run-values", &[("run".into(), run.run)])
        .unwrap();
    let of = |kind: &str| {
        let rows = values.rows.iter().filter(|row| row["use"] == kind);
        let shown = rows.map(|row| (row["skill"].clone(), row["value"].clone()));
        shown.collect::<Vec<_>>()
    };
    let width = ("urn:example:vacuum#Grasp".into(), 0.03.into());
    assert_eq!(of("result"), [width]);
    assert_eq!(of("parameter").len(), 9, "one of each movement: {values:?}");
    let mut quads = Vec::new();
    knowledge.write_quads(None, &mut quads).unwrap();
    let quads = String::from_utf8(quads).unwrap();
    let count = |predicate: &str| quads.matches(&format!("/ns/prov#{predicate}>")).count();
    assert_eq!(count("wasInformedBy"), 11);
    assert_eq!(count("hadPlan"), 12);
    let lost: Vec<_> = steps
        .rows
        .iter()
        .filter(|row| row["outcome"] == "lost")
        .map(|row| &row["skill"])
        .collect();
    assert_eq!(lost, ["urn:example:gripper#Grasp"]);
    assert_eq!(knowledge.ask("processes", &[]).unwrap().rows.len(), 6);
}

/// A step of a sequence that a skill of a type does.
fn alone(number: usize, name: &str, of: &str) -> ProcessStep {
    ProcessStep {
        name: name.into(),
        needs: vec![Need {
            role: SkillRole::Alone(number),
            capability: None,
            skill_type: Some(ParameterType::own(of)),
        }],
        ..ProcessStep::default()
    }
}

/// The compensation of a step, by the same component.
fn undone_by(of: usize, of_all: usize, skill_type: &str) -> Option<Box<ProcessStep>> {
    let step = alone(of_all + of, &format!("compensation {of}"), skill_type);
    Some(Box::new(ProcessStep {
        by: By::SameAs(of),
        ..step
    }))
}

/// A process that grasps, moves and drills; the first two steps can be undone.
fn drills() -> Process {
    let mut steps = vec![
        alone(0, "grip", "GraspSkillType"),
        alone(1, "move", "LinearMoveSkillType"),
        alone(2, "drill", "DrillSkillType"),
    ];
    steps[0].compensation = undone_by(0, 3, "ReleaseSkillType");
    steps[1].compensation = undone_by(1, 3, "PtpMoveSkillType");
    Process { steps, ..grasps() }
}

fn drilling(names: &[&str]) -> Fakes {
    let drills = names
        .iter()
        .map(|name| offer(name, "Drill", "DrillSkillType"));
    plant(gripper("gripper").into_iter().chain(drills).collect())
}

#[tokio::test]
async fn a_failed_step_is_planned_anew_and_completed_steps_are_not_repeated() {
    let mut fakes = drilling(&["a-drill", "b-drill"]);
    fakes.fails_at = Some("a-drill.Drill");
    let (run, fakes, _) = executed(fakes, &drills()).await;
    assert_eq!((run.outcome, run.plans.len()), (How::Done, 2), "{run:?}");
    let journal = [
        "gripper.Grasp",
        "robot.Lin",
        "a-drill.Drill",
        "closed",
        "b-drill.Drill",
        "closed",
    ];
    assert_eq!(*fakes.journal.lock().unwrap(), journal);
    // The component of a step that has not begun is lost: nothing can go on.
    let fakes = drilling(&["a-drill", "b-drill"]);
    fakes
        .lost
        .send_modify(|lost| lost.push("urn:example:a-drill".into()));
    let (run, fakes, _) = executed(fakes, &drills()).await;
    assert_eq!((run.outcome, run.plans.len()), (How::Done, 2), "{run:?}");
    assert!(
        !fakes
            .journal
            .lock()
            .unwrap()
            .contains(&"a-drill.Drill".to_owned())
    );
}

#[tokio::test]
async fn a_result_of_a_step_is_a_parameter_of_a_later_step() {
    let mut process = drills();
    process.steps[2].parameters = vec![GivenParameter {
        name: "Depth".into(),
        value: serde_json::Value::Null,
        unit: None,
        result: Some(ResultOf {
            step: 0,
            name: "Width".into(),
        }),
        query: None,
    }];
    let (run, ..) = executed(drilling(&["drill"]), &process).await;
    assert_eq!(run.outcome, How::Done, "{run:?}");
    let drill = run.plans[0].ran.last().unwrap();
    assert_eq!(drill.parameters["Depth"], 0.03);
    // A skill that breaks its description gives no value: the run fails and is compensated.
    process.steps[2].parameters[0].result = Some(ResultOf {
        step: 1,
        name: "Width".into(),
    });
    let (run, ..) = executed(drilling(&["drill"]), &process).await;
    let reason = run.reason.unwrap();
    let said = reason.contains("drill: Depth: Lin returned no result Width");
    assert!(
        said && reason.ends_with("compensated: `move`, `grip`"),
        "{reason}"
    );
}

#[tokio::test]
async fn two_processes_run_at_a_time_and_the_second_waits_for_a_component_in_use() {
    let fakes = Arc::new(drilling(&["drill"]));
    let as_plant: Arc<dyn Plant> = Arc::new(Arc::clone(&fakes));
    let other = "urn:run:other".to_owned();
    fakes
        .leases
        .lock()
        .unwrap()
        .insert("urn:example:drill".to_owned(), other);
    let told = |_: &'static str| {};
    let process = Process {
        wait: Duration::from_secs(10),
        ..drills()
    };
    let run = execute(&as_plant, &process, 1, &told);
    let free = async {
        let waits = || {
            let kept = fakes.kept.lock().unwrap();
            kept.last().and_then(|run| run.waits_for.clone())
        };
        let waits_for = loop {
            match waits() {
                Some(waits_for) => break waits_for,
                None => tokio::task::yield_now().await,
            }
        };
        assert!(
            waits_for.contains("the run urn:run:other uses its component"),
            "{waits_for}"
        );
        assert!(fakes.journal.lock().unwrap().is_empty());
        Plant::lease(&fakes, "urn:run:other", &BTreeSet::new());
    };
    let (run, ()) = tokio::join!(run, free);
    assert_eq!(run.outcome, How::Done, "{run:?}");
    assert!(fakes.leases.lock().unwrap().is_empty());
}
