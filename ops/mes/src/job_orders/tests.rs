use std::sync::Mutex;

use plant_opcua::job_control::{OptionalArray, Parameter, WorkMaster};

use super::*;

/// Jobs whose outcomes the test sets.
#[derive(Default)]
struct Fakes {
    outcome: Mutex<Option<JobOutcome>>,
    is_busy: Mutex<bool>,
    is_paused: Mutex<bool>,
    calls: Mutex<Vec<String>>,
}

impl JobRuns for Fakes {
    fn is_process(&self, process: &str) -> bool {
        process == "urn:p"
    }

    fn start(&self, process: &str) -> Result<Option<u64>, String> {
        if *self.is_busy.lock().unwrap() {
            return Ok(None);
        }
        self.calls.lock().unwrap().push(format!("start {process}"));
        *self.outcome.lock().unwrap() = Some(JobOutcome::Running);
        Ok(Some(7))
    }

    fn stop(&self, job: u64) {
        self.calls.lock().unwrap().push(format!("stop {job}"));
    }

    fn pause(&self, job: u64, is_paused: bool) -> bool {
        let call = if is_paused { "pause" } else { "resume" };
        self.calls.lock().unwrap().push(format!("{call} {job}"));
        *self.is_paused.lock().unwrap() = is_paused;
        true
    }

    fn progress(&self, _job: u64) -> Option<JobProgress> {
        Some(JobProgress {
            is_paused: *self.is_paused.lock().unwrap(),
            outcome: (*self.outcome.lock().unwrap())?,
            reason: None,
            started_ms: 1,
            ended_ms: None,
            results: Vec::new(),
        })
    }
}

fn job_order(id: &str, process: &str) -> JobOrder {
    let master = WorkMaster {
        id: process.into(),
        ..WorkMaster::default()
    };
    JobOrder {
        id: id.into(),
        work_masters: Some(OptionalArray(vec![master])),
        ..JobOrder::default()
    }
}

fn state(orders: &Orders) -> OrderState {
    orders.order("one").unwrap().state
}

#[test]
fn commands_follow_the_states() {
    let runs = Fakes::default();
    let mut orders = Orders::default();
    assert_eq!(
        orders.store(job_order("one", "urn:p"), &runs),
        CommandStatus::Good
    );
    assert_eq!(
        orders.store(job_order("one", "urn:p"), &runs),
        CommandStatus::UnableToAccept
    );
    assert_eq!(
        orders.store(job_order("two", "urn:q"), &runs),
        CommandStatus::UnableToAccept
    );
    assert_eq!(
        orders.store(job_order("", "urn:p"), &runs),
        CommandStatus::InvalidRequest
    );
    assert_eq!(
        orders.command("two", JobCommand::Start, &runs),
        CommandStatus::UnknownOrder
    );
    for command in [
        JobCommand::Stop,
        JobCommand::Clear,
        JobCommand::RevokeStart,
        JobCommand::Pause,
    ] {
        assert_eq!(
            orders.command("one", command, &runs),
            CommandStatus::InvalidState
        );
    }
    assert_eq!(
        orders.command("one", JobCommand::Start, &runs),
        CommandStatus::Good
    );
    assert_eq!(state(&orders), OrderState::Running);
    for command in [JobCommand::Start, JobCommand::Cancel, JobCommand::Clear] {
        assert_eq!(
            orders.command("one", command, &runs),
            CommandStatus::InvalidState
        );
    }
    *runs.outcome.lock().unwrap() = Some(JobOutcome::Done);
    assert!(orders.poll(&runs));
    assert_eq!(state(&orders), OrderState::Ended);
    assert_eq!(
        orders.command("one", JobCommand::Clear, &runs),
        CommandStatus::Good
    );
    assert!(orders.all().is_empty());
    assert_eq!(
        *runs.calls.lock().unwrap(),
        ["start urn:p"],
        "it was started once"
    );
}

#[test]
fn a_pause_is_seen_when_no_skill_runs_and_ends_with_resume() {
    let runs = Fakes::default();
    let mut orders = Orders::default();
    orders.store(job_order("one", "urn:p"), &runs);
    assert_eq!(
        orders.command("one", JobCommand::Resume, &runs),
        CommandStatus::InvalidState
    );
    orders.command("one", JobCommand::Start, &runs);
    assert_eq!(
        orders.command("one", JobCommand::Pause, &runs),
        CommandStatus::Good
    );
    assert_eq!(state(&orders).number(), 4);
    assert_eq!(
        orders.command("one", JobCommand::Pause, &runs),
        CommandStatus::InvalidState
    );
    assert_eq!(
        orders.command("one", JobCommand::Resume, &runs),
        CommandStatus::Good
    );
    assert_eq!(state(&orders), OrderState::Running);
    orders.command("one", JobCommand::Pause, &runs);
    assert_eq!(
        orders.command("one", JobCommand::Stop, &runs),
        CommandStatus::Good
    );
    *runs.outcome.lock().unwrap() = Some(JobOutcome::Failed);
    orders.poll(&runs);
    assert_eq!(state(&orders), OrderState::Ended);
    let calls = ["start urn:p", "pause 7", "resume 7", "pause 7", "stop 7"];
    assert_eq!(*runs.calls.lock().unwrap(), calls);
}

#[test]
fn after_a_restart_nothing_starts_and_what_may_have_run_is_unknown() {
    let folder = std::env::temp_dir().join(format!("job-orders-{}", std::process::id()));
    std::fs::create_dir_all(&folder).unwrap();
    let open = || Orders::of_file(OrderFile::open(&folder).unwrap());
    let runs = Fakes::default();
    let mut orders = open();
    for id in ["one", "stored", "done", "waits", "gone"] {
        assert_eq!(
            orders.store(job_order(id, "urn:p"), &runs),
            CommandStatus::Good
        );
    }
    orders.command("done", JobCommand::Start, &runs);
    *runs.outcome.lock().unwrap() = Some(JobOutcome::Done);
    orders.poll(&runs);
    orders.command("one", JobCommand::Start, &runs);
    *runs.is_busy.lock().unwrap() = true;
    orders.command("waits", JobCommand::Start, &runs);
    orders.command("gone", JobCommand::Cancel, &runs);
    drop(orders);
    *runs.is_busy.lock().unwrap() = false;
    runs.calls.lock().unwrap().clear();
    let mut orders = open();
    assert!(!orders.poll(&runs));
    let states = orders.all().iter().map(|order| (order.id(), order.state));
    let states: Vec<_> = states.collect();
    let expected = [
        ("one", OrderState::Interrupted),
        ("stored", OrderState::NotAllowedToStart),
        ("done", OrderState::Ended),
        ("waits", OrderState::Interrupted),
    ];
    assert_eq!(states, expected);
    let done = orders.order("done").unwrap();
    assert!(done.progress.is_some() && done.order == job_order("done", "urn:p"));
    assert_eq!(
        orders.command("one", JobCommand::Resume, &runs),
        CommandStatus::UnableToAccept
    );
    assert_eq!(
        orders.command("one", JobCommand::Abort, &runs),
        CommandStatus::Good
    );
    assert!(runs.calls.lock().unwrap().is_empty(), "nothing was started");
    drop(orders);
    assert_eq!(open().order("one").unwrap().state, OrderState::Aborted);
    std::fs::remove_dir_all(&folder).unwrap();
}

#[test]
fn a_start_that_is_revoked_is_never_executed() {
    let runs = Fakes::default();
    *runs.is_busy.lock().unwrap() = true;
    let mut orders = Orders::default();
    orders.store(job_order("one", "urn:p"), &runs);
    assert_eq!(
        orders.command("one", JobCommand::Start, &runs),
        CommandStatus::Good
    );
    assert_eq!(state(&orders), OrderState::AllowedToStart);
    assert_eq!(
        orders.command("one", JobCommand::RevokeStart, &runs),
        CommandStatus::Good
    );
    *runs.is_busy.lock().unwrap() = false;
    orders.poll(&runs);
    assert_eq!(state(&orders), OrderState::NotAllowedToStart);
    assert!(runs.calls.lock().unwrap().is_empty());
}

#[test]
fn a_stop_ends_the_order_only_when_the_end_is_confirmed() {
    for (command, end) in [
        (JobCommand::Stop, OrderState::Ended),
        (JobCommand::Abort, OrderState::Aborted),
    ] {
        let runs = Fakes::default();
        let mut orders = Orders::default();
        orders.store(job_order("one", "urn:p"), &runs);
        orders.command("one", JobCommand::Start, &runs);
        assert_eq!(orders.command("one", command, &runs), CommandStatus::Good);
        assert_eq!(state(&orders), OrderState::Running, "it still runs");
        *runs.outcome.lock().unwrap() = Some(JobOutcome::Unknown);
        orders.poll(&runs);
        assert_eq!(state(&orders), OrderState::Interrupted);
        assert_eq!(
            orders.command("one", JobCommand::Resume, &runs),
            CommandStatus::UnableToAccept
        );
        assert_eq!(orders.command("one", command, &runs), CommandStatus::Good);
        assert_eq!(state(&orders), end);
        assert_eq!(
            *runs.calls.lock().unwrap(),
            ["start urn:p", "stop 7", "stop 7"]
        );
    }
}

#[test]
fn a_stop_of_a_run_gives_back_no_components_after_an_end_that_was_not_shown() {
    for (outcome, shown) in [
        (JobOutcome::Unknown, OrderState::Interrupted),
        (JobOutcome::Done, OrderState::Ended),
        (JobOutcome::Failed, OrderState::Aborted),
    ] {
        let runs = Fakes::default();
        let mut orders = Orders::default();
        orders.store(job_order("one", "urn:p"), &runs);
        orders.command("one", JobCommand::Start, &runs);
        *runs.outcome.lock().unwrap() = Some(outcome);
        assert_eq!(
            orders.command("one", JobCommand::Stop, &runs),
            CommandStatus::InvalidState
        );
        assert_eq!(state(&orders), shown);
        assert_eq!(*runs.calls.lock().unwrap(), ["start urn:p"]);
    }
}

#[test]
fn requirements_that_no_plan_checks_are_refused() {
    let runs = Fakes::default();
    let mut orders = Orders::default();
    let parameter = Parameter::default();
    let with = JobOrder {
        parameters: Some(OptionalArray(vec![parameter])),
        ..job_order("one", "urn:p")
    };
    assert_eq!(orders.store(with, &runs), CommandStatus::UnableToAccept);
    let empty = JobOrder {
        parameters: Some(OptionalArray(Vec::new())),
        ..job_order("one", "urn:p")
    };
    assert_eq!(orders.store(empty, &runs), CommandStatus::Good);
}
