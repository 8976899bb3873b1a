//! Messages of secured groups.

use std::net::SocketAddr;

use uadp::{KeyError, NetworkMessage};

use super::{About, Router};
use crate::guard::{GroupState, Guard, KeyDelivery, Unopened};
use crate::output::Output;
use crate::settings::Now;

impl Router {
    /// Sets the keys of a secured group. Keys of a group that is not in the mapping are ignored.
    ///
    /// # Errors
    /// Returns a [`KeyError`]; the previous keys stay in use.
    pub fn set_keys(
        &mut self,
        group: &str,
        delivery: &KeyDelivery,
        now: Now,
    ) -> Result<(), KeyError> {
        match &mut self.guard {
            Some(guard) => guard.set_keys(group, delivery, now.monotonic),
            None => Ok(()),
        }
    }

    /// Returns the state of each secured group.
    pub fn groups(&self) -> impl Iterator<Item = GroupState> {
        self.guard.iter().flat_map(|guard| guard.states())
    }

    /// Returns whether messages in a namespace are secured.
    pub(super) fn is_secured(&self, namespace: u16) -> bool {
        let guard = self.guard.as_ref();
        guard.is_some_and(|guard| guard.is_secured(namespace))
    }

    /// Applies the groups of the mapping.
    pub(super) fn renew_guard(&mut self) {
        let groups = self.values.mapping.security();
        match &mut self.guard {
            Some(guard) => {
                if !guard.replace(groups) {
                    self.guard = None;
                }
            }
            None => {
                self.guard = Guard::new(groups).map(Box::new);
                self.mark_guard();
            }
        }
        self.values.overhead = self.guard.as_ref().map_or(0, |_| Guard::OVERHEAD);
    }

    /// Sets the random bytes of the guard, if they are known.
    pub(super) fn mark_guard(&mut self) {
        let [a, b, c, d, ..] = self.instance;
        let random = self.instance.iter().any(|byte| *byte != 0);
        if let Some(guard) = self.guard.as_mut().filter(|_| random) {
            guard.set_mark([a, b, c, d]);
        }
    }

    /// Handles a datagram if there are secured groups.
    pub(super) fn handle_guarded(
        &mut self,
        message: &NetworkMessage<'_>,
        from: SocketAddr,
        now: Now,
    ) {
        // An own message that was received again. It is not opened, to save time.
        if message.is_sealed()
            && self.values.settings.source.is_some()
            && self.values.is_source(from)
        {
            let about = About::sender(from);
            self.values
                .count(about, crate::Reason::Looped, 1, String::new);
            return;
        }
        let mut scratch = self.values.buffer();
        let opened = match &mut self.guard {
            Some(guard) => guard.open(message, now.monotonic, &mut scratch),
            None => Ok(None),
        };
        match opened {
            Ok(Some(opened)) => {
                self.in_clear = false;
                self.handle_network_message(&opened, from, now);
            }
            Ok(None) => {
                self.in_clear = true;
                self.handle_network_message(message, from, now);
            }
            Err(Unopened {
                reason,
                case,
                detail,
            }) => self
                .values
                .count(About::sender(from), (reason, case), 1, || detail),
        }
        self.values.recycle(scratch);
        self.want_keys(now);
    }

    pub(super) fn want_keys(&mut self, now: Now) {
        let guard = self.guard.as_mut();
        if let Some(group) = guard.and_then(|guard| guard.wanted(now.monotonic)) {
            self.values.tell(Output::KeysWanted { group });
        }
    }

    /// Returns whether the current message is unsecured but concerns a secured namespace, and
    /// counts it.
    pub(super) fn is_unsaid(&mut self, namespace: Option<u16>, from: SocketAddr) -> bool {
        let secured = namespace.is_none_or(|namespace| self.is_secured(namespace));
        let unsaid = self.in_clear && secured;
        if unsaid {
            let cause = (crate::Reason::Unsecured, "announcement");
            self.values
                .count(About::sender(from), cause, 1, || match namespace {
                    Some(namespace) => {
                        format!(
                            "it says in clear what is in namespace {namespace}, which is secured"
                        )
                    }
                    None => {
                        "it says in clear what there is, and there are secured groups".to_owned()
                    }
                });
        }
        unsaid
    }

    /// Seals an output. Returns `None` for a message that cannot be sent, and counts it.
    #[expect(
        clippy::wildcard_enum_match_arm,
        reason = "all but datagrams are for this program"
    )]
    pub(super) fn sealed(&mut self, output: Output) -> Option<Output> {
        let guard = self.guard.as_mut()?;
        let (bytes, topic) = match &output {
            Output::Datagram { topic, bytes, .. } | Output::Action { topic, bytes } => {
                (bytes, Some(*topic))
            }
            Output::Discovery { bytes } | Output::Heartbeat { bytes } => (bytes, None),
            _ => return Some(output),
        };
        let mut sealed = self.values.spare.pop().unwrap_or_default();
        match guard.seal(bytes, &mut sealed) {
            Ok(false) => {
                self.values.recycle(sealed);
                Some(output)
            }
            Ok(true) => {
                let (clear, output) = match output {
                    Output::Datagram { topic, with, bytes } => {
                        let bytes_out = sealed;
                        (
                            bytes,
                            Output::Datagram {
                                topic,
                                with,
                                bytes: bytes_out,
                            },
                        )
                    }
                    Output::Action { topic, bytes } => (
                        bytes,
                        Output::Action {
                            topic,
                            bytes: sealed,
                        },
                    ),
                    Output::Discovery { bytes } => (bytes, Output::Discovery { bytes: sealed }),
                    Output::Heartbeat { bytes } => (bytes, Output::Heartbeat { bytes: sealed }),
                    other => (sealed, other),
                };
                self.values.recycle(clear);
                Some(output)
            }
            Err(Unopened {
                reason,
                case,
                detail,
            }) => {
                self.values.recycle(sealed);
                let about = About { topic, from: None };
                self.values.count(about, (reason, case), 1, || detail);
                None
            }
        }
    }
}
