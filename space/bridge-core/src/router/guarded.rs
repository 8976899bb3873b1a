//! Messages of secured groups.

use std::net::SocketAddr;

use uadp::{KeyError, NetworkMessage};

use super::security::MessageSecurity;
use super::{DropSite, Router, TopicQueues};
use crate::counters::Reason;
use crate::guard::{GroupState, KeyDelivery, Unopened};
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
        self.security.set_keys(group, delivery, now.monotonic)
    }

    /// Returns the state of each secured group.
    pub fn groups(&self) -> impl Iterator<Item = GroupState> {
        self.security.states()
    }

    /// Handles a datagram if there are secured groups.
    pub(super) fn handle_guarded(
        &mut self,
        message: &NetworkMessage<'_>,
        from: SocketAddr,
        now: Now,
    ) {
        let about = DropSite::sender(from);
        // An own message that was received again. It is not opened, to save time.
        let is_own = self.values.settings.source.is_some() && self.values.is_source(from);
        if message.is_sealed() && is_own {
            return self.values.count(about, Reason::Looped, 1, String::new);
        }
        let mut scratch = self.values.buffer();
        match self.security.open(message, now.monotonic, &mut scratch) {
            Ok(Some(opened)) => self.handle_network_message(&opened, from, now),
            Ok(None) => self.handle_network_message(message, from, now),
            Err(Unopened {
                reason,
                case,
                detail,
            }) => self.values.count(about, (reason, case), 1, || detail),
        }
        self.values.recycle(scratch);
        self.want_keys(now);
    }

    pub(super) fn want_keys(&mut self, now: Now) {
        if let Some(group) = self.security.wanted(now.monotonic) {
            self.values.tell(Output::KeysWanted { group });
        }
    }
}

impl TopicQueues {
    /// Returns whether the current message is unsecured but concerns a secured namespace, and
    /// counts it.
    pub(super) fn is_unsaid(
        &mut self,
        security: &MessageSecurity,
        namespace: Option<u16>,
        from: SocketAddr,
    ) -> bool {
        let unsaid = security.is_unsaid(namespace);
        if unsaid {
            let cause = (Reason::Unsecured, "announcement");
            let about = DropSite::sender(from);
            self.count(about, cause, 1, || match namespace {
                Some(namespace) => {
                    format!("the message is not secured, but its namespace {namespace} is")
                }
                None => {
                    "the announcement is not secured, but the mapping has secured groups".to_owned()
                }
            });
        }
        unsaid
    }
}
