//! The servers that a Global Discovery Server lists: the times of the queries, and the validity of
//! the last answer.
//!
//! The listing has no socket and no clock. Send a query when [`Listing::due`] has passed, pass its
//! result to [`Listing::answered`] or [`Listing::failed`], and call [`Listing::expire`] when
//! [`Listing::expires`] has passed. [`Listing::answered`] returns the servers for
//! [`ServerRegistry::listed`](crate::ServerRegistry::listed).

use std::collections::{BTreeMap, BTreeSet};
use std::time::{Duration, Instant};

use crate::name::label;
use crate::network::{AnnouncedServer, host, place};

/// The settings of a listing.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ListingSettings {
    /// Period of the queries. The answer is valid for ten periods.
    pub every: Duration,
    /// The URL of the Global Discovery Server.
    pub gds: String,
    /// The URLs of this program, which are not listed.
    pub own: Vec<String>,
}

/// A server as a Global Discovery Server lists it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ListedServer {
    /// The application name.
    pub name: String,
    /// The DiscoveryUrl.
    pub url: String,
    /// The server capabilities.
    pub capabilities: Vec<String>,
}

/// Reason for which a listed server is ignored.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Ignored {
    /// The URL is not an OPC UA URL over TCP, or is too long.
    Url,
    /// The URL has a loopback or wildcard address, and the Global Discovery Server has another
    /// address: the URL is valid on one host only.
    Loopback,
    /// The name is empty.
    Name,
    /// The server is this program.
    Own,
    /// Another listed server has the same host and port.
    Duplicate,
    /// The number of listed servers exceeds the limit.
    TooMany,
}

impl Ignored {
    /// Returns the label for the status.
    #[must_use]
    pub fn label(self) -> &'static str {
        match self {
            Self::Url => "url",
            Self::Loopback => "loopback",
            Self::Name => "name",
            Self::Own => "own",
            Self::Duplicate => "duplicate",
            Self::TooMany => "too_many",
        }
    }
}

/// The state of the queries of a Global Discovery Server.
#[derive(Debug)]
pub struct Listing {
    settings: ListingSettings,
    due: Instant,
    /// Number of consecutive failures.
    failures: u32,
    /// Number of all failures.
    failed: u64,
    fault: Option<String>,
    /// Time of the last answer, until the answer expires.
    answered: Option<Instant>,
    /// Number of servers of the last answer.
    listed: usize,
    /// Number of ignored servers of the last answer.
    ignored: BTreeMap<Ignored, u64>,
}

impl Listing {
    /// Creates a listing with a first query that is due now.
    #[must_use]
    pub fn new(settings: ListingSettings, now: Instant) -> Self {
        Self {
            settings,
            due: now,
            failures: 0,
            failed: 0,
            fault: None,
            answered: None,
            listed: 0,
            ignored: BTreeMap::new(),
        }
    }

    /// Returns the time of the next query.
    #[must_use]
    pub fn due(&self) -> Instant {
        self.due
    }

    /// Returns the time at which the last answer expires; `None` without an answer.
    #[must_use]
    pub fn expires(&self) -> Option<Instant> {
        let valid_for = self.settings.every.saturating_mul(VALID_PERIODS);
        self.answered.map(|answered| answered + valid_for)
    }

    /// Handles a complete answer, and returns its usable servers. They replace the servers of the
    /// previous answer.
    pub fn answered(&mut self, servers: Vec<ListedServer>, now: Instant) -> Vec<AnnouncedServer> {
        self.due = now + self.settings.every;
        self.failures = 0;
        self.fault = None;
        self.answered = Some(now);
        self.ignored.clear();
        let mut places = BTreeSet::new();
        let mut usable = Vec::new();
        for server in servers {
            match self.usable(server, &places) {
                Ok(announcement) => {
                    places.insert(place(&announcement.url));
                    usable.push(announcement);
                }
                Err(why) => *self.ignored.entry(why).or_default() += 1,
            }
        }
        self.listed = usable.len();
        usable
    }

    /// Handles a failed query. The next query follows after a pause, which doubles with each
    /// failure.
    pub fn failed(&mut self, why: String, now: Instant) {
        let pause = FIRST_PAUSE.saturating_mul(1 << self.failures.min(MOST_DOUBLED));
        self.due = now + pause.min(LONGEST_PAUSE);
        self.failures = self.failures.saturating_add(1);
        self.failed = self.failed.saturating_add(1);
        self.fault = Some(why);
    }

    /// Returns whether the last answer has expired, once for each answer. No server is listed
    /// then.
    pub fn expire(&mut self, now: Instant) -> bool {
        let is_expired = self.expires().is_some_and(|at| at <= now);
        if is_expired {
            self.answered = None;
            self.listed = 0;
            self.ignored.clear();
        }
        is_expired
    }

    /// Returns the reason of the last failure, until a query succeeds.
    #[must_use]
    pub fn fault(&self) -> Option<&str> {
        self.fault.as_deref()
    }

    /// Returns the number of failed queries.
    #[must_use]
    pub fn failures(&self) -> u64 {
        self.failed
    }

    /// Returns the number of usable servers of the last answer.
    #[must_use]
    pub fn len(&self) -> usize {
        self.listed
    }

    /// Returns whether the last answer has no usable servers, or there is no valid answer.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.listed == 0
    }

    /// Returns the number of ignored servers of the last answer, by reason.
    #[must_use]
    pub fn ignored(&self) -> &BTreeMap<Ignored, u64> {
        &self.ignored
    }

    fn usable(
        &self,
        server: ListedServer,
        places: &BTreeSet<String>,
    ) -> Result<AnnouncedServer, Ignored> {
        let ListedServer {
            name,
            url,
            capabilities,
        } = server;
        let is_odd = |letter: char| letter.is_control() || letter.is_whitespace();
        let at = place(&url);
        if !at.starts_with(SCHEME)
            || host(&at).len() <= SCHEME.len()
            || url.len() > LONGEST_URL
            || url.contains(is_odd)
        {
            return Err(Ignored::Url);
        }
        if is_of_one_host(&at) && !is_of_one_host(&place(&self.settings.gds)) {
            return Err(Ignored::Loopback);
        }
        let instance = label(&name);
        if instance.is_empty() {
            return Err(Ignored::Name);
        }
        if self.settings.own.iter().any(|own| place(own) == at) {
            return Err(Ignored::Own);
        }
        if places.contains(&at) {
            return Err(Ignored::Duplicate);
        }
        if places.len() >= MOST_LISTED {
            return Err(Ignored::TooMany);
        }
        let capabilities = capabilities.iter().take(MOST_CAPABILITIES);
        Ok(AnnouncedServer {
            instance,
            url,
            capabilities: capabilities.map(|code| label(code)).collect(),
        })
    }
}

/// Returns whether a host and port is valid on one host only: a loopback or wildcard address.
fn is_of_one_host(place: &str) -> bool {
    let name = host(place).strip_prefix(SCHEME).unwrap_or_default();
    let name = name.trim_start_matches('[').trim_end_matches(']');
    let address: Option<std::net::IpAddr> = name.parse().ok();
    let is_such = address.is_some_and(|ip| ip.is_loopback() || ip.is_unspecified());
    is_such || name == "localhost"
}

const SCHEME: &str = "opc.tcp://";
/// Validity of an answer, in periods of the queries.
const VALID_PERIODS: u32 = 10;
const FIRST_PAUSE: Duration = Duration::from_secs(5);
const LONGEST_PAUSE: Duration = Duration::from_secs(60);
/// Limits the doubling, far above the longest pause.
const MOST_DOUBLED: u32 = 8;
/// Maximum number of listed servers: a quarter of the records of a registry.
const MOST_LISTED: usize = 256;
const MOST_CAPABILITIES: usize = 32;
const LONGEST_URL: usize = 512;

#[cfg(test)]
mod tests {
    use super::*;

    const PERIOD: Duration = Duration::from_secs(30);

    #[expect(
        clippy::disallowed_methods,
        reason = "a test needs some instant to count from"
    )]
    fn start() -> (Listing, Instant) {
        let now = Instant::now();
        let settings = ListingSettings {
            every: PERIOD,
            gds: "opc.tcp://10.0.0.1:4841".to_owned(),
            own: vec!["opc.tcp://10.0.0.2:4840/".to_owned()],
        };
        (Listing::new(settings, now), now)
    }

    fn server(name: &str, url: &str) -> ListedServer {
        ListedServer {
            name: name.to_owned(),
            url: url.to_owned(),
            capabilities: vec!["DA".to_owned()],
        }
    }

    #[test]
    fn a_query_is_repeated_and_its_pauses_grow_while_it_fails() {
        let (mut listing, now) = start();
        assert_eq!(listing.due(), now, "the first query is sent at once");
        listing.answered(Vec::new(), now);
        assert_eq!(listing.due(), now + PERIOD);
        let pauses: Vec<u64> = (0..6)
            .map(|_| {
                listing.failed("no connection".to_owned(), now);
                (listing.due() - now).as_secs()
            })
            .collect();
        assert_eq!(pauses, [5, 10, 20, 40, 60, 60]);
        assert_eq!(listing.fault(), Some("no connection"));
        assert_eq!(listing.failures(), 6);
        listing.answered(Vec::new(), now);
        assert_eq!((listing.fault(), listing.due()), (None, now + PERIOD));
        listing.failed("again".to_owned(), now);
        assert_eq!(listing.due(), now + FIRST_PAUSE, "the count starts again");
    }

    #[test]
    fn an_answer_expires_once_after_ten_periods_without_another() {
        let (mut listing, now) = start();
        assert_eq!(listing.expires(), None);
        listing.answered(vec![server("arm", "opc.tcp://arm:4840")], now);
        listing.failed("no connection".to_owned(), now + PERIOD);
        let end = now + PERIOD * VALID_PERIODS;
        assert_eq!(listing.expires(), Some(end));
        assert!(!listing.expire(end - Duration::from_millis(1)));
        assert_eq!(listing.len(), 1);
        assert!(listing.expire(end));
        assert!(listing.is_empty());
        assert!(!listing.expire(end), "an answer expires only once");
    }

    #[test]
    fn servers_that_cannot_be_used_are_ignored_with_a_reason() {
        let (mut listing, now) = start();
        let cases = [
            ("arm", "opc.tcp://arm:4840/arm", None),
            ("web", "https://arm", Some(Ignored::Url)),
            ("no host", "opc.tcp://:4840", Some(Ignored::Url)),
            ("line", "opc.tcp://arm:1/\nx", Some(Ignored::Url)),
            ("local", "opc.tcp://127.0.0.1:4840", Some(Ignored::Loopback)),
            ("any", "opc.tcp://[::]:4840", Some(Ignored::Loopback)),
            ("\n", "opc.tcp://nameless:4840", Some(Ignored::Name)),
            ("lds", "opc.tcp://10.0.0.2:4840", Some(Ignored::Own)),
            ("arm again", "opc.tcp://ARM", Some(Ignored::Duplicate)),
        ];
        for (name, url, wanted) in cases {
            let two = [server("arm", "opc.tcp://arm"), server(name, url)];
            let first = usize::from(wanted.is_none());
            let usable = listing.answered(two[first..].to_vec(), now);
            assert_eq!(usable.len(), 1, "{name}");
            let ignored: Vec<Ignored> = listing.ignored().keys().copied().collect();
            assert_eq!(ignored, wanted.into_iter().collect::<Vec<_>>(), "{name}");
        }
        let many = (0..=MOST_LISTED).map(|n| server("arm", &format!("opc.tcp://arm:{}", n + 1)));
        assert_eq!(listing.answered(many.collect(), now).len(), MOST_LISTED);
        assert_eq!(listing.ignored().get(&Ignored::TooMany), Some(&1));
    }

    #[test]
    fn a_local_global_discovery_server_may_list_local_servers() {
        let (mut listing, now) = start();
        listing.settings.gds = "opc.tcp://localhost:4841".to_owned();
        let usable = listing.answered(vec![server("arm", "opc.tcp://127.0.0.1:4850")], now);
        assert_eq!(usable.len(), 1);
    }
}
