//! Services of a process module (MTP) as skills: each procedure is a skill whose driver performs
//! the handshake of VDI/VDE/NAMUR 2658-4 with the OPC UA server of the module.
//!
//! Reading order: this module (the device), `handshake` (the waits and writes), `procedure` (a
//! run), `nodes` (the OPC UA client), `types` (the NodeSet with the skill types).

mod error;
mod handshake;
mod nodes;
mod procedure;
mod types;

#[cfg(test)]
mod tests;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use mtp::{Module, MtpService, Procedure, ServiceParameter};
use skills::yaml::{DocumentKind, DocumentNode, Place, YamlFindingCode, YamlReader};
use skills::{
    Authority, Device, Driver, DriverFault, DriverSetup, ParameterType, PeerAccess, Skill,
    SkillDescription, SkillObserver, SkillSetup, SkillValue, ValueShape,
};
use tokio::sync::Mutex;

pub use error::ModuleNodeError;
pub use handshake::{HandshakeTiming, ModuleNodes};
use nodes::UaNodes;
use procedure::ProcedureRun;

use crate::skill_types::other_type;

/// Settings of a module.
#[derive(Debug, Clone)]
pub struct ModuleSettings {
    /// The module of the manifest.
    pub module: Module,
    /// The endpoint of its server, if it differs from the manifest.
    pub endpoint: Option<String>,
    /// Classes of capabilities by the name of a service, or of `service/procedure`.
    pub capabilities: BTreeMap<String, Vec<String>>,
    /// Whether parameters of the configuration are parameters of the skills.
    pub configuration: bool,
    /// The time limits.
    pub timing: HandshakeTiming,
}

/// A process module.
pub struct ProcessModule {
    settings: ModuleSettings,
    skills: Vec<ModuleSkill>,
    nodes: Arc<dyn ModuleNodes>,
}

/// A procedure as a skill.
#[derive(Debug, Clone)]
struct ModuleSkill {
    /// The name of the skill: `Service-Procedure`.
    name: String,
    service: Arc<MtpService>,
    procedure: Arc<Procedure>,
    /// Held during a run, since a service runs one procedure at a time.
    busy: Arc<Mutex<()>>,
}

impl std::fmt::Debug for ProcessModule {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("ProcessModule")
            .field("module", &self.settings.module.name)
            .field("skills", &self.skills.len())
            .finish_non_exhaustive()
    }
}

impl ProcessModule {
    /// Creates the device of a module, reached over OPC UA.
    #[must_use]
    pub fn new(settings: ModuleSettings) -> Self {
        let endpoint = settings.endpoint.clone();
        Self::over(settings, Arc::new(UaNodes::new(endpoint)))
    }

    /// Creates the device of a module with nodes that are reached by `nodes`.
    #[must_use]
    pub fn over(settings: ModuleSettings, nodes: Arc<dyn ModuleNodes>) -> Self {
        let mut skills: Vec<ModuleSkill> = Vec::new();
        for service in &settings.module.services {
            let busy = Arc::new(Mutex::new(()));
            let shared = Arc::new(service.clone());
            for procedure in &service.procedures {
                let plain = plain_name(&format!("{}-{}", service.name, procedure.name));
                let mut name = plain.clone();
                let is_taken = |name: &str| {
                    let mut skills = skills.iter();
                    skills.any(|known| known.name.eq_ignore_ascii_case(name))
                };
                for number in 2.. {
                    if !is_taken(&name) {
                        break;
                    }
                    name = format!("{plain}-{number}");
                }
                skills.push(ModuleSkill {
                    name,
                    service: Arc::clone(&shared),
                    procedure: Arc::new(procedure.clone()),
                    busy: Arc::clone(&busy),
                });
            }
        }
        Self {
            settings,
            skills,
            nodes,
        }
    }

    /// Starts the skill of a procedure in this process, without a server. A service with several
    /// procedures needs the name of one, or has a default. Needs a tokio runtime.
    ///
    /// # Errors
    /// [`DriverFault`] if there is no such service or procedure, or it cannot be commanded.
    pub fn start(
        &self,
        service: &str,
        procedure: Option<&str>,
        observers: Vec<Box<dyn SkillObserver>>,
    ) -> Result<Skill, DriverFault> {
        let names = |all: &mut dyn Iterator<Item = &str>| all.collect::<Vec<_>>().join(", ");
        let of = |skill: &&ModuleSkill| skill.service.name == service;
        let of_service: Vec<&ModuleSkill> = self.skills.iter().filter(of).collect();
        if of_service.is_empty() {
            let services = self.settings.module.services.iter();
            let known = names(&mut services.map(|one| one.name.as_str()));
            return Err(DriverFault(format!(
                "there is no service `{service}` with procedures; the services are {known}"
            )));
        }
        let found = match (procedure, of_service.as_slice()) {
            (Some(name), all) => all.iter().find(|skill| skill.procedure.name == name),
            (None, [only]) => Some(only),
            (None, all) => all.iter().find(|skill| skill.procedure.is_default),
        };
        let Some(found) = found else {
            let known = names(&mut of_service.iter().map(|one| one.procedure.name.as_str()));
            let wanted = procedure.map_or_else(
                || format!("{service} has several procedures and no default"),
                |name| format!("{service} has no procedure `{name}`"),
            );
            return Err(DriverFault(format!("{wanted}; its procedures are {known}")));
        };
        self.spawn(found, observers)
    }

    fn spawn(
        &self,
        skill: &ModuleSkill,
        observers: Vec<Box<dyn SkillObserver>>,
    ) -> Result<Skill, DriverFault> {
        let types = vec![self.type_of(skill), ParameterType::own("SkillType")];
        let driver = self.driver(&types, &PeerAccess::default())?;
        let mut parameters: Vec<_> = self
            .parameters(skill)
            .map(|parameter| skills::SkillParameter {
                unit: types::unit(parameter.unit.as_ref()).map(str::to_owned),
                range: types::range(parameter),
                ..plain(&parameter.name, types::builtin(parameter.kind))
            })
            .collect();
        if procedure::has_run_time(&skill.procedure, self.parameters(skill)) {
            parameters.push(skills::SkillParameter {
                default: Some(SkillValue::Double(0.0)),
                unit: Some("s".to_owned()),
                ..plain(procedure::RUN_TIME, skills::Builtin::Double)
            });
        }
        let outputs = procedure::outputs(&skill.service, &skill.procedure);
        let facts = SkillDescription {
            name: skill.name.clone(),
            types,
            parameters,
            results: outputs
                .map(|output| skills::SkillParameter {
                    unit: types::unit(output.unit.as_ref()).map(str::to_owned),
                    ..plain(&output.name, types::builtin(output.kind))
                })
                .collect(),
            capabilities: Vec::new(),
            timeout: None,
            rests_in: program::Rest::Ready,
        };
        Ok(Skill::spawn(facts, driver, Authority::new(), observers))
    }

    /// Returns the URI of the namespace of its skill types.
    fn namespace(&self) -> String {
        format!(
            "urn:ua-bridge:mtp:{}",
            mtp::escaped(&self.settings.module.name)
        )
    }

    fn type_of(&self, skill: &ModuleSkill) -> ParameterType {
        ParameterType {
            namespace: self.namespace(),
            name: format!("{}SkillType", skill.name),
        }
    }

    /// Returns the parameters that a run of a procedure writes.
    fn parameters<'s>(&self, skill: &'s ModuleSkill) -> impl Iterator<Item = &'s ServiceParameter> {
        let configuration = self.settings.configuration;
        let of_service = skill.service.parameters.iter();
        let of_service = of_service.filter(move |_| configuration);
        skill
            .procedure
            .parameters
            .iter()
            .filter(move |parameter| configuration || !parameter.is_configuration)
            .chain(of_service)
            .filter(|parameter| parameter.write.is_some())
    }
}

impl Device for ProcessModule {
    fn driver(
        &self,
        types: &[ParameterType],
        peers: &PeerAccess,
    ) -> Result<Arc<dyn Driver>, DriverFault> {
        self.nodes.identify(&peers.options);
        let of = |skill: &&ModuleSkill| types.contains(&self.type_of(skill));
        let Some(skill) = self.skills.iter().find(of) else {
            let known: Vec<String> = self
                .skills
                .iter()
                .map(|skill| self.type_of(skill).to_string())
                .collect();
            return Err(other_type("mtp", &known.join(", "), types));
        };
        if skill
            .service
            .control
            .node(mtp::ControlRole::Command)
            .is_none()
            || skill
                .service
                .control
                .node(mtp::ControlRole::State)
                .is_none()
        {
            return Err(DriverFault(format!(
                "the service {} has no node for commands or for its state",
                skill.service.name
            )));
        }
        Ok(Arc::new(ProcedureRun {
            service: Arc::clone(&skill.service),
            procedure: Arc::clone(&skill.procedure),
            parameters: self.parameters(skill).cloned().collect(),
            nodes: Arc::clone(&self.nodes),
            busy: Arc::clone(&skill.busy),
            timing: self.settings.timing,
        }))
    }

    fn nodesets(&self) -> Vec<(String, String)> {
        let skills = self.skills.iter().map(|skill| types::SkillTypeXml {
            name: format!("{}SkillType", skill.name),
            about: format!(
                "{} of the service {}",
                skill.procedure.name, skill.service.name
            ),
            parameters: self.parameters(skill).collect(),
            outputs: procedure::outputs(&skill.service, &skill.procedure).collect(),
            has_run_time: procedure::has_run_time(&skill.procedure, self.parameters(skill)),
        });
        let skills: Vec<_> = skills.collect();
        let namespace = self.namespace();
        let text = types::nodeset(&namespace, &skills);
        vec![(namespace, text)]
    }

    fn skills(&self) -> Vec<SkillSetup> {
        let setup = |skill: &ModuleSkill| {
            let both = format!("{}/{}", skill.service.name, skill.procedure.name);
            let classes = [&skill.service.name, &both];
            let classes = classes
                .into_iter()
                .filter_map(|name| self.settings.capabilities.get(name));
            SkillSetup {
                name: skill.name.clone(),
                skill_type: self.type_of(skill),
                driver: DriverSetup::Device,
                capabilities: classes.flatten().cloned().collect(),
                timeout: None,
                grip_point: None,
                place: Place::START,
            }
        };
        self.skills.iter().map(setup).collect()
    }
}

fn plain(name: &str, builtin: skills::Builtin) -> skills::SkillParameter {
    skills::SkillParameter {
        name: name.to_owned(),
        shape: ValueShape::scalar(builtin),
        length: None,
        default: None,
        unit: None,
        range: None,
        about: String::new(),
    }
}

/// Returns a name of letters, digits, `-` and `_`, as skills have.
fn plain_name(name: &str) -> String {
    let plain = name.chars().take(LONGEST_NAME).map(|c| {
        if c.is_ascii_alphanumeric() || matches!(c, '-' | '_') {
            c
        } else {
            '_'
        }
    });
    plain.collect()
}

/// Reads the value of `mtp`.
pub(crate) fn read(
    node: &DocumentNode,
    folder: &Path,
    reader: &mut YamlReader<'_>,
) -> Option<Arc<dyn Device>> {
    let keys = [
        "manifest",
        "endpoint",
        "capabilities",
        "configuration",
        "within",
        "stop_within",
    ];
    let [
        manifest,
        endpoint,
        capabilities,
        configuration,
        within,
        stop,
    ] = reader.map(node, keys)?;
    let module = reader
        .needed(manifest, "manifest", node.place)
        .and_then(|node| read_manifest(node, folder, reader));
    let endpoint = match endpoint {
        Some(node) => Some(read_endpoint(node, reader)?),
        None => None,
    };
    let capabilities = capabilities.map_or_else(
        || Some(BTreeMap::new()),
        |node| read_capabilities(node, reader),
    );
    let configuration = configuration.map_or(Some(false), |node| reader.boolean(node));
    let usual = HandshakeTiming::default();
    let within = within.map_or(Some(usual.handshake), |node| reader.duration(node));
    let stop = stop.map_or(Some(usual.stop), |node| reader.duration(node));
    Some(Arc::new(ProcessModule::new(ModuleSettings {
        module: module?,
        endpoint,
        capabilities: capabilities?,
        configuration: configuration?,
        timing: HandshakeTiming {
            handshake: within?,
            stop: stop?,
            ..usual
        },
    })))
}

fn read_manifest(
    node: &DocumentNode,
    folder: &Path,
    reader: &mut YamlReader<'_>,
) -> Option<Module> {
    let path: PathBuf = folder.join(reader.text(node, "the path of a manifest")?);
    let bounded = |path: &Path| -> std::io::Result<Vec<u8>> {
        match std::fs::metadata(path)?.len() {
            0..=LARGEST => std::fs::read(path),
            _ => Err(std::io::Error::other(
                "the file is too large for a manifest",
            )),
        }
    };
    let shown = path.display();
    let bytes = match bounded(&path) {
        Ok(bytes) => bytes,
        Err(error) => {
            let message = format!("cannot read {shown}: {error}");
            return reader.refuse(node, YamlFindingCode::WrongValue, message);
        }
    };
    let beside = path.parent().unwrap_or_else(|| Path::new(""));
    match Module::from_files(&bytes, &mut |name| bounded(&beside.join(name)).ok()) {
        Ok(module) if module.services.iter().all(|one| one.procedures.is_empty()) => {
            let message = format!("{shown} has no services with procedures");
            reader.refuse(node, YamlFindingCode::WrongValue, message)
        }
        Ok(module) => Some(module),
        Err(error) => reader.refuse(
            node,
            YamlFindingCode::WrongValue,
            format!("{shown}: {error}"),
        ),
    }
}

fn read_endpoint(node: &DocumentNode, reader: &mut YamlReader<'_>) -> Option<String> {
    let text = reader.text(node, "an endpoint")?;
    if text.starts_with("opc.tcp://") {
        return Some(text.to_owned());
    }
    let message = format!("expected opc.tcp://<host>:<port>, found `{text}`");
    reader.refuse(node, YamlFindingCode::Endpoint, message)
}

fn read_capabilities(
    node: &DocumentNode,
    reader: &mut YamlReader<'_>,
) -> Option<BTreeMap<String, Vec<String>>> {
    let DocumentKind::Map(pairs) = &node.kind else {
        reader.wrong(
            node,
            "a map from the name of a service to IRIs of capabilities",
        );
        return None;
    };
    let mut capabilities = BTreeMap::new();
    for (service, classes) in pairs {
        let name = reader.text(service, "the name of a service")?.to_owned();
        let mut iris = Vec::new();
        for class in reader.list(classes) {
            let text = reader.text(class, "the IRI of a capability")?;
            if !text.contains(':') || text.contains(char::is_whitespace) {
                let message = format!("`{text}` is no IRI");
                return reader.refuse(class, YamlFindingCode::Capability, message);
            }
            iris.push(text.to_owned());
        }
        capabilities.insert(name, iris);
    }
    Some(capabilities)
}

/// Returns whether a value was read as it was written; a Float of a module has fewer digits.
fn is_equal(written: &SkillValue, read: &SkillValue) -> bool {
    match (written.as_f64(), read.as_f64()) {
        (Some(a), Some(b)) => {
            let is_float =
                |value: &SkillValue| matches!(value, SkillValue::Float(_) | SkillValue::Double(_));
            let most = match is_float(written) || is_float(read) {
                true => a.abs().max(b.abs()) * 1e-6,
                false => 0.0,
            };
            (a - b).abs() <= most
        }
        _ => written == read,
    }
}

const LONGEST_NAME: usize = 60;
/// Maximum size of a manifest in bytes.
const LARGEST: u64 = 64 << 20;
