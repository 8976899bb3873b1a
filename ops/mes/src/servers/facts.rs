//! Attributes and values of OPC UA as facts about nodes, with limits of their sizes.

use knowledge::NodeName;
use knowledge::owl::{
    OntologyDefinition, OntologyField, OntologyText, OntologyTextKind, OntologyValue, OwlNodeClass,
};
use plant_opcua::types::xml::{XmlEncodable as _, XmlStreamWriter};
use plant_opcua::types::{
    AttributeId, ByteStringBody, ContextOwned, DataValue, DateTime, DecodingOptions,
    EnumDefinition, ExpandedNodeId, LocalizedText, NamespaceMap, NodeClass, NodeId,
    StructureDefinition, StructureType, UAString, Variant,
};

/// The namespaces of a server, by which it numbers them.
pub(super) struct NamespaceNames {
    uris: Vec<String>,
    context: ContextOwned,
}

/// Reason for which a value is not in the graph.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum UnreadValue {
    /// Larger than the limit.
    TooLarge,
    /// A structure of a DataType that this program cannot decode.
    Undecoded,
}

impl NamespaceNames {
    /// Reads the NamespaceArray of a server.
    pub(super) fn new(uris: Vec<String>) -> Self {
        let mut namespaces = NamespaceMap::new();
        for uri in &uris {
            namespaces.add_namespace(uri);
        }
        Self {
            uris,
            context: ContextOwned::new_default(namespaces, DecodingOptions::default()),
        }
    }

    /// Returns the name of a node; `None` if the server has no such namespace, or the identifier is
    /// too long.
    pub(super) fn name(&self, id: &NodeId) -> Option<NodeName> {
        let uri = self.uris.get(usize::from(id.namespace))?;
        self.in_namespace(uri, id)
    }

    /// Returns the name of a target, and its NodeId if it is a node of the server.
    pub(super) fn target(&self, id: &ExpandedNodeId) -> Option<(NodeName, NodeId)> {
        if id.server_index != 0 {
            return None;
        }
        if id.namespace_uri.is_empty() {
            return Some((self.name(&id.node_id)?, id.node_id.clone()));
        }
        let uri = id.namespace_uri.as_ref();
        let at = self.uris.iter().position(|known| known == uri)?;
        let mut local = id.node_id.clone();
        local.namespace = u16::try_from(at).ok()?;
        Some((self.in_namespace(uri, &local)?, local))
    }

    /// Returns the NodeId of a node at the server.
    pub(super) fn id(&self, name: &NodeName) -> Option<NodeId> {
        let at = self.uris.iter().position(|uri| *uri == name.namespace)?;
        format!("ns={at};{}", name.identifier).parse().ok()
    }

    fn in_namespace(&self, uri: &str, id: &NodeId) -> Option<NodeName> {
        let identifier = id.identifier.to_string();
        let fits = !uri.is_empty() && uri.len() <= LONGEST_NAME && identifier.len() <= LONGEST_NAME;
        fits.then(|| NodeName {
            namespace: uri.to_owned(),
            identifier,
        })
    }

    /// Converts a value. `None` without a value.
    ///
    /// # Errors
    /// [`UnreadValue`].
    pub(super) fn value(&self, value: &Variant) -> Result<Option<OntologyValue>, UnreadValue> {
        let typed = |built_in: &str, text: String| match text.len() <= LARGEST_VALUE {
            true => Ok(OntologyValue::scalar(built_in, &text)),
            false => Err(UnreadValue::TooLarge),
        };
        match value {
            Variant::Empty => Ok(None),
            Variant::Boolean(value) => typed("Boolean", value.to_string()),
            Variant::SByte(value) => typed("SByte", value.to_string()),
            Variant::Byte(value) => typed("Byte", value.to_string()),
            Variant::Int16(value) => typed("Int16", value.to_string()),
            Variant::UInt16(value) => typed("UInt16", value.to_string()),
            Variant::Int32(value) => typed("Int32", value.to_string()),
            Variant::UInt32(value) => typed("UInt32", value.to_string()),
            Variant::Int64(value) => typed("Int64", value.to_string()),
            Variant::UInt64(value) => typed("UInt64", value.to_string()),
            Variant::Float(value) => typed("Float", number(f64::from(*value), value.to_string())),
            Variant::Double(value) => typed("Double", number(*value, value.to_string())),
            Variant::String(text) if text.is_null() => Ok(None),
            Variant::String(text) => typed("String", text.as_ref().to_owned()),
            Variant::DateTime(time) => typed("DateTime", time_text(time)),
            Variant::Guid(guid) => typed("Guid", guid.to_string()),
            Variant::ByteString(bytes) if bytes.is_null() => Ok(None),
            Variant::ByteString(bytes) => typed("ByteString", bytes.as_base64()),
            Variant::LocalizedText(text) if text.text.as_ref().len() <= LARGEST_VALUE => {
                Ok(Some(OntologyValue::Localized {
                    text: text.text.as_ref().to_owned(),
                    locale: locale(&text.locale),
                }))
            }
            Variant::NodeId(id) => Ok(self.name(id).map(OntologyValue::Node)),
            Variant::ExpandedNodeId(id) => {
                Ok(self.target(id).map(|(name, _)| OntologyValue::Node(name)))
            }
            Variant::Variant(inner) => self.value(inner),
            Variant::LocalizedText(_) => Err(UnreadValue::TooLarge),
            Variant::StatusCode(_)
            | Variant::QualifiedName(_)
            | Variant::XmlElement(_)
            | Variant::DataValue(_)
            | Variant::DiagnosticInfo(_) => self.encoded(value),
            Variant::ExtensionObject(object) if object.is_null() => Ok(None),
            Variant::ExtensionObject(object) if object.inner_is::<ByteStringBody>() => {
                Err(UnreadValue::Undecoded)
            }
            Variant::ExtensionObject(_) => self.encoded(value),
            Variant::Array(array) => {
                let is_undecoded = |one: &Variant| {
                    matches!(one, Variant::ExtensionObject(object)
                        if object.inner_is::<ByteStringBody>())
                };
                match array.values.iter().any(is_undecoded) {
                    true => Err(UnreadValue::Undecoded),
                    false => self.encoded(value),
                }
            }
        }
    }

    /// Converts an array or a structure by its XML encoding, which NodeSets have too.
    fn encoded(&self, value: &Variant) -> Result<Option<OntologyValue>, UnreadValue> {
        let mut buffer = vec![0; LARGEST_VALUE];
        let mut rest: &mut [u8] = &mut buffer;
        let written = {
            let out: &mut dyn std::io::Write = &mut rest;
            let mut writer = XmlStreamWriter::new(out);
            value.encode(&mut writer, &self.context.context())
        };
        let is_full = rest.is_empty();
        let length = LARGEST_VALUE.saturating_sub(rest.len());
        match (written, is_full) {
            (Ok(()), _) => {}
            (Err(_), true) => return Err(UnreadValue::TooLarge),
            (Err(_), false) => return Err(UnreadValue::Undecoded),
        }
        let xml = buffer.get(..length).unwrap_or_default();
        let xml = std::str::from_utf8(xml).map_err(|_| UnreadValue::Undecoded)?;
        let value = OntologyValue::from_xml(xml).ok_or(UnreadValue::Undecoded)?;
        Ok(Some(value))
    }

    /// Converts the definition of a DataType.
    pub(super) fn definition(&self, value: &Variant) -> Option<OntologyDefinition> {
        let Variant::ExtensionObject(object) = value else {
            return None;
        };
        if let Some(structure) = object.inner_as::<StructureDefinition>() {
            return Some(self.structure(structure));
        }
        object.inner_as::<EnumDefinition>().map(enumeration)
    }

    fn structure(&self, structure: &StructureDefinition) -> OntologyDefinition {
        let fields = structure.fields.iter().flatten().take(MOST_FIELDS);
        let fields = fields.map(|field| {
            let mut attributes = Vec::new();
            if field.is_optional {
                attributes.push(("IsOptional", "true".to_owned()));
            }
            if field.value_rank != SCALAR {
                attributes.push(("ValueRank", field.value_rank.to_string()));
            }
            OntologyField {
                name: shortened(&field.name),
                value: None,
                data_type: self.name(&field.data_type),
                attributes,
                texts: text(OntologyTextKind::Comment, &field.description)
                    .into_iter()
                    .collect(),
            }
        });
        OntologyDefinition {
            is_union: matches!(
                structure.structure_type,
                StructureType::Union | StructureType::UnionWithSubtypedValues
            ),
            is_option_set: false,
            fields: fields.collect(),
        }
    }
}

fn enumeration(definition: &EnumDefinition) -> OntologyDefinition {
    let fields = definition.fields.iter().flatten().take(MOST_FIELDS);
    let fields = fields.map(|field| OntologyField {
        name: shortened(&field.name),
        value: Some(field.value.to_string()),
        data_type: None,
        attributes: Vec::new(),
        // A NodeSet does not repeat the name as a text.
        texts: text(OntologyTextKind::Comment, &field.description)
            .into_iter()
            .collect(),
    });
    OntologyDefinition {
        is_union: false,
        is_option_set: false,
        fields: fields.collect(),
    }
}

/// Returns the class of a node; `None` if it is unspecified.
pub(super) const fn class(class: NodeClass) -> Option<OwlNodeClass> {
    match class {
        NodeClass::Unspecified => None,
        NodeClass::Object => Some(OwlNodeClass::Object),
        NodeClass::Variable => Some(OwlNodeClass::Variable),
        NodeClass::Method => Some(OwlNodeClass::Method),
        NodeClass::ObjectType => Some(OwlNodeClass::ObjectType),
        NodeClass::VariableType => Some(OwlNodeClass::VariableType),
        NodeClass::ReferenceType => Some(OwlNodeClass::ReferenceType),
        NodeClass::DataType => Some(OwlNodeClass::DataType),
        NodeClass::View => Some(OwlNodeClass::View),
    }
}

/// Returns the attributes to read of nodes of a class, without the value.
pub(super) const fn attributes(class: OwlNodeClass) -> &'static [AttributeId] {
    use AttributeId::{
        AccessLevel, ArrayDimensions, DataType, DataTypeDefinition, Description, EventNotifier,
        Executable, Historizing, InverseName, IsAbstract, Symmetric, ValueRank,
    };
    match class {
        OwlNodeClass::Variable => &[
            Description,
            DataType,
            ValueRank,
            ArrayDimensions,
            AccessLevel,
            Historizing,
        ],
        OwlNodeClass::Object | OwlNodeClass::View => &[Description, EventNotifier],
        OwlNodeClass::Method => &[Description, Executable],
        OwlNodeClass::ObjectType => &[Description, IsAbstract],
        OwlNodeClass::VariableType => &[Description, IsAbstract, DataType, ValueRank],
        OwlNodeClass::DataType => &[Description, IsAbstract, DataTypeDefinition],
        OwlNodeClass::ReferenceType => &[Description, IsAbstract, Symmetric, InverseName],
    }
}

/// Returns an attribute as a NodeSet2 file has it; `None` if it has its default value.
pub(super) fn attribute(id: AttributeId, value: &Variant) -> Option<(&'static str, String)> {
    match (id, value) {
        (AttributeId::ValueRank, Variant::Int32(rank)) if *rank != SCALAR => {
            Some(("ValueRank", rank.to_string()))
        }
        (AttributeId::AccessLevel, Variant::Byte(level)) if *level != READABLE => {
            Some(("AccessLevel", level.to_string()))
        }
        (AttributeId::EventNotifier, Variant::Byte(notifier)) if *notifier != 0 => {
            Some(("EventNotifier", notifier.to_string()))
        }
        (AttributeId::Historizing, Variant::Boolean(true)) => {
            Some(("Historizing", "true".to_owned()))
        }
        (AttributeId::IsAbstract, Variant::Boolean(true)) => {
            Some(("IsAbstract", "true".to_owned()))
        }
        (AttributeId::Symmetric, Variant::Boolean(true)) => Some(("Symmetric", "true".to_owned())),
        (AttributeId::Executable, Variant::Boolean(false)) => {
            Some(("Executable", "false".to_owned()))
        }
        (AttributeId::ArrayDimensions, Variant::Array(array)) if !array.values.is_empty() => {
            let dimensions = array.values.iter().take(MOST_DIMENSIONS);
            let dimensions: Vec<String> = dimensions.map(ToString::to_string).collect();
            Some(("ArrayDimensions", dimensions.join(",")))
        }
        _ => None,
    }
}

/// Returns a text of a node; `None` if it is empty or too long.
pub(super) fn text(kind: OntologyTextKind, text: &LocalizedText) -> Option<OntologyText> {
    let fits = !text.text.is_empty() && text.text.as_ref().len() <= LONGEST_TEXT;
    fits.then(|| OntologyText {
        kind,
        text: text.text.as_ref().to_owned(),
        locale: locale(&text.locale),
    })
}

/// Returns the number of bytes of a value.
pub(super) fn length(value: &OntologyValue) -> usize {
    match value {
        OntologyValue::Text(text) | OntologyValue::Typed(text, _) => text.len(),
        OntologyValue::Localized { text, locale } => text.len() + locale.len(),
        OntologyValue::Node(name) => name.namespace.len() + name.identifier.len(),
        OntologyValue::Json(json) => json.to_string().len(),
    }
}

/// Returns the time at which a value was measured.
pub(super) fn source_time(value: &DataValue) -> Option<String> {
    let time = value.source_timestamp.filter(|time| !time.is_null());
    time.map(|time| time_text(&time))
}

/// Returns a time as `xsd:dateTime`.
pub(super) fn time_text(time: &DateTime) -> String {
    time.to_rfc3339()
}

fn number(value: f64, text: String) -> String {
    // The lexical forms of XML Schema.
    if value.is_infinite() {
        return if value > 0.0 { "INF" } else { "-INF" }.to_owned();
    }
    text
}

fn locale(locale: &UAString) -> String {
    let text = locale.as_ref();
    if text.len() <= LONGEST_LOCALE {
        text.to_owned()
    } else {
        String::new()
    }
}

pub(super) fn shortened(text: &UAString) -> String {
    text.as_ref().chars().take(LONGEST_BROWSE_NAME).collect()
}

/// The ValueRank of a scalar, which is the default of a NodeSet2 file.
const SCALAR: i32 = -1;
/// The AccessLevel of a variable that can be read, which is the default of a NodeSet2 file.
const READABLE: u8 = 1;
/// The standard allows 4096 characters in identifiers of NodeIds.
const LONGEST_NAME: usize = 4096;
/// The standard allows 512 characters in BrowseNames.
const LONGEST_BROWSE_NAME: usize = 512;
const LONGEST_LOCALE: usize = 64;
const LONGEST_TEXT: usize = 16 << 10;
/// Largest value in bytes of its XML encoding.
const LARGEST_VALUE: usize = 64 << 10;
const MOST_FIELDS: usize = 1000;
const MOST_DIMENSIONS: usize = 16;

#[cfg(test)]
mod tests {
    use plant_opcua::types::{Array, EUInformation, ExtensionObject, VariantScalarTypeId};

    use super::*;

    fn names() -> NamespaceNames {
        let uris = ["http://opcfoundation.org/UA/", "urn:server", "urn:maker"];
        NamespaceNames::new(uris.map(str::to_owned).to_vec())
    }

    #[test]
    fn a_unit_has_the_members_that_the_converter_of_nodesets_gives() {
        let unit = EUInformation {
            namespace_uri: "http://www.opcfoundation.org/UA/units/un/cefact".into(),
            unit_id: 4_408_652,
            display_name: LocalizedText::new("en", "°C"),
            description: LocalizedText::new("en", "degree Celsius"),
        };
        let value = Variant::ExtensionObject(ExtensionObject::from_message(unit));
        let Ok(Some(OntologyValue::Json(json))) = names().value(&value) else {
            panic!("{:?}", names().value(&value))
        };
        assert_eq!(json["UnitId"], "4408652", "{json}");
        assert_eq!(json["DisplayName"]["Text"], "°C", "{json}");
    }

    #[test]
    fn values_are_literals_nodes_or_json_within_their_limits() {
        let names = names();
        let typed =
            |text: &str, datatype| Ok(Some(OntologyValue::Typed(text.to_owned(), datatype)));
        assert_eq!(names.value(&Variant::Double(0.25)), typed("0.25", "double"));
        assert_eq!(
            names.value(&Variant::Float(f32::INFINITY)),
            typed("INF", "double")
        );
        assert_eq!(names.value(&Variant::Empty), Ok(None));
        let node = NodeName {
            namespace: "urn:maker".to_owned(),
            identifier: "s=a b".to_owned(),
        };
        let id = NodeId::new(2, "a b");
        assert_eq!(names.id(&node).as_ref(), Some(&id));
        let value = names.value(&Variant::NodeId(Box::new(id)));
        assert_eq!(value, Ok(Some(OntologyValue::Node(node))));
        let array = |count: usize| {
            let values = vec![Variant::Int32(7); count];
            let array = Array::new(VariantScalarTypeId::Int32, values).unwrap();
            Variant::Array(Box::new(array))
        };
        let json = OntologyValue::Json(serde_json::json!([7, 7]));
        assert_eq!(names.value(&array(2)), Ok(Some(json)));
        assert_eq!(names.value(&array(100_000)), Err(UnreadValue::TooLarge));
        let long = "x".repeat(LARGEST_VALUE + 1);
        let long = Variant::String(long.as_str().into());
        assert_eq!(names.value(&long), Err(UnreadValue::TooLarge));
        // A namespace that the server does not list is refused.
        assert_eq!(names.name(&NodeId::new(9, 1)), None);
        assert_eq!(names.name(&NodeId::new(2, "y".repeat(5000))), None);
    }
}
