//! Converts the tree of elements to the model.

use std::borrow::Cow;
use std::collections::HashMap;

use crate::caex::{Element, ManifestError};
use crate::container;
use crate::model::{
    Access, Bound, Control, Finding, Identifier, Module, Node, Parameter, Procedure, Role, Service,
    ValueKind,
};

impl Module {
    /// Reads a manifest as delivered: an `.aml` file in any encoding of [`xml_text`], or a ZIP
    /// container with such a file (`.mtp` or `.amlx`).
    ///
    /// # Errors
    /// [`ManifestError`] if the file is not a manifest.
    pub fn from_bytes(file: &[u8]) -> Result<Self, ManifestError> {
        let unpacked = match container::is_container(file) {
            true => Cow::Owned(container::document(file)?),
            false => Cow::Borrowed(file),
        };
        Self::read(&xml_text::decode(&unpacked)?)
    }

    /// Reads a manifest, the text of the `.aml` file of an MTP.
    ///
    /// # Errors
    /// [`ManifestError`] if the file is not a manifest. Inconsistencies in a manifest are in
    /// [`findings`](Self::findings).
    pub fn read(manifest: &str) -> Result<Self, ManifestError> {
        let root = Element::read(manifest)?;
        let of_module = |element: &&Element| element.path == "MTPSUCLib/ModuleTypePackage";
        let module = root.all().find(of_module).ok_or(ManifestError::NoModule)?;
        let mut reading = Reading::of(&root);
        let services = root
            .all()
            .filter(|element| element.path == "MTPServiceSUCLib/Service")
            .map(|service| reading.service(service))
            .collect();
        Ok(Self {
            name: module.name.clone(),
            version: module.value(&["Version"]).unwrap_or_default().to_owned(),
            endpoints: reading.endpoints,
            services,
            findings: reading.findings,
        })
    }
}

/// Index of the elements that are referenced in a file.
struct Reading<'a> {
    /// OPCUAItems by their ID.
    nodes: HashMap<&'a str, Node>,
    /// DataAssemblies by their RefID, and by their ID for files with services that reference the
    /// ID.
    assemblies: HashMap<&'a str, &'a Element>,
    /// All elements by their ID.
    elements: HashMap<&'a str, &'a Element>,
    endpoints: Vec<String>,
    findings: Vec<Finding>,
}

impl<'a> Reading<'a> {
    fn of(root: &'a Element) -> Self {
        let mut reading = Self {
            nodes: HashMap::new(),
            assemblies: HashMap::new(),
            elements: HashMap::new(),
            endpoints: Vec::new(),
            findings: Vec::new(),
        };
        for element in root.all() {
            if !element.id.is_empty() {
                reading.elements.insert(&element.id, element);
            }
            if element.kind() == "OPCUAServer" {
                reading.server(element);
            }
            let is_assembly =
                matches!(element.kind(), "ServiceControl") || kind_of(element).is_some();
            if is_assembly {
                reading.assemblies.entry(&element.id).or_insert(element);
                // There may be two: in the files that have two, the last attribute is referenced.
                for attribute in element
                    .attributes
                    .iter()
                    .filter(|attribute| attribute.name == "RefID")
                {
                    reading.assemblies.insert(attribute.value.trim(), element);
                }
            }
        }
        reading
    }

    fn server(&mut self, server: &'a Element) {
        let endpoint = server.value(&["Endpoint"]).unwrap_or_default();
        if !self.endpoints.iter().any(|known| known == endpoint) {
            self.endpoints.push(endpoint.to_owned());
        }
        for item in server
            .children
            .iter()
            .filter(|item| item.kind() == "OPCUAItem")
        {
            let (Some(identifier), Some(namespace)) =
                (item.value(&["Identifier"]), item.value(&["Namespace"]))
            else {
                self.find(
                    &item.name,
                    "the OPCUAItem has no Identifier or no Namespace",
                );
                continue;
            };
            let is_numeric = item
                .attributes
                .iter()
                .any(|attribute| attribute.name == "Identifier" && is_number(&attribute.data_type));
            let node = Node {
                endpoint: endpoint.to_owned(),
                namespace: namespace.to_owned(),
                identifier: Identifier::of(identifier, is_numeric),
                access: Access::of(item.value(&["Access"])),
            };
            self.nodes.insert(&item.id, node);
        }
    }

    fn service(&mut self, element: &'a Element) -> Service {
        let control = match self.assembly(element) {
            Some(assembly) if assembly.kind() == "ServiceControl" => self.control(assembly),
            _ => {
                self.find(
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
        Service {
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

    fn procedure(&mut self, service: &str, element: &'a Element) -> Option<Procedure> {
        let about = format!("{service}/{}", element.name);
        let number = element.value(&["ProcedureID", "ProcedureId", "StrategyID"]);
        let Some(number) = number.and_then(|number| number.parse().ok()) else {
            self.find(&about, "it has no number by which it could be asked for");
            return None;
        };
        let required = required(element).filter_map(|id| self.elements.get(id).copied());
        let parts: Vec<&Element> = element
            .children
            .iter()
            .filter(|child| is_parameter(child))
            .chain(required)
            .collect();
        Some(Procedure {
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

    fn parameter(&mut self, about: &str, element: &'a Element) -> Option<Parameter> {
        let assembly = self.assembly(element);
        let Some((assembly, kind)) = assembly.and_then(|found| Some((found, kind_of(found)?)))
        else {
            let about = format!("{about}/{}", element.name);
            self.find(
                &about,
                "no data assembly of a kind known here belongs to this parameter",
            );
            return None;
        };
        Some(Parameter {
            id: element.id.clone(),
            name: element.name.clone(),
            kind,
            min: self.bound(assembly, "VMin"),
            max: self.bound(assembly, "VMax"),
            unit: self.bound(assembly, "VUnit"),
            write: self.node(assembly, &["VExt"]),
            read: self.node(assembly, &["VOut", "VFbk", "VRbk"]),
        })
    }

    fn control(&mut self, assembly: &Element) -> Control {
        let roles = ROLES
            .iter()
            .filter_map(|(role, names)| Some((*role, self.node(assembly, names)?)));
        Control(roles.collect())
    }

    /// Returns the element that a service, procedure or parameter references by its RefID.
    fn assembly(&self, element: &Element) -> Option<&'a Element> {
        self.assemblies.get(element.value(&["RefID"])?).copied()
    }

    fn node(&self, assembly: &Element, names: &[&str]) -> Option<Node> {
        self.nodes.get(assembly.value(names)?).cloned()
    }

    fn bound(&self, assembly: &Element, name: &str) -> Option<Bound> {
        let value = assembly.value(&[name])?;
        match self.nodes.get(value) {
            Some(node) => Some(Bound::Node(node.clone())),
            None => value
                .parse()
                .ok()
                .filter(|number: &f64| number.is_finite())
                .map(Bound::Constant),
        }
    }

    fn find(&mut self, about: &str, what: &str) {
        if self.findings.len() < MAX_FINDINGS {
            self.findings.push(Finding {
                about: about.to_owned(),
                what: what.to_owned(),
            });
        }
    }
}

/// Returns the IDs in RequiredParameters, by which strategies reference the parameters of their
/// service.
fn required(strategy: &Element) -> impl Iterator<Item = &str> {
    let ids = strategy.value(&["RequiredParameters"]).unwrap_or_default();
    ids.split_whitespace()
}

fn is_procedure(element: &Element) -> bool {
    matches!(
        element.kind(),
        "Procedure" | "ServiceProcedure" | "ServiceStrategy"
    )
}

fn is_parameter(element: &Element) -> bool {
    matches!(
        element.kind(),
        "ConfigurationParameter" | "ProcedureParameter" | "StrategyParameter"
    )
}

fn kind_of(assembly: &Element) -> Option<ValueKind> {
    match assembly.kind() {
        "AnaServParam" => Some(ValueKind::Analog),
        "DIntServParam" | "DigServParam" => Some(ValueKind::Integer),
        "BinServParam" => Some(ValueKind::Binary),
        "StringServParam" => Some(ValueKind::Text),
        // A draft of 2018.
        "ServAnaParam" | "StrategyAnaParam" => Some(ValueKind::Analog),
        // Before parameters had kinds of their own, they were operations from outside.
        "ExtAnaOp" | "ExtIntAnaOp" | "AdvAnaOp" => Some(ValueKind::Analog),
        "ExtDigOp" | "ExtIntDigOp" | "AdvDigOp" => Some(ValueKind::Integer),
        "ExtBinOp" | "ExtIntBinOp" | "AdvBinOp" => Some(ValueKind::Binary),
        _ => None,
    }
}

fn is_true(value: Option<&str>) -> bool {
    value.is_some_and(|value| value.eq_ignore_ascii_case("true") || value == "1")
}

fn is_number(data_type: &str) -> bool {
    matches!(
        data_type.trim_start_matches("xs:"),
        "unsignedInt" | "unsignedLong" | "int" | "integer" | "long" | "unsignedShort"
    )
}

impl Identifier {
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

impl Access {
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
const ROLES: &[(Role, &[&str])] = &[
    (Role::Command, &["CommandExt", "ControlExt"]),
    (
        Role::CommandEnabled,
        &["CommandEn", "CommandEnable", "ControlEnable"],
    ),
    (Role::State, &["StateCur", "CurrentState", "State"]),
    (Role::ProcedureWanted, &["ProcedureExt", "StrategyExt"]),
    (Role::ProcedureRequested, &["ProcedureReq"]),
    (Role::ProcedureCurrent, &["ProcedureCur", "CurrentStrategy"]),
    (Role::OperationMode, &["OpMode"]),
    (Role::AutomaticActive, &["StateAutAct"]),
    (Role::AutomaticByOperator, &["StateAutOp"]),
    (Role::AutomaticByAutomation, &["StateAutAut"]),
    (Role::OperatorActive, &["StateOpAct"]),
    (Role::ExternalActive, &["SrcExtAct"]),
    (Role::ExternalByOperator, &["SrcExtOp"]),
    (Role::ExternalByAutomation, &["SrcExtAut"]),
    (Role::Quality, &["WQC"]),
];

const MAX_FINDINGS: usize = 1000;
