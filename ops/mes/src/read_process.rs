//! Reads processes from the graph, which decides which processes run.

mod fault;
mod loops;

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use knowledge::{Knowledge, QuestionAnswer, QuestionFault, ValueQuery};
use serde_json::Value;
use skills::ParameterType;

pub(crate) use self::fault::{ProcessFault, StatementFault};
use crate::locate_skill::numbers_of;
use crate::parameter_fault::ParameterFault;
use crate::process::{
    BadEnd, By, Compare, GivenParameter, Loop, MOST_STEPS, Need, ParameterQuery, Process,
    ProcessStep, ResultOf, SkillRole, StepCondition, StepJob, Test,
};

/// The processes of the graph: each can run, or has a reason why it cannot.
#[derive(Debug, Default)]
pub(crate) struct Processes {
    pub(crate) all: Vec<Process>,
    /// The reasons by the IRI of the process.
    pub(crate) faults: BTreeMap<String, ProcessFault>,
}

type Row = BTreeMap<String, Value>;

impl Processes {
    /// Reads all processes.
    pub(crate) fn read(knowledge: &Knowledge) -> Result<Self, QuestionFault> {
        let ask = |question| knowledge.ask(question, &[]);
        let (steps, parameters) = (ask("process-steps")?, ask("process-parameters")?);
        let (conditions, loops) = (ask("process-conditions")?, ask("process-loops")?);
        let mut by_process: BTreeMap<&str, Vec<&Row>> = BTreeMap::new();
        for row in &steps.rows {
            let process = QuestionAnswer::text(row, "process");
            by_process.entry(process).or_default().push(row);
        }
        let mut processes = Self::default();
        for (iri, rows) in by_process {
            let facts = Facts {
                parameters: &parameters.rows,
                conditions: &conditions.rows,
                loops: &loops.rows,
            };
            match process(iri, &rows, facts) {
                Ok(process) => processes.all.push(process),
                Err(why) => drop(processes.faults.insert(iri.to_owned(), why)),
            }
        }
        Ok(processes)
    }
}

/// The rows about the steps of all processes.
#[derive(Debug, Clone, Copy)]
struct Facts<'a> {
    parameters: &'a [Row],
    conditions: &'a [Row],
    loops: &'a [Row],
}

fn process(iri: &str, rows: &[&Row], facts: Facts<'_>) -> Result<Process, ProcessFault> {
    let parameters = facts.parameters;
    let within = seconds(one(rows, "within")?, "ua:within")?.unwrap_or(USUALLY_WITHIN);
    let wait = seconds(one(rows, "wait")?, "ua:wait")?.unwrap_or(USUALLY_WAIT);
    let name = one(rows, "name")?.and_then(Value::as_str);
    let mut by_part: BTreeMap<&str, Vec<&Row>> = BTreeMap::new();
    let mut undone: BTreeMap<&str, Vec<&Row>> = BTreeMap::new();
    for row in rows
        .iter()
        .filter(|row| !QuestionAnswer::text(row, "part").is_empty())
    {
        let part = QuestionAnswer::text(row, "part");
        match QuestionAnswer::text(row, "compensates") {
            "" => by_part.entry(part).or_default().push(row),
            of => undone.entry(of).or_default().push(row),
        }
    }
    if by_part.is_empty() {
        return Err(StatementFault::Missing("ua:hasStep").into());
    }
    if by_part.len() > MOST_STEPS {
        return Err(ProcessFault::TooManySteps);
    }
    let ordered = in_order(by_part)?;
    let job = job(rows)?;
    let order: Vec<&str> = ordered.iter().map(|(_, part, _)| *part).collect();
    let mut steps = Vec::new();
    for (number, (_, part, rows)) in ordered.iter().enumerate() {
        let role = job.is_none().then_some(SkillRole::Alone(number));
        let read = step(part, rows, role, (&order, number), parameters);
        let mut read = read.map_err(ProcessFault::of("step", part))?;
        let ordered = order_of(&mut read, rows, iri, (&order, number))
            .and_then(|()| conditions_of(part, (&order, number), facts.conditions))
            .map(|when| read.when = when);
        ordered.map_err(ProcessFault::of("step", part))?;
        let is_plain = read.after.is_none() && read.when.is_empty() && read.within.is_none();
        if job.is_some() && !is_plain {
            return Err(ProcessFault::of("step", part)(
                StatementFault::NotInPickAndPlace {
                    has: "an order, a condition or a time limit",
                    instead: "has its own",
                },
            ));
        }
        if let Some(rows) = undone.get(part) {
            let role = SkillRole::Alone(order.len().saturating_add(number));
            let undone = compensation(&read.name, rows, role, (&order, number), parameters);
            let undone = undone.map_err(ProcessFault::of("compensation of", part))?;
            if job.is_some() {
                return Err(ProcessFault::of("step", part)(
                    StatementFault::NotInPickAndPlace {
                        has: "a ua:compensatedBy",
                        instead: "retreats by itself",
                    },
                ));
            }
            read.compensation = Some(Box::new(undone));
        }
        steps.push(read);
    }
    let loops = loops::loops_of(iri, (&order, &steps), (facts.loops, facts.conditions))?;
    if job.is_some() {
        is_composite(&steps, &loops)?;
    }
    Ok(Process {
        iri: iri.to_owned(),
        name: name.unwrap_or(iri).to_owned(),
        work: job.map_or(StepJob::Sequence, StepJob::PickAndPlace),
        steps,
        loops,
        within,
        wait,
    })
}

/// Checks that a pick-and-place process has all roles, and no loop.
fn is_composite(steps: &[ProcessStep], loops: &[Loop]) -> Result<(), ProcessFault> {
    if !loops.is_empty() {
        let fault = StatementFault::NotInPickAndPlace {
            has: "a ua:hasLoop",
            instead: "has none",
        };
        return Err(fault.into());
    }
    let has = |role: &SkillRole| {
        let mut needs = steps.iter().flat_map(|step| &step.needs);
        needs.any(|need| need.role == *role)
    };
    match SkillRole::OF_COMPOSITE.iter().find(|role| !has(role)) {
        None => Ok(()),
        Some(role) => Err(ProcessFault::NoRole(role.name())),
    }
}

/// The position of a step, its IRI and its rows.
type Positioned<'a> = (i64, &'a str, Vec<&'a Row>);

/// Returns the steps with their rows, in the order of their positions.
fn in_order<'a>(
    by_part: BTreeMap<&'a str, Vec<&'a Row>>,
) -> Result<Vec<Positioned<'a>>, ProcessFault> {
    let mut ordered: Vec<Positioned<'_>> = Vec::new();
    for (part, rows) in by_part {
        let missing = StatementFault::Missing("number as its ua:position");
        let position = one(&rows, "position")
            .and_then(|value| value.and_then(Value::as_i64).ok_or(missing))
            .map_err(ProcessFault::of("step", part))?;
        ordered.push((position, part, rows));
    }
    ordered.sort_by_key(|(position, ..)| *position);
    if let Some([(position, one, _), (_, other, _)]) = ordered
        .windows(2)
        .find_map(|pair| <&[_; 2]>::try_from(pair).ok().filter(|[a, b]| a.0 == b.0))
    {
        return Err(ProcessFault::SamePosition {
            one: (*one).to_owned(),
            other: (*other).to_owned(),
            position: *position,
        });
    }
    Ok(ordered)
}

/// Reads the order and the time limit of a step.
fn order_of(
    step: &mut ProcessStep,
    rows: &[&Row],
    process: &str,
    (order, number): (&[&str], usize),
) -> Result<(), StatementFault> {
    step.within = seconds(one(rows, "limit")?, "ua:within")?;
    let named = rows.iter().map(|row| QuestionAnswer::text(row, "after"));
    let named: BTreeSet<&str> = named.filter(|after| !after.is_empty()).collect();
    if named.is_empty() {
        return Ok(());
    }
    let mut after = Vec::new();
    for other in named.into_iter().filter(|other| *other != process) {
        after.push(earlier(other, (order, number))?);
    }
    after.sort_unstable();
    step.after = Some(after);
    Ok(())
}

/// Returns the number of a step that comes before the step with a number.
fn earlier(other: &str, (order, number): (&[&str], usize)) -> Result<usize, StatementFault> {
    let step = order.iter().position(|known| *known == other);
    step.filter(|step| *step < number)
        .ok_or_else(|| StatementFault::NotEarlier(other.to_owned()))
}

/// Reads the alternatives of a step, of which one must hold.
fn conditions_of(
    part: &str,
    place: (&[&str], usize),
    rows: &[Row],
) -> Result<Vec<Vec<StepCondition>>, StatementFault> {
    let mut alternatives: BTreeMap<&str, Vec<&Row>> = BTreeMap::new();
    for row in rows
        .iter()
        .filter(|row| QuestionAnswer::text(row, "part") == part)
    {
        let of = QuestionAnswer::text(row, "alternative");
        alternatives.entry(of).or_default().push(row);
    }
    let mut all = Vec::new();
    for (iri, rows) in alternatives {
        let mut conditions: Vec<(i64, StepCondition)> = Vec::new();
        for row in rows {
            if QuestionAnswer::text(row, "condition").is_empty() {
                return Err(StatementFault::NoCondition(iri.to_owned()));
            }
            let position = row.get("position").and_then(Value::as_i64);
            let read = condition(row, place);
            conditions.push((
                position.unwrap_or_default(),
                read.map_err(|fault| StatementFault::Condition(Box::new(fault)))?,
            ));
        }
        conditions.sort_by_key(|(position, _)| *position);
        all.push(conditions.into_iter().map(|(_, read)| read).collect());
    }
    Ok(all)
}

fn condition(row: &Row, place: (&[&str], usize)) -> Result<StepCondition, StatementFault> {
    let is_there = |column: &str| row.get(column).filter(|value| !value.is_null());
    let step = earlier(QuestionAnswer::text(row, "of"), place)?;
    let test = match (is_there("result"), is_there("ends_as")) {
        (Some(name), None) => {
            let sign = QuestionAnswer::text(row, "compare");
            let compare = Compare::ALL.iter().find(|(_, known)| *known == sign);
            let compare = compare.ok_or_else(|| StatementFault::Compare(sign.to_owned()))?;
            let value = match (is_there("value"), is_there("json")) {
                (Some(value), None) => value.clone(),
                (None, Some(json)) => serde_json::from_str(json.as_str().unwrap_or_default())
                    .map_err(|error| StatementFault::ConditionJson(error.to_string()))?,
                _ => return Err(StatementFault::ConditionValue),
            };
            Test::Result {
                name: name.as_str().unwrap_or_default().to_owned(),
                compare: compare.0,
                value,
            }
        }
        (None, Some(end)) => {
            let all = [BadEnd::Failed, BadEnd::TimedOut];
            let known = all
                .into_iter()
                .find(|known| Some(known.name()) == end.as_str());
            Test::Ended(known.ok_or_else(|| StatementFault::EndsAs(end.clone()))?)
        }
        _ => return Err(StatementFault::NoTest),
    };
    Ok(StepCondition {
        step,
        test,
        is_negated: is_there("negated").and_then(Value::as_bool) == Some(true),
    })
}

fn job(rows: &[&Row]) -> Result<Option<skills::Job>, ProcessFault> {
    let position = |column: &'static str| {
        let Some(value) = one(rows, column)? else {
            return Ok(None);
        };
        let text = value.as_str().unwrap_or_default();
        let numbers = numbers_of(text, 6);
        let position = numbers.and_then(|numbers| numbers.try_into().ok());
        position.map(Some).ok_or(ProcessFault::NoPosition(column))
    };
    let (Some(pick), Some(place)) = (position("pick")?, position("place")?) else {
        return Ok(None);
    };
    let approach = match one(rows, "approach")? {
        None => USUALLY_APPROACH,
        Some(value) => value
            .as_f64()
            .filter(|approach| (0.0..=10.0).contains(approach))
            .ok_or_else(|| ProcessFault::Approach(value.clone()))?,
    };
    Ok(Some(skills::Job {
        pick,
        place,
        approach,
        shape: shape(rows)?,
    }))
}

fn shape(rows: &[&Row]) -> Result<Option<skills::PartShape>, ProcessFault> {
    let Some(value) = one(rows, "shape")? else {
        return Ok(None);
    };
    let text = value.as_str().unwrap_or_default();
    let shape = text.parse::<skills::PartShape>();
    shape.map(Some).map_err(|fault| ProcessFault::Shape {
        shape: text.to_owned(),
        fault,
    })
}

fn step(
    part: &str,
    rows: &[&Row],
    role: Option<SkillRole>,
    (order, number): (&[&str], usize),
    parameters: &[Row],
) -> Result<ProcessStep, StatementFault> {
    let name = one(rows, "step")?.and_then(Value::as_str).unwrap_or(part);
    let with = one(rows, "with")?.and_then(Value::as_str);
    let is_attached = one(rows, "attached")?.and_then(Value::as_bool) == Some(true);
    let by = match with {
        Some(_) if is_attached => return Err(StatementFault::TwoComponents),
        Some(with) => By::SameAs(earlier(with, (order, number))?),
        None if is_attached => By::AttachedTool,
        None => By::Any,
    };
    let mut by_need: BTreeMap<&str, Vec<&Row>> = BTreeMap::new();
    for row in rows
        .iter()
        .filter(|row| !QuestionAnswer::text(row, "need").is_empty())
    {
        let need = QuestionAnswer::text(row, "need");
        by_need.entry(need).or_default().push(row);
    }
    if by_need.is_empty() {
        return Err(StatementFault::Missing("css:requiresCapability"));
    }
    if role.is_some() && by_need.len() > 1 {
        return Err(StatementFault::SeveralSkills);
    }
    let needs = by_need.values().map(|rows| need(rows, role));
    let needs = needs.collect::<Result<_, _>>()?;
    let given = parameters_of(part, (order, number), parameters)?;
    Ok(ProcessStep {
        name: name.to_owned(),
        needs,
        parameters: given,
        by,
        ..ProcessStep::default()
    })
}

/// Reads the compensation of the step with a number. The component of the step does it, unless it
/// says otherwise.
fn compensation(
    of: &str,
    rows: &[&Row],
    role: SkillRole,
    (order, number): (&[&str], usize),
    parameters: &[Row],
) -> Result<ProcessStep, StatementFault> {
    let mut parts = rows.iter().map(|row| QuestionAnswer::text(row, "part"));
    let part = parts.next().unwrap_or_default();
    if parts.any(|other| other != part) {
        return Err(StatementFault::Twice);
    }
    let next = number.saturating_add(1);
    let mut read = step(part, rows, Some(role), (order, next), parameters)?;
    match read.by {
        By::Any => read.by = By::SameAs(number),
        By::SameAs(_) => {}
        By::AttachedTool => return Err(StatementFault::UndoneByTool),
    }
    if one(rows, "step")?.is_none() {
        read.name = format!("compensation of {of}");
    }
    Ok(read)
}

fn need(rows: &[&Row], role: Option<SkillRole>) -> Result<Need, StatementFault> {
    let role = match (role, one(rows, "role")?.and_then(Value::as_str)) {
        (Some(role), _) => role,
        (None, named) => {
            let known = SkillRole::OF_COMPOSITE.into_iter();
            let mut known = known.filter(|role| Some(role.name()) == named);
            known.next().ok_or(StatementFault::Role)?
        }
    };
    let capability = one(rows, "capability")?.and_then(Value::as_str);
    let skill_type = match one(rows, "type")? {
        None => role.skill_type(),
        Some(of) => {
            let name = one(rows, "type_name")?.and_then(Value::as_str);
            let namespace = one(rows, "type_namespace")?.and_then(Value::as_str);
            match (name, namespace) {
                (Some(name), Some(namespace)) => Some(ParameterType {
                    namespace: namespace.to_owned(),
                    name: name.to_owned(),
                }),
                _ => return Err(StatementFault::UnknownType(of.clone())),
            }
        }
    };
    if capability.is_none() && skill_type.is_none() {
        return Err(StatementFault::EmptyNeed);
    }
    Ok(Need {
        role,
        capability: capability.map(str::to_owned),
        skill_type,
    })
}

/// Reads the parameters of a step, which has a number among the steps, or of an action.
pub(crate) fn parameters_of(
    part: &str,
    (order, number): (&[&str], usize),
    parameters: &[Row],
) -> Result<Vec<GivenParameter>, StatementFault> {
    let mut given: Vec<GivenParameter> = Vec::new();
    for row in parameters
        .iter()
        .filter(|row| QuestionAnswer::text(row, "part") == part)
    {
        let parameter = given_by(row, (order, number))?;
        if given.iter().any(|known| known.name == parameter.name) {
            return Err(StatementFault::ParameterTwice(parameter.name));
        }
        given.push(parameter);
    }
    Ok(given)
}

/// Reads a parameter of the step with a number.
fn given_by(
    row: &Row,
    (order, number): (&[&str], usize),
) -> Result<GivenParameter, StatementFault> {
    let name = QuestionAnswer::text(row, "name");
    if name.is_empty() {
        return Err(StatementFault::NamelessParameter);
    }
    let is_there = |column: &str| row.get(column).filter(|value| !value.is_null());
    let unit = is_there("unit").and_then(Value::as_str).map(str::to_owned);
    let mut given = GivenParameter {
        name: name.to_owned(),
        value: Value::Null,
        unit,
        result: None,
        query: None,
    };
    if let Some(sparql) = is_there("query") {
        let columns = ["value", "json", "result_of"];
        if columns.into_iter().any(|column| is_there(column).is_some()) {
            return Err(StatementFault::QueryAndValue(name.to_owned()));
        }
        let query_name = is_there("query_name").and_then(Value::as_str);
        given.query = Some(ParameterQuery {
            name: query_name.unwrap_or(name).to_owned(),
            sparql: sparql.as_str().unwrap_or_default().to_owned(),
        });
        return readable(given).map_err(StatementFault::Parameter);
    }
    match (is_there("value"), is_there("json"), is_there("result_of")) {
        (Some(value), None, None) => given.value = value.clone(),
        (None, Some(json), None) => {
            given.value =
                serde_json::from_str(json.as_str().unwrap_or_default()).map_err(|error| {
                    StatementFault::ParameterJson {
                        name: name.to_owned(),
                        error: error.to_string(),
                    }
                })?;
        }
        (None, None, Some(of)) => {
            if given.unit.is_some() {
                return Err(StatementFault::UnitOfResult(name.to_owned()));
            }
            let of = of.as_str().unwrap_or_default();
            let step = earlier(of, (order, number));
            let result = is_there("result").and_then(Value::as_str).unwrap_or(name);
            given.result = Some(ResultOf {
                step: step.map_err(|_not_earlier| StatementFault::ResultNotEarlier {
                    name: name.to_owned(),
                    step: of.to_owned(),
                })?,
                name: result.to_owned(),
            });
        }
        _ => return Err(StatementFault::ParameterValue(name.to_owned())),
    }
    Ok(given)
}

/// Checks that the query of a parameter can be read.
///
/// # Errors
/// The reason, with the names of the parameter and of the query.
pub(crate) fn readable(given: GivenParameter) -> Result<GivenParameter, ParameterFault> {
    let read = given
        .query
        .as_ref()
        .map(|query| ValueQuery::read(&query.sparql));
    match read {
        Some(Err(fault)) => Err(ParameterFault::Given(given.shown(), fault.into())),
        Some(Ok(_)) | None => Ok(given),
    }
}

/// Returns the value of a column, which must be the same in all rows that have it.
fn one<'a>(rows: &[&'a Row], column: &str) -> Result<Option<&'a Value>, StatementFault> {
    let values = rows.iter().filter_map(|row| row.get(column));
    let mut values = values.filter(|value| !value.is_null());
    let Some(first) = values.next() else {
        return Ok(None);
    };
    match values.find(|value| *value != first) {
        None => Ok(Some(first)),
        Some(other) => Err(StatementFault::TwoValues {
            column: column.to_owned(),
            first: first.clone(),
            other: other.clone(),
        }),
    }
}

pub(crate) fn seconds(
    value: Option<&Value>,
    name: &str,
) -> Result<Option<Duration>, StatementFault> {
    let Some(value) = value else {
        return Ok(None);
    };
    let seconds = value.as_f64().filter(|seconds| *seconds <= LONGEST);
    let time = seconds.and_then(|seconds| Duration::try_from_secs_f64(seconds).ok());
    time.map(Some).ok_or_else(|| StatementFault::NoTime {
        name: name.to_owned(),
        value: value.clone(),
    })
}

pub(crate) const USUALLY_WITHIN: Duration = Duration::from_secs(30);
pub(crate) const USUALLY_WAIT: Duration = Duration::from_secs(60);
pub(crate) const USUALLY_APPROACH: f64 = 0.05;
/// Longest time of a process in seconds.
const LONGEST: f64 = 7.0 * 86_400.0;

#[cfg(test)]
mod tests {
    use std::path::Path;

    use knowledge::{KnowledgeSource, SourceKind};

    use super::*;
    use crate::settings::Settings;

    fn read(turtle: &str) -> Processes {
        let knowledge = Knowledge::new().unwrap();
        let source = KnowledgeSource::new(SourceKind::File, "processes.ttl");
        knowledge.replace_turtle(&source, turtle, 1).unwrap();
        Processes::read(&knowledge).unwrap()
    }

    const TURTLE: &str = "@prefix css: <http://www.w3id.org/hsu-aut/css#> . @prefix cask: <http://www.w3id.org/hsu-aut/cask#> .
        @prefix ua: <urn:ua-bridge:plant#> . @prefix rdfs: <http://www.w3.org/2000/01/rdf-schema#> .
        <urn:p> a css:Process ; rdfs:label \"hold\" ; ua:within 20 ; ua:hasStep <urn:p/1> , <urn:p/2> .
        <urn:p/2> rdfs:label \"let go\" ; ua:position 2 ; ua:byComponentOf <urn:p/1> ;
            css:requiresCapability [ a cask:RequiredCapability , <urn:c:release> ] .
        <urn:p/1> rdfs:label \"grip\" ; ua:position 1 ; css:requiresCapability [ a cask:RequiredCapability , <urn:c:grasp> ] ;
            ua:hasParameter [ cask:hasVariableName \"Force\" ; ua:value 12.5 ; ua:unit \"N\" ] .";

    #[test]
    fn a_process_of_a_file_is_read_in_its_order() {
        let processes = read(TURTLE);
        assert_eq!(processes.faults, BTreeMap::new());
        let [process] = processes.all.as_slice() else {
            panic!("{processes:?}")
        };
        let names: Vec<_> = process
            .steps
            .iter()
            .map(|step| step.name.as_str())
            .collect();
        assert_eq!(names, ["grip", "let go"]);
        assert_eq!(process.within, Duration::from_secs(20));
        assert_eq!(process.steps[1].by, By::SameAs(0));
        let force = GivenParameter {
            name: "Force".into(),
            value: serde_json::json!(12.5),
            unit: Some("N".into()),
            result: None,
            query: None,
        };
        assert_eq!(process.steps[0].parameters, [force]);
        assert_eq!(
            process.steps[0].needs[0].capability.as_deref(),
            Some("urn:c:grasp")
        );
    }

    #[test]
    fn a_process_that_cannot_run_has_a_reason() {
        for (from, to, reason) in [
            ("ua:position 2", "ua:position 1", "have the ua:position 1"),
            ("ua:position 2 ;", "", "no number as its ua:position"),
            (
                "ua:byComponentOf <urn:p/1>",
                "ua:byComponentOf <urn:x>",
                "which is no earlier step",
            ),
            ("ua:value 12.5 ;", "", "no value, or several, for Force"),
            (
                "ua:value 12.5",
                "ua:value 12.5 ; ua:valueQuery \"SELECT ?f { ?s ?p ?f }\"",
                "several values for Force, a query among them",
            ),
            (
                "ua:value 12.5",
                "ua:queryName \"force\" ; ua:valueQuery \"ASK { ?s ?p ?f }\"",
                "Force (query `force`): it is no SELECT",
            ),
            (
                "ua:within 20",
                "ua:within \"soon\"",
                "is not a number of seconds",
            ),
            (", <urn:c:release> ]", "]", "without a capability or type"),
            (
                "ua:value 12.5 ; ua:unit \"N\"",
                "ua:resultOf <urn:p/2>",
                "takes Force from urn:p/2, which is no earlier step",
            ),
        ] {
            assert!(TURTLE.contains(from), "{from}");
            let processes = read(&TURTLE.replace(from, to));
            assert!(processes.all.is_empty());
            let why = processes.faults["urn:p"].to_string();
            assert!(why.contains(reason), "{reason}: {why}");
        }
    }

    #[test]
    fn processes_of_the_yaml_come_back_from_the_graph_as_they_were() {
        let example = include_str!("../../../examples/plant/mes.yaml");
        let own = "  - process: urn:p\n    wait: 4 s\n    steps:\n      - {step: grip, needs: {skill: urn:c:grasp}, parameters: {Force: {value: 12.5, unit: N}, Name: a, All: [1, true], Deep: -3, Depth: {query: 'SELECT ?d { ?s ?p ?d }', query_name: depth, unit: mm}}}\n      - {step: hold, needs: {skill: {type: GraspSkillType}}, by: attached-tool, parameters: {Width: {result: Width, of: grip}}, compensation: {needs: {skill: urn:c:release}, by: {component_of: grip}}}\n      - {step: hold, needs: {skill: {type: 'nsu=urn:maker;HoldType', capability: urn:c:hold}}, by: {component_of: grip}, compensation: {step: let go, needs: {skill: urn:c:release}, parameters: {Speed: 2}}}\n";
        let shaped = "approach: 0.05, shape: {box: [0.04, 0.06, 0.05]}";
        assert!(example.contains("approach: 0.05"), "{example}");
        let example = example.replacen("approach: 0.05", shaped, 1);
        let text = format!("{example}{own}");
        let settings = Settings::from_yaml(&text, Path::new(""))
            .unwrap_or_else(|findings| panic!("{}", findings.render("mes.yaml", &text)));
        let knowledge = Knowledge::new().unwrap();
        for process in &settings.processes {
            let source = KnowledgeSource::new(SourceKind::Process, &process.iri);
            let triples = process.triples(&|_| None);
            knowledge.replace(&source, &triples, 1).unwrap();
        }
        let read = Processes::read(&knowledge).unwrap();
        assert_eq!(read.faults, BTreeMap::new());
        let sorted = |mut all: Vec<Process>| {
            all.sort_by(|one, other| one.iri.cmp(&other.iri));
            for step in all.iter_mut().flat_map(|process| &mut process.steps) {
                step.parameters
                    .sort_by(|one, other| one.name.cmp(&other.name));
                step.needs.sort_by_key(|need| need.role);
            }
            all
        };
        assert_eq!(sorted(read.all), sorted(settings.processes));
    }
}
