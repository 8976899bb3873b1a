//! Mappings that are saved while the programs run.

use std::{
    collections::BTreeMap,
    fs,
    io::Write as _,
    net::TcpStream,
    path::{Path, PathBuf},
    sync::{
        Arc, Mutex,
        atomic::{AtomicBool, Ordering},
    },
    time::{Duration, Instant},
};

use nix::sys::signal::Signal;
use serde_json::{Value, json};
use system_tests::{
    BareNode, Cell, Child, MASTER, METRICS_ROS1, METRICS_ROS2, Peer, SERVER_ENDPOINT, UaSide,
    UadpSocket, eventually, http_get, metrics, string_frame, xml_rpc,
};
use uadp::{NetworkMessage, NetworkMessageType, Scalar, Variant};

const SOON: Duration = Duration::from_secs(30);
/// Time to repair the samples that a busy machine lost at 25 000 samples a second. It took 25 to 30
/// s with nine busy loops on two cores.
const REPAIRED: Duration = Duration::from_secs(60);
const ROUTES: u16 = 500;
/// Number of samples that are sent from DDS for each route: 8 s at 50 Hz.
const TICKS: u16 = 400;
/// Number of samples due each millisecond, with 50 Hz per route.
const EACH_MS: usize = 25;

/// Returns a mapping of `routes` routes from ROS 1, with the topic `first` for the first route.
fn mapping(routes: u16, first: &str) -> String {
    let mut text = "spaces:\n  - {id: 1}\nnamespaces:\n  2: urn:test\nvariables:\n".to_owned();
    for route in 1..=routes {
        let topic = if route == 1 {
            first.to_owned()
        } else {
            format!("/r{route}")
        };
        text += &format!(
            "  - {{node: ns=2;i={route}, name: R{route}, origin: 1, queue: {{drop_oldest: 100}}, \
             ros: {{topic: {topic}, type: std_msgs/String, field: data}}}}\n"
        );
    }
    text
}

/// Saves a file as editors do: writes another file and renames it.
fn save(file: &Path, text: &str) {
    let beside = file.with_extension("new");
    fs::write(&beside, text).unwrap();
    fs::rename(beside, file).unwrap();
}

fn about(key: &str) -> Value {
    metrics(METRICS_ROS1).map_or(Value::Null, |status| status["mapping"][key].clone())
}

/// The received values: for each route, sequence numbers and sent numbers. Repeated events are
/// recorded once.
type ReceivedNumbers = BTreeMap<u16, Vec<(u16, u16)>>;

/// Receives from the group on a separate thread until `ended`.
fn listen(
    heard: &Arc<Mutex<ReceivedNumbers>>,
    ended: &Arc<AtomicBool>,
) -> std::thread::JoinHandle<()> {
    let socket = UadpSocket::join();
    let (heard, ended) = (Arc::clone(heard), Arc::clone(ended));
    std::thread::spawn(move || {
        while !ended.load(Ordering::Relaxed) {
            let Some(datagram) = socket.receive(Duration::from_millis(100)) else {
                continue;
            };
            let message = NetworkMessage::decode(&datagram).unwrap();
            if message.message_type() != NetworkMessageType::DataSet {
                continue;
            }
            for message in message.messages().map(Result::unwrap) {
                let sequence = message.header().sequence_number.unwrap();
                let field = message.fields().ok().and_then(|mut fields| fields.next());
                let Some(Ok(Variant::Scalar(Scalar::String(Some(text))))) = field else {
                    continue;
                };
                let route = message.writer_id.unwrap();
                // The Cyclone DDS peer's texts end with a stamp; its number is the 12 digits before
                // the time.
                let number = match text.len() {
                    36 => &text[8..20],
                    _ => text,
                };
                let said = number.parse().unwrap();
                let mut heard = heard.lock().unwrap();
                let all = heard.entry(route).or_default();
                // An event is repeated with its sequence number, unless a newer event followed.
                if all.last() != Some(&(sequence, said)) {
                    all.push((sequence, said));
                }
            }
        }
    })
}

/// Sends each connection its next number, 50 times a second, spread over the time.
fn send(to: &mut [TcpStream], said: &mut u16, until: impl Fn() -> bool) {
    let mut due = Instant::now();
    while !until() {
        *said += 1;
        let frame = string_frame(&said.to_string());
        for some in to.chunks_mut(EACH_MS) {
            for stream in some {
                // The connection of the topic that the mapping has dropped is closed.
                drop(stream.write_all(&frame));
            }
            due += Duration::from_millis(1);
            std::thread::sleep(due.saturating_duration_since(Instant::now()));
        }
    }
}

#[test]
fn of_500_routes_at_50_hz_only_the_edited_one_notices_the_edit() {
    let Some(cell) = Cell::with(&[Peer::Ros1]) else {
        return;
    };
    let _master = cell.roscore();
    let file = cell.file("cell.yaml", &mapping(ROUTES, "/r1"));
    let _bridge = cell.bridge_ros1(&[file.to_str().unwrap()]);
    let node = BareNode::start("/robot");
    let topics: Vec<String> = (1..=ROUTES).map(|route| format!("/r{route}")).collect();
    let mut streams = node.publish(&topics);
    let (heard, ended) = (Arc::default(), Arc::new(AtomicBool::new(false)));
    let listener = listen(&heard, &ended);
    let mut said = 0;
    let reloads = |count: u64| {
        let next = Mutex::new(Instant::now());
        move || {
            // Not polled at each turn: the status contains 500 topics.
            let mut next = next.lock().unwrap();
            if Instant::now() < *next {
                return false;
            }
            *next = Instant::now() + Duration::from_millis(300);
            about("reloads") == count
        }
    };

    let before = said + 10;
    let warm = Instant::now() + Duration::from_millis(500);
    send(&mut streams, &mut said, || Instant::now() > warm);
    save(&file, &mapping(ROUTES, "/moved"));
    send(&mut streams, &mut said, reloads(1));
    let mut moved = node.publish(&["/moved".to_owned()]);
    std::mem::swap(&mut streams[0], &mut moved[0]);
    let after = said + 10;
    let cool = Instant::now() + Duration::from_millis(500);
    send(&mut streams, &mut said, || Instant::now() > cool);
    eventually("the last are heard", SOON, || {
        let heard: std::sync::MutexGuard<'_, ReceivedNumbers> = heard.lock().unwrap();
        let is_last = |of: &Vec<(u16, u16)>| of.last().is_some_and(|(_, last)| *last == said);
        heard.values().all(is_last).then_some(())
    });
    ended.store(true, Ordering::Relaxed);
    listener.join().unwrap();

    let heard = heard.lock().unwrap();
    assert_eq!(heard.len(), usize::from(ROUTES));
    assert!(before < after && said > after);
    for (route, all) in heard.iter().filter(|(route, _)| **route != 1) {
        // Sent numbers and sequence numbers increase together from first to last: the bridge
        // skipped, repeated and renumbered no value, whatever this socket missed.
        let (first, number) = all[0];
        let offset = first.wrapping_sub(number);
        for (sequence, number) in all {
            assert_eq!(sequence.wrapping_sub(*number), offset, "{route}: {all:?}");
        }
    }
    // The edited route continues its sequence numbers.
    let sequences: Vec<u16> = heard[&1].iter().map(|(sequence, _)| *sequence).collect();
    assert!(sequences.is_sorted_by(|a, b| a < b), "{sequences:?}");
    let status = metrics(METRICS_ROS1).unwrap();
    assert_eq!(system_tests::drops(&status["topics"]), 0, "{status}");
    assert_eq!(status["mapping"]["stale"], Value::Null);
    // The bridge unsubscribes from topics that the mapping does not read.
    eventually("/r1 is published, and not subscribed", SOON, || {
        let graph = xml_rpc(MASTER, "getSystemState", &["/test"])?;
        (graph.matches(">/r1<").count() == 1).then_some(())
    });
}

#[test]
fn a_faulty_file_changes_nothing_and_says_why_and_a_mended_one_is_taken() {
    let Some(cell) = Cell::with(&[Peer::Ros1]) else {
        return;
    };
    let _master = cell.roscore();
    let file = cell.file("cell.yaml", &mapping(2, "/r1"));
    let mut bridge = cell.bridge_ros1(&[file.to_str().unwrap()]);
    let node = BareNode::start("/robot");
    let mut streams = node.publish(&["/r1".to_owned(), "/r2".to_owned()]);
    let socket = UadpSocket::join();
    let first = about("hash");

    save(&file, &mapping(2, "/r1").replace("origin: 1", "origin: 7"));
    bridge.wait_for_line("the running mapping stays in use", SOON);
    let told = bridge.lines().join("\n");
    assert_eq!(
        told.matches("error[M014]").count(),
        2,
        "both places: {told}"
    );
    assert_eq!((about("hash"), about("refused")), (first.clone(), 1.into()));
    assert!(about("stale").as_str().unwrap().contains("2 errors"));
    let page = http_get(METRICS_ROS1, "/metrics").unwrap();
    assert!(page.contains("ua_mapping_stale{program=\"bridge-ros1\",space=\"1\"} 1"));
    streams[0].write_all(&string_frame("still")).unwrap();
    let carries = |socket: &UadpSocket, text: &str| {
        let datagram = socket.receive(Duration::from_millis(50));
        datagram.filter(|datagram| datagram.windows(text.len()).any(|w| w == text.as_bytes()))
    };
    eventually("what ran still runs", SOON, || carries(&socket, "still"));

    // The file is written in place, and the reload is requested instead of awaited.
    fs::write(&file, mapping(1, "/r1")).unwrap();
    bridge.signal(Signal::SIGHUP);
    eventually("it is taken", SOON, || {
        (about("reloads") == 1).then_some(())
    });
    assert_eq!(
        (about("stale"), about("variables")),
        (Value::Null, 1.into())
    );
    assert_ne!(about("hash"), first);
    bridge.wait_for_line("stopped bridging", SOON);

    // Changed as a Kubernetes ConfigMap is: the file stays a link, and its target is replaced.
    let (folder, link) = (cell.folder(), file.with_extension("link"));
    fs::write(
        folder.join("other.yaml"),
        mapping(3, "/r1") + "pubsub: {ttl: 4}\n",
    )
    .unwrap();
    std::os::unix::fs::symlink("other.yaml", &link).unwrap();
    fs::rename(&link, &file).unwrap();
    bridge.wait_for_line("restart needed for changes of: pubsub.ttl", SOON);
    assert_eq!(about("variables"), 3);
    assert_eq!(about("restart_needed"), serde_json::json!(["pubsub.ttl"]));
    let _third = node.publish(&["/r3".to_owned()]);
    bridge.end();
}

/// A mapping whose first value is written to a topic of a defined type, and whose second value is
/// read from `/r1`.
const DEFINED: &str = "
spaces:
  - {id: 1}
namespaces:
  2: urn:test
type_paths: [types]
variables:
  - {node: ns=2;i=1, name: Goal, type: Double, origin: 0, ros: {space: 1, topic: /goal, type: geometry_msgs/Point, field: x}}
  - {node: ns=2;i=2, name: Said, origin: 1, ros: {topic: /r1, type: std_msgs/String, field: data}}
";

/// Writes [`DEFINED`], a definition of its type, and another definition. Returns the mapping and
/// the folder of the definitions.
fn defined(cell: &Cell, point: &str) -> (PathBuf, PathBuf) {
    let folder = cell.folder().join("types/geometry_msgs/msg");
    fs::create_dir_all(&folder).unwrap();
    fs::write(folder.join("Point.msg"), point).unwrap();
    fs::write(folder.join("Other.msg"), "bool a\n").unwrap();
    (cell.file("cell.yaml", DEFINED), folder)
}

const POINT: &str = "float64 x\nfloat64 y\nfloat64 z\n";

#[test]
fn a_definition_file_that_is_saved_counts_and_a_faulty_one_changes_nothing_and_says_why() {
    let Some(cell) = Cell::with(&[Peer::Ros1]) else {
        return;
    };
    let _master = cell.roscore();
    let (file, folder) = defined(&cell, "float64 x\nfloat64 y\n");
    let mut bridge = cell.bridge_ros1(&[file.to_str().unwrap()]);
    let mut ua = UaSide::join();
    let reader = cell.rospy("ros1_sub.py", &["/goal", "geometry_msgs/Point"]);
    bridge.wait_for_line("md5", SOON);
    let first = about("hash");

    save(&folder.join("Point.msg"), "float64 x\nfloat64 9y\n");
    bridge.wait_for_line("the running mapping stays in use", SOON);
    let why = about("stale");
    let why = why.as_str().unwrap();
    assert!(why.contains("geometry_msgs/msg/Point.msg:2: "), "{why}");
    assert_eq!(
        (about("reloads"), about("refused")),
        (0.into(), 1.into()),
        "{why}"
    );
    // The definition lacks a mapped field, so the mapping cannot run with it.
    save(&folder.join("Point.msg"), "float64 y\n");
    eventually("it is refused", SOON, || {
        (about("refused") == 2).then_some(())
    });
    save(&folder.join("Point.msg"), "float64 x\nNowhere n\n");
    eventually("it is refused, too", SOON, || {
        (about("refused") == 3).then_some(())
    });
    let why = about("stale");
    assert!(
        why.as_str()
            .unwrap()
            .contains("a type that `geometry_msgs/Point` uses"),
        "{why}"
    );
    assert_eq!(about("reloads"), 0);

    save(&folder.join("Point.msg"), POINT);
    bridge.wait_for_line("reloaded ", SOON);
    assert_eq!((about("stale"), about("reloads")), (Value::Null, 1.into()));
    assert_eq!(
        about("hash"),
        first,
        "that of the mapping, which is the same"
    );
    eventually("the peer has the value", SOON, || {
        ua.write((0, 2, 1), Scalar::Double(1.5));
        let values = reader.values();
        values.iter().any(|value| value["x"] == 1.5).then_some(())
    });

    // A file is added in a new folder, and a file is removed.
    let more = folder.with_file_name("action");
    fs::create_dir(&more).unwrap();
    fs::write(more.join("Go.action"), "---\n---\n").unwrap();
    eventually("it is read", SOON, || (about("reloads") == 2).then_some(()));
    fs::remove_file(folder.join("Other.msg")).unwrap();
    eventually("all are read", SOON, || {
        (about("reloads") == 3).then_some(())
    });
    assert_eq!(about("refused"), 3);
}

#[test]
fn values_cross_while_definitions_are_read_and_what_is_saved_meanwhile_is_read_next() {
    let Some(cell) = Cell::with(&[Peer::Ros1, Peer::Python]) else {
        return;
    };
    let _master = cell.roscore();
    let (file, folder) = defined(&cell, POINT);
    let mut bridge = cell.bridge_ros1(&[file.to_str().unwrap()]);
    let node = BareNode::start("/robot");
    let mut streams = node.publish(&["/r1".to_owned()]);
    let ua = UaSide::join();
    let mut crosses = |text: &str| {
        streams[0].write_all(&string_frame(text)).unwrap();
        ua.hear_scalar((1, 2, 2), Scalar::String(Some(text)));
    };
    let waits = |lease: &mut Child| {
        lease.wait_for_json("a reader waits", SOON, |line| line.get("waits").cloned());
    };
    let path = folder.join("Point.msg");
    let lease = || {
        let lease = cell.asyncua_started("lease.py", &[path.to_str().unwrap()]);
        lease.told().start().ready(SOON)
    };

    let mut held = lease();
    // This definition is read before the other definition.
    save(&folder.join("Other.msg"), "bool b\n");
    waits(&mut held);
    crosses("meanwhile");
    assert_eq!((about("reloads"), about("stale")), (0.into(), Value::Null));
    save(&folder.join("Other.msg"), "bool c\n");
    crosses("still");
    held.tell("");
    eventually("both are read", SOON, || {
        (about("reloads") == 2).then_some(())
    });
    crosses("after");
    assert!(held.end().success());

    let mut held = lease();
    bridge.signal(Signal::SIGHUP);
    waits(&mut held);
    // A reader that waits for a disk does not prevent the end of the program.
    assert!(bridge.end().success());
}

#[test]
fn bridge_ros2_leaves_the_routes_alone_that_an_edit_does_not_name() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let mapping = |first: &str| {
        mapping(2, first)
            .replace("{id: 1}", "{id: 2}")
            .replace("origin: 1", "origin: 2")
    };
    let file = cell.file("cell.yaml", &mapping("/r1"));
    let mut bridge = cell.bridge_ros2(&[file.to_str().unwrap()]);
    let (heard, ended) = (Arc::default(), Arc::new(AtomicBool::new(false)));
    let listener = listen(&heard, &ended);
    let sends = |topic: &str| {
        let numbered = ["--domain", "2", "--numbered", "60000", "--rate", "50"];
        cell.cyclone(
            "ros2_pub.py",
            &[&[topic, "std_msgs/String"][..], &numbered].concat(),
        )
    };
    let heard_of = |route: u16| {
        let heard: std::sync::MutexGuard<'_, ReceivedNumbers> = heard.lock().unwrap();
        heard.get(&route).map_or(0, Vec::len)
    };
    let _sends = [sends("/r1"), sends("/r2"), sends("/moved")];
    eventually("both are heard", SOON, || {
        (heard_of(1) > 10 && heard_of(2) > 10).then_some(())
    });
    save(&file, &mapping("/moved"));
    bridge.wait_for_line("reloaded ", SOON);
    bridge.wait_for_line("stopped bridging topic=ua_2_2_1", SOON);
    let (one, two) = (heard_of(1), heard_of(2));
    eventually("both are heard again", SOON, || {
        (heard_of(1) > one + 10 && heard_of(2) > two + 10).then_some(())
    });
    ended.store(true, Ordering::Relaxed);
    listener.join().unwrap();
    let lines = bridge.lines();
    assert!(
        !lines
            .iter()
            .any(|line| line.contains("stopped bridging topic=ua_2_2_2"))
    );
    let heard = heard.lock().unwrap();
    let (first, number) = heard[&2][0];
    for (sequence, said) in &heard[&2] {
        let offset = first.wrapping_sub(number);
        assert_eq!(sequence.wrapping_sub(*said), offset, "{:?}", heard[&2]);
    }
    let sequences: Vec<u16> = heard[&1].iter().map(|(sequence, _)| *sequence).collect();
    assert!(sequences.is_sorted_by(|a, b| a < b), "{sequences:?}");
}

/// Has the peer send `ticks` values on each of its topics, each tick spread over 20 ms. Returns the
/// first number, and the number of readers at the end.
fn paced(peer: &mut Child, ticks: u16) -> (u16, u64) {
    let sent = |peer: &Child| -> Vec<(u64, u64)> {
        let lines = peer.json_lines();
        let of = |line: &Value| Some((line["first"].as_u64()?, line["readers"].as_u64()?));
        lines.iter().filter_map(of).collect()
    };
    let before = sent(peer).len();
    peer.tell(&format!("{ticks} 36 20000000 0 0"));
    let (first, readers) = eventually("it is sent", SOON, || sent(peer).get(before).copied());
    (first.try_into().unwrap(), readers)
}

#[test]
fn of_500_routes_from_dds_at_50_hz_only_the_edited_one_notices_the_edit() {
    let Some(cell) = Cell::with(&[Peer::CycloneC]) else {
        return;
    };
    let mapping = |first: &str, more: &str| {
        let text = mapping(ROUTES, first);
        text.replace("{id: 1}", "{id: 1}\n  - {id: 2}")
            .replace("origin: 1", "origin: 2")
            + more
    };
    let written = "  - {node: ns=2;i=600, name: Written, origin: 1, ros: {space: 2, topic: /written, type: \
                   std_msgs/String, field: data}}\n";
    let file = cell.file("cell.yaml", &mapping("/r1", written));
    let mut bridge = cell.bridge_ros2(&[file.to_str().unwrap()]);
    let routes = ROUTES.to_string();
    // The peer keeps all samples, so that a busy machine causes delay instead of loss.
    let kept = ["--first", "1", "--spread", "--depth", "1000"];
    let pace = [&["pace", "/r", "--topics", &routes][..], &kept].concat();
    let mut sends = cell.cyclone_c(&pace);
    let mut moved = cell.cyclone_c(&["pace", "/moved"]);
    let mut reads = cell.cyclone_c(&["sub", "/written", "std_msgs/String", "--counts"]);
    let mut writers = |count: u64| {
        reads.wait_for_json("the writers change", SOON, |line| {
            (line["writers"] == count).then_some(())
        });
    };
    writers(1);
    eventually("each route has a reader", SOON, || {
        (paced(&mut sends, 1).1 == u64::from(ROUTES)).then_some(())
    });
    let (heard, ended) = (Arc::default(), Arc::new(AtomicBool::new(false)));
    let listener = listen(&heard, &ended);

    let sending = std::thread::spawn(move || (paced(&mut sends, TICKS), sends));
    let heard_of = |route: u16| {
        let heard: std::sync::MutexGuard<'_, ReceivedNumbers> = heard.lock().unwrap();
        heard.get(&route).map_or(0, Vec::len)
    };
    eventually("all are heard", REPAIRED, || {
        (1..=ROUTES).all(|route| heard_of(route) > 25).then_some(())
    });
    save(&file, &mapping("/moved", ""));
    bridge.wait_for_line("reloaded ", SOON);
    writers(0);
    eventually("the other topic has a reader", SOON, || {
        (paced(&mut moved, 1).1 == 1).then_some(())
    });
    let (first, _) = paced(&mut moved, 50);
    let other = first + 50 - 1;
    let ((first, _), mut sends) = sending.join().unwrap();
    let last = first + TICKS - 1;
    eventually("the last are heard", REPAIRED, || {
        let heard: std::sync::MutexGuard<'_, ReceivedNumbers> = heard.lock().unwrap();
        let is_last = |(route, of): (&u16, &Vec<(u16, u16)>)| {
            let last = if *route == 1 { other } else { last };
            of.last().is_some_and(|(_, said)| *said == last)
        };
        heard.iter().all(is_last).then_some(())
    });
    ended.store(true, Ordering::Relaxed);
    listener.join().unwrap();
    eventually("what is taken out is disposed of", SOON, || {
        (paced(&mut sends, 1).1 == u64::from(ROUTES) - 1).then_some(())
    });
    let lines = bridge.lines();
    let unbound: Vec<&String> = lines
        .iter()
        .filter(|line| line.contains("stopped bridging"))
        .collect();
    assert_eq!(unbound.len(), 2, "{unbound:?}");
    let heard = heard.lock().unwrap();
    assert_eq!(heard.len(), usize::from(ROUTES));
    for (route, all) in heard.iter().filter(|(route, _)| **route != 1) {
        let (first, number) = all[0];
        let offset = first.wrapping_sub(number);
        for (sequence, number) in all {
            assert_eq!(sequence.wrapping_sub(*number), offset, "{route}: {all:?}");
        }
    }
    let sequences: Vec<u16> = heard[&1].iter().map(|(sequence, _)| *sequence).collect();
    assert!(sequences.is_sorted_by(|a, b| a < b), "{sequences:?}");
    let status = metrics(METRICS_ROS2).unwrap();
    assert_eq!(system_tests::drops(&status["topics"]), 0, "{status}");
}

#[test]
fn the_server_has_the_nodes_of_the_saved_mapping_and_its_clients_stay() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let part = cell.file("part.yaml", "variables: []\n");
    let whole = mapping(2, "/r1").replacen("spaces", "include: part.yaml\nspaces", 1);
    let file = cell.file("cell.yaml", &whole);
    let mut server = cell.ua_server(&[file.to_str().unwrap()]);
    let read = |nodes: &[&str]| {
        let all = [&[SERVER_ENDPOINT], nodes].concat();
        let answers = cell.asyncua_try("opcua_read.py", &all)?;
        let status = |answer: &Value| answer["status"].as_str().unwrap().to_owned();
        Some(answers.iter().map(status).collect::<Vec<String>>())
    };
    let (waiting, unknown) = ("BadWaitingForInitialData", "BadNodeIdUnknown");
    let nodes = ["ns=2;i=1", "ns=2;i=2", "ns=2;i=3"];
    let before = eventually("the server answers", SOON, || read(&nodes));
    assert_eq!(before, [waiting, waiting, unknown]);
    let mut changes = cell.asyncua("opcua_changes.py", &[SERVER_ENDPOINT]);
    changes.wait_for_json("the client listens", SOON, |line| {
        line.get("ready").map(|_| ())
    });
    let mut told = |wanted: Value| {
        changes.wait_for_json(&format!("{wanted} is told"), SOON, |line| {
            (*line.get("changes")? == wanted).then_some(())
        });
    };
    let (added, deleted, other_type) = (1, 2, 16);

    // The main file stays the same, only an included file changes.
    save(
        &part,
        "variables:\n  - {node: ns=2;i=3, name: New, type: Double, origin: 4}\n  - {node: ns=2;i=4, name: Far, \
         type: Double, origin: 1}\n",
    );
    server.wait_for_line("error[M014]", SOON);
    save(
        &part,
        "variables:\n  - {node: ns=2;i=3, name: New, type: Double, origin: 0}\n",
    );
    server.wait_for_line("reloaded ", SOON);
    assert_eq!(read(&nodes), Some(vec![waiting.to_owned(); 3]));
    told(json!([["ns=2;i=3", added]]));
    save(
        &part,
        "variables:\n  - {node: ns=2;i=3, name: New, type: Int32, origin: 0}\n",
    );
    told(json!([["ns=2;i=3", other_type]]));
    save(&file, &whole.replace("node: ns=2;i=2,", "node: ns=2;i=7,"));
    server.wait_for_line("stopped bridging topic=ua_1_2_2", SOON);
    let after = read(&nodes).unwrap();
    assert_eq!(after, [waiting, unknown, waiting]);
    told(json!([["ns=2;i=2", deleted], ["ns=2;i=7", added]]));
}
