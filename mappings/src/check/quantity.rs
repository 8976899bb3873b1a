//! Durations, and numbers within limits.

use std::ops::RangeInclusive;
use std::time::Duration;

use crate::code::Code;
use crate::findings::MappingFindings;
use crate::read::{OptionalKey, given, short};

/// Returns a number, unless it is out of range, which is noted.
pub(super) fn within(
    field: &OptionalKey<u16>,
    range: RangeInclusive<u16>,
    unit: &str,
    findings: &mut MappingFindings,
) -> Option<u16> {
    let (number, place) = given(field)?;
    if range.contains(number) {
        return Some(*number);
    }
    let message = format!("{number} {unit} are out of range");
    let (least, most) = range.into_inner();
    findings
        .error(Code::WrongValue, place, message)
        .label(format!("{least} to {most}"));
    None
}

const SHORTEST: Duration = Duration::from_millis(10);
const LONGEST: Duration = Duration::from_secs(3600);

/// Returns `None` for a faulty duration, which is noted.
pub(super) fn duration(
    field: &OptionalKey<String>,
    findings: &mut MappingFindings,
) -> Option<Duration> {
    let (text, place) = given(field)?;
    let duration = parse_duration(text);
    if duration.is_none() {
        let message = format!("`{}` is not a duration from 10ms to 1h", short(text));
        let note = findings.error(Code::Duration, place, message);
        note.help("give a number with its unit: 500ms, 1s, 2.5s, 1min");
    }
    duration
}

/// Reads a duration. Returns `None` also outside 10 ms to 1 h.
pub(super) fn parse_duration(text: &str) -> Option<Duration> {
    let unit = text.find(|c: char| c.is_ascii_alphabetic())?;
    let (number, unit) = text.split_at_checked(unit)?;
    let (whole, fraction) = number.split_once('.').unwrap_or((number, "0"));
    let digits =
        |text: &str| (1..=9).contains(&text.len()) && text.bytes().all(|b| b.is_ascii_digit());
    if !digits(whole) || !digits(fraction) {
        return None;
    }
    let unit_nanos: u64 = match unit {
        "ms" => 1_000_000,
        "s" => 1_000_000_000,
        "min" => 60_000_000_000,
        "h" => 3_600_000_000_000,
        _ => return None,
    };
    let scale = 10_u64.checked_pow(u32::try_from(fraction.len()).ok()?)?;
    let whole = whole.parse::<u64>().ok()?.checked_mul(unit_nanos)?;
    let fraction =
        u128::from(fraction.parse::<u64>().ok()?) * u128::from(unit_nanos) / u128::from(scale);
    let nanos = whole.checked_add(u64::try_from(fraction).ok()?)?;
    let duration = Duration::from_nanos(nanos);
    (SHORTEST..=LONGEST).contains(&duration).then_some(duration)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_duration_is_a_number_with_its_unit() {
        for (text, millis) in [
            ("500ms", 500),
            ("1s", 1000),
            ("2.5s", 2500),
            ("1min", 60_000),
            ("1h", 3_600_000),
            ("0.010s", 10),
            ("10ms", 10),
        ] {
            assert_eq!(
                parse_duration(text),
                Some(Duration::from_millis(millis)),
                "{text}"
            );
        }
        for text in [
            "",
            "1",
            "s",
            "1 s",
            "-1s",
            "+1s",
            "1.s",
            ".5s",
            "1e3s",
            "9ms",
            "3601s",
            "1.1h",
            "0s",
            "1d",
            "1.2.3s",
            "99999999999999999999s",
            "999999999h",
            "١s",
        ] {
            assert_eq!(parse_duration(text), None, "{text}");
        }
    }
}
