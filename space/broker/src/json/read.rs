//! Received JSON messages, of every layout and encoding.

use json_values::{JsonFieldValue, iso_time};
use serde_json::{Map, Value};
use uadp::discovery::{ConnectionState, CyclicStatus};
use uadp::{
    DataSetHeader, DataValue, DateTime, GroupHeader, Nested, NetworkHeader, NetworkMessageEncoder,
    PublisherId, StatusCode, Variant,
};

use super::forms::{ValueForms, status_number};
use super::{Json, WriterIds};
use crate::topics::Address;

/// The contents of a JSON message.
#[derive(Debug, Default, PartialEq)]
pub(crate) struct JsonContents {
    /// NetworkMessages of UADP.
    pub(crate) messages: Vec<Vec<u8>>,
    pub(crate) status: Option<(ConnectionState, Option<CyclicStatus>)>,
    /// Keys of payloads that the metadata does not have, and DataSetMessages that cannot be read.
    pub(crate) faults: Vec<&'static str>,
}

/// The ids that a message inherits from its topic and its headers.
#[derive(Debug, Clone, Copy)]
struct Inherited {
    publisher: u16,
    group: Option<u16>,
    writer: Option<u16>,
    sent: Option<DateTime>,
}

impl Json {
    /// Reads a message of a topic.
    ///
    /// # Errors
    /// The reason why the whole message is dropped.
    pub(crate) fn read(
        &mut self,
        text: &[u8],
        address: Address,
    ) -> Result<JsonContents, &'static str> {
        if text.len() > MAX_TEXT {
            return Err("malformed_json");
        }
        let json: Value = serde_json::from_slice(text).map_err(|_| "malformed_json")?;
        let mut inherited = Inherited {
            publisher: address.publisher,
            group: address.group,
            writer: address.writer,
            sent: None,
        };
        let Value::Object(whole) = &json else {
            // Without a NetworkMessage header the message is an array of DataSetMessages.
            return match json.as_array() {
                Some(list) => Ok(self.data(list, inherited)),
                None => Err("malformed_json"),
            };
        };
        if let Some(id) = whole.get("PublisherId")
            && number(id) != Some(address.publisher)
        {
            return Err("other_publisher");
        }
        let group = whole.get("WriterGroupName").and_then(number);
        inherited.group = inherited.group.or(group);
        let writer = whole.get("DataSetWriterId").and_then(number);
        inherited.writer = inherited.writer.or(writer);
        inherited.sent = whole.get("MessageId").and_then(sent);
        match whole.get("MessageType").and_then(Value::as_str) {
            Some("ua-metadata") => {
                let (Some(group), Some(writer)) = (inherited.group, inherited.writer) else {
                    return Err("json_ids");
                };
                let topic = (inherited.publisher, group, writer);
                let meta_data = whole.get("MetaData").unwrap_or(&Value::Null);
                let announcement = self.others.read(topic, meta_data);
                Ok(JsonContents {
                    messages: vec![announcement.ok_or("malformed_json")?],
                    ..JsonContents::default()
                })
            }
            Some("ua-status") => Ok(JsonContents {
                status: Some(status(whole).ok_or("malformed_json")?),
                ..JsonContents::default()
            }),
            _ => Ok(match whole.get("Messages") {
                Some(Value::Array(list)) => self.data(list, inherited),
                Some(one) => self.data(std::slice::from_ref(one), inherited),
                None => self.data(std::slice::from_ref(&json), inherited),
            }),
        }
    }

    fn data(&self, list: &[Value], inherited: Inherited) -> JsonContents {
        let mut reading = JsonContents::default();
        for message in list {
            match self.data_set(message, inherited, &mut reading.faults) {
                Ok(bytes) => reading.messages.push(bytes),
                Err(fault) => reading.faults.push(fault),
            }
        }
        reading
    }

    /// Converts a DataSetMessage, or a bare payload.
    fn data_set(
        &self,
        message: &Value,
        inherited: Inherited,
        faults: &mut Vec<&'static str>,
    ) -> Result<Vec<u8>, &'static str> {
        let whole = message.as_object().ok_or("malformed_json")?;
        let kind = whole
            .get("MessageType")
            .and_then(Value::as_str)
            .unwrap_or_default();
        let is_keep_alive = kind == "ua-keepalive";
        let has_header = whole.contains_key("Payload") || is_keep_alive;
        let empty = Map::new();
        let header = if has_header { whole } else { &empty };
        let named = header.get("WriterGroupName").and_then(number);
        let group = inherited.group.or(named);
        let ids = ["DataSetWriterId", "DataSetWriterName"];
        let writer = ids.iter().find_map(|key| number(header.get(*key)?));
        let writer = inherited.writer.or(writer);
        let (Some(group), Some(writer)) = (group, writer) else {
            return Err("json_ids");
        };
        let topic = (inherited.publisher, group, writer);
        let taken = header
            .get("Timestamp")
            .and_then(Value::as_str)
            .and_then(iso_time::parse);
        let sequence = header.get("SequenceNumber").and_then(Value::as_u64);
        let version = header
            .get("MetaDataVersion")
            .and_then(|of| of.get("MajorVersion"));
        let version = version.and_then(Value::as_u64);
        let status = header.get("Status");
        let status = status.map(|of| status_number(of).ok_or("wrong_json_value"));
        let data_set_header = DataSetHeader {
            // The number is a UInt32 in JSON, and counts on.
            sequence_number: sequence.map(low_word),
            timestamp: taken,
            status: status.transpose()?.map(high_word),
            major_version: version.and_then(|version| u32::try_from(version).ok()),
            ..DataSetHeader::default()
        };
        let network = NetworkHeader {
            publisher_id: Some(PublisherId::UInt16(inherited.publisher)),
            group: Some(GroupHeader {
                writer_group_id: Some(group),
                ..GroupHeader::default()
            }),
            timestamp: inherited.sent,
            ..NetworkHeader::default()
        };
        let mut bytes = Vec::new();
        let mut encoder = NetworkMessageEncoder::new(&mut bytes, &network, Some(&[writer]))
            .map_err(|_| "malformed_json")?;
        if is_keep_alive {
            encoder
                .keep_alive(&data_set_header)
                .map_err(|_| "malformed_json")?;
        } else {
            let payload = if has_header {
                header.get("Payload").and_then(Value::as_object)
            } else {
                Some(whole)
            };
            let payload = payload.ok_or("malformed_json")?;
            let fields = self.fields(topic, payload, faults)?;
            let written = match kind {
                "ua-deltaframe" => delta(&mut encoder, &data_set_header, &fields),
                _ => frame(&mut encoder, (&data_set_header, kind), &fields),
            };
            written.ok_or("malformed_json")?;
        }
        encoder.finish().map_err(|_| "malformed_json")?;
        Ok(bytes)
    }

    /// Returns the fields of a payload by their index; `None` for a field that is not there.
    fn fields(
        &self,
        topic: WriterIds,
        payload: &Map<String, Value>,
        faults: &mut Vec<&'static str>,
    ) -> Result<Vec<Option<FieldBytes>>, &'static str> {
        let mut forms = ValueForms::default();
        let Some(described) = self.others.of(topic) else {
            // The order of several fields is unknown without metadata.
            let mut values = payload.values();
            let (Some(value), None) = (values.next(), values.next()) else {
                return Err("undescribed_json");
            };
            let value = FieldBytes::encode(forms.field(value, None)?)?;
            faults.extend(forms.fault());
            return Ok(vec![Some(value)]);
        };
        let is_known = |key: &String| described.iter().any(|field| field.name == *key);
        if payload.keys().any(|key| !is_known(key)) {
            faults.push("unknown_field");
        }
        let mut fields = Vec::with_capacity(described.len());
        for field in described {
            let value = match payload.get(&field.name) {
                Some(value) => Some(FieldBytes::encode(forms.field(value, Some(field))?)?),
                None => None,
            };
            fields.push(value);
        }
        faults.extend(forms.fault());
        Ok(fields)
    }
}

/// A field of a payload.
struct FieldBytes {
    /// A Variant.
    variant: Vec<u8>,
    /// The status of the field, if it is not Good.
    status: Option<StatusCode>,
}

impl FieldBytes {
    fn encode(mut value: JsonFieldValue) -> Result<Self, &'static str> {
        let status = value.status.take().map(|status| StatusCode(status.code));
        let variant = json_values::variant_bytes(&value).map_err(|_| "wrong_json_value")?;
        let status = status.filter(|status| *status != StatusCode::GOOD);
        Ok(Self { variant, status })
    }

    fn variant(&self) -> Option<Variant<'_>> {
        Nested::new(&self.variant).ok()?.get().ok()
    }

    fn data_value(&self) -> Option<DataValue<'_>> {
        let value = self.variant()?;
        Some(DataValue {
            value: (value != Variant::Null).then_some(value),
            status: self.status,
            ..DataValue::default()
        })
    }
}

fn has_status(fields: &[Option<FieldBytes>]) -> bool {
    fields.iter().flatten().any(|field| field.status.is_some())
}

/// Writes a key frame or event. A missing field is null. Fields with a status make it a key frame
/// of DataValues; events have Variants only.
fn frame(
    encoder: &mut NetworkMessageEncoder<'_>,
    (header, kind): (&DataSetHeader, &str),
    fields: &[Option<FieldBytes>],
) -> Option<()> {
    let is_event = kind == "ua-event";
    if !is_event && has_status(fields) {
        let mut frame = encoder.data_values(header).ok()?;
        for field in fields {
            let value = match field {
                Some(field) => field.data_value()?,
                None => DataValue::default(),
            };
            frame.value(&value).ok()?;
        }
        return frame.finish().ok();
    }
    let mut frame = if is_event {
        encoder.event(header).ok()?
    } else {
        encoder.key_frame(header).ok()?
    };
    for field in fields {
        match field {
            Some(field) => frame.variant(&field.variant()?).ok()?,
            None => frame.null().ok()?,
        }
    }
    frame.finish().ok()
}

fn delta(
    encoder: &mut NetworkMessageEncoder<'_>,
    header: &DataSetHeader,
    fields: &[Option<FieldBytes>],
) -> Option<()> {
    let changed = fields.iter().zip(0_u16..);
    let changed = changed.filter_map(|(field, index)| Some((index, field.as_ref()?)));
    if has_status(fields) {
        let mut frame = encoder.delta_data_values(header).ok()?;
        for (index, field) in changed {
            frame.changed(index, &field.data_value()?).ok()?;
        }
        return frame.finish().ok();
    }
    let mut frame = encoder.delta_frame(header).ok()?;
    for (index, field) in changed {
        frame.field(index).ok()?.variant(&field.variant()?).ok()?;
    }
    frame.finish().ok()
}

fn status(whole: &Map<String, Value>) -> Option<(ConnectionState, Option<CyclicStatus>)> {
    let state = i32::try_from(whole.get("Status")?.as_i64()?).ok()?;
    let time = |key: &str| iso_time::parse(whole.get(key)?.as_str()?);
    let is_cyclic = whole
        .get("IsCyclic")
        .and_then(Value::as_bool)
        .unwrap_or_default();
    let cyclic = is_cyclic.then(|| CyclicStatus {
        next_report_time: time("NextReportTime").unwrap_or_default(),
        timestamp: time("Timestamp").unwrap_or_default(),
    });
    Some((ConnectionState(state), cyclic))
}

/// Reads an id: a number, or its decimal text.
fn number(json: &Value) -> Option<u16> {
    match json.as_str() {
        Some(text) => text.parse().ok(),
        None => u16::try_from(json.as_u64()?).ok(),
    }
}

/// Returns the time of sending with which a MessageId of this project begins.
fn sent(id: &Value) -> Option<DateTime> {
    let (time, _) = id.as_str()?.split_once("Z-")?;
    iso_time::parse(&format!("{time}Z"))
}

fn low_word(number: u64) -> u16 {
    let [low, high, ..] = number.to_le_bytes();
    u16::from_le_bytes([low, high])
}

fn high_word(code: u32) -> u16 {
    let [high, low, ..] = code.to_be_bytes();
    u16::from_be_bytes([high, low])
}

/// The largest JSON message in bytes that is read.
const MAX_TEXT: usize = 4 << 20;
