//! The messages of the benchmark, as sent by a robot.

use messages::{Dialect, FieldSupplier, MessagePlan, Selection, SourceError, TypeRegistry, Wire};
use uadp::{BuiltinType, DateTime, Scalar};

/// A type, and the lengths of its arrays in order.
#[derive(Debug, Clone, Copy)]
pub(crate) struct BenchPayload {
    pub(crate) name: &'static str,
    of: &'static str,
    lengths: &'static [usize],
    /// Whether the message is too large for an instruction counter.
    pub(crate) large: bool,
}

pub(crate) const ALL: [BenchPayload; 6] = [
    payload("Bool", "std_msgs/Bool", &[]),
    payload("Twist", "geometry_msgs/Twist", &[]),
    payload("JointState(6)", "sensor_msgs/JointState", &[6, 6, 6, 6]),
    payload("Odometry", "nav_msgs/Odometry", &[36, 36]),
    payload("LaserScan(720)", "sensor_msgs/LaserScan", &[720, 720]),
    BenchPayload {
        large: true,
        ..payload(
            "PointCloud2(1 MB)",
            "sensor_msgs/PointCloud2",
            &[4, 1_000_000],
        )
    },
];

const fn payload(name: &'static str, of: &'static str, lengths: &'static [usize]) -> BenchPayload {
    BenchPayload {
        name,
        of,
        lengths,
        large: false,
    }
}

impl BenchPayload {
    /// Returns the plan of the type and a message.
    pub(crate) fn make(&self, dialect: Dialect) -> (MessagePlan, Vec<u8>) {
        let wire = match dialect {
            Dialect::Ros1 => Wire::Ros1,
            Dialect::Ros2 => Wire::Cdr,
        };
        let of = self.of.parse().unwrap();
        let message = TypeRegistry::bundle(dialect).get(&of).unwrap();
        let plan = MessagePlan::compile(&message, &Selection::Whole, wire).unwrap();
        let mut out = Vec::new();
        plan.write(&mut Filler(self.lengths.iter()), &mut out)
            .unwrap();
        (plan, out)
    }

    pub(crate) const fn type_name(&self) -> &'static str {
        self.of
    }
}

/// A source of plausible values.
struct Filler(std::slice::Iter<'static, usize>);

static BYTES: [u8; 1_000_000] = [0x3F; 1_000_000];

impl Filler {
    fn length(&mut self) -> usize {
        *self.0.next().unwrap()
    }
}

impl FieldSupplier<'static> for Filler {
    fn scalar(&mut self, expected: BuiltinType) -> Result<Scalar<'static>, SourceError> {
        Ok(match expected {
            BuiltinType::Boolean => Scalar::Boolean(true),
            BuiltinType::Byte => Scalar::Byte(7),
            BuiltinType::UInt32 => Scalar::UInt32(640),
            BuiltinType::Float => Scalar::Float(0.25),
            BuiltinType::Double => Scalar::Double(0.125),
            BuiltinType::String => Scalar::String(Some("base_link")),
            BuiltinType::DateTime => Scalar::DateTime(DateTime(134_234_948_967_890_100)),
            BuiltinType::ByteString => Scalar::ByteString(Some(&BYTES[..self.length()])),
            other => panic!("no message here has {other:?}"),
        })
    }

    fn packed_array(
        &mut self,
        expected: BuiltinType,
    ) -> Result<(usize, &'static [u8]), SourceError> {
        let count = self.length();
        Ok((count, &BYTES[..count * expected.fixed_size().unwrap()]))
    }

    fn array(&mut self, _: BuiltinType) -> Result<usize, SourceError> {
        Ok(self.length())
    }

    fn element(&mut self, _: BuiltinType) -> Result<Scalar<'static>, SourceError> {
        Ok(Scalar::String(Some("joint_1")))
    }

    fn structures(&mut self) -> Result<usize, SourceError> {
        Ok(self.length())
    }

    fn begin_structure(&mut self) -> Result<(), SourceError> {
        Ok(())
    }

    fn end_structure(&mut self) -> Result<(), SourceError> {
        Ok(())
    }

    fn finish(&mut self) -> Result<(), SourceError> {
        assert_eq!(self.0.len(), 0, "lengths are left over");
        Ok(())
    }
}
