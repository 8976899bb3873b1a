//! The events of the cell over time: changes of discrete values, states of skills, and calls.
//!
//! Pure: times are parameters. The timeline is bounded in events, in events of each topic per
//! second, and in requests and responses per second, because any host of the group can publish.

use std::collections::{BTreeMap, BTreeSet, VecDeque};

use mappings::{SpaceId, TopicId};
use serde_json::{Value, json};
use uadp::action::{ActionDialect, ActionKind, ActionState};
use uadp::{Fields, NetworkMessage, PublisherId, Scalar, Timestamp, Variant};

use crate::board::{EventTime, TopicEntry, quality};
use crate::value;

/// The last events, oldest first.
#[derive(Debug, Default)]
pub(crate) struct Timeline {
    events: VecDeque<Event>,
    /// The number of the last event.
    number: u64,
    /// Events that exceeded the limit of their topic.
    left_out: u64,
    topics: BTreeMap<TopicId, Last>,
    /// The topics with events.
    named: BTreeSet<TopicId>,
    /// The last requests and responses, because they are repeated.
    calls: VecDeque<CallMessage>,
    /// The second of the last requests and responses, and their number.
    called: (u64, u32),
    /// The time of the day at the start of the page, in milliseconds since 1970.
    start_ms: Option<i64>,
    /// The name of the recording with the shown events.
    recording: Option<String>,
}

/// The last event of a topic.
#[derive(Debug, Default)]
struct Last {
    text: String,
    /// The present text, if it exceeded the limit and is not shown.
    left_out: Option<String>,
    /// The second of the last events, and their number.
    second: u64,
    count: u32,
}

#[derive(Debug, Clone)]
struct Event {
    number: u64,
    topic: TopicId,
    kind: EventKind,
    text: String,
    severity: &'static str,
    /// The time at the producer, in milliseconds since 1970.
    ms: i64,
    /// The time from the producer to this program; `None` without a time of the producer.
    delay_us: Option<i64>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum EventKind {
    Value,
    State,
    Request,
    Response,
}

impl EventKind {
    const fn word(self) -> &'static str {
        match self {
            Self::Value => "value",
            Self::State => "state",
            Self::Request => "request",
            Self::Response => "response",
        }
    }
}

/// A request or response of a call.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct CallMessage {
    pub(crate) topic: TopicId,
    is_request: bool,
    id: u16,
    is_done: bool,
}

impl Timeline {
    /// Notes that the events come from a recording.
    pub(crate) fn set_recording(&mut self, name: &str) {
        self.recording = Some(name.to_owned());
    }

    /// Takes a value whose bytes have changed. Numbers with fractions and messages of several
    /// fields change continuously and are no events.
    pub(crate) fn value(&mut self, topic: TopicId, entry: &TopicEntry, at: EventTime) {
        let Some((kind, text)) = text_of(entry) else {
            return;
        };
        let last = self.topics.entry(topic).or_default();
        if last.text == text {
            if last.left_out.take().is_some() {
                self.left_out += 1;
            }
            return;
        }
        let second = at.since.as_secs();
        if last.second != second {
            (last.second, last.count) = (second, 0);
        }
        if last.count >= MOST_PER_SECOND {
            if last.left_out.as_ref() != Some(&text) {
                self.left_out += 1;
                last.left_out = Some(text);
            }
            return;
        }
        last.text.clone_from(&text);
        last.left_out = None;
        last.count += 1;
        let severity = match (quality(entry.status, false).0, kind) {
            ("good", EventKind::State) => of_state(&text),
            ("good", _) if text == "true" => "run",
            ("good", _) => "none",
            (other, _) => other,
        };
        let event = Event {
            number: 0,
            topic,
            kind,
            text,
            severity,
            ms: 0,
            delay_us: None,
        };
        self.push(event, entry.source, at);
    }

    /// Returns true if the present value of the topic exceeded the limit and is not shown. Its
    /// repetition is shown.
    pub(crate) fn is_behind(&self, topic: TopicId) -> bool {
        let last = self.topics.get(&topic);
        last.is_some_and(|last| last.left_out.is_some())
    }

    /// Takes a request or response. Repetitions are no events.
    pub(crate) fn call(&mut self, call: CallMessage, at: EventTime) {
        if self.calls.contains(&call) {
            return;
        }
        let second = at.since.as_secs();
        if self.called.0 != second {
            self.called = (second, 0);
        }
        if self.called.1 >= MOST_CALLS_PER_SECOND {
            self.left_out += 1;
            return;
        }
        self.called.1 += 1;
        if self.calls.len() >= MOST_CALLS {
            self.calls.pop_front();
        }
        self.calls.push_back(call);
        let (kind, text, severity) = match (call.is_request, call.is_done) {
            (true, _) => (EventKind::Request, "requested", "run"),
            (false, true) => (EventKind::Response, "answered", "good"),
            (false, false) => (EventKind::Response, "executing", "run"),
        };
        let event = Event {
            number: 0,
            topic: call.topic,
            kind,
            text: text.to_owned(),
            severity,
            ms: 0,
            delay_us: None,
        };
        self.push(event, None, at);
    }

    fn push(&mut self, mut event: Event, source: Option<Timestamp>, at: EventTime) {
        let arrived = at.utc.unix_nanos();
        let taken = source.map_or(arrived, Timestamp::unix_nanos);
        self.number += 1;
        event.number = self.number;
        event.ms = i64::try_from(taken / 1_000_000).unwrap_or_default();
        event.delay_us = source.and_then(|_| i64::try_from((arrived - taken) / 1000).ok());
        let since = i64::try_from(at.since.as_millis()).unwrap_or_default();
        let now = i64::try_from(arrived / 1_000_000).unwrap_or_default();
        self.start_ms = Some(now.saturating_sub(since));
        if self.events.len() >= MOST_EVENTS {
            self.events.pop_front();
        }
        if self.named.len() < MOST_NAMED {
            self.named.insert(event.topic);
        }
        self.events.push_back(event);
    }

    /// Returns the participant, the name and the world of each topic with events.
    pub(crate) fn names(&self, name_of: impl Fn(TopicId) -> String) -> Value {
        let named = self.named.iter().map(|topic| {
            let (lane, row) = participant(&name_of(*topic), topic.space);
            let world = crate::view::world(topic.space);
            (topic.to_string(), json!([lane, row, world]))
        });
        Value::Object(named.collect())
    }

    /// Returns the number of the last event.
    pub(crate) const fn last(&self) -> u64 {
        self.number
    }

    /// Returns the events after the event `seen`, and the time of the day at `now`.
    pub(crate) fn after(&self, seen: u64, now: std::time::Duration) -> Value {
        let since = i64::try_from(now.as_millis()).unwrap_or_default();
        let first = self.events.partition_point(|event| event.number <= seen);
        let events: Vec<Value> = self.events.iter().skip(first).map(Event::shown).collect();
        json!({
            "all": seen == 0,
            "now_ms": self.start_ms.map(|start| start.saturating_add(since)),
            "left_out": self.left_out,
            "recording": self.recording,
            "events": events,
        })
    }
}

impl Event {
    fn shown(&self) -> Value {
        json!({
            "id": self.number, "topic": self.topic.to_string(), "kind": self.kind.word(),
            "text": self.text, "severity": self.severity, "ms": self.ms, "delay_us": self.delay_us,
        })
    }
}

/// Returns the participant of a value or call, and the rest of the name: the first folder of the
/// name, or the world of a name without a folder.
fn participant(name: &str, space: SpaceId) -> (String, String) {
    let path = name.trim_start_matches('/');
    let folder = path.split_once('.').or_else(|| path.split_once('/'));
    match folder {
        Some((lane, row)) if !lane.is_empty() && !row.is_empty() => {
            (value::cut(lane, 60), value::cut(row, 60))
        }
        Some(_) | None => (crate::view::world(space), value::cut(name, 60)),
    }
}

/// Returns the kind and the text of a discrete value.
fn text_of(entry: &TopicEntry) -> Option<(EventKind, String)> {
    let names = &entry.description.fields;
    let has_state = names.iter().any(|name| name == "state");
    if has_state && entry.description.name.ends_with(STATE) {
        let shown = value::fields(&entry.block, names).ok()?;
        let state = shown.iter().find(|(name, _)| name == "state");
        let state = state.and_then(|(_, value)| value.as_str())?;
        return Some((EventKind::State, value::cut(state, LONGEST_TEXT)));
    }
    let mut fields = Fields::parse(&entry.block).ok()?;
    let first = fields.next()?.ok()?;
    if fields.next().is_some() {
        return None;
    }
    let Variant::Scalar(scalar) = first else {
        return None;
    };
    #[expect(
        clippy::wildcard_enum_match_arm,
        reason = "the other types are not discrete"
    )]
    let text = match scalar {
        Scalar::Boolean(value) => value.to_string(),
        Scalar::SByte(value) => value.to_string(),
        Scalar::Byte(value) => value.to_string(),
        Scalar::Int16(value) => value.to_string(),
        Scalar::UInt16(value) => value.to_string(),
        Scalar::Int32(value) => value.to_string(),
        Scalar::UInt32(value) => value.to_string(),
        Scalar::Int64(value) => value.to_string(),
        Scalar::UInt64(value) => value.to_string(),
        Scalar::String(Some(text)) => value::cut(text, LONGEST_TEXT),
        _ => return None,
    };
    Some((EventKind::Value, text))
}

/// Returns the severity of a state of a skill.
fn of_state(state: &str) -> &'static str {
    match state {
        "Running" | "Execute" | "Executing" | "Starting" | "Completing" => "run",
        "Suspended" | "Held" | "Paused" => "uncertain",
        "Aborted" | "Aborting" => "bad",
        _ => "none",
    }
}

/// Reads the requests and responses of a datagram in clear.
pub(crate) fn calls(message: &NetworkMessage<'_>) -> Vec<CallMessage> {
    if !message.is_action() || message.is_sealed() || message.is_chunk() {
        return Vec::new();
    }
    let Ok(actions) = message.actions(ActionDialect::Standard) else {
        return Vec::new();
    };
    let is_request = actions.header().kind == ActionKind::Request;
    let read = actions.filter_map(|action| {
        let action = action.ok()?;
        let PublisherId::UInt16(space) = action.publisher_id else {
            return None;
        };
        Some(CallMessage {
            topic: TopicId::new(space, action.writer_group_id?, action.writer_id)?,
            is_request,
            id: action.request_id,
            is_done: action.state == ActionState::Done,
        })
    });
    read.take(MOST_PER_DATAGRAM).collect()
}

/// The suffix of the name of the state of a skill.
const STATE: &str = ".State";
const MOST_EVENTS: usize = 2_000;
const MOST_NAMED: usize = 2_000;
/// Faster changes of a topic are counted and not shown.
const MOST_PER_SECOND: u32 = 5;
const MOST_CALLS: usize = 256;
/// Further requests and responses of all calls are counted and not shown.
const MOST_CALLS_PER_SECOND: u32 = 50;
const MOST_PER_DATAGRAM: usize = 16;
const LONGEST_TEXT: usize = 80;

#[cfg(test)]
mod tests {
    use bytes::Bytes;

    use super::*;
    use crate::announced::AnnouncedValue;
    use crate::board::tests::{at, topic};
    use crate::board::{BoardSample, CellBoard};

    fn named(board: &mut CellBoard, of: &str, name: &str, fields: &[&str]) {
        let description = AnnouncedValue {
            name: name.to_owned(),
            fields: fields.iter().map(|name| (*name).to_owned()).collect(),
            ..AnnouncedValue::default()
        };
        board.describe(topic(of), description);
    }

    /// Takes a block that was sent 3 ms before.
    fn take(board: &mut CellBoard, of: &str, block: &[u8], millis: u64) {
        let sent = Timestamp::from_unix_nanos(at(millis).utc.unix_nanos() - 3_000_000);
        let sample = BoardSample {
            topic: topic(of),
            block: &Bytes::copy_from_slice(block),
            source: Some(sent),
            status: 0,
        };
        board.take(sample, at(millis));
    }

    fn boolean(value: bool) -> [u8; 4] {
        [1, 0, 1, value.into()]
    }

    fn texts(board: &CellBoard) -> Vec<String> {
        let shown = board.timeline.after(0, at(0).since);
        let names = board.event_names();
        let events = shown["events"].as_array().unwrap().iter();
        let texts = events.map(|one| {
            let name = &names[one["topic"].as_str().unwrap()];
            let get = |value: &Value| value.as_str().unwrap_or_default().to_owned();
            format!("{} {} {}", get(&name[0]), get(&name[1]), get(&one["text"]))
        });
        texts.collect()
    }

    #[test]
    fn changes_of_discrete_values_are_events_of_their_participant() {
        let mut board = CellBoard::default();
        named(&mut board, "ua_1_2_10", "Conveyor.Running", &["data"]);
        for (millis, value) in [(0, true), (100, true), (2000, false), (3000, false)] {
            take(&mut board, "ua_1_2_10", &boolean(value), millis);
        }
        assert_eq!(
            texts(&board),
            ["Conveyor Running true", "Conveyor Running false"]
        );
        let shown = board.timeline.after(1, at(5000).since);
        assert_eq!(shown["events"].as_array().unwrap().len(), 1);
        assert_eq!(shown["events"][0]["delay_us"], 3000);
        assert_eq!(shown["events"][0]["ms"], 1_700_000_001_997_i64);
        assert_eq!(shown["now_ms"], 1_700_000_005_000_i64);
        assert_eq!(shown["all"], false);
        // A number with a fraction changes continuously.
        crate::board::tests::take(&mut board, topic("ua_1_2_11"), 1.5, 100);
        assert_eq!(board.timeline.last(), 2);
    }

    #[test]
    fn a_skill_has_an_event_for_each_state_but_not_for_its_progress() {
        let mut board = CellBoard::default();
        named(
            &mut board,
            "ua_2_2_11",
            "gripper.Grasp.State",
            &["state", "progress"],
        );
        let block = |state: &str, progress: f32| {
            let mut block = vec![2, 0, 12];
            block.extend(u32::try_from(state.len()).unwrap().to_le_bytes());
            block.extend(state.as_bytes());
            block.push(10);
            block.extend(progress.to_le_bytes());
            block
        };
        for (state, progress) in [("Ready", 0.0), ("Running", 0.1), ("Running", 0.5)] {
            take(&mut board, "ua_2_2_11", &block(state, progress), 0);
        }
        assert_eq!(
            texts(&board),
            ["gripper Grasp.State Ready", "gripper Grasp.State Running"]
        );
    }

    #[test]
    fn the_events_of_a_topic_are_limited_and_the_rest_is_counted() {
        let mut board = CellBoard::default();
        for number in 0..200_u8 {
            take(&mut board, "ua_1_2_10", &[1, 0, 3, number], 1000);
        }
        assert_eq!(board.timeline.last(), 5);
        assert_eq!(board.timeline.after(0, at(0).since)["left_out"], 195);
        for second in 2..3000_u64 {
            let number = u8::try_from(second % 250).unwrap();
            take(&mut board, "ua_1_2_10", &[1, 0, 3, number], second * 1000);
        }
        let shown = board.timeline.after(0, at(0).since);
        assert_eq!(shown["events"].as_array().unwrap().len(), MOST_EVENTS);
    }

    #[test]
    fn a_value_beyond_the_limit_is_shown_with_its_repetition() {
        let mut board = CellBoard::default();
        for number in 0..7_u8 {
            take(&mut board, "ua_1_2_10", &[1, 0, 3, number], 1000);
        }
        assert_eq!(board.timeline.last(), 5);
        for millis in [2000, 3000] {
            take(&mut board, "ua_1_2_10", &[1, 0, 3, 6], millis);
        }
        assert_eq!(board.timeline.last(), 6);
        assert_eq!(
            board.timeline.after(5, at(0).since)["events"][0]["text"],
            "6"
        );
        assert_eq!(board.timeline.after(0, at(0).since)["left_out"], 2);
    }

    #[test]
    fn requests_of_all_calls_are_limited_and_the_rest_is_counted() {
        let mut timeline = Timeline::default();
        for id in 0..200 {
            let call = CallMessage {
                topic: topic("ua_1_2_61"),
                is_request: true,
                id,
                is_done: false,
            };
            timeline.call(call, at(1000));
        }
        assert_eq!(timeline.last(), 50);
        assert_eq!(timeline.after(0, at(0).since)["left_out"], 150);
    }

    #[test]
    fn a_repeated_request_is_one_event() {
        let mut timeline = Timeline::default();
        let call = |is_request: bool, id: u16| CallMessage {
            topic: topic("ua_1_2_61"),
            is_request,
            id,
            is_done: !is_request,
        };
        for (is_request, id) in [(true, 1), (true, 1), (false, 1), (false, 1), (true, 2)] {
            timeline.call(call(is_request, id), at(10));
        }
        let shown = timeline.after(0, at(10).since);
        let events = shown["events"].as_array().unwrap();
        let kinds: Vec<&str> = events
            .iter()
            .filter_map(|one| one["kind"].as_str())
            .collect();
        assert_eq!(kinds, ["request", "response", "request"]);
        let names = timeline.names(|_| "Conveyor.switch".to_owned());
        assert_eq!(names["ua_1_2_61"], json!(["Conveyor", "switch", "ROS 1"]));
    }

    #[test]
    fn a_name_without_a_folder_belongs_to_its_world() {
        let of = |name: &str| participant(name, SpaceId::ROS1);
        assert_eq!(of("Light"), ("ROS 1".to_owned(), "Light".to_owned()));
        assert_eq!(of("/arm/state").0, "arm");
        assert_eq!(of("Arm.Left.Busy").1, "Left.Busy");
    }
}
