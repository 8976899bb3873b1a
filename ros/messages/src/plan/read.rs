//! Decodes bytes into a sink.

use std::marker::PhantomData;

use uadp::{BuiltinType, Scalar};

use super::{Len, MAX_WITHOUT_BYTES, Op, Plan, What, Wire};
use crate::definition::{Clock, Number, Primitive};
use crate::{Fault, ReadError, Sink, TypeName, duration_to_millis, time_to_date_time};

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
    Fault(Fault),
    Sink(E),
}

impl<E> From<Fault> for Stop<E> {
    fn from(fault: Fault) -> Self {
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

pub(super) fn read<S: Sink>(
    plan: &Plan,
    ops: &[Op],
    payload: &[u8],
    sink: &mut S,
) -> Result<(), ReadError<S::Error>> {
    as_wire(plan, (ops, false), payload, sink)
}

/// Reads a message as a structure.
pub(super) fn structure<S: Sink>(
    plan: &Plan,
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
fn as_wire<S: Sink>(
    plan: &Plan,
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
        return Err(malformed(payload.len(), Fault::Truncated));
    };
    match u16::from_be_bytes([*high, *low]) {
        0 => run::<BigCdr, S>(plan, (ops, inside), (data, 4), sink),
        1 => run::<LittleCdr, S>(plan, (ops, inside), (data, 4), sink),
        other => Err(malformed(0, Fault::Encapsulation(other))),
    }
}

/// Runs the steps. `offset`: the start of `data` in the payload.
fn run<L: Layout, S: Sink>(
    plan: &Plan,
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
        done = Err(Stop::Fault(Fault::TrailingBytes(left)));
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

impl<'p, L: Layout, S: Sink> Reader<'p, '_, L, S> {
    /// Runs steps. `inside`: whether the steps belong to an element.
    fn steps(&mut self, mut ops: &[Op], inside: bool) -> Result<(), Stop<S::Error>> {
        while let Some((op, after)) = ops.split_first() {
            ops = after;
            self.leaf = Some(op.leaf);
            match &op.what {
                What::One(primitive) if op.carry => self.one(*primitive, S::scalar)?,
                What::One(primitive) => self.skip_one(*primitive)?,
                What::Run(number, count) => {
                    if self.run(*number, *count).map_err(Stop::Sink)? {
                        ops = ops.get(usize::from(*count)..).unwrap_or_default();
                    }
                }
                What::Skip { align, bytes } => {
                    self.take(*align, *bytes)?;
                }
                What::Packed(number, len) => self.packed(*number, *len, op.carry)?,
                What::Bytes(len) => {
                    let count = self.count(*len)?;
                    let bytes = self.take(1, count)?;
                    if op.carry {
                        self.sink
                            .scalar(Scalar::ByteString(Some(bytes)))
                            .map_err(Stop::Sink)?;
                    }
                }
                What::Many(primitive, len) => self.many(*primitive, *len, op.carry)?,
                What::Messages {
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

    fn skip_one(&mut self, primitive: Primitive) -> Result<(), Fault> {
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

    fn clock(&mut self, clock: Clock) -> Result<Scalar<'static>, Fault> {
        let (first, second) = (self.u32()?, self.u32()?);
        let signed = first.cast_signed();
        Ok(match clock {
            Clock::Time1 => Scalar::DateTime(time_to_date_time(i64::from(first), second)),
            Clock::Time2 => Scalar::DateTime(time_to_date_time(i64::from(signed), second)),
            Clock::Duration1 => {
                Scalar::Double(duration_to_millis(signed, i64::from(second.cast_signed())))
            }
            Clock::Duration2 => Scalar::Double(duration_to_millis(signed, i64::from(second))),
        })
    }

    fn narrow(&mut self, bound: u32) -> Result<&'p str, Fault> {
        let said = self.u32()?;
        let mut bytes = self.take(1, length(said)?)?;
        // Some writers encode an empty CDR string with the length 0 instead of a NUL.
        if L::ALIGNED && !bytes.is_empty() {
            bytes = bytes.strip_suffix(&[0]).ok_or(Fault::Terminator)?;
        }
        check(
            bound,
            u32::try_from(bytes.len()).map_err(|_| Fault::Truncated)?,
        )?;
        std::str::from_utf8(bytes).map_err(|_| Fault::Text)
    }

    fn wide(&mut self, bound: u32) -> Result<String, Fault> {
        let said = self.u32()?;
        check(bound, said)?;
        let bytes = self.take(1, product(length(said)?, 4)?)?;
        let units = bytes.chunks_exact(4).map(|unit| {
            let mut unit = <[u8; 4]>::try_from(unit).unwrap_or_default();
            if L::SWAPPED {
                unit.reverse();
            }
            u16::try_from(u32::from_le_bytes(unit)).map_err(|_| Fault::Text)
        });
        let units = units.collect::<Result<Vec<u16>, Fault>>()?;
        String::from_utf16(&units).map_err(|_| Fault::Text)
    }

    /// Returns the length of an array, within its bound.
    fn count(&mut self, len: Len) -> Result<usize, Fault> {
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
    fn room(&mut self, count: usize, least: usize) -> Result<(), Fault> {
        if least == 0 {
            let left = self.without_bytes.checked_sub(count);
            self.without_bytes = left.ok_or(Fault::WithoutBytes(count))?;
            return Ok(());
        }
        let left = self.data.len().saturating_sub(self.at);
        if product(count, least)? > left {
            Err(Fault::Truncated)
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
    fn take(&mut self, align: usize, bytes: usize) -> Result<&'p [u8], Fault> {
        self.align(align);
        let taken = self
            .data
            .get(self.at..)
            .and_then(|rest| rest.get(..bytes))
            .ok_or(Fault::Truncated)?;
        self.at += bytes;
        Ok(taken)
    }

    #[inline]
    fn array<const N: usize>(&mut self) -> Result<[u8; N], Fault> {
        self.align(N);
        let taken = *self
            .data
            .get(self.at..)
            .and_then(|rest| rest.first_chunk())
            .ok_or(Fault::Truncated)?;
        self.at += N;
        Ok(taken)
    }

    #[inline]
    fn u16(&mut self) -> Result<u16, Fault> {
        let value = u16::from_le_bytes(self.array()?);
        Ok(if L::SWAPPED {
            value.swap_bytes()
        } else {
            value
        })
    }

    #[inline]
    fn u32(&mut self) -> Result<u32, Fault> {
        let value = u32::from_le_bytes(self.array()?);
        Ok(if L::SWAPPED {
            value.swap_bytes()
        } else {
            value
        })
    }

    #[inline]
    fn u64(&mut self) -> Result<u64, Fault> {
        let value = u64::from_le_bytes(self.array()?);
        Ok(if L::SWAPPED {
            value.swap_bytes()
        } else {
            value
        })
    }
}

fn length(count: u32) -> Result<usize, Fault> {
    usize::try_from(count).map_err(|_| Fault::Truncated)
}

fn product(count: usize, size: usize) -> Result<usize, Fault> {
    count.checked_mul(size).ok_or(Fault::Truncated)
}

fn check(bound: u32, found: u32) -> Result<(), Fault> {
    if found > bound {
        Err(Fault::Bound { bound, found })
    } else {
        Ok(())
    }
}
