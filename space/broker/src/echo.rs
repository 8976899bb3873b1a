//! Detection of own messages that the broker returns. Only MQTT 5 can suppress them at the broker.

use std::collections::hash_map::RandomState;
use std::collections::{HashMap, VecDeque};
use std::hash::BuildHasher;

/// Hashes of the messages sent last.
#[derive(Debug, Default)]
pub(crate) struct Echo {
    state: RandomState,
    /// The number of expected echoes of each hash.
    counts: HashMap<u64, u32>,
    order: VecDeque<u64>,
}

impl Echo {
    /// Records a sent message.
    pub(crate) fn sent(&mut self, topic: &str, payload: &[u8]) {
        let hash = self.state.hash_one((topic, payload));
        *self.counts.entry(hash).or_default() += 1;
        self.order.push_back(hash);
        if self.order.len() > MAX_SENT
            && let Some(oldest) = self.order.pop_front()
        {
            self.remove(oldest);
        }
    }

    /// Returns whether a received message is an own message.
    pub(crate) fn is_own(&self, topic: &str, payload: &[u8]) -> bool {
        let hash = self.state.hash_one((topic, payload));
        self.counts.contains_key(&hash)
    }

    fn remove(&mut self, hash: u64) {
        if let Some(count) = self.counts.get_mut(&hash) {
            *count -= 1;
            if *count == 0 {
                self.counts.remove(&hash);
            }
        }
    }
}

/// The number of messages for which an echo is recognised. Echoes of older messages are late, and
/// the loop rule of the space drops them.
const MAX_SENT: usize = 8192;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn own_messages_are_recognised_until_many_others_were_sent() {
        let mut echo = Echo::default();
        echo.sent("a", b"1");
        assert!(echo.is_own("a", b"1"));
        assert!(!echo.is_own("b", b"1") && !echo.is_own("a", b"2"));
        for number in 0..MAX_SENT {
            echo.sent("c", &number.to_le_bytes());
        }
        assert!(!echo.is_own("a", b"1"));
        assert_eq!(echo.order.len(), MAX_SENT);
    }
}
