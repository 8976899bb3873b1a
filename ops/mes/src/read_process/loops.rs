//! Reads the loops of processes from the graph.

use std::collections::{BTreeMap, BTreeSet};

use knowledge::QuestionAnswer;
use serde_json::Value;

use super::{ProcessFault, Row, StatementFault, conditions_of, one};
use crate::process::{Loop, LoopConditionFault, ProcessStep};

/// Reads the loops of a process. `order` has the IRIs of the steps.
///
/// # Errors
/// The reason why the process cannot run.
pub(super) fn loops_of(
    process: &str,
    (order, steps): (&[&str], &[ProcessStep]),
    (loops, conditions): (&[Row], &[Row]),
) -> Result<Vec<Loop>, ProcessFault> {
    let mut by_loop: BTreeMap<&str, Vec<&Row>> = BTreeMap::new();
    let of_process = |row: &&Row| QuestionAnswer::text(row, "process") == process;
    for row in loops.iter().filter(of_process) {
        by_loop
            .entry(QuestionAnswer::text(row, "loop"))
            .or_default()
            .push(row);
    }
    let mut all: Vec<Loop> = Vec::new();
    let mut iris = Vec::new();
    for (iri, rows) in by_loop {
        let read = read(iri, &rows, order, conditions);
        let read = read.map_err(ProcessFault::of("loop", iri))?;
        let is_apart =
            |other: &Loop| other.steps.is_disjoint(&read.steps) || other.is_within(&read);
        if !all
            .iter()
            .all(|other| is_apart(other) || read.is_within(other))
        {
            return Err(ProcessFault::of("loop", iri)(StatementFault::SharedSteps));
        }
        if let Some(step) = caught(&read, steps).and_then(|step| order.get(step)) {
            let fault = StatementFault::WaitsForItself((*step).to_owned());
            return Err(ProcessFault::of("loop", iri)(fault));
        }
        all.push(read);
        iris.push(iri);
    }
    // The steps of other loops may be over too.
    for (one, iri) in all.iter().zip(iris) {
        if let Some(fault) = condition_fault(one, (steps, &all), order) {
            return Err(ProcessFault::of("loop", iri)(fault));
        }
    }
    Ok(all)
}

fn read(
    iri: &str,
    rows: &[&Row],
    order: &[&str],
    conditions: &[Row],
) -> Result<Loop, StatementFault> {
    let mut steps = BTreeSet::new();
    let named = rows.iter().map(|row| QuestionAnswer::text(row, "step"));
    for step in named.filter(|step| !step.is_empty()) {
        let number = order.iter().position(|known| *known == step);
        steps.insert(number.ok_or_else(|| StatementFault::UnknownStep(step.to_owned()))?);
    }
    if steps.is_empty() {
        return Err(StatementFault::Missing("ua:repeats"));
    }
    let rounds = match one(rows, "rounds")? {
        None => Loop::USUAL_ROUNDS,
        Some(value) => rounds(value).ok_or_else(|| StatementFault::Rounds(value.clone()))?,
    };
    // Its conditions are decided when all its steps are over.
    let again = conditions_of(iri, (order, order.len()), conditions)?;
    if again.is_empty() {
        return Err(StatementFault::Missing("ua:when"));
    }
    Ok(Loop {
        steps,
        again,
        rounds,
    })
}

/// Returns the reason why a condition of a loop cannot decide about another round.
fn condition_fault(
    one: &Loop,
    (steps, loops): (&[ProcessStep], &[Loop]),
    order: &[&str],
) -> Option<StatementFault> {
    let name = |step: usize| order.get(step).copied().unwrap_or_default().to_owned();
    Some(match one.condition_fault(steps, loops)? {
        LoopConditionFault::MayNotBeOver(step) => StatementFault::MayNotBeOver(name(step)),
        LoopConditionFault::IsConstant(step) => StatementFault::ConstantCondition(name(step)),
    })
}

fn rounds(value: &Value) -> Option<u32> {
    let rounds = u32::try_from(value.as_u64()?).ok()?;
    (1..=Loop::MOST_ROUNDS).contains(&rounds).then_some(rounds)
}

/// Returns a step outside a loop for which the loop waits, and which waits for the loop.
fn caught(one: &Loop, steps: &[ProcessStep]) -> Option<usize> {
    let mut behind: BTreeSet<usize> = BTreeSet::new();
    for (number, step) in steps.iter().enumerate() {
        let waits = step.waits_for(number);
        if one.steps.contains(&number) {
            let caught = waits.iter().find(|other| behind.contains(other));
            if let Some(other) = caught {
                return Some(*other);
            }
        } else if waits
            .iter()
            .any(|other| one.steps.contains(other) || behind.contains(other))
        {
            behind.insert(number);
        }
    }
    None
}
