//! Messages in the encoding of protobuf, written by hand because few fields are needed.

/// An encoded protobuf message.
#[derive(Debug, Default)]
pub(super) struct ProtobufMessage(Vec<u8>);

impl ProtobufMessage {
    /// Returns the encoded fields.
    pub(super) fn encoded(&self) -> &[u8] {
        &self.0
    }

    /// Returns the encoded fields.
    pub(super) fn into_bytes(self) -> Vec<u8> {
        self.0
    }

    /// Adds an attribute of OTLP with a text.
    pub(super) fn attribute(&mut self, field: u32, name: &str, value: &str) {
        self.message(field, |attribute| {
            attribute.text(KEY, name);
            attribute.message(VALUE, |any| any.text(STRING_VALUE, value));
        });
    }

    fn varint(&mut self, mut value: u64) {
        loop {
            let [low, ..] = value.to_le_bytes();
            value >>= 7;
            if value == 0 {
                self.0.push(low & 0x7f);
                return;
            }
            self.0.push(low | 0x80);
        }
    }

    /// Adds a field of the type uint or enum.
    pub(super) fn number(&mut self, field: u32, value: u64) {
        self.varint(u64::from(field) << 3);
        self.varint(value);
    }

    /// Adds a field of the type fixed64.
    pub(super) fn fixed(&mut self, field: u32, value: u64) {
        self.varint((u64::from(field) << 3) | 1);
        self.0.extend(value.to_le_bytes());
    }

    /// Adds a double.
    pub(super) fn double(&mut self, field: u32, value: f64) {
        self.fixed(field, value.to_bits());
    }

    /// Adds a field of the type bytes, or an encoded message.
    pub(super) fn bytes(&mut self, field: u32, bytes: &[u8]) {
        self.varint((u64::from(field) << 3) | 2);
        self.varint(u64::try_from(bytes.len()).unwrap_or_default());
        self.0.extend_from_slice(bytes);
    }

    /// Adds a string.
    pub(super) fn text(&mut self, field: u32, text: &str) {
        self.bytes(field, text.as_bytes());
    }

    /// Adds a message, which `fill` fills.
    pub(super) fn message(&mut self, field: u32, fill: impl FnOnce(&mut Self)) {
        let mut inner = Self::default();
        fill(&mut inner);
        self.bytes(field, &inner.0);
    }
}

/// Fields of KeyValue and AnyValue of OTLP.
const KEY: u32 = 1;
const VALUE: u32 = 2;
const STRING_VALUE: u32 = 1;

#[cfg(test)]
pub(super) mod tests {
    /// Reads a varint.
    fn varint(bytes: &mut &[u8]) -> u64 {
        let (mut value, mut shift) = (0, 0);
        loop {
            let (first, rest) = bytes.split_first().unwrap();
            *bytes = rest;
            value |= u64::from(first & 0x7f) << shift;
            shift += 7;
            if first & 0x80 == 0 {
                return value;
            }
        }
    }

    #[derive(Debug, PartialEq)]
    pub(crate) enum Value<'a> {
        Number(u64),
        Bytes(&'a [u8]),
    }

    /// Returns the fields of a message.
    pub(crate) fn fields(mut bytes: &[u8]) -> Vec<(u64, Value<'_>)> {
        let mut all = Vec::new();
        while !bytes.is_empty() {
            let key = varint(&mut bytes);
            let value = match key & 7 {
                0 => Value::Number(varint(&mut bytes)),
                1 => {
                    let (fixed, rest) = bytes.split_at(8);
                    bytes = rest;
                    Value::Number(u64::from_le_bytes(fixed.try_into().unwrap()))
                }
                2 => {
                    let length = usize::try_from(varint(&mut bytes)).unwrap();
                    let (inner, rest) = bytes.split_at(length);
                    bytes = rest;
                    Value::Bytes(inner)
                }
                other => panic!("wire type {other}"),
            };
            all.push((key >> 3, value));
        }
        all
    }

    #[test]
    fn fields_are_encoded_by_their_types() {
        let mut message = super::ProtobufMessage::default();
        message.number(1, 300);
        message.double(2, 1.5);
        message.message(3, |inner| inner.text(1, "a"));
        assert_eq!(message.encoded()[..3], [0x08, 0xac, 0x02]);
        let all = fields(message.encoded());
        assert_eq!(all[0], (1, Value::Number(300)));
        assert_eq!(all[1], (2, Value::Number(1.5_f64.to_bits())));
        assert_eq!(all[2], (3, Value::Bytes(&[0x0a, 1, b'a'])));
    }
}
