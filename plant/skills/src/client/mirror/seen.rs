//! The task of one skill of another server: processes its notifications and calls.

use std::sync::Arc;
use std::time::Duration;

use plant_opcua::types::{DataValue, Variant};
use program::{ProgramMachineState, ProgramMethod, Transition};
use tokio::sync::{mpsc, watch};
use tokio::time::{Instant, sleep, sleep_until};
use tracing::debug;

use super::super::handle::{SkillHandle, state_in};
use super::state_order::{StateNotice, StateOrder};
use super::{Order, leads_to, way};
use crate::outcomes::NewestOutcomes;
use crate::parameters::Parameters;
use crate::refusal::SkillRefusal;
use crate::shown::{
    RunOutcome, SkillEvent, SkillObserver, SkillSnapshot, Transitioned, clock, is_work,
};
use crate::skill_fault::SkillFault;
use crate::value::SkillValue;
use crate::variant::from_variant;

/// The aspect of a skill that a variable holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum SkillAspect {
    State,
    Progress,
    Step,
}

pub(super) struct SeenSkill {
    handle: SkillHandle,
    observers: Vec<Box<dyn SkillObserver>>,
    outcomes: NewestOutcomes,
    shown: watch::Sender<Arc<SkillSnapshot>>,
    now: SkillSnapshot,
    next_run: u32,
    states: StateOrder,
    /// Time of the next poll during a run.
    look_at: Instant,
}

impl SeenSkill {
    pub(super) fn new(
        handle: SkillHandle,
        observers: Vec<Box<dyn SkillObserver>>,
        outcomes: NewestOutcomes,
        first_run: u32,
    ) -> (Self, watch::Receiver<Arc<SkillSnapshot>>) {
        let now = SkillSnapshot::first(ProgramMachineState::Halted, [false; 5], clock());
        let (shown, watched) = watch::channel(Arc::new(now.clone()));
        let seen = Self {
            handle,
            observers,
            outcomes,
            shown,
            now,
            next_run: first_run.max(1),
            states: StateOrder::default(),
            look_at: Instant::now(),
        };
        (seen, watched)
    }

    /// Reports events until the connection is lost.
    pub(super) async fn run(
        mut self,
        mut notices: mpsc::Receiver<(SkillAspect, DataValue)>,
        mut orders: mpsc::Receiver<Order>,
        mut gone: watch::Receiver<Option<String>>,
    ) {
        let lives = async {
            self.first_without(&mut orders).await;
            loop {
                let look = self.look_at;
                tokio::select! {
                    biased;
                    order = orders.recv() => match order {
                        Some(order) => self.order(order).await,
                        None => return,
                    },
                    notice = notices.recv() => match notice {
                        Some((part, value)) => self.take(part, &value).await,
                        None => return,
                    },
                    () = sleep_until(look), if is_work(self.now.state) => self.look().await,
                }
            }
        };
        let why = tokio::select! {
            lost = gone.wait_for(Option::is_some) => lost.ok().and_then(|why| why.clone()),
            () = lives => None,
        };
        let why = why.unwrap_or_else(|| "nobody looks any more".to_owned());
        for observer in &self.observers {
            observer.lost(&why);
        }
    }

    /// Reads the initial state. Calls are refused until it is known: a call that waits for it would
    /// be carried out in a state that its caller did not see.
    async fn first_without(&mut self, orders: &mut mpsc::Receiver<Order>) {
        let first = self.first();
        tokio::pin!(first);
        loop {
            tokio::select! {
                biased;
                () = &mut first => break,
                Some(order) = orders.recv() => order.refuse(),
            }
        }
        while let Ok(order) = orders.try_recv() {
            order.refuse();
        }
    }

    /// Reads the initial state.
    async fn first(&mut self) {
        while let Err(fault) = self.read_first().await {
            debug!("a skill does not say how it is: {fault}");
            sleep(LOOK).await;
        }
        self.tell(SkillEvent::Step);
    }

    /// Reads the state, and the last outcome of a skill that is not at work.
    async fn read_first(&mut self) -> Result<(), SkillFault> {
        let (state, since) = self.handle.seen().await?;
        self.states.read(since);
        self.now.state = state.state;
        self.now.progress = state.progress;
        self.now.step = state.step;
        let is_at_work = is_work(self.now.state);
        self.now.run = match (state.run, is_at_work) {
            // A run without a number is in progress.
            (0, true) => self.number(),
            (run, _) => run,
        };
        if is_at_work {
            return Ok(());
        }
        let read = self.outcome(self.now.state).await;
        self.last_outcome(read)
    }

    /// Takes the outcome of the run before this program saw the skill. If it is unknown, a skill
    /// that is Halted needs a Reset. An outcome of another run counts as unknown.
    ///
    /// # Errors
    /// The outcome could not be read, so it has to be read again.
    fn last_outcome(&mut self, read: Result<RunOutcome, SkillFault>) -> Result<(), SkillFault> {
        let outcome = match read {
            Ok(outcome) => outcome,
            Err(SkillFault::Unexpected(why)) => unknown(self.now.run, why),
            Err(
                fault @ (SkillFault::Lost(_)
                | SkillFault::Refused { .. }
                | SkillFault::TimedOut(_)
                | SkillFault::NotHalted(_)),
            ) => return Err(fault),
        };
        let is_halted = self.now.state == ProgramMachineState::Halted;
        // A skill that has had no run has no outcome.
        if self.now.run > 0 || (outcome.unknown && is_halted) {
            let outcome = self.outcomes.keep(outcome);
            self.now.end(&outcome);
            self.now.needs_reset &= is_halted;
            self.tell(SkillEvent::Outcome(&outcome));
        }
        Ok(())
    }

    async fn look(&mut self) {
        self.look_at = Instant::now() + LOOK;
        if let Ok((state, since)) = self.handle.seen().await {
            self.states.read(since);
            self.go(state.state).await;
        }
    }

    async fn take(&mut self, part: SkillAspect, value: &DataValue) {
        let Some(said) = &value.value else {
            return;
        };
        match part {
            SkillAspect::State => self.state(said, value).await,
            SkillAspect::Progress => {
                let progress = from_variant(said).and_then(|value| value.as_f64());
                if let Some(progress) = progress.filter(|progress| !progress.is_nan()) {
                    // Between 0 and 1, so the conversion is safe.
                    #[expect(clippy::cast_possible_truncation, reason = "a share of 1")]
                    let progress = progress.clamp(0.0, 1.0) as f32;
                    self.now.progress = progress;
                    self.tell(SkillEvent::Progress);
                }
            }
            SkillAspect::Step => {
                if let Some(SkillValue::String(step)) = from_variant(said)
                    && step != self.now.step
                {
                    self.now.step = step;
                    self.tell(SkillEvent::Step);
                }
            }
        }
    }

    async fn state(&mut self, said: &Variant, value: &DataValue) {
        let Some(state) = state_in(said) else {
            return;
        };
        let at = value.source_timestamp.map(|at| at.ticks());
        match self.states.notified(state == self.now.state, at) {
            StateNotice::Known => {}
            StateNotice::Entered => self.go(state).await,
            StateNotice::Unclear => self.look().await,
        }
    }

    async fn order(&mut self, order: Order) {
        let Order {
            method,
            parameters,
            is_cautious,
            condition,
            reply,
        } = order;
        let is_wanted = || {
            let is_met = condition.as_ref().is_none_or(|is_met| is_met());
            !is_motion(method) || (is_met && !reply.is_closed())
        };
        let called = match is_wanted() {
            true => {
                self.call(method, (parameters, is_cautious), &is_wanted)
                    .await
            }
            false => Err(withdrawn(method)),
        };
        let begun = called.is_ok() && is_work(self.now.state);
        // The caller may have stopped waiting.
        let _told = reply.send(called);
        if begun {
            // Observers that read the state after the reply are notified too.
            self.tell(SkillEvent::Step);
        }
    }

    async fn call(
        &mut self,
        method: ProgramMethod,
        (parameters, is_cautious): (Vec<(String, SkillValue)>, bool),
        is_wanted: &(impl Fn() -> bool + Sync),
    ) -> Result<u32, SkillFault> {
        // The state machine is checked here, because some servers accept invalid calls, for example
        // Start of a suspended skill.
        self.look().await;
        let from = self.now.state;
        let is_without_look = method == ProgramMethod::Start || is_cautious;
        if from == ProgramMachineState::Halted && self.now.needs_reset && is_without_look {
            let refusal = SkillRefusal::unknown_outcome(self.now.run);
            return Err(refused(&refusal.text));
        }
        let Some(to) = leads_to(from, method) else {
            return Err(refused(&format!(
                "{method} is not possible in the state {from}"
            )));
        };
        // The caller may have given up while the state was read.
        if !is_wanted() {
            return Err(withdrawn(method));
        }
        if method == ProgramMethod::Start {
            self.handle.start(parameters).await?;
            self.look_at = Instant::now() + LOOK;
            // The server may show the state before or after its response.
            self.go(to).await;
            let read = self.handle.seen().await.ok();
            let read = read.map(|(state, at)| (state.state, at));
            let is_of_run = read.map(|(state, at)| (is_work(state), at));
            if self.states.started(is_of_run)
                && let Some((state, _)) = read
            {
                self.go(state).await;
            }
        } else {
            self.handle.call(method).await?;
            if let Ok((state, at)) = self.handle.seen().await
                && state.state != from
            {
                self.states.called(at);
                self.go(state.state).await;
            }
        }
        Ok(self.now.run)
    }

    /// Reports all transitions between the shown state and this state.
    async fn go(&mut self, to: ProgramMachineState) {
        for transition in way(self.now.state, to) {
            self.pass(transition).await;
        }
    }

    async fn pass(&mut self, transition: &'static Transition) {
        let begins = (transition.from, transition.to)
            == (ProgramMachineState::Ready, ProgramMachineState::Running);
        let ends = is_work(transition.from) && !is_work(transition.to);
        let mut message = String::new();
        if begins {
            self.now.progress = 0.0;
            self.now.step.clear();
            self.now.run = match self.handle.run_id().await {
                0 => self.number(),
                run => run,
            };
            let parameters = Arc::new(Parameters::shown(self.handle.parameters().await));
            self.now.parameters = Arc::clone(&parameters);
            self.tell(SkillEvent::Parameters(&parameters));
        }
        if ends {
            let outcome = self.outcomes.keep(self.ended(transition.to).await);
            message.clone_from(&outcome.message);
            self.now.end(&outcome);
            self.tell(SkillEvent::Outcome(&outcome));
        }
        self.now.enter(transition, clock());
        let happened = Transitioned {
            transition,
            run: self.now.run,
            message,
            at: self.now.since,
        };
        self.tell(SkillEvent::Transition(&happened));
    }

    /// Reads the outcome of the run that the server left for this state; unknown if it cannot be
    /// read.
    async fn ended(&self, state: ProgramMachineState) -> RunOutcome {
        let outcome = self.outcome(state).await;
        outcome.unwrap_or_else(|fault| unknown(self.now.run, fault.to_string()))
    }

    /// Reads the outcome of the run that the server left for this state.
    async fn outcome(&self, state: ProgramMachineState) -> Result<RunOutcome, SkillFault> {
        let run = self.now.run;
        let numbered = if self.handle.numbers_runs() { run } else { 0 };
        let mut outcome = self.handle.outcome(numbered, state).await?;
        outcome.run = run;
        if !outcome.succeeded && outcome.message.is_empty() {
            outcome.message = format!("it ended in {state}, which says nothing of why");
        }
        Ok(outcome)
    }

    /// Returns the number of a run that the server does not number.
    fn number(&mut self) -> u32 {
        let number = self.next_run;
        self.next_run = number.wrapping_add(1).max(1);
        number
    }

    fn tell(&self, what: SkillEvent<'_>) {
        self.shown.send_replace(Arc::new(self.now.clone()));
        for observer in &self.observers {
            observer.told(what, &self.now);
        }
    }
}

impl Order {
    /// Refuses the call, because the state of the skill is not known yet.
    fn refuse(self) {
        let text = format!(
            "the state of the skill is not known yet; call {} again",
            self.method
        );
        // The caller may have stopped waiting.
        let _told = self.reply.send(Err(refused(&text)));
    }
}

fn unknown(run: u32, message: String) -> RunOutcome {
    RunOutcome {
        run,
        succeeded: false,
        unknown: true,
        message,
        results: Vec::new(),
        trace: Vec::new(),
    }
}

/// Returns whether a method lets the machine move.
fn is_motion(method: ProgramMethod) -> bool {
    match method {
        ProgramMethod::Start | ProgramMethod::Resume => true,
        ProgramMethod::Suspend | ProgramMethod::Halt | ProgramMethod::Reset => false,
    }
}

/// Refuses a call that its caller has given up. The call was not sent to the server.
fn withdrawn(method: ProgramMethod) -> SkillFault {
    SkillFault::Refused {
        status: "BadRequestCancelledByClient".to_owned(),
        text: format!("{method} was withdrawn or came too late, so it was not sent"),
    }
}

fn refused(text: &str) -> SkillFault {
    SkillFault::Refused {
        status: "BadInvalidState".to_owned(),
        text: text.to_owned(),
    }
}

/// Interval in which a running skill is polled, in case its server does not notify changes.
const LOOK: Duration = Duration::from_secs(1);

#[cfg(test)]
mod tests {
    use tokio::sync::oneshot;

    use super::super::super::tests::{client, serve};
    use super::super::StartCondition;
    use super::*;

    #[tokio::test(flavor = "multi_thread", worker_threads = 2)]
    async fn a_goal_and_a_start_leave_a_skill_halted_after_an_unknown_outcome() {
        let server = serve("parallel-gripper.yaml", &[]);
        let client = client(&server).await;
        let found = client.skills().await.unwrap();
        let handle = client.handle(&found[0]);
        let (mut seen, _shown) = SeenSkill::new(handle, Vec::new(), NewestOutcomes::default(), 1);
        seen.first().await;
        assert_eq!(seen.now.state, ProgramMachineState::Halted);
        seen.now.needs_reset = true;
        for (method, is_cautious) in [(ProgramMethod::Reset, true), (ProgramMethod::Start, false)] {
            let refused = seen.call(method, (Vec::new(), is_cautious), &|| true).await;
            let text = refused.unwrap_err().to_string();
            let expected = "the outcome of run 0 is unknown; Reset makes the skill ready";
            assert!(text.contains(expected), "{text}");
        }
        assert_eq!(seen.now.state, ProgramMachineState::Halted);
        let given = (Vec::new(), false);
        let reset = seen.call(ProgramMethod::Reset, given, &|| true).await;
        assert_eq!(reset, Ok(0));
        assert!(!seen.now.needs_reset);
        server.stop().await;
    }

    #[tokio::test(flavor = "multi_thread", worker_threads = 2)]
    async fn a_start_that_its_caller_gave_up_is_not_sent() {
        let server = serve("parallel-gripper.yaml", &[]);
        let client = client(&server).await;
        let found = client.skills().await.unwrap();
        let handle = client.handle(&found[0]);
        let (mut seen, _shown) = SeenSkill::new(handle, Vec::new(), NewestOutcomes::default(), 1);
        seen.first().await;
        let given = || (Vec::new(), false);
        let reset = seen.call(ProgramMethod::Reset, given(), &|| true).await;
        assert_eq!(reset, Ok(0));
        let start = |condition: Option<StartCondition>| {
            let (reply, answer) = oneshot::channel();
            let order = Order {
                method: ProgramMethod::Start,
                parameters: Vec::new(),
                is_cautious: false,
                condition,
                reply,
            };
            (order, answer)
        };
        // The caller gave up while the call waited in the queue.
        let (order, answer) = start(None);
        drop(answer);
        seen.order(order).await;
        // The goal was cancelled while the call waited in the queue.
        let (order, answer) = start(Some(Box::new(|| false)));
        seen.order(order).await;
        let refused = answer.await.unwrap();
        assert_eq!(refused, Err(withdrawn(ProgramMethod::Start)));
        // The caller gives up while the state is read.
        let refused = seen.call(ProgramMethod::Start, given(), &|| false).await;
        assert_eq!(refused, Err(withdrawn(ProgramMethod::Start)));
        let shown = server.skills()[0].shown();
        assert_eq!((shown.state, shown.run), (ProgramMachineState::Ready, 0));
        let (order, answer) = start(Some(Box::new(|| true)));
        seen.order(order).await;
        assert_eq!(answer.await.unwrap(), Ok(1));
        server.stop().await;
    }

    #[tokio::test(flavor = "multi_thread", worker_threads = 2)]
    async fn an_outcome_that_could_not_be_read_at_first_is_read_again() {
        let server = serve("parallel-gripper.yaml", &[]);
        let client = client(&server).await;
        let found = client.skills().await.unwrap();
        let handle = client.handle(&found[0]);
        let (mut seen, _shown) = SeenSkill::new(handle, Vec::new(), NewestOutcomes::default(), 1);
        for fault in [SkillFault::Lost("no answer".to_owned()), refused("busy")] {
            assert_eq!(seen.last_outcome(Err(fault.clone())), Err(fault));
            assert!(!seen.now.needs_reset && seen.now.outcome.is_none());
        }
        let mismatch = SkillFault::Unexpected("its outcome is of another run than 3".to_owned());
        assert_eq!(seen.last_outcome(Err(mismatch)), Ok(()));
        assert!(seen.now.needs_reset);
        server.stop().await;
    }
}
