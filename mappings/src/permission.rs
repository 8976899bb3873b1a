//! Who may do what with a node of the cell's server.

/// What a user may be (OPC 10000-18, 4.2).
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Role {
    /// Sees what there is.
    Observer,
    /// Runs the cell: sees, writes and calls.
    Operator,
    /// Sets the cell up.
    Engineer,
    /// Says who may do what.
    SecurityAdmin,
}

impl Role {
    /// As it stands in the document.
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

/// Which roles may do what with a variable. Where nothing is said everybody reads, and operators and engineers write.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Permissions {
    /// Who may read it.
    pub read: Option<Vec<Role>>,
    /// Who may write it.
    pub write: Option<Vec<Role>>,
}

/// What users without a name may be.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Anonymous {
    /// They observe; on a server of its own host without users they operate.
    #[default]
    Usual,
    /// They are not let in.
    Refused,
    /// They have that role.
    Has(Role),
}
