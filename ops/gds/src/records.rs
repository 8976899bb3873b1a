//! The registered applications, in a file.

use std::fs;
use std::io::{self, Write as _};
use std::path::{Path, PathBuf};

use opcua::types::{
    ApplicationDescription, ApplicationType, LocalizedText, NodeId, ServerOnNetwork, UAString,
};
use serde::{Deserialize, Serialize};

use plant_opcua::directory::ApplicationRecord;

/// An application.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct GdsRecord {
    /// Unique number of the application, which is never reused.
    pub(crate) number: u32,
    pub(crate) uri: String,
    /// ApplicationType of OPC 10000-4, 7.4.
    pub(crate) kind: i32,
    /// Pairs of locale and text.
    pub(crate) names: Vec<(String, String)>,
    pub(crate) product_uri: String,
    pub(crate) urls: Vec<String>,
    pub(crate) capabilities: Vec<String>,
    /// The hosts of `urls` that an administrator or an invitation has confirmed.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub(crate) confirmed: Vec<String>,
}

/// The reason why an application is refused.
#[derive(Debug, thiserror::Error)]
pub(crate) enum RecordFault {
    #[error("an application with this ApplicationUri is already registered")]
    Present,
    #[error("the application is not registered")]
    Unknown,
    #[error("{0}")]
    Unfit(&'static str),
    #[error("the limit of {MOST_RECORDS} registered applications is reached")]
    Full,
    #[error("{path}: {source}")]
    Io {
        path: PathBuf,
        #[source]
        source: io::Error,
    },
}

/// A query. Empty fields match every application.
#[derive(Debug, Clone, Default)]
pub(crate) struct ApplicationQuery<'q> {
    /// Only applications with a larger number match.
    pub(crate) after: u32,
    /// Largest number of results; 0 for the limit of the server.
    pub(crate) most: u32,
    /// A pattern of the name, with `%` and `_` (OPC 10000-4, 7.7.3).
    pub(crate) name: &'q str,
    pub(crate) uri: &'q str,
    /// 1 for servers, 2 for clients, 0 or 3 for both.
    pub(crate) kinds: u32,
    pub(crate) product_uri: &'q str,
    pub(crate) capabilities: Vec<&'q str>,
}

#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct StoredRecords {
    /// Start of the numbering, in seconds since 1970.
    since: u64,
    last: u32,
    records: Vec<GdsRecord>,
}

/// All registered applications.
#[derive(Debug)]
pub(crate) struct Records {
    path: PathBuf,
    kept: StoredRecords,
}

impl Records {
    /// Reads the applications of a file. A missing file is an empty register.
    pub(crate) fn open(path: PathBuf, now: u64) -> Result<Self, RecordFault> {
        let kept = match fs::read(&path) {
            Ok(bytes) => serde_json::from_slice(&bytes).map_err(|error| RecordFault::Io {
                path: path.clone(),
                source: error.into(),
            })?,
            Err(error) if error.kind() == io::ErrorKind::NotFound => StoredRecords {
                since: now,
                last: 0,
                records: Vec::new(),
            },
            Err(source) => return Err(RecordFault::Io { path, source }),
        };
        Ok(Self { path, kept })
    }

    /// Returns the start of the numbering, in seconds since 1970.
    pub(crate) fn since(&self) -> u64 {
        self.kept.since
    }

    pub(crate) fn len(&self) -> usize {
        self.kept.records.len()
    }

    pub(crate) fn get(&self, number: u32) -> Option<&GdsRecord> {
        self.kept.records.iter().find(|one| one.number == number)
    }

    pub(crate) fn of_uri(&self, uri: &str) -> impl Iterator<Item = &GdsRecord> {
        self.kept.records.iter().filter(move |one| one.uri == uri)
    }

    /// Registers an application and returns its number.
    pub(crate) fn register(&mut self, record: GdsRecord) -> Result<u32, RecordFault> {
        check(&record)?;
        if self.of_uri(&record.uri).next().is_some() {
            return Err(RecordFault::Present);
        }
        if self.len() >= MOST_RECORDS {
            return Err(RecordFault::Full);
        }
        let number = self.kept.last.checked_add(1).ok_or(RecordFault::Full)?;
        self.kept.records.push(GdsRecord { number, ..record });
        self.kept.last = number;
        self.save().inspect_err(|_| {
            self.kept.records.pop();
        })?;
        Ok(number)
    }

    /// Puts a record in the place of that of its number. The ApplicationUri stays, and so do the
    /// confirmed hosts that the DiscoveryUrls still name.
    pub(crate) fn update(&mut self, mut record: GdsRecord) -> Result<(), RecordFault> {
        check(&record)?;
        let all = &mut self.kept.records;
        let known = all.iter_mut().find(|one| one.number == record.number);
        let known = known.ok_or(RecordFault::Unknown)?;
        if known.uri != record.uri {
            return Err(RecordFault::Unfit("the ApplicationUri differs"));
        }
        record.confirm(&known.confirmed);
        if *known == record {
            return Ok(());
        }
        let number = record.number;
        let before = std::mem::replace(known, record);
        self.save().inspect_err(|_| {
            let known = self.kept.records.iter_mut();
            for one in known.filter(|one| one.number == number) {
                one.clone_from(&before);
            }
        })
    }

    /// Removes an application.
    pub(crate) fn remove(&mut self, number: u32) -> Result<GdsRecord, RecordFault> {
        let mut places = self.kept.records.iter();
        let place = places.position(|one| one.number == number);
        let place = place.ok_or(RecordFault::Unknown)?;
        let gone = self.kept.records.remove(place);
        self.save()
            .inspect_err(|_| self.kept.records.insert(place, gone.clone()))?;
        Ok(gone)
    }

    /// Returns the matching applications, and the number after which the next query continues, or 0
    /// if there are no more.
    pub(crate) fn query(&self, query: &ApplicationQuery<'_>) -> (Vec<&GdsRecord>, u32) {
        let most = match usize::try_from(query.most).unwrap_or(MOST_AT_ONCE) {
            0 => MOST_AT_ONCE,
            most => most.min(MOST_AT_ONCE),
        };
        let mut fitting = self
            .kept
            .records
            .iter()
            .filter(|one| one.number > query.after && one.fits(query));
        let found: Vec<&GdsRecord> = fitting.by_ref().take(most).collect();
        let next = match (fitting.next(), found.last()) {
            (Some(_), Some(last)) => last.number,
            _ => 0,
        };
        (found, next)
    }

    fn save(&self) -> Result<(), RecordFault> {
        let failed = |source| RecordFault::Io {
            path: self.path.clone(),
            source,
        };
        let content =
            serde_json::to_vec_pretty(&self.kept).map_err(|error| failed(error.into()))?;
        replace(&self.path, &content).map_err(failed)
    }
}

impl GdsRecord {
    /// Converts the record of a client.
    pub(crate) fn of(told: &ApplicationRecord, number: u32) -> Self {
        let texts = |all: &Option<Vec<UAString>>| -> Vec<String> {
            let all = all.iter().flatten();
            all.map(|one| one.as_ref().to_owned()).collect()
        };
        let names = told.application_names.iter().flatten();
        let name =
            |one: &LocalizedText| (one.locale.as_ref().to_owned(), one.text.as_ref().to_owned());
        Self {
            number,
            uri: told.application_uri.as_ref().to_owned(),
            kind: told.application_type as i32,
            names: names.map(name).collect(),
            product_uri: told.product_uri.as_ref().to_owned(),
            urls: texts(&told.discovery_urls),
            capabilities: texts(&told.server_capabilities),
            confirmed: Vec::new(),
        }
    }

    /// Converts the record for a client.
    pub(crate) fn told(&self, id: NodeId) -> ApplicationRecord {
        let texts = |all: &[String]| Some(all.iter().map(UAString::from).collect());
        let names = self.names.iter();
        ApplicationRecord {
            application_id: id,
            application_uri: UAString::from(&self.uri),
            application_type: self.application_type(),
            application_names: Some(
                names
                    .map(|(locale, text)| LocalizedText::new(locale, text))
                    .collect(),
            ),
            product_uri: UAString::from(&self.product_uri),
            discovery_urls: texts(&self.urls),
            server_capabilities: texts(&self.capabilities),
        }
    }

    pub(crate) fn described(&self) -> ApplicationDescription {
        let (locale, text) = self.name();
        ApplicationDescription {
            application_uri: UAString::from(&self.uri),
            product_uri: UAString::from(&self.product_uri),
            application_name: LocalizedText::new(locale, text),
            application_type: self.application_type(),
            gateway_server_uri: UAString::null(),
            discovery_profile_uri: UAString::null(),
            discovery_urls: Some(self.urls.iter().map(UAString::from).collect()),
        }
    }

    pub(crate) fn on_network(&self) -> ServerOnNetwork {
        ServerOnNetwork {
            record_id: self.number,
            server_name: UAString::from(self.name().1),
            discovery_url: UAString::from(self.urls.first().map_or("", String::as_str)),
            server_capabilities: Some(self.capabilities.iter().map(UAString::from).collect()),
        }
    }

    /// Returns true if the application is a server.
    pub(crate) fn is_server(&self) -> bool {
        self.application_type() != ApplicationType::Client
    }

    fn name(&self) -> (&str, &str) {
        let first = self.names.first();
        first.map_or(("", ""), |(locale, text)| (locale, text))
    }

    fn application_type(&self) -> ApplicationType {
        ApplicationType::try_from(self.kind).unwrap_or(ApplicationType::Client)
    }

    /// Returns the hosts of the DiscoveryUrls. IPv6 addresses have no brackets.
    pub(crate) fn hosts(&self) -> Vec<String> {
        self.urls.iter().filter_map(|url| host(url)).collect()
    }

    /// Confirms hosts as far as the DiscoveryUrls name them, and drops confirmed hosts that they do
    /// not name.
    pub(crate) fn confirm(&mut self, hosts: &[String]) {
        let registered = self.hosts();
        let before = std::mem::take(&mut self.confirmed);
        for host in before.iter().chain(hosts) {
            if has_host(&registered, host) && !has_host(&self.confirmed, host) {
                self.confirmed.push(host.clone());
            }
        }
    }

    fn fits(&self, query: &ApplicationQuery<'_>) -> bool {
        let kind = match query.kinds {
            0 | 3 => true,
            1 => self.is_server(),
            2 => matches!(
                self.application_type(),
                ApplicationType::Client | ApplicationType::ClientAndServer
            ),
            _ => false,
        };
        let has = |wanted: &&str| {
            let mut own = self.capabilities.iter();
            own.any(|one| one.eq_ignore_ascii_case(wanted))
        };
        let named = |pattern: &str| {
            pattern.is_empty() || self.names.iter().any(|(_, text)| is_like(text, pattern))
        };
        kind && named(query.name)
            && (query.uri.is_empty() || query.uri == self.uri)
            && (query.product_uri.is_empty() || query.product_uri == self.product_uri)
            && query.capabilities.iter().all(has)
    }
}

/// Returns whether a host is among others, in any case of its letters.
pub(crate) fn has_host(hosts: &[String], host: &str) -> bool {
    hosts.iter().any(|one| one.eq_ignore_ascii_case(host))
}

/// Returns the host of a URL.
fn host(url: &str) -> Option<String> {
    let (_, rest) = url.split_once("://")?;
    let authority = rest.split(['/', '?', '#']).next()?;
    let authority = authority
        .rsplit_once('@')
        .map_or(authority, |(_, host)| host);
    let host = match authority.strip_prefix('[') {
        Some(literal) => literal.split_once(']')?.0,
        None => authority
            .split_once(':')
            .map_or(authority, |(host, _)| host),
    };
    (!host.is_empty()).then(|| host.to_owned())
}

/// Checks if the record of a client can be stored.
pub(crate) fn check(record: &GdsRecord) -> Result<(), RecordFault> {
    let fits = |ok: bool, why: &'static str| ok.then_some(()).ok_or(RecordFault::Unfit(why));
    let short = |text: &String| text.len() <= LONGEST_TEXT;
    fits(!record.uri.is_empty(), "it has no ApplicationUri")?;
    fits(!record.names.is_empty(), "it has no name")?;
    fits(
        !record.is_server() || !record.urls.is_empty(),
        "the server has no discovery URL",
    )?;
    fits(
        !record.is_server() || !record.capabilities.is_empty(),
        "the server has no capabilities (give `NA` for a server without any)",
    )?;
    let counts = [
        record.names.len(),
        record.urls.len(),
        record.capabilities.len(),
    ];
    fits(
        counts.iter().all(|count| *count <= MOST_TEXTS),
        "too many names, URLs or capabilities",
    )?;
    let names = record
        .names
        .iter()
        .flat_map(|(locale, text)| [locale, text]);
    let mut texts = names
        .chain(&record.urls)
        .chain(&record.capabilities)
        .chain([&record.uri, &record.product_uri]);
    fits(texts.all(short), "a text is too long")
}

/// Returns true if a text matches a pattern: `%` is any text, `_` is any character, and `\` escapes
/// the next character.
fn is_like(text: &str, pattern: &str) -> bool {
    let text: Vec<char> = text.chars().collect();
    // The positions of the text at which the pattern read so far may end.
    let mut ends = vec![false; text.len() + 1];
    if let Some(first) = ends.first_mut() {
        *first = true;
    }
    let mut pattern = pattern.chars();
    while let Some(step) = pattern.next() {
        if step == '%' {
            let mut reached = false;
            for end in &mut ends {
                reached |= *end;
                *end = reached;
            }
            continue;
        }
        let wanted = match step {
            '_' => None,
            '\\' => pattern.next(),
            other => Some(other),
        };
        let fits = text
            .iter()
            .map(|one| wanted.is_none_or(|wanted| wanted == *one));
        let after = ends.iter().zip(fits).map(|(end, fits)| *end && fits);
        ends = std::iter::once(false).chain(after).collect();
    }
    ends.last().copied().unwrap_or_default()
}

/// Replaces a file: writes the content beside it and renames it.
pub(crate) fn replace(path: &Path, content: &[u8]) -> io::Result<()> {
    let beside = path.with_extension("new");
    let mut file = fs::File::create(&beside)?;
    file.write_all(content)?;
    file.sync_all()?;
    fs::rename(&beside, path)
}

const MOST_RECORDS: usize = 10_000;
const MOST_AT_ONCE: usize = 500;
const MOST_TEXTS: usize = 32;
/// Size limit of a text, in bytes. A URI may have 4096 (OPC 10000-3, 8.31).
const LONGEST_TEXT: usize = 4096;

#[cfg(test)]
mod tests {
    use super::*;

    fn records(name: &str) -> Records {
        let path = std::env::temp_dir().join(format!("ua-gds-{}-{name}.json", std::process::id()));
        drop(fs::remove_file(&path));
        Records::open(path, 1_795_000_000).unwrap()
    }

    fn robot(number: u32) -> GdsRecord {
        GdsRecord {
            number: 0,
            uri: format!("urn:cell:robot-{number}"),
            kind: 0,
            names: vec![("en".to_owned(), format!("Robot {number}"))],
            product_uri: "urn:maker".to_owned(),
            urls: vec![format!("opc.tcp://robot-{number}:4840")],
            capabilities: vec!["DA".to_owned(), "HD".to_owned()],
            confirmed: Vec::new(),
        }
    }

    #[test]
    fn numbers_ascend_stay_over_a_restart_and_are_never_given_again() {
        let mut all = records("numbers");
        assert_eq!(all.register(robot(1)).unwrap(), 1);
        assert_eq!(all.register(robot(2)).unwrap(), 2);
        assert!(matches!(all.register(robot(2)), Err(RecordFault::Present)));
        all.remove(2).unwrap();
        let mut again = Records::open(all.path.clone(), 0).unwrap();
        assert_eq!(again.since(), 1_795_000_000);
        assert_eq!(again.register(robot(2)).unwrap(), 3);
        assert_eq!(again.get(1).unwrap().uri, "urn:cell:robot-1");
        assert!(again.get(2).is_none());
        fs::remove_file(&all.path).unwrap();
    }

    #[test]
    fn a_query_goes_on_where_it_ended_and_looks_at_each_filter() {
        let mut all = records("query");
        for number in 1..=5 {
            all.register(robot(number)).unwrap();
        }
        let numbers = |query: &ApplicationQuery<'_>| {
            let (found, next) = all.query(query);
            (found.iter().map(|one| one.number).collect::<Vec<_>>(), next)
        };
        let two = |after| ApplicationQuery {
            after,
            most: 2,
            ..ApplicationQuery::default()
        };
        assert_eq!(numbers(&two(0)), (vec![1, 2], 2));
        assert_eq!(numbers(&two(2)), (vec![3, 4], 4));
        assert_eq!(numbers(&two(4)), (vec![5], 0));
        let filters = [
            (
                ApplicationQuery {
                    name: "%bot 3",
                    ..ApplicationQuery::default()
                },
                vec![3],
            ),
            (
                ApplicationQuery {
                    uri: "urn:cell:robot-4",
                    ..ApplicationQuery::default()
                },
                vec![4],
            ),
            (
                ApplicationQuery {
                    kinds: 2,
                    ..ApplicationQuery::default()
                },
                vec![],
            ),
            (
                ApplicationQuery {
                    capabilities: vec!["hd", "GDS"],
                    ..ApplicationQuery::default()
                },
                vec![],
            ),
        ];
        for (query, wanted) in filters {
            assert_eq!(numbers(&query).0, wanted, "{query:?}");
        }
        fs::remove_file(&all.path).unwrap();
    }

    #[test]
    fn the_hosts_of_an_application_are_those_of_its_urls() {
        let record = GdsRecord {
            urls: [
                "opc.tcp://robot:4840/a",
                "opc.tcp://[fe80::1]:4840",
                "https://10.0.0.7",
                "none",
            ]
            .map(str::to_owned)
            .to_vec(),
            ..robot(1)
        };
        assert_eq!(record.hosts(), ["robot", "fe80::1", "10.0.0.7"]);
    }

    #[test]
    fn confirmed_hosts_stay_over_an_update_and_a_restart_while_a_url_names_them() {
        let mut all = records("confirmed");
        let mut first = robot(1);
        first.confirm(&["ROBOT-1".to_owned(), "mes".to_owned()]);
        let number = all.register(first).unwrap();
        let renamed = |hosts: &[&str]| GdsRecord {
            number,
            urls: hosts
                .iter()
                .map(|host| format!("opc.tcp://{host}"))
                .collect(),
            ..robot(1)
        };
        all.update(renamed(&["robot-1", "mes"])).unwrap();
        let mut all = Records::open(all.path.clone(), 0).unwrap();
        assert_eq!(all.get(number).unwrap().confirmed, ["ROBOT-1"]);
        all.update(renamed(&["mes"])).unwrap();
        all.update(renamed(&["robot-1"])).unwrap();
        assert!(all.get(number).unwrap().confirmed.is_empty());
        fs::remove_file(&all.path).unwrap();
    }

    #[test]
    fn a_register_without_confirmed_hosts_is_read() {
        let text = serde_json::to_string(&robot(1)).unwrap();
        assert!(!text.contains("confirmed"), "{text}");
        assert_eq!(serde_json::from_str::<GdsRecord>(&text).unwrap(), robot(1));
    }

    #[test]
    fn what_cannot_be_kept_is_refused_with_the_reason() {
        let mut all = records("unfit");
        let unfit = [
            GdsRecord {
                uri: String::new(),
                ..robot(1)
            },
            GdsRecord {
                names: vec![],
                ..robot(1)
            },
            GdsRecord {
                urls: vec![],
                ..robot(1)
            },
            GdsRecord {
                urls: vec!["u".repeat(LONGEST_TEXT + 1)],
                ..robot(1)
            },
        ];
        for record in unfit {
            let refused = all.register(record);
            assert!(matches!(refused, Err(RecordFault::Unfit(_))), "{refused:?}");
        }
        assert_eq!(all.len(), 0);
    }

    #[test]
    fn patterns_are_those_of_the_like_operator() {
        for (text, pattern, fits) in [
            ("Robot 1", "Robot _", true),
            ("Robot 12", "Robot _", false),
            ("Robot 12", "%bot%", true),
            ("100 %", "100 \\%", true),
            ("100 x", "100 \\%", false),
            ("", "%", true),
            ("a", "", false),
        ] {
            assert_eq!(is_like(text, pattern), fits, "{text:?} {pattern:?}");
        }
    }
}
