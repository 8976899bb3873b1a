//! Services as values of the space, with the bridge program.

use serde_json::json;
use system_tests::{Cell, Peer, UaSide, eventually};
use uadp::Scalar;

use crate::ros2_services::peer::{SOON, Vendor, cyclone_serves};

const CELL: &str = "
spaces:
  - {id: 2}
namespaces:
  2: urn:test
variables:
  - {node: ns=2;i=1, name: Light, type: Boolean, origin: 0, ros: {space: 2, call: /light, type: std_srvs/SetBool, field: data}}
  - {node: ns=2;i=2, name: Said, origin: 2, ros: {answer: ns=2;i=1, field: message}}
  - {node: ns=2;i=3, name: Go, type: Boolean, origin: 0, ros: {space: 2, call: /go, type: std_srvs/SetBool, request: {data: true}}}
  - {node: ns=2;i=4, name: Told, origin: 2, ros: {poll: /ask, type: std_srvs/SetBool, every: 100ms, field: message}}
";

#[test]
fn values_call_services_of_both_vendors_and_their_answers_are_values() {
    let Some(cell) = Cell::with(&[Peer::Python, Peer::FastDds]) else {
        return;
    };
    let file = cell.file("cell.yaml", CELL);
    let mut ua = UaSide::join();
    let _bridge = cell.bridge_ros2(&[file.to_str().unwrap()]);
    // Written before the service is available: a state is retried until then.
    ua.write((0, 2, 1), Scalar::Boolean(true));
    let light = Vendor::FastDds.serves(&cell, "/light");
    ua.hear_scalar((2, 2, 2), Scalar::String(Some("done")));
    // The answer may arrive before the server's line about the call.
    eventually("the server has told of the call", SOON, || {
        (!Vendor::FastDds.asked(&light).is_empty()).then_some(())
    });
    assert_eq!(Vendor::FastDds.asked(&light), [true]);

    let go = cyclone_serves(&cell, "/go", &[]);
    ua.write((0, 2, 3), Scalar::Boolean(false));
    ua.write((0, 2, 3), Scalar::Boolean(true));
    eventually("the trigger has called", SOON, || {
        (!go.values().is_empty()).then_some(())
    });
    // False does not call the service.
    assert_eq!(go.values(), [json!({"data": true})]);

    let _ask = cyclone_serves(&cell, "/ask", &[]);
    ua.hear_scalar((2, 2, 4), Scalar::String(Some("done")));
}
