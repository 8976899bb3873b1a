//! Bytes between our endpoints and the peer.

use std::net::{IpAddr, Ipv4Addr};
use std::num::NonZeroU16;
use std::time::{Duration, Instant};

use bridge_ros2::domain::{Domain, DomainOptions};
use bridge_ros2::graph::Graph;
use bridge_ros2::inbox::{Inbox, Taken};
use bridge_ros2::outlet::Outlet;
use bridge_ros2::qos::{Offered, Requested};
use bridge_ros2::raw::Payload;

use crate::peer::{Peer, eventually, string};

const STRING: &str = "std_msgs::msg::dds_::String_";
const UINT32: &str = "std_msgs::msg::dds_::UInt32_";

fn now() -> tokio::time::Instant {
    tokio::time::Instant::now()
}

fn join(domain: u16) -> Domain {
    Domain::join(&DomainOptions {
        domain,
        networks: vec![IpAddr::V4(Ipv4Addr::LOCALHOST)],
        node: "data_plane".into(),
    })
    .unwrap()
}

fn writers_of(domain: &Domain, topic: &str) -> Requested {
    let mut requested = Requested::from_writers(&[]);
    eventually("a writer is discovered", || {
        let graph = Graph::snapshot(domain.participant());
        requested = Requested::from_writers(graph.writers(topic));
        !graph.writers(topic).is_empty()
    });
    requested
}

async fn sample(inbox: &mut Inbox<()>) -> (Vec<u8>, u64) {
    match tokio::time::timeout(Duration::from_secs(10), inbox.recv())
        .await
        .unwrap()
    {
        Taken::Sample {
            payload, missing, ..
        } => (payload.into_bytes().to_vec(), missing),
        Taken::Unreadable { why, .. } => panic!("{why}"),
    }
}

fn outlet(domain: &Domain, topic: &str, type_name: &str, offered: Offered) -> Outlet {
    Outlet::new(domain.writer(topic, type_name, offered).unwrap(), offered)
}

fn meet_readers(domain: &Domain, outlet: &mut Outlet, topic: &str) {
    eventually("a reader is discovered", || {
        let graph = Graph::snapshot(domain.participant());
        outlet.set_readers(graph.readers(topic), now()).unwrap();
        !graph.readers(topic).is_empty()
    });
}

/// Flushes until nothing waits.
async fn sent(outlet: &mut Outlet) {
    let deadline = now() + Duration::from_secs(5);
    while outlet.is_waiting() {
        assert!(now() < deadline, "still waiting");
        outlet.flush(now()).unwrap();
        tokio::time::sleep(Duration::from_millis(1)).await;
    }
}

#[tokio::test]
#[ignore = "needs Cyclone DDS"]
async fn a_message_arrives_with_its_byte_order_in_front() {
    let domain = join(11);
    let _peer =
        Peer::start("pub --topic ua_11_1_1 --type std_msgs/String --domain 11 --value \"hello\"");
    let requested = writers_of(&domain, "rt/ua_11_1_1");
    let mut inbox = Inbox::new();
    inbox.insert(
        (),
        domain.reader("rt/ua_11_1_1", STRING, requested).unwrap(),
    );
    let (bytes, missing) = sample(&mut inbox).await;
    assert_eq!(bytes[..14], string("hello")[..14]);
    assert_eq!(missing, 0);
}

#[tokio::test]
#[ignore = "needs Cyclone DDS"]
async fn ten_thousand_messages_at_1_khz_arrive_in_order_without_loss() {
    let domain = join(12);
    let mut inbox = Inbox::new();
    let peer = Peer::start(
        "pub --topic ua_12_1_1 --type std_msgs/UInt32 --domain 12 --count 10000 --rate 1000 --no-wait --transient-local --depth 2000",
    );
    let requested = writers_of(&domain, "rt/ua_12_1_1");
    inbox.insert(
        (),
        domain.reader("rt/ua_12_1_1", UINT32, requested).unwrap(),
    );
    for expected in 0..10_000_u32 {
        let (bytes, missing) = sample(&mut inbox).await;
        assert_eq!(missing, 0, "before {expected}");
        assert_eq!(bytes[4..8], expected.to_le_bytes());
    }
    drop(peer);
}

#[tokio::test]
#[ignore = "needs Cyclone DDS"]
async fn ten_thousand_messages_at_1_khz_are_written_without_loss() {
    let domain = join(13);
    let mut out = outlet(
        &domain,
        "rt/ua_1_1_1",
        UINT32,
        Offered::DropOldest(NonZeroU16::new(1000).unwrap()),
    );
    let mut peer = Peer::start(
        "sub --topic ua_1_1_1 --type std_msgs/UInt32 --domain 13 --count 10000 --depth 1000 --timeout 30",
    );
    meet_readers(&domain, &mut out, "rt/ua_1_1_1");
    assert!(peer.line()["matched_after"].is_number());
    let begin = Instant::now();
    for number in 0..10_000_u32 {
        let mut payload = vec![0, 1, 0, 0];
        payload.extend_from_slice(&number.to_le_bytes());
        out.offer(Payload::to_write(payload.into()).unwrap(), None, now())
            .unwrap();
        tokio::time::sleep_until((begin + Duration::from_millis(u64::from(number))).into()).await;
        out.flush(now()).unwrap();
    }
    sent(&mut out).await;
    for expected in 0..10_000_u32 {
        assert_eq!(peer.line()["value"], expected);
    }
}

#[tokio::test]
#[ignore = "needs Cyclone DDS"]
async fn a_late_joiner_gets_the_last_value_and_no_older_one() {
    let domain = join(14);
    let mut out = outlet(&domain, "rt/ua_1_1_2", STRING, Offered::KeepLatest);
    for value in ["first", "second", "last"] {
        out.offer(
            Payload::to_write(string(value).into()).unwrap(),
            None,
            now(),
        )
        .unwrap();
    }
    let mut peer =
        Peer::start("sub --topic ua_1_1_2 --type std_msgs/String --domain 14 --transient-local");
    meet_readers(&domain, &mut out, "rt/ua_1_1_2");
    sent(&mut out).await;
    assert!(peer.line()["matched_after"].is_number());
    assert_eq!(peer.line()["value"], "last");

    let mut later =
        Peer::start("sub --topic ua_1_1_2 --type std_msgs/String --domain 14 --transient-local");
    assert!(later.line()["matched_after"].is_number());
    assert_eq!(later.line()["value"], "last");
}

#[tokio::test]
#[ignore = "needs Cyclone DDS"]
async fn a_transient_local_value_from_before_our_time_is_read() {
    let _peer = Peer::start(
        "pub --topic ua_15_1_1 --type std_msgs/String --domain 15 --transient-local --no-wait --linger 20 --value \"old\"",
    );
    let domain = join(15);
    let requested = writers_of(&domain, "rt/ua_15_1_1");
    let mut inbox = Inbox::new();
    inbox.insert(
        (),
        domain.reader("rt/ua_15_1_1", STRING, requested).unwrap(),
    );
    let (bytes, _) = sample(&mut inbox).await;
    assert_eq!(bytes[..12], string("old")[..12]);
}

#[tokio::test]
#[ignore = "needs Cyclone DDS"]
async fn a_large_message_of_odd_length_crosses_both_ways() {
    let domain = join(16);
    let mut inbox = Inbox::new();
    inbox.insert(
        (),
        domain
            .reader("rt/ua_16_1_1", STRING, Requested::from_writers(&[]))
            .unwrap(),
    );
    let _peer = Peer::start(
        "pub --topic ua_16_1_1 --type std_msgs/String --domain 16 --count 1 --size 100001 --linger 20",
    );
    let (bytes, _) = sample(&mut inbox).await;
    assert_eq!(bytes[4..8], 100_002_u32.to_le_bytes());

    let mut out = outlet(&domain, "rt/ua_1_1_3", STRING, Offered::KeepLatest);
    let mut peer =
        Peer::start("sub --topic ua_1_1_3 --type std_msgs/String --domain 16 --digest --count 10");
    meet_readers(&domain, &mut out, "rt/ua_1_1_3");
    assert!(peer.line()["matched_after"].is_number());
    for length in 99_991..100_001 {
        let text = "y".repeat(length);
        out.offer(
            Payload::to_write(string(&text).into()).unwrap(),
            None,
            now(),
        )
        .unwrap();
    }
    sent(&mut out).await;
    for length in 99_991..100_001 {
        assert_eq!(peer.line()["length"], length);
    }
}

#[tokio::test]
#[ignore = "needs Cyclone DDS"]
async fn a_replaced_reader_repeats_nothing() {
    let domain = join(17);
    let mut inbox = Inbox::new();
    let slot = inbox.insert(
        (),
        domain
            .reader("rt/ua_17_1_1", UINT32, Requested::from_writers(&[]))
            .unwrap(),
    );
    let _peer = Peer::start(
        "pub --topic ua_17_1_1 --type std_msgs/UInt32 --domain 17 --count 300 --rate 100 --linger 20",
    );
    let requested = writers_of(&domain, "rt/ua_17_1_1");
    let mut retired = Vec::new();
    for expected in 0..300_u32 {
        let (bytes, missing) = sample(&mut inbox).await;
        assert_eq!(missing, 0);
        assert_eq!(bytes[4..8], expected.to_le_bytes());
        if expected % 100 == 50 {
            let reader = domain.reader("rt/ua_17_1_1", UINT32, requested).unwrap();
            retired.push(inbox.replace(slot, reader).unwrap());
        }
    }
}

#[tokio::test]
async fn leaving_a_domain_ends_in_time() {
    let domain = join(18);
    let mut inbox = Inbox::new();
    for n in 0..50 {
        let topic = format!("rt/ua_18_1_{}", n + 1);
        inbox.insert(
            (),
            domain
                .reader(&topic, UINT32, Requested::from_writers(&[]))
                .unwrap(),
        );
    }
    let begin = Instant::now();
    assert!(domain.leave(inbox).await);
    assert!(
        begin.elapsed() < Duration::from_secs(2),
        "{:?}",
        begin.elapsed()
    );
}
