//! A simulated module (PEA) of a manifest: values of all nodes, modes, and the state machines of
//! its services. It has no clock and no server.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use crate::model::{
    ControlRole, DataAssembly, Family, Module, MtpService, OpcUaNode, ParameterKind, VariableLink,
};
use crate::state::{Command, State};

/// The value of a node.
#[derive(Debug, Clone, PartialEq)]
pub enum PeaValue {
    /// A Boolean.
    Boolean(bool),
    /// A Byte: the quality of values, the access of operators.
    Byte(u8),
    /// A UInt32: commands, states, numbers of procedures.
    Word(u32),
    /// An Int32.
    Integer(i32),
    /// A Float.
    Number(f32),
    /// A String.
    Text(String),
}

/// Reason why a node cannot be written.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum PeaRefusal {
    /// There is no such node.
    #[error("there is no such node")]
    Unknown,
    /// The manifest gives no access for writing.
    #[error("the node is read-only")]
    ReadOnly,
    /// The value has another type.
    #[error("the value has another type than the node")]
    WrongType,
}

/// Deviations of a simulated module from the standard, as modules in the field have them.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct PeaFaults {
    /// CommandExt keeps its value after a command.
    pub keeps_command: bool,
    /// CommandEn is 0 until the mode is automatic and external.
    pub enables_late: bool,
    /// StateCur has this word in the state Resetting.
    pub resetting_word: Option<u32>,
    /// The module ignores requests of automatic mode.
    pub stays_in_operator_mode: bool,
    /// The module ignores requests of procedures.
    pub ignores_procedure: bool,
    /// Services never leave this state by themselves.
    pub stuck_in: Option<State>,
}

/// A simulated module.
#[derive(Debug, Clone)]
pub struct Pea {
    values: BTreeMap<String, PeaValue>,
    writable: BTreeSet<String>,
    services: Vec<SimulatedService>,
    changed: BTreeSet<String>,
    faults: PeaFaults,
    acting: Duration,
    executing: Duration,
    now: Duration,
}

/// The nodes of a parameter, by their items.
#[derive(Debug, Clone)]
struct SimulatedParameter {
    external: Option<String>,
    requested: Option<String>,
    outputs: Vec<String>,
    apply: Option<String>,
    modes: Modes,
}

#[derive(Debug, Clone, Default)]
struct Modes {
    nodes: BTreeMap<&'static str, String>,
}

#[derive(Debug, Clone)]
struct SimulatedService {
    nodes: BTreeMap<ControlRole, String>,
    modes: Modes,
    parameters: Vec<SimulatedParameter>,
    /// The numbers of the procedures, and whether each completes by itself.
    procedures: BTreeMap<u32, bool>,
    requested: u32,
    current: u32,
    state: State,
    since: Duration,
    is_automatic: bool,
    is_external: bool,
}

impl Pea {
    /// Creates a module in operator mode with all services Idle.
    #[must_use]
    pub fn new(module: &Module) -> Self {
        let mut pea = Self {
            values: BTreeMap::new(),
            writable: BTreeSet::new(),
            services: Vec::new(),
            changed: BTreeSet::new(),
            faults: PeaFaults::default(),
            acting: Duration::from_millis(100),
            executing: Duration::from_secs(2),
            now: Duration::ZERO,
        };
        for item in &module.items {
            let key = item.node.item.clone();
            if item.node.access.writes {
                pea.writable.insert(key.clone());
            }
            pea.values.insert(key, PeaValue::Boolean(false));
        }
        for assembly in &module.assemblies {
            for variable in &assembly.variables {
                if let VariableLink::Node(node) = &variable.link {
                    let value = initial(assembly, &variable.name);
                    pea.values.insert(node.item.clone(), value);
                }
            }
        }
        pea.services = module
            .services
            .iter()
            .map(|service| SimulatedService::new(service, module))
            .collect();
        for at in 0..pea.services.len() {
            pea.publish(at);
        }
        pea.changed.clear();
        pea
    }

    /// Sets the times of an acting state, and of Execute for procedures that complete by
    /// themselves.
    #[must_use]
    pub fn with_times(mut self, acting: Duration, executing: Duration) -> Self {
        self.acting = acting;
        self.executing = executing;
        self
    }

    /// Sets deviations from the standard.
    #[must_use]
    pub fn with_faults(mut self, faults: PeaFaults) -> Self {
        self.faults = faults;
        for at in 0..self.services.len() {
            self.publish(at);
        }
        self.changed.clear();
        self
    }

    /// Returns the value of a node by the ID of its item.
    #[must_use]
    pub fn value(&self, item: &str) -> Option<&PeaValue> {
        self.values.get(item)
    }

    /// Returns all values by the IDs of their items.
    pub fn values(&self) -> impl Iterator<Item = (&str, &PeaValue)> {
        self.values.iter().map(|(item, value)| (&**item, value))
    }

    /// Returns the state of a service by its position in the manifest.
    #[must_use]
    pub fn state(&self, service: usize) -> Option<State> {
        self.services.get(service).map(|service| service.state)
    }

    /// Writes a node as a client does.
    ///
    /// # Errors
    /// [`PeaRefusal`]. A write that the state of the module does not allow is accepted and has no
    /// effect, as in a module of the standard.
    pub fn write(&mut self, item: &str, value: PeaValue) -> Result<(), PeaRefusal> {
        let known = self.values.get(item).ok_or(PeaRefusal::Unknown)?;
        if !self.writable.contains(item) {
            return Err(PeaRefusal::ReadOnly);
        }
        if std::mem::discriminant(known) != std::mem::discriminant(&value) {
            return Err(PeaRefusal::WrongType);
        }
        self.set(item, value);
        for at in 0..self.services.len() {
            self.handle(at, item);
        }
        Ok(())
    }

    /// Advances the time.
    pub fn advance(&mut self, by: Duration) {
        self.now = self.now.saturating_add(by);
        for at in 0..self.services.len() {
            // A service passes at most two acting states in a step.
            for _ in 0..2 {
                self.leave(at);
            }
        }
    }

    /// Returns the items with values that changed since the previous call.
    pub fn take_changes(&mut self) -> BTreeSet<String> {
        std::mem::take(&mut self.changed)
    }

    fn leave(&mut self, at: usize) {
        let Some(service) = self.services.get_mut(at) else {
            return;
        };
        let (state, spent) = (service.state, self.now.saturating_sub(service.since));
        let is_self_completing = service.procedures.get(&service.current) == Some(&true);
        let next = if state == State::Execute {
            let is_over = is_self_completing && spent >= self.executing;
            is_over.then_some(State::Completing)
        } else {
            state.next().filter(|_| spent >= self.acting)
        };
        let Some(next) = next else { return };
        if self.faults.stuck_in == Some(state) {
            return;
        }
        self.enter(at, next);
    }

    fn enter(&mut self, at: usize, state: State) {
        let now = self.now;
        let mut taken = Vec::new();
        if let Some(service) = self.services.get_mut(at) {
            if state == State::Starting {
                service.current = service.requested;
                taken.clone_from(&service.parameters);
            }
            if state == State::Idle {
                service.current = 0;
            }
            service.state = state;
            service.since = now;
        }
        for parameter in taken {
            let source = parameter
                .requested
                .as_ref()
                .or(parameter.external.as_ref())
                .and_then(|item| self.values.get(item).cloned());
            for output in parameter.outputs {
                if let Some(value) = &source {
                    self.set(&output, value.clone());
                }
            }
        }
        self.publish(at);
    }

    fn handle(&mut self, at: usize, item: &str) {
        let faults = self.faults.clone();
        let Some(service) = self.services.get(at) else {
            return;
        };
        let role = service
            .nodes
            .iter()
            .find(|(_, node)| *node == item)
            .map(|(role, _)| *role);
        let word = match self.values.get(item) {
            Some(PeaValue::Word(word)) => *word,
            Some(PeaValue::Boolean(is_set)) => u32::from(*is_set),
            Some(
                PeaValue::Byte(_) | PeaValue::Integer(_) | PeaValue::Number(_) | PeaValue::Text(_),
            )
            | None => 0,
        };
        let is_effective = service.is_automatic && service.is_external;
        match role {
            Some(ControlRole::Command) => {
                let state = service.state;
                let command = Command::of_bit(word).filter(|_| is_effective);
                if let Some(next) = command.and_then(|command| state.after(command)) {
                    self.enter(at, next);
                }
                if !faults.keeps_command {
                    self.set(item, PeaValue::Word(0));
                }
                return;
            }
            Some(ControlRole::ProcedureWanted) => {
                let is_known = service.procedures.contains_key(&word);
                if is_effective && is_known && !faults.ignores_procedure {
                    if let Some(service) = self.services.get_mut(at) {
                        service.requested = word;
                    }
                    self.publish(at);
                }
                return;
            }
            Some(ControlRole::OperationMode) => {
                let asks = |bit: u32| word & bit != 0;
                let (automatic, external) = (asks(OP_MODE_AUTOMATIC), asks(OP_MODE_EXTERNAL));
                self.switch(at, automatic, external);
                return;
            }
            Some(_) | None => {}
        }
        let mode = service.modes.name_of(item).filter(|_| word == 1);
        match mode {
            Some(name) => {
                let (automatic, external) = asked(name);
                self.switch(at, automatic, external);
                self.set(item, PeaValue::Boolean(false));
            }
            None => self.handle_parameter(at, item, word == 1),
        }
    }

    fn switch(&mut self, at: usize, automatic: bool, external: bool) {
        if self.faults.stays_in_operator_mode {
            return;
        }
        if let Some(service) = self.services.get_mut(at) {
            service.is_automatic |= automatic;
            service.is_external |= external;
        }
        self.publish(at);
    }

    fn handle_parameter(&mut self, at: usize, item: &str, is_set: bool) {
        let Some(service) = self.services.get(at) else {
            return;
        };
        let mut changes = Vec::new();
        let is_running = service.state == State::Execute;
        for parameter in &service.parameters {
            let is_external = parameter.external.as_deref() == Some(item);
            let is_apply = parameter.apply.as_deref() == Some(item) && is_set;
            let value = parameter
                .external
                .as_ref()
                .and_then(|item| self.values.get(item).cloned());
            let Some(value) = value else { continue };
            if is_apply || (is_external && parameter.apply.is_none()) {
                changes.extend(parameter.requested.clone().map(|to| (to, value.clone())));
                if is_running {
                    let outputs = parameter.outputs.iter().cloned();
                    changes.extend(outputs.map(|to| (to, value.clone())));
                }
            }
            if is_apply {
                changes.push((item.to_owned(), PeaValue::Boolean(false)));
            }
            if let Some(name) = parameter.modes.name_of(item).filter(|_| is_set) {
                let (automatic, _) = asked(name);
                let shown = if automatic {
                    "StateAutAct"
                } else {
                    "SrcExtAct"
                };
                let shown = parameter.modes.nodes.get(shown).cloned();
                changes.extend(shown.map(|to| (to, PeaValue::Boolean(true))));
                changes.push((item.to_owned(), PeaValue::Boolean(false)));
            }
        }
        for (to, value) in changes {
            self.set(&to, value);
        }
    }

    /// Publishes the values of a service.
    fn publish(&mut self, at: usize) {
        let Some(service) = self.services.get(at) else {
            return;
        };
        let is_effective = service.is_automatic && service.is_external;
        let commands = if self.faults.enables_late && !is_effective {
            0
        } else {
            service.state.commands()
        };
        let state = match (service.state, self.faults.resetting_word) {
            (State::Resetting, Some(word)) => word,
            (state, _) => state.bit(),
        };
        let mut mode = 0;
        if service.is_automatic {
            mode |= OP_MODE_AUTOMATIC_ACTIVE;
        }
        if service.is_external {
            mode |= OP_MODE_EXTERNAL_ACTIVE;
        }
        let shown = [
            (ControlRole::State, PeaValue::Word(state)),
            (ControlRole::CommandEnabled, PeaValue::Word(commands)),
            (
                ControlRole::ProcedureRequested,
                PeaValue::Word(service.requested),
            ),
            (
                ControlRole::ProcedureCurrent,
                PeaValue::Word(service.current),
            ),
            (ControlRole::OperationMode, PeaValue::Word(mode)),
            (
                ControlRole::AutomaticActive,
                PeaValue::Boolean(service.is_automatic),
            ),
            (
                ControlRole::OperatorActive,
                PeaValue::Boolean(!service.is_automatic),
            ),
            (
                ControlRole::ExternalActive,
                PeaValue::Boolean(service.is_external),
            ),
            (ControlRole::Quality, PeaValue::Byte(255)),
        ];
        let nodes = service.nodes.clone();
        for (role, value) in shown {
            if let Some(item) = nodes.get(&role) {
                self.set(item, value);
            }
        }
    }

    fn set(&mut self, item: &str, value: PeaValue) {
        if let Some(known) = self.values.get_mut(item)
            && *known != value
        {
            *known = value;
            self.changed.insert(item.to_owned());
        }
    }
}

impl Modes {
    fn name_of(&self, item: &str) -> Option<&'static str> {
        let mut nodes = self.nodes.iter();
        nodes
            .find(|(name, node)| *node == item && REQUESTS.contains(*name))
            .map(|(name, _)| *name)
    }
}

impl SimulatedService {
    fn new(service: &MtpService, module: &Module) -> Self {
        let nodes: BTreeMap<ControlRole, String> = service
            .control
            .0
            .iter()
            .map(|(role, node)| (*role, node.item.clone()))
            .collect();
        let mut modes = Modes::default();
        for (role, name) in [
            (ControlRole::AutomaticByOperator, "StateAutOp"),
            (ControlRole::AutomaticByAutomation, "StateAutAut"),
            (ControlRole::ExternalByOperator, "SrcExtOp"),
            (ControlRole::ExternalByAutomation, "SrcExtAut"),
        ] {
            if let Some(item) = nodes.get(&role) {
                modes.nodes.insert(name, item.clone());
            }
        }
        let of_procedures = service.procedures.iter().flat_map(|one| &one.parameters);
        let parameters = service.parameters.iter().chain(of_procedures);
        let parameters = parameters.map(|parameter| {
            let shake = |name: &str| {
                let mut nodes = parameter.handshake.iter();
                let found = nodes.find(|(known, _)| known == name)?;
                Some(found.1.item.clone())
            };
            let known = REQUESTS.iter().chain(&["StateAutAct", "SrcExtAct"]);
            SimulatedParameter {
                external: parameter.write.as_ref().map(|node| node.item.clone()),
                requested: shake("VReq"),
                outputs: outputs(module, parameter.read.as_ref()),
                apply: shake("ApplyExt"),
                modes: Modes {
                    nodes: known
                        .filter_map(|name| Some((*name, shake(name)?)))
                        .collect(),
                },
            }
        });
        let default = service.procedures.iter().find(|one| one.is_default);
        Self {
            nodes,
            modes,
            parameters: parameters.collect(),
            procedures: service
                .procedures
                .iter()
                .map(|one| (one.number, one.is_self_completing))
                .collect(),
            requested: default.map_or(0, |one| one.number),
            current: 0,
            state: State::Idle,
            since: Duration::ZERO,
            is_automatic: false,
            is_external: false,
        }
    }
}

/// Returns the items that show the effective value of a parameter: VOut, VFbk and VRbk of its data
/// assembly.
fn outputs(module: &Module, read: Option<&OpcUaNode>) -> Vec<String> {
    let Some(read) = read else { return Vec::new() };
    let is_of = |assembly: &&DataAssembly| {
        assembly.variables.iter().any(
            |variable| matches!(&variable.link, VariableLink::Node(node) if node.item == read.item),
        )
    };
    let Some(assembly) = module.assemblies.iter().find(is_of) else {
        return vec![read.item.clone()];
    };
    ["VOut", "VFbk", "VRbk"]
        .iter()
        .filter_map(|name| Some(assembly.node(&[name])?.item.clone()))
        .collect()
}

/// Returns whether a request asks for automatic mode, and for the external source.
fn asked(name: &str) -> (bool, bool) {
    (name.starts_with("StateAut"), name.starts_with("SrcExt"))
}

/// Returns the first value of a variable, which defines its type.
fn initial(assembly: &DataAssembly, name: &str) -> PeaValue {
    let is_word = name.starts_with("Command")
        || name.starts_with("Control")
        || name.starts_with("Procedure")
        || name.starts_with("Strategy")
        || matches!(
            name,
            "StateCur" | "CurrentState" | "State" | "CurrentStrategy" | "OpMode"
        )
        || name.ends_with("ID");
    let is_text = assembly.family == Family::Information
        || name.starts_with("VState")
        || name.starts_with("Tag")
        || name.ends_with("Name");
    let is_value = matches!(
        name,
        "V" | "VExt"
            | "VOp"
            | "VMan"
            | "VInt"
            | "VReq"
            | "VOut"
            | "VFbk"
            | "VRbk"
            | "VMin"
            | "VMax"
            | "VSclMin"
            | "VSclMax"
    );
    match () {
        () if is_word => PeaValue::Word(0),
        () if matches!(name, "WQC" | "OSLevel") => PeaValue::Byte(0),
        () if is_text => PeaValue::Text(String::new()),
        () if name.ends_with("Unit") => PeaValue::Integer(0),
        () if is_value => match assembly.value_kind() {
            Some(ParameterKind::Analog) => {
                PeaValue::Number(if name == "VMax" || name == "VSclMax" {
                    100.0
                } else {
                    0.0
                })
            }
            Some(ParameterKind::Integer) => {
                PeaValue::Integer(if name == "VMax" || name == "VSclMax" {
                    100
                } else {
                    0
                })
            }
            Some(ParameterKind::Text) => PeaValue::Text(String::new()),
            Some(ParameterKind::Binary) | None => PeaValue::Boolean(false),
        },
        () if NUMBERS.contains(&name) => PeaValue::Number(0.0),
        () => PeaValue::Boolean(name == "ApplyEn" || name.ends_with("ApplyEn")),
    }
}

/// Requests of modes from outside.
const REQUESTS: [&str; 4] = ["StateAutOp", "StateAutAut", "SrcExtOp", "SrcExtAut"];
/// Variables of actuators and controllers that are numbers.
const NUMBERS: [&str; 10] = [
    "Rpm", "RpmFbk", "Pos", "PosFbk", "MV", "SP", "PV", "P", "Ti", "Td",
];
/// Bits of the word OpMode of early drafts.
pub const OP_MODE_AUTOMATIC: u32 = 64;
/// The bit of active automatic mode.
pub const OP_MODE_AUTOMATIC_ACTIVE: u32 = 256;
/// The bit that requests the external source.
pub const OP_MODE_EXTERNAL: u32 = 8192;
/// The bit of the active external source.
pub const OP_MODE_EXTERNAL_ACTIVE: u32 = 16384;
