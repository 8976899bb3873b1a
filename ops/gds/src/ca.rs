//! The commands of the authority: `ua-gds ca init|issue|revoke|list`.

use std::fs;
use std::io::{self, Write as _};
use std::path::{Path, PathBuf};
use std::time::Duration;

use plant_opcua::own::day;
use service::{Failure, FailureKind};
use trust::{Certificate, CertificateSigningRequest, Serial};

use crate::Folders;
use crate::serve::of_store;
use crate::service::now;
use crate::store::{AuthorityStore, Issued, new_key, pem_of, write_key};

#[derive(Debug, clap::Subcommand)]
pub(crate) enum CaVerb {
    /// Make the authority of a plant: its key and its certificate, which all programs have to trust
    Init {
        /// The common name in the certificate
        #[arg(long, value_name = "NAME", default_value = "Plant authority")]
        name: String,
        /// The organization in the certificate
        #[arg(long, value_name = "NAME", default_value = "")]
        organization: String,
        /// Validity in days
        #[arg(long, value_name = "DAYS", default_value = "3650", value_parser = clap::value_parser!(u32).range(1..=36_500))]
        days: u32,
        #[command(flatten)]
        folders: Folders,
    },
    /// Issue a certificate for a signing request in DER or PEM, or without a request for a new key
    Issue {
        /// The signing request
        #[arg(value_name = "REQUEST", required_unless_present = "application_uri", conflicts_with_all = ["application_uri", "host", "name"])]
        request: Option<PathBuf>,
        /// The ApplicationUri of an application that gets a new key
        #[arg(long, value_name = "URI", requires = "key")]
        application_uri: Option<String>,
        /// The common name in the certificate
        #[arg(long, value_name = "NAME", default_value = "")]
        name: String,
        /// A host of the application; may be repeated
        #[arg(long, value_name = "HOST")]
        host: Vec<String>,
        /// File for the key, as PEM
        #[arg(long, value_name = "FILE")]
        key: Option<PathBuf>,
        /// File for the certificate: DER, or PEM for a name that ends with .pem
        #[arg(long, value_name = "FILE")]
        out: PathBuf,
        /// Validity in days
        #[arg(long, value_name = "DAYS", default_value = "365", value_parser = clap::value_parser!(u32).range(1..=36_500))]
        days: u32,
        #[command(flatten)]
        folders: Folders,
    },
    /// Revoke an issued certificate. The running ua-gds applies it at once, other programs when
    /// they receive the new list
    Revoke {
        /// Its number in `list`, or its file
        #[arg(value_name = "SERIAL|FILE")]
        which: String,
        #[command(flatten)]
        folders: Folders,
    },
    /// List the issued and revoked certificates
    List {
        /// Print a JSON line for each
        #[arg(long)]
        json: bool,
        #[command(flatten)]
        folders: Folders,
    },
}

/// Executes a command.
pub(crate) fn run(verb: CaVerb) -> Result<(), Failure> {
    match verb {
        CaVerb::Init {
            name,
            organization,
            days,
            folders,
        } => {
            let folder = folders.authority();
            let made = AuthorityStore::init(&folder, (&name, &organization), now(), of_days(days));
            let store = made.map_err(|fault| of_store(&fault))?;
            say(&format!(
                "made: {:?}, valid until {}",
                store.certificate().name(),
                day(store.certificate().validity().1)
            ))?;
            say(&format!(
                "servers and clients must trust: {} with the list {}",
                store.certificate_path().display(),
                store.list_path().display()
            ))
        }
        CaVerb::Issue {
            request,
            application_uri,
            name,
            host,
            key,
            out,
            days,
            folders,
        } => {
            let store = open(&folders)?;
            let wanted = match (&request, &application_uri) {
                (Some(file), _) => read_request(file)?,
                (None, uri) => {
                    let uri = uri.as_deref().unwrap_or_default();
                    with_key(uri, &name, &host, key.as_deref())?
                }
            };
            let issued = store.issue(&wanted, now(), of_days(days));
            let issued = issued.map_err(|fault| of_store(&fault))?;
            write(&out, &issued)?;
            say(&line(&Issued {
                certificate: issued,
                revoked: None,
            }))
        }
        CaVerb::Revoke { which, folders } => {
            let store = open(&folders)?;
            let serial = serial(&which)?;
            store
                .revoke(&serial, now())
                .map_err(|fault| of_store(&fault))?;
            say(&format!("revoked: {serial}"))?;
            say(&format!(
                "the new list, for programs that do not fetch it: {}",
                store.list_path().display()
            ))
        }
        CaVerb::List { json, folders } => {
            let all = open(&folders)?.list().map_err(|fault| of_store(&fault))?;
            for one in &all {
                say(&if json { as_json(one) } else { line(one) })?;
            }
            Ok(())
        }
    }
}

pub(crate) fn open(folders: &Folders) -> Result<AuthorityStore, Failure> {
    AuthorityStore::open(&folders.authority()).map_err(|fault| of_store(&fault))
}

fn read_request(file: &Path) -> Result<CertificateSigningRequest, Failure> {
    let bytes = read(file)?;
    CertificateSigningRequest::read(&bytes).map_err(|why| {
        let message = format!("{} is not a signing request: {why}", file.display());
        Failure::new(FailureKind::Usage, message)
    })
}

fn read(file: &Path) -> Result<Vec<u8>, Failure> {
    documents::read_bounded(file, LARGEST).map_err(|why| {
        let message = format!("{}: {why}", file.display());
        Failure::new(FailureKind::Io, message)
    })
}

/// Size limit of a certificate or signing request, in bytes.
const LARGEST: u64 = 64 << 10;

fn with_key(
    uri: &str,
    name: &str,
    hosts: &[String],
    file: Option<&Path>,
) -> Result<CertificateSigningRequest, Failure> {
    let usage = |why: String| Failure::new(FailureKind::Usage, why);
    let Some(file) = file else {
        return Err(usage("--key FILE: give the file for the key".to_owned()));
    };
    let key = new_key(KEY_BITS).map_err(|fault| of_store(&fault))?;
    let name = if name.is_empty() { uri } else { name };
    let name: String = name.chars().take(LONGEST_NAME).collect();
    let wanted = CertificateSigningRequest::make(&key, uri, (&name, ""), hosts);
    let wanted =
        wanted.map_err(|why| usage(format!("cannot issue a certificate for {uri:?}: {why}")))?;
    let pem = pem_of(&key).map_err(|fault| of_store(&fault))?;
    write_key(file, &pem).map_err(|error| io_fault(file, &error))?;
    Ok(wanted)
}

fn serial(which: &str) -> Result<Serial, Failure> {
    let file = Path::new(which);
    if file.is_file() {
        let read = Certificate::read(&read(file)?);
        return read.map(|one| one.serial()).map_err(|why| {
            Failure::new(
                FailureKind::Usage,
                format!("{which} is not a certificate: {why}"),
            )
        });
    }
    Serial::parse(which).ok_or_else(|| {
        let message = format!("`{which}` is neither a number of `ua-gds ca list` nor a file");
        Failure::new(FailureKind::Usage, message)
    })
}

fn write(file: &Path, issued: &Certificate) -> Result<(), Failure> {
    let is_pem = file.extension().is_some_and(|end| end == "pem");
    let written = if is_pem {
        fs::write(file, issued.pem())
    } else {
        fs::write(file, issued.der())
    };
    written.map_err(|error| io_fault(file, &error))
}

/// Returns a line about an issued certificate for the operator. Texts of its owner are escaped.
fn line(one: &Issued) -> String {
    let certificate = &one.certificate;
    let standing = match one.revoked {
        Some(since) => format!("REVOKED since {}", day(since)),
        None if !certificate.is_valid_at(now()) => "NOT VALID".to_owned(),
        None => "valid".to_owned(),
    };
    format!(
        "{} until {} {standing} {:?} {:?}",
        certificate.serial(),
        day(certificate.validity().1),
        certificate.name(),
        certificate.application_uri().unwrap_or_default()
    )
}

fn as_json(one: &Issued) -> String {
    let certificate = &one.certificate;
    let json = serde_json::json!({
        "serial": certificate.serial().to_string(),
        "name": certificate.name(),
        "application_uri": certificate.application_uri(),
        "hosts": certificate.hosts(),
        "until": day(certificate.validity().1),
        "revoked": one.revoked.map(day),
    });
    documents::harmless_json(&json.to_string())
}

fn of_days(days: u32) -> Duration {
    Duration::from_secs(u64::from(days) * 86_400)
}

pub(crate) fn io_fault(file: &Path, error: &io::Error) -> Failure {
    Failure::new(FailureKind::Io, format!("{}: {error}", file.display()))
}

pub(crate) fn say(text: &str) -> Result<(), Failure> {
    writeln!(io::stdout(), "{text}")
        .map_err(|error| Failure::new(FailureKind::Io, error.to_string()))
}

const KEY_BITS: u32 = 2048;
/// Largest length of a common name, in characters.
const LONGEST_NAME: usize = 64;
