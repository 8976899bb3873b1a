//! The page for browsers of other hosts, by TLS with the certificate of the program.

use std::io;
use std::net::SocketAddr;
use std::sync::Arc;

use bridge_node::{BoxFuture, Failure, FailureKind, Stream, serve_secure};
use tls_server::{CertificateFiles, TlsServer};
use tokio::net::TcpStream;
use tracing::info;

use crate::page::Page;

impl Page {
    /// Serves the page by TLS at an address, for browsers of all hosts. Each user signs in, also to
    /// read.
    ///
    /// # Errors
    /// The certificate cannot be used, or the address cannot be bound.
    pub async fn serve_tls(
        self: Arc<Self>,
        address: SocketAddr,
        pair: CertificateFiles,
    ) -> Result<(), Failure> {
        let server = TlsServer::open(pair)
            .map_err(|error| Failure::new(FailureKind::Configuration, error.to_string()))?;
        let _first = self.tls.set(server.clone());
        let secure = move |stream: TcpStream| -> BoxFuture<io::Result<Box<dyn Stream>>> {
            let server = server.clone();
            Box::pin(async move {
                let stream = server.accept(stream).await?;
                Ok(Box::new(stream) as Box<dyn Stream>)
            })
        };
        let served = serve_secure(address, self, Arc::new(secure)).await;
        let at = served.map_err(|error| {
            Failure::new(
                FailureKind::Unavailable,
                format!("cannot serve the page at {address}: {error}; give another --page-tls"),
            )
        })?;
        info!("page at https://{at}/, by the names in the certificate, for signed-in users");
        Ok(())
    }
}
