//! `ua-space plan`: shows the components that the MES would choose for a process, with the reasons.

use std::io::{self, Write as _};

use serde::Deserialize;
use uri_text::escaped;

use crate::arguments::PlanArguments;
use crate::ask::{parsed, refusal};
use crate::exit::CommandFailure;
use crate::http::HttpServer;
use crate::live::{TextTable, harmless, is_coloured};
use crate::survey::look;

/// Runs `ua-space plan`.
pub(crate) fn plan(arguments: &PlanArguments) -> Result<(), CommandFailure> {
    let server = HttpServer::parse(&arguments.mes.url)?;
    look(async {
        let status = get(&server, "/status").await?;
        let known: Status = parsed(&status)?;
        let Some(wanted) = &arguments.process else {
            return list(&known.processes, &status, arguments.json);
        };
        let iri = find(&known.processes, wanted)?;
        let body = get(&server, &format!("/plan/{}", escaped(iri))).await?;
        show(&body, arguments.json)
    })
}

async fn get(server: &HttpServer, path: &str) -> Result<String, CommandFailure> {
    let answer = server.get(path).await?;
    match answer.status {
        200 => Ok(answer.body),
        _ => Err(refusal(&answer)),
    }
}

/// The status of the MES, as far as it is needed here.
#[derive(Debug, Deserialize)]
struct Status {
    #[serde(default)]
    processes: Vec<KnownProcess>,
}

/// A process that the MES knows.
#[derive(Debug, Deserialize)]
struct KnownProcess {
    process: String,
    #[serde(default)]
    name: String,
    #[serde(default)]
    steps: Vec<String>,
}

/// The plan of a process.
#[derive(Debug, Deserialize)]
struct Planned {
    process: String,
    complete: bool,
    #[serde(default)]
    missing: String,
    plan: Steps,
}

#[derive(Debug, Deserialize)]
struct Steps {
    steps: Vec<ListedPlanStep>,
}

#[derive(Debug, Deserialize)]
struct ListedPlanStep {
    step: String,
    needs: Vec<Need>,
}

/// A need of a step, and the skills that were considered.
#[derive(Debug, Deserialize)]
struct Need {
    role: String,
    #[serde(default)]
    capability: Option<String>,
    #[serde(default, rename = "type")]
    skill_type: Option<String>,
    candidates: Vec<Candidate>,
}

#[derive(Debug, Deserialize)]
struct Candidate {
    name: String,
    component_name: String,
    chosen: bool,
    why: String,
}

/// Returns the IRI of a process that is given by its IRI, its name or the end of its IRI.
fn find<'a>(known: &'a [KnownProcess], wanted: &str) -> Result<&'a str, CommandFailure> {
    let exact = known.iter().find(|one| one.process == wanted);
    if let Some(one) = exact {
        return Ok(&one.process);
    }
    let is_meant = |one: &&KnownProcess| one.name == wanted || short(&one.process) == wanted;
    let mut meant = known.iter().filter(is_meant);
    match (meant.next(), meant.next()) {
        (Some(one), None) => Ok(&one.process),
        (Some(one), Some(other)) => Err(CommandFailure::Usage(format!(
            "{wanted} is {} and {}: give the IRI",
            harmless(&one.process),
            harmless(&other.process)
        ))),
        (None, _) => {
            let names = known.iter().map(|one| short(&one.process));
            let help = match mappings::nearest(wanted, names) {
                Some(near) => format!("did you mean `{}`?", harmless(near)),
                None => "`ua-space plan` lists the processes".to_owned(),
            };
            let wanted = harmless(wanted);
            Err(CommandFailure::Usage(format!(
                "the MES knows no process {wanted}\n  = help: {help}"
            )))
        }
    }
}

fn list(known: &[KnownProcess], status: &str, is_json: bool) -> Result<(), CommandFailure> {
    let mut out = io::stdout().lock();
    if is_json {
        let status: serde_json::Value = parsed(status)?;
        let processes = status.get("processes").cloned().unwrap_or_default();
        writeln!(out, "{}", mappings::harmless_json(&processes.to_string()))?;
        return Ok(());
    }
    let mut table = TextTable::new(["PROCESS", "NAME", "STEPS"].map(str::to_owned)).yielding([2]);
    for one in known {
        let steps = one.steps.join(", ");
        table.row([one.process.clone(), one.name.clone(), steps]);
    }
    table.write(&mut out, is_coloured())?;
    Ok(())
}

fn show(body: &str, is_json: bool) -> Result<(), CommandFailure> {
    let planned: Planned = parsed(body)?;
    let mut out = io::stdout().lock();
    if is_json {
        writeln!(out, "{}", mappings::harmless_json(body.trim_end()))?;
    } else {
        let columns = ["STEP", "NEEDS", "COMPONENT", "SKILL", "CHOSEN", "REASON"];
        let mut table = TextTable::new(columns.map(str::to_owned)).yielding([5, 1]);
        for row in rows(&planned) {
            table.row(row);
        }
        table.write(&mut out, is_coloured())?;
    }
    if planned.complete {
        Ok(())
    } else {
        Err(CommandFailure::Failed(format!(
            "{} cannot run: {}",
            harmless(&planned.process),
            harmless(&plain(&planned.missing))
        )))
    }
}

/// Returns a row for each skill that was considered. The step and the need are in their first row.
fn rows(planned: &Planned) -> Vec<[String; 6]> {
    let mut rows = Vec::new();
    for step in &planned.plan.steps {
        let mut name = step.step.clone();
        for need in &step.needs {
            let wanted = need.capability.as_deref().or(need.skill_type.as_deref());
            let wanted = wanted.map_or_else(|| need.role.clone(), |iri| short(iri).to_owned());
            let mut wanted = match need.role.as_str() {
                "" | "skill" => wanted,
                role if role == wanted => wanted,
                role => format!("{role}: {wanted}"),
            };
            // The chosen skill is first.
            let mut candidates: Vec<&Candidate> = need.candidates.iter().collect();
            candidates.sort_by_key(|one| !one.chosen);
            if candidates.is_empty() {
                rows.push([
                    std::mem::take(&mut name),
                    std::mem::take(&mut wanted),
                    "-".to_owned(),
                    "-".to_owned(),
                    "-".to_owned(),
                    "no skill provides it".to_owned(),
                ]);
            }
            for one in candidates {
                rows.push([
                    std::mem::take(&mut name),
                    std::mem::take(&mut wanted),
                    one.component_name.clone(),
                    one.name.clone(),
                    if one.chosen { "yes" } else { "no" }.to_owned(),
                    plain(&one.why),
                ]);
            }
        }
    }
    rows
}

/// Replaces the IRIs of a text by their last parts, so that it fits a line.
fn plain(text: &str) -> String {
    let words = text.split(' ').map(|word| {
        let inner = word.trim_end_matches([',', ';', ')']);
        let end = word.get(inner.len()..).unwrap_or_default();
        match inner.strip_prefix("nsu=").and_then(|it| it.split_once(';')) {
            Some((_, name)) => format!("{name}{end}"),
            None if inner.starts_with("urn:") || inner.contains("://") => {
                format!("{}{end}", short(inner))
            }
            None => word.to_owned(),
        }
    });
    words.collect::<Vec<_>>().join(" ")
}

/// Returns the last part of an IRI.
fn short(iri: &str) -> &str {
    iri.rsplit(['#', '/', ':']).next().unwrap_or(iri)
}

#[cfg(test)]
mod tests {
    use super::*;

    const PLAN: &str = r#"{"process": "urn:example:process:move", "complete": false, "missing": "step 2: no skill",
        "plan": {"steps": [
          {"step": "grasp", "needs": [{"role": "skill", "capability": "urn:c#grasp", "type": null, "chosen": "urn:g#Grasp", "candidates": [
            {"skill": "urn:v#Grasp", "name": "Grasp", "component": "urn:v", "component_name": "vacuum", "chosen": false, "why": "a later component"},
            {"skill": "urn:g#Grasp", "name": "Grasp", "component": "urn:g", "component_name": "gripper", "chosen": true, "why": "it realises urn:example:capability:grasp, of nsu=urn:x;GraspSkillType"}]}]},
          {"step": "weigh", "needs": [{"role": "skill", "capability": "urn:c#weigh", "type": null, "chosen": null, "candidates": []}]}]}}"#;

    #[test]
    fn each_considered_skill_has_a_row_with_its_reason() {
        let planned: Planned = serde_json::from_str(PLAN).unwrap();
        let rows: Vec<String> = rows(&planned).iter().map(|row| row.join("|")).collect();
        assert_eq!(
            rows,
            [
                "grasp|grasp|gripper|Grasp|yes|it realises grasp, of GraspSkillType",
                "||vacuum|Grasp|no|a later component",
                "weigh|weigh|-|-|-|no skill provides it",
            ]
        );
    }

    #[test]
    fn a_process_is_found_by_its_iri_its_name_and_the_end_of_its_iri() {
        let known = |process: &str, name: &str| KnownProcess {
            process: process.to_owned(),
            name: name.to_owned(),
            steps: Vec::new(),
        };
        let all = [
            known("urn:a:move-part", "Move a part"),
            known("urn:b:weigh", ""),
            known("urn:c:weigh", ""),
        ];
        for wanted in ["urn:a:move-part", "Move a part", "move-part"] {
            assert_eq!(find(&all, wanted).unwrap(), "urn:a:move-part");
        }
        let refused = |wanted: &str| find(&all, wanted).unwrap_err().to_string();
        assert!(refused("weigh").contains("give the IRI"));
        assert!(refused("mvoe-part").contains("did you mean `move-part`?"));
    }
}
