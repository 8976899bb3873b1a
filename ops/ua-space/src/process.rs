//! `ua-space process`: imports processes from recipes of other programs.

use std::collections::BTreeMap;

use serde_json::json;
use uri_text::escaped;

use crate::arguments::{ProcessArguments, ProcessVerb};
use crate::exit::CommandFailure;
use crate::input::read;
use crate::live::harmless;
use crate::report::{say, warn};
use crate::source::{CREATED, change, findings, plain_name};

/// Runs `ua-space process`.
pub(crate) fn process(arguments: &ProcessArguments) -> Result<(), CommandFailure> {
    let ProcessVerb::Import {
        file,
        names,
        source,
        at,
    } = &arguments.verb;
    let contents = read(file)?;
    let recipe = xml_text::decode(&contents)
        .map_err(|fault| CommandFailure::Data(format!("{file}: {fault}")))?;
    let name = match source {
        Some(name) => name.clone(),
        None => plain_name(file)?,
    };
    let body = json!({ "recipe": recipe, "names": named(names)? }).to_string();
    let path = format!("/sources/process/{}", escaped(&name));
    let done = change("PUT", &path, ("application/json", body.into_bytes()), at)?;
    let verb = match done.status {
        CREATED => "added",
        _ => "replaced",
    };
    for found in findings(&at.mes, "process", &name)? {
        warn(&harmless(&format!("note: {file}: {found}")));
    }
    say(&format!("process {name}: {verb}"))
}

/// Reads names with the names that they stand for.
fn named(names: &[String]) -> Result<BTreeMap<&str, &str>, CommandFailure> {
    let mut all = BTreeMap::new();
    for name in names {
        // The type of a skill begins with nsu=. An IRI contains no =, and a name of a recipe may.
        let at = name.find("=nsu=").or_else(|| name.rfind('='));
        let split = at.and_then(|at| Some((name.get(..at)?, name.get(at + 1..)?)));
        let split = split.filter(|(name, of)| !name.is_empty() && !of.is_empty());
        let (name, stands_for) = split.ok_or_else(|| {
            CommandFailure::Usage(format!("--name {name}: expected NAME=NAME, as Sekunde=s"))
        })?;
        all.insert(name, stands_for);
    }
    Ok(all)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_split_at_the_sign_that_is_no_part_of_them() {
        let given = [
            "Sekunde=s",
            "a=b=urn:c:dose",
            "001:x=nsu=urn:m;A-BSkillType",
        ];
        let named = named(&given.map(str::to_owned)).map(|all| {
            let all = all.into_iter();
            all.map(|(name, of)| format!("{name} {of}"))
                .collect::<Vec<_>>()
        });
        let expected = [
            "001:x nsu=urn:m;A-BSkillType",
            "Sekunde s",
            "a=b urn:c:dose",
        ];
        assert_eq!(named.ok().unwrap(), expected);
        for wrong in ["", "=", "a=", "=b", "none"] {
            assert!(super::named(&[wrong.to_owned()]).is_err(), "{wrong}");
        }
    }
}
