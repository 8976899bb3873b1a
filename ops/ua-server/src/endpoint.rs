//! The endpoints of the server and their security.

use std::net::{SocketAddr, TcpListener};
use std::sync::Arc;

use bridge_node::{Failure, FailureKind};
use mappings::{Server, ServerLimits, ServerSecurityPolicy};
use opcua::server::{Limits, ServerBuilder, ServerConfig, ServerHandle};
use plant_opcua::configuration::Configuration;
use plant_opcua::door::{Door, UnknownClients};
use plant_opcua::endpoint::EndpointUrl;
use plant_opcua::enrolment::{Applicant, Enrolment, Invitation};
use plant_opcua::limits::{self, ClientLimits};
use plant_opcua::patches;
use plant_opcua::pki::{OWN_CERTIFICATE, OWN_KEY, Pki};
use plant_opcua::server::ServerSecurity;
use serde_json::{Value, json};
use tokio::runtime::Runtime;
use tracing::warn;

use crate::{identity, redundant, reverse};

/// Returns whether programs of this host only reach a server that listens at `address`.
pub(crate) fn is_local(described: &Server, address: SocketAddr) -> bool {
    address.ip().is_loopback() && described.connects_to_own_host_only()
}

/// Returns the security policies that the server offers at `address`, as the mapping defines them.
pub(crate) fn security(described: &Server, address: SocketAddr) -> Vec<ServerSecurity> {
    let policies = described.policies(is_local(described, address));
    let security = policies.into_iter().map(|policy| match policy {
        ServerSecurityPolicy::None => ServerSecurity::None,
        ServerSecurityPolicy::Basic256Sha256 => ServerSecurity::Basic256Sha256,
        ServerSecurityPolicy::Aes128Sha256RsaOaep => ServerSecurity::Aes128Sha256RsaOaep,
        ServerSecurityPolicy::Aes256Sha256RsaPss => ServerSecurity::Aes256Sha256RsaPss,
    });
    security.collect()
}

/// Builds the server that the mapping describes, reached at `url`. `port` is the port of the
/// listener; it differs from the port of the URL if that is 0.
pub(crate) fn server(
    described: &Server,
    (url, port): (&EndpointUrl, u16),
    security: &[ServerSecurity],
) -> ServerBuilder {
    let host = url.advertised_host();
    let mut builder = ServerBuilder::new()
        .without_node_managers()
        .application_name(identity::APPLICATION_NAME)
        .application_uri(described.application_uri.as_str())
        .product_uri(identity::PRODUCT_URI)
        .build_info(identity::build_info())
        .diagnostics_enabled(true)
        .discovery_urls(vec![url.advertised(port)])
        .host(host)
        .port(port)
        .certificate_path(OWN_CERTIFICATE)
        .private_key_path(OWN_KEY)
        .subscription_poll_interval_ms(limits::POLL_MS)
        // The library lets a request take the longer of this timeout and the client's timeout, and
        // the client's timeout has to hold. Each call has its own deadline.
        .max_timeout_ms(0)
        .limits(within(described.limits));
    builder.config_mut().reverse_connect_failure_delay_ms = REVERSE_PAUSE_MS;
    for security in security {
        for (name, endpoint) in security.endpoints(url.path()) {
            builder = builder.add_endpoint(name, endpoint);
        }
    }
    list_others(builder.config_mut(), described);
    builder
}

/// Lets FindServers return the other servers of a redundant set (OPC 10000-4, 6.6.2.4.5). The
/// unpatched library has no setting for them, and returns its own server only.
fn list_others(config: &mut ServerConfig, described: &Server) {
    let others = redundant::others(described).map(|(uri, endpoint)| {
        json!({
            "application_uri": uri,
            "discovery_urls": [endpoint.to_string()],
        })
    });
    let others: Vec<Value> = others.collect();
    if others.is_empty() {
        return;
    }
    let listed = serde_json::to_value(&*config).and_then(|mut settings| {
        if let Value::Object(settings) = &mut settings {
            settings.insert("redundant_servers".to_owned(), others.into());
        }
        serde_json::from_value(settings)
    });
    match listed {
        Ok(listed) => *config = listed,
        Err(error) => warn!(%error, "FindServers returns this server only"),
    }
}

/// Returns the limits of resources of clients.
pub(crate) fn within(told: ServerLimits) -> Limits {
    let mut limits = limits::server(clients(told));
    limits.max_history_continuation_points = MOST_HISTORY_GOES_ON;
    limits.operational.max_nodes_per_history_read_events = MOST_EVENT_HISTORIES;
    if let Some(subscriptions) = told.subscriptions {
        limits.subscriptions.max_subscriptions_per_session = usize::from(subscriptions);
    }
    if let Some(items) = told.items {
        limits.subscriptions.max_monitored_items_per_sub = usize::from(items);
    }
    if let Some(operations) = told.operations.map(usize::from) {
        limits.operational.max_nodes_per_read = operations;
        limits.operational.max_nodes_per_write = operations;
        limits.operational.max_monitored_items_per_call = operations;
    }
    limits
}

/// Returns the number of clients that the mapping allows.
pub(crate) fn clients(told: ServerLimits) -> ClientLimits {
    ClientLimits::given([
        told.sessions,
        told.sessions_per_address,
        told.connections,
        told.connections_per_address,
    ])
}

/// Creates the threads of the server and registers the listener with them.
pub(crate) fn threads(
    listener: TcpListener,
) -> Result<(Runtime, tokio::net::TcpListener), Failure> {
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(SERVER_THREADS)
        .thread_name("opcua")
        .enable_all()
        .build()
        .map_err(io_fault)?;
    let listener = taken_by(&runtime, listener).map_err(io_fault)?;
    Ok((runtime, listener))
}

/// Registers a listener with the threads of the server.
fn taken_by(runtime: &Runtime, listener: TcpListener) -> std::io::Result<tokio::net::TcpListener> {
    let _inside = runtime.enter();
    tokio::net::TcpListener::from_std(listener)
}

pub(crate) type EndpointStanding = Option<(Door, TcpListener)>;

/// Returns the door in front of the server with the public listener, if the certificate store needs
/// a door; the server's own listener; and the builder with the certificate store to use.
pub(crate) fn door(
    pki: &Pki,
    trust_any: bool,
    clients: ClientLimits,
    (listener, builder): (TcpListener, ServerBuilder),
) -> Result<(EndpointStanding, TcpListener, ServerBuilder), Failure> {
    let builder = builder.trust_client_certs(trust_any);
    let wanted = if trust_any {
        warn!("this server trusts and stores every client certificate: use this for tests only");
        None
    } else {
        Door::of(pki.root(), clients, UnknownClients::Refuse).map_err(io_fault)?
    };
    Ok(match wanted {
        Some((door, behind)) => {
            let builder = door.behind().used_by(builder);
            (Some((door, listener)), behind, builder)
        }
        None => (None, listener, builder.pki_dir(pki.root())),
    })
}

/// Starts to accept clients through the door.
pub(crate) fn stand(runtime: &Runtime, door: EndpointStanding) -> Result<(), Failure> {
    if let Some((door, listener)) = door {
        let listener = taken_by(runtime, listener).map_err(io_fault)?;
        drop(runtime.spawn(door.stand(listener)));
    }
    Ok(())
}

/// Connects the server to the clients of the mapping. Each connection is tried again, 5 s after it
/// failed or ended.
///
/// # Errors
/// Returns an error if the certificates of clients are checked before the server, or if the library
/// has no pause between two attempts.
pub(crate) fn reverse_connect(
    described: &Server,
    (handle, url): (&ServerHandle, String),
    (runtime, has_door): (&Runtime, bool),
) -> Result<(), Failure> {
    if described.reverse_connect.is_empty() {
        return Ok(());
    }
    let refused = |why: &str| {
        let message = format!("server.reverse_connect: {why}");
        Err(Failure::new(FailureKind::Configuration, message))
    };
    if has_door {
        return refused(
            "the store trusts an authority, whose clients are checked where they connect; trust the \
             certificates of these clients themselves, or let them connect",
        );
    }
    if !patches::are_applied() {
        return refused("build with `cargo xtask build`, which applies the patches");
    }
    for client in &described.reverse_connect {
        let (handle, url) = (handle.clone(), url.clone());
        drop(runtime.spawn(reverse::connect(handle, client.clone(), url)));
    }
    Ok(())
}

/// Renews the certificate of the server at the Global Discovery Server, as long as the server runs.
pub(crate) fn enrol(
    runtime: &Runtime,
    (applicant, gds): (Applicant, Option<Invitation>),
    (pki, certificates): (&Pki, &Arc<Configuration>),
) {
    let Some(gds) = gds else { return };
    let enrolment = Enrolment::new(pki.root(), applicant, gds);
    let certificates = Arc::clone(certificates);
    let kept = async move { enrolment.keep(|| certificates.restart()).await };
    drop(runtime.spawn(kept));
}

fn io_fault(error: std::io::Error) -> Failure {
    Failure::new(FailureKind::Io, error.to_string())
}

/// Largest number of history continuation points of a session.
const MOST_HISTORY_GOES_ON: usize = 100;
/// Largest number of histories of events in a request. Only two nodes have one.
const MOST_EVENT_HISTORIES: usize = 10;
/// Pause before a connection to a client is tried again, in milliseconds.
const REVERSE_PAUSE_MS: u64 = 5_000;
const SERVER_THREADS: usize = 2;
