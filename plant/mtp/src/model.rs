//! The model of a manifest, with a single name for each concept.

use std::collections::BTreeMap;

/// A module (PEA) with services.
#[derive(Debug, Clone, PartialEq)]
pub struct Module {
    /// The name of its ModuleTypePackage.
    pub name: String,
    /// Its version; empty if unknown.
    pub version: String,
    /// The endpoints of its OPC UA servers.
    pub endpoints: Vec<String>,
    /// Its services, in the order of the file.
    pub services: Vec<Service>,
    /// Inconsistencies in the file.
    pub findings: Vec<Finding>,
}

/// An inconsistency; its element is not in the model.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Finding {
    /// The element, such as `Dosing/volume_based`.
    pub about: String,
    /// Description of the inconsistency.
    pub what: String,
}

/// A service, which runs one of its procedures at a time (VDI/VDE/NAMUR 2658-4).
#[derive(Debug, Clone, PartialEq)]
pub struct Service {
    /// Unique in the file; two services may have the same name.
    pub id: String,
    /// Its name.
    pub name: String,
    /// Nodes for commands and monitoring.
    pub control: Control,
    /// Parameters of the service itself.
    pub parameters: Vec<Parameter>,
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
    pub parameters: Vec<Parameter>,
}

/// An input value of a service or procedure.
#[derive(Debug, Clone, PartialEq)]
pub struct Parameter {
    /// Unique in the file.
    pub id: String,
    /// Its name.
    pub name: String,
    /// Its kind.
    pub kind: ValueKind,
    /// Minimum value.
    pub min: Option<Bound>,
    /// Maximum value.
    pub max: Option<Bound>,
    /// The number of its unit in VDI/VDE/NAMUR 2658-3, or the node with that number.
    pub unit: Option<Bound>,
    /// The node for writing from outside (VExt).
    pub write: Option<Node>,
    /// The node for reading the effective value (VOut).
    pub read: Option<Node>,
}

/// The kind of a parameter.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum ValueKind {
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
pub enum Bound {
    /// A number in the file.
    Constant(f64),
    /// A node.
    Node(Node),
}

/// The nodes of a ServiceControl in the file.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Control(pub BTreeMap<Role, Node>);

/// The role of a node of a ServiceControl, with the names of other drafts in brackets.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Role {
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
}

/// A node of an OPC UA server.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Node {
    /// The endpoint of its server.
    pub endpoint: String,
    /// The URI of its namespace, or the namespace index that some files have in its place.
    pub namespace: String,
    /// Its identifier in the namespace.
    pub identifier: Identifier,
    /// Access rights.
    pub access: Access,
}

/// The identifier of a node.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Identifier {
    /// A number.
    Numeric(u32),
    /// A text, including GUIDs and opaque identifiers as written in the file.
    Text(String),
}

/// OPCUAItem's Access: 1 reads, 2 writes, 3 both.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Access {
    /// Whether the node can be read.
    pub reads: bool,
    /// Whether the node can be written.
    pub writes: bool,
}

impl Control {
    /// Returns the node with a role.
    #[must_use]
    pub fn node(&self, role: Role) -> Option<&Node> {
        self.0.get(&role)
    }
}
