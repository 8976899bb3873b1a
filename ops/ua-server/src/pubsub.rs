//! The PubSub configuration in the address space (OPC 10000-14, 9.1). The object PublishSubscribe
//! has the connection of the program, a WriterGroup for each namespace it writes, a ReaderGroup for
//! each namespace it reads, and a DataSetWriter or DataSetReader for each variable of the mapping.
//! The components have states and counters, and a file contains the whole configuration.
//!
//! A single lock guards the states. The address spaces are written in turn while it is held.

mod counts;
mod file;
mod insert;
mod readers;
mod states;
mod tree;

use std::collections::{HashMap, HashSet};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, OnceLock};

use bridge_node::{Counters, Router};
use mappings::{Mapping, SpaceId, TopicId};
use opcua::server::SubscriptionCache;
use opcua::server::address_space::AddressSpace;
use opcua::server::node_manager::memory::CoreNodeManager;
use opcua::sync::{Mutex, RwLock};
use opcua::types::{
    AttributeId, DataValue, MethodId, NodeId, ObjectId, StatusCode, TimestampsToReturn, UAString,
    VariableId, Variant,
};
use plant_opcua::file::Handles;
use plant_opcua::server::{CoreMethod, MethodHandler, MethodRefusal, method};
use tokio::sync::Notify;
use tracing::info;

use self::counts::{Counts, LiveCounts, PubSubCounters, Totals};
use self::file::Content;
use self::insert::NodesToAdd;
pub(crate) use self::readers::Readers;
pub(crate) use self::states::PubSubNodeState;
use self::states::{StateChange, States};
use crate::layout::Layout;
use crate::nodes::SpaceManager;

/// The configuration in the address spaces.
pub(crate) struct PubSubNodes {
    inner: Mutex<Inner>,
    /// True while the nodes of readers do not exist, because no client has looked at them.
    has_no_readers: AtomicBool,
    /// The topics with a writer or reader that is off.
    off: RwLock<HashSet<TopicId>>,
    /// Notified when a client has enabled or disabled a component.
    called: Notify,
    /// Set when the nodes exist.
    places: OnceLock<PubSubManagers>,
    /// The open handles of the configuration file. No other lock is held when this lock is taken.
    file: Mutex<Handles>,
}

/// Returns the values of the object PublishSubscribe that do not change.
pub(crate) fn capabilities() -> Vec<(VariableId, Variant)> {
    let profiles: Vec<UAString> = insert::PROFILES.into_iter().map(UAString::from).collect();
    vec![(
        VariableId::PublishSubscribe_SupportedTransportProfiles,
        profiles.into(),
    )]
}

/// The node managers of the nodes, and their subscriptions.
#[derive(Clone)]
pub(crate) struct PubSubManagers {
    /// The node manager of the object PublishSubscribe itself.
    pub(crate) core: Option<Arc<CoreNodeManager>>,
    pub(crate) space: Arc<SpaceManager>,
    pub(crate) subscriptions: Arc<SubscriptionCache>,
}

#[derive(Default)]
struct Inner {
    states: States,
    parts: Vec<Part>,
    /// The methods of components by their nodes.
    methods: HashMap<NodeId, (usize, Ask)>,
    /// The nodes of all components.
    made: Vec<NodeId>,
    /// Topics that were switched on or off and not yet returned by [`PubSubNodes::switched`].
    switched: HashMap<TopicId, bool>,
    /// The configuration as a file.
    content: Content,
    /// The configuration, while the nodes of its readers do not exist.
    unseen: Option<(Arc<Mapping>, Arc<Layout>)>,
}

impl Inner {
    /// Returns the components that clients have disabled.
    fn disabled(&self) -> HashSet<Kind> {
        let parts = self.parts.iter().enumerate();
        let disabled = parts.filter(|(at, _)| !self.states.is_enabled(*at));
        disabled.map(|(_, part)| part.kind).collect()
    }
}

/// A component of the configuration.
struct Part {
    kind: Kind,
    parent: Option<usize>,
    state: NodeId,
    diagnostics: Option<PubSubCounters>,
    /// The numbers of writers and readers below a component; `None` for components that do not show
    /// them.
    live: Option<LiveCounts>,
    counts: Counts,
}

/// The kind of a component.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
enum Kind {
    Whole,
    Connection,
    Writers(u16),
    Readers(SpaceId, u16),
    Writer(TopicId),
    Reader(TopicId),
}

/// A method call for a component.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Ask {
    Enable,
    Disable,
    Reset,
}

impl PubSubNodes {
    pub(crate) fn new() -> Self {
        Self {
            inner: Mutex::default(),
            has_no_readers: AtomicBool::new(true),
            off: RwLock::default(),
            called: Notify::new(),
            places: OnceLock::new(),
            file: Mutex::default(),
        }
    }

    /// Returns the methods of the object PublishSubscribe itself.
    pub(crate) fn methods(self: &Arc<Self>) -> Vec<CoreMethod> {
        let status: NodeId = ObjectId::PublishSubscribe_Status.into();
        let diagnostics: NodeId = ObjectId::PublishSubscribe_Diagnostics.into();
        let asked = |ask| {
            let whole = Arc::clone(self);
            let handler: Arc<dyn MethodHandler> = method(move |request| {
                let done = whole.ask((0, ask), &request.caller.user);
                done.map(|()| Vec::new()).map_err(MethodRefusal::Status)
            });
            handler
        };
        let enable: [NodeId; 2] = [
            MethodId::PublishSubscribe_Status_Enable.into(),
            MethodId::PubSubStatusType_Enable.into(),
        ];
        let disable: [NodeId; 2] = [
            MethodId::PublishSubscribe_Status_Disable.into(),
            MethodId::PubSubStatusType_Disable.into(),
        ];
        let reset: [NodeId; 2] = [
            MethodId::PublishSubscribe_Diagnostics_Reset.into(),
            MethodId::PubSubDiagnosticsType_Reset.into(),
        ];
        let mut methods = vec![
            CoreMethod::new(status.clone(), enable, "Enable", asked(Ask::Enable)),
            CoreMethod::new(status, disable, "Disable", asked(Ask::Disable)),
            CoreMethod::new(diagnostics, reset, "Reset", asked(Ask::Reset)),
        ];
        methods.extend(self.file_methods());
        methods
    }

    /// Sets the node managers, adds the missing methods of PublishSubscribe, and makes the methods
    /// for writing the file not executable.
    pub(crate) fn stand(&self, places: PubSubManagers) {
        if let Some(core) = &places.core {
            let mut address_space = core.address_space().write();
            for (method, name) in WHOLE {
                tree::core_method(&mut address_space, method, name);
            }
            for method in file::OF_WRITERS {
                tree::nobody_executes(&mut address_space, method);
            }
        }
        drop(self.places.set(places));
        self.write(LiveCounts::of_the_whole().zeros());
    }

    /// Shows the configuration of a mapping, replacing the previous configuration. Disabled
    /// components that still exist stay disabled.
    pub(crate) fn show(&self, mapping: &Arc<Mapping>, layout: &Arc<Layout>) {
        let Some(places) = self.places.get() else {
            return;
        };
        let mut inner = self.inner.lock();
        let disabled = inner.disabled();
        {
            let mut address_space = places.space.address_space().write();
            for node in inner.made.drain(..) {
                drop(address_space.delete(&node, true));
            }
            let switched = std::mem::take(&mut inner.switched);
            let is_unseen = self.has_no_readers.load(Ordering::Relaxed);
            let wanted = if is_unseen {
                NodesToAdd::WithoutReaders
            } else {
                NodesToAdd::All
            };
            *inner = Inner {
                content: Content::of(mapping, layout),
                ..insert::all(mapping, layout, &mut address_space, wanted)
            };
            inner.unseen = is_unseen.then(|| (Arc::clone(mapping), Arc::clone(layout)));
            inner.switched = switched;
        }
        let again: Vec<usize> = inner
            .parts
            .iter()
            .enumerate()
            .filter(|(_, part)| disabled.contains(&part.kind))
            .map(|(at, _)| at)
            .collect();
        for at in again {
            inner.states.enable(at, false);
        }
        self.settle(&mut inner);
        self.show_states(&inner);
        drop(inner);
        self.show_file();
    }

    /// Adds the nodes of the readers if they do not exist and one of `nodes` is the connection, a
    /// group of readers, or a node below it. Cells have many readers, and most clients look
    /// at none.
    pub(crate) fn look_for_readers<'n>(&self, mut nodes: impl Iterator<Item = &'n NodeId>) {
        if !self.has_no_readers.load(Ordering::Relaxed) || !nodes.any(insert::leads_to_readers) {
            return;
        }
        let Some(places) = self.places.get() else {
            return;
        };
        let mut inner = self.inner.lock();
        let Some((mapping, layout)) = inner.unseen.take() else {
            return;
        };
        {
            let mut address_space = places.space.address_space().write();
            let readers = insert::all(&mapping, &layout, &mut address_space, NodesToAdd::Readers);
            inner.made.extend(readers.made);
        }
        let diagnostics = inner
            .parts
            .iter()
            .filter_map(|part| part.diagnostics.as_ref());
        let shown = diagnostics.flat_map(PubSubCounters::shown).collect();
        self.write(shown);
        self.show_states(&inner);
        self.has_no_readers.store(false, Ordering::Relaxed);
    }

    /// Calls a method of a component. Returns `None` if the node is no such method.
    pub(crate) fn call(&self, method: &NodeId, user: &str) -> Option<StatusCode> {
        let asked = self.inner.lock().methods.get(method).copied()?;
        Some(self.ask(asked, user).err().unwrap_or(StatusCode::Good))
    }

    fn ask(&self, (at, ask): (usize, Ask), user: &str) -> Result<(), StatusCode> {
        let mut inner = self.inner.lock();
        let inner = &mut *inner;
        let part = inner
            .parts
            .get_mut(at)
            .ok_or(StatusCode::BadNodeIdUnknown)?;
        let kind = part.kind;
        match ask {
            Ask::Enable | Ask::Disable => {
                if !inner.states.enable(at, ask == Ask::Enable) {
                    return Err(StatusCode::BadInvalidState);
                }
                info!(
                    ?kind,
                    user,
                    ?ask,
                    "a user changed the state of a PubSub component"
                );
                self.settle(inner);
            }
            Ask::Reset => {
                let counts = part.counts;
                if let Some(diagnostics) = &mut part.diagnostics {
                    diagnostics.reset(counts);
                }
                self.show_counts(inner);
            }
        }
        Ok(())
    }

    /// Waits until a component was enabled or disabled. Cancel-safe.
    pub(crate) async fn called(&self) {
        self.called.notified().await;
    }

    /// Returns the topics that were switched on or off after the previous call.
    pub(crate) fn switched(&self) -> Vec<(TopicId, bool)> {
        self.inner.lock().switched.drain().collect()
    }

    /// Returns true if the writer or reader of a topic is off.
    pub(crate) fn is_off(&self, topic: TopicId) -> bool {
        self.off.read().contains(&topic)
    }

    /// Updates the states of the readers and the counters of each topic.
    pub(crate) fn look(&self, readers: &Readers, router: &Router) {
        self.tidy_file();
        let counted: HashMap<TopicId, &Counters> = router.topics().collect();
        let counts = |topic| {
            let counters = counted.get(&topic)?;
            Some(Counts::of(counters, readers.count_ignored(topic)))
        };
        let mut inner = self.inner.lock();
        let inner = &mut *inner;
        let mut sums: Vec<Counts> = vec![Counts::default(); inner.parts.len()];
        for (at, part) in inner.parts.iter().enumerate().rev() {
            match part.kind {
                Kind::Writer(topic) | Kind::Reader(topic) => {
                    let counts = counts(topic).unwrap_or_default();
                    if let Some(sum) = sums.get_mut(at) {
                        sum.add(counts);
                    }
                }
                Kind::Whole | Kind::Connection | Kind::Writers(_) | Kind::Readers(..) => {}
            }
            if let Kind::Reader(topic) = part.kind {
                inner.states.set_own(at, readers.of(topic));
            }
            let sum = sums.get(at).copied().unwrap_or_default();
            if let Some(above) = part.parent.and_then(|parent| sums.get_mut(parent)) {
                above.add(sum);
            }
        }
        for (part, sum) in inner.parts.iter_mut().zip(sums) {
            part.counts = sum;
        }
        self.settle(inner);
        self.show_counts(inner);
    }

    /// Computes all states, then shows and applies the changes.
    fn settle(&self, inner: &mut Inner) {
        let changes = inner.states.settle();
        if changes.is_empty() {
            return;
        }
        let mut off = self.off.write();
        let mut called = false;
        for change in &changes {
            let Some(part) = inner.parts.get_mut(change.at) else {
                continue;
            };
            if let Some(diagnostics) = &mut part.diagnostics {
                diagnostics.note(change);
            }
            let (Kind::Writer(topic) | Kind::Reader(topic)) = part.kind else {
                continue;
            };
            let (was, is) = (is_on(change.was), is_on(change.is));
            if was != is {
                called = true;
                inner.switched.insert(topic, is);
                if is {
                    off.remove(&topic);
                } else {
                    off.insert(topic);
                }
            }
        }
        drop(off);
        let shown = changes.iter().filter_map(|StateChange { at, is, .. }| {
            let part = inner.parts.get(*at)?;
            Some((part.state.clone(), Variant::Int32(*is as i32)))
        });
        self.write(shown.collect());
        if called {
            self.called.notify_one();
        }
    }

    fn show_states(&self, inner: &Inner) {
        let states = inner.parts.iter().enumerate();
        let states = states.map(|(at, part)| {
            let state = Variant::Int32(inner.states.of(at) as i32);
            (part.state.clone(), state)
        });
        self.write(states.collect());
    }

    fn show_counts(&self, inner: &mut Inner) {
        let mut below: Vec<(Totals, bool)> = vec![(Totals::default(), false); inner.parts.len()];
        let mut changes = Vec::new();
        for at in (0..inner.parts.len()).rev() {
            let operational = u16::from(inner.states.of(at) == PubSubNodeState::Operational);
            let (mut numbers, errors) = below.get(at).copied().unwrap_or_default();
            let Some(part) = inner.parts.get_mut(at) else {
                continue;
            };
            let mut any = errors;
            if let Some(diagnostics) = &mut part.diagnostics {
                changes.extend(diagnostics.changes(part.counts, errors));
                any |= diagnostics.has_errors();
            }
            match part.kind {
                Kind::Writer(_) => numbers.writers = [1, operational],
                Kind::Reader(_) => numbers.readers = [1, operational],
                Kind::Whole | Kind::Connection | Kind::Writers(_) | Kind::Readers(..) => {}
            }
            if let Some(live) = &mut part.live {
                changes.extend(live.changes(numbers));
            }
            if let Some((all, failed)) = part.parent.and_then(|at| below.get_mut(at)) {
                all.add(numbers);
                *failed |= any;
            }
        }
        self.write(changes);
    }

    /// Shows values of variables of the core namespace and of the own namespace.
    fn write(&self, values: Vec<(NodeId, Variant)>) {
        let Some(places) = self.places.get() else {
            return;
        };
        let subscriptions = &places.subscriptions;
        let (core, own): (Vec<_>, Vec<_>) = values
            .into_iter()
            .partition(|(node, _)| node.namespace == 0);
        write(places.space.address_space(), subscriptions, own);
        if let Some(manager) = &places.core {
            write(manager.address_space(), subscriptions, core);
        }
    }
}

/// Returns true if messages are sent or received in that state.
const fn is_on(state: PubSubNodeState) -> bool {
    !matches!(state, PubSubNodeState::Disabled | PubSubNodeState::Paused)
}

fn write(
    address_space: &RwLock<AddressSpace>,
    subscriptions: &SubscriptionCache,
    values: Vec<(NodeId, Variant)>,
) {
    if values.is_empty() {
        return;
    }
    let mut address_space = address_space.write();
    let mut shown = Vec::with_capacity(values.len());
    for (node, value) in values {
        if let Some(opcua::nodes::NodeType::Variable(variable)) = address_space.find_mut(&node) {
            variable.set_data_value(DataValue::new_now(value));
            shown.push(node);
        }
    }
    subscriptions.maybe_notify(
        shown.iter().map(|node| (node, AttributeId::Value)),
        |node, attribute, range, encoding| {
            let node = address_space.find(node)?.as_node();
            node.get_attribute(TimestampsToReturn::Both, attribute, range, encoding)
        },
    );
}

/// Optional methods of the object PublishSubscribe that the library omits.
const WHOLE: [(MethodId, &str); 2] = [
    (MethodId::PublishSubscribe_Status_Enable, "Enable"),
    (MethodId::PublishSubscribe_Status_Disable, "Disable"),
];
