//! `ua-space status` and `ua-space doctor` with cells in which one thing is broken.

mod broken;

use std::net::UdpSocket;
use std::path::Path;
use std::time::Duration;

use nix::sys::signal::Signal;
use serde_json::{Value, json};
use system_tests::{
    Cell, METRICS_ROS1, METRICS_ROS2, Peer, StartedChild, eventually, metrics, program,
};

const SOON: Duration = Duration::from_secs(30);

/// Runs `ua-space` on loopback with variables. Returns the exit code, and the last JSON object of
/// the output.
fn ua_space(words: &[&str], variables: &[(&str, &str)]) -> (i32, Value) {
    ua_space_anywhere(&[words, &["--interface", "lo"]].concat(), variables)
}

/// Like [`ua_space`], on the interface of the routes or of the words.
fn ua_space_anywhere(words: &[&str], variables: &[(&str, &str)]) -> (i32, Value) {
    let mut started = StartedChild::new("ua-space", &program("ua-space")).args(words);
    for (name, value) in variables {
        started = started.env(name, value);
    }
    let mut child = started.args(["--json"]).start();
    let code = child.wait_for_end(SOON).code().unwrap();
    let lines = child.lines();
    let mut objects = lines.iter().rev().filter_map(|line| {
        let value: Value = serde_json::from_str(line).ok()?;
        value.is_object().then_some(value)
    });
    (code, objects.next().unwrap_or_default())
}

/// Returns the codes of the findings, without those about limits of the host of the tests.
fn codes(variables: &[(&str, &str)]) -> Vec<String> {
    let (_, found) = ua_space(&["doctor", "--seconds", "1"], variables);
    let findings = found["findings"].as_array().unwrap();
    let codes = findings.iter().filter_map(|one| one["code"].as_str());
    let of_cell = codes.filter(|code| !["D050", "D052", "D053", "D070", "D071"].contains(code));
    of_cell.map(str::to_owned).collect()
}

#[test]
fn status_shows_each_program_and_what_it_waits_for() {
    let Some(cell) = Cell::with(&[Peer::Ros1]) else {
        return;
    };
    let (code, _) = ua_space(&["status", "--seconds", "0.5"], &[]);
    assert_eq!(code, 69, "no program runs");
    let _bridge = cell.bridge_ros1(&[]);
    let unready = eventually("the bridge misses its master", SOON, || {
        let (code, shown) = ua_space(&["status", "--seconds", "1"], &[]);
        let one = shown["programs"][0].clone();
        (code == 1 && one["state"] == "not_ready").then_some(one)
    });
    assert_eq!(
        (&unready["program"], &unready["space"]),
        (&json!("bridge-ros1"), &json!(1))
    );
    assert!(unready["uptime_s"].is_u64(), "{unready}");
    let reasons = unready["not_ready"].as_array().unwrap();
    assert!(!reasons.is_empty(), "{unready}");
    let _master = cell.roscore();
    eventually("the bridge is ready", SOON, || {
        let (code, shown) = ua_space(&["status", "--seconds", "1"], &[]);
        let all = shown["programs"].as_array()?;
        (code == 0 && all.len() == 1 && all[0]["state"] == "ready").then_some(())
    });
}

#[test]
fn doctor_finds_a_missing_master_settings_of_ros_and_the_holder_of_the_port() {
    let Some(_cell) = Cell::with(&[]) else {
        return;
    };
    let away = ("ROS_MASTER_URI", "http://127.0.0.1:1");
    for (variables, code) in [
        (&[away][..], "D010"),
        (&[away, ("ROS_IP", "10.9.9.9")], "D012"),
        (&[("ROS_LOCALHOST_ONLY", "1")], "D020"),
        (&[("ROS_DISCOVERY_SERVER", "127.0.0.1:11811")], "D021"),
        (&[("RMW_IMPLEMENTATION", "rmw_zenoh_cpp")], "D022"),
    ] {
        let found = codes(variables);
        assert!(found.contains(&code.to_owned()), "{code} in {found:?}");
    }
    let plain = codes(&[]);
    assert_eq!(plain, ["D007"], "nothing runs");
    let _holder = UdpSocket::bind("0.0.0.0:4840").unwrap();
    let (_, found) = ua_space(&["doctor", "--seconds", "1"], &[]);
    let found = found["findings"].as_array().unwrap().clone();
    let holder = found.iter().find(|one| one["code"] == "D005");
    let what = holder
        .and_then(|one| one["what"].as_str())
        .unwrap_or_default();
    let own = format!("process {}", std::process::id());
    assert!(what.contains(&own), "{own} in {found:?}");
}

#[test]
fn doctor_measures_multicast_on_each_interface() {
    let Some(_cell) = Cell::with(&[]) else {
        return;
    };
    let (_, found) = ua_space(&["doctor", "--seconds", "0.5"], &[]);
    let interfaces = found["facts"]["host"]["interfaces"].as_array().unwrap();
    let lo = interfaces.iter().find(|one| one["name"] == "lo").unwrap();
    assert!(lo["round_trip"]["Ok"].as_f64() > Some(0.0), "{lo}");
}

#[test]
fn doctor_finds_two_bridges_of_a_space_and_mappings_that_differ() {
    let Some(cell) = Cell::with(&[]) else {
        return;
    };
    let text = |name: &str| {
        format!(
            "spaces: [{{id: 2}}]\nnamespaces: {{2: urn:test}}\nvariables:\n  - {{node: ns=2;i=10, name: {name}, origin: 2, \
             ros: {{space: 2, topic: /speed, type: std_msgs/Float64, field: data}}}}\n"
        )
    };
    let first = cell.file("first.yaml", &text("Speed"));
    let second = cell.file("second.yaml", &text("Velocity"));
    let _first = cell.bridge_ros2(&[first.to_str().unwrap()]);
    let healthy = codes(&[]);
    assert!(!healthy.contains(&"D030".to_owned()), "{healthy:?}");
    let _second = StartedChild::new("bridge-ros2", &program("bridge-ros2"))
        .args([second.to_str().unwrap(), "--domain", "2"])
        .args(["--interface", "lo", "--metrics", METRICS_ROS1])
        .start();
    eventually("the second bridge answers", SOON, || metrics(METRICS_ROS1));
    eventually("both faults are found", SOON, || {
        let found = codes(&[]);
        ["D030", "D032"]
            .iter()
            .all(|code| found.iter().any(|one| one == code))
            .then_some(())
    });
    let status = metrics(METRICS_ROS2).unwrap();
    assert_eq!(status["program"], "bridge-ros2");
}

#[test]
fn doctor_finds_faults_of_running_programs() {
    let Some(cell) = Cell::with(&[Peer::Ros1]) else {
        return;
    };
    let text = "spaces: [{id: 2}]\nnamespaces: {2: urn:test}\nvariables: []\n";
    let mapping = cell.file("cell.yaml", text);
    let bridge = cell.bridge_ros2(&[mapping.to_str().unwrap()]);
    let has =
        |code: &str, variables: &[(&str, &str)]| codes(variables).iter().any(|found| found == code);
    for code in ["D037", "D051"] {
        assert!(!has(code, &[]), "{code} before anything is broken");
    }
    // A node of another domain than the bridge.
    assert!(has("D023", &[("ROS_DOMAIN_ID", "7")]));
    assert!(!has("D023", &[("ROS_DOMAIN_ID", "2")]));
    // The file is changed, and what it says now cannot run.
    std::fs::write(&mapping, "variables: 3\n").unwrap();
    bridge.signal(Signal::SIGHUP);
    eventually("the older mapping is found", SOON, || {
        has("D037", &[]).then_some(())
    });
    // No ROS master answers the other bridge.
    let _waiting = cell.bridge_ros1(&[]);
    eventually("the unready bridge is found", SOON, || {
        let (_, found) = ua_space(&["doctor", "--seconds", "1"], &[]);
        let mut all = found["findings"].as_array()?.iter();
        let is_it = |one: &Value| {
            let what = one["what"].as_str().unwrap_or_default();
            one["code"] == "D035" && what.contains("bridge-ros1") && what.contains("not ready")
        };
        all.any(is_it).then_some(())
    });
    // Its files and sockets reach their limit.
    let process = bridge.id().to_string();
    let open = std::fs::read_dir(format!("/proc/{process}/fd")).unwrap();
    let limit = format!("--nofile={}", open.count() + 2);
    let limited = std::process::Command::new("prlimit")
        .args(["--pid", &process, &limit])
        .status();
    assert!(limited.unwrap().success());
    assert!(has("D051", &[]));
}

#[test]
fn doctor_finds_a_network_bridge_without_a_querier_and_mends_it() {
    let Some(_cell) = Cell::with(&[]) else {
        return;
    };
    // The interfaces of this network are in a /sys of its own.
    let doctor = |more: &str| {
        let script = format!(
            "mount -t sysfs sysfs /sys && exec {} doctor --seconds 0.5 --json {more}",
            program("ua-space").display()
        );
        let mut child = StartedChild::new("doctor", Path::new("/usr/bin/unshare"))
            .args(["--mount", "sh", "-c", &script])
            .start();
        child.wait_for_end(SOON);
        child.lines().iter().any(|line| line.contains("\"D071\""))
    };
    assert!(!doctor(""));
    for words in [
        &[
            "link",
            "add",
            "br7",
            "type",
            "bridge",
            "mcast_snooping",
            "1",
        ][..],
        &["addr", "add", "10.77.7.1/24", "dev", "br7"],
        &["link", "set", "br7", "up"],
    ] {
        let ip = std::process::Command::new("ip").args(words).status();
        assert!(ip.unwrap().success(), "{words:?}");
    }
    assert!(doctor(""), "nothing asks for the members of the group");
    assert!(doctor("--fix"), "it is found, and then mended");
    assert!(!doctor(""));
}

#[test]
fn doctor_packs_a_report_without_secrets() {
    let Some(cell) = Cell::with(&[]) else {
        return;
    };
    let mapping = cell.file(
        "cell.yaml",
        "# password: hunter2\nspaces: [{id: 2}]\nnamespaces: {2: urn:test}\nvariables: []\n",
    );
    let _bridge = cell.bridge_ros2(&[mapping.to_str().unwrap()]);
    let report = cell.folder().join("report.tar.gz");
    let words = [
        "doctor",
        "--seconds",
        "1",
        "--bundle",
        report.to_str().unwrap(),
    ];
    let (code, found) = ua_space(&words, &[]);
    assert!(code <= 1 && found["findings"].is_array(), "{code} {found}");
    let listed = |words: &[&str]| {
        let mut tar = StartedChild::new("tar", Path::new("/bin/tar"))
            .args(words)
            .args([&report])
            .start();
        assert!(tar.wait_for_end(SOON).success(), "{tar}");
        tar.lines()
    };
    let names = listed(&["-tzf"]);
    for part in [
        "versions.txt",
        "findings.json",
        "facts.json",
        "status/0-bridge-ros2-2.json",
    ] {
        let path = format!("ua-bridge-report/{part}");
        assert!(names.contains(&path), "{path} in {names:?}");
    }
    let content = listed(&["--to-stdout", "-xzf"]);
    assert!(
        content
            .iter()
            .any(|line| line.contains("namespaces: {2: urn:test}"))
    );
    assert!(!content.iter().any(|line| line.contains("hunter2")));
}
