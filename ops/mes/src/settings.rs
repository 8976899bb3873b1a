//! The YAML of the MES.

mod composite;
mod endpoints;
mod files;
mod flow;
mod parameters;
mod servers;

use std::net::SocketAddr;
use std::path::{Path, PathBuf};

use knowledge::is_iri;
use plant_opcua::client::ClientUser;
use skills::yaml::{
    DocumentKind, DocumentNode, Findings, YamlFindingCode, YamlReader, read_document, whole,
};
use skills::{
    ComponentSecurity, DEFAULT_ENDPOINT, Lds, ParameterType, read_endpoint, read_lds, read_name,
    read_positive, read_security, read_user,
};

use crate::process::{By, MOST_STEPS, Need, Process, ProcessStep, SkillRole, StepJob};
use crate::read_process::{USUALLY_WAIT, USUALLY_WITHIN};

pub(crate) use files::{Connect, Manifest, NodeSetOrigin, RecipeSource, RmlSource, Source};
pub(crate) use servers::{NamedServers, ServerEntry};

/// The settings of the MES.
#[derive(Debug, Clone)]
pub(crate) struct Settings {
    /// The name of the component.
    pub(crate) name: String,
    pub(crate) application_uri: String,
    /// The number of the component in the space.
    pub(crate) namespace: u16,
    pub(crate) endpoint: String,
    pub(crate) security: Vec<ComponentSecurity>,
    pub(crate) lds: Lds,
    pub(crate) open: bool,
    /// The user as which the MES uses components; `None` for anonymous.
    pub(crate) user: Option<ClientUser>,
    /// The address of the SPARQL endpoint.
    pub(crate) sparql: SocketAddr,
    /// The address for users of other hosts, by TLS.
    pub(crate) sparql_tls: Option<SocketAddr>,
    /// The folder of the lasting sources.
    pub(crate) store: Option<PathBuf>,
    /// Whether the rules of OWL 2 RL are applied.
    pub(crate) rules: bool,
    /// Turtle files.
    pub(crate) knowledge: Vec<Source>,
    pub(crate) nodesets: Vec<Source>,
    /// The folder or URL of the NodeSets that others require.
    pub(crate) nodeset_folder: Option<NodeSetOrigin>,
    pub(crate) manifests: Vec<Manifest>,
    pub(crate) rml: Vec<RmlSource>,
    /// Running servers whose nodes are in the graph.
    pub(crate) servers: Vec<ServerEntry>,
    /// STEP files.
    pub(crate) products: Vec<Source>,
    /// Recipes of BatchML and BPMN.
    pub(crate) recipes: Vec<RecipeSource>,
    pub(crate) processes: Vec<Process>,
    /// The ApplicationUris of components that are preferred among others, the most preferred first.
    pub(crate) prefer: Vec<String>,
}

impl Settings {
    /// Reads the settings from YAML; paths are relative to `folder`. All errors are reported
    /// together.
    pub(crate) fn from_yaml(text: &str, folder: &Path) -> Result<Self, Findings> {
        read_document(text, |root, reader| {
            Reading { reader, folder }.settings(root)
        })
    }
}

/// Keys of the document.
const KEYS: [&str; 22] = [
    "mes",
    "application_uri",
    "namespace",
    "endpoint",
    "security",
    "lds",
    "open",
    "user",
    "sparql",
    "sparql_tls",
    "store",
    "rules",
    "knowledge",
    "nodesets",
    "nodeset_folder",
    "manifests",
    "rml",
    "servers",
    "products",
    "recipes",
    "processes",
    "prefer",
];

struct Reading<'a, 'f> {
    reader: &'a mut YamlReader<'f>,
    folder: &'a Path,
}

impl Reading<'_, '_> {
    fn settings(&mut self, root: &DocumentNode) -> Option<Settings> {
        let [
            name,
            uri,
            namespace,
            endpoint,
            security,
            lds,
            open,
            user,
            sparql,
            sparql_tls,
            store,
            rules,
            knowledge,
            nodesets,
            nodeset_folder,
            manifests,
            rml,
            servers,
            products,
            recipes,
            processes,
            prefer,
        ] = self.reader.map(root, KEYS)?;
        let identity = self.identity(root, [name, uri, namespace]);
        let usual = || Some(DEFAULT_ENDPOINT.to_owned());
        let endpoint = endpoint.map_or_else(usual, |node| read_endpoint(node, self.reader));
        let usual = || vec![ComponentSecurity::None];
        let security = security.map_or_else(usual, |node| read_security(node, self.reader));
        let lds = lds.map_or(Some(Lds::Local), |node| read_lds(node, self.reader));
        let open = open.map_or(Some(false), |node| self.reader.boolean(node));
        let user = user.map(|node| read_user(node, self.folder, self.reader));
        let sparql = sparql.map_or(Some(DEFAULT_SPARQL), |node| self.address(node, true));
        let sparql_tls = sparql_tls.map(|node| self.address(node, false));
        let store = store.map(|node| self.folder(node));
        let rules = rules.map_or(Some(false), |node| self.reader.boolean(node));
        let knowledge = knowledge.map_or_else(Vec::new, |node| self.files(node));
        let nodesets = nodesets.map_or_else(Vec::new, |node| self.files(node));
        let nodeset_folder = nodeset_folder.map(|node| self.nodeset_origin(node));
        let manifests = manifests.map_or_else(Vec::new, |node| self.each(node, Self::manifest));
        let rml = rml.map_or_else(Vec::new, |node| self.each(node, Self::rml));
        let mut servers = servers.map_or_else(Vec::new, |node| self.each(node, Self::server));
        let products = products.map_or_else(Vec::new, |node| self.files(node));
        let recipes = recipes.map_or_else(Vec::new, |node| self.each(node, Self::recipe));
        let processes = processes.map_or_else(Vec::new, |node| self.each(node, Self::process));
        let prefer = prefer.map_or_else(Vec::new, |node| self.each(node, Self::preferred));
        let names = manifests.iter().map(|manifest| &*manifest.source.name);
        self.once(root, names, "manifest");
        self.files_once(root, &knowledge, &rml);
        self.each_once(root, &products, &processes, &recipes);
        let names = servers.iter().map(|server| server.which.text());
        self.once(root, names, "server");
        let (name, application_uri, namespace) = identity?;
        let user = whole(user)?;
        servers::give_user(&mut servers, user.as_ref());
        Some(Settings {
            name,
            application_uri,
            namespace,
            endpoint: endpoint?,
            security,
            lds: lds?,
            open: open?,
            user,
            sparql: sparql?,
            sparql_tls: whole(sparql_tls)?,
            store: whole(store)?.map(|store| store.path),
            rules: rules?,
            knowledge,
            nodesets,
            nodeset_folder: whole(nodeset_folder)?,
            manifests,
            rml,
            servers,
            products,
            recipes,
            processes,
            prefer,
        })
    }

    /// Reads the name, the ApplicationUri and the number of the component.
    fn identity(
        &mut self,
        root: &DocumentNode,
        [name, uri, namespace]: [Option<&DocumentNode>; 3],
    ) -> Option<(String, String, u16)> {
        let name = self.reader.needed(name, "mes", root.place);
        let name = name.and_then(|node| read_name(node, self.reader));
        let uri = self.reader.needed(uri, "application_uri", root.place);
        let uri = uri.and_then(|node| self.iri(node, YamlFindingCode::Uri));
        let namespace = self
            .reader
            .needed(namespace, "namespace", root.place)
            .and_then(|node| read_positive(node, YamlFindingCode::Namespace, self.reader));
        Some((name?, uri?, namespace?))
    }

    fn each<T>(
        &mut self,
        node: &DocumentNode,
        mut read: impl FnMut(&mut Self, &DocumentNode) -> Option<T>,
    ) -> Vec<T> {
        let nodes = self.reader.list(node);
        nodes.iter().filter_map(|node| read(self, node)).collect()
    }

    /// Reports names of products and IRIs of processes that are given twice.
    fn each_once(
        &mut self,
        root: &DocumentNode,
        products: &[Source],
        processes: &[Process],
        recipes: &[RecipeSource],
    ) {
        let names = products.iter().map(|product| &*product.name);
        self.once(root, names, "product");
        let iris = processes.iter().map(|process| &*process.iri);
        let iris = iris.chain(recipes.iter().map(|recipe| &*recipe.source.name));
        self.once(root, iris, "process");
    }

    fn once<'n>(&mut self, root: &DocumentNode, names: impl Iterator<Item = &'n str>, what: &str) {
        let mut seen: Vec<&str> = Vec::new();
        for name in names {
            if seen.contains(&name) {
                self.reader.findings().error(
                    YamlFindingCode::DuplicateKey,
                    root.place,
                    format!("there are two of the {what} `{name}`"),
                );
            }
            seen.push(name);
        }
    }

    fn preferred(&mut self, node: &DocumentNode) -> Option<String> {
        self.iri(node, YamlFindingCode::Uri)
    }

    fn process(&mut self, node: &DocumentNode) -> Option<Process> {
        let keys = [
            "process",
            "name",
            "pick_and_place",
            "within",
            "wait",
            "steps",
        ];
        let [iri, name, composite, within, wait, steps] = self.reader.map(node, keys)?;
        let iri = self
            .reader
            .needed(iri, "process", node.place)
            .and_then(|node| self.iri(node, YamlFindingCode::Uri));
        let name = match name {
            Some(node) => self.reader.text(node, "a name").map(str::to_owned),
            None => iri.clone(),
        };
        let within = within.map_or(Some(USUALLY_WITHIN), |node| self.reader.duration(node));
        let wait = wait.map_or(Some(USUALLY_WAIT), |node| self.reader.duration(node));
        let nodes = self
            .reader
            .needed(steps, "steps", node.place)
            .map_or(&[][..], |node| self.reader.list(node));
        if steps.is_some() && (nodes.is_empty() || nodes.len() > MOST_STEPS) {
            self.reader.refuse::<()>(
                node,
                YamlFindingCode::WrongValue,
                format!(
                    "a process has from 1 to {MOST_STEPS} steps, and this one {}",
                    nodes.len()
                ),
            );
        }
        let is_composite = composite.is_some();
        let mut steps: Vec<ProcessStep> = Vec::new();
        let count = nodes.len().min(MOST_STEPS);
        for (number, node) in nodes.iter().take(MOST_STEPS).enumerate() {
            let kind = is_composite.then_some(()).ok_or((number, count));
            let step = self.step(node, kind, &steps);
            steps.extend(step);
        }
        let work = match composite {
            Some(composite) => {
                let roles: Vec<SkillRole> = steps
                    .iter()
                    .flat_map(|step| &step.needs)
                    .map(|need| need.role)
                    .collect();
                for role in SkillRole::OF_COMPOSITE
                    .iter()
                    .filter(|role| !roles.contains(role))
                {
                    self.reader.refuse::<()>(
                        composite,
                        YamlFindingCode::MissingKey,
                        format!("no step says who is to be `{}`", role.name()),
                    );
                }
                self.job(composite).map(StepJob::PickAndPlace)
            }
            None => Some(StepJob::Sequence),
        };
        Some(Process {
            iri: iri?,
            name: name?,
            work: work?,
            steps,
            loops: Vec::new(),
            within: within?,
            wait: wait?,
        })
    }

    /// Reads a step of a composite, or the step with a number that a single skill does. The second
    /// number is the number of all steps.
    fn step(
        &mut self,
        node: &DocumentNode,
        kind: Result<(), (usize, usize)>,
        earlier: &[ProcessStep],
    ) -> Option<ProcessStep> {
        let keys = [
            "step",
            "needs",
            "parameters",
            "by",
            "compensation",
            "after",
            "when",
            "within",
        ];
        let [name, needs, parameters, by, compensation, flow @ ..] = self.reader.map(node, keys)?;
        let name = self
            .reader
            .needed(name, "step", node.place)
            .and_then(|node| self.reader.text(node, "a name"));
        let needs = self.reader.needed(needs, "needs", node.place)?;
        let roles: Vec<SkillRole> = match kind {
            Ok(()) => SkillRole::OF_COMPOSITE.to_vec(),
            Err((number, _)) => vec![SkillRole::Alone(number)],
        };
        let read = self.needs(needs, &roles)?;
        let given = match parameters {
            Some(parameters) => {
                self.only_alone(
                    parameters,
                    kind.is_err(),
                    "gives its skills their parameters",
                )?;
                self.parameters(parameters, earlier)?
            }
            None => Vec::new(),
        };
        let by = match by {
            Some(by) => {
                self.only_alone(
                    by,
                    kind.is_err(),
                    "chooses one component for the tool and one for the robot",
                )?;
                self.by(by, earlier)?
            }
            None => By::Any,
        };
        let mut step = ProcessStep {
            name: name?.to_owned(),
            needs: read,
            parameters: given,
            by,
            ..ProcessStep::default()
        };
        for key in flow.into_iter().flatten() {
            self.only_alone(key, kind.is_err(), "does all its steps in one order")?;
        }
        self.flow(&mut step, flow, earlier)?;
        if let Some(node) = compensation {
            self.only_alone(node, kind.is_err(), "retreats by itself")?;
            if let Err((number, count)) = kind {
                let mut known = earlier.to_vec();
                known.push(step.clone());
                let read = self.compensation(node, number, count, &known)?;
                step.compensation = Some(Box::new(read));
            }
        }
        Some(step)
    }

    /// Reads the compensation of the last of these steps.
    fn compensation(
        &mut self,
        node: &DocumentNode,
        number: usize,
        count: usize,
        known: &[ProcessStep],
    ) -> Option<ProcessStep> {
        let keys = ["step", "needs", "parameters", "by"];
        let [name, needs, parameters, by] = self.reader.map(node, keys)?;
        let of = known.last().map_or("", |step| step.name.as_str());
        let name = match name {
            Some(name) => self.reader.text(name, "a name")?.to_owned(),
            None => format!("compensation of {of}"),
        };
        let needs = self.reader.needed(needs, "needs", node.place)?;
        let role = SkillRole::Alone(count.saturating_add(number));
        let needs = self.needs(needs, &[role])?;
        let parameters = match parameters {
            Some(parameters) => self.parameters(parameters, known)?,
            None => Vec::new(),
        };
        let by = match by {
            Some(by) => match self.by(by, known)? {
                By::AttachedTool => {
                    let why = "a compensation is done by the component of a step, as {component_of: STEP}";
                    return self
                        .reader
                        .refuse(by, YamlFindingCode::WrongValue, why.to_owned());
                }
                by @ (By::Any | By::SameAs(_)) => by,
            },
            None => By::SameAs(number),
        };
        Some(ProcessStep {
            name,
            needs,
            parameters,
            by,
            ..ProcessStep::default()
        })
    }

    /// Refuses a key of a step that only steps of a sequence have.
    fn only_alone(&mut self, node: &DocumentNode, is_alone: bool, why: &str) -> Option<()> {
        match is_alone {
            true => Some(()),
            false => self.reader.refuse(
                node,
                YamlFindingCode::UnknownKey,
                format!("`pick_and_place` {why}"),
            ),
        }
    }

    fn needs(&mut self, needs: &DocumentNode, roles: &[SkillRole]) -> Option<Vec<Need>> {
        let DocumentKind::Map(pairs) = &needs.kind else {
            self.reader.wrong(needs, "a map from what a skill is for to the capability it needs, as `grasp: urn:example:capability:grasp`");
            return None;
        };
        let mut read = Vec::new();
        for (key, need) in pairs {
            let Some(text) = self.reader.text(key, "what a skill is for") else {
                continue;
            };
            let Some(role) = roles.iter().find(|role| role.name() == text) else {
                let known: Vec<_> = roles.iter().map(|role| role.name()).collect();
                self.reader.refuse::<()>(
                    key,
                    YamlFindingCode::UnknownKey,
                    format!("`{text}` is not known here; known are {}", known.join(", ")),
                );
                continue;
            };
            read.extend(self.need(need, *role));
        }
        if read.is_empty() {
            self.reader.refuse::<()>(
                needs,
                YamlFindingCode::MissingKey,
                "a step needs a skill".to_owned(),
            );
        }
        Some(read)
    }

    /// Reads the name of an earlier step. Returns its number.
    fn earlier(&mut self, node: &DocumentNode, earlier: &[ProcessStep]) -> Option<usize> {
        let name = self.reader.text(node, "the name of a step")?;
        let number = earlier.iter().position(|step| step.name == name);
        number.or_else(|| {
            let known: Vec<_> = earlier.iter().map(|step| step.name.as_str()).collect();
            let why = format!(
                "no earlier step is called `{}`; there are {}",
                shortened(name),
                known.join(", ")
            );
            self.reader.refuse(node, YamlFindingCode::WrongValue, why)
        })
    }

    /// Reads the component that has to do a step.
    fn by(&mut self, node: &DocumentNode, earlier: &[ProcessStep]) -> Option<By> {
        if matches!(&node.kind, DocumentKind::Scalar(text) if text == "attached-tool") {
            return Some(By::AttachedTool);
        }
        let expected = "expected `attached-tool`, or the component of an earlier step, as {component_of: STEP}";
        if !matches!(node.kind, DocumentKind::Map(_)) {
            return self
                .reader
                .refuse(node, YamlFindingCode::WrongValue, expected.to_owned());
        }
        let [of] = self.reader.map(node, ["component_of"])?;
        let of = self.reader.needed(of, "component_of", node.place)?;
        self.earlier(of, earlier).map(By::SameAs)
    }

    fn need(&mut self, node: &DocumentNode, role: SkillRole) -> Option<Need> {
        if matches!(node.kind, DocumentKind::Scalar(_)) {
            return Some(Need {
                role,
                capability: Some(self.iri(node, YamlFindingCode::Capability)?),
                skill_type: role.skill_type(),
            });
        }
        let [capability, of] = self.reader.map(node, ["capability", "type"])?;
        let capability = match capability {
            Some(node) => Some(self.iri(node, YamlFindingCode::Capability)?),
            None => None,
        };
        let skill_type = match of {
            Some(node) => {
                let text = self.reader.text(node, "a skill type")?;
                match text.parse::<ParameterType>() {
                    Ok(name) => Some(name),
                    Err(error) => {
                        return self.reader.refuse(
                            node,
                            YamlFindingCode::SkillType,
                            error.to_string(),
                        );
                    }
                }
            }
            None => role.skill_type(),
        };
        if capability.is_none() && skill_type.is_none() {
            return self.reader.refuse(
                node,
                YamlFindingCode::MissingKey,
                "say a `capability`, a `type` or both".to_owned(),
            );
        }
        Some(Need {
            role,
            capability,
            skill_type,
        })
    }

    fn iri(&mut self, node: &DocumentNode, code: YamlFindingCode) -> Option<String> {
        let text = self.reader.text(node, "an IRI")?;
        if is_iri(text) && text.len() <= 256 {
            Some(text.to_owned())
        } else {
            self.reader.refuse(
                node,
                code,
                format!(
                    "`{}` is no IRI, as urn:example:capability:grasp is one",
                    shortened(text)
                ),
            )
        }
    }
}

/// Converts a value to JSON: a number or Boolean if the text is a valid number or Boolean.
fn json(node: &DocumentNode) -> serde_json::Value {
    match &node.kind {
        DocumentKind::Scalar(text) => plain(text),
        DocumentKind::List(nodes) => nodes.iter().map(json).collect(),
        DocumentKind::Map(_) | DocumentKind::Null => serde_json::Value::Null,
    }
}

fn plain(text: &str) -> serde_json::Value {
    let read: Option<serde_json::Value> = serde_json::from_str(text).ok();
    read.filter(|value| value.is_number() || value.is_boolean())
        .unwrap_or_else(|| text.into())
}

fn shortened(text: &str) -> String {
    text.chars().take(60).collect()
}

const DEFAULT_SPARQL: SocketAddr =
    SocketAddr::new(std::net::IpAddr::V4(std::net::Ipv4Addr::LOCALHOST), 8087);

#[cfg(test)]
mod tests;
