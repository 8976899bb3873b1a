use uadp::DateTime;

/// 1970-01-01 in ticks of 100 ns since 1601-01-01.
const UNIX_EPOCH: i64 = 116_444_736_000_000_000;
const TICKS_PER_SECOND: i64 = 10_000_000;
const NANOS_PER_SECOND: i64 = 1_000_000_000;

/// Converts a ROS time to a DateTime, rounded down to 100 ns. No ROS time is out of range.
///
/// `sec` counts from 1970-01-01 and is within `u32` (ROS 1) or `i32` (ROS 2); beyond 9·10^11 it
/// saturates.
pub fn time_to_date_time(sec: i64, nanosec: u32) -> DateTime {
    DateTime(
        sec.saturating_mul(TICKS_PER_SECOND)
            .saturating_add(i64::from(nanosec / 100))
            .saturating_add(UNIX_EPOCH),
    )
}

/// Converts a DateTime to seconds and nanoseconds since 1970-01-01; earlier seconds are negative.
///
/// The null DateTime (0 or less, OPC 10000-6 5.2.2.5) is ROS's zero time, which also means "not
/// set".
pub fn date_time_to_time(value: DateTime) -> (i64, u32) {
    if value.0 <= 0 {
        return (0, 0);
    }
    let ticks = value.0.saturating_sub(UNIX_EPOCH);
    let nanos = u32::try_from(ticks.rem_euclid(TICKS_PER_SECOND) * 100).unwrap_or_default();
    (ticks.div_euclid(TICKS_PER_SECOND), nanos)
}

/// Nanoseconds of the shortest and of the longest ROS duration.
const DURATIONS: (i64, i64) = (
    -2_147_483_648 * NANOS_PER_SECOND,
    2_147_483_648 * NANOS_PER_SECOND - 1,
);
/// The longest ROS duration in milliseconds: the nearest Double is 2^31 s.
const LONGEST: f64 = 2_147_483_648_000.0;

/// Converts a DateTime to the seconds and nanoseconds of a ROS time with seconds from `earliest` to
/// `latest`. A DateTime out of this range becomes the earliest or latest time (OPC 10000-6,
/// 5.2.2.5).
pub(crate) fn date_time_within(value: DateTime, earliest: i64, latest: i64) -> (i64, u32) {
    match date_time_to_time(value) {
        (sec, _) if sec < earliest => (earliest, 0),
        (sec, _) if sec > latest => (latest, 999_999_900),
        time => time,
    }
}

/// Converts a ROS duration to milliseconds.
///
/// The result is the nearest Double: up to 2^33 ms (99 days) [`millis_to_duration`] returns the
/// same seconds and nanoseconds. Beyond that a Double does not distinguish all nanoseconds; up to
/// 2^31 s the error is at most 245 ns. If nanoseconds beyond a second exceed the range of a
/// duration, the result is the shortest or longest duration.
pub fn duration_to_millis(sec: i32, nanosec: i64) -> f64 {
    let (shortest, longest) = DURATIONS;
    let nanos = i64::from(sec) * NANOS_PER_SECOND + nanosec;
    let nanos = nanos.clamp(shortest, longest);
    let whole = nanos.div_euclid(1_000_000);
    let rest = nanos.rem_euclid(1_000_000);
    lossless(whole) + lossless(rest) / 1e6
}

/// Converts milliseconds to seconds and 0..10^9 nanoseconds, to the nearest nanosecond. Returns
/// `None` if the seconds do not fit. 2^31 s is the Double of the longest duration, which is
/// returned for it.
pub fn millis_to_duration(millis: f64) -> Option<(i32, u32)> {
    if millis.total_cmp(&LONGEST).is_eq() {
        return Some((i32::MAX, 999_999_999));
    }
    let whole = millis.floor();
    if !(-3e12..3e12).contains(&whole) {
        return None;
    }
    #[expect(
        clippy::cast_possible_truncation,
        reason = "a whole number below 3e12, and one of 0..=1000000"
    )]
    let nanos = whole as i64 * 1_000_000 + ((millis - whole) * 1e6).round() as i64;
    let sec = i32::try_from(nanos.div_euclid(NANOS_PER_SECOND)).ok()?;
    Some((sec, u32::try_from(nanos.rem_euclid(NANOS_PER_SECOND)).ok()?))
}

/// Converts to a Double without loss: `value` is below 2^53 in all uses.
#[expect(
    clippy::cast_precision_loss,
    reason = "whole milliseconds of an i32 of seconds, and less than 10^6"
)]
fn lossless(value: i64) -> f64 {
    value as f64
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn known_times_are_known_date_times() {
        assert_eq!(time_to_date_time(0, 0), DateTime(116_444_736_000_000_000));
        // 2000-01-01T00:00:00Z
        assert_eq!(
            time_to_date_time(946_684_800, 999_999_999),
            DateTime(125_911_584_009_999_999)
        );
        assert_eq!(
            date_time_to_time(DateTime(125_911_584_009_999_999)),
            (946_684_800, 999_999_900)
        );
    }

    #[test]
    fn the_null_date_time_is_the_zero_time() {
        assert_eq!(date_time_to_time(DateTime(0)), (0, 0));
        assert_eq!(date_time_to_time(DateTime(-1)), (0, 0));
        assert_eq!(date_time_to_time(DateTime(i64::MIN)), (0, 0));
        assert_eq!(
            date_time_to_time(DateTime(UNIX_EPOCH - 1)),
            (-1, 999_999_900)
        );
    }

    #[test]
    fn durations_are_milliseconds() {
        assert_eq!(duration_to_millis(1, 500_000_000), 1500.0);
        assert_eq!(duration_to_millis(-1, 999_000_000), -1.0);
        assert_eq!(millis_to_duration(-0.000_001), Some((-1, 999_999_999)));
        let longest = Some((i32::MAX, 999_999_999));
        assert_eq!(duration_to_millis(i32::MAX, 999_999_999), LONGEST);
        assert_eq!(millis_to_duration(LONGEST), longest);
        assert_eq!(millis_to_duration(LONGEST.next_up()), None);
        // Nanoseconds that no sender should send.
        let beyond = duration_to_millis(i32::MAX, i64::from(u32::MAX));
        assert_eq!(millis_to_duration(beyond), longest);
        let below = duration_to_millis(i32::MIN, i64::from(i32::MIN));
        assert_eq!(millis_to_duration(below), Some((i32::MIN, 0)));
        assert_eq!(
            millis_to_duration(-2_147_483_648_000.0),
            Some((i32::MIN, 0))
        );
        for value in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY, 1e300] {
            assert_eq!(millis_to_duration(value), None);
        }
    }

    proptest! {
        #[test]
        fn a_duration_of_up_to_99_days_returns_to_the_nanosecond(sec in -8_589_934i32..8_589_934, nanosec in 0u32..1_000_000_000) {
            prop_assert_eq!(millis_to_duration(duration_to_millis(sec, i64::from(nanosec))), Some((sec, nanosec)));
        }

        #[test]
        fn a_time_loses_less_than_100_ns_on_its_first_way_and_nothing_on_any_other(sec in i64::from(i32::MIN)..=i64::from(u32::MAX), nanosec in 0u32..1_000_000_000) {
            let (back, rest) = date_time_to_time(time_to_date_time(sec, nanosec));
            prop_assert_eq!((back, rest), (sec, nanosec - nanosec % 100));
            prop_assert_eq!(date_time_to_time(time_to_date_time(back, rest)), (back, rest));
        }

        #[test]
        fn a_duration_that_went_to_and_fro_stays_what_it_is(sec in i32::MIN..=i32::MAX, nanosec in 0u32..1_000_000_000) {
            let (back, rest) = millis_to_duration(duration_to_millis(sec, i64::from(nanosec))).unwrap();
            let again = millis_to_duration(duration_to_millis(back, i64::from(rest)));
            prop_assert_eq!(again, Some((back, rest)));
        }

        #[test]
        fn any_duration_returns_within_245_nanoseconds(sec in i32::MIN..=i32::MAX, nanosec in 0u32..1_000_000_000) {
            let (back, rest) = millis_to_duration(duration_to_millis(sec, i64::from(nanosec))).unwrap();
            let drift = (i64::from(back) - i64::from(sec)) * NANOS_PER_SECOND + i64::from(rest) - i64::from(nanosec);
            prop_assert!(drift.abs() <= 245, "{}", drift);
        }

        #[test]
        fn a_time_returns_to_100_nanoseconds(sec in i64::from(i32::MIN)..i64::from(u32::MAX), nanosec in 0u32..1_000_000_000) {
            prop_assert_eq!(date_time_to_time(time_to_date_time(sec, nanosec)), (sec, nanosec / 100 * 100));
        }
    }
}
