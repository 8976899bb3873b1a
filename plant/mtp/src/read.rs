//! Converts the tree of elements to the model.

use std::borrow::Cow;
use std::collections::HashMap;

use crate::caex::{CaexElement, MAX_FILE, ManifestError};
use crate::container;
use crate::model::{
    Control, ControlRole, Edition, ItemAccess, ManifestServer, Module, MtpFinding, MtpService,
    NodeIdentifier, NodeItem, OpcUaNode, ParameterKind, Procedure, ServiceParameter, ValueBound,
};
use crate::notes::notes;

impl Module {
    /// Reads a manifest as delivered: an `.aml` file in any encoding of [`xml_text`], or a ZIP
    /// container with such a file (`.mtp` or `.amlx`). Other documents of a container that the
    /// manifest refers to are read with it.
    ///
    /// # Errors
    /// [`ManifestError`] if the file is not a manifest.
    pub fn from_bytes(file: &[u8]) -> Result<Self, ManifestError> {
        Self::from_files(file, &mut |_| None)
    }

    /// Reads a manifest with the documents to which it refers by `refURI`. `fetch` returns a
    /// document by its relative path; a container has its own documents.
    ///
    /// # Errors
    /// [`ManifestError`] if the file is not a manifest, or another document is no CAEX file.
    pub fn from_files(
        file: &[u8],
        fetch: &mut dyn FnMut(&str) -> Option<Vec<u8>>,
    ) -> Result<Self, ManifestError> {
        let is_container = container::is_container(file);
        let unpacked = if is_container {
            Cow::Owned(container::document(file)?)
        } else {
            Cow::Borrowed(file)
        };
        let mut root = CaexElement::read(&xml_text::decode(&unpacked)?)?;
        let mut missing = Vec::new();
        let mut total = unpacked.len();
        for (reference, line) in references(&root) {
            let document = if is_container {
                container::named(file, &reference)?
            } else {
                fetch(&reference)
            };
            let Some(document) = document else {
                missing.push((reference, line));
                continue;
            };
            if document.as_slice() == &*unpacked {
                continue;
            }
            total = total.saturating_add(document.len());
            if total > MAX_FILE {
                return Err(ManifestError::TooLarge {
                    length: total,
                    most: MAX_FILE,
                });
            }
            let part = CaexElement::read(&xml_text::decode(&document)?)?;
            root.children.extend(part.children);
        }
        let mut module = Self::of(&root)?;
        module
            .findings
            .extend(missing.into_iter().map(|(reference, line)| MtpFinding {
                about: reference,
                what: "the manifest refers to this document, which is missing".to_owned(),
                line,
                is_note: false,
            }));
        Ok(module)
    }

    /// Reads a manifest, the text of the `.aml` file of an MTP.
    ///
    /// # Errors
    /// [`ManifestError`] if the file is not a manifest. Inconsistencies in a manifest are in
    /// [`findings`](Self::findings).
    pub fn read(manifest: &str) -> Result<Self, ManifestError> {
        Self::of(&CaexElement::read(manifest)?)
    }

    fn of(root: &CaexElement) -> Result<Self, ManifestError> {
        let of_module = |element: &&CaexElement| element.path == "MTPSUCLib/ModuleTypePackage";
        let mut modules = root.all().filter(of_module);
        let module = modules.next().ok_or(ManifestError::NoModule)?;
        let mut reading = ElementIndex::of(root);
        for other in modules {
            let what = "the file describes several modules, and the first is read";
            reading.find(other, &other.name, what);
        }
        let services = root
            .all()
            .filter(|element| element.path == "MTPServiceSUCLib/Service")
            .map(|service| reading.service(service))
            .collect();
        let assemblies = reading.data_assemblies(root);
        let process_values = root
            .all()
            .filter(|element| element.kind() == "ProcessValueSet" || is_process_values(element))
            .flat_map(|set| reading.outputs(&set.name, set))
            .collect();
        let alarms = reading.alarms(root);
        let (pictures, of_pictures) = reading.pictures(root);
        for note in notes(root, of_pictures) {
            reading.add(note);
        }
        let is_second = root.all().any(|element| {
            element.path.starts_with("MTPServerAssemblySUCLib/")
                || element.path.starts_with("MTPDataAssemblySUCLib/")
        });
        Ok(Self {
            name: module.name.clone(),
            version: module.value(&["Version"]).unwrap_or_default().to_owned(),
            edition: if is_second { Edition::V2 } else { Edition::V1 },
            endpoints: reading.endpoints,
            servers: reading.servers,
            items: reading.items,
            assemblies,
            process_values,
            alarms,
            pictures,
            services,
            findings: reading.findings,
        })
    }
}

/// Returns the relative paths of other documents in the attributes `refURI`, with their lines.
fn references(root: &CaexElement) -> Vec<(String, usize)> {
    let mut found: Vec<(String, usize)> = Vec::new();
    for element in root.all() {
        let Some(reference) = element.value(&["refURI"]) else {
            continue;
        };
        let path = reference.split('#').next().unwrap_or_default();
        let path = path.trim_start_matches("./").trim_start_matches('/');
        let is_document = path
            .rsplit_once('.')
            .is_some_and(|(_, end)| end.eq_ignore_ascii_case("aml"));
        let is_local = !path.contains("://") && !path.split('/').any(|part| part == "..");
        let is_new = !found.iter().any(|(known, _)| known == path);
        if is_document && is_local && is_new && found.len() < MAX_DOCUMENTS {
            found.push((path.to_owned(), element.line));
        }
    }
    found
}

/// Returns whether an element without a type is the set of process values, as in early files.
fn is_process_values(element: &CaexElement) -> bool {
    element.path.is_empty()
        && element.children.iter().any(|child| {
            child
                .path
                .starts_with("MTPProcessValueSUCLib/ProcessValue/")
        })
}

/// Index of the elements that are referenced in a file.
pub(crate) struct ElementIndex<'a> {
    /// OPCUAItems by their ID.
    nodes: HashMap<&'a str, OpcUaNode>,
    /// ServiceControls and data assemblies of parameters by their RefID, and by their ID for files
    /// with services that reference the ID.
    assemblies: HashMap<&'a str, &'a CaexElement>,
    /// All other data assemblies in the same way.
    values: HashMap<&'a str, &'a CaexElement>,
    /// All elements by their ID.
    elements: HashMap<&'a str, &'a CaexElement>,
    /// The values of attributes by their ID.
    attributes: HashMap<&'a str, &'a str>,
    endpoints: Vec<String>,
    servers: Vec<ManifestServer>,
    items: Vec<NodeItem>,
    findings: Vec<MtpFinding>,
}

impl<'a> ElementIndex<'a> {
    fn of(root: &'a CaexElement) -> Self {
        let mut reading = Self {
            nodes: HashMap::new(),
            assemblies: HashMap::new(),
            values: HashMap::new(),
            elements: HashMap::new(),
            attributes: HashMap::new(),
            endpoints: Vec::new(),
            servers: Vec::new(),
            items: Vec::new(),
            findings: Vec::new(),
        };
        let mut waiting = vec![(root, None, false)];
        while let Some((element, mut server, is_in_list)) = waiting.pop() {
            if !element.id.is_empty() {
                reading.elements.insert(&element.id, element);
            }
            for attribute in &element.attributes {
                if !attribute.id.is_empty() {
                    reading
                        .attributes
                        .insert(&attribute.id, attribute.value.trim());
                }
            }
            match element.kind() {
                "OPCUAServer" => {
                    reading.server(element);
                    server = Some(element);
                }
                "OPCUAItem" => reading.item(element, server),
                _ => {}
            }
            let is_first = matches!(element.kind(), "ServiceControl") || kind_of(element).is_some();
            if is_first || is_assembly(element, is_in_list) {
                let index = if is_first {
                    &mut reading.assemblies
                } else {
                    &mut reading.values
                };
                index.entry(&element.id).or_insert(element);
                // There may be two: in the files that have two, the last attribute is referenced.
                for attribute in element
                    .attributes
                    .iter()
                    .filter(|attribute| attribute.name == "RefID")
                {
                    index.insert(attribute.value.trim(), element);
                }
            }
            let is_list = is_list(element);
            for child in element.children.iter().rev() {
                waiting.push((child, server, is_list));
            }
        }
        reading
    }

    fn server(&mut self, server: &'a CaexElement) {
        let endpoint = server.value(&["Endpoint"]).unwrap_or_default();
        if endpoint.is_empty() {
            self.find(server, &server.name, "the OPCUAServer has no Endpoint");
        }
        if !self.endpoints.iter().any(|known| known == endpoint) {
            self.endpoints.push(endpoint.to_owned());
        }
        self.servers.push(ManifestServer {
            id: server.id.clone(),
            name: server.name.clone(),
            endpoint: endpoint.to_owned(),
        });
    }

    fn item(&mut self, item: &'a CaexElement, server: Option<&CaexElement>) {
        let Some(server) = server else {
            self.find(
                item,
                &item.name,
                "the OPCUAItem is not below an OPCUAServer",
            );
            return;
        };
        let (Some(identifier), Some(namespace)) =
            (item.value(&["Identifier"]), item.value(&["Namespace"]))
        else {
            let what = "the OPCUAItem has no Identifier or no Namespace";
            self.find(item, &item.name, what);
            return;
        };
        let is_numeric = item
            .attributes
            .iter()
            .any(|attribute| attribute.name == "Identifier" && is_number(&attribute.data_type));
        let node = OpcUaNode {
            item: item.id.clone(),
            endpoint: server.value(&["Endpoint"]).unwrap_or_default().to_owned(),
            namespace: namespace.to_owned(),
            identifier: NodeIdentifier::of(identifier, is_numeric),
            access: ItemAccess::of(item.value(&["Access"])),
        };
        self.items.push(NodeItem {
            name: item.name.clone(),
            node: node.clone(),
        });
        let is_unnamed = item.id.is_empty();
        if is_unnamed {
            let what = "the OPCUAItem has no ID, so nothing refers to it";
            self.find(item, &item.name, what);
        } else if self.nodes.insert(&item.id, node).is_some() {
            self.find(item, &item.name, "another OPCUAItem has the same ID");
        }
    }

    /// Returns the node of an OPCUAItem by its ID.
    pub(crate) fn node_of(&self, id: &str) -> Option<OpcUaNode> {
        self.nodes.get(id).cloned()
    }

    /// Returns the value of an attribute by its ID.
    pub(crate) fn attribute_value(&self, id: &str) -> Option<&'a str> {
        self.attributes.get(id).copied()
    }

    /// Returns the data assembly of any kind that an element references by its RefID.
    pub(crate) fn value_assembly(&self, element: &CaexElement) -> Option<&'a CaexElement> {
        let id = element.value(&["RefID"])?;
        let found = self.values.get(id).or_else(|| self.assemblies.get(id));
        found.copied()
    }

    fn service(&mut self, element: &'a CaexElement) -> MtpService {
        let control = match self.assembly(element) {
            Some(assembly) if assembly.kind() == "ServiceControl" => self.control(assembly),
            _ => {
                self.find(
                    element,
                    &element.name,
                    "no ServiceControl belongs to this service, so it cannot be commanded",
                );
                Control::default()
            }
        };
        let parameters: Vec<_> = element
            .children
            .iter()
            .filter(|child| is_parameter(child))
            .filter_map(|child| Some((child, self.parameter(&element.name, child)?)))
            .collect();
        let procedures: Vec<_> = element
            .children
            .iter()
            .filter(|child| is_procedure(child))
            .filter_map(|child| self.procedure(&element.name, child))
            .collect();
        // Parameters that a strategy references belong to the strategy and not to the service.
        let required: Vec<&str> = element
            .children
            .iter()
            .filter(|child| is_procedure(child))
            .flat_map(required)
            .collect();
        let outputs = self.outputs(&element.name, element);
        let equipment = self.equipment(&element.name, element);
        MtpService {
            outputs,
            equipment,
            id: element.id.clone(),
            name: element.name.clone(),
            control,
            parameters: parameters
                .into_iter()
                .filter(|(child, _)| !required.contains(&&*child.id))
                .map(|(_, parameter)| parameter)
                .collect(),
            procedures,
        }
    }

    fn procedure(&mut self, service: &str, element: &'a CaexElement) -> Option<Procedure> {
        let about = format!("{service}/{}", element.name);
        let number = element.value(&["ProcedureID", "ProcedureId", "StrategyID"]);
        let Some(number) = number.and_then(|number| number.parse().ok()) else {
            self.find(
                element,
                &about,
                "it has no number by which it could be asked for",
            );
            return None;
        };
        let required = required(element).filter_map(|id| self.elements.get(id).copied());
        let parts: Vec<&CaexElement> = element
            .children
            .iter()
            .filter(|child| is_parameter(child))
            .chain(required)
            .collect();
        let outputs = self.outputs(&about, element);
        let equipment = self.equipment(&about, element);
        Some(Procedure {
            outputs,
            equipment,
            id: element.id.clone(),
            name: element.name.clone(),
            number,
            is_default: is_true(element.value(&["IsDefault"])),
            is_self_completing: is_true(element.value(&["IsSelfCompleting"])),
            parameters: parts
                .into_iter()
                .filter_map(|part| self.parameter(&about, part))
                .collect(),
        })
    }

    fn parameter(&mut self, about: &str, element: &'a CaexElement) -> Option<ServiceParameter> {
        let assembly = self.assembly(element);
        let Some((assembly, kind)) = assembly.and_then(|found| Some((found, kind_of(found)?)))
        else {
            let about = format!("{about}/{}", element.name);
            self.find(
                element,
                &about,
                "no data assembly of a kind known here belongs to this parameter",
            );
            return None;
        };
        Some(ServiceParameter {
            id: element.id.clone(),
            name: element.name.clone(),
            is_configuration: element.kind() == "ConfigurationParameter",
            kind,
            min: self.bound(assembly, "VMin"),
            max: self.bound(assembly, "VMax"),
            unit: self.bound(assembly, "VUnit"),
            write: self.node(assembly, &["VExt"]),
            read: self.node(assembly, &["VOut", "VFbk", "VRbk"]),
            handshake: HANDSHAKE
                .iter()
                .filter_map(|name| Some(((*name).to_owned(), self.node(assembly, &[name])?)))
                .collect(),
        })
    }

    fn control(&mut self, assembly: &CaexElement) -> Control {
        let roles = ROLES
            .iter()
            .filter_map(|(role, names)| Some((*role, self.node(assembly, names)?)));
        Control(roles.collect())
    }

    /// Returns the element that a service, procedure or parameter references by its RefID.
    fn assembly(&self, element: &CaexElement) -> Option<&'a CaexElement> {
        self.assemblies.get(element.value(&["RefID"])?).copied()
    }

    fn node(&self, assembly: &CaexElement, names: &[&str]) -> Option<OpcUaNode> {
        self.nodes.get(assembly.value(names)?).cloned()
    }

    fn bound(&self, assembly: &CaexElement, name: &str) -> Option<ValueBound> {
        let value = assembly.value(&[name])?;
        match self.nodes.get(value) {
            Some(node) => Some(ValueBound::Node(node.clone())),
            None => ValueBound::of_text(value),
        }
    }

    /// Adds a finding about an element.
    pub(crate) fn find(&mut self, element: &CaexElement, about: &str, what: &str) {
        self.find_at(element.line, about, what);
    }

    /// Adds a finding about a line.
    pub(crate) fn find_at(&mut self, line: usize, about: &str, what: &str) {
        let finding = MtpFinding {
            about: about.to_owned(),
            what: what.to_owned(),
            line,
            is_note: false,
        };
        if self.findings.len() < MAX_FINDINGS && !self.findings.contains(&finding) {
            self.findings.push(finding);
        }
    }

    /// Adds a finding or a note, as long as there are not too many.
    pub(crate) fn add(&mut self, finding: MtpFinding) {
        if self.findings.len() < MAX_FINDINGS {
            self.findings.push(finding);
        }
    }
}

/// Returns the IDs in RequiredParameters, by which strategies reference the parameters of their
/// service.
fn required(strategy: &CaexElement) -> impl Iterator<Item = &str> {
    let ids = strategy.value(&["RequiredParameters"]).unwrap_or_default();
    ids.split_whitespace()
}

/// Returns whether an element is a data assembly. Drafts have parameters and services of the
/// instance list in the library of services.
pub(crate) fn is_assembly(element: &CaexElement, is_in_list: bool) -> bool {
    let (library, rest) = element.path.split_once('/').unwrap_or_default();
    match library {
        "MTPDataObjectSUCLib" | "MTPDataAssemblySUCLib" => rest.starts_with("DataAssembly/"),
        _ => is_in_list && !element.is_interface && !element.path.is_empty(),
    }
}

/// Returns whether the children of an element are data assemblies.
pub(crate) fn is_list(element: &CaexElement) -> bool {
    element.kind() == "InstanceList"
        || (element.path.is_empty() && element.name == "DataAssemblies")
}

pub(crate) fn is_procedure(element: &CaexElement) -> bool {
    matches!(
        element.kind(),
        "Procedure" | "ServiceProcedure" | "ServiceStrategy"
    )
}

pub(crate) fn is_parameter(element: &CaexElement) -> bool {
    matches!(
        element.kind(),
        "ConfigurationParameter" | "ProcedureParameter" | "StrategyParameter"
    )
}

fn kind_of(assembly: &CaexElement) -> Option<ParameterKind> {
    match assembly.kind() {
        "AnaServParam" => Some(ParameterKind::Analog),
        "DIntServParam" | "DigServParam" => Some(ParameterKind::Integer),
        "BinServParam" => Some(ParameterKind::Binary),
        "StringServParam" => Some(ParameterKind::Text),
        // A draft of 2018.
        "ServAnaParam" | "StrategyAnaParam" => Some(ParameterKind::Analog),
        // Before parameters had kinds of their own, they were operations from outside.
        "ExtAnaOp" | "ExtIntAnaOp" | "AdvAnaOp" => Some(ParameterKind::Analog),
        "ExtDigOp" | "ExtIntDigOp" | "AdvDigOp" => Some(ParameterKind::Integer),
        "ExtBinOp" | "ExtIntBinOp" | "AdvBinOp" => Some(ParameterKind::Binary),
        _ => None,
    }
}

pub(crate) fn is_true(value: Option<&str>) -> bool {
    value.is_some_and(|value| value.eq_ignore_ascii_case("true") || value == "1")
}

fn is_number(data_type: &str) -> bool {
    matches!(
        data_type.trim_start_matches("xs:"),
        "unsignedInt" | "unsignedLong" | "int" | "integer" | "long" | "unsignedShort"
    )
}

impl NodeIdentifier {
    fn of(text: &str, is_numeric: bool) -> Self {
        // Some files have the whole NodeId here.
        let part = text
            .split_once(';')
            .filter(|(namespace, _)| namespace.starts_with("ns="));
        let (text, is_numeric) = match part.map(|(_, identifier)| identifier.split_at_checked(2)) {
            Some(Some(("i=", number))) => (number, true),
            Some(Some(("s=" | "g=" | "b=", rest))) => (rest, false),
            _ => (text, is_numeric),
        };
        match text.parse() {
            Ok(number) if is_numeric => Self::Numeric(number),
            _ => Self::Text(text.to_owned()),
        }
    }
}

impl ItemAccess {
    /// Converts the number in the file. Without a number all access is allowed here; the server
    /// decides.
    fn of(text: Option<&str>) -> Self {
        let bits: u8 = text.and_then(|text| text.parse().ok()).unwrap_or(3);
        Self {
            reads: bits & 1 != 0,
            writes: bits & 2 != 0,
        }
    }
}

/// The names of the nodes of a ServiceControl, newest first.
const ROLES: &[(ControlRole, &[&str])] = &[
    (ControlRole::Command, &["CommandExt", "ControlExt"]),
    (
        ControlRole::CommandEnabled,
        &["CommandEn", "CommandEnable", "ControlEnable"],
    ),
    (ControlRole::State, &["StateCur", "CurrentState", "State"]),
    (
        ControlRole::ProcedureWanted,
        &["ProcedureExt", "StrategyExt"],
    ),
    (ControlRole::ProcedureRequested, &["ProcedureReq"]),
    (
        ControlRole::ProcedureCurrent,
        &["ProcedureCur", "CurrentStrategy"],
    ),
    (ControlRole::OperationMode, &["OpMode"]),
    (ControlRole::AutomaticActive, &["StateAutAct"]),
    (ControlRole::AutomaticByOperator, &["StateAutOp"]),
    (ControlRole::AutomaticByAutomation, &["StateAutAut"]),
    (ControlRole::OperatorActive, &["StateOpAct"]),
    (ControlRole::ExternalActive, &["SrcExtAct"]),
    (ControlRole::ExternalByOperator, &["SrcExtOp"]),
    (ControlRole::ExternalByAutomation, &["SrcExtAut"]),
    (ControlRole::Quality, &["WQC"]),
    (ControlRole::SourceChannel, &["SrcChannel"]),
    (ControlRole::ModeChannel, &["StateChannel"]),
    (ControlRole::ApplyEnabled, &["ProcParamApplyEn"]),
    (ControlRole::ApplyByExternal, &["ProcParamApplyExt"]),
    (
        ControlRole::ConfigurationApplyEnabled,
        &["ConfigParamApplyEn"],
    ),
    (
        ControlRole::ConfigurationApplyByExternal,
        &["ConfigParamApplyExt"],
    ),
    (ControlRole::Question, &["InteractQuestionID"]),
    (ControlRole::Answer, &["InteractAnswerID"]),
    (ControlRole::Text, &["PosTextID"]),
];

/// The variables of a parameter beside its values, as far as a client from outside uses them.
const HANDSHAKE: &[&str] = &[
    "ApplyEn",
    "ApplyExt",
    "OpMode",
    "SrcChannel",
    "SrcExtAct",
    "SrcExtAut",
    "SrcExtOp",
    "StateAutAct",
    "StateAutAut",
    "StateAutOp",
    "StateChannel",
    "StateOpAct",
    "Sync",
    "VReq",
];

const MAX_FINDINGS: usize = 1000;
/// Limit of documents that a manifest refers to.
const MAX_DOCUMENTS: usize = 100;
