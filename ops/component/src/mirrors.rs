//! Skills of servers that are not participants of the space, as values, calls and actions of the
//! space. Each server has a namespace number, and its skills have the same identifiers as skills of
//! a component.

use std::collections::{BTreeMap, HashMap, HashSet, VecDeque};
use std::time::Duration;

use bridge_node::actions::OwnActions;
use bridge_node::{Executed, Execution, ExecutionId, PortEvent, Refusal, now};
use mappings::TopicId;
use plant_opcua::client::{Link, OpcUaClient};
use program::ProgramMethod;
use skills::{Mirrors, SkillClient, SkillDescription, SkillObserver, SkillOwner, Watchable};
use tokio::sync::mpsc;
use tokio::task::AbortHandle;
use tracing::{info, warn};

use crate::executor::SkillExecutor;
use crate::goals::{self, Doer, Reporter};
use crate::port::run_number_of_now;
use crate::space::{ComponentOutbox, ComponentPlace, GOAL, MOST_IN_SPACE, Speaker};

/// A server with skills that is not a participant of the space.
#[derive(Clone)]
pub struct Foreign {
    /// The name of the server. Its skills are `<name>.<skill>`, or `<name>.<object>.<skill>` if
    /// several objects have skills.
    pub name: String,
    /// The namespace number in the space.
    pub namespace: u16,
    /// True if other hosts may run its skills too.
    pub open: bool,
    /// True if the server was discovered and not configured. A discovered server that is a
    /// participant of the space itself is skipped.
    pub is_found: bool,
    /// The endpoint, as text for the operator.
    pub endpoint: String,
    /// The session with the server.
    pub client: OpcUaClient,
}

impl Foreign {
    fn is_as(&self, other: &Self) -> bool {
        let of = |one: &Self| {
            (
                one.name.clone(),
                one.namespace,
                one.open,
                one.endpoint.clone(),
                one.is_found,
            )
        };
        of(self) == of(other) && self.client.is_same(&other.client)
    }
}

/// The faults of a server's skills, by the names of the skills.
pub type ForeignFaults = BTreeMap<String, String>;

/// The skills of such servers, for the port of the program that represents them.
pub struct ForeignSkills {
    servers: HashMap<String, Server>,
    outbox: ComponentOutbox,
    first: VecDeque<PortEvent>,
    actions: OwnActions,
    heard: mpsc::Receiver<News>,
    tell: mpsc::Sender<News>,
    executed: mpsc::Receiver<PortEvent>,
    executes: mpsc::Sender<PortEvent>,
}

struct Server {
    of: Foreign,
    looking: AbortHandle,
    mirrors: Option<Mirrors>,
    skills: BTreeMap<u16, Shown>,
    faults: ForeignFaults,
    /// True if the server was discovered and is a participant of the space itself.
    speaks: bool,
}

/// A skill in the space.
struct Shown {
    /// The full name, as in `press.Grasp`.
    name: String,
    executor: SkillExecutor,
    values: Vec<TopicId>,
    calls: Vec<TopicId>,
}

impl Drop for Server {
    fn drop(&mut self) {
        self.looking.abort();
    }
}

/// A change of a server, with its name.
struct News {
    name: String,
    what: Change,
}

enum Change {
    Found(Watchable),
    Gone(String),
}

impl Default for ForeignSkills {
    fn default() -> Self {
        let (tell, heard) = mpsc::channel(MOST_NEWS);
        let (executes, executed) = mpsc::channel(MOST_EXECUTIONS);
        Self {
            servers: HashMap::new(),
            outbox: ComponentOutbox::default(),
            first: VecDeque::new(),
            actions: OwnActions::default(),
            heard,
            tell,
            executed,
            executes,
        }
    }
}

impl ForeignSkills {
    /// Represents these servers and no others. Unchanged servers stay undisturbed. Needs a tokio
    /// runtime.
    pub fn follow(&mut self, servers: Vec<Foreign>) {
        let stays = |name: &String, server: &Server| {
            let mut servers = servers.iter();
            servers.any(|one| one.name == *name && one.is_as(&server.of))
        };
        let gone: Vec<Server> = self
            .servers
            .extract_if(|name, server| !stays(name, server))
            .map(|(_, server)| server)
            .collect();
        for mut server in gone {
            let why = match server.of.is_found {
                true => "the server is there no longer",
                false => "the mapping has it no longer",
            };
            withdraw(&mut server, &mut self.first, why);
        }
        for of in servers {
            if self.servers.contains_key(&of.name) {
                continue;
            }
            let looking = tokio::spawn(look(of.clone(), self.tell.clone())).abort_handle();
            self.servers.insert(
                of.name.clone(),
                Server {
                    of,
                    looking,
                    mirrors: None,
                    skills: BTreeMap::new(),
                    faults: BTreeMap::new(),
                    speaks: false,
                },
            );
        }
    }

    /// Waits for the next event. Cancel-safe; pends without any server.
    pub async fn next(&mut self) -> PortEvent {
        loop {
            if let Some(event) = self.first.pop_front() {
                return event;
            }
            tokio::select! {
                biased;
                Some(news) = self.heard.recv() => self.take(news),
                Some(event) = self.executed.recv() => return event,
                event = self.actions.recv() => return event,
                event = self.outbox.next() => return event,
            }
        }
    }

    /// Returns true if a call belongs to a skill of these servers.
    #[must_use]
    pub fn serves(&self, topic: TopicId) -> bool {
        let namespace = topic.namespace.get();
        let mut servers = self.servers.values();
        topic.space == mappings::SpaceId::UA
            && servers.any(|server| server.of.namespace == namespace)
    }

    /// Executes a call. Returns false if the call cannot be executed now.
    pub fn execute(&mut self, execution: Execution) -> bool {
        if self.actions.serves(execution.topic) {
            let id = execution.id;
            if let Err(refusal) = self.actions.execute(execution) {
                self.first.push_back(PortEvent::Executed {
                    execution: id,
                    outcome: Executed::Refused(refusal),
                });
            }
            return true;
        }
        let Some((executor, method)) = self.skill(execution.topic) else {
            return false;
        };
        // Space for the answer is reserved before the machine moves.
        let Ok(room) = self.executes.clone().try_reserve_owned() else {
            return false;
        };
        let by = SkillOwner::Local("a call of the space");
        let Execution {
            id,
            request,
            start_by,
            ..
        } = execution;
        drop(tokio::spawn(async move {
            let outcome = if start_by < now().monotonic {
                // The program was stopped, and another redundant server may have taken over.
                Executed::Refused(Refusal::NotExecutable)
            } else {
                let condition = Box::new(move || now().monotonic <= start_by);
                executor.execute((by, method), &request, condition).await
            };
            drop(room.send(PortEvent::Executed {
                execution: id,
                outcome,
            }));
        }));
        true
    }

    fn skill(&self, topic: TopicId) -> Option<(SkillExecutor, ProgramMethod)> {
        let (number, method) = ComponentPlace::call(topic)?;
        let namespace = topic.namespace.get();
        let mut servers = self.servers.values();
        let server = servers.find(|server| server.of.namespace == namespace)?;
        let shown = server.skills.get(&number)?;
        Some((shown.executor.clone(), method))
    }

    /// Handles that the caller has abandoned an execution. Its run continues.
    pub fn abandoned(&mut self, execution: ExecutionId) {
        self.actions.abandoned(execution);
    }

    /// Handles the announcement of another program's call. A fault is recorded and logged if it has
    /// the name of a skill of these servers.
    pub fn others(&mut self, topic: TopicId, name: &str) {
        for server in self.servers.values_mut() {
            let mut skills = server.skills.values();
            let same = skills.find(|shown| {
                let method = name
                    .strip_prefix(&*shown.name)
                    .and_then(|rest| rest.strip_prefix('.'));
                method.is_some_and(|method| {
                    ProgramMethod::ALL
                        .iter()
                        .any(|known| known.name() == method)
                })
            });
            let Some(same) = same.map(|shown| shown.name.clone()) else {
                continue;
            };
            let why = format!(
                "another component has a skill with the same name, at {topic}: choose between them in `ua-space call` by number"
            );
            if server.faults.insert(same.clone(), why.clone()).is_none() {
                warn!(server = server.of.name, skill = same, "{why}");
            }
        }
    }

    /// Returns the faults of the skills, by the names of the servers.
    pub fn faults(&self) -> impl Iterator<Item = (&str, &ForeignFaults)> {
        let servers = self.servers.iter();
        servers.map(|(name, server)| (name.as_str(), &server.faults))
    }

    /// Returns the names of discovered servers that are participants of the space themselves and
    /// need no representation.
    pub fn speaking(&self) -> impl Iterator<Item = &str> {
        let servers = self.servers.iter().filter(|(_, server)| server.speaks);
        servers.map(|(name, _)| name.as_str())
    }

    fn take(&mut self, news: News) {
        let Some(server) = self.servers.get_mut(&news.name) else {
            return;
        };
        match news.what {
            Change::Gone(why) => withdraw(server, &mut self.first, &why),
            Change::Found(found) => {
                withdraw(server, &mut self.first, "it has other skills now");
                // A component reports its namespace number.
                let has_number = found.found().any(|of| of.namespace.is_some());
                server.speaks = server.of.is_found && has_number;
                if server.speaks {
                    let of = &server.of;
                    info!(
                        server = of.name,
                        url = of.endpoint,
                        "it is in the space by itself"
                    );
                    return;
                }
                show(
                    server,
                    &found,
                    &self.outbox,
                    (&mut self.actions, &mut self.first),
                );
            }
        }
    }
}

/// Adds the skills of a server to the space.
fn show(
    server: &mut Server,
    found: &Watchable,
    outbox: &ComponentOutbox,
    (actions, first): (&mut OwnActions, &mut VecDeque<PortEvent>),
) {
    let of = server.of.clone();
    let (named, faults) = names(&of.name, found);
    for (name, why) in &faults {
        warn!(
            server = of.name,
            url = of.endpoint,
            skill = name,
            "cannot show a skill of another server as it is: {why}"
        );
    }
    server.faults = faults;
    let mut reporters = Vec::new();
    let mirrors = Mirrors::begin(found, run_number_of_now(), |at, facts| {
        let Some(named) = named.get(at).and_then(Option::as_ref) else {
            reporters.push(None);
            return Vec::new();
        };
        let place = named.place(&of);
        let facts = named.facts(facts);
        let methods = found.found().nth(at).map(skills::FoundSkill::methods);
        first.extend(place.announce(named.number, &facts, &methods.unwrap_or_default()));
        let reporter = Reporter::new();
        reporters.push(Some(reporter.clone()));
        let mut observers: Vec<Box<dyn SkillObserver>> = vec![Box::new(reporter)];
        if let Some(speaker) = Speaker::new(outbox.clone(), &place, named.number) {
            speaker.at_first(&facts, None);
            observers.push(Box::new(speaker));
        }
        observers
    });
    for ((mirror, reporter), named) in mirrors.skills().iter().zip(reporters).zip(&named) {
        let (Some(reporter), Some(named)) = (reporter, named) else {
            continue;
        };
        let place = named.place(&of);
        let executor = SkillExecutor::Theirs(mirror.clone());
        let topic = |n| place.topic(named.number, n);
        let mut calls: Vec<TopicId> = (5..10).filter_map(topic).collect();
        let mut values: Vec<TopicId> = (1..5).filter_map(topic).collect();
        // An action needs Halt to cancel goals, and Reset after a run has ended.
        let runs = [
            ProgramMethod::Start,
            ProgramMethod::Halt,
            ProgramMethod::Reset,
        ];
        if let Some(goal) = topic(GOAL)
            && runs.iter().all(|method| mirror.methods().contains(method))
        {
            let facts = named.facts(mirror.facts());
            let action = goals::action(goal, (&place.component, of.open), &facts);
            let added = actions.add(&action, Doer::new(executor.clone(), reporter));
            first.extend(added.unwrap_or_default());
            calls.extend((GOAL..GOAL + 3).filter_map(topic));
            values.extend((GOAL + 3..GOAL + 5).filter_map(topic));
        }
        let shown = Shown {
            name: format!("{}.{}", place.component, named.skill),
            executor,
            values,
            calls,
        };
        server.skills.insert(named.number, shown);
    }
    info!(
        server = of.name,
        url = of.endpoint,
        namespace = of.namespace,
        skills = server.skills.len(),
        "its skills are in the space"
    );
    server.mirrors = Some(mirrors);
}

/// Removes the skills of a server from the space.
fn withdraw(server: &mut Server, first: &mut VecDeque<PortEvent>, why: &str) {
    if let Some(mirrors) = &server.mirrors {
        mirrors.lose(why);
    }
    for shown in std::mem::take(&mut server.skills).into_values() {
        let calls = shown.calls.into_iter();
        first.extend(calls.map(|topic| PortEvent::Withdrawn { topic }));
        let live = false;
        let values = shown.values.into_iter();
        first.extend(values.map(|topic| PortEvent::Live { topic, live }));
    }
}

/// The identifier and the names of a skill in the space.
struct Named {
    number: u16,
    component: String,
    skill: String,
}

impl Named {
    fn place(&self, of: &Foreign) -> ComponentPlace {
        ComponentPlace {
            component: self.component.clone(),
            namespace: of.namespace,
            open: of.open,
        }
    }

    fn facts(&self, facts: &SkillDescription) -> SkillDescription {
        SkillDescription {
            name: self.skill.clone(),
            ..facts.clone()
        }
    }
}

/// Returns the names and numbers of a server's skills, `None` for skills that are not shown, and
/// the faults of the skills.
fn names(server: &str, found: &Watchable) -> (Vec<Option<Named>>, ForeignFaults) {
    let all: Vec<_> = found.found().collect();
    let components: HashSet<&str> = all.iter().map(|of| of.component.as_str()).collect();
    // Numbers of skills are used for components only; the identifiers of other servers' nodes have
    // no such meaning.
    let own = all
        .iter()
        .filter_map(|of| of.number.filter(|_| of.namespace.is_some()));
    let numbered = own.collect::<HashSet<u16>>().len() == all.len();
    let mut faults = ForeignFaults::new();
    let mut taken: HashSet<String> = HashSet::new();
    let mut named = Vec::new();
    for (at, of) in all.iter().enumerate() {
        let component = match components.len() {
            1 => server.to_owned(),
            _ => format!("{server}.{}", plain(&of.component)),
        };
        let called = plain(&of.name);
        let skill = (1..)
            .map(|nth| match nth {
                1 => called.clone(),
                nth => format!("{called}_{nth}"),
            })
            .find(|skill| !taken.contains(&format!("{component}.{skill}")))
            .unwrap_or_default();
        let name = format!("{component}.{skill}");
        taken.insert(name.clone());
        let mut why = found.faults(at);
        if skill != called {
            why.push(format!(
                "another one is called {called} too; this one, {}, has the name {skill} in the space",
                of.node
            ));
        }
        let number = match of.number.filter(|_| numbered) {
            Some(number) => Some(number),
            None => u16::try_from(at + 1).ok(),
        };
        let number = number.filter(|number| usize::from(*number) <= MOST_IN_SPACE);
        if number.is_none() {
            why.push(format!(
                "only {MOST_IN_SPACE} skills have a place in the space"
            ));
        }
        let number = number.filter(|_| found.is_watchable(at));
        if !why.is_empty() {
            faults.insert(name, why.join("; "));
        }
        named.push(number.map(|number| Named {
            number,
            component,
            skill,
        }));
    }
    (named, faults)
}

/// Replaces the separators in a name.
fn plain(name: &str) -> String {
    let parts = |c: char| c == '.' || c.is_whitespace() || c.is_control();
    name.chars()
        .map(|c| if parts(c) { '_' } else { c })
        .collect()
}

/// Reads the skills of a server at each connection and periodically.
async fn look(of: Foreign, tell: mpsc::Sender<News>) {
    let mut link = of.client.link();
    let mut told: Option<(u64, Watchable)> = None;
    let mut trouble = String::new();
    loop {
        let now = link.borrow_and_update().clone();
        let what = match now {
            Link::Up { connects, .. } => {
                match Watchable::of(SkillClient::over(&of.client, &of.endpoint)).await {
                    Ok(found) => {
                        trouble.clear();
                        let known = told.as_ref();
                        let is_new =
                            known.is_none_or(|(at, known)| *at != connects || !known.is_as(&found));
                        told = Some((connects, found.clone()));
                        is_new.then_some(Change::Found(found))
                    }
                    Err(fault) => {
                        let fault = fault.to_string();
                        if trouble != fault {
                            warn!(
                                server = of.name,
                                url = of.endpoint,
                                "cannot read the skills of another server: {fault}"
                            );
                            trouble = fault;
                        }
                        None
                    }
                }
            }
            Link::Down { reason, .. } => told.take().map(|_| Change::Gone(reason)),
            Link::Connecting | Link::Closed => None,
        };
        if let Some(what) = what {
            let name = of.name.clone();
            if tell.send(News { name, what }).await.is_err() {
                return;
            }
        }
        let again = tokio::time::timeout(LOOK_AGAIN, link.changed());
        if matches!(again.await, Ok(Err(_))) {
            return;
        }
    }
}

/// Interval between two reads of a server's skills.
const LOOK_AGAIN: Duration = Duration::from_secs(30);
/// Largest number of changes that wait for the run loop.
const MOST_NEWS: usize = 16;
/// Largest number of simultaneous calls; more are refused.
const MOST_EXECUTIONS: usize = 64;
