//! A server that connects to its client: asyncua waits for it.

use super::*;

const CLIENT_PORT: &str = "4899";
/// The endpoint that the server names.
const ENDPOINT: &str = "opc.tcp://127.0.0.1:4840/";
const MAPPING: &str = "
namespaces:
  2: urn:ua-bridge:system-tests
variables:
  - {node: ns=2;i=30, name: level, type: Double, origin: 0}
server:
  application_uri: urn:ua-bridge:system-tests:reverse
  security: [None]
  reverse_connect: ['opc.tcp://127.0.0.1:4899']
";

#[test]
fn a_client_uses_the_connection_of_the_server_and_the_server_connects_again() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    // The server tries again while the client does not listen yet.
    let _server = serving(&cell, MAPPING);
    assert_eq!(write(&cell, "ns=2;i=30", "Double", "12.5"), "Good");
    let client = cell.asyncua_started("opcua_reverse.py", &[CLIENT_PORT, "ns=2;i=30"]);
    let mut client = client.start();
    let texts = ["urn:ua-bridge:system-tests:reverse", ENDPOINT];
    let hello = json!({"kind": "RHEF", "texts": texts});
    client.wait_for_json("the ReverseHello", SOON, |line| {
        (*line == hello).then_some(())
    });
    client.wait_for_json("the value", SOON, |line| {
        (line["value"] == json!(12.5)).then_some(())
    });
    client.wait_for_json("the next connection", SOON, |line| {
        (line["again"] == hello).then_some(())
    });
}
