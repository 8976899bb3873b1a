//! The JSON message mapping (OPC 10000-14, 7.2.5) of values, metadata and status.
//!
//! Messages of programs are NetworkMessages of UADP. This module converts them to JSON where the
//! mapping wants JSON, and received JSON to UADP. Sealed messages, chunks, requests, responses and
//! commands stay UADP: JSON has no message security, and no PicoSeconds, which identify a command.
//!
//! The MessageId begins with the time of sending. Readers of this project take it as the Timestamp
//! of the NetworkMessage, which JSON does not have.

mod descriptions;
mod forms;
mod names;
mod promoted;
mod read;
#[cfg(test)]
mod tests;

use json_values::iso_time;
use mappings::MessageMapping;
use serde_json::{Map, Value, json};
use uadp::discovery::{ConnectionState, CyclicStatus};
use uadp::{DataSetMessage, MessageKind, NetworkMessage, StatusCode, Timestamp, Variant};

pub(crate) use promoted::PromotedTexts;

use descriptions::{DataSetField, Descriptions, WriterIds};

/// The converter of a program.
#[derive(Debug)]
pub(crate) struct Json {
    form: MessageMapping,
    own: Descriptions,
    others: Descriptions,
    sent: u64,
}

impl Json {
    pub(crate) fn new(form: MessageMapping) -> Self {
        Self {
            form,
            own: Descriptions::default(),
            others: Descriptions::default(),
            sent: 0,
        }
    }

    /// Returns the metadata in an own message as JSON, with its topic.
    pub(crate) fn describe(
        &mut self,
        message: &NetworkMessage<'_>,
        now: Timestamp,
    ) -> Option<Vec<u8>> {
        self.own.learn(message)?;
        let ((publisher, group, writer), meta_data) = descriptions::to_json(message)?;
        let mut whole = self.start("ua-metadata", publisher, now);
        whole.insert("DataSetWriterId".to_owned(), self.writer_id(writer));
        whole.insert("WriterGroupName".to_owned(), json!(group.to_string()));
        whole.insert("DataSetWriterName".to_owned(), json!(writer.to_string()));
        whole.insert(
            "Timestamp".to_owned(),
            json!(iso_time::of_date_time(now.time)),
        );
        whole.insert("MetaData".to_owned(), meta_data);
        Some(bytes(whole))
    }

    /// Records the metadata in an own message, or in a message that is forwarded.
    pub(crate) fn learn_own(&mut self, message: &NetworkMessage<'_>) {
        self.own.learn(message);
    }

    /// Records the metadata in a received UADP message.
    pub(crate) fn learn(&mut self, message: &NetworkMessage<'_>) {
        self.others.learn(message);
    }

    /// Returns a status as JSON.
    pub(crate) fn status(
        &mut self,
        publisher: u16,
        (state, cyclic): (ConnectionState, Option<CyclicStatus>),
        now: Timestamp,
    ) -> Vec<u8> {
        let mut whole = self.start("ua-status", publisher, now);
        whole.insert("IsCyclic".to_owned(), json!(cyclic.is_some()));
        whole.insert("Status".to_owned(), json!(state.0));
        if let Some(cyclic) = cyclic {
            let next = iso_time::of_date_time(cyclic.next_report_time);
            let at = iso_time::of_date_time(cyclic.timestamp);
            whole.insert("Timestamp".to_owned(), json!(at));
            whole.insert("NextReportTime".to_owned(), json!(next));
        }
        bytes(whole)
    }

    /// Returns a value as JSON; `None` if it stays UADP.
    pub(crate) fn value(
        &mut self,
        message: &NetworkMessage<'_>,
        now: Timestamp,
    ) -> Option<Vec<u8>> {
        if message.is_sealed() || message.is_chunk() {
            return None;
        }
        let publisher = crate::address::publisher(message)?;
        let group = message.group()?.writer_group_id?;
        let messages: Vec<Value> = message
            .messages()
            .map(|of| self.data_set_message((publisher, group), &of.ok()?))
            .collect::<Option<_>>()?;
        let mut whole = self.start("ua-data", publisher, now);
        whole.insert("WriterGroupName".to_owned(), json!(group.to_string()));
        whole.insert("Messages".to_owned(), messages.into());
        Some(bytes(whole))
    }

    fn data_set_message(
        &self,
        (publisher, group): (u16, u16),
        message: &DataSetMessage<'_>,
    ) -> Option<Value> {
        let writer = message.writer_id?;
        let header = message.header();
        let mut whole = Map::new();
        whole.insert("DataSetWriterId".to_owned(), self.writer_id(writer));
        whole.insert("DataSetWriterName".to_owned(), json!(writer.to_string()));
        if let Some(number) = header.sequence_number {
            whole.insert("SequenceNumber".to_owned(), json!(number));
        }
        if let Some(major) = header.major_version {
            let version = json!({"MajorVersion": major, "MinorVersion": header.minor_version.unwrap_or(major)});
            whole.insert("MetaDataVersion".to_owned(), version);
        }
        if let Some(time) = header.timestamp {
            whole.insert("Timestamp".to_owned(), json!(iso_time::of_date_time(time)));
        }
        if let Some(status) = header.status.filter(|status| *status != 0) {
            let code = StatusCode(u32::from(status) << 16);
            whole.insert("Status".to_owned(), self.status_code(code));
        }
        let kind = match message.kind {
            MessageKind::KeyFrame => "ua-keyframe",
            MessageKind::KeepAlive => "ua-keepalive",
            MessageKind::Event => "ua-event",
            // The programs of this project send key frames.
            MessageKind::DeltaFrame => return None,
        };
        whole.insert("MessageType".to_owned(), json!(kind));
        if message.kind != MessageKind::KeepAlive {
            let fields = self.own.of((publisher, group, writer)).unwrap_or_default();
            let mut payload = Map::new();
            for (value, at) in message.fields().ok()?.zip(0_usize..) {
                let field = fields.get(at);
                let name = field.map_or_else(|| format!("Field{at}"), |field| field.name.clone());
                payload.insert(name, self.field(&value.ok()?, field)?);
            }
            whole.insert("Payload".to_owned(), payload.into());
        }
        Some(whole.into())
    }

    /// Returns a field of the payload.
    fn field(&self, variant: &Variant<'_>, field: Option<&DataSetField>) -> Option<Value> {
        let shown = json_values::show_variant(variant).ok()?;
        let is_described = field.is_some_and(|field| {
            field.builtin.is_some() && field.builtin == variant.builtin_type()
        });
        let plain = shown.value.unwrap_or_default();
        let is_plain = match self.form {
            MessageMapping::JsonNonReversible => true,
            MessageMapping::JsonVerbose => is_described,
            MessageMapping::JsonCompact | MessageMapping::JsonReversible | MessageMapping::Uadp => {
                false
            }
        };
        if variant.builtin_type().is_none() || (is_plain && shown.dimensions.is_none()) {
            return Some(plain);
        }
        let (kind, value) = match self.form {
            MessageMapping::JsonReversible => ("Type", "Body"),
            MessageMapping::JsonVerbose
            | MessageMapping::JsonCompact
            | MessageMapping::JsonNonReversible
            | MessageMapping::Uadp => ("UaType", "Value"),
        };
        let mut whole = Map::new();
        whole.insert(kind.to_owned(), json!(shown.ua_type));
        whole.insert(value.to_owned(), plain);
        if let Some(dimensions) = shown.dimensions {
            whole.insert("Dimensions".to_owned(), json!(dimensions));
        }
        Some(whole.into())
    }

    fn status_code(&self, code: StatusCode) -> Value {
        let symbol = json_values::status::symbol(code);
        match (self.form, symbol) {
            (MessageMapping::JsonReversible, _) => json!(code.0),
            (MessageMapping::JsonVerbose | MessageMapping::JsonNonReversible, Some(symbol)) => {
                json!({"Code": code.0, "Symbol": symbol})
            }
            _ => json!({"Code": code.0}),
        }
    }

    /// The DataSetWriterId was a String in version 1.04.
    fn writer_id(&self, writer: u16) -> Value {
        match self.form {
            MessageMapping::JsonReversible | MessageMapping::JsonNonReversible => {
                json!(writer.to_string())
            }
            MessageMapping::Uadp | MessageMapping::JsonVerbose | MessageMapping::JsonCompact => {
                json!(writer)
            }
        }
    }

    fn start(&mut self, kind: &str, publisher: u16, now: Timestamp) -> Map<String, Value> {
        self.sent = self.sent.wrapping_add(1);
        let time = iso_time::of_date_time(now.time);
        let mut whole = Map::new();
        whole.insert(
            "MessageId".to_owned(),
            json!(format!("{time}-{publisher}-{}", self.sent)),
        );
        whole.insert("MessageType".to_owned(), json!(kind));
        whole.insert("PublisherId".to_owned(), json!(publisher.to_string()));
        whole
    }
}

/// A map with text keys is always written.
fn bytes(whole: Map<String, Value>) -> Vec<u8> {
    Value::from(whole).to_string().into_bytes()
}
