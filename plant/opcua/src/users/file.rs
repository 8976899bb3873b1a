//! The users of a server, in a folder of its certificate store that only its owner may read.
//!
//! The file `list` has a line for each user: the name, the roles separated by commas, and a
//! credential. The credential is the argon2 hash of the password in the PHC format, or `x509:` and
//! the SHA-1 thumbprint of the user's certificate, which is stored in the same folder as
//! `<thumbprint>.der`. Lines that begin with `#` are comments.

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::{self, Read as _};
use std::path::{Path, PathBuf};

use argon2::Argon2;
use argon2::password_hash::PasswordHasher as _;
use argon2::password_hash::phc::PasswordHash;
use opcua::crypto::{CertificateStore, X509};

use super::{Roles, UnknownRole};
use crate::synced::replace;

/// A user and its credential.
#[derive(Clone, PartialEq, Eq)]
pub struct StoredUser {
    /// The roles of the user.
    pub roles: Roles,
    /// The credential of the user.
    pub credential: Credential,
}

/// The credential of a user.
#[derive(Clone, PartialEq, Eq)]
pub enum Credential {
    /// The hash of a password.
    Password(String),
    /// The SHA-1 thumbprint of a certificate in lower-case hexadecimal. The user proves to have its
    /// private key.
    Certificate(String),
}

/// Omits the hash, which must not be logged.
impl std::fmt::Debug for Credential {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Password(_) => f.write_str("Password"),
            Self::Certificate(thumbprint) => {
                f.debug_tuple("Certificate").field(thumbprint).finish()
            }
        }
    }
}

impl std::fmt::Debug for StoredUser {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("User")
            .field("roles", &self.roles)
            .field("credential", &self.credential)
            .finish()
    }
}

/// An error of the users of a server.
#[derive(Debug, thiserror::Error)]
pub enum UserFault {
    /// The folder or a file in it cannot be used.
    #[error("cannot use the users in {path}: {source}")]
    Io {
        /// The file.
        path: PathBuf,
        /// The error of the operating system.
        #[source]
        source: io::Error,
    },
    /// Other users can read the hashes.
    #[error("other users can read {0}: chmod 600 {0}")]
    Open(PathBuf),
    /// The file is too large or contains too many users.
    #[error("{0} is larger than {LARGEST_FILE} bytes, or has more than {MOST_USERS} users")]
    TooMany(PathBuf),
    /// A line is invalid. The message omits its content, which may be a hash or a password.
    #[error("{path}, line {line}: {why}")]
    Line {
        /// The file.
        path: PathBuf,
        /// The line number, from 1.
        line: usize,
        /// The reason.
        why: UserLineFault,
    },
    /// The user name is invalid.
    #[error(
        "a user's name has 1 to 64 letters, digits, dots, hyphens, underscores and @, and is not `anonymous`"
    )]
    Name,
    /// The user does not exist.
    #[error("unknown user {0}: `ua-server user list` shows the users")]
    Unknown(String),
    /// A user without a role would have no rights.
    #[error(
        "a user has at least one role: observer, operator, engineer, security_admin, configure_admin"
    )]
    NoRole,
    /// The role does not exist.
    #[error(transparent)]
    Role(#[from] UnknownRole),
    /// The password is too short or too long.
    #[error("a password has 8 to {LARGEST_PASSWORD} bytes")]
    Password,
    /// The certificate cannot be read.
    #[error("{path} is not a certificate: {why}")]
    Certificate {
        /// The file.
        path: PathBuf,
        /// The reason.
        why: String,
    },
}

/// The reason why a line is no user. It omits the content, which may be a hash or a password.
#[derive(Debug, thiserror::Error)]
pub enum UserLineFault {
    /// The line has another number of words.
    #[error("expected a name, roles, and a hash or x509: with a thumbprint")]
    Words,
    /// The user name is invalid.
    #[error("{}", UserFault::Name)]
    Name,
    /// A previous line has the same name.
    #[error("the name occurs twice")]
    Twice,
    /// The role does not exist.
    #[error(transparent)]
    Role(#[from] UnknownRole),
    /// The thumbprint of a certificate is invalid.
    #[error("expected the 40 digits of a SHA-1 thumbprint after x509:")]
    Thumbprint,
    /// The text is not a hash.
    #[error("expected an argon2 hash in the PHC format, as $argon2id$..")]
    Hash,
    /// The parameters of the hash are invalid.
    #[error("the parameters of the hash are not valid")]
    Parameters,
    /// The server would spend too much on an attempt to log in.
    #[error(
        "a hash may need at most {MOST_MEMORY} KiB and {MOST_PASSES} passes, because the server \
         computes it for each attempt"
    )]
    Costly,
}

/// The users of a server.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Users {
    by_name: BTreeMap<String, StoredUser>,
}

impl Users {
    /// Reads the users in a folder. A missing folder or file contains no users.
    ///
    /// # Errors
    /// Returns an error if other users can read the file, or if a line is invalid.
    pub fn read(folder: &Path) -> Result<Self, UserFault> {
        let path = folder.join(LIST);
        let io = |source| UserFault::Io {
            path: path.clone(),
            source,
        };
        let file = match File::open(&path) {
            Ok(file) => file,
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(Self::default()),
            Err(error) => return Err(io(error)),
        };
        let about = file.metadata().map_err(io)?;
        if others_read(&about) {
            return Err(UserFault::Open(path));
        }
        let mut text = String::new();
        file.take(LARGEST_FILE + 1)
            .read_to_string(&mut text)
            .map_err(io)?;
        if u64::try_from(text.len()).is_ok_and(|length| length > LARGEST_FILE) {
            return Err(UserFault::TooMany(path));
        }
        let users = Self::parse(&text).map_err(|(line, why)| UserFault::Line {
            path: path.clone(),
            line,
            why,
        })?;
        if users.by_name.len() > MOST_USERS {
            return Err(UserFault::TooMany(path));
        }
        Ok(users)
    }

    fn parse(text: &str) -> Result<Self, (usize, UserLineFault)> {
        let mut by_name = BTreeMap::new();
        for (line, number) in text.lines().zip(1..) {
            let line = line.trim();
            if line.is_empty() || line.starts_with('#') {
                continue;
            }
            let (name, user) = user(line).map_err(|why| (number, why))?;
            if by_name.insert(name.to_owned(), user).is_some() {
                return Err((number, UserLineFault::Twice));
            }
        }
        Ok(Self { by_name })
    }

    /// Writes the users, and replaces the previous file.
    ///
    /// # Errors
    /// Returns an error if the folder or the file cannot be written.
    pub fn write(&self, folder: &Path) -> Result<(), UserFault> {
        let path = folder.join(LIST);
        let mut text = String::from(HEAD);
        for (name, user) in &self.by_name {
            let credential = match &user.credential {
                Credential::Password(hash) => hash.clone(),
                Credential::Certificate(thumbprint) => format!("{X509_PREFIX}{thumbprint}"),
            };
            text.push_str(&format!("{name} {} {credential}\n", user.roles));
        }
        let written = make_folder(folder).and_then(|()| replace(&path, text.as_bytes()));
        written.map_err(|source| UserFault::Io { path, source })
    }

    /// Returns whether there are no users.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.by_name.is_empty()
    }

    /// Returns a user by name.
    #[must_use]
    pub fn get(&self, name: &str) -> Option<&StoredUser> {
        self.by_name.get(name)
    }

    /// Returns the users, ordered by name.
    pub fn iter(&self) -> impl Iterator<Item = (&str, &StoredUser)> {
        self.by_name.iter().map(|(name, user)| (&name[..], user))
    }

    /// Returns the user with the certificate of this thumbprint.
    #[must_use]
    pub fn of_certificate(&self, thumbprint: &str) -> Option<(&str, &StoredUser)> {
        self.iter().find(|(_, user)| match &user.credential {
            Credential::Certificate(known) => known == thumbprint,
            Credential::Password(_) => false,
        })
    }

    /// Adds a user, or replaces the user with the same name.
    ///
    /// # Errors
    /// Returns an error for an invalid name or if the user has no role.
    pub fn put(&mut self, name: &str, user: StoredUser) -> Result<(), UserFault> {
        if !is_name(name) {
            return Err(UserFault::Name);
        }
        if user.roles == Roles::NONE {
            return Err(UserFault::NoRole);
        }
        self.by_name.insert(name.to_owned(), user);
        Ok(())
    }

    /// Replaces the roles of a user.
    ///
    /// # Errors
    /// Returns an error if the user does not exist or if no role is given.
    pub fn set_roles(&mut self, name: &str, roles: Roles) -> Result<(), UserFault> {
        if roles == Roles::NONE {
            return Err(UserFault::NoRole);
        }
        let user = self.by_name.get_mut(name);
        user.ok_or_else(|| UserFault::Unknown(name.to_owned()))?
            .roles = roles;
        Ok(())
    }

    /// Removes a user.
    ///
    /// # Errors
    /// Returns an error if the user does not exist.
    pub fn remove(&mut self, name: &str) -> Result<StoredUser, UserFault> {
        let gone = self.by_name.remove(name);
        gone.ok_or_else(|| UserFault::Unknown(name.to_owned()))
    }

    /// Stores the certificate of a user in the folder, and returns the credential.
    ///
    /// # Errors
    /// Returns an error if the file is not a certificate or cannot be stored.
    pub fn keep_certificate(folder: &Path, from: &Path) -> Result<Credential, UserFault> {
        let certificate = read_certificate(from)?;
        let thumbprint = certificate.thumbprint().as_hex_string().to_lowercase();
        let path = folder.join(format!("{thumbprint}.der"));
        let der = certificate
            .to_der()
            .map_err(|error| UserFault::Certificate {
                path: from.to_owned(),
                why: error.to_string(),
            })?;
        let written = make_folder(folder).and_then(|()| replace(&path, &der));
        written.map_err(|source| UserFault::Io { path, source })?;
        Ok(Credential::Certificate(thumbprint))
    }

    /// Returns the stored certificate of a user.
    ///
    /// # Errors
    /// Returns an error if the certificate is missing or invalid.
    pub fn certificate(folder: &Path, thumbprint: &str) -> Result<X509, UserFault> {
        read_certificate(&folder.join(format!("{thumbprint}.der")))
    }
}

/// Reads a certificate in DER or PEM.
fn read_certificate(path: &Path) -> Result<X509, UserFault> {
    CertificateStore::read_cert(path).map_err(|why| UserFault::Certificate {
        path: path.to_owned(),
        why,
    })
}

fn user(line: &str) -> Result<(&str, StoredUser), UserLineFault> {
    let mut parts = line.split_whitespace();
    let (Some(name), Some(roles), Some(credential), None) =
        (parts.next(), parts.next(), parts.next(), parts.next())
    else {
        return Err(UserLineFault::Words);
    };
    if !is_name(name) {
        return Err(UserLineFault::Name);
    }
    let roles: Roles = roles.parse()?;
    let credential = match credential.strip_prefix(X509_PREFIX) {
        Some(thumbprint) => {
            let thumbprint = thumbprint.to_lowercase();
            if thumbprint.len() != 40 || !thumbprint.bytes().all(|b| b.is_ascii_hexdigit()) {
                return Err(UserLineFault::Thumbprint);
            }
            Credential::Certificate(thumbprint)
        }
        None => Credential::Password(sound_hash(credential)?),
    };
    Ok((name, StoredUser { roles, credential }))
}

/// Checks that the cost of verifying a hash is bounded.
fn sound_hash(text: &str) -> Result<String, UserLineFault> {
    let hash = PasswordHash::new(text).map_err(|_| UserLineFault::Hash)?;
    let parameters = argon2::Params::try_from(&hash).map_err(|_| UserLineFault::Parameters)?;
    if !hash.algorithm.as_str().starts_with("argon2") || hash.hash.is_none() {
        return Err(UserLineFault::Hash);
    }
    if parameters.m_cost() > MOST_MEMORY || parameters.t_cost() > MOST_PASSES {
        return Err(UserLineFault::Costly);
    }
    Ok(text.to_owned())
}

/// Returns the argon2id hash of a password, in the PHC format.
///
/// # Errors
/// Returns an error if the password is too short or too long.
pub fn hashed(password: &[u8]) -> Result<Credential, UserFault> {
    if !(8..=LARGEST_PASSWORD).contains(&password.len()) {
        return Err(UserFault::Password);
    }
    let salt = opcua::crypto::random::byte_string(16);
    let hash: PasswordHash = Argon2::default()
        .hash_password_with_salt(password, salt.as_ref())
        .map_err(|_| UserFault::Password)?;
    Ok(Credential::Password(hash.to_string()))
}

fn is_name(text: &str) -> bool {
    (1..=64).contains(&text.len())
        && text
            .bytes()
            .all(|b| b.is_ascii_alphanumeric() || b"._-@".contains(&b))
        && !text.eq_ignore_ascii_case("anonymous")
}

#[cfg(unix)]
fn make_folder(folder: &Path) -> io::Result<()> {
    use std::os::unix::fs::PermissionsExt as _;
    fs::create_dir_all(folder)?;
    fs::set_permissions(folder, fs::Permissions::from_mode(0o700))
}

#[cfg(not(unix))]
fn make_folder(folder: &Path) -> io::Result<()> {
    fs::create_dir_all(folder)
}

#[cfg(unix)]
fn others_read(about: &fs::Metadata) -> bool {
    use std::os::unix::fs::PermissionsExt as _;
    about.permissions().mode() & 0o077 != 0
}

#[cfg(not(unix))]
fn others_read(_about: &fs::Metadata) -> bool {
    false
}

/// The folder of users below the root of the certificate store.
pub const FOLDER: &str = "users";
/// The file in this folder.
pub(super) const LIST: &str = "list";
const HEAD: &str = "# Name, roles, and the argon2 hash of the password or the thumbprint of the certificate. See `ua-server user`.\n";
const X509_PREFIX: &str = "x509:";
/// Maximum number of users of a server.
pub const MOST_USERS: usize = 10_000;
/// Maximum number of bytes of a password.
pub const LARGEST_PASSWORD: usize = 1_024;
const LARGEST_FILE: u64 = 4 << 20;
/// Maximum memory in KiB, and maximum number of passes, of a hash.
const MOST_MEMORY: u32 = 256 << 10;
const MOST_PASSES: u32 = 32;

#[cfg(test)]
mod tests {
    use super::super::UserRole;
    use super::*;

    fn scratch(name: &str) -> PathBuf {
        let path =
            std::env::temp_dir().join(format!("plant-opcua-users-{}-{name}", std::process::id()));
        drop(fs::remove_dir_all(&path));
        path
    }

    fn operator(credential: Credential) -> StoredUser {
        StoredUser {
            roles: Roles::of(&[UserRole::Operator]),
            credential,
        }
    }

    #[cfg(unix)]
    #[test]
    fn users_are_read_back_from_a_file_of_their_owner_alone() {
        use std::os::unix::fs::PermissionsExt as _;
        let folder = scratch("back");
        let mut users = Users::default();
        users
            .put("anna", operator(hashed(b"correct horse").unwrap()))
            .unwrap();
        users
            .put("plc-1", operator(Credential::Certificate("ab".repeat(20))))
            .unwrap();
        users.write(&folder).unwrap();
        assert_eq!(Users::read(&folder).unwrap(), users);
        let list = folder.join(LIST);
        let mode = fs::metadata(&list).unwrap().permissions().mode();
        assert_eq!(mode & 0o077, 0);
        let text = fs::read_to_string(&list).unwrap();
        assert!(
            !text.contains("horse") && text.contains("$argon2id$"),
            "{text}"
        );
        fs::set_permissions(&list, fs::Permissions::from_mode(0o644)).unwrap();
        assert!(matches!(Users::read(&folder), Err(UserFault::Open(_))));
        fs::remove_dir_all(folder).unwrap();
    }

    #[test]
    fn without_a_file_there_are_no_users() {
        assert!(Users::read(&scratch("none")).unwrap().is_empty());
    }

    #[test]
    fn a_line_that_is_none_of_a_user_is_told_by_its_number_and_not_by_what_stands_in_it() {
        for (text, why) in [
            ("anna operator hunter2hunter2", "argon2"),
            ("anna boss $argon2id$x", "not a role"),
            ("anna operator", "expected a name"),
            ("ann/a operator x509:00", "name"),
            ("anonymous operator x509:00", "anonymous"),
            ("anna operator x509:00", "40 digits"),
            (
                "anna operator $argon2id$v=19$m=9999999,t=2,p=1$c2FsdHNhbHRzYWx0$AAAAAAAAAAAAAAAAAAAAAA",
                "KiB",
            ),
        ] {
            let (line, told) = Users::parse(&format!("# who\n{text}\n")).unwrap_err();
            assert_eq!(line, 2);
            let told = told.to_string();
            assert!(told.contains(why) && !told.contains("hunter2"), "{told}");
        }
        let twice = format!("a operator x509:{0}\na engineer x509:{0}\n", "0".repeat(40));
        assert_eq!(Users::parse(&twice).unwrap_err().0, 2);
    }

    #[test]
    fn a_password_that_is_too_short_or_too_long_is_refused() {
        assert!(matches!(hashed(b"short"), Err(UserFault::Password)));
        let long = vec![b'x'; LARGEST_PASSWORD + 1];
        assert!(matches!(hashed(&long), Err(UserFault::Password)));
    }
}
