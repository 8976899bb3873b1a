//! The values of the nodes of a skill and its events, for clients.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::SystemTime;

use plant_opcua::server::{Instance, OpcUaServer, StateRef, TransitionEvent};
use plant_opcua::types::{
    DataValue, DateTime, ExtensionObject, LocalizedText, NodeId, ProgramDiagnostic2DataType,
    QualifiedName, StatusCode, UAString, Variant,
};
use program::{ProgramMachineState, ProgramMethod, Transition};

use crate::description::SkillDescription;
use crate::model::{EVENT_TYPE, NAMESPACE};
use crate::parameters::{Parameters, SkillParameter};
use crate::shown::{RunOutcome, SkillEvent, SkillObserver, SkillSnapshot, Transitioned};
use crate::value::{Builtin, SkillValue};
use crate::variant::to_variant;

/// The nodes of a skill.
#[derive(Debug)]
pub(super) struct SkillNodes {
    name: String,
    instance: Instance,
    parameters: BTreeMap<String, NodeId>,
    results: BTreeMap<String, NodeId>,
    event_type: Option<NodeId>,
    /// The index of the namespace of the skill types.
    types: u16,
}

impl SkillNodes {
    pub(super) fn new(server: &OpcUaServer, instance: Instance, facts: &SkillDescription) -> Self {
        let among = |group: &str, of: &[SkillParameter]| {
            let named = |parameter: &SkillParameter| {
                let node = instance.node(&format!("{group}/{}", parameter.name))?;
                Some((parameter.name.clone(), node.clone()))
            };
            of.iter().filter_map(named).collect()
        };
        Self {
            name: facts.name.clone(),
            parameters: among("ParameterSet", &facts.parameters),
            results: among("FinalResultData", &facts.results),
            event_type: server.find_type(NAMESPACE, EVENT_TYPE),
            types: server.namespace(NAMESPACE).unwrap_or_default(),
            instance,
        }
    }

    pub(super) fn skill(&self) -> &NodeId {
        &self.instance.node_id
    }

    pub(super) fn parameters(&self) -> impl Iterator<Item = (&str, &NodeId)> {
        self.parameters
            .iter()
            .map(|(name, node)| (name.as_str(), node))
    }

    pub(super) fn method(&self, method: ProgramMethod) -> Option<&NodeId> {
        self.named(method.name())
    }

    /// Returns the node of a member of the type.
    pub(super) fn named(&self, name: &str) -> Option<&NodeId> {
        self.instance.node(name)
    }

    /// Shows the constant values of the skill and its initial state.
    pub(super) fn show_at_first(
        &self,
        server: &OpcUaServer,
        facts: &SkillDescription,
        uses: &[String],
    ) {
        let mut values = Values::new(self);
        values.add("Name", facts.name.as_str());
        values.add("Capabilities", texts(&facts.capabilities));
        values.add("UsesSkills", texts(uses));
        values.add("Deletable", false);
        values.add("AutoDelete", false);
        values.add("RecycleCount", 0_i32);
        values.state(ProgramMachineState::Halted);
        values.add("RunId", 0_u32);
        values.add("Progress", 0.0_f32);
        values.add("SkillStep", "");
        values.add("FinalResultData/Run", 0_u32);
        values.add("FinalResultData/Succeeded", false);
        values.add("FinalResultData/Message", "");
        values.add("FinalResultData/Trace", texts(&[]));
        values.add("FinalResultData/Unknown", false);
        values.show(server);
        self.show_defaults(server, facts);
        for method in ProgramMethod::ALL {
            self.executable(server, method, method == ProgramMethod::Reset);
        }
    }

    /// Shows the default parameters, for a client that has not written any.
    pub(super) fn show_defaults(&self, server: &OpcUaServer, facts: &SkillDescription) {
        let values = facts.parameters.iter().filter_map(|parameter| {
            let node = self.parameters.get(&parameter.name)?;
            let value = match &parameter.default {
                Some(value) => DataValue::new_now(to_variant(value)),
                // The parameter is mandatory and has no value.
                None => {
                    DataValue::new_now_status(Variant::Empty, StatusCode::BadWaitingForInitialData)
                }
            };
            Some((node.clone(), value))
        });
        show(server, &self.name, values.collect());
    }

    fn show_parameters(&self, server: &OpcUaServer, parameters: &Parameters) {
        show(
            server,
            &self.name,
            named(&self.parameters, parameters.all()),
        );
    }

    fn show_outcome(&self, server: &OpcUaServer, outcome: &RunOutcome) {
        let mut values = Values::new(self);
        values.add("FinalResultData/Run", outcome.run);
        values.add("FinalResultData/Succeeded", outcome.succeeded);
        values.add("FinalResultData/Message", outcome.message.as_str());
        values.add("FinalResultData/Trace", texts(&outcome.trace));
        values.add("FinalResultData/Unknown", outcome.unknown);
        values.values.extend(named(&self.results, &outcome.results));
        values.show(server);
    }

    fn show_transition(
        &self,
        server: &OpcUaServer,
        happened: &Transitioned,
        shown: &SkillSnapshot,
    ) {
        let Transitioned {
            transition,
            run,
            message,
            at,
        } = happened;
        let time = date_time(*at);
        let mut values = Values::new(self);
        values.state(transition.to);
        values.add("LastTransition", LocalizedText::new("en", transition.name));
        values.add("LastTransition/Id", NodeId::new(0, transition.node_id));
        values.add("LastTransition/Number", transition.number);
        values.add("LastTransition/TransitionTime", time);
        values.add("RunId", *run);
        values.add("Progress", shown.progress);
        values.add("SkillStep", shown.step.as_str());
        self.diagnostic(&mut values, shown);
        values.show(server);
        for (method, executable) in ProgramMethod::ALL.into_iter().zip(shown.executable) {
            self.executable(server, method, executable);
        }
        let Some(event_type) = &self.event_type else {
            return;
        };
        server.raise(&TransitionEvent {
            source: self.skill().clone(),
            source_name: self.name.clone(),
            event_type: event_type.clone(),
            message: message.clone(),
            severity: if transition.to == ProgramMachineState::Halted {
                FAILED
            } else {
                USUAL
            },
            from_state: state_ref(transition.from),
            to_state: state_ref(transition.to),
            transition: transition_ref(transition),
            intermediate_result: Variant::from(shown.step.as_str()),
            fields: vec![(QualifiedName::new(self.types, "RunId"), Variant::from(*run))],
            time,
        });
    }

    fn show_progress(&self, server: &OpcUaServer, shown: &SkillSnapshot) {
        let mut values = Values::new(self);
        values.add("Progress", shown.progress);
        values.add("SkillStep", shown.step.as_str());
        values.show(server);
    }

    /// Shows why a run that is being cancelled has not ended, and raises an event without a
    /// transition.
    fn show_pending(&self, server: &OpcUaServer, why: &str, shown: &SkillSnapshot) {
        self.show_progress(server, shown);
        let source = (self.skill().clone(), &*self.name);
        let state = state_ref(shown.state);
        server.raise(&TransitionEvent {
            intermediate_result: Variant::from(shown.step.as_str()),
            fields: vec![(
                QualifiedName::new(self.types, "RunId"),
                Variant::from(shown.run),
            )],
            ..TransitionEvent::without_transition(source, state, (why, FAILED))
        });
    }

    fn show_called(&self, server: &OpcUaServer, shown: &SkillSnapshot) {
        let mut values = Values::new(self);
        self.diagnostic(&mut values, shown);
        values.show(server);
    }

    /// Sets ProgramDiagnostic as a whole and its members (OPC 10000-10, 5.2.9).
    fn diagnostic(&self, values: &mut Values<'_>, shown: &SkillSnapshot) {
        let of = &shown.diagnostic;
        let created = date_time(of.created);
        let since = date_time(shown.since);
        let call = of.last_call.as_ref();
        let method = call.map_or("", |call| call.method.name());
        let by = call.map(|call| call.by.to_string()).unwrap_or_default();
        let at = call.map_or_else(DateTime::null, |call| date_time(call.at));
        let status = call
            .and_then(|call| call.refused.as_ref())
            .map_or(StatusCode::Good, super::status);
        values.add(
            "ProgramDiagnostic",
            ExtensionObject::from_message(ProgramDiagnostic2DataType {
                create_client_name: UAString::from(self.name.as_str()),
                invocation_creation_time: created,
                last_transition_time: since,
                last_method_call: UAString::from(method),
                last_method_session_id: NodeId::new(0, by.as_str()),
                last_method_call_time: at,
                last_method_return_status: status,
                ..ProgramDiagnostic2DataType::default()
            }),
        );
        values.add("ProgramDiagnostic/CreateClientName", self.name.as_str());
        values.add("ProgramDiagnostic/InvocationCreationTime", created);
        values.add("ProgramDiagnostic/LastTransitionTime", since);
        values.add("ProgramDiagnostic/LastMethodCall", method);
        values.add(
            "ProgramDiagnostic/LastMethodSessionId",
            NodeId::new(0, by.as_str()),
        );
        values.add("ProgramDiagnostic/LastMethodCallTime", at);
        values.add("ProgramDiagnostic/LastMethodReturnStatus", status);
    }

    fn executable(&self, server: &OpcUaServer, method: ProgramMethod, executable: bool) {
        if let Some(node) = self.method(method)
            && let Err(status) = server.set_executable(node, executable)
        {
            tracing::warn!(
                skill = self.name,
                "cannot show whether {method} is executable: {status}"
            );
        }
    }
}

/// An observer that shows the events of a skill.
pub(super) struct Shower {
    server: OpcUaServer,
    nodes: Arc<SkillNodes>,
}

impl Shower {
    pub(super) fn new(server: OpcUaServer, nodes: Arc<SkillNodes>) -> Self {
        Self { server, nodes }
    }
}

impl SkillObserver for Shower {
    fn told(&self, what: SkillEvent<'_>, shown: &SkillSnapshot) {
        let Self { server, nodes } = self;
        match what {
            SkillEvent::Parameters(parameters) => nodes.show_parameters(server, parameters),
            SkillEvent::Transition(happened) => nodes.show_transition(server, happened, shown),
            SkillEvent::Step | SkillEvent::Progress => nodes.show_progress(server, shown),
            SkillEvent::Pending(why) => nodes.show_pending(server, why, shown),
            SkillEvent::Outcome(outcome) => nodes.show_outcome(server, outcome),
            SkillEvent::Called => nodes.show_called(server, shown),
        }
    }
}

/// Values to be written to the nodes of a skill.
struct Values<'n> {
    nodes: &'n SkillNodes,
    values: Vec<(NodeId, DataValue)>,
}

impl<'n> Values<'n> {
    fn new(nodes: &'n SkillNodes) -> Self {
        Self {
            nodes,
            values: Vec::new(),
        }
    }

    /// Adds a value for a node of the type; ignored if there is no such node.
    fn add(&mut self, path: &str, value: impl Into<Variant>) {
        if let Some(node) = self.nodes.instance.node(path) {
            self.values
                .push((node.clone(), DataValue::new_now(value.into())));
        }
    }

    fn state(&mut self, state: ProgramMachineState) {
        self.add("CurrentState", LocalizedText::new("en", state.name()));
        self.add("CurrentState/Id", NodeId::new(0, state.node_id()));
        self.add("CurrentState/Number", state.number());
    }

    fn show(self, server: &OpcUaServer) {
        show(server, &self.nodes.name, self.values);
    }
}

pub(super) fn texts(of: &[String]) -> Variant {
    let of = of
        .iter()
        .map(|text| SkillValue::from(text.as_str()))
        .collect();
    to_variant(&SkillValue::Array(Builtin::String, of))
}

fn named(
    nodes: &BTreeMap<String, NodeId>,
    values: &[(String, SkillValue)],
) -> Vec<(NodeId, DataValue)> {
    let shown = |(name, value): &(String, SkillValue)| {
        Some((
            nodes.get(name)?.clone(),
            DataValue::new_now(to_variant(value)),
        ))
    };
    values.iter().filter_map(shown).collect()
}

fn show(server: &OpcUaServer, skill: &str, values: Vec<(NodeId, DataValue)>) {
    if let Err(status) = server.show_all(values) {
        tracing::warn!(skill, "cannot show the values of the skill: {status}");
    }
}

fn state_ref(state: ProgramMachineState) -> StateRef {
    StateRef {
        name: state.name().to_owned(),
        id: NodeId::new(0, state.node_id()),
        number: state.number(),
    }
}

fn transition_ref(transition: &Transition) -> StateRef {
    StateRef {
        name: transition.name.to_owned(),
        id: NodeId::new(0, transition.node_id),
        number: transition.number,
    }
}

pub(super) fn date_time(time: SystemTime) -> DateTime {
    let since = time
        .duration_since(SystemTime::UNIX_EPOCH)
        .unwrap_or_default();
    let ticks = i64::try_from(since.as_nanos() / 100).unwrap_or_default();
    DateTime::from(ticks.saturating_add(TICKS_TO_1970))
}

/// Number of intervals of 100 ns from 1601 to 1970.
const TICKS_TO_1970: i64 = 116_444_736_000_000_000;

/// Severities from 1 to 1000 (OPC 10000-5, 6.4.2).
const USUAL: u16 = 100;
const FAILED: u16 = 400;
