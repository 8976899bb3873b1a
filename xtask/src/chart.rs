//! Pictures of measurements: bar charts of Markdown tables, as SVG.
//!
//! A marker before a table of docs/benchmarks.md names its picture:
//! `<!-- chart NAME: LABEL; LABEL | VALUE; VALUE | COLUMN = TEXT -->`. The labels and values are
//! columns of the table; the last part is optional and selects rows. The picture is
//! docs/images/NAME.svg. Each measurement draws its own tables into target/bench as well.

use std::{
    fmt::Write as _,
    fs,
    io::{BufRead as _, BufReader},
    path::{Path, PathBuf},
    process::{Command, Stdio},
};

use anyhow::{Context as _, bail, ensure};

use crate::{
    shell::{CommandOutcome, step},
    workspace::Workspace,
};

/// Draws the pictures of docs/benchmarks.md, or only checks that they are current.
pub(crate) fn run(workspace: &Workspace, arguments: &[&str]) -> anyhow::Result<CommandOutcome> {
    let check = match arguments {
        [] => false,
        ["--check"] => true,
        _ => {
            eprintln!("xtask: bench charts takes --check");
            return Ok(CommandOutcome::USAGE);
        }
    };
    let page = workspace.root.join("docs/benchmarks.md");
    let text = fs::read_to_string(&page).with_context(|| page.display().to_string())?;
    let mut ended = CommandOutcome::WELL;
    for (name, picture) in pictures(&text)? {
        let file = workspace.root.join(format!("docs/images/{name}.svg"));
        if !check {
            fs::write(&file, picture).with_context(|| file.display().to_string())?;
        } else if fs::read_to_string(&file).ok().as_ref() != Some(&picture) {
            println!(
                "{} is not the picture of its table; `cargo xtask bench charts` draws it",
                file.display()
            );
            ended = CommandOutcome::BADLY;
        }
    }
    Ok(ended)
}

/// Runs a measurement, shows its output, and draws the tables in it into `target/bench`.
pub(crate) fn measured(
    command: &mut Command,
    workspace: &Workspace,
    bench: &str,
) -> anyhow::Result<CommandOutcome> {
    let mut child = command.stdout(Stdio::piped()).spawn()?;
    let mut text = String::new();
    if let Some(output) = child.stdout.take() {
        for line in BufReader::new(output).lines() {
            let line = line?;
            println!("{line}");
            text.push_str(&line);
            text.push('\n');
        }
    }
    let ended = child.wait()?;
    let folder = workspace.target.join("bench");
    for (number, table) in tables(&text).iter().enumerate() {
        let values = table.columns(|name| TIMES.contains(&name));
        if values.is_empty() {
            continue;
        }
        let labels = table.columns(|name| !TIMES.contains(&name));
        let texts: Vec<usize> = labels
            .into_iter()
            .filter(|column| {
                table
                    .rows
                    .iter()
                    .any(|row| number_of(cell(row, *column)).is_none())
            })
            .collect();
        let chart = Chart {
            labels: texts,
            values,
            only: None,
        };
        fs::create_dir_all(&folder).with_context(|| folder.display().to_string())?;
        let file: PathBuf = folder.join(format!("{bench}-{}.svg", number + 1));
        fs::write(&file, chart.draw(table)).with_context(|| file.display().to_string())?;
        step(&format!("drawn: {}", shown(&file, &workspace.root)));
    }
    Ok(ended.into())
}

fn shown(file: &Path, root: &Path) -> String {
    file.strip_prefix(root)
        .unwrap_or(file)
        .display()
        .to_string()
}

/// The columns that are drawn of the tables of a measurement.
const TIMES: [&str; 3] = ["p50", "p99", "CPU per message"];

/// Returns the pictures of a page by their names.
fn pictures(page: &str) -> anyhow::Result<Vec<(String, String)>> {
    let mut drawn = Vec::new();
    for (at, _) in page.match_indices(MARKER) {
        let rest = page.get(at + MARKER.len()..).unwrap_or_default();
        let (marker, rest) = rest
            .split_once("-->")
            .with_context(|| format!("a marker without an end: {}", first_line(rest)))?;
        let (name, of) = marker
            .split_once(':')
            .with_context(|| format!("`{marker}` names no picture: write NAME: LABELS | VALUES"))?;
        let found = tables(rest);
        let table = found
            .first()
            .with_context(|| format!("no table follows the marker of {}", name.trim()))?;
        let chart = Chart::of(of, table).with_context(|| format!("chart {}", name.trim()))?;
        drawn.push((name.trim().to_owned(), chart.draw(table)));
    }
    Ok(drawn)
}

const MARKER: &str = "<!-- chart ";

fn first_line(text: &str) -> &str {
    text.lines().next().unwrap_or_default()
}

/// A Markdown table.
#[derive(Debug, Default, PartialEq, Eq)]
struct Table {
    names: Vec<String>,
    rows: Vec<Vec<String>>,
}

impl Table {
    /// Returns the columns with names that fulfil a condition.
    fn columns(&self, wanted: impl Fn(&str) -> bool) -> Vec<usize> {
        let names = self.names.iter().enumerate();
        names
            .filter(|(_, name)| wanted(name))
            .map(|(column, _)| column)
            .collect()
    }

    fn column(&self, name: &str) -> anyhow::Result<usize> {
        match self.columns(|of| of == name)[..] {
            [column, ..] => Ok(column),
            [] => bail!("no column `{name}` among {}", self.names.join(", ")),
        }
    }
}

/// Returns the tables of a text.
fn tables(text: &str) -> Vec<Table> {
    let mut found = Vec::new();
    let mut table = Table::default();
    for line in text.lines().chain([""]) {
        let row = line
            .trim()
            .strip_prefix('|')
            .and_then(|rest| rest.strip_suffix('|'));
        let Some(row) = row else {
            if !table.rows.is_empty() {
                found.push(std::mem::take(&mut table));
            }
            table = Table::default();
            continue;
        };
        let cells: Vec<String> = row.split('|').map(|cell| cell.trim().to_owned()).collect();
        if table.names.is_empty() {
            table.names = cells;
        } else if !cells
            .iter()
            .all(|cell| cell.chars().all(|c| "-:".contains(c)))
        {
            table.rows.push(cells);
        }
    }
    found
}

fn cell(row: &[String], column: usize) -> &str {
    row.get(column).map_or("", String::as_str)
}

/// Returns the number that a cell begins with, such as 55.2 of `55.2 (2.41)`.
fn number_of(cell: &str) -> Option<f64> {
    let digits = cell.find(|c: char| !c.is_ascii_digit() && c != '.');
    cell.get(..digits.unwrap_or(cell.len()))?.parse().ok()
}

/// The columns that a picture shows.
#[derive(Debug)]
struct Chart {
    labels: Vec<usize>,
    values: Vec<usize>,
    /// A column and the text of the rows that are shown.
    only: Option<(usize, String)>,
}

impl Chart {
    /// Reads `LABELS | VALUES | COLUMN = TEXT`.
    fn of(text: &str, table: &Table) -> anyhow::Result<Self> {
        let mut parts = text.split('|').map(str::trim);
        let mut named = |what: &str| -> anyhow::Result<Vec<usize>> {
            let part = parts.next().with_context(|| format!("no {what}"))?;
            part.split(';')
                .map(|name| table.column(name.trim()))
                .collect()
        };
        let (labels, values) = (named("labels")?, named("values")?);
        let only = parts.next().map(|part| -> anyhow::Result<_> {
            let (column, text) = part
                .split_once('=')
                .with_context(|| format!("`{part}` is not COLUMN = TEXT"))?;
            Ok((table.column(column.trim())?, text.trim().to_owned()))
        });
        let chart = Self {
            labels,
            values,
            only: only.transpose()?,
        };
        ensure!(!chart.bars(table).is_empty(), "no row has such values");
        Ok(chart)
    }

    /// Returns the label and the values of each row.
    fn bars(&self, table: &Table) -> Vec<(String, Vec<f64>)> {
        let is_shown = |row: &&Vec<String>| {
            let only = self.only.as_ref();
            only.is_none_or(|(column, text)| cell(row, *column) == text)
        };
        let bars = table.rows.iter().filter(is_shown).filter_map(|row| {
            let labels: Vec<String> = self
                .labels
                .iter()
                .map(|column| cell(row, *column).replace(['`', '*'], ""))
                .collect();
            let values: Option<Vec<f64>> = self
                .values
                .iter()
                .map(|column| number_of(cell(row, *column)))
                .collect();
            Some((labels.join(", "), values?))
        });
        bars.collect()
    }

    /// Returns the picture: a group of bars for each row, with a bar for each value.
    fn draw(&self, table: &Table) -> String {
        let bars = self.bars(table);
        let values = || bars.iter().flat_map(|(_, values)| values.iter().copied());
        let longest = values().fold(f64::MIN_POSITIVE, f64::max);
        let names: Vec<&str> = self
            .values
            .iter()
            .map(|column| table.names.get(*column).map_or("", String::as_str))
            .collect();
        let group = BAR * amount(names.len()) + GAP;
        let height = HEAD + group * amount(bars.len()) + GAP;
        let mut svg = format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {WIDTH} {height}\" width=\"{WIDTH}\" height=\"{height}\" \
             font-family=\"sans-serif\" font-size=\"12\">\n<style>svg{{background:#fff}}text{{fill:#17212b}}.b0{{fill:#0f766e}}\
             .b1{{fill:#9fd3cd}}.b2{{fill:#b9a46a}}@media(prefers-color-scheme:dark){{svg{{background:#0f1418}}text{{fill:#e4eaef}}\
             .b0{{fill:#2dd4bf}}.b1{{fill:#1d5f58}}}}</style>\n"
        );
        // Writing to a String cannot fail.
        let mut line = |text: String| _ = writeln!(svg, "{text}");
        for (at, name) in names.iter().enumerate() {
            let x = LEFT + 120.0 * amount(at);
            let class = at.min(2);
            line(format!(
                "<rect class=\"b{class}\" x=\"{x}\" y=\"8\" width=\"12\" height=\"12\"/><text x=\"{}\" y=\"18\">{}</text>",
                x + 18.0,
                escaped(name)
            ));
        }
        for (row, (label, values)) in bars.iter().enumerate() {
            let top = HEAD + group * amount(row);
            line(format!(
                "<text x=\"{}\" y=\"{:.1}\" text-anchor=\"end\">{}</text>",
                LEFT - 8.0,
                top + BAR * amount(values.len()) / 2.0 + 4.0,
                escaped(&abbreviated(label))
            ));
            for (at, value) in values.iter().enumerate() {
                let width = (value / longest * (WIDTH - LEFT - RIGHT)).max(1.0);
                let y = top + BAR * amount(at);
                let class = at.min(2);
                line(format!(
                    "<rect class=\"b{class}\" x=\"{LEFT}\" y=\"{y:.1}\" width=\"{width:.1}\" height=\"{:.1}\"/>\
                     <text x=\"{:.1}\" y=\"{:.1}\">{value}</text>",
                    BAR - 3.0,
                    LEFT + width + 6.0,
                    y + BAR - 5.0
                ));
            }
        }
        svg.push_str("</svg>\n");
        svg
    }
}

fn abbreviated(label: &str) -> String {
    match label.chars().count() > MOST_LABEL {
        true => label.chars().take(MOST_LABEL - 1).chain(['…']).collect(),
        false => label.to_owned(),
    }
}

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;")
        .replace('<', "&lt;")
        .replace('>', "&gt;")
}

fn amount(count: usize) -> f64 {
    u32::try_from(count).map_or(f64::MAX, f64::from)
}

const WIDTH: f64 = 860.0;
const LEFT: f64 = 380.0;
/// Room for the number behind the longest bar.
const RIGHT: f64 = 80.0;
const HEAD: f64 = 34.0;
const BAR: f64 = 16.0;
const GAP: f64 = 10.0;
const MOST_LABEL: usize = 56;

#[cfg(test)]
mod tests {
    use super::*;

    const PAGE: &str = "\
# A page

<!-- chart hop: path | p50; p99 | payload = 1 KiB -->
![p50 and p99](images/hop.svg)

| payload | path | p50 | p99 |
|---|---|---|---|
| 16 B | floor | 10 | 20 |
| 1 KiB | `relay` & floor | 40 (2.0) | 80.5 |
| 1 KiB | bridge | 20 | - |

text
";

    #[test]
    fn a_marker_draws_the_selected_rows_of_the_next_table() {
        let drawn = pictures(PAGE).unwrap();
        let [(name, picture)] = &drawn[..] else {
            panic!("{drawn:?}");
        };
        assert_eq!(name, "hop");
        assert!(picture.contains(">relay &amp; floor<"), "{picture}");
        assert!(picture.contains(">80.5<") && picture.contains(">40<"));
        assert!(!picture.contains(">10<"), "another payload");
        assert!(!picture.contains("bridge"), "a row without a value");
        // The longest bar takes all the room, and the other half of it.
        assert!(picture.contains("width=\"400.0\"") && picture.contains("width=\"198.8\""));
    }

    #[test]
    fn faults_of_a_marker_are_named() {
        for (wrong, said) in [
            (
                "path | p95",
                "no column `p95` among payload, path, p50, p99",
            ),
            ("path", "no values"),
            ("path | p50 | payload", "is not COLUMN = TEXT"),
            ("path | p50 | payload = 2 KiB", "no row has such values"),
        ] {
            let page = PAGE.replace("path | p50; p99 | payload = 1 KiB", wrong);
            let error = format!("{:#}", pictures(&page).unwrap_err());
            assert!(error.contains(said), "{error}");
        }
        let error = pictures("<!-- chart none: a | b -->").unwrap_err();
        assert!(error.to_string().contains("no table"), "{error}");
    }

    #[test]
    fn a_cell_begins_with_its_number() {
        for (cell, number) in [
            ("55.2 (2.41)", Some(55.2)),
            ("12 %", Some(12.0)),
            ("-", None),
            ("", None),
            ("floor", None),
        ] {
            assert_eq!(number_of(cell), number, "{cell}");
        }
    }
}
