//! The deadline of a topic: the longest time between two values.

use std::time::{Duration, Instant};

use mappings::Variable;

/// Watches the times between values.
#[derive(Debug)]
pub(crate) struct Deadline {
    limit: Duration,
    last: Option<Instant>,
}

impl Deadline {
    /// Returns the deadline of a variable, if it has one.
    pub(crate) fn of(variable: Option<&Variable>) -> Option<Box<Self>> {
        let limit = variable?.ages.deadline?;
        Some(Box::new(Self { limit, last: None }))
    }

    /// Notes a value. Returns whether it came later than the deadline after the value before.
    pub(crate) fn note(&mut self, now: Instant) -> bool {
        let before = self.last.replace(now);
        before.is_some_and(|before| now.saturating_duration_since(before) > self.limit)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    #[expect(clippy::disallowed_methods, reason = "some instant to count from")]
    fn each_longer_pause_counts_once_and_the_first_value_does_not() {
        let start = Instant::now();
        let at = |millis| start + Duration::from_millis(millis);
        let mut deadline = Deadline {
            limit: Duration::from_millis(100),
            last: None,
        };
        let missed = [0, 100, 201, 900, 950].map(|millis| deadline.note(at(millis)));
        assert_eq!(missed, [false, false, true, true, false]);
    }
}
