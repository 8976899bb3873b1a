use std::path::Path;
use std::sync::atomic::{AtomicUsize, Ordering};

use bridge_node::Executed;
use skills::server::{ComponentServer, ServeSettings};
use skills::{ClientOptions, Component, MirroredSkill, Mirrors, SkillClient, Watchable};

use super::*;

const GRIPPER: &str = include_str!("../../../../examples/plant/parallel-gripper.yaml");
const ID: GraphGoalId = [7; 16];

fn serve() -> ComponentServer {
    let component = Component::from_yaml(GRIPPER, Path::new(""))
        .unwrap_or_else(|findings| panic!("{}", findings.render("x", GRIPPER)));
    let settings = ServeSettings::default();
    let server = ComponentServer::build(&component, &settings, |_, _| Vec::new()).unwrap();
    server.start();
    server
}

fn own(server: &ComponentServer) -> SkillExecutor {
    SkillExecutor::Own(server.skills()[0].clone())
}

fn doer(skill: &SkillExecutor) -> Doer {
    Doer::new(skill.clone(), Reporter::new())
}

fn soon() -> std::time::Instant {
    now().monotonic + Duration::from_secs(60)
}

async fn rest(goal: &mut SentSkillGoal) -> Vec<GraphGoalEvent> {
    let all = async {
        let mut events = Vec::new();
        while let Some(event) = goal.recv().await {
            events.push(event);
        }
        events
    };
    let all = tokio::time::timeout(Duration::from_secs(20), all).await;
    all.unwrap()
}

/// Mirrors the first skill of a server, and waits until it shows this state.
async fn mirror(server: &ComponentServer) -> (Mirrors, MirroredSkill) {
    let options = ClientOptions {
        within: Duration::from_secs(10),
        ..ClientOptions::default()
    };
    let client = SkillClient::connect(server.url(), &options).await.unwrap();
    let watchable = Watchable::of(client).await.unwrap();
    let mirrors = Mirrors::begin(&watchable, 1, |_, _| Vec::new());
    let mirror = mirrors.skills()[0].clone();
    (mirrors, mirror)
}

/// Makes the skill ready, which is refused until the mirror knows its state.
async fn make_ready(mirror: &MirroredSkill) {
    let ready = async {
        while mirror.make_ready().await.is_err() {
            tokio::task::yield_now().await;
        }
    };
    let within = Duration::from_secs(20);
    tokio::time::timeout(within, ready).await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_goal_whose_start_is_lost_has_an_unknown_outcome() {
    let server = serve();
    let (mirrors, mirror) = mirror(&server).await;
    make_ready(&mirror).await;
    assert_eq!(mirror.shown().state, ProgramMachineState::Ready);
    drop(mirrors);
    let doer = doer(&SkillExecutor::Theirs(mirror));
    let mut goal = doer.send_goal(ID, &fields::block(&[]), soon());
    let events = rest(&mut goal).await;
    let [GraphGoalEvent::Lost { text, ran }] = events.as_slice() else {
        panic!("{events:?}");
    };
    assert_eq!(*ran, MayHaveRun::Perhaps);
    assert!(text.contains("the machine may move"), "{text}");
    assert!(lock(&doer.doing).beginning.is_empty());
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_call_whose_execution_is_lost_is_answered_as_lost_and_a_refused_one_with_the_reason() {
    let server = serve();
    let (mirrors, mirror) = mirror(&server).await;
    make_ready(&mirror).await;
    drop(mirrors);
    let skill = SkillExecutor::Theirs(mirror);
    let execute = async |method, is_wanted: bool| {
        let by = SkillOwner::Local("the test");
        let condition = Box::new(move || is_wanted);
        skill
            .execute((by, method), &fields::block(&[]), condition)
            .await
    };
    // The connection is closed: it is not known whether the request was executed.
    for method in [ProgramMethod::Start, ProgramMethod::Halt] {
        let executed = execute(method, true).await;
        assert!(matches!(executed, Executed::Lost), "{method}: {executed:?}");
    }
    let withdrawn = execute(ProgramMethod::Start, false).await;
    assert!(
        matches!(withdrawn, Executed::Answered(_)),
        "it was not sent: {withdrawn:?}"
    );
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_goal_whose_reset_is_lost_is_rejected() {
    let server = serve();
    let (mirrors, mirror) = mirror(&server).await;
    drop(mirrors);
    assert_eq!(mirror.shown().state, ProgramMachineState::Halted);
    let doer = doer(&SkillExecutor::Theirs(mirror));
    let mut goal = doer.send_goal(ID, &fields::block(&[]), soon());
    let events = rest(&mut goal).await;
    assert!(
        matches!(events.as_slice(), [GraphGoalEvent::Rejected(_)]),
        "{events:?}"
    );
    server.stop().await;
}

#[tokio::test]
async fn a_goal_whose_start_is_aborted_has_an_unknown_outcome() {
    let server = serve();
    let doer = doer(&own(&server));
    let mut goal = doer.send_goal(ID, &fields::block(&[]), soon());
    let Stage::Begins(begun) = &goal.stage else {
        panic!("{:?}", goal.stage);
    };
    begun.abort();
    let events = rest(&mut goal).await;
    let [GraphGoalEvent::Lost { ran, .. }] = events.as_slice() else {
        panic!("{events:?}");
    };
    assert_eq!(*ran, MayHaveRun::Perhaps);
    assert!(lock(&doer.doing).beginning.is_empty());
    server.stop().await;
}

#[tokio::test]
async fn a_goal_that_is_cancelled_before_its_start_is_canceled_and_starts_no_run() {
    let server = serve();
    let skill = own(&server);
    let doer = doer(&skill);
    let mut goal = doer.send_goal(ID, &fields::block(&[]), soon());
    let answer = doer.cancel(GraphCancelSelection::Goal(ID)).await.unwrap();
    assert_eq!((answer.code, answer.goals), (NONE, vec![ID]));
    let events = rest(&mut goal).await;
    let [
        GraphGoalEvent::Accepted(_),
        GraphGoalEvent::Status(CANCELING),
        GraphGoalEvent::Ended { status, .. },
    ] = events.as_slice()
    else {
        panic!("{events:?}");
    };
    assert_eq!(*status, CANCELED);
    let shown = skill.shown();
    assert_eq!((shown.state, shown.run), (ProgramMachineState::Halted, 0));
    server.stop().await;
}

#[tokio::test]
async fn a_goal_that_is_cancelled_during_the_reset_starts_no_run() {
    let server = serve();
    let skill = own(&server);
    let checks = Arc::new(AtomicUsize::new(0));
    let condition = {
        let checks = Arc::clone(&checks);
        Arc::new(move || checks.fetch_add(1, Ordering::Relaxed) == 0)
    };
    let begun = begin(&skill, &fields::block(&[]), condition).await;
    let Err(BeginFault::NotStarted(_)) = &begun else {
        panic!("{begun:?}");
    };
    // The skill was reset between the two checks.
    let shown = skill.shown();
    assert_eq!((shown.state, shown.run), (ProgramMachineState::Ready, 0));
    assert_eq!(checks.load(Ordering::Relaxed), 2);
    let doing = Mutex::default();
    let start = settle(&skill, &doing, (begun, true)).await;
    assert!(matches!(start, GoalStart::Cancelled), "{start:?}");
    let begun = begin(&skill, &fields::block(&[]), Arc::new(|| true)).await;
    assert!(matches!(begun, Ok(1)), "{begun:?}");
    server.stop().await;
}

#[tokio::test]
async fn a_run_of_a_cancelled_goal_that_is_not_halted_is_followed() {
    let server = serve();
    let skill = own(&server);
    let doer = doer(&skill);
    let mut goal = doer.send_goal(ID, &fields::block(&[]), soon());
    // The skill is Halted, so it refuses the Halt.
    lock(&doer.doing).current = Some(Current {
        id: ID,
        run: 5,
        cancelled: true,
    });
    let start = settle(&skill, &doer.doing, (Ok(5), true)).await;
    assert!(matches!(start, GoalStart::NotHalted(5)), "{start:?}");
    assert!(!goal.is_cancelled(5));
    goal.begun(start);
    assert!(matches!(goal.stage, Stage::Runs(5)), "{:?}", goal.stage);
    let events: Vec<GraphGoalEvent> = goal.events.drain(..).collect();
    let [
        GraphGoalEvent::Accepted(_),
        GraphGoalEvent::Status(EXECUTING),
        GraphGoalEvent::CancelRefused,
    ] = events.as_slice()
    else {
        panic!("{events:?}");
    };
    server.stop().await;
}

#[tokio::test]
async fn a_cancelled_goal_whose_start_is_lost_halts_the_skill() {
    let server = serve();
    let skill = own(&server);
    let begun = begin(&skill, &fields::block(&[]), Arc::new(|| true)).await;
    assert!(matches!(begun, Ok(1)), "{begun:?}");
    let lost = skills::SkillFault::Lost("no answer".to_owned());
    let lost = Err(BeginFault::Unknown(SkillRequestError::Theirs(lost)));
    let start = settle(&skill, &Mutex::default(), (lost, true)).await;
    let GoalStart::Unknown(text) = &start else {
        panic!("{start:?}");
    };
    assert!(text.contains("the skill was halted"), "{text}");
    assert_eq!(skill.shown().state, ProgramMachineState::Halted);
    server.stop().await;
}
