//! The sender that announced a call, whose answers alone count.

use std::net::SocketAddr;

use uadp::action::{ActionMessage, Requestor};

use crate::report::warn;

/// The sender that announced a call, as the carrier tells senders apart.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Executor {
    from: Option<SocketAddr>,
    /// A forged answer was reported.
    reported: bool,
}

impl Executor {
    pub(super) const fn at(from: SocketAddr) -> Self {
        Self {
            from: Some(from),
            reported: false,
        }
    }

    /// Whether values and announcements of that sender are of the executor.
    pub(super) fn publishes(&self, from: SocketAddr) -> bool {
        self.from == Some(from)
    }

    /// Whether a response comes from the executor. The first answer to an open call from another sender is reported.
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
