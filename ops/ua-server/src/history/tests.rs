//! Unit tests of `history`.

use super::*;

const TIMES: [i64; 4] = [10, 20, 30, 40];

fn read(start: Option<i64>, end: Option<i64>, count: u32, bounds: bool) -> Vec<HistoryValue> {
    steps(&TIMES, (start, end), (count, bounds)).unwrap()
}

fn values(list: &[usize]) -> Vec<HistoryValue> {
    list.iter().map(|at| HistoryValue::Value(*at)).collect()
}

#[test]
fn a_span_has_its_start_and_not_its_end_in_either_direction() {
    assert_eq!(read(Some(10), Some(30), 0, false), values(&[0, 1]));
    assert_eq!(read(Some(30), Some(10), 0, false), values(&[2, 1]));
    assert_eq!(read(Some(20), Some(20), 0, false), values(&[1]));
    assert_eq!(read(Some(20), None, 2, false), values(&[1, 2, 3]));
    assert_eq!(read(None, Some(30), 2, false), values(&[2, 1, 0]));
    assert_eq!(read(Some(50), Some(60), 0, false), []);
}

#[test]
fn bounds_are_the_values_at_the_ends_or_beyond_them() {
    assert_eq!(read(Some(10), Some(30), 0, true), values(&[0, 1, 2]));
    assert_eq!(read(Some(15), Some(35), 0, true), values(&[0, 1, 2, 3]));
    assert_eq!(read(Some(35), Some(15), 0, true), values(&[3, 2, 1, 0]));
    assert_eq!(
        read(Some(5), Some(50), 0, true),
        [
            &[HistoryValue::NoBound(5)][..],
            &values(&[0, 1, 2, 3]),
            &[HistoryValue::NoBound(50)]
        ]
        .concat()
    );
}

#[test]
fn percentages_that_contradict_each_other_are_refused() {
    let asked = |percent_data_bad, percent_data_good| {
        let configuration = AggregateConfiguration {
            percent_data_bad,
            percent_data_good,
            ..AggregateConfiguration::default()
        };
        rules(&configuration).map(|rules| (rules.percent_bad, rules.percent_good))
    };
    assert_eq!(asked(50, 50), Ok((50, 50)));
    for (bad, good) in [(49, 50), (101, 100), (100, 101)] {
        let refused = Err(StatusCode::BadAggregateInvalidInputs);
        assert_eq!(asked(bad, good), refused, "{bad}, {good}");
    }
}

#[test]
fn two_of_start_end_and_count_are_needed() {
    for (start, end, count) in [(None, None, 5), (Some(1), None, 0), (None, Some(1), 0)] {
        let refused = steps(&TIMES, (start, end), (count, false));
        assert_eq!(refused, Err(StatusCode::BadHistoryOperationInvalid));
    }
}
