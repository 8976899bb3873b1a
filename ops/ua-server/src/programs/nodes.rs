//! The nodes of a Program and their values (OPC 10000-10, 5.2).

use std::sync::Arc;

use bridge_node::{CallDescription, CallField};
use mappings::TopicId;
use opcua::nodes::{MethodBuilder, NodeType, ObjectBuilder, ReferenceDirection, VariableBuilder};
use opcua::server::SubscriptionCache;
use opcua::server::address_space::{AddressSpace, EventNotifier};
use opcua::types::{
    Argument, AttributeId, ByteString, DataTypeId, DataValue, DateTime, LocalizedText, NodeId,
    ObjectTypeId, QualifiedName, ReferenceTypeId, StatusCode, TimestampsToReturn, VariableTypeId,
    Variant,
};
use plant_opcua::server::{StateRef, TransitionEvent};
use program::{ProgramMachineState, ProgramMethod, Transition};

use crate::address;
use crate::argument_types::ArgumentTypes;
use crate::nodes::SpaceManager;

/// The nodes of a Program.
pub(super) struct ProgramNodes {
    manager: Arc<SpaceManager>,
    subscriptions: Arc<SubscriptionCache>,
    topic: TopicId,
    name: String,
    /// The fields of a result that have a node.
    results: Vec<String>,
    /// All nodes, the Program first.
    made: Vec<NodeId>,
}

/// The outcome of a goal.
pub(super) struct GoalOutcome {
    /// Status of `action_msgs/GoalStatus`, or 0 if it is unknown.
    pub(super) status: i64,
    message: String,
    fields: Vec<Variant>,
}

impl GoalOutcome {
    /// Decodes an answer: status, message, and the fields of the result.
    pub(super) fn of(answer: Vec<Variant>) -> Self {
        let mut fields = answer.into_iter();
        let status = fields.next().as_ref().and_then(whole).unwrap_or_default();
        let message = match fields.next() {
            Some(Variant::String(text)) => text.as_ref().trim_end().to_owned(),
            Some(_) | None => String::new(),
        };
        Self {
            status,
            message,
            fields: fields.collect(),
        }
    }

    /// Returns the outcome of a goal that was rejected or not sent.
    pub(super) const fn never_ran(message: String) -> Self {
        Self {
            status: NEVER_RAN,
            message,
            fields: Vec::new(),
        }
    }

    /// Returns an outcome with an unknown end.
    pub(super) const fn lost(message: String) -> Self {
        Self {
            status: 0,
            message,
            fields: Vec::new(),
        }
    }

    /// Returns the outcome as text for the operator.
    pub(super) fn said(&self) -> String {
        match (&self.message[..], self.status) {
            ("", SUCCEEDED) => "the goal is reached".to_owned(),
            ("", 5) => "the goal was cancelled".to_owned(),
            ("", 6) => "the goal was aborted".to_owned(),
            ("", NEVER_RAN) => "the goal never ran".to_owned(),
            ("", _) => "the goal is lost".to_owned(),
            (message, _) => message.to_owned(),
        }
    }
}

impl ProgramNodes {
    /// Adds the Program of an action and its parent objects. Also returns the parent objects,
    /// outermost first.
    pub(super) fn insert(
        (manager, subscriptions): (Arc<SpaceManager>, Arc<SubscriptionCache>),
        (topic, name): (TopicId, &str),
        (goal, result): (&CallDescription, &CallDescription),
        types: &ArgumentTypes,
    ) -> (Self, Vec<NodeId>) {
        let mut address_space = manager.address_space().write();
        let (around, last) = around(&mut address_space, name);
        let parent = around.last().cloned();
        let mut tree = Tree {
            address_space: &mut address_space,
            topic,
            made: Vec::new(),
        };
        tree.program(last, parent.unwrap_or_else(address::programs_folder));
        let taken = goal.request.get(1..).unwrap_or_default();
        let takes = without(GOAL, types.arguments(topic, taken));
        let gives = Argument {
            name: "GoalId".into(),
            data_type: DataTypeId::ByteString.into(),
            value_rank: -1,
            ..Argument::default()
        };
        tree.method(ProgramMethod::Start, (&takes, &[gives]));
        tree.method(ProgramMethod::Halt, (&[], &[]));
        tree.method(ProgramMethod::Reset, (&[], &[]));
        let shown = result.response.get(2..).unwrap_or_default();
        let results = tree.results(shown, types);
        let made = tree.made;
        drop(address_space);
        let nodes = Self {
            manager,
            subscriptions,
            topic,
            name: name.to_owned(),
            results,
            made,
        };
        (nodes, around)
    }

    pub(super) fn program(&self) -> NodeId {
        self.node("")
    }

    pub(super) fn methods(&self) -> [(NodeId, ProgramMethod); 3] {
        METHODS.map(|method| (self.node(method.name()), method))
    }

    fn node(&self, path: &str) -> NodeId {
        address::program(self.topic, path)
    }

    /// Removes the nodes, and the given parent objects. Clients that monitor a removed node are
    /// notified.
    pub(super) fn remove(&self, around: &[&NodeId]) {
        let mut address_space = self.manager.address_space().write();
        for node in &self.made {
            drop(address_space.delete(node, true));
        }
        for object in around.iter().rev() {
            drop(address_space.delete(object, true));
        }
        drop(address_space);
        let mut notifier = self.subscriptions.data_notifier();
        for node in &self.made {
            let gone = DataValue::new_now_status(Variant::Empty, StatusCode::BadNodeIdUnknown);
            notifier.notify(node, AttributeId::Value, gone);
        }
    }

    /// Shows the initial state.
    pub(super) fn show_first(&self, now: ProgramMachineState) {
        self.show(state(now).to_vec());
    }

    /// Shows the current goal before its end.
    pub(super) fn show_goal(&self, id: &ByteString) {
        self.show(vec![
            ("FinalResultData.GoalId", Variant::from(id.clone())),
            ("FinalResultData.Status", Variant::Int32(EXECUTING)),
            ("FinalResultData.Message", Variant::from("")),
        ]);
    }

    /// Returns the end of a goal as text for the operator, with the reason in its result.
    pub(super) fn said(&self, outcome: &GoalOutcome) -> String {
        let said = outcome.said();
        if !outcome.message.is_empty() || outcome.status == SUCCEEDED {
            return said;
        }
        let fields = self.results.iter().zip(&outcome.fields);
        let texts = fields.filter_map(|(name, value)| {
            if let Variant::String(text) = value {
                Some((name.as_str(), text.as_ref()))
            } else {
                None
            }
        });
        match messages::reason_of(texts) {
            None => said,
            Some(reason) => format!("{said}: {reason}"),
        }
    }

    pub(super) fn show_outcome(&self, outcome: &GoalOutcome) {
        let status = i32::try_from(outcome.status).unwrap_or_default();
        self.show(vec![
            ("FinalResultData.Status", Variant::Int32(status)),
            (
                "FinalResultData.Message",
                Variant::from(outcome.message.as_str()),
            ),
        ]);
        let nodes = self.results.iter().map(|name| self.node(&result(name)));
        self.write(nodes.zip(outcome.fields.iter().cloned()).collect());
    }

    /// Shows why a goal that is being cancelled has not ended or is not cancelled, and raises an
    /// event without a transition.
    pub(super) fn show_pending(&self, why: &str, now: ProgramMachineState) {
        self.show(vec![("FinalResultData.Message", Variant::from(why))]);
        let state = StateRef {
            name: now.name().to_owned(),
            id: NodeId::new(0, now.node_id()),
            number: now.number(),
        };
        let source = (self.program(), &*self.name);
        let event = TransitionEvent::without_transition(source, state, (why, FAILED));
        event.raise(&self.subscriptions);
    }

    /// Shows the feedback of the action: a single field as its value, several fields as an array.
    pub(super) fn show_feedback(&self, fields: &[Variant]) {
        let value = match fields {
            [one] => one.clone(),
            all => Variant::from(all.to_vec()),
        };
        self.show(vec![("Feedback", value)]);
    }

    pub(super) fn show_transition(&self, transition: &Transition, message: &str) {
        let time = DateTime::now();
        let mut values = state(transition.to).to_vec();
        values.extend([
            (
                "LastTransition",
                Variant::from(LocalizedText::new("en", transition.name)),
            ),
            (
                "LastTransition.Id",
                Variant::from(NodeId::new(0, transition.node_id)),
            ),
            ("LastTransition.Number", Variant::from(transition.number)),
            ("LastTransition.TransitionTime", Variant::from(time)),
        ]);
        self.show(values);
        let of = |name: &str, node_id, number| StateRef {
            name: name.to_owned(),
            id: NodeId::new(0, node_id),
            number,
        };
        let of_state =
            |state: ProgramMachineState| of(state.name(), state.node_id(), state.number());
        let event = TransitionEvent {
            source: self.program(),
            source_name: self.name.clone(),
            event_type: ObjectTypeId::ProgramTransitionEventType.into(),
            message: match message {
                "" => transition.name.to_owned(),
                message => message.to_owned(),
            },
            severity: match transition.to {
                ProgramMachineState::Halted => FAILED,
                ProgramMachineState::Ready
                | ProgramMachineState::Running
                | ProgramMachineState::Suspended => USUAL,
            },
            from_state: of_state(transition.from),
            to_state: of_state(transition.to),
            transition: of(transition.name, transition.node_id, transition.number),
            intermediate_result: Variant::Empty,
            fields: Vec::new(),
            time,
        };
        event.raise(&self.subscriptions);
    }

    fn show(&self, values: Vec<(&str, Variant)>) {
        let values = values.into_iter();
        self.write(
            values
                .map(|(path, value)| (self.node(path), value))
                .collect(),
        );
    }

    fn write(&self, values: Vec<(NodeId, Variant)>) {
        let mut address_space = self.manager.address_space().write();
        let mut shown = Vec::with_capacity(values.len());
        for (node, value) in values {
            if let Some(NodeType::Variable(variable)) = address_space.find_mut(&node) {
                variable.set_data_value(DataValue::new_now(value));
                shown.push(node);
            }
        }
        self.subscriptions.maybe_notify(
            shown.iter().map(|node| (node, AttributeId::Value)),
            |node, attribute, range, encoding| {
                let node = address_space.find(node)?.as_node();
                node.get_attribute(TimestampsToReturn::Both, attribute, range, encoding)
            },
        );
    }
}

/// Creates the missing objects that the dots of a name denote. Returns the objects and the part
/// after the last dot.
fn around<'n>(address_space: &mut AddressSpace, name: &'n str) -> (Vec<NodeId>, &'n str) {
    let mut parts = name
        .split('.')
        .map(str::trim)
        .filter(|part| !part.is_empty());
    let last = parts.next_back().unwrap_or(name);
    let (mut around, mut path) = (Vec::new(), Vec::new());
    let mut parent = address::programs_folder();
    for part in parts.take(MOST_PARTS) {
        path.push(part);
        let object = address::program_folder(&path);
        if !address_space.node_exists(&object) {
            address::add_folder(&object, part, parent, address_space);
        }
        around.push(object.clone());
        parent = object;
    }
    (around, last)
}

/// Adds nodes and records them.
struct Tree<'a> {
    address_space: &'a mut AddressSpace,
    topic: TopicId,
    made: Vec<NodeId>,
}

impl Tree<'_> {
    fn program(&mut self, name: &str, parent: NodeId) {
        let node = self.made("");
        ObjectBuilder::new(&node, names(name), LocalizedText::from(name))
            .description(LocalizedText::from(self.topic.to_string()))
            .has_type_definition(ObjectTypeId::ProgramStateMachineType)
            .event_notifier(EventNotifier::SUBSCRIBE_TO_EVENTS)
            .organized_by(parent)
            .insert(self.address_space);
        for (path, type_, kind) in [
            ("CurrentState", DataTypeId::LocalizedText, STATE),
            ("CurrentState.Id", DataTypeId::NodeId, PROPERTY),
            ("CurrentState.Number", DataTypeId::UInt32, PROPERTY),
            ("LastTransition", DataTypeId::LocalizedText, TRANSITION),
            ("LastTransition.Id", DataTypeId::NodeId, PROPERTY),
            ("LastTransition.Number", DataTypeId::UInt32, PROPERTY),
            (
                "LastTransition.TransitionTime",
                DataTypeId::UtcTime,
                PROPERTY,
            ),
            ("Deletable", DataTypeId::Boolean, PROPERTY),
            ("AutoDelete", DataTypeId::Boolean, PROPERTY),
            ("RecycleCount", DataTypeId::Int32, PROPERTY),
        ] {
            let value = if type_ == DataTypeId::Boolean {
                Some(Variant::from(false))
            } else {
                (type_ == DataTypeId::Int32).then(|| Variant::from(0_i32))
            };
            self.variable(path, (type_.into(), -1), kind, value);
        }
        self.variable(
            "Feedback",
            (DataTypeId::BaseDataType.into(), -2),
            VALUE,
            None,
        );
    }

    /// Adds the nodes of a result: the goal, its end, and its fields under their names.
    fn results(&mut self, fields: &[CallField], types: &ArgumentTypes) -> Vec<String> {
        let node = self.made("FinalResultData");
        let parent = address::program(self.topic, "");
        ObjectBuilder::new(
            &node,
            core("FinalResultData"),
            LocalizedText::from("FinalResultData"),
        )
        .has_type_definition(ObjectTypeId::BaseObjectType)
        .component_of(parent)
        .insert(self.address_space);
        for (name, type_) in OWN_RESULTS {
            self.variable(&result(name), (type_.into(), -1), VALUE, None);
        }
        let arguments = without(RESULT, types.arguments(self.topic, fields));
        let named = arguments.into_iter().map(|field| {
            let mut name = field.name.as_ref().to_owned();
            if OWN_RESULTS.iter().any(|(own, _)| *own == name) {
                name.push('_');
            }
            let type_ = (field.data_type, field.value_rank);
            self.variable(&result(&name), type_, VALUE, None);
            name
        });
        named.collect()
    }

    fn variable(
        &mut self,
        path: &str,
        (data_type, rank): (NodeId, i32),
        (kind, reference): (VariableTypeId, ReferenceTypeId),
        value: Option<Variant>,
    ) {
        let (above, name) = path.split_once('.').unwrap_or(("", path));
        let node = address::program(self.topic, path);
        if self.address_space.node_exists(&node) {
            return;
        }
        let is_core = kind != VariableTypeId::BaseDataVariableType;
        let browse_name = if is_core { core(name) } else { names(name) };
        VariableBuilder::new(&node, browse_name, LocalizedText::from(name))
            .data_type(data_type)
            .value_rank(rank)
            .has_type_definition(kind)
            .reference(
                address::program(self.topic, above),
                reference,
                ReferenceDirection::Inverse,
            )
            .insert(self.address_space);
        let waiting = StatusCode::BadWaitingForInitialData;
        let value = value.map_or_else(
            || DataValue::new_now_status(Variant::Empty, waiting),
            DataValue::new_now,
        );
        if let Some(NodeType::Variable(variable)) = self.address_space.find_mut(&node) {
            variable.set_data_value(value);
        }
        self.made.push(node);
    }

    fn method(&mut self, method: ProgramMethod, (takes, gives): (&[Argument], &[Argument])) {
        let name = method.name();
        let node = self.made(name);
        let mut builder = MethodBuilder::new(&node, core(name), LocalizedText::from(name))
            .component_of(address::program(self.topic, ""))
            .executable(true)
            .user_executable(true);
        if !takes.is_empty() {
            let id = self.made(&format!("{name}.InputArguments"));
            builder = builder.input_args(self.address_space, &id, takes);
        }
        if !gives.is_empty() {
            let id = self.made(&format!("{name}.OutputArguments"));
            builder = builder.output_args(self.address_space, &id, gives);
        }
        // The Method stays executable, because the library refuses calls of other Methods with
        // BadUserAccessDenied. OPC 10000-10 requires BadInvalidState.
        builder.insert(self.address_space);
    }

    fn made(&mut self, path: &str) -> NodeId {
        let node = address::program(self.topic, path);
        self.made.push(node.clone());
        node
    }
}

fn state(state: ProgramMachineState) -> [(&'static str, Variant); 3] {
    [
        (
            "CurrentState",
            Variant::from(LocalizedText::new("en", state.name())),
        ),
        (
            "CurrentState.Id",
            Variant::from(NodeId::new(0, state.node_id())),
        ),
        ("CurrentState.Number", Variant::from(state.number())),
    ]
}

/// Returns the fields of a message without its prefix.
fn without(message: &str, mut fields: Vec<Argument>) -> Vec<Argument> {
    for field in &mut fields {
        if let Some(name) = field.name.as_ref().strip_prefix(message) {
            field.name = name.into();
        }
    }
    fields
}

fn result(name: &str) -> String {
    format!("FinalResultData.{name}")
}

/// Returns a name that OPC 10000-10 defines.
fn core(name: &str) -> QualifiedName {
    QualifiedName::new(0, name)
}

/// Returns a name in the namespace of the application.
fn names(name: &str) -> QualifiedName {
    QualifiedName::new(address::programs_folder().namespace, name)
}

/// Nodes in addition to the fields of a result.
const OWN_RESULTS: [(&str, DataTypeId); 3] = [
    ("GoalId", DataTypeId::ByteString),
    ("Status", DataTypeId::Int32),
    ("Message", DataTypeId::String),
];
const METHODS: [ProgramMethod; 3] = [
    ProgramMethod::Start,
    ProgramMethod::Halt,
    ProgramMethod::Reset,
];
const PROPERTY: (VariableTypeId, ReferenceTypeId) =
    (VariableTypeId::PropertyType, ReferenceTypeId::HasProperty);
const VALUE: (VariableTypeId, ReferenceTypeId) = (
    VariableTypeId::BaseDataVariableType,
    ReferenceTypeId::HasComponent,
);
const STATE: (VariableTypeId, ReferenceTypeId) = (
    VariableTypeId::FiniteStateVariableType,
    ReferenceTypeId::HasComponent,
);
const TRANSITION: (VariableTypeId, ReferenceTypeId) = (
    VariableTypeId::FiniteTransitionVariableType,
    ReferenceTypeId::HasComponent,
);
/// Largest number of objects around a Program.
const MOST_PARTS: usize = 8;
/// Prefixes of the announced fields of a goal and of a result.
const GOAL: &str = "goal.";
const RESULT: &str = "result.";
/// STATUS_EXECUTING of `action_msgs/GoalStatus`.
const EXECUTING: i32 = 2;
/// Severities from 1 to 1000 (OPC 10000-5, 6.4.2).
const USUAL: u16 = 100;
const FAILED: u16 = 400;

/// Converts an integer of any width.
pub(super) fn whole(value: &Variant) -> Option<i64> {
    if let Variant::SByte(number) = value {
        Some((*number).into())
    } else if let Variant::Byte(number) = value {
        Some((*number).into())
    } else if let Variant::Int16(number) = value {
        Some((*number).into())
    } else if let Variant::Int32(number) = value {
        Some((*number).into())
    } else {
        None
    }
}

/// Statuses of `action_msgs/GoalStatus`; `NEVER_RAN` marks goals that were not executed.
pub(super) const SUCCEEDED: i64 = 4;
pub(super) const NEVER_RAN: i64 = -1;
