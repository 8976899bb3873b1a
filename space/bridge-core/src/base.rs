//! The state of a writer that its delta frames change (OPC 10000-14, 7.2.4.5.6).

use std::net::SocketAddr;

use uadp::{
    DataSetHeader, DataSetMessage, DataValue, DecodeError, FieldEncoding, FieldValue,
    NetworkHeader, NetworkMessageEncoder, Timestamp,
};

use crate::counters::Reason;
use crate::place::Place;

/// The last key frame of a writer with what its delta frames have changed since.
///
/// It holds for one sender and one ConfigurationVersion. Sequence numbers tell when a message of that writer was lost, which may
/// have changed any field: from then on each field is in doubt until something is said of it. Without sequence numbers a loss
/// cannot be seen, and lasts until the next key frame.
#[derive(Debug)]
pub(crate) struct Base {
    /// A DataSetMessage, as [`DataSetMessage::decode`] takes it.
    message: Vec<u8>,
    from: SocketAddr,
    version: (Option<u32>, Option<u32>),
    sequence: Option<u16>,
    /// Timestamp of the key frame; none once delta frames have changed it.
    stamp: Option<Timestamp>,
    /// Of each field whether it is in doubt; empty where none is.
    in_doubt: Vec<bool>,
}

/// What a delta frame comes to.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct Merged {
    /// Number of fields of the DataSet.
    pub(crate) count: usize,
    /// The fields it says something of.
    pub(crate) said: Vec<u16>,
}

impl Base {
    /// Of a key frame of Variants or DataValues.
    pub(crate) fn new(message: &DataSetMessage<'_>, place: &Place) -> Self {
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

    /// Another key frame.
    pub(crate) fn renew(&mut self, message: &DataSetMessage<'_>, place: &Place) {
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

    /// Returns whether a key frame has the fields of the last key frame under this stamp; true for any other stamp.
    pub(crate) fn is_same(&self, message: &DataSetMessage<'_>, stamp: Timestamp) -> bool {
        self.stamp != Some(stamp)
            || (self.message.first() == Some(&flags(message.encoding()))
                && self.message.get(1..) == Some(message.payload()))
    }

    /// The key frame has come once more.
    pub(crate) const fn repeated(&mut self, place: &Place) {
        self.sequence = place.sequence;
    }

    /// Bytes it takes up.
    pub(crate) const fn weight(&self) -> usize {
        self.message.len() + self.in_doubt.len()
    }

    /// Whether a delta frame can be put over it.
    pub(crate) fn is_of(&self, delta: &DataSetMessage<'_>, from: SocketAddr) -> bool {
        self.from == from
            && self.version == version(&delta.header())
            && self.message.first() == Some(&flags(delta.encoding()))
    }

    /// Puts a delta frame over it, and appends what that comes to, a DataSetMessage, to `out`.
    ///
    /// # Errors
    /// The delta frame or the key frame is malformed; all fields are then in doubt.
    pub(crate) fn merge(
        &mut self,
        delta: &DataSetMessage<'_>,
        place: &Place,
        out: &mut Vec<u8>,
    ) -> Result<Merged, (Reason, String)> {
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
        let Ok(Merged { said, .. }) = &merged else {
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

    /// FieldCount of the key frame.
    fn count(&self) -> usize {
        let count = self.message.get(1..).and_then(|block| block.first_chunk());
        count.map_or(0, |count| u16::from_le_bytes(*count).into())
    }

    /// Whether a field, or all of them, are what the writer has.
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
) -> Result<Merged, (Reason, String)> {
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
            let detail = format!("field {} of a DataSet that has {count}", entry.index);
            return Err((Reason::Malformed, detail));
        };
        *field = entry.value;
        said.push(entry.index);
    }
    let count = fields.len();
    write(whole.encoding(), &fields, out).map_err(|error| (Reason::TooBig, error.to_string()))?;
    Ok(Merged { count, said })
}

/// Whether it says nothing. open62541 ends its delta frames with entries for field 0 without a value.
fn is_filler(entry: &FieldValue<'_>) -> bool {
    entry.is_filler() || (entry.index == 0 && entry.value == DataValue::default())
}

/// Appends a key frame that stands alone.
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

/// DataSetFlags1 of a key frame with nothing in its header (OPC 10000-14, 7.2.4.5.4).
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
