//! The judgement of offers for the needs of a process, with reasons.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet};

use skills::ParameterType;
use skills::choosing::Attachment;

use super::tools::{
    AttachedTools, PlannedToolStep, PossibleTools, ToolFault, ToolStep, ToolUser, ToolWork,
};
use super::{Facts, Offer, Plan, PlanCandidate, PlannedNeed, Situation, Team, rank};
use crate::parameter_fault::ParameterFault;
use crate::process::{By, Group, Loop, Need, Process, ProcessStep, SkillRole, StepJob};

#[derive(Debug, Clone, PartialEq, Eq)]
enum NotFit {
    Unrelated,
    Because(String),
    Tool(ToolFault),
}

impl From<ParameterFault> for NotFit {
    fn from(fault: ParameterFault) -> Self {
        Self::Because(fault.to_string())
    }
}

/// The judgement of offers for a process.
pub(super) struct Judging<'a> {
    process: &'a Process,
    situation: Situation<'a>,
    facts: &'a dyn Facts,
    /// The steps that may need a tool.
    tools: BTreeMap<SkillRole, StepTools>,
    /// The completed steps whose components have to fill roles.
    bound: BTreeMap<SkillRole, Bound<'a>>,
    /// The robots and grippers that are excluded because they are not attached to each other, with
    /// the reasons.
    apart: BTreeMap<(Group, String), String>,
}

/// A completed step, and the component that did it.
#[derive(Debug, Clone, Copy)]
struct Bound<'a> {
    step: &'a str,
    offer: &'a Offer,
}

impl Bound<'_> {
    /// Returns whether an offer is of the component as it did the step. A component that was lost
    /// meanwhile may have lost the effect of the step.
    fn is_it(&self, offer: &Offer) -> bool {
        self.offer.component == offer.component && self.offer.since_ms == offer.since_ms
    }

    /// Returns the reason why an offer of another component cannot fill the role.
    fn why(&self, offer: &Offer) -> String {
        let (step, name) = (self.step, &self.offer.component_name);
        match self.offer.component == offer.component {
            true => format!("its component was lost after it had done the step `{step}`"),
            false => format!("{name} has done the step `{step}`, and has to do this one too"),
        }
    }
}

/// A step that may need a tool, and the tools that may be attached when it begins.
struct StepTools {
    number: usize,
    by: By,
    behind: BTreeSet<usize>,
    able: BTreeSet<String>,
    possible: PossibleTools,
    /// Steps of other branches that begin no later, and change a tool.
    beside: Vec<PlannedToolStep>,
    loops: Vec<Loop>,
}

impl StepTools {
    fn user(&self) -> ToolUser<'_> {
        ToolUser {
            number: self.number,
            by: self.by,
            behind: &self.behind,
            able: &self.able,
            loops: &self.loops,
        }
    }
}

/// Returns the effect of a step on tools, if it has one. `fitting` are the skills that can do it.
fn planned_tool_step(
    (number, step): (usize, &ProcessStep),
    fitting: &[&Offer],
) -> Option<PlannedToolStep> {
    let mut types = step
        .needs
        .iter()
        .filter_map(|need| need.skill_type.as_ref());
    let named = types.find_map(|named| {
        let mut known = ToolWork::TYPES.into_iter();
        known.find(|(of, _)| ParameterType::own(of) == *named)
    });
    let named = named.map(|(_, work)| work);
    let work = named.or_else(|| fitting.iter().find_map(|offer| ToolWork::of(offer)))?;
    let changers = fitting.iter().filter(|offer| ToolWork::of(offer).is_some());
    let changers: BTreeSet<String> = changers.map(|offer| offer.component.clone()).collect();
    let given = step.parameters.iter().find(|given| given.name == TOOL);
    Some(PlannedToolStep {
        work,
        changers: changers.into_iter().collect(),
        same_as: match step.by {
            By::SameAs(with) => Some(with),
            By::Any | By::AttachedTool => None,
        },
        tool: given
            .and_then(|given| given.value.as_str())
            .map(str::to_owned),
        step: ToolStep {
            number,
            name: step.name.clone(),
        },
        may_be_skipped: !step.when.is_empty(),
    })
}

impl<'a> Judging<'a> {
    pub(super) const fn new(
        process: &'a Process,
        situation: Situation<'a>,
        facts: &'a dyn Facts,
    ) -> Self {
        Self {
            process,
            situation,
            facts,
            tools: BTreeMap::new(),
            bound: BTreeMap::new(),
            apart: BTreeMap::new(),
        }
    }

    /// Excludes a component from the roles of a group.
    pub(super) fn exclude(&mut self, group: Group, component: &str, why: String) {
        self.apart.insert((group, component.to_owned()), why);
    }

    /// Returns the reason why the component of an offer is excluded from a role, if it is.
    pub(super) fn excluded(&self, role: SkillRole, offer: &Offer) -> Option<&String> {
        self.apart.get(&(role.group(), offer.component.clone()))
    }

    /// Requires the tools that steps attach for the steps that they can do.
    pub(super) fn require_tools(&mut self, offers: &[Offer]) {
        self.tools = self.tool_users(offers);
    }

    /// Returns the components with a skill that can do a step of a sequence, whether the tools that
    /// may be attached allow it or not.
    fn able(&self, role: SkillRole) -> BTreeSet<String> {
        let tools = self.tools.get(&role);
        tools.map(|tools| tools.able.clone()).unwrap_or_default()
    }

    /// Returns whether an offer fits a need, and no other run uses its component.
    pub(super) fn fits(&self, need: &Need, offer: &Offer) -> bool {
        self.judge(need, offer).is_ok() && self.used(offer).is_none()
    }

    /// Returns whether a completed step does not exclude the offer for a role.
    pub(super) fn is_allowed(&self, role: SkillRole, offer: &Offer) -> bool {
        let bound = self.bound.get(&role);
        bound.is_none_or(|bound| bound.is_it(offer))
    }

    /// Returns the step of a sequence, or the compensation, that has a role.
    fn step(&self, role: SkillRole) -> Option<&'a ProcessStep> {
        match role {
            SkillRole::Alone(number) => self.process.step(number),
            SkillRole::Ptp | SkillRole::Linear | SkillRole::Grasp | SkillRole::Release => None,
        }
    }

    /// Returns the offer that an earlier plan chose for a step that is done.
    pub(super) fn kept(&self, role: SkillRole) -> Option<&'a Offer> {
        let mut kept = self.situation.kept.iter();
        let of_role = kept.find(|kept| SkillRole::Alone(kept.number) == role);
        of_role.map(|kept| &kept.offer)
    }

    /// Binds the roles of each group with a completed step to its component.
    pub(super) fn bind(&mut self, groups: &BTreeMap<SkillRole, Group>) {
        for kept in self.situation.kept {
            let Some(step) = self.process.steps.get(kept.number) else {
                continue;
            };
            let bound = Bound {
                step: &step.name,
                offer: &kept.offer,
            };
            let group = groups.get(&SkillRole::Alone(kept.number));
            for (role, _) in groups.iter().filter(|(_, other)| Some(*other) == group) {
                self.bound.entry(*role).or_insert(bound);
            }
        }
    }

    /// Takes back the choice of a skill that cannot take the result of another chosen skill.
    pub(super) fn connect(&self, plan: &mut Plan) {
        for (number, step) in self.process.numbered() {
            let taken = step.parameters.iter();
            for (given, of) in taken.filter_map(|given| Some((given, given.result.as_ref()?))) {
                let chosen =
                    |plan: &Plan, number| plan.chosen(SkillRole::Alone(number)).map(str::to_owned);
                let (Some(from), Some(to)) = (chosen(plan, of.step), chosen(plan, number)) else {
                    continue;
                };
                let connects = self.facts.connects((&from, &of.name), (&to, &given.name));
                if let Err(why) = connects {
                    plan.refuse(SkillRole::Alone(number), &format!("{}: {why}", given.name));
                }
            }
        }
    }

    /// Returns the other run that uses the component of an offer.
    fn used(&self, offer: &Offer) -> Option<&'a str> {
        let used = self.situation.used?.get(&offer.component);
        used.map(String::as_str)
    }

    /// Returns the results of a step that other steps take.
    fn taken(&self, role: SkillRole) -> impl Iterator<Item = &'a str> {
        let given = self.process.numbered();
        let given = given.flat_map(|(_, step)| &step.parameters);
        let results = given.filter_map(|given| given.result.as_ref());
        results
            .filter(move |of| SkillRole::Alone(of.step) == role)
            .map(|of| of.name.as_str())
    }

    /// Returns the steps that may need a tool, with the tools that may be attached when they begin.
    fn tool_users(&self, offers: &[Offer]) -> BTreeMap<SkillRole, StepTools> {
        let mut users = BTreeMap::new();
        if self.process.work != StepJob::Sequence {
            return users;
        }
        let nothing = AttachedTools::default();
        let now = self.situation.tools.unwrap_or(&nothing);
        let left = self.process.steps.iter().enumerate();
        let is_left = |number: usize| {
            let role = SkillRole::Alone(number);
            self.kept(role).is_none() && !self.situation.is_passed(self.process, role)
        };
        let left = left.filter(|(number, _)| is_left(*number));
        // A tool that has failed or is in use stays attached.
        let able: BTreeMap<usize, Vec<&Offer>> = left
            .clone()
            .map(|(number, step)| {
                let fits = |offer: &&Offer| {
                    let mut needs = step.needs.iter();
                    needs.all(|need| {
                        self.suits(need, offer).is_ok() && self.takes(need, offer).is_ok()
                    })
                };
                (number, offers.iter().filter(fits).collect())
            })
            .collect();
        let of_step = |number: usize| able.get(&number).into_iter().flatten().copied();
        let changes = left.clone().filter_map(|(number, step)| {
            let planned = planned_tool_step((number, step), &of_step(number).collect::<Vec<_>>())?;
            Some((number, planned))
        });
        let changes: BTreeMap<usize, PlannedToolStep> = changes.collect();
        for (number, step) in left.filter(|(number, _)| !changes.contains_key(number)) {
            let behind = self.process.behind(number);
            let is_beside = |other: &&PlannedToolStep| {
                let of = other.step.number;
                let waits = self.process.steps.get(of).map(|step| step.waits_for(of));
                let is_no_later =
                    waits.is_some_and(|all| all.iter().all(|one| behind.contains(one)));
                of < number && is_no_later && !other.may_be_skipped && !behind.contains(&of)
            };
            let tools = StepTools {
                number,
                by: step.by,
                beside: changes.values().filter(is_beside).cloned().collect(),
                behind,
                able: of_step(number)
                    .map(|offer| offer.component.clone())
                    .collect(),
                possible: PossibleTools::before(number, self.process, (now, &changes)),
                loops: self.process.loops.clone(),
            };
            users.insert(SkillRole::Alone(number), tools);
        }
        users
    }

    /// Returns the number of cases in which an offer is not of the tool that a role needs.
    pub(super) fn wrong_tools(&self, role: SkillRole, offer: &Offer) -> usize {
        let tools = self.tools.get(&role);
        tools.map_or(0, |tools| {
            tools.possible.wrong(&tools.user(), &offer.component).0
        })
    }

    /// Returns the attachment of the component of an offer at the start of a role, as it is shown.
    /// Earlier steps change it: they attach a tool to the tool changer of a robot, or detach it.
    pub(super) fn attachment(&self, role: SkillRole, offer: &Offer) -> Attachment {
        let shown = self.facts.attachment(offer);
        let moves = |changer: &str| self.facts.moves(offer, changer);
        match (shown, self.tools.get(&role)) {
            (Attachment::None, Some(tools))
                if tools.possible.are_carried(&tools.user(), &moves) =>
            {
                Attachment::CarriesTool
            }
            (Attachment::CarriesTool, Some(tools)) if tools.possible.are_detached(&moves) => {
                Attachment::None
            }
            _ => shown,
        }
    }

    pub(super) fn planned(
        &self,
        need: &Need,
        offers: &[Offer],
        team: Option<&Team<'_>>,
    ) -> PlannedNeed {
        let chosen = team.and_then(|team| team.chosen.get(&need.role)).copied();
        if let Some(kept) = self.kept(need.role) {
            return PlannedNeed::chosen(need, kept, "an earlier plan of this run chose it");
        }
        let mut candidates = Vec::new();
        let mut lasting = Vec::new();
        let is_there = |component: &str| offers.iter().any(|of| of.component == component);
        for offer in offers {
            let judged = self.judge(need, offer);
            if self.suits(need, offer).is_ok() {
                lasting.push(match &judged {
                    Err(NotFit::Tool(fault)) => fault.is_lasting(is_there),
                    Ok(_) | Err(NotFit::Unrelated | NotFit::Because(_)) => false,
                });
            }
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
                Err(NotFit::Tool(fault)) => fault.to_string(),
            };
            candidates.push(PlanCandidate {
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
            is_bound: self.bound.contains_key(&need.role),
            able: self.able(need.role),
            is_without_tool: !lasting.is_empty() && lasting.iter().all(|one| *one),
            is_passed: self.situation.is_passed(self.process, need.role),
        }
    }

    /// Checks the capability and the type of an offer.
    fn suits(&self, need: &Need, offer: &Offer) -> Result<(), NotFit> {
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
        Ok(())
    }

    /// Checks that an offer takes the parameters of its step, and has the results that other steps
    /// take.
    fn takes(&self, need: &Need, offer: &Offer) -> Result<(), NotFit> {
        if let (SkillRole::Alone(number), Some(step)) = (need.role, self.step(need.role)) {
            self.facts.takes(offer, (number, step))?;
        }
        if let (StepJob::PickAndPlace(job), SkillRole::Ptp | SkillRole::Linear) =
            (&self.process.work, need.role)
        {
            let positions = [job.pick, job.place].map(|[x, y, z, ..]| [x, y, z]);
            self.facts.reaches(offer, &positions)?;
        }
        for result in self.taken(need.role) {
            self.facts.gives(offer, result)?;
        }
        Ok(())
    }

    /// Returns the reason why an offer fits a need, or why it does not.
    fn judge(&self, need: &Need, offer: &Offer) -> Result<String, NotFit> {
        self.suits(need, offer)?;
        let because = |why: String| Err(NotFit::Because(why));
        let fell = self.situation.fallen.iter().find(|fallen| {
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
        if let Some(tools) = self.tools.get(&need.role) {
            let (user, component) = (tools.user(), &offer.component);
            let allows = tools.possible.allows(&user, component);
            allows.map_err(NotFit::Tool)?;
            let other = tools.possible.changed_by((&user, &tools.beside), component);
            if let Some(ToolStep { name, .. }) = other {
                let step = name.clone();
                return Err(NotFit::Tool(ToolFault::AnyTime { step }));
            }
        }
        self.takes(need, offer)?;
        if let Some(why) = self.excluded(need.role, offer) {
            return because(why.clone());
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
        if let Some(run) = self.used(offer) {
            return format!("it would fit, but the run {run} uses its component");
        }
        if let Some(bound) = self
            .bound
            .get(&need.role)
            .filter(|bound| !bound.is_it(offer))
        {
            return bound.why(offer);
        }
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
        let wrong = self.wrong_tools(need.role, offer);
        if wrong > self.wrong_tools(need.role, chosen) {
            return "it would fit only while another tool is attached".to_owned();
        }
        let ranked = |offer: &Offer| {
            let attachment = self.attachment(need.role, offer);
            rank(&[need], (offer, attachment), self.facts)
        };
        let (mut best, mut rank) = (ranked(chosen), ranked(offer));
        let name = |offer: &Offer| format!("{}.{}", offer.component_name, offer.name);
        (best.name, rank.name) = (chosen.skill.clone(), offer.skill.clone());
        rank.why_not((&name(chosen), &best))
    }
}

/// The parameter that names a tool by its ApplicationUri.
pub(crate) const TOOL: &str = "ToolAppUri";
