//! Encoding of values at fixed positions, and of structures as lists of such values.

use crate::reader::ByteReader;
use crate::writer;
use crate::{
    DateTime, DecodeError, EncodeError, ExtensionBody, ExtensionObject, Guid, LocalizedText,
    NodeId, QualifiedName, StatusCode, Variant,
};
use alloc::vec::Vec;

/// A value with a fixed encoding: a builtin type, an array or a structure (OPC 10000-6, 5.2.6).
pub(crate) trait WireStructure<'a>: Copy {
    /// The default value: null if the type has it, otherwise zero.
    const NULL: Self;
    /// Minimum encoded size in bytes. An array length is checked against it before the elements are
    /// decoded.
    const MIN_SIZE: usize;

    /// Decodes a value. `what` is the field name in errors; a structure uses the names of its
    /// fields.
    fn read(reader: &mut ByteReader<'a>, what: &'static str) -> Result<Self, DecodeError>;

    /// Appends the encoding. The parameter `what` has the meaning that it has in
    /// [`read`](Self::read).
    fn write(&self, out: &mut Vec<u8>, what: &'static str) -> Result<(), EncodeError>;
}

/// Numbers, little-endian.
macro_rules! number {
    ($($number:ty)+) => { $(
        impl WireStructure<'_> for $number {
            const NULL: Self = 0 as Self;
            const MIN_SIZE: usize = size_of::<Self>();

            #[inline]
            fn read(reader: &mut ByteReader<'_>, what: &'static str) -> Result<Self, DecodeError> {
                reader.array(what).map(Self::from_le_bytes)
            }

            #[inline]
            fn write(&self, out: &mut Vec<u8>, _: &'static str) -> Result<(), EncodeError> {
                out.extend_from_slice(&self.to_le_bytes());
                Ok(())
            }
        }
    )+ };
}

number! { u8 u16 u32 i32 i64 f64 }

/// Types that wrap a value of another type.
macro_rules! wrapped {
    ($($wrapper:ident($inner:ty))+) => { $(
        impl WireStructure<'_> for $wrapper {
            const NULL: Self = Self(<$inner as WireStructure<'_>>::NULL);
            const MIN_SIZE: usize = <$inner as WireStructure<'_>>::MIN_SIZE;

            #[inline]
            fn read(reader: &mut ByteReader<'_>, what: &'static str) -> Result<Self, DecodeError> {
                WireStructure::read(reader, what).map(Self)
            }

            #[inline]
            fn write(&self, out: &mut Vec<u8>, what: &'static str) -> Result<(), EncodeError> {
                self.0.write(out, what)
            }
        }
    )+ };
}

wrapped! { StatusCode(u32) DateTime(i64) }

/// Builtin types with `read` and `write` functions.
macro_rules! builtin {
    ($($builtin:ident: $null:expr, $min_size:literal;)+) => { $(
        impl<'a> WireStructure<'a> for $builtin<'a> {
            const NULL: Self = $null;
            const MIN_SIZE: usize = $min_size;

            #[inline]
            fn read(reader: &mut ByteReader<'a>, _: &'static str) -> Result<Self, DecodeError> {
                Self::read(reader)
            }

            #[inline]
            fn write(&self, out: &mut Vec<u8>, _: &'static str) -> Result<(), EncodeError> {
                Self::write(self, out)
            }
        }
    )+ };
}

builtin! {
    NodeId: Self::NULL, 2;
    QualifiedName: Self { namespace: 0, name: None }, 6;
    LocalizedText: Self { locale: None, text: None }, 1;
    Variant: Self::Null, 1;
    ExtensionObject: Self { type_id: NodeId::NULL, body: ExtensionBody::None }, 3;
}

impl WireStructure<'_> for bool {
    const NULL: Self = false;
    const MIN_SIZE: usize = 1;

    fn read(reader: &mut ByteReader<'_>, what: &'static str) -> Result<Self, DecodeError> {
        // Every value except 0 is true (OPC 10000-6, 5.2.2.1).
        reader.u8(what).map(|byte| byte != 0)
    }

    fn write(&self, out: &mut Vec<u8>, _: &'static str) -> Result<(), EncodeError> {
        out.push(u8::from(*self));
        Ok(())
    }
}

impl WireStructure<'_> for Guid {
    const NULL: Self = Self([0; 16]);
    const MIN_SIZE: usize = 16;

    fn read(reader: &mut ByteReader<'_>, what: &'static str) -> Result<Self, DecodeError> {
        reader.array(what).map(Self)
    }

    fn write(&self, out: &mut Vec<u8>, _: &'static str) -> Result<(), EncodeError> {
        out.extend_from_slice(&self.0);
        Ok(())
    }
}

impl<'a> WireStructure<'a> for Option<&'a str> {
    const NULL: Self = None;
    const MIN_SIZE: usize = 4;

    fn read(reader: &mut ByteReader<'a>, what: &'static str) -> Result<Self, DecodeError> {
        reader.text(what)
    }

    fn write(&self, out: &mut Vec<u8>, what: &'static str) -> Result<(), EncodeError> {
        writer::byte_string(out, self.map(str::as_bytes), what)
    }
}

impl<'a> WireStructure<'a> for Option<&'a [u8]> {
    const NULL: Self = None;
    const MIN_SIZE: usize = 4;

    fn read(reader: &mut ByteReader<'a>, what: &'static str) -> Result<Self, DecodeError> {
        reader.byte_string(what)
    }

    fn write(&self, out: &mut Vec<u8>, what: &'static str) -> Result<(), EncodeError> {
        writer::byte_string(out, *self, what)
    }
}

/// Decodes a value that spans all bytes.
pub(crate) fn read_all<'a, T: WireStructure<'a>>(
    bytes: &'a [u8],
    what: &'static str,
) -> Result<T, DecodeError> {
    let mut reader = ByteReader::new(bytes);
    let value = T::read(&mut reader, what)?;
    match reader.remaining() {
        0 => Ok(value),
        left => Err(DecodeError::TrailingBytes(left)),
    }
}

/// Defines structures of the standard by their fields in the order of the encoding, each with its
/// name in errors.
macro_rules! structure {
    ($(
        $(#[$meta:meta])*
        $name:ident $(<$lifetime:lifetime>)? {
            $( $(#[$field_meta:meta])* $field:ident: $type:ty = $label:literal, )+
        }
    )+) => { $(
        $(#[$meta])*
        #[derive(Debug, Clone, Copy, PartialEq)]
        pub struct $name $(<$lifetime>)? {
            $( $(#[$field_meta])* pub $field: $type, )+
        }

        impl<'a> crate::discovery::wire::WireStructure<'a> for $name $(<$lifetime>)? {
            const NULL: Self = Self {
                $( $field: <$type as crate::discovery::wire::WireStructure<'a>>::NULL, )+
            };
            const MIN_SIZE: usize =
                0 $( + <$type as crate::discovery::wire::WireStructure<'a>>::MIN_SIZE )+;

            fn read(
                reader: &mut crate::reader::ByteReader<'a>,
                _: &'static str,
            ) -> Result<Self, crate::DecodeError> {
                Ok(Self {
                    $( $field: crate::discovery::wire::WireStructure::read(
                        reader,
                        concat!(stringify!($name), " ", $label),
                    )?, )+
                })
            }

            fn write(
                &self,
                out: &mut alloc::vec::Vec<u8>,
                _: &'static str,
            ) -> Result<(), crate::EncodeError> {
                $( crate::discovery::wire::WireStructure::write(
                    &self.$field,
                    out,
                    concat!(stringify!($name), " ", $label),
                )?; )+
                Ok(())
            }
        }

        /// Every field is null, or zero if its type has no null.
        impl $(<$lifetime>)? Default for $name $(<$lifetime>)? {
            fn default() -> Self {
                <Self as crate::discovery::wire::WireStructure<'_>>::NULL
            }
        }
    )+ };
}

/// Defines enumerations of the standard. An enumeration is an Int32 that can also hold other values
/// than the named constants.
macro_rules! enumeration {
    ($(
        $(#[$meta:meta])*
        $name:ident { $( $(#[$value_meta:meta])* $constant:ident = $value:literal, )+ }
    )+) => { $(
        $(#[$meta])*
        #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default)]
        pub struct $name(pub i32);

        impl $name {
            $( $(#[$value_meta])* pub const $constant: Self = Self($value); )+
        }

        impl crate::discovery::wire::WireStructure<'_> for $name {
            const NULL: Self = Self(0);
            const MIN_SIZE: usize = 4;

            fn read(
                reader: &mut crate::reader::ByteReader<'_>,
                what: &'static str,
            ) -> Result<Self, crate::DecodeError> {
                reader.i32(what).map(Self)
            }

            fn write(
                &self,
                out: &mut alloc::vec::Vec<u8>,
                _: &'static str,
            ) -> Result<(), crate::EncodeError> {
                out.extend_from_slice(&self.0.to_le_bytes());
                Ok(())
            }
        }
    )+ };
}

pub(crate) use {enumeration, structure};
