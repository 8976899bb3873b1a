//! Tests the reload of a mapping by a running port.

use std::sync::Arc;
use std::time::Duration;

use bridge_node::Port;
use bytes::Bytes;
use tcpros::{Inbox, RequestedType, SubscriberOptions};
use tokio::time::timeout;

use crate::services::{event, offer};
use crate::{Cell, advertise, cell, delivery, events, line, message, parsed, run_until, types};

/// X and Y of /target are subscribed, Park is published on /park.
const BEFORE: &str = crate::TWO_FIELDS;

/// Returns [`BEFORE`] with one replacement.
fn edited(from: &str, to: &str) -> Arc<mappings::Mapping> {
    assert!(BEFORE.contains(from));
    parsed(&BEFORE.replacen(from, to, 1))
}

impl Cell {
    fn go_over(&mut self, mapping: &Arc<mappings::Mapping>) -> Vec<String> {
        self.port.reload(mapping, &types(mapping))
    }
}

/// Returns the events within a short time, if few or no events are expected.
async fn at_once(cell: &mut Cell) -> Vec<String> {
    let mut lines = Vec::new();
    while let Ok(event) = timeout(Duration::from_millis(100), cell.port.recv()).await {
        lines.push(line(&event));
    }
    lines
}

#[tokio::test]
async fn the_same_mapping_changes_nothing() {
    let mut cell = cell(BEFORE);
    let publisher = advertise(&cell.node, "/target", "geometry_msgs/Point", true);
    let _sent = publisher.publish(Bytes::from_static(b"p"));
    events(&mut cell.port, 7).await;
    assert_eq!(cell.go_over(&parsed(BEFORE)), [""; 0]);
    assert_eq!(at_once(&mut cell).await, [""; 0]);
    let _sent = publisher.publish(Bytes::from_static(b"q"));
    let lines = events(&mut cell.port, 2).await;
    assert_eq!(lines, ["ua_1_2_1 = b\"q\"", "ua_1_2_2 = b\"q\""]);
}

#[tokio::test]
async fn a_value_that_changes_its_field_hears_what_was_latched_and_the_other_hears_nothing_twice() {
    let mut cell = cell(BEFORE);
    let publisher = advertise(&cell.node, "/target", "geometry_msgs/Point", true);
    let _sent = publisher.publish(Bytes::from_static(b"p"));
    events(&mut cell.port, 7).await;
    cell.go_over(&edited("field: y", "field: z"));
    let expected = [
        "ua_1_2_2 unbound",
        "ua_1_2_2 is geometry_msgs/Point z",
        "ua_1_2_2 live true",
        "ua_1_2_2 = b\"p\"",
    ];
    assert_eq!(at_once(&mut cell).await, expected);
}

#[tokio::test]
async fn a_topic_without_values_is_let_go_and_one_that_gets_some_is_read() {
    let mut cell = cell(BEFORE);
    let (old, new) = ("/target", "/goal");
    let publishers = [old, new].map(|t| advertise(&cell.node, t, "geometry_msgs/Point", true));
    for publisher in &publishers {
        let _sent = publisher.publish(Bytes::from_static(b"p"));
    }
    events(&mut cell.port, 7).await;
    assert_eq!(publishers.each_ref().map(|p| p.subscribers()), [1, 0]);
    let text = BEFORE.replace(old, new).replace("field: y", "field: z");
    cell.go_over(&parsed(&text));
    let expected = [
        "ua_1_2_1 unbound",
        "ua_1_2_2 unbound",
        "ua_1_2_1 is geometry_msgs/Point x",
        "ua_1_2_2 is geometry_msgs/Point z",
        "ua_1_2_1 live true",
        "ua_1_2_2 live true",
        "ua_1_2_1 = b\"p\"",
        "ua_1_2_2 = b\"p\"",
    ];
    assert_eq!(events(&mut cell.port, 8).await, expected);
    run_until(&mut cell.port, "the old one is let go", || {
        publishers[0].subscribers() == 0
    })
    .await;
    assert_eq!(publishers[1].subscribers(), 1);
    // The previous mapping is restored, as after a file that was saved too early.
    cell.go_over(&parsed(BEFORE));
    events(&mut cell.port, 8).await;
    assert_eq!(publishers[0].subscribers(), 1);
}

#[tokio::test]
async fn a_topic_that_went_and_came_back_is_read_once_whatever_is_edited_next() {
    let mut cell = cell(BEFORE);
    let publisher = advertise(&cell.node, "/target", "geometry_msgs/Point", false);
    events(&mut cell.port, 5).await;
    cell.go_over(&parsed(&BEFORE.replace("/target", "/goal")));
    events(&mut cell.port, 2).await;
    cell.go_over(&parsed(BEFORE));
    // Both values are bound and live again.
    event(&mut cell, "ua_1_2_1", "live true").await;
    event(&mut cell, "ua_1_2_2", "live true").await;
    for name in ["Stop", "Halt"] {
        cell.go_over(&edited("name: Park", &format!("name: {name}")));
        assert_eq!(at_once(&mut cell).await, [""; 0]);
    }
    let _sent = publisher.publish(Bytes::from_static(b"q"));
    let expected = ["ua_1_2_1 = b\"q\"", "ua_1_2_2 = b\"q\""];
    assert_eq!(events(&mut cell.port, 2).await, expected);
    assert_eq!(at_once(&mut cell).await, [""; 0]);
}

#[tokio::test]
async fn a_topic_that_is_written_may_change_its_type_and_may_come_under_its_own_name() {
    let mut cell = cell(BEFORE);
    assert_eq!(
        events(&mut cell.port, 1).await,
        ["ua_2_2_3 is std_msgs/Bool data"]
    );
    let inbox = &mut Inbox::new();
    let wanted = RequestedType {
        type_name: None,
        md5sum: None,
    };
    let options = SubscriberOptions::default();
    let _heard = cell.node.subscribe("/park", wanted, options, (), inbox);
    cell.port.publish(delivery("ua_2_2_3", b"\x01")).unwrap();
    let heard = message(&mut cell.port, inbox).await;
    assert_eq!(heard.bytes, Bytes::from_static(b"\x01"));

    let other = BEFORE.replace("type: Boolean", "type: Int16");
    let other = parsed(&other.replace("type: std_msgs/Bool", "type: std_msgs/Int16"));
    cell.go_over(&other);
    let stale = cell.port.publish(delivery("ua_2_2_3", b"\x01"));
    assert_eq!(stale, Err("type changes"), "it is still in the old one");
    let lines = at_once(&mut cell).await;
    assert_eq!(
        lines,
        ["ua_2_2_3 unbound", "ua_2_2_3 is std_msgs/Int16 data"]
    );
    cell.port
        .publish(delivery("ua_2_2_3", b"\x02\x00"))
        .unwrap();
    let heard = message(&mut cell.port, inbox).await;
    assert_eq!(heard.peer.header.type_name(), Some("std_msgs/Int16"));

    let begin = BEFORE
        .find("    ros:\n      - {space: 1, topic: /park")
        .unwrap();
    cell.go_over(&parsed(&BEFORE[..begin]));
    assert_eq!(at_once(&mut cell).await, ["ua_2_2_3 unbound"]);
    let refused = cell.port.publish(delivery("ua_2_2_3", b"\x01"));
    assert_eq!(refused, Err("no publisher yet"), "until its type is known");
}

#[tokio::test]
async fn services_are_called_by_the_new_mapping_and_no_longer_by_the_old_one() {
    let service = |name: &str, every: &str| {
        format!(
            "
spaces:
  - {{id: 1}}
namespaces:
  2: urn:test
variables:
  - {{node: ns=2;i=1, name: Light, type: Boolean, origin: 0, queue: keep_latest, ros: {{space: 1, call: {name}, type: std_srvs/SetBool, field: data}}}}
  - {{node: ns=2;i=2, name: Said, origin: 1, ros: {{answer: ns=2;i=1, field: message}}}}
  - {{node: ns=2;i=5, name: Told, origin: 1, ros: {{poll: /ask, type: std_srvs/Trigger, every: {every}, field: message}}}}
"
        )
    };
    let mut cell = cell(&service("/light", "50ms"));
    let (_light, old) = offer(&cell.node, "/light", "std_srvs/SetBool");
    let (_lamp, new) = offer(&cell.node, "/lamp", "std_srvs/SetBool");
    let (_ask, asked) = offer(&cell.node, "/ask", "std_srvs/Trigger");
    event(&mut cell, "ua_0_2_1", " is ").await;
    cell.port.publish(delivery("ua_0_2_1", &[1])).unwrap();
    event(&mut cell, "ua_1_2_2", "=").await;
    event(&mut cell, "ua_1_2_5", "=").await;

    cell.go_over(&parsed(&service("/lamp", "50ms")));
    for line in ["unbound", "is std_srvs/SetBoolRequest"] {
        event(&mut cell, "ua_0_2_1", line).await;
    }
    event(&mut cell, "ua_1_2_2", "is std_srvs/SetBoolResponse").await;
    cell.port.publish(delivery("ua_0_2_1", &[0])).unwrap();
    event(&mut cell, "ua_1_2_2", "=").await;
    let requests = |of: &Arc<std::sync::Mutex<Vec<Bytes>>>| of.lock().unwrap().clone();
    assert_eq!(requests(&old), [Bytes::from_static(&[1])]);
    assert_eq!(requests(&new), [Bytes::from_static(&[0])]);
    // The poll is equal in both mappings and continued.
    event(&mut cell, "ua_1_2_5", "=").await;

    cell.go_over(&parsed(&service("/lamp", "1h")));
    event(&mut cell, "ua_1_2_5", "unbound").await;
    // The new poll calls at once, and the next call does not follow today.
    event(&mut cell, "ua_1_2_5", "=").await;
    let before = requests(&asked).len();
    let later = at_once(&mut cell).await;
    assert_eq!((requests(&asked).len(), later), (before, Vec::new()));
}

#[tokio::test]
async fn a_topic_named_in_the_space_crosses_again_when_the_mapping_has_another_use_for_it_no_more()
{
    let tied = "spaces: [{id: 1}]\nnamespaces: {2: 'urn:test'}\nvariables:\n  - {node: ns=2;i=7, name: A, origin: 1, \
                ros: {topic: /a, type: std_msgs/Bool, field: data}}\n";
    let mut cell = cell(tied);
    let publishers = ["/a", "/ua_1_2_7"].map(|t| advertise(&cell.node, t, "std_msgs/Bool", true));
    let [a, named] = &publishers;
    let _sent = (
        a.publish(Bytes::from_static(b"\x00")),
        named.publish(Bytes::from_static(b"\x01")),
    );
    event(&mut cell, "ua_1_2_7", "= b\"\\0\"").await;
    cell.go_over(&parsed(crate::NOTHING));
    event(&mut cell, "ua_1_2_7", "unbound").await;
    event(&mut cell, "ua_1_2_7", "is std_msgs/Bool whole").await;
    event(&mut cell, "ua_1_2_7", "= b\"\\x01\"").await;
    cell.go_over(&parsed(tied));
    event(&mut cell, "ua_1_2_7", "unbound").await;
    event(&mut cell, "ua_1_2_7", "= b\"\\0\"").await;
    run_until(&mut cell.port, "the other is let go", || {
        named.subscribers() == 0
    })
    .await;
    assert_eq!(a.subscribers(), 1);
}

#[tokio::test]
async fn a_saved_definition_file_counts_from_the_next_reload_on_and_others_do_not_notice() {
    let folder = std::env::temp_dir().join(format!("reload-types-{}", std::process::id()));
    let file = folder.join("geometry_msgs/msg/Point.msg");
    std::fs::create_dir_all(file.parent().unwrap()).unwrap();
    std::fs::write(&file, "float64 x\nfloat64 y\nfloat64 z\n").unwrap();
    let text = format!(
        "spaces: [{{id: 1}}, {{id: 2}}]\nnamespaces: {{2: urn:test}}\ntype_paths: [{}]\nvariables:\n  - {{node: ns=2;i=1, \
         name: Arm, origin: 2, ros: {{space: 1, topic: /arm, type: geometry_msgs/Point}}}}\n  - {{node: ns=2;i=2, name: Other, \
         origin: 2, ros: {{space: 1, topic: /other, type: std_msgs/Bool}}}}\n",
        folder.display()
    );
    let mut cell = cell(&text);
    let lines = events(&mut cell.port, 2).await;
    assert!(
        lines[0].starts_with("ua_2_2_1 is geometry_msgs/Point"),
        "{lines:?}"
    );
    cell.go_over(&parsed(&text));
    assert_eq!(at_once(&mut cell).await, [""; 0]);
    std::fs::write(&file, "float64 x\nfloat64 y\nfloat64 z\nfloat64 w\n").unwrap();
    cell.go_over(&parsed(&text));
    std::fs::remove_dir_all(&folder).unwrap();
    let expected = ["ua_2_2_1 unbound", &lines[0]];
    assert_eq!(at_once(&mut cell).await, expected);
}
