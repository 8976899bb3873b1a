//! The Local Discovery Server of a host: the program `ua-lds` around [`lds`].

use std::ffi::OsString;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::Duration;

use plant_opcua::enrolment::GdsArguments;
use plant_opcua::pki::default_named;
use service::{
    Failure, FailureKind, LogArguments, LogFormat, ServiceProgram, run_service, serve_pages,
};

use crate::lds::{self, LdsSettings};
use crate::listing::ListingArguments;
use crate::{DEFAULT_LDS, NetworkArguments};

/// A Local Discovery Server with multicast extension: lists the OPC UA servers of the network.
///
/// Servers register with it (RegisterServer, RegisterServer2) and are announced on the network by
/// mDNS; clients query it (FindServers, FindServersOnNetwork, GetEndpoints). It has no sessions. A
/// server that no longer responds is removed within two seconds.
#[derive(Debug, clap::Parser)]
#[command(name = "ua-lds", version = plant_opcua::patches::version())]
struct UaLds {
    /// The endpoint URL for servers and clients
    #[arg(long, value_name = "URL", env = "UA_LDS_ENDPOINT", default_value = DEFAULT_LDS)]
    endpoint: String,
    /// The network interface of mDNS, by name or address. Default: only this host
    #[arg(long, value_name = "NAME|ADDRESS", env = "UA_INTERFACE")]
    interface: Option<String>,
    #[command(flatten)]
    networks: NetworkArguments,
    /// Allow servers of other hosts to register over unsecured channels. Default: only servers of
    /// this host may, over a loopback address
    #[arg(long)]
    allow_unsecured: bool,
    /// Accept registrations over secured channels only, also from this host
    #[arg(long, requires = "pki", conflicts_with = "allow_unsecured")]
    secured_only: bool,
    /// Expected registration period of servers, in seconds. A registration without semaphore file
    /// is valid for two periods
    #[arg(long, value_name = "SECONDS", default_value = "600", value_parser = clap::value_parser!(u32).range(1..=86_400))]
    register_period: u32,
    /// The certificate store, for secured channels (Basic256Sha256): own, private and trusted in
    /// one directory. Default: unsecured channels only
    #[arg(long, value_name = "DIR", env = "UA_LDS_PKI")]
    pki: Option<PathBuf>,
    #[command(flatten)]
    gds: GdsArguments,
    #[command(flatten)]
    listing: ListingArguments,
    /// Trust every client certificate. For tests and demonstrations only
    #[arg(long, requires = "pki")]
    trust_any_client_certificate: bool,
    /// Serve the status at this address: /status as JSON, /metrics for Prometheus, and /readyz for
    /// readiness
    #[arg(long, value_name = "ADDRESS:PORT", env = "UA_METRICS")]
    metrics: Option<SocketAddr>,
    #[command(flatten)]
    log: LogArguments,
}

/// Runs `ua-lds` with the command line `arguments`, which begin with the name of the program.
#[must_use]
pub fn run(arguments: Vec<OsString>) -> ExitCode {
    run_service::<UaLds>(arguments)
}

impl ServiceProgram for UaLds {
    // The libraries log faults of clients at level error.
    const QUIET: &'static str = "opcua_core=off,opcua_crypto=off,opcua_types=off,mdns_sd=off";

    fn log(&self) -> LogFormat {
        self.log.format
    }

    async fn serve(self, stop: impl Future<Output = ()> + Send + 'static) -> Result<(), Failure> {
        let pages = serve_pages(self.metrics).await?;
        let gds = self.gds.invitation();
        let gds = gds.map_err(|fault| Failure::new(FailureKind::Usage, fault.to_string()))?;
        // A certificate of the plant requires a store.
        let usual = || gds.as_ref().map(|_| default_named("pki-ua-lds"));
        let settings = LdsSettings {
            interface: self.networks.interface(self.interface.as_deref()),
            allow_unsecured: self.allow_unsecured,
            secured_only: self.secured_only,
            register_every: Duration::from_secs(self.register_period.into()),
            pki: self.pki.or_else(usual),
            listing: self.listing.query(gds.as_ref()),
            gds,
            trust_any: self.trust_any_client_certificate,
            ..LdsSettings::at(self.endpoint)
        };
        lds::run(settings, pages, stop).await
    }
}
