//! The programs of the cell: their `/status` as rows with reasons and the command that helps.

use std::collections::BTreeMap;

use serde_json::{Value, json};

use crate::value::cut;

/// The status of a program, as read from its `/status`.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct ProgramStatus {
    /// The location of the status: `this program`, or a URL.
    pub(crate) source: String,
    /// The status; otherwise the reason why it cannot be read.
    pub(crate) status: Result<Value, String>,
}

/// Counters of a topic in a program.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(crate) struct TopicCounts {
    pub(crate) sent: u64,
    pub(crate) delivered: u64,
    pub(crate) dropped: BTreeMap<String, u64>,
}

impl ProgramStatus {
    /// Returns the name of the program.
    pub(crate) fn name(&self) -> &str {
        let status = self.status.as_ref().ok();
        let name = status.and_then(|status| status.get("program")?.as_str());
        name.unwrap_or("unknown program")
    }

    /// Returns the space that the program serves.
    pub(crate) fn space(&self) -> Option<u64> {
        self.status.as_ref().ok()?.get("space")?.as_u64()
    }

    /// Returns whether the program answers and reports no reason for being not ready.
    pub(crate) fn is_ready(&self) -> bool {
        self.status.is_ok() && self.texts("not_ready").is_empty()
    }

    /// Returns the counters of a topic.
    pub(crate) fn counts(&self, topic: &str) -> Option<TopicCounts> {
        let counts = self.status.as_ref().ok()?.get("topics")?.get(topic)?;
        let number = |key: &str| counts.get(key).and_then(Value::as_u64).unwrap_or_default();
        let dropped = counts.get("dropped").and_then(Value::as_object);
        let dropped = dropped.into_iter().flatten();
        let dropped = dropped.filter(|(reason, _)| !is_intended_drop(reason));
        Some(TopicCounts {
            sent: number("sent"),
            delivered: number("delivered"),
            dropped: dropped
                .filter_map(|(reason, count)| Some((reason.clone(), count.as_u64()?)))
                .collect(),
        })
    }

    /// Returns the total of a counter over all topics.
    pub(crate) fn total(&self, counter: &str) -> u64 {
        let topics = self
            .status
            .as_ref()
            .ok()
            .and_then(|status| status.get("topics"));
        let topics = topics.and_then(Value::as_object);
        let counts = topics.into_iter().flat_map(serde_json::Map::values);
        counts
            .filter_map(|counts| counts.get(counter)?.as_u64())
            .sum()
    }

    /// Returns the delays of the hops that the program measures.
    pub(crate) fn hops(&self) -> Option<&Value> {
        self.status.as_ref().ok()?.get("hops")
    }

    /// Returns the peers that the program waits for.
    pub(crate) fn waiting_for(&self) -> Vec<&str> {
        self.texts("waiting_for")
    }

    /// Returns the row of the view.
    pub(crate) fn row(&self) -> Value {
        let status = match &self.status {
            Ok(status) => status,
            Err(why) => {
                return json!({
                    "program": "not reachable",
                    "source": self.source,
                    "state": "down",
                    "problems": [problem(why, "start the program, or read its log")],
                    "waiting": [],
                });
            }
        };
        let not_ready = self.texts("not_ready");
        let waiting = self.texts("waiting_for");
        let links = status.get("servers").and_then(Value::as_array);
        let links = links.into_iter().flatten().filter_map(|link| {
            let is_up = link.get("up")?.as_bool()?;
            let name = link.get("name")?.as_str()?;
            let why = link
                .get("why")
                .and_then(Value::as_str)
                .unwrap_or("no connection");
            (!is_up).then(|| problem(&format!("server {name}: {why}"), "ua-space discover"))
        });
        let links: Vec<Value> = links.collect();
        let state = match (not_ready.is_empty(), waiting.is_empty() && links.is_empty()) {
            (false, _) => "down",
            (true, false) => "waiting",
            (true, true) => "ready",
        };
        let mapping = status.get("mapping");
        let of_mapping = |key: &str| mapping.and_then(|mapping| mapping.get(key)).cloned();
        let mut problems: Vec<Value> = not_ready
            .iter()
            .map(|why| problem(why, &help(why)))
            .collect();
        problems.extend(links);
        if let Some(stale) = of_mapping("stale").filter(|stale| !stale.is_null()) {
            let why = format!("mapping file: {}", stale.as_str().unwrap_or_default());
            problems.push(problem(&why, "ua-space check MAPPING"));
        }
        let restart = of_mapping("restart_needed");
        let restart = restart.as_ref().and_then(Value::as_array);
        if let Some(keys) = restart.filter(|keys| !keys.is_empty()) {
            let keys: Vec<&str> = keys.iter().filter_map(Value::as_str).collect();
            let why = format!("changed in the mapping: {}", keys.join(", "));
            problems.push(problem(&why, "restart the program"));
        }
        json!({
            "program": self.name(),
            "source": self.source,
            "space": self.space(),
            "state": state,
            "problems": problems,
            "waiting": waiting.iter().map(|peer| problem(peer, &help(peer))).collect::<Vec<_>>(),
            "mapping": of_mapping("file"),
            "hash": of_mapping("hash"),
            "version": status.get("version"),
            "uptime_s": status.get("uptime_s"),
            "sent": self.total("sent"),
            "delivered": self.total("delivered"),
        })
    }

    fn texts(&self, key: &str) -> Vec<&str> {
        let status = self.status.as_ref().ok();
        let texts = status.and_then(|status| status.get(key)?.as_array());
        let texts = texts.into_iter().flatten();
        texts.filter_map(Value::as_str).take(MOST_REASONS).collect()
    }
}

fn problem(text: &str, help: &str) -> Value {
    json!({ "text": cut(text, LONGEST_REASON), "help": help })
}

/// Returns the command that helps with a reason or a missing peer.
fn help(reason: &str) -> String {
    let topic = reason
        .split_whitespace()
        .map(|word| word.trim_end_matches([':', ',', ';']))
        .find(|word| word.starts_with('/') && word.len() > 1);
    let has = |part: &str| reason.contains(part);
    if has("ROS master") {
        return "echo $ROS_MASTER_URI; rosnode list".to_owned();
    }
    if has("keys") {
        return "ua-space keys --help".to_owned();
    }
    if has("interface") || has("out of reach") {
        return "ip -br address".to_owned();
    }
    if has("in use from") {
        return "ua-space list".to_owned();
    }
    if has("clock") {
        return "timedatectl".to_owned();
    }
    match topic {
        Some(name) if has("service") => format!("rosservice info {name}; ros2 service type {name}"),
        Some(name) if has("action") => format!("ros2 action info {name}"),
        Some(name) => format!("rostopic info {name}; ros2 topic info -v {name}"),
        None => "ua-space list".to_owned(),
    }
}

/// Returns whether drops for a reason lose nothing: repetitions for late joiners, and values that
/// the mapping leaves out.
#[must_use]
pub fn is_intended_drop(reason: &str) -> bool {
    INTENDED.contains(&reason)
}

const INTENDED: [&str; 4] = ["repeat", "unchanged", "outpaced", "not_asked"];
const MOST_REASONS: usize = 64;
const LONGEST_REASON: usize = 400;

#[cfg(test)]
mod tests {
    use super::*;

    fn program(status: Value) -> ProgramStatus {
        ProgramStatus {
            source: "this program".to_owned(),
            status: Ok(status),
        }
    }

    #[test]
    fn a_row_has_the_reason_and_the_command_that_helps() {
        let row = program(json!({
            "program": "bridge-ros1", "space": 1,
            "not_ready": ["no ROS master answers at http://localhost:11311"],
            "waiting_for": ["topic /start: no publisher"],
            "mapping": { "hash": "0011" },
        }))
        .row();
        assert_eq!(row["state"], "down");
        assert_eq!(
            row["problems"][0]["help"],
            "echo $ROS_MASTER_URI; rosnode list"
        );
        assert_eq!(
            row["waiting"][0]["help"],
            "rostopic info /start; ros2 topic info -v /start"
        );
        assert_eq!(row["hash"], "0011");
    }

    #[test]
    fn a_program_without_reasons_is_ready_and_one_that_does_not_answer_is_down() {
        let ready = program(json!({ "program": "ua-server", "not_ready": [], "waiting_for": [] }));
        assert_eq!(
            (ready.row()["state"].clone(), ready.is_ready()),
            (json!("ready"), true)
        );
        let waiting = program(json!({ "not_ready": [], "waiting_for": ["space 2: no publisher"] }));
        assert_eq!(waiting.row()["state"], "waiting");
        let gone = ProgramStatus {
            source: "http://127.0.0.1:9101".to_owned(),
            status: Err("connection refused".to_owned()),
        };
        assert_eq!(gone.row()["state"], "down");
        assert_eq!(gone.row()["problems"][0]["text"], "connection refused");
    }

    #[test]
    fn counters_are_per_topic_and_in_total() {
        let bridge = program(json!({ "topics": {
            "ua_1_2_10": { "sent": 4, "delivered": 0, "dropped": { "full": 2, "repeat": 9 } },
            "ua_1_2_11": { "sent": 3, "delivered": 1, "dropped": {} },
        }}));
        assert_eq!(bridge.total("sent"), 7);
        let counts = bridge.counts("ua_1_2_10").unwrap();
        assert_eq!((counts.sent, counts.dropped.get("full")), (4, Some(&2)));
        assert_eq!(counts.dropped.get("repeat"), None);
        assert_eq!(bridge.counts("ua_1_2_12"), None);
    }
}
