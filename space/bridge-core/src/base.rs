//! The last state of a writer, to which its delta frames apply (OPC 10000-14, 7.2.4.5.6).

use std::net::SocketAddr;

use uadp::{
    DataSetHeader, DataSetMessage, DataValue, DecodeError, FieldEncoding, FieldValue,
    NetworkHeader, NetworkMessageEncoder, Timestamp,
};

use crate::counters::Reason;
use crate::place::SequencePosition;

/// The last key frame of a writer with the changes of the following delta frames.
///
/// It is valid for a single sender and ConfigurationVersion. A gap in the sequence numbers shows a
/// lost message, which may have changed any field. Each field is then in doubt until a message
/// contains it. Without sequence numbers a loss is not detected, and its effect lasts until the
/// next key frame.
#[derive(Debug)]
pub(crate) struct KeyFrame {
    /// A DataSetMessage in the form that [`DataSetMessage::decode`] reads.
    message: Vec<u8>,
    from: SocketAddr,
    version: (Option<u32>, Option<u32>),
    sequence: Option<u16>,
    /// The Timestamp of the key frame; `None` after a delta frame.
    stamp: Option<Timestamp>,
    /// Whether each field is in doubt; empty if no field is.
    in_doubt: Vec<bool>,
}

/// The result of a delta frame.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct MergedDelta {
    /// The number of fields of the DataSet.
    pub(crate) count: usize,
    /// The indexes of the fields in the delta frame.
    pub(crate) said: Vec<u16>,
}

impl KeyFrame {
    /// Creates the state from a key frame of Variants or DataValues.
    pub(crate) fn new(message: &DataSetMessage<'_>, place: &SequencePosition) -> Self {
        let mut base = Self {
            message: Vec::new(),
            from: place.from,
            version: (None, None),
            sequence: None,
            stamp: None,
            in_doubt: Vec::new(),
        };
        base.renew(message, place);
        base
    }

    /// Replaces the state by another key frame.
    pub(crate) fn renew(&mut self, message: &DataSetMessage<'_>, place: &SequencePosition) {
        let header = message.header();
        self.message.clear();
        self.message.push(flags(message.encoding()));
        self.message.extend_from_slice(message.payload());
        self.from = place.from;
        self.version = version(&header);
        self.sequence = place.sequence;
        self.stamp = place.stamp;
        self.in_doubt.clear();
    }

    /// Returns whether a key frame has the fields of the last key frame under this stamp; true for
    /// any other stamp.
    pub(crate) fn is_same(&self, message: &DataSetMessage<'_>, stamp: Timestamp) -> bool {
        self.stamp != Some(stamp)
            || (self.message.first() == Some(&flags(message.encoding()))
                && self.message.get(1..) == Some(message.payload()))
    }

    /// Records a repetition of the key frame.
    pub(crate) const fn repeated(&mut self, place: &SequencePosition) {
        self.sequence = place.sequence;
    }

    /// Returns the size in bytes.
    pub(crate) const fn weight(&self) -> usize {
        self.message.len() + self.in_doubt.len()
    }

    /// Returns whether a delta frame can be applied.
    pub(crate) fn is_of(&self, delta: &DataSetMessage<'_>, from: SocketAddr) -> bool {
        self.from == from
            && self.version == version(&delta.header())
            && self.message.first() == Some(&flags(delta.encoding()))
    }

    /// Applies a delta frame, and appends the resulting DataSetMessage to `out`.
    ///
    /// # Errors
    /// The delta frame or the key frame is malformed. All fields are then in doubt.
    pub(crate) fn merge(
        &mut self,
        delta: &DataSetMessage<'_>,
        place: &SequencePosition,
        out: &mut Vec<u8>,
    ) -> Result<MergedDelta, (Reason, String)> {
        let follows = match (self.sequence, place.sequence) {
            (Some(last), Some(next)) => next == last.wrapping_add(1),
            (None, None) => true,
            (Some(_), None) | (None, Some(_)) => false,
        };
        self.sequence = place.sequence;
        self.stamp = None;
        let merged = merged(&self.message, delta, out);
        if !follows || merged.is_err() {
            let count = self.count();
            self.in_doubt.clear();
            self.in_doubt.resize(count, true);
        }
        let Ok(MergedDelta { said, .. }) = &merged else {
            return merged;
        };
        for index in said {
            if let Some(doubt) = self.in_doubt.get_mut(usize::from(*index)) {
                *doubt = false;
            }
        }
        if !self.in_doubt.contains(&true) {
            self.in_doubt.clear();
        }
        self.message.clear();
        self.message.extend_from_slice(out);
        merged
    }

    /// Returns the FieldCount of the key frame.
    fn count(&self) -> usize {
        let count = self.message.get(1..).and_then(|block| block.first_chunk());
        count.map_or(0, |count| u16::from_le_bytes(*count).into())
    }

    /// Returns whether a field, or each field for `None`, is not in doubt.
    pub(crate) fn is_sure(&self, field: Option<usize>) -> bool {
        match field {
            Some(field) => self.in_doubt.get(field) != Some(&true),
            None => self.in_doubt.is_empty(),
        }
    }
}

fn merged(
    base: &[u8],
    delta: &DataSetMessage<'_>,
    out: &mut Vec<u8>,
) -> Result<MergedDelta, (Reason, String)> {
    let malformed = |error: DecodeError| (Reason::Malformed, error.to_string());
    let whole = DataSetMessage::decode(None, base).map_err(malformed)?;
    let fields = whole.values().map_err(malformed)?;
    let fields = fields.map(|field| field.map(|field| field.value));
    let mut fields: Vec<DataValue<'_>> = fields.collect::<Result<_, _>>().map_err(malformed)?;
    let mut said = Vec::new();
    for entry in delta.values().map_err(malformed)? {
        let entry = entry.map_err(malformed)?;
        if is_filler(&entry) {
            continue;
        }
        let count = fields.len();
        let Some(field) = fields.get_mut(usize::from(entry.index)) else {
            let detail = format!("field {} of a DataSet with {count} fields", entry.index);
            return Err((Reason::Malformed, detail));
        };
        *field = entry.value;
        said.push(entry.index);
    }
    let count = fields.len();
    write(whole.encoding(), &fields, out).map_err(|error| (Reason::TooBig, error.to_string()))?;
    Ok(MergedDelta { count, said })
}

/// Returns whether an entry contains no change. open62541 ends its delta frames with entries for
/// field 0 without a value.
fn is_filler(entry: &FieldValue<'_>) -> bool {
    entry.is_filler() || (entry.index == 0 && entry.value == DataValue::default())
}

/// Appends a key frame without NetworkMessage headers.
fn write(
    encoding: FieldEncoding,
    fields: &[DataValue<'_>],
    out: &mut Vec<u8>,
) -> Result<(), uadp::EncodeError> {
    let mut message = NetworkMessageEncoder::new(out, &NetworkHeader::default(), None)?;
    let at = message.payload_offset();
    if encoding == FieldEncoding::DataValue {
        let mut frame = message.data_values(&DataSetHeader::default())?;
        for field in fields {
            frame.value(field)?;
        }
        frame.finish()?;
    } else {
        let mut frame = message.key_frame(&DataSetHeader::default())?;
        for field in fields {
            frame.variant(&field.value.unwrap_or(uadp::Variant::Null))?;
        }
        frame.finish()?;
    }
    message.finish()?;
    out.drain(..at);
    Ok(())
}

/// Returns DataSetFlags1 of a key frame with an empty header (OPC 10000-14, 7.2.4.5.4).
const fn flags(encoding: FieldEncoding) -> u8 {
    match encoding {
        FieldEncoding::Variant => 0x01,
        FieldEncoding::RawData => 0x03,
        FieldEncoding::DataValue => 0x05,
    }
}

const fn version(header: &DataSetHeader) -> (Option<u32>, Option<u32>) {
    (header.major_version, header.minor_version)
}
