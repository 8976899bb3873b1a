//! Runs a mapping: the rows of its files to statements.

mod sink;

use std::collections::{BTreeMap, BTreeSet, HashMap, HashSet};
use std::rc::Rc;

use oxrdf::{BlankNode, GraphName, Literal, NamedNode, NamedOrBlankNode, Quad, Term};
use roxmltree::{Document, ParsingOptions};

use self::sink::StatementSink;
use crate::files::Files;
use crate::mapping::{
    Expression, JoinCondition, MappingFault, ObjectMap, PredicateObject, RmlMapping, TemplatePart,
    TermKind, TermMap, TermValue, TriplesMap,
};
use crate::read::{blank, is_default_graph, is_language};
use crate::xpath::{EvaluationFault, Evaluator, NodeRef, WorkBudget};

/// The statements of a run.
#[derive(Debug, Clone)]
pub struct RunOutput {
    /// The statements, each once, in the order of the triples maps and rows.
    pub quads: Vec<Quad>,
    /// Values that are no term, and other faults that cost single statements.
    pub findings: Vec<String>,
    pub(crate) prefixes: Vec<(String, String)>,
}

impl RmlMapping {
    /// Runs the mapping.
    ///
    /// # Errors
    /// [`MappingFault`] if a file cannot be read, or a limit is exceeded.
    pub fn run(&self, files: &mut dyn Files) -> Result<RunOutput, MappingFault> {
        self.run_within(files, WorkBudget::new(MAX_WORK))
    }

    fn run_within(
        &self,
        files: &mut dyn Files,
        work: WorkBudget,
    ) -> Result<RunOutput, MappingFault> {
        let texts = self.texts(files)?;
        let mut documents = Vec::new();
        for (file, text) in &texts {
            let options = ParsingOptions {
                nodes_limit: MAX_NODES,
                ..ParsingOptions::default()
            };
            let document = Document::parse_with_options(text, options)
                .map_err(|fault| self.file_fault(file, xml_fault(&fault)))?;
            documents.push((*file, document));
        }
        let mut run = Run {
            mapping: self,
            evaluators: documents
                .iter()
                .map(|(_, document)| Evaluator::new(document))
                .collect(),
            file_of_source: Vec::new(),
            rows: Vec::new(),
            work,
            sink: StatementSink::default(),
            blank_nodes: HashMap::new(),
            findings: BTreeMap::new(),
            subjects: HashMap::new(),
            indexes: HashMap::new(),
        };
        for source in &self.sources {
            let file = documents.iter().position(|(file, _)| *file == source.file);
            run.file_of_source.push(file.unwrap_or(usize::MAX));
        }
        run.rows()?;
        for (number, map) in self.maps.iter().enumerate() {
            run.map(number, map).map_err(|fault| MappingFault::Map {
                map: map.name.clone(),
                problem: fault.to_string(),
            })?;
        }
        let findings = run.findings.into_iter();
        Ok(RunOutput {
            quads: run.sink.quads,
            findings: findings
                .map(|(problem, times)| repeated(problem, times))
                .collect(),
            prefixes: self.prefixes.clone(),
        })
    }

    /// Reads the files, each once.
    fn texts(&self, files: &mut dyn Files) -> Result<Vec<(&str, String)>, MappingFault> {
        let mut texts = Vec::new();
        let mut total = 0;
        for file in self.files() {
            let bytes = files
                .read(file)
                .map_err(|fault| self.file_fault(file, fault.to_string()))?;
            let text = xml_text::decode(&bytes)
                .map_err(|fault| self.file_fault(file, fault.to_string()))?;
            total += text.len();
            if total > MAX_FILES {
                return Err(MappingFault::Whole(format!(
                    "the files of the mapping have more than {MAX_FILES} bytes together"
                )));
            }
            // The parser compares the attributes of an element pairwise.
            if xml_text::has_more_attributes(&text, MAX_ATTRIBUTES) {
                let problem = format!("an element has more than {MAX_ATTRIBUTES} attributes");
                return Err(self.file_fault(file, problem));
            }
            texts.push((file, text.into_owned()));
        }
        Ok(texts)
    }

    fn file_fault(&self, file: &str, problem: String) -> MappingFault {
        let reads = |map: &&TriplesMap| {
            let source = self.sources.get(map.source);
            source.is_some_and(|source| source.file == file)
        };
        let map = self.maps.iter().find(reads);
        MappingFault::File {
            map: map.map(|map| map.name.clone()).unwrap_or_default(),
            file: file.to_owned(),
            problem,
        }
    }
}

/// Reason for which the rows of a triples map have no statements.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
enum RunFault {
    #[error("the mapping makes more than {0} statements; narrow its iterators")]
    Statements(usize),
    #[error("the statements have more than {0} bytes; shorten the subjects")]
    Bytes(usize),
    #[error(
        "the parent {0} has other rows; give a rr:joinCondition, or the same source and iterator"
    )]
    Parent(String),
    #[error("`{written}`: {fault}")]
    Expression {
        written: String,
        fault: EvaluationFault,
    },
    #[error("a row has more than {0} combinations of values; select fewer nodes")]
    Combinations(usize),
    #[error(transparent)]
    Work(#[from] EvaluationFault),
}

struct Run<'a> {
    mapping: &'a RmlMapping,
    /// One per file.
    evaluators: Vec<Evaluator<'a>>,
    file_of_source: Vec<usize>,
    /// The rows by source.
    rows: Vec<Rc<Vec<NodeRef>>>,
    work: WorkBudget,
    sink: StatementSink,
    blank_nodes: HashMap<String, BlankNode>,
    findings: BTreeMap<String, usize>,
    /// The subjects of the rows of parents, by triples map.
    subjects: HashMap<usize, Rc<Vec<Vec<Term>>>>,
    /// The rows of parents by the values that join them.
    indexes: HashMap<JoinKey, Rc<RowIndex>>,
}

/// A parent, with the expressions that join it.
type JoinKey = (usize, Vec<String>);
/// Rows by the values that join them.
type RowIndex = HashMap<Vec<String>, Vec<usize>>;

/// A row of a triples map.
#[derive(Clone, Copy)]
struct Row<'a> {
    file: usize,
    node: NodeRef,
    base: &'a str,
    map: &'a str,
}

impl<'a> Run<'a> {
    fn rows(&mut self) -> Result<(), MappingFault> {
        let mapping = self.mapping;
        for (number, source) in mapping.sources.iter().enumerate() {
            let file = self.file_of_source.get(number).copied();
            let evaluator = file.and_then(|file| self.evaluators.get_mut(file));
            let rows = match evaluator {
                Some(evaluator) => evaluator.rows(&source.iterator, &mut self.work),
                None => Ok(Vec::new()),
            };
            let rows = rows.map_err(|problem| {
                let problem = format!("the iterator `{}`: {problem}", source.written);
                mapping.file_fault(&source.file, problem)
            })?;
            self.rows.push(Rc::new(rows));
        }
        Ok(())
    }

    fn rows_of(&self, map: &'a TriplesMap) -> Vec<Row<'a>> {
        let base = map.base.as_deref().unwrap_or(&self.mapping.base);
        let file = self.file_of_source.get(map.source).copied();
        let rows = self.rows.get(map.source).map_or(&[][..], |rows| rows);
        let row = |node: &NodeRef| Row {
            file: file.unwrap_or(usize::MAX),
            node: *node,
            base,
            map: &map.name,
        };
        rows.iter().map(row).collect()
    }

    fn map(&mut self, number: usize, map: &'a TriplesMap) -> Result<(), RunFault> {
        for (at, row) in self.rows_of(map).into_iter().enumerate() {
            let subjects: Vec<NamedOrBlankNode> = match self.subjects.get(&number) {
                Some(known) => known.get(at).cloned().unwrap_or_default(),
                None => self.terms(&map.subject, row)?,
            }
            .into_iter()
            .filter_map(resource)
            .collect();
            if subjects.is_empty() {
                continue;
            }
            let graphs = self.graphs(&map.graphs, row)?;
            for subject in &subjects {
                for class in &map.classes {
                    let is_a = Term::from(class.clone());
                    let statement = (subject, rdf_type(), is_a);
                    self.state(statement, &graphs)?;
                }
            }
            for one in &map.predicate_objects {
                self.predicate_object(map, one, (row, &subjects, &graphs))?;
            }
        }
        Ok(())
    }

    fn predicate_object(
        &mut self,
        map: &'a TriplesMap,
        one: &'a PredicateObject,
        (row, subjects, graphs): (Row<'a>, &[NamedOrBlankNode], &BTreeSet<GraphKey>),
    ) -> Result<(), RunFault> {
        let mut all_graphs = self.graphs(&one.graphs, row)?;
        all_graphs.extend(graphs.iter().cloned());
        let mut predicates = Vec::new();
        for predicate in &one.predicates {
            predicates.extend(self.terms(predicate, row)?);
        }
        let mut objects = Vec::new();
        for object in &one.objects {
            match object {
                ObjectMap::Term(term) => objects.extend(self.terms(term, row)?),
                ObjectMap::Parent { map: parent, joins } => {
                    objects.extend(self.parents(map, (*parent, joins), row)?);
                }
            }
        }
        for subject in subjects {
            for predicate in &predicates {
                let Term::NamedNode(predicate) = predicate else {
                    continue;
                };
                for object in &objects {
                    let statement = (subject, predicate.clone(), object.clone());
                    self.state(statement, &all_graphs)?;
                }
            }
        }
        Ok(())
    }

    /// Adds a statement to its graphs, or to the default graph if it has none.
    fn state(
        &mut self,
        (subject, predicate, object): (&NamedOrBlankNode, NamedNode, Term),
        graphs: &BTreeSet<GraphKey>,
    ) -> Result<(), RunFault> {
        let default = graphs.is_empty().then_some(GraphName::DefaultGraph);
        let named = graphs.iter().map(|key| key.graph.clone());
        for graph in default.into_iter().chain(named) {
            self.work.spend(1)?;
            self.sink.add(Quad::new(
                subject.clone(),
                predicate.clone(),
                object.clone(),
                graph,
            ))?;
        }
        Ok(())
    }

    fn graphs(
        &mut self,
        maps: &'a [TermMap],
        row: Row<'a>,
    ) -> Result<BTreeSet<GraphKey>, RunFault> {
        let mut graphs = BTreeSet::new();
        for map in maps {
            for term in self.terms(map, row)? {
                let key = term.to_string();
                let graph = match resource(term) {
                    Some(NamedOrBlankNode::NamedNode(node)) if is_default_graph(&node) => {
                        GraphName::DefaultGraph
                    }
                    Some(NamedOrBlankNode::NamedNode(node)) => node.into(),
                    Some(NamedOrBlankNode::BlankNode(node)) => node.into(),
                    None => continue,
                };
                graphs.insert(GraphKey { key, graph });
            }
        }
        Ok(graphs)
    }

    /// Returns the subjects of the rows of a parent that join the row.
    fn parents(
        &mut self,
        map: &'a TriplesMap,
        (number, joins): (usize, &'a [JoinCondition]),
        row: Row<'a>,
    ) -> Result<Vec<Term>, RunFault> {
        let mapping = self.mapping;
        let Some(parent) = mapping.maps.get(number) else {
            return Ok(Vec::new());
        };
        if joins.is_empty() {
            if parent.source != map.source {
                return Err(RunFault::Parent(parent.name.clone()));
            }
            return self.terms(&parent.subject, row);
        }
        let subjects = self.subjects_of(number, parent)?;
        let index = self.index(number, parent, joins)?;
        let children = joins.iter().map(|join| &join.child);
        let mut terms = Vec::new();
        let mut seen = HashSet::new();
        for key in self.keys(children, row)? {
            for at in index.get(&key).into_iter().flatten() {
                self.work.spend(1)?;
                if seen.insert(*at) {
                    let found = subjects.get(*at).map_or(&[][..], Vec::as_slice);
                    self.work.spend(found.len())?;
                    terms.extend_from_slice(found);
                }
            }
        }
        Ok(terms)
    }

    fn subjects_of(
        &mut self,
        number: usize,
        map: &'a TriplesMap,
    ) -> Result<Rc<Vec<Vec<Term>>>, RunFault> {
        if let Some(known) = self.subjects.get(&number) {
            return Ok(Rc::clone(known));
        }
        let mut subjects = Vec::new();
        for row in self.rows_of(map) {
            subjects.push(self.terms(&map.subject, row)?);
        }
        let subjects = Rc::new(subjects);
        self.subjects.insert(number, Rc::clone(&subjects));
        Ok(subjects)
    }

    fn index(
        &mut self,
        number: usize,
        map: &'a TriplesMap,
        joins: &'a [JoinCondition],
    ) -> Result<Rc<RowIndex>, RunFault> {
        let written = joins.iter().map(|join| join.parent.written.clone());
        let key = (number, written.collect());
        if let Some(known) = self.indexes.get(&key) {
            return Ok(Rc::clone(known));
        }
        let mut index = RowIndex::new();
        for (at, row) in self.rows_of(map).into_iter().enumerate() {
            for key in self.keys(joins.iter().map(|join| &join.parent), row)? {
                index.entry(key).or_default().push(at);
            }
        }
        let index = Rc::new(index);
        self.indexes.insert(key, Rc::clone(&index));
        Ok(index)
    }

    /// Returns all combinations of the values of several expressions.
    fn keys<'e>(
        &mut self,
        expressions: impl Iterator<Item = &'e Expression>,
        row: Row<'_>,
    ) -> Result<Vec<Vec<String>>, RunFault> {
        let mut keys: Vec<Vec<String>> = vec![Vec::new()];
        for expression in expressions {
            let values = self.expand(expression, row, TermKind::Literal)?;
            let bytes: usize = keys.iter().flatten().map(String::len).sum();
            self.work.spend(product(keys.len(), bytes, &values))?;
            keys = combined(&keys, &values, |key, value| {
                let mut key = key.clone();
                key.push(value.clone());
                key
            })?;
        }
        Ok(keys)
    }

    /// Returns the terms of a term map for a row.
    fn terms(&mut self, map: &'a TermMap, row: Row<'a>) -> Result<Vec<Term>, RunFault> {
        let expression = match &map.value {
            TermValue::Constant(Term::BlankNode(node)) => {
                let node = self.blank_node(&format!("_:{}", node.as_str()));
                return Ok(vec![node.into()]);
            }
            TermValue::Constant(term) => return Ok(vec![term.clone()]),
            TermValue::Expression(expression) => expression,
        };
        let values = self.expand(expression, row, map.kind)?;
        let mut terms = Vec::new();
        for value in values {
            match map.kind {
                TermKind::BlankNode => terms.push(self.blank_node(&value).into()),
                TermKind::Literal => {
                    terms.extend(self.literal(map, value, row)?.map(Term::from));
                }
                TermKind::Iri | TermKind::UnsafeIri => {
                    terms.extend(self.iri(value, row).map(Term::from));
                }
            }
        }
        Ok(terms)
    }

    fn blank_node(&mut self, name: &str) -> BlankNode {
        let number = self.blank_nodes.len();
        let known = self.blank_nodes.entry(name.to_owned());
        known.or_insert_with(|| blank(number)).clone()
    }

    /// Returns an IRI. A relative one is appended to the base.
    fn iri(&mut self, value: String, row: Row<'_>) -> Option<NamedNode> {
        if let Ok(node) = NamedNode::new(&*value) {
            return Some(node);
        }
        let node = NamedNode::new(format!("{}{value}", row.base)).ok();
        if node.is_none() {
            let remedy = match row.base {
                "" => "begin it with a scheme, or give the mapping a @base",
                _ => "use a template, which escapes values",
            };
            self.find(row, format!("`{}` is no IRI; {remedy}", shortened(&value)));
        }
        node
    }

    fn literal(
        &mut self,
        map: &'a TermMap,
        value: String,
        row: Row<'a>,
    ) -> Result<Option<Literal>, RunFault> {
        if let Some(language) = &map.language {
            let tags = self.expand(language, row, TermKind::Literal)?;
            let Some(tag) = tags.into_iter().next() else {
                return Ok(Some(Literal::new_simple_literal(value)));
            };
            let literal = Literal::new_language_tagged_literal(value, &*tag).ok();
            let literal = literal.filter(|_| is_language(&tag));
            if literal.is_none() {
                self.find(row, format!("`{}` is no language tag", shortened(&tag)));
            }
            return Ok(literal);
        }
        if let Some(datatype) = &map.datatype {
            let types = self.expand(datatype, row, TermKind::Iri)?;
            let Some(datatype) = types.into_iter().next() else {
                return Ok(Some(Literal::new_simple_literal(value)));
            };
            let datatype = self.iri(datatype, row);
            return Ok(datatype.map(|datatype| Literal::new_typed_literal(value, datatype)));
        }
        Ok(Some(Literal::new_simple_literal(value)))
    }

    /// Returns the texts of an expression: all combinations of the values of its parts.
    fn expand(
        &mut self,
        expression: &Expression,
        row: Row<'_>,
        kind: TermKind,
    ) -> Result<Vec<String>, RunFault> {
        let mut texts = vec![String::new()];
        for part in &expression.parts {
            let values = match part {
                TemplatePart::Text(text) => vec![text.clone()],
                TemplatePart::Value(expr) => {
                    let Some(evaluator) = self.evaluators.get_mut(row.file) else {
                        return Ok(Vec::new());
                    };
                    let values = evaluator.values(expr, row.node, &mut self.work);
                    let mut values = values.map_err(|fault| RunFault::Expression {
                        written: expression.written.clone(),
                        fault,
                    })?;
                    if expression.is_template && kind == TermKind::Iri {
                        for value in &mut values {
                            *value = escaped(value);
                        }
                    }
                    values
                }
            };
            let bytes: usize = texts.iter().map(String::len).sum();
            self.work.spend(product(texts.len(), bytes, &values))?;
            texts = combined(&texts, &values, |text, value| format!("{text}{value}"))?;
        }
        Ok(texts)
    }

    fn find(&mut self, row: Row<'_>, problem: String) {
        let problem = format!("triples map {}: {problem}", row.map);
        if self.findings.len() >= MAX_FINDINGS && !self.findings.contains_key(&problem) {
            let others = "further values are no terms".to_owned();
            *self.findings.entry(others).or_default() += 1;
            return;
        }
        *self.findings.entry(problem).or_default() += 1;
    }
}

/// A graph, ordered by its text.
#[derive(Debug, Clone)]
struct GraphKey {
    key: String,
    graph: GraphName,
}

impl PartialEq for GraphKey {
    fn eq(&self, other: &Self) -> bool {
        self.key == other.key
    }
}

impl Eq for GraphKey {}

impl PartialOrd for GraphKey {
    fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}

impl Ord for GraphKey {
    fn cmp(&self, other: &Self) -> std::cmp::Ordering {
        self.key.cmp(&other.key)
    }
}

/// Returns the work of combining `count` texts, which have `bytes` together, with values: the
/// number of the combinations, and their bytes.
fn product(count: usize, bytes: usize, values: &[String]) -> usize {
    let of_values: usize = values.iter().map(String::len).sum();
    count
        .saturating_mul(values.len())
        .saturating_add(bytes.saturating_mul(values.len()))
        .saturating_add(of_values.saturating_mul(count))
}

fn combined<T>(
    all: &[T],
    values: &[String],
    join: impl Fn(&T, &String) -> T,
) -> Result<Vec<T>, RunFault> {
    if all.len().saturating_mul(values.len()) > MAX_COMBINATIONS {
        return Err(RunFault::Combinations(MAX_COMBINATIONS));
    }
    let pairs = all
        .iter()
        .flat_map(|one| values.iter().map(move |value| (one, value)));
    Ok(pairs.map(|(one, value)| join(one, value)).collect())
}

fn resource(term: Term) -> Option<NamedOrBlankNode> {
    match term {
        Term::NamedNode(node) => Some(node.into()),
        Term::BlankNode(node) => Some(node.into()),
        Term::Literal(_) => None,
    }
}

fn rdf_type() -> NamedNode {
    NamedNode::new_unchecked("http://www.w3.org/1999/02/22-rdf-syntax-ns#type")
}

/// Escapes a value for an IRI: all characters but the unreserved ones (RFC 3987) become `%XX`.
fn escaped(value: &str) -> String {
    let mut escaped = String::with_capacity(value.len());
    for character in value.chars() {
        let is_plain = character.is_ascii_alphanumeric() || "-._~".contains(character);
        if is_plain || (character >= '\u{a0}' && !is_private(character)) {
            escaped.push(character);
            continue;
        }
        let mut bytes = [0; 4];
        for byte in character.encode_utf8(&mut bytes).bytes() {
            escaped.push_str(&format!("%{byte:02X}"));
        }
    }
    escaped
}

/// Returns whether a character is none of `ucschar` (RFC 3987, 2.2).
fn is_private(character: char) -> bool {
    let code = u32::from(character);
    matches!(code, 0xE000..=0xF8FF | 0xFDD0..=0xFDEF | 0xFFF0..=0xFFFF | 0xE_0000..=0xE_0FFF)
        || code >= 0xF_0000
        || code & 0xFFFE == 0xFFFE
}

fn shortened(value: &str) -> String {
    let mut short: String = value.chars().take(MAX_SHOWN).collect();
    if short.len() < value.len() {
        short.push('…');
    }
    short
}

fn repeated(problem: String, times: usize) -> String {
    match times {
        1 => problem,
        times => format!("{problem} ({times} times)"),
    }
}

fn xml_fault(fault: &roxmltree::Error) -> String {
    let line = fault.pos().row;
    if matches!(fault, roxmltree::Error::NodesLimitReached) {
        return format!("it has more than {MAX_NODES} elements and texts");
    }
    if matches!(fault, roxmltree::Error::DtdDetected) {
        return format!("line {line}: document types are not read; remove the <!DOCTYPE ..>");
    }
    format!("line {line}: {fault}")
}

/// Maximum number of visited nodes, and of bytes of values, of a run.
const MAX_WORK: u64 = 500_000_000;
const MAX_NODES: u32 = 8_000_000;
const MAX_FILES: usize = 256 << 20;
/// Maximum number of attributes of an element.
const MAX_ATTRIBUTES: usize = 1000;
const MAX_COMBINATIONS: usize = 100_000;
const MAX_FINDINGS: usize = 100;
const MAX_SHOWN: usize = 80;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::files::MappingFileFault;

    struct Deep;

    impl Files for Deep {
        fn read(&mut self, _: &str) -> Result<Vec<u8>, MappingFileFault> {
            let (open, close) = ("<a>".repeat(300), "</a>".repeat(300));
            Ok(format!("{open}{close}").into_bytes())
        }
    }

    #[test]
    fn the_work_of_combinations_is_their_number_and_their_bytes() {
        let values = ["ab".to_owned(), String::new()];
        assert_eq!(product(3, 10, &values), 3 * 2 + 10 * 2 + 2 * 3);
        assert_eq!(product(1, usize::MAX, &values), usize::MAX);
        assert_eq!(product(3, 10, &[]), 0);
    }

    /// The reference visits 300^3 nodes for each of 300 rows.
    #[test]
    fn a_run_ends_at_the_limit_of_its_work() {
        let mapping = "@prefix r: <http://w3id.org/rml/> . <urn:m> r:logicalSource [ r:source \"a\"; r:referenceFormulation r:XPath; r:iterator \"//a\" ]; r:subject <urn:s>; r:predicateObjectMap [ r:predicate <urn:p>; r:objectMap [ r:reference \"//a[.//a//a]\" ] ] .";
        let mapping = RmlMapping::read(mapping).unwrap();
        let run = mapping.run_within(&mut Deep, WorkBudget::new(200_000));
        let fault = run.unwrap_err().to_string();
        assert!(fault.contains("narrow its paths"), "{fault}");
    }
}
