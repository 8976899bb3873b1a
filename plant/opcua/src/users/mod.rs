//! Who may do what: users, the roles they have, and what a role may do with a node.
//!
//! A server that takes users keeps them in a folder of its certificate store (`file`). Who comes with a session is asked
//! there, and for each request of that session what its user may do is asked again (`access`): a user that is taken away,
//! or has other roles, is that for open sessions too.
//!
//! Reading order: the roles here, `file`, `password`, `access`.

mod access;
mod file;
mod password;

pub use self::access::{Access, Anonymous, Login, LoginFault, Permissions, Right, Rules};
pub use self::file::{
    Credential, FOLDER, LARGEST_PASSWORD, MOST_USERS, User, UserFault, Users, hashed,
};

/// One of the well-known roles of OPC 10000-18, 4.2.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Role {
    /// Sees what there is.
    Observer,
    /// Runs the cell: sees, writes and calls.
    Operator,
    /// Sets the cell up: may all that an operator may, and what is kept to engineers.
    Engineer,
    /// Says who may do what: users, certificates, keys, and what the audit tells.
    SecurityAdmin,
    /// Configures programs: says where in the plant they are.
    ConfigureAdmin,
}

impl Role {
    /// Every role.
    pub const ALL: &'static [Self] = &[
        Self::Observer,
        Self::Operator,
        Self::Engineer,
        Self::SecurityAdmin,
        Self::ConfigureAdmin,
    ];

    /// As it is typed and stands in files.
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

impl std::str::FromStr for Role {
    type Err = UnknownRole;

    fn from_str(text: &str) -> Result<Self, UnknownRole> {
        let mut all = Self::ALL.iter().copied();
        all.find(|role| role.name() == text)
            .ok_or_else(|| UnknownRole(text.chars().take(64).collect()))
    }
}

/// A text that names no role.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("`{0}` is no role: observer, operator, engineer, security_admin, configure_admin")]
pub struct UnknownRole(String);

/// A set of roles.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Roles(u8);

impl Roles {
    /// No role.
    pub const NONE: Self = Self(0);
    /// Every role.
    pub const ALL: Self = Self(31);

    /// Those roles.
    #[must_use]
    pub fn of(roles: &[Role]) -> Self {
        roles.iter().copied().collect()
    }

    /// Whether that role is among them.
    #[must_use]
    pub const fn contains(self, role: Role) -> bool {
        self.0 & role.bit() != 0
    }

    /// Whether one of the others is among them.
    #[must_use]
    pub const fn meets(self, others: Self) -> bool {
        self.0 & others.0 != 0
    }

    /// The roles, in their order.
    pub fn iter(self) -> impl Iterator<Item = Role> {
        let all = Role::ALL.iter().copied();
        all.filter(move |role| self.contains(*role))
    }
}

impl FromIterator<Role> for Roles {
    fn from_iter<T: IntoIterator<Item = Role>>(roles: T) -> Self {
        Self(roles.into_iter().fold(0, |all, role| all | role.bit()))
    }
}

/// `operator,engineer`
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
