//! A server that works on one goal at a time; a newer goal takes the place of an older one.

use super::server::{ActionServer, ServerEvent, ServerGoal};

/// The policy of actionlib's `SimpleActionServer`: one goal is worked on and one waits. A goal with a later stamp than
/// both takes the waiting one's place, and whoever works should give way to it.
#[derive(Debug)]
pub struct SimpleActionServer {
    server: ActionServer,
    waiting: Option<ServerGoal>,
}

impl SimpleActionServer {
    /// Takes the goals of `server` one at a time.
    pub const fn new(server: ActionServer) -> Self {
        Self {
            server,
            waiting: None,
        }
    }

    /// The next goal, accepted. It may carry a request to cancel already. Cancel-safe.
    pub async fn next(&mut self) -> ServerGoal {
        loop {
            while let Some(event) = self.server.try_recv() {
                self.take(event, None);
            }
            if let Some(goal) = self.waiting.take() {
                if goal.accept("").is_ok() {
                    return goal;
                }
                continue;
            }
            let event = self.server.recv().await;
            self.take(event, None);
        }
    }

    /// Waits until work on `current` should stop: a client asked to cancel it, or a newer goal waits. For a goal that
    /// has ended it returns at once. Then call [`ServerGoal::cancelled`] and [`Self::next`]. Cancel-safe.
    pub async fn preempted(&mut self, current: &ServerGoal) {
        loop {
            if self.waiting.is_some()
                || current.is_cancel_requested()
                || current.status().is_terminal()
            {
                return;
            }
            let event = self.server.recv().await;
            self.take(event, Some(current));
        }
    }

    /// Keeps the goal with the latest stamp waiting. A request to cancel is in the status of its goal already.
    fn take(&mut self, event: ServerEvent, current: Option<&ServerGoal>) {
        let ServerEvent::Goal(goal) = event else {
            return;
        };
        let newest = self.waiting.as_ref().or(current);
        let late = newest.is_some_and(|newest| goal.goal_id().stamp < newest.goal_id().stamp);
        let superseded = if late {
            Some(goal)
        } else {
            self.waiting.replace(goal)
        };
        // It cannot have ended, except with the server.
        if let Some(old) = superseded {
            let _closed = old.cancelled(None, SUPERSEDED).is_err();
        }
    }
}

const SUPERSEDED: &str = "another goal took its place";
