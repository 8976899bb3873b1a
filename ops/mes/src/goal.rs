//! Goals: a sequence of actions is searched that leads from the given facts to the wanted facts.
//!
//! An action is a capability with its conditions before and after (STRIPS with negative
//! conditions). The sequence that is found is one of the shortest, and it is a process like any
//! other.

use std::collections::{BTreeMap, BTreeSet, HashMap, VecDeque};
use std::time::Duration;

use knowledge::{Knowledge, QuestionAnswer, QuestionFault};
use serde::Serialize;

use crate::process::{
    By, GivenParameter, MOST_STEPS, Need, Process, ProcessStep, SkillRole, StepJob,
};
use crate::read_process::{StatementFault, USUALLY_WAIT, USUALLY_WITHIN, parameters_of, seconds};

/// An action.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct GoalAction {
    pub(crate) iri: String,
    pub(crate) name: String,
    /// The class of the capability that does it.
    pub(crate) capability: String,
    /// Facts that hold before it.
    pub(crate) requires: BTreeSet<String>,
    /// Facts that do not hold before it.
    pub(crate) forbids: BTreeSet<String>,
    pub(crate) adds: BTreeSet<String>,
    /// Facts that do not hold after it, unless it adds them.
    pub(crate) removes: BTreeSet<String>,
    pub(crate) parameters: Vec<GivenParameter>,
}

/// A goal.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct GoalConditions {
    pub(crate) iri: String,
    pub(crate) name: String,
    /// Facts that hold at the start.
    pub(crate) given: BTreeSet<String>,
    /// Facts that hold at the end.
    pub(crate) wants: BTreeSet<String>,
    /// Facts that do not hold at the end.
    pub(crate) avoids: BTreeSet<String>,
    within: Option<Duration>,
    wait: Option<Duration>,
}

/// A step of the sequence, with its proof.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub(crate) struct Proved {
    pub(crate) action: String,
    pub(crate) name: String,
    pub(crate) capability: String,
    /// The conditions before the step, with the reasons why they hold.
    pub(crate) because: Vec<GoalCondition>,
    pub(crate) adds: BTreeSet<String>,
    pub(crate) removes: BTreeSet<String>,
}

/// A condition that holds before a step, or at the end.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub(crate) struct GoalCondition {
    pub(crate) fact: String,
    /// Whether the fact holds, or does not hold.
    pub(crate) holds: bool,
    /// The number of the step that made it so, from 1; 0 for the start.
    pub(crate) since: usize,
}

/// The result of a search.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub(crate) struct Sequence {
    pub(crate) steps: Vec<Proved>,
    /// The conditions of the goal.
    pub(crate) reached: Vec<GoalCondition>,
}

/// The reason why no sequence of actions reaches a goal.
#[derive(Debug, thiserror::Error)]
pub(crate) enum GoalFault {
    #[error("there is no such goal")]
    Unknown,
    #[error(transparent)]
    Question(#[from] QuestionFault),
    #[error("it {0}")]
    Goal(#[from] StatementFault),
    #[error("the action {iri} {fault}")]
    Action {
        iri: String,
        fault: Box<StatementFault>,
    },
    #[error("the action {0} has two names or two capabilities")]
    AmbiguousAction(String),
    #[error("its conditions have more than {} facts", u128::BITS)]
    TooManyFacts,
    #[error(
        "its shortest sequence has {0} steps, and a process has at most {MOST_STEPS}; \
         split it into several goals"
    )]
    TooLong(usize),
    #[error("no available action adds {0}")]
    NotAdded(String),
    #[error("no sequence of the {actions} available actions reaches it")]
    Unreachable { actions: usize },
    #[error("the search was given up after {MOST_STATES} states; split it into several goals")]
    TooManyStates,
    /// The actions whose capabilities have no skills.
    #[error("{fault}; no skill is there for {}", actions.join(", "))]
    WithoutSkills {
        fault: Box<Self>,
        actions: Vec<String>,
    },
}

impl GoalConditions {
    /// Reads a goal of the graph.
    ///
    /// # Errors
    /// The reason why it cannot be planned.
    pub(crate) fn read(knowledge: &Knowledge, iri: &str) -> Result<Self, GoalFault> {
        let answer = knowledge.ask("goals", &[])?;
        let of_goal =
            |row: &&BTreeMap<String, serde_json::Value>| QuestionAnswer::text(row, "goal") == iri;
        let row = answer.rows.iter().find(of_goal).ok_or(GoalFault::Unknown)?;
        let facts = |column| QuestionAnswer::texts(row, column).into_iter().collect();
        let time = |column| seconds(row.get(column).filter(|value| !value.is_null()), column);
        let name = QuestionAnswer::text(row, "name");
        let goal = Self {
            iri: iri.to_owned(),
            name: if name.is_empty() { iri } else { name }.to_owned(),
            given: facts("given"),
            wants: facts("wants"),
            avoids: facts("avoids"),
            within: time("within")?,
            wait: time("wait")?,
        };
        match goal.wants.is_empty() && goal.avoids.is_empty() {
            true => Err(StatementFault::Missing("ua:wants or ua:avoids").into()),
            false => Ok(goal),
        }
    }

    /// Searches a shortest sequence of actions.
    ///
    /// # Errors
    /// The reason why there is none.
    pub(crate) fn search(&self, actions: &[GoalAction]) -> Result<Sequence, GoalFault> {
        let mut facts = Facts::default();
        let goal = Bits {
            yes: facts.set(&self.wants)?,
            no: facts.set(&self.avoids)?,
        };
        // Only facts that a condition names can matter.
        let mut steps = Vec::new();
        for action in actions {
            steps.push(Effect {
                before: Bits {
                    yes: facts.set(&action.requires)?,
                    no: facts.set(&action.forbids)?,
                },
                adds: 0,
                removes: 0,
            });
        }
        for (step, action) in steps.iter_mut().zip(actions) {
            step.adds = facts.known(&action.adds);
            step.removes = facts.known(&action.removes) & !step.adds;
        }
        let start = facts.known(&self.given);
        match found(start, goal, &steps)? {
            Some(order) if order.len() > MOST_STEPS => Err(GoalFault::TooLong(order.len())),
            Some(order) => Ok(self.proved(actions, &order)),
            None => Err(self.unreachable(actions)),
        }
    }

    /// Returns the reason why no sequence of actions reaches the goal.
    fn unreachable(&self, actions: &[GoalAction]) -> GoalFault {
        let nobody = self.wants.iter().find(|fact| {
            let is_added = actions.iter().any(|action| action.adds.contains(*fact));
            !self.given.contains(*fact) && !is_added
        });
        match nobody {
            Some(fact) => GoalFault::NotAdded(fact.clone()),
            None => GoalFault::Unreachable {
                actions: actions.len(),
            },
        }
    }

    /// Adds the proof to a sequence.
    fn proved(&self, actions: &[GoalAction], order: &[usize]) -> Sequence {
        // The step that last changed a fact, from 1.
        let mut since: BTreeMap<&str, usize> = BTreeMap::new();
        let conditions =
            |since: &BTreeMap<&str, usize>, yes: &BTreeSet<String>, no: &BTreeSet<String>| {
                let all = yes.iter().map(|fact| (fact, true));
                let all = all.chain(no.iter().map(|fact| (fact, false)));
                let one = |(fact, holds): (&String, bool)| GoalCondition {
                    fact: fact.clone(),
                    holds,
                    since: since.get(fact.as_str()).copied().unwrap_or_default(),
                };
                all.map(one).collect::<Vec<_>>()
            };
        let mut holds: BTreeSet<&str> = self.given.iter().map(String::as_str).collect();
        let mut steps = Vec::new();
        for (action, number) in order
            .iter()
            .filter_map(|index| actions.get(*index))
            .zip(1..)
        {
            steps.push(Proved {
                action: action.iri.clone(),
                name: action.name.clone(),
                capability: action.capability.clone(),
                because: conditions(&since, &action.requires, &action.forbids),
                adds: action.adds.clone(),
                removes: action.removes.clone(),
            });
            for fact in &action.removes {
                if !action.adds.contains(fact) && holds.remove(fact.as_str()) {
                    since.insert(fact, number);
                }
            }
            for fact in &action.adds {
                if holds.insert(fact) {
                    since.insert(fact, number);
                }
            }
        }
        Sequence {
            steps,
            reached: conditions(&since, &self.wants, &self.avoids),
        }
    }

    /// Returns the process of a sequence.
    pub(crate) fn process(&self, sequence: &Sequence, actions: &[GoalAction]) -> Process {
        let step = |(number, proved): (usize, &Proved)| {
            let action = actions.iter().find(|action| action.iri == proved.action);
            ProcessStep {
                name: proved.name.clone(),
                needs: vec![Need {
                    role: SkillRole::Alone(number),
                    capability: Some(proved.capability.clone()),
                    skill_type: None,
                }],
                parameters: action
                    .map(|action| action.parameters.clone())
                    .unwrap_or_default(),
                by: By::Any,
                ..ProcessStep::default()
            }
        };
        Process {
            iri: self.iri.clone(),
            name: self.name.clone(),
            work: StepJob::Sequence,
            steps: sequence.steps.iter().enumerate().map(step).collect(),
            loops: Vec::new(),
            within: self.within.unwrap_or(USUALLY_WITHIN),
            wait: self.wait.unwrap_or(USUALLY_WAIT),
        }
    }
}

impl GoalAction {
    /// Reads the actions of the graph.
    ///
    /// # Errors
    /// The first action that is not whole, with the reason.
    pub(crate) fn read(knowledge: &Knowledge) -> Result<Vec<Self>, GoalFault> {
        let ask = |question| knowledge.ask(question, &[]);
        let (actions, parameters) = (ask("actions")?, ask("action-parameters")?);
        let mut all: Vec<Self> = Vec::new();
        for row in &actions.rows {
            let text = |column| QuestionAnswer::text(row, column).to_owned();
            let facts = |column| QuestionAnswer::texts(row, column).into_iter().collect();
            let (iri, name) = (text("action"), text("name"));
            if all.iter().any(|known| known.iri == iri) {
                return Err(GoalFault::AmbiguousAction(iri));
            }
            let parameters = parameters_of(&iri, (&[], 0), &parameters.rows);
            let parameters = parameters.map_err(|fault| GoalFault::Action {
                iri: iri.clone(),
                fault: Box::new(fault),
            })?;
            all.push(Self {
                name: if name.is_empty() { iri.clone() } else { name },
                capability: text("capability"),
                requires: facts("requires"),
                forbids: facts("forbids"),
                adds: facts("adds"),
                removes: facts("removes"),
                parameters,
                iri,
            });
        }
        Ok(all)
    }
}

/// The numbers of the facts that conditions name.
#[derive(Debug, Default)]
struct Facts<'a>(BTreeMap<&'a str, u32>);

impl<'a> Facts<'a> {
    /// Returns facts as a set of bits; new facts get numbers.
    fn set(&mut self, facts: &'a BTreeSet<String>) -> Result<u128, GoalFault> {
        let mut set = 0;
        for fact in facts {
            let next = u32::try_from(self.0.len()).unwrap_or(u128::BITS);
            let number = *self.0.entry(fact).or_insert(next);
            let bit = 1_u128.checked_shl(number);
            set |= bit.ok_or(GoalFault::TooManyFacts)?;
        }
        Ok(set)
    }

    /// Returns the facts that have numbers as a set of bits.
    fn known(&self, facts: &BTreeSet<String>) -> u128 {
        let numbers = facts.iter().filter_map(|fact| self.0.get(fact.as_str()));
        numbers.fold(0, |set, number| set | 1_u128 << number)
    }
}

/// Facts that hold and facts that do not hold.
#[derive(Debug, Clone, Copy)]
struct Bits {
    yes: u128,
    no: u128,
}

impl Bits {
    const fn hold_in(self, state: u128) -> bool {
        state & self.yes == self.yes && state & self.no == 0
    }
}

/// An action as sets of bits.
#[derive(Debug, Clone, Copy)]
struct Effect {
    before: Bits,
    adds: u128,
    removes: u128,
}

/// Searches breadth first: the first sequence found is one of the shortest.
fn found(start: u128, goal: Bits, steps: &[Effect]) -> Result<Option<Vec<usize>>, GoalFault> {
    // The previous state and the action that led from it.
    let mut came: HashMap<u128, Option<(u128, usize)>> = HashMap::from([(start, None)]);
    let mut waiting = VecDeque::from([start]);
    while let Some(state) = waiting.pop_front() {
        if goal.hold_in(state) {
            let mut order = Vec::new();
            let mut at = state;
            while let Some(Some((before, action))) = came.get(&at) {
                order.push(*action);
                at = *before;
            }
            order.reverse();
            return Ok(Some(order));
        }
        for (action, step) in steps.iter().enumerate() {
            if !step.before.hold_in(state) {
                continue;
            }
            let next = (state & !step.removes) | step.adds;
            if came.contains_key(&next) {
                continue;
            }
            if came.len() >= MOST_STATES {
                return Err(GoalFault::TooManyStates);
            }
            came.insert(next, Some((state, action)));
            waiting.push_back(next);
        }
    }
    Ok(None)
}

const MOST_STATES: usize = 500_000;

#[cfg(test)]
mod tests;
