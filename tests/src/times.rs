//! The processor time of a process by the scheduler's count, and summaries of benchmark figures.

use std::fs;
use std::time::Duration;

/// Returns the processor time of a process so far, over its living threads.
///
/// `/proc/PID/stat` counts in ticks of 10 ms; the scheduler's own count is in nanoseconds.
///
/// # Panics
/// Panics if the process has ended.
#[must_use]
pub fn processor_time(pid: u32) -> Duration {
    let threads = fs::read_dir(format!("/proc/{pid}/task")).unwrap();
    let nanoseconds = threads.filter_map(|thread| {
        // A thread may end between the listing and the read.
        let counts = fs::read_to_string(thread.ok()?.path().join("schedstat")).ok()?;
        counts.split_whitespace().next()?.parse::<u64>().ok()
    });
    Duration::from_nanos(nanoseconds.sum())
}

/// Times of many messages.
#[derive(Debug, Default)]
pub struct Times(Vec<Duration>);

impl Times {
    /// Adds the time of a message.
    pub fn add(&mut self, time: Duration) {
        self.0.push(time);
    }

    /// Adds the times of other messages of the same kind.
    pub fn extend(&mut self, other: Self) {
        self.0.extend(other.0);
    }

    /// Returns the number of messages.
    #[must_use]
    pub fn count(&self) -> u64 {
        self.0.len() as u64
    }

    /// Returns the time that this share of the messages did not exceed, in microseconds.
    #[must_use]
    pub fn at(&mut self, share: f64) -> f64 {
        self.0.sort_unstable();
        let last = self.0.len().saturating_sub(1);
        let place = (last as f64 * share) as usize;
        self.0.get(place).map_or(f64::NAN, |time| micros(*time))
    }

    /// Returns the mean of the times, in microseconds.
    #[must_use]
    pub fn mean(&self) -> f64 {
        let sum: f64 = self.0.iter().map(|time| micros(*time)).sum();
        sum / self.0.len() as f64
    }
}

/// Returns the time in microseconds.
#[must_use]
pub fn micros(time: Duration) -> f64 {
    time.as_secs_f64() * 1e6
}

/// Returns the processor time per message, in microseconds.
#[must_use]
pub fn per_message(time: Duration, messages: u64) -> f64 {
    micros(time) / messages as f64
}
