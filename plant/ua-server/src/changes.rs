//! What clients are told of nodes that a reload brought, took away or changed (OPC 10000-3, 9.32).
//!
//! GeneralModelChangeEvents of the Server object: who watches it browses again what they name, and nothing else.

use std::collections::HashSet;

use opcua::nodes::{BaseEventType, Event, EventField};
use opcua::server::SubscriptionCache;
use opcua::types::{
    AttributeId, DateTime, ExtensionObject, LocalizedText, ModelChangeStructureDataType, NodeId,
    NumericRange, ObjectId, ObjectTypeId, QualifiedName, VariableTypeId, Variant,
};

use crate::layout::TopicNode;

/// What became of a node: bits of ModelChangeStructureDataType.
const ADDED: u8 = 1;
const DELETED: u8 = 2;
const TYPE_CHANGED: u8 = 16;
/// Changes of one event; more come in several.
const MOST_TOLD: usize = 500;

/// Tells who watches the Server object which nodes are gone, new or of another type.
pub(crate) fn tell(subscriptions: &SubscriptionCache, gone: &[TopicNode], new: &[TopicNode]) {
    let server: NodeId = ObjectId::Server.into();
    for changes in changes(gone, new).chunks(MOST_TOLD) {
        let changed = Changed::new(changes.to_vec());
        subscriptions.notify_events([(&changed as &dyn Event, &server)].into_iter());
    }
}

/// Each node once: what is gone or another one, and then what is new.
fn changes(gone: &[TopicNode], new: &[TopicNode]) -> Vec<ModelChangeStructureDataType> {
    let nodes = |topics: &[TopicNode]| -> Vec<NodeId> {
        let nodes = topics.iter().flat_map(TopicNode::nodes);
        nodes.cloned().collect()
    };
    let (gone, new) = (nodes(gone), nodes(new));
    let (was, is): (HashSet<&NodeId>, HashSet<&NodeId>) =
        (gone.iter().collect(), new.iter().collect());
    let gone = gone.iter().map(|node| {
        let stays = is.contains(node);
        (node, if stays { TYPE_CHANGED } else { DELETED })
    });
    let new = new.iter().filter(|node| !was.contains(node));
    gone.chain(new.map(|node| (node, ADDED)))
        .map(|(node, verb)| ModelChangeStructureDataType {
            affected: node.clone(),
            affected_type: VariableTypeId::BaseDataVariableType.into(),
            verb,
        })
        .collect()
}

/// An event on its way to clients.
struct Changed {
    base: BaseEventType,
    changes: Variant,
}

impl Changed {
    fn new(changes: Vec<ModelChangeStructureDataType>) -> Self {
        let now = DateTime::now();
        let message = format!("{} nodes are others than before", changes.len());
        let base = BaseEventType {
            event_id: opcua::crypto::random::byte_string(16),
            event_type: ObjectTypeId::GeneralModelChangeEventType.into(),
            source_node: ObjectId::Server.into(),
            source_name: "Server".into(),
            time: now,
            receive_time: now,
            message: LocalizedText::from(&message),
            severity: 100,
            ..BaseEventType::default()
        };
        let changes: Vec<ExtensionObject> = changes
            .into_iter()
            .map(ExtensionObject::from_message)
            .collect();
        Self {
            base,
            changes: changes.into(),
        }
    }
}

impl Event for Changed {
    fn get_field(
        &self,
        type_definition_id: &NodeId,
        attribute_id: AttributeId,
        index_range: &NumericRange,
        browse_path: &[QualifiedName],
    ) -> Variant {
        let is_own = TYPES.iter().any(|known| *type_definition_id == *known);
        if !is_own {
            return Variant::Empty;
        }
        self.get_value(attribute_id, index_range, browse_path)
    }

    fn time(&self) -> &DateTime {
        &self.base.time
    }

    fn event_type_id(&self) -> &NodeId {
        &self.base.event_type
    }
}

impl EventField for Changed {
    fn get_value(
        &self,
        attribute_id: AttributeId,
        index_range: &NumericRange,
        remaining_path: &[QualifiedName],
    ) -> Variant {
        if attribute_id == AttributeId::Value
            && let [name] = remaining_path
            && name.namespace_index == 0
            && name.name.as_ref() == "Changes"
        {
            let changes = self.changes.clone();
            return changes
                .range_of_owned(index_range)
                .unwrap_or(Variant::Empty);
        }
        self.base
            .get_value(attribute_id, index_range, remaining_path)
    }
}

/// The type of the event, and those above it.
const TYPES: [ObjectTypeId; 3] = [
    ObjectTypeId::GeneralModelChangeEventType,
    ObjectTypeId::BaseModelChangeEventType,
    ObjectTypeId::BaseEventType,
];

#[cfg(test)]
mod tests {
    use mappings::TopicId;
    use uadp::BuiltinType;

    use crate::layout::Shape;

    use super::*;

    fn topic(id: u16, shape: BuiltinType) -> TopicNode {
        TopicNode::new(
            TopicId::new(1, 2, id).unwrap(),
            NodeId::new(2, u32::from(id)),
            format!("t{id}"),
            vec![(String::new(), Shape(Some((shape, false))))],
        )
    }

    #[test]
    fn each_node_is_told_once_with_what_became_of_it() {
        let (int, double) = (BuiltinType::Int32, BuiltinType::Double);
        let told = changes(
            &[topic(1, int), topic(2, int)],
            &[topic(2, double), topic(3, int)],
        );
        let told: Vec<_> = told
            .into_iter()
            .map(|change| (change.affected, change.verb))
            .collect();
        let node = |id: u32| NodeId::new(2, id);
        assert_eq!(
            told,
            [
                (node(1), DELETED),
                (node(2), TYPE_CHANGED),
                (node(3), ADDED)
            ]
        );
    }
}
