//! The `/status` pages of programs.

use std::collections::BTreeMap;
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr};
use std::time::Duration;

use bridge_core::RecentDelays;
use mappings::TopicId;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use tokio::task::JoinSet;
use tokio::time::timeout;

use super::processes::LocalProcess;
use crate::exit::CommandFailure;
use crate::http::HttpServer;

/// The status of a program in a space, as far as it is needed here.
#[derive(Debug, Clone, Default, PartialEq, Deserialize, Serialize)]
#[serde(default)]
pub(crate) struct StatusPage {
    pub(crate) program: String,
    pub(crate) version: Option<String>,
    pub(crate) uptime_s: Option<u64>,
    /// The clock of the host of the program, in microseconds since 1970.
    #[serde(skip_serializing)]
    pub(crate) time_us: Option<u64>,
    pub(crate) space: u8,
    pub(crate) not_ready: Vec<String>,
    pub(crate) waiting_for: Vec<String>,
    pub(crate) mapping: MappingPage,
    pub(crate) topics: BTreeMap<String, TopicPage>,
    /// The topics of the mapping and of announcements without a value so far.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub(crate) topics_without_values: BTreeMap<String, TopicPage>,
    pub(crate) others: TopicPage,
    pub(crate) certificate: Option<CertificatePage>,
    pub(crate) servers: Vec<ServerPage>,
    pub(crate) hops: BTreeMap<String, HopPage>,
    pub(crate) redundancy: Option<RedundancyPage>,
    /// The address of the page.
    #[serde(skip_deserializing)]
    pub(crate) url: String,
    /// The process that serves the page, if it runs on this host.
    #[serde(skip_deserializing)]
    pub(crate) pid: Option<u32>,
}

/// The role of a bridge among the redundant bridges of its space.
#[derive(Debug, Clone, Default, PartialEq, Eq, Deserialize, Serialize)]
#[serde(default)]
pub(crate) struct RedundancyPage {
    pub(crate) role: String,
    pub(crate) rank: u8,
    pub(crate) epoch: u32,
    pub(crate) cut_off: bool,
    pub(crate) rivals: u64,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) last_takeover: Option<TakeoverPage>,
    pub(crate) peers: Vec<RedundantPeerPage>,
}

#[derive(Debug, Clone, Default, PartialEq, Eq, Deserialize, Serialize)]
#[serde(default)]
pub(crate) struct TakeoverPage {
    pub(crate) reason: String,
    pub(crate) seconds_ago: u64,
}

#[derive(Debug, Clone, Default, PartialEq, Eq, Deserialize, Serialize)]
#[serde(default)]
pub(crate) struct RedundantPeerPage {
    pub(crate) rank: u8,
    pub(crate) role: String,
    pub(crate) address: String,
    pub(crate) age_ms: u64,
}

#[derive(Debug, Clone, Default, PartialEq, Deserialize, Serialize)]
#[serde(default)]
pub(crate) struct MappingPage {
    pub(crate) file: Option<String>,
    pub(crate) hash: String,
    pub(crate) stale: Option<String>,
    pub(crate) restart_needed: Vec<String>,
}

#[derive(Debug, Clone, Default, PartialEq, Deserialize, Serialize)]
#[serde(default)]
pub(crate) struct TopicPage {
    pub(crate) name: Option<String>,
    pub(crate) ros_topics: Vec<RosTopicPage>,
    pub(crate) sent: u64,
    pub(crate) delivered: u64,
    pub(crate) repeated: u64,
    pub(crate) missing: u64,
    pub(crate) sender_changed: u64,
    pub(crate) dropped: BTreeMap<String, u64>,
}

#[derive(Debug, Clone, Default, PartialEq, Deserialize, Serialize)]
#[serde(default)]
pub(crate) struct RosTopicPage {
    pub(crate) topic: String,
}

impl TopicPage {
    /// Returns the name of the mapping or of the announcement, and the ROS topics.
    pub(super) fn names(&self) -> impl Iterator<Item = &str> {
        let ros = self.ros_topics.iter().map(|ros| ros.topic.as_str());
        self.name.as_deref().into_iter().chain(ros)
    }
}

#[derive(Debug, Clone, Default, PartialEq, Deserialize, Serialize)]
#[serde(default)]
pub(crate) struct CertificatePage {
    pub(crate) name: String,
    /// The last day of validity, as `2031-11-25`.
    pub(crate) until: String,
}

#[derive(Debug, Clone, Default, PartialEq, Deserialize, Serialize)]
#[serde(default)]
pub(crate) struct ServerPage {
    pub(crate) name: String,
    pub(crate) up: bool,
}

/// The delays of a hop.
#[derive(Debug, Clone, Default, PartialEq, Deserialize, Serialize)]
#[serde(default)]
pub(crate) struct HopPage {
    pub(crate) p50_us: f64,
    pub(crate) p99_us: f64,
    /// `None` from a program that does not report it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) p999_us: Option<f64>,
    pub(crate) max_us: f64,
    pub(crate) count: u64,
    /// Number of negative delays, which are caused by clocks that disagree.
    pub(crate) negative: u64,
}

impl HopPage {
    /// Returns the figures of the newest delays; `None` without any delay.
    pub(crate) fn of<const MOST: usize>(delays: &RecentDelays<MOST>) -> Option<Self> {
        let (count, negative) = (delays.count(), delays.negative());
        let [p50_us, p99_us, p999_us, max_us] = delays.quantiles_us([500, 990, 999, 1000]);
        (count + negative > 0).then_some(Self {
            p50_us,
            p99_us,
            p999_us: Some(p999_us),
            max_us,
            count,
            negative,
        })
    }
}

impl StatusPage {
    /// Returns the program and its space for output.
    pub(crate) fn label(&self) -> String {
        format!("{} (space {})", self.program, self.space)
    }

    /// Returns the topics that the program knows, with and without values.
    pub(super) fn known_topics(&self) -> impl Iterator<Item = (&String, &TopicPage)> {
        self.topics.iter().chain(&self.topics_without_values)
    }

    /// Returns a topic that the program knows.
    pub(crate) fn known_topic(&self, topic: TopicId) -> Option<&TopicPage> {
        let topic = topic.to_string();
        let without = || self.topics_without_values.get(&topic);
        self.topics.get(&topic).or_else(without)
    }
}

/// Reads the body of a `/status`: an object, or an array with an object for each space.
pub(crate) fn parse(body: &str) -> Option<Vec<StatusPage>> {
    let value: Value = serde_json::from_str(body).ok()?;
    let all = if value.is_array() {
        serde_json::from_value(value).ok()?
    } else {
        vec![value]
    };
    let pages = all.into_iter().map(|one| serde_json::from_value(one).ok());
    let pages: Vec<StatusPage> = pages.collect::<Option<_>>()?;
    pages
        .iter()
        .all(|page| !page.program.is_empty())
        .then_some(pages)
}

/// Returns the status pages of programs on this host.
pub(crate) async fn of_processes(processes: &[LocalProcess]) -> Vec<StatusPage> {
    let mut asking = JoinSet::new();
    for process in processes {
        for address in process.status_at.iter().take(MOST_PORTS) {
            let (pid, at) = (process.pid, reachable(*address));
            asking.spawn(async move {
                let server = HttpServer::parse(&format!("http://{at}")).ok()?;
                let answer = timeout(LIMIT, server.get("/status")).await.ok()?.ok()?;
                let mut pages = parse(&answer.body).filter(|_| answer.status == 200)?;
                for page in &mut pages {
                    page.url = format!("http://{at}");
                    page.pid = Some(pid);
                }
                Some(pages)
            });
        }
    }
    let all = asking.join_all().await;
    let mut pages: Vec<StatusPage> = all.into_iter().flatten().flatten().collect();
    pages.sort_by(|a, b| (&a.program, a.space, &a.url).cmp(&(&b.program, b.space, &b.url)));
    pages
}

/// Returns the pages of a program at an address of `--metrics`.
///
/// # Errors
/// The program does not answer, or its answer is no status.
pub(crate) async fn of_url(url: &str) -> Result<Vec<StatusPage>, CommandFailure> {
    let answer = HttpServer::parse(url)?.get("/status").await?;
    let mut pages = parse(&answer.body)
        .filter(|_| answer.status == 200)
        .ok_or_else(|| CommandFailure::Data(format!("{url}/status is no status of a program")))?;
    for page in &mut pages {
        url.clone_into(&mut page.url);
    }
    Ok(pages)
}

/// Returns an address to which this host can connect.
fn reachable(address: SocketAddr) -> SocketAddr {
    let ip = match address.ip() {
        IpAddr::V4(ip) if ip.is_unspecified() => IpAddr::V4(Ipv4Addr::LOCALHOST),
        IpAddr::V6(ip) if ip.is_unspecified() => IpAddr::V6(Ipv6Addr::LOCALHOST),
        ip @ (IpAddr::V4(_) | IpAddr::V6(_)) => ip,
    };
    SocketAddr::new(ip, address.port())
}

/// The time limit of a page of this host.
const LIMIT: Duration = Duration::from_secs(2);
/// Maximum number of ports of a process that are tried.
const MOST_PORTS: usize = 8;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_program_of_one_space_and_one_of_several_are_read() {
        let one = r#"{"program":"bridge-ros2","space":2,"not_ready":[],"waiting_for":["a type"],"mapping":{"file":null,"hash":"ab","loaded":1,"stale":null},"topics":{"ua_1_2_3":{"sent":4,"dropped":{"too_big":1}}},"hops":{"out":{"count":1,"negative":0,"p50_us":1.5,"p99_us":2,"max_us":2}},"unknown":1}"#;
        let pages = parse(one).unwrap();
        assert_eq!(pages[0].label(), "bridge-ros2 (space 2)");
        assert_eq!(pages[0].topics["ua_1_2_3"].dropped["too_big"], 1);
        assert_eq!(pages[0].hops["out"].p50_us, 1.5);
        assert_eq!(parse(&format!("[{one},{one}]")).unwrap().len(), 2);
        for other in ["", "{}", "[]x", "\"a\"", "{\"program\":1}"] {
            assert_eq!(parse(other), None, "{other}");
        }
    }
}
