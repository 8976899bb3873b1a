//! `ua-space skills info`: shows all details of a skill.

use std::io::{self, Write as _};

use serde::Serialize;

use super::{ListenEnd, Skill, SkillName, chosen, hear, in_group};
use crate::arguments::InfoSkill;
use crate::exit::CommandFailure;
use crate::live::described::{AnnouncedField, ShownField};
use crate::live::plain::NamedValues;
use crate::live::run::results;
use crate::live::text::{TextTable, harmless, is_coloured, json, wrapped};

pub(super) fn info(arguments: &InfoSkill) -> Result<(), CommandFailure> {
    in_group(&arguments.group, async |mut live| {
        let wanted = &arguments.skill;
        let name = SkillName::new(wanted);
        let is_whole = |found: &[Skill]| {
            name.of(found).is_some_and(|skill| {
                skill.state.is_some()
                    && skill.calls.len() == super::METHODS.len()
                    && skill.result.is_some()
            })
        };
        let (found, ended) = hear(&mut live, arguments.seconds, &is_whole).await?;
        let Some(skill) = chosen(&found, wanted)? else {
            if ended == ListenEnd::Interrupted {
                return Err(CommandFailure::Interrupted);
            }
            return Err(not_found(wanted, &found, arguments.seconds));
        };
        let whole = Whole {
            skill,
            parameters: skill.parameters.iter().map(|field| field.shown()).collect(),
            result: skill.result.as_ref().and_then(Ending::of),
        };
        let mut out = io::stdout().lock();
        if arguments.json {
            writeln!(out, "{}", json(&whole)?)?;
        } else {
            for (what, text) in whole.lines() {
                let head = format!("{:<12} ", format!("{what}:"));
                write!(out, "{}", wrapped(&head, &harmless(&text)))?;
            }
            if !skill.parameters.is_empty() {
                writeln!(out)?;
                parameters(&skill.parameters).write(&mut out, is_coloured())?;
            }
        }
        live.tell_dropped();
        Ok(())
    })
}

/// Returns the table of the parameters of Start.
pub(super) fn parameters(fields: &[AnnouncedField]) -> TextTable {
    let head = [
        "PARAMETER",
        "TYPE",
        "UNIT",
        "RANGE",
        "DEFAULT",
        "DESCRIPTION",
    ];
    let mut table = TextTable::new(head.map(str::to_owned)).yielding([5, 4]);
    for field in fields {
        let meaning = &field.meaning;
        let range = meaning.range.map(|(low, high)| format!("{low} to {high}"));
        let default = match (&meaning.default, field.optional) {
            (Some(default), _) => default.clone(),
            (None, true) => "optional".to_owned(),
            (None, false) => "required".to_owned(),
        };
        table.row([
            field.name.clone(),
            field.kind(),
            or_dash(&meaning.unit),
            range.unwrap_or_else(|| "-".to_owned()),
            default,
            or_dash(&field.description),
        ]);
    }
    table.without_empty_columns()
}

fn or_dash(text: &str) -> String {
    match text {
        "" => "-".to_owned(),
        text => text.to_owned(),
    }
}

/// Returns the failure for a skill that was not found, with the received skills.
pub(super) fn not_found(wanted: &str, found: &[Skill], seconds: f64) -> CommandFailure {
    let names: Vec<String> = found.iter().take(SHOWN).map(Skill::name).collect();
    let help = if names.is_empty() {
        "no skills were heard; is this the group and the interface (--address, --interface)?"
            .to_owned()
    } else {
        format!("there are {}", names.join(", "))
    };
    let wanted = harmless(wanted);
    CommandFailure::Unavailable(format!(
        "no skill {wanted} was heard for {seconds} s\n  = help: {}",
        harmless(&help)
    ))
}

#[derive(Serialize)]
struct Whole<'a> {
    #[serde(flatten)]
    skill: &'a Skill,
    parameters: Vec<ShownField<'a>>,
    /// The result of the last run; `None` before the end of the first run.
    result: Option<Ending>,
}

#[derive(Serialize)]
struct Ending {
    run: u64,
    succeeded: bool,
    message: String,
    results: NamedValues,
}

impl Ending {
    fn of(value: &NamedValues) -> Option<Self> {
        let run = value.number("run").filter(|run| *run > 0)?;
        Some(Self {
            run,
            succeeded: value.get("succeeded").and_then(serde_json::Value::as_bool) == Some(true),
            message: value.text("message").unwrap_or_default().to_owned(),
            results: results(value),
        })
    }
}

impl Whole<'_> {
    fn lines(&self) -> Vec<(&'static str, String)> {
        let Self { skill, result, .. } = self;
        let mut lines = vec![("skill", skill.name())];
        if let (Some(name), Some(namespace)) = (&skill.type_name, &skill.type_namespace) {
            lines.push(("type", format!("{name} of {namespace}")));
        }
        lines.push(("topic", skill.topic.clone()));
        if let Some(state) = &skill.state {
            let step = skill.step.as_deref().unwrap_or_default();
            lines.push(("state", format!("{state} {step}").trim_end().to_owned()));
        }
        if let Some(run) = skill.run.filter(|run| *run > 0) {
            lines.push(("run", run.to_string()));
        }
        if let Some(ending) = result {
            let how = if ending.succeeded {
                "succeeded"
            } else {
                "failed"
            };
            let message = match ending.message.as_str() {
                "" => String::new(),
                message => format!(": {message}"),
            };
            lines.push(("last", format!("run {} {how}{message}", ending.run)));
            for (name, value) in &ending.results.0 {
                lines.push(("result", format!("{name}: {value}")));
            }
        }
        for (method, topic) in &skill.calls {
            lines.push(("call", format!("{topic} {method}")));
        }
        lines
    }
}

/// Maximum number of names listed if a skill is not found.
const SHOWN: usize = 20;
