//! Where the server listens, what it lets clients choose, and the bounds it puts on them.

use std::fmt;
use std::io;
use std::net::{IpAddr, SocketAddr, TcpListener, ToSocketAddrs as _};
use std::str::FromStr;

use mappings::Server;
use opcua::crypto::SecurityPolicy;
use opcua::server::{
    ANONYMOUS_USER_TOKEN_ID, Limits, OperationalLimits, ServerBuilder, ServerEndpoint,
    SubscriptionLimits,
};
use opcua::types::{BuildInfo, MessageSecurityMode, UAString};

/// The endpoint URL of the server: `opc.tcp://host:port/path` (OPC 10000-6, 7.1.2.2).
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct EndpointUrl {
    host: String,
    port: u16,
    path: String,
}

impl EndpointUrl {
    /// The host clients are told: that of the URL, or this computer's name where the URL has the wildcard address,
    /// which no client can connect to.
    pub(crate) fn advertised_host(&self) -> String {
        let bare = self.host.trim_matches(['[', ']']);
        match bare.parse::<IpAddr>() {
            Ok(address) if address.is_unspecified() => {
                opcua::crypto::hostname().unwrap_or_else(|_| "localhost".to_owned())
            }
            Ok(_) | Err(_) => self.host.clone(),
        }
    }

    /// The URL clients are told, with the port that is listened on.
    pub(crate) fn advertised(&self, port: u16) -> String {
        format!("opc.tcp://{}:{port}{}", self.advertised_host(), self.path)
    }

    /// Opens the listening socket.
    ///
    /// # Errors
    /// The host has no address, or none of its addresses can be listened on.
    pub(crate) fn bind(&self) -> Result<TcpListener, BindError> {
        let failed = |address: String| {
            move |source: io::Error| {
                let kind = source.kind();
                if kind == io::ErrorKind::AddrInUse {
                    BindError::Taken {
                        address,
                        port: self.port,
                    }
                } else if kind == io::ErrorKind::AddrNotAvailable {
                    BindError::NotOurs(address)
                } else {
                    BindError::Other { address, source }
                }
            }
        };
        let name = format!("{}:{}", self.host, self.port);
        let addresses: Vec<SocketAddr> = name
            .to_socket_addrs()
            .map_err(|source| BindError::Unresolved {
                host: self.host.clone(),
                source,
            })?
            .collect();
        let shown = addresses.first().map_or_else(|| name, ToString::to_string);
        let listener = TcpListener::bind(addresses.as_slice()).map_err(failed(shown.clone()))?;
        listener
            .set_nonblocking(true)
            .map_err(failed(shown.clone()))?;
        // Connections take it over. Without it a notification waits for the client's delayed acknowledgement, 40 ms.
        socket2::SockRef::from(&listener)
            .set_tcp_nodelay(true)
            .map_err(failed(shown))?;
        Ok(listener)
    }
}

impl FromStr for EndpointUrl {
    type Err = UrlError;

    fn from_str(text: &str) -> Result<Self, UrlError> {
        let rest = text.strip_prefix("opc.tcp://").ok_or(UrlError::Scheme)?;
        let (authority, path) = match rest.split_once('/') {
            Some((authority, path)) => (authority, format!("/{path}")),
            None => (rest, "/".to_owned()),
        };
        let (host, port) = match authority.rsplit_once(':') {
            Some((host, port)) if !port.contains(']') => {
                (host, port.parse().map_err(|_| UrlError::Port)?)
            }
            _ => (authority, DEFAULT_PORT),
        };
        let bracketed = host.starts_with('[') && host.ends_with(']');
        if host.is_empty()
            || (host.contains(':') && !bracketed)
            || host.contains(char::is_whitespace)
        {
            return Err(UrlError::Host);
        }
        Ok(Self {
            host: host.to_owned(),
            port,
            path,
        })
    }
}

impl fmt::Display for EndpointUrl {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "opc.tcp://{}:{}{}", self.host, self.port, self.path)
    }
}

/// Why a text is not an endpoint URL.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub(crate) enum UrlError {
    #[error("an endpoint URL begins with `opc.tcp://`, such as opc.tcp://127.0.0.1:4840")]
    Scheme,
    #[error("the host of the endpoint URL is a name or an address (an IPv6 address in brackets)")]
    Host,
    #[error("the port of the endpoint URL is a number up to 65535")]
    Port,
}

/// Why nothing listens.
#[derive(Debug, thiserror::Error)]
pub(crate) enum BindError {
    #[error(
        "another program listens on {address} already (see `ss -ltnp 'sport = :{port}'`); \
         stop it, or choose another address with --endpoint"
    )]
    Taken { address: String, port: u16 },
    #[error("{0} is no address of this computer; choose one of its own with --endpoint")]
    NotOurs(String),
    #[error("the host {host} of the endpoint has no address: {source}")]
    Unresolved {
        host: String,
        #[source]
        source: io::Error,
    },
    #[error("cannot listen on {address}: {source}")]
    Other {
        address: String,
        #[source]
        source: io::Error,
    },
}

/// The server the mapping describes, reached at `url`, for anonymous users. `port` is the one that is listened on, which differs from the URL's when that is 0.
pub(crate) fn server(described: &Server, url: &EndpointUrl, port: u16) -> ServerBuilder {
    let host = url.advertised_host();
    let anonymous = [ANONYMOUS_USER_TOKEN_ID.to_owned()];
    let mut builder = ServerBuilder::new()
        .without_node_managers()
        .application_name(APPLICATION_NAME)
        .application_uri(described.application_uri.as_str())
        .product_uri(PRODUCT_URI)
        .build_info(BuildInfo {
            product_uri: UAString::from(PRODUCT_URI),
            manufacturer_name: UAString::null(),
            product_name: UAString::from(APPLICATION_NAME),
            software_version: UAString::from(env!("CARGO_PKG_VERSION")),
            build_number: UAString::null(),
            build_date: opcua::types::DateTime::null(),
        })
        .discovery_urls(vec![format!("opc.tcp://{host}:{port}{}", url.path)])
        .host(host)
        .port(port)
        .certificate_path("own/cert.der")
        .private_key_path("private/private.pem")
        .subscription_poll_interval_ms(POLL_MS)
        .limits(limits());
    for policy in &described.security {
        let (policy, modes) = match policy {
            mappings::SecurityPolicy::None => {
                (SecurityPolicy::None, [MessageSecurityMode::None].as_slice())
            }
            mappings::SecurityPolicy::Basic256Sha256 => (
                SecurityPolicy::Basic256Sha256,
                [
                    MessageSecurityMode::Sign,
                    MessageSecurityMode::SignAndEncrypt,
                ]
                .as_slice(),
            ),
        };
        for mode in modes {
            let endpoint = ServerEndpoint::new(url.path.clone(), policy, *mode, &anonymous);
            builder = builder.add_endpoint(format!("{policy} {mode}"), endpoint);
        }
    }
    builder
}

fn limits() -> Limits {
    Limits {
        // Any value of the space, and what can be read of an array at once.
        max_array_length: LARGEST_ARRAY,
        max_string_length: LARGEST_VALUE,
        max_byte_string_length: LARGEST_VALUE,
        max_message_size: LARGEST_VALUE + (1 << 20),
        // With room for clients that send chunks of half the usual size.
        max_chunk_count: 2_100,
        subscriptions: SubscriptionLimits {
            max_subscriptions_per_session: 50,
            // 0 is what a client gets that asks for exception-based reporting: every change, as it comes.
            min_sampling_interval_ms: 0.0,
            min_publishing_interval_ms: 10.0,
            max_monitored_items_per_sub: 10_000,
            max_monitored_item_queue_size: 1_000,
            // Clients commonly refuse arrays of more than 1000 elements, and then hear nothing more.
            max_notifications_per_publish: 1_000,
            max_queued_notifications: 100,
            ..SubscriptionLimits::default()
        },
        operational: OperationalLimits::default(),
        max_sessions: 50,
        ..Limits::default()
    }
}

/// The largest message of the space.
const LARGEST_VALUE: usize = 64 << 20;
/// Each element takes up 24 bytes and more while a message is read.
const LARGEST_ARRAY: usize = 4 << 20;
const APPLICATION_NAME: &str = "UA bridge server";
pub(crate) const PRODUCT_URI: &str = "urn:ua-bridge:server";
/// The port of OPC UA Connection Protocol registered with IANA.
const DEFAULT_PORT: u16 = 4840;
/// How often subscriptions are looked at: how late a notification may be beyond its publishing interval.
const POLL_MS: u64 = 5;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_endpoint_url_has_a_host_a_port_and_a_path() {
        let url: EndpointUrl = "opc.tcp://cell-1.local:4841/ua/server".parse().unwrap();
        assert_eq!(url.to_string(), "opc.tcp://cell-1.local:4841/ua/server");
        let url: EndpointUrl = "opc.tcp://[::1]".parse().unwrap();
        assert_eq!(url.to_string(), "opc.tcp://[::1]:4840/");
    }

    #[test]
    fn what_is_no_endpoint_url_is_refused_with_the_part_that_is_wrong() {
        for (text, error) in [
            ("127.0.0.1:4840", UrlError::Scheme),
            ("http://127.0.0.1:4840", UrlError::Scheme),
            ("opc.tcp://", UrlError::Host),
            ("opc.tcp://::1:4840", UrlError::Host),
            ("opc.tcp://127.0.0.1:99999", UrlError::Port),
            ("opc.tcp://127.0.0.1:", UrlError::Port),
        ] {
            assert_eq!(text.parse::<EndpointUrl>(), Err(error), "{text}");
        }
    }

    #[test]
    fn clients_are_never_told_the_wildcard_address() {
        for text in ["opc.tcp://0.0.0.0:4840", "opc.tcp://[::]:4840"] {
            let host = text.parse::<EndpointUrl>().unwrap().advertised_host();
            assert!(
                !host.is_empty() && !host.contains("0.0.0.0") && !host.contains("::"),
                "{host}"
            );
        }
    }

    #[test]
    fn a_taken_port_is_named_with_what_to_do() {
        let url: EndpointUrl = "opc.tcp://127.0.0.1:0".parse().unwrap();
        let first = url.bind().unwrap();
        let port = first.local_addr().unwrap().port();
        let url: EndpointUrl = format!("opc.tcp://127.0.0.1:{port}").parse().unwrap();
        let message = url.bind().unwrap_err().to_string();
        assert!(message.contains(&format!("127.0.0.1:{port}")), "{message}");
        assert!(message.contains("--endpoint"), "{message}");
    }
}
