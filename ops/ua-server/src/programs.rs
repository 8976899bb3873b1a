//! Actions of other spaces as Programs (OPC 10000-10). A client starts a Program with a goal,
//! watches and halts it, without knowing goals and their ids.
//!
//! A Program has the dotted name of its action below the folder `Programs`. It exists while all
//! three calls of the action exist. A Program is Ready at first and after success, and Halted after
//! every other end. Other callers may send goals of the same action in the meantime; the Program
//! shows its own goals only.

mod nodes;
mod run;
mod unknown;

use std::collections::HashMap;
use std::path::Path;
use std::sync::Arc;

use bridge_node::{ActionFamily, CallDescription, CallRole};
use mappings::TopicId;
use opcua::server::SubscriptionCache;
use opcua::types::NodeId;
use tracing::{info, warn};

use self::nodes::ProgramNodes;
use self::run::Run;
use self::unknown::UnknownOutcomes;
use crate::address;
use crate::argument_types::ArgumentTypes;
use crate::asking::Callable;
use crate::nodes::SpaceManager;

/// Shows the actions of other spaces.
pub(crate) struct Programs {
    manager: Arc<SpaceManager>,
    subscriptions: Arc<SubscriptionCache>,
    /// The calls that are parts of actions.
    parts: HashMap<TopicId, Arc<CallDescription>>,
    /// The Programs, by the calls that send goals.
    shown: HashMap<TopicId, Shown>,
    /// The action of each feedback topic.
    feedback: HashMap<TopicId, TopicId>,
    /// The Programs that need a Reset.
    unknown: Arc<UnknownOutcomes>,
    told_full: bool,
}

struct Shown {
    run: Arc<Run>,
    /// The parent objects, outermost first.
    around: Vec<NodeId>,
    feedback: Option<TopicId>,
}

impl Programs {
    /// Creates the Programs. Programs that need a Reset are stored in a file below `root`.
    pub(crate) fn new(
        manager: Arc<SpaceManager>,
        subscriptions: Arc<SubscriptionCache>,
        root: &Path,
    ) -> Self {
        address::add_folder(
            &address::programs_folder(),
            "Programs",
            address::root(),
            &mut manager.address_space().write(),
        );
        Self {
            manager,
            subscriptions,
            parts: HashMap::new(),
            shown: HashMap::new(),
            feedback: HashMap::new(),
            unknown: Arc::new(UnknownOutcomes::open(root.join(UNKNOWN))),
            told_full: false,
        }
    }

    /// Registers a call. A call that is not a part of an action is ignored.
    pub(crate) fn known(
        &mut self,
        topic: TopicId,
        description: &Arc<CallDescription>,
        types: &ArgumentTypes,
    ) {
        if self.parts.get(&topic) == Some(description) {
            return;
        }
        self.gone(topic);
        let Some(goal) = goal_of(topic, description.role) else {
            return;
        };
        if self.parts.len() >= MOST_PARTS {
            if !std::mem::replace(&mut self.told_full, true) {
                warn!(
                    "more than {MOST_PARTS} calls of actions: the others are not shown as Programs"
                );
            }
            return;
        }
        self.parts.insert(topic, Arc::clone(description));
        self.show(goal, types);
    }

    fn show(&mut self, goal: TopicId, types: &ArgumentTypes) {
        let Some(description) = self.parts.get(&goal) else {
            return;
        };
        let CallRole::Goal(family) = description.role else {
            return;
        };
        let part = |id| {
            let topic = beside(goal, id)?;
            Some(Callable::new(topic, self.parts.get(&topic)?))
        };
        let ActionFamily { cancel, result, .. } = family;
        let (Some(cancel), Some(result)) = (part(cancel), part(result)) else {
            return;
        };
        let send = Callable::new(goal, description);
        let name = match &description.name[..] {
            "" => goal.to_string(),
            name => name.to_owned(),
        };
        let places = (Arc::clone(&self.manager), Arc::clone(&self.subscriptions));
        let described = (&**description, &**result.description());
        let (nodes, around) = ProgramNodes::insert(places, (goal, &name), described, types);
        let node = nodes.program();
        let feedback = beside(goal, family.feedback);
        let methods = nodes.methods();
        let calls = [send, cancel, result];
        let run = Run::new((name, goal), nodes, calls, &self.unknown);
        let inner = self.manager.inner();
        let sends = goal_node(goal, inner);
        let drive = |method| run.drive(method, inner.callables().questions(), sends.clone());
        let all = methods.map(|(node, method)| (node, drive(method)));
        inner.callables().programs().lock().extend(all);
        if let Some(feedback) = feedback {
            self.feedback.insert(feedback, goal);
        }
        info!(topic = %goal, %node, "shown as a Program");
        let shown = Shown {
            run,
            around,
            feedback,
        };
        self.shown.insert(goal, shown);
    }

    /// Removes a call and its Program. The current goal of the Program ends for its clients.
    pub(crate) fn gone(&mut self, topic: TopicId) {
        let Some(part) = self.parts.remove(&topic) else {
            return;
        };
        let Some(goal) = goal_of(topic, part.role) else {
            return;
        };
        let Some(shown) = self.shown.remove(&goal) else {
            return;
        };
        if let Some(feedback) = shown.feedback {
            self.feedback.remove(&feedback);
        }
        shown.run.leave(run::GONE);
        let nodes = shown.run.nodes();
        let mut programs = self.manager.inner().callables().programs().lock();
        for (method, _) in nodes.methods() {
            programs.remove(&method);
        }
        drop(programs);
        let taken = |object: &NodeId| {
            let mut others = self.shown.values();
            others.any(|other| other.around.contains(object))
        };
        let around = shown.around.iter().filter(|object| !taken(object));
        nodes.remove(&around.collect::<Vec<_>>());
    }

    /// Returns a line for each Program with a pending cancellation of its goal.
    pub(crate) fn pending(&self) -> Vec<String> {
        let all = self.shown.values();
        all.filter_map(|shown| shown.run.pending()).collect()
    }

    /// Ends all Programs when the server stops.
    pub(crate) fn end(&self) {
        for shown in self.shown.values() {
            shown.run.leave(run::ENDS);
        }
    }

    /// Shows the feedback of an action, if its goal belongs to a Program.
    pub(crate) fn reported(&self, topic: TopicId, block: &[u8]) {
        let goal = self.feedback.get(&topic);
        if let Some(shown) = goal.and_then(|goal| self.shown.get(goal)) {
            shown.run.reported(block);
        }
    }
}

/// Returns the node of the Method that sends goals. Clients with permission to call the Method may
/// control the Program.
fn goal_node(goal: TopicId, nodes: &crate::nodes::SpaceNodes) -> NodeId {
    let methods = nodes.callables().methods().lock();
    let mut all = methods.iter();
    let found = all.find(|(_, callable)| callable.topic() == goal);
    found.map_or_else(|| address::unmapped_call(goal), |(node, _)| node.clone())
}

/// Returns the call that sends the goals of the action to which a call belongs.
fn goal_of(topic: TopicId, role: CallRole) -> Option<TopicId> {
    match role {
        CallRole::Call => None,
        CallRole::Goal(_) => Some(topic),
        CallRole::Cancel { of } | CallRole::Result { of } => beside(topic, of),
    }
}

/// Returns the topic of another DataSetWriterId in the same namespace.
fn beside(topic: TopicId, id: u16) -> Option<TopicId> {
    let (space, namespace, _) = topic.triple();
    TopicId::new(space, namespace, id)
}

/// The file of the Programs that need a Reset.
const UNKNOWN: &str = "programs-to-reset";
/// Largest number of calls of actions. The limit exists because every participant of the space can
/// announce calls.
const MOST_PARTS: usize = 3 * 256;
