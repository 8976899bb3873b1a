//! The parameters of the bridge's node, so that `ros2 param` of either vendor lists, gets, sets and
//! describes them.
//!
//! Six services below the node's name and the topic `/parameter_events` (rcl_interfaces).
//! Parameters are declared at the start and keep their types.

mod store;
mod value;

use std::sync::{Arc, Mutex, PoisonError};

use bytes::Bytes;
use messages::{Dialect, TypeName, TypeRegistry};
use rustdds::policy::{Durability, History};
use rustdds::{QosPolicies, QosPolicyBuilder};
use tracing::{info, warn};

pub use self::store::DeclaredParameter;
pub use self::value::ParameterValue;

use self::store::{ParameterService, ParameterStore};
use crate::cdr::Malformed;
use crate::clock::unix_nanos;
use crate::domain::{Domain, DomainError};
use crate::raw::{Payload, PayloadWriter};
use crate::service::{ServiceCounters, ServiceName, ServiceOptions, ServicePeers, ServiceServer};

/// Serves the parameters of a node. Dropping it withdraws the services.
#[derive(Debug)]
pub struct ParameterServer {
    shared: Arc<ParametersShared>,
    services: Vec<ServiceServer>,
}

struct ParametersShared {
    node: String,
    store: Mutex<ParameterStore>,
    events: Mutex<PayloadWriter>,
}

impl ParameterServer {
    /// Declares `parameters` for the domain's node and serves them. Call this on a tokio runtime.
    ///
    /// # Errors
    /// [`DomainError::Endpoint`].
    pub fn open(
        domain: &Domain,
        peers: &ServicePeers,
        parameters: Vec<DeclaredParameter>,
    ) -> Result<Self, DomainError> {
        let node = domain.node_name();
        let bundle = TypeRegistry::bundle(Dialect::Ros2);
        let event = TypeName::new("rcl_interfaces", "ParameterEvent");
        if let Some(hash) = event.ok().and_then(|name| bundle.type_hash(&name).ok()) {
            domain.learn_type_hash(EVENT_TYPE, hash.to_string());
        }
        let events = domain.open_writer(EVENTS, EVENT_TYPE, &policies())?;
        let shared = Arc::new(ParametersShared {
            node: node.clone(),
            store: Mutex::new(ParameterStore::new(parameters)),
            events: Mutex::new(events),
        });
        let mut services = Vec::new();
        for question in ParameterService::ALL {
            let (name, service_type) = question.names();
            let Ok(service_type) = TypeName::new("rcl_interfaces", service_type) else {
                continue;
            };
            let service = ServiceName::new(&format!("{node}/{name}"), &service_type);
            if let Ok(hashes) = bundle.service_type_hashes(&service_type) {
                service.announce(domain, &hashes);
            }
            let shared = Arc::clone(&shared);
            services.push(ServiceServer::open(
                domain,
                peers,
                &service,
                ServiceOptions::default(),
                move |request| {
                    let answer = shared.answer(question, &request.bytes);
                    async { answer.map_err(|Malformed| "a truncated request".to_owned()) }
                },
            )?);
        }
        Ok(Self { shared, services })
    }

    /// Returns the sums of the counters of its services.
    #[must_use]
    pub fn counters(&self) -> ServiceCounters {
        let each = self.services.iter().map(ServiceServer::counters);
        each.fold(ServiceCounters::default(), ServiceCounters::plus)
    }

    /// Returns the current value of a parameter; `None` if it is not declared.
    #[must_use]
    pub fn value(&self, name: &str) -> Option<ParameterValue> {
        let store = self.shared.store.lock();
        let store = store.unwrap_or_else(PoisonError::into_inner);
        store.get(name).map(|parameter| parameter.value.clone())
    }
}

impl ParametersShared {
    fn answer(&self, question: ParameterService, request: &[u8]) -> Result<Bytes, Malformed> {
        let (answer, changed) = self
            .store
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .answer(question, request)?;
        if !changed.is_empty() {
            for DeclaredParameter { name, value, .. } in &changed {
                info!(parameter = name, ?value, "parameter set");
            }
            let event = store::event(&self.node, unix_nanos(), &changed);
            let written = Payload::to_write(event).map(|event| {
                let events = self.events.lock().unwrap_or_else(PoisonError::into_inner);
                events.write(event, None).is_ok()
            });
            if written != Ok(true) {
                warn!("cannot publish a parameter change on /parameter_events");
            }
        }
        Ok(answer)
    }
}

impl std::fmt::Debug for ParametersShared {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Shared")
            .field("node", &self.node)
            .field("store", &self.store)
            .finish_non_exhaustive()
    }
}

/// Returns rmw's default policies for parameter events, which are reliable and volatile.
fn policies() -> QosPolicies {
    QosPolicyBuilder::new()
        .reliable(rustdds::Duration::ZERO)
        .durability(Durability::Volatile)
        .history(History::KeepLast { depth: 100 })
        .build()
}

const EVENTS: &str = "rt/parameter_events";
const EVENT_TYPE: &str = "rcl_interfaces::msg::dds_::ParameterEvent_";
