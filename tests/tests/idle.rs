//! Programs without work sleep.

use std::time::{Duration, Instant};

use system_tests::{Cell, eventually, wake_ups};

const SOON: Duration = Duration::from_secs(60);
/// The time in which wake-ups are counted.
const WINDOW: Duration = Duration::from_secs(2);
/// The largest rate of an idle server. Its tasks of each second wake it less than 50 times, and a
/// server that polls its subscriptions wakes more than 200 times.
const PER_SECOND: f64 = 100.0;

const MAPPING: &str = "\
spaces:
  - id: 1
  - id: 2
namespaces:
  2: urn:ua-bridge:idle
variables:
  - {node: ns=2;i=10, name: here, type: Double, origin: 0}
  - {node: ns=2;i=11, name: there, type: Double, origin: 1}
";

#[test]
fn a_server_without_clients_is_hardly_woken() {
    let Some(cell) = Cell::with(&[]) else {
        return;
    };
    let mapping = cell.file("idle.yaml", MAPPING);
    let server = cell.ua_server(&[&mapping.to_string_lossy()]);
    // A server has work in its first seconds.
    eventually("the server sleeps", SOON, || {
        let (start, before) = (Instant::now(), wake_ups(server.id()));
        std::thread::sleep(WINDOW);
        let count = u32::try_from(wake_ups(server.id()) - before).ok()?;
        let rate = f64::from(count) / start.elapsed().as_secs_f64();
        println!("{rate:.1} wake-ups a second");
        (rate < PER_SECOND).then_some(())
    });
}
