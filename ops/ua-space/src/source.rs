//! `ua-space source`: lists, adds and removes the sources of the knowledge of the plant.

use std::io::{self, Write as _};
use std::path::Path;

use serde::Deserialize;
use uri_text::escaped;

use crate::arguments::{MesAt, SourceArguments, SourceAt, SourceVerb};
use crate::ask::refusal;
use crate::exit::CommandFailure;
use crate::http::{ChangeRequest, HttpResponse, HttpServer};
use crate::input::read;
use crate::live::{TextTable, harmless, is_coloured};
use crate::report::say;
use crate::survey::look;

/// Runs `ua-space source`.
pub(crate) fn source(arguments: &SourceArguments) -> Result<(), CommandFailure> {
    match &arguments.verb {
        SourceVerb::List { json, at } => list(*json, at),
        SourceVerb::Add {
            file,
            kind,
            name,
            rml,
            at,
        } => {
            let mut contents = read(file)?;
            let kind = match (kind, rml) {
                (Some(kind), _) => kind.clone(),
                (None, Some(mapping)) => {
                    contents = crate::rml::turtle(mapping, contents)?;
                    "file".to_owned()
                }
                (None, None) => kind_of(file, &contents)?.to_owned(),
            };
            let name = match name {
                Some(name) => name.clone(),
                None => plain_name(file)?,
            };
            let path = format!("/sources/{}/{}", escaped(&kind), escaped(&name));
            let done = change("PUT", &path, ("application/octet-stream", contents), at)?;
            let verb = if done.status == CREATED {
                "added"
            } else {
                "replaced"
            };
            say(&format!("{kind} {name}: {verb}"))
        }
        SourceVerb::Remove { kind, name, at } => {
            let path = format!("/sources/{}/{}", escaped(kind), escaped(name));
            change("DELETE", &path, ("", Vec::new()), at)?;
            say(&format!("{kind} {name}: removed"))
        }
        SourceVerb::Check { turtle, json, at } => check(*turtle, *json, at),
        SourceVerb::Update { file, at } => {
            let update = read(file)?;
            change("POST", "/update", ("application/sparql-update", update), at)?;
            say("updated")
        }
    }
}

#[derive(Debug, Deserialize)]
struct Sources {
    sources: Vec<ListedSource>,
    findings: Vec<Finding>,
}

#[derive(Debug, Deserialize)]
struct ListedSource {
    kind: String,
    name: String,
    statements: u64,
    lasting: bool,
}

#[derive(Debug, Deserialize)]
struct Finding {
    kind: String,
    source: String,
    what: String,
}

fn list(json: bool, at: &SourceAt) -> Result<(), CommandFailure> {
    let server = HttpServer::parse(&at.mes.url)?;
    look(async {
        let answer = server.get("/sources").await?;
        if answer.status != 200 {
            return Err(refusal(&answer));
        }
        let mut out = io::stdout().lock();
        if json {
            let text = mappings::harmless_json(answer.body.trim_end());
            writeln!(out, "{text}")?;
            return Ok(());
        }
        let all: Sources = serde_json::from_str(&answer.body)
            .map_err(|error| CommandFailure::Data(format!("cannot read the response: {error}")))?;
        let columns = ["KIND", "SOURCE", "STATEMENTS", "STORED", "FINDING"];
        let mut table = TextTable::new(columns.map(str::to_owned));
        for known in &all.sources {
            let stored = if known.lasting { "yes" } else { "no" };
            let of_known = all.findings.iter();
            let of_known = of_known
                .filter(|found| found.kind == known.kind && found.source == known.name)
                .map(|found| found.what.as_str());
            let findings: Vec<&str> = of_known.collect();
            table.row([
                known.kind.clone(),
                known.name.clone(),
                known.statements.to_string(),
                stored.to_owned(),
                findings.join("; "),
            ]);
        }
        for found in &all.findings {
            let mut known = all.sources.iter();
            if !known.any(|known| found.kind == known.kind && found.source == known.name) {
                table.row([
                    found.kind.clone(),
                    found.source.clone(),
                    "-".to_owned(),
                    "-".to_owned(),
                    found.what.clone(),
                ]);
            }
        }
        table.write(&mut out, is_coloured())?;
        Ok(())
    })
}

/// A report of shapes.
#[derive(Debug, Deserialize)]
struct Report {
    conforms: bool,
    results: Vec<Violation>,
    unchecked: Vec<String>,
}

#[derive(Debug, Deserialize)]
struct Violation {
    focus: String,
    path: Option<String>,
    value: Option<String>,
    message: String,
    severity: Option<String>,
}

fn check(turtle: bool, json: bool, at: &SourceAt) -> Result<(), CommandFailure> {
    let server = HttpServer::parse(&at.mes.url)?;
    look(async {
        let answer = if turtle {
            server.get_turtle("/report").await?
        } else {
            server.get("/report").await?
        };
        if answer.status != 200 {
            return Err(refusal(&answer));
        }
        let mut out = io::stdout().lock();
        if turtle {
            for line in answer.body.lines() {
                writeln!(out, "{}", harmless(line))?;
            }
            return told(!answer.body.contains("sh:conforms false"));
        }
        let report: Report = serde_json::from_str(&answer.body)
            .map_err(|error| CommandFailure::Data(format!("cannot read the response: {error}")))?;
        if json {
            let text = mappings::harmless_json(answer.body.trim_end());
            writeln!(out, "{text}")?;
        } else if !report.results.is_empty() {
            let columns = ["SEVERITY", "NODE", "PATH", "VALUE", "MESSAGE"];
            let mut table = TextTable::new(columns.map(str::to_owned));
            for found in &report.results {
                let dash = || "-".to_owned();
                table.row([
                    found.severity.clone().unwrap_or_else(dash),
                    found.focus.clone(),
                    found.path.clone().unwrap_or_else(dash),
                    found.value.clone().unwrap_or_else(dash),
                    found.message.clone(),
                ]);
            }
            table.write(&mut out, is_coloured())?;
        }
        for unchecked in &report.unchecked {
            crate::report::warn(&harmless(&format!("not checked: {unchecked}")));
        }
        if report.conforms && !json {
            writeln!(out, "{}", conclusion(&report.unchecked))?;
        }
        told(report.conforms)
    })
}

/// Returns the sentence about a report without violations.
fn conclusion(unchecked: &[String]) -> &'static str {
    match unchecked {
        [] => "the knowledge conforms to its shapes",
        _ => "no violation was found, but parts of the shapes were not checked",
    }
}

/// Returns the end of a check after its violations were printed.
fn told(conforms: bool) -> Result<(), CommandFailure> {
    if conforms {
        Ok(())
    } else {
        Err(CommandFailure::Told)
    }
}

/// Sends a change. Returns the response, which is no refusal.
pub(crate) fn change(
    method: &'static str,
    path: &str,
    (content_type, body): (&'static str, Vec<u8>),
    at: &SourceAt,
) -> Result<HttpResponse, CommandFailure> {
    let server = HttpServer::parse(&at.mes.url)?;
    let user = match (&at.user, &at.password) {
        (Some(user), Some(password)) => Some((user.clone(), password.clone())),
        (None, None) => None,
        _ => {
            let why = "give --user and the variable UA_PASSWORD together";
            return Err(CommandFailure::Usage(why.to_owned()));
        }
    };
    let change = ChangeRequest {
        method,
        content_type,
        body,
        user,
    };
    look(async {
        let answer = server.change(path, change).await?;
        match answer.status {
            200..=299 => Ok(answer),
            _ => Err(refusal(&answer)),
        }
    })
}

/// Returns the kind of a source by the name and the contents of its file.
fn kind_of(file: &str, contents: &[u8]) -> Result<&'static str, CommandFailure> {
    supervisor::source_kind(file, contents).ok_or_else(|| {
        CommandFailure::Usage(format!(
            "{file}: give its --kind: file (Turtle), nodeset, mtp, process (Turtle, or a recipe) or \
             product (STEP)"
        ))
    })
}

/// Returns the findings about a source.
pub(crate) fn findings(mes: &MesAt, kind: &str, name: &str) -> Result<Vec<String>, CommandFailure> {
    let server = HttpServer::parse(&mes.url)?;
    look(async {
        let answer = server.get("/sources").await?;
        if answer.status != 200 {
            return Err(refusal(&answer));
        }
        let all: Sources = serde_json::from_str(&answer.body)
            .map_err(|error| CommandFailure::Data(format!("cannot read the response: {error}")))?;
        let findings = all.findings.into_iter();
        let of_source = findings.filter(|found| found.kind == kind && found.source == name);
        Ok(of_source.map(|found| found.what).collect())
    })
}

pub(crate) fn plain_name(file: &str) -> Result<String, CommandFailure> {
    let name = Path::new(file).file_name().and_then(|name| name.to_str());
    name.map(str::to_owned)
        .ok_or_else(|| CommandFailure::Usage(format!("{file}: give the source a name with --as")))
}

pub(crate) const CREATED: u16 = 201;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_a_whole_check_is_full_conformity() {
        assert_eq!(conclusion(&[]), "the knowledge conforms to its shapes");
        let unchecked = ["<urn:s>: sh:not is not supported here".to_owned()];
        assert!(conclusion(&unchecked).contains("were not checked"));
        assert!(told(true).is_ok());
        assert!(matches!(told(false), Err(CommandFailure::Told)));
    }
}
