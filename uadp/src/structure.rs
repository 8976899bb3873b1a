//! Decodes the body of a structure with known fields.

use crate::reader::ByteReader;
use crate::{Array, BuiltinType, DecodeError, Scalar};

/// Reads the binary body of an [`ExtensionObject`](crate::ExtensionObject) field by field: values
/// without the encoding byte of a Variant (OPC 10000-6, 5.2.6). The caller has to know the fields.
#[derive(Debug, Clone)]
pub struct StructureReader<'a> {
    reader: ByteReader<'a>,
}

impl<'a> StructureReader<'a> {
    /// Maximum number of structures without fields in an array.
    pub const MAX_WITHOUT_FIELDS: usize = 65_536;

    /// Creates a reader at the start of a body.
    #[must_use]
    pub const fn new(body: &'a [u8]) -> Self {
        Self {
            reader: ByteReader::new(body),
        }
    }

    /// Reads the next field, a single value.
    ///
    /// # Errors
    /// Fails if the field is truncated or malformed.
    pub fn scalar(&mut self, builtin: BuiltinType) -> Result<Scalar<'a>, DecodeError> {
        Scalar::read(builtin, &mut self.reader)
    }

    /// Takes the next `count` fields at once: single values of `builtin`, a type of fixed size,
    /// little-endian and contiguous. Returns `None` and takes nothing if the body is too short.
    pub fn take_scalars(&mut self, builtin: BuiltinType, count: u16) -> Option<&'a [u8]> {
        let size = builtin.fixed_size()?;
        let len = usize::from(count).checked_mul(size)?;
        self.reader.bytes(len, "structure").ok()
    }

    /// Reads the next field, an array.
    ///
    /// # Errors
    /// As for [`scalar`](Self::scalar).
    pub fn array(&mut self, element: BuiltinType) -> Result<Array<'a>, DecodeError> {
        Array::read(element, &mut self.reader)
    }

    /// Reads the length of the next field, an array of structures by value. The fields of the
    /// structures follow inline. Returns `None` for null.
    ///
    /// Structures without fields have no bytes, so up to
    /// [`MAX_WITHOUT_FIELDS`](Self::MAX_WITHOUT_FIELDS) are accepted independent of the remaining
    /// bytes. Callers that read many such arrays have to limit their total.
    ///
    /// # Errors
    /// Fails if the length is negative or exceeds the maximum.
    pub fn length(&mut self) -> Result<Option<usize>, DecodeError> {
        let length = self.reader.length("array of structures")?;
        let most = self.reader.remaining().max(Self::MAX_WITHOUT_FIELDS);
        match length {
            Some(length) if length > most => Err(DecodeError::Limit {
                field: "array of structures",
                value: u32::try_from(length).unwrap_or(u32::MAX),
            }),
            other => Ok(other),
        }
    }

    /// Returns the number of unread bytes.
    #[must_use]
    pub const fn remaining(&self) -> usize {
        self.reader.remaining()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        DataSetHeader, Fields, NetworkHeader, NetworkMessage, NetworkMessageEncoder, NodeId,
    };
    use crate::{ExtensionBody, Variant};

    #[test]
    fn numbers_of_one_kind_are_written_and_taken_at_once_or_not_at_all() {
        let mut datagram = Vec::new();
        let mut message =
            NetworkMessageEncoder::new(&mut datagram, &NetworkHeader::default(), Some(&[1]))
                .unwrap();
        let mut frame = message.key_frame(&DataSetHeader::default()).unwrap();
        assert!(frame.scalars(BuiltinType::Int32, &[1, 0, 0]).is_err());
        assert!(frame.scalars(BuiltinType::String, &[1]).is_err());
        frame
            .scalars(BuiltinType::Int16, &[1, 0, 0xFE, 0xFF])
            .unwrap();
        frame.scalar(Scalar::Byte(7)).unwrap();
        frame.finish().unwrap();
        message.finish().unwrap();
        let message = NetworkMessage::decode(&datagram).unwrap();
        let message = message.messages().next().unwrap().unwrap();
        let mut fields = message.fields().unwrap();
        assert_eq!(fields.len(), 3);
        assert_eq!(fields.take_scalars(BuiltinType::Int16, 3), None);
        assert_eq!(fields.take_scalars(BuiltinType::Int16, 4), None);
        assert_eq!(fields.take_scalars(BuiltinType::UInt16, 2), None);
        let taken = fields.take_scalars(BuiltinType::Int16, 2).unwrap();
        assert_eq!(taken, [4, 1, 0, 4, 0xFE, 0xFF]);
        let rest: Vec<_> = fields.collect();
        assert_eq!(rest, [Ok(Variant::Scalar(Scalar::Byte(7)))]);
    }

    #[test]
    fn what_was_written_into_a_structure_is_read_back() {
        let mut datagram = Vec::new();
        let mut message =
            NetworkMessageEncoder::new(&mut datagram, &NetworkHeader::default(), Some(&[1]))
                .unwrap();
        let mut frame = message.key_frame(&DataSetHeader::default()).unwrap();
        frame.structures(1).unwrap();
        frame.begin_structure(NodeId::string(2, "a/B")).unwrap();
        frame.scalar(Scalar::Int16(-3)).unwrap();
        frame.packed_array(BuiltinType::Byte, 2, &[7, 8]).unwrap();
        frame.inline_structures(2).unwrap();
        frame.scalar(Scalar::String(Some("x"))).unwrap();
        frame.scalar(Scalar::String(Some("y"))).unwrap();
        frame.end_structure().unwrap();
        frame.finish().unwrap();
        message.finish().unwrap();

        let message = NetworkMessage::decode(&datagram)
            .unwrap()
            .messages()
            .next()
            .unwrap()
            .unwrap();
        let fields: Vec<_> = Fields::parse(message.fields().unwrap().bytes())
            .unwrap()
            .collect::<Result<_, _>>()
            .unwrap();
        let [Variant::Array(structures)] = fields[..] else {
            panic!("{fields:?}")
        };
        let Some(Scalar::ExtensionObject(object)) = structures.iter().next() else {
            panic!()
        };
        assert_eq!(object.type_id, NodeId::string(2, "a/B"));
        let ExtensionBody::Binary(body) = object.body else {
            panic!("{object:?}")
        };
        let mut structure = StructureReader::new(body);
        assert_eq!(structure.scalar(BuiltinType::Int16), Ok(Scalar::Int16(-3)));
        assert_eq!(structure.array(BuiltinType::Byte).unwrap().bytes(), [7, 8]);
        assert_eq!(structure.length(), Ok(Some(2)));
        assert_eq!(
            structure.scalar(BuiltinType::String),
            Ok(Scalar::String(Some("x")))
        );
        assert_eq!(
            structure.scalar(BuiltinType::String),
            Ok(Scalar::String(Some("y")))
        );
        assert_eq!(structure.remaining(), 0);
        assert!(
            structure.scalar(BuiltinType::Byte).is_err(),
            "nothing is left"
        );
    }

    #[test]
    fn structures_without_fields_are_counted_though_nothing_follows() {
        let mut structure = StructureReader::new(&[3, 0, 0, 0]);
        assert_eq!(structure.length(), Ok(Some(3)));
        assert_eq!(structure.remaining(), 0);
    }

    #[test]
    fn a_length_above_what_follows_is_refused() {
        let mut structure = StructureReader::new(&[0xff, 0xff, 0xff, 0x7f, 0]);
        assert!(matches!(structure.length(), Err(DecodeError::Limit { .. })));
    }
}
