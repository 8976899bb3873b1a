//! Alarms and conditions (OPC 10000-9): asyncua and node-opcua watch and acknowledge them.

use super::*;

/// Alarms of values that clients write.
const ALARMS: &str = "
namespaces:
  2: urn:ua-bridge:system-tests
variables:
  - {node: ns=2;i=30, name: level, type: Double, origin: 0, alarm: {high: 70, high_high: 90, confirm: true}}
  - {node: ns=2;i=31, name: pressure, type: Int32, origin: 0, alarm: {high: 5, exclusive: false, delay: 100ms}}
  - {node: ns=2;i=32, name: guard, type: Boolean, origin: 0, alarm: {normal: false, message: the guard is open}}
  - {node: ns=2;i=33, name: mode, type: Int32, origin: 0, enum: {0: idle, 3: fault}, alarm: {when: fault, severity: 900}}
server:
  security: [None]
";

const AUDIT_CONDITION: &str = "i=2790";
const AUDIT_ACKNOWLEDGE: &str = "i=8944";

/// A client that watches conditions and calls their methods.
struct Watcher(Child);

impl Watcher {
    fn start(cell: &Cell, args: &[&str]) -> Self {
        let args = [&[SERVER_ENDPOINT], args].concat();
        let mut client = cell
            .asyncua_started("opcua_alarms.py", &args)
            .told()
            .start();
        client.wait_for_json("the client watches conditions", SOON, |line| {
            line.get("ready").map(|_| ())
        });
        Self(client)
    }

    /// Waits for an event with these fields and returns it.
    fn sees(&mut self, fields: &Value) -> Value {
        let wanted = fields.as_object().unwrap();
        self.0.wait_for_json(&format!("{fields}"), SOON, |line| {
            let has = wanted
                .iter()
                .all(|(key, value)| line.get(key) == Some(value));
            has.then(|| line.clone())
        })
    }

    /// Calls a method and returns its status.
    fn call(&mut self, line: &Value) -> String {
        let before = self.statuses().len();
        self.0.tell(&line.to_string());
        eventually(&format!("an answer to {line}"), SOON, || {
            self.statuses().get(before).cloned()
        })
    }

    fn statuses(&self) -> Vec<String> {
        let lines = self.0.json_lines();
        let statuses = lines.iter().filter_map(|line| line.get("status"));
        statuses
            .map(|status| status.as_str().unwrap().to_owned())
            .collect()
    }

    /// Returns the types of all events.
    fn types(&self) -> Vec<String> {
        let lines = self.0.json_lines();
        let types = lines.iter().filter_map(|line| line.get("type"));
        types.map(|one| one.as_str().unwrap().to_owned()).collect()
    }
}

fn method(name: &str, event: &Value, comment: &str) -> Value {
    json!({"call": name, "condition": event["condition"], "event": event["event"], "comment": comment})
}

#[test]
fn a_limit_alarm_is_acknowledged_and_confirmed_by_one_of_several_clients() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let _server = serving(&cell, ALARMS);
    let mut anna = Watcher::start(&cell, &[]);
    let mut bert = Watcher::start(&cell, &[]);
    let mut auditor = Watcher::start(
        &cell,
        &["--type", AUDIT_CONDITION, "--type", AUDIT_ACKNOWLEDGE],
    );
    assert_eq!(write(&cell, "ns=2;i=30", "Double", "50"), "Good");
    assert_eq!(write(&cell, "ns=2;i=30", "Double", "75.5"), "Good");
    let high = json!({"name": "level", "active": true, "acked": false, "limit": "High"});
    let seen = anna.sees(&high);
    assert_eq!(bert.sees(&high)["event"], seen["event"]);
    assert_eq!(seen["type"], "i=9482");
    assert_eq!(seen["source"], "ns=2;i=30");
    assert_eq!(seen["input"], "ns=2;i=30");
    assert_eq!(seen["message"], "level is 75.5: High");
    assert_eq!(
        [&seen["severity"], &seen["retain"]],
        [&json!(500), &json!(true)]
    );
    write(&cell, "ns=2;i=30", "Double", "95");
    let worse = bert.sees(&json!({"limit": "HighHigh", "severity": 750}));
    // The earlier event does not acknowledge the worse state.
    let early = bert.call(&method("Acknowledge", &seen, ""));
    assert_eq!(early, "BadEventIdUnknown");
    assert_eq!(
        bert.call(&method("Acknowledge", &worse, "on my way")),
        "Good"
    );
    let acked = anna.sees(&json!({"acked": true, "confirmed": false, "comment": "on my way"}));
    assert_eq!(acked["user"], "anonymous");
    let again = anna.call(&method("Acknowledge", &worse, ""));
    assert_eq!(again, "BadConditionBranchAlreadyAcked");
    let audited = auditor.sees(&json!({"type": AUDIT_ACKNOWLEDGE, "good": true}));
    assert_eq!(audited["condition_event"], worse["event"]);
    assert_eq!(
        [&audited["comment"], &audited["user"]],
        ["on my way", "anonymous"]
    );
    auditor.sees(&json!({"type": AUDIT_ACKNOWLEDGE, "good": false}));
    write(&cell, "ns=2;i=30", "Double", "20");
    let normal = anna.sees(&json!({"active": false, "confirmed": false, "retain": true}));
    assert_eq!(anna.call(&method("Confirm", &normal, "repaired")), "Good");
    bert.sees(&json!({"active": false, "confirmed": true, "retain": false, "comment": "repaired"}));
    // The nodes of the condition show its state.
    let node = |path: &str| read(&cell, &format!("ns=1;s=ua_0_2_30.alarm|{path}"))["value"].clone();
    assert_eq!(node("AckedState.Id"), json!(true));
    assert_eq!(node("ClientUserId"), "anonymous");
    assert_eq!(node("HighHighLimit"), json!(90.0));
}

#[test]
fn conditions_are_refreshed_for_the_subscription_that_asks() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let _server = serving(&cell, ALARMS);
    let mut early = Watcher::start(&cell, &[]);
    write(&cell, "ns=2;i=32", "Boolean", "true");
    let open = json!({"name": "guard", "active": true, "message": "the guard is open"});
    assert_eq!(early.sees(&open)["type"], "i=10637");
    write(&cell, "ns=2;i=33", "Int32", "3");
    let fault = early.sees(&json!({"name": "mode", "severity": 900}));
    assert_eq!(fault["type"], "i=10523");
    assert_eq!(fault["message"], "mode is 3 (fault): alarm");
    write(&cell, "ns=2;i=31", "Int32", "6");
    early.sees(&json!({"name": "pressure", "type": "i=10060", "high": true, "active": true}));
    let before = early.types();
    // The refresh events are no alarms, and have to be named.
    let mut late = Watcher::start(&cell, &["--type", "i=2915", "--type", "i=2130"]);
    assert_eq!(
        late.call(&json!({"refresh": 4_000_000})),
        "BadSubscriptionIdInvalid"
    );
    for (turn, how) in (1..).zip(["refresh", "refresh2"]) {
        assert_eq!(late.call(&json!({how: true})), "Good");
        eventually("the conditions between start and end", SOON, || {
            let types = late.types();
            let types: Vec<&str> = types.iter().map(String::as_str).collect();
            let batches: Vec<&[&str]> = types.split(|one| *one == "i=2788").collect();
            let ends = batches.len() == turn + 1;
            let each = |batch: &&[&str]| batch.first() == Some(&"i=2787") && batch.len() == 4;
            (ends && batches.iter().take(turn).all(each)).then_some(())
        });
    }
    let guard = late.sees(&open);
    assert_eq!(
        early.types(),
        before,
        "another subscription is not refreshed"
    );
    // A disabled condition is not retained, and shows the value again when it is enabled.
    assert_eq!(
        late.call(&json!({"call": "Disable", "condition": guard["condition"]})),
        "Good"
    );
    early.sees(&json!({"name": "guard", "enabled": false, "retain": false}));
    let again = late.call(&json!({"call": "Disable", "condition": guard["condition"]}));
    assert_eq!(again, "BadConditionAlreadyDisabled");
    let disabled = late.call(&method("AddComment", &guard, "later"));
    assert_eq!(disabled, "BadConditionDisabled");
    assert_eq!(
        late.call(&json!({"call": "Enable", "condition": guard["condition"]})),
        "Good"
    );
    early.sees(&json!({"name": "guard", "enabled": true, "active": true, "retain": true}));
    let unknown = json!({"call": "Enable", "condition": "ns=2;i=32"});
    assert_eq!(late.call(&unknown), "BadNodeIdUnknown");
}

#[test]
fn events_of_conditions_have_a_history_at_their_folder() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let _server = serving(&cell, ALARMS);
    for (node, kind, value) in [
        ("ns=2;i=30", "Double", "95"),
        ("ns=2;i=33", "Int32", "3"),
        ("ns=2;i=30", "Double", "75"),
        ("ns=2;i=30", "Double", "20"),
    ] {
        assert_eq!(write(&cell, node, kind, value), "Good");
    }
    let level = [json!("HighHigh"), json!("High"), Value::Null];
    let node = "ns=1;s=UaSpace.Alarms";
    for (count, answers) in [("0", 1), ("2", 2)] {
        // ExclusiveLimitAlarmType; the mode is of another type.
        let arguments = ["--node", node, "--type", "i=9341", "--history", count];
        let arguments = [&[SERVER_ENDPOINT][..], &arguments].concat();
        let mut told = cell.asyncua_once("opcua_alarms.py", &arguments);
        let end = told.pop().unwrap();
        assert_eq!(end["answers"], answers, "{told:?}");
        // SubscribeToEvents and HistoryRead.
        assert_eq!(end["notifier"], 5);
        let limits: Vec<&Value> = told.iter().map(|event| &event["limit"]).collect();
        assert_eq!(limits, level.each_ref(), "{told:?}");
        assert!(
            told.iter().all(|event| event["name"] == "level"),
            "{told:?}"
        );
    }
}

#[test]
fn an_acknowledged_alarm_stays_acknowledged_over_a_restart() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let file = cell.folder().join("history.redb");
    let mapping = ALARMS.replace(
        "server:\n",
        &format!("server:\n  history: {{file: {}}}\n", file.display()),
    );
    let mut server = serving(&cell, &mapping);
    let mut anna = Watcher::start(&cell, &[]);
    assert_eq!(write(&cell, "ns=2;i=30", "Double", "75"), "Good");
    let seen = anna.sees(&json!({"name": "level", "active": true, "acked": false}));
    let acknowledged = anna.call(&method("Acknowledge", &seen, "on my way"));
    assert_eq!(acknowledged, "Good");
    drop(anna);
    server.signal(nix::sys::signal::Signal::SIGTERM);
    assert!(server.wait_for_end(SOON).success());

    let _server = serving(&cell, &mapping);
    let node = |path: &str| read(&cell, &format!("ns=1;s=ua_0_2_30.alarm|{path}"))["value"].clone();
    assert_eq!(node("ActiveState.Id"), json!(true));
    assert_eq!(node("AckedState.Id"), json!(true));
    assert_eq!(node("ConfirmedState.Id"), json!(false));
    // The value is still in alarm, which is nothing new.
    let mut bert = Watcher::start(&cell, &[]);
    assert_eq!(write(&cell, "ns=2;i=30", "Double", "76"), "Good");
    let seen = bert.sees(&json!({"name": "level", "acked": true, "comment": "on my way"}));
    assert_eq!(bert.call(&method("Confirm", &seen, "")), "Good");
    assert_eq!(write(&cell, "ns=2;i=30", "Double", "95"), "Good");
    bert.sees(&json!({"limit": "HighHigh", "acked": false}));
}

#[test]
fn node_opcua_lists_and_acknowledges_the_alarm_that_was_active_before() {
    let Some(cell) = Cell::with(&[Peer::Python, Peer::NodeOpcua]) else {
        return;
    };
    let _server = serving(&cell, ALARMS);
    write(&cell, "ns=2;i=32", "Boolean", "true");
    let lines = cell.node_opcua_once("alarms.js", &[SERVER_ENDPOINT, "ns=2;i=32"]);
    let first = lines.iter().find(|line| line.get("condition").is_some());
    let first = first.unwrap_or_else(|| panic!("{lines:?}"));
    assert_eq!(first["message"], "the guard is open");
    assert_eq!(
        [&first["active"], &first["acked"]],
        [&json!(true), &json!(false)]
    );
    assert!(
        lines.iter().any(|line| line["acknowledge"] == "Good"),
        "{lines:?}"
    );
    let last = lines.iter().rfind(|line| line["acked"] == true);
    let last = last.unwrap_or_else(|| panic!("{lines:?}"));
    assert_eq!(last["comment"], "seen by node-opcua");
}

/// The diagnostics of a robot of ROS 1.
const ROBOT: &str = "
namespaces:
  2: urn:ua-bridge:system-tests
spaces:
  - {id: 1}
variables:
  - node: ns=2;i=40
    name: diagnostics
    origin: 1
    ros: {topic: /diagnostics, type: diagnostic_msgs/DiagnosticArray}
    alarm: {diagnostics: true}
server:
  security: [None]
  publisher_alarms: true
";

#[test]
fn the_diagnostics_of_a_robot_are_conditions_and_so_is_the_loss_of_its_bridge() {
    let Some(cell) = Cell::with(&[Peer::Ros1, Peer::Python]) else {
        return;
    };
    let _master = cell.roscore();
    let _server = serving(&cell, ROBOT);
    let mut watcher = Watcher::start(&cell, &[]);
    let bridge = cell.bridge_ros1(&[&cell.file("server.yaml", ROBOT).display().to_string()]);
    let robot = cell.rospy_started("ros1_diagnostics.py", &["/diagnostics"]);
    let mut robot = robot.told().start().ready(SOON);
    let mut says = |level: u8, message: &str| {
        let motor = json!({"level": level, "name": "motor 3", "message": message, "hardware_id": "arm-7",
                           "values": {"temperature": "91"}});
        let fine =
            json!({"level": 0, "name": "motor 4", "message": "fine", "hardware_id": "arm-7"});
        robot.tell(&json!([motor, fine]).to_string());
    };
    says(2, "over temperature");
    let hot = watcher.sees(&json!({"name": "arm-7: motor 3", "active": true}));
    assert_eq!(hot["type"], "i=18496");
    assert_eq!(hot["message"], "error: over temperature; temperature: 91");
    assert_eq!(
        [&hot["severity"], &hot["source"]],
        [&json!(750), &json!("ns=2;i=40")]
    );
    assert_eq!(watcher.call(&method("Acknowledge", &hot, "")), "Good");
    says(0, "cooled down");
    watcher.sees(&json!({"name": "arm-7: motor 3", "active": false, "retain": false}));
    let message = "ns=1;s=ua_1_2_40.alarm/arm-7/motor 3|Message";
    let shown = read(&cell, message)["value"].to_string();
    assert!(shown.contains("OK: cooled down"), "{shown}");
    drop(bridge);
    let lost = json!({"name": "ROS 1: publisher lost", "active": true});
    assert_eq!(watcher.sees(&lost)["type"], "i=11753");
    let lines = watcher.0.json_lines();
    let names = lines.iter().filter_map(|line| line.get("name"));
    let others = names.filter(|name| **name != "arm-7: motor 3" && **name != lost["name"]);
    assert_eq!(others.count(), 0, "nothing else is an alarm: {lines:?}");
}

/// The conditions of the server as diagnostics for ROS 1.
const REPORTED: &str = "
namespaces:
  2: urn:ua-bridge:system-tests
spaces:
  - {id: 1}
variables:
  - {node: ns=2;i=30, name: level, type: Double, origin: 0, alarm: {high: 70, severity: 700}}
  - node: ns=2;i=90
    name: diagnostics
    origin: 0
    reports: alarms
    ros: {space: 1, topic: /cell/diagnostics, type: diagnostic_msgs/DiagnosticArray}
calls:
  - node: ns=2;i=91
    name: Alarms.Acknowledge
    origin: 0
    acknowledges: alarms
    ros:
      space: 1
      service: /cell/acknowledge
      type: roscpp/SetLoggerLevel
      request: {event_id: {field: logger}, comment: {field: level}}
server:
  security: [None]
";

#[test]
fn the_conditions_of_the_server_are_diagnostics_of_ros() {
    let Some(cell) = Cell::with(&[Peer::Ros1, Peer::Python]) else {
        return;
    };
    let _master = cell.roscore();
    let _server = serving(&cell, REPORTED);
    let _bridge = cell.bridge_ros1(&[&cell.file("server.yaml", REPORTED).display().to_string()]);
    let mut tool = cell.rospy("ros1_diagnostics.py", &["/cell/diagnostics", "--hear"]);
    let status = |level: u8, acknowledged: &str| {
        let acknowledged = acknowledged.to_owned();
        move |line: &Value| {
            let is_level = line["name"] == "level" && line["level"] == level;
            let values = &line["values"];
            (is_level && values["acknowledged"] == acknowledged.as_str()).then(|| line.clone())
        }
    };
    write(&cell, "ns=2;i=30", "Double", "50");
    tool.wait_for_json("the condition is fine", SOON, status(0, "true"));
    write(&cell, "ns=2;i=30", "Double", "75");
    let high = tool.wait_for_json("the condition is an error", SOON, status(2, "false"));
    assert_eq!(high["message"], "level is 75: High");
    assert_eq!(high["values"]["severity"], "700");
    // The request has the id of the event, and a comment. An unknown id acknowledges nothing.
    let values = [json!("00ff"), high["values"]["event_id"].clone()]
        .map(|event| json!({"logger": event, "level": "on my way"}).to_string());
    let service = ["/cell/acknowledge", "roscpp/SetLoggerLevel"];
    let values = values
        .each_ref()
        .map(|value| ["--value", value.as_str()])
        .concat();
    let mut robot = cell.rospy("ros1_call.py", &[&service[..], &values].concat());
    eventually("both responses", SOON, || {
        let lines = robot.json_lines();
        let answers = lines.iter().filter(|line| line.get("value").is_some());
        (answers.count() == 2).then_some(())
    });
    assert!(robot.wait_for_end(SOON).success());
    tool.wait_for_json("the alarm is acknowledged", SOON, status(2, "true"));
    let user = read(&cell, "ns=1;s=ua_0_2_30.alarm|ClientUserId");
    assert_eq!(user["value"], "space 1");
    // Clients cannot write values of the server itself.
    let refused = write(&cell, "ns=2;i=90", "Double", "1");
    assert_eq!(refused, "BadNotWritable");
}
