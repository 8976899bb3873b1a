//! The graph of derived statements: computed again after a change of the schema, and updated in
//! place after every other change.
//!
//! Except for the hierarchies of classes and properties, the graph has no statement that a source
//! states.

use std::collections::{BTreeMap, BTreeSet, HashMap, HashSet};

use oxigraph::model::vocab::{rdf, rdfs};
use oxigraph::model::{
    GraphName, NamedNode, NamedNodeRef, NamedOrBlankNode, NamedOrBlankNodeRef, Term, TermRef,
    Triple,
};
use oxigraph::store::{StorageError, Transaction};

use super::{Direction, Extent, Schema, directed, resource};
use crate::source::DERIVED;

/// The rules of a store.
#[derive(Debug, Clone, Default)]
pub(crate) enum StoreRules {
    /// Subclasses of subclasses only.
    #[default]
    Off,
    /// The rules of OWL 2 RL, with the schema of the sources.
    On(Schema),
    /// More statements follow than are stored; no rule is applied until the schema changes.
    Suspended,
}

/// A change of the derived graph.
#[derive(Debug, Default)]
pub(crate) struct Derived {
    pub(crate) added: Vec<Triple>,
    pub(crate) removed: Vec<Triple>,
    /// The rules after the change, if they are others.
    pub(crate) rules: Option<StoreRules>,
}

/// Reason why no statements are derived.
enum Stop {
    Store(StorageError),
    TooMany,
}

impl From<StorageError> for Stop {
    fn from(error: StorageError) -> Self {
        Self::Store(error)
    }
}

impl StoreRules {
    pub(crate) fn extent(&self) -> Extent {
        match self {
            Self::Off => Extent::Subclasses,
            Self::On(_) | Self::Suspended => Extent::OwlRl,
        }
    }

    pub(crate) fn name(&self) -> &'static str {
        match self {
            Self::Off => "off",
            Self::On(_) => "on",
            Self::Suspended => "suspended",
        }
    }

    /// Returns the change of the derived graph after a change of the schema.
    pub(crate) fn after_schema(
        &self,
        transaction: &Transaction<'_>,
        touched: &HashSet<Triple>,
    ) -> Result<Derived, StorageError> {
        let schema = Schema::read(transaction, self.extent())?;
        if let Self::On(old) = self
            && old.properties == schema.properties
        {
            let mut changing = Changing::new(transaction, &schema, MAX_DERIVED);
            let found = changing.all(touched, old);
            if let Some(mut derived) = suspended(found)? {
                let (added, removed) = hierarchies(transaction, &schema)?;
                derived.added.extend(added);
                derived.removed.extend(removed);
                derived.rules = Some(Self::On(schema));
                return Ok(derived);
            }
        }
        self.anew(transaction)
    }

    /// Returns the change of the derived graph that makes it complete, whatever is in it.
    pub(crate) fn anew(&self, transaction: &Transaction<'_>) -> Result<Derived, StorageError> {
        let mut schema = Schema::read(transaction, self.extent())?;
        let mut wanted = HashSet::new();
        let mut rules = Self::Off;
        if self.extent() == Extent::OwlRl {
            let mut changing = Changing::new(transaction, &schema, MAX_DERIVED);
            match suspended(changing.anew())? {
                Some(all) => {
                    wanted = all;
                    rules = Self::On(schema.clone());
                }
                None => {
                    rules = Self::Suspended;
                    schema = Schema::read(transaction, Extent::Subclasses)?;
                }
            }
        }
        let room = MAX_DERIVED.saturating_sub(wanted.len());
        wanted.extend(limited(&schema, room));
        let present = of_graph(transaction, None)?;
        Ok(Derived {
            added: wanted.difference(&present).cloned().collect(),
            removed: present.difference(&wanted).cloned().collect(),
            rules: Some(rules),
        })
    }

    /// Returns the change of the derived graph after a change of statements that are not of the
    /// schema.
    pub(crate) fn after(
        &self,
        transaction: &Transaction<'_>,
        touched: &HashSet<Triple>,
    ) -> Result<Derived, StorageError> {
        let Self::On(schema) = self else {
            return Ok(Derived::default());
        };
        let mut changing = Changing::new(transaction, schema, MAX_DERIVED);
        let found = changing.all(touched, schema);
        match suspended(found)? {
            Some(derived) => Ok(derived),
            None => {
                let mut derived = Self::Off.anew(transaction)?;
                derived.rules = Some(Self::Suspended);
                Ok(derived)
            }
        }
    }
}

/// Returns `None` and logs a warning if more statements follow than are stored.
fn suspended<T>(found: Result<T, Stop>) -> Result<Option<T>, StorageError> {
    match found {
        Ok(found) => Ok(Some(found)),
        Err(Stop::Store(error)) => Err(error),
        Err(Stop::TooMany) => {
            tracing::warn!(
                most = MAX_DERIVED,
                "the rules derive more statements than the limit: no rule is applied until the schema changes"
            );
            Ok(None)
        }
    }
}

/// Returns the changes of the hierarchies of classes and properties.
fn hierarchies(
    transaction: &Transaction<'_>,
    schema: &Schema,
) -> Result<(Vec<Triple>, Vec<Triple>), StorageError> {
    let wanted: HashSet<Triple> = limited(schema, MAX_DERIVED).collect();
    let mut present = of_graph(transaction, Some(rdfs::SUB_CLASS_OF))?;
    present.extend(of_graph(transaction, Some(rdfs::SUB_PROPERTY_OF))?);
    let added = wanted.difference(&present).cloned().collect();
    let removed = present.difference(&wanted).cloned().collect();
    Ok((added, removed))
}

fn limited(schema: &Schema, most: usize) -> impl Iterator<Item = Triple> {
    let mut all: Vec<Triple> = schema.hierarchies().take(most.saturating_add(1)).collect();
    if all.len() > most {
        all.truncate(most);
        tracing::warn!(
            most = MAX_DERIVED,
            "the limit of stored superclasses is reached: answers about types may be incomplete"
        );
    }
    all.into_iter()
}

/// Returns the derived statements, all or those with a predicate.
fn of_graph(
    transaction: &Transaction<'_>,
    predicate: Option<NamedNodeRef<'_>>,
) -> Result<HashSet<Triple>, StorageError> {
    let quads = transaction.quads_for_pattern(None, predicate, None, Some(GRAPH.into()));
    quads.map(|quad| quad.map(Triple::from)).collect()
}

/// Returns whether a graph is that of a source.
pub(super) fn is_of_source(graph: &GraphName) -> bool {
    matches!(graph, GraphName::NamedNode(graph) if graph.as_ref() != GRAPH)
}

/// The statements that follow after a change.
struct Changing<'a> {
    transaction: &'a Transaction<'a>,
    schema: &'a Schema,
    /// The nodes that are reached from a node by a transitive property.
    reached: HashMap<(NamedNode, NamedOrBlankNode), HashSet<Term>>,
    /// Statements that may have to be added or removed, and whether they are known to follow.
    candidates: HashMap<Triple, bool>,
    /// Number of visited nodes that are left.
    visits: usize,
    most: usize,
}

impl<'a> Changing<'a> {
    fn new(transaction: &'a Transaction<'_>, schema: &'a Schema, most: usize) -> Self {
        Self {
            transaction,
            schema,
            reached: HashMap::new(),
            candidates: HashMap::new(),
            visits: most.saturating_mul(VISITS_OF_EACH),
            most,
        }
    }

    /// Returns all statements that follow, except those that sources state.
    fn anew(&mut self) -> Result<HashSet<Triple>, Stop> {
        let mut starts = HashSet::new();
        for quad in self.transaction.quads_for_pattern(None, None, None, None) {
            let quad = quad?;
            if !is_of_source(&quad.graph_name) {
                continue;
            }
            let triple = Triple::from(quad);
            for consequence in self.schema.consequences(&triple) {
                self.follows(consequence, true)?;
            }
            let links = self.schema.links(&triple).into_iter();
            starts.extend(links.map(|link| (link.predicate, link.subject)));
        }
        for (property, start) in starts {
            self.reach_again(&property, &start)?;
        }
        let mut all = HashSet::new();
        for (triple, is_known) in std::mem::take(&mut self.candidates) {
            if is_known && !self.is_stated(&triple)? {
                all.insert(triple);
            }
        }
        Ok(all)
    }

    /// Returns the change of the derived graph after a change of statements, and of the classes
    /// above a class since an older schema with the same properties.
    fn all(&mut self, touched: &HashSet<Triple>, old: &Schema) -> Result<Derived, Stop> {
        let mut links: BTreeMap<NamedNode, Vec<Triple>> = BTreeMap::new();
        for triple in touched {
            let is_stated = self.is_stated(triple)?;
            self.follows(triple.clone(), false)?;
            for consequence in self.schema.consequences(triple) {
                self.follows(consequence, is_stated)?;
            }
            for link in self.schema.links(triple) {
                let links = links.entry(link.predicate.clone()).or_default();
                links.push(link);
            }
            // The removed statement may have had other classes above.
            if !std::ptr::eq(self.schema, old) {
                for consequence in old.consequences(triple) {
                    self.follows(consequence, false)?;
                }
            }
        }
        if !std::ptr::eq(self.schema, old) {
            self.reclassify(old)?;
        }
        for (property, links) in links {
            for start in self.ancestors(&property, &links)? {
                self.reach_again(&property, &start)?;
            }
        }
        self.settle()
    }

    /// Notes a statement that may follow.
    fn follows(&mut self, triple: Triple, is_known: bool) -> Result<(), Stop> {
        *self.candidates.entry(triple).or_default() |= is_known;
        if self.candidates.len() > self.most {
            Err(Stop::TooMany)
        } else {
            Ok(())
        }
    }

    /// Notes the types of the nodes of all classes whose classes above have changed.
    fn reclassify(&mut self, old: &Schema) -> Result<(), Stop> {
        let (schema, none) = (self.schema, BTreeSet::new());
        let classes: BTreeSet<&NamedNode> = schema.above.keys().chain(old.above.keys()).collect();
        for class in classes {
            let (before, after) = (old.above.get(class), schema.above.get(class));
            if before == after {
                continue;
            }
            let (before, after) = (before.unwrap_or(&none), after.unwrap_or(&none));
            for node in self.subjects(rdf::TYPE, class.as_ref().into())? {
                for above in before.union(after) {
                    let typed = Triple::new(node.clone(), rdf::TYPE, above.clone());
                    self.follows(typed, above != class && after.contains(above))?;
                }
            }
        }
        Ok(())
    }

    /// Notes the edges of a transitive property from a node, and the edges that they imply.
    fn reach_again(&mut self, property: &NamedNode, start: &NamedOrBlankNode) -> Result<(), Stop> {
        let reached = self.reach(property, start)?;
        let edge = |object: &Term| Triple::new(start.clone(), property.clone(), object.clone());
        for object in &reached {
            self.implies(&edge(object), true)?;
        }
        let known = self.transaction.quads_for_pattern(
            Some(start.as_ref()),
            Some(property.as_ref()),
            None,
            Some(GRAPH.into()),
        );
        let known: Vec<Triple> = known
            .map(|quad| quad.map(Triple::from))
            .collect::<Result<_, _>>()?;
        for triple in known {
            if !reached.contains(&triple.object) {
                self.implies(&triple, false)?;
            }
        }
        self.reached
            .insert((property.clone(), start.clone()), reached);
        Ok(())
    }

    fn implies(&mut self, edge: &Triple, is_known: bool) -> Result<(), Stop> {
        self.follows(edge.clone(), is_known)?;
        let images = self.schema.properties.images.get(&edge.predicate);
        for (image, direction) in images.into_iter().flatten() {
            if let Some(image) = directed(edge, image, *direction) {
                self.follows(image, is_known)?;
            }
        }
        Ok(())
    }

    /// Returns the nodes from which the edges can be reached, before or after the change.
    fn ancestors(
        &mut self,
        property: &NamedNode,
        links: &[Triple],
    ) -> Result<HashSet<NamedOrBlankNode>, Stop> {
        let mut seen: HashSet<NamedOrBlankNode> = HashSet::new();
        let mut waiting: Vec<NamedOrBlankNode> =
            links.iter().map(|link| link.subject.clone()).collect();
        while let Some(node) = waiting.pop() {
            if !seen.insert(node.clone()) {
                continue;
            }
            self.visit(seen.len())?;
            let object = Term::from(node);
            let removed = links.iter().filter(|link| link.object == object);
            waiting.extend(removed.map(|link| link.subject.clone()));
            let before = self.neighbours(property, Direction::Reversed, &object)?;
            waiting.extend(before.iter().filter_map(resource));
        }
        Ok(seen)
    }

    /// Returns the nodes that are reached from a node by edges of a transitive property.
    fn reach(
        &mut self,
        property: &NamedNode,
        start: &NamedOrBlankNode,
    ) -> Result<HashSet<Term>, Stop> {
        let mut seen = HashSet::new();
        let mut waiting = vec![Term::from(start.clone())];
        while let Some(node) = waiting.pop() {
            for next in self.neighbours(property, Direction::Same, &node)? {
                if seen.insert(next.clone()) {
                    self.visit(seen.len())?;
                    waiting.push(next);
                }
            }
        }
        Ok(seen)
    }

    fn visit(&mut self, nodes: usize) -> Result<(), Stop> {
        self.visits = self.visits.saturating_sub(1);
        if self.visits == 0 || nodes > self.most {
            Err(Stop::TooMany)
        } else {
            Ok(())
        }
    }

    /// Returns the nodes behind a node, or before it, by the stated edges of a property and of the
    /// properties that imply it.
    fn neighbours(
        &self,
        property: &NamedNode,
        towards: Direction,
        node: &Term,
    ) -> Result<Vec<Term>, Stop> {
        let mut all = Vec::new();
        let itself = (property.clone(), Direction::Same);
        let sources = self.schema.properties.sources.get(property);
        for (source, direction) in sources.into_iter().flatten().chain([&itself]) {
            if *direction == towards {
                let Some(subject) = resource(node) else {
                    continue;
                };
                all.extend(self.objects(subject.as_ref(), source.as_ref())?);
            } else {
                let subjects = self.subjects(source.as_ref(), node.as_ref())?;
                all.extend(subjects.into_iter().map(Term::from));
            }
        }
        Ok(all)
    }

    /// Compares the candidates with the derived graph.
    fn settle(&mut self) -> Result<Derived, Stop> {
        let mut derived = Derived::default();
        for (triple, is_known) in std::mem::take(&mut self.candidates) {
            let is_wanted =
                !self.is_stated(&triple)? && (is_known || self.is_supported(&triple)?);
            let of_graph = self.transaction.contains(triple.as_ref().in_graph(GRAPH))?;
            let is_hierarchy =
                [rdfs::SUB_CLASS_OF, rdfs::SUB_PROPERTY_OF].contains(&triple.predicate.as_ref());
            match (is_wanted, of_graph) {
                _ if is_hierarchy => {}
                (true, false) => derived.added.push(triple),
                (false, true) => derived.removed.push(triple),
                (true, true) | (false, false) => {}
            }
        }
        Ok(derived)
    }

    /// Returns whether a statement follows from statements of sources.
    fn is_supported(&mut self, triple: &Triple) -> Result<bool, Stop> {
        let schema = self.schema;
        if triple.predicate.as_ref() == rdf::TYPE {
            return match &triple.object {
                Term::NamedNode(class) => self.is_typed(&triple.subject, class),
                Term::BlankNode(_) | Term::Literal(_) => Ok(false),
            };
        }
        let property = &triple.predicate;
        let sources = schema.properties.sources.get(property);
        let sources = sources.into_iter().flatten();
        let itself = (property.clone(), Direction::Same);
        for (source, direction) in sources.chain([&itself]) {
            // The premise of a reversed edge is the edge reversed.
            let Some(premise) = directed(triple, source, *direction) else {
                continue;
            };
            if premise != *triple && self.is_stated(&premise)? {
                return Ok(true);
            }
            if !schema.properties.transitive.contains(source) {
                continue;
            }
            let key = (source.clone(), premise.subject.clone());
            if !self.reached.contains_key(&key) {
                let reached = self.reach(&key.0, &key.1)?;
                self.reached.insert(key.clone(), reached);
            }
            let reached = self.reached.get(&key);
            if reached.is_some_and(|reached| reached.contains(&premise.object)) {
                return Ok(true);
            }
        }
        Ok(false)
    }

    /// Returns whether a class of a node follows.
    fn is_typed(&self, node: &NamedOrBlankNode, class: &NamedNode) -> Result<bool, Stop> {
        for stated in self.objects(node.as_ref(), rdf::TYPE)? {
            if let Term::NamedNode(stated) = stated
                && let Some(above) = self.schema.above.get(&stated)
                && stated != *class
                && above.contains(class)
            {
                return Ok(true);
            }
        }
        for (property, end) in self.schema.properties.that_type(class) {
            let (subject, object) = match end {
                Direction::Same => (Some(node.as_ref()), None),
                Direction::Reversed => (None, Some(TermRef::from(node.as_ref()))),
            };
            if self.any_stated(subject, property.as_ref(), object)? {
                return Ok(true);
            }
        }
        Ok(false)
    }

    fn is_stated(&self, triple: &Triple) -> Result<bool, Stop> {
        self.any_stated(
            Some(triple.subject.as_ref()),
            triple.predicate.as_ref(),
            Some(triple.object.as_ref()),
        )
    }

    fn any_stated(
        &self,
        subject: Option<NamedOrBlankNodeRef<'_>>,
        predicate: NamedNodeRef<'_>,
        object: Option<TermRef<'_>>,
    ) -> Result<bool, Stop> {
        let quads = self
            .transaction
            .quads_for_pattern(subject, Some(predicate), object, None);
        for quad in quads {
            if is_of_source(&quad?.graph_name) {
                return Ok(true);
            }
        }
        Ok(false)
    }

    fn objects(
        &self,
        subject: NamedOrBlankNodeRef<'_>,
        predicate: NamedNodeRef<'_>,
    ) -> Result<Vec<Term>, Stop> {
        let quads = self
            .transaction
            .quads_for_pattern(Some(subject), Some(predicate), None, None);
        let mut all = Vec::new();
        for quad in quads {
            let quad = quad?;
            if is_of_source(&quad.graph_name) {
                all.push(quad.object);
            }
        }
        Ok(all)
    }

    fn subjects(
        &self,
        predicate: NamedNodeRef<'_>,
        object: TermRef<'_>,
    ) -> Result<Vec<NamedOrBlankNode>, Stop> {
        let quads = self
            .transaction
            .quads_for_pattern(None, Some(predicate), Some(object), None);
        let mut all = Vec::new();
        for quad in quads {
            let quad = quad?;
            if is_of_source(&quad.graph_name) {
                all.push(quad.subject);
            }
        }
        Ok(all)
    }
}

/// Maximum number of derived statements.
const MAX_DERIVED: usize = 500_000;
/// Visited nodes for each statement that may be derived.
const VISITS_OF_EACH: usize = 20;
const GRAPH: NamedNodeRef<'_> = NamedNodeRef::new_unchecked(DERIVED);
