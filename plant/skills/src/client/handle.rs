//! Handle of a skill of another component.

use std::time::Duration;

use async_trait::async_trait;
use plant_opcua::client::{
    Browse, CallError, ClientError, Link, MonitoredWatch, Notice, OpcUaClient,
};
use plant_opcua::types::{DataValue, NodeId, QualifiedName, StatusCode, UAString, Variant};
use program::{ProgramMachineState, ProgramMethod};

use super::found::{FoundParameter, FoundSkill, texts};
use super::{called, lost, refused};
use crate::grip::GripPoint;
use crate::model::{DEVICES, POWER_OFF};
use crate::refusal::RefusalCode;
use crate::runs::{HALTS_WITHIN, RunnableSkill, goes_on};
use crate::shown::{RunOutcome, UNKNOWN_OUTCOME};
use crate::skill_fault::SkillFault;
use crate::value::SkillValue;
use crate::variant::{from_pairs, from_variant, to_pairs, to_variant};

/// A skill of another component that can be run. Clones share the connection.
#[derive(Clone)]
pub struct SkillHandle {
    client: OpcUaClient,
    found: FoundSkill,
}

/// The current state of a skill of another component.
#[derive(Debug, Clone, PartialEq)]
pub struct RemoteState {
    /// The state of its state machine.
    pub state: ProgramMachineState,
    /// The number of the newest run; 0 before the first run, or if the skill does not number its
    /// runs.
    pub run: u32,
    /// The progress of that run, 0 to 1.
    pub progress: f32,
    /// The current step of that run.
    pub step: String,
}

impl SkillHandle {
    pub(super) fn new(client: OpcUaClient, found: FoundSkill) -> Self {
        Self { client, found }
    }

    /// Returns the description of the skill.
    #[must_use]
    pub fn found(&self) -> &FoundSkill {
        &self.found
    }

    /// Reads the current state.
    ///
    /// # Errors
    /// No response, or the object is not a Program.
    pub async fn state(&self) -> Result<RemoteState, SkillFault> {
        Ok(self.seen().await?.0)
    }

    /// Reads the current state and the time at which it was entered, by the clock of the server.
    pub(super) async fn seen(&self) -> Result<(RemoteState, Option<i64>), SkillFault> {
        let [id, name, kind] = STATE_PATHS;
        let paths = [id, name, kind, "RunId", "Progress", "SkillStep"];
        let [id, name, kind, run, progress, step] = self.read_all(paths).await?;
        let state = [&id, &name, &kind].into_iter().find_map(|value| {
            let said = value.value.as_ref()?;
            Some((state_in(said)?, value.source_timestamp.map(|at| at.ticks())))
        });
        let (state, since) = state.ok_or_else(|| match id.status() {
            // A station between the client and the component has lost the component.
            status @ (StatusCode::BadNoCommunication | StatusCode::BadNodeIdUnknown) => {
                SkillFault::Lost(format!("{}: {status}", self.name()))
            }
            _ => self.unexpected("its state is none of a Program"),
        })?;
        let state = RemoteState {
            state,
            run: run.value.as_ref().map_or(0, number),
            progress: match progress.value {
                Some(Variant::Float(progress)) => progress,
                _ => 0.0,
            },
            step: step.value.as_ref().map(text).unwrap_or_default(),
        };
        Ok((state, since))
    }

    /// Returns whether the skill numbers its runs.
    pub(super) fn numbers_runs(&self) -> bool {
        self.found.nodes.get("RunId").is_some()
    }

    /// Reads the number of the newest run; 0 if there is no run or no response.
    pub(super) async fn run_id(&self) -> u32 {
        match self.read(["RunId"]).await {
            Ok([run]) => run.as_ref().map_or(0, number),
            Err(_) => 0,
        }
    }

    /// Reads the current values of the parameters; empty if there is no response.
    pub(super) async fn parameters(&self) -> Vec<(String, SkillValue)> {
        let declared = &self.found.parameters;
        let ids: Vec<NodeId> = declared.iter().map(|of| of.id.clone()).collect();
        let values = self.client.read(&ids).await.unwrap_or_default();
        let shown = declared.iter().zip(values);
        let shown = shown
            .filter_map(|(of, value)| Some((of.name.clone(), of.shown(value.value.as_ref()?)?)));
        shown.collect()
    }

    /// Locks the component until the session closes (OPC 10000-100, 7). Returns whether the
    /// component supports locking; otherwise the first call acquires the lease.
    ///
    /// # Errors
    /// BadLocked if another owner holds the lease, or no response.
    pub async fn lock(&self, what_for: &str) -> Result<bool, SkillFault> {
        let Some((object, method)) = self.of_lock("InitLock").await? else {
            return Ok(false);
        };
        let context = Variant::String(UAString::from(what_for));
        let answer = self.client.call(&object, &method, vec![context]).await;
        let what = format!("{} is somebody else's", self.found.component);
        match answer.as_deref() {
            Ok([Variant::Int32(0), ..]) => Ok(true),
            Ok(_) => Err(refused(StatusCode::BadLocked, &what)),
            Err(error) => Err(called(
                error,
                &format!("InitLock of {}", self.found.component),
            )),
        }
    }

    /// Returns the lock of the component, and one of its methods; `None` if it has none.
    ///
    /// # Errors
    /// No response.
    async fn of_lock(&self, method: &str) -> Result<Option<(NodeId, NodeId)>, SkillFault> {
        let Some(index) = self.client.namespace(DEVICES) else {
            return Ok(None);
        };
        let name = |name: &str| QualifiedName::new(index, name);
        let component = &self.found.nodes.component;
        let path = [name("Lock")];
        let below = [name("Lock"), name(method)];
        let mut nodes = Vec::new();
        for path in [&path[..], &below] {
            match self.client.translate(component, path).await {
                Ok(node) => nodes.push(node),
                Err(ClientError::Status(StatusCode::BadNoMatch)) => return Ok(None),
                Err(error) => return Err(lost(&error)),
            }
        }
        let mut nodes = nodes.into_iter();
        Ok(nodes.next().zip(nodes.next()))
    }

    /// Switches the component off after a delay (`PowerOffDevice`). Returns whether the component
    /// has this method.
    ///
    /// # Errors
    /// A refusal, or no response.
    pub async fn power_off(&self, delay: Duration) -> Result<bool, SkillFault> {
        let component = &self.found.nodes.component;
        let below = self.client.browse(component, Browse::hierarchical()).await;
        let below = below.map_err(|error| lost(&error))?;
        let mut below = below.into_iter();
        let method = below.find(|child| child.browse_name.name.as_ref() == POWER_OFF);
        let Some(method) = method.map(|child| child.node_id.node_id) else {
            return Ok(false);
        };
        let delay = u32::try_from(delay.as_millis()).unwrap_or(u32::MAX);
        let arguments = vec![Variant::UInt32(delay)];
        let answer = self.client.call(component, &method, arguments).await;
        let what = format!("{POWER_OFF} of {}", self.found.component);
        answer.map(|_| true).map_err(|error| called(&error, &what))
    }

    /// Calls a method.
    ///
    /// # Errors
    /// A refusal, or no response.
    pub async fn call(&self, method: ProgramMethod) -> Result<(), SkillFault> {
        let node = self.found.nodes.get(method.name());
        let node = node.ok_or_else(|| self.unexpected(&format!("it has no {method}")))?;
        let call = self
            .client
            .call(&self.found.nodes.skill, node, Vec::new())
            .await;
        match call {
            Ok(_) => Ok(()),
            Err(error) => Err(called(&error, &format!("{method} of {}", self.name()))),
        }
    }

    /// Writes parameters and starts a run. Returns the number of the run; 0 if the skill does not
    /// number its runs or the number cannot be read. Parameters that are not given keep their
    /// values.
    ///
    /// # Errors
    /// A refusal, or no response. After [`SkillFault::Lost`] it is unknown whether the run has
    /// started.
    pub async fn start(&self, parameters: Vec<(String, SkillValue)>) -> Result<u32, SkillFault> {
        self.write(parameters).await?;
        self.call(ProgramMethod::Start).await?;
        // The run has started: an error of this read must not hide it.
        Ok(self.run_id().await)
    }

    /// Starts a run in one call; a Halted skill is reset first. Uses Execute if the skill has it,
    /// otherwise Reset, writes and Start. Returns the number of the run, 0 if the skill does not
    /// number its runs.
    ///
    /// # Errors
    /// A refusal, or no response. After [`SkillFault::Lost`] it is unknown whether the run has
    /// started.
    pub async fn execute(
        &self,
        parameters: Vec<(String, SkillValue)>,
        within: Option<Duration>,
    ) -> Result<u32, SkillFault> {
        let Some(node) = self.found.nodes.get("Execute") else {
            return self.step_by_step(parameters).await;
        };
        let parameters = parameters
            .into_iter()
            .map(|(name, value)| Ok((name.clone(), self.taken(&name, value)?.1)))
            .collect::<Result<Vec<_>, SkillFault>>()?;
        let [names, values] = to_pairs(&parameters);
        let timeout = within.map_or(0.0, |within| within.as_secs_f64() * 1_000.0);
        let arguments = vec![names, values, timeout.into()];
        let skill = &self.found.nodes.skill;
        match self.client.call(skill, node, arguments).await {
            Ok(outputs) => Ok(outputs.first().map_or(0, number)),
            Err(error) => Err(called(&error, &format!("Execute of {}", self.name()))),
        }
    }

    async fn step_by_step(&self, parameters: Vec<(String, SkillValue)>) -> Result<u32, SkillFault> {
        if self.state().await?.state == ProgramMachineState::Halted {
            self.refuse_unknown().await?;
            let reset = self.call(ProgramMethod::Reset).await;
            // The Reset of a caller that gave up earlier may have taken effect first.
            if reset.is_err() && self.state().await?.state != ProgramMachineState::Ready {
                reset?;
            }
        }
        self.start(parameters).await
    }

    /// Refuses to reset a skill whose newest run may go on.
    async fn refuse_unknown(&self) -> Result<(), SkillFault> {
        let outcome = self.outcome(0, ProgramMachineState::Halted).await?;
        match outcome.unknown {
            false => Ok(()),
            true => Err(SkillFault::Refused {
                status: RefusalCode::InvalidState.name().to_owned(),
                text: format!("{UNKNOWN_OUTCOME}; Reset makes the skill ready"),
            }),
        }
    }

    /// Returns the outcome of a run of any client; `None` while the run is in progress. Run 0 is
    /// the newest run.
    ///
    /// # Errors
    /// BadNotFound for an unknown run, no response, or a skill without ReadOutcome.
    pub async fn outcome_of(&self, run: u32) -> Result<Option<RunOutcome>, SkillFault> {
        let node = self.found.nodes.get("ReadOutcome");
        let node = node.ok_or_else(|| self.unexpected("it has no ReadOutcome"))?;
        let outputs = self
            .client
            .call(&self.found.nodes.skill, node, vec![run.into()])
            .await
            .map_err(|error| match &error {
                // The station behind which the component is may reach it again.
                CallError::Refused { status, .. } if *status == StatusCode::BadNoCommunication => {
                    SkillFault::Lost(format!("{}: {status}", self.name()))
                }
                CallError::Refused { .. } | CallError::Client(_) => {
                    called(&error, &format!("ReadOutcome of {}", self.name()))
                }
            })?;
        // Older components do not return `Unknown`.
        let [ended, succeeded, message, names, values, trace, more @ ..] = outputs.as_slice()
        else {
            return Err(self.unexpected("its ReadOutcome says something else"));
        };
        if *ended != Variant::Boolean(true) {
            return Ok(None);
        }
        let results = from_pairs(names, values)
            .ok_or_else(|| self.unexpected("its results are none of a skill"))?;
        Ok(Some(RunOutcome {
            run,
            succeeded: *succeeded == Variant::Boolean(true),
            unknown: more.first() == Some(&Variant::Boolean(true)),
            message: text(message),
            results,
            trace: texts(from_variant(trace)),
        }))
    }

    /// Waits for the end of a run, which another session may have started. While the component is
    /// disconnected, it waits for the reconnection. A restarted component does not know runs from
    /// before the restart.
    ///
    /// # Errors
    /// As [`outcome_of`](Self::outcome_of), and [`SkillFault::TimedOut`]; the run is not stopped.
    pub async fn wait(&self, run: u32, within: Duration) -> Result<RunOutcome, SkillFault> {
        let ended = async {
            let mut look = tokio::time::interval(PUBLISHING);
            look.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
            loop {
                look.tick().await;
                match self.outcome_of(run).await {
                    Ok(Some(outcome)) => return Ok(outcome),
                    Ok(None) => {}
                    // The component may reconnect within the time limit.
                    Err(SkillFault::Lost(why)) => {
                        if self.client.up(within).await.is_err() {
                            return Err(SkillFault::Lost(why));
                        }
                    }
                    Err(fault) => return Err(fault),
                }
            }
        };
        match tokio::time::timeout(within, ended).await {
            Ok(ended) => ended,
            Err(_) => Err(SkillFault::TimedOut(within)),
        }
    }

    /// Returns the declared parameter of this name, and the value in its type.
    fn taken(
        &self,
        name: &str,
        value: SkillValue,
    ) -> Result<(&FoundParameter, SkillValue), SkillFault> {
        let wrong = |status: &str, text: String| SkillFault::Refused {
            status: status.to_owned(),
            text,
        };
        let declared = self.found.parameters.iter().find(|of| of.name == name);
        let declared = declared.ok_or_else(|| {
            let text = format!("{} has no parameter {name}", self.name());
            wrong("BadInvalidArgument", text)
        })?;
        let given = value.shape();
        let value = declared.shape.take(value).ok_or_else(|| {
            let text = format!("{name} is {}, and {given} was given", declared.shape);
            wrong("BadTypeMismatch", text)
        })?;
        Ok((declared, value))
    }

    async fn write(&self, parameters: Vec<(String, SkillValue)>) -> Result<(), SkillFault> {
        let mut writes = Vec::new();
        let mut names = Vec::new();
        for (name, value) in parameters {
            let (declared, value) = self.taken(&name, value)?;
            let said = match declared.packed {
                None => to_variant(&value),
                Some(packed) => packed.pack(&value).map_err(|why| SkillFault::Refused {
                    status: "BadInvalidArgument".to_owned(),
                    text: format!("{name}: {why}"),
                })?,
            };
            writes.push((declared.id.clone(), said));
            names.push(name);
        }
        if writes.is_empty() {
            return Ok(());
        }
        let written = self
            .client
            .write(&writes)
            .await
            .map_err(|error| lost(&error))?;
        match names
            .iter()
            .zip(written)
            .find(|(_, status)| status.is_bad())
        {
            Some((name, status)) => Err(refused(status, &format!("{name} of {}", self.name()))),
            None => Ok(()),
        }
    }

    /// Waits until the skill is neither Running nor Suspended.
    async fn ended(&self) -> Result<ProgramMachineState, SkillFault> {
        let node = self
            .found
            .nodes
            .get("CurrentState/Id")
            .ok_or_else(|| self.unexpected("it has no state"))?;
        let mut watch =
            self.client
                .subscribe(vec![MonitoredWatch::Value(node.clone())], PUBLISHING, QUEUE);
        let mut look = tokio::time::interval(LOOK);
        let mut gone = RunnableSkill::lost(self);
        loop {
            let state = tokio::select! {
                _ = look.tick() => self.state().await?.state,
                notice = watch.next() => match notice {
                    Some(Notice::Value { value, .. }) => match value.value.as_ref().and_then(state_in) {
                        Some(state) => state,
                        None => continue,
                    },
                    Some(_) => continue,
                    None => return Err(SkillFault::Lost("the connection is closed".to_owned())),
                },
                why = &mut gone => return Err(SkillFault::Lost(why)),
            };
            if matches!(
                state,
                ProgramMachineState::Ready | ProgramMachineState::Halted
            ) {
                // A notification may be older than the run.
                let now = self.state().await?.state;
                if matches!(
                    now,
                    ProgramMachineState::Ready | ProgramMachineState::Halted
                ) {
                    return Ok(now);
                }
            }
        }
    }

    /// Returns whether the component has to be asked for the ends of runs: the values that a
    /// station repeats may be older than the run.
    fn asks_component(&self) -> bool {
        self.found.behind.is_some() && self.found.nodes.get("ReadOutcome").is_some()
    }

    /// Waits for the end of a run that this client has started.
    async fn end_of(&self, run: u32) -> Result<RunOutcome, SkillFault> {
        loop {
            let state = self.ended().await?;
            if !self.asks_component() || (run == 0 && !self.numbers_runs()) {
                return self.outcome(run, state).await;
            }
            if let Some(outcome) = self.outcome_of(run).await? {
                return Ok(outcome);
            }
            tokio::time::sleep(PUBLISHING).await;
        }
    }

    /// Waits until no run is in progress.
    async fn over(&self) -> Result<(), SkillFault> {
        loop {
            if !self.asks_component() {
                let state = self.state().await?.state;
                if !matches!(
                    state,
                    ProgramMachineState::Ready | ProgramMachineState::Halted
                ) {
                    self.ended().await?;
                }
                return Ok(());
            }
            if self.has_no_run().await? {
                return Ok(());
            }
            tokio::time::sleep(PUBLISHING).await;
        }
    }

    /// Asks the component whether no run is in progress.
    async fn has_no_run(&self) -> Result<bool, SkillFault> {
        match self.outcome_of(0).await {
            Ok(outcome) => Ok(outcome.is_some()),
            Err(SkillFault::Refused { status, .. }) => {
                // There was no run.
                match status == StatusCode::BadNotFound.to_string() {
                    true => Ok(true),
                    false => Err(goes_on(&self.name())),
                }
            }
            Err(fault) => Err(fault),
        }
    }

    pub(super) async fn outcome(
        &self,
        run: u32,
        state: ProgramMachineState,
    ) -> Result<RunOutcome, SkillFault> {
        let paths = [
            "FinalResultData/Succeeded",
            "FinalResultData/Message",
            "FinalResultData/Run",
            "FinalResultData/Trace",
            "FinalResultData/Unknown",
            "FinalResultData/Status",
        ];
        let [succeeded, message, of, trace, unknown, status] = self.read(paths).await?;
        if of.as_ref().is_some_and(|of| run != 0 && number(of) != run) {
            return Err(self.unexpected(&format!("its outcome is of another run than {run}")));
        }
        let ids: Vec<NodeId> = self
            .found
            .results
            .iter()
            .map(|result| result.id.clone())
            .collect();
        let values = self.client.read(&ids).await.map_err(|error| lost(&error))?;
        let succeeded = match succeeded {
            Some(Variant::Boolean(succeeded)) => succeeded,
            // Without a value, the run counts as failed if the skill needs a Reset.
            _ => state == ProgramMachineState::Ready,
        };
        let unknown = match unknown {
            Some(Variant::Boolean(unknown)) => unknown,
            // Actions of ROS have the status of their goal: STATUS_UNKNOWN of action_msgs is 0.
            _ => {
                let is_goal = self.found.nodes.get("FinalResultData/GoalId").is_some();
                is_goal && !succeeded && status == Some(Variant::Int32(0))
            }
        };
        let results = self.found.results.iter().zip(values);
        let results = results.filter_map(|(result, value)| {
            Some((result.name.clone(), result.shown(value.value.as_ref()?)?))
        });
        Ok(RunOutcome {
            run,
            succeeded,
            unknown,
            message: message.as_ref().map(text).unwrap_or_default(),
            results: if succeeded {
                results.collect()
            } else {
                Vec::new()
            },
            trace: texts(trace.as_ref().and_then(from_variant)),
        })
    }

    /// Reads the values of variables; `None` for variables that do not exist.
    async fn read<const N: usize>(
        &self,
        paths: [&str; N],
    ) -> Result<[Option<Variant>; N], SkillFault> {
        Ok(self.read_all(paths).await?.map(|value| value.value))
    }

    /// Reads the values of variables with their timestamps; empty for variables that do not exist.
    async fn read_all<const N: usize>(
        &self,
        paths: [&str; N],
    ) -> Result<[DataValue; N], SkillFault> {
        let nodes: Vec<(usize, NodeId)> = paths
            .iter()
            .enumerate()
            .filter_map(|(at, path)| Some((at, self.found.nodes.get(path)?.clone())))
            .collect();
        let ids: Vec<NodeId> = nodes.iter().map(|(_, node)| node.clone()).collect();
        let values = self.client.read(&ids).await.map_err(|error| lost(&error))?;
        let mut all = [const { None }; N];
        for ((at, _), value) in nodes.into_iter().zip(values) {
            if let Some(slot) = all.get_mut(at) {
                *slot = Some(value);
            }
        }
        Ok(all.map(Option::unwrap_or_default))
    }

    fn unexpected(&self, what: &str) -> SkillFault {
        SkillFault::Unexpected(format!("{}: {what}", self.name()))
    }
}

#[async_trait]
impl RunnableSkill for SkillHandle {
    fn grip_point(&self) -> Option<GripPoint> {
        self.found.grip_point
    }

    fn name(&self) -> String {
        format!("{}.{}", self.found.component, self.found.name)
    }

    async fn run(
        &self,
        parameters: Vec<(String, SkillValue)>,
        within: Duration,
    ) -> Result<RunOutcome, SkillFault> {
        let run = self.execute(parameters, None).await?;
        let ended = tokio::time::timeout(within, self.end_of(run)).await;
        let Ok(ended) = ended else {
            self.halt().await?;
            let outcome = match self.asks_component() && run != 0 {
                true => self.outcome_of(run).await.ok().flatten(),
                false => self.outcome(run, ProgramMachineState::Halted).await.ok(),
            };
            return match outcome {
                Some(outcome) if outcome.unknown => Err(SkillFault::NotHalted(outcome.message)),
                Some(_) | None => Err(SkillFault::TimedOut(within)),
            };
        };
        ended
    }

    async fn halt(&self) -> Result<(), SkillFault> {
        let Some(node) = self.found.nodes.get(ProgramMethod::Halt.name()) else {
            return Err(self.unexpected("it has no Halt"));
        };
        let halted = self
            .client
            .call(&self.found.nodes.skill, node, Vec::new())
            .await;
        let Err(error) = halted else {
            // The work of the skill may not have ended.
            let over = tokio::time::timeout(HALTS_WITHIN, self.over()).await;
            return over.unwrap_or_else(|_| Err(goes_on(&self.name())));
        };
        // The skill may be Halted already, which is the wanted state.
        match &error {
            // The state that a station repeats may be older than the run.
            CallError::Refused { .. } if self.asks_component() => match self.has_no_run().await {
                Ok(true) => Ok(()),
                Ok(false) | Err(_) => Err(called(&error, &format!("Halt of {}", self.name()))),
            },
            CallError::Refused { .. }
                if self.state().await?.state == ProgramMachineState::Halted =>
            {
                Ok(())
            }
            CallError::Client(ClientError::Lost(_))
            | CallError::Client(_)
            | CallError::Refused { .. } => Err(called(&error, &format!("Halt of {}", self.name()))),
        }
    }

    async fn release(&self) -> Result<(), SkillFault> {
        // ExitLock ends the lease of a lock, and not that of a call.
        if !self.lock("").await? {
            return Ok(());
        }
        let Some((object, method)) = self.of_lock("ExitLock").await? else {
            return Ok(());
        };
        let answer = self.client.call(&object, &method, Vec::new()).await;
        let what = format!("ExitLock of {}", self.found.component);
        match answer.as_deref() {
            Ok([Variant::Int32(0), ..]) => Ok(()),
            Ok(_) => Err(refused(StatusCode::BadLocked, &what)),
            Err(error) => Err(called(error, &what)),
        }
    }

    async fn lost(&self) -> String {
        let mut link = self.client.link();
        let down = link
            .wait_for(|link| matches!(link, Link::Down { .. } | Link::Closed))
            .await;
        why(down.as_deref().ok())
    }
}

fn why(link: Option<&Link>) -> String {
    match link {
        Some(Link::Down { reason, .. }) => reason.clone(),
        _ => "the connection is closed".to_owned(),
    }
}

/// Returns the state that a variable holds: as a NodeId of namespace 0, as a name or as a number.
pub(super) fn state_in(said: &Variant) -> Option<ProgramMachineState> {
    let mut all = ProgramMachineState::ALL.into_iter();
    if let Variant::NodeId(id) = said {
        let id = (id.namespace == 0).then(|| id.as_u32())??;
        return all.find(|state| state.node_id() == id);
    }
    if matches!(said, Variant::LocalizedText(_) | Variant::String(_)) {
        let said = text(said);
        return all.find(|state| state.name() == said);
    }
    let number = from_variant(said)?.as_f64()?;
    all.find(|state| f64::from(state.number()) == number)
}

fn number(value: &Variant) -> u32 {
    match from_variant(value) {
        Some(SkillValue::UInt32(number)) => number,
        _ => 0,
    }
}

fn text(value: &Variant) -> String {
    if let Variant::LocalizedText(text) = value {
        return text.text.as_ref().to_owned();
    }
    let value = from_variant(value);
    value
        .as_ref()
        .and_then(SkillValue::as_str)
        .unwrap_or_default()
        .to_owned()
}

/// The variables that hold the state of a skill, in order of preference.
pub(super) const STATE_PATHS: [&str; 3] =
    ["CurrentState/Id", "CurrentState", "CurrentState/Number"];
/// Publishing interval of the subscription.
const PUBLISHING: Duration = Duration::from_millis(20);
/// Interval in which the state is polled, in case the server does not notify changes.
const LOOK: Duration = Duration::from_millis(500);
const QUEUE: usize = 16;
