//! Faults in a plant: programs that hang, cut cables, duplicate names, unknown hosts.

use std::io::ErrorKind;
use std::net::{Shutdown, SocketAddr, TcpListener, TcpStream};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU16, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use nix::sys::signal::Signal;
use serde_json::Value;
use system_tests::{Cell, Child, HERE, Peer, THERE, WIRE, eventually, metrics, number};

use super::{
    Greeter, LDS, SOON, STATUS, after, announced, lds, now, on_network, registered, told, who,
    who_started,
};

#[test]
fn a_program_that_hangs_is_missed_in_three_seconds_and_back_when_it_goes_on() {
    let Some(_cell) = Cell::with(&[]) else {
        return;
    };
    let _lds = lds(&[]);
    let mut watch = who(&["watch"]);
    let gripper = announced("gripper", &[]);
    told(&mut watch, "seen", "gripper");
    eventually("it is registered", SOON, || registered("urn:who:gripper"));
    let before = now();
    gripper.signal(Signal::SIGSTOP);
    let gone = told(&mut watch, "gone", "gripper");
    // The host of the program still accepts connections.
    assert_eq!(gone["loss"], "hanging");
    assert!(after(before, &gone) < 4000, "{gone}, stopped at {before:?}");
    eventually("the discovery server misses it", SOON, || {
        registered("urn:who:gripper").is_none().then_some(())
    });
    let losses = metrics(STATUS).unwrap()["losses"].clone();
    assert_eq!(losses[0]["loss"], "hanging", "{losses}");
    gripper.signal(Signal::SIGCONT);
    told_again(&mut watch, "seen", "gripper");
    eventually("it is registered as before", SOON, || {
        registered("urn:who:gripper").and_then(|_| on_network("gripper"))
    });
}

#[test]
fn a_cable_that_is_cut_is_noticed_in_two_seconds_and_one_that_is_mended_too() {
    let Some(cell) = Cell::with(&[]) else {
        return;
    };
    let cable = cell.cable();
    cable.lay(HERE);
    let _lds = lds(&["--interface", WIRE]);
    let _gripper = who_started(&["announce", "gripper", "--address", THERE])
        .beyond(&cable)
        .start()
        .ready(SOON);
    let mut watch = who(&["watch", "--interface", WIRE]);
    told(&mut watch, "seen", "gripper");
    eventually("it is seen", SOON, || on_network("gripper"));
    let before = now();
    cable.cut();
    let gone = told(&mut watch, "gone", "gripper");
    assert_eq!(gone["loss"], "unreachable");
    assert!(after(before, &gone) < 3000, "{gone}, cut at {before:?}");
    eventually("the discovery server misses it", SOON, || {
        on_network("gripper").is_none().then_some(())
    });
    let before = now();
    cable.mend();
    let back = told_again(&mut watch, "seen", "gripper");
    assert!(after(before, &back) < 5000, "{back}, mended at {before:?}");
    eventually("it is seen again", SOON, || on_network("gripper"));
}

#[test]
fn two_hosts_that_announce_one_name_are_told_apart() {
    let Some(cell) = Cell::with(&[]) else {
        return;
    };
    let cable = cell.cable();
    cable.lay(HERE);
    let mut watch = who(&["watch", "--interface", WIRE]);
    // Equal host names, ports and server names, as hosts cloned from the same disk image have them.
    let port = ["--port", "4850"];
    let _here = who(&[&["announce", "arm", "--address", HERE][..], &port].concat());
    let _there = who_started(&[&["announce", "arm", "--address", THERE][..], &port].concat())
        .beyond(&cable)
        .start()
        .ready(SOON);
    let [here, there] = [HERE, THERE].map(|address| format!("opc.tcp://{address}:4850/"));
    eventually("both are there under names of their own", SOON, || {
        let names = [&here, &there].map(|url| last_name(&watch, url));
        let [Some(here), Some(there)] = names else {
            return None;
        };
        (here != there && (here.ends_with(" (2)") || there.ends_with(" (2)"))).then_some(())
    });
    // The name stays.
    watch.wait_for_json("the one with the number", SOON, |line| {
        line["name"].as_str()?.ends_with(" (2)").then_some(())
    });
}

/// Returns the last reported name of a server that has not been lost since.
fn last_name(watch: &Child, url: &str) -> Option<String> {
    let lines = watch.json_lines();
    let mut of_it = lines.iter().filter(|line| line["url"] == url);
    let last = of_it.next_back().filter(|line| line["found"] != "gone")?;
    last["name"].as_str().map(str::to_owned)
}

#[test]
fn a_name_that_two_want_and_a_host_that_nobody_knows_disturb_no_other() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let _lds = lds(&[]);
    let mut watch = who(&["watch"]);
    let (one, other) = (Greeter::start(), Greeter::start());
    for (uri, url) in [
        ("urn:one", one.url()),
        ("urn:other", other.url()),
        ("urn:nowhere", "opc.tcp://no-such-host.invalid:4840"),
    ] {
        let args = ["register", LDS, "--url", url, "--uri", uri];
        let all = [&args[..], &["--mdns", "arm"]].concat();
        let answer = cell.asyncua_once("opcua_discovery.py", &all).remove(0);
        assert_eq!(answer["status"], "Good", "{uri}");
    }
    for (name, url) in [("arm", one.url()), ("arm (2)", other.url())] {
        let seen = watch.wait_for_json(name, SOON, |line| {
            (line["name"] == name && line["found"] == "seen").then(|| line["url"].clone())
        });
        assert_eq!(seen, format!("{url}/"), "{name}");
    }
    let gripper = announced("gripper", &[]);
    told(&mut watch, "seen", "gripper");
    let before = now();
    gripper.signal(Signal::SIGKILL);
    let gone = told(&mut watch, "gone", "gripper");
    assert!(after(before, &gone) < 2500, "{gone}, killed at {before:?}");
    // The loss of the server at an unknown host cannot be detected, so it stays registered.
    assert!(registered("urn:nowhere").is_some());
}

#[test]
fn a_hundred_components_that_come_and_go_at_once_are_all_listed_and_all_missed() {
    let Some(_cell) = Cell::with(&[]) else {
        return;
    };
    let _lds = lds(&[]);
    let watch = who(&["watch"]);
    let crowd = announced("crowd", &["--count", "100", "--no-mdns"]);
    let count = |key: &str| {
        let status = metrics(STATUS)?;
        let of_crowd = |one: &&Value| {
            let name = one["name"].as_str();
            name.is_some_and(|name| name.starts_with("crowd"))
        };
        Some(status[key].as_array()?.iter().filter(of_crowd).count())
    };
    let all = |wanted: usize| {
        let [servers, network] = ["servers", "network"].map(count);
        (servers == Some(wanted) && network == Some(wanted)).then_some(())
    };
    eventually("all are there", SOON * 2, || all(100));
    let told = |found: &str| {
        let lines = watch.json_lines();
        let of_crowd = lines.iter().filter(|line| line["found"] == found);
        let names = of_crowd.filter_map(|line| line["name"].as_str());
        let names: std::collections::BTreeSet<&str> = names.collect();
        names.len()
    };
    eventually("all are told of", SOON, || {
        (told("seen") >= 100).then_some(())
    });
    crowd.signal(Signal::SIGKILL);
    eventually("all are missed", Duration::from_secs(4), || all(0));
    eventually("that is told", SOON, || (told("gone") >= 100).then_some(()));
}

#[test]
fn another_start_time_behind_one_url_is_a_restart() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let mut lds = lds(&[]);
    let [first, second] = ["4861", "4862"].map(|port| format!("opc.tcp://127.0.0.1:{port}"));
    let _first = cell.asyncua("opcua_serve.py", &[&first]);
    let switch = Switch::to(4861);
    let register = ["register", LDS, "--url", &switch.url, "--mdns", "plc"];
    let answer = cell.asyncua_once("opcua_discovery.py", &register).remove(0);
    assert_eq!(answer["status"], "Good");
    let started = || on_network("plc")?["started_ms"].as_u64();
    let before = eventually("it is asked when it started", SOON, started);
    let _second = cell.asyncua("opcua_serve.py", &[&second]);
    let since = now();
    switch.turn(4862);
    lds.wait_for_line("restarted", SOON);
    let took = now().saturating_sub(since);
    assert!(took < Duration::from_secs(3), "{took:?}");
    let later = eventually("it is known when", SOON, started);
    assert!(later > before, "{later} after {before}");
    assert_eq!(number(&metrics(STATUS).unwrap(), "lost_total"), 0);
}

#[test]
fn a_discovery_server_that_stood_still_holds_that_against_nobody() {
    let Some(_cell) = Cell::with(&[]) else {
        return;
    };
    let mut server = lds(&["--register-period", "2"]);
    let _gripper = announced("gripper", &["--register-period", "1"]);
    eventually("it is registered", SOON, || registered("urn:who:gripper"));
    let since = registered("urn:who:gripper").unwrap()["since_ms"].clone();
    for _ in 0..3 {
        server.signal(Signal::SIGSTOP);
        // As long as a registration is valid, and twice the timeout of a silent server.
        std::thread::sleep(Duration::from_secs(5));
        server.signal(Signal::SIGCONT);
        eventually("it goes on", SOON, || metrics(STATUS));
        let found = registered("urn:who:gripper").unwrap();
        assert_eq!(found["since_ms"], since, "{found}");
    }
    assert!(server.runs());
    assert_eq!(number(&metrics(STATUS).unwrap(), "lost_total"), 0);
}

/// Waits for another line of an event that was reported before.
fn told_again(watch: &mut Child, found: &str, name: &str) -> Value {
    let of_it = |line: &&Value| {
        let its = line["name"].as_str();
        its.is_some_and(|its| its.starts_with(name)) && line["found"] == found
    };
    let what = format!("{name} {found} again");
    eventually(&what, SOON, || {
        let lines = watch.json_lines();
        lines.iter().filter(of_it).nth(1).cloned()
    })
}

/// A proxy that can be switched between several programs.
struct Switch {
    url: String,
    port: Arc<AtomicU16>,
    end: Arc<AtomicBool>,
    at: SocketAddr,
    thread: Option<JoinHandle<()>>,
}

impl Switch {
    fn to(port: u16) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let at = listener.local_addr().unwrap();
        let (port, end) = (
            Arc::new(AtomicU16::new(port)),
            Arc::new(AtomicBool::new(false)),
        );
        let (wanted, ends) = (Arc::clone(&port), Arc::clone(&end));
        let thread = std::thread::spawn(move || {
            for stream in listener.incoming() {
                if ends.load(Ordering::Relaxed) {
                    return;
                }
                let (stream, wanted) = (stream.unwrap(), Arc::clone(&wanted));
                std::thread::spawn(move || carry(&stream, &wanted));
            }
        });
        Self {
            url: format!("opc.tcp://{at}"),
            port,
            end,
            at,
            thread: Some(thread),
        }
    }

    /// Switches to another port. Open connections are closed.
    fn turn(&self, port: u16) {
        self.port.store(port, Ordering::Relaxed);
    }
}

/// Carries bytes both ways until a side closes its connection, or the proxy is switched.
fn carry(near: &TcpStream, wanted: &AtomicU16) {
    let port = wanted.load(Ordering::Relaxed);
    let Ok(far) = TcpStream::connect(("127.0.0.1", port)) else {
        return;
    };
    let ways = [(near, &far), (&far, near)];
    std::thread::scope(|scope| {
        for (from, to) in ways {
            scope.spawn(move || {
                from.set_read_timeout(Some(Duration::from_millis(20)))
                    .unwrap();
                let mut bytes = [0; 4096];
                while wanted.load(Ordering::Relaxed) == port {
                    match std::io::Read::read(&mut &*from, &mut bytes) {
                        Ok(0) => break,
                        Ok(length) => {
                            let written = std::io::Write::write_all(&mut &*to, &bytes[..length]);
                            if written.is_err() {
                                break;
                            }
                        }
                        Err(error)
                            if matches!(
                                error.kind(),
                                ErrorKind::WouldBlock | ErrorKind::TimedOut
                            ) => {}
                        Err(_) => break,
                    }
                }
                // A stream may be closed already.
                drop(from.shutdown(Shutdown::Both));
                drop(to.shutdown(Shutdown::Both));
            });
        }
    });
}

impl Drop for Switch {
    fn drop(&mut self) {
        self.end.store(true, Ordering::Relaxed);
        self.port.store(0, Ordering::Relaxed);
        drop(TcpStream::connect(self.at));
        if let Some(thread) = self.thread.take() {
            drop(thread.join());
        }
    }
}
