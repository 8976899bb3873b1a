//! What becomes of a Program: the goal that it has sent, and the state that follows.

use std::sync::Arc;
use std::time::Duration;

use bridge_node::AskErrorKind;
use opcua::sync::Mutex;
use opcua::types::{ByteString, DateTime, NodeId, StatusCode, Variant};
use program::{Ending, Method, Nature, Program, Rest, RunId, State};
use tokio::sync::watch;
use tokio::time::{sleep, timeout};
use tracing::info;
use uadp::Fields;

use super::nodes::{Nodes, Outcome};
use crate::asking::{Callable, Drive, Questions, Refused};
use crate::value;

/// One Program. Of all its methods one is carried out at a time.
pub(crate) struct Run {
    name: String,
    nodes: Nodes,
    send: Callable,
    cancel: Callable,
    result: Callable,
    inner: Mutex<Inner>,
    /// The state, for who waits for another; closed never.
    state: watch::Sender<State>,
}

struct Inner {
    program: Program,
    /// The goal that is at work, or is being sent.
    goal: Option<ByteString>,
    /// It is being sent: nothing else may be called.
    starting: bool,
    halting: bool,
    /// The action is gone.
    left: bool,
}

impl Run {
    /// A Program that is ready.
    pub(super) fn new(
        name: String,
        nodes: Nodes,
        [send, cancel, result]: [Callable; 3],
    ) -> Arc<Self> {
        let mut program = Program::new(Nature {
            can_suspend: false,
            rests_in: Rest::Ready,
        });
        // Nobody has to make ready what is there.
        let _ready = program.call(Method::Reset);
        let (state, _) = watch::channel(program.state());
        nodes.show_first(program.state());
        Arc::new(Self {
            name,
            nodes,
            send,
            cancel,
            result,
            inner: Mutex::new(Inner {
                program,
                goal: None,
                starting: false,
                halting: false,
                left: false,
            }),
            state,
        })
    }

    /// A method of it, for clients that may call the Method at `goal`.
    pub(super) fn drive(
        self: &Arc<Self>,
        method: Method,
        questions: &Questions,
        goal: NodeId,
    ) -> Drive {
        let (run, questions) = (Arc::clone(self), questions.clone());
        Drive {
            goal,
            carry_out: Arc::new(move |arguments| {
                let called = Arc::clone(&run).call(method, arguments, questions.clone());
                Box::pin(called)
            }),
        }
    }

    async fn call(
        self: Arc<Self>,
        method: Method,
        arguments: Vec<Variant>,
        questions: Questions,
    ) -> Result<Vec<Variant>, Refused> {
        match method {
            Method::Start => self.start(arguments, questions).await,
            Method::Halt => self.halt(&questions).await,
            Method::Reset => self.reset(),
            Method::Suspend | Method::Resume => Err(NOT_NOW_AND_NEVER),
        }
    }

    pub(super) const fn nodes(&self) -> &Nodes {
        &self.nodes
    }

    /// Sends a goal, and is running once that is accepted.
    async fn start(
        self: Arc<Self>,
        arguments: Vec<Variant>,
        questions: Questions,
    ) -> Result<Vec<Variant>, Refused> {
        // Behind the id that we choose.
        let most = self.send.description().request.len().saturating_sub(1);
        if arguments.len() > most {
            return Err(Refused::Status(StatusCode::BadTooManyArguments));
        }
        let id = opcua::crypto::random::byte_string(16);
        {
            let mut inner = self.inner.lock();
            if inner.left || inner.starting || !inner.program.is_executable(Method::Start) {
                return Err(Refused::Status(StatusCode::BadInvalidState));
            }
            inner.starting = true;
            // Feedback may come before the answer.
            inner.goal = Some(id.clone());
        }
        let mut goal = vec![Variant::from(id.clone())];
        goal.extend(arguments);
        let answer = self.send.call(&goal, &questions, || false).await;
        let accepted = match answer {
            Ok(answer) => self.is_accepted(&answer),
            Err(refused) => {
                if is_unknown(&refused) {
                    // It may be at work, and nobody would follow it.
                    drop(self.ask_to_cancel(&id, &questions).await);
                }
                Err(in_terms_of_start(refused))
            }
        };
        let run = {
            let mut inner = self.inner.lock();
            inner.starting = false;
            if let Err(refused) = accepted {
                inner.goal = None;
                return Err(refused);
            }
            if inner.left {
                return Err(Refused::Status(StatusCode::BadNoCommunication));
            }
            let started = inner.program.call(Method::Start);
            let transition = started.map_err(|_| Refused::Status(StatusCode::BadInvalidState))?;
            inner.halting = false;
            self.nodes.show_goal(&id);
            self.nodes
                .show_transition(transition, "the goal is accepted");
            self.state.send_replace(inner.program.state());
            inner.program.run()
        };
        if let Some(run) = run {
            tokio::spawn(Arc::clone(&self).follow(id.clone(), run, questions));
        }
        Ok(vec![Variant::from(id)])
    }

    fn is_accepted(&self, answer: &[Variant]) -> Result<(), Refused> {
        match answer {
            [Variant::Boolean(true), ..] => Ok(()),
            [Variant::Boolean(false), rest @ ..] => {
                let why = rest.last().map(ToString::to_string).unwrap_or_default();
                info!(program = self.name, "a goal is rejected: {why}");
                Err(Refused::Status(StatusCode::BadRequestNotAllowed))
            }
            _ => Err(Refused::Status(StatusCode::BadDecodingError)),
        }
    }

    /// Waits for the end of a goal.
    async fn follow(self: Arc<Self>, id: ByteString, run: RunId, questions: Questions) {
        let mut pause = FIRST_PAUSE;
        loop {
            let asked = [Variant::from(id.clone())];
            match self.result.call(&asked, &questions, || false).await {
                Ok(answer) => return self.ended(run, Outcome::of(answer)),
                Err(Refused::Asked(error)) if error.kind == AskErrorKind::Failed => {
                    return self.ended(run, Outcome::lost(error.text));
                }
                Err(Refused::Arguments(_)) => {
                    let why = "the result cannot be asked for".to_owned();
                    return self.ended(run, Outcome::lost(why));
                }
                // It goes on, or nobody is heard for the moment; when it is gone for good, so is the action.
                Err(Refused::Status(_) | Refused::Asked(_)) => {}
            }
            if self.inner.lock().left {
                return;
            }
            sleep(pause).await;
            pause = (pause * 2).min(LAST_PAUSE);
        }
    }

    fn ended(&self, run: RunId, outcome: Outcome) {
        let mut inner = self.inner.lock();
        if inner.left {
            return;
        }
        let halted = inner.halting && outcome.status == CANCELED;
        let message = outcome.said();
        let ended = match outcome.status {
            _ if inner.program.run() != Some(run) => return,
            SUCCEEDED => inner.program.ended(run, Ending::Success).ok(),
            _ if halted => inner.program.call(Method::Halt).ok(),
            _ => inner.program.ended(run, Ending::Failure).ok(),
        };
        inner.goal = None;
        inner.halting = false;
        // Whoever sees the state change can read what came out.
        self.nodes.show_outcome(&outcome);
        if let Some(transition) = ended {
            self.nodes.show_transition(transition, &message);
        }
        self.state.send_replace(inner.program.state());
    }

    /// Has the goal cancelled, and waits until it is. One that is ready is so no longer.
    async fn halt(&self, questions: &Questions) -> Result<Vec<Variant>, Refused> {
        let id = {
            let mut inner = self.inner.lock();
            if inner.left || inner.starting || !inner.program.is_executable(Method::Halt) {
                return Err(Refused::Status(StatusCode::BadInvalidState));
            }
            match inner.goal.clone() {
                Some(id) => {
                    inner.halting = true;
                    id
                }
                None => return self.called(&mut inner, Method::Halt),
            }
        };
        match self.ask_to_cancel(&id, questions).await {
            Ok(AGREED | TERMINATED) => {}
            refused => {
                self.inner.lock().halting = false;
                refused?;
                info!(program = self.name, "its action server does not cancel");
                return Err(Refused::Status(StatusCode::BadRequestNotAllowed));
            }
        }
        let mut state = self.state.subscribe();
        let ends = timeout(HALTS_WITHIN, state.wait_for(|now| *now != State::Running));
        match ends.await {
            Ok(_) => Ok(Vec::new()),
            Err(_) => Err(Refused::Status(StatusCode::BadTimeout)),
        }
    }

    /// The `return_code` of `action_msgs/CancelGoal`.
    async fn ask_to_cancel(&self, id: &ByteString, questions: &Questions) -> Result<i64, Refused> {
        let asked = [Variant::from(id.clone()), Variant::from(DateTime::null())];
        let answer = self.cancel.call(&asked, questions, || false).await?;
        let code = answer.first().and_then(whole);
        code.ok_or(Refused::Status(StatusCode::BadDecodingError))
    }

    fn reset(&self) -> Result<Vec<Variant>, Refused> {
        let mut inner = self.inner.lock();
        if inner.left || inner.starting {
            return Err(Refused::Status(StatusCode::BadInvalidState));
        }
        self.called(&mut inner, Method::Reset)
    }

    fn called(&self, inner: &mut Inner, method: Method) -> Result<Vec<Variant>, Refused> {
        let transition = inner.program.call(method);
        let transition = transition.map_err(|_| Refused::Status(StatusCode::BadInvalidState))?;
        self.nodes.show_transition(transition, "");
        self.state.send_replace(inner.program.state());
        Ok(Vec::new())
    }

    /// The action is gone, and what it was at is nobody's any more.
    pub(super) fn leave(&self) {
        let mut inner = self.inner.lock();
        inner.left = true;
        let run = inner.program.run();
        let ended = run.and_then(|run| inner.program.ended(run, Ending::Failure).ok());
        if let Some(transition) = ended {
            let outcome = Outcome::lost(GONE.to_owned());
            self.nodes.show_outcome(&outcome);
            self.nodes.show_transition(transition, GONE);
        }
        self.state.send_replace(State::Halted);
    }

    /// Shows feedback, if it is of the goal that is at work.
    pub(super) fn reported(&self, block: &[u8]) {
        let Ok(fields) = Fields::parse(block) else {
            return;
        };
        let fields = fields.map(|field| field.map(|field| value::from_field(&field)));
        let Ok(fields) = fields.collect::<Result<Vec<Variant>, _>>() else {
            return;
        };
        let inner = self.inner.lock();
        if let Some((Variant::ByteString(id), rest)) = fields.split_first()
            && inner.goal.as_ref() == Some(id)
        {
            self.nodes.show_feedback(rest);
        }
    }
}

/// Whether the goal may be at work all the same.
fn is_unknown(refused: &Refused) -> bool {
    matches!(refused, Refused::Asked(error) if error.kind == AskErrorKind::Unknown)
}

/// The arguments of Start are those behind the id.
fn in_terms_of_start(refused: Refused) -> Refused {
    match refused {
        Refused::Arguments(mut statuses) => {
            statuses.drain(..statuses.len().min(1));
            Refused::Arguments(statuses)
        }
        Refused::Status(_) | Refused::Asked(_) => refused,
    }
}

/// A number of any width.
pub(super) fn whole(value: &Variant) -> Option<i64> {
    if let Variant::SByte(number) = value {
        Some((*number).into())
    } else if let Variant::Byte(number) = value {
        Some((*number).into())
    } else if let Variant::Int16(number) = value {
        Some((*number).into())
    } else if let Variant::Int32(number) = value {
        Some((*number).into())
    } else {
        None
    }
}

const NOT_NOW_AND_NEVER: Refused = Refused::Status(StatusCode::BadNotSupported);
const GONE: &str = "who executes the action is gone; the goal may go on";
/// Of `action_msgs/GoalStatus`.
pub(super) const SUCCEEDED: i64 = 4;
const CANCELED: i64 = 5;
/// Of `action_msgs/CancelGoal`: ERROR_NONE and ERROR_GOAL_TERMINATED.
const AGREED: i64 = 0;
const TERMINATED: i64 = 3;
/// How long a goal may take to end once it is being cancelled.
const HALTS_WITHIN: Duration = Duration::from_secs(30);
/// Before a result is asked for anew, doubling from the first to the last.
const FIRST_PAUSE: Duration = Duration::from_millis(100);
const LAST_PAUSE: Duration = Duration::from_secs(1);
