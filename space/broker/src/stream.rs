//! The TCP connection, with or without TLS.

use std::io;
use std::net::SocketAddr;
use std::time::Duration;

use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::{TcpStream, lookup_host};
use tokio::time::timeout;

use crate::settings::BrokerSettings;

/// A connection with a broker.
pub(crate) trait BrokerStream: AsyncRead + AsyncWrite + Unpin + Send {}

impl<T: AsyncRead + AsyncWrite + Unpin + Send> BrokerStream for T {}

/// Connects with the broker, and returns its address.
pub(crate) async fn connect(
    settings: &BrokerSettings,
) -> io::Result<(Box<dyn BrokerStream>, SocketAddr)> {
    match timeout(CONNECT, connect_now(settings)).await {
        Ok(connected) => connected,
        Err(_elapsed) => Err(io::Error::new(
            io::ErrorKind::TimedOut,
            "the broker did not accept the connection in time",
        )),
    }
}

async fn connect_now(settings: &BrokerSettings) -> io::Result<(Box<dyn BrokerStream>, SocketAddr)> {
    let address = &settings.broker.address;
    let mut failed = None;
    for at in lookup_host((address.host.as_str(), address.port)).await? {
        match TcpStream::connect(at).await {
            Ok(tcp) => return Ok((secure(settings, tcp).await?, at)),
            Err(error) => failed = Some(error),
        }
    }
    Err(failed
        .unwrap_or_else(|| io::Error::new(io::ErrorKind::NotFound, "the host has no address")))
}

async fn secure(settings: &BrokerSettings, tcp: TcpStream) -> io::Result<Box<dyn BrokerStream>> {
    tcp.set_nodelay(true)?;
    // On close, the system discards data that was not sent, and resets the connection, so that the
    // broker discards data that it has not read: nothing of it is delivered late. A connection that
    // is closed on purpose is shut down first.
    socket2::SockRef::from(&tcp).set_linger(Some(Duration::ZERO))?;
    match &settings.tls {
        None => Ok(Box::new(tcp)),
        Some(tls) => Ok(Box::new(tls.connect(tcp).await?)),
    }
}

/// The time for a connection including TLS.
const CONNECT: Duration = Duration::from_secs(10);
