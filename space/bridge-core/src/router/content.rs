//! Messages with fields that need conversion: DataValues, RawData, delta frames, and a selected
//! field of several.

use std::net::SocketAddr;
use std::sync::Arc;

use mappings::{TopicId, UaField};
use uadp::{
    Array, DataSetHeader, DataSetMessage, DataValue, EncodeError, FieldEncoder, FieldEncoding,
    Fields, MessageKind, NetworkHeader, NetworkMessageEncoder, RawDialect, RawLayout, RawValue,
    Scalar, StatusCode, Timestamp, Variant,
};

use super::about::DropSite;
use super::values::TopicQueues;
use crate::base::KeyFrame;
use crate::counters::Reason;
use crate::layout::DataSetLayout;
use crate::place::SequencePosition;
use crate::settings::Now;
use crate::takes::UsedFields;
use crate::topic::{Topic, TopicSide};
use crate::topics::Handle;

/// The selection of fields in a message.
enum Choice {
    All,
    /// The only field, or the field at the index.
    One(Option<u16>),
    Place(u16),
}

impl Choice {
    /// Returns the index of the selected field in a message of `count` fields.
    fn place(&self, count: usize) -> Result<Option<usize>, Refusal> {
        let place = match *self {
            Self::All => return Ok(None),
            Self::One(_) if count == 1 => 0,
            Self::One(Some(place)) | Self::Place(place) => usize::from(place),
            Self::One(None) => {
                let detail = format!(
                    "{count} fields, but the mapping has one value: choose the field with `ua_field`"
                );
                return Err((Reason::Mismatch, detail));
            }
        };
        if place < count {
            return Ok(Some(place));
        }
        let detail = format!(
            "`ua_field` names field {place}, but the message has {count} fields, counted from 0"
        );
        Err((Reason::Mismatch, detail))
    }
}

/// The reason why a message is rejected, with details.
type Refusal = (Reason, String);

/// The status and timestamp of a DataValue that is the value.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct ValueQuality {
    pub(super) status: Option<StatusCode>,
    pub(super) source: Option<Timestamp>,
}

impl ValueQuality {
    fn of(value: &DataValue<'_>) -> Self {
        Self {
            status: value.status,
            source: value.source_timestamp.map(|time| Timestamp {
                time,
                picoseconds: value.source_picoseconds.unwrap_or_default(),
            }),
        }
    }

    /// Returns the status of the sample: the status of the message, or of its value if that is
    /// worse. It is the upper half of a StatusCode; its two highest bits are the severity
    /// (OPC 10000-4, 7.39.1).
    pub(super) fn status(self, message: u16) -> u16 {
        let status = self.status.unwrap_or(StatusCode::GOOD);
        let value = u16::try_from(status.0 >> 16).unwrap_or(u16::MAX);
        if value >> 14 > message >> 14 {
            value
        } else {
            message
        }
    }
}

impl TopicQueues {
    /// Stores a key frame for later delta frames, and returns the selection of its fields.
    pub(super) fn take_base(
        &mut self,
        at: Handle,
        message: &DataSetMessage<'_>,
        place: &SequencePosition,
    ) -> UsedFields {
        let Some(Topic {
            role: TopicSide::Theirs(reader),
            takes,
            ..
        }) = self.topics.at_mut(at)
        else {
            return UsedFields::All;
        };
        if message.kind != MessageKind::KeyFrame {
            return *takes;
        }
        let before = reader.base.as_ref().map_or(0, |base| base.weight());
        let others = self.base_bytes.saturating_sub(before);
        let payload = message.payload().len();
        if payload == 0 {
            // A heartbeat.
        } else if payload > MAX_BASE || others + payload >= MAX_BASES {
            reader.base = None;
            self.base_bytes = others;
        } else {
            let base = match reader.base.take() {
                Some(mut base) => {
                    base.renew(message, place);
                    base
                }
                None => Box::new(KeyFrame::new(message, place)),
            };
            self.base_bytes = others + base.weight();
            reader.base = Some(base);
        }
        *takes
    }

    /// Returns the fields of a message if they need no conversion.
    pub(super) fn plain<'a>(
        message: &DataSetMessage<'a>,
        takes: UsedFields,
    ) -> Option<Result<Fields<'a>, uadp::DecodeError>> {
        let has_fields = matches!(message.kind, MessageKind::KeyFrame | MessageKind::Event);
        if !has_fields
            || message.encoding() != FieldEncoding::Variant
            || message.payload().is_empty()
        {
            return None;
        }
        let fields = message.fields();
        let is_taken = match (takes, &fields) {
            (UsedFields::All, _) | (_, Err(_)) => true,
            (UsedFields::One, Ok(fields)) => fields.len() == 1,
            (UsedFields::Named, Ok(_)) => false,
        };
        is_taken.then_some(fields)
    }

    /// Writes the selected fields of a message into an empty buffer, as a key frame of Variants
    /// without NetworkMessage headers. Returns `None` if the message contains nothing new.
    pub(super) fn content(
        &mut self,
        topic: TopicId,
        message: &DataSetMessage<'_>,
        place: &SequencePosition,
        out: &mut Vec<u8>,
    ) -> Result<Option<ValueQuality>, Refusal> {
        if message.kind == MessageKind::KeyFrame && message.payload().is_empty() {
            return Ok(None);
        }
        let choice = self.choice(topic, &message.header(), place.from)?;
        match (message.kind, message.encoding()) {
            (MessageKind::KeyFrame, FieldEncoding::RawData) => self
                .raw(topic, (message, place.from), &choice, out)
                .map(Some),
            (_, FieldEncoding::RawData) => {
                let detail = "RawData in a delta frame or an event".to_owned();
                Err((Reason::Unsupported, detail))
            }
            (MessageKind::DeltaFrame, _) => self.delta(topic, (message, place), &choice, out),
            (MessageKind::KeyFrame | MessageKind::Event | MessageKind::KeepAlive, _) => {
                flatten(message, &choice, out).map(Some)
            }
        }
    }

    /// Returns the selection of fields in a message with this header.
    fn choice(
        &self,
        topic: TopicId,
        header: &DataSetHeader,
        from: SocketAddr,
    ) -> Result<Choice, Refusal> {
        let variable = self.mapping.variable(topic);
        let Some(variable) = variable else {
            return Ok(Choice::All);
        };
        let announced = || {
            let layout = self.announced(topic, from);
            layout.filter(|layout| layout.is_current(header))
        };
        match (UsedFields::of(Some(variable)), &variable.ua_field) {
            (_, Some(UaField::Place(place))) => Ok(Choice::Place(*place)),
            (_, Some(UaField::Name(name))) => {
                let Some(layout) = announced() else {
                    let detail = format!(
                        "`ua_field: {name}` needs the DataSetMetaData of the writer, which were not received yet"
                    );
                    return Err((Reason::Undescribed, detail));
                };
                let place = layout.place_of(name).map(Choice::Place);
                place.ok_or_else(|| {
                    let detail = format!("its writer announces no field `{name}`");
                    (Reason::Mismatch, detail)
                })
            }
            (UsedFields::One, None) => {
                let named = announced().and_then(|layout| layout.place_of(&variable.name));
                Ok(Choice::One(named))
            }
            (UsedFields::All | UsedFields::Named, None) => Ok(Choice::All),
        }
    }

    /// Returns the layout of a topic if the sender announced it.
    fn announced(&self, topic: TopicId, from: SocketAddr) -> Option<&Arc<DataSetLayout>> {
        let layout = self.layouts.last(topic)?;
        Some(layout).filter(|layout| layout.is_of(from))
    }

    /// Converts RawData with the layout announced by its writer, or else with the layout in the
    /// mapping.
    fn raw(
        &self,
        topic: TopicId,
        (message, from): (&DataSetMessage<'_>, SocketAddr),
        choice: &Choice,
        out: &mut Vec<u8>,
    ) -> Result<ValueQuality, Refusal> {
        let undescribed = |why: &str| Err((Reason::Undescribed, why.to_owned()));
        let layout = match self.announced(topic, from) {
            Some(layout) if layout.is_current(&message.header()) => Some(layout),
            Some(_) => return undescribed("RawData of another version than its DataSetMetaData"),
            None => None,
        };
        if let Some(layout) = layout {
            return raw(message.payload(), layout, choice, out);
        }
        let Some(variable) = self
            .mapping
            .variable(topic)
            .filter(|variable| variable.ua_field.is_none() && !variable.fields.is_empty())
        else {
            return undescribed("RawData before the DataSetMetaData of the writer");
        };
        let layout = DataSetLayout::mapped(variable);
        fits(message.payload(), &layout)?;
        raw(message.payload(), &layout, choice, out)
    }

    /// Applies a delta frame to the last key frame.
    fn delta(
        &mut self,
        topic: TopicId,
        delta: (&DataSetMessage<'_>, &SequencePosition),
        choice: &Choice,
        out: &mut Vec<u8>,
    ) -> Result<Option<ValueQuality>, Refusal> {
        let mut merged = self.buffer();
        let taken = self.merge(topic, delta, (choice, &mut merged), out);
        self.recycle(merged);
        taken
    }

    fn merge(
        &mut self,
        topic: TopicId,
        (message, place): (&DataSetMessage<'_>, &SequencePosition),
        (choice, merged): (&Choice, &mut Vec<u8>),
        out: &mut Vec<u8>,
    ) -> Result<Option<ValueQuality>, Refusal> {
        let no_key_frame = |why: &str| Err((Reason::NoKeyFrame, why.to_owned()));
        let Some(reader) = self.topics.reader_of(topic) else {
            return Ok(None);
        };
        reader.deltas = true;
        let owed = reader.owed;
        let base = reader.base.as_mut();
        let Some(base) = base.filter(|base| base.is_of(message, place.from)) else {
            return no_key_frame("a delta frame without its key frame");
        };
        let others = self.base_bytes.saturating_sub(base.weight());
        let done = base.merge(message, place, merged);
        self.base_bytes = others + base.weight();
        let one = done
            .as_ref()
            .map_or(Ok(None), |done| choice.place(done.count));
        let is_sure = one.as_ref().is_ok_and(|one| base.is_sure(*one));
        if base.weight() > 2 * MAX_BASE || self.base_bytes > MAX_BASES {
            reader.base = None;
            self.base_bytes = others;
        }
        let (done, one) = (done?, one?);
        if !is_sure {
            return no_key_frame(
                "a delta frame after a lost message, which may have changed other fields",
            );
        }
        let is_said = match one {
            Some(one) => done.said.iter().any(|index| usize::from(*index) == one),
            None => !done.said.is_empty(),
        };
        if !is_said && !owed {
            return Ok(None);
        }
        let whole = DataSetMessage::decode(None, merged)
            .map_err(|error| (Reason::Malformed, error.to_string()))?;
        flatten(&whole, choice, out).map(Some)
    }

    /// Removes the key frame of a silent writer that has never sent a delta frame.
    pub(super) fn forget_base(&mut self, at: Handle) {
        if let Some(reader) = self.topics.reader(at)
            && !reader.deltas
            && let Some(base) = reader.base.take()
        {
            self.base_bytes = self.base_bytes.saturating_sub(base.weight());
        }
    }

    /// Stores a key frame that the local side already has, because delta frames may follow it.
    pub(super) fn follow_again(
        &mut self,
        at: Handle,
        message: &DataSetMessage<'_>,
        place: &SequencePosition,
    ) {
        let Some(reader) = self.topics.reader(at) else {
            return;
        };
        if reader.deltas {
            self.take_base(at, message, place);
        } else if let Some(base) = &mut reader.base {
            base.repeated(place);
        }
    }

    /// Counts a message with rejected content, and probes its writer if metadata is missing.
    pub(super) fn refuse_content(
        &mut self,
        topic: TopicId,
        from: SocketAddr,
        (reason, detail): Refusal,
        now: Now,
    ) {
        if reason == Reason::Undescribed {
            self.ask_layout(topic, now);
        }
        let about = DropSite {
            topic: Some(topic),
            from: Some(from),
        };
        self.count(about, reason, 1, || detail);
    }
}

/// Checks that a payload has exactly the layout of the mapping. No writer announced this layout,
/// and a message of more fields could pass for a padded message.
fn fits(payload: &[u8], layout: &DataSetLayout) -> Result<(), Refusal> {
    let fields = layout.raw_fields();
    let layout = raw_layout(&fields)?;
    let values: Result<Vec<_>, _> = layout.read(payload, RawDialect::Standard).collect();
    let mut again = Vec::new();
    let same = values.is_ok_and(|values| {
        let written = layout.write(&mut again, RawDialect::Standard, values);
        written.is_ok() && again.len() == payload.len()
    });
    if same {
        return Ok(());
    }
    let detail = format!(
        "RawData of {} bytes, which do not match the fields of the mapping, without DataSetMetaData of the writer",
        payload.len()
    );
    Err((Reason::Mismatch, detail))
}

fn raw_layout<'a>(fields: &'a [uadp::RawField<'a>]) -> Result<RawLayout<'a>, Refusal> {
    RawLayout::new(fields).map_err(|error| (Reason::Unsupported, format!("RawData: {error}")))
}

fn raw(
    payload: &[u8],
    layout: &DataSetLayout,
    choice: &Choice,
    out: &mut Vec<u8>,
) -> Result<ValueQuality, Refusal> {
    let fields = layout.raw_fields();
    let layout = raw_layout(&fields)?;
    let values = layout.read(payload, RawDialect::Standard);
    let values: Vec<RawValue<'_>> = values
        .collect::<Result<_, _>>()
        .map_err(|error| (Reason::Malformed, format!("RawData: {error}")))?;
    let one = choice.place(values.len())?;
    write(out, |frame| {
        for value in taken(&values, one) {
            match value {
                RawValue::Variant(variant) => frame.variant(variant)?,
                RawValue::Array(array) if array.is_null() => {
                    frame.variant(&Variant::Array(Array::null(array.element())))?;
                }
                RawValue::Array(array) => {
                    // For a matrix of texts, the elements in row-major order as in ROS.
                    frame.array(array.element(), array.len())?;
                    for element in array {
                        frame.element(element)?;
                    }
                }
            }
        }
        Ok(())
    })?;
    Ok(ValueQuality::default())
}

/// Converts Variants or DataValues. A bad DataValue without a value, and a bad DataValue among
/// several, are replaced by their status as in a writer of Variants (OPC 10000-14, 7.2.4.5.5).
/// Other DataValues without a value are null.
fn flatten(
    message: &DataSetMessage<'_>,
    choice: &Choice,
    out: &mut Vec<u8>,
) -> Result<ValueQuality, Refusal> {
    let malformed = |error: uadp::DecodeError| (Reason::Malformed, error.to_string());
    let values = message.values().map_err(malformed)?;
    let values = values.map(|field| field.map(|field| field.value));
    let values: Vec<DataValue<'_>> = values.collect::<Result<_, _>>().map_err(malformed)?;
    let one = choice.place(values.len())?;
    let taken = taken(&values, one);
    let alone = taken.len() == 1;
    write(out, |frame| {
        for value in taken {
            let status = value.status.unwrap_or(StatusCode::GOOD);
            let is_bad = status.0 & STATUS_BAD != 0;
            match value.value {
                Some(variant) if alone || !is_bad => frame.variant(&variant)?,
                Some(_) | None if is_bad => frame.scalar(Scalar::StatusCode(status))?,
                Some(_) | None => frame.null()?,
            }
        }
        Ok(())
    })?;
    Ok(match taken {
        [one] => ValueQuality::of(one),
        _ => ValueQuality::default(),
    })
}

fn taken<T>(values: &[T], one: Option<usize>) -> &[T] {
    match one {
        Some(one) => values.get(one..=one).unwrap_or_default(),
        None => values,
    }
}

/// Writes a key frame of Variants without NetworkMessage headers.
fn write(
    out: &mut Vec<u8>,
    fields: impl FnOnce(&mut FieldEncoder<'_>) -> Result<(), EncodeError>,
) -> Result<(), Refusal> {
    let too_big = |error: EncodeError| (Reason::TooBig, error.to_string());
    let mut message =
        NetworkMessageEncoder::new(out, &NetworkHeader::default(), None).map_err(too_big)?;
    let at = message.payload_offset();
    let mut frame = message
        .key_frame(&DataSetHeader::default())
        .map_err(too_big)?;
    fields(&mut frame).map_err(too_big)?;
    frame.finish().map_err(too_big)?;
    message.finish().map_err(too_big)?;
    out.drain(..at);
    Ok(())
}

/// The severity of a Bad StatusCode (OPC 10000-4, 7.39.1).
pub(super) const STATUS_BAD: u32 = 0x8000_0000;
/// The maximum size of a stored key frame: the size of a datagram.
const MAX_BASE: usize = 1 << 16;
/// The maximum size of all stored key frames. It is limited, because any sender in the group can
/// invent topics.
const MAX_BASES: usize = 16 << 20;
