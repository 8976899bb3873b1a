//! A source of random values.
use std::collections::HashMap;
use std::sync::OnceLock;

use messages::{FieldSupplier, MessagePlan, SourceError, WriteFault};
use proptest::prelude::Rng as _;
use proptest::test_runner::TestRng;
use uadp::{BuiltinType, DateTime, Scalar};

use crate::support::{RecordedEvent, RecordedValue};

/// Supplies random values and records them.
struct Inventor<'r> {
    rng: &'r mut TestRng,
    made: Vec<RecordedEvent>,
    /// Lengths that the type requires, by the index of the array.
    lengths: &'r HashMap<usize, usize>,
    arrays: usize,
}

const TEXTS: [&str; 6] = [
    "",
    "x",
    "Grüße",
    "日本語",
    "🤖 robot",
    "a longer text, to move what follows",
];

impl Inventor<'_> {
    fn length(&mut self) -> usize {
        let number = self.arrays;
        self.arrays += 1;
        self.lengths
            .get(&number)
            .copied()
            .unwrap_or_else(|| (self.rng.next_u32() % 4) as usize)
    }

    fn value(&mut self, builtin: BuiltinType) -> Scalar<'static> {
        let random = self.rng.next_u64();
        let signed = random.cast_signed();
        match builtin {
            BuiltinType::String => Scalar::String(Some(TEXTS[(random % 6) as usize])),
            // Any Double may be a duration, so each is exact to the nanosecond.
            BuiltinType::Double => Scalar::Double((random % 16_000_000) as f64 / 8.0 - 1_000_000.0),
            // From 1970 to 2037, the range of both ROS versions.
            BuiltinType::DateTime => Scalar::DateTime(DateTime(
                116_444_736_000_000_000 + (random % 21_000_000_000_000_000).cast_signed(),
            )),
            BuiltinType::Boolean => Scalar::Boolean(random.is_multiple_of(2)),
            BuiltinType::SByte => Scalar::SByte(signed as i8),
            BuiltinType::Byte => Scalar::Byte(random as u8),
            BuiltinType::Int16 => Scalar::Int16(signed as i16),
            BuiltinType::UInt16 => Scalar::UInt16(random as u16),
            BuiltinType::Int32 => Scalar::Int32(signed as i32),
            BuiltinType::UInt32 => Scalar::UInt32(random as u32),
            BuiltinType::Int64 => Scalar::Int64(signed),
            BuiltinType::UInt64 => Scalar::UInt64(random),
            BuiltinType::Float => {
                let bits = self.pool(BuiltinType::Float, 4);
                Scalar::Float(f32::from_le_bytes(bits.try_into().unwrap()))
            }
            other => panic!("{other:?} is no value of a ROS message"),
        }
    }

    /// Returns the given number of bytes as numbers of that type, without any NaN: not every
    /// serializer keeps the payload of a NaN.
    fn pool(&mut self, builtin: BuiltinType, bytes: usize) -> &'static [u8] {
        const SIZE: usize = 1 << 16;
        static POOLS: OnceLock<[Vec<u8>; 2]> = OnceLock::new();
        let [any, truths] = POOLS.get_or_init(|| {
            let mut all = vec![0; SIZE];
            self.rng.fill_bytes(&mut all);
            let truths = all.iter().map(|byte| byte & 1).collect();
            all.iter_mut()
                .filter(|byte| **byte & 0x7F == 0x7F)
                .for_each(|byte| *byte ^= 0x40);
            [all, truths]
        });
        let pool = if builtin == BuiltinType::Boolean {
            truths
        } else {
            any
        };
        let at = self.rng.next_u32() as usize % (SIZE - bytes);
        &pool[at..at + bytes]
    }
}

impl FieldSupplier<'static> for Inventor<'_> {
    fn scalar(&mut self, expected: BuiltinType) -> Result<Scalar<'static>, SourceError> {
        let value = if expected == BuiltinType::ByteString {
            let length = self.length();
            Scalar::ByteString(Some(self.pool(BuiltinType::Byte, length)))
        } else {
            self.value(expected)
        };
        self.made
            .push(RecordedEvent::Scalar(RecordedValue::of(value)));
        Ok(value)
    }
    fn packed_array(
        &mut self,
        expected: BuiltinType,
    ) -> Result<(usize, &'static [u8]), SourceError> {
        let count = self.length();
        let bytes = self.pool(expected, count * expected.fixed_size().unwrap());
        self.made
            .push(RecordedEvent::Packed(expected, count, bytes.to_vec()));
        Ok((count, bytes))
    }
    fn array(&mut self, expected: BuiltinType) -> Result<usize, SourceError> {
        let count = self.length();
        self.made.push(RecordedEvent::Array(expected, count));
        Ok(count)
    }
    fn element(&mut self, expected: BuiltinType) -> Result<Scalar<'static>, SourceError> {
        let value = self.value(expected);
        self.made
            .push(RecordedEvent::Element(RecordedValue::of(value)));
        Ok(value)
    }
    fn structures(&mut self) -> Result<usize, SourceError> {
        let count = self.length();
        self.made
            .push(RecordedEvent::Structures(String::new(), count));
        Ok(count)
    }
    fn begin_structure(&mut self) -> Result<(), SourceError> {
        self.made.push(RecordedEvent::Begin(String::new()));
        Ok(())
    }
    fn end_structure(&mut self) -> Result<(), SourceError> {
        self.made.push(RecordedEvent::End);
        Ok(())
    }
    fn finish(&mut self) -> Result<(), SourceError> {
        Ok(())
    }
}

/// Returns values of the plan's fields and the message they form. A fixed length is learned from
/// the refusal of another length.
pub(crate) fn invent(plan: &MessagePlan, rng: &TestRng) -> (Vec<RecordedEvent>, Vec<u8>) {
    let mut lengths = HashMap::new();
    for _ in 0..1000 {
        let mut out = Vec::new();
        let mut inventor = Inventor {
            rng: &mut rng.clone(),
            made: Vec::new(),
            lengths: &lengths,
            arrays: 0,
        };
        let done = plan.write(&mut inventor, &mut out);
        let (made, arrays) = (inventor.made, inventor.arrays);
        match done {
            Ok(()) => return (made, out),
            Err(error) => {
                assert!(out.is_empty(), "a message that failed left bytes");
                let length = match error.fault {
                    WriteFault::Length { expected, .. } => expected,
                    WriteFault::Bound { bound, .. } => bound,
                    fault => panic!("{fault}"),
                };
                lengths.insert(arrays - 1, length as usize);
            }
        }
    }
    panic!("no values found");
}

/// Removes the names of structures, because structures of an inventor have no name.
pub(crate) fn unnamed(events: Vec<RecordedEvent>) -> Vec<RecordedEvent> {
    let strip = |event| match event {
        RecordedEvent::Structures(_, count) => RecordedEvent::Structures(String::new(), count),
        RecordedEvent::Begin(_) => RecordedEvent::Begin(String::new()),
        other => other,
    };
    events.into_iter().map(strip).collect()
}
