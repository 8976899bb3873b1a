//! XPath 1.0 over an XML document, with the function `current()`, which is the node of the row.
//!
//! Variables and the functions `id` and `lang` are left out. A comparison of an absolute path with
//! a value of the row is answered by a hash index, so that joins inside a file take linear time.

mod calls;
mod evaluate;
mod fault;
mod functions;
mod parse;
mod tokens;

use std::fmt;
use std::sync::Arc;

pub(crate) use evaluate::{Evaluator, NodeRef, WorkBudget};
pub(crate) use fault::{EvaluationFault, XPathSyntaxFault};
pub(crate) use parse::parse;

/// The namespaces of prefixes in expressions. Without any, names match in all namespaces.
pub(crate) type XpathNamespaces = [(String, String)];

/// An expression.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Expr {
    Or(Box<Self>, Box<Self>),
    And(Box<Self>, Box<Self>),
    Compare(Comparison, Box<Self>, Box<Self>),
    Calculate(Operator, Box<Self>, Box<Self>),
    Negate(Box<Self>),
    Union(Box<Self>, Box<Self>),
    Path(Box<LocationPath>),
    Text(String),
    Number(f64),
    Call(Function, Vec<Self>),
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Comparison {
    Equal,
    NotEqual,
    Less,
    LessOrEqual,
    Greater,
    GreaterOrEqual,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Operator {
    Add,
    Subtract,
    Multiply,
    Divide,
    Remainder,
}

/// A location path.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct LocationPath {
    pub(crate) start: Start,
    pub(crate) steps: Vec<XPathStep>,
    /// The index of an absolute path: its nodes are the same for all rows up to this step.
    pub(crate) index: Option<PathIndex>,
}

/// Start of a location path.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Start {
    Context,
    Root,
    Filter(Box<Expr>, Vec<Expr>),
}

/// The leading steps of an absolute path with nodes that do not depend on the row.
#[derive(Clone)]
pub(crate) struct PathIndex {
    /// Identifies the steps within a document.
    pub(crate) key: Arc<str>,
    /// Number of leading steps.
    pub(crate) steps: usize,
    /// The step that follows, if an equality selects its nodes.
    pub(crate) join: Option<Box<Join>>,
}

// An index follows from the steps of its path, which are shown and compared beside it.
impl fmt::Debug for PathIndex {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Index")
    }
}

impl PartialEq for PathIndex {
    fn eq(&self, other: &Self) -> bool {
        self.key == other.key
    }
}

/// A step to nodes that are found by a value.
///
/// The expressions are shared: a path inside of them has an index too, which would double with each
/// level of nesting.
#[derive(Clone)]
pub(crate) struct Join {
    /// Identifies the index within a document.
    pub(crate) key: Arc<str>,
    /// The values of a candidate.
    pub(crate) candidate: Arc<Expr>,
    /// The values that are looked up.
    pub(crate) probe: Arc<Expr>,
    /// All other predicates of the step.
    pub(crate) rest: Arc<[Expr]>,
}

#[derive(Debug, Clone, PartialEq)]
pub(crate) struct XPathStep {
    pub(crate) axis: Axis,
    pub(crate) test: StepTest,
    pub(crate) predicates: Vec<Expr>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Axis {
    Ancestor,
    AncestorOrSelf,
    Attribute,
    Child,
    Descendant,
    DescendantOrSelf,
    Following,
    FollowingSibling,
    Parent,
    Preceding,
    PrecedingSibling,
    Itself,
}

impl Axis {
    /// Returns whether positions on the axis count backwards.
    pub(crate) fn is_reverse(self) -> bool {
        matches!(
            self,
            Self::Ancestor | Self::AncestorOrSelf | Self::Preceding | Self::PrecedingSibling
        )
    }
}

/// The test of a step.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum StepTest {
    /// Any node.
    Node,
    Text,
    Comment,
    Instruction(Option<String>),
    /// An element or attribute. Without a name, any of the namespace.
    Name(NamespaceTest, Option<String>),
}

/// The namespace of a name.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum NamespaceTest {
    Any,
    None,
    Uri(String),
    /// The prefix has the namespace that the document declares for it.
    OfDocument(String),
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Function {
    Boolean,
    Ceiling,
    Concat,
    Contains,
    Count,
    Current,
    EndsWith,
    False,
    Floor,
    Last,
    LocalName,
    LowerCase,
    Name,
    NamespaceUri,
    NormalizeSpace,
    Not,
    Number,
    Position,
    Round,
    StartsWith,
    String,
    StringLength,
    Substring,
    SubstringAfter,
    SubstringBefore,
    Sum,
    Translate,
    True,
    UpperCase,
}

impl Function {
    /// All functions with their names, and the smallest and largest number of arguments.
    pub(crate) const ALL: [(&'static str, Self, usize, usize); 29] = [
        ("boolean", Self::Boolean, 1, 1),
        ("ceiling", Self::Ceiling, 1, 1),
        ("concat", Self::Concat, 2, 64),
        ("contains", Self::Contains, 2, 2),
        ("count", Self::Count, 1, 1),
        ("current", Self::Current, 0, 0),
        ("ends-with", Self::EndsWith, 2, 2),
        ("false", Self::False, 0, 0),
        ("floor", Self::Floor, 1, 1),
        ("last", Self::Last, 0, 0),
        ("local-name", Self::LocalName, 0, 1),
        ("lower-case", Self::LowerCase, 1, 1),
        ("name", Self::Name, 0, 1),
        ("namespace-uri", Self::NamespaceUri, 0, 1),
        ("normalize-space", Self::NormalizeSpace, 0, 1),
        ("not", Self::Not, 1, 1),
        ("number", Self::Number, 0, 1),
        ("position", Self::Position, 0, 0),
        ("round", Self::Round, 1, 1),
        ("starts-with", Self::StartsWith, 2, 2),
        ("string", Self::String, 0, 1),
        ("string-length", Self::StringLength, 0, 1),
        ("substring", Self::Substring, 2, 3),
        ("substring-after", Self::SubstringAfter, 2, 2),
        ("substring-before", Self::SubstringBefore, 2, 2),
        ("sum", Self::Sum, 1, 1),
        ("translate", Self::Translate, 3, 3),
        ("true", Self::True, 0, 0),
        ("upper-case", Self::UpperCase, 1, 1),
    ];

    fn is_number(self) -> bool {
        matches!(
            self,
            Self::Ceiling
                | Self::Count
                | Self::Floor
                | Self::Last
                | Self::Number
                | Self::Position
                | Self::Round
                | Self::StringLength
                | Self::Sum
        )
    }
}

impl Expr {
    /// Returns whether the value of a predicate depends on the position of the node.
    pub(crate) fn is_positional(&self) -> bool {
        let is_number = matches!(
            self,
            Self::Number(_) | Self::Calculate(..) | Self::Negate(_)
        ) || matches!(self, Self::Call(function, _) if function.is_number());
        is_number || self.has_position()
    }

    /// Returns whether `position()` or `last()` occurs outside of nested predicates.
    fn has_position(&self) -> bool {
        match self {
            Self::Or(a, b)
            | Self::And(a, b)
            | Self::Union(a, b)
            | Self::Compare(_, a, b)
            | Self::Calculate(_, a, b) => a.has_position() || b.has_position(),
            Self::Negate(a) => a.has_position(),
            Self::Text(_) | Self::Number(_) => false,
            Self::Path(path) => match &path.start {
                Start::Filter(start, _) => start.has_position(),
                Start::Context | Start::Root => false,
            },
            Self::Call(Function::Position | Function::Last, _) => true,
            Self::Call(_, all) => all.iter().any(Self::has_position),
        }
    }

    /// Returns whether `current()` occurs anywhere.
    pub(crate) fn has_current(&self) -> bool {
        match self {
            Self::Or(a, b)
            | Self::And(a, b)
            | Self::Union(a, b)
            | Self::Compare(_, a, b)
            | Self::Calculate(_, a, b) => a.has_current() || b.has_current(),
            Self::Negate(a) => a.has_current(),
            Self::Text(_) | Self::Number(_) => false,
            Self::Path(path) => {
                let start = match &path.start {
                    Start::Filter(start, all) => {
                        start.has_current() || all.iter().any(Self::has_current)
                    }
                    Start::Context | Start::Root => false,
                };
                start || path.steps.iter().any(XPathStep::has_current)
            }
            Self::Call(Function::Current, _) => true,
            Self::Call(_, all) => all.iter().any(Self::has_current),
        }
    }

    /// Returns whether the value is the same for all candidates of a step.
    pub(crate) fn is_outer(&self) -> bool {
        match self {
            Self::Or(a, b)
            | Self::And(a, b)
            | Self::Union(a, b)
            | Self::Compare(_, a, b)
            | Self::Calculate(_, a, b) => a.is_outer() && b.is_outer(),
            Self::Negate(a) => a.is_outer(),
            Self::Text(_) | Self::Number(_) => true,
            Self::Path(path) => match &path.start {
                Start::Root => true,
                Start::Context => false,
                Start::Filter(start, _) => start.is_outer(),
            },
            Self::Call(Function::Current | Function::True | Function::False, _) => true,
            Self::Call(_, all) => !all.is_empty() && all.iter().all(Self::is_outer),
        }
    }

    /// Returns whether the value is text or nodes, which are compared as texts.
    pub(crate) fn is_textual(&self) -> bool {
        match self {
            Self::Text(_) | Self::Path(_) | Self::Union(..) => true,
            Self::Call(function, _) => matches!(
                function,
                Function::Concat
                    | Function::Current
                    | Function::LocalName
                    | Function::LowerCase
                    | Function::Name
                    | Function::NamespaceUri
                    | Function::NormalizeSpace
                    | Function::String
                    | Function::Substring
                    | Function::SubstringAfter
                    | Function::SubstringBefore
                    | Function::Translate
                    | Function::UpperCase
            ),
            Self::Or(..)
            | Self::And(..)
            | Self::Compare(..)
            | Self::Calculate(..)
            | Self::Negate(_)
            | Self::Number(_) => false,
        }
    }
}

impl XPathStep {
    pub(crate) fn has_current(&self) -> bool {
        self.predicates.iter().any(Expr::has_current)
    }
}
