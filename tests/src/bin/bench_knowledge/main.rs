//! `cargo xtask bench knowledge`: manifests, NodeSets and questions of the knowledge of the plant,
//! its journal, and the search for a plan.
//!
//! Rows without the data of other makers are left out with a line.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::Path;
use std::process::ExitCode;
use std::time::{Duration, Instant};

use knowledge::{Knowledge, KnowledgeSource, QUESTIONS, SourceKind, SourceLifetime, nodeset};
use mtp::{Module, Object, Triple};
use system_tests::{Cell, StartedChild, eventually, http_get, program, resident};
use test_data::{foreign, read_foreign, read_own};

fn main() -> ExitCode {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let number = |name: &str, usual: usize| -> Option<usize> {
        match args.iter().position(|arg| arg == name) {
            None => Some(usual),
            Some(at) => args.get(at + 1)?.parse().ok(),
        }
    };
    let (Some(runs), Some(statements)) = (number("--runs", 5), number("--statements", 1_000_000))
    else {
        print!("{HELP}");
        return ExitCode::from(64);
    };
    if args.iter().any(|arg| arg == "--help") {
        print!("{HELP}");
        return ExitCode::SUCCESS;
    }
    let Some(cell) = Cell::with(&[]) else {
        return ExitCode::FAILURE;
    };
    println!("| what | figure | target |\n|---|---|---|");
    manifests(runs);
    node_sets(runs);
    questions(runs);
    journal(&cell, statements);
    plan(&cell);
    ExitCode::SUCCESS
}

const HELP: &str = "\
cargo xtask bench knowledge [--runs N] [--statements N]

  --runs N        runs of each measurement, of which the best counts (5); 20 times as many of each question
  --statements N  statements in the journal (1000000)
";

fn row(what: &str, figure: &str, target: &str) {
    println!("| {what} | {figure} | {target} |");
}

fn ms(time: Duration) -> String {
    format!("{:.1} ms", time.as_secs_f64() * 1e3)
}

/// Returns the shortest time of several runs.
fn best(runs: usize, mut run: impl FnMut()) -> Duration {
    let times = (0..runs).map(|_| {
        let began = Instant::now();
        run();
        began.elapsed()
    });
    times.min().unwrap_or_default()
}

/// The manifests of other makers.
fn foreign_manifests() -> Vec<Vec<u8>> {
    let Some(folder) = foreign("mtp") else {
        return Vec::new();
    };
    let mut found = Vec::new();
    collect(&folder, &mut found);
    found.sort_by_key(Vec::len);
    found
}

fn collect(folder: &Path, found: &mut Vec<Vec<u8>>) {
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            collect(&path, found);
        } else if path.extension() == Some("aml".as_ref()) {
            found.push(std::fs::read(&path).unwrap());
        }
    }
}

/// Reads a manifest, and makes its statements.
fn read_manifest(bytes: &[u8]) -> usize {
    let module = Module::from_bytes(bytes).unwrap();
    module.triples("urn:example:m", &BTreeMap::new()).len()
}

fn manifests(runs: usize) {
    let all = foreign_manifests();
    let Some(largest) = all.last() else { return };
    let time = best(runs, || {
        read_manifest(largest);
    });
    let size = largest.len() / 1000;
    let what = format!("largest manifest ({size} kB) to RDF");
    row(&what, &ms(time), "< 200 ms");
    let time = best(runs, || {
        for one in &all {
            read_manifest(one);
        }
    });
    let (count, size) = (all.len(), all.iter().map(Vec::len).sum::<usize>() / 1000);
    let what = format!("all {count} manifests ({size} kB) to RDF");
    row(&what, &ms(time), "< 1 s");
}

/// The base NodeSet, DI and Robotics.
fn foreign_node_sets() -> Option<Vec<String>> {
    let files = [
        "Opc.Ua.NodeSet2",
        "Opc.Ua.Di.NodeSet2",
        "Opc.Ua.Robotics.NodeSet2",
    ];
    let read = files.map(|file| read_foreign(&format!("nodesets/{file}.xml")));
    read.into_iter().collect()
}

fn put_node_sets(knowledge: &Knowledge, texts: &[String]) {
    for text in texts {
        let read = nodeset::read(text).unwrap();
        let source = KnowledgeSource::new(SourceKind::NodeSet, &read.model.namespace);
        knowledge.replace(&source, &read.triples, 1).unwrap();
    }
}

fn node_sets(runs: usize) {
    let Some(texts) = foreign_node_sets() else {
        return;
    };
    for rules in [false, true] {
        let mut statements = 0;
        let time = best(runs, || {
            let knowledge = Knowledge::new().unwrap();
            put_node_sets(&knowledge, &texts);
            knowledge.set_rules(rules).unwrap();
            statements = knowledge.sources().iter().map(|one| one.statements).sum();
        });
        let rules = if rules { "OWL 2 RL" } else { "subclasses" };
        let what = format!(
            "base, DI and Robotics into the store, with the rules ({rules}, {statements} statements)"
        );
        row(&what, &ms(time), "< 1 s");
    }
}

fn questions(runs: usize) {
    let knowledge = Knowledge::new().unwrap();
    if let Some(texts) = foreign_node_sets() {
        put_node_sets(&knowledge, &texts);
    }
    let mut manifests = foreign_manifests();
    manifests.push(read_own("mtp/column.aml").into_bytes());
    for (number, bytes) in (0..).zip(&manifests) {
        let module = Module::from_bytes(bytes).unwrap();
        let triples = module.triples(&format!("urn:example:m{number}"), &BTreeMap::new());
        let source = KnowledgeSource::new(SourceKind::Mtp, &format!("m{number}"));
        knowledge.replace(&source, &triples, 1).unwrap();
    }
    let statements: usize = knowledge.sources().iter().map(|one| one.statements).sum();
    let narrowed = [
        ("components-of", "module", "urn:example:m0"),
        ("state-of", "skill", "urn:example:m0/service/1/procedure/1"),
        ("services-of", "module", "urn:example:m0"),
        ("skills-for", "capability", "urn:example:none"),
        (
            "parameters-of",
            "skill",
            "urn:example:m0/service/1/procedure/1",
        ),
        ("outputs-of", "skill", "urn:example:m0"),
        ("access-of", "name", "Level.V"),
        ("modules-with", "what", "BinVlv"),
    ];
    let measure = |name: &str, parameters: &[(String, String)]| -> Vec<Duration> {
        let mut times = Vec::new();
        for _ in 0..runs * 20 {
            let began = Instant::now();
            let answer = knowledge.ask(name, parameters);
            times.push(began.elapsed());
            answer.unwrap_or_else(|fault| panic!("{name}: {fault}"));
        }
        times.sort();
        times
    };
    let whole: Vec<(&str, Vec<Duration>)> = QUESTIONS
        .iter()
        .map(|question| (question.name, measure(question.name, &[])))
        .collect();
    let narrow: Vec<(&str, Vec<Duration>)> = narrowed
        .iter()
        .map(|(name, parameter, value)| {
            let parameters = [((*parameter).to_owned(), (*value).to_owned())];
            (*name, measure(name, &parameters))
        })
        .collect();
    let all = || whole.iter().chain(&narrow).flat_map(|(_, times)| times);
    let within = all().filter(|time| **time < Duration::from_millis(10));
    let share = 1000 * within.count() / all().count().max(1);
    let what = format!("named questions on {statements} statements that take < 10 ms");
    row(&what, &format!("{}.{} %", share / 10, share % 10), "95 %");
    let median = |times: &[Duration]| times.get(times.len() / 2).copied();
    for (name, times) in &whole {
        let Some(whole) = median(times) else { continue };
        row(&format!("`{name}`, p50"), &ms(whole), "< 10 ms");
        let of = narrow.iter().find(|(narrowed, _)| narrowed == name);
        if let Some(narrowed) = of.and_then(|(_, times)| median(times)) {
            let factor = whole.as_secs_f64() / narrowed.as_secs_f64();
            let figure = format!("{}, {factor:.0} times faster", ms(narrowed));
            row(&format!("`{name}`, narrowed, p50"), &figure, "10 times");
        }
    }
}

fn journal(cell: &Cell, statements: usize) {
    let folder = cell.file("journal", "");
    std::fs::remove_file(&folder).unwrap();
    let of = |source: usize, count: usize| -> Vec<Triple> {
        (0..count)
            .map(|number| Triple {
                subject: format!("urn:example:part:{source}:{}", number / 5),
                predicate: format!("urn:example:property:{}", number % 5),
                object: Object::Integer(i64::try_from(number).unwrap_or_default()),
            })
            .collect()
    };
    let (knowledge, _) = Knowledge::open(&folder).unwrap();
    let each = 100_000;
    for source in 0..statements.div_ceil(each) {
        let count = each.min(statements - source * each);
        let name = KnowledgeSource::new(SourceKind::File, &format!("{source}"));
        let lasting = (1, SourceLifetime::Yes);
        knowledge
            .replace_with(&name, &of(source, count), lasting)
            .unwrap();
    }
    drop(knowledge);
    let began = Instant::now();
    let (knowledge, damaged) = Knowledge::open(&folder).unwrap();
    let time = began.elapsed();
    assert_eq!(damaged, 0);
    let found: usize = knowledge
        .sources()
        .iter()
        .filter(|one| one.kind == SourceKind::File)
        .map(|one| one.statements)
        .sum();
    assert_eq!(found, statements);
    let memory = resident(std::process::id()) / 1_000_000;
    let what = format!("{statements} statements back from the journal ({memory} MB in memory)");
    row(&what, &format!("{:.1} s", time.as_secs_f64()), "< 10 s");
}

/// Searches the plan of a counter of four bits, which has 15 steps, beside four switches that it
/// does not need.
fn plan(cell: &Cell) {
    let mut text = "@prefix ua: <urn:ua-bridge:plant#> . @prefix f: <urn:example:fact:> .\n\
         <urn:example:c> <http://www.w3.org/2000/01/rdf-schema#subClassOf> \
         <http://www.w3id.org/hsu-aut/css#Capability> .\n"
        .to_owned();
    for bit in 0..4 {
        let lower: Vec<String> = (0..bit).map(|lower| format!("f:b{lower}")).collect();
        write!(
            text,
            "<urn:example:action:{bit}> a ua:Action ; ua:ofCapability <urn:example:c> ; ua:forbids f:b{bit} ; ua:adds f:b{bit}"
        )
        .unwrap();
        for lower in lower {
            write!(text, " ; ua:requires {lower} ; ua:removes {lower}").unwrap();
        }
        text.push_str(" .\n");
        writeln!(
            text,
            "<urn:example:action:s{bit}> a ua:Action ; ua:ofCapability <urn:example:c> ; ua:forbids f:s{bit} ; ua:adds f:s{bit} ."
        )
        .unwrap();
    }
    text.push_str("<urn:example:goal> a ua:Goal ; ua:wants f:b0 , f:b1 , f:b2 , f:b3 .\n");
    let turtle = cell.file("goal.ttl", &text).display().to_string();
    let yaml = format!(
        "mes: mes\napplication_uri: urn:example:mes\nnamespace: 50\nsecurity: [None]\n\
         endpoint: opc.tcp://127.0.0.1:0\nsparql: {AT}\nknowledge: [{turtle}]\n"
    );
    let yaml = cell.file("mes.yaml", &yaml).display().to_string();
    let component = "component: arm\napplication_uri: urn:example:arm\nnamespace: 9\n\
        endpoint: opc.tcp://127.0.0.1:0\nsecurity: [None]\nskills:\n  \
        - {name: Move, type: PtpMoveSkillType, driver: {simulated: {}}, capabilities: [urn:example:c]}\n";
    let component = cell.file("component.yaml", component).display().to_string();
    let start = |name: &str, of: &str, yaml: &str| {
        StartedChild::new(name, &program(of))
            .args([yaml, "--interface", "lo", "--lds", "none"])
            .start()
    };
    let _component = start("component", "ua-component", &component);
    let _mes = start("mes", "ua-mes", &yaml);
    eventually("ua-mes knows the skill", Duration::from_secs(30), || {
        let answer = http_get(AT, "/ask/skills-for")?;
        answer.contains("urn:example:c\"").then_some(())
    });
    let began = Instant::now();
    let answer = http_get(AT, "/goal/urn:example:goal").unwrap_or_default();
    let time = began.elapsed();
    let read: serde_json::Value = serde_json::from_str(&answer).unwrap_or_default();
    let steps = read["steps"].as_array().map_or(0, Vec::len);
    assert_eq!(steps, 15, "{answer}");
    let what = format!("plan of {steps} steps, over HTTP");
    row(&what, &ms(time), "< 1 s");
}

const AT: &str = "127.0.0.1:8087";
