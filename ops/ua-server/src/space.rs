//! Shows the received values of the other spaces in the address space.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use bridge_node::{Room, now};
use bytes::Bytes;
use mappings::{Ages, Mapping, TopicId};
use opcua::server::SubscriptionCache;
use opcua::types::{DateTime, StatusCode};
use uadp::{Fields, Scalar, Timestamp};

use crate::address;
use crate::changes;
use crate::layout::{Layout, TopicNode, VariableShape, unmapped_node};
use crate::nodes::SpaceManager;
use crate::staleness::{StaleValues, Staleness};
use crate::structures::Structure;
use crate::values::{self, SampleStamp, ShownValue};

/// Writes values of the space to the address space.
pub(crate) struct SpaceWriter {
    manager: Arc<SpaceManager>,
    subscriptions: Arc<SubscriptionCache>,
    topics: HashMap<TopicId, Known>,
    structures: Vec<Structure>,
    /// Limits the number of unmapped topics.
    room: Room,
    /// Topics that lost their nodes to other topics.
    gave_way: Vec<TopicId>,
    /// The ages of the values, of the same topics.
    ages: StaleValues,
    /// Maximum age of uncertain values of unmapped topics.
    unmapped_ages: Ages,
}

/// A topic of another space, and its last received state.
struct Known {
    node: TopicNode,
    mapped: bool,
    /// The status of the last sample.
    status: StatusCode,
    /// The last sample, while it is too old to be shown.
    over: Option<Bytes>,
}

impl SpaceWriter {
    pub(crate) fn new(
        layout: &Layout,
        manager: Arc<SpaceManager>,
        subscriptions: Arc<SubscriptionCache>,
    ) -> Self {
        let mut ages = StaleValues::default();
        for node in &layout.topics {
            ages.add(node.topic, Ages::default());
        }
        let topics = layout
            .topics
            .iter()
            .map(|node| (node.topic, Known::new(node.clone(), true)))
            .collect();
        Self {
            manager,
            subscriptions,
            topics,
            structures: layout.structures.clone(),
            room: Room::new(MOST_UNMAPPED),
            gave_way: Vec::new(),
            ages,
            unmapped_ages: Ages::default(),
        }
    }

    /// Returns the node manager.
    pub(crate) const fn manager(&self) -> &Arc<SpaceManager> {
        &self.manager
    }

    /// Sets the maximum ages of values and returns the space.
    pub(crate) fn with_ages(mut self, mapping: &Mapping) -> Self {
        self.set_ages(mapping);
        self
    }

    /// Sets the maximum ages of values.
    pub(crate) fn set_ages(&mut self, mapping: &Mapping) {
        let usual = mapping.server().bad_after;
        self.unmapped_ages = Ages::default().or(usual);
        let now = now().monotonic;
        for (topic, known) in &self.topics {
            let ages = match mapping.variable(*topic) {
                Some(variable) if !known.node.writable() => variable.ages.or(usual),
                Some(_) => Ages::default(),
                None => self.unmapped_ages,
            };
            self.ages.set_ages(*topic, ages, now);
        }
        self.show_changes();
    }

    /// Switches to the nodes of another layout. Unchanged nodes keep their values. Returns the
    /// topics that were removed or replaced, and the topics that are new or replaced.
    pub(crate) fn exchange(&mut self, layout: &Layout) -> (Vec<TopicId>, Vec<TopicId>) {
        self.exchange_structures(&layout.structures);
        self.manager.inner().set_order(layout);
        let wanted: HashMap<TopicId, &TopicNode> = layout
            .topics
            .iter()
            .map(|node| (node.topic, node))
            .collect();
        let is_gone = |topic: &TopicId, known: &mut Known| match wanted.get(topic) {
            Some(node) => !known.mapped || known.node != **node,
            // Unmapped topics are not removed by a reload.
            None => known.mapped,
        };
        let gone: Vec<Known> = self
            .topics
            .extract_if(is_gone)
            .map(|(_, known)| known)
            .collect();
        let gone: Vec<TopicNode> = gone.into_iter().map(|known| known.node).collect();
        for node in &gone {
            self.ages.remove(node.topic);
        }
        let new = layout.topics.iter();
        let new: Vec<TopicNode> = new
            .filter(|node| !self.topics.contains_key(&node.topic))
            .cloned()
            .collect();
        self.manager.inner().exchange(
            self.manager.address_space(),
            &self.subscriptions,
            (&gone, &new),
        );
        changes::tell(&self.subscriptions, &gone, &new);
        for node in &new {
            let known = Known::new(node.clone(), true);
            self.topics.insert(node.topic, known);
            self.ages.add(node.topic, Ages::default());
        }
        let topics = |nodes: Vec<TopicNode>| nodes.into_iter().map(|node| node.topic).collect();
        (topics(gone), topics(new))
    }

    /// Adds new DataTypes. Unused DataTypes stay, because clients may have read them.
    fn exchange_structures(&mut self, wanted: &[Structure]) {
        let mut address_space = self.manager.address_space().write();
        for structure in wanted {
            if !self.structures.contains(structure) {
                structure.insert(&mut address_space);
            }
        }
        self.structures = wanted.to_vec();
    }

    /// Returns the DataTypes of the mapped variables.
    pub(crate) fn structures(&self) -> &[Structure] {
        &self.structures
    }

    /// Sets the limits of past values.
    pub(crate) fn limit_past(&self, mapping: &Mapping) {
        self.manager.inner().live().limit_past(mapping);
    }

    /// Sets the size limit of written values, in bytes.
    pub(crate) fn limit_writes(&self, largest: usize) {
        self.manager.inner().writes().limit(largest);
    }

    /// Handles a sample: the fields of its DataSet as a key frame carries them. A sample that
    /// cannot be shown replaces the previous value by a status with the reason, because that value
    /// is outdated too. [`take_gave_way`](Self::take_gave_way) returns the topics that lost their
    /// nodes to a new topic.
    ///
    /// # Errors
    /// Returns the reason why the sample is not shown: malformed fields, fields that do not match
    /// the mapping, not enough memory, or too many unmapped topics.
    pub(crate) fn update(
        &mut self,
        topic: TopicId,
        payload: Bytes,
        (source, status): (Option<Timestamp>, u16),
    ) -> Result<(), &'static str> {
        let block = values::compact(payload);
        if !self.topics.contains_key(&topic) {
            self.add_unmapped(topic, &block)?;
        }
        let Some(known) = self.topics.get_mut(&topic) else {
            return Err("unknown topic");
        };
        let status = StatusCode::from(uadp::StatusCode::from_status(status).0);
        let (shown, why) = match known.fit(&block) {
            Ok(()) => (Some(block), None),
            Err((refused, why)) => (None, Some((refused, why))),
        };
        let stamp = SampleStamp {
            status: why.map_or(status, |(refused, _)| refused),
            source,
            server: DateTime::now(),
        };
        if let Some(block) = &shown
            && !known.mapped
        {
            known.retype(block, &self.manager);
        }
        self.ages.received(topic, now().monotonic);
        known.over = None;
        known.status = stamp.status;
        let shown = ShownValue {
            block: shown,
            stamp,
        };
        let kept = self
            .manager
            .inner()
            .live()
            .show(&self.subscriptions, &known.node, shown);
        match why {
            Some((_, why)) => Err(why),
            None => kept.map_err(|_| "the values take up all the memory there is for them"),
        }
    }

    /// Shows if the last written value of a topic has arrived at the bridges.
    pub(crate) fn show_arrival(&self, topic: TopicId, has_arrived: bool) {
        let known = self.topics.get(&topic);
        // The status of a value of another server is the status of that server.
        if let Some(known) = known.filter(|known| !known.node.sourced) {
            let writes = self.manager.inner().writes();
            writes.show_arrival(&self.subscriptions, &known.node, has_arrived);
        }
    }

    /// Returns true if the mapping has a variable for a topic.
    pub(crate) fn is_mapped(&self, topic: TopicId) -> bool {
        self.topics.get(&topic).is_some_and(|known| known.mapped)
    }

    /// Takes the topics that lost their nodes to other topics.
    pub(crate) fn take_gave_way(&mut self) -> Vec<TopicId> {
        std::mem::take(&mut self.gave_way)
    }

    /// Returns the status of a topic as it is shown.
    pub(crate) fn status(&self, topic: TopicId) -> StatusCode {
        self.manager.inner().live().shown(topic).stamp.status
    }

    /// Returns the source timestamp of the value that is shown.
    pub(crate) fn shown(&self, topic: TopicId) -> Option<Timestamp> {
        self.manager.inner().live().shown(topic).stamp.source
    }

    /// Marks the last value of a topic as stale or as current. The value and its source timestamp
    /// stay (OPC 10000-8, 6.3.2). A topic without a value continues to wait.
    pub(crate) fn set_silent(&mut self, topic: TopicId, silent: bool) {
        self.ages.set_silent(topic, silent, now().monotonic);
        self.show_changes();
    }

    /// Restores the status of last values if the writer is active again without a new sample.
    pub(crate) fn settle(&mut self) {
        self.ages.settle(now().monotonic);
        self.show_changes();
    }

    /// Updates the times of the last messages. If a publisher sends nothing for `timeout`, its
    /// values are shown as offline.
    pub(crate) fn hear(
        &mut self,
        heard: impl Iterator<Item = (TopicId, Instant)>,
        timeout: Duration,
    ) {
        self.ages.set_last_messages(heard, timeout, now().monotonic);
        self.show_changes();
    }

    /// Returns the time at which the next value becomes too old.
    pub(crate) fn due(&self) -> Option<Instant> {
        self.ages.poll_deadline()
    }

    /// Updates the values that have become too old.
    pub(crate) fn grow_old(&mut self) {
        self.ages.handle_deadline(now().monotonic);
        self.show_changes();
    }

    /// Shows the changes of the staleness of values.
    fn show_changes(&mut self) {
        while let Some((topic, staleness)) = self.ages.poll_change() {
            self.show_staleness(topic, staleness);
        }
    }

    /// Shows the last sample with the status of its staleness. A sample that is too old is kept
    /// here.
    fn show_staleness(&mut self, topic: TopicId, staleness: Staleness) {
        let Some(known) = self.topics.get_mut(&topic) else {
            return;
        };
        let live = self.manager.inner().live();
        let mut shown = live.shown(topic);
        if shown.block.is_none() {
            shown.block = known.over.take();
        }
        if shown.block.is_none() {
            return;
        }
        if staleness == Staleness::Expired {
            known.over = shown.block.take();
        }
        shown.stamp.status = staleness.status().unwrap_or(known.status);
        shown.stamp.server = DateTime::now();
        live.show_again(&self.subscriptions, &known.node, shown);
    }

    /// Removes the nodes of unmapped topics with silent writers, longest silent first, if it is
    /// time to make room.
    fn let_unmapped_go(&mut self) {
        let now = now().monotonic;
        if !self.room.wants_look(now) {
            return;
        }
        let unmapped = self.topics.iter().filter(|(_, known)| !known.mapped);
        let there = unmapped.clone().count();
        let mut silent: Vec<(Instant, TopicId)> = unmapped
            .filter_map(|(topic, _)| Some((self.ages.silent_since(*topic)?, *topic)))
            .collect();
        silent.sort_unstable();
        silent.truncate(MOST_LET_GO);
        let topics: Vec<TopicId> = silent.into_iter().map(|(_, topic)| topic).collect();
        let gone = topics.iter().filter_map(|topic| self.topics.remove(topic));
        let gone: Vec<TopicNode> = gone.map(|known| known.node).collect();
        for topic in &topics {
            self.ages.remove(*topic);
        }
        if !gone.is_empty() {
            self.manager.inner().exchange(
                self.manager.address_space(),
                &self.subscriptions,
                (&gone, &[]),
            );
        }
        self.room.looked(there - topics.len(), now);
        self.gave_way.extend(topics);
    }

    /// Adds a node for an unmapped topic at its first value.
    fn add_unmapped(&mut self, topic: TopicId, block: &[u8]) -> Result<(), &'static str> {
        self.let_unmapped_go();
        if !self.room.take() {
            return Err("too many unmapped topics");
        }
        let name = topic.to_string();
        let node = TopicNode::new(
            topic,
            unmapped_node(topic),
            name.clone(),
            vec![(name, shape_of(block))],
        );
        address::add_topic(
            &mut self.manager.address_space().write(),
            &node,
            &address::unmapped_folder(),
        );
        self.manager.inner().know(&node);
        self.topics.insert(topic, Known::new(node, false));
        self.ages.add(topic, self.unmapped_ages);
        Ok(())
    }
}

impl Known {
    fn new(node: TopicNode, mapped: bool) -> Self {
        Self {
            node,
            mapped,
            status: StatusCode::Good,
            over: None,
        }
    }

    /// Checks if the fields match the topic's nodes. A topic without a known type accepts any
    /// fields.
    fn fit(&self, block: &[u8]) -> Result<(), (StatusCode, &'static str)> {
        let malformed = |_| (StatusCode::BadDecodingError, "malformed fields");
        let fields = Fields::parse(block).map_err(malformed)?;
        let open = !self.mapped
            || matches!(self.node.fields.as_slice(), [field] if field.shape == VariableShape(None));
        if !open && fields.len() != self.node.fields.len() {
            return Err((StatusCode::BadTypeMismatch, "other fields than mapped"));
        }
        for (at, value) in fields.enumerate() {
            let value = value.map_err(malformed)?;
            let in_place_of_a_value = matches!(
                value,
                uadp::Variant::Null | uadp::Variant::Scalar(Scalar::StatusCode(_))
            );
            let field = self.node.fields.get(at).filter(|_| !open);
            if !in_place_of_a_value && field.is_some_and(|field| !field.shape.fits(&value)) {
                return Err((StatusCode::BadTypeMismatch, "another type than mapped"));
            }
        }
        Ok(())
    }

    /// Changes the type of an unmapped topic's node to the type of the last value.
    fn retype(&mut self, block: &[u8], manager: &SpaceManager) {
        let Some(field) = self.node.fields.first_mut() else {
            return;
        };
        let shape = shape_of(block);
        if shape != field.shape {
            field.shape = shape;
            address::retype(&mut manager.address_space().write(), &field.node, shape);
            manager.inner().know(&self.node);
        }
    }
}

/// Returns the shape of a single field. Several fields have no shape.
fn shape_of(block: &[u8]) -> VariableShape {
    let only = match Fields::parse(block) {
        Ok(mut fields) if fields.len() == 1 => fields.next(),
        Ok(_) | Err(_) => None,
    };
    VariableShape(match only {
        Some(Ok(uadp::Variant::Scalar(scalar))) => Some((scalar.builtin_type(), false)),
        Some(Ok(uadp::Variant::Array(array))) => Some((array.element(), true)),
        Some(Ok(uadp::Variant::Matrix(_) | uadp::Variant::Null) | Err(_)) | None => None,
    })
}

/// Largest number of unmapped topics that are shown. Every member of the group can publish such
/// topics.
const MOST_UNMAPPED: usize = 1_000;
/// Number of unmapped topics that are removed at a time.
const MOST_LET_GO: usize = MOST_UNMAPPED / 8;

#[cfg(test)]
mod tests {
    use opcua::types::{NodeId, Variant};
    use uadp::BuiltinType;

    use super::*;
    use crate::value;

    fn fit(fields: &[Variant]) -> Result<(), &'static str> {
        let shapes = [
            ("name", (BuiltinType::String, false)),
            ("positions", (BuiltinType::Double, true)),
        ]
        .map(|(path, shape)| (path.to_owned(), VariableShape(Some(shape))));
        let topic = TopicId::new(1, 2, 10).unwrap();
        let node = TopicNode::new(topic, NodeId::new(2, 10), "x".to_owned(), shapes.to_vec());
        let block = value::fields_block(fields).unwrap();
        let fits = Known::new(node, true).fit(&block);
        fits.map_err(|(status, why)| {
            assert_eq!(status, StatusCode::BadTypeMismatch);
            why
        })
    }

    #[test]
    fn fields_of_other_types_or_another_number_do_not_fit_and_what_stands_for_a_value_does() {
        let (name, positions) = (Variant::from("elbow"), Variant::from(vec![1.5, 2.5]));
        assert_eq!(fit(&[name.clone(), positions.clone()]), Ok(()));
        let absent = Variant::StatusCode(StatusCode::BadNoData);
        assert_eq!(fit(&[absent, Variant::Empty]), Ok(()));
        let other = Err("another type than mapped");
        assert_eq!(fit(&[positions.clone(), name.clone()]), other);
        assert_eq!(fit(&[name.clone(), Variant::from(1.5)]), other);
        let others = Err("other fields than mapped");
        assert_eq!(fit(std::slice::from_ref(&name)), others);
        assert_eq!(fit(&[name.clone(), positions, name]), others);
    }
}
