//! The functions of XPath (XPath 1.0, 4).

use roxmltree::NodeId;

use super::evaluate::{Evaluator, NodeRef, WorkBudget, XPathContext, XPathValue};
use super::fault::Evaluated;
use super::functions::{bounded, count, round, substring, to_number, translated};
use super::{Expr, Function};

impl Evaluator<'_> {
    pub(super) fn call(
        &mut self,
        function: Function,
        all: &[Expr],
        at: XPathContext,
        work: &mut WorkBudget,
    ) -> Evaluated<XPathValue> {
        let first = all.first();
        Ok(match function {
            Function::Current => XPathValue::Nodes(vec![at.row]),
            Function::Position => XPathValue::Number(count(at.position)),
            Function::Last => XPathValue::Number(count(at.size)),
            Function::True => XPathValue::Boolean(true),
            Function::False => XPathValue::Boolean(false),
            Function::Not => XPathValue::Boolean(!self.truth_of(first, at, work)?),
            Function::Boolean => XPathValue::Boolean(self.truth_of(first, at, work)?),
            Function::Count => XPathValue::Number(count(self.nodes_of(first, at, work)?.len())),
            Function::Sum => {
                let nodes = self.nodes_of(first, at, work)?;
                let texts = self.texts(&nodes, work)?;
                XPathValue::Number(texts.iter().map(|text| to_number(text)).sum())
            }
            Function::Number => XPathValue::Number(to_number(&self.text_of(first, at, work)?)),
            Function::Floor => XPathValue::Number(self.number_of(first, at, work)?.floor()),
            Function::Ceiling => XPathValue::Number(self.number_of(first, at, work)?.ceil()),
            Function::Round => XPathValue::Number(round(self.number_of(first, at, work)?)),
            Function::LocalName | Function::Name | Function::NamespaceUri => {
                let node = match first {
                    Some(expr) => self.evaluate_nodes(expr, at, work)?.first().copied(),
                    None => Some(at.node),
                };
                let name = node.map(|node| self.name(node, function));
                XPathValue::Text(name.unwrap_or_default())
            }
            Function::StringLength => {
                let text = self.text_of(first, at, work)?;
                XPathValue::Number(count(text.chars().count()))
            }
            Function::Concat => {
                let mut text = String::new();
                for part in all {
                    text.push_str(&self.evaluate_text(part, at, work)?);
                    work.spend(text.len())?;
                }
                XPathValue::Text(bounded(text)?)
            }
            Function::Substring => {
                let text = self.text_of(first, at, work)?;
                let start = self.number_of(all.get(1), at, work)?;
                let length = match all.get(2) {
                    Some(length) => Some(self.evaluate_number(length, at, work)?),
                    None => None,
                };
                XPathValue::Text(substring(&text, start, length))
            }
            Function::Translate => {
                let text = self.text_of(first, at, work)?;
                let from = self.text_of(all.get(1), at, work)?;
                let to = self.text_of(all.get(2), at, work)?;
                XPathValue::Text(bounded(translated(&text, &from, &to))?)
            }
            Function::NormalizeSpace => {
                let text = self.text_of(first, at, work)?;
                XPathValue::Text(text.split_whitespace().collect::<Vec<_>>().join(" "))
            }
            Function::String => XPathValue::Text(self.text_of(first, at, work)?),
            Function::LowerCase => XPathValue::Text(self.text_of(first, at, work)?.to_lowercase()),
            Function::UpperCase => XPathValue::Text(self.text_of(first, at, work)?.to_uppercase()),
            Function::Contains
            | Function::StartsWith
            | Function::EndsWith
            | Function::SubstringAfter
            | Function::SubstringBefore => {
                let text = self.text_of(first, at, work)?;
                let part = self.text_of(all.get(1), at, work)?;
                searched(function, &text, &part)
            }
        })
    }

    fn truth_of(
        &mut self,
        expr: Option<&Expr>,
        at: XPathContext,
        work: &mut WorkBudget,
    ) -> Evaluated<bool> {
        expr.map_or(Ok(false), |expr| self.truth(expr, at, work))
    }

    fn nodes_of(
        &mut self,
        expr: Option<&Expr>,
        at: XPathContext,
        work: &mut WorkBudget,
    ) -> Evaluated<Vec<NodeRef>> {
        expr.map_or(Ok(Vec::new()), |expr| self.evaluate_nodes(expr, at, work))
    }

    /// Returns the text of an argument, or of the node of the context.
    fn text_of(
        &mut self,
        expr: Option<&Expr>,
        at: XPathContext,
        work: &mut WorkBudget,
    ) -> Evaluated<String> {
        match expr {
            Some(expr) => self.evaluate_text(expr, at, work),
            None => self.of_node(at.node, work),
        }
    }

    fn number_of(
        &mut self,
        expr: Option<&Expr>,
        at: XPathContext,
        work: &mut WorkBudget,
    ) -> Evaluated<f64> {
        expr.map_or(Ok(f64::NAN), |expr| self.evaluate_number(expr, at, work))
    }

    fn name(&self, node: NodeRef, function: Function) -> String {
        let Some(found) = self.document.get_node(NodeId::new(node.id)) else {
            return String::new();
        };
        let (space, local) = match node.attribute.checked_sub(1) {
            None => (found.tag_name().namespace(), found.tag_name().name()),
            Some(index) => {
                let index = usize::try_from(index).unwrap_or(usize::MAX);
                match found.attributes().nth(index) {
                    Some(attribute) => (attribute.namespace(), attribute.name()),
                    None => (None, ""),
                }
            }
        };
        if function == Function::NamespaceUri {
            return space.unwrap_or_default().to_owned();
        }
        let prefix = space.and_then(|uri| found.lookup_prefix(uri));
        match prefix.filter(|_| function == Function::Name) {
            Some(prefix) => format!("{prefix}:{local}"),
            None => local.to_owned(),
        }
    }
}

fn searched(function: Function, text: &str, part: &str) -> XPathValue {
    if function == Function::Contains {
        return XPathValue::Boolean(text.contains(part));
    }
    if function == Function::StartsWith {
        return XPathValue::Boolean(text.starts_with(part));
    }
    if function == Function::EndsWith {
        return XPathValue::Boolean(text.ends_with(part));
    }
    // An empty part is at the start of each text.
    let (before, after) = text.split_once(part).unwrap_or_default();
    let found = if function == Function::SubstringAfter {
        after
    } else {
        before
    };
    XPathValue::Text(found.to_owned())
}
