//! `ua-space mtp`: reads manifests of process modules (MTP).

use std::collections::BTreeMap;
use std::io::{self, Write as _};
use std::path::Path;

use mtp::{Family, Module, MtpFinding, Object, Triple};
use serde::Serialize;

use crate::arguments::{MtpArguments, MtpRdf, MtpSkills, MtpVerb};
use crate::exit::CommandFailure;
use crate::live::{TextTable, harmless, is_coloured, json};
use crate::manifest::read;

/// Runs `ua-space mtp`.
pub(crate) fn mtp(arguments: &MtpArguments) -> Result<(), CommandFailure> {
    match &arguments.verb {
        MtpVerb::Check(arguments) => check(&arguments.files, arguments.json),
        MtpVerb::Rdf(arguments) => rdf(arguments),
        MtpVerb::Skills(arguments) => skills(arguments),
        MtpVerb::Picture(arguments) => crate::mtp_picture::picture(arguments),
        MtpVerb::Alarms(arguments) => crate::mtp_alarms::alarms(arguments),
        MtpVerb::Connect(arguments) => crate::mtp_connect::connect(arguments),
        MtpVerb::Run(arguments) => crate::mtp_run::run(arguments),
    }
}

/// The contents of a manifest, by their numbers.
#[derive(Debug, Serialize)]
struct Checked<'m> {
    file: &'m str,
    module: &'m str,
    version: &'m str,
    edition: &'static str,
    endpoints: &'m [String],
    services: usize,
    procedures: usize,
    parameters: usize,
    outputs: usize,
    process_values: usize,
    sensors: usize,
    actuators: usize,
    data_assemblies: usize,
    servers: usize,
    nodes: usize,
    alarms: usize,
    pictures: usize,
    picture_objects: usize,
    picture_connections: usize,
    findings: Vec<FindingRow<'m>>,
}

#[derive(Debug, Serialize)]
struct FindingRow<'m> {
    line: usize,
    severity: &'static str,
    element: &'m str,
    message: &'m str,
}

impl<'m> Checked<'m> {
    fn of(file: &'m str, module: &'m Module) -> Self {
        let procedures = || module.services.iter().flat_map(|one| &one.procedures);
        let of_procedures = procedures().map(|one| one.parameters.len()).sum::<usize>();
        let of_services = module.services.iter().map(|one| one.parameters.len());
        let outputs = procedures().map(|one| one.outputs.len()).sum::<usize>();
        let outputs_of_services = module.services.iter().map(|one| one.outputs.len());
        let family = |family| {
            let all = module.assemblies.iter();
            all.filter(|assembly| assembly.family == family).count()
        };
        Self {
            file,
            module: &module.name,
            version: &module.version,
            edition: edition(module),
            endpoints: &module.endpoints,
            services: module.services.len(),
            procedures: procedures().count(),
            parameters: of_procedures + of_services.sum::<usize>(),
            outputs: outputs + outputs_of_services.sum::<usize>(),
            process_values: module.process_values.len(),
            sensors: family(Family::Sensor),
            actuators: family(Family::Actuator),
            data_assemblies: module.assemblies.len(),
            servers: module.servers.len(),
            nodes: module.items.len(),
            alarms: module.alarms.len(),
            pictures: module.pictures.len(),
            picture_objects: module.pictures.iter().map(|one| one.objects.len()).sum(),
            picture_connections: module
                .pictures
                .iter()
                .map(|one| one.connections.len())
                .sum(),
            findings: module.findings.iter().map(FindingRow::of).collect(),
        }
    }
}

impl<'m> FindingRow<'m> {
    fn of(finding: &'m MtpFinding) -> Self {
        Self {
            line: finding.line,
            severity: severity(finding),
            element: &finding.about,
            message: &finding.what,
        }
    }
}

fn severity(finding: &MtpFinding) -> &'static str {
    if finding.is_note { "note" } else { "error" }
}

fn edition(module: &Module) -> &'static str {
    match module.edition {
        mtp::Edition::V1 => "1",
        mtp::Edition::V2 => "2.0",
    }
}

fn check(files: &[String], is_json: bool) -> Result<(), CommandFailure> {
    let mut out = io::stdout().lock();
    let mut faults = Vec::new();
    for file in files {
        let module = match read(file) {
            Ok(module) => module,
            Err(failure) if files.len() > 1 => {
                faults.push(failure.to_string());
                continue;
            }
            Err(failure) => return Err(failure),
        };
        let checked = Checked::of(file, &module);
        if is_json {
            writeln!(out, "{}", json(&checked)?)?;
        } else {
            for finding in &module.findings {
                let line = format!("{}: {file}: {finding}", severity(finding));
                writeln!(out, "{}", harmless(&line))?;
            }
            let line = format!(
                "{file}: {} (MTP {}): {} services, {} procedures, {} parameters, {} outputs, \
                 {} sensors, {} actuators, {} servers, {} nodes, {} pictures with {} objects and \
                 {} connections",
                module.name,
                checked.edition,
                checked.services,
                checked.procedures,
                checked.parameters,
                checked.outputs,
                checked.sensors,
                checked.actuators,
                checked.servers,
                checked.nodes,
                checked.pictures,
                checked.picture_objects,
                checked.picture_connections
            );
            writeln!(out, "{}", harmless(&line))?;
        }
        let errors = module.findings.iter().filter(|one| !one.is_note).count();
        if errors > 0 {
            faults.push(format!("{file}: {errors} errors"));
        }
    }
    match faults.is_empty() {
        true => Ok(()),
        false => Err(CommandFailure::Data(faults.join("\n"))),
    }
}

/// A statement in JSON.
#[derive(Debug, Serialize)]
struct Statement<'t> {
    subject: &'t str,
    predicate: &'t str,
    object: Term<'t>,
}

/// A term in the form of the SPARQL results format.
#[derive(Debug, Serialize)]
struct Term<'t> {
    #[serde(rename = "type")]
    kind: &'static str,
    value: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    datatype: Option<&'t str>,
}

fn rdf(arguments: &MtpRdf) -> Result<(), CommandFailure> {
    let module = read(&arguments.file)?;
    let name = match Path::new(&arguments.file).file_stem() {
        Some(stem) if arguments.file != "-" => stem.to_string_lossy().into_owned(),
        _ => module.name.clone(),
    };
    let base = match &arguments.base {
        Some(base) => base.clone(),
        None => format!("urn:ua-bridge:mtp:{}", mtp::escaped(&name)),
    };
    let triples = module.triples(&base, &BTreeMap::new());
    let mut out = io::BufWriter::new(io::stdout().lock());
    if arguments.json {
        let statements: Vec<Statement<'_>> = triples.iter().map(statement).collect();
        writeln!(out, "{}", json(&statements)?)?;
    } else {
        for triple in &triples {
            writeln!(out, "{triple}")?;
        }
    }
    out.flush()?;
    Ok(())
}

fn statement(triple: &Triple) -> Statement<'_> {
    let literal = |value: String, datatype| Term {
        kind: "literal",
        value,
        datatype,
    };
    let object = match &triple.object {
        Object::Iri(iri) => Term {
            kind: "uri",
            value: iri.clone(),
            datatype: None,
        },
        Object::Text(text) => literal(text.clone(), None),
        other @ (Object::Integer(_) | Object::Number(_) | Object::Boolean(_) | Object::Time(_)) => {
            literal(other.lexical(), other.datatype())
        }
    };
    Statement {
        subject: &triple.subject,
        predicate: &triple.predicate,
        object,
    }
}

/// A procedure as a skill.
#[derive(Debug, Serialize)]
struct SkillRow {
    skill: String,
    service: String,
    procedure: String,
    number: u32,
    is_default: bool,
    is_self_completing: bool,
    state_node: Option<String>,
    command_node: Option<String>,
    parameters: Vec<VariableRow>,
    outputs: Vec<VariableRow>,
    required_equipment: Vec<String>,
}

#[derive(Debug, Serialize)]
struct VariableRow {
    name: String,
    kind: &'static str,
    #[serde(rename = "type")]
    data_type: &'static str,
    min: Option<f64>,
    max: Option<f64>,
    unit: Option<String>,
    node: Option<String>,
    access: Option<&'static str>,
}

fn skills(arguments: &MtpSkills) -> Result<(), CommandFailure> {
    let module = read(&arguments.file)?;
    let rows: Vec<SkillRow> = module
        .services
        .iter()
        .flat_map(|service| {
            let procedures = service.procedures.iter();
            procedures.map(|procedure| skill_row(&module, service, procedure))
        })
        .collect();
    let mut out = io::stdout().lock();
    if arguments.json {
        writeln!(out, "{}", json(&rows)?)?;
        return Ok(());
    }
    let columns = ["SKILL", "NUMBER", "ENDS", "PARAMETERS", "OUTPUTS"];
    let mut table = TextTable::new(columns.map(str::to_owned));
    for row in rows {
        let all = |rows: &[VariableRow]| {
            let shown: Vec<String> = rows.iter().map(VariableRow::shown).collect();
            shown.join(", ")
        };
        let ends = match row.is_self_completing {
            true => "by itself",
            false => "at Complete",
        };
        table.row([
            row.skill,
            row.number.to_string(),
            ends.to_owned(),
            all(&row.parameters),
            all(&row.outputs),
        ]);
    }
    table.write(&mut out, is_coloured())?;
    Ok(())
}

impl VariableRow {
    fn shown(&self) -> String {
        let limits = match (self.min, self.max) {
            (None, None) => String::new(),
            (min, max) => {
                let limit =
                    |limit: Option<f64>| limit.map_or_else(String::new, |one| one.to_string());
                format!(" [{}..{}]", limit(min), limit(max))
            }
        };
        let unit = self.unit.as_ref().map(|unit| format!(" {unit}"));
        format!(
            "{}: {}{limits}{}",
            self.name,
            self.data_type,
            unit.unwrap_or_default()
        )
    }
}

fn skill_row(module: &Module, service: &mtp::MtpService, procedure: &mtp::Procedure) -> SkillRow {
    let node = |role| service.control.node(role).map(mtp::OpcUaNode::id);
    let parameters = procedure.parameters.iter().chain(&service.parameters);
    let parameters = parameters.map(|parameter| VariableRow {
        name: parameter.name.clone(),
        kind: match parameter.is_configuration {
            true => "configuration",
            false => "procedure",
        },
        data_type: parameter.kind.data_type(),
        min: constant(parameter.min.as_ref()),
        max: constant(parameter.max.as_ref()),
        unit: unit(parameter.unit.as_ref()),
        node: parameter.write.as_ref().map(mtp::OpcUaNode::id),
        access: parameter.write.as_ref().map(|node| node.access.name()),
    });
    let outputs = procedure.outputs.iter().chain(&service.outputs);
    let outputs = outputs.map(|output| VariableRow {
        name: output.name.clone(),
        kind: match output.role {
            mtp::OutputRole::Report => "report",
            mtp::OutputRole::ProcessValueOut => "process value",
            mtp::OutputRole::ProcessValueIn => "process value from another module",
        },
        data_type: output.kind.data_type(),
        min: constant(output.min.as_ref()),
        max: constant(output.max.as_ref()),
        unit: unit(output.unit.as_ref()),
        node: output.node.as_ref().map(mtp::OpcUaNode::id),
        access: output.node.as_ref().map(|node| node.access.name()),
    });
    let equipment = service.equipment.iter().chain(&procedure.equipment);
    let equipment = equipment.map(|id| {
        let mut assemblies = module.assemblies.iter();
        let found = assemblies.find(|assembly| assembly.id == *id);
        found.map_or_else(|| id.clone(), |assembly| assembly.name.clone())
    });
    SkillRow {
        skill: format!("{}/{}", service.name, procedure.name),
        service: service.name.clone(),
        procedure: procedure.name.clone(),
        number: procedure.number,
        is_default: procedure.is_default,
        is_self_completing: procedure.is_self_completing,
        state_node: node(mtp::ControlRole::State),
        command_node: node(mtp::ControlRole::Command),
        parameters: parameters.collect(),
        outputs: outputs.collect(),
        required_equipment: equipment.collect(),
    }
}

fn constant(bound: Option<&mtp::ValueBound>) -> Option<f64> {
    bound.and_then(mtp::ValueBound::constant)
}

fn unit(bound: Option<&mtp::ValueBound>) -> Option<String> {
    let code = constant(bound)?;
    let symbol = mtp::unit_symbol(code);
    Some(symbol.map_or_else(|| format!("unit {code}"), str::to_owned))
}
