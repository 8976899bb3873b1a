//! `ua-space trace --otlp` with a collector that parses by the definitions of OpenTelemetry.

use std::time::Duration;

use nix::sys::signal::Signal;
use serde_json::{Value, json};
use system_tests::{Cell, Peer, StartedChild, program};

const SOON: Duration = Duration::from_secs(60);

/// Returns the objects in the requests on a path.
fn parsed(line: &Value, path: &str) -> Vec<Value> {
    let of_path = line["path"] == path;
    let parsed = line["parsed"].as_array().filter(|_| of_path);
    parsed.cloned().unwrap_or_default()
}

/// Returns the value of a counter of the topic in a request of metrics.
fn count(line: &Value, metric: &str) -> Option<u64> {
    let all = parsed(line, "/v1/metrics");
    let counter = all
        .iter()
        .find(|one| one["metric"] == metric && one["resource"]["service.name"] == "bridge-ros1")?;
    assert_eq!(
        (&counter["kind"], &counter["monotonic"]),
        (&json!("sum"), &json!(true))
    );
    let points = counter["points"].as_array()?;
    let point = points
        .iter()
        .find(|point| point["attributes"]["topic"] == "ua_1_2_10")?;
    // The start is known to the second.
    let (start, time) = (point["start"].as_u64(), point["time"].as_u64());
    assert!(start.is_some_and(|start| start > 0), "{point}");
    assert!(start <= time, "{point}");
    point["value"].as_u64()
}

#[test]
fn a_collector_parses_the_counters_delays_and_sampled_traces_of_a_cell() {
    let Some(cell) = Cell::with(&[Peer::Ros1, Peer::Python]) else {
        return;
    };
    let _master = cell.roscore();
    let _bridge = cell.bridge_ros1(&[]);
    let value = r#"{"data": 1.5}"#;
    let words = [
        "/ua_1_2_10",
        "std_msgs/Float64",
        "--repeat",
        "0",
        "--value",
        value,
    ];
    let _node = cell.rospy("ros1_pub.py", &words);
    let mut collector = cell.asyncua("otlp_collector.py", &[]);
    let words = ["trace", "--otlp", "http://127.0.0.1:4318", "--traces", "2"];
    let mut exporter = StartedChild::new("ua-space", &program("ua-space"))
        .args(words)
        .args(["--seconds", "0.5", "--interface", "lo"])
        .start();

    // Totals grow from request to request, although the collector refused the first.
    let first = collector.wait_for_json("a counter of the topic", SOON, |line| {
        count(line, "ua.samples.sent").filter(|sent| *sent > 0)
    });
    collector.wait_for_json("a higher counter", SOON, |line| {
        count(line, "ua.samples.sent").filter(|sent| *sent > first)
    });
    collector.wait_for_json("the delays of a hop", SOON, |line| {
        let all = parsed(line, "/v1/metrics");
        let delays = all.iter().find(|one| one["metric"] == "ua.hop.delay")?;
        assert_eq!(
            (&delays["kind"], &delays["unit"]),
            (&json!("summary"), &json!("us"))
        );
        let points = delays["points"].as_array()?;
        points.iter().find_map(|point| {
            let quantile = |name: &str| point["quantiles"][name].as_f64();
            (point["count"].as_u64()? > 0 && quantile("0.5")? <= quantile("1.0")?).then_some(())
        })
    });
    let spans = collector.wait_for_json("a trace with both hops", SOON, |line| {
        let spans = parsed(line, "/v1/traces");
        spans.iter().find_map(|origin| {
            let of_trace = |span: &&Value| span["trace"] == origin["trace"];
            let network = spans
                .iter()
                .filter(of_trace)
                .find(|span| span["parent"] == origin["id"])?;
            (origin["parent"] == "").then(|| [origin.clone(), network.clone()])
        })
    });
    let [origin, network] = spans;
    assert_eq!(origin["service"], "bridge-ros1", "{origin}");
    assert_eq!(origin["attributes"]["hop"], "origin", "{origin}");
    assert_eq!(network["attributes"]["hop"], "network", "{network}");
    assert_eq!(origin["kind"], "SPAN_KIND_PRODUCER", "{origin}");
    assert_eq!(network["service"], "ua-space", "{network}");
    assert_eq!(network["kind"], "SPAN_KIND_CONSUMER", "{network}");
    assert_eq!(network["attributes"]["topic"], "ua_1_2_10", "{network}");
    for span in [&origin, &network] {
        assert_eq!(span["trace"].as_str().map(str::len), Some(32), "{span}");
        let nanos = span["nanos"].as_i64().unwrap();
        assert!((0..10_000_000_000).contains(&nanos), "{span}");
    }
    exporter.signal(Signal::SIGINT);
    assert!(exporter.wait_for_end(SOON).success(), "{exporter}");
}
