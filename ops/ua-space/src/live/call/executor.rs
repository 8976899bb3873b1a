//! The executor of a call: the sender that announced it. Responses of other senders are ignored.

use std::net::SocketAddr;

use uadp::action::{ActionMessage, Requestor};

use crate::report::warn;

/// The sender that announced a call, identified by its address.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct AnnouncedExecutor {
    from: Option<SocketAddr>,
    /// True if a forged response was reported.
    reported: bool,
}

impl AnnouncedExecutor {
    pub(super) const fn at(from: SocketAddr) -> Self {
        Self {
            from: Some(from),
            reported: false,
        }
    }

    /// Returns true if `from` is the address of the executor.
    pub(super) fn publishes(&self, from: SocketAddr) -> bool {
        self.from == Some(from)
    }

    /// Returns true if a response comes from the executor. Reports the first response to an open
    /// call from another sender.
    pub(super) fn answers(
        &mut self,
        requestor: &Requestor,
        (response, from): (&ActionMessage<'_>, SocketAddr),
    ) -> bool {
        let is_executor = self.publishes(from);
        let is_forged = !is_executor && requestor.is_awaited(response);
        if is_forged && !std::mem::replace(&mut self.reported, true) {
            let executor = self.from.map(|from| from.to_string()).unwrap_or_default();
            warn(&format!(
                "ignored an answer of {from}: {executor} offers the call, and answers of other senders do not count"
            ));
        }
        is_executor
    }
}
