//! A skill that is executed here: the handle, and what it is made of.

use std::collections::{BTreeMap, VecDeque};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use program::{Method, Rest, State};
use tokio::sync::{mpsc, oneshot, watch};

use crate::actor::{Actor, Call, Given, Order};
use crate::authority::{Authority, Owner};
use crate::driver::Driver;
use crate::parameters::{Parameter, Parameters, TypeName, shortened};
use crate::refusal::{Code, Refusal};
use crate::shown::{Observer, Outcome, Shown};
use crate::value::Value;

/// What a skill is, for as long as it is there.
#[derive(Debug, Clone)]
pub struct Facts {
    /// What its component calls it.
    pub name: String,
    /// Its type and all supertypes, nearest first.
    pub types: Vec<TypeName>,
    /// What a run is told.
    pub parameters: Vec<Parameter>,
    /// What a run says at its end.
    pub results: Vec<Parameter>,
    /// The IRIs of the capabilities it provides.
    pub capabilities: Vec<String>,
    /// How long a run may take; `None` for as long as it likes.
    pub timeout: Option<Duration>,
    /// The state after a run that did its work, as its type says.
    pub rests_in: Rest,
}

/// A skill that is executed here. Clones are of the same one; it ends with the last of them, its run being stopped.
#[derive(Debug, Clone)]
pub struct Skill {
    facts: Arc<Facts>,
    authority: Authority,
    pending: Arc<Mutex<Pending>>,
    orders: mpsc::Sender<Order>,
    shown: watch::Receiver<Arc<Shown>>,
    outcomes: Arc<Mutex<VecDeque<Arc<Outcome>>>>,
}

/// Parameters written for the next run, and by whom: those of one client are nothing to the next.
#[derive(Debug, Default)]
pub(crate) struct Pending {
    by: Option<Owner>,
    values: BTreeMap<String, Value>,
}

impl Pending {
    /// Those of this owner.
    fn of(&mut self, by: &Owner) -> &mut BTreeMap<String, Value> {
        if self.by.as_ref() != Some(by) {
            self.by = Some(by.clone());
            self.values.clear();
        }
        &mut self.values
    }

    pub(crate) fn given(&mut self, by: &Owner) -> Vec<(String, Value)> {
        self.of(by).clone().into_iter().collect()
    }

    pub(crate) fn kept(&mut self, by: &Owner, values: &[(String, Value)]) {
        *self.of(by) = values.iter().cloned().collect();
    }
}

impl Skill {
    /// Starts a skill, in Halted, whose first run is 1. Needs a tokio runtime.
    #[must_use]
    pub fn spawn(
        facts: Facts,
        driver: Arc<dyn Driver>,
        authority: Authority,
        observers: Vec<Box<dyn Observer>>,
    ) -> Self {
        Self::counting_from(1, facts, driver, authority, observers)
    }

    /// The same with the number of its first run, that no number which it had before it was started anew comes again.
    #[must_use]
    pub fn counting_from(
        first_run: u32,
        facts: Facts,
        driver: Arc<dyn Driver>,
        authority: Authority,
        observers: Vec<Box<dyn Observer>>,
    ) -> Self {
        let facts = Arc::new(facts);
        let pending = Arc::new(Mutex::new(Pending::default()));
        let outcomes = Arc::default();
        let (orders, waiting) = mpsc::channel(MOST_ORDERS);
        let (actor, shown) = Actor::new(
            (Arc::clone(&facts), driver),
            authority.clone(),
            (Arc::clone(&pending), Arc::clone(&outcomes)),
            (observers, first_run),
        );
        drop(tokio::spawn(actor.run(waiting)));
        Self {
            facts,
            authority,
            pending,
            orders,
            shown,
            outcomes,
        }
    }

    /// What it is.
    #[must_use]
    pub fn facts(&self) -> &Arc<Facts> {
        &self.facts
    }

    /// How it is now.
    #[must_use]
    pub fn shown(&self) -> Arc<Shown> {
        self.shown.borrow().clone()
    }

    /// How it is, and each change; of changes that follow each other closely the newest. An [`Observer`] hears of all.
    #[must_use]
    pub fn watch(&self) -> watch::Receiver<Arc<Shown>> {
        self.shown.clone()
    }

    /// How a run ended, of the newest ones.
    #[must_use]
    pub fn outcome(&self, run: u32) -> Option<Arc<Outcome>> {
        lock(&self.outcomes)
            .iter()
            .find(|outcome| outcome.run == run)
            .cloned()
    }

    /// Writes a parameter for the next run.
    ///
    /// # Errors
    /// BadLocked, BadInvalidState while a run goes on, BadInvalidArgument for a name that is none of the type, and as
    /// [`Parameter::take`]. Nothing has changed then.
    pub fn write(&self, by: &Owner, name: &str, value: Value) -> Result<(), Refusal> {
        self.authority.claim(by)?;
        let written = self.written(by, name, value);
        self.authority.settle();
        written
    }

    fn written(&self, by: &Owner, name: &str, value: Value) -> Result<(), Refusal> {
        let state = self.shown.borrow().state;
        if matches!(state, State::Running | State::Suspended) {
            let text = format!("parameters are kept while the skill is {state}");
            return Err(Refusal::new(Code::InvalidState, text));
        }
        let parameter = self
            .facts
            .parameters
            .iter()
            .find(|parameter| parameter.name == name);
        let Some(parameter) = parameter else {
            let text = format!("there is no parameter {}", shortened(name));
            return Err(Refusal::new(Code::InvalidArgument, text));
        };
        let value = parameter.take(value)?;
        lock(&self.pending).of(by).insert(name.to_owned(), value);
        Ok(())
    }

    /// What an owner that is gone has written counts for nothing any more. Says whether there was anything.
    pub fn forget(&self, by: &Owner) -> bool {
        let mut pending = lock(&self.pending);
        let theirs = pending.by.as_ref() == Some(by);
        if theirs {
            *pending = Pending::default();
        }
        theirs
    }

    /// Calls a method; Start begins a run with the parameters that the same owner has written. Gives the number of the
    /// newest run.
    ///
    /// # Errors
    /// In this order: BadLocked (authority), BadInvalidState (mode), BadNotSupported (capability), BadArgumentsMissing,
    /// BadTypeMismatch or BadInvalidArgument (parameters), BadInvalidState while another skill of the component runs and
    /// BadTooManyOperations (queue). Nothing has changed then.
    pub async fn call(&self, by: Owner, method: Method) -> Result<u32, Refusal> {
        self.order(by, method, Given::default()).await
    }

    /// Begins a run with these parameters, whatever was written before.
    ///
    /// # Errors
    /// As [`call`](Self::call).
    pub async fn start_with(
        &self,
        by: Owner,
        parameters: Vec<(String, Value)>,
    ) -> Result<u32, Refusal> {
        let given = Given {
            parameters: Some(parameters),
            ..Given::default()
        };
        self.order(by, Method::Start, given).await
    }

    /// Begins a run with these parameters in one call, a Halted skill being made ready first; the run fails when it is not
    /// done `within` that time, or within that of the skill where that is shorter. Gives the number by which
    /// [`outcome_of`](Self::outcome_of) is asked.
    ///
    /// # Errors
    /// As [`call`](Self::call).
    pub async fn execute(
        &self,
        by: Owner,
        parameters: Vec<(String, Value)>,
        within: Option<Duration>,
    ) -> Result<u32, Refusal> {
        let given = Given {
            parameters: Some(parameters),
            within,
            readies: true,
        };
        self.order(by, Method::Start, given).await
    }

    /// How a run ended; `None` while it goes on. Run 0 is the newest one.
    ///
    /// # Errors
    /// BadNotFound for a run that never was, or of which nothing is known any more.
    pub fn outcome_of(&self, run: u32) -> Result<Option<Arc<Outcome>>, Refusal> {
        // In this order: a run that ends meanwhile is found.
        let newest = self.shown.borrow().run;
        let run = if run == 0 { newest } else { run };
        match self.outcome(run) {
            Some(outcome) => Ok(Some(outcome)),
            None if run == newest && run != 0 => Ok(None),
            None => Err(Refusal::new(
                Code::NotFound,
                format!("nothing is known of run {run}; the newest is {newest}"),
            )),
        }
    }

    /// Ends the skill: what runs is halted, whoever has the lease. Every later call is refused.
    pub async fn close(&self) {
        let (closed, ended) = oneshot::channel();
        if self.orders.send(Order::Close(closed)).await.is_ok() {
            // Without an answer it has ended already.
            let _ended = ended.await;
        }
    }

    async fn order(&self, by: Owner, method: Method, given: Given) -> Result<u32, Refusal> {
        let (reply, answer) = oneshot::channel();
        let room = match self.orders.try_reserve() {
            Ok(room) => room,
            Err(mpsc::error::TrySendError::Full(())) => {
                return Err(self.no_room(&by, given.parameters));
            }
            Err(mpsc::error::TrySendError::Closed(())) => return Err(ends()),
        };
        room.send(Order::Call(Call {
            by,
            method,
            given,
            reply,
        }));
        answer.await.unwrap_or_else(|_| Err(ends()))
    }

    /// Why a call is refused for which there is no room: what would be wrong with it at any time comes first.
    fn no_room(&self, by: &Owner, given: Option<Vec<(String, Value)>>) -> Refusal {
        if let Err(refusal) = self.authority.allows(by) {
            return refusal;
        }
        let wrong =
            given.and_then(|given| Parameters::complete(&self.facts.parameters, given).err());
        wrong.unwrap_or_else(|| {
            Refusal::new(
                Code::TooManyOperations,
                "too many calls of this skill wait already",
            )
        })
    }
}

fn ends() -> Refusal {
    Refusal::new(Code::Shutdown, "the component ends")
}

pub(crate) fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    // Each change is whole before the lock is given back.
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// So many calls of one skill may wait.
const MOST_ORDERS: usize = 16;

#[cfg(test)]
mod tests;
