//! The skills of another server as they are seen from outside: what happens to each is told as of one that is executed here.
//!
//! A server that knows Programs of OPC 10000-10 and nothing more says in what state each is. The transitions, the runs and their
//! ends follow from that: where it has numbers for runs these are told, else they are counted here.

mod seen;

use std::collections::VecDeque;
use std::fmt;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use plant_opcua::client::{Notice, Sampled, Watch};
use plant_opcua::types::NodeId;
use program::{Cause, Method, Rest, State, TRANSITIONS, Transition};
use tokio::sync::{mpsc, oneshot, watch};
use tokio::task::JoinSet;

use self::seen::{Part, Seen};
use super::find::{FoundParameter, FoundSkill};
use super::handle::{STATE_PATHS, state_in};
use super::packed::Packed;
use super::{SkillClient, lost};
use crate::parameters::Parameter;
use crate::runs::SkillFault;
use crate::shown::{Observer, Outcome, Shown};
use crate::skill::{Facts, lock};
use crate::value::Value;

/// A skill of another server. Clones are of the same one.
#[derive(Clone)]
pub struct Mirror {
    facts: Arc<Facts>,
    methods: Arc<[Method]>,
    orders: mpsc::Sender<Order>,
    shown: watch::Receiver<Arc<Shown>>,
    outcomes: Arc<Mutex<VecDeque<Arc<Outcome>>>>,
}

impl fmt::Debug for Mirror {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("Mirror").field(&self.facts.name).finish()
    }
}

/// A call on its way to the server.
#[derive(Debug)]
struct Order {
    method: Method,
    parameters: Vec<(String, Value)>,
    reply: oneshot::Sender<Result<u32, SkillFault>>,
}

/// The skills of one server for as long as there is one connection; dropped, nothing is told of them any more.
#[derive(Debug)]
pub struct Mirrors {
    skills: Vec<Mirror>,
    gone: watch::Sender<Option<String>>,
    _tasks: JoinSet<()>,
}

/// The Programs of a server, skills or not, that can be watched over the connection that they were found by.
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
    /// All that the server has.
    ///
    /// # Errors
    /// No answer.
    pub async fn of(client: SkillClient) -> Result<Self, SkillFault> {
        let found = client.programs().await?;
        let states = states(&client, &found).await?;
        let found = found.into_iter().zip(states).collect();
        Ok(Self { client, found })
    }

    /// What was found.
    pub fn found(&self) -> impl Iterator<Item = &FoundSkill> {
        self.found.iter().map(|(found, _)| found)
    }

    /// What of a skill cannot be used, and why, for people; by its place.
    #[must_use]
    pub fn faults(&self, at: usize) -> Vec<String> {
        let found = self.found.get(at);
        found.map_or_else(Vec::new, |(found, state)| found.faults(state.is_some()))
    }

    /// Whether it can be told in what state a skill is; by its place.
    #[must_use]
    pub fn is_watchable(&self, at: usize) -> bool {
        self.found.get(at).is_some_and(|(_, state)| state.is_some())
    }

    /// Whether another look has found the same.
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
    /// Watches skills over the connection that they were found by. `observers` are asked for those of each, by its place.
    /// Runs of skills that do not number them count from `first_run`. Needs a tokio runtime.
    #[must_use]
    pub fn begin(
        of: &Watchable,
        first_run: u32,
        mut observers: impl FnMut(usize, &Facts) -> Vec<Box<dyn Observer>>,
    ) -> Self {
        let client = &of.client;
        let gone = watch::Sender::new(None);
        let mut tasks = JoinSet::new();
        let (mut skills, mut watches, mut ways) = (Vec::new(), Vec::new(), Vec::new());
        for (at, (found, state)) in of.found.iter().enumerate() {
            let facts = Arc::new(found.facts());
            let (orders, ordered) = mpsc::channel(MOST_ORDERS);
            let (tell, notices) = mpsc::channel(MOST_NOTICES);
            let parts = [(Part::Progress, "Progress"), (Part::Step, "SkillStep")];
            let parts = parts
                .into_iter()
                .filter_map(|(part, path)| Some((part, found.nodes.get(path)?.clone())));
            let told = state.clone().map(|node| (Part::State, node));
            for (part, node) in parts.chain(told) {
                watches.push(Watch::Sampled(Sampled {
                    node,
                    interval: PUBLISHING,
                    queue: QUEUE,
                    deadband: 0.0,
                }));
                ways.push((part, tell.clone()));
            }
            let outcomes = Arc::default();
            let observers = observers(at, &facts);
            let (seen, shown) = Seen::new(
                client.handle(found),
                observers,
                Arc::clone(&outcomes),
                first_run,
            );
            tasks.spawn(seen.run(notices, ordered, gone.subscribe()));
            skills.push(Mirror {
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
                    // It has been lost meanwhile.
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

    /// In the order in which they were given.
    #[must_use]
    pub fn skills(&self) -> &[Mirror] {
        &self.skills
    }

    /// The connection is lost: whoever hears of runs is told, and no call is taken any more.
    pub fn lose(&self, why: &str) {
        self.gone.send_replace(Some(why.to_owned()));
    }
}

impl Mirror {
    /// What it is.
    #[must_use]
    pub fn facts(&self) -> &Arc<Facts> {
        &self.facts
    }

    /// The methods that it has.
    #[must_use]
    pub fn methods(&self) -> &[Method] {
        &self.methods
    }

    /// How it is now.
    #[must_use]
    pub fn shown(&self) -> Arc<Shown> {
        self.shown.borrow().clone()
    }

    /// How a run ended, of the newest ones that were seen.
    #[must_use]
    pub fn outcome(&self, run: u32) -> Option<Arc<Outcome>> {
        let outcomes = lock(&self.outcomes);
        outcomes.iter().find(|one| one.run == run).cloned()
    }

    /// Calls a method; Start is given these parameters first. Gives the number of the newest run.
    ///
    /// # Errors
    /// What the state machine of OPC 10000-10 or the server refuses, or that the server is lost.
    pub async fn call(
        &self,
        method: Method,
        parameters: Vec<(String, Value)>,
    ) -> Result<u32, SkillFault> {
        let (reply, answer) = oneshot::channel();
        let order = Order {
            method,
            parameters,
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
    /// What it is, as far as its server says.
    #[must_use]
    pub fn facts(&self) -> Facts {
        let declared = |of: &[FoundParameter]| of.iter().map(parameter).collect();
        Facts {
            name: self.name.clone(),
            types: self.types.iter().map(|of| of.name.clone()).collect(),
            parameters: declared(&self.parameters),
            results: declared(&self.results),
            capabilities: self.capabilities.clone(),
            timeout: None,
            rests_in: Rest::Ready,
        }
    }

    /// The methods that it has, of those of a Program.
    #[must_use]
    pub fn methods(&self) -> Vec<Method> {
        let has = |method: &Method| self.nodes.get(method.name()).is_some();
        Method::ALL.into_iter().filter(has).collect()
    }

    /// What of it cannot be used, and why.
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

/// The variable of each skill by which its state is known, where there is one.
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

fn parameter(of: &FoundParameter) -> Parameter {
    Parameter {
        name: of.name.clone(),
        shape: of.shape,
        length: of.packed.and_then(Packed::length),
        default: of.default.clone(),
        unit: of.unit.clone(),
        range: None,
        about: String::new(),
    }
}

/// The transitions that lead from one state to another, the fewest there are: what lies between them was not seen.
fn way(from: State, to: State) -> Vec<&'static Transition> {
    let mut ways: VecDeque<(State, Vec<&'static Transition>)> =
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

/// Where a method leads from a state, if it leads anywhere.
fn leads_to(from: State, method: Method) -> Option<State> {
    let mut transitions = TRANSITIONS.iter();
    let found = transitions.find(|one| {
        let by_method = match one.cause {
            Cause::Method(cause) | Cause::MethodOrWork(cause) => cause == method,
            Cause::Work => false,
        };
        by_method && one.from == from
    });
    found.map(|one| one.to)
}

/// Without these nobody runs a skill.
const NEEDED: [&str; 3] = ["Start", "Halt", "Reset"];
/// How often a server looks and tells of changes.
const PUBLISHING: Duration = Duration::from_millis(20);
/// Changes that it keeps until it tells them.
const QUEUE: u32 = 64;
/// So many calls of one skill may wait.
const MOST_ORDERS: usize = 16;
/// And so many changes of it.
const MOST_NOTICES: usize = 256;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_was_not_seen_between_two_states_is_the_shortest_way() {
        let names = |from, to| -> Vec<&str> { way(from, to).iter().map(|one| one.name).collect() };
        assert_eq!(
            names(State::Halted, State::Running),
            ["HaltedToReady", "ReadyToRunning"]
        );
        assert_eq!(
            names(State::Ready, State::Suspended),
            ["ReadyToRunning", "RunningToSuspended"]
        );
        assert_eq!(names(State::Suspended, State::Ready), ["SuspendedToReady"]);
        assert!(names(State::Ready, State::Ready).is_empty());
        for from in State::ALL {
            for to in State::ALL {
                let way = way(from, to);
                let ends = way.last().map_or(from, |last| last.to);
                assert_eq!(ends, to, "{from} {to}");
            }
        }
    }

    #[test]
    fn eight_of_twenty_calls_lead_somewhere() {
        let all = State::ALL
            .into_iter()
            .flat_map(|state| Method::ALL.map(|method| leads_to(state, method)));
        assert_eq!(all.flatten().count(), 8);
        assert_eq!(leads_to(State::Suspended, Method::Start), None);
    }
}
