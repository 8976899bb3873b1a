//! The PubSub network of the run loop: its changes, and its properties for the Router.

use bridge_core::{Forwarding, Reason, Relay};
use tracing::{info, warn};
use transport::{Carrier, CarrierChange, NetworkArrival, Senders};

use super::Shell;
use crate::carrier::{limit, link, relay, rules};
use crate::clock::now;
use crate::port::Port;

impl<P: Port> Shell<P> {
    /// Follows the changes of the network interface of the group.
    pub(super) fn follow_group(&mut self) {
        match self.carrier.follow() {
            None => {}
            Some(CarrierChange::Lost(why)) => {
                let next = match self.carrier.lost() {
                    Some(_) => {
                        "this program waits for the network and transfers nothing until then"
                    }
                    None => "the other carriers continue",
                };
                warn!("{}; {next}", group_lost(why));
            }
            Some(CarrierChange::Back(interface)) => self.group_is_back(&interface),
        }
        let late = self.carrier.overflowed();
        if late > 0 {
            let why = "messages of another program of this process were not received in time";
            self.router.dropped(Reason::Overflow, late, why);
        }
        // A broker may have another limit after each connection, and an interface another MTU.
        self.router.set_relay(relay(self.carrier.as_ref()));
        self.router.set_limit(limit(self.carrier.as_ref()));
        self.router.set_link(link(self.carrier.as_ref()));
    }

    /// Lets the network drop the messages that the Router does not handle.
    pub(super) fn follow_interest(&mut self) {
        // An observer sees all messages.
        let interest = match self.observer {
            None => self.router.interest(),
            Some(_) => None,
        };
        if interest != self.interest {
            let rules = interest.as_ref().map(rules).unwrap_or_default();
            self.carrier.drop_by(rules);
            self.interest = interest;
        }
    }

    fn group_is_back(&mut self, interface: &str) {
        if let Some(source) = self.carrier.source() {
            self.router.set_source(source);
        }
        // The probes of the start may have been lost.
        self.router.call_the_roll(now());
        info!(%interface, "the PubSub network is within reach again: sending and receiving");
    }

    /// Returns the reasons why carriers are out of reach.
    pub(super) fn lost_carriers(&self) -> impl Iterator<Item = String> + use<P> {
        let states = self.carrier.states().into_iter();
        states.filter_map(|state| state.lost).map(group_lost)
    }
}

/// Returns the properties of the broker by which the last message was received, `None` if it was
/// not received from a broker, and its forwarding.
pub(super) fn arrival(carrier: &dyn Carrier) -> (Option<Relay>, Forwarding) {
    let NetworkArrival {
        senders,
        within,
        is_forwarded,
        not_forwarded,
    } = carrier.arrival();
    let relay = within.map(|within| Relay {
        within,
        authorized: senders == Senders::Authorized,
    });
    let forwarding = match not_forwarded {
        Some(reason) => Forwarding::Refused(reason),
        None if is_forwarded => Forwarding::Forwarded,
        None => Forwarding::None,
    };
    (relay, forwarding)
}

fn group_lost(why: String) -> String {
    format!("the PubSub network is out of reach: {why}")
}
