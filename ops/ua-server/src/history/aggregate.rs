//! Aggregates of past values (OPC 10000-13, 5.4.3) as pure functions. Times are in ticks of 100 ns.

/// A past value as a number, with its quality.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Sample {
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
    Count,
}

/// The outcome of an interval.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Outcome {
    /// The value of that sample, unchanged.
    Raw(usize),
    /// The value of that sample, at the time of the interval.
    Picked(usize, Quality),
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
pub(super) struct Rules {
    pub(super) uncertain_is_bad: bool,
    pub(super) percent_bad: u8,
    pub(super) percent_good: u8,
}

impl Default for Rules {
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
    samples: &[Sample],
    (start, end): (i64, i64),
    rules: Rules,
) -> Outcome {
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
        samples.partition_point(|sample| match start <= end {
            true => sample.time < bound,
            false => sample.time <= bound,
        })
    };
    let (first, last) = (place(from), place(to));
    let within = samples.get(first..last).unwrap_or_default();
    let within: Vec<(usize, &Sample)> = (first..).zip(within).collect();
    let usable = |sample: &Sample| rules.takes(sample.quality);
    let good: Vec<(usize, f64)> = within
        .iter()
        .filter(|(_, sample)| usable(sample))
        .filter_map(|(at, sample)| Some((*at, sample.value?)))
        .collect();
    let quality = rules.quality(within.iter().map(|(_, sample)| sample.quality));
    if aggregate == Aggregate::Count {
        let count = within.iter().filter(|(_, sample)| usable(sample)).count();
        let count = u32::try_from(count).unwrap_or(u32::MAX);
        return Outcome::Count(count, quality.unwrap_or(Quality::Good));
    }
    let Some(quality) = quality else {
        return Outcome::NoData;
    };
    if quality == Quality::Bad || good.is_empty() {
        return Outcome::Bad;
    }
    let least = |pair: &(usize, f64), other: &(usize, f64)| pair.1.total_cmp(&other.1);
    match aggregate {
        Aggregate::Minimum => {
            let found = good.iter().copied().min_by(least);
            found.map_or(Outcome::NoData, |(at, _)| {
                picked(samples, at, (start, quality))
            })
        }
        Aggregate::Maximum => {
            // The first of equal samples is used.
            let found = good.iter().copied().rev().max_by(least);
            found.map_or(Outcome::NoData, |(at, _)| {
                picked(samples, at, (start, quality))
            })
        }
        Aggregate::Average => {
            let sum: f64 = good.iter().map(|(_, value)| value).sum();
            let count = u32::try_from(good.len()).unwrap_or(u32::MAX);
            Outcome::Calculated(sum / f64::from(count), quality)
        }
        Aggregate::Interpolative | Aggregate::Count => Outcome::NoData,
    }
}

/// Returns the outcome for a selected sample: the raw value if the sample is good and at the start
/// of the interval.
fn picked(samples: &[Sample], at: usize, (start, quality): (i64, Quality)) -> Outcome {
    match samples.get(at) {
        Some(sample) if sample.time == start && quality == Quality::Good => Outcome::Raw(at),
        Some(_) | None => Outcome::Picked(at, quality),
    }
}

/// Returns the value at a time (OPC 10000-13, 5.4.3.4): the sample at that time, or the
/// interpolation between its neighbours. After the last sample its value is held. Values that are
/// not numbers are held too.
pub(super) fn at(samples: &[Sample], time: i64, rules: Rules) -> Outcome {
    let usable = |sample: &Sample| rules.takes(sample.quality);
    let behind = samples.partition_point(|sample| sample.time <= time);
    let (before, after) = samples.split_at(behind.min(samples.len()));
    let then = before.iter().enumerate().rev();
    let mut then = then.take_while(|(_, sample)| sample.time == time);
    if let Some((exact, _)) = then.find(|(_, sample)| usable(sample)) {
        return Outcome::Raw(exact);
    }
    let Some(last) = before.iter().rposition(usable) else {
        return Outcome::NoData;
    };
    let first = after.iter().find(|sample| usable(sample));
    let Some(low) = before.get(last) else {
        return Outcome::NoData;
    };
    let Some(from) = low.value else {
        return Outcome::Held(last);
    };
    // Bad samples in between make the value uncertain.
    let skipped = before.len() - 1 != last || after.first() != first;
    match first {
        Some(Sample {
            time: next,
            value: Some(to),
            ..
        }) => {
            let whole = (next - low.time).max(1);
            let part = (time - low.time) as f64 / whole as f64;
            let quality = match skipped {
                true => Quality::Uncertain,
                false => Quality::Good,
            };
            Outcome::Interpolated(from + (to - from) * part, quality)
        }
        Some(_) => Outcome::Held(last),
        None => Outcome::Interpolated(from, Quality::Uncertain),
    }
}

impl Rules {
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
            match self.takes(quality) {
                true => good += 1,
                false => bad += 1,
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
mod tests {
    use super::*;

    fn sample(time: i64, value: f64) -> Sample {
        Sample {
            time,
            value: Some(value),
            quality: Quality::Good,
        }
    }

    fn samples() -> Vec<Sample> {
        vec![
            sample(10, 1.0),
            sample(20, 5.0),
            sample(30, 3.0),
            sample(40, 9.0),
        ]
    }

    fn of_all(aggregate: Aggregate, samples: &[Sample], interval: (i64, i64)) -> Outcome {
        of(aggregate, samples, interval, Rules::default())
    }

    #[test]
    fn an_interval_has_its_start_and_not_its_end() {
        let all = samples();
        let average = of_all(Aggregate::Average, &all, (10, 30));
        assert_eq!(average, Outcome::Calculated(3.0, Quality::Good));
        let back = of_all(Aggregate::Average, &all, (40, 20));
        assert_eq!(back, Outcome::Calculated(6.0, Quality::Good));
        assert_eq!(
            of_all(Aggregate::Count, &all, (10, 40)),
            Outcome::Count(3, Quality::Good)
        );
        assert_eq!(
            of_all(Aggregate::Count, &all, (50, 60)),
            Outcome::Count(0, Quality::Good)
        );
        assert_eq!(of_all(Aggregate::Average, &all, (50, 60)), Outcome::NoData);
    }

    #[test]
    fn the_least_and_the_greatest_are_samples_and_raw_where_they_stand_at_the_start() {
        let all = samples();
        assert_eq!(of_all(Aggregate::Minimum, &all, (10, 40)), Outcome::Raw(0));
        assert_eq!(
            of_all(Aggregate::Maximum, &all, (10, 40)),
            Outcome::Picked(1, Quality::Good)
        );
    }

    #[test]
    fn between_samples_the_value_lies_on_the_line_and_behind_the_last_it_is_held() {
        let all = samples();
        let rules = Rules::default();
        assert_eq!(
            at(&all, 15, rules),
            Outcome::Interpolated(3.0, Quality::Good)
        );
        assert_eq!(at(&all, 20, rules), Outcome::Raw(1));
        assert_eq!(
            at(&all, 50, rules),
            Outcome::Interpolated(9.0, Quality::Uncertain)
        );
        assert_eq!(at(&all, 5, rules), Outcome::NoData);
    }

    #[test]
    fn what_is_bad_counts_for_nothing_and_leaves_a_doubt() {
        let mut all = samples();
        all[1].quality = Quality::Bad;
        let average = of_all(Aggregate::Average, &all, (10, 50));
        assert_eq!(average, Outcome::Calculated(13.0 / 3.0, Quality::Uncertain));
        assert_eq!(
            at(&all, 15, Rules::default()),
            Outcome::Interpolated(1.5, Quality::Uncertain)
        );
        assert_eq!(of_all(Aggregate::Average, &all, (20, 30)), Outcome::Bad);
        all[1].quality = Quality::Uncertain;
        let lenient = Rules {
            uncertain_is_bad: false,
            ..Rules::default()
        };
        assert_eq!(
            of(Aggregate::Average, &all, (20, 30), lenient),
            Outcome::Calculated(5.0, Quality::Good)
        );
    }

    #[test]
    fn texts_are_held() {
        let text = Sample {
            time: 10,
            value: None,
            quality: Quality::Good,
        };
        let all = [text, Sample { time: 20, ..text }];
        assert_eq!(at(&all, 15, Rules::default()), Outcome::Held(0));
    }
}
