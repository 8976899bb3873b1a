//! The scenario as a state machine: the facts that have to be observed next, and the action that
//! follows.

use std::collections::{BTreeMap, BTreeSet};

use super::fact::{CanRunAnswer, Fact, MesRun, NodeEvent, PlugComponent, Ros, VisibilityLevel};
use super::pages::nanos;
use crate::clock::millis;

/// An act of the scenario, in order.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Act {
    /// The programs of the cell are ready, and both nodes listen.
    Cell,
    Robot,
    Gripper,
    GraspFromRos2,
    GraspFromRos1,
    FirstRun,
    /// Ends when the gripper holds the part.
    SecondRun,
    /// The gripper is killed.
    Loss,
    /// Another gripper is plugged in, and the run ends.
    Vacuum,
    /// The query of skills and services that can run.
    Question,
    End,
}

/// The action at the start of an act.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum ActStart {
    Plug(PlugComponent),
    Grasp(Ros),
    /// Runs the process with the MES, as the run with this number, from 0.
    Run(usize),
    Kill(PlugComponent),
    Ask,
    /// The scenario is complete.
    End,
}

/// All observed facts, and the current act.
#[derive(Debug)]
pub(crate) struct PlugStory {
    act: Act,
    ready: BTreeSet<&'static str>,
    up: BTreeSet<Ros>,
    pub(crate) started: BTreeMap<PlugComponent, i64>,
    pub(crate) reached: BTreeMap<(PlugComponent, VisibilityLevel), i64>,
    pub(crate) left: BTreeMap<(PlugComponent, VisibilityLevel), i64>,
    pub(crate) killed_at: Option<i64>,
    pub(crate) grasps: BTreeMap<Ros, Grasp>,
    pub(crate) runs: BTreeMap<usize, MesRun>,
    calls: BTreeMap<usize, Result<(), String>>,
    pub(crate) asked: Option<CanRunAnswer>,
}

/// A grasp that was started from ROS, as observed by its node.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Grasp {
    pub(crate) asked_at: Option<i64>,
    pub(crate) answered: Option<(i64, Result<(), String>)>,
    /// Distinct consecutive states of the gripper's first skill since the request, starting with
    /// the state before it.
    pub(crate) states: Vec<(i64, String)>,
    pub(crate) result: Option<(i64, Result<(), String>)>,
    /// The state before the request.
    before: Option<(i64, String, u32)>,
}

impl PlugStory {
    pub(crate) fn new() -> Self {
        Self {
            act: Act::Cell,
            ready: BTreeSet::new(),
            up: BTreeSet::new(),
            started: BTreeMap::new(),
            reached: BTreeMap::new(),
            left: BTreeMap::new(),
            killed_at: None,
            grasps: BTreeMap::new(),
            runs: BTreeMap::new(),
            calls: BTreeMap::new(),
            asked: None,
        }
    }

    pub(crate) const fn act(&self) -> Act {
        self.act
    }

    pub(crate) fn finished(&self) -> bool {
        self.act == Act::End
    }

    /// Processes a fact. Facts may arrive in any order; the earliest of a kind counts.
    pub(crate) fn observe(&mut self, at_ns: i64, fact: &Fact) {
        match fact {
            Fact::Ready(program) => {
                self.ready.insert(program);
            }
            Fact::Started(part) => {
                self.started.insert(*part, at_ns);
            }
            Fact::Reached(part, level) => earliest(&mut self.reached, (*part, *level), at_ns),
            // Before the act of the loss, no component is lost.
            Fact::Left(part, level) => {
                if self.act >= Act::Loss && *part == PlugComponent::Gripper {
                    earliest(&mut self.left, (*part, *level), at_ns);
                }
            }
            Fact::Node(event) => self.observe_node(at_ns, event),
            Fact::Killed(_) => {
                self.killed_at.get_or_insert(at_ns);
            }
            Fact::Run(number, run) => {
                self.runs.insert(*number, run.clone());
            }
            Fact::CallEnded {
                run,
                succeeded,
                why,
            } => {
                let outcome = succeeded.then_some(()).ok_or_else(|| why.clone());
                self.calls.insert(*run, outcome);
            }
            Fact::Asked(asked) => self.asked = Some(asked.clone()),
        }
    }

    fn observe_node(&mut self, at_ns: i64, event: &NodeEvent) {
        match event {
            NodeEvent::Up { ros } => {
                self.up.insert(*ros);
            }
            NodeEvent::State {
                ros,
                namespace,
                state,
                run,
            } => {
                let Some(part) = PlugComponent::of_namespace(*namespace) else {
                    return;
                };
                let level = level(*ros);
                earliest(&mut self.reached, (part, level), at_ns);
                if part == PlugComponent::Gripper {
                    self.grasp(*ros).saw(at_ns, state, *run);
                }
            }
            NodeEvent::Resets { .. } => {}
            NodeEvent::Asks { ros } => {
                let grasp = self.grasp(*ros);
                grasp.asked_at.get_or_insert(at_ns);
                if let Some((at, state, _)) = &grasp.before {
                    grasp.states = vec![(*at, state.clone())];
                }
            }
            NodeEvent::Answered {
                ros,
                success,
                message,
            } => {
                let outcome = success.then_some(()).ok_or_else(|| message.clone());
                self.grasp(*ros).answered.get_or_insert((at_ns, outcome));
            }
            NodeEvent::Result {
                ros,
                namespace,
                run,
                succeeded,
                message,
            } => {
                let grasp = self.grasp(*ros);
                let is_new = grasp
                    .before
                    .as_ref()
                    .is_none_or(|(_, _, before)| run > before);
                if *namespace == PlugComponent::Gripper.namespace()
                    && grasp.asked_at.is_some()
                    && is_new
                {
                    let outcome = succeeded.then_some(()).ok_or_else(|| message.clone());
                    grasp.result.get_or_insert((at_ns, outcome));
                }
            }
        }
    }

    fn grasp(&mut self, ros: Ros) -> &mut Grasp {
        self.grasps.entry(ros).or_default()
    }

    /// Returns the milliseconds from the start of a component's process until it is known at a
    /// level.
    pub(crate) fn after_start(&self, part: PlugComponent, level: VisibilityLevel) -> Option<f64> {
        let reached = self.reached.get(&(part, level))?;
        Some(millis(reached - self.started.get(&part)?))
    }

    /// Returns the milliseconds from the kill of the gripper until it is no longer known at a
    /// level.
    pub(crate) fn after_kill(&self, level: VisibilityLevel) -> Option<f64> {
        let left = self.left.get(&(PlugComponent::Gripper, level))?;
        Some(millis(left - self.killed_at?))
    }

    /// Returns the milliseconds from the kill of the gripper to the end of its plan.
    pub(crate) fn halted_after(&self) -> Option<f64> {
        let plan = self.runs.get(&1)?.plans.first()?;
        Some(millis(nanos(plan.ended_ms?) - self.killed_at?))
    }

    /// Returns the milliseconds from the start of the other gripper's process to the plan with it.
    pub(crate) fn planned_anew_after(&self) -> Option<f64> {
        let plan = self.runs.get(&1)?.plans.get(1)?;
        Some(millis(
            nanos(plan.at_ms) - self.started.get(&PlugComponent::Vacuum)?,
        ))
    }

    /// Returns whether the loss of a component at this level is expected and not known yet.
    pub(crate) fn loses(&self, part: PlugComponent, level: VisibilityLevel) -> bool {
        self.act >= Act::Loss
            && part == PlugComponent::Gripper
            && !self.left.contains_key(&(part, level))
    }

    /// Returns whether a state of the gripper, as reported by a node, is new in a grasp of this
    /// node.
    pub(crate) fn is_new_state(&self, ros: Ros, state: &str) -> bool {
        self.grasps.get(&ros).is_some_and(|grasp| {
            grasp.asked_at.is_some()
                && (grasp.result.is_none() || !grasp.has_run())
                && grasp.states.last().is_none_or(|(_, last)| last != state)
        })
    }

    /// Returns whether a node has requested a grasp and has no result yet.
    pub(crate) fn awaits_result(&self, ros: Ros) -> bool {
        self.grasps
            .get(&ros)
            .is_some_and(|grasp| grasp.asked_at.is_some() && grasp.result.is_none())
    }

    /// Returns the missing conditions of the act, as text for people; empty when it is over.
    ///
    /// # Errors
    /// The reason why the act cannot succeed any more.
    pub(crate) fn missing(&self) -> Result<Vec<String>, String> {
        match self.act {
            Act::Cell => Ok(self.cell_lacks()),
            Act::Robot => Ok(self.part_lacks(PlugComponent::Robot)),
            Act::Gripper => Ok(self.part_lacks(PlugComponent::Gripper)),
            Act::GraspFromRos2 => self.grasp_lacks(Ros::Ros2),
            Act::GraspFromRos1 => self.grasp_lacks(Ros::Ros1),
            Act::FirstRun => self.run_lacks(0, 1),
            Act::SecondRun => self.holding_lacks(),
            Act::Loss => self.loss_lacks(),
            Act::Vacuum => {
                let mut lacks = self.part_lacks(PlugComponent::Vacuum);
                lacks.extend(self.run_lacks(1, 2)?);
                Ok(lacks)
            }
            Act::Question => self.question_lacks(),
            Act::End => Ok(Vec::new()),
        }
    }

    /// Proceeds to the next act. Returns its action.
    pub(crate) fn advance(&mut self) -> ActStart {
        let (act, order) = match self.act {
            Act::Cell => (Act::Robot, ActStart::Plug(PlugComponent::Robot)),
            Act::Robot => (Act::Gripper, ActStart::Plug(PlugComponent::Gripper)),
            Act::Gripper => (Act::GraspFromRos2, ActStart::Grasp(Ros::Ros2)),
            Act::GraspFromRos2 => (Act::GraspFromRos1, ActStart::Grasp(Ros::Ros1)),
            Act::GraspFromRos1 => (Act::FirstRun, ActStart::Run(0)),
            Act::FirstRun => (Act::SecondRun, ActStart::Run(1)),
            Act::SecondRun => (Act::Loss, ActStart::Kill(PlugComponent::Gripper)),
            Act::Loss => (Act::Vacuum, ActStart::Plug(PlugComponent::Vacuum)),
            Act::Vacuum => (Act::Question, ActStart::Ask),
            Act::Question | Act::End => (Act::End, ActStart::End),
        };
        self.act = act;
        order
    }

    fn cell_lacks(&self) -> Vec<String> {
        let programs = PROGRAMS
            .into_iter()
            .filter(|program| !self.ready.contains(program))
            .map(|program| format!("{program} is not ready"));
        let nodes = [Ros::Ros1, Ros::Ros2]
            .into_iter()
            .filter(|ros| !self.up.contains(ros))
            .map(|ros| format!("{} does not listen", ros.label()));
        programs.chain(nodes).collect()
    }

    fn part_lacks(&self, part: PlugComponent) -> Vec<String> {
        VisibilityLevel::ALL
            .into_iter()
            .filter(|level| !self.reached.contains_key(&(part, *level)))
            .map(|level| format!("{}: not {}", part.name(), level.label()))
            .collect()
    }

    fn grasp_lacks(&self, ros: Ros) -> Result<Vec<String>, String> {
        let node = ros.label();
        let nothing = Grasp::default();
        let grasp = self.grasps.get(&ros).unwrap_or(&nothing);
        let mut lacks = Vec::new();
        match &grasp.answered {
            Some((_, Ok(()))) => {}
            Some((_, Err(why))) => return Err(format!("{node}: Start was refused: {why}")),
            None => lacks.push(format!("{node} has no answer from /ua_0_7_105")),
        }
        if !grasp.has_run() {
            let seen: Vec<&str> = grasp.states.iter().map(|(_, s)| s.as_str()).collect();
            lacks.push(format!(
                "{node} has not seen Ready, Running, Ready on /ua_0_7_101, but {}",
                or_nothing(&seen.join(", "))
            ));
        }
        match &grasp.result {
            Some((_, Ok(()))) => {}
            Some((_, Err(why))) => return Err(format!("{node}: the grasp failed: {why}")),
            None => lacks.push(format!("{node} has no result on /ua_0_7_104")),
        }
        Ok(lacks)
    }

    /// Returns the missing conditions for the success of a run with at least this number of plans.
    fn run_lacks(&self, number: usize, plans: usize) -> Result<Vec<String>, String> {
        let Some(run) = self.runs.get(&number) else {
            return match self.calls.get(&number) {
                Some(Err(why)) => Err(format!("the process was not begun: {why}")),
                Some(Ok(())) | None => Ok(vec!["ua-mes has not begun the process".to_owned()]),
            };
        };
        if run.outcome == "failed" {
            let why = run.reason.as_deref().unwrap_or("no reason given");
            return Err(format!("ua-mes could not end the process: {why}"));
        }
        let mut lacks = Vec::new();
        if run.outcome != "done" {
            lacks.push(format!(
                "ua-mes has not ended the process: {}",
                standing(run)
            ));
        } else if run.plans.len() < plans {
            return Err(format!(
                "the process ended by {} plans, where {plans} were to be made",
                run.plans.len()
            ));
        }
        match self.calls.get(&number) {
            Some(Ok(())) => {}
            Some(Err(why)) => return Err(format!("`ua-space call` says: {why}")),
            None => lacks.push("`ua-space call` has not seen the end of the process".to_owned()),
        }
        Ok(lacks)
    }

    fn holding_lacks(&self) -> Result<Vec<String>, String> {
        let Some(run) = self.runs.get(&1) else {
            return self.run_lacks(1, 1);
        };
        if matches!(run.outcome.as_str(), "failed" | "done") {
            return Err(format!(
                "the second run was over before the gripper could be killed: {}",
                standing(run)
            ));
        }
        let carries = |plan: &super::fact::RunPlan| {
            let mut steps = plan.ran.iter().map(|ran| ran.step.as_str());
            steps.any(|step| CARRYING.contains(&step))
        };
        if run.plans.first().is_some_and(carries) {
            Ok(Vec::new())
        } else {
            Ok(vec![format!("nothing is carried yet: {}", standing(run))])
        }
    }

    fn loss_lacks(&self) -> Result<Vec<String>, String> {
        let mut lacks: Vec<String> = LOST_FROM
            .into_iter()
            .filter(|level| !self.left.contains_key(&(PlugComponent::Gripper, *level)))
            .map(|level| {
                format!(
                    "{} is still {}",
                    PlugComponent::Gripper.name(),
                    level.label()
                )
            })
            .collect();
        let plan = self.runs.get(&1).and_then(|run| run.plans.first());
        match plan.map(|plan| (plan.outcome.as_str(), &plan.reason, plan.retreated)) {
            Some(("failed", Some(_), Some(true))) => {}
            Some(("failed", Some(reason), Some(false))) => {
                return Err(format!("the robot could not retreat: {reason}"));
            }
            _ => lacks.push("the composite has not halted with a reason and retreated".to_owned()),
        }
        Ok(lacks)
    }

    fn question_lacks(&self) -> Result<Vec<String>, String> {
        let Some(asked) = &self.asked else {
            return Ok(vec![
                "`ua-space ask what-can-run` has not answered".to_owned(),
            ]);
        };
        if asked.skills < 6 || asked.services == 0 {
            return Err(format!(
                "what-can-run lists {} skills and {} services; robot, gripper and MES have 6 skills, the manifest some services",
                asked.skills, asked.services
            ));
        }
        if asked.incomplete.is_empty() {
            Ok(Vec::new())
        } else {
            Err(format!(
                "what-can-run lacks capability or endpoint of {}",
                asked.incomplete.join(", ")
            ))
        }
    }
}

impl Grasp {
    fn saw(&mut self, at_ns: i64, state: &str, run: u32) {
        if self.asked_at.is_none() {
            self.before = Some((at_ns, state.to_owned(), run));
        } else if (self.result.is_none() || !self.has_run())
            && self.states.last().is_none_or(|(_, last)| last != state)
        {
            self.states.push((at_ns, state.to_owned()));
        }
    }

    /// Returns whether the states Ready, Running and then Ready or Halted were observed last.
    pub(crate) fn has_run(&self) -> bool {
        let states: Vec<&str> = self.states.iter().map(|(_, s)| s.as_str()).collect();
        matches!(
            states.as_slice(),
            [.., "Ready", "Running", "Ready" | "Halted"]
        )
    }
}

const fn level(ros: Ros) -> VisibilityLevel {
    match ros {
        Ros::Ros1 => VisibilityLevel::Ros1,
        Ros::Ros2 => VisibilityLevel::Ros2,
    }
}

fn earliest<K: Ord>(times: &mut BTreeMap<K, i64>, key: K, at_ns: i64) {
    times
        .entry(key)
        .and_modify(|known| *known = at_ns.min(*known))
        .or_insert(at_ns);
}

/// Describes the state of a run for people.
fn standing(run: &MesRun) -> String {
    if let Some(what) = &run.waits_for {
        return format!("it waits for {what}");
    }
    let ran = run.plans.last().and_then(|plan| plan.ran.last());
    ran.map_or_else(
        || "no skill was started".to_owned(),
        |ran| format!("{} by {}: {}", ran.step, ran.component, ran.outcome),
    )
}

fn or_nothing(text: &str) -> &str {
    if text.is_empty() { "nothing" } else { text }
}

/// The programs that must provide their status pages.
pub(crate) const PROGRAMS: [&str; 5] = [
    "ua-lds",
    "ua-server",
    "bridge-ros1",
    "bridge-ros2",
    "ua-mes",
];

/// The levels at which a killed component must no longer be known.
pub(crate) const LOST_FROM: [VisibilityLevel; 4] = [
    VisibilityLevel::Announced,
    VisibilityLevel::Registered,
    VisibilityLevel::InGraph,
    VisibilityLevel::Ros1,
];

/// Steps of the composite in which the gripper holds the part without running a skill.
const CARRYING: [&str; 3] = [
    "MovePickApproachAfter",
    "MovePlaceApproachBefore",
    "MovePlace",
];

#[cfg(test)]
mod tests;
