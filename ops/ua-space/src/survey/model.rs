//! Reads the topics of a SysML model: XMI as Papyrus writes it, or the textual notation of
//! SysML v2.
//!
//! Stereotypes (SysML 1) or metadata (SysML v2) mark the properties and operations that cross.
//! `ua-space new profile` and `ua-space new sysml` write their definitions. The file is not
//! trusted: sizes and depths are bounded, and faults are collected as findings.

mod stereotypes;
mod text;
mod xmi;

use std::collections::BTreeMap;
use std::fmt;
use std::path::Path;

use mappings::{CallKind, ExpandedNodeIdText, SpaceId};
use messages::TypeName;
use uadp::BuiltinType;

use crate::exit::CommandFailure;
use crate::live::harmless;

/// The values and calls of a model.
#[derive(Clone, Debug, Default)]
pub(crate) struct NodeModel {
    /// The name of the source, for people.
    pub(crate) place: String,
    /// The spaces of the topics, with their DDS domains.
    pub(crate) spaces: BTreeMap<SpaceId, Option<u16>>,
    /// The namespaces of the model, by index.
    pub(crate) namespaces: BTreeMap<u16, String>,
    pub(crate) values: Vec<ModelValue>,
    pub(crate) calls: Vec<ModelCall>,
}

/// A property with a topic or node.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct ModelValue {
    /// The names of the blocks around the property, joined by dots.
    pub(crate) within: String,
    pub(crate) name: String,
    pub(crate) node: Option<ExpandedNodeIdText>,
    /// The builtin type, and whether the value is an array; `None` if the mapping derives it from
    /// the ROS type.
    pub(crate) value: Option<(BuiltinType, bool)>,
    pub(crate) origin: SpaceId,
    pub(crate) topics: Vec<ModelTopic>,
}

/// A topic of a property.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct ModelTopic {
    pub(crate) space: SpaceId,
    pub(crate) topic: String,
    pub(crate) kind: TypeName,
    pub(crate) field: Option<String>,
}

/// An operation that ROS executes.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct ModelCall {
    pub(crate) name: String,
    pub(crate) origin: SpaceId,
    pub(crate) kind: CallKind,
    /// The ROS name of the service or action.
    pub(crate) server: String,
    pub(crate) type_name: String,
}

/// An element of a model that has stereotypes.
#[derive(Clone, Debug)]
struct Element {
    /// The names of the blocks around the element, from the outside in.
    owners: Vec<String>,
    name: String,
    kind: ElementKind,
    /// The last segment of the name of its type.
    type_name: Option<String>,
    is_array: bool,
    line: usize,
    applied: Vec<Applied>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum ElementKind {
    Property,
    Operation,
    /// A package, a definition or another element.
    Other,
}

/// A stereotype of an element.
#[derive(Clone, Debug, Default)]
struct Applied {
    stereotype: String,
    line: usize,
    tags: Vec<Tag>,
}

impl Applied {
    /// Returns about its memory in bytes.
    fn size(&self) -> usize {
        let texts = self.tags.iter().flat_map(|tag| [&tag.name, &tag.value]);
        let all = std::iter::once(&self.stereotype).chain(texts);
        all.fold(0, |sum, text| {
            sum.saturating_add(text.len()).saturating_add(50)
        })
    }
}

/// A value of a stereotype.
#[derive(Clone, Debug)]
struct Tag {
    name: String,
    value: String,
    line: usize,
}

/// A fault of a model.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Finding {
    line: usize,
    message: String,
}

impl Finding {
    fn new(line: usize, message: impl Into<String>) -> Self {
        Self {
            line,
            message: message.into(),
        }
    }
}

impl fmt::Display for Finding {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        // Names of XML elements may contain control characters.
        write!(f, "{}: {}", self.line, harmless(&self.message))
    }
}

/// Reads the values and calls of a model file.
///
/// # Errors
/// `CommandFailure::Io` if the file cannot be read, `CommandFailure::Data` with all findings of the
/// file.
pub(crate) fn survey(file: &str) -> Result<NodeModel, CommandFailure> {
    let bytes = type_files::read_bounded(Path::new(file), LARGEST)
        .map_err(|why| CommandFailure::Io(format!("cannot read {file}: {why}")))?;
    let content =
        xml_text::decode(&bytes).map_err(|why| CommandFailure::Data(format!("{file}: {why}")))?;
    let model =
        parse(&content).map_err(|findings| CommandFailure::Data(report(file, &findings)))?;
    Ok(NodeModel {
        place: format!("SysML model {file}"),
        ..model
    })
}

/// Returns the text of the findings, a line each.
fn report(file: &str, findings: &[Finding]) -> String {
    let shown = findings.iter().take(MOST_SHOWN);
    let mut lines: Vec<String> = shown.map(|finding| format!("{file}:{finding}")).collect();
    if let Some(more) = findings
        .len()
        .checked_sub(MOST_SHOWN)
        .filter(|more| *more > 0)
    {
        lines.push(format!("{file}: {more} more findings are not shown"));
    }
    lines.join("\n")
}

/// Returns the values and calls of a model, or all its findings in the order of their lines.
fn parse(content: &str) -> Result<NodeModel, Vec<Finding>> {
    let (elements, mut findings) = match content.trim_start().starts_with('<') {
        true => xmi::elements(content),
        false => text::elements(content),
    }
    .map_err(|fatal| vec![fatal])?;
    let (model, faults) = stereotypes::interpret(&elements);
    findings.extend(faults);
    if findings.is_empty() && model.values.is_empty() && model.calls.is_empty() {
        findings.push(Finding::new(
            1,
            "the model has no topic; apply Ros1Topic or Ros2Topic to a property (`ua-space new \
             profile` and `ua-space new sysml` write the stereotypes)",
        ));
    }
    match findings.is_empty() {
        true => Ok(model),
        false => {
            findings.sort_by_key(|finding| finding.line);
            Err(findings)
        }
    }
}

/// Returns the number of values and calls of a model, or the lines of all its findings.
pub(crate) fn counted(content: &str) -> Result<usize, Vec<usize>> {
    match parse(content) {
        Ok(model) => Ok(model.values.len() + model.calls.len()),
        Err(findings) => Err(findings.iter().map(|finding| finding.line).collect()),
    }
}

/// Shortens text of the file and escapes control characters.
fn shown(text: &str) -> String {
    let short: String = text.chars().take(64).collect();
    short.escape_debug().to_string()
}

/// Maximum size of a file in bytes.
const LARGEST: u64 = 64 << 20;
/// Maximum number of elements of a model.
const MOST_ELEMENTS: usize = 500_000;
/// Maximum depth of nested elements.
const DEEPEST: usize = 128;
/// Maximum number of findings that are shown.
const MOST_SHOWN: usize = 100;

#[cfg(test)]
mod tests;
