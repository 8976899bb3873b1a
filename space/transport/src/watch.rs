//! Detection of interfaces that change while a program runs.
//!
//! A multicast group is joined on an interface by its index, and a sender is bound to an address.
//! If the interface is deleted and recreated, or gets another address, both become invalid without
//! a notification of the kernel. So the interfaces are polled each second. Listing them takes less
//! than a tenth of a millisecond and needs no privilege.

use std::error::Error;
use std::io;
use std::net::{IpAddr, Ipv4Addr, SocketAddr, UdpSocket};
use std::time::Duration;

use crate::interface::{Interface, interfaces};

/// Polling interval of interfaces.
pub const LOOK: Duration = Duration::from_secs(1);

/// Change of an interface between two polls.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum InterfaceChange {
    /// The interface cannot be used, for this reason.
    Lost(String),
    /// The interface can be used again, or was replaced.
    Back(Interface),
}

/// The reason why the interface of our sockets cannot be used.
#[derive(Debug, thiserror::Error)]
pub(crate) enum UnusableInterface {
    /// No interface has the name or address.
    #[error("this host has no network interface `{0}` with an IPv4 address")]
    Missing(String),
    /// The system has no route to the group.
    #[error("no network interface leads to {group}: {error}")]
    NoRoute {
        /// The multicast group.
        group: SocketAddr,
        /// The error of the system.
        error: io::Error,
    },
    /// No interface has the source address of the route to the group.
    #[error("no network interface of this host has the address {address}, which leads to {group}")]
    NoAddress {
        /// The multicast group.
        group: SocketAddr,
        /// The source address.
        address: Ipv4Addr,
    },
    /// The link is down.
    #[error("the network interface {0} is down")]
    Down(Interface),
    /// The sockets cannot be recreated.
    #[error(transparent)]
    Sockets(#[from] Box<dyn Error + Send + Sync>),
}

/// Selection of the interface of the sockets.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum InterfaceSelection {
    /// The interface with this name or address.
    Named(String),
    /// The interface that the system uses for this multicast group.
    Towards(SocketAddr),
}

/// The interface of our sockets.
#[derive(Debug)]
pub(crate) struct InterfaceWatch {
    wanted: InterfaceSelection,
    /// The interface at the time when the sockets were created.
    held: Interface,
    /// Reason why the interface cannot be used at present.
    lost: Option<String>,
}

impl InterfaceWatch {
    /// Starts to watch the present interface; `None` if there is no interface to watch.
    pub(crate) fn start(wanted: InterfaceSelection) -> Option<Self> {
        let held = wanted.find(&interfaces().ok()?, None).ok()?;
        Some(Self {
            wanted,
            held,
            lost: None,
        })
    }

    pub(crate) fn lost(&self) -> Option<&str> {
        self.lost.as_deref()
    }

    /// Returns the interface at the time when the sockets were created.
    pub(crate) const fn interface(&self) -> &Interface {
        &self.held
    }

    /// Checks the present interfaces. If the watched interface is present and has changed, `take`
    /// recreates the sockets. A failure is retried at the next poll.
    pub(crate) fn see(
        &mut self,
        present: &[Interface],
        take: impl FnOnce(&Interface) -> Result<(), Box<dyn Error + Send + Sync>>,
    ) -> Option<InterfaceChange> {
        let found = self.wanted.find(present, Some(&self.held));
        let taken = found.and_then(|found| {
            if !found.up {
                return Err(UnusableInterface::Down(found));
            }
            if self.lost.is_none() && found == self.held {
                return Ok(None);
            }
            take(&found)?;
            Ok(Some(found))
        });
        match taken {
            Ok(None) => None,
            Ok(Some(found)) => {
                self.lost = None;
                self.held = found.clone();
                Some(InterfaceChange::Back(found))
            }
            Err(why) => {
                let why = why.to_string();
                let told = self.lost.replace(why.clone()).is_some();
                (!told).then_some(InterfaceChange::Lost(why))
            }
        }
    }
}

impl InterfaceSelection {
    fn find(
        &self,
        present: &[Interface],
        held: Option<&Interface>,
    ) -> Result<Interface, UnusableInterface> {
        let (wanted, missing) = match self {
            Self::Named(wanted) => (wanted.clone(), UnusableInterface::Missing(wanted.clone())),
            Self::Towards(group) => {
                let group = *group;
                let address = source_towards(group)
                    .map_err(|error| UnusableInterface::NoRoute { group, error })?;
                let missing = UnusableInterface::NoAddress { group, address };
                (address.to_string(), missing)
            }
        };
        // While the previous address is present, other addresses of the interface are ignored.
        let kept = held.and_then(|held| {
            let kept = present.iter().find(|interface| interface.is_same(held));
            kept.filter(|interface| interface.is(&wanted))
        });
        let found = kept.or_else(|| present.iter().find(|interface| interface.is(&wanted)));
        found.cloned().ok_or(missing)
    }
}

/// Returns the local address of datagrams to a group. Nothing is sent.
fn source_towards(group: SocketAddr) -> io::Result<Ipv4Addr> {
    let socket = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, 0))?;
    socket.connect(group)?;
    match socket.local_addr()?.ip() {
        IpAddr::V4(address) => Ok(address),
        IpAddr::V6(_) => Err(io::ErrorKind::AddrNotAvailable.into()),
    }
}

/// Interfaces whose addresses a library uses permanently: it cannot change them while it runs.
#[derive(Debug)]
pub struct HeldInterfaces {
    held: Vec<Holding>,
    /// True if the library uses all interfaces.
    all: bool,
    /// Reported interfaces that appeared later.
    late: Vec<String>,
}

#[derive(Debug)]
struct Holding {
    interface: Interface,
    state: HoldingState,
    /// State at the last call of [`HeldInterfaces::look`].
    reported: HoldingState,
    /// True if the interface was removed at that call or since.
    was_gone: bool,
    /// True if the interface was up once.
    was_there: bool,
    /// True if another interface has its address.
    is_elsewhere: bool,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum HoldingState {
    There,
    Down,
    Gone,
}

/// Result of a check of held interfaces.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum InterfaceFinding {
    /// An interface cannot be used at present, for this reason.
    Lost(String),
    /// An unchanged interface can be used again.
    Back(Interface),
    /// A new interface is available that the library does not use.
    Late(Interface),
    /// The addresses of the library are invalid, but its interface is available: a restart is
    /// required to use it.
    Void(String),
}

impl HeldInterfaces {
    /// Starts to watch the interfaces with the given addresses, or all interfaces except loopback
    /// if the list is empty. Loopback is not watched: returns `None` if no other interface has a
    /// given address.
    #[must_use]
    pub fn start(addresses: &[IpAddr]) -> Option<Self> {
        let all = addresses.is_empty();
        let held: Vec<Interface> = interfaces()
            .ok()?
            .into_iter()
            .filter(|interface| !interface.address.is_loopback())
            .filter(|interface| all || addresses.contains(&interface.address.into()))
            .collect();
        (all || !held.is_empty()).then(|| Self::of(held, all))
    }

    fn of(held: Vec<Interface>, all: bool) -> Self {
        let holding = |interface: Interface| {
            let state = if interface.up {
                HoldingState::There
            } else {
                HoldingState::Down
            };
            Holding {
                interface,
                state,
                reported: state,
                was_gone: false,
                was_there: state == HoldingState::There,
                is_elsewhere: false,
            }
        };
        Self {
            held: held.into_iter().map(holding).collect(),
            all,
            late: Vec::new(),
        }
    }

    /// Checks the interfaces, and returns the changes since the last call.
    pub fn look(&mut self) -> Vec<InterfaceFinding> {
        interfaces().map_or_else(|_not_now| Vec::new(), |present| self.see(&present))
    }

    /// Updates the state that [`lost`](Self::lost) returns. The next [`look`](Self::look) returns
    /// the changes, but not a loss of the link that is already over.
    pub fn refresh(&mut self) {
        if let Ok(present) = interfaces() {
            self.update(&present);
        }
    }

    /// Returns the reason why the library cannot communicate: each of its interfaces is removed or
    /// down.
    #[must_use]
    pub fn lost(&self) -> Option<String> {
        let first = self.held.first()?;
        let none = self
            .held
            .iter()
            .all(|held| held.state != HoldingState::There);
        none.then(|| first.why())
    }

    /// Returns the addresses whose interfaces were up and are removed or down, unless another
    /// interface has the address now.
    #[must_use]
    pub fn lost_addresses(&self) -> Vec<IpAddr> {
        let is_lost = |held: &&Holding| {
            held.was_there && held.state != HoldingState::There && !held.is_elsewhere
        };
        let lost = self.held.iter().filter(is_lost);
        lost.map(|held| held.interface.address.into()).collect()
    }

    fn update(&mut self, present: &[Interface]) {
        for holding in &mut self.held {
            let now = present.iter().find(|one| one.is_same(&holding.interface));
            holding.state = match now {
                Some(now) if now.up => HoldingState::There,
                Some(_) => HoldingState::Down,
                None => HoldingState::Gone,
            };
            holding.was_gone |= holding.state == HoldingState::Gone;
            holding.was_there |= holding.state == HoldingState::There;
            let address = holding.interface.address;
            let mut up = present.iter().filter(|one| one.up);
            holding.is_elsewhere = up.any(|one| one.address == address);
        }
    }

    fn see(&mut self, present: &[Interface]) -> Vec<InterfaceFinding> {
        self.update(present);
        let is_there = |holding: &Holding| holding.reported == HoldingState::There;
        let was_there = self.held.iter().any(is_there);
        let mut findings = Vec::new();
        for holding in &mut self.held {
            let state = holding.state;
            let before = std::mem::replace(&mut holding.reported, state);
            let was_gone = std::mem::replace(&mut holding.was_gone, state == HoldingState::Gone);
            match (before, state) {
                // The kernel removed its state together with the interface.
                (_, HoldingState::There | HoldingState::Down) if was_gone => {
                    findings.push(InterfaceFinding::Void(format!(
                        "the network interface {} was created again",
                        holding.interface
                    )));
                }
                (HoldingState::Down, HoldingState::There) => {
                    findings.push(InterfaceFinding::Back(holding.interface.clone()));
                }
                (HoldingState::There, HoldingState::Down | HoldingState::Gone) => {
                    findings.push(InterfaceFinding::Lost(holding.why()));
                }
                _ => {}
            }
        }
        findings.extend(self.changed(present, was_there));
        findings
    }

    /// Returns present interfaces that replace a held interface or are new. `was_there` is whether
    /// a held interface was up at the check before: links that are down at one check only may be up
    /// again soon, so no new interface replaces them yet.
    fn changed(&mut self, present: &[Interface], was_there: bool) -> Vec<InterfaceFinding> {
        let mut findings = Vec::new();
        let usable = |one: &&Interface| one.up && !one.address.is_loopback();
        let is_there = self
            .held
            .iter()
            .any(|held| held.state == HoldingState::There);
        for one in present.iter().filter(usable) {
            let mut of_name = self.held.iter().filter(|h| h.interface.name == one.name);
            if of_name.any(|h| h.interface.is_same(one)) {
                continue;
            }
            let mut of_name = self.held.iter().filter(|h| h.interface.name == one.name);
            if let Some(gone) = of_name.find(|h| h.state == HoldingState::Gone) {
                findings.push(InterfaceFinding::Void(
                    if gone.interface.address == one.address {
                        format!("the network interface {one} was created again")
                    } else {
                        format!(
                            "the network interface {} has another address, {}",
                            gone.interface, one.address
                        )
                    },
                ));
            } else if self.all && !was_there && !is_there {
                findings.push(InterfaceFinding::Void(format!(
                    "the network interface {one} appeared"
                )));
            } else if self.all && !self.late.contains(&one.name) && self.late.len() < MAX_LATE {
                self.late.push(one.name.clone());
                findings.push(InterfaceFinding::Late(one.clone()));
            }
        }
        findings
    }
}

impl Holding {
    fn why(&self) -> String {
        let state = match self.state {
            HoldingState::Gone => "removed, or has another address",
            HoldingState::Down | HoldingState::There => "down",
        };
        format!("the network interface {} is {state}", self.interface)
    }
}

/// Maximum number of reported new interfaces; containers create new names without end.
const MAX_LATE: usize = 64;

#[cfg(test)]
mod tests {
    use super::*;

    fn wire(index: u32, last: u8) -> Interface {
        Interface {
            name: "wire0".to_owned(),
            index,
            address: Ipv4Addr::new(10, 77, 0, last),
            up: true,
        }
    }

    fn other() -> Interface {
        Interface {
            name: "wlan0".to_owned(),
            ..wire(7, 9)
        }
    }

    fn down(interface: Interface) -> Interface {
        Interface {
            up: false,
            ..interface
        }
    }

    fn named(name: &str) -> InterfaceWatch {
        InterfaceWatch {
            wanted: InterfaceSelection::Named(name.to_owned()),
            held: wire(3, 1),
            lost: None,
        }
    }

    /// Performs a check. Returns the change, and true if the sockets were recreated.
    fn look(watch: &mut InterfaceWatch, present: &[Interface]) -> (Option<InterfaceChange>, bool) {
        let mut made = false;
        let change = watch.see(present, |_| {
            made = true;
            Ok(())
        });
        (change, made)
    }

    #[test]
    fn an_interface_that_is_what_it_was_is_left_alone() {
        let mut watch = named("wire0");
        assert_eq!(look(&mut watch, &[wire(3, 1)]), (None, false));
        // An additional address changes nothing, even at the front of the list.
        assert_eq!(look(&mut watch, &[wire(3, 9), wire(3, 1)]), (None, false));
    }

    #[test]
    fn an_interface_that_was_made_anew_or_has_another_address_is_taken_up() {
        for anew in [wire(4, 1), wire(3, 2), wire(4, 2)] {
            let mut watch = named("wire0");
            let back = (Some(InterfaceChange::Back(anew.clone())), true);
            assert_eq!(look(&mut watch, std::slice::from_ref(&anew)), back);
            assert_eq!(look(&mut watch, &[anew]), (None, false));
        }
    }

    #[test]
    fn a_loss_is_told_once_and_the_return_too_though_it_is_as_it_was() {
        for without in [vec![], vec![down(wire(3, 1))]] {
            let mut watch = named("wire0");
            let (change, made) = look(&mut watch, &without);
            assert!(matches!(&change, Some(InterfaceChange::Lost(why)) if why.contains("wire0")));
            assert!(!made && watch.lost().is_some());
            assert_eq!(look(&mut watch, &without), (None, false));
            let back = (Some(InterfaceChange::Back(wire(3, 1))), true);
            assert_eq!(look(&mut watch, &[wire(3, 1)]), back);
            assert!(watch.lost().is_none());
        }
    }

    #[test]
    fn an_interface_wanted_by_its_address_is_not_followed_to_another() {
        let mut watch = named("10.77.0.1");
        assert!(matches!(
            look(&mut watch, &[wire(4, 2)]).0,
            Some(InterfaceChange::Lost(_))
        ));
        let back = (Some(InterfaceChange::Back(wire(5, 1))), true);
        assert_eq!(look(&mut watch, &[wire(4, 2), wire(5, 1)]), back);
    }

    #[test]
    fn sockets_that_cannot_be_made_are_tried_again() {
        let mut watch = named("wire0");
        let refuse = |_: &Interface| Err("no".into());
        let refused = watch.see(&[wire(4, 1)], refuse);
        assert_eq!(refused, Some(InterfaceChange::Lost("no".to_owned())));
        assert_eq!(watch.see(&[wire(4, 1)], refuse), None);
        let back = (Some(InterfaceChange::Back(wire(4, 1))), true);
        assert_eq!(look(&mut watch, &[wire(4, 1)]), back);
    }

    #[test]
    fn what_a_library_holds_is_void_once_the_interface_is_another() {
        for anew in [wire(4, 1), wire(3, 2), wire(4, 2)] {
            // The interface changes between two checks, or is absent during a check.
            for looks in [&[][..], &[&[][..]]] {
                let mut held = HeldInterfaces::of(vec![wire(3, 1)], false);
                for present in looks {
                    assert!(matches!(held.see(present)[..], [InterfaceFinding::Lost(_)]));
                    assert!(held.lost().unwrap().contains("wire0 (10.77.0.1)"));
                    assert_eq!(held.see(present), []);
                }
                let last = held.see(std::slice::from_ref(&anew)).pop();
                assert!(matches!(last, Some(InterfaceFinding::Void(_))), "{last:?}");
            }
        }
        let mut held = HeldInterfaces::of(vec![wire(3, 1)], false);
        held.see(&[]);
        assert!(matches!(
            held.see(&[wire(3, 1)])[..],
            [InterfaceFinding::Void(_)]
        ));
    }

    #[test]
    fn what_a_library_holds_stays_good_while_a_link_is_down() {
        let mut held = HeldInterfaces::of(vec![wire(3, 1)], false);
        assert!(matches!(
            held.see(&[down(wire(3, 1))])[..],
            [InterfaceFinding::Lost(_)]
        ));
        assert!(held.lost().is_some());
        assert_eq!(
            held.see(&[wire(3, 1)]),
            [InterfaceFinding::Back(wire(3, 1))]
        );
        assert_eq!(held.lost(), None);
    }

    #[test]
    fn a_link_that_is_down_for_a_moment_does_not_make_what_a_library_holds_void() {
        let mut held = HeldInterfaces::of(vec![wire(3, 1)], true);
        let flap = [down(wire(3, 1)), other()];
        assert_eq!(
            held.see(&[wire(3, 1), other()]),
            [InterfaceFinding::Late(other())]
        );
        // Between two checks, only the fitness follows the link.
        held.update(&flap);
        assert!(held.lost().is_some());
        held.update(&[wire(3, 1), other()]);
        assert_eq!(held.lost(), None);
        assert_eq!(held.see(&[wire(3, 1), other()]), []);
        // At a check, the loss is reported first. It is void if the link stays down.
        held.update(&flap);
        assert!(matches!(held.see(&flap)[..], [InterfaceFinding::Lost(_)]));
        held.update(&flap);
        assert!(matches!(held.see(&flap)[..], [InterfaceFinding::Void(_)]));
    }

    #[test]
    fn an_interface_that_was_removed_between_two_checks_is_void_at_the_next() {
        let mut held = HeldInterfaces::of(vec![wire(3, 1)], false);
        held.update(&[]);
        held.update(&[wire(3, 1)]);
        assert_eq!(held.lost(), None);
        assert!(matches!(
            held.see(&[wire(3, 1)])[..],
            [InterfaceFinding::Void(_)]
        ));
        assert_eq!(held.see(&[wire(3, 1)]), []);
        held.update(&[]);
        assert!(matches!(held.see(&[])[..], [InterfaceFinding::Lost(_)]));
        assert!(matches!(
            held.see(&[wire(3, 1)])[..],
            [InterfaceFinding::Void(_)]
        ));
    }

    #[test]
    fn an_interface_that_comes_late_is_told_of_where_all_are_wanted() {
        let other = other();
        let both = [wire(3, 1), other.clone()];
        let mut one = HeldInterfaces::of(vec![wire(3, 1)], false);
        assert_eq!(one.see(&both), []);
        let mut all = HeldInterfaces::of(vec![wire(3, 1)], true);
        assert_eq!(all.see(&both), [InterfaceFinding::Late(other.clone())]);
        assert_eq!(all.see(&both), []);
        // The loss of one of several interfaces does not prevent communication.
        let mut two = HeldInterfaces::of(both.to_vec(), true);
        assert!(matches!(
            two.see(&both[..1])[..],
            [InterfaceFinding::Lost(_)]
        ));
        assert_eq!(two.lost(), None);
        // Without interfaces, or with an interface that is down (as for containers), no
        // communication was possible.
        for nothing in [vec![], vec![down(other)]] {
            let mut none = HeldInterfaces::of(nothing, true);
            assert!(matches!(
                none.see(&both[..1])[..],
                [.., InterfaceFinding::Void(_)]
            ));
        }
    }
}
