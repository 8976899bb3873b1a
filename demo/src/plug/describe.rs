//! The texts of the timeline for facts.

use super::fact::{Fact, MesRun, NodeEvent, PlugComponent, Ros, VisibilityLevel};
use super::story::PlugStory;
use crate::stage::EventSource;

/// Returns the sources and the texts of a fact. Facts that are known already or not for people have
/// no text. Must be called before the story observes the fact.
pub(crate) fn describe(story: &PlugStory, fact: &Fact) -> Vec<(EventSource, String)> {
    match fact {
        Fact::Ready(program) => vec![(EventSource::DEMO, format!("{program} runs"))],
        Fact::Started(part) => vec![(who(*part), "is plugged in: its process starts".to_owned())],
        Fact::Reached(part, level) if !story.reached.contains_key(&(*part, *level)) => {
            vec![(who(*part), reached(*part, *level))]
        }
        Fact::Left(part, level) if story.loses(*part, *level) => {
            vec![(who(*part), format!("is gone from {}", level.gone_from()))]
        }
        Fact::Reached(..) | Fact::Left(..) => Vec::new(),
        Fact::Node(event) => node(story, event),
        Fact::Killed(part) => vec![(who(*part), "is killed (SIGKILL)".to_owned())],
        Fact::Run(number, run) => changes(story.runs.get(number), run)
            .into_iter()
            .map(|what| (MES, what))
            .collect(),
        Fact::CallEnded { succeeded, why, .. } => {
            let what = if *succeeded {
                "ua-space call: the process is done".to_owned()
            } else {
                format!("ua-space call: {why}")
            };
            vec![(EventSource::DEMO, what)]
        }
        Fact::Asked(asked) => vec![(
            MES,
            format!(
                "knows what can run: {} skills and {} services",
                asked.skills, asked.services
            ),
        )],
    }
}

fn reached(part: PlugComponent, level: VisibilityLevel) -> String {
    let namespace = part.namespace();
    match level {
        VisibilityLevel::Announced
        | VisibilityLevel::Registered
        | VisibilityLevel::Listed
        | VisibilityLevel::InGraph => level.label().to_owned(),
        VisibilityLevel::InSpace => format!("{}: ua_0_{namespace}_101 ...", level.label()),
        VisibilityLevel::AtServer => level.label().to_owned(),
        VisibilityLevel::Ros1 | VisibilityLevel::Ros2 => {
            format!("/ua_0_{namespace}_101 is {}", level.label())
        }
    }
}

fn node(story: &PlugStory, event: &NodeEvent) -> Vec<(EventSource, String)> {
    let (ros, what) = match event {
        NodeEvent::Up { ros } => (*ros, "listens".to_owned()),
        NodeEvent::State {
            ros,
            namespace,
            state,
            ..
        } => {
            let Some(part) = PlugComponent::of_namespace(*namespace) else {
                return Vec::new();
            };
            let level = match ros {
                Ros::Ros1 => VisibilityLevel::Ros1,
                Ros::Ros2 => VisibilityLevel::Ros2,
            };
            if !story.reached.contains_key(&(part, level)) {
                return vec![(who(part), reached(part, level))];
            }
            if part != PlugComponent::Gripper || !story.is_new_state(*ros, state) {
                return Vec::new();
            }
            (*ros, format!("/ua_0_7_101: {state}"))
        }
        NodeEvent::Resets { ros } => (*ros, "calls /ua_0_7_109: the skill is Halted".to_owned()),
        NodeEvent::Asks { ros } => (*ros, "calls /ua_0_7_105 (std_srvs/Trigger)".to_owned()),
        NodeEvent::Answered {
            ros,
            success,
            message,
        } => {
            let what = if *success {
                "is answered: success".to_owned()
            } else {
                format!("is answered: {message}")
            };
            (*ros, what)
        }
        NodeEvent::Result {
            ros,
            run,
            succeeded,
            ..
        } => {
            if !story.awaits_result(*ros) {
                return Vec::new();
            }
            let how = if *succeeded { "succeeded" } else { "failed" };
            (*ros, format!("/ua_0_7_104: run {run} {how}"))
        }
    };
    vec![(node_of(ros), what)]
}

/// Returns the changes of a run.
fn changes(known: Option<&MesRun>, run: &MesRun) -> Vec<String> {
    let mut new = Vec::new();
    if known.is_none() {
        new.push(format!("runs {}", run.process));
    }
    let known_plans = known
        .map(|known| known.plans.as_slice())
        .unwrap_or_default();
    if let Some(what) = run.waits_for.as_deref().map(need)
        && known.and_then(|known| known.waits_for.as_deref()).map(need) != Some(what)
    {
        new.push(format!("waits: {what}"));
    }
    for (number, plan) in run.plans.iter().enumerate() {
        let known = known_plans.get(number);
        if known.is_none() {
            new.push(format!("has plan {}", number + 1));
        }
        let known_ran = known.map_or(0, |known| known.ran.len());
        for ran in plan.ran.iter().skip(known_ran) {
            let part = PlugComponent::of_uri(&ran.component);
            let component = part.map_or(ran.component.as_str(), |part| part.name());
            new.push(format!("{} by {component}", ran.step));
        }
        let was_retreated = known.and_then(|known| known.retreated);
        if plan.retreated != was_retreated
            && let Some(retreated) = plan.retreated
        {
            let how = if retreated {
                "is away from the place"
            } else {
                "could not retreat"
            };
            new.push(format!("the robot {how}"));
        }
        if plan.outcome == "failed"
            && known.is_none_or(|known| known.outcome != "failed")
            && let Some(reason) = &plan.reason
        {
            new.push(format!("plan {} broke: {reason}", number + 1));
        }
    }
    if run.outcome != "running" && known.is_none_or(|known| known.outcome == "running") {
        let plans = run.plans.len();
        new.push(format!(
            "the process is {} after {plans} plan(s)",
            run.outcome
        ));
    }
    new
}

/// Returns the first need that a run waits for, without its candidates.
fn need(what: &str) -> &str {
    what.split_once(" by a skill ")
        .map_or(what, |(need, _)| need)
}

const fn who(part: PlugComponent) -> EventSource {
    match part {
        PlugComponent::Robot => EventSource("robot", "33"),
        PlugComponent::Gripper => EventSource("gripper", "36"),
        PlugComponent::Vacuum => EventSource("vacuum gripper", "34"),
    }
}

const fn node_of(ros: Ros) -> EventSource {
    match ros {
        Ros::Ros1 => EventSource("ROS 1 node", "32"),
        Ros::Ros2 => EventSource("ROS 2 node", "32"),
    }
}

const MES: EventSource = EventSource("ua-mes", "35");

#[cfg(test)]
mod tests {
    use super::super::fact::{ExecutedSkill, RunPlan};
    use super::*;

    #[test]
    fn of_a_run_only_what_is_new_is_said() {
        let ran = |step: &str| ExecutedSkill {
            step: step.to_owned(),
            component: PlugComponent::Gripper.uri().to_owned(),
            ..ExecutedSkill::default()
        };
        let mut run = MesRun {
            process: "urn:p".to_owned(),
            outcome: "running".to_owned(),
            plans: vec![RunPlan {
                outcome: "running".to_owned(),
                ran: vec![ran("Grasp")],
                ..RunPlan::default()
            }],
            ..MesRun::default()
        };
        assert_eq!(
            changes(None, &run),
            ["runs urn:p", "has plan 1", "Grasp by parallel-gripper"]
        );
        let before = run.clone();
        assert!(changes(Some(&before), &run).is_empty());
        let plan = &mut run.plans[0];
        plan.ran.push(ran("Release"));
        "failed".clone_into(&mut plan.outcome);
        plan.reason = Some("it is lost".to_owned());
        plan.retreated = Some(true);
        assert_eq!(
            changes(Some(&before), &run),
            [
                "Release by parallel-gripper",
                "the robot is away from the place",
                "plan 1 broke: it is lost"
            ]
        );
    }
}
