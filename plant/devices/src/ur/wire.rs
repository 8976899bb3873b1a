//! The wire format of RTDE, the Real-Time Data Exchange of Universal Robots, protocol version 2.
//!
//! A package is its length including the header (UInt16), a letter for its type, and a body; all
//! numbers are big-endian.

use std::io;

use tokio::io::{AsyncRead, AsyncReadExt as _};

/// The port of the robot.
pub const PORT: u16 = 30_004;
/// The supported protocol version.
pub const VERSION: u16 = 2;

/// The type of a package, with its letter.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Type {
    /// V: request of a protocol version
    Protocol,
    /// v: request of the controller version
    Controller,
    /// M: a text for people
    Text,
    /// U: values of a recipe
    Data,
    /// O: a recipe of outputs of the robot
    Outputs,
    /// I: a recipe of inputs of the robot
    Inputs,
    /// S: start of the outputs
    Start,
    /// P: pause of the outputs
    Pause,
}

impl Type {
    const ALL: [(Self, u8); 8] = [
        (Self::Protocol, b'V'),
        (Self::Controller, b'v'),
        (Self::Text, b'M'),
        (Self::Data, b'U'),
        (Self::Outputs, b'O'),
        (Self::Inputs, b'I'),
        (Self::Start, b'S'),
        (Self::Pause, b'P'),
    ];

    fn of(letter: u8) -> Option<Self> {
        Self::ALL
            .iter()
            .find(|(_, of)| *of == letter)
            .map(|(of, _)| *of)
    }

    fn letter(self) -> u8 {
        Self::ALL
            .iter()
            .find(|(of, _)| *of == self)
            .map_or(0, |(_, letter)| *letter)
    }
}

/// The type of a value.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RecipeType {
    /// A byte, 0 or 1.
    Bool,
    /// A byte.
    U8,
    /// Four bytes.
    U32,
    /// Eight bytes.
    U64,
    /// Four bytes with a sign.
    I32,
    /// Eight bytes of IEEE 754.
    F64,
    /// Six values of [`RecipeType::F64`].
    Vector,
    /// Three values of [`RecipeType::F64`].
    Triple,
    /// Six values of [`RecipeType::I32`].
    Whole,
}

impl RecipeType {
    const ALL: [(Self, &'static str); 9] = [
        (Self::Bool, "BOOL"),
        (Self::U8, "UINT8"),
        (Self::U32, "UINT32"),
        (Self::U64, "UINT64"),
        (Self::I32, "INT32"),
        (Self::F64, "DOUBLE"),
        (Self::Vector, "VECTOR6D"),
        (Self::Triple, "VECTOR3D"),
        (Self::Whole, "VECTOR6INT32"),
    ];

    /// Returns the type with a name.
    #[must_use]
    pub fn of(name: &str) -> Option<Self> {
        Self::ALL
            .iter()
            .find(|(_, of)| *of == name)
            .map(|(of, _)| *of)
    }

    /// Returns the name, such as `VECTOR6D`.
    #[must_use]
    pub fn name(self) -> &'static str {
        Self::ALL
            .iter()
            .find(|(of, _)| *of == self)
            .map_or("NOT_FOUND", |(_, name)| name)
    }

    /// Returns the zero value of the type.
    #[must_use]
    pub fn zero(self) -> RecipeValue {
        match self {
            Self::Bool => RecipeValue::Bool(false),
            Self::U8 => RecipeValue::U8(0),
            Self::U32 => RecipeValue::U32(0),
            Self::U64 => RecipeValue::U64(0),
            Self::I32 => RecipeValue::I32(0),
            Self::F64 => RecipeValue::F64(0.0),
            Self::Vector => RecipeValue::Vector([0.0; 6]),
            Self::Triple => RecipeValue::Triple([0.0; 3]),
            Self::Whole => RecipeValue::Whole([0; 6]),
        }
    }

    /// Reads a value of the type from the front of some bytes; returns `None` if they are too few.
    pub fn take(self, bytes: &mut &[u8]) -> Option<RecipeValue> {
        Some(match self {
            Self::Bool => RecipeValue::Bool(u8::from_be_bytes(chunk(bytes)?) != 0),
            Self::U8 => RecipeValue::U8(u8::from_be_bytes(chunk(bytes)?)),
            Self::U32 => RecipeValue::U32(u32::from_be_bytes(chunk(bytes)?)),
            Self::U64 => RecipeValue::U64(u64::from_be_bytes(chunk(bytes)?)),
            Self::I32 => RecipeValue::I32(i32::from_be_bytes(chunk(bytes)?)),
            Self::F64 => RecipeValue::F64(f64::from_be_bytes(chunk(bytes)?)),
            Self::Vector => {
                let mut six = [0.0; 6];
                for slot in &mut six {
                    *slot = f64::from_be_bytes(chunk(bytes)?);
                }
                RecipeValue::Vector(six)
            }
            Self::Triple => {
                let mut three = [0.0; 3];
                for slot in &mut three {
                    *slot = f64::from_be_bytes(chunk(bytes)?);
                }
                RecipeValue::Triple(three)
            }
            Self::Whole => {
                let mut six = [0; 6];
                for slot in &mut six {
                    *slot = i32::from_be_bytes(chunk(bytes)?);
                }
                RecipeValue::Whole(six)
            }
        })
    }
}

/// Reads `N` bytes from the front.
pub fn chunk<const N: usize>(bytes: &mut &[u8]) -> Option<[u8; N]> {
    let (first, rest) = bytes.split_first_chunk::<N>()?;
    *bytes = rest;
    Some(*first)
}

/// A value of a recipe.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum RecipeValue {
    /// Value of [`RecipeType::Bool`].
    Bool(bool),
    /// Value of [`RecipeType::U8`].
    U8(u8),
    /// Value of [`RecipeType::U32`].
    U32(u32),
    /// Value of [`RecipeType::U64`].
    U64(u64),
    /// Value of [`RecipeType::I32`].
    I32(i32),
    /// Value of [`RecipeType::F64`].
    F64(f64),
    /// Value of [`RecipeType::Vector`].
    Vector([f64; 6]),
    /// Value of [`RecipeType::Triple`].
    Triple([f64; 3]),
    /// Value of [`RecipeType::Whole`].
    Whole([i32; 6]),
}

impl RecipeValue {
    /// Appends the bytes of the value.
    pub fn put(self, bytes: &mut Vec<u8>) {
        match self {
            Self::Bool(value) => bytes.push(u8::from(value)),
            Self::U8(value) => bytes.push(value),
            Self::U32(value) => bytes.extend(value.to_be_bytes()),
            Self::U64(value) => bytes.extend(value.to_be_bytes()),
            Self::I32(value) => bytes.extend(value.to_be_bytes()),
            Self::F64(value) => bytes.extend(value.to_be_bytes()),
            Self::Vector(six) => bytes.extend(six.into_iter().flat_map(f64::to_be_bytes)),
            Self::Triple(three) => bytes.extend(three.into_iter().flat_map(f64::to_be_bytes)),
            Self::Whole(six) => bytes.extend(six.into_iter().flat_map(i32::to_be_bytes)),
        }
    }
}

/// Returns a package as bytes.
///
/// # Errors
/// Fails if the package is too long.
pub fn package(of: Type, body: &[u8]) -> io::Result<Vec<u8>> {
    let length = u16::try_from(body.len() + HEADER).map_err(|_| io::ErrorKind::InvalidInput)?;
    let mut package = length.to_be_bytes().to_vec();
    package.push(of.letter());
    package.extend(body);
    Ok(package)
}

/// Reads the next package. Packages with an unknown letter are skipped. Not cancel-safe.
///
/// # Errors
/// Fails if the connection has ended, or if the data is not a package.
pub async fn next(stream: &mut (impl AsyncRead + Unpin)) -> io::Result<(Type, Vec<u8>)> {
    loop {
        let length = usize::from(stream.read_u16().await?);
        let letter = stream.read_u8().await?;
        let Some(length) = length.checked_sub(HEADER) else {
            let why = "a package is shorter than its header";
            return Err(io::Error::new(io::ErrorKind::InvalidData, why));
        };
        let mut body = vec![0; length];
        stream.read_exact(&mut body).await?;
        if let Some(of) = Type::of(letter) {
            return Ok((of, body));
        }
    }
}

const HEADER: usize = 3;

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn a_package_is_as_the_guide_of_the_maker_writes_it() {
        // The request for version 2: five bytes, V, 2.
        let asked = package(Type::Protocol, &VERSION.to_be_bytes()).unwrap();
        assert_eq!(asked, [0, 5, b'V', 0, 2]);
        let mut bytes: &[u8] = &[0, 4, b'?', 7, 0, 4, b'S', 1];
        assert_eq!(next(&mut bytes).await.unwrap(), (Type::Start, vec![1]));
        let short = next(&mut &[0u8, 2, b'S'][..]).await.unwrap_err();
        assert_eq!(short.kind(), io::ErrorKind::InvalidData);
    }

    #[test]
    fn values_are_the_same_after_their_way_over_the_line_and_never_read_past_its_end() {
        for (kind, name) in RecipeType::ALL {
            assert_eq!(RecipeType::of(name), Some(kind));
            let mut bytes = Vec::new();
            kind.zero().put(&mut bytes);
            assert_eq!(kind.take(&mut &bytes[..]), Some(kind.zero()));
            assert_eq!(kind.take(&mut &bytes[1..]), None, "{name}");
        }
        let mut bytes = Vec::new();
        RecipeValue::Vector([0.5, -1.0, 0.0, 3.0, 0.0, 1e-9]).put(&mut bytes);
        let read = RecipeType::Vector.take(&mut &bytes[..]);
        assert_eq!(
            read,
            Some(RecipeValue::Vector([0.5, -1.0, 0.0, 3.0, 0.0, 1e-9]))
        );
    }
}
