//! Encodes the fields of a source as bytes.

use uadp::{BuiltinType, Scalar};

use super::literal::Typed;
use super::{Len, MAX_WITHOUT_BYTES, MessagePlan, Op, PlanStep, Wire};
use crate::convert::date_time_within;
use crate::definition::{ClockType, Number, Primitive};
use crate::{FieldSupplier, SourceError, WriteError, WriteFault, millis_to_duration};

struct Writer<'o, 's, S> {
    out: &'o mut Vec<u8>,
    /// Origin of the alignment; `None` on ROS 1.
    origin: Option<usize>,
    leaf: Option<usize>,
    source: &'s mut S,
    /// Number of elements without a value that are still accepted.
    without_value: usize,
}

pub(super) fn write<'a, S: FieldSupplier<'a>>(
    plan: &MessagePlan,
    ops: &[Op],
    source: &mut S,
    out: &mut Vec<u8>,
) -> Result<(), WriteError> {
    message(plan, (ops, false), source, out)
}

/// Writes a message that is a structure.
pub(super) fn structure<'a, S: FieldSupplier<'a>>(
    plan: &MessagePlan,
    ops: &[Op],
    source: &mut S,
    out: &mut Vec<u8>,
) -> Result<(), WriteError> {
    message(plan, (ops, true), source, out)
}

/// Writes a message. `structure`: whether the fields belong to a structure.
fn message<'a, S: FieldSupplier<'a>>(
    plan: &MessagePlan,
    (ops, structure): (&[Op], bool),
    source: &mut S,
    out: &mut Vec<u8>,
) -> Result<(), WriteError> {
    let start = out.len();
    if plan.wire == Wire::Cdr {
        out.extend_from_slice(&[0, 1, 0, 0]);
    }
    let origin = (plan.wire == Wire::Cdr).then_some(out.len());
    let mut writer = Writer {
        out,
        origin,
        leaf: None,
        source,
        without_value: MAX_WITHOUT_BYTES,
    };
    let done = writer.body(ops, structure).and_then(|()| {
        writer.leaf = None;
        writer.source.finish().map_err(WriteFault::Source)
    });
    writer.align(4);
    let leaf = writer.leaf;
    done.map_err(|fault| {
        out.truncate(start);
        WriteError {
            field: plan.path(leaf),
            fault,
        }
    })
}

/// Fails with the first field of a constant that cannot be written because of its length or
/// content.
pub(super) fn try_constants(wire: Wire, ops: &[Op]) -> Result<(), (usize, WriteFault)> {
    let mut out = Vec::new();
    let origin = (wire == Wire::Cdr).then_some(0);
    ops.iter()
        .filter_map(|op| Some((op, op.constant.as_ref()?)))
        .try_for_each(|(op, constant)| {
            constant_of(op, constant, &mut out, origin).map_err(|fault| (op.leaf, fault))
        })
}

fn constant_of(
    op: &Op,
    constant: &Typed,
    out: &mut Vec<u8>,
    origin: Option<usize>,
) -> Result<(), WriteFault> {
    let mut writer = Writer {
        out,
        origin,
        leaf: None,
        source: &mut constant.source(),
        without_value: MAX_WITHOUT_BYTES,
    };
    match &op.what {
        PlanStep::One(primitive) => writer.single(*primitive),
        PlanStep::Packed(number, len) => writer.packed(*number, *len, true),
        PlanStep::Bytes(len) => writer.bytes(*len, true),
        PlanStep::Many(primitive, len) => writer.many(*primitive, *len, true),
        // These steps have no constants.
        PlanStep::Messages { .. } | PlanStep::Skip { .. } | PlanStep::Run(..) => Ok(()),
    }
}

/// Writes a message that is transferred unchanged.
pub(super) fn bytes<'a, S: FieldSupplier<'a>>(
    source: &mut S,
    out: &mut Vec<u8>,
) -> Result<(), WriteError> {
    let whole = |fault: WriteFault| WriteError {
        field: String::new(),
        fault,
    };
    let value = source
        .scalar(BuiltinType::ByteString)
        .map_err(|error| whole(error.into()))?;
    let Scalar::ByteString(bytes) = value else {
        return Err(whole(mismatch(BuiltinType::ByteString, &value)));
    };
    source.finish().map_err(|error| whole(error.into()))?;
    out.extend_from_slice(bytes.unwrap_or_default());
    Ok(())
}

impl<'a, S: FieldSupplier<'a>> Writer<'_, '_, S> {
    fn body(&mut self, ops: &[Op], structure: bool) -> Result<(), WriteFault> {
        if !structure {
            return self.steps(ops, false);
        }
        self.source.structure()?;
        self.steps(ops, true)?;
        self.source.end_structure()?;
        Ok(())
    }

    /// Runs steps. `inside`: whether the steps belong to an element.
    fn steps(&mut self, mut ops: &[Op], inside: bool) -> Result<(), WriteFault> {
        while let Some((op, after)) = ops.split_first() {
            ops = after;
            self.leaf = Some(op.leaf);
            if let Some(constant) = &op.constant {
                constant_of(op, constant, self.out, self.origin)?;
                continue;
            }
            match &op.what {
                PlanStep::One(primitive) if op.carry => self.single(*primitive)?,
                PlanStep::One(primitive) => self.zero(*primitive),
                PlanStep::Run(number, count) => {
                    self.align(number.size());
                    if self.source.scalars(number.builtin(), *count, self.out) {
                        ops = ops.get(usize::from(*count)..).unwrap_or_default();
                    }
                }
                PlanStep::Skip { align, bytes } => self.zeros(*align, *bytes),
                PlanStep::Packed(number, len) => self.packed(*number, *len, op.carry)?,
                PlanStep::Bytes(len) => self.bytes(*len, op.carry)?,
                PlanStep::Many(primitive, len) => self.many(*primitive, *len, op.carry)?,
                PlanStep::Messages { len, steps, .. } => {
                    let (body, after) = ops.split_at_checked(*steps).unwrap_or((ops, &[]));
                    ops = after;
                    self.messages(*len, body, op.carry.then_some(inside))?;
                }
            }
        }
        Ok(())
    }

    #[inline]
    fn single(&mut self, primitive: Primitive) -> Result<(), WriteFault> {
        let value = self.source.scalar(primitive.builtin())?;
        self.one(primitive, value)
    }

    /// Writes an array of messages. `carry`: whether the writer is within an element already, or
    /// `None` if the value is not transferred.
    fn messages(&mut self, len: Len, body: &[Op], carry: Option<bool>) -> Result<(), WriteFault> {
        let count = match carry {
            None => self.zero_count(len),
            Some(true) => self.source.array(BuiltinType::ExtensionObject)?,
            Some(false) => self.source.structures()?,
        };
        if carry.is_some() {
            if body
                .iter()
                .all(|op| matches!(op.what, PlanStep::Skip { .. }))
            {
                // Inline they take no bytes, for any number of elements.
                let left = self.without_value.checked_sub(count);
                self.without_value = left.ok_or(WriteFault::WithoutValue(count))?;
            }
            self.count(len, count)?;
        }
        for _ in 0..count {
            if carry == Some(false) {
                self.source.begin_structure()?;
            }
            self.steps(body, true)?;
            if carry == Some(false) {
                self.source.end_structure()?;
            }
        }
        Ok(())
    }

    #[inline]
    fn one(&mut self, primitive: Primitive, value: Scalar<'_>) -> Result<(), WriteFault> {
        match (primitive, value) {
            (Primitive::Number(number), value) => return self.number(number, value),
            (Primitive::Text(text), Scalar::String(value)) if text.wide => {
                return self.wide(text.bound, value.unwrap_or_default());
            }
            (Primitive::Text(text), Scalar::String(value)) => {
                return self.narrow(text.bound, value.unwrap_or_default());
            }
            (
                Primitive::Clock(clock @ (ClockType::Time1 | ClockType::Time2)),
                Scalar::DateTime(value),
            ) => {
                let (earliest, latest) = if clock == ClockType::Time1 {
                    (0, i64::from(u32::MAX))
                } else {
                    (i64::from(i32::MIN), i64::from(i32::MAX))
                };
                let (sec, nanosec) = date_time_within(value, earliest, latest);
                // The field holds the low half of each value.
                let [a, b, c, d, ..] = sec.to_le_bytes();
                self.put([a, b, c, d]);
                self.put(nanosec.to_le_bytes());
            }
            (
                Primitive::Clock(ClockType::Duration1 | ClockType::Duration2),
                Scalar::Double(value),
            ) => {
                let (sec, nanosec) = millis_to_duration(value).ok_or(WriteFault::Duration)?;
                self.put(sec.to_le_bytes());
                self.put(nanosec.to_le_bytes());
            }
            (primitive, value) => return Err(mismatch(primitive.builtin(), &value)),
        }
        Ok(())
    }

    #[inline]
    fn number(&mut self, number: Number, value: Scalar<'_>) -> Result<(), WriteFault> {
        match (number, value) {
            (Number::Bool, Scalar::Boolean(value)) => self.out.push(u8::from(value)),
            (Number::Int8, Scalar::SByte(value)) => self.put(value.to_le_bytes()),
            (Number::UInt8, Scalar::Byte(value)) => self.out.push(value),
            (Number::Int16, Scalar::Int16(value)) => self.put(value.to_le_bytes()),
            (Number::UInt16, Scalar::UInt16(value)) => self.put(value.to_le_bytes()),
            (Number::Int32, Scalar::Int32(value)) => self.put(value.to_le_bytes()),
            (Number::UInt32, Scalar::UInt32(value)) => self.put(value.to_le_bytes()),
            (Number::Int64, Scalar::Int64(value)) => self.put(value.to_le_bytes()),
            (Number::UInt64, Scalar::UInt64(value)) => self.put(value.to_le_bytes()),
            (Number::Float32, Scalar::Float(value)) => self.put(value.to_le_bytes()),
            (Number::Float64, Scalar::Double(value)) => self.put(value.to_le_bytes()),
            (number, value) => return Err(mismatch(number.builtin(), &value)),
        }
        Ok(())
    }

    fn packed(&mut self, number: Number, len: Len, carry: bool) -> Result<(), WriteFault> {
        if !carry {
            let count = self.zero_count(len);
            let align = if count == 0 { 1 } else { number.size() };
            self.zeros(align, count.saturating_mul(number.size()));
            return Ok(());
        }
        let (count, bytes) = self.source.packed_array(number.builtin())?;
        if count.checked_mul(number.size()) != Some(bytes.len()) {
            return Err(SourceError::Malformed(format!(
                "{count} elements in {} bytes",
                bytes.len()
            ))
            .into());
        }
        self.count(len, count)?;
        if count > 0 {
            self.align(number.size());
        }
        if number == Number::Bool {
            self.out
                .extend(bytes.iter().map(|byte| u8::from(*byte != 0)));
        } else {
            self.out.extend_from_slice(bytes);
        }
        Ok(())
    }

    fn bytes(&mut self, len: Len, carry: bool) -> Result<(), WriteFault> {
        if !carry {
            let count = self.zero_count(len);
            self.zeros(1, count);
            return Ok(());
        }
        let value = self.source.scalar(BuiltinType::ByteString)?;
        let Scalar::ByteString(bytes) = value else {
            return Err(mismatch(BuiltinType::ByteString, &value));
        };
        let bytes = bytes.unwrap_or_default();
        self.count(len, bytes.len())?;
        self.out.extend_from_slice(bytes);
        Ok(())
    }

    fn many(&mut self, primitive: Primitive, len: Len, carry: bool) -> Result<(), WriteFault> {
        if !carry {
            let count = self.zero_count(len);
            (0..count).for_each(|_| self.zero(primitive));
            return Ok(());
        }
        let count = self.source.array(primitive.builtin())?;
        self.count(len, count)?;
        (0..count).try_for_each(|_| {
            let value = self.source.element(primitive.builtin())?;
            match (primitive, value) {
                // The common case, such as names of joints.
                (Primitive::Text(text), Scalar::String(value)) if !text.wide => {
                    self.narrow(text.bound, value.unwrap_or_default())
                }
                (primitive, value) => self.one(primitive, value),
            }
        })
    }

    fn narrow(&mut self, bound: u32, text: &str) -> Result<(), WriteFault> {
        let cdr = self.origin.is_some();
        let length = within(bound.min(u32::MAX - 1), text.len())?;
        if cdr && text.contains('\0') {
            return Err(WriteFault::Nul);
        }
        self.put((length + u32::from(cdr)).to_le_bytes());
        self.out.extend_from_slice(text.as_bytes());
        if cdr {
            self.out.push(0);
        }
        Ok(())
    }

    fn wide(&mut self, bound: u32, text: &str) -> Result<(), WriteFault> {
        let length = within(bound, text.encode_utf16().count())?;
        if text.contains('\0') {
            return Err(WriteFault::Nul);
        }
        self.put(length.to_le_bytes());
        for unit in text.encode_utf16() {
            self.out.extend_from_slice(&u32::from(unit).to_le_bytes());
        }
        Ok(())
    }

    /// Checks the length of a value, and writes it if the type leaves it open.
    fn count(&mut self, len: Len, found: usize) -> Result<(), WriteFault> {
        match len {
            Len::Fixed(expected)
                if usize::try_from(expected).is_ok_and(|expected| expected == found) =>
            {
                Ok(())
            }
            Len::Fixed(expected) => Err(WriteFault::Length { expected, found }),
            Len::Counted { bound } => {
                let count = within(bound, found)?;
                self.put(count.to_le_bytes());
                Ok(())
            }
        }
    }

    /// Returns the length of an array of zeros, and writes it if the type leaves it open.
    fn zero_count(&mut self, len: Len) -> usize {
        match len {
            Len::Fixed(count) => usize::try_from(count).unwrap_or(usize::MAX),
            Len::Counted { .. } => {
                self.put([0; 4]);
                0
            }
        }
    }

    fn zero(&mut self, primitive: Primitive) {
        match primitive {
            Primitive::Text(text) if self.origin.is_some() && !text.wide => {
                self.put(1u32.to_le_bytes());
                self.out.push(0);
            }
            Primitive::Number(_) | Primitive::Clock(_) | Primitive::Text(_) => {
                self.zeros(primitive.align(), primitive.size())
            }
        }
    }

    fn zeros(&mut self, align: usize, bytes: usize) {
        self.align(align);
        self.out.resize(self.out.len().saturating_add(bytes), 0);
    }

    #[inline]
    fn align(&mut self, to: usize) {
        if let Some(origin) = self.origin {
            let past = (self.out.len() - origin) & (to - 1);
            if past > 0 {
                self.out
                    .extend_from_slice([0; 8].get(..to - past).unwrap_or_default());
            }
        }
    }

    #[inline]
    fn put<const N: usize>(&mut self, bytes: [u8; N]) {
        self.align(N);
        self.out.extend_from_slice(&bytes);
    }
}

fn within(bound: u32, found: usize) -> Result<u32, WriteFault> {
    u32::try_from(found)
        .ok()
        .filter(|found| *found <= bound)
        .ok_or(WriteFault::Bound { bound, found })
}

fn mismatch(expected: BuiltinType, found: &Scalar<'_>) -> WriteFault {
    WriteFault::Source(SourceError::Type {
        expected,
        expected_array: false,
        found: Some(found.builtin_type()),
        found_array: false,
    })
}
