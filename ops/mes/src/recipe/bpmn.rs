//! BPMN 2.0: service tasks, sequence flows, exclusive and parallel gateways, and boundary events
//! for errors and timers.
//!
//! A service task is a step. Its capability is the `implementation`, or the name that the importer
//! gives for its ID or its name. Its parameters are assignments of its data inputs, or those of the
//! extensions of common modellers (`inputParameter`, `input`).

use std::collections::BTreeMap;
use std::time::Duration;

use roxmltree::Node;

use super::flow::{self, Flow, FlowNodeKind, NodeCondition, RecipeSequence};
use super::values::{self, WrittenValue};
use super::{Reading, child, children, text_of};
use crate::process::{BadEnd, GivenParameter, Process, ProcessStep, ResultOf, StepJob, Test};
use crate::read_process::{USUALLY_WAIT, USUALLY_WITHIN};

pub(super) const NAMESPACE: &str = "http://www.omg.org/spec/BPMN/20100524/MODEL";

/// A process that is being read.
#[derive(Default)]
struct Parts<'d> {
    flow: Flow,
    /// The nodes by the IDs of the elements.
    nodes: BTreeMap<&'d str, usize>,
    /// The tasks and the ends that boundary events handle, by the IDs of the events.
    boundaries: BTreeMap<&'d str, (usize, BadEnd)>,
    /// The IDs of the exclusive gateways, with their default flows.
    exclusive: BTreeMap<&'d str, &'d str>,
    /// Results that are parameters: the node, the place, the ID of the other task, and the element.
    results: Vec<(usize, usize, String, Node<'d, 'd>)>,
}

impl<'d> Reading<'d> {
    /// Reads all processes of a file.
    pub(super) fn bpmn(&mut self, root: Node<'d, 'd>) -> Vec<Process> {
        self.only(root, &["process", "error"]);
        let processes: Vec<_> = children(root, "process").collect();
        processes
            .into_iter()
            .filter_map(|process| self.bpmn_process(process))
            .collect()
    }

    fn bpmn_process(&mut self, process: Node<'d, 'd>) -> Option<Process> {
        let id = process.attribute("id").unwrap_or_default();
        if id.is_empty() {
            self.error(process, "the process has no id".to_owned());
            return None;
        }
        let before = self.errors.len();
        let mut parts = Parts::default();
        for element in process.children().filter(Node::is_element) {
            self.element(element, &mut parts);
        }
        for event in children(process, "boundaryEvent") {
            self.boundary(event, &mut parts);
        }
        if let Some(second) = children(process, "startEvent").nth(1) {
            let what = "the process has several start events; it is started as a whole";
            self.error(second, what.to_owned());
        }
        self.flows(process, &mut parts);
        for (node, place, of, at) in std::mem::take(&mut parts.results) {
            let Some(other) = parts.nodes.get(of.as_str()).copied() else {
                self.error(
                    at,
                    format!("a parameter is a result of the task `{of}`, which is unknown"),
                );
                continue;
            };
            if let Some(FlowNodeKind::Task(task)) =
                parts.flow.nodes.get_mut(node).map(|node| &mut node.kind)
                && let Some(result) = task
                    .parameters
                    .get_mut(place)
                    .and_then(|given| given.result.as_mut())
            {
                result.step = other;
            }
        }
        if self.errors.len() > before {
            return None;
        }
        let RecipeSequence { steps, loops } = self.sequence(&parts.flow)?;
        Some(Process {
            iri: self.iri(id, "bpmn"),
            name: process.attribute("name").unwrap_or(id).to_owned(),
            work: StepJob::Sequence,
            steps,
            loops,
            within: USUALLY_WITHIN,
            wait: USUALLY_WAIT,
        })
    }

    /// Adds the node of an element.
    fn element(&mut self, element: Node<'d, 'd>, parts: &mut Parts<'d>) {
        let kind = element.tag_name().name();
        let id = element.attribute("id").unwrap_or_default();
        let name = element
            .attribute("name")
            .filter(|name| !name.is_empty())
            .unwrap_or(id);
        let common = ["incoming", "outgoing", "documentation"];
        let node = match kind {
            "startEvent" | "endEvent" => {
                let mut inside = element.children().filter(Node::is_element);
                let special = inside.find(|child| !common.contains(&child.tag_name().name()));
                if let Some(special) = special {
                    let special_kind = special.tag_name().name();
                    self.error(
                        special,
                        format!("the {kind} `{name}` with {special_kind} is not supported"),
                    );
                }
                match kind {
                    "startEvent" => FlowNodeKind::Start,
                    _ => FlowNodeKind::Merge,
                }
            }
            "serviceTask" => {
                let node = parts.flow.nodes.len();
                let Some(task) = self.task(element, (id, name), node, parts) else {
                    return;
                };
                FlowNodeKind::Task(Box::new(task))
            }
            "exclusiveGateway" => {
                self.only(element, &common);
                parts
                    .exclusive
                    .insert(id, element.attribute("default").unwrap_or_default());
                FlowNodeKind::Merge
            }
            "parallelGateway" => {
                self.only(element, &common);
                FlowNodeKind::Join
            }
            "sequenceFlow" | "boundaryEvent" => return,
            "documentation"
            | "extensionElements"
            | "laneSet"
            | "textAnnotation"
            | "association"
            | "ioSpecification"
            | "property"
            | "dataObject"
            | "dataObjectReference"
            | "dataStoreReference"
            | "monitoring"
            | "auditing"
            | "category"
            | "group" => {
                self.note(element, format!("{kind} is left out"));
                return;
            }
            _ => {
                self.error(
                    element,
                    format!(
                        "{kind} `{name}` is not supported; use service tasks, exclusive and parallel \
                         gateways, and boundary events for errors and timers"
                    ),
                );
                return;
            }
        };
        let node = parts.flow.node(element.range().start, name, node);
        if parts.nodes.insert(id, node).is_some() || id.is_empty() {
            self.error(
                element,
                format!("{kind} `{name}` has no id, or that of another element"),
            );
        }
    }

    fn task(
        &mut self,
        task: Node<'d, 'd>,
        (id, name): (&'d str, &'d str),
        node: usize,
        parts: &mut Parts<'d>,
    ) -> Option<ProcessStep> {
        self.only(
            task,
            &[
                "incoming",
                "outgoing",
                "documentation",
                "extensionElements",
                "ioSpecification",
                "dataInputAssociation",
            ],
        );
        for loops in task.children().filter(Node::is_element) {
            let kind = loops.tag_name().name();
            if kind.ends_with("LoopCharacteristics") {
                self.error(
                    loops,
                    format!(
                        "{kind} of `{name}` is not supported; return to it by an exclusive gateway"
                    ),
                );
            }
        }
        let definition =
            child(task, "extensionElements").and_then(|all| child(all, "taskDefinition"));
        let topic = task
            .attributes()
            .find(|attribute| attribute.name() == "topic");
        let named = [
            Some(id),
            Some(name),
            task.attribute("implementation"),
            definition.and_then(|definition| definition.attribute("type")),
            topic.map(|topic| topic.value()),
        ];
        let need = named.into_iter().flatten().find_map(|name| self.need(name));
        let Some(need) = need else {
            self.error(
                task,
                format!(
                    "nothing says which skill does the task `{name}`; give it the IRI of a \
                     capability as its implementation, or as `--name {id}=urn:..`"
                ),
            );
            return None;
        };
        let given = self.task_parameters((task, name), node, parts);
        self.left_out(task);
        Some(ProcessStep {
            name: name.to_owned(),
            needs: vec![need],
            parameters: given,
            ..ProcessStep::default()
        })
    }

    /// Reads the parameters of a task.
    fn task_parameters(
        &mut self,
        (task, name): (Node<'d, 'd>, &str),
        node: usize,
        parts: &mut Parts<'d>,
    ) -> Vec<GivenParameter> {
        let mut given: Vec<GivenParameter> = Vec::new();
        for (key, text, at) in inputs(task) {
            let key = self.named(key).to_owned();
            if given.iter().any(|known| known.name == key) {
                self.error(
                    at,
                    format!("the parameter `{key}` of `{name}` is given twice"),
                );
                continue;
            }
            match values::value(text) {
                WrittenValue::Value { value, unit } => {
                    let unit = unit.map(|unit| self.named(&unit).to_owned());
                    given.push(values::given(&key, value, unit));
                }
                WrittenValue::Result(of, result) => {
                    parts.results.push((node, given.len(), of, at));
                    let mut taken = values::given(&key, serde_json::Value::Null, None);
                    taken.result = Some(ResultOf {
                        step: usize::MAX,
                        name: result,
                    });
                    given.push(taken);
                }
            }
        }
        given
    }

    /// Notes the extensions of a task that are not read.
    fn left_out(&mut self, task: Node<'d, 'd>) {
        for all in children(task, "extensionElements") {
            self.only(all, &["taskDefinition", "ioMapping", "inputOutput"]);
            for mapping in all.children().filter(Node::is_element) {
                if ["ioMapping", "inputOutput"].contains(&mapping.tag_name().name()) {
                    self.only(mapping, &["input", "inputParameter"]);
                }
            }
        }
    }

    /// Adds a boundary event: the flows behind it handle an end of its task.
    fn boundary(&mut self, event: Node<'d, 'd>, parts: &mut Parts<'d>) {
        let id = event.attribute("id").unwrap_or_default();
        let to = event.attribute("attachedToRef").unwrap_or_default();
        let Some(node) = parts.nodes.get(to).copied() else {
            self.error(
                event,
                format!("the boundary event `{id}` belongs to `{to}`, which is no task here"),
            );
            return;
        };
        if event.attribute("cancelActivity") == Some("false") {
            self.error(
                event,
                format!("the boundary event `{id}` does not end its task, which is not supported"),
            );
            return;
        }
        self.only(
            event,
            &[
                "outgoing",
                "documentation",
                "errorEventDefinition",
                "timerEventDefinition",
            ],
        );
        let end = match (
            child(event, "errorEventDefinition"),
            child(event, "timerEventDefinition"),
        ) {
            (Some(error), None) => {
                if error.attribute("errorRef").is_some() {
                    let what = format!(
                        "the error of `{id}` is not compared: the event handles each failure of its task"
                    );
                    self.note(error, what);
                }
                BadEnd::Failed
            }
            (None, Some(timer)) => {
                let text = text_of(timer, "timeDuration");
                let Some(seconds) = values::duration(text).filter(|seconds| *seconds <= LONGEST)
                else {
                    self.error(
                        timer,
                        format!("the timer `{id}` has no timeDuration of up to 7 days as PT30S"),
                    );
                    return;
                };
                if let Some(FlowNodeKind::Task(step)) =
                    parts.flow.nodes.get_mut(node).map(|node| &mut node.kind)
                {
                    step.within = Some(Duration::from_secs_f64(seconds));
                }
                BadEnd::TimedOut
            }
            _ => {
                self.error(
                    event,
                    format!("the boundary event `{id}` is of another kind than error and timer"),
                );
                return;
            }
        };
        let mut others = parts.boundaries.values();
        if others.any(|other| *other == (node, end)) {
            let end = end.name();
            self.error(
                event,
                format!("two boundary events of `{to}` handle that it {end}"),
            );
        }
        parts.boundaries.insert(id, (node, end));
    }

    /// Adds the sequence flows.
    fn flows(&mut self, process: Node<'d, 'd>, parts: &mut Parts<'d>) {
        let mut out: BTreeMap<&str, Vec<Node<'d, 'd>>> = BTreeMap::new();
        for flow in children(process, "sequenceFlow") {
            self.only(flow, &["conditionExpression", "documentation"]);
            out.entry(flow.attribute("sourceRef").unwrap_or_default())
                .or_default()
                .push(flow);
        }
        let boundaries = parts.boundaries.clone();
        for (id, (node, end)) in &boundaries {
            let Some(flows) = out.remove(id) else {
                self.error(
                    process,
                    format!("nothing follows the boundary event `{id}`"),
                );
                continue;
            };
            // A task that has failed has not timed out.
            let handler = NodeCondition {
                step: *node,
                test: Test::Ended(*end),
                is_negated: false,
            };
            let mut when = flow::ended_well(*node, &[BadEnd::Failed]);
            when.retain(|_| *end == BadEnd::TimedOut);
            let both = boundaries
                .values()
                .any(|other| *other == (*node, BadEnd::Failed));
            when.retain(|_| both);
            when.push(handler);
            for flow in flows {
                self.flow((*node, flow), when.clone(), parts);
            }
        }
        for (id, flows) in out {
            let Some(from) = parts.nodes.get(id).copied() else {
                let Some(flow) = flows.first() else { continue };
                self.error(
                    *flow,
                    format!("the flow begins at `{id}`, which is no element here"),
                );
                continue;
            };
            let handled: Vec<BadEnd> = [BadEnd::Failed, BadEnd::TimedOut]
                .into_iter()
                .filter(|end| boundaries.values().any(|other| *other == (from, *end)))
                .collect();
            let mut branches = flows;
            let default = parts.exclusive.get(id).copied();
            // The default flow is taken when no other is.
            branches.sort_by_key(|flow| flow.attribute("id").is_some_and(|id| Some(id) == default));
            let whens = self.branches(id, (&branches, default), parts);
            for (flow, own) in branches.into_iter().zip(whens) {
                let mut when = flow::ended_well(from, &handled);
                when.extend(own);
                self.flow((from, flow), when, parts);
            }
        }
    }

    /// Returns the conditions of the flows behind an element, of which the last is the default flow
    /// of an exclusive gateway.
    fn branches(
        &mut self,
        id: &str,
        (branches, default): (&[Node<'d, 'd>], Option<&'d str>),
        parts: &Parts<'d>,
    ) -> Vec<Vec<NodeCondition>> {
        let mut own: Vec<Vec<NodeCondition>> = Vec::new();
        for (flow, left) in branches.iter().zip((0..branches.len()).rev()) {
            let condition = child(*flow, "conditionExpression");
            let read = condition.map(|condition| self.expression(condition, parts));
            let what = match (&read, default) {
                (Some(_), None) => Some(format!(
                    "the flow behind `{id}` has a condition; put an exclusive gateway there"
                )),
                (Some(_), Some(_)) if left == 0 => Some(format!(
                    "the exclusive gateway `{id}` has no default flow: nothing happens if no \
                     condition holds"
                )),
                (None, Some(_)) if left > 0 => Some(format!(
                    "a flow behind the exclusive gateway `{id}` has no condition, and is not its \
                     default flow"
                )),
                (_, Some(_)) | (None, None) => None,
            };
            if let Some(what) = what {
                self.error(*flow, what);
            }
            own.push(read.flatten().into_iter().collect());
        }
        match default {
            Some(_) => Flow::exclusive(own),
            None => own,
        }
    }

    fn flow(
        &mut self,
        (from, flow): (usize, Node<'d, 'd>),
        when: Vec<NodeCondition>,
        parts: &mut Parts<'d>,
    ) {
        let to = flow.attribute("targetRef").unwrap_or_default();
        match parts.nodes.get(to) {
            Some(to) => parts.flow.edge(from, *to, flow.range().start, when),
            None => self.error(
                flow,
                format!("the flow ends at `{to}`, which is no element here"),
            ),
        }
    }

    fn expression(&mut self, condition: Node<'d, 'd>, parts: &Parts<'d>) -> Option<NodeCondition> {
        let node = |id: &str| parts.nodes.get(id).copied();
        match values::condition(condition.text().unwrap_or_default(), &node) {
            Ok(condition) => Some(condition),
            Err(why) => {
                self.error(condition, why);
                None
            }
        }
    }
}

/// Returns the parameters of a task: their names, their values, and the elements.
fn inputs<'d>(task: Node<'d, 'd>) -> Vec<(&'d str, &'d str, Node<'d, 'd>)> {
    let mut all = Vec::new();
    for association in children(task, "dataInputAssociation") {
        for assignment in children(association, "assignment") {
            all.push((
                text_of(assignment, "to"),
                text_of(assignment, "from"),
                assignment,
            ));
        }
    }
    let extensions = children(task, "extensionElements");
    for mapping in extensions.flat_map(|all| all.children().filter(Node::is_element)) {
        for input in children(mapping, "inputParameter") {
            let name = input.attribute("name").unwrap_or_default();
            all.push((name, input.text().unwrap_or_default(), input));
        }
        for input in children(mapping, "input") {
            let target = input.attribute("target").unwrap_or_default();
            all.push((target, input.attribute("source").unwrap_or_default(), input));
        }
    }
    all
}

/// Longest timer in seconds.
const LONGEST: f64 = 7.0 * 86_400.0;
