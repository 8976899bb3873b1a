//! The OPC UA server of a component: its skills as instances of their types, with methods, events
//! and parameters.
//!
//! Reading order:
//!
//! - this module
//! - `place`: the location of the component in the plant
//! - `power`: the end of the program before its device loses its supply
//! - `types`: the description of a skill from the instance of its type
//! - `show`: values and events for clients
//! - `methods`: methods and writes of clients
//! - `lock`: the lease as a lock of OPC 10000-100
//! - `configuration`: the configuration of the component
//! - `grip`: the grip point of a grasp skill
//! - `robot`: the robot for clients of OPC 40010-1
//! - `tool`: the state of a tool changer
//! - `uses`: the skills that composites use
//! - `values`: the values of the component

mod configuration;
mod grip;
mod lock;
mod methods;
mod place;
mod power;
mod robot;
mod show;
mod tool;
mod types;
mod uses;
mod values;

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use plant_opcua::server::{
    EndpointUrl, IdRange, Instance, InstanceError, InstanceSpec, OpcUaServer, ServerBuilder,
    ServerConfig, ServerError, ServerSecurity as Policy,
};
use plant_opcua::supervision::Supervision;
use plant_opcua::types::{NodeId, ObjectId, ObjectTypeId, QualifiedName};
use plant_opcua::users::{AnonymousRights, PermissionRules, Roles, UserAccess};
use tokio::sync::{mpsc, watch};
use tokio::task::JoinSet;
use tokio::time::{Instant, MissedTickBehavior};

pub(crate) use self::configuration::{CONFIGURED, OBJECT as CONFIGURATION, SET_FIELDS};
use self::grip::Stated;
use self::lock::Lock;
use self::methods::status;
pub use self::power::PowerOff;
use self::show::{Shower, SkillNodes};
use self::values::Tallies;
pub use self::values::status as value_status;
use crate::authority::{Authority, SkillOwner};
use crate::client::PeerAccess;
use crate::component::{Component, ComponentSecurity, DriverFault, Drivers, SkillSetup};
use crate::configuration::ComponentConfiguration;
use crate::description::SkillDescription;
use crate::driver::Driver;
use crate::model::{self, NAMESPACE};
use crate::parameters::{ParameterType, SkillParameter};
use crate::shown::SkillObserver;
use crate::skill::Skill;
use crate::values::LiveValue;
use crate::workspace::RobotWorkspace;
use crate::yaml::{Findings, YamlFinding, YamlFindingCode};

/// Settings of the server of a component, beside the component.
#[derive(Debug, Clone, Default)]
pub struct ServeSettings {
    /// Reaches the components with the skills that the component uses.
    pub peers: PeerAccess,
    /// The directory of certificates, required for Basic256Sha256.
    pub pki: Option<PathBuf>,
    /// Trusts the certificates of all clients. For tests and demonstrations only.
    pub trust_any_client: bool,
    /// The number of each skill's first run, above the numbers used before a restart; 0 counts as
    /// 1.
    pub first_run: u32,
    /// The supervisor at which the component is registered.
    pub supervision: Supervision,
    /// Ends the program for `PowerOffDevice`; `None` for a component without this method.
    pub power_off: Option<PowerOff>,
    /// The file with the configuration of the component; `None` for a configuration that is lost
    /// at the end of the program.
    pub configuration: Option<PathBuf>,
    /// Additional objects of the component.
    pub extensions: Vec<Arc<dyn Extension>>,
}

/// Adds objects to the object of a component.
pub trait Extension: std::fmt::Debug + Send + Sync {
    /// Adds NodeSets and type loaders to the server.
    fn prepare(&self, builder: ServerBuilder) -> ServerBuilder {
        builder
    }

    /// Creates the objects below the object of the component. The users are those of the server.
    ///
    /// # Errors
    /// A node cannot be created.
    fn serve(
        &self,
        server: (&OpcUaServer, &UserAccess),
        component: &NodeId,
        ids: &mut IdRange,
    ) -> Result<(), InstanceError>;
}

/// The reason why a component cannot be served.
#[derive(Debug, thiserror::Error)]
pub enum ServeFault {
    /// Errors in the description of the skills.
    #[error("the component's skills cannot be made")]
    Findings(Findings),
    /// A NodeSet cannot be used, or the server cannot be created.
    #[error(transparent)]
    Server(#[from] ServerError),
    /// The address space cannot be created.
    #[error("the address space cannot be made: {0}")]
    Space(String),
}

impl From<InstanceError> for ServeFault {
    fn from(error: InstanceError) -> Self {
        Self::Space(error.to_string())
    }
}

/// A served component, until [`stop`](Self::stop).
pub struct ComponentServer {
    server: OpcUaServer,
    authority: Authority,
    skills: Vec<Skill>,
    values: Vec<LiveValue>,
    drivers: Drivers,
    configuration: ComponentConfiguration,
    tasks: JoinSet<()>,
}

impl ComponentServer {
    /// Creates the address space and binds the port; clients are served after
    /// [`start`](Self::start). Each skill is Halted. `observers` provides the observers of each
    /// skill, by its number from 1 and its description. Needs a tokio runtime.
    ///
    /// # Errors
    /// - Missing types, and drivers that do not match their types; all of them are reported
    ///   together
    /// - NodeSets, certificates or an address that cannot be used
    pub fn build(
        component: &Component,
        settings: &ServeSettings,
        mut observers: impl FnMut(u16, &SkillDescription) -> Vec<Box<dyn SkillObserver>>,
    ) -> Result<Self, ServeFault> {
        let users = users_of(component, settings)?;
        let server = server_of(component, settings, &users)?;
        let mut ids = IdRange::new(OWN, FIRST_FREE_ID);
        let root = root(&server, component, &mut ids)?;
        let by = (settings.supervision.clone(), Arc::clone(&users));
        place::configurable(&server, &root.node_id, &mut ids, by.clone())?;
        let folder = root
            .node("Skills")
            .cloned()
            .ok_or_else(|| ServeFault::Space("it has no folder Skills".to_owned()))?;
        let mut drivers = Drivers::new(component, settings.peers.clone());
        let (made, mut findings) = make_all(&server, component, &folder, &mut drivers, &mut ids);
        let tallies = Tallies::of(component);
        let values = values::made(component, &tallies);
        findings.extend(values.as_ref().err().cloned());
        let (Ok(values), true) = (values, findings.is_empty()) else {
            return Err(ServeFault::Findings(findings));
        };
        let store = settings.configuration.as_deref();
        let configuration = ComponentConfiguration::new(component.configurable.clone(), store);
        let shown = configuration::serve(&server, &root.node_id, &mut ids, (&configuration, by))?;
        let authority = Authority::new();
        let mut served = Vec::new();
        let mut used = Vec::new();
        for (number, made) in (1..).zip(made) {
            let (facts, driver, nodes) = (made.facts, made.driver, made.nodes);
            let mut all: Vec<Box<dyn SkillObserver>> =
                vec![Box::new(Shower::new(server.clone(), Arc::clone(&nodes)))];
            all.extend(tallies.observers(number, &facts.name));
            all.extend(observers(number, &facts));
            let uses = driver.uses();
            nodes.show_at_first(&server, &facts, &uses);
            used.push((nodes.skill().clone(), uses));
            let driver = configuration.applied(&facts.name, driver);
            let first = settings.first_run;
            let skill = Skill::counting_from(first, facts, driver, authority.clone(), all);
            methods::serve(&server, &nodes, &skill);
            served.push((skill, nodes));
        }
        let skills: Vec<Skill> = served.iter().map(|(skill, _)| skill.clone()).collect();
        if let Some(power_off) = settings.power_off.clone() {
            let by = (power_off, Arc::clone(&users));
            power::serve(&server, &root.node_id, &mut ids, &skills, by)?;
        }
        let mut tasks = JoinSet::new();
        if let Some(device) = component.device.clone() {
            let nodes = served.iter().map(|(_, nodes)| Arc::clone(nodes)).collect();
            tend(&mut tasks, &server, nodes, (device, settings.peers.clone()));
        }
        let leases = Leases {
            server: server.clone(),
            served,
            authority: authority.clone(),
        };
        tasks.spawn(leases.free(component.lease));
        uses::show(&server, &root.node_id, &used, &mut ids)?;
        tasks.spawn(Lock::serve(&server, &authority, &root.node_id, &mut ids)?);
        if let Some(robot) = &component.robot {
            let of = (skills.as_slice(), values.live.as_slice());
            let named = (component.name.as_str(), robot);
            tasks.spawn(robot::serve(&server, named, of, &mut ids)?);
        }
        tasks.spawn(shown);
        let values = (values, &configuration);
        let values = values::serve(&server, &root.node_id, &mut ids, values, &mut tasks)?;
        for extension in &settings.extensions {
            extension.serve((&server, &users), &root.node_id, &mut ids)?;
        }
        if let Some(node) = root.node("LeaseHolder").cloned() {
            tasks.spawn(show_holder(server.clone(), node, authority.holder()));
        }
        Ok(Self {
            server,
            authority,
            skills,
            values,
            drivers,
            configuration,
            tasks,
        })
    }

    /// Replaces the drivers and time limits of the named skills by those of `component`, and the
    /// objects of the cell, from the next run of each skill on. Runs in progress keep theirs. Names
    /// of skills that are not served with the same type are ignored.
    ///
    /// # Errors
    /// A driver cannot do the work of its skill; nothing is replaced.
    pub fn replace_drivers(
        &mut self,
        component: &Component,
        names: &[String],
    ) -> Result<(), DriverFault> {
        self.drivers.set_world(Arc::clone(&component.world));
        let mut made = Vec::new();
        for setup in &component.skills {
            let served = self.skills.iter().find(|skill| {
                let facts = skill.facts();
                facts.name == setup.name && facts.types.first() == Some(&setup.skill_type)
            });
            let Some(skill) = served.filter(|_| names.contains(&setup.name)) else {
                continue;
            };
            let driver = self.drivers.make(&setup.driver, &skill.facts().types)?;
            let driver = self.configuration.applied(&setup.name, driver);
            made.push((skill, driver, setup.timeout));
        }
        for (skill, driver, timeout) in made {
            skill.replace(driver, timeout);
        }
        Ok(())
    }

    /// Starts serving clients.
    pub fn start(&self) {
        self.server.start();
    }

    /// Halts running skills, closes all connections and stops listening. Takes at most 4 s, or 8 s
    /// while work that is done elsewhere is being cancelled.
    pub async fn stop(mut self) {
        self.tasks.abort_all();
        let closing = self.skills.iter().map(Skill::close);
        futures_util::future::join_all(closing).await;
        self.server.stop().await;
    }

    /// Returns the URL of the endpoint, with the bound port.
    #[must_use]
    pub fn url(&self) -> &str {
        self.server.url()
    }

    /// Returns the skills, by their numbers from 1.
    #[must_use]
    pub fn skills(&self) -> &[Skill] {
        &self.skills
    }

    /// Returns the values, by their numbers from 1.
    #[must_use]
    pub fn values(&self) -> &[LiveValue] {
        &self.values
    }

    /// Returns the authority, which controls the lease.
    #[must_use]
    pub fn authority(&self) -> &Authority {
        &self.authority
    }
}

/// Returns the users of the certificate store.
fn users_of(
    component: &Component,
    settings: &ServeSettings,
) -> Result<Arc<UserAccess>, ServeFault> {
    let anonymous = component.anonymous.unwrap_or(Roles::NONE);
    let users = UserAccess::of_store(settings.pki.as_deref(), anonymous);
    let users = users.map_err(|error| ServerError::Configuration(error.to_string()))?;
    if component.anonymous.is_none() {
        users.set_rules(PermissionRules {
            anonymous: AnonymousRights::Refused,
            ..PermissionRules::default()
        });
    }
    Ok(Arc::new(users))
}

fn server_of(
    component: &Component,
    settings: &ServeSettings,
    users: &Arc<UserAccess>,
) -> Result<OpcUaServer, ServeFault> {
    let endpoint: EndpointUrl = component
        .endpoint
        .parse()
        .map_err(|error| ServeFault::Space(format!("{}: {error}", component.endpoint)))?;
    let policies = component.security.iter().map(|security| match security {
        ComponentSecurity::None => Policy::None,
        ComponentSecurity::Basic256Sha256 => Policy::Basic256Sha256,
    });
    let config = ServerConfig {
        security: policies.collect(),
        pki: settings.pki.clone(),
        trust_unknown_clients: settings.trust_any_client,
        clients: component.limits,
        ..ServerConfig::new(&component.application_uri, &component.name, endpoint)
    };
    let mut builder = ServerBuilder::new(config)
        .users(Arc::clone(users))
        .nodeset_str(NAMESPACE, &model::nodeset());
    if !component.nodesets.iter().any(|file| lock::has_di(file)) {
        builder = builder.nodeset_str(lock::NAMESPACE, lock::NODESET);
    }
    for file in &component.nodesets {
        builder = builder.nodeset_file(file);
    }
    for (namespace, text) in component.device.iter().flat_map(|device| device.nodesets()) {
        builder = builder.nodeset_str(&namespace, &text);
    }
    for extension in &settings.extensions {
        builder = extension.prepare(builder);
    }
    Ok(builder.build()?)
}

/// Creates the object of the component, below Objects.
fn root(
    server: &OpcUaServer,
    component: &Component,
    ids: &mut IdRange,
) -> Result<Instance, ServeFault> {
    let space = |why: &dyn std::fmt::Display| ServeFault::Space(why.to_string());
    let controller = server
        .find_type(NAMESPACE, model::CONTROLLER_TYPE)
        .ok_or_else(|| space(&"there is no ISkillControllerType"))?;
    let spec = InstanceSpec {
        reference: plant_opcua::types::ReferenceTypeId::Organizes.into(),
        interfaces: vec![controller],
        ..InstanceSpec::new(
            ObjectTypeId::BaseObjectType.into(),
            NodeId::new(OWN, COMPONENT_ID),
            QualifiedName::new(OWN, component.name.as_str()),
            ObjectId::ObjectsFolder.into(),
        )
    };
    let made = server
        .instantiate(&spec, &mut |_| ids.next())
        .map_err(|error| space(&error))?;
    if let Some(node) = made.node("NamespaceNumber") {
        server
            .show(node, component.namespace)
            .map_err(|status| space(&status))?;
    }
    Ok(made)
}

struct Made {
    facts: SkillDescription,
    driver: Arc<dyn Driver>,
    nodes: Arc<SkillNodes>,
}

/// Creates the skills of a component. Returns them with the findings.
fn make_all(
    server: &OpcUaServer,
    component: &Component,
    folder: &NodeId,
    drivers: &mut Drivers,
    ids: &mut IdRange,
) -> (Vec<Made>, Findings) {
    let mut findings = Findings::default();
    let mut made = Vec::new();
    for (number, setup) in (1..).zip(&component.skills) {
        let workspace = component.workspace.as_deref();
        match make(server, (number, setup, workspace), folder, drivers, ids) {
            Ok(skill) => made.push(skill),
            Err(finding) => findings.push(finding),
        }
    }
    let parameters: Vec<(&str, &[SkillParameter])> = made
        .iter()
        .map(|made| (made.facts.name.as_str(), made.facts.parameters.as_slice()))
        .collect();
    // Parameters of skills with findings are unknown.
    if findings.is_empty() {
        let unknown = component.configurable.iter();
        findings.extend(unknown.filter_map(|field| field.lacks_parameter(&parameters)));
    }
    findings.extend(robot::lacks_types(server, component.robot.as_ref()));
    (made, findings)
}

/// Returns the remedy for a skill type that no NodeSet defines.
fn help_for_type(skill_type: &ParameterType) -> String {
    let own = skill_type.namespace == NAMESPACE;
    let names: Vec<&str> = model::TYPES.iter().map(|of| of.name).collect();
    let near = crate::yaml::nearest(&skill_type.name, names.iter().copied()).filter(|_| own);
    match near {
        Some(near) => format!("did you mean `{near}`?"),
        None if own => "types of others are named as nsu=<namespace uri>;<BrowseName>".to_owned(),
        None => "the NodeSet with the type stands under `nodesets`".to_owned(),
    }
}

/// Creates the instance of a skill's type, and its description.
fn make(
    server: &OpcUaServer,
    (number, setup, workspace): (u32, &SkillSetup, Option<&RobotWorkspace>),
    folder: &NodeId,
    drivers: &mut Drivers,
    free: &mut IdRange,
) -> Result<Made, YamlFinding> {
    let SkillSetup {
        name,
        skill_type,
        place,
        ..
    } = setup;
    let wrong = |code, message: String| YamlFinding::error(code, *place, message);
    let Some(type_id) = server.find_type(&skill_type.namespace, &skill_type.name) else {
        let message = format!("there is no type {skill_type}");
        return Err(wrong(YamlFindingCode::SkillType, message).with_help(help_for_type(skill_type)));
    };
    let types = types::chain(server, &type_id);
    let root = ParameterType::own(model::SKILL_TYPE);
    let Some(last) = types.iter().position(|of| *of == root) else {
        let message = format!("{skill_type} is no subtype of SkillType");
        return Err(wrong(YamlFindingCode::SkillType, message));
    };
    let types: Vec<ParameterType> = types.into_iter().take(last + 1).collect();
    let driver = drivers
        .make(&setup.driver, &types)
        .map_err(|fault| wrong(YamlFindingCode::Driver, fault.to_string()))?;
    let changes_tools =
        drivers.has_tool_changer() && types.contains(&ParameterType::own("ToolSkillType"));
    let stated = Stated {
        grip: setup.grip_point.as_ref(),
        workspace: workspace.filter(|_| types.contains(&ParameterType::own("MotionSkillType"))),
    };
    let first = number * IDS_PER_SKILL;
    let of_tools = changes_tools.then_some(tool::PROPERTIES).into_iter();
    let of_tools = of_tools.flatten().chain(["ProgramDiagnostic"]);
    let spec = InstanceSpec {
        event_notifier: true,
        optional: stated
            .properties()
            .chain(of_tools.map(str::to_owned))
            .collect(),
        ..InstanceSpec::new(
            type_id,
            NodeId::new(OWN, first),
            QualifiedName::new(OWN, name.as_str()),
            folder.clone(),
        )
    };
    let made = server.instantiate(&spec, &mut |path| match kept(path) {
        Some(offset) => NodeId::new(OWN, first + offset),
        None => free.next(),
    });
    let instance = made.map_err(|error| {
        let code = if matches!(error, InstanceError::Abstract(_)) {
            YamlFindingCode::AbstractType
        } else {
            YamlFindingCode::SkillType
        };
        let finding = wrong(code, format!("{skill_type} has no instances: {error}"));
        finding.with_help("a subtype that is not abstract has skills")
    })?;
    if !stated.show(server, &instance) {
        let message =
            format!("`grip_point` is for skills of GraspSkillType, and this is {skill_type}");
        return Err(wrong(YamlFindingCode::SkillType, message));
    }
    let facts = SkillDescription {
        name: name.clone(),
        parameters: types::parameters(server, &instance, "ParameterSet", &types, |of| {
            of.parameters()
        }),
        results: types::parameters(server, &instance, "FinalResultData", &types, |of| {
            of.results()
        }),
        types,
        capabilities: setup.capabilities.clone(),
        timeout: setup.timeout,
        rests_in: types::rests_in(server, &instance),
    };
    let nodes = SkillNodes::new(server, instance, &facts);
    Ok(Made {
        facts,
        driver,
        nodes: Arc::new(nodes),
    })
}

/// Returns the offset of a node with a fixed identifier within the skill's hundred.
fn kept(path: &str) -> Option<u32> {
    Some(match path {
        "CurrentState" => 1,
        "ParameterSet" => 3,
        "FinalResultData" => 4,
        "Start" => 5,
        "Halt" => 6,
        "Suspend" => 7,
        "Resume" => 8,
        "Reset" => 9,
        "Execute" => 20,
        "ReadOutcome" => 21,
        _ => return None,
    })
}

/// Releases the leases of sessions.
struct Leases {
    server: OpcUaServer,
    served: Vec<(Skill, Arc<SkillNodes>)>,
    authority: Authority,
}

impl Leases {
    /// Releases the lease of a session that closes or is idle for `idle`. Parameters that the
    /// session wrote are discarded.
    async fn free(self, idle: Duration) {
        let (closed, mut told) = mpsc::channel(MOST_CLOSED);
        let authority = self.authority.clone();
        self.server.on_session_closed(move |session| {
            authority.release(&SkillOwner::Session(session));
            // The queue is longer than the maximum number of sessions of the server.
            if let Err(error) = closed.try_send(session) {
                tracing::warn!(session, "cannot process the end of a session: {error}");
            }
        });
        let mut look = tokio::time::interval((idle / LOOKS).max(SHORTEST_LOOK));
        look.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            tokio::select! {
                session = told.recv() => match session {
                    Some(session) => self.forget(&SkillOwner::Session(session)),
                    None => return,
                },
                _ = look.tick() => if let Some(owner) = self.authority.release_idle(idle, Instant::now()) {
                    tracing::info!("released the lease of {owner}: it was idle for {idle:?}");
                    self.forget(&owner);
                },
            }
        }
    }

    fn forget(&self, owner: &SkillOwner) {
        for (skill, nodes) in &self.served {
            if skill.forget(owner) {
                nodes.show_defaults(&self.server, skill.facts());
            }
        }
    }
}

/// Keeps the state of the device up to date, and shows the state of a tool changer.
fn tend(
    tasks: &mut JoinSet<()>,
    server: &OpcUaServer,
    nodes: Vec<Arc<SkillNodes>>,
    (device, peers): (Arc<dyn crate::component::Device>, PeerAccess),
) {
    if let Some(state) = device.tool_changer() {
        tasks.spawn(tool::show(server.clone(), nodes, state));
    }
    tasks.spawn(async move { device.tend(&peers).await });
}

async fn show_holder(
    server: OpcUaServer,
    node: NodeId,
    mut holder: watch::Receiver<Option<SkillOwner>>,
) {
    loop {
        let text = holder
            .borrow_and_update()
            .as_ref()
            .map(ToString::to_string)
            .unwrap_or_default();
        // The node exists as long as the server.
        let _shown = server.show(&node, text);
        if holder.changed().await.is_err() {
            return;
        }
    }
}

/// The namespace of the instances: the namespace of the ApplicationUri.
const OWN: u16 = 1;
const COMPONENT_ID: u32 = 1;
const IDS_PER_SKILL: u32 = 100;
const FIRST_FREE_ID: u32 = 1_000_000;
/// Number of checks for an idle lease within the idle time.
const LOOKS: u32 = 10;
const SHORTEST_LOOK: Duration = Duration::from_millis(10);
/// Maximum number of closed sessions that wait to be processed.
const MOST_CLOSED: usize = 1_024;

#[cfg(test)]
mod tests;
