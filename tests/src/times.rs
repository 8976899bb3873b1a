//! What a process costs by the scheduler's count, and how figures of a benchmark are summed up.

use std::fs;
use std::time::Duration;

/// The processor time a process has had so far, over its threads that live.
///
/// `/proc/PID/stat` counts in ticks of 10 ms; the scheduler's own count is in nanoseconds.
///
/// # Panics
/// When it is gone.
#[must_use]
pub fn processor_time(pid: u32) -> Duration {
    let threads = fs::read_dir(format!("/proc/{pid}/task")).unwrap();
    let nanoseconds = threads.filter_map(|thread| {
        // A thread may end between the listing and the look.
        let counts = fs::read_to_string(thread.ok()?.path().join("schedstat")).ok()?;
        counts.split_whitespace().next()?.parse::<u64>().ok()
    });
    Duration::from_nanos(nanoseconds.sum())
}

/// Times of many messages.
#[derive(Debug, Default)]
pub struct Times(Vec<Duration>);

impl Times {
    /// One more message.
    pub fn add(&mut self, time: Duration) {
        self.0.push(time);
    }

    /// Those of other messages of the same kind.
    pub fn extend(&mut self, other: Self) {
        self.0.extend(other.0);
    }

    /// How many messages.
    #[must_use]
    pub fn count(&self) -> u64 {
        self.0.len() as u64
    }

    /// The time that this share of the messages did not exceed, in microseconds.
    #[must_use]
    pub fn at(&mut self, share: f64) -> f64 {
        self.0.sort_unstable();
        let last = self.0.len().saturating_sub(1);
        let place = (last as f64 * share) as usize;
        self.0.get(place).map_or(f64::NAN, |time| micros(*time))
    }
}

/// The time in microseconds.
#[must_use]
pub fn micros(time: Duration) -> f64 {
    time.as_secs_f64() * 1e6
}

/// Microseconds of processor time for each of so many messages.
#[must_use]
pub fn per_message(time: Duration, messages: u64) -> f64 {
    micros(time) / messages as f64
}
