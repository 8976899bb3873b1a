//! Reads processes from recipes of other programs: BatchML (B2MML) and BPMN.
//!
//! - `batchml`: master and control recipes
//! - `bpmn`: service tasks with gateways and boundary events
//! - `flow`: from nodes and flows to the order and the conditions of steps

mod batchml;
mod bpmn;
mod flow;
mod values;

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::fmt;

use knowledge::is_iri;
use mtp::escaped;
use roxmltree::{Document, Node, ParsingOptions};
use serde::Deserialize;
use skills::ParameterType;

use crate::process::{Need, Process, SkillRole};

/// The processes of a file.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Recipe {
    pub(crate) processes: Vec<Process>,
    /// Elements that are left out, each with its line.
    pub(crate) notes: Vec<RecipeFinding>,
}

/// An element that is left out, or that no process can have.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct RecipeFinding {
    /// The line of the element, from 1.
    pub(crate) line: usize,
    pub(crate) what: String,
}

impl fmt::Display for RecipeFinding {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "line {}: {}", self.line, self.what)
    }
}

/// Names of a file, with the names that they stand for: capabilities and types of skills,
/// parameters and units.
pub(crate) type Names = BTreeMap<String, String>;

/// A file with the names that it needs, as `ua-space process import` sends it.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Envelope {
    recipe: String,
    #[serde(default)]
    names: Names,
}

/// Returns the recipe in the contents of a source, with its names; `None` if the contents are no
/// recipe.
///
/// # Errors
/// The reason why the contents cannot be read.
pub(crate) fn in_source(contents: &[u8]) -> Result<Option<(Cow<'_, str>, Names)>, String> {
    if contents.trim_ascii_start().starts_with(b"{") {
        let envelope: Envelope = serde_json::from_slice(contents).map_err(|error| {
            format!("it is neither Turtle nor {{\"recipe\": \"..\", \"names\": {{}}}}: {error}")
        })?;
        return Ok(Some((Cow::Owned(envelope.recipe), envelope.names)));
    }
    // Turtle is UTF-8: a file that cannot be decoded is refused by its own reader.
    let Ok(text) = xml_text::decode(contents) else {
        return Ok(None);
    };
    let is_xml = text.trim_start().starts_with('<');
    let is_known = [batchml::NAMESPACE, bpmn::NAMESPACE];
    let is_recipe = is_xml && is_known.iter().any(|namespace| text.contains(namespace));
    Ok(is_recipe.then(|| (text, Names::new())))
}

/// Reads a recipe.
///
/// # Errors
/// All elements that no process can have; then the file has no process.
pub(crate) fn read(text: &str, names: &Names) -> Result<Recipe, Vec<RecipeFinding>> {
    let whole = |line, what: String| vec![RecipeFinding { line, what }];
    if text.len() > MAX_FILE {
        let what = format!("the file has more than {MAX_FILE} bytes");
        return Err(whole(1, what));
    }
    // The parser compares the attributes of an element pairwise.
    if xml_text::has_more_attributes(text, MAX_ATTRIBUTES) {
        let what = format!("an element has more than {MAX_ATTRIBUTES} attributes");
        return Err(whole(1, what));
    }
    let options = ParsingOptions {
        nodes_limit: MAX_NODES,
        ..ParsingOptions::default()
    };
    let text = text.trim_start_matches('\u{feff}');
    let document = Document::parse_with_options(text, options)
        .map_err(|fault| whole(line_of_fault(&fault), fault.to_string()))?;
    let mut reading = Reading {
        document: &document,
        names,
        errors: Vec::new(),
        notes: Vec::new(),
        dropped: 0,
    };
    let root = document.root_element();
    let processes = match root.tag_name().namespace() {
        Some(batchml::NAMESPACE) => reading.batchml(root),
        Some(bpmn::NAMESPACE) => reading.bpmn(root),
        _ => {
            let name = root.tag_name().name();
            reading.error(
                root,
                format!("the root element `{name}` is neither of BatchML nor of BPMN"),
            );
            Vec::new()
        }
    };
    if processes.is_empty() && reading.errors.is_empty() {
        reading.error(root, "the file has no recipe and no process".to_owned());
    }
    let dropped = reading.dropped;
    let more = (dropped > 0).then(|| RecipeFinding {
        line: 1,
        what: format!("{dropped} more findings are not shown"),
    });
    if !reading.errors.is_empty() {
        reading.errors.extend(more);
        return Err(reading.errors);
    }
    reading.notes.extend(more);
    Ok(Recipe {
        processes,
        notes: reading.notes,
    })
}

fn line_of_fault(fault: &roxmltree::Error) -> usize {
    usize::try_from(fault.pos().row).unwrap_or(usize::MAX)
}

/// A file that is being read.
struct Reading<'d> {
    document: &'d Document<'d>,
    names: &'d Names,
    errors: Vec<RecipeFinding>,
    notes: Vec<RecipeFinding>,
    /// Number of findings beyond the limit.
    dropped: usize,
}

impl<'d> Reading<'d> {
    /// Reports an element that no process can have.
    fn error(&mut self, at: Node<'d, 'd>, what: String) {
        self.error_at(at.range().start, what);
    }

    fn error_at(&mut self, at: usize, what: String) {
        if self.errors.len() >= MAX_FINDINGS {
            self.dropped += 1;
            return;
        }
        let line = self.line(at);
        self.errors.push(RecipeFinding { line, what });
    }

    /// Reports an element that is left out.
    fn note(&mut self, at: Node<'d, 'd>, what: String) {
        if self.notes.len() >= MAX_FINDINGS {
            self.dropped += 1;
            return;
        }
        let line = self.line(at.range().start);
        self.notes.push(RecipeFinding { line, what });
    }

    /// Reports the children of an element whose names are not among these.
    fn only(&mut self, node: Node<'d, 'd>, known: &[&str]) {
        let parent = node.tag_name().name();
        for child in node.children().filter(Node::is_element) {
            let name = child.tag_name().name();
            if !known.contains(&name) {
                self.note(child, format!("{name} of {parent} is left out"));
            }
        }
    }

    fn line(&self, at: usize) -> usize {
        let row = self.document.text_pos_at(at).row;
        usize::try_from(row).unwrap_or(usize::MAX)
    }

    /// Returns the name that a name of the file stands for.
    fn named<'a>(&'a self, name: &'a str) -> &'a str {
        self.names.get(name).map_or(name, String::as_str)
    }

    /// Returns the IRI of a process by its ID.
    fn iri(&self, id: &str, kind: &str) -> String {
        let named = self.named(id);
        match is_iri(named) {
            true => named.to_owned(),
            false => format!("urn:ua-bridge:{kind}:{}", escaped(id)),
        }
    }

    /// Returns the need for the capability or the type of skills that a name of the file stands
    /// for, or is. The number of its role is set with the order of the steps.
    fn need(&self, name: &str) -> Option<Need> {
        let wanted = self.named(name).trim();
        let role = SkillRole::Alone(0);
        if wanted.starts_with("nsu=") {
            let skill_type: ParameterType = wanted.parse().ok()?;
            return Some(Need {
                role,
                capability: None,
                skill_type: Some(skill_type),
            });
        }
        is_iri(wanted).then(|| Need {
            role,
            capability: Some(wanted.to_owned()),
            skill_type: None,
        })
    }
}

/// Returns the first child element with a name.
fn child<'d>(node: Node<'d, 'd>, name: &str) -> Option<Node<'d, 'd>> {
    children(node, name).next()
}

/// Returns the child elements with a name.
fn children<'d>(node: Node<'d, 'd>, name: &str) -> impl Iterator<Item = Node<'d, 'd>> {
    let children = node.children().filter(Node::is_element);
    children.filter(move |child| child.tag_name().name() == name)
}

/// Returns the text of the first child element with a name; empty without it.
fn text_of<'d>(node: Node<'d, 'd>, name: &str) -> &'d str {
    child(node, name)
        .and_then(|child| child.text())
        .unwrap_or_default()
        .trim()
}

const MAX_FILE: usize = 4 << 20;
const MAX_NODES: u32 = 500_000;
const MAX_ATTRIBUTES: usize = 100;
const MAX_FINDINGS: usize = 200;

#[cfg(test)]
mod tests;
