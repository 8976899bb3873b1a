//! Common times for the periodic work of a process that needs no exact time.
//!
//! An idle process spends more time on a wake-up than on its periodic work. Tasks that wait for the
//! same tick wake the process once.
//!
//! The ticks are [`TICK`] apart. The timer wheel of tokio has slots of 64 ms, and wakes the runtime
//! at the start of the slot of a deadline, and again at the deadline. Ticks at the start of a slot
//! save the second wake-up, so a program calls [`start`] directly before it builds its runtime.

use std::sync::OnceLock;
use std::time::Duration;

use tokio::time::{Instant, sleep_until};

/// The time between two ticks, a multiple of the slots of the timer wheel.
pub const TICK: Duration = Duration::from_millis(256);

static START: OnceLock<Instant> = OnceLock::new();

/// Starts the ticks at the present time, unless they have started.
pub fn start() {
    START.get_or_init(Instant::now);
}

/// Waits for the first tick that is at least `pause` away. Does not wait without a pause.
pub async fn sleep(pause: Duration) {
    if !pause.is_zero() {
        sleep_until(next(Instant::now(), pause)).await;
    }
}

/// Returns the first tick that is at least `pause` after `now`.
#[must_use]
pub fn next(now: Instant, pause: Duration) -> Instant {
    let start = *START.get_or_init(|| now);
    start + round_up(now.saturating_duration_since(start) + pause)
}

/// Rounds a time up to a multiple of [`TICK`].
fn round_up(time: Duration) -> Duration {
    let tick = TICK.as_millis();
    // A fraction of a millisecond is rounded up.
    let ticks = time.saturating_sub(Duration::from_nanos(1)).as_millis() / tick + 1;
    let ticks = if time.is_zero() { 0 } else { ticks };
    TICK * u32::try_from(ticks).unwrap_or(u32::MAX)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_time_is_rounded_up_to_the_next_tick() {
        let nano = Duration::from_nanos(1);
        for (time, ticks) in [
            (Duration::ZERO, 0),
            (nano, 1),
            (TICK - nano, 1),
            (TICK, 1),
            (TICK + nano, 2),
            (TICK * 7, 7),
        ] {
            assert_eq!(round_up(time), TICK * ticks, "{time:?}");
        }
    }

    #[test]
    fn tasks_that_start_at_different_times_wake_together() {
        let now = Instant::now();
        start();
        let half = next(now, Duration::from_millis(500));
        assert!(half >= now + Duration::from_millis(500));
        assert!(half < now + Duration::from_millis(500) + TICK);
        let other = half - TICK / 2;
        assert_eq!(next(other, TICK / 2), half);
        assert_eq!(next(other, TICK / 3), half);
        assert_eq!(next(other, TICK), half + TICK);
    }
}
