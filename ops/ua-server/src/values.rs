//! The last value of each topic in its received form: the encoded fields of its DataSet.
//!
//! The Variants of the server need far more memory (24 bytes for each byte of an array). They are
//! therefore created for each response, for the requested part only, and dropped afterwards.

use std::collections::HashMap;

use bytes::Bytes;
use mappings::TopicId;
use opcua::types::{
    Array, DataValue, DateTime, NumericRange, StatusCode, Variant, VariantScalarTypeId,
};
use uadp::{BuiltinType, Fields, Scalar, Timestamp};

use crate::layout::TopicNode;
use crate::value;

/// The current values of the topics, with a common memory limit.
#[derive(Debug)]
pub(crate) struct CurrentValues {
    topics: HashMap<TopicId, ShownValue>,
    bytes: usize,
    most: usize,
}

/// The current value of the nodes of a topic.
#[derive(Debug, Clone)]
pub(crate) struct ShownValue {
    /// FieldCount and a Variant for each field, all of them readable; `None` without a usable
    /// value.
    pub(crate) block: Option<Bytes>,
    pub(crate) stamp: SampleStamp,
}

/// The properties that all values of a sample share.
#[derive(Debug, Clone, Copy)]
pub(crate) struct SampleStamp {
    pub(crate) status: StatusCode,
    pub(crate) source: Option<Timestamp>,
    pub(crate) server: DateTime,
}

impl CurrentValues {
    /// Creates an empty store with a limit of `most` bytes.
    pub(crate) fn new(most: usize) -> Self {
        Self {
            topics: HashMap::new(),
            bytes: 0,
            most,
        }
    }

    pub(crate) fn get(&self, topic: TopicId) -> Option<&ShownValue> {
        self.topics.get(&topic)
    }

    /// Stores a value and returns the previous value. A value beyond the memory limit is not
    /// stored: `BadOutOfMemory` is shown instead and returned as the error.
    pub(crate) fn put(
        &mut self,
        topic: TopicId,
        mut shown: ShownValue,
    ) -> (Option<ShownValue>, Result<(), StatusCode>) {
        let before = self.remove(topic);
        let size = shown.size();
        let room = self.most.saturating_sub(self.bytes);
        let kept = if size <= room {
            self.bytes += size;
            Ok(())
        } else {
            shown.block = None;
            shown.stamp.status = StatusCode::BadOutOfMemory;
            Err(StatusCode::BadOutOfMemory)
        };
        self.topics.insert(topic, shown);
        (before, kept)
    }

    pub(crate) fn remove(&mut self, topic: TopicId) -> Option<ShownValue> {
        let shown = self.topics.remove(&topic)?;
        self.bytes -= shown.size();
        Some(shown)
    }
}

impl ShownValue {
    /// Returns a missing value with this status.
    pub(crate) fn nothing(status: StatusCode) -> Self {
        Self {
            block: None,
            stamp: SampleStamp {
                status,
                source: None,
                server: DateTime::now(),
            },
        }
    }

    /// Returns the state before the first value.
    pub(crate) fn waiting() -> Self {
        Self::nothing(StatusCode::BadWaitingForInitialData)
    }

    fn size(&self) -> usize {
        self.block.as_ref().map_or(0, Bytes::len)
    }

    /// Returns the value of the topic's own node, or of the field with this index.
    pub(crate) fn view(&self, topic: &TopicNode, field: Option<usize>) -> NodeView<'_> {
        let Some(fields) = self.fields() else {
            return NodeView::One(uadp::Variant::Null, self.stamp);
        };
        let place = match field {
            None if topic.compound || fields.len() != 1 => {
                return NodeView::All(fields, self.stamp);
            }
            None => 0,
            Some(place) => place,
        };
        let value = fields.clone().nth(place).and_then(Result::ok);
        self.one(topic, place, value.unwrap_or(uadp::Variant::Null))
    }

    /// Returns the value of each of the topic's nodes, in the order of [`TopicNode::places`].
    pub(crate) fn views<'a>(&'a self, topic: &'a TopicNode) -> impl Iterator<Item = NodeView<'a>> {
        let mut fields = self.fields();
        let components = topic.places().filter_map(|(_, field)| field);
        let components = components.map(move |place| {
            let value = fields.as_mut().and_then(Iterator::next);
            let value = value.and_then(Result::ok);
            self.one(topic, place, value.unwrap_or(uadp::Variant::Null))
        });
        std::iter::once(self.view(topic, None)).chain(components)
    }

    /// Returns the value of the field with this index.
    fn one<'a>(
        &'a self,
        topic: &TopicNode,
        place: usize,
        value: uadp::Variant<'a>,
    ) -> NodeView<'a> {
        // A StatusCode in place of a value of another type is the reason why there is no value (OPC
        // 10000-14, 7.2.4.5.5).
        if let uadp::Variant::Scalar(Scalar::StatusCode(status)) = value
            && let Some(field) = topic.fields.get(place)
            && !field.shape.fits(&value)
        {
            let status = StatusCode::from(status.0);
            let stamp = SampleStamp {
                status,
                ..self.stamp
            };
            return NodeView::One(uadp::Variant::Null, stamp);
        }
        NodeView::One(value, self.stamp)
    }

    /// Returns the fields, if there are values.
    pub(crate) fn fields(&self) -> Option<Fields<'_>> {
        Fields::parse(self.block.as_ref()?).ok()
    }
}

/// The encoded value of a node.
#[derive(Debug, Clone)]
pub(crate) enum NodeView<'a> {
    One(uadp::Variant<'a>, SampleStamp),
    /// All fields, which are shown as a Variant array.
    All(Fields<'a>, SampleStamp),
}

impl<'a> NodeView<'a> {
    pub(crate) const fn stamp(&self) -> SampleStamp {
        match self {
            Self::One(_, stamp) | Self::All(_, stamp) => *stamp,
        }
    }

    /// Returns true if both values are equal. Their statuses are not compared.
    pub(crate) fn has_value_of(&self, other: &NodeView<'_>) -> bool {
        match (self, other) {
            (Self::One(value, _), NodeView::One(other, _)) => value == other,
            (Self::All(fields, _), NodeView::All(others, _)) => fields.bytes() == others.bytes(),
            (Self::One(..), NodeView::All(..)) | (Self::All(..), NodeView::One(..)) => false,
        }
    }

    /// Applies an IndexRange to an encoded array with elements of a fixed size. Other values are
    /// returned whole, with the range still to be applied.
    pub(crate) fn narrowed(self, range: &NumericRange) -> (Self, NumericRange) {
        if let Self::One(uadp::Variant::Array(array), stamp) = self
            && let Some((first, last)) = bounds(range)
            && let Some(part) = part(array, first, last)
        {
            return (
                Self::One(uadp::Variant::Array(part), stamp),
                NumericRange::None,
            );
        }
        (self, range.clone())
    }

    /// Returns the approximate size of the decoded value, in bytes.
    pub(crate) fn weight(&self) -> usize {
        match self {
            Self::One(value, _) => weight(value),
            Self::All(fields, _) => fields
                .clone()
                .flatten()
                .map(|field| weight(&field) + BOXED)
                .sum(),
        }
    }

    /// Decodes the value with its stamps. If the range cannot be applied, the status is the error
    /// of the range.
    pub(crate) fn data_value(&self, range: &NumericRange) -> DataValue {
        let value = match self {
            Self::One(value, _) => value::from_field(value),
            Self::All(fields, _) => Variant::Array(Box::new(Array {
                value_type: VariantScalarTypeId::Variant,
                values: fields
                    .clone()
                    .flatten()
                    .map(|field| Variant::Variant(Box::new(value::from_field(&field))))
                    .collect(),
                dimensions: None,
            })),
        };
        let stamp = self.stamp();
        // Without a value, its status is more useful than an error of the range.
        if matches!(value, Variant::Empty) {
            return data_value(Some(value), stamp);
        }
        match value.range_of_owned(range) {
            Ok(value) => data_value(Some(value), stamp),
            Err(status) => data_value(None, SampleStamp { status, ..stamp }),
        }
    }

    /// Returns an empty DataValue. It differs from every value, including null, so subscribers are
    /// notified of the value after it.
    pub(crate) fn between(&self) -> DataValue {
        data_value(None, self.stamp())
    }

    /// Returns a DataValue without the value and with the reason.
    pub(crate) fn refused(&self, status: StatusCode) -> DataValue {
        let stamp = self.stamp();
        data_value(Some(Variant::Empty), SampleStamp { status, ..stamp })
    }
}

/// Returns a value of a sample as a DataValue.
pub(crate) fn data_value(value: Option<Variant>, stamp: SampleStamp) -> DataValue {
    DataValue {
        value,
        status: Some(stamp.status),
        source_timestamp: stamp.source.map(|source| value::date_time(source.time)),
        // asyncua reads the picoseconds as the first bytes of the server timestamp, because its
        // order of the fields is not the order of OPC 10000-6, 5.2.2.17. The picoseconds are
        // therefore omitted: the resolution stays 100 ns, and clients read correct times.
        source_picoseconds: None,
        server_timestamp: Some(stamp.server),
        server_picoseconds: None,
    }
}

/// Returns the bytes without spare capacity, which may be many times as large, because buffers of
/// the Router are reused.
pub(crate) fn compact(payload: Bytes) -> Bytes {
    match payload.try_into_mut() {
        Ok(buffer) if buffer.capacity() - buffer.len() <= SLACK => buffer.freeze(),
        Ok(buffer) => Bytes::copy_from_slice(&buffer),
        Err(shared) => shared,
    }
}

/// Returns the first and last element of a one-dimensional range.
fn bounds(range: &NumericRange) -> Option<(usize, usize)> {
    let (first, last) = if let NumericRange::Index(at) = range {
        (*at, *at)
    } else if let NumericRange::Range(first, last) = range {
        (*first, *last)
    } else {
        return None;
    };
    Some((usize::try_from(first).ok()?, usize::try_from(last).ok()?))
}

/// Returns the part of an array. Returns `None` for elements of variable size, and for an empty
/// range.
fn part(array: uadp::Array<'_>, first: usize, last: usize) -> Option<uadp::Array<'_>> {
    let size = array.element().fixed_size()?;
    let last = last.min(array.len().checked_sub(1)?);
    let count = last.checked_sub(first)? + 1;
    let at = first.checked_mul(size)?;
    let bytes = array.bytes().get(at..at + count.checked_mul(size)?)?;
    uadp::Array::new(array.element(), count, bytes).ok()
}

fn weight(value: &uadp::Variant<'_>) -> usize {
    let elements = |array: &uadp::Array<'_>| {
        let element = array.element();
        if matches!(element, BuiltinType::Variant | BuiltinType::DataValue) {
            array.iter().map(|element| scalar_weight(&element)).sum()
        } else if is_boxed(element) {
            array.len() * (VARIANT + BOXED) + array.bytes().len()
        } else {
            array.len() * VARIANT
        }
    };
    match value {
        uadp::Variant::Null => VARIANT,
        uadp::Variant::Scalar(scalar) => scalar_weight(scalar),
        uadp::Variant::Array(array) => VARIANT + elements(array),
        uadp::Variant::Matrix(matrix) => VARIANT + elements(&matrix.elements()),
    }
}

fn scalar_weight(value: &Scalar<'_>) -> usize {
    if !is_boxed(value.builtin_type()) {
        return VARIANT;
    }
    let inner = match value {
        Scalar::Variant(inner) => inner.get().as_ref().map_or(0, weight),
        Scalar::DataValue(inner) => {
            let inner = inner.get().unwrap_or_default();
            inner.value.as_ref().map_or(0, weight)
        }
        Scalar::String(text) | Scalar::XmlElement(text) => text.map_or(0, str::len),
        Scalar::LocalizedText(text) => text.text.map_or(0, str::len),
        Scalar::ByteString(bytes) => bytes.map_or(0, <[u8]>::len),
        Scalar::ExtensionObject(object) => match object.body {
            uadp::ExtensionBody::None => 0,
            uadp::ExtensionBody::Binary(bytes) => bytes.len(),
            uadp::ExtensionBody::Xml(text) => text.len(),
        },
        // The values are as large as their types, or a few bytes larger.
        Scalar::DateTime(_)
        | Scalar::Guid(_)
        | Scalar::NodeId(_)
        | Scalar::ExpandedNodeId(_)
        | Scalar::QualifiedName(_)
        | Scalar::DiagnosticInfo(_)
        | Scalar::Boolean(_)
        | Scalar::SByte(_)
        | Scalar::Byte(_)
        | Scalar::Int16(_)
        | Scalar::UInt16(_)
        | Scalar::Int32(_)
        | Scalar::UInt32(_)
        | Scalar::Int64(_)
        | Scalar::UInt64(_)
        | Scalar::Float(_)
        | Scalar::Double(_)
        | Scalar::StatusCode(_) => 0,
    };
    VARIANT + BOXED + inner
}

/// Returns true if the Variant of the server stores such a value in a separate allocation.
const fn is_boxed(builtin: BuiltinType) -> bool {
    !builtin.is_number() && !matches!(builtin, BuiltinType::Boolean | BuiltinType::StatusCode)
}

const VARIANT: usize = size_of::<Variant>();
/// Approximate size of a value outside its Variant, including its allocation.
const BOXED: usize = 2 * size_of::<DataValue>();
/// Spare capacity that is not worth a copy.
const SLACK: usize = 64;

#[cfg(test)]
mod tests {
    use opcua::types::NodeId;

    use super::*;
    use crate::layout::VariableShape;

    fn id(identifier: u16) -> TopicId {
        TopicId::new(1, 2, identifier).unwrap()
    }

    /// Returns a topic with that number of SByte arrays.
    fn topic(fields: usize) -> TopicNode {
        let shape = VariableShape(Some((BuiltinType::SByte, true)));
        let fields = (0..fields).map(|at| (format!("f{at}"), shape)).collect();
        TopicNode::new(id(10), NodeId::new(2, 10), "x".to_owned(), fields)
    }

    fn bytes(values: &[i8]) -> Variant {
        Variant::from(values.to_vec())
    }

    fn shown(fields: &[Variant]) -> ShownValue {
        ShownValue {
            block: Some(Bytes::from(value::fields_block(fields).unwrap())),
            stamp: SampleStamp {
                status: StatusCode::Good,
                source: None,
                server: DateTime::now(),
            },
        }
    }

    fn read(shown: &ShownValue, topic: &TopicNode, field: Option<usize>, range: &str) -> DataValue {
        let range: NumericRange = range.parse().unwrap();
        let (view, range) = shown.view(topic, field).narrowed(&range);
        view.data_value(&range)
    }

    #[test]
    fn no_more_is_kept_than_there_is_room_for_and_what_gives_way_makes_room() {
        let mut values = CurrentValues::new(100);
        let sized = |size| ShownValue {
            block: Some(Bytes::from(vec![0; size])),
            ..ShownValue::nothing(StatusCode::Good)
        };
        assert_eq!(values.put(id(1), sized(60)).1, Ok(()));
        let (before, kept) = values.put(id(2), sized(41));
        assert!(before.is_none());
        assert_eq!(kept, Err(StatusCode::BadOutOfMemory));
        let refused = values.get(id(2)).unwrap();
        assert_eq!(refused.stamp.status, StatusCode::BadOutOfMemory);
        assert!(refused.block.is_none());
        assert_eq!(
            values.put(id(1), sized(100)).1,
            Ok(()),
            "its own room counts"
        );
        values.remove(id(1));
        assert_eq!(values.put(id(2), sized(100)).1, Ok(()));
        assert_eq!(values.bytes, 100);
    }

    #[test]
    fn a_node_has_its_field_and_that_of_the_topic_all_of_them() {
        let (topic, fields) = (topic(2), [bytes(&[1, 2]), bytes(&[3])]);
        let shown = shown(&fields);
        assert_eq!(
            read(&shown, &topic, Some(1), "").value.as_ref(),
            Some(&fields[1])
        );
        let all = Array {
            value_type: VariantScalarTypeId::Variant,
            values: fields
                .map(|field| Variant::Variant(Box::new(field)))
                .to_vec(),
            dimensions: None,
        };
        let all = Variant::Array(Box::new(all));
        assert_eq!(read(&shown, &topic, None, "").value, Some(all));
    }

    #[test]
    fn an_index_range_of_a_large_array_takes_up_no_more_than_itself() {
        let topic = topic(1);
        let mut elements = vec![0; 10_000_000];
        elements[9_000_000..9_000_003].copy_from_slice(&[7, 8, 9]);
        let block = {
            let mut block = vec![1, 0, 0x82];
            block.extend_from_slice(&10_000_000_u32.to_le_bytes());
            block.extend_from_slice(&elements);
            Bytes::from(block)
        };
        let mut shown = shown(&[]);
        shown.block = Some(block);
        assert!(shown.view(&topic, None).weight() > 200_000_000);
        let range: NumericRange = "9000000:9000002".parse().unwrap();
        let (view, _) = shown.view(&topic, None).narrowed(&range);
        assert!(view.weight() < 200);
        for (range, wanted) in [
            ("9000000:9000002", Ok(bytes(&[7, 8, 9]))),
            ("9999999:20000000", Ok(bytes(&[0]))),
            ("9000001", Ok(bytes(&[8]))),
        ] {
            let found = read(&shown, &topic, None, range);
            assert_eq!(found.value.ok_or(found.status), wanted, "{range}");
        }
    }

    #[test]
    fn an_index_range_is_the_same_of_the_encoded_value_as_of_the_decoded_one() {
        let topic = topic(1);
        let open = TopicNode::new(id(10), NodeId::new(2, 10), "x".to_owned(), vec![]);
        let text = Variant::from("four");
        let strings = Variant::from(vec!["a".to_owned(), "b".to_owned(), "c".to_owned()]);
        for (topic, whole) in [
            (&topic, bytes(&[1, 2, 3, 4])),
            (&topic, bytes(&[])),
            (&open, text),
            (&open, strings),
            (&open, Variant::from(3.5)),
        ] {
            for range in ["", "0", "1:2", "2:9", "4", "7:8", "1:2,0:1"] {
                let parsed: NumericRange = range.parse().unwrap();
                let found = read(&shown(std::slice::from_ref(&whole)), topic, None, range);
                match whole.range_of(&parsed) {
                    Ok(value) => assert_eq!(found.value, Some(value), "{whole:?} {range}"),
                    Err(status) => {
                        assert_eq!((found.value, found.status), (None, Some(status)), "{range}");
                    }
                }
            }
        }
    }

    #[test]
    fn a_status_in_the_place_of_a_value_is_the_nodes_and_an_empty_topic_has_its_own() {
        let topic = topic(2);
        let shown = shown(&[Variant::StatusCode(StatusCode::BadNoData), bytes(&[3])]);
        let found = read(&shown, &topic, Some(0), "0:1");
        assert_eq!(found.value, Some(Variant::Empty));
        assert_eq!(found.status, Some(StatusCode::BadNoData));
        assert_eq!(
            read(&shown, &topic, Some(1), "").status,
            Some(StatusCode::Good)
        );
        let nothing = ShownValue::nothing(StatusCode::BadTypeMismatch);
        let found = read(&nothing, &topic, None, "");
        assert_eq!(found.value, Some(Variant::Empty));
        assert_eq!(found.status, Some(StatusCode::BadTypeMismatch));
    }

    #[test]
    fn the_room_behind_a_small_value_is_not_kept() {
        let mut buffer = Vec::with_capacity(100_000);
        buffer.extend_from_slice(&[1, 2, 3]);
        let before = buffer.as_ptr();
        let kept = compact(Bytes::from(buffer));
        assert_eq!(kept[..], [1, 2, 3]);
        assert_ne!(kept.as_ptr(), before, "it is where the large buffer was");
        let large = Bytes::from(vec![7; 100_000]);
        let before = large.as_ptr();
        assert_eq!(
            compact(large).as_ptr(),
            before,
            "a value that fits is not copied"
        );
    }
}
