//! Assigns available skills to the needs of a process, with reasons. Planning is a pure function:
//! its input is the result of a query, its output is a plan.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet};

use knowledge::Answer;
use serde::Serialize;
use skills::TypeName;

use crate::process::{By, Group, Job, Need, Process, Role, Step};

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
    pub(crate) candidates: Vec<Candidate>,
    #[serde(skip)]
    role_is: Role,
}

/// A skill that was considered.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub(crate) struct Candidate {
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
    pub(crate) fn all(answer: &Answer, since: &dyn Fn(&str) -> u64) -> Vec<Self> {
        let offer = |row| {
            let text = |column| Answer::text(row, column).to_owned();
            let component = text("component");
            Self {
                is_skill: Answer::text(row, "kind") == "skill",
                skill: text("skill"),
                component_name: text("component_name"),
                name: text("name"),
                types: Answer::texts(row, "types"),
                capabilities: Answer::texts(row, "capabilities"),
                closure: Answer::texts(row, "closure"),
                endpoint: text("endpoint"),
                node: text("node"),
                since_ms: since(&component),
                component,
            }
        };
        answer.rows.iter().map(offer).collect()
    }
}

/// Returns the reason why an offer cannot take the parameters of a step.
pub(crate) type Check<'a> = dyn Fn(&Offer, &Step) -> Result<(), String> + 'a;

/// Plans a process with the available skills, except failed skills and lost components. `check`
/// judges the parameters of the steps.
pub(crate) fn plan(
    process: &Process,
    offers: &[Offer],
    fallen: &[Fallen],
    check: &Check<'_>,
) -> Plan {
    let mut roles: BTreeMap<Role, Vec<&Need>> = BTreeMap::new();
    for need in process.steps.iter().flat_map(|step| &step.needs) {
        roles.entry(need.role).or_default().push(need);
    }
    let mut judging = Judging {
        process,
        fallen,
        check,
        tools: BTreeMap::new(),
    };
    judging.tools = judging.attached_tools(offers);
    let fitting: BTreeMap<Role, Vec<&Offer>> = roles
        .iter()
        .map(|(role, needs)| {
            let fits = |offer: &&Offer| needs.iter().all(|need| judging.judge(need, offer).is_ok());
            (*role, offers.iter().filter(fits).collect())
        })
        .collect();
    let groups = bind(process, &roles, &fitting);
    let all: BTreeSet<Group> = groups.values().copied().collect();
    let teams: BTreeMap<Group, Team<'_>> = all
        .into_iter()
        .map(|group| {
            let roles = roles.iter();
            let of_group = roles.filter(|(role, _)| groups.get(role) == Some(&group));
            let roles: Vec<_> = of_group
                .map(|(role, needs)| (*role, needs.clone()))
                .collect();
            (group, Team::of(&roles, &fitting))
        })
        .collect();
    let team = |need: &Need| groups.get(&need.role).and_then(|group| teams.get(group));
    let steps = process.steps.iter().map(|step| PlannedStep {
        step: step.name.clone(),
        needs: step
            .needs
            .iter()
            .map(|need| judging.planned(need, offers, team(need)))
            .collect(),
    });
    Plan {
        steps: steps.collect(),
    }
}

/// Returns the group of each role: the roles of a group are filled by one component. In a sequence
/// a release belongs to the last grasp before it, and a detached tool to the changer that attached
/// it, unless the process says otherwise.
fn bind(
    process: &Process,
    roles: &BTreeMap<Role, Vec<&Need>>,
    fitting: &BTreeMap<Role, Vec<&Offer>>,
) -> BTreeMap<Role, Group> {
    let mut groups: BTreeMap<Role, Group> =
        roles.keys().map(|role| (*role, role.group())).collect();
    if process.work != Job::Sequence {
        return groups;
    }
    let mut join = |number: usize, with: usize| {
        let of = |role: Role| groups.get(&role).copied();
        let (one, other) = (of(Role::Alone(number)), of(Role::Alone(with)));
        if let (Some(one), Some(other)) = (one, other) {
            for group in groups.values_mut().filter(|group| **group == one) {
                *group = other;
            }
        }
    };
    let fits = |number: usize| {
        let fitting = fitting.get(&Role::Alone(number));
        fitting.into_iter().flatten().copied()
    };
    let is_of = |number: usize, of: &str| {
        let of = TypeName::own(of);
        let needs = roles.get(&Role::Alone(number)).into_iter().flatten();
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
    for (number, step) in process.steps.iter().enumerate() {
        if let By::SameAs(with) = step.by {
            join(number, with);
        }
    }
    groups
}

impl Plan {
    /// Returns whether a skill is chosen for each need.
    pub(crate) fn is_complete(&self) -> bool {
        self.needs().all(|(_, need)| need.chosen.is_some())
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
    pub(crate) fn chosen(&self, role: Role) -> Option<&str> {
        self.needs()
            .find(|(_, need)| need.role_is == role)
            .and_then(|(_, need)| need.chosen.as_deref())
    }

    fn needs(&self) -> impl Iterator<Item = (&str, &PlannedNeed)> {
        self.steps
            .iter()
            .flat_map(|step| step.needs.iter().map(|need| (step.step.as_str(), need)))
    }
}

/// The component that fills the roles of a group.
struct Team<'a> {
    /// The skills by role; empty if no component can fill all roles.
    chosen: BTreeMap<Role, &'a Offer>,
    /// The missing roles of each component that cannot fill all.
    lacks: BTreeMap<&'a str, Vec<Role>>,
}

impl<'a> Team<'a> {
    fn of(roles: &[(Role, Vec<&Need>)], fitting: &BTreeMap<Role, Vec<&'a Offer>>) -> Self {
        let of_role = |role: &Role| fitting.get(role).into_iter().flatten().copied();
        let components: BTreeSet<&str> = roles
            .iter()
            .flat_map(|(role, _)| of_role(role))
            .map(|offer| offer.component.as_str())
            .collect();
        let mut lacks = BTreeMap::new();
        let mut teams = Vec::new();
        for component in components {
            let mut chosen = BTreeMap::new();
            let mut exact = 0;
            for (role, needs) in roles {
                let of_component = of_role(role).filter(|offer| offer.component == component);
                let best = of_component
                    .min_by_key(|offer| (Reverse(is_exact(needs, offer)), offer.skill.as_str()));
                if let Some(best) = best {
                    exact += usize::from(is_exact(needs, best));
                    chosen.insert(*role, best);
                }
            }
            if chosen.len() == roles.len() {
                teams.push((exact, chosen));
            } else {
                let missing = roles
                    .iter()
                    .map(|(role, _)| *role)
                    .filter(|role| !chosen.contains_key(role))
                    .collect();
                lacks.insert(component, missing);
            }
        }
        // Components with the exact capabilities come before components with subclasses; then the
        // longest available component comes first.
        let rank = |(exact, chosen): &(usize, BTreeMap<Role, &'a Offer>)| {
            let first = chosen.values().next();
            (
                Reverse(*exact),
                first.map(|offer| offer.since_ms),
                first.map(|offer| offer.component.as_str()),
            )
        };
        let best = teams
            .into_iter()
            .min_by(|one, other| rank(one).cmp(&rank(other)));
        Self {
            chosen: best.map(|(_, chosen)| chosen).unwrap_or_default(),
            lacks,
        }
    }
}

#[derive(Debug, Clone, PartialEq, Eq)]
enum NotFit {
    Unrelated,
    Because(String),
}

/// The judgement of offers for a process.
struct Judging<'a> {
    process: &'a Process,
    fallen: &'a [Fallen],
    check: &'a Check<'a>,
    /// The tools that have to fill roles, with the steps that attach them.
    tools: BTreeMap<Role, Option<Attached>>,
}

/// A tool by its IRI, and the name of the step that attaches it.
type Attached = (String, String);

impl Judging<'_> {
    /// Returns the step of a sequence that has a role.
    fn step(&self, role: Role) -> Option<&Step> {
        match role {
            Role::Alone(number) => self.process.steps.get(number),
            Role::Ptp | Role::Linear | Role::Grasp | Role::Release => None,
        }
    }

    /// Returns the tools that have to fill roles: a tool that a step attaches does all later steps
    /// that it can do, until another tool is attached.
    fn attached_tools(&self, offers: &[Offer]) -> BTreeMap<Role, Option<Attached>> {
        let mut tools = BTreeMap::new();
        if self.process.work != Job::Sequence {
            return tools;
        }
        let mut attached: Option<Attached> = None;
        for (number, step) in self.process.steps.iter().enumerate() {
            let role = Role::Alone(number);
            let fits = |offer: &&Offer| {
                step.needs
                    .iter()
                    .all(|need| self.judge(need, offer).is_ok())
            };
            let is_tool = |of: &str| {
                let of = TypeName::own(of).to_string();
                let named = step
                    .needs
                    .iter()
                    .filter_map(|need| need.skill_type.as_ref());
                named.into_iter().any(|named| named.to_string() == of)
                    || offers
                        .iter()
                        .filter(fits)
                        .any(|offer| offer.types.contains(&of))
            };
            if is_tool("AttachToolSkillType") || is_tool("ChangeToolSkillType") {
                let named = step.parameters.iter().find(|given| given.name == TOOL);
                attached = named
                    .and_then(|given| given.value.as_str())
                    .map(|tool| (tool.to_owned(), step.name.clone()));
                continue;
            }
            let can = |tool: &str| {
                let mut fitting = offers.iter().filter(fits);
                fitting.any(|offer| offer.component == tool)
            };
            let is_bound = match (&attached, step.by) {
                (_, By::AttachedTool) => true,
                (Some((tool, _)), By::Any) => can(tool),
                (None, By::Any) | (_, By::SameAs(_)) => false,
            };
            if is_bound {
                tools.insert(role, attached.clone());
            }
        }
        tools
    }

    fn planned(&self, need: &Need, offers: &[Offer], team: Option<&Team<'_>>) -> PlannedNeed {
        let chosen = team.and_then(|team| team.chosen.get(&need.role)).copied();
        let mut candidates = Vec::new();
        for offer in offers {
            let judged = self.judge(need, offer);
            // Skills with neither the capability nor the type are not listed as candidates.
            if judged == Err(NotFit::Unrelated) {
                continue;
            }
            let is_chosen = chosen.is_some_and(|chosen| chosen.skill == offer.skill);
            let why = match judged {
                Ok(fit) if is_chosen => fit,
                Ok(_) => self.why_not(need, offer, chosen, team),
                Err(NotFit::Unrelated) => String::new(),
                Err(NotFit::Because(why)) => why,
            };
            candidates.push(Candidate {
                skill: offer.skill.clone(),
                name: offer.name.clone(),
                component: offer.component.clone(),
                component_name: offer.component_name.clone(),
                chosen: is_chosen,
                why,
            });
        }
        candidates.sort_by(|one, other| {
            (Reverse(one.chosen), &one.skill).cmp(&(Reverse(other.chosen), &other.skill))
        });
        PlannedNeed {
            role: need.role.name(),
            capability: need.capability.clone(),
            skill_type: need.skill_type.as_ref().map(ToString::to_string),
            chosen: chosen.map(|offer| offer.skill.clone()),
            candidates,
            role_is: need.role,
        }
    }

    /// Returns the reason why an offer fits a need, or why it does not.
    fn judge(&self, need: &Need, offer: &Offer) -> Result<String, NotFit> {
        let has_capability = need
            .capability
            .as_ref()
            .is_none_or(|wanted| offer.closure.contains(wanted));
        let has_type = need
            .skill_type
            .as_ref()
            .is_none_or(|wanted| offer.types.contains(&wanted.to_string()));
        let is_related = (need.capability.is_some() && has_capability)
            || (need.skill_type.is_some() && has_type);
        if !is_related {
            return Err(NotFit::Unrelated);
        }
        let because = |why: String| Err(NotFit::Because(why));
        if !offer.is_skill {
            return because(
                "it is a service in a manifest; `ua-component` with `device: {mtp: ..}` runs it as a skill"
                    .to_owned(),
            );
        }
        if let (false, Some(wanted)) = (has_capability, &need.capability) {
            let has = if offer.capabilities.is_empty() {
                "no capability".to_owned()
            } else {
                offer.capabilities.join(", ")
            };
            return because(format!(
                "it realises {has}, and none of that is {wanted} or below it"
            ));
        }
        if let (false, Some(wanted)) = (has_type, &need.skill_type) {
            return because(format!("its type is not {wanted} or below it"));
        }
        let fell = self.fallen.iter().find(|fallen| {
            fallen.component == offer.component
                && fallen.since_ms == offer.since_ms
                && fallen
                    .skill
                    .as_ref()
                    .is_none_or(|skill| *skill == offer.skill)
        });
        if let Some(fallen) = fell {
            return because(fallen.why.clone());
        }
        match self.tools.get(&need.role) {
            Some(None) => return because("no step before it attaches a tool".to_owned()),
            Some(Some((tool, step))) if *tool != offer.component => {
                return because(format!(
                    "it is not of the tool {tool}, which the step `{step}` attaches"
                ));
            }
            Some(Some(_)) | None => {}
        }
        if let Some(step) = self.step(need.role) {
            (self.check)(offer, step).map_err(NotFit::Because)?;
        }
        let capability = need.capability.as_ref().map(|wanted| {
            if offer.capabilities.contains(wanted) {
                format!("it realises {wanted}")
            } else {
                format!(
                    "it realises {}, which is below {wanted}",
                    offer.capabilities.join(", ")
                )
            }
        });
        let of_type = need
            .skill_type
            .as_ref()
            .map(|wanted| format!("its type is {} or below it", wanted.name));
        let reasons: Vec<String> = capability.into_iter().chain(of_type).collect();
        Ok(reasons.join(", "))
    }

    /// Returns the reason why a fitting offer is not chosen.
    fn why_not(
        &self,
        need: &Need,
        offer: &Offer,
        chosen: Option<&Offer>,
        team: Option<&Team<'_>>,
    ) -> String {
        if let Some(lacking) = team.and_then(|team| team.lacks.get(offer.component.as_str())) {
            let lacking: Vec<_> = lacking
                .iter()
                .map(|role| match self.step(*role) {
                    Some(step) => format!("the step `{}`", step.name),
                    None => role.name().to_owned(),
                })
                .collect();
            return format!(
                "it would fit, but its component has nothing for {}",
                lacking.join(" and ")
            );
        }
        let Some(chosen) = chosen else {
            return "it would fit this step".to_owned();
        };
        let better = if is_exact(&[need], chosen) && !is_exact(&[need], offer) {
            "is of just this capability"
        } else if chosen.since_ms < offer.since_ms {
            "has been there for longer"
        } else {
            "comes first by its name"
        };
        format!(
            "it would fit, but {}.{} {better}",
            chosen.component_name, chosen.name
        )
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
/// The parameter that names a tool by its ApplicationUri.
const TOOL: &str = "ToolAppUri";

#[cfg(test)]
mod tests;
