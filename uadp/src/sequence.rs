//! SequenceNumbers: order of received numbers, duplicates, and assignment of numbers (OPC 10000-14,
//! 7.2.3).

/// Relation of a received SequenceNumber to the last processed number (OPC 10000-14, 7.2.3).
///
/// With N bits, `(received - 1 - last) modulo 2^N` is newer below 2^(N-2), older or the same above
/// 2^N - 2^(N-2), and otherwise invalid.
/// ```
/// use uadp::SequenceOrder;
///
/// assert_eq!(SequenceOrder::of_u16(65535, 0), SequenceOrder::Newer { missed: 0 });
/// assert_eq!(SequenceOrder::of_u16(10, 14), SequenceOrder::Newer { missed: 3 });
/// assert_eq!(SequenceOrder::of_u16(2, 65535), SequenceOrder::Older { by: 3 });
/// assert_eq!(SequenceOrder::of_u16(10, 10), SequenceOrder::Same);
/// assert_eq!(SequenceOrder::of_u16(0, 30000), SequenceOrder::Invalid);
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum SequenceOrder {
    /// Newer: process the message. The field is the number of missing numbers in between.
    Newer {
        /// 0 if the received number is the next number.
        missed: u32,
    },
    /// Equal to the last processed number.
    Same,
    /// Older: ignore the message, unless late messages are accepted.
    Older {
        /// Distance to the last number, at least 1.
        by: u32,
    },
    /// Too far away to be newer or older; ignore the message.
    Invalid,
}

impl SequenceOrder {
    /// Compares UInt16 numbers of NetworkMessages, DataSetMessages and chunks.
    #[must_use]
    pub const fn of_u16(last: u16, received: u16) -> Self {
        let distance = received.wrapping_sub(1).wrapping_sub(last);
        Self::classify(distance as u32, u16::MAX as u32)
    }

    /// Compares UInt32 numbers in the MessageNonce of the AES-CTR policies (OPC 10000-14,
    /// 7.2.4.4.3.2).
    #[must_use]
    pub const fn of_u32(last: u32, received: u32) -> Self {
        let distance = received.wrapping_sub(1).wrapping_sub(last);
        Self::classify(distance, u32::MAX)
    }

    const fn classify(distance: u32, max: u32) -> Self {
        let lower_bound = max / 4 + 1;
        let upper_bound = max - max / 4;
        if distance < lower_bound {
            Self::Newer { missed: distance }
        } else if distance == max {
            Self::Same
        } else if distance > upper_bound {
            Self::Older { by: max - distance }
        } else {
            Self::Invalid
        }
    }
}

/// SequenceNumbers of a sender: start at 0, increase by 1, and continue with 0 after 65535
/// (OPC 10000-14, 7.2.3).
///
/// There are separate counters for the DataSetMessages of a DataSetWriter, for the NetworkMessages
/// of a WriterGroup, and for the announcements of a publisher.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub struct SequenceCounter {
    next: u16,
}

impl SequenceCounter {
    /// Creates a counter that continues an earlier counter.
    #[must_use]
    pub const fn starting_at(next: u16) -> Self {
        Self { next }
    }

    /// Returns the number of the next message, which a keep-alive carries (OPC 10000-14,
    /// 7.2.4.5.8).
    #[must_use]
    pub const fn peek(&self) -> u16 {
        self.next
    }

    /// Returns the next number and advances the counter.
    pub const fn take(&mut self) -> u16 {
        let number = self.next;
        self.advance(1);
        number
    }

    /// Uses up `count` numbers, for example of the NetworkMessages of several chunks.
    pub const fn advance(&mut self, count: u16) {
        self.next = self.next.wrapping_add(count);
    }
}

/// The last SequenceNumber, and which of the [`REACH`] numbers up to it were received.
#[derive(Debug, Clone, Copy)]
pub(crate) struct SequenceWindow {
    last: u16,
    /// Bit n represents `last - n`.
    seen: u64,
}

/// Position of a number relative to a [`SequenceWindow`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Place {
    Newer {
        missed: u16,
    },
    Seen,
    /// Not received, as far as the window reaches.
    Behind {
        by: u16,
    },
    Invalid,
}

/// Number of sequence numbers that a [`SequenceWindow`] remembers.
pub(crate) const REACH: u16 = 64;

impl SequenceWindow {
    /// Creates a window in which `number` was received.
    pub(crate) const fn at(number: u16) -> Self {
        Self {
            last: number,
            seen: 1,
        }
    }

    /// Creates a window in which `next` is expected and no earlier number was received.
    pub(crate) const fn before(next: u16) -> Self {
        Self {
            last: next.wrapping_sub(1),
            seen: 0,
        }
    }

    pub(crate) fn place(&self, number: u16) -> Place {
        match SequenceOrder::of_u16(self.last, number) {
            SequenceOrder::Newer { missed } => Place::Newer {
                missed: saturated(missed),
            },
            SequenceOrder::Same => self.behind(0),
            SequenceOrder::Older { by } => self.behind(saturated(by)),
            SequenceOrder::Invalid => Place::Invalid,
        }
    }

    /// Returns true for the newest number, received or not.
    pub(crate) const fn is_last(&self, number: u16) -> bool {
        self.last == number
    }

    /// Returns the distance of `number` to the newest number.
    pub(crate) const fn distance(&self, number: u16) -> u16 {
        self.last.wrapping_sub(number)
    }

    const fn behind(&self, by: u16) -> Place {
        match by < REACH && self.seen >> by & 1 == 1 {
            true => Place::Seen,
            false => Place::Behind { by },
        }
    }

    /// Records a number for which [`place`](Self::place) returns newer or behind.
    pub(crate) fn receive(&mut self, number: u16) {
        match self.place(number) {
            Place::Newer { missed } => {
                self.shift(missed.saturating_add(1));
                self.seen |= 1;
                self.last = number;
            }
            Place::Behind { by } if by < REACH => self.seen |= 1 << by,
            Place::Behind { .. } | Place::Seen | Place::Invalid => {}
        }
    }

    /// Advances to the number before `next` without marking it as received.
    pub(crate) fn expect(&mut self, next: u16) {
        let last = next.wrapping_sub(1);
        self.shift(last.wrapping_sub(self.last));
        self.last = last;
    }

    fn shift(&mut self, by: u16) {
        self.seen = self.seen.checked_shl(by.into()).unwrap_or_default();
    }
}

/// Converts a distance between two UInt16, which is always below 2^16.
fn saturated(distance: u32) -> u16 {
    u16::try_from(distance).unwrap_or(u16::MAX)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Formula and bounds of 7.2.3, computed without overflow.
    fn by_the_book(bits: u32, last: u32, received: u32) -> SequenceOrder {
        let range = 1_i64 << bits;
        let result = (i64::from(received) - 1 - i64::from(last)).rem_euclid(range);
        let narrow = |n: i64| u32::try_from(n).unwrap();
        match result {
            n if n < range / 4 => SequenceOrder::Newer { missed: narrow(n) },
            n if n == range - 1 => SequenceOrder::Same,
            n if n > range - range / 4 => SequenceOrder::Older {
                by: narrow(range - 1 - n),
            },
            _ => SequenceOrder::Invalid,
        }
    }

    #[test]
    fn every_uint16_stands_to_another_as_the_formula_says() {
        for last in [0, 1, 16383, 16384, 32767, 32768, 49152, 65534, 65535] {
            for received in 0..=u16::MAX {
                assert_eq!(
                    SequenceOrder::of_u16(last, received),
                    by_the_book(16, last.into(), received.into()),
                    "{last} then {received}"
                );
            }
        }
    }

    #[test]
    fn the_distance_alone_decides() {
        for distance in 0..=u16::MAX {
            let from_zero = SequenceOrder::of_u16(0, distance);
            for last in (0..=u16::MAX).step_by(997) {
                assert_eq!(
                    SequenceOrder::of_u16(last, last.wrapping_add(distance)),
                    from_zero
                );
            }
        }
    }

    #[test]
    fn the_bounds_of_uint16_are_those_of_the_table() {
        use SequenceOrder::{Invalid, Newer, Older};
        let at = |result: u16| SequenceOrder::of_u16(100, result.wrapping_add(101));
        assert_eq!(at(16383), Newer { missed: 16383 });
        assert_eq!(at(16384), Invalid);
        assert_eq!(at(49152), Invalid);
        assert_eq!(at(49153), Older { by: 16382 });
        assert_eq!(at(65534), Older { by: 1 });
        assert_eq!(at(65535), SequenceOrder::Same);
    }

    #[test]
    fn the_bounds_of_uint32_are_those_of_the_table() {
        let lower = 1_073_741_824_u32;
        let upper = 3_221_225_472_u32;
        for last in [0, 1, u32::MAX, 5_000_000] {
            for result in [
                0,
                1,
                lower - 1,
                lower,
                lower + 1,
                upper - 1,
                upper,
                upper + 1,
            ] {
                let received = last.wrapping_add(1).wrapping_add(result);
                assert_eq!(
                    SequenceOrder::of_u32(last, received),
                    by_the_book(32, last, received)
                );
            }
            assert_eq!(SequenceOrder::of_u32(last, last), SequenceOrder::Same);
            assert_eq!(
                SequenceOrder::of_u32(last, last.wrapping_sub(1)),
                SequenceOrder::Older { by: 1 }
            );
        }
        let at = |result: u32| SequenceOrder::of_u32(7, result.wrapping_add(8));
        assert_eq!(at(lower - 1), SequenceOrder::Newer { missed: lower - 1 });
        assert_eq!(at(lower), SequenceOrder::Invalid);
        assert_eq!(at(upper), SequenceOrder::Invalid);
        assert_eq!(at(upper + 1), SequenceOrder::Older { by: lower - 2 });
    }

    #[test]
    fn a_counter_goes_on_with_zero_after_the_largest_number() {
        let mut counter = SequenceCounter::starting_at(65534);
        assert_eq!(
            [counter.take(), counter.take(), counter.take()],
            [65534, 65535, 0]
        );
        counter.advance(65535);
        assert_eq!(counter.peek(), 0);
        assert_eq!(SequenceCounter::default().take(), 0);
    }

    #[test]
    fn a_window_knows_what_it_has_seen_across_the_roll_over() {
        let mut window = SequenceWindow::at(65533);
        window.receive(0);
        assert_eq!(window.place(65533), Place::Seen);
        assert_eq!(window.place(65534), Place::Behind { by: 2 });
        assert_eq!(window.place(0), Place::Seen);
        window.receive(65534);
        assert_eq!(window.place(65534), Place::Seen);
        assert_eq!(window.place(65535), Place::Behind { by: 1 });
        assert_eq!(window.place(3), Place::Newer { missed: 2 });
    }

    #[test]
    fn a_window_forgets_what_is_out_of_its_reach() {
        let mut window = SequenceWindow::at(1000);
        window.receive(1000 + REACH - 1);
        assert_eq!(window.place(1000), Place::Seen);
        window.receive(1000 + REACH);
        assert_eq!(window.place(1000), Place::Behind { by: REACH });
        window.receive(1000);
        assert_eq!(window.place(1000), Place::Behind { by: REACH });
    }

    #[test]
    fn an_expected_number_was_not_received_and_those_before_it_may_come_late() {
        let mut window = SequenceWindow::at(5);
        window.expect(8);
        assert_eq!(window.place(7), Place::Behind { by: 0 });
        assert_eq!(window.place(5), Place::Seen);
        assert_eq!(window.place(8), Place::Newer { missed: 0 });
        assert_eq!(
            SequenceWindow::before(0).place(0),
            Place::Newer { missed: 0 }
        );
    }
}
