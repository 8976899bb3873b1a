//! The tools that the steps of a process attach to tool changers: the tools that are attached in a
//! run, and the tools that may be attached when a step of a plan begins. Pure.

use std::collections::{BTreeMap, BTreeSet};

use skills::ParameterType;

use super::Offer;
use crate::process::{By, Loop, Process};

/// The effect of a step on its tool changer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum ToolWork {
    /// It attaches a tool, and replaces an attached one.
    Attach,
    /// It detaches the tool.
    Detach,
}

impl ToolWork {
    /// Skill types with their effects.
    pub(super) const TYPES: [(&'static str, Self); 3] = [
        ("AttachToolSkillType", Self::Attach),
        ("ChangeToolSkillType", Self::Attach),
        ("DetachToolSkillType", Self::Detach),
    ];

    /// Returns the effect of a skill; `None` if it does not change tools.
    pub(crate) fn of(offer: &Offer) -> Option<Self> {
        let is_of = |of: &str| offer.types.contains(&ParameterType::own(of).to_string());
        let mut types = Self::TYPES.into_iter();
        types.find(|(of, _)| is_of(of)).map(|(_, work)| work)
    }
}

/// The tools of a run at one time: the tools of the changers before the run, as its steps attached
/// and detached them.
#[derive(Debug, Clone, Default, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct AttachedTools {
    /// In the order in which they were attached, those from before the run first; at most one of
    /// each changer.
    attached: Vec<AttachedTool>,
    /// The tools that are not attached, or not known to be, by their ApplicationUris.
    away: BTreeMap<String, ToolAway>,
    /// The changers whose tools the run has changed.
    changed: BTreeSet<String>,
}

/// The tools of the tool changers of a cell, as the changers show them.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(crate) struct ShownTools {
    /// The ApplicationUri of the attached tool of each changer, by the IRI of the changer; empty
    /// for no tool, `None` if it is not known.
    pub(crate) attached: BTreeMap<String, Option<String>>,
    /// The ApplicationUris of all known tools.
    pub(crate) tools: BTreeSet<String>,
}

/// A tool at a changer.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
struct AttachedTool {
    /// The IRI of the changer.
    changer: String,
    /// The ApplicationUri of the tool; `None` if it is not known.
    tool: Option<String>,
    /// The step that attached it; `None` if it was attached before the run.
    by: Option<ToolStep>,
    /// The step did so in an earlier round of a loop.
    is_earlier: bool,
    /// It is not known whether a tool is attached, for example after a failed step.
    is_uncertain: bool,
}

/// A step that changes a tool: its number and its name.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct ToolStep {
    pub(crate) number: usize,
    pub(crate) name: String,
}

/// The reason why a tool is not attached, or not known to be: a step, or the tools before the run.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
enum ToolAway {
    Detached { step: String },
    Uncertain { step: String },
    NotAttached,
    NotShown { changer: String },
}

/// A step that may need a tool.
#[derive(Debug, Clone, Copy)]
pub(crate) struct ToolUser<'a> {
    pub(crate) number: usize,
    pub(crate) by: By,
    /// The steps that end before it begins.
    pub(crate) behind: &'a BTreeSet<usize>,
    /// The components with a skill that can do it.
    pub(crate) able: &'a BTreeSet<String>,
    pub(crate) loops: &'a [Loop],
}

/// The reason why a component must not do a step.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub(crate) enum ToolFault {
    #[error("no step before it attaches a tool")]
    NoTool,
    #[error("the step `{step}` detaches the tool, and no step after it attaches one")]
    NoneLeft { step: String },
    #[error("the step `{step}` detaches this tool")]
    Detached { step: String },
    #[error("it is not known whether this tool is attached after the step `{step}`")]
    Uncertain { step: String },
    #[error("the tool that the step `{step}` attaches is not known")]
    Unknown { step: String },
    #[error("it is not of the tool {tool}, which the step `{step}` attaches")]
    Other { tool: String, step: String },
    #[error("the step `{step}` detaches this tool at any time; order the two steps with `after`")]
    AnyTime { step: String },
    #[error("no tool changer shows this tool, and no step before it attaches it")]
    NotAttached,
    #[error(
        "the tool changer {changer} does not show whether it has this tool; \
         let a step before it attach the tool"
    )]
    NotShown { changer: String },
    #[error(
        "the tool changer {changer} does not show its tool; let a step before it attach the tool"
    )]
    NoToolShown { changer: String },
    #[error("it is not of a tool that was attached before the run, such as {tool}")]
    OtherBefore { tool: String },
}

impl ToolFault {
    /// Returns whether no change outside the run can end the fault. `is_there` returns whether a
    /// component is in the graph.
    pub(super) fn is_lasting(&self, is_there: impl Fn(&str) -> bool) -> bool {
        match self {
            // The tool may enter the graph, and do the step.
            Self::Other { tool, .. } => is_there(tool),
            Self::NoTool
            | Self::NoneLeft { .. }
            | Self::Detached { .. }
            | Self::Uncertain { .. }
            | Self::Unknown { .. }
            | Self::AnyTime { .. } => true,
            Self::NotAttached
            | Self::NotShown { .. }
            | Self::NoToolShown { .. }
            | Self::OtherBefore { .. } => false,
        }
    }
}

impl AttachedTools {
    /// Returns whether the run has changed the tool of a changer.
    pub(crate) fn is_changed(&self) -> bool {
        !self.changed.is_empty()
    }

    /// Takes over the tools of the changers that the run has not changed. A changer that showed its
    /// tool, and does not respond, still has the tool.
    pub(crate) fn observe(&mut self, shown: &ShownTools) {
        let is_before = |tool: &AttachedTool| tool.by.is_none();
        let (before, by_steps): (Vec<_>, Vec<_>) = std::mem::take(&mut self.attached)
            .into_iter()
            .partition(is_before);
        let known = |changer: &str| {
            let tool = before.iter().find(|tool| tool.changer == changer);
            tool.and_then(|tool| tool.tool.clone())
        };
        let others = shown.attached.iter();
        let others = others.filter(|(changer, _)| !self.changed.contains(*changer));
        let observed = others.filter_map(|(changer, tool)| {
            let tool = tool.clone().or_else(|| known(changer));
            (tool.as_deref() != Some("")).then(|| AttachedTool {
                changer: changer.clone(),
                tool,
                by: None,
                is_earlier: false,
                is_uncertain: false,
            })
        });
        let lost = before.iter().filter(|tool| {
            let is_shown = shown.attached.contains_key(&tool.changer);
            !is_shown && !self.changed.contains(&tool.changer)
        });
        self.attached = observed.chain(lost.cloned()).chain(by_steps).collect();
        self.away
            .retain(|_, away| !matches!(away, ToolAway::NotAttached | ToolAway::NotShown { .. }));
        let away = match self.silent_changer() {
            Some(changer) => ToolAway::NotShown { changer },
            None => ToolAway::NotAttached,
        };
        let known = names(&self.attached);
        for tool in shown.tools.iter().filter(|tool| !known.contains(*tool)) {
            let away = away.clone();
            self.away.entry(tool.clone()).or_insert(away);
        }
    }

    /// Records that a changer has attached a tool; `None` if it is not known which.
    pub(crate) fn attach(&mut self, changer: &str, tool: Option<String>, by: ToolStep) {
        let before = self.take(changer);
        match &tool {
            // A tool that is not known may be any of them.
            None => self.away.clear(),
            Some(tool) => {
                if let Some(before) = before.and_then(|before| before.tool) {
                    let step = by.name.clone();
                    self.away.insert(before, ToolAway::Detached { step });
                }
                self.away.remove(tool);
            }
        }
        self.attached.push(AttachedTool {
            changer: changer.to_owned(),
            tool,
            by: Some(by),
            is_earlier: false,
            is_uncertain: false,
        });
    }

    /// Records that a changer has detached its tool.
    pub(crate) fn detach(&mut self, changer: &str, by: &ToolStep) {
        if let Some(tool) = self.take(changer).and_then(|before| before.tool) {
            let step = by.name.clone();
            self.away.insert(tool, ToolAway::Detached { step });
        }
    }

    /// Records that the tool of a changer is not known after a step, such as one that failed:
    /// neither the tool that was attached nor the named tool is known to be attached.
    pub(crate) fn lose(&mut self, changer: &str, tool: Option<String>, by: ToolStep) {
        let before = self.take(changer).and_then(|before| before.tool);
        for tool in before.into_iter().chain(tool) {
            let step = by.name.clone();
            self.away.insert(tool, ToolAway::Uncertain { step });
        }
        self.attached.push(AttachedTool {
            changer: changer.to_owned(),
            tool: None,
            by: Some(by),
            is_earlier: false,
            is_uncertain: true,
        });
    }

    /// Records that another round does steps again.
    pub(crate) fn repeat(&mut self, steps: &BTreeSet<usize>) {
        for tool in &mut self.attached {
            let by = tool.by.as_ref();
            tool.is_earlier |= by.is_some_and(|by| steps.contains(&by.number));
        }
    }

    /// Returns the tool that a changer is known to have.
    pub(crate) fn at(&self, changer: &str) -> Option<&str> {
        let mut attached = self.attached.iter();
        let of_changer = attached.find(|tool| tool.changer == changer)?;
        of_changer.tool.as_deref()
    }

    /// Checks that a component is not a tool that the run has detached.
    ///
    /// # Errors
    /// The step after which the tool is not attached, or not known to be.
    pub(crate) fn check_attached(&self, component: &str) -> Result<(), ToolFault> {
        match self.away.get(component).cloned() {
            Some(ToolAway::Detached { step }) => Err(ToolFault::Detached { step }),
            Some(ToolAway::Uncertain { step }) => Err(ToolFault::Uncertain { step }),
            Some(ToolAway::NotAttached) => Err(ToolFault::NotAttached),
            Some(ToolAway::NotShown { changer }) => Err(ToolFault::NotShown { changer }),
            None => Ok(()),
        }
    }

    /// Checks that a component may do a step: it is not a tool that is detached, and it is the
    /// attached tool if the step needs that tool. The attached tool is that of the last step that
    /// ends before the step begins.
    ///
    /// # Errors
    /// The reason why the component must not do the step.
    pub(crate) fn check(&self, user: &ToolUser<'_>, component: &str) -> Result<(), ToolFault> {
        self.check_attached(component)?;
        let (last, by) = (self.last(user), user.by);
        let step = last.and_then(|last| last.by.as_ref());
        match (last, step) {
            _ if matches!(by, By::SameAs(_)) => Ok(()),
            (Some(last), Some(step)) => match &last.tool {
                Some(tool) if tool == component => Ok(()),
                Some(tool) if by == By::AttachedTool || user.able.contains(tool) => {
                    Err(ToolFault::Other {
                        tool: tool.clone(),
                        step: step.name.clone(),
                    })
                }
                None if by == By::AttachedTool => Err(ToolFault::Unknown {
                    step: step.name.clone(),
                }),
                Some(_) | None => Ok(()),
            },
            // A component beside the tools from before the run may do a step too.
            _ if by == By::AttachedTool => self.check_before(component),
            _ => Ok(()),
        }
    }

    /// Checks that a component is a tool that was attached before the run and still is.
    fn check_before(&self, component: &str) -> Result<(), ToolFault> {
        let before = self.attached.iter().filter(|tool| tool.by.is_none());
        let mut tools = before.filter_map(|tool| tool.tool.as_ref());
        if tools.clone().any(|tool| tool == component) {
            return Ok(());
        }
        if let Some(changer) = self.silent_changer() {
            return Err(ToolFault::NoToolShown { changer });
        }
        Err(tools.next().map_or_else(
            || self.no_tool(),
            |tool| ToolFault::OtherBefore { tool: tool.clone() },
        ))
    }

    /// Returns a tool changer whose tool from before the run is not known.
    fn silent_changer(&self) -> Option<String> {
        let mut before = self.attached.iter().filter(|tool| tool.by.is_none());
        let silent = before.find(|tool| tool.tool.is_none())?;
        Some(silent.changer.clone())
    }

    /// Returns the tool that a step before a step has attached last, if it is known.
    pub(crate) fn tool_for(&self, user: &ToolUser<'_>) -> Option<&str> {
        let last = self.last(user).filter(|last| last.by.is_some());
        last?.tool.as_deref()
    }

    /// Returns whether the tool of a step is known.
    fn is_known(&self, user: &ToolUser<'_>) -> bool {
        let last = self.last(user);
        last.is_none_or(|last| last.by.is_none() || last.tool.is_some())
    }

    /// Returns the tool that was attached last before a step.
    fn last(&self, user: &ToolUser<'_>) -> Option<&AttachedTool> {
        let mut latest = self.attached.iter().rev();
        latest.find(|tool| user.follows(tool))
    }

    fn no_tool(&self) -> ToolFault {
        let mut away = self.away.values();
        let detached = away.find_map(|away| match away {
            ToolAway::Detached { step } => Some(ToolFault::NoneLeft { step: step.clone() }),
            ToolAway::Uncertain { .. } | ToolAway::NotAttached | ToolAway::NotShown { .. } => None,
        });
        detached.unwrap_or(ToolFault::NoTool)
    }

    /// Removes the tool of a changer that the run changes.
    fn take(&mut self, changer: &str) -> Option<AttachedTool> {
        self.changed.insert(changer.to_owned());
        let mut attached = self.attached.iter();
        let place = attached.position(|tool| tool.changer == changer)?;
        Some(self.attached.remove(place))
    }
}

/// Returns the ApplicationUris of attached tools.
fn names(attached: &[AttachedTool]) -> BTreeSet<&String> {
    let tools = attached.iter().filter_map(|tool| tool.tool.as_ref());
    tools.collect()
}

impl ToolUser<'_> {
    /// Returns whether the step begins after a tool was attached.
    fn follows(&self, tool: &AttachedTool) -> bool {
        let Some(of) = tool.by.as_ref().map(|by| by.number) else {
            return true;
        };
        // An earlier round of a loop is over when a step of the loop begins.
        let is_again = |one: &Loop| one.steps.contains(&of) && one.steps.contains(&self.number);
        self.behind.contains(&of) || (tool.is_earlier && self.loops.iter().any(is_again))
    }
}

/// A step of a plan that changes a tool.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct PlannedToolStep {
    pub(super) work: ToolWork,
    /// The changers that can do it.
    pub(super) changers: Vec<String>,
    /// The changer of an earlier step does it.
    pub(super) same_as: Option<usize>,
    /// The ApplicationUri of the tool; `None` if a result of a step names it.
    pub(super) tool: Option<String>,
    pub(super) step: ToolStep,
    /// Its conditions may not hold.
    pub(super) may_be_skipped: bool,
}

/// The tools that may be attached when a step begins: it is one of several cases.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct PossibleTools {
    cases: BTreeSet<AttachedTools>,
    /// There are more cases than are kept.
    has_more: bool,
}

impl PossibleTools {
    /// Maximum number of cases; a choice among more is checked when its step begins.
    const MOST_CASES: usize = 64;

    /// Returns the single case of tools that are known.
    pub(super) fn known(tools: &AttachedTools) -> Self {
        Self {
            cases: BTreeSet::from([tools.clone()]),
            has_more: false,
        }
    }

    /// Returns the tools before a step of a process: the tools that are attached now, and then the
    /// effects of the steps that end before it begins.
    pub(super) fn before(
        number: usize,
        process: &Process,
        (now, all): (&AttachedTools, &BTreeMap<usize, PlannedToolStep>),
    ) -> Self {
        let behind = process.behind(number);
        let mut possible = Self::known(now);
        let mut left: Vec<&PlannedToolStep> = behind.iter().filter_map(|of| all.get(of)).collect();
        while let Some(first) = left.first() {
            // The rounds of a loop are over when a step outside it begins.
            let of_loop = |one: &&Loop| {
                one.steps.contains(&first.step.number) && !one.steps.contains(&number)
            };
            let outermost = process.loops.iter().filter(of_loop);
            let outermost = outermost.max_by_key(|one| one.steps.len());
            let (body, rest): (Vec<_>, Vec<_>) = match outermost {
                Some(one) => left
                    .iter()
                    .copied()
                    .partition(|step| one.steps.contains(&step.step.number)),
                None => (vec![*first], left.iter().skip(1).copied().collect()),
            };
            possible.go(&body);
            if let Some(one) = outermost {
                possible.repeat(&body, &one.steps);
            }
            left = rest;
        }
        possible
    }

    /// Applies steps in their order.
    fn go(&mut self, steps: &[&PlannedToolStep]) {
        for step in steps {
            let mut after = self.after(step);
            if step.may_be_skipped {
                after.join(self);
            }
            *self = after;
        }
    }

    /// Adds the cases after further rounds of a loop, until no new case appears.
    fn repeat(&mut self, body: &[&PlannedToolStep], steps: &BTreeSet<usize>) {
        loop {
            let known = self.clone();
            let mut again = self.clone();
            again.cases = known
                .cases
                .iter()
                .cloned()
                .map(|mut case| {
                    case.repeat(steps);
                    case
                })
                .collect();
            again.go(body);
            self.join(&again);
            if *self == known || self.has_more {
                return;
            }
        }
    }

    /// Adds the cases of another way to the same step.
    pub(super) fn join(&mut self, other: &Self) {
        self.cases.extend(other.cases.iter().cloned());
        self.has_more |= other.has_more;
        while self.cases.len() > Self::MOST_CASES {
            self.cases.pop_last();
            self.has_more = true;
        }
    }

    /// Returns the cases after a step that is done by one of its changers.
    fn after(&self, step: &PlannedToolStep) -> Self {
        let mut after = Self {
            cases: BTreeSet::new(),
            has_more: self.has_more,
        };
        for case in &self.cases {
            for changer in step.changers_in(case) {
                let mut case = case.clone();
                match step.work {
                    ToolWork::Attach => {
                        case.attach(changer, step.tool.clone(), step.step.clone());
                    }
                    ToolWork::Detach => case.detach(changer, &step.step),
                }
                after.join(&Self::known(&case));
            }
        }
        after
    }

    /// Returns the number of cases in which a component must not do a step, and the reason of the
    /// first of them. A case whose tool is known only when the step begins counts too.
    pub(super) fn wrong(&self, user: &ToolUser<'_>, component: &str) -> (usize, Option<ToolFault>) {
        let faults = self.cases.iter().map(|case| case.check(user, component));
        let faults: Vec<_> = faults.filter_map(Result::err).collect();
        (faults.len(), faults.into_iter().next())
    }

    /// Returns whether, in each case, an earlier step has attached a tool to a tool changer for
    /// which `moves` returns true.
    pub(super) fn are_carried(&self, user: &ToolUser<'_>, moves: &dyn Fn(&str) -> bool) -> bool {
        self.are_all(|case| {
            let mut attached = case.attached.iter();
            attached.any(|tool| {
                let is_by_step = tool.by.is_some() && !tool.is_uncertain;
                is_by_step && user.follows(tool) && moves(&tool.changer)
            })
        })
    }

    /// Returns whether, in each case, the run has changed the tool of a tool changer for which
    /// `moves` returns true, and no such changer has a tool.
    pub(super) fn are_detached(&self, moves: &dyn Fn(&str) -> bool) -> bool {
        self.are_all(|case| {
            let is_changed = case.changed.iter().any(|changer| moves(changer));
            is_changed && !case.attached.iter().any(|tool| moves(&tool.changer))
        })
    }

    /// Returns whether all cases are known, and each of them meets a condition.
    fn are_all(&self, condition: impl Fn(&AttachedTools) -> bool) -> bool {
        !self.has_more && !self.cases.is_empty() && self.cases.iter().all(condition)
    }

    /// Returns the step of another branch that certainly changes the tool of a component in each
    /// case, although it has no order to the step that uses the tool.
    pub(super) fn changed_by<'a>(
        &self,
        (user, beside): (&ToolUser<'_>, &'a [PlannedToolStep]),
        component: &str,
    ) -> Option<&'a ToolStep> {
        let changes = |case: &AttachedTools, step: &PlannedToolStep| {
            let last = case.last(user).filter(|last| last.by.is_some());
            last.is_some_and(|last| {
                let is_its = last.tool.as_deref() == Some(component);
                is_its && step.changers == std::slice::from_ref(&last.changer)
            })
        };
        let mut beside = beside.iter();
        let always = |step: &&PlannedToolStep| self.cases.iter().all(|case| changes(case, step));
        beside.find(always).map(|step| &step.step)
    }

    /// Checks that a component may do a step in one of the cases. Which case it is is known when
    /// the step begins.
    ///
    /// # Errors
    /// The reason why it must not in any of them.
    pub(super) fn allows(&self, user: &ToolUser<'_>, component: &str) -> Result<(), ToolFault> {
        let is_open = |case: &AttachedTools| {
            let fault = case.check(user, component);
            fault.is_ok()
                || (!case.is_known(user) && matches!(fault, Err(ToolFault::Unknown { .. })))
        };
        match self.wrong(user, component).1 {
            Some(fault) if !self.has_more && !self.cases.iter().any(is_open) => Err(fault),
            Some(_) | None => Ok(()),
        }
    }
}

impl PlannedToolStep {
    /// Returns the changers that may do the step in a case. A detached tool belongs to a changer
    /// that has one.
    fn changers_in<'a>(&'a self, case: &'a AttachedTools) -> Vec<&'a str> {
        let attached = || case.attached.iter().rev();
        let same = self.same_as.and_then(|with| {
            let of_step = attached().find(|tool| {
                let by = tool.by.as_ref();
                by.is_some_and(|by| by.number == with)
            });
            of_step.map(|tool| tool.changer.as_str())
        });
        let can = |changer: &str| self.changers.iter().any(|known| known == changer);
        let mut with_tool = attached().filter(|tool| can(&tool.changer));
        let last = with_tool.clone().find(|tool| tool.by.is_some());
        let all = || self.changers.iter().map(String::as_str).collect::<Vec<_>>();
        match (same, self.work) {
            (Some(same), _) => vec![same],
            (None, ToolWork::Detach) => match (last, with_tool.next()) {
                (Some(last), _) => vec![last.changer.as_str()],
                // Each changer with a tool from before the run may do it.
                (None, Some(before)) => {
                    let others = with_tool.map(|tool| tool.changer.as_str());
                    std::iter::once(before.changer.as_str())
                        .chain(others)
                        .collect()
                }
                (None, None) => vec![self.changers.first().map_or("", String::as_str)],
            },
            (None, ToolWork::Attach) if self.changers.is_empty() => vec![""],
            (None, ToolWork::Attach) => all(),
        }
    }
}

#[cfg(test)]
mod tests;
