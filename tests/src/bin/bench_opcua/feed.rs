//! Values of space 2, as a robot sends them.

use std::net::UdpSocket;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use system_tests::{GROUP, micros, now};
use uadp::{DataSetHeader, GroupHeader, NetworkHeader, NetworkMessageEncoder, PublisherId, Scalar};

use crate::servers::{FIRST, SPACE};

/// A publisher of values.
pub(crate) struct ValueSender {
    socket: UdpSocket,
    datagram: Vec<u8>,
}

impl ValueSender {
    pub(crate) fn new() -> Self {
        Self {
            // The socket joins no group, because it receives nothing.
            socket: UdpSocket::bind("127.0.0.1:0").unwrap(),
            datagram: Vec::new(),
        }
    }

    /// Sends a value for each of the variables with these numbers, in a single datagram.
    pub(crate) fn send(&mut self, numbers: &[usize], sequence: u16, value: f64) {
        let header = NetworkHeader {
            publisher_id: Some(PublisherId::UInt16(2)),
            group: Some(GroupHeader {
                writer_group_id: Some(SPACE),
                ..GroupHeader::default()
            }),
            ..NetworkHeader::default()
        };
        let ids: Vec<u16> = numbers
            .iter()
            .map(|number| u16::try_from(FIRST as usize + number).unwrap())
            .collect();
        self.datagram.clear();
        let mut message =
            NetworkMessageEncoder::new(&mut self.datagram, &header, Some(&ids)).unwrap();
        let header = DataSetHeader {
            sequence_number: Some(sequence),
            ..DataSetHeader::default()
        };
        for _ in &ids {
            let mut frame = message.key_frame(&header).unwrap();
            frame.scalar(Scalar::Double(value)).unwrap();
            frame.finish().unwrap();
        }
        message.finish().unwrap();
        let sent = self.socket.send_to(&self.datagram, GROUP).unwrap();
        assert_eq!(sent, self.datagram.len());
    }
}

/// Changes all variables each [`PERIOD`] while it is running. The value is the time of the change,
/// in microseconds of the machine's monotonic clock.
pub(crate) struct ValueFeed {
    variables: usize,
    sequence: u16,
    running: Option<(Arc<AtomicBool>, JoinHandle<u16>)>,
}

impl ValueFeed {
    pub(crate) const fn of(variables: usize) -> Self {
        Self {
            variables,
            sequence: 0,
            running: None,
        }
    }

    pub(crate) fn change(&mut self, on: bool) {
        if let Some((stop, thread)) = self.running.take() {
            stop.store(true, Ordering::Relaxed);
            self.sequence = thread.join().unwrap();
        }
        if on {
            let stop = Arc::<AtomicBool>::default();
            let (stopped, variables, sequence) = (Arc::clone(&stop), self.variables, self.sequence);
            let thread = std::thread::spawn(move || change(&stopped, variables, sequence));
            self.running = Some((stop, thread));
        }
    }
}

impl Drop for ValueFeed {
    fn drop(&mut self) {
        self.change(false);
    }
}

fn change(stopped: &AtomicBool, variables: usize, mut sequence: u16) -> u16 {
    let numbers: Vec<usize> = (0..variables).collect();
    let mut sender = ValueSender::new();
    let mut due = Instant::now();
    while !stopped.load(Ordering::Relaxed) {
        sequence = sequence.wrapping_add(1);
        let value = micros(now());
        for numbers in numbers.chunks(A_DATAGRAM) {
            sender.send(numbers, sequence, value);
        }
        due += PERIOD;
        std::thread::sleep(due.saturating_duration_since(Instant::now()));
    }
    sequence
}

/// Interval of changes: out of step with the publishing interval of 100 ms, so that a change waits
/// for any part of it.
pub(crate) const PERIOD: Duration = Duration::from_millis(103);
/// Maximum number of values in a datagram.
const A_DATAGRAM: usize = 25;
