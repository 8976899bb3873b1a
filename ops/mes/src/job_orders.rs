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
pub(crate) enum CommandStatus {
    Good,
    UnknownOrder,
    /// The command does not fit the state.
    InvalidState,
    /// The job order needs something that the MES does not have.
    UnableToAccept,
    InvalidRequest,
}

impl CommandStatus {
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
pub(crate) struct KeptJobOrder {
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

impl KeptJobOrder {
    fn id(&self) -> &str {
        self.order.id.as_ref()
    }
}

impl KeptJobOrder {
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
    all: Vec<KeptJobOrder>,
    file: Option<OrderFile>,
}

/// A command for a job order.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum JobCommand {
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
    pub(crate) fn of_file((file, all): (OrderFile, Vec<KeptJobOrder>)) -> Self {
        Self {
            all,
            file: Some(file),
        }
    }

    pub(crate) fn all(&self) -> &[KeptJobOrder] {
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
    pub(crate) fn order(&self, id: &str) -> Option<&KeptJobOrder> {
        self.all.iter().find(|order| order.id() == id)
    }

    /// Stores a job order.
    pub(crate) fn store(&mut self, order: JobOrder, runs: &dyn JobRuns) -> CommandStatus {
        let process = match process_of(&order, runs) {
            Ok(process) => process,
            Err(status) => return status,
        };
        if self.order(order.id.as_ref()).is_some() || self.all.len() >= MOST_ORDERS {
            return CommandStatus::UnableToAccept;
        }
        self.all.push(KeptJobOrder {
            order,
            state: OrderState::NotAllowedToStart,
            progress: None,
            reason: None,
            process,
            job: None,
            wanted: None,
        });
        if self.keep() {
            return CommandStatus::Good;
        }
        self.all.pop();
        CommandStatus::UnableToAccept
    }

    /// Replaces a job order that has not been started.
    pub(crate) fn update(&mut self, order: JobOrder, runs: &dyn JobRuns) -> CommandStatus {
        let mut all = self.all.iter_mut();
        let Some(known) = all.find(|known| known.order.id == order.id) else {
            return CommandStatus::UnknownOrder;
        };
        if known.job.is_some() || known.state.number() > OrderState::AllowedToStart.number() {
            return CommandStatus::InvalidState;
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
    pub(crate) fn command(
        &mut self,
        id: &str,
        command: JobCommand,
        runs: &dyn JobRuns,
    ) -> CommandStatus {
        use OrderState::{
            Aborted, AllowedToStart, Ended, Interrupted, NotAllowedToStart, Paused, Running,
        };
        let Some(place) = self.all.iter().position(|order| order.id() == id) else {
            return CommandStatus::UnknownOrder;
        };
        let Some(order) = self.all.get_mut(place) else {
            return CommandStatus::UnknownOrder;
        };
        let before = order.clone();
        match (command, order.state) {
            // It is stored before anything starts: after a restart it may have been started.
            (JobCommand::Start, NotAllowedToStart) => {
                order.state = AllowedToStart;
                let kept = self.kept_or(before);
                if kept != CommandStatus::Good {
                    return kept;
                }
            }
            (JobCommand::RevokeStart, AllowedToStart) => order.state = NotAllowedToStart,
            (JobCommand::Cancel, NotAllowedToStart | AllowedToStart)
            | (JobCommand::Clear, Ended | Aborted) => drop(self.all.remove(place)),
            (JobCommand::Abort, NotAllowedToStart | AllowedToStart) => order.state = Aborted,
            (JobCommand::Stop | JobCommand::Abort, Running | Paused) => {
                let progress = order.job.and_then(|job| runs.progress(job));
                let is_running = |of: &JobProgress| of.outcome == JobOutcome::Running;
                // A stop gives back the components of a run with an unknown outcome, which the
                // client has not seen yet.
                if !progress.as_ref().is_some_and(is_running) {
                    self.poll(runs);
                    return CommandStatus::InvalidState;
                }
                let end = if command == JobCommand::Stop {
                    Ended
                } else {
                    Aborted
                };
                order.wanted = Some(end);
                order.job.into_iter().for_each(|job| runs.stop(job));
            }
            // Someone has looked at the machines.
            (JobCommand::Stop | JobCommand::Abort, Interrupted) => {
                order.job.take().into_iter().for_each(|job| runs.stop(job));
                order.state = if command == JobCommand::Stop {
                    Ended
                } else {
                    Aborted
                };
            }
            (JobCommand::Pause, Running) | (JobCommand::Resume, Running | Paused) => {
                let is_paused = command == JobCommand::Pause;
                // A composite cannot be paused between its steps.
                if !order.job.is_some_and(|job| runs.pause(job, is_paused)) {
                    return CommandStatus::UnableToAccept;
                }
            }
            (JobCommand::Resume, Interrupted) => return CommandStatus::UnableToAccept,
            _ => return CommandStatus::InvalidState,
        }
        if !self.poll(runs) {
            self.keep();
        }
        CommandStatus::Good
    }

    /// Stores a changed order, or restores it as it was before.
    fn kept_or(&mut self, before: KeptJobOrder) -> CommandStatus {
        if self.keep() {
            return CommandStatus::Good;
        }
        let mut all = self.all.iter_mut();
        if let Some(known) = all.find(|known| known.order.id == before.order.id) {
            *known = before;
        }
        CommandStatus::UnableToAccept
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
fn process_of(order: &JobOrder, runs: &dyn JobRuns) -> Result<String, CommandStatus> {
    let id = order.id.as_ref();
    if id.is_empty() || id.len() > LONGEST_ID {
        return Err(CommandStatus::InvalidRequest);
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
        return Err(CommandStatus::UnableToAccept);
    }
    let masters = order.work_masters.iter().flat_map(|array| &array.0);
    let mut known = masters.filter(|master| {
        let parameters = master.parameters.as_ref().map_or(0, |array| array.0.len());
        parameters == 0 && runs.is_process(master.id.as_ref())
    });
    let process = known.next().map(|master| master.id.as_ref().to_owned());
    process.ok_or(CommandStatus::UnableToAccept)
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
}
