//! Requests and renews the certificate and the trust list of an application at the Global Discovery
//! Server of its plant (OPC 10000-12, 7.9). All programs with an OPC UA certificate use this
//! implementation.
//!
//! An application with a self-made certificate sends the first request at once. Later requests
//! follow after four fifths of the lifetime of the certificate. With the one-time token of an
//! [`Invitation`] the first certificate is issued at once. Without a token the request waits for
//! the approval of an administrator, and is polled until then. The authority in the trust list
//! becomes trusted, so that the programs of a plant trust each other.
//!
//! Reading order: `invitation` (the option of a program), then this module.

mod fault;
mod invitation;

use std::path::{Path, PathBuf};
use std::time::Duration;

use opcua::types::{ApplicationType, NodeId, ServerOnNetwork, StatusCode};
use tokio::time::{Instant, sleep, timeout};
use tracing::{debug, info, warn};
use trust::{Certificate, CertificateSigningRequest, Renewal, RenewalStep};

pub use self::fault::EnrolmentFault;
pub use self::invitation::{GdsArguments, GdsOption, Invitation, InvitationFault, Token};

use crate::client::{CallError, ClientConfig, ClientError, Link, OpcUaClient, SecurityChoice};
use crate::configuration::StoreList;
use crate::directory::{ApplicationRecord, Directory, DirectoryError, TrustLists};
use crate::endpoint::EndpointUrl;
use crate::known;
use crate::own::{self, CertificateCause};
use crate::pair;
use crate::pki::OWN_KEY;

/// The application that requests a certificate.
#[derive(Debug, Clone)]
pub struct Applicant {
    /// The ApplicationUri of the application.
    pub application_uri: String,
    /// The application name.
    pub name: String,
    /// The ProductUri of the application.
    pub product_uri: String,
    /// The DiscoveryUrls of the application. The authority issues certificates for their hosts
    /// only.
    pub urls: Vec<String>,
    /// The server capabilities, such as `DA`.
    pub capabilities: Vec<String>,
}

impl Applicant {
    fn record(&self) -> ApplicationRecord {
        let texts = |all: &[String]| Some(all.iter().map(|one| one.as_str().into()).collect());
        let capabilities = match self.capabilities.as_slice() {
            [] => vec!["NA".to_owned()],
            all => all.to_vec(),
        };
        ApplicationRecord {
            application_uri: self.application_uri.as_str().into(),
            application_type: ApplicationType::Server,
            application_names: Some(vec![self.name.as_str().into()]),
            product_uri: self.product_uri.as_str().into(),
            discovery_urls: texts(&self.urls),
            server_capabilities: texts(&capabilities),
            ..ApplicationRecord::default()
        }
    }

    /// Returns the hosts of the requested certificate. These are the hosts of the DiscoveryUrls,
    /// and hosts of the current certificate: all hosts if an authority issued it, otherwise only
    /// the loopback names.
    fn hosts(&self, old: &Certificate) -> Vec<String> {
        let urls = self.urls.iter().filter_map(|url| url.parse().ok());
        let registered = urls.flat_map(|url: EndpointUrl| url.hosts());
        let is_issued = !old.is_self_signed();
        let own = old.hosts().into_iter();
        let own = own.filter(|host| is_issued || LOOPBACK.contains(&host.as_str()));
        let mut hosts: Vec<String> = Vec::new();
        for host in registered.chain(own) {
            if !hosts.iter().any(|one| one.eq_ignore_ascii_case(&host)) {
                hosts.push(host);
            }
        }
        hosts
    }
}

/// Keeps the certificate and the trust list of an application up to date.
#[derive(Debug)]
pub struct Enrolment {
    root: PathBuf,
    applicant: Applicant,
    gds: Invitation,
    /// The pending request, on which the server has not decided.
    pending: Option<Pending>,
    /// Whether the token was refused because it expired or another application used it.
    is_token_refused: bool,
}

#[derive(Debug)]
struct Pending {
    application: NodeId,
    number: NodeId,
}

/// The outcome of a connection to the Global Discovery Server.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Visit {
    /// A new certificate was installed, or the first authority is trusted: the program has to
    /// restart.
    Changed,
    /// The certificate is unchanged.
    Current,
    /// The request waits for an administrator.
    Waiting,
}

impl Enrolment {
    /// Creates the enrolment of an application. The certificate store at `root` contains its
    /// certificate and key.
    #[must_use]
    pub fn new(root: &Path, applicant: Applicant, gds: Invitation) -> Self {
        Self {
            root: root.to_owned(),
            applicant,
            gds,
            pending: None,
            is_token_refused: false,
        }
    }

    /// Keeps the certificate and the trust list up to date while the future is polled. Calls
    /// `changed` when the program has to restart with a new certificate.
    pub async fn keep(mut self, changed: impl Fn()) {
        let mut plan: Option<(Certificate, Renewal)> = None;
        let mut lists_at = Instant::now();
        let mut reported: Option<String> = None;
        loop {
            let own = own::read(&self.root);
            // An administrator may have replaced the certificate.
            let is_same = |(of, _): &(Certificate, Renewal)| Some(of) == own.as_ref();
            plan = plan
                .filter(is_same)
                .or_else(|| own.map(|own| (own.clone(), Renewal::of(&own))));
            let Some((certificate, renewal)) = &mut plan else {
                sleep(LOOK).await;
                continue;
            };
            let wants = match renewal.step(known::now()) {
                RenewalStep::Ask | RenewalStep::Late => Some(certificate.clone()),
                RenewalStep::Wait { .. } => None,
            };
            let is_for_lists = !certificate.is_self_signed() && Instant::now() >= lists_at;
            if wants.is_some() || is_for_lists {
                let visited = self.visit(wants.as_ref()).await;
                let again = match &visited {
                    Ok(_) => LISTS_EVERY,
                    Err(_) => LISTS_AGAIN,
                };
                lists_at = Instant::now() + again;
                let is_changed = matches!(visited, Ok(Visit::Changed));
                if wants.is_some() && !is_changed {
                    renewal.failed(known::now());
                }
                let days_left = renewal.left(known::now()).as_secs() / 86_400;
                self.report(&visited, days_left, &mut reported);
                if is_changed {
                    plan = None;
                    changed();
                }
            }
            sleep(LOOK).await;
        }
    }

    /// Logs an outcome if it differs from the last outcome.
    fn report(
        &self,
        visited: &Result<Visit, EnrolmentFault>,
        days_left: u64,
        reported: &mut Option<String>,
    ) {
        let message = match visited {
            Ok(Visit::Changed | Visit::Current) => None,
            Ok(Visit::Waiting) => Some(WAITING.to_owned()),
            Err(why) => Some(why.to_string()),
        };
        if *reported == message {
            return;
        }
        match (visited, &message) {
            (Ok(Visit::Waiting), _) => self.report_waiting(),
            (_, Some(why)) => warn!(
                gds = self.gds.url,
                days_left, "cannot renew the certificate or its trust list: {why}"
            ),
            (_, None) => {}
        }
        *reported = message;
    }

    fn report_waiting(&self) {
        let key = own::read(&self.root).map(|own| own.key_fingerprint().to_string());
        warn!(
            gds = self.gds.url,
            application_uri = self.applicant.application_uri,
            key = key.unwrap_or_default(),
            "{WAITING}"
        );
    }

    /// Connects to the Global Discovery Server, requests a certificate to replace `old`, and
    /// fetches the trust list.
    async fn visit(&mut self, old: Option<&Certificate>) -> Result<Visit, EnrolmentFault> {
        let client = DirectoryClient {
            root: self.root.clone(),
            application_uri: self.applicant.application_uri.clone(),
            name: self.applicant.name.clone(),
            gds: self.gds.clone(),
        };
        let ask = async |directory: Directory| self.ask(&directory, old).await;
        client.visit(ask).await
    }

    async fn ask(
        &mut self,
        directory: &Directory,
        old: Option<&Certificate>,
    ) -> Result<Visit, EnrolmentFault> {
        let issued = match old {
            Some(old) => match self.issued(directory, old).await? {
                Some(issued) => Some(issued),
                None if old.is_self_signed() => return Ok(Visit::Waiting),
                None => {
                    // A renewal may wait for weeks, in which certificates of others are revoked.
                    if let Ok(lists) = self.lists(directory).await {
                        self.trust(&lists)?;
                    }
                    return Ok(Visit::Waiting);
                }
            },
            None => None,
        };
        let lists = self.lists(directory).await?;
        let is_first = !known::trusts_authorities(&self.root);
        // The trust list comes first: the certificate is useless until its authority is trusted
        // here.
        self.trust(&lists)?;
        if let Some((certificate, above)) = &issued {
            self.take_up(certificate, above)?;
        }
        match issued.is_some() || is_first && known::trusts_authorities(&self.root) {
            true => Ok(Visit::Changed),
            false => Ok(Visit::Current),
        }
    }

    /// Fetches the trust list of the registered application.
    async fn lists(&self, directory: &Directory) -> Result<TrustLists, DirectoryError> {
        let application = directory.registered(&self.applicant.record()).await?;
        directory.trust_lists(&application).await
    }

    /// Returns the certificate that the authority issued and the certificates of the authorities
    /// above it; `None` while the request waits.
    async fn issued(
        &mut self,
        directory: &Directory,
        old: &Certificate,
    ) -> Result<Option<(Certificate, Vec<Certificate>)>, EnrolmentFault> {
        let pending = match self.pending.take() {
            Some(pending) => pending,
            None => {
                let application = directory.registered(&self.applicant.record()).await?;
                self.requested(directory, application, old).await?
            }
        };
        match directory
            .finished(&pending.application, &pending.number)
            .await
        {
            Ok(issued) => Ok(Some(issued)),
            Err(error) => match status_of(&error) {
                Some(StatusCode::BadRequestNotComplete) => {
                    self.pending = Some(pending);
                    Ok(None)
                }
                // The server does not know the request; the next visit sends a new request.
                Some(_) => Err(error.into()),
                // The response was lost; the next visit polls the request again.
                None => {
                    self.pending = Some(pending);
                    Err(error.into())
                }
            },
        }
    }

    /// Requests a certificate, with the token unless the server refused the token.
    async fn requested(
        &mut self,
        directory: &Directory,
        application: NodeId,
        old: &Certificate,
    ) -> Result<Pending, EnrolmentFault> {
        let token = self.gds.token.clone();
        let token = token.filter(|_| !self.is_token_refused && old.is_self_signed());
        let has_token = token.is_some();
        let request = self.request(old, token).await?;
        match directory.requested(&application, &request).await {
            Ok(number) => Ok(Pending {
                application,
                number,
            }),
            Err(error)
                if has_token && status_of(&error) == Some(StatusCode::BadUserAccessDenied) =>
            {
                warn!(
                    gds = self.gds.url,
                    "the server refused the token of --gds: it has expired, was used, or belongs to another \
                     application; approve the request (`ua-gds approve`), or use a new invitation (`ua-gds \
                     invite`)"
                );
                self.is_token_refused = true;
                let request = self.request(old, None).await?;
                let number = directory.requested(&application, &request).await?;
                Ok(Pending {
                    application,
                    number,
                })
            }
            Err(error) => Err(error.into()),
        }
    }

    /// Signs a request with the own private key, which takes some time.
    async fn request(
        &self,
        old: &Certificate,
        token: Option<Token>,
    ) -> Result<CertificateSigningRequest, EnrolmentFault> {
        let key = own_key(&self.root)?;
        let (uri, hosts) = (
            self.applicant.application_uri.clone(),
            self.applicant.hosts(old),
        );
        let name: String = self.applicant.name.chars().take(LONGEST_NAME).collect();
        let signing = tokio::task::spawn_blocking(move || {
            let token = token.as_ref().map(Token::secret);
            CertificateSigningRequest::make_with(&key, (&uri, &hosts), (&name, ""), token)
        });
        Ok(signing.await??)
    }

    /// Trusts the certificates of a trust list, and stores its revocation lists.
    fn trust(&self, lists: &TrustLists) -> Result<(), EnrolmentFault> {
        let store = StoreList::new(&self.root);
        let trusted = store.trust_all(&lists.trusted);
        trusted.map_err(EnrolmentFault::TrustList)?;
        let kept = store.keep_all(&lists.issuers);
        kept.map_err(EnrolmentFault::Issuers)?;
        for list in &lists.revocation_lists {
            match known::put_crl(&self.root, list)? {
                Some(path) => debug!(file = %path.display(), "stored a revocation list"),
                None => debug!(
                    issuer = ?list.issuer_name(),
                    "ignored a revocation list of an unknown authority"
                ),
            }
        }
        Ok(())
    }

    /// Checks an issued certificate by the rules of UpdateCertificate, and replaces the own
    /// certificate.
    fn take_up(
        &self,
        certificate: &Certificate,
        above: &[Certificate],
    ) -> Result<(), EnrolmentFault> {
        if certificate.application_uri().as_deref() != Some(&self.applicant.application_uri) {
            return Err(EnrolmentFault::OtherApplication);
        }
        if !certificate.is_valid_at(known::now()) {
            return Err(EnrolmentFault::NotValid);
        }
        if !matches!(
            Renewal::of(certificate).step(known::now()),
            RenewalStep::Wait { .. }
        ) {
            return Err(EnrolmentFault::ShortLived);
        }
        let key = own_key(&self.root)?;
        if !certificate.is_of_private_key(&key) {
            return Err(EnrolmentFault::OtherKey);
        }
        let store = StoreList::new(&self.root);
        let kept = store.judge_among(certificate, above);
        let kept = kept.and_then(|()| store.keep_all(above));
        kept.map_err(EnrolmentFault::Rejected)?;
        own::replace(&self.root, certificate, &CertificateCause::Enrolment)
            .map_err(EnrolmentFault::Write)?;
        info!(
            gds = self.gds.url,
            "restarting with the certificate of the plant"
        );
        Ok(())
    }
}

/// A client of the Directory of a Global Discovery Server, with the certificate store of its
/// program.
#[derive(Debug, Clone)]
pub struct DirectoryClient {
    /// The certificate store.
    pub root: PathBuf,
    /// The ApplicationUri.
    pub application_uri: String,
    /// The application name.
    pub name: String,
    /// The Global Discovery Server.
    pub gds: Invitation,
}

impl DirectoryClient {
    /// Returns the registered servers with names that match a pattern, up to a limit.
    ///
    /// # Errors
    /// The server is unreachable, slow or untrusted, or its answer is invalid.
    pub async fn servers(
        &self,
        pattern: &str,
        most: usize,
    ) -> Result<Vec<ServerOnNetwork>, EnrolmentFault> {
        let ask = async |directory: Directory| {
            let servers = directory.servers(pattern, most).await;
            servers.map_err(EnrolmentFault::from)
        };
        self.visit(ask).await
    }

    /// Connects over a secured channel, sends requests, and disconnects, all within a time limit.
    async fn visit<T>(
        &self,
        requests: impl AsyncFnOnce(Directory) -> Result<T, EnrolmentFault>,
    ) -> Result<T, EnrolmentFault> {
        let client = OpcUaClient::open(
            ClientConfig {
                pki: Some(self.root.clone()),
                pinned: self.gds.fingerprint,
                allow_outdated_lists: true,
                security: SecurityChoice::Best,
                timeout: ANSWERS_WITHIN,
                ..ClientConfig::new(&self.application_uri, &self.name)
            },
            &self.gds.url,
        );
        let visit = async {
            client.up(ANSWERS_WITHIN).await?;
            if !matches!(&*client.link().borrow(), Link::Up { secured: true, .. }) {
                return Err(EnrolmentFault::Unsecured);
            }
            requests(Directory::of(&client)?).await
        };
        let visited = timeout(LONGEST_VISIT, visit).await;
        client.close().await;
        visited.unwrap_or(Err(EnrolmentFault::Late))
    }
}

/// Returns the status code of the server's response; `None` without a response.
fn status_of(error: &DirectoryError) -> Option<StatusCode> {
    match error {
        DirectoryError::Call { error, .. } => match error {
            CallError::Client(ClientError::Status(status)) => Some(*status),
            CallError::Client(_) => None,
            CallError::Refused { status, .. } => Some(*status),
        },
        DirectoryError::Client(_) | DirectoryError::None | DirectoryError::Answer(_) => None,
    }
}

/// Reads the own private key, and returns its DER encoding.
///
/// # Errors
/// Returns an error if the file cannot be read or does not contain a key.
pub fn own_key(root: &Path) -> Result<Vec<u8>, EnrolmentFault> {
    let path = root.join(OWN_KEY);
    let read = std::fs::read(&path).map_err(|error| EnrolmentFault::KeyFile {
        path: path.clone(),
        error,
    })?;
    pair::from_pem(&read).ok_or(EnrolmentFault::NoKey(path))
}

/// The loopback names, which every certificate may contain.
const LOOPBACK: [&str; 3] = ["localhost", "127.0.0.1", "::1"];
const WAITING: &str = "the certificate request waits for an administrator: list it with `ua-gds requests`, \
                       approve it with `ua-gds approve NUMBER`";
/// Interval of reading the store: an administrator may have replaced the certificate, or the clock
/// may have been set.
const LOOK: Duration = Duration::from_secs(2);
/// Interval of fetching the trust list. An authority signs a new revocation list after half of the
/// validity of the last list.
const LISTS_EVERY: Duration = Duration::from_secs(3600);
/// Interval of fetching the trust list after a failure.
const LISTS_AGAIN: Duration = Duration::from_secs(30);
/// Longest duration of a visit.
const LONGEST_VISIT: Duration = Duration::from_secs(60);
/// Timeout of a request to the Global Discovery Server.
const ANSWERS_WITHIN: Duration = Duration::from_secs(10);
/// Maximum number of characters of a common name.
const LONGEST_NAME: usize = 64;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_hosts_that_the_authority_can_check_are_requested() {
        let applicant = Applicant {
            application_uri: "urn:a".to_owned(),
            name: "A".to_owned(),
            product_uri: String::new(),
            urls: [4840, 4841]
                .map(|port| format!("opc.tcp://192.0.2.7:{port}"))
                .to_vec(),
            capabilities: Vec::new(),
        };
        let data = own::described(
            "urn:a",
            &["192.0.2.6".to_owned()],
            "UA bridge",
            known::now(),
        );
        let key = opcua::crypto::PrivateKey::new(2048).unwrap();
        let made = opcua::crypto::X509::from_pkey(&key, &data).unwrap();
        let old = Certificate::read(&made.to_der().unwrap()).unwrap();
        assert!(old.hosts().contains(&"192.0.2.6".to_owned()));
        let hosts = applicant.hosts(&old);
        assert_eq!(hosts.first().map(String::as_str), Some("192.0.2.7"));
        assert_eq!(hosts.iter().filter(|one| *one == "192.0.2.7").count(), 1);
        let others: Vec<&str> = hosts.iter().skip(1).map(String::as_str).collect();
        assert!(others.iter().all(|one| LOOPBACK.contains(one)), "{hosts:?}");
        let record = applicant.record();
        assert_eq!(record.server_capabilities, Some(vec!["NA".into()]));
    }
}
