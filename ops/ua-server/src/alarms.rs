//! Alarms and conditions (OPC 10000-9): the alarms of variables, the diagnostics of robots, and
//! the faults of publishers.
//!
//! - `condition`: the state machine of a condition; `trigger`: values that make an alarm active.
//!   Both are pure.
//! - `event` and `nodes`: a condition as an event and as nodes.
//! - `diagnostics` and `publishers`: further sources of conditions; `report`: conditions as
//!   diagnostics of ROS; `methods`: calls of clients; `acknowledging`: calls of the space; `page`:
//!   conditions on the page.
//!
//! A single lock guards all conditions. While it is held, the current values are read and the
//! subscriptions are called; the address space is written afterwards.

mod acknowledging;
mod condition;
mod diagnostics;
mod event;
mod methods;
mod nodes;
mod page;
mod past;
mod publishers;
mod report;
mod saved;
mod trigger;

use std::collections::{BTreeMap, HashMap};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, OnceLock};
use std::time::{Duration, Instant};

use bridge_node::now;
use bytes::Bytes;
use mappings::{Alarm, AlarmTrigger, Mapping, SpaceId, TopicId, Variable};
use opcua::nodes::Event;
use opcua::server::ServerHandle;
use opcua::server::node_manager::{HistoryNode, RequestContext};
use opcua::sync::Mutex;
use opcua::types::{
    AttributeId, DataValue, DateTime, NodeId, ObjectTypeId, ReadEventDetails, StatusCode,
};
use plant_opcua::server::EventHistory;
use tokio::sync::Notify;
use tracing::info;
use uadp::Scalar;

pub(crate) use self::acknowledging::description as description_of_acknowledging;
use self::condition::{AlarmCondition, EventStamp, Levels, ReportEffect, SourceReport};
use self::diagnostics::StatusLevels;
use self::event::{ConditionEvent, ConditionIdentity, ConditionType};
pub(crate) use self::methods::permissions;
use self::past::PastEvents;
use self::publishers::Publishers;
use self::report::ConditionReports;
use self::trigger::{AlarmCause, AlarmInput};
use crate::address;
use crate::history::StoredConditions;
use crate::layout::node_id;
use crate::nodes::SpaceManager;
use crate::values::ShownValue;

/// The conditions of the server.
#[derive(Default)]
pub(crate) struct Alarms {
    inner: Mutex<Inner>,
    /// True if the mapping has alarms.
    any: AtomicBool,
    /// Set when the nodes exist.
    place: OnceLock<Place>,
    /// Notified when an alarm waits for its delay, and when a report is due.
    delayed: Notify,
}

/// The server of the conditions.
struct Place {
    space: Arc<SpaceManager>,
    handle: ServerHandle,
    /// The history of the events. No other lock is taken while it is held.
    past: Mutex<PastEvents>,
    /// The file of the conditions. No other lock is taken while it is held.
    stored: Mutex<StoredConditions>,
}

#[derive(Default)]
struct Inner {
    conditions: HashMap<NodeId, Entry>,
    sources: HashMap<TopicId, Source>,
    /// The times at which the delays of conditions are over.
    delays: HashMap<NodeId, Instant>,
    publishers: Publishers,
    diagnostics: StatusLevels,
    reports: ConditionReports,
}

/// The conditions of a variable.
#[derive(Clone)]
enum Source {
    /// A single condition.
    Value(NodeId),
    /// A condition for each status of a DiagnosticArray.
    Diagnostics(diagnostics::Origin),
}

/// A condition with its source.
struct Entry {
    identity: Arc<ConditionIdentity>,
    condition: AlarmCondition,
    /// The alarm of the mapping and its trigger; `None` for other sources.
    alarm: Option<(Box<Alarm>, AlarmCause)>,
    /// Texts of single values.
    texts: BTreeMap<i64, String>,
    /// True if every client may read the value, which then is in the message.
    is_public: bool,
}

impl Entry {
    fn new(identity: ConditionIdentity, severity: u16) -> Self {
        Self {
            condition: AlarmCondition::new(identity.confirms, severity, stamp()),
            identity: Arc::new(identity),
            alarm: None,
            texts: BTreeMap::new(),
            is_public: true,
        }
    }

    /// Creates the condition of a variable.
    fn of(variable: &Variable, alarm: &Alarm) -> Self {
        let source = node_id(&variable.node);
        let limits = match &alarm.trigger {
            AlarmTrigger::Limits(limits) => limits.limits(),
            AlarmTrigger::Normal(_) | AlarmTrigger::When(_) | AlarmTrigger::Diagnostics => {
                [None; 4]
            }
        };
        let kind = match &alarm.trigger {
            AlarmTrigger::Limits(limits) if limits.exclusive => ConditionType::ExclusiveLevel,
            AlarmTrigger::Limits(_) => ConditionType::NonExclusiveLevel,
            AlarmTrigger::Normal(_) => ConditionType::OffNormal,
            AlarmTrigger::When(_) | AlarmTrigger::Diagnostics => ConditionType::Discrete,
        };
        let identity = ConditionIdentity {
            node: condition_node(variable.topic),
            kind,
            input: source.clone(),
            source,
            source_name: variable.name.clone(),
            name: variable.name.clone(),
            limits,
            normal: NodeId::null(),
            confirms: alarm.confirm,
            delay: alarm.delay,
        };
        let trigger = AlarmCause::new(alarm.trigger.clone(), alarm.delay);
        Self {
            alarm: Some((Box::new(alarm.clone()), trigger)),
            texts: variable.meaning.texts.clone(),
            ..Self::new(identity, alarm.severity)
        }
    }

    /// Returns the report of the levels of a value.
    fn report(
        &self,
        levels: Levels,
        reading: Option<&AlarmInput>,
        quality: StatusCode,
    ) -> SourceReport {
        let state = self.condition.state();
        let severity = self.alarm.as_ref().map_or(500, |(alarm, _)| alarm.severity);
        let message = if levels == state.levels && !state.message.is_empty() {
            state.message.clone()
        } else {
            self.message(levels, reading)
        };
        SourceReport {
            levels,
            severity: severity_of(levels, severity),
            message,
            quality,
        }
    }

    fn message(&self, levels: Levels, reading: Option<&AlarmInput>) -> String {
        let name = &self.identity.source_name;
        let own = self
            .alarm
            .as_ref()
            .and_then(|(alarm, _)| alarm.message.as_ref());
        if let Some(own) = own.filter(|_| levels.is_active()) {
            return own.clone();
        }
        let shown = reading.filter(|_| self.is_public).map(|reading| {
            let text = match reading {
                AlarmInput::Value(mappings::AlarmValue::Integer(number)) => {
                    let number = i64::try_from(*number).ok();
                    number.and_then(|number| self.texts.get(&number))
                }
                AlarmInput::Value(_) | AlarmInput::Number(_) => None,
            };
            match text {
                Some(text) => format!(" is {reading} ({text})"),
                None => format!(" is {reading}"),
            }
        });
        let shown = shown.unwrap_or_default();
        match (levels.is_active(), self.identity.kind) {
            (false, _) => format!("{name}{shown}: normal"),
            (true, ConditionType::ExclusiveLevel | ConditionType::NonExclusiveLevel) => {
                format!("{name}{shown}: {}", levels.name())
            }
            (true, _) => format!("{name}{shown}: alarm"),
        }
    }
}

/// Returns the severity of levels. The outer limits are halfway between the severity of the alarm
/// and 1000.
fn severity_of(levels: Levels, severity: u16) -> u16 {
    if levels.has(Levels::HIGH_HIGH) || levels.has(Levels::LOW_LOW) {
        return severity.midpoint(1000);
    }
    severity
}

impl Place {
    /// Sends an event of the conditions.
    fn raise(&self, event: &dyn Event) {
        let folder = address::alarms_folder();
        let subscriptions = self.handle.subscriptions();
        subscriptions.notify_events([(event, &folder)].into_iter());
    }

    /// Shows the state of a condition to clients.
    fn show(&self, entry: &Entry, effect: ReportEffect) {
        if effect == ReportEffect::Nothing {
            return;
        }
        let stored = self.stored.lock();
        if stored.is_kept()
            && let Some(text) = entry.alarm_text()
        {
            let bytes = saved::encoded(&entry.condition, &text);
            stored.keep(&entry.identity.node, bytes);
        }
        drop(stored);
        let event = ConditionEvent::new(&entry.identity, entry.condition.state());
        if effect == ReportEffect::Reported {
            self.past.lock().keep(event.clone());
            self.raise(&event);
        }
        let mut notifier = self.handle.subscriptions().data_notifier();
        for (node, path) in nodes::variables(&entry.identity) {
            let Some(mut items) = notifier.notify_for(&node, AttributeId::Value) else {
                continue;
            };
            let path: Vec<&str> = path.split('.').collect();
            if let Some(value) = event.field(&path) {
                items.data_value(data_value(value, &event));
            }
        }
    }
}

fn data_value(value: opcua::types::Variant, event: &ConditionEvent) -> DataValue {
    DataValue {
        value: Some(value),
        status: Some(StatusCode::Good),
        source_timestamp: Some(*event.time()),
        server_timestamp: Some(DateTime::now()),
        ..DataValue::default()
    }
}

impl Inner {
    /// Applies a value of a variable with an alarm.
    fn value(
        &mut self,
        node: &NodeId,
        shown: &ShownValue,
        now: Instant,
        place: &Place,
    ) -> ReportEffect {
        let Some(entry) = self.conditions.get_mut(node) else {
            return ReportEffect::Nothing;
        };
        let (reading, quality) = reading(shown);
        let Some((_, trigger)) = &mut entry.alarm else {
            return ReportEffect::Nothing;
        };
        let levels = match reading.as_ref().filter(|_| !quality.is_bad()) {
            Some(reading) => trigger.read(reading, now),
            // A missing value says nothing about the machine.
            None => trigger.levels(),
        };
        match trigger.due() {
            Some(due) => drop(self.delays.insert(node.clone(), due)),
            None => drop(self.delays.remove(node)),
        }
        let report = entry.report(levels, reading.as_ref(), quality);
        let effect = entry.condition.report(report, stamp());
        place.show(entry, effect);
        effect
    }

    /// Returns the time at which the next delay is over or the next report is due.
    fn due(&self) -> Option<Instant> {
        let delays = self.delays.values().copied();
        delays.chain(self.reports.due()).min()
    }

    fn elapse(&mut self, now: Instant, place: &Place) {
        let over = self.delays.extract_if(|_, due| *due <= now);
        let over: Vec<NodeId> = over.map(|(node, _)| node).collect();
        for node in over {
            let Some(entry) = self.conditions.get_mut(&node) else {
                continue;
            };
            let Some((_, trigger)) = &mut entry.alarm else {
                continue;
            };
            let Some((levels, reading)) = trigger.elapsed(now) else {
                continue;
            };
            let (quality, _) = entry.condition.state().quality;
            let report = entry.report(levels, Some(&reading), quality);
            let effect = entry.condition.report(report, stamp());
            place.show(entry, effect);
            self.reports.changed(now);
        }
    }
}

/// Returns the value of a variable and its status.
fn reading(shown: &ShownValue) -> (Option<AlarmInput>, StatusCode) {
    let status = shown.stamp.status;
    let Some(mut fields) = shown.fields() else {
        return (None, status);
    };
    match fields.next() {
        // A status in place of a value.
        Some(Ok(uadp::Variant::Scalar(Scalar::StatusCode(said)))) => {
            (None, StatusCode::from(said.0))
        }
        Some(Ok(value)) => (AlarmInput::of(&value), status),
        Some(Err(_)) | None => (None, status),
    }
}

impl Alarms {
    /// Sets the server of the conditions and creates the conditions of a mapping. Conditions of the
    /// same alarms continue as they were stored.
    pub(crate) fn stand(
        &self,
        space: Arc<SpaceManager>,
        handle: &ServerHandle,
        mapping: &Mapping,
        stored: StoredConditions,
    ) {
        let handle = handle.clone();
        let past = Mutex::default();
        drop(self.place.set(Place {
            space,
            handle,
            past,
            stored: Mutex::new(stored),
        }));
        self.follow(mapping);
        if let Some(place) = self.place.get() {
            place.stored.lock().forget_others();
        }
    }

    /// Switches to the alarms of a mapping. Unchanged conditions keep their state. Clients are
    /// asked to refresh their conditions.
    pub(crate) fn reload(&self, mapping: &Mapping) {
        let had = self.any.load(Ordering::Relaxed);
        self.follow(mapping);
        let Some(place) = self.place.get() else {
            return;
        };
        if had || self.any.load(Ordering::Relaxed) {
            place.raise(&event::refresh(
                ObjectTypeId::RefreshRequiredEventType,
                stamp(),
            ));
        }
    }

    fn follow(&self, mapping: &Mapping) {
        let Some(place) = self.place.get() else {
            return;
        };
        let mut before = Vec::new();
        let mut wanted = Vec::new();
        {
            let mut inner = self.inner.lock();
            let inner = &mut *inner;
            let mut old = std::mem::take(&mut inner.conditions);
            before.extend(old.values().map(|entry| Arc::clone(&entry.identity)));
            inner.sources.clear();
            for variable in mapping.variables() {
                let Some(alarm) = &variable.alarm else {
                    continue;
                };
                let topic = variable.topic;
                if alarm.trigger == AlarmTrigger::Diagnostics {
                    let origin = diagnostics::Origin::of(variable, alarm);
                    let is_public = place.space.inner().is_public(&node_id(&variable.node));
                    let all = old.extract_if(|_, entry| origin.has(&entry.identity));
                    for (node, mut entry) in all {
                        if entry.is_public != is_public {
                            // The next status makes the text again.
                            inner.diagnostics.retain(|other| *other != node);
                        }
                        entry.is_public = is_public;
                        inner.conditions.insert(node, entry);
                    }
                    inner.sources.insert(topic, Source::Diagnostics(origin));
                    continue;
                }
                let mut entry = Entry::of(variable, alarm);
                let node = entry.identity.node.clone();
                if let Some(known) = old.remove(&node)
                    && known.identity == entry.identity
                    && known.alarm.as_ref().is_some_and(|(was, _)| *was == *alarm)
                {
                    entry.condition = known.condition;
                    entry.alarm = known.alarm;
                } else {
                    place.restore(&mut entry);
                }
                entry.is_public = place.space.inner().is_public(&entry.identity.source);
                inner.sources.insert(topic, Source::Value(node.clone()));
                inner.conditions.insert(node, entry);
            }
            let kept = &inner.conditions;
            inner.diagnostics.retain(|node| kept.contains_key(node));
            inner.reports.follow(mapping, now().monotonic);
            let spaces = publishers::spaces(mapping);
            for entry in inner.publishers.follow(spaces) {
                let node = entry.identity.node.clone();
                let entry = old.remove(&node).unwrap_or(entry);
                inner.conditions.insert(node, entry);
            }
            place.remove_stored(old.keys());
            let conditions = inner.conditions.values();
            wanted.extend(conditions.map(|entry| Arc::clone(&entry.identity)));
            let any = !inner.sources.is_empty()
                || !inner.conditions.is_empty()
                || inner.reports.due().is_some();
            self.any.store(any, Ordering::Relaxed);
        }
        if !before.is_empty() || self.any.load(Ordering::Relaxed) {
            let mut address_space = place.space.address_space().write();
            nodes::add_folder(&mut address_space);
            for identity in before {
                nodes::remove(&mut address_space, &identity);
            }
            for identity in &wanted {
                nodes::insert(&mut address_space, identity);
            }
        }
        self.delayed.notify_one();
        let topics: Vec<TopicId> = self.inner.lock().sources.keys().copied().collect();
        for topic in topics {
            self.look(topic, || place.space.inner().live().shown(topic));
        }
    }

    /// Applies the current value of a topic.
    pub(crate) fn look(&self, topic: TopicId, current: impl FnOnce() -> ShownValue) {
        if !self.any.load(Ordering::Relaxed) {
            return;
        }
        let Some(place) = self.place.get() else {
            return;
        };
        let mut inner = self.inner.lock();
        let Some(source) = inner.sources.get(&topic).cloned() else {
            return;
        };
        let shown = current();
        let now = now().monotonic;
        match source {
            Source::Value(node) => {
                let had = inner.due();
                if inner.value(&node, &shown, now, place) == ReportEffect::Reported {
                    inner.reports.changed(now);
                }
                let due = inner.due();
                drop(inner);
                if due != had {
                    self.delayed.notify_one();
                }
            }
            Source::Diagnostics(origin) => {
                let (new, gone) = inner.diagnosed(&origin, &shown, place);
                drop(inner);
                if new.is_empty() && gone.is_empty() {
                    return;
                }
                let mut address_space = place.space.address_space().write();
                for identity in &gone {
                    nodes::remove(&mut address_space, identity);
                }
                for identity in &new {
                    nodes::insert(&mut address_space, identity);
                }
            }
        }
    }

    /// Waits until the delay of an alarm is over or a report is due. Cancel-safe.
    pub(crate) async fn elapsed(&self) {
        loop {
            let any = self.any.load(Ordering::Relaxed);
            let due = any.then(|| self.inner.lock().due()).flatten();
            let called = self.delayed.notified();
            match due {
                Some(due) => tokio::select! {
                    () = tokio::time::sleep_until(due.into()) => return,
                    () = called => {}
                },
                None => called.await,
            }
        }
    }

    /// Applies the values after their delay. Returns the values that report the conditions, if
    /// they are due: the topic and the fields of its DataSet.
    pub(crate) fn elapse(&self) -> Vec<(TopicId, Bytes)> {
        let Some(place) = self.place.get() else {
            return Vec::new();
        };
        let mut inner = self.inner.lock();
        let inner = &mut *inner;
        let now = now();
        inner.elapse(now.monotonic, place);
        let conditions = inner.conditions.values();
        let conditions = conditions.map(|one| (&*one.identity, one.condition.state()));
        inner.reports.take(conditions, (now.monotonic, now.utc))
    }

    /// Returns the value of a variable of a condition.
    pub(crate) fn read(&self, node: &NodeId) -> Option<DataValue> {
        if !self.any.load(Ordering::Relaxed) {
            return None;
        }
        let (condition, path) = nodes::split(node)?;
        let inner = self.inner.lock();
        let entry = inner.conditions.get(&condition)?;
        let event = ConditionEvent::new(&entry.identity, entry.condition.state());
        let value = event.field(&path)?;
        Some(data_value(value, &event))
    }

    /// Applies the state of the publishers of the space.
    pub(crate) fn publishers(&self, router: &bridge_node::Router, timeout: Duration) {
        let Some(place) = self.place.get() else {
            return;
        };
        let mut inner = self.inner.lock();
        let inner = &mut *inner;
        if inner.publishers.is_empty() {
            return;
        }
        let now = now().monotonic;
        let seen = publishers::PublisherStates::of(router, timeout);
        for (node, report) in inner.publishers.look(&seen, now) {
            if let Some(entry) = inner.conditions.get_mut(&node) {
                let effect = entry.condition.report(report, stamp());
                place.show(entry, effect);
            }
        }
    }

    /// Executes a method of a condition.
    ///
    /// # Errors
    /// Returns `BadNodeIdUnknown` for a node that is no condition, or the status of the method.
    fn act(
        &self,
        node: &NodeId,
        user: &str,
        act: impl FnOnce(&mut AlarmCondition, EventStamp) -> Result<(), StatusCode>,
    ) -> Result<(), StatusCode> {
        let place = self.place.get().ok_or(StatusCode::BadShutdown)?;
        let mut inner = self.inner.lock();
        let entry = inner
            .conditions
            .get_mut(node)
            .ok_or(StatusCode::BadNodeIdUnknown)?;
        act(&mut entry.condition, stamp())?;
        info!(condition = %node, user, "a user changed a condition");
        place.show(entry, ReportEffect::Reported);
        let is_earlier = inner.reports.changed(now().monotonic);
        drop(inner);
        if is_earlier {
            self.delayed.notify_one();
        }
        Ok(())
    }

    /// Sends all retained conditions to an event item of a subscription, or to all its event
    /// items (OPC 10000-9, 5.5.7).
    ///
    /// # Errors
    /// Returns `BadSubscriptionIdInvalid` or `BadMonitoredItemIdInvalid`.
    fn refresh(
        &self,
        session: u32,
        subscription: u32,
        item: Option<u32>,
    ) -> Result<(), StatusCode> {
        let place = self.place.get().ok_or(StatusCode::BadShutdown)?;
        // No condition changes in between.
        let inner = self.inner.lock();
        let retained = inner.conditions.values();
        let retained = retained.filter(|entry| entry.condition.state().retain());
        let events = retained.map(|one| ConditionEvent::new(&one.identity, one.condition.state()));
        let events: Vec<ConditionEvent> = events.collect();
        let unknown = StatusCode::BadSubscriptionIdInvalid;
        let subscriptions = place.handle.subscriptions();
        let subscriptions = subscriptions.get_session_subscriptions(session);
        let subscriptions = subscriptions.ok_or(unknown)?;
        let mut subscriptions = subscriptions.lock();
        let subscription = subscriptions.get_mut(subscription).ok_or(unknown)?;
        let notifiers = [
            address::alarms_folder(),
            opcua::types::ObjectId::Server.into(),
        ];
        let items = subscription.items().filter(|item| {
            let monitored = item.item_to_monitor();
            monitored.attribute_id == AttributeId::EventNotifier
                && notifiers.contains(&monitored.node_id)
        });
        let mut items: Vec<u32> = items.map(|item| item.id()).collect();
        if let Some(wanted) = item {
            items.retain(|item| *item == wanted);
            if items.is_empty() {
                return Err(StatusCode::BadMonitoredItemIdInvalid);
            }
        }
        let types = place.handle.type_tree().read();
        let start = event::refresh(ObjectTypeId::RefreshStartEventType, stamp());
        let end = event::refresh(ObjectTypeId::RefreshEndEventType, stamp());
        for item in items {
            subscription.notify_event(&item, &start, &*types);
            for event in &events {
                subscription.notify_event(&item, event, &*types);
            }
            subscription.notify_event(&item, &end, &*types);
        }
        Ok(())
    }
}

/// The history of the events of conditions.
impl EventHistory for Alarms {
    fn read_events(
        &self,
        context: &RequestContext,
        details: &ReadEventDetails,
        node: &mut HistoryNode,
    ) {
        let Some(place) = self.place.get() else {
            node.set_status(StatusCode::BadShutdown);
            return;
        };
        let types = context.type_tree.read();
        place.past.lock().read(details, node, &*types);
    }
}

/// Returns the condition of a variable.
fn condition_node(topic: TopicId) -> NodeId {
    NodeId::new(1, format!("{topic}.alarm"))
}

/// Returns the current time and a new event id.
fn stamp() -> EventStamp {
    EventStamp {
        time: DateTime::now(),
        id: opcua::crypto::random::byte_string(16),
    }
}

/// Returns the name of a space in messages.
fn space_name(space: SpaceId) -> String {
    address::origin_name(space)
}
