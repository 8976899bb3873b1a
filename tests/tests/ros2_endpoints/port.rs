//! The events of the port and the samples its peers receive.

use std::sync::Arc;
use std::time::{Duration, Instant};

use bridge_node::{LocalDelivery, Port, PortEvent, Reason, TypePaths, ValueRelation};
use bridge_ros2::{Ros2Port, Ros2PortOptions};
use mappings::{Mapping, SpaceId, TopicId};
use nix::sys::signal::Signal;
use ros2_node::limits::PATCHED;
use serde_json::json;
use system_tests::{Cell, Child, Peer};
use uadp::BuiltinType;

use crate::ros2_endpoints::peer::{DOMAIN, SOON, heard, is_string, options, reads, string, writes};

const LATCHED: [&str; 4] = ["--durability", "transient_local", "--depth", "1"];

pub(crate) fn port() -> Ros2Port {
    port_of(Arc::default())
}

pub(crate) fn port_of(mapping: Arc<Mapping>) -> Ros2Port {
    Ros2Port::start(Ros2PortOptions {
        domain: options(),
        own: SpaceId::new(DOMAIN).unwrap(),
        types: types(&mapping),
        mapping,
        prefixes: Vec::new(),
    })
    .unwrap()
}

pub(crate) fn types(mapping: &Mapping) -> Arc<TypePaths> {
    Arc::new(TypePaths::read(mapping.type_paths(), &mut |_| {}))
}

fn reload(port: &mut Ros2Port, mapping: &Arc<Mapping>) -> Vec<String> {
    port.reload(mapping, &types(mapping))
}

pub(crate) fn topic(name: &str) -> TopicId {
    name.parse().unwrap()
}

/// Returns the first event accepted by `wanted` and discards others. Fails after [`SOON`].
pub(crate) async fn event<T>(
    port: &mut Ros2Port,
    mut wanted: impl FnMut(PortEvent) -> Option<T>,
) -> T {
    let deadline = tokio::time::Instant::now() + SOON;
    loop {
        let event = tokio::time::timeout_at(deadline, port.recv())
            .await
            .unwrap();
        if let Some(found) = wanted(event) {
            return found;
        }
    }
}

pub(crate) async fn bound(port: &mut Ros2Port, topic: TopicId) -> String {
    event(port, |event| match event {
        PortEvent::Bound {
            topic: bound,
            message_type,
            ..
        } if bound == topic => Some(message_type.name().to_string()),
        _ => None,
    })
    .await
}

async fn live(port: &mut Ros2Port, topic: TopicId) -> bool {
    event(port, |event| match event {
        PortEvent::Live { topic: of, live } if of == topic => Some(live),
        _ => None,
    })
    .await
}

/// Runs the port until the condition holds. Fails after [`SOON`].
pub(crate) async fn run_until(
    port: &mut Ros2Port,
    what: &str,
    mut condition: impl FnMut() -> bool,
) {
    let deadline = Instant::now() + SOON;
    while !condition() {
        assert!(Instant::now() < deadline, "within {SOON:?} not so: {what}");
        run(port, Duration::from_millis(5)).await;
    }
}

/// Runs the port for a while and discards its events.
async fn run(port: &mut Ros2Port, time: Duration) {
    let until = tokio::time::Instant::now() + time;
    while tokio::time::timeout_at(until, port.recv()).await.is_ok() {}
}

fn last_is(reader: &Child, text: &str) -> bool {
    heard(reader).last().is_some_and(|last| last == text)
}

fn delivery(topic: TopicId, text: &str) -> LocalDelivery {
    LocalDelivery {
        topic,
        payload: string(text).into(),
        source: None,
        status: 0,
        instance: None,
        kept: ValueRelation::Alone,
        lasting: true,
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_topic_of_the_space_crosses_without_configuration_whatever_its_type() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let mut port = port();
    let value = json!({"header": {"stamp": {"sec": 1, "nanosec": 2}, "frame_id": "base"},
                       "name": ["a", "b"], "position": [1.0, 2.0]})
    .to_string();
    let more = ["--wait-readers", "1", "--value", &value];
    let _peer = writes(&cell, "/ua_2_2_3", "sensor_msgs/JointState", &more);
    let topic = topic("ua_2_2_3");
    assert_eq!(bound(&mut port, topic).await, "sensor_msgs/JointState");
    assert!(live(&mut port, topic).await);
    let payload = event(&mut port, |event| match event {
        PortEvent::Sample { payload, .. } => Some(payload),
        _ => None,
    })
    .await;
    assert_eq!(payload[..2], [0, 1]);
    assert_eq!(payload[4..12], [1, 0, 0, 0, 2, 0, 0, 0]);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_topic_whose_publisher_leaves_is_reported_dead() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let mut port = port();
    let mut peer = writes(&cell, "/ua_2_1_1", "std_msgs/Bool", &["--value", "true"]);
    assert!(live(&mut port, topic("ua_2_1_1")).await);
    let left = Instant::now();
    peer.tell("leave");
    assert!(!live(&mut port, topic("ua_2_1_1")).await);
    // By its announcement: the end of its lease would be reported after 10 s.
    assert!(
        left.elapsed() < Duration::from_secs(5),
        "{:?}",
        left.elapsed()
    );
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_value_nobody_asks_for_gets_the_standard_type_and_waits_for_late_joiners() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let mut port = port();
    let topic = topic("ua_1_2_3");
    port.wanted(topic, &[(BuiltinType::String, false)], None);
    assert_eq!(bound(&mut port, topic).await, "std_msgs/String");
    port.publish(delivery(topic, "earlier")).unwrap();
    port.publish(delivery(topic, "latched")).unwrap();
    for _ in 0..2 {
        let peer = reads(&cell, "/ua_1_2_3", "std_msgs/String", &LATCHED);
        run_until(&mut port, "the latched value", || last_is(&peer, "latched")).await;
        assert_eq!(heard(&peer), ["latched"]);
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_subscriber_decides_the_type() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let mut port = port();
    let _decides = reads(&cell, "/ua_0_2_3", "std_msgs/UInt32", &[]);
    // No standard type has two fields, so this topic is bound when its subscriber is discovered,
    // later than the other subscriber.
    let _later = reads(&cell, "/ua_0_2_4", "std_msgs/Bool", &[]);
    let two = [(BuiltinType::Double, false); 2];
    port.wanted(topic("ua_0_2_4"), &two, None);
    assert_eq!(bound(&mut port, topic("ua_0_2_4")).await, "std_msgs/Bool");

    port.wanted(topic("ua_0_2_3"), &[(BuiltinType::Double, false)], None);
    assert_eq!(bound(&mut port, topic("ua_0_2_3")).await, "std_msgs/UInt32");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_subscriber_that_comes_later_changes_the_standard_type() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let mut port = port();
    let topic = topic("ua_0_2_3");
    port.wanted(topic, &[(BuiltinType::Double, false)], None);
    assert_eq!(bound(&mut port, topic).await, "std_msgs/Float64");
    let _peer = reads(&cell, "/ua_0_2_3", "std_msgs/UInt32", &[]);
    assert_eq!(bound(&mut port, topic).await, "std_msgs/UInt32");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_type_without_a_definition_is_counted_and_keeps_nobody_out() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let mut port = port();
    let unheard = topic("ua_2_1_1");
    let _unheard = writes(&cell, "/ua_2_1_1", "nobody_msgs/Unheard", &["--value", "1"]);
    let why = event(&mut port, |event| match event {
        PortEvent::Lost { topic, why, .. } if topic == Some(unheard) => Some(why),
        _ => None,
    })
    .await;
    assert_eq!(why, "type without a definition");
    let _heard = writes(&cell, "/ua_2_1_2", "std_msgs/Bool", &["--value", "true"]);
    assert_eq!(bound(&mut port, topic("ua_2_1_2")).await, "std_msgs/Bool");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn samples_of_another_type_than_the_topics_are_not_handed_up() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let mut port = port();
    let topic = topic("ua_2_1_1");
    let first = ["--repeat", "0", "--rate", "20", "--value", "true"];
    let _first = writes(&cell, "/ua_2_1_1", "std_msgs/Bool", &first);
    assert_eq!(bound(&mut port, topic).await, "std_msgs/Bool");
    let other = ["--repeat", "0", "--rate", "50", "--value", "\"no\""];
    let _other = writes(&cell, "/ua_2_1_1", "std_msgs/String", &other);
    // About two seconds of samples from both writers.
    for _ in 0..40 {
        let payload = event(&mut port, |event| match event {
            PortEvent::Sample { payload, .. } => Some(payload),
            _ => None,
        })
        .await;
        assert_eq!(payload[4], 1, "{payload:?}");
        assert!(payload.len() <= 8, "{payload:?}");
    }
}

/// Returns a mapping of space 2.
fn cell_of(text: &str) -> Arc<Mapping> {
    let text = format!("spaces: [{{id: 1}}, {{id: 2}}]\nnamespaces: {{2: urn:test}}\n{text}");
    Arc::new(Mapping::from_yaml(&text, "cell.yaml").mapping.unwrap())
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_topic_that_becomes_another_value_at_a_reload_loses_and_repeats_no_sample() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let named = |number| {
        cell_of(&format!(
            "variables: [{{node: ns=2;i={number}, name: Read, origin: 2, ros: {{topic: /arm3, type: std_msgs/String}}}}]"
        ))
    };
    let found = "patterns: [{topics: \"/arm*\", node: \"ns=2;i=10{1}\", name: \"Arm{1}\", origin: 2, type: std_msgs/String}]";
    let mut port = port_of(named(1));
    let numbered = ["--numbered", "3000", "--rate", "1000"];
    let more = [&["--wait-readers", "1"], &numbered[..]].concat();
    let _peer = writes(&cell, "/arm3", "std_msgs/String", &more);
    let mut values = Vec::new();
    for number in 0..3000 {
        match number {
            1000 => drop(reload(&mut port, &named(2))),
            2000 => drop(reload(&mut port, &cell_of(found))),
            _ => {}
        }
        let (of, payload) = event(&mut port, |event| match event {
            PortEvent::Sample { topic, payload, .. } => Some((topic, payload)),
            _ => None,
        })
        .await;
        assert!(
            is_string(&payload, &number.to_string()),
            "{number} is {payload:?}"
        );
        if values.last() != Some(&of) {
            values.push(of);
        }
    }
    assert_eq!(values, ["ua_2_2_1", "ua_2_2_2", "ua_2_2_103"].map(topic));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_value_that_waits_for_room_when_its_topic_is_given_up_is_counted() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let mut port = port();
    let of = topic("ua_1_2_3");
    let reader = reads(&cell, "/ua_1_2_3", "std_msgs/String", &LATCHED[..2]);
    port.wanted(of, &[(BuiltinType::String, false)], None);
    assert_eq!(bound(&mut port, of).await, "std_msgs/String");
    port.publish(delivery(of, "before")).unwrap();
    run_until(&mut port, "it hears", || last_is(&reader, "before")).await;
    reader.signal(Signal::SIGSTOP);
    // Without room, a new value replaces a waiting value.
    let refused = (0..10_000).find_map(|number| {
        let refused = port.publish(delivery(of, &number.to_string()));
        refused.err()
    });
    assert_eq!(refused, Some("subscriber too slow"));
    let events =
        "variables: [{node: ns=2;i=3, name: Written, origin: 1, queue: {drop_oldest: 10}}]";
    reload(&mut port, &cell_of(events));
    let lost = event(&mut port, |event| match event {
        PortEvent::Lost {
            topic, why, count, ..
        } => Some((topic, why, count)),
        PortEvent::Unbound { .. } => Some((None, "it is given up", 0)),
        _ => None,
    })
    .await;
    assert_eq!(lost, (Some(of), "the writer of the topic was replaced", 1));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_bad_value_is_not_published() {
    let Some(_cell) = Cell::with(&[]) else {
        return;
    };
    let mut port = port();
    let topic = topic("ua_1_2_3");
    port.wanted(topic, &[(BuiltinType::String, false)], None);
    assert_eq!(bound(&mut port, topic).await, "std_msgs/String");
    let bad = LocalDelivery {
        status: 0x8032,
        instance: None,
        kept: ValueRelation::Alone,
        ..delivery(topic, "stale")
    };
    assert_eq!(port.publish(bad), Err("bad status"));
    assert_eq!(port.publish(delivery(topic, "fresh")), Ok(()));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_thousand_topics_are_advertised_in_batches_and_disposed_within_two_seconds() {
    let Some(_cell) = Cell::with(&[]) else {
        return;
    };
    let mut port = port();
    for n in 1..=1000 {
        let topic = TopicId::new(1, 1, n).unwrap();
        port.wanted(topic, &[(BuiltinType::Boolean, false)], None);
    }
    for _ in 0..1000 {
        event(&mut port, |event| {
            matches!(event, PortEvent::Bound { .. }).then_some(())
        })
        .await;
    }
    let begin = Instant::now();
    port.shutdown().await;
    assert!(
        begin.elapsed() < Duration::from_millis(2100),
        "{:?}",
        begin.elapsed()
    );
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_subscriber_that_is_killed_does_not_keep_values_from_the_others() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let mut port = port();
    let topic = topic("ua_1_2_3");
    let mut killed = reads(&cell, "/ua_1_2_3", "std_msgs/String", &LATCHED[..2]);
    let other = reads(&cell, "/ua_1_2_3", "std_msgs/String", &LATCHED[..2]);
    port.wanted(topic, &[(BuiltinType::String, false)], None);
    assert_eq!(bound(&mut port, topic).await, "std_msgs/String");
    port.publish(delivery(topic, "before")).unwrap();
    run_until(&mut port, "both hear", || {
        last_is(&killed, "before") && last_is(&other, "before")
    })
    .await;
    killed.signal(Signal::SIGKILL);
    killed.wait_for_end(SOON);
    // More values than the send window holds, over a longer time than a reader may be silent
    // before.
    let numbers: Vec<String> = (0..600).map(|number| number.to_string()).collect();
    let mut refused = 0;
    for number in &numbers {
        refused += u32::from(port.publish(delivery(topic, number)).is_err());
        run(&mut port, Duration::from_millis(3)).await;
    }
    run_until(&mut port, "the newest value", || last_is(&other, "599")).await;
    // RustDDS as published stops, and another writer continues with the newest value.
    assert_eq!(refused > 0, !PATCHED);
    if PATCHED {
        let expected = [&["before".to_owned()], &numbers[..]].concat();
        assert_eq!(heard(&other), expected);
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn made_up_values_keep_out_none_that_speaks_when_they_have_fallen_silent() {
    let Some(_cell) = Cell::with(&[]) else {
        return;
    };
    let mut port = port();
    let made_up = |number: u16| TopicId::new(9, 1, number + 1).unwrap();
    // Values with two fields have no standard type, so their topics create nothing in the domain.
    let no_type = [(BuiltinType::Double, false); 2];
    for number in 0..4096 {
        port.wanted(made_up(number), &no_type, None);
    }
    let (robot, boolean) = (topic("ua_9_2_1"), [(BuiltinType::Boolean, false)]);
    port.wanted(robot, &boolean, None);
    let refused = event(&mut port, |event| match event {
        PortEvent::Dropped { reason, .. } => Some(reason),
        _ => None,
    });
    assert_eq!(refused.await, Reason::TooManyTopics);
    port.silent(made_up(7), true);
    let deadline = tokio::time::Instant::now() + SOON;
    let mut gone = Vec::new();
    loop {
        // The Router requests the topic again while values arrive.
        port.wanted(robot, &boolean, None);
        let soon = tokio::time::Instant::now() + Duration::from_millis(50);
        match tokio::time::timeout_at(soon, port.recv()).await {
            Ok(PortEvent::Bound { topic, .. }) if topic == robot => break,
            Ok(PortEvent::Unbound { topic }) => gone.push(topic),
            Ok(_) | Err(_) => {}
        }
        assert!(tokio::time::Instant::now() < deadline, "it is not written");
    }
    assert_eq!(gone, [made_up(7)]);
}
