//! Rules of OWL 2 RL: the schema that the sources state, and the statements that follow from it.
//!
//! Covered are `scm-sco`, `scm-spo`, `scm-eqc1`, `scm-eqp1`, `cax-sco`, `cax-eqc`, `prp-dom`,
//! `prp-rng`, `prp-spo1`, `prp-eqp`, `prp-inv`, `prp-symp` and `prp-trp`, for named classes and
//! properties outside RDF, RDFS and OWL. The schema has only statements of the sources: a schema
//! statement that would follow by other rules of OWL 2 RL is not used.
//!
//! All rules except transitivity have a single statement of the plant as their premise. So the
//! support of a derived statement is found among the statements of its two nodes, and a change is
//! local. `apply` keeps the derived graph.

pub(crate) mod apply;

use std::collections::{BTreeMap, BTreeSet};

use oxigraph::model::vocab::{rdf, rdfs};
use oxigraph::model::{NamedNode, NamedNodeRef, NamedOrBlankNode, Term, Triple};
use oxigraph::store::{StorageError, Transaction};

use self::apply::is_of_source;

/// The rules that are applied.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Extent {
    /// Subclasses of subclasses only.
    Subclasses,
    /// All rules of this module.
    OwlRl,
}

/// The direction of a derived edge.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Direction {
    /// From the subject of the premise to its object.
    Same,
    /// From the object of the premise to its subject.
    Reversed,
}

/// The classes above each class, and the properties with rules.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(crate) struct Schema {
    above: BTreeMap<NamedNode, BTreeSet<NamedNode>>,
    properties: Properties,
}

/// An edge of a property implies an edge of another one, in the same or the reverse direction.
type Images = BTreeMap<NamedNode, BTreeSet<(NamedNode, Direction)>>;

#[derive(Debug, Clone, Default, PartialEq, Eq)]
struct Properties {
    above: BTreeMap<NamedNode, BTreeSet<NamedNode>>,
    /// The edges that an edge of a property implies.
    images: Images,
    /// The edges that imply an edge of a property: `images` the other way round.
    sources: Images,
    transitive: BTreeSet<NamedNode>,
    /// The classes of the subjects of a property.
    subjects: BTreeMap<NamedNode, BTreeSet<NamedNode>>,
    /// The classes of the objects of a property.
    objects: BTreeMap<NamedNode, BTreeSet<NamedNode>>,
}

impl Schema {
    /// Reads the schema that the sources state.
    pub(crate) fn read(
        transaction: &Transaction<'_>,
        extent: Extent,
    ) -> Result<Self, StorageError> {
        let mut above = BTreeMap::new();
        for (class, supertype) in pairs(transaction, rdfs::SUB_CLASS_OF)? {
            below(&mut above, class, supertype);
        }
        if extent == Extent::Subclasses {
            return Ok(Self {
                above: closed(&above),
                properties: Properties::default(),
            });
        }
        for (one, other) in pairs(transaction, EQUIVALENT_CLASS)? {
            below(&mut above, one.clone(), other.clone());
            below(&mut above, other, one);
        }
        let above = closed(&above);
        let properties = Properties::read(transaction, &above)?;
        Ok(Self { above, properties })
    }

    /// Returns whether a statement is one of the schema.
    pub(crate) fn has(triple: &Triple, extent: Extent) -> bool {
        let predicate = triple.predicate.as_ref();
        if predicate == rdfs::SUB_CLASS_OF {
            return true;
        }
        if extent == Extent::Subclasses {
            return false;
        }
        let is_kind = || {
            let kinds = [TRANSITIVE, SYMMETRIC];
            matches!(&triple.object, Term::NamedNode(kind) if kinds.contains(&kind.as_ref()))
        };
        RELATIONS.contains(&predicate) || (predicate == rdf::TYPE && is_kind())
    }

    /// Returns the subclass and subproperty statements, transitive and reflexive. Questions never
    /// need a path (`rdfs:subClassOf*`), which the evaluator would follow last and for all classes.
    pub(crate) fn hierarchies(&self) -> impl Iterator<Item = Triple> {
        let of = |predicate: NamedNodeRef<'static>, above: &BTreeMap<_, BTreeSet<NamedNode>>| {
            let statement = move |one: &NamedNode, other: &NamedNode| {
                Triple::new(one.clone(), predicate, other.clone())
            };
            let mut all = Vec::new();
            for (one, above) in above {
                all.push(statement(one, one));
                let others = above.iter().filter(|other| *other != one);
                all.extend(others.map(|other| statement(one, other)));
            }
            all.into_iter()
        };
        let classes = of(rdfs::SUB_CLASS_OF, &self.above);
        classes.chain(of(rdfs::SUB_PROPERTY_OF, &self.properties.above))
    }

    /// Returns the statements that follow from one statement alone.
    fn consequences(&self, triple: &Triple) -> Vec<Triple> {
        let typed =
            |node: NamedOrBlankNode, class: &NamedNode| Triple::new(node, rdf::TYPE, class.clone());
        if triple.predicate.as_ref() == rdf::TYPE {
            let Term::NamedNode(class) = &triple.object else {
                return Vec::new();
            };
            let above = self.above.get(class).into_iter().flatten();
            let above = above.filter(|above| *above != class);
            return above
                .map(|above| typed(triple.subject.clone(), above))
                .collect();
        }
        let properties = &self.properties;
        let images = properties
            .images
            .get(&triple.predicate)
            .into_iter()
            .flatten();
        let mut all: Vec<Triple> = images
            .filter_map(|(image, direction)| directed(triple, image, *direction))
            .collect();
        let subjects = properties.subjects.get(&triple.predicate);
        let subjects = subjects.into_iter().flatten();
        all.extend(subjects.map(|class| typed(triple.subject.clone(), class)));
        if let Some(object) = resource(&triple.object) {
            let objects = properties.objects.get(&triple.predicate);
            let objects = objects.into_iter().flatten();
            all.extend(objects.map(|class| typed(object.clone(), class)));
        }
        all
    }

    /// Returns the edges of transitive properties that a statement is or implies.
    fn links(&self, triple: &Triple) -> Vec<Triple> {
        let properties = &self.properties;
        let itself = properties.transitive.contains(&triple.predicate);
        let images = properties.images.get(&triple.predicate);
        let images = images.into_iter().flatten();
        let images = images.filter(|(image, _)| properties.transitive.contains(image));
        let mut links: Vec<Triple> = images
            .filter_map(|(image, direction)| directed(triple, image, *direction))
            .collect();
        links.extend(itself.then(|| triple.clone()));
        links
    }
}

impl Properties {
    fn read(
        transaction: &Transaction<'_>,
        classes: &BTreeMap<NamedNode, BTreeSet<NamedNode>>,
    ) -> Result<Self, StorageError> {
        let of_users = |relation| -> Result<Vec<_>, StorageError> {
            let mut all = pairs(transaction, relation)?;
            all.retain(|(one, other)| !is_reserved(one) && !is_reserved(other));
            Ok(all)
        };
        let mut above = BTreeMap::new();
        let mut images = Images::new();
        let mut implies = |from: &NamedNode, to: &NamedNode, direction| {
            let images = images.entry(from.clone()).or_default();
            images.insert((to.clone(), direction));
        };
        for (one, other) in of_users(rdfs::SUB_PROPERTY_OF)? {
            implies(&one, &other, Direction::Same);
            below(&mut above, one, other);
        }
        for (one, other) in of_users(EQUIVALENT_PROPERTY)? {
            implies(&one, &other, Direction::Same);
            implies(&other, &one, Direction::Same);
            below(&mut above, one.clone(), other.clone());
            below(&mut above, other, one);
        }
        for (one, other) in of_users(INVERSE_OF)? {
            implies(&one, &other, Direction::Reversed);
            implies(&other, &one, Direction::Reversed);
        }
        for property in of_kind(transaction, SYMMETRIC)? {
            implies(&property, &property, Direction::Reversed);
        }
        let images = all_images(&images);
        let mut sources = Images::new();
        for (from, images) in &images {
            for (to, direction) in images {
                let sources = sources.entry(to.clone()).or_default();
                sources.insert((from.clone(), *direction));
            }
        }
        let mut read = Self {
            above: closed(&above),
            images,
            sources,
            transitive: of_kind(transaction, TRANSITIVE)?,
            ..Self::default()
        };
        for (relation, end) in [
            (rdfs::DOMAIN, Direction::Same),
            (rdfs::RANGE, Direction::Reversed),
        ] {
            for (property, class) in pairs(transaction, relation)? {
                if is_reserved(&property) {
                    continue;
                }
                let mut all: BTreeSet<NamedNode> = BTreeSet::from([class.clone()]);
                all.extend(classes.get(&class).into_iter().flatten().cloned());
                read.types(&property, end, &all);
            }
        }
        Ok(read)
    }

    /// Adds classes to the nodes at an end of a property, and of all properties that imply it:
    /// the subject is the end `Same`.
    fn types(&mut self, property: &NamedNode, end: Direction, classes: &BTreeSet<NamedNode>) {
        let of_others = self.sources.get(property).cloned().unwrap_or_default();
        let itself = (property.clone(), Direction::Same);
        for (source, direction) in of_others.into_iter().chain([itself]) {
            let ends = if end == direction {
                &mut self.subjects
            } else {
                &mut self.objects
            };
            let known = ends.entry(source).or_default();
            known.extend(classes.iter().cloned());
        }
    }

    /// Returns the properties whose edges give a node a class, with the end of the node.
    fn that_type(&self, class: &NamedNode) -> impl Iterator<Item = (&NamedNode, Direction)> {
        let of = |ends, end| {
            let ends: &BTreeMap<NamedNode, BTreeSet<NamedNode>> = ends;
            let properties = ends
                .iter()
                .filter(move |(_, classes)| classes.contains(class));
            properties.map(move |(property, _)| (property, end))
        };
        let subjects = of(&self.subjects, Direction::Same);
        subjects.chain(of(&self.objects, Direction::Reversed))
    }
}

/// Returns the edge that follows from a statement; `None` if its subject would be a literal.
fn directed(triple: &Triple, property: &NamedNode, direction: Direction) -> Option<Triple> {
    Some(match direction {
        Direction::Same => Triple::new(
            triple.subject.clone(),
            property.clone(),
            triple.object.clone(),
        ),
        Direction::Reversed => Triple::new(
            resource(&triple.object)?,
            property.clone(),
            triple.subject.clone(),
        ),
    })
}

fn resource(term: &Term) -> Option<NamedOrBlankNode> {
    match term {
        Term::NamedNode(node) => Some(node.clone().into()),
        Term::BlankNode(node) => Some(node.clone().into()),
        Term::Literal(_) => None,
    }
}

fn below(
    above: &mut BTreeMap<NamedNode, BTreeSet<NamedNode>>,
    one: NamedNode,
    supertype: NamedNode,
) {
    above.entry(supertype.clone()).or_default();
    above.entry(one).or_default().insert(supertype);
}

/// Returns all nodes above each node, at any distance.
fn closed(
    above: &BTreeMap<NamedNode, BTreeSet<NamedNode>>,
) -> BTreeMap<NamedNode, BTreeSet<NamedNode>> {
    let mut all = BTreeMap::new();
    for node in above.keys() {
        let mut seen: BTreeSet<&NamedNode> = BTreeSet::new();
        let mut waiting = vec![node];
        while let Some(next) = waiting.pop() {
            let further = above.get(next).into_iter().flatten();
            waiting.extend(further.filter(|further| seen.insert(*further)));
        }
        all.insert(node.clone(), seen.into_iter().cloned().collect());
    }
    all
}

/// Returns all edges that an edge of each property implies, in any number of steps.
fn all_images(images: &Images) -> Images {
    let mut all = Images::new();
    for property in images.keys() {
        let itself = (property.clone(), Direction::Same);
        let mut seen = BTreeSet::new();
        let mut waiting = vec![itself.clone()];
        while let Some((next, so_far)) = waiting.pop() {
            for (image, direction) in images.get(&next).into_iter().flatten() {
                let direction = if so_far == *direction {
                    Direction::Same
                } else {
                    Direction::Reversed
                };
                let image = (image.clone(), direction);
                if image != itself && seen.insert(image.clone()) {
                    waiting.push(image);
                }
            }
        }
        all.insert(property.clone(), seen);
    }
    all
}

/// Returns the pairs of named nodes of a relation that sources state.
fn pairs(
    transaction: &Transaction<'_>,
    relation: NamedNodeRef<'_>,
) -> Result<Vec<(NamedNode, NamedNode)>, StorageError> {
    let mut all = Vec::new();
    for quad in transaction.quads_for_pattern(None, Some(relation), None, None) {
        let quad = quad?;
        let is_stated = is_of_source(&quad.graph_name);
        if let (NamedOrBlankNode::NamedNode(one), Term::NamedNode(other), true) =
            (quad.subject, quad.object, is_stated)
        {
            all.push((one, other));
        }
    }
    Ok(all)
}

/// Returns the properties of a kind that sources state.
fn of_kind(
    transaction: &Transaction<'_>,
    kind: NamedNodeRef<'_>,
) -> Result<BTreeSet<NamedNode>, StorageError> {
    let mut all = BTreeSet::new();
    for quad in transaction.quads_for_pattern(None, Some(rdf::TYPE), Some(kind.into()), None) {
        let quad = quad?;
        let is_stated = is_of_source(&quad.graph_name);
        match quad.subject {
            NamedOrBlankNode::NamedNode(property) if is_stated && !is_reserved(&property) => {
                all.insert(property);
            }
            NamedOrBlankNode::NamedNode(_) | NamedOrBlankNode::BlankNode(_) => {}
        }
    }
    Ok(all)
}

/// Returns whether a term is one of RDF, RDFS or OWL, whose meaning no source changes.
fn is_reserved(property: &NamedNode) -> bool {
    let iri = property.as_str();
    RESERVED.iter().any(|prefix| iri.starts_with(prefix))
}

const RESERVED: [&str; 3] = [
    "http://www.w3.org/1999/02/22-rdf-syntax-ns#",
    "http://www.w3.org/2000/01/rdf-schema#",
    "http://www.w3.org/2002/07/owl#",
];
const EQUIVALENT_CLASS: NamedNodeRef<'_> =
    NamedNodeRef::new_unchecked("http://www.w3.org/2002/07/owl#equivalentClass");
const EQUIVALENT_PROPERTY: NamedNodeRef<'_> =
    NamedNodeRef::new_unchecked("http://www.w3.org/2002/07/owl#equivalentProperty");
const INVERSE_OF: NamedNodeRef<'_> =
    NamedNodeRef::new_unchecked("http://www.w3.org/2002/07/owl#inverseOf");
const TRANSITIVE: NamedNodeRef<'_> =
    NamedNodeRef::new_unchecked("http://www.w3.org/2002/07/owl#TransitiveProperty");
const SYMMETRIC: NamedNodeRef<'_> =
    NamedNodeRef::new_unchecked("http://www.w3.org/2002/07/owl#SymmetricProperty");
/// The predicates of the schema besides `rdfs:subClassOf`.
const RELATIONS: [NamedNodeRef<'_>; 6] = [
    EQUIVALENT_CLASS,
    EQUIVALENT_PROPERTY,
    INVERSE_OF,
    rdfs::SUB_PROPERTY_OF,
    rdfs::DOMAIN,
    rdfs::RANGE,
];
