//! SPARQL 1.1 Update on the graphs of users.
//!
//! All operations of a request are one change: readers see either all of its effects or nothing.
//! Statements without a graph are in the graph [`UNNAMED`]; patterns without a graph match the
//! merge of all graphs.
//! The graphs of components, manifests, NodeSets, processes and runs are read-only.

use std::collections::{BTreeMap, HashMap};

use oxigraph::model::{BlankNode, GraphName, NamedNode, NamedOrBlankNode, Quad, Term, Triple};
use oxigraph::sparql::{CancellationToken, QueryResults, QuerySolution, SparqlEvaluator};
use spargebra::algebra::{GraphPattern, GraphTarget, QueryDataset};
use spargebra::term::{
    GraphNamePattern, GroundQuad, GroundQuadPattern, GroundTerm, GroundTermPattern,
    NamedNodePattern, QuadPattern, TermPattern,
};
use spargebra::{GraphUpdateOperation, Query, SparqlParser, Update};

use crate::bounds;
use crate::query::QueryFault;
use crate::source::{KnowledgeSource, SourceKind, UNNAMED};
use crate::store::{Knowledge, KnowledgeFault};
use crate::writing::{GraphChange, StoreChange};

/// Number of statements that an update changed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(crate) struct Updated {
    pub(crate) changed: usize,
}

/// Parses an update, and checks its limits.
pub(crate) fn read(text: &str) -> Result<Update, QueryFault> {
    bounds::nests(text)?;
    let update = SparqlParser::new()
        .parse_update(text)
        .map_err(|error| QueryFault::Malformed(error.to_string()))?;
    for operation in &update.operations {
        match operation {
            GraphUpdateOperation::Load { .. } => return Err(QueryFault::Load),
            GraphUpdateOperation::DeleteInsert { using, pattern, .. } => {
                bounds::check(&select(using.as_ref(), pattern))?;
            }
            GraphUpdateOperation::InsertData { .. }
            | GraphUpdateOperation::DeleteData { .. }
            | GraphUpdateOperation::Clear { .. }
            | GraphUpdateOperation::Create { .. }
            | GraphUpdateOperation::Drop { .. } => {}
        }
    }
    Ok(update)
}

/// Returns the source of a graph that users may write.
///
/// # Errors
/// [`KnowledgeFault::Protected`].
pub(crate) fn writable(graph: &str) -> Result<KnowledgeSource, KnowledgeFault> {
    if graph.starts_with(OURS) && graph != UNNAMED {
        return Err(KnowledgeFault::Protected(graph.chars().take(200).collect()));
    }
    Ok(KnowledgeSource::new(SourceKind::Graph, graph))
}

impl Knowledge {
    /// Runs an update. `at` is in milliseconds since 1970.
    pub(crate) fn update(
        &self,
        update: &Update,
        token: &CancellationToken,
        at: u64,
    ) -> Result<Updated, QueryFault> {
        let mut writer = self.writer();
        let mut running = Running {
            writing: writer.begin()?,
            token,
            changed: 0,
        };
        for operation in &update.operations {
            running.operation(operation)?;
        }
        if token.is_cancelled() {
            return Err(QueryFault::Failed("it was stopped".to_owned()));
        }
        let changed = running.changed;
        running.writing.commit(at)?;
        Ok(Updated { changed })
    }
}

struct Running<'a> {
    writing: StoreChange<'a>,
    token: &'a CancellationToken,
    changed: usize,
}

impl Running<'_> {
    fn operation(&mut self, operation: &GraphUpdateOperation) -> Result<(), QueryFault> {
        if self.token.is_cancelled() {
            return Err(QueryFault::Failed("it was stopped".to_owned()));
        }
        let mut changes = Changes::default();
        match operation {
            GraphUpdateOperation::InsertData { data } => {
                let mut blank = HashMap::new();
                for quad in data {
                    changes.add(renamed(quad, &mut blank))?;
                }
            }
            GraphUpdateOperation::DeleteData { data } => {
                for quad in data {
                    changes.remove(ground(quad))?;
                }
            }
            GraphUpdateOperation::DeleteInsert {
                delete,
                insert,
                using,
                pattern,
            } => self.modify(
                &mut changes,
                (delete, insert),
                &select(using.as_ref(), pattern),
            )?,
            GraphUpdateOperation::Clear { graph, .. }
            | GraphUpdateOperation::Drop { graph, .. } => {
                self.clear(&mut changes, graph)?;
            }
            // A graph without statements does not exist.
            GraphUpdateOperation::Create { graph, .. } => drop(writable(graph.as_str())?),
            GraphUpdateOperation::Load { .. } => return Err(QueryFault::Load),
        }
        for (graph, change) in changes.0 {
            self.changed += self.writing.change(&writable(&graph)?, change)?;
        }
        Ok(())
    }

    fn modify(
        &self,
        changes: &mut Changes,
        (delete, insert): (&[GroundQuadPattern], &[QuadPattern]),
        query: &Query,
    ) -> Result<(), QueryFault> {
        let failed =
            |error: oxigraph::sparql::QueryEvaluationError| QueryFault::Failed(error.to_string());
        let evaluator = SparqlEvaluator::new().with_cancellation_token(self.token.clone());
        let results = evaluator
            .for_query(query.clone())
            .on_transaction(self.writing.transaction())
            .execute()
            .map_err(failed)?;
        let QueryResults::Solutions(solutions) = results else {
            return Err(QueryFault::Failed("the pattern is no SELECT".to_owned()));
        };
        for (solution, row) in solutions.zip(0_usize..) {
            let solution = solution.map_err(failed)?;
            let of_row = delete.len().saturating_add(insert.len()).max(1);
            if row.saturating_mul(of_row) >= MOST_CHANGES {
                return Err(QueryFault::TooComplex(format!(
                    "it changes more than {MOST_CHANGES} statements"
                )));
            }
            // A blank node of the template is another node for each solution.
            let mut blank = HashMap::new();
            for pattern in delete {
                if let Some(quad) = deleted(pattern, &solution) {
                    changes.remove(quad)?;
                }
            }
            for pattern in insert {
                if let Some(quad) = inserted(pattern, &solution, &mut blank) {
                    changes.add(quad)?;
                }
            }
        }
        Ok(())
    }

    fn clear(&self, changes: &mut Changes, graph: &GraphTarget) -> Result<(), QueryFault> {
        let unnamed = || KnowledgeSource::new(SourceKind::Graph, UNNAMED);
        let graphs: Vec<KnowledgeSource> = match graph {
            GraphTarget::NamedNode(graph) => vec![writable(graph.as_str())?],
            GraphTarget::DefaultGraph => vec![unnamed()],
            GraphTarget::NamedGraphs | GraphTarget::AllGraphs => {
                let is_all = *graph == GraphTarget::AllGraphs;
                let all = self.writing.sources();
                let all = all.filter(|source| source.kind == SourceKind::Graph);
                all.filter(|source| is_all || source.name != UNNAMED)
                    .cloned()
                    .collect()
            }
        };
        for source in graphs {
            let removed = self.writing.triples(&source)?;
            let change = changes.0.entry(source.name).or_default();
            change.removed.extend(removed);
        }
        Ok(())
    }
}

/// The changes of an operation by graph. Deletions are applied before insertions.
#[derive(Debug, Default)]
struct Changes(BTreeMap<String, GraphChange>);

impl Changes {
    fn of(&mut self, graph: &GraphName) -> Result<&mut GraphChange, QueryFault> {
        let graph = match graph {
            GraphName::NamedNode(graph) => graph.as_str(),
            GraphName::DefaultGraph => UNNAMED,
            GraphName::BlankNode(_) => {
                return Err(QueryFault::Graph("a blank node".to_owned()));
            }
        };
        writable(graph)?;
        Ok(self.0.entry(graph.to_owned()).or_default())
    }

    fn add(&mut self, quad: Quad) -> Result<(), QueryFault> {
        let change = self.of(&quad.graph_name)?;
        change.added.push(Triple::from(quad));
        Ok(())
    }

    fn remove(&mut self, quad: Quad) -> Result<(), QueryFault> {
        let change = self.of(&quad.graph_name)?;
        change.removed.push(Triple::from(quad));
        Ok(())
    }
}

fn select(using: Option<&QueryDataset>, pattern: &GraphPattern) -> Query {
    Query::Select {
        dataset: using.cloned(),
        pattern: pattern.clone(),
        base_iri: None,
    }
}

fn ground(quad: &GroundQuad) -> Quad {
    let object: Term = match &quad.object {
        GroundTerm::NamedNode(node) => node.clone().into(),
        GroundTerm::Literal(literal) => literal.clone().into(),
    };
    Quad::new(
        quad.subject.clone(),
        quad.predicate.clone(),
        object,
        graph_of(&quad.graph_name),
    )
}

/// Returns a statement of an update. A blank node of the text is a new node of the store.
fn renamed(quad: &spargebra::term::Quad, blank: &mut HashMap<BlankNode, BlankNode>) -> Quad {
    let mut new = |node: &BlankNode| blank.entry(node.clone()).or_default().clone();
    let subject = match &quad.subject {
        NamedOrBlankNode::NamedNode(node) => NamedOrBlankNode::from(node.clone()),
        NamedOrBlankNode::BlankNode(node) => new(node).into(),
    };
    let object = match &quad.object {
        Term::BlankNode(node) => new(node).into(),
        Term::NamedNode(_) | Term::Literal(_) => quad.object.clone(),
    };
    Quad::new(
        subject,
        quad.predicate.clone(),
        object,
        graph_of(&quad.graph_name),
    )
}

fn graph_of(graph: &spargebra::term::GraphName) -> GraphName {
    match graph {
        spargebra::term::GraphName::NamedNode(graph) => graph.clone().into(),
        spargebra::term::GraphName::DefaultGraph => GraphName::DefaultGraph,
    }
}

/// Returns the statement of a template; `None` if a variable has no value, or a value that is not
/// allowed at its place.
fn deleted(pattern: &GroundQuadPattern, solution: &QuerySolution) -> Option<Quad> {
    let term = |pattern: &GroundTermPattern| match pattern {
        GroundTermPattern::NamedNode(node) => Some(node.clone().into()),
        GroundTermPattern::Literal(literal) => Some(literal.clone().into()),
        GroundTermPattern::Variable(variable) => solution.get(variable).cloned(),
    };
    Some(Quad::new(
        subject(term(&pattern.subject)?)?,
        predicate(&pattern.predicate, solution)?,
        term(&pattern.object)?,
        graph(&pattern.graph_name, solution)?,
    ))
}

fn inserted(
    pattern: &QuadPattern,
    solution: &QuerySolution,
    blank: &mut HashMap<BlankNode, BlankNode>,
) -> Option<Quad> {
    let mut term = |pattern: &TermPattern| match pattern {
        TermPattern::NamedNode(node) => Some(node.clone().into()),
        TermPattern::Literal(literal) => Some(literal.clone().into()),
        TermPattern::Variable(variable) => solution.get(variable).cloned(),
        TermPattern::BlankNode(node) => {
            let node = blank.entry(node.clone()).or_default();
            Some(Term::from(node.clone()))
        }
    };
    Some(Quad::new(
        subject(term(&pattern.subject)?)?,
        predicate(&pattern.predicate, solution)?,
        term(&pattern.object)?,
        graph(&pattern.graph_name, solution)?,
    ))
}

fn subject(term: Term) -> Option<NamedOrBlankNode> {
    match term {
        Term::NamedNode(node) => Some(node.into()),
        Term::BlankNode(node) => Some(node.into()),
        Term::Literal(_) => None,
    }
}

fn predicate(pattern: &NamedNodePattern, solution: &QuerySolution) -> Option<NamedNode> {
    match pattern {
        NamedNodePattern::NamedNode(node) => Some(node.clone()),
        NamedNodePattern::Variable(variable) => match solution.get(variable)? {
            Term::NamedNode(node) => Some(node.clone()),
            Term::BlankNode(_) | Term::Literal(_) => None,
        },
    }
}

fn graph(pattern: &GraphNamePattern, solution: &QuerySolution) -> Option<GraphName> {
    match pattern {
        GraphNamePattern::NamedNode(node) => Some(node.clone().into()),
        GraphNamePattern::DefaultGraph => Some(GraphName::DefaultGraph),
        GraphNamePattern::Variable(variable) => match solution.get(variable)? {
            Term::NamedNode(node) => Some(node.clone().into()),
            Term::BlankNode(_) | Term::Literal(_) => None,
        },
    }
}

/// The prefix of the graphs that are made from sources.
const OURS: &str = "urn:ua-bridge:graph:";
/// Maximum number of statements that an operation changes.
const MOST_CHANGES: usize = 1_000_000;
