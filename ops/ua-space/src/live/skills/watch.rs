//! `ua-space skills watch`: shows transitions, progress and results of skills as they happen.

use std::collections::BTreeMap;
use std::io::{self, Write as _};

use mappings::TopicId;
use serde::Serialize;
use serde_json::Value;
use uadp::MessageKind;

use super::{Go, RESULT, STATE, in_group, until};
use crate::arguments::WatchSkills;
use crate::exit::CommandFailure;
use crate::iso_time;
use crate::live::book::{DatagramContent, ReceivedSample};
use crate::live::names::is_fitting;
use crate::live::plain::{self, NamedValues};
use crate::live::run::{RunEvent, percent, results};
use crate::live::text::{harmless, json};

/// The suffix of the name of the transitions.
const EVENTS: &str = ".Events";

pub(super) fn watch(arguments: &WatchSkills) -> Result<(), CommandFailure> {
    in_group(&arguments.group, async |mut live| {
        live.want_calls([0]);
        let mut known = LastStates::default();
        let mut fault = None;
        let end = until(live.now(), arguments.seconds);
        let mut each = |news: DatagramContent<'_>, _| {
            let DatagramContent::Sample(sample) = news else {
                return Go::On;
            };
            for happened in known.take(&sample, arguments.what.as_deref()) {
                if let Err(failure) = tell(&happened, arguments.json) {
                    fault = Some(failure);
                    return Go::Enough;
                }
            }
            Go::On
        };
        live.listen(end, &mut each).await?;
        live.tell_dropped();
        fault.map_or(Ok(()), Err)
    })
}

fn tell(happened: &Happened, as_json: bool) -> Result<(), CommandFailure> {
    let mut out = io::stdout().lock();
    if as_json {
        writeln!(out, "{}", json(happened)?)?;
    } else {
        let Happened {
            time,
            skill,
            run,
            step,
        } = happened;
        let time = time.as_deref().unwrap_or("-");
        let told = step.told().replace('\n', ", ");
        let line = format!("{time} {skill} run {run}: {told}");
        writeln!(out, "{}", harmless(&line))?;
    }
    out.flush()?;
    Ok(())
}

/// An event of a skill.
#[derive(Debug, PartialEq, Serialize)]
struct Happened {
    /// The time by the clock of the component.
    #[serde(skip_serializing_if = "Option::is_none")]
    time: Option<String>,
    skill: String,
    run: u64,
    #[serde(flatten)]
    step: RunEvent,
}

/// The last reported event of each skill, by the topic of its state.
#[derive(Debug, Default)]
struct LastStates(BTreeMap<TopicId, Last>);

#[derive(Debug, Default)]
struct Last {
    state: Option<(String, u64)>,
    progress: (u32, String),
    /// The run of the result that was reported, or received first.
    result: Option<u64>,
}

impl LastStates {
    fn take(&mut self, sample: &ReceivedSample<'_>, only: Option<&str>) -> Vec<Happened> {
        let Some(described) = sample.described.as_deref() else {
            return Vec::new();
        };
        let (space, namespace, id) = sample.topic.triple();
        let kinds = [(STATE, 1), (EVENTS, 2), (RESULT, 4)];
        let found = kinds.into_iter().find_map(|(end, place)| {
            let skill = described.name.strip_suffix(end)?;
            let state = TopicId::new(space, namespace, id.checked_sub(place)?.checked_add(1)?)?;
            Some((skill, end, state))
        });
        let Some((skill, kind, topic)) = found.filter(|(skill, ..)| is_meant(skill, only)) else {
            return Vec::new();
        };
        let is_value = sample.message.kind != MessageKind::KeepAlive;
        let has_room = self.0.len() < super::MOST || self.0.contains_key(&topic);
        let value = plain::message(&sample.message, Some(described));
        let Some(value) = value.ok().filter(|_| is_value && has_room) else {
            return Vec::new();
        };
        let last = self.0.entry(topic).or_default();
        let steps = match kind {
            EVENTS => last.event(&value),
            RESULT => last.result(&value),
            _ => last.state(&value),
        };
        let header = sample.message.header();
        let time = header.timestamp.or(sample.network.timestamp);
        let run = value.number("run").unwrap_or_default();
        steps
            .into_iter()
            .map(|step| Happened {
                time: time.map(iso_time::of_date_time),
                skill: skill.to_owned(),
                run,
                step,
            })
            .collect()
    }
}

/// Returns true if the skill is the wanted skill, also by the last parts of its name, or belongs to
/// the wanted component.
pub(super) fn is_meant(skill: &str, only: Option<&str>) -> bool {
    let Some(only) = only else {
        return true;
    };
    let component = skill.rsplit_once('.').map(|(component, _)| component);
    component == Some(only) || is_fitting(skill, only)
}

impl Last {
    fn event(&mut self, value: &NamedValues) -> Vec<RunEvent> {
        let Some(state) = value.text("to_state") else {
            return Vec::new();
        };
        let now = (state.to_owned(), value.number("run").unwrap_or_default());
        if self.state.as_ref() == Some(&now) {
            // The state was received before its transition.
            return Vec::new();
        }
        self.state = Some(now);
        vec![RunEvent::State {
            state: state.to_owned(),
            transition: value.text("transition").map(str::to_owned),
        }]
    }

    fn state(&mut self, value: &NamedValues) -> Vec<RunEvent> {
        let Some(state) = value.text("state") else {
            return Vec::new();
        };
        let mut steps = Vec::new();
        let now = (state.to_owned(), value.number("run").unwrap_or_default());
        if self.state.as_ref() != Some(&now) {
            let transition = value
                .text("last_transition")
                .filter(|text| !text.is_empty());
            steps.push(RunEvent::State {
                state: state.to_owned(),
                transition: transition.map(str::to_owned),
            });
            self.state = Some(now);
        }
        let progress = value
            .get("progress")
            .and_then(Value::as_f64)
            .unwrap_or_default();
        let step = value.text("step").unwrap_or_default().to_owned();
        let reached = (percent(progress), step.clone());
        let runs = matches!(state, "Running" | "Suspended");
        if runs && self.progress != reached && reached != (0, String::new()) {
            steps.push(RunEvent::Progress { progress, step });
        }
        self.progress = reached;
        steps
    }

    fn result(&mut self, value: &NamedValues) -> Vec<RunEvent> {
        let run = value.number("run").unwrap_or_default();
        let told = self.result.replace(run);
        // The first received result belongs to an earlier run, unless the run was followed.
        let seen = self.state.as_ref().is_some_and(|(state, of)| {
            *of == run && matches!(state.as_str(), "Running" | "Suspended")
        });
        if run == 0 || told == Some(run) || (told.is_none() && !seen) {
            return Vec::new();
        }
        vec![RunEvent::Result {
            succeeded: value.get("succeeded").and_then(Value::as_bool) == Some(true),
            message: value.text("message").unwrap_or_default().to_owned(),
            results: results(value),
        }]
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn named(json: &Value) -> NamedValues {
        let object = json.as_object().unwrap();
        NamedValues(
            object
                .iter()
                .map(|(name, value)| (name.clone(), value.clone()))
                .collect(),
        )
    }

    fn told(steps: &[RunEvent]) -> Vec<String> {
        steps.iter().map(RunEvent::told).collect()
    }

    #[test]
    fn what_is_repeated_is_told_once_and_a_result_only_of_a_run_that_was_seen() {
        let mut last = Last::default();
        let ready = json!({"state": "Ready", "run": 4, "last_transition": "RunningToReady"});
        let result =
            |run| json!({"run": run, "succeeded": true, "message": "", "names": [], "values": []});
        assert_eq!(
            told(&last.state(&named(&ready))),
            ["Ready (RunningToReady)"]
        );
        assert!(last.state(&named(&ready)).is_empty());
        assert!(last.result(&named(&result(4))).is_empty(), "of before");
        let running = json!({"to_state": "Running", "run": 5, "transition": "ReadyToRunning"});
        assert_eq!(
            told(&last.event(&named(&running))),
            ["Running (ReadyToRunning)"]
        );
        let half = json!({"state": "Running", "run": 5, "progress": 0.5, "step": "Closing"});
        assert_eq!(told(&last.state(&named(&half))), ["50 %, Closing"]);
        assert_eq!(told(&last.result(&named(&result(5)))), ["succeeded"]);
        assert!(last.result(&named(&result(5))).is_empty());
    }

    #[test]
    fn a_component_means_all_its_skills() {
        assert!(is_meant("cell.gripper.Grasp", Some("cell.gripper")));
        assert!(is_meant("gripper.Grasp", Some("gripper.Grasp")));
        assert!(!is_meant("gripper.Grasp", Some("grip")));
        assert!(is_meant("gripper.Grasp", None));
    }
}
