//! The configuration of a product, split over the components that it names: checked at all of them
//! first, then set at all of them. If a component refuses or is lost meanwhile, the others are set
//! back.

use std::time::Duration;

use async_trait::async_trait;
use futures_util::future::join_all;
use mtp::{ConfiguredComponent, ConfiguredValue};
use serde::Serialize;
use skills::{FieldChange, SetFieldsFault, SkillFault, SkillValue};
use tokio::time::timeout;
use tracing::{info, warn};

/// A component with fields that can be set.
#[async_trait]
pub(crate) trait ConfigurationTarget: Send + Sync {
    /// Sets the fields, or only checks them. Returns their values before.
    async fn set(
        &self,
        fields: &FieldChange,
        checks_only: bool,
    ) -> Result<FieldChange, SetFieldsFault>;
}

/// A component of a product configuration, with its fields.
pub(crate) struct ProductComponent {
    pub(crate) application_uri: String,
    pub(crate) fields: FieldChange,
    /// The component, or the reason why it is not reached.
    pub(crate) target: Result<Box<dyn ConfigurationTarget>, String>,
}

/// The outcome of a product configuration, and of its components.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub(crate) struct ConfigurationReport {
    pub(crate) outcome: ProductOutcome,
    pub(crate) components: Vec<ComponentReport>,
}

/// The outcome of a product configuration.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum ProductOutcome {
    /// All components accept their fields. Nothing was set.
    Checked,
    /// All fields are set.
    Configured,
    /// A component does not accept its fields, or is not reached. Nothing was set.
    Refused,
    /// A component refused or was lost after the check, and all components have their values from
    /// before.
    SetBack,
    /// As before, and it is not known whether all components have their values from before.
    Unknown,
}

/// The outcome for a component, with the reason.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub(crate) struct ComponentReport {
    pub(crate) component: String,
    pub(crate) outcome: FieldsOutcome,
    pub(crate) reason: Option<String>,
}

/// The outcome for a component.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum FieldsOutcome {
    /// It accepts its fields, and has its values from before.
    Accepted,
    Configured,
    Refused,
    NotReached,
    /// Its fields were set, and it has its values from before again.
    SetBack,
    /// It is not known which values it has.
    Unknown,
}

/// Converts the fields of a component.
pub(crate) fn fields(of: &ConfiguredComponent) -> FieldChange {
    let value = |value: &ConfiguredValue| match value {
        ConfiguredValue::Boolean(value) => SkillValue::from(*value),
        ConfiguredValue::Integer(value) => SkillValue::Int64(*value),
        ConfiguredValue::Number(value) => SkillValue::from(*value),
        ConfiguredValue::Text(text) => SkillValue::from(text.as_str()),
    };
    let fields = of.fields.iter();
    let fields = fields.map(|(name, given)| (name.clone(), Some(value(given))));
    fields.collect()
}

/// Checks a product configuration at all components, and sets it unless it is only to be checked.
pub(crate) async fn configure(
    components: &[ProductComponent],
    checks_only: bool,
) -> ConfigurationReport {
    let checks = components.iter().map(|component| async move {
        match &component.target {
            Ok(target) => set(&**target, &component.fields, true).await,
            Err(why) => Err((FieldsOutcome::NotReached, why.clone())),
        }
    });
    let checked = join_all(checks).await;
    let mut reports: Vec<ComponentReport> = components
        .iter()
        .zip(&checked)
        .map(|(component, checked)| match checked {
            Ok(_) => component.report(FieldsOutcome::Accepted, None),
            // Nothing is set by a check, also if its response is lost.
            Err((FieldsOutcome::Refused, why)) => {
                component.report(FieldsOutcome::Refused, Some(why.clone()))
            }
            Err((_, why)) => component.report(FieldsOutcome::NotReached, Some(why.clone())),
        })
        .collect();
    let is_accepted = checked.iter().all(Result::is_ok);
    if !is_accepted || checks_only {
        let outcome = match is_accepted {
            true => ProductOutcome::Checked,
            false => ProductOutcome::Refused,
        };
        return told(outcome, reports);
    }
    let before: Vec<FieldChange> = checked.into_iter().filter_map(Result::ok).collect();
    let mut ended = Vec::new();
    for component in components {
        let Ok(target) = &component.target else {
            continue;
        };
        let outcome = set(&**target, &component.fields, false).await;
        let is_set = outcome.is_ok();
        ended.push(match outcome {
            Ok(_) => component.report(FieldsOutcome::Configured, None),
            Err((outcome, why)) => component.report(outcome, Some(why)),
        });
        if !is_set {
            break;
        }
    }
    let is_whole = ended.len() == components.len()
        && ended
            .iter()
            .all(|report| report.outcome == FieldsOutcome::Configured);
    let undone = match is_whole {
        true => Vec::new(),
        false => set_back((components, &before), &ended).await,
    };
    for (number, report) in undone {
        if let Some(slot) = ended.get_mut(number) {
            *slot = report;
        }
    }
    for (report, ended) in reports.iter_mut().zip(ended) {
        *report = ended;
    }
    let is_unknown = reports
        .iter()
        .any(|report| report.outcome == FieldsOutcome::Unknown);
    let outcome = match (is_whole, is_unknown) {
        (true, _) => ProductOutcome::Configured,
        (false, true) => ProductOutcome::Unknown,
        (false, false) => ProductOutcome::SetBack,
    };
    told(outcome, reports)
}

/// Sets the configured components back, and the component with an unknown outcome, in
/// reverse order.
/// Returns the new reports by the numbers of the components.
async fn set_back(
    (components, before): (&[ProductComponent], &[FieldChange]),
    ended: &[ComponentReport],
) -> Vec<(usize, ComponentReport)> {
    let mut undone = Vec::new();
    let all = components.iter().zip(before).zip(ended).enumerate();
    for (number, ((component, before), report)) in all.rev() {
        let may_be_set = match report.outcome {
            FieldsOutcome::Configured | FieldsOutcome::Unknown => true,
            FieldsOutcome::Accepted
            | FieldsOutcome::Refused
            | FieldsOutcome::NotReached
            | FieldsOutcome::SetBack => false,
        };
        let Ok(target) = component.target.as_ref() else {
            continue;
        };
        if !may_be_set {
            continue;
        }
        let reason = report.reason.clone();
        let report = match set(&**target, before, false).await {
            Ok(_) => component.report(FieldsOutcome::SetBack, reason),
            Err((_, why)) => {
                let why = format!("its values from before are not set: {why}");
                let why = match reason {
                    Some(reason) => format!("{reason}; {why}"),
                    None => why,
                };
                component.report(FieldsOutcome::Unknown, Some(why))
            }
        };
        undone.push((number, report));
    }
    undone
}

/// Sets or checks fields within a time limit. Returns the values before, or the outcome with its
/// reason.
async fn set(
    target: &dyn ConfigurationTarget,
    fields: &FieldChange,
    checks_only: bool,
) -> Result<FieldChange, (FieldsOutcome, String)> {
    match timeout(WITHIN, target.set(fields, checks_only)).await {
        Ok(Ok(before)) => Ok(before),
        Ok(Err(fault)) => {
            let outcome = match &fault {
                SetFieldsFault::None | SetFieldsFault::Refused { .. } => FieldsOutcome::Refused,
                SetFieldsFault::Request(SkillFault::Refused { .. }) => FieldsOutcome::Refused,
                SetFieldsFault::Request(
                    SkillFault::Lost(_)
                    | SkillFault::TimedOut(_)
                    | SkillFault::NotHalted(_)
                    | SkillFault::Unexpected(_),
                ) => FieldsOutcome::Unknown,
            };
            Err((outcome, fault.to_string()))
        }
        Err(_) => {
            let why = format!("it has not answered within {WITHIN:?}");
            Err((FieldsOutcome::Unknown, why))
        }
    }
}

fn told(outcome: ProductOutcome, components: Vec<ComponentReport>) -> ConfigurationReport {
    for report in &components {
        let component = &report.component;
        match &report.reason {
            None => info!(component, outcome = ?report.outcome, "configuration of a product"),
            Some(why) => {
                warn!(component, outcome = ?report.outcome, "configuration of a product: {why}");
            }
        }
    }
    ConfigurationReport {
        outcome,
        components,
    }
}

impl ProductComponent {
    fn report(&self, outcome: FieldsOutcome, reason: Option<String>) -> ComponentReport {
        ComponentReport {
            component: self.application_uri.clone(),
            outcome,
            reason,
        }
    }
}

/// Time limit of each request to a component.
const WITHIN: Duration = Duration::from_secs(10);

#[cfg(test)]
mod tests {
    use std::collections::VecDeque;
    use std::sync::{Arc, Mutex};

    use super::*;

    type Journal = Arc<Mutex<Vec<String>>>;

    /// A component that records requests, and answers them in turn.
    struct Fake {
        name: &'static str,
        faults: Mutex<VecDeque<Option<SetFieldsFault>>>,
        journal: Journal,
    }

    #[async_trait]
    impl ConfigurationTarget for Fake {
        async fn set(
            &self,
            fields: &FieldChange,
            checks_only: bool,
        ) -> Result<FieldChange, SetFieldsFault> {
            let (_, value) = &fields[0];
            let value = value.as_ref().map_or(0.0, |value| value.as_f64().unwrap());
            let verb = if checks_only { "check" } else { "set" };
            let line = format!("{verb} {} {value}", self.name);
            self.journal.lock().unwrap().push(line);
            match self.faults.lock().unwrap().pop_front().flatten() {
                Some(fault) => Err(fault),
                None => Ok(vec![("Force".to_owned(), None)]),
            }
        }
    }

    fn lost() -> SetFieldsFault {
        SetFieldsFault::Request(SkillFault::Lost("no response".to_owned()))
    }

    fn wrong() -> SetFieldsFault {
        SetFieldsFault::Refused {
            field: "Force".to_owned(),
            reason: "expected 5 to 50 N, found 70".to_owned(),
        }
    }

    /// Configures a, b and c. Each has a list of faults, one for each request. Returns the outcome
    /// of the product, the outcomes of the components, and the journal.
    async fn run(
        faults: [Vec<Option<SetFieldsFault>>; 3],
        checks_only: bool,
    ) -> (ProductOutcome, Vec<FieldsOutcome>, Vec<String>) {
        let journal = Journal::default();
        let all = ["a", "b", "c"].into_iter().zip(faults);
        let components: Vec<ProductComponent> = all
            .map(|(name, faults)| ProductComponent {
                application_uri: format!("urn:{name}"),
                fields: vec![("Force".to_owned(), Some(SkillValue::from(7.0)))],
                target: Ok(Box::new(Fake {
                    name,
                    faults: Mutex::new(faults.into()),
                    journal: Arc::clone(&journal),
                })),
            })
            .collect();
        let report = configure(&components, checks_only).await;
        let outcomes = report.components.iter().map(|one| one.outcome).collect();
        let journal = journal.lock().unwrap().clone();
        (report.outcome, outcomes, journal)
    }

    const CHECKS: [&str; 3] = ["check a 7", "check b 7", "check c 7"];

    #[tokio::test]
    async fn all_are_checked_before_one_is_set_and_a_refusal_sets_nothing() {
        let none = || [vec![], vec![], vec![]];
        let (outcome, components, journal) = run(none(), false).await;
        assert_eq!(outcome, ProductOutcome::Configured);
        assert_eq!(components, [FieldsOutcome::Configured; 3]);
        let sets = ["set a 7", "set b 7", "set c 7"];
        assert_eq!(journal, [&CHECKS[..], &sets].concat());

        let (outcome, components, journal) = run(none(), true).await;
        assert_eq!(outcome, ProductOutcome::Checked);
        assert_eq!(components, [FieldsOutcome::Accepted; 3]);
        assert_eq!(journal, CHECKS);

        let faults = [vec![], vec![Some(wrong())], vec![Some(lost())]];
        let (outcome, components, journal) = run(faults, false).await;
        assert_eq!(outcome, ProductOutcome::Refused);
        let expected = [
            FieldsOutcome::Accepted,
            FieldsOutcome::Refused,
            FieldsOutcome::NotReached,
        ];
        assert_eq!(components, expected);
        assert_eq!(journal, CHECKS, "nothing was set");
    }

    #[tokio::test]
    async fn the_others_are_set_back_if_one_refuses_or_is_lost_in_between() {
        let at_set = |fault| vec![None, Some(fault)];
        let (outcome, components, journal) = run([vec![], vec![], at_set(wrong())], false).await;
        assert_eq!(outcome, ProductOutcome::SetBack);
        let expected = [
            FieldsOutcome::SetBack,
            FieldsOutcome::SetBack,
            FieldsOutcome::Refused,
        ];
        assert_eq!(components, expected);
        let rest = ["set a 7", "set b 7", "set c 7", "set b 0", "set a 0"];
        assert_eq!(journal[3..], rest);

        // The component that is lost may have set its fields, so it is set back too.
        for (again, expected) in [
            (None, FieldsOutcome::SetBack),
            (Some(lost()), FieldsOutcome::Unknown),
        ] {
            let is_known = expected == FieldsOutcome::SetBack;
            let faults = [vec![], vec![None, Some(lost()), again], vec![]];
            let (outcome, components, journal) = run(faults, false).await;
            let accepted = FieldsOutcome::Accepted;
            assert_eq!(components, [FieldsOutcome::SetBack, expected, accepted]);
            let whole = match is_known {
                true => ProductOutcome::SetBack,
                false => ProductOutcome::Unknown,
            };
            assert_eq!(outcome, whole);
            assert_eq!(journal[3..], ["set a 7", "set b 7", "set b 0", "set a 0"]);
        }
    }

    #[tokio::test]
    async fn a_component_that_is_not_reached_is_named_and_nothing_is_set() {
        let component = ProductComponent {
            application_uri: "urn:away".to_owned(),
            fields: Vec::new(),
            target: Err("it is not in the plant".to_owned()),
        };
        let report = configure(&[component], false).await;
        assert_eq!(report.outcome, ProductOutcome::Refused);
        let reason = report.components[0].reason.as_deref();
        assert_eq!(reason, Some("it is not in the plant"));
    }
}
