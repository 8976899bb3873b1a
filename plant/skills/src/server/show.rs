//! The values of the nodes of a skill and its events, for clients.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::SystemTime;

use plant_opcua::server::{Instance, Server, StateRef, TransitionEvent};
use plant_opcua::types::{
    DataValue, DateTime, ExtensionObject, LocalizedText, NodeId, ProgramDiagnostic2DataType,
    QualifiedName, StatusCode, UAString, Variant,
};
use program::{Method, State, Transition};

use crate::model::{EVENT_TYPE, NAMESPACE};
use crate::parameters::{Parameter, Parameters};
use crate::shown::{Observer, Outcome, Shown, Told, Transitioned};
use crate::skill::Facts;
use crate::value::{Builtin, Value};
use crate::variant::to_variant;

/// The nodes of a skill.
#[derive(Debug)]
pub(super) struct Nodes {
    name: String,
    instance: Instance,
    parameters: BTreeMap<String, NodeId>,
    results: BTreeMap<String, NodeId>,
    event_type: Option<NodeId>,
    /// The index of the namespace of the skill types.
    types: u16,
}

impl Nodes {
    pub(super) fn new(server: &Server, instance: Instance, facts: &Facts) -> Self {
        let among = |group: &str, of: &[Parameter]| {
            let named = |parameter: &Parameter| {
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

    pub(super) fn method(&self, method: Method) -> Option<&NodeId> {
        self.named(method.name())
    }

    /// Returns the node of a member of the type.
    pub(super) fn named(&self, name: &str) -> Option<&NodeId> {
        self.instance.node(name)
    }

    /// Shows the constant values of the skill and its initial state.
    pub(super) fn show_at_first(&self, server: &Server, facts: &Facts, uses: &[String]) {
        let mut values = Values::new(self);
        values.add("Name", facts.name.as_str());
        values.add("Capabilities", texts(&facts.capabilities));
        values.add("UsesSkills", texts(uses));
        values.add("Deletable", false);
        values.add("AutoDelete", false);
        values.add("RecycleCount", 0_i32);
        values.state(State::Halted);
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
        for method in Method::ALL {
            self.executable(server, method, method == Method::Reset);
        }
    }

    /// Shows the default parameters, for a client that has not written any.
    pub(super) fn show_defaults(&self, server: &Server, facts: &Facts) {
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

    fn show_parameters(&self, server: &Server, parameters: &Parameters) {
        show(
            server,
            &self.name,
            named(&self.parameters, parameters.all()),
        );
    }

    fn show_outcome(&self, server: &Server, outcome: &Outcome) {
        let mut values = Values::new(self);
        values.add("FinalResultData/Run", outcome.run);
        values.add("FinalResultData/Succeeded", outcome.succeeded);
        values.add("FinalResultData/Message", outcome.message.as_str());
        values.add("FinalResultData/Trace", texts(&outcome.trace));
        values.add("FinalResultData/Unknown", outcome.unknown);
        values.values.extend(named(&self.results, &outcome.results));
        values.show(server);
    }

    fn show_transition(&self, server: &Server, happened: &Transitioned, shown: &Shown) {
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
        for (method, executable) in Method::ALL.into_iter().zip(shown.executable) {
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
            severity: if transition.to == State::Halted {
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

    fn show_progress(&self, server: &Server, shown: &Shown) {
        let mut values = Values::new(self);
        values.add("Progress", shown.progress);
        values.add("SkillStep", shown.step.as_str());
        values.show(server);
    }

    /// Shows why a run that is being cancelled has not ended, and raises an event without a
    /// transition.
    fn show_pending(&self, server: &Server, why: &str, shown: &Shown) {
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

    fn show_called(&self, server: &Server, shown: &Shown) {
        let mut values = Values::new(self);
        self.diagnostic(&mut values, shown);
        values.show(server);
    }

    /// Sets ProgramDiagnostic as a whole and its members (OPC 10000-10, 5.2.9).
    fn diagnostic(&self, values: &mut Values<'_>, shown: &Shown) {
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

    fn executable(&self, server: &Server, method: Method, executable: bool) {
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
    server: Server,
    nodes: Arc<Nodes>,
}

impl Shower {
    pub(super) fn new(server: Server, nodes: Arc<Nodes>) -> Self {
        Self { server, nodes }
    }
}

impl Observer for Shower {
    fn told(&self, what: Told<'_>, shown: &Shown) {
        let Self { server, nodes } = self;
        match what {
            Told::Parameters(parameters) => nodes.show_parameters(server, parameters),
            Told::Transition(happened) => nodes.show_transition(server, happened, shown),
            Told::Step | Told::Progress => nodes.show_progress(server, shown),
            Told::Pending(why) => nodes.show_pending(server, why, shown),
            Told::Outcome(outcome) => nodes.show_outcome(server, outcome),
            Told::Called => nodes.show_called(server, shown),
        }
    }
}

/// Values to be written to the nodes of a skill.
struct Values<'n> {
    nodes: &'n Nodes,
    values: Vec<(NodeId, DataValue)>,
}

impl<'n> Values<'n> {
    fn new(nodes: &'n Nodes) -> Self {
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

    fn state(&mut self, state: State) {
        self.add("CurrentState", LocalizedText::new("en", state.name()));
        self.add("CurrentState/Id", NodeId::new(0, state.node_id()));
        self.add("CurrentState/Number", state.number());
    }

    fn show(self, server: &Server) {
        show(server, &self.nodes.name, self.values);
    }
}

pub(super) fn texts(of: &[String]) -> Variant {
    let of = of.iter().map(|text| Value::from(text.as_str())).collect();
    to_variant(&Value::Array(Builtin::String, of))
}

fn named(nodes: &BTreeMap<String, NodeId>, values: &[(String, Value)]) -> Vec<(NodeId, DataValue)> {
    let shown = |(name, value): &(String, Value)| {
        Some((
            nodes.get(name)?.clone(),
            DataValue::new_now(to_variant(value)),
        ))
    };
    values.iter().filter_map(shown).collect()
}

fn show(server: &Server, skill: &str, values: Vec<(NodeId, DataValue)>) {
    if let Err(status) = server.show_all(values) {
        tracing::warn!(skill, "cannot show the values of the skill: {status}");
    }
}

fn state_ref(state: State) -> StateRef {
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
