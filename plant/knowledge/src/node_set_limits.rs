//! Limits that the nodes of a NodeSet declare: the EURange of a variable, with its EngineeringUnits
//! (OPC 10000-8, 5.3.2.3).
//!
//! A limit belongs to the type or object that has the variable. Objects that only group nodes, such
//! as a ParameterSet, are passed over.

use std::collections::{BTreeMap, BTreeSet};

use mtp::{Object, Triple};
use nodeset_files::{NodeSetFileNode, NodeSetFileRange, NodeSetFileUnit};

use crate::component::{NodeName, OPC_UA};
use crate::units;
use crate::vocabulary as v;

/// The nodes of a NodeSet by their IRIs.
pub(crate) type NodesByIri<'a> = BTreeMap<String, (NodeName, &'a NodeSetFileNode)>;

/// The objects, types and variables above each node, and the nodes that only group others.
#[derive(Debug, Default)]
pub(crate) struct DeclaredLimits {
    above: BTreeMap<String, BTreeSet<String>>,
    grouping: BTreeMap<String, Grouping>,
}

/// The kind of an object that only groups nodes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Grouping {
    /// A folder, which never has a limit.
    Folder,
    /// An object without a type of its own. It has the limit only if neither a type nor an object
    /// of another kind above the variable has it.
    Plain,
}

impl DeclaredLimits {
    /// Adds a reference between nodes that are given by their IRIs.
    pub(crate) fn reference(&mut self, from: &str, reference: &NodeName, to: (&str, &NodeName)) {
        let (to, name) = to;
        if reference.namespace != OPC_UA {
            return;
        }
        match reference.identifier.as_str() {
            HAS_TYPE_DEFINITION => {
                let grouping = match (name.namespace.as_str(), name.identifier.as_str()) {
                    (OPC_UA, BASE_OBJECT_TYPE) => Grouping::Plain,
                    (OPC_UA, FOLDER_TYPE) | (DI, FUNCTIONAL_GROUP_TYPE) => Grouping::Folder,
                    _ => return,
                };
                self.grouping.insert(from.to_owned(), grouping);
            }
            kind if BELOW.contains(&kind) => {
                let above = self.above.entry(to.to_owned()).or_default();
                above.insert(from.to_owned());
            }
            _ => {}
        }
    }

    /// Returns the limits as statements. The nodes of types have their names from elsewhere.
    pub(crate) fn statements(&self, nodes: &NodesByIri<'_>) -> Vec<Triple> {
        let mut limits = LimitStatements::default();
        for (iri, (_, property)) in nodes {
            let (Some(range), "EURange") = (&property.range, property.plain_browse_name()) else {
                continue;
            };
            let Some(bounds) = bounds(range) else {
                continue;
            };
            for variable in self.above.get(iri).into_iter().flatten() {
                let Some((variable, (_, node))) = nodes.get_key_value(variable) else {
                    continue;
                };
                if node.class != "Variable" {
                    continue;
                }
                let holders = self.holders(variable, nodes);
                if holders.is_empty() {
                    continue;
                }
                limits.limit(variable, node, bounds);
                limits.node(variable, nodes);
                for holder in holders {
                    limits.link(holder, v::HAS_LIMIT, variable);
                    limits.node(holder, nodes);
                    if let Some(owner) = self.owner(holder, nodes) {
                        limits.link(holder, v::IS_PART_OF, owner);
                        limits.node(owner, nodes);
                    }
                }
            }
        }
        for (iri, (_, property)) in nodes {
            if property.plain_browse_name() == "EngineeringUnits"
                && let Some(symbol) = property.unit.as_ref().and_then(symbol)
            {
                for variable in self.above.get(iri).into_iter().flatten() {
                    limits.unit(variable, &symbol);
                }
            }
        }
        limits.all
    }

    /// Returns the nearest types and objects above a node which do not only group nodes, or else
    /// the topmost plain objects.
    fn holders<'a>(&'a self, of: &'a str, nodes: &NodesByIri<'_>) -> BTreeSet<&'a str> {
        let (mut found, mut topmost) = (BTreeSet::new(), BTreeSet::new());
        let mut seen = BTreeSet::from([of]);
        let mut waiting = vec![of];
        while let Some(node) = waiting.pop() {
            let above = self.above.get(node).into_iter().flatten();
            let above: Vec<&str> = above
                .map(String::as_str)
                .filter(|above| nodes.contains_key(*above))
                .take(MOST_ABOVE)
                .collect();
            let grouping = |node: &str| self.grouping.get(node).copied();
            let is_topmost = above
                .iter()
                .all(|above| grouping(above) == Some(Grouping::Folder));
            if is_topmost && node != of && grouping(node) == Some(Grouping::Plain) {
                topmost.insert(node);
            }
            for above in above {
                if seen.len() >= MOST_ABOVE || !seen.insert(above) {
                    continue;
                }
                let class = nodes.get(above).map(|(_, node)| node.class.as_str());
                let holds = matches!(class, Some("Object" | "ObjectType"));
                if holds && !self.grouping.contains_key(above) {
                    found.insert(above);
                } else {
                    waiting.push(above);
                }
            }
        }
        if found.is_empty() { topmost } else { found }
    }

    /// Returns the topmost type or object above a type or object that has a limit.
    fn owner<'a>(&'a self, of: &'a str, nodes: &NodesByIri<'_>) -> Option<&'a str> {
        let mut owner = None;
        let mut seen = BTreeSet::from([of]);
        let mut node = of;
        while let Some(above) = self.holders(node, nodes).into_iter().next() {
            if seen.len() >= MOST_ABOVE || !seen.insert(above) {
                break;
            }
            owner = Some(above);
            node = above;
        }
        owner
    }
}

#[derive(Debug, Default)]
struct LimitStatements {
    all: Vec<Triple>,
    /// The variables that have limits.
    limited: BTreeSet<String>,
    /// The nodes that have names.
    named: BTreeSet<String>,
}

impl LimitStatements {
    fn limit(
        &mut self,
        variable: &str,
        node: &NodeSetFileNode,
        (min, max): (Option<f64>, Option<f64>),
    ) {
        if !self.limited.insert(variable.to_owned()) {
            return;
        }
        let name = Object::Text(node.plain_browse_name().to_owned());
        self.say(variable, v::HAS_VARIABLE_NAME, name);
        for (bound, predicate) in [(min, v::MIN), (max, v::MAX)] {
            if let Some(bound) = bound {
                self.say(variable, predicate, Object::Number(bound));
            }
        }
    }

    fn unit(&mut self, variable: &str, symbol: &str) {
        if self.limited.contains(variable) {
            self.say(variable, v::UNIT, Object::Text(symbol.to_owned()));
        }
    }

    fn node(&mut self, iri: &str, nodes: &NodesByIri<'_>) {
        if let Some((name, node)) = nodes.get(iri)
            && self.named.insert(iri.to_owned())
        {
            let browse_name = Object::Text(node.plain_browse_name().to_owned());
            self.say(iri, v::BROWSE_NAME, browse_name);
            self.say(iri, v::NODE_ID, Object::Text(name.id()));
        }
    }

    fn link(&mut self, subject: &str, predicate: &str, object: &str) {
        self.say(subject, predicate, Object::Iri(object.to_owned()));
    }

    fn say(&mut self, subject: &str, predicate: &str, object: Object) {
        self.all.push(Triple {
            subject: subject.to_owned(),
            predicate: predicate.to_owned(),
            object,
        });
    }
}

/// Returns the bounds of a range, without those that are written as infinite. Returns `None` if a
/// bound is no number or too large for one. Returns `None` also for an empty range, such as 0 to 0,
/// which stands for an unknown range in files.
fn bounds(range: &NodeSetFileRange) -> Option<(Option<f64>, Option<f64>)> {
    let bound = |text: &str| match text.trim() {
        // The default of an omitted element.
        "" => Some(0.0),
        text => text.parse::<f64>().ok().filter(|bound| {
            let is_written = !text.contains(|digit: char| digit.is_ascii_digit());
            bound.is_finite() || (bound.is_infinite() && is_written)
        }),
    };
    let (low, high) = (bound(&range.low)?, bound(&range.high)?);
    let finite = |bound: f64| bound.is_finite().then_some(bound);
    (low < high).then(|| (finite(low), finite(high)))
}

/// Returns the symbol of a unit, by its UnitId if that is known.
fn symbol(unit: &NodeSetFileUnit) -> Option<String> {
    let by_code = unit.unece_code();
    let by_code = by_code.as_deref().and_then(units::symbol);
    let written = unit.symbol.trim();
    let symbol = by_code.unwrap_or(written);
    (!symbol.is_empty()).then(|| symbol.to_owned())
}

const HAS_TYPE_DEFINITION: &str = "i=40";
const BASE_OBJECT_TYPE: &str = "i=58";
const FOLDER_TYPE: &str = "i=61";
const DI: &str = "http://opcfoundation.org/UA/DI/";
const FUNCTIONAL_GROUP_TYPE: &str = "i=1005";
/// Organizes, HasProperty, HasComponent, HasOrderedComponent, HasAddIn.
const BELOW: [&str; 5] = ["i=35", "i=46", "i=47", "i=49", "i=17604"];
/// Number of nodes above a node that are looked at.
const MOST_ABOVE: usize = 64;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_range_with_a_bound_that_cannot_be_read_is_no_limit() {
        let of = |low: &str, high: &str| {
            let (low, high) = (low.to_owned(), high.to_owned());
            bounds(&NodeSetFileRange { low, high })
        };
        assert_eq!(of("-1", " 5e3 "), Some((Some(-1.0), Some(5000.0))));
        assert_eq!(of("", "2"), Some((Some(0.0), Some(2.0))));
        assert_eq!(of("-INF", "INF"), Some((None, None)));
        for (low, high) in [
            ("0", "1e400"),
            ("-1e400", "5"),
            ("0", "NaN"),
            ("0", "five"),
            ("0", "0"),
            ("5", "-INF"),
        ] {
            assert_eq!(of(low, high), None, "{low} to {high}");
        }
    }
}
