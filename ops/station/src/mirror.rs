//! Reads the nodes of a server below Objects: its objects, variables and methods, with the names of
//! their types and the paths that lead to them.

use std::collections::HashSet;

use plant_opcua::client::{Browse, ClientError, OpcUaClient, Select};
use plant_opcua::server::arguments_in;
use plant_opcua::types::{
    Argument, AttributeId, DataTypeId, DataValue, NodeClass, NodeClassMask, NodeId, ObjectId,
    ObjectTypeId, QualifiedName, ReferenceDescription, ReferenceTypeId, VariableId, VariableTypeId,
    Variant,
};
use tracing::debug;

use crate::configure::is_configure;

/// The nodes of a server.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct MirroredServer {
    /// The nodes that can be shown elsewhere, parents before their children.
    pub(crate) nodes: Vec<MirroredNode>,
    /// The types of the server, supertypes before their subtypes, by their NodeIds.
    pub(crate) types: Vec<(NodeId, NamedType)>,
    /// The fields that its own types of transition events declare.
    pub(crate) event_fields: Vec<Select>,
    /// The namespaces of the server, by index.
    pub(crate) namespaces: Vec<String>,
    /// Object and method of its `Configure`.
    pub(crate) configure: Option<(NodeId, NodeId)>,
    /// Number of methods that cannot be forwarded: their arguments are valid only at that server,
    /// or there are more nodes than [`MOST_NODES`], or than the station shows of all servers.
    pub(crate) methods_kept_back: usize,
    /// Number of variables and objects that cannot be shown, for the same reasons or because they
    /// cannot be read.
    pub(crate) variables_kept_back: usize,
}

/// A node of a server.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct MirroredNode {
    /// The BrowseNames of the nodes below Objects, the name of the node last.
    pub(crate) path: Vec<String>,
    /// Its BrowseName.
    pub(crate) name: Name,
    /// The reference type from its parent, of the core namespace.
    pub(crate) reference: ReferenceTypeId,
    /// Its NodeId at the server.
    pub(crate) id: NodeId,
    pub(crate) kind: MirroredKind,
}

/// A BrowseName with the URI of its namespace; the core namespace has none.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub(crate) struct Name {
    pub(crate) uri: Option<String>,
    pub(crate) name: String,
}

/// The kind of a node.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum MirroredKind {
    Object {
        /// Its type.
        of: TypeRef,
        /// Whether it raises events.
        events: bool,
    },
    Variable {
        /// Its DataType, of the core namespace.
        data_type: NodeId,
        value_rank: i32,
        writable: bool,
    },
    Method {
        object: NodeId,
        takes: Vec<Argument>,
        gives: Vec<Argument>,
    },
}

/// A type of the core namespace, or of another namespace by its name.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum TypeRef {
    Core(NodeId),
    Named(TypeKey),
}

/// The identity of a type, which is the same at every server.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct TypeKey {
    pub(crate) name: Name,
    /// The identifier in the namespace of the name, for example `i=1200`, also behind further
    /// stations.
    pub(crate) identifier: String,
}

/// A type that is not of the core namespace.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct NamedType {
    pub(crate) key: TypeKey,
    pub(crate) supertype: TypeRef,
}

impl TypeKey {
    fn of(name: Name, id: &NodeId) -> Self {
        let identifier = id.identifier.to_string();
        let shown = format!("s={}", Self::shown(&name, ""));
        let own = identifier.strip_prefix(&shown).map(str::to_owned);
        Self {
            identifier: own.unwrap_or(identifier),
            name,
        }
    }

    /// Returns the identifier of the type on a face.
    pub(crate) fn on_face(&self) -> String {
        Self::shown(&self.name, &self.identifier)
    }

    fn shown(name: &Name, identifier: &str) -> String {
        format!(
            "Types/{};{identifier}",
            name.uri.as_deref().unwrap_or_default()
        )
    }
}

impl MirroredServer {
    /// Returns the number of methods.
    pub(crate) fn methods(&self) -> usize {
        self.count(|kind| matches!(kind, MirroredKind::Method { .. }))
    }

    /// Returns the number of variables.
    pub(crate) fn variables(&self) -> usize {
        self.count(|kind| matches!(kind, MirroredKind::Variable { .. }))
    }

    /// Keeps this number of nodes, and counts the others as not shown. Parents come before their
    /// children.
    pub(crate) fn keep(&mut self, most: usize) {
        let kept_back = self.nodes.get(most..).unwrap_or_default();
        let is_method = |node: &&MirroredNode| matches!(node.kind, MirroredKind::Method { .. });
        let methods = kept_back.iter().filter(is_method).count();
        self.methods_kept_back += methods;
        self.variables_kept_back += kept_back.len() - methods;
        self.nodes.truncate(most);
    }

    fn count(&self, is: impl Fn(&MirroredKind) -> bool) -> usize {
        self.nodes.iter().filter(|node| is(&node.kind)).count()
    }
}

/// Reads the nodes over the current connection.
///
/// # Errors
/// No response.
pub(crate) async fn look(client: &OpcUaClient) -> Result<MirroredServer, ClientError> {
    let mut survey = Survey {
        client,
        mirror: MirroredServer {
            namespaces: namespaces(client).await?,
            ..MirroredServer::default()
        },
        seen: HashSet::new(),
        object_types: Vec::new(),
    };
    let mut level = vec![Parent {
        id: ObjectId::ObjectsFolder.into(),
        path: Vec::new(),
    }];
    while !level.is_empty() {
        level = survey.level(level).await?;
    }
    survey.types().await?;
    Ok(survey.mirror)
}

/// A node to read the children of.
struct Parent {
    id: NodeId,
    path: Vec<String>,
}

/// A child before its attributes are read.
struct Child {
    object: NodeId,
    path: Vec<String>,
    reference: ReferenceDescription,
}

/// A search through the address space of a server, level by level.
struct Survey<'c> {
    client: &'c OpcUaClient,
    mirror: MirroredServer,
    seen: HashSet<NodeId>,
    /// The types of the objects that were found, each once.
    object_types: Vec<NodeId>,
}

impl Survey<'_> {
    /// Reads the children of a level. Returns the children that may have children themselves.
    async fn level(&mut self, parents: Vec<Parent>) -> Result<Vec<Parent>, ClientError> {
        let below = Browse {
            classes: NodeClassMask::OBJECT | NodeClassMask::VARIABLE | NodeClassMask::METHOD,
            ..Browse::hierarchical()
        };
        let ids: Vec<NodeId> = parents.iter().map(|parent| parent.id.clone()).collect();
        let all = self.client.browse_all(&ids, &below).await?;
        let (mut objects, mut variables, mut methods) = (Vec::new(), Vec::new(), Vec::new());
        for (parent, references) in parents.into_iter().zip(all) {
            let mut names = HashSet::new();
            for reference in references {
                let id = &reference.node_id.node_id;
                let elsewhere = reference.node_id.server_index != 0;
                // Nodes of namespace 0, such as the object Server, exist in every server and are
                // skipped.
                if id.namespace == 0 || elsewhere || parent.path.len() >= DEEPEST {
                    continue;
                }
                let name = &reference.browse_name.name;
                let name: String = name.as_ref().chars().take(LONGEST_NAME).collect();
                let is_method = reference.node_class == NodeClass::Method;
                // Nodes that differ only in their namespaces: the first is shown. A method may
                // belong to several objects.
                if !names.insert(name.clone()) || !(is_method || self.seen.insert(id.clone())) {
                    continue;
                }
                if self.is_full(objects.len() + variables.len() + methods.len()) {
                    match is_method {
                        true => self.mirror.methods_kept_back += 1,
                        false => self.mirror.variables_kept_back += 1,
                    }
                    continue;
                }
                let path = parent.path.iter().cloned().chain([name]).collect();
                let child = Child {
                    object: parent.id.clone(),
                    path,
                    reference,
                };
                // The server returns these three classes only.
                let class = child.reference.node_class;
                if class == NodeClass::Object {
                    objects.push(child);
                } else if class == NodeClass::Variable {
                    variables.push(child);
                } else if class == NodeClass::Method {
                    methods.push(child);
                }
            }
        }
        let mut next = self.objects(objects).await?;
        next.extend(self.variables(variables).await?);
        self.methods(methods).await?;
        Ok(next)
    }

    fn is_full(&self, more: usize) -> bool {
        self.mirror.nodes.len() + more >= MOST_NODES
    }

    async fn objects(&mut self, found: Vec<Child>) -> Result<Vec<Parent>, ClientError> {
        let what: Vec<_> = found
            .iter()
            .map(|child| (child.id().clone(), AttributeId::EventNotifier))
            .collect();
        let notifiers = self.client.read_attributes(&what).await?;
        let mut next = Vec::new();
        for (child, notifier) in found.into_iter().zip(notifiers) {
            let events = matches!(notifier.value, Some(Variant::Byte(bits)) if bits & 1 != 0);
            let of = child.reference.type_definition.node_id.clone();
            let of = match of.namespace {
                0 if of.is_null() => ObjectTypeId::BaseObjectType.into(),
                _ => of,
            };
            if of.namespace != 0 && !self.object_types.contains(&of) {
                self.object_types.push(of.clone());
            }
            next.push(Parent {
                id: child.id().clone(),
                path: child.path.clone(),
            });
            // The name of the type is added when all types are known.
            let kind = MirroredKind::Object {
                of: TypeRef::Core(of),
                events,
            };
            self.put(child, kind);
        }
        Ok(next)
    }

    async fn variables(&mut self, found: Vec<Child>) -> Result<Vec<Parent>, ClientError> {
        let attributes = [
            AttributeId::DataType,
            AttributeId::ValueRank,
            AttributeId::UserAccessLevel,
        ];
        let what: Vec<_> = found
            .iter()
            .flat_map(|child| attributes.map(|attribute| (child.id().clone(), attribute)))
            .collect();
        let mut read = self.client.read_attributes(&what).await?.into_iter();
        let mut next = || read.next().and_then(|value| value.value);
        let mut described = Vec::new();
        for child in found {
            let [data_type, rank, access] = [next(), next(), next()];
            described.push((child, data_type, rank, access));
        }
        let mut parents = Vec::new();
        for (child, data_type, rank, access) in described {
            let data_type = match data_type {
                Some(Variant::NodeId(of)) => passed(self.client, &of).await?,
                _ => None,
            };
            let Some(data_type) = data_type else {
                self.mirror.variables_kept_back += 1;
                debug!(path = ?child.path, "cannot pass on a variable");
                continue;
            };
            let bits = match access {
                Some(Variant::Byte(bits)) => bits,
                _ => READABLE,
            };
            if bits & READABLE == 0 {
                self.mirror.variables_kept_back += 1;
                continue;
            }
            parents.push(Parent {
                id: child.id().clone(),
                path: child.path.clone(),
            });
            let kind = MirroredKind::Variable {
                value_rank: match rank {
                    Some(Variant::Int32(rank)) => rank,
                    _ => SCALAR,
                },
                // NodeIds and names of this server mean nothing to the device.
                writable: bits & WRITABLE != 0 && !is_local(&data_type),
                data_type,
            };
            self.put(child, kind);
        }
        Ok(parents)
    }

    async fn methods(&mut self, found: Vec<Child>) -> Result<(), ClientError> {
        let ids: Vec<NodeId> = found.iter().map(|child| child.id().clone()).collect();
        let properties = Browse::of(ReferenceTypeId::HasProperty);
        let properties = self.client.browse_all(&ids, &properties).await?;
        let which = ["InputArguments", "OutputArguments"];
        let mut nodes = Vec::new();
        for properties in &properties {
            for which in which {
                let mut properties = properties.iter();
                let found = properties.find(|one| one.browse_name.name.as_ref() == which);
                nodes.push(found.map(|one| one.node_id.node_id.clone()));
            }
        }
        let there: Vec<NodeId> = nodes.iter().flatten().cloned().collect();
        let mut values = self.client.read(&there).await?.into_iter();
        let mut signatures = nodes.into_iter().map(|node| node.map(|_| values.next()));
        for child in found {
            let both = [signatures.next().flatten(), signatures.next().flatten()];
            let Some([takes, gives]) = signature(self.client, both).await? else {
                self.mirror.methods_kept_back += 1;
                debug!(path = ?child.path, "cannot pass on a method");
                continue;
            };
            let name = child.path.last().map(String::as_str).unwrap_or_default();
            if is_configure(name, &takes, &gives) {
                // Only the station configures the place, so the method is not shown.
                let own = (child.object.clone(), child.id().clone());
                self.mirror.configure.get_or_insert(own);
                continue;
            }
            let kind = MirroredKind::Method {
                object: child.object.clone(),
                takes,
                gives,
            };
            self.put(child, kind);
        }
        Ok(())
    }

    fn put(&mut self, child: Child, kind: MirroredKind) {
        let name = self.name_of(&child.reference.browse_name);
        self.mirror.nodes.push(MirroredNode {
            name,
            reference: reference(&child.reference.reference_type_id, &kind),
            id: child.reference.node_id.node_id,
            path: child.path,
            kind,
        });
    }

    fn name_of(&self, name: &QualifiedName) -> Name {
        let index = usize::from(name.namespace_index);
        Name {
            uri: match index {
                0 => None,
                _ => self.mirror.namespaces.get(index).cloned(),
            },
            name: name.name.as_ref().chars().take(LONGEST_NAME).collect(),
        }
    }

    /// Reads the types of the objects and of the transition events up to the core namespace, and
    /// adds the names of the types to the objects.
    async fn types(&mut self) -> Result<(), ClientError> {
        let base: NodeId = ObjectTypeId::ProgramTransitionEventType.into();
        // Not every server has Programs.
        let events = match self.client.subtypes(&base).await {
            Ok(events) => events,
            Err(ClientError::Status(_)) => Vec::new(),
            Err(error) => return Err(error),
        };
        let events: Vec<NodeId> = events.into_iter().filter(|id| id.namespace != 0).collect();
        let wanted: Vec<NodeId> = self.object_types.iter().chain(&events).cloned().collect();
        for of in wanted {
            self.type_with_supertypes(of).await?;
        }
        for (event, fields) in events
            .iter()
            .zip(self.client.browse_all(&events, &declared()).await?)
        {
            let fields = fields.into_iter().take(MOST_FIELDS).map(|field| Select {
                type_id: event.clone(),
                path: vec![field.browse_name],
            });
            self.mirror.event_fields.extend(fields);
        }
        let types = &self.mirror.types;
        for node in &mut self.mirror.nodes {
            if let MirroredKind::Object { of, .. } = &mut node.kind
                && let TypeRef::Core(id) = of
                && id.namespace != 0
            {
                *of = reference_to(types, id)
                    .unwrap_or_else(|| TypeRef::Core(ObjectTypeId::BaseObjectType.into()));
            }
        }
        Ok(())
    }

    async fn type_with_supertypes(&mut self, of: NodeId) -> Result<(), ClientError> {
        let above = match self.client.supertypes(&of).await {
            Ok(above) => above,
            Err(ClientError::Status(_)) => Vec::new(),
            Err(error) => return Err(error),
        };
        let chain: Vec<NodeId> = std::iter::once(of).chain(above).collect();
        for (at, id) in chain.iter().enumerate().rev() {
            let known = self.mirror.types.iter().any(|(known, _)| known == id);
            if id.namespace == 0 || known || self.mirror.types.len() >= MOST_TYPES {
                continue;
            }
            let named = [(id.clone(), AttributeId::BrowseName)];
            let name = self.client.read_attributes(&named).await?.pop();
            let Some(Variant::QualifiedName(name)) = name.and_then(|value| value.value) else {
                continue;
            };
            let supertype = chain
                .get(at + 1)
                .and_then(|above| reference_to(&self.mirror.types, above))
                .unwrap_or_else(|| TypeRef::Core(ObjectTypeId::BaseObjectType.into()));
            let key = TypeKey::of(self.name_of(&name), id);
            let named = NamedType { key, supertype };
            self.mirror.types.push((id.clone(), named));
        }
        Ok(())
    }
}

impl Child {
    fn id(&self) -> &NodeId {
        &self.reference.node_id.node_id
    }
}

/// Returns the declared variables of a type.
fn declared() -> Browse {
    Browse {
        classes: NodeClassMask::VARIABLE,
        ..Browse::of(ReferenceTypeId::Aggregates)
    }
}

fn reference_to(types: &[(NodeId, NamedType)], id: &NodeId) -> Option<TypeRef> {
    if id.namespace == 0 {
        return Some(TypeRef::Core(id.clone()));
    }
    let mut types = types.iter();
    let (_, of) = types.find(|(known, _)| known == id)?;
    Some(TypeRef::Named(of.key.clone()))
}

/// Returns the reference type of the core namespace for a node on another server.
fn reference(id: &NodeId, kind: &MirroredKind) -> ReferenceTypeId {
    let kept = [
        ReferenceTypeId::HasComponent,
        ReferenceTypeId::HasProperty,
        ReferenceTypeId::HasOrderedComponent,
        ReferenceTypeId::HasAddIn,
        ReferenceTypeId::Organizes,
    ];
    let usual = match kind {
        MirroredKind::Object { .. } => ReferenceTypeId::Organizes,
        MirroredKind::Variable { .. } | MirroredKind::Method { .. } => {
            ReferenceTypeId::HasComponent
        }
    };
    kept.into_iter().find(|one| id == one).unwrap_or(usual)
}

/// Returns the NamespaceArray of the server. It may be longer than at the start of the connection.
async fn namespaces(client: &OpcUaClient) -> Result<Vec<String>, ClientError> {
    let node: NodeId = VariableId::Server_NamespaceArray.into();
    let value = client.read(&[node]).await?.pop();
    let Some(Variant::Array(array)) = value.and_then(|value| value.value) else {
        return Ok(client.namespaces());
    };
    let texts = array.values.iter().map(|uri| {
        let Variant::String(uri) = uri else {
            return String::new();
        };
        uri.as_ref().chars().take(LONGEST_NAME).collect()
    });
    Ok(texts.collect())
}

/// Returns the input and output arguments of a method; `None` if it cannot be forwarded.
async fn signature(
    client: &OpcUaClient,
    values: [Option<Option<DataValue>>; 2],
) -> Result<Option<[Vec<Argument>; 2]>, ClientError> {
    let mut both = [Vec::new(), Vec::new()];
    for (value, into) in values.into_iter().zip(&mut both) {
        // A method without arguments has no such property.
        let Some(value) = value else {
            continue;
        };
        let Some(all) = arguments_in(value) else {
            return Ok(None);
        };
        if all.len() > MOST_ARGUMENTS {
            return Ok(None);
        }
        for argument in all {
            match passed(client, &argument.data_type).await? {
                Some(data_type) if !is_local(&data_type) && data_type != DataTypeId::Structure => {
                    into.push(Argument {
                        data_type,
                        ..argument
                    });
                }
                Some(_) | None => return Ok(None),
            }
        }
    }
    Ok(Some(both))
}

/// Returns the DataType of the core namespace for values on this server. `None` for custom
/// structures, whose identifiers differ between servers.
async fn passed(client: &OpcUaClient, data_type: &NodeId) -> Result<Option<NodeId>, ClientError> {
    if data_type.namespace == 0 {
        return Ok(Some(data_type.clone()));
    }
    let above = match client.supertypes(data_type).await {
        Ok(above) => above,
        Err(ClientError::Status(_)) => return Ok(None),
        Err(error) => return Err(error),
    };
    // An enumeration, or a subtype of a number.
    let known = above.into_iter().find(|one| one.namespace == 0);
    Ok(known.filter(|known| *known != DataTypeId::Structure))
}

/// Returns whether values of the DataType identify something at one server only.
fn is_local(data_type: &NodeId) -> bool {
    let names = [
        DataTypeId::NodeId,
        DataTypeId::ExpandedNodeId,
        DataTypeId::QualifiedName,
    ];
    names.iter().any(|one| *data_type == *one)
}

/// Returns the VariableType for a variable on another server.
pub(crate) fn variable_type(reference: ReferenceTypeId) -> VariableTypeId {
    match reference == ReferenceTypeId::HasProperty {
        true => VariableTypeId::PropertyType,
        false => VariableTypeId::BaseDataVariableType,
    }
}

/// Two stations below each other add four objects to the path of a node.
const DEEPEST: usize = 20;
const LONGEST_NAME: usize = 128;
/// Maximum number of nodes of a server that are shown.
pub(crate) const MOST_NODES: usize = 60_000;
const MOST_TYPES: usize = 1_000;
const MOST_ARGUMENTS: usize = 64;
/// Maximum number of fields of a type of events.
const MOST_FIELDS: usize = 32;
/// The value of ValueRank for scalars.
const SCALAR: i32 = -1;
/// Bits of AccessLevel.
const READABLE: u8 = 1;
const WRITABLE: u8 = 2;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nodes_that_are_not_kept_are_counted_by_their_kind() {
        let found = |kind: MirroredKind| MirroredNode {
            path: vec!["a".to_owned()],
            name: Name {
                uri: None,
                name: "a".to_owned(),
            },
            reference: ReferenceTypeId::HasComponent,
            id: NodeId::new(1, 1_u32),
            kind,
        };
        let object = || MirroredKind::Object {
            of: TypeRef::Core(ObjectTypeId::BaseObjectType.into()),
            events: false,
        };
        let method = || MirroredKind::Method {
            object: NodeId::new(1, 1_u32),
            takes: Vec::new(),
            gives: Vec::new(),
        };
        let nodes = [object(), object(), method(), method(), object()].map(found);
        let mut mirror = MirroredServer {
            nodes: nodes.into(),
            ..MirroredServer::default()
        };
        mirror.keep(9);
        assert_eq!((mirror.nodes.len(), mirror.methods_kept_back), (5, 0));
        mirror.keep(2);
        assert_eq!(mirror.nodes.len(), 2);
        let kept_back = (mirror.methods_kept_back, mirror.variables_kept_back);
        assert_eq!(kept_back, (2, 1));
    }

    #[test]
    fn a_type_has_one_identity_behind_any_number_of_stations() {
        let name = Name {
            uri: Some("urn:types".to_owned()),
            name: "GraspSkillType".to_owned(),
        };
        let direct = TypeKey::of(name.clone(), &NodeId::new(4, 1_200_u32));
        assert_eq!(direct.identifier, "i=1200");
        assert_eq!(direct.on_face(), "Types/urn:types;i=1200");
        let through = TypeKey::of(name, &NodeId::new(1, direct.on_face()));
        assert_eq!(through, direct);
    }
}
