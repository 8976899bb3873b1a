//! Tests services as values: successful, repeated and omitted calls, and their results.

use std::sync::{Arc, Mutex};
use std::time::Duration;

use bridge_node::{Port, PortEvent};
use bytes::Bytes;
use messages::{Dialect, TypeRegistry};
use tcpros::{Node, ServiceOptions, ServiceServer, ServiceTypeSum};
use tokio::time::timeout;

use crate::{Cell, cell, delivery, line, within};

const SERVICES: &str = "
spaces:
  - {id: 1}
namespaces:
  2: urn:test
variables:
  - {node: ns=2;i=1, name: Light, type: Boolean, origin: 0, queue: keep_latest, ros: {space: 1, call: /light, type: std_srvs/SetBool, field: data}}
  - {node: ns=2;i=2, name: Said, origin: 1, ros: {answer: ns=2;i=1, field: message}}
  - {node: ns=2;i=3, name: Go, type: Boolean, origin: 0, queue: keep_latest, ros: {space: 1, call: /go, type: std_srvs/Trigger}}
  - {node: ns=2;i=4, name: Beep, type: Boolean, origin: 0, queue: {drop_oldest: 4}, ros: {space: 1, call: /light, type: std_srvs/SetBool, field: data}}
  - {node: ns=2;i=5, name: Told, origin: 1, ros: {poll: /ask, type: std_srvs/Trigger, every: 50ms, field: message}}
";

/// The response of SetBool and Trigger: success, and a text of two letters.
const FINE: &[u8] = &[1, 2, 0, 0, 0, b'o', b'k'];
/// Longer than the delays before the second and third attempt together.
const A_WHILE: Duration = Duration::from_millis(1500);

/// Offers a service of the robot, and records its requests.
pub(crate) fn offer(
    node: &Node,
    service: &str,
    name: &str,
) -> (ServiceServer, Arc<Mutex<Vec<Bytes>>>) {
    let found = TypeRegistry::bundle(Dialect::Ros1)
        .service(&name.parse().unwrap())
        .unwrap();
    let service_type = ServiceTypeSum {
        name: name.to_owned(),
        md5sum: found.md5().to_owned(),
        request_type: found.request().name().to_string(),
        response_type: found.response().name().to_string(),
    };
    let requests: Arc<Mutex<Vec<Bytes>>> = Arc::default();
    let heard = Arc::clone(&requests);
    let answer = move |request: tcpros::ServiceRequest| {
        heard.lock().unwrap().push(request.bytes);
        async { Ok(Bytes::from_static(FINE)) }
    };
    let server = node.advertise_service(service, service_type, ServiceOptions::default(), answer);
    (server.unwrap(), requests)
}

/// Returns the next event with both parts in its line.
pub(crate) async fn event(cell: &mut Cell, topic: &str, part: &str) -> String {
    within(&format!("{topic} {part}"), async {
        loop {
            let line = line(&cell.port.recv().await);
            if line.starts_with(topic) && line.contains(part) {
                return line;
            }
        }
    })
    .await
}

/// Runs the port for a while.
async fn for_a_while(cell: &mut Cell) {
    let run = async {
        loop {
            drop::<PortEvent>(cell.port.recv().await);
        }
    };
    assert!(timeout(A_WHILE, run).await.is_err());
}

#[tokio::test]
async fn a_state_is_tried_until_its_service_comes_and_the_answer_is_a_value() {
    let mut cell = cell(SERVICES);
    event(&mut cell, "ua_0_2_1", " is ").await;
    cell.port.publish(delivery("ua_0_2_1", &[1])).unwrap();
    let told = event(&mut cell, "ua_0_2_1", "call failed").await;
    assert!(
        told.contains("/light") && told.contains("trying again"),
        "{told}"
    );
    let (_server, requests) = offer(&cell.node, "/light", "std_srvs/SetBool");
    event(&mut cell, "ua_1_2_2", "live true").await;
    let answer = event(&mut cell, "ua_1_2_2", " = ").await;
    assert!(answer.contains("ok"), "{answer}");
    for_a_while(&mut cell).await;
    assert_eq!(*requests.lock().unwrap(), [Bytes::from_static(&[1])]);
}

#[tokio::test]
async fn a_value_that_calls_nothing_ends_what_is_tried_for_one_before_it() {
    let mut cell = cell(SERVICES);
    event(&mut cell, "ua_0_2_3", " is ").await;
    cell.port.publish(delivery("ua_0_2_3", &[1])).unwrap();
    event(&mut cell, "ua_0_2_3", "trying again").await;
    cell.port.publish(delivery("ua_0_2_3", &[0])).unwrap();
    let (_server, requests) = offer(&cell.node, "/go", "std_srvs/Trigger");
    for_a_while(&mut cell).await;
    assert_eq!(
        requests.lock().unwrap().len(),
        0,
        "it is not to go any more"
    );
    cell.port.publish(delivery("ua_0_2_3", &[1])).unwrap();
    for_a_while(&mut cell).await;
    assert_eq!(*requests.lock().unwrap(), [Bytes::new()]);
}

#[tokio::test]
async fn an_event_is_called_for_once() {
    let mut cell = cell(SERVICES);
    event(&mut cell, "ua_0_2_4", " is ").await;
    cell.port.publish(delivery("ua_0_2_4", &[1])).unwrap();
    let told = event(&mut cell, "ua_0_2_4", "call failed").await;
    assert!(!told.contains("trying again"), "{told}");
    let (_server, requests) = offer(&cell.node, "/light", "std_srvs/SetBool");
    for_a_while(&mut cell).await;
    assert_eq!(requests.lock().unwrap().len(), 0);
}

#[tokio::test]
async fn a_polled_value_lives_while_its_service_answers() {
    let mut cell = cell(SERVICES);
    event(&mut cell, "ua_1_2_5", "call failed").await;
    let (server, _requests) = offer(&cell.node, "/ask", "std_srvs/Trigger");
    event(&mut cell, "ua_1_2_5", "live true").await;
    for _ in 0..3 {
        event(&mut cell, "ua_1_2_5", " = ").await;
    }
    drop(server);
    event(&mut cell, "ua_1_2_5", "live false").await;
}
