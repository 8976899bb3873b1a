//! The job orders of the MES, and the commands of clients. A job order names a process; its run is
//! a job of the MES.

use plant_opcua::job_control::JobOrder;
use tracing::error;

use crate::job_order::{JobOutcome, JobProgress, KeptJobOrder, MOST_ORDERS, OrderState};
use crate::order_file::OrderFile;

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
        self.all.push(KeptJobOrder::new(order, process));
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

const LONGEST_ID: usize = 256;

#[cfg(test)]
mod tests;
