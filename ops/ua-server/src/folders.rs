//! The folders that follow from dotted names of variables: `Line.Conveyor.Speed` is the variable
//! `Speed` in `Conveyor` in `Line`.

use std::collections::HashMap;

use mappings::SpaceId;
use opcua::nodes::{DefaultTypeTree, TypeTree};
use opcua::server::address_space::AddressSpace;
use opcua::types::{BrowseDirection, NodeId, ReferenceTypeId};

use crate::address;
use crate::layout::{Layout, TopicNode};

/// Returns the folders of a topic with their names, outermost first.
fn around(topic: &TopicNode) -> impl Iterator<Item = (NodeId, &str)> {
    let (_, names) = topic.parts();
    let space = topic.topic.space;
    (1..=names.len()).filter_map(move |depth| {
        let within = names.get(..depth)?;
        Some((folder(space, within), *within.last()?))
    })
}

fn folder(space: SpaceId, names: &[&str]) -> NodeId {
    let root = address::origin_folder(space);
    let path = format!("UaSpace.{space}/{}", names.join("/"));
    NodeId::new(root.namespace, path)
}

/// Adds the missing folders of a topic and returns the innermost folder.
pub(crate) fn stand(address_space: &mut AddressSpace, topic: &TopicNode) -> NodeId {
    let mut parent = address::origin_folder(topic.topic.space);
    if !address_space.node_exists(&parent) {
        let name = address::origin_name(topic.topic.space);
        address::add_folder(&parent, &name, address::root(), address_space);
    }
    for (node, name) in around(topic) {
        if !address_space.node_exists(&node) {
            address::add_folder(&node, name, parent, address_space);
        }
        parent = node;
    }
    parent
}

/// Removes the folders of removed topics that are empty.
pub(crate) fn tidy(address_space: &mut AddressSpace, gone: &[TopicNode]) {
    let types = DefaultTypeTree::new();
    for topic in gone {
        let mut folders: Vec<NodeId> = around(topic).map(|(node, _)| node).collect();
        while let Some(node) = folders.pop() {
            let filter = Some((ReferenceTypeId::Organizes, false));
            let types: &dyn TypeTree = &types;
            let direction = BrowseDirection::Forward;
            let mut within = address_space.find_references(&node, filter, types, direction);
            if within.next().is_some() {
                break;
            }
            drop(within);
            drop(address_space.delete(&node, true));
        }
    }
}

/// Returns the rank of each node among the children of its parent. A folder has the rank of its
/// first variable.
pub(crate) fn order(layout: &Layout) -> HashMap<NodeId, usize> {
    let mut order = address::order(layout);
    for (at, topic) in (1..).zip(&layout.topics) {
        for (node, _) in around(topic) {
            order.entry(node).or_insert(at);
        }
    }
    order
}
