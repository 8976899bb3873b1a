//! The nodes of a server as a face shows them on the other level. A change of the server replaces
//! only the nodes that differ, so that clients keep their subscriptions to all others.

use std::collections::{BTreeMap, HashMap};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, RwLock};

use plant_opcua::server::{InstanceError, MethodSpec, ObjectSpec, TypeSpec, VariableSpec};
use plant_opcua::supervision::SET_FIELDS;
use plant_opcua::types::{
    Array, DataValue, DateTime, ExpandedNodeId, LocalizedText, NodeId, ObjectTypeId, QualifiedName,
    StatusCode, Variant,
};
use tracing::debug;

use crate::callers::Callers;
use crate::face::{Calling, Face, ForwardedWrites, Passing, id};
use crate::mirror::{MirroredKind, MirroredNode, MirroredServer, Name, TypeRef, variable_type};

/// The nodes of a server on a face.
pub(crate) struct ServerCopy {
    face: Face,
    /// The name of the server below the folder of the face.
    name: String,
    application_uri: String,
    callers: Arc<Callers>,
    /// The nodes by their paths, each with its children behind it.
    nodes: BTreeMap<String, MirroredNode>,
    translation: Arc<Translation>,
    /// The source timestamps of the values that were marked as last values, by their variables.
    doubted: Mutex<HashMap<NodeId, Option<DateTime>>>,
}

/// A variable of a server, and its copy.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct CopiedVariable {
    pub(crate) at_server: NodeId,
    pub(crate) shown: NodeId,
}

/// Translates identifiers of a server to identifiers of the face.
#[derive(Debug, Default)]
pub(crate) struct Translation(RwLock<Identifiers>);

#[derive(Debug, Default)]
struct Identifiers {
    nodes: HashMap<NodeId, NodeId>,
    types: HashMap<NodeId, NodeId>,
    /// The index on the face of each namespace of the server.
    namespaces: Vec<Option<u16>>,
}

impl ServerCopy {
    pub(crate) fn new(
        face: &Face,
        (name, application_uri): (&str, &str),
        callers: &Arc<Callers>,
    ) -> Self {
        Self {
            face: face.clone(),
            name: name.to_owned(),
            application_uri: application_uri.to_owned(),
            callers: Arc::clone(callers),
            nodes: BTreeMap::new(),
            translation: Arc::default(),
            doubted: Mutex::default(),
        }
    }

    /// Returns the translation, which follows further changes of the server.
    pub(crate) fn translation(&self) -> Arc<Translation> {
        Arc::clone(&self.translation)
    }

    pub(crate) fn face(&self) -> &Face {
        &self.face
    }

    /// Returns the node of the server itself.
    pub(crate) fn root(&self) -> NodeId {
        id(&self.path())
    }

    fn path(&self) -> String {
        format!("{}/{}", self.face.folder(), self.name)
    }

    /// Shows the nodes of the server. Returns the variables that were added, and whether anything
    /// has changed.
    ///
    /// # Errors
    /// The folder does not exist.
    pub(crate) fn show(
        &mut self,
        mirror: &MirroredServer,
    ) -> Result<(Vec<CopiedVariable>, bool), InstanceError> {
        let root = self.path();
        let is_new = self.face.server.browse_name(&id(&root)).is_none();
        if is_new {
            self.nodes.clear();
            self.face
                .object(&root, &id(self.face.folder()), &self.name)?;
            self.face
                .property(&root, "ApplicationUri", &self.application_uri)?;
        }
        let types = self.types(mirror);
        self.translation.names(self, mirror, types.clone());
        let mut wanted = BTreeMap::new();
        let mut nodes = HashMap::new();
        for found in &mirror.nodes {
            let path = self.path_of(found);
            nodes.insert(found.id.clone(), id(&path));
            // A name may contain the sign between names: the first node of a path is shown.
            wanted.entry(path).or_insert_with(|| found.clone());
        }
        self.translation.nodes(nodes);
        let mut changed = is_new || self.remove_outdated(&wanted);
        let mut added = Vec::new();
        for found in &mirror.nodes {
            let path = self.path_of(found);
            if self.nodes.contains_key(&path) {
                continue;
            }
            match self.add(&path, found, &types) {
                Ok(variable) => added.extend(variable),
                // A part of a node that could not be shown.
                Err(InstanceError::NoParent(_) | InstanceError::Taken(_)) => {
                    debug!(path, "cannot show a node");
                    continue;
                }
                Err(error) => return Err(error),
            }
            changed = true;
            self.nodes.insert(path, found.clone());
        }
        Ok((added, changed))
    }

    fn path_of(&self, found: &MirroredNode) -> String {
        let path = found.path.join("/");
        let end = match found.kind {
            MirroredKind::Method { .. } => "()",
            MirroredKind::Object { .. } | MirroredKind::Variable { .. } => "",
        };
        format!("{}/{path}{end}", self.path())
    }

    /// Removes the nodes that the server has no more or that differ. Returns whether there are any.
    fn remove_outdated(&mut self, wanted: &BTreeMap<String, MirroredNode>) -> bool {
        let outdated: Vec<String> = self
            .nodes
            .iter()
            .filter(|(path, known)| wanted.get(*path) != Some(known))
            .map(|(path, _)| path.clone())
            .collect();
        for path in &outdated {
            // A node is removed with its children.
            if self.nodes.remove(path).is_some() {
                self.face.server.remove(&id(path));
                let below = format!("{path}/");
                self.nodes.retain(|known, _| !known.starts_with(&below));
            }
        }
        !outdated.is_empty()
    }

    /// Adds the types of the server to the face. Returns their NodeIds by the NodeIds at the
    /// server.
    fn types(&self, mirror: &MirroredServer) -> HashMap<NodeId, NodeId> {
        let mut known = HashMap::new();
        for (at_server, of) in &mirror.types {
            let node_id = id(&of.key.on_face());
            let added = self.browse_name(&of.key.name).map(|browse_name| {
                self.face.server.add_type(&TypeSpec {
                    node_id: node_id.clone(),
                    browse_name,
                    supertype: type_node(&of.supertype),
                })
            });
            match added {
                Some(Ok(()) | Err(InstanceError::Taken(_))) => {
                    known.insert(at_server.clone(), node_id);
                }
                Some(Err(error)) => debug!(%error, "cannot show a type"),
                None => debug!(name = of.key.name.name, "there are too many namespaces"),
            }
        }
        known
    }

    /// Returns a BrowseName with the index of its namespace on the face.
    fn browse_name(&self, name: &Name) -> Option<QualifiedName> {
        let index = match &name.uri {
            Some(uri) => self.face.server.add_namespace(uri)?,
            None => 0,
        };
        Some(QualifiedName::new(index, name.name.as_str()))
    }

    fn add(
        &self,
        path: &str,
        found: &MirroredNode,
        types: &HashMap<NodeId, NodeId>,
    ) -> Result<Option<CopiedVariable>, InstanceError> {
        let parent = match found.path.split_last() {
            Some((_, above)) if !above.is_empty() => format!("{}/{}", self.path(), above.join("/")),
            _ => self.path(),
        };
        let browse_name = self.browse_name(&found.name);
        let browse_name =
            browse_name.unwrap_or_else(|| QualifiedName::new(0, found.name.name.as_str()));
        let display_name = LocalizedText::new("", &found.name.name);
        match &found.kind {
            MirroredKind::Object { of, events } => {
                let of = type_node(of);
                // A type that could not be added.
                let is_known = of.namespace == 0 || types.values().any(|known| *known == of);
                self.face.server.add_object(&ObjectSpec {
                    node_id: id(path),
                    browse_name,
                    display_name,
                    type_definition: if is_known {
                        of
                    } else {
                        ObjectTypeId::BaseObjectType.into()
                    },
                    parent: id(&parent),
                    reference: found.reference.into(),
                    event_notifier: *events,
                })?;
                Ok(None)
            }
            MirroredKind::Variable {
                data_type,
                value_rank,
                writable,
            } => {
                let variable = VariableSpec {
                    node_id: id(path),
                    browse_name,
                    display_name,
                    type_definition: variable_type(found.reference).into(),
                    parent: id(&parent),
                    reference: found.reference.into(),
                    data_type: data_type.clone(),
                    value_rank: *value_rank,
                    value: without_value(StatusCode::BadWaitingForInitialData),
                    writable: *writable,
                };
                self.add_variable(&variable, &found.id).map(Some)
            }
            MirroredKind::Method {
                object,
                takes,
                gives,
            } => {
                let spec = MethodSpec {
                    node_id: id(path),
                    browse_name,
                    object: id(&parent),
                    arguments: (id(&format!("{path}.in")), id(&format!("{path}.out"))),
                    takes: takes.clone(),
                    gives: gives.clone(),
                };
                let handler = Calling {
                    passing: self.passing(),
                    object: object.clone(),
                    method: found.id.clone(),
                    configures: found.name.name == SET_FIELDS,
                };
                self.face.server.add_method(spec, Arc::new(handler))?;
                Ok(None)
            }
        }
    }

    fn add_variable(
        &self,
        variable: &VariableSpec,
        at_server: &NodeId,
    ) -> Result<CopiedVariable, InstanceError> {
        self.face.server.add_variable(variable)?;
        if variable.writable {
            let handler = ForwardedWrites {
                passing: self.passing(),
                node: at_server.clone(),
            };
            self.face
                .server
                .on_write(&variable.node_id, Arc::new(handler));
        }
        Ok(CopiedVariable {
            at_server: at_server.clone(),
            shown: variable.node_id.clone(),
        })
    }

    fn passing(&self) -> Passing {
        Passing {
            admission: self.face.admission().clone(),
            callers: Arc::clone(&self.callers),
        }
    }

    /// Returns all variables.
    pub(crate) fn variables(&self) -> Vec<CopiedVariable> {
        let nodes = self.nodes.iter();
        let variables =
            nodes.filter(|(_, found)| matches!(found.kind, MirroredKind::Variable { .. }));
        let copied = variables.map(|(path, found)| CopiedVariable {
            at_server: found.id.clone(),
            shown: id(path),
        });
        copied.collect()
    }

    /// Marks the values of all variables after the loss of the server: they have no value.
    pub(crate) fn lose(&self, status: StatusCode) {
        self.doubted().clear();
        let values = self.variables().into_iter();
        let values = values.map(|of| (of.shown, without_value(status)));
        self.set(values.collect());
    }

    /// Marks the values of a server that does not respond as its last values.
    pub(crate) fn doubt(&self) {
        let mut doubted = self.doubted();
        let mut values = Vec::new();
        for of in self.variables() {
            let Some(mut value) = self.face.server.value(&of.shown) else {
                continue;
            };
            if value.status() == StatusCode::Good {
                value.status = Some(StatusCode::UncertainLastUsableValue);
                doubted.insert(of.shown.clone(), value.source_timestamp);
                values.push((of.shown, value));
            }
        }
        self.set(values);
    }

    /// Marks the values that were marked as last values as current values: the server responds
    /// again. A value that the server itself doubts stays as it is.
    pub(crate) fn trust_again(&self) {
        let mut doubted = self.doubted();
        let values = doubted.drain().filter_map(|(node, timestamp)| {
            let mut value = self.face.server.value(&node)?;
            let is_marked = value.status() == StatusCode::UncertainLastUsableValue
                && value.source_timestamp == timestamp;
            value.status = Some(StatusCode::Good);
            is_marked.then_some((node, value))
        });
        self.set(values.collect());
    }

    fn doubted(&self) -> MutexGuard<'_, HashMap<NodeId, Option<DateTime>>> {
        self.doubted.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn set(&self, values: Vec<(NodeId, DataValue)>) {
        if let Err(status) = self.face.server.show_all(values) {
            debug!(name = self.name, %status, "cannot mark the values of a server");
        }
    }
}

pub(crate) fn without_value(status: StatusCode) -> DataValue {
    DataValue {
        value: Some(Variant::Empty),
        status: Some(status),
        source_timestamp: Some(DateTime::now()),
        ..DataValue::default()
    }
}

fn type_node(of: &TypeRef) -> NodeId {
    match of {
        TypeRef::Core(of) => of.clone(),
        // Servers share the types of one identity.
        TypeRef::Named(key) => id(&key.on_face()),
    }
}

impl Translation {
    fn names(&self, copy: &ServerCopy, mirror: &MirroredServer, types: HashMap<NodeId, NodeId>) {
        let namespaces = mirror.namespaces.iter().enumerate();
        let namespaces = namespaces.map(|(at, uri)| match at {
            0 => Some(0),
            _ => copy.face.server.add_namespace(uri),
        });
        let namespaces = namespaces.collect();
        let mut all = self.0.write().unwrap_or_else(PoisonError::into_inner);
        all.namespaces = namespaces;
        all.types = types;
    }

    fn nodes(&self, nodes: HashMap<NodeId, NodeId>) {
        let mut all = self.0.write().unwrap_or_else(PoisonError::into_inner);
        all.nodes = nodes;
    }

    /// Returns the node or type of the face that stands for one of the server. Nodes of the core
    /// namespace are the same everywhere.
    pub(crate) fn node(&self, at_server: &NodeId) -> Option<NodeId> {
        self.read(|all| all.node(at_server))
    }

    /// Returns a path of BrowseNames with the namespaces of the face.
    pub(crate) fn path(&self, path: &[QualifiedName]) -> Option<Vec<QualifiedName>> {
        self.read(|all| path.iter().map(|name| all.name(name)).collect())
    }

    /// Translates a value. Identifiers that are unknown on the face become null.
    pub(crate) fn value(&self, value: Variant) -> Variant {
        self.read(|all| all.value(value))
    }

    fn read<T>(&self, how: impl FnOnce(&Identifiers) -> T) -> T {
        how(&self.0.read().unwrap_or_else(PoisonError::into_inner))
    }
}

impl Identifiers {
    fn node(&self, at_server: &NodeId) -> Option<NodeId> {
        if at_server.namespace == 0 {
            return Some(at_server.clone());
        }
        let known = self.nodes.get(at_server);
        known.or_else(|| self.types.get(at_server)).cloned()
    }

    fn name(&self, name: &QualifiedName) -> Option<QualifiedName> {
        let index = usize::from(name.namespace_index);
        let index = self.namespaces.get(index).copied().flatten()?;
        Some(QualifiedName::new(index, name.name.as_ref()))
    }

    #[expect(
        clippy::wildcard_enum_match_arm,
        reason = "the other values contain no identifiers of nodes"
    )]
    fn value(&self, value: Variant) -> Variant {
        match value {
            Variant::NodeId(node) => self.node(&node).unwrap_or_else(NodeId::null).into(),
            Variant::ExpandedNodeId(node) => {
                let here = node.server_index == 0 && node.namespace_uri.is_null();
                let known = here.then(|| self.node(&node.node_id)).flatten();
                ExpandedNodeId::from(known.unwrap_or_else(NodeId::null)).into()
            }
            Variant::QualifiedName(name) => {
                let known = self.name(&name);
                known.unwrap_or_else(QualifiedName::null).into()
            }
            Variant::Array(array) => {
                let Array {
                    value_type,
                    values,
                    dimensions,
                } = *array;
                let values = values.into_iter().map(|value| self.value(value));
                Variant::Array(Box::new(Array {
                    value_type,
                    values: values.collect(),
                    dimensions,
                }))
            }
            other => other,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn identifiers_of_a_device_become_those_of_the_face_or_null() {
        let node = |namespace, name: &str| NodeId::new(namespace, name);
        let all = Identifiers {
            nodes: HashMap::from([(node(2, "skill"), node(1, "Devices/a/skill"))]),
            types: HashMap::from([(node(3, "type"), node(1, "Types/urn:t#type"))]),
            namespaces: vec![Some(0), Some(4), Some(5), None],
        };
        let state: NodeId = ObjectTypeId::ProgramStateMachineType.into();
        let translated = |id: NodeId| all.value(id.into());
        assert_eq!(translated(state.clone()), state.into());
        assert_eq!(
            translated(node(2, "skill")),
            node(1, "Devices/a/skill").into()
        );
        assert_eq!(
            translated(node(3, "type")),
            node(1, "Types/urn:t#type").into()
        );
        assert_eq!(translated(node(2, "other")), NodeId::null().into());
        let list = Variant::from(vec![QualifiedName::new(2, "a"), QualifiedName::new(3, "b")]);
        let expected = Variant::from(vec![QualifiedName::new(5, "a"), QualifiedName::null()]);
        assert_eq!(all.value(list), expected);
        assert_eq!(all.value(7_i32.into()), Variant::from(7_i32));
    }
}
