//! Decodes bytes into a sink.

use std::marker::PhantomData;

use uadp::{BuiltinType, Scalar};

use super::{Len, MAX_WITHOUT_BYTES, MessagePlan, Op, PlanStep, Wire};
use crate::definition::{ClockType, Number, Primitive};
use crate::{FieldSink, MessageFault, ReadError, TypeName, duration_to_millis, time_to_date_time};

/// The layout of numbers in the payload.
trait Layout {
    const ALIGNED: bool;
    const SWAPPED: bool;
}
struct Packed;
impl Layout for Packed {
    const ALIGNED: bool = false;
    const SWAPPED: bool = false;
}
struct LittleCdr;
impl Layout for LittleCdr {
    const ALIGNED: bool = true;
    const SWAPPED: bool = false;
}
struct BigCdr;
impl Layout for BigCdr {
    const ALIGNED: bool = true;
    const SWAPPED: bool = true;
}

enum Stop<E> {
    Fault(MessageFault),
    Sink(E),
}

impl<E> From<MessageFault> for Stop<E> {
    fn from(fault: MessageFault) -> Self {
        Self::Fault(fault)
    }
}

struct Reader<'p, 's, L, S> {
    /// The payload after the encapsulation header, which is offset 0 of the alignment.
    data: &'p [u8],
    at: usize,
    /// The field being read.
    leaf: Option<usize>,
    sink: &'s mut S,
    /// Normalized elements for the sink: swapped numbers, and Booleans that were neither 0 nor 1.
    scratch: Vec<u8>,
    /// Number of elements without bytes that are still accepted.
    without_bytes: usize,
    layout: PhantomData<L>,
}

pub(super) fn read<S: FieldSink>(
    plan: &MessagePlan,
    ops: &[Op],
    payload: &[u8],
    sink: &mut S,
) -> Result<(), ReadError<S::Error>> {
    as_wire(plan, (ops, false), payload, sink)
}

/// Reads a message as a structure.
pub(super) fn structure<S: FieldSink>(
    plan: &MessagePlan,
    (of, ops): (&TypeName, &[Op]),
    payload: &[u8],
    sink: &mut S,
) -> Result<(), ReadError<S::Error>> {
    let refused = |source| ReadError::Sink {
        field: String::new(),
        source,
    };
    sink.begin_structure(of).map_err(refused)?;
    as_wire(plan, (ops, true), payload, sink)?;
    sink.end_structure().map_err(refused)
}

/// Reads a message. `inside`: whether the fields belong to a structure.
fn as_wire<S: FieldSink>(
    plan: &MessagePlan,
    (ops, inside): (&[Op], bool),
    payload: &[u8],
    sink: &mut S,
) -> Result<(), ReadError<S::Error>> {
    if plan.wire == Wire::Ros1 {
        return run::<Packed, S>(plan, (ops, inside), (payload, 0), sink);
    }
    let malformed = |at, fault| ReadError::Malformed {
        field: String::new(),
        at,
        fault,
    };
    let Some(([high, low, _, _], data)) = payload.split_first_chunk() else {
        return Err(malformed(payload.len(), MessageFault::Truncated));
    };
    match u16::from_be_bytes([*high, *low]) {
        0 => run::<BigCdr, S>(plan, (ops, inside), (data, 4), sink),
        1 => run::<LittleCdr, S>(plan, (ops, inside), (data, 4), sink),
        other => Err(malformed(0, MessageFault::Encapsulation(other))),
    }
}

/// Runs the steps. `offset`: the start of `data` in the payload.
fn run<L: Layout, S: FieldSink>(
    plan: &MessagePlan,
    (ops, inside): (&[Op], bool),
    (data, offset): (&[u8], usize),
    sink: &mut S,
) -> Result<(), ReadError<S::Error>> {
    let mut reader = Reader::<L, S> {
        data,
        at: 0,
        leaf: None,
        sink,
        scratch: Vec::new(),
        without_bytes: MAX_WITHOUT_BYTES,
        layout: PhantomData,
    };
    let mut done = reader.steps(ops, inside);
    let left = data.len().saturating_sub(reader.at);
    if done.is_ok() && !L::ALIGNED && left > 0 {
        reader.leaf = None;
        done = Err(Stop::Fault(MessageFault::TrailingBytes(left)));
    }
    let (leaf, at) = (reader.leaf, reader.at);
    done.map_err(|stop| match stop {
        Stop::Fault(fault) => ReadError::Malformed {
            field: plan.path(leaf),
            at: at.min(data.len()) + offset,
            fault,
        },
        Stop::Sink(source) => ReadError::Sink {
            field: plan.path(leaf),
            source,
        },
    })
}

impl<'p, L: Layout, S: FieldSink> Reader<'p, '_, L, S> {
    /// Runs steps. `inside`: whether the steps belong to an element.
    fn steps(&mut self, mut ops: &[Op], inside: bool) -> Result<(), Stop<S::Error>> {
        while let Some((op, after)) = ops.split_first() {
            ops = after;
            self.leaf = Some(op.leaf);
            match &op.what {
                PlanStep::One(primitive) if op.carry => self.one(*primitive, S::scalar)?,
                PlanStep::One(primitive) => self.skip_one(*primitive)?,
                PlanStep::Run(number, count) => {
                    if self.run(*number, *count).map_err(Stop::Sink)? {
                        ops = ops.get(usize::from(*count)..).unwrap_or_default();
                    }
                }
                PlanStep::Skip { align, bytes } => {
                    self.take(*align, *bytes)?;
                }
                PlanStep::Packed(number, len) => self.packed(*number, *len, op.carry)?,
                PlanStep::Bytes(len) => {
                    let count = self.count(*len)?;
                    let bytes = self.take(1, count)?;
                    if op.carry {
                        self.sink
                            .scalar(Scalar::ByteString(Some(bytes)))
                            .map_err(Stop::Sink)?;
                    }
                }
                PlanStep::Many(primitive, len) => self.many(*primitive, *len, op.carry)?,
                PlanStep::Messages {
                    of,
                    len,
                    steps,
                    least,
                } => {
                    let (body, after) = ops.split_at_checked(*steps).unwrap_or((ops, &[]));
                    ops = after;
                    let count = self.count(*len)?;
                    self.room(count, *least)?;
                    self.messages(of, count, body, op.carry.then_some(inside))?;
                }
            }
        }
        Ok(())
    }

    /// Reads an array of messages. `carry`: whether the reader is within an element already, or
    /// `None` if the value is skipped.
    fn messages(
        &mut self,
        of: &TypeName,
        count: usize,
        body: &[Op],
        carry: Option<bool>,
    ) -> Result<(), Stop<S::Error>> {
        match carry {
            None => (0..count).try_for_each(|_| self.steps(body, true)),
            Some(true) => {
                self.sink
                    .array(BuiltinType::ExtensionObject, count)
                    .map_err(Stop::Sink)?;
                (0..count).try_for_each(|_| self.steps(body, true))
            }
            Some(false) => {
                self.sink.structures(of, count).map_err(Stop::Sink)?;
                (0..count).try_for_each(|_| {
                    self.sink.begin_structure(of).map_err(Stop::Sink)?;
                    self.steps(body, true)?;
                    self.sink.end_structure().map_err(Stop::Sink)
                })
            }
        }
    }

    /// Reads a value and passes it to `give`, a method of the sink. Each kind is passed on where
    /// it is read: a Scalar that only passes through registers makes small messages cheap.
    #[inline]
    fn one<G>(&mut self, primitive: Primitive, give: G) -> Result<(), Stop<S::Error>>
    where
        G: Fn(&mut S, Scalar<'_>) -> Result<(), S::Error>,
    {
        match primitive {
            Primitive::Number(number) => self.number(number, give),
            Primitive::Clock(clock) => {
                let value = self.clock(clock)?;
                give(self.sink, value).map_err(Stop::Sink)
            }
            Primitive::Text(text) if text.wide => {
                let text = self.wide(text.bound)?;
                give(self.sink, Scalar::String(Some(&text))).map_err(Stop::Sink)
            }
            Primitive::Text(text) => {
                let text = self.narrow(text.bound)?;
                give(self.sink, Scalar::String(Some(text))).map_err(Stop::Sink)
            }
        }
    }

    #[inline]
    fn number<G>(&mut self, number: Number, give: G) -> Result<(), Stop<S::Error>>
    where
        G: Fn(&mut S, Scalar<'_>) -> Result<(), S::Error>,
    {
        macro_rules! hand {
            ($variant:ident, $value:expr) => {{
                let value = $value;
                give(self.sink, Scalar::$variant(value))
            }};
        }
        let given = match number {
            Number::Bool => hand!(Boolean, self.array::<1>()? != [0]),
            Number::Int8 => hand!(SByte, i8::from_le_bytes(self.array()?)),
            Number::UInt8 => hand!(Byte, u8::from_le_bytes(self.array()?)),
            Number::Int16 => hand!(Int16, self.u16()?.cast_signed()),
            Number::UInt16 => hand!(UInt16, self.u16()?),
            Number::Int32 => hand!(Int32, self.u32()?.cast_signed()),
            Number::UInt32 => hand!(UInt32, self.u32()?),
            Number::Int64 => hand!(Int64, self.u64()?.cast_signed()),
            Number::UInt64 => hand!(UInt64, self.u64()?),
            Number::Float32 => hand!(Float, f32::from_bits(self.u32()?)),
            Number::Float64 => hand!(Double, f64::from_bits(self.u64()?)),
        };
        given.map_err(Stop::Sink)
    }

    /// Passes on `count` numbers at once. If this is not possible, nothing is consumed; then the
    /// numbers are read individually, which locates errors.
    #[inline]
    fn run(&mut self, number: Number, count: u16) -> Result<bool, S::Error> {
        if L::SWAPPED {
            return Ok(false);
        }
        let before = self.at;
        let size = number.size();
        let taken = match self.take(size, usize::from(count) * size) {
            Ok(bytes) => self.sink.scalars(number.builtin(), bytes)?,
            Err(_) => false,
        };
        if !taken {
            self.at = before;
        }
        Ok(taken)
    }

    fn skip_one(&mut self, primitive: Primitive) -> Result<(), MessageFault> {
        match primitive {
            Primitive::Text(text) => {
                let said = length(self.u32()?)?;
                self.take(1, product(said, if text.wide { 4 } else { 1 })?)?;
            }
            Primitive::Number(_) | Primitive::Clock(_) => {
                self.take(primitive.align(), primitive.size())?;
            }
        }
        Ok(())
    }

    fn packed(&mut self, number: Number, len: Len, carry: bool) -> Result<(), Stop<S::Error>> {
        let count = self.count(len)?;
        // An empty array has no alignment.
        let align = if count == 0 { 1 } else { number.size() };
        let bytes = self.take(align, product(count, number.size())?)?;
        if !carry {
            return Ok(());
        }
        let odd = number == Number::Bool && bytes.iter().any(|byte| *byte > 1);
        let swap = L::SWAPPED && number.size() > 1;
        if !odd && !swap {
            return self
                .sink
                .packed_array(number.builtin(), count, bytes)
                .map_err(Stop::Sink);
        }
        self.scratch.clear();
        if odd {
            self.scratch
                .extend(bytes.iter().map(|byte| u8::from(*byte != 0)));
        } else {
            self.scratch.extend_from_slice(bytes);
            self.scratch
                .chunks_exact_mut(number.size())
                .for_each(<[u8]>::reverse);
        }
        self.sink
            .packed_array(number.builtin(), count, &self.scratch)
            .map_err(Stop::Sink)
    }

    fn many(&mut self, primitive: Primitive, len: Len, carry: bool) -> Result<(), Stop<S::Error>> {
        let count = self.count(len)?;
        self.room(count, primitive.size())?;
        if !carry {
            return Ok((0..count).try_for_each(|_| self.skip_one(primitive))?);
        }
        self.sink
            .array(primitive.builtin(), count)
            .map_err(Stop::Sink)?;
        (0..count).try_for_each(|_| self.one(primitive, S::element))
    }

    fn clock(&mut self, clock: ClockType) -> Result<Scalar<'static>, MessageFault> {
        let (first, second) = (self.u32()?, self.u32()?);
        let signed = first.cast_signed();
        Ok(match clock {
            ClockType::Time1 => Scalar::DateTime(time_to_date_time(i64::from(first), second)),
            ClockType::Time2 => Scalar::DateTime(time_to_date_time(i64::from(signed), second)),
            ClockType::Duration1 => {
                Scalar::Double(duration_to_millis(signed, i64::from(second.cast_signed())))
            }
            ClockType::Duration2 => Scalar::Double(duration_to_millis(signed, i64::from(second))),
        })
    }

    fn narrow(&mut self, bound: u32) -> Result<&'p str, MessageFault> {
        let said = self.u32()?;
        let mut bytes = self.take(1, length(said)?)?;
        // Some writers encode an empty CDR string with the length 0 instead of a NUL.
        if L::ALIGNED && !bytes.is_empty() {
            bytes = bytes.strip_suffix(&[0]).ok_or(MessageFault::Terminator)?;
        }
        check(
            bound,
            u32::try_from(bytes.len()).map_err(|_| MessageFault::Truncated)?,
        )?;
        std::str::from_utf8(bytes).map_err(|_| MessageFault::Text)
    }

    fn wide(&mut self, bound: u32) -> Result<String, MessageFault> {
        let said = self.u32()?;
        check(bound, said)?;
        let bytes = self.take(1, product(length(said)?, 4)?)?;
        let units = bytes.chunks_exact(4).map(|unit| {
            let mut unit = <[u8; 4]>::try_from(unit).unwrap_or_default();
            if L::SWAPPED {
                unit.reverse();
            }
            u16::try_from(u32::from_le_bytes(unit)).map_err(|_| MessageFault::Text)
        });
        let units = units.collect::<Result<Vec<u16>, MessageFault>>()?;
        String::from_utf16(&units).map_err(|_| MessageFault::Text)
    }

    /// Returns the length of an array, within its bound.
    fn count(&mut self, len: Len) -> Result<usize, MessageFault> {
        match len {
            Len::Fixed(count) => length(count),
            Len::Counted { bound } => {
                let count = self.u32()?;
                check(bound, count)?;
                length(count)
            }
        }
    }

    /// Fails if `count` elements of at least `least` bytes exceed the payload, or if there are too
    /// many elements without bytes.
    fn room(&mut self, count: usize, least: usize) -> Result<(), MessageFault> {
        if least == 0 {
            let left = self.without_bytes.checked_sub(count);
            self.without_bytes = left.ok_or(MessageFault::WithoutBytes(count))?;
            return Ok(());
        }
        let left = self.data.len().saturating_sub(self.at);
        if product(count, least)? > left {
            Err(MessageFault::Truncated)
        } else {
            Ok(())
        }
    }

    #[inline]
    fn align(&mut self, to: usize) {
        if L::ALIGNED {
            self.at = self.at.saturating_add(to - 1) & !(to - 1);
        }
    }

    #[inline]
    fn take(&mut self, align: usize, bytes: usize) -> Result<&'p [u8], MessageFault> {
        self.align(align);
        let taken = self
            .data
            .get(self.at..)
            .and_then(|rest| rest.get(..bytes))
            .ok_or(MessageFault::Truncated)?;
        self.at += bytes;
        Ok(taken)
    }

    #[inline]
    fn array<const N: usize>(&mut self) -> Result<[u8; N], MessageFault> {
        self.align(N);
        let taken = *self
            .data
            .get(self.at..)
            .and_then(|rest| rest.first_chunk())
            .ok_or(MessageFault::Truncated)?;
        self.at += N;
        Ok(taken)
    }

    #[inline]
    fn u16(&mut self) -> Result<u16, MessageFault> {
        let value = u16::from_le_bytes(self.array()?);
        Ok(if L::SWAPPED {
            value.swap_bytes()
        } else {
            value
        })
    }

    #[inline]
    fn u32(&mut self) -> Result<u32, MessageFault> {
        let value = u32::from_le_bytes(self.array()?);
        Ok(if L::SWAPPED {
            value.swap_bytes()
        } else {
            value
        })
    }

    #[inline]
    fn u64(&mut self) -> Result<u64, MessageFault> {
        let value = u64::from_le_bytes(self.array()?);
        Ok(if L::SWAPPED {
            value.swap_bytes()
        } else {
            value
        })
    }
}

fn length(count: u32) -> Result<usize, MessageFault> {
    usize::try_from(count).map_err(|_| MessageFault::Truncated)
}

fn product(count: usize, size: usize) -> Result<usize, MessageFault> {
    count.checked_mul(size).ok_or(MessageFault::Truncated)
}

fn check(bound: u32, found: u32) -> Result<(), MessageFault> {
    if found > bound {
        Err(MessageFault::Bound { bound, found })
    } else {
        Ok(())
    }
}
