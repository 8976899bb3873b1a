//! `mappings/schema.json` checked with a third-party JSON Schema validator and YAML parser.

use std::fs;
use std::path::{Path, PathBuf};

use serde_json::Value;
use system_tests::{Cell, Peer};

const ROOT: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/..");

/// Returns the validator's result for each file.
fn judged(cell: &Cell, files: &[PathBuf]) -> Vec<Value> {
    let schema = format!("{ROOT}/mappings/schema.json");
    let names: Vec<&str> = files.iter().map(|file| file.to_str().unwrap()).collect();
    let args = [&[schema.as_str()][..], &names].concat();
    let told = cell.asyncua_once("schema_judge.py", &args);
    assert_eq!(told.len(), files.len());
    told
}

fn yaml_in(folder: &str) -> Vec<PathBuf> {
    let entries = fs::read_dir(Path::new(ROOT).join(folder)).unwrap();
    let mut files: Vec<PathBuf> = entries.map(|entry| entry.unwrap().path()).collect();
    files.retain(|path| path.extension().is_some_and(|end| end == "yaml"));
    files.sort();
    files
}

/// Pages with YAML of components and of `ua-mes`, which have no schema.
const WITHOUT_MAPPINGS: [&str; 5] = [
    "components.md",
    "knowledge.md",
    "mtp.md",
    "plug-and-produce.md",
    "processes.md",
];

/// Returns the README and the pages of `docs/` that show mappings.
fn pages() -> Vec<PathBuf> {
    let root = Path::new(ROOT);
    let entries = fs::read_dir(root.join("docs")).unwrap();
    let mut pages: Vec<PathBuf> = entries.map(|entry| entry.unwrap().path()).collect();
    pages.retain(|path| path.extension().is_some_and(|end| end == "md"));
    pages.retain(|path| !WITHOUT_MAPPINGS.iter().any(|name| path.ends_with(name)));
    pages.sort();
    pages.insert(0, root.join("README.md"));
    pages
}

/// Returns the YAML blocks of a Markdown text that hold more than comments.
fn blocks(markdown: &str) -> Vec<&str> {
    let blocks = markdown.split("```yaml\n").skip(1);
    let blocks = blocks.map(|rest| rest.split("```").next().unwrap());
    let says = |line: &str| !line.trim().is_empty() && !line.trim_start().starts_with('#');
    blocks.filter(|block| block.lines().any(says)).collect()
}

#[test]
fn what_is_shipped_and_what_the_pages_show_is_valid() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let mut files = yaml_in("mappings");
    files.extend(
        yaml_in("tests/cells")
            .into_iter()
            .filter(|file| !file.ends_with("ten_faults.yaml")),
    );
    files.extend(yaml_in("tests/tests/init"));
    let shipped = files.len();
    for page in pages() {
        let text = fs::read_to_string(&page).unwrap();
        let name = page.file_stem().unwrap().to_str().unwrap();
        for (number, block) in blocks(&text).into_iter().enumerate() {
            files.push(cell.file(&format!("{name}-{number}.yaml"), block));
        }
    }
    assert!(shipped >= 7 && files.len() >= shipped + 20, "{files:?}");
    for told in judged(&cell, &files) {
        assert_eq!(told["faults"], serde_json::json!([]), "{told}");
        assert_ne!(
            told["keys"],
            serde_json::json!([]),
            "{told} holds nothing that was judged"
        );
    }
}

#[test]
fn what_breaks_the_schema_is_refused_at_its_place() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    // Errors of shape and range. The schema does not cover errors across keys.
    let expected = [
        ("M003", "$"),
        ("M005", "$.variables[0]"),
        ("M006", "$.spaces"),
        ("M010", "$.spaces"),
        ("M020", "$.pubsub"),
        ("M040", "$.server"),
        ("M050", "$.variables"),
    ];
    let files: Vec<PathBuf> = expected
        .iter()
        .map(|(name, _)| Path::new(ROOT).join(format!("mappings/tests/bad/{name}.yaml")))
        .collect();
    for (told, (name, place)) in judged(&cell, &files).iter().zip(expected) {
        let faults = told["faults"].as_array().unwrap();
        let there = |fault: &Value| fault.as_str().unwrap().starts_with(place);
        assert!(
            faults.iter().any(there),
            "{name} is to be refused at {place}: {told}"
        );
    }
}

/// Keys of each kind that does not accept arbitrary text, each with a valid value.
const LIMITED: [(&str, &str); 12] = [
    ("spaces: [{id: 2, domain: @}]", "7"),
    ("pubsub: {ttl: @}", "1"),
    ("pubsub: {publisher_id: @}", "any_width"),
    ("pubsub: {keep_alive_period: @}", "1s"),
    ("pubsub: {address: @}", "opc.udp://239.192.0.40:4840"),
    ("server: {security: [@]}", "Basic256Sha256"),
    ("variables: [{node: @, name: A, origin: 1}]", "ns=2;i=1"),
    (
        "variables: [{node: ns=2;i=1, name: A, origin: 1, queue: @}]",
        "keep_latest",
    ),
    (
        "variables: [{node: ns=2;i=1, name: A, origin: 1, queue: {drop_oldest: @}}]",
        "100",
    ),
    (
        "variables: [{node: ns=2;i=1, name: A, origin: 1, range: [@, 100]}]",
        "0.5",
    ),
    (
        "variables: [{node: ns=2;i=1, name: A, origin: 1, ros: {topic: /a, scale: 2, invert: @}}]",
        "true",
    ),
    (
        "patterns: [{topics: \"/a/*\", node: \"ns=2;i={1}\", name: A, origin: 1, fields: [{field: x, out_of_range: @}]}]",
        "clamp",
    ),
];

#[test]
fn an_environment_variable_may_stand_wherever_the_program_takes_one_and_nothing_else_may() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let mut files = Vec::new();
    for (number, (document, value)) in LIMITED.into_iter().enumerate() {
        let values = [
            value.to_owned(),
            "\"${CELL_VALUE}\"".to_owned(),
            format!("\"${{CELL_VALUE:-{value}}}\""),
            "\"$CELL_VALUE\"".to_owned(),
            "\"$${CELL_VALUE}\"".to_owned(),
            "\"${CELL VALUE}\"".to_owned(),
        ];
        for (form, value) in values.iter().enumerate() {
            let text = document.replace('@', value);
            files.push(cell.file(&format!("limited-{number}-{form}.yaml"), &text));
        }
    }
    let told = judged(&cell, &files);
    for (told, (document, _)) in told.chunks(6).zip(LIMITED) {
        let sound: Vec<bool> = told
            .iter()
            .map(|one| one["faults"] == serde_json::json!([]))
            .collect();
        let expected = [true, true, true, false, false, false];
        assert_eq!(sound, expected, "{document}: {told:?}");
    }
    // The program accepts the values that the schema accepts.
    for (document, value) in LIMITED {
        let text = document.replace('@', &format!("\"${{NO_SUCH_VARIABLE:-{value}}}\""));
        let checked = mappings::Mapping::from_yaml(&text, "cell.yaml");
        let refused = checked.findings.iter().find(|found| {
            let codes = [
                mappings::Code::WrongValue,
                mappings::Code::EnvironmentVariable,
            ];
            codes.contains(&found.code)
        });
        assert_eq!(refused, None, "{text}");
    }
}
