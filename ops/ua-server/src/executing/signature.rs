//! The signature of a Method of another server, read from that server.

use bridge_node::{CallDescription, CallField, CallRole};
use mappings::{ExpandedNodeIdText, MethodTarget, NamespaceText, NodeIdText};
use messages::ArrayRank;
use opcua::types::{
    Argument, AttributeId, DataTypeId, DataValue, Identifier, NodeId, ReferenceTypeId, StatusCode,
    Variant,
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

/// The reason why a Method cannot be called.
#[derive(Debug, thiserror::Error)]
pub(crate) enum SignatureError {
    /// A request failed.
    #[error(transparent)]
    Client(#[from] ClientError),
    /// The response has another number of values.
    #[error("the server answers with another number of values")]
    Short,
    /// The server has no namespace with the URI.
    #[error("the server has no namespace {0}")]
    NoNamespace(String),
    /// A node does not exist, or cannot be read.
    #[error("the server answers {status} for {node}")]
    NoNode {
        /// The answer of the server.
        status: StatusCode,
        /// The node.
        node: String,
    },
    /// The node is no Method, or the user may not call it.
    #[error("{0} is not executable")]
    NotExecutable(String),
    /// The value of the property is no list of arguments.
    #[error("its {0} are none")]
    NoArguments(&'static str),
    /// The Method has too many arguments of this kind.
    #[error("{0} are more than {MOST_FIELDS}")]
    TooMany(&'static str),
    /// The name of an argument is too long.
    #[error("the name of {which} {at} is longer than {LONGEST_NAME} bytes")]
    LongName {
        /// The kind of argument.
        which: &'static str,
        /// The number of the argument, from 1.
        at: u32,
    },
    /// A call cannot carry an argument.
    #[error("{which} {at} (`{name}`) {why}, which no call has")]
    NotCarried {
        /// The kind of argument.
        which: &'static str,
        /// The number of the argument, from 1.
        at: u32,
        /// The name of the argument.
        name: String,
        /// Its DataType or ValueRank, as a predicate.
        why: String,
    },
}

/// Reads the signature over the current connection.
///
/// # Errors
/// The Method cannot be called.
pub(super) async fn read(
    client: &OpcUaClient,
    target: &MethodTarget,
) -> Result<Signature, SignatureError> {
    let object = node(client, &target.object)?;
    let method = node(client, &target.method)?;
    let what = [
        (object.clone(), AttributeId::NodeClass),
        (method.clone(), AttributeId::Executable),
    ];
    let read = client.read_attributes(&what).await?;
    let [of_object, executable] = &read[..] else {
        return Err(SignatureError::Short);
    };
    there(of_object, &target.object)?;
    there(executable, &target.method)?;
    if executable.value != Some(Variant::Boolean(true)) {
        return Err(SignatureError::NotExecutable(target.method.to_string()));
    }
    let properties = Browse {
        subtypes: false,
        ..Browse::of(ReferenceTypeId::HasProperty)
    };
    let properties = client.browse(&method, properties).await?;
    let mut both = Vec::new();
    for which in ["InputArguments", "OutputArguments"] {
        let named = properties
            .iter()
            .find(|one| one.browse_name.name.as_ref() == which);
        let arguments = match named {
            None => Vec::new(),
            Some(property) => {
                let values = client.read(std::slice::from_ref(&property.node_id.node_id));
                let value = values.await?.into_iter().next();
                arguments_in(value).ok_or(SignatureError::NoArguments(which))?
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
/// The server has no such namespace.
pub(crate) fn node(
    client: &OpcUaClient,
    text: &ExpandedNodeIdText,
) -> Result<NodeId, SignatureError> {
    let namespace = match &text.namespace {
        NamespaceText::Index(index) => *index,
        NamespaceText::Uri(uri) => client
            .namespace(uri)
            .ok_or_else(|| SignatureError::NoNamespace(uri.to_string()))?,
    };
    Ok(layout::node_id(&NodeIdText {
        namespace,
        identifier: text.identifier.clone(),
    }))
}

fn there(read: &DataValue, text: &ExpandedNodeIdText) -> Result<(), SignatureError> {
    let status = read.status();
    if status.is_bad() {
        let node = text.to_string();
        return Err(SignatureError::NoNode { status, node });
    }
    Ok(())
}

async fn fields(
    client: &OpcUaClient,
    which: &'static str,
    arguments: Vec<Argument>,
) -> Result<Vec<CallField>, SignatureError> {
    if arguments.len() > MOST_FIELDS {
        return Err(SignatureError::TooMany(which));
    }
    let mut fields: Vec<CallField> = Vec::new();
    for (at, argument) in (1_u32..).zip(arguments) {
        let wrong = |why: String| SignatureError::NotCarried {
            which,
            at,
            name: argument.name.to_string(),
            why,
        };
        let builtin = builtin(client, &argument.data_type).await?;
        let builtin = builtin.ok_or_else(|| wrong(format!("is of {}", argument.data_type)))?;
        let rank = match argument.value_rank {
            -1 => ArrayRank::Scalar,
            1 => ArrayRank::Array { fixed: None },
            other => return Err(wrong(format!("has ValueRank {other}"))),
        };
        let name = argument.name.as_ref();
        if name.len() > LONGEST_NAME {
            return Err(SignatureError::LongName { which, at });
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
