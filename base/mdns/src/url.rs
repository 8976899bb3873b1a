//! The URL of a server: `opc.tcp://host:port/path`.

use std::net::IpAddr;

/// The parts of a URL of OPC UA over TCP.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Url {
    /// Name or address of the host; an IPv6 address is without brackets.
    pub host: String,
    /// The TCP port, 4840 by default.
    pub port: u16,
    /// The path with its slash, or empty.
    pub path: String,
}

impl Url {
    /// Parses a URL. Returns `None` for any other kind of URL.
    pub fn parse(url: &str) -> Option<Self> {
        let rest = url.strip_prefix("opc.tcp://")?;
        let (authority, path) = match rest.find('/') {
            Some(at) => rest.split_at(at),
            None => (rest, ""),
        };
        let (host, port) = match authority.strip_prefix('[') {
            Some(literal) => literal.split_once(']')?,
            None => match authority.rfind(':') {
                Some(at) => authority.split_at(at),
                None => (authority, ""),
            },
        };
        let port = match port.strip_prefix(':') {
            Some(port) => port.parse().ok()?,
            None if port.is_empty() => PORT,
            None => return None,
        };
        let strange = |c: char| c.is_control() || c.is_whitespace();
        // Only an IPv6 address has colons, and it is in brackets.
        let is_literal = authority.starts_with('[');
        if host.is_empty()
            || host.contains(['[', ']'])
            || host.contains(':') != is_literal
            || url.contains(strange)
        {
            return None;
        }
        Some(Self {
            host: host.to_owned(),
            port,
            path: path.to_owned(),
        })
    }

    /// Creates the URL of an address.
    pub fn of(ip: IpAddr, port: u16, path: &str) -> Self {
        Self {
            host: ip.to_string(),
            port,
            path: path.to_owned(),
        }
    }

    /// Returns the address if the host is an address.
    pub fn ip(&self) -> Option<IpAddr> {
        self.host.parse().ok()
    }
}

impl std::fmt::Display for Url {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { host, port, path } = self;
        if host.contains(':') {
            write!(f, "opc.tcp://[{host}]:{port}{path}")
        } else {
            write!(f, "opc.tcp://{host}:{port}{path}")
        }
    }
}

/// The default port of OPC UA over TCP (OPC 10000-6, 7.2).
const PORT: u16 = 4840;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn urls_are_read_as_they_are_written() {
        for url in [
            "opc.tcp://127.0.0.1:43121/",
            "opc.tcp://cell-pc:4841",
            "opc.tcp://[fe80::1]:4840/a/b",
        ] {
            assert_eq!(
                Url::parse(url).map(|url| url.to_string()).as_deref(),
                Some(url)
            );
        }
        assert_eq!(Url::parse("opc.tcp://h").map(|url| url.port), Some(4840));
    }

    #[test]
    fn what_is_no_such_url_is_none() {
        for url in [
            "",
            "http://h:1",
            "opc.tcp://",
            "opc.tcp://:4840",
            "opc.tcp://h:70000",
            "opc.tcp://[::1",
            "opc.tcp://[::1]4840",
            "opc.tcp://fe80::1:4840",
            "opc.tcp://fe80::1]:4840",
            "opc.tcp://[host]:4840",
            "opc.tcp://h:1/a\nb",
        ] {
            assert_eq!(Url::parse(url), None, "{url:?}");
        }
    }
}
