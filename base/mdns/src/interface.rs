//! The network interface on which servers are announced and discovered.

use std::net::{IpAddr, Ipv4Addr};
use std::time::Duration;

use mdns_sd::{IfKind, IfPredicate};
use tokio::net::lookup_host;
use tokio::time::timeout;

use crate::range::Range;
use crate::url::Url;

/// A network interface, by name or by an address it has. Each level of a plant is a network of its
/// own: announcements on a network do not appear on another network.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct MdnsInterface {
    which: Which,
    /// Networks behind routers, from which announcements are accepted too.
    beyond: Vec<Range>,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash)]
enum Which {
    Name(String),
    Address(IpAddr),
}

/// An IPv4 address of an interface.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct InterfaceAddress {
    /// The index of the interface in the system.
    index: Option<u32>,
    pub(crate) address: Ipv4Addr,
}

impl MdnsInterface {
    /// The loopback interface, for this host only.
    pub const LOOPBACK: Self = Self::of(Which::Address(IpAddr::V4(Ipv4Addr::LOCALHOST)));

    const fn of(which: Which) -> Self {
        Self {
            which,
            beyond: Vec::new(),
        }
    }

    /// Parses an address, or else a name.
    #[must_use]
    pub fn parse(text: &str) -> Self {
        Self::of(match text.parse() {
            Ok(address) => Which::Address(address),
            Err(_) => Which::Name(text.to_owned()),
        })
    }

    /// Accepts announcements of addresses in these networks, too. Without them only addresses in
    /// the subnets of the interface are accepted, since any host on the network can announce any
    /// address.
    #[must_use]
    pub fn with_networks(mut self, networks: impl IntoIterator<Item = Range>) -> Self {
        self.beyond.extend(networks);
        self
    }

    /// Returns all interfaces of this host that have an IPv4 address.
    #[must_use]
    pub fn all() -> Vec<Self> {
        let all = if_addrs::get_if_addrs().unwrap_or_default();
        let addresses = all.iter().map(if_addrs::Interface::ip);
        addresses
            .filter(IpAddr::is_ipv4)
            .map(|address| Self::of(Which::Address(address)))
            .collect()
    }

    /// Returns whether an interface of the system is this interface.
    fn is(&self, interface: &if_addrs::Interface) -> bool {
        match &self.which {
            Which::Name(name) => interface.name == *name,
            Which::Address(address) => interface.ip() == *address,
        }
    }

    /// Returns the IPv4 addresses of the interface, which are used for mDNS.
    #[must_use]
    pub fn addresses(&self) -> Vec<Ipv4Addr> {
        let all = self.indexed_addresses().into_iter();
        all.map(|one| one.address).collect()
    }

    /// Returns the IPv4 addresses of the interface with its index in the system. An interface
    /// that is created again has another index.
    pub(crate) fn indexed_addresses(&self) -> Vec<InterfaceAddress> {
        let all = if_addrs::get_if_addrs().unwrap_or_default();
        let own = all.iter().filter(|interface| self.is(interface));
        own.filter_map(|interface| match interface.ip() {
            IpAddr::V4(address) => Some(InterfaceAddress {
                index: interface.index,
                address,
            }),
            IpAddr::V6(_) => None,
        })
        .collect()
    }

    /// Returns whether only this host is on the interface.
    pub fn is_loopback(&self) -> bool {
        match &self.which {
            Which::Address(address) => address.is_loopback(),
            Which::Name(_) => self.addresses().iter().all(Ipv4Addr::is_loopback),
        }
    }

    /// Returns whether a URL is that of a server in the subnets of the interface, or in a network
    /// that is accepted too. For URLs that were named by other hosts: a name is resolved, and all
    /// of its addresses have to be in these networks.
    pub async fn accepts(&self, url: &str) -> bool {
        let Some(place) = Url::parse(url) else {
            return false;
        };
        let looked_up = lookup_host((place.host.as_str(), place.port));
        let Ok(Ok(all)) = timeout(LOOK_UP_LIMIT, looked_up).await else {
            return false;
        };
        let subnets = self.subnets();
        let mut all = all.map(|address| address.ip().to_canonical()).peekable();
        all.peek().is_some()
            && all.all(|address| match address {
                IpAddr::V4(address) => subnets.contains(address),
                IpAddr::V6(_) => false,
            })
    }

    /// Returns the networks from which announcements are accepted.
    pub fn subnets(&self) -> Subnets {
        let all = if_addrs::get_if_addrs().unwrap_or_default();
        let own = all.iter().filter(|interface| self.is(interface));
        let networks = own.filter_map(|interface| match &interface.addr {
            if_addrs::IfAddr::V4(address) => Some((address.ip, address.netmask)),
            if_addrs::IfAddr::V6(_) => None,
        });
        Subnets {
            is_loopback: self.is_loopback(),
            networks: networks.collect(),
            beyond: self.beyond.clone(),
        }
    }

    /// Returns the interface for the mDNS daemon.
    pub fn kind(&self) -> IfKind {
        let this = self.clone();
        let is =
            move |interface: &if_addrs::Interface| interface.ip().is_ipv4() && this.is(interface);
        IfKind::Predicate(IfPredicate::new(is))
    }
}

/// The networks from which announcements are accepted: the subnets of an interface, and the
/// networks added by the operator.
#[derive(Debug, Clone)]
pub struct Subnets {
    is_loopback: bool,
    /// Addresses of the interface, with their masks.
    networks: Vec<(Ipv4Addr, Ipv4Addr)>,
    beyond: Vec<Range>,
}

impl Subnets {
    /// Returns the subnets of an interface with a single address.
    pub fn of(address: Ipv4Addr, mask: Ipv4Addr) -> Self {
        Self {
            is_loopback: address.is_loopback(),
            networks: vec![(address, mask)],
            beyond: Vec::new(),
        }
    }

    /// Returns whether only this host is on the network.
    pub const fn is_loopback(&self) -> bool {
        self.is_loopback
    }

    /// Returns whether a server at that address may be connected to.
    pub fn contains(&self, ip: Ipv4Addr) -> bool {
        let mut networks = self.networks.iter();
        let is_near =
            networks.any(|(own, mask)| (own.to_bits() ^ ip.to_bits()) & mask.to_bits() == 0);
        is_near || self.beyond.iter().any(|range| range.contains(ip))
    }
}

impl std::fmt::Display for MdnsInterface {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match &self.which {
            Which::Name(name) => f.write_str(name),
            Which::Address(address) => write!(f, "{address}"),
        }
    }
}

const LOOK_UP_LIMIT: Duration = Duration::from_secs(1);

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn a_url_outside_the_subnets_of_the_interface_is_not_accepted() {
        let loopback = MdnsInterface::LOOPBACK;
        assert!(loopback.accepts("opc.tcp://127.0.0.1:4840/a").await);
        for url in [
            "opc.tcp://192.0.2.7:4840",
            "opc.tcp://[2001:db8::1]:4840",
            "http://127.0.0.1",
            "opc.tcp://no-such-host.invalid",
        ] {
            assert!(!loopback.accepts(url).await, "{url}");
        }
    }

    #[test]
    fn an_address_counts_in_the_subnets_of_the_interface_and_where_the_operator_says_so() {
        let mut subnets = Subnets::of(Ipv4Addr::new(10, 9, 0, 1), Ipv4Addr::new(255, 255, 255, 0));
        assert!(subnets.contains(Ipv4Addr::new(10, 9, 0, 77)));
        assert!(!subnets.contains(Ipv4Addr::new(10, 77, 0, 9)));
        subnets.beyond.push("10.77.0.0/24".parse().unwrap());
        assert!(subnets.contains(Ipv4Addr::new(10, 77, 0, 9)));
        assert!(!subnets.contains(Ipv4Addr::new(10, 78, 0, 9)));
        assert!(
            MdnsInterface::LOOPBACK
                .subnets()
                .contains(Ipv4Addr::LOCALHOST)
        );
    }
}
