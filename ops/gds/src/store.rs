//! The authority in its folder: its certificate and key, the issued certificates, and the
//! revocations.

use std::fmt;
use std::fs::{self, File};
use std::io::{self, Write as _};
use std::path::{Path, PathBuf};
use std::time::Duration;

use opcua::crypto::{PrivateKey, random};
use plant_opcua::synced;
use trust::{
    Certificate, CertificateAuthority, CertificateSigningRequest, Crl, Issue, Revoked, Serial,
    Unfit,
};
use x509_cert::der::pem::{self, LineEnding};

use crate::records::replace;

/// The authority of a folder.
#[derive(Debug)]
pub(crate) struct AuthorityStore {
    folder: PathBuf,
    authority: CertificateAuthority,
}

/// An issued certificate.
#[derive(Debug, Clone)]
pub(crate) struct Issued {
    pub(crate) certificate: Certificate,
    /// Time of the revocation.
    pub(crate) revoked: Option<Duration>,
}

/// The reason why the authority failed.
#[derive(Debug, thiserror::Error)]
pub(crate) enum AuthorityStoreFault {
    #[error("{path}: {source}")]
    Io {
        path: PathBuf,
        #[source]
        source: io::Error,
    },
    #[error("no authority in {0}: make it with `ua-gds ca init`")]
    Missing(PathBuf),
    #[error(
        "{0} already contains an authority, which issued certificates depend on: give another --authority"
    )]
    Present(PathBuf),
    #[error("cannot use {path}: {why}")]
    Unfit { path: PathBuf, why: Unfit },
    #[error(
        "another ua-gds already serves the authority in {0}: stop it, or give another --authority"
    )]
    Claimed(PathBuf),
    #[error("other users can read {0}: `chmod 600` it")]
    Open(PathBuf),
    #[error("no issued certificate has the number {0} (`ua-gds ca list`)")]
    Unknown(String),
    #[error("cannot make or read a key: {0}")]
    Key(String),
    #[error("cannot issue the certificate: {0}")]
    Request(Unfit),
}

impl AuthorityStoreFault {
    /// Returns true for an I/O fault, and false for a fault of the request or the authority.
    pub(crate) const fn is_io(&self) -> bool {
        matches!(self, Self::Io { .. })
    }
}

impl AuthorityStore {
    /// Creates an authority with this life.
    pub(crate) fn init(
        folder: &Path,
        names: (&str, &str),
        now: Duration,
        life: Duration,
    ) -> Result<Self, AuthorityStoreFault> {
        make_folder(folder).map_err(io_at(folder))?;
        let _alone = lock(folder)?;
        if folder.join(CERTIFICATE).exists() {
            return Err(AuthorityStoreFault::Present(folder.to_owned()));
        }
        // A key without a certificate remains from an interrupted start, and has signed nothing.
        let path = folder.join(KEY);
        let known = if path.exists() {
            Some(read_key(&path)?)
        } else {
            None
        };
        let is_new = known.is_none();
        let key = match known {
            Some(key) => key,
            None => new_key(AUTHORITY_BITS)?,
        };
        let issue = Issue {
            serial: random_serial(),
            from: now.saturating_sub(CLOCKS_DIFFER),
            until: now + life,
        };
        let authority = CertificateAuthority::make(&key, names, &issue)
            .map_err(AuthorityStoreFault::Request)?;
        if is_new {
            write_key(&path, &pem_of(&key)?).map_err(io_at(&path))?;
        }
        let path = folder.join(CERTIFICATE);
        let content = authority.certificate().pem();
        replace(&path, content.as_bytes()).map_err(io_at(&path))?;
        let store = Self {
            folder: folder.to_owned(),
            authority,
        };
        store.sign_list(now)?;
        Ok(store)
    }

    /// Opens the authority of a folder.
    pub(crate) fn open(folder: &Path) -> Result<Self, AuthorityStoreFault> {
        let (path, key) = (folder.join(CERTIFICATE), folder.join(KEY));
        if !path.exists() || !key.exists() {
            return Err(AuthorityStoreFault::Missing(folder.to_owned()));
        }
        if !is_owners(&key).map_err(io_at(&key))? {
            return Err(AuthorityStoreFault::Open(key));
        }
        let unfit = |path: &Path| {
            let path = path.to_owned();
            move |why| AuthorityStoreFault::Unfit { path, why }
        };
        let bytes = fs::read(&path).map_err(io_at(&path))?;
        let certificate = Certificate::read(&bytes).map_err(unfit(&path))?;
        let der = read_key(&key)?;
        let authority = CertificateAuthority::open(certificate, &der).map_err(unfit(&key))?;
        Ok(Self {
            folder: folder.to_owned(),
            authority,
        })
    }

    pub(crate) const fn certificate(&self) -> &Certificate {
        self.authority.certificate()
    }

    /// The folder of the authority.
    pub(crate) fn folder(&self) -> &Path {
        &self.folder
    }

    /// Issues the requested certificate with this life.
    pub(crate) fn issue(
        &self,
        request: &CertificateSigningRequest,
        now: Duration,
        life: Duration,
    ) -> Result<Certificate, AuthorityStoreFault> {
        let _alone = lock(&self.folder)?;
        let issue = Issue {
            serial: random_serial(),
            from: now.saturating_sub(CLOCKS_DIFFER),
            until: now + life,
        };
        let made = self.authority.issue(request, &issue);
        let made = made.map_err(AuthorityStoreFault::Request)?;
        let folder = self.folder.join(ISSUED);
        fs::create_dir_all(&folder).map_err(io_at(&folder))?;
        let path = folder.join(format!("{}.der", made.serial()));
        // A certificate that is not stored could not be revoked.
        replace(&path, made.der()).map_err(io_at(&path))?;
        Ok(made)
    }

    /// Revokes a certificate that was issued here. Repeating it has no effect.
    pub(crate) fn revoke(&self, serial: &Serial, now: Duration) -> Result<(), AuthorityStoreFault> {
        let _alone = lock(&self.folder)?;
        let name = format!("{serial}.der");
        if !self.folder.join(ISSUED).join(name).exists() {
            return Err(AuthorityStoreFault::Unknown(serial.to_string()));
        }
        let mut all = self.revoked()?;
        if !all.iter().any(|one| one.serial == *serial) {
            let serial = serial.clone();
            all.push(Revoked { serial, since: now });
            let line = |one: &Revoked| format!("{} {}\n", one.serial, one.since.as_secs());
            let text: String = all.iter().map(line).collect();
            let path = self.folder.join(REVOKED);
            replace(&path, text.as_bytes()).map_err(io_at(&path))?;
        }
        self.sign_list(now)
    }

    /// Returns all issued certificates, sorted by name.
    pub(crate) fn list(&self) -> Result<Vec<Issued>, AuthorityStoreFault> {
        let revoked = self.revoked()?;
        let folder = self.folder.join(ISSUED);
        let entries = match fs::read_dir(&folder) {
            Ok(entries) => entries,
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(Vec::new()),
            Err(source) => {
                return Err(AuthorityStoreFault::Io {
                    path: folder,
                    source,
                });
            }
        };
        let read = |entry: fs::DirEntry| Certificate::read(&fs::read(entry.path()).ok()?).ok();
        let mut all: Vec<Issued> = entries
            .flatten()
            .filter_map(read)
            .map(|certificate| {
                let serial = certificate.serial();
                let gone = revoked.iter().find(|one| one.serial == serial);
                Issued {
                    revoked: gone.map(|one| one.since),
                    certificate,
                }
            })
            .collect();
        all.sort_by_cached_key(|one| {
            (
                one.certificate.name(),
                one.certificate.validity(),
                one.certificate.serial(),
            )
        });
        Ok(all)
    }

    /// Returns the certificates of an application that are not revoked, latest first.
    pub(crate) fn of_application(
        &self,
        uri: &str,
    ) -> Result<Vec<Certificate>, AuthorityStoreFault> {
        let all = self.list()?.into_iter();
        let mut own: Vec<Certificate> = all
            .filter(|one| one.revoked.is_none())
            .map(|one| one.certificate)
            .filter(|one| one.application_uri().as_deref() == Some(uri))
            .collect();
        own.sort_by_key(|one| std::cmp::Reverse(one.validity()));
        Ok(own)
    }

    /// Returns the revocation list. It is signed again after half of its life.
    pub(crate) fn current_list(&self, now: Duration) -> Result<Crl, AuthorityStoreFault> {
        let path = self.folder.join(LIST);
        let read = || Crl::read(&fs::read(&path).ok()?).ok();
        let current = read().filter(|list| {
            let (made, next) = list.times();
            list.is_of(self.certificate())
                && made <= now
                && next.is_some_and(|next| next.saturating_sub(now) > LIST_LIFE / 2)
        });
        if let Some(list) = current {
            return Ok(list);
        }
        let _alone = lock(&self.folder)?;
        self.sign_list(now)?;
        read().ok_or_else(|| AuthorityStoreFault::Unfit {
            path: path.clone(),
            why: Unfit::Unreadable,
        })
    }

    /// Returns the path of the revocation list.
    pub(crate) fn list_path(&self) -> PathBuf {
        self.folder.join(LIST)
    }

    /// Returns the path of the authority's certificate.
    pub(crate) fn certificate_path(&self) -> PathBuf {
        self.folder.join(CERTIFICATE)
    }

    fn sign_list(&self, now: Duration) -> Result<(), AuthorityStoreFault> {
        let revoked = self.revoked()?;
        // The number increases with time.
        let number = u64::try_from(now.as_millis()).unwrap_or(u64::MAX);
        let list = self.authority.crl(&revoked, number, (now, now + LIST_LIFE));
        let list = list.map_err(AuthorityStoreFault::Request)?;
        let path = self.list_path();
        replace(&path, list.der()).map_err(io_at(&path))
    }

    fn revoked(&self) -> Result<Vec<Revoked>, AuthorityStoreFault> {
        let path = self.folder.join(REVOKED);
        let text = match fs::read_to_string(&path) {
            Ok(text) => text,
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(Vec::new()),
            Err(source) => return Err(AuthorityStoreFault::Io { path, source }),
        };
        let line = |line: &str| {
            let (serial, since) = line.split_once(' ')?;
            Some(Revoked {
                serial: Serial::parse(serial)?,
                since: Duration::from_secs(since.parse().ok()?),
            })
        };
        // A revocation that is skipped would make its certificate valid again.
        let all: Option<Vec<Revoked>> = text.lines().map(line).collect();
        all.ok_or(AuthorityStoreFault::Unfit {
            path,
            why: Unfit::Unreadable,
        })
    }
}

/// Creates a private key in the DER of PKCS #8. Takes some time.
pub(crate) fn new_key(bits: u32) -> Result<Vec<u8>, AuthorityStoreFault> {
    let failed = |error: &dyn fmt::Display| AuthorityStoreFault::Key(error.to_string());
    let key = PrivateKey::new(bits).map_err(|error| failed(&error))?;
    let der = key.to_der().map_err(|error| failed(&error))?;
    Ok(der.as_bytes().to_vec())
}

/// Encodes a private key in PEM.
pub(crate) fn pem_of(key: &[u8]) -> Result<String, AuthorityStoreFault> {
    pem::encode_string("PRIVATE KEY", LineEnding::LF, key)
        .map_err(|error| AuthorityStoreFault::Key(error.to_string()))
}

/// Reads a key in the DER of PKCS #8.
fn read_key(path: &Path) -> Result<Vec<u8>, AuthorityStoreFault> {
    let bytes = fs::read(path).map_err(io_at(path))?;
    let (_, der) = pem::decode_vec(&bytes).map_err(|_| AuthorityStoreFault::Unfit {
        path: path.to_owned(),
        why: Unfit::Unreadable,
    })?;
    Ok(der)
}

/// Writes a key that only its owner can read, atomically. An existing key is never replaced.
pub(crate) fn write_key(path: &Path, pem: &str) -> io::Result<()> {
    let beside = path.with_extension("new");
    match fs::remove_file(&beside) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
        Ok(()) | Err(_) => {}
    }
    let mut options = fs::OpenOptions::new();
    options.write(true).create_new(true);
    #[cfg(unix)]
    {
        use std::os::unix::fs::OpenOptionsExt as _;
        options.mode(0o600);
    }
    let mut file = options.open(&beside)?;
    let written = file
        .write_all(pem.as_bytes())
        .and_then(|()| file.sync_all())
        // Unlike a rename, a link fails if the file exists.
        .and_then(|()| match fs::hard_link(&beside, path) {
            // Some file systems have no links.
            Err(error) if error.kind() != io::ErrorKind::AlreadyExists && !path.exists() => {
                fs::rename(&beside, path)
            }
            linked => linked,
        });
    match fs::remove_file(&beside) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => Err(error),
        Ok(()) | Err(_) => written,
    }
}

/// Locks a folder against other servers until the file is dropped.
///
/// # Errors
/// Returns an error if another server has locked the folder.
pub(crate) fn claim(folder: &Path) -> Result<File, AuthorityStoreFault> {
    let path = folder.join("running");
    let claimed = synced::claim(&path).map_err(io_at(&path))?;
    claimed.ok_or_else(|| AuthorityStoreFault::Claimed(folder.to_owned()))
}

fn random_serial() -> Serial {
    let bytes = random::byte_string(16).value.unwrap_or_default();
    Serial::random(bytes.try_into().unwrap_or([0; 16]))
}

fn io_at(path: &Path) -> impl FnOnce(io::Error) -> AuthorityStoreFault + use<> {
    let path = path.to_owned();
    move |source| AuthorityStoreFault::Io { path, source }
}

/// Waits until no other process issues or revokes here, and locks the folder until the file is
/// dropped.
fn lock(folder: &Path) -> Result<File, AuthorityStoreFault> {
    let path = folder.join("lock");
    let locked = File::create(&path).and_then(|file| match file.lock() {
        // Some network file systems have no locks.
        Err(error) if error.kind() != io::ErrorKind::Unsupported => Err(error),
        Ok(()) | Err(_) => Ok(file),
    });
    locked.map_err(io_at(&path))
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
fn is_owners(path: &Path) -> io::Result<bool> {
    use std::os::unix::fs::PermissionsExt as _;
    Ok(fs::metadata(path)?.permissions().mode() & 0o077 == 0)
}

#[cfg(not(unix))]
fn is_owners(_path: &Path) -> io::Result<bool> {
    Ok(true)
}

const CERTIFICATE: &str = "authority.pem";
const KEY: &str = "authority.key";
const ISSUED: &str = "issued";
const REVOKED: &str = "revoked";
const LIST: &str = "authority.crl";
const AUTHORITY_BITS: u32 = 3072;
/// Certificates are valid from this time before their issue, because the clock of an application
/// may be behind.
const CLOCKS_DIFFER: Duration = Duration::from_secs(3600);
/// The life of the revocation list. Applications without a current list trust no certificate of the
/// authority.
const LIST_LIFE: Duration = Duration::from_secs(30 * 86_400);

#[cfg(test)]
mod tests {
    use super::*;

    const NOW: Duration = Duration::from_secs(1_795_000_000);
    const YEAR: Duration = Duration::from_secs(365 * 86_400);

    fn scratch(name: &str) -> PathBuf {
        let path = std::env::temp_dir().join(format!("ua-gds-{}-{name}", std::process::id()));
        drop(fs::remove_dir_all(&path));
        path
    }

    #[test]
    fn what_was_issued_and_revoked_is_known_after_a_restart() {
        let folder = scratch("authority");
        AuthorityStore::init(&folder, ("Plant authority", "Plant"), NOW, YEAR).unwrap();
        let again = AuthorityStore::init(&folder, ("Plant authority", "Plant"), NOW, YEAR);
        assert!(matches!(again, Err(AuthorityStoreFault::Present(_))));
        let store = AuthorityStore::open(&folder).unwrap();
        let key = new_key(2048).unwrap();
        let hosts = ["robot".to_owned()];
        let request =
            CertificateSigningRequest::make(&key, "urn:robot", ("Robot", "Plant"), &hosts).unwrap();
        let [first, second] = [1, 2].map(|day| {
            store
                .issue(&request, NOW + Duration::from_secs(day), YEAR)
                .unwrap()
        });
        store.revoke(&first.serial(), NOW).unwrap();
        let store = AuthorityStore::open(&folder).unwrap();
        assert_eq!(store.of_application("urn:robot").unwrap(), [second]);
        let list = store.current_list(NOW).unwrap();
        assert!(list.is_of(store.certificate()) && list.revokes(&first));
        let later = NOW + LIST_LIFE * 3 / 4;
        assert!(
            store
                .current_list(later)
                .unwrap()
                .is_current(NOW + LIST_LIFE)
        );
        let unknown = store.revoke(&Serial::of(&[1, 2, 3]), NOW);
        assert!(matches!(unknown, Err(AuthorityStoreFault::Unknown(_))));
        fs::remove_dir_all(folder).unwrap();
    }

    #[test]
    fn an_authority_whose_making_was_interrupted_is_made_with_its_key() {
        let folder = scratch("interrupted");
        fs::create_dir_all(&folder).unwrap();
        let key = new_key(2048).unwrap();
        write_key(&folder.join(KEY), &pem_of(&key).unwrap()).unwrap();
        assert!(
            write_key(&folder.join(KEY), "other").is_err(),
            "it is never replaced"
        );
        AuthorityStore::init(&folder, ("Plant authority", "Plant"), NOW, YEAR).unwrap();
        assert_eq!(read_key(&folder.join(KEY)).unwrap(), key);
        AuthorityStore::open(&folder).unwrap();
        fs::remove_dir_all(folder).unwrap();
    }

    #[test]
    fn a_second_server_of_one_folder_is_told_of_the_first() {
        let folder = scratch("claimed");
        fs::create_dir_all(&folder).unwrap();
        let first = claim(&folder).unwrap();
        assert!(matches!(
            claim(&folder),
            Err(AuthorityStoreFault::Claimed(_))
        ));
        drop(first);
        claim(&folder).unwrap();
        fs::remove_dir_all(folder).unwrap();
    }

    #[cfg(unix)]
    #[test]
    fn a_key_that_others_can_read_is_refused() {
        use std::os::unix::fs::PermissionsExt as _;
        let folder = scratch("open");
        AuthorityStore::init(&folder, ("Plant authority", "Plant"), NOW, YEAR).unwrap();
        let open = fs::Permissions::from_mode(0o644);
        fs::set_permissions(folder.join(KEY), open).unwrap();
        assert!(matches!(
            AuthorityStore::open(&folder),
            Err(AuthorityStoreFault::Open(_))
        ));
        fs::remove_dir_all(folder).unwrap();
    }
}
