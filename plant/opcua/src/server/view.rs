//! A view of the nodes of both node managers: types of the core namespace and of NodeSets, and the
//! declarations that instances copy.

use std::collections::{BTreeMap, HashMap, HashSet};

use opcua::nodes::{DefaultTypeTree, HasNodeId as _, NodeType};
use opcua::server::address_space::AddressSpace;
use opcua::types::{
    BrowseDirection, Identifier, NodeClass, NodeId, QualifiedName, ReferenceTypeId, VariableTypeId,
};

/// The core namespace and the server's own namespaces.
#[derive(Clone, Copy)]
pub(crate) struct ServerView<'a> {
    pub(crate) core: &'a AddressSpace,
    pub(crate) own: &'a AddressSpace,
    /// An empty type tree: no query of this module includes subtypes of references.
    pub(crate) no_types: &'a DefaultTypeTree,
}

/// A child of a type by its BrowseName, with its declarations. The declaration of the most derived
/// type is first.
#[derive(Debug, Clone)]
pub(crate) struct Declared {
    pub(crate) name: QualifiedName,
    pub(crate) reference: NodeId,
    pub(crate) nodes: Vec<NodeId>,
}

/// A child of a node.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ChildNode {
    /// The node.
    pub node_id: NodeId,
    /// Its BrowseName.
    pub browse_name: QualifiedName,
    /// The reference type from the parent.
    pub reference_type: NodeId,
    /// Its NodeClass.
    pub node_class: NodeClass,
}

impl<'a> ServerView<'a> {
    pub(crate) fn node(self, id: &NodeId) -> Option<&'a NodeType> {
        if id.namespace == 0 {
            self.core.find(id)
        } else {
            self.own.find(id)
        }
    }

    /// Returns the references of a node in both address spaces, in a stable order by type and
    /// target.
    fn references(
        self,
        id: &NodeId,
        forward: bool,
        kinds: &[ReferenceTypeId],
    ) -> Vec<(&'a NodeId, &'a NodeId)> {
        let direction = if forward {
            BrowseDirection::Forward
        } else {
            BrowseDirection::Inverse
        };
        let mut found: Vec<(&NodeId, &NodeId)> = Vec::new();
        for space in [self.core, self.own] {
            let all = space.find_references(id, None::<(NodeId, bool)>, self.no_types, direction);
            // Some nodes of the core namespace have thousands of references.
            let wanted = all.filter(|one| kinds.iter().any(|kind| *one.reference_type == *kind));
            found.extend(wanted.map(|one| (one.reference_type, one.target_node)));
        }
        found.sort_by_cached_key(|(kind, target)| (order(kind), order(target)));
        found.dedup();
        found
    }

    /// Returns the targets of the references of a type.
    pub(crate) fn targets(
        self,
        id: &NodeId,
        reference: ReferenceTypeId,
        forward: bool,
    ) -> Vec<&'a NodeId> {
        let references = self.references(id, forward, &[reference]);
        references.into_iter().map(|(_, target)| target).collect()
    }

    /// Returns the supertypes, nearest first.
    pub(crate) fn supertypes(self, type_id: &NodeId) -> Vec<&'a NodeId> {
        let mut found: Vec<&NodeId> = Vec::new();
        let mut at = type_id;
        while let Some(next) = self
            .targets(at, ReferenceTypeId::HasSubtype, false)
            .into_iter()
            .next()
        {
            // The type hierarchy of a faulty NodeSet may be cyclic.
            if next == type_id || found.contains(&next) {
                break;
            }
            found.push(next);
            at = next;
        }
        found
    }

    /// Returns the subtypes of all levels, without the type itself.
    pub(crate) fn subtypes(self, type_id: &NodeId) -> Vec<&'a NodeId> {
        let mut found: Vec<&NodeId> = Vec::new();
        let mut seen: HashSet<&NodeId> = HashSet::new();
        let mut next = self.targets(type_id, ReferenceTypeId::HasSubtype, true);
        while let Some(at) = next.pop() {
            if at != type_id && seen.insert(at) {
                found.push(at);
                next.extend(self.targets(at, ReferenceTypeId::HasSubtype, true));
            }
        }
        found
    }

    pub(crate) fn is_subtype_of(self, type_id: &NodeId, base: &NodeId) -> bool {
        type_id == base || self.supertypes(type_id).contains(&base)
    }

    /// Returns the type definition of an object or variable if its instances can have children:
    /// properties have none.
    pub(crate) fn parental_type(self, id: &NodeId) -> Option<&'a NodeId> {
        self.type_definition(id)
            .filter(|found| **found != VariableTypeId::PropertyType)
    }

    pub(crate) fn type_definition(self, id: &NodeId) -> Option<&'a NodeId> {
        self.targets(id, ReferenceTypeId::HasTypeDefinition, true)
            .into_iter()
            .next()
    }

    /// Returns the modelling rule of the first declaration that has a modelling rule.
    pub(crate) fn modelling_rule(self, declared: &Declared) -> Option<&'a NodeId> {
        declared.nodes.iter().find_map(|node| {
            self.targets(node, ReferenceTypeId::HasModellingRule, true)
                .into_iter()
                .next()
        })
    }

    /// Returns the children of a node: components, properties, organized nodes and event sources.
    pub(crate) fn children(self, id: &NodeId) -> Vec<ChildNode> {
        self.below(id, &HIERARCHICAL)
    }

    fn below(self, id: &NodeId, kinds: &[ReferenceTypeId]) -> Vec<ChildNode> {
        let references = self.references(id, true, kinds);
        references
            .into_iter()
            .filter_map(|(kind, target)| {
                let node = self.node(target)?;
                Some(ChildNode {
                    node_id: target.clone(),
                    browse_name: node.as_node().browse_name().clone(),
                    reference_type: kind.clone(),
                    node_class: node.node_class(),
                })
            })
            .collect()
    }

    /// Returns the children of an instance by its declarations and its type. Declarations precede
    /// the type, and a type precedes its supertypes and its interfaces.
    pub(crate) fn declared(
        self,
        declarations: &[NodeId],
        type_id: Option<&NodeId>,
        interfaces: &[NodeId],
    ) -> Vec<Declared> {
        let mut sources: Vec<NodeId> = declarations.to_vec();
        let chain: Vec<NodeId> = type_id
            .into_iter()
            .chain(type_id.into_iter().flat_map(|id| self.supertypes(id)))
            .cloned()
            .collect();
        sources.extend(chain.iter().cloned());
        let implemented = chain
            .iter()
            .flat_map(|id| self.targets(id, ReferenceTypeId::HasInterface, true));
        for interface in interfaces.iter().chain(implemented) {
            sources.push(interface.clone());
            sources.extend(self.supertypes(interface).into_iter().cloned());
        }
        let mut found: BTreeMap<(String, u16), Declared> = BTreeMap::new();
        for source in &sources {
            for child in self.below(source, &AGGREGATES) {
                let key = (
                    child.browse_name.name.as_ref().to_owned(),
                    child.browse_name.namespace_index,
                );
                let entry = found.entry(key).or_insert_with(|| Declared {
                    name: child.browse_name,
                    reference: child.reference_type,
                    nodes: Vec::new(),
                });
                if !entry.nodes.contains(&child.node_id) {
                    entry.nodes.push(child.node_id);
                }
            }
        }
        found.into_values().collect()
    }

    /// Returns a type by its BrowseName in its own namespace.
    pub(crate) fn find_type(self, namespace: u16, name: &str) -> Option<NodeId> {
        let roots = [
            ReferenceTypeId::References as u32,
            BASE_OBJECT_TYPE,
            BASE_VARIABLE_TYPE,
            BASE_DATA_TYPE,
        ];
        roots.into_iter().find_map(|root| {
            let root = NodeId::new(0, root);
            let all = std::iter::once(&root).chain(self.subtypes(&root));
            let mut named = all.filter(|id| {
                id.namespace == namespace
                    && self.node(id).is_some_and(|node| {
                        let browse_name = node.as_node().browse_name();
                        browse_name.namespace_index == namespace
                            && browse_name.name.as_ref() == name
                    })
            });
            named.next().cloned()
        })
    }

    /// Returns the fields of an event type by their paths, including inherited and optional fields.
    /// `known` caches the children of the types of fields.
    pub(crate) fn event_fields(
        self,
        event_type: &NodeId,
        known: &mut HashMap<NodeId, Vec<Declared>>,
    ) -> Vec<(Vec<QualifiedName>, NodeId)> {
        let mut found = Vec::new();
        for field in self.declared(&[], Some(event_type), &[]) {
            let Some(first) = field.nodes.first() else {
                continue;
            };
            found.push((vec![field.name.clone()], first.clone()));
            let Some(type_id) = self.parental_type(first) else {
                continue;
            };
            let below = known
                .entry(type_id.clone())
                .or_insert_with(|| self.declared(&[], Some(type_id), &[]));
            let declared = self.declared(&field.nodes, None, &[]);
            for below in below.iter().chain(&declared) {
                if let Some(node) = below.nodes.first() {
                    found.push((vec![field.name.clone(), below.name.clone()], node.clone()));
                }
            }
        }
        found
    }

    pub(crate) fn class(self, id: &NodeId) -> Option<NodeClass> {
        self.node(id).map(NodeType::node_class)
    }

    pub(crate) fn exists(self, id: &NodeId) -> bool {
        self.node(id).is_some_and(|node| node.node_id() == id)
    }
}

/// Returns a sort key of a NodeId.
fn order(id: &NodeId) -> (u16, u32, String) {
    match &id.identifier {
        Identifier::Numeric(number) => (id.namespace, *number, String::new()),
        Identifier::String(_) | Identifier::Guid(_) | Identifier::ByteString(_) => {
            (id.namespace, u32::MAX, id.to_string())
        }
    }
}

/// The reference types to the children that instances copy.
const AGGREGATES: [ReferenceTypeId; 4] = [
    ReferenceTypeId::HasComponent,
    ReferenceTypeId::HasProperty,
    ReferenceTypeId::HasOrderedComponent,
    ReferenceTypeId::HasAddIn,
];
const HIERARCHICAL: [ReferenceTypeId; 7] = [
    ReferenceTypeId::HasComponent,
    ReferenceTypeId::HasProperty,
    ReferenceTypeId::HasOrderedComponent,
    ReferenceTypeId::HasAddIn,
    ReferenceTypeId::Organizes,
    ReferenceTypeId::HasEventSource,
    ReferenceTypeId::HasNotifier,
];
const BASE_OBJECT_TYPE: u32 = 58;
const BASE_VARIABLE_TYPE: u32 = 62;
const BASE_DATA_TYPE: u32 = 24;
