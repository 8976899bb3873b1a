//! The decision if a value makes an alarm active: limits with a deadband, and a delay. Times are
//! inputs.

use std::time::{Duration, Instant};

use mappings::{AlarmLimits, AlarmTrigger, AlarmValue};
use uadp::Scalar;

use super::condition::Levels;

/// A value as alarms compare it.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum AlarmInput {
    Number(f64),
    Value(AlarmValue),
}

impl AlarmInput {
    /// Returns the value of a field. Returns `None` for values that have no alarms.
    pub(crate) fn of(value: &uadp::Variant<'_>) -> Option<Self> {
        let uadp::Variant::Scalar(scalar) = value else {
            return None;
        };
        if let Scalar::Float(number) = scalar {
            return Some(Self::Number(f64::from(*number)));
        }
        if let Scalar::Double(number) = scalar {
            return Some(Self::Number(*number));
        }
        if let Scalar::Boolean(value) = scalar {
            return Some(Self::Value(AlarmValue::Boolean(*value)));
        }
        if let Scalar::String(text) = scalar {
            let text = text.unwrap_or_default().to_owned();
            return Some(Self::Value(AlarmValue::Text(text)));
        }
        integer(scalar).map(|value| Self::Value(AlarmValue::Integer(value)))
    }

    /// Returns the value as a number for limits; `None` also for NaN.
    #[expect(
        clippy::cast_precision_loss,
        reason = "limits are floating point numbers themselves"
    )]
    fn number(&self) -> Option<f64> {
        let number = match self {
            Self::Number(number) => *number,
            Self::Value(AlarmValue::Integer(integer)) => *integer as f64,
            Self::Value(AlarmValue::Boolean(_) | AlarmValue::Text(_)) => return None,
        };
        (!number.is_nan()).then_some(number)
    }
}

impl std::fmt::Display for AlarmInput {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Number(number) => write!(f, "{number}"),
            Self::Value(value) => write!(f, "{value}"),
        }
    }
}

/// Returns the value of an integer of any size.
#[expect(
    clippy::wildcard_enum_match_arm,
    reason = "all other types are no integers"
)]
fn integer(scalar: &Scalar<'_>) -> Option<i128> {
    Some(match scalar {
        Scalar::SByte(value) => (*value).into(),
        Scalar::Byte(value) => (*value).into(),
        Scalar::Int16(value) => (*value).into(),
        Scalar::UInt16(value) => (*value).into(),
        Scalar::Int32(value) => (*value).into(),
        Scalar::UInt32(value) => (*value).into(),
        Scalar::Int64(value) => (*value).into(),
        Scalar::UInt64(value) => (*value).into(),
        _ => return None,
    })
}

/// The trigger of an alarm, with its current levels.
#[derive(Debug)]
pub(crate) struct AlarmCause {
    rule: AlarmTrigger,
    delay: Duration,
    levels: Levels,
    /// Levels that become current at this time, and the value that caused them.
    pending: Option<(Instant, Levels, AlarmInput)>,
}

impl AlarmCause {
    pub(crate) const fn new(rule: AlarmTrigger, delay: Duration) -> Self {
        Self {
            rule,
            delay,
            levels: Levels::NONE,
            pending: None,
        }
    }

    /// Sets the levels before a restart.
    pub(crate) const fn restore(&mut self, levels: Levels) {
        self.levels = levels;
    }

    /// Returns the levels of the last value that was compared.
    pub(crate) const fn levels(&self) -> Levels {
        self.levels
    }

    /// Returns the levels of a value. A value that cannot be compared changes nothing.
    pub(crate) fn read(&mut self, reading: &AlarmInput, now: Instant) -> Levels {
        let Some(found) = evaluate(&self.rule, reading, self.levels) else {
            return self.levels;
        };
        if self.delay.is_zero() || !found.is_worse_than(self.levels) {
            self.pending = None;
            self.levels = found;
            return found;
        }
        let due = self
            .pending
            .as_ref()
            .map_or_else(|| now.checked_add(self.delay), |(due, ..)| Some(*due));
        self.pending = due.map(|due| (due, found, reading.clone()));
        self.levels
    }

    /// Returns the time at which the delay of a value is over.
    pub(crate) fn due(&self) -> Option<Instant> {
        self.pending.as_ref().map(|(due, ..)| *due)
    }

    /// Returns the levels that are due after their delay, and the value that caused them.
    pub(crate) fn elapsed(&mut self, now: Instant) -> Option<(Levels, AlarmInput)> {
        let (_, levels, reading) = self.pending.take_if(|(due, ..)| *due <= now)?;
        self.levels = levels;
        Some((levels, reading))
    }
}

/// Returns `None` for a value that the rule cannot compare.
fn evaluate(rule: &AlarmTrigger, reading: &AlarmInput, before: Levels) -> Option<Levels> {
    let on = |on: bool| Some(if on { Levels::ON } else { Levels::NONE });
    match (rule, reading) {
        (AlarmTrigger::Limits(limits), reading) => Some(beyond(limits, reading.number()?, before)),
        (AlarmTrigger::Normal(normal), AlarmInput::Value(value)) => on(value != normal),
        (AlarmTrigger::When(values), AlarmInput::Value(value)) => on(values.contains(value)),
        (AlarmTrigger::Normal(_) | AlarmTrigger::When(_), AlarmInput::Number(_))
        | (AlarmTrigger::Diagnostics, _) => None,
    }
}

/// Returns the limits that a number exceeds. A limit that was exceeded before is left only when
/// the number has returned by the deadband.
fn beyond(limits: &AlarmLimits, number: f64, before: Levels) -> Levels {
    let before = before.filled();
    let deadband = limits.deadband();
    let sides = [
        (Levels::LOW_LOW, -1.0),
        (Levels::LOW, -1.0),
        (Levels::HIGH, 1.0),
        (Levels::HIGH_HIGH, 1.0),
    ];
    let mut found = Levels::NONE;
    for (limit, (level, sign)) in limits.limits().into_iter().zip(sides) {
        let Some(limit) = limit else { continue };
        let distance = (number - limit) * sign;
        let slack = if before.has(level) { deadband } else { 0.0 };
        if distance > -slack {
            found = found.with(level);
        }
    }
    if limits.exclusive {
        found = found.outermost();
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    fn limits(exclusive: bool, deadband: f64) -> AlarmTrigger {
        let limits = [Some(-10.0), Some(0.0), Some(70.0), Some(90.0)];
        AlarmTrigger::Limits(AlarmLimits::new(limits, deadband, exclusive))
    }

    /// Returns the origin of a virtual clock.
    fn begin() -> Instant {
        bridge_node::now().monotonic
    }

    fn levels(trigger: &mut AlarmCause, values: &[f64]) -> Vec<&'static str> {
        let now = begin();
        let all = values
            .iter()
            .map(|value| trigger.read(&AlarmInput::Number(*value), now).name());
        all.collect()
    }

    #[test]
    fn an_exclusive_alarm_is_at_the_outermost_limit() {
        let mut trigger = AlarmCause::new(limits(true, 0.0), Duration::ZERO);
        assert_eq!(
            levels(&mut trigger, &[70.0, 70.1, 90.1, 90.0, 50.0, -1.0, -11.0]),
            [
                "Inactive", "High", "HighHigh", "High", "Inactive", "Low", "LowLow"
            ]
        );
        assert!(!trigger.levels.has(Levels::LOW));
    }

    #[test]
    fn a_non_exclusive_alarm_is_at_each_limit() {
        let mut trigger = AlarmCause::new(limits(false, 0.0), Duration::ZERO);
        levels(&mut trigger, &[91.0]);
        assert_eq!(trigger.levels, Levels::HIGH.with(Levels::HIGH_HIGH));
    }

    #[test]
    fn a_limit_is_left_when_the_value_has_returned_by_the_deadband() {
        let mut trigger = AlarmCause::new(limits(true, 2.0), Duration::ZERO);
        assert_eq!(
            levels(
                &mut trigger,
                &[71.0, 69.0, 68.1, 68.0, 69.0, 91.0, 88.5, 88.0, 68.5]
            ),
            [
                "High", "High", "High", "Inactive", "Inactive", "HighHigh", "HighHigh", "High",
                "High"
            ]
        );
    }

    #[test]
    fn an_alarm_with_a_delay_is_active_when_the_value_stays_beyond_the_limit() {
        let mut trigger = AlarmCause::new(limits(true, 0.0), Duration::from_secs(2));
        let begin = begin();
        let at = |seconds| begin + Duration::from_secs(seconds);
        let number = AlarmInput::Number;
        assert_eq!(trigger.read(&number(71.0), at(0)), Levels::NONE);
        assert_eq!(trigger.due(), Some(at(2)));
        assert_eq!(trigger.read(&number(50.0), at(1)), Levels::NONE);
        assert_eq!(trigger.due(), None, "the value has returned");
        trigger.read(&number(71.0), at(3));
        trigger.read(&number(95.0), at(4));
        assert_eq!(trigger.elapsed(at(4)), None);
        let elapsed = trigger.elapsed(at(5));
        assert_eq!(elapsed, Some((Levels::HIGH_HIGH, number(95.0))));
        assert_eq!(trigger.read(&number(50.0), at(6)), Levels::NONE, "at once");
    }

    #[test]
    fn values_that_cannot_be_compared_change_nothing() {
        let mut trigger = AlarmCause::new(limits(true, 0.0), Duration::ZERO);
        levels(&mut trigger, &[71.0]);
        let now = begin();
        assert_eq!(
            trigger.read(&AlarmInput::Number(f64::NAN), now),
            Levels::HIGH
        );
        let text = AlarmInput::Value(AlarmValue::Text("71".to_owned()));
        assert_eq!(trigger.read(&text, now), Levels::HIGH);
    }

    #[test]
    fn booleans_integers_and_texts_are_compared_as_they_are() {
        let now = begin();
        let reading = |scalar| AlarmInput::of(&uadp::Variant::Scalar(scalar)).unwrap();
        let mut normal = AlarmCause::new(
            AlarmTrigger::Normal(AlarmValue::Boolean(false)),
            Duration::ZERO,
        );
        assert_eq!(
            normal.read(&reading(Scalar::Boolean(true)), now),
            Levels::ON
        );
        assert!(
            !normal
                .read(&reading(Scalar::Boolean(false)), now)
                .is_active()
        );
        let values = vec![AlarmValue::Integer(2), AlarmValue::Integer(-3)];
        let mut when = AlarmCause::new(AlarmTrigger::When(values), Duration::ZERO);
        assert!(when.read(&reading(Scalar::Int64(-3)), now).is_active());
        assert!(!when.read(&reading(Scalar::Byte(3)), now).is_active());
        assert_eq!(when.read(&reading(Scalar::Byte(2)), now), Levels::ON);
        let values = vec![AlarmValue::Text("fault".to_owned())];
        let mut text = AlarmCause::new(AlarmTrigger::When(values), Duration::ZERO);
        assert!(
            text.read(&reading(Scalar::String(Some("fault"))), now)
                .is_active()
        );
        assert!(!text.read(&reading(Scalar::String(None)), now).is_active());
    }
}
