//! Calls of the space as Methods of the server: an OPC UA client calls services of ROS.

use std::time::{Duration, Instant};

use nix::sys::signal::Signal;
use serde_json::{Value, json};
use system_tests::{
    Cell, Child, Counting, Distribution, Executes, Executor, METRICS_SERVER, Peer, SERVER_ENDPOINT,
    StartedChild, eventually, metrics, program,
};

/// The time that rospy, rclpy and asyncua need to start on a busy machine.
const SOON: Duration = Duration::from_secs(60);
const MAPPING: &str = "
spaces: [{id: 1}, {id: 2, domain: 2}]
namespaces: {2: 'urn:test:belt'}
calls:
  - {node: ns=2;i=61, name: Belt.Switch, about: Starts or stops the belt, origin: 1, ros: {service: /belt, type: std_srvs/SetBool}}
";

fn line(client: &mut Child, key: &str) -> Value {
    client.wait_for_json(key, SOON, |line| line.get(key).map(|_| line.clone()))
}

/// Returns the client's results of `count` calls.
fn answers(client: &mut Child, count: usize) -> Vec<Value> {
    let mut all = Vec::new();
    client.wait_for_json("all answers", SOON, |line| {
        all.extend(line.get("status").map(|_| line.clone()));
        (all.len() == count).then(|| all.clone())
    })
}

#[test]
fn asyncua_calls_a_service_of_rospy_and_is_told_how_it_went() {
    let Some(cell) = Cell::with(&[Peer::Ros1, Peer::Python]) else {
        return;
    };
    let _core = cell.roscore();
    let file = cell.file("cell.yaml", MAPPING);
    let path = file.to_str().unwrap();
    let server = cell.rospy("ros1_serve.py", &["/belt"]);
    let mut bridge = cell.bridge_ros1(&[path]);
    let _ua_server = cell.ua_server(&[path]);
    let method = "UaSpace/Calls/Belt/Switch";
    let values = [
        "[true]",
        "[false]",
        "[]",
        "[true, true]",
        r#"[{"String": "on"}]"#,
    ];
    let mut args = vec![SERVER_ENDPOINT, method, "--gone"];
    for value in values {
        args.extend(["--value", value]);
    }
    let mut client = cell.asyncua_started("opcua_call.py", &args).start();
    let found = line(&mut client, "node");
    assert_eq!(found["node"], "ns=2;i=61");
    // The DataTypes are Boolean (1) and String (12); both arguments are scalars.
    assert_eq!(found["takes"], json!([["data", 1, -1]]));
    assert_eq!(
        found["gives"],
        json!([["success", 1, -1], ["message", 12, -1]])
    );
    let told = answers(&mut client, values.len());
    let wanted = [
        ("Good", json!([true, "done"]), json!([])),
        ("BadUnexpectedError", json!([]), json!([])),
        ("BadArgumentsMissing", json!([]), json!([])),
        ("BadTooManyArguments", json!([]), json!([])),
        ("BadInvalidArgument", json!([]), json!(["BadTypeMismatch"])),
    ];
    for (told, (status, value, arguments)) in told.iter().zip(wanted) {
        let wanted = json!({"status": status, "value": value, "arguments": arguments});
        assert_eq!(*told, wanted);
    }
    // Invalid requests never reached the service.
    assert_eq!(server.values(), [true, false]);
    bridge.end();
    line(&mut client, "gone");
    // The object that contained nothing else is removed, too.
    let object = ["UaSpace/Calls/Belt", "--wait", "0"];
    let args = [&[SERVER_ENDPOINT][..], &object].concat();
    let told = cell.asyncua_once("opcua_call.py", &args);
    assert_eq!(told, [json!({"missing": "UaSpace/Calls/Belt"})]);
}

#[test]
fn asyncua_is_told_that_a_call_takes_too_long_and_that_its_service_fell() {
    let Some(cell) = Cell::with(&[Peer::Ros1, Peer::Python]) else {
        return;
    };
    let _core = cell.roscore();
    let timed = |name: &str, timeout: &str| {
        format!(
            "  - {{node: ns=2;s={name}, alias: {}, name: {name}, origin: 1, timeout: {timeout}, \
             ros: {{service: /{name}, type: std_srvs/Trigger}}}}\n",
            name.len()
        )
    };
    let calls = [timed("Slow", "1s"), timed("Slower", "30s")].concat();
    let mapping =
        format!("spaces: [{{id: 1}}]\nnamespaces: {{2: 'urn:test:belt'}}\ncalls:\n{calls}");
    let file = cell.file("cell.yaml", &mapping);
    let path = file.to_str().unwrap();
    let mut executor = cell.rospy_executor(&["empty=/Slow", "empty=/Slower", "--delay", "1000"]);
    let _bridge = cell.bridge_ros1(&[path]);
    let _ua_server = cell.ua_server(&[path]);
    let asked = |method: &str, patience: &str| {
        let method = format!("UaSpace/Calls/{method}");
        let value = ["--value", "[]", "--patience", patience];
        let args = [&[SERVER_ENDPOINT, &method][..], &value].concat();
        cell.asyncua_started("opcua_call.py", &args).start()
    };
    let mut client = asked("Slow", "20");
    let start = Instant::now();
    assert_eq!(line(&mut client, "status")["status"], "BadTimeout");
    assert!(start.elapsed() < SOON, "{:?}", start.elapsed());
    let mut client = asked("Slower", "40");
    running(&mut executor, 2);
    executor.child().signal(Signal::SIGKILL);
    assert_eq!(line(&mut client, "status")["status"], "BadNoCommunication");
}

fn running(executor: &mut Counting, count: u64) {
    let deadline = Instant::now() + SOON;
    while executor.counts()["running"] != count {
        assert!(Instant::now() < deadline, "{}", executor.counts());
        std::thread::park_timeout(Duration::from_millis(50));
    }
}

#[test]
fn who_executes_is_told_that_a_client_has_given_up_or_gone_and_the_method_moves_when_told() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let mapping = |node: &str, more: &str| {
        format!(
            "spaces: [{{id: 1}}]\nnamespaces: {{2: 'urn:test:belt'}}\n{more}\
             calls: [{{node: {node}, alias: 61, name: Grip, origin: 1, timeout: 1h, \
             ros: {{service: /grip, type: std_srvs/Trigger}}}}]\n"
        )
    };
    let file = cell.file("cell.yaml", &mapping("ns=2;s=Old", ""));
    let path = file.to_str().unwrap();
    let executor = Executor::start((1, 2, 61), "Grip", Executes::Forever, 1);
    let ua_server = cell.ua_server(&[path]);
    let asked = |patience: &str| {
        let value = ["--value", "[]", "--patience", patience];
        let args = [&[SERVER_ENDPOINT, "UaSpace/Calls/Grip"][..], &value].concat();
        cell.asyncua_started("opcua_call.py", &args).start()
    };
    // The call has the timeout that the client sends, not the timeout of the mapping.
    let mut client = asked("8");
    assert_eq!(line(&mut client, "node")["node"], "ns=2;s=Old");
    // The server reports the timeout, or its report is too late.
    client.wait_for_json("it has given up", SOON, |line| {
        let told = line["fault"] == "BadTimeout" || line["given_up"] == true;
        told.then_some(())
    });
    eventually("the first is abandoned", SOON, || {
        (executor.abandoned() == 1).then_some(())
    });
    assert_eq!(executor.executed(), 1);
    drop(executor);
    // A variable gets the node that the Method had.
    let more = "variables: [{node: ns=2;s=Old, alias: 70, name: Load, origin: 1, ros: {topic: /load, type: std_msgs/Float64}}]\n";
    let _ = cell.file("cell.yaml", &mapping("ns=2;s=Grip", more));
    ua_server.signal(Signal::SIGHUP);
    eventually("the mapping is read", SOON, || {
        (metrics(METRICS_SERVER)?["mapping"]["reloads"] == 1).then_some(())
    });
    let executor = Executor::start((1, 2, 61), "Grip", Executes::AtOnce, 1);
    let mut client = asked("20");
    assert_eq!(line(&mut client, "node")["node"], "ns=2;s=Grip");
    assert_eq!(line(&mut client, "status")["status"], "Good");
    let read = cell.asyncua_once("opcua_read.py", &[SERVER_ENDPOINT, "ns=2;s=Old"]);
    assert_eq!(read[0]["status"], "BadWaitingForInitialData", "{read:?}");
    drop(executor);
}

#[test]
fn a_skill_of_a_component_is_started_by_clients_that_know_only_the_server() {
    let Some(cell) = Cell::with(&[Peer::Python, Peer::NodeOpcua]) else {
        return;
    };
    let _ua_server = cell.ua_server(&[]);
    let component = |name: &str, metrics: &str| {
        let plant = concat!(env!("CARGO_MANIFEST_DIR"), "/../examples/plant");
        let args = ["--lds", "none", "--interface", "lo", "--metrics", metrics];
        StartedChild::new("ua-component", &program("ua-component"))
            .args([format!("{plant}/{name}.yaml")])
            .args(args)
            .start()
    };
    let _components = (
        component("parallel-gripper", "127.0.0.1:9855"),
        component("robot", "127.0.0.1:9856"),
    );
    let asked = |method: &str| {
        let method = format!("UaSpace/Calls/parallel-gripper/Grasp/{method}");
        let args = [SERVER_ENDPOINT, &method, "--value", "[]"];
        let mut client = cell.asyncua_started("opcua_call.py", &args).start();
        let takes = line(&mut client, "node")["takes"].clone();
        (takes, line(&mut client, "status"))
    };
    let good = |told: &Value| told["status"] == "Good" && told["value"][0] == true;
    let (takes, told) = asked("Reset");
    assert!(takes == json!([]) && good(&told), "{takes} {told}");
    // Every input of this skill has a default value, so the Method takes no arguments.
    let (takes, told) = asked("Start");
    assert!(takes != json!([]) && good(&told), "{takes} {told}");
    // The inputs of this skill have no default values.
    let asked = |method: &str, values: &[&str]| {
        let method = format!("UaSpace/Calls/robot/PtpMove/{method}");
        let args = [&[SERVER_ENDPOINT, &method], values].concat();
        cell.node_opcua_once("call.js", &args)
    };
    let told = asked("Reset", &["[]"]);
    assert!(good(&told[1]), "{told:?}");
    let told = asked(
        "Start",
        &["[]", r#"[[0.4, 0, 0.2, 0, 0, 0], 0.5, 0.5, "base"]"#],
    );
    let takes = json!([
        ["TargetPosition", 11, 1],
        ["MaxVelocity", 11, -1],
        ["MaxAcceleration", 11, -1],
        ["ToolFrame", 12, -1]
    ]);
    assert_eq!(told[0]["takes"], takes);
    assert_eq!(told[1]["status"], "BadArgumentsMissing");
    assert!(good(&told[2]), "{told:?}");
}

#[test]
fn asyncua_calls_a_service_of_rclpy_that_nobody_mapped() {
    let Some(cell) = Cell::with(&[Peer::Ros2, Peer::Python]) else {
        return;
    };
    let mut judge = cell.judge(Distribution::Jazzy, &["judge"]);
    let answer = json!({"success": true, "message": "weighed"});
    judge.ask(json!({"serve": "/ua_2_2_62", "type": "std_srvs/srv/Trigger", "value": answer}));
    let _bridge = cell.bridge_ros2(&[]);
    let _ua_server = cell.ua_server(&[]);
    // The value of a topic of the same name has a separate node.
    let value = json!({"data": "on the scales"});
    let publish = json!({"publish": "/ua_2_2_62", "type": "std_msgs/msg/String", "value": value});
    let args = [SERVER_ENDPOINT, "ns=1;s=ua_2_2_62"];
    eventually("the value is there", SOON, || {
        judge.ask(publish.clone());
        let read = cell.asyncua_once("opcua_read.py", &args);
        (read[0]["value"] == "on the scales").then_some(())
    });
    let args = [SERVER_ENDPOINT, "UaSpace/Calls/ua_2_2_62", "--value", "[]"];
    let mut client = cell.asyncua_started("opcua_call.py", &args).start();
    let found = line(&mut client, "node");
    assert_eq!(found["node"], "ns=1;s=ua_2_2_62.call");
    assert_eq!(found["takes"], json!([]));
    let told = line(&mut client, "status");
    assert_eq!(
        (&told["status"], &told["value"]),
        (&json!("Good"), &json!([true, "weighed"]))
    );
}

/// The server with Methods that are calls of the space.
const OTHER: &str = "opc.tcp://127.0.0.1:4841";

fn executed(more: &str) -> String {
    let call = |number: u16, name: &str, method: &str, more: &str| {
        let node = "nsu=urn:ua-bridge:system-tests:plc;s=Line";
        format!(
            "  - {{node: ns=3;i={number}, name: Plc.{name}, origin: 0, \
             opcua: {{endpoint: '{OTHER}', object: '{node}', method: '{node}.{method}'}}{more}}}\n"
        )
    };
    let trigger = "service: /plc/move, type: std_srvs/Trigger, \
         request: {TargetPosition: 1.5, speeds: [0.5, 0.25]}, response: {success: true, message: {field: Remark}}";
    let asked = format!(", ros: [{{space: 1, {trigger}}}, {{space: 2, {trigger}}}]");
    let calls = [
        call(80, "Move", "Move", &asked),
        call(81, "Wait", "Wait", ""),
        call(83, "Strange", "Strange", ""),
    ];
    format!(
        "spaces: [{{id: 1}}, {{id: 2}}]\nnamespaces: {{3: 'urn:test:plc-calls'}}\ncalls:\n{}{more}",
        calls.concat()
    )
}

fn reset(number: u16) -> String {
    format!(
        "  - {{node: ns=3;i={number}, name: Plc.Reset, origin: 0, opcua: {{endpoint: '{OTHER}', \
         object: 'nsu=urn:ua-bridge:system-tests:plc;s=Line', \
         method: 'nsu=urn:ua-bridge:system-tests:plc;s=Line.Reset'}}}}\n"
    )
}

/// Starts `ua-space call`, which ends by itself.
fn ua_space_call(words: &[&str]) -> Child {
    StartedChild::new("ua-space", &program("ua-space"))
        .args(["call"])
        .args(words)
        .args([
            "--json",
            "--wait",
            "30",
            "--timeout",
            "30",
            "--interface",
            "lo",
        ])
        .start()
}

/// Waits for the end of a call. Returns the exit code and the printed lines.
fn ended(mut child: Child) -> (i32, Vec<Value>) {
    let code = child.wait_for_end(SOON).code().unwrap();
    (code, child.json_lines())
}

#[test]
fn methods_of_another_server_are_executed_once_for_each_who_asks() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let file = cell.file("cell.yaml", &executed(&reset(82)));
    let path = file.to_str().unwrap();
    let mut ua_server = cell.ua_server(&[path]);
    let mut plc = cell.asyncua("opcua_methods.py", &[OTHER]);
    let (code, told) = ended(ua_space_call(&[
        "ua_0_3_80",
        "TargetPosition=2.5",
        "speeds=0.5,0.25,1",
    ]));
    let fields = json!({"Reached": 5.0, "Remark": "3 axes"});
    assert_eq!((code, &told[0]["fields"]), (0, &fields), "{told:?}");
    let begun = line(&mut plc, "begun");
    assert_eq!(
        begun,
        json!({"begun": "Move", "arguments": [2.5, [0.5, 0.25, 1.0]], "calls": 1})
    );
    // The Method fails with its own StatusCode.
    let args = ["Plc.Move", "TargetPosition=-1", "speeds=1"];
    let (code, told) = ended(ua_space_call(&args));
    let out_of_range = 0x803C_0000_u32;
    assert_eq!(
        (code, &told[0]["status"]),
        (1, &json!(out_of_range)),
        "{told:?}"
    );
    // Two calls at once, which asyncua executes one after the other.
    let both =
        ["1", "1.5"].map(|seconds| ua_space_call(&["Plc.Wait", &format!("seconds={seconds}")]));
    for child in both {
        let (code, told) = ended(child);
        assert_eq!(code, 0, "{told:?}");
    }
    // A Method with a type that no call can carry is logged and not offered.
    ua_server.wait_for_line("which no call has", SOON);
    // The mapping gives a Method another number.
    let _ = cell.file("cell.yaml", &executed(&reset(84)));
    ua_server.signal(Signal::SIGHUP);
    let (code, told) = ended(ua_space_call(&["ua_0_3_84"]));
    assert_eq!(code, 0, "{told:?}");
    // During an execution: the server is lost, the result is unknown, and the Method is not called
    // again.
    let slow = ua_space_call(&["Plc.Wait", "seconds=100"]);
    plc.wait_for_json("the last call", SOON, |line| {
        (line.get("arguments")? == &json!([100.0])).then_some(())
    });
    let begun = |plc: &Child| {
        let lines = plc.json_lines();
        lines.iter().filter_map(|line| line["calls"].as_u64()).max()
    };
    assert_eq!(begun(&plc), Some(6), "{plc}");
    plc.signal(Signal::SIGKILL);
    let (code, told) = ended(slow);
    assert_eq!((code, told), (69, Vec::new()));
    // After a restart: the namespace has another index.
    let plc = cell.asyncua("opcua_methods.py", &[OTHER, "--before", "3"]);
    let (code, told) = ended(ua_space_call(&["Plc.Reset"]));
    assert_eq!(code, 0, "{told:?}");
    assert_eq!(begun(&plc), Some(1), "{plc}");
}

#[test]
fn rospy_and_rclpy_ask_for_a_method_of_another_server_as_a_service() {
    let Some(cell) = Cell::with(&[Peer::Ros1, Peer::Ros2, Peer::Python]) else {
        return;
    };
    let _core = cell.roscore();
    let file = cell.file("cell.yaml", &executed(&reset(82)));
    let path = file.to_str().unwrap();
    let plc = cell.asyncua("opcua_methods.py", &[OTHER]);
    let _ua_server = cell.ua_server(&[path]);
    let _bridges = (cell.bridge_ros1(&[path]), cell.bridge_ros2(&[path]));
    let args = ["/plc/move", "std_srvs/Trigger", "--value", "{}"];
    let mut client = cell.rospy("ros1_call.py", &args);
    let answer = json!({"success": true, "message": "2 axes"});
    assert_eq!(line(&mut client, "value")["value"], answer);
    let mut judge = cell.judge(Distribution::Jazzy, &["judge"]);
    let told = judge.ask(json!({"call": "/plc/move", "type": "std_srvs/srv/Trigger", "value": {}}));
    assert_eq!(told, answer);
    let begun: Vec<Value> = plc
        .json_lines()
        .into_iter()
        .filter(|line| line["begun"] == "Move")
        .collect();
    let begins = |calls| json!({"begun": "Move", "arguments": [1.5, [0.5, 0.25]], "calls": calls});
    assert_eq!(begun, [begins(1), begins(2)]);
}

#[test]
fn asyncua_builds_and_reads_messages_in_arguments_by_the_definitions_of_the_server() {
    let Some(cell) = Cell::with(&[Peer::Ros2, Peer::Python]) else {
        return;
    };
    let mapping = "
spaces: [{id: 2}]
namespaces: {2: 'urn:test:belt'}
calls:
  - {node: ns=2;i=61, name: Set, origin: 2, ros: {service: /judge/judge/set_parameters, type: rcl_interfaces/SetParameters}}
  - {node: ns=2;i=62, name: Get, origin: 2, ros: {service: /judge/judge/get_parameters, type: rcl_interfaces/GetParameters}}
";
    let file = cell.file("cell.yaml", mapping);
    let path = file.to_str().unwrap();
    let _judge = cell.judge(Distribution::Jazzy, &["judge"]);
    let _bridge = cell.bridge_ros2(&[path]);
    let _ua_server = cell.ua_server(&[path]);
    let parameter = json!([{"rcl_interfaces_Parameter": [
        {"name": "use_sim_time", "value": {"type": 1, "bool_value": true}}
    ]}]);
    let asked = |method: &str, value: &Value| {
        let (method, value) = (format!("UaSpace/Calls/{method}"), value.to_string());
        let args = [SERVER_ENDPOINT, &method, "--structures", "--value", &value];
        let mut client = cell.asyncua_started("opcua_call.py", &args).start();
        (line(&mut client, "node"), line(&mut client, "status"))
    };
    let (found, told) = asked("Set", &parameter);
    assert_eq!(
        found["takes"],
        json!([["parameters", "DataType.rcl_interfaces/Parameter", 1]])
    );
    let result = json!({"successful": true, "reason": ""});
    assert_eq!(told["value"], json!([[result]]), "{told}");
    let (_, told) = asked("Get", &json!([["use_sim_time"]]));
    let value = &told["value"][0][0];
    assert_eq!(
        (&value["type"], &value["bool_value"]),
        (&json!(1), &json!(true)),
        "{told}"
    );
}

#[test]
fn asyncua_drives_an_action_of_ros_2_by_its_methods() {
    let Some(cell) = Cell::with(&[Peer::Ros2, Peer::Python]) else {
        return;
    };
    let args = ["serve", "/ua_2_2_70"];
    let server = cell.rclpy_started(Distribution::Kilted, "ros2_rclpy_action.py", &args);
    let mut server = server.told().start().ready(SOON);
    let _bridge = cell.bridge_ros2(&[]);
    let _ua_server = cell.ua_server(&[]);
    let ask = |method: &str, values: &Value| {
        let (method, values) = (format!("UaSpace/Calls/{method}"), values.to_string());
        let args = [
            SERVER_ENDPOINT,
            &method,
            "--value",
            &values,
            "--patience",
            "40",
        ];
        let mut client = cell.asyncua_started("opcua_call.py", &args).start();
        let answer = line(&mut client, "status");
        assert_eq!(answer["status"], "Good", "{method}: {answer}");
        answer["value"].clone()
    };
    let ids = ["01", "02"].map(|byte| byte.repeat(16));
    let accepted = |id: &str, order: i32| ask("ua_2_2_70", &json!([id, order]))[0].clone();
    // The goal reports the first three numbers and runs until it is cancelled.
    assert_eq!(accepted(&ids[0], 100), true);
    assert_eq!(accepted(&ids[1], -1), false);
    eventually("its feedback is shown", SOON, || {
        let told = cell.asyncua_try("opcua_read.py", &[SERVER_ENDPOINT, "ns=1;s=ua_2_2_73"])?;
        // Feedback has two fields: the goal id and the numbers.
        let shown = told[0]["value"].to_string();
        shown.contains("[1, 1, 2]").then_some(())
    });
    let cancelled = ask("ua_2_2_71", &json!([ids[0], "1601-01-01"]));
    assert_eq!(cancelled[0], 0);
    server.wait_for_json("the server agrees", SOON, |line| {
        (line.get("cancel")? == 100).then_some(())
    });
    // The status is CANCELED of action_msgs/GoalStatus; the result has the numbers up to the
    // cancellation.
    let result = ask("ua_2_2_72", &json!([ids[0]]));
    assert_eq!((&result[0], &result[2]), (&json!(5), &json!([1, 1, 2])));
}

#[test]
fn asyncua_drives_an_action_of_ros_2_as_a_program() {
    let Some(cell) = Cell::with(&[Peer::Ros2, Peer::Python]) else {
        return;
    };
    let args = ["serve", "/ua_2_2_70"];
    let server = cell.rclpy_started(Distribution::Kilted, "ros2_rclpy_action.py", &args);
    let _server = server.told().start().ready(SOON);
    let _bridge = cell.bridge_ros2(&[]);
    let _ua_server = cell.ua_server(&[]);
    let program = "UaSpace/Programs/ua_2_2_70";
    let ask = |method: &str, values: &Value| {
        let (method, values) = (format!("{program}/{method}"), values.to_string());
        let args = [
            SERVER_ENDPOINT,
            &method,
            "--value",
            &values,
            "--patience",
            "40",
        ];
        let mut client = cell.asyncua_started("opcua_call.py", &args).start();
        line(&mut client, "status")["status"].clone()
    };
    let shown = |path: &str| {
        let node = format!("ns=1;s=ua_2_2_70.program.{path}");
        let read = cell.asyncua_try("opcua_read.py", &[SERVER_ENDPOINT, &node]);
        read.map_or_else(String::new, |read| {
            read[0]["value"].to_string().replace(" ", "")
        })
    };
    let becomes = |path: &str, value: &str| {
        eventually(path, SOON, || shown(path).contains(value).then_some(()));
    };
    let events = [
        SERVER_ENDPOINT,
        "--events",
        "Transition",
        "--events",
        "Message",
        "ns=1;s=ua_2_2_70.program",
    ];
    // The Program exists as soon as the action exists.
    becomes("CurrentState", "Ready");
    let mut watch = cell.asyncua("opcua_subscribe.py", &events);
    // The goal reports the first three numbers and runs until it is cancelled.
    assert_eq!(ask("Start", &json!([100])), "Good");
    assert!(shown("CurrentState").contains("Running"));
    assert_eq!(ask("Start", &json!([100])), "BadInvalidState");
    becomes("Feedback", "[1,1,2]");
    assert_eq!(ask("Halt", &json!([])), "Good");
    assert!(shown("CurrentState").contains("Halted"));
    let came_out =
        ["Status", "Message", "sequence"].map(|name| shown(&format!("FinalResultData.{name}")));
    assert_eq!(
        came_out,
        ["5", "\"\"", "[1,1,2]"],
        "{:?}",
        cell.asyncua_try(
            "opcua_read.py",
            &[
                SERVER_ENDPOINT,
                "--children",
                "ns=1;s=ua_2_2_70.program.FinalResultData"
            ]
        )
    );
    assert_eq!(ask("Reset", &json!([])), "Good");
    assert_eq!(ask("Start", &json!([-1])), "BadRequestNotAllowed");
    assert!(shown("CurrentState").contains("Ready"));
    assert_eq!(ask("Start", &json!([3])), "Good");
    becomes("CurrentState", "Ready");
    becomes("FinalResultData.Status", "4");
    transitions(&mut watch);
}

/// Waits for the transitions of two goals: the first is cancelled, the second succeeds.
fn transitions(watch: &mut Child) {
    let mut told = Vec::new();
    let told = watch.wait_for_json("all transitions", SOON, |line| {
        told.extend(line.get("event").cloned());
        (told.len() == 5).then(|| told.clone())
    });
    let event =
        |transition: &str, message: &str| json!({"Transition": transition, "Message": message});
    let wanted = [
        event("ReadyToRunning", "the goal is accepted"),
        event("RunningToHalted", "the goal was cancelled"),
        event("HaltedToReady", "HaltedToReady"),
        event("ReadyToRunning", "the goal is accepted"),
        event("RunningToReady", "the goal is reached"),
    ];
    assert_eq!(told, wanted);
}
