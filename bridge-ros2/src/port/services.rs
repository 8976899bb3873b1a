//! Implements services of the domain, which values of the space call, and calls of the space
//! offered as services.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use bridge_node::{
    Asker, CallFault, CallGraph, ExecutorGraph, GraphError, MayHaveRun, ServiceCall, ServiceGraph,
};
use bytes::Bytes;
use mappings::SpaceId;
use messages::{MessageType, ServiceType, TextKind, TypeName, Wire};
use ros2_node::domain::Domain;
use ros2_node::parameters::{DeclaredParameter, ParameterValue};
use ros2_node::service::{
    Recall, ServiceClient, ServiceClientOptions, ServiceError, ServiceName, ServiceOptions,
    ServicePeers, ServiceRequest, ServiceServer,
};
use uadp::BuiltinType;

use crate::definitions::Ros2Definitions;

/// A DDS domain and the known type definitions.
pub(super) struct Ros2Graph<'p> {
    pub(super) domain: &'p Domain,
    pub(super) peers: &'p ServicePeers,
    pub(super) definitions: &'p mut Ros2Definitions,
}

impl ServiceGraph for Ros2Graph<'_> {
    type Client = DomainServiceClient;

    const WIRE: Wire = Wire::Cdr;

    fn service_type(&mut self, name: &TypeName) -> Result<Arc<ServiceType>, GraphError> {
        self.definitions.known.find_service(name).map_err(|error| {
            let wanted = format!(
                "discovery does not carry the definition of a service: a prefix in AMENT_PREFIX_PATH must \
                 contain share/{}/srv/{}.srv",
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
        let found = name.map(|name| self.definitions.here(&name)).transpose()?;
        Ok(found.map(|found| found.message_type))
    }

    fn client(
        &mut self,
        service: &str,
        service_type: &ServiceType,
        timeout: Duration,
    ) -> Result<DomainServiceClient, GraphError> {
        let service = ServiceName::new(service, service_type.name());
        if let Some(hashes) = self.definitions.service_type_hashes(service_type.name()) {
            service.announce(self.domain, &hashes);
        }
        let options = ServiceClientOptions {
            timeout: Some(timeout),
            ..ServiceClientOptions::default()
        };
        ServiceClient::open(self.domain, self.peers, &service, options)
            .map(DomainServiceClient::from)
            .map_err(GraphError::library)
    }
}

impl ExecutorGraph for Ros2Graph<'_> {
    type Executor = DomainServiceClient;

    fn executor(
        &mut self,
        service: &str,
        service_type: &ServiceType,
        timeout: Duration,
    ) -> Result<DomainServiceClient, GraphError> {
        self.client(service, service_type, timeout)
    }
}

impl CallGraph for Ros2Graph<'_> {
    type Server = ServiceServer;

    // A ROS 2 service reports a fault only by the missing reply.
    const TELLS_FAULTS: bool = false;

    fn offer(
        &mut self,
        service: &str,
        service_type: &Arc<ServiceType>,
        asker: Asker,
    ) -> Result<ServiceServer, GraphError> {
        let service = ServiceName::new(service, service_type.name());
        if let Some(hashes) = self.definitions.service_type_hashes(service_type.name()) {
            service.announce(self.domain, &hashes);
        }
        let options = ServiceOptions {
            max_handled: HANDLED,
            // Each request ends with the timeout of its call.
            handler_timeout: None,
            ..ServiceOptions::default()
        };
        let handler = move |request: ServiceRequest| asker.ask(request.bytes);
        ServiceServer::open(self.domain, self.peers, &service, options, handler)
            .map_err(GraphError::library)
    }
}

/// Returns the parameters of the bridge, as `ros2 param` lists them.
pub(super) fn parameters(own: SpaceId, domain: u16, sim_time: bool) -> Vec<DeclaredParameter> {
    let parameter = |name: &str, value, description: &str, read_only| DeclaredParameter {
        name: name.to_owned(),
        value,
        description: description.to_owned(),
        read_only,
    };
    let (space, domain) = (i64::from(u16::from(own)), i64::from(domain));
    vec![
        parameter(
            "use_sim_time",
            ParameterValue::Bool(sim_time),
            "Whether stamps of messages made here are of /clock; said at the start",
            true,
        ),
        parameter(
            "space",
            ParameterValue::Integer(space),
            "The space whose values are produced in this domain",
            true,
        ),
        parameter(
            "domain",
            ParameterValue::Integer(domain),
            "The DDS domain",
            true,
        ),
    ]
}

/// Calls a service.
#[derive(Debug)]
pub(super) struct DomainServiceClient {
    client: ServiceClient,
    /// The most recent call.
    under_way: Mutex<Recall>,
}

impl From<ServiceClient> for DomainServiceClient {
    fn from(client: ServiceClient) -> Self {
        Self {
            client,
            under_way: Mutex::default(),
        }
    }
}

impl DomainServiceClient {
    fn under_way(&self) -> MutexGuard<'_, Recall> {
        // The handle is consistent between statements.
        let lock = self.under_way.lock();
        lock.unwrap_or_else(PoisonError::into_inner)
    }
}

impl ServiceCall for DomainServiceClient {
    fn service(&self) -> &str {
        self.client.service()
    }

    fn has_request(&self) -> bool {
        self.under_way().is_sent()
    }

    async fn call_by(&self, request: Bytes, start_by: Option<Instant>) -> Result<Bytes, CallFault> {
        let under_way = Recall::after(start_by.map(Into::into));
        *self.under_way() = under_way.clone();
        let call = self.client.call_recallable(request, None, &under_way);
        let replied = call.await.map(|replied| replied.reply);
        replied.map_err(|error| CallFault {
            text: error.to_string(),
            // A server of another type may be replaced by a server of the right type, as may a
            // missing server.
            may_pass: matches!(
                error,
                ServiceError::Timeout { .. }
                    | ServiceError::Lost { .. }
                    | ServiceError::OtherType { .. }
            ),
            ran: match error.may_have_run() {
                true => MayHaveRun::Perhaps,
                false => MayHaveRun::No,
            },
        })
    }
}

/// Maximum number of concurrent requests of a service, equal to the limit of a call.
const HANDLED: usize = 256;
