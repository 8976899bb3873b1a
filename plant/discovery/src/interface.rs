//! The network interface on which servers are announced and heard.

use std::net::{IpAddr, Ipv4Addr};

use mdns_sd::{IfKind, IfPredicate};

/// One network interface, by name or by an address it has. One level of a plant is one network: what is announced on one
/// does not appear on another.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct Interface(Which);

#[derive(Debug, Clone, PartialEq, Eq, Hash)]
enum Which {
    Name(String),
    Address(IpAddr),
}

impl Interface {
    /// The host with itself.
    pub const LOOPBACK: Self = Self(Which::Address(IpAddr::V4(Ipv4Addr::LOCALHOST)));

    /// By an address, or else by name.
    #[must_use]
    pub fn parse(text: &str) -> Self {
        Self(match text.parse() {
            Ok(address) => Which::Address(address),
            Err(_) => Which::Name(text.to_owned()),
        })
    }

    /// All of this host that have an IPv4 address.
    #[must_use]
    pub fn all() -> Vec<Self> {
        let all = if_addrs::get_if_addrs().unwrap_or_default();
        let addresses = all.iter().map(if_addrs::Interface::ip);
        addresses
            .filter(IpAddr::is_ipv4)
            .map(|address| Self(Which::Address(address)))
            .collect()
    }

    /// Whether it is this one.
    fn is(&self, interface: &if_addrs::Interface) -> bool {
        match &self.0 {
            Which::Name(name) => interface.name == *name,
            Which::Address(address) => interface.ip() == *address,
        }
    }

    /// Its IPv4 addresses, which is what is announced and heard by.
    #[must_use]
    pub fn addresses(&self) -> Vec<Ipv4Addr> {
        let all = if_addrs::get_if_addrs().unwrap_or_default();
        let addresses = all.iter().filter(|interface| self.is(interface));
        addresses
            .filter_map(|interface| match interface.ip() {
                IpAddr::V4(address) => Some(address),
                IpAddr::V6(_) => None,
            })
            .collect()
    }

    /// Whether only this host is on it.
    pub(crate) fn is_loopback(&self) -> bool {
        match &self.0 {
            Which::Address(address) => address.is_loopback(),
            Which::Name(_) => self.addresses().iter().all(Ipv4Addr::is_loopback),
        }
    }

    /// For the mDNS daemon.
    pub(crate) fn kind(&self) -> IfKind {
        let this = self.clone();
        let is =
            move |interface: &if_addrs::Interface| interface.ip().is_ipv4() && this.is(interface);
        IfKind::Predicate(IfPredicate::new(is))
    }
}

impl std::fmt::Display for Interface {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match &self.0 {
            Which::Name(name) => f.write_str(name),
            Which::Address(address) => write!(f, "{address}"),
        }
    }
}
