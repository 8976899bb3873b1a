//! Endpoint URLs: the listening address of a server, and the URL for its clients.

use std::fmt;
use std::io;
use std::net::{IpAddr, SocketAddr, TcpListener, ToSocketAddrs as _};
use std::str::FromStr;

#[cfg(feature = "server")]
use crate::patches::OtherHosts;

/// The endpoint URL of the server: `opc.tcp://host:port/path` (OPC 10000-6, 7.1.2.2).
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct EndpointUrl {
    host: String,
    port: u16,
    path: String,
}

impl EndpointUrl {
    /// Returns the host for clients: the host of the URL, or the name of this computer if the URL
    /// has the wildcard address, to which no client can connect.
    #[must_use]
    pub fn advertised_host(&self) -> String {
        let bare = self.host.trim_matches(['[', ']']);
        match bare.parse::<IpAddr>() {
            Ok(address) if address.is_unspecified() => {
                opcua::crypto::hostname().unwrap_or_else(|_| "localhost".to_owned())
            }
            Ok(_) | Err(_) => self.host.clone(),
        }
    }

    /// Returns the hosts for the certificate of the server: the host of the URL, or for the
    /// wildcard address the name of this computer and its current addresses.
    #[must_use]
    pub fn hosts(&self) -> Vec<String> {
        let bare = self.host.trim_matches(['[', ']']);
        let is_wildcard = bare
            .parse::<IpAddr>()
            .is_ok_and(|address| address.is_unspecified());
        let named = self.advertised_host().trim_matches(['[', ']']).to_owned();
        let mut hosts = vec![named];
        if is_wildcard {
            let all = if_addrs::get_if_addrs().unwrap_or_default();
            let others = all.iter().filter(|one| !one.is_loopback());
            hosts.extend(others.take(MOST_ADDRESSES).map(|one| one.ip().to_string()));
        }
        hosts
    }

    /// Returns a URL for each of the [hosts](Self::hosts), with the actual port.
    #[must_use]
    pub fn urls(&self, port: u16) -> Vec<String> {
        let url = |host: &String| {
            let host = match host.contains(':') {
                true => format!("[{host}]"),
                false => host.clone(),
            };
            format!("opc.tcp://{host}:{port}{}", self.path)
        };
        self.hosts().iter().map(url).collect()
    }

    /// Returns the path of the URL, at least `/`.
    #[must_use]
    pub fn path(&self) -> &str {
        &self.path
    }

    /// Returns the host of the URL: a name, or an address without brackets.
    #[must_use]
    pub fn host(&self) -> &str {
        self.host.trim_matches(['[', ']'])
    }

    /// Returns the port of the URL; 0 stands for any free port.
    #[must_use]
    pub const fn port(&self) -> u16 {
        self.port
    }

    /// Returns `host:port`, for connecting.
    #[must_use]
    pub fn authority(&self) -> String {
        format!("{}:{}", self.host, self.port)
    }

    /// Returns the URL for clients, with the actual port.
    #[must_use]
    pub fn advertised(&self, port: u16) -> String {
        format!("opc.tcp://{}:{port}{}", self.advertised_host(), self.path)
    }

    /// Opens the listening socket, with TCP_NODELAY for the accepted connections.
    ///
    /// # Errors
    /// Returns an error if the host has no address or if listening fails on its addresses. With
    /// unpatched libraries, an address that other hosts reach is an error too ([`crate::patches`]).
    pub fn bind(&self) -> Result<TcpListener, BindError> {
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
        let name = self.authority();
        let addresses: Vec<SocketAddr> = name
            .to_socket_addrs()
            .map_err(|source| BindError::Unresolved {
                host: self.host.clone(),
                source,
            })?
            .collect();
        #[cfg(feature = "server")]
        crate::patches::check(&addresses)?;
        let shown = addresses.first().map_or_else(|| name, ToString::to_string);
        let listener = TcpListener::bind(addresses.as_slice()).map_err(failed(shown.clone()))?;
        listener
            .set_nonblocking(true)
            .map_err(failed(shown.clone()))?;
        // Accepted connections inherit the option. Without it a notification waits 40 ms for the
        // delayed acknowledgement of the client.
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

/// An error in an endpoint URL.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum UrlError {
    /// The scheme is not `opc.tcp`.
    #[error("an endpoint URL begins with `opc.tcp://`, such as opc.tcp://127.0.0.1:4840")]
    Scheme,
    /// The host is missing or invalid.
    #[error("the host of the endpoint URL is a name or an address (an IPv6 address in brackets)")]
    Host,
    /// The port is not a number, or too large.
    #[error("the port of the endpoint URL is a number up to 65535")]
    Port,
}

/// An error of opening the listening socket.
#[derive(Debug, thiserror::Error)]
pub enum BindError {
    /// Another program uses the port.
    #[error(
        "another program already listens on {address} (see `ss -ltnp 'sport = :{port}'`); stop it, or \
         choose another endpoint"
    )]
    Taken {
        /// Address and port.
        address: String,
        /// The port.
        port: u16,
    },
    /// The address does not belong to this computer.
    #[error("{0} is not an address of this host; choose an address of this host for the endpoint")]
    NotOurs(String),
    /// The host cannot be resolved.
    #[error("the host {host} of the endpoint has no address: {source}")]
    Unresolved {
        /// The host.
        host: String,
        /// The error of the operating system.
        #[source]
        source: io::Error,
    },
    /// Other hosts reach the address, and the libraries are unpatched.
    #[cfg(feature = "server")]
    #[error(transparent)]
    AsPublished(#[from] OtherHosts),
    /// Any other error.
    #[error("cannot listen on {address}: {source}")]
    Other {
        /// Address and port.
        address: String,
        /// The error of the operating system.
        #[source]
        source: io::Error,
    },
}

/// The port that IANA assigned to the OPC UA Connection Protocol.
const DEFAULT_PORT: u16 = 4840;
/// Maximum number of addresses of this computer in a certificate.
const MOST_ADDRESSES: usize = 64;

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
    fn a_certificate_names_the_host_of_the_url_and_for_the_wildcard_address_this_computer() {
        let hosts = |text: &str| text.parse::<EndpointUrl>().unwrap().hosts();
        assert_eq!(hosts("opc.tcp://192.0.2.7:4840"), ["192.0.2.7"]);
        assert_eq!(hosts("opc.tcp://[::1]:4840"), ["::1"]);
        let all = hosts("opc.tcp://0.0.0.0:4840");
        assert!(
            !all.contains(&"0.0.0.0".to_owned()) && !all[0].is_empty(),
            "{all:?}"
        );
    }

    #[test]
    fn a_taken_port_is_named_with_what_to_do() {
        let url: EndpointUrl = "opc.tcp://127.0.0.1:0".parse().unwrap();
        let first = url.bind().unwrap();
        let port = first.local_addr().unwrap().port();
        let url: EndpointUrl = format!("opc.tcp://127.0.0.1:{port}").parse().unwrap();
        let message = url.bind().unwrap_err().to_string();
        assert!(message.contains(&format!("127.0.0.1:{port}")), "{message}");
        assert!(message.contains("endpoint"), "{message}");
    }
}
