//! The facts of the plant for one plan: the values of queries, and the checks of skills.

use std::collections::BTreeMap;

use knowledge::ValueQueryFault;
use skills::Unchosen;
use skills::choosing::Attachment;

use super::Plant;
use super::sequence::RunProgress;
use crate::parameter_fault::ParameterFault;
use crate::plan::{Facts, Offer};
use crate::process::{GivenParameter, Process, ProcessStep};

/// A process with the results of its queries, evaluated before a plan is made.
pub(super) struct EvaluatedProcess {
    /// The process with the values of its queries. A completed step has the values of the plan
    /// that did it, such as the tool that it attached.
    pub(super) process: Process,
    /// The queries without a value, by the numbers of their steps and compensations. A step with
    /// conditions may be skipped, so its queries are not among them.
    faults: BTreeMap<usize, ParameterFault>,
}

impl EvaluatedProcess {
    /// Evaluates the queries of the steps that are not over, and of their compensations. Each query
    /// is evaluated once.
    pub(super) async fn of(plant: &dyn Plant, process: &Process, progress: &RunProgress) -> Self {
        let mut evaluated = Self {
            process: process.clone(),
            faults: BTreeMap::new(),
        };
        for done in progress.current() {
            if let Some(step) = evaluated.process.steps.get_mut(done.number) {
                *step = done.step.clone();
            }
        }
        let mut values = BTreeMap::new();
        let steps = evaluated.process.steps.iter_mut().enumerate();
        for (number, step) in steps.filter(|(number, _)| !progress.is_over(*number)) {
            let is_certain = step.when.is_empty();
            let undo = step.compensation.as_deref_mut();
            let undo = undo.map(|undo| (process.compensation_of(number), &mut undo.parameters));
            let both = std::iter::once((number, &mut step.parameters)).chain(undo);
            for (number, given) in both {
                let fault = fill_in(plant, given, &mut values).await;
                if let Some(fault) = fault.filter(|_| is_certain) {
                    evaluated.faults.insert(number, fault);
                }
            }
        }
        evaluated
    }

    /// Returns the reason why a query of a step without conditions, or of its compensation, has no
    /// value. No component that comes later can help.
    pub(super) fn fault(&self) -> Option<String> {
        let (number, why) = self.faults.first_key_value()?;
        let step = self.process.step(*number)?;
        Some(format!("{}: {why}", step.name))
    }
}

/// Gives parameters the values of their queries. Returns the reason of the first query without a
/// value; its parameter stays null.
async fn fill_in(
    plant: &dyn Plant,
    parameters: &mut [GivenParameter],
    values: &mut BTreeMap<String, Result<serde_json::Value, ValueQueryFault>>,
) -> Option<ParameterFault> {
    let mut fault = None;
    for given in parameters {
        let Some(query) = &given.query else { continue };
        let value = match values.get(&query.sparql) {
            Some(value) => value.clone(),
            None => {
                let value = plant.query(query).await;
                values.insert(query.sparql.clone(), value.clone());
                value
            }
        };
        match given.evaluated(value) {
            Ok(evaluated) => *given = evaluated,
            Err(why) => drop(fault.get_or_insert(why)),
        }
    }
    fault
}

/// The facts about skills that the plant knows, for one plan.
pub(super) struct OfPlant<'a> {
    pub(super) plant: &'a dyn Plant,
    pub(super) evaluated: &'a EvaluatedProcess,
}

impl Facts for OfPlant<'_> {
    fn takes(
        &self,
        offer: &Offer,
        (number, step): (usize, &ProcessStep),
    ) -> Result<(), ParameterFault> {
        if let Some(why) = self.evaluated.faults.get(&number) {
            return Err(why.clone());
        }
        let values = self.plant.values(&offer.skill, &step.parameters);
        values.map(drop)
    }

    fn gives(&self, offer: &Offer, result: &str) -> Result<(), ParameterFault> {
        self.plant.result(&offer.skill, result).map(drop)
    }

    fn connects(&self, from: (&str, &str), to: (&str, &str)) -> Result<(), ParameterFault> {
        self.plant.connects(from, to)
    }

    fn reaches(&self, offer: &Offer, positions: &[[f64; 3]]) -> Result<(), ParameterFault> {
        self.plant.reaches(&offer.skill, positions)
    }

    fn mounts(&self, robot: &Offer, gripper: &Offer) -> Result<(), Unchosen> {
        let plate = self.plant.plate(&robot.component, &gripper.component);
        plate.map(drop)
    }

    fn attachment(&self, offer: &Offer) -> Attachment {
        self.plant.attachment(&offer.component)
    }

    fn moves(&self, offer: &Offer, changer: &str) -> bool {
        self.plant.moves(&offer.component, changer)
    }

    fn prefer(&self) -> &[String] {
        self.plant.prefer()
    }
}
