//! Assigns available skills to the needs of a process, with reasons. Planning is a pure function:
//! its input is the result of a query, its output is a plan.

mod judging;
mod tools;

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet};

use knowledge::QuestionAnswer;
use serde::Serialize;
use skills::choosing::{self, Attachment, CandidateRank, choose};
use skills::{ParameterType, Unchosen};

use crate::parameter_fault::ParameterFault;
use crate::process::{By, Group, Need, Process, ProcessStep, SkillRole, StepJob};

use judging::Judging;
pub(crate) use judging::TOOL;
pub(crate) use tools::{AttachedTools, ShownTools, ToolFault, ToolStep, ToolUser, ToolWork};

/// An available skill, as a row of the query `candidates`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Offer {
    /// Whether it is a skill of a component, and not a service of a module.
    pub(crate) is_skill: bool,
    /// IRIs of the component and of the skill.
    pub(crate) component: String,
    pub(crate) skill: String,
    pub(crate) component_name: String,
    pub(crate) name: String,
    /// Its type and supertypes, as `nsu=<namespace>;<BrowseName>`.
    pub(crate) types: Vec<String>,
    /// The classes of the capabilities that it realises.
    pub(crate) capabilities: Vec<String>,
    /// These classes and all their superclasses.
    pub(crate) closure: Vec<String>,
    pub(crate) endpoint: String,
    pub(crate) node: String,
    /// Time at which its component entered the graph, ms since 1970.
    pub(crate) since_ms: u64,
}

/// A skill or component that must not be chosen, and the reason.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Fallen {
    /// The IRI of the component.
    pub(crate) component: String,
    /// Time at which the component entered the graph. A component that enters again can be chosen
    /// again.
    pub(crate) since_ms: u64,
    /// The failed skill; `None` if the component is lost.
    pub(crate) skill: Option<String>,
    pub(crate) why: String,
}

/// The skills chosen for the steps, and the reasons.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub(crate) struct Plan {
    pub(crate) steps: Vec<PlannedStep>,
}

/// A step of a plan.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub(crate) struct PlannedStep {
    pub(crate) step: String,
    pub(crate) needs: Vec<PlannedNeed>,
}

/// A need of a step, and its candidates.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub(crate) struct PlannedNeed {
    pub(crate) role: &'static str,
    pub(crate) capability: Option<String>,
    #[serde(rename = "type")]
    pub(crate) skill_type: Option<String>,
    /// The IRI of the chosen skill.
    pub(crate) chosen: Option<String>,
    pub(crate) candidates: Vec<PlanCandidate>,
    #[serde(skip)]
    role_is: SkillRole,
    /// Whether the component of a completed step has to do it.
    #[serde(skip)]
    is_bound: bool,
    /// The components that can do it with the right tool.
    #[serde(skip)]
    able: BTreeSet<String>,
    /// Whether the tools that steps have changed exclude all candidates for good.
    #[serde(skip)]
    is_without_tool: bool,
    /// Whether the step was passed, so that it needs no skill.
    #[serde(skip)]
    is_passed: bool,
}

impl PlannedNeed {
    /// Creates a need whose skill is chosen without other candidates.
    fn chosen(need: &Need, offer: &Offer, why: &str) -> Self {
        Self {
            role: need.role.name(),
            capability: need.capability.clone(),
            skill_type: need.skill_type.as_ref().map(ToString::to_string),
            chosen: Some(offer.skill.clone()),
            candidates: vec![PlanCandidate {
                skill: offer.skill.clone(),
                name: offer.name.clone(),
                component: offer.component.clone(),
                component_name: offer.component_name.clone(),
                chosen: true,
                why: why.to_owned(),
            }],
            role_is: need.role,
            is_bound: true,
            able: BTreeSet::new(),
            is_without_tool: false,
            is_passed: false,
        }
    }
}

/// A skill that was considered.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub(crate) struct PlanCandidate {
    pub(crate) skill: String,
    pub(crate) name: String,
    pub(crate) component: String,
    pub(crate) component_name: String,
    pub(crate) chosen: bool,
    pub(crate) why: String,
}

impl Offer {
    /// Reads the result of the query `candidates`. `since` returns the time at which a component
    /// entered the graph, by its IRI.
    pub(crate) fn all(answer: &QuestionAnswer, since: &dyn Fn(&str) -> u64) -> Vec<Self> {
        let offer = |row| {
            let text = |column| QuestionAnswer::text(row, column).to_owned();
            let component = text("component");
            Self {
                is_skill: QuestionAnswer::text(row, "kind") == "skill",
                skill: text("skill"),
                component_name: text("component_name"),
                name: text("name"),
                types: QuestionAnswer::texts(row, "types"),
                capabilities: QuestionAnswer::texts(row, "capabilities"),
                closure: QuestionAnswer::texts(row, "closure"),
                endpoint: text("endpoint"),
                node: text("node"),
                since_ms: since(&component),
                component,
            }
        };
        answer.rows.iter().map(offer).collect()
    }
}

/// A step that is done, or its compensation, with the skill that was chosen for it. A later plan
/// keeps the choice.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct KeptStep {
    /// The number of the role.
    pub(crate) number: usize,
    pub(crate) offer: Offer,
}

/// The facts about a run that its next plan has to respect.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Situation<'a> {
    /// Failed skills and lost components.
    pub(crate) fallen: &'a [Fallen],
    /// The steps that are done.
    pub(crate) kept: &'a [KeptStep],
    /// The numbers of the steps that were passed without being done, or will be.
    pub(crate) passed: &'a [usize],
    /// The components that other runs use, with these runs.
    pub(crate) used: Option<&'a BTreeMap<String, String>>,
    /// The tools that were attached before the run, and those that the run has changed.
    pub(crate) tools: Option<&'a AttachedTools>,
}

impl Situation<'_> {
    /// Returns whether a role belongs to a step that was passed, or to its compensation.
    fn is_passed(&self, process: &Process, role: SkillRole) -> bool {
        self.passed.iter().any(|number| {
            [*number, process.compensation_of(*number)]
                .map(SkillRole::Alone)
                .contains(&role)
        })
    }
}

/// The facts about skills that a plan needs. Each check returns the reason why it fails.
pub(crate) trait Facts {
    /// Checks that an offer takes the parameters of the step or compensation with a number.
    fn takes(&self, offer: &Offer, step: (usize, &ProcessStep)) -> Result<(), ParameterFault>;

    /// Checks that an offer has the result of a name.
    fn gives(&self, offer: &Offer, result: &str) -> Result<(), ParameterFault>;

    /// Checks that a result of a skill, given by its IRI, can be a parameter of another skill.
    fn connects(&self, from: (&str, &str), to: (&str, &str)) -> Result<(), ParameterFault>;

    /// Checks that the robot of an offer reaches positions.
    fn reaches(&self, _offer: &Offer, _positions: &[[f64; 3]]) -> Result<(), ParameterFault> {
        Ok(())
    }

    /// Checks that the gripper of an offer may be at the flange of the robot of another offer.
    fn mounts(&self, _robot: &Offer, _gripper: &Offer) -> Result<(), Unchosen> {
        Ok(())
    }

    /// Returns the attachment of the component of an offer.
    fn attachment(&self, _offer: &Offer) -> Attachment {
        Attachment::None
    }

    /// Returns whether the component of an offer moves a tool changer, given by its IRI.
    fn moves(&self, _offer: &Offer, _changer: &str) -> bool {
        false
    }

    /// Returns the components that the user prefers, the most preferred first.
    fn prefer(&self) -> &[String] {
        &[]
    }
}

/// Returns the rank of an offer with an attachment for needs.
fn rank(
    needs: &[&Need],
    (offer, attachment): (&Offer, Attachment),
    facts: &dyn Facts,
) -> CandidateRank {
    CandidateRank {
        attachment,
        preference: CandidateRank::preference(facts.prefer(), &offer.component),
        inexact: usize::from(!is_exact(needs, offer)),
        since_ms: offer.since_ms,
        name: offer.component.clone(),
    }
}

/// Plans a process with the available skills. The parameters that queries give have their values
/// in the process; a parameter whose value is null gets it when its step begins.
pub(crate) fn plan(
    process: &Process,
    offers: &[Offer],
    situation: Situation<'_>,
    facts: &dyn Facts,
) -> Plan {
    let mut roles: BTreeMap<SkillRole, Vec<&Need>> = BTreeMap::new();
    let needs = process.numbered().flat_map(|(_, step)| &step.needs);
    for need in needs.filter(|need| !situation.is_passed(process, need.role)) {
        roles.entry(need.role).or_default().push(need);
    }
    let mut judging = Judging::new(process, situation, facts);
    judging.require_tools(offers);
    let mut fitting: BTreeMap<SkillRole, Vec<&Offer>> = roles
        .iter()
        .map(|(role, needs)| {
            if let Some(kept) = judging.kept(*role) {
                return (*role, vec![kept]);
            }
            let fits = |offer: &&Offer| needs.iter().all(|need| judging.fits(need, offer));
            (*role, offers.iter().filter(fits).collect())
        })
        .collect();
    let groups = bind(process, &roles, &fitting);
    judging.bind(&groups);
    for (role, fitting) in &mut fitting {
        if judging.kept(*role).is_none() {
            fitting.retain(|offer| judging.is_allowed(*role, offer));
        }
    }
    if process.work != StepJob::Sequence {
        pair(&roles, &mut fitting, (facts, &mut judging));
    }
    let all: BTreeSet<Group> = groups.values().copied().collect();
    let teams: BTreeMap<Group, Team<'_>> = all
        .into_iter()
        .map(|group| {
            let roles = roles.iter();
            let of_group = roles.filter(|(role, _)| groups.get(role) == Some(&group));
            let roles: Vec<_> = of_group
                .map(|(role, needs)| (*role, needs.clone()))
                .collect();
            (group, Team::of(&roles, &fitting, (facts, &judging)))
        })
        .collect();
    let team = |need: &Need| groups.get(&need.role).and_then(|group| teams.get(group));
    let steps = process.numbered().map(|(_, step)| PlannedStep {
        step: step.name.clone(),
        needs: step
            .needs
            .iter()
            .map(|need| judging.planned(need, offers, team(need)))
            .collect(),
    });
    let mut plan = Plan {
        steps: steps.collect(),
    };
    judging.connect(&mut plan);
    plan
}

/// Leaves the robots with a gripper that may be at their flange, and then the grippers that may be
/// at the flange of the chosen robot.
fn pair<'a>(
    roles: &BTreeMap<SkillRole, Vec<&Need>>,
    fitting: &mut BTreeMap<SkillRole, Vec<&'a Offer>>,
    (facts, judging): (&dyn Facts, &mut Judging<'_>),
) {
    // A single offer of each component.
    let components = |fitting: &BTreeMap<SkillRole, Vec<&'a Offer>>, group: Group| {
        let of_group = fitting.iter().filter(|(role, _)| role.group() == group);
        let offers = of_group.flat_map(|(_, offers)| offers.iter().copied());
        let offers: BTreeMap<&str, &'a Offer> = offers
            .map(|offer| (offer.component.as_str(), offer))
            .collect();
        offers
    };
    let grippers = components(fitting, Group::Tool);
    let faults = |robot: &Offer| -> BTreeMap<String, String> {
        let faults = grippers.iter().filter_map(|(name, gripper)| {
            let why = facts.mounts(robot, gripper).err()?;
            Some(((*name).to_owned(), why.to_string()))
        });
        faults.collect()
    };
    for (name, robot) in components(fitting, Group::Robot) {
        let mut faults = faults(robot);
        if faults.len() == grippers.len()
            && let Some((_, why)) = faults.pop_first()
        {
            judging.exclude(Group::Robot, name, why);
        }
    }
    let retain = |fitting: &mut BTreeMap<SkillRole, Vec<&'a Offer>>, judging: &Judging<'_>| {
        for (role, offers) in fitting.iter_mut() {
            offers.retain(|offer| judging.excluded(*role, offer).is_none());
        }
    };
    retain(fitting, &*judging);
    let of_robot = roles.iter();
    let of_robot = of_robot.filter(|(role, _)| role.group() == Group::Robot);
    let of_robot: Vec<_> = of_robot
        .map(|(role, needs)| (*role, needs.clone()))
        .collect();
    let chosen = Team::of(&of_robot, fitting, (facts, &*judging)).chosen;
    if let Some(robot) = chosen.into_values().next() {
        for (name, why) in faults(robot) {
            judging.exclude(Group::Tool, &name, why);
        }
        retain(fitting, &*judging);
    }
}

/// Returns the group of each role: the roles of a group are filled by one component. In a sequence
/// a release belongs to the last grasp before it, and a detached tool to the changer that attached
/// it, unless the process says otherwise.
fn bind(
    process: &Process,
    roles: &BTreeMap<SkillRole, Vec<&Need>>,
    fitting: &BTreeMap<SkillRole, Vec<&Offer>>,
) -> BTreeMap<SkillRole, Group> {
    let mut groups: BTreeMap<SkillRole, Group> =
        roles.keys().map(|role| (*role, role.group())).collect();
    if process.work != StepJob::Sequence {
        return groups;
    }
    let mut join = |number: usize, with: usize| {
        let of = |role: SkillRole| groups.get(&role).copied();
        let (one, other) = (of(SkillRole::Alone(number)), of(SkillRole::Alone(with)));
        if let (Some(one), Some(other)) = (one, other) {
            for group in groups.values_mut().filter(|group| **group == one) {
                *group = other;
            }
        }
    };
    let fits = |number: usize| {
        let fitting = fitting.get(&SkillRole::Alone(number));
        fitting.into_iter().flatten().copied()
    };
    let is_of = |number: usize, of: &str| {
        let of = ParameterType::own(of);
        let needs = roles.get(&SkillRole::Alone(number)).into_iter().flatten();
        let is_named = needs
            .clone()
            .any(|need| need.skill_type.as_ref() == Some(&of));
        is_named || fits(number).any(|offer| offer.types.contains(&of.to_string()))
    };
    for (opens, closes) in PAIRS {
        let mut open: Vec<usize> = Vec::new();
        for (number, step) in process.steps.iter().enumerate() {
            if is_of(number, opens) {
                open.push(number);
            } else if let By::SameAs(with) = step.by {
                open.retain(|known| *known != with || !is_of(number, closes));
            } else if is_of(number, closes) {
                let can = |known: &&usize| {
                    fits(**known)
                        .any(|one| fits(number).any(|other| one.component == other.component))
                };
                let with = open.iter().rev().find(can).or_else(|| open.last()).copied();
                if let Some(with) = with {
                    join(number, with);
                    open.retain(|known| *known != with);
                }
            }
        }
    }
    for (number, step) in process.numbered() {
        if let By::SameAs(with) = step.by {
            join(number, with);
        }
    }
    groups
}

impl Plan {
    /// Creates the plan of compensations, whose skills were chosen with their steps.
    pub(crate) fn of<'a>(chosen: impl Iterator<Item = (&'a ProcessStep, &'a Offer)>) -> Self {
        let why = "it was chosen with the step that it undoes";
        let steps = chosen.map(|(step, offer)| PlannedStep {
            step: step.name.clone(),
            needs: step
                .needs
                .iter()
                .map(|need| PlannedNeed::chosen(need, offer, why))
                .collect(),
        });
        Self {
            steps: steps.collect(),
        }
    }

    /// Returns whether a skill is chosen for each need.
    pub(crate) fn is_complete(&self) -> bool {
        self.needs().all(|(_, need)| need.chosen.is_some())
    }

    /// Returns whether a need has no skill because only the component of a completed step could do
    /// it: no component that comes later can help.
    pub(crate) fn is_hopeless(&self) -> bool {
        self.needs()
            .any(|(_, need)| need.chosen.is_none() && need.is_bound)
    }

    /// Returns whether a need has no skill because of the tools that steps have changed.
    pub(crate) fn lacks_tool(&self) -> bool {
        self.needs()
            .any(|(_, need)| need.chosen.is_none() && need.is_without_tool)
    }

    /// Returns the needs without a skill, as text for people.
    pub(crate) fn missing(&self) -> String {
        let missing = self.needs().filter(|(_, need)| need.chosen.is_none());
        let told = missing.map(|(step, need)| {
            let wanted = match (&need.capability, &need.skill_type) {
                (Some(capability), Some(of)) => format!("{capability} by a skill of {of}"),
                (Some(capability), None) => capability.clone(),
                (None, Some(of)) => format!("a skill of {of}"),
                (None, None) => "a skill".to_owned(),
            };
            let looked_at: Vec<_> = need
                .candidates
                .iter()
                .map(|candidate| {
                    format!(
                        "{}.{}: {}",
                        candidate.component_name, candidate.name, candidate.why
                    )
                })
                .collect();
            let looked_at = if looked_at.is_empty() {
                "there is none".to_owned()
            } else {
                looked_at.join("; ")
            };
            format!("{step} needs {wanted} for {} ({looked_at})", need.role)
        });
        told.collect::<Vec<_>>().join(", ")
    }

    /// Returns the IRI of the skill for a role.
    pub(crate) fn chosen(&self, role: SkillRole) -> Option<&str> {
        self.needs()
            .find(|(_, need)| need.role_is == role)
            .and_then(|(_, need)| need.chosen.as_deref())
    }

    /// Returns the components that can do a step with the right tool.
    pub(crate) fn able(&self, role: SkillRole) -> BTreeSet<String> {
        let mut needs = self.needs();
        let need = needs.find(|(_, need)| need.role_is == role);
        need.map(|(_, need)| need.able.clone()).unwrap_or_default()
    }

    /// Takes back the choice for a role.
    fn refuse(&mut self, role: SkillRole, why: &str) {
        let needs = self.steps.iter_mut().flat_map(|step| &mut step.needs);
        for need in needs.filter(|need| need.role_is == role) {
            need.chosen = None;
            for candidate in need.candidates.iter_mut().filter(|known| known.chosen) {
                candidate.chosen = false;
                why.clone_into(&mut candidate.why);
            }
        }
    }

    fn needs(&self) -> impl Iterator<Item = (&str, &PlannedNeed)> {
        self.steps
            .iter()
            .flat_map(|step| step.needs.iter().map(|need| (step.step.as_str(), need)))
            .filter(|(_, need)| !need.is_passed)
    }
}

/// The component that fills the roles of a group.
struct Team<'a> {
    /// The skills by role; empty if no component can fill all roles.
    chosen: BTreeMap<SkillRole, &'a Offer>,
    /// The missing roles of each component that cannot fill all.
    lacks: BTreeMap<&'a str, Vec<SkillRole>>,
}

impl<'a> Team<'a> {
    fn of(
        roles: &[(SkillRole, Vec<&Need>)],
        fitting: &BTreeMap<SkillRole, Vec<&'a Offer>>,
        (facts, judging): (&dyn Facts, &Judging<'_>),
    ) -> Self {
        let of_role = |role: &SkillRole| fitting.get(role).into_iter().flatten().copied();
        let components: BTreeSet<&str> = roles
            .iter()
            .flat_map(|(role, _)| of_role(role))
            .map(|offer| offer.component.as_str())
            .collect();
        let mut lacks = BTreeMap::new();
        let mut teams = Vec::new();
        for component in components {
            let mut chosen = BTreeMap::new();
            let mut whole = CandidateRank::default();
            let mut wrong = 0_usize;
            for (role, needs) in roles {
                let of_component = of_role(role).filter(|offer| offer.component == component);
                let best = of_component
                    .min_by_key(|offer| (Reverse(is_exact(needs, offer)), offer.skill.as_str()));
                if let Some(best) = best {
                    let attachment = judging.attachment(*role, best);
                    let rank = rank(needs, (best, attachment), facts);
                    whole = CandidateRank {
                        attachment: whole.attachment.min(rank.attachment),
                        inexact: whole.inexact + rank.inexact,
                        ..rank
                    };
                    chosen.insert(*role, best);
                    wrong = wrong.saturating_add(judging.wrong_tools(*role, best));
                }
            }
            if chosen.len() == roles.len() {
                let candidate = choosing::SkillCandidate {
                    of: chosen,
                    name: component.to_owned(),
                    fits: Ok(()),
                    rank: whole,
                };
                teams.push((wrong, candidate));
            } else {
                let missing = roles
                    .iter()
                    .map(|(role, _)| *role)
                    .filter(|role| !chosen.contains_key(role))
                    .collect();
                lacks.insert(component, missing);
            }
        }
        // The choice is right for as many of the tools that may be attached as possible.
        let least = teams.iter().map(|(wrong, _)| *wrong).min();
        teams.retain(|(wrong, _)| Some(*wrong) == least);
        let teams = teams.into_iter().map(|(_, candidate)| candidate).collect();
        // The names of components differ, so no two of them are equal.
        let chosen = choose(teams).map(|choice| choice.chosen);
        Self {
            chosen: chosen.unwrap_or_default(),
            lacks,
        }
    }
}

/// Returns whether the offer realises exactly the needed capabilities, not only subclasses of them.
fn is_exact(needs: &[&Need], offer: &Offer) -> bool {
    needs
        .iter()
        .filter_map(|need| need.capability.as_ref())
        .all(|wanted| offer.capabilities.contains(wanted))
}

/// Pairs of skill types that one component has to do: the second type ends the effect of the first.
const PAIRS: [(&str, &str); 2] = [
    ("GraspSkillType", "ReleaseSkillType"),
    ("AttachToolSkillType", "DetachToolSkillType"),
];
#[cfg(test)]
mod tests;
