//! The node in its graph, as the topics, services and actions of the port share it.

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;

use bridge_node::policy::Policy;
use bridge_node::{PortEvent, Reason};
use mappings::TopicId;
use tcpros::{MasterGraph, Node};

use crate::definitions::Ros1Definitions;

/// The node, the graph around it, and the events for the run loop.
#[derive(Debug)]
pub(super) struct Ros1Side {
    pub(super) node: Node,
    pub(super) policy: Policy,
    pub(super) definitions: Ros1Definitions,
    pub(super) graph: Arc<MasterGraph>,
    /// True if the master responded to the last query.
    pub(super) has_master: bool,
    /// The events that `recv` returns next; filled by a message or by a comparison with the graph.
    pub(super) events: VecDeque<PortEvent>,
}

impl Ros1Side {
    /// Reports lost samples of a topic.
    pub(super) fn lost(
        &mut self,
        topic: TopicId,
        (reason, why): (Reason, &'static str),
        count: u64,
    ) {
        if count > 0 {
            self.events.push_back(PortEvent::Lost {
                topic: Some(topic),
                reason,
                why,
                count,
            });
        }
    }

    /// Returns the nodes in `named` except this node.
    pub(super) fn others<'g>(
        &self,
        named: &'g BTreeMap<String, Vec<String>>,
        name: &str,
    ) -> impl Iterator<Item = &'g str> {
        let nodes = named.get(name).into_iter().flatten().map(String::as_str);
        let own = self.node.name().to_owned();
        nodes.filter(move |node| *node != own)
    }

    /// Returns the names in `named` that another node has.
    pub(super) fn names<'g>(
        &'g self,
        named: &'g BTreeMap<String, Vec<String>>,
    ) -> impl Iterator<Item = &'g str> {
        let of_others = named
            .iter()
            .filter(|(_, nodes)| nodes.iter().any(|node| node != self.node.name()));
        of_others.map(|(name, _)| name.as_str())
    }
}
