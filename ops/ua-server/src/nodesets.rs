//! The NodeSet2 files of a mapping in the address space. Their nodes are added as the files define
//! them. Variables and Methods that the mapping uses are updated and callable; they are called live
//! here.

use std::collections::{HashMap, HashSet};
use std::path::PathBuf;

use bridge_node::{Failure, FailureKind};
use mappings::Mapping;
use opcua::nodes::{DefaultTypeTree, NodeType, TypeTree};
use opcua::server::address_space::{AccessLevel, AddressSpace};
use opcua::sync::Mutex;
use opcua::types::{
    BrowseDirection, DataValue, NamespaceMap, NodeId, ObjectId, QualifiedName, ReferenceTypeId,
    StatusCode, Variant,
};
use plant_opcua::nodeset::ImportedNodeSets;
use tracing::{info, warn};

use crate::layout::{TopicNode, component};
use crate::properties::{self, Property};

/// Reads the files of a mapping for a server that starts.
///
/// # Errors
/// Returns the first fatal error of the files. The check of the mapping has reported all errors,
/// unless a file changed in the meantime.
pub(crate) fn read(mapping: &Mapping) -> Result<ImportedNodeSets, Failure> {
    let (sets, faults) = ImportedNodeSets::read(&mapping.server().nodesets);
    let mut faults = faults.into_iter();
    match faults.find(|fault| fault.error.is_fatal()) {
        Some(fault) => Err(Failure::new(
            FailureKind::Configuration,
            format!("server.nodesets: {}", fault.error),
        )),
        None => Ok(sets),
    }
}

/// Appends the namespaces of NodeSets that the server does not have yet.
pub(crate) fn add_namespaces(sets: &ImportedNodeSets, namespaces: &mut Vec<String>) {
    for uri in sets.provides() {
        if !namespaces.iter().any(|known| known == uri) {
            namespaces.push(uri.to_owned());
        }
    }
}

/// The NodeSet files of a running server. Other files take effect at the next start.
pub(crate) struct RunningNodeSets {
    files: Vec<PathBuf>,
    fingerprint: u64,
}

impl RunningNodeSets {
    pub(crate) fn new(mapping: &Mapping, sets: &ImportedNodeSets) -> Self {
        Self {
            files: mapping.server().nodesets.clone(),
            fingerprint: sets.fingerprint(),
        }
    }

    /// Returns the part of another mapping that takes effect at the next start only, as text for
    /// the operator.
    pub(crate) fn differs(&self, mapping: &Mapping) -> Option<String> {
        let files = &mapping.server().nodesets;
        if *files != self.files {
            return Some("server.nodesets".to_owned());
        }
        let differs =
            !files.is_empty() && plant_opcua::nodeset::fingerprint(files) != self.fingerprint;
        differs.then(|| "server.nodesets (a file of them is another one)".to_owned())
    }
}

/// The nodes of NodeSets, and the live nodes among them.
#[derive(Default)]
pub(crate) struct Loaded {
    nodes: HashSet<NodeId>,
    live: Mutex<HashMap<NodeId, Before>>,
    /// The namespaces that the files describe by NamespaceMetadata.
    told: HashSet<String>,
    fault: Option<String>,
    types: DefaultTypeTree,
}

/// The state of a node before it became live.
struct Before {
    folder: NodeId,
    level: AccessLevel,
    user_level: AccessLevel,
    historizing: bool,
    properties: Vec<(NodeId, DataValue)>,
}

impl Loaded {
    /// Adds the nodes of NodeSets. Nodes that are not live are neither writable nor callable.
    pub(crate) fn put_in(
        sets: &ImportedNodeSets,
        address_space: &mut AddressSpace,
        namespaces: &mut NamespaceMap,
    ) -> Self {
        let mut loaded = Self::default();
        if sets.is_empty() {
            return loaded;
        }
        let mut unread = Vec::new();
        match sets.import(address_space, namespaces) {
            Ok(imported) => {
                loaded.nodes.extend(imported.nodes);
                unread = imported.unread;
            }
            Err(error) => loaded.fault = Some(error.to_string()),
        }
        let namespaces: NodeId = ObjectId::Server_Namespaces.into();
        for node in &loaded.nodes {
            if address_space.has_reference(&namespaces, node, ReferenceTypeId::HasComponent)
                && let Some(found) = address_space.find(node)
            {
                let name = found.as_node().browse_name();
                loaded.told.insert(name.name.as_ref().to_owned());
            }
            let in_type = loaded.target(address_space, node, ReferenceTypeId::HasModellingRule);
            let in_type = in_type.is_some();
            let read = AccessLevel::CURRENT_READ;
            match address_space.find_mut(node) {
                Some(NodeType::Variable(variable)) => {
                    let value = plant_opcua::server::value_of(variable).value;
                    variable.set_data_value(value.map_or_else(DataValue::null, of_now));
                    variable.set_user_access_level(variable.user_access_level() & read);
                    if !in_type {
                        variable.set_access_level(variable.access_level() & read);
                        variable.set_historizing(false);
                    }
                }
                Some(NodeType::Method(method)) if !in_type => {
                    method.set_executable(false);
                    method.set_user_executable(false);
                }
                Some(_) | None => {}
            }
        }
        for node in &unread {
            if let Some(NodeType::Variable(variable)) = address_space.find_mut(node) {
                variable.set_data_value(DataValue::new_now_status(
                    Variant::Empty,
                    StatusCode::BadDecodingError,
                ));
            }
        }
        info!(nodes = loaded.nodes.len(), "loaded {sets:?} from NodeSets");
        loaded
    }

    /// Returns the error because of which nodes are missing.
    pub(crate) fn fault(&self) -> Option<&str> {
        self.fault.as_deref()
    }

    /// Returns true if a NodeSet has the metadata of a namespace.
    pub(crate) fn tell_of(&self, uri: &str) -> bool {
        self.told.contains(uri)
    }

    /// Returns true if a node belongs to a NodeSet.
    pub(crate) fn has(&self, node: &NodeId) -> bool {
        self.nodes.contains(node)
    }

    /// Makes the Variable of a NodeSet live that is the node of a topic, and adds it to `folder`.
    /// Returns `false` if the node belongs to no NodeSet.
    pub(crate) fn adopt(
        &self,
        address_space: &mut AddressSpace,
        topic: &TopicNode,
        folder: &NodeId,
    ) -> bool {
        if !self.has(&topic.node) {
            return false;
        }
        let Some(NodeType::Variable(variable)) = address_space.find_mut(&topic.node) else {
            warn!(node = %topic.node, topic = %topic.topic, "cannot show the value: the node is not a Variable in its NodeSet");
            return true;
        };
        let mut before = Before {
            folder: folder.clone(),
            level: variable.access_level(),
            user_level: variable.user_access_level(),
            historizing: variable.historizing(),
            properties: Vec::new(),
        };
        let level = crate::address::access(topic);
        variable.set_access_level(level);
        variable.set_user_access_level(level);
        variable.set_historizing(level.contains(AccessLevel::HISTORY_READ));
        address_space.insert_reference(folder, &topic.node, ReferenceTypeId::Organizes);
        if !topic.compound {
            properties::each(topic, &mut |property| {
                self.property(address_space, &topic.node, property, &mut before);
            });
        }
        self.live.lock().insert(topic.node.clone(), before);
        true
    }

    /// Sets a Property of a Variable: the Property of the NodeSet, or else a new Property.
    fn property(
        &self,
        address_space: &mut AddressSpace,
        node: &NodeId,
        property: Property,
        before: &mut Before,
    ) {
        let name = QualifiedName::new(0, property.name);
        let filter = Some((ReferenceTypeId::HasProperty, false));
        let types: &dyn TypeTree = &self.types;
        let direction = BrowseDirection::Forward;
        let found = address_space.find_node_by_browse_name(node, filter, types, direction, name);
        let own = found.map(|found| found.as_node().node_id().clone());
        let Some(own) = own else {
            if !address_space.node_exists(&component(node, property.name)) {
                property.insert(address_space, node);
            }
            return;
        };
        if let Some(NodeType::Variable(variable)) = address_space.find_mut(&own) {
            let was = plant_opcua::server::value_of(variable);
            variable.set_data_value(of_now(property.value));
            before.properties.push((own, was));
        }
    }

    /// Restores the state of a Variable from its NodeSet, and returns its value from then on.
    /// Returns `None` if the Variable was not live.
    pub(crate) fn release(
        &self,
        address_space: &mut AddressSpace,
        node: &NodeId,
    ) -> Option<DataValue> {
        let before = self.live.lock().remove(node)?;
        address_space.delete_reference(&before.folder, node, ReferenceTypeId::Organizes);
        for (property, value) in before.properties {
            if let Some(NodeType::Variable(variable)) = address_space.find_mut(&property) {
                variable.set_data_value(value);
            }
        }
        let Some(NodeType::Variable(variable)) = address_space.find_mut(node) else {
            return None;
        };
        variable.set_access_level(before.level);
        variable.set_user_access_level(before.user_level);
        variable.set_historizing(before.historizing);
        let value = plant_opcua::server::value_of(variable).value;
        Some(of_now(value.unwrap_or_default()))
    }

    /// Returns true if a Method of a NodeSet has these numbers of arguments. Returns `None` if the
    /// node belongs to no NodeSet.
    pub(crate) fn suits(
        &self,
        address_space: &AddressSpace,
        method: &NodeId,
        (inputs, outputs): (usize, usize),
    ) -> Option<bool> {
        if !self.has(method) {
            return None;
        }
        let count = |name: &str| {
            let name = QualifiedName::new(0, name);
            let filter = Some((ReferenceTypeId::HasProperty, false));
            let types: &dyn TypeTree = &self.types;
            let direction = BrowseDirection::Forward;
            let found =
                address_space.find_node_by_browse_name(method, filter, types, direction, name);
            let Some(NodeType::Variable(variable)) = found else {
                return 0;
            };
            match plant_opcua::server::value_of(variable).value {
                Some(Variant::Array(array)) => array.values.len(),
                Some(_) | None => 0,
            }
        };
        let is_method = matches!(address_space.find(method), Some(NodeType::Method(_)));
        Some(is_method && count("InputArguments") == inputs && count("OutputArguments") == outputs)
    }

    /// Allows or forbids clients to call a Method of a NodeSet. Returns `false` if the node belongs
    /// to no NodeSet.
    pub(crate) fn let_call(
        &self,
        address_space: &mut AddressSpace,
        method: &NodeId,
        may: bool,
    ) -> bool {
        if !self.has(method) {
            return false;
        }
        if let Some(NodeType::Method(method)) = address_space.find_mut(method) {
            method.set_executable(may);
            method.set_user_executable(may);
        }
        true
    }

    fn target(
        &self,
        address_space: &AddressSpace,
        node: &NodeId,
        reference: ReferenceTypeId,
    ) -> Option<NodeId> {
        let filter = Some((reference, false));
        let types: &dyn TypeTree = &self.types;
        let direction = BrowseDirection::Forward;
        let mut found = address_space.find_references(node, filter, types, direction);
        found.next().map(|found| found.target_node.clone())
    }
}

/// Returns a DataValue without the picoseconds that the library adds. They are meaningless, and
/// asyncua misreads the timestamps with them.
fn of_now(value: Variant) -> DataValue {
    DataValue {
        source_picoseconds: None,
        server_picoseconds: None,
        ..DataValue::new_now(value)
    }
}
