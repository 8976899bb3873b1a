//! The current states of skills and of the services of connected modules, as statements.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use knowledge::{Answer, Knowledge, Lasting, NodeName, Source, SourceKind, vocabulary as v};
use mtp::state::{Command, State as ServiceState};
use mtp::{Object, Triple};
use plant_opcua::client::{Client, ClientConfig, Notice, Watch};
use plant_opcua::types::{NodeId, Variant};
use skills::{ClientOptions, FoundSkill, SkillClient, from_variant};
use tracing::{debug, error, info};

use crate::cell::now;

/// Publishes the states of the skills of a component until its connection is lost. `iri` returns
/// the IRI of a skill.
pub(crate) async fn skills(
    knowledge: &Knowledge,
    client: &SkillClient,
    (name, found): (&str, &[FoundSkill]),
    iri: impl Fn(&FoundSkill) -> Option<String>,
) {
    let source = Source::new(SourceKind::State, name);
    let _forgotten = Forgotten {
        knowledge,
        source: &source,
    };
    let mut states = client.states(found);
    let mut known: BTreeMap<String, program::State> = BTreeMap::new();
    loop {
        let next = tokio::select! {
            next = states.next() => next,
            why = client.lost() => {
                debug!(component = name, "the states are unknown: {why}");
                None
            }
        };
        let Some((at, state)) = next else { break };
        let Some(skill) = found.get(at).and_then(&iri) else {
            continue;
        };
        known.insert(skill, state);
        let triples = known.iter().flat_map(|(skill, state)| {
            let state_iri = format!("{PROGRAM_STATES}{state}");
            of_state(skill, &state_iri, (state.name(), state.number().into()))
        });
        publish(knowledge, &source, &triples.collect::<Vec<_>>());
    }
}

/// Removes the states of a component or a module when their task ends, also when it is aborted.
struct Forgotten<'k> {
    knowledge: &'k Knowledge,
    source: &'k Source,
}

impl Drop for Forgotten<'_> {
    fn drop(&mut self) {
        if let Err(fault) = self.knowledge.remove(self.source) {
            let source = &self.source.name;
            error!(source, "cannot remove the states: {fault}");
        }
    }
}

/// Returns the statements that a skill is in a state.
fn of_state(skill: &str, state: &str, (name, value): (&str, i64)) -> Vec<Triple> {
    let triple = |subject: &str, predicate: &str, object| Triple {
        subject: subject.to_owned(),
        predicate: predicate.to_owned(),
        object,
    };
    vec![
        triple(skill, v::HAS_CURRENT_STATE, Object::Iri(state.to_owned())),
        triple(state, v::RDF_TYPE, Object::Iri(v::STATE.to_owned())),
        triple(state, v::RDFS_LABEL, Object::Text(name.to_owned())),
        triple(state, v::STATE_VALUE, Object::Integer(value)),
    ]
}

fn publish(knowledge: &Knowledge, source: &Source, triples: &[Triple]) {
    if let Err(fault) = knowledge.replace_with(source, triples, (now(), Lasting::No)) {
        error!(source = source.name, "cannot publish the states: {fault}");
    }
}

/// A module with watched services.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct WatchedModule {
    /// The name of its manifest.
    pub(crate) name: String,
    /// The IRI of the module.
    pub(crate) iri: String,
    /// The endpoint in place of the endpoint in the manifest.
    pub(crate) endpoint: Option<String>,
}

/// A service of the graph.
#[derive(Debug, Clone, Default)]
struct Watched {
    /// The IRIs of its procedures.
    skills: Vec<String>,
    endpoint: String,
    state: Option<NodeName>,
    commands: Option<NodeName>,
    /// The current words.
    state_word: Option<u32>,
    commands_word: Option<u32>,
}

/// Publishes the states of the services of a module whenever the module can be reached.
pub(crate) async fn module(
    knowledge: Arc<Knowledge>,
    options: ClientOptions,
    module: WatchedModule,
) {
    let source = Source::new(SourceKind::State, &module.name);
    let mut changes = knowledge.changes();
    loop {
        changes.borrow_and_update();
        let mut services = services(&knowledge, &module.iri);
        let endpoint = module.endpoint.clone().or_else(|| {
            let mut known = services.values();
            known.next().map(|service| service.endpoint.clone())
        });
        let Some(endpoint) = endpoint else {
            // The manifest is not in the graph.
            if changes.changed().await.is_err() {
                return;
            }
            continue;
        };
        let config = ClientConfig {
            pki: options.pki.clone(),
            user: options.user.clone(),
            security: options.security,
            timeout: options.within,
            ..ClientConfig::new(&options.application_uri, &options.application_name)
        };
        let client = Client::open(config, &endpoint);
        if client.up(CONNECTS).await.is_ok() {
            let forgotten = Forgotten {
                knowledge: &knowledge,
                source: &source,
            };
            connected(
                &forgotten,
                &client,
                (&module.name, &endpoint),
                &mut services,
            )
            .await;
        }
        client.close().await;
        tokio::time::sleep(AGAIN).await;
    }
}

/// Publishes the states of services of a module until the connection is lost.
async fn connected(
    to: &Forgotten<'_>,
    client: &Client,
    (module, endpoint): (&str, &str),
    services: &mut BTreeMap<String, Watched>,
) {
    info!(module, endpoint, "a module is connected");
    watch(to.knowledge, client, to.source, services).await;
    info!(module, endpoint, "a module is disconnected");
}

/// Returns the services of a module by their IRIs.
fn services(knowledge: &Knowledge, module: &str) -> BTreeMap<String, Watched> {
    let ask = |name: &str| match knowledge.ask(name, &[]) {
        Ok(answer) => answer.rows,
        Err(fault) => {
            error!("{fault}");
            Vec::new()
        }
    };
    let mut services: BTreeMap<String, Watched> = BTreeMap::new();
    let start = format!("{module}/service/");
    for row in ask("state-of") {
        let skill = Answer::text(&row, "skill");
        let Some((service, _)) = skill.split_once("/procedure/") else {
            continue;
        };
        if !service.starts_with(&start) {
            continue;
        }
        let watched = services.entry(service.to_owned()).or_default();
        watched.skills.push(skill.to_owned());
        Answer::text(&row, "endpoint").clone_into(&mut watched.endpoint);
        watched.state = node_name(Answer::text(&row, "node"));
    }
    for row in ask("access-of") {
        let of = Answer::text(&row, "of");
        if let Some(service) = of.strip_suffix("/node/CommandEnabled")
            && let Some(watched) = services.get_mut(service)
        {
            watched.commands = node_name(Answer::text(&row, "node"));
        }
    }
    services
}

/// Parses a NodeId with a namespace URI, or with an index as some manifests have it.
fn node_name(id: &str) -> Option<NodeName> {
    if let Some(rest) = id.strip_prefix("ns=") {
        let (index, identifier) = rest.split_once(';')?;
        return Some(NodeName {
            namespace: index.to_owned(),
            identifier: identifier.to_owned(),
        });
    }
    NodeName::parse(id)
}

/// Publishes the states of services until the connection is lost.
async fn watch(
    knowledge: &Knowledge,
    client: &Client,
    source: &Source,
    services: &mut BTreeMap<String, Watched>,
) {
    let mut watches = Vec::new();
    let mut of: Vec<(String, bool)> = Vec::new();
    for (iri, service) in services.iter() {
        for (node, is_state) in [(&service.state, true), (&service.commands, false)] {
            if let Some(node) = node.as_ref().and_then(|node| node_id(client, node)) {
                watches.push(Watch::Value(node));
                of.push((iri.clone(), is_state));
            }
        }
    }
    let mut subscription = client.subscribe(watches, INTERVAL, QUEUE);
    let mut link = client.link();
    let is_down =
        |link: &plant_opcua::client::Link| !matches!(link, plant_opcua::client::Link::Up { .. });
    loop {
        let notice = tokio::select! {
            notice = subscription.next() => notice,
            _ = link.wait_for(is_down) => return,
        };
        let (watch, value) = match notice {
            Some(Notice::Value { watch, value }) => {
                let is_good = value.status.is_none_or(|status| status.is_good());
                (watch, value.value.filter(|_| is_good))
            }
            Some(Notice::Refused { watch, status }) => {
                let service = of.get(watch).map(|(iri, _)| iri.as_str());
                info!(service, %status, "the state of a service cannot be watched");
                continue;
            }
            Some(Notice::Subscribed | Notice::Event { .. }) => continue,
            None => return,
        };
        let Some((service, is_state)) = of.get(watch) else {
            continue;
        };
        let Some(service) = services.get_mut(service) else {
            continue;
        };
        let word = value.as_ref().and_then(word);
        match is_state {
            true => service.state_word = word,
            false => service.commands_word = word,
        }
        let triples: Vec<Triple> = services
            .iter()
            .flat_map(|(iri, service)| service.triples(iri))
            .collect();
        publish(knowledge, source, &triples);
    }
}

impl Watched {
    fn triples(&self, iri: &str) -> Vec<Triple> {
        let Some(word) = self.state_word else {
            return Vec::new();
        };
        let known = ServiceState::of_bit(word);
        let mut triples = Vec::new();
        for skill in &self.skills {
            match known {
                // The state itself is in the graph of the manifest.
                Some(state) => triples.push(Triple {
                    subject: skill.clone(),
                    predicate: v::HAS_CURRENT_STATE.to_owned(),
                    object: Object::Iri(mtp::state_iri(iri, state)),
                }),
                None => {
                    let unknown = format!("{iri}/machine/state/Undefined");
                    triples.extend(of_state(skill, &unknown, ("Undefined", word.into())));
                }
            }
            let Some(commands) = self.commands_word else {
                continue;
            };
            triples.push(Triple {
                subject: skill.clone(),
                predicate: v::COMMANDS_ARE_KNOWN.to_owned(),
                object: Object::Boolean(true),
            });
            let enabled = Command::ALL.iter();
            let enabled = enabled.filter(|command| commands & command.bit() != 0);
            triples.extend(enabled.map(|command| Triple {
                subject: skill.clone(),
                predicate: v::ENABLES_COMMAND.to_owned(),
                object: Object::Iri(format!("{iri}/command/{command}")),
            }));
        }
        triples
    }
}

fn word(value: &Variant) -> Option<u32> {
    let number = from_variant(value)?.to_json().as_i64()?;
    u32::try_from(number).ok()
}

fn node_id(client: &Client, node: &NodeName) -> Option<NodeId> {
    let index = match node.namespace.parse() {
        Ok(index) => index,
        Err(_) => client.namespace(&node.namespace)?,
    };
    let (kind, identifier) = node.identifier.split_once('=')?;
    match kind {
        "i" => Some(NodeId::new(index, identifier.parse::<u32>().ok()?)),
        "s" => Some(NodeId::new(index, identifier)),
        _ => None,
    }
}

/// The IRIs of the states of a Program begin with this text.
const PROGRAM_STATES: &str = "urn:ua-bridge:program-state:";
const CONNECTS: Duration = Duration::from_secs(5);
/// Pause before the next connection.
const AGAIN: Duration = Duration::from_secs(1);
/// Publishing interval of the states of services.
const INTERVAL: Duration = Duration::from_millis(50);
const QUEUE: usize = 1024;
