//! Constraints to queries. The rows of a query are the violations of its constraint.

use oxigraph::model::{NamedNode, NamedOrBlankNode, Term};

use super::{SHACL, Shapes, resource};
use crate::vocabulary::RDFS_SUB_CLASS_OF;

/// Reason for which the targets of a shape are not checked.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
enum TargetFault {
    #[error("its sh:{0} is no IRI")]
    Term(&'static str),
    #[error("its sh:targetNode is a blank node")]
    BlankNode,
    #[error("sh:{0} is not supported")]
    Unsupported(&'static str),
}

/// A constraint with the query for its violations.
#[derive(Debug, Clone)]
pub(crate) struct Check {
    pub(crate) shape: Term,
    /// The path of a property shape, as in the shapes and as in SPARQL.
    pub(crate) path: Option<(Term, String)>,
    /// The local name of the constraint component.
    pub(crate) component: String,
    pub(crate) severity: NamedNode,
    pub(crate) message: String,
    pub(crate) query: String,
}

/// The terms of shapes. Terms outside of this list have no effect.
pub(crate) const TERMS: [&str; 52] = [
    "alternativePath",
    "and",
    "class",
    "closed",
    "datatype",
    "deactivated",
    "disjoint",
    "equals",
    "flags",
    "hasValue",
    "ignoredProperties",
    "in",
    "inversePath",
    "js",
    "languageIn",
    "lessThan",
    "lessThanOrEquals",
    "maxCount",
    "maxExclusive",
    "maxInclusive",
    "maxLength",
    "message",
    "minCount",
    "minExclusive",
    "minInclusive",
    "minLength",
    "node",
    "nodeKind",
    "not",
    "oneOrMorePath",
    "or",
    "path",
    "pattern",
    "property",
    "qualifiedMaxCount",
    "qualifiedMinCount",
    "qualifiedValueShape",
    "qualifiedValueShapesDisjoint",
    "reifierShape",
    "rule",
    "severity",
    "sparql",
    "target",
    "targetClass",
    "targetNode",
    "targetObjectsOf",
    "targetSubjectsOf",
    "targetWhere",
    "uniqueLang",
    "xone",
    "zeroOrMorePath",
    "zeroOrOnePath",
];

/// Terms that are no constraints of their own.
const OTHER: [&str; 15] = [
    "closed",
    "deactivated",
    "flags",
    "ignoredProperties",
    "message",
    "path",
    "property",
    "severity",
    "targetClass",
    "targetNode",
    "targetObjectsOf",
    "targetSubjectsOf",
    "inversePath",
    "alternativePath",
    "zeroOrMorePath",
];

/// A shape whose constraints are compiled.
struct Scope<'a> {
    shape: &'a NamedOrBlankNode,
    targets: &'a str,
    path: Option<(Term, String)>,
}

impl Shapes {
    /// Returns the checks, and the parts of shapes that are not checked.
    pub(crate) fn checks(&self) -> (Vec<Check>, Vec<String>) {
        let mut checks = Vec::new();
        let mut ignored = Vec::new();
        for shape in &self.subjects {
            let targets = match self.targets(shape) {
                Ok(targets) if targets.is_empty() || self.is_deactivated(shape) => continue,
                Ok(targets) => targets.join(" UNION "),
                Err(what) => {
                    ignored.push(format!("{shape}: {what}"));
                    continue;
                }
            };
            if targets.len() > MAX_TEXT {
                ignored.push(format!("{shape}: it has too many targets"));
                continue;
            }
            self.shape(shape, &targets, (&mut checks, &mut ignored));
            for property in self.all(shape, "property") {
                match resource(property) {
                    Some(property) if self.is_deactivated(&property) => {}
                    Some(property) if self.one(&property, "path").is_some() => {
                        self.shape(&property, &targets, (&mut checks, &mut ignored));
                        for nested in self.all(&property, "property") {
                            ignored.push(format!("{nested}: it is inside another property shape"));
                        }
                    }
                    _ => ignored.push(format!("{shape}: a property shape has no sh:path")),
                }
            }
        }
        if ignored.len() > MAX_IGNORED {
            ignored.truncate(MAX_IGNORED);
            ignored.push("further parts of shapes".to_owned());
        }
        if checks.len() > MAX_CHECKS {
            checks.truncate(MAX_CHECKS);
            ignored.push(format!("constraints beyond the first {MAX_CHECKS}"));
        }
        (checks, ignored)
    }

    fn shape(
        &self,
        shape: &NamedOrBlankNode,
        targets: &str,
        (checks, ignored): (&mut Vec<Check>, &mut Vec<String>),
    ) {
        if checks.len() > MAX_CHECKS {
            return;
        }
        let path = match self.one(shape, "path") {
            None => None,
            Some(term) => match self.path(term, 0) {
                Some(text) => Some((term.clone(), text)),
                None => {
                    ignored.push(format!("{shape}: its sh:path is not supported"));
                    return;
                }
            },
        };
        let scope = Scope {
            shape,
            targets,
            path,
        };
        for (predicate, value) in self.about(shape) {
            // One more than are kept shows that there are more.
            if checks.len() > MAX_CHECKS {
                return;
            }
            let Some(term) = predicate.strip_prefix(SHACL) else {
                continue;
            };
            if term == "closed" && value.to_string().contains("true") {
                checks.push(self.closed(&scope));
            }
            if OTHER.contains(&term) {
                continue;
            }
            match self.check(&scope, term, value) {
                Some(check) => checks.push(check),
                None => ignored.push(format!("{shape}: sh:{term} is not supported here")),
            }
        }
    }

    fn is_deactivated(&self, shape: &NamedOrBlankNode) -> bool {
        let value = self.one(shape, "deactivated");
        matches!(value, Some(Term::Literal(literal)) if literal.value() == "true")
    }

    /// Returns the patterns of the targets of a shape.
    fn targets(&self, shape: &NamedOrBlankNode) -> Result<Vec<String>, TargetFault> {
        let mut targets = Vec::new();
        for class in self.all(shape, "targetClass") {
            let class = named(class).ok_or(TargetFault::Term("targetClass"))?;
            targets.push(format!("{{ ?this a {class} }}"));
            let sub_class = format!("<{RDFS_SUB_CLASS_OF}> {class}");
            targets.push(format!("{{ ?this a ?sub . ?sub {sub_class} }}"));
        }
        for node in self.all(shape, "targetNode") {
            if matches!(node, Term::BlankNode(_)) {
                return Err(TargetFault::BlankNode);
            }
            targets.push(format!("{{ VALUES ?this {{ {node} }} }}"));
        }
        for (term, pattern) in [
            ("targetSubjectsOf", "?this PREDICATE ?other"),
            ("targetObjectsOf", "?other PREDICATE ?this"),
        ] {
            for predicate in self.all(shape, term) {
                let predicate = named(predicate).ok_or(TargetFault::Term(term))?;
                let pattern = pattern.replace("PREDICATE", &predicate);
                targets.push(format!("{{ {pattern} }}"));
            }
        }
        for unsupported in ["target", "targetWhere"] {
            if self.one(shape, unsupported).is_some() {
                return Err(TargetFault::Unsupported(unsupported));
            }
        }
        Ok(targets)
    }

    /// Returns a path in SPARQL, if it is supported and not too long.
    fn path(&self, term: &Term, depth: usize) -> Option<String> {
        if depth > MAX_DEPTH {
            return None;
        }
        if let Some(predicate) = named(term) {
            return bounded(predicate);
        }
        let node = resource(term)?;
        // Lists of lists grow with each level, so that the length is checked at each part.
        let joined = |list: &Term, separator: &str| {
            let mut path = String::new();
            for part in self.list(list)? {
                if !path.is_empty() {
                    path.push_str(separator);
                }
                path.push_str(&self.path(part, depth + 1)?);
                path = bounded(path)?;
            }
            bounded(format!("({path})"))
        };
        if let Some(list) = self.one(&node, "alternativePath") {
            return joined(list, "|");
        }
        for (term, before, after) in [
            ("inversePath", "^", ""),
            ("zeroOrMorePath", "", "*"),
            ("oneOrMorePath", "", "+"),
            ("zeroOrOnePath", "", "?"),
        ] {
            if let Some(inner) = self.one(&node, term) {
                let inner = self.path(inner, depth + 1)?;
                return bounded(format!("({before}({inner}){after})"));
            }
        }
        joined(term, "/")
    }

    /// Compiles a constraint.
    fn check(&self, scope: &Scope<'_>, term: &str, value: &Term) -> Option<Check> {
        if matches!(term, "minCount" | "maxCount") {
            return self.count(scope, term, number(value)?);
        }
        if term == "hasValue" {
            let value = not_blank(value)?;
            let (_, path) = scope.path.as_ref()?;
            let missing = format!("FILTER NOT EXISTS {{ ?this {path} {value} }}");
            return Some(self.made(scope, term, format!("no value is {value}"), &missing));
        }
        let of_kind = self.kind(term, value);
        let (what, body) = of_kind.or_else(|| self.range(scope, term, value))?;
        let values = match &scope.path {
            Some((_, path)) => format!("?this {path} ?value ."),
            None => "BIND(?this AS ?value)".to_owned(),
        };
        Some(self.made(scope, term, what, &format!("{values} {body}")))
    }

    /// Returns the message and the filter of a constraint of the kind of values.
    fn kind(&self, term: &str, value: &Term) -> Option<(String, String)> {
        match term {
            "class" => {
                let class = named(value)?;
                let sub = format!("?value a ?kind . ?kind <{RDFS_SUB_CLASS_OF}> {class}");
                let body = format!(
                    "FILTER NOT EXISTS {{ ?value a {class} }} FILTER NOT EXISTS {{ {sub} }}"
                );
                Some((format!("the value is no {class}"), body))
            }
            "datatype" => {
                let datatype = named(value)?;
                let is_valid = if CHECKED.iter().any(|known| datatype == *known) {
                    format!("COALESCE({datatype}(STR(?value)) = ?value, false)")
                } else {
                    "true".to_owned()
                };
                let body = format!(
                    "FILTER(!isLiteral(?value) || DATATYPE(?value) != {datatype} || !({is_valid}))"
                );
                Some((format!("the value is no {datatype}"), body))
            }
            "nodeKind" => {
                let Term::NamedNode(kind) = value else {
                    return None;
                };
                let kind = kind.as_str().strip_prefix(SHACL)?;
                let (_, is_kind) = KINDS.iter().find(|(name, _)| *name == kind)?;
                let body = format!("FILTER(!({is_kind}))");
                Some((format!("the value is no {kind}"), body))
            }
            "in" => {
                let members = self.list(value)?;
                let members: Option<Vec<String>> = members.into_iter().map(not_blank).collect();
                let is_one = members?
                    .iter()
                    .map(|member| format!("sameTerm(?value, {member})"))
                    .collect::<Vec<_>>()
                    .join(" || ");
                let is_one = if is_one.is_empty() { "false" } else { &is_one };
                let body = format!("FILTER(!({is_one}))");
                Some(("the value is none of sh:in".to_owned(), body))
            }
            _ => None,
        }
    }

    /// Returns the message and the filter of a constraint of the range or text of values.
    fn range(&self, scope: &Scope<'_>, term: &str, value: &Term) -> Option<(String, String)> {
        let is_literal = matches!(value, Term::Literal(_));
        let compare = |operator: &str| {
            is_literal.then(|| format!("FILTER(!COALESCE(?value {operator} {value}, false))"))
        };
        Some(match term {
            "minInclusive" => (format!("the value is below {value}"), compare(">=")?),
            "maxInclusive" => (format!("the value is above {value}"), compare("<=")?),
            "minExclusive" => (format!("the value is not above {value}"), compare(">")?),
            "maxExclusive" => (format!("the value is not below {value}"), compare("<")?),
            "minLength" | "maxLength" => {
                let length = number(value)?;
                let operator = if term == "minLength" { "<" } else { ">" };
                let body =
                    format!("FILTER(isBlank(?value) || STRLEN(STR(?value)) {operator} {length})");
                (format!("the length is {operator} {length}"), body)
            }
            "pattern" => {
                let flags = match self.one(scope.shape, "flags") {
                    Some(flags @ Term::Literal(_)) => format!(", {flags}"),
                    _ => String::new(),
                };
                let text = is_literal.then(|| value.to_string())?;
                let body = format!("FILTER(isBlank(?value) || !REGEX(STR(?value), {text}{flags}))");
                (format!("the value does not match {value}"), body)
            }
            "disjoint" => {
                let other = named(value)?;
                let body = format!("FILTER EXISTS {{ ?this {other} ?value }}");
                (format!("{other} has the same value"), body)
            }
            "lessThan" | "lessThanOrEquals" => {
                let other = named(value)?;
                let operator = if term == "lessThan" { "<" } else { "<=" };
                let body = format!(
                    "?this {other} ?bound . FILTER(!COALESCE(?value {operator} ?bound, false))"
                );
                (format!("the value is not {operator} {other}"), body)
            }
            _ => return None,
        })
    }

    fn count(&self, scope: &Scope<'_>, term: &str, number: u32) -> Option<Check> {
        let (_, path) = scope.path.as_ref()?;
        let (operator, word) = match term {
            "minCount" => ("<", "fewer"),
            _ => (">", "more"),
        };
        let query = format!(
            "SELECT ?this WHERE {{ {{ SELECT DISTINCT ?this WHERE {{ {} }} }} \
             OPTIONAL {{ ?this {path} ?value }} }} GROUP BY ?this \
             HAVING (COUNT(DISTINCT ?value) {operator} {number}) LIMIT {MAX_ROWS}",
            scope.targets
        );
        let what = format!("there are {word} than {number} values");
        let check = self.made(scope, term, what, "");
        Some(Check { query, ..check })
    }

    /// Compiles `sh:closed`: only predicates of the property shapes are permitted.
    fn closed(&self, scope: &Scope<'_>) -> Check {
        let ignored = self.one(scope.shape, "ignoredProperties");
        let ignored = ignored.and_then(|list| self.list(list)).unwrap_or_default();
        let properties = self.all(scope.shape, "property").into_iter();
        let paths = properties.filter_map(|property| self.one(&resource(property)?, "path"));
        let known: Vec<String> = ignored.into_iter().chain(paths).filter_map(named).collect();
        let body = format!(
            "?this ?path ?value . FILTER(?path NOT IN ({}))",
            known.join(", ")
        );
        let what = "the shape is closed, and has no such property".to_owned();
        self.made(scope, "closed", what, &body)
    }

    fn made(&self, scope: &Scope<'_>, term: &str, what: String, body: &str) -> Check {
        let mut component = term.to_owned();
        if let Some(first) = component.get_mut(..1) {
            first.make_ascii_uppercase();
        }
        let message = match self.one(scope.shape, "message") {
            Some(Term::Literal(message)) => message.value(),
            _ => what.as_str(),
        };
        let message = message.chars().take(MAX_MESSAGE).collect();
        let severity = match self.one(scope.shape, "severity") {
            Some(Term::NamedNode(severity)) => severity.clone(),
            _ => NamedNode::new_unchecked(format!("{SHACL}Violation")),
        };
        Check {
            shape: scope.shape.clone().into(),
            path: scope.path.clone(),
            component: format!("{component}ConstraintComponent"),
            severity,
            message,
            query: format!(
                "SELECT DISTINCT ?this ?value ?path WHERE {{ \
                 {{ SELECT DISTINCT ?this WHERE {{ {} }} }} {body} }} LIMIT {MAX_ROWS}",
                scope.targets
            ),
        }
    }
}

/// Returns a path or a part of one, if it is not too long.
fn bounded(path: String) -> Option<String> {
    (path.len() <= MAX_TEXT).then_some(path)
}

fn number(value: &Term) -> Option<u32> {
    match value {
        Term::Literal(literal) => literal.value().parse().ok(),
        Term::NamedNode(_) | Term::BlankNode(_) => None,
    }
}

/// Returns the IRI of a term for a query.
fn named(term: &Term) -> Option<String> {
    match term {
        Term::NamedNode(node) => Some(node.to_string()),
        Term::BlankNode(_) | Term::Literal(_) => None,
    }
}

/// Returns the text of a term for a query, where a blank node would be a variable.
fn not_blank(term: &Term) -> Option<String> {
    match term {
        Term::BlankNode(_) => None,
        other @ (Term::NamedNode(_) | Term::Literal(_)) => Some(other.to_string()),
    }
}

/// The kinds of nodes, and their tests in SPARQL.
const KINDS: [(&str, &str); 6] = [
    ("IRI", "isIRI(?value)"),
    ("BlankNode", "isBlank(?value)"),
    ("Literal", "isLiteral(?value)"),
    ("BlankNodeOrIRI", "!isLiteral(?value)"),
    ("BlankNodeOrLiteral", "!isIRI(?value)"),
    ("IRIOrLiteral", "!isBlank(?value)"),
];
/// Datatypes whose lexical forms are checked.
const CHECKED: [&str; 5] = [
    "<http://www.w3.org/2001/XMLSchema#boolean>",
    "<http://www.w3.org/2001/XMLSchema#dateTime>",
    "<http://www.w3.org/2001/XMLSchema#decimal>",
    "<http://www.w3.org/2001/XMLSchema#double>",
    "<http://www.w3.org/2001/XMLSchema#integer>",
];
/// Maximum number of violations of a constraint in the report.
const MAX_ROWS: usize = 1000;
const MAX_DEPTH: usize = 16;
const MAX_CHECKS: usize = 1000;
const MAX_IGNORED: usize = 100;
/// Maximum length of a path, and of the targets of a shape, in bytes.
const MAX_TEXT: usize = 8 << 10;
/// Maximum length of a message in characters.
const MAX_MESSAGE: usize = 1000;

#[cfg(test)]
mod tests {
    use oxigraph::io::{RdfFormat, RdfParser};

    use super::*;

    fn checks(turtle: &str) -> (Vec<Check>, Vec<String>) {
        let turtle = format!("@prefix sh: <{SHACL}> . {turtle}");
        let mut shapes = Shapes::default();
        for quad in RdfParser::from_format(RdfFormat::Turtle).for_slice(turtle.as_str()) {
            shapes.add(quad.unwrap().into());
        }
        shapes.checks()
    }

    fn many(count: usize, before: &str, after: &str, separator: &str) -> String {
        let all = (0..count).map(|number| format!("{before}{number}{after}"));
        all.collect::<Vec<_>>().join(separator)
    }

    #[test]
    fn parts_beyond_the_limits_are_named() {
        let classes = many(1200, "<urn:c", ">", ", ");
        let text = format!("<urn:s> sh:targetNode <urn:x> ; sh:class {classes} .");
        let (found, ignored) = checks(&text);
        assert_eq!(found.len(), MAX_CHECKS);
        assert_eq!(ignored, ["constraints beyond the first 1000"]);
        let shapes = many(150, "<urn:n", ">", ", ");
        let text = format!("<urn:s> sh:targetNode <urn:x> ; sh:not {shapes} .");
        let (found, ignored) = checks(&text);
        assert!(found.is_empty());
        assert_eq!(ignored.len(), MAX_IGNORED + 1);
        assert_eq!(ignored.last().unwrap(), "further parts of shapes");
    }

    #[test]
    fn long_targets_and_paths_are_named() {
        let targets = many(300, "<urn:target", ">", ", ");
        let text = format!("<urn:s> sh:targetNode {targets} ; sh:class <urn:c> .");
        let (found, ignored) = checks(&text);
        assert!(found.is_empty());
        assert_eq!(ignored, ["<urn:s>: it has too many targets"]);
        let of_path = |path: &str| {
            checks(&format!(
                "<urn:s> sh:targetNode <urn:x> ; sh:property <urn:q> .
                 <urn:q> sh:minCount 1 ; sh:path {path} ."
            ))
        };
        let long = format!("( {} )", many(900, "<urn:p", ">", " "));
        // Sixteen levels of two parts each have 65536 predicates.
        let mut nested = "_:l15 . _:l0 sh:alternativePath ( <urn:p> <urn:p> )".to_owned();
        for level in 1..16 {
            let below = level - 1;
            let list = format!(" . _:l{level} sh:alternativePath ( _:l{below} _:l{below} )");
            nested.push_str(&list);
        }
        for path in [long, nested] {
            let (found, ignored) = of_path(&path);
            assert!(found.is_empty());
            assert_eq!(ignored, ["<urn:q>: its sh:path is not supported"]);
        }
        assert_eq!(of_path("( <urn:p> <urn:r> )").0.len(), 1);
    }

    #[test]
    fn messages_are_cut() {
        let text = "ö".repeat(5000);
        let text =
            format!("<urn:s> sh:targetNode <urn:x> ; sh:class <urn:c> ; sh:message \"{text}\" .");
        let (found, _) = checks(&text);
        assert_eq!(found.first().unwrap().message.chars().count(), MAX_MESSAGE);
    }
}
