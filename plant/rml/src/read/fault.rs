//! Reasons for which a triples map cannot be read.

use crate::xpath::XPathSyntaxFault;

/// Reason for which a triples map cannot be read, with the remedy. Terms are shown as in Turtle.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub(crate) enum TriplesMapFault {
    #[error("there are {count} of `{property}`; leave one")]
    Several { count: usize, property: String },
    #[error("`{property}` is a text, and not {found}")]
    NoText { property: String, found: String },
    #[error("`{property}` is a resource, and not {found}")]
    NoResource { property: String, found: String },
    #[error("nothing is stated about {term}, the `{property}`")]
    Unstated { property: String, term: String },
    #[error("`{property}` is no {found}")]
    NoTerm { property: String, found: String },
    #[error("rr:logicalTable names a database; only XML files are read")]
    LogicalTable,
    #[error("it has no rml:logicalSource")]
    NoLogicalSource,
    #[error("the logical source has no rml:source")]
    NoSource,
    #[error("the source is no file; give its name as a text, or as rml:path")]
    NoFile,
    #[error(
        "rml:root {0} is not supported; files are read from the folder of the mapping, \
         rml:MappingDirectory"
    )]
    Root(String),
    #[error("compressed sources are not read; unpack the file")]
    Compression,
    #[error(
        "the logical source has no rml:referenceFormulation; for XML give ql:XPath or rml:XPath"
    )]
    NoFormulation,
    #[error("the reference formulation {0} is not supported; only XPath over XML is")]
    Formulation(String),
    #[error("rml:namespace needs rml:namespacePrefix and rml:namespaceURL")]
    Namespace,
    #[error("the iterator `{written}`: {fault}")]
    Iterator {
        written: String,
        fault: XPathSyntaxFault,
    },
    #[error("it has {0} subject maps, and needs one")]
    Subjects(usize),
    #[error("the class {0} is no IRI")]
    Class(String),
    #[error("a graph is no literal; remove its term type")]
    Graph,
    #[error("a predicate is an IRI; remove its term type")]
    Predicate,
    #[error(
        "a predicate-object map needs a predicate and an object, for example `rr:predicate \
         ex:name; rr:objectMap [ rml:reference \"@Name\" ]`"
    )]
    PredicateObject,
    #[error("rr:parentTriplesMap is missing")]
    NoParentMap,
    #[error("the parent {0} is no triples map")]
    UnknownParent(String),
    #[error("no parent")]
    NoParent,
    #[error("the parent {0} has no source")]
    ParentSource(String),
    #[error("a join condition has no `{0}`")]
    JoinSide(String),
    #[error("the {0} map has no constant, template or reference of its own")]
    NoExpression(String),
    #[error("a map has both a template and a reference")]
    TwoExpressions,
    #[error("`{0}` is no language tag; use one of BCP 47, such as `en`")]
    Language(String),
    #[error("unknown term type {0}")]
    TermType(String),
    #[error("the constant {term} cannot be a {role}")]
    Constant { term: String, role: String },
    #[error("the reference `{written}`: {fault}")]
    Reference {
        written: String,
        fault: XPathSyntaxFault,
    },
    #[error("the template `{written}`: {fault}")]
    Template {
        written: String,
        fault: TemplateFault,
    },
}

/// Reason for which a text is no template.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub(crate) enum TemplateFault {
    #[error("it ends with a backslash")]
    Backslash,
    #[error("`{0}` has no counterpart; write \\{0} for the character")]
    Brace(char),
    #[error("`{{` has no counterpart")]
    Open,
    #[error("`{written}`: {fault}")]
    Expression {
        written: String,
        fault: XPathSyntaxFault,
    },
}
