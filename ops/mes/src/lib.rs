//! The semantic MES: it stores knowledge about the plant, answers queries about it, and runs
//! processes with the available components.
//!
//! Reading order:
//!
//! - `settings`: the YAML
//! - `process`, `read_process`: processes and their steps, and how the graph has them
//! - `recipe`: processes of BatchML and BPMN
//! - `plan`: the assignment of skills to steps, with reasons
//! - `execute`: the execution of a plan, and planning again after a loss
//! - `record`: the record of runs
//! - `cell`, `clock`: the current state of the plant, and the time
//! - `follow`: from discovery to the graph
//! - `servers`, `search_limits`: from the address spaces of running servers to the graph
//! - `sources`, `nodeset_folder`, `nodeset_url`: from files to the graph, while the program runs
//! - `remote_questions`: questions of users of other hosts
//! - `goal`: the search for a sequence that reaches a goal
//! - `jobs`: processes that clients start, several at a time
//! - `job_orders`, `order_file`, `job_control`: jobs for clients of OPC 10031-4
//! - `knowledge_methods`: queries and changes for clients of OPC UA
//! - `execution_skill` and `locate_skill`: the skills of the MES

mod cell;
mod clock;
mod compaction;
mod execute;
mod execution_skill;
mod follow;
mod goal;
mod job_control;
mod job_order;
mod job_orders;
mod jobs;
mod knowledge_methods;
mod live;
mod locate_skill;
mod nodeset_folder;
mod nodeset_url;
mod order_file;
mod parameter_fault;
mod plan;
mod process;
mod product_configuration;
mod read_process;
mod recipe;
mod record;
mod remote_questions;
mod search_limits;
mod servers;
mod settings;
mod sources;

use std::ffi::OsString;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::{Arc, OnceLock};
use std::time::Duration;

use bridge_node::{
    Arguments, Context, Failure, FailureKind, KeyService, Made, Owned, Program, WithoutMapping,
};
use knowledge::{
    HttpEndpoint, Knowledge, KnowledgeRequests, May, Queries, QueryLimits, SourceFiles, Writes,
};
use mappings::{Mapping, SpaceId};
use plant_opcua::enrolment::GdsArguments;
use plant_opcua::users::{self, UserAccess, UserRole};
use skills::yaml::Place;
use skills::{
    ClientOptions, Component, ComponentSecurity, Driver, DriverSetup, Lds, LocalRun, ParameterType,
    RunnableSkill as _, Skill, SkillOwner, SkillSetup, SkillValue,
};
use tokio::runtime::Handle;
use tokio::signal::unix::{SignalKind, signal};
use tracing::{error, info, warn};
use ua_component::{ComponentOptions, ComponentPort, made};

use crate::cell::PlantState;
use crate::execution_skill::ExecuteProcess;
use crate::job_control::JobControl;
use crate::job_orders::Orders;
use crate::jobs::ProcessJobs;
use crate::knowledge_methods::KnowledgeMethods;
use crate::locate_skill::LocateObject;
use crate::order_file::OrderFile;
use crate::remote_questions::RefusedPasswords;
use crate::servers::LiveServers;
use crate::settings::{Connect, Settings};
use crate::sources::MesSources;

/// The semantic MES: knows the components of the plant, answers questions about them, and runs processes with them.
#[derive(Debug, clap::Parser)]
#[command(name = "ua-mes", version = plant_opcua::patches::version())]
struct UaMes {
    /// The YAML of the MES
    #[arg(value_name = "MES", env = "UA_MES")]
    mes: PathBuf,
    /// Check the YAML and the files it names, print every finding, and exit
    #[arg(long)]
    check: bool,
    /// Run this process as soon as its components are available, and go on serving
    #[arg(long, value_name = "IRI")]
    run: Option<String>,
    /// The address at which questions are answered, in place of the address of the YAML; loopback
    /// only
    #[arg(long, value_name = "ADDRESS:PORT", env = "UA_SPARQL")]
    sparql: Option<SocketAddr>,
    /// A further address at which questions of users of other hosts are answered by TLS, with the
    /// certificate of the MES, in place of the address of the YAML
    #[arg(long, value_name = "ADDRESS:PORT", env = "UA_SPARQL_TLS")]
    sparql_tls: Option<SocketAddr>,
    /// The folder for added sources, fetched NodeSets and records of runs, in place of the folder
    /// of the YAML
    #[arg(long, value_name = "DIR", env = "UA_STORE")]
    store: Option<PathBuf>,
    /// The endpoint for clients, as opc.tcp://127.0.0.1:0, in place of the endpoint of the YAML
    #[arg(long, value_name = "URL", env = "UA_ENDPOINT")]
    endpoint: Option<String>,
    /// The local discovery server for the registration, or `none`, in place of the server of the
    /// YAML; `embed` for the server of this host at port 4840, or `embed=URL`, which the program
    /// serves itself while there is none
    #[arg(long, value_name = "URL|embed", env = "UA_LDS")]
    lds: Option<String>,
    /// The certificate store: own, private, trusted and rejected under one directory
    #[arg(long, value_name = "DIR", env = "UA_PKI")]
    pki: Option<PathBuf>,
    #[command(flatten)]
    gds: GdsArguments,
    /// Trust every client certificate, and keep it as trusted. For tests and demonstrations only
    #[arg(long)]
    trust_any_client_certificate: bool,
    #[command(flatten)]
    networks: discovery::NetworkArguments,
    #[command(flatten)]
    arguments: WithoutMapping,
    #[arg(skip)]
    ready: OnceLock<Ready>,
    #[arg(skip)]
    serving: OnceLock<HttpEndpoint>,
    #[arg(skip)]
    serving_tls: OnceLock<HttpEndpoint>,
}

/// The objects created from the YAML.
struct Ready {
    settings: Settings,
    component: Component,
    cell: Arc<PlantState>,
    knowledge: Arc<Knowledge>,
    servers: Arc<LiveServers>,
    options: ComponentOptions,
    refused: Arc<RefusedPasswords>,
}

impl Ready {
    fn page(&self) -> knowledge::ExtraPages {
        let has_remote = self.settings.sparql_tls.is_some();
        let refused = has_remote.then(|| Arc::clone(&self.refused));
        page(&self.cell, &self.servers, refused)
    }
}

impl std::fmt::Debug for Ready {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Ready")
            .field("settings", &self.settings)
            .finish_non_exhaustive()
    }
}

/// Runs `ua-mes` with the command line `arguments`, which start with the name of the program, until
/// it ends.
#[must_use]
pub fn run(arguments: Vec<OsString>) -> ExitCode {
    bridge_node::run::<UaMes>(arguments)
}

/// Reads a recipe of BatchML or BPMN, as `ua-space process import` sends it. Returns the number of
/// its processes; `None` if the contents are no recipe. For tests with changed files.
///
/// # Errors
/// The lines of the elements that no process can have, from 1; no line if the contents cannot be
/// decoded.
#[doc(hidden)]
pub fn read_recipe(contents: &[u8]) -> Result<Option<usize>, Vec<usize>> {
    let found = recipe::in_source(contents).map_err(|_| Vec::new())?;
    let Some((text, names)) = found else {
        return Ok(None);
    };
    match recipe::read(&text, &names) {
        Ok(recipe) => Ok(Some(recipe.processes.len())),
        Err(findings) => Err(findings.iter().map(|finding| finding.line).collect()),
    }
}

impl UaMes {
    fn ready(&self) -> Result<&Ready, Failure> {
        if let Some(ready) = self.ready.get() {
            return Ok(ready);
        }
        let settings = self.settings()?;
        let knowledge = Arc::new(self.knowledge(&settings)?);
        let folder = self.store.as_ref().or(settings.store.as_ref());
        let folder = folder.filter(|_| !self.check).cloned();
        let sources = MesSources::new(Arc::clone(&knowledge)).cached_in(folder);
        let sources = Arc::new(sources);
        sources.read(&settings);
        let options = self.options(&settings);
        let client = ClientOptions {
            // The ApplicationUri of the certificate: servers refuse a session with another one.
            application_uri: settings.application_uri.clone(),
            application_name: format!("{} client", settings.name),
            pki: options.pki.clone(),
            user: settings.user.clone(),
            within: WITHIN,
            ..ClientOptions::default()
        };
        let prefer = settings.prefer.clone();
        let servers = Arc::new(LiveServers::new(
            Arc::clone(&knowledge),
            Arc::clone(&sources),
            client.clone(),
            &settings.application_uri,
        ));
        servers.configure(settings.servers.clone());
        let cell = Arc::new(PlantState::new(
            Arc::clone(&knowledge),
            sources,
            client,
            prefer,
        ));
        if let Some(iri) = self.run.as_deref().filter(|iri| cell.process(iri).is_err()) {
            return Err(Failure::new(
                FailureKind::Usage,
                format!("--run {iri}: {} has no such process", self.mes.display()),
            ));
        }
        let driver = ExecuteProcess::new(Arc::clone(&cell));
        let locator = LocateObject {
            knowledge: Arc::clone(&knowledge),
        };
        let component = component(&settings, driver, locator);
        Ok(self.ready.get_or_init(|| Ready {
            settings,
            component,
            cell,
            knowledge,
            servers,
            options,
            refused: Arc::default(),
        }))
    }

    /// Opens the knowledge, with its lasting sources if it has a folder.
    fn knowledge(&self, settings: &Settings) -> Result<Knowledge, Failure> {
        let folder = self.store.as_ref().or(settings.store.as_ref());
        let Some(folder) = folder.filter(|_| !self.check) else {
            let made = Knowledge::new();
            return made.map_err(|fault| Failure::new(FailureKind::Io, fault.to_string()));
        };
        let shown = folder.display();
        let (knowledge, damaged) = Knowledge::open(folder).map_err(|fault| {
            Failure::new(
                FailureKind::Io,
                format!("cannot open the store {shown}: {fault}"),
            )
        })?;
        if damaged > 0 {
            warn!(
                "{damaged} bytes at the end of the journal in {shown} are incomplete; they are in knowledge.journal.damaged"
            );
        }
        let sources = knowledge.sources().len();
        info!(sources, "the store {shown} is read");
        Ok(knowledge)
    }

    /// Reads the users that may change the knowledge and start jobs.
    fn access(&self, ready: &Ready) -> Result<Arc<UserAccess>, Failure> {
        let settings = &ready.settings;
        let folder = self.pki_root(settings).join(users::FOLDER);
        let access = UserAccess::new(Some(folder), settings.sparql.ip().is_loopback());
        access.map(Arc::new).map_err(|fault| {
            Failure::new(
                FailureKind::Configuration,
                format!("cannot read the users: {fault}"),
            )
        })
    }

    /// Reads the YAML and its files again at each SIGHUP.
    fn reload(&self, ready: &Ready) -> Result<impl Future<Output = ()> + use<>, Failure> {
        let mut hangups = signal(SignalKind::hangup()).map_err(|error| {
            Failure::new(
                FailureKind::Io,
                format!("cannot listen for SIGHUP: {error}"),
            )
        })?;
        let sources = Arc::clone(ready.cell.sources());
        let servers = Arc::clone(&ready.servers);
        let (file, name) = (self.mes.clone(), self.mes.display().to_string());
        Ok(async move {
            while hangups.recv().await.is_some() {
                let (file, name) = (file.clone(), name.clone());
                let sources = Arc::clone(&sources);
                let servers = Arc::clone(&servers);
                let read = tokio::task::spawn_blocking(move || match read_settings(&file) {
                    Ok(settings) => {
                        sources.read(&settings);
                        sources.yaml(&name, None);
                        servers.configure(settings.servers);
                        let findings = sources.findings().len();
                        info!(findings, "SIGHUP: the sources of {name} were read again");
                    }
                    Err(why) => {
                        warn!(
                            "SIGHUP: cannot read the sources, and the previous sources stay in use: {why}"
                        );
                        sources.yaml(&name, Some(why));
                    }
                });
                if let Err(error) = read.await {
                    error!("SIGHUP: cannot read the sources: {error}");
                }
            }
        })
    }

    fn settings(&self) -> Result<Settings, Failure> {
        let file = self.mes.display().to_string();
        let text = bridge_node::read_text_file(&self.mes).map_err(|error| {
            Failure::new(FailureKind::Io, format!("cannot read {file}: {error}"))
        })?;
        let folder = self.mes.parent().unwrap_or_else(|| Path::new(""));
        let mut settings = Settings::from_yaml(&text, folder).map_err(|findings| {
            let count = findings.len();
            ua_component::print(&findings.render(&file, &text));
            Failure::new(
                FailureKind::Configuration,
                format!("{file}: {count} errors"),
            )
        })?;
        if let Some(endpoint) = &self.endpoint {
            settings.endpoint.clone_from(endpoint);
        }
        if let Some(sparql) = self.sparql {
            settings.sparql = sparql;
        }
        settings.sparql_tls = self.sparql_tls.or(settings.sparql_tls);
        if let Some(lds) = &self.lds {
            settings.lds = Lds::written(lds);
        }
        Ok(settings)
    }

    /// Returns the directory of the certificate store, used if a connection is secured.
    fn pki_root(&self, settings: &Settings) -> PathBuf {
        let root = || plant_opcua::pki::default_root(|name| std::env::var(name).ok());
        let usual = || root().join(&settings.name);
        self.pki.clone().unwrap_or_else(usual)
    }

    fn options(&self, settings: &Settings) -> ComponentOptions {
        let is_secured = self.gds.gds.is_some()
            || settings.sparql_tls.is_some()
            || settings
                .security
                .contains(&ComponentSecurity::Basic256Sha256);
        let usual = || self.pki_root(settings);
        ComponentOptions {
            pki: self.pki.clone().or_else(|| is_secured.then(usual)),
            trust_any_client: self.trust_any_client_certificate,
            mdns: Some(self.interface()),
            capabilities: vec!["DA".to_owned()],
            gds: None,
            configuration: None,
            source: None,
            file: None,
            extensions: Vec::new(),
        }
    }

    fn interface(&self) -> discovery::MdnsInterface {
        let interface = self.arguments.0.flags.interface.as_deref();
        self.networks.interface(interface)
    }

    /// Serves queries, and follows the components of the plant.
    async fn serve(&self, ready: &Ready, queries: Queries, writes: Writes) -> Result<(), Failure> {
        let page = ready.page();
        let address = ready.settings.sparql;
        let endpoint = HttpEndpoint::bind_with(address, queries, page, Some(writes)).await;
        let endpoint = endpoint.map_err(|error| {
            Failure::new(
                FailureKind::Unavailable,
                format!(
                    "cannot answer questions at {address}: {error}; give another --sparql address"
                ),
            )
        })?;
        info!(
            "questions are answered at http://{}/ask and /sparql, status at /status",
            endpoint.address()
        );
        drop(self.serving.set(endpoint));
        drop(tokio::spawn(self.reload(ready)?));
        let sources = Arc::clone(ready.cell.sources());
        drop(tokio::spawn(sources::supply(sources)));
        let knowledge = Arc::clone(&ready.knowledge);
        drop(tokio::spawn(compaction::compact(knowledge)));
        let interface = self.interface();
        let only_loopback = self.arguments.0.flags.interface.is_none()
            || interface == discovery::MdnsInterface::LOOPBACK;
        let watcher = discovery::watch(discovery::WatchSettings {
            mdns: Some(interface),
            ..discovery::WatchSettings::default()
        });
        let watcher =
            watcher.map_err(|fault| Failure::new(FailureKind::Unavailable, fault.to_string()))?;
        for manifest in &ready.settings.manifests {
            let endpoint = match &manifest.connect {
                Connect::No => continue,
                Connect::Yes => None,
                Connect::At(endpoint) => Some(endpoint.clone()),
            };
            let module = live::WatchedModule {
                name: manifest.source.name.clone(),
                iri: manifest.iri.clone(),
                endpoint,
            };
            let options = ready.cell.client().clone();
            drop(tokio::spawn(live::module(
                Arc::clone(&ready.knowledge),
                options,
                module,
            )));
        }
        drop(tokio::spawn(Arc::clone(&ready.servers).run()));
        drop(tokio::spawn(follow::follow(
            (Arc::clone(&ready.cell), Arc::clone(&ready.servers)),
            watcher,
            only_loopback,
        )));
        Ok(())
    }
}

impl Program for UaMes {
    type Port = ComponentPort;

    const NAME: &'static str = "ua-mes";
    const LOCAL: bridge_core::Local = bridge_core::Local::Fields;
    const QUIET: &'static str = plant_opcua::QUIET;
    const CLAIMS: bool = true;

    fn library() -> Option<&'static str> {
        Some(plant_opcua::patches::library())
    }

    fn arguments(&self) -> &Arguments {
        &self.arguments.0
    }

    fn made(&self) -> Result<Option<Made>, Failure> {
        let ready = self.ready()?;
        if self.check {
            ua_component::check(&ready.component, &ready.options)?;
            let mut refused = ready.cell.status_findings();
            refused.retain(|finding| finding.refused);
            if let Some(first) = refused.first() {
                let (count, source, what) = (refused.len(), &first.source, &first.what);
                return Err(Failure::new(
                    FailureKind::Configuration,
                    format!("{count} sources cannot be read; the first: {source}: {what}"),
                ));
            }
            return Ok(Some(Made::Checked));
        }
        Ok(Some(Made::Run(made(&ready.component))))
    }

    /// Returns a key service with the identity and the certificate store of the MES server.
    fn key_service(&self, _mapping: &Mapping) -> Option<Arc<dyn KeyService>> {
        let settings = &self.ready().ok()?.settings;
        Some(Arc::new(plant_keys::KeyFetcher::new(
            plant_keys::KeyClientIdentity {
                application_uri: settings.application_uri.clone(),
                application_name: settings.name.clone(),
                pki: self.pki_root(settings),
            },
        )))
    }

    fn owned(mapping: &Mapping) -> Owned {
        Owned::Only(mapping.namespaces().keys().copied().collect())
    }

    fn spaces(&self, _mapping: &Mapping) -> Result<Vec<SpaceId>, Failure> {
        Ok(vec![SpaceId::UA])
    }

    async fn start(&self, _context: Context) -> Result<ComponentPort, Failure> {
        let ready = self.ready()?;
        let jobs = Arc::new(ProcessJobs::new(Arc::clone(&ready.cell), Handle::current()));
        let access = self.access(ready)?;
        let writes = writes(ready, &access, Arc::clone(&jobs));
        let queries = Queries::new(Arc::clone(&ready.knowledge), QueryLimits::default());
        let requests = KnowledgeRequests::new(queries.clone(), &writes);
        self.serve(ready, queries.clone(), writes.clone()).await?;
        let folder = self.store.as_ref().or(ready.settings.store.as_ref());
        let orders = match folder {
            Some(folder) => Orders::of_file(OrderFile::open(folder).map_err(|error| {
                let shown = folder.display();
                let what = format!("cannot read the job orders in {shown}: {error}");
                Failure::new(FailureKind::Io, what)
            })?),
            None => Orders::default(),
        };
        let control = JobControl::new(jobs, orders, Handle::current());
        let methods = KnowledgeMethods::new(requests, access, &ready.settings.endpoint);
        let gds = self.gds.invitation();
        let gds = gds.map_err(|fault| Failure::new(FailureKind::Usage, fault.to_string()))?;
        let options = ComponentOptions {
            extensions: vec![Arc::new(control), Arc::new(methods)],
            gds,
            ..ready.options.clone()
        };
        let port = ComponentPort::start(&ready.component, &options)?;
        if let Some(address) = ready.settings.sparql_tls {
            // `ComponentPort::start` has created the certificate.
            let root = self.pki_root(&ready.settings);
            let of = (root.as_path(), Arc::clone(&ready.refused));
            let page = ready.page();
            let served = remote_questions::serve(address, of, queries, page, writes).await?;
            drop(self.serving_tls.set(served));
        }
        if let (Some(iri), Some(skill)) = (&self.run, port.skills().first()) {
            drop(tokio::spawn(run_process(skill.clone(), iri.clone())));
        }
        Ok(port)
    }
}

/// Returns the handlers of changes.
fn writes(ready: &Ready, access: &Arc<UserAccess>, jobs: Arc<ProcessJobs>) -> Writes {
    Writes {
        now: clock::now,
        may_read: has(access, UserRole::Observer),
        may: has(access, UserRole::Engineer),
        may_run: has(access, UserRole::Operator),
        files: Arc::clone(ready.cell.sources()) as Arc<dyn SourceFiles>,
        jobs,
    }
}

/// Returns the check that a user has a role. Without any user, programs of this host have it.
fn has(access: &Arc<UserAccess>, role: UserRole) -> May {
    let access = Arc::clone(access);
    Arc::new(move |user| {
        let access = Arc::clone(&access);
        Box::pin(async move {
            access.look();
            match user {
                Some((name, password)) => {
                    let roles = access.roles_by_password(&name, &password, "SPARQL").await;
                    // Each user may read, and engineers do all.
                    let is_enough = |needed| role == UserRole::Observer || role == needed;
                    roles
                        .iter()
                        .any(|has| is_enough(has) || has == UserRole::Engineer)
                }
                None => access.roles_of_anonymous().contains(UserRole::Operator),
            }
        })
    })
}

/// Returns the MES as a component of the plant.
fn component(settings: &Settings, driver: ExecuteProcess, locator: LocateObject) -> Component {
    let skill = |name: &str, driver: Arc<dyn Driver>| SkillSetup {
        name: name.to_owned(),
        skill_type: ParameterType::own(&format!("{name}SkillType")),
        driver: DriverSetup::Given(driver),
        capabilities: Vec::new(),
        timeout: None,
        grip_point: None,
        place: Place::START,
    };
    Component {
        name: settings.name.clone(),
        application_uri: settings.application_uri.clone(),
        namespace: settings.namespace,
        endpoint: settings.endpoint.clone(),
        security: settings.security.clone(),
        nodesets: Vec::new(),
        lds: settings.lds.clone(),
        open: settings.open,
        lease: skills::LEASE,
        user: settings.user.clone(),
        anonymous: Some(skills::anonymous_by_default()),
        limits: plant_opcua::limits::ClientLimits::default(),
        device: None,
        robot: None,
        workspace: None,
        power_off: false,
        world: Arc::default(),
        values: Vec::new(),
        configurable: Vec::new(),
        skills: vec![
            skill("ExecuteProcess", Arc::new(driver)),
            skill("LocateObject", Arc::new(locator)),
        ],
    }
}

/// Reads the YAML again.
///
/// # Errors
/// All findings with their lines.
fn read_settings(file: &Path) -> Result<Settings, String> {
    let name = file.display().to_string();
    let text = bridge_node::read_text_file(file).map_err(|error| error.to_string())?;
    let folder = file.parent().unwrap_or_else(|| Path::new(""));
    Settings::from_yaml(&text, folder).map_err(|findings| findings.render(&name, &text))
}

/// Returns the pages `/status`, `/plan/IRI` and `/goal/IRI`. `/plan/` shows the plan that would be
/// run, with its reasons; `/goal/` the sequence that reaches a goal, with its proof.
fn page(
    cell: &Arc<PlantState>,
    servers: &Arc<LiveServers>,
    refused: Option<Arc<RefusedPasswords>>,
) -> knowledge::ExtraPages {
    let (cell, servers) = (Arc::clone(cell), Arc::clone(servers));
    Arc::new(move |path| {
        if path == "/status" {
            let mut status = cell.status();
            if let Some(status) = status.as_object_mut() {
                status.insert("servers".to_owned(), servers.status());
                if let Some(refused) = &refused {
                    status.insert("refused_passwords".to_owned(), refused.status());
                }
            }
            return Some(status.to_string());
        }
        if let Some(iri) = path.strip_prefix("/goal/") {
            return cell.goal_page(iri).map(|page| page.to_string());
        }
        let iri = path.strip_prefix("/plan/")?;
        let processes = cell.processes();
        let mut known = processes.all.iter();
        let known = known.find(|process| process.iri == iri || mtp::escaped(&process.iri) == iri);
        let process = match known {
            Some(process) => process.clone(),
            None => cell.goal(iri).ok()?.process,
        };
        // Pages are made in a thread that may block.
        let runtime = Handle::try_current().ok()?;
        let plan = runtime.block_on(execute::dry_run(&*cell, &process));
        Some(serde_json::json!({ "process": process.iri, "complete": plan.is_complete(), "missing": plan.missing(), "plan": plan }).to_string())
    })
}

/// Runs a process with the skill, like any other caller.
async fn run_process(skill: Skill, iri: String) {
    let run = LocalRun {
        skill,
        by: SkillOwner::Local("the command line"),
    };
    let parameters = vec![("ProcessIri".to_owned(), SkillValue::String(iri.clone()))];
    // The run itself logs its end.
    if let Err(fault) = run.run(parameters, RUN).await {
        error!(process = iri, "cannot run the process: {fault}");
    }
}

/// Time limit for a response of a component.
const WITHIN: Duration = Duration::from_secs(2);
/// Time limit of a process that is started from the command line.
const RUN: Duration = Duration::from_secs(24 * 3600);
