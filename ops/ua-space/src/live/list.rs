//! The topics and calls of a group, as shown by `ua-space list` and `ua-space info`.

use std::collections::BTreeMap;
use std::io::{self, Write as _};
use std::time::Duration;

use mappings::{SpaceId, TopicId};
use serde::Serialize;
use uadp::StatusCode;

use super::book::{Book, DatagramContent, NameKind, TopicValues};
use super::described::{AnnouncedDescription, AnnouncedField, DescribedKind, ShownField};
use super::names::unknown;
use super::text::{TextTable, age, harmless, json, width, wrapped};
use super::{Go, Live, in_group, until};
use crate::arguments::InfoArguments;
use crate::exit::CommandFailure;
use crate::status;

/// Runs `ua-space info`.
pub(crate) fn info(arguments: &InfoArguments) -> Result<(), CommandFailure> {
    in_group(&arguments.group, async |mut live| {
        let end = until(live.now(), Some(arguments.seconds));
        let mut ignored = |_: DatagramContent<'_>, _| Go::On;
        let target = (&arguments.target, None);
        let Some(topic) = live.resolve(target, end, &mut ignored).await? else {
            return Err(unknown(&live, &arguments.target, arguments.seconds));
        };
        live.listen(end, &mut ignored).await?;
        let lines = lines(&live.book, live.now());
        let Some(line) = lines.iter().find(|line| line.topic == topic) else {
            return Err(unheard(&live, topic, arguments.seconds));
        };
        let mut out = io::stdout().lock();
        if arguments.json {
            writeln!(out, "{}", json(&line.shown())?)?
        } else {
            out.write_all(line.told().as_bytes())?
        }
        Ok(())
    })
}

/// Returns the failure for a topic that was not received.
pub(super) fn unheard(live: &Live, topic: TopicId, seconds: f64) -> CommandFailure {
    let group = live.group();
    let heard = live.book.topics().count();
    let announced = live.book.announced();
    let mut names = announced.filter(|(of, ..)| *of == topic);
    let name = names.find_map(|(_, _, described, _)| described.names().next().map(harmless));
    let name = name.map(|name| format!(" ({name})")).unwrap_or_default();
    let what = format!("{topic}{name} was not heard in {group} for {seconds} s");
    let help = match heard {
        0 => "nothing else was heard either; is this the group and the interface (--address, --interface)?".to_owned(),
        1 => "one other topic was heard; `ua-space list` shows it".to_owned(),
        many => format!("{many} other topics were heard; `ua-space list` shows them"),
    };
    CommandFailure::Unavailable(format!("{what}\n  = help: {help}"))
}

/// A topic or call in the list.
pub(super) struct ListRow<'b> {
    pub(super) topic: TopicId,
    described: Option<&'b AnnouncedDescription>,
    heard: Option<&'b TopicValues>,
    pub(super) is_call: bool,
    from: String,
    /// Time since the last message.
    age: Option<Duration>,
    /// Values per second.
    rate: Option<f64>,
}

#[derive(Serialize)]
pub(super) struct ListJson<'l> {
    topic: String,
    kind: &'static str,
    space: u8,
    origin: &'static str,
    name: Option<&'l str>,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    ros_topics: Vec<RosTopic<'l>>,
    #[serde(rename = "type")]
    type_name: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    description: Option<&'l str>,
    #[serde(skip_serializing_if = "Option::is_none")]
    fields: Option<Vec<ShownField<'l>>>,
    #[serde(skip_serializing_if = "Option::is_none")]
    takes: Option<Vec<ShownField<'l>>>,
    #[serde(skip_serializing_if = "Option::is_none")]
    gives: Option<Vec<ShownField<'l>>>,
    values: u64,
    keep_alives: u64,
    rate_hz: Option<f64>,
    age_s: Option<f64>,
    /// The quality of the last value.
    #[serde(skip_serializing_if = "Option::is_none")]
    quality: Option<String>,
    secured: bool,
    sender: &'l str,
    sender_changed: u64,
}

#[derive(Serialize)]
struct RosTopic<'l> {
    space: u8,
    topic: &'l str,
}

pub(super) fn lines(book: &Book, now: Duration) -> Vec<ListRow<'_>> {
    let mut lines = BTreeMap::new();
    for (topic, heard) in book.topics() {
        let line = ListRow {
            topic,
            described: book.described(topic).map(AsRef::as_ref),
            heard: Some(heard),
            is_call: false,
            from: heard.from.to_string(),
            age: Some(now.saturating_sub(heard.last)),
            rate: rate(heard),
        };
        lines.insert((topic, false), line);
    }
    for (topic, kind, described, from) in book.announced() {
        let is_call = kind == NameKind::Call;
        lines.entry((topic, is_call)).or_insert_with(|| ListRow {
            topic,
            described: Some(described),
            heard: None,
            is_call,
            from: from.to_string(),
            age: None,
            rate: None,
        });
    }
    lines.into_values().collect()
}

#[expect(clippy::cast_precision_loss, reason = "a rate shown to people")]
fn rate(heard: &TopicValues) -> Option<f64> {
    let span = heard.last.saturating_sub(heard.first).as_secs_f64();
    let gaps = heard.values.checked_sub(1).filter(|gaps| *gaps > 0)?;
    (span > 0.0).then(|| gaps as f64 / span)
}

const HEAD: [&str; 9] = [
    "TOPIC",
    "NAME",
    "ROS TOPIC",
    "KIND",
    "ORIGIN",
    "RATE",
    "LAST",
    "QUALITY",
    "TYPE",
];

/// The columns that are shortened first: the type, the ROS topic and the name.
const YIELDING: [usize; 3] = [8, 2, 1];
/// The columns that a narrow table has not: the origin, which is the first number of the topic.
const SPARE: [usize; 1] = [4];

pub(super) fn table(lines: &[&ListRow<'_>]) -> TextTable {
    table_within(width(), lines)
}

/// Returns the table with whole types if it fits `limit`, or else with shorter forms of the types
/// that are too long.
fn table_within(limit: usize, lines: &[&ListRow<'_>]) -> TextTable {
    let whole = table_of(lines, usize::MAX);
    match whole.yielding_room(limit) {
        None => whole,
        Some(room) => table_of(lines, room),
    }
}

/// Returns the table with shorter forms of the types that have more than `longest` characters.
fn table_of(lines: &[&ListRow<'_>], longest: usize) -> TextTable {
    let mut table = TextTable::new(HEAD.map(str::to_owned))
        .yielding(YIELDING)
        .leaving_out(SPARE);
    for line in lines {
        let dash = || "-".to_owned();
        let quality = line.quality().filter(|quality| quality != GOOD);
        table.row([
            line.topic.to_string(),
            line.name().map_or_else(dash, str::to_owned),
            line.ros_topic().map_or_else(dash, str::to_owned),
            line.kind().to_owned(),
            origin(line.topic.space).to_owned(),
            line.rate.map_or_else(dash, |rate| format!("{rate:.1}/s")),
            line.age.map_or_else(dash, age),
            quality.unwrap_or_else(dash),
            line.type_within(longest).unwrap_or_else(dash),
        ]);
    }
    table.without_empty_columns()
}

/// Returns the name of a StatusCode, or its severity and number.
pub(super) fn quality_name(status: StatusCode) -> String {
    // The lower 16 bits are flags of the value.
    if let Some(name) = status::symbol(StatusCode(status.0 & 0xFFFF_0000)) {
        return name.to_owned();
    }
    let severity = match status.0 >> 30 {
        0 => GOOD,
        1 => "Uncertain",
        _ => "Bad",
    };
    format!("{severity} ({:#010x})", status.0)
}

const GOOD: &str = "Good";

pub(super) fn origin(space: SpaceId) -> &'static str {
    match space {
        SpaceId::UA => "OPC UA",
        SpaceId::ROS1 => "ROS 1",
        _ => "ROS 2",
    }
}

impl ListRow<'_> {
    const fn kind(&self) -> &'static str {
        if self.is_call { "call" } else { "value" }
    }

    /// Returns the display name.
    fn name(&self) -> Option<&str> {
        let name = self.described?.name.as_str();
        (!name.is_empty()).then_some(name)
    }

    /// Returns the ROS topic in the space of origin, or else the first ROS topic.
    fn ros_topic(&self) -> Option<&str> {
        let all = &self.described?.ros_topics;
        let own = all
            .iter()
            .find(|(space, _)| *space == self.topic.space.get());
        own.or_else(|| all.first()).map(|(_, topic)| topic.as_str())
    }

    /// Returns the quality of the last value.
    fn quality(&self) -> Option<String> {
        let heard = self
            .heard
            .filter(|heard| !heard.secured && heard.values > 0)?;
        Some(quality_name(heard.quality))
    }

    fn type_name(&self) -> Option<String> {
        self.type_within(usize::MAX)
    }

    /// Returns the type, or a shorter form of a type with more than `limit` characters.
    fn type_within(&self, limit: usize) -> Option<String> {
        if let Some(described) = self.described {
            return Some(described.summary_within(limit));
        }
        let heard = self.heard?;
        if heard.secured {
            return Some("(secured)".to_owned());
        }
        let (builtin, is_array) = heard.only?;
        let array = if is_array { "[]" } else { "" };
        Some(format!("{}{array}", builtin.name()))
    }

    pub(super) fn shown(&self) -> ListJson<'_> {
        fn shown(fields: &[AnnouncedField]) -> Vec<ShownField<'_>> {
            fields.iter().map(AnnouncedField::shown).collect()
        }
        let call = self.described.and_then(AnnouncedDescription::call);
        let fields = self.described.and_then(|described| match &described.what {
            DescribedKind::Value(fields) => Some(shown(fields)),
            DescribedKind::Call(_) => None,
        });
        let description = self
            .described
            .map(|described| described.description.as_str());
        let ros_topics = self.described.map(|described| &described.ros_topics);
        let ros_topics = ros_topics.into_iter().flatten();
        ListJson {
            ros_topics: ros_topics
                .map(|(space, topic)| RosTopic {
                    space: *space,
                    topic,
                })
                .collect(),
            quality: self.quality(),
            topic: self.topic.to_string(),
            kind: self.kind(),
            space: self.topic.space.get(),
            origin: origin(self.topic.space),
            name: self.name(),
            type_name: self.type_name(),
            description: description.filter(|text| !text.is_empty()),
            fields,
            takes: call.map(|call| shown(&call.request)),
            gives: call.map(|call| shown(&call.response)),
            values: self.heard.map_or(0, |heard| heard.values),
            keep_alives: self.heard.map_or(0, |heard| heard.keep_alives),
            rate_hz: self.rate,
            age_s: self.age.map(|age| age.as_secs_f64()),
            secured: self.heard.is_some_and(|heard| heard.secured),
            sender: &self.from,
            sender_changed: self.heard.map_or(0, |heard| heard.changed_hands),
        }
    }

    /// Returns all details, one per line.
    fn told(&self) -> String {
        let mut text = String::new();
        let mut line = |name: &str, value: &str| {
            let head = format!("{:<12} ", format!("{name}:"));
            text.push_str(&wrapped(&head, &harmless(value)));
        };
        line("topic", &self.topic.to_string());
        line("kind", self.kind());
        line("origin", origin(self.topic.space));
        if let Some(name) = self.name() {
            line("name", name);
        }
        let ros = self.described.map(|described| &described.ros_topics);
        for (space, topic) in ros.into_iter().flatten() {
            line("ROS topic", &format!("{topic} in space {space}"));
        }
        if let Some(described) = self.described.filter(|it| !it.description.is_empty()) {
            line("description", &described.description);
        }
        line(
            "type",
            &self
                .type_name()
                .unwrap_or_else(|| "not announced".to_owned()),
        );
        line("sender", &self.from);
        if let Some(heard) = self.heard {
            line("values", &heard.values.to_string());
            if let Some(quality) = self.quality() {
                line("quality", &quality);
            }
            if let Some(rate) = self.rate {
                line("rate", &format!("{rate:.1}/s"));
            }
            if heard.changed_hands > 0 {
                let changed = format!(
                    "changed {} times: do two programs send it?",
                    heard.changed_hands
                );
                line("sender", &changed);
            }
        }
        let parts = match self.described.map(|described| &described.what) {
            None => Vec::new(),
            Some(DescribedKind::Value(fields)) => vec![("field", fields)],
            Some(DescribedKind::Call(call)) => {
                vec![("takes", &call.request), ("gives", &call.response)]
            }
        };
        for (what, fields) in parts {
            for field in fields {
                let about = [field.meaning(), field.description.clone()];
                let about: Vec<String> = about.into_iter().filter(|it| !it.is_empty()).collect();
                let about = match about.as_slice() {
                    [] => String::new(),
                    about => format!("  # {}", about.join(". ")),
                };
                line(what, &format!("{}: {}{about}", field.name, field.kind()));
            }
        }
        text
    }
}

#[cfg(test)]
mod tests {
    use uadp::BuiltinType;

    use super::super::described::DescribedCall;
    use super::*;

    fn call(response: &[&str]) -> AnnouncedDescription {
        let field = |name: &&str| AnnouncedField::plain(name, BuiltinType::Boolean, None);
        AnnouncedDescription {
            name: "Switch".to_owned(),
            what: DescribedKind::Call(DescribedCall {
                request: vec![field(&"on")],
                response: response.iter().map(field).collect(),
                targets: vec![1],
                action: None,
            }),
            description: String::new(),
            ros_topics: Vec::new(),
            command: false,
        }
    }

    /// Returns the table of calls in `limit` columns.
    fn shown(limit: usize, calls: &[AnnouncedDescription]) -> String {
        let rows: Vec<ListRow<'_>> = calls
            .iter()
            .map(|described| ListRow {
                topic: TopicId::new(1, 2, 10).unwrap(),
                described: Some(described),
                heard: None,
                is_call: true,
                from: String::new(),
                age: None,
                rate: None,
            })
            .collect();
        let rows: Vec<&ListRow<'_>> = rows.iter().collect();
        let mut out = Vec::new();
        let table = table_within(limit, &rows);
        table.write_within(limit, &mut out, false).unwrap();
        String::from_utf8(out).unwrap()
    }

    #[test]
    fn a_signature_is_shortened_only_if_the_table_is_too_narrow_for_it() {
        let whole = "(on: Boolean) -> (ok: Boolean)";
        let short = call(&["ok"]);
        // The other columns have 33 characters.
        let of = |limit| shown(limit, std::slice::from_ref(&short));
        for limit in [63, 80] {
            assert!(of(limit).contains(whole), "{}", of(limit));
        }
        assert!(of(62).contains("(1 field) -> (1 field)"), "{}", of(62));
        let both = shown(
            80,
            &[short.clone(), call(&["is_set", "is_running", "is_halted"])],
        );
        assert!(both.contains(whole), "{both}");
        assert!(both.contains("(1 field) -> (3 fields)"), "{both}");
    }
}
