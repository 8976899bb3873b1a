//! Nodes as plain data, read from a NodeSet2 file or from a server, for their statements.

use roxmltree::Document;
use serde_json::Value;

use super::values;
use crate::component::NodeName;

/// A node of OPC UA.
#[derive(Debug, Clone, PartialEq)]
pub struct OntologyNode {
    /// Its NodeClass.
    pub class: OwlNodeClass,
    /// Its NodeId.
    pub name: NodeName,
    /// Its BrowseName, without a namespace.
    pub browse_name: String,
    /// Its texts.
    pub texts: Vec<OntologyText>,
    /// Its DataType, of a variable or VariableType.
    pub data_type: Option<NodeName>,
    /// Its other attributes: the name and the value as a NodeSet2 file has them, without attributes
    /// that have their default value.
    pub attributes: Vec<(&'static str, String)>,
    /// Its references, in both directions.
    pub references: Vec<OntologyReference>,
    /// The definition of a DataType.
    pub definition: Option<OntologyDefinition>,
    /// Its value.
    pub value: Option<OntologyValue>,
}

/// The class of a node (OPC 10000-3, 5.2).
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[expect(missing_docs, reason = "the names are those of the standard")]
pub enum OwlNodeClass {
    DataType,
    Method,
    Object,
    ObjectType,
    ReferenceType,
    Variable,
    VariableType,
    View,
}

impl OwlNodeClass {
    const ALL: [Self; 8] = [
        Self::DataType,
        Self::Method,
        Self::Object,
        Self::ObjectType,
        Self::ReferenceType,
        Self::Variable,
        Self::VariableType,
        Self::View,
    ];

    /// Returns the class of an element of a NodeSet2 file, such as `UAObject`.
    #[must_use]
    pub fn of_element(name: &str) -> Option<Self> {
        let name = name.strip_prefix("UA")?;
        Self::ALL.into_iter().find(|class| class.name() == name)
    }

    /// Returns its name in the standard.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::DataType => "DataType",
            Self::Method => "Method",
            Self::Object => "Object",
            Self::ObjectType => "ObjectType",
            Self::ReferenceType => "ReferenceType",
            Self::Variable => "Variable",
            Self::VariableType => "VariableType",
            Self::View => "View",
        }
    }

    /// Returns whether nodes of the class are types, which all servers have under the same IRI.
    #[must_use]
    pub const fn is_type(self) -> bool {
        match self {
            Self::DataType | Self::ObjectType | Self::ReferenceType | Self::VariableType => true,
            Self::Method | Self::Object | Self::Variable | Self::View => false,
        }
    }
}

/// The attribute or element that has a text.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum OntologyTextKind {
    /// DisplayName.
    Label,
    /// Description.
    Comment,
    /// InverseName of a ReferenceType.
    Inverse,
}

/// A text of a node in a language.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct OntologyText {
    /// The attribute that has it.
    pub kind: OntologyTextKind,
    /// The text.
    pub text: String,
    /// Its locale; empty if unknown.
    pub locale: String,
}

/// A reference of a node.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct OntologyReference {
    /// Its ReferenceType.
    pub of_type: NodeName,
    /// Whether it leads from the node to the target.
    pub is_forward: bool,
    /// The other node.
    pub target: NodeName,
}

/// The definition of a structure, an enumeration or an option set.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct OntologyDefinition {
    /// Whether the structure is a union.
    pub is_union: bool,
    /// Whether the enumeration is an option set.
    pub is_option_set: bool,
    /// Its fields, in order.
    pub fields: Vec<OntologyField>,
}

/// A field of a structure, or a value of an enumeration.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct OntologyField {
    /// Its name.
    pub name: String,
    /// The number of a value of an enumeration, as text.
    pub value: Option<String>,
    /// The DataType of a field of a structure.
    pub data_type: Option<NodeName>,
    /// Its other attributes, as those of [`OntologyNode`].
    pub attributes: Vec<(&'static str, String)>,
    /// Its texts.
    pub texts: Vec<OntologyText>,
}

/// The value of a variable.
#[derive(Debug, Clone, PartialEq)]
pub enum OntologyValue {
    /// A text.
    Text(String),
    /// A text in a language.
    Localized {
        /// The text.
        text: String,
        /// Its locale; empty if unknown.
        locale: String,
    },
    /// A literal: its text and its datatype in XML Schema, such as `double`.
    Typed(String, &'static str),
    /// A node.
    Node(NodeName),
    /// An array or a structure.
    Json(Value),
}

impl OntologyValue {
    /// Returns a scalar by the name of its built-in type and its text; `None` if the type has other
    /// parts than a text.
    #[must_use]
    pub fn scalar(built_in: &str, text: &str) -> Option<Self> {
        let datatype = match built_in {
            "Boolean" => "boolean",
            "SByte" | "Byte" | "Int16" | "UInt16" | "Int32" | "UInt32" | "Int64" | "UInt64" => {
                "integer"
            }
            "Float" | "Double" => "double",
            "DateTime" => "dateTime",
            "ByteString" => "base64Binary",
            "String" => return Some(Self::Text(text.to_owned())),
            "Guid" => return Some(Self::Text(text.trim().to_owned())),
            _ => return None,
        };
        Some(Self::Typed(text.trim().to_owned(), datatype))
    }

    /// Reads a value from its XML encoding (OPC 10000-6, 5.3): an element such as `ListOfInt32`.
    /// `None` if it is no XML, or nests too deep.
    #[must_use]
    pub fn from_xml(xml: &str) -> Option<Self> {
        let document = Document::parse(xml).ok()?;
        values::json(document.root_element(), 0).map(Self::Json)
    }
}
