//! Conversions between our codec and the types of the foreign crate, for writing and reading.

use uadp::{
    Array, BuiltinType, DataSetHeader, DateTime, DecodeError, DeltaEncoder, EncodeError, Extras,
    FieldEncoder, FieldEncoding, MessageKind, Nested, NetworkHeader, NetworkMessageEncoder, Scalar,
    StatusCode,
};
use zerodds_opcua_gateway::data_value as foreign;
use zerodds_opcua_gateway::data_value::{ExtensionObjectBody, VariantValue};
use zerodds_opcua_gateway::node_id::{NodeId, NodeIdentifier};
use zerodds_opcua_gateway::types::{Guid, LocalizedText, QualifiedName};
use zerodds_opcua_pubsub::uadp::{
    DataSetData, DataSetMessage, DataSetMessageKind, GroupHeader, NetworkMessage, PublisherId,
};

/// Encodes the message with our encoder.
pub(crate) fn write(message: &NetworkMessage) -> Result<Vec<u8>, EncodeError> {
    let header = NetworkHeader {
        publisher_id: message.publisher_id.as_ref().map(our_publisher_id),
        data_set_class_id: message.data_set_class_id.as_ref().map(our_guid),
        group: message.group_header.as_ref().map(our_group_header),
        timestamp: message.timestamp.map(DateTime),
        picoseconds: message.pico_seconds,
    };
    let ids: Vec<u16> = message.messages.iter().map(|one| one.writer_id).collect();
    let values: Vec<Value<'_>> = message.promoted_fields.iter().map(Value::of).collect();
    let promoted: Vec<uadp::Variant<'_>> = values.iter().map(Value::variant).collect();
    let extras = Extras {
        promoted_fields: (!promoted.is_empty()).then_some(&promoted[..]),
        security: None,
    };
    let mut datagram = Vec::new();
    let ids = message.payload_header.then_some(&ids[..]);
    let mut encoder = NetworkMessageEncoder::with(&mut datagram, &header, ids, &extras)?;
    for one in &message.messages {
        write_data_set_message(&mut encoder, one)?;
    }
    encoder.finish()?;
    Ok(datagram)
}

fn write_data_set_message(
    encoder: &mut NetworkMessageEncoder<'_>,
    message: &DataSetMessage,
) -> Result<(), EncodeError> {
    let header = DataSetHeader {
        valid: message.valid,
        sequence_number: message.sequence_number,
        timestamp: message.timestamp.map(DateTime),
        picoseconds: message.pico_seconds,
        status: message.status,
        major_version: message.config_major_version,
        minor_version: message.config_minor_version,
    };
    match (&message.data, message.kind) {
        (DataSetData::None, _) => encoder.keep_alive(&header),
        (DataSetData::Variant(fields), DataSetMessageKind::Event) => {
            write_fields(encoder.event(&header)?, fields)
        }
        (DataSetData::Variant(fields), _) => write_fields(encoder.key_frame(&header)?, fields),
        (DataSetData::DataValue(fields), _) => {
            let mut frame = encoder.data_values(&header)?;
            for field in fields {
                let value = field.value.as_ref().map(Value::of);
                frame.value(&our_data_value(field, value.as_ref()))?;
            }
            frame.finish()
        }
        (DataSetData::DeltaVariant(fields), _) => {
            write_delta(encoder.delta_frame(&header)?, fields)
        }
        (DataSetData::DeltaDataValue(fields), _) => {
            let mut frame = encoder.delta_data_values(&header)?;
            for (index, field) in fields {
                let value = field.value.as_ref().map(Value::of);
                frame.changed(*index, &our_data_value(field, value.as_ref()))?;
            }
            frame.finish()
        }
        (DataSetData::Raw(bytes), _) => encoder.raw_key_frame(&header, |out| {
            out.extend_from_slice(bytes);
            Ok(())
        }),
    }
}

fn write_fields(
    mut frame: FieldEncoder<'_>,
    fields: &[foreign::Variant],
) -> Result<(), EncodeError> {
    for field in fields {
        write_field(&mut frame, field)?;
    }
    frame.finish()
}

fn write_delta(
    mut frame: DeltaEncoder<'_>,
    fields: &[(u16, foreign::Variant)],
) -> Result<(), EncodeError> {
    for (index, field) in fields {
        write_field(frame.field(*index)?, field)?;
    }
    frame.finish()
}

/// Uses the calls for single values where they exist, so that they are tested as well.
fn write_field(frame: &mut FieldEncoder<'_>, field: &foreign::Variant) -> Result<(), EncodeError> {
    match (&field.array_dimensions[..], &field.value[..]) {
        ([], []) => frame.null(),
        ([], [value]) => frame.scalar(our_scalar(value)),
        ([_], [first, ..]) => {
            frame.array(our_scalar(first).builtin_type(), field.value.len())?;
            for value in &field.value {
                frame.element(our_scalar(value))?;
            }
            Ok(())
        }
        _ => frame.variant(&Value::of(field).variant()),
    }
}

/// The data that one of our Variants borrows.
struct Value<'a> {
    foreign: &'a foreign::Variant,
    elements: Vec<u8>,
    dimensions: Vec<[u8; 4]>,
}

impl<'a> Value<'a> {
    fn of(foreign: &'a foreign::Variant) -> Self {
        let mut elements = Vec::new();
        let mut one = Vec::new();
        for value in &foreign.value {
            let scalar = uadp::Variant::Scalar(our_scalar(value));
            // The bytes after the encoding byte.
            elements.extend_from_slice(&Nested::variant(&scalar, &mut one).unwrap().bytes()[1..]);
        }
        let dimensions = foreign.array_dimensions.iter();
        Self {
            foreign,
            elements,
            dimensions: dimensions.map(|size| size.to_le_bytes()).collect(),
        }
    }

    fn variant(&self) -> uadp::Variant<'_> {
        let Some(first) = self.foreign.value.first() else {
            return uadp::Variant::Null;
        };
        if self.dimensions.is_empty() {
            return our_scalar(first).into();
        }
        let element = our_scalar(first).builtin_type();
        let array = Array::new(element, self.foreign.value.len(), &self.elements).unwrap();
        match self.dimensions.len() {
            1 => array.into(),
            _ => uadp::Matrix::new(array, &self.dimensions).unwrap().into(),
        }
    }
}

fn our_publisher_id(id: &PublisherId) -> uadp::PublisherId<'_> {
    match id {
        PublisherId::Byte(id) => uadp::PublisherId::Byte(*id),
        PublisherId::UInt16(id) => uadp::PublisherId::UInt16(*id),
        PublisherId::UInt32(id) => uadp::PublisherId::UInt32(*id),
        PublisherId::UInt64(id) => uadp::PublisherId::UInt64(*id),
        PublisherId::String(id) => uadp::PublisherId::String(id),
    }
}

fn our_guid(guid: &Guid) -> uadp::Guid {
    uadp::Guid::from_fields(guid.data1, guid.data2, guid.data3, guid.data4)
}

fn our_group_header(header: &GroupHeader) -> uadp::GroupHeader {
    uadp::GroupHeader {
        writer_group_id: header.writer_group_id,
        group_version: header.group_version,
        network_message_number: header.network_message_number,
        sequence_number: header.sequence_number,
    }
}

fn our_data_value<'a>(
    value: &foreign::DataValue,
    variant: Option<&'a Value<'_>>,
) -> uadp::DataValue<'a> {
    uadp::DataValue {
        value: variant.map(Value::variant),
        status: value.status.map(StatusCode),
        source_timestamp: value.source_timestamp.map(DateTime),
        source_picoseconds: value.source_pico_sec,
        server_timestamp: value.server_timestamp.map(DateTime),
        server_picoseconds: value.server_pico_sec,
    }
}

fn our_node_id(id: &NodeId) -> uadp::NodeId<'_> {
    uadp::NodeId {
        namespace: id.namespace_index,
        identifier: match &id.identifier_type {
            NodeIdentifier::Numeric(id) => uadp::NodeIdValue::Numeric(*id),
            NodeIdentifier::String(id) => uadp::NodeIdValue::String(Some(id)),
            NodeIdentifier::Guid(id) => uadp::NodeIdValue::Guid(our_guid(id)),
            NodeIdentifier::Opaque(id) => uadp::NodeIdValue::Opaque(Some(id)),
        },
    }
}

fn our_scalar(value: &VariantValue) -> Scalar<'_> {
    match value {
        VariantValue::Boolean(v) => Scalar::Boolean(*v),
        VariantValue::SByte(v) => Scalar::SByte(*v),
        VariantValue::Byte(v) => Scalar::Byte(*v),
        VariantValue::Int16(v) => Scalar::Int16(*v),
        VariantValue::UInt16(v) => Scalar::UInt16(*v),
        VariantValue::Int32(v) => Scalar::Int32(*v),
        VariantValue::UInt32(v) => Scalar::UInt32(*v),
        VariantValue::Int64(v) => Scalar::Int64(*v),
        VariantValue::UInt64(v) => Scalar::UInt64(*v),
        VariantValue::Float(v) => Scalar::Float(*v),
        VariantValue::Double(v) => Scalar::Double(*v),
        VariantValue::String(v) => Scalar::String(Some(v)),
        VariantValue::DateTime(v) => Scalar::DateTime(DateTime(*v)),
        VariantValue::Guid(v) => Scalar::Guid(our_guid(v)),
        VariantValue::ByteString(v) => Scalar::ByteString(Some(v)),
        VariantValue::XmlElement(v) => Scalar::XmlElement(Some(v)),
        VariantValue::NodeId(v) => Scalar::NodeId(our_node_id(v)),
        VariantValue::StatusCode(v) => Scalar::StatusCode(StatusCode(*v)),
        VariantValue::QualifiedName(v) => Scalar::QualifiedName(uadp::QualifiedName {
            namespace: v.namespace_index,
            name: Some(&v.name),
        }),
        VariantValue::LocalizedText(v) => Scalar::LocalizedText(uadp::LocalizedText {
            locale: v.locale.as_deref(),
            text: v.text.as_deref(),
        }),
        VariantValue::ExtensionObject(v) => Scalar::ExtensionObject(uadp::ExtensionObject {
            type_id: our_node_id(&v.type_id),
            body: match &v.body {
                ExtensionObjectBody::None => uadp::ExtensionBody::None,
                ExtensionObjectBody::ByteString(body) => uadp::ExtensionBody::Binary(body),
                ExtensionObjectBody::XmlElement(body) => uadp::ExtensionBody::Xml(body),
            },
        }),
    }
}

/// The reason why a datagram that we read has no counterpart.
#[derive(Debug, PartialEq)]
pub(crate) enum Unread {
    /// Our decoder refuses the datagram.
    Refused(DecodeError),
    /// Our decoder reads the datagram, but the foreign types cannot express it.
    NoWords(&'static str),
}

impl From<DecodeError> for Unread {
    fn from(error: DecodeError) -> Self {
        Self::Refused(error)
    }
}

/// Decodes the datagram with our decoder, to its last byte.
pub(crate) fn read(datagram: &[u8]) -> Result<NetworkMessage, Unread> {
    let message = uadp::NetworkMessage::decode(datagram)?;
    let header = message.header();
    let promoted = message.promoted_fields().into_iter().flatten();
    Ok(NetworkMessage {
        publisher_id: header.publisher_id.map(their_publisher_id),
        data_set_class_id: header.data_set_class_id.map(their_guid),
        group_header: header.group.map(|group| GroupHeader {
            writer_group_id: group.writer_group_id,
            group_version: group.group_version,
            network_message_number: group.network_message_number,
            sequence_number: group.sequence_number,
        }),
        timestamp: header.timestamp.map(|time| time.0),
        pico_seconds: header.picoseconds,
        promoted_fields: promoted
            .map(|field| their_variant(field?))
            .collect::<Result<_, Unread>>()?,
        payload_header: message.writer_ids().is_some(),
        messages: message
            .messages()
            .map(|one| read_data_set_message(&one?))
            .collect::<Result<_, Unread>>()?,
    })
}

fn read_data_set_message(message: &uadp::DataSetMessage<'_>) -> Result<DataSetMessage, Unread> {
    let header = message.header();
    let mut read = DataSetMessage {
        writer_id: message.writer_id.unwrap_or_default(),
        valid: header.valid,
        kind: match message.kind {
            MessageKind::KeyFrame => DataSetMessageKind::KeyFrame,
            MessageKind::DeltaFrame => DataSetMessageKind::DeltaFrame,
            MessageKind::Event => DataSetMessageKind::Event,
            MessageKind::KeepAlive => DataSetMessageKind::KeepAlive,
        },
        sequence_number: header.sequence_number,
        timestamp: header.timestamp.map(|time| time.0),
        pico_seconds: header.picoseconds,
        status: header.status,
        config_major_version: header.major_version,
        config_minor_version: header.minor_version,
        data: DataSetData::None,
    };
    if message.is_valid() && message.kind != MessageKind::KeepAlive {
        read.data = read_data(message)?;
    }
    Ok(read)
}

fn read_data(message: &uadp::DataSetMessage<'_>) -> Result<DataSetData, Unread> {
    let delta = message.kind == MessageKind::DeltaFrame;
    Ok(match (message.encoding(), delta) {
        (FieldEncoding::RawData, _) => DataSetData::Raw(message.payload().to_vec()),
        (FieldEncoding::Variant, false) => {
            let fields = message.fields()?.map(|field| their_variant(field?));
            DataSetData::Variant(fields.collect::<Result<_, _>>()?)
        }
        (FieldEncoding::Variant, true) => {
            let fields = message.values()?.map(|field| {
                let field = field?;
                let value = field.value.value.ok_or(Unread::NoWords("no Variant"))?;
                Ok((field.index, their_variant(value)?))
            });
            DataSetData::DeltaVariant(fields.collect::<Result<_, Unread>>()?)
        }
        (FieldEncoding::DataValue, false) => {
            let fields = message
                .values()?
                .map(|field| their_data_value(field?.value));
            DataSetData::DataValue(fields.collect::<Result<_, _>>()?)
        }
        (FieldEncoding::DataValue, true) => {
            let fields = message.values()?.map(|field| {
                let field = field?;
                Ok((field.index, their_data_value(field.value)?))
            });
            DataSetData::DeltaDataValue(fields.collect::<Result<_, Unread>>()?)
        }
    })
}

fn their_publisher_id(id: uadp::PublisherId<'_>) -> PublisherId {
    match id {
        uadp::PublisherId::Byte(id) => PublisherId::Byte(id),
        uadp::PublisherId::UInt16(id) => PublisherId::UInt16(id),
        uadp::PublisherId::UInt32(id) => PublisherId::UInt32(id),
        uadp::PublisherId::UInt64(id) => PublisherId::UInt64(id),
        uadp::PublisherId::String(id) => PublisherId::String(id.to_owned()),
    }
}

/// Converts from the text form, which is the standard's and not ours.
fn their_guid(guid: uadp::Guid) -> Guid {
    let digits = guid.to_string().replace('-', "");
    Guid::from_bytes(u128::from_str_radix(&digits, 16).unwrap().to_be_bytes())
}

fn their_data_value(value: uadp::DataValue<'_>) -> Result<foreign::DataValue, Unread> {
    Ok(foreign::DataValue {
        value: value.value.map(their_variant).transpose()?,
        status: value.status.map(|status| status.0),
        source_timestamp: value.source_timestamp.map(|time| time.0),
        server_timestamp: value.server_timestamp.map(|time| time.0),
        source_pico_sec: value.source_picoseconds,
        server_pico_sec: value.server_picoseconds,
    })
}

fn their_variant(variant: uadp::Variant<'_>) -> Result<foreign::Variant, Unread> {
    let elements = |array: Array<'_>| match array.is_null() {
        true => Err(Unread::NoWords("null array")),
        false if array.element() == BuiltinType::Variant => Err(Unread::NoWords("Variants")),
        false => array.iter().map(their_value).collect::<Result<Vec<_>, _>>(),
    };
    let (array_dimensions, value) = match variant {
        uadp::Variant::Null => (Vec::new(), Vec::new()),
        uadp::Variant::Scalar(scalar) => (Vec::new(), vec![their_value(scalar)?]),
        uadp::Variant::Array(array) => {
            (vec![u32::try_from(array.len()).unwrap()], elements(array)?)
        }
        uadp::Variant::Matrix(matrix) => {
            (matrix.dimensions().collect(), elements(matrix.elements())?)
        }
    };
    Ok(foreign::Variant {
        array_dimensions,
        value,
    })
}

fn their_node_id(id: uadp::NodeId<'_>) -> NodeId {
    NodeId {
        namespace_index: id.namespace,
        identifier_type: match id.identifier {
            uadp::NodeIdValue::Numeric(id) => NodeIdentifier::Numeric(id),
            uadp::NodeIdValue::String(id) => NodeIdentifier::String(owned(id)),
            uadp::NodeIdValue::Guid(id) => NodeIdentifier::Guid(their_guid(id)),
            uadp::NodeIdValue::Opaque(id) => {
                NodeIdentifier::Opaque(id.unwrap_or_default().to_vec())
            }
        },
    }
}

/// Null is empty in the foreign types.
fn owned(text: Option<&str>) -> String {
    text.unwrap_or_default().to_owned()
}

fn their_value(scalar: Scalar<'_>) -> Result<VariantValue, Unread> {
    Ok(match scalar {
        Scalar::Boolean(v) => VariantValue::Boolean(v),
        Scalar::SByte(v) => VariantValue::SByte(v),
        Scalar::Byte(v) => VariantValue::Byte(v),
        Scalar::Int16(v) => VariantValue::Int16(v),
        Scalar::UInt16(v) => VariantValue::UInt16(v),
        Scalar::Int32(v) => VariantValue::Int32(v),
        Scalar::UInt32(v) => VariantValue::UInt32(v),
        Scalar::Int64(v) => VariantValue::Int64(v),
        Scalar::UInt64(v) => VariantValue::UInt64(v),
        Scalar::Float(v) => VariantValue::Float(v),
        Scalar::Double(v) => VariantValue::Double(v),
        Scalar::String(v) => VariantValue::String(owned(v)),
        Scalar::DateTime(v) => VariantValue::DateTime(v.0),
        Scalar::Guid(v) => VariantValue::Guid(their_guid(v)),
        Scalar::ByteString(v) => VariantValue::ByteString(v.unwrap_or_default().to_vec()),
        Scalar::XmlElement(v) => VariantValue::XmlElement(owned(v)),
        Scalar::NodeId(v) => VariantValue::NodeId(their_node_id(v)),
        Scalar::StatusCode(v) => VariantValue::StatusCode(v.0),
        Scalar::QualifiedName(v) => VariantValue::QualifiedName(QualifiedName {
            namespace_index: v.namespace,
            name: owned(v.name),
        }),
        Scalar::LocalizedText(v) => VariantValue::LocalizedText(LocalizedText {
            locale: v.locale.map(str::to_owned),
            text: v.text.map(str::to_owned),
        }),
        Scalar::ExtensionObject(v) => VariantValue::ExtensionObject(foreign::ExtensionObject {
            type_id: their_node_id(v.type_id),
            body: match v.body {
                uadp::ExtensionBody::None => ExtensionObjectBody::None,
                uadp::ExtensionBody::Binary(body) => ExtensionObjectBody::ByteString(body.to_vec()),
                uadp::ExtensionBody::Xml(body) => ExtensionObjectBody::XmlElement(body.to_owned()),
            },
        }),
        Scalar::ExpandedNodeId(_) => return Err(Unread::NoWords("ExpandedNodeId")),
        Scalar::DataValue(_) => return Err(Unread::NoWords("DataValue")),
        Scalar::Variant(_) => return Err(Unread::NoWords("Variant")),
        Scalar::DiagnosticInfo(_) => return Err(Unread::NoWords("DiagnosticInfo")),
    })
}
