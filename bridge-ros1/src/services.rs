//! Services of the ROS 1 graph that values of the space call, and calls of the space as services.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use bridge_node::{
    Asker, CallFault, CallGraph, ExecutorGraph, GraphError, MayHaveRun, ServiceCall, ServiceGraph,
};
use bytes::Bytes;
use messages::{MessageType, ServiceType, TextKind, TypeName, Wire};
use tcpros::{
    Node, ServiceClient, ServiceClientOptions, ServiceError, ServiceOptions, ServiceServer,
};
use tokio::sync::Mutex;
use uadp::BuiltinType;

use crate::definitions::Ros1Definitions;
use crate::ends::Ends;

/// A node with its message definitions and action clients and servers.
pub(crate) struct Ros1Graph<'p> {
    pub(crate) node: &'p Node,
    pub(crate) definitions: &'p mut Ros1Definitions,
    pub(crate) ends: &'p mut Ends,
}

impl ServiceGraph for Ros1Graph<'_> {
    type Client = ServiceCaller;

    const WIRE: Wire = Wire::Ros1;

    fn service_type(&mut self, name: &TypeName) -> Result<Arc<ServiceType>, GraphError> {
        self.definitions.known.find_service(name).map_err(|error| {
            let wanted = format!(
                "service connections do not carry the definition: a folder below ROS_PACKAGE_PATH must \
                 contain {}/srv/{}.srv",
                name.package(),
                name.name()
            );
            let of = (TextKind::Service, name);
            GraphError::MissingType(self.definitions.known.explain_missing(of, &error, &wanted))
        })
    }

    fn carrier(
        &mut self,
        builtin: BuiltinType,
        array: bool,
    ) -> Result<Option<Arc<MessageType>>, GraphError> {
        let name = self
            .definitions
            .known
            .registry()
            .standard_type(builtin, array);
        let found = name.map(|name| self.definitions.get(&name));
        Ok(found.transpose()?)
    }

    fn client(
        &mut self,
        service: &str,
        service_type: &ServiceType,
        timeout: Duration,
    ) -> Result<ServiceCaller, GraphError> {
        let options = ServiceClientOptions {
            md5sum: Some(service_type.md5().to_owned()),
            type_name: Some(service_type.name().to_string()),
            persistent: true,
            timeout,
            ..ServiceClientOptions::default()
        };
        let client = self.node.service_client(service, options);
        client.map(ServiceCaller::from).map_err(GraphError::library)
    }
}

impl CallGraph for Ros1Graph<'_> {
    type Server = ServiceServer;

    const TELLS_FAULTS: bool = true;

    fn offer(
        &mut self,
        service: &str,
        service_type: &Arc<ServiceType>,
        asker: Asker,
    ) -> Result<ServiceServer, GraphError> {
        let service_type = tcpros::ServiceTypeSum {
            name: service_type.name().to_string(),
            md5sum: service_type.md5().to_owned(),
            request_type: service_type.request().name().to_string(),
            response_type: service_type.response().name().to_string(),
        };
        let options = ServiceOptions {
            handler_timeout: ANSWERED,
            ..ServiceOptions::default()
        };
        let handler = move |request: tcpros::ServiceRequest| asker.ask(request.bytes);
        let server = self
            .node
            .advertise_service(service, service_type, options, handler);
        server.map_err(GraphError::library)
    }
}

impl ExecutorGraph for Ros1Graph<'_> {
    type Executor = ServiceExecutor;

    fn executor(
        &mut self,
        service: &str,
        service_type: &ServiceType,
        timeout: Duration,
    ) -> Result<ServiceExecutor, GraphError> {
        let client = |persistent| {
            let options = ServiceClientOptions {
                md5sum: Some(service_type.md5().to_owned()),
                type_name: Some(service_type.name().to_string()),
                persistent,
                timeout,
                ..ServiceClientOptions::default()
            };
            let client = self.node.service_client(service, options);
            client.map(ServiceCaller::from).map_err(GraphError::library)
        };
        Ok(ServiceExecutor {
            kept: client(true)?,
            more: client(false)?,
            turn: Mutex::new(()),
        })
    }
}

/// Calls a service over a persistent connection, and over further connections while it is in use,
/// because a connection carries one call at a time.
#[derive(Debug)]
pub(crate) struct ServiceExecutor {
    kept: ServiceCaller,
    more: ServiceCaller,
    turn: Mutex<()>,
}

impl ServiceCall for ServiceExecutor {
    fn service(&self) -> &str {
        self.kept.service()
    }

    async fn call_by(&self, request: Bytes, start_by: Option<Instant>) -> Result<Bytes, CallFault> {
        match self.turn.try_lock() {
            Ok(_turn) => self.kept.call_by(request, start_by).await,
            Err(_) => self.more.call_by(request, start_by).await,
        }
    }
}

/// Calls a service.
#[derive(Debug)]
pub(crate) struct ServiceCaller {
    client: ServiceClient,
    /// The requests that had been sent when the last call began.
    sent_before: AtomicU64,
}

impl From<ServiceClient> for ServiceCaller {
    fn from(client: ServiceClient) -> Self {
        Self {
            client,
            sent_before: AtomicU64::new(0),
        }
    }
}

impl ServiceCall for ServiceCaller {
    fn service(&self) -> &str {
        self.client.service()
    }

    fn has_request(&self) -> bool {
        self.client.requests_sent() > self.sent_before.load(Ordering::Relaxed)
    }

    async fn call_by(&self, request: Bytes, start_by: Option<Instant>) -> Result<Bytes, CallFault> {
        let before = self.client.requests_sent();
        self.sent_before.store(before, Ordering::Relaxed);
        let called = self.client.call_by(request, start_by.map(Into::into)).await;
        called.map_err(|error| CallFault {
            text: error.to_string(),
            may_pass: may_pass(&error),
            ran: if matches!(error, ServiceError::Failed { .. }) {
                MayHaveRun::Yes
            } else if error.may_have_run() {
                MayHaveRun::Perhaps
            } else {
                MayHaveRun::No
            },
        })
    }
}

/// Time limit of a request, which is never reached: the request ends with the timeout of its call.
const ANSWERED: Duration = Duration::from_secs(24 * 3600);

/// Returns true if the same call may succeed later without changes other than the return of the
/// service.
fn may_pass(error: &ServiceError) -> bool {
    matches!(
        error,
        ServiceError::NotAdvertised { .. }
            | ServiceError::Master { .. }
            | ServiceError::NoConnection { .. }
            | ServiceError::Timeout { .. }
            | ServiceError::Lost { .. }
    )
}
