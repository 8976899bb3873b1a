//! Reads the variables of a NodeSet, an XML file by `UANodeSet.xsd` (OPC 10000-6, F).

use std::collections::{HashMap, HashSet};
use std::path::Path;

use mappings::{Identifier, NodeIdText};
use nodeset_files::{MAX_FILE, NodeSetDocument, NodeSetFileFault, NodeSetFileNode};
use uadp::BuiltinType;

use super::data_types::{self, STRUCTURE};
use super::{MOST, SurveyedNodes, UaVariable};
use crate::exit::CommandFailure;

/// Reads the variables of a NodeSet file.
pub(crate) fn survey(file: &str) -> Result<SurveyedNodes, CommandFailure> {
    let largest = u64::try_from(MAX_FILE).unwrap_or(u64::MAX);
    let bytes = type_files::read_bounded(Path::new(file), largest)
        .map_err(|why| CommandFailure::Io(format!("cannot read {file}: {why}")))?;
    let xml =
        xml_text::decode(&bytes).map_err(|why| CommandFailure::Data(format!("{file}: {why}")))?;
    parse(&xml, file).map_err(|fault| CommandFailure::Data(fault.located(file)))
}

/// The reason why the variables of a NodeSet are not read.
#[derive(Debug, thiserror::Error)]
enum SurveyFault {
    /// The file is not read.
    #[error(transparent)]
    File(#[from] NodeSetFileFault),
    /// A node of the file is not usable.
    #[error("line {line}: {fault}")]
    Node {
        /// The line of the node, from 1.
        line: usize,
        /// The fault.
        fault: UnusableNode,
    },
}

impl SurveyFault {
    /// Returns the fault with its location in the file.
    fn located(&self, file: &str) -> String {
        match self {
            Self::File(NodeSetFileFault::Document { line, fault }) => {
                format!("{file}:{line}: {fault}")
            }
            Self::File(fault) => format!("{file}: {fault}"),
            Self::Node { line, fault } => format!("{file}:{line}: {fault}"),
        }
    }
}

/// The reason why a node is not usable.
#[derive(Debug, thiserror::Error)]
enum UnusableNode {
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
    let document = NodeSetDocument::read(xml)?;
    let mut set = NodeSet::new(&document);
    for node in &document.nodes {
        let line = node.line;
        set.add(node)
            .map_err(|fault| SurveyFault::Node { line, fault })?;
    }
    let variables = set.values()?;
    let mut namespaces = vec!["http://opcfoundation.org/UA/".to_owned()];
    namespaces.extend(document.namespaces.iter().cloned());
    Ok(SurveyedNodes {
        place: format!("NodeSet {place}"),
        server: None,
        namespaces,
        variables,
        methods: Vec::new(),
    })
}

/// The nodes of a document by their meaning.
struct NodeSet<'d> {
    document: &'d NodeSetDocument,
    variables: Vec<NodeSetEntry<'d>>,
    objects: HashMap<NodeIdText, NodeSetEntry<'d>>,
    /// Types and Methods; nodes below them are declarations, not values.
    types: HashSet<NodeIdText>,
    /// Supertypes of DataTypes.
    supertypes: HashMap<NodeIdText, NodeIdText>,
    properties: HashSet<NodeIdText>,
}

/// A node, and its parent as written.
struct NodeSetEntry<'d> {
    id: NodeIdText,
    node: &'d NodeSetFileNode,
    parent: Option<String>,
}

impl<'d> NodeSet<'d> {
    fn new(document: &'d NodeSetDocument) -> Self {
        Self {
            document,
            variables: Vec::new(),
            objects: HashMap::new(),
            types: HashSet::new(),
            supertypes: HashMap::new(),
            properties: HashSet::new(),
        }
    }

    fn add(&mut self, node: &'d NodeSetFileNode) -> Result<(), UnusableNode> {
        let id = self.resolve(&node.id)?;
        let mut parents = Vec::new();
        for one in &node.references {
            let reference = self.resolve(&one.reference_type)?;
            let target = self.resolve(&one.target)?;
            let Identifier::Numeric(number) = reference.identifier else {
                continue;
            };
            match (reference.namespace, number, one.is_forward) {
                (0, HAS_PROPERTY, true) => self.properties.extend([target]),
                (0, HAS_PROPERTY, false) => self.properties.extend([id.clone()]),
                (0, HAS_SUBTYPE, false) => self.supertypes.extend([(id.clone(), target)]),
                (0, HAS_MODELLING_RULE, true) => self.types.extend([id.clone()]),
                (0, ORGANIZES | HAS_COMPONENT, false) => parents.push(target),
                _ => {}
            }
        }
        let parent = node.parent.clone();
        let parent = parent.or_else(|| parents.first().map(ToString::to_string));
        let entry = NodeSetEntry { id, node, parent };
        match node.class.as_str() {
            "Variable" if self.variables.len() >= MOST => return Err(UnusableNode::TooMany),
            "Variable" => self.variables.push(entry),
            "Object" => self.objects.extend([(entry.id.clone(), entry)]),
            "ObjectType" | "VariableType" | "Method" => self.types.extend([entry.id]),
            _ => {}
        }
        Ok(())
    }

    /// Parses a node id, or resolves its alias.
    fn resolve(&self, text: &str) -> Result<NodeIdText, UnusableNode> {
        let text = self.document.resolved(text);
        text.parse().map_err(|_| {
            let shown: String = text.chars().take(64).collect();
            UnusableNode::NodeId(shown.escape_debug().to_string())
        })
    }

    /// Returns the variables with values, without properties and declarations.
    fn values(&self) -> Result<Vec<UaVariable>, SurveyFault> {
        let ids: HashSet<&NodeIdText> = self.variables.iter().map(|entry| &entry.id).collect();
        let mut found = Vec::new();
        for entry in &self.variables {
            let line = entry.node.line;
            let variable = self.variable(entry, &ids);
            found.extend(variable.map_err(|fault| SurveyFault::Node { line, fault })?);
        }
        Ok(found)
    }

    fn variable(
        &self,
        entry: &NodeSetEntry<'_>,
        variables: &HashSet<&NodeIdText>,
    ) -> Result<Option<UaVariable>, UnusableNode> {
        let NodeSetEntry { id, node, parent } = entry;
        if id.namespace == 0 || self.properties.contains(id) || self.types.contains(id) {
            return Ok(None);
        }
        if usize::from(id.namespace) > self.document.namespaces.len() {
            return Err(UnusableNode::Namespace { id: id.clone() });
        }
        let parent = parent.as_deref().map(|text| self.resolve(text));
        let parent = parent.transpose()?;
        if parent.as_ref().is_some_and(|id| variables.contains(id))
            || self.is_declaration(parent.clone())?
        {
            return Ok(None);
        }
        let within = parent.and_then(|parent| self.objects.get(&parent));
        let within = within.map(|object| object.node.plain_browse_name());
        Ok(Some(UaVariable {
            source: None,
            node: id.clone(),
            name: node.plain_browse_name().to_owned(),
            within: within.unwrap_or_default().to_owned(),
            value: self.value(node)?,
        }))
    }

    /// Returns true if the chain of parent objects ends at a type or Method.
    fn is_declaration(&self, mut parent: Option<NodeIdText>) -> Result<bool, UnusableNode> {
        for _ in 0..DEEPEST {
            let Some(id) = parent else { return Ok(false) };
            if self.types.contains(&id) {
                return Ok(true);
            }
            let above = self
                .objects
                .get(&id)
                .and_then(|object| object.parent.as_deref());
            parent = above.map(|text| self.resolve(text)).transpose()?;
        }
        Ok(false)
    }

    fn value(&self, node: &NodeSetFileNode) -> Result<Option<(BuiltinType, bool)>, UnusableNode> {
        // The defaults are BaseDataType and a scalar (UANodeSet.xsd).
        let rank = node.value_rank.as_deref();
        let rank = rank.map_or(Ok(-1), |text| text.trim().parse());
        let rank = rank.map_err(|_| UnusableNode::ValueRank(node.id.clone()))?;
        let Some(text) = &node.data_type else {
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

/// Largest number of parents of an object, and of supertypes of a DataType.
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
        let refused = |xml: &str| parse(xml, "x").unwrap_err().to_string();
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
