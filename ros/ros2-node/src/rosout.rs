//! `/rosout`: publishes log records of the program as messages of the graph.

use std::collections::VecDeque;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::thread::Thread;

use bytes::{BufMut, Bytes};
use log_limit::{LogRecord, LogSink};
use rustdds::policy::{Durability, History, Lifespan, ResourceLimits};
use rustdds::{Duration, QosPolicies, QosPolicyBuilder};
use tracing::Level;

use crate::clock::{Ros2Clock, Ros2Time};
use crate::discovery_info::Cdr;

/// Collects warnings and errors of all threads, for the node's thread to publish.
#[derive(Debug)]
pub struct Rosout {
    waiting: Mutex<WaitingLogs>,
    clock: Ros2Clock,
    publisher: Thread,
}

#[derive(Debug, Default)]
struct WaitingLogs {
    records: VecDeque<(Ros2Time, LogRecord)>,
    dropped: u64,
}

impl Rosout {
    /// Creates the queue. `publisher` is woken when a record is added.
    pub(crate) fn new(clock: Ros2Clock, publisher: Thread) -> Self {
        Self {
            waiting: Mutex::default(),
            clock,
            publisher,
        }
    }

    /// Passes waiting records to `write` as serialized `rcl_interfaces/msg/Log`s of the logger
    /// `name`, oldest first, until `write` returns false. Returns whether records still wait.
    pub(crate) fn flush(&self, name: &str, mut write: impl FnMut(Bytes) -> bool) -> bool {
        while let Some((stamp, record)) = self.next() {
            // Without the lock: RustDDS may log during the write.
            if !write(encode(stamp, &record, name)) {
                let mut waiting = self.lock();
                if waiting.records.len() < MAX_WAITING {
                    waiting.records.push_front((stamp, record));
                } else {
                    waiting.dropped += 1;
                }
                return true;
            }
        }
        false
    }

    fn next(&self) -> Option<(Ros2Time, LogRecord)> {
        let mut waiting = self.lock();
        let (stamp, mut record) = waiting.records.pop_front()?;
        let dropped = std::mem::take(&mut waiting.dropped);
        if dropped > 0 {
            let note = format!(" ({dropped} messages before it were dropped)");
            record.message.push_str(&note);
        }
        Some((stamp, record))
    }

    fn lock(&self) -> MutexGuard<'_, WaitingLogs> {
        self.waiting.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl LogSink for Rosout {
    fn hear(&self, record: LogRecord) {
        let stamp = self.clock.now();
        {
            let mut waiting = self.lock();
            if waiting.records.len() >= MAX_WAITING {
                waiting.dropped += 1;
                waiting.records.pop_front();
            }
            waiting.records.push_back((stamp, record));
        }
        self.publisher.unpark();
    }
}

fn encode(stamp: Ros2Time, record: &LogRecord, name: &str) -> Bytes {
    let mut out = Cdr::new();
    out.0.put_i32_le(stamp.sec);
    out.u32(stamp.nanosec);
    out.0.put_u8(level(record.level));
    out.string(name);
    out.string(cut(&record.message));
    out.string(record.file.unwrap_or_default());
    // The function; tracing knows the module.
    out.string(record.module.unwrap_or_default());
    out.u32(record.line.unwrap_or_default());
    out.0.freeze()
}

/// Returns the constant of `rcl_interfaces/msg/Log`.
fn level(level: Level) -> u8 {
    match level {
        Level::ERROR => 40,
        Level::WARN => 30,
        Level::INFO => 20,
        _ => 10,
    }
}

fn cut(text: &str) -> &str {
    let fits = |end: &usize| text.is_char_boundary(*end);
    let end = (0..=MAX_TEXT.min(text.len())).rev().find(fits);
    text.get(..end.unwrap_or_default()).unwrap_or_default()
}

/// The topic of log messages.
pub(crate) const TOPIC: &str = "rt/rosout";
/// The DDS type of the topic.
pub(crate) const TYPE: &str = "rcl_interfaces::msg::dds_::Log_";
/// Maximum number of waiting records; beyond it, the oldest is dropped.
const MAX_WAITING: usize = 256;
/// Maximum size of a message in bytes.
const MAX_TEXT: usize = 8192;
/// As in `rcl_qos_profile_rosout_default`.
const DEPTH: i32 = 1000;

/// Returns the policies that rclcpp offers on `/rosout`: reliable, transient-local, 1000 messages
/// of up to 10 s.
pub(crate) fn qos() -> QosPolicies {
    QosPolicyBuilder::new()
        .reliable(Duration::ZERO)
        .durability(Durability::TransientLocal)
        .history(History::KeepLast { depth: DEPTH })
        .resource_limits(ResourceLimits {
            max_samples: DEPTH,
            max_instances: 1,
            max_samples_per_instance: DEPTH,
        })
        .lifespan(Lifespan {
            duration: Duration::from_secs(10),
        })
        .build()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn record(message: &str) -> LogRecord {
        LogRecord {
            level: Level::WARN,
            message: message.to_owned(),
            file: Some("port.rs"),
            module: Some("bridge_ros2::port"),
            line: Some(7),
        }
    }

    #[test]
    fn a_warning_is_a_log_message_of_the_node() {
        let stamp = Ros2Time { sec: 1, nanosec: 2 };
        let bytes = encode(stamp, &record("slow"), "bridge");
        let mut wanted = vec![0, 1, 0, 0, 1, 0, 0, 0, 2, 0, 0, 0, 30, 0, 0, 0];
        wanted.extend(b"\x07\0\0\0bridge\0\0\x05\0\0\0slow\0\0\0\0\x08\0\0\0port.rs\0");
        wanted.extend(b"\x12\0\0\0bridge_ros2::port\0\0\0\x07\0\0\0");
        assert_eq!(&bytes[..], &wanted[..]);
    }

    #[test]
    fn when_too_many_wait_the_oldest_give_way_and_the_next_says_how_many() {
        let rosout = Rosout::new(Ros2Clock::default(), std::thread::current());
        for number in 0..MAX_WAITING + 3 {
            rosout.hear(record(&format!("number {number}")));
        }
        let mut published = Vec::new();
        let waits = rosout.flush("bridge", |log| {
            published.push(String::from_utf8_lossy(&log).into_owned());
            published.len() < 3
        });
        assert!(waits);
        let note = "number 3 (3 messages before it were dropped)";
        assert!(published[0].contains(note), "{}", published[0]);
        assert!(!published[1].contains("dropped"));
        // The third record was refused, so it is passed again.
        let mut again = Vec::new();
        assert!(!rosout.flush("bridge", |log| {
            again.push(String::from_utf8_lossy(&log).into_owned());
            true
        }));
        assert_eq!((again.len(), &again[0]), (MAX_WAITING - 2, &published[2]));
    }

    #[test]
    fn a_long_message_is_cut_between_letters() {
        let bytes = encode(
            Ros2Time::default(),
            &record(&"ü".repeat(MAX_TEXT)),
            "bridge",
        );
        assert!(bytes.len() < MAX_TEXT + 200, "{}", bytes.len());
    }
}
