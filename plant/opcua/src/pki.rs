//! The application's own certificate, and the rejected certificates of clients.

use std::collections::BTreeSet;
use std::fs::{self, File};
use std::io;
use std::path::{Path, PathBuf};

use opcua::crypto::{CertificateStore, PrivateKey, X509, X509Data};
use tracing::warn;

use crate::certificates::{self, REJECTED_KEPT, Standing};
use crate::known;
use crate::own::{self, CertificateCause, CertificateOwner};
use crate::pair::{self, PairFiles};
pub use crate::pair::{OWN_CERTIFICATE, OWN_KEY};

/// An OPC UA certificate store with the directories `own`, `private`, `trusted` and `rejected`
/// below a root.
#[derive(Debug)]
pub struct Pki {
    root: PathBuf,
    reported: BTreeSet<PathBuf>,
}

/// An error of the certificate store.
#[derive(Debug, thiserror::Error)]
pub enum PkiError {
    /// A directory cannot be created or read.
    #[error("cannot use the certificate store {path}: {source}; choose another directory for it")]
    Directory {
        /// The directory.
        path: PathBuf,
        /// The error of the operating system.
        #[source]
        source: io::Error,
    },
    /// Only the certificate or only the key exists. A new pair would silently replace a certificate
    /// that clients trust.
    #[error("{present} exists, but {missing} does not: restore it, or remove both for a new pair")]
    Half {
        /// The existing file.
        present: PathBuf,
        /// The missing file.
        missing: PathBuf,
    },
    /// The files exist, but are not a valid certificate and key.
    #[error("{0}; restore the certificate and its key, or remove both for a new pair")]
    Unreadable(String),
    /// A new pair cannot be created or written.
    #[error("cannot make a certificate: {0}")]
    Make(String),
    /// The store has no certificate to renew.
    #[error("no certificate in {0}: start the program that uses this store, which makes it")]
    None(PathBuf),
    /// An authority issued the certificate.
    #[error(
        "the certificate was issued by {0:?}, which other applications trust: have it renewed there (--gds), or give --self-made \
         to replace it by a self-made one"
    )]
    Issued(String),
}

impl Pki {
    /// Opens the store under `root`, and creates missing directories.
    ///
    /// # Errors
    /// Returns an error if a directory cannot be created or read.
    pub fn open(root: PathBuf) -> Result<Self, PkiError> {
        for name in ["own", "private", "trusted", "rejected"] {
            let path = root.join(name);
            let made = fs::create_dir_all(&path).and_then(|()| match name {
                "private" => owner_only(&path),
                _ => Ok(()),
            });
            made.map_err(|source| PkiError::Directory { path, source })?;
        }
        let mut pki = Self {
            root,
            reported: BTreeSet::new(),
        };
        pki.reported = pki
            .rejected()
            .map_err(|source| PkiError::Directory {
                path: pki.root.join("rejected"),
                source,
            })?
            .into_iter()
            .collect();
        Ok(pki)
    }

    /// Returns the root of the store.
    #[must_use]
    pub fn root(&self) -> &Path {
        &self.root
    }

    /// Makes sure that a client has an application instance certificate and its key (OPC 10000-6,
    /// 6.2.2).
    ///
    /// Creates a missing pair for the application and its host. Replaces a self-made certificate
    /// that has expired. Logs a warning if an existing certificate does not fit otherwise. If
    /// several programs start with the same store, the first program creates the pair and the other
    /// programs use it. The store may belong to a server.
    ///
    /// # Errors
    /// Returns an error if files cannot be read or written, or if only half of a pair exists.
    pub fn ensure_own(&self, application_uri: &str, host: &str) -> Result<(), PkiError> {
        let hosts = [host.to_owned()];
        self.ensure((application_uri, CertificateOwner::Client), &hosts, NAME)
    }

    /// Makes sure that a server with several hosts has a certificate, like
    /// [`ensure_own`](Self::ensure_own). Also replaces a self-made certificate of another
    /// ApplicationUri.
    ///
    /// # Errors
    /// Returns an error if files cannot be read or written, or if only half of a pair exists.
    pub fn ensure_own_at(&self, application_uri: &str, hosts: &[String]) -> Result<(), PkiError> {
        self.ensure_own_named(application_uri, hosts, NAME)
    }

    /// Makes sure that a server with a name has a certificate, like
    /// [`ensure_own_at`](Self::ensure_own_at).
    ///
    /// # Errors
    /// Returns an error if files cannot be read or written, or if only half of a pair exists.
    pub fn ensure_own_named(
        &self,
        application_uri: &str,
        hosts: &[String],
        name: &str,
    ) -> Result<(), PkiError> {
        self.ensure((application_uri, CertificateOwner::Server), hosts, name)
    }

    fn ensure(
        &self,
        application: (&str, CertificateOwner),
        hosts: &[String],
        name: &str,
    ) -> Result<(), PkiError> {
        let _alone = self.lock()?;
        let certificate = self.root.join(OWN_CERTIFICATE);
        let key = self.root.join(OWN_KEY);
        let files = pair::settle(&self.root).map_err(|source| PkiError::Directory {
            path: self.root.clone(),
            source,
        })?;
        let now = known::now();
        let data = own::described(application.0, hosts, name, now);
        match files {
            PairFiles::Both => {
                let known = own::read(&self.root);
                match known.and_then(|known| own::outdated(&known, application, now)) {
                    Some(cause) => self.make_anew(&data, &cause),
                    None => check_own(&certificate, &key, application.0),
                }
            }
            PairFiles::Certificate => self.replace_without_key(&data, certificate, key),
            PairFiles::Key => self.certify_key(&data, certificate, key),
            PairFiles::Neither => self.make_own(&data, None, &CertificateCause::Missing),
        }
    }

    /// Replaces the self-made certificate by command, with the same key, ApplicationUri and hosts.
    /// With `even_issued` a certificate of an authority is replaced too.
    ///
    /// # Errors
    /// Returns an error if the store has no certificate, if an authority issued the certificate, or
    /// if files cannot be read or written.
    pub fn renew(&self, even_issued: bool) -> Result<(), PkiError> {
        let _alone = self.lock()?;
        let Some(known) = own::read(&self.root) else {
            return Err(PkiError::None(self.root.clone()));
        };
        if !known.is_self_signed() && !even_issued {
            return Err(PkiError::Issued(known.issuer_name()));
        }
        let (uri, name) = (known.application_uri().unwrap_or_default(), known.name());
        let name = if own::is_self_made(&known) {
            &name
        } else {
            NAME
        };
        let computer = opcua::crypto::hostname().unwrap_or_default();
        let mut hosts = known.hosts();
        // A certificate contains the names of the computer itself anyway.
        hosts.retain(|host| *host != computer && host != "localhost");
        let data = own::described(&uri, &hosts, name, known::now());
        self.make_anew(&data, &CertificateCause::Command)
    }

    /// Makes a new certificate for the existing key.
    fn make_anew(&self, data: &X509Data, cause: &CertificateCause) -> Result<(), PkiError> {
        let key = CertificateStore::read_pkey(&self.root.join(OWN_KEY));
        let key = key.map_err(PkiError::Unreadable)?;
        self.make_own(data, Some(key), cause)?;
        warn!("applications that trust the previous certificate must trust the new certificate");
        Ok(())
    }

    /// Makes a new pair to replace a self-made certificate without key.
    ///
    /// An interrupted start can leave a certificate without its key if the certificate is written
    /// first.
    fn replace_without_key(
        &self,
        data: &X509Data,
        certificate: PathBuf,
        key: PathBuf,
    ) -> Result<(), PkiError> {
        if !own::read(&self.root).is_some_and(|one| own::is_self_made(&one)) {
            return Err(PkiError::Half {
                present: certificate,
                missing: key,
            });
        }
        let aside = certificate.with_extension("without-key");
        fs::rename(&certificate, &aside).map_err(|source| PkiError::Directory {
            path: certificate.clone(),
            source,
        })?;
        warn!(aside = %aside.display(), "the previous certificate has no key: moved it aside");
        self.make_own(data, None, &CertificateCause::KeyMissing)
    }

    /// Makes a certificate for a key without certificate.
    fn certify_key(
        &self,
        data: &X509Data,
        certificate: PathBuf,
        key: PathBuf,
    ) -> Result<(), PkiError> {
        let Ok(known) = CertificateStore::read_pkey(&key) else {
            return Err(PkiError::Half {
                present: key,
                missing: certificate,
            });
        };
        self.make_own(data, Some(known), &CertificateCause::CertificateMissing)
    }

    /// Makes a new pair, or a certificate for an existing key.
    fn make_own(
        &self,
        data: &X509Data,
        key: Option<PrivateKey>,
        cause: &CertificateCause,
    ) -> Result<(), PkiError> {
        let made = |error: &dyn std::fmt::Display| PkiError::Make(error.to_string());
        let (certificate, new_key) = match key {
            Some(key) => (X509::from_pkey(&key, data).map_err(PkiError::Make)?, None),
            None => {
                let (certificate, key) = X509::cert_and_pkey(data).map_err(PkiError::Make)?;
                (certificate, Some(key))
            }
        };
        let der = certificate.to_der().map_err(|error| made(&error))?;
        let key = new_key.map(|key| key.to_der()).transpose();
        let key = key.map_err(|error| made(&error))?;
        let key = key.as_ref().map(|key| key.as_bytes());
        pair::write(&self.root, &der, key).map_err(|error| made(&error))?;
        own::report(&self.root, cause);
        Ok(())
    }

    /// Waits for the exclusive lock of the store. Dropping the file releases the lock.
    fn lock(&self) -> Result<File, PkiError> {
        let path = self.root.join(LOCK);
        let locked = File::create(&path).and_then(|file| match file.lock() {
            // Some network file systems do not support locks; servers that start at the same time
            // are then not synchronized.
            Err(error) if error.kind() != io::ErrorKind::Unsupported => Err(error),
            Ok(()) | Err(_) => Ok(file),
        });
        locked.map_err(|source| PkiError::Directory { path, source })
    }

    /// Logs how to trust each client certificate that was rejected since the last call. Keeps the
    /// newest `REJECTED_KEPT` certificates, because anyone who reaches the port can add
    /// certificates.
    pub fn report_rejected(&mut self) {
        // If the directory is missing, the server still refuses the certificates and logs it.
        let rejected = self.rejected().unwrap_or_default();
        let oldest = rejected.len().saturating_sub(REJECTED_KEPT);
        for (at, path) in rejected.iter().enumerate() {
            if at < oldest {
                remove(path);
            } else if !self.reported.contains(path) {
                self.tell_refused(path);
            }
        }
        self.reported = rejected.into_iter().collect();
    }

    /// Logs a rejected client and the command that trusts it, by thumbprint: the client chose all
    /// other data freely.
    fn tell_refused(&self, path: &Path) {
        let trusted = self.root.join("trusted");
        let Some(stored) = certificates::stored(path, Standing::Rejected) else {
            warn!("rejected a client, and {path:?} contains no certificate that can be trusted");
            return;
        };
        warn!(
            name = ?stored.name,
            application_uri = ?stored.application_uri.unwrap_or_default(),
            "rejected a client whose certificate is not trusted; to trust it: `ua-server trust {} --pki \
             {:?}`, or move {path:?} into {trusted:?}",
            stored.thumbprint.get(..16).unwrap_or_default(),
            self.root,
        );
    }

    /// Returns the rejected certificates, oldest first.
    fn rejected(&self) -> io::Result<Vec<PathBuf>> {
        let mut found = Vec::new();
        for entry in fs::read_dir(self.root.join("rejected"))? {
            let entry = entry?;
            found.push((entry.metadata()?.modified()?, entry.path()));
        }
        found.sort();
        Ok(found.into_iter().map(|(_, path)| path).collect())
    }
}

/// Returns the default root of the store: the state directory of systemd, of the user, or of the
/// system.
#[must_use]
pub fn default_root(variable: impl Fn(&str) -> Option<String>) -> PathBuf {
    let given = |name| {
        variable(name)
            .filter(|value| !value.is_empty())
            .map(PathBuf::from)
    };
    if let Some(state) = given("STATE_DIRECTORY") {
        return state.join("pki");
    }
    let state = given("XDG_STATE_HOME")
        .or_else(|| given("HOME").map(|home| home.join(".local/state")))
        .unwrap_or_else(|| PathBuf::from("/var/lib"));
    state.join("ua-bridge/pki")
}

/// Returns the store with this name beside the default store, for a program that shares its host
/// with other programs.
#[must_use]
pub fn default_named(name: &str) -> PathBuf {
    default_root(|variable| std::env::var(variable).ok()).with_file_name(name)
}

/// Makes all certificates in `trusted` of the store at `root` effective, whatever their file names:
/// the library expects a file name of its own. Also removes them from `rejected`, because the
/// library refuses a certificate that is both trusted and rejected.
pub fn know_trusted(root: &Path) {
    // Without the directory, no certificate is trusted.
    let Ok(entries) = fs::read_dir(root.join("trusted")) else {
        return;
    };
    for path in entries.flatten().map(|entry| entry.path()) {
        let Ok(certificate) = CertificateStore::read_cert(&path) else {
            continue;
        };
        let name = CertificateStore::cert_file_name(&certificate);
        let known = root.join("trusted").join(&name);
        if known != path
            && !known.exists()
            && let Err(error) = fs::copy(&path, &known)
        {
            warn!(path = %path.display(), %error, "cannot use a trusted certificate");
            continue;
        }
        let refused = root.join("rejected").join(&name);
        if refused.exists() {
            remove(&refused);
        }
    }
}

fn remove(refused: &Path) {
    if let Err(error) = fs::remove_file(refused) {
        warn!(path = %refused.display(), %error, "cannot remove an old rejected certificate");
    }
}

fn check_own(certificate: &Path, key: &Path, application_uri: &str) -> Result<(), PkiError> {
    let own = CertificateStore::read_cert(certificate).map_err(PkiError::Unreadable)?;
    CertificateStore::read_pkey(key).map_err(PkiError::Unreadable)?;
    if own.is_application_uri_valid(application_uri).is_err() {
        warn!(
            certificate = %certificate.display(),
            application_uri,
            "the certificate has the ApplicationUri of another application, so peers will reject it; request one \
             for this application (--gds), or run `ua-server renew --self-made` and restart",
        );
    }
    let now = opcua::types::DateTime::now().as_chrono();
    if own.is_time_valid(&now).is_err() {
        warn!(
            certificate = %certificate.display(),
            "the certificate is not valid at this time (see `openssl x509 -noout -dates`): clients will reject it",
        );
    }
    Ok(())
}

#[cfg(unix)]
fn owner_only(path: &Path) -> io::Result<()> {
    use std::os::unix::fs::PermissionsExt as _;
    fs::set_permissions(path, fs::Permissions::from_mode(0o700))
}

#[cfg(not(unix))]
fn owner_only(_path: &Path) -> io::Result<()> {
    Ok(())
}

/// The certificate folder of a peer without certificates: this folder cannot be created.
pub(crate) const NO_PKI: &str = "/dev/null/pki";
/// The lock file for creating the pair.
const LOCK: &str = "private/lock";
/// The common name of an application without its own name.
const NAME: &str = "UA bridge";

#[cfg(test)]
mod tests {
    use opcua::crypto::SecurityPolicy;
    use trust::Certificate;

    use super::*;

    fn scratch(name: &str) -> PathBuf {
        let path =
            std::env::temp_dir().join(format!("plant-opcua-pki-{}-{name}", std::process::id()));
        drop(fs::remove_dir_all(&path));
        path
    }

    #[test]
    fn a_missing_certificate_is_made_for_the_application_and_the_host() {
        let root = scratch("made");
        let pki = Pki::open(root.clone()).unwrap();
        pki.ensure_own("urn:cell:server", "192.0.2.7").unwrap();
        let own = CertificateStore::read_cert(&root.join(OWN_CERTIFICATE)).unwrap();
        assert!(own.is_application_uri_valid("urn:cell:server").is_ok());
        assert!(own.is_hostname_valid("192.0.2.7").is_ok());
        assert!(own.is_hostname_valid("localhost").is_ok());
        assert!(own.is_hostname_valid("192.0.2.8").is_err());
        let before = fs::read(root.join(OWN_CERTIFICATE)).unwrap();
        pki.ensure_own("urn:cell:server", "192.0.2.7").unwrap();
        assert_eq!(
            before,
            fs::read(root.join(OWN_CERTIFICATE)).unwrap(),
            "a certificate that is there is kept"
        );
        fs::remove_dir_all(root).unwrap();
    }

    #[test]
    fn a_certificate_under_any_name_is_trusted_and_no_longer_refused() {
        let root = scratch("known");
        let pki = Pki::open(root.clone()).unwrap();
        pki.ensure_own("urn:cell:server", "localhost").unwrap();
        let own = CertificateStore::read_cert(&root.join(OWN_CERTIFICATE)).unwrap();
        let store = CertificateStore::new(&root);
        assert!(
            store
                .validate_or_reject_application_instance_cert(
                    &own,
                    SecurityPolicy::Basic256Sha256,
                    None,
                    None
                )
                .is_err()
        );
        assert_eq!(pki.rejected().unwrap().len(), 1);
        fs::copy(
            root.join(OWN_CERTIFICATE),
            root.join("trusted/of the server.der"),
        )
        .unwrap();
        fs::write(root.join("trusted/README"), "no certificate").unwrap();
        know_trusted(&root);
        assert!(
            store
                .validate_or_reject_application_instance_cert(
                    &own,
                    SecurityPolicy::Basic256Sha256,
                    None,
                    None
                )
                .is_ok()
        );
        assert!(pki.rejected().unwrap().is_empty());
        fs::remove_dir_all(root).unwrap();
    }

    #[test]
    fn servers_that_start_at_once_in_one_store_have_one_certificate() {
        let root = scratch("at-once");
        let start = std::sync::Barrier::new(3);
        let begin = || {
            let pki = Pki::open(root.clone()).unwrap();
            start.wait();
            pki.ensure_own("urn:cell:server", "localhost")
                .map(|()| fs::read(root.join(OWN_CERTIFICATE)).unwrap())
        };
        let made: Vec<Vec<u8>> = std::thread::scope(|scope| {
            let servers: Vec<_> = (0..3).map(|_| scope.spawn(begin)).collect();
            let ended = servers.into_iter().map(|server| server.join().unwrap());
            ended.collect::<Result<_, _>>().unwrap()
        });
        assert!(
            made.iter().all(|one| *one == made[0]),
            "each has the same certificate"
        );
        fs::remove_dir_all(root).unwrap();
    }

    #[cfg(unix)]
    #[test]
    fn only_the_owner_reads_the_private_key() {
        use std::os::unix::fs::PermissionsExt as _;
        let root = scratch("mode");
        Pki::open(root.clone()).unwrap();
        let mode = fs::metadata(root.join("private"))
            .unwrap()
            .permissions()
            .mode();
        assert_eq!(mode & 0o077, 0);
        fs::remove_dir_all(root).unwrap();
    }

    #[test]
    fn a_key_that_cannot_be_read_is_no_half_of_a_pair() {
        let root = scratch("half");
        let pki = Pki::open(root.clone()).unwrap();
        fs::write(root.join(OWN_KEY), "key").unwrap();
        let error = pki
            .ensure_own("urn:a", "localhost")
            .unwrap_err()
            .to_string();
        assert!(
            error.contains("private.pem") && error.contains("cert.der"),
            "{error}"
        );
        fs::remove_dir_all(root).unwrap();
    }

    #[test]
    fn a_first_start_that_was_interrupted_is_completed_by_the_next_one() {
        type Interrupted = fn(&Path);
        let (certificate, key) = (OWN_CERTIFICATE, OWN_KEY);
        let cases: [(&str, Interrupted); 6] = [
            ("the certificate alone", |root| {
                fs::remove_file(root.join(OWN_KEY)).unwrap();
            }),
            ("the key alone", |root| {
                fs::remove_file(root.join(OWN_CERTIFICATE)).unwrap();
            }),
            ("an empty key of a full disk", |root| {
                fs::write(root.join(OWN_KEY), "").unwrap();
            }),
            ("an empty certificate of a full disk", |root| {
                fs::write(root.join(OWN_CERTIFICATE), "").unwrap();
            }),
            ("the key renamed, its certificate beside", |root| {
                let path = root.join(OWN_CERTIFICATE);
                fs::rename(&path, path.with_extension("new")).unwrap();
            }),
            ("half a certificate beside", |root| {
                for file in [OWN_CERTIFICATE, OWN_KEY] {
                    fs::remove_file(root.join(file)).unwrap();
                }
                fs::write(root.join(OWN_CERTIFICATE).with_extension("new"), "x").unwrap();
            }),
        ];
        for (number, (what, interrupt)) in cases.into_iter().enumerate() {
            let root = scratch(&format!("interrupted-{number}"));
            let pki = Pki::open(root.clone()).unwrap();
            pki.ensure_own("urn:a", "localhost").unwrap();
            interrupt(&root);
            let again = pki.ensure_own("urn:a", "localhost");
            again.unwrap_or_else(|error| panic!("{what}: {error}"));
            let made = Certificate::read(&fs::read(root.join(certificate)).unwrap()).unwrap();
            let der = pair::from_pem(&fs::read(root.join(key)).unwrap()).unwrap();
            assert!(made.is_of_private_key(&der), "{what}");
            for file in [certificate, key] {
                let beside = root.join(file).with_extension("new");
                assert!(!beside.exists(), "{what}");
            }
            fs::remove_dir_all(root).unwrap();
        }
    }

    #[test]
    fn a_certificate_of_another_application_is_made_anew_for_a_server_and_by_command() {
        let root = scratch("anew");
        let pki = Pki::open(root.clone()).unwrap();
        let read = || own::read(&root).unwrap();
        pki.ensure_own("urn:a", "localhost").unwrap();
        let first = read();
        pki.ensure_own("urn:b", "localhost").unwrap();
        assert_eq!(read(), first, "a client of the store replaces nothing");
        let hosts = ["other".to_owned()];
        pki.ensure_own_at("urn:b", &hosts).unwrap();
        let second = read();
        assert_eq!(second.application_uri().as_deref(), Some("urn:b"));
        assert_eq!(second.key_fingerprint(), first.key_fingerprint());
        pki.ensure_own_at("urn:b", &hosts).unwrap();
        assert_eq!(read(), second);
        pki.renew(false).unwrap();
        // Within the same second the certificate has the same bytes.
        let third = read();
        assert_eq!(third.application_uri().as_deref(), Some("urn:b"));
        assert!(third.is_for_host("other"));
        assert_eq!(third.hosts().len(), second.hosts().len());
        let said = own::status(&root).unwrap();
        assert_eq!(said["reason"], CertificateCause::Command.to_string());
        fs::remove_dir_all(root).unwrap();
    }

    #[test]
    fn refused_certificates_do_not_fill_the_disk() {
        let root = scratch("rejected");
        let mut pki = Pki::open(root.clone()).unwrap();
        for n in 0..REJECTED_KEPT + 5 {
            fs::write(root.join("rejected").join(format!("{n}.der")), "x").unwrap();
        }
        pki.report_rejected();
        assert_eq!(
            fs::read_dir(root.join("rejected")).unwrap().count(),
            REJECTED_KEPT
        );
        fs::remove_dir_all(root).unwrap();
    }

    #[test]
    fn the_store_is_in_the_state_directory_of_the_user_or_the_system() {
        let with = |pairs: &'static [(&str, &str)]| {
            default_root(move |name| {
                pairs
                    .iter()
                    .find(|(key, _)| *key == name)
                    .map(|(_, value)| (*value).to_owned())
            })
        };
        assert_eq!(
            with(&[("XDG_STATE_HOME", "/s"), ("HOME", "/h")]),
            Path::new("/s/ua-bridge/pki")
        );
        assert_eq!(
            with(&[("HOME", "/h")]),
            Path::new("/h/.local/state/ua-bridge/pki")
        );
        assert_eq!(with(&[]), Path::new("/var/lib/ua-bridge/pki"));
        assert_eq!(
            with(&[("STATE_DIRECTORY", "/var/lib/x"), ("HOME", "/h")]),
            Path::new("/var/lib/x/pki")
        );
    }
}
