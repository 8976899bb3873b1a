//! Ethernet interfaces of this host.

use std::io;

use nix::ifaddrs::getifaddrs;
use nix::net::if_::InterfaceFlags;
use nix::sys::socket::LinkAddr;

use super::EthernetError;
use crate::interface::InterfaceError;

/// An Ethernet interface of this host. Its sockets stay valid while it is equal.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct EthernetPort {
    pub(super) name: String,
    /// The index and address of the interface, to bind sockets to it.
    pub(super) link: LinkAddr,
    /// The MAC address.
    pub(super) address: [u8; 6],
    /// True if the interface is up and has a link.
    pub(super) is_up: bool,
}

impl EthernetPort {
    /// Finds the interface with a name.
    ///
    /// # Errors
    /// [`InterfaceError::Unknown`] with the present interfaces, and [`EthernetError::NoEthernet`].
    pub(super) fn find(wanted: &str) -> Result<Self, EthernetError> {
        let listed = getifaddrs().map_err(io::Error::from);
        let listed = listed.map_err(InterfaceError::List)?;
        let mut present = Vec::new();
        for interface in listed {
            let Some(link) = interface.address.as_ref().and_then(|of| of.as_link_addr()) else {
                continue;
            };
            if interface.interface_name != wanted {
                present.push(interface.interface_name);
                continue;
            }
            let address = link.addr().filter(|_| link.hatype() == ETHERNET);
            let Some(address) = address else {
                return Err(EthernetError::NoEthernet(wanted.to_owned()));
            };
            let running = InterfaceFlags::IFF_UP | InterfaceFlags::IFF_RUNNING;
            return Ok(Self {
                name: interface.interface_name,
                link: *link,
                address,
                is_up: interface.flags.contains(running),
            });
        }
        let unknown = InterfaceError::Unknown {
            wanted: wanted.to_owned(),
            present: present.join(", "),
        };
        Err(unknown.into())
    }

    /// Returns the index of the interface.
    pub(super) fn index(&self) -> u32 {
        u32::try_from(self.link.ifindex()).unwrap_or_default()
    }
}

/// The type of Ethernet among the types of hardware (`ARPHRD_ETHER`).
const ETHERNET: u16 = 1;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn loopback_carries_no_frames_and_an_unknown_interface_is_refused_with_what_there_is() {
        let loopback = EthernetPort::find("lo").unwrap_err();
        assert!(
            matches!(loopback, EthernetError::NoEthernet(_)),
            "{loopback}"
        );
        let unknown = EthernetPort::find("nosuch0").unwrap_err().to_string();
        let is_listed = unknown.contains("nosuch0") && unknown.contains("lo");
        assert!(is_listed, "{unknown}");
    }
}
