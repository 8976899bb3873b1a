//! Keeps the master's knowledge of this node equal to what the node publishes, subscribes and offers.
//!
//! It compares what should be registered with what the master was told and settles the difference, so the order in
//! which topics and services come and go, a master that starts late, and one that restarts are the same case.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use log_limit::Throttle;
use tokio::task::JoinSet;
use tokio::time::{Instant, sleep, timeout};

use crate::clock;
use crate::events;
use crate::master::{self, Master, MasterError, Request};
use crate::node::{Inner, MasterState, Registration, ResourceKind};
use crate::parameters;
use crate::xmlrpc::Value;

/// Works until the node is closed and the master has been told.
pub(crate) async fn run(node: Arc<Inner>) {
    let mut chores = JoinSet::new();
    chores.spawn(check_hostname(node.hostname.clone()));
    let mut registrar = Registrar {
        node: Arc::clone(&node),
        told: HashMap::new(),
        pid: None,
        found: None,
        checked: None,
        compared: None,
        contested: None,
        contests: Throttle::new(Duration::from_secs(10)),
        refusals: Throttle::new(Duration::from_secs(30)),
    };
    let mut wait = TICK;
    loop {
        // Before the comparison: it then sees no more than what was there at closing.
        let closed = node.is_closed();
        match registrar.turn(closed).await {
            Ok(()) => {
                // While closing, a turn may have had nothing to ask the master.
                if !closed {
                    registrar.found();
                }
                wait = TICK;
            }
            Err(error) => {
                registrar.lost(&error);
                wait = if closed {
                    Duration::ZERO
                } else {
                    (wait * 2).min(LONGEST_WAIT)
                };
            }
        }
        if closed && registrar.told.is_empty() && node.params.is_empty() {
            node.settled.send_replace(true);
            return;
        }
        tokio::select! {
            () = node.changed.notified() => {}
            () = sleep(wait) => {}
        }
    }
}

struct Registrar {
    node: Arc<Inner>,
    /// What the master was told, whether or not it has answered yet.
    told: HashMap<(String, ResourceKind), Told>,
    pid: Option<i32>,
    /// `None` before the first try.
    found: Option<bool>,
    checked: Option<Instant>,
    /// When what the master lists was compared with what it was told.
    compared: Option<Instant>,
    /// Since when it is open whose name this node's is.
    contested: Option<Instant>,
    contests: Throttle,
    refusals: Throttle,
}

#[derive(Clone, Copy)]
struct Told {
    generation: u64,
    confirmed: bool,
}

enum Job {
    Register {
        registration: Registration,
        replaces: bool,
    },
    Unregister {
        name: String,
        kind: ResourceKind,
    },
}

type Outcome = ((String, ResourceKind), Option<u64>, Result<(), MasterError>);

impl Registrar {
    async fn turn(&mut self, closed: bool) -> Result<(), MasterError> {
        if !closed && let Some(contest) = self.node.contest() {
            self.decide(contest).await?;
        }
        let due = self.checked.is_none_or(|at| at.elapsed() >= TICK) || self.found != Some(true);
        if due && !closed {
            self.check().await?;
            self.checked = Some(clock::now());
        }
        // First of all: a program may read its own parameters as soon as the node is registered.
        if let Err(error) = parameters::settle(&self.node, &mut self.refusals).await {
            if closed {
                self.abandon(&error);
                for name in self.node.params.abandon() {
                    events::unregistration_failed(&name, &error);
                }
            }
            return Err(error);
        }
        let mut jobs = self.jobs();
        jobs.sort_by_key(Job::rank);
        let mut batches = batches(jobs).into_iter();
        let mut running: JoinSet<Result<Vec<Outcome>, MasterError>> = JoinSet::new();
        let mut failure = None;
        loop {
            while failure.is_none()
                && running.len() < PARALLEL
                && (closed || self.node.may_register())
                && let Some(batch) = batches.next()
            {
                running.spawn(perform(Arc::clone(&self.node), batch));
            }
            let Some(finished) = running.join_next().await else {
                break;
            };
            let noted = match finished {
                Ok(Ok(outcomes)) => outcomes.into_iter().try_for_each(|one| self.note(one)),
                Ok(Err(error)) => Err(error),
                // It was aborted with the node's runtime.
                Err(_) => Ok(()),
            };
            if let Err(error) = noted {
                failure = Some(error);
            }
        }
        if closed && let Some(error) = &failure {
            self.abandon(error);
        }
        failure.map_or(Ok(()), Err)
    }

    /// Gives up and names what the master may still have: nobody is there to be told.
    fn abandon(&mut self, error: &MasterError) {
        for (name, _) in self.told.drain().map(|(key, _)| key) {
            events::unregistration_failed(&name, error);
        }
    }

    /// Finds out whether the master is there, is the same as before, and still knows this node.
    async fn check(&mut self) -> Result<(), MasterError> {
        let master = &self.node.master;
        let pid = master.pid().await?;
        let other = self.pid.replace(pid).is_some_and(|before| before != pid);
        let mut forgotten = other;
        let known =
            self.node.params.any_subscribed() || self.told.values().any(|told| told.confirmed);
        if !other && known {
            match master.lookup_node(self.node.name()).await? {
                None => forgotten = true,
                Some(uri) if uri != self.node.uri => self.lose_name(&uri),
                Some(_) => {}
            }
        }
        if forgotten && self.found == Some(true) {
            events::master_restarted(master.uri());
        }
        if forgotten || self.found != Some(true) {
            self.told
                .values_mut()
                .for_each(|told| told.confirmed = false);
            self.node.params.forget();
        } else if self.compared.is_none_or(|at| at.elapsed() >= COMPARED) {
            self.compare().await;
            self.compared = Some(clock::now());
        }
        Ok(())
    }

    /// Finds out what a master that knows this node no longer lists of it, as after `rosnode cleanup`: that is registered
    /// again. A service that another node has taken over is that node's.
    async fn compare(&mut self) {
        if !self.told.values().any(|told| told.confirmed) {
            return;
        }
        let listed = match self.node.master.registrations().await {
            Ok(listed) => listed,
            // The next check finds out whether the master is there.
            Err(error) => {
                tracing::debug!(%error, "the registrations at the master were not read");
                return;
            }
        };
        let name = self.node.name();
        let is_listed = |resource: &str, kind| {
            let listed = match kind {
                ResourceKind::Published => listed.publishers.get(resource),
                ResourceKind::Subscribed => listed.subscribers.get(resource),
                ResourceKind::Service => return listed.services.contains_key(resource),
            };
            listed.is_some_and(|nodes| nodes.iter().any(|node| node == name))
        };
        let mut missing = Vec::new();
        for ((resource, kind), told) in &mut self.told {
            if told.confirmed && !is_listed(resource, *kind) {
                told.confirmed = false;
                missing.push(resource.as_str());
            }
        }
        if let Some(first) = missing.first() {
            events::registrations_lost(self.node.master.uri(), first, missing.len());
        }
    }

    /// Asks the master whose this node's name is, as another has claimed it: of two nodes that start at once each may be
    /// told to end, the one by a registration of the other that was on its way. Nothing is registered meanwhile, and
    /// nothing of this node is on its way here, so the name stays with whom it belongs to now.
    async fn decide(&mut self, contest: u64) -> Result<(), MasterError> {
        let since = *self.contested.get_or_insert_with(clock::now);
        let name = self.node.name();
        match self.node.master.lookup_node(name).await {
            Ok(Some(uri)) if uri != self.node.uri => self.lose_name(&uri),
            Ok(_) => {
                if let Some(more) = self.contests.admit(clock::now()) {
                    events::name_kept(name, more);
                }
                // The other may have had the name for a while, with which all that was registered is lost.
                self.compared = None;
                self.node.params.forget();
                self.node.decided(contest);
                self.contested = None;
            }
            Err(error) if since.elapsed() < LONGEST_CONTEST => return Err(error),
            Err(error) => self.node.ask_to_shut_down(&format!(
                "another node has taken the name {name}, and the master does not say which: {error}"
            )),
        }
        Ok(())
    }

    fn lose_name(&self, uri: &str) {
        let name = self.node.name();
        self.node.ask_to_shut_down(&format!(
            "another node with the name {name} runs at {uri}; give one of them another name, as with __name:=other"
        ));
    }

    fn jobs(&mut self) -> Vec<Job> {
        let mut wanted = self.node.wanted_registrations();
        if !self.node.may_register() {
            // The name may belong to another node now, which a registration would push out in turn.
            wanted.retain(|registration| {
                let key = (registration.name.clone(), registration.kind);
                let told = self.told.get(&key);
                told.is_some_and(|told| {
                    told.confirmed && told.generation == registration.generation
                })
            });
        }
        let mut gone = self.told.clone();
        let mut jobs = Vec::new();
        for registration in wanted {
            let key = (registration.name.clone(), registration.kind);
            let before = gone.remove(&key);
            let current = before.filter(|told| told.generation == registration.generation);
            if current.is_some_and(|told| told.confirmed) {
                continue;
            }
            let told = Told {
                generation: registration.generation,
                confirmed: false,
            };
            self.told.insert(key, told);
            let replaces = before.is_some() && current.is_none();
            jobs.push(Job::Register {
                registration,
                replaces,
            });
        }
        jobs.extend(
            gone.into_keys()
                .map(|(name, kind)| Job::Unregister { name, kind }),
        );
        jobs
    }

    /// Takes the result of one job. Only a master that cannot be reached is a failure of the turn.
    fn note(&mut self, outcome: Outcome) -> Result<(), MasterError> {
        let (key, registered, result) = outcome;
        match (registered, result) {
            (Some(generation), Ok(())) => {
                if let Some(told) = self.told.get_mut(&key)
                    && told.generation == generation
                {
                    told.confirmed = true;
                }
            }
            (None, Ok(())) => {
                self.told.remove(&key);
            }
            (Some(_), Err(error @ (MasterError::Refused { .. } | MasterError::Shape(_)))) => {
                if self.refusals.admit(clock::now()).is_some() {
                    events::registration_refused(&key.0, &error);
                }
            }
            // A master that does not know the registration has nothing to forget.
            (None, Err(MasterError::Refused { .. } | MasterError::Shape(_))) => {
                self.told.remove(&key);
            }
            (_, Err(error)) => return Err(error),
        }
        Ok(())
    }

    fn found(&mut self) {
        if self.found.replace(true) != Some(true) {
            events::master_found(self.node.master.uri());
            self.node.master_state.send_replace(MasterState::Registered);
        }
    }

    fn lost(&mut self, error: &MasterError) {
        if self.found.replace(false) != Some(false) {
            events::master_awaited(self.node.master.uri(), error);
            self.node.master_state.send_replace(MasterState::Awaited);
        }
    }
}

/// What is told to the master in one request: what is new or gone, many at a time. Whatever takes another's place goes by
/// itself, in two requests: rospy takes two lists of publishers that come at once for one, sees no difference, and
/// leaves it to its retry half a second later to connect anew.
fn batches(jobs: Vec<Job>) -> Vec<Vec<Job>> {
    let (alone, mut together): (Vec<Job>, Vec<Job>) = jobs.into_iter().partition(Job::replaces);
    let mut batches: Vec<Vec<Job>> = alone.into_iter().map(|job| vec![job]).collect();
    while !together.is_empty() {
        let rest = together.split_off(BATCH.min(together.len()));
        batches.push(std::mem::replace(&mut together, rest));
    }
    batches
}

/// Tells the master several things.
async fn perform(node: Arc<Inner>, jobs: Vec<Job>) -> Result<Vec<Outcome>, MasterError> {
    // Lists of publishers that come while the master answers are newer than its answer.
    let seen: Vec<u64> = jobs.iter().map(|job| job.updates(&node)).collect();
    let requests: Vec<Request> = jobs.iter().flat_map(|job| job.requests(&node)).collect();
    let mut results = Vec::with_capacity(requests.len());
    if jobs.iter().any(Job::replaces) {
        for request in requests {
            results.extend(node.master.call_all(vec![request]).await?);
        }
    } else {
        results = node.master.call_all(requests).await?;
    }
    let mut results = results.into_iter();
    let settle = |(job, seen): (Job, u64)| {
        let answer = || MasterError::Shape("system.multicall");
        let mut next = || results.next().unwrap_or_else(|| Err(answer()));
        match job {
            Job::Register {
                registration,
                replaces,
            } => {
                // A master that does not know the one before has nothing to forget.
                let forgotten = if replaces { next().map(drop) } else { Ok(()) };
                drop(forgotten);
                let result =
                    next().and_then(|result| registered(&node, &registration, &result, seen));
                let key = (registration.name, registration.kind);
                (key, Some(registration.generation), result)
            }
            Job::Unregister { name, kind } => ((name, kind), None, next().map(drop)),
        }
    };
    Ok(jobs.into_iter().zip(seen).map(settle).collect())
}

/// What follows from the master's answer to a registration.
fn registered(
    node: &Inner,
    registration: &Registration,
    result: &Value,
    seen: u64,
) -> Result<(), MasterError> {
    if registration.kind == ResourceKind::Subscribed {
        let publishers = master::publishers(result)?;
        node.registered_publishers(&registration.name, &publishers, seen);
    }
    Ok(())
}

impl Job {
    /// What the master has to be asked, in this order.
    fn requests(&self, node: &Inner) -> Vec<Request> {
        let master = &node.master;
        match self {
            Self::Register {
                registration,
                replaces,
            } => {
                let (name, type_name) = (&registration.name, &registration.type_name);
                let before = replaces.then(|| unregister(node, name, registration.kind));
                let register = match registration.kind {
                    ResourceKind::Published => master.register_publisher(name, type_name),
                    ResourceKind::Subscribed => master.register_subscriber(name, type_name),
                    ResourceKind::Service => master.register_service(name, &node.service_uri),
                };
                before.into_iter().chain([register]).collect()
            }
            Self::Unregister { name, kind } => vec![unregister(node, name, *kind)],
        }
    }

    const fn replaces(&self) -> bool {
        matches!(self, Self::Register { replaces: true, .. })
    }

    fn updates(&self, node: &Inner) -> u64 {
        match self {
            Self::Register { registration, .. }
                if registration.kind == ResourceKind::Subscribed =>
            {
                node.updates(&registration.name)
            }
            Self::Register { .. } | Self::Unregister { .. } => 0,
        }
    }

    /// Publishers before subscribers: a registered subscriber is told of each publisher that comes after it.
    fn rank(&self) -> u8 {
        match self {
            Self::Unregister { .. } => 0,
            Self::Register { registration, .. } => match registration.kind {
                ResourceKind::Published => 1,
                ResourceKind::Service => 2,
                ResourceKind::Subscribed => 3,
            },
        }
    }
}

fn unregister(node: &Inner, name: &str, kind: ResourceKind) -> Request {
    match kind {
        ResourceKind::Published => node.master.unregister_publisher(name),
        ResourceKind::Subscribed => node.master.unregister_subscriber(name),
        ResourceKind::Service => Master::unregister_service(name, &node.service_uri),
    }
}

/// The commonest set-up fault of ROS 1: a node that others cannot reach under the name it gives.
async fn check_hostname(hostname: String) {
    let lookup = tokio::net::lookup_host((hostname.as_str(), 0));
    match timeout(Duration::from_secs(10), lookup).await {
        Ok(Ok(_)) => {}
        Ok(Err(error)) => events::hostname_unresolvable(&hostname, &error),
        Err(error) => events::hostname_unresolvable(&hostname, &error),
    }
}

const TICK: Duration = Duration::from_secs(1);
const LONGEST_WAIT: Duration = Duration::from_secs(2);
/// Between two comparisons with what the master lists, which is all of the graph.
const COMPARED: Duration = Duration::from_secs(5);
/// How long a master that does not answer is asked whose a name is.
const LONGEST_CONTEST: Duration = Duration::from_secs(5);
/// Registrations in one request.
const BATCH: usize = 64;
/// Requests at a time.
const PARALLEL: usize = 16;
