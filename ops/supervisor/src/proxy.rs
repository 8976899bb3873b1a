//! The reverse proxy through which browsers of other hosts reach the page.

use std::fmt;
use std::str::FromStr;

/// The address of the page behind a reverse proxy, as `https://cell.example.org`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ProxyUrl {
    authority: String,
}

/// A text that is no address of a reverse proxy.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ProxyUrlError;

impl fmt::Display for ProxyUrlError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(
            "the https address of a reverse proxy is wanted, without a path, as https://cell.example.org: passwords are not \
             sent in clear",
        )
    }
}

impl std::error::Error for ProxyUrlError {}

impl FromStr for ProxyUrl {
    type Err = ProxyUrlError;

    fn from_str(text: &str) -> Result<Self, ProxyUrlError> {
        let authority = text.strip_prefix("https://").ok_or(ProxyUrlError)?;
        let authority = authority.strip_suffix('/').unwrap_or(authority);
        let is_part = |byte: u8| byte.is_ascii_alphanumeric() || b".-:[]".contains(&byte);
        if authority.is_empty() || !authority.bytes().all(is_part) {
            return Err(ProxyUrlError);
        }
        Ok(Self {
            authority: authority.to_ascii_lowercase(),
        })
    }
}

impl fmt::Display for ProxyUrl {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "https://{}", self.authority)
    }
}

impl ProxyUrl {
    /// Returns whether a Host header names the proxy.
    pub(crate) fn is_host(&self, host: &str) -> bool {
        host.eq_ignore_ascii_case(&self.authority)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_proxy_has_an_https_address_without_a_path() {
        let url: ProxyUrl = "https://Cell.example.org/".parse().unwrap();
        assert_eq!(url.to_string(), "https://cell.example.org");
        assert!(url.is_host("cell.example.org") && !url.is_host("example.org"));
        for wrong in [
            "http://cell",
            "https://",
            "https://cell/page",
            "cell",
            "https://u@cell",
        ] {
            assert!(wrong.parse::<ProxyUrl>().is_err(), "{wrong}");
        }
    }
}
