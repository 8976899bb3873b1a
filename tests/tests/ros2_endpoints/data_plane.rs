//! Samples between our endpoints and the peer.

use std::num::NonZeroU16;
use std::time::{Duration, Instant};

use nix::sys::signal::Signal;
use ros2_node::domain::Domain;
use ros2_node::graph::Graph;
use ros2_node::inbox::{Inbox, InboxTurn};
use ros2_node::limits::PATCHED;
use ros2_node::outlet::Outlet;
use ros2_node::qos::{Offered, Requested};
use ros2_node::raw::Payload;
use serde_json::Value;
use system_tests::{Cell, Peer, eventually};

use crate::ros2_endpoints::peer::{SOON, heard, is_string, options, reads, string, writes};

const STRING: &str = "std_msgs::msg::dds_::String_";
const TEXT: &str = "std_msgs/String";
/// The topic that the peer writes.
const THEIRS: (&str, &str) = ("/ua_2_1_1", "rt/ua_2_1_1");
/// The topic that we write.
const OURS: (&str, &str) = ("/ua_1_1_1", "rt/ua_1_1_1");
const LATCHED: [&str; 4] = ["--durability", "transient_local", "--depth", "1"];

fn now() -> tokio::time::Instant {
    tokio::time::Instant::now()
}

fn join() -> Domain {
    Domain::join(&options()).unwrap()
}

/// Returns the QoS that fits the writers of the peer's topic, once they are discovered.
fn writers(domain: &Domain) -> Requested {
    eventually("a writer is discovered", SOON, || {
        let graph = Graph::snapshot(domain.participant());
        let writers = graph.writers(THEIRS.1);
        (!writers.is_empty()).then(|| Requested::from_writers(writers))
    })
}

fn inbox(domain: &Domain, requested: Requested) -> Inbox<()> {
    let mut inbox = Inbox::new();
    inbox.insert((), domain.reader(THEIRS.1, STRING, requested).unwrap());
    inbox
}

/// Returns the next sample, and the number of samples lost before it.
async fn sample(inbox: &mut Inbox<()>) -> (Vec<u8>, u64) {
    match tokio::time::timeout(SOON, inbox.recv()).await.unwrap() {
        InboxTurn::Sample {
            payload, missing, ..
        } => (payload.into_bytes().to_vec(), missing),
        InboxTurn::Unreadable { why, .. } => panic!("{why}"),
    }
}

fn outlet(domain: &Domain, offered: Offered) -> Outlet {
    Outlet::new(
        domain.writer(OURS.1, STRING, offered).unwrap(),
        offered,
        domain.joined(),
    )
}

fn meet_readers(domain: &Domain, outlet: &mut Outlet) {
    eventually("a reader is discovered", SOON, || {
        let graph = Graph::snapshot(domain.participant());
        let readers = graph.readers(OURS.1);
        outlet.set_readers(readers, now()).unwrap();
        (!readers.is_empty()).then_some(())
    });
}

fn offer(outlet: &mut Outlet, text: &str) {
    let payload = Payload::to_write(string(text).into()).unwrap();
    outlet.offer(payload, None, now()).unwrap();
}

/// Flushes until nothing waits.
async fn sent(outlet: &mut Outlet) {
    let deadline = now() + SOON;
    while outlet.is_waiting() {
        assert!(now() < deadline, "still waiting");
        outlet.flush(now()).unwrap();
        tokio::time::sleep(Duration::from_millis(1)).await;
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_message_arrives_with_its_byte_order_in_front() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let domain = join();
    let more = ["--wait-readers", "1", "--value", "\"hello\""];
    let _peer = writes(&cell, THEIRS.0, TEXT, &more);
    let mut inbox = inbox(&domain, writers(&domain));
    let (bytes, missing) = sample(&mut inbox).await;
    assert_eq!(bytes[..2], [0, 1]);
    assert!(is_string(&bytes, "hello"), "{bytes:?}");
    assert_eq!(missing, 0);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn five_thousand_messages_at_1_khz_arrive_in_order_without_loss() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let domain = join();
    let more = [
        "--wait-readers",
        "1",
        "--numbered",
        "5000",
        "--rate",
        "1000",
    ];
    let _peer = writes(&cell, THEIRS.0, TEXT, &more);
    let mut inbox = inbox(&domain, writers(&domain));
    for expected in 0..5_000 {
        let (bytes, missing) = sample(&mut inbox).await;
        assert_eq!(missing, 0, "before {expected}");
        assert!(
            is_string(&bytes, &expected.to_string()),
            "{expected} is {bytes:?}"
        );
    }
}

/// Checks writers of Fast DDS without periodic HEARTBEAT, created when the peer knows our reader.
/// The HEARTBEAT they send at the match may arrive before we know the writers. Then only the
/// HEARTBEAT that we request shows that no sample precedes the first.
#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn writers_of_fast_dds_are_heard_before_their_heartbeat_period_is_over() {
    const EARLIER: (&str, &str) = ("/ua_2_1_2", "rt/ua_2_1_2");
    /// The end that discovers the other first is random; both orders are about equally likely.
    const WRITERS: usize = 6;
    let Some(cell) = Cell::with(&[Peer::FastDds]) else {
        return;
    };
    let domain = join();
    let reliable = Requested::from_writers(&[]);
    let mut inbox = inbox(&domain, reliable);
    // Announced after the other reader, so a peer that has matched this reader knows both.
    let _known = domain.reader(EARLIER.1, STRING, reliable).unwrap();
    for writer in 0..WRITERS {
        let text = format!("of {writer}");
        let writes = ["pub", THEIRS.0, TEXT, "--text", &text];
        let when = ["--after", EARLIER.0, "--wait-readers", "1"];
        let how = ["--heartbeat-period", "3600"];
        let _peer = cell.fastdds(&[&writes[..], &when, &how].concat());
        let (bytes, missing) = sample(&mut inbox).await;
        assert!(is_string(&bytes, &text), "{bytes:?}");
        assert_eq!(missing, 0);
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn five_thousand_messages_at_1_khz_are_written_without_loss() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let domain = join();
    let mut out = outlet(&domain, Offered::DropOldest(NonZeroU16::new(1000).unwrap()));
    let mut peer = reads(&cell, OURS.0, TEXT, &[]);
    meet_readers(&domain, &mut out);
    let begin = Instant::now();
    for number in 0..5_000_u32 {
        offer(&mut out, &number.to_string());
        tokio::time::sleep_until((begin + Duration::from_millis(u64::from(number))).into()).await;
        out.flush(now()).unwrap();
    }
    sent(&mut out).await;
    peer.wait_for_line("\"4999\"", SOON);
    let expected: Vec<String> = (0..5_000).map(|number: u32| number.to_string()).collect();
    assert_eq!(heard(&peer), expected);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_late_joiner_gets_the_last_value_and_no_older_one() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let domain = join();
    let mut out = outlet(&domain, Offered::KeepLatest);
    for value in ["first", "second", "last"] {
        offer(&mut out, value);
    }
    let mut early = reads(&cell, OURS.0, TEXT, &LATCHED);
    meet_readers(&domain, &mut out);
    sent(&mut out).await;
    early.wait_for_line("\"last\"", SOON);
    assert_eq!(heard(&early), ["last"]);

    let mut later = reads(&cell, OURS.0, TEXT, &LATCHED);
    later.wait_for_line("\"last\"", SOON);
    assert_eq!(heard(&later), ["last"]);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_late_joiner_gets_no_old_value_that_another_reader_has_not_acknowledged() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    if !PATCHED {
        Cell::skip("RustDDS as published gives late joiners all it has");
        return;
    }
    let domain = join();
    let mut out = outlet(&domain, Offered::KeepLatest);
    let mut stopped = reads(&cell, OURS.0, TEXT, &LATCHED);
    meet_readers(&domain, &mut out);
    offer(&mut out, "before");
    sent(&mut out).await;
    stopped.wait_for_line("\"before\"", SOON);
    stopped.signal(Signal::SIGSTOP);
    for number in 0..50 {
        offer(&mut out, &number.to_string());
    }
    sent(&mut out).await;
    // The reader's depth has room for all samples.
    let mut later = reads(&cell, OURS.0, TEXT, &LATCHED[..2]);
    later.wait_for_line("\"49\"", SOON);
    assert_eq!(heard(&later), ["49"]);
    stopped.signal(Signal::SIGCONT);
    stopped.wait_for_line("\"49\"", SOON);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn who_comes_when_nobody_listened_gets_the_newest_value_and_not_what_the_last_one_heard() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    if !PATCHED {
        Cell::skip("RustDDS as published cannot take a value back");
        return;
    }
    let (domain, other) = (join(), join());
    let mut out = outlet(&domain, Offered::KeepLatest);
    let mut listener = Inbox::new();
    let reader = other.reader(OURS.1, STRING, Requested::from_writers(&[]));
    listener.insert((), reader.unwrap());
    meet_readers(&domain, &mut out);
    offer(&mut out, "on");
    sent(&mut out).await;
    assert!(is_string(&sample(&mut listener).await.0, "on"));
    drop(listener);
    eventually("nobody listens", SOON, || {
        let graph = Graph::snapshot(domain.participant());
        out.set_readers(graph.readers(OURS.1), now()).unwrap();
        graph.readers(OURS.1).is_empty().then_some(())
    });
    for value in ["dim", "off"] {
        offer(&mut out, value);
    }
    // The reader's depth has room for all samples.
    let mut later = reads(&cell, OURS.0, TEXT, &LATCHED[..2]);
    meet_readers(&domain, &mut out);
    sent(&mut out).await;
    later.wait_for_line("\"off\"", SOON);
    assert_eq!(heard(&later), ["off"]);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_writer_that_is_replaced_repairs_what_its_reader_lacks() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let domain = join();
    let offered = Offered::DropOldest(NonZeroU16::new(1000).unwrap());
    let mut out = outlet(&domain, offered);
    let mut reader = reads(&cell, OURS.0, TEXT, &[]);
    meet_readers(&domain, &mut out);
    offer(&mut out, "first");
    sent(&mut out).await;
    reader.wait_for_line("\"first\"", SOON);
    reader.signal(Signal::SIGSTOP);
    // More than the reader's socket buffer holds.
    let large = "x".repeat(100_000);
    for number in 0..30 {
        offer(&mut out, &format!("{number} {large}"));
    }
    sent(&mut out).await;
    let writer = domain.writer(OURS.1, STRING, offered).unwrap();
    out.replace_writer(writer, now());
    offer(&mut out, "last");
    reader.signal(Signal::SIGCONT);
    sent(&mut out).await;
    reader.wait_for_line("\"last\"", SOON);
    let heard = heard(&reader);
    let heard: Vec<_> = heard.iter().filter_map(|it| it.split(' ').next()).collect();
    let numbers: Vec<String> = (0..30).map(|number: u32| number.to_string()).collect();
    let mut expected: Vec<&str> = vec!["first"];
    expected.extend(numbers.iter().map(String::as_str));
    expected.push("last");
    assert_eq!(heard, expected);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_transient_local_value_from_before_our_time_is_read() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let more = [&LATCHED[..], &["--value", "\"old\""]].concat();
    let mut peer = writes(&cell, THEIRS.0, TEXT, &more);
    peer.wait_for_line("\"sent\"", SOON);
    let domain = join();
    let mut inbox = inbox(&domain, writers(&domain));
    let (bytes, _) = sample(&mut inbox).await;
    assert!(is_string(&bytes, "old"), "{bytes:?}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn large_messages_of_odd_length_cross_both_ways() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let domain = join();
    let large = "x".repeat(100_001);
    let value = Value::from(large.as_str()).to_string();
    let more = ["--wait-readers", "1", "--value", &value];
    let _peer = writes(&cell, THEIRS.0, TEXT, &more);
    let mut inbox = inbox(&domain, writers(&domain));
    let (bytes, _) = sample(&mut inbox).await;
    assert!(is_string(&bytes, &large), "{} bytes", bytes.len());

    let mut out = outlet(&domain, Offered::KeepLatest);
    let peer = reads(&cell, OURS.0, TEXT, &[]);
    meet_readers(&domain, &mut out);
    let lengths: Vec<usize> = (99_991..100_001).collect();
    for length in &lengths {
        offer(&mut out, &"y".repeat(*length));
    }
    sent(&mut out).await;
    let texts = eventually("the large messages arrive", SOON, || {
        Some(heard(&peer)).filter(|texts| texts.len() >= lengths.len())
    });
    assert!(
        texts
            .iter()
            .all(|text| text.bytes().all(|byte| byte == b'y'))
    );
    let got: Vec<usize> = texts.iter().map(String::len).collect();
    assert_eq!(got, lengths);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_replaced_reader_repeats_and_loses_nothing() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let domain = join();
    let more = ["--wait-readers", "1", "--numbered", "300", "--rate", "100"];
    let _peer = writes(&cell, THEIRS.0, TEXT, &more);
    let requested = writers(&domain);
    let mut inbox = Inbox::new();
    let slot = inbox.insert((), domain.reader(THEIRS.1, STRING, requested).unwrap());
    let mut retired = Vec::new();
    for expected in 0..300 {
        let (bytes, missing) = sample(&mut inbox).await;
        assert_eq!(missing, 0, "before {expected}");
        assert!(
            is_string(&bytes, &expected.to_string()),
            "{expected} is {bytes:?}"
        );
        if expected % 100 == 50 {
            let reader = domain.reader(THEIRS.1, STRING, requested).unwrap();
            retired.push(inbox.replace(slot, reader).unwrap());
        }
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn what_a_publisher_sent_before_it_left_is_read_after_it_has() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    if !PATCHED {
        Cell::skip("RustDDS as published hands out nothing of a reliable writer that has left");
        return;
    }
    let domain = join();
    let more = ["--wait-readers", "1", "--numbered", "50", "--rate", "1000"];
    let mut peer = writes(&cell, THEIRS.0, TEXT, &more);
    let mut inbox = inbox(&domain, writers(&domain));
    peer.wait_for_line("\"sent\"", SOON);
    peer.tell("leave");
    eventually("the publisher has left", SOON, || {
        let graph = Graph::snapshot(domain.participant());
        graph.writers(THEIRS.1).is_empty().then_some(())
    });
    for expected in 0..50 {
        let (bytes, missing) = sample(&mut inbox).await;
        assert_eq!(missing, 0, "before {expected}");
        assert!(
            is_string(&bytes, &expected.to_string()),
            "{expected} is {bytes:?}"
        );
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn leaving_a_domain_ends_in_time() {
    let Some(_cell) = Cell::with(&[]) else {
        return;
    };
    let domain = join();
    let mut inbox = Inbox::new();
    for n in 0..50 {
        let topic = format!("rt/ua_2_1_{}", n + 1);
        let requested = Requested::from_writers(&[]);
        inbox.insert((), domain.reader(&topic, STRING, requested).unwrap());
    }
    let begin = Instant::now();
    assert!(domain.leave(inbox).await);
    assert!(
        begin.elapsed() < Duration::from_secs(2),
        "{:?}",
        begin.elapsed()
    );
}
