//! Queries a Global Discovery Server for servers that multicast does not reach:
//! [`registry::Listing`] with its connection and its clock.

use std::collections::BTreeMap;
use std::time::{Duration, SystemTime};

use opcua::types::ServerOnNetwork;
use plant_opcua::enrolment::{DirectoryClient, EnrolmentFault, Invitation};
use registry::{AnnouncedServer, ListedServer, Listing, ListingSettings};
use serde::Serialize;
use tokio::task::JoinSet;
use tokio::time::sleep_until;
use tracing::{info, warn};

use crate::clock;

/// The options of a discovery server that lists the servers of a Global Discovery Server.
#[derive(Debug, Clone, Default, clap::Args)]
pub struct ListingArguments {
    /// Also list servers that multicast does not reach: those that are registered at the Global
    /// Discovery Server of --gds with a name that matches this pattern, where % stands for any
    /// text. They are listed while they answer
    #[arg(long, value_name = "PATTERN", env = "UA_GDS_SERVERS", requires = "gds")]
    pub gds_servers: Option<String>,
    /// Period of the queries of --gds-servers, in seconds. An answer is valid for ten periods
    #[arg(long, value_name = "SECONDS", default_value = "30", value_parser = clap::value_parser!(u32).range(1..=3600))]
    pub gds_period: u32,
}

impl ListingArguments {
    /// Returns the query of these options; `None` without a pattern or a Global Discovery Server.
    #[must_use]
    pub fn query(&self, gds: Option<&Invitation>) -> Option<ServerQuery> {
        Some(ServerQuery {
            gds: gds?.clone(),
            pattern: self.gds_servers.clone()?,
            every: Duration::from_secs(self.gds_period.into()),
        })
    }
}

/// A periodic query of a Global Discovery Server.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ServerQuery {
    /// The Global Discovery Server.
    pub gds: Invitation,
    /// The pattern of the names of the servers.
    pub pattern: String,
    /// The period of the queries.
    pub every: Duration,
}

/// The state of a periodic query in `/status`.
#[derive(Debug, Clone, Serialize)]
pub(crate) struct ListingStatus {
    url: String,
    pattern: String,
    /// Number of usable servers in the last answer.
    listed: usize,
    /// Number of ignored servers in the last answer, by reason.
    ignored: BTreeMap<&'static str, u64>,
    /// The time of the last answer.
    answered_ms: Option<u64>,
    /// Why the last query failed.
    #[serde(skip_serializing_if = "Option::is_none")]
    reason: Option<String>,
}

/// See the module documentation. Call [`step`](Self::step) repeatedly.
pub(crate) struct ListingTask {
    listing: Listing,
    client: DirectoryClient,
    pattern: String,
    /// The running query, which is separate so that a slow server delays nothing else.
    running: JoinSet<Result<Vec<ServerOnNetwork>, EnrolmentFault>>,
    answered: Option<SystemTime>,
}

impl ListingTask {
    /// Creates the task of a query with the identity of a client. `own` are the URLs of this
    /// program.
    pub(crate) fn new(query: &ServerQuery, client: DirectoryClient, own: Vec<String>) -> Self {
        let settings = ListingSettings {
            every: query.every,
            gds: query.gds.url.clone(),
            own,
        };
        Self {
            listing: Listing::new(settings, clock::now()),
            client,
            pattern: query.pattern.clone(),
            running: JoinSet::new(),
            answered: None,
        }
    }

    /// Waits until the list changes, and returns its servers. Cancel safe.
    pub(crate) async fn step(&mut self) -> Vec<AnnouncedServer> {
        loop {
            let expires = self.listing.expires();
            let due = self.running.is_empty().then(|| self.listing.due());
            let next = due.into_iter().chain(expires).min();
            let timer = async {
                match next {
                    Some(next) => sleep_until(next.into()).await,
                    None => std::future::pending().await,
                }
            };
            tokio::select! {
                Some(asked) = self.running.join_next() => {
                    let asked = asked.unwrap_or_else(|error| Err(error.into()));
                    if let Some(servers) = self.finished(asked) {
                        return servers;
                    }
                }
                () = timer => {
                    let now = clock::now();
                    if self.listing.expire(now) {
                        let why = "the Global Discovery Server has not answered for too long: its servers are not listed";
                        warn!(gds = self.client.gds.url, "{why}");
                        return Vec::new();
                    }
                    if self.running.is_empty() && self.listing.due() <= now {
                        self.start();
                    }
                }
            }
        }
    }

    fn start(&mut self) {
        let (client, pattern) = (self.client.clone(), self.pattern.clone());
        self.running
            .spawn(async move { client.servers(&pattern, MOST_ASKED).await });
    }

    /// Handles the result of a query. Returns the servers of an answer.
    fn finished(
        &mut self,
        asked: Result<Vec<ServerOnNetwork>, EnrolmentFault>,
    ) -> Option<Vec<AnnouncedServer>> {
        let before = self.listing.fault().map(str::to_owned);
        let gds = &self.client.gds.url;
        match asked {
            Ok(servers) => {
                let servers = servers.into_iter().map(listed).collect();
                let servers = self.listing.answered(servers, clock::now());
                if before.is_some() || self.answered.is_none() {
                    let listed = servers.len();
                    let ignored: u64 = self.listing.ignored().values().sum();
                    info!(gds, listed, ignored, "the Global Discovery Server answers");
                }
                self.answered = Some(clock::wall());
                Some(servers)
            }
            Err(fault) => {
                let why = fault.to_string();
                if before.as_ref() != Some(&why) {
                    warn!(
                        gds,
                        "cannot query the Global Discovery Server for servers: {why}"
                    );
                }
                self.listing.failed(why, clock::now());
                None
            }
        }
    }

    pub(crate) fn status(&self) -> ListingStatus {
        let ignored = self.listing.ignored().iter();
        ListingStatus {
            url: self.client.gds.url.clone(),
            pattern: self.pattern.clone(),
            listed: self.listing.len(),
            ignored: ignored.map(|(why, count)| (why.label(), *count)).collect(),
            answered_ms: self.answered.map(clock::millis),
            reason: self.listing.fault().map(str::to_owned),
        }
    }

    /// Returns the number of failed queries.
    pub(crate) fn failures(&self) -> u64 {
        self.listing.failures()
    }
}

fn listed(server: ServerOnNetwork) -> ListedServer {
    let capabilities = server.server_capabilities.into_iter().flatten();
    ListedServer {
        name: server.server_name.as_ref().to_owned(),
        url: server.discovery_url.as_ref().to_owned(),
        capabilities: capabilities.map(|code| code.as_ref().to_owned()).collect(),
    }
}

/// Number of servers that are requested, at most. The listing keeps fewer and counts the others.
const MOST_ASKED: usize = 1024;
