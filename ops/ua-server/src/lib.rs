//! The OPC UA server of the cell, which shows the values of the space as nodes.
//!
//! It is one of the programs of origin 0, beside components, and owns the namespaces of its
//! mapping. Values of the other spaces and of components arrive by UADP and are read here. Values
//! that clients write to the variables of origin 0 are sent by UADP. The server has no ROS code.
//!
//! Modules in reading order:
//! - Nodes and values: `layout` (nodes of the mapping), `structures` (their DataTypes), `address`
//!   (nodes of the address space), `values` (current values), `staleness` (age of values),
//!   `history` (past values), `nodes` (the node manager), `browse` (the order of nodes), `budget`
//!   (memory limits of clients), `space` (received values), `nodesets` (nodes from files), `folders`
//!   (folders of dotted names), `properties` (units, ranges and texts of values), `value`
//!   (conversion between the two codecs).
//! - Calls and discovery: `components` and `presence` (servers in the network), `methods` and
//!   `argument_types` (calls of the space as Methods), `programs` (actions as Programs), `asking`
//!   (client requests for both).
//! - Other servers: `executing` (Methods of other servers as calls), `sources` (their nodes as
//!   values), `clients` (the sessions for both), `finding` (discovered servers with skills),
//!   `others` (all of these).
//! - The server itself: `port` (the interface to the shell), `endpoint` (endpoints and security),
//!   `changes` (notifications of reloads), `identity` (BuildInfo and limits), `confirm` and
//!   `arrivals` (confirmation of writes), `commanders` (sessions that wrote commands), `access`
//!   (permissions), `operations` (operators on the page), `auditing` (audit events), `alarms`
//!   (alarms and conditions), `sks` (keys of secured groups), `pubsub` (the PubSub configuration
//!   as nodes), `verbs` (commands for certificates and users).

mod access;
mod address;
mod alarms;
mod argument_types;
mod arrivals;
mod asking;
mod auditing;
mod browse;
mod budget;
mod changes;
mod clients;
mod commanders;
mod components;
mod confirm;
#[cfg(test)]
mod dice;
mod endpoint;
mod executing;
mod finding;
mod folders;
mod history;
mod identity;
mod layout;
mod leaving;
mod methods;
mod nodes;
mod nodesets;
mod operations;
mod others;
mod port;
mod presence;
mod programs;
mod properties;
mod pubsub;
mod redundant;
mod reverse;
mod sks;
mod sources;
mod space;
mod staleness;
mod structures;
mod value;
mod values;
mod verbs;

use std::ffi::OsString;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::{Arc, OnceLock};

use bridge_node::{
    Arguments, Context, Failure, FailureKind, KeyService, NodeSetReader, Observer, Owned, Program,
    RedundancyRank, SharedProgram, Site,
};
use discovery::scan::Range;
use discovery::{AnnounceSettings, MdnsInterface};
use mappings::{FindSkills, Mapping, SpaceId};
use plant_opcua::endpoint::EndpointUrl;
use plant_opcua::enrolment::GdsArguments;
use plant_opcua::pki::{self, Pki};
use supervisor::{CertificateFiles, Page, ProxyUrl, StatusUrl};

use crate::port::{ServerPort, Setup};
use crate::sks::{ServerKeys, Sks};
use crate::structures::MappedTypes;

/// The OPC UA server of the cell: every value of the space as a variable; clients write the values
/// of origin 0.
#[derive(Debug, clap::Parser)]
#[command(name = "ua-server", version = plant_opcua::patches::version(), after_help = verbs::HELP)]
struct UaServer {
    #[command(flatten)]
    arguments: Arguments,
    /// Where clients connect, as opc.tcp://127.0.0.1:4840; the mapping's endpoint without it
    #[arg(long, value_name = "URL", env = "UA_ENDPOINT")]
    endpoint: Option<EndpointUrl>,
    /// The certificate store: own, private, trusted and rejected under one directory
    #[arg(long, value_name = "DIR", env = "UA_PKI")]
    pki: Option<PathBuf>,
    /// Trust every client certificate, and keep it as trusted. For tests and demonstrations only
    #[arg(long)]
    trust_any_client_certificate: bool,
    /// Register with this Local Discovery Server, now or when it comes, as opc.tcp://127.0.0.1:4840; with --announce also one
    /// that is heard of, as `any` (the only one there), `uri=<ApplicationUri>` or `name=<mDNS name>` (both may end with *).
    /// `embed` is that of this host at port 4840, and `embed=URL` at another, which the program is itself while there is none
    #[arg(long, value_name = "URL|CHOICE|embed", env = "UA_LDS")]
    lds: Option<String>,
    /// Announce the server by mDNS on the network interface of --interface, and show the servers that are there; without
    /// an interface, to this host and of this host
    #[arg(long)]
    announce: bool,
    #[command(flatten)]
    gds: GdsArguments,
    /// Run as one of up to three redundant servers, whose ApplicationUris are in `server.redundant`
    /// of the mapping: all show the values, and a single one sends the values of clients and calls
    #[arg(long, value_name = "1|2|3", env = "UA_RANK", value_parser = bridge_node::rank)]
    rank: Option<RedundancyRank>,
    /// Show the program with this address of --metrics on the page, as http://127.0.0.1:9101. May
    /// be repeated
    #[arg(long, value_name = "URL")]
    status: Vec<StatusUrl>,
    /// Let browsers of other hosts reach the page through this reverse proxy, as
    /// https://cell.example.org: each user signs in
    #[arg(long, value_name = "URL")]
    page_proxy: Option<ProxyUrl>,
    /// Serve the page to browsers of other hosts at this address too, as 0.0.0.0:9443, by TLS with
    /// the certificate of the server: each user signs in
    #[arg(long, value_name = "IP:PORT")]
    page_tls: Option<SocketAddr>,
    /// Made when it is first wanted.
    #[arg(skip)]
    sks: OnceLock<Arc<Sks>>,
    /// Made when it is first wanted.
    #[arg(skip)]
    page: OnceLock<Arc<Page>>,
}

/// Runs `ua-server` from its command line to its end. `arguments` begin with the name of the
/// program.
#[must_use]
pub fn run(arguments: Vec<OsString>) -> ExitCode {
    match verbs::asked(&arguments) {
        Some(ended) => ended,
        None => bridge_node::run::<UaServer>(arguments),
    }
}

/// Returns `ua-server` for a process with several programs. `arguments` begin with the name of the
/// program.
///
/// # Errors
/// The exit code if the arguments are invalid or ask for help; the message was printed.
pub fn shared(arguments: Vec<OsString>) -> Result<SharedProgram, ExitCode> {
    SharedProgram::new::<UaServer>(arguments)
}

/// The reader of the NodeSet2 files that a mapping names.
pub const NODESETS: NodeSetReader = plant_nodesets::read;

impl UaServer {
    fn pki_root(&self) -> PathBuf {
        let usual = || pki::default_root(|name| std::env::var(name).ok());
        self.pki.clone().unwrap_or_else(usual)
    }

    /// Returns the key service. The keys of its groups are stored beside the private key of the
    /// server.
    fn sks(&self) -> Arc<Sks> {
        let made = || Arc::new(Sks::new(self.pki_root().join("private/sks.json")));
        Arc::clone(self.sks.get_or_init(made))
    }

    /// Returns the ApplicationUri of the server.
    fn uri(&self, mapping: &Mapping) -> String {
        let rank = self.rank.map(RedundancyRank::get);
        let ranked = rank.and_then(|rank| mapping.for_rank(rank));
        ranked
            .as_ref()
            .unwrap_or(mapping)
            .server()
            .application_uri
            .clone()
    }

    fn page(&self) -> Arc<Page> {
        let made = || Page::new(Self::NAME, self.status.clone(), self.page_proxy.clone());
        Arc::clone(self.page.get_or_init(made))
    }

    /// Serves the page by TLS, if that is wanted. The certificate exists by then.
    async fn serve_page_by_tls(&self) -> Result<(), Failure> {
        let Some(address) = self.page_tls else {
            return Ok(());
        };
        if self.arguments.flags.metrics.is_none() {
            return Err(Failure::new(
                FailureKind::Usage,
                "--page-tls needs --metrics, as 127.0.0.1:9100: the page shows the state of programs",
            ));
        }
        let root = self.pki_root();
        let pair = CertificateFiles {
            certificate: root.join(pki::OWN_CERTIFICATE),
            key: root.join(pki::OWN_KEY),
        };
        self.page().serve_tls(address, pair).await
    }

    /// Returns the settings for announcing the server, or `None` if it is not announced.
    fn announcement(&self, mapping: &Mapping) -> Option<AnnounceSettings> {
        let found = mapping.server().find_skills.as_ref();
        let networks = found.into_iter().flat_map(|found| &found.networks);
        // The mapping has validated the texts.
        let networks: Vec<Range> = networks.filter_map(|text| text.parse().ok()).collect();
        let interface = self
            .arguments
            .flags
            .interface
            .as_deref()
            .map(MdnsInterface::parse);
        let settings = AnnounceSettings {
            mdns: self
                .announce
                .then(|| interface.unwrap_or(MdnsInterface::LOOPBACK))
                .map(|interface| interface.with_networks(networks)),
            // The directory of --pki exists by then.
            pki: Some(self.pki_root()),
            ..AnnounceSettings::registering(self.lds.as_deref())
        };
        (self.announce || self.lds.is_some()).then_some(settings)
    }
}

impl Program for UaServer {
    type Port = ServerPort;

    const NAME: &'static str = "ua-server";
    const LOCAL: bridge_core::Local = bridge_core::Local::Fields;
    // The libraries log at level info each action for a client, and at level error faults of
    // clients and checks if the server is reachable. Events of other servers are logged by this
    // program.
    const QUIET: &'static str = "opcua_server=warn,opcua_server::session::controller=off,opcua_client=off,\
        opcua_crypto=warn,opcua_core=warn,opcua_nodes=warn,opcua_types=off";

    const NODESETS: Option<NodeSetReader> = Some(NODESETS);

    fn library() -> Option<&'static str> {
        Some(plant_opcua::patches::library())
    }

    fn arguments(&self) -> &Arguments {
        &self.arguments
    }

    fn observer(&self) -> Option<Arc<dyn Observer>> {
        let is_served = self.arguments.flags.metrics.is_some();
        is_served.then(|| self.page() as Arc<dyn Observer>)
    }

    fn site(&self) -> Result<Option<Arc<dyn Site>>, Failure> {
        Ok(Some(self.page()))
    }

    /// Returns the namespaces of the mapping, of discovered servers and of the server itself.
    /// Components publish in all other namespaces of space 0.
    fn owned(mapping: &Mapping) -> Owned {
        let own = std::iter::once(presence::NAMESPACE);
        let found = mapping.server().find_skills.as_ref();
        let found = found.into_iter().flat_map(FindSkills::namespaces);
        let mapped = mapping.namespaces().keys().copied();
        Owned::Only(mapped.chain(own).chain(found).collect())
    }

    const SHOWS_VALUES_AT_STANDBY: bool = true;

    fn rank(&self) -> Option<RedundancyRank> {
        self.rank
    }

    fn spaces(&self, mapping: &Mapping) -> Result<Vec<SpaceId>, Failure> {
        if let Some(rank) = self.rank.map(RedundancyRank::get)
            && mapping.for_rank(rank).is_none()
        {
            let message = format!(
                "--rank {rank}: the mapping has no ApplicationUri for it; list those of all redundant servers, as in \
                 server: {{redundant: [urn:cell:server-1, urn:cell:server-2]}}"
            );
            return Err(Failure::new(FailureKind::Configuration, message));
        }
        Ok(vec![SpaceId::UA])
    }

    fn key_service(&self, mapping: &Mapping) -> Option<Arc<dyn KeyService>> {
        Some(Arc::new(ServerKeys {
            own: self.sks(),
            others: plant_keys::KeyFetcher::new(plant_keys::KeyClientIdentity {
                application_uri: self.uri(mapping),
                application_name: Self::NAME.to_owned(),
                pki: self.pki_root(),
            }),
        }))
    }

    async fn start(&self, context: Context) -> Result<ServerPort, Failure> {
        let url = match &self.endpoint {
            Some(url) => url.clone(),
            None => {
                let mapping = redundant::ranked(&context.mapping, self.rank);
                let endpoint = mapping.server().endpoint.to_string();
                endpoint.parse().map_err(|error| {
                    Failure::new(
                        FailureKind::Configuration,
                        format!("server.endpoint {endpoint}: {error}"),
                    )
                })?
            }
        };
        let pki = Pki::open(self.pki_root())
            .map_err(|error| Failure::new(FailureKind::Io, format!("{error} (--pki)")))?;
        let gds = self.gds.invitation();
        let gds = gds.map_err(|fault| Failure::new(FailureKind::Usage, fault.to_string()))?;
        let setup = Setup {
            url,
            pki,
            sks: self.sks(),
            trust_any_client: self.trust_any_client_certificate,
            types: MappedTypes::new(&context.types),
            mapped_url: self.endpoint.is_none(),
            gds,
            rank: self.rank,
            announce: self.announcement(&context.mapping),
        };
        let port = ServerPort::start(&context.mapping, setup)?;
        self.page().operate(Arc::new(port.operations()));
        self.serve_page_by_tls().await?;
        Ok(port)
    }
}
