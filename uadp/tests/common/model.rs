//! Owned values of every type, which the values of the crate borrow from, and their generators.

use proptest::collection::vec;
use proptest::option;
use proptest::prelude::*;
use uadp::{
    Array, BuiltinType, DataSetHeader, DataValue, DateTime, DiagnosticInfo, ExpandedNodeId,
    ExtensionBody, ExtensionObject, Guid, LocalizedText, Matrix, Nested, NetworkHeader,
    NetworkMessageEncoder, NodeId, NodeIdValue, QualifiedName, Scalar, StatusCode, Variant,
};

/// Data that a [`Scalar`] of any type borrows from.
#[derive(Debug, Clone)]
pub(crate) struct Seed {
    builtin: BuiltinType,
    number: u64,
    wide: [u8; 16],
    text: Option<String>,
    other_text: Option<String>,
    bytes: Option<Vec<u8>>,
    choice: u8,
    inside: Inside,
}

/// The nested value of a value. `Seed::bytes` is its encoding.
#[derive(Debug, Clone)]
enum Inside {
    Nothing,
    Variant(Box<ModelVariant>),
    DataValue(Box<ModelDataValue>),
    DiagnosticInfo(Box<ModelDiagnosticInfo>),
}

/// A Variant.
#[derive(Debug, Clone)]
pub(crate) enum ModelVariant {
    Null,
    Scalar(Box<Seed>),
    Array(ModelElements),
    Matrix(ModelElements, Vec<[u8; 4]>),
}

/// The elements of an array and their encoding.
#[derive(Debug, Clone)]
pub(crate) struct ModelElements {
    pub(crate) builtin: BuiltinType,
    /// `None` is the null array.
    pub(crate) seeds: Option<Vec<Seed>>,
    bytes: Vec<u8>,
}

/// A DataValue.
#[derive(Debug, Clone)]
pub(crate) struct ModelDataValue {
    value: Option<ModelVariant>,
    rest: DataValue<'static>,
}

/// A DiagnosticInfo; `inner` includes its encoding.
#[derive(Debug, Clone)]
pub(crate) struct ModelDiagnosticInfo {
    indexes: [Option<i32>; 4],
    text: Option<Option<String>>,
    status: Option<u32>,
    inner: Option<(Box<Self>, Vec<u8>)>,
}

impl Seed {
    /// Returns a seed of a type that contains values.
    fn holding(inside: Inside) -> Self {
        let mut bytes = Vec::new();
        let builtin = match &inside {
            Inside::Variant(value) => {
                Nested::variant(&value.variant(), &mut bytes).unwrap();
                BuiltinType::Variant
            }
            Inside::DataValue(sample) => {
                Nested::data_value(&sample.data_value(), &mut bytes).unwrap();
                BuiltinType::DataValue
            }
            Inside::DiagnosticInfo(info) => {
                Nested::diagnostic_info(&info.diagnostic_info(), &mut bytes).unwrap();
                BuiltinType::DiagnosticInfo
            }
            Inside::Nothing => unreachable!("no type holds nothing"),
        };
        Self {
            builtin,
            number: 0,
            wide: [0; 16],
            text: None,
            other_text: None,
            bytes: Some(bytes),
            choice: 0,
            inside,
        }
    }

    fn node_id(&self) -> NodeId<'_> {
        let [a, b, ..] = self.wide;
        let namespace = match self.choice & 3 {
            0 => 0,
            1 => u16::from(a),
            _ => u16::from_le_bytes([a, b]),
        };
        let identifier = match self.choice >> 2 & 7 {
            0 => NodeIdValue::Numeric((self.number & 0xFF) as u32),
            1 => NodeIdValue::Numeric((self.number & 0xFFFF) as u32),
            2 | 3 => NodeIdValue::Numeric((self.number & 0xFFFF_FFFF) as u32),
            4 => NodeIdValue::Guid(Guid(self.wide)),
            5 => NodeIdValue::Opaque(self.bytes.as_deref()),
            _ => NodeIdValue::String(self.text.as_deref()),
        };
        NodeId {
            namespace,
            identifier,
        }
    }

    pub(crate) fn scalar(&self) -> Scalar<'_> {
        let [a, b, c, d, e, f, g, h] = self.number.to_le_bytes();
        let eight = self.number.to_le_bytes();
        let inside = self.bytes.as_deref().unwrap_or_default();
        match self.builtin {
            BuiltinType::Boolean => Scalar::Boolean(a & 1 == 1),
            BuiltinType::SByte => Scalar::SByte(i8::from_le_bytes([a])),
            BuiltinType::Byte => Scalar::Byte(a),
            BuiltinType::Int16 => Scalar::Int16(i16::from_le_bytes([a, b])),
            BuiltinType::UInt16 => Scalar::UInt16(u16::from_le_bytes([a, b])),
            BuiltinType::Int32 => Scalar::Int32(i32::from_le_bytes([a, b, c, d])),
            BuiltinType::UInt32 => Scalar::UInt32(u32::from_le_bytes([e, f, g, h])),
            BuiltinType::Int64 => Scalar::Int64(i64::from_le_bytes(eight)),
            BuiltinType::UInt64 => Scalar::UInt64(self.number),
            BuiltinType::Float => Scalar::Float(f32::from_le_bytes([a, b, c, d])),
            BuiltinType::Double => Scalar::Double(f64::from_le_bytes(eight)),
            BuiltinType::String => Scalar::String(self.text.as_deref()),
            BuiltinType::DateTime => Scalar::DateTime(DateTime(i64::from_le_bytes(eight))),
            BuiltinType::Guid => Scalar::Guid(Guid(self.wide)),
            BuiltinType::ByteString => Scalar::ByteString(self.bytes.as_deref()),
            BuiltinType::XmlElement => Scalar::XmlElement(self.text.as_deref()),
            BuiltinType::NodeId => Scalar::NodeId(self.node_id()),
            BuiltinType::ExpandedNodeId => Scalar::ExpandedNodeId(ExpandedNodeId {
                node_id: self.node_id(),
                namespace_uri: self.other_text.as_deref(),
                server_index: u32::from(a & 3),
            }),
            BuiltinType::StatusCode => {
                Scalar::StatusCode(StatusCode(u32::from_le_bytes([a, b, c, d])))
            }
            BuiltinType::QualifiedName => Scalar::QualifiedName(QualifiedName {
                namespace: u16::from_le_bytes([a, b]),
                name: self.text.as_deref(),
            }),
            BuiltinType::LocalizedText => Scalar::LocalizedText(LocalizedText {
                locale: self.other_text.as_deref(),
                text: self.text.as_deref(),
            }),
            BuiltinType::ExtensionObject => Scalar::ExtensionObject(ExtensionObject {
                type_id: self.node_id(),
                body: match (&self.bytes, &self.other_text) {
                    (Some(bytes), _) => ExtensionBody::Binary(bytes),
                    (None, Some(text)) => ExtensionBody::Xml(text),
                    (None, None) => ExtensionBody::None,
                },
            }),
            BuiltinType::DataValue => Scalar::DataValue(Nested::new(inside).unwrap()),
            BuiltinType::Variant => Scalar::Variant(Nested::new(inside).unwrap()),
            BuiltinType::DiagnosticInfo => Scalar::DiagnosticInfo(Nested::new(inside).unwrap()),
        }
    }

    /// Compares bits, so that a NaN equals the same NaN, including all nested values.
    fn is(&self, found: &Scalar<'_>) -> bool {
        match (found, self.scalar(), &self.inside) {
            (Scalar::Float(a), Scalar::Float(b), _) => a.to_bits() == b.to_bits(),
            (Scalar::Double(a), Scalar::Double(b), _) => a.to_bits() == b.to_bits(),
            (Scalar::Variant(found), _, Inside::Variant(value)) => value.is(&found.get().unwrap()),
            (Scalar::DataValue(found), _, Inside::DataValue(sample)) => {
                sample.is(&found.get().unwrap())
            }
            (Scalar::DiagnosticInfo(found), _, Inside::DiagnosticInfo(info)) => {
                info.is(&found.get().unwrap())
            }
            (found, sent, Inside::Nothing) => *found == sent,
            _ => false,
        }
    }
}

impl ModelElements {
    fn new(builtin: BuiltinType, seeds: Option<Vec<Seed>>) -> Self {
        let mut out = Vec::new();
        let header = NetworkHeader::default();
        let mut message = NetworkMessageEncoder::new(&mut out, &header, None).unwrap();
        let mut fields = message.key_frame(&DataSetHeader::default()).unwrap();
        let elements = seeds.as_deref().unwrap_or_default();
        fields.array(builtin, elements.len()).unwrap();
        for seed in elements {
            fields.element(seed.scalar()).unwrap();
        }
        fields.finish().unwrap();
        message.finish().unwrap();
        // The elements follow two flag bytes, the FieldCount, the encoding byte and the array
        // length.
        let bytes = out.split_off(9);
        Self {
            builtin,
            seeds,
            bytes,
        }
    }

    fn array(&self) -> Array<'_> {
        match &self.seeds {
            Some(seeds) => Array::new(self.builtin, seeds.len(), &self.bytes).unwrap(),
            None => Array::null(self.builtin),
        }
    }

    fn is(&self, found: Array<'_>) -> bool {
        let seeds = self.seeds.as_deref().unwrap_or_default();
        found.element() == self.builtin
            && found.is_null() == self.seeds.is_none()
            && found.len() == seeds.len()
            && found.iter().len() == seeds.len()
            && found.iter().count() == seeds.len()
            && found.iter().zip(seeds).all(|(found, seed)| seed.is(&found))
    }
}

impl ModelVariant {
    pub(crate) fn variant(&self) -> Variant<'_> {
        match self {
            Self::Null => Variant::Null,
            Self::Scalar(seed) => Variant::Scalar(seed.scalar()),
            Self::Array(elements) => Variant::Array(elements.array()),
            Self::Matrix(elements, dimensions) => {
                Variant::Matrix(Matrix::new(elements.array(), dimensions).unwrap())
            }
        }
    }

    pub(crate) fn is(&self, found: &Variant<'_>) -> bool {
        match (self, found) {
            (Self::Null, Variant::Null) => true,
            (Self::Scalar(seed), Variant::Scalar(found)) => seed.is(found),
            (Self::Array(elements), Variant::Array(found)) => elements.is(*found),
            (Self::Matrix(elements, dimensions), Variant::Matrix(found)) => {
                let sizes = dimensions.iter().map(|size| u32::from_le_bytes(*size));
                elements.is(found.elements()) && found.dimensions().eq(sizes)
            }
            _ => false,
        }
    }
}

impl ModelDataValue {
    pub(crate) fn data_value(&self) -> DataValue<'_> {
        DataValue {
            value: self.value.as_ref().map(ModelVariant::variant),
            ..self.rest
        }
    }

    pub(crate) fn is(&self, found: &DataValue<'_>) -> bool {
        let value = match (&self.value, &found.value) {
            (Some(value), Some(found)) => value.is(found),
            (None, None) => true,
            _ => false,
        };
        let rest = DataValue {
            value: None,
            ..*found
        };
        value && rest == self.rest
    }
}

impl ModelDiagnosticInfo {
    fn diagnostic_info(&self) -> DiagnosticInfo<'_> {
        let [symbolic_id, namespace_uri, locale, localized_text] = self.indexes;
        let inner = self.inner.as_ref();
        DiagnosticInfo {
            symbolic_id,
            namespace_uri,
            locale,
            localized_text,
            additional_info: self.text.as_ref().map(Option::as_deref),
            inner_status_code: self.status.map(StatusCode),
            inner: inner.map(|(_, bytes)| Nested::new(bytes).unwrap()),
        }
    }

    fn is(&self, found: &DiagnosticInfo<'_>) -> bool {
        let inner = match (&self.inner, found.inner) {
            (Some((inner, _)), Some(found)) => inner.is(&found.get().unwrap()),
            (None, None) => true,
            _ => false,
        };
        inner && *found == self.diagnostic_info()
    }
}

/// Generates a Variant that contains several levels of values.
pub(crate) fn value() -> impl Strategy<Value = ModelVariant> {
    let leaf = plain(1..=22).prop_map(|seed| ModelVariant::Scalar(Box::new(seed)));
    let leaf = prop_oneof![1 => Just(ModelVariant::Null), 6 => leaf];
    leaf.prop_recursive(4, 12, 3, |inner| {
        let holder = inner.clone();
        let scalar = prop_oneof![Just(23), Just(25)].prop_flat_map(move |id| seed(id, &holder));
        prop_oneof![
            2 => scalar.prop_map(|seed| ModelVariant::Scalar(Box::new(seed))),
            2 => elements(inner.clone(), 0..4_usize).prop_map(ModelVariant::Array),
            1 => matrix(inner),
        ]
    })
}

fn elements(
    inner: BoxedStrategy<ModelVariant>,
    count: impl Strategy<Value = usize>,
) -> impl Strategy<Value = ModelElements> {
    // Half of the elements contain values.
    let id = prop_oneof![1..=22_u8, 23..=25_u8];
    (id, count).prop_flat_map(move |(id, count)| {
        let builtin = BuiltinType::from_id(id).unwrap();
        let seeds = option::weighted(0.9, vec(seed(id, &inner), count));
        seeds.prop_map(move |seeds| ModelElements::new(builtin, seeds))
    })
}

/// Generates at least two non-empty dimensions, because any other matrix is encoded as an array.
fn matrix(inner: BoxedStrategy<ModelVariant>) -> impl Strategy<Value = ModelVariant> {
    vec(1..3_u32, 2..4).prop_flat_map(move |sizes| {
        let count = sizes.iter().product::<u32>() as usize;
        let dimensions: Vec<_> = sizes.iter().map(|size| size.to_le_bytes()).collect();
        elements(inner.clone(), Just(count))
            .prop_filter("null has no elements", |elements| elements.seeds.is_some())
            .prop_map(move |elements| ModelVariant::Matrix(elements, dimensions.clone()))
    })
}

pub(crate) fn sample(
    value: impl Strategy<Value = ModelVariant>,
) -> impl Strategy<Value = ModelDataValue> {
    let time = || (option::of(any::<i64>()), option::of(0..=9999_u16));
    let status = option::of(any::<u32>());
    (option::weighted(0.9, value), status, time(), time()).prop_map(
        |(value, status, source, server)| ModelDataValue {
            value,
            rest: DataValue {
                value: None,
                status: status.map(StatusCode),
                source_timestamp: source.0.map(DateTime),
                source_picoseconds: source.1,
                server_timestamp: server.0.map(DateTime),
                server_picoseconds: server.1,
            },
        },
    )
}

fn info() -> impl Strategy<Value = ModelDiagnosticInfo> {
    let head = || {
        let indexes = proptest::array::uniform4(option::of(any::<i32>()));
        let text = option::of(option::of(".{0,3}"));
        (indexes, text, option::of(any::<u32>())).prop_map(|(indexes, text, status)| {
            ModelDiagnosticInfo {
                indexes,
                text,
                status,
                inner: None,
            }
        })
    };
    head().prop_recursive(5, 5, 1, move |inner| {
        (head(), inner).prop_map(|(head, inner)| {
            let mut bytes = Vec::new();
            Nested::diagnostic_info(&inner.diagnostic_info(), &mut bytes).unwrap();
            ModelDiagnosticInfo {
                inner: Some((Box::new(inner), bytes)),
                ..head
            }
        })
    })
}

/// Generates a value of the type with an id. `inner` are its nested Variants.
fn seed(id: u8, inner: &BoxedStrategy<ModelVariant>) -> BoxedStrategy<Seed> {
    let inner = inner.clone();
    match BuiltinType::from_id(id).unwrap() {
        BuiltinType::Variant => inner
            .prop_map(|value| Seed::holding(Inside::Variant(Box::new(value))))
            .boxed(),
        BuiltinType::DataValue => sample(inner)
            .prop_map(|sample| Seed::holding(Inside::DataValue(Box::new(sample))))
            .boxed(),
        BuiltinType::DiagnosticInfo => info()
            .prop_map(|info| Seed::holding(Inside::DiagnosticInfo(Box::new(info))))
            .boxed(),
        _ => plain(id..=id).boxed(),
    }
}

/// Generates a value of a type that contains no other values.
fn plain(ids: std::ops::RangeInclusive<u8>) -> impl Strategy<Value = Seed> {
    (
        ids.prop_map(|id| BuiltinType::from_id(id).unwrap()),
        any::<u64>(),
        any::<[u8; 16]>(),
        option::of(".{0,6}"),
        option::of(".{0,3}"),
        option::of(vec(any::<u8>(), 0..9)),
        any::<u8>(),
    )
        .prop_map(
            |(builtin, number, wide, text, other_text, bytes, choice)| Seed {
                builtin,
                number,
                wide,
                text,
                other_text,
                bytes,
                choice,
                inside: Inside::Nothing,
            },
        )
}
