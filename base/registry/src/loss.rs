//! Reasons for the loss of a server.

/// Reason for the loss of a server.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum ServerLoss {
    /// The server withdrew its registration.
    Unregistered,
    /// The server sent a goodbye by mDNS, or its announcement expired.
    Goodbye,
    /// The server did not repeat its registration.
    Expired,
    /// The semaphore file of the server was removed.
    SemaphoreGone,
    /// The server does not answer.
    Unreachable,
    /// The host accepts connections, and the server does not answer.
    Hanging,
    /// The server was never verified, and was displaced by another server.
    Displaced,
    /// The Global Discovery Server no longer lists the server, or has not answered for too long.
    Unlisted,
    /// Another source reports the server that a Global Discovery Server lists.
    Superseded,
}

impl ServerLoss {
    /// Returns the label for logs and counters.
    #[must_use]
    pub fn label(self) -> &'static str {
        match self {
            Self::Unregistered => "unregistered",
            Self::Goodbye => "goodbye",
            Self::Expired => "expired",
            Self::SemaphoreGone => "semaphore_gone",
            Self::Unreachable => "unreachable",
            Self::Hanging => "hanging",
            Self::Displaced => "displaced",
            Self::Unlisted => "unlisted",
            Self::Superseded => "superseded",
        }
    }
}
