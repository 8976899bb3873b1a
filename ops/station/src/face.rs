//! A server that shows the nodes of other servers and forwards their calls and writes.

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use plant_opcua::changes::{Became, ModelChange};
use plant_opcua::client::{CallOptions, ClientError, OpcUaClient};
use plant_opcua::limits::ClientLimits;
use plant_opcua::server::{
    EndpointUrl, InstanceError, MethodHandler, MethodRefusal, MethodRequest, ObjectSpec,
    OpcUaServer, ServerBuilder, ServerConfig, ServerError, ServerSecurity, SessionCaller,
    SessionPresence, VariableSpec, WriteHandler, WriteRequest,
};
use plant_opcua::supervision::SET_FIELDS;
use plant_opcua::types::{
    DataTypeId, DataValue, LocalizedText, NodeId, ObjectId, ObjectTypeId, QualifiedName,
    ReferenceTypeId, StatusCode, VariableTypeId, Variant,
};
use tracing::warn;

use crate::callers::{AllCallers, CallerCheck, Callers};

/// A face of a station: its server on a level.
#[derive(Clone)]
pub(crate) struct Face {
    pub(crate) server: OpcUaServer,
    /// The folder of the servers that are shown.
    folder: &'static str,
    admission: CallerCheck,
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
    pub(crate) admission: CallerCheck,
    pub(crate) clients: ClientLimits,
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
            (None, _) => vec![ServerSecurity::None],
            (Some(_), true) => vec![ServerSecurity::None, ServerSecurity::Basic256Sha256],
            (Some(_), false) => vec![ServerSecurity::Basic256Sha256],
        };
        let config = ServerConfig {
            security,
            pki,
            trust_unknown_clients: trust_any,
            clients,
            // A call that waits for a session at the device is not delivered late.
            obeys_timeout_hints: true,
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

    /// Removes a server, and notifies clients.
    pub(crate) fn remove(&self, name: &str) {
        let root = id(&format!("{}/{name}", self.folder));
        self.server.remove(&root);
        self.tell(&root, Became::Deleted);
    }

    /// Returns the folder of the servers that are shown.
    pub(crate) fn folder(&self) -> &'static str {
        self.folder
    }

    pub(crate) fn admission(&self) -> &CallerCheck {
        &self.admission
    }

    /// Notifies clients that a server was added, changed or removed.
    pub(crate) fn tell(&self, root: &NodeId, became: Became) {
        self.server.tell_changes(&[ModelChange {
            node: root.clone(),
            type_definition: ObjectTypeId::FolderType.into(),
            became,
        }]);
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

/// Forwards requests in the session that their caller has at the server.
pub(crate) struct Passing {
    pub(crate) admission: CallerCheck,
    pub(crate) callers: Arc<Callers>,
}

impl Passing {
    /// Checks that calls and writes of a caller are forwarded.
    fn check(&self, caller: &SessionCaller, what: &str) -> Result<(), StatusCode> {
        self.admission.check(caller).inspect_err(|_| {
            warn!(
                application = ?caller.application_uri, user = ?caller.user, what,
                "refused request: the caller needs the role operator"
            );
        })
    }

    /// Checks that a caller may set the fields of the servers behind the station.
    fn check_configures(&self, caller: &SessionCaller) -> Result<(), StatusCode> {
        self.admission.check_configures(caller).inspect_err(|_| {
            warn!(
                application = ?caller.application_uri, user = ?caller.user,
                "refused {SET_FIELDS}: the caller needs the role configure_admin"
            );
        })
    }

    /// Returns the session of a checked caller at the server.
    async fn session(
        &self,
        caller: &SessionCaller,
        presence: &SessionPresence,
    ) -> Result<OpcUaClient, StatusCode> {
        let client = self.callers.client_of(caller.session).await;
        let client = client.map_err(status)?;
        if !presence.lasts() {
            // The caller disconnected while its session at the server was created.
            self.callers.gone(caller.session);
            return Err(StatusCode::BadSessionClosed);
        }
        Ok(client)
    }
}

/// Forwards calls of a method.
pub(crate) struct Calling {
    pub(crate) passing: Passing,
    pub(crate) object: NodeId,
    pub(crate) method: NodeId,
    /// Whether the method configures the server.
    pub(crate) configures: bool,
}

#[async_trait]
impl MethodHandler for Calling {
    fn longest(&self) -> Duration {
        LONGEST_CALL
    }

    async fn call(&self, request: MethodRequest) -> Result<Vec<Variant>, MethodRefusal> {
        // The role to configure does not include the role of an operator.
        match self.configures {
            true => self.passing.check_configures(&request.caller)?,
            false => self.passing.check(&request.caller, &request.name)?,
        }
        let session = self.passing.session(&request.caller, &request.presence);
        let client = session.await.map_err(MethodRefusal::Status)?;
        let options = CallOptions {
            // The forwarded call times out first, so that the caller receives its status.
            within: LONGEST_CALL * 9 / 10,
            connection: None,
        };
        let target = (&self.object, &self.method);
        let called = client.call_result(target, request.arguments, options);
        match called.await {
            Ok(result) => Err(MethodRefusal::PassedOn(Box::new(result))),
            Err(error) => Err(MethodRefusal::Status(status(error))),
        }
    }
}

/// Forwards writes of a variable.
pub(crate) struct ForwardedWrites {
    pub(crate) passing: Passing,
    pub(crate) node: NodeId,
}

#[async_trait]
impl WriteHandler for ForwardedWrites {
    async fn write(&self, request: WriteRequest) -> Result<(), StatusCode> {
        let what = request.node.to_string();
        self.passing.check(&request.caller, &what)?;
        let session = self.passing.session(&request.caller, &request.presence);
        let client = session.await?;
        let value = request.value.value.unwrap_or_default();
        let written = client.write(&[(self.node.clone(), value)]).await;
        match written.map_err(status)?.first() {
            Some(written) if written.is_good() => Ok(()),
            Some(refused) => Err(*refused),
            None => Err(StatusCode::BadUnexpectedError),
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
