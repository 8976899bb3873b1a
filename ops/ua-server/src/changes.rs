//! Reports to clients which nodes a reload added, removed or changed.

use std::collections::HashSet;

use opcua::server::SubscriptionCache;
use opcua::types::{NodeId, VariableTypeId};
use plant_opcua::changes::{self, Became, ModelChange};

use crate::layout::TopicNode;

/// Notifies clients that monitor the Server object of removed, added and retyped nodes.
pub(crate) fn tell(subscriptions: &SubscriptionCache, gone: &[TopicNode], new: &[TopicNode]) {
    changes::tell(subscriptions, &changed(gone, new));
}

/// Returns a change for each node: removed and retyped nodes first, then added nodes.
fn changed(gone: &[TopicNode], new: &[TopicNode]) -> Vec<ModelChange> {
    let nodes = |topics: &[TopicNode]| -> Vec<NodeId> {
        let nodes = topics.iter().flat_map(TopicNode::nodes);
        nodes.cloned().collect()
    };
    let (gone, new) = (nodes(gone), nodes(new));
    let (was, is): (HashSet<&NodeId>, HashSet<&NodeId>) =
        (gone.iter().collect(), new.iter().collect());
    let gone = gone.iter().map(|node| {
        let stays = is.contains(node);
        (
            node,
            if stays {
                Became::OfAnotherType
            } else {
                Became::Deleted
            },
        )
    });
    let new = new.iter().filter(|node| !was.contains(node));
    gone.chain(new.map(|node| (node, Became::Added)))
        .map(|(node, became)| ModelChange {
            node: node.clone(),
            type_definition: VariableTypeId::BaseDataVariableType.into(),
            became,
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use mappings::TopicId;
    use uadp::BuiltinType;

    use crate::layout::VariableShape;

    use super::*;

    fn topic(id: u16, shape: BuiltinType) -> TopicNode {
        TopicNode::new(
            TopicId::new(1, 2, id).unwrap(),
            NodeId::new(2, u32::from(id)),
            format!("t{id}"),
            vec![(String::new(), VariableShape(Some((shape, false))))],
        )
    }

    #[test]
    fn each_node_is_told_once_with_what_became_of_it() {
        let (int, double) = (BuiltinType::Int32, BuiltinType::Double);
        let told = changed(
            &[topic(1, int), topic(2, int)],
            &[topic(2, double), topic(3, int)],
        );
        let told: Vec<_> = told
            .into_iter()
            .map(|change| (change.node, change.became))
            .collect();
        let node = |id: u32| NodeId::new(2, id);
        assert_eq!(
            told,
            [
                (node(1), Became::Deleted),
                (node(2), Became::OfAnotherType),
                (node(3), Became::Added)
            ]
        );
    }
}
