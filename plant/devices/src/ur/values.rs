//! The values of a robot for clients.

use std::time::Duration;

use skills::{Builtin, DeviceValue, Measured, SkillValue, ValueShape};

use super::of_robot;
use super::rtde::{Rtde, RtdeError};
use super::wire::{RecipeType, RecipeValue};
use crate::measuring::value;

/// Measures all values until the robot is lost, and returns the reason. The robot sends its state
/// at the rate of the period. Values of outputs that the controller does not have are unknown.
pub(super) async fn measure(rtde: &str, period: Duration, out: &Measured) -> RtdeError {
    let hertz = (1.0 / period.as_secs_f64()).clamp(1.0, FASTEST);
    let (mut rtde, measured) = match open(rtde, hertz, out).await {
        Ok(opened) => opened,
        Err(why) => return why,
    };
    loop {
        let values = match rtde.next().await {
            Ok(values) => values,
            Err(why) => return why,
        };
        for ((name, _), value) in measured.iter().zip(values) {
            out.put(
                name,
                shown(name, value).map_err(|why| why.to_string().into()),
            );
        }
    }
}

/// A value and its output of RTDE.
type Output = (&'static str, &'static str);

/// Connects with all outputs that the controller has. Returns them in the order of the recipe.
async fn open(address: &str, hertz: f64, out: &Measured) -> Result<(Rtde, Vec<Output>), RtdeError> {
    let all = MEASURED.map(|(_, output)| output);
    let why = match Rtde::open(address, hertz, &all, &[]).await {
        Ok(rtde) => return Ok((rtde, MEASURED.to_vec())),
        Err(why) => why,
    };
    let RtdeError::Outputs { kinds, .. } = &why else {
        return Err(why);
    };
    if kinds.len() != all.len() {
        return Err(why);
    }
    // Controllers of earlier versions have fewer outputs.
    let (known, unknown): (Vec<_>, Vec<_>) = MEASURED
        .into_iter()
        .zip(kinds)
        .partition(|(_, kind)| RecipeType::of(kind).is_some());
    if known.is_empty() {
        return Err(why);
    }
    for ((name, output), kind) in unknown {
        out.put(name, Err(unsupported(output, kind).into()));
    }
    let known: Vec<Output> = known.into_iter().map(|(measured, _)| measured).collect();
    let outputs: Vec<&str> = known.iter().map(|(_, output)| *output).collect();
    let rtde = Rtde::open(address, hertz, &outputs, &[]).await?;
    Ok((rtde, known))
}

/// Returns the reason why an output with this type is unknown.
fn unsupported(output: &str, kind: &str) -> String {
    if kind == "NOT_FOUND" {
        return format!("the robot has no output {output}");
    }
    let kind: String = kind.chars().take(LONGEST_KIND).collect();
    let kind = kind.escape_debug();
    format!("the robot sends {output} as {kind}, which is not supported")
}

/// An output of the robot with a type that the value does not have.
#[derive(Debug, thiserror::Error)]
#[error("the robot sends {name} as {value:?}")]
struct UnshownOutput {
    name: String,
    value: RecipeValue,
}

/// Returns a value of the robot for clients.
fn shown(name: &str, value: RecipeValue) -> Result<SkillValue, UnshownOutput> {
    Ok(match value {
        RecipeValue::Vector(pose) if name == "TcpPose" => of_robot(pose).into(),
        RecipeValue::Vector(six) => six.into(),
        RecipeValue::Triple(three) => three.to_vec().into(),
        RecipeValue::I32(number) => number.into(),
        RecipeValue::F64(number) if name == "SpeedScaling" => (number * 100.0).into(),
        RecipeValue::F64(number) => number.into(),
        other @ (RecipeValue::Bool(_)
        | RecipeValue::U8(_)
        | RecipeValue::U32(_)
        | RecipeValue::U64(_)
        | RecipeValue::Whole(_)) => {
            let name = name.to_owned();
            return Err(UnshownOutput { name, value: other });
        }
    })
}

const MEASURED: [Output; 12] = [
    ("TcpPose", "actual_TCP_pose"),
    ("TcpSpeed", "actual_TCP_speed"),
    ("TcpForce", "actual_TCP_force"),
    ("JointPositions", "actual_q"),
    ("SpeedScaling", "target_speed_fraction"),
    ("RobotMode", "robot_mode"),
    ("SafetyMode", "safety_mode"),
    ("JointSpeeds", "actual_qd"),
    ("LoadMass", "payload"),
    ("LoadCenter", "payload_cog"),
    ("JointTemperatures", "joint_temperatures"),
    ("JointCurrents", "actual_current"),
];

/// The values of a robot. A new value is the last, because the numbers of values follow this order.
pub(super) const VALUES: [DeviceValue; 12] = [
    list(
        "TcpPose",
        None,
        "The pose of the flange: x, y, z in m and the rotations about them in rad.",
    ),
    list("TcpSpeed", None, "The speed of the flange: m/s, and rad/s."),
    list("TcpForce", None, "The force at the tool: N, and N m."),
    list(
        "JointPositions",
        Some("rad"),
        "The positions of the joints.",
    ),
    DeviceValue {
        unit: Some("%"),
        range: Some((0.0, 100.0)),
        ..value(
            "SpeedScaling",
            Builtin::Double,
            "The position of the speed slider.",
        )
    },
    value(
        "RobotMode",
        Builtin::Int32,
        "7 runs, 5 waits for the release of its brakes, 3 is switched off.",
    ),
    value(
        "SafetyMode",
        Builtin::Int32,
        "1 normal, 2 reduced, 3 protective stop, 5 safeguard stop, 6 and 7 emergency stop, 8 and 9 fault.",
    ),
    list("JointSpeeds", Some("rad/s"), "The speeds of the joints."),
    DeviceValue {
        unit: Some("kg"),
        ..value(
            "LoadMass",
            Builtin::Double,
            "The mass at the flange, as it is set at the robot.",
        )
    },
    list(
        "LoadCenter",
        Some("m"),
        "The centre of this mass in the frame of the flange.",
    ),
    list(
        "JointTemperatures",
        Some("\u{b0}C"),
        "The temperatures of the joints.",
    ),
    list(
        "JointCurrents",
        Some("A"),
        "The currents of the motors of the joints.",
    ),
];

const fn list(name: &'static str, unit: Option<&'static str>, about: &'static str) -> DeviceValue {
    DeviceValue {
        shape: ValueShape::array(Builtin::Double),
        unit,
        ..value(name, Builtin::Double, about)
    }
}

/// Highest rate of values, Hz.
const FASTEST: f64 = 125.0;
/// Limit of the characters of a type in a message.
const LONGEST_KIND: usize = 20;

#[cfg(test)]
mod tests {
    use super::super::simulator::{ServedRobot, UrSimulator, UrSimulatorSettings};
    use super::*;

    #[test]
    fn an_output_of_another_type_is_not_reported_as_missing() {
        for (kind, reason) in [
            ("NOT_FOUND", "the robot has no output payload"),
            (
                "FLOAT",
                "the robot sends payload as FLOAT, which is not supported",
            ),
            (
                "\u{7}34567890123456789012345",
                "the robot sends payload as \\u{7}3456789012345678901, which is not supported",
            ),
        ] {
            assert_eq!(unsupported("payload", kind), reason);
        }
    }

    const OUTPUTS: [&str; 12] = [
        "actual_TCP_pose",
        "actual_TCP_speed",
        "actual_TCP_force",
        "actual_q",
        "target_speed_fraction",
        "robot_mode",
        "safety_mode",
        "actual_qd",
        "payload",
        "payload_cog",
        "joint_temperatures",
        "actual_current",
    ];

    #[tokio::test]
    async fn a_robot_without_any_output_is_reported_with_all_outputs() {
        let settings = UrSimulatorSettings {
            lacks: &OUTPUTS,
            ..UrSimulatorSettings::default()
        };
        let simulator = UrSimulator::new(settings);
        let serving = ServedRobot::start(&simulator, "127.0.0.1:0", "127.0.0.1:0").await;
        let address = serving.as_ref().unwrap().rtde().to_string();
        match open(&address, FASTEST, &Measured::default()).await {
            Err(RtdeError::Outputs { outputs, kinds, .. }) => {
                assert_eq!(outputs, OUTPUTS);
                assert_eq!(kinds, ["NOT_FOUND"; OUTPUTS.len()]);
            }
            other => panic!("{other:?}"),
        }
    }
}
