//! The order and the conditions of steps, from the nodes and flows of a file.
//!
//! Each node has a guard: the alternatives under which it is reached, each a list of conditions. A
//! node where branches meet again has a shorter guard than its branches, since a condition and its
//! negation cancel. A flow that returns makes a loop of the nodes between: its steps are done again
//! while the guard of the returning flow holds.

mod loops;

use std::collections::{BTreeMap, BTreeSet};

use super::Reading;
use crate::process::{
    BadEnd, Loop, LoopConditionFault, MOST_STEPS, ProcessStep, SkillRole, StepCondition, Test,
};
use loops::FlowLoops;

/// The nodes of a process, and the flows between them.
#[derive(Debug, Default)]
pub(super) struct Flow {
    pub(super) nodes: Vec<FlowNode>,
    pub(super) edges: Vec<Edge>,
}

/// A node.
#[derive(Debug)]
pub(super) struct FlowNode {
    /// Its offset in the file.
    pub(super) at: usize,
    /// Its name for findings.
    pub(super) name: String,
    pub(super) kind: FlowNodeKind,
}

#[derive(Debug)]
pub(super) enum FlowNodeKind {
    /// The process begins here.
    Start,
    /// A step. The steps in its parameters are numbers of nodes.
    Task(Box<ProcessStep>),
    /// Goes on when one of the flows to it is done.
    Merge,
    /// Goes on when all flows to it are done.
    Join,
}

/// A flow between two nodes, by their numbers.
#[derive(Debug)]
pub(super) struct Edge {
    pub(super) from: usize,
    pub(super) to: usize,
    /// Its offset in the file.
    pub(super) at: usize,
    pub(super) when: Vec<NodeCondition>,
}

/// A condition whose step is the number of a node.
pub(super) type NodeCondition = StepCondition;

/// Alternatives, each of which is a list of conditions.
type Guard = Vec<Vec<NodeCondition>>;

/// The steps of a process in an order in which they can be done, and its loops.
#[derive(Debug)]
pub(super) struct RecipeSequence {
    pub(super) steps: Vec<ProcessStep>,
    pub(super) loops: Vec<Loop>,
}

/// The properties of each node, by its number.
#[derive(Debug)]
struct Paths {
    guards: Vec<Guard>,
    /// The steps that it waits for.
    after: Vec<BTreeSet<usize>>,
}

impl Flow {
    /// Adds a node. Returns its number.
    pub(super) fn node(&mut self, at: usize, name: &str, kind: FlowNodeKind) -> usize {
        self.nodes.push(FlowNode {
            at,
            name: name.to_owned(),
            kind,
        });
        self.nodes.len() - 1
    }

    pub(super) fn edge(&mut self, from: usize, to: usize, at: usize, when: Vec<NodeCondition>) {
        self.edges.push(Edge { from, to, at, when });
    }

    /// Makes branches exclusive: a branch is taken if its own condition holds and the conditions of
    /// the branches before it do not hold. The last branch has no condition of its own.
    pub(super) fn exclusive(branches: Vec<Vec<NodeCondition>>) -> Vec<Vec<NodeCondition>> {
        let mut before: Vec<NodeCondition> = Vec::new();
        let mut all = Vec::new();
        for own in branches {
            let when = before.iter().chain(&own).cloned().collect();
            before.extend(own.iter().map(negated));
            all.push(when);
        }
        all
    }

    fn name(&self, node: usize) -> &str {
        self.nodes.get(node).map_or("", |node| node.name.as_str())
    }

    fn is_task(&self, node: usize) -> bool {
        let node = self.nodes.get(node);
        node.is_some_and(|node| matches!(node.kind, FlowNodeKind::Task(_)))
    }
}

/// Returns the finding about a condition that cannot decide about another round of the loop that
/// returns to a node with this name.
fn condition_fault(
    one: &Loop,
    head: &str,
    (steps, loops): (&[ProcessStep], &[Loop]),
) -> Option<String> {
    let name = |step: usize| steps.get(step).map_or("", |step| step.name.as_str());
    let what = match one.condition_fault(steps, loops)? {
        LoopConditionFault::MayNotBeOver(step) => format!(
            "the flow returns to `{head}` by a condition about `{}`, which may not be over then; \
             use a result of a step between",
            name(step)
        ),
        LoopConditionFault::IsConstant(step) => format!(
            "the flow returns to `{head}` by a condition about `{}` only, which holds after each \
             round or never; add a condition about a step between",
            name(step)
        ),
    };
    Some(what)
}

fn negated(condition: &NodeCondition) -> NodeCondition {
    NodeCondition {
        is_negated: !condition.is_negated,
        ..condition.clone()
    }
}

/// Returns the conditions of the flow behind a step whose bad ends other flows handle.
pub(super) fn ended_well(step: usize, handled: &[BadEnd]) -> Vec<NodeCondition> {
    let condition = |end: &BadEnd| NodeCondition {
        step,
        test: Test::Ended(*end),
        is_negated: true,
    };
    handled.iter().map(condition).collect()
}

impl Reading<'_> {
    /// Returns the steps of a flow in an order in which they can be done, and its loops.
    pub(super) fn sequence(&mut self, flow: &Flow) -> Option<RecipeSequence> {
        let before = self.errors.len();
        if flow.nodes.len() > MOST_FLOW_NODES {
            let at = flow.nodes.first().map_or(0, |node| node.at);
            self.error_at(at, too_large());
            return None;
        }
        let loops = match FlowLoops::of(flow) {
            Ok(loops) => loops,
            Err((at, what)) => {
                self.error_at(at, what);
                return None;
            }
        };
        let order = self.ordered(flow, &loops)?;
        let mut paths = Paths {
            guards: flow.nodes.iter().map(|_| Guard::new()).collect(),
            after: flow.nodes.iter().map(|_| BTreeSet::new()).collect(),
        };
        for node in &order {
            let (guard, waits) = self.reached((flow, &loops), *node, &paths)?;
            if let Some(place) = paths.guards.get_mut(*node) {
                *place = guard;
            }
            if let Some(place) = paths.after.get_mut(*node) {
                *place = waits;
            }
        }
        let tasks: Vec<usize> = order
            .into_iter()
            .filter(|node| flow.is_task(*node))
            .collect();
        if tasks.is_empty() || tasks.len() > MOST_STEPS {
            let at = flow.nodes.first().map_or(0, |node| node.at);
            let count = tasks.len();
            let what = format!("a process has from 1 to {MOST_STEPS} steps, and this one {count}");
            self.error_at(at, what);
            return None;
        }
        let numbers: BTreeMap<usize, usize> = tasks
            .iter()
            .enumerate()
            .map(|(number, node)| (*node, number))
            .collect();
        let steps = self.steps(flow, &tasks, &paths, &numbers);
        let loops = self.loops((flow, &loops), &paths, (&numbers, &steps));
        (self.errors.len() == before).then_some(RecipeSequence { steps, loops })
    }

    /// Returns the steps of tasks in their order. Numbers of steps replace the numbers of nodes.
    fn steps(
        &mut self,
        flow: &Flow,
        tasks: &[usize],
        paths: &Paths,
        numbers: &BTreeMap<usize, usize>,
    ) -> Vec<ProcessStep> {
        let mut steps = Vec::new();
        for (number, node) in tasks.iter().enumerate() {
            let Some(FlowNode {
                at,
                kind: FlowNodeKind::Task(step),
                ..
            }) = flow.nodes.get(*node)
            else {
                continue;
            };
            let mut step = (**step).clone();
            let guard = paths.guards.get(*node).cloned().unwrap_or_default();
            for need in &mut step.needs {
                need.role = SkillRole::Alone(number);
            }
            self.results(&mut step, (*at, &guard), flow, (&paths.guards, numbers));
            let is_always = guard.iter().any(Vec::is_empty);
            step.when = if is_always { Vec::new() } else { guard };
            for condition in step.when.iter_mut().flatten() {
                match numbers.get(&condition.step).filter(|of| **of < number) {
                    Some(of) => condition.step = *of,
                    None => {
                        let what = format!("a condition of `{}` is about a later step", step.name);
                        self.error_at(*at, what);
                    }
                }
            }
            let waits = paths.after.get(*node).into_iter().flatten();
            let waits: BTreeSet<usize> = waits
                .filter_map(|other| numbers.get(other))
                .copied()
                .collect();
            let is_next = match number.checked_sub(1) {
                Some(previous) => waits.iter().eq([&previous]),
                None => waits.is_empty(),
            };
            step.after = (!is_next).then(|| waits.into_iter().collect());
            steps.push(step);
        }
        steps
    }

    /// Returns the loops over these steps, which have these numbers.
    fn loops(
        &mut self,
        (flow, loops): (&Flow, &FlowLoops),
        paths: &Paths,
        (numbers, done): (&BTreeMap<usize, usize>, &[ProcessStep]),
    ) -> Vec<Loop> {
        let guarded = |edge: &Edge| {
            let guard = paths.guards.get(edge.from);
            guard.map_or_else(Guard::new, |guard| and(guard, &edge.when))
        };
        let (mut all, mut heads) = (Vec::new(), Vec::new());
        for one in &loops.all {
            let name = flow.name(one.head);
            let at = loops.back(flow, one.head).next().map_or(0, |edge| edge.at);
            let mut again = simplified(loops.back(flow, one.head).flat_map(guarded).collect());
            let ways = loops.forward(flow).filter(|edge| one.is_left_by(edge));
            let ways: Vec<&Edge> = ways.collect();
            let is_left = !ways.is_empty();
            // The condition of a way may come behind a transition.
            let unclear = loops.way_with(flow, ways, |edge| !excludes(&guarded(edge), &again));
            let steps: BTreeSet<usize> = one
                .nodes
                .iter()
                .filter_map(|node| numbers.get(node))
                .copied()
                .collect();
            if steps.is_empty() || !is_left || again.len() > MOST_ALTERNATIVES {
                let what = match (steps.is_empty(), is_left) {
                    (true, _) => format!("the loop that returns to `{name}` has no step"),
                    (_, false) => format!("no way leads out of the loop that returns to `{name}`"),
                    _ => format!(
                        "the flow returns to `{name}` in more than {MOST_ALTERNATIVES} ways"
                    ),
                };
                self.error_at(at, what);
                continue;
            }
            if let Some(edge) = unclear {
                let what = format!(
                    "the flow leaves the loop that returns to `{name}` while it returns; only one \
                     of their conditions may hold"
                );
                self.error_at(edge.at, what);
                continue;
            }
            for condition in again.iter_mut().flatten() {
                match numbers.get(&condition.step) {
                    Some(step) => condition.step = *step,
                    None => self.error_at(at, "a condition names no step".to_owned()),
                }
            }
            let read = Loop {
                steps,
                again,
                rounds: Loop::USUAL_ROUNDS,
            };
            all.push(read);
            heads.push((at, name));
        }
        // The steps of other loops may be over too.
        for (one, (at, head)) in all.iter().zip(heads) {
            if let Some(what) = condition_fault(one, head, (done, &all)) {
                self.error_at(at, what);
            }
        }
        all
    }

    /// Resolves the steps whose results are parameters: they are done whenever the step is reached.
    fn results(
        &mut self,
        step: &mut ProcessStep,
        (at, guard): (usize, &Guard),
        flow: &Flow,
        (guards, numbers): (&[Guard], &BTreeMap<usize, usize>),
    ) {
        let name = step.name.clone();
        let results = step.parameters.iter_mut();
        for (parameter, of) in
            results.filter_map(|given| Some((given.name.clone(), given.result.as_mut()?)))
        {
            let node = of.step;
            let handled = handled(flow, node);
            let done = guards
                .get(node)
                .map(|guard| and(guard, &ended_well(node, &handled)));
            let is_done = done.is_some_and(|done| implies(guard, &done));
            match numbers.get(&node).filter(|_| is_done) {
                Some(number) => of.step = *number,
                None => {
                    let of = flow.nodes.get(node).map_or("", |node| node.name.as_str());
                    self.error_at(
                        at,
                        format!(
                            "`{name}` takes {parameter} from `{of}`, which is not done whenever \
                             `{name}` begins"
                        ),
                    );
                }
            }
        }
    }

    /// Returns the nodes in an order in which each node follows the nodes that lead to it. Nodes of
    /// equal rank have the order of the file.
    fn ordered(&mut self, flow: &Flow, loops: &FlowLoops) -> Option<Vec<usize>> {
        let mut open: Vec<usize> = flow.nodes.iter().map(|_| 0).collect();
        for edge in loops.forward(flow) {
            if let Some(count) = open.get_mut(edge.to) {
                *count += 1;
            }
        }
        let mut ready: BTreeSet<usize> = BTreeSet::new();
        for ((number, node), count) in flow.nodes.iter().enumerate().zip(&open) {
            if *count > 0 {
                continue;
            }
            ready.insert(number);
            if !matches!(node.kind, FlowNodeKind::Start) {
                let what = format!("`{}` is not reached from the start", node.name);
                self.error_at(node.at, what);
            }
        }
        let mut order = Vec::new();
        while let Some(node) = ready.pop_first() {
            order.push(node);
            for edge in loops.forward(flow).filter(|edge| edge.from == node) {
                if let Some(count) = open.get_mut(edge.to) {
                    *count -= 1;
                    if *count == 0 {
                        ready.insert(edge.to);
                    }
                }
            }
        }
        if order.len() == flow.nodes.len() {
            return Some(order);
        }
        let mut nodes = flow.nodes.iter().enumerate();
        if let Some((_, node)) = nodes.find(|(number, _)| !order.contains(number)) {
            let what = format!("`{}` is not reached from the start", node.name);
            self.error_at(node.at, what);
        }
        None
    }

    /// Returns the guard of a node, and the steps that it waits for.
    fn reached(
        &mut self,
        (flow, loops): (&Flow, &FlowLoops),
        node: usize,
        paths: &Paths,
    ) -> Option<(Guard, BTreeSet<usize>)> {
        let here = flow.nodes.get(node)?;
        if matches!(here.kind, FlowNodeKind::Start) {
            return Some((vec![Vec::new()], BTreeSet::new()));
        }
        let mut waits = BTreeSet::new();
        let mut incoming: Vec<Guard> = Vec::new();
        for edge in loops.forward(flow).filter(|edge| edge.to == node) {
            incoming.push(and(paths.guards.get(edge.from)?, &edge.when));
            match flow.is_task(edge.from) {
                true => drop(waits.insert(edge.from)),
                false => waits.extend(paths.after.get(edge.from)?),
            }
            // The last round is over when all steps of the loop are.
            for one in loops.left_by(edge) {
                waits.extend(one.nodes.iter().filter(|node| flow.is_task(**node)));
            }
        }
        let guard = match here.kind {
            FlowNodeKind::Join => {
                let (first, rest) = incoming.split_first()?;
                if rest
                    .iter()
                    .any(|other| !implies(first, other) || !implies(other, first))
                {
                    let name = &here.name;
                    let what = format!("`{name}` waits for branches that do not run in every case");
                    self.error_at(here.at, what);
                    return None;
                }
                first.clone()
            }
            FlowNodeKind::Merge | FlowNodeKind::Task(_) | FlowNodeKind::Start => {
                for (number, one) in incoming.iter().enumerate() {
                    let mut later = incoming.iter().skip(number + 1);
                    if later.any(|other| !excludes(one, other)) {
                        let name = &here.name;
                        let what = format!(
                            "branches that run in parallel meet at `{name}`; join them in parallel"
                        );
                        self.error_at(here.at, what);
                        return None;
                    }
                }
                simplified(incoming.into_iter().flatten().collect())
            }
        };
        if guard.len() > MOST_ALTERNATIVES {
            let what = format!(
                "`{}` is reached in more than {MOST_ALTERNATIVES} ways",
                here.name
            );
            self.error_at(here.at, what);
            return None;
        }
        Some((guard, waits))
    }
}

/// Returns the bad ends of a step that flows handle.
pub(super) fn handled(flow: &Flow, node: usize) -> Vec<BadEnd> {
    let conditions = flow.edges.iter().flat_map(|edge| &edge.when);
    let ends = conditions.filter_map(|condition| match condition.test {
        Test::Ended(end) if condition.step == node && !condition.is_negated => Some(end),
        Test::Ended(_) | Test::Result { .. } => None,
    });
    let ends: BTreeSet<BadEnd> = ends.collect();
    ends.into_iter().collect()
}

/// Adds conditions to each alternative. Alternatives that contradict themselves are left out.
fn and(guard: &Guard, conditions: &[NodeCondition]) -> Guard {
    let mut all = Guard::new();
    for alternative in guard {
        let mut whole = alternative.clone();
        for condition in conditions {
            if !whole.contains(condition) {
                whole.push(condition.clone());
            }
        }
        if !whole
            .iter()
            .any(|condition| whole.contains(&negated(condition)))
        {
            all.push(whole);
        }
    }
    all
}

/// Returns whether no alternative of one guard holds together with one of the other.
fn excludes(one: &Guard, other: &Guard) -> bool {
    one.iter().all(|alternative| {
        other.iter().all(|known| {
            alternative
                .iter()
                .any(|condition| known.contains(&negated(condition)))
        })
    })
}

/// Returns whether each alternative of a guard contains one of the other.
fn implies(guard: &Guard, other: &Guard) -> bool {
    guard.iter().all(|alternative| {
        let contains = |known: &Vec<NodeCondition>| {
            known
                .iter()
                .all(|condition| alternative.contains(condition))
        };
        other.iter().any(contains)
    })
}

/// Joins pairs of alternatives that differ only in a condition and its negation, and removes
/// alternatives that contain another alternative.
fn simplified(mut guard: Guard) -> Guard {
    while let Some((one, other, shorter)) = joined(&guard) {
        guard.remove(other.max(one));
        guard.remove(other.min(one));
        guard.push(shorter);
    }
    let all = guard.clone();
    let mut number = 0;
    guard.retain(|alternative| {
        let this = number;
        number += 1;
        !all.iter().enumerate().any(|(at, other)| {
            let is_within = other
                .iter()
                .all(|condition| alternative.contains(condition));
            at != this && is_within && (other.len() < alternative.len() || at < this)
        })
    });
    guard
}

/// Returns the places of two alternatives that can be joined, and the joined alternative.
fn joined(guard: &Guard) -> Option<(usize, usize, Vec<NodeCondition>)> {
    for (one, first) in guard.iter().enumerate() {
        for (other, second) in guard.iter().enumerate().skip(one + 1) {
            if first.len() != second.len() {
                continue;
            }
            let mut differ = first.iter().filter(|condition| !second.contains(condition));
            let (Some(condition), None) = (differ.next(), differ.next()) else {
                continue;
            };
            if second.contains(&negated(condition)) {
                let mut shorter = first.clone();
                shorter.retain(|known| known != condition);
                return Some((one, other, shorter));
            }
        }
    }
    None
}

/// Returns the finding about a process with too many elements.
pub(super) fn too_large() -> String {
    format!("the process has more than {MOST_FLOW_NODES} steps, gateways, transitions and links")
}

/// Maximum number of nodes of a process.
pub(super) const MOST_FLOW_NODES: usize = 4_000;
/// Maximum number of alternatives of a guard.
const MOST_ALTERNATIVES: usize = 32;
