//! The history of values: raw and as aggregates, checked with asyncua and node-opcua.

use std::fs;
use std::time::Duration;

use nix::sys::signal::Signal;
use serde_json::{Value, json};
use system_tests::{Cell, Child, Peer, SERVER_ENDPOINT, UadpSocket, eventually};
use uadp::{DataSetHeader, Timestamp};

use super::{SOON, TEMPERATURE, TEMPERATURE_NODE, key_frame, shows, watch, write};

/// A value written by others, a value written by clients, and a value that only some users may
/// read.
const MAPPING: &str = "
namespaces:
  2: urn:ua-bridge:system-tests
spaces:
  - id: 2
variables:
  - {node: ns=2;i=10, name: temperature, type: Double, origin: 2}
  - {node: ns=2;i=30, name: setpoint, type: Double, origin: 0}
  - {node: ns=2;i=31, name: secret, type: Double, origin: 0, permissions: {read: engineer}}
";

/// HistorianBits of a StatusCode, with the InfoType of a DataValue (OPC 10000-4, 7.39.1).
const CALCULATED: u32 = 0x0401;
const INTERPOLATED: u32 = 0x0402;
const BAD: u32 = 0x8000_0000;
const NO_DATA: u32 = 0x809B_0000;

/// The start of the times in queries, in nanoseconds.
const EPOCH: i128 = 1_700_000_000_000_000_000;

fn server(cell: &Cell) -> Child {
    let mapping = cell.file("history.yaml", MAPPING);
    let server = cell.ua_server(&[mapping.to_str().unwrap()]);
    eventually("the server answers clients", SOON, || {
        cell.asyncua_try("opcua_read.py", &[SERVER_ENDPOINT, "ns=0;i=2258"])
    });
    server
}

/// Returns the answers of a judge.
fn asyncua(cell: &Cell, questions: &Value) -> Vec<Value> {
    cell.asyncua_once(
        "opcua_history.py",
        &[SERVER_ENDPOINT, &questions.to_string()],
    )
}

fn node_opcua(cell: &Cell, questions: &Value) -> Vec<Value> {
    cell.node_opcua_once("history.js", &[SERVER_ENDPOINT, &questions.to_string()])
}

/// Encodes a sample with the time `at` milliseconds after [`EPOCH`].
fn sample(sequence: u16, (at, value): (i32, f64), status: Option<u16>) -> Vec<u8> {
    let time = Timestamp::from_unix_nanos(EPOCH + i128::from(at) * 1_000_000);
    let header = DataSetHeader {
        timestamp: Some(time.time),
        status,
        ..DataSetHeader::default()
    };
    key_frame(TEMPERATURE, sequence, value, header)
}

/// Sends four values a second apart, and a bad value after their writer was silent.
fn five_values(cell: &Cell) {
    let group = UadpSocket::join();
    let mut watch = watch(cell, TEMPERATURE_NODE);
    for (sequence, at, value) in [(1, 0, 1.0), (2, 1000, 5.0), (3, 2000, 3.0), (4, 3000, 9.0)] {
        group.send(&sample(sequence, (at, value), None));
        shows(&mut watch, "Good", &json!(value));
    }
    shows(&mut watch, "UncertainLastUsableValue", &json!(9.0));
    group.send(&sample(5, (4000, 7.0), Some(0x8000)));
    watch.wait_for_json("the bad value", SOON, |line| {
        (line.get("status")? == "Bad").then_some(())
    });
}

/// Checks that each judge gets these answers.
fn assert_answers(cell: &Cell, expected: &[(Value, Value)]) {
    let questions = expected.iter().map(|(question, _)| question.clone());
    let questions = Value::Array(questions.collect());
    for (judge, answers) in [
        ("asyncua", asyncua(cell, &questions)),
        ("node-opcua", node_opcua(cell, &questions)),
    ] {
        assert_eq!(answers.len(), expected.len(), "{judge}: {answers:?}");
        for (answer, (question, wanted)) in answers.iter().zip(expected) {
            let (answer, wanted) = (numbers(answer), numbers(wanted));
            assert_eq!(answer, wanted, "{judge} asks {question}");
        }
    }
}

/// Converts numbers to floats, because the judges write whole numbers in two ways.
fn numbers(value: &Value) -> Value {
    match value {
        Value::Number(number) => json!(number.as_f64()),
        Value::Array(all) => Value::Array(all.iter().map(numbers).collect()),
        Value::Object(all) => {
            let all = all.iter();
            Value::Object(
                all.map(|(name, one)| (name.clone(), numbers(one)))
                    .collect(),
            )
        }
        Value::Null | Value::Bool(_) | Value::String(_) => value.clone(),
    }
}

fn good(answers: u32, values: &[(i32, f64, u32)]) -> Value {
    json!({"status": "Good", "answers": answers, "values": values})
}

fn refused(status: &str) -> Value {
    json!({"status": status, "answers": 1, "values": []})
}

#[test]
fn past_values_are_read_in_either_direction_with_bounds_and_in_parts() {
    let Some(cell) = Cell::with(&[Peer::Python, Peer::NodeOpcua]) else {
        return;
    };
    let _server = server(&cell);
    five_values(&cell);
    let node = TEMPERATURE_NODE;
    let (first, second, third, fourth) =
        ((0, 1.0, 0), (1000, 5.0, 0), (2000, 3.0, 0), (3000, 9.0, 0));
    let bad = (4000, 7.0, BAD);
    let no_bound = json!([-1000, null, 0x80D7_0000_u32]);
    let from_before = json!([no_bound, first, second]);
    assert_answers(
        &cell,
        &[
            (
                json!({"node": node, "start": 0, "end": 3000}),
                good(1, &[first, second, third]),
            ),
            (
                json!({"node": node, "start": 1000, "count": 2}),
                good(2, &[second, third, fourth, bad]),
            ),
            (
                json!({"node": node, "end": 3000, "count": 10}),
                good(1, &[fourth, third, second, first]),
            ),
            (
                json!({"node": node, "start": 2500, "end": 500, "bounds": true}),
                good(1, &[fourth, third, second, first]),
            ),
            (
                json!({"node": node, "start": -1000, "end": 500, "bounds": true}),
                json!({"status": "Good", "answers": 1, "values": from_before}),
            ),
            (
                json!({"node": node, "start": 10_000, "end": 20_000}),
                refused("GoodNoData"),
            ),
            (
                json!({"node": node, "end": 3000}),
                refused("BadHistoryOperationInvalid"),
            ),
            (
                json!({"node": "ns=2;i=31", "start": 0, "end": 3000}),
                refused("BadUserAccessDenied"),
            ),
        ],
    );
}

/// Returns the request of an aggregate for intervals, in milliseconds.
fn of(aggregate: &str, (start, end, interval): (i32, i32, u32)) -> Value {
    let node = TEMPERATURE_NODE;
    json!({"node": node, "aggregate": aggregate, "start": start, "end": end, "interval": interval})
}

#[test]
fn aggregates_of_past_values_are_worked_out_for_each_interval() {
    let Some(cell) = Cell::with(&[Peer::Python, Peer::NodeOpcua]) else {
        return;
    };
    let _server = server(&cell);
    five_values(&cell);
    let halves = (0, 4000, 2000);
    let with_the_bad_one = json!([
        [0, 3.0, CALCULATED],
        [2000, 6.0, CALCULATED],
        [4000, null, NO_DATA]
    ]);
    let counts = json!([[0, 2, CALCULATED], [2000, 2, CALCULATED]]);
    assert_answers(
        &cell,
        &[
            (
                of("Average", halves),
                good(1, &[(0, 3.0, CALCULATED), (2000, 6.0, CALCULATED)]),
            ),
            (
                of("Average", (3000, 1000, 2000)),
                good(1, &[(3000, 6.0, CALCULATED)]),
            ),
            (
                of("Average", (0, 6000, 2000)),
                json!({"status": "Good", "answers": 1, "values": with_the_bad_one}),
            ),
            // The minima are at the starts of their intervals, so they are raw values.
            (
                of("Minimum", halves),
                good(1, &[(0, 1.0, 0), (2000, 3.0, 0)]),
            ),
            (
                of("Maximum", halves),
                good(1, &[(0, 5.0, CALCULATED), (2000, 9.0, CALCULATED)]),
            ),
            (
                of("Count", halves),
                json!({"status": "Good", "answers": 1, "values": counts}),
            ),
            (
                of("Interpolative", (0, 3000, 1500)),
                good(1, &[(0, 1.0, 0), (1500, 4.0, INTERPOLATED)]),
            ),
            (
                of("NumberOfTransitions", halves),
                refused("BadAggregateNotSupported"),
            ),
        ],
    );
    let at = json!([{"node": TEMPERATURE_NODE, "at": [500, 2000]}]);
    assert_eq!(
        asyncua(&cell, &at)[..],
        [good(1, &[(500, 3.0, INTERPOLATED), (2000, 3.0, 0)])]
    );
}

#[test]
fn differences_ends_and_times_of_past_values_are_aggregates() {
    let Some(cell) = Cell::with(&[Peer::Python, Peer::NodeOpcua]) else {
        return;
    };
    let _server = server(&cell);
    five_values(&cell);
    let halves = (0, 4000, 2000);
    assert_answers(
        &cell,
        &[
            (
                of("Range", halves),
                good(1, &[(0, 4.0, CALCULATED), (2000, 6.0, CALCULATED)]),
            ),
            (
                of("Delta", halves),
                good(1, &[(0, 4.0, CALCULATED), (2000, 6.0, CALCULATED)]),
            ),
            (
                of("End", halves),
                good(1, &[(1000, 5.0, 0), (3000, 9.0, 0)]),
            ),
            (
                of("MaximumActualTime", halves),
                good(1, &[(1000, 5.0, 0), (3000, 9.0, 0)]),
            ),
            (
                of("TimeAverage", (0, 2000, 2000)),
                good(1, &[(0, 3.5, CALCULATED)]),
            ),
            (
                of("DurationGood", (0, 6000, 3000)),
                good(1, &[(0, 3000.0, CALCULATED), (3000, 1000.0, CALCULATED)]),
            ),
        ],
    );
}

#[test]
fn the_last_thousand_values_are_kept_and_variables_and_server_say_so() {
    let Some(cell) = Cell::with(&[Peer::Python, Peer::NodeOpcua]) else {
        return;
    };
    let _server = server(&cell);
    let group = UadpSocket::join();
    let mut watch = watch(&cell, TEMPERATURE_NODE);
    for number in 0..1100_u16 {
        let value = f64::from(number);
        group.send(&sample(number + 1, (number.into(), value), None));
        if number % 50 == 49 {
            shows(&mut watch, "Good", &json!(value));
        }
    }
    let kept: Vec<(i32, f64, u32)> = (100..1100).map(|at| (at, at.into(), 0)).collect();
    assert_answers(
        &cell,
        &[(
            json!({"node": TEMPERATURE_NODE, "start": -1, "end": 5000, "count": 400}),
            good(3, &kept),
        )],
    );
    for value in ["1.5", "2.5"] {
        assert_eq!(write(&cell, "ns=2;i=30", "Double", value), "Good");
    }
    let questions = json!([
        {"node": "ns=2;i=30", "start": 0, "count": 10},
        {"node": TEMPERATURE_NODE, "attribute": "Historizing"},
        {"node": TEMPERATURE_NODE, "attribute": "AccessLevel"},
        {"node": TEMPERATURE_NODE, "attribute": "UserAccessLevel"},
        {"node": "ns=2;i=30", "attribute": "AccessLevel"},
        // AccessHistoryDataCapability, and HistoryServerCapabilities/AggregateFunctions.
        {"node": "i=11193", "attribute": "Value"},
        {"node": "i=11201", "children": true},
    ]);
    let answers = asyncua(&cell, &questions);
    let written = answers[0]["values"].as_array().unwrap();
    let written: Vec<&Value> = written.iter().map(|value| &value[1]).collect();
    assert_eq!(written, [&json!(1.5), &json!(2.5)], "what clients write");
    let told = |value: Value| json!({"status": "Good", "value": value});
    // CurrentRead, CurrentWrite and HistoryRead are 1, 2 and 4.
    let attributes = [json!(true), json!(5), json!(5), json!(7), json!(true)];
    assert_eq!(answers[1..6], attributes.map(told)[..]);
    assert_eq!(
        answers[6]["children"],
        json!([
            "Average",
            "Count",
            "Delta",
            "DurationGood",
            "End",
            "Interpolative",
            "Maximum",
            "MaximumActualTime",
            "Minimum",
            "MinimumActualTime",
            "PercentGood",
            "Range",
            "Start",
            "TimeAverage",
            "Total",
            "WorstQuality"
        ])
    );
}

#[test]
fn the_history_in_a_file_survives_a_killed_and_a_stopped_server() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let file = cell.folder().join("below/history.redb");
    let text = format!(
        "{MAPPING}server:\n  history: {{values: 4, file: {}}}\n",
        file.display()
    );
    let mapping = cell.file("kept.yaml", &text);
    let served = || {
        let server = cell.ua_server(&[mapping.to_str().unwrap()]);
        eventually("the server answers clients", SOON, || {
            cell.asyncua_try("opcua_read.py", &[SERVER_ENDPOINT, "ns=0;i=2258"])
        });
        server
    };
    let sends = |values: &[(u16, i32, f64)]| {
        let group = UadpSocket::join();
        let mut watch = watch(&cell, TEMPERATURE_NODE);
        for (sequence, at, value) in values {
            group.send(&sample(*sequence, (*at, *value), None));
            shows(&mut watch, "Good", &json!(value));
        }
    };
    // The values and the lower halves of their statuses.
    let raw = || {
        let question = json!([{"node": TEMPERATURE_NODE, "start": 0, "count": 10}]);
        let told = asyncua(&cell, &question);
        let values = told[0]["values"].as_array().unwrap().clone();
        values.iter().map(|one| one[1].clone()).collect::<Vec<_>>()
    };

    let mut server = served();
    let written = || fs::metadata(&file).ok()?.modified().ok();
    let before = written();
    assert!(before.is_some(), "the file is created at the start");
    sends(&[(1, 0, 1.0), (2, 1000, 2.0), (3, 2000, 3.0)]);
    // Changes are written within half a second.
    eventually("the values are in the file", SOON, || {
        let is_quiet = written()?.elapsed().ok()? > Duration::from_secs(2);
        (written() != before && is_quiet).then_some(())
    });
    server.signal(Signal::SIGKILL);
    assert!(!server.wait_for_end(SOON).success());

    let mut server = served();
    // The last entry marks the time without the server.
    assert_eq!(raw(), [json!(1.0), json!(2.0), json!(3.0), Value::Null]);
    sends(&[(4, 600_000_000, 4.0)]);
    server.signal(Signal::SIGTERM);
    assert!(server.wait_for_end(SOON).success());

    // The file has as many values as the memory.
    let _server = served();
    let kept = raw();
    assert_eq!(kept.len(), 4, "{kept:?}");
    assert!(kept.contains(&json!(4.0)), "{kept:?}");
    assert!(!kept.contains(&json!(1.0)), "{kept:?}");
}
