//! Job orders (OPC 10031-4): their states, and the commands of clients. A job order names a
//! process; its run is a job of the MES.

use plant_opcua::job_control::JobOrder;
use serde::{Deserialize, Serialize};
use serde_json::Value as Json;
use tracing::error;

use crate::order_file::OrderFile;

/// The states of a job order.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) enum OrderState {
    NotAllowedToStart,
    AllowedToStart,
    Running,
    /// The run is paused: no skill runs, and no further step begins. Clients see Interrupted.
    Paused,
    /// The outcome of the run is unknown: its machines may move.
    Interrupted,
    Ended,
    Aborted,
}

impl OrderState {
    pub(crate) const fn name(self) -> &'static str {
        match self {
            Self::NotAllowedToStart => "NotAllowedToStart",
            Self::AllowedToStart => "AllowedToStart",
            Self::Running => "Running",
            Self::Paused | Self::Interrupted => "Interrupted",
            Self::Ended => "Ended",
            Self::Aborted => "Aborted",
        }
    }

    pub(crate) const fn number(self) -> u32 {
        match self {
            Self::NotAllowedToStart => 1,
            Self::AllowedToStart => 2,
            Self::Running => 3,
            Self::Paused | Self::Interrupted => 4,
            Self::Ended => 5,
            Self::Aborted => 6,
        }
    }
}

/// The status that a command returns.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Status {
    Good,
    UnknownOrder,
    /// The command does not fit the state.
    InvalidState,
    /// The job order needs something that the MES does not have.
    UnableToAccept,
    InvalidRequest,
}

impl Status {
    /// Returns the bit field of OPC 10031-4.
    pub(crate) const fn bits(self) -> u64 {
        match self {
            Self::Good => 1,
            Self::UnknownOrder => 1 << 1,
            Self::InvalidState => 1 << 3,
            Self::UnableToAccept => 1 << 4,
            Self::InvalidRequest => 1 << 32,
        }
    }
}

/// The jobs of the MES.
pub(crate) trait JobRuns: Send + Sync {
    /// Returns whether there is such a process.
    fn is_process(&self, process: &str) -> bool;

    /// Starts a process. Returns the number of its job; `None` if too many jobs are running.
    ///
    /// # Errors
    /// The reason why it cannot run.
    fn start(&self, process: &str) -> Result<Option<u64>, String>;

    /// Stops a job, or gives back the components of a job with an unknown outcome.
    fn stop(&self, job: u64);

    /// Pauses or resumes a job between its steps. Returns whether that is possible.
    fn pause(&self, job: u64, is_paused: bool) -> bool;

    /// Returns the progress of a job.
    fn progress(&self, job: u64) -> Option<JobProgress>;
}

/// The progress of a job. Times are in ms since 1970.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct JobProgress {
    /// Whether the job is paused, and no skill runs.
    pub(crate) is_paused: bool,
    pub(crate) outcome: JobOutcome,
    pub(crate) reason: Option<String>,
    pub(crate) started_ms: u64,
    pub(crate) ended_ms: Option<u64>,
    /// The results of the steps, by `step.Result`.
    pub(crate) results: Vec<(String, Json)>,
}

/// The outcome of a job.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) enum JobOutcome {
    Running,
    Done,
    /// Its end is confirmed.
    Failed,
    Unknown,
}

/// A job order.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Order {
    pub(crate) order: JobOrder,
    pub(crate) state: OrderState,
    pub(crate) progress: Option<JobProgress>,
    /// The reason of the last change of the state, if there is one.
    pub(crate) reason: Option<String>,
    pub(crate) process: String,
    job: Option<u64>,
    /// The state that a client wants the run to end in.
    wanted: Option<OrderState>,
}

impl Order {
    fn id(&self) -> &str {
        self.order.id.as_ref()
    }
}

impl Order {
    /// Restores a job order of an earlier run of the program. Nothing is started again: an order
    /// that was allowed to start may have been started, so its outcome is unknown.
    pub(crate) fn restored(
        (order, process): (JobOrder, String),
        state: OrderState,
        (progress, reason): (Option<JobProgress>, Option<String>),
    ) -> Self {
        let (state, reason) = match state {
            OrderState::AllowedToStart
            | OrderState::Running
            | OrderState::Paused
            | OrderState::Interrupted => {
                let why = "the program ended before the end of the job was known";
                (OrderState::Interrupted, Some(why.to_owned()))
            }
            OrderState::NotAllowedToStart | OrderState::Ended | OrderState::Aborted => {
                (state, reason)
            }
        };
        Self {
            order,
            state,
            progress,
            reason,
            process,
            job: None,
            wanted: None,
        }
    }
}

/// The job orders of the MES.
#[derive(Debug, Default)]
pub(crate) struct Orders {
    all: Vec<Order>,
    file: Option<OrderFile>,
}

/// A command for a job order.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Command {
    Start,
    RevokeStart,
    Pause,
    Resume,
    Stop,
    Abort,
    Cancel,
    Clear,
}

impl Orders {
    /// Creates the job orders of a file, which stores each change.
    pub(crate) fn of_file((file, all): (OrderFile, Vec<Order>)) -> Self {
        Self {
            all,
            file: Some(file),
        }
    }

    pub(crate) fn all(&self) -> &[Order] {
        &self.all
    }

    /// Stores all orders. Returns whether they are stored, or need not be.
    fn keep(&self) -> bool {
        let Some(file) = &self.file else { return true };
        match file.write(&self.all) {
            Ok(()) => true,
            Err(error) => {
                error!(%error, "cannot store the job orders");
                false
            }
        }
    }

    /// Returns the job order with an ID.
    pub(crate) fn order(&self, id: &str) -> Option<&Order> {
        self.all.iter().find(|order| order.id() == id)
    }

    /// Stores a job order.
    pub(crate) fn store(&mut self, order: JobOrder, runs: &dyn JobRuns) -> Status {
        let process = match process_of(&order, runs) {
            Ok(process) => process,
            Err(status) => return status,
        };
        if self.order(order.id.as_ref()).is_some() || self.all.len() >= MOST_ORDERS {
            return Status::UnableToAccept;
        }
        self.all.push(Order {
            order,
            state: OrderState::NotAllowedToStart,
            progress: None,
            reason: None,
            process,
            job: None,
            wanted: None,
        });
        if self.keep() {
            return Status::Good;
        }
        self.all.pop();
        Status::UnableToAccept
    }

    /// Replaces a job order that has not been started.
    pub(crate) fn update(&mut self, order: JobOrder, runs: &dyn JobRuns) -> Status {
        let mut all = self.all.iter_mut();
        let Some(known) = all.find(|known| known.order.id == order.id) else {
            return Status::UnknownOrder;
        };
        if known.job.is_some() || known.state.number() > OrderState::AllowedToStart.number() {
            return Status::InvalidState;
        }
        match process_of(&order, runs) {
            Ok(process) => {
                let before = known.clone();
                (known.process, known.order) = (process, order);
                self.kept_or(before)
            }
            Err(status) => status,
        }
    }

    /// Executes a command.
    pub(crate) fn command(&mut self, id: &str, command: Command, runs: &dyn JobRuns) -> Status {
        use OrderState::{
            Aborted, AllowedToStart, Ended, Interrupted, NotAllowedToStart, Paused, Running,
        };
        let Some(place) = self.all.iter().position(|order| order.id() == id) else {
            return Status::UnknownOrder;
        };
        let Some(order) = self.all.get_mut(place) else {
            return Status::UnknownOrder;
        };
        let before = order.clone();
        match (command, order.state) {
            // It is stored before anything starts: after a restart it may have been started.
            (Command::Start, NotAllowedToStart) => {
                order.state = AllowedToStart;
                let kept = self.kept_or(before);
                if kept != Status::Good {
                    return kept;
                }
            }
            (Command::RevokeStart, AllowedToStart) => order.state = NotAllowedToStart,
            (Command::Cancel, NotAllowedToStart | AllowedToStart)
            | (Command::Clear, Ended | Aborted) => drop(self.all.remove(place)),
            (Command::Abort, NotAllowedToStart | AllowedToStart) => order.state = Aborted,
            (Command::Stop | Command::Abort, Running | Paused) => {
                let progress = order.job.and_then(|job| runs.progress(job));
                let is_running = |of: &JobProgress| of.outcome == JobOutcome::Running;
                // A stop gives back the components of a run with an unknown outcome, which the
                // client has not seen yet.
                if !progress.as_ref().is_some_and(is_running) {
                    self.poll(runs);
                    return Status::InvalidState;
                }
                let end = if command == Command::Stop {
                    Ended
                } else {
                    Aborted
                };
                order.wanted = Some(end);
                order.job.into_iter().for_each(|job| runs.stop(job));
            }
            // Someone has looked at the machines.
            (Command::Stop | Command::Abort, Interrupted) => {
                order.job.take().into_iter().for_each(|job| runs.stop(job));
                order.state = if command == Command::Stop {
                    Ended
                } else {
                    Aborted
                };
            }
            (Command::Pause, Running) | (Command::Resume, Running | Paused) => {
                let is_paused = command == Command::Pause;
                // A composite cannot be paused between its steps.
                if !order.job.is_some_and(|job| runs.pause(job, is_paused)) {
                    return Status::UnableToAccept;
                }
            }
            (Command::Resume, Interrupted) => return Status::UnableToAccept,
            _ => return Status::InvalidState,
        }
        if !self.poll(runs) {
            self.keep();
        }
        Status::Good
    }

    /// Stores a changed order, or restores it as it was before.
    fn kept_or(&mut self, before: Order) -> Status {
        if self.keep() {
            return Status::Good;
        }
        let mut all = self.all.iter_mut();
        if let Some(known) = all.find(|known| known.order.id == before.order.id) {
            *known = before;
        }
        Status::UnableToAccept
    }

    /// Starts the job orders that are allowed to start, follows the runs, and stores changes.
    /// Returns whether an order has changed.
    pub(crate) fn poll(&mut self, runs: &dyn JobRuns) -> bool {
        let has_changed = self.follow(runs);
        if has_changed {
            self.keep();
        }
        has_changed
    }

    fn follow(&mut self, runs: &dyn JobRuns) -> bool {
        let mut has_changed = false;
        for order in &mut self.all {
            if order.state == OrderState::AllowedToStart {
                match runs.start(&order.process) {
                    Ok(None) => continue,
                    Ok(Some(job)) => {
                        order.job = Some(job);
                        order.state = OrderState::Running;
                    }
                    Err(why) => {
                        order.state = OrderState::Aborted;
                        order.reason = Some(why);
                    }
                }
                has_changed = true;
            }
            let follows = matches!(order.state, OrderState::Running | OrderState::Paused);
            let Some(job) = order.job.filter(|_| follows) else {
                continue;
            };
            let Some(progress) = runs.progress(job) else {
                // A job is removed from the list after its end, which was not seen.
                order.state = OrderState::Interrupted;
                order.reason = Some("the outcome of the job is unknown".to_owned());
                has_changed = true;
                continue;
            };
            let wanted = order.wanted.unwrap_or(OrderState::Aborted);
            let state = match progress.outcome {
                JobOutcome::Running if progress.is_paused => OrderState::Paused,
                JobOutcome::Running => OrderState::Running,
                JobOutcome::Done => OrderState::Ended,
                JobOutcome::Failed => wanted,
                JobOutcome::Unknown => OrderState::Interrupted,
            };
            has_changed |= state != order.state;
            order.state = state;
            order.reason.clone_from(&progress.reason);
            order.progress = Some(progress);
        }
        has_changed
    }
}

/// Returns the process of a job order.
fn process_of(order: &JobOrder, runs: &dyn JobRuns) -> Result<String, Status> {
    let id = order.id.as_ref();
    if id.is_empty() || id.len() > LONGEST_ID {
        return Err(Status::InvalidRequest);
    }
    // Nothing that a client requires is left out without a word.
    let is_empty = |count: Option<usize>| count.unwrap_or_default() == 0;
    let counts = [
        order.parameters.as_ref().map(|array| array.0.len()),
        order.personnel.as_ref().map(|array| array.0.len()),
        order.equipment.as_ref().map(|array| array.0.len()),
        order.assets.as_ref().map(|array| array.0.len()),
        order.material.as_ref().map(|array| array.0.len()),
    ];
    if !counts.into_iter().all(is_empty) || order.start.is_some() {
        return Err(Status::UnableToAccept);
    }
    let masters = order.work_masters.iter().flat_map(|array| &array.0);
    let mut known = masters.filter(|master| {
        let parameters = master.parameters.as_ref().map_or(0, |array| array.0.len());
        parameters == 0 && runs.is_process(master.id.as_ref())
    });
    let process = known.next().map(|master| master.id.as_ref().to_owned());
    process.ok_or(Status::UnableToAccept)
}

/// Maximum number of job orders.
pub(crate) const MOST_ORDERS: usize = 100;
const LONGEST_ID: usize = 256;

#[cfg(test)]
mod tests {
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
        assert_eq!(orders.store(job_order("one", "urn:p"), &runs), Status::Good);
        assert_eq!(
            orders.store(job_order("one", "urn:p"), &runs),
            Status::UnableToAccept
        );
        assert_eq!(
            orders.store(job_order("two", "urn:q"), &runs),
            Status::UnableToAccept
        );
        assert_eq!(
            orders.store(job_order("", "urn:p"), &runs),
            Status::InvalidRequest
        );
        assert_eq!(
            orders.command("two", Command::Start, &runs),
            Status::UnknownOrder
        );
        for command in [
            Command::Stop,
            Command::Clear,
            Command::RevokeStart,
            Command::Pause,
        ] {
            assert_eq!(orders.command("one", command, &runs), Status::InvalidState);
        }
        assert_eq!(orders.command("one", Command::Start, &runs), Status::Good);
        assert_eq!(state(&orders), OrderState::Running);
        for command in [Command::Start, Command::Cancel, Command::Clear] {
            assert_eq!(orders.command("one", command, &runs), Status::InvalidState);
        }
        *runs.outcome.lock().unwrap() = Some(JobOutcome::Done);
        assert!(orders.poll(&runs));
        assert_eq!(state(&orders), OrderState::Ended);
        assert_eq!(orders.command("one", Command::Clear, &runs), Status::Good);
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
            orders.command("one", Command::Resume, &runs),
            Status::InvalidState
        );
        orders.command("one", Command::Start, &runs);
        assert_eq!(orders.command("one", Command::Pause, &runs), Status::Good);
        assert_eq!(state(&orders).number(), 4);
        assert_eq!(
            orders.command("one", Command::Pause, &runs),
            Status::InvalidState
        );
        assert_eq!(orders.command("one", Command::Resume, &runs), Status::Good);
        assert_eq!(state(&orders), OrderState::Running);
        orders.command("one", Command::Pause, &runs);
        assert_eq!(orders.command("one", Command::Stop, &runs), Status::Good);
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
            assert_eq!(orders.store(job_order(id, "urn:p"), &runs), Status::Good);
        }
        orders.command("done", Command::Start, &runs);
        *runs.outcome.lock().unwrap() = Some(JobOutcome::Done);
        orders.poll(&runs);
        orders.command("one", Command::Start, &runs);
        *runs.is_busy.lock().unwrap() = true;
        orders.command("waits", Command::Start, &runs);
        orders.command("gone", Command::Cancel, &runs);
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
            orders.command("one", Command::Resume, &runs),
            Status::UnableToAccept
        );
        assert_eq!(orders.command("one", Command::Abort, &runs), Status::Good);
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
        assert_eq!(orders.command("one", Command::Start, &runs), Status::Good);
        assert_eq!(state(&orders), OrderState::AllowedToStart);
        assert_eq!(
            orders.command("one", Command::RevokeStart, &runs),
            Status::Good
        );
        *runs.is_busy.lock().unwrap() = false;
        orders.poll(&runs);
        assert_eq!(state(&orders), OrderState::NotAllowedToStart);
        assert!(runs.calls.lock().unwrap().is_empty());
    }

    #[test]
    fn a_stop_ends_the_order_only_when_the_end_is_confirmed() {
        for (command, end) in [
            (Command::Stop, OrderState::Ended),
            (Command::Abort, OrderState::Aborted),
        ] {
            let runs = Fakes::default();
            let mut orders = Orders::default();
            orders.store(job_order("one", "urn:p"), &runs);
            orders.command("one", Command::Start, &runs);
            assert_eq!(orders.command("one", command, &runs), Status::Good);
            assert_eq!(state(&orders), OrderState::Running, "it still runs");
            *runs.outcome.lock().unwrap() = Some(JobOutcome::Unknown);
            orders.poll(&runs);
            assert_eq!(state(&orders), OrderState::Interrupted);
            assert_eq!(
                orders.command("one", Command::Resume, &runs),
                Status::UnableToAccept
            );
            assert_eq!(orders.command("one", command, &runs), Status::Good);
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
            orders.command("one", Command::Start, &runs);
            *runs.outcome.lock().unwrap() = Some(outcome);
            assert_eq!(
                orders.command("one", Command::Stop, &runs),
                Status::InvalidState
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
        assert_eq!(orders.store(with, &runs), Status::UnableToAccept);
        let empty = JobOrder {
            parameters: Some(OptionalArray(Vec::new())),
            ..job_order("one", "urn:p")
        };
        assert_eq!(orders.store(empty, &runs), Status::Good);
    }
}
