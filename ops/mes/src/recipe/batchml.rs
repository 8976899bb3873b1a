//! Master and control recipes of BatchML (B2MML, `BatchInformation`).
//!
//! Steps and transitions have the meaning of a sequential function chart: a transition with several
//! steps before it waits for all of them, and a step with several transitions behind it takes the
//! first whose condition holds. A transition that leads to an earlier step is a loop. Recipe
//! elements with a procedure logic of their own are replaced by it; the others are steps.

mod formula;

use std::collections::BTreeMap;

use mtp::escaped;
use roxmltree::Node;

use super::flow::{
    Edge, Flow, FlowNodeKind, MOST_FLOW_NODES, NodeCondition, RecipeSequence, too_large,
};
use super::values;
use super::{Reading, child, children, text_of};
use crate::process::{Need, Process, ProcessStep, SkillRole, StepJob};
use crate::read_process::{USUALLY_WAIT, USUALLY_WITHIN};

use formula::{Formula, StepReference};

pub(super) const NAMESPACE: &str = "http://www.mesa.org/xml/B2MML";

/// A recipe that is being read.
struct RecipeParts<'d> {
    formula: Formula<'d>,
    /// Recipe elements that other elements refer to.
    blocks: Vec<Node<'d, 'd>>,
    flow: Flow,
    /// The nodes of the steps by the IDs of the steps; `None` if several steps have the ID.
    steps: BTreeMap<&'d str, Option<usize>>,
    /// Parameters with the result of a step, with the nodes of the steps that take them.
    results: Vec<(usize, StepReference)>,
}

/// The first and the last node of a procedure logic.
type Ends = (usize, usize);

/// The nodes of a procedure logic, by `ProcessStep`, `Transition` or `Link` and the ID.
type Places<'d> = BTreeMap<(&'d str, &'d str), Ends>;

impl<'d> Reading<'d> {
    /// Reads all recipes of a file.
    pub(super) fn batchml(&mut self, root: Node<'d, 'd>) -> Vec<Process> {
        let is_recipe = |node: &Node<'_, '_>| {
            ["MasterRecipe", "ControlRecipe"].contains(&node.tag_name().name())
        };
        if is_recipe(&root) {
            return self.recipe(root, Vec::new()).into_iter().collect();
        }
        self.only(
            root,
            &[
                "Description",
                "MasterRecipe",
                "ControlRecipe",
                "RecipeBuildingBlock",
            ],
        );
        let blocks = children(root, "RecipeBuildingBlock");
        let blocks: Vec<_> = blocks
            .flat_map(|block| children(block, "RecipeElement"))
            .collect();
        let recipes: Vec<_> = root.children().filter(is_recipe).collect();
        let processes = recipes.into_iter();
        processes
            .filter_map(|recipe| self.recipe(recipe, blocks.clone()))
            .collect()
    }

    fn recipe(&mut self, recipe: Node<'d, 'd>, blocks: Vec<Node<'d, 'd>>) -> Option<Process> {
        self.only(
            recipe,
            &[
                "ID",
                "Version",
                "VersionDate",
                "Description",
                "BatchID",
                "EquipmentRequirement",
                "Formula",
                "ProcedureLogic",
                "RecipeElement",
            ],
        );
        self.constraints(recipe);
        let id = text_of(recipe, "ID");
        if id.is_empty() {
            self.error(recipe, "the recipe has no ID".to_owned());
            return None;
        }
        let mut parts = RecipeParts {
            formula: Formula::of(recipe),
            blocks,
            flow: Flow::default(),
            steps: BTreeMap::new(),
            results: Vec::new(),
        };
        let start = parts
            .flow
            .node(recipe.range().start, id, FlowNodeKind::Start);
        let (first, _) = self.logic(recipe, &mut parts, &mut vec![recipe])?;
        parts
            .flow
            .edge(start, first, recipe.range().start, Vec::new());
        let flow = self.resolved(parts);
        let RecipeSequence { steps, loops } = self.sequence(&flow)?;
        let description = text_of(recipe, "Description");
        Some(Process {
            iri: self.iri(id, "recipe"),
            name: if description.is_empty() {
                id
            } else {
                description
            }
            .to_owned(),
            work: StepJob::Sequence,
            steps,
            loops,
            within: USUALLY_WITHIN,
            wait: USUALLY_WAIT,
        })
    }

    /// Sets the steps whose results are parameters.
    fn resolved(&mut self, parts: RecipeParts<'d>) -> Flow {
        let RecipeParts {
            mut flow,
            steps,
            results,
            ..
        } = parts;
        for (
            node,
            StepReference {
                parameter,
                step,
                at,
            },
        ) in results
        {
            let Some(step) = steps.get(step.as_str()).copied().flatten() else {
                let what = format!(
                    "the value refers to the step `{step}`, which is unknown or not the only one"
                );
                self.error_at(at, what);
                continue;
            };
            if let Some(FlowNodeKind::Task(task)) =
                flow.nodes.get_mut(node).map(|node| &mut node.kind)
                && let Some(given) = task.parameters.get_mut(parameter)
                && let Some(result) = given.result.as_mut()
            {
                result.step = step;
            }
        }
        flow
    }

    /// Adds the steps of a recipe or of a recipe element. `open` has the elements around it.
    fn logic(
        &mut self,
        parent: Node<'d, 'd>,
        parts: &mut RecipeParts<'d>,
        open: &mut Vec<Node<'d, 'd>>,
    ) -> Option<Ends> {
        let name = text_of(parent, "ID");
        let at = parent.range().start;
        let Some(logic) = child(parent, "ProcedureLogic") else {
            let what = format!("`{name}` has recipe elements, and no ProcedureLogic orders them");
            self.error(parent, what);
            return None;
        };
        self.only(logic, &["Link", "Step", "Transition"]);
        let first = parts.flow.node(at, name, FlowNodeKind::Merge);
        let last = parts.flow.node(at, name, FlowNodeKind::Merge);
        let (places, conditions) = self.places((parent, logic), parts, open)?;
        self.links(logic, &places, parts);
        let mut own: Vec<usize> = places
            .values()
            .flat_map(|(one, other)| [*one, *other])
            .collect();
        own.sort_unstable();
        own.dedup();
        self.transitions(&places, &conditions, parts);
        let is_inside = |edge: &&Edge| own.contains(&edge.from) && own.contains(&edge.to);
        let inside: Vec<(usize, usize)> = parts
            .flow
            .edges
            .iter()
            .filter(is_inside)
            .map(|edge| (edge.from, edge.to))
            .collect();
        // A step to which no link leads would begin at once: only one step does.
        let starts = places.values().map(|ends| ends.0);
        let mut starts: Vec<usize> = starts
            .filter(|start| !inside.iter().any(|(_, to)| to == start))
            .collect();
        if starts.is_empty() {
            // A loop may return to the first step, which is the first one of the file.
            let steps = places.iter().filter(|((kind, _), _)| *kind == "Step");
            starts.extend(steps.map(|(_, ends)| ends.0).min());
        }
        if starts.len() > 1 {
            let names = starts.iter().filter_map(|node| parts.flow.nodes.get(*node));
            let names: Vec<&str> = names.map(|node| node.name.as_str()).collect();
            let what = format!(
                "no link leads to {}; only one step can be the first",
                names.join(", ")
            );
            self.error(logic, what);
        }
        for start in starts {
            parts.flow.edge(first, start, at, Vec::new());
        }
        let lasts = places.values().map(|ends| ends.1);
        let lasts: Vec<usize> = lasts
            .filter(|end| !inside.iter().any(|(from, _)| from == end))
            .collect();
        for end in lasts {
            parts.flow.edge(end, last, at, Vec::new());
        }
        if places.is_empty() {
            parts.flow.edge(first, last, at, Vec::new());
        }
        Some((first, last))
    }

    /// Adds the nodes of the steps, transitions and links of a procedure logic.
    fn places(
        &mut self,
        (parent, logic): (Node<'d, 'd>, Node<'d, 'd>),
        parts: &mut RecipeParts<'d>,
        open: &mut Vec<Node<'d, 'd>>,
    ) -> Option<(Places<'d>, BTreeMap<usize, Node<'d, 'd>>)> {
        // Elements that are used several times on each level multiply their numbers.
        let more = logic.children().filter(Node::is_element).count();
        if parts.flow.nodes.len().saturating_add(more) > MOST_FLOW_NODES {
            self.error(logic, too_large());
            return None;
        }
        let mut is_whole = true;
        let mut places: Places<'d> = BTreeMap::new();
        let mut conditions: BTreeMap<usize, Node<'d, 'd>> = BTreeMap::new();
        for step in children(logic, "Step") {
            self.only(
                step,
                &[
                    "ID",
                    "RecipeElementID",
                    "RecipeElementVersion",
                    "Description",
                ],
            );
            // The other steps have findings too.
            let Some(ends) = self.step(step, parent, parts, open) else {
                is_whole = false;
                continue;
            };
            if places.insert(("Step", text_of(step, "ID")), ends).is_some() {
                self.error(
                    step,
                    format!("there are two steps `{}`", text_of(step, "ID")),
                );
            }
        }
        for transition in children(logic, "Transition") {
            self.only(
                transition,
                &["ID", "Condition", "ConditionAnnotation", "Description"],
            );
            let id = text_of(transition, "ID");
            let node = parts
                .flow
                .node(transition.range().start, id, FlowNodeKind::Join);
            conditions.insert(node, transition);
            places.insert(("Transition", id), (node, node));
        }
        for link in children(logic, "Link") {
            let kind = match text_of(link, "LinkType") {
                "ControlLink" | "ParallelDivergent" | "SerialDivergent" | "SerialConvergent" => {
                    FlowNodeKind::Merge
                }
                "ParallelConvergent" => FlowNodeKind::Join,
                other => {
                    let id = text_of(link, "ID");
                    let what = format!(
                        "the link `{id}` has the LinkType `{other}`; links of control only are supported"
                    );
                    self.error(link, what);
                    continue;
                }
            };
            let id = text_of(link, "ID");
            let node = parts.flow.node(link.range().start, id, kind);
            places.insert(("Link", id), (node, node));
        }
        is_whole.then_some((places, conditions))
    }

    /// Adds the flows between the nodes of a procedure logic.
    fn links(&mut self, logic: Node<'d, 'd>, places: &Places<'d>, parts: &mut RecipeParts<'d>) {
        for link in children(logic, "Link") {
            self.only(
                link,
                &[
                    "ID",
                    "FromID",
                    "ToID",
                    "LinkType",
                    "Depiction",
                    "EvaluationOrder",
                    "Description",
                ],
            );
            let Some((node, _)) = places.get(&("Link", text_of(link, "ID"))).copied() else {
                continue;
            };
            let at = link.range().start;
            for (end, value, kind) in [
                ("FromID", "FromIDValue", "FromType"),
                ("ToID", "ToIDValue", "ToType"),
            ] {
                for named in children(link, end) {
                    let (kind, value) = (text_of(named, kind), text_of(named, value));
                    match places.get(&(kind, value)) {
                        Some((_, last)) if end == "FromID" => {
                            parts.flow.edge(*last, node, at, Vec::new());
                        }
                        Some((first, _)) => parts.flow.edge(node, *first, at, Vec::new()),
                        None => {
                            let what =
                                format!("the link names the {kind} `{value}`, which is unknown");
                            self.error(named, what);
                        }
                    }
                }
            }
        }
    }

    /// Sets the conditions of the flows behind transitions. Of several transitions behind a step
    /// the first whose condition holds is taken.
    fn transitions(
        &mut self,
        places: &Places<'d>,
        conditions: &BTreeMap<usize, Node<'d, 'd>>,
        parts: &mut RecipeParts<'d>,
    ) {
        for ((kind, _), (_, step)) in places {
            if *kind != "Step" {
                continue;
            }
            // Links between a step and its transitions are nodes of their own.
            let mut behind: Vec<usize> = Vec::new();
            let mut look = vec![*step];
            let mut seen = Vec::new();
            while let Some(from) = look.pop() {
                for edge in parts.flow.edges.iter().filter(|edge| edge.from == from) {
                    if conditions.contains_key(&edge.to) {
                        behind.push(edge.to);
                    } else if !seen.contains(&edge.to) {
                        seen.push(edge.to);
                        let is_link = places
                            .iter()
                            .any(|((kind, _), (node, _))| *kind == "Link" && *node == edge.to);
                        look.extend(is_link.then_some(edge.to));
                    }
                }
            }
            behind.sort_unstable();
            behind.dedup();
            let count = behind.len();
            let mut own: Vec<Vec<NodeCondition>> = Vec::new();
            for (number, node) in behind.iter().enumerate() {
                let Some(transition) = conditions.get(node).copied() else {
                    continue;
                };
                let condition = self.transition(transition, parts);
                let is_last = number + 1 == count;
                if count == 1 && condition.is_some() {
                    let id = text_of(transition, "ID");
                    let what = format!(
                        "the transition `{id}` waits until a value has changed, which is not \
                         supported; use a phase that ends then"
                    );
                    self.error(transition, what);
                } else if count > 1 && (is_last == condition.is_some()) {
                    let id = text_of(transition, "ID");
                    let what = format!(
                        "of several transitions only the last has the condition True, and `{id}` {}",
                        if is_last {
                            "has another one"
                        } else {
                            "has it too"
                        }
                    );
                    self.error(transition, what);
                }
                own.push(condition.into_iter().collect());
            }
            if count < 2 {
                continue;
            }
            for (node, when) in behind.into_iter().zip(Flow::exclusive(own)) {
                for edge in parts.flow.edges.iter_mut().filter(|edge| edge.from == node) {
                    edge.when.clone_from(&when);
                }
            }
        }
    }

    /// Reads the condition of a transition; `None` if it holds when the steps before it are done.
    fn transition(
        &mut self,
        transition: Node<'d, 'd>,
        parts: &RecipeParts<'d>,
    ) -> Option<NodeCondition> {
        let text = text_of(transition, "Condition");
        let is_completed = text.starts_with("Step ") && text.ends_with(" is Completed");
        if text.is_empty() || text.eq_ignore_ascii_case("true") || is_completed {
            return None;
        }
        let node = |step: &str| parts.steps.get(step).copied().flatten();
        match values::condition(text, &node) {
            Ok(condition) => Some(condition),
            Err(why) => {
                self.error(transition, why);
                None
            }
        }
    }

    /// Adds a step with its recipe element.
    fn step(
        &mut self,
        step: Node<'d, 'd>,
        parent: Node<'d, 'd>,
        parts: &mut RecipeParts<'d>,
        open: &mut Vec<Node<'d, 'd>>,
    ) -> Option<Ends> {
        let (id, of) = (text_of(step, "ID"), text_of(step, "RecipeElementID"));
        let element = open
            .iter()
            .rev()
            .copied()
            .chain([parent])
            .flat_map(|node| children(node, "RecipeElement"))
            .find(|element| text_of(*element, "ID") == of);
        let Some(element) = element else {
            let what = format!("the step `{id}` has the recipe element `{of}`, which is unknown");
            self.error(step, what);
            return None;
        };
        self.only(
            element,
            &[
                "ID",
                "Version",
                "VersionDate",
                "Description",
                "RecipeElementType",
                "BuildingBlockElementID",
                "BuildingBlockElementVersion",
                "ActualEquipmentID",
                "EquipmentRequirement",
                "Parameter",
                "ProcedureLogic",
                "RecipeElement",
            ],
        );
        self.constraints(element);
        let block_id = text_of(element, "BuildingBlockElementID");
        let mut blocks = parts.blocks.iter();
        let block = blocks.find(|block| !block_id.is_empty() && text_of(**block, "ID") == block_id);
        let nested = [Some(element), block.copied()]
            .into_iter()
            .flatten()
            .find(|node| {
                child(*node, "ProcedureLogic").is_some() || child(*node, "RecipeElement").is_some()
            });
        let at = step.range().start;
        if let Some(nested) = nested {
            if open.contains(&nested) || open.len() >= MOST_LEVELS {
                let what = format!(
                    "the recipe element `{of}` contains itself, or more than {MOST_LEVELS} levels"
                );
                self.error(step, what);
                return None;
            }
            open.push(nested);
            let ends = self.logic(nested, parts, open);
            open.pop();
            return ends;
        }
        match text_of(element, "RecipeElementType") {
            "Begin" | "End" => {
                let node = parts.flow.node(at, id, FlowNodeKind::Merge);
                return Some((node, node));
            }
            "Allocation" => {
                let what = format!(
                    "the allocation `{of}` is left out: the plan chooses and reserves components"
                );
                self.note(element, what);
                let node = parts.flow.node(at, id, FlowNodeKind::Merge);
                return Some((node, node));
            }
            _ => {}
        }
        self.phase((step, element), block_id, parts)
    }

    /// Adds a recipe element without a procedure logic: a step of the process.
    fn phase(
        &mut self,
        (step, element): (Node<'d, 'd>, Node<'d, 'd>),
        block_id: &'d str,
        parts: &mut RecipeParts<'d>,
    ) -> Option<Ends> {
        let (id, at) = (text_of(step, "ID"), step.range().start);
        let need = self.need_of(element, block_id)?;
        let node = parts.flow.nodes.len();
        let parameters = parts.formula.parameters(element, self);
        let results = parameters.results.into_iter();
        parts.results.extend(results.map(|of| (node, of)));
        let description = text_of(step, "Description");
        let name = if description.is_empty() {
            id
        } else {
            description
        };
        let task = ProcessStep {
            name: name.to_owned(),
            needs: vec![need],
            parameters: parameters.given,
            ..ProcessStep::default()
        };
        let node = parts.flow.node(at, id, FlowNodeKind::Task(Box::new(task)));
        let known = parts.steps.entry(id);
        known
            .and_modify(|known| *known = None)
            .or_insert(Some(node));
        Some((node, node))
    }

    /// Returns the capability or the type of skills of a recipe element.
    fn need_of(&mut self, element: Node<'d, 'd>, block: &'d str) -> Option<Need> {
        let (id, description) = (text_of(element, "ID"), text_of(element, "Description"));
        let required = children(element, "EquipmentRequirement");
        let required: Vec<&str> = required.map(|node| text_of(node, "ID")).collect();
        let named = [id, block, description].into_iter().chain(required);
        let need = named
            .filter(|name| !name.is_empty())
            .find_map(|name| self.need(name));
        if need.is_some() {
            return need;
        }
        let equipment = text_of(element, "ActualEquipmentID");
        let skill = if block.is_empty() { id } else { block };
        let service = self
            .named(skill)
            .split_once(':')
            .or_else(|| self.named(skill).split_once('/'));
        let is_plain = |text: &str| !text.is_empty() && !text.contains(';');
        if let Some((service, procedure)) = service
            && [equipment, service, procedure].into_iter().all(is_plain)
            && !procedure.contains(':')
            // Tools number the elements of a recipe, as 001:Dosing.
            && service.starts_with(char::is_alphabetic)
        {
            let equipment = escaped(self.named(equipment));
            return Some(Need {
                role: SkillRole::Alone(0),
                capability: None,
                skill_type: format!(
                    "nsu=urn:ua-bridge:mtp:{equipment};{service}-{procedure}SkillType"
                )
                .parse()
                .ok(),
            })
            .filter(|need| need.skill_type.is_some());
        }
        self.error(
            element,
            format!(
                "nothing says which skill does `{id}`; name its capability, as `--name {id}=urn:..`, \
                 or give it an ActualEquipmentID (the module) and the ID service:procedure"
            ),
        );
        None
    }

    /// Notes the constraints of equipment, which no plan checks.
    fn constraints(&mut self, node: Node<'d, 'd>) {
        for requirement in children(node, "EquipmentRequirement") {
            self.only(requirement, &["ID", "Description", "Constraint"]);
            for constraint in children(requirement, "Constraint") {
                let condition = text_of(constraint, "Condition");
                self.note(
                    constraint,
                    format!("the constraint `{condition}` is not checked"),
                );
            }
        }
    }
}

/// Maximum number of levels of recipe elements.
const MOST_LEVELS: usize = 16;
