//! Aggregates of past values (OPC 10000-13, 5.4.3) as pure functions. Times are in ticks of 100 ns.

/// A past value as a number, with its quality.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct PastValue {
    pub(super) time: i64,
    /// The number, or `None` if the value is not a number.
    pub(super) value: Option<f64>,
    pub(super) quality: Quality,
}

/// The quality of a past value.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Quality {
    Good,
    Uncertain,
    Bad,
}

/// The supported aggregates.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Aggregate {
    Interpolative,
    Average,
    Minimum,
    Maximum,
    /// The minimum, at its own time.
    MinimumActualTime,
    /// The maximum, at its own time.
    MaximumActualTime,
    Count,
    /// The difference of the maximum and the minimum.
    Range,
    /// The first sample.
    Start,
    /// The last sample.
    End,
    /// The difference of the last and the first sample.
    Delta,
    /// The average over time.
    TimeAverage,
    /// The integral over time, in seconds.
    Total,
    /// The time with good values, in milliseconds.
    DurationGood,
    /// The share of that time, in percent.
    PercentGood,
    /// The worst status of a sample.
    WorstQuality,
}

/// The outcome of an interval.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum IntervalOutcome {
    /// The value of that sample, unchanged.
    Raw(usize),
    /// The value of that sample, at the time of the interval.
    Picked(usize, Quality),
    /// The value of that sample, at the time of the sample.
    Actual(usize, Quality),
    /// The status of that sample.
    Status(usize),
    /// A value calculated from several samples.
    Calculated(f64, Quality),
    /// A number of samples.
    Count(u32, Quality),
    /// A value between two samples, or after the last sample.
    Interpolated(f64, Quality),
    /// The value of the sample before, which is not a number.
    Held(usize),
    /// The interval has no data.
    NoData,
    /// The interval has data, but too much of it is bad.
    Bad,
}

/// The rules for the quality of an aggregate (AggregateConfiguration, OPC 10000-13, 4.2.1.2).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct AggregateRules {
    pub(super) uncertain_is_bad: bool,
    pub(super) percent_bad: u8,
    pub(super) percent_good: u8,
}

impl Default for AggregateRules {
    fn default() -> Self {
        Self {
            uncertain_is_bad: true,
            percent_bad: 100,
            percent_good: 100,
        }
    }
}

/// Returns the aggregate of the samples in an interval that includes `start` and excludes `end`.
/// `samples` ascend in time.
pub(super) fn of(
    aggregate: Aggregate,
    samples: &[PastValue],
    (start, end): (i64, i64),
    rules: AggregateRules,
) -> IntervalOutcome {
    if aggregate == Aggregate::Interpolative {
        return at(samples, start, rules);
    }
    let (from, to) = if start <= end {
        (start, end)
    } else {
        (end, start)
    };
    // The earlier bound is excluded in backward intervals, the later bound in forward intervals.
    let place = |bound: i64| {
        samples.partition_point(|sample| {
            if start <= end {
                sample.time < bound
            } else {
                sample.time <= bound
            }
        })
    };
    let (first, last) = (place(from), place(to));
    let within = samples.get(first..last).unwrap_or_default();
    let within: Vec<(usize, &PastValue)> = (first..).zip(within).collect();
    match aggregate {
        Aggregate::TimeAverage => average_over_time(samples, (from, to), rules).0,
        Aggregate::Total => {
            let (average, seconds) = average_over_time(samples, (from, to), rules);
            if let IntervalOutcome::Calculated(value, quality) = average {
                return IntervalOutcome::Calculated(value * seconds, quality);
            }
            average
        }
        Aggregate::DurationGood => {
            let good = time_good(samples, (from, to));
            IntervalOutcome::Calculated(good / TICKS_PER_MILLISECOND, Quality::Good)
        }
        Aggregate::PercentGood => {
            let good = time_good(samples, (from, to));
            let whole = length((from, to)).max(1.0);
            IntervalOutcome::Calculated(good * 100.0 / whole, Quality::Good)
        }
        Aggregate::WorstQuality => {
            let worst = within.iter().rev();
            let worst = worst.max_by_key(|(_, sample)| sample.quality.rank());
            worst.map_or(IntervalOutcome::NoData, |(at, _)| {
                IntervalOutcome::Status(*at)
            })
        }
        Aggregate::Start => within
            .first()
            .map_or(IntervalOutcome::NoData, |(at, _)| IntervalOutcome::Raw(*at)),
        Aggregate::End => within
            .last()
            .map_or(IntervalOutcome::NoData, |(at, _)| IntervalOutcome::Raw(*at)),
        Aggregate::Interpolative
        | Aggregate::Average
        | Aggregate::Minimum
        | Aggregate::Maximum
        | Aggregate::MinimumActualTime
        | Aggregate::MaximumActualTime
        | Aggregate::Count
        | Aggregate::Range
        | Aggregate::Delta => of_values(aggregate, (samples, &within), start, rules),
    }
}

/// Returns an aggregate of the values within an interval.
fn of_values(
    aggregate: Aggregate,
    (samples, within): (&[PastValue], &[(usize, &PastValue)]),
    start: i64,
    rules: AggregateRules,
) -> IntervalOutcome {
    let usable = |sample: &PastValue| rules.takes(sample.quality);
    let good: Vec<(usize, f64)> = within
        .iter()
        .filter(|(_, sample)| usable(sample))
        .filter_map(|(at, sample)| Some((*at, sample.value?)))
        .collect();
    let quality = rules.quality(within.iter().map(|(_, sample)| sample.quality));
    if aggregate == Aggregate::Count {
        let count = within.iter().filter(|(_, sample)| usable(sample)).count();
        let count = u32::try_from(count).unwrap_or(u32::MAX);
        return IntervalOutcome::Count(count, quality.unwrap_or(Quality::Good));
    }
    let Some(quality) = quality else {
        return IntervalOutcome::NoData;
    };
    let (Some(first), Some(last)) = (good.first(), good.last()) else {
        return IntervalOutcome::NoData;
    };
    if quality == Quality::Bad {
        return IntervalOutcome::Bad;
    }
    let order = |pair: &&(usize, f64), other: &&(usize, f64)| pair.1.total_cmp(&other.1);
    // The first of equal samples is used.
    let low = good.iter().min_by(order).unwrap_or(first);
    let high = good.iter().rev().max_by(order).unwrap_or(first);
    match aggregate {
        Aggregate::Minimum => picked(samples, low.0, (start, quality)),
        Aggregate::Maximum => picked(samples, high.0, (start, quality)),
        Aggregate::MinimumActualTime => actual(low.0, quality),
        Aggregate::MaximumActualTime => actual(high.0, quality),
        Aggregate::Range => IntervalOutcome::Calculated(high.1 - low.1, quality),
        Aggregate::Delta => {
            // Samples before the first and after the last number are bad.
            let ends = [within.first(), within.last()].map(|end| end.map(|(at, _)| *at));
            let quality = if ends == [Some(first.0), Some(last.0)] {
                Quality::Good
            } else {
                Quality::Uncertain
            };
            IntervalOutcome::Calculated(last.1 - first.1, quality)
        }
        Aggregate::Average
        | Aggregate::Interpolative
        | Aggregate::Count
        | Aggregate::Start
        | Aggregate::End
        | Aggregate::TimeAverage
        | Aggregate::Total
        | Aggregate::DurationGood
        | Aggregate::PercentGood
        | Aggregate::WorstQuality => {
            let sum: f64 = good.iter().map(|(_, value)| value).sum();
            let count = u32::try_from(good.len()).unwrap_or(u32::MAX);
            IntervalOutcome::Calculated(sum / f64::from(count), quality)
        }
    }
}

/// Returns the length of an interval in ticks.
fn length((from, to): (i64, i64)) -> f64 {
    to.saturating_sub(from) as f64
}

/// Returns the outcome for a selected sample at its own time.
fn actual(at: usize, quality: Quality) -> IntervalOutcome {
    match quality {
        Quality::Good => IntervalOutcome::Raw(at),
        Quality::Uncertain | Quality::Bad => IntervalOutcome::Actual(at, quality),
    }
}

/// Returns the average of the line through the samples (OPC 10000-13, 5.4.3.6), and the length of
/// the interval in seconds. The time before the first sample has no data, and the value after the
/// last sample is uncertain.
fn average_over_time(
    samples: &[PastValue],
    (from, to): (i64, i64),
    rules: AggregateRules,
) -> (IntervalOutcome, f64) {
    let whole = length((from, to));
    let seconds = whole / TICKS_PER_MILLISECOND / 1e3;
    let value_at = |time| {
        let outcome = at(samples, time, rules);
        if let IntervalOutcome::Interpolated(value, _) = outcome {
            return Some(value);
        }
        let IntervalOutcome::Raw(at) = outcome else {
            return None;
        };
        samples.get(at).and_then(|sample| sample.value)
    };
    let usable = |sample: &&PastValue| rules.takes(sample.quality) && sample.value.is_some();
    let inside = |(after, before): (i64, i64)| {
        let first = samples.partition_point(|one| one.time <= after);
        let last = samples.partition_point(|one| one.time < before);
        samples.get(first..last).unwrap_or_default()
    };
    let inner = inside((from, to)).iter();
    let mut points = vec![(from, value_at(from))];
    points.extend(inner.filter(usable).map(|one| (one.time, one.value)));
    points.push((to, value_at(to)));
    let last = samples.iter().rfind(usable).map(|sample| sample.time);
    let (mut area, mut good, mut bad) = (0.0, 0.0, 0.0);
    for (left, right) in points.iter().zip(points.iter().skip(1)) {
        let time = length((left.0, right.0));
        let (Some(low), Some(high)) = (left.1, right.1) else {
            bad += time;
            continue;
        };
        area += (low + high) / 2.0 * time;
        let mut between = inside((left.0, right.0)).iter();
        let skips = between.any(|one| !rules.takes(one.quality));
        let is_held = last.is_none_or(|last| last < right.0);
        if !is_held && !skips {
            good += time;
        }
    }
    let known = whole - bad;
    if known <= 0.0 {
        return (IntervalOutcome::NoData, seconds);
    }
    let quality = if bad > 0.0 && bad * 100.0 >= whole * f64::from(rules.percent_bad) {
        return (IntervalOutcome::Bad, seconds);
    } else if good * 100.0 >= whole * f64::from(rules.percent_good) {
        Quality::Good
    } else {
        Quality::Uncertain
    };
    (IntervalOutcome::Calculated(area / known, quality), seconds)
}

/// Returns the time with good values, in ticks. Each value counts until the next value (OPC
/// 10000-13, 5.4.3.22). The start of the interval has a good value between two good samples only.
fn time_good(samples: &[PastValue], (from, to): (i64, i64)) -> f64 {
    let mut good = 0.0;
    let first = samples.partition_point(|one| one.time <= from);
    let end = samples.partition_point(|one| one.time < to);
    let samples = samples
        .get(first.saturating_sub(1)..end)
        .unwrap_or_default();
    let nexts = samples.iter().skip(1).map(|next| next.time);
    let is_good =
        |sample: Option<&PastValue>| sample.is_none_or(|one| one.quality == Quality::Good);
    for (place, (sample, next)) in samples.iter().zip(nexts.chain([i64::MAX])).enumerate() {
        let (begin, end) = (sample.time.max(from), next.min(to));
        let follower = samples.get(place + 1).filter(|_| sample.time < from);
        if is_good(Some(sample)) && is_good(follower) && end > begin {
            good += length((begin, end));
        }
    }
    good
}

/// Ticks of 100 ns.
const TICKS_PER_MILLISECOND: f64 = 1e4;

/// Returns the outcome for a selected sample: the raw value if the sample is good and at the start
/// of the interval.
fn picked(samples: &[PastValue], at: usize, (start, quality): (i64, Quality)) -> IntervalOutcome {
    match samples.get(at) {
        Some(sample) if sample.time == start && quality == Quality::Good => {
            IntervalOutcome::Raw(at)
        }
        Some(_) | None => IntervalOutcome::Picked(at, quality),
    }
}

/// Returns the value at a time (OPC 10000-13, 5.4.3.4): the sample at that time, or the
/// interpolation between its neighbours. After the last sample its value is held. Values that are
/// not numbers are held too.
pub(super) fn at(samples: &[PastValue], time: i64, rules: AggregateRules) -> IntervalOutcome {
    let usable = |sample: &PastValue| rules.takes(sample.quality);
    let behind = samples.partition_point(|sample| sample.time <= time);
    let (before, after) = samples.split_at(behind.min(samples.len()));
    let then = before.iter().enumerate().rev();
    let mut then = then.take_while(|(_, sample)| sample.time == time);
    if let Some((exact, _)) = then.find(|(_, sample)| usable(sample)) {
        return IntervalOutcome::Raw(exact);
    }
    let Some(last) = before.iter().rposition(usable) else {
        return IntervalOutcome::NoData;
    };
    let first = after.iter().find(|sample| usable(sample));
    let Some(low) = before.get(last) else {
        return IntervalOutcome::NoData;
    };
    let Some(from) = low.value else {
        return IntervalOutcome::Held(last);
    };
    // Bad samples in between, and uncertain samples at the ends, make the value uncertain.
    let skipped = before.len() - 1 != last || after.first() != first;
    let ends = [Some(low), first];
    let doubtful = ends
        .iter()
        .flatten()
        .any(|end| end.quality != Quality::Good);
    match first {
        Some(PastValue {
            time: next,
            value: Some(to),
            ..
        }) => {
            let whole = (next - low.time).max(1);
            let part = (time - low.time) as f64 / whole as f64;
            let quality = if skipped || doubtful {
                Quality::Uncertain
            } else {
                Quality::Good
            };
            IntervalOutcome::Interpolated(from + (to - from) * part, quality)
        }
        Some(_) => IntervalOutcome::Held(last),
        None => IntervalOutcome::Interpolated(from, Quality::Uncertain),
    }
}

impl Quality {
    /// Returns a number that is higher for worse qualities.
    const fn rank(self) -> u8 {
        match self {
            Self::Good => 0,
            Self::Uncertain => 1,
            Self::Bad => 2,
        }
    }
}

impl AggregateRules {
    const fn takes(self, quality: Quality) -> bool {
        match quality {
            Quality::Good => true,
            Quality::Uncertain => !self.uncertain_is_bad,
            Quality::Bad => false,
        }
    }

    /// Returns the quality of an interval by the shares of good and bad samples, or `None` for an
    /// interval without samples.
    fn quality(self, all: impl Iterator<Item = Quality>) -> Option<Quality> {
        let (mut good, mut bad) = (0_u64, 0_u64);
        for quality in all {
            if self.takes(quality) {
                good += 1
            } else {
                bad += 1
            }
        }
        let all = good + bad;
        if all == 0 {
            return None;
        }
        Some(
            if bad * 100 >= all * u64::from(self.percent_bad) && bad > 0 {
                Quality::Bad
            } else if good * 100 >= all * u64::from(self.percent_good) {
                Quality::Good
            } else {
                Quality::Uncertain
            },
        )
    }
}

#[cfg(test)]
mod examples;

#[cfg(test)]
mod tests {
    use super::*;

    fn sample(time: i64, value: f64) -> PastValue {
        PastValue {
            time,
            value: Some(value),
            quality: Quality::Good,
        }
    }

    fn samples() -> Vec<PastValue> {
        vec![
            sample(10, 1.0),
            sample(20, 5.0),
            sample(30, 3.0),
            sample(40, 9.0),
        ]
    }

    fn of_all(
        aggregate: Aggregate,
        samples: &[PastValue],
        interval: (i64, i64),
    ) -> IntervalOutcome {
        of(aggregate, samples, interval, AggregateRules::default())
    }

    #[test]
    fn an_interval_has_its_start_and_not_its_end() {
        let all = samples();
        let average = of_all(Aggregate::Average, &all, (10, 30));
        assert_eq!(average, IntervalOutcome::Calculated(3.0, Quality::Good));
        let back = of_all(Aggregate::Average, &all, (40, 20));
        assert_eq!(back, IntervalOutcome::Calculated(6.0, Quality::Good));
        assert_eq!(
            of_all(Aggregate::Count, &all, (10, 40)),
            IntervalOutcome::Count(3, Quality::Good)
        );
        assert_eq!(
            of_all(Aggregate::Count, &all, (50, 60)),
            IntervalOutcome::Count(0, Quality::Good)
        );
        assert_eq!(
            of_all(Aggregate::Average, &all, (50, 60)),
            IntervalOutcome::NoData
        );
    }

    #[test]
    fn the_least_and_the_greatest_are_samples_and_raw_where_they_stand_at_the_start() {
        let all = samples();
        assert_eq!(
            of_all(Aggregate::Minimum, &all, (10, 40)),
            IntervalOutcome::Raw(0)
        );
        assert_eq!(
            of_all(Aggregate::Maximum, &all, (10, 40)),
            IntervalOutcome::Picked(1, Quality::Good)
        );
    }

    #[test]
    fn between_samples_the_value_lies_on_the_line_and_behind_the_last_it_is_held() {
        let all = samples();
        let rules = AggregateRules::default();
        assert_eq!(
            at(&all, 15, rules),
            IntervalOutcome::Interpolated(3.0, Quality::Good)
        );
        assert_eq!(at(&all, 20, rules), IntervalOutcome::Raw(1));
        assert_eq!(
            at(&all, 50, rules),
            IntervalOutcome::Interpolated(9.0, Quality::Uncertain)
        );
        assert_eq!(at(&all, 5, rules), IntervalOutcome::NoData);
    }

    #[test]
    fn what_is_bad_counts_for_nothing_and_leaves_a_doubt() {
        let mut all = samples();
        all[1].quality = Quality::Bad;
        let average = of_all(Aggregate::Average, &all, (10, 50));
        assert_eq!(
            average,
            IntervalOutcome::Calculated(13.0 / 3.0, Quality::Uncertain)
        );
        assert_eq!(
            at(&all, 15, AggregateRules::default()),
            IntervalOutcome::Interpolated(1.5, Quality::Uncertain)
        );
        assert_eq!(
            of_all(Aggregate::Average, &all, (20, 30)),
            IntervalOutcome::NoData
        );
        all[1].quality = Quality::Uncertain;
        let lenient = AggregateRules {
            uncertain_is_bad: false,
            ..AggregateRules::default()
        };
        assert_eq!(
            of(Aggregate::Average, &all, (20, 30), lenient),
            IntervalOutcome::Calculated(5.0, Quality::Good)
        );
    }

    #[test]
    fn the_first_and_the_last_sample_and_their_difference() {
        let mut all = samples();
        assert_eq!(
            of_all(Aggregate::Start, &all, (15, 45)),
            IntervalOutcome::Raw(1)
        );
        assert_eq!(
            of_all(Aggregate::End, &all, (15, 40)),
            IntervalOutcome::Raw(2)
        );
        assert_eq!(
            of_all(Aggregate::Start, &all, (50, 60)),
            IntervalOutcome::NoData
        );
        assert_eq!(
            of_all(Aggregate::Delta, &all, (10, 50)),
            IntervalOutcome::Calculated(8.0, Quality::Good)
        );
        all[3].quality = Quality::Bad;
        assert_eq!(
            of_all(Aggregate::Delta, &all, (10, 50)),
            IntervalOutcome::Calculated(2.0, Quality::Uncertain),
            "without the last sample"
        );
        assert_eq!(
            of_all(Aggregate::Range, &all, (10, 40)),
            IntervalOutcome::Calculated(4.0, Quality::Good)
        );
        assert_eq!(
            of_all(Aggregate::WorstQuality, &all, (10, 50)),
            IntervalOutcome::Status(3)
        );
        assert_eq!(
            of_all(Aggregate::WorstQuality, &all, (10, 40)),
            IntervalOutcome::Status(0)
        );
    }

    #[test]
    fn extremes_have_their_own_time_on_request() {
        let mut all = samples();
        assert_eq!(
            of_all(Aggregate::MaximumActualTime, &all, (10, 40)),
            IntervalOutcome::Raw(1)
        );
        all[0].quality = Quality::Bad;
        assert_eq!(
            of_all(Aggregate::MinimumActualTime, &all, (10, 40)),
            IntervalOutcome::Actual(2, Quality::Uncertain)
        );
    }

    #[test]
    fn the_average_over_time_is_the_area_below_the_line() {
        let all = samples();
        // The line from 1 to 5, to 3 and to 9: areas of 30, 40 and 60.
        let whole = of_all(Aggregate::TimeAverage, &all, (10, 40));
        assert_eq!(
            whole,
            IntervalOutcome::Calculated(130.0 / 30.0, Quality::Good)
        );
        let half = of_all(Aggregate::TimeAverage, &all, (15, 20));
        assert_eq!(half, IntervalOutcome::Calculated(4.0, Quality::Good));
        let held = of_all(Aggregate::TimeAverage, &all, (40, 50));
        assert_eq!(held, IntervalOutcome::Calculated(9.0, Quality::Uncertain));
        let before = of_all(Aggregate::TimeAverage, &all, (0, 5));
        assert_eq!(before, IntervalOutcome::NoData);
        // Half of this interval is before the first sample.
        let partly = of_all(Aggregate::TimeAverage, &all, (5, 15));
        assert_eq!(partly, IntervalOutcome::Calculated(2.0, Quality::Uncertain));
        let seconds: Vec<PastValue> = [0, 1].map(|at| sample(at * 10_000_000, 3.0)).to_vec();
        let total = of_all(Aggregate::Total, &seconds, (0, 10_000_000));
        assert_eq!(total, IntervalOutcome::Calculated(3.0, Quality::Good));
    }

    #[test]
    fn a_value_is_good_until_the_next_value() {
        let mut all: Vec<PastValue> = (0..4).map(|at| sample(at * 10_000, 1.0)).collect();
        all[1].quality = Quality::Bad;
        all[2].quality = Quality::Uncertain;
        let interval = (-10_000, 40_000);
        assert_eq!(
            of_all(Aggregate::DurationGood, &all, interval),
            IntervalOutcome::Calculated(2.0, Quality::Good),
            "in milliseconds"
        );
        assert_eq!(
            of_all(Aggregate::PercentGood, &all, interval),
            IntervalOutcome::Calculated(40.0, Quality::Good)
        );
    }

    #[test]
    fn texts_are_held() {
        let text = PastValue {
            time: 10,
            value: None,
            quality: Quality::Good,
        };
        let all = [text, PastValue { time: 20, ..text }];
        assert_eq!(
            at(&all, 15, AggregateRules::default()),
            IntervalOutcome::Held(0)
        );
    }
}
