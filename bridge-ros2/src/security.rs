//! Whether a bridge takes part in DDS Security, and by which files: what SROS2 lays down in a keystore and rcl reads of
//! the environment (design.ros2.org, "ROS 2 DDS-Security integration" and "ROS 2 Security Enclaves"; rcl `security.c`).
//!
//! Two things are stricter than in rcl. A value rcl does not know, such as `ROS_SECURITY_ENABLE=1`, is refused: rcl takes
//! it for "no". And files that are there but wrong are refused with `Permissive`, too.

#[cfg(feature = "security")]
mod files;

use std::path::{Path, PathBuf};

use thiserror::Error;

/// What the environment asks for.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub enum Security {
    /// Nothing: everybody in the domain reads and writes.
    #[default]
    Off,
    /// To be secured, but rather not than not at all (`ROS_SECURITY_STRATEGY` is not `Enforce`), and it cannot be: why.
    Refrained(String),
    /// To be secured with this enclave.
    On(Enclave),
}

/// A folder of a keystore, and the name by which others know it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Enclave {
    /// `/` or `/cell/bridge`.
    pub name: String,
    /// Where its files are.
    pub folder: PathBuf,
}

/// Why the bridge cannot be secured as it is told to.
#[derive(Debug, Error, PartialEq, Eq)]
pub enum SecurityError {
    /// A value ROS does not know.
    #[error("{name} is `{value}`: it is {allowed}")]
    Value {
        /// The variable.
        name: &'static str,
        /// What it is set to.
        value: String,
        /// What it can be set to.
        allowed: &'static str,
    },
    /// Not a name of an enclave.
    #[error(
        "`{0}` is not the name of an enclave: it is an absolute ROS name as /cell/bridge (--ros-args --enclave, or \
         ROS_SECURITY_ENCLAVE_OVERRIDE)"
    )]
    Name(String),
    /// With `Enforce`.
    #[error(
        "ROS_SECURITY_ENABLE is true and ROS_SECURITY_STRATEGY is Enforce, but the bridge cannot be secured: {0}"
    )]
    Enforced(String),
    /// A file is there, and wrong.
    #[error("{}: {why}", .path.display())]
    File {
        /// Which.
        path: PathBuf,
        /// What is wrong, and what to do.
        why: String,
    },
}

impl Security {
    /// Reads `ROS_SECURITY_ENABLE`, `ROS_SECURITY_STRATEGY`, `ROS_SECURITY_KEYSTORE` and
    /// `ROS_SECURITY_ENCLAVE_OVERRIDE`, which wins over `enclave`, the argument `--enclave` of ROS.
    ///
    /// # Errors
    /// [`SecurityError`], and with `Enforce` also what `Permissive` goes without.
    pub fn from_env(
        variable: impl Fn(&str) -> Option<String>,
        enclave: Option<&str>,
    ) -> Result<Self, SecurityError> {
        let set = |name| variable(name).filter(|value| !value.is_empty());
        if !one_of(set, "ROS_SECURITY_ENABLE", ["true", "false"])? {
            return Ok(Self::Off);
        }
        let enforced = one_of(set, "ROS_SECURITY_STRATEGY", ["Enforce", "Permissive"])?;
        let name = set("ROS_SECURITY_ENCLAVE_OVERRIDE");
        let name = name.as_deref().or(enclave).unwrap_or("/");
        if !is_enclave(name) {
            return Err(SecurityError::Name(name.to_owned()));
        }
        match Enclave::find(set("ROS_SECURITY_KEYSTORE").as_deref(), name) {
            Ok(enclave) => Ok(Self::On(enclave)),
            Err(why) if enforced => Err(SecurityError::Enforced(why)),
            Err(why) => Ok(Self::Refrained(why)),
        }
    }

    /// For people.
    #[must_use]
    pub fn label(&self) -> String {
        match self {
            Self::Off => "off".to_owned(),
            Self::Refrained(_) => "off, though ROS_SECURITY_ENABLE is true".to_owned(),
            Self::On(enclave) => format!("on, enclave {}", enclave.name),
        }
    }

    /// The enclave, when it is on.
    #[must_use]
    pub const fn enclave(&self) -> Option<&Enclave> {
        match self {
            Self::On(enclave) => Some(enclave),
            Self::Off | Self::Refrained(_) => None,
        }
    }
}

/// Whether a variable is the first of two values; when it is not set it is the second.
fn one_of(
    set: impl Fn(&'static str) -> Option<String>,
    name: &'static str,
    [yes, no]: [&'static str; 2],
) -> Result<bool, SecurityError> {
    match set(name) {
        Some(value) if value == yes => Ok(true),
        None => Ok(false),
        Some(value) if value == no => Ok(false),
        Some(value) => Err(SecurityError::Value {
            name,
            value,
            allowed: match yes {
                "true" => "true or false",
                _ => "Enforce or Permissive",
            },
        }),
    }
}

/// An absolute ROS name. It becomes a path, so nothing else is in it.
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
    /// The enclave of that name, with all its files there.
    fn find(keystore: Option<&str>, name: &str) -> Result<Self, String> {
        if !cfg!(feature = "security") {
            return Err(
                "this bridge-ros2 is built without DDS Security (`bridge-ros2 --version` names it where it is there; \
                 cargo feature `security`)"
                    .to_owned(),
            );
        }
        let keystore = keystore
            .ok_or("ROS_SECURITY_KEYSTORE does not say where the keystore is (`ros2 security create_keystore`)")?;
        let folder = Path::new(keystore)
            .join("enclaves")
            .join(name.trim_start_matches('/'));
        if !folder.is_dir() {
            return Err(format!(
                "there is no folder {} for the enclave {name} (`ros2 security create_enclave {keystore} {name}`; \
                 --ros-args --enclave names another)",
                folder.display()
            ));
        }
        let missing: Vec<&str> = FILES
            .into_iter()
            .filter(|file| !folder.join(file).is_file())
            .collect();
        if !missing.is_empty() {
            return Err(format!(
                "{} lacks {} (`ros2 security create_enclave {keystore} {name}` makes them)",
                folder.display(),
                missing.join(", ")
            ));
        }
        Ok(Self {
            name: name.to_owned(),
            folder,
        })
    }

    /// Looks at the files as far as RustDDS does not say clearly what is wrong with them.
    ///
    /// The return value is what should be mended, though it works.
    ///
    /// # Errors
    /// [`SecurityError::File`] for the first file that is wrong.
    #[cfg(feature = "security")]
    pub fn check(&self) -> Result<Vec<String>, SecurityError> {
        files::check(&self.folder)
    }

    /// Nothing was found that could be looked at: there is no enclave without the feature.
    ///
    /// # Errors
    /// None.
    #[cfg(not(feature = "security"))]
    pub const fn check(&self) -> Result<Vec<String>, SecurityError> {
        Ok(Vec::new())
    }

    /// An error about one of its files.
    #[cfg(feature = "security")]
    fn fault(folder: &Path, file: &str, why: impl std::fmt::Display) -> SecurityError {
        SecurityError::File {
            path: folder.join(file),
            why: why.to_string(),
        }
    }
}

/// What an enclave consists of (rmw_dds_common `security.cpp`).
const FILES: [&str; 6] = [
    "identity_ca.cert.pem",
    "permissions_ca.cert.pem",
    "cert.pem",
    "key.pem",
    "governance.p7s",
    "permissions.p7s",
];
/// The one that may be there beside them.
#[cfg(feature = "security")]
const REVOKED: &str = "crl.pem";

#[cfg(test)]
mod tests {
    use super::*;

    fn read(variables: &[(&str, &str)], enclave: Option<&str>) -> Result<Security, SecurityError> {
        let find = |name: &str| {
            let found = variables.iter().find(|(set, _)| *set == name);
            found.map(|(_, value)| (*value).to_owned())
        };
        Security::from_env(find, enclave)
    }

    const ON: (&str, &str) = ("ROS_SECURITY_ENABLE", "true");
    const ENFORCE: (&str, &str) = ("ROS_SECURITY_STRATEGY", "Enforce");

    #[test]
    fn security_is_off_unless_it_is_asked_for() {
        assert_eq!(read(&[], None), Ok(Security::Off));
        assert_eq!(
            read(&[("ROS_SECURITY_ENABLE", ""), ENFORCE], None),
            Ok(Security::Off)
        );
        assert_eq!(
            read(&[("ROS_SECURITY_ENABLE", "false"), ENFORCE], None),
            Ok(Security::Off)
        );
    }

    #[test]
    fn what_rcl_would_take_for_no_is_refused() {
        for wrong in [
            &[("ROS_SECURITY_ENABLE", "1")][..],
            &[ON, ("ROS_SECURITY_STRATEGY", "enforce")],
        ] {
            let error = read(wrong, None).unwrap_err();
            assert!(matches!(error, SecurityError::Value { .. }), "{error}");
        }
    }

    #[test]
    fn without_files_enforce_refuses_and_permissive_refrains() {
        let nowhere = ("ROS_SECURITY_KEYSTORE", "/nowhere");
        let error = read(&[ON, ENFORCE, nowhere], Some("/bridge")).unwrap_err();
        assert!(matches!(error, SecurityError::Enforced(_)), "{error}");
        let refrained = read(&[ON, nowhere], Some("/bridge")).unwrap();
        let Security::Refrained(why) = refrained else {
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
        assert_eq!(error, SecurityError::Name("/..".into()));
    }
}
