//! The current state of the plant: the components in the graph, their skills, and the runs.

mod component;
mod configuring;
mod facts;
mod leases;
mod opened;
mod parameters;
mod tools;

use std::collections::{BTreeMap, BTreeSet};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use async_trait::async_trait;
use knowledge::{
    ComponentFacts, Knowledge, KnowledgeSource, NodeName, QuestionAnswer, SourceKind,
    SourceLifetime, ValueQuery, ValueQueryFault,
};
use skills::choosing::Attachment;
use skills::{
    ClientOptions, FoundSkill, RunnableSkill as RunsOfSkill, SkillClient, SkillValue, Unchosen,
};
use tokio::sync::watch;
use tokio::task::spawn_blocking;
use tracing::{error, info, warn};

pub(crate) use self::component::QueriedComponent;
use self::component::{ListedComponent, LostComponent, PresentComponents};
use self::leases::{ComponentLeases, LeaseChange};
use self::opened::OpenedSkills;
use self::parameters::{connects, parameter, result, values};
use crate::clock::now;
use crate::execute::{OpenFault, Opened, Plant};
use crate::goal::{GoalAction, GoalConditions, GoalFault, Sequence};
use crate::parameter_fault::ParameterFault;
use crate::plan::{Offer, ShownTools};
use crate::process::{GivenParameter, ParameterQuery, Process};
use crate::read_process::Processes;
use crate::record::{NewestRuns, ProcessRun};
use crate::sources::{Finding, MesSources};

/// The current state of the plant.
pub(crate) struct PlantState {
    knowledge: Arc<Knowledge>,
    sources: Arc<MesSources>,
    /// The processes of the graph, with the change of the graph after which they were read.
    processes: Mutex<(Option<u64>, Arc<Processes>)>,
    client: ClientOptions,
    /// The components that the user prefers, the most preferred first.
    prefer: Vec<String>,
    present: Mutex<PresentComponents>,
    changed: watch::Sender<u64>,
    runs: NewestRuns,
    leases: ComponentLeases,
    /// Held during the search for a sequence, which takes up to 100 MB of memory.
    searching: Mutex<()>,
    next_run: AtomicU64,
}

/// A goal with a sequence of actions that reaches it.
pub(crate) struct PlannedGoal {
    pub(crate) process: Process,
    pub(crate) sequence: Sequence,
}

/// A server, as discovery found it.
#[derive(Debug, Clone)]
pub(crate) struct SeenServer {
    pub(crate) name: String,
    pub(crate) url: String,
    pub(crate) at_ms: u64,
}

impl PlantState {
    pub(crate) fn new(
        knowledge: Arc<Knowledge>,
        sources: Arc<MesSources>,
        client: ClientOptions,
        prefer: Vec<String>,
    ) -> Self {
        Self {
            knowledge,
            sources,
            prefer,
            processes: Mutex::default(),
            client,
            present: Mutex::default(),
            changed: watch::channel(0).0,
            runs: NewestRuns::default(),
            leases: ComponentLeases::default(),
            searching: Mutex::default(),
            next_run: AtomicU64::new(1),
        }
    }

    /// Returns the number of the next run.
    pub(crate) fn next_run(&self) -> u64 {
        self.next_run.fetch_add(1, Ordering::Relaxed)
    }

    /// Returns the newest runs.
    pub(crate) fn runs(&self) -> Vec<ProcessRun> {
        self.runs.all()
    }

    /// Returns the components that a run uses.
    pub(crate) fn used_by(&self, run: &str) -> Vec<String> {
        self.leases.used_by(run)
    }

    /// Gives back the components of a run.
    pub(crate) fn give_back(&self, run: &str) {
        self.lease(run, &BTreeSet::new());
    }

    /// Gives back the components of the run with this number.
    pub(crate) fn give_back_of(&self, number: u64) {
        if let Some(run) = self.leases.run(number) {
            self.give_back(&run);
        }
    }

    pub(crate) fn knowledge(&self) -> &Knowledge {
        &self.knowledge
    }

    pub(crate) fn client(&self) -> &ClientOptions {
        &self.client
    }

    /// Returns the processes of the graph.
    pub(crate) fn processes(&self) -> Arc<Processes> {
        let changes = *self.knowledge.changes().borrow();
        let mut known = self
            .processes
            .lock()
            .unwrap_or_else(PoisonError::into_inner);
        if known.0 != Some(changes) {
            match Processes::read(&self.knowledge) {
                Ok(processes) => *known = (Some(changes), Arc::new(processes)),
                Err(fault) => error!("cannot read the processes: {fault}"),
            }
        }
        Arc::clone(&known.1)
    }

    /// Returns the process with an IRI.
    ///
    /// # Errors
    /// The reason why it cannot run.
    pub(crate) fn process(&self, iri: &str) -> Result<Process, String> {
        let processes = self.processes();
        if let Some(process) = processes.all.iter().find(|process| process.iri == iri) {
            return Ok(process.clone());
        }
        let shown: String = iri.chars().take(200).collect();
        if let Some(why) = processes.faults.get(iri) {
            return Err(format!("`{shown}` cannot run: {why}"));
        }
        match self.goal(iri) {
            Ok(planned) => return Ok(planned.process),
            Err(GoalFault::Unknown) => {}
            Err(fault) => return Err(format!("the goal `{shown}` cannot be reached: {fault}")),
        }
        let known = processes.all.iter().take(MOST_SHOWN);
        let known: Vec<_> = known.map(|process| process.iri.as_str()).collect();
        Err(format!(
            "`{shown}` is no process here; known are {}",
            known.join(", ")
        ))
    }

    /// Plans a goal with the actions whose capabilities have skills.
    ///
    /// # Errors
    /// The reason why it cannot be reached.
    pub(crate) fn goal(&self, iri: &str) -> Result<PlannedGoal, GoalFault> {
        let goal = GoalConditions::read(&self.knowledge, iri)?;
        let all = GoalAction::read(&self.knowledge)?;
        let offers = self.offers();
        let (actions, without): (Vec<_>, Vec<_>) = all.into_iter().partition(|action| {
            let mut skills = offers.iter().filter(|offer| offer.is_skill);
            skills.any(|offer| offer.closure.contains(&action.capability))
        });
        let searching = self.searching.lock();
        let searching = searching.unwrap_or_else(PoisonError::into_inner);
        let sequence = goal.search(&actions);
        drop(searching);
        let sequence = sequence.map_err(|fault| match without.is_empty() {
            true => fault,
            false => GoalFault::WithoutSkills {
                fault: Box::new(fault),
                actions: without.into_iter().map(|action| action.name).collect(),
            },
        })?;
        Ok(PlannedGoal {
            process: goal.process(&sequence, &actions),
            sequence,
        })
    }

    /// Returns the goal whose IRI is the end of a path, and its plan as JSON.
    pub(crate) fn goal_page(&self, escaped: &str) -> Option<serde_json::Value> {
        let answer = self.knowledge.ask("goals", &[]).ok()?;
        let mut goals = answer
            .rows
            .iter()
            .map(|row| QuestionAnswer::text(row, "goal"));
        let iri = goals.find(|iri| *iri == escaped || mtp::escaped(iri) == escaped)?;
        let page = match self.goal(iri) {
            Ok(planned) => serde_json::json!({
                "goal": iri, "reachable": true, "steps": planned.sequence.steps,
                "reached": planned.sequence.reached,
            }),
            Err(fault) => serde_json::json!({
                "goal": iri, "reachable": false, "reason": fault.to_string(),
            }),
        };
        Some(page)
    }

    pub(crate) fn sources(&self) -> &Arc<MesSources> {
        &self.sources
    }

    /// Adds a component to the graph after it has listed its skills.
    pub(crate) fn came(
        &self,
        seen: &SeenServer,
        application_uri: &str,
        found: QueriedComponent,
        listed_ms: u64,
    ) {
        let Some(facts) = found.facts(application_uri, &seen.url) else {
            return;
        };
        // A component with the ApplicationUri of another component replaces it. A component that
        // changes its description keeps its entry.
        self.remove(
            |known| known.application_uri == application_uri && known.discovered != seen.name,
            "another came under its ApplicationUri",
        );
        let iri = facts.iri();
        let since = self
            .present()
            .components
            .get(&iri)
            .map(|known| known.since_ms);
        let since_ms = since.unwrap_or_else(now);
        if !self.take_in(&facts, since_ms) {
            return;
        }
        let by_iri = |found: FoundSkill| {
            NodeName::parse(&found.node).map(|node| (facts.skill_iri(&node), found))
        };
        let component = ListedComponent {
            application_uri: application_uri.to_owned(),
            name: facts.name.clone(),
            endpoint: seen.url.clone(),
            namespace: facts.namespace,
            seen_ms: seen.at_ms,
            listed_ms,
            since_ms,
            skills: facts
                .skills
                .iter()
                .map(|skill| skill.name.clone())
                .collect(),
            discovered: seen.name.clone(),
            found: found.skills.into_iter().filter_map(by_iri).collect(),
            configuration: found.configuration,
            tools: BTreeSet::new(),
        };
        let (skills, endpoint) = (component.skills.len(), &component.endpoint);
        info!(
            component = component.name,
            skills, endpoint, "a component is in the graph"
        );
        self.present().put(&iri, component);
        self.changed.send_modify(|changes| *changes += 1);
    }

    /// Adds the description of a component to the graph. Returns whether it was added.
    fn take_in(&self, facts: &ComponentFacts, at: u64) -> bool {
        let (triples, left_out) = facts.triples();
        if !left_out.is_empty() {
            let left_out = left_out.join(", ");
            warn!(
                component = facts.name,
                left_out, "ignored capabilities that are not IRIs"
            );
        }
        let source = KnowledgeSource::new(SourceKind::Component, &facts.application_uri);
        let taken = self.knowledge.replace(&source, &triples, at);
        if let Err(fault) = &taken {
            error!(
                component = facts.name,
                "cannot store the description of a component in the graph: {fault}"
            );
        }
        taken.is_ok()
    }

    /// Removes the components that a server, which discovery found under this name, has no more.
    pub(crate) fn keeps_only(&self, discovered: &str, is_there: impl Fn(&str) -> bool) {
        let gone = |known: &ListedComponent| {
            known.discovered == discovered && !is_there(&known.application_uri)
        };
        self.remove(gone, "its station has lost it");
    }

    /// Removes a server that discovery has lost.
    pub(crate) fn went(&self, discovered: &str, why: &str) {
        self.remove(|component| component.discovered == discovered, why);
    }

    fn remove(&self, which: impl Fn(&ListedComponent) -> bool, why: &str) {
        let removed = self.present().remove(which);
        for component in removed {
            let source = KnowledgeSource::new(SourceKind::Component, &component.application_uri);
            if let Err(fault) = self.knowledge.remove(&source) {
                error!(
                    component = component.name,
                    "cannot remove a lost component from the graph: {fault}"
                );
            }
            info!(component = component.name, "a component is gone: {why}");
            self.present().lose(LostComponent {
                application_uri: component.application_uri,
                name: component.name,
                at_ms: now(),
                why: why.to_owned(),
            });
            self.changed.send_modify(|changes| *changes += 1);
        }
    }

    /// Returns the findings about sources and processes.
    pub(crate) fn status_findings(&self) -> Vec<Finding> {
        let mut findings = self.sources.findings();
        let processes = self.processes();
        findings.extend(processes.faults.iter().map(|(iri, why)| Finding {
            kind: SourceKind::Process,
            source: iri.clone(),
            line: None,
            what: why.to_string(),
            refused: true,
        }));
        findings
    }

    /// Returns the status page as JSON.
    pub(crate) fn status(&self) -> serde_json::Value {
        let known = self.processes();
        let findings = self.status_findings();
        let processes = known.all.iter().map(|process| {
            let steps: Vec<_> = process.steps.iter().map(|step| &step.name).collect();
            serde_json::json!({ "process": process.iri, "name": process.name, "steps": steps })
        });
        let present = self.present();
        let components: Vec<_> = present.components.values().collect();
        serde_json::json!({
            "program": "ua-mes",
            "components": components,
            "gone": present.lost(),
            "graphs": self.knowledge.sources(),
            "rules": self.knowledge.rules(),
            "findings": findings,
            "processes": processes.collect::<Vec<_>>(),
            "runs": self.runs.all(),
        })
    }

    /// Returns a skill of a component that is present.
    fn found(&self, skill: &str) -> Result<FoundSkill, ParameterFault> {
        let present = self.present();
        let mut components = present.components.values();
        let found = components.find_map(|component| component.found.get(skill));
        found.cloned().ok_or(ParameterFault::Gone)
    }

    fn present(&self) -> MutexGuard<'_, PresentComponents> {
        self.present.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[async_trait]
impl Plant for PlantState {
    fn offers(&self) -> Vec<Offer> {
        match self.knowledge.ask("candidates", &[]) {
            Ok(answer) => {
                let present = self.present();
                Offer::all(&answer, &|component| {
                    present
                        .components
                        .get(component)
                        .map_or(0, |component| component.since_ms)
                })
            }
            Err(fault) => {
                error!("{fault}");
                Vec::new()
            }
        }
    }

    fn changes(&self) -> watch::Receiver<u64> {
        self.changed.subscribe()
    }

    async fn open(&self, offers: &[Offer]) -> Result<Box<dyn Opened>, OpenFault> {
        let mut clients: BTreeMap<String, SkillClient> = BTreeMap::new();
        let mut skills: Vec<Arc<dyn RunsOfSkill>> = Vec::new();
        let mut fault = None;
        for offer in offers {
            let found = {
                let present = self.present();
                let component = present.components.get(&offer.component);
                component.and_then(|component| {
                    Some((
                        component.endpoint.clone(),
                        component.found.get(&offer.skill)?.clone(),
                    ))
                })
            };
            let broken = |why: String| {
                Some(OpenFault {
                    component: offer.component.clone(),
                    why,
                })
            };
            let Some((endpoint, found)) = found else {
                fault = broken("it is gone".to_owned());
                break;
            };
            if !clients.contains_key(&endpoint) {
                match SkillClient::connect(&endpoint, &self.client).await {
                    Ok(client) => drop(clients.insert(endpoint.clone(), client)),
                    Err(why) => {
                        fault = broken(why.to_string());
                        break;
                    }
                }
            }
            if let Some(client) = clients.get(&endpoint) {
                skills.push(Arc::new(client.handle(&found)));
            }
        }
        let opened = OpenedSkills {
            clients: clients.into_values().collect(),
            skills,
        };
        match fault {
            None => Ok(Box::new(opened)),
            Some(fault) => {
                Box::new(opened).close().await;
                Err(fault)
            }
        }
    }

    fn values(
        &self,
        skill: &str,
        given: &[GivenParameter],
    ) -> Result<Vec<(String, SkillValue)>, ParameterFault> {
        values(&self.found(skill)?, given)
    }

    async fn query(&self, query: &ParameterQuery) -> Result<serde_json::Value, ValueQueryFault> {
        let (knowledge, sparql) = (Arc::clone(&self.knowledge), query.sparql.clone());
        let value = move || ValueQuery::read(&sparql).and_then(|read| read.value(&knowledge));
        let value = spawn_blocking(value).await;
        value.unwrap_or_else(|error| Err(ValueQueryFault::Failed(error.to_string())))
    }

    fn result(&self, skill: &str, name: &str) -> Result<Option<String>, ParameterFault> {
        Ok(result(&self.found(skill)?, name)?.unit.clone())
    }

    fn connects(&self, from: (&str, &str), to: (&str, &str)) -> Result<(), ParameterFault> {
        let (source, target) = (self.found(from.0)?, self.found(to.0)?);
        connects(result(&source, from.1)?, parameter(&target, to.1)?)
    }

    fn reaches(&self, skill: &str, positions: &[[f64; 3]]) -> Result<(), ParameterFault> {
        if let Some(workspace) = self.found(skill)?.workspace {
            workspace.allows_all(positions)?;
        }
        Ok(())
    }

    fn attachment(&self, component: &str) -> Attachment {
        self.attachment_of(component)
    }

    fn plate(&self, robot: &str, gripper: &str) -> Result<[f64; 6], Unchosen> {
        self.plate_of(robot, gripper)
    }

    fn moves(&self, component: &str, changer: &str) -> bool {
        self.carries(component, changer)
    }

    async fn read_tools(&self) {
        self.read_changers().await;
    }

    fn tools(&self) -> ShownTools {
        self.shown_tools()
    }

    fn prefer(&self) -> &[String] {
        &self.prefer
    }

    fn used_by_others(&self, run: &str) -> BTreeMap<String, String> {
        self.leases.used_by_others(run)
    }

    fn lease(&self, run: &str, components: &BTreeSet<String>) -> bool {
        let change = self.leases.lease(run, components);
        if change == LeaseChange::GaveBack {
            self.changed.send_modify(|changes| *changes += 1);
        }
        change != LeaseChange::Refused
    }

    fn keep(&self, run: &ProcessRun) {
        for gone in self.runs.put(run) {
            if let Err(fault) = self
                .knowledge
                .remove(&KnowledgeSource::new(SourceKind::Run, &gone))
            {
                error!(
                    run = gone,
                    "cannot remove an old run from the graph: {fault}"
                );
            }
        }
        if let Err(fault) = self.knowledge.replace_with(
            &KnowledgeSource::new(SourceKind::Run, &run.run),
            &run.triples(),
            (run.started_ms, SourceLifetime::Yes),
        ) {
            error!(run = run.run, "cannot store a run in the graph: {fault}");
        }
    }

    fn now(&self) -> u64 {
        now()
    }
}

/// Number of processes that an error names.
const MOST_SHOWN: usize = 50;
