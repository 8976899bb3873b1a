//! The task of a skill. It waits for calls, reports of the work and time limits, and carries out
//! the outputs of the [`SkillMachine`].

use std::future::pending;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;

use program::RunId;
use tokio::sync::{mpsc, oneshot, watch};
use tokio::task::{JoinError, JoinHandle};
use tokio::time::{Instant, sleep_until};
use tracing::error;

use crate::authority::Authority;
use crate::driver::{Line, MOST_STEPS, Reins, RunResults, Work};
use crate::driver_error::DriverError;
use crate::machine::{
    CallReply, MachineParts, Moment, RunFailure, SkillCallRequest, SkillMachine, SkillOutput,
    WorkEnd,
};
use crate::panics::panic_text;
use crate::refusal::SkillRefusal;
use crate::shown::{SkillObserver, SkillSnapshot, clock};

/// A message to the task.
#[derive(Debug)]
pub(crate) enum Order {
    Call(SkillCallRequest<SkillReply>),
    /// Closes the component: a run in progress is halted, regardless of the holder of the lease.
    Close(oneshot::Sender<()>),
}

/// The way to a caller within this program.
pub(crate) type SkillReply = oneshot::Sender<Result<u32, SkillRefusal>>;

impl CallReply for SkillReply {
    fn is_wanted(&self) -> bool {
        !self.is_closed()
    }
}

pub(crate) struct Actor {
    machine: SkillMachine<SkillReply>,
    /// The lease of the component, and the name of the skill in it.
    authority: Authority,
    name: String,
    observers: Vec<Box<dyn SkillObserver>>,
    shown: watch::Sender<Arc<SkillSnapshot>>,
    task: Option<RunTask>,
}

/// The task of a run.
struct RunTask {
    run: RunId,
    task: JoinHandle<Result<RunResults, DriverError>>,
    reins: Reins,
}

enum TaskEvent {
    Line(Line),
    Progress(f32),
    Ended(WorkEnd),
}

impl Actor {
    pub(crate) fn new(
        parts: MachineParts,
        observers: Vec<Box<dyn SkillObserver>>,
    ) -> (Self, watch::Receiver<Arc<SkillSnapshot>>) {
        let (authority, name) = (parts.authority.clone(), parts.facts.name.clone());
        let machine = SkillMachine::new(parts, clock());
        let (shown, watched) = watch::channel(Arc::new(machine.snapshot().clone()));
        let actor = Self {
            machine,
            authority,
            name,
            observers,
            shown,
            task: None,
        };
        (actor, watched)
    }

    /// Runs until the skill is closed or its last handle is dropped.
    pub(crate) async fn run(mut self, mut orders: mpsc::Receiver<Order>) {
        let mut closers = Vec::new();
        let mut has_handles = true;
        while !self.machine.is_closed() {
            let deadline = self.machine.poll_deadline();
            tokio::select! {
                order = orders.recv(), if has_handles => match order {
                    Some(Order::Call(call)) => {
                        self.take_arrived().await;
                        self.machine.call(call);
                    }
                    Some(Order::Close(closed)) => {
                        closers.push(closed);
                        self.machine.close();
                    }
                    // All handles are dropped: the machine is stopped.
                    None => {
                        has_handles = false;
                        self.machine.close();
                    }
                },
                event = next_event(&mut self.task) => self.task_event(event),
                () = at(deadline) => self.handle_deadline(moment()).await,
            }
            self.carry_out();
        }
        for closed in closers {
            // The caller of the close may not wait for the reply.
            let _told = closed.send(());
        }
    }

    /// Processes a time limit that has passed, and before it all that came in time.
    async fn handle_deadline(&mut self, now: Moment) {
        self.take_arrived().await;
        self.machine.handle_deadline(now);
    }

    /// Processes the reports that wait, and the end of work that has ended already, so that a call
    /// or a deadline finds the run ended.
    async fn take_arrived(&mut self) {
        let has_ended = self.task.as_ref().is_some_and(|of| of.task.is_finished());
        if has_ended {
            // The end comes before the reports, and processes them.
            let event = next_event(&mut self.task).await;
            self.task_event(event);
        } else {
            self.take_reports();
        }
        self.carry_out();
    }

    /// Processes the reports that wait: at most a full queue, because a task that the driver
    /// started may report without end.
    fn take_reports(&mut self) {
        for _ in 0..MOST_STEPS {
            let Some(RunTask { run, reins, .. }) = &mut self.task else {
                return;
            };
            let Ok(line) = reins.steps.try_recv() else {
                return;
            };
            self.machine.report(*run, line, moment());
            self.carry_out();
        }
    }

    fn task_event(&mut self, event: TaskEvent) {
        let Some(RunTask { run, .. }) = self.task else {
            return;
        };
        match event {
            TaskEvent::Line(line) => self.machine.report(run, line, moment()),
            TaskEvent::Progress(done) => self.machine.progress(run, done),
            TaskEvent::Ended(result) => {
                // Reports that came before the end.
                self.take_reports();
                self.task = None;
                self.machine.ended(run, result, moment());
            }
        }
    }

    fn carry_out(&mut self) {
        while let Some(output) = self.machine.poll_output(moment()) {
            match output {
                SkillOutput::Event(notice, shown) => {
                    for observer in &self.observers {
                        observer.told(notice.event(), &shown);
                    }
                    self.shown.send_replace(shown);
                }
                SkillOutput::Run {
                    run,
                    driver,
                    parameters,
                } => {
                    let (work, reins) = Work::new(run.number(), parameters);
                    let task = tokio::spawn(async move { driver.run(work).await });
                    self.task = Some(RunTask { run, task, reins });
                }
                SkillOutput::Signal(signal) => {
                    if let Some(RunTask { reins, .. }) = &self.task {
                        reins.signal.send_replace(signal);
                    }
                }
                SkillOutput::Abort => {
                    if let Some(RunTask { task, .. }) = &self.task {
                        task.abort();
                    }
                }
                SkillOutput::Release { at } => self.authority.end(&self.name, at),
                SkillOutput::Reply(caller, answer) => {
                    // The caller may have gone; the call has taken effect.
                    let _told = caller.send(answer);
                }
            }
        }
    }
}

impl Drop for Actor {
    /// Ends a run in progress with an unknown outcome, and releases the component. An observer that
    /// panics, and the end of the runtime, drop the task before the skill is closed.
    fn drop(&mut self) {
        if self.machine.is_closed() {
            return;
        }
        if std::thread::panicking() {
            error!(
                skill = self.name,
                hint = "restart the component",
                "the skill broke down"
            );
        }
        self.machine.abandon(moment());
        while let Some(output) = self.machine.poll_output(moment()) {
            match output {
                SkillOutput::Event(notice, shown) => {
                    for observer in &self.observers {
                        let told = || observer.told(notice.event(), &shown);
                        // The observer that broke down may do so again.
                        let _told = catch_unwind(AssertUnwindSafe(told));
                    }
                }
                SkillOutput::Release { at } => self.authority.end(&self.name, at),
                SkillOutput::Reply(caller, answer) => {
                    let _told = caller.send(answer);
                }
                // The work sees the end of its skill as a stop.
                SkillOutput::Run { .. } | SkillOutput::Signal(_) | SkillOutput::Abort => {}
            }
        }
        let shown = self.machine.snapshot().clone();
        self.shown.send_replace(Arc::new(shown));
    }
}

/// Returns the next event of the work. Pends while there is no work.
async fn next_event(task: &mut Option<RunTask>) -> TaskEvent {
    let Some(RunTask { task, reins, .. }) = task else {
        return pending().await;
    };
    tokio::select! {
        biased;
        // Reports without end do not delay the end of the work, which processes those before it.
        ended = task => TaskEvent::Ended(end_of(ended)),
        Some(line) = reins.steps.recv() => TaskEvent::Line(line),
        Ok(()) = reins.progress.changed() => {
            TaskEvent::Progress(*reins.progress.borrow_and_update())
        }
    }
}

/// Returns the result of ended work.
fn end_of(ended: Result<Result<RunResults, DriverError>, JoinError>) -> WorkEnd {
    let error = match ended {
        Ok(result) => return result.map_err(RunFailure::Driver),
        Err(error) => error,
    };
    Err(match error.try_into_panic() {
        Ok(panic) => RunFailure::Panicked {
            panic: panic_text(&*panic).to_owned(),
        },
        Err(_) => RunFailure::Aborted,
    })
}

fn moment() -> Moment {
    Moment {
        monotonic: Instant::now(),
        wall: clock(),
    }
}

async fn at(deadline: Option<Instant>) {
    match deadline {
        Some(deadline) => sleep_until(deadline).await,
        None => pending().await,
    }
}

#[cfg(test)]
mod tests;
