//! Renews the certificate of a server before it is over, with the Global Discovery Server of its plant (OPC 10000-12, 7.9), and fetches
//! what authorities have revoked.

use std::fs;
use std::time::Duration;

use opcua::types::NodeId;
use tokio::time::{Instant, sleep, timeout};
use tracing::{debug, info, warn};
use trust::{Certificate, Renewal, Request, Step};

use super::Configuration;
use crate::client::{Client, ClientConfig, Link, SecurityChoice};
use crate::directory::{ApplicationRecord, Directory, DirectoryError};
use crate::endpoint::EndpointUrl;
use crate::known;
use crate::pair;
use crate::pki::OWN_CERTIFICATE;

/// Where certificates come from, and for whom.
#[derive(Debug, Clone)]
pub struct Plant {
    /// The endpoint of the Global Discovery Server.
    pub url: String,
    /// As what the server is registered there.
    pub record: ApplicationRecord,
}

impl Plant {
    /// Returns the hosts for which a certificate is requested: the hosts of the current certificate if an authority issued it.
    /// Of a self-made certificate only the hosts in the DiscoveryUrls are requested, since the authority refuses others.
    fn hosts(&self, old: &Certificate) -> Vec<String> {
        let hosts = old.hosts();
        if !old.is_self_signed() {
            return hosts;
        }
        let urls = self.record.discovery_urls.iter().flatten();
        let registered: Vec<String> = urls
            .filter_map(|url| url.as_ref().parse::<EndpointUrl>().ok())
            .flat_map(|url| url.hosts())
            .collect();
        let is_registered = |host: &String| {
            let mut known = registered.iter().map(String::as_str).chain(LOOPBACK);
            known.any(|one| one.eq_ignore_ascii_case(host))
        };
        hosts.into_iter().filter(is_registered).collect()
    }
}

/// What the server is without now, for people.
type Why = String;

impl Configuration {
    /// Has a young certificate and current revocation lists, for as long as it is polled. A new certificate is told as other changes
    /// that are applied are ([`Self::applied`]).
    pub async fn keep_young(&self, plant: Plant) {
        let mut plan = None;
        let mut lists_at = Instant::now();
        let mut is_told = false;
        loop {
            let own = self.own_certificate();
            // Somebody else may have given it another one.
            let is_same = |(of, _): &(Certificate, Renewal)| Some(of) == own.as_ref();
            plan = plan
                .filter(is_same)
                .or_else(|| own.map(|own| (own.clone(), Renewal::of(&own))));
            let Some((certificate, renewal)) = &mut plan else {
                sleep(LOOK).await;
                continue;
            };
            let step = renewal.step(known::now());
            let wants = match step {
                Step::Ask | Step::Late => Some(certificate.clone()),
                Step::Wait { .. } => None,
            };
            let is_for_lists = Instant::now() >= lists_at;
            if wants.is_some() || is_for_lists {
                match self.visit(&plant, wants.as_ref()).await {
                    Ok(renewed) => {
                        is_told = false;
                        if renewed {
                            plan = None;
                            self.applied.notify_one();
                        }
                    }
                    Err(why) => {
                        let left = renewal.left(known::now());
                        if wants.is_some() {
                            renewal.failed(known::now());
                        }
                        if !std::mem::replace(&mut is_told, true) || wants.is_some() {
                            warn!(
                                gds = plant.url,
                                days_left = left.as_secs() / 86_400,
                                "certificates are not kept young: {why}"
                            );
                        }
                    }
                }
                let again = if is_told { LISTS_AGAIN } else { LISTS_EVERY };
                lists_at = Instant::now() + again;
            }
            sleep(LOOK).await;
        }
    }

    /// Asks the Global Discovery Server for revocation lists, and for a certificate in place of that one; whether there is another.
    async fn visit(&self, plant: &Plant, old: Option<&Certificate>) -> Result<bool, Why> {
        let client = Client::open(
            ClientConfig {
                pki: Some(self.root.clone()),
                security: SecurityChoice::Best,
                timeout: ANSWERS_WITHIN,
                ..ClientConfig::new(&self.application_uri, "certificates")
            },
            &plant.url,
        );
        let visited = timeout(LONGEST_VISIT, self.ask(&client, plant, old)).await;
        client.close().await;
        visited.unwrap_or_else(|_| Err(format!("it is not done within {LONGEST_VISIT:?}")))
    }

    async fn ask(
        &self,
        client: &Client,
        plant: &Plant,
        old: Option<&Certificate>,
    ) -> Result<bool, Why> {
        let text = |error: DirectoryError| error.to_string();
        client
            .up(ANSWERS_WITHIN)
            .await
            .map_err(|error| error.to_string())?;
        // Who is not proven could give the server any certificate.
        if !matches!(&*client.link().borrow(), Link::Up { secured: true, .. }) {
            return Err("it is reached without security only, and is not asked so".to_owned());
        }
        let directory = Directory::of(client).map_err(text)?;
        let application = directory.registered(plant.record.clone()).await;
        let application = application.map_err(text)?;
        let lists = self.fetch_lists(&directory, &application).await;
        let Some(old) = old else {
            return lists.map(|()| false);
        };
        // A certificate is worth having without them.
        if let Err(why) = lists {
            warn!(gds = plant.url, "revocation lists are not fetched: {why}");
        }
        let key = self.own_key().map_err(|status| status.to_string())?;
        let hosts = plant.hosts(old);
        let request = Request::make(&key, &self.application_uri, (&old.name(), ""), &hosts);
        let request = request.map_err(|why| why.to_string())?;
        let issued = directory.issued(&application, &request).await;
        let (certificate, above) = issued.map_err(text)?;
        self.take_up(&certificate, &above)?;
        info!(
            gds = plant.url,
            issuer = ?certificate.issuer_name(),
            serial = %certificate.serial(),
            "the certificate is renewed before it is over: the server is started anew with it"
        );
        Ok(true)
    }

    /// Looks at what was issued, as at what an administrator brings, and puts it in the place of the server's own.
    fn take_up(&self, certificate: &Certificate, above: &[Certificate]) -> Result<(), Why> {
        if certificate.application_uri().as_deref() != Some(&self.application_uri) {
            return Err("what was issued is of another ApplicationUri".to_owned());
        }
        if !certificate.is_valid_at(known::now()) {
            return Err("what was issued is not valid now: one of the clocks is wrong".to_owned());
        }
        if !matches!(
            Renewal::of(certificate).step(known::now()),
            Step::Wait { .. }
        ) {
            // The server would be started anew without end.
            return Err("what was issued is to be renewed at once".to_owned());
        }
        let key = self.own_key().map_err(|status| status.to_string())?;
        if !certificate.is_of_private_key(&key) {
            return Err("what was issued is for another key".to_owned());
        }
        let refused = |status| format!("what was issued is refused: {status}");
        self.store
            .judge_among(certificate, above)
            .map_err(refused)?;
        self.store.keep_all(above).map_err(refused)?;
        pair::write(&self.root, certificate.der(), None)
            .map_err(|error| format!("the certificate cannot be written: {error}"))
    }

    async fn fetch_lists(&self, directory: &Directory, application: &NodeId) -> Result<(), Why> {
        let lists = directory.revocation_lists(application).await;
        for list in lists.map_err(|error| error.to_string())? {
            match known::put_crl(&self.root, &list) {
                Ok(Some(path)) => debug!(file = %path.display(), "a revocation list is at hand"),
                Ok(None) => debug!(
                    issuer = ?list.issuer_name(),
                    "a revocation list of an authority that is not known is left out"
                ),
                Err(error) => return Err(error.to_string()),
            }
        }
        Ok(())
    }

    fn own_certificate(&self) -> Option<Certificate> {
        let bytes = fs::read(self.root.join(OWN_CERTIFICATE)).ok()?;
        Certificate::read(&bytes).ok()
    }
}

/// The names of the computer itself, which every certificate may have.
const LOOPBACK: [&str; 3] = ["localhost", "127.0.0.1", "::1"];
/// How often the store is looked at: somebody may have changed the certificate, and the clock may have been set.
const LOOK: Duration = Duration::from_secs(2);
/// How often revocation lists are fetched; an authority signs a new one when half of the time of the last is over.
const LISTS_EVERY: Duration = Duration::from_secs(3600);
/// The same after it was in vain.
const LISTS_AGAIN: Duration = Duration::from_secs(30);
/// How long a visit may take, with all its answers.
const LONGEST_VISIT: Duration = Duration::from_secs(60);
/// How long the Global Discovery Server may take for an answer.
const ANSWERS_WITHIN: Duration = Duration::from_secs(10);
