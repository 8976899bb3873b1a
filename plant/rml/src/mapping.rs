//! The model of a mapping.

use std::collections::BTreeSet;

use oxrdf::{NamedNode, Term};
use thiserror::Error;

use crate::xpath::Expr;

/// A mapping of XML files to RDF.
#[derive(Debug, Clone)]
pub struct RmlMapping {
    pub(crate) sources: Vec<LogicalSource>,
    pub(crate) maps: Vec<TriplesMap>,
    pub(crate) base: String,
    pub(crate) prefixes: Vec<(String, String)>,
    pub(crate) findings: Vec<String>,
}

/// Error of a mapping, of its files, or of a run.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
#[non_exhaustive]
pub enum MappingFault {
    /// The mapping is not Turtle.
    #[error("line {line}: {problem}")]
    Turtle {
        /// Line, from 1.
        line: u64,
        /// Description of the error.
        problem: String,
    },
    /// The mapping exceeds a limit, or has no triples map.
    #[error("{0}")]
    Whole(String),
    /// A triples map is wrong.
    #[error("triples map {map}: {problem}")]
    Map {
        /// The IRI of the triples map.
        map: String,
        /// Description of the error and its remedy.
        problem: String,
    },
    /// A file cannot be read.
    #[error("triples map {map}: source `{file}`: {problem}")]
    File {
        /// The IRI of a triples map that reads it.
        map: String,
        /// The name in the mapping.
        file: String,
        /// Description of the error, with the line if it is known.
        problem: String,
    },
}

/// A file with its rows.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct LogicalSource {
    pub(crate) file: String,
    pub(crate) iterator: Expr,
    pub(crate) namespaces: Vec<(String, String)>,
    /// The iterator as written.
    pub(crate) written: String,
}

#[derive(Debug, Clone)]
pub(crate) struct TriplesMap {
    pub(crate) name: String,
    /// Index of the source.
    pub(crate) source: usize,
    pub(crate) subject: TermMap,
    pub(crate) classes: Vec<NamedNode>,
    pub(crate) graphs: Vec<TermMap>,
    pub(crate) predicate_objects: Vec<PredicateObject>,
    /// The base of relative IRIs, if it differs from that of the mapping.
    pub(crate) base: Option<String>,
}

#[derive(Debug, Clone)]
pub(crate) struct PredicateObject {
    pub(crate) predicates: Vec<TermMap>,
    pub(crate) objects: Vec<ObjectMap>,
    pub(crate) graphs: Vec<TermMap>,
}

#[derive(Debug, Clone)]
pub(crate) enum ObjectMap {
    Term(TermMap),
    /// The subjects of another triples map.
    Parent {
        /// Index of the triples map.
        map: usize,
        joins: Vec<JoinCondition>,
    },
}

/// Equality of a value of the row and a value of a row of the parent.
#[derive(Debug, Clone)]
pub(crate) struct JoinCondition {
    pub(crate) child: Expression,
    pub(crate) parent: Expression,
}

#[derive(Debug, Clone)]
pub(crate) struct TermMap {
    pub(crate) value: TermValue,
    pub(crate) kind: TermKind,
    pub(crate) language: Option<Expression>,
    pub(crate) datatype: Option<Expression>,
}

#[derive(Debug, Clone)]
pub(crate) enum TermValue {
    Constant(Term),
    Expression(Expression),
}

/// An expression for texts.
#[derive(Debug, Clone)]
pub(crate) struct Expression {
    pub(crate) parts: Vec<TemplatePart>,
    /// Whether it is a template: values in IRIs are escaped.
    pub(crate) is_template: bool,
    /// The text in the mapping.
    pub(crate) written: String,
}

#[derive(Debug, Clone)]
pub(crate) enum TemplatePart {
    Text(String),
    Value(Expr),
}

/// The kind of a generated term.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum TermKind {
    Iri,
    /// An IRI with values that are not escaped.
    UnsafeIri,
    BlankNode,
    Literal,
}

impl RmlMapping {
    /// Returns the names of the files that the mapping reads.
    #[must_use]
    pub fn files(&self) -> BTreeSet<&str> {
        let files = self.sources.iter().map(|source| source.file.as_str());
        files.collect()
    }

    /// Returns statements of the mapping that have no effect, with the reason.
    #[must_use]
    pub fn findings(&self) -> &[String] {
        &self.findings
    }
}
