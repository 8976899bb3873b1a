//! `ua-space skills`: shows the skills of all components with their states.
//!
//! Reading order: this module (received states, and the list), `info`, `start`, `watch`.

mod info;
mod start;
mod types;
mod watch;

pub(crate) use types::types;

use std::collections::BTreeMap;
use std::io::{self, Write as _};
use std::time::{Duration, Instant};

use mappings::{SpaceId, TopicId};
use serde::Serialize;
use uadp::MessageKind;

use super::book::{Book, DatagramContent, NameKind};
use super::described::{AnnouncedDescription, AnnouncedField};
use super::names::fitting;
use super::plain::{self, NamedValues};
use super::text::{TextTable, age, harmless, is_coloured, json};
use super::{Go, ListenEnd, Live, in_group, until};
use crate::arguments::{GroupArguments, ListSkills, Skills, SkillsVerb};
use crate::exit::CommandFailure;

/// The suffix of the name of a state, after `<component>.<skill>`.
const STATE: &str = ".State";
/// The suffix of the name of the result of the last run.
const RESULT: &str = ".Result";

/// Methods of a skill, in the order of their identifiers.
const METHODS: [&str; 5] = ["Start", "Halt", "Suspend", "Resume", "Reset"];

/// Runs `ua-space skills`.
pub(crate) fn skills(arguments: &Skills) -> Result<(), CommandFailure> {
    match &arguments.verb {
        None => list(&arguments.list),
        Some(SkillsVerb::List(arguments)) => list(arguments),
        Some(SkillsVerb::Info(arguments)) => info::info(arguments),
        Some(SkillsVerb::Start(arguments)) => start::start(arguments),
        Some(SkillsVerb::Watch(arguments)) => watch::watch(arguments),
    }
}

fn list(arguments: &ListSkills) -> Result<(), CommandFailure> {
    in_group(&arguments.group, async |mut live| {
        let (mut found, _) = hear(&mut live, arguments.seconds, &|_| false).await?;
        if let Some(what) = &arguments.what {
            let (meant, others): (Vec<Skill>, Vec<Skill>) = found
                .into_iter()
                .partition(|skill| watch::is_meant(&skill.name(), Some(what)));
            if meant.is_empty() && !others.is_empty() {
                return Err(info::not_found(what, &others, arguments.seconds));
            }
            found = meant;
        }
        let mut out = io::stdout().lock();
        if arguments.json {
            writeln!(out, "{}", json(&found)?)?;
        } else if found.is_empty() {
            writeln!(
                out,
                "no skills were heard in {} for {} s",
                live.group(),
                arguments.seconds
            )?;
        } else {
            table(&found).write(&mut out, is_coloured())?;
        }
        live.tell_dropped();
        Ok(())
    })
}

/// Listens for `seconds`, or until `enough` returns true.
async fn hear(
    live: &mut Live,
    seconds: f64,
    enough: &dyn Fn(&[Skill]) -> bool,
) -> Result<(Vec<Skill>, ListenEnd), CommandFailure> {
    live.want_calls([0]);
    let mut states = States::default();
    let end = until(live.now(), Some(seconds));
    loop {
        let next = (live.now() + LOOK).min(end);
        let each = &mut |news: DatagramContent<'_>, _| {
            states.take(&news);
            Go::On
        };
        let ended = live.listen(next, each).await?;
        let found = find(&live.book, &states, live.now());
        if ended == ListenEnd::Interrupted || live.now() >= end || enough(&found) {
            return Ok((found, ended));
        }
    }
}

/// Returns the names that `call` accepts and that are received within a short time: skills, calls
/// and topics.
pub(crate) fn heard_names(group: &GroupArguments) -> Result<HeardNames, CommandFailure> {
    in_group(group, async |mut live| {
        live.want_all();
        let (found, _) = hear(&mut live, FOR_NAMES, &|_| false).await?;
        let mut components: Vec<String> =
            found.iter().map(|skill| skill.component.clone()).collect();
        components.dedup();
        let calls = live.book.calls();
        let named = calls.map(|(_, described)| described.name.clone());
        Ok(HeardNames {
            components: components.clone(),
            skills: found.iter().map(Skill::name).collect(),
            types: found
                .iter()
                .filter_map(|skill| skill.type_name.clone())
                .collect(),
            calls: named.filter(|name| !name.is_empty()).collect(),
            topics: live
                .book
                .topics()
                .map(|(topic, _)| topic.to_string())
                .collect(),
            names: live
                .book
                .announced()
                .flat_map(|(_, _, described, _)| described.names())
                .map(str::to_owned)
                .collect(),
            values: names_of_values(&live.book, |_, _| true),
            written: names_of_values(&live.book, |topic, name| {
                topic.space == SpaceId::UA && !components.iter().any(|one| is_of(name, one))
            }),
        })
    })
}

/// Returns the names of the values for which `is_wanted` returns true.
fn names_of_values(book: &Book, is_wanted: impl Fn(TopicId, &str) -> bool) -> Vec<String> {
    let values = book.announced();
    let values = values.filter(|(topic, kind, described, _)| {
        *kind == NameKind::Value && is_wanted(*topic, &described.name)
    });
    let names = values.flat_map(|(_, _, described, _)| described.names());
    names.map(str::to_owned).collect()
}

/// Returns whether the name is the name of a value of the component. Only the component writes it.
fn is_of(name: &str, component: &str) -> bool {
    let rest = name.strip_prefix(component);
    rest.is_some_and(|rest| rest.starts_with('.'))
}

/// Names received in a space.
#[derive(Debug, Default)]
pub(crate) struct HeardNames {
    pub(crate) components: Vec<String>,
    pub(crate) skills: Vec<String>,
    /// The names of skill types.
    pub(crate) types: Vec<String>,
    pub(crate) calls: Vec<String>,
    pub(crate) topics: Vec<String>,
    /// The names of values and calls, and the ROS topics.
    pub(crate) names: Vec<String>,
    /// The names of values and their ROS topics.
    pub(crate) values: Vec<String>,
    /// The names of values that `write` can write.
    pub(crate) written: Vec<String>,
}

/// The last states and results of skills.
#[derive(Default)]
struct States(BTreeMap<TopicId, NamedValues>);

impl States {
    /// Stores a state or result. A value received before its name is recognized by its identifier.
    fn take(&mut self, news: &DatagramContent<'_>) {
        let DatagramContent::Sample(sample) = news else {
            return;
        };
        let described = sample.described.as_deref();
        let may_be = match described {
            Some(described) => [STATE, RESULT]
                .iter()
                .any(|end| described.name.ends_with(end)),
            None => [STATE_ID, RESULT_ID].contains(&(sample.topic.identifier.get() % 100)),
        };
        let has_room = self.0.len() < MOST || self.0.contains_key(&sample.topic);
        if may_be
            && has_room
            && sample.message.kind == MessageKind::KeyFrame
            && let Ok(state) = plain::message(&sample.message, described)
        {
            self.0.insert(sample.topic, state);
        }
    }

    /// Returns the state or result of a skill, with the names known at this time.
    fn of(&self, topic: TopicId, described: &AnnouncedDescription) -> Option<NamedValues> {
        let mut state = self.0.get(&topic)?.clone();
        state.rename(described.fields());
        Some(state)
    }
}

/// A skill in the list.
#[derive(Debug, Serialize)]
struct Skill {
    component: String,
    skill: String,
    #[serde(rename = "type")]
    type_name: Option<String>,
    type_namespace: Option<String>,
    /// The topic of the state.
    topic: String,
    state: Option<String>,
    run: Option<u64>,
    progress: Option<f64>,
    step: Option<String>,
    /// Seconds since the last state.
    age_s: f64,
    /// The topic of each method.
    calls: BTreeMap<&'static str, String>,
    /// The parameters of Start, in one line.
    takes: Option<String>,
    /// The result of the last run.
    #[serde(skip)]
    result: Option<NamedValues>,
    /// The parameters of Start.
    #[serde(skip)]
    parameters: Vec<AnnouncedField>,
}

impl Skill {
    /// Returns the name that `call` accepts.
    fn name(&self) -> String {
        format!("{}.{}", self.component, self.skill)
    }
}

/// Returns the skill with a name, or with a name that ends with it; `None` if there is none.
///
/// # Errors
/// Several skills have such a name.
fn chosen<'s>(found: &'s [Skill], wanted: &str) -> Result<Option<&'s Skill>, CommandFailure> {
    let names: Vec<String> = found.iter().map(Skill::name).collect();
    let known: Vec<(&str, Vec<&str>)> = names
        .iter()
        .map(|name| (name.as_str(), vec![name.as_str()]))
        .collect();
    let mut fit = fitting(&known, wanted);
    fit.dedup();
    match fit.as_slice() {
        [] => Ok(None),
        [one] => Ok(found.iter().find(|skill| skill.name() == *one)),
        several => Err(CommandFailure::Usage(format!(
            "{} is the name of {} skills\n  = help: give one of {}",
            harmless(wanted),
            several.len(),
            harmless(&several.join(", "))
        ))),
    }
}

/// Whether the skills that were heard may be all with a name that ends in the wanted one.
struct SkillName<'a> {
    wanted: &'a str,
    start: Instant,
}

impl<'a> SkillName<'a> {
    #[expect(clippy::disallowed_methods, reason = "the one read of this clock")]
    fn new(wanted: &'a str) -> Self {
        Self {
            wanted,
            start: Instant::now(),
        }
    }

    /// Returns the skill; `None` if it was not heard, others may follow, or there are several.
    fn of<'s>(&self, found: &'s [Skill]) -> Option<&'s Skill> {
        let skill = chosen(found, self.wanted).ok()??;
        (skill.name() == self.wanted || self.start.elapsed() >= SETTLE).then_some(skill)
    }
}

fn find(book: &Book, states: &States, now: Duration) -> Vec<Skill> {
    // The key includes the space and namespace of the state, because two components may have the
    // same name.
    let mut calls: BTreeMap<(u16, u16, String), _> = BTreeMap::new();
    for (topic, described) in book.calls() {
        let (space, namespace, _) = topic.triple();
        calls.insert(
            (space, namespace, described.name.clone()),
            (topic, described),
        );
    }
    let skills = book.topics().filter_map(|(topic, heard)| {
        let described = book.described(topic)?;
        let name = described.name.strip_suffix(STATE)?;
        let (component, skill) = name.rsplit_once('.')?;
        let (space, namespace, _) = topic.triple();
        let of = |method: &str| calls.get(&(space, namespace, format!("{name}.{method}")));
        let state = states.of(topic, described);
        let state = state.as_ref();
        let text = |field: &str| state.and_then(|state| state.text(field));
        let skill_type = described.skill_type();
        let result = result_of(topic).and_then(|topic| {
            let described = book.described(topic)?;
            states.of(topic, described)
        });
        let start = of("Start").and_then(|(_, start)| start.call());
        Some(Skill {
            component: component.to_owned(),
            skill: skill.to_owned(),
            type_name: skill_type.map(|(name, _)| name.to_owned()),
            type_namespace: skill_type.map(|(_, namespace)| namespace.to_owned()),
            topic: topic.to_string(),
            state: text("state").map(str::to_owned),
            run: state.and_then(|state| state.number("run")),
            progress: state.and_then(|state| state.get("progress")?.as_f64()),
            step: text("step").map(str::to_owned),
            age_s: now.saturating_sub(heard.last).as_secs_f64(),
            calls: METHODS
                .into_iter()
                .filter_map(|method| Some((method, of(method)?.0.to_string())))
                .collect(),
            takes: start.map(|start| format!("({})", super::described::list(&start.request))),
            result,
            parameters: start.map(|start| start.request.clone()).unwrap_or_default(),
        })
    });
    let mut skills: Vec<Skill> = skills.collect();
    skills.sort_by(|a, b| {
        (&a.component, &a.topic, &a.skill).cmp(&(&b.component, &b.topic, &b.skill))
    });
    skills
}

/// Returns the topic of the result from the topic of the state.
fn result_of(state: TopicId) -> Option<TopicId> {
    let (space, namespace, id) = state.triple();
    TopicId::new(space, namespace, id.checked_add(RESULT_ID - STATE_ID)?)
}

const HEAD: [&str; 6] = ["COMPONENT", "SKILL", "TYPE", "STATE", "RUN", "CALL"];

fn table(skills: &[Skill]) -> TextTable {
    let mut table = TextTable::new(HEAD.map(str::to_owned)).yielding([5, 2]);
    for skill in skills {
        let dash = || "-".to_owned();
        let silent = Duration::try_from_secs_f64(skill.age_s).unwrap_or_default();
        let state = skill.state.clone().unwrap_or_else(dash);
        let state = if silent > SILENT {
            format!("{state} {} ago", age(silent))
        } else {
            state
        };
        let call = skill.calls.get("Start").map(|topic| {
            let takes = skill.takes.as_deref().unwrap_or_default();
            format!("{topic} {takes}")
        });
        table.row([
            skill.component.clone(),
            skill.skill.clone(),
            skill.type_name.clone().unwrap_or_else(dash),
            state,
            skill.run.map_or_else(dash, |run| run.to_string()),
            call.unwrap_or_else(dash),
        ]);
    }
    table
}

/// The period in which each component that runs repeats its states, with a margin.
const SETTLE: Duration = Duration::from_millis(1_500);
/// Offset of the state among the identifiers of a skill.
const STATE_ID: u16 = 1;
/// Offset of the result.
const RESULT_ID: u16 = 4;
/// The interval at which the received skills are checked.
const LOOK: Duration = Duration::from_millis(100);
/// Time in which every skill sends its state, in seconds.
const FOR_NAMES: f64 = 1.3;
/// Maximum number of stored states.
const MOST: usize = 4096;
/// Three times the interval at which states are repeated.
const SILENT: Duration = Duration::from_secs(3);
