//! Alarms of variables: the conditions that the cell's server derives from their values.

use std::time::Duration;

/// Alarm of a variable (OPC 10000-9).
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Alarm {
    /// Values that make the alarm active.
    pub trigger: AlarmTrigger,
    /// Severity of the alarm, 1 to 1000. The outer limits are more severe.
    pub severity: u16,
    /// `true` if an acknowledged alarm also needs a confirmation.
    pub confirm: bool,
    /// Time for which a value has to trigger the alarm before the alarm is active.
    pub delay: Duration,
    /// Text of the alarm; `None` for a text that names the variable, its value and the limit.
    pub message: Option<String>,
}

/// Values that make an alarm active.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum AlarmTrigger {
    /// Numbers beyond limits.
    Limits(AlarmLimits),
    /// Every value but this value.
    Normal(AlarmValue),
    /// One of these values.
    When(Vec<AlarmValue>),
    /// The entries of a `diagnostic_msgs/DiagnosticArray`: each is an alarm of its own, and active
    /// unless its level is OK.
    Diagnostics,
}

/// A value of a Boolean, an integer or a text.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum AlarmValue {
    /// A Boolean.
    Boolean(bool),
    /// An integer.
    Integer(i128),
    /// A text.
    Text(String),
}

impl std::fmt::Display for AlarmValue {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Boolean(value) => write!(f, "{value}"),
            Self::Integer(value) => write!(f, "{value}"),
            Self::Text(value) => f.write_str(value),
        }
    }
}

/// Limits of a number, in the order LowLow, Low, High, HighHigh.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct AlarmLimits {
    /// The limits, as bits.
    limits: [Option<u64>; 4],
    /// The deadband, as bits.
    deadband: u64,
    /// `true` if the alarm is at one limit only, the outermost that the value exceeds.
    pub exclusive: bool,
}

impl AlarmLimits {
    /// Creates limits from LowLow, Low, High and HighHigh.
    #[must_use]
    pub fn new(limits: [Option<f64>; 4], deadband: f64, exclusive: bool) -> Self {
        Self {
            limits: limits.map(|limit| limit.map(f64::to_bits)),
            deadband: deadband.to_bits(),
            exclusive,
        }
    }

    /// Returns LowLow, Low, High and HighHigh.
    #[must_use]
    pub fn limits(&self) -> [Option<f64>; 4] {
        self.limits.map(|limit| limit.map(f64::from_bits))
    }

    /// Returns the distance that a value has to return behind a limit to leave it.
    #[must_use]
    pub const fn deadband(&self) -> f64 {
        f64::from_bits(self.deadband)
    }
}
