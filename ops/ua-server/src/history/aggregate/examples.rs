//! The published examples of OPC 10000-13, Annex A: two historians with a point that is created at
//! 12:00:00. Times are seconds after that. The rows beyond the last value are left out, and so is
//! the mark of the creation where an example does not count it.

use super::*;

const SECOND: i64 = 10_000_000;

fn samples(values: &[(i64, Option<f64>, Quality)]) -> Vec<PastValue> {
    let samples = values.iter().map(|(second, value, quality)| PastValue {
        time: second * SECOND,
        value: *value,
        quality: *quality,
    });
    samples.collect()
}

/// A value every 10 s (A.1.1).
fn periodic() -> Vec<PastValue> {
    let mut values = vec![(0, None, Quality::Bad)];
    for tens in 1..=9 {
        let quality = match tens {
            4 => Quality::Bad,
            7 => Quality::Uncertain,
            _ => Quality::Good,
        };
        values.push((10 * tens, Some(10.0 * tens as f64), quality));
    }
    samples(&values)
}

/// Values at irregular times (A.1.2).
fn irregular() -> Vec<PastValue> {
    samples(&[
        (0, None, Quality::Bad),
        (2, Some(10.0), Quality::Good),
        (25, Some(20.0), Quality::Good),
        (28, Some(25.0), Quality::Good),
        (39, Some(30.0), Quality::Good),
        (42, None, Quality::Bad),
        (48, Some(40.0), Quality::Good),
        (52, Some(50.0), Quality::Good),
        (72, Some(60.0), Quality::Good),
        (77, Some(70.0), Quality::Uncertain),
        (83, Some(70.0), Quality::Good),
        (86, Some(80.0), Quality::Good),
        (90, Some(90.0), Quality::Good),
    ])
}

/// The rules of the first historian: uncertain values are used.
fn lenient() -> AggregateRules {
    AggregateRules {
        uncertain_is_bad: false,
        ..AggregateRules::default()
    }
}

/// An expected value: G is Good, U is `UncertainDataSubNormal`.
#[derive(Debug, Clone, Copy)]
enum Row {
    NoData,
    G(f64),
    U(f64),
}

use Row::{G, NoData, U};

/// Asserts the values of intervals of that many seconds, from 12:00:00.
fn assert_rows(
    aggregate: Aggregate,
    all: &[PastValue],
    (rules, step): (AggregateRules, i64),
    rows: &[Row],
) {
    for (row, start) in rows.iter().zip((0..).map(|row: i64| row * step)) {
        let interval = (start * SECOND, (start + step) * SECOND);
        let (value, quality) = match of(aggregate, all, interval, rules) {
            IntervalOutcome::Raw(at) | IntervalOutcome::Held(at) => {
                let sample = all.get(at).unwrap();
                (sample.value, sample.quality)
            }
            IntervalOutcome::Picked(at, quality) | IntervalOutcome::Actual(at, quality) => {
                (all.get(at).unwrap().value, quality)
            }
            IntervalOutcome::Calculated(value, quality)
            | IntervalOutcome::Interpolated(value, quality) => (Some(value), quality),
            IntervalOutcome::Count(count, quality) => (Some(f64::from(count)), quality),
            IntervalOutcome::Status(_) | IntervalOutcome::NoData | IntervalOutcome::Bad => {
                (None, Quality::Bad)
            }
        };
        let wanted = match row {
            NoData => (None, Quality::Bad),
            G(value) => (Some(*value), Quality::Good),
            U(value) => (Some(*value), Quality::Uncertain),
        };
        let is_near = match (value, wanted.0) {
            (Some(value), Some(wanted)) => (value - wanted).abs() < 0.001,
            (value, wanted) => value == wanted,
        };
        assert!(
            is_near && quality == wanted.1,
            "{aggregate:?} at {start} s is {value:?} {quality:?}, not {row:?}"
        );
    }
}

#[test]
fn interpolative_of_the_published_examples() {
    let every_five = (lenient(), 5);
    let rows = [
        NoData,
        NoData,
        G(10.0),
        G(15.0),
        G(20.0),
        G(25.0),
        G(30.0),
        U(35.0),
        U(40.0),
        U(45.0),
        G(50.0),
        G(55.0),
        G(60.0),
        U(65.0),
        U(70.0),
        U(75.0),
        G(80.0),
        G(85.0),
        G(90.0),
        U(90.0),
    ];
    assert_rows(Aggregate::Interpolative, &periodic(), every_five, &rows);
    let rows = [
        NoData,
        G(11.304),
        G(13.478),
        G(15.652),
        G(17.826),
        G(20.0),
        G(25.909),
        G(28.182),
        U(31.111),
        U(36.667),
        G(45.0),
        G(51.5),
        G(54.0),
        G(56.5),
        G(59.0),
        U(62.727),
        U(67.273),
        G(76.667),
        G(90.0),
        U(90.0),
    ];
    let every_five = (AggregateRules::default(), 5);
    assert_rows(Aggregate::Interpolative, &irregular(), every_five, &rows);
}

#[test]
fn average_of_the_published_examples() {
    let rows = [
        G(10.0),
        NoData,
        NoData,
        NoData,
        NoData,
        G(22.5),
        NoData,
        G(30.0),
        NoData,
        G(40.0),
        G(50.0),
        NoData,
        NoData,
        NoData,
        G(60.0),
        NoData,
        G(70.0),
        G(80.0),
        G(90.0),
        NoData,
    ];
    let every_five = (AggregateRules::default(), 5);
    assert_rows(Aggregate::Average, &irregular()[1..], every_five, &rows);
}

#[test]
fn extremes_and_numbers_of_the_published_examples() {
    let irregular = &irregular()[1..];
    let rules = (AggregateRules::default(), 16);
    let rows = [G(10.0), G(25.0), U(30.0), G(50.0), U(60.0), G(90.0)];
    assert_rows(Aggregate::Maximum, irregular, rules, &rows);
    let rows = [G(1.0), G(2.0), U(1.0), G(2.0), U(1.0), G(3.0)];
    assert_rows(Aggregate::Count, irregular, rules, &rows);
    let rows = [G(10.0), G(30.0), NoData, G(60.0)];
    assert_rows(Aggregate::Maximum, &periodic()[1..], rules, &rows);
}

#[test]
fn good_times_of_the_published_examples() {
    let rules = (AggregateRules::default(), 16);
    let rows = [14_000.0, 16_000.0, 10_000.0, 16_000.0, 13_000.0].map(G);
    assert_rows(Aggregate::DurationGood, &irregular(), rules, &rows);
    let rows = [87.5, 100.0, 62.5, 100.0, 81.25].map(G);
    assert_rows(Aggregate::PercentGood, &irregular(), rules, &rows);
    let rows = [6_000.0, 16_000.0, 0.0, 14_000.0, 0.0].map(G);
    assert_rows(Aggregate::DurationGood, &periodic(), rules, &rows);
}
