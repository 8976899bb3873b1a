//! DateTime, PicoSeconds, and their conversion to Unix time.

/// 100 ns ticks since 1601-01-01 00:00 UTC (OPC 10000-6, 5.2.2.5).
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default)]
pub struct DateTime(pub i64);

/// A DateTime with its PicoSeconds, in units of 10 ps, 0 to 9999 (OPC 10000-14, 7.2.4.4.2 and
/// 7.2.4.5.4).
///
/// It preserves nanoseconds; a DateTime has a resolution of 100 ns.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default)]
pub struct Timestamp {
    /// DateTime in ticks of 100 ns.
    pub time: DateTime,
    /// Remainder of the tick in units of 10 ps, at most 9999.
    pub picoseconds: u16,
}

impl Timestamp {
    /// Creates a Timestamp from nanoseconds since 1970-01-01 UTC. Values outside of the range of a
    /// DateTime are clamped.
    #[must_use]
    pub fn from_unix_nanos(nanos: i128) -> Self {
        let ticks = nanos.div_euclid(NANOS_PER_TICK) + UNIX_EPOCH_TICKS;
        match i64::try_from(ticks) {
            Ok(ticks) => Self {
                time: DateTime(ticks),
                picoseconds: u16::try_from(nanos.rem_euclid(NANOS_PER_TICK) * UNITS_PER_NANO)
                    .unwrap_or_default(),
            },
            Err(_) if ticks < 0 => Self {
                time: DateTime(i64::MIN),
                picoseconds: 0,
            },
            Err(_) => Self {
                time: DateTime(i64::MAX),
                picoseconds: 9999,
            },
        }
    }

    /// Returns nanoseconds since 1970-01-01 UTC, rounded down.
    #[must_use]
    pub fn unix_nanos(self) -> i128 {
        (i128::from(self.time.0) - UNIX_EPOCH_TICKS) * NANOS_PER_TICK
            + i128::from(self.picoseconds) / UNITS_PER_NANO
    }
}

impl From<DateTime> for Timestamp {
    fn from(time: DateTime) -> Self {
        Self {
            time,
            picoseconds: 0,
        }
    }
}

/// Ticks from 1601-01-01 to 1970-01-01.
const UNIX_EPOCH_TICKS: i128 = 116_444_736_000_000_000;
const NANOS_PER_TICK: i128 = 100;
/// PicoSeconds count 10 ps.
const UNITS_PER_NANO: i128 = 100;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nanoseconds_survive_the_way_there_and_back() {
        for nanos in [0, 1, 99, 100, -1, -101, 1_779_021_296_789_012_345] {
            assert_eq!(Timestamp::from_unix_nanos(nanos).unix_nanos(), nanos);
        }
        let t = Timestamp::from_unix_nanos(1_779_021_296_789_012_345);
        assert_eq!(t.time, DateTime(134_234_948_967_890_123));
        assert_eq!(t.picoseconds, 4500);
    }

    #[test]
    fn times_outside_a_date_time_stop_at_its_ends() {
        assert_eq!(
            Timestamp::from_unix_nanos(i128::from(i64::MAX) * 1000)
                .time
                .0,
            i64::MAX
        );
        assert_eq!(
            Timestamp::from_unix_nanos(i128::from(i64::MIN) * 1000)
                .time
                .0,
            i64::MIN
        );
    }
}
