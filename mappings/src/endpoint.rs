//! Endpoint of an OPC UA server.

/// URL `opc.tcp://host:port/path`.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub struct Endpoint {
    /// Host name or address; an IPv6 address is without its brackets.
    pub host: String,
    /// Port, 1..=65535.
    pub port: u16,
    /// Path; empty, or begins with `/`.
    pub path: String,
}

impl Endpoint {
    /// Reads the URL; the default port is 4840 (OPC 10000-6, 7.2). Returns `None` for another text.
    #[must_use]
    pub fn parse(text: &str) -> Option<Self> {
        let rest = text.strip_prefix("opc.tcp://")?;
        let slash = rest.find('/').unwrap_or(rest.len());
        let (authority, path) = rest.split_at_checked(slash)?;
        let (host, port) = match authority
            .strip_prefix('[')
            .and_then(|rest| rest.split_once(']'))
        {
            Some((host, port)) => {
                host.parse::<std::net::Ipv6Addr>().ok()?;
                (
                    host,
                    if port.is_empty() {
                        None
                    } else {
                        Some(port.strip_prefix(':')?)
                    },
                )
            }
            None => match authority.split_once(':') {
                Some((host, port)) => (host, Some(port)),
                None => (authority, None),
            },
        };
        let plain = |c: char| c.is_ascii_alphanumeric() || "-._".contains(c);
        let named = !host.is_empty()
            && host.len() <= 255
            && (authority.starts_with('[') || host.chars().all(plain));
        let port = match port {
            Some(text) if text.bytes().all(|b| b.is_ascii_digit()) => {
                text.parse().ok().filter(|port| *port != 0)?
            }
            Some(_) => return None,
            None => PORT,
        };
        let whole =
            !path.contains(|c: char| c.is_whitespace() || c.is_control()) && path.len() <= 1024;
        (named && whole).then(|| Self {
            host: host.to_owned(),
            port,
            path: path.to_owned(),
        })
    }

    /// Returns `true` if only programs of its own host reach it, judging by its host.
    #[must_use]
    pub fn is_loopback(&self) -> bool {
        match self.host.parse::<std::net::IpAddr>() {
            Ok(address) => address.is_loopback(),
            Err(_) => self.host.eq_ignore_ascii_case("localhost"),
        }
    }
}

impl Default for Endpoint {
    fn default() -> Self {
        Self {
            host: "127.0.0.1".to_owned(),
            port: PORT,
            path: String::new(),
        }
    }
}

impl std::fmt::Display for Endpoint {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { host, port, path } = self;
        if host.contains(':') {
            write!(f, "opc.tcp://[{host}]:{port}{path}")
        } else {
            write!(f, "opc.tcp://{host}:{port}{path}")
        }
    }
}

/// Port registered for OPC UA over TCP.
const PORT: u16 = 4840;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_endpoint_prints_as_it_was_read() {
        for text in [
            "opc.tcp://127.0.0.1:4840",
            "opc.tcp://plant-7.local:1/ua/x",
            "opc.tcp://[::1]:4841",
        ] {
            assert_eq!(Endpoint::parse(text).unwrap().to_string(), text);
        }
        assert_eq!(Endpoint::parse("opc.tcp://gateway").unwrap().port, 4840);
        for text in [
            "",
            "127.0.0.1:4840",
            "http://a:1",
            "opc.tcp://",
            "opc.tcp://:4840",
            "opc.tcp://a:0",
            "opc.tcp://a:x",
            "opc.tcp://a:65536",
            "opc.tcp://[::1",
            "opc.tcp://[x]:1",
            "opc.tcp://a b:1",
            "opc.tcp://a:1/ x",
            "opc.tcp://a:+1",
        ] {
            assert_eq!(Endpoint::parse(text), None, "{text}");
        }
    }
}
