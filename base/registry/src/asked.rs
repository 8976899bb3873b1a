//! The registration request of a server (OPC 10000-4, 5.5.5 and 5.5.6), and its errors.

use std::net::IpAddr;

use thiserror::Error;

/// The ApplicationType of OPC 10000-4, 7.4.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ApplicationType {
    /// Server.
    Server,
    /// Client, which never registers.
    Client,
    /// ClientAndServer.
    ClientAndServer,
    /// DiscoveryServer.
    DiscoveryServer,
}

/// A RegisteredServer (OPC 10000-4, 7.32) with its MdnsDiscoveryConfiguration.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RegistrationRequest {
    /// The ApplicationUri.
    pub server_uri: String,
    /// The ProductUri; may be empty.
    pub product_uri: String,
    /// Names as (locale, text).
    pub names: Vec<(String, String)>,
    /// Type of the application.
    pub application_type: ApplicationType,
    /// The URI of a gateway; empty otherwise.
    pub gateway_server_uri: String,
    /// URLs for GetEndpoints requests.
    pub discovery_urls: Vec<String>,
    /// A file that exists while the server is installed; empty without such a file.
    pub semaphore_file_path: String,
    /// `false` withdraws the registration.
    pub is_online: bool,
    /// Requested announcement on the network; not available in RegisterServer.
    pub mdns: Option<MdnsConfiguration>,
}

/// MdnsDiscoveryConfiguration of OPC 10000-4, 7.13.1.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct MdnsConfiguration {
    /// The requested mDNS name.
    pub name: String,
    /// Codes of OPC 10000-12, Annex D, such as `DA`.
    pub capabilities: Vec<String>,
}

/// The channel of the request.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Channel {
    /// Whether the SecureChannel signs.
    pub is_secured: bool,
    /// The ApplicationUri in the client's certificate.
    pub certificate_uri: Option<String>,
    /// The address of the client; `None` within the program.
    pub peer: Option<IpAddr>,
}

/// Error of a registration, which has no effect then.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
#[non_exhaustive]
pub enum RegisterFault {
    /// BadSecurityModeInsufficient.
    #[error("registering needs a secured channel")]
    Unsecured,
    /// BadServerUriInvalid.
    #[error("the server URI is empty or too long")]
    NoUri,
    /// BadServerUriInvalid: the server URI differs from the certificate of the client.
    #[error("the server URI is {asked}, but the certificate has {certificate}")]
    OtherUri {
        /// The requested URI.
        asked: String,
        /// The URI of the certificate.
        certificate: String,
    },
    /// BadServerNameMissing.
    #[error("the server has no name")]
    NoName,
    /// BadDiscoveryUrlMissing.
    #[error("the server has no discovery URL")]
    NoUrl,
    /// BadSempahoreFileMissing.
    #[error("the semaphore file does not exist")]
    NoSemaphore,
    /// BadInvalidArgument: a client cannot register, or a text or list is too long.
    #[error("{what}")]
    Invalid {
        /// Description of the error.
        what: &'static str,
    },
    /// BadResourceUnavailable.
    #[error("the limit of {most} registered servers is reached")]
    Full {
        /// Maximum number of servers.
        most: usize,
    },
    /// BadSecurityModeInsufficient: a registration without a certificate cannot replace a
    /// registration with a certificate.
    #[error(
        "{asked} is registered with a certificate, and only this certificate can change the registration"
    )]
    Certified {
        /// The requested URI.
        asked: String,
    },
}

impl RegisterFault {
    /// Returns the StatusCode of OPC 10000-6, Annex A.
    #[must_use]
    pub fn status(&self) -> u32 {
        match self {
            Self::Unsecured | Self::Certified { .. } => 0x80E6_0000,
            Self::NoUri | Self::OtherUri { .. } => 0x804F_0000,
            Self::NoName => 0x8050_0000,
            Self::NoUrl => 0x8051_0000,
            Self::NoSemaphore => 0x8052_0000,
            Self::Invalid { .. } => 0x80AB_0000,
            Self::Full { .. } => 0x8004_0000,
        }
    }
}

impl RegistrationRequest {
    /// Validates a request, in the order of Part 4.
    pub(crate) fn check(
        &self,
        channel: &Channel,
        allow_unsecured: bool,
    ) -> Result<(), RegisterFault> {
        if !channel.is_secured && !allow_unsecured {
            return Err(RegisterFault::Unsecured);
        }
        if self.server_uri.is_empty() || self.server_uri.len() > MAX_TEXT {
            return Err(RegisterFault::NoUri);
        }
        if let Some(certificate) = &channel.certificate_uri
            && *certificate != self.server_uri
        {
            return Err(RegisterFault::OtherUri {
                asked: self.server_uri.clone(),
                certificate: certificate.clone(),
            });
        }
        if !self.is_online {
            // A withdrawal only needs the URI; some servers omit the rest.
            return Ok(());
        }
        if self.application_type == ApplicationType::Client {
            let what = "a client does not register";
            return Err(RegisterFault::Invalid { what });
        }
        if self.names.iter().all(|(_, text)| text.is_empty()) {
            return Err(RegisterFault::NoName);
        }
        if self.discovery_urls.iter().all(String::is_empty) {
            return Err(RegisterFault::NoUrl);
        }
        self.check_sizes()
    }

    fn check_sizes(&self) -> Result<(), RegisterFault> {
        let lists = [
            (self.names.len(), MAX_NAMES, "too many names of the server"),
            (
                self.discovery_urls.len(),
                MAX_URLS,
                "too many discovery URLs of the server",
            ),
            (
                self.mdns.as_ref().map_or(0, |mdns| mdns.capabilities.len()),
                MAX_CAPABILITIES,
                "too many capabilities of the server",
            ),
        ];
        let too_many = lists.into_iter().find(|(count, most, _)| count > most);
        if let Some((_, _, what)) = too_many {
            return Err(RegisterFault::Invalid { what });
        }
        let mdns = self.mdns.iter();
        let texts = [
            &self.product_uri,
            &self.gateway_server_uri,
            &self.semaphore_file_path,
        ]
        .into_iter()
        .chain(self.names.iter().flat_map(|(locale, text)| [locale, text]))
        .chain(&self.discovery_urls)
        .chain(mdns.flat_map(|mdns| mdns.capabilities.iter().chain([&mdns.name])));
        let mut texts = texts.into_iter();
        if texts.any(|text| text.len() > MAX_TEXT) {
            let what = "a text is longer than 1024 bytes";
            return Err(RegisterFault::Invalid { what });
        }
        let strange = |url: &String| url.contains(|c: char| c.is_control() || c.is_whitespace());
        if self.discovery_urls.iter().any(strange) {
            let what = "a discovery URL contains a space or a control character";
            return Err(RegisterFault::Invalid { what });
        }
        if self.discovery_urls.iter().all(|url| is_endpoint(url)) {
            Ok(())
        } else {
            Err(RegisterFault::Invalid {
                what: "a discovery URL is not the URL of a server: use `opc.tcp`, `opc.wss` or `https` with \
                       a host and a port from 1",
            })
        }
    }
}

/// Returns whether a server can be at a URL: a scheme of OPC 10000-6, 7, a host, and no port 0.
fn is_endpoint(url: &str) -> bool {
    let Some((scheme, rest)) = url.split_once("://") else {
        return false;
    };
    let authority = rest.split(['/', '?', '#']).next().unwrap_or_default();
    let (host, port) = match authority.rsplit_once(':') {
        Some((host, port)) if !port.contains(']') => (host, Some(port)),
        _ => (authority, None),
    };
    let has_port = port.is_none_or(|port| port.parse().is_ok_and(|port: u16| port > 0));
    SCHEMES
        .iter()
        .any(|known| known.eq_ignore_ascii_case(scheme))
        && !host.is_empty()
        && has_port
}

const SCHEMES: [&str; 6] = [
    "opc.tcp",
    "opc.tls",
    "opc.wss",
    "opc.https",
    "https",
    "http",
];

const MAX_TEXT: usize = 1024;
const MAX_NAMES: usize = 16;
const MAX_URLS: usize = 16;
const MAX_CAPABILITIES: usize = 32;
