//! The views of the page. A browser receives only the view that it shows.

use std::collections::HashMap;
use std::time::Duration;

use mappings::{SpaceId, TopicId};
use serde_json::{Map, Value, json};

use crate::board::{CellBoard, TopicEntry, quality};
use crate::mes::MesClient;
use crate::operations;
use crate::program::ProgramStatus;
use crate::skill;
use crate::value;

/// The query of an event stream names no view.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub(crate) enum ViewFault {
    #[error("{key}={text}: a number is wanted")]
    Number { key: &'static str, text: String },
    #[error("topic={0}: a topic is wanted, as ua_1_2_10")]
    Topic(String),
    #[error(
        "view={0}: there are programs, values, topic, map, skills, processes, knowledge, alarms \
         and events"
    )]
    View(String),
}

/// The view that a browser shows.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum BrowserView {
    /// The programs.
    Programs,
    /// A window of the list of values.
    Values(Window),
    /// A single topic.
    Topic(TopicId),
    /// The map of the cell.
    Map,
    /// The skills.
    Skills,
    /// The processes of the MES.
    Processes,
    /// The knowledge of the MES, which the browser requests itself.
    Knowledge,
    /// The conditions of the server.
    Alarms,
    /// The events of values and calls over time.
    Events,
}

/// The visible rows of the list of values.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(crate) struct Window {
    from: usize,
    count: usize,
    /// In lower case.
    filter: String,
    only_bad: bool,
}

/// A browser: its view, and the contents that were sent to it. Intermediate states are never
/// queued: the next event is made of the state at the time at which the browser takes it.
#[derive(Debug)]
pub(crate) struct Viewer {
    view: BrowserView,
    /// The sent version of each visible row.
    sent: HashMap<TopicId, u64>,
    order: Vec<TopicId>,
    total: usize,
    last: String,
    sent_at: Option<Duration>,
    /// The number of the last event that was sent.
    event: u64,
}

impl BrowserView {
    /// Parses the query of the event stream, as `view=values&from=0&count=40`.
    ///
    /// # Errors
    /// Returns the fault of a parameter.
    pub(crate) fn parse(query: &str) -> Result<Self, ViewFault> {
        let pairs = pairs(query);
        let get = |key: &str| {
            let found = pairs.iter().find(|(name, _)| name == key);
            found.map(|(_, value)| value.as_str())
        };
        let number = |key: &'static str, default: usize| match get(key) {
            None => Ok(default),
            Some(text) => text.parse().map_err(|_| ViewFault::Number {
                key,
                text: text.to_owned(),
            }),
        };
        Ok(match get("view").unwrap_or_default() {
            "programs" => Self::Programs,
            "values" => Self::Values(Window {
                from: number("from", 0)?,
                count: number("count", 50)?.min(MOST_ROWS),
                filter: value::cut(get("filter").unwrap_or_default(), 100).to_lowercase(),
                only_bad: get("only") == Some("bad"),
            }),
            "topic" => {
                let topic = get("topic").unwrap_or_default();
                let fault = |_| ViewFault::Topic(topic.to_owned());
                Self::Topic(topic.parse().map_err(fault)?)
            }
            "map" => Self::Map,
            "skills" => Self::Skills,
            "processes" => Self::Processes,
            "knowledge" => Self::Knowledge,
            "alarms" => Self::Alarms,
            "events" => Self::Events,
            other => return Err(ViewFault::View(other.to_owned())),
        })
    }

    /// Returns the period of events.
    pub(crate) const fn period(&self) -> Duration {
        match self {
            Self::Programs | Self::Map | Self::Processes | Self::Knowledge => {
                Duration::from_secs(1)
            }
            Self::Values(_) | Self::Topic(_) | Self::Skills | Self::Alarms | Self::Events => {
                Duration::from_millis(250)
            }
        }
    }
}

impl Viewer {
    pub(crate) fn new(view: BrowserView) -> Self {
        Self {
            view,
            sent: HashMap::new(),
            order: Vec::new(),
            total: 0,
            last: String::new(),
            sent_at: None,
            event: 0,
        }
    }

    /// Returns whether the browser shows the conditions.
    pub(crate) fn shows_conditions(&self) -> bool {
        self.view == BrowserView::Alarms
    }

    /// Returns the next event of the stream; `None` if nothing visible has changed.
    pub(crate) fn next(&mut self, board: &mut CellBoard, now: Duration) -> Option<String> {
        let data = match &self.view {
            BrowserView::Values(window) => {
                let window = window.clone();
                self.values(&window, board, now)
            }
            BrowserView::Programs => self.changed(programs(board)),
            BrowserView::Topic(topic) => {
                let shown = topic_view(board, *topic, now);
                self.changed(shown)
            }
            BrowserView::Map => self.changed(map(board, now)),
            BrowserView::Skills => {
                let shown = json!({ "skills": skill::all(board), "calls": skill::calls(board) });
                self.changed(shown)
            }
            BrowserView::Processes => self.changed(processes(board)),
            BrowserView::Knowledge => {
                // The state is known when the programs were read for the first time.
                let is_known = !board.programs.is_empty();
                self.changed(json!({ "mes": is_known.then(|| board.mes().is_some()) }))
            }
            BrowserView::Events => {
                let names = board.event_names();
                let text = names.to_string();
                let is_renamed = text != self.last;
                let is_new = board.timeline.last() > self.event || self.sent_at.is_none();
                (is_new || is_renamed).then(|| {
                    let mut shown = board.timeline.after(self.event, now);
                    if let Some(shown) = shown.as_object_mut().filter(|_| is_renamed) {
                        shown.insert("names".to_owned(), names);
                    }
                    self.event = board.timeline.last();
                    self.last = text;
                    shown.to_string()
                })
            }
            BrowserView::Alarms => self.changed(operations::alarms(board.conditions.as_deref())),
        };
        match data {
            Some(data) => {
                self.sent_at = Some(now);
                Some(format!("event: view\ndata: {data}\n\n"))
            }
            None => {
                let is_due = self.sent_at.is_none_or(|sent| now >= sent + ALIVE);
                is_due.then(|| {
                    self.sent_at = Some(now);
                    "event: alive\ndata: {}\n\n".to_owned()
                })
            }
        }
    }

    /// Returns the JSON unless it was sent last.
    fn changed(&mut self, shown: Value) -> Option<String> {
        let text = shown.to_string();
        if text == self.last {
            return None;
        }
        self.last.clone_from(&text);
        Some(text)
    }

    fn values(&mut self, window: &Window, board: &mut CellBoard, now: Duration) -> Option<String> {
        board.ordered();
        let all: Vec<TopicId> = board.ordered().to_vec();
        let matching = all.into_iter().filter(|topic| {
            board.topics.get(topic).is_some_and(|entry| {
                let is_bad = !window.only_bad || quality(entry.status, entry.is_silent).0 != "good";
                is_bad && (window.filter.is_empty() || entry.folded.contains(&window.filter))
            })
        });
        let mut total = 0;
        let mut visible = Vec::new();
        for topic in matching {
            if total >= window.from && visible.len() < window.count {
                visible.push(topic);
            }
            total += 1;
        }
        let mut rows = Map::new();
        for topic in &visible {
            let Some(entry) = board.topics.get_mut(topic) else {
                continue;
            };
            if self.sent.get(topic) != Some(&entry.version) {
                self.sent.insert(*topic, entry.version);
                rows.insert(topic.to_string(), row(*topic, entry, now));
            }
        }
        let is_same = visible == self.order && total == self.total;
        if is_same && rows.is_empty() && self.sent_at.is_some() {
            return None;
        }
        self.sent.retain(|topic, _| visible.contains(topic));
        let mut shown = json!({
            "total": total, "topics": board.topics.len(), "from": window.from, "rows": rows,
            "left_out": board.left_out,
        });
        if !is_same || self.sent_at.is_none() {
            let order: Vec<String> = visible.iter().map(ToString::to_string).collect();
            if let Some(shown) = shown.as_object_mut() {
                shown.insert("order".to_owned(), json!(order));
            }
            (self.order, self.total) = (visible, total);
        }
        Some(shown.to_string())
    }
}

/// Returns a row of the list of values.
fn row(topic: TopicId, entry: &mut TopicEntry, now: Duration) -> Value {
    let hz = entry.rate.hz(now);
    let (severity, text) = quality(entry.status, entry.is_silent);
    let has_value = entry.count > 0;
    let line = if has_value {
        value::line(&entry.block, &entry.description.fields)
    } else {
        "–".to_owned()
    };
    let (severity, text) = if has_value {
        (severity, text)
    } else {
        ("none", "never received")
    };
    json!({
        "name": entry.name(topic),
        "value": line,
        "unit": entry.unit(),
        "severity": severity,
        "quality": text,
        "age_ms": entry.received.map(|at| millis(now.saturating_sub(at))),
        "hz": hz,
        "spark": entry.spark,
        "ros": ros(entry),
        "type": entry.description.type_name,
        "drops": entry.dropped,
    })
}

fn ros(entry: &TopicEntry) -> Vec<String> {
    let all = entry.ros.iter();
    all.map(|(space, name)| format!("{} {name}", world(*space)))
        .collect()
}

/// Returns the name of a space for people.
pub(crate) fn world(space: SpaceId) -> String {
    match space {
        SpaceId::UA => "OPC UA".to_owned(),
        SpaceId::ROS1 => "ROS 1".to_owned(),
        SpaceId { .. } if space.get() == 2 => "ROS 2".to_owned(),
        space => format!("ROS 2 ({space})"),
    }
}

fn programs(board: &CellBoard) -> Value {
    let rows: Vec<Value> = board.programs.iter().map(|program| program.row()).collect();
    let known: Vec<&str> = board
        .programs
        .iter()
        .filter_map(|program| program.status.as_ref().ok())
        .filter_map(|status| status.get("program")?.as_str())
        .collect();
    // The applications of the group that the other rows do not cover.
    let mut heard = Map::new();
    for program in &board.programs {
        let status = program.status.as_ref().ok();
        let all = status.and_then(|status| status.get("applications")?.as_array());
        for application in all.into_iter().flatten() {
            let text = |key: &str| application.get(key).and_then(Value::as_str);
            let name = text("name").or_else(|| text("uri")).unwrap_or_default();
            if !known.iter().any(|known| name.starts_with(known)) {
                heard.insert(name.to_owned(), application.clone());
            }
        }
    }
    let heard: Vec<&Value> = heard.values().collect();
    json!({ "programs": rows, "heard": heard, "topics": board.topics.len(), "calls": board.calls.len() })
}

fn topic_view(board: &mut CellBoard, topic: TopicId, now: Duration) -> Value {
    let samples: Vec<Value> = board
        .watch(topic, now)
        .iter()
        .map(|kept| {
            json!({
                "ms": i64::try_from(kept.at.unix_nanos() / 1_000_000).unwrap_or_default(),
                "delay_us": kept.delay_us,
                "severity": quality(kept.status, false).0,
                "value": kept.line,
            })
        })
        .collect();
    let text = topic.to_string();
    let (mut publishers, mut subscribers) = (Vec::new(), Vec::new());
    for program in &board.programs {
        let Some(counts) = program.counts(&text) else {
            continue;
        };
        let known = json!({
            "program": program.name(), "space": program.space(), "source": program.source,
            "sent": counts.sent, "delivered": counts.delivered, "dropped": counts.dropped,
        });
        if counts.sent > 0 {
            publishers.push(known.clone());
        }
        if counts.delivered > 0 || !counts.dropped.is_empty() {
            subscribers.push(known);
        }
    }
    let hops = topic_hops(board, topic);
    let why = why(board, topic);
    let Some(entry) = board.topics.get_mut(&topic) else {
        return json!({ "topic": text, "known": false, "why": why, "hops": hops });
    };
    let fields = if entry.block.is_empty() {
        Vec::new()
    } else {
        value::fields(&entry.block, &entry.description.fields).unwrap_or_default()
    };
    let row = row(topic, entry, now);
    json!({
        "topic": text,
        "known": true,
        "row": row,
        "about": entry.description.about,
        "origin": world(topic.space),
        "from": entry.description.from.map(|from| from.to_string()),
        "fields": fields,
        "write": entry.writable.as_deref().map(|(_, field)| skill::field(field)),
        "samples": samples,
        "delays": { "classes": entry.delays.classes, "negative": entry.delays.negative, "last_us": entry.delays.last_us },
        "publishers": publishers,
        "subscribers": subscribers,
        "hops": hops,
        "why": why,
    })
}

/// Returns the delays of the topic at each program. A program that does not report its steps has
/// the delays of all its topics.
fn topic_hops(board: &CellBoard, topic: TopicId) -> Vec<Value> {
    let tapped = board.hops.get(&topic);
    let of_topic = |program: &ProgramStatus| {
        let spaces = tapped?.get(&program.source)?;
        let hops = spaces.get(&program.space()?).cloned();
        Some(hops.unwrap_or_else(|| json!({})))
    };
    let programs = board.programs.iter().filter_map(|program| {
        let of_topic = of_topic(program);
        let is_of_topic = of_topic.is_some();
        let hops = of_topic.or_else(|| program.hops().cloned())?;
        Some(json!({
            "program": program.name(), "space": program.space(), "hops": hops, "of_topic": is_of_topic,
        }))
    });
    programs.collect()
}

/// Returns the reasons why a value is missing, most likely first; empty if it is received.
fn why(board: &CellBoard, topic: TopicId) -> Vec<String> {
    let entry = board.topics.get(&topic);
    let is_received = entry
        .is_some_and(|entry| entry.count > 0 && quality(entry.status, entry.is_silent).0 == "good");
    let mut reasons = Vec::new();
    if !is_received {
        let ros: Vec<&str> = entry
            .map(|entry| entry.ros.iter().map(|(_, name)| name.as_str()).collect())
            .unwrap_or_default();
        for program in &board.programs {
            for peer in program.waiting_for() {
                if ros.iter().any(|name| peer.contains(name)) || peer.contains(&topic.to_string()) {
                    reasons.push(format!("{} waits for {peer}", program.name()));
                }
            }
        }
        let serves =
            |program: &&ProgramStatus| program.space() == Some(u64::from(topic.space.get()));
        let mut serving = board.programs.iter().filter(serves).peekable();
        if serving.peek().is_none() && topic.space != SpaceId::UA {
            reasons.push(format!(
                "no status of a program for {} is known: start its bridge, or name its status with --status URL",
                world(topic.space)
            ));
        }
        for program in serving.filter(|program| !program.is_ready()) {
            reasons.push(format!("{} is not ready", program.name()));
        }
        match entry {
            None => reasons.push("no message of this topic was received in the group".to_owned()),
            Some(entry) if entry.count == 0 => {
                reasons.push("the mapping names it, and no value was received yet".to_owned());
            }
            Some(entry) if entry.is_silent => reasons.push(
                "values were received before, and none within the receive timeout".to_owned(),
            ),
            Some(entry) if entry.status != 0 => {
                reasons.push(format!(
                    "its publisher sends the status 0x{:04X}0000 ({})",
                    entry.status,
                    quality(entry.status, false).1
                ));
            }
            Some(_) => {}
        }
    }
    if let Some(entry) = entry {
        for (reason, count) in &entry.dropped {
            reasons.push(format!("{count} samples dropped: {reason}"));
        }
    }
    reasons
}

/// Returns the map of the cell: the rates from each world to the space and back.
fn map(board: &mut CellBoard, now: Duration) -> Value {
    let mut worlds: Map<String, Value> = Map::new();
    let mut spaces: Vec<SpaceId> = board.topics.keys().map(|topic| topic.space).collect();
    let served = board.programs.iter().filter_map(|program| {
        let space = u16::try_from(program.space()?).ok()?;
        SpaceId::new(space)
    });
    spaces.extend(served);
    spaces.extend([
        SpaceId::UA,
        SpaceId::ROS1,
        SpaceId::new(2).unwrap_or(SpaceId::UA),
    ]);
    spaces.sort_unstable();
    spaces.dedup();
    for space in spaces {
        let (mut hz, mut topics, mut silent) = (0.0, 0_usize, 0_usize);
        let of = board
            .topics
            .iter_mut()
            .filter(|(topic, _)| topic.space == space);
        for (_, entry) in of {
            hz += entry.rate.hz(now);
            topics += 1;
            // Events may never have been sent.
            silent += usize::from(entry.count > 0 && entry.is_silent);
        }
        let programs: Vec<&ProgramStatus> = board
            .programs
            .iter()
            .filter(|program| program.space() == Some(u64::from(space.get())))
            .collect();
        let reasons: Vec<String> = programs
            .iter()
            .filter(|program| !program.is_ready())
            .map(|program| format!("{} is not ready", program.name()))
            .collect();
        let names: Vec<&str> = programs.iter().map(|program| program.name()).collect();
        let delivered: u64 = programs
            .iter()
            .map(|program| program.total("delivered"))
            .sum();
        let dropped: u64 = board
            .topics
            .iter()
            .filter(|(topic, _)| topic.space == space)
            .flat_map(|(_, entry)| entry.dropped.values())
            .sum();
        worlds.insert(
            space.to_string(),
            json!({
                "label": world(space), "programs": names, "topics": topics, "silent": silent,
                "hz": (hz * 10.0).round() / 10.0, "delivered": delivered, "dropped": dropped,
                "problems": reasons,
            }),
        );
    }
    json!({ "worlds": worlds })
}

/// Returns the processes and runs of the MES.
fn processes(board: &CellBoard) -> Value {
    let mes = board.programs.iter().find_map(|program| {
        let status = program.status.as_ref().ok()?;
        MesClient::is_status(status).then_some(status)
    });
    match mes {
        None => json!({ "mes": false }),
        Some(status) => json!({
            "mes": true,
            "processes": status.get("processes"),
            "runs": status.get("runs"),
        }),
    }
}

/// Splits a query into its decoded pairs.
pub(crate) fn pairs(query: &str) -> Vec<(String, String)> {
    let pairs = query.split('&').take(MOST_PAIRS);
    pairs
        .filter(|pair| !pair.is_empty())
        .map(|pair| {
            let (key, value) = pair.split_once('=').unwrap_or((pair, ""));
            (decoded(key), decoded(value))
        })
        .collect()
}

/// Decodes `%41` and `+`.
fn decoded(text: &str) -> String {
    let mut bytes = text.bytes();
    let mut out = Vec::with_capacity(text.len());
    while let Some(byte) = bytes.next() {
        match byte {
            b'+' => out.push(b' '),
            b'%' => {
                let mut rest = bytes.clone();
                let digits = [rest.next(), rest.next()]
                    .map(|digit| char::from(digit.unwrap_or_default()).to_digit(16));
                match digits {
                    [Some(high), Some(low)] => {
                        out.push(u8::try_from(high * 16 + low).unwrap_or_default());
                        bytes = rest;
                    }
                    _ => out.push(byte),
                }
            }
            byte => out.push(byte),
        }
    }
    String::from_utf8_lossy(&out).into_owned()
}

fn millis(duration: Duration) -> u64 {
    u64::try_from(duration.as_millis()).unwrap_or(u64::MAX)
}

/// A browser shows no more rows than this.
const MOST_ROWS: usize = 200;
const MOST_PAIRS: usize = 16;
/// An event is sent at least this often, so that the page notices a lost connection.
const ALIVE: Duration = Duration::from_secs(5);

#[cfg(test)]
mod tests;
