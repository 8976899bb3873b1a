//! Messages between carriers in shared memory.
#![cfg(feature = "shm")]

use std::sync::atomic::{AtomicU32, Ordering};
use std::time::Duration;

use tokio::time::timeout;
use transport::{BUFFER, Carrier, OutgoingMessage, Received, SendError, SharedMemory};

const SOON: Duration = Duration::from_secs(20);

/// Returns the name of a group that no other test has.
fn group() -> String {
    static GROUPS: AtomicU32 = AtomicU32::new(0);
    let number = GROUPS.fetch_add(1, Ordering::Relaxed);
    format!("test-{}-{number}", std::process::id())
}

fn join(group: &str) -> Box<dyn Carrier> {
    Box::new(SharedMemory::open(group).unwrap())
}

fn send(carrier: &mut dyn Carrier, bytes: &[u8]) -> Result<(), SendError> {
    carrier.try_send(&OutgoingMessage::new(bytes))
}

async fn receive(carrier: &mut dyn Carrier) -> (Received, Vec<u8>) {
    let mut buffer = vec![0; BUFFER];
    let received = timeout(SOON, carrier.recv(&mut buffer)).await;
    let received = received.expect("a message arrives").unwrap();
    buffer.truncate(received.length);
    (received, buffer)
}

#[tokio::test]
async fn each_program_of_the_group_receives_what_the_others_send_in_order() {
    let name = group();
    let [mut a, mut b, mut c] = [(); 3].map(|()| join(&name));
    let mut other = join(&group());
    for number in 0_u8..100 {
        send(a.as_mut(), &[number]).unwrap();
    }
    send(b.as_mut(), b"of b").unwrap();
    let mut senders = Vec::new();
    for carrier in [&mut b, &mut c] {
        for number in 0_u8..100 {
            let (received, bytes) = receive(carrier.as_mut()).await;
            assert_eq!(bytes, [number]);
            assert!(
                received
                    .stamp
                    .is_some_and(|stamp| stamp.elapsed().unwrap() < SOON)
            );
            senders.push(received.from);
        }
    }
    let (of_b, bytes) = receive(c.as_mut()).await;
    assert_eq!(bytes, b"of b");
    assert_eq!(receive(a.as_mut()).await.1, b"of b");
    senders.dedup();
    assert_eq!(senders.len(), 1, "one address for a sender: {senders:?}");
    assert_ne!(senders[0], of_b.from);
    // Own messages and those of other groups are not received.
    let mut buffer = vec![0; BUFFER];
    for carrier in [&mut a, &mut b, &mut other] {
        assert!(carrier.try_recv(&mut buffer).is_none());
    }
}

#[tokio::test]
async fn a_message_wakes_a_program_that_waits() {
    let name = group();
    let (mut a, mut b) = (join(&name), join(&name));
    let waits = tokio::spawn(async move { receive(b.as_mut()).await.1 });
    tokio::task::yield_now().await;
    send(a.as_mut(), b"wake up").unwrap();
    assert_eq!(waits.await.unwrap(), b"wake up");
}

#[tokio::test]
async fn the_largest_datagram_arrives_whole_and_a_larger_one_is_refused() {
    let name = group();
    let (mut a, mut b) = (join(&name), join(&name));
    let largest = vec![7; 65_507];
    send(a.as_mut(), b"small").unwrap();
    send(a.as_mut(), &largest).unwrap();
    assert_eq!(send(a.as_mut(), &[0; 65_508]), Err(SendError::TooBig));
    assert_eq!(receive(b.as_mut()).await.1, b"small");
    assert!(receive(b.as_mut()).await.1 == largest);
}

#[tokio::test]
async fn a_program_that_does_not_read_loses_messages_and_blocks_nobody() {
    let name = group();
    let [mut a, frozen, mut reads] = [(); 3].map(|()| join(&name));
    let mut buffer = vec![0; BUFFER];
    for number in 0_u32..5000 {
        send(a.as_mut(), &number.to_le_bytes()).unwrap();
        let _own = a.try_recv(&mut buffer);
        assert_eq!(receive(reads.as_mut()).await.1, number.to_le_bytes());
    }
    let dropped = a.dropped();
    let full = dropped
        .iter()
        .find(|(reason, _)| *reason == "receiver_full");
    let full = full.unwrap().1;
    assert!((4500..5000).contains(&full), "{dropped:?}");
    // The oldest messages are there when it reads again, and the next ones arrive.
    let mut frozen = frozen;
    let mut count = 0;
    while frozen.try_recv(&mut buffer).is_some() {
        count += 1;
    }
    assert_eq!(count + full, 5000);
    send(a.as_mut(), b"next").unwrap();
    assert_eq!(receive(frozen.as_mut()).await.1, b"next");
}

#[tokio::test]
async fn a_sender_goes_on_beside_many_programs_that_do_not_read() {
    let name = group();
    let mut a = join(&name);
    let mut reads = join(&name);
    let mut frozen = Vec::new();
    let mut buffer = vec![0; BUFFER];
    let mut number = 0_u32;
    // Each of them holds other messages than those before.
    for _ in 0..12 {
        frozen.push(join(&name));
        for _ in 0..300 {
            number += 1;
            let mut bytes = number.to_le_bytes().to_vec();
            bytes.resize(5000, 7);
            send(a.as_mut(), &bytes).unwrap();
            let _own = a.try_recv(&mut buffer);
            assert!(receive(reads.as_mut()).await.1 == bytes);
        }
    }
    for frozen in &mut frozen {
        assert!(frozen.try_recv(&mut buffer).is_some());
    }
}

#[tokio::test]
async fn a_program_that_joins_late_gets_nothing_that_was_sent_before() {
    let name = group();
    let mut a = join(&name);
    send(a.as_mut(), b"before").unwrap();
    let mut late = join(&name);
    send(a.as_mut(), b"after").unwrap();
    assert_eq!(receive(late.as_mut()).await.1, b"after");
}

#[test]
fn a_group_that_cannot_be_opened_is_named_with_the_remedy() {
    let error = SharedMemory::open(&"x".repeat(300)).unwrap_err();
    let text = error.to_string();
    assert!(
        text.contains("xxx") && text.contains("same version"),
        "{text}"
    );
}
