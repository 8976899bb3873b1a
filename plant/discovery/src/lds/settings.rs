//! The settings of a discovery server.

use std::net::IpAddr;
use std::path::PathBuf;
use std::time::Duration;

use mdns::{MdnsInterface, Url, host_name};
use plant_opcua::enrolment::{Applicant, DirectoryClient, Enrolment, Invitation};
use service::{Failure, FailureKind};
use tokio::task::spawn_blocking;

use crate::listing::{ListingTask, ServerQuery};
use crate::security::ChannelSecurity;
use crate::services::OwnDescription;

/// The settings of a discovery server.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LdsSettings {
    /// The ApplicationUri of the embedding application; `None` for a default with the host name.
    pub application_uri: Option<String>,
    /// The endpoint URL, for example `opc.tcp://127.0.0.1:4840`.
    pub endpoint: String,
    /// The interface for mDNS.
    pub interface: MdnsInterface,
    /// Whether servers of other hosts may register over an unsecured channel.
    pub allow_unsecured: bool,
    /// Whether servers of this host must register over a secured channel too.
    pub secured_only: bool,
    /// The registration interval of servers. A registration without a semaphore file expires after
    /// twice this time.
    pub register_every: Duration,
    /// The certificate store; `None` disables secured channels.
    pub pki: Option<PathBuf>,
    /// The Global Discovery Server that issues the certificate. Requires `pki`.
    pub gds: Option<Invitation>,
    /// The Global Discovery Server; its servers are listed too. Requires `pki`.
    pub listing: Option<ServerQuery>,
    /// Whether every client certificate is trusted. For tests only.
    pub trust_any: bool,
    /// The embedding program; `None` for the program `ua-lds`.
    pub embedded: Option<EmbeddedIn>,
}

/// The program that embeds a discovery server.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct EmbeddedIn {
    /// The name of the program.
    pub name: String,
    /// The certificate store that decides on trust; `None` for the store of the discovery server.
    pub trusts: Option<PathBuf>,
}

impl LdsSettings {
    /// Returns the defaults of `ua-lds` at an endpoint: mDNS on loopback, and no secured channels.
    #[must_use]
    pub fn at(endpoint: impl Into<String>) -> Self {
        Self {
            application_uri: None,
            endpoint: endpoint.into(),
            interface: MdnsInterface::LOOPBACK,
            allow_unsecured: false,
            secured_only: false,
            register_every: REGISTER_EVERY,
            pki: None,
            gds: None,
            listing: None,
            trust_any: false,
            embedded: None,
        }
    }

    /// Returns the application name.
    pub(super) fn name(&self) -> String {
        match &self.embedded {
            None => NAME.to_owned(),
            Some(program) => format!("{NAME} in {}", program.name),
        }
    }

    /// Creates a missing certificate and key. Generating a key takes seconds on a small computer,
    /// during which an open port would keep clients waiting.
    pub(crate) async fn prepare(&self) -> Result<(), Failure> {
        let place = Url::parse(&self.endpoint).map(|place| place.host);
        let host = own_host(place.as_deref().unwrap_or_default(), &self.interface);
        self.open_security(&self.uri(), &host).await.map(drop)
    }

    pub(super) fn uri(&self) -> String {
        let given = self.application_uri.clone();
        given.unwrap_or_else(|| format!("urn:{}:ua-lds", host_name()))
    }

    /// Returns the renewal of the certificate at the Global Discovery Server.
    pub(super) fn enrolment(&self, own: &OwnDescription) -> Option<Enrolment> {
        let (root, gds) = (self.pki.as_ref()?, self.gds.clone()?);
        let applicant = Applicant {
            application_uri: own.application_uri.clone(),
            name: own.name.clone(),
            product_uri: "urn:ua-bridge:lds".to_owned(),
            urls: vec![own.url.clone()],
            capabilities: vec!["LDS".to_owned()],
        };
        Some(Enrolment::new(root, applicant, gds))
    }

    /// Returns the queries of the Global Discovery Server, with the identity of the discovery
    /// server.
    pub(super) fn listing_task(&self, own: &OwnDescription) -> Option<ListingTask> {
        let (query, root) = (self.listing.as_ref()?, self.pki.clone()?);
        let client = DirectoryClient {
            root,
            application_uri: own.application_uri.clone(),
            name: own.name.clone(),
            gds: query.gds.clone(),
        };
        Some(ListingTask::new(query, client, vec![own.url.clone()]))
    }

    /// Opens the certificate store, and creates a missing certificate and key.
    pub(super) async fn open_security(
        &self,
        application_uri: &str,
        host: &str,
    ) -> Result<Option<ChannelSecurity>, Failure> {
        let Some(root) = self.pki.clone() else {
            return Ok(None);
        };
        let (uri, host, trust_any) = (application_uri.to_owned(), host.to_owned(), self.trust_any);
        // Generating a key takes some time, and must not block the program.
        let open = move || ChannelSecurity::open(&root, &uri, &host, trust_any);
        let opened = spawn_blocking(open).await;
        let opened = opened.map_err(|error| Failure::new(FailureKind::Io, error.to_string()))??;
        let trusts = self
            .embedded
            .as_ref()
            .and_then(|program| program.trusts.clone());
        Ok(Some(opened.judging_by(trusts, self.trust_any)))
    }
}

/// Returns the host of the own URL. A server on the wildcard address uses the address of the
/// interface.
pub(super) fn own_host(host: &str, interface: &MdnsInterface) -> String {
    let address: Option<IpAddr> = host.parse().ok();
    let is_wildcard = address.is_some_and(|address| address.is_unspecified());
    match (is_wildcard, interface.addresses().first()) {
        (true, Some(address)) => address.to_string(),
        _ => host.to_owned(),
    }
}

const NAME: &str = "UA bridge discovery server";
/// The default of most discovery servers.
const REGISTER_EVERY: Duration = Duration::from_secs(600);
