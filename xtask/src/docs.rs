//! `cargo xtask docs`: generates the reference pages from the programs and the schema of mappings.

use std::{fmt::Write as _, fs, path::Path};

use anyhow::Context as _;
use serde_json::{Map, Value};

use crate::{
    dist,
    help::{Help, output},
    markdown,
    shell::{CommandOutcome, step},
    workspace::Workspace,
};

const FOLDER: &str = "docs/reference";
const NOTE: &str =
    "<!-- Written by `cargo xtask docs`. Change the program or the schema instead. -->";
/// Sources of the metrics: the file, the text before the name of a metric, and the end of the name.
const METRICS: [(&str, &str, &str); 3] = [
    ("space/bridge-node/src/status.rs", "line(", ""),
    ("space/bridge-node/src/mapping_file.rs", "(", "_total"),
    ("plant/discovery/src/lds.rs", "(", "_total"),
];

/// Builds the programs and writes the reference pages. `--check` compares the pages instead, and
/// checks that the page of metrics names each metric of the sources, and that the links of all
/// pages have targets. `--no-build` takes the programs as they are.
///
/// # Errors
/// Returns an error if a program cannot be built or run, or a page cannot be written.
pub(crate) fn run(workspace: &Workspace, arguments: &[&str]) -> anyhow::Result<CommandOutcome> {
    let unknown = arguments
        .iter()
        .find(|argument| !["--check", "--no-build"].contains(argument));
    if let Some(unknown) = unknown {
        eprintln!("xtask: docs takes --check and --no-build, not {unknown}");
        return Ok(CommandOutcome::USAGE);
    }
    let check = arguments.contains(&"--check");
    if !arguments.contains(&"--no-build") {
        dist::build(workspace, None)?;
    }
    let programs = workspace.target.join("debug");
    let schema = fs::read_to_string(workspace.root.join("mappings/schema.json"))
        .context("mappings/schema.json")?;
    let pages = [
        ("commands.md", commands(&programs)?),
        (
            "findings.md",
            findings(&output(&programs, &["ua-space", "explain"])?),
        ),
        ("mapping.md", mapping(&serde_json::from_str(&schema)?)),
    ];
    let folder = workspace.root.join(FOLDER);
    fs::create_dir_all(&folder).with_context(|| format!("{}", folder.display()))?;
    let mut faults = Vec::new();
    for (name, text) in pages {
        let path = folder.join(name);
        if !check {
            fs::write(&path, text).with_context(|| format!("{}", path.display()))?;
        } else if fs::read_to_string(&path).ok() != Some(text) {
            faults.push(format!(
                "{FOLDER}/{name} is out of date: run `cargo xtask docs`"
            ));
        }
    }
    if check {
        let page = fs::read_to_string(folder.join("metrics.md")).context("metrics.md")?;
        for (file, before, end) in METRICS {
            let source = fs::read_to_string(workspace.root.join(file)).context(file)?;
            let missing = metrics(&source, before, end);
            let missing = missing.filter(|name| !page.contains(&format!("{name}`")));
            faults
                .extend(missing.map(|name| format!("{FOLDER}/metrics.md lacks {name} of {file}")));
        }
    }
    if check {
        faults.extend(markdown::broken_links(&workspace.root)?);
    }
    for fault in &faults {
        eprintln!("xtask: {fault}");
    }
    if !faults.is_empty() {
        return Ok(CommandOutcome::BADLY);
    }
    step(match check {
        true => "the reference pages are current",
        false => "the reference pages are written",
    });
    Ok(CommandOutcome::WELL)
}

/// Returns the page of all commands: the help of each program and of its verbs.
fn commands(programs: &Path) -> anyhow::Result<String> {
    let mut page = format!(
        "{NOTE}\n# Commands\n\nEach program and verb with its options. An option wins over its \
         environment variable, which wins over the YAML.\n"
    );
    for help in Help::all(programs)? {
        let text: Vec<&str> = help.text.trim().lines().map(str::trim_end).collect();
        // Writing to a string does not fail.
        let _written = write!(
            page,
            "\n## {}\n\n```text\n{}\n```\n",
            help.words.join(" "),
            text.join("\n")
        );
    }
    Ok(page)
}

/// Returns the page of all finding codes from lines of the form `CODE  text`.
fn findings(list: &str) -> String {
    let mut page = format!(
        "{NOTE}\n# Findings\n\n`ua-space check` prints findings with these codes. `ua-space explain \
         CODE` shows a document with the finding.\n\n| code | rule |\n|---|---|\n"
    );
    for (code, rule) in list.lines().filter_map(|line| line.split_once("  ")) {
        let _written = writeln!(page, "| {code} | {} |", cell(rule));
    }
    page
}

/// Returns the page of all keys of a mapping from its JSON Schema.
fn mapping(schema: &Value) -> String {
    let mut page = format!(
        "{NOTE}\n# Keys of a mapping\n\n[Map values](../mapping.md) explains mappings with examples. A \
         key with a star is required.\n"
    );
    table("The document", schema, &mut page);
    let definitions = schema.get("$defs").and_then(Value::as_object);
    for (name, definition) in definitions.into_iter().flatten() {
        table(name, definition, &mut page);
    }
    page
}

/// Appends the keys of a definition of the schema, or its alternatives if it has no keys.
fn table(name: &str, definition: &Value, page: &mut String) {
    let about = definition.get("description").and_then(Value::as_str);
    let _written = write!(page, "\n## {name}\n\n");
    if let Some(about) = about {
        let _written = write!(page, "{}\n\n", cell(about));
    }
    let required = definition.get("required").and_then(Value::as_array);
    let keys = definition.get("properties").and_then(Value::as_object);
    if let Some(keys) = keys {
        page.push_str("| key | value | meaning |\n|---|---|---|\n");
        for (key, value) in keys {
            let star = required.is_some_and(|keys| keys.iter().any(|required| required == key));
            let star = if star { "*" } else { "" };
            let about = value
                .get("description")
                .and_then(Value::as_str)
                .unwrap_or_default();
            let _written = writeln!(
                page,
                "| `{key}`{star} | {} | {} |",
                kind(value),
                cell(about)
            );
        }
        return;
    }
    let alternatives = definition.get("oneOf").and_then(Value::as_array);
    if let Some(alternatives) = alternatives {
        page.push_str("| value | meaning |\n|---|---|\n");
        for value in alternatives {
            let about = value
                .get("description")
                .and_then(Value::as_str)
                .unwrap_or_default();
            let _written = writeln!(page, "| {} | {} |", kind(value), cell(about));
        }
        return;
    }
    let _written = writeln!(page, "{}", kind(definition));
}

/// Returns the kind of a value in words, with links to the referenced definitions.
fn kind(value: &Value) -> String {
    if let Some(name) = value.get("$ref").and_then(Value::as_str) {
        let name = name.rsplit('/').next().unwrap_or(name);
        // Every value may be an environment variable.
        return match name {
            "EnvironmentVariable" => String::new(),
            name => format!("[{name}](#{})", name.to_lowercase()),
        };
    }
    if let Some(constant) = value.get("const") {
        return format!(
            "`{}`",
            constant
                .as_str()
                .map_or_else(|| constant.to_string(), str::to_owned)
        );
    }
    for choice in ["anyOf", "oneOf"] {
        if let Some(choices) = value.get(choice).and_then(Value::as_array) {
            let mut kinds: Vec<String> = choices.iter().map(kind).collect();
            kinds.retain(|kind| !kind.is_empty());
            kinds.dedup();
            return kinds.join(" or ");
        }
    }
    let types = match value.get("type") {
        Some(Value::String(one)) => vec![one.as_str()],
        Some(Value::Array(several)) => several.iter().filter_map(Value::as_str).collect(),
        _ => Vec::new(),
    };
    let kinds = types.iter().filter(|kind| **kind != "null");
    let kinds: Vec<String> = kinds.map(|kind| simple(kind, value)).collect();
    kinds.join(" or ")
}

/// Returns a JSON type in the words of YAML, with its bounds.
fn simple(kind: &str, value: &Value) -> String {
    let number = |key: &str| value.get(key).and_then(Value::as_number);
    match kind {
        "array" => match value.get("items").map(self::kind) {
            Some(items) if !items.is_empty() => format!("list of {items}"),
            _ => "list".to_owned(),
        },
        "object" => match value.get("properties").and_then(Value::as_object) {
            Some(keys) => format!("map with {}", listed(keys)),
            None => "map".to_owned(),
        },
        "integer" => match (number("minimum"), number("maximum")) {
            (Some(least), Some(most)) => format!("integer, {least} to {most}"),
            (Some(least), None) => format!("integer, from {least}"),
            _ => "integer".to_owned(),
        },
        "string" => "text".to_owned(),
        other => other.to_owned(),
    }
}

/// Returns the names of keys.
fn listed(keys: &Map<String, Value>) -> String {
    let keys: Vec<String> = keys.keys().map(|key| format!("`{key}`")).collect();
    keys.join(", ")
}

/// Returns a text as a cell of a table: a single line, with `|` escaped.
fn cell(text: &str) -> String {
    let words: Vec<&str> = text.split_whitespace().collect();
    words.join(" ").replace('|', "\\|")
}

/// Returns the metrics of a source file, without its tests: texts after `before` that end with
/// `end`.
fn metrics<'a>(source: &'a str, before: &'a str, end: &'a str) -> impl Iterator<Item = &'a str> {
    let (source, _) = source.split_once("#[cfg(test)]").unwrap_or((source, ""));
    let behind = source.split(before).skip(1);
    let texts = behind.filter_map(|rest| rest.trim_start().strip_prefix('"')?.split('"').next());
    let named = |name: &&str| {
        !name.is_empty()
            && name
                .bytes()
                .all(|b| b.is_ascii_lowercase() || b.is_ascii_digit() || b == b'_')
    };
    texts.filter(named).filter(move |name| name.ends_with(end))
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn keys_of_the_schema_are_rows_with_their_kinds_and_links() {
        let schema = json!({
            "properties": {"spaces": {"type": "array", "items": {"$ref": "#/$defs/Space"}}},
            "$defs": {
                "Space": {
                    "description": "A space\nof the cell.",
                    "properties": {
                        "id": {"anyOf": [
                            {"type": "integer", "minimum": 1, "maximum": 232},
                            {"$ref": "#/$defs/EnvironmentVariable"},
                        ], "description": "1 | 2"},
                        "name": {"type": ["string", "null"]},
                    },
                    "required": ["id"],
                },
                "Mode": {"oneOf": [{"const": "sign", "description": "Signed."}]},
            },
        });
        let page = mapping(&schema);
        for row in [
            "| `spaces` | list of [Space](#space) |  |\n",
            "A space of the cell.\n",
            "| `id`* | integer, 1 to 232 | 1 \\| 2 |\n",
            "| `name` | text |  |\n",
            "| `sign` | Signed. |\n",
        ] {
            assert!(page.contains(row), "no {row} in {page}");
        }
    }

    #[test]
    fn metrics_are_found_in_the_code_and_not_in_its_tests() {
        let source = "line(\"ready\", 1); line(\n  \"lost_total\", 2); line(name, 3);\n\
                      #[cfg(test)]\nline(\"no\", 1)";
        let all: Vec<&str> = metrics(source, "line(", "").collect();
        assert_eq!(all, ["ready", "lost_total"]);
        let totals: Vec<&str> = metrics(source, "(", "_total").collect();
        assert_eq!(totals, ["lost_total"]);
    }
}
