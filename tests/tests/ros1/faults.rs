//! Faults on the wire and sudden ends, with real ROS 1 on the other side.

use std::{
    io::{Read, Write},
    net::{TcpListener, TcpStream},
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    thread::JoinHandle,
    time::{Duration, Instant},
};

use nix::sys::signal::Signal;
use socket2::SockRef;
use system_tests::{
    Cell, Child, MASTER, METRICS_ROS1, Peer, UadpSocket, eventually, holds_for, metrics, xml_rpc,
};
use tcpros::ConnectionHeader;

use crate::ros1::support::{Ros1Node, SOON, string, string_type};

const ROS1: &[Peer] = &[Peer::Ros1];
/// Time that the master or a peer may need on a busy machine in addition to the time a rule allows.
const AIR: Duration = Duration::from_secs(2);

/// Connects to a topic as any peer may, and returns the connection and the answered header.
fn connect(port: &str, fields: &[(&str, &str)]) -> (TcpStream, ConnectionHeader) {
    let mut stream = TcpStream::connect(port).unwrap();
    stream.set_read_timeout(Some(SOON)).unwrap();
    stream.write_all(&header(fields)).unwrap();
    let answer = read_header(&mut stream);
    (stream, answer)
}

fn header(fields: &[(&str, &str)]) -> Vec<u8> {
    let header = fields
        .iter()
        .fold(ConnectionHeader::default(), |header, (name, value)| {
            header.with(name, *value)
        });
    header.encode().unwrap()
}

fn read_header(stream: &mut TcpStream) -> ConnectionHeader {
    let mut length = [0; 4];
    stream.read_exact(&mut length).unwrap();
    let mut header = vec![0; u32::from_le_bytes(length) as usize];
    stream.read_exact(&mut header).unwrap();
    ConnectionHeader::parse(&header).unwrap()
}

fn tally(child: &mut Child, least: u64) -> u64 {
    child.wait_for_json(&format!("{least} messages"), SOON, |line| {
        line["tally"].as_u64().filter(|count| *count >= least)
    })
}

/// Requirement: slow peers affect only themselves (a separate queue, limited in messages and bytes;
/// oldest messages dropped and counted; write timeout).
#[test]
fn a_stalled_subscriber_costs_nobody_else_a_message() {
    let Some(cell) = Cell::with(ROS1) else {
        return;
    };
    let _master = cell.roscore();
    let ours = Ros1Node::start("ours");
    let big = ours.advertise("/big", string_type(), false);
    let mut healthy = cell.rospy("ros1_tally.py", &["/big"]);
    let port = eventually("the topic is served", SOON, || {
        cell.tcpros_port("/ours", "/big")
    });
    let request = [("callerid", "/stalled"), ("topic", "/big"), ("md5sum", "*")];
    let (_stalled, _) = connect(&port, &request);
    let _silent = TcpStream::connect(&port).unwrap();
    eventually("both listen", SOON, || {
        (big.subscribers() == 2).then_some(())
    });

    let content = string(&"x".repeat(20_000));
    let started = Instant::now();
    let mut sent = 0;
    eventually("the stalled one is given up", SOON, || {
        let _sent = big.publish(content.clone());
        sent += 1;
        (big.subscribers() == 1).then_some(())
    });
    let given_up = started.elapsed();
    println!("{sent} messages; the stalled one was given up after {given_up:?}");
    assert!(given_up > Duration::from_secs(9), "{given_up:?}");
    assert!(big.dropped() > 0);
    assert_eq!(tally(&mut healthy, sent), sent);
}

/// Requirement: handshakes are independent of each other; a rejected peer gets the reason in an
/// `error=` field.
#[test]
fn peers_that_break_the_handshake_cost_only_themselves() {
    let Some(cell) = Cell::with(ROS1) else {
        return;
    };
    let _master = cell.roscore();
    let ours = Ros1Node::start("ours");
    let chatter = ours.advertise("/chatter", string_type(), false);
    let port = eventually("the topic is served", SOON, || {
        cell.tcpros_port("/ours", "/chatter")
    });
    let request = header(&[("callerid", "/x"), ("topic", "/chatter"), ("md5sum", "*")]);
    for n in 0..20 {
        let mut stream = TcpStream::connect(&port).unwrap();
        stream
            .write_all(&request[..request.len() * n / 19])
            .unwrap();
        SockRef::from(&stream)
            .set_linger(Some(Duration::ZERO))
            .unwrap();
    }
    let malformed: [&[u8]; 8] = [
        &[0xff; 4],                               // 4 GiB
        &[1, 0, 16, 0],                           // 1 MiB and one byte
        b"\x04\0\0\0\0\0\0\0",                    // an empty field
        b"\x10\0\0\0\xff\xff\xff\x7fcallerid=/x", // a field longer than its header
        b"\x08\0\0\0\x04\0\0\0noeq",              // no `=`
        b"\0\0\0\0",                              // no field at all
        b"GET / HTTP/1.1\r\n\r\n",                // another protocol
        b"\x03\0\0\0abc",                         // no room for a length
    ];
    let open: Vec<TcpStream> = malformed
        .iter()
        .map(|bytes| {
            let mut stream = TcpStream::connect(&port).unwrap();
            stream.write_all(bytes).unwrap();
            stream
        })
        .collect();

    let (_any, answer) = connect(
        &port,
        &[
            ("callerid", "/any"),
            ("topic", "/chatter"),
            ("md5sum", "*"),
            ("odd", "=1"),
        ],
    );
    assert_eq!(answer.type_name(), Some("std_msgs/String"));
    let mut healthy = cell.rospy("ros1_tally.py", &["/chatter", "std_msgs/String"]);
    eventually("both listen", SOON, || {
        (chatter.subscribers() == 2).then_some(())
    });
    let _sent = chatter.publish(string("all well"));
    tally(&mut healthy, 1);
    drop(open);

    let other = ["/chatter", "std_msgs/Bool", "--node", "rospy_other"];
    let mut other = cell.rospy("ros1_tally.py", &other);
    let line = other.wait_for_line("remote error reported", SOON);
    assert!(
        line.contains(
            "Client [/rospy_other] wants topic /chatter to have datatype/md5sum [std_msgs/Bool/"
        ),
        "{line}"
    );
    assert_eq!(chatter.refused_type().as_deref(), Some("std_msgs/Bool"));
}

/// The behaviour of a hand-written publisher after the header of a connection.
#[derive(Clone, Copy)]
enum Lie {
    /// Announces 2 GiB.
    Huge,
    /// Ends within a message.
    Half,
    /// Ends within the header.
    HalfHeader,
    /// Sends a message and stays.
    None,
}

/// A hand-written publisher of `/t` in the master and on the wire: each connection gets the next
/// lie.
struct ByHand {
    stop: Arc<AtomicBool>,
    threads: Vec<JoinHandle<()>>,
}

impl ByHand {
    fn start(lies: Vec<Lie>) -> Self {
        let api = TcpListener::bind("127.0.0.1:0").unwrap();
        let topics = TcpListener::bind("127.0.0.1:0").unwrap();
        let uri = format!("http://{}/", api.local_addr().unwrap());
        let port = topics.local_addr().unwrap().port();
        let stop = Arc::new(AtomicBool::new(false));
        let threads = vec![
            accepting(api, &stop, move |stream| answer_request_topic(stream, port)),
            accepting(topics, &stop, {
                let mut lies = lies.into_iter();
                let mut open = Vec::new();
                move |stream| open.push(serve(stream, lies.next().unwrap_or(Lie::None)))
            }),
        ];
        let arguments = ["/by_hand", "/t", "std_msgs/String", uri.as_str()];
        xml_rpc(MASTER, "registerPublisher", &arguments).unwrap();
        Self { stop, threads }
    }
}

impl Drop for ByHand {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        for thread in self.threads.drain(..) {
            // A thread that panicked has already failed the test through the missing service.
            drop(thread.join());
        }
    }
}

fn accepting(
    listener: TcpListener,
    stop: &Arc<AtomicBool>,
    mut handle: impl FnMut(TcpStream) + Send + 'static,
) -> JoinHandle<()> {
    let stop = Arc::clone(stop);
    listener.set_nonblocking(true).unwrap();
    std::thread::spawn(move || {
        while !stop.load(Ordering::Relaxed) {
            match listener.accept() {
                Ok((stream, _)) => {
                    stream.set_nonblocking(false).unwrap();
                    handle(stream);
                }
                Err(_) => std::thread::sleep(Duration::from_millis(5)),
            }
        }
    })
}

fn answer_request_topic(mut stream: TcpStream, port: u16) {
    let mut request = Vec::new();
    let mut piece = [0; 4096];
    while !String::from_utf8_lossy(&request).contains("</methodCall>") {
        let read = stream.read(&mut piece).unwrap();
        if read == 0 {
            return;
        }
        request.extend_from_slice(&piece[..read]);
    }
    let body = format!(
        "<?xml version='1.0'?><methodResponse><params><param><value><array><data><value><int>1</int></value>\
         <value><string></string></value><value><array><data><value><string>TCPROS</string></value>\
         <value><string>127.0.0.1</string></value><value><int>{port}</int></value></data></array></value></data>\
         </array></value></param></params></methodResponse>"
    );
    let answer = format!(
        "HTTP/1.0 200 OK\r\nContent-Length: {}\r\n\r\n{body}",
        body.len()
    );
    stream.write_all(answer.as_bytes()).unwrap();
}

fn serve(mut stream: TcpStream, lie: Lie) -> Option<TcpStream> {
    let request = read_header(&mut stream);
    assert_eq!(request.get("tcp_nodelay"), Some("1"));
    let reply = header(&[
        ("callerid", "/by_hand"),
        ("type", "std_msgs/String"),
        ("md5sum", "*"),
    ]);
    if matches!(lie, Lie::HalfHeader) {
        stream.write_all(&reply[..reply.len() / 2]).unwrap();
        return None;
    }
    stream.write_all(&reply).unwrap();
    match lie {
        Lie::Huge => stream.write_all(&(2u32 << 30).to_le_bytes()).unwrap(),
        Lie::Half => stream.write_all(b"\x09\0\0\0\x05\0\0\0he").unwrap(),
        Lie::HalfHeader | Lie::None => {
            let content = string("truth");
            stream.write_all(&9u32.to_le_bytes()).unwrap();
            stream.write_all(&content).unwrap();
        }
    }
    matches!(lie, Lie::Huge | Lie::None).then_some(stream)
}

/// Requirement: an announced length is trusted only as far as the data arrives, and after each
/// failure the address of the publisher is requested again.
#[test]
fn a_publisher_that_lies_or_breaks_off_is_asked_again() {
    let Some(cell) = Cell::with(ROS1) else {
        return;
    };
    let _master = cell.roscore();
    let ours = Ros1Node::start("ours");
    let mut heard = ours.subscribe("/t");
    let _by_hand = ByHand::start(vec![Lie::Huge, Lie::Half, Lie::HalfHeader]);
    let message = heard.next("the truth after three lies");
    assert_eq!(message.bytes, string("truth"));
    assert_eq!(heard.subscription.refused_frames(), 1);
    assert_eq!(message.peer.caller_id, "/by_hand");
}

/// Waits until a value of `/ua_1_5_10` reaches the group.
fn crosses(group: &UadpSocket, value: &str) {
    eventually(&format!("`{value}` is on the group"), SOON, || {
        let datagram = group.receive(Duration::from_millis(100))?;
        datagram
            .windows(value.len())
            .any(|part| part == value.as_bytes())
            .then_some(())
    });
}

fn rospy_pub(cell: &Cell, value: &str, ports: [&str; 2]) -> Child {
    let value = format!("\"{value}\"");
    let args = [
        "/ua_1_5_10",
        "std_msgs/String",
        "--repeat",
        "0",
        "--value",
        &value,
        "--ports",
        ports[0],
        ports[1],
    ];
    cell.rospy("ros1_pub.py", &args)
}

/// Requirement: a publisher is retried until the master drops it, with few log lines that name the
/// remedy. It is found again at once under its old address or a new address.
#[test]
fn a_publisher_is_found_again_after_every_kind_of_end() {
    let Some(cell) = Cell::with(ROS1) else {
        return;
    };
    let _master = cell.roscore();
    let group = UadpSocket::join();
    let mut bridge = cell.bridge_ros1(&[]);
    let mut first = rospy_pub(&cell, "first", ["40001", "40002"]);
    crosses(&group, "first");

    first.signal(Signal::SIGKILL);
    first.wait_for_end(SOON);
    let complaint = bridge.wait_for_line("cannot connect to a registered publisher", SOON);
    assert!(
        complaint.contains("rosnode cleanup") && complaint.contains("/rospy_pub"),
        "{complaint}"
    );
    holds_for("one line a minute", Duration::from_secs(6), || {
        let lines = bridge.lines();
        lines
            .iter()
            .filter(|line| line.contains("registered publisher"))
            .count()
            == 1
    });

    let started = Instant::now();
    let second = rospy_pub(&cell, "second", ["40001", "40002"]);
    let ready = Instant::now();
    crosses(&group, "second");
    println!(
        "the old address: {:?} after the start, {:?} after it was ready",
        started.elapsed(),
        ready.elapsed()
    );
    assert!(ready.elapsed() < Duration::from_secs(1) + AIR);
    drop(second);

    let _third = rospy_pub(&cell, "third", ["0", "0"]);
    crosses(&group, "third");
}

/// Requirement: everything is registered again when the master has restarted; links stay and no
/// message is lost.
#[test]
fn twenty_restarts_of_the_master_cost_no_message() {
    const ROUNDS: usize = 20;
    let Some(cell) = Cell::with(ROS1) else {
        return;
    };
    let mut master = cell.roscore();
    let ours = Ros1Node::start("ours");
    let out = Arc::new(ours.advertise("/out", string_type(), false));
    let heard = ours.subscribe("/in");
    let mut tallied = cell.rospy("ros1_tally.py", &["/out", "std_msgs/String"]);
    let args = [
        "/in",
        "std_msgs/String",
        "--wait-subscribers",
        "1",
        "--numbered",
        "100000",
        "--rate",
        "100",
    ];
    let _sends = cell.rospy("ros1_pub.py", &args);
    eventually("both links", SOON, || {
        (out.subscribers() == 1 && heard.subscription.publishers() == 1).then_some(())
    });
    let sending = {
        let out = Arc::clone(&out);
        ours.runtime.spawn(async move {
            let mut ticks = tokio::time::interval(Duration::from_millis(10));
            loop {
                ticks.tick().await;
                assert_eq!(out.publish(string("x")).sent_to, 1);
            }
        })
    };

    let mut longest = Duration::ZERO;
    for _ in 0..ROUNDS {
        master.signal(Signal::SIGKILL);
        master.wait_for_end(SOON);
        master = cell.roscore();
        let started = Instant::now();
        eventually("all is registered again", SOON, || {
            let state = xml_rpc(MASTER, "getSystemState", &["/system_tests"])?;
            (state.matches("/ours").count() == 2).then_some(())
        });
        longest = longest.max(started.elapsed());
    }
    println!("registered again within {longest:?} of the master's first answer");
    assert!(longest < Duration::from_secs(3) + AIR, "{longest:?}");

    assert!(!sending.is_finished(), "a message found no subscriber");
    sending.abort();
    let mut heard = heard;
    let mut next = 0;
    while let Some(message) = heard.try_next() {
        assert_eq!(message.bytes, string(&next.to_string()));
        next += 1;
    }
    println!("{next} messages heard in their order");
    assert!(next > 100);
    assert_eq!((out.dropped(), out.subscribers()), (0, 1));
    let api = cell.slave_api("/ours").unwrap();
    // [topic, bytes, [[connection, bytes, messages, connected]]]: the statistics of written
    // messages.
    let written = xml_rpc(&api, "getBusStats", &["/system_tests"]).unwrap();
    let numbers: Vec<u64> = written
        .split("<i4>")
        .skip(1)
        .filter_map(|rest| rest.split('<').next()?.parse().ok())
        .collect();
    let messages = *numbers.get(4).unwrap_or_else(|| panic!("{written}"));
    assert_eq!(tally(&mut tallied, messages), messages);
}

/// Requirement: a node starts without a master, and tolerates nonsense answers of a master.
#[test]
fn a_master_that_answers_nonsense_is_waited_for() {
    let Some(cell) = Cell::with(ROS1) else {
        return;
    };
    let answers: [&[u8]; 6] = [
        b"",
        b"SSH-2.0-OpenSSH_9.2\r\n",
        b"HTTP/1.1 500 Oops\r\nContent-Length: 0\r\n\r\n",
        b"HTTP/1.1 200 OK\r\nContent-Length: 13\r\n\r\n<html></html>",
        b"HTTP/1.1 200 OK\r\nContent-Length: 99999999\r\n\r\n<methodResponse>",
        b"HTTP/1.1 200 OK\r\n\r\n<methodResponse><params><param><value><i4>1</i4></value></param></params></methodResponse>",
    ];
    let ours = Ros1Node::start("ours");
    let _out = ours.advertise("/out", string_type(), false);
    let stop = Arc::new(AtomicBool::new(false));
    let listener = TcpListener::bind(MASTER).unwrap();
    let answered = Arc::new(std::sync::atomic::AtomicUsize::new(0));
    let nonsense = accepting(listener, &stop, {
        let answered = Arc::clone(&answered);
        move |mut stream| {
            let turn = answered.fetch_add(1, Ordering::Relaxed);
            stream.write_all(answers[turn % answers.len()]).ok();
            stream.read_exact(&mut [0]).ok();
        }
    });
    eventually("every answer was given", SOON, || {
        (answered.load(Ordering::Relaxed) > answers.len()).then_some(())
    });
    assert!(!ours.is_registered());
    stop.store(true, Ordering::Relaxed);
    nonsense.join().unwrap();

    let _master = cell.roscore();
    eventually("the registration", SOON, || {
        ours.is_registered().then_some(())
    });
    let state = xml_rpc(MASTER, "getSystemState", &["/system_tests"]).unwrap();
    assert!(state.contains("/out") && state.contains("/ours"), "{state}");
}

fn ends_in_time(bridge: &mut Child, when: &str) {
    let started = Instant::now();
    bridge.signal(Signal::SIGTERM);
    let status = bridge.wait_for_end(SOON);
    let took = started.elapsed();
    println!("{when}: ended within {took:?}");
    assert!(status.success(), "{when}: {status}");
    assert!(took < Duration::from_secs(2) + AIR, "{when}: {took:?}");
}

/// Requirement: an ended program leaves nothing in the master, and its end takes two seconds at
/// most, with or without a master.
#[test]
fn a_bridge_ends_in_time_with_and_without_a_master() {
    let Some(cell) = Cell::with(ROS1) else {
        return;
    };
    let group = UadpSocket::join();
    let mut master = cell.roscore();
    let _sends = rospy_pub(&cell, "value", ["0", "0"]);
    let known = || {
        let state = xml_rpc(MASTER, "getSystemState", &["/system_tests"]).unwrap();
        state.contains("/ua_bridge_ros1")
    };

    let mut bridge = cell.bridge_ros1(&[]);
    crosses(&group, "value");
    assert!(known());
    ends_in_time(&mut bridge, "with a master");
    assert!(!known());

    group.drain();
    let mut bridge = cell.bridge_ros1(&[]);
    crosses(&group, "value");
    master.signal(Signal::SIGSTOP);
    ends_in_time(&mut bridge, "with a master that says nothing");
    master.signal(Signal::SIGCONT);

    group.drain();
    let mut bridge = cell.bridge_ros1(&[]);
    crosses(&group, "value");
    master.signal(Signal::SIGKILL);
    master.wait_for_end(SOON);
    ends_in_time(&mut bridge, "without a master");
    bridge.wait_for_line("rosnode cleanup", SOON);
}

/// Requirement: a killed program replaces its old registrations when it is restarted.
#[test]
fn a_bridge_that_was_killed_takes_its_place_again() {
    let Some(cell) = Cell::with(ROS1) else {
        return;
    };
    let _master = cell.roscore();
    let group = UadpSocket::join();
    let _sends = rospy_pub(&cell, "value", ["0", "0"]);
    for _ in 0..2 {
        let mut bridge = cell.bridge_ros1(&[]);
        crosses(&group, "value");
        bridge.signal(Signal::SIGKILL);
        bridge.wait_for_end(SOON);
        group.drain();
    }
    let _bridge = cell.bridge_ros1(&[]);
    crosses(&group, "value");
    assert!(metrics(METRICS_ROS1).is_some());
}

/// Requirement: of two nodes with the same name, the earlier node ends and reports the reason.
#[test]
fn a_bridge_whose_name_is_taken_ends_and_says_so() {
    let Some(cell) = Cell::with(ROS1) else {
        return;
    };
    let _master = cell.roscore();
    let group = UadpSocket::join();
    let _sends = rospy_pub(&cell, "value", ["0", "0"]);
    let mut bridge = cell.bridge_ros1(&["__name:=cell", "__ns:=/line"]);
    crosses(&group, "value");
    let thief = Ros1Node::start_in("/line", "cell");
    let _out = thief.advertise("/anything", string_type(), false);
    let status = bridge.wait_for_end(SOON);
    assert!(!status.success());
    bridge.wait_for_line("shut down the ROS 1 node /line/cell", SOON);
    eventually("the other has the name", SOON, || {
        thief.is_registered().then_some(())
    });
}

/// Returns a mapping with `count` topics of the graph, half of them read and half written.
fn many_topics(count: usize) -> String {
    let variables: String = (1..=count)
        .map(|n| {
            let ros = format!("topic: /t{n}, type: std_msgs/Bool");
            let bindings = match n % 2 {
                0 => format!("origin: 1, ros: {{{ros}}}"),
                _ => format!("origin: 2, ros: [{{space: 1, {ros}}}, {{space: 2, {ros}}}]"),
            };
            format!("  - {{node: ns=2;i={n}, name: T{n}, {bindings}}}\n")
        })
        .collect();
    format!(
        "spaces: [{{id: 1}}, {{id: 2}}]\nnamespaces: {{2: urn:test:many}}\nvariables:\n{variables}"
    )
}

/// Requirement: of two programs with the same name that start at the same instant, exactly one
/// program stays with all its registrations. The other ends and reports where the first runs.
#[test]
fn of_two_bridges_that_start_at_once_exactly_one_stays() {
    let Some(cell) = Cell::with(ROS1) else {
        return;
    };
    let _master = cell.roscore();
    let mapping = cell.folder().join("many.yaml");
    std::fs::write(&mapping, many_topics(300)).unwrap();
    let mapping = mapping.to_str().unwrap();
    // A faulty program loses the race in some rounds only.
    for _ in 0..3 {
        let mut bridges = ["127.0.0.1:9111", "127.0.0.1:9112"]
            .map(|metrics| cell.bridge_ros1_at(&[mapping], metrics).start());
        let ended = eventually("one of them ends", SOON, || {
            bridges.iter_mut().position(|bridge| !bridge.runs())
        });
        let status = bridges[ended].wait_for_end(SOON);
        assert_eq!(status.code(), Some(69));
        bridges[ended].wait_for_line("another node with the name /ua_bridge_ros1 runs at", SOON);
        let stays = &mut bridges[1 - ended];
        eventually("the other has registered all", SOON, || {
            let state = xml_rpc(MASTER, "getSystemState", &["/system_tests"]).unwrap();
            (state.matches("/ua_bridge_ros1").count() == 300).then_some(())
        });
        assert!(stays.runs(), "the other ends as well");
        assert!(stays.end().success());
    }
}
