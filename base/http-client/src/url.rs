//! URLs of `http` and `https`.

use std::fmt;
use std::net::Ipv6Addr;
use std::str::FromStr;

use hyper::header::{HeaderValue, InvalidHeaderValue};
use thiserror::Error;
use uri_text::unescaped;

use crate::basic_authorization;

/// A URL of `http` or `https`. As text it has neither its query nor its user and password, which
/// may be secrets.
#[derive(Clone, PartialEq, Eq)]
pub struct HttpUrl {
    is_secure: bool,
    /// A name, or an address without brackets.
    host: String,
    port: u16,
    /// The path with its query; it begins with a slash.
    target: String,
    /// The name and the password.
    user: Option<(String, String)>,
}

/// The reason why a text is no [`HttpUrl`].
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum HttpUrlError {
    /// The scheme is another one, or missing.
    #[error("the URL does not begin with http:// or https://")]
    Scheme,
    /// The host is neither a name nor an address.
    #[error("`{0}` is no host; a host is a name, an IPv4 address or an IPv6 address in brackets")]
    Host(String),
    /// The port is no number from 1 to 65535.
    #[error("`{0}` is no port; a port is a number from 1 to 65535")]
    Port(String),
    /// The user or the password is not escaped as `%XX` of UTF-8.
    #[error("the user or the password of the URL is not escaped as %XX of UTF-8")]
    User,
    /// The URL has a character that URLs escape.
    #[error("the URL has the character {0:?}; escape it as %XX")]
    Character(char),
}

impl HttpUrl {
    /// Returns whether the scheme is `https`.
    #[must_use]
    pub const fn is_secure(&self) -> bool {
        self.is_secure
    }

    /// Returns the name or the address of the host, without brackets.
    #[must_use]
    pub fn host(&self) -> &str {
        &self.host
    }

    /// Returns the host with its port, as `10.0.0.9:80` or `[::1]:443`.
    #[must_use]
    pub fn address(&self) -> String {
        let port = self.port;
        match self.host.contains(':') {
            true => format!("[{}]:{port}", self.host),
            false => format!("{}:{port}", self.host),
        }
    }

    /// Returns the path with its query, which begins with a slash.
    #[must_use]
    pub fn target(&self) -> &str {
        &self.target
    }

    /// Returns whether the URL has a user.
    #[must_use]
    pub const fn has_user(&self) -> bool {
        self.user.is_some()
    }

    /// Returns the value of `Authorization` for the user of the URL, if there is one.
    ///
    /// # Errors
    /// The text is too long for a header.
    pub fn authorization(&self) -> Result<Option<HeaderValue>, InvalidHeaderValue> {
        let user = self.user.as_ref();
        user.map(|(name, password)| basic_authorization(name, password))
            .transpose()
    }

    /// Returns the URL that a reference stands for (RFC 3986, 5.2): a URL, an absolute path, or a
    /// path relative to the last slash. A relative reference has the user of this URL. Segments
    /// `.` and `..` are left to the server.
    ///
    /// # Errors
    /// [`HttpUrlError`].
    pub fn join(&self, reference: &str) -> Result<Self, HttpUrlError> {
        if reference.contains("://") {
            return reference.parse();
        }
        if let Some(character) = reference.chars().find(|c| !is_url(*c)) {
            return Err(HttpUrlError::Character(character));
        }
        let target = match reference.starts_with('/') {
            true => reference.to_owned(),
            false => {
                let (path, _query) = self.target.split_once('?').unwrap_or((&self.target, ""));
                let (folder, _file) = path.rsplit_once('/').unwrap_or((path, ""));
                format!("{folder}/{reference}")
            }
        };
        Ok(Self {
            target,
            ..self.clone()
        })
    }

    /// Returns whether another URL has the same scheme, host and port.
    #[must_use]
    pub fn has_origin_of(&self, other: &Self) -> bool {
        let origin = |url: &Self| (url.is_secure, url.host.to_ascii_lowercase(), url.port);
        origin(self) == origin(other)
    }
}

impl FromStr for HttpUrl {
    type Err = HttpUrlError;

    fn from_str(text: &str) -> Result<Self, HttpUrlError> {
        let schemes = [("http://", 80, false), ("https://", 443, true)];
        let mut known = schemes.iter();
        let known = known.find_map(|(scheme, port, is_secure)| {
            Some((text.strip_prefix(scheme)?, *port, *is_secure))
        });
        let (rest, usual_port, is_secure) = known.ok_or(HttpUrlError::Scheme)?;
        if let Some(character) = rest.chars().find(|c| !is_url(*c)) {
            return Err(HttpUrlError::Character(character));
        }
        let (authority, path) = match rest.find(['/', '?']) {
            Some(at) => rest.split_at(at),
            None => (rest, ""),
        };
        let (user, authority) = match authority.rsplit_once('@') {
            Some((user, authority)) => (Some(user_of(user)?), authority),
            None => (None, authority),
        };
        let (host, port) = split(authority)?;
        let port = port.map_or(Ok(usual_port), |port| {
            let number = port.parse().ok().filter(|port| *port > 0);
            number.ok_or_else(|| HttpUrlError::Port(port.to_owned()))
        });
        Ok(Self {
            is_secure,
            host,
            port: port?,
            target: match path.starts_with('/') {
                true => path.to_owned(),
                false => format!("/{path}"),
            },
            user,
        })
    }
}

impl fmt::Display for HttpUrl {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (scheme, usual_port) = match self.is_secure {
            true => ("https", 443),
            false => ("http", 80),
        };
        let address = self.address();
        let shown = match self.port == usual_port {
            true => address.rsplit_once(':').map_or("", |(host, _)| host),
            false => &address,
        };
        let path = self.target.split('?').next().unwrap_or_default();
        write!(f, "{scheme}://{shown}{path}")
    }
}

impl fmt::Debug for HttpUrl {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "HttpUrl({self})")
    }
}

/// Returns the name and the password of `name:password`.
fn user_of(text: &str) -> Result<(String, String), HttpUrlError> {
    let (name, password) = text.split_once(':').unwrap_or((text, ""));
    // A plus sign is no space there.
    let plain = |text: &str| unescaped(&text.replace('+', "%2B")).ok_or(HttpUrlError::User);
    Ok((plain(name)?, plain(password)?))
}

/// Returns the host without brackets, and the text of its port.
fn split(authority: &str) -> Result<(String, Option<&str>), HttpUrlError> {
    let wrong = || HttpUrlError::Host(authority.to_owned());
    let (host, rest) = match authority.strip_prefix('[') {
        Some(inner) => {
            let (host, rest) = inner.split_once(']').ok_or_else(wrong)?;
            let address: Ipv6Addr = host.parse().map_err(|_| wrong())?;
            (address.to_string(), rest)
        }
        None => {
            let at = authority.find(':').unwrap_or(authority.len());
            let (host, rest) = authority.split_at(at);
            let is_host = |byte: u8| byte.is_ascii_alphanumeric() || b".-_".contains(&byte);
            if host.is_empty() || !host.bytes().all(is_host) {
                return Err(wrong());
            }
            (host.to_owned(), rest)
        }
    };
    match rest.strip_prefix(':') {
        Some(port) => Ok((host, Some(port))),
        None if rest.is_empty() => Ok((host, None)),
        None => Err(wrong()),
    }
}

/// Returns whether a URL may have a character. Braces are for placeholders of the caller.
fn is_url(character: char) -> bool {
    character.is_ascii_graphic() && !"\"<>\\^`|#".contains(character)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn url(text: &str) -> HttpUrl {
        text.parse().unwrap()
    }

    #[test]
    fn a_url_has_an_address_and_a_target() {
        for (text, is_secure, address, target) in [
            ("http://h", false, "h:80", "/"),
            ("https://h/a?b=c", true, "h:443", "/a?b=c"),
            ("http://10.0.0.9:8080?x", false, "10.0.0.9:8080", "/?x"),
            ("https://[::1]/{uri}", true, "[::1]:443", "/{uri}"),
            ("http://[::1]:81/", false, "[::1]:81", "/"),
        ] {
            let url = url(text);
            let read = (url.is_secure(), url.address(), url.target());
            assert_eq!(read, (is_secure, address.to_owned(), target), "{text}");
        }
    }

    #[test]
    fn the_wrong_part_of_a_url_is_named() {
        let host = |host: &str| HttpUrlError::Host(host.to_owned());
        for (text, expected) in [
            ("ftp://h/", HttpUrlError::Scheme),
            ("h", HttpUrlError::Scheme),
            ("http://", host("")),
            ("http://:80", host(":80")),
            ("http://{h}/", host("{h}")),
            ("http://[::1/", host("[::1")),
            ("http://[::1]1/", host("[::1]1")),
            ("http://h:0/", HttpUrlError::Port("0".to_owned())),
            ("http://h:65536/", HttpUrlError::Port("65536".to_owned())),
            ("http://h:/", HttpUrlError::Port(String::new())),
            ("http://u%zz@h/", HttpUrlError::User),
            ("http://h/a b", HttpUrlError::Character(' ')),
            ("http://h/#a", HttpUrlError::Character('#')),
            ("http://h/ü", HttpUrlError::Character('ü')),
        ] {
            assert_eq!(text.parse::<HttpUrl>(), Err(expected), "{text}");
        }
    }

    #[test]
    fn the_secrets_of_a_url_are_sent_and_not_shown() {
        let url = url("https://anna:p%40s+s@h:8443/sets/{uri}?key=secret");
        assert!(url.has_user());
        for shown in [url.to_string(), format!("{url:?}")] {
            assert!(shown.contains("https://h:8443/sets/{uri}"), "{shown}");
            for secret in ["anna", "p@s", "p%40s", "secret"] {
                assert!(!shown.contains(secret), "{shown}");
            }
        }
        let authorization = url.authorization().unwrap().unwrap();
        assert!(authorization.is_sensitive());
        assert_eq!(authorization, basic_authorization("anna", "p@s+s").unwrap());
        assert_eq!(authorization, "Basic YW5uYTpwQHMrcw==");
    }

    #[test]
    fn a_reference_is_relative_to_the_last_slash_or_a_url() {
        let index = url("http://a:b@h:81/sets/index.json?x=/y/");
        for (reference, target) in [
            ("di.xml", "/sets/di.xml"),
            ("/di/1.xml?v=2", "/di/1.xml?v=2"),
        ] {
            let joined = index.join(reference).unwrap();
            assert_eq!(joined.target(), target);
            assert!(joined.has_origin_of(&index) && joined.has_user());
        }
        for (reference, is_same) in [
            ("http://H:81/x", true),
            ("http://h/x", false),
            ("https://h:81/x", false),
            ("http://other:81/x", false),
        ] {
            let joined = index.join(reference).unwrap();
            assert_eq!(joined.has_origin_of(&index), is_same, "{reference}");
        }
        let space = index.join("a b.xml");
        assert_eq!(space, Err(HttpUrlError::Character(' ')));
    }
}
