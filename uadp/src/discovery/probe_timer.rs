//! Schedules the probes of a Subscriber: after a random delay, and at increasing intervals.

use core::time::Duration;

/// Timing of the probes for a piece of information that a Subscriber needs from a Publisher
/// (OPC 10000-14, 7.2.4.6.12.2).
///
/// A probe is sent after a random delay of 100 to 500 ms, so that one of many Subscribers sends it
/// and the others receive it. The Subscriber then waits for the response, 500 ms at first and twice
/// as long after each of its probes. Create a timer when metadata are missing or a version changed;
/// call [`poll`](Self::poll) at the time of [`poll_timeout`](Self::poll_timeout).
/// ```
/// use std::time::Duration;
/// use uadp::discovery::{ProbeLimits, ProbeStep, ProbeTimer};
///
/// let ms = Duration::from_millis;
/// let mut timer = ProbeTimer::new(ms(0), 0, ProbeLimits::default()); // the random number 0 is the shortest delay
/// assert_eq!(timer.poll_timeout(), Some(ms(100)));
/// assert_eq!(timer.poll(ms(100), 0), ProbeStep::Send);
/// assert_eq!(timer.poll_timeout(), Some(ms(600)));
/// timer.handle_answer();
/// assert_eq!(timer.poll(ms(600), 0), ProbeStep::Answered);
/// ```
#[derive(Debug, Clone)]
pub struct ProbeTimer {
    limits: ProbeLimits,
    state: State,
    /// Time to wait after the next probe.
    period: Duration,
    /// Number of sent probes.
    sent: u32,
    /// The last probe was sent by another Subscriber.
    relied: bool,
}

/// Limits of a [`ProbeTimer`]; the standard leaves both to the Subscriber.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct ProbeLimits {
    /// Maximum time to wait for a response, at least 500 ms.
    pub max_period: Duration,
    /// Maximum number of probes.
    pub attempts: u32,
}

/// Result of [`ProbeTimer::poll`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum ProbeStep {
    /// Wait until [`poll_timeout`](ProbeTimer::poll_timeout).
    Wait,
    /// Send the probe for the missing information.
    Send,
    /// The probing has ended with a response.
    Answered,
    /// The probing has ended: the maximum number of probes got no response.
    GivenUp,
}

#[derive(Debug, Clone, Copy)]
enum State {
    /// A probe is due at this time, unless another Subscriber sends it.
    Delayed(Duration),
    /// A probe was sent; the timer waits for the response until this time.
    Waiting(Duration),
    Answered,
    GivenUp,
}

impl ProbeTimer {
    /// Creates a timer and delays the first probe. `now` counts from any fixed time, `random` is
    /// any random number.
    #[must_use]
    pub fn new(now: Duration, random: u32, limits: ProbeLimits) -> Self {
        Self {
            limits,
            state: State::Delayed(now.saturating_add(delay(random))),
            period: FIRST_PERIOD,
            sent: 0,
            relied: false,
        }
    }

    /// Returns the step that is due. `random` determines the delay of the next probe.
    pub fn poll(&mut self, now: Duration, random: u32) -> ProbeStep {
        match self.state {
            State::Delayed(due) if now >= due => {
                self.sent = self.sent.saturating_add(1);
                self.relied = false;
                self.wait(now);
                self.period = self.period.saturating_mul(2);
                ProbeStep::Send
            }
            State::Waiting(until) if now >= until && self.sent >= self.limits.attempts => {
                self.state = State::GivenUp;
                ProbeStep::GivenUp
            }
            State::Waiting(until) if now >= until => {
                self.state = State::Delayed(now.saturating_add(delay(random)));
                ProbeStep::Wait
            }
            State::Delayed(_) | State::Waiting(_) => ProbeStep::Wait,
            State::Answered => ProbeStep::Answered,
            State::GivenUp => ProbeStep::GivenUp,
        }
    }

    /// Handles a probe of another Subscriber that requests at least the missing information from
    /// the same Publisher. A delayed probe is then not sent, because the response to the other
    /// probe suffices. This does not happen twice in a row, so other Subscribers cannot prevent the
    /// probing.
    pub fn handle_probe(&mut self, now: Duration) {
        if let State::Delayed(_) = self.state
            && !self.relied
        {
            self.relied = true;
            self.wait(now);
        }
    }

    /// Handles a response that contains or refuses (with a bad status) all missing information.
    /// Ends the probing, even after it was given up.
    pub const fn handle_answer(&mut self) {
        self.state = State::Answered;
    }

    /// Returns the time of the next [`poll`](Self::poll), or `None` if the probing has ended.
    #[must_use]
    pub const fn poll_timeout(&self) -> Option<Duration> {
        match self.state {
            State::Delayed(at) | State::Waiting(at) => Some(at),
            State::Answered | State::GivenUp => None,
        }
    }

    fn wait(&mut self, now: Duration) {
        let longest = self.limits.max_period.max(FIRST_PERIOD);
        self.state = State::Waiting(now.saturating_add(self.period.min(longest)));
    }
}

/// At most 30 s of waiting, 8 attempts: about 90 s in total.
impl Default for ProbeLimits {
    fn default() -> Self {
        Self {
            max_period: Duration::from_secs(30),
            attempts: 8,
        }
    }
}

/// Returns an evenly distributed delay of 100 to 500 ms.
fn delay(random: u32) -> Duration {
    let spread = (u64::from(random) * (SPREAD_NANOS + 1)) >> 32;
    SHORTEST_DELAY + Duration::from_nanos(spread)
}

const SHORTEST_DELAY: Duration = Duration::from_millis(100);
const SPREAD_NANOS: u64 = 400_000_000;
const FIRST_PERIOD: Duration = Duration::from_millis(500);

#[cfg(test)]
mod tests {
    use super::*;

    const LIMITS: ProbeLimits = ProbeLimits {
        max_period: Duration::from_secs(2),
        attempts: 4,
    };

    fn ms(millis: u64) -> Duration {
        Duration::from_millis(millis)
    }

    /// Polls at each timeout. Returns the times of the probes and of giving up.
    fn run(timer: &mut ProbeTimer, random: u32) -> (Vec<Duration>, Duration) {
        let mut sent = Vec::new();
        let mut now = Duration::ZERO;
        while let Some(at) = timer.poll_timeout() {
            now = at;
            if timer.poll(now, random) == ProbeStep::Send {
                sent.push(now);
            }
        }
        (sent, now)
    }

    #[test]
    fn the_delay_is_between_100_and_500_ms() {
        assert_eq!(delay(0), ms(100));
        assert_eq!(delay(1 << 31), ms(300));
        assert_eq!(delay(u32::MAX), ms(500));
    }

    #[test]
    fn each_probe_is_waited_for_twice_as_long_as_the_one_before() {
        let mut timer = ProbeTimer::new(Duration::ZERO, 0, LIMITS);
        let (sent, end) = run(&mut timer, 0);
        // 100 ms of delay before each probe; 500, 1000, 2000 and 2000 ms of waiting after it.
        assert_eq!(sent, [ms(100), ms(700), ms(1800), ms(3900)]);
        assert_eq!(end, ms(5900));
        assert_eq!(timer.poll(ms(9999), 0), ProbeStep::GivenUp);
        assert_eq!(timer.poll_timeout(), None);
    }

    #[test]
    fn a_probe_another_subscriber_sent_is_not_sent_but_waited_for() {
        let mut timer = ProbeTimer::new(Duration::ZERO, u32::MAX, LIMITS);
        timer.handle_probe(ms(200));
        assert_eq!(timer.poll_timeout(), Some(ms(700)));
        assert_eq!(timer.poll(ms(500), 0), ProbeStep::Wait);
        assert_eq!(timer.poll(ms(700), 0), ProbeStep::Wait);
        assert_eq!(timer.poll_timeout(), Some(ms(800)));
        assert_eq!(timer.poll(ms(800), 0), ProbeStep::Send);
    }

    #[test]
    fn others_cannot_keep_a_subscriber_from_asking() {
        let mut timer = ProbeTimer::new(Duration::ZERO, 0, LIMITS);
        let mut sent = 0;
        for millis in 0..10_000 {
            timer.handle_probe(ms(millis));
            sent += u32::from(timer.poll(ms(millis), 0) == ProbeStep::Send);
        }
        assert_eq!(sent, LIMITS.attempts);
    }

    #[test]
    fn an_answer_ends_the_probing_whenever_it_comes() {
        let mut early = ProbeTimer::new(Duration::ZERO, 0, LIMITS);
        early.handle_answer();
        assert_eq!(early.poll(ms(100), 0), ProbeStep::Answered);
        assert_eq!(early.poll_timeout(), None);

        let mut late = ProbeTimer::new(Duration::ZERO, 0, LIMITS);
        run(&mut late, 0);
        assert_eq!(late.poll(ms(9999), 0), ProbeStep::GivenUp);
        late.handle_answer();
        assert_eq!(late.poll(ms(9999), 0), ProbeStep::Answered);
    }

    #[test]
    fn an_answer_is_waited_for_500_ms_whatever_the_limits_say() {
        let hasty = ProbeLimits {
            max_period: Duration::ZERO,
            attempts: 1,
        };
        let mut timer = ProbeTimer::new(Duration::ZERO, 0, hasty);
        assert_eq!(timer.poll(ms(100), 0), ProbeStep::Send);
        assert_eq!(timer.poll_timeout(), Some(ms(600)));
    }

    #[test]
    fn the_end_of_time_does_not_overflow() {
        let mut timer = ProbeTimer::new(Duration::MAX, u32::MAX, ProbeLimits::default());
        assert_eq!(timer.poll(Duration::MAX, 0), ProbeStep::Send);
        assert_eq!(timer.poll_timeout(), Some(Duration::MAX));
    }
}
