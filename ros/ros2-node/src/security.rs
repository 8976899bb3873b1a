//! The DDS Security settings of a bridge and its files: the keystore format of SROS2 and the
//! environment variables of rcl (design.ros2.org, "ROS 2 DDS-Security integration" and "ROS 2
//! Security Enclaves"; rcl `security.c`).
//!
//! Two rules are stricter than in rcl. A value that rcl does not know, such as
//! `ROS_SECURITY_ENABLE=1`, is refused: rcl takes it for "no". Invalid files are refused with
//! `Permissive`, too.

#[cfg(feature = "security")]
mod files;
pub mod rejections;

use std::path::{Path, PathBuf};

use thiserror::Error;

/// The security that the environment requests.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub enum RequestedSecurity {
    /// No security: every participant in the domain can read and write.
    #[default]
    Off,
    /// Security is requested and unavailable, and not enforced (`ROS_SECURITY_STRATEGY` is not
    /// `Enforce`). Holds the reason.
    Refrained(String),
    /// Secured with this enclave.
    On(Enclave),
}

/// A folder of a keystore, and the enclave name that other participants see.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Enclave {
    /// The name, `/` or for example `/cell/bridge`.
    pub name: String,
    /// The folder of the files.
    pub folder: PathBuf,
}

/// The reason for which the bridge cannot be secured as requested.
#[derive(Debug, Error, PartialEq, Eq)]
pub enum DdsSecurityError {
    /// A value that ROS does not define.
    #[error("{name} is `{value}`: it is {allowed}")]
    Value {
        /// The name of the variable.
        name: &'static str,
        /// The value of the variable.
        value: String,
        /// The allowed values.
        allowed: &'static str,
    },
    /// Not a name of an enclave.
    #[error(
        "`{0}` is not the name of an enclave: give an absolute ROS name such as /cell/bridge (--ros-args \
         --enclave, or ROS_SECURITY_ENCLAVE_OVERRIDE)"
    )]
    Name(String),
    /// Security is unavailable, with `Enforce`.
    #[error(
        "ROS_SECURITY_ENABLE is true and ROS_SECURITY_STRATEGY is Enforce, but DDS Security cannot be set up: {0}"
    )]
    Enforced(String),
    /// A file exists and is invalid.
    #[error("{}: {why}", .path.display())]
    File {
        /// The path of the file.
        path: PathBuf,
        /// The fault and its remedy.
        why: String,
    },
}

impl RequestedSecurity {
    /// Reads `ROS_SECURITY_ENABLE`, `ROS_SECURITY_STRATEGY`, `ROS_SECURITY_KEYSTORE` and
    /// `ROS_SECURITY_ENCLAVE_OVERRIDE`, which takes precedence over `enclave`, the argument
    /// `--enclave` of ROS.
    ///
    /// # Errors
    /// [`DdsSecurityError`]; with `Enforce`, also for a fault that `Permissive` ignores.
    pub fn from_env(
        variable: impl Fn(&str) -> Option<String>,
        enclave: Option<&str>,
    ) -> Result<Self, DdsSecurityError> {
        let set = |name| variable(name).filter(|value| !value.is_empty());
        if !one_of(set, "ROS_SECURITY_ENABLE", ["true", "false"])? {
            return Ok(Self::Off);
        }
        let enforced = one_of(set, "ROS_SECURITY_STRATEGY", ["Enforce", "Permissive"])?;
        let name = set("ROS_SECURITY_ENCLAVE_OVERRIDE");
        let name = name.as_deref().or(enclave).unwrap_or("/");
        if !is_enclave(name) {
            return Err(DdsSecurityError::Name(name.to_owned()));
        }
        match Enclave::find(set("ROS_SECURITY_KEYSTORE").as_deref(), name) {
            Ok(enclave) => Ok(Self::On(enclave)),
            Err(why) if enforced => Err(DdsSecurityError::Enforced(why)),
            Err(why) => Ok(Self::Refrained(why)),
        }
    }

    /// Returns the text for log messages.
    #[must_use]
    pub fn label(&self) -> String {
        match self {
            Self::Off => "off".to_owned(),
            Self::Refrained(_) => "off, though ROS_SECURITY_ENABLE is true".to_owned(),
            Self::On(enclave) => format!("on, enclave {}", enclave.name),
        }
    }

    /// Returns the enclave if security is on.
    #[must_use]
    pub const fn enclave(&self) -> Option<&Enclave> {
        match self {
            Self::On(enclave) => Some(enclave),
            Self::Off | Self::Refrained(_) => None,
        }
    }
}

/// Returns whether a variable has the first of two values; an unset variable has the second.
fn one_of(
    set: impl Fn(&'static str) -> Option<String>,
    name: &'static str,
    [yes, no]: [&'static str; 2],
) -> Result<bool, DdsSecurityError> {
    match set(name) {
        Some(value) if value == yes => Ok(true),
        None => Ok(false),
        Some(value) if value == no => Ok(false),
        Some(value) => Err(DdsSecurityError::Value {
            name,
            value,
            allowed: match yes {
                "true" => "true or false",
                _ => "Enforce or Permissive",
            },
        }),
    }
}

/// Returns whether the name is an absolute ROS name. It becomes a path, so no other characters are
/// allowed.
fn is_enclave(name: &str) -> bool {
    let is_part = |part: &str| {
        part.starts_with(|first: char| first.is_ascii_alphabetic() || first == '_')
            && part.chars().all(|c| c.is_ascii_alphanumeric() || c == '_')
    };
    name == "/"
        || name
            .strip_prefix('/')
            .is_some_and(|rest| rest.split('/').all(is_part))
}

impl Enclave {
    /// Returns the enclave with the name if all its files exist.
    fn find(keystore: Option<&str>, name: &str) -> Result<Self, String> {
        if !cfg!(feature = "security") {
            return Err(
                "this bridge-ros2 is built without DDS Security (cargo feature `security`; `bridge-ros2 \
                 --version` shows it)"
                    .to_owned(),
            );
        }
        let keystore = keystore
            .ok_or("ROS_SECURITY_KEYSTORE is not set: set it to the folder of the keystore (`ros2 security \
                    create_keystore` creates it)")?;
        let folder = Path::new(keystore)
            .join("enclaves")
            .join(name.trim_start_matches('/'));
        if !folder.is_dir() {
            return Err(format!(
                "the folder {} of the enclave {name} does not exist: create it with `ros2 security \
                 create_enclave {keystore} {name}`, or give another enclave with --ros-args --enclave",
                folder.display()
            ));
        }
        let missing: Vec<&str> = FILES
            .into_iter()
            .filter(|file| !folder.join(file).is_file())
            .collect();
        if !missing.is_empty() {
            return Err(format!(
                "{} lacks {}: create the files with `ros2 security create_enclave {keystore} {name}`",
                folder.display(),
                missing.join(", ")
            ));
        }
        Ok(Self {
            name: name.to_owned(),
            folder,
        })
    }

    /// Checks the files for faults that RustDDS does not report clearly.
    ///
    /// Returns advice about faults that do not prevent operation.
    ///
    /// # Errors
    /// [`DdsSecurityError::File`] for the first invalid file.
    #[cfg(feature = "security")]
    pub fn check(&self) -> Result<Vec<String>, DdsSecurityError> {
        files::check(&self.folder)
    }

    /// Returns no advice: without the feature there is no enclave to check.
    ///
    /// # Errors
    /// Never fails.
    #[cfg(not(feature = "security"))]
    pub const fn check(&self) -> Result<Vec<String>, DdsSecurityError> {
        Ok(Vec::new())
    }

    /// Returns an error about a file of the enclave.
    #[cfg(feature = "security")]
    fn fault(folder: &Path, file: &str, why: impl std::fmt::Display) -> DdsSecurityError {
        DdsSecurityError::File {
            path: folder.join(file),
            why: why.to_string(),
        }
    }
}

/// The files of an enclave (rmw_dds_common `security.cpp`).
const FILES: [&str; 6] = [
    "identity_ca.cert.pem",
    "permissions_ca.cert.pem",
    "cert.pem",
    "key.pem",
    "governance.p7s",
    "permissions.p7s",
];
/// An optional file of an enclave.
#[cfg(feature = "security")]
const REVOKED: &str = "crl.pem";

#[cfg(test)]
mod tests {
    use super::*;

    fn read(
        variables: &[(&str, &str)],
        enclave: Option<&str>,
    ) -> Result<RequestedSecurity, DdsSecurityError> {
        let find = |name: &str| {
            let found = variables.iter().find(|(set, _)| *set == name);
            found.map(|(_, value)| (*value).to_owned())
        };
        RequestedSecurity::from_env(find, enclave)
    }

    const ON: (&str, &str) = ("ROS_SECURITY_ENABLE", "true");
    const ENFORCE: (&str, &str) = ("ROS_SECURITY_STRATEGY", "Enforce");

    #[test]
    fn security_is_off_unless_it_is_asked_for() {
        assert_eq!(read(&[], None), Ok(RequestedSecurity::Off));
        assert_eq!(
            read(&[("ROS_SECURITY_ENABLE", ""), ENFORCE], None),
            Ok(RequestedSecurity::Off)
        );
        assert_eq!(
            read(&[("ROS_SECURITY_ENABLE", "false"), ENFORCE], None),
            Ok(RequestedSecurity::Off)
        );
    }

    #[test]
    fn what_rcl_would_take_for_no_is_refused() {
        for wrong in [
            &[("ROS_SECURITY_ENABLE", "1")][..],
            &[ON, ("ROS_SECURITY_STRATEGY", "enforce")],
        ] {
            let error = read(wrong, None).unwrap_err();
            assert!(matches!(error, DdsSecurityError::Value { .. }), "{error}");
        }
    }

    #[test]
    fn without_files_enforce_refuses_and_permissive_refrains() {
        let nowhere = ("ROS_SECURITY_KEYSTORE", "/nowhere");
        let error = read(&[ON, ENFORCE, nowhere], Some("/bridge")).unwrap_err();
        assert!(matches!(error, DdsSecurityError::Enforced(_)), "{error}");
        let refrained = read(&[ON, nowhere], Some("/bridge")).unwrap();
        let RequestedSecurity::Refrained(why) = refrained else {
            panic!("{refrained:?}")
        };
        if cfg!(feature = "security") {
            assert!(why.contains("/nowhere/enclaves/bridge"), "{why}");
        } else {
            assert!(why.contains("without DDS Security"), "{why}");
        }
    }

    #[test]
    fn the_name_of_an_enclave_leads_nowhere_else() {
        for name in ["bridge", "/../etc", "/a//b", "/a/", "/1a", "/a b"] {
            assert!(!is_enclave(name), "{name}");
        }
        for name in ["/", "/bridge", "/cell_1/bridge"] {
            assert!(is_enclave(name), "{name}");
        }
        let escaping = ("ROS_SECURITY_ENCLAVE_OVERRIDE", "/..");
        let error = read(&[ON, escaping], Some("/bridge")).unwrap_err();
        assert_eq!(error, DdsSecurityError::Name("/..".into()));
    }
}
