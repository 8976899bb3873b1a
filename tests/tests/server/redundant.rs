//! Two redundant servers, as asyncua sees them.

use system_tests::{METRICS_SERVER, StartedChild, metrics, program};

use super::*;

const MAPPING: &str = "
namespaces: {2: urn:ua-bridge:system-tests}
spaces: [{id: 2}]
variables:
  - {node: ns=2;i=10, name: temperature, type: Double, origin: 2}
  - {node: ns=2;i=30, name: setpoint, type: Double, origin: 0}
server:
  security: [None]
  redundant: [\"urn:cell:server-1\", \"urn:cell:server-2\"]
";
const ENDPOINTS: [&str; 2] = [SERVER_ENDPOINT, "opc.tcp://127.0.0.1:48499"];
const METRICS: [&str; 2] = [METRICS_SERVER, "127.0.0.1:9113"];
const SERVICE_LEVEL: &str = "i=2267";
const REDUNDANCY_SUPPORT: &str = "i=3709";
const SERVER_REDUNDANCY: &str = "i=2296";
const REDUNDANT_SERVER_ARRAY: &str = "i=11313";
const SERVER_URI_ARRAY: &str = "i=11314";
const SETPOINT: &str = "ns=2;i=30";

fn start(cell: &Cell, at: usize, mapping: &str) -> Child {
    let rank = ["1", "2"][at];
    StartedChild::new("ua-server", &program("ua-server"))
        .args([mapping, "--rank", rank])
        .args(["--pki".into(), cell.folder().join(format!("pki{rank}"))])
        .args(["--interface", "lo", "--metrics", METRICS[at]])
        .start()
}

fn value(cell: &Cell, at: usize, node: &str) -> Option<Value> {
    let read = cell.asyncua_try("opcua_read.py", &[ENDPOINTS[at], node])?;
    Some(read.first()?["value"].clone())
}

/// Returns the ServiceLevels that a server shows of all servers; `None` while it shows others.
fn levels_at(cell: &Cell, at: usize) -> Option<[u8; 2]> {
    let servers = value(cell, at, REDUNDANT_SERVER_ARRAY)?;
    let level = |of: usize| {
        let shown = servers[of].as_str()?;
        assert!(shown.contains(&format!("'urn:cell:server-{}'", of + 1)));
        let (_, level) = shown.split_once("ServiceLevel=")?;
        level.split(',').next()?.parse::<u8>().ok()
    };
    Some([level(0)?, level(1)?])
}

fn role(at: usize) -> Option<Value> {
    Some(metrics(METRICS[at])?["redundancy"]["role"].clone())
}

fn written(cell: &Cell, at: usize, value: &str) -> Value {
    let args = [ENDPOINTS[at], SETPOINT, "Double", value];
    cell.asyncua_once("opcua_write.py", &args)[0]["status"].clone()
}

/// Waits until a server is active and the other is standby. Returns the active server.
fn settled() -> usize {
    eventually("one server is active, the other is standby", SOON, || {
        let roles = [role(0)?, role(1)?];
        let active = roles.iter().position(|role| role == "active")?;
        (roles[1 - active] == "standby").then_some(active)
    })
}

/// Checks that a server describes the redundant set.
fn assert_described(cell: &Cell, at: usize) {
    eventually("the server describes its redundancy", SOON, || {
        (value(cell, at, REDUNDANCY_SUPPORT)? == 3).then_some(())
    });
    let uris = value(cell, at, SERVER_URI_ARRAY);
    assert_eq!(
        uris,
        Some(json!(["urn:cell:server-1", "urn:cell:server-2"]))
    );
    let own = value(cell, at, "i=2254").unwrap();
    assert_eq!(own[0], format!("urn:cell:server-{}", at + 1));
    let args = [ENDPOINTS[at], SERVER_REDUNDANCY, "--children"];
    let below = cell.asyncua_once("opcua_read.py", &args).remove(0);
    let names = below["names"].as_array().unwrap();
    assert!(names.contains(&json!("ServerUriArray")), "{below}");
    // A client of one server finds the endpoints of all of them.
    let args = ["find-servers", ENDPOINTS[at]];
    let found = cell.asyncua_once("opcua_discovery.py", &args).remove(0);
    let found = found["registered"].as_array().unwrap();
    let found = found.iter().map(|server| {
        let url = server["urls"][0].as_str().unwrap_or_default();
        let uri = server["uri"].as_str().unwrap_or_default();
        (uri.to_owned(), url.trim_end_matches('/').to_owned())
    });
    let mut found: Vec<_> = found.collect();
    found.sort();
    let server = |of: usize| {
        (
            format!("urn:cell:server-{}", of + 1),
            ENDPOINTS[of].to_owned(),
        )
    };
    assert_eq!(found, [server(0), server(1)]);
}

#[test]
fn a_client_finds_the_active_server_by_the_service_level_and_a_standby_refuses_writes() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let endpoints = format!("  redundant_endpoints: {ENDPOINTS:?}\n");
    let mapping = cell.file("redundant.yaml", &format!("{MAPPING}{endpoints}"));
    let mapping = mapping.to_str().unwrap();
    let mut servers = [
        Some(start(&cell, 0, mapping)),
        Some(start(&cell, 1, mapping)),
    ];
    let _first = settled();
    for at in [0, 1] {
        assert_described(&cell, at);
    }
    // The roles may change at any time on a busy machine.
    eventually("the levels show the roles", SOON * 2, || {
        let active = settled();
        let levels = [active, 1 - active].map(|at| value(&cell, at, SERVICE_LEVEL));
        let is_shown = levels == [Some(json!(255)), Some(json!(199))];
        let of_all = [[255, 199], [199, 255]][active];
        let is_known = (0..2).all(|at| levels_at(&cell, at) == Some(of_all));
        (is_shown && is_known).then_some(())
    });
    // Both show the values of the space.
    let group = UadpSocket::join();
    group.send(&key_frame(TEMPERATURE, 1, 21.5, DataSetHeader::default()));
    for at in [0, 1] {
        eventually("the server shows the value", SOON, || {
            (value(&cell, at, TEMPERATURE_NODE)? == 21.5).then_some(())
        });
    }
    let active = eventually("the active server alone takes a write", SOON * 2, || {
        let active = settled();
        let is_refused = written(&cell, 1 - active, "7") == "BadInvalidState";
        (is_refused && written(&cell, active, "5") == "Good").then_some(active)
    });
    let standby = 1 - active;
    // The standby takes over, and has the values.
    let mut ended = servers[active].take().unwrap();
    ended.signal(nix::sys::signal::Signal::SIGKILL);
    ended.wait_for_end(SOON);
    eventually("the standby is active", SOON, || {
        (role(standby)? == "active").then_some(())
    });
    eventually("it shows that the other server is lost", SOON, || {
        (levels_at(&cell, standby)?[active] == 0).then_some(())
    });
    let mut sequence = 1;
    eventually("its level shows it", SOON, || {
        // A space with silent writers has a low level.
        sequence += 1;
        let value_of = key_frame(TEMPERATURE, sequence, 21.5, DataSetHeader::default());
        group.send(&value_of);
        (value(&cell, standby, SERVICE_LEVEL)? == 255).then_some(())
    });
    assert_eq!(value(&cell, standby, TEMPERATURE_NODE), Some(json!(21.5)));
    assert_eq!(written(&cell, standby, "8"), "Good");
}
