//! Network interfaces by name or address.

use std::fmt;
use std::net::{IpAddr, Ipv4Addr};

/// An IPv4 address of a network interface of this host.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Interface {
    /// Name of the interface, such as `eth0`.
    pub name: String,
    /// Interface index of the kernel.
    pub index: u32,
    /// IPv4 address of the interface.
    pub address: Ipv4Addr,
    /// True if the interface is up and has a link.
    pub up: bool,
}

impl fmt::Display for Interface {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} ({})", self.name, self.address)
    }
}

/// Reason why no interface was found.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum InterfaceError {
    /// No interface has the requested name or address.
    #[error("unknown network interface `{wanted}`; this host has: {present}")]
    Unknown {
        /// Requested name or address.
        wanted: String,
        /// Present interfaces, for the message.
        present: String,
    },
    /// The system cannot list its interfaces.
    #[error("cannot list the network interfaces: {0}")]
    List(#[source] std::io::Error),
}

impl Interface {
    /// Finds the interface with a name (`eth0`) or an IPv4 address.
    ///
    /// # Errors
    /// [`InterfaceError::Unknown`] with the present interfaces.
    pub fn find(wanted: &str) -> Result<Self, InterfaceError> {
        let present = interfaces().map_err(InterfaceError::List)?;
        present
            .iter()
            .find(|interface| interface.is(wanted))
            .cloned()
            .ok_or_else(|| InterfaceError::Unknown {
                wanted: wanted.to_owned(),
                present: if present.is_empty() {
                    "none with an IPv4 address".to_owned()
                } else {
                    present
                        .iter()
                        .map(ToString::to_string)
                        .collect::<Vec<_>>()
                        .join(", ")
                },
            })
    }

    /// Returns true for the name or the address of the interface.
    pub(crate) fn is(&self, wanted: &str) -> bool {
        self.name == wanted || wanted.parse() == Ok(self.address)
    }

    /// Returns the speed in bytes per second, or `None` if the system does not know it.
    pub(crate) fn speed(&self) -> Option<u64> {
        speed(&self.name)
    }

    /// Returns true if kernel state of `other` is still valid. A recreated interface has another
    /// index.
    pub(crate) fn is_same(&self, other: &Self) -> bool {
        (&self.name, self.index, self.address) == (&other.name, other.index, other.address)
    }
}

/// Returns the speed of an interface in bytes per second, or `None` if the system does not know it.
pub(crate) fn speed(interface: &str) -> Option<u64> {
    let path = std::path::Path::new("/sys/class/net")
        .join(interface)
        .join("speed");
    // Mbit/s. An interface without a link has -1, and a wireless interface cannot be read.
    speed_of(&std::fs::read_to_string(path).ok()?)
}

/// Returns the bytes per second of a speed in Mbit/s.
fn speed_of(megabits: &str) -> Option<u64> {
    let megabits: u64 = megabits.trim().parse().ok()?;
    (megabits > 0).then(|| megabits.saturating_mul(1_000_000 / 8))
}

/// Returns the IPv4 addresses of the interfaces of this host, in the order of the system.
///
/// # Errors
/// The error of the system if it cannot list its interfaces.
pub fn interfaces() -> std::io::Result<Vec<Interface>> {
    let mut found: Vec<Interface> = if_addrs::get_if_addrs()?
        .into_iter()
        .filter_map(|interface| match interface.ip() {
            IpAddr::V4(address) => Some(Interface {
                index: interface.index.unwrap_or_default(),
                up: interface.is_oper_up(),
                name: interface.name,
                address,
            }),
            IpAddr::V6(_) => None,
        })
        .collect();
    found.dedup();
    Ok(found)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn loopback_is_found_by_name_and_by_address() {
        let by_address = Interface::find("127.0.0.1").unwrap();
        assert_eq!(
            Interface::find(&by_address.name).unwrap().address,
            by_address.address
        );
    }

    #[test]
    fn the_speed_is_in_bytes_and_an_interface_without_a_link_has_none() {
        assert_eq!(speed_of("100\n"), Some(12_500_000));
        assert_eq!(speed_of("1000\n"), Some(125_000_000));
        for none in ["-1\n", "0\n", "", "fast\n", "18446744073709551616\n"] {
            assert_eq!(speed_of(none), None, "{none}");
        }
    }

    #[test]
    fn an_unknown_interface_is_refused_with_what_there_is() {
        let error = Interface::find("nosuch0").unwrap_err().to_string();
        assert!(
            error.contains("nosuch0") && error.contains("127.0.0.1"),
            "{error}"
        );
    }
}
