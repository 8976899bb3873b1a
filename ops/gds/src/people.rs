//! The commands of an administrator: `ua-gds invite|requests|approve|reject`. A running server
//! reads the lists at each request.

use std::io::{self, Write as _};
use std::path::PathBuf;
use std::time::Duration;

use opcua::crypto::random;
use plant_opcua::enrolment::Invitation;
use plant_opcua::own;
use plant_opcua::server::EndpointUrl;
use serde::Serialize;
use serde::de::DeserializeOwned;
use service::{Failure, FailureKind};

use crate::Folders;
use crate::ca::{io_fault, open, say};
use crate::invitations::{self, Invitations, RANDOM};
use crate::kept;
use crate::requests::{self, RequestState, SigningRequest, SigningRequests};
use crate::serve::ensure_own;
use crate::service::now;

#[derive(Debug, clap::Subcommand)]
pub(crate) enum PeopleVerb {
    /// Print an invitation for a program, to give to it as --gds: the URL of this server, the
    /// fingerprint of its certificate and a one-time token. With the token the program gets its
    /// certificate without an administrator
    Invite {
        /// The application that may use the invitation: its ApplicationUri or its name
        #[arg(value_name = "APPLICATION")]
        application: Option<String>,
        /// Validity in hours
        #[arg(long, value_name = "HOURS", default_value = "24", value_parser = clap::value_parser!(u32).range(1..=8760))]
        hours: u32,
        /// The URL of this server for other programs
        #[arg(
            long,
            value_name = "URL",
            env = "UA_GDS_ENDPOINT",
            default_value = "opc.tcp://127.0.0.1:4841"
        )]
        endpoint: EndpointUrl,
        #[command(flatten)]
        folders: Folders,
    },
    /// List the certificate requests and the valid invitations
    Requests {
        /// Print a JSON line for each
        #[arg(long)]
        json: bool,
        #[command(flatten)]
        folders: Folders,
    },
    /// Approve a request: the program gets the certificate with its next request
    Approve {
        /// Its number in `requests`
        #[arg(value_name = "NUMBER")]
        number: u32,
        #[command(flatten)]
        folders: Folders,
    },
    /// Reject a request, or withdraw an invitation
    Reject {
        /// Its number in `requests`
        #[arg(value_name = "NUMBER")]
        number: String,
        #[command(flatten)]
        folders: Folders,
    },
}

/// Executes a command.
pub(crate) fn run(verb: PeopleVerb) -> Result<(), Failure> {
    match verb {
        PeopleVerb::Invite {
            application,
            hours,
            endpoint,
            folders,
        } => invite(&folders, application, (&endpoint, hours)),
        PeopleVerb::Requests { json, folders } => list(&folders, json),
        PeopleVerb::Approve { number, folders } => approve(&folders, number),
        PeopleVerb::Reject { number, folders } => reject(&folders, &number),
    }
}

fn invite(
    folders: &Folders,
    application: Option<String>,
    (endpoint, hours): (&EndpointUrl, u32),
) -> Result<(), Failure> {
    let (store, pki) = (open(folders)?, folders.pki());
    ensure_own(&store, &pki, endpoint, now())?;
    let fingerprint = own::read(&pki).map(|own| own.fingerprint());
    let random: Option<[u8; RANDOM]> = random::byte_string(RANDOM)
        .value
        .and_then(|bytes| bytes.try_into().ok());
    let random = random.ok_or_else(|| {
        Failure::new(
            FailureKind::Io,
            "the operating system provides no random bytes".to_owned(),
        )
    })?;
    let life = Duration::from_secs(u64::from(hours) * 3600);
    let token = change(folders, invitations::FILE, |all: &mut Invitations| {
        all.add(&random, application, (now(), life))
    })?;
    let url = match endpoint.to_string() {
        url if endpoint.advertised_host() == endpoint.host() => url,
        url => url.replacen(endpoint.host(), &endpoint.advertised_host(), 1),
    };
    let invitation = Invitation {
        url,
        fingerprint,
        token: Some(token),
    };
    say(&invitation.to_string())?;
    // The hint goes to stderr, because a script may read the invitation from stdout.
    let _nobody_reads = writeln!(
        io::stderr(),
        "give it to a program as --gds INVITATION, in the variable UA_GDS, or in a file as --gds @FILE; it \
         can be used once within {hours} h"
    );
    Ok(())
}

fn list(folders: &Folders, json: bool) -> Result<(), Failure> {
    let requests: SigningRequests = read(folders, requests::FILE)?;
    for one in requests.kept(now()) {
        say(&if json { as_json(one) } else { line(one) })?;
    }
    let invitations: Invitations = read(folders, invitations::FILE)?;
    for one in invitations.open(now()) {
        let until = own::day(Duration::from_secs(one.until));
        let application = one.application.as_deref();
        let used = one.used.as_ref().map(|used| used.uri.as_str());
        let text = if json {
            let json = serde_json::json!({
                "invitation": one.number,
                "application": application,
                "until": until,
                "used_by": used,
            });
            documents::harmless_json(&json.to_string())
        } else {
            format!(
                "invitation {} {} for {:?} until {until}",
                one.number,
                used.map_or_else(|| "open".to_owned(), |used| format!("used by {used:?}")),
                application.unwrap_or("any application"),
            )
        };
        say(&text)?;
    }
    Ok(())
}

fn approve(folders: &Folders, number: u32) -> Result<(), Failure> {
    let by = "the command line".to_owned();
    let decided = decide(folders, number, RequestState::Approved { by })?;
    let Some(one) = decided else {
        return Err(unknown(&number.to_string()));
    };
    say(&format!("approved: {}", line(&one)))
}

fn reject(folders: &Folders, number: &str) -> Result<(), Failure> {
    if let Ok(request) = number.parse::<u32>()
        && let Some(one) = decide(folders, request, RequestState::Refused)?
    {
        return say(&format!("rejected: {}", line(&one)));
    }
    let withdrawn = change(folders, invitations::FILE, |all: &mut Invitations| {
        all.withdraw(number)
    })?;
    if withdrawn {
        say(&format!("withdrawn: invitation {number}"))
    } else {
        Err(unknown(number))
    }
}

fn decide(
    folders: &Folders,
    number: u32,
    state: RequestState,
) -> Result<Option<SigningRequest>, Failure> {
    change(folders, requests::FILE, |all: &mut SigningRequests| {
        all.decide(number, state, now()).cloned()
    })
}

fn unknown(number: &str) -> Failure {
    let message =
        format!("no open request or invitation has the number {number:?} (`ua-gds requests`)");
    Failure::new(FailureKind::Usage, message)
}

/// Returns a line about a request for the operator. Texts of its owner are escaped.
fn line(one: &SigningRequest) -> String {
    let request = one.request();
    let request = request.as_ref();
    let name = request.map(|request| request.name()).unwrap_or_default();
    let hosts = request.map(|request| request.hosts().to_vec());
    format!(
        "{} {} {:?} {name:?} hosts {:?} key {}",
        one.number,
        state(one),
        one.uri,
        hosts.unwrap_or_default(),
        one.key
    )
}

fn as_json(one: &SigningRequest) -> String {
    let request = one.request();
    let json = serde_json::json!({
        "request": one.number,
        "state": state(one),
        "application_uri": one.uri,
        "name": request.as_ref().map(|request| request.name()),
        "hosts": request.as_ref().map(|request| request.hosts().to_vec()),
        "key": one.key,
    });
    documents::harmless_json(&json.to_string())
}

const fn state(one: &SigningRequest) -> &'static str {
    match one.state {
        RequestState::Waiting => "waits",
        RequestState::Approved { .. } => "approved",
        RequestState::Refused => "rejected",
        RequestState::Issued { .. } => "issued",
    }
}

fn path(folders: &Folders, file: &str) -> Result<PathBuf, Failure> {
    // A missing folder of an authority is not created.
    open(folders)?;
    Ok(folders.authority().join(file))
}

fn read<T: DeserializeOwned + Default>(folders: &Folders, file: &str) -> Result<T, Failure> {
    let path = path(folders, file)?;
    kept::read(&path).map_err(|error| io_fault(&path, &error))
}

fn change<T, R>(folders: &Folders, file: &str, with: impl FnOnce(&mut T) -> R) -> Result<R, Failure>
where
    T: Serialize + DeserializeOwned + Default + Clone + PartialEq,
{
    let path = path(folders, file)?;
    kept::change(&path, with).map_err(|error| io_fault(&path, &error))
}
