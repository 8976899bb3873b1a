//! The right to configure a program: held by the supervisor that it registered with, and by users
//! with the role ConfigureAdmin.

use std::sync::Arc;

use opcua::sync::RwLock;
use opcua::types::{Argument, DataTypeId, LocalizedText, StatusCode};

use crate::server::SessionCaller;
use crate::users::{Roles, UserRole};

/// The BrowseName of the method with which a supervisor configures a program, in any namespace.
pub const CONFIGURE: &str = "Configure";

/// The BrowseName of the method of a component with which its supervisor sets configured fields.
/// Stations pass it on for callers that may configure them.
pub const SET_FIELDS: &str = "SetFields";

/// The arguments of [`CONFIGURE`], in this order, all Strings.
pub const CONFIGURED: [(&str, &str); 3] = [
    (
        "Place",
        "The location of the component, such as cell-1/station-a/gripper",
    ),
    ("SupervisorUri", "The ApplicationUri of the supervisor"),
    (
        "DiscoveryUrl",
        "The discovery server of the component's level",
    ),
];

/// Returns the InputArguments of [`CONFIGURE`].
#[must_use]
pub fn configure_takes() -> Vec<Argument> {
    let argument = |(name, description): (&str, &str)| Argument {
        name: name.into(),
        data_type: DataTypeId::String.into(),
        value_rank: -1,
        array_dimensions: None,
        description: LocalizedText::new("en", description),
    };
    CONFIGURED.map(argument).to_vec()
}

/// The discovery server that a program registered with. It supervises the level of the program.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Registrar {
    /// The ApplicationUri.
    pub application_uri: String,
    /// Whether a trusted certificate contains the ApplicationUri: the program registered over a
    /// secured channel.
    pub proven: bool,
}

/// The supervisor of a program. Clones share it: the registration sets it, and the method
/// `Configure` checks it.
#[derive(Debug, Clone, Default)]
pub struct Supervision(Arc<RwLock<Option<Registrar>>>);

/// Compares by identity.
impl PartialEq for Supervision {
    fn eq(&self, other: &Self) -> bool {
        Arc::ptr_eq(&self.0, &other.0)
    }
}

impl Eq for Supervision {}

impl Supervision {
    /// Sets the discovery server that the program is registered with.
    pub fn registered_with(&self, registrar: Registrar) {
        *self.0.write() = Some(registrar);
    }

    /// Checks that a caller with these roles may configure the program.
    ///
    /// # Errors
    /// BadUserAccessDenied unless the caller is the supervisor or has the role ConfigureAdmin.
    pub fn admits(&self, caller: &SessionCaller, roles: Roles) -> Result<(), StatusCode> {
        if roles.contains(UserRole::ConfigureAdmin) {
            return Ok(());
        }
        let supervisor = self.0.read();
        let is_supervisor = supervisor.as_ref().is_some_and(|supervisor| {
            // Channels without security prove no identity, neither for the caller nor at the
            // registration.
            let may_claim = !supervisor.proven && !caller.encrypted;
            caller.application_uri == supervisor.application_uri && (caller.proven || may_claim)
        });
        match is_supervisor {
            true => Ok(()),
            false => Err(StatusCode::BadUserAccessDenied),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn caller(uri: &str, proven: bool, encrypted: bool) -> SessionCaller {
        SessionCaller {
            session: 1,
            user: "anonymous".to_owned(),
            application_uri: uri.to_owned(),
            proven,
            encrypted,
            certificate: None,
        }
    }

    #[test]
    fn only_the_supervisor_that_the_program_registered_with_configures_it() {
        let none = Roles::NONE;
        let supervision = Supervision::default();
        let cell = caller("urn:cell", true, true);
        let denied = Err(StatusCode::BadUserAccessDenied);
        assert_eq!(supervision.admits(&cell, none), denied, "not registered");
        let registration = supervision.clone();
        registration.registered_with(Registrar {
            application_uri: "urn:cell".to_owned(),
            proven: true,
        });
        assert_eq!(supervision.admits(&cell, none), Ok(()));
        let claims = caller("urn:cell", false, false);
        assert_eq!(
            supervision.admits(&claims, none),
            denied,
            "it proves nothing"
        );
        let another = caller("urn:cell-2", true, true);
        assert_eq!(supervision.admits(&another, none), denied);
        let admin = Roles::of(&[UserRole::ConfigureAdmin]);
        assert_eq!(supervision.admits(&another, admin), Ok(()));
        let security = Roles::of(&[UserRole::SecurityAdmin, UserRole::Engineer]);
        assert_eq!(supervision.admits(&another, security), denied);
    }

    #[test]
    fn without_security_the_supervisor_is_known_by_what_it_says() {
        let supervision = Supervision::default();
        supervision.registered_with(Registrar {
            application_uri: "urn:cell".to_owned(),
            proven: false,
        });
        let admits = |caller: &SessionCaller| supervision.admits(caller, Roles::NONE).is_ok();
        assert!(admits(&caller("urn:cell", false, false)));
        assert!(admits(&caller("urn:cell", true, true)));
        assert!(!admits(&caller("urn:other", false, false)));
        assert!(
            !admits(&caller("urn:cell", false, true)),
            "its certificate is of another"
        );
    }
}
