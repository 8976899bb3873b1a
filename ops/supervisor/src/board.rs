//! The board: the last value of each topic, with its description, rate and delays.
//!
//! Pure: times are parameters. The board is bounded in topics and bytes, because any host of the
//! group can publish.

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;
use std::time::Duration;

use bridge_node::{CallDescription, CallField};
use bytes::Bytes;
use mappings::{Mapping, NodeIdText, SpaceId, TopicId, Variable};
use uadp::Timestamp;

use crate::announced::AnnouncedValue;
use crate::hops::ShownHops;
use crate::mes::MesClient;
use crate::operations::ConditionState;
use crate::program::ProgramStatus;
use crate::timeline::{CallMessage, Timeline};
use crate::value;

/// The time of an event on both clocks.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct EventTime {
    /// The time since the start of the page.
    pub(crate) since: Duration,
    /// The time of the day.
    pub(crate) utc: Timestamp,
}

/// A received value.
#[derive(Debug, Clone, Copy)]
pub(crate) struct BoardSample<'a> {
    pub(crate) topic: TopicId,
    /// The block of fields.
    pub(crate) block: &'a Bytes,
    /// The time at which the producer's bridge took the value.
    pub(crate) source: Option<Timestamp>,
    /// The upper half of the StatusCode.
    pub(crate) status: u16,
}

/// All that the page knows of the cell.
#[derive(Debug, Default)]
pub(crate) struct CellBoard {
    pub(crate) topics: BTreeMap<TopicId, TopicEntry>,
    /// The calls that can be requested, and whether this program executes them itself.
    pub(crate) calls: BTreeMap<TopicId, (Arc<CallDescription>, bool)>,
    pub(crate) programs: Vec<ProgramStatus>,
    /// The events of values and calls.
    pub(crate) timeline: Timeline,
    /// The conditions of the program, if it has any; read while a browser shows them.
    pub(crate) conditions: Option<Vec<ConditionState>>,
    /// The number of values of topics for which there was no room.
    pub(crate) left_out: u64,
    mapping: Option<Arc<Mapping>>,
    /// The topics in the order of their names; rebuilt after a change of names.
    order: Vec<TopicId>,
    is_ordered: bool,
    watched: BTreeMap<TopicId, Watched>,
    /// The delays of the samples of watched topics.
    pub(crate) hops: BTreeMap<TopicId, ShownHops>,
    probed: BTreeMap<TopicId, u8>,
}

/// A topic with its last value.
#[derive(Debug)]
pub(crate) struct TopicEntry {
    pub(crate) description: AnnouncedValue,
    /// The ROS topics by the mapping: the space and the name.
    pub(crate) ros: Vec<(SpaceId, String)>,
    /// The unit by the mapping.
    unit: Option<&'static str>,
    /// The node and the field of a value that operators may write.
    pub(crate) writable: Option<Arc<(NodeIdText, CallField)>>,
    pub(crate) block: Bytes,
    pub(crate) status: u16,
    pub(crate) source: Option<Timestamp>,
    pub(crate) received: Option<Duration>,
    pub(crate) is_silent: bool,
    pub(crate) count: u64,
    /// Increased by each change.
    pub(crate) version: u64,
    pub(crate) rate: Rate,
    pub(crate) spark: VecDeque<f32>,
    sparked: Duration,
    pub(crate) delays: DelayClasses,
    /// The samples dropped by all programs, by reason.
    pub(crate) dropped: BTreeMap<String, u64>,
    /// The name in lower case, for filters.
    pub(crate) folded: String,
}

/// The number of values in each of the last seconds.
#[derive(Debug, Default)]
pub(crate) struct Rate {
    second: u64,
    /// The current second first.
    counts: [u32; RATE_SECONDS + 1],
}

/// The delays from the producer's bridge to this program, in classes of powers of two.
#[derive(Debug, Default)]
pub(crate) struct DelayClasses {
    /// Class `n` counts delays of 2^n to 2^(n+1) microseconds; class 0 also shorter delays.
    pub(crate) classes: [u32; DELAY_CLASSES],
    /// Delays below zero, which result from clocks that differ.
    pub(crate) negative: u64,
    pub(crate) last_us: Option<f64>,
}

/// The last samples of a topic that a browser shows.
#[derive(Debug, Default)]
struct Watched {
    until: Duration,
    samples: VecDeque<KeptSample>,
}

/// A kept sample.
#[derive(Debug, Clone)]
pub(crate) struct KeptSample {
    pub(crate) at: Timestamp,
    pub(crate) delay_us: Option<f64>,
    pub(crate) status: u16,
    pub(crate) line: String,
}

impl CellBoard {
    /// Takes the names and bindings of a mapping.
    pub(crate) fn map(&mut self, mapping: &Arc<Mapping>) {
        self.mapping = Some(Arc::clone(mapping));
        for variable in mapping.variables() {
            self.entry(variable.topic);
        }
        let mapping = Arc::clone(mapping);
        for (topic, entry) in &mut self.topics {
            entry.map(*topic, &mapping);
            entry.version += 1;
        }
        self.is_ordered = false;
    }

    /// Takes a value.
    pub(crate) fn take(&mut self, sample: BoardSample<'_>, at: EventTime) {
        let BoardSample {
            topic,
            block,
            source,
            status,
        } = sample;
        let Some(entry) = self.entry(topic) else {
            self.left_out += 1;
            return;
        };
        let has_changed = entry.count == 0 || entry.block != *block || entry.status != status;
        let delay = entry.update(sample, at);
        let Self {
            topics, timeline, ..
        } = self;
        let is_event = has_changed || timeline.is_behind(topic);
        if is_event && let Some(entry) = topics.get(&topic) {
            timeline.value(topic, entry, at);
        }
        if let Some(watched) = self.watched.get_mut(&topic) {
            if watched.samples.len() >= MOST_SAMPLES {
                watched.samples.pop_front();
            }
            let names = self.topics.get(&topic);
            let names = names.map_or(&[][..], |entry| &entry.description.fields);
            watched.samples.push_back(KeptSample {
                at: source.unwrap_or(at.utc),
                delay_us: delay,
                status,
                line: value::line(block, names),
            });
        }
    }

    /// Takes a description that was received in clear. In a secured namespace it is ignored,
    /// because any host can send it.
    pub(crate) fn announce(&mut self, topic: TopicId, description: AnnouncedValue) {
        let (_, namespace, _) = topic.triple();
        let mapping = self.mapping.as_deref();
        if mapping.is_none_or(|mapping| mapping.group_of(namespace).is_none()) {
            self.describe(topic, description);
        }
    }

    /// Takes the description of a topic.
    pub(crate) fn describe(&mut self, topic: TopicId, description: AnnouncedValue) {
        let Some(entry) = self.entry(topic) else {
            return;
        };
        if entry.description != description {
            entry.description = description;
            entry.version += 1;
            entry.fold(topic);
            self.is_ordered = false;
        }
    }

    /// Notes that a topic is silent, or is received again.
    pub(crate) fn set_silent(&mut self, topic: TopicId, is_silent: bool) {
        if let Some(entry) = self.topics.get_mut(&topic) {
            entry.is_silent = is_silent;
            entry.version += 1;
        }
    }

    /// Takes a request or response that was received in clear.
    pub(crate) fn called(&mut self, call: CallMessage, at: EventTime) {
        self.timeline.call(call, at);
    }

    /// Returns the participant, the name and the world of each topic with events.
    pub(crate) fn event_names(&self) -> serde_json::Value {
        self.timeline.names(|topic| match self.calls.get(&topic) {
            Some((call, _)) => call.name.clone(),
            None => {
                let entry = self.topics.get(&topic);
                entry.map_or_else(|| topic.to_string(), |entry| entry.name(topic))
            }
        })
    }

    /// Takes a call; `is_own` if this program executes it.
    pub(crate) fn offer(&mut self, topic: TopicId, call: &Arc<CallDescription>, is_own: bool) {
        let has_room = self.calls.len() < MOST_CALLS || self.calls.contains_key(&topic);
        if has_room {
            self.calls.insert(topic, (Arc::clone(call), is_own));
        }
    }

    /// Removes a call.
    pub(crate) fn withdraw(&mut self, topic: TopicId) {
        self.calls.remove(&topic);
    }

    /// Returns the MES, if its status was read.
    pub(crate) fn mes(&self) -> Option<MesClient> {
        let is_mes =
            |program: &&ProgramStatus| program.status.as_ref().is_ok_and(MesClient::is_status);
        let program = self.programs.iter().find(is_mes)?;
        program.source.parse().ok().map(MesClient::new)
    }

    /// Takes the status of all programs.
    pub(crate) fn set_programs(&mut self, programs: Vec<ProgramStatus>) {
        for (topic, entry) in &mut self.topics {
            let name = topic.to_string();
            let mut dropped = BTreeMap::new();
            for counts in programs.iter().filter_map(|program| program.counts(&name)) {
                for (reason, count) in counts.dropped {
                    *dropped.entry(reason).or_default() += count;
                }
            }
            if entry.dropped != dropped {
                entry.dropped = dropped;
                entry.version += 1;
            }
        }
        self.programs = programs;
    }

    /// Returns the topics in the order of their names.
    pub(crate) fn ordered(&mut self) -> &[TopicId] {
        if !self.is_ordered || self.order.len() != self.topics.len() {
            let mut order: Vec<(&str, TopicId)> = self
                .topics
                .iter()
                .map(|(topic, entry)| (entry.folded.as_str(), *topic))
                .collect();
            order.sort_unstable();
            self.order = order.into_iter().map(|(_, topic)| topic).collect();
            self.is_ordered = true;
        }
        &self.order
    }

    /// Keeps the samples of a topic for some seconds, and returns the kept samples, newest first.
    pub(crate) fn watch(&mut self, topic: TopicId, now: Duration) -> Vec<KeptSample> {
        self.watched.retain(|_, watched| watched.until > now);
        let has_room = self.watched.len() < MOST_WATCHED || self.watched.contains_key(&topic);
        if !has_room {
            return Vec::new();
        }
        let watched = self.watched.entry(topic).or_default();
        watched.until = now + WATCHED_FOR;
        watched.samples.iter().rev().cloned().collect()
    }

    /// Returns the topics that browsers show.
    pub(crate) fn watched(&self, now: Duration) -> Vec<TopicId> {
        let watched = self.watched.iter();
        let watched = watched.filter(|(_, watched)| watched.until > now);
        watched.map(|(topic, _)| *topic).collect()
    }

    /// Returns topics with values and without a description, each at most a few times.
    pub(crate) fn nameless(&mut self) -> Vec<TopicId> {
        let mut asked = Vec::new();
        for (topic, entry) in &self.topics {
            let is_nameless = entry.description == AnnouncedValue::default();
            if entry.count == 0 || !is_nameless {
                continue;
            }
            let times = self.probed.entry(*topic).or_default();
            if *times < MOST_PROBES {
                *times += 1;
                asked.push(*topic);
            }
            if asked.len() >= PROBED_TOGETHER {
                break;
            }
        }
        asked
    }

    fn entry(&mut self, topic: TopicId) -> Option<&mut TopicEntry> {
        if !self.topics.contains_key(&topic) {
            if self.topics.len() >= MOST_TOPICS {
                return None;
            }
            self.topics
                .insert(topic, TopicEntry::new(topic, self.mapping.as_deref()));
            self.is_ordered = false;
        }
        self.topics.get_mut(&topic)
    }
}

impl TopicEntry {
    fn new(topic: TopicId, mapping: Option<&Mapping>) -> Self {
        let mut entry = Self {
            description: AnnouncedValue::default(),
            ros: Vec::new(),
            unit: None,
            writable: None,
            block: Bytes::new(),
            status: 0,
            source: None,
            received: None,
            is_silent: false,
            count: 0,
            version: 1,
            rate: Rate::default(),
            spark: VecDeque::new(),
            sparked: Duration::ZERO,
            delays: DelayClasses::default(),
            dropped: BTreeMap::new(),
            folded: String::new(),
        };
        if let Some(mapping) = mapping {
            entry.map(topic, mapping);
        }
        entry.fold(topic);
        entry
    }

    fn map(&mut self, topic: TopicId, mapping: &Mapping) {
        let Some(variable) = mapping.variable(topic) else {
            return;
        };
        let bindings = variable.bindings.iter();
        self.ros = bindings
            .map(|binding| (binding.space, binding.ros_topic.clone()))
            .collect();
        self.unit = variable.meaning.unit.map(|unit| unit.symbol);
        self.writable = writable(variable).map(Arc::new);
        if self.description.name.is_empty() {
            self.description.name.clone_from(&variable.name);
        }
        if let Some(about) = &variable.meaning.description {
            self.description.about.clone_from(about);
        }
        if self.description.type_name.is_empty() {
            let first = variable.bindings.first();
            self.description.type_name =
                first.map_or_else(String::new, |binding| binding.message_type.to_string());
        }
        if self.description.fields.is_empty() {
            let fields = variable.fields.iter().map(|leaf| leaf.path.clone());
            self.description.fields = fields.collect();
        }
        self.fold(topic);
    }

    /// Returns the name for people: the display name, the ROS topic, or the topic of the space.
    pub(crate) fn name(&self, topic: TopicId) -> String {
        let ros = self.ros.first().map(|(_, name)| name.as_str());
        match (self.description.name.as_str(), ros) {
            ("", Some(ros)) => ros.to_owned(),
            ("", None) => topic.to_string(),
            (name, _) => name.to_owned(),
        }
    }

    pub(crate) fn unit(&self) -> &str {
        self.unit.unwrap_or(&self.description.unit)
    }

    fn fold(&mut self, topic: TopicId) {
        let mut folded = self.name(topic).to_lowercase();
        folded.push(' ');
        folded.push_str(&topic.to_string());
        for (_, ros) in &self.ros {
            folded.push(' ');
            folded.push_str(&ros.to_lowercase());
        }
        self.folded = folded;
    }

    /// Takes a value. Returns its delay in microseconds.
    fn update(&mut self, sample: BoardSample<'_>, at: EventTime) -> Option<f64> {
        let delay = sample
            .source
            .map(|source| at.utc.unix_nanos() - source.unix_nanos());
        let delay = delay.and_then(|nanos| self.delays.record(nanos));
        // A view of a large buffer would keep the whole buffer in memory.
        self.block = if sample.block.len() <= LARGEST_BLOCK {
            sample.block.clone()
        } else {
            Bytes::new()
        };
        self.status = sample.status;
        self.source = sample.source;
        self.received = Some(at.since);
        self.is_silent = false;
        self.count += 1;
        self.version += 1;
        self.rate.count(at.since);
        if self.spark.is_empty() || at.since >= self.sparked + SPARK_EVERY {
            self.sparked = at.since;
            if let Some(number) = value::number(&self.block) {
                if self.spark.len() >= MOST_SPARKS {
                    self.spark.pop_front();
                }
                #[expect(clippy::cast_possible_truncation, reason = "a point of a drawing")]
                self.spark.push_back(number as f32);
            }
        }
        delay
    }
}

impl Rate {
    fn count(&mut self, now: Duration) {
        self.advance(now.as_secs());
        if let Some(first) = self.counts.first_mut() {
            *first = first.saturating_add(1);
        }
    }

    fn advance(&mut self, second: u64) {
        let passed = second.saturating_sub(self.second);
        let passed = usize::try_from(passed).unwrap_or(usize::MAX);
        let passed = passed.min(self.counts.len());
        self.counts.rotate_right(passed % (RATE_SECONDS + 1));
        for count in self.counts.iter_mut().take(passed) {
            *count = 0;
        }
        self.second = self.second.max(second);
    }

    /// Returns the mean rate of the last full seconds.
    pub(crate) fn hz(&mut self, now: Duration) -> f64 {
        self.advance(now.as_secs());
        let full = self.counts.get(1..).unwrap_or_default();
        let seconds = now.as_secs().clamp(1, RATE_SECONDS as u64);
        let total: u32 = full.iter().sum();
        #[expect(clippy::cast_precision_loss, reason = "at most five")]
        let seconds = seconds as f64;
        f64::from(total) / seconds
    }
}

impl DelayClasses {
    /// Counts a delay. Returns it in microseconds, unless it is negative.
    fn record(&mut self, nanos: i128) -> Option<f64> {
        let Ok(nanos) = u64::try_from(nanos) else {
            self.negative += 1;
            return None;
        };
        let micros = nanos / 1000;
        let class = usize::try_from(micros.checked_ilog2().unwrap_or(0)).unwrap_or_default();
        if let Some(count) = self.classes.get_mut(class.min(DELAY_CLASSES - 1)) {
            *count = count.saturating_add(1);
        }
        #[expect(clippy::cast_precision_loss, reason = "a delay shown to people")]
        let micros = nanos as f64 / 1000.0;
        self.last_us = Some(micros);
        Some(micros)
    }
}

/// Returns the node and the field of a variable that operators may write: one field of the OPC UA
/// side. Commands with a reaction to the loss of their client are left to OPC UA clients, because a
/// browser that is closed is not noticed in time.
fn writable(variable: &Variable) -> Option<(NodeIdText, CallField)> {
    let (builtin, is_array) = variable.value_type?;
    let is_own = variable.topic.space == SpaceId::UA && variable.from.is_none();
    if !is_own || variable.loss.is_some() {
        return None;
    }
    let field = if is_array {
        CallField::array("value", builtin)
    } else {
        CallField::scalar("value", builtin)
    };
    Some((variable.node.clone(), field))
}

/// Returns the quality of a status for people, and its severity.
pub(crate) fn quality(status: u16, is_silent: bool) -> (&'static str, &'static str) {
    if is_silent {
        return ("bad", "no data");
    }
    match status >> 14 {
        0 => ("good", "Good"),
        1 => ("uncertain", "Uncertain"),
        _ => ("bad", bad(status)),
    }
}

/// Returns the name of common Bad codes.
const fn bad(status: u16) -> &'static str {
    match status {
        0x8005 => "Bad, communication error",
        0x800A => "Bad, timeout",
        0x8031 => "Bad, no communication",
        0x8032 => "Bad, waiting for initial data",
        _ => "Bad",
    }
}

const MOST_TOPICS: usize = 16_384;
const MOST_CALLS: usize = 4_096;
/// Larger values are shown without their content.
const LARGEST_BLOCK: usize = 16 << 10;
const RATE_SECONDS: usize = 5;
const DELAY_CLASSES: usize = 28;
const SPARK_EVERY: Duration = Duration::from_millis(500);
const MOST_SPARKS: usize = 40;
const MOST_SAMPLES: usize = 24;
const MOST_WATCHED: usize = 32;
const WATCHED_FOR: Duration = Duration::from_secs(10);
const MOST_PROBES: u8 = 3;
const PROBED_TOGETHER: usize = 64;

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    pub(crate) fn at(millis: u64) -> EventTime {
        let nanos = 1_700_000_000_000_000_000 + i128::from(millis) * 1_000_000;
        EventTime {
            since: Duration::from_millis(millis),
            utc: Timestamp::from_unix_nanos(nanos),
        }
    }

    pub(crate) fn topic(text: &str) -> TopicId {
        text.parse().unwrap()
    }

    /// Takes a Double that was sent 2 ms before.
    pub(crate) fn take(board: &mut CellBoard, of: TopicId, number: f64, millis: u64) {
        let mut block = vec![1, 0, 11];
        block.extend(number.to_le_bytes());
        let sent = Timestamp::from_unix_nanos(at(millis).utc.unix_nanos() - 2_000_000);
        let sample = BoardSample {
            topic: of,
            block: &block.into(),
            source: Some(sent),
            status: 0,
        };
        board.take(sample, at(millis));
    }

    #[test]
    fn the_rate_is_the_mean_of_full_seconds() {
        let mut board = CellBoard::default();
        let one = topic("ua_1_2_10");
        for millis in (0..6000).step_by(100) {
            take(&mut board, one, 1.0, millis);
        }
        let entry = board.topics.get_mut(&one).unwrap();
        assert!((entry.rate.hz(at(6000).since) - 10.0).abs() < 1e-9);
        assert!(entry.rate.hz(at(20_000).since).abs() < 1e-9);
        assert_eq!(entry.count, 60);
        assert_eq!(entry.spark.len(), 12);
    }

    #[test]
    fn delays_are_counted_in_classes_and_negative_delays_apart() {
        let mut board = CellBoard::default();
        let one = topic("ua_1_2_10");
        take(&mut board, one, 1.0, 10);
        let early = BoardSample {
            topic: one,
            block: &Bytes::from_static(&[0, 0]),
            source: Some(at(5000).utc),
            status: 0x8000,
        };
        board.take(early, at(20));
        let entry = &board.topics[&one];
        // 2000 microseconds are between 2^10 and 2^11.
        assert_eq!(entry.delays.classes[10], 1);
        assert_eq!(entry.delays.negative, 1);
        assert_eq!(quality(entry.status, false).0, "bad");
    }

    #[test]
    fn the_number_of_topics_is_bounded_and_the_rest_is_counted() {
        let mut board = CellBoard::default();
        for id in 1..=u16::MAX {
            let of = TopicId::new(2, 5, id).unwrap();
            board.take(
                BoardSample {
                    topic: of,
                    block: &Bytes::new(),
                    source: None,
                    status: 0,
                },
                at(0),
            );
        }
        assert_eq!(board.topics.len(), MOST_TOPICS);
        assert_eq!(board.left_out, u64::from(u16::MAX) - 16_384);
    }

    #[test]
    fn samples_are_kept_while_a_browser_shows_the_topic() {
        let mut board = CellBoard::default();
        let one = topic("ua_1_2_10");
        take(&mut board, one, 1.0, 0);
        assert!(board.watch(one, at(0).since).is_empty());
        for millis in 1..100 {
            take(&mut board, one, 2.0, millis);
        }
        let kept = board.watch(one, at(100).since);
        assert_eq!(kept.len(), MOST_SAMPLES);
        assert_eq!(kept[0].line, "2");
        board.watch(topic("ua_1_2_11"), at(20_000).since);
        assert!(!board.watched.contains_key(&one));
    }

    #[test]
    fn topics_are_in_the_order_of_their_names() {
        let mut board = CellBoard::default();
        let (a, b) = (topic("ua_1_2_10"), topic("ua_1_2_11"));
        take(&mut board, a, 1.0, 0);
        take(&mut board, b, 1.0, 0);
        assert_eq!(board.ordered(), [a, b]);
        let named = AnnouncedValue {
            name: "zone".to_owned(),
            ..AnnouncedValue::default()
        };
        board.describe(a, named);
        assert_eq!(board.ordered(), [b, a]);
        assert_eq!(board.nameless(), [b]);
    }

    #[test]
    fn drops_of_all_programs_are_added_up() {
        let mut board = CellBoard::default();
        let one = topic("ua_1_2_10");
        take(&mut board, one, 1.0, 0);
        let program = |count: u64| ProgramStatus {
            source: String::new(),
            status: Ok(serde_json::json!({
                "topics": { "ua_1_2_10": { "dropped": { "full": count } } }
            })),
        };
        board.set_programs(vec![program(2), program(3)]);
        assert_eq!(board.topics[&one].dropped.get("full"), Some(&5));
    }
}
