//! `ua-space doctor`: looks for the usual faults of a cell, and says what to do.
//!
//! Reading order: this module (the verb), `facts` (what is read and measured), `findings` (pure
//! functions from facts to findings), `bundle` (the file for a report).

mod bundle;
mod facts;
mod findings;
mod host;
mod ros;

use std::fs;
use std::io::{self, Write as _};
use std::os::unix::fs::OpenOptionsExt as _;
use std::path::Path;

use serde::Serialize;

use crate::arguments::Doctor;
use crate::exit::CommandFailure;
use crate::live::{harmless, is_coloured, json, wrapped};
use crate::report::warn;
use crate::survey::look;
use facts::CellFacts;
use findings::{DoctorFinding, DoctorSeverity, Fix};

/// Runs `ua-space doctor`.
pub(crate) fn doctor(arguments: &Doctor) -> Result<(), CommandFailure> {
    let facts = look(async { Ok(Box::pin(facts::gather(arguments)).await) })?;
    let findings = findings::of(&facts);
    let mut out = io::stdout().lock();
    if arguments.json {
        let shown = DiagnosisJson {
            findings: &findings,
            facts: &facts,
        };
        writeln!(out, "{}", json(&shown)?)?;
    } else {
        tell(&facts, &findings, &mut out)?;
    }
    if let Some(path) = &arguments.bundle {
        let packed = bundle::pack(&facts, &findings);
        // The log and the rules of the firewall are not for all users.
        let mut open = fs::OpenOptions::new();
        open.write(true).create(true).truncate(true).mode(0o600);
        open.open(path)
            .and_then(|mut file| file.write_all(&packed))
            .map_err(|error| {
                CommandFailure::Io(format!("cannot write {}: {error}", path.display()))
            })?;
        if !arguments.json {
            writeln!(out, "the report is in {}", path.display())?;
        }
    }
    out.flush()?;
    if arguments.fix {
        repair(&findings, Path::new("/"));
    }
    let count = |severity| {
        findings
            .iter()
            .filter(|one| one.severity == severity)
            .count()
    };
    match (count(DoctorSeverity::Error), count(DoctorSeverity::Warning)) {
        (0, 0) => Ok(()),
        (errors, warnings) => Err(CommandFailure::Failed(format!(
            "found {errors} {} and {warnings} {}",
            plural(errors, "error"),
            plural(warnings, "warning")
        ))),
    }
}

#[derive(Serialize)]
struct DiagnosisJson<'a> {
    findings: &'a [DoctorFinding],
    facts: &'a CellFacts,
}

fn plural(count: usize, word: &str) -> String {
    match count {
        1 => word.to_owned(),
        _ => format!("{word}s"),
    }
}

fn tell(
    facts: &CellFacts,
    findings: &[DoctorFinding],
    out: &mut impl io::Write,
) -> Result<(), CommandFailure> {
    let is_coloured = is_coloured();
    for one in findings {
        let (word, colour) = match one.severity {
            DoctorSeverity::Error => ("error", "31"),
            DoctorSeverity::Warning => ("warning", "33"),
            DoctorSeverity::Note => ("note", "36"),
        };
        let head = format!("{word} {}: ", one.code);
        let text = wrapped(&head, &harmless(&one.what));
        match (is_coloured, text.strip_prefix(&head)) {
            (true, Some(rest)) => write!(out, "\x1b[1;{colour}m{head}\x1b[0m{rest}")?,
            _ => write!(out, "{text}")?,
        }
        write!(out, "{}", wrapped("    why: ", &harmless(&one.why)))?;
        write!(out, "{}", wrapped("    do:  ", &harmless(&one.remedy)))?;
        if one.fix.is_some() {
            write!(
                out,
                "{}",
                wrapped("         ", "`ua-space doctor --fix` does it")
            )?;
        }
    }
    let looked = format!(
        "{} programs on this host, {} with a status, {} announced in {}, {} topics",
        facts.host.processes.len(),
        facts.pages.len(),
        facts.group.applications.len(),
        facts.group.address,
        facts.group.topics.len()
    );
    if findings.is_empty() {
        writeln!(out, "no faults found")?;
    }
    write!(out, "{}", wrapped("looked at: ", &looked))?;
    Ok(())
}

/// Writes the settings of the safe repairs, which last until the host restarts.
fn repair(findings: &[DoctorFinding], root: &Path) {
    for fix in findings.iter().filter_map(|one| one.fix.as_ref()) {
        let Fix { path, value } = fix;
        let target = root.join(path.trim_start_matches('/'));
        match fs::write(&target, format!("{value}\n")) {
            Ok(()) => {
                let key = path.trim_start_matches("/proc/sys/").replace('/', ".");
                let lasting = if path.starts_with("/proc/sys/") {
                    format!("; `{key} = {value}` in /etc/sysctl.d keeps it")
                } else {
                    String::new()
                };
                warn(&format!(
                    "{path} is {value} until the host restarts{lasting}"
                ));
            }
            Err(error) => warn(&format!(
                "cannot write {path}: {error}\n  = help: run it as root"
            )),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_repair_writes_the_setting_of_its_finding_only() {
        let root = std::env::temp_dir().join(format!("doctor-fix-{}", std::process::id()));
        let folder = root.join("proc/sys/net/ipv4");
        fs::create_dir_all(&folder).unwrap();
        let path = "/proc/sys/net/ipv4/ipfrag_high_thresh";
        fs::write(folder.join("ipfrag_high_thresh"), "1\n").unwrap();
        let finding = |fix| DoctorFinding {
            code: "D052",
            severity: DoctorSeverity::Warning,
            what: String::new(),
            why: String::new(),
            remedy: String::new(),
            fix,
        };
        let fix = Fix {
            path: path.to_owned(),
            value: 33_554_432,
        };
        repair(&[finding(None), finding(Some(fix))], &root);
        let written = fs::read_to_string(folder.join("ipfrag_high_thresh")).unwrap();
        fs::remove_dir_all(&root).unwrap();
        assert_eq!(written, "33554432\n");
    }
}
