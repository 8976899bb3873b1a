//! Asking what a type is: when, and when again.

use std::collections::BTreeSet;
use std::time::Duration;

use rustdds::GUID;
use tokio::time::Instant;

/// How far the asking for one type is.
#[derive(Debug)]
pub(super) struct Inquiry {
    state: State,
    /// Endpoints of that type that were there when it was asked for.
    seen: BTreeSet<GUID>,
    /// When somebody last wanted to know.
    looked: Instant,
    /// How many calls were made: whoever tells is asked in turn.
    calls: usize,
    /// How long to wait before it is asked for once more; none until nobody told it.
    pause: Option<Duration>,
    /// How often in a row all who could have told it left before they had the time to.
    cut_short: u8,
}

#[derive(Debug)]
enum State {
    /// To be asked for, not before `next`.
    Waiting {
        since: Instant,
        next: Instant,
        tries: u8,
    },
    Asking {
        tries: u8,
    },
    Told,
    /// Nobody told it. To be asked for again then, or when there is somebody new to ask.
    Untold {
        again: Instant,
    },
}

/// What comes of a call, or of nobody to call.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Outcome {
    Told,
    /// It goes on.
    GoesOn,
    /// Nobody told it, for the first time.
    Untold,
    /// Nobody told it this time either.
    UntoldAgain,
}

impl Inquiry {
    pub(super) fn new(now: Instant) -> Self {
        Self {
            state: State::begin(now),
            seen: BTreeSet::new(),
            looked: now,
            calls: 0,
            pause: None,
            cut_short: 0,
        }
    }

    /// Whether endpoints wait for the answer. They do not once nobody told it: it is asked for again beside what goes on.
    pub(super) fn is_waited_for(&self) -> bool {
        match self.state {
            State::Waiting { .. } | State::Asking { .. } => self.pause.is_none(),
            State::Told | State::Untold { .. } => false,
        }
    }

    /// Whether it goes on, and somebody wanted to know lately.
    pub(super) fn is_open(&self, now: Instant) -> bool {
        let goes_on = matches!(self.state, State::Waiting { .. } | State::Asking { .. });
        goes_on && now.saturating_duration_since(self.looked) <= OFFERED_WITHIN
    }

    /// Takes note of the endpoints whose nodes could tell it. Somebody new is worth asking at once; where all others have
    /// left, or nobody wanted to know for a while, it begins anew, with the time that a node has to tell of its services.
    /// Where they leave and come before that time is over, again and again, nothing waits for it any longer.
    pub(super) fn meet(
        &mut self,
        endpoints: impl IntoIterator<Item = GUID>,
        is_there: impl Fn(GUID) -> bool,
        now: Instant,
    ) -> Outcome {
        let lapsed = now.duration_since(self.looked) > OFFERED_WITHIN;
        self.looked = now;
        // While a call is out nobody is noted: who comes then is new at the next look.
        if matches!(self.state, State::Asking { .. } | State::Told) {
            return Outcome::GoesOn;
        }
        let new: Vec<GUID> = endpoints
            .into_iter()
            .filter(|guid| !self.seen.contains(guid))
            .collect();
        let anyone_new = !new.is_empty();
        let unanswered = !self.seen.is_empty() && matches!(self.state, State::Waiting { .. });
        if anyone_new {
            self.seen.retain(|guid| is_there(*guid));
        }
        let anew = lapsed || self.seen.is_empty();
        self.seen.extend(new);
        let mut outcome = Outcome::GoesOn;
        if anew {
            self.cut_short = if unanswered {
                self.cut_short.saturating_add(1)
            } else {
                0
            };
            if self.cut_short < MOST_CUT_SHORT {
                self.pause = None;
            } else if self.pause.is_none() {
                outcome = self.untold(now);
            }
        }
        if anew || anyone_new && matches!(self.state, State::Untold { .. }) {
            self.state = State::begin(now);
        }
        outcome
    }

    /// Whether somebody is to be asked, and how many were before: of those who can tell, the next one's turn it is.
    pub(super) fn due(&mut self, now: Instant) -> Option<usize> {
        if matches!(self.state, State::Untold { again } if now >= again) {
            self.state = State::begin(now);
        }
        let State::Waiting { next, .. } = self.state else {
            return None;
        };
        (now >= next).then_some(self.calls)
    }

    /// A call is out.
    pub(super) fn asked(&mut self) {
        if let State::Waiting { tries, .. } = self.state {
            self.state = State::Asking { tries };
            self.calls = self.calls.wrapping_add(1);
        }
    }

    /// Nobody offers to tell.
    pub(super) fn nobody(&mut self, now: Instant) -> Outcome {
        let State::Waiting { since, .. } = self.state else {
            return Outcome::GoesOn;
        };
        if now.duration_since(since) < OFFERED_WITHIN {
            return Outcome::GoesOn;
        }
        self.untold(now)
    }

    /// The call failed.
    pub(super) fn failed(&mut self, now: Instant) -> Outcome {
        let State::Asking { tries } = self.state else {
            return Outcome::GoesOn;
        };
        let tries = tries.saturating_add(1);
        if tries >= MOST_TRIES {
            return self.untold(now);
        }
        self.state = State::Waiting {
            since: now,
            next: now + PAUSE * u32::from(tries),
            tries,
        };
        Outcome::GoesOn
    }

    pub(super) fn told(&mut self) -> Outcome {
        self.state = State::Told;
        self.seen.clear();
        Outcome::Told
    }

    /// Nobody tells it for the time being.
    pub(super) fn untold(&mut self, now: Instant) -> Outcome {
        let before = self.pause;
        let pause = before.map_or(AGAIN_FIRST, |before| (before * 2).min(AGAIN_MOST));
        self.pause = Some(pause);
        self.state = State::Untold { again: now + pause };
        match before {
            None => Outcome::Untold,
            Some(_) => Outcome::UntoldAgain,
        }
    }
}

impl State {
    fn begin(now: Instant) -> Self {
        Self::Waiting {
            since: now,
            next: now,
            tries: 0,
        }
    }
}

/// How long a node may take to tell its name and services.
const OFFERED_WITHIN: Duration = Duration::from_secs(3);
/// How often all may leave before that time is over: whoever comes next is asked beside what goes on.
const MOST_CUT_SHORT: u8 = 3;
/// Calls for one type.
const MOST_TRIES: u8 = 3;
/// After the first call that failed; longer after the next.
const PAUSE: Duration = Duration::from_secs(1);
/// After which a type that nobody told is asked for again; longer each time.
const AGAIN_FIRST: Duration = Duration::from_secs(10);
const AGAIN_MOST: Duration = Duration::from_secs(300);

#[cfg(test)]
mod tests {
    use super::*;

    fn guid(number: u8) -> GUID {
        GUID::from_bytes([number; 16])
    }

    const OLD: [GUID; 1] = [GUID::GUID_UNKNOWN];
    const LOOK: Duration = Duration::from_millis(200);

    /// One that nobody offers to tell while an endpoint of it is there, and when that was found.
    fn untold(began: Instant) -> (Inquiry, Instant) {
        let mut inquiry = Inquiry::new(began);
        inquiry.meet(OLD, |_| true, began);
        assert_eq!(inquiry.due(began), Some(0));
        assert_eq!(inquiry.nobody(began), Outcome::GoesOn);
        assert!(inquiry.is_waited_for());
        let now = began + OFFERED_WITHIN;
        inquiry.meet(OLD, |_| true, now);
        assert_eq!(inquiry.nobody(now), Outcome::Untold);
        (inquiry, now)
    }

    /// When it is due, looked at from then on, and that.
    fn next_due(inquiry: &mut Inquiry, mut now: Instant) -> Instant {
        let end = now + 2 * AGAIN_MOST;
        loop {
            inquiry.meet(OLD, |_| true, now);
            assert!(!inquiry.is_waited_for());
            if inquiry.due(now).is_some() {
                return now;
            }
            now += LOOK;
            assert!(now < end, "it is never asked for again");
        }
    }

    #[test]
    fn what_nobody_told_is_asked_for_again_at_growing_intervals_and_nothing_waits_for_it() {
        let (mut inquiry, mut now) = untold(Instant::now());
        let mut pauses = Vec::new();
        for _ in 0..7 {
            let due = next_due(&mut inquiry, now);
            pauses.push(due.duration_since(now).as_secs());
            now = due + OFFERED_WITHIN;
            inquiry.meet(OLD, |_| true, now);
            assert_eq!(inquiry.nobody(now), Outcome::UntoldAgain);
        }
        assert_eq!(pauses, [10, 20, 40, 80, 160, 300, 300]);
    }

    #[test]
    fn somebody_new_is_asked_at_once_and_nothing_waits_for_the_answer() {
        let (mut inquiry, untold) = untold(Instant::now());
        let now = untold + LOOK;
        inquiry.meet(OLD, |_| true, now);
        assert_eq!(inquiry.due(now), None);
        inquiry.meet([OLD[0], guid(2)], |_| true, now);
        assert_eq!(inquiry.due(now), Some(0));
        assert!(!inquiry.is_waited_for());
        // Once.
        inquiry.asked();
        assert_eq!(inquiry.due(now), None);
    }

    #[test]
    fn whoever_comes_when_the_others_have_left_is_waited_for_as_the_first_was() {
        let (mut inquiry, untold) = untold(Instant::now());
        let now = untold + LOOK;
        inquiry.meet([guid(2)], |one| one == guid(2), now);
        assert!(inquiry.is_waited_for());
        assert_eq!(inquiry.nobody(now), Outcome::GoesOn);
        assert_eq!(inquiry.nobody(now + OFFERED_WITHIN), Outcome::Untold);
    }

    #[test]
    fn a_node_that_comes_back_has_the_time_to_tell_of_its_services() {
        let began = Instant::now();
        let mut inquiry = Inquiry::new(began);
        inquiry.meet(OLD, |_| true, began);
        let back = began + Duration::from_secs(600);
        inquiry.meet(OLD, |_| true, back);
        assert_eq!(inquiry.nobody(back), Outcome::GoesOn);
        assert_eq!(inquiry.nobody(back + OFFERED_WITHIN), Outcome::Untold);
    }

    #[test]
    fn nodes_that_leave_before_they_could_tell_it_are_not_waited_for_for_ever() {
        let life = OFFERED_WITHIN / 3;
        for away in [LOOK, OFFERED_WITHIN * 2] {
            let mut now = Instant::now();
            let mut inquiry = Inquiry::new(now);
            for number in 0..20 {
                let one = guid(number);
                let first = inquiry.meet([one], |it| it == one, now);
                let is_last = number == MOST_CUT_SHORT;
                assert_eq!(first == Outcome::Untold, is_last, "{number}: {first:?}");
                // Asked all the same.
                assert_eq!(inquiry.due(now), Some(0));
                assert_eq!(inquiry.is_waited_for(), number < MOST_CUT_SHORT, "{number}");
                assert_eq!(inquiry.nobody(now), Outcome::GoesOn);
                now += life;
                assert_eq!(inquiry.meet([one], |it| it == one, now), Outcome::GoesOn);
                assert_eq!(inquiry.nobody(now), Outcome::GoesOn);
                now += away;
            }
            // One that stays and tells nothing has had its time: the next is waited for as the first was.
            let stays = guid(100);
            inquiry.meet([stays], |it| it == stays, now);
            now += OFFERED_WITHIN;
            inquiry.meet([stays], |it| it == stays, now);
            assert_eq!(inquiry.nobody(now), Outcome::UntoldAgain);
            inquiry.meet([guid(101)], |it| it == guid(101), now + LOOK);
            assert!(inquiry.is_waited_for());
        }
    }

    #[test]
    fn who_comes_while_a_call_is_out_is_asked_after_it() {
        let began = Instant::now();
        let mut inquiry = Inquiry::new(began);
        inquiry.meet(OLD, |_| true, began);
        let mut now = began;
        for tries in 0..MOST_TRIES {
            now += PAUSE * 2;
            assert_eq!(inquiry.due(now), Some(usize::from(tries)));
            inquiry.asked();
            inquiry.meet([OLD[0], guid(2)], |_| true, now);
            let last = tries + 1 == MOST_TRIES;
            let outcome = inquiry.failed(now);
            assert_eq!(outcome == Outcome::Untold, last, "{tries}: {outcome:?}");
        }
        assert_eq!(inquiry.due(now), None);
        inquiry.meet([OLD[0], guid(2)], |_| true, now);
        assert_eq!(inquiry.due(now), Some(usize::from(MOST_TRIES)));
    }

    #[test]
    fn what_was_told_is_not_asked_for_again() {
        let now = Instant::now();
        let mut inquiry = Inquiry::new(now);
        inquiry.meet(OLD, |_| true, now);
        inquiry.asked();
        assert_eq!(inquiry.told(), Outcome::Told);
        let later = now + 2 * AGAIN_MOST;
        inquiry.meet([guid(2)], |_| true, later);
        assert_eq!(inquiry.due(later), None);
        assert!(!inquiry.is_waited_for());
    }
}
