//! Calls of other spaces, as Methods: what a client calls is asked of whoever executes it.
//!
//! A Method stands in the object that the dots of its name say (`Conveyor.Switch`), below the folder `Calls`. It goes when the
//! call does.

use std::collections::{HashMap, VecDeque};
use std::sync::Arc;
use std::time::Duration;

use bridge_node::{Answered, AskId, CallDescription, CallField, CallRole};
use bytes::Bytes;
use mappings::{Mapping, TopicId};
use messages::Rank;
use opcua::nodes::{MethodBuilder, ObjectBuilder};
use opcua::server::address_space::AddressSpace;
use opcua::sync::Mutex;
use opcua::types::{
    Argument, LocalizedText, NodeId, ObjectTypeId, QualifiedName, StatusCode, Variant,
};
use tokio::sync::{mpsc, oneshot};
use tracing::{info, warn};
use uadp::Fields;

use crate::address;
use crate::layout::Shape;
use crate::nodes::SpaceManager;
use crate::value;

/// The Methods there are, by their nodes.
pub(crate) type Table = Mutex<HashMap<NodeId, Callable>>;

/// A call as a client finds it.
#[derive(Debug, Clone)]
pub(crate) struct Callable {
    topic: TopicId,
    description: Arc<CallDescription>,
}

/// A request of a client.
#[derive(Debug)]
pub(crate) struct Question {
    topic: TopicId,
    block: Bytes,
    answer: oneshot::Sender<Answered<Bytes>>,
}

/// Shows the calls of other spaces, and hands on what clients ask them.
pub(crate) struct Methods {
    manager: Arc<SpaceManager>,
    mapping: Arc<Mapping>,
    questions: mpsc::Receiver<Question>,
    shown: HashMap<TopicId, NodeId>,
    /// How many Methods are in each object, or in one in it.
    objects: HashMap<NodeId, usize>,
    /// The objects around each Method, the outermost first.
    around: HashMap<TopicId, Vec<NodeId>>,
    asked: HashMap<AskId, oneshot::Sender<Answered<Bytes>>>,
    /// Those that waited the longest, to be looked at whether their client is still there.
    order: VecDeque<AskId>,
    next: u64,
    told_full: bool,
}

/// What is to be asked.
pub(crate) struct Ask {
    pub(crate) ask: AskId,
    pub(crate) topic: TopicId,
    pub(crate) request: Bytes,
    pub(crate) timeout: Duration,
}

/// What the arguments of a client come to.
pub(crate) enum Refused {
    /// Some are not of their types: a status for each.
    Arguments(Vec<StatusCode>),
    /// Nothing can be asked.
    Status(StatusCode),
}

impl Methods {
    pub(crate) fn new(
        manager: Arc<SpaceManager>,
        mapping: &Arc<Mapping>,
        questions: mpsc::Receiver<Question>,
    ) -> Self {
        address::add_folder(
            &address::calls_folder(),
            "Calls",
            address::root(),
            &mut manager.address_space().write(),
        );
        Self {
            manager,
            mapping: Arc::clone(mapping),
            questions,
            shown: HashMap::new(),
            objects: HashMap::new(),
            around: HashMap::new(),
            asked: HashMap::new(),
            order: VecDeque::new(),
            next: 0,
            told_full: false,
        }
    }

    /// Shows a call, in the place of what it was. The parts of an action are Methods too.
    pub(crate) fn known(&mut self, topic: TopicId, description: &Arc<CallDescription>) {
        self.gone(topic);
        if self.shown.len() >= MOST_METHODS {
            self.tell_full();
            return;
        }
        let node = self.node(topic);
        let Some(around) = self.insert(&node, (topic, description)) else {
            warn!(%topic, %node, "the call is shown as no Method: there is a node of that id already");
            return;
        };
        for object in &around {
            *self.objects.entry(object.clone()).or_default() += 1;
        }
        self.around.insert(topic, around);
        info!(%topic, name = description.name, %node, "shown as a Method");
        self.shown.insert(topic, node);
    }

    fn tell_full(&mut self) {
        if !std::mem::replace(&mut self.told_full, true) {
            warn!("more than {MOST_METHODS} calls of the space: the rest is shown as no Methods");
        }
    }

    /// Puts a Method in, unless there is something under its node. Gives the objects around it.
    fn insert(
        &self,
        node: &NodeId,
        (topic, description): (TopicId, &Arc<CallDescription>),
    ) -> Option<Vec<NodeId>> {
        let mut address_space = self.manager.address_space().write();
        if address_space.node_exists(node) {
            return None;
        }
        let around = add(&mut address_space, node, (topic, description));
        drop(address_space);
        let callable = Callable {
            topic,
            description: Arc::clone(description),
        };
        let mut methods = self.manager.inner().methods().lock();
        methods.insert(node.clone(), callable);
        Some(around)
    }

    /// A mapped call has the node that the mapping says, if the server has its namespace.
    fn node(&self, topic: TopicId) -> NodeId {
        let mapped = self
            .mapping
            .call(topic)
            .map(|call| crate::layout::node_id(&call.node));
        let has = |node: &NodeId| {
            let inner = self.manager.inner();
            let mut namespaces = inner.served_namespaces();
            namespaces.any(|(index, _)| index == node.namespace)
        };
        mapped
            .filter(has)
            .unwrap_or_else(|| address::unmapped_node(topic))
    }

    /// Takes a call away. What was asked is still answered.
    pub(crate) fn gone(&mut self, topic: TopicId) {
        let Some(node) = self.shown.remove(&topic) else {
            return;
        };
        self.manager.inner().methods().lock().remove(&node);
        let mut address_space = self.manager.address_space().write();
        for arguments in ["InputArguments", "OutputArguments"] {
            drop(address_space.delete(&arguments_node(&node, arguments), true));
        }
        drop(address_space.delete(&node, true));
        // An object without a Method in it would stay for ever.
        for object in self.around.remove(&topic).unwrap_or_default().iter().rev() {
            let left = self.objects.get_mut(object).map_or(0, |methods| {
                *methods = methods.saturating_sub(1);
                *methods
            });
            if left == 0 {
                self.objects.remove(object);
                drop(address_space.delete(object, true));
            }
        }
    }

    /// Another mapping may say another node.
    pub(crate) fn reload(&mut self, mapping: &Arc<Mapping>) {
        self.mapping = Arc::clone(mapping);
        let moved = self
            .shown
            .iter()
            .filter(|(topic, node)| self.node(**topic) != **node);
        let moved: Vec<TopicId> = moved.map(|(topic, _)| *topic).collect();
        for topic in moved {
            let callable = self.shown.get(&topic).and_then(|node| {
                let methods = self.manager.inner().methods().lock();
                methods.get(node).cloned()
            });
            if let Some(callable) = callable {
                self.known(topic, &callable.description);
            }
        }
    }

    /// What a client asks next. Cancel-safe.
    pub(crate) async fn next(&mut self) -> Ask {
        let Some(question) = self.questions.recv().await else {
            return std::future::pending().await;
        };
        let Question {
            topic,
            block,
            answer,
        } = question;
        let ask = AskId(self.next);
        self.next = self.next.wrapping_add(1);
        // Answered ones, and those whose client is gone.
        while let Some(oldest) = self.order.front()
            && self
                .asked
                .get(oldest)
                .is_none_or(oneshot::Sender::is_closed)
        {
            self.asked.remove(oldest);
            self.order.pop_front();
        }
        self.asked.insert(ask, answer);
        self.order.push_back(ask);
        let timeout = self
            .mapping
            .call(topic)
            .map_or(TIMEOUT, |call| call.timeout);
        Ask {
            ask,
            topic,
            request: block,
            timeout,
        }
    }

    pub(crate) fn answered(&mut self, ask: AskId, answer: Answered<Bytes>) {
        if let Some(asked) = self.asked.remove(&ask) {
            // Who asked may have gone.
            drop(asked.send(answer));
        }
    }
}

impl Callable {
    /// Asks with those arguments, and gives what comes back.
    pub(crate) async fn call(
        self,
        arguments: &[Variant],
        questions: &mpsc::Sender<Question>,
    ) -> Result<Vec<Variant>, Refused> {
        let block = self.block(arguments)?;
        let (answer, answered) = oneshot::channel();
        let question = Question {
            topic: self.topic,
            block,
            answer,
        };
        questions
            .try_send(question)
            .map_err(|_| Refused::Status(StatusCode::BadTooManyOperations))?;
        let answer = answered.await;
        let answer = answer.map_err(|_| Refused::Status(StatusCode::BadShutdown))?;
        let response = answer.map_err(|error| {
            info!(topic = %self.topic, "a call came to nothing: {error}");
            Refused::Status(StatusCode::from(error.status.0))
        })?;
        let fields = Fields::parse(&response);
        let fields = fields.map_err(|_| Refused::Status(StatusCode::BadDecodingError))?;
        let outputs = fields.map(|field| field.map(|field| value::from_field(&field)));
        outputs
            .collect::<Result<_, _>>()
            .map_err(|_| Refused::Status(StatusCode::BadDecodingError))
    }

    fn block(&self, arguments: &[Variant]) -> Result<Bytes, Refused> {
        let request = &self.description.request;
        if arguments.len() < request.len() {
            return Err(Refused::Status(StatusCode::BadArgumentsMissing));
        }
        let block = value::fields_block(arguments).map_err(Refused::Status)?;
        let fields = Fields::parse(&block);
        let fields = fields.map_err(|_| Refused::Status(StatusCode::BadInvalidArgument))?;
        let statuses = fields.zip(request).map(|(value, field)| match value {
            Ok(value) if shape(field).fits(&value) => StatusCode::Good,
            Ok(_) => StatusCode::BadTypeMismatch,
            Err(_) => StatusCode::BadInvalidArgument,
        });
        let statuses: Vec<StatusCode> = statuses.collect();
        if statuses.iter().any(|status| status.is_bad()) {
            return Err(Refused::Arguments(statuses));
        }
        Ok(Bytes::from(block))
    }
}

fn shape(field: &CallField) -> Shape {
    Shape(Some((
        field.builtin,
        matches!(field.rank, Rank::Array { .. }),
    )))
}

/// Puts the Method in, and the objects around it that are not there. Gives the objects, the outermost first.
fn add(
    address_space: &mut AddressSpace,
    node: &NodeId,
    (topic, description): (TopicId, &CallDescription),
) -> Vec<NodeId> {
    let name = match &description.name[..] {
        "" => topic.to_string(),
        name => name.to_owned(),
    };
    let mut parts = name
        .split('.')
        .map(str::trim)
        .filter(|part| !part.is_empty());
    let last = parts.next_back().unwrap_or(&name);
    let mut object = address::calls_folder();
    let (mut around, mut path) = (Vec::new(), Vec::new());
    for part in parts.take(MOST_PARTS) {
        path.push(part);
        let inner = address::call_object(&path);
        if !address_space.node_exists(&inner) {
            let names = QualifiedName::new(inner.namespace, part);
            ObjectBuilder::new(&inner, names, LocalizedText::from(part))
                .has_type_definition(ObjectTypeId::BaseObjectType)
                .organized_by(object.clone())
                .insert(address_space);
        }
        around.push(inner.clone());
        object = inner;
    }
    let about = match (&description.about[..], description.role) {
        ("", CallRole::Call) => topic.to_string(),
        (about, _) => format!("{topic}: {about}"),
    };
    let names = QualifiedName::new(node.namespace, last);
    let mut method = MethodBuilder::new(node, names, LocalizedText::from(last))
        .description(LocalizedText::from(about.as_str()))
        .component_of(object)
        .executable(true)
        .user_executable(true);
    if !description.request.is_empty() {
        let arguments = arguments(&description.request);
        let id = arguments_node(node, "InputArguments");
        method = method.input_args(address_space, &id, &arguments);
    }
    if !description.response.is_empty() {
        let arguments = arguments(&description.response);
        let id = arguments_node(node, "OutputArguments");
        method = method.output_args(address_space, &id, &arguments);
    }
    method.insert(address_space);
    around
}

fn arguments(fields: &[CallField]) -> Vec<Argument> {
    let argument = |field: &CallField| Argument {
        name: field.name.as_str().into(),
        data_type: shape(field).data_type(),
        value_rank: shape(field).value_rank(),
        array_dimensions: match field.rank {
            Rank::Scalar => None,
            Rank::Array { fixed } => Some(vec![fixed.unwrap_or(0)]),
        },
        description: LocalizedText::null(),
    };
    fields.iter().map(argument).collect()
}

fn arguments_node(method: &NodeId, which: &str) -> NodeId {
    NodeId::new(
        address::calls_folder().namespace,
        format!("UaSpace.Calls.{method}.{which}"),
    )
}

/// Calls that are shown: anybody in the space can announce some.
const MOST_METHODS: usize = 4_096;
/// Objects around one Method.
const MOST_PARTS: usize = 8;
/// Requests of clients that wait for the run loop; one more is refused.
pub(crate) const MOST_QUESTIONS: usize = 256;
/// How long an answer is waited for where the mapping says nothing.
const TIMEOUT: Duration = Duration::from_secs(30);
