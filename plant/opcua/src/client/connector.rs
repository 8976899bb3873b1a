//! TCP connections with TCP_NODELAY: a request does not wait for the acknowledgement of another
//! request.

use std::io;
use std::sync::Arc;
use std::time::Duration;

use opcua::client::ConnectionSource;
use opcua::client::transport::{
    Connector, RequestRecv, SecureChannelState, StreamConnection, StreamConnector, TcpTransport,
    TransportConfiguration,
};
use opcua::core::comms::tcp_codec::TcpCodec;
use opcua::types::{DecodingOptions, EndpointDescription, Error, StatusCode};
use socket2::{SockRef, TcpKeepalive};
use tokio::io::{ReadHalf, WriteHalf};
use tokio::net::TcpStream;
use tokio::time::timeout;
use tokio_util::codec::FramedRead;

use crate::endpoint::EndpointUrl;

/// Connects to one endpoint.
#[derive(Debug, Clone)]
pub(crate) struct Direct {
    url: String,
    within: Duration,
}

impl Direct {
    pub(crate) fn new(url: &str, within: Duration) -> Self {
        Self {
            url: url.to_owned(),
            within,
        }
    }
}

impl ConnectionSource for Direct {
    type Builder = Self;

    fn get_connector(&self, endpoint: &EndpointDescription) -> Result<Self, Error> {
        Ok(Self::new(endpoint.endpoint_url.as_ref(), self.within))
    }
}

type Connection = StreamConnection<ReadHalf<TcpStream>, WriteHalf<TcpStream>>;

async fn connect(
    url: String,
    within: Duration,
    options: DecodingOptions,
) -> Result<Connection, Error> {
    let failed = |reason: String| Error::new(StatusCode::BadCommunicationError, reason);
    let endpoint: EndpointUrl = url
        .parse()
        .map_err(|error| failed(format!("{url}: {error}")))?;
    let socket = timeout(within, TcpStream::connect(endpoint.authority()))
        .await
        .map_err(|_| failed(format!("{url} does not respond")))?
        .map_err(|error| failed(format!("{url}: {error}")))?;
    socket
        .set_nodelay(true)
        .and_then(|()| keep_alive(&socket))
        .map_err(|error| failed(format!("{url}: {error}")))?;
    let (reader, writer) = tokio::io::split(socket);
    let reader = FramedRead::new(reader, TcpCodec::new(options));
    Ok(StreamConnection::new(reader, writer, url))
}

/// Enables TCP keep-alive, so that the kernel detects an unreachable host while nothing is sent.
fn keep_alive(socket: &TcpStream) -> io::Result<()> {
    let socket = SockRef::from(socket);
    let keep_alive = TcpKeepalive::new()
        .with_time(KEEP_ALIVE)
        .with_interval(KEEP_ALIVE);
    socket.set_tcp_keepalive(&keep_alive)?;
    #[cfg(target_os = "linux")]
    socket.set_tcp_user_timeout(Some(UNACKNOWLEDGED))?;
    Ok(())
}

/// Idle time before the first TCP keep-alive probe, and interval between the probes.
const KEEP_ALIVE: Duration = Duration::from_secs(1);
/// Longest time that data may stay unacknowledged. A busy server may have a full receive window.
#[cfg(target_os = "linux")]
const UNACKNOWLEDGED: Duration = Duration::from_secs(5);

impl Connector for Direct {
    type Transport = TcpTransport;

    async fn connect(
        &self,
        channel: Arc<SecureChannelState>,
        requests: RequestRecv,
        config: TransportConfiguration,
    ) -> Result<TcpTransport, Error> {
        let within = self.within;
        let connect = move |url, options| connect(url, within, options);
        let connector = StreamConnector::new(connect, self.url.clone());
        connector.connect(channel, requests, config).await
    }

    fn default_endpoint(&self) -> EndpointDescription {
        EndpointDescription::from(self.url.as_str())
    }
}
