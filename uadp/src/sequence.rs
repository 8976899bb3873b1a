//! The order of received SequenceNumbers (OPC 10000-14, 7.2.3).

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
}
