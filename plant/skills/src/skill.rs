//! A skill that is executed in this process: its handle.

use std::sync::{Arc, Mutex};
use std::time::Duration;

use program::ProgramMethod;
use tokio::sync::{mpsc, oneshot, watch};

use crate::actor::{Actor, Order};
use crate::authority::{Authority, SkillOwner};
use crate::description::SkillDescription;
use crate::driver::Driver;
use crate::lock::lock;
use crate::machine::{Given, MachineParts, SkillCallRequest, Successor};
use crate::outcomes::NewestOutcomes;
use crate::parameters::shortened;
use crate::pending::PendingParameters;
use crate::refusal::{RefusalCode, SkillRefusal};
use crate::shown::{RunOutcome, SkillObserver, SkillSnapshot, is_work};
use crate::value::SkillValue;

/// A skill that is executed in this process. Clones share the skill. It ends when the last clone is
/// dropped, and its run is stopped then.
#[derive(Debug, Clone)]
pub struct Skill {
    facts: Arc<SkillDescription>,
    authority: Authority,
    pending: Arc<Mutex<PendingParameters>>,
    orders: mpsc::Sender<Order>,
    shown: watch::Receiver<Arc<SkillSnapshot>>,
    outcomes: NewestOutcomes,
    successor: Arc<Mutex<Option<Successor>>>,
}

impl Skill {
    /// Starts a skill in the state Halted. Its first run has the number 1. Needs a tokio runtime.
    #[must_use]
    pub fn spawn(
        facts: SkillDescription,
        driver: Arc<dyn Driver>,
        authority: Authority,
        observers: Vec<Box<dyn SkillObserver>>,
    ) -> Self {
        Self::counting_from(1, facts, driver, authority, observers)
    }

    /// Starts a skill with this number for its first run, so that numbers used before a restart
    /// are not reused.
    #[must_use]
    pub fn counting_from(
        first_run: u32,
        facts: SkillDescription,
        driver: Arc<dyn Driver>,
        authority: Authority,
        observers: Vec<Box<dyn SkillObserver>>,
    ) -> Self {
        let facts = Arc::new(facts);
        let pending = Arc::new(Mutex::new(PendingParameters::default()));
        let outcomes = NewestOutcomes::default();
        let successor = Arc::default();
        let (orders, waiting) = mpsc::channel(MOST_ORDERS);
        let parts = MachineParts {
            facts: Arc::clone(&facts),
            driver,
            authority: authority.clone(),
            pending: Arc::clone(&pending),
            outcomes: outcomes.clone(),
            successor: Arc::clone(&successor),
            first_run,
        };
        let (actor, shown) = Actor::new(parts, observers);
        drop(tokio::spawn(actor.run(waiting)));
        Self {
            facts,
            authority,
            pending,
            orders,
            shown,
            outcomes,
            successor,
        }
    }

    /// Replaces the driver and the time limit from the next run on. A run in progress keeps its
    /// driver and its limit.
    pub fn replace(&self, driver: Arc<dyn Driver>, timeout: Option<Duration>) {
        *lock(&self.successor) = Some(Successor { driver, timeout });
    }

    /// Returns the description of the skill.
    #[must_use]
    pub fn facts(&self) -> &Arc<SkillDescription> {
        &self.facts
    }

    /// Returns the current state of the skill.
    #[must_use]
    pub fn shown(&self) -> Arc<SkillSnapshot> {
        self.shown.borrow().clone()
    }

    /// Returns the state and its changes. Only the newest of rapid changes is delivered; an
    /// [`SkillObserver`] receives all.
    #[must_use]
    pub fn watch(&self) -> watch::Receiver<Arc<SkillSnapshot>> {
        self.shown.clone()
    }

    /// Returns the outcome of a run, if it is one of the newest runs.
    #[must_use]
    pub fn outcome(&self, run: u32) -> Option<Arc<RunOutcome>> {
        self.outcomes.of(run)
    }

    /// Writes a parameter for the next run. A refused write changes nothing.
    ///
    /// # Errors
    /// - BadLocked
    /// - BadInvalidState during a run
    /// - BadInvalidArgument for a name that the type does not have
    /// - As [`SkillParameter::take`](crate::SkillParameter::take)
    pub fn write(
        &self,
        by: &SkillOwner,
        name: &str,
        value: SkillValue,
    ) -> Result<(), SkillRefusal> {
        self.authority.claim(by)?;
        let written = self.written(by, name, value);
        self.authority.settle();
        written
    }

    fn written(&self, by: &SkillOwner, name: &str, value: SkillValue) -> Result<(), SkillRefusal> {
        let state = self.shown.borrow().state;
        if is_work(state) {
            let text = format!("parameters are kept while the skill is {state}");
            return Err(SkillRefusal::new(RefusalCode::InvalidState, text));
        }
        let parameter = self
            .facts
            .parameters
            .iter()
            .find(|parameter| parameter.name == name);
        let Some(parameter) = parameter else {
            let text = format!("there is no parameter {}", shortened(name));
            return Err(SkillRefusal::new(RefusalCode::InvalidArgument, text));
        };
        let value = parameter.take(value)?;
        lock(&self.pending).write(by, name, value);
        Ok(())
    }

    /// Discards the parameters that an owner wrote, for example when its session has closed.
    /// Returns whether the owner had written any.
    pub fn forget(&self, by: &SkillOwner) -> bool {
        lock(&self.pending).forget(by)
    }

    /// Calls a method. Start starts a run with the parameters that the same owner has written.
    /// Returns the number of the newest run.
    ///
    /// # Errors
    /// Checked in this order; a refused call changes nothing:
    ///
    /// 1. BadLocked (authority)
    /// 2. BadInvalidState (mode)
    /// 3. BadNotSupported (capability)
    /// 4. BadArgumentsMissing, BadTypeMismatch or BadInvalidArgument (parameters)
    /// 5. BadInvalidState while another skill of the component runs, and BadTooManyOperations
    ///    (queue)
    ///
    /// A Start or Resume whose future is dropped while it waits for a stop is not executed.
    pub async fn call(&self, by: SkillOwner, method: ProgramMethod) -> Result<u32, SkillRefusal> {
        self.order(by, method, Given::default()).await
    }

    /// Starts a run with these parameters, regardless of parameters written before.
    ///
    /// # Errors
    /// As [`call`](Self::call).
    pub async fn start_with(
        &self,
        by: SkillOwner,
        parameters: Vec<(String, SkillValue)>,
    ) -> Result<u32, SkillRefusal> {
        let given = Given {
            parameters: Some(parameters),
            ..Given::default()
        };
        self.order(by, ProgramMethod::Start, given).await
    }

    /// Starts a run with these parameters in one call; a Halted skill is reset first. The run fails
    /// if it is not done `within` that time, or within the time limit of the skill if that is
    /// shorter. Returns the number of the run for [`outcome_of`](Self::outcome_of).
    ///
    /// # Errors
    /// As [`call`](Self::call).
    pub async fn execute(
        &self,
        by: SkillOwner,
        parameters: Vec<(String, SkillValue)>,
        within: Option<Duration>,
    ) -> Result<u32, SkillRefusal> {
        let given = Given {
            parameters: Some(parameters),
            within,
            readies: true,
        };
        self.order(by, ProgramMethod::Start, given).await
    }

    /// Returns the outcome of a run; `None` while it is in progress. Run 0 is the newest run.
    ///
    /// # Errors
    /// BadNotFound if the run does not exist or its outcome is no longer kept.
    pub fn outcome_of(&self, run: u32) -> Result<Option<Arc<RunOutcome>>, SkillRefusal> {
        // The number is read before the outcome, so that a run that ends meanwhile is found.
        let newest = self.shown.borrow().run;
        let run = if run == 0 { newest } else { run };
        match self.outcome(run) {
            Some(outcome) => Ok(Some(outcome)),
            None if run == newest && run != 0 => Ok(None),
            None => Err(SkillRefusal::new(
                RefusalCode::NotFound,
                format!("nothing is known of run {run}; the newest is {newest}"),
            )),
        }
    }

    /// Ends the skill: a run in progress is halted, regardless of the holder of the lease. Later
    /// calls are refused.
    pub async fn close(&self) {
        let (closed, ended) = oneshot::channel();
        if self.orders.send(Order::Close(closed)).await.is_ok() {
            // Without a reply, the skill has ended already.
            let _ended = ended.await;
        }
    }

    async fn order(
        &self,
        by: SkillOwner,
        method: ProgramMethod,
        given: Given,
    ) -> Result<u32, SkillRefusal> {
        let (reply, answer) = oneshot::channel();
        let call = SkillCallRequest {
            by,
            method,
            given,
            reply,
        };
        // The task takes each call at once; it counts and bounds the calls that wait.
        if self.orders.send(Order::Call(call)).await.is_err() {
            return Err(SkillRefusal::closed());
        }
        answer.await.unwrap_or_else(|_| Err(SkillRefusal::closed()))
    }
}

/// Maximum number of calls on their way to the task.
const MOST_ORDERS: usize = 16;

#[cfg(test)]
mod tests;
