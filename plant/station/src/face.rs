//! A server that shows the methods of others, and passes their calls on.

use std::collections::BTreeSet;
use std::path::PathBuf;
use std::sync::Arc;

use async_trait::async_trait;
use plant_opcua::changes::{Became, ModelChange};
use plant_opcua::client::{CallError, CallOptions, Client, ClientError};
use plant_opcua::limits::LONGEST_REQUEST;
use plant_opcua::server::{
    EndpointUrl, InstanceError, MethodHandler, MethodRequest, MethodSpec, ObjectSpec, Refusal,
    Security, Server, ServerBuilder, ServerConfig, ServerError, VariableSpec,
};
use plant_opcua::types::{
    DataTypeId, DataValue, LocalizedText, NodeId, ObjectId, ObjectTypeId, QualifiedName,
    ReferenceTypeId, StatusCode, VariableTypeId, Variant,
};
use tracing::debug;

use crate::mirror::{Found, Mirror};

/// One face of a station.
#[derive(Clone)]
pub(crate) struct Face {
    pub(crate) server: Server,
    /// The folder of those whose methods are shown.
    folder: &'static str,
}

/// How a face listens.
pub(crate) struct FaceSettings {
    pub(crate) application_uri: String,
    pub(crate) name: String,
    pub(crate) endpoint: EndpointUrl,
    /// The certificate store; the pair is there.
    pub(crate) pki: Option<PathBuf>,
    pub(crate) allow_unsecured: bool,
    pub(crate) trust_any: bool,
}

/// A server whose methods are shown.
pub(crate) struct Shown<'a> {
    /// Its name below the folder.
    pub(crate) name: &'a str,
    pub(crate) application_uri: &'a str,
    pub(crate) mirror: &'a Mirror,
    pub(crate) client: &'a Client,
    /// The connection on which its NodeIds hold.
    pub(crate) connects: u64,
}

impl Face {
    /// Listens; nobody is served until the server is started.
    pub(crate) fn open(settings: FaceSettings, folder: &'static str) -> Result<Self, ServerError> {
        let FaceSettings {
            application_uri,
            name,
            endpoint,
            pki,
            allow_unsecured,
            trust_any,
        } = settings;
        let security = match (&pki, allow_unsecured) {
            (None, _) => vec![Security::None],
            (Some(_), true) => vec![Security::None, Security::Basic256Sha256],
            (Some(_), false) => vec![Security::Basic256Sha256],
        };
        let config = ServerConfig {
            security,
            pki,
            trust_unknown_clients: trust_any,
            ..ServerConfig::new(&application_uri, &name, endpoint)
        };
        let server = ServerBuilder::new(config).build()?;
        let face = Self { server, folder };
        let made = face.object(folder, &ObjectId::ObjectsFolder.into(), folder);
        made.map_err(|error| ServerError::Configuration(error.to_string()))?;
        Ok(face)
    }

    /// Shows the methods of a server in the place of what was shown of it, and tells clients.
    ///
    /// # Errors
    /// The folder is not there any more.
    pub(crate) fn show(&self, shown: &Shown<'_>) -> Result<(), InstanceError> {
        self.server.remove(&self.root(shown.name));
        let made = self.add(shown);
        self.tell(shown.name, Became::Added);
        made
    }

    fn add(&self, shown: &Shown<'_>) -> Result<(), InstanceError> {
        let root = format!("{}/{}", self.folder, shown.name);
        self.object(&root, &id(self.folder), shown.name)?;
        self.property(&root, "ApplicationUri", shown.application_uri)?;
        let mut objects = BTreeSet::new();
        for found in &shown.mirror.methods {
            let handler = Arc::new(Passing {
                client: shown.client.clone(),
                connects: shown.connects,
                object: found.object.clone(),
                method: found.method.clone(),
            });
            match self.method(&root, found, &mut objects, handler) {
                // Two that differ in their namespaces alone: the first is shown.
                Err(InstanceError::Taken(node)) => debug!(%node, "a method is not shown"),
                made => made?,
            }
        }
        Ok(())
    }

    /// Shows nothing more of a server, and tells clients.
    pub(crate) fn remove(&self, name: &str) {
        self.server.remove(&self.root(name));
        self.tell(name, Became::Deleted);
    }

    /// The object of a server.
    fn root(&self, name: &str) -> NodeId {
        id(&format!("{}/{name}", self.folder))
    }

    fn tell(&self, name: &str, became: Became) {
        self.server.tell_changes(&[ModelChange {
            node: self.root(name),
            type_definition: ObjectTypeId::FolderType.into(),
            became,
        }]);
    }

    fn method(
        &self,
        root: &str,
        found: &Found,
        objects: &mut BTreeSet<String>,
        handler: Arc<dyn MethodHandler>,
    ) -> Result<(), InstanceError> {
        let Some((name, above)) = found.path.split_last() else {
            return Ok(());
        };
        let mut parent = root.to_owned();
        for step in above {
            let path = format!("{parent}/{step}");
            if objects.insert(path.clone()) {
                self.object(&path, &id(&parent), step)?;
            }
            parent = path;
        }
        let path = format!("{parent}/{name}()");
        let spec = MethodSpec {
            node_id: id(&path),
            browse_name: QualifiedName::new(OWN, name.as_str()),
            object: id(&parent),
            arguments: (id(&format!("{path}.in")), id(&format!("{path}.out"))),
            takes: found.takes.clone(),
            gives: found.gives.clone(),
        };
        self.server.add_method(spec, handler)
    }

    /// An object with nothing below it.
    pub(crate) fn object(
        &self,
        path: &str,
        parent: &NodeId,
        name: &str,
    ) -> Result<(), InstanceError> {
        self.server.add_object(&ObjectSpec {
            node_id: id(path),
            browse_name: QualifiedName::new(OWN, name),
            display_name: LocalizedText::new("", name),
            type_definition: ObjectTypeId::FolderType.into(),
            parent: parent.clone(),
            reference: ReferenceTypeId::Organizes.into(),
            event_notifier: false,
        })
    }

    /// A property of an object of ours, with a text.
    pub(crate) fn property(
        &self,
        object: &str,
        name: &str,
        text: &str,
    ) -> Result<NodeId, InstanceError> {
        let node_id = id(&format!("{object}.{name}"));
        self.server.add_variable(&VariableSpec {
            node_id: node_id.clone(),
            browse_name: QualifiedName::new(OWN, name),
            display_name: LocalizedText::new("", name),
            type_definition: VariableTypeId::PropertyType.into(),
            parent: id(object),
            reference: ReferenceTypeId::HasProperty.into(),
            data_type: DataTypeId::String.into(),
            value_rank: -1,
            value: DataValue::new_now(Variant::from(text)),
            writable: false,
        })?;
        Ok(node_id)
    }
}

/// The NodeId of a path.
pub(crate) fn id(path: &str) -> NodeId {
    NodeId::new(OWN, path)
}

/// Passes a call on.
struct Passing {
    client: Client,
    connects: u64,
    object: NodeId,
    method: NodeId,
}

#[async_trait]
impl MethodHandler for Passing {
    async fn call(&self, request: MethodRequest) -> Result<Vec<Variant>, Refusal> {
        let options = CallOptions {
            // So that who asked hears of it from us.
            within: LONGEST_REQUEST * 9 / 10,
            connection: Some(self.connects),
        };
        let target = (&self.object, &self.method);
        let called = self.client.call_within(target, request.arguments, options);
        called.await.map_err(refusal)
    }
}

fn refusal(error: CallError) -> Refusal {
    match error {
        CallError::Refused { status, arguments } if arguments.is_empty() => Refusal::Status(status),
        CallError::Refused { arguments, .. } => Refusal::Arguments(arguments),
        CallError::Client(ClientError::NotConnected(_)) => {
            Refusal::Status(StatusCode::BadNoCommunication)
        }
        CallError::Client(ClientError::Status(status)) => Refusal::Status(status),
        // Nobody knows whether it was executed: it was sent, and the answer has not come.
        CallError::Client(ClientError::Lost(_) | ClientError::Answer(_)) => {
            Refusal::Status(StatusCode::BadRequestInterrupted)
        }
    }
}

/// The namespace of the ApplicationUri.
const OWN: u16 = 1;
