//! The program `ua-component`: a component of the cell that its YAML file defines.

use std::ffi::OsString;
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::{Arc, OnceLock};

use bridge_node::{
    Arguments, ConfigurationFile, Context, Failure, FailureKind, KeyService, Made, Owned, Program,
    WithoutMapping,
};
use mappings::{Mapping, SpaceId};
use plant_opcua::enrolment::GdsArguments;
use skills::yaml::{Findings, YamlFindingCode};
use skills::{Component, ComponentSecurity, Lds};

use crate::reload::{ComponentFile, Overrides, ReadComponent, Version};
use crate::{ComponentOptions, ComponentPort, made, modules, simulate};

/// A component of the cell: an OPC UA server with skills, which are values and calls of the space too.
#[derive(Debug, clap::Parser)]
#[command(
    name = "ua-component",
    version = plant_opcua::patches::version(),
    after_help = "`ua-component simulate --help`: devices behind their protocols, to try drivers with\n\
                  `ua-component modules --help`: a component for each manifest (MTP) in a folder"
)]
struct UaComponent {
    /// The YAML of the component
    #[arg(
        value_name = "COMPONENT",
        env = "UA_COMPONENT",
        required_unless_present_any = ["nodeset", "schema", "explain"]
    )]
    component: Option<PathBuf>,
    /// Print the NodeSet with the skill types, and exit
    #[arg(long)]
    nodeset: bool,
    /// Print a JSON schema, and exit: of the YAML, or of the lines of `exec` programs
    #[arg(
        long,
        value_name = "OF",
        value_enum,
        num_args = 0..=1,
        default_missing_value = "component"
    )]
    schema: Option<Schema>,
    /// Print the meaning of a finding's code, or of all codes, and exit
    #[arg(long, value_name = "CODE", num_args = 0..=1, default_missing_value = "all")]
    explain: Option<String>,
    /// Check the YAML and the types it names, print every finding, and exit
    #[arg(long)]
    check: bool,
    /// The endpoint for clients, as opc.tcp://127.0.0.1:0, in place of the endpoint of the YAML
    #[arg(long, value_name = "URL", env = "UA_ENDPOINT")]
    endpoint: Option<String>,
    /// The discovery server for the registration, in place of the server of the YAML: its URL; an
    /// announced server on --interface, as `any` (the only server there), uri=<ApplicationUri> or
    /// name=<mDNS name> (both may end with *); `embed` for the server of this host at port 4840, or
    /// `embed=URL`, which the component serves itself while there is none; or `none`
    #[arg(long, value_name = "URL|CHOICE|embed", env = "UA_LDS")]
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
    read: OnceLock<Arc<ComponentFile>>,
}

/// The schemas that the program prints.
#[derive(Debug, Clone, Copy, clap::ValueEnum)]
enum Schema {
    Component,
    Exec,
}

/// Runs `ua-component` with devices of a program: `read` returns the component of the YAML file
/// with the device or the drivers of the program. Everything else is as in [`run`]. A second call
/// in a process keeps the function of the first one.
#[must_use]
pub fn run_with(arguments: Vec<OsString>, read: ReadComponent) -> ExitCode {
    READER.get_or_init(|| read);
    run(arguments)
}

/// Reads a component with the devices of this project.
///
/// # Errors
/// The findings in the text.
pub fn read_component(text: &str, folder: &Path) -> Result<Component, Findings> {
    Component::from_yaml_with(text, folder, &devices::Kinds)
}

/// The function that reads a component, if a program has an own one.
static READER: OnceLock<ReadComponent> = OnceLock::new();

/// Runs `ua-component` from its command line to its end. `arguments` begin with the name of the
/// program.
#[must_use]
pub fn run(arguments: Vec<OsString>) -> ExitCode {
    match arguments.get(1) {
        Some(first) if first == simulate::VERB => simulate::run(arguments.into_iter().skip(1)),
        Some(first) if first == modules::VERB => modules::run(arguments.into_iter().skip(1)),
        _ => bridge_node::run::<UaComponent>(arguments),
    }
}

impl UaComponent {
    /// Returns the path of the YAML file, which is empty if the command line need not name it.
    fn file(&self) -> &Path {
        self.component.as_deref().unwrap_or_else(|| Path::new(""))
    }

    fn read(&self) -> Result<&Arc<ComponentFile>, Failure> {
        if let Some(read) = self.read.get() {
            return Ok(read);
        }
        let file = self.file().display().to_string();
        let text = bridge_node::read_text_file(self.file()).map_err(|error| {
            Failure::new(FailureKind::Io, format!("cannot read {file}: {error}"))
        })?;
        let overrides = Overrides {
            endpoint: self.endpoint.clone(),
            lds: self.lds.as_deref().map(Lds::written),
        };
        let reader = READER.get().copied().unwrap_or(read_component);
        let read = ComponentFile::new(self.file().to_owned(), text, reader, overrides);
        let read = read.map_err(|(text, findings)| {
            let count = findings.len();
            crate::print(&findings.render(&file, &text));
            Failure::new(
                FailureKind::Configuration,
                format!("{file}: {count} errors"),
            )
        })?;
        Ok(self.read.get_or_init(|| Arc::new(read)))
    }

    fn component(&self) -> Result<&Component, Failure> {
        Ok(&self.read()?.started().component)
    }

    /// Returns the path of the certificate store.
    fn pki_root(&self, component: &Component) -> PathBuf {
        let root = || plant_opcua::pki::default_root(|name| std::env::var(name).ok());
        let usual = || root().join(&component.name);
        self.pki.clone().unwrap_or_else(usual)
    }

    fn options(&self, file: &Arc<ComponentFile>) -> ComponentOptions {
        let Version { component, text } = &**file.started();
        let is_secured = self.gds.gds.is_some()
            || component
                .security
                .contains(&ComponentSecurity::Basic256Sha256);
        let usual = || self.pki_root(component);
        let pki = self.pki.clone().or_else(|| is_secured.then(usual));
        let interface = self.arguments.0.flags.interface.as_deref();
        ComponentOptions {
            pki,
            trust_any_client: self.trust_any_client_certificate,
            mdns: Some(self.networks.interface(interface)),
            capabilities: vec!["DA".to_owned()],
            gds: None,
            configuration: Some(self.pki_root(component).join("configuration.json")),
            source: Some((text.clone(), self.file().display().to_string())),
            file: Some(Arc::clone(file)),
            extensions: Vec::new(),
        }
    }
}

/// Returns the meaning of a code, or of all codes.
fn explained(wanted: &str) -> Result<String, Failure> {
    let all = wanted == "all";
    let codes = YamlFindingCode::ALL.iter();
    let told: String = codes
        .filter(|code| all || code.as_str().eq_ignore_ascii_case(wanted))
        .map(|code| format!("{code}: {}\n", code.explanation()))
        .collect();
    match told.is_empty() {
        true => Err(Failure::new(
            FailureKind::Usage,
            format!("unknown code `{wanted}`; `--explain` alone prints all codes"),
        )),
        false => Ok(told),
    }
}

impl Program for UaComponent {
    type Port = ComponentPort;

    const NAME: &'static str = "ua-component";
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
        let text = match (self.nodeset, self.schema, &self.explain) {
            (true, ..) => Some(skills::model::nodeset()),
            (_, Some(Schema::Component), _) => Some(Component::SCHEMA.to_owned()),
            (_, Some(Schema::Exec), _) => Some(crate::exec::SCHEMA.to_owned()),
            (_, _, Some(code)) => Some(explained(code)?),
            (false, None, None) => None,
        };
        if let Some(text) = text {
            let printed = std::io::stdout().lock().write_all(text.as_bytes());
            printed.map_err(|error| Failure::new(FailureKind::Io, error.to_string()))?;
            return Ok(Some(Made::Checked));
        }
        let read = self.read()?;
        if self.check {
            crate::check(&read.started().component, &self.options(read))?;
            let file = self.component.as_deref().unwrap_or_else(|| Path::new("-"));
            tracing::info!("{} can run", file.display());
            return Ok(Some(Made::Checked));
        }
        Ok(Some(Made::Run(made(&read.started().component))))
    }

    fn configuration(&self) -> Option<Arc<dyn ConfigurationFile>> {
        let file = Arc::clone(self.read().ok()?);
        Some(file)
    }

    /// The key service uses the identity of the server and its clients, from the same certificate
    /// store.
    fn key_service(&self, _mapping: &Mapping) -> Option<Arc<dyn KeyService>> {
        let component = self.component().ok()?;
        Some(Arc::new(plant_keys::KeyFetcher::new(
            plant_keys::KeyClientIdentity {
                application_uri: component.application_uri.clone(),
                application_name: component.name.clone(),
                pki: self.pki_root(component),
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
        let read = self.read()?;
        let gds = self.gds.invitation();
        let gds = gds.map_err(|fault| Failure::new(FailureKind::Usage, fault.to_string()))?;
        let options = ComponentOptions {
            gds,
            ..self.options(read)
        };
        ComponentPort::start(&read.started().component, &options)
    }
}
