//! The part of the run loop that passes on the events of tapped topics.

use super::Shell;
use crate::clock::now;
use crate::port::Port;

impl<P: Port> Shell<P> {
    /// Follows the tapped topics, and passes their events on.
    pub(super) fn follow_taps(&mut self) {
        let now = now();
        self.router.tap(&self.taps.wanted(now.monotonic));
        while let Some(tapped) = self.router.next_tapped() {
            self.taps.add(self.own, &tapped, now);
        }
        match self.router.take_lost_taps() {
            0 => {}
            lost => self.taps.lost(lost),
        }
    }
}
