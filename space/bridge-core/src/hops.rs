//! How long samples took, hop by hop, read off the stamps that are on the wire anyway.

use hdrhistogram::Histogram;
use uadp::Timestamp;

/// One stretch of a sample's way.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Hop {
    /// From the local side's message to the NetworkMessage, in this program (tPB of a producer's bridge).
    Out,
    /// The same stretch in the producer's bridge, read from the stamps of its messages.
    Origin,
    /// From the producer's bridge to this program, through the PubSub network (tTR0). Between two hosts it holds
    /// only as far as their clocks agree.
    Network,
    /// From the datagram's arrival to the local publication, in this program (tPB of a consumer's bridge).
    In,
}

/// The delays of one hop.
#[derive(Debug, Clone)]
pub struct Delays {
    /// In nanoseconds; two significant digits.
    histogram: Histogram<u64>,
    /// Delays below zero, which only clocks that disagree can make.
    negative: u64,
}

impl Delays {
    fn new() -> Self {
        // Two significant digits from 1 ns to 1 h: the bounds are valid constants, so the fallback is never taken.
        let histogram = Histogram::new_with_bounds(1, 3_600_000_000_000, 2)
            .or_else(|_| Histogram::new(2))
            .unwrap_or_else(|_| unreachable!("two significant digits are valid"));
        Self {
            histogram,
            negative: 0,
        }
    }

    fn record(&mut self, nanoseconds: i128) {
        match u64::try_from(nanoseconds) {
            Ok(delay) => self.histogram.saturating_record(delay.max(1)),
            Err(_) => self.negative += 1,
        }
    }

    /// How many delays were recorded.
    #[must_use]
    pub fn count(&self) -> u64 {
        self.histogram.len()
    }

    /// How many were below zero and left out: the clocks of the two hosts disagree.
    #[must_use]
    pub const fn negative(&self) -> u64 {
        self.negative
    }

    /// The delay, in microseconds, that the share `quantile` (0..=1) of samples did not exceed. 0 without samples.
    #[must_use]
    pub fn quantile_us(&self, quantile: f64) -> f64 {
        microseconds(self.histogram.value_at_quantile(quantile))
    }

    /// The largest delay, in microseconds. 0 without samples.
    #[must_use]
    pub fn max_us(&self) -> f64 {
        microseconds(self.histogram.max())
    }
}

/// The delays of every hop this program can see.
#[derive(Debug, Clone)]
pub struct Hops {
    out: Delays,
    origin: Delays,
    network: Delays,
    inward: Delays,
}

impl Hops {
    pub(crate) fn new() -> Self {
        Self {
            out: Delays::new(),
            origin: Delays::new(),
            network: Delays::new(),
            inward: Delays::new(),
        }
    }

    /// The delays of one hop.
    #[must_use]
    pub const fn of(&self, hop: Hop) -> &Delays {
        match hop {
            Hop::Out => &self.out,
            Hop::Origin => &self.origin,
            Hop::Network => &self.network,
            Hop::In => &self.inward,
        }
    }

    pub(crate) fn record(&mut self, hop: Hop, from: Timestamp, to: Timestamp) {
        let delays = match hop {
            Hop::Out => &mut self.out,
            Hop::Origin => &mut self.origin,
            Hop::Network => &mut self.network,
            Hop::In => &mut self.inward,
        };
        delays.record(to.unix_nanos() - from.unix_nanos());
    }
}

#[expect(clippy::cast_precision_loss, reason = "a delay shown to people")]
fn microseconds(nanoseconds: u64) -> f64 {
    nanoseconds as f64 / 1000.0
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_are_in_microseconds_and_negative_delays_are_told_apart() {
        let mut hops = Hops::new();
        let at = |nanos: i128| Timestamp::from_unix_nanos(1_700_000_000_000_000_000 + nanos);
        for delay in 1..=100 {
            hops.record(Hop::Network, at(0), at(delay * 1000));
        }
        hops.record(Hop::Network, at(1000), at(0));
        let network = hops.of(Hop::Network);
        assert_eq!((network.count(), network.negative()), (100, 1));
        assert!(
            (49.0..=51.0).contains(&network.quantile_us(0.5)),
            "{}",
            network.quantile_us(0.5)
        );
        assert!(
            (99.0..=101.0).contains(&network.max_us()),
            "{}",
            network.max_us()
        );
        assert_eq!(hops.of(Hop::In).count(), 0);
    }
}
