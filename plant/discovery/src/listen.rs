//! The listener of a discovery server, and the reasons why it cannot listen.

use std::io::ErrorKind;
use std::net::SocketAddr;
use std::time::Duration;

use mdns::Url;
use plant_opcua::patches::OtherHosts;
use service::{Failure, FailureKind};
use tokio::net::TcpListener;

use crate::client;

/// Listens at the address of a URL.
pub(crate) async fn listen(endpoint: &str) -> Result<(TcpListener, Url), ListenFault> {
    let place = Url::parse(endpoint).ok_or(ListenFault::Url)?;
    let addresses = tokio::net::lookup_host((place.host.as_str(), place.port)).await;
    let addresses: Vec<SocketAddr> = addresses.map_err(ListenFault::Io)?.collect();
    plant_opcua::patches::check(&addresses).map_err(ListenFault::AsPublished)?;
    let listener = TcpListener::bind(addresses.as_slice()).await;
    Ok((listener.map_err(ListenFault::Io)?, place))
}

/// An error of listening.
#[derive(Debug)]
pub(crate) enum ListenFault {
    /// The URL is not an OPC UA URL over TCP.
    Url,
    /// The error of the operating system.
    Io(std::io::Error),
    /// Other hosts reach the address, and the OPC UA libraries are unpatched.
    AsPublished(OtherHosts),
}

impl ListenFault {
    /// Returns whether another program listens at the address.
    pub(crate) fn is_taken(&self) -> bool {
        matches!(self, Self::Io(error) if error.kind() == ErrorKind::AddrInUse)
    }

    /// Converts the error into a failure of `ua-lds`. Queries the program that uses the address for
    /// its identity.
    pub(crate) async fn told(self, endpoint: &str) -> Failure {
        let error = match &self {
            Self::Url => {
                let message = format!(
                    "--endpoint {endpoint}: expected a URL such as opc.tcp://127.0.0.1:4840"
                );
                return Failure::new(FailureKind::Usage, message);
            }
            Self::AsPublished(error) => {
                return Failure::new(FailureKind::Configuration, error.to_string());
            }
            Self::Io(error) => error,
        };
        let who = if self.is_taken() {
            client::find_servers(endpoint, WHO_LIMIT).await.ok()
        } else {
            None
        };
        let who = who.and_then(|all| all.into_iter().find(|one| one.is_discovery_server));
        let what = match who {
            Some(one) => format!(
                "the discovery server \"{}\" ({}) already listens there: stop it or the program that \
                 contains it, or give another --endpoint",
                cut(&one.name),
                cut(&one.application_uri)
            ),
            None => {
                "if another discovery server runs on this host, give another --endpoint".to_owned()
            }
        };
        let message = format!("cannot listen at {endpoint}: {error}; {what}");
        Failure::new(FailureKind::Unavailable, message)
    }
}

impl std::fmt::Display for ListenFault {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Url => f.write_str("expected a URL such as opc.tcp://host:port"),
            Self::Io(error) => error.fmt(f),
            Self::AsPublished(error) => error.fmt(f),
        }
    }
}

/// Truncates an external text for the log.
pub(crate) fn cut(text: &str) -> String {
    text.chars().take(256).collect()
}

const WHO_LIMIT: Duration = Duration::from_secs(1);
