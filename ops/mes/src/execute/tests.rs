mod compensation;
mod composite;
mod flow;
mod loops;
mod queries;
mod stops;
mod tools;
mod unknown;

use std::collections::VecDeque;
use std::sync::atomic::{AtomicU64, Ordering};

use knowledge::{Knowledge, KnowledgeSource, SourceKind};
use skills::{ParameterType, RunOutcome, SkillFault};

use super::*;
use crate::process::{By, GivenParameter, Need, ProcessStep, ResultOf};

/// A plant for tests. Its skills do nothing and record their runs.
struct Fakes {
    offers: Mutex<Vec<Offer>>,
    changed: watch::Sender<u64>,
    lost: watch::Sender<Vec<String>>,
    /// The skill that loses its component when it is run.
    dies_at: Mutex<Option<&'static str>>,
    fails_at: Option<&'static str>,
    /// A skill and how its run ends; `None` if it does not end.
    ends: Option<(&'static str, Option<Result<RunOutcome, SkillFault>>)>,
    /// A skill that runs until it is halted, because the gripper is lost meanwhile.
    halted_at: Mutex<Option<&'static str>>,
    halts: watch::Sender<u32>,
    unreachable: Option<&'static str>,
    /// Counts the reads of the tool changers, which do not respond; `None` if they do.
    silent_tools: Option<watch::Sender<u32>>,
    /// Skills named `Meet` wait for each other here.
    meets: Option<Arc<tokio::sync::Barrier>>,
    /// The results of the evaluations of queries, in their order.
    found: Mutex<VecDeque<Result<serde_json::Value, ValueQueryFault>>>,
    /// Counts the evaluations after these, which do not end.
    silent_queries: watch::Sender<u32>,
    journal: Mutex<Vec<String>>,
    kept: Mutex<Vec<ProcessRun>>,
    clock: AtomicU64,
    leases: Mutex<BTreeMap<String, String>>,
    /// Appears when a component is lost.
    spare: Mutex<Vec<Offer>>,
    /// A skill, and the offers that appear when it is run.
    powers: Option<(&'static str, Vec<Offer>)>,
    tools: ShownTools,
}

struct FakeSkill {
    plant: Arc<Fakes>,
    offer: Offer,
}

#[async_trait]
impl Plant for Arc<Fakes> {
    fn offers(&self) -> Vec<Offer> {
        self.offers.lock().unwrap().clone()
    }

    fn changes(&self) -> watch::Receiver<u64> {
        self.changed.subscribe()
    }

    async fn open(&self, offers: &[Offer]) -> Result<Box<dyn Opened>, OpenFault> {
        if let Some(offer) = offers
            .iter()
            .find(|offer| Some(offer.component_name.as_str()) == self.unreachable)
        {
            return Err(OpenFault {
                component: offer.component.clone(),
                why: "no route".into(),
            });
        }
        let skill = |offer: &Offer| {
            Arc::new(FakeSkill {
                plant: Self::clone(self),
                offer: offer.clone(),
            }) as Arc<dyn RunnableSkill>
        };
        Ok(Box::new(FakeOpened(
            offers.iter().map(skill).collect(),
            Self::clone(self),
        )))
    }

    fn values(
        &self,
        _skill: &str,
        given: &[GivenParameter],
    ) -> Result<Vec<(String, SkillValue)>, ParameterFault> {
        given
            .iter()
            .filter(|given| given.result.is_none())
            .filter(|given| given.query.is_none() || !given.value.is_null())
            .map(|given| {
                let value = match given.value.as_str() {
                    Some(text) => SkillValue::String(text.to_owned()),
                    None => SkillValue::Double(given.value.as_f64().unwrap()),
                };
                Ok((given.name.clone(), value))
            })
            .collect()
    }

    async fn query(&self, _query: &ParameterQuery) -> Result<serde_json::Value, ValueQueryFault> {
        let found = self.found.lock().unwrap().pop_front();
        match found {
            Some(found) => found,
            None => {
                self.silent_queries.send_modify(|queries| *queries += 1);
                std::future::pending().await
            }
        }
    }

    fn result(&self, skill: &str, name: &str) -> Result<Option<String>, ParameterFault> {
        match name {
            "Width" | "Tool" => Ok(None),
            other => Err(ParameterFault::Unknown {
                skill: skill.to_owned(),
                kind: "result",
                name: other.to_owned(),
                known: vec!["Width".to_owned()],
            }),
        }
    }

    fn connects(&self, _from: (&str, &str), _to: (&str, &str)) -> Result<(), ParameterFault> {
        Ok(())
    }

    async fn read_tools(&self) {
        if let Some(reads) = &self.silent_tools {
            reads.send_modify(|reads| *reads += 1);
            std::future::pending().await
        }
    }

    fn tools(&self) -> ShownTools {
        self.tools.clone()
    }

    fn used_by_others(&self, run: &str) -> BTreeMap<String, String> {
        let mut leases = self.leases.lock().unwrap().clone();
        leases.retain(|_, holder| holder != run);
        leases
    }

    fn lease(&self, run: &str, components: &BTreeSet<String>) -> bool {
        let mut leases = self.leases.lock().unwrap();
        let is_used = |component| leases.get(component).is_some_and(|holder| holder != run);
        if components.iter().any(is_used) {
            return false;
        }
        leases.retain(|_, holder| holder != run);
        let taken = components.iter().map(|one| (one.clone(), run.to_owned()));
        leases.extend(taken);
        self.changed.send_modify(|changes| *changes += 1);
        true
    }

    fn keep(&self, run: &ProcessRun) {
        self.kept.lock().unwrap().push(run.clone());
    }

    fn now(&self) -> u64 {
        self.clock.fetch_add(1, Ordering::Relaxed)
    }
}

struct FakeOpened(Vec<Arc<dyn RunnableSkill>>, Arc<Fakes>);

#[async_trait]
impl Opened for FakeOpened {
    fn skills(&self) -> Vec<Arc<dyn RunnableSkill>> {
        self.0.clone()
    }

    async fn close(self: Box<Self>) {
        self.1.journal.lock().unwrap().push("closed".into());
    }
}

impl FakeSkill {
    /// Returns the results of a run: `Count` has its number.
    fn results(&self, name: &str) -> Vec<(String, SkillValue)> {
        let journal = self.plant.journal.lock().unwrap();
        let runs = journal.iter().filter(|told| **told == name).count();
        let runs = SkillValue::Double(f64::from(u32::try_from(runs).unwrap()));
        match name.rsplit('.').next() {
            Some("Grasp") => vec![("Width".to_owned(), SkillValue::Double(0.03))],
            Some("Count") => vec![("Runs".to_owned(), runs)],
            Some("Find" | "Swap") => vec![("Tool".to_owned(), "urn:example:other".into())],
            _ => vec![],
        }
    }
}

#[async_trait]
impl RunnableSkill for FakeSkill {
    fn name(&self) -> String {
        format!("{}.{}", self.offer.component_name, self.offer.name)
    }

    async fn run(
        &self,
        parameters: Vec<(String, SkillValue)>,
        _within: Duration,
    ) -> Result<RunOutcome, SkillFault> {
        let name = self.name();
        let told = if parameters.is_empty() {
            name.clone()
        } else {
            format!("{name} {}", parameters.len())
        };
        self.plant.journal.lock().unwrap().push(told);
        if let Some((_, more)) = self.plant.powers.as_ref().filter(|(at, _)| *at == name) {
            let mut offers = self.plant.offers.lock().unwrap();
            offers.extend(more.iter().cloned());
        }
        if let Some(meets) = self
            .plant
            .meets
            .as_ref()
            .filter(|_| name.ends_with(".Meet"))
        {
            let mut halts = self.plant.halts.subscribe();
            tokio::select! {
                _ = meets.wait() => {}
                _ = halts.wait_for(|halts| *halts > 0) => {
                    return Ok(failed("halted by session 3"));
                }
            }
        }
        let dies = self
            .plant
            .dies_at
            .lock()
            .unwrap()
            .take_if(|at| *at == name)
            .is_some();
        if dies {
            self.plant
                .offers
                .lock()
                .unwrap()
                .retain(|offer| offer.component != self.offer.component);
            self.plant
                .lost
                .send_modify(|lost| lost.push(self.offer.component.clone()));
            std::future::pending::<()>().await;
        }
        let is_halted = self
            .plant
            .halted_at
            .lock()
            .unwrap()
            .take_if(|at| *at == name)
            .is_some();
        if is_halted {
            self.plant
                .offers
                .lock()
                .unwrap()
                .retain(|offer| offer.component != GRIPPER);
            self.plant
                .lost
                .send_modify(|lost| lost.push(GRIPPER.to_owned()));
            let mut halts = self.plant.halts.subscribe();
            halts.wait_for(|halts| *halts > 0).await.unwrap();
            return Ok(failed("halted by session 3"));
        }
        if self.plant.fails_at == Some(&*name) {
            return Ok(failed("nothing was gripped"));
        }
        if let Some((_, end)) = self.plant.ends.as_ref().filter(|(at, _)| *at == name) {
            return match end {
                Some(end) => end.clone(),
                None => std::future::pending().await,
            };
        }
        Ok(RunOutcome {
            run: 1,
            succeeded: true,
            unknown: false,
            message: String::new(),
            results: self.results(&name),
            trace: vec![],
        })
    }

    async fn halt(&self) -> Result<(), SkillFault> {
        self.plant.halts.send_modify(|halts| *halts += 1);
        Ok(())
    }

    async fn lost(&self) -> String {
        let mut lost = self.plant.lost.subscribe();
        let is_lost = lost
            .wait_for(|lost| lost.contains(&self.offer.component))
            .await
            .is_ok();
        assert!(is_lost, "the plant of the test is gone");
        let spare: Vec<_> = self.plant.spare.lock().unwrap().drain(..).collect();
        if !spare.is_empty() {
            let plant = Arc::clone(&self.plant);
            // Connected a little later, while the process waits.
            tokio::spawn(async move {
                tokio::time::sleep(Duration::from_millis(50)).await;
                plant.offers.lock().unwrap().extend(spare);
                plant.changed.send_modify(|changes| *changes += 1);
            });
        }
        "the connection broke".into()
    }
}

fn failed(message: &str) -> RunOutcome {
    RunOutcome {
        run: 1,
        succeeded: false,
        unknown: false,
        message: message.into(),
        results: vec![],
        trace: vec![],
    }
}

/// Returns an outcome whose end is unknown.
fn unconfirmed(message: &str) -> RunOutcome {
    RunOutcome {
        unknown: true,
        ..failed(message)
    }
}

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
