//! The network interfaces of the local side.

use std::net::IpAddr;

use service::{Failure, FailureKind};
use tracing::{info, warn};
use transport::{HeldInterfaces, InterfaceFinding};

/// The network interfaces of the local side, which its port cannot change while it runs. `None` if
/// the port follows all changes, or uses loopback only.
#[derive(Debug)]
pub(crate) struct SideInterfaces(Option<HeldInterfaces>);

impl SideInterfaces {
    /// Starts to watch the interfaces with these addresses; all of them if the list is empty.
    pub(crate) fn start(addresses: Option<&[IpAddr]>) -> Self {
        Self(addresses.and_then(HeldInterfaces::start))
    }

    pub(super) const fn is_watched(&self) -> bool {
        self.0.is_some()
    }

    /// Updates the state, without a report.
    pub(super) fn refresh(&mut self) {
        if let Some(held) = &mut self.0 {
            held.refresh();
        }
    }

    /// Returns the addresses whose links are lost; `None` without watched interfaces.
    pub(super) fn lost_addresses(&self) -> Option<Vec<IpAddr>> {
        self.0.as_ref().map(HeldInterfaces::lost_addresses)
    }

    /// Returns the message that the local side is out of reach, if it is.
    pub(super) fn lost(&self) -> Option<String> {
        self.0
            .as_ref()
            .and_then(HeldInterfaces::lost)
            .map(side_lost)
    }

    /// Returns 1 if the local side is within reach and 0 if it is not; `None` without watched
    /// interfaces.
    pub(super) fn up(&self) -> Option<u8> {
        let held = self.0.as_ref()?;
        Some(u8::from(held.lost().is_none()))
    }

    /// Checks the interfaces, and logs the changes.
    ///
    /// # Errors
    /// The local side cannot follow a change.
    pub(super) fn report(&mut self) -> Result<(), Failure> {
        let findings = self.0.as_mut().map(HeldInterfaces::look);
        for finding in findings.into_iter().flatten() {
            let told = match finding {
                InterfaceFinding::Lost(why) => side_lost(why),
                InterfaceFinding::Late(interface) => format!(
                    "the network interface {interface} appeared after the start: the ROS side does not use \
                     it until this program is restarted"
                ),
                InterfaceFinding::Back(interface) => {
                    info!(%interface, "the network interface of the ROS side is up again");
                    continue;
                }
                InterfaceFinding::Void(why) => {
                    let message = format!(
                        "{why}, and the ROS side cannot switch to it: stopping; the service manager should \
                         restart this program"
                    );
                    return Err(Failure::new(FailureKind::Unavailable, message));
                }
            };
            warn!("{told}");
        }
        Ok(())
    }
}

fn side_lost(why: String) -> String {
    format!("the network of the ROS side is out of reach: {why}")
}
