//! Settings for NetworkMessages: [`PubSub`].

use std::net::{Ipv4Addr, SocketAddr};
use std::time::Duration;

use crate::broker::Broker;
use crate::carriers::ConfiguredCarrier;

/// Settings for NetworkMessages between the spaces.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PubSub {
    /// Group or host that NetworkMessages are sent to, and its UDP port.
    pub address: SocketAddr,
    /// MQTT broker that carries the messages instead of UDP.
    pub broker: Option<Box<Broker>>,
    /// Name or address of the network interface; `None` lets the operating system choose.
    pub interface: Option<String>,
    /// Hops a multicast datagram may travel; 1 stays on the link.
    pub ttl: u8,
    /// Hosts that datagrams are sent to instead of `address`, for networks without multicast.
    pub peers: Vec<SocketAddr>,
    /// Rule for the PublisherIds of a space.
    pub publisher_id: PublisherIdRule,
    /// A value that does not change is sent again after this time, which heals a lost datagram.
    pub key_frame_period: Duration,
    /// A writer without a new value sends a keep-alive message after this time.
    pub keep_alive_period: Duration,
    /// A writer that is silent for this long is lost; longer than `keep_alive_period`.
    pub receive_timeout: Duration,
    /// Period in which a writer announces the fields of its messages (DataSetMetaData: OPC
    /// 10000-14, 7.2.4.6.4). It also announces them at its start and on request.
    pub metadata_period: Duration,
    /// Bytes of the largest NetworkMessage that is sent as one datagram; a larger message is sent
    /// in chunks of this size (OPC 10000-14, 7.2.4.4.4).
    pub max_datagram: u16,
    /// Bytes of the largest DataSetMessage that is sent, or reassembled from chunks.
    pub max_message: u32,
    /// Largest number of DataSetMessages of one WriterGroup that share a NetworkMessage, if they
    /// wait to be sent and fit into [`max_datagram`](Self::max_datagram) and an Ethernet frame; 1
    /// sends each alone.
    pub messages_per_datagram: u8,
    /// The carriers of a mapping that lists several or uses Ethernet; otherwise empty.
    /// [`address`](Self::address) and [`broker`](Self::broker) are then the first of each kind.
    pub carriers: Vec<ConfiguredCarrier>,
}

impl PubSub {
    /// The largest number of carriers.
    pub const MOST_CARRIERS: usize = 4;
    /// The largest UDP payload over IPv4.
    pub const LARGEST_DATAGRAM: u16 = 65_507;
    /// Size for the headers of a chunk and a part of the message.
    pub const SMALLEST_DATAGRAM: u16 = 512;

    /// 239.192.0.40:4840. The group is of the IPv4 organization-local scope (RFC 2365, 6.2), so no
    /// router forwards it to the Internet; the port is registered for OPC UA over UDP (OPC
    /// 10000-14, 7.3.2).
    pub const ADDRESS: SocketAddr =
        SocketAddr::new(std::net::IpAddr::V4(Ipv4Addr::new(239, 192, 0, 40)), 4840);
    /// Reads `opc.udp://<numeric group or host>:<port>`; the default port is 4840 (OPC 10000-14,
    /// 7.3.2).
    #[must_use]
    pub fn parse_address(url: &str) -> Option<SocketAddr> {
        let rest = url.strip_prefix("opc.udp://")?;
        let rest = rest.strip_suffix('/').unwrap_or(rest);
        let alone = || {
            rest.trim_start_matches('[')
                .trim_end_matches(']')
                .parse()
                .ok()
        };
        rest.parse()
            .ok()
            .or_else(|| Some(SocketAddr::new(alone()?, Self::ADDRESS.port())))
    }

    /// Group that OPC 10000-14, 7.3.2.1 reserves for discovery messages: no data may be sent to it.
    pub const DISCOVERY_GROUP: Ipv4Addr = Ipv4Addr::new(224, 0, 2, 14);
}

impl Default for PubSub {
    fn default() -> Self {
        Self {
            address: Self::ADDRESS,
            broker: None,
            interface: None,
            ttl: 1,
            peers: Vec::new(),
            publisher_id: PublisherIdRule::Exact,
            key_frame_period: Duration::from_secs(1),
            keep_alive_period: Duration::from_secs(1),
            receive_timeout: Duration::from_secs(3),
            metadata_period: Duration::from_secs(30),
            max_datagram: Self::LARGEST_DATAGRAM,
            max_message: 64 << 20,
            messages_per_datagram: 1,
            carriers: Vec::new(),
        }
    }
}

/// Rule for the PublisherIds of a space.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum PublisherIdRule {
    /// Only a UInt16 of the space's number: type and value must be equal (OPC 10000-14, 7.2.4.4.2).
    #[default]
    Exact,
    /// The space's number in any unsigned integer type, for publishers that cannot send UInt16.
    AnyWidth,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_default_group_stays_within_the_organization() {
        let SocketAddr::V4(address) = PubSub::default().address else {
            panic!("IPv4")
        };
        // RFC 2365, 6.2: 239.192.0.0/14
        assert_eq!(address.ip().octets()[0], 239);
        assert_eq!(address.ip().octets()[1] & 0b1111_1100, 192);
        assert!(PubSub::default().receive_timeout > PubSub::default().keep_alive_period);
    }
}
