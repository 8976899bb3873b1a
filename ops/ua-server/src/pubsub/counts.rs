//! PubSubDiagnostics (OPC 10000-14, 9.1.11): the counters of a component, from the same numbers as
//! `/metrics`.

use bridge_node::{Counters, Reason};
use opcua::types::{
    DataTypeId, NodeId, ObjectTypeId, ReferenceTypeId, VariableId, VariableTypeId, Variant,
};

use super::states::{PubSubNodeState, StateCause, StateChange};
use super::tree::{At, BASIC, Tree};

/// The counters of a topic, or of all topics of a group.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(crate) struct Counts {
    /// Messages sent, including repetitions and keep-alives.
    pub(crate) sent: u64,
    /// Messages that could not be sent.
    pub(crate) failed: u64,
    /// Messages that could not be secured.
    pub(crate) unsealed: u64,
    /// Messages accepted.
    pub(crate) received: u64,
    /// Messages received and rejected because of faults.
    pub(crate) wrong: u64,
}

impl Counts {
    /// Returns the counters of a topic. `ignored` messages for disabled readers do not count as
    /// faults.
    pub(super) fn of(counters: &Counters, ignored: u64) -> Self {
        let dropped = |reasons: &[Reason]| -> u64 {
            reasons.iter().map(|reason| counters.dropped(*reason)).sum()
        };
        Self {
            sent: counters.sent + counters.repeated + counters.keep_alives,
            failed: dropped(&FAILED),
            unsealed: counters.dropped(Reason::NoKeys),
            received: counters.delivered,
            wrong: dropped(&WRONG).saturating_sub(ignored),
        }
    }

    pub(super) fn add(&mut self, other: Self) {
        self.sent += other.sent;
        self.failed += other.failed;
        self.unsealed += other.unsealed;
        self.received += other.received;
        self.wrong += other.wrong;
    }
}

/// A counter of the standard.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Counter {
    StateError,
    OperationalByMethod,
    OperationalByParent,
    OperationalFromError,
    PausedByParent,
    DisabledByMethod,
    Sent,
    FailedTransmissions,
    EncryptionErrors,
    Received,
    InvalidReceived,
    FailedMessages,
}

impl Counter {
    /// The counters of every component.
    pub(super) const OF_ALL: [Self; 6] = [
        Self::StateError,
        Self::OperationalByMethod,
        Self::OperationalByParent,
        Self::OperationalFromError,
        Self::PausedByParent,
        Self::DisabledByMethod,
    ];
    pub(super) const OF_WRITERS: [Self; 3] = [
        Self::Sent,
        Self::FailedTransmissions,
        Self::EncryptionErrors,
    ];
    pub(super) const OF_READERS: [Self; 2] = [Self::Received, Self::InvalidReceived];

    const fn name(self) -> &'static str {
        match self {
            Self::StateError => "StateError",
            Self::OperationalByMethod => "StateOperationalByMethod",
            Self::OperationalByParent => "StateOperationalByParent",
            Self::OperationalFromError => "StateOperationalFromError",
            Self::PausedByParent => "StatePausedByParent",
            Self::DisabledByMethod => "StateDisabledByMethod",
            Self::Sent => "SentNetworkMessages",
            Self::FailedTransmissions => "FailedTransmissions",
            Self::EncryptionErrors => "EncryptionErrors",
            Self::Received => "ReceivedNetworkMessages",
            Self::InvalidReceived => "ReceivedInvalidNetworkMessages",
            Self::FailedMessages => "FailedDataSetMessages",
        }
    }

    const fn is_error(self) -> bool {
        matches!(
            self,
            Self::StateError
                | Self::FailedTransmissions
                | Self::EncryptionErrors
                | Self::InvalidReceived
                | Self::FailedMessages
        )
    }

    const fn of(self, states: &[u64; 6], counts: Counts) -> u64 {
        let [error, by_method, by_parent, from_error, paused, disabled] = *states;
        match self {
            Self::StateError => error,
            Self::OperationalByMethod => by_method,
            Self::OperationalByParent => by_parent,
            Self::OperationalFromError => from_error,
            Self::PausedByParent => paused,
            Self::DisabledByMethod => disabled,
            Self::Sent => counts.sent,
            Self::FailedTransmissions => counts.failed,
            Self::EncryptionErrors => counts.unsealed,
            Self::Received => counts.received,
            Self::InvalidReceived => counts.wrong,
            Self::FailedMessages => counts.failed + counts.wrong + counts.unsealed,
        }
    }
}

/// The counters of a component in the address space.
pub(super) struct PubSubCounters {
    counters: Vec<Shown>,
    information: NodeId,
    error: NodeId,
    sub_error: NodeId,
    /// True if a component below has errors, as it is shown.
    below: bool,
    /// Numbers of state changes, by their kinds.
    states: [u64; 6],
    totals: (u32, u32),
}

struct Shown {
    counter: Counter,
    node: NodeId,
    /// The count at the last reset.
    base: u64,
    shown: u32,
}

impl PubSubCounters {
    /// Adds the counters below a component. Also returns the method that resets them, and the
    /// object of the live values.
    pub(super) fn insert(
        tree: &mut Tree<'_>,
        above: &At,
        kind: ObjectTypeId,
        more: &[Counter],
    ) -> (Self, NodeId, At) {
        let object = tree.part("Diagnostics", kind, above);
        let level = (DataTypeId::DiagnosticsLevel, -1);
        tree.value("DiagnosticsLevel", level, BASIC, &object);
        let information = total(tree, "TotalInformation", false, &object);
        let error = total(tree, "TotalError", true, &object);
        let sub_error = tree.value("SubError", (DataTypeId::Boolean, -1), false, &object);
        let reset = tree.method("Reset", &object);
        let live = tree.part("LiveValues", ObjectTypeId::BaseObjectType, &object);
        let counters = tree.part("Counters", ObjectTypeId::BaseObjectType, &object);
        let all = Counter::OF_ALL.iter().chain(more);
        let counters = all.map(|counter| Shown {
            counter: *counter,
            node: total(tree, counter.name(), counter.is_error(), &counters),
            base: 0,
            shown: 0,
        });
        let made = Self {
            counters: counters.collect(),
            information,
            error,
            sub_error,
            below: false,
            states: [0; 6],
            totals: (0, 0),
        };
        (made, reset, live)
    }

    /// Returns the counters of the object PublishSubscribe, which are in the core namespace.
    pub(super) fn of_the_whole() -> Self {
        let node = |id: u32| NodeId::new(0, id);
        let counters = Counter::OF_ALL.iter().zip(WHOLE);
        let counters = counters.map(|(counter, id)| Shown {
            counter: *counter,
            node: node(id),
            base: 0,
            shown: 0,
        });
        Self {
            counters: counters.collect(),
            information: node(WHOLE_INFORMATION),
            error: node(WHOLE_ERROR),
            sub_error: node(WHOLE_SUB_ERROR),
            below: false,
            states: [0; 6],
            totals: (0, 0),
        }
    }

    /// Counts a change of the component's state.
    pub(super) fn note(&mut self, change: &StateChange) {
        let [error, by_method, by_parent, from_error, paused, disabled] = &mut self.states;
        let which = match (change.is, change.cause) {
            (PubSubNodeState::Error, _) => error,
            (
                PubSubNodeState::Operational | PubSubNodeState::PreOperational,
                StateCause::Method,
            ) => by_method,
            (
                PubSubNodeState::Operational | PubSubNodeState::PreOperational,
                StateCause::Parent,
            ) => by_parent,
            (PubSubNodeState::Operational, StateCause::Itself)
                if change.was == PubSubNodeState::Error =>
            {
                from_error
            }
            (
                PubSubNodeState::Operational | PubSubNodeState::PreOperational,
                StateCause::Itself,
            ) => return,
            (PubSubNodeState::Paused, _) => paused,
            (PubSubNodeState::Disabled, _) => disabled,
        };
        *which = which.saturating_add(1);
    }

    /// Resets the counters.
    pub(super) fn reset(&mut self, counts: Counts) {
        self.states = [0; 6];
        for shown in &mut self.counters {
            shown.base = shown.counter.of(&self.states, counts);
        }
    }

    /// Returns the values that have changed.
    pub(super) fn changes(&mut self, counts: Counts, below: bool) -> Vec<(NodeId, Variant)> {
        let mut changes = Vec::new();
        let mut totals = (0_u32, 0_u32);
        for shown in &mut self.counters {
            let counted = shown.counter.of(&self.states, counts);
            let now = u32::try_from(counted.saturating_sub(shown.base)).unwrap_or(u32::MAX);
            let total = if shown.counter.is_error() {
                &mut totals.1
            } else {
                &mut totals.0
            };
            *total = total.saturating_add(now);
            if now != shown.shown {
                shown.shown = now;
                changes.push((shown.node.clone(), Variant::UInt32(now)));
            }
        }
        if totals != self.totals {
            self.totals = totals;
            changes.push((self.information.clone(), Variant::UInt32(totals.0)));
            changes.push((self.error.clone(), Variant::UInt32(totals.1)));
        }
        if below != self.below {
            self.below = below;
            changes.push((self.sub_error.clone(), Variant::Boolean(below)));
        }
        changes
    }

    /// Returns all values as they are shown.
    pub(super) fn shown(&self) -> Vec<(NodeId, Variant)> {
        let counters = self.counters.iter();
        let counters = counters.map(|one| (one.node.clone(), Variant::UInt32(one.shown)));
        let totals = [
            (self.information.clone(), Variant::UInt32(self.totals.0)),
            (self.error.clone(), Variant::UInt32(self.totals.1)),
            (self.sub_error.clone(), Variant::Boolean(self.below)),
        ];
        counters.chain(totals).collect()
    }

    /// Returns true if an error was counted.
    pub(super) const fn has_errors(&self) -> bool {
        self.totals.1 > 0
    }
}

/// The numbers of configured and operational components below a component (OPC 10000-14, 9.1.11).
pub(super) struct LiveCounts {
    nodes: Vec<(Live, NodeId)>,
    shown: Totals,
}

/// The numbers of writers, operational writers, readers, and operational readers.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) struct Totals {
    pub(super) writers: [u16; 2],
    pub(super) readers: [u16; 2],
}

impl Totals {
    /// Adds numbers.
    pub(super) fn add(&mut self, more: Self) {
        for (sum, more) in [
            (&mut self.writers, more.writers),
            (&mut self.readers, more.readers),
        ] {
            for (sum, more) in sum.iter_mut().zip(more) {
                *sum = sum.saturating_add(more);
            }
        }
    }
}

/// A value of LiveValues.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Live {
    Writers,
    OperationalWriters,
    Readers,
    OperationalReaders,
}

impl Live {
    const ALL: [(Self, &'static str); 4] = [
        (Self::Writers, "ConfiguredDataSetWriters"),
        (Self::OperationalWriters, "OperationalDataSetWriters"),
        (Self::Readers, "ConfiguredDataSetReaders"),
        (Self::OperationalReaders, "OperationalDataSetReaders"),
    ];

    const fn of(self, totals: Totals) -> u16 {
        let Totals {
            writers: [writers, operational_writers],
            readers: [readers, operational_readers],
        } = totals;
        match self {
            Self::Writers => writers,
            Self::OperationalWriters => operational_writers,
            Self::Readers => readers,
            Self::OperationalReaders => operational_readers,
        }
    }
}

impl LiveCounts {
    /// Adds the numbers of a group of writers or of readers.
    pub(super) fn insert(tree: &mut Tree<'_>, live: &At, has_writers: bool) -> Self {
        let kind = (DataTypeId::UInt16, -1);
        let own = Live::ALL
            .iter()
            .filter(|(live, _)| {
                let of_writers = matches!(live, Live::Writers | Live::OperationalWriters);
                of_writers == has_writers
            })
            .map(|(which, name)| (*which, tree.live_value(name, kind, 0_u16, live)));
        Self {
            nodes: own.collect(),
            shown: Totals::default(),
        }
    }

    /// Returns the numbers of the object PublishSubscribe, which are in the core namespace.
    pub(super) fn of_the_whole() -> Self {
        let live = Live::ALL.iter().zip(WHOLE_LIVE);
        let nodes = live.map(|((which, _), id)| (*which, NodeId::from(id)));
        Self {
            nodes: nodes.collect(),
            shown: Totals::default(),
        }
    }

    /// Returns the values that have changed.
    pub(super) fn changes(&mut self, totals: Totals) -> Vec<(NodeId, Variant)> {
        let before = std::mem::replace(&mut self.shown, totals);
        let changed = self
            .nodes
            .iter()
            .filter(|(which, _)| which.of(before) != which.of(totals));
        changed
            .map(|(which, node)| (node.clone(), Variant::UInt16(which.of(totals))))
            .collect()
    }

    /// Returns the values of the object PublishSubscribe before the first change.
    pub(super) fn zeros(&self) -> Vec<(NodeId, Variant)> {
        let nodes = self.nodes.iter();
        nodes
            .map(|(_, node)| (node.clone(), Variant::UInt16(0)))
            .collect()
    }
}

/// Adds a counter with the properties of the standard.
fn total(tree: &mut Tree<'_>, name: &str, is_error: bool, above: &At) -> NodeId {
    let as_ = (
        VariableTypeId::PubSubDiagnosticsCounterType,
        ReferenceTypeId::HasComponent,
    );
    let kind = (DataTypeId::UInt32, -1);
    let node = tree.variable(name, kind, 0_u32, (above, as_));
    let at = At::core(node.clone(), &node_text(&node));
    let class = (DataTypeId::PubSubDiagnosticsCounterClassification, -1);
    tree.property("Active", (DataTypeId::Boolean, -1), true, &at);
    tree.property("Classification", class, i32::from(is_error), &at);
    let level = (DataTypeId::DiagnosticsLevel, -1);
    tree.property("DiagnosticsLevel", level, BASIC, &at);
    node
}

/// Returns the identifier of a node as text.
fn node_text(node: &NodeId) -> String {
    match &node.identifier {
        opcua::types::Identifier::String(text) => text.as_ref().to_owned(),
        opcua::types::Identifier::Numeric(_)
        | opcua::types::Identifier::Guid(_)
        | opcua::types::Identifier::ByteString(_) => node.to_string(),
    }
}

/// StateError and the following counters below PublishSubscribe.Diagnostics.Counters.
const WHOLE: [u32; 6] = [17_424, 17_431, 17_436, 17_441, 17_446, 17_451];
/// LiveValues of PublishSubscribe, in the order of [`Live::ALL`].
const WHOLE_LIVE: [VariableId; 4] = [
    VariableId::PublishSubscribe_Diagnostics_LiveValues_ConfiguredDataSetWriters,
    VariableId::PublishSubscribe_Diagnostics_LiveValues_OperationalDataSetWriters,
    VariableId::PublishSubscribe_Diagnostics_LiveValues_ConfiguredDataSetReaders,
    VariableId::PublishSubscribe_Diagnostics_LiveValues_OperationalDataSetReaders,
];
const WHOLE_INFORMATION: u32 = 17_411;
const WHOLE_ERROR: u32 = 17_416;
const WHOLE_SUB_ERROR: u32 = 17_422;
/// Reasons why a message could not be sent.
const FAILED: [Reason; 2] = [Reason::NotSent, Reason::TooBig];
/// Reasons why a message for this program was rejected.
const WRONG: [Reason; 14] = [
    Reason::Malformed,
    Reason::Unsupported,
    Reason::Invalid,
    Reason::Mismatch,
    Reason::NoValue,
    Reason::Incomplete,
    Reason::NoKeyFrame,
    Reason::Undescribed,
    Reason::NotPublished,
    Reason::Unsecured,
    Reason::Downgraded,
    Reason::Signature,
    Reason::Replayed,
    Reason::UnknownKey,
];
