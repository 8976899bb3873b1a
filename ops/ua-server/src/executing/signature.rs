//! The signature of a Method of another server, read from that server.

use bridge_node::{CallDescription, CallField, CallRole};
use mappings::{ExpandedNodeIdText, MethodTarget, NamespaceText, NodeIdText};
use messages::ArrayRank;
use opcua::types::{
    Argument, AttributeId, DataTypeId, DataValue, Identifier, NodeId, ReferenceTypeId, Variant,
};
use plant_opcua::client::{Browse, ClientError, OpcUaClient};
use plant_opcua::server::arguments_in;
use uadp::BuiltinType;

use super::MappedMethod;
use crate::layout;

/// The nodes of a Method, and its input and output arguments.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Signature {
    pub(super) object: NodeId,
    pub(super) method: NodeId,
    pub(super) takes: Vec<CallField>,
    pub(super) gives: Vec<CallField>,
}

impl Signature {
    /// Returns the description of the call that is announced in the space.
    pub(super) fn description(&self, wanted: &MappedMethod) -> CallDescription {
        CallDescription {
            name: wanted.name.clone(),
            about: wanted.about.clone(),
            role: CallRole::Call,
            request: self.takes.clone(),
            response: self.gives.clone(),
        }
    }
}

/// Reads the signature over the current connection.
///
/// # Errors
/// Returns the reason why the Method cannot be called, as text for the operator.
pub(super) async fn read(client: &OpcUaClient, target: &MethodTarget) -> Result<Signature, String> {
    let object = node(client, &target.object)?;
    let method = node(client, &target.method)?;
    let what = [
        (object.clone(), AttributeId::NodeClass),
        (method.clone(), AttributeId::Executable),
    ];
    let read = client.read_attributes(&what).await.map_err(told)?;
    let [of_object, executable] = &read[..] else {
        return Err("the server answers with another number of values".to_owned());
    };
    there(of_object, &target.object)?;
    there(executable, &target.method)?;
    if executable.value != Some(Variant::Boolean(true)) {
        return Err(format!("{} is not executable", target.method));
    }
    let properties = Browse {
        subtypes: false,
        ..Browse::of(ReferenceTypeId::HasProperty)
    };
    let properties = client.browse(&method, properties).await.map_err(told)?;
    let mut both = Vec::new();
    for which in ["InputArguments", "OutputArguments"] {
        let named = properties
            .iter()
            .find(|one| one.browse_name.name.as_ref() == which);
        let arguments = match named {
            None => Vec::new(),
            Some(property) => {
                let values = client.read(std::slice::from_ref(&property.node_id.node_id));
                let value = values.await.map_err(told)?.into_iter().next();
                arguments_in(value).ok_or_else(|| format!("its {which} are none"))?
            }
        };
        both.push(fields(client, which, arguments).await?);
    }
    let gives = both.pop().unwrap_or_default();
    let takes = both.pop().unwrap_or_default();
    Ok(Signature {
        object,
        method,
        takes,
        gives,
    })
}

/// Converts a NodeId into a NodeId of that server, over the current connection.
///
/// # Errors
/// Returns the reason why there is no such NodeId, as text for the operator.
pub(crate) fn node(client: &OpcUaClient, text: &ExpandedNodeIdText) -> Result<NodeId, String> {
    let namespace = match &text.namespace {
        NamespaceText::Index(index) => *index,
        NamespaceText::Uri(uri) => client
            .namespace(uri)
            .ok_or_else(|| format!("the server has no namespace {uri}"))?,
    };
    Ok(layout::node_id(&NodeIdText {
        namespace,
        identifier: text.identifier.clone(),
    }))
}

fn there(read: &DataValue, text: &ExpandedNodeIdText) -> Result<(), String> {
    let status = read.status();
    if status.is_bad() {
        return Err(format!("the server answers {status} for {text}"));
    }
    Ok(())
}

fn told(error: ClientError) -> String {
    error.to_string()
}

async fn fields(
    client: &OpcUaClient,
    which: &str,
    arguments: Vec<Argument>,
) -> Result<Vec<CallField>, String> {
    if arguments.len() > MOST_FIELDS {
        return Err(format!("{which} are more than {MOST_FIELDS}"));
    }
    let mut fields: Vec<CallField> = Vec::new();
    for (at, argument) in (1..).zip(arguments) {
        let wrong = |why: &str| format!("{which} {at} (`{}`) {why}", argument.name);
        let builtin = builtin(client, &argument.data_type).await.map_err(told)?;
        let builtin = builtin
            .ok_or_else(|| wrong(&format!("is of {}, which no call has", argument.data_type)))?;
        let rank = match argument.value_rank {
            -1 => ArrayRank::Scalar,
            1 => ArrayRank::Array { fixed: None },
            other => return Err(wrong(&format!("has ValueRank {other}, which no call has"))),
        };
        let name = argument.name.as_ref();
        if name.len() > LONGEST_NAME {
            return Err(format!(
                "the name of {which} {at} is longer than {LONGEST_NAME} bytes"
            ));
        }
        let taken = fields
            .iter()
            .any(|field| field.name.eq_ignore_ascii_case(name));
        let name = match name {
            "" => format!("arg{at}"),
            _ if taken => format!("arg{at}"),
            name => name.to_owned(),
        };
        fields.push(CallField {
            rank,
            ..CallField::scalar(&name, builtin)
        });
    }
    Ok(fields)
}

/// Returns the builtin type of the values of a DataType, or `None` if a call cannot carry them.
/// Structures and NodeIds depend on the namespaces of that server, and values of an abstract type
/// may have any type.
async fn builtin(
    client: &OpcUaClient,
    data_type: &NodeId,
) -> Result<Option<BuiltinType>, ClientError> {
    if let Some(known) = standard(data_type) {
        return Ok(known);
    }
    for above in client.supertypes(data_type).await? {
        if let Some(known) = standard(&above) {
            return Ok(known);
        }
    }
    Ok(None)
}

/// Returns the builtin type that a DataType of the standard defines. The inner `None` is a type
/// that a call cannot carry; the outer `None` is a DataType that does not define it.
fn standard(data_type: &NodeId) -> Option<Option<BuiltinType>> {
    let Identifier::Numeric(number) = data_type.identifier else {
        return None;
    };
    if data_type.namespace != 0 {
        return None;
    }
    if number == DataTypeId::Enumeration as u32 {
        return Some(Some(BuiltinType::Int32));
    }
    let builtin = u8::try_from(number).ok().and_then(BuiltinType::from_id)?;
    Some(match builtin {
        BuiltinType::Boolean
        | BuiltinType::SByte
        | BuiltinType::Byte
        | BuiltinType::Int16
        | BuiltinType::UInt16
        | BuiltinType::Int32
        | BuiltinType::UInt32
        | BuiltinType::Int64
        | BuiltinType::UInt64
        | BuiltinType::Float
        | BuiltinType::Double
        | BuiltinType::String
        | BuiltinType::DateTime
        | BuiltinType::Guid
        | BuiltinType::ByteString
        | BuiltinType::XmlElement
        | BuiltinType::StatusCode
        | BuiltinType::LocalizedText => Some(builtin),
        BuiltinType::NodeId
        | BuiltinType::ExpandedNodeId
        | BuiltinType::QualifiedName
        | BuiltinType::ExtensionObject
        | BuiltinType::DataValue
        | BuiltinType::Variant
        | BuiltinType::DiagnosticInfo => None,
    })
}

/// Largest number of announced fields of a request or response.
const MOST_FIELDS: usize = 256;
/// Largest length of an announced name, in bytes.
const LONGEST_NAME: usize = 255;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_data_type_of_the_standard_says_what_its_values_are_or_that_no_call_has_them() {
        let of = |number: u32| standard(&NodeId::new(0, number));
        assert_eq!(of(1), Some(Some(BuiltinType::Boolean)));
        assert_eq!(of(29), Some(Some(BuiltinType::Int32)), "an enumeration");
        assert_eq!(of(17), Some(None), "a NodeId");
        assert_eq!(of(22), Some(None), "a structure");
        assert_eq!(of(24), Some(None), "anything");
        assert_eq!(
            of(26),
            None,
            "Number is abstract, and has nothing above but anything"
        );
        assert_eq!(of(290), None, "Duration, which is below Double");
        assert_eq!(standard(&NodeId::new(2, 1)), None);
    }
}
