//! The commands for certificates and users: `ua-server trust`, `reject`, `certificates`, `renew`
//! and `user`.
//!
//! A running server applies the changes by itself: certificates at each connection, and users
//! within a second.

use std::ffi::OsString;
use std::io::{self, BufRead as _, IsTerminal as _, Write as _};
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use bridge_node::FailureKind;
use clap::Parser as _;
use clap::error::ErrorKind;
use plant_opcua::certificates::{self, Standing, StoreFault, Stored};
use plant_opcua::known;
use plant_opcua::pki::{self, Pki, PkiError};
use plant_opcua::users::{self, Credential, Roles, StoredUser, UserFault, Users};

/// Certificates and users of the OPC UA server of the cell.
#[derive(Debug, clap::Parser)]
#[command(name = "ua-server")]
struct Verbs {
    #[command(subcommand)]
    verb: Verb,
}

#[derive(Debug, clap::Subcommand)]
enum Verb {
    /// Trust the certificate of a client: a refused certificate, or a file. With the certificate of
    /// an authority, all certificates that it has issued and not revoked; its revocation list is
    /// added in the same way
    Trust {
        /// The first digits of its thumbprint, as the log of the server has them, or a file in DER or PEM
        #[arg(value_name = "THUMBPRINT|FILE")]
        which: String,
        /// The file is of an authority that others are checked with, and that is not trusted for itself
        #[arg(long)]
        issuer: bool,
        #[command(flatten)]
        store: Store,
    },
    /// Remove the trust in a certificate: its holder is refused at the next connection
    Reject {
        /// The first digits of its thumbprint
        #[arg(value_name = "THUMBPRINT")]
        which: String,
        #[command(flatten)]
        store: Store,
    },
    /// List the server's own certificate, the trusted certificates, and the refused certificates of
    /// clients
    Certificates {
        /// A JSON line for each
        #[arg(long)]
        json: bool,
        #[command(flatten)]
        store: Store,
    },
    /// Make a self-made certificate anew, for the same key, ApplicationUri and hosts. Works on the store of any program of
    /// the plant (--pki), which shows it when it is started again
    Renew {
        /// Put a self-made certificate in the place of one of an authority
        #[arg(long)]
        self_made: bool,
        #[command(flatten)]
        store: Store,
    },
    /// Make, change, list and remove users
    #[command(subcommand)]
    User(UserVerb),
}

#[derive(Debug, clap::Subcommand)]
enum UserVerb {
    /// Make a user, or put another in the place of one of that name. The password is read from stdin
    Add {
        name: String,
        /// The roles of the user: observer, operator, engineer, security_admin, configure_admin;
        /// several with commas between them
        #[arg(long, value_name = "ROLES")]
        role: Roles,
        /// The user shows this certificate (DER or PEM, as .der or .pem) in place of a password
        #[arg(long, value_name = "FILE")]
        certificate: Option<PathBuf>,
        #[command(flatten)]
        store: Store,
    },
    /// Give a user another password, which is read from stdin
    Password {
        name: String,
        #[command(flatten)]
        store: Store,
    },
    /// Give a user other roles
    Role {
        name: String,
        roles: Roles,
        #[command(flatten)]
        store: Store,
    },
    /// Remove a user: its open sessions may do nothing more
    Remove {
        name: String,
        #[command(flatten)]
        store: Store,
    },
    /// List the users
    List {
        /// A JSON line for each
        #[arg(long)]
        json: bool,
        #[command(flatten)]
        store: Store,
    },
}

#[derive(Debug, clap::Args)]
struct Store {
    /// The certificate store of the server
    #[arg(long, value_name = "DIR", env = "UA_PKI")]
    pki: Option<PathBuf>,
}

impl Store {
    fn root(&self) -> PathBuf {
        let usual = || pki::default_root(|name| std::env::var(name).ok());
        self.pki.clone().unwrap_or_else(usual)
    }

    fn users(&self) -> PathBuf {
        self.root().join(users::FOLDER)
    }
}

/// The reason why a command failed.
#[derive(Debug, thiserror::Error)]
enum VerbFault {
    #[error(transparent)]
    Store(#[from] StoreFault),
    #[error(transparent)]
    Pki(#[from] PkiError),
    #[error(transparent)]
    User(#[from] UserFault),
    #[error("the password cannot be read: {0}")]
    Password(io::Error),
    #[error("there is no password: give it on stdin, as one line")]
    NoPassword,
    #[error("{0}")]
    Output(io::Error),
}

/// Executes a command for certificates and users. Returns `None` if the command line starts the
/// server.
pub(crate) fn asked(arguments: &[OsString]) -> Option<ExitCode> {
    let first = arguments.get(1)?;
    if !VERBS.iter().any(|verb| first == verb) {
        return None;
    }
    let verbs = match Verbs::try_parse_from(arguments) {
        Ok(verbs) => verbs,
        Err(usage) => {
            // Output errors are ignored, because stdout or stderr may be closed.
            let _printed = usage.print();
            let help = matches!(usage.kind(), ErrorKind::DisplayHelp);
            return Some(if help {
                ExitCode::SUCCESS
            } else {
                FailureKind::Usage.into()
            });
        }
    };
    Some(match run(verbs.verb) {
        Ok(()) => ExitCode::SUCCESS,
        Err(fault) => {
            let _told = writeln!(io::stderr(), "error: {fault}");
            kind(&fault).into()
        }
    })
}

fn kind(fault: &VerbFault) -> FailureKind {
    match fault {
        VerbFault::Store(StoreFault::Io { .. })
        | VerbFault::Pki(PkiError::Directory { .. } | PkiError::Make(_))
        | VerbFault::User(UserFault::Io { .. })
        | VerbFault::Password(_)
        | VerbFault::Output(_) => FailureKind::Io,
        VerbFault::User(UserFault::Open(_) | UserFault::Line { .. } | UserFault::TooMany(_)) => {
            FailureKind::Configuration
        }
        VerbFault::Pki(
            PkiError::Half { .. }
            | PkiError::Unreadable(_)
            | PkiError::None(_)
            | PkiError::Issued(_),
        )
        | VerbFault::Store(
            StoreFault::Certificate { .. }
            | StoreFault::Useless { .. }
            | StoreFault::Unknown { .. }
            | StoreFault::Several(_),
        )
        | VerbFault::User(
            UserFault::Name
            | UserFault::Unknown(_)
            | UserFault::NoRole
            | UserFault::Role(_)
            | UserFault::Password
            | UserFault::Certificate { .. },
        )
        | VerbFault::NoPassword => FailureKind::Usage,
    }
}

fn run(verb: Verb) -> Result<(), VerbFault> {
    match verb {
        Verb::Trust {
            which,
            issuer,
            store,
        } => trust(&store.root(), &which, issuer),
        Verb::Reject { which, store } => {
            let rejected = certificates::reject(&store.root(), &which)?;
            say(&format!("no longer trusted: {}", line(&rejected)))
        }
        Verb::Certificates { json, store } => {
            for one in certificates::list(&store.root())? {
                say(&if json { as_json(&one) } else { line(&one) })?;
            }
            Ok(())
        }
        Verb::Renew { self_made, store } => renew(&store.root(), self_made),
        Verb::User(verb) => user(verb),
    }
}

fn trust(root: &Path, which: &str, issuer: bool) -> Result<(), VerbFault> {
    let file = Path::new(which);
    if known::is_crl(file) {
        let kept = known::keep_crl(root, file)?;
        return say(&format!("revocation list taken up: {}", kept.display()));
    }
    if issuer {
        let kept = certificates::keep_issuer(root, file)?;
        return say(&format!("known: {}", line(&kept)));
    }
    let is_first = !known::trusts_authorities(root);
    let trusted = certificates::trust(root, which)?;
    say(&format!("trusted: {}", line(&trusted)))?;
    if trusted.is_authority {
        say(
            "all that it issues are trusted, as long as its revocation list is here and up to date (`ua-server trust FILE.crl`)",
        )?;
        if is_first {
            say(
                "it is the first authority here: a server that runs takes notice of it when it is started again",
            )?;
        }
    }
    Ok(())
}

fn renew(root: &Path, self_made: bool) -> Result<(), VerbFault> {
    Pki::open(root.to_owned())?.renew(self_made)?;
    let all = certificates::list(root)?;
    for own in all.iter().filter(|one| one.standing == Standing::Own) {
        say(&format!("made anew: {}", line(own)))?;
    }
    say(
        "restart the program; applications that trust the previous certificate have to trust this one",
    )
}

fn user(verb: UserVerb) -> Result<(), VerbFault> {
    match verb {
        UserVerb::Add {
            name,
            role,
            certificate,
            store,
        } => {
            let folder = store.users();
            let mut users = Users::read(&folder)?;
            let credential = match certificate {
                Some(file) => Users::keep_certificate(&folder, &file)?,
                None => users::hashed(password(&name)?.as_bytes())?,
            };
            let user = StoredUser {
                roles: role,
                credential,
            };
            users.put(&name, user)?;
            users.write(&folder)?;
            say(&format!("{name} is {role}"))
        }
        UserVerb::Password { name, store } => {
            let folder = store.users();
            let mut users = Users::read(&folder)?;
            let Some(known) = users.get(&name).cloned() else {
                return Err(UserFault::Unknown(name).into());
            };
            let credential = users::hashed(password(&name)?.as_bytes())?;
            let user = StoredUser {
                credential,
                ..known
            };
            users.put(&name, user)?;
            users.write(&folder)?;
            say(&format!("{name} has another password"))
        }
        UserVerb::Role { name, roles, store } => {
            let folder = store.users();
            let mut users = Users::read(&folder)?;
            users.set_roles(&name, roles)?;
            users.write(&folder)?;
            say(&format!("{name} is {roles}"))
        }
        UserVerb::Remove { name, store } => {
            let folder = store.users();
            let mut users = Users::read(&folder)?;
            users.remove(&name)?;
            users.write(&folder)?;
            say(&format!("{name} is no user any longer"))
        }
        UserVerb::List { json, store } => {
            for (name, user) in Users::read(&store.users())?.iter() {
                let by = by(&user.credential);
                say(&if json {
                    let roles: Vec<String> =
                        user.roles.iter().map(|role| quoted(role.name())).collect();
                    format!(
                        "{{\"name\":{},\"roles\":[{}],\"by\":{}}}",
                        quoted(name),
                        roles.join(","),
                        quoted(by)
                    )
                } else {
                    format!("{name:<24} {:<32} {by}", user.roles.to_string())
                })?;
            }
            Ok(())
        }
    }
}

const fn by(credential: &Credential) -> &'static str {
    match credential {
        Credential::Password(_) => "password",
        Credential::Certificate(_) => "certificate",
    }
}

/// Reads a line of stdin, without its line ending.
fn password(name: &str) -> Result<String, VerbFault> {
    let stdin = io::stdin();
    if stdin.is_terminal() {
        let _told = write!(
            io::stderr(),
            "Password of {name} (it is shown; `ua-server user .. < FILE` takes it from a file): "
        );
    }
    let mut line = String::new();
    let read = stdin.lock().read_line(&mut line);
    read.map_err(VerbFault::Password)?;
    let password = line.trim_end_matches(['\n', '\r']);
    if password.is_empty() {
        Err(VerbFault::NoPassword)
    } else {
        Ok(password.to_owned())
    }
}

/// Returns a line about a certificate for the operator. Texts of the certificate's creator are
/// escaped.
fn line(one: &Stored) -> String {
    let now = if one.is_valid {
        "until"
    } else {
        "NOT VALID, until"
    };
    let authority = if one.is_authority { "authority " } else { "" };
    format!(
        "{:<8} {authority}{} {} {} {:?} {:?}",
        one.standing.name(),
        one.thumbprint,
        now,
        one.until,
        one.name,
        one.application_uri.as_deref().unwrap_or_default(),
    )
}

fn as_json(one: &Stored) -> String {
    let uri = one
        .application_uri
        .as_deref()
        .map_or_else(|| "null".to_owned(), quoted);
    format!(
        "{{\"standing\":{},\"thumbprint\":{},\"name\":{},\"application_uri\":{uri},\"until\":{},\"valid\":{},\"authority\":{},\"file\":{}}}",
        quoted(one.standing.name()),
        quoted(&one.thumbprint),
        quoted(&one.name),
        quoted(&one.until),
        one.is_valid,
        one.is_authority,
        quoted(&one.path.display().to_string()),
    )
}

/// Returns a JSON string.
fn quoted(text: &str) -> String {
    let mut out = String::from('"');
    for c in text.chars() {
        match c {
            '"' | '\\' => out.extend(['\\', c]),
            c if mappings::is_obeyed(c) => out.push_str(&format!("\\u{:04x}", u32::from(c))),
            c => out.push(c),
        }
    }
    out.push('"');
    out
}

fn say(text: &str) -> Result<(), VerbFault> {
    writeln!(io::stdout(), "{text}").map_err(VerbFault::Output)
}

/// The commands. Every other first argument is a mapping or an option of the server.
const VERBS: [&str; 5] = ["trust", "reject", "certificates", "renew", "user"];
/// The section of the server's help about these commands.
pub(crate) const HELP: &str = "Certificates and users (each with --help):
  ua-server trust THUMBPRINT|FILE        let a client in that was refused, or all that an authority has issued
  ua-server reject THUMBPRINT            let it in no longer
  ua-server certificates                 list its own, trusted and refused certificates
  ua-server renew                        make the self-made certificate anew
  ua-server user add|password|role|remove|list";
