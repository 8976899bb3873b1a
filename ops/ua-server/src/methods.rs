//! Calls of other spaces as Methods. A call of a client is forwarded to its executor.
//!
//! A Method is placed in the object that the dots of its name denote (`Conveyor.Switch`), below the
//! folder `Calls`. The Method is removed with its call.

use std::collections::{HashMap, VecDeque};
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use bridge_node::{AskId, CallDescription, CallResponse};
use bytes::Bytes;
use mappings::{Mapping, TopicId};
use opcua::nodes::{MethodBuilder, ObjectBuilder};
use opcua::server::SubscriptionCache;
use opcua::server::address_space::AddressSpace;
use opcua::types::{LocalizedText, NodeId, ObjectTypeId, QualifiedName};
use tokio::sync::oneshot;
use tracing::{info, warn};

use crate::address;
use crate::argument_types::ArgumentTypes;
use crate::asking::{Callable, ClientQuestion, QuestionReceiver};
use crate::nodes::SpaceManager;
use crate::programs::Programs;
use crate::structures::Structure;

/// Shows the calls of other spaces and forwards the requests of clients.
pub(crate) struct Methods {
    manager: Arc<SpaceManager>,
    mapping: Arc<Mapping>,
    heard: QuestionReceiver,
    shown: HashMap<TopicId, NodeId>,
    /// Calls without a Method, because another node has their NodeId.
    refused: HashMap<TopicId, Arc<CallDescription>>,
    /// Number of Methods in each object, including nested objects.
    objects: HashMap<NodeId, usize>,
    /// The parent objects of each Method, outermost first.
    around: HashMap<TopicId, Vec<NodeId>>,
    types: ArgumentTypes,
    /// Actions, as Programs beside their Methods.
    programs: Programs,
    asked: HashMap<AskId, oneshot::Sender<CallResponse<Bytes>>>,
    /// Requests that clients have abandoned, to be reported.
    given_up: VecDeque<AskId>,
    next: u64,
    told_full: bool,
}

/// A request of a client, or its end.
pub(crate) enum Wish {
    /// The client requests an answer.
    Ask {
        ask: AskId,
        topic: TopicId,
        request: Bytes,
        timeout: Duration,
    },
    /// The client has abandoned its request.
    GiveUp(AskId),
}

/// The calls that have another node in the new mapping. They have no Method until they are added
/// again.
pub(crate) struct Moved(Vec<(TopicId, Arc<CallDescription>)>);

impl Methods {
    pub(crate) fn new(
        (manager, subscriptions): (Arc<SpaceManager>, Arc<SubscriptionCache>),
        mapping: &Arc<Mapping>,
        (heard, structures): (QuestionReceiver, &[Structure]),
        root: &Path,
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
            programs: Programs::new(Arc::clone(&manager), subscriptions, root),
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

    /// Shows a call, replacing its previous version. The parts of an action are Methods too, and
    /// together a Program.
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
            warn!(%topic, name = description.name, %node, "cannot show the call as a Method: its NodeId belongs to another node, or to a Method with other arguments");
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
            warn!(
                "more than {MOST_METHODS} calls of the space: the others are not shown as Methods"
            );
        }
    }

    /// Adds a Method, unless its node is in use. Returns the parent objects of the Method.
    fn insert(
        &mut self,
        node: &NodeId,
        (topic, description): (TopicId, &Arc<CallDescription>),
    ) -> Option<Vec<NodeId>> {
        let mut address_space = self.manager.address_space().write();
        let nodesets = self.manager.inner().nodesets();
        let counts = (description.request.len(), description.response.len());
        let of_nodeset = nodesets.suits(&address_space, node, counts);
        if of_nodeset.is_none() && address_space.node_exists(node) || of_nodeset == Some(false) {
            return None;
        }
        let namespace = topic.namespace.get();
        let mut served = self.manager.inner().served_namespaces();
        // The TypeIds of its values are in that namespace. A client would map them to another
        // namespace otherwise.
        if served.any(|(index, _)| index == namespace) {
            self.types.add(&mut address_space, (topic, description));
        }
        let around = if nodesets.let_call(&mut address_space, node, true) {
            Vec::new()
        } else {
            add(&mut address_space, node, (topic, description), &self.types)
        };
        drop(address_space);
        let callable = Callable::new(topic, description);
        let mut methods = self.manager.inner().callables().methods().lock();
        methods.insert(node.clone(), callable);
        Some(around)
    }

    /// Returns the node of a call. A mapped call has the node of the mapping, if the server has its
    /// namespace.
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

    /// Removes a call. Pending requests are still answered.
    pub(crate) fn gone(&mut self, topic: TopicId) {
        self.programs.gone(topic);
        self.remove(topic);
    }

    /// Handles a report of an action about one of its goals.
    pub(crate) fn reported(&self, topic: TopicId, block: &[u8]) {
        self.programs.reported(topic, block);
    }

    /// See [`Programs::end`].
    pub(crate) fn end(&self) {
        self.programs.end();
    }

    /// See [`Programs::pending`].
    pub(crate) fn pending(&self) -> Vec<String> {
        self.programs.pending()
    }

    fn remove(&mut self, topic: TopicId) {
        self.refused.remove(&topic);
        let Some(node) = self.shown.remove(&topic) else {
            return;
        };
        self.manager
            .inner()
            .callables()
            .methods()
            .lock()
            .remove(&node);
        let mut address_space = self.manager.address_space().write();
        let nodesets = self.manager.inner().nodesets();
        if !nodesets.let_call(&mut address_space, &node, false) {
            for arguments in ["InputArguments", "OutputArguments"] {
                drop(address_space.delete(&arguments_node(&node, arguments), true));
            }
            drop(address_space.delete(&node, true));
        }
        self.types.remove(&mut address_space, topic);
        // Objects without any Method are removed.
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

    /// Removes the Methods that have another node in the new mapping, because a variable may have
    /// their node.
    pub(crate) fn take_moved(&mut self, mapping: &Arc<Mapping>) -> Moved {
        self.mapping = Arc::clone(mapping);
        let moved = self
            .shown
            .iter()
            .filter(|(topic, node)| self.node(**topic) != **node);
        let callable = |(topic, node): (&TopicId, &NodeId)| {
            let methods = self.manager.inner().callables().methods().lock();
            Some((*topic, Arc::clone(methods.get(node)?.description())))
        };
        let mut moved: Vec<_> = moved.filter_map(callable).collect();
        for (topic, _) in &moved {
            self.remove(*topic);
        }
        moved.extend(self.refused.drain());
        Moved(moved)
    }

    /// Adds the moved calls again, beside variables of these DataTypes.
    pub(crate) fn put(&mut self, Moved(moved): Moved, structures: &[Structure]) {
        self.types.set_variables(structures);
        for (topic, description) in moved {
            self.show(topic, &description);
        }
    }

    /// Waits for the next request of a client. Cancel-safe.
    pub(crate) async fn next(&mut self) -> Wish {
        loop {
            if let Some(ask) = self.given_up.pop_front() {
                return Wish::GiveUp(ask);
            }
            tokio::select! {
                Some(question) = self.heard.questions.recv() => {
                    // Requests that were abandoned in the meantime are dropped.
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

    fn ask(&mut self, question: ClientQuestion) -> Wish {
        let ClientQuestion {
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

    pub(crate) fn answered(&mut self, ask: AskId, answer: CallResponse<Bytes>) {
        if let Some(asked) = self.asked.remove(&ask) {
            // The client may be lost.
            drop(asked.send(answer));
        }
    }
}

/// Adds the Method and its missing parent objects. Returns the parent objects, outermost first.
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
        let arguments = types.arguments(topic, &description.request);
        let id = arguments_node(node, "InputArguments");
        method = method.input_args(address_space, &id, &arguments);
    }
    if !description.response.is_empty() {
        let arguments = types.arguments(topic, &description.response);
        let id = arguments_node(node, "OutputArguments");
        method = method.output_args(address_space, &id, &arguments);
    }
    method.insert(address_space);
    around
}

fn arguments_node(method: &NodeId, which: &str) -> NodeId {
    NodeId::new(
        address::calls_folder().namespace,
        format!("UaSpace.Calls.{method}.{which}"),
    )
}

/// Largest number of calls that are shown. The limit exists because every participant of the space
/// can announce calls.
const MOST_METHODS: usize = 4_096;
/// Largest number of objects around a Method.
const MOST_PARTS: usize = 8;
/// Time limit of a call without a limit in the mapping.
const TIMEOUT: Duration = Duration::from_secs(30);
