//! `ua-space check`: reports the findings of a mapping as text or JSON.

use std::fs::File;
use std::io::{self, BufWriter, Write as _};
use std::path::PathBuf;

use mappings::{
    Checked, Diagnostic, Environment, FileReaders, Mapping, NodeSets, OpenTypeFiles, SpaceId,
    Surroundings, TypeOrigin, TypeUse,
};
use messages::Dialect;
use serde::Serialize;
use type_files::Disk;

use crate::arguments::CheckArguments;
use crate::environment::{EnvironmentQuery, QueriedEnvironment};
use crate::exit::CommandFailure;
use crate::report::warn;

pub(crate) fn check(arguments: &CheckArguments) -> Result<(), CommandFailure> {
    let mut out = BufWriter::new(io::stdout().lock());
    let (mut all_can_run, mut all_there) = (true, true);
    for file in &arguments.files {
        let text = read(file)?;
        let name = if file == "-" { "<stdin>" } else { file };
        let part = |checked: Checked| match arguments.spaces.as_slice() {
            [] => checked,
            spaces => checked.for_spaces(spaces),
        };
        let mut checked = part(Mapping::from_text(&text, name, &Around::default()));
        all_can_run &= checked.mapping.is_some();
        let mut seen = None;
        if !arguments.environment.is_empty()
            && let Some(mapping) = &checked.mapping
        {
            let found = QueriedEnvironment::look(mapping, arguments)?;
            let around = Around {
                environment: Some(&found.environment),
            };
            checked = part(Mapping::from_text(&text, name, &around));
            all_there &= found.is_whole();
            seen = Some(found);
        }
        let asked = seen.as_ref().map(|seen| seen.asked.as_slice());
        if arguments.json {
            let told = CheckJson::of(name, &checked, asked, &arguments.spaces);
            writeln!(out, "{}", crate::live::json(&told)?)?;
        } else {
            out.write_all(checked.render_all().as_bytes())?;
            for asked in asked.unwrap_or_default() {
                match &asked.why {
                    None => writeln!(out, "{} is there", asked.whom)?,
                    Some(why) => warn(&format!("error: {why}")),
                }
            }
            writeln!(out, "{}", sum(name, &checked, &arguments.spaces))?;
        }
    }
    out.flush()?;
    if !all_can_run {
        Err(CommandFailure::Configuration)
    } else if all_there {
        Ok(())
    } else {
        Err(CommandFailure::NotThere)
    }
}

fn read(file: &str) -> Result<String, CommandFailure> {
    let read = match file {
        "-" => type_files::read_text(io::stdin().lock()),
        // The file may be a pipe that the user fills.
        file => File::open(file).and_then(type_files::read_text),
    };
    read.map_err(|why| CommandFailure::Io(format!("cannot read {file}: {why}")))
}

/// The files and variables around a mapping, with the environment if it was queried.
#[derive(Default)]
struct Around<'a> {
    environment: Option<&'a Environment>,
}

impl Surroundings for Around<'_> {
    fn read(&self, file: &str) -> io::Result<String> {
        Disk.read(file)
    }

    fn list(&self, folder: &str) -> io::Result<Vec<String>> {
        Disk.list(folder)
    }

    fn variable(&self, name: &str) -> Option<String> {
        Disk.variable(name)
    }

    fn readers(&self, file: &str) -> Option<FileReaders> {
        Disk.readers(file)
    }

    fn types(&self, paths: &[PathBuf]) -> Box<dyn OpenTypeFiles> {
        Disk.types(paths)
    }

    fn nodesets(&self, files: &[PathBuf]) -> Option<Box<dyn NodeSets>> {
        Some(plant_nodesets::read(files))
    }

    fn environment(&self) -> Option<&Environment> {
        self.environment
    }
}

/// Returns the summary line of a mapping.
fn sum(name: &str, checked: &Checked, spaces: &[SpaceId]) -> String {
    let numbers: Vec<String> = spaces.iter().map(ToString::to_string).collect();
    let part = match spaces.len() {
        0 => String::new(),
        1 => format!(" for space {}", numbers.join("")),
        _ => format!(" for the spaces {}", numbers.join(", ")),
    };
    let Some(mapping) = &checked.mapping else {
        return format!("{name} cannot run{part}");
    };
    let several = |count: usize, what: &str| match count {
        1 => format!("1 {what}"),
        _ => format!("{count} {what}s"),
    };
    let parts = [
        several(mapping.variables().len(), "variable"),
        several(mapping.patterns().len(), "pattern"),
        several(mapping.calls().len(), "call"),
        several(mapping.spaces().len(), "ROS space"),
    ];
    // A space without configuration is most likely a typing error; a bridge would run there without
    // a line of configuration.
    let unknown: Vec<String> = spaces
        .iter()
        .filter(|space| **space != SpaceId::UA && mapping.space(**space).is_none())
        .map(ToString::to_string)
        .collect();
    let unknown = if unknown.is_empty() {
        String::new()
    } else {
        format!(" (it has no space {})", unknown.join(", "))
    };
    format!("{name} can run{part}{unknown}: {}", parts.join(", "))
}

#[derive(Serialize)]
#[serde(rename_all = "camelCase")]
struct CheckJson<'a> {
    file: &'a str,
    can_run: bool,
    /// The spaces given with `--for`.
    #[serde(rename = "for", skip_serializing_if = "Vec::is_empty")]
    spaces: Vec<u8>,
    findings: Vec<Finding<'a>>,
    /// The message, service and action types that the mapping uses.
    types: Vec<Type<'a>>,
    #[serde(skip_serializing_if = "Option::is_none")]
    environment: Option<&'a [EnvironmentQuery]>,
}

#[derive(Serialize)]
struct Type<'a> {
    ros: u8,
    name: &'a str,
    /// The path of a file, `built in`, or `unknown`.
    from: &'a str,
}

impl<'a> Type<'a> {
    fn of(used: &'a TypeUse) -> Self {
        Self {
            ros: match used.dialect {
                Dialect::Ros1 => 1,
                Dialect::Ros2 => 2,
            },
            name: used.name.as_str(),
            from: match &used.source {
                TypeOrigin::BuiltIn => "built in",
                TypeOrigin::File(file) => file,
                TypeOrigin::Unknown => "unknown",
            },
        }
    }
}

#[derive(Serialize)]
struct Finding<'a> {
    /// The file of the finding, if it is an included file instead of the checked file.
    #[serde(skip_serializing_if = "Option::is_none")]
    file: Option<&'a str>,
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
    /// The spaces with programs that the finding stops; empty if it stops all programs.
    #[serde(rename = "neededBy", skip_serializing_if = "Vec::is_empty")]
    needed_by: Vec<u8>,
}

impl<'a> CheckJson<'a> {
    fn of(
        file: &'a str,
        checked: &'a Checked,
        environment: Option<&'a [EnvironmentQuery]>,
        spaces: &[SpaceId],
    ) -> Self {
        Self {
            file,
            can_run: checked.mapping.is_some(),
            spaces: spaces.iter().map(|space| space.get()).collect(),
            findings: checked
                .findings
                .iter()
                .map(|found| Finding::of(file, found))
                .collect(),
            types: checked.types.iter().map(Type::of).collect(),
            environment,
        }
    }
}

impl<'a> Finding<'a> {
    fn of(file: &str, found: &'a Diagnostic) -> Self {
        Self {
            file: Some(&*found.at.file).filter(|name| *name != file),
            code: found.code.as_str(),
            severity: found.severity.to_string(),
            line: found.at.line,
            column: found.at.column,
            length: found.at.len,
            message: &found.message,
            label: found.label.as_deref(),
            help: found.help.as_deref(),
            needed_by: found.needed_by.iter().map(|space| space.get()).collect(),
        }
    }
}
