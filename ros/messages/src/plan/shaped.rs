//! A field that is converted or of which a part is transferred: a sink and a source around the
//! caller's.

use std::convert::Infallible;

use uadp::{BuiltinType, Scalar};

use super::inside::Inside;
use super::{Conversion, MessagePlan, Op, PlanStep, Selection, index, range, read, write};
use crate::definition::Primitive;
use crate::{
    ArrayRank, FieldSink, FieldSupplier, Leaf, MessageType, PlanError, ReadError, SourceError,
    TypeName, ValueFault, WriteError,
};

/// A part of an array. It can only be read: the values of the rest of the array are unknown.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub enum ArrayPart {
    /// An element, from 0: `position[2]`.
    Element(u32),
    /// The element at the index at which another array of the same message has this text:
    /// `position[name=joint_3]`.
    Named {
        /// The field with the names, beside the array.
        by: String,
        /// The text.
        name: String,
    },
    /// The elements of a range, as far as they exist: `ranges[0:90]`.
    Slice {
        /// Index of the first element.
        from: u32,
        /// Index after the last element; greater than `from`.
        to: u32,
    },
    /// A field of a message of an array: `points[2].x`, or `status[name=lidar].level` with the
    /// name in the message itself.
    Inside {
        /// The message: [`ArrayPart::Element`] or [`ArrayPart::Named`].
        of: Box<Self>,
        /// The path of the field in the message.
        field: String,
    },
}

impl ArrayPart {
    /// Splits `position[2]` into the field and its part; a field without brackets has no part.
    /// Returns `None` if the brackets contain anything else.
    #[must_use]
    pub fn split(text: &str) -> Option<(&str, Option<Self>)> {
        let Some((field, rest)) = text.split_once('[') else {
            return (!text.contains(']')).then_some((text, None));
        };
        let (inside, behind) = rest.split_once(']')?;
        let part = if let Some((by, name)) = inside.split_once('=') {
            let (by, name) = (by.trim(), name.trim());
            let sound = !by.is_empty() && !name.is_empty() && !name.contains([']', '[']);
            sound.then(|| Self::Named {
                by: by.to_owned(),
                name: name.to_owned(),
            })?
        } else if let Some((from, to)) = inside.split_once(':') {
            let from = if from.is_empty() { 0 } else { number(from)? };
            let to = if to.is_empty() { u32::MAX } else { number(to)? };
            (from < to).then_some(Self::Slice { from, to })?
        } else {
            Self::Element(number(inside)?)
        };
        if behind.is_empty() {
            return Some((field, Some(part)));
        }
        let inner = behind.strip_prefix('.')?;
        let sound = !inner.is_empty() && !inner.contains(['[', ']']);
        if !sound || matches!(part, Self::Slice { .. }) {
            return None;
        }
        let part = Self::Inside {
            of: Box::new(part),
            field: inner.to_owned(),
        };
        Some((field, Some(part)))
    }
}

impl std::fmt::Display for ArrayPart {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Element(at) => write!(f, "[{at}]"),
            Self::Named { by, name } => write!(f, "[{by}={name}]"),
            Self::Slice { from, to: u32::MAX } => write!(f, "[{from}:]"),
            Self::Slice { from, to } => write!(f, "[{from}:{to}]"),
            Self::Inside { of, field } => write!(f, "{of}.{field}"),
        }
    }
}

fn number(text: &str) -> Option<u32> {
    let digits = text.bytes().all(|byte| byte.is_ascii_digit());
    text.parse().ok().filter(|_| digits)
}

/// The field with its part and conversion.
#[derive(Clone, Debug)]
pub(super) struct Shaped {
    ops: Vec<Op>,
    /// The steps that read the names, if the element is selected by name.
    names: Option<Vec<Op>>,
    part: Option<ArrayPart>,
    /// Location of the value in the messages of an array.
    inside: Option<Inside>,
    conversion: Conversion,
    /// Path of the field, for errors.
    field: String,
    /// The builtin type in OPC UA.
    outside: BuiltinType,
}

impl Shaped {
    /// Returns the steps, and the field in OPC UA. `steps` compiles a selection.
    pub(super) fn compile(
        message: &MessageType,
        (field, part, conversion): (&str, &Option<ArrayPart>, &Conversion),
        mut steps: impl FnMut(&Selection) -> Result<Vec<Op>, PlanError>,
    ) -> Result<(Self, Leaf), PlanError> {
        let fault = |what: &'static str| PlanError::Shape {
            name: message.name().clone(),
            path: field.to_owned(),
            what,
        };
        let leaf = index(message, field)
            .ok()
            .and_then(|at| message.leaves().get(at));
        let Some(leaf) = leaf else {
            range(message, field)?;
            return Err(fault(
                "is a message, and only a single value can be converted",
            ));
        };
        let inside = match part {
            Some(ArrayPart::Inside { of, field: inner }) => {
                Some(Inside::compile(message, field, (of, inner))?)
            }
            Some(_) | None => None,
        };
        let inner = match &inside {
            Some(inside) => inside.leaf.clone(),
            None => {
                let bytes = message.fixed_bytes(field);
                shape((leaf, bytes), part.as_ref()).map_err(&fault)?
            }
        };
        let outside = conversion.outside(inner.builtin).map_err(&fault)?;
        let mut names = None;
        if let Some(ArrayPart::Named { by, .. }) = part {
            let by = beside(field, by);
            let texts = message.leaf(&by).is_some_and(|leaf| {
                leaf.builtin == BuiltinType::String && matches!(leaf.rank, ArrayRank::Array { .. })
            });
            if !texts {
                index(message, &by)?;
                return Err(fault(
                    "is selected by a field that is not an array of strings",
                ));
            }
            names = Some(steps(&Selection::Field(by))?);
        }
        let mut ops = steps(&Selection::Field(field.to_owned()))?;
        if !conversion.is_none() {
            // Converted elements are passed on individually.
            for op in &mut ops {
                if let PlanStep::Packed(number, len) = op.what
                    && op.carry
                {
                    op.what = PlanStep::Many(Primitive::Number(number), len);
                }
            }
            if inside.is_none() {
                ops.retain(|op| !matches!(op.what, PlanStep::Run(..)));
            }
        }
        let told = part.as_ref().map(ToString::to_string).unwrap_or_default();
        let outer = Leaf {
            path: format!("{field}{told}"),
            builtin: outside,
            rank: inner.rank,
        };
        let shaped = Self {
            ops,
            names,
            part: part.clone(),
            inside,
            conversion: *conversion,
            field: field.to_owned(),
            outside,
        };
        Ok((shaped, outer))
    }

    pub(super) fn read<S: FieldSink>(
        &self,
        plan: &MessagePlan,
        payload: &[u8],
        sink: &mut S,
    ) -> Result<(), ReadError<S::Error>> {
        let pick = match &self.part {
            None => Pick::All,
            Some(ArrayPart::Element(at)) => Pick::One(wide(*at)),
            Some(ArrayPart::Slice { from, to }) => Pick::Some(wide(*from), wide(*to)),
            Some(ArrayPart::Named { name, .. }) => Pick::One(self.find(plan, payload, name)?),
            Some(ArrayPart::Inside { .. }) => Pick::All,
        };
        let mut shaping = ShapingSink {
            sink,
            conversion: self.conversion,
            outside: self.outside,
            pick,
            at: 0,
        };
        let done = match &self.inside {
            Some(inside) => {
                let at = inside.find(plan, &self.ops, payload)?;
                read::read(
                    plan,
                    &self.ops,
                    payload,
                    &mut inside.picking(at, &mut shaping),
                )
            }
            None => read::read(plan, &self.ops, payload, &mut shaping),
        };
        done.map_err(|error| match error {
            ReadError::Malformed { field, at, fault } => ReadError::Malformed { field, at, fault },
            ReadError::Value { field, fault } => ReadError::Value { field, fault },
            ReadError::Sink { field, source } => match source {
                NotPassed::Sink(source) => ReadError::Sink { field, source },
                NotPassed::Value(fault) => ReadError::Value { field, fault },
            },
        })
    }

    /// Returns the index of the name.
    fn find<E>(
        &self,
        plan: &MessagePlan,
        payload: &[u8],
        name: &str,
    ) -> Result<usize, ReadError<E>> {
        let mut finder = Finder {
            name,
            at: 0,
            found: None,
        };
        let names = self.names.as_deref().unwrap_or_default();
        read::read(plan, names, payload, &mut finder).map_err(|error| match error {
            ReadError::Malformed { field, at, fault } => ReadError::Malformed { field, at, fault },
            ReadError::Value { field, fault } => ReadError::Value { field, fault },
            ReadError::Sink { source, .. } => match source {},
        })?;
        finder.found.ok_or_else(|| ReadError::Value {
            field: self.field.clone(),
            fault: ValueFault::NoName(name.to_owned()),
        })
    }

    pub(super) fn write<'a, S: FieldSupplier<'a>>(
        &self,
        plan: &MessagePlan,
        source: &mut S,
        out: &mut Vec<u8>,
    ) -> Result<(), WriteError> {
        if self.part.is_some() {
            return Err(WriteError {
                field: self.field.clone(),
                fault: crate::WriteFault::Part,
            });
        }
        let mut shaping = ShapingSource {
            source,
            conversion: self.conversion,
            outside: self.outside,
        };
        write::write(plan, &self.ops, &mut shaping, out)
    }
}

/// Returns the path of the field `name` in the message that contains `field`.
fn beside(field: &str, name: &str) -> String {
    match field.rsplit_once('.') {
        Some((outer, _)) => format!("{outer}.{name}"),
        None => name.to_owned(),
    }
}

/// Returns the type of a part of a field before its conversion. `bytes`: the fixed length of a byte
/// array.
fn shape(
    (leaf, bytes): (&Leaf, Option<u32>),
    part: Option<&ArrayPart>,
) -> Result<Leaf, &'static str> {
    let Some(part) = part else {
        return Ok(leaf.clone());
    };
    let (element, fixed) = match leaf {
        Leaf {
            builtin: BuiltinType::ExtensionObject,
            ..
        } => return Err("is an array of messages, and no part of it can be selected"),
        // An array of bytes.
        Leaf {
            builtin: BuiltinType::ByteString,
            ..
        } => (BuiltinType::Byte, bytes),
        Leaf {
            rank: ArrayRank::Scalar,
            ..
        } => return Err("is not an array"),
        Leaf {
            builtin,
            rank: ArrayRank::Array { fixed },
            ..
        } => (*builtin, *fixed),
    };
    let first = match part {
        ArrayPart::Element(at) => *at,
        ArrayPart::Slice { from, .. } => *from,
        ArrayPart::Named { .. } | ArrayPart::Inside { .. } => 0,
    };
    if fixed.is_some_and(|fixed| first >= fixed) {
        return Err("always has fewer elements");
    }
    let (builtin, rank) = match (part, leaf.rank) {
        // Handled by the caller.
        (ArrayPart::Inside { .. }, rank) => (element, rank),
        (ArrayPart::Element(_) | ArrayPart::Named { .. }, _) => (element, ArrayRank::Scalar),
        (ArrayPart::Slice { .. }, ArrayRank::Scalar) => (leaf.builtin, ArrayRank::Scalar),
        (ArrayPart::Slice { .. }, ArrayRank::Array { .. }) => {
            (element, ArrayRank::Array { fixed: None })
        }
    };
    Ok(Leaf {
        path: leaf.path.clone(),
        builtin,
        rank,
    })
}

pub(super) fn wide(number: u32) -> usize {
    usize::try_from(number).unwrap_or(usize::MAX)
}

/// The transferred elements of an array.
#[derive(Clone, Copy)]
enum Pick {
    All,
    One(usize),
    Some(usize, usize),
}

/// Reason for which a value is not passed on.
pub(super) enum NotPassed<E> {
    Sink(E),
    Value(ValueFault),
}

pub(super) struct ShapingSink<'s, S> {
    sink: &'s mut S,
    conversion: Conversion,
    outside: BuiltinType,
    pick: Pick,
    /// Index of the next element.
    at: usize,
}

impl<S: FieldSink> ShapingSink<'_, S> {
    fn converted<'v>(&self, value: Scalar<'v>) -> Result<Scalar<'v>, NotPassed<S::Error>> {
        if self.conversion.is_none() {
            return Ok(value);
        }
        self.conversion.there(value).map_err(NotPassed::Value)
    }

    fn absent(at: usize, found: usize) -> NotPassed<S::Error> {
        NotPassed::Value(ValueFault::Absent { at, found })
    }
}

impl<S: FieldSink> FieldSink for ShapingSink<'_, S> {
    type Error = NotPassed<S::Error>;

    fn scalar(&mut self, value: Scalar<'_>) -> Result<(), Self::Error> {
        let value = match (self.pick, value) {
            (Pick::All, value) => value,
            (Pick::One(at), Scalar::ByteString(bytes)) => {
                let bytes = bytes.unwrap_or_default();
                let byte = bytes.get(at);
                Scalar::Byte(*byte.ok_or_else(|| Self::absent(at, bytes.len()))?)
            }
            (Pick::Some(from, to), Scalar::ByteString(bytes)) => {
                Scalar::ByteString(Some(cut(bytes.unwrap_or_default(), from, to)))
            }
            // Compiled for arrays only.
            (Pick::One(_) | Pick::Some(..), value) => value,
        };
        let value = self.converted(value)?;
        self.sink.scalar(value).map_err(NotPassed::Sink)
    }

    fn packed_array(
        &mut self,
        element: BuiltinType,
        count: usize,
        bytes: &[u8],
    ) -> Result<(), Self::Error> {
        let size = element.fixed_size().unwrap_or(1);
        let (from, to) = match self.pick {
            Pick::All => (0, count),
            Pick::Some(from, to) => (from, to),
            Pick::One(at) => {
                let from = at.saturating_mul(size);
                let value = bytes
                    .get(from..from.saturating_add(size))
                    .and_then(|bytes| fixed(element, bytes))
                    .ok_or_else(|| Self::absent(at, count))?;
                return self.sink.scalar(value).map_err(NotPassed::Sink);
            }
        };
        let bytes = cut(bytes, from.saturating_mul(size), to.saturating_mul(size));
        self.sink
            .packed_array(element, bytes.len() / size, bytes)
            .map_err(NotPassed::Sink)
    }

    fn array(&mut self, _: BuiltinType, count: usize) -> Result<(), Self::Error> {
        self.at = 0;
        let picked = match self.pick {
            Pick::All => count,
            Pick::Some(from, to) => to.min(count).saturating_sub(from),
            Pick::One(at) if at < count => return Ok(()),
            Pick::One(at) => return Err(Self::absent(at, count)),
        };
        self.sink
            .array(self.outside, picked)
            .map_err(NotPassed::Sink)
    }

    fn element(&mut self, value: Scalar<'_>) -> Result<(), Self::Error> {
        let at = self.at;
        self.at += 1;
        match self.pick {
            Pick::One(picked) if picked == at => {
                let value = self.converted(value)?;
                self.sink.scalar(value).map_err(NotPassed::Sink)
            }
            Pick::One(_) => Ok(()),
            Pick::Some(from, to) if !(from..to).contains(&at) => Ok(()),
            Pick::Some(..) | Pick::All => {
                let value = self.converted(value)?;
                self.sink.element(value).map_err(NotPassed::Sink)
            }
        }
    }

    fn structures(&mut self, of: &TypeName, count: usize) -> Result<(), Self::Error> {
        self.sink.structures(of, count).map_err(NotPassed::Sink)
    }

    fn begin_structure(&mut self, of: &TypeName) -> Result<(), Self::Error> {
        self.sink.begin_structure(of).map_err(NotPassed::Sink)
    }

    fn end_structure(&mut self) -> Result<(), Self::Error> {
        self.sink.end_structure().map_err(NotPassed::Sink)
    }
}

/// Returns the existing bytes of a range.
fn cut(bytes: &[u8], from: usize, to: usize) -> &[u8] {
    let to = to.min(bytes.len());
    bytes.get(from.min(to)..to).unwrap_or_default()
}

/// Returns a number of a packed array.
#[expect(
    clippy::wildcard_enum_match_arm,
    reason = "numbers are told apart, and all else is none"
)]
fn fixed(element: BuiltinType, bytes: &[u8]) -> Option<Scalar<'static>> {
    macro_rules! number {
        ($variant:ident, $type:ty) => {
            Scalar::$variant(<$type>::from_le_bytes(bytes.try_into().ok()?))
        };
    }
    Some(match element {
        BuiltinType::Boolean => Scalar::Boolean(bytes != [0]),
        BuiltinType::SByte => number!(SByte, i8),
        BuiltinType::Byte => number!(Byte, u8),
        BuiltinType::Int16 => number!(Int16, i16),
        BuiltinType::UInt16 => number!(UInt16, u16),
        BuiltinType::Int32 => number!(Int32, i32),
        BuiltinType::UInt32 => number!(UInt32, u32),
        BuiltinType::Int64 => number!(Int64, i64),
        BuiltinType::UInt64 => number!(UInt64, u64),
        BuiltinType::Float => number!(Float, f32),
        BuiltinType::Double => number!(Double, f64),
        _ => return None,
    })
}

/// Finds a text in an array of texts.
struct Finder<'n> {
    name: &'n str,
    at: usize,
    found: Option<usize>,
}

impl FieldSink for Finder<'_> {
    type Error = Infallible;

    fn scalar(&mut self, _: Scalar<'_>) -> Result<(), Infallible> {
        Ok(())
    }

    fn packed_array(&mut self, _: BuiltinType, _: usize, _: &[u8]) -> Result<(), Infallible> {
        Ok(())
    }

    fn array(&mut self, _: BuiltinType, _: usize) -> Result<(), Infallible> {
        Ok(())
    }

    fn element(&mut self, value: Scalar<'_>) -> Result<(), Infallible> {
        if self.found.is_none() && value == Scalar::String(Some(self.name)) {
            self.found = Some(self.at);
        }
        self.at += 1;
        Ok(())
    }

    fn structures(&mut self, _: &TypeName, _: usize) -> Result<(), Infallible> {
        Ok(())
    }

    fn begin_structure(&mut self, _: &TypeName) -> Result<(), Infallible> {
        Ok(())
    }

    fn end_structure(&mut self) -> Result<(), Infallible> {
        Ok(())
    }
}

struct ShapingSource<'s, S> {
    source: &'s mut S,
    conversion: Conversion,
    outside: BuiltinType,
}

impl<S> ShapingSource<'_, S> {
    fn back<'a>(&self, value: Scalar<'a>, field: BuiltinType) -> Result<Scalar<'a>, SourceError> {
        if self.conversion.is_none() {
            return Ok(value);
        }
        let back = self.conversion.back(value, field);
        back.map_err(SourceError::Value)
    }
}

impl<'a, S: FieldSupplier<'a>> FieldSupplier<'a> for ShapingSource<'_, S> {
    fn scalar(&mut self, expected: BuiltinType) -> Result<Scalar<'a>, SourceError> {
        let value = self.source.scalar(self.outside)?;
        self.back(value, expected)
    }

    fn packed_array(&mut self, expected: BuiltinType) -> Result<(usize, &'a [u8]), SourceError> {
        self.source.packed_array(expected)
    }

    fn array(&mut self, _: BuiltinType) -> Result<usize, SourceError> {
        self.source.array(self.outside)
    }

    fn element(&mut self, expected: BuiltinType) -> Result<Scalar<'a>, SourceError> {
        let value = self.source.element(self.outside)?;
        self.back(value, expected)
    }

    fn structures(&mut self) -> Result<usize, SourceError> {
        self.source.structures()
    }

    fn structure(&mut self) -> Result<(), SourceError> {
        self.source.structure()
    }

    fn begin_structure(&mut self) -> Result<(), SourceError> {
        self.source.begin_structure()
    }

    fn end_structure(&mut self) -> Result<(), SourceError> {
        self.source.end_structure()
    }

    fn finish(&mut self) -> Result<(), SourceError> {
        self.source.finish()
    }
}
