//! The events that a client receives if it names event types, as asyncua does.

use super::*;

const AUDIT: &str = "i=2052";
const AUDIT_SESSION: &str = "i=2069";
const ACTIVATE_SESSION: &str = "i=2075";
const AUDIT_UPDATE: &str = "i=2099";
const WRITE_UPDATE: &str = "i=2100";

#[test]
fn a_client_that_names_types_of_events_is_told_of_those_and_of_no_others() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let _server = server(&cell);
    let mut updates = listening(&cell, &[AUDIT_UPDATE]);
    let mut sessions = listening(&cell, &[AUDIT_SESSION]);
    // Each of these events happens together with others between two responses of the server.
    let mut all = listening(&cell, &[AUDIT, "--interval", "2000"]);
    for value in ["1.5", "2.5"] {
        write(&cell, "ns=2;i=30", "Double", value);
    }
    told_of(&mut updates, &[WRITE_UPDATE; 2]);
    told_of(&mut sessions, &[ACTIVATE_SESSION; 2]);
    let pair = [ACTIVATE_SESSION, WRITE_UPDATE];
    told_of(&mut all, &[pair, pair].concat());
}

/// Starts a client that subscribes to events of these types at the Server object.
fn listening(cell: &Cell, args: &[&str]) -> Child {
    let args = [&[SERVER_ENDPOINT], args].concat();
    let mut client = cell.asyncua("opcua_events.py", &args);
    client.wait_for_json("the client listens", SOON, |line| {
        line.get("ready").map(|_| ())
    });
    client
}

/// Waits until the last events that the client received are of these types. All other events must
/// be of these types, too, such as events of the sessions of later clients. The client must have
/// received no value.
fn told_of(client: &mut Child, types: &[&str]) {
    eventually(&format!("{types:?} are told"), SOON, || {
        let lines = client.json_lines();
        let lines = lines.iter().filter(|line| line.get("ready").is_none());
        let told: Vec<&str> = lines.map(|line| line["type"].as_str().unwrap()).collect();
        assert!(told.iter().all(|kind| types.contains(kind)), "{told:?}");
        told.ends_with(types).then_some(())
    });
}
