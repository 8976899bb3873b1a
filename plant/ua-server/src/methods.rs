//! Calls of other spaces, as Methods: what a client calls is asked of whoever executes it.
//!
//! A Method stands in the object that the dots of its name say (`Conveyor.Switch`), below the folder `Calls`. It goes when the
//! call does.

use std::collections::{HashMap, VecDeque};
use std::sync::Arc;
use std::time::Duration;

use bridge_node::{Answered, AskError, AskId, CallDescription, CallField};
use bytes::Bytes;
use mappings::{Mapping, TopicId};
use messages::Rank;
use opcua::nodes::{MethodBuilder, ObjectBuilder};
use opcua::server::SubscriptionCache;
use opcua::server::address_space::AddressSpace;
use opcua::sync::Mutex;
use opcua::types::{
    Argument, LocalizedText, NodeId, ObjectTypeId, QualifiedName, StatusCode, Variant,
};
use tokio::sync::{Notify, mpsc, oneshot};
use tracing::{info, warn};
use uadp::Fields;

use crate::address;
use crate::argument_types::ArgumentTypes;
use crate::layout::Shape;
use crate::nodes::SpaceManager;
use crate::programs::Programs;
use crate::structures::Structure;
use crate::value;

/// The Methods there are, by their nodes.
pub(crate) type Table = Mutex<HashMap<NodeId, Callable>>;

/// A call as a client finds it.
#[derive(Debug, Clone)]
pub(crate) struct Callable {
    topic: TopicId,
    description: Arc<CallDescription>,
}

/// The way of clients to [`Methods`].
#[derive(Debug, Clone)]
pub(crate) struct Questions {
    sender: mpsc::Sender<Question>,
    given_up: Arc<Notify>,
}

/// The other end of [`Questions`].
#[derive(Debug)]
pub(crate) struct Heard {
    questions: mpsc::Receiver<Question>,
    /// Of one or more that were handed on nobody waits for the answer any longer.
    given_up: Arc<Notify>,
}

/// A request of a client.
#[derive(Debug)]
struct Question {
    topic: TopicId,
    block: Bytes,
    answer: oneshot::Sender<Answered<Bytes>>,
}

/// What a client waits for; [`Methods`] is told when it does no longer.
struct Waiting {
    answered: oneshot::Receiver<Answered<Bytes>>,
    given_up: Arc<Notify>,
    over: bool,
}

impl Drop for Waiting {
    fn drop(&mut self) {
        if !self.over {
            self.answered.close();
            self.given_up.notify_one();
        }
    }
}

/// Shows the calls of other spaces, and hands on what clients ask them.
pub(crate) struct Methods {
    manager: Arc<SpaceManager>,
    mapping: Arc<Mapping>,
    heard: Heard,
    shown: HashMap<TopicId, NodeId>,
    /// Calls without a Method, since something else has their node.
    refused: HashMap<TopicId, Arc<CallDescription>>,
    /// How many Methods are in each object, or in one in it.
    objects: HashMap<NodeId, usize>,
    /// The objects around each Method, the outermost first.
    around: HashMap<TopicId, Vec<NodeId>>,
    types: ArgumentTypes,
    /// Actions, as Programs beside their Methods.
    programs: Programs,
    asked: HashMap<AskId, oneshot::Sender<Answered<Bytes>>>,
    /// Those whose clients wait no longer, to be told.
    given_up: VecDeque<AskId>,
    next: u64,
    told_full: bool,
}

/// What clients want.
pub(crate) enum Wish {
    /// An answer.
    Ask {
        ask: AskId,
        topic: TopicId,
        request: Bytes,
        timeout: Duration,
    },
    /// No answer any longer.
    GiveUp(AskId),
}

/// The calls that another mapping has under another node, without a Method in between.
pub(crate) struct Moved(Vec<(TopicId, Arc<CallDescription>)>);

/// What the arguments of a client come to.
pub(crate) enum Refused {
    /// Some are not of their types: a status for each.
    Arguments(Vec<StatusCode>),
    /// Nothing can be asked.
    Status(StatusCode),
    /// It was asked, and there is no response.
    Asked(AskError),
}

impl Methods {
    pub(crate) fn new(
        (manager, subscriptions): (Arc<SpaceManager>, Arc<SubscriptionCache>),
        mapping: &Arc<Mapping>,
        (heard, structures): (Heard, &[Structure]),
    ) -> Self {
        let mut types = ArgumentTypes::default();
        types.set_variables(structures);
        address::add_folder(
            &address::calls_folder(),
            "Calls",
            address::root(),
            &mut manager.address_space().write(),
        );
        Self {
            programs: Programs::new(Arc::clone(&manager), subscriptions),
            manager,
            mapping: Arc::clone(mapping),
            heard,
            shown: HashMap::new(),
            refused: HashMap::new(),
            objects: HashMap::new(),
            around: HashMap::new(),
            types,
            asked: HashMap::new(),
            given_up: VecDeque::new(),
            next: 0,
            told_full: false,
        }
    }

    /// Shows a call, in the place of what it was. The parts of an action are Methods too, and together a Program.
    pub(crate) fn known(&mut self, topic: TopicId, description: &Arc<CallDescription>) {
        self.show(topic, description);
        self.programs.known(topic, description, &self.types);
    }

    fn show(&mut self, topic: TopicId, description: &Arc<CallDescription>) {
        self.remove(topic);
        if self.shown.len() + self.refused.len() >= MOST_METHODS {
            self.tell_full();
            return;
        }
        let node = self.node(topic);
        let Some(around) = self.insert(&node, (topic, description)) else {
            warn!(%topic, %node, "the call is shown as no Method: there is a node of that id already");
            self.refused.insert(topic, Arc::clone(description));
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
        &mut self,
        node: &NodeId,
        (topic, description): (TopicId, &Arc<CallDescription>),
    ) -> Option<Vec<NodeId>> {
        let mut address_space = self.manager.address_space().write();
        if address_space.node_exists(node) {
            return None;
        }
        let namespace = topic.namespace.get();
        let mut served = self.manager.inner().served_namespaces();
        // The TypeIds of its values are in that namespace, which means another one to a client else.
        if served.any(|(index, _)| index == namespace) {
            self.types.add(&mut address_space, (topic, description));
        }
        let around = add(&mut address_space, node, (topic, description), &self.types);
        drop(address_space);
        let callable = Callable::new(topic, description);
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
            .unwrap_or_else(|| address::unmapped_call(topic))
    }

    /// Takes a call away. What was asked is still answered.
    pub(crate) fn gone(&mut self, topic: TopicId) {
        self.programs.gone(topic);
        self.remove(topic);
    }

    /// What an action reports of one of its goals.
    pub(crate) fn reported(&self, topic: TopicId, block: &[u8]) {
        self.programs.reported(topic, block);
    }

    fn remove(&mut self, topic: TopicId) {
        self.refused.remove(&topic);
        let Some(node) = self.shown.remove(&topic) else {
            return;
        };
        self.manager.inner().methods().lock().remove(&node);
        let mut address_space = self.manager.address_space().write();
        for arguments in ["InputArguments", "OutputArguments"] {
            drop(address_space.delete(&arguments_node(&node, arguments), true));
        }
        drop(address_space.delete(&node, true));
        self.types.remove(&mut address_space, topic);
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

    /// Takes the Methods out that another mapping has under another node: a variable may have theirs.
    pub(crate) fn take_moved(&mut self, mapping: &Arc<Mapping>) -> Moved {
        self.mapping = Arc::clone(mapping);
        let moved = self
            .shown
            .iter()
            .filter(|(topic, node)| self.node(**topic) != **node);
        let callable = |(topic, node): (&TopicId, &NodeId)| {
            let methods = self.manager.inner().methods().lock();
            Some((*topic, Arc::clone(&methods.get(node)?.description)))
        };
        let mut moved: Vec<_> = moved.filter_map(callable).collect();
        for (topic, _) in &moved {
            self.remove(*topic);
        }
        moved.extend(self.refused.drain());
        Moved(moved)
    }

    /// Puts them in again, beside variables of these DataTypes.
    pub(crate) fn put(&mut self, Moved(moved): Moved, structures: &[Structure]) {
        self.types.set_variables(structures);
        for (topic, description) in moved {
            self.show(topic, &description);
        }
    }

    /// What a client wants next. Cancel-safe.
    pub(crate) async fn next(&mut self) -> Wish {
        loop {
            if let Some(ask) = self.given_up.pop_front() {
                return Wish::GiveUp(ask);
            }
            tokio::select! {
                Some(question) = self.heard.questions.recv() => {
                    // Whoever has given up meanwhile has not asked.
                    if !question.answer.is_closed() {
                        return self.ask(question);
                    }
                }
                () = self.heard.given_up.notified() => {
                    let given_up = self.asked.extract_if(|_, answer| answer.is_closed());
                    self.given_up.extend(given_up.map(|(ask, _)| ask));
                }
            }
        }
    }

    fn ask(&mut self, question: Question) -> Wish {
        let Question {
            topic,
            block,
            answer,
        } = question;
        let ask = AskId(self.next);
        self.next = self.next.wrapping_add(1);
        self.asked.insert(ask, answer);
        let timeout = self
            .mapping
            .call(topic)
            .map_or(TIMEOUT, |call| call.timeout);
        Wish::Ask {
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

impl Questions {
    /// Both ends.
    pub(crate) fn channel() -> (Self, Heard) {
        let (sender, questions) = mpsc::channel(MOST_QUESTIONS);
        let given_up = Arc::<Notify>::default();
        let heard = Heard {
            questions,
            given_up: Arc::clone(&given_up),
        };
        (Self { sender, given_up }, heard)
    }
}

impl Waiting {
    /// The answer. It is given up when the client is gone, for which is looked from time to time: the library goes on with the
    /// requests of a connection that is lost.
    async fn answer(mut self, gone: impl Fn() -> bool) -> Result<Answered<Bytes>, StatusCode> {
        let answer = loop {
            match tokio::time::timeout(LOOK_AT_CLIENT, &mut self.answered).await {
                Ok(answer) => break answer.map_err(|_| StatusCode::BadShutdown),
                Err(_) if gone() => return Err(StatusCode::BadSessionClosed),
                Err(_) => {}
            }
        };
        self.over = true;
        answer
    }
}

impl Callable {
    pub(crate) fn new(topic: TopicId, description: &Arc<CallDescription>) -> Self {
        Self {
            topic,
            description: Arc::clone(description),
        }
    }

    pub(crate) const fn topic(&self) -> TopicId {
        self.topic
    }

    pub(crate) fn description(&self) -> &CallDescription {
        &self.description
    }

    /// Asks with those arguments, and gives what comes back. Given up when it is dropped, or when the client is gone.
    pub(crate) async fn call(
        &self,
        arguments: &[Variant],
        questions: &Questions,
        gone: impl Fn() -> bool,
    ) -> Result<Vec<Variant>, Refused> {
        let block = self.block(arguments)?;
        let (answer, answered) = oneshot::channel();
        let question = Question {
            topic: self.topic,
            block,
            answer,
        };
        let waiting = Waiting {
            answered,
            given_up: Arc::clone(&questions.given_up),
            over: false,
        };
        questions
            .sender
            .try_send(question)
            .map_err(|_| Refused::Status(StatusCode::BadTooManyOperations))?;
        let answer = waiting.answer(gone).await.map_err(Refused::Status)?;
        let response = answer.map_err(Refused::Asked)?;
        let fields = Fields::parse(&response);
        let fields = fields.map_err(|_| Refused::Status(StatusCode::BadDecodingError))?;
        let outputs = fields.map(|field| field.map(|field| value::from_field(&field)));
        outputs
            .collect::<Result<_, _>>()
            .map_err(|_| Refused::Status(StatusCode::BadDecodingError))
    }

    /// The request. Arguments that all have values of their own may be left out all together.
    fn block(&self, arguments: &[Variant]) -> Result<Bytes, Refused> {
        let request = &self.description.request;
        let left_out = arguments.is_empty() && self.description.may_be_empty();
        if arguments.len() < request.len() && !left_out {
            return Err(Refused::Status(StatusCode::BadArgumentsMissing));
        }
        let block = value::fields_block(arguments).map_err(Refused::Status)?;
        let fields = Fields::parse(&block);
        let fields = fields.map_err(|_| Refused::Status(StatusCode::BadInvalidArgument))?;
        let statuses = fields.zip(request).map(|(value, field)| match value {
            Ok(value) if Shape::of(field).fits(&value) => StatusCode::Good,
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

/// Puts the Method in, and the objects around it that are not there. Gives the objects, the outermost first.
fn add(
    address_space: &mut AddressSpace,
    node: &NodeId,
    (topic, description): (TopicId, &CallDescription),
    types: &ArgumentTypes,
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
    let about = match &description.about[..] {
        "" => topic.to_string(),
        about => format!("{topic}: {about}"),
    };
    let names = QualifiedName::new(node.namespace, last);
    let mut method = MethodBuilder::new(node, names, LocalizedText::from(last))
        .description(LocalizedText::from(about.as_str()))
        .component_of(object)
        .executable(true)
        .user_executable(true);
    if !description.request.is_empty() {
        let arguments = arguments(topic, &description.request, types);
        let id = arguments_node(node, "InputArguments");
        method = method.input_args(address_space, &id, &arguments);
    }
    if !description.response.is_empty() {
        let arguments = arguments(topic, &description.response, types);
        let id = arguments_node(node, "OutputArguments");
        method = method.output_args(address_space, &id, &arguments);
    }
    method.insert(address_space);
    around
}

pub(crate) fn arguments(
    topic: TopicId,
    fields: &[CallField],
    types: &ArgumentTypes,
) -> Vec<Argument> {
    let argument = |field: &CallField| Argument {
        name: field.name.as_str().into(),
        data_type: types.data_type(topic, field),
        value_rank: Shape::of(field).value_rank(),
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
const MOST_QUESTIONS: usize = 256;
/// How often it is looked whether a client that waits is still there.
const LOOK_AT_CLIENT: Duration = Duration::from_secs(1);
/// How long an answer is waited for where the mapping says nothing.
const TIMEOUT: Duration = Duration::from_secs(30);
