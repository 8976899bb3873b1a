//! Many clients: those that vanish leave nothing behind, and their sessions do not delay the end.

use nix::sys::signal::Signal;
use system_tests::{anonymous, cpu_share};

use super::*;

const CROWD: &str = "
namespaces:
  2: urn:ua-bridge:system-tests
spaces:
  - id: 2
variables:
  - {node: ns=2;i=10, name: temperature, type: Double, origin: 2}
server:
  security: [None]
  limits: {sessions: 700, sessions_per_address: 700, connections: 1500, connections_per_address: 1500}
";
/// Clients of a round; half of them vanish.
const AT_ONCE: u32 = 15;
/// Time until the sessions of vanished clients have ended, on a loaded machine.
const ALL_ENDED: Duration = Duration::from_secs(90);

/// Lets clients come and vanish, and waits until their sessions have ended.
fn visit(cell: &Cell, clients: u32) {
    let rounds = clients.div_ceil(AT_ONCE).to_string();
    let at_once = AT_ONCE.to_string();
    let arguments = [SERVER_ENDPOINT, "--rounds", &rounds, "--clients", &at_once];
    let mut crowd = cell.asyncua_started("opcua_crowd.py", &arguments).start();
    assert!(
        crowd
            .wait_for_end(ALL_ENDED * clients.div_ceil(60))
            .success()
    );
    eventually(
        "the sessions of vanished clients have ended",
        ALL_ENDED,
        || {
            let told = cell.asyncua_try("opcua_tree.py", &[SERVER_ENDPOINT, "--server"])?;
            (told[0]["connected"] == 1).then_some(())
        },
    );
}

#[test]
fn clients_that_vanish_leave_neither_memory_nor_work_behind() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let clients = std::env::var("UA_CROWD").ok();
    let clients = clients.and_then(|text| text.parse().ok()).unwrap_or(90);
    let server = serving(&cell, CROWD);
    visit(&cell, 2 * AT_ONCE);
    let before = anonymous(server.id());
    visit(&cell, clients);
    let grown = anonymous(server.id()).saturating_sub(before);
    // A client would leave more than 100 kB with its session. Half of the clients leave their
    // subscription behind, for the ten minutes of its lifetime.
    let most = (4 << 20) + u64::from(clients / 2) * 16_000;
    assert!(grown < most, "{grown} bytes after {clients} clients");
    let share = cpu_share(server.id(), Duration::from_secs(3));
    assert!(share < 0.05, "{share} of a processor without clients");
}

#[test]
fn a_server_with_a_hundred_sessions_ends_soon() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let mut server = serving(&cell, CROWD);
    let arguments = [SERVER_ENDPOINT, "--hold", "100"];
    let mut crowd = cell.asyncua_started("opcua_crowd.py", &arguments).start();
    crowd.wait_for_json("a hundred sessions", ALL_ENDED, |line| {
        (line["held"] == 100).then_some(())
    });
    let asked = Instant::now();
    server.signal(Signal::SIGTERM);
    assert!(server.wait_for_end(SOON).success());
    // 2 s on an idle machine. A delay of 100 ms for each session would take longer.
    let took = asked.elapsed();
    assert!(took < Duration::from_secs(10), "{took:?}");
}
