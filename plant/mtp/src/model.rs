//! The model of a manifest, with a single name for each concept.

use std::collections::BTreeMap;

use crate::picture::ModulePicture;

/// A module (PEA) with services.
#[derive(Debug, Clone, PartialEq)]
pub struct Module {
    /// The name of its ModuleTypePackage.
    pub name: String,
    /// Its version; empty if unknown.
    pub version: String,
    /// The edition of the standard that the file follows.
    pub edition: Edition,
    /// The endpoints of its OPC UA servers.
    pub endpoints: Vec<String>,
    /// Its OPC UA servers.
    pub servers: Vec<ManifestServer>,
    /// All nodes of its servers (OPCUAItems).
    pub items: Vec<NodeItem>,
    /// All data assemblies: sensors, actuators, parameters, services.
    pub assemblies: Vec<DataAssembly>,
    /// The values that the module exchanges with other modules.
    pub process_values: Vec<ModuleOutput>,
    /// Its alarms (MTP 2.0).
    pub alarms: Vec<ModuleAlarm>,
    /// Its pictures for operators.
    pub pictures: Vec<ModulePicture>,
    /// Its services, in the order of the file.
    pub services: Vec<MtpService>,
    /// Inconsistencies in the file.
    pub findings: Vec<MtpFinding>,
}

/// The edition of the standard of a manifest.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Edition {
    /// VDI/VDE/NAMUR 2658 and its drafts, MTP 1.x.
    V1,
    /// MTP 2.0, with a hierarchy for each aspect.
    V2,
}

/// An element that is not in the model.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct MtpFinding {
    /// The element, such as `Dosing/volume_based`.
    pub about: String,
    /// Description of the inconsistency.
    pub what: String,
    /// The line of the element, from 1.
    pub line: usize,
    /// Whether the file is consistent, and the element has no place in the model, such as an
    /// interface of another standard.
    pub is_note: bool,
}

impl std::fmt::Display for MtpFinding {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "line {}: {}: {}", self.line, self.about, self.what)
    }
}

/// An OPC UA server of a module.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ManifestServer {
    /// Unique in the file.
    pub id: String,
    /// Its name.
    pub name: String,
    /// Its endpoint; empty if the file has none.
    pub endpoint: String,
}

/// A node of a server, as the file names it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NodeItem {
    /// Its name in the file.
    pub name: String,
    /// The node, with its ID in the file.
    pub node: OpcUaNode,
}

/// A data assembly: the variables of a sensor, an actuator, a parameter or a service.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct DataAssembly {
    /// Unique in the file.
    pub id: String,
    /// Its name.
    pub name: String,
    /// Its most derived type, such as `AnaView` or `MonBinVlv`.
    pub kind: String,
    /// The family of its type.
    pub family: Family,
    /// Its variables in the order of the file.
    pub variables: Vec<AssemblyVariable>,
}

/// A family of data assemblies (VDI/VDE/NAMUR 2658-3).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Family {
    /// IndicatorElement: a sensor.
    Sensor,
    /// ActiveElement: an actuator or a controller.
    Actuator,
    /// OperationElement and service parameters.
    Parameter,
    /// InputElement: a value from another module.
    Input,
    /// ServiceControl.
    Service,
    /// DiagnosticElement, such as the health of a procedure.
    Diagnostic,
    /// PeaElement: information about the module.
    Information,
    /// A type without a family.
    Other,
}

/// A variable of a data assembly.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct AssemblyVariable {
    /// Its name, such as `V` or `VSclMax`.
    pub name: String,
    /// A node, or a value in the file.
    pub link: VariableLink,
}

/// The value of a variable of a data assembly.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum VariableLink {
    /// A node.
    Node(OpcUaNode),
    /// A value in the file.
    Constant(String),
}

/// An output value of a procedure or a service, or a value that a module exchanges with others.
#[derive(Debug, Clone, PartialEq)]
pub struct ModuleOutput {
    /// Unique in the file.
    pub id: String,
    /// Its name.
    pub name: String,
    /// Its use.
    pub role: OutputRole,
    /// Its kind.
    pub kind: ParameterKind,
    /// The data assembly with its variables.
    pub assembly: String,
    /// Minimum value of its scale.
    pub min: Option<ValueBound>,
    /// Maximum value of its scale.
    pub max: Option<ValueBound>,
    /// The number of its unit, or the node with that number.
    pub unit: Option<ValueBound>,
    /// The node with the value.
    pub node: Option<OpcUaNode>,
}

/// The use of an output.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum OutputRole {
    /// A report value.
    Report,
    /// A process value that other modules read.
    ProcessValueOut,
    /// A process value that the module reads from another module.
    ProcessValueIn,
}

/// An alarm of a module (MTP 2.0).
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ModuleAlarm {
    /// Unique in the file.
    pub id: String,
    /// Its name.
    pub name: String,
    /// The text for operators; empty if the file has none.
    pub text: String,
    /// From 1 to 1000.
    pub severity: Option<u16>,
    /// Whether an operator acknowledges it.
    pub is_acknowledged: bool,
    /// The node that triggers it.
    pub trigger: Option<OpcUaNode>,
    /// The value of the node that triggers it; empty if the file has none.
    pub trigger_value: String,
}

/// A service, which runs one of its procedures at a time (VDI/VDE/NAMUR 2658-4).
#[derive(Debug, Clone, PartialEq)]
pub struct MtpService {
    /// Unique in the file; two services may have the same name.
    pub id: String,
    /// Its name.
    pub name: String,
    /// Nodes for commands and monitoring.
    pub control: Control,
    /// Parameters of the service itself.
    pub parameters: Vec<ServiceParameter>,
    /// Output values of the service itself.
    pub outputs: Vec<ModuleOutput>,
    /// The IDs of the equipment that the service requires.
    pub equipment: Vec<String>,
    /// Its procedures.
    pub procedures: Vec<Procedure>,
}

/// A procedure, called strategy in earlier drafts.
#[derive(Debug, Clone, PartialEq)]
pub struct Procedure {
    /// Unique in the file.
    pub id: String,
    /// Its name.
    pub name: String,
    /// The number for requesting the procedure.
    pub number: u32,
    /// Whether it runs if no procedure is requested.
    pub is_default: bool,
    /// Whether it ends by itself, or needs the command to complete.
    pub is_self_completing: bool,
    /// Its parameters.
    pub parameters: Vec<ServiceParameter>,
    /// Its output values.
    pub outputs: Vec<ModuleOutput>,
    /// The IDs of the equipment that the procedure requires.
    pub equipment: Vec<String>,
}

/// An input value of a service or procedure.
#[derive(Debug, Clone, PartialEq)]
pub struct ServiceParameter {
    /// Unique in the file.
    pub id: String,
    /// Its name.
    pub name: String,
    /// Whether it belongs to the configuration of the service, in place of a recipe.
    pub is_configuration: bool,
    /// Its kind.
    pub kind: ParameterKind,
    /// Minimum value.
    pub min: Option<ValueBound>,
    /// Maximum value.
    pub max: Option<ValueBound>,
    /// The number of its unit in VDI/VDE/NAMUR 2658-3, or the node with that number.
    pub unit: Option<ValueBound>,
    /// The node for writing from outside (VExt).
    pub write: Option<OpcUaNode>,
    /// The node for reading the effective value (VOut).
    pub read: Option<OpcUaNode>,
    /// The nodes of the handshake (Apply, mode and source), by the names of the standard.
    pub handshake: Vec<(String, OpcUaNode)>,
}

/// The kind of a parameter.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum ParameterKind {
    /// AnaServParam: a REAL.
    Analog,
    /// DIntServParam, DigServParam: a DINT.
    Integer,
    /// BinServParam: a BOOL.
    Binary,
    /// StringServParam.
    Text,
}

/// A number in the file, or a node with the number while the module runs.
#[derive(Debug, Clone, PartialEq)]
pub enum ValueBound {
    /// A number in the file.
    Constant(f64),
    /// A node.
    Node(OpcUaNode),
}

/// The nodes of a ServiceControl in the file.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Control(pub BTreeMap<ControlRole, OpcUaNode>);

/// The role of a node of a ServiceControl, with the names of other drafts in brackets.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum ControlRole {
    /// CommandExt (ControlExt): commands from outside.
    Command,
    /// CommandEn (CommandEnable, ControlEnable): the currently enabled commands.
    CommandEnabled,
    /// StateCur (CurrentState, State).
    State,
    /// ProcedureExt (StrategyExt): the requested procedure.
    ProcedureWanted,
    /// ProcedureReq: the accepted request.
    ProcedureRequested,
    /// ProcedureCur (CurrentStrategy): the running procedure.
    ProcedureCurrent,
    /// OpMode of early drafts: one word of all modes.
    OperationMode,
    /// StateAutAct: automatic mode is active.
    AutomaticActive,
    /// StateAutOp: an operator selects automatic mode.
    AutomaticByOperator,
    /// StateAutAut: the orchestrating system selects automatic mode.
    AutomaticByAutomation,
    /// StateOpAct: operator mode is active.
    OperatorActive,
    /// SrcExtAct: values and commands from outside are effective.
    ExternalActive,
    /// SrcExtOp: an operator selects values and commands from outside.
    ExternalByOperator,
    /// SrcExtAut: the orchestrating system selects values and commands from outside.
    ExternalByAutomation,
    /// WQC: the quality of the values.
    Quality,
    /// SrcChannel: services select the source of values by themselves.
    SourceChannel,
    /// StateChannel: the orchestrating system selects the mode.
    ModeChannel,
    /// ProcParamApplyEn: parameters of the procedure can be applied.
    ApplyEnabled,
    /// ProcParamApplyExt: applies the parameters of the procedure.
    ApplyByExternal,
    /// ConfigParamApplyEn: parameters of the configuration can be applied.
    ConfigurationApplyEnabled,
    /// ConfigParamApplyExt: applies the parameters of the configuration.
    ConfigurationApplyByExternal,
    /// InteractQuestionID: a question of the service to the operator.
    Question,
    /// InteractAnswerID: the answer to the question.
    Answer,
    /// PosTextID: the number of a text about the progress.
    Text,
}

/// A node of an OPC UA server.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct OpcUaNode {
    /// The ID of its OPCUAItem in the file.
    pub item: String,
    /// The endpoint of its server.
    pub endpoint: String,
    /// The URI of its namespace, or the namespace index that some files have in its place.
    pub namespace: String,
    /// Its identifier in the namespace.
    pub identifier: NodeIdentifier,
    /// Access rights.
    pub access: ItemAccess,
}

/// The identifier of a node.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum NodeIdentifier {
    /// A number.
    Numeric(u32),
    /// A text, including GUIDs and opaque identifiers as written in the file.
    Text(String),
}

/// OPCUAItem's Access: 1 reads, 2 writes, 3 both.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ItemAccess {
    /// Whether the node can be read.
    pub reads: bool,
    /// Whether the node can be written.
    pub writes: bool,
}

impl DataAssembly {
    /// Returns the variable of a name.
    #[must_use]
    pub fn variable(&self, name: &str) -> Option<&AssemblyVariable> {
        self.variables.iter().find(|one| one.name == name)
    }

    /// Returns the node of the first existing variable with one of these names.
    #[must_use]
    pub fn node(&self, names: &[&str]) -> Option<&OpcUaNode> {
        let found = names.iter().find_map(|name| self.variable(name))?;
        match &found.link {
            VariableLink::Node(node) => Some(node),
            VariableLink::Constant(_) => None,
        }
    }

    /// Returns the bound in the first existing variable with one of these names.
    pub(crate) fn bound(&self, names: &[&str]) -> Option<ValueBound> {
        let found = names.iter().find_map(|name| self.variable(name))?;
        match &found.link {
            VariableLink::Node(node) => Some(ValueBound::Node(node.clone())),
            VariableLink::Constant(text) => ValueBound::of_text(text),
        }
    }

    /// Returns the kind of its value; `None` for data assemblies without a single value.
    #[must_use]
    pub fn value_kind(&self) -> Option<ParameterKind> {
        let is = |part: &str| self.kind.contains(part);
        let is_active = matches!(self.family, Family::Actuator | Family::Service);
        match () {
            () if is_active => None,
            () if is("DInt") || is("Dig") => Some(ParameterKind::Integer),
            () if is("Ana") => Some(ParameterKind::Analog),
            () if is("Bin") => Some(ParameterKind::Binary),
            () if is("Str") => Some(ParameterKind::Text),
            () => None,
        }
    }
}

impl ValueBound {
    /// Returns the finite number in a text.
    pub(crate) fn of_text(text: &str) -> Option<Self> {
        let number: f64 = text.parse().ok()?;
        number.is_finite().then_some(Self::Constant(number))
    }

    /// Returns the number in the file.
    #[must_use]
    pub fn constant(&self) -> Option<f64> {
        match self {
            Self::Constant(number) => Some(*number),
            Self::Node(_) => None,
        }
    }

    /// Returns the node with the number.
    #[must_use]
    pub fn node(&self) -> Option<&OpcUaNode> {
        match self {
            Self::Constant(_) => None,
            Self::Node(node) => Some(node),
        }
    }
}

impl Control {
    /// Returns the node with a role.
    #[must_use]
    pub fn node(&self, role: ControlRole) -> Option<&OpcUaNode> {
        self.0.get(&role)
    }
}
