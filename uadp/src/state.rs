//! The PubSubState of connections, groups, writers and readers (OPC 10000-14, 6.2.1).

/// State of a PubSub component, with the values of the enumeration (OPC 10000-14, 6.2.1, Table 1).
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default)]
#[repr(u8)]
pub enum PubSubState {
    /// Configured, but not enabled.
    #[default]
    Disabled = 0,
    /// Enabled, but its parent is Disabled or Paused.
    Paused = 1,
    /// Working.
    Operational = 2,
    /// Enabled, but in error.
    Error = 3,
    /// Enabled, and becoming Operational.
    PreOperational = 4,
}

impl PubSubState {
    /// Returns the state of an enumeration value, or `None` above 4.
    #[must_use]
    pub const fn from_value(value: u8) -> Option<Self> {
        Some(match value {
            0 => Self::Disabled,
            1 => Self::Paused,
            2 => Self::Operational,
            3 => Self::Error,
            4 => Self::PreOperational,
            _ => return None,
        })
    }
}
