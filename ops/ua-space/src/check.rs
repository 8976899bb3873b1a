//! What is wrong with a mapping, for people and for programs.

use std::io::{self, BufWriter, Read as _, Write as _};

use mappings::{Checked, Diagnostic, Mapping};
use serde::Serialize;

use crate::arguments::Check;
use crate::environment::{Asked, Seen};
use crate::exit::Failure;
use crate::report::warn;

pub(crate) fn check(arguments: &Check) -> Result<(), Failure> {
    let mut out = BufWriter::new(io::stdout().lock());
    let (mut all_can_run, mut all_there) = (true, true);
    for file in &arguments.files {
        let text = read(file)?;
        let name = if file == "-" { "<stdin>" } else { file };
        let mut checked = Mapping::from_yaml(&text, name);
        all_can_run &= checked.mapping.is_some();
        let mut seen = None;
        if !arguments.environment.is_empty()
            && let Some(mapping) = &checked.mapping
        {
            let found = Seen::look(mapping, arguments)?;
            checked = Mapping::from_yaml_in(&text, name, &found.environment);
            all_there &= found.is_whole();
            seen = Some(found);
        }
        let asked = seen.as_ref().map(|seen| seen.asked.as_slice());
        if arguments.json {
            let line = serde_json::to_string(&Told::of(name, &checked, asked))
                .map_err(|error| Failure::Data(format!("{name}: {error}")))?;
            writeln!(out, "{line}")?;
        } else {
            out.write_all(checked.render(&text).as_bytes())?;
            for asked in asked.unwrap_or_default() {
                match &asked.why {
                    None => writeln!(out, "{} is there", asked.whom)?,
                    Some(why) => warn(&format!("error: {why}")),
                }
            }
            writeln!(out, "{}", sum(name, &checked))?;
        }
    }
    out.flush()?;
    if !all_can_run {
        Err(Failure::Configuration)
    } else if all_there {
        Ok(())
    } else {
        Err(Failure::NotThere)
    }
}

fn read(file: &str) -> Result<String, Failure> {
    let mut text = Vec::new();
    let read = if file == "-" {
        io::stdin().lock().take(MOST).read_to_end(&mut text)
    } else {
        std::fs::File::open(file).and_then(|file| file.take(MOST).read_to_end(&mut text))
    };
    let length = read.map_err(|error| Failure::reading(file, &error))?;
    if u64::try_from(length).is_ok_and(|length| length == MOST) {
        // It has a finding by its size alone (M002), and may end within a character.
        return Ok(String::from_utf8_lossy(&text).into_owned());
    }
    String::from_utf8(text).map_err(|error| {
        let at = error.utf8_error().valid_up_to();
        Failure::Io(format!(
            "cannot read {file}: it is not UTF-8 from byte {at} on; save it as UTF-8"
        ))
    })
}

/// What there is, in a line.
fn sum(name: &str, checked: &Checked) -> String {
    let Some(mapping) = &checked.mapping else {
        return format!("{name} cannot run");
    };
    let several = |count: usize, what: &str| match count {
        1 => format!("1 {what}"),
        _ => format!("{count} {what}s"),
    };
    let parts = [
        several(mapping.variables().len(), "variable"),
        several(mapping.patterns().len(), "pattern"),
        several(mapping.spaces().len(), "ROS space"),
    ];
    format!("{name} can run: {}", parts.join(", "))
}

#[derive(Serialize)]
#[serde(rename_all = "camelCase")]
struct Told<'a> {
    file: &'a str,
    can_run: bool,
    findings: Vec<Finding<'a>>,
    #[serde(skip_serializing_if = "Option::is_none")]
    environment: Option<&'a [Asked]>,
}

#[derive(Serialize)]
struct Finding<'a> {
    code: &'static str,
    severity: String,
    line: usize,
    column: usize,
    length: usize,
    message: &'a str,
    #[serde(skip_serializing_if = "Option::is_none")]
    label: Option<&'a str>,
    #[serde(skip_serializing_if = "Option::is_none")]
    help: Option<&'a str>,
}

impl<'a> Told<'a> {
    fn of(file: &'a str, checked: &'a Checked, environment: Option<&'a [Asked]>) -> Self {
        Self {
            file,
            can_run: checked.mapping.is_some(),
            findings: checked.findings.iter().map(Finding::of).collect(),
            environment,
        }
    }
}

impl<'a> Finding<'a> {
    fn of(found: &'a Diagnostic) -> Self {
        Self {
            code: found.code.as_str(),
            severity: found.severity.to_string(),
            line: found.at.line,
            column: found.at.column,
            length: found.at.len,
            message: &found.message,
            label: found.label.as_deref(),
            help: found.help.as_deref(),
        }
    }
}

/// More than a mapping may have (M002): a device that never ends is not read for ever.
const MOST: u64 = 5 << 20;
