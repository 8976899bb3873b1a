//! The loops of a flow: flows that return to an earlier node, and the nodes between.

use std::collections::{BTreeMap, BTreeSet};

use super::{Edge, Flow, FlowNodeKind};

/// A loop of a flow, by the numbers of its nodes.
#[derive(Debug)]
pub(super) struct FlowLoop {
    /// The node at which each round begins.
    pub(super) head: usize,
    /// All nodes, with the head.
    pub(super) nodes: BTreeSet<usize>,
}

/// All loops of a flow, and the flows that return.
#[derive(Debug, Default)]
pub(super) struct FlowLoops {
    pub(super) all: Vec<FlowLoop>,
    /// The numbers of the flows that return to the head of a loop.
    returns: BTreeSet<usize>,
}

/// A loop that no process can have: the offset in the file, and the finding.
pub(super) type LoopFault = (usize, String);

impl FlowLoops {
    /// Finds the loops: each is entered at its head only.
    ///
    /// # Errors
    /// A loop that is entered at several nodes.
    pub(super) fn of(flow: &Flow) -> Result<Self, LoopFault> {
        let returns = returning(flow);
        let mut by_head: BTreeMap<usize, Vec<&Edge>> = BTreeMap::new();
        for edge in returns.iter().filter_map(|edge| flow.edges.get(*edge)) {
            by_head.entry(edge.to).or_default().push(edge);
        }
        let mut before: BTreeMap<usize, Vec<usize>> = BTreeMap::new();
        for edge in &flow.edges {
            before.entry(edge.to).or_default().push(edge.from);
        }
        let mut all = Vec::new();
        for (head, edges) in by_head {
            let mut nodes = BTreeSet::from([head]);
            let mut look: Vec<usize> = edges.iter().map(|edge| edge.from).collect();
            while let Some(node) = look.pop() {
                if nodes.insert(node) {
                    look.extend(before.get(&node).into_iter().flatten());
                }
            }
            let is_start = |node: &usize| {
                let node = flow.nodes.get(*node);
                node.is_some_and(|node| matches!(node.kind, FlowNodeKind::Start))
            };
            if nodes.iter().any(is_start) {
                let what = format!(
                    "the loop that returns to `{}` is entered at another place too; a loop has one \
                     beginning",
                    flow.name(head)
                );
                return Err((edges.first().map_or(0, |edge| edge.at), what));
            }
            all.push(FlowLoop { head, nodes });
        }
        Ok(Self { all, returns })
    }

    /// Returns the flows that do not return.
    pub(super) fn forward<'f>(&self, flow: &'f Flow) -> impl Iterator<Item = &'f Edge> {
        let edges = flow.edges.iter().enumerate();
        edges.filter_map(|(number, edge)| (!self.returns.contains(&number)).then_some(edge))
    }

    /// Returns the flows that return to the head of a loop.
    pub(super) fn back<'f>(&self, flow: &'f Flow, head: usize) -> impl Iterator<Item = &'f Edge> {
        let edges = self.returns.iter().filter_map(|edge| flow.edges.get(*edge));
        edges.filter(move |edge| edge.to == head)
    }

    /// Returns a flow that leads to a step or to an end without a flow before it for which
    /// `is_open` is false. `ways` are the first flows.
    pub(super) fn way_with<'f>(
        &self,
        flow: &'f Flow,
        mut ways: Vec<&'f Edge>,
        is_open: impl Fn(&Edge) -> bool,
    ) -> Option<&'f Edge> {
        let mut seen = BTreeSet::new();
        while let Some(edge) = ways.pop() {
            if !is_open(edge) {
                continue;
            }
            let mut behind = self
                .forward(flow)
                .filter(|next| next.from == edge.to)
                .peekable();
            if flow.is_task(edge.to) || behind.peek().is_none() {
                return Some(edge);
            }
            if seen.insert(edge.to) {
                ways.extend(behind);
            }
        }
        None
    }

    /// Returns the loops that a flow leaves.
    pub(super) fn left_by(&self, edge: &Edge) -> impl Iterator<Item = &FlowLoop> {
        self.all.iter().filter(|one| one.is_left_by(edge))
    }
}

impl FlowLoop {
    /// Returns whether a flow leads out of the loop.
    pub(super) fn is_left_by(&self, edge: &Edge) -> bool {
        self.nodes.contains(&edge.from) && !self.nodes.contains(&edge.to)
    }
}

/// Returns the numbers of the flows that lead to a node on the path from the start to them.
fn returning(flow: &Flow) -> BTreeSet<usize> {
    let mut behind: BTreeMap<usize, Vec<usize>> = BTreeMap::new();
    for (number, edge) in flow.edges.iter().enumerate() {
        behind.entry(edge.from).or_default().push(number);
    }
    let mut returns = BTreeSet::new();
    let mut seen = BTreeSet::new();
    let nodes = flow.nodes.iter().enumerate();
    let starts = nodes.filter(|(_, node)| matches!(node.kind, FlowNodeKind::Start));
    for (start, _) in starts {
        // Each node of the path, with the number of its flows that were followed.
        let mut path: Vec<(usize, usize)> = vec![(start, 0)];
        let mut open = BTreeSet::from([start]);
        seen.insert(start);
        while let Some((node, followed)) = path.last_mut() {
            let next = behind.get(node).and_then(|edges| edges.get(*followed));
            let Some((number, edge)) = next.and_then(|edge| Some((*edge, flow.edges.get(*edge)?)))
            else {
                open.remove(node);
                path.pop();
                continue;
            };
            *followed += 1;
            if open.contains(&edge.to) {
                returns.insert(number);
            } else if seen.insert(edge.to) {
                open.insert(edge.to);
                path.push((edge.to, 0));
            }
        }
    }
    returns
}
