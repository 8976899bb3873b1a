//! The order of the states of a server: its notifications arrive late, and its responses overtake
//! them.

/// Decides which states of a server are newer than the shown state. Times are those at which the
/// server entered a state, by its clock, in ticks; some servers give none.
#[derive(Debug, Default)]
pub(super) struct StateOrder {
    /// Time of the shown state.
    since: Option<i64>,
    /// Whether a run was started from here that the server does not show yet.
    has_begun: bool,
}

/// The meaning of a notification of a state.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum StateNotice {
    /// It is older than the shown state, or the shown state.
    Known,
    /// The server entered another state.
    Entered,
    /// It may be from before the run that was started: the state has to be read.
    Unclear,
}

impl StateOrder {
    /// Judges a notification. `is_shown` is true for the shown state.
    pub(super) fn notified(&mut self, is_shown: bool, at: Option<i64>) -> StateNotice {
        if let (Some(at), Some(since)) = (at, self.since)
            && at <= since
        {
            return StateNotice::Known;
        }
        if !is_shown && self.has_begun && at.is_none() {
            return StateNotice::Unclear;
        }
        self.read(at);
        match is_shown {
            true => StateNotice::Known,
            false => StateNotice::Entered,
        }
    }

    /// Records a state that was read from the server.
    pub(super) fn read(&mut self, at: Option<i64>) {
        self.since = at.or(self.since);
        self.has_begun = false;
    }

    /// Records a state that was read after a call. Notifications without a time may still be from
    /// before it.
    pub(super) fn called(&mut self, at: Option<i64>) {
        self.since = at.or(self.since);
    }

    /// Records the state that was read after the server confirmed a Start; `None` if it was not
    /// readable. Returns whether the state is of the run: otherwise the server does not show the
    /// run yet.
    pub(super) fn started(&mut self, read: Option<(bool, Option<i64>)>) -> bool {
        match read {
            Some((is_work, at)) if is_work || at > self.since => {
                self.called(at);
                true
            }
            Some(_) | None => {
                self.has_begun = true;
                false
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(since: i64) -> StateOrder {
        let mut order = StateOrder::default();
        order.read(Some(since));
        order
    }

    #[test]
    fn a_notification_that_is_not_newer_than_the_shown_state_changes_nothing() {
        let mut order = at(5);
        for old in [4, 5] {
            assert_eq!(order.notified(false, Some(old)), StateNotice::Known);
        }
        assert_eq!(order.notified(false, Some(6)), StateNotice::Entered);
        assert_eq!(order.notified(false, Some(6)), StateNotice::Known);
        // The shown state again, entered later: what came before it is old.
        assert_eq!(order.notified(true, Some(9)), StateNotice::Known);
        assert_eq!(order.notified(false, Some(8)), StateNotice::Known);
    }

    #[test]
    fn after_a_start_a_state_without_a_time_may_be_from_before_the_run() {
        let mut order = StateOrder::default();
        assert_eq!(order.notified(false, None), StateNotice::Entered);
        assert!(!order.started(Some((false, None))), "the run is not shown");
        assert_eq!(order.notified(false, None), StateNotice::Unclear);
        // The state of the run was notified: the next one ends it.
        assert_eq!(order.notified(true, None), StateNotice::Known);
        assert_eq!(order.notified(false, None), StateNotice::Entered);
    }

    #[test]
    fn a_state_that_was_read_after_a_start_is_of_the_run_if_it_is_work_or_newer() {
        let mut order = at(5);
        // The run ended before the state was read.
        assert!(order.started(Some((false, Some(6)))));
        assert_eq!(order.notified(false, Some(6)), StateNotice::Known);
        assert!(order.started(Some((true, None))));
        for earlier in [Some((false, Some(6))), Some((false, None)), None] {
            assert!(!order.started(earlier), "{earlier:?}");
            assert_eq!(order.notified(false, None), StateNotice::Unclear);
            order.read(None);
        }
    }
}
