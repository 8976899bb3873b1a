//! The Global Discovery Server of a plant (OPC 10000-12, 6 and 7): a register of its applications
//! in all subnets, and a small authority that issues their certificates.
//!
//! Reading order: `records` (the applications in a file), `store` (the authority in its folder),
//! `kept` (lists that the server and the command line share), `invitations` and `requests`,
//! `applicants`, `service` (permissions and shared state), `hosts` (the hosts of a certificate),
//! `directory` and `manager` (the methods), `serve` (the server), `ca` and `people` (the commands).

mod applicants;
mod ca;
mod directory;
mod hosts;
mod invitations;
mod kept;
mod manager;
mod people;
mod records;
mod requests;
mod serve;
mod service;
mod store;

use std::ffi::OsString;
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::Duration;

use ::service::{Failure, FailureKind, LogArguments, LogFormat, ServiceProgram, run_service};
use discovery::MdnsInterface;
use plant_opcua::pki::default_root;
use plant_opcua::server::EndpointUrl;

use crate::ca::CaVerb;
use crate::people::PeopleVerb;
use crate::serve::{GdsSettings, serve};

/// The Global Discovery Server of a plant: registers its applications, and issues and revokes their certificates.
///
/// A program gets its first certificate with an invitation (`ua-gds invite`), or once an
/// administrator has approved its request (`ua-gds requests`, `ua-gds approve`). Otherwise a user
/// with the role security_admin, or the application itself with a trusted certificate, registers it
/// or requests its certificate over an encrypted channel. Every client may list the registered
/// applications. Users and trusted certificates are in the certificate store (`ua-server user` and
/// `ua-server trust` with its --pki).
#[derive(Debug, clap::Parser)]
#[command(name = "ua-gds", version = plant_opcua::patches::version(), args_conflicts_with_subcommands = true)]
struct UaGds {
    #[command(subcommand)]
    verb: Option<Verb>,
    /// The endpoint URL for clients
    #[arg(
        long,
        value_name = "URL",
        env = "UA_GDS_ENDPOINT",
        default_value = "opc.tcp://127.0.0.1:4841"
    )]
    endpoint: EndpointUrl,
    #[command(flatten)]
    folders: Folders,
    /// Validity of issued certificates in days
    #[arg(long, value_name = "DAYS", default_value = "365", value_parser = clap::value_parser!(u32).range(1..=36_500))]
    days: u32,
    /// The local discovery server to register at; `embed` for the discovery server of this host at
    /// port 4840, or `embed=URL`: the program itself is the discovery server while no other runs
    /// there
    #[arg(long, value_name = "URL|embed", env = "UA_LDS")]
    lds: Option<String>,
    /// The network interface for mDNS announcements, by name or address
    #[arg(long, value_name = "NAME|ADDRESS", env = "UA_INTERFACE")]
    interface: Option<String>,
    #[command(flatten)]
    log: LogArguments,
}

#[derive(Debug, clap::Subcommand)]
enum Verb {
    /// Manage the authority: make it; issue, revoke and list certificates
    #[command(subcommand)]
    Ca(CaVerb),
    /// Invite a program into the plant, and list, approve and reject requests for certificates
    #[command(flatten)]
    People(PeopleVerb),
}

#[derive(Debug, clap::Args)]
struct Folders {
    /// The certificate store of the server, with its users
    #[arg(long, value_name = "DIR", env = "UA_GDS_PKI")]
    pki: Option<PathBuf>,
    /// The folder of the authority, its key and the register [default: authority in the store]
    #[arg(long, value_name = "DIR", env = "UA_GDS_AUTHORITY")]
    authority: Option<PathBuf>,
}

impl Folders {
    fn pki(&self) -> PathBuf {
        let usual = || default_root(|name| std::env::var(name).ok()).with_file_name("gds-pki");
        self.pki.clone().unwrap_or_else(usual)
    }

    fn authority(&self) -> PathBuf {
        let usual = || self.pki().join("authority");
        self.authority.clone().unwrap_or_else(usual)
    }
}

/// Runs `ua-gds` from its command line to its end. `arguments` begin with the name of the program.
#[must_use]
pub fn run(arguments: Vec<OsString>) -> ExitCode {
    run_service::<UaGds>(arguments)
}

impl ServiceProgram for UaGds {
    const QUIET: &'static str = plant_opcua::QUIET;

    fn log(&self) -> LogFormat {
        self.log.format
    }

    async fn serve(self, stop: impl Future<Output = ()> + Send + 'static) -> Result<(), Failure> {
        if let Some(verb) = self.verb {
            let done = tokio::task::spawn_blocking(|| match verb {
                Verb::Ca(verb) => ca::run(verb),
                Verb::People(verb) => people::run(verb),
            });
            let done = done.await;
            return done
                .unwrap_or_else(|error| Err(Failure::new(FailureKind::Io, error.to_string())));
        }
        let settings = GdsSettings {
            pki: self.folders.pki(),
            authority: self.folders.authority(),
            endpoint: self.endpoint,
            life: Duration::from_secs(u64::from(self.days) * 86_400),
            lds: self.lds,
            interface: self.interface.as_deref().map(MdnsInterface::parse),
        };
        serve(settings, stop).await
    }
}
