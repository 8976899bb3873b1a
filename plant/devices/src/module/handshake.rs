//! The handshake with a service: mode and source, procedure, parameters and commands. Each wait has
//! a name and a time limit.

use std::time::Duration;

use async_trait::async_trait;
use mtp::pea::{OP_MODE_AUTOMATIC, OP_MODE_AUTOMATIC_ACTIVE, OP_MODE_EXTERNAL};
use mtp::state::{Command, State};
use mtp::{ControlRole, MtpService, OpcUaNode, Procedure, ServiceParameter, ValueBound};
use skills::{ClientOptions, SkillValue};
use tokio::time::{Instant, sleep};

use super::error::{ModuleError, ModuleNodeError, StateWord};
use super::is_equal;

/// Access to the nodes of a module.
#[async_trait]
pub trait ModuleNodes: Send + Sync + 'static {
    /// Sets the identity of later connections.
    fn identify(&self, options: &ClientOptions) {
        let _unused = options;
    }

    /// Waits until the server of a node can be reached.
    ///
    /// # Errors
    /// [`ModuleNodeError::Unreachable`].
    async fn connect(&self, node: &OpcUaNode, within: Duration) -> Result<(), ModuleNodeError>;

    /// Reads the values of nodes of one server; `None` for bad values.
    ///
    /// # Errors
    /// There is no response.
    async fn read(&self, nodes: &[&OpcUaNode]) -> Result<Vec<Option<SkillValue>>, ModuleNodeError>;

    /// Writes a value in the type of the node.
    ///
    /// # Errors
    /// The value was refused, or there is no response.
    async fn write(&self, node: &OpcUaNode, value: SkillValue) -> Result<(), ModuleNodeError>;
}

/// Time limits of a module.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct HandshakeTiming {
    /// Time limit of the connection.
    pub connect: Duration,
    /// Time limit of each wait of the handshake.
    pub handshake: Duration,
    /// Time limit from Halt until the service has stopped.
    pub stop: Duration,
    /// Time without answers after which the end of a run is unknown.
    pub lost: Duration,
    /// Interval of reads.
    pub poll: Duration,
}

impl Default for HandshakeTiming {
    fn default() -> Self {
        Self {
            connect: Duration::from_secs(5),
            handshake: Duration::from_secs(5),
            stop: Duration::from_secs(10),
            lost: Duration::from_secs(10),
            poll: Duration::from_millis(50),
        }
    }
}

/// A service and the access to its nodes.
pub(super) struct Handshake<'a> {
    pub(super) service: &'a MtpService,
    pub(super) nodes: &'a dyn ModuleNodes,
    pub(super) timing: HandshakeTiming,
}

impl Handshake<'_> {
    /// Reads the state of the service.
    pub(super) async fn state(&self) -> Result<StateWord, ModuleError> {
        let node = self.needed(ControlRole::State, "StateCur")?;
        let word = self.word(node, "StateCur").await?;
        Ok(match State::of_bit(word) {
            Some(state) => StateWord::Known(state),
            None => StateWord::Unknown(word),
        })
    }

    /// Requests automatic mode and the external source, and waits for both.
    pub(super) async fn mode(&self) -> Result<(), ModuleError> {
        if let Some(node) = self.node(ControlRole::OperationMode) {
            return self.mode_word(node).await;
        }
        self.request(
            self.node(ControlRole::AutomaticActive),
            [
                self.node(ControlRole::AutomaticByOperator),
                self.node(ControlRole::AutomaticByAutomation),
            ],
            "automatic mode (StateAutAct)",
        )
        .await?;
        self.request(
            self.node(ControlRole::ExternalActive),
            [
                self.node(ControlRole::ExternalByOperator),
                self.node(ControlRole::ExternalByAutomation),
            ],
            "the external source (SrcExtAct)",
        )
        .await
    }

    /// Requests the mode by the word of early drafts, which confirms automatic mode only.
    async fn mode_word(&self, node: &OpcUaNode) -> Result<(), ModuleError> {
        let word = self.word(node, "OpMode").await?;
        if word & OP_MODE_AUTOMATIC_ACTIVE == 0 {
            self.write(node, SkillValue::UInt32(OP_MODE_AUTOMATIC), "OpMode")
                .await?;
            let is_active = |value: &SkillValue| as_word(value) & OP_MODE_AUTOMATIC_ACTIVE != 0;
            self.wait(node, is_active, "automatic mode (OpMode)")
                .await?;
        }
        self.write(node, SkillValue::UInt32(OP_MODE_EXTERNAL), "OpMode")
            .await
    }

    /// Requests a mode or source that is not active, and waits for it. A service without the nodes
    /// has no such modes.
    async fn request(
        &self,
        active: Option<&OpcUaNode>,
        requests: [Option<&OpcUaNode>; 2],
        what: &str,
    ) -> Result<(), ModuleError> {
        let Some(active) = active else { return Ok(()) };
        if self.is_true(active).await? {
            return Ok(());
        }
        // A request that cannot be written from outside belongs to the automation of the module.
        let mut requests = requests.into_iter().flatten();
        let Some(request) = requests.find(|node| node.access.writes) else {
            let what = what.to_owned();
            return Err(ModuleError::NoRequest { what });
        };
        self.write(request, SkillValue::Boolean(true), what).await?;
        let is_active = |value: &SkillValue| *value == SkillValue::Boolean(true);
        self.wait(active, is_active, what).await
    }

    /// Selects a procedure, and waits until the service has accepted the selection.
    pub(super) async fn select(&self, procedure: &Procedure) -> Result<(), ModuleError> {
        let Some(node) = self.node(ControlRole::ProcedureWanted) else {
            let is_only = self.service.procedures.len() == 1;
            return match is_only {
                true => Ok(()),
                false => Err(ModuleError::NoSelection),
            };
        };
        let number = procedure.number;
        self.write(node, SkillValue::UInt32(number), "ProcedureExt")
            .await?;
        let accepted = self.node(ControlRole::ProcedureRequested).unwrap_or(node);
        let is_accepted = |value: &SkillValue| as_word(value) == number;
        let what = format!("procedure {number} (ProcedureReq)");
        self.wait(accepted, is_accepted, &what).await
    }

    /// Writes a parameter within its limits, and waits until the module has taken the value.
    pub(super) async fn parameter(
        &self,
        parameter: &ServiceParameter,
        value: &SkillValue,
    ) -> Result<(), ModuleError> {
        let name = &parameter.name;
        let Some(node) = &parameter.write else {
            let parameter = name.clone();
            return Err(ModuleError::NotWritable { parameter });
        };
        self.limits(parameter, value).await?;
        self.external(parameter).await?;
        self.write(node, value.clone(), &format!("{name}.VExt"))
            .await?;
        let is_written = |read: &SkillValue| is_equal(value, read);
        self.wait(node, is_written, &format!("the value of {name} (VExt)"))
            .await?;
        let Some(apply) = shaken(parameter, "ApplyExt") else {
            return Ok(());
        };
        if let Some(enabled) = shaken(parameter, "ApplyEn") {
            let is_enabled = |read: &SkillValue| *read == SkillValue::Boolean(true);
            self.wait(enabled, is_enabled, &format!("ApplyEn of {name}"))
                .await?;
        }
        self.write(
            apply,
            SkillValue::Boolean(true),
            &format!("{name}.ApplyExt"),
        )
        .await?;
        match shaken(parameter, "VReq") {
            Some(requested) => {
                let what = format!("the applied value of {name} (VReq)");
                self.wait(requested, is_written, &what).await
            }
            None => Ok(()),
        }
    }

    /// Makes the value from outside effective: a parameter follows its service (Sync), or has its
    /// own mode and source.
    async fn external(&self, parameter: &ServiceParameter) -> Result<(), ModuleError> {
        let name = &parameter.name;
        let of = |wanted| shaken(parameter, wanted);
        let sync = of("Sync");
        if let Some(sync) = sync
            && self.is_true(sync).await?
        {
            return Ok(());
        }
        let (mode, source) = (of("StateAutAct"), of("SrcExtAct"));
        if let Some(sync) = sync
            && mode.or(source).is_none()
            && sync.access.writes
        {
            let what = format!("{name}.Sync");
            self.write(sync, SkillValue::Boolean(true), &what).await?;
            let is_set = |read: &SkillValue| *read == SkillValue::Boolean(true);
            return self.wait(sync, is_set, &what).await;
        }
        let what = format!("automatic mode of {name}");
        self.request(mode, [of("StateAutOp"), of("StateAutAut")], &what)
            .await?;
        let what = format!("the external source of {name}");
        self.request(source, [of("SrcExtOp"), of("SrcExtAut")], &what)
            .await
    }

    /// Checks the limits that the file or the module has.
    async fn limits(
        &self,
        parameter: &ServiceParameter,
        value: &SkillValue,
    ) -> Result<(), ModuleError> {
        let Some(number) = value.as_f64() else {
            return Ok(());
        };
        let mut limits = [None, None];
        for (limit, bound) in limits.iter_mut().zip([&parameter.min, &parameter.max]) {
            *limit = match bound {
                Some(ValueBound::Constant(limit)) => Some(*limit),
                Some(ValueBound::Node(node)) => {
                    let read = self.nodes.read(&[node]).await?;
                    read.into_iter()
                        .next()
                        .flatten()
                        .and_then(|one| one.as_f64())
                }
                None => None,
            };
        }
        let [low, high] = limits;
        // Modules without limits have zero in both nodes.
        if low.is_some() && low == high {
            return Ok(());
        }
        if low.is_some_and(|low| number < low) || high.is_some_and(|high| number > high) {
            return Err(ModuleError::OutOfRange {
                parameter: parameter.name.clone(),
                low,
                high,
                given: number,
            });
        }
        Ok(())
    }

    /// Returns whether the service allows a command; true if it does not say so.
    pub(super) async fn allows(&self, command: Command) -> Result<bool, ModuleError> {
        match self.node(ControlRole::CommandEnabled) {
            Some(node) => Ok(self.word(node, "CommandEn").await? & command.bit() != 0),
            None => Ok(true),
        }
    }

    /// Waits until the service allows a command.
    pub(super) async fn allowed(&self, command: Command) -> Result<(), ModuleError> {
        let Some(node) = self.node(ControlRole::CommandEnabled) else {
            return Ok(());
        };
        let is_allowed = |value: &SkillValue| as_word(value) & command.bit() != 0;
        self.wait(node, is_allowed, &format!("{command} in CommandEn"))
            .await
    }

    /// Writes a command. A command that the service left in place is removed before.
    pub(super) async fn command(&self, command: Command) -> Result<(), ModuleError> {
        let node = self.needed(ControlRole::Command, "CommandExt")?;
        if self.word(node, "CommandExt").await? != 0 {
            self.write(node, SkillValue::UInt32(0), "CommandExt")
                .await?;
        }
        self.write(node, SkillValue::UInt32(command.bit()), "CommandExt")
            .await
    }

    /// Removes a command that the service did not remove, so that it has no effect later.
    pub(super) async fn withdraw(&self) -> Result<(), ModuleError> {
        let node = self.needed(ControlRole::Command, "CommandExt")?;
        if self.word(node, "CommandExt").await? != 0 {
            self.write(node, SkillValue::UInt32(0), "CommandExt")
                .await?;
        }
        Ok(())
    }

    /// Waits until the state fulfils a condition. Returns the state.
    pub(super) async fn until(
        &self,
        is: impl Fn(StateWord) -> bool,
        (what, within): (&'static str, Duration),
    ) -> Result<StateWord, ModuleError> {
        let end = Instant::now() + within;
        loop {
            let state = self.state().await;
            match state {
                Ok(state) if is(state) => return Ok(state),
                _ if Instant::now() < end => sleep(self.timing.poll).await,
                Ok(state) => {
                    return Err(ModuleError::NotReached {
                        what,
                        state,
                        within,
                    });
                }
                Err(why) => {
                    let why = Box::new(why);
                    return Err(ModuleError::NoState { what, why });
                }
            }
        }
    }

    async fn wait(
        &self,
        node: &OpcUaNode,
        is: impl Fn(&SkillValue) -> bool,
        what: &str,
    ) -> Result<(), ModuleError> {
        let within = self.timing.handshake;
        let end = Instant::now() + within;
        loop {
            let read = self.nodes.read(&[node]).await?;
            let value = read.into_iter().next().flatten();
            if value.as_ref().is_some_and(&is) {
                return Ok(());
            }
            if Instant::now() >= end {
                return Err(ModuleError::NotConfirmed {
                    what: what.to_owned(),
                    within,
                    node: node.id(),
                    value,
                });
            }
            sleep(self.timing.poll).await;
        }
    }

    async fn write(
        &self,
        node: &OpcUaNode,
        value: SkillValue,
        what: &str,
    ) -> Result<(), ModuleError> {
        let written = self.nodes.write(node, value).await;
        written.map_err(|error| ModuleError::Write {
            what: what.to_owned(),
            node: node.id(),
            error,
        })
    }

    async fn word(&self, node: &OpcUaNode, what: &str) -> Result<u32, ModuleError> {
        let read = self.nodes.read(&[node]).await?;
        let value = read.into_iter().next().flatten();
        let value = value.ok_or_else(|| ModuleError::NoValue {
            what: what.to_owned(),
            node: node.id(),
        })?;
        Ok(as_word(&value))
    }

    async fn is_true(&self, node: &OpcUaNode) -> Result<bool, ModuleError> {
        let read = self.nodes.read(&[node]).await?;
        Ok(read.into_iter().next().flatten() == Some(SkillValue::Boolean(true)))
    }

    fn node(&self, role: ControlRole) -> Option<&OpcUaNode> {
        self.service.control.node(role)
    }

    pub(super) fn needed(
        &self,
        role: ControlRole,
        name: &'static str,
    ) -> Result<&OpcUaNode, ModuleError> {
        let node = self.node(role);
        node.ok_or_else(|| ModuleError::NoNode {
            node: name,
            service: self.service.name.clone(),
        })
    }
}

/// Returns the word in an integer of any type; 0 for other values.
fn as_word(value: &SkillValue) -> u32 {
    if matches!(
        value,
        SkillValue::Boolean(_) | SkillValue::String(_) | SkillValue::Array(..)
    ) {
        return 0;
    }
    let number = value.to_json().as_i64();
    number
        .and_then(|number| u32::try_from(number).ok())
        .unwrap_or_default()
}

/// Returns the node of a parameter with a name of the handshake.
fn shaken<'p>(parameter: &'p ServiceParameter, wanted: &str) -> Option<&'p OpcUaNode> {
    let mut nodes = parameter.handshake.iter();
    let found = nodes.find(|(known, _)| known == wanted);
    found.map(|(_, node)| node)
}
