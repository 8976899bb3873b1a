//! The program `ua-station` around [`crate::run`].

use std::ffi::OsString;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::Duration;

use discovery::lds::LdsSettings;
use discovery::{DEFAULT_LDS, ListingArguments, MdnsInterface};
use plant_opcua::client::HostNames;
use plant_opcua::enrolment::GdsArguments;
use plant_opcua::limits::LimitArguments;
use plant_opcua::pki::default_named;
use plant_opcua::server::EndpointUrl;
use plant_opcua::users::{Roles, UserRole};
use registry::hierarchy::{PlantLocation, ServerChoice};
use service::{
    Failure, FailureKind, LogArguments, LogFormat, ServiceProgram, run_service, serve_pages,
};

use crate::{StationSettings, Upper};

/// One level of a plant: the discovery server of a workstation and its devices, or of a whole cell.
///
/// Servers of the level below register here as at ua-lds, receive their location (the station calls
/// their method `Configure`), and are hidden from the level above: there the station shows their
/// methods as its own, below Devices, and forwards calls. It shows the methods of its neighbours
/// above to the devices, below Neighbours. Without --upper-interface it is the top level and shows
/// no methods.
#[derive(Debug, clap::Parser)]
#[command(name = "ua-station", version = plant_opcua::patches::version())]
struct UaStation {
    /// The name of the station on the level above
    #[arg(long, value_name = "NAME", env = "UA_STATION")]
    name: String,
    /// The location of the level in the plant, such as plant/cell-1; the level above may change it
    #[arg(long, value_name = "PLACE", env = "UA_PLACE")]
    place: Option<PlantLocation>,
    /// The endpoint URL for servers and clients of the level below
    #[arg(long, value_name = "URL", env = "UA_LDS_ENDPOINT", default_value = DEFAULT_LDS)]
    endpoint: String,
    /// The network interface of the level below, by name or address. Default: only this host
    #[arg(long, value_name = "NAME|ADDRESS", env = "UA_INTERFACE")]
    interface: Option<String>,
    /// Networks behind routers with servers that are also accepted, such as 10.77.0.0/16. Default:
    /// only servers with addresses in the subnets of the interface, because any host can announce
    /// any address
    #[arg(
        long = "network",
        value_name = "CIDR",
        env = "UA_NETWORKS",
        value_delimiter = ','
    )]
    networks: Vec<discovery::scan::Range>,
    /// The endpoint URL for calls of devices to methods of neighbours. Default: a free port of the
    /// interface
    #[arg(long, value_name = "URL")]
    devices_endpoint: Option<EndpointUrl>,
    /// The network interface of the level above, by name or address
    #[arg(long, value_name = "NAME|ADDRESS", env = "UA_UPPER_INTERFACE")]
    upper_interface: Option<String>,
    /// The endpoint URL for calls from above to methods of devices. Default: a free port of the
    /// upper interface
    #[arg(long, value_name = "URL", requires = "upper_interface")]
    upper_endpoint: Option<EndpointUrl>,
    /// The discovery server above: an opc.tcp:// URL, `any` (the only one found),
    /// uri=<ApplicationUri>, name=<mDNS name> (both may end with *), or node=<NodeId> for the
    /// server with this node, such as node=nsu=urn:cell;s=Marker
    #[arg(
        long,
        value_name = "CHOICE",
        default_value = "any",
        env = "UA_UPPER_LDS"
    )]
    upper_lds: ServerChoice,
    /// Also serve and use unsecured channels. Without --pki all channels are unsecured, and servers
    /// of other hosts need this option to register
    #[arg(long)]
    allow_unsecured: bool,
    /// Expected registration period of servers, in seconds. A registration without semaphore file
    /// is valid for two periods
    #[arg(long, value_name = "SECONDS", default_value = "600", value_parser = clap::value_parser!(u32).range(1..=86_400))]
    register_period: u32,
    /// The certificate store, for secured channels (Basic256Sha256): own, private, trusted and rejected under one directory
    #[arg(long, value_name = "DIR", env = "UA_PKI")]
    pki: Option<PathBuf>,
    #[command(flatten)]
    gds: GdsArguments,
    #[command(flatten)]
    listing: ListingArguments,
    /// Trust every certificate. For tests and demonstrations only
    #[arg(long, requires = "pki")]
    trust_any_certificate: bool,
    /// The roles of anonymous callers: observer, operator, engineer, separated by commas. Calls of
    /// operators and engineers are forwarded, and calls of servers of the level, which are
    /// identified by their certificates. Users are in `users` of --pki (`ua-server user add`).
    /// Default: observer, or operator if channels are unsecured
    #[arg(long, value_name = "ROLES", env = "UA_ANONYMOUS")]
    anonymous: Option<Roles>,
    /// Refuse servers whose trusted certificates do not include the host of the URL, as after a new
    /// DHCP lease. Default: the station connects to them and logs a warning
    #[arg(long)]
    refuse_other_hosts: bool,
    #[command(flatten)]
    limits: LimitArguments,
    /// Serve the status at this address: /status as JSON, /metrics for Prometheus, and /readyz
    #[arg(long, value_name = "ADDRESS:PORT", env = "UA_METRICS")]
    metrics: Option<SocketAddr>,
    #[command(flatten)]
    log: LogArguments,
}

/// Runs `ua-station` with the command line `arguments`, which start with the name of the program,
/// until it ends.
#[must_use]
pub fn run(arguments: Vec<OsString>) -> ExitCode {
    run_service::<UaStation>(arguments)
}

impl ServiceProgram for UaStation {
    const QUIET: &'static str = "opcua_server=warn,opcua_server::session::controller=off,opcua_client=off,\
        opcua_core=off,opcua_crypto=off,opcua_nodes=warn,opcua_types=off,mdns_sd=off";

    fn log(&self) -> LogFormat {
        self.log.format
    }

    async fn serve(self, stop: impl Future<Output = ()> + Send + 'static) -> Result<(), Failure> {
        let pages = serve_pages(self.metrics).await?;
        let interface = self.interface.as_deref().map(MdnsInterface::parse);
        let gds = self.gds.invitation();
        let gds = gds.map_err(|fault| Failure::new(FailureKind::Usage, fault.to_string()))?;
        // A certificate of the plant needs a store.
        let usual = || {
            gds.as_ref()
                .map(|_| default_named(&format!("pki-ua-station-{}", self.name)))
        };
        let lds = LdsSettings {
            interface: interface
                .unwrap_or(MdnsInterface::LOOPBACK)
                .with_networks(self.networks.iter().copied()),
            allow_unsecured: self.allow_unsecured,
            register_every: Duration::from_secs(self.register_period.into()),
            pki: self.pki.or_else(usual),
            listing: self.listing.query(gds.as_ref()),
            trust_any: self.trust_any_certificate,
            ..LdsSettings::at(self.endpoint)
        };
        let upper = self.upper_interface.as_deref().map(|interface| Upper {
            interface: MdnsInterface::parse(interface).with_networks(self.networks.iter().copied()),
            endpoint: self.upper_endpoint,
            discovery: self.upper_lds,
        });
        let is_open = self.allow_unsecured || lds.pki.is_none();
        let usual = if is_open {
            Roles::of(&[UserRole::Observer, UserRole::Operator])
        } else {
            Roles::of(&[UserRole::Observer])
        };
        let settings = StationSettings {
            anonymous: self.anonymous.unwrap_or(usual),
            host_names: if self.refuse_other_hosts {
                HostNames::Refuse
            } else {
                HostNames::Warn
            },
            gds,
            name: self.name,
            place: self.place,
            lds,
            devices_endpoint: self.devices_endpoint,
            upper,
            clients: self.limits.limits(),
        };
        crate::run(settings, pages, stop).await
    }
}
