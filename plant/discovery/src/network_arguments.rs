//! The option of programs that look for servers on the network.

use mdns::{MdnsInterface, Range};

/// The option of programs that look for servers on the network.
#[derive(Debug, Clone, Default, clap::Args)]
pub struct NetworkArguments {
    /// Networks behind routers with servers that are also accepted, such as 10.77.0.0/16. Default:
    /// only servers with addresses in the subnets of the interface, because any host can announce
    /// any address
    #[arg(
        long = "network",
        value_name = "CIDR",
        env = "UA_NETWORKS",
        value_delimiter = ','
    )]
    networks: Vec<Range>,
}

impl NetworkArguments {
    /// Returns the interface of mDNS with a name or an address, by default loopback, and with these
    /// networks.
    #[must_use]
    pub fn interface(&self, interface: Option<&str>) -> MdnsInterface {
        let interface = interface.map_or(MdnsInterface::LOOPBACK, MdnsInterface::parse);
        interface.with_networks(self.networks.iter().copied())
    }
}
