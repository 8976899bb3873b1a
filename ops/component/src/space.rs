//! The skills of a component as values and calls of the space. Skill k has the identifiers `100*k +
//! n`, value v has the identifier `10 + v`.

use std::collections::VecDeque;
use std::num::NonZeroU16;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use bridge_core::{CallDescription, CallField, CallRole, FieldNote, OfferedCall, ValueDescription};
use bridge_node::{PortEvent, Reason, now};
use bytes::Bytes;
use mappings::{Overflow, TopicId};
use messages::{ArrayRank, Leaf, TypeName};
use program::{ProgramMachineState, ProgramMethod};
use skills::server::value_status;
use skills::{
    Builtin, LiveValue, Parameters, RunOutcome, SkillDescription, SkillEvent, SkillObserver,
    SkillParameter, SkillSnapshot, SkillValue, Transitioned, ValueFacts,
};
use tokio::sync::Notify;
use tokio::time::Instant;
use uadp::{BuiltinType, Timestamp};

use crate::fields;

/// The values of a skill, by their identifiers.
pub(crate) const STATE: u16 = 1;
pub(crate) const EVENTS: u16 = 2;
pub(crate) const PARAMETERS: u16 = 3;
pub(crate) const RESULT: u16 = 4;
/// The methods of a skill, by their identifiers.
pub(crate) const CALLS: [(u16, ProgramMethod); 5] = [
    (5, ProgramMethod::Start),
    (6, ProgramMethod::Halt),
    (7, ProgramMethod::Suspend),
    (8, ProgramMethod::Resume),
    (9, ProgramMethod::Reset),
];

/// The goals of a skill as an action. The next four identifiers are its cancel, result, feedback
/// and status.
pub(crate) const GOAL: u16 = 10;

/// The location of a component in the space.
#[derive(Debug, Clone)]
pub(crate) struct ComponentPlace {
    /// The name of the component in the space.
    pub(crate) component: String,
    /// The namespace number of the component.
    pub(crate) namespace: u16,
    /// True if other hosts may use its calls.
    pub(crate) open: bool,
}

impl ComponentPlace {
    /// Returns the topic of a value or call of skill `number`. Returns `None` for namespace 0.
    pub(crate) fn topic(&self, number: u16, n: u16) -> Option<TopicId> {
        TopicId::new(
            0,
            self.namespace,
            number.checked_mul(PER_SKILL)?.checked_add(n)?,
        )
    }

    /// Returns the skill and the method of a topic.
    pub(crate) fn call(topic: TopicId) -> Option<(u16, ProgramMethod)> {
        let identifier = topic.identifier.get();
        let (number, n) = (identifier / PER_SKILL, identifier % PER_SKILL);
        let (_, method) = CALLS.into_iter().find(|(known, _)| *known == n)?;
        Some((number, method))
    }

    /// Returns the announcements of a skill with these methods, which precede its values.
    pub(crate) fn announce(
        &self,
        number: u16,
        facts: &SkillDescription,
        methods: &[ProgramMethod],
    ) -> Vec<PortEvent> {
        let mut events = Vec::new();
        for (n, description) in self.values(facts) {
            if let Some(topic) = self.topic(number, n) {
                events.push(PortEvent::Described { topic, description });
                events.push(PortEvent::Live { topic, live: true });
            }
        }
        for (n, method) in CALLS {
            if let Some(topic) = self.topic(number, n)
                && methods.contains(&method)
            {
                let description = self.method(facts, method);
                let open = self.open;
                events.push(PortEvent::Offer {
                    topic,
                    offered: OfferedCall { description, open },
                });
            }
        }
        events
    }

    /// Returns the topic of value `number` of the component.
    pub(crate) fn value(&self, number: u16) -> Option<TopicId> {
        let identifier = FIRST_VALUE.checked_add(number)?;
        let fits = identifier < PER_SKILL;
        fits.then(|| TopicId::new(0, self.namespace, identifier))?
    }

    /// Returns the announcement of a value.
    pub(crate) fn announce_value(&self, number: u16, facts: &ValueFacts) -> Vec<PortEvent> {
        let Some(topic) = self.value(number) else {
            return Vec::new();
        };
        let message = (!facts.shape.array).then(|| std_message(facts.shape.builtin));
        let description = ValueDescription {
            name: format!("{}.{}", self.component, facts.name),
            message_type: message.and_then(|name| TypeName::new("std_msgs", name).ok()),
            about: about_value(facts),
            fields: vec![Leaf {
                path: "data".to_owned(),
                builtin: fields::builtin(facts.shape.builtin),
                rank: fields::rank(facts.shape),
            }],
            overflow: Overflow::KeepLatest,
        };
        vec![
            PortEvent::Described { topic, description },
            PortEvent::Live { topic, live: true },
        ]
    }

    fn values(&self, facts: &SkillDescription) -> [(u16, ValueDescription); 4] {
        let name = |what: &str| format!("{}.{}.{what}", self.component, facts.name);
        let own_type = facts.types.first();
        let of_type = own_type
            .map(|of| format!("{} nsu={}", of.name, of.namespace))
            .unwrap_or_default();
        let described = |what: &str, message: &str, about: String, fields: Vec<Leaf>, overflow| {
            ValueDescription {
                name: name(what),
                message_type: TypeName::new("ua_msgs", message).ok(),
                about,
                fields,
                overflow,
            }
        };
        let (text, texts) = (
            (BuiltinType::String, ArrayRank::Scalar),
            (BuiltinType::String, ArrayRank::Array { fixed: None }),
        );
        let run = ("run", (BuiltinType::UInt32, ArrayRank::Scalar));
        let byte = (BuiltinType::Byte, ArrayRank::Scalar);
        let state = leaves([
            ("state", text),
            ("number", byte),
            ("last_transition", text),
            ("progress", (BuiltinType::Float, ArrayRank::Scalar)),
            ("step", text),
            run,
        ]);
        let event = leaves([
            ("transition", text),
            ("number", byte),
            ("from_state", text),
            ("to_state", text),
            run,
            ("message", text),
        ]);
        let parameters = leaves([run, ("names", texts), ("values", texts)]);
        let result = leaves([
            run,
            ("succeeded", (BuiltinType::Boolean, ArrayRank::Scalar)),
            ("message", text),
            ("names", texts),
            ("values", texts),
        ]);
        let queue = Overflow::DropOldest(NonZeroU16::MIN.saturating_add(QUEUED_EVENTS));
        [
            (
                STATE,
                described("State", "SkillState", of_type, state, Overflow::KeepLatest),
            ),
            (
                EVENTS,
                described("Events", "SkillEvent", String::new(), event, queue),
            ),
            (
                PARAMETERS,
                described(
                    "Parameters",
                    "SkillParameters",
                    String::new(),
                    parameters,
                    Overflow::KeepLatest,
                ),
            ),
            (
                RESULT,
                described(
                    "Result",
                    "SkillResult",
                    String::new(),
                    result,
                    Overflow::KeepLatest,
                ),
            ),
        ]
    }

    fn method(&self, facts: &SkillDescription, method: ProgramMethod) -> CallDescription {
        let request = match method {
            ProgramMethod::Start => facts
                .parameters
                .iter()
                .map(|parameter| {
                    let field = CallField {
                        rank: fields::rank(parameter.shape),
                        ..CallField::scalar(
                            &parameter.name,
                            fields::builtin(parameter.shape.builtin),
                        )
                    };
                    let field = field.with_note(note(parameter));
                    if parameter.default.is_some() {
                        field.optional()
                    } else {
                        field
                    }
                })
                .collect(),
            ProgramMethod::Suspend
            | ProgramMethod::Resume
            | ProgramMethod::Halt
            | ProgramMethod::Reset => Vec::new(),
        };
        CallDescription {
            name: format!("{}.{}.{method}", self.component, facts.name),
            about: format!(
                "{method} of {}",
                facts.types.first().map_or("a skill", |of| of.name.as_str())
            ),
            role: CallRole::Call,
            request,
            response: vec![
                CallField::scalar("success", BuiltinType::Boolean),
                CallField::scalar("message", BuiltinType::String),
                CallField::scalar("run", BuiltinType::UInt32),
            ],
        }
    }
}

/// Returns the message of std_msgs with a value of this type.
const fn std_message(builtin: Builtin) -> &'static str {
    match builtin {
        Builtin::Boolean => "Bool",
        Builtin::SByte => "Int8",
        Builtin::Byte => "UInt8",
        Builtin::Int16 => "Int16",
        Builtin::UInt16 => "UInt16",
        Builtin::Int32 => "Int32",
        Builtin::UInt32 => "UInt32",
        Builtin::Int64 => "Int64",
        Builtin::UInt64 => "UInt64",
        Builtin::Float => "Float32",
        Builtin::Double => "Float64",
        Builtin::String => "String",
    }
}

/// Returns the description of a value with its unit and range.
fn about_value(facts: &ValueFacts) -> String {
    let unit = facts.unit.as_deref().unwrap_or_default();
    let range = facts.range.map(|(low, high)| format!("{low} to {high}"));
    let numbers = match (range, unit) {
        (None, "") => String::new(),
        (None, unit) => format!("[{unit}]"),
        (Some(range), "") => format!("[{range}]"),
        (Some(range), unit) => format!("[{range} {unit}]"),
    };
    let about = [facts.about.as_str(), &numbers];
    about
        .into_iter()
        .filter(|text| !text.is_empty())
        .collect::<Vec<_>>()
        .join(" ")
}

/// Returns the meaning of a parameter for users.
fn note(parameter: &SkillParameter) -> FieldNote {
    let default = parameter.default.as_ref().map(ToString::to_string);
    FieldNote {
        unit: parameter.unit.clone().unwrap_or_default(),
        range: parameter.range,
        default: default.filter(|text| text.len() <= LONGEST_DEFAULT),
        about: parameter.about.clone(),
    }
}

fn leaves<const N: usize>(fields: [(&str, (BuiltinType, ArrayRank)); N]) -> Vec<Leaf> {
    let leaf = |(name, (builtin, rank)): (&str, (BuiltinType, ArrayRank))| Leaf {
        path: name.to_owned(),
        builtin,
        rank,
    };
    fields.into_iter().map(leaf).collect()
}

/// Values to be sent to the space, in the order of their creation. The queue is bounded: if it is
/// full, the oldest value is dropped and counted.
#[derive(Debug, Clone, Default)]
pub(crate) struct ComponentOutbox {
    inner: Arc<Mutex<Waiting>>,
    more: Arc<Notify>,
}

#[derive(Debug, Default)]
struct Waiting {
    samples: VecDeque<Sample>,
    lost: VecDeque<(TopicId, u64)>,
}

#[derive(Debug)]
struct Sample {
    topic: TopicId,
    payload: Bytes,
    at: Timestamp,
    /// True if a newer value of the topic may replace this value.
    passing: bool,
    /// The upper 16 bits of the StatusCode; 0 for Good.
    status: u16,
}

impl ComponentOutbox {
    /// Waits for the next value, or for the loss of values before it.
    pub(crate) async fn next(&self) -> PortEvent {
        loop {
            let more = self.more.notified();
            if let Some(event) = self.take() {
                return event;
            }
            more.await;
        }
    }

    fn take(&self) -> Option<PortEvent> {
        let mut waiting = self.lock();
        if let Some((topic, count)) = waiting.lost.pop_front() {
            return Some(PortEvent::Lost {
                topic: Some(topic),
                reason: Reason::Overflow,
                why: "the space is slow",
                count,
            });
        }
        let Sample {
            topic,
            payload,
            at,
            status,
            ..
        } = waiting.samples.pop_front()?;
        if status != 0 {
            return Some(PortEvent::Qualified {
                topic,
                payload,
                taken: at,
                status,
            });
        }
        Some(PortEvent::Sample {
            topic,
            payload,
            received: at,
            latched_by: None,
        })
    }

    /// Publishes a value at each change. The newest value replaces a value that still waits.
    pub(crate) async fn publish(self, topic: TopicId, value: LiveValue) {
        let mut readings = value.watch();
        loop {
            let reading = readings.borrow_and_update().clone();
            let status = value_status(value.facts(), &reading).bits();
            let payload = match &reading.value {
                Ok(value) => fields::block(std::slice::from_ref(value)),
                Err(_) => fields::no_value(status),
            };
            self.push(Sample {
                topic,
                payload: Bytes::from(payload),
                at: now().utc,
                passing: true,
                status: u16::try_from(status >> 16).unwrap_or(u16::MAX),
            });
            if readings.changed().await.is_err() {
                return;
            }
        }
    }

    fn put(&self, topic: TopicId, values: &[SkillValue], passing: bool) {
        self.push(Sample {
            topic,
            payload: Bytes::from(fields::block(values)),
            at: now().utc,
            passing,
            status: 0,
        });
    }

    fn push(&self, sample: Sample) {
        let Sample { topic, passing, .. } = sample;
        let mut waiting = self.lock();
        if passing
            && waiting
                .samples
                .back()
                .is_some_and(|last| last.topic == topic && last.passing)
        {
            waiting.samples.pop_back();
        }
        if waiting.samples.len() >= MOST_WAITING
            && let Some(gone) = waiting.samples.pop_front()
        {
            match waiting
                .lost
                .iter_mut()
                .find(|(topic, _)| *topic == gone.topic)
            {
                Some((_, count)) => *count += 1,
                None => waiting.lost.push_back((gone.topic, 1)),
            }
        }
        waiting.samples.push_back(sample);
        drop(waiting);
        self.more.notify_one();
    }

    fn lock(&self) -> MutexGuard<'_, Waiting> {
        // Each change is complete before the lock is released.
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Puts the changes of a skill into the outbox.
#[derive(Debug)]
pub(crate) struct Speaker {
    outbox: ComponentOutbox,
    topics: [TopicId; 4],
    /// Time of the last report of progress only.
    progressed: Mutex<Option<Instant>>,
}

impl Speaker {
    /// Creates the speaker of skill `number`. Returns `None` if the skill has no identifiers in the
    /// space.
    pub(crate) fn new(
        outbox: ComponentOutbox,
        place: &ComponentPlace,
        number: u16,
    ) -> Option<Self> {
        let topic = |n| place.topic(number, n);
        let topics = [
            topic(STATE)?,
            topic(EVENTS)?,
            topic(PARAMETERS)?,
            topic(RESULT)?,
        ];
        Some(Self {
            outbox,
            topics,
            progressed: Mutex::new(None),
        })
    }

    /// Publishes the values before the first run, and the state if it is known.
    pub(crate) fn at_first(&self, facts: &SkillDescription, state: Option<ProgramMachineState>) {
        let defaults = facts
            .parameters
            .iter()
            .filter_map(|of| Some((of.name.clone(), of.default.clone()?)));
        self.parameters(0, &defaults.collect::<Vec<_>>());
        self.result(&RunOutcome {
            run: 0,
            succeeded: false,
            unknown: false,
            message: String::new(),
            results: Vec::new(),
            trace: Vec::new(),
        });
        let [topic, ..] = self.topics;
        if let Some(state) = state {
            self.outbox
                .put(topic, &state_of(state, "", (0.0, "", 0)), false);
        }
    }

    fn state(&self, shown: &SkillSnapshot, passing: bool) {
        let [state, ..] = self.topics;
        let last = shown.last.map_or("", |last| last.name);
        let values = state_of(shown.state, last, (shown.progress, &shown.step, shown.run));
        self.outbox.put(state, &values, passing);
    }

    fn parameters(&self, run: u32, of: &[(String, SkillValue)]) {
        let [_, _, parameters, _] = self.topics;
        let [names, values] = named(of);
        self.outbox
            .put(parameters, &[run.into(), names, values], false);
    }

    fn result(&self, outcome: &RunOutcome) {
        let [.., result] = self.topics;
        let [names, values] = named(&outcome.results);
        let RunOutcome { run, succeeded, .. } = outcome;
        let values = [
            (*run).into(),
            (*succeeded).into(),
            outcome.shown_message().as_ref().into(),
            names,
            values,
        ];
        self.outbox.put(result, &values, false);
    }

    fn event(&self, happened: &Transitioned) {
        let [_, event, ..] = self.topics;
        let Transitioned {
            transition,
            run,
            message,
            ..
        } = happened;
        let values = [
            transition.name.into(),
            SkillValue::Byte(u8::try_from(transition.number).unwrap_or_default()),
            transition.from.name().into(),
            transition.to.name().into(),
            (*run).into(),
            message.as_str().into(),
        ];
        self.outbox.put(event, &values, false);
    }
}

impl SkillObserver for Speaker {
    fn told(&self, what: SkillEvent<'_>, shown: &SkillSnapshot) {
        match what {
            SkillEvent::Parameters(parameters) => {
                self.parameters(shown.run, Parameters::all(parameters))
            }
            SkillEvent::Transition(happened) => {
                self.event(happened);
                self.state(shown, false);
            }
            SkillEvent::Step | SkillEvent::Pending(_) => self.state(shown, false),
            SkillEvent::Progress => {
                let mut progressed = self
                    .progressed
                    .lock()
                    .unwrap_or_else(PoisonError::into_inner);
                if progressed.is_none_or(|last| last.elapsed() >= BETWEEN_PROGRESS) {
                    *progressed = Some(Instant::now());
                    drop(progressed);
                    self.state(shown, true);
                }
            }
            SkillEvent::Outcome(outcome) => self.result(outcome),
            SkillEvent::Called => {}
        }
    }
}

fn state_of(
    state: ProgramMachineState,
    last: &str,
    (progress, step, run): (f32, &str, u32),
) -> [SkillValue; 6] {
    [
        state.name().into(),
        SkillValue::Byte(u8::try_from(state.number()).unwrap_or_default()),
        last.into(),
        progress.into(),
        step.into(),
        run.into(),
    ]
}

/// Returns the names and the values, each value as JSON.
fn named(of: &[(String, SkillValue)]) -> [SkillValue; 2] {
    let names = of
        .iter()
        .map(|(name, _)| SkillValue::from(name.as_str()))
        .collect();
    let values = of
        .iter()
        .map(|(_, value)| SkillValue::String(value.to_string()))
        .collect();
    [
        SkillValue::Array(Builtin::String, names),
        SkillValue::Array(Builtin::String, values),
    ]
}

/// Largest number of skills. Identifiers have 16 bits, and a skill has a hundred of them.
pub(crate) const MOST_IN_SPACE: usize = 654;
/// The identifier of value n is larger by n. Values have lower identifiers than skills.
const FIRST_VALUE: u16 = 10;
/// Number of identifiers of a skill.
const PER_SKILL: u16 = 100;
/// The length in bytes of a default value above which it is not announced.
const LONGEST_DEFAULT: usize = 512;
/// Largest number of events of a skill that wait for the network, in addition to the first.
const QUEUED_EVENTS: u16 = 63;
/// Largest number of values of a component that wait for the run loop.
const MOST_WAITING: usize = 1_024;
/// Shortest interval between two reports of progress only: 20 a second.
const BETWEEN_PROGRESS: Duration = Duration::from_millis(50);
