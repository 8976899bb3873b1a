//! Timestamps in the notations of Wireshark and of the vectors.

/// Returns DateTime ticks, 100 ns since 1601, of "May 17, 2026 12:34:56.789012300 UTC" (Wireshark
/// 4.0) or of an ISO 8601 text in UTC.
pub(crate) fn ticks(text: &str) -> i64 {
    let words: Vec<&str> = text
        .split([' ', ',', '-', 'T', 'Z', ':', '.'])
        .filter(|word| !word.is_empty() && *word != "UTC" && *word != "UC")
        .collect();
    let month = MONTHS.iter().position(|name| words[0] == *name);
    let (year, month, day) = match month {
        Some(month) => (
            number(words[2]),
            i64::try_from(month).unwrap() + 1,
            number(words[1]),
        ),
        None => (number(words[0]), number(words[1]), number(words[2])),
    };
    let seconds = days(year, month, day) * 86_400
        + number(words[3]) * 3600
        + number(words[4]) * 60
        + number(words[5]);
    let fraction = words.get(6).copied().unwrap_or_default();
    seconds * 10_000_000 + number(&format!("{fraction:0<7}")[..7])
}

fn number(digits: &str) -> i64 {
    digits.parse().unwrap()
}

/// Returns the days since 1601-01-01, the first day of a cycle of 400 years.
fn days(year: i64, month: i64, day: i64) -> i64 {
    let past = year - 1601;
    let leap = year % 4 == 0 && (year % 100 != 0 || year % 400 == 0);
    let before = [0, 31, 59, 90, 120, 151, 181, 212, 243, 273, 304, 334];
    let month = usize::try_from(month).unwrap();
    past * 365 + past / 4 - past / 100
        + past / 400
        + before[month - 1]
        + i64::from(leap && month > 2)
        + day
        - 1
}

const MONTHS: [&str; 12] = [
    "Jan", "Feb", "Mar", "Apr", "May", "Jun", "Jul", "Aug", "Sep", "Oct", "Nov", "Dec",
];

#[test]
fn both_ways_to_write_a_time_are_read() {
    let time = 134_234_948_967_890_123;
    assert_eq!(ticks("May 17, 2026 12:34:56.789012300 UTC"), time);
    assert_eq!(ticks("2026-05-17T12:34:56.7890123Z"), time);
    assert_eq!(ticks("Jan  1, 1601 00:00:00.000000000 UTC"), 0);
}
