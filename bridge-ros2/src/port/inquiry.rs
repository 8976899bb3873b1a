//! The schedule of requests for a type description.

use std::collections::BTreeSet;
use std::time::Duration;

use rustdds::GUID;
use tokio::time::Instant;

/// The state of the requests for a type.
#[derive(Debug)]
pub(super) struct Inquiry {
    state: State,
    /// Endpoints of the type that were present at the request.
    seen: BTreeSet<GUID>,
    /// The time of the last interest in the type.
    looked: Instant,
    /// The number of calls; nodes that offer the service are called in turn.
    calls: usize,
    /// The delay before the next request; `None` before the first failure.
    pause: Option<Duration>,
    /// How often in a row all candidate nodes left before they had time to respond.
    cut_short: u8,
}

#[derive(Debug)]
enum State {
    /// A request is due, not before `next`.
    Waiting {
        since: Instant,
        next: Instant,
        tries: u8,
    },
    Asking {
        tries: u8,
    },
    Told,
    /// No node described the type. It is requested at `again`, or when a new node appears.
    Untold {
        again: Instant,
    },
}

/// The outcome of a call, or of a request without a node to call.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum InquiryOutcome {
    Told,
    /// The inquiry continues.
    GoesOn,
    /// No node described the type, for the first time.
    Untold,
    /// No node described the type, as before.
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

    /// Returns whether endpoints wait for the response. After the first failure they do not wait:
    /// later requests run in the background.
    pub(super) fn is_waited_for(&self) -> bool {
        match self.state {
            State::Waiting { .. } | State::Asking { .. } => self.pause.is_none(),
            State::Told | State::Untold { .. } => false,
        }
    }

    /// Returns whether the inquiry continues and the type is still of interest.
    pub(super) fn is_open(&self, now: Instant) -> bool {
        let goes_on = matches!(self.state, State::Waiting { .. } | State::Asking { .. });
        goes_on && now.saturating_duration_since(self.looked) <= OFFERED_WITHIN
    }

    /// Records the endpoints of nodes that could describe the type.
    ///
    /// A new endpoint is asked at once. The inquiry restarts, with the time that a node needs to
    /// announce its services, when all former endpoints have left or the type was of no interest
    /// for a while. If endpoints repeatedly leave before this time is over, no endpoint waits for
    /// the response any longer.
    pub(super) fn meet(
        &mut self,
        endpoints: impl IntoIterator<Item = GUID>,
        is_there: impl Fn(GUID) -> bool,
        now: Instant,
    ) -> InquiryOutcome {
        let lapsed = now.duration_since(self.looked) > OFFERED_WITHIN;
        self.looked = now;
        // Endpoints are not recorded during a call: an endpoint that appears then is new at the
        // next pass.
        if matches!(self.state, State::Asking { .. } | State::Told) {
            return InquiryOutcome::GoesOn;
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
        let mut outcome = InquiryOutcome::GoesOn;
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

    /// Returns the number of earlier calls if a request is due. The number selects the next node in
    /// turn.
    pub(super) fn due(&mut self, now: Instant) -> Option<usize> {
        if matches!(self.state, State::Untold { again } if now >= again) {
            self.state = State::begin(now);
        }
        let State::Waiting { next, .. } = self.state else {
            return None;
        };
        (now >= next).then_some(self.calls)
    }

    /// Records that a call was sent.
    pub(super) fn asked(&mut self) {
        if let State::Waiting { tries, .. } = self.state {
            self.state = State::Asking { tries };
            self.calls = self.calls.wrapping_add(1);
        }
    }

    /// Records that no node offers the service.
    pub(super) fn nobody(&mut self, now: Instant) -> InquiryOutcome {
        let State::Waiting { since, .. } = self.state else {
            return InquiryOutcome::GoesOn;
        };
        if now.duration_since(since) < OFFERED_WITHIN {
            return InquiryOutcome::GoesOn;
        }
        self.untold(now)
    }

    /// Records that the call failed.
    pub(super) fn failed(&mut self, now: Instant) -> InquiryOutcome {
        let State::Asking { tries } = self.state else {
            return InquiryOutcome::GoesOn;
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
        InquiryOutcome::GoesOn
    }

    pub(super) fn told(&mut self) -> InquiryOutcome {
        self.state = State::Told;
        self.seen.clear();
        InquiryOutcome::Told
    }

    /// Records that no node describes the type for the time being.
    pub(super) fn untold(&mut self, now: Instant) -> InquiryOutcome {
        let before = self.pause;
        let pause = before.map_or(AGAIN_FIRST, |before| (before * 2).min(AGAIN_MOST));
        self.pause = Some(pause);
        self.state = State::Untold { again: now + pause };
        match before {
            None => InquiryOutcome::Untold,
            Some(_) => InquiryOutcome::UntoldAgain,
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

/// How long a node may take to announce its name and services.
const OFFERED_WITHIN: Duration = Duration::from_secs(3);
/// How often all nodes may leave early; after that, requests run in the background.
const MOST_CUT_SHORT: u8 = 3;
/// Maximum number of calls for a type.
const MOST_TRIES: u8 = 3;
/// The delay after the first failed call; later delays are longer.
const PAUSE: Duration = Duration::from_secs(1);
/// The delay before a failed type is requested again; it doubles each time, up to `AGAIN_MOST`.
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

    /// Returns an inquiry that no node answers while an endpoint of the type is present, and the
    /// time of that outcome.
    fn untold(began: Instant) -> (Inquiry, Instant) {
        let mut inquiry = Inquiry::new(began);
        inquiry.meet(OLD, |_| true, began);
        assert_eq!(inquiry.due(began), Some(0));
        assert_eq!(inquiry.nobody(began), InquiryOutcome::GoesOn);
        assert!(inquiry.is_waited_for());
        let now = began + OFFERED_WITHIN;
        inquiry.meet(OLD, |_| true, now);
        assert_eq!(inquiry.nobody(now), InquiryOutcome::Untold);
        (inquiry, now)
    }

    /// Returns the time at which the inquiry is due, if polled from `now` on.
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
            assert_eq!(inquiry.nobody(now), InquiryOutcome::UntoldAgain);
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
        // Asked only once.
        inquiry.asked();
        assert_eq!(inquiry.due(now), None);
    }

    #[test]
    fn whoever_comes_when_the_others_have_left_is_waited_for_as_the_first_was() {
        let (mut inquiry, untold) = untold(Instant::now());
        let now = untold + LOOK;
        inquiry.meet([guid(2)], |one| one == guid(2), now);
        assert!(inquiry.is_waited_for());
        assert_eq!(inquiry.nobody(now), InquiryOutcome::GoesOn);
        assert_eq!(inquiry.nobody(now + OFFERED_WITHIN), InquiryOutcome::Untold);
    }

    #[test]
    fn a_node_that_comes_back_has_the_time_to_tell_of_its_services() {
        let began = Instant::now();
        let mut inquiry = Inquiry::new(began);
        inquiry.meet(OLD, |_| true, began);
        let back = began + Duration::from_secs(600);
        inquiry.meet(OLD, |_| true, back);
        assert_eq!(inquiry.nobody(back), InquiryOutcome::GoesOn);
        assert_eq!(
            inquiry.nobody(back + OFFERED_WITHIN),
            InquiryOutcome::Untold
        );
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
                assert_eq!(
                    first == InquiryOutcome::Untold,
                    is_last,
                    "{number}: {first:?}"
                );
                // It is asked nevertheless.
                assert_eq!(inquiry.due(now), Some(0));
                assert_eq!(inquiry.is_waited_for(), number < MOST_CUT_SHORT, "{number}");
                assert_eq!(inquiry.nobody(now), InquiryOutcome::GoesOn);
                now += life;
                assert_eq!(
                    inquiry.meet([one], |it| it == one, now),
                    InquiryOutcome::GoesOn
                );
                assert_eq!(inquiry.nobody(now), InquiryOutcome::GoesOn);
                now += away;
            }
            // A node that stays and does not respond has had its time; endpoints wait for the next
            // node as for the first.
            let stays = guid(100);
            inquiry.meet([stays], |it| it == stays, now);
            now += OFFERED_WITHIN;
            inquiry.meet([stays], |it| it == stays, now);
            assert_eq!(inquiry.nobody(now), InquiryOutcome::UntoldAgain);
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
            assert_eq!(
                outcome == InquiryOutcome::Untold,
                last,
                "{tries}: {outcome:?}"
            );
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
        assert_eq!(inquiry.told(), InquiryOutcome::Told);
        let later = now + 2 * AGAIN_MOST;
        inquiry.meet([guid(2)], |_| true, later);
        assert_eq!(inquiry.due(later), None);
        assert!(!inquiry.is_waited_for());
    }
}
