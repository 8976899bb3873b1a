//! What a manifest says, under one name for each thing.

use std::collections::BTreeMap;

/// A module (PEA) with services.
#[derive(Debug, Clone, PartialEq)]
pub struct Module {
    /// The name of its ModuleTypePackage.
    pub name: String,
    /// Its version; empty where none is told.
    pub version: String,
    /// The endpoints of its OPC UA servers.
    pub endpoints: Vec<String>,
    /// What it offers, in the order of the file.
    pub services: Vec<Service>,
    /// What in the file does not hold together.
    pub findings: Vec<Finding>,
}

/// Something that does not hold together; what it is about is left out of the model.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Finding {
    /// The element, as `Dosing/volume_based`.
    pub about: String,
    /// What is wrong with it.
    pub what: String,
}

/// A service, which runs one of its procedures at a time (VDI/VDE/NAMUR 2658-4).
#[derive(Debug, Clone, PartialEq)]
pub struct Service {
    /// Unique in the file; two services may have one name.
    pub id: String,
    /// Its name.
    pub name: String,
    /// How it is commanded and watched.
    pub control: Control,
    /// Parameters of the service itself.
    pub parameters: Vec<Parameter>,
    /// What it can do.
    pub procedures: Vec<Procedure>,
}

/// A procedure, which earlier drafts call strategy.
#[derive(Debug, Clone, PartialEq)]
pub struct Procedure {
    /// Unique in the file.
    pub id: String,
    /// Its name.
    pub name: String,
    /// The number by which it is asked for.
    pub number: u32,
    /// Whether it is taken when none is asked for.
    pub is_default: bool,
    /// Whether it ends by itself, or has to be told to complete.
    pub is_self_completing: bool,
    /// What it needs to know.
    pub parameters: Vec<Parameter>,
}

/// A value to be given to a service or procedure.
#[derive(Debug, Clone, PartialEq)]
pub struct Parameter {
    /// Unique in the file.
    pub id: String,
    /// Its name.
    pub name: String,
    /// What it is.
    pub kind: ValueKind,
    /// The least it may be.
    pub min: Option<Bound>,
    /// The most it may be.
    pub max: Option<Bound>,
    /// The number of its unit in VDI/VDE/NAMUR 2658-3, or the node that tells it.
    pub unit: Option<Bound>,
    /// Where it is written from outside (VExt).
    pub write: Option<Node>,
    /// Where the value that counts is read (VOut).
    pub read: Option<Node>,
}

/// What a parameter is.
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

/// A number the file tells, or the node that tells it while the module runs.
#[derive(Debug, Clone, PartialEq)]
pub enum Bound {
    /// The file does.
    Constant(f64),
    /// A node does.
    Node(Node),
}

/// The nodes of a ServiceControl that the file names.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Control(pub BTreeMap<Role, Node>);

/// What a node of a ServiceControl is for. In brackets what other drafts call it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Role {
    /// CommandExt (ControlExt): commands from outside.
    Command,
    /// CommandEn (CommandEnable, ControlEnable): the commands that are taken now.
    CommandEnabled,
    /// StateCur (CurrentState, State).
    State,
    /// ProcedureExt (StrategyExt): the procedure that is asked for.
    ProcedureWanted,
    /// ProcedureReq: the one that was taken over from there.
    ProcedureRequested,
    /// ProcedureCur (CurrentStrategy): the one that runs.
    ProcedureCurrent,
    /// OpMode of early drafts: one word of all modes.
    OperationMode,
    /// StateAutAct: it is in automatic mode.
    AutomaticActive,
    /// StateAutOp: an operator puts it there.
    AutomaticByOperator,
    /// StateAutAut: the orchestrating system does.
    AutomaticByAutomation,
    /// StateOpAct: it is in operator mode.
    OperatorActive,
    /// SrcExtAct: values and commands from outside count.
    ExternalActive,
    /// SrcExtOp: an operator has it so.
    ExternalByOperator,
    /// SrcExtAut: the orchestrating system has.
    ExternalByAutomation,
    /// WQC: how good what it says is.
    Quality,
}

/// A node of an OPC UA server.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Node {
    /// The endpoint of its server.
    pub endpoint: String,
    /// The URI of its namespace, or the bare index that some files have in its place.
    pub namespace: String,
    /// Its identifier there.
    pub identifier: Identifier,
    /// What may be done with it.
    pub access: Access,
}

/// The identifier of a node.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Identifier {
    /// A number.
    Numeric(u32),
    /// A text, also of GUIDs and opaque ones: as the file has it.
    Text(String),
}

/// OPCUAItem's Access: 1 reads, 2 writes, 3 both.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Access {
    /// It can be read.
    pub reads: bool,
    /// It can be written.
    pub writes: bool,
}

impl Control {
    /// The node for something.
    #[must_use]
    pub fn node(&self, role: Role) -> Option<&Node> {
        self.0.get(&role)
    }
}
