//! `ua-space skills start`: resets a skill if necessary, and runs it. A skill whose last outcome is
//! unknown is reset on demand only: its machine may move.

use skills::UNKNOWN_OUTCOME;

use super::info::not_found;
use super::{ListenEnd, Skill, SkillName, chosen, hear, in_group};
use crate::arguments::{CallArguments, GroupArguments, NamedTarget, StartSkill};
use crate::exit::CommandFailure;
use crate::live::call::{call, call_quietly, look_first};
use crate::live::plain::NamedValues;
use crate::live::text::harmless;

pub(super) fn start(StartSkill { reset, call: of }: &StartSkill) -> Result<(), CommandFailure> {
    let NamedTarget::Name(wanted) = &of.target else {
        // A topic of Start is called directly, without a Reset.
        return call(of);
    };
    let wanted = wanted.strip_suffix(".Start").unwrap_or(wanted);
    let (name, topic) = in_group(&of.group, async |mut live| {
        let one = |skill: &Skill| {
            let is_whole = skill.calls.contains_key("Start");
            is_whole.then(|| skill.reset(*reset))?
        };
        let name = SkillName::new(wanted);
        let is_whole = |found: &[Skill]| {
            let reset = name.of(found).and_then(one);
            reset.is_some_and(|reset| reset != ResetBefore::NoResult)
        };
        let (found, ended) = hear(&mut live, of.wait, &is_whole).await?;
        let skill = chosen(&found, wanted)?;
        let name = skill.map_or_else(|| wanted.to_owned(), Skill::name);
        match skill.and_then(one) {
            Some(ResetBefore::Not) => Ok((name, None)),
            Some(ResetBefore::By(topic)) => Ok((name, Some(topic))),
            Some(ResetBefore::Unknown(why)) => Err(refused(&name, &why)),
            _ if ended == ListenEnd::Interrupted => Err(CommandFailure::Interrupted),
            Some(ResetBefore::NoResult) => {
                let why = format!("its last outcome was not received for {} s", of.wait);
                Err(refused(&name, &why))
            }
            None => Err(not_found(wanted, &found, of.wait)),
        }
    })?;
    if let Some(topic) = topic.and_then(|topic| topic.parse().ok()) {
        call_quietly(&CallArguments {
            target: NamedTarget::Topic(topic),
            parameters: Vec::new(),
            run_timeout: None,
            no_wait: true,
            group: same(&of.group),
            ..*of
        })?;
    }
    call(&CallArguments {
        target: NamedTarget::Name(name),
        parameters: of.parameters.clone(),
        group: same(&of.group),
        ..*of
    })
}

/// The Reset before a Start.
#[derive(Debug, Clone, PartialEq, Eq)]
enum ResetBefore {
    /// The skill needs no Reset, or has none.
    Not,
    /// The topic of the call.
    By(String),
    /// The outcome of the last run is unknown, with its message.
    Unknown(String),
    /// The outcome of the last run has not been received.
    NoResult,
}

impl Skill {
    /// Returns the Reset that has to come before a Start; `None` if the state is not known.
    /// `is_forced` is true if the user asks for a Reset after an unknown outcome too.
    fn reset(&self, is_forced: bool) -> Option<ResetBefore> {
        let topic = self.calls.get("Reset");
        Some(match (self.state.as_deref()?, topic) {
            (HALTED, Some(topic)) if is_forced => ResetBefore::By(topic.clone()),
            (HALTED, Some(topic)) => match &self.result {
                Some(result) if result.number("run") == self.run => unknown(result).map_or_else(
                    || ResetBefore::By(topic.clone()),
                    |why| ResetBefore::Unknown(why.to_owned()),
                ),
                Some(_) | None => ResetBefore::NoResult,
            },
            _ => ResetBefore::Not,
        })
    }
}

/// Returns the message of a result if the outcome is unknown.
fn unknown(result: &NamedValues) -> Option<&str> {
    let message = result.text("message")?;
    message.contains(UNKNOWN_OUTCOME).then_some(message)
}

fn refused(skill: &str, why: &str) -> CommandFailure {
    let skill = harmless(skill);
    CommandFailure::Failed(format!(
        "{skill} is not started: {}\n  = help: {}",
        harmless(why),
        look_first(&skill)
    ))
}

fn same(group: &GroupArguments) -> GroupArguments {
    GroupArguments {
        interface: group.interface.clone(),
        address: group.address.clone(),
        broker: group.broker.clone(),
        cell: group.cell.clone(),
        keys: group.keys.clone(),
        sign: group.sign,
    }
}

const HALTED: &str = "Halted";

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn skill(state: &str, result: Option<(u64, &str)>) -> Skill {
        let result = result.map(|(run, message)| {
            NamedValues(vec![
                ("run".to_owned(), json!(run)),
                ("succeeded".to_owned(), json!(false)),
                ("message".to_owned(), json!(message)),
            ])
        });
        Skill {
            component: "cup".to_owned(),
            skill: "Grasp".to_owned(),
            type_name: None,
            type_namespace: None,
            topic: "ua_0_7_101".to_owned(),
            state: Some(state.to_owned()),
            run: Some(5),
            progress: None,
            step: None,
            age_s: 0.0,
            calls: [("Reset", "ua_0_7_109".to_owned())].into(),
            takes: None,
            result,
            parameters: Vec::new(),
        }
    }

    #[test]
    fn a_halted_skill_is_reset_unless_its_last_outcome_is_unknown() {
        let by = || Some(ResetBefore::By("ua_0_7_109".to_owned()));
        let failed = Some((5, "nothing was gripped"));
        assert_eq!(skill(HALTED, failed).reset(false), by());
        assert_eq!(skill("Ready", failed).reset(false), Some(ResetBefore::Not));
        let lost = Some((5, "halted; the outcome is unknown: no response"));
        let why = "halted; the outcome is unknown: no response".to_owned();
        assert_eq!(
            skill(HALTED, lost).reset(false),
            Some(ResetBefore::Unknown(why))
        );
        assert_eq!(skill(HALTED, lost).reset(true), by());
    }

    #[test]
    fn the_result_of_an_earlier_run_decides_nothing() {
        let earlier = skill(HALTED, Some((4, "nothing was gripped")));
        assert_eq!(earlier.reset(false), Some(ResetBefore::NoResult));
        let none = skill(HALTED, None);
        assert_eq!(none.reset(false), Some(ResetBefore::NoResult));
        assert_eq!(
            none.reset(true),
            Some(ResetBefore::By("ua_0_7_109".to_owned()))
        );
    }
}
