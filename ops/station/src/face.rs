//! A server that shows the methods of other servers and forwards their calls.

use std::collections::BTreeSet;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use plant_opcua::changes::{Became, ModelChange};
use plant_opcua::client::{CallOptions, ClientError};
use plant_opcua::limits::ClientLimits;
use plant_opcua::server::{
    EndpointUrl, InstanceError, MethodHandler, MethodRequest, MethodSpec, ObjectSpec, Refusal,
    Security, Server, ServerBuilder, ServerConfig, ServerError, VariableSpec,
};
use plant_opcua::types::{
    DataTypeId, DataValue, LocalizedText, NodeId, ObjectId, ObjectTypeId, QualifiedName,
    ReferenceTypeId, StatusCode, VariableTypeId, Variant,
};
use tracing::{debug, warn};

use crate::callers::{Admission, AllCallers, Callers};
use crate::mirror::{Found, Mirror};

/// A face of a station: its server on a level.
#[derive(Clone)]
pub(crate) struct Face {
    pub(crate) server: Server,
    /// The folder of the servers that are shown.
    folder: &'static str,
    admission: Admission,
    callers: AllCallers,
}

/// The settings of a face.
pub(crate) struct FaceSettings {
    pub(crate) application_uri: String,
    pub(crate) name: String,
    pub(crate) endpoint: EndpointUrl,
    /// The certificate store, which contains the certificate and the key of the station.
    pub(crate) pki: Option<PathBuf>,
    pub(crate) allow_unsecured: bool,
    pub(crate) trust_any: bool,
    /// Checks callers.
    pub(crate) admission: Admission,
    pub(crate) clients: ClientLimits,
}

/// A server to be shown.
pub(crate) struct Shown<'a> {
    /// Its name below the folder.
    pub(crate) name: &'a str,
    pub(crate) application_uri: &'a str,
    pub(crate) mirror: &'a Mirror,
    pub(crate) callers: &'a Arc<Callers>,
    /// The number of the connection for which its NodeIds are valid.
    pub(crate) connects: u64,
}

impl Face {
    /// Binds the port; clients are served after the server is started.
    pub(crate) fn open(settings: FaceSettings, folder: &'static str) -> Result<Self, ServerError> {
        let FaceSettings {
            application_uri,
            name,
            endpoint,
            pki,
            allow_unsecured,
            trust_any,
            admission,
            clients,
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
            clients,
            ..ServerConfig::new(&application_uri, &name, endpoint)
        };
        let users = Arc::clone(&admission.users);
        let server = ServerBuilder::new(config).users(users).build()?;
        let callers = AllCallers::default();
        let leaving = callers.clone();
        server.on_session_closed(move |session| leaving.gone(session));
        let face = Self {
            server,
            folder,
            admission,
            callers,
        };
        let made = face.object(folder, &ObjectId::ObjectsFolder.into(), folder);
        made.map_err(|error| ServerError::Configuration(error.to_string()))?;
        Ok(face)
    }

    /// Closes the sessions at a server when the sessions of its callers at this face close.
    pub(crate) fn follow(&self, callers: &Arc<Callers>) {
        self.callers.add(callers);
    }

    /// Shows the methods of a server, replacing the methods shown before, and notifies clients.
    ///
    /// # Errors
    /// The folder does not exist.
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
                admission: self.admission.clone(),
                callers: Arc::clone(shown.callers),
                connects: shown.connects,
                object: found.object.clone(),
                method: found.method.clone(),
            });
            match self.method(&root, found, &mut objects, handler) {
                // Methods that differ only in their namespaces: the first is shown.
                Err(InstanceError::Taken(node)) => debug!(%node, "cannot show a method"),
                made => made?,
            }
        }
        Ok(())
    }

    /// Removes a server, and notifies clients.
    pub(crate) fn remove(&self, name: &str) {
        self.server.remove(&self.root(name));
        self.tell(name, Became::Deleted);
    }

    /// Returns the NodeId of a server's object.
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

    /// Adds an object without children.
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

    /// Adds a property with a text to an object of the face.
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

/// Returns the NodeId of a path.
pub(crate) fn id(path: &str) -> NodeId {
    NodeId::new(OWN, path)
}

/// Forwards a call in the session that its caller has at the server.
struct Passing {
    admission: Admission,
    callers: Arc<Callers>,
    connects: u64,
    object: NodeId,
    method: NodeId,
}

#[async_trait]
impl MethodHandler for Passing {
    fn longest(&self) -> Duration {
        LONGEST_CALL
    }

    async fn call(&self, request: MethodRequest) -> Result<Vec<Variant>, Refusal> {
        let caller = &request.caller;
        self.admission.check(caller).inspect_err(|_| {
            warn!(
                application = ?caller.application_uri, user = ?caller.user, method = request.name,
                "refused call: the caller needs the role operator"
            );
        })?;
        let options = CallOptions {
            // The forwarded call times out first, so that the caller receives its status.
            within: LONGEST_CALL * 9 / 10,
            connection: None,
        };
        let target = (&self.object, &self.method);
        let client = self.callers.client_of(caller.session, self.connects);
        let client = client
            .await
            .map_err(|error| Refusal::Status(status(error)))?;
        if !request.presence.lasts() {
            // The caller disconnected while its session at the server was created.
            self.callers.gone(caller.session);
            return Err(Refusal::Status(StatusCode::BadSessionClosed));
        }
        let called = client.call_result(target, request.arguments, options);
        match called.await {
            Ok(result) => Err(Refusal::PassedOn(Box::new(result))),
            Err(error) => Err(Refusal::Status(status(error))),
        }
    }
}

/// Returns the status of a call without a result.
fn status(error: ClientError) -> StatusCode {
    match error {
        ClientError::NotConnected(_) => StatusCode::BadNoCommunication,
        ClientError::Status(status) => status,
        // The request was sent and there is no response: it is unknown whether the method was
        // executed.
        ClientError::Lost(_) | ClientError::Answer(_) => StatusCode::BadRequestInterrupted,
    }
}

/// Time limit of a forwarded call. A caller with a shorter timeout gives up earlier.
const LONGEST_CALL: Duration = Duration::from_secs(300);
/// The namespace of the ApplicationUri.
const OWN: u16 = 1;
