//! A range of IPv4 addresses, written as a network.

use std::net::Ipv4Addr;
use std::str::FromStr;

/// The IPv4 host addresses of a network, which are tried in turn.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Range {
    first: u32,
    count: u32,
}

/// Error for an invalid range.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum RangeFault {
    /// The text is not a range.
    #[error("`{0}` is not a range of IPv4 addresses, such as 192.168.0.0/24")]
    Malformed(String),
    /// The range has more addresses than are tried.
    #[error("/{0} has more than 65536 addresses: use /16 or a smaller range")]
    Wide(u8),
}

impl Range {
    /// Returns the number of addresses.
    #[must_use]
    pub const fn hosts(self) -> u32 {
        self.count
    }

    /// Returns whether an address is that of a host in the network.
    #[must_use]
    pub fn contains(self, address: Ipv4Addr) -> bool {
        let at = address.to_bits().checked_sub(self.first);
        at.is_some_and(|at| at < self.count)
    }

    /// Returns all addresses in order.
    pub fn addresses(self) -> impl Iterator<Item = Ipv4Addr> {
        (0..self.count).map(move |at| Ipv4Addr::from_bits(self.first.saturating_add(at)))
    }
}

impl FromStr for Range {
    type Err = RangeFault;

    /// Parses an address, or a network such as `192.168.0.0/24`. The network address and the
    /// broadcast address are excluded if the network has more than two addresses.
    fn from_str(text: &str) -> Result<Self, RangeFault> {
        let malformed = || RangeFault::Malformed(text.to_owned());
        let (address, prefix) = text.split_once('/').unwrap_or((text, "32"));
        let address: Ipv4Addr = address.parse().map_err(|_| malformed())?;
        let prefix: u8 = prefix.parse().map_err(|_| malformed())?;
        if prefix > 32 {
            return Err(malformed());
        }
        if prefix < WIDEST {
            return Err(RangeFault::Wide(prefix));
        }
        let count = 1_u32 << (32 - prefix);
        let network = address.to_bits() & !(count - 1);
        Ok(match prefix {
            31 | 32 => Self {
                first: network,
                count,
            },
            _ => Self {
                first: network + 1,
                count: count - 2,
            },
        })
    }
}

/// The widest network is /16.
const WIDEST: u8 = 16;

#[cfg(test)]
mod tests {
    use super::*;

    fn range(text: &str) -> Result<Range, RangeFault> {
        text.parse()
    }

    fn all(text: &str) -> Vec<String> {
        let range = range(text).unwrap();
        range.addresses().map(|ip| ip.to_string()).collect()
    }

    #[test]
    fn the_hosts_of_a_network_are_tried_and_not_the_network() {
        assert_eq!(all("10.0.0.7/30"), ["10.0.0.5", "10.0.0.6"]);
        assert_eq!(all("10.0.0.7/31"), ["10.0.0.6", "10.0.0.7"]);
        assert_eq!(all("10.0.0.7"), ["10.0.0.7"]);
        assert_eq!(range("10.1.2.3/16").unwrap().hosts(), 65_534);
        let last: Vec<String> = all("255.255.255.255/24");
        assert_eq!(last.last().map(String::as_str), Some("255.255.255.254"));
    }

    #[test]
    fn what_is_wider_or_no_range_is_refused() {
        assert_eq!(range("10.0.0.0/15"), Err(RangeFault::Wide(15)));
        assert_eq!(range("0.0.0.0/0"), Err(RangeFault::Wide(0)));
        for text in [
            "",
            "10.0.0",
            "10.0.0.0/33",
            "10.0.0.0/",
            "10.0.0.0/-1",
            "::1/128",
            "a/24",
        ] {
            assert_eq!(range(text), Err(RangeFault::Malformed(text.to_owned())));
        }
    }
}
