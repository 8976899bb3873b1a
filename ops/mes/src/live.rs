//! The current states of skills and of the services of connected modules, as statements.

use std::collections::{BTreeMap, HashMap};
use std::sync::Arc;
use std::time::Duration;

use knowledge::{
    Knowledge, KnowledgeSource, NodeName, QuestionAnswer, SourceKind, SourceLifetime,
    vocabulary as v,
};
use mtp::state::{Command, State as ServiceState};
use mtp::{Object, Triple};
use plant_opcua::client::{ClientConfig, MonitoredWatch, Notice, OpcUaClient};
use plant_opcua::types::{NodeId, Variant};
use skills::{ClientOptions, FoundSkill, SkillClient, from_variant};
use tokio::task::{Id, JoinSet};
use tokio::time::Instant;
use tracing::{debug, error, info, warn};

use crate::clock::now;

/// Publishes the states of the skills of a component until its connection is lost. `iri` returns
/// the IRI of a skill.
pub(crate) async fn skills(
    knowledge: &Knowledge,
    client: &SkillClient,
    (name, found): (&str, &[FoundSkill]),
    iri: impl Fn(&FoundSkill) -> Option<String>,
) {
    let source = KnowledgeSource::new(SourceKind::State, name);
    let _forgotten = Forgotten {
        knowledge,
        source: &source,
    };
    let mut states = client.states(found);
    let mut known: BTreeMap<String, program::ProgramMachineState> = BTreeMap::new();
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
    source: &'k KnowledgeSource,
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

fn publish(knowledge: &Knowledge, source: &KnowledgeSource, triples: &[Triple]) {
    if let Err(fault) = knowledge.replace_with(source, triples, (now(), SourceLifetime::No)) {
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
    /// The endpoint of the server that shows its state.
    endpoint: String,
    state: Option<NodeName>,
    commands: Option<NodeName>,
    commands_endpoint: String,
    /// The current words.
    state_word: Option<u32>,
    commands_word: Option<u32>,
}

/// Publishes the states of the services of a module whenever its servers can be reached. Each
/// endpoint has a connection.
pub(crate) async fn module(
    knowledge: Arc<Knowledge>,
    options: ClientOptions,
    module: WatchedModule,
) {
    let mut changes = knowledge.changes();
    let mut pauses: BTreeMap<String, Duration> = BTreeMap::new();
    let mut connections = JoinSet::new();
    let mut connected: HashMap<Id, String> = HashMap::new();
    let mut is_told = false;
    loop {
        changes.borrow_and_update();
        let services = services(&knowledge, &module.iri);
        let mut all = by_endpoint(services, module.endpoint.as_deref());
        if let Some(services) = all.remove("")
            && !std::mem::replace(&mut is_told, true)
        {
            let (module, services) = (&module.name, services.len());
            warn!(
                module,
                services, "cannot monitor services without an endpoint"
            );
        }
        let has_one = all.len() == 1;
        for (endpoint, services) in all {
            if connected.values().any(|known| *known == endpoint) {
                continue;
            }
            let name = match has_one {
                true => module.name.clone(),
                false => format!("{} {endpoint}", module.name),
            };
            let connection = Connection {
                knowledge: Arc::clone(&knowledge),
                source: KnowledgeSource::new(SourceKind::State, &name),
                module: module.name.clone(),
                endpoint: endpoint.clone(),
                pause: pauses.get(&endpoint).copied().unwrap_or(AGAIN),
            };
            let task = connections.spawn(connection.once(options.clone(), services));
            connected.insert(task.id(), endpoint);
        }
        tokio::select! {
            Some(ended) = connections.join_next_with_id() => {
                let (id, pause) = match ended {
                    Ok((id, pause)) => (id, pause),
                    Err(fault) => (fault.id(), AGAIN_AT_MOST),
                };
                if let Some(endpoint) = connected.remove(&id) {
                    pauses.insert(endpoint, pause);
                }
            }
            // The manifest is not in the graph.
            changed = changes.changed(), if connections.is_empty() => {
                if changed.is_err() {
                    return;
                }
            }
        }
    }
}

/// Returns the services by the endpoints of their servers, which may be empty. With `instead`, all
/// are at this endpoint.
fn by_endpoint(
    services: BTreeMap<String, Watched>,
    instead: Option<&str>,
) -> BTreeMap<String, BTreeMap<String, Watched>> {
    let mut all: BTreeMap<String, BTreeMap<String, Watched>> = BTreeMap::new();
    for (iri, mut service) in services {
        let endpoint = instead.unwrap_or(&service.endpoint).to_owned();
        if instead.is_none() && service.commands_endpoint != endpoint {
            // The word is at another server.
            service.commands = None;
        }
        all.entry(endpoint).or_default().insert(iri, service);
    }
    all
}

/// A connection to a server of a module.
struct Connection {
    knowledge: Arc<Knowledge>,
    source: KnowledgeSource,
    module: String,
    endpoint: String,
    /// Pause before the next connection.
    pause: Duration,
}

impl Connection {
    /// Publishes the states of the services of the server once, until the connection is lost, and
    /// waits before the next time. Returns the next pause.
    async fn once(
        self,
        options: ClientOptions,
        mut services: BTreeMap<String, Watched>,
    ) -> Duration {
        let config = ClientConfig {
            pki: options.pki.clone(),
            user: options.user.clone(),
            security: options.security,
            timeout: options.within,
            ..ClientConfig::new(&options.application_uri, &options.application_name)
        };
        let client = OpcUaClient::open(config, &self.endpoint);
        let lasted = match client.up(CONNECTS).await {
            Ok(()) => {
                let began = Instant::now();
                self.connected(&client, &mut services).await;
                Some(began.elapsed())
            }
            Err(_) => None,
        };
        client.close().await;
        let (now, next) = pauses(self.pause, lasted);
        tokio::time::sleep(now).await;
        next
    }

    /// Publishes the states of services until the connection is lost.
    async fn connected(&self, client: &OpcUaClient, services: &mut BTreeMap<String, Watched>) {
        let _forgotten = Forgotten {
            knowledge: &self.knowledge,
            source: &self.source,
        };
        let (module, endpoint) = (&self.module, &self.endpoint);
        info!(module, endpoint, "a module is connected");
        watch(&self.knowledge, client, &self.source, services).await;
        info!(module, endpoint, "a module is disconnected");
    }
}

/// Returns the pause after a connection that lasted so long, and the pause after the next one. The
/// pauses of a module that accepts connections and drops them grow.
fn pauses(pause: Duration, lasted: Option<Duration>) -> (Duration, Duration) {
    match lasted {
        // The time until the connection fails is a pause too, and nothing is logged.
        None => (AGAIN, pause),
        Some(lasted) if lasted > AGAIN_AT_MOST => (AGAIN, AGAIN),
        Some(_) => (pause, (pause * 2).min(AGAIN_AT_MOST)),
    }
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
        let skill = QuestionAnswer::text(&row, "skill");
        let Some((service, _)) = skill.split_once("/procedure/") else {
            continue;
        };
        if !service.starts_with(&start) {
            continue;
        }
        let watched = services.entry(service.to_owned()).or_default();
        watched.skills.push(skill.to_owned());
        QuestionAnswer::text(&row, "endpoint").clone_into(&mut watched.endpoint);
        watched.state = node_name(QuestionAnswer::text(&row, "node"));
    }
    for row in ask("access-of") {
        let of = QuestionAnswer::text(&row, "of");
        if let Some(service) = of.strip_suffix("/node/CommandEnabled")
            && let Some(watched) = services.get_mut(service)
        {
            QuestionAnswer::text(&row, "endpoint").clone_into(&mut watched.commands_endpoint);
            watched.commands = node_name(QuestionAnswer::text(&row, "node"));
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

/// Returns the nodes of services to watch; for each, the service and whether the node is its state.
fn watches(
    client: &OpcUaClient,
    services: &BTreeMap<String, Watched>,
) -> (Vec<MonitoredWatch>, Vec<(String, bool)>) {
    let mut watches = Vec::new();
    let mut of = Vec::new();
    for (iri, service) in services {
        for (node, is_state) in [(&service.state, true), (&service.commands, false)] {
            let Some(node) = node else { continue };
            let Some(id) = node_id(client, node) else {
                let namespace = &node.namespace;
                info!(service = iri, namespace, "the server has no such namespace");
                continue;
            };
            watches.push(MonitoredWatch::Value(id));
            of.push((iri.clone(), is_state));
        }
    }
    (watches, of)
}

/// Publishes the states of services until the connection is lost.
async fn watch(
    knowledge: &Knowledge,
    client: &OpcUaClient,
    source: &KnowledgeSource,
    services: &mut BTreeMap<String, Watched>,
) {
    let (watches, of) = watches(client, services);
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

fn node_id(client: &OpcUaClient, node: &NodeName) -> Option<NodeId> {
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
const AGAIN_AT_MOST: Duration = Duration::from_secs(30);
/// Publishing interval of the states of services.
const INTERVAL: Duration = Duration::from_millis(50);
const QUEUE: usize = 1024;

#[cfg(test)]
mod tests {
    use plant_opcua::server::{OpcUaServer, ServerBuilder, ServerConfig, VariableSpec};
    use plant_opcua::types::{
        DataTypeId, DataValue, LocalizedText, ObjectId, QualifiedName, ReferenceTypeId,
        VariableTypeId,
    };

    use super::*;

    const STAGE: &str = include_str!("../../../tests/data/mtp/stage.aml");

    /// The manifest of the tests, with the nodes of the service Solo at a server of its own.
    fn with_two_servers() -> String {
        let mut own = String::new();
        let mut rest = String::new();
        for line in STAGE.lines() {
            let is_own = line.starts_with("<ExternalInterface Name=\"Solo_");
            let to = if is_own { &mut own } else { &mut rest };
            to.push_str(line);
            to.push('\n');
        }
        let server = "<InternalElement Name=\"Server\"";
        let second = format!(
            "<InternalElement Name=\"Second\" ID=\"second\" \
             RefBaseSystemUnitPath=\"MTPCommunicationSUCLib/ServerAssembly/OPCUAServer\">\n\
             <Attribute Name=\"Endpoint\" AttributeDataType=\"xs:string\">\
             <Value>opc.tcp://127.0.0.1:4841</Value></Attribute>\n{own}</InternalElement>\n{server}"
        );
        assert!(!own.is_empty());
        rest.replacen(server, &second, 1)
    }

    fn services_of(manifest: &str) -> BTreeMap<String, Watched> {
        let module = mtp::Module::from_bytes(manifest.as_bytes()).unwrap();
        let triples = module.triples("urn:m", &BTreeMap::new());
        let knowledge = Knowledge::new().unwrap();
        let source = KnowledgeSource::new(SourceKind::Mtp, "stage");
        knowledge.replace(&source, &triples, 1).unwrap();
        services(&knowledge, "urn:m")
    }

    /// Returns the numbers of services and of their nodes by endpoint.
    fn counted(all: &BTreeMap<String, BTreeMap<String, Watched>>) -> Vec<(&str, usize, usize)> {
        let nodes =
            |one: &Watched| usize::from(one.state.is_some()) + usize::from(one.commands.is_some());
        all.iter()
            .map(|(endpoint, services)| {
                let nodes = services.values().map(nodes).sum();
                (endpoint.as_str(), services.len(), nodes)
            })
            .collect()
    }

    #[test]
    fn each_server_of_a_module_has_its_services() {
        const FIRST: &str = "opc.tcp://127.0.0.1:4840";
        let one = by_endpoint(services_of(STAGE), None);
        assert_eq!(counted(&one), [(FIRST, 2, 4)]);
        let services = services_of(&with_two_servers());
        let two = by_endpoint(services.clone(), None);
        let second = ("opc.tcp://127.0.0.1:4841", 1, 2);
        assert_eq!(counted(&two), [(FIRST, 1, 2), second]);
        let instead = by_endpoint(services, Some("opc.tcp://h:1"));
        assert_eq!(counted(&instead), [("opc.tcp://h:1", 2, 4)]);
        let without = BTreeMap::from([("urn:m/service/1".to_owned(), Watched::default())]);
        assert_eq!(counted(&by_endpoint(without, None)), [("", 1, 0)]);
    }

    /// Starts a server that shows the state of a service.
    fn serves(service: &str, state: ServiceState) -> OpcUaServer {
        const NAMESPACE: &str = "urn:ua-bridge:test:stage";
        let uri = format!("urn:test:{service}");
        let config = ServerConfig::new(&uri, service, "opc.tcp://127.0.0.1:0".parse().unwrap());
        let server = ServerBuilder::new(config)
            .namespace(NAMESPACE)
            .build()
            .unwrap();
        let index = server.namespace(NAMESPACE).unwrap();
        let name = format!("{service}.StateCur");
        let variable = VariableSpec {
            node_id: NodeId::new(index, name.clone()),
            browse_name: QualifiedName::new(index, name.as_str()),
            display_name: LocalizedText::from(name.as_str()),
            type_definition: VariableTypeId::BaseDataVariableType.into(),
            parent: ObjectId::ObjectsFolder.into(),
            reference: ReferenceTypeId::Organizes.into(),
            data_type: DataTypeId::UInt32.into(),
            value_rank: -1,
            value: DataValue::new_now(Variant::UInt32(state.bit())),
            writable: false,
        };
        server.add_variable(&variable).unwrap();
        server.start();
        server
    }

    #[tokio::test]
    async fn the_states_of_a_module_with_two_servers_are_those_of_both() {
        let solo = serves("Solo", ServiceState::Completed);
        let duet = serves("Duet", ServiceState::Idle);
        let manifest = with_two_servers()
            .replace("opc.tcp://127.0.0.1:4841", solo.url())
            .replace("opc.tcp://127.0.0.1:4840", duet.url());
        let manifest = mtp::Module::from_bytes(manifest.as_bytes()).unwrap();
        let triples = manifest.triples("urn:m", &BTreeMap::new());
        let knowledge = Arc::new(Knowledge::new().unwrap());
        let source = KnowledgeSource::new(SourceKind::Mtp, "stage");
        knowledge.replace(&source, &triples, 1).unwrap();
        let watched = WatchedModule {
            name: "stage".to_owned(),
            iri: "urn:m".to_owned(),
            endpoint: None,
        };
        let states = || {
            let rows = knowledge.ask("state-of", &[]).unwrap().rows;
            let known = rows.iter().map(|row| {
                let (service, _) = QuestionAnswer::text(row, "skill_name")
                    .split_once('/')
                    .unwrap();
                (
                    service.to_owned(),
                    QuestionAnswer::text(row, "state").to_owned(),
                )
            });
            let known: BTreeMap<_, _> = known.filter(|(_, state)| !state.is_empty()).collect();
            known
        };
        let until = async |wanted: &[(&str, &str)]| {
            let wanted = wanted
                .iter()
                .map(|(service, state)| ((*service).to_owned(), (*state).to_owned()))
                .collect();
            let mut changes = knowledge.changes();
            let known = async {
                while states() != wanted {
                    changes.changed().await.unwrap();
                }
            };
            let in_time = tokio::time::timeout(Duration::from_secs(20), known).await;
            assert!(in_time.is_ok(), "{:?}", states());
        };
        let options = ClientOptions::default();
        let task = tokio::spawn(module(Arc::clone(&knowledge), options, watched));
        let idle = ("Duet", "Idle");
        until(&[idle, ("Solo", "Completed")]).await;
        // The loss of one server leaves the states of the other.
        solo.stop().await;
        until(&[idle]).await;
        task.abort();
        assert!(task.await.unwrap_err().is_cancelled());
        until(&[]).await;
        duet.stop().await;
    }

    #[test]
    fn the_pauses_of_a_module_that_drops_its_connections_grow() {
        let mut pause = AGAIN;
        let mut waited = Vec::new();
        for _ in 0..7 {
            let (now, next) = pauses(pause, Some(Duration::from_millis(3)));
            waited.push(now.as_secs());
            pause = next;
        }
        assert_eq!(waited, [1, 2, 4, 8, 16, 30, 30]);
        assert_eq!(pauses(pause, None), (AGAIN, AGAIN_AT_MOST));
        let long = Some(Duration::from_secs(60));
        assert_eq!(pauses(pause, long), (AGAIN, AGAIN));
    }
}
