//! The outputs and inputs of the robot over RTDE, by name and type, as listed in the guide of the
//! manufacturer.

use super::super::wire::{RecipeType, RecipeValue};
use super::{Robot, UrSimulator};

/// Returns the type of an output.
pub(super) fn output(name: &str) -> Option<RecipeType> {
    if let Some(kind) = register(name, "output_") {
        return Some(kind);
    }
    let of = |names: &[&str]| names.contains(&name);
    if of(&VECTORS) {
        Some(RecipeType::Vector)
    } else if of(&DOUBLES) {
        Some(RecipeType::F64)
    } else if of(&["robot_mode", "safety_mode", "tool_mode"]) {
        Some(RecipeType::I32)
    } else if of(&["actual_tool_accelerometer", "payload_cog"]) {
        Some(RecipeType::Triple)
    } else if of(&["joint_mode"]) {
        Some(RecipeType::Whole)
    } else if of(&[
        "runtime_state",
        "robot_status_bits",
        "safety_status_bits",
        "safety_status",
        "analog_io_types",
    ]) {
        Some(RecipeType::U32)
    } else if of(&["actual_digital_input_bits", "actual_digital_output_bits"]) {
        Some(RecipeType::U64)
    } else {
        None
    }
}

/// Returns the type of an input.
pub(super) fn input(name: &str) -> Option<RecipeType> {
    if let Some(kind) = register(name, "input_") {
        return Some(kind);
    }
    match name {
        "speed_slider_mask" => Some(RecipeType::U32),
        "speed_slider_fraction" | "standard_analog_output_0" | "standard_analog_output_1" => {
            Some(RecipeType::F64)
        }
        "standard_digital_output_mask"
        | "standard_digital_output"
        | "configurable_digital_output_mask"
        | "configurable_digital_output"
        | "tool_digital_output_mask"
        | "tool_digital_output"
        | "standard_analog_output_mask"
        | "standard_analog_output_type" => Some(RecipeType::U8),
        "external_force_torque" => Some(RecipeType::Vector),
        _ => None,
    }
}

/// Returns the type of a general purpose register: 48 integers, 48 doubles, 64 bits in two words
/// and from 64 on single bits.
fn register(name: &str, direction: &str) -> Option<RecipeType> {
    let rest = name.strip_prefix(direction)?;
    if rest == "bit_registers0_to_31" || rest == "bit_registers32_to_63" {
        return Some(RecipeType::U32);
    }
    let (of, number) = rest.rsplit_once('_')?;
    let number: u8 = number.parse().ok()?;
    match of {
        "int_register" if number < 48 => Some(RecipeType::I32),
        "double_register" if number < 48 => Some(RecipeType::F64),
        "bit_register" if (64..128).contains(&number) => Some(RecipeType::Bool),
        _ => None,
    }
}

impl Robot {
    /// Returns the current value of an output; outputs that are not simulated are zero.
    pub(super) fn tells(&self, name: &str, kind: RecipeType) -> RecipeValue {
        let number = name.strip_prefix("output_int_register_");
        if let Some(register) = number
            .and_then(|number| number.parse::<usize>().ok())
            .and_then(|number| self.registers.get(number))
        {
            return RecipeValue::I32(*register);
        }
        let runs = self.program.is_some() && !self.paused;
        // 1: no program; 2: the program runs; 4: the program is paused.
        let runtime = match (&self.program, self.paused) {
            (None, _) => 1,
            (Some(_), false) => 2,
            (Some(_), true) => 4,
        };
        match name {
            "timestamp" => {
                RecipeValue::F64(self.seen.duration_since(self.switched_on).as_secs_f64())
            }
            "actual_TCP_pose" | "target_TCP_pose" => RecipeValue::Vector(self.pose),
            "actual_q" | "target_q" => RecipeValue::Vector(self.joints),
            "actual_TCP_speed" | "target_TCP_speed" => RecipeValue::Vector(self.velocity()),
            "actual_TCP_force" => RecipeValue::Vector(self.force()),
            "joint_temperatures" => RecipeValue::Vector(TEMPERATURES),
            "actual_current" => RecipeValue::Vector(CURRENTS),
            "payload" => RecipeValue::F64(self.payload.0),
            "payload_cog" => RecipeValue::Triple(self.payload.1),
            "robot_mode" => RecipeValue::I32(self.mode()),
            "safety_mode" => RecipeValue::I32(self.safety),
            "runtime_state" => RecipeValue::U32(runtime),
            // Power is on; a program runs.
            "robot_status_bits" => RecipeValue::U32(1 | u32::from(runs) << 1),
            "safety_status_bits" => RecipeValue::U32(if self.safety == 1 { 1 } else { 1 << 2 }),
            "safety_status" => RecipeValue::U32(u32::try_from(self.safety).unwrap_or_default()),
            "speed_scaling" | "target_speed_fraction" => RecipeValue::F64(self.slider),
            "actual_main_voltage" => RecipeValue::F64(230.0),
            "actual_robot_voltage" => RecipeValue::F64(48.0),
            _ => kind.zero(),
        }
    }
}

impl UrSimulator {
    /// Applies inputs in the order of a client's recipe.
    pub(super) fn told(&self, values: &[(String, RecipeValue)]) {
        let named = |wanted: &str| values.iter().find(|(name, _)| name == wanted);
        let mask = named("speed_slider_mask").map(|(_, value)| *value);
        if let (Some(RecipeValue::U32(1)), Some((_, RecipeValue::F64(fraction)))) =
            (mask, named("speed_slider_fraction"))
            && fraction.is_finite()
        {
            self.lock().slider = fraction.clamp(0.0, 1.0);
        }
    }
}

/// The temperatures of the joints at rest, in degrees Celsius.
const TEMPERATURES: [f64; 6] = [28.0, 29.5, 29.0, 31.0, 31.5, 32.0];
/// The currents of the motors at rest, in A.
const CURRENTS: [f64; 6] = [0.0, -2.5, -1.5, -0.25, 0.125, 0.0];
const VECTORS: [&str; 20] = [
    "payload_inertia",
    "target_q",
    "target_qd",
    "target_qdd",
    "target_current",
    "target_moment",
    "actual_q",
    "actual_qd",
    "actual_current",
    "joint_control_output",
    "actual_TCP_pose",
    "actual_TCP_speed",
    "actual_TCP_force",
    "target_TCP_pose",
    "target_TCP_speed",
    "joint_temperatures",
    "actual_joint_voltage",
    "ft_raw_wrench",
    "actual_current_window",
    "tcp_offset",
];
const DOUBLES: [&str; 15] = [
    "timestamp",
    "actual_execution_time",
    "speed_scaling",
    "target_speed_fraction",
    "actual_momentum",
    "actual_main_voltage",
    "actual_robot_voltage",
    "actual_robot_current",
    "standard_analog_input0",
    "standard_analog_input1",
    "standard_analog_output0",
    "standard_analog_output1",
    "io_current",
    "tool_output_current",
    "payload",
];
