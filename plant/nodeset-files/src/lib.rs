//! NodeSet2 files (OPC 10000-6, annex F) as documents: namespaces, aliases, models, and nodes with
//! their references. Of the values, only ranges and units are read.
//!
//! A file is not trusted: its size, the number and depth of its elements are bounded, and a
//! document type is refused. NodeIds stay as written; [`NodeSetDocument::resolved`] applies the
//! aliases.
//!
//! The server imports NodeSets with the reader of its OPC UA library, which decodes values too.

mod model;
mod reading;

use std::collections::BTreeMap;

use xml_text::{LocatedXmlFault, XmlAttributeFault, XmlFault, walk};

pub use self::model::{ModelVersion, NodeSetModel};
use self::reading::{NodeSetReading, ReadingExtent};

/// A NodeSet2 file.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct NodeSetDocument {
    /// The URIs of its namespace table, which begins at index 1.
    pub namespaces: Vec<String>,
    /// The NodeIds of the aliases.
    pub aliases: BTreeMap<String, String>,
    /// The first model, which is that of the file.
    pub model: Option<NodeSetModel>,
    /// The nodes, in the order of the file.
    pub nodes: Vec<NodeSetFileNode>,
}

/// A node of a NodeSet2 file. Texts are as written, and empty or `None` if they are missing.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct NodeSetFileNode {
    /// The line of its start, from 1.
    pub line: usize,
    /// The NodeClass, such as `ObjectType`.
    pub class: String,
    /// The NodeId.
    pub id: String,
    /// The BrowseName with its namespace index.
    pub browse_name: String,
    /// The NodeId of the parent.
    pub parent: Option<String>,
    /// The NodeId of the DataType, or its alias.
    pub data_type: Option<String>,
    /// The ValueRank.
    pub value_rank: Option<String>,
    /// Whether a type is abstract.
    pub is_abstract: bool,
    /// The first DisplayName.
    pub display_name: String,
    /// The first Description.
    pub description: String,
    /// The references.
    pub references: Vec<NodeSetFileReference>,
    /// The value of a variable with a single range, such as an EURange.
    pub range: Option<NodeSetFileRange>,
    /// The value of a variable with a single unit, such as EngineeringUnits.
    pub unit: Option<NodeSetFileUnit>,
}

/// A value of the DataType Range (OPC 10000-8, 5.6.2).
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct NodeSetFileRange {
    /// The lowest value.
    pub low: String,
    /// The highest value.
    pub high: String,
}

/// A value of the DataType EUInformation (OPC 10000-8, 5.6.4.3).
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct NodeSetFileUnit {
    /// The URI of the organisation that defines the unit.
    pub namespace: String,
    /// The UnitId.
    pub id: String,
    /// The text of the DisplayName, which is the symbol.
    pub symbol: String,
}

/// A reference of a node. NodeIds are as written, or aliases.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct NodeSetFileReference {
    /// The NodeId of the ReferenceType.
    pub reference_type: String,
    /// Whether the node is the source.
    pub is_forward: bool,
    /// The NodeId of the other node.
    pub target: String,
}

/// Reason for which a file is not read.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum NodeSetFileFault {
    /// The file exceeds the limit.
    #[error("the file has {length} bytes, more than the {most} that are read")]
    TooLarge {
        /// Size of the file.
        length: usize,
        /// The limit.
        most: usize,
    },
    /// The file is not XML, incomplete, or exceeds a limit.
    #[error("line {line}: {fault}")]
    Document {
        /// Line, from 1.
        line: usize,
        /// The fault.
        fault: XmlFault<NodeSetElementFault>,
    },
    /// The file has no elements.
    #[error("there is no <UANodeSet> in it")]
    Empty,
}

/// Reason for which an element of a NodeSet is not read.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum NodeSetElementFault {
    /// The file has another root element.
    #[error("this is a <{0}>, no <UANodeSet>")]
    Root(String),
    /// An attribute is malformed.
    #[error(transparent)]
    Attribute(#[from] XmlAttributeFault),
    /// There are too many nodes.
    #[error("there are more than {0} nodes")]
    Nodes(usize),
    /// The model requires too many models.
    #[error("the model requires more than {0} models")]
    Required(usize),
}

impl NodeSetFileFault {
    /// Returns whether the file is XML of another format, or empty.
    #[must_use]
    pub const fn is_other_format(&self) -> bool {
        matches!(
            self,
            Self::Empty
                | Self::Document {
                    fault: XmlFault::Refused(NodeSetElementFault::Root(_)),
                    ..
                }
        )
    }
}

impl NodeSetDocument {
    /// Reads the text of a file.
    ///
    /// # Errors
    /// [`NodeSetFileFault`].
    pub fn read(xml: &str) -> Result<Self, NodeSetFileFault> {
        read(xml, ReadingExtent::Whole)
    }

    /// Reads the text of a file up to the end of its models. The text may end there.
    ///
    /// # Errors
    /// [`NodeSetFileFault`].
    pub fn read_models(xml: &str) -> Result<Self, NodeSetFileFault> {
        read(xml, ReadingExtent::Models)
    }

    /// Returns the NodeId for a NodeId or an alias.
    #[must_use]
    pub fn resolved<'t>(&'t self, written: &'t str) -> &'t str {
        self.aliases.get(written).map_or(written, String::as_str)
    }
}

impl NodeSetFileUnit {
    /// Returns the common code of UN/ECE Recommendation 20 that the UnitId has, such as `KGM`;
    /// `None` if another organisation defines the unit.
    #[must_use]
    pub fn unece_code(&self) -> Option<String> {
        let id: u32 = self.id.parse().ok()?;
        let bytes = id.to_be_bytes().into_iter().skip_while(|byte| *byte == 0);
        let code: String = bytes.map(char::from).collect();
        let is_code = !code.is_empty() && code.bytes().all(|byte| byte.is_ascii_alphanumeric());
        (self.namespace == UNECE && is_code).then_some(code)
    }
}

impl NodeSetFileNode {
    /// Returns the BrowseName without its namespace index.
    #[must_use]
    pub fn plain_browse_name(&self) -> &str {
        match self.browse_name.split_once(':') {
            Some((index, name)) if index.bytes().all(|byte| byte.is_ascii_digit()) => name,
            _ => &self.browse_name,
        }
    }
}

fn read(xml: &str, extent: ReadingExtent) -> Result<NodeSetDocument, NodeSetFileFault> {
    if xml.len() > MAX_FILE {
        return Err(NodeSetFileFault::TooLarge {
            length: xml.len(),
            most: MAX_FILE,
        });
    }
    let mut reading = NodeSetReading::new(extent);
    let walked = walk(xml, MAX_DEPTH, &mut reading);
    walked.map_err(|LocatedXmlFault { line, fault }| NodeSetFileFault::Document { line, fault })?;
    reading.finish().ok_or(NodeSetFileFault::Empty)
}

/// Limit of the size of a file, in bytes. The largest published file has 13 MB.
pub const MAX_FILE: usize = 64 << 20;
/// Limit of the number of nodes of a file.
pub const MAX_NODES: usize = 200_000;
const MAX_DEPTH: usize = 64;
/// The URI of the units that common codes name.
const UNECE: &str = "http://www.opcfoundation.org/UA/units/un/cefact";
const MAX_REQUIRED: usize = 256;

#[cfg(test)]
mod tests {
    use super::*;

    const FILE: &str = r#"<?xml version="1.0" encoding="utf-8"?>
<UANodeSet xmlns="http://opcfoundation.org/UA/2011/03/UANodeSet.xsd">
  <NamespaceUris><Uri>urn:line</Uri><Uri> urn:other </Uri></NamespaceUris>
  <Models>
    <Model ModelUri="urn:line" Version="1.2" PublicationDate="2026-01-02T00:00:00Z">
      <RequiredModel ModelUri="urn:other" Version="3"/>
    </Model>
    <Model ModelUri="urn:second"><RequiredModel ModelUri="urn:third"/></Model>
  </Models>
  <Aliases><Alias Alias="HasComponent">i=47</Alias></Aliases>
  <UAObjectType NodeId="ns=1;i=1001" BrowseName="1:ConveyorType" IsAbstract="true"/>
  <UAVariable NodeId="ns=1;i=6001" BrowseName="1:Unit &amp; range" ParentNodeId="ns=1;i=1001" DataType="Boolean" ValueRank="1">
    <DisplayName>Range</DisplayName><DisplayName Locale="de">Bereich</DisplayName>
    <Description>Of &lt;all&gt;</Description>
    <References>
      <Reference ReferenceType="HasComponent" IsForward="false"> ns=1;i=1001 </Reference>
      <Reference ReferenceType="i=37">i=78</Reference>
    </References>
    <Value><Text>not read</Text></Value>
  </UAVariable>
</UANodeSet>"#;

    #[test]
    fn namespaces_aliases_models_and_nodes_are_as_in_the_file() {
        let document = NodeSetDocument::read(FILE).unwrap();
        assert_eq!(document.namespaces, ["urn:line", "urn:other"]);
        assert_eq!(document.resolved("HasComponent"), "i=47");
        assert_eq!(document.resolved("i=46"), "i=46");
        let model = document.model.as_ref().unwrap();
        assert_eq!(model.namespace, "urn:line");
        assert_eq!(model.version.version, "1.2");
        let required: Vec<&str> = model.required.iter().map(|(uri, _)| uri.as_str()).collect();
        assert_eq!(required, ["urn:other"], "those of the first model");
        let [conveyor, range] = &document.nodes[..] else {
            panic!("{:?}", document.nodes);
        };
        assert_eq!(
            (conveyor.class.as_str(), conveyor.is_abstract),
            ("ObjectType", true)
        );
        assert_eq!((conveyor.line, range.line), (11, 12));
        assert_eq!(range.plain_browse_name(), "Unit & range");
        assert_eq!(range.parent.as_deref(), Some("ns=1;i=1001"));
        assert_eq!(range.data_type.as_deref(), Some("Boolean"));
        assert_eq!(range.value_rank.as_deref(), Some("1"));
        assert_eq!(range.display_name, "Range");
        assert_eq!(range.description, "Of <all>");
        let reference = |of: &str, is_forward, target: &str| NodeSetFileReference {
            reference_type: of.to_owned(),
            is_forward,
            target: target.to_owned(),
        };
        let references = [
            reference("HasComponent", false, "ns=1;i=1001"),
            reference("i=37", true, "i=78"),
        ];
        assert_eq!(range.references, references);
    }

    #[test]
    fn a_range_and_a_unit_are_read_from_the_values_of_their_nodes() {
        let value = |body: &str| {
            let xml = format!(
                "<UANodeSet><UAVariable NodeId='i=1'><Value><ExtensionObject><TypeId>\
                 <Identifier>i=885</Identifier></TypeId><Body>{body}</Body></ExtensionObject>\
                 </Value></UAVariable></UANodeSet>"
            );
            let document = NodeSetDocument::read(&xml).unwrap();
            document.nodes.into_iter().next().unwrap()
        };
        let range = value("<Range><Low>-1.5</Low><High> 5 </High></Range>");
        let (low, high) = ("-1.5".to_owned(), "5".to_owned());
        assert_eq!(range.range, Some(NodeSetFileRange { low, high }));
        assert_eq!(range.unit, None);
        let unit = |namespace: &str, id: &str| {
            let body = format!(
                "<EUInformation><NamespaceUri>{namespace}</NamespaceUri><UnitId>{id}</UnitId>\
                 <DisplayName><Locale>en</Locale><Text>kg</Text></DisplayName>\
                 <Description><Text>kilogram</Text></Description></EUInformation>"
            );
            let unit = value(&body).unit.unwrap();
            assert_eq!(unit.symbol, "kg");
            unit.unece_code()
        };
        assert_eq!(unit(UNECE, "4933453").as_deref(), Some("KGM"));
        assert_eq!(unit(UNECE, "17476").as_deref(), Some("DD"));
        for (namespace, id) in [
            ("urn:maker", "4933453"),
            (UNECE, "0"),
            (UNECE, "-1"),
            (UNECE, "kg"),
            (UNECE, "4294967295"),
        ] {
            assert_eq!(unit(namespace, id), None, "{namespace} {id}");
        }
        let other = value("<Argument><Name>Low</Name></Argument>");
        assert_eq!((other.range, other.unit), (None, None));
    }

    #[test]
    fn the_models_are_read_from_the_beginning_of_a_file() {
        let (beginning, _) = FILE.split_once("<Aliases>").unwrap();
        let document = NodeSetDocument::read_models(beginning).unwrap();
        assert_eq!(document.model.unwrap().namespace, "urn:line");
        assert!(NodeSetDocument::read(beginning).is_err());
    }

    #[test]
    fn files_of_other_formats_are_told_from_broken_files() {
        let fault = |xml: &str| NodeSetDocument::read(xml).unwrap_err();
        for other in ["", "<html/>", "text"] {
            assert!(fault(other).is_other_format(), "{other}");
        }
        assert!(!fault("<UANodeSet>").is_other_format());
        assert_eq!(
            fault("<html/>").to_string(),
            "line 1: this is a <html>, no <UANodeSet>"
        );
        let deep = format!("<UANodeSet>{}", "<a>".repeat(100_000));
        let told = fault(&deep).to_string();
        assert_eq!(told, "line 1: elements are nested deeper than 64");
        let many = "<RequiredModel ModelUri='urn:b'/>".repeat(MAX_REQUIRED + 1);
        let many = format!("<UANodeSet><Models><Model ModelUri='urn:a'>{many}");
        let told = fault(&many).to_string();
        assert_eq!(told, "line 1: the model requires more than 256 models");
    }
}
