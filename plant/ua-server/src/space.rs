//! The values of the other spaces, as they come, into the address space.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Instant;

use bridge_node::{Room, now};
use mappings::TopicId;
use opcua::server::SubscriptionCache;
use opcua::types::{Array, DateTime, StatusCode, Variant, VariantScalarTypeId};
use uadp::{Fields, Timestamp};

use crate::layout::{Layout, Shape, TopicNode};
use crate::nodes::{self, SpaceManager, Stamp, Stored};
use crate::value;

/// The writing end of the address space for values that come from the space.
pub(crate) struct Space {
    manager: Arc<SpaceManager>,
    subscriptions: Arc<SubscriptionCache>,
    topics: HashMap<TopicId, Known>,
    /// For those that nobody mapped.
    room: Room,
    /// Topics whose writer speaks again, without a sample so far.
    returned: Vec<TopicId>,
}

/// A topic of another space, and what was last heard of it.
struct Known {
    node: TopicNode,
    mapped: bool,
    /// The last sample's fields and stamp.
    last: Option<(Vec<Variant>, Stamp)>,
    /// Since when its writer is silent.
    silent: Option<Instant>,
    /// The statuses of the nodes as they are in the address space.
    statuses: Vec<StatusCode>,
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
            room: Room::new(MOST_UNMAPPED),
            returned: Vec::new(),
        }
    }

    /// Goes over to the nodes of another layout: those that are the same in both keep their values. Returns the topics
    /// that are gone or other ones now, and those that are new or other ones.
    pub(crate) fn exchange(&mut self, layout: &Layout) -> (Vec<TopicId>, Vec<TopicId>) {
        let wanted: HashMap<TopicId, &TopicNode> = layout
            .topics
            .iter()
            .map(|node| (node.topic, node))
            .collect();
        let is_gone = |topic: &TopicId, known: &mut Known| match wanted.get(topic) {
            Some(node) => !known.mapped || known.node != **node,
            // Those that nobody mapped stay.
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

    /// Takes in a sample: the fields of its DataSet as a key frame carries them. Returns the topics whose nodes had to go
    /// for its own.
    ///
    /// # Errors
    /// Why it is not shown: fields that are malformed or not those of the mapping, or too many unmapped topics.
    pub(crate) fn update(
        &mut self,
        topic: TopicId,
        block: &[u8],
        (source, status): (Option<Timestamp>, u16),
    ) -> Result<Vec<TopicId>, &'static str> {
        let fields = Fields::parse(block)
            .and_then(|fields| {
                fields
                    .map(|field| Ok(value::from_field(&field?)))
                    .collect::<Result<Vec<_>, _>>()
            })
            .map_err(|_| "malformed fields")?;
        let gave_way = match self.topics.contains_key(&topic) {
            true => Vec::new(),
            false => self.add_unmapped(topic, &fields)?,
        };
        let Some(known) = self.topics.get_mut(&topic) else {
            return Err("unknown topic");
        };
        let fields = known.fit(fields)?;
        if !known.mapped {
            known.retype(&fields, &self.manager);
        }
        let stamp = Stamp {
            status: StatusCode::from(uadp::StatusCode::from_status(status).0),
            source,
            server: DateTime::now(),
        };
        known.silent = None;
        self.returned.retain(|returned| *returned != topic);
        known.last = Some((fields.clone(), stamp));
        let values = known.stored(fields, stamp);
        self.manager
            .inner()
            .store(self.manager.address_space(), &self.subscriptions, values);
        Ok(gave_way)
    }

    /// When the value shown of a topic was taken.
    pub(crate) fn shown(&self, topic: TopicId) -> Option<Timestamp> {
        let (_, stamp) = self.topics.get(&topic)?.last.as_ref()?;
        stamp.source
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
            let known = self.topics.get(&topic);
            if known.is_some_and(|known| known.silent.is_none()) {
                self.set_status(topic, None);
            }
        }
    }

    /// Shows the last sample anew, under another status than its own or, without one, under its own.
    fn set_status(&mut self, topic: TopicId, status: Option<StatusCode>) {
        let Some(known) = self.topics.get_mut(&topic) else {
            return;
        };
        let Some((fields, stamp)) = known.last.clone() else {
            return;
        };
        let status = status.unwrap_or(stamp.status);
        let values = known.stored(
            fields,
            Stamp {
                status,
                server: DateTime::now(),
                ..stamp
            },
        );
        self.manager
            .inner()
            .store(self.manager.address_space(), &self.subscriptions, values);
    }

    /// Takes out the nodes of topics that nobody mapped and whose writers fell silent, of those first that are silent
    /// longest, when it is time to look for room. Returns their topics.
    fn let_unmapped_go(&mut self) -> Vec<TopicId> {
        let now = now().monotonic;
        if !self.room.wants_look(now) {
            return Vec::new();
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
        topics
    }

    /// A topic nobody mapped gets a node of its own when its first value comes. Returns the topics that gave way to it.
    fn add_unmapped(
        &mut self,
        topic: TopicId,
        fields: &[Variant],
    ) -> Result<Vec<TopicId>, &'static str> {
        let gave_way = self.let_unmapped_go();
        if !self.room.take() {
            return Err("too many unmapped topics");
        }
        let name = topic.to_string();
        let shape = match fields {
            [only] => shape_of(only),
            _ => Shape(None),
        };
        let node = TopicNode::new(
            topic,
            nodes::unmapped_node(topic),
            name.clone(),
            vec![(name, shape)],
        );
        nodes::add_topic(
            &mut self.manager.address_space().write(),
            &node,
            &nodes::unmapped_folder(),
        );
        self.topics.insert(topic, Known::new(node, false));
        Ok(gave_way)
    }
}

impl Known {
    fn new(node: TopicNode, mapped: bool) -> Self {
        Self {
            node,
            mapped,
            last: None,
            silent: None,
            statuses: Vec::new(),
        }
    }

    /// The fields as the topic's nodes take them. A topic of which nothing is known beforehand takes several as one
    /// Variant array.
    fn fit(&self, mut fields: Vec<Variant>) -> Result<Vec<Variant>, &'static str> {
        let open = !self.mapped
            || matches!(self.node.fields.as_slice(), [field] if field.shape == Shape(None));
        if open && fields.len() != 1 {
            let values = fields
                .drain(..)
                .map(|field| Variant::Variant(Box::new(field)))
                .collect();
            let array = Array {
                value_type: VariantScalarTypeId::Variant,
                values,
                dimensions: None,
            };
            fields.push(Variant::Array(Box::new(array)));
        }
        if open {
            return Ok(fields);
        }
        if fields.len() != self.node.fields.len() {
            return Err("other fields than mapped");
        }
        let fits = self.node.fields.iter().zip(&fields).all(|(field, value)| {
            let in_place_of_a_value = matches!(value, Variant::Empty | Variant::StatusCode(_));
            in_place_of_a_value || field.shape.accepts(value)
        });
        if fits {
            Ok(fields)
        } else {
            Err("another type than mapped")
        }
    }

    /// The node of an unmapped topic has the type of what came last.
    fn retype(&mut self, fields: &[Variant], manager: &SpaceManager) {
        let (Some(field), [value]) = (self.node.fields.first_mut(), fields) else {
            return;
        };
        let shape = shape_of(value);
        if shape != field.shape {
            field.shape = shape;
            nodes::retype(&mut manager.address_space().write(), &field.node, shape);
        }
    }

    /// The values of the topic's nodes, with those marked whose status changes.
    fn stored(&mut self, fields: Vec<Variant>, stamp: Stamp) -> Vec<Stored> {
        let values = nodes::topic_values(&self.node, fields, stamp);
        let before = std::mem::take(&mut self.statuses);
        self.statuses = values.iter().map(|(_, value)| value.status()).collect();
        values
            .into_iter()
            .enumerate()
            .map(|(at, (node, value))| {
                let flipped = before
                    .get(at)
                    .is_some_and(|status| *status != value.status());
                Stored {
                    node,
                    value,
                    flipped,
                }
            })
            .collect()
    }
}

fn shape_of(value: &Variant) -> Shape {
    use opcua::types::VariantTypeId;
    let (scalar, array) = match value.type_id() {
        VariantTypeId::Empty => return Shape(None),
        VariantTypeId::Scalar(scalar) => (scalar, false),
        VariantTypeId::Array(scalar, _) => (scalar, true),
    };
    Shape(uadp::BuiltinType::from_id(scalar.encoding_mask()).map(|builtin| (builtin, array)))
}

/// How many topics without a mapping are shown. Anyone who reaches the group can make them up.
const MOST_UNMAPPED: usize = 1_000;
/// Of them, how many go at a time.
const MOST_LET_GO: usize = MOST_UNMAPPED / 8;
