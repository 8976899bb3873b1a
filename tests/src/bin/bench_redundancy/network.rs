//! The network of the group: an interface for each bridge and for the reader, at one switch.

use std::net::Ipv4Addr;
use std::process::Command;

use crate::address;

/// An interface of this host.
pub(crate) struct Interface {
    pub(crate) name: &'static str,
    address: Ipv4Addr,
}

/// The interfaces of the bridges.
pub(crate) const BRIDGES: [Interface; 2] = [
    Interface {
        name: "group1",
        address: address(1),
    },
    Interface {
        name: "group2",
        address: address(2),
    },
];
/// The address of the reader.
pub(crate) const READER: Ipv4Addr = address(3);

/// The switch with the interfaces.
pub(crate) struct Network;

impl Network {
    /// Lays the network in the namespace of this process.
    pub(crate) fn lay() -> Self {
        ip("link add switch type bridge mcast_snooping 0");
        ip("link set switch up");
        let reader = Interface {
            name: "reader",
            address: READER,
        };
        set("all", "rp_filter", "0");
        for Interface { name, address } in BRIDGES.iter().chain([&reader]) {
            ip(&format!("link add {name} type veth peer name {name}p"));
            ip(&format!("link set {name}p master switch up"));
            ip(&format!("address add {address}/24 dev {name}"));
            ip(&format!("link set {name} up"));
            // All ends are on this host: without this, it drops datagrams from its own addresses.
            set(name, "accept_local", "1");
            set(name, "rp_filter", "0");
        }
        Self
    }

    /// Unplugs a bridge from the switch. Its interface stays up.
    pub(crate) fn cut(&self, bridge: usize) {
        ip(&format!("link set {}p nomaster", BRIDGES[bridge].name));
    }

    /// Ends [`cut`](Self::cut).
    pub(crate) fn mend(&self, bridge: usize) {
        ip(&format!("link set {}p master switch", BRIDGES[bridge].name));
    }
}

fn ip(args: &str) {
    let done = Command::new("ip").args(args.split(' ')).status().unwrap();
    assert!(done.success(), "ip {args}");
}

fn set(interface: &str, key: &str, value: &str) {
    let path = format!("/proc/sys/net/ipv4/conf/{interface}/{key}");
    std::fs::write(&path, value).unwrap_or_else(|error| panic!("{path}: {error}"));
}
