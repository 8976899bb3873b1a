//! Several hosts on several networks: a plant with its levels.

use std::path::PathBuf;

use crate::Cell;
use crate::host::Namespace;

/// A host with its own loopback, and otherwise only the networks it is plugged into.
pub struct PlantSite(Namespace);

/// A network of level 2: a bridge.
pub struct Segment(Namespace);

impl Cell {
    /// Creates a host.
    #[must_use]
    pub fn site(&self) -> PlantSite {
        PlantSite(Namespace::fresh())
    }

    /// Creates a network without hosts.
    #[must_use]
    pub fn segment(&self) -> Segment {
        let segment = Namespace::fresh();
        segment.ip(&[
            "link",
            "add",
            BRIDGE,
            "type",
            "bridge",
            "mcast_snooping",
            "0",
        ]);
        segment.ip(&["link", "set", BRIDGE, "up"]);
        Segment(segment)
    }
}

impl Segment {
    /// Connects a host with an interface of the name `interface` and an address of a 24-bit
    /// network.
    ///
    /// # Panics
    /// Panics if the host has an interface with this name.
    pub fn plug(&self, site: &PlantSite, interface: &str, address: &str) {
        let Self(here) = self;
        let end = end_of(address);
        let path = site.path();
        let path = path.to_string_lossy();
        here.ip(&[
            "link", "add", &end, "type", "veth", "peer", "name", interface, "netns", &path,
        ]);
        here.ip(&["link", "set", &end, "master", BRIDGE, "up"]);
        let address = format!("{address}/24");
        for args in [
            &["address", "add", &address, "dev", interface][..],
            &["link", "set", interface, "multicast", "on", "up"],
        ] {
            site.0.ip(args);
        }
    }

    /// Pulls the cable of the host with this address, which removes the interface.
    ///
    /// # Panics
    /// Panics if no host is connected with this address.
    pub fn pull(&self, address: &str) {
        self.0.ip(&["link", "delete", &end_of(address)]);
    }

    /// Takes away or returns the link of the host with this address. Its interface stays.
    ///
    /// # Panics
    /// Panics if no host is connected with this address.
    pub fn set_link(&self, address: &str, is_up: bool) {
        let state = if is_up { "up" } else { "down" };
        self.0.ip(&["link", "set", &end_of(address), state]);
    }

    /// Cuts the host with this address off, or ends it. The host keeps its link.
    ///
    /// # Panics
    /// Panics if no host is connected with this address.
    pub fn set_cut_off(&self, address: &str, is_cut_off: bool) {
        let end = end_of(address);
        match is_cut_off {
            true => self.0.ip(&["link", "set", &end, "nomaster"]),
            false => self.0.ip(&["link", "set", &end, "master", BRIDGE]),
        }
    }
}

/// Returns the name of the end of a cable in the network. Names of interfaces have at most 15
/// characters and are unique.
fn end_of(address: &str) -> String {
    format!("p{}", address.replace('.', "-"))
}

impl PlantSite {
    pub(crate) fn path(&self) -> PathBuf {
        self.0.path()
    }

    /// Runs a function on this host.
    pub fn within<T: Send>(&self, what: impl FnOnce() -> T + Send) -> T {
        self.0.within(what)
    }
}

const BRIDGE: &str = "bridge0";
