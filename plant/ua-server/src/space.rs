//! The values of the other spaces, as they come, into the address space.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Instant;

use bridge_node::{Room, now};
use bytes::Bytes;
use mappings::TopicId;
use opcua::server::SubscriptionCache;
use opcua::types::{DateTime, StatusCode};
use uadp::{Fields, Scalar, Timestamp};

use crate::address;
use crate::layout::{Layout, Shape, TopicNode};
use crate::nodes::SpaceManager;
use crate::structures::Structure;
use crate::values::{self, Shown, Stamp};

/// The writing end of the address space for values that come from the space.
pub(crate) struct Space {
    manager: Arc<SpaceManager>,
    subscriptions: Arc<SubscriptionCache>,
    topics: HashMap<TopicId, Known>,
    structures: Vec<Structure>,
    /// For those that nobody mapped.
    room: Room,
    /// Topics whose writer speaks again, without a sample so far.
    returned: Vec<TopicId>,
    /// Topics whose nodes had to go for others.
    gave_way: Vec<TopicId>,
}

/// A topic of another space, and what was last heard of it.
struct Known {
    node: TopicNode,
    mapped: bool,
    /// The status of the last sample.
    status: StatusCode,
    /// Since when its writer is silent.
    silent: Option<Instant>,
}

impl Space {
    pub(crate) fn new(
        layout: &Layout,
        manager: Arc<SpaceManager>,
        subscriptions: Arc<SubscriptionCache>,
    ) -> Self {
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
            returned: Vec::new(),
            gave_way: Vec::new(),
        }
    }

    /// Goes over to the nodes of another layout: those that are the same in both keep their values. Returns the topics
    /// that are gone or other ones now, and those that are new or other ones.
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
            // Those that nobody mapped are there as long as the server.
            None => known.mapped,
        };
        let gone: Vec<Known> = self
            .topics
            .extract_if(is_gone)
            .map(|(_, known)| known)
            .collect();
        let gone: Vec<TopicNode> = gone.into_iter().map(|known| known.node).collect();
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
        for node in &new {
            let known = Known::new(node.clone(), true);
            self.topics.insert(node.topic, known);
        }
        let topics = |nodes: Vec<TopicNode>| nodes.into_iter().map(|node| node.topic).collect();
        (topics(gone), topics(new))
    }

    /// DataTypes that no variable has any more stay: clients may have read them.
    fn exchange_structures(&mut self, wanted: &[Structure]) {
        let mut address_space = self.manager.address_space().write();
        for structure in wanted {
            if !self.structures.contains(structure) {
                structure.insert(&mut address_space);
            }
        }
        self.structures = wanted.to_vec();
    }

    /// The DataTypes of the mapped variables.
    pub(crate) fn structures(&self) -> &[Structure] {
        &self.structures
    }

    /// How large a value may be that clients write, in bytes.
    pub(crate) fn limit_writes(&self, largest: usize) {
        self.manager.inner().limit_writes(largest);
    }

    /// Takes in a sample: the fields of its DataSet as a key frame carries them. One that cannot be shown leaves a status
    /// that says why in the place of the value before it, which is no longer true either. Whose nodes had to go
    /// for its own says [`take_gave_way`](Self::take_gave_way).
    ///
    /// # Errors
    /// Why it is not shown: fields that are malformed or not those of the mapping, no memory, or too many unmapped
    /// topics.
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
        let stamp = Stamp {
            status: why.map_or(status, |(refused, _)| refused),
            source,
            server: DateTime::now(),
        };
        if let Some(block) = &shown
            && !known.mapped
        {
            known.retype(block, &self.manager);
        }
        known.silent = None;
        known.status = stamp.status;
        self.returned.retain(|returned| *returned != topic);
        let shown = Shown {
            block: shown,
            stamp,
        };
        let kept = self
            .manager
            .inner()
            .show(&self.subscriptions, &known.node, shown);
        match why {
            Some((_, why)) => Err(why),
            None => kept.map_err(|_| "the values take up all the memory there is for them"),
        }
    }

    /// Whether the mapping has a variable of a topic.
    pub(crate) fn is_mapped(&self, topic: TopicId) -> bool {
        self.topics.get(&topic).is_some_and(|known| known.mapped)
    }

    /// The topics whose nodes had to go for others, since this was asked.
    pub(crate) fn take_gave_way(&mut self) -> Vec<TopicId> {
        std::mem::take(&mut self.gave_way)
    }

    /// The status a topic is shown with.
    pub(crate) fn status(&self, topic: TopicId) -> StatusCode {
        self.manager.inner().shown(topic).stamp.status
    }

    /// When the value shown of a topic was taken.
    pub(crate) fn shown(&self, topic: TopicId) -> Option<Timestamp> {
        self.manager.inner().shown(topic).stamp.source
    }

    /// Marks the last value of a topic as no longer kept up, or as kept up again. The value and its source timestamp
    /// stay (OPC 10000-8, 6.3.2); a topic that never had one goes on waiting.
    pub(crate) fn set_silent(&mut self, topic: TopicId, silent: bool) {
        let Some(known) = self.topics.get_mut(&topic) else {
            return;
        };
        if known.silent.is_some() == silent {
            return;
        }
        known.silent = silent.then(|| now().monotonic);
        if silent {
            self.set_status(topic, Some(StatusCode::UncertainLastUsableValue));
        } else {
            // Most likely a sample follows at once, which says more than the one before.
            self.returned.push(topic);
        }
    }

    /// Gives the last values their own status back where a writer speaks again but has nothing new to say.
    pub(crate) fn settle(&mut self) {
        for topic in std::mem::take(&mut self.returned) {
            if self
                .topics
                .get(&topic)
                .is_some_and(|known| known.silent.is_none())
            {
                self.set_status(topic, None);
            }
        }
    }

    /// Shows the last sample anew, under another status than its own or, without one, under its own.
    fn set_status(&mut self, topic: TopicId, status: Option<StatusCode>) {
        let Some(known) = self.topics.get(&topic) else {
            return;
        };
        let nodes = self.manager.inner();
        let mut shown = nodes.shown(topic);
        if shown.block.is_none() {
            return;
        }
        shown.stamp.status = status.unwrap_or(known.status);
        shown.stamp.server = DateTime::now();
        nodes.show_again(&self.subscriptions, &known.node, shown);
    }

    /// Takes out the nodes of topics that nobody mapped and whose writers fell silent, of those first that are silent
    /// longest, when it is time to look for room.
    fn let_unmapped_go(&mut self) {
        let now = now().monotonic;
        if !self.room.wants_look(now) {
            return;
        }
        let unmapped = self.topics.iter().filter(|(_, known)| !known.mapped);
        let there = unmapped.clone().count();
        let mut silent: Vec<(Instant, TopicId)> = unmapped
            .filter_map(|(topic, known)| known.silent.map(|since| (since, *topic)))
            .collect();
        silent.sort_unstable();
        silent.truncate(MOST_LET_GO);
        let topics: Vec<TopicId> = silent.into_iter().map(|(_, topic)| topic).collect();
        let gone = topics.iter().filter_map(|topic| self.topics.remove(topic));
        let gone: Vec<TopicNode> = gone.map(|known| known.node).collect();
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

    /// A topic nobody mapped gets a node of its own when its first value comes.
    fn add_unmapped(&mut self, topic: TopicId, block: &[u8]) -> Result<(), &'static str> {
        self.let_unmapped_go();
        if !self.room.take() {
            return Err("too many unmapped topics");
        }
        let name = topic.to_string();
        let node = TopicNode::new(
            topic,
            address::unmapped_node(topic),
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
        Ok(())
    }
}

impl Known {
    fn new(node: TopicNode, mapped: bool) -> Self {
        Self {
            node,
            mapped,
            status: StatusCode::Good,
            silent: None,
        }
    }

    /// Whether the topic's nodes take the fields. A topic of which nothing is known beforehand takes any.
    fn fit(&self, block: &[u8]) -> Result<(), (StatusCode, &'static str)> {
        let malformed = |_| (StatusCode::BadDecodingError, "malformed fields");
        let fields = Fields::parse(block).map_err(malformed)?;
        let open = !self.mapped
            || matches!(self.node.fields.as_slice(), [field] if field.shape == Shape(None));
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

    /// The node of an unmapped topic has the type of what came last.
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

/// The shape of the only field; of several, none.
fn shape_of(block: &[u8]) -> Shape {
    let only = match Fields::parse(block) {
        Ok(mut fields) if fields.len() == 1 => fields.next(),
        Ok(_) | Err(_) => None,
    };
    Shape(match only {
        Some(Ok(uadp::Variant::Scalar(scalar))) => Some((scalar.builtin_type(), false)),
        Some(Ok(uadp::Variant::Array(array))) => Some((array.element(), true)),
        Some(Ok(uadp::Variant::Matrix(_) | uadp::Variant::Null) | Err(_)) | None => None,
    })
}

/// How many topics without a mapping are shown. Anyone who reaches the group can make them up.
const MOST_UNMAPPED: usize = 1_000;
/// Of them, how many go at a time.
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
        .map(|(path, shape)| (path.to_owned(), Shape(Some(shape))));
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
