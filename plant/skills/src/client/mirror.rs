//! Mirrors of the skills of another server: reports their events like events of local skills.
//!
//! A server that implements only the Programs of OPC 10000-10 publishes the state of each. The
//! transitions, the runs and their ends are derived from the state. Run numbers are the server's if
//! it has them; otherwise they are counted here.

mod seen;
mod state_order;

use std::collections::VecDeque;
use std::fmt;
use std::sync::Arc;
use std::time::Duration;

use plant_opcua::client::{MonitoredWatch, Notice, Sampled};
use plant_opcua::types::NodeId;
use program::{ProgramMachineState, ProgramMethod, Rest, TRANSITIONS, Transition, TransitionCause};
use tokio::sync::{mpsc, oneshot, watch};
use tokio::task::JoinSet;

use self::seen::{SeenSkill, SkillAspect};
use super::found::{FoundParameter, FoundSkill};
use super::handle::{STATE_PATHS, state_in};
use super::packed::Packed;
use super::{SkillClient, lost};
use crate::description::SkillDescription;
use crate::outcomes::NewestOutcomes;
use crate::parameters::SkillParameter;
use crate::shown::{RunOutcome, SkillObserver, SkillSnapshot};
use crate::skill_fault::SkillFault;
use crate::value::SkillValue;

/// A skill of another server. Clones share the skill.
#[derive(Clone)]
pub struct MirroredSkill {
    facts: Arc<SkillDescription>,
    methods: Arc<[ProgramMethod]>,
    orders: mpsc::Sender<Order>,
    shown: watch::Receiver<Arc<SkillSnapshot>>,
    outcomes: NewestOutcomes,
}

impl fmt::Debug for MirroredSkill {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("Mirror").field(&self.facts.name).finish()
    }
}

/// The condition under which a run may start. A mirror evaluates it just before it calls Start.
pub type StartCondition = Box<dyn Fn() -> bool + Send + Sync>;

/// A call that waits to be sent to the server.
struct Order {
    method: ProgramMethod,
    parameters: Vec<(String, SkillValue)>,
    /// It must not reset a skill after an unknown outcome.
    is_cautious: bool,
    /// A call that moves the machine is not sent if this is false.
    condition: Option<StartCondition>,
    reply: oneshot::Sender<Result<u32, SkillFault>>,
}

/// The skills of a server for the lifetime of a connection. Dropping them ends the reports.
#[derive(Debug)]
pub struct Mirrors {
    skills: Vec<MirroredSkill>,
    gone: watch::Sender<Option<String>>,
    _tasks: JoinSet<()>,
}

/// The Programs of a server, including Programs that are not skills, with the connection over which
/// they were found.
#[derive(Clone)]
pub struct Watchable {
    client: SkillClient,
    found: Vec<(FoundSkill, Option<NodeId>)>,
}

impl fmt::Debug for Watchable {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_list().entries(self.found()).finish()
    }
}

impl Watchable {
    /// Reads all Programs of the server.
    ///
    /// # Errors
    /// No response.
    pub async fn of(client: SkillClient) -> Result<Self, SkillFault> {
        let found = client.programs().await?;
        let states = states(&client, &found).await?;
        let found = found.into_iter().zip(states).collect();
        Ok(Self { client, found })
    }

    /// Returns the Programs that were found.
    pub fn found(&self) -> impl Iterator<Item = &FoundSkill> {
        self.found.iter().map(|(found, _)| found)
    }

    /// Returns the reasons why the skill at index `at` cannot be used fully, as text for people.
    #[must_use]
    pub fn faults(&self, at: usize) -> Vec<String> {
        let found = self.found.get(at);
        found.map_or_else(Vec::new, |(found, state)| found.faults(state.is_some()))
    }

    /// Returns whether the state of the skill at index `at` can be observed.
    #[must_use]
    pub fn is_watchable(&self, at: usize) -> bool {
        self.found.get(at).is_some_and(|(_, state)| state.is_some())
    }

    /// Returns whether another query found the same skills.
    #[must_use]
    pub fn is_as(&self, other: &Self) -> bool {
        let same = |((one, state), (other, others)): (&Found, &Found)| {
            state == others && one.nodes == other.nodes && one.types == other.types
        };
        self.found.len() == other.found.len() && self.found.iter().zip(&other.found).all(same)
    }
}

type Found = (FoundSkill, Option<NodeId>);

impl Mirrors {
    /// Observes skills over the connection over which they were found. `observers` provides the
    /// observers of each skill, by its index. Runs of skills that do not number them are counted
    /// from `first_run`. Needs a tokio runtime.
    #[must_use]
    pub fn begin(
        of: &Watchable,
        first_run: u32,
        mut observers: impl FnMut(usize, &SkillDescription) -> Vec<Box<dyn SkillObserver>>,
    ) -> Self {
        let client = &of.client;
        let gone = watch::Sender::new(None);
        let mut tasks = JoinSet::new();
        let (mut skills, mut watches, mut ways) = (Vec::new(), Vec::new(), Vec::new());
        for (at, (found, state)) in of.found.iter().enumerate() {
            let facts = Arc::new(found.facts());
            let (orders, ordered) = mpsc::channel(MOST_ORDERS);
            let (tell, notices) = mpsc::channel(MOST_NOTICES);
            let parts = [
                (SkillAspect::Progress, "Progress"),
                (SkillAspect::Step, "SkillStep"),
            ];
            let parts = parts
                .into_iter()
                .filter_map(|(part, path)| Some((part, found.nodes.get(path)?.clone())));
            let told = state.clone().map(|node| (SkillAspect::State, node));
            for (part, node) in parts.chain(told) {
                watches.push(MonitoredWatch::Sampled(Sampled {
                    node,
                    interval: PUBLISHING,
                    queue: QUEUE,
                    deadband: 0.0,
                }));
                ways.push((part, tell.clone()));
            }
            let outcomes = NewestOutcomes::default();
            let observers = observers(at, &facts);
            let (seen, shown) =
                SeenSkill::new(client.handle(found), observers, outcomes.clone(), first_run);
            tasks.spawn(seen.run(notices, ordered, gone.subscribe()));
            skills.push(MirroredSkill {
                facts,
                methods: found.methods().into(),
                orders,
                shown,
                outcomes,
            });
        }
        let mut subscription = client.client.subscribe(watches, PUBLISHING, MOST_NOTICES);
        tasks.spawn(async move {
            while let Some(notice) = subscription.next().await {
                if let Notice::Value { watch, value } = notice
                    && let Some((part, way)) = ways.get(watch)
                    && way.send((*part, value)).await.is_err()
                {
                    // The mirror has been lost meanwhile.
                    continue;
                }
            }
        });
        Self {
            skills,
            gone,
            _tasks: tasks,
        }
    }

    /// Returns the skills in the order of the [`Watchable`].
    #[must_use]
    pub fn skills(&self) -> &[MirroredSkill] {
        &self.skills
    }

    /// Reports the loss of the connection to the observers; further calls are refused.
    pub fn lose(&self, why: &str) {
        self.gone.send_replace(Some(why.to_owned()));
    }
}

impl MirroredSkill {
    /// Returns the description of the skill.
    #[must_use]
    pub fn facts(&self) -> &Arc<SkillDescription> {
        &self.facts
    }

    /// Returns the methods of the skill.
    #[must_use]
    pub fn methods(&self) -> &[ProgramMethod] {
        &self.methods
    }

    /// Returns the current state of the skill.
    #[must_use]
    pub fn shown(&self) -> Arc<SkillSnapshot> {
        self.shown.borrow().clone()
    }

    /// Returns the outcome of a run, if it is one of the newest observed runs.
    #[must_use]
    pub fn outcome(&self, run: u32) -> Option<Arc<RunOutcome>> {
        self.outcomes.of(run)
    }

    /// Calls a method; the parameters are written before Start. Returns the number of the newest
    /// run.
    ///
    /// # Errors
    /// A refusal by the state machine of OPC 10000-10 or by the server, or the loss of the server.
    /// A call is refused until the state of the skill has been read.
    pub async fn call(
        &self,
        method: ProgramMethod,
        parameters: Vec<(String, SkillValue)>,
    ) -> Result<u32, SkillFault> {
        self.order(method, (parameters, false), None).await
    }

    /// Calls Start as [`call`](Self::call) does, if the condition is true when the call is sent.
    ///
    /// # Errors
    /// As [`call`](Self::call); the condition is false, so no run was started.
    pub async fn start_if(
        &self,
        condition: StartCondition,
        parameters: Vec<(String, SkillValue)>,
    ) -> Result<u32, SkillFault> {
        let given = (parameters, false);
        self.order(ProgramMethod::Start, given, Some(condition))
            .await
    }

    /// Resets a skill that is Halted, unless its last outcome is unknown.
    ///
    /// # Errors
    /// As [`call`](Self::call); the last outcome is unknown.
    pub async fn make_ready(&self) -> Result<u32, SkillFault> {
        let given = (Vec::new(), true);
        self.order(ProgramMethod::Reset, given, None).await
    }

    async fn order(
        &self,
        method: ProgramMethod,
        (parameters, is_cautious): (Vec<(String, SkillValue)>, bool),
        condition: Option<StartCondition>,
    ) -> Result<u32, SkillFault> {
        let (reply, answer) = oneshot::channel();
        let order = Order {
            method,
            parameters,
            is_cautious,
            condition,
            reply,
        };
        match self.orders.try_send(order) {
            Ok(()) => {}
            Err(mpsc::error::TrySendError::Full(_)) => {
                return Err(SkillFault::Refused {
                    status: "BadTooManyOperations".to_owned(),
                    text: "too many calls of this skill wait already".to_owned(),
                });
            }
            Err(mpsc::error::TrySendError::Closed(_)) => return Err(is_lost()),
        }
        answer.await.unwrap_or_else(|_| Err(is_lost()))
    }
}

fn is_lost() -> SkillFault {
    SkillFault::Lost("there is no connection".to_owned())
}

impl FoundSkill {
    /// Returns the description of the skill, as far as its server provides it.
    #[must_use]
    pub fn facts(&self) -> SkillDescription {
        let declared = |of: &[FoundParameter]| of.iter().map(parameter).collect();
        SkillDescription {
            name: self.name.clone(),
            types: self.types.iter().map(|of| of.name.clone()).collect(),
            parameters: declared(&self.parameters),
            results: declared(&self.results),
            capabilities: self.capabilities.clone(),
            timeout: None,
            rests_in: Rest::Ready,
        }
    }

    /// Returns the methods of a Program that the skill has.
    #[must_use]
    pub fn methods(&self) -> Vec<ProgramMethod> {
        let has = |method: &ProgramMethod| self.nodes.get(method.name()).is_some();
        ProgramMethod::ALL.into_iter().filter(has).collect()
    }

    /// Returns the reasons why the skill cannot be used fully.
    fn faults(&self, tells_state: bool) -> Vec<String> {
        let mut faults = self.strange.clone();
        if !tells_state {
            faults.push(
                "its CurrentState is none of a Program: neither its Id, its text nor its number tells which one"
                    .to_owned(),
            );
        }
        let missing = |method: &&str| self.nodes.get(method).is_none();
        let missing: Vec<&str> = NEEDED.iter().copied().filter(missing).collect();
        if !missing.is_empty() {
            faults.push(format!("it has no {}", missing.join(", no ")));
        }
        faults
    }
}

/// Returns the variable that holds the state of each skill, if there is one.
async fn states(
    client: &SkillClient,
    found: &[FoundSkill],
) -> Result<Vec<Option<NodeId>>, SkillFault> {
    let nodes: Vec<Vec<NodeId>> = found
        .iter()
        .map(|found| {
            let paths = STATE_PATHS.iter();
            paths
                .filter_map(|path| found.nodes.get(path).cloned())
                .collect()
        })
        .collect();
    let all: Vec<NodeId> = nodes.iter().flatten().cloned().collect();
    let read = client
        .client
        .read(&all)
        .await
        .map_err(|error| lost(&error))?;
    let mut values = read.into_iter();
    let each = nodes.into_iter().map(|nodes| {
        let mut tells = None;
        for node in nodes {
            let value = values.next().and_then(|value| value.value);
            if tells.is_none() && value.as_ref().and_then(state_in).is_some() {
                tells = Some(node);
            }
        }
        tells
    });
    Ok(each.collect())
}

fn parameter(of: &FoundParameter) -> SkillParameter {
    SkillParameter {
        name: of.name.clone(),
        shape: of.shape,
        length: of.packed.and_then(Packed::length),
        default: of.default.clone(),
        unit: of.unit.clone(),
        range: None,
        about: String::new(),
    }
}

/// Returns the shortest sequence of transitions from one state to another, for states that were not
/// observed in between.
fn way(from: ProgramMachineState, to: ProgramMachineState) -> Vec<&'static Transition> {
    let mut ways: VecDeque<(ProgramMachineState, Vec<&'static Transition>)> =
        VecDeque::from([(from, Vec::new())]);
    let mut known = vec![from];
    while let Some((at, way)) = ways.pop_front() {
        if at == to {
            return way;
        }
        for next in TRANSITIONS.iter().filter(|next| next.from == at) {
            if !known.contains(&next.to) {
                known.push(next.to);
                let further = way.iter().copied().chain([next]).collect();
                ways.push_back((next.to, further));
            }
        }
    }
    Vec::new()
}

/// Returns the state to which a method leads from a state, if the method is possible there.
fn leads_to(from: ProgramMachineState, method: ProgramMethod) -> Option<ProgramMachineState> {
    let mut transitions = TRANSITIONS.iter();
    let found = transitions.find(|one| {
        let by_method = match one.cause {
            TransitionCause::Method(cause) | TransitionCause::MethodOrWork(cause) => {
                cause == method
            }
            TransitionCause::Work => false,
        };
        by_method && one.from == from
    });
    found.map(|one| one.to)
}

/// Methods without which a skill cannot be run.
const NEEDED: [&str; 3] = ["Start", "Halt", "Reset"];
/// Sampling and publishing interval.
const PUBLISHING: Duration = Duration::from_millis(20);
/// Queue size of a monitored item.
const QUEUE: u32 = 64;
/// Maximum number of waiting calls of a skill.
const MOST_ORDERS: usize = 16;
/// Maximum number of waiting notifications of a skill.
const MOST_NOTICES: usize = 256;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_was_not_seen_between_two_states_is_the_shortest_way() {
        let names = |from, to| -> Vec<&str> { way(from, to).iter().map(|one| one.name).collect() };
        assert_eq!(
            names(ProgramMachineState::Halted, ProgramMachineState::Running),
            ["HaltedToReady", "ReadyToRunning"]
        );
        assert_eq!(
            names(ProgramMachineState::Ready, ProgramMachineState::Suspended),
            ["ReadyToRunning", "RunningToSuspended"]
        );
        assert_eq!(
            names(ProgramMachineState::Suspended, ProgramMachineState::Ready),
            ["SuspendedToReady"]
        );
        assert!(names(ProgramMachineState::Ready, ProgramMachineState::Ready).is_empty());
        for from in ProgramMachineState::ALL {
            for to in ProgramMachineState::ALL {
                let way = way(from, to);
                let ends = way.last().map_or(from, |last| last.to);
                assert_eq!(ends, to, "{from} {to}");
            }
        }
    }

    #[test]
    fn eight_of_twenty_calls_lead_somewhere() {
        let all = ProgramMachineState::ALL
            .into_iter()
            .flat_map(|state| ProgramMethod::ALL.map(|method| leads_to(state, method)));
        assert_eq!(all.flatten().count(), 8);
        assert_eq!(
            leads_to(ProgramMachineState::Suspended, ProgramMethod::Start),
            None
        );
    }
}
