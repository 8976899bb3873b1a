//! Estimates the offset between the clocks of two hosts from the messages that both have received.
//!
//! Pure: all times are parameters. A message of the first host arrives at the second host after
//! its delay, so the difference of both times of arrival is the offset plus that delay. A message
//! of the second host gives the offset minus a delay. The smallest delays of both directions are
//! taken as equal; the offset is within half of their sum.

/// A message in the recordings of two hosts, in nanoseconds since 1970.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Twice {
    /// The time of arrival by the first clock.
    pub(super) at: i128,
    /// The time of arrival by the second clock minus that by the first clock.
    pub(super) difference: i128,
}

/// The second clock compared with the first.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Estimate {
    /// The time of the offset by the first clock, in nanoseconds since 1970.
    at: i128,
    /// The second clock minus the first, in nanoseconds.
    pub(super) offset: i128,
    /// The change of the offset in parts per million; `None` for a short time.
    pub(super) drift_ppm: Option<f64>,
    /// The largest error of the offset, in nanoseconds, if the directions differ entirely.
    pub(super) within: i128,
}

impl Estimate {
    /// Returns the offset of two equal clocks.
    pub(super) const fn none() -> Self {
        Self {
            at: 0,
            offset: 0,
            drift_ppm: None,
            within: 0,
        }
    }

    /// Returns the offset at a time of the first clock.
    #[expect(
        clippy::cast_precision_loss,
        clippy::cast_possible_truncation,
        reason = "the change within a recording is far below the precision"
    )]
    pub(super) fn at(&self, time: i128) -> i128 {
        let passed = (time - self.at) as f64;
        let change = passed * self.drift_ppm.unwrap_or(0.0) / 1e6;
        self.offset + change as i128
    }

    /// Returns a time of the second clock as a time of the first clock.
    pub(super) fn corrected(&self, time: i128) -> i128 {
        time - self.at(time - self.offset)
    }
}

/// The smallest delays of both directions within a part of the time, or of a request with its
/// response.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Exchange {
    /// The time of the offset by the first clock, in nanoseconds since 1970.
    pub(super) at: i128,
    /// The second clock minus the first, in nanoseconds.
    pub(super) offset: i128,
    /// Half of the sum of both delays.
    pub(super) half: i128,
}

/// Estimates the second clock from the messages of the first host (`forth`) and of the second host
/// (`back`). Returns `None` without messages of both within one window.
pub(super) fn estimate(forth: &[Twice], back: &[Twice]) -> Option<Estimate> {
    let times = || forth.iter().chain(back).map(|one| one.at);
    let (first, last) = (times().min()?, times().max()?);
    let width = ((last - first) / MOST_WINDOWS).max(NARROWEST);
    let mut windows = Vec::new();
    let number = |one: &Twice| (one.at - first) / width;
    let mut sorted = [forth.to_vec(), back.to_vec()];
    for all in &mut sorted {
        all.sort_unstable_by_key(|one| one.at);
    }
    let [forth, back] = &sorted;
    let (mut forth, mut back) = (forth.as_slice(), back.as_slice());
    for window in 0..=MOST_WINDOWS {
        let (of_forth, of_back);
        (of_forth, forth) = forth.split_at(forth.partition_point(|one| number(one) <= window));
        (of_back, back) = back.split_at(back.partition_point(|one| number(one) <= window));
        // The message with the smallest delay of each direction.
        let low = of_forth.iter().min_by_key(|one| one.difference);
        let high = of_back.iter().max_by_key(|one| one.difference);
        if let (Some(low), Some(high)) = (low, high) {
            windows.push(Exchange {
                at: i128::midpoint(low.at, high.at),
                offset: i128::midpoint(low.difference, high.difference),
                half: ((low.difference - high.difference) / 2).abs(),
            });
        }
    }
    fit(windows)
}

/// Estimates the second clock from exchanges in the order of their times. Returns `None` without
/// exchanges.
pub(super) fn fit(mut windows: Vec<Exchange>) -> Option<Estimate> {
    let within = windows.iter().map(|one| one.half).min()?;
    // Exchanges without an undisturbed message of both directions say little.
    windows.retain(|one| one.half <= within.saturating_mul(2) + TOLERANCE);
    let at = i128::midpoint(windows.first()?.at, windows.last()?.at);
    let drift_ppm = drift(&windows);
    let line = Estimate {
        at,
        offset: 0,
        drift_ppm,
        within,
    };
    let mut offsets: Vec<i128> = windows
        .iter()
        .map(|one| one.offset - line.at(one.at))
        .collect();
    Some(Estimate {
        offset: median(&mut offsets)?,
        ..line
    })
}

/// Returns the median slope of all pairs of windows, in parts per million.
#[expect(clippy::cast_precision_loss, reason = "a drift for people")]
fn drift(windows: &[Exchange]) -> Option<f64> {
    let mut slopes = Vec::new();
    for (at, one) in windows.iter().enumerate() {
        for other in windows.iter().skip(at + 1) {
            let passed = other.at - one.at;
            if passed >= SHORTEST {
                slopes.push((other.offset - one.offset) as f64 / passed as f64 * 1e6);
            }
        }
    }
    slopes.sort_unstable_by(f64::total_cmp);
    slopes.get(slopes.len() / 2).copied()
}

/// Returns the middle of the numbers.
pub(super) fn median(numbers: &mut [i128]) -> Option<i128> {
    numbers.sort_unstable();
    numbers.get(numbers.len() / 2).copied()
}

/// The offset changes within a window by 50 µs at a drift of 50 ppm.
const NARROWEST: i128 = 1_000_000_000;
const MOST_WINDOWS: i128 = 64;
/// The shortest time between two windows from which a drift follows.
const SHORTEST: i128 = 5_000_000_000;
const TOLERANCE: i128 = 50_000;

#[cfg(test)]
mod tests {
    use super::*;

    const START: i128 = 1_700_000_000_000_000_000;
    const MS: i128 = 1_000_000;

    /// Returns a delay of 0.2 ms and more, up to 20 ms for each seventh message.
    fn delay(number: i128) -> i128 {
        let noise = number * 7919 % 1000;
        match number % 7 {
            3 => 200_000 + noise * 20_000,
            _ => 200_000 + noise * 300,
        }
    }

    /// Returns messages of both hosts, each 50 ms, with the second clock shifted and drifting.
    fn messages(seconds: i128, shift: i128, ppm: i128) -> [Vec<Twice>; 2] {
        let clock = |time: i128| time + shift + time * ppm / 1_000_000;
        let (mut forth, mut back) = (Vec::new(), Vec::new());
        for number in 0..seconds * 20 {
            let sent = number * 50 * MS;
            forth.push(Twice {
                at: START + sent,
                difference: clock(sent + delay(number)) - sent,
            });
            let arrived = sent + delay(number + 5);
            back.push(Twice {
                at: START + arrived,
                difference: clock(sent) - arrived,
            });
        }
        [forth, back]
    }

    #[test]
    fn a_shift_of_three_seconds_with_a_drift_of_50_ppm_is_found_within_a_millisecond() {
        for (shift, ppm) in [
            (3_000 * MS, 50),
            (-3_000 * MS, -50),
            (0, 0),
            (3_000 * MS, 0),
        ] {
            for seconds in [10, 60, 600] {
                let [forth, back] = messages(seconds, shift, ppm);
                let found = estimate(&forth, &back).unwrap();
                for at in [0, seconds / 2, seconds] {
                    let at = at * 1_000 * MS;
                    let wanted = shift + at * ppm / 1_000_000;
                    let error = (found.at(START + at) - wanted).abs();
                    assert!(error < MS / 4, "{error} ns at {at}: {found:?}");
                }
                assert!(found.within < MS, "{found:?}");
                #[expect(clippy::cast_precision_loss, reason = "a small number")]
                let error = (found.drift_ppm.unwrap() - ppm as f64).abs();
                assert!(error < 15.0, "{found:?}");
            }
        }
    }

    #[test]
    fn requests_and_responses_give_the_offset_of_a_drifting_clock() {
        let exchanges = |count: i128| {
            let each = (0..count).map(|number| {
                let (there, back) = (delay(number), delay(number + 2));
                let sent = number * 500 * MS;
                let at = sent + (there + back) / 2;
                let clock = sent + there + 3_000 * MS + (sent + there) * 50 / 1_000_000;
                Exchange {
                    at: START + at,
                    offset: clock - at,
                    half: (there + back) / 2,
                }
            });
            each.collect::<Vec<_>>()
        };
        assert_eq!(fit(Vec::new()), None);
        for count in [1, 8, 120] {
            let found = fit(exchanges(count)).unwrap();
            let last = count * 500 * MS;
            let wanted = 3_000 * MS + last * 50 / 1_000_000;
            let error = (found.at(START + last) - wanted).abs();
            assert!(error < MS / 2, "{error} ns after {count}: {found:?}");
            assert!(found.within < MS, "{found:?}");
        }
    }

    #[test]
    fn one_direction_gives_no_offset() {
        let [forth, back] = messages(10, 0, 0);
        assert_eq!(estimate(&forth, &[]), None);
        assert_eq!(estimate(&[], &back), None);
        assert_eq!(estimate(&[], &[]), None);
    }

    #[test]
    fn a_short_time_gives_an_offset_without_a_drift() {
        let [forth, back] = messages(1, 5 * MS, 0);
        let found = estimate(&forth, &back).unwrap();
        assert_eq!(found.drift_ppm, None);
        assert!((found.offset - 5 * MS).abs() < MS / 4, "{found:?}");
    }
}
