//! Announcements of OPC UA servers by DNS-SD (OPC 10000-12, Annex C).
//!
//! Any host on the network can send announcements, so URLs and capabilities are validated.

use std::net::{IpAddr, Ipv4Addr};
use std::num::NonZeroU16;

use mdns_sd::ResolvedService;
use registry::{AnnouncedServer, label};

use crate::host_name;
use crate::interface::{MdnsInterface, Subnets};
use crate::url::Url;

/// Error of starting the mDNS daemon.
#[derive(Debug, thiserror::Error)]
#[error("cannot use mDNS on {interface}: {source}")]
pub struct MdnsFault {
    interface: String,
    #[source]
    source: mdns_sd::Error,
}

impl MdnsFault {
    pub(crate) fn new(interface: &MdnsInterface, source: mdns_sd::Error) -> Self {
        Self {
            interface: interface.to_string(),
            source,
        }
    }
}

/// Event on the network.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum MdnsEvent {
    /// A server was announced for the first time or with changes.
    Announced {
        /// Announcement of the server.
        announcement: AnnouncedServer,
        /// Additional properties of programs of this project.
        aside: Aside,
    },
    /// A server has ended: a goodbye was received, or its announcement has expired.
    Withdrawn {
        /// The instance name of the server.
        instance: String,
    },
    /// Another host has the name of an announced server, which is renamed.
    Renamed {
        /// The previous instance name.
        from: String,
        /// The new instance name.
        to: String,
    },
}

/// An announcement of this program.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct OwnAnnouncement {
    /// The standard part of the announcement.
    pub announcement: AnnouncedServer,
    /// The keys that programs of this project add.
    pub aside: Aside,
}

/// Additional properties of programs of this project, in TXT keys that other programs ignore.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Aside {
    /// Start time of the program, in 100 ns since 1601.
    pub start_time: Option<i64>,
    /// Number of the program in the space: the namespace of its values there.
    pub number: Option<NonZeroU16>,
}

impl Aside {
    /// Returns the properties of a program without a number.
    pub const fn of_start(start_time: i64) -> Self {
        Self {
            start_time: Some(start_time),
            number: None,
        }
    }
}

/// Returns whether a name is that of this host, with or without a domain.
pub fn is_own(name: &str) -> bool {
    let first = |name: &str| {
        name.split('.')
            .next()
            .unwrap_or_default()
            .to_ascii_lowercase()
    };
    let name = first(name);
    name == "localhost" || name == first(&host_name())
}

/// Returns whether two URLs have the same endpoint.
pub fn same_place(one: &str, other: &str) -> bool {
    one.trim_end_matches('/') == other.trim_end_matches('/')
}

/// Converts a received announcement for the registry.
pub fn heard(service: &ResolvedService, subnets: &Subnets) -> Option<(AnnouncedServer, Aside)> {
    let records = ServerRecords {
        instance: instance(&service.fullname)?,
        addresses: service.get_addresses_v4().into_iter().collect(),
        port: service.port,
    };
    let text = |key: &str| service.get_property_val(key).flatten();
    records.announcement(text, subnets)
}

/// The records of a server, without its texts.
#[derive(Debug)]
pub(crate) struct ServerRecords {
    pub(crate) instance: String,
    pub(crate) addresses: Vec<Ipv4Addr>,
    pub(crate) port: u16,
}

impl ServerRecords {
    /// Returns the announcement in the records, with the text of each key. `None` if a part is
    /// invalid.
    pub(crate) fn announcement<'t>(
        self,
        text: impl Fn(&str) -> Option<&'t [u8]>,
        subnets: &Subnets,
    ) -> Option<(AnnouncedServer, Aside)> {
        let Self {
            instance,
            addresses,
            port,
        } = self;
        let path = match text("path").map(std::str::from_utf8) {
            None => "",
            Some(Ok(path)) if path.bytes().all(|byte| byte.is_ascii_graphic()) => path,
            Some(_) => return None,
        };
        let slash = if path.is_empty() || path.starts_with('/') {
            ""
        } else {
            "/"
        };
        let ip = address(addresses, subnets)?;
        if port == 0 {
            return None;
        }
        let url = Url::of(IpAddr::V4(ip), port, &format!("{slash}{path}")).to_string();
        let texts = |key| text(key).and_then(|value| std::str::from_utf8(value).ok());
        let capabilities = texts("caps").unwrap_or_default().split(',').map(str::trim);
        let capabilities = capabilities
            .filter(|code| is_code(code))
            .take(MOST_CAPABILITIES);
        let announcement = AnnouncedServer {
            instance,
            url,
            capabilities: capabilities.map(str::to_owned).collect(),
        };
        let aside = Aside {
            start_time: texts(START).and_then(|at| at.parse().ok()),
            number: texts(NUMBER).and_then(|number| number.parse().ok()),
        };
        Some((announcement, aside))
    }
}

/// Returns the address to try. Loopback addresses of a network and addresses outside its subnets
/// are excluded.
pub(crate) fn address(
    all: impl IntoIterator<Item = Ipv4Addr>,
    subnets: &Subnets,
) -> Option<Ipv4Addr> {
    let loopback = subnets.is_loopback();
    let usable = |ip: &Ipv4Addr| {
        let one = !(ip.is_unspecified() || ip.is_multicast() || ip.is_broadcast());
        one && (loopback || !ip.is_loopback()) && subnets.contains(*ip)
    };
    // The more specific address first: a loopback address among several addresses is valid on its
    // own host only.
    let all = all.into_iter().filter(usable);
    all.min_by_key(|ip| (ip.is_loopback() != loopback, ip.is_link_local(), *ip))
}

/// Returns whether a text is a code of OPC 10000-12, Annex D, or of a manufacturer.
fn is_code(text: &str) -> bool {
    !text.is_empty() && text.len() <= 32 && text.bytes().all(|byte| byte.is_ascii_graphic())
}

/// Returns the name before the service, or `None` if the name cannot be displayed.
pub(crate) fn instance(fullname: &str) -> Option<String> {
    let at = fullname.len().checked_sub(SERVICE.len() + 1)?;
    let (name, service) = fullname.split_at_checked(at)?;
    let service = service.strip_prefix('.')?;
    if !service.eq_ignore_ascii_case(SERVICE) || name.is_empty() {
        return None;
    }
    let name = name.replace("\\.", ".").replace("\\\\", "\\");
    (label(&name) == name).then_some(name)
}

/// The service of OPC UA servers over TCP (OPC 10000-12, Annex C).
pub const SERVICE: &str = "_opcua-tcp._tcp.local.";
/// The key of the TXT record with the start time, which distinguishes the runs of a program. Only
/// programs of this project use it.
pub(crate) const START: &str = "start";
/// The key of the TXT record with the number in the space. Only programs of this project use it.
pub(crate) const NUMBER: &str = "ns";
const MOST_CAPABILITIES: usize = 32;

#[cfg(test)]
mod tests;
