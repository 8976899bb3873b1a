//! Reads term maps: constants, templates and references.

use oxrdf::{BlankNode, Literal, NamedNode, NamedOrBlankNode, Term};

use super::fault::{TemplateFault, TriplesMapFault};
use super::{Reading, Scope, TermNode, named};
use crate::mapping::{Expression, TemplatePart, TermKind, TermMap, TermValue};
use crate::xpath::{XpathNamespaces, parse};

impl<'a> Reading<'a> {
    /// Returns the term maps of a role, and the constants of its shortcut.
    pub(super) fn term_nodes(
        &self,
        node: &NamedOrBlankNode,
        role: &str,
    ) -> Result<Vec<TermNode<'a>>, TriplesMapFault> {
        let shortcuts = self.graph.all(node, role);
        let mut all: Vec<TermNode<'a>> = shortcuts.into_iter().map(TermNode::Constant).collect();
        let property = format!("{role}Map");
        for map in self.graph.all(node, &property) {
            all.push(TermNode::Map(self.node(map, &property)?));
        }
        Ok(all)
    }

    /// Returns the graph maps, without the default graph.
    pub(super) fn graphs(
        &mut self,
        node: &'a NamedOrBlankNode,
        scope: &mut Scope<'_>,
    ) -> Result<Vec<TermMap>, TriplesMapFault> {
        let mut graphs = Vec::new();
        for graph in self.graph_nodes(node)? {
            let graph = self.term(graph, "graph", TermKind::Iri, scope)?;
            if graph.kind == TermKind::Literal {
                return Err(TriplesMapFault::Graph);
            }
            graphs.push(graph);
        }
        Ok(graphs)
    }

    /// Returns graph maps. A map in the place of the constant of `rr:graph` counts as well.
    fn graph_nodes(&self, node: &NamedOrBlankNode) -> Result<Vec<TermNode<'a>>, TriplesMapFault> {
        let mut all = self.term_nodes(node, "graph")?;
        for one in &mut all {
            if let TermNode::Constant(term @ Term::BlankNode(_)) = one
                && let Ok(map) = self.node(term, "graph")
            {
                *one = TermNode::Map(map);
            }
        }
        Ok(all)
    }

    /// Reads a term map of a role.
    pub(super) fn term(
        &mut self,
        node: TermNode<'a>,
        role: &str,
        usual: TermKind,
        scope: &Scope<'_>,
    ) -> Result<TermMap, TriplesMapFault> {
        let node = match node {
            TermNode::Constant(term) => return constant(term, role),
            TermNode::Map(node) => node,
        };
        self.known_only(scope.map, node, &format!("the {role} map"), known(role));
        if role != "subject" && !self.graph.all(node, "class").is_empty() {
            let problem = format!(
                "`class` belongs to a subject map, and is ignored in the {role} map; give the \
                 class in a triples map for these resources"
            );
            self.note(scope.map, &problem);
        }
        if let Some(term) = self.graph.one(node, "constant")? {
            return constant(term, role);
        }
        let expression = self.expression(node, scope)?;
        let expression =
            expression.ok_or_else(|| TriplesMapFault::NoExpression(role.to_owned()))?;
        let language = self.shared(node, "language", scope)?;
        let datatype = self.shared(node, "datatype", scope)?;
        if let Some(tag) = language.as_ref().and_then(Expression::constant)
            && !is_language(tag)
        {
            return Err(TriplesMapFault::Language(tag.to_owned()));
        }
        let is_literal = language.is_some() || datatype.is_some();
        let kind = match self
            .graph
            .one(node, "termType")?
            .map(|kind| (kind, named(kind)))
        {
            Some((_, Some("IRI" | "URI"))) => TermKind::Iri,
            Some((_, Some("UnsafeIRI" | "UnsafeURI"))) => TermKind::UnsafeIri,
            Some((_, Some("BlankNode"))) => TermKind::BlankNode,
            Some((_, Some("Literal"))) => TermKind::Literal,
            Some((kind, _)) => return Err(TriplesMapFault::TermType(kind.to_string())),
            None if role == "object" && (is_literal || !expression.is_template) => {
                TermKind::Literal
            }
            None => usual,
        };
        Ok(TermMap {
            value: TermValue::Expression(expression),
            kind,
            language,
            datatype,
        })
    }

    /// Reads a side of a join condition.
    pub(super) fn side(
        &mut self,
        join: &'a NamedOrBlankNode,
        side: &str,
        scope: &Scope<'_>,
    ) -> Result<Expression, TriplesMapFault> {
        if let Some(written) = self.graph.text(join, side)? {
            return reference(written, scope.namespaces);
        }
        let found = self.shared(join, side, scope)?;
        found.ok_or_else(|| TriplesMapFault::JoinSide(side.to_owned()))
    }

    /// Reads an expression that is given as a constant, or by a map.
    fn shared(
        &mut self,
        node: &'a NamedOrBlankNode,
        property: &str,
        scope: &Scope<'_>,
    ) -> Result<Option<Expression>, TriplesMapFault> {
        let text = match self.graph.one(node, property)? {
            Some(Term::Literal(text)) => Some(text.value()),
            Some(Term::NamedNode(iri)) => Some(iri.as_str()),
            Some(other) => {
                return Err(TriplesMapFault::NoTerm {
                    property: property.to_owned(),
                    found: other.to_string(),
                });
            }
            None => None,
        };
        if let Some(text) = text {
            return Ok(Some(Expression::of(text)));
        }
        let property = format!("{property}Map");
        let Some(map) = self.graph.one(node, &property)? else {
            return Ok(None);
        };
        let map = self.node(map, &property)?;
        match self.graph.one(map, "constant")? {
            Some(Term::Literal(text)) => Ok(Some(Expression::of(text.value()))),
            Some(Term::NamedNode(iri)) => Ok(Some(Expression::of(iri.as_str()))),
            _ => self.expression(map, scope),
        }
    }

    /// Reads the template or reference of a term map.
    fn expression(
        &self,
        node: &NamedOrBlankNode,
        scope: &Scope<'_>,
    ) -> Result<Option<Expression>, TriplesMapFault> {
        let written = self.graph.text(node, "template")?;
        let reference = self.graph.text(node, "reference")?;
        match (written, reference) {
            (Some(_), Some(_)) => Err(TriplesMapFault::TwoExpressions),
            (Some(written), None) => template(written, scope.namespaces).map(Some),
            (None, Some(written)) => self::reference(written, scope.namespaces).map(Some),
            (None, None) => Ok(None),
        }
    }
}

impl Expression {
    fn of(text: &str) -> Self {
        Self {
            parts: vec![TemplatePart::Text(text.to_owned())],
            is_template: false,
            written: text.to_owned(),
        }
    }

    /// Returns the text, if it is the same for all rows.
    pub(crate) fn constant(&self) -> Option<&str> {
        match self.parts.as_slice() {
            [] => Some(""),
            [TemplatePart::Text(text)] => Some(text),
            _ => None,
        }
    }
}

fn constant(term: &Term, role: &str) -> Result<TermMap, TriplesMapFault> {
    let kind = match term {
        Term::NamedNode(_) => TermKind::Iri,
        Term::BlankNode(_) => TermKind::BlankNode,
        Term::Literal(_) => TermKind::Literal,
    };
    let is_allowed = match role {
        "object" => true,
        "predicate" => kind == TermKind::Iri,
        _ => kind != TermKind::Literal,
    };
    if !is_allowed {
        return Err(TriplesMapFault::Constant {
            term: term.to_string(),
            role: role.to_owned(),
        });
    }
    Ok(TermMap {
        value: TermValue::Constant(term.clone()),
        kind,
        language: None,
        datatype: None,
    })
}

fn reference(written: &str, namespaces: &XpathNamespaces) -> Result<Expression, TriplesMapFault> {
    let expr = parse(written, namespaces).map_err(|fault| TriplesMapFault::Reference {
        written: written.to_owned(),
        fault,
    })?;
    Ok(Expression {
        parts: vec![TemplatePart::Value(expr)],
        is_template: false,
        written: written.to_owned(),
    })
}

/// Reads a template: texts with expressions in braces. A backslash escapes a brace.
fn template(written: &str, namespaces: &XpathNamespaces) -> Result<Expression, TriplesMapFault> {
    let fault = |fault: TemplateFault| TriplesMapFault::Template {
        written: written.to_owned(),
        fault,
    };
    let mut parts = Vec::new();
    let mut text = String::new();
    let mut inner: Option<String> = None;
    let mut characters = written.chars();
    while let Some(character) = characters.next() {
        let (character, is_escaped) = match character {
            '\\' => match characters.next() {
                Some(next) => (next, true),
                None => return Err(fault(TemplateFault::Backslash)),
            },
            other => (other, false),
        };
        match (character, is_escaped, &mut inner) {
            ('{', false, None) => {
                if !text.is_empty() {
                    parts.push(TemplatePart::Text(std::mem::take(&mut text)));
                }
                inner = Some(String::new());
            }
            ('}', false, Some(expression)) => {
                let expr = parse(expression, namespaces).map_err(|found| {
                    fault(TemplateFault::Expression {
                        written: expression.clone(),
                        fault: found,
                    })
                })?;
                parts.push(TemplatePart::Value(expr));
                inner = None;
            }
            ('{' | '}', false, _) => {
                return Err(fault(TemplateFault::Brace(character)));
            }
            (_, _, Some(expression)) => expression.push(character),
            (_, _, None) => text.push(character),
        }
    }
    if inner.is_some() {
        return Err(fault(TemplateFault::Open));
    }
    if !text.is_empty() {
        parts.push(TemplatePart::Text(text));
    }
    Ok(Expression {
        parts,
        is_template: true,
        written: written.to_owned(),
    })
}

/// Returns whether a text is a language tag. A language of more than three letters is reserved
/// (RFC 5646, 2.2.1).
pub(crate) fn is_language(tag: &str) -> bool {
    let first = tag.split('-').next().unwrap_or_default();
    let is_private = first.eq_ignore_ascii_case("x") || first.eq_ignore_ascii_case("i");
    (is_private || matches!(first.len(), 2 | 3))
        && Literal::new_language_tagged_literal("", tag).is_ok()
}

/// Returns whether a graph term is the default graph.
pub(crate) fn is_default_graph(graph: &NamedNode) -> bool {
    super::local(graph.as_str()) == Some("defaultGraph")
}

/// Returns a blank node with a number.
pub(crate) fn blank(number: usize) -> BlankNode {
    BlankNode::new_unchecked(format!("b{number}"))
}

fn known(role: &str) -> &'static [&'static str] {
    match role {
        "subject" => &[
            "class",
            "constant",
            "graph",
            "graphMap",
            "reference",
            "template",
            "termType",
        ],
        "object" => &[
            "class",
            "constant",
            "datatype",
            "datatypeMap",
            "language",
            "languageMap",
            "reference",
            "template",
            "termType",
        ],
        _ => &["class", "constant", "reference", "template", "termType"],
    }
}
