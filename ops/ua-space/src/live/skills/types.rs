//! `ua-space types`: shows the skill types of the cell with their parameters.

use std::collections::BTreeMap;
use std::io::{self, Write as _};

use serde::Serialize;

use super::{Skill, hear, in_group};
use crate::arguments::TypesArguments;
use crate::exit::CommandFailure;
use crate::live::described::{AnnouncedField, ShownField};
use crate::live::text::{harmless, is_coloured, json, wrapped};

/// Runs `ua-space types`.
pub(crate) fn types(arguments: &TypesArguments) -> Result<(), CommandFailure> {
    in_group(&arguments.group, async |mut live| {
        let (found, _) = hear(&mut live, arguments.seconds, &|_| false).await?;
        let types = of(&found, arguments.name.as_deref());
        let mut out = io::stdout().lock();
        if arguments.json {
            writeln!(out, "{}", json(&types)?)?;
        }
        live.tell_dropped();
        if types.is_empty() {
            return Err(missing(arguments, &found));
        }
        if arguments.json {
            return Ok(());
        }
        for (at, one) in types.iter().enumerate() {
            if at > 0 {
                writeln!(out)?;
            }
            let title = format!("{} of {}", one.name, one.namespace);
            write!(out, "{}", wrapped("", &harmless(&title)))?;
            let skills = harmless(&one.skills.join(", "));
            write!(out, "{}", wrapped("skills: ", &skills))?;
            if one.fields.is_empty() {
                writeln!(out, "no parameters")?
            } else {
                super::info::parameters(one.fields).write(&mut out, is_coloured())?
            }
        }
        Ok(())
    })
}

/// A skill type with the skills that have it.
#[derive(Debug, Serialize)]
struct SkillType<'a> {
    name: &'a str,
    namespace: &'a str,
    skills: Vec<String>,
    parameters: Vec<ShownField<'a>>,
    #[serde(skip)]
    fields: &'a [AnnouncedField],
}

fn of<'a>(skills: &'a [Skill], wanted: Option<&str>) -> Vec<SkillType<'a>> {
    let mut types: BTreeMap<(&str, &str), SkillType<'a>> = BTreeMap::new();
    for skill in skills {
        let Some(name) = skill.type_name.as_deref() else {
            continue;
        };
        if wanted.is_some_and(|wanted| !is_meant(name, wanted)) {
            continue;
        }
        let namespace = skill.type_namespace.as_deref().unwrap_or_default();
        let one = types.entry((name, namespace)).or_insert_with(|| SkillType {
            name,
            namespace,
            skills: Vec::new(),
            parameters: Vec::new(),
            fields: &[],
        });
        one.skills.push(skill.name());
        if one.fields.is_empty() {
            one.fields = &skill.parameters;
            one.parameters = skill.parameters.iter().map(AnnouncedField::shown).collect();
        }
    }
    types.into_values().collect()
}

/// Returns true for the name of a type, with or without `SkillType`, in any case.
fn is_meant(name: &str, wanted: &str) -> bool {
    let short = name.strip_suffix("SkillType").unwrap_or(name);
    name.eq_ignore_ascii_case(wanted) || short.eq_ignore_ascii_case(wanted)
}

fn missing(arguments: &TypesArguments, found: &[Skill]) -> CommandFailure {
    let mut names: Vec<&str> = found
        .iter()
        .filter_map(|skill| skill.type_name.as_deref())
        .collect();
    names.sort_unstable();
    names.dedup();
    let what = match &arguments.name {
        Some(name) => format!("no skill of type {}", harmless(name)),
        None => "no skill".to_owned(),
    };
    let help = match names.as_slice() {
        [] => "is this the group and the interface (--address, --interface)?".to_owned(),
        names => format!("there are {}", harmless(&names.join(", "))),
    };
    let seconds = arguments.seconds;
    CommandFailure::Unavailable(format!(
        "{what} was heard for {seconds} s\n  = help: {help}"
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_type_is_meant_with_and_without_its_ending() {
        for wanted in ["GraspSkillType", "Grasp", "grasp", "graspskilltype"] {
            assert!(is_meant("GraspSkillType", wanted), "{wanted}");
        }
        assert!(!is_meant("GraspSkillType", "Gras"));
        assert!(!is_meant("GraspSkillType", "Release"));
    }
}
