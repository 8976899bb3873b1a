//! Keeps the registrations at the master equal to the topics and services of the node.
//!
//! The registrar compares the desired registrations with the registrations sent to the master and
//! sends the difference. The order in which topics and services are created and dropped, a master
//! that starts late, and a master that restarts are thus the same case.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use log_limit::Throttle;
use tokio::task::JoinSet;
use tokio::time::{Instant, timeout};

use crate::clock;
use crate::events;
use crate::master::{self, Master, MasterError, MasterRequest, MasterState};
use crate::node::{Inner, Registration, ResourceKind};
use crate::parameters;
use crate::xmlrpc::XmlRpcValue;

/// Runs until the node is closed and everything is unregistered at the master.
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
        // Read before the comparison, which then covers only the state at closing.
        let closed = node.is_closed();
        match registrar.turn(closed).await {
            Ok(()) => {
                // While closing, a turn may not have called the master at all.
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
            () = idle_ticks::sleep(wait) => {}
        }
    }
}

struct Registrar {
    node: Arc<Inner>,
    /// The registrations sent to the master, with or without a reply.
    told: HashMap<(String, ResourceKind), ReportedState>,
    pid: Option<i32>,
    /// `None` before the first attempt.
    found: Option<bool>,
    checked: Option<Instant>,
    /// Time of the last comparison of the registrations with the master's list.
    compared: Option<Instant>,
    /// Start of the contest for this node's name.
    contested: Option<Instant>,
    contests: Throttle,
    refusals: Throttle,
}

#[derive(Clone, Copy)]
struct ReportedState {
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
                // The task was aborted with the runtime of the node.
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

    /// Discards the registrations that the master may still have, and logs them: the master is
    /// unreachable.
    fn abandon(&mut self, error: &MasterError) {
        for (name, _) in self.told.drain().map(|(key, _)| key) {
            events::unregistration_failed(&name, error);
        }
    }

    /// Checks whether the master is reachable, is the same as before, and still knows this node.
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

    /// Finds the registrations that a master that knows this node no longer lists, as after
    /// `rosnode cleanup`; they are registered again. A service that another node has taken over
    /// stays with that node.
    async fn compare(&mut self) {
        if !self.told.values().any(|told| told.confirmed) {
            return;
        }
        let listed = match self.node.master.registrations().await {
            Ok(listed) => listed,
            // The next check finds out whether the master is reachable.
            Err(error) => {
                tracing::debug!(%error, "cannot read the registrations from the master");
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

    /// Looks up the owner of this node's name at the master, after another node has claimed the
    /// name. If two nodes start at once, each may receive a request to shut down, one of them
    /// because of a registration that was still on its way. Nothing is registered during the
    /// contest, and no registration of this node is on its way, so the reported owner keeps the
    /// name.
    async fn decide(&mut self, contest: u64) -> Result<(), MasterError> {
        let since = *self.contested.get_or_insert_with(clock::now);
        let name = self.node.name();
        match self.node.master.lookup_node(name).await {
            Ok(Some(uri)) if uri != self.node.uri => self.lose_name(&uri),
            Ok(_) => {
                if let Some(more) = self.contests.admit(clock::now()) {
                    events::name_kept(name, more);
                }
                // The other node may have had the name for a while, which removes all
                // registrations.
                self.compared = None;
                self.node.params.forget();
                self.node.decided(contest);
                self.contested = None;
            }
            Err(error) if since.elapsed() < LONGEST_CONTEST => return Err(error),
            Err(error) => self.node.ask_to_shut_down(&format!(
                "another node has taken the name {name}, and the master does not report its address: {error}"
            )),
        }
        Ok(())
    }

    fn lose_name(&self, uri: &str) {
        let name = self.node.name();
        self.node.ask_to_shut_down(&format!(
            "another node with the name {name} runs at {uri}; stop one of them, or give it another name, as with __name:=other"
        ));
    }

    fn jobs(&mut self) -> Vec<Job> {
        let mut wanted = self.node.wanted_registrations();
        if !self.node.may_register() {
            // The name may belong to another node, which a registration would displace in turn.
            wanted.retain(|registration| {
                let key = (registration.name.clone(), registration.kind);
                let told = self.told.get(&key);
                told.is_some_and(|told| {
                    told.confirmed && told.generation == registration.generation
                })
            });
        }
        for topic in self.node.take_renewed() {
            if let Some(told) = self.told.get_mut(&(topic, ResourceKind::Published)) {
                told.confirmed = false;
            }
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
            let told = ReportedState {
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

    /// Applies the result of a job. Only an unreachable master is a failure of the turn.
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
            // A master that does not know the registration has nothing to remove.
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

/// Groups jobs into requests. New and removed registrations are sent many at a time. A registration
/// that replaces another registration is a group of its own and takes two requests. The reason is
/// that rospy merges two lists of publishers that arrive at once. It would see no difference, and
/// reconnect only with its retry half a second later.
fn batches(jobs: Vec<Job>) -> Vec<Vec<Job>> {
    let (alone, mut together): (Vec<Job>, Vec<Job>) = jobs.into_iter().partition(Job::replaces);
    let mut batches: Vec<Vec<Job>> = alone.into_iter().map(|job| vec![job]).collect();
    while !together.is_empty() {
        let rest = together.split_off(BATCH.min(together.len()));
        batches.push(std::mem::replace(&mut together, rest));
    }
    batches
}

/// Sends several jobs to the master.
async fn perform(node: Arc<Inner>, jobs: Vec<Job>) -> Result<Vec<Outcome>, MasterError> {
    // Lists of publishers that arrive before the reply of the master are newer than the reply.
    let seen: Vec<u64> = jobs.iter().map(|job| job.updates(&node)).collect();
    let requests: Vec<MasterRequest> = jobs.iter().flat_map(|job| job.requests(&node)).collect();
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
                // A master that does not know the previous registration has nothing to remove.
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

/// Applies the master's reply to a registration.
fn registered(
    node: &Inner,
    registration: &Registration,
    result: &XmlRpcValue,
    seen: u64,
) -> Result<(), MasterError> {
    if registration.kind == ResourceKind::Subscribed {
        let publishers = master::publishers(result)?;
        node.registered_publishers(&registration.name, &publishers, seen);
    }
    Ok(())
}

impl Job {
    /// Returns the calls to the master, in order.
    fn requests(&self, node: &Inner) -> Vec<MasterRequest> {
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

    /// Returns the order of jobs: publishers before subscribers, because the master notifies a
    /// registered subscriber of each later publisher.
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

fn unregister(node: &Inner, name: &str, kind: ResourceKind) -> MasterRequest {
    match kind {
        ResourceKind::Published => node.master.unregister_publisher(name),
        ResourceKind::Subscribed => node.master.unregister_subscriber(name),
        ResourceKind::Service => Master::unregister_service(name, &node.service_uri),
    }
}

/// Checks for the most common set-up fault of ROS 1: a node that announces a name under which
/// others cannot reach it.
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
/// Period between two comparisons with the master's list, which is the whole graph.
const COMPARED: Duration = Duration::from_secs(5);
/// Time limit for looking up the owner of a name at a master that does not reply.
const LONGEST_CONTEST: Duration = Duration::from_secs(5);
/// Number of registrations in a single request.
const BATCH: usize = 64;
/// Number of concurrent requests.
const PARALLEL: usize = 16;
