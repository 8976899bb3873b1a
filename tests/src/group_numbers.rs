//! Numbers in the values of a topic, as a subscriber of any maker accepts them.

use std::net::Ipv4Addr;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use uadp::{MessageKind, NetworkMessage, PublisherId, Scalar, SequenceOrder, Variant};

use crate::{TopicTriple, UadpSocket, eventually};

/// Receives the numbers of a topic in the group. A message with a sequence number that was received
/// before is not accepted (OPC 10000-14, 7.2.3).
pub struct GroupNumbers {
    accepted: Arc<Mutex<Vec<(Instant, u32)>>>,
    ends: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl GroupNumbers {
    /// Joins the group on the interface with this address.
    #[must_use]
    pub fn of(triple: TopicTriple, interface: Ipv4Addr) -> Self {
        let accepted = Arc::new(Mutex::new(Vec::new()));
        let ends = Arc::new(AtomicBool::new(false));
        let socket = UadpSocket::join_on(interface).of_one_interface();
        let (values, over) = (Arc::clone(&accepted), Arc::clone(&ends));
        let thread = thread::spawn(move || {
            let mut last = None;
            while !over.load(Ordering::Relaxed) {
                if let Some(datagram) = socket.receive(Duration::from_millis(100)) {
                    let accepted = accept(&datagram, triple, &mut last);
                    let accepted = accepted.map(|number| (Instant::now(), number));
                    values.lock().unwrap().extend(accepted);
                }
            }
        });
        Self {
            accepted,
            ends,
            thread: Some(thread),
        }
    }

    /// Returns the accepted numbers in their order.
    ///
    /// # Panics
    /// Panics if the receiving thread has failed.
    #[must_use]
    pub fn values(&self) -> Vec<u32> {
        let accepted = self.accepted.lock().unwrap();
        accepted.iter().map(|(_, number)| *number).collect()
    }

    /// Removes and returns the accepted numbers with their arrivals.
    ///
    /// # Panics
    /// Panics if the receiving thread has failed.
    #[must_use]
    pub fn take(&self) -> Vec<(Instant, u32)> {
        std::mem::take(&mut *self.accepted.lock().unwrap())
    }

    /// Waits for a number that is not lower.
    ///
    /// # Panics
    /// Panics if it does not arrive in time.
    pub fn wait_for(&self, value: u32) {
        eventually(&format!("value {value} or a later one"), SOON, || {
            self.values()
                .last()
                .is_some_and(|last| *last >= value)
                .then_some(())
        });
    }
}

impl Drop for GroupNumbers {
    fn drop(&mut self) {
        self.ends.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            drop(thread.join());
        }
    }
}

/// Returns the number in a value of the topic, unless its sequence number was received before.
fn accept(
    datagram: &[u8],
    (space, group, writer): TopicTriple,
    last: &mut Option<u16>,
) -> Option<u32> {
    let message = NetworkMessage::decode(datagram).ok()?;
    let is_ours = message.publisher_id() == Some(PublisherId::UInt16(space))
        && message.group().and_then(|group| group.writer_group_id) == Some(group);
    if !is_ours {
        return None;
    }
    let message = message.messages().next()?.ok()?;
    if message.writer_id != Some(writer) || message.kind != MessageKind::KeyFrame {
        return None;
    }
    let sequence = message.sequence_number()?;
    if let Some(last) = *last {
        match SequenceOrder::of_u16(last, sequence) {
            SequenceOrder::Newer { .. } => {}
            // A subscriber drops late messages (OPC 10000-14, 7.2.3).
            SequenceOrder::Same | SequenceOrder::Older { .. } => return None,
            order @ SequenceOrder::Invalid => panic!("number {sequence} after {last}: {order:?}"),
        }
    }
    *last = Some(sequence);
    match message.fields().ok()?.next()?.ok()? {
        Variant::Scalar(Scalar::String(Some(text))) => text.parse().ok(),
        _ => None,
    }
}

const SOON: Duration = Duration::from_secs(60);
