//! The search through the address space of a server: bounded requests, in levels.

use std::collections::{HashMap, HashSet};

use knowledge::owl::{
    OntologyNode, OntologyReference, OntologyText, OntologyTextKind, OwlNodeClass,
};
use knowledge::{NodeName, OPC_UA, ServedNode, ServedSpace};
use plant_opcua::client::{Browse, BrowsedReferences, ClientError};
use plant_opcua::types::{
    AttributeId, DataValue, LocalizedText, NodeClass, NodeId, ObjectId, ReferenceTypeId,
    StatusCode, UAString, UaEnum as _, Variant,
};
use tokio::time::Instant;

use super::facts::{self, NamespaceNames, UnreadValue};
use super::searched::{BrowsableServer, SearchFaults, namespaces};
use crate::search_limits::SearchLimits;

/// The nodes of a server, with remarks for people.
#[derive(Debug)]
pub(super) struct Searched {
    pub(super) space: ServedSpace,
    pub(super) findings: Vec<String>,
}

/// Searches a server from start nodes; from the Objects folder if there are none.
///
/// # Errors
/// The first request without a response.
pub(super) async fn search(
    server: &dyn BrowsableServer,
    start: &[NodeName],
    limits: &SearchLimits,
    is_known: &(dyn Fn(&str) -> bool + Sync),
) -> Result<Searched, ClientError> {
    let mut search = Search {
        server,
        names: NamespaceNames::new(namespaces(server).await?),
        limits,
        ends: Instant::now() + limits.within,
        nodes: Vec::new(),
        index: HashMap::new(),
        wanted: Vec::new(),
        references: 0,
        text: 0,
        space: ServedSpace::default(),
        faults: SearchFaults::default(),
    };
    let frontier = search.start(start).await?;
    search.levels(frontier).await?;
    search.describe(0).await?;
    let walked = search.nodes.len();
    search.types(is_known).await?;
    search.describe(walked).await?;
    search.values().await?;
    Ok(search.finish())
}

struct Search<'a> {
    server: &'a dyn BrowsableServer,
    names: NamespaceNames,
    limits: &'a SearchLimits,
    ends: Instant,
    nodes: Vec<FoundNode>,
    index: HashMap<NodeId, usize>,
    /// Types that nodes use.
    wanted: Vec<NodeId>,
    /// Number of references.
    references: usize,
    /// Number of bytes of texts and values.
    text: usize,
    space: ServedSpace,
    faults: SearchFaults,
}

struct FoundNode {
    id: NodeId,
    served: ServedNode,
    is_readable: bool,
}

/// The parts of a node that its references have too.
struct Described<'d> {
    class: OwlNodeClass,
    browse_name: &'d UAString,
    label: &'d LocalizedText,
}

impl Search<'_> {
    /// Adds the start nodes. Returns their indexes.
    async fn start(&mut self, start: &[NodeName]) -> Result<Vec<usize>, ClientError> {
        let objects = NodeName {
            namespace: OPC_UA.to_owned(),
            identifier: "i=85".to_owned(),
        };
        let all = if start.is_empty() {
            std::slice::from_ref(&objects)
        } else {
            start
        };
        let mut ids = Vec::new();
        for name in all {
            match self.names.id(name) {
                Some(id) => ids.push((name.clone(), id)),
                None => self.faults.missing.push(name.id()),
            }
        }
        let only: Vec<NodeId> = ids.iter().map(|(_, id)| id.clone()).collect();
        let added = self.add_all(&only, false).await?;
        for ((name, _), at) in ids.iter().zip(&added) {
            match at {
                Some(_) => self.space.start.push(name.clone()),
                None => self.faults.missing.push(name.id()),
            }
        }
        Ok(added.into_iter().flatten().collect())
    }

    /// Adds nodes by their NodeIds. Returns their indexes; `None` for those that do not exist.
    async fn add_all(
        &mut self,
        ids: &[NodeId],
        is_shared: bool,
    ) -> Result<Vec<Option<usize>>, ClientError> {
        let mut added = Vec::with_capacity(ids.len());
        for part in ids.chunks(PART) {
            let what: Vec<_> = part
                .iter()
                .flat_map(|id| NAMING.map(|attribute| (id.clone(), attribute)))
                .collect();
            let values = self.server.attributes(&what).await?;
            for (id, about) in part.iter().zip(values.chunks(NAMING.len())) {
                added.push(self.add_read(id, about, is_shared));
            }
        }
        Ok(added)
    }

    fn add_read(&mut self, id: &NodeId, about: &[DataValue], is_shared: bool) -> Option<usize> {
        if let Some(known) = self.index.get(id) {
            return Some(*known);
        }
        let [class, browse_name, label] = about else {
            return None;
        };
        let Some(Variant::Int32(class)) = class.value else {
            return None;
        };
        let class = NodeClass::from_repr(class).ok().and_then(facts::class)?;
        let Some(Variant::QualifiedName(browse_name)) = &browse_name.value else {
            return None;
        };
        let empty = LocalizedText::null();
        let label = if let Some(Variant::LocalizedText(label)) = &label.value {
            label
        } else {
            &empty
        };
        let name = self.names.name(id)?;
        let described = Described {
            class,
            browse_name: &browse_name.name,
            label,
        };
        self.add(id.clone(), name, &described, is_shared)
    }

    /// Adds a node. `None` if there are too many.
    fn add(
        &mut self,
        id: NodeId,
        name: NodeName,
        described: &Described<'_>,
        is_shared: bool,
    ) -> Option<usize> {
        if self.nodes.len() >= self.limits.nodes {
            let most = self.limits.nodes;
            self.end(format!("it has more than {most} nodes (`nodes`)"));
            return None;
        }
        let browse_name = facts::shortened(described.browse_name);
        let label = facts::text(OntologyTextKind::Label, described.label);
        let length = |text: &OntologyText| text.text.len();
        let bytes = name.identifier.len() + browse_name.len() + label.as_ref().map_or(0, length);
        if !self.has_room(bytes) {
            return None;
        }
        if is_shared {
            self.space.shared.insert(name.clone());
        }
        self.space.share(&name, described.class);
        let at = self.nodes.len();
        self.index.insert(id.clone(), at);
        self.nodes.push(FoundNode {
            id,
            served: ServedNode {
                node: OntologyNode {
                    class: described.class,
                    name,
                    browse_name,
                    texts: label.into_iter().collect(),
                    data_type: None,
                    attributes: Vec::new(),
                    references: Vec::new(),
                    definition: None,
                    value: None,
                },
                source_time: None,
                status: None,
            },
            is_readable: false,
        });
        Some(at)
    }

    /// Takes bytes of the limit of all texts. Returns whether they fit.
    fn has_room(&mut self, bytes: usize) -> bool {
        let text = self.text.saturating_add(bytes);
        if text > MOST_TEXT {
            self.end(format!(
                "its texts and values exceed {} MiB",
                MOST_TEXT >> 20
            ));
            return false;
        }
        self.text = text;
        true
    }

    fn end(&mut self, why: String) {
        if !self.faults.ends.contains(&why) {
            self.faults.ends.push(why);
        }
    }

    fn end_of_references(&mut self) {
        self.end(format!(
            "it has more than {MOST_REFERENCES} references, or continues them without end"
        ));
    }

    /// Returns whether the search ends because of its time.
    fn is_late(&mut self) -> bool {
        let is_late = Instant::now() >= self.ends;
        if is_late {
            let seconds = self.limits.within.as_secs();
            self.end(format!("it answers too slowly for {seconds} s"));
        }
        is_late
    }

    /// Follows the hierarchical references from the first nodes.
    async fn levels(&mut self, mut frontier: Vec<usize>) -> Result<(), ClientError> {
        let hierarchical = self.hierarchical().await?;
        let what = Browse::of(ReferenceTypeId::References);
        let mut depth = 0;
        while !frontier.is_empty() {
            if depth >= self.limits.depth {
                let most = self.limits.depth;
                self.end(format!("it has nodes more than {most} deep (`depth`)"));
                return Ok(());
            }
            depth += 1;
            let mut next = Vec::new();
            for part in frontier.chunks(PART) {
                let left = MOST_REFERENCES.saturating_sub(self.references);
                if left == 0 {
                    self.end_of_references();
                    return Ok(());
                }
                if self.is_late() {
                    return Ok(());
                }
                let ids: Vec<NodeId> = self.ids(part);
                let browsed = self.server.references(&ids, &what, left).await?;
                for (at, browsed) in part.iter().zip(browsed) {
                    self.node(*at, browsed, &hierarchical, &mut next);
                }
            }
            frontier = next;
        }
        Ok(())
    }

    /// Returns the hierarchical ReferenceTypes.
    async fn hierarchical(&mut self) -> Result<HashSet<NodeId>, ClientError> {
        let first: NodeId = ReferenceTypeId::HierarchicalReferences.into();
        let mut all = HashSet::from([first.clone()]);
        let mut level = vec![first];
        let down = Browse {
            subtypes: false,
            ..Browse::of(ReferenceTypeId::HasSubtype)
        };
        while !level.is_empty() && all.len() < MOST_TYPES && !self.is_late() {
            let mut next = Vec::new();
            for part in level.chunks(PART) {
                let browsed = self.server.references(part, &down, MOST_TYPES).await?;
                for found in browsed.into_iter().flat_map(|one| one.references) {
                    if all.insert(found.node_id.node_id.clone()) {
                        next.push(found.node_id.node_id);
                    }
                }
            }
            level = next;
        }
        Ok(all)
    }

    fn ids(&self, part: &[usize]) -> Vec<NodeId> {
        let nodes = part.iter().filter_map(|at| self.nodes.get(*at));
        nodes.map(|node| node.id.clone()).collect()
    }

    /// Takes the references of a node, and adds new nodes to the next level.
    fn node(
        &mut self,
        at: usize,
        browsed: BrowsedReferences,
        hierarchical: &HashSet<NodeId>,
        next: &mut Vec<usize>,
    ) {
        if browsed.status.is_bad() {
            self.faults.bad += 1;
        } else if !browsed.is_whole {
            self.end_of_references();
        }
        let is_shared = self.nodes.get(at).is_some_and(|node| {
            let name = &node.served.node.name;
            self.space.shared.contains(name)
        });
        let mut references = Vec::with_capacity(browsed.references.len());
        for found in browsed.references {
            let of_type = self.names.name(&found.reference_type_id);
            let (Some(of_type), Some((target, id))) = (of_type, self.names.target(&found.node_id))
            else {
                self.faults.names += 1;
                continue;
            };
            if !self.has_room(target.identifier.len()) {
                break;
            }
            let is_followed = hierarchical.contains(&found.reference_type_id);
            let class = facts::class(found.node_class);
            if let Some(class) = class {
                self.space.share(&target, class);
                if class.is_type() && !is_followed {
                    self.wanted.push(id.clone());
                }
            }
            self.wanted.push(found.reference_type_id.clone());
            if let Some(class) = class.filter(|_| is_followed)
                && !self.index.contains_key(&id)
            {
                let described = Described {
                    class,
                    browse_name: &found.browse_name.name,
                    label: &found.display_name,
                };
                // A declaration is below its type; a folder organizes nodes of any kind.
                let organizes = found.reference_type_id == ReferenceTypeId::Organizes;
                let is_declared = is_shared && !organizes;
                let added = self.add(id.clone(), target.clone(), &described, is_declared);
                // The Server object, which each server has, is followed as a start node only.
                next.extend(added.filter(|_| id != ObjectId::Server));
            }
            references.push(OntologyReference {
                of_type,
                is_forward: true,
                target,
            });
        }
        self.references = self.references.saturating_add(references.len());
        if let Some(node) = self.nodes.get_mut(at) {
            node.served.node.references.append(&mut references);
        }
        // Most nodes use the same few types.
        if self.wanted.len() > MOST_REPEATED {
            self.wanted = self.distinct();
        }
    }

    /// Returns the wanted types once each, in their order.
    fn distinct(&mut self) -> Vec<NodeId> {
        let mut seen = HashSet::new();
        let wanted = std::mem::take(&mut self.wanted);
        let mut all: Vec<NodeId> = wanted
            .into_iter()
            .filter(|id| seen.insert(id.clone()))
            .collect();
        if all.len() > MOST_TYPES {
            all.truncate(MOST_TYPES);
            self.end(format!("it uses more than {MOST_TYPES} types"));
        }
        all
    }

    /// Reads the attributes of the nodes from an index on.
    async fn describe(&mut self, from: usize) -> Result<(), ClientError> {
        let all: Vec<usize> = (from..self.nodes.len()).collect();
        for part in all.chunks(PART) {
            if self.is_late() {
                return Ok(());
            }
            let mut what = Vec::new();
            let mut of = Vec::new();
            for at in part {
                let Some(node) = self.nodes.get(*at) else {
                    continue;
                };
                for attribute in facts::attributes(node.served.node.class) {
                    what.push((node.id.clone(), *attribute));
                    of.push((*at, *attribute));
                }
            }
            let values = self.server.attributes(&what).await?;
            for ((at, attribute), value) in of.into_iter().zip(values) {
                if let Some(value) = value.value {
                    self.attribute(at, attribute, &value);
                }
            }
        }
        Ok(())
    }

    fn attribute(&mut self, at: usize, id: AttributeId, value: &Variant) {
        let text = match (id, value) {
            (AttributeId::Description, Variant::LocalizedText(text)) => {
                facts::text(OntologyTextKind::Comment, text)
            }
            (AttributeId::InverseName, Variant::LocalizedText(text)) => {
                facts::text(OntologyTextKind::Inverse, text)
            }
            _ => None,
        };
        let text = text.filter(|text| self.has_room(text.text.len()));
        let data_type = match (id, value) {
            (AttributeId::DataType, Variant::NodeId(id)) => {
                let name = self.names.name(id);
                if name.is_some() {
                    self.wanted.push((**id).clone());
                }
                name
            }
            _ => None,
        };
        let definition = (id == AttributeId::DataTypeDefinition)
            .then(|| self.names.definition(value))
            .flatten();
        let Some(node) = self.nodes.get_mut(at) else {
            return;
        };
        if let (AttributeId::AccessLevel, Variant::Byte(level)) = (id, value) {
            node.is_readable = level & CURRENT_READ != 0;
        }
        let served = &mut node.served.node;
        served.texts.extend(text);
        served.attributes.extend(facts::attribute(id, value));
        if data_type.is_some() {
            served.data_type = data_type;
        }
        if definition.is_some() {
            served.definition = definition;
        }
    }

    /// Adds the types that nodes use, with the types above them. Types of known NodeSets end the
    /// search.
    async fn types(&mut self, is_known: &(dyn Fn(&str) -> bool + Sync)) -> Result<(), ClientError> {
        let mut done: HashSet<NodeId> = HashSet::new();
        let up = Browse {
            subtypes: false,
            ..Browse::of(ReferenceTypeId::HasSubtype).inverse()
        };
        let interfaces = Browse::of(ReferenceTypeId::HasInterface);
        loop {
            let level: Vec<NodeId> = self
                .distinct()
                .into_iter()
                .filter(|id| {
                    let name = self.names.name(id);
                    let is_new = !done.contains(id);
                    is_new && name.is_some_and(|name| !is_known(&name.namespace))
                })
                .collect();
            if level.is_empty() || done.len() > MOST_TYPES || self.is_late() {
                return Ok(());
            }
            done.extend(level.iter().cloned());
            self.add_all(&level, true).await?;
            for part in level.chunks(PART) {
                for (what, is_forward) in [(&up, false), (&interfaces, true)] {
                    let browsed = self.server.references(part, what, MOST_TYPES).await?;
                    for (id, browsed) in part.iter().zip(browsed) {
                        self.above(id, browsed, is_forward);
                    }
                }
            }
        }
    }

    /// Takes the types above a type.
    fn above(&mut self, id: &NodeId, browsed: BrowsedReferences, is_forward: bool) {
        for found in browsed.references.into_iter().take(MOST_ABOVE) {
            let of_type = self.names.name(&found.reference_type_id);
            let target = self.names.target(&found.node_id);
            let (Some(of_type), Some((target, above))) = (of_type, target) else {
                self.faults.names += 1;
                continue;
            };
            self.space.shared.insert(target.clone());
            self.wanted.push(above);
            let at = self.index.get(id).copied();
            let Some(node) = at.and_then(|at| self.nodes.get_mut(at)) else {
                continue;
            };
            let reference = OntologyReference {
                of_type,
                is_forward,
                target,
            };
            let references = &mut node.served.node.references;
            if !references.contains(&reference) {
                references.push(reference);
            }
        }
    }

    /// Reads the values of the variables.
    async fn values(&mut self) -> Result<(), ClientError> {
        let readable = self.nodes.iter().enumerate();
        let readable = readable.filter(|(_, node)| {
            node.is_readable && node.served.node.class == OwlNodeClass::Variable
        });
        let all: Vec<usize> = readable.map(|(at, _)| at).collect();
        for part in all.chunks(VALUES) {
            if self.is_late() {
                return Ok(());
            }
            let what: Vec<_> = self
                .ids(part)
                .into_iter()
                .map(|id| (id, AttributeId::Value))
                .collect();
            let values = self.server.attributes(&what).await?;
            for (at, value) in part.iter().zip(values) {
                self.value(*at, &value);
            }
        }
        Ok(())
    }

    fn value(&mut self, at: usize, value: &DataValue) {
        let status = value.status.unwrap_or(StatusCode::Good);
        let converted = value.value.as_ref().filter(|_| !status.is_bad());
        let converted = match converted.map(|value| self.names.value(value)) {
            Some(Ok(converted)) => converted,
            Some(Err(UnreadValue::TooLarge)) => {
                self.faults.large += 1;
                None
            }
            Some(Err(UnreadValue::Undecoded)) => {
                self.faults.undecoded += 1;
                None
            }
            None => None,
        };
        let converted = converted.filter(|value| self.has_room(facts::length(value)));
        if let Some(node) = self.nodes.get_mut(at) {
            node.served.source_time = facts::source_time(value).filter(|_| converted.is_some());
            node.served.node.value = converted;
            node.served.status = (!status.is_good()).then(|| status.to_string());
        }
    }

    fn finish(self) -> Searched {
        let mut space = self.space;
        space.is_complete = self.faults.ends.is_empty();
        space.nodes = self.nodes.into_iter().map(|node| node.served).collect();
        Searched {
            space,
            findings: self.faults.findings(),
        }
    }
}

/// The attributes that name a node.
const NAMING: [AttributeId; 3] = [
    AttributeId::NodeClass,
    AttributeId::BrowseName,
    AttributeId::DisplayName,
];
/// The bit of AccessLevel for reading.
const CURRENT_READ: u8 = 1;
/// Number of nodes in a step of the search.
const PART: usize = 100;
/// Number of values in a step of the search.
const VALUES: usize = 50;
const MOST_REFERENCES: usize = 500_000;
const MOST_TYPES: usize = 5000;
/// Number of types after which repetitions are removed.
const MOST_REPEATED: usize = 50_000;
/// Maximum number of types directly above a type.
const MOST_ABOVE: usize = 64;
/// Maximum number of bytes of texts and values.
const MOST_TEXT: usize = 64 << 20;

#[cfg(test)]
mod tests;
