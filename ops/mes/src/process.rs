//! Processes: their steps and the needs of each step.

use std::collections::BTreeSet;
use std::time::Duration;

use knowledge::{ValueQueryFault, is_iri, vocabulary as v};
use mtp::{Object, Triple, escaped};
use skills::ParameterType;

use crate::parameter_fault::ParameterFault;
use crate::plan::Offer;

/// A process that the MES can run, identified by its IRI.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Process {
    pub(crate) iri: String,
    pub(crate) name: String,
    pub(crate) work: StepJob,
    /// The steps in order.
    pub(crate) steps: Vec<ProcessStep>,
    /// The parts of a sequence that are repeated.
    pub(crate) loops: Vec<Loop>,
    /// Time limit of each run of a skill.
    pub(crate) within: Duration,
    /// Time to wait for a component that a plan needs.
    pub(crate) wait: Duration,
}

/// The way in which the steps are done.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum StepJob {
    /// All steps together, by the composite that moves an object to another pose.
    PickAndPlace(skills::Job),
    /// A sequence of skills: each step is a skill.
    Sequence,
}

/// A step.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub(crate) struct ProcessStep {
    pub(crate) name: String,
    pub(crate) needs: Vec<Need>,
    /// The parameters of its skill, in a sequence.
    pub(crate) parameters: Vec<GivenParameter>,
    pub(crate) by: By,
    /// The step that undoes this one after a later step has failed, in a sequence.
    pub(crate) compensation: Option<Box<Self>>,
    /// The earlier steps that end before this one begins, in a sequence; the previous step if
    /// `None`. Steps that do not wait for each other run in parallel.
    pub(crate) after: Option<Vec<usize>>,
    /// The step is skipped unless all conditions of one of these alternatives hold. Without
    /// alternatives it is not skipped.
    pub(crate) when: Vec<Vec<StepCondition>>,
    /// Time limit of the skill, if it differs from that of the process.
    pub(crate) within: Option<Duration>,
}

/// Steps of a sequence that are done in rounds. When all of them are over, another round begins if
/// its conditions hold. Other steps wait for the last round.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Loop {
    /// The numbers of its steps.
    pub(crate) steps: BTreeSet<usize>,
    /// Another round begins if all conditions of one of these alternatives hold.
    pub(crate) again: Vec<Vec<StepCondition>>,
    /// The run fails when another round is due after this number of rounds.
    pub(crate) rounds: u32,
}

impl Loop {
    /// Maximum number of rounds of a loop that does not state one.
    pub(crate) const USUAL_ROUNDS: u32 = 100;
    /// Largest possible maximum: each round is a plan of its own in the record of the run.
    pub(crate) const MOST_ROUNDS: u32 = 500;
    /// Maximum number of rounds of all loops of a run: loops within loops multiply.
    pub(crate) const MOST_ROUNDS_OF_RUN: u32 = 2000;

    /// Returns whether a loop is a part of another loop.
    pub(crate) fn is_within(&self, other: &Self) -> bool {
        self.steps.is_subset(&other.steps) && self.steps.len() < other.steps.len()
    }

    /// Returns a condition that cannot decide about another round. `steps` and `loops` are all of
    /// the process.
    pub(crate) fn condition_fault(
        &self,
        steps: &[ProcessStep],
        loops: &[Self],
    ) -> Option<LoopConditionFault> {
        let over = self.over_after_round(steps, loops);
        for alternative in &self.again {
            let mut named = alternative.iter().map(|condition| condition.step);
            if let Some(step) = named.clone().find(|step| !over.contains(step)) {
                return Some(LoopConditionFault::MayNotBeOver(step));
            }
            let is_constant = !named.clone().any(|step| self.steps.contains(&step));
            if let Some(step) = named.next().filter(|_| is_constant) {
                return Some(LoopConditionFault::IsConstant(step));
            }
        }
        None
    }

    /// Returns the steps that are over at the end of a round: the steps of the loop, and the steps
    /// for which they wait.
    fn over_after_round(&self, steps: &[ProcessStep], loops: &[Self]) -> BTreeSet<usize> {
        waited_for(self.steps.iter().copied(), steps, loops)
    }
}

/// Returns steps and the steps for which they wait, directly or not. A step that waits for a step
/// of another loop waits for the last round of that loop.
fn waited_for(
    first: impl Iterator<Item = usize>,
    steps: &[ProcessStep],
    loops: &[Loop],
) -> BTreeSet<usize> {
    let mut over = BTreeSet::new();
    let mut open: Vec<usize> = first.collect();
    while let Some(number) = open.pop() {
        if !over.insert(number) {
            continue;
        }
        let waits = steps.get(number).map(|step| step.waits_for(number));
        for other in waits.into_iter().flatten() {
            open.push(other);
            let left = loops
                .iter()
                .filter(|one| one.steps.contains(&other) && !one.steps.contains(&number));
            open.extend(left.flat_map(|one| &one.steps));
        }
    }
    over
}

/// The fault of a loop whose condition names a step outside it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum LoopConditionFault {
    /// The step with this number may not be over when a round is.
    MayNotBeOver(usize),
    /// The alternative that begins with this step names no step of the loop: it holds after each
    /// round, or after none.
    IsConstant(usize),
}

/// A condition about an earlier step.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct StepCondition {
    /// The number of the step, from 0.
    pub(crate) step: usize,
    pub(crate) test: Test,
    /// Whether the condition holds if the test fails.
    pub(crate) is_negated: bool,
}

/// A test of a step that has ended.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Test {
    /// A result of the step compares with a value.
    Result {
        name: String,
        compare: Compare,
        value: serde_json::Value,
    },
    /// The step has ended in this way, and its machines stand still.
    Ended(BadEnd),
}

/// A comparison.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Compare {
    Equal,
    NotEqual,
    Less,
    LessOrEqual,
    Greater,
    GreaterOrEqual,
}

/// An end of a step that other steps handle.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum BadEnd {
    Failed,
    /// It was halted after its time limit.
    TimedOut,
}

/// A result and a value of different types, or without an order.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{result} cannot be compared with {value}")]
pub(crate) struct Incomparable {
    result: serde_json::Value,
    value: serde_json::Value,
}

impl Compare {
    /// All comparisons, with their signs. A sign that begins with another sign comes before it.
    pub(crate) const ALL: [(Self, &'static str); 6] = [
        (Self::Equal, "=="),
        (Self::NotEqual, "!="),
        (Self::LessOrEqual, "<="),
        (Self::GreaterOrEqual, ">="),
        (Self::Less, "<"),
        (Self::Greater, ">"),
    ];

    pub(crate) fn sign(self) -> &'static str {
        let mut all = Self::ALL.iter();
        all.find(|(known, _)| *known == self)
            .map_or("", |(_, sign)| sign)
    }

    /// Compares a result with a value.
    ///
    /// # Errors
    /// The reason why they cannot be compared.
    pub(crate) fn holds(
        self,
        result: &serde_json::Value,
        value: &serde_json::Value,
    ) -> Result<bool, Incomparable> {
        use std::cmp::Ordering;
        let order = match (result.as_f64(), value.as_f64()) {
            (Some(one), Some(other)) => one.partial_cmp(&other),
            _ if result == value => Some(Ordering::Equal),
            _ if std::mem::discriminant(result) != std::mem::discriminant(value) => None,
            _ if matches!(self, Self::Equal | Self::NotEqual) => Some(Ordering::Less),
            _ => match (result.as_str(), value.as_str()) {
                (Some(one), Some(other)) => Some(one.cmp(other)),
                _ => None,
            },
        };
        let order = order.ok_or_else(|| Incomparable {
            result: result.clone(),
            value: value.clone(),
        })?;
        Ok(match self {
            Self::Equal => order.is_eq(),
            Self::NotEqual => order.is_ne(),
            Self::Less => order.is_lt(),
            Self::LessOrEqual => order.is_le(),
            Self::Greater => order.is_gt(),
            Self::GreaterOrEqual => order.is_ge(),
        })
    }
}

impl BadEnd {
    /// Returns the name in the graph.
    pub(crate) const fn name(self) -> &'static str {
        match self {
            Self::Failed => "failed",
            Self::TimedOut => "timed out",
        }
    }
}

impl ProcessStep {
    /// Returns whether a skill has the capability and the type of each need. Its parameters and
    /// results are not compared.
    pub(crate) fn may_be_done_by(&self, offer: &Offer) -> bool {
        self.needs.iter().all(|need| {
            let capability = need.capability.as_ref();
            let of = need.skill_type.as_ref();
            capability.is_none_or(|wanted| offer.closure.contains(wanted))
                && of.is_none_or(|wanted| offer.types.contains(&wanted.to_string()))
        })
    }

    /// Returns the numbers of the steps that end before this step begins. `number` is that of this
    /// step: it waits for the steps of its order, its conditions and the results that it takes.
    pub(crate) fn waits_for(&self, number: usize) -> Vec<usize> {
        let mut all = match &self.after {
            Some(after) => after.clone(),
            None => number.checked_sub(1).into_iter().collect(),
        };
        all.extend(self.when.iter().flatten().map(|condition| condition.step));
        let results = self
            .parameters
            .iter()
            .filter_map(|given| given.result.as_ref());
        all.extend(results.map(|of| of.step));
        all
    }
}

/// A parameter as the process gives it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct GivenParameter {
    pub(crate) name: String,
    pub(crate) value: serde_json::Value,
    /// The unit of the value; that of the skill if missing.
    pub(crate) unit: Option<String>,
    /// The result that is the value; `value` is null then.
    pub(crate) result: Option<ResultOf>,
    /// The query whose result is the value; `value` is null until it is evaluated.
    pub(crate) query: Option<ParameterQuery>,
}

/// A query over the knowledge that gives a parameter its value.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct ParameterQuery {
    /// The name in findings.
    pub(crate) name: String,
    /// A SELECT with one variable.
    pub(crate) sparql: String,
}

impl GivenParameter {
    /// Returns the name for findings, with that of its query.
    pub(crate) fn shown(&self) -> String {
        match &self.query {
            None => self.name.clone(),
            Some(query) => format!("{} (query `{}`)", self.name, query.name),
        }
    }

    /// Returns the parameter with the value of its query.
    ///
    /// # Errors
    /// The reason why the query has no value, with its name.
    pub(crate) fn evaluated(
        &self,
        value: Result<serde_json::Value, ValueQueryFault>,
    ) -> Result<Self, ParameterFault> {
        let is_there = |value: serde_json::Value| match value.is_null() {
            true => Err(ValueQueryFault::NoValue),
            false => Ok(value),
        };
        let value = value.and_then(is_there);
        let value = value.map_err(|why| ParameterFault::Given(self.shown(), why.into()))?;
        Ok(Self {
            value,
            ..self.clone()
        })
    }
}

/// A result of an earlier step.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct ResultOf {
    /// The number of the step, from 0.
    pub(crate) step: usize,
    pub(crate) name: String,
}

/// The component that has to do a step of a sequence.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(crate) enum By {
    /// Any component that can. A release is done by the component that grasped, and a tool that an
    /// earlier step attaches does the steps that it can do.
    #[default]
    Any,
    /// The component of the step with this number.
    SameAs(usize),
    /// The tool that an earlier step attaches.
    AttachedTool,
}

/// A skill that a step needs.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Need {
    /// The role of the skill. In all steps of a composite, each role has the same skill.
    pub(crate) role: SkillRole,
    /// The class of the capability that the skill has to realise.
    pub(crate) capability: Option<String>,
    /// The required type; subtypes match too.
    pub(crate) skill_type: Option<ParameterType>,
}

/// The role of a skill.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub(crate) enum SkillRole {
    /// Moves fast, along a path that the robot chooses.
    Ptp,
    /// Moves along a straight line.
    Linear,
    /// Grasps the object.
    Grasp,
    /// Releases the object.
    Release,
    /// Does the step with this number alone.
    Alone(usize),
}

impl SkillRole {
    /// The roles of the composite.
    pub(crate) const OF_COMPOSITE: [Self; 4] =
        [Self::Ptp, Self::Linear, Self::Grasp, Self::Release];

    /// Returns the name in the YAML and in the graph.
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::Ptp => "ptp",
            Self::Linear => "linear",
            Self::Grasp => "grasp",
            Self::Release => "release",
            Self::Alone(_) => "skill",
        }
    }

    /// Returns the default skill type of the role.
    pub(crate) fn skill_type(self) -> Option<ParameterType> {
        let name = match self {
            Self::Ptp => "PtpMoveSkillType",
            Self::Linear => "LinearMoveSkillType",
            Self::Grasp => "GraspSkillType",
            Self::Release => "ReleaseSkillType",
            Self::Alone(_) => return None,
        };
        Some(ParameterType::own(name))
    }

    /// Returns the group. The same component fills all roles of a group: one robot moves, one tool
    /// grasps and releases.
    pub(crate) fn group(self) -> Group {
        match self {
            Self::Ptp | Self::Linear => Group::Robot,
            Self::Grasp | Self::Release => Group::Tool,
            Self::Alone(step) => Group::Alone(step),
        }
    }
}

/// Roles that the same component has to fill.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub(crate) enum Group {
    Robot,
    Tool,
    Alone(usize),
}

impl Process {
    /// Returns the steps, and then their compensations, with the numbers of their roles.
    pub(crate) fn numbered(&self) -> impl Iterator<Item = (usize, &ProcessStep)> {
        let steps = self.steps.iter().enumerate();
        let compensations = steps.filter_map(|(number, step)| {
            let compensation = step.compensation.as_deref()?;
            Some((self.compensation_of(number), compensation))
        });
        self.steps.iter().enumerate().chain(compensations)
    }

    /// Returns whether other steps handle an end of the step with this number.
    pub(crate) fn handles(&self, number: usize, end: BadEnd) -> bool {
        let of_steps = self.steps.iter().flat_map(|step| &step.when);
        let of_loops = self.loops.iter().flat_map(|one| &one.again);
        let conditions = of_steps.chain(of_loops).flatten();
        let mut handlers = conditions.filter(|condition| !condition.is_negated);
        handlers.any(|condition| condition.step == number && condition.test == Test::Ended(end))
    }

    /// Returns the steps that end before the step with this number begins.
    pub(crate) fn behind(&self, number: usize) -> BTreeSet<usize> {
        let mut behind = waited_for(std::iter::once(number), &self.steps, &self.loops);
        behind.remove(&number);
        behind
    }

    /// Returns the number of the role of the compensation of a step.
    pub(crate) fn compensation_of(&self, number: usize) -> usize {
        self.steps.len().saturating_add(number)
    }

    /// Returns the step or the compensation with the number of its role.
    pub(crate) fn step(&self, number: usize) -> Option<&ProcessStep> {
        match number.checked_sub(self.steps.len()) {
            None => self.steps.get(number),
            Some(of) => self.steps.get(of)?.compensation.as_deref(),
        }
    }

    /// Returns the triples of the process. `type_iri` returns the IRI of a type, if it is known.
    pub(crate) fn triples(
        &self,
        type_iri: &dyn Fn(&ParameterType) -> Option<String>,
    ) -> Vec<Triple> {
        let mut all = Vec::new();
        let mut say = |subject: &str, predicate: &str, object: Object| {
            all.push(Triple {
                subject: subject.to_owned(),
                predicate: predicate.to_owned(),
                object,
            });
        };
        let iri = |iri: &str| Object::Iri(iri.to_owned());
        say(&self.iri, v::RDF_TYPE, iri(v::PROCESS));
        say(&self.iri, v::RDFS_LABEL, Object::Text(self.name.clone()));
        for (time, predicate) in [(self.within, v::WITHIN), (self.wait, v::WAIT)] {
            say(&self.iri, predicate, Object::Number(time.as_secs_f64()));
        }
        if let StepJob::PickAndPlace(job) = &self.work {
            for (position, predicate) in [(job.pick, v::PICK), (job.place, v::PLACE)] {
                let numbers: Vec<_> = position.iter().map(ToString::to_string).collect();
                say(&self.iri, predicate, Object::Text(numbers.join(" ")));
            }
            say(&self.iri, v::APPROACH, Object::Number(job.approach));
            if let Some(shape) = &job.shape {
                say(&self.iri, v::SHAPE, Object::Text(shape.to_string()));
            }
        }
        let iris = self.step_iris();
        for ((step, position), step_iri) in self.steps.iter().zip(1_i64..).zip(&iris) {
            say(&self.iri, v::HAS_STEP, iri(step_iri));
            say(step_iri, v::POSITION, Object::Integer(position));
            if let Some(compensation) = &step.compensation {
                let undo = format!("{step_iri}/compensation");
                say(step_iri, v::COMPENSATED_BY, iri(&undo));
                of_step(compensation, &undo, &iris, &mut say, type_iri);
            }
            if let Some(within) = step.within {
                say(step_iri, v::WITHIN, Object::Number(within.as_secs_f64()));
            }
            match step.after.as_deref() {
                None => {}
                Some([]) => say(step_iri, v::AFTER, iri(&self.iri)),
                Some(after) => {
                    for other in after.iter().filter_map(|number| iris.get(*number)) {
                        say(step_iri, v::AFTER, iri(other));
                    }
                }
            }
            of_conditions(&step.when, step_iri, &iris, &mut say);
            of_step(step, step_iri, &iris, &mut say, type_iri);
        }
        for (one, number) in self.loops.iter().zip(1..) {
            let loop_iri = format!("{}/loop/{number}", self.iri);
            say(&self.iri, v::HAS_LOOP, iri(&loop_iri));
            for step in one.steps.iter().filter_map(|number| iris.get(*number)) {
                say(&loop_iri, v::REPEATS, iri(step));
            }
            say(&loop_iri, v::ROUNDS, Object::Integer(one.rounds.into()));
            of_conditions(&one.again, &loop_iri, &iris, &mut say);
        }
        all
    }

    /// Returns the IRIs of the steps. Steps of one name have their positions in the IRIs.
    fn step_iris(&self) -> Vec<String> {
        let mut iris: Vec<String> = Vec::new();
        for (step, position) in self.steps.iter().zip(1..) {
            let plain = step_iri(&self.iri, &step.name);
            let is_new = !iris.contains(&plain);
            iris.push(if is_new {
                plain
            } else {
                format!("{plain}/{position}")
            });
        }
        iris
    }
}

/// Adds the alternatives of a step or of a loop to the graph.
fn of_conditions(
    when: &[Vec<StepCondition>],
    part_iri: &str,
    iris: &[String],
    say: &mut dyn FnMut(&str, &str, Object),
) {
    let iri = |iri: &str| Object::Iri(iri.to_owned());
    for (alternative, number) in when.iter().zip(1..) {
        let alternative_iri = format!("{part_iri}/when/{number}");
        say(part_iri, v::WHEN, iri(&alternative_iri));
        for (condition, position) in alternative.iter().zip(1_i64..) {
            let condition_iri = format!("{alternative_iri}/{position}");
            say(&alternative_iri, v::CONDITION, iri(&condition_iri));
            say(&condition_iri, v::POSITION, Object::Integer(position));
            if let Some(other) = iris.get(condition.step) {
                say(&condition_iri, v::RESULT_OF, iri(other));
            }
            if condition.is_negated {
                say(&condition_iri, v::NEGATED, Object::Boolean(true));
            }
            match &condition.test {
                Test::Result {
                    name,
                    compare,
                    value,
                } => {
                    say(&condition_iri, v::RESULT, Object::Text(name.clone()));
                    let sign = Object::Text(compare.sign().to_owned());
                    say(&condition_iri, v::COMPARE, sign);
                    let (predicate, value) = literal(value);
                    say(&condition_iri, predicate, value);
                }
                Test::Ended(end) => {
                    say(
                        &condition_iri,
                        v::ENDS_AS,
                        Object::Text(end.name().to_owned()),
                    );
                }
            }
        }
    }
}

/// States a step, or the compensation of a step.
fn of_step(
    step: &ProcessStep,
    step_iri: &str,
    iris: &[String],
    say: &mut dyn FnMut(&str, &str, Object),
    type_iri: &dyn Fn(&ParameterType) -> Option<String>,
) {
    let iri = |iri: &str| Object::Iri(iri.to_owned());
    for (given, number) in step.parameters.iter().zip(1..) {
        let parameter = format!("{step_iri}/parameter/{number}");
        say(step_iri, v::HAS_PARAMETER, iri(&parameter));
        let name = Object::Text(given.name.clone());
        say(&parameter, v::HAS_VARIABLE_NAME, name);
        match (&given.result, &given.query) {
            (Some(of), _) => {
                if let Some(other) = iris.get(of.step) {
                    say(&parameter, v::RESULT_OF, iri(other));
                }
                say(&parameter, v::RESULT, Object::Text(of.name.clone()));
            }
            (None, Some(query)) => {
                let sparql = Object::Text(query.sparql.clone());
                say(&parameter, v::VALUE_QUERY, sparql);
                let name = Object::Text(query.name.clone());
                say(&parameter, v::QUERY_NAME, name);
            }
            (None, None) => {
                let (predicate, value) = literal(&given.value);
                say(&parameter, predicate, value);
            }
        }
        if let Some(unit) = &given.unit {
            say(&parameter, v::UNIT, Object::Text(unit.clone()));
        }
    }
    match step.by {
        By::Any => {}
        By::SameAs(number) => {
            if let Some(other) = iris.get(number) {
                say(step_iri, v::BY_COMPONENT_OF, iri(other));
            }
        }
        By::AttachedTool => say(step_iri, v::BY_ATTACHED_TOOL, Object::Boolean(true)),
    }
    say(step_iri, v::RDF_TYPE, iri(v::STEP));
    say(step_iri, v::RDFS_LABEL, Object::Text(step.name.clone()));
    for need in &step.needs {
        let need_iri = format!("{step_iri}/{}", need.role.name());
        say(step_iri, v::REQUIRES_CAPABILITY, iri(&need_iri));
        say(&need_iri, v::RDF_TYPE, iri(v::REQUIRED_CAPABILITY));
        say(
            &need_iri,
            v::ROLE,
            Object::Text(need.role.name().to_owned()),
        );
        if let Some(class) = need.capability.as_ref().filter(|class| is_iri(class)) {
            say(&need_iri, v::RDF_TYPE, iri(class));
            say(class, v::RDFS_SUB_CLASS_OF, iri(v::CAPABILITY));
        }
        if let Some(of) = &need.skill_type {
            let known = type_iri(of);
            // A type that no source describes stays a requirement.
            let unknown = || format!("urn:ua-bridge:type:{}", escaped(&of.to_string()));
            let type_iri = known.clone().unwrap_or_else(unknown);
            say(&need_iri, v::REQUIRES_TYPE, iri(&type_iri));
            if known.is_none() {
                say(&type_iri, v::BROWSE_NAME, Object::Text(of.name.clone()));
                let namespace = Object::Text(of.namespace.clone());
                say(&type_iri, v::NODE_NAMESPACE, namespace);
            }
        }
    }
}

/// Returns the predicate and the literal of a value: structured values are texts of JSON.
pub(crate) fn literal(value: &serde_json::Value) -> (&'static str, Object) {
    use serde_json::Value;
    let object = match value {
        Value::Bool(value) => Some(Object::Boolean(*value)),
        Value::String(text) => Some(Object::Text(text.clone())),
        Value::Number(number) => match number.as_i64() {
            Some(number) => Some(Object::Integer(number)),
            None if number.is_f64() => number.as_f64().map(Object::Number),
            None => None,
        },
        Value::Null | Value::Array(_) | Value::Object(_) => None,
    };
    match object {
        Some(object) => (v::VALUE, object),
        None => (v::VALUE_JSON, Object::Text(value.to_string())),
    }
}

/// Returns the IRI of a step of a process.
pub(crate) fn step_iri(process: &str, step: &str) -> String {
    format!("{process}/step/{}", escaped(step))
}

/// Maximum number of steps of a process.
pub(crate) const MOST_STEPS: usize = 100;
