//! rosrust as an independent ROS 1 implementation: publishes, subscribes or relays
//! `std_msgs/String`, calls or serves `std_srvs/SetBool`.
//!
//! `rosrust-peer pub TOPIC VALUE..` sends the values ten times a second; `rosrust-peer sub TOPIC`
//! prints a JSON line per message; `rosrust-peer relay IN OUT` forwards the bytes of each message;
//! `rosrust-peer serve SERVICE` answers `done` to true and fails at false. All four end on SIGTERM,
//! and by themselves after two minutes, the relay after thirty. `rosrust-peer call SERVICE` calls
//! with true and with false, prints a JSON line for each, and ends.

use std::{
    io::Write,
    time::{Duration, Instant},
};

use rosrust::{Message, RawMessage, RawMessageDescription, RosMsg, ServicePair};
use serde_json::{Value, json};

const LIMIT: Duration = Duration::from_secs(120);
const RELAY_LIMIT: Duration = Duration::from_secs(1800);
const QUEUE: usize = 1000;
const PERIOD: Duration = Duration::from_millis(100);
const POLL: Duration = Duration::from_millis(20);

fn main() {
    let args = rosrust::args();
    match args.get(1..).unwrap_or_default() {
        [verb, topic, values @ ..] if verb == "pub" => publish(topic, values),
        [verb, topic] if verb == "sub" => subscribe(topic),
        [verb, from, to] if verb == "relay" => relay(from, to),
        [verb, service] if verb == "serve" => serve(service),
        [verb, service] if verb == "call" => call(service),
        _ => {
            eprintln!(
                "usage: rosrust-peer pub TOPIC VALUE.. | sub TOPIC | relay IN OUT | serve SERVICE | call SERVICE"
            );
            std::process::exit(64);
        }
    }
}

fn publish(topic: &str, values: &[String]) {
    rosrust::init("rosrust_pub");
    let publisher =
        rosrust::publish_with_description::<RawMessage>(topic, 100, description()).unwrap();
    say(&json!({ "ready": topic }));
    let start = Instant::now();
    while rosrust::is_ok() && start.elapsed() < LIMIT {
        for value in values {
            publisher.send(RawMessage(to_bytes(value))).unwrap();
        }
        std::thread::sleep(PERIOD);
    }
}

fn subscribe(topic: &str) {
    rosrust::init("rosrust_sub");
    let name = topic.to_owned();
    let subscriber =
        rosrust::subscribe_with_ids(topic, QUEUE, move |message: RawMessage, id: &str| {
            say(
                &json!({ "topic": name, "callerid": id, "value": { "data": to_text(&message.0) } }),
            );
        })
        .unwrap();
    say(&json!({ "ready": topic }));
    stay(LIMIT);
    drop(subscriber);
}

fn relay(from: &str, to: &str) {
    rosrust::init("rosrust_relay");
    let publisher =
        rosrust::publish_with_description::<RawMessage>(to, QUEUE, description()).unwrap();
    let subscriber = rosrust::subscribe(from, QUEUE, move |message: RawMessage| {
        publisher.send(message).unwrap();
    })
    .unwrap();
    say(&json!({ "ready": to }));
    stay(RELAY_LIMIT);
    drop(subscriber);
}

fn serve(service: &str) {
    rosrust::init("rosrust_server");
    let handle = |on: bool| match on {
        true => Ok(RawMessage([&[1][..], &to_bytes("done")].concat())),
        false => Err("the valve is stuck".to_owned()),
    };
    let server = rosrust::service::<SetBool, _>(service, handle).unwrap();
    say(&json!({ "ready": service }));
    stay(LIMIT);
    drop(server);
}

fn call(service: &str) {
    rosrust::init("rosrust_client");
    rosrust::wait_for_service(service, Some(LIMIT)).unwrap();
    say(&json!({ "ready": service }));
    let client = rosrust::client::<SetBool>(service).unwrap();
    for on in [true, false] {
        match client.req(&on).unwrap() {
            Ok(answer) => say(&json!({ "value": to_text(&answer.0[1..]) })),
            Err(error) => say(&json!({ "error": error })),
        }
    }
}

/// `std_srvs/SetBool` with its response as bytes.
#[derive(Clone, Debug, Default, PartialEq)]
struct SetBool;

impl RosMsg for SetBool {
    fn encode<W: Write>(&self, _: W) -> std::io::Result<()> {
        Ok(())
    }

    fn decode<R: std::io::Read>(_: R) -> std::io::Result<Self> {
        Ok(Self)
    }
}

impl Message for SetBool {
    fn msg_definition() -> String {
        String::new()
    }

    fn md5sum() -> String {
        "09fb03525b03e7ea1fd3992bafd87e16".to_owned()
    }

    fn msg_type() -> String {
        "std_srvs/SetBool".to_owned()
    }
}

impl ServicePair for SetBool {
    type Request = bool;
    type Response = RawMessage;
}

fn stay(limit: Duration) {
    let start = Instant::now();
    while rosrust::is_ok() && start.elapsed() < limit {
        std::thread::sleep(POLL);
    }
}

fn description() -> RawMessageDescription {
    RawMessageDescription {
        msg_definition: "string data\n".into(),
        md5sum: "992ce8a1687cec8c8bd883ec73ca41d1".into(),
        msg_type: "std_msgs/String".into(),
    }
}

fn to_bytes(text: &str) -> Vec<u8> {
    let length = u32::try_from(text.len()).unwrap();
    [&length.to_le_bytes()[..], text.as_bytes()].concat()
}

fn to_text(body: &[u8]) -> Option<String> {
    let (length, text) = body.split_first_chunk::<4>()?;
    let length = usize::try_from(u32::from_le_bytes(*length)).ok()?;
    String::from_utf8(text.get(..length)?.to_vec()).ok()
}

fn say(line: &Value) {
    let mut out = std::io::stdout().lock();
    writeln!(out, "{line}").and_then(|()| out.flush()).unwrap();
}
