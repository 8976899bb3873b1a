//! Converts the model to RDF, in the terms of CSS and CaSk.
//!
//! A module is a resource, each of its procedures a skill, and each of its services a capability
//! that its procedures realise. IRIs consist of the base given by the importer and of the IDs in
//! the file, never of names alone. Two modules of the same name, and two services or procedures of
//! the same name in a module, are therefore distinct.

use std::collections::{BTreeMap, HashSet};
use std::fmt;

use uri_text::escaped;

use crate::model::{
    ControlRole, Edition, ItemAccess, Module, MtpService, NodeIdentifier, OpcUaNode, ParameterKind,
    Procedure, ServiceParameter, ValueBound,
};
use crate::state::Command;
use crate::vocabulary as v;

/// A statement.
#[derive(Debug, Clone, PartialEq)]
pub struct Triple {
    /// An IRI.
    pub subject: String,
    /// An IRI, usually of [`vocabulary`](crate::vocabulary).
    pub predicate: String,
    /// The object of the statement.
    pub object: Object,
}

/// The object of a statement.
#[derive(Debug, Clone, PartialEq)]
pub enum Object {
    /// Another resource, by its IRI.
    Iri(String),
    /// An xsd:string.
    Text(String),
    /// An xsd:integer.
    Integer(i64),
    /// An xsd:double.
    Number(f64),
    /// An xsd:boolean.
    Boolean(bool),
    /// An xsd:dateTime in its lexical form.
    Time(String),
}

impl Object {
    /// Returns its lexical form.
    #[must_use]
    pub fn lexical(&self) -> String {
        match self {
            Self::Iri(text) | Self::Text(text) | Self::Time(text) => text.clone(),
            Self::Integer(number) => number.to_string(),
            // The exponent makes the text an xsd:double in Turtle too.
            Self::Number(number) => format!("{number:E}"),
            Self::Boolean(value) => value.to_string(),
        }
    }

    /// Returns the IRI of its datatype; `None` for an IRI and for an xsd:string.
    #[must_use]
    pub const fn datatype(&self) -> Option<&'static str> {
        match self {
            Self::Iri(_) | Self::Text(_) => None,
            Self::Integer(_) => Some("http://www.w3.org/2001/XMLSchema#integer"),
            Self::Number(_) => Some("http://www.w3.org/2001/XMLSchema#double"),
            Self::Boolean(_) => Some("http://www.w3.org/2001/XMLSchema#boolean"),
            Self::Time(_) => Some("http://www.w3.org/2001/XMLSchema#dateTime"),
        }
    }
}

/// The statement as a line of N-Triples, without the end of the line.
impl fmt::Display for Triple {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "<{}> <{}> ", self.subject, self.predicate)?;
        match (&self.object, self.object.datatype()) {
            (Object::Iri(iri), _) => write!(f, "<{iri}> ."),
            (object, datatype) => {
                f.write_str("\"")?;
                for c in object.lexical().chars() {
                    match c {
                        '"' => f.write_str("\\\"")?,
                        '\\' => f.write_str("\\\\")?,
                        '\n' => f.write_str("\\n")?,
                        '\r' => f.write_str("\\r")?,
                        '\t' => f.write_str("\\t")?,
                        c if c.is_control() => write!(f, "\\u{:04X}", u32::from(c))?,
                        c => write!(f, "{c}")?,
                    }
                }
                match datatype {
                    Some(datatype) => write!(f, "\"^^<{datatype}> ."),
                    None => f.write_str("\" ."),
                }
            }
        }
    }
}

impl Module {
    /// Returns the module and its capabilities as statements. `base` is an IRI that no other module
    /// of the plant has; all other IRIs begin with it.
    ///
    /// A manifest does not relate its services to the capabilities of the plant. Each service has a
    /// capability class of its own, `<base>/service/<ID>/capability`, which an ontology can declare
    /// as a subclass. `capabilities` does so here: IRIs of classes by the name of a service, or by
    /// `service/procedure`.
    #[must_use]
    pub fn triples(&self, base: &str, capabilities: &BTreeMap<String, Vec<String>>) -> Vec<Triple> {
        let mut graph = ModuleStatements {
            base,
            all: Vec::new(),
            taken: HashSet::new(),
            capabilities,
        };
        graph.module(self);
        graph.all
    }
}

impl OpcUaNode {
    /// Returns its NodeId in the notation of OPC 10000-6, 5.1.12, such as
    /// `nsu=urn:module;s=Dosing.StateCur`. It starts with `ns=` if the file has only an index.
    #[must_use]
    pub fn id(&self) -> String {
        let is_index = self.namespace.bytes().all(|byte| byte.is_ascii_digit());
        if is_index {
            format!("ns={};{}", self.namespace, self.identifier)
        } else {
            let namespace = self.namespace.replace('%', "%25").replace(';', "%3B");
            format!("nsu={namespace};{}", self.identifier)
        }
    }
}

impl fmt::Display for NodeIdentifier {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Numeric(number) => write!(f, "i={number}"),
            Self::Text(text) => write!(f, "s={text}"),
        }
    }
}

/// The statements about a module.
pub(crate) struct ModuleStatements<'a> {
    base: &'a str,
    all: Vec<Triple>,
    taken: HashSet<String>,
    capabilities: &'a BTreeMap<String, Vec<String>>,
}

impl ModuleStatements<'_> {
    fn module(&mut self, module: &Module) {
        let iri = self.base.to_owned();
        self.taken.insert(iri.clone());
        self.is_a(&iri, &[v::RESOURCE, v::MODULE, v::PAPER_MODULE]);
        self.text(&iri, v::RDFS_LABEL, &module.name);
        let edition = match module.edition {
            Edition::V1 => "1",
            Edition::V2 => "2.0",
        };
        self.text(&iri, v::EDITION, edition);
        if !module.version.is_empty() {
            self.text(&iri, v::VERSION, &module.version);
        }
        for endpoint in &module.endpoints {
            self.text(&iri, v::ENDPOINT, endpoint);
        }
        self.whole(&iri, module);
        for service in &module.services {
            self.service(&iri, service);
        }
    }

    fn service(&mut self, module: &str, service: &MtpService) {
        let iri = self.name(module, "service", &service.id, &service.name);
        self.link(module, v::OFFERS_SERVICE, &iri);
        self.link(module, v::PAPER_HAS_CAPABILITY, &iri);
        self.is_a(&iri, &[v::SERVICE, v::PAPER_PROCESS, v::PAPER_CAPABILITY]);
        self.text(&iri, v::RDFS_LABEL, &service.name);
        for (role, node) in &service.control.0 {
            let node_iri = format!("{iri}/node/{role:?}");
            self.link(&iri, v::HAS_NODE, &node_iri);
            self.is_a(&node_iri, &[v::NODE]);
            self.text(
                &node_iri,
                v::RDFS_LABEL,
                &format!("{}.{role:?}", service.name),
            );
            self.text(&node_iri, v::ROLE, &format!("{role:?}"));
            self.node(&node_iri, node);
        }
        let commands = self.commands(&iri, service);
        let machine = self.state_machine(&iri, service, &commands);
        let variables = self.service_variables(&iri, service);
        let outputs = self.outputs(&iri, &service.name, &service.outputs);
        let class = format!("{iri}/capability");
        self.link(&class, v::RDFS_SUB_CLASS_OF, v::CAPABILITY);
        self.text(&class, v::RDFS_LABEL, &service.name);
        let shared: Vec<_> = service
            .parameters
            .iter()
            .map(|parameter| self.parameter(&iri, &service.name, parameter))
            .collect();
        for procedure in &service.procedures {
            let skill = self.procedure((module, &iri), service, procedure);
            self.capability((module, &skill), &class, service, procedure);
            for parameter in &shared {
                self.link(&skill, v::HAS_INPUT_PARAMETER, parameter);
                self.link(&skill, v::PAPER_HAS_PARAMETER, parameter);
            }
            for (_, command) in &commands {
                self.link(&skill, v::HAS_SKILL_COMMAND, command);
                self.link(&skill, v::PAPER_HAS_COMMAND, command);
            }
            self.link(&skill, v::BEHAVIOR_CONFORMS_TO, &machine);
            self.link(&skill, v::PAPER_HAS_STATE_MACHINE, &machine);
            for (predicate, variable) in variables.iter().chain(&outputs) {
                self.link(&skill, predicate, variable);
            }
            let equipment = service.equipment.iter().chain(&procedure.equipment);
            for id in equipment {
                let element = self.element_iri(id);
                self.link(&skill, v::REQUIRES_EQUIPMENT, &element);
            }
        }
    }

    /// Adds the commands of a procedure: a number for each command, written to the same node.
    fn commands(&mut self, service_iri: &str, service: &MtpService) -> Vec<(Command, String)> {
        let Some(node) = service.control.node(ControlRole::Command) else {
            return Vec::new();
        };
        let mut commands = Vec::new();
        for command in Command::ALL {
            let iri = format!("{service_iri}/command/{command}");
            self.is_a(&iri, &[v::SKILL_COMMAND, v::PAPER_SKILL_COMMAND]);
            self.text(&iri, v::RDFS_LABEL, command.name());
            let value = Object::Integer(command.bit().into());
            self.say(&iri, v::COMMAND_VALUE, value);
            self.node(&iri, node);
            commands.push((*command, iri));
        }
        commands
    }

    fn procedure(
        &mut self,
        (module, service_iri): (&str, &str),
        service: &MtpService,
        procedure: &Procedure,
    ) -> String {
        let iri = self.name(service_iri, "procedure", &procedure.id, &procedure.name);
        self.link(module, v::PROVIDES_SKILL, &iri);
        self.link(service_iri, v::HAS_PROCEDURE, &iri);
        self.link(module, v::PAPER_PROVIDES_SKILL, &iri);
        self.link(service_iri, v::PAPER_IS_EXECUTABLE_VIA, &iri);
        self.is_a(&iri, &[v::SKILL, v::PROCEDURE, v::PAPER_SKILL]);
        self.text(
            &iri,
            v::RDFS_LABEL,
            &format!("{}/{}", service.name, procedure.name),
        );
        self.say(
            &iri,
            v::PROCEDURE_NUMBER,
            Object::Integer(procedure.number.into()),
        );
        self.say(&iri, v::IS_DEFAULT, Object::Boolean(procedure.is_default));
        self.say(
            &iri,
            v::IS_SELF_COMPLETING,
            Object::Boolean(procedure.is_self_completing),
        );
        if let Some(command) = service.control.node(ControlRole::Command) {
            self.node(&iri, command);
        }
        let about = format!("{}/{}", service.name, procedure.name);
        for parameter in &procedure.parameters {
            let parameter = self.parameter(&iri, &about, parameter);
            self.link(&iri, v::HAS_INPUT_PARAMETER, &parameter);
            self.link(&iri, v::PAPER_HAS_PARAMETER, &parameter);
        }
        for (predicate, output) in self.outputs(&iri, &about, &procedure.outputs) {
            self.link(&iri, predicate, &output);
        }
        iri
    }

    fn capability(
        &mut self,
        (module, skill): (&str, &str),
        class: &str,
        service: &MtpService,
        procedure: &Procedure,
    ) {
        let about = format!("{}/{}", service.name, procedure.name);
        let told = [&service.name, &about]
            .into_iter()
            .filter_map(|name| self.capabilities.get(name))
            .flatten();
        let classes: Vec<String> = std::iter::once(class.to_owned())
            .chain(told.cloned())
            .collect();
        let iri = format!("{skill}/capability");
        self.link(module, v::PROVIDES_CAPABILITY, &iri);
        self.is_a(&iri, &[v::PROVIDED_CAPABILITY]);
        self.link(&iri, v::IS_REALIZED_BY_SKILL, skill);
        for class in classes {
            self.link(&iri, v::RDF_TYPE, &class);
            self.link(&class, v::RDFS_SUB_CLASS_OF, v::CAPABILITY);
        }
    }

    /// Returns the IRI of a data assembly by its ID.
    pub(crate) fn element_iri(&self, id: &str) -> String {
        format!("{}/element/{}", self.base, escaped(id))
    }

    fn parameter(&mut self, of: &str, about: &str, parameter: &ServiceParameter) -> String {
        let iri = self.name(of, "parameter", &parameter.id, &parameter.name);
        self.is_a(&iri, &[v::INPUT_PARAMETER, v::PAPER_SKILL_PARAMETER]);
        self.text(&iri, v::RDFS_LABEL, &format!("{about}.{}", parameter.name));
        self.text(&iri, v::HAS_VARIABLE_NAME, &parameter.name);
        self.text(&iri, v::HAS_VARIABLE_TYPE, parameter.kind.data_type());
        // The module keeps the last given value, and starts with an initial value.
        self.say(&iri, v::IS_REQUIRED, Object::Boolean(false));
        let kind = if parameter.is_configuration {
            "configuration"
        } else {
            "procedure"
        };
        self.text(&iri, v::PARAMETER_KIND, kind);
        if let Some(node) = &parameter.write {
            self.node(&iri, node);
        }
        let about = format!("{about}.{}", parameter.name);
        let scale = [&parameter.min, &parameter.max, &parameter.unit];
        self.scale(&iri, &about, scale);
        if let Some(node) = &parameter.read {
            self.part(&iri, &about, "Read", node);
        }
        for (role, node) in &parameter.handshake {
            self.part(&iri, &about, role, node);
        }
        iri
    }

    /// Adds the limits and the unit of a parameter or an output: numbers, or nodes.
    pub(crate) fn scale(&mut self, of: &str, about: &str, scale: [&Option<ValueBound>; 3]) {
        let [min, max, unit] = scale;
        for (bound, predicate, role) in [(min, v::MIN, "Min"), (max, v::MAX, "Max")] {
            match bound {
                Some(ValueBound::Constant(number)) => {
                    self.say(of, predicate, Object::Number(*number));
                    self.constant(of, role, Object::Number(*number));
                }
                Some(ValueBound::Node(node)) => self.part(of, about, role, node),
                None => {}
            }
        }
        match unit {
            Some(ValueBound::Constant(code)) => {
                self.unit(of, *code);
                self.constant(of, "Unit", Object::Number(*code));
            }
            Some(ValueBound::Node(node)) => self.part(of, about, "Unit", node),
            None => {}
        }
    }

    /// Adds a limit or unit whose value is in the file, for the capability model that has each as a
    /// parameter of the skill.
    fn constant(&mut self, of: &str, role: &str, value: Object) {
        let iri = format!("{of}/constant/{role}");
        self.is_a(&iri, &[v::PAPER_SKILL_PARAMETER]);
        self.text(&iri, v::ROLE, role);
        self.say(&iri, v::VALUE, value);
    }

    /// Adds a node of a parameter or an output beside its value.
    fn part(&mut self, of: &str, about: &str, role: &str, node: &OpcUaNode) {
        let iri = format!("{of}/node/{role}");
        self.link(of, v::HAS_NODE, &iri);
        self.is_a(&iri, &[v::NODE]);
        if matches!(role, "Min" | "Max" | "Unit") {
            self.is_a(&iri, &[v::PAPER_SKILL_PARAMETER]);
        }
        self.text(&iri, v::RDFS_LABEL, &format!("{about}.{role}"));
        self.text(&iri, v::ROLE, role);
        self.node(&iri, node);
    }

    fn unit(&mut self, parameter: &str, code: f64) {
        if let Some((code, symbol)) = known_unit(code) {
            self.say(parameter, v::UNIT_CODE, Object::Integer(code.into()));
            self.text(parameter, v::UNIT, symbol);
        } else {
            self.say(parameter, v::UNIT_CODE, Object::Number(code));
        }
    }

    /// Adds the location of a node, and the access to it.
    pub(crate) fn node(&mut self, of: &str, node: &OpcUaNode) {
        self.text(of, v::ACCESS, node.access.name());
        self.text(of, v::ENDPOINT, &node.endpoint);
        self.text(of, v::NODE_NAMESPACE, &node.namespace);
        self.text(of, v::NODE_IDENTIFIER, &node.identifier.to_string());
        self.text(of, v::NODE_ID, &node.id());
    }

    /// Returns a unique IRI: from the ID, or from the name if there is no ID, with a number if it
    /// is taken.
    pub(crate) fn name(&mut self, of: &str, kind: &str, id: &str, name: &str) -> String {
        let part = escaped(if id.is_empty() { name } else { id });
        let mut iri = format!("{of}/{kind}/{part}");
        // A part never contains a comma.
        for number in 2.. {
            if self.taken.insert(iri.clone()) {
                break;
            }
            iri = format!("{of}/{kind}/{part},{number}");
        }
        iri
    }

    pub(crate) fn is_a(&mut self, subject: &str, classes: &[&str]) {
        for class in classes {
            self.link(subject, v::RDF_TYPE, class);
        }
    }

    pub(crate) fn link(&mut self, subject: &str, predicate: &str, object: &str) {
        self.say(subject, predicate, Object::Iri(object.to_owned()));
    }

    pub(crate) fn text(&mut self, subject: &str, predicate: &str, text: &str) {
        self.say(subject, predicate, Object::Text(text.to_owned()));
    }

    pub(crate) fn say(&mut self, subject: &str, predicate: &str, object: Object) {
        self.all.push(Triple {
            subject: subject.to_owned(),
            predicate: predicate.to_owned(),
            object,
        });
    }
}

impl ItemAccess {
    /// Returns its name: `read`, `write`, `read and write` or `none`.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match (self.reads, self.writes) {
            (true, true) => "read and write",
            (true, false) => "read",
            (false, true) => "write",
            (false, false) => "none",
        }
    }
}

/// Returns the symbol of a unit by its number in VDI/VDE/NAMUR 2658-3, table 10.
#[must_use]
pub fn unit_symbol(code: f64) -> Option<&'static str> {
    known_unit(code).map(|(_, symbol)| symbol)
}

fn known_unit(code: f64) -> Option<(u16, &'static str)> {
    let mut known = UNITS.iter().copied();
    known.find(|(known, _)| f64::from(*known) == code)
}

impl ParameterKind {
    /// Returns the OPC UA DataType of such values.
    #[must_use]
    pub fn data_type(self) -> &'static str {
        match self {
            Self::Analog => "Float",
            Self::Integer => "Int32",
            Self::Binary => "Boolean",
            Self::Text => "String",
        }
    }
}

/// The most common units (VDI/VDE/NAMUR 2658-3, table 10). Other units have only their code.
const UNITS: &[(u16, &str)] = &[
    (1000, "K"),
    (1001, "°C"),
    (1002, "°F"),
    (1005, "°"),
    (1010, "m"),
    (1013, "mm"),
    (1018, "ft"),
    (1023, "m²"),
    (1038, "L"),
    (1041, "hL"),
    (1054, "s"),
    (1058, "min"),
    (1059, "h"),
    (1060, "d"),
    (1061, "m/s"),
    (1077, "Hz"),
    (1081, "kHz"),
    (1082, "1/s"),
    (1083, "1/min"),
    (1088, "kg"),
    (1092, "t"),
    (1100, "g/cm³"),
    (1105, "g/L"),
    (1120, "N"),
    (1123, "mN"),
    (1130, "Pa"),
    (1133, "kPa"),
    (1137, "bar"),
    (1138, "mbar"),
    (1175, "Wh"),
    (1179, "kWh"),
    (1190, "kW"),
    (1209, "A"),
    (1211, "mA"),
    (1221, "Ah"),
    (1240, "V"),
    (1342, "%"),
    (1349, "m³/h"),
    (1353, "L/h"),
    (1384, "mol"),
    (1422, "pH"),
];
