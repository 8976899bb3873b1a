//! Permissions on the nodes of the cell's server.

/// Role of a user (OPC 10000-18, 4.2).
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Role {
    /// Reads.
    Observer,
    /// Runs the cell: reads, writes and calls.
    Operator,
    /// Configures the cell.
    Engineer,
    /// Administers permissions.
    SecurityAdmin,
}

impl Role {
    /// Returns the name in the document.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Observer => "observer",
            Self::Operator => "operator",
            Self::Engineer => "engineer",
            Self::SecurityAdmin => "security_admin",
        }
    }
}

/// Roles that may read and write a variable. By default every user reads, and operators and
/// engineers write.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Permissions {
    /// Roles that may read it.
    pub read: Option<Vec<Role>>,
    /// Roles that may write it.
    pub write: Option<Vec<Role>>,
}

/// Permission of anonymous users.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Anonymous {
    /// They are observers; at a server of its own host without users they are operators.
    #[default]
    Usual,
    /// They are refused.
    Refused,
    /// They have this role.
    Has(Role),
}
