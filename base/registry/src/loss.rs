//! How it is known that a server is gone.

/// Why a server is no longer there.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Loss {
    /// It took its registration back.
    Unregistered,
    /// It said so by mDNS, or its announcement ran out.
    Goodbye,
    /// It registered no more.
    Expired,
    /// Its semaphore file is gone.
    SemaphoreGone,
    /// It does not answer.
    Unreachable,
    /// Its host takes connections, and it does not answer.
    Hanging,
    /// It was never verified, and gave way to another one.
    Displaced,
}

impl Loss {
    /// For logs and counters.
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
        }
    }
}
