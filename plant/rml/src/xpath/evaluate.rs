//! The evaluation of expressions on a document.

use std::collections::HashMap;
use std::rc::Rc;
use std::sync::Arc;

use roxmltree::{Document, Node, NodeId};

use super::fault::{Evaluated, EvaluationFault};
use super::functions::{any_pair, bounded, count, holds, of_number, to_number};
use super::{
    Axis, Comparison, Expr, Join, LocationPath, NamespaceTest, Operator, Start, StepTest, XPathStep,
};

/// A node or an attribute of a document. The order is that of the document.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub(crate) struct NodeRef {
    pub(super) id: u32,
    /// 0 for the node itself, else the number of its attribute, from 1.
    pub(super) attribute: u32,
}

/// The remaining work of a run: visited nodes, and bytes of text.
#[derive(Debug)]
pub(crate) struct WorkBudget {
    left: u64,
    most: u64,
}

impl WorkBudget {
    pub(crate) fn new(most: u64) -> Self {
        Self { left: most, most }
    }

    pub(crate) fn spend(&mut self, amount: usize) -> Evaluated<()> {
        let amount = u64::try_from(amount).unwrap_or(u64::MAX);
        let left = self.left.checked_sub(amount);
        self.left = left.ok_or(EvaluationFault::Work(self.most))?;
        Ok(())
    }
}

/// The value of an expression.
#[derive(Debug)]
pub(super) enum XPathValue {
    Nodes(Vec<NodeRef>),
    Text(String),
    Number(f64),
    Boolean(bool),
}

/// The context of an expression (XPath 1.0, 1), and the node of the row.
#[derive(Debug, Clone, Copy)]
pub(super) struct XPathContext {
    pub(super) node: NodeRef,
    pub(super) position: usize,
    pub(super) size: usize,
    pub(super) row: NodeRef,
}

type Nodes = Rc<Vec<NodeRef>>;
type Table = Rc<HashMap<String, Vec<NodeRef>>>;

/// Evaluates expressions on a document, with the indexes of its absolute paths.
pub(crate) struct Evaluator<'a> {
    pub(super) document: &'a Document<'a>,
    fixed: HashMap<Arc<str>, Nodes>,
    tables: HashMap<Arc<str>, Table>,
}

impl<'a> Evaluator<'a> {
    pub(crate) fn new(document: &'a Document<'a>) -> Self {
        Self {
            document,
            fixed: HashMap::new(),
            tables: HashMap::new(),
        }
    }

    /// Returns the nodes of an expression at the root of the document.
    pub(crate) fn rows(&mut self, expr: &Expr, work: &mut WorkBudget) -> Evaluated<Vec<NodeRef>> {
        let root = itself(self.document.root());
        match self.evaluate(expr, XPathContext::of(root), work)? {
            XPathValue::Nodes(nodes) => Ok(nodes),
            XPathValue::Text(_) | XPathValue::Number(_) | XPathValue::Boolean(_) => {
                Err(EvaluationFault::Iterator)
            }
        }
    }

    /// Returns the values of an expression for a row: one per node, or the only value.
    pub(crate) fn values(
        &mut self,
        expr: &Expr,
        row: NodeRef,
        work: &mut WorkBudget,
    ) -> Evaluated<Vec<String>> {
        match self.evaluate(expr, XPathContext::of(row), work)? {
            XPathValue::Nodes(nodes) => self.texts(&nodes, work),
            other @ (XPathValue::Text(_) | XPathValue::Number(_) | XPathValue::Boolean(_)) => {
                Ok(vec![self.text(other, work)?])
            }
        }
    }

    fn evaluate(
        &mut self,
        expr: &Expr,
        at: XPathContext,
        work: &mut WorkBudget,
    ) -> Evaluated<XPathValue> {
        work.spend(1)?;
        Ok(match expr {
            Expr::Or(a, b) => {
                XPathValue::Boolean(self.truth(a, at, work)? || self.truth(b, at, work)?)
            }
            Expr::And(a, b) => {
                XPathValue::Boolean(self.truth(a, at, work)? && self.truth(b, at, work)?)
            }
            Expr::Compare(comparison, a, b) => {
                let a = self.evaluate(a, at, work)?;
                let b = self.evaluate(b, at, work)?;
                XPathValue::Boolean(self.compare(*comparison, a, b, work)?)
            }
            Expr::Calculate(operator, a, b) => {
                let a = self.evaluate_number(a, at, work)?;
                let b = self.evaluate_number(b, at, work)?;
                XPathValue::Number(match operator {
                    Operator::Add => a + b,
                    Operator::Subtract => a - b,
                    Operator::Multiply => a * b,
                    Operator::Divide => a / b,
                    Operator::Remainder => a % b,
                })
            }
            Expr::Negate(a) => XPathValue::Number(-self.evaluate_number(a, at, work)?),
            Expr::Union(a, b) => {
                let mut nodes = self.evaluate_nodes(a, at, work)?;
                nodes.extend(self.evaluate_nodes(b, at, work)?);
                ordered(&mut nodes);
                XPathValue::Nodes(nodes)
            }
            Expr::Path(path) => XPathValue::Nodes(self.path(path, at, work)?),
            Expr::Text(text) => XPathValue::Text(text.clone()),
            Expr::Number(number) => XPathValue::Number(*number),
            Expr::Call(function, all) => self.call(*function, all, at, work)?,
        })
    }

    pub(super) fn evaluate_nodes(
        &mut self,
        expr: &Expr,
        at: XPathContext,
        work: &mut WorkBudget,
    ) -> Evaluated<Vec<NodeRef>> {
        match self.evaluate(expr, at, work)? {
            XPathValue::Nodes(nodes) => Ok(nodes),
            XPathValue::Text(_) | XPathValue::Number(_) | XPathValue::Boolean(_) => {
                Err(EvaluationFault::NoPath)
            }
        }
    }

    pub(super) fn evaluate_text(
        &mut self,
        expr: &Expr,
        at: XPathContext,
        work: &mut WorkBudget,
    ) -> Evaluated<String> {
        let value = self.evaluate(expr, at, work)?;
        self.text(value, work)
    }

    pub(super) fn evaluate_number(
        &mut self,
        expr: &Expr,
        at: XPathContext,
        work: &mut WorkBudget,
    ) -> Evaluated<f64> {
        let value = self.evaluate(expr, at, work)?;
        self.number(value, work)
    }

    pub(super) fn truth(
        &mut self,
        expr: &Expr,
        at: XPathContext,
        work: &mut WorkBudget,
    ) -> Evaluated<bool> {
        Ok(boolean(&self.evaluate(expr, at, work)?))
    }

    fn path(
        &mut self,
        path: &LocationPath,
        at: XPathContext,
        work: &mut WorkBudget,
    ) -> Evaluated<Vec<NodeRef>> {
        let (mut nodes, mut done) = match (&path.start, &path.index) {
            (Start::Context, _) => (vec![at.node], 0),
            (Start::Root, Some(index)) => {
                let leading = path.steps.get(..index.steps).unwrap_or_default();
                let fixed = self.fixed(&index.key, leading, work)?;
                match (&index.join, path.steps.get(index.steps)) {
                    (Some(join), Some(step)) => {
                        let found = self.joined(&fixed, (step, join), at, work)?;
                        (found, index.steps + 1)
                    }
                    _ => {
                        work.spend(fixed.len())?;
                        (fixed.to_vec(), index.steps)
                    }
                }
            }
            (Start::Root, None) => (vec![itself(self.document.root())], 0),
            (Start::Filter(start, predicates), _) => {
                let mut nodes = self.evaluate_nodes(start, at, work)?;
                for predicate in predicates {
                    nodes = self.filter(nodes, predicate, at.row, work)?;
                }
                (nodes, 0)
            }
        };
        while let Some(step) = path.steps.get(done) {
            nodes = self.step(&nodes, step, at.row, work)?;
            done += 1;
        }
        Ok(nodes)
    }

    /// Returns the nodes of the leading steps of an absolute path.
    fn fixed(
        &mut self,
        key: &Arc<str>,
        steps: &[XPathStep],
        work: &mut WorkBudget,
    ) -> Evaluated<Nodes> {
        if let Some(known) = self.fixed.get(key) {
            return Ok(Rc::clone(known));
        }
        let root = itself(self.document.root());
        let mut nodes = vec![root];
        for step in steps {
            nodes = self.step(&nodes, step, root, work)?;
        }
        let nodes = Rc::new(nodes);
        self.fixed.insert(Arc::clone(key), Rc::clone(&nodes));
        Ok(nodes)
    }

    /// Returns the nodes of a step with values equal to the values of the probe.
    fn joined(
        &mut self,
        before: &[NodeRef],
        (step, join): (&XPathStep, &Join),
        at: XPathContext,
        work: &mut WorkBudget,
    ) -> Evaluated<Vec<NodeRef>> {
        let table = match self.tables.get(&join.key) {
            Some(known) => Rc::clone(known),
            None => {
                let all = XPathStep {
                    axis: step.axis,
                    test: step.test.clone(),
                    predicates: Vec::new(),
                };
                let mut table: HashMap<String, Vec<NodeRef>> = HashMap::new();
                for node in self.step(before, &all, at.row, work)? {
                    for value in self.values(&join.candidate, node, work)? {
                        table.entry(value).or_default().push(node);
                    }
                }
                let table = Rc::new(table);
                self.tables.insert(Arc::clone(&join.key), Rc::clone(&table));
                table
            }
        };
        let probes = match self.evaluate(&join.probe, at, work)? {
            XPathValue::Nodes(nodes) => self.texts(&nodes, work)?,
            other @ (XPathValue::Text(_) | XPathValue::Number(_) | XPathValue::Boolean(_)) => {
                vec![self.text(other, work)?]
            }
        };
        let mut nodes = Vec::new();
        for probe in &probes {
            let found = table.get(probe).map_or(&[][..], Vec::as_slice);
            work.spend(found.len())?;
            nodes.extend_from_slice(found);
        }
        ordered(&mut nodes);
        for predicate in join.rest.iter() {
            nodes = self.filter(nodes, predicate, at.row, work)?;
        }
        Ok(nodes)
    }

    fn step(
        &mut self,
        before: &[NodeRef],
        step: &XPathStep,
        row: NodeRef,
        work: &mut WorkBudget,
    ) -> Evaluated<Vec<NodeRef>> {
        let mut all = Vec::new();
        let mut compact_at = COMPACT_AT;
        for node in before {
            let mut found = self.axis(*node, step, work)?;
            for predicate in &step.predicates {
                found = self.filter(found, predicate, row, work)?;
            }
            all.append(&mut found);
            if all.len() > compact_at {
                ordered(&mut all);
                compact_at = all.len().saturating_mul(2).max(COMPACT_AT);
            }
        }
        if before.len() > 1 || step.axis.is_reverse() {
            ordered(&mut all);
        }
        Ok(all)
    }

    fn filter(
        &mut self,
        nodes: Vec<NodeRef>,
        predicate: &Expr,
        row: NodeRef,
        work: &mut WorkBudget,
    ) -> Evaluated<Vec<NodeRef>> {
        let size = nodes.len();
        let mut kept = Vec::new();
        for (at, node) in nodes.into_iter().enumerate() {
            let context = XPathContext {
                node,
                position: at + 1,
                size,
                row,
            };
            let holds = match self.evaluate(predicate, context, work)? {
                XPathValue::Number(number) => number == count(at + 1),
                other @ (XPathValue::Nodes(_) | XPathValue::Text(_) | XPathValue::Boolean(_)) => {
                    boolean(&other)
                }
            };
            if holds {
                kept.push(node);
            }
        }
        Ok(kept)
    }

    /// Returns the nodes of an axis that pass the test, in the order of the axis.
    fn axis(
        &self,
        from: NodeRef,
        step: &XPathStep,
        work: &mut WorkBudget,
    ) -> Evaluated<Vec<NodeRef>> {
        let Some(node) = self.document.get_node(NodeId::new(from.id)) else {
            return Ok(Vec::new());
        };
        let mut found = FoundNodes {
            step,
            all: Vec::new(),
            work,
        };
        if from.attribute > 0 {
            // Attributes have a parent, and neither children nor siblings.
            match step.axis {
                Axis::Itself | Axis::AncestorOrSelf | Axis::DescendantOrSelf => {
                    if self.attribute_passes(node, from, &step.test, step.axis)? {
                        found.all.push(from);
                    }
                    if step.axis == Axis::AncestorOrSelf {
                        found.nodes(node.ancestors())?;
                    }
                }
                Axis::Parent => found.nodes(std::iter::once(node))?,
                Axis::Ancestor => found.nodes(node.ancestors())?,
                Axis::Following => {
                    found.nodes(node.descendants().skip(1))?;
                    found.following(node)?;
                }
                Axis::Preceding => found.preceding(node)?,
                Axis::Attribute
                | Axis::Child
                | Axis::Descendant
                | Axis::FollowingSibling
                | Axis::PrecedingSibling => {}
            }
            return Ok(found.all);
        }
        match step.axis {
            Axis::Attribute => {
                for number in 1..=node.attributes().len() {
                    found.work.spend(1)?;
                    let attribute = NodeRef {
                        id: from.id,
                        attribute: u32::try_from(number).unwrap_or(u32::MAX),
                    };
                    if self.attribute_passes(node, attribute, &step.test, step.axis)? {
                        found.all.push(attribute);
                    }
                }
            }
            Axis::Ancestor => found.nodes(node.ancestors().skip(1))?,
            Axis::AncestorOrSelf => found.nodes(node.ancestors())?,
            Axis::Child => found.nodes(node.children())?,
            Axis::Descendant => found.nodes(node.descendants().skip(1))?,
            Axis::DescendantOrSelf => found.nodes(node.descendants())?,
            Axis::Following => found.following(node)?,
            Axis::FollowingSibling => found.nodes(node.next_siblings().skip(1))?,
            Axis::Parent => found.nodes(node.parent().into_iter())?,
            Axis::Preceding => found.preceding(node)?,
            Axis::PrecedingSibling => found.nodes(node.prev_siblings().skip(1))?,
            Axis::Itself => found.nodes(std::iter::once(node))?,
        }
        Ok(found.all)
    }

    fn attribute_passes(
        &self,
        node: Node<'_, '_>,
        attribute: NodeRef,
        test: &StepTest,
        axis: Axis,
    ) -> Evaluated<bool> {
        match test {
            StepTest::Node => Ok(true),
            // A name tests elements on all axes but that of attributes.
            StepTest::Name(space, name) if axis == Axis::Attribute => {
                let index = usize::try_from(attribute.attribute).unwrap_or(usize::MAX);
                let Some(attribute) = node.attributes().nth(index.wrapping_sub(1)) else {
                    return Ok(false);
                };
                let is_named = name.as_ref().is_none_or(|name| name == attribute.name());
                Ok(is_named && in_space(space, attribute.namespace(), self.document)?)
            }
            StepTest::Name(..) | StepTest::Text | StepTest::Comment | StepTest::Instruction(_) => {
                Ok(false)
            }
        }
    }

    pub(super) fn texts(&self, nodes: &[NodeRef], work: &mut WorkBudget) -> Evaluated<Vec<String>> {
        nodes.iter().map(|node| self.of_node(*node, work)).collect()
    }

    /// Returns the string value of a node (XPath 1.0, 5).
    pub(super) fn of_node(&self, node: NodeRef, work: &mut WorkBudget) -> Evaluated<String> {
        let mut all = String::new();
        let Some(found) = self.document.get_node(NodeId::new(node.id)) else {
            return Ok(all);
        };
        if let Some(index) = node.attribute.checked_sub(1) {
            let index = usize::try_from(index).unwrap_or(usize::MAX);
            let attribute = found.attributes().nth(index);
            all.push_str(attribute.map_or("", |attribute| attribute.value()));
        } else if found.is_element() || found.is_root() {
            for inner in found.descendants() {
                work.spend(1)?;
                if inner.is_text() {
                    all.push_str(inner.text().unwrap_or_default());
                }
            }
        } else if let Some(instruction) = found.pi() {
            all.push_str(instruction.value.unwrap_or_default());
        } else {
            all.push_str(found.text().unwrap_or_default());
        }
        work.spend(all.len())?;
        bounded(all)
    }

    fn text(&self, value: XPathValue, work: &mut WorkBudget) -> Evaluated<String> {
        Ok(match value {
            XPathValue::Nodes(nodes) => match nodes.first() {
                Some(first) => self.of_node(*first, work)?,
                None => String::new(),
            },
            XPathValue::Text(text) => text,
            XPathValue::Number(number) => of_number(number),
            XPathValue::Boolean(is) => is.to_string(),
        })
    }

    fn number(&self, value: XPathValue, work: &mut WorkBudget) -> Evaluated<f64> {
        Ok(match value {
            XPathValue::Number(number) => number,
            XPathValue::Boolean(is) => f64::from(u8::from(is)),
            other @ (XPathValue::Nodes(_) | XPathValue::Text(_)) => {
                to_number(&self.text(other, work)?)
            }
        })
    }

    fn compare(
        &self,
        comparison: Comparison,
        a: XPathValue,
        b: XPathValue,
        work: &mut WorkBudget,
    ) -> Evaluated<bool> {
        let is_equality = matches!(comparison, Comparison::Equal | Comparison::NotEqual);
        Ok(match (a, b) {
            (XPathValue::Nodes(a), XPathValue::Nodes(b)) => {
                let (a, b) = (self.texts(&a, work)?, self.texts(&b, work)?);
                any_pair(comparison, &a, &b)
            }
            (XPathValue::Boolean(a), b) if is_equality => holds(comparison, &a, &boolean(&b)),
            (a, XPathValue::Boolean(b)) if is_equality => holds(comparison, &boolean(&a), &b),
            (XPathValue::Nodes(a), XPathValue::Text(b)) if is_equality => {
                any_pair(comparison, &self.texts(&a, work)?, &[b])
            }
            (XPathValue::Text(a), XPathValue::Nodes(b)) if is_equality => {
                any_pair(comparison, &[a], &self.texts(&b, work)?)
            }
            (XPathValue::Text(a), XPathValue::Text(b)) if is_equality => holds(comparison, &a, &b),
            (XPathValue::Nodes(a), b) => {
                let b = self.number(b, work)?;
                let a = self.texts(&a, work)?;
                a.iter().any(|a| holds(comparison, &to_number(a), &b))
            }
            (a, XPathValue::Nodes(b)) => {
                let a = self.number(a, work)?;
                let b = self.texts(&b, work)?;
                b.iter().any(|b| holds(comparison, &a, &to_number(b)))
            }
            (a, b) => {
                let (a, b) = (self.number(a, work)?, self.number(b, work)?);
                holds(comparison, &a, &b)
            }
        })
    }
}

impl XPathContext {
    fn of(node: NodeRef) -> Self {
        Self {
            node,
            position: 1,
            size: 1,
            row: node,
        }
    }
}

/// The nodes of an axis that pass the test of a step.
struct FoundNodes<'s, 'w> {
    step: &'s XPathStep,
    all: Vec<NodeRef>,
    work: &'w mut WorkBudget,
}

impl FoundNodes<'_, '_> {
    fn nodes<'d, 'i: 'd>(
        &mut self,
        candidates: impl Iterator<Item = Node<'d, 'i>>,
    ) -> Evaluated<()> {
        for node in candidates {
            self.work.spend(1)?;
            if passes(node, &self.step.test)? {
                self.all.push(itself(node));
            }
        }
        Ok(())
    }

    fn following(&mut self, node: Node<'_, '_>) -> Evaluated<()> {
        for ancestor in node.ancestors() {
            self.work.spend(1)?;
            for sibling in ancestor.next_siblings().skip(1) {
                self.nodes(sibling.descendants())?;
            }
        }
        Ok(())
    }

    fn preceding(&mut self, node: Node<'_, '_>) -> Evaluated<()> {
        for ancestor in node.ancestors() {
            self.work.spend(1)?;
            for sibling in ancestor.prev_siblings().skip(1) {
                self.nodes(sibling.descendants().rev())?;
            }
        }
        Ok(())
    }
}

fn itself(node: Node<'_, '_>) -> NodeRef {
    NodeRef {
        id: node.id().get(),
        attribute: 0,
    }
}

fn ordered(nodes: &mut Vec<NodeRef>) {
    nodes.sort_unstable();
    nodes.dedup();
}

fn passes(node: Node<'_, '_>, test: &StepTest) -> Evaluated<bool> {
    Ok(match test {
        StepTest::Node => true,
        StepTest::Text => node.is_text(),
        StepTest::Comment => node.is_comment(),
        StepTest::Instruction(target) => node
            .pi()
            .is_some_and(|found| target.as_ref().is_none_or(|target| target == found.target)),
        StepTest::Name(space, name) => {
            let tag = node.tag_name();
            node.is_element()
                && name.as_ref().is_none_or(|name| name == tag.name())
                && in_space(space, tag.namespace(), node.document())?
        }
    })
}

fn in_space(
    space: &NamespaceTest,
    namespace: Option<&str>,
    document: &Document<'_>,
) -> Evaluated<bool> {
    match space {
        NamespaceTest::Any => Ok(true),
        NamespaceTest::None => Ok(namespace.is_none()),
        NamespaceTest::Uri(uri) => Ok(namespace == Some(uri)),
        NamespaceTest::OfDocument(prefix) => {
            let root = document.root_element();
            match root.lookup_namespace_uri(Some(prefix)) {
                Some(uri) => Ok(namespace == Some(uri)),
                None => Err(EvaluationFault::Prefix(prefix.clone())),
            }
        }
    }
}

fn boolean(value: &XPathValue) -> bool {
    match value {
        XPathValue::Nodes(nodes) => !nodes.is_empty(),
        XPathValue::Text(text) => !text.is_empty(),
        XPathValue::Number(number) => *number != 0.0 && !number.is_nan(),
        XPathValue::Boolean(is) => *is,
    }
}

const COMPACT_AT: usize = 1 << 20;
