//! Network interfaces by name or address.

use std::fmt;
use std::net::{IpAddr, Ipv4Addr};

/// One IPv4 address of one network interface of this machine.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Interface {
    /// The name the system gives it, such as `eth0`.
    pub name: String,
    /// The index the kernel knows it by.
    pub index: u32,
    /// An IPv4 address it has.
    pub address: Ipv4Addr,
    /// Whether it is up and has a link.
    pub up: bool,
}

impl fmt::Display for Interface {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} ({})", self.name, self.address)
    }
}

/// Why no interface could be chosen.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum InterfaceError {
    /// No interface has the name or address asked for.
    #[error("no network interface `{wanted}` here; there are: {present}")]
    Unknown {
        /// What was asked for.
        wanted: String,
        /// What there is, for the message.
        present: String,
    },
    /// The system would not list its interfaces.
    #[error("the network interfaces cannot be listed: {0}")]
    List(#[source] std::io::Error),
}

impl Interface {
    /// Finds the interface that `wanted` names: by name (`eth0`) or by one of its IPv4 addresses.
    ///
    /// # Errors
    /// [`InterfaceError::Unknown`] lists what there is.
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

    /// Whether that is its name or its address.
    pub(crate) fn is(&self, wanted: &str) -> bool {
        self.name == wanted || wanted.parse() == Ok(self.address)
    }

    /// Whether the kernel has kept what was made for `other`: one that was made anew has another index.
    pub(crate) fn is_same(&self, other: &Self) -> bool {
        (&self.name, self.index, self.address) == (&other.name, other.index, other.address)
    }
}

/// The IPv4 addresses of this machine's interfaces, in the system's order.
///
/// # Errors
/// What the system answers when it will not list them.
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
    fn an_unknown_interface_is_refused_with_what_there_is() {
        let error = Interface::find("nosuch0").unwrap_err().to_string();
        assert!(
            error.contains("nosuch0") && error.contains("127.0.0.1"),
            "{error}"
        );
    }
}
