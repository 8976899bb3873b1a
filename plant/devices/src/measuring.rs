//! Values of devices and the times at which they are measured.

use std::time::Duration;

use skills::{Builtin, DeviceValue, ValueShape};
use tokio::time::{Interval, MissedTickBehavior, interval};

/// Returns the description of a scalar value without a unit and a range.
pub(crate) const fn value(
    name: &'static str,
    builtin: Builtin,
    about: &'static str,
) -> DeviceValue {
    DeviceValue {
        name,
        shape: ValueShape::scalar(builtin),
        unit: None,
        range: None,
        about,
    }
}

/// Returns the times of measurements. A late measurement delays the next.
pub(crate) fn ticks(period: Duration) -> Interval {
    let mut ticks = interval(period);
    ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    ticks
}
