//! Inspects the namespaces and nodes of a running OPC UA server.

use std::collections::{BTreeMap, HashMap, HashSet, VecDeque};
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use mappings::{
    Access, ExpandedNodeIdText, LiveNode, LiveRemote, LiveServer, Mapping, MethodTarget,
    NamespaceText, NodeIdText, ServerSecurityPolicy,
};
use opcua::client::{ClientBuilder, IdentityToken, Session};
use opcua::types::{
    AttributeId, BrowseDescription, BrowseDirection, BrowseResultMask, DataValue,
    EndpointDescription, Identifier, MessageSecurityMode, NodeClass, NodeClassMask, NodeId,
    ObjectId, ReadValueId, ReferenceDescription, ReferenceTypeId, TimestampsToReturn, UAString,
    UserTokenType, VariableId, Variant,
};
use plant_opcua::client::{LimitedService, OperationLimits, PartFault};
use tokio::time::timeout;
use uadp::BuiltinType;

use super::data_types::{self, STRUCTURE};
use super::{MOST, SurveyedNodes, UaMethod, UaServer, UaVariable, away};
use crate::exit::CommandFailure;

/// Browses the server at `url`, starting at its Objects folder.
pub(crate) async fn survey(url: &str) -> Result<SurveyedNodes, CommandFailure> {
    let server = Connected::to(url).await?;
    let browsing = async {
        let namespaces = server.namespaces().await?;
        let found = server.nodes(namespaces.len()).await?;
        Ok((namespaces, found))
    };
    let (namespaces, found) = server.within(browsing).await?;
    server.leave().await;
    let variables = found.variables.into_iter().map(|(_, one)| one);
    Ok(SurveyedNodes {
        place: format!("OPC UA server {url}"),
        server: Some(UaServer {
            endpoint: url.to_owned(),
            name: server.name.clone(),
            is_cell: found.is_cell,
        }),
        namespaces,
        variables: variables.collect(),
        methods: found.methods,
    })
}

/// Reads the namespaces of the server at `url` and the nodes of `mapping`.
pub(crate) async fn check(url: &str, mapping: &Mapping) -> Result<LiveServer, CommandFailure> {
    let server = Connected::to(url).await?;
    let asking = async {
        let mut live = LiveServer {
            namespaces: server.namespaces().await?,
            nodes: BTreeMap::new(),
        };
        let mut asked = Vec::new();
        for variable in mapping.variables() {
            let uri = mapping.namespaces().get(&variable.node.namespace);
            let text = variable.node.to_string();
            if live.agrees(&variable.node, uri.map(String::as_str))
                && let Ok(node) = text.parse::<NodeId>()
            {
                asked.push((text, node));
            }
        }
        let nodes: Vec<NodeId> = asked.iter().map(|(_, node)| node.clone()).collect();
        let told = server.read(&nodes, &[AttributeId::NodeClass]).await?;
        let types = server.value_types(&nodes).await?;
        for (((text, _), class), value) in asked.into_iter().zip(told).zip(types) {
            let class = class
                .value
                .and_then(|value| value.try_cast_to::<i32>().ok());
            let node = match class {
                Some(VARIABLE) => LiveNode::Variable(value),
                Some(_) | None => LiveNode::Away,
            };
            live.nodes.insert(text, node);
        }
        Ok(live)
    };
    let live = server.within(asking).await?;
    server.leave().await;
    Ok(live)
}

/// Checks Methods of a server. Returns `None` for each Method that can be called, otherwise the
/// reason.
pub(crate) async fn methods(
    access: &Access,
    wanted: &[&MethodTarget],
) -> Result<Vec<Option<String>>, CommandFailure> {
    let server = Connected::by(access).await?;
    let asking = async {
        let namespaces = server.namespaces().await?;
        let mut told = Vec::with_capacity(wanted.len());
        for target in wanted {
            let parts = [
                (&target.object, OBJECT, "Object"),
                (&target.method, METHOD, "Method"),
            ];
            let mut why = None;
            for (node, class, word) in parts {
                why = server.is_away(node, &namespaces, (class, word)).await?;
                if why.is_some() {
                    break;
                }
            }
            told.push(why);
        }
        Ok(told)
    };
    let told = server.within(asking).await?;
    server.leave().await;
    Ok(told)
}

/// Reads variables of a server, in order.
pub(crate) async fn remote(
    access: &Access,
    wanted: &[&ExpandedNodeIdText],
) -> Result<Vec<LiveRemote>, CommandFailure> {
    let server = Connected::by(access).await?;
    let asking = async {
        let namespaces = server.namespaces().await?;
        // A node is not read if its namespace does not exist at the server.
        let local = |text: &&ExpandedNodeIdText| {
            let namespace = index(text, &namespaces)?;
            let identifier = text.identifier.clone();
            let node = NodeIdText {
                namespace,
                identifier,
            };
            node.to_string().parse::<NodeId>().ok()
        };
        let nodes: Vec<Option<NodeId>> = wanted.iter().map(local).collect();
        let there: Vec<NodeId> = nodes.iter().flatten().cloned().collect();
        let attributes = [AttributeId::NodeClass, AttributeId::UserAccessLevel];
        let told = server.read(&there, &attributes).await?;
        let types = server.value_types(&there).await?;
        let told = told.chunks_exact(attributes.len()).zip(types);
        let mut told = told.map(|(told, value)| {
            let class = told.first().and_then(|class| class.value.clone());
            let class = class.and_then(|class| class.try_cast_to::<i32>().ok());
            let level = match told.get(1).and_then(|level| level.value.as_ref()) {
                Some(Variant::Byte(level)) => *level,
                Some(_) | None => 0,
            };
            match class {
                Some(VARIABLE) => LiveRemote::Variable {
                    value,
                    readable: level & READABLE != 0,
                    writable: level & WRITABLE != 0,
                },
                Some(_) | None => LiveRemote::Away,
            }
        });
        let live = nodes.into_iter().map(|node| match node {
            Some(_) => told.next().unwrap_or(LiveRemote::Away),
            None => LiveRemote::Away,
        });
        Ok(live.collect())
    };
    let live = server.within(asking).await?;
    server.leave().await;
    Ok(live)
}

/// Returns the index of the namespace of a node at a server.
fn index(node: &ExpandedNodeIdText, namespaces: &[String]) -> Option<u16> {
    match &node.namespace {
        NamespaceText::Index(index) => Some(*index),
        NamespaceText::Uri(uri) => {
            let at = namespaces.iter().position(|other| other == uri)?;
            u16::try_from(at).ok()
        }
    }
}

/// A session without security.
struct Connected {
    url: String,
    /// The ApplicationName of the server.
    name: String,
    session: Arc<Session>,
    limits: OperationLimits,
    events: tokio::task::JoinHandle<opcua::types::StatusCode>,
    pki: PathBuf,
}

impl Connected {
    /// Connects as an anonymous user.
    async fn to(url: &str) -> Result<Self, CommandFailure> {
        Self::connected(url, IdentityToken::Anonymous).await
    }

    /// Connects with the user of the mapping. A password is sent without security only if the
    /// mapping sets `security` to None.
    async fn by(access: &Access) -> Result<Self, CommandFailure> {
        let url = access.endpoint.to_string();
        let plain = access.security == Some(ServerSecurityPolicy::None);
        let may = plain || access.security.is_none() && access.user.is_none();
        if !may {
            return Err(away(
                format!("the OPC UA server at {url} is to be asked over a secured session only"),
                "ua-space has no certificates: `ua-server` tells at /status what it finds there",
            ));
        }
        let identity = match &access.user {
            Some(user) => IdentityToken::new_user_name(&user.name, user.password.reveal()),
            None => IdentityToken::Anonymous,
        };
        Self::connected(&url, identity).await
    }

    async fn connected(url: &str, identity: IdentityToken) -> Result<Self, CommandFailure> {
        if !url.starts_with("opc.tcp://") {
            return Err(CommandFailure::Usage(format!(
                "`{url}` is no endpoint of an OPC UA server, such as opc.tcp://127.0.0.1:4840"
            )));
        }
        let pki = std::env::temp_dir().join(format!("ua-space-{}", std::process::id()));
        let connecting = Self::connect(url, pki.clone(), identity);
        let found = match timeout(CONNECT, connecting).await {
            Ok(found) => found,
            Err(_over) => Err(absent(
                url,
                &format!("it did not answer within {CONNECT:?}"),
            )),
        };
        if found.is_err() {
            forget(&pki);
        }
        found
    }

    async fn connect(
        url: &str,
        pki: PathBuf,
        identity: IdentityToken,
    ) -> Result<Self, CommandFailure> {
        let mut client = ClientBuilder::new()
            .application_name("ua-space")
            .application_uri("urn:ua-bridge:ua-space")
            .product_uri("urn:ua-bridge:ua-space")
            .pki_dir(&pki)
            .session_retry_limit(0)
            .request_timeout(REQUEST)
            .max_message_size(MESSAGE)
            .max_chunk_count(CHUNKS)
            .client()
            .map_err(|wrong| CommandFailure::Io(wrong.join("; ")))?;
        let endpoints = client
            .get_server_endpoints_from_url(url)
            .await
            .map_err(|error| absent(url, &error.to_string()))?;
        let anonymous = matches!(identity, IdentityToken::Anonymous);
        let mut endpoint = open_endpoint(endpoints, anonymous).ok_or_else(|| {
            away(
                format!("the OPC UA server at {url} takes secured sessions or known users only"),
                "ua-space connects without security, as anonymous: allow that on this network, or export its NodeSet \
                 and give it by --nodeset",
            )
        })?;
        let name = endpoint.server.application_name.text.as_ref().to_owned();
        // Servers may return host names that this host cannot resolve.
        endpoint.endpoint_url = UAString::from(url);
        let (session, events) = client
            .connect_to_endpoint_directly(endpoint, identity)
            .map_err(|error| absent(url, &error.to_string()))?;
        let events = events.spawn();
        if !session.wait_for_connection().await {
            return Err(absent(url, "it refuses a session"));
        }
        let connected = Self {
            url: url.to_owned(),
            name,
            session,
            limits: OperationLimits::default(),
            events,
            pki,
        };
        connected.learn_limits().await?;
        Ok(connected)
    }

    /// Returns the result of `asking`, or an error after the time limit.
    async fn within<T>(
        &self,
        asking: impl Future<Output = Result<T, CommandFailure>>,
    ) -> Result<T, CommandFailure> {
        match timeout(BROWSE, asking).await {
            Ok(found) => found,
            Err(_over) => Err(absent(
                &self.url,
                &format!("not all was told within {BROWSE:?}"),
            )),
        }
    }

    async fn leave(&self) {
        // A server that does not respond to CloseSession is left without it.
        let _answered = timeout(GOODBYE, self.session.disconnect()).await;
    }

    fn failed(&self, error: &opcua::types::Error) -> CommandFailure {
        absent(&self.url, &error.to_string())
    }

    fn refused(&self, fault: PartFault, service: &str) -> CommandFailure {
        match fault {
            PartFault::Short => absent(
                &self.url,
                &format!("its answer to {service} is short of results"),
            ),
            PartFault::Failed(error) => self.failed(&error),
        }
    }

    /// Reads the operation limits of the server.
    async fn learn_limits(&self) -> Result<(), CommandFailure> {
        let nodes = OperationLimits::VARIABLES.map(NodeId::from);
        let values = self.read(&nodes, &[AttributeId::Value]).await?;
        self.limits.learn(&values);
        Ok(())
    }

    async fn namespaces(&self) -> Result<Vec<String>, CommandFailure> {
        let node = NodeId::from(VariableId::Server_NamespaceArray);
        let read = self.read(&[node], &[AttributeId::Value]).await?;
        let value = read.into_iter().next().and_then(|value| value.value);
        let Some(Variant::Array(array)) = value else {
            return Err(absent(&self.url, "it has no NamespaceArray"));
        };
        let uris = array.values.iter().map(|value| {
            if let Variant::String(uri) = value {
                uri.as_ref().to_owned()
            } else {
                String::new()
            }
        });
        Ok(uris.collect())
    }

    /// Returns the reason why the node does not exist with this NodeClass; `None` if it exists.
    async fn is_away(
        &self,
        node: &ExpandedNodeIdText,
        namespaces: &[String],
        (class, word): (i32, &str),
    ) -> Result<Option<String>, CommandFailure> {
        let Some(namespace) = index(node, namespaces) else {
            return Ok(Some(format!("{} has no namespace for `{node}`", self.url)));
        };
        let local = NodeIdText {
            namespace,
            identifier: node.identifier.clone(),
        };
        let Ok(local) = local.to_string().parse::<NodeId>() else {
            return Ok(Some(format!(
                "`{node}` is no node id that can be asked for"
            )));
        };
        let read = self.read(&[local], &[AttributeId::NodeClass]).await?;
        let told = read.into_iter().next().and_then(|told| told.value);
        let told = told.and_then(|value| value.try_cast_to::<i32>().ok());
        Ok((told != Some(class)).then(|| format!("{} has no {word} `{node}`", self.url)))
    }

    /// Browses the variables and Methods below the Objects folder, without properties and without
    /// nodes below variables.
    async fn nodes(&self, namespaces: usize) -> Result<BrowsedNodes, CommandFailure> {
        let mut found = BrowsedNodes::default();
        let objects = NodeId::from(ObjectId::ObjectsFolder);
        found.seen.insert(objects.clone());
        let mut next = VecDeque::from([Object {
            node: objects,
            name: String::new(),
            ours: false,
        }]);
        while !next.is_empty() {
            let batch: Vec<Object> = next.drain(..next.len().min(BATCH)).collect();
            let nodes: Vec<NodeId> = batch.iter().map(|object| object.node.clone()).collect();
            let below = self.below(&nodes).await?;
            for (object, references) in batch.into_iter().zip(below) {
                let local = references.into_iter().filter(|reference| {
                    let node = &reference.node_id.node_id;
                    node.namespace != 0
                        && usize::from(node.namespace) < namespaces
                        && reference.node_id.server_index == 0
                        && reference.reference_type_id != ReferenceTypeId::HasProperty
                });
                next.extend(local.filter_map(|reference| found.take(&object, reference)));
            }
            if found.seen.len() > MOST || found.methods.len() > MOST {
                return Err(CommandFailure::Unavailable(format!(
                    "the OPC UA server at {} has more than {MOST} nodes, which are not looked through",
                    self.url
                )));
            }
        }
        let variables = found.variables.iter();
        let nodes: Vec<NodeId> = variables.map(|(node, _)| node.clone()).collect();
        let types = self.value_types(&nodes).await?;
        for ((_, variable), value) in found.variables.iter_mut().zip(types) {
            variable.value = value;
        }
        Ok(found)
    }

    /// Returns the forward references of each node.
    async fn below(
        &self,
        nodes: &[NodeId],
    ) -> Result<Vec<Vec<ReferenceDescription>>, CommandFailure> {
        let wanted: Vec<BrowseDescription> = nodes
            .iter()
            .map(|node| BrowseDescription {
                node_id: node.clone(),
                browse_direction: BrowseDirection::Forward,
                reference_type_id: ReferenceTypeId::HierarchicalReferences.into(),
                include_subtypes: true,
                node_class_mask: (NodeClassMask::OBJECT
                    | NodeClassMask::VARIABLE
                    | NodeClassMask::METHOD)
                    .bits(),
                result_mask: BrowseResultMask::All as u32,
            })
            .collect();
        let mut parts = self.limits.parts(LimitedService::Browse, &wanted);
        while let Some(part) = parts.next_part() {
            let browsed = self.session.browse(part, REFERENCES, None).await;
            parts
                .answered(browsed)
                .map_err(|fault| self.refused(fault, "Browse"))?;
        }
        let results = parts.into_answers();
        let mut all = Vec::with_capacity(nodes.len());
        for result in results {
            let mut references = result.references.unwrap_or_default();
            let mut point = result.continuation_point;
            while !point.is_null_or_empty() && references.len() <= MOST {
                let more = self.session.browse_next(false, &[point]).await;
                let more = more.map_err(|error| self.failed(&error))?;
                let Some(more) = more.into_iter().next() else {
                    break;
                };
                references.extend(more.references.unwrap_or_default());
                point = more.continuation_point;
            }
            all.push(references);
        }
        Ok(all)
    }

    /// Reads the attributes of the nodes; the attributes of a node are consecutive.
    async fn read(
        &self,
        nodes: &[NodeId],
        attributes: &[AttributeId],
    ) -> Result<Vec<DataValue>, CommandFailure> {
        let mut values = Vec::new();
        for nodes in nodes.chunks(BATCH) {
            let wanted: Vec<ReadValueId> = nodes
                .iter()
                .flat_map(|node| {
                    let of = |attribute: &AttributeId| ReadValueId::new(node.clone(), *attribute);
                    attributes.iter().map(of)
                })
                .collect();
            let mut parts = self.limits.parts(LimitedService::Read, &wanted);
            while let Some(part) = parts.next_part() {
                let read = self.session.read(part, TimestampsToReturn::Neither, 0.0);
                parts
                    .answered(read.await)
                    .map_err(|fault| self.refused(fault, "Read"))?;
            }
            values.extend(parts.into_answers());
        }
        Ok(values)
    }

    /// Returns the builtin type of each variable, and whether it is an array.
    async fn value_types(
        &self,
        nodes: &[NodeId],
    ) -> Result<Vec<Option<(BuiltinType, bool)>>, CommandFailure> {
        let attributes = [AttributeId::DataType, AttributeId::ValueRank];
        let read = self.read(nodes, &attributes).await?;
        let mut known: HashMap<NodeId, Option<BuiltinType>> = HashMap::new();
        let mut types = Vec::with_capacity(nodes.len());
        for told in read.chunks_exact(attributes.len()) {
            let [kind, rank] = told else { continue };
            let rank = if let Some(Variant::Int32(rank)) = &rank.value {
                i64::from(*rank)
            } else {
                ANY_RANK
            };
            let Some(Variant::NodeId(kind)) = &kind.value else {
                types.push(None);
                continue;
            };
            let builtin = match known.get(&**kind) {
                Some(builtin) => *builtin,
                None => {
                    let builtin = self.builtin(kind).await?;
                    known.insert((**kind).clone(), builtin);
                    builtin
                }
            };
            types.push(builtin.and_then(|builtin| data_types::ranked(builtin, rank)));
        }
        Ok(types)
    }

    /// Returns the builtin type of a DataType, by its supertypes.
    async fn builtin(&self, data_type: &NodeId) -> Result<Option<BuiltinType>, CommandFailure> {
        let mut node = data_type.clone();
        for _ in 0..DEEPEST {
            if node.namespace == 0
                && let Identifier::Numeric(number) = node.identifier
            {
                if number == STRUCTURE {
                    return Ok(Some(BuiltinType::ExtensionObject));
                }
                if let Some(builtin) = data_types::builtin(number) {
                    return Ok(Some(builtin));
                }
            }
            let above = BrowseDescription {
                node_id: node.clone(),
                browse_direction: BrowseDirection::Inverse,
                reference_type_id: ReferenceTypeId::HasSubtype.into(),
                include_subtypes: true,
                node_class_mask: NodeClassMask::DATA_TYPE.bits(),
                result_mask: BrowseResultMask::All as u32,
            };
            let results = self.session.browse(&[above], 1, None).await;
            let results = results.map_err(|error| self.failed(&error))?;
            let references = results.into_iter().next().and_then(|one| one.references);
            match references.and_then(|references| references.into_iter().next()) {
                Some(above) => node = above.node_id.node_id,
                None => return Ok(None),
            }
        }
        Ok(None)
    }
}

/// An Object to browse.
struct Object {
    node: NodeId,
    /// The name; empty for the Objects folder.
    name: String,
    /// True if the Object is below the folder with which a server of the space shows the space.
    ours: bool,
}

/// The nodes below the Objects folder.
#[derive(Default)]
struct BrowsedNodes {
    seen: HashSet<NodeId>,
    variables: Vec<(NodeId, UaVariable)>,
    methods: Vec<UaMethod>,
    /// True if the server shows the space.
    is_cell: bool,
}

impl BrowsedNodes {
    /// Stores a node below an Object. Returns the node if it is an Object found for the first time.
    fn take(&mut self, above: &Object, reference: ReferenceDescription) -> Option<Object> {
        let node = reference.node_id.node_id;
        let name = reference.browse_name.name.as_ref().to_owned();
        let within = above.name.clone();
        let text = |node: &NodeId| node.to_string().parse::<NodeIdText>().ok();
        if reference.node_class == NodeClass::Method {
            if !above.ours {
                self.methods.push(UaMethod {
                    object: text(&above.node)?,
                    method: text(&node)?,
                    name,
                    within,
                });
            }
            return None;
        }
        if !self.seen.insert(node.clone()) {
            return None;
        }
        if reference.node_class == NodeClass::Object {
            let ours = above.ours || name == OURS;
            self.is_cell |= ours;
            return Some(Object { node, name, ours });
        }
        let variable = UaVariable {
            node: text(&node)?,
            name,
            within,
            source: None,
            value: None,
        };
        self.variables.push((node, variable));
        None
    }
}

/// The folder of a server of the space.
const OURS: &str = "UaSpace";

impl Drop for Connected {
    fn drop(&mut self) {
        self.events.abort();
        forget(&self.pki);
    }
}

/// Removes the folder that the client creates for certificates, which are not used here.
fn forget(pki: &PathBuf) {
    // If this fails, an empty folder remains among the temporary files.
    let _removed = std::fs::remove_dir_all(pki);
}

/// Returns an endpoint without security, for anonymous users or for users with a password.
fn open_endpoint(
    endpoints: Vec<EndpointDescription>,
    anonymous: bool,
) -> Option<EndpointDescription> {
    let wanted = if anonymous {
        UserTokenType::Anonymous
    } else {
        UserTokenType::UserName
    };
    endpoints.into_iter().find(|endpoint| {
        let known = endpoint.user_identity_tokens.as_ref().is_none_or(|tokens| {
            tokens.is_empty() || tokens.iter().any(|token| token.token_type == wanted)
        });
        endpoint.security_mode == MessageSecurityMode::None && known
    })
}

fn absent(url: &str, why: &str) -> CommandFailure {
    away(
        format!("no OPC UA server can be asked at {url}: {why}"),
        "is it running, and is that its endpoint?",
    )
}

/// NodeClasses (OPC 10000-3, 8.29).
const OBJECT: i32 = 1;
const VARIABLE: i32 = 2;
const METHOD: i32 = 4;
/// Bits of UserAccessLevel (OPC 10000-3, 8.57).
const READABLE: u8 = 1;
const WRITABLE: u8 = 2;
const ANY_RANK: i64 = -2;
const BATCH: usize = 100;
const REFERENCES: u32 = 1000;
const DEEPEST: usize = 32;
const CONNECT: Duration = Duration::from_secs(10);
const REQUEST: Duration = Duration::from_secs(5);
const BROWSE: Duration = Duration::from_secs(60);
const GOODBYE: Duration = Duration::from_secs(2);
const MESSAGE: usize = 16 << 20;
const CHUNKS: usize = 260;
