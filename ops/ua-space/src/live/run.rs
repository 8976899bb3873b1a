//! Follows a run of a skill from its start to its end, by the values that the component publishes.

use std::time::Duration;

use mappings::TopicId;
use serde::Serialize;
use serde_json::Value;

use super::plain::NamedValues;

/// The topics of the runs of a skill. Their identifiers follow from the identifier of Start.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct RunTopics {
    state: TopicId,
    events: TopicId,
    result: TopicId,
    /// The call that ends a run.
    pub(super) halt: TopicId,
}

/// An event of a run.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(tag = "event", rename_all = "snake_case")]
pub(super) enum RunEvent {
    /// The skill entered another state.
    State {
        state: String,
        #[serde(skip_serializing_if = "Option::is_none")]
        transition: Option<String>,
    },
    /// The progress of the run.
    Progress { progress: f64, step: String },
    /// The result of the run.
    Result {
        succeeded: bool,
        message: String,
        results: NamedValues,
    },
}

/// The end of a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum RunEnd {
    Succeeded,
    Failed,
    /// Another run began, and the result of this run was not received.
    Overtaken,
    /// The run ended, and its result was not received.
    NoResult,
    /// No value is received from the component.
    Silent,
    /// The component publishes the state of other runs only.
    NoSuchRun,
}

/// A followed run.
#[derive(Debug)]
pub(super) struct FollowedRun {
    number: u64,
    state: Option<String>,
    progress: Option<(u32, String)>,
    ended: Option<(RunEnd, Duration)>,
    /// The time of the first state of an earlier run, until a state of this run is received.
    earlier: Option<Duration>,
    heard: Duration,
    succeeded: Option<bool>,
}

impl RunTopics {
    /// Returns the topics for a call that starts a skill; `None` for other calls.
    pub(super) fn of(start: TopicId, name: &str) -> Option<Self> {
        let (space, namespace, id) = start.triple();
        if !name.ends_with(".Start") || id % 100 != START {
            return None;
        }
        let skill = id - START;
        let place = |part| TopicId::new(space, namespace, skill.checked_add(part)?);
        Some(Self {
            state: place(1)?,
            events: place(2)?,
            result: place(4)?,
            halt: place(6)?,
        })
    }

    /// Returns true if values of the topic belong to a run.
    pub(super) fn has(&self, topic: TopicId) -> bool {
        [self.state, self.events, self.result].contains(&topic)
    }
}

impl FollowedRun {
    pub(super) fn new(number: u64, now: Duration) -> Self {
        Self {
            number,
            state: None,
            progress: None,
            ended: None,
            earlier: None,
            heard: now,
            succeeded: None,
        }
    }

    /// Returns the new events in a value.
    pub(super) fn handle(
        &mut self,
        places: &RunTopics,
        (topic, value): (TopicId, &NamedValues),
        now: Duration,
    ) -> Vec<RunEvent> {
        self.heard = now;
        if topic == places.result {
            self.result(value, now)
        } else if topic == places.events {
            self.event(value)
        } else {
            self.state(value, now)
        }
    }

    fn event(&mut self, value: &NamedValues) -> Vec<RunEvent> {
        if value.number("run") != Some(self.number) {
            return Vec::new();
        }
        let transition = value.text("transition").map(str::to_owned);
        match value.text("to_state") {
            Some(state) => self.reach(state, transition),
            None => Vec::new(),
        }
    }

    fn state(&mut self, value: &NamedValues, now: Duration) -> Vec<RunEvent> {
        match value.number("run") {
            Some(run) if run == self.number => self.earlier = None,
            // Runs have increasing numbers.
            Some(run) if run > self.number => {
                self.ended.get_or_insert((RunEnd::Overtaken, now));
                return Vec::new();
            }
            Some(_) | None => {
                self.earlier.get_or_insert(now);
                return Vec::new();
            }
        }
        let state = value.text("state").unwrap_or_default();
        let transition = value
            .text("last_transition")
            .filter(|text| !text.is_empty());
        let mut steps = self.reach(state, transition.map(str::to_owned));
        let progress = value
            .get("progress")
            .and_then(Value::as_f64)
            .unwrap_or_default();
        let step = value.text("step").unwrap_or_default().to_owned();
        let reached = (percent(progress), step);
        let is_news = self.progress.as_ref() != Some(&reached);
        if is_news && reached != (0, String::new()) {
            steps.push(RunEvent::Progress {
                progress,
                step: reached.1.clone(),
            });
        }
        self.progress = Some(reached);
        if !matches!(state, "Running" | "Suspended") {
            self.ended.get_or_insert((RunEnd::NoResult, now));
        }
        steps
    }

    fn reach(&mut self, state: &str, transition: Option<String>) -> Vec<RunEvent> {
        if self.state.as_deref() == Some(state) {
            return Vec::new();
        }
        self.state = Some(state.to_owned());
        vec![RunEvent::State {
            state: state.to_owned(),
            transition,
        }]
    }

    fn result(&mut self, value: &NamedValues, now: Duration) -> Vec<RunEvent> {
        if value.number("run") != Some(self.number) || self.succeeded.is_some() {
            return Vec::new();
        }
        let succeeded = value.get("succeeded").and_then(Value::as_bool) == Some(true);
        self.succeeded = Some(succeeded);
        self.ended.get_or_insert((RunEnd::NoResult, now));
        vec![RunEvent::Result {
            succeeded,
            message: value.text("message").unwrap_or_default().to_owned(),
            results: results(value),
        }]
    }

    /// Returns the end of the run, once all events are received.
    pub(super) fn end(&self, now: Duration) -> Option<RunEnd> {
        let stands = self
            .state
            .as_deref()
            .is_some_and(|state| state != "Running" && state != "Suspended");
        let since = self.ended.map(|(_, at)| now.saturating_sub(at));
        match (self.succeeded, self.ended) {
            // The last transition may follow the result.
            (Some(succeeded), _) if stands || since >= Some(LAST) => Some(if succeeded {
                RunEnd::Succeeded
            } else {
                RunEnd::Failed
            }),
            (None, Some((end, _))) if since >= Some(LATE) => Some(end),
            (Some(_) | None, _) if now.saturating_sub(self.heard) >= SILENT => Some(RunEnd::Silent),
            (None, None)
                if self
                    .earlier
                    .is_some_and(|at| now.saturating_sub(at) >= LATE) =>
            {
                Some(RunEnd::NoSuchRun)
            }
            (Some(_) | None, _) => None,
        }
    }
}

/// Returns the results by name.
pub(super) fn results(value: &NamedValues) -> NamedValues {
    let list = |name: &str| {
        let found = value.get(name).and_then(Value::as_array);
        found.map_or(&[][..], Vec::as_slice)
    };
    let pairs = list("names").iter().zip(list("values"));
    let pairs = pairs.filter_map(|(name, json)| {
        let (name, json) = (name.as_str()?, json.as_str()?);
        let value = serde_json::from_str(json).unwrap_or_else(|_| json.into());
        Some((name.to_owned(), value))
    });
    NamedValues(pairs.collect())
}

#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "between 0 and 100"
)]
pub(super) fn percent(progress: f64) -> u32 {
    (progress.clamp(0.0, 1.0) * 100.0).round() as u32
}

impl RunEvent {
    /// Returns a line for people.
    pub(super) fn told(&self) -> String {
        match self {
            Self::State { state, transition } => match transition {
                Some(transition) => format!("{state} ({transition})"),
                None => state.clone(),
            },
            Self::Progress { progress, step } => match step.as_str() {
                "" => format!("{} %", percent(*progress)),
                step => format!("{} %, {step}", percent(*progress)),
            },
            Self::Result {
                succeeded,
                message,
                results,
            } => {
                let mut text = if *succeeded {
                    "succeeded".to_owned()
                } else {
                    "failed".to_owned()
                };
                if !message.is_empty() {
                    text.push_str(&format!(": {message}"));
                }
                for (name, value) in &results.0 {
                    text.push_str(&format!("\n{name}: {value}"));
                }
                text
            }
        }
    }
}

/// Offset of Start among the identifiers of a skill.
const START: u16 = 5;
/// Time to wait for the last transition after the result.
const LAST: Duration = Duration::from_millis(500);
/// Time to wait for the result of a run that ended: two repetitions of the result.
const LATE: Duration = Duration::from_secs(3);
/// Time without values after which the component counts as lost; states are repeated every second.
const SILENT: Duration = Duration::from_secs(5);

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    const START: &str = "gripper.Grasp.Start";

    fn places() -> RunTopics {
        RunTopics::of("ua_0_7_105".parse().unwrap(), START).unwrap()
    }

    fn at(seconds: u64) -> Duration {
        Duration::from_secs(seconds)
    }

    fn named(json: &Value) -> NamedValues {
        let object = json.as_object().unwrap();
        NamedValues(
            object
                .iter()
                .map(|(name, value)| (name.clone(), value.clone()))
                .collect(),
        )
    }

    fn state(run: &mut FollowedRun, of: u64, state: &str, progress: f64, now: u64) -> Vec<String> {
        let value = json!({"run": of, "state": state, "progress": progress, "step": "Closing", "last_transition": "X"});
        let steps = run.handle(&places(), (places().state, &named(&value)), at(now));
        steps.iter().map(RunEvent::told).collect()
    }

    fn result(run: &mut FollowedRun, of: u64, succeeded: bool, now: u64) -> Vec<String> {
        let value = json!({
            "run": of, "succeeded": succeeded, "message": "why", "names": ["Gripped"], "values": ["true"]
        });
        let steps = run.handle(&places(), (places().result, &named(&value)), at(now));
        steps.iter().map(RunEvent::told).collect()
    }

    #[test]
    fn a_start_says_where_its_skill_tells_of_its_runs() {
        let topic = |text: &str| text.parse::<TopicId>().unwrap();
        assert!(places().has(topic("ua_0_7_101")) && places().has(topic("ua_0_7_104")));
        assert_eq!(places().halt, topic("ua_0_7_106"));
        assert!(!places().has(topic("ua_0_8_101")));
        assert_eq!(
            RunTopics::of(topic("ua_0_7_106"), "gripper.Grasp.Halt"),
            None
        );
        assert_eq!(RunTopics::of(topic("ua_0_7_61"), "reset.Start"), None);
    }

    #[test]
    fn a_run_that_its_component_does_not_know_comes_to_an_end() {
        let mut run = FollowedRun::new(4242, at(0));
        for now in 0..3 {
            assert!(state(&mut run, 2, "Ready", 0.0, now).is_empty());
            assert_eq!(run.end(at(now)), None, "the first state may be an old one");
        }
        assert!(state(&mut run, 2, "Ready", 0.0, 3).is_empty());
        assert_eq!(run.end(at(3)), Some(RunEnd::NoSuchRun));
        let mut late = FollowedRun::new(3, at(0));
        assert!(state(&mut late, 2, "Ready", 0.0, 0).is_empty());
        assert!(!state(&mut late, 3, "Running", 0.0, 1).is_empty());
        assert_eq!(late.end(at(5)), None);
    }

    #[test]
    fn only_the_own_run_counts_and_it_ends_with_its_result() {
        let mut run = FollowedRun::new(3, at(0));
        assert!(state(&mut run, 2, "Ready", 1.0, 0).is_empty());
        assert!(
            result(&mut run, 2, false, 0).is_empty(),
            "of an earlier run"
        );
        assert_eq!(
            state(&mut run, 3, "Running", 0.4, 1),
            ["Running (X)", "40 %, Closing"]
        );
        assert!(
            state(&mut run, 3, "Running", 0.4, 2).is_empty(),
            "nothing new"
        );
        assert_eq!(run.end(at(2)), None);
        assert_eq!(
            result(&mut run, 3, true, 3),
            ["succeeded: why\nGripped: true"]
        );
        assert_eq!(run.end(at(3)), None, "it is running still");
        assert_eq!(state(&mut run, 3, "Ready", 0.4, 3), ["Ready (X)"]);
        assert_eq!(run.end(at(3)), Some(RunEnd::Succeeded));
    }

    #[test]
    fn a_failure_is_no_success_and_the_last_transition_is_not_waited_for_long() {
        let mut run = FollowedRun::new(1, at(0));
        state(&mut run, 1, "Running", 0.0, 0);
        result(&mut run, 1, false, 1);
        assert_eq!(run.end(at(2)), Some(RunEnd::Failed));
    }

    #[test]
    fn a_run_whose_result_never_comes_has_an_end_all_the_same() {
        let mut run = FollowedRun::new(1, at(0));
        state(&mut run, 1, "Running", 0.0, 0);
        assert_eq!(run.end(at(4)), None);
        assert_eq!(run.end(at(5)), Some(RunEnd::Silent));
        state(&mut run, 1, "Halted", 0.0, 6);
        assert_eq!(run.end(at(6)), None, "its result may be late");
        state(&mut run, 1, "Halted", 0.0, 9);
        assert_eq!(run.end(at(9)), Some(RunEnd::NoResult));
        let mut other = FollowedRun::new(1, at(0));
        state(&mut other, 2, "Running", 0.0, 1);
        state(&mut other, 2, "Running", 0.0, 4);
        assert_eq!(other.end(at(4)), Some(RunEnd::Overtaken));
    }
}
