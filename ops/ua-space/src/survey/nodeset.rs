//! Reads the variables of a NodeSet, an XML file by `UANodeSet.xsd` (OPC 10000-6, F).
//!
//! The file is not trusted: a document type is refused, so no entity is ever expanded, and sizes
//! are bounded.

use std::collections::{HashMap, HashSet};
use std::path::Path;

use mappings::{Identifier, NodeIdText};
use quick_xml::XmlVersion;
use quick_xml::events::{BytesStart, Event};
use quick_xml::reader::Reader;
use uadp::BuiltinType;

use super::data_types::{self, STRUCTURE};
use super::{MOST, SurveyedNodes, UaVariable};
use crate::exit::CommandFailure;

/// Reads the variables of a NodeSet file.
pub(crate) fn survey(file: &str) -> Result<SurveyedNodes, CommandFailure> {
    let bytes = type_files::read_bounded(Path::new(file), LARGEST)
        .map_err(|why| CommandFailure::Io(format!("cannot read {file}: {why}")))?;
    let xml =
        xml_text::decode(&bytes).map_err(|why| CommandFailure::Data(format!("{file}: {why}")))?;
    parse(&xml, file).map_err(|fault| {
        let line = xml.get(..fault.at).unwrap_or(&xml).matches('\n').count() + 1;
        CommandFailure::Data(format!("{file}:{line}: {}", fault.what))
    })
}

/// The fault of a NodeSet, with its byte offset.
#[derive(Debug)]
struct SurveyFault {
    at: usize,
    what: UnreadNodeSet,
}

/// The reason why the variables of a NodeSet are not read.
#[derive(Debug, thiserror::Error)]
enum UnreadNodeSet {
    /// The file is malformed.
    #[error("this is not XML: {0}")]
    Xml(quick_xml::Error),
    /// An attribute of an element is malformed.
    #[error("in <{element}>: {why}")]
    Attribute {
        /// The local name of the element.
        element: String,
        /// The reason.
        why: String,
    },
    /// An entity is not predefined.
    #[error("an entity that XML does not have")]
    Entity,
    /// The file has a document type, which may define entities.
    #[error("a NodeSet has no document type; remove the `<!DOCTYPE ..>`")]
    DocumentType,
    /// The file has no elements.
    #[error("there is no <UANodeSet> in it")]
    Empty,
    /// The file has another root element.
    #[error("this is a <{0}>, no <UANodeSet>")]
    Root(String),
    /// The end of the file is missing.
    #[error("the file ends in the middle")]
    Cut,
    /// Elements are nested too deeply.
    #[error("elements are nested deeper than {DEEPEST}")]
    TooDeep,
    /// The file has too many variables.
    #[error("more than {MOST} variables are not read")]
    TooMany,
    /// A text is no NodeId.
    #[error("`{0}` is neither a node id nor an alias")]
    NodeId(String),
    /// The namespace index of a NodeId has no URI.
    #[error("`{id}`: NamespaceUris has no entry {}", id.namespace)]
    Namespace {
        /// The NodeId.
        id: NodeIdText,
    },
    /// The ValueRank of the node with this NodeId is malformed.
    #[error("the ValueRank of `{0}` is no number")]
    ValueRank(String),
}

fn parse(xml: &str, place: &str) -> Result<SurveyedNodes, SurveyFault> {
    let mut reader = Reader::from_str(xml.trim_start_matches('\u{feff}'));
    reader.config_mut().expand_empty_elements = true;
    reader.config_mut().trim_text(true);
    let mut set = NodeSet::default();
    loop {
        let at = usize::try_from(reader.buffer_position()).unwrap_or(usize::MAX);
        let fault = |what: UnreadNodeSet| SurveyFault { at, what };
        let event = reader.read_event();
        match event.map_err(|error| fault(UnreadNodeSet::Xml(error)))? {
            Event::Start(element) => set.open(&element).map_err(fault)?,
            Event::End(_) => set.close().map_err(fault)?,
            Event::Text(text) => set.text.push_str(&text.xml10_content()),
            Event::CData(text) => set.text.push_str(&text.xml10_content()),
            Event::GeneralRef(entity) => {
                let found = entity.resolve_char_ref().ok().flatten();
                let known = quick_xml::escape::resolve_predefined_entity(&entity.xml10_content());
                match (found, known) {
                    (Some(char), _) => set.text.push(char),
                    (None, Some(text)) => set.text.push_str(text),
                    (None, None) => return Err(fault(UnreadNodeSet::Entity)),
                }
            }
            Event::DocType(_) => return Err(fault(UnreadNodeSet::DocumentType)),
            Event::Eof if !set.seen => return Err(fault(UnreadNodeSet::Empty)),
            Event::Eof if !set.path.is_empty() => return Err(fault(UnreadNodeSet::Cut)),
            Event::Eof => break,
            // An empty element is reported as its start and its end.
            Event::Empty(_) | Event::Comment(_) | Event::Decl(_) | Event::PI(_) => {}
        }
    }
    set.nodes(place).map_err(|what| SurveyFault {
        at: xml.len(),
        what,
    })
}

/// The parts of the NodeSet read so far.
#[derive(Default)]
struct NodeSet {
    seen: bool,
    /// Local names of the open elements.
    path: Vec<String>,
    text: String,
    attributes: HashMap<String, String>,
    uris: Vec<String>,
    aliases: HashMap<String, String>,
    node: Option<NodeSetEntry>,
    variables: Vec<(NodeIdText, NodeSetEntry)>,
    objects: HashMap<NodeIdText, NodeSetEntry>,
    /// Types and Methods; nodes below them are declarations, not values.
    types: HashSet<NodeIdText>,
    /// Supertypes of DataTypes.
    supertypes: HashMap<NodeIdText, NodeIdText>,
    properties: HashSet<NodeIdText>,
}

/// A node with its attributes and references.
#[derive(Clone, Debug, Default)]
struct NodeSetEntry {
    attributes: HashMap<String, String>,
    parent: Option<String>,
    references: Vec<(String, bool, String)>,
}

impl NodeSet {
    fn open(&mut self, element: &BytesStart<'_>) -> Result<(), UnreadNodeSet> {
        let name = element.local_name().into_inner().to_owned();
        self.text.clear();
        self.attributes.clear();
        for attribute in element.attributes() {
            let wrong = |why: String| UnreadNodeSet::Attribute {
                element: name.clone(),
                why,
            };
            let attribute = attribute.map_err(|error| wrong(error.to_string()))?;
            let value = attribute
                .normalized_value(XmlVersion::Implicit1_0)
                .map_err(|error| wrong(error.to_string()))?;
            let key = attribute.key.local_name().into_inner().to_owned();
            self.attributes.insert(key, value.into_owned());
        }
        match self.path.len() {
            0 if name != "UANodeSet" => {
                return Err(UnreadNodeSet::Root(name));
            }
            0 => self.seen = true,
            1 if name.starts_with("UA") => {
                self.node = Some(NodeSetEntry {
                    parent: self.attributes.get("ParentNodeId").cloned(),
                    attributes: std::mem::take(&mut self.attributes),
                    references: Vec::new(),
                });
            }
            DEEPEST.. => return Err(UnreadNodeSet::TooDeep),
            _ => {}
        }
        self.path.push(name);
        Ok(())
    }

    fn close(&mut self) -> Result<(), UnreadNodeSet> {
        let path: Vec<&str> = self.path.iter().map(String::as_str).collect();
        let text = self.text.trim().to_owned();
        match path.as_slice() {
            [_, "NamespaceUris", "Uri"] => self.uris.push(text),
            [_, "Aliases", "Alias"] => {
                if let Some(alias) = self.attributes.remove("Alias") {
                    self.aliases.insert(alias, text);
                }
            }
            [_, _, "References", "Reference"] => {
                let kind = self.attributes.remove("ReferenceType").unwrap_or_default();
                let forward = self
                    .attributes
                    .get("IsForward")
                    .is_none_or(|it| it != "false");
                if let Some(node) = &mut self.node {
                    node.references.push((kind, forward, text));
                }
            }
            [_, kind] => {
                let kind = (*kind).to_owned();
                if let Some(node) = self.node.take() {
                    self.keep(&kind, node)?;
                }
            }
            _ => {}
        }
        self.text.clear();
        self.path.pop();
        Ok(())
    }

    fn keep(&mut self, kind: &str, mut node: NodeSetEntry) -> Result<(), UnreadNodeSet> {
        let text = node.attributes.get("NodeId").map(String::as_str);
        let id = self.resolve(text.unwrap_or_default())?;
        let references = std::mem::take(&mut node.references);
        let mut kept = Vec::new();
        for (reference, forward, target) in references {
            let reference = self.resolve(&reference)?;
            let target = self.resolve(&target)?;
            let Identifier::Numeric(number) = reference.identifier else {
                continue;
            };
            match (reference.namespace, number, forward) {
                (0, HAS_PROPERTY, true) => self.properties.extend([target]),
                (0, HAS_PROPERTY, false) => self.properties.extend([id.clone()]),
                (0, HAS_SUBTYPE, false) => self.supertypes.extend([(id.clone(), target)]),
                (0, HAS_MODELLING_RULE, true) => self.types.extend([id.clone()]),
                (0, ORGANIZES | HAS_COMPONENT, false) => kept.push(target),
                _ => {}
            }
        }
        if node.parent.is_none() {
            node.parent = kept.first().map(ToString::to_string);
        }
        match kind {
            "UAVariable" if self.variables.len() >= MOST => {
                return Err(UnreadNodeSet::TooMany);
            }
            "UAVariable" => self.variables.push((id, node)),
            "UAObject" => self.objects.extend([(id, node)]),
            "UAObjectType" | "UAVariableType" | "UAMethod" => self.types.extend([id]),
            _ => {}
        }
        Ok(())
    }

    /// Parses a node id, or resolves its alias.
    fn resolve(&self, text: &str) -> Result<NodeIdText, UnreadNodeSet> {
        let text = self.aliases.get(text).map_or(text, String::as_str);
        text.parse().map_err(|_| {
            let shown: String = text.chars().take(64).collect();
            UnreadNodeSet::NodeId(shown.escape_debug().to_string())
        })
    }

    fn nodes(self, place: &str) -> Result<SurveyedNodes, UnreadNodeSet> {
        let variables: HashSet<&NodeIdText> = self.variables.iter().map(|(id, _)| id).collect();
        let mut found = Vec::new();
        for (id, node) in &self.variables {
            if id.namespace == 0 || self.properties.contains(id) || self.types.contains(id) {
                continue;
            }
            if usize::from(id.namespace) > self.uris.len() {
                return Err(UnreadNodeSet::Namespace { id: id.clone() });
            }
            let parent = match &node.parent {
                Some(text) => Some(self.resolve(text)?),
                None => None,
            };
            if parent.as_ref().is_some_and(|id| variables.contains(id))
                || self.is_declaration(parent.clone())?
            {
                continue;
            }
            let within = parent.and_then(|parent| self.objects.get(&parent));
            found.push(UaVariable {
                source: None,
                node: id.clone(),
                name: browse_name(node),
                within: within.map(browse_name).unwrap_or_default(),
                value: self.value(node)?,
            });
        }
        let mut namespaces = vec!["http://opcfoundation.org/UA/".to_owned()];
        namespaces.extend(self.uris);
        Ok(SurveyedNodes {
            place: format!("NodeSet {place}"),
            server: None,
            namespaces,
            variables: found,
            methods: Vec::new(),
        })
    }

    /// Returns true if the chain of parent objects ends at a type or Method.
    fn is_declaration(&self, mut parent: Option<NodeIdText>) -> Result<bool, UnreadNodeSet> {
        for _ in 0..DEEPEST {
            let Some(id) = parent else { return Ok(false) };
            if self.types.contains(&id) {
                return Ok(true);
            }
            let above = self
                .objects
                .get(&id)
                .and_then(|node| node.parent.as_deref());
            parent = above.map(|text| self.resolve(text)).transpose()?;
        }
        Ok(false)
    }

    fn value(&self, node: &NodeSetEntry) -> Result<Option<(BuiltinType, bool)>, UnreadNodeSet> {
        // The defaults are BaseDataType and a scalar (UANodeSet.xsd).
        let rank = node.attributes.get("ValueRank");
        let rank = rank
            .map_or(Ok(-1), |text| text.trim().parse())
            .map_err(|_| {
                let id = node.attributes.get("NodeId").map_or("", String::as_str);
                UnreadNodeSet::ValueRank(id.to_owned())
            })?;
        let Some(text) = node.attributes.get("DataType") else {
            return Ok(None);
        };
        let mut id = self.resolve(text)?;
        for _ in 0..DEEPEST {
            if id.namespace == 0
                && let Identifier::Numeric(number) = id.identifier
            {
                let builtin = match number {
                    STRUCTURE => Some(BuiltinType::ExtensionObject),
                    _ => data_types::builtin(number),
                };
                if let Some(builtin) = builtin {
                    return Ok(data_types::ranked(builtin, rank));
                }
            }
            match self.supertypes.get(&id) {
                Some(above) => id = above.clone(),
                None => break,
            }
        }
        Ok(None)
    }
}

/// Returns the BrowseName without its namespace index.
fn browse_name(node: &NodeSetEntry) -> String {
    let text = node.attributes.get("BrowseName").map_or("", String::as_str);
    let name = text
        .split_once(':')
        .filter(|(index, _)| index.bytes().all(|b| b.is_ascii_digit()))
        .map_or(text, |(_, name)| name);
    name.to_owned()
}

/// Maximum size of a file in bytes, about five times the NodeSet of the standard.
const LARGEST: u64 = 64 << 20;
const DEEPEST: usize = 64;
/// ReferenceTypes of namespace 0.
const ORGANIZES: u32 = 35;
const HAS_MODELLING_RULE: u32 = 37;
const HAS_SUBTYPE: u32 = 45;
const HAS_PROPERTY: u32 = 46;
const HAS_COMPONENT: u32 = 47;

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const LINE: &str = r#"<?xml version="1.0" encoding="utf-8"?>
<UANodeSet xmlns="http://opcfoundation.org/UA/2011/03/UANodeSet.xsd">
  <NamespaceUris><Uri>urn:line</Uri></NamespaceUris>
  <Aliases>
    <Alias Alias="Boolean">i=1</Alias><Alias Alias="HasComponent">i=47</Alias><Alias Alias="HasProperty">i=46</Alias>
    <Alias Alias="HasSubtype">i=45</Alias><Alias Alias="Organizes">i=35</Alias>
  </Aliases>
  <UADataType NodeId="ns=1;i=3001" BrowseName="1:Mode">
    <References><Reference ReferenceType="HasSubtype" IsForward="false">i=29</Reference></References>
  </UADataType>
  <UAObjectType NodeId="ns=1;i=1001" BrowseName="1:ConveyorType"/>
  <UAVariable NodeId="ns=1;i=1002" BrowseName="1:Running" ParentNodeId="ns=1;i=1001" DataType="Boolean"/>
  <UAObject NodeId="ns=1;i=5001" BrowseName="1:Conveyor">
    <References><Reference ReferenceType="Organizes" IsForward="false">i=85</Reference></References>
  </UAObject>
  <UAVariable NodeId="ns=1;i=6001" BrowseName="1:Running" ParentNodeId="ns=1;i=5001" DataType="Boolean"/>
  <UAVariable NodeId="ns=1;s=Line.Mode" BrowseName="1:Mode" DataType="ns=1;i=3001" ValueRank="1">
    <References><Reference ReferenceType="HasComponent" IsForward="false">ns=1;i=5001</Reference></References>
  </UAVariable>
  <UAVariable NodeId="ns=1;i=6003" BrowseName="1:Unit &amp; range" DataType="i=12" ParentNodeId="ns=1;i=6001">
    <References><Reference ReferenceType="HasProperty" IsForward="false">ns=1;i=6001</Reference></References>
  </UAVariable>
</UANodeSet>"#;

    #[test]
    fn values_are_told_from_properties_declarations_and_types() {
        let nodes = parse(LINE, "line.xml").unwrap();
        assert_eq!(
            nodes.namespaces,
            ["http://opcfoundation.org/UA/", "urn:line"]
        );
        let told: Vec<(String, &str, &str, _)> = nodes
            .variables
            .iter()
            .map(|one| {
                (
                    one.node.to_string(),
                    one.name.as_str(),
                    one.within.as_str(),
                    one.value,
                )
            })
            .collect();
        assert_eq!(
            told,
            [
                (
                    "ns=1;i=6001".to_owned(),
                    "Running",
                    "Conveyor",
                    Some((BuiltinType::Boolean, false))
                ),
                (
                    "ns=1;s=Line.Mode".to_owned(),
                    "Mode",
                    "Conveyor",
                    Some((BuiltinType::Int32, true))
                ),
            ]
        );
    }

    #[test]
    fn what_is_no_node_set_is_refused_with_the_reason() {
        let refused = |xml: &str| parse(xml, "x").unwrap_err().what.to_string();
        assert!(refused("").contains("no <UANodeSet>"));
        assert!(refused("<html/>").contains("this is a <html>"));
        assert!(refused("<UANodeSet>").contains("ends in the middle"));
        assert!(refused("<!DOCTYPE x [<!ENTITY a \"aaaa\">]><UANodeSet/>").contains("DOCTYPE"));
        assert!(refused("<UANodeSet>&a;</UANodeSet>").contains("entity"));
        let odd = LINE.replace("ns=1;i=6001\" BrowseName", "ns=1;q=1\" BrowseName");
        assert!(refused(&odd).contains("`ns=1;q=1` is neither"));
        let odd = LINE.replace("<Uri>urn:line</Uri>", "");
        assert!(refused(&odd).contains("has no entry 1"));
        let deep = format!("<UANodeSet>{}", "<a>".repeat(100_000));
        assert!(refused(&deep).contains("nested deeper"));
        // A type that is its own supertype has no builtin type.
        let round = LINE.replace("\"false\">i=29<", "\"false\">ns=1;i=3001<");
        assert_eq!(parse(&round, "x").unwrap().variables[1].value, None);
    }

    proptest! {
        #[test]
        fn no_bytes_end_the_program(at in 0..LINE.len(), cut in 0..40_usize, put in "[<>&\"=a-z;/! ]{0,12}") {
            let (start, end) = (LINE.get(..at).unwrap(), LINE.get(at + cut..).unwrap_or(""));
            parse(&format!("{start}{put}{end}"), "x").ok();
        }
    }
}
