//! Users, their roles, and the permissions of roles on nodes.
//!
//! A server stores its users in a folder of its certificate store (`file`). Each session is
//! authenticated against this folder, and each request of a session is authorized again (`access`).
//! Removed users and changed roles therefore take effect on open sessions too.
//!
//! Reading order: the roles in this module, `file`, `password`, `access`.

mod access;
mod file;
mod password;

pub use self::access::{
    AnonymousRights, Login, LoginFault, NodePermissions, PermissionRules, Right, UserAccess,
};
pub use self::file::{
    Credential, FOLDER, LARGEST_PASSWORD, MOST_USERS, StoredUser, UserFault, UserLineFault, Users,
    hashed,
};

/// A well-known role of OPC 10000-18, 4.2.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum UserRole {
    /// May read.
    Observer,
    /// Operates the cell: may read, write and call.
    Operator,
    /// Sets up the cell: has the rights of an operator, and rights reserved for engineers.
    Engineer,
    /// Manages users, certificates and keys, and receives audit events.
    SecurityAdmin,
    /// Configures programs, for example their location in the plant.
    ConfigureAdmin,
}

impl UserRole {
    /// Every role.
    pub const ALL: &'static [Self] = &[
        Self::Observer,
        Self::Operator,
        Self::Engineer,
        Self::SecurityAdmin,
        Self::ConfigureAdmin,
    ];

    /// Returns the name in commands and files.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Observer => "observer",
            Self::Operator => "operator",
            Self::Engineer => "engineer",
            Self::SecurityAdmin => "security_admin",
            Self::ConfigureAdmin => "configure_admin",
        }
    }

    const fn bit(self) -> u8 {
        match self {
            Self::Observer => 1,
            Self::Operator => 2,
            Self::Engineer => 4,
            Self::SecurityAdmin => 8,
            Self::ConfigureAdmin => 16,
        }
    }
}

impl std::str::FromStr for UserRole {
    type Err = UnknownRole;

    fn from_str(text: &str) -> Result<Self, UnknownRole> {
        let mut all = Self::ALL.iter().copied();
        all.find(|role| role.name() == text)
            .ok_or_else(|| UnknownRole(text.chars().take(64).collect()))
    }
}

/// An unknown role name.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "`{0}` is not a role: expected observer, operator, engineer, security_admin or configure_admin"
)]
pub struct UnknownRole(String);

/// A set of roles.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Roles(u8);

impl Roles {
    /// No role.
    pub const NONE: Self = Self(0);
    /// Every role.
    pub const ALL: Self = Self(31);

    /// Returns the set of the given roles.
    #[must_use]
    pub fn of(roles: &[UserRole]) -> Self {
        roles.iter().copied().collect()
    }

    /// Returns whether the set contains a role.
    #[must_use]
    pub const fn contains(self, role: UserRole) -> bool {
        self.0 & role.bit() != 0
    }

    /// Returns whether both sets have a role in common.
    #[must_use]
    pub const fn meets(self, others: Self) -> bool {
        self.0 & others.0 != 0
    }

    /// Returns the roles in their order.
    pub fn iter(self) -> impl Iterator<Item = UserRole> {
        let all = UserRole::ALL.iter().copied();
        all.filter(move |role| self.contains(*role))
    }
}

impl FromIterator<UserRole> for Roles {
    fn from_iter<T: IntoIterator<Item = UserRole>>(roles: T) -> Self {
        Self(roles.into_iter().fold(0, |all, role| all | role.bit()))
    }
}

/// Formats the roles as `operator,engineer`.
impl std::fmt::Display for Roles {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        for (at, role) in self.iter().enumerate() {
            let comma = if at == 0 { "" } else { "," };
            write!(f, "{comma}{}", role.name())?;
        }
        Ok(())
    }
}

impl std::str::FromStr for Roles {
    type Err = UnknownRole;

    fn from_str(text: &str) -> Result<Self, UnknownRole> {
        text.split(',').map(|one| one.trim().parse()).collect()
    }
}
