//! The local side of a component: its OPC UA server and skills, with values and calls of the space.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::num::NonZeroU16;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use bridge_node::actions::OwnActions;
use bridge_node::{
    Application, AskId, CallDescription, CallResponse, Executed, Execution, ExecutionId, Failure,
    FailureKind, LinkState, LocalDelivery, Port, PortEvent, TopicMetaData, TypePaths, now,
};
use bytes::Bytes;
use discovery::{AnnounceSettings, MdnsInterface, ServerAnnouncement};
use mappings::{Mapping, PubSub, TopicId};
use plant_opcua::endpoint::EndpointUrl;
use plant_opcua::enrolment::{Enrolment, Invitation};
use plant_opcua::own;
use plant_opcua::supervision::Supervision;
use program::{ProgramMachineState, ProgramMethod};
use skills::server::{ComponentServer, PowerOff, ServeFault, ServeSettings};
use skills::{
    Component, ComponentSecurity, DriverSetup, LiveValue, PeerAccess, Skill, SkillOwner, Takes,
    ValueSource,
};
use tokio::sync::mpsc;
use tokio::task::{AbortHandle, JoinSet};
use tracing::{info, warn};
use uadp::BuiltinType;

use crate::asking::Asking;
use crate::executor::SkillExecutor;
use crate::goals::{self, Doer, Reporter};
use crate::idle::{Usage, restart_when_idle};
use crate::partners;
use crate::reload::{ComponentFile, Version};
use crate::space::{ComponentOutbox, ComponentPlace, GOAL, MOST_IN_SPACE, Speaker};
use crate::topics::Topics;
use crate::work::with_drivers;

/// The options of a component beside its definition.
#[derive(Debug, Clone, Default)]
pub struct ComponentOptions {
    /// The certificate store, which Basic256Sha256 needs.
    pub pki: Option<PathBuf>,
    /// Trusts every client certificate. For tests and demonstrations only.
    pub trust_any_client: bool,
    /// The network interface for announcements by mDNS; `None` for no announcements.
    pub mdns: Option<MdnsInterface>,
    /// The announced capability codes of OPC 10000-12, annex D.
    pub capabilities: Vec<String>,
    /// The Global Discovery Server that issues the certificate. Needs `pki`.
    pub gds: Option<Invitation>,
    /// The file with the configuration of the component; `None` for a configuration that is lost
    /// at the end of the program.
    pub configuration: Option<PathBuf>,
    /// The text and the name of the YAML file, for findings.
    pub source: Option<(String, String)>,
    /// The YAML file, which is read again while the component runs.
    pub file: Option<Arc<ComponentFile>>,
    /// Additional objects of the component in its OPC UA server.
    pub extensions: Vec<Arc<dyn skills::server::Extension>>,
}

/// Returns the mapping of a component, which has a single namespace and no variables.
#[must_use]
pub fn made(component: &Component) -> Mapping {
    let namespaces = BTreeMap::from([(component.namespace, component.application_uri.clone())]);
    Mapping::made(PubSub::default(), namespaces)
}

/// A running component.
pub struct ComponentPort {
    server: ComponentServer,
    announced: Option<ServerAnnouncement>,
    outbox: ComponentOutbox,
    /// Events that are reported before all others: announcements and refused requests.
    first: VecDeque<PortEvent>,
    executed: mpsc::Receiver<PortEvent>,
    executes: mpsc::Sender<PortEvent>,
    /// The skills as actions.
    actions: OwnActions,
    /// The tasks of discovery, which run as long as the component.
    _looks: JoinSet<()>,
    /// Requests of skills to others.
    asking: Asking,
    /// The topics that values of the component are received from.
    topics: Topics,
    /// The values with sources outside of the component.
    measured: Vec<LiveValue>,
    /// The application as it is described to the group.
    application: Application,
    /// The skills that are being halted because the component stops.
    closing: Arc<Mutex<BTreeSet<String>>>,
    /// The certificate store.
    pki: Option<PathBuf>,
    /// The YAML file and the version that drivers were made of last.
    versions: Option<(Arc<ComponentFile>, Arc<Version>)>,
    /// The wait for a restart, after a change that needs it.
    restarting: Option<AbortOnDrop>,
}

impl ComponentPort {
    /// Serves a component and announces it. Needs a tokio runtime.
    ///
    /// # Errors
    /// Returns an error if the definition has faults, which are printed before; if the address
    /// cannot be bound; or if the certificates cannot be used.
    pub fn start(component: &Component, options: &ComponentOptions) -> Result<Self, Failure> {
        let place = ComponentPlace {
            component: component.name.clone(),
            namespace: component.namespace,
            open: component.open,
        };
        let outbox = ComponentOutbox::default();
        let mut first = VecDeque::new();
        let peers = PeerAccess::of_component(component, options.pki.as_deref());
        let mut looks = partners::look(&peers, options.mdns.as_ref());
        let settings = ServeSettings {
            peers,
            pki: options.pki.clone(),
            trust_any_client: options.trust_any_client,
            first_run: run_number_of_now(),
            supervision: Supervision::default(),
            power_off: component.power_off.then(power_off),
            configuration: options.configuration.clone(),
            extensions: options.extensions.clone(),
        };
        let mut reporters = Vec::new();
        let (mut asking, mut topics) = (Asking::new(), Topics::default());
        let component = &with_drivers(component, &mut asking, &mut topics);
        let server = ComponentServer::build(component, &settings, |number, facts| {
            let reporter = Reporter::new();
            reporters.push(reporter.clone());
            first.extend(place.announce(number, facts, &ProgramMethod::ALL));
            let Some(speaker) = Speaker::new(outbox.clone(), &place, number) else {
                return vec![Box::new(reporter)];
            };
            speaker.at_first(facts, Some(ProgramMachineState::Halted));
            vec![Box::new(speaker), Box::new(reporter)]
        });
        let server = server.map_err(|fault| failure(fault, options))?;
        let mut actions = OwnActions::default();
        for (number, (skill, reporter)) in (1..).zip(server.skills().iter().zip(reporters)) {
            if let Some(topic) = place.topic(number, GOAL) {
                let with = (&*place.component, place.open);
                let action = goals::action(topic, with, skill.facts());
                let added = actions.add(
                    &action,
                    Doer::new(SkillExecutor::Own(skill.clone()), reporter),
                );
                first.extend(added.unwrap_or_default());
            }
        }
        let measured = show_values(component, &server, (&place, &outbox), &mut looks);
        first.extend(announced_values(&server, &place));
        server.start();
        let told = told_of(component, server.url(), options);
        let application = application(&told, &component.security);
        enrol(&mut looks, (component, &told), options, &server);
        let announced = announce(told, component, options, settings.supervision);
        log_served(component, &server);
        let (executes, executed) = mpsc::channel(MOST_EXECUTIONS);
        Ok(Self {
            server,
            announced,
            outbox,
            first,
            executed,
            executes,
            actions,
            _looks: looks,
            asking,
            topics,
            measured,
            application,
            closing: Arc::default(),
            pki: options.pki.clone(),
            versions: options.file.clone().map(versions),
            restarting: None,
        })
    }

    /// Returns the URL of the server.
    #[must_use]
    pub fn url(&self) -> &str {
        self.server.url()
    }

    /// Returns the skills, by their numbers from 1.
    #[must_use]
    pub fn skills(&self) -> &[Skill] {
        self.server.skills()
    }

    /// Adopts the latest version of the YAML file. Returns the changes that only a restart by the
    /// operator takes up.
    fn adopt(&mut self) -> Vec<String> {
        let Some((file, adopted)) = &mut self.versions else {
            return Vec::new();
        };
        let latest = file.latest();
        let names = replaced_drivers(adopted, &latest);
        let component = Component {
            values: Vec::new(),
            ..latest.component.clone()
        };
        let component = with_drivers(&component, &mut self.asking, &mut self.topics);
        let changes = Component::changes(&file.started().text, &latest.text);
        match self.server.replace_drivers(&component, &names) {
            Ok(()) => *adopted = latest,
            // A change that needs a restart comes with it. Drivers that were not replaced are
            // compared with the next version again.
            Err(fault) => warn!("the drivers stay as they are until the restart: {fault}"),
        }
        let of = |takes: Takes| {
            let changes = changes.iter().filter(move |change| change.takes == takes);
            changes.map(|change| change.path.clone())
        };
        let by_operator: Vec<String> = of(Takes::Operator).collect();
        let by_itself: Vec<String> = of(Takes::Restart).collect();
        self.restarting = None;
        if !by_operator.is_empty() {
            return by_operator.into_iter().chain(by_itself).collect();
        }
        if !by_itself.is_empty() {
            let why = format!("with {}", by_itself.join(", "));
            let usage = Usage::of(&self.server, Some(Arc::clone(file)));
            let waits = tokio::spawn(restart_when_idle(usage, why));
            self.restarting = Some(AbortOnDrop(waits.abort_handle()));
        }
        Vec::new()
    }

    fn skill(&self, topic: TopicId) -> Option<(Skill, ProgramMethod)> {
        let (number, method) = ComponentPlace::call(topic)?;
        let skill = self
            .server
            .skills()
            .get(usize::from(number.checked_sub(1)?))?;
        Some((skill.clone(), method))
    }
}

impl Port for ComponentPort {
    async fn recv(&mut self) -> PortEvent {
        if let Some(event) = self.first.pop_front() {
            return event;
        }
        tokio::select! {
            biased;
            Some(event) = self.executed.recv() => event,
            event = self.asking.next() => event,
            event = self.actions.recv() => event,
            event = self.outbox.next() => event,
        }
    }

    fn certificate(&self) -> Option<serde_json::Value> {
        own::status(self.pki.as_deref()?)
    }

    fn application(&self) -> Option<Application> {
        Some(self.application.clone())
    }

    /// Returns the topics of values and the calls of skills that the component takes from others.
    fn used_topics(&self) -> Option<Vec<TopicId>> {
        let topics = self.topics.all().chain(self.asking.wanted());
        Some(topics.collect())
    }

    /// Takes the values that the component shows. Other values do not count as losses.
    fn publish(&mut self, sample: LocalDelivery) -> Result<(), &'static str> {
        self.topics.received(&sample);
        Ok(())
    }

    fn wanted(
        &mut self,
        _topic: TopicId,
        _shape: &[(BuiltinType, bool)],
        _described: Option<&TopicMetaData>,
    ) {
        // Values of others have no type here: they are fields.
    }

    fn silent(&mut self, topic: TopicId, silent: bool) {
        self.topics.set_silent(topic, silent);
    }

    /// Returns the sources of values, with the reasons of unknown values.
    fn links(&self) -> Vec<LinkState> {
        if self.measured.is_empty() {
            return Vec::new();
        }
        let faults: BTreeMap<String, String> = self
            .measured
            .iter()
            .filter_map(|value| {
                let why = value.reading().value.err()?;
                Some((value.facts().name.clone(), why.to_string()))
            })
            .collect();
        vec![LinkState {
            name: "values".to_owned(),
            up: faults.is_empty(),
            why: faults
                .first_key_value()
                .map(|(name, why)| format!("{name}: {why}")),
            faults,
            ..LinkState::default()
        }]
    }

    fn call_known(&mut self, topic: TopicId, description: &Arc<CallDescription>) {
        self.asking.known(topic, description);
    }

    fn call_gone(&mut self, topic: TopicId) {
        self.asking.gone(topic);
    }

    fn answered(&mut self, ask: AskId, _topic: TopicId, answer: CallResponse<Bytes>) {
        self.asking.answered(ask, answer);
    }

    fn execute(&mut self, execution: Execution) -> bool {
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
        let Some((skill, method)) = self.skill(execution.topic) else {
            return false;
        };
        // Space for the answer is reserved before the machine moves.
        let Ok(room) = self.executes.clone().try_reserve_owned() else {
            return false;
        };
        let by = execution
            .requestor
            .map_or(SkillOwner::Local("a tool in the space"), |space| {
                SkillOwner::Space(space.get().into())
            });
        let Execution {
            id,
            request,
            start_by,
            ..
        } = execution;
        let skill = SkillExecutor::Own(skill);
        drop(tokio::spawn(async move {
            let condition = Box::new(move || now().monotonic <= start_by);
            let outcome = skill.execute((by, method), &request, condition).await;
            drop(room.send(PortEvent::Executed {
                execution: id,
                outcome,
            }));
        }));
        true
    }

    fn abandoned(&mut self, execution: ExecutionId, _topic: TopicId) {
        // A call lasts a second or two. Its run continues, and the outcome can be requested later.
        self.actions.abandoned(execution);
    }

    fn reload(&mut self, _mapping: &Arc<Mapping>, _types: &Arc<TypePaths>) -> Vec<String> {
        self.adopt()
    }

    fn closing(&mut self) {
        for skill in self.server.skills() {
            let (skill, closing) = (skill.clone(), Arc::clone(&self.closing));
            let name = skill.facts().name.clone();
            lock(&closing).insert(name.clone());
            drop(tokio::spawn(async move {
                skill.close().await;
                lock(&closing).remove(&name);
            }));
        }
    }

    fn pending(&self) -> Vec<String> {
        let closing = lock(&self.closing);
        let pending = self.server.skills().iter().filter_map(|skill| {
            let (shown, name) = (skill.shown(), &skill.facts().name);
            match &shown.pending {
                Some(why) => Some(format!("{name}, run {}: {why}", shown.run)),
                None => closing
                    .contains(name)
                    .then(|| format!("{name}, run {}: it is halted", shown.run)),
            }
        });
        pending.collect()
    }

    async fn shutdown(self) {
        let leaving = async {
            if let Some(announced) = self.announced {
                announced.leave().await;
            }
        };
        // Both take about a second; connections that are still open then are dropped.
        let ended = tokio::time::timeout(SHUTDOWN, async {
            tokio::join!(leaving, self.server.stop())
        });
        if ended.await.is_err() {
            warn!("dropped the connections that did not close in time");
        }
    }
}

/// Checks if a component could be served: its types, NodeSets and drivers. The server listens on a
/// random port of the loopback interface, which is not announced.
///
/// # Errors
/// Returns the errors of [`ComponentPort::start`].
pub fn check(component: &Component, options: &ComponentOptions) -> Result<(), Failure> {
    built_and_stopped(component)?.map_err(|fault| failure(fault, options))
}

/// Builds the server of a component in a runtime of its own, and stops it. Its tasks, such as the
/// measurements of values, never run.
pub(crate) fn built_and_stopped(component: &Component) -> Result<Result<(), ServeFault>, Failure> {
    let component = Component {
        endpoint: "opc.tcp://127.0.0.1:0".to_owned(),
        security: vec![ComponentSecurity::None],
        ..with_drivers(component, &mut Asking::new(), &mut Topics::default())
    };
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .map_err(|error| Failure::new(FailureKind::Io, format!("cannot start: {error}")))?;
    runtime.block_on(async {
        let settings = ServeSettings::default();
        let built = ComponentServer::build(&component, &settings, |_, _| Vec::new());
        Ok(match built {
            Ok(server) => {
                server.stop().await;
                Ok(())
            }
            Err(fault) => Err(fault),
        })
    })
}

/// Returns the skills whose drivers or time limits differ between two versions, and take effect at
/// the next run.
fn replaced_drivers(before: &Version, after: &Version) -> Vec<String> {
    let changes = Component::changes(&before.text, &after.text);
    let next_run = || {
        changes
            .iter()
            .filter(|change| change.takes == Takes::NextRun)
    };
    let mut names = Vec::new();
    for skill in &after.component.skills {
        let is_changed = next_run().any(|change| {
            let parts = change.path.strip_prefix("skills.");
            let name = parts.and_then(|parts| parts.split('.').next());
            name == Some(skill.name.as_str())
        });
        // Composites look up objects in the world.
        let is_composite = matches!(skill.driver, DriverSetup::PickAndPlace(_));
        if is_changed || (is_composite && next_run().any(|change| change.path == "world")) {
            names.push(skill.name.clone());
        }
    }
    names
}

/// Returns the file with the version that drivers are made of at the start.
fn versions(file: Arc<ComponentFile>) -> (Arc<ComponentFile>, Arc<Version>) {
    let started = Arc::clone(file.started());
    (file, started)
}

/// A task that ends when this value is dropped.
struct AbortOnDrop(AbortHandle);

impl Drop for AbortOnDrop {
    fn drop(&mut self) {
        self.0.abort();
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Returns the number of the first run of a component that starts now. It is larger than all
/// previous numbers if there were fewer than 62 runs a second. It wraps around after two years.
#[expect(
    clippy::disallowed_methods,
    reason = "what a host remembers over a restart without a file is its clock"
)]
pub(crate) fn run_number_of_now() -> u32 {
    let since = SystemTime::now().duration_since(UNIX_EPOCH);
    let number = since.unwrap_or_default().as_millis() / 16;
    u32::try_from(number % (1 << 32)).unwrap_or_default()
}

fn failure(fault: ServeFault, options: &ComponentOptions) -> Failure {
    match fault {
        ServeFault::Findings(findings) => {
            let (text, file) = options.source.clone().unwrap_or_default();
            let count = findings.len();
            print(&findings.render(&file, &text));
            Failure::new(
                FailureKind::Configuration,
                format!("{file}: {count} errors"),
            )
        }
        ServeFault::Server(error) => {
            let kind = match error {
                plant_opcua::server::ServerError::Bind(_) => FailureKind::Unavailable,
                plant_opcua::server::ServerError::Pki(_)
                | plant_opcua::server::ServerError::Io(_) => FailureKind::Io,
                plant_opcua::server::ServerError::NodeSet(_)
                | plant_opcua::server::ServerError::NoPki
                | plant_opcua::server::ServerError::NoSecurity
                | plant_opcua::server::ServerError::Configuration(_) => FailureKind::Configuration,
            };
            Failure::new(kind, error.to_string())
        }
        ServeFault::Space(_) => Failure::new(FailureKind::Configuration, fault.to_string()),
    }
}

/// Prints findings to stderr, like the findings of mappings.
pub fn print(text: &str) {
    use std::io::Write as _;
    // An error is ignored, because stderr may be closed.
    let _printed = std::io::stderr().lock().write_all(text.as_bytes());
}

/// Returns the description of the component for discovery.
fn told_of(
    component: &Component,
    url: &str,
    options: &ComponentOptions,
) -> discovery::ServerDescription {
    discovery::ServerDescription {
        application_uri: component.application_uri.clone(),
        product_uri: "urn:ua-bridge:plant".to_owned(),
        name: component.name.clone(),
        url: url.to_owned(),
        capabilities: options.capabilities.clone(),
        number: NonZeroU16::new(component.namespace),
    }
}

/// Returns the announcements of the values.
fn announced_values(server: &ComponentServer, place: &ComponentPlace) -> Vec<PortEvent> {
    let values = (1..).zip(server.values());
    let announced = values.flat_map(|(number, value)| place.announce_value(number, value.facts()));
    announced.collect()
}

/// Publishes the values in the space. Returns the values with sources outside of the component.
fn show_values(
    component: &Component,
    server: &ComponentServer,
    (place, outbox): (&ComponentPlace, &ComponentOutbox),
    tasks: &mut JoinSet<()>,
) -> Vec<LiveValue> {
    for (number, value) in (1..).zip(server.values()) {
        if let Some(topic) = place.value(number) {
            tasks.spawn(outbox.clone().publish(topic, value.clone()));
        }
    }
    let measured = component.values.iter().zip(server.values());
    let measured = measured.filter(|(setup, _)| !matches!(setup.source, ValueSource::Computed(..)));
    measured.map(|(_, value)| value.clone()).collect()
}

/// Ends the program after a delay.
fn power_off() -> PowerOff {
    PowerOff(Arc::new(|delay| {
        drop(tokio::spawn(async move {
            // The response to the request is sent before the program ends.
            tokio::time::sleep(delay.max(SHORTEST_DELAY)).await;
            bridge_node::stop();
        }));
    }))
}

/// Logs where a component is served, and whether it has too many skills for the space.
fn log_served(component: &Component, server: &ComponentServer) {
    if server.skills().len() > MOST_IN_SPACE {
        warn!(
            "more than {MOST_IN_SPACE} skills: the others are only available over OPC UA, not in the space"
        );
    }
    info!(
        skills = server.skills().len(),
        values = server.values().len(),
        namespace = component.namespace,
        "{} is served at {}",
        component.name,
        server.url()
    );
}

/// Renews the certificate of the component at the Global Discovery Server.
fn enrol(
    tasks: &mut JoinSet<()>,
    (component, announced): (&Component, &discovery::ServerDescription),
    options: &ComponentOptions,
    server: &ComponentServer,
) {
    let (Some(root), Some(gds)) = (&options.pki, &options.gds) else {
        return;
    };
    let endpoint = component.endpoint.parse::<EndpointUrl>().ok();
    let port = announced.url.parse::<EndpointUrl>().map(|url| url.port());
    let urls = endpoint.zip(port.ok()).map(|(url, port)| url.urls(port));
    let applicant = announced.applicant(urls.unwrap_or_default());
    let enrolment = Enrolment::new(root, applicant, gds.clone());
    let usage = Usage::of(server, options.file.clone());
    tasks.spawn(async move {
        enrolment
            .keep(|| {
                let why = "with its new certificate".to_owned();
                drop(tokio::spawn(restart_when_idle(usage.clone(), why)));
            })
            .await;
    });
}

/// Returns the description of the component for the group.
fn application(
    server: &discovery::ServerDescription,
    security: &[ComponentSecurity],
) -> Application {
    let ways = security.iter().flat_map(|security| match security {
        ComponentSecurity::None => plant_opcua::server::ServerSecurity::None.ways(),
        ComponentSecurity::Basic256Sha256 => {
            plant_opcua::server::ServerSecurity::Basic256Sha256.ways()
        }
    });
    Application {
        uri: server.application_uri.clone(),
        product_uri: server.product_uri.clone(),
        name: server.name.clone(),
        urls: vec![server.url.clone()],
        capabilities: server.capabilities.clone(),
        ..Application::default()
    }
    .talked_to(ways)
}

fn announce(
    server: discovery::ServerDescription,
    component: &Component,
    options: &ComponentOptions,
    supervision: Supervision,
) -> Option<ServerAnnouncement> {
    let lds = component.lds.option(discovery::DEFAULT_LDS);
    if lds.is_none() && options.mdns.is_none() {
        return None;
    }
    let settings = AnnounceSettings {
        mdns: options.mdns.clone(),
        pki: options.pki.clone(),
        supervision,
        ..AnnounceSettings::registering(lds.as_deref())
    };
    match discovery::announce(server, settings) {
        Ok(announced) => Some(announced),
        Err(fault) => {
            warn!("cannot announce this component by mDNS: {fault}");
            None
        }
    }
}

/// Shortest delay before a component switches itself off.
const SHORTEST_DELAY: Duration = Duration::from_millis(50);
/// Within the limit of 2 s for the shutdown of a port.
const SHUTDOWN: Duration = Duration::from_millis(1_900);
/// Largest number of simultaneous calls; more are refused.
const MOST_EXECUTIONS: usize = 64;
