//! Reads and writes RawData by its metadata (OPC 10000-14, 7.2.4.5.11).

use std::sync::LazyLock;

use uadp::{
    BuiltinType, DecodeError, Nested, NodeId, RawDialect, RawField, RawLayout, RawStructure,
    RawStructureType, RawValue, Variant,
};

use crate::arguments::RawReading;
use crate::fault::{PartialRead, in_field};
use crate::node_ids::OwnedNodeId;
use crate::shape::{FieldJson, FieldMetaData};
use crate::values::{JsonFieldValue, WrongValue, show_scalar, show_variant, variant_bytes};

/// The fields of a DataSet, with the properties that RawData uses.
#[derive(Debug)]
pub(crate) struct RawDataLayout<'a> {
    metadata: &'a [FieldMetaData],
    fields: Vec<RawField<'a>>,
    reading: RawReading,
}

impl<'a> RawDataLayout<'a> {
    /// Creates the layout. Fails if RawData cannot have these fields.
    pub(crate) fn new(
        metadata: &'a [FieldMetaData],
        reading: RawReading,
    ) -> Result<Self, WrongValue> {
        let mut fields = Vec::new();
        for (field, at) in metadata.iter().zip(0..) {
            let field = raw_field(field);
            fields.push(field.map_err(|wrong| wrong.at(&format!(".metaData[{at}]")))?);
        }
        RawLayout::new(&fields).map_err(|error| {
            WrongValue::new(error.fault.to_string()).at(&format!(".metaData[{}]", error.field))
        })?;
        Ok(Self {
            metadata,
            fields,
            reading,
        })
    }

    pub(crate) const fn reading(&self) -> RawReading {
        self.reading
    }

    const fn dialect(&self) -> RawDialect {
        match self.reading {
            RawReading::Standard => RawDialect::Standard,
            RawReading::Open62541 => RawDialect::Open62541,
        }
    }

    pub(crate) const fn metadata(&self) -> &'a [FieldMetaData] {
        self.metadata
    }

    /// Passes the fields of a payload to `each`; an error has the number of fields before it.
    pub(crate) fn read(
        &self,
        payload: &[u8],
        mut each: impl FnMut(FieldJson),
    ) -> Result<(), PartialRead> {
        let layout = RawLayout::new(&self.fields)
            .map_err(|_| (None, DecodeError::Misread("not what its metadata says")))?;
        for (value, at) in layout.read(payload, self.dialect()).zip(0..) {
            let value = value.and_then(|value| show_raw(&value));
            let value = value.map_err(|error| in_field(at, error))?;
            each(FieldJson { index: None, value });
        }
        Ok(())
    }

    /// Returns the payload of these fields.
    pub(crate) fn write(&self, fields: &[FieldJson]) -> Result<Vec<u8>, WrongValue> {
        let mut buffers = Vec::new();
        for (field, at) in fields.iter().zip(0..) {
            let bytes = variant_bytes(&field.value);
            buffers.push(bytes.map_err(|wrong| wrong.at(&format!(".fields[{at}].value")))?);
        }
        let mut values = Vec::new();
        for bytes in &buffers {
            values.push(Nested::<Variant<'_>>::new(bytes)?.get()?);
        }
        let layout =
            RawLayout::new(&self.fields).map_err(|error| WrongValue::new(error.to_string()))?;
        let mut payload = Vec::new();
        if !values.is_empty() {
            layout
                .write(&mut payload, self.dialect(), values)
                .map_err(|error| {
                    let path = format!(".fields[{}]", error.field);
                    WrongValue::new(error.fault.to_string()).at(&path)
                })?;
        }
        Ok(payload)
    }
}

fn raw_field(metadata: &FieldMetaData) -> Result<RawField<'_>, WrongValue> {
    let builtin = BuiltinType::from_id(metadata.built_in_type)
        .ok_or_else(|| WrongValue::new("1 to 25 are known").at(".builtInType"))?;
    let structure = match (builtin, &metadata.data_type) {
        (BuiltinType::ExtensionObject, Some(data_type)) => {
            let known = structure(data_type);
            let wrong = || WrongValue::new("of structures only i=884 and i=18814 are known here");
            Some(known.ok_or_else(|| wrong().at(".dataType"))?)
        }
        _ => None,
    };
    Ok(RawField {
        value_rank: metadata.value_rank,
        array_dimensions: &metadata.array_dimensions,
        max_string_length: metadata.max_string_length,
        structure,
        ..RawField::new(builtin)
    })
}

fn show_raw(value: &RawValue<'_>) -> Result<JsonFieldValue, DecodeError> {
    let array = match value {
        RawValue::Variant(variant) => return show_variant(variant),
        RawValue::Array(array) => array,
    };
    let dimensions: Vec<_> = array.dimensions().collect();
    Ok(JsonFieldValue {
        ua_type: Some(array.element().id()),
        value: Some(array.iter().map(show_scalar).collect::<Result<_, _>>()?),
        null_array: array.is_null(),
        dimensions: (!dimensions.is_empty()).then_some(dimensions),
        ..JsonFieldValue::default()
    })
}

/// Returns a known structure that RawData may hold; all its fields are Doubles.
fn structure(data_type: &str) -> Option<&'static RawStructure<'static>> {
    static RANGE: LazyStructure = LazyLock::new(|| doubles(NodeId::numeric(0, 886), &DOUBLES[..2]));
    static THREE_D_FRAME: LazyStructure =
        LazyLock::new(|| doubles(NodeId::numeric(0, 18823), &DOUBLES));
    let node_id = OwnedNodeId::parse(data_type)?;
    if node_id.node_id()? == NodeId::numeric(0, 884) {
        RANGE.as_ref()
    } else if node_id.node_id()? == NodeId::numeric(0, 18814) {
        THREE_D_FRAME.as_ref()
    } else {
        None
    }
}

type LazyStructure = LazyLock<Option<RawStructure<'static>>>;

fn doubles(
    encoding: NodeId<'static>,
    fields: &'static [RawField<'static>],
) -> Option<RawStructure<'static>> {
    RawStructure::new(encoding, RawStructureType::Structure, fields).ok()
}

/// A ThreeDFrame holds two structures of three Doubles, which are encoded inline as six Doubles.
static DOUBLES: [RawField<'static>; 6] = [RawField::new(BuiltinType::Double); 6];
