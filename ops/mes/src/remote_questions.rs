//! Questions and changes of users of other hosts, by TLS with the certificate of the MES.

use std::net::{IpAddr, SocketAddr};
use std::path::Path;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use bridge_node::{Failure, FailureKind};
use knowledge::{
    ConnectionSecurity, ExtraPages, HttpEndpoint, PasswordRefusal, Queries, SecuredStream,
    SecuringConnection, Writes,
};
use log_limit::Throttle;
use plant_opcua::pki;
use tls_server::{CertificateFiles, TlsServer};
use tokio::net::TcpStream;
use tokio::time::Instant;
use tracing::{info, warn};

/// The refused passwords of clients of other hosts, for the status.
#[derive(Debug)]
pub(crate) struct RefusedPasswords {
    wrong: AtomicU64,
    too_many: AtomicU64,
    logged: Mutex<Throttle>,
}

impl Default for RefusedPasswords {
    fn default() -> Self {
        Self {
            wrong: AtomicU64::new(0),
            too_many: AtomicU64::new(0),
            logged: Mutex::new(Throttle::several(LOGGED, LOG_PERIOD)),
        }
    }
}

impl RefusedPasswords {
    fn count(&self, client: IpAddr, refusal: PasswordRefusal) {
        let (counter, why) = match refusal {
            PasswordRefusal::Wrong => (&self.wrong, "unknown user or wrong password"),
            PasswordRefusal::TooMany => (&self.too_many, "too many wrong passwords"),
        };
        counter.fetch_add(1, Ordering::Relaxed);
        let mut logged = self.logged.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(suppressed) = logged.admit(Instant::now()) {
            warn!(%client, suppressed, "refused a client of another host: {why}");
        }
    }

    /// Returns the counters.
    pub(crate) fn status(&self) -> serde_json::Value {
        serde_json::json!({
            "wrong": self.wrong.load(Ordering::Relaxed),
            "too_many": self.too_many.load(Ordering::Relaxed),
        })
    }
}

/// TLS with the certificate of the MES.
struct MesTls {
    server: TlsServer,
    refused: Arc<RefusedPasswords>,
}

impl ConnectionSecurity for MesTls {
    fn secure(&self, stream: TcpStream) -> SecuringConnection {
        let server = self.server.clone();
        Box::pin(async move {
            let stream = server.accept(stream).await?;
            Ok(Box::new(stream) as Box<dyn SecuredStream>)
        })
    }

    fn is_for(&self, host: &str) -> bool {
        self.server.is_for(host)
    }

    fn refused(&self, client: IpAddr, refusal: PasswordRefusal) {
        self.refused.count(client, refusal);
    }
}

/// Serves questions and changes by TLS, with the certificate in the store of the MES.
///
/// # Errors
/// The certificate cannot be used, or the address cannot be bound.
pub(crate) async fn serve(
    address: SocketAddr,
    (root, refused): (&Path, Arc<RefusedPasswords>),
    queries: Queries,
    page: ExtraPages,
    writes: Writes,
) -> Result<HttpEndpoint, Failure> {
    let files = CertificateFiles {
        certificate: root.join(pki::OWN_CERTIFICATE),
        key: root.join(pki::OWN_KEY),
    };
    let server = TlsServer::open(files).map_err(|error| {
        let what = format!("cannot answer questions by TLS: {error}");
        Failure::new(FailureKind::Configuration, what)
    })?;
    let security: Arc<dyn ConnectionSecurity> = Arc::new(MesTls { server, refused });
    let bound = HttpEndpoint::bind_secured(address, queries, page, (writes, security)).await;
    let endpoint = bound.map_err(|error| {
        let what = format!(
            "cannot answer questions at {address}: {error}; give another --sparql-tls address"
        );
        Failure::new(FailureKind::Unavailable, what)
    })?;
    info!(address = %endpoint.address(), "serving queries by TLS");
    Ok(endpoint)
}

/// Number of refusals that are logged in a period.
const LOGGED: u32 = 5;
const LOG_PERIOD: Duration = Duration::from_secs(60);
