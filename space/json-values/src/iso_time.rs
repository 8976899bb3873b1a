//! Formats and parses times as ISO 8601 text.

use uadp::DateTime;

/// Formats a DateTime with as many digits as needed: `2026-05-17T12:34:56.789Z`. Years beyond four
/// digits have a sign.
#[must_use]
pub fn of_date_time(time: DateTime) -> String {
    let seconds = time.0.div_euclid(TICKS_PER_SECOND) - UNIX_EPOCH_SECONDS;
    let ticks = time.0.rem_euclid(TICKS_PER_SECOND);
    let fraction = format!("{ticks:07}");
    let fraction = fraction.trim_end_matches('0');
    let point = if fraction.is_empty() { "" } else { "." };
    format!("{}{point}{fraction}Z", of_seconds(seconds))
}

/// Formats nanoseconds since 1970-01-01 UTC, with all nine digits.
#[must_use]
pub fn of_unix_nanos(nanos: i128) -> String {
    let seconds = i64::try_from(nanos.div_euclid(1_000_000_000)).unwrap_or_default();
    format!(
        "{}.{:09}Z",
        of_seconds(seconds),
        nanos.rem_euclid(1_000_000_000)
    )
}

/// Parses a DateTime; `None` if the text is not a time or the time is out of range.
#[must_use]
pub fn parse(text: &str) -> Option<DateTime> {
    let (date, time) = text.strip_suffix('Z')?.split_once('T')?;
    // The first sign belongs to the year.
    let (year, rest) = date.split_at_checked(date.get(1..)?.find('-')? + 1)?;
    let (month, day) = rest.strip_prefix('-')?.split_once('-')?;
    let (time, fraction) = time.split_once('.').unwrap_or((time, "0"));
    let mut clock = time.split(':').map(|part| two_digits(part, 0, 59));
    let (hour, minute, second) = (clock.next()??, clock.next()??, clock.next()??);
    let known = clock.next().is_none() && hour < 24 && fraction.len() <= 7;
    let digits = fraction.bytes().all(|byte| byte.is_ascii_digit());
    if !known || !digits {
        return None;
    }
    let days = days_from_1970(
        year.parse().ok()?,
        two_digits(month, 1, 12)?,
        two_digits(day, 1, 31)?,
    )?;
    let seconds = days * SECONDS_PER_DAY + (hour * 60 + minute) * 60 + second + UNIX_EPOCH_SECONDS;
    let ticks: i64 = format!("{fraction:0<7}").parse().ok()?;
    let ticks = i128::from(seconds) * i128::from(TICKS_PER_SECOND) + i128::from(ticks);
    i64::try_from(ticks).ok().map(DateTime)
}

fn two_digits(text: &str, least: i64, most: i64) -> Option<i64> {
    let number = text.parse().ok()?;
    (text.len() == 2 && (least..=most).contains(&number)).then_some(number)
}

fn of_seconds(seconds: i64) -> String {
    let (year, month, day) = date(seconds.div_euclid(SECONDS_PER_DAY));
    let second = seconds.rem_euclid(SECONDS_PER_DAY);
    let year = match year {
        0..=9999 => format!("{year:04}"),
        _ => format!("{year:+07}"),
    };
    let (hour, minute, second) = (second / 3600, second / 60 % 60, second % 60);
    format!("{year}-{month:02}-{day:02}T{hour:02}:{minute:02}:{second:02}")
}

/// Returns the days from 1970-01-01 to a day of the Gregorian calendar; `None` if the month does
/// not have the day.
fn days_from_1970(year: i64, month: i64, day: i64) -> Option<i64> {
    if year.abs() > 100_000 {
        return None;
    }
    let days = days_of(year, month, day);
    (date(days) == (year, month, day)).then_some(days)
}

/// Like [`days_from_1970`], but a day beyond the end of the month counts into the next month.
fn days_of(year: i64, month: i64, day: i64) -> i64 {
    // Years counted from March end with the leap day.
    let (year, month) = match month {
        1 | 2 => (year - 1, month + 9),
        _ => (year, month - 3),
    };
    let leap_days = year.div_euclid(4) - year.div_euclid(100) + year.div_euclid(400);
    let before_month = (153 * month + 2) / 5;
    year * 365 + leap_days + before_month + day - 1 - MARCH_0000_TO_1970
}

/// Returns year, month and day of a day counted from 1970-01-01.
fn date(days: i64) -> (i64, i64, i64) {
    // The estimate is at most a year off; then the latest year that starts on or before the day is
    // chosen.
    let guess = 1970 + (days * 400).div_euclid(DAYS_IN_400_YEARS);
    let late = |year: &i64| days_of(*year, 1, 1) > days;
    let year = [guess + 1, guess, guess - 1]
        .into_iter()
        .find(|year| !late(year))
        .unwrap_or(guess - 1);
    let month = (1..=12)
        .rev()
        .find(|month| days_of(year, *month, 1) <= days)
        .unwrap_or(1);
    (year, month, days - days_of(year, month, 1) + 1)
}

const TICKS_PER_SECOND: i64 = 10_000_000;
const SECONDS_PER_DAY: i64 = 86_400;
/// Seconds from 1601-01-01 to 1970-01-01.
const UNIX_EPOCH_SECONDS: i64 = 11_644_473_600;
const DAYS_IN_400_YEARS: i64 = 146_097;
const MARCH_0000_TO_1970: i64 = 719_468;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn known_times_have_their_text() {
        for (ticks, text) in [
            (0, "1601-01-01T00:00:00Z"),
            (134_234_948_967_890_123, "2026-05-17T12:34:56.7890123Z"),
            (134_234_948_967_890_000, "2026-05-17T12:34:56.789Z"),
            (-1, "1600-12-31T23:59:59.9999999Z"),
            (-504_911_232_000_000_001, "0000-12-31T23:59:59.9999999Z"),
        ] {
            assert_eq!(of_date_time(DateTime(ticks)), text);
            assert_eq!(parse(text), Some(DateTime(ticks)));
        }
        assert_eq!(
            of_unix_nanos(1_779_021_296_789_012_345),
            "2026-05-17T12:34:56.789012345Z"
        );
    }

    #[test]
    fn every_date_time_survives_its_text() {
        let step = i64::MAX / 5_000;
        let many = (-4_999..5_000).map(|n: i64| n * step + n);
        for ticks in many.chain([i64::MIN, i64::MAX]) {
            let text = of_date_time(DateTime(ticks));
            assert_eq!(parse(&text), Some(DateTime(ticks)), "{text}");
        }
    }

    #[test]
    fn leap_days_are_where_the_calendar_has_them() {
        for text in ["2000-02-29T00:00:00Z", "2024-02-29T00:00:00Z"] {
            assert_eq!(parse(text).map(of_date_time).as_deref(), Some(text));
        }
        for text in [
            "1900-02-29T00:00:00Z",
            "2026-02-29T00:00:00Z",
            "2026-04-31T00:00:00Z",
        ] {
            assert_eq!(parse(text), None, "{text}");
        }
    }

    #[test]
    fn what_is_no_time_is_refused() {
        for text in [
            "",
            "Z",
            "2026-05-17",
            "2026-05-17T12:34Z",
            "2026-05-17T24:00:00Z",
            "2026-5-17T12:34:56Z",
            "2026-13-17T12:34:56Z",
            "2026-05-17T12:34:56.12345678Z",
            "2026-05-17T12:34:56.x",
            "2026-05-17T12:34:56+01:00",
            "+100000-01-01T00:00:00Z",
        ] {
            assert_eq!(parse(text), None, "{text}");
        }
    }
}
