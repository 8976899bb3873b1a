//! The delays of samples by hop, computed from the timestamps in the messages.

use std::collections::VecDeque;

use hdrhistogram::Histogram;
use uadp::Timestamp;

/// A part of the path of a sample.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Hop {
    /// From the message of the local side to the NetworkMessage, in this program (tPB of the
    /// producer's bridge).
    Out,
    /// The same part in the producer's bridge, computed from the timestamps of its messages.
    Origin,
    /// From the producer's bridge to this program through the PubSub network (tTR0). Between two
    /// hosts it is only as accurate as the synchronization of their clocks.
    Network,
    /// From the arrival of the datagram, at the kernel if it stamps datagrams, to the local
    /// publication in this program (tPB of the consumer's bridge).
    In,
}

impl Hop {
    /// Returns the name of the hop in status pages and metrics.
    #[must_use]
    pub const fn label(self) -> &'static str {
        match self {
            Self::Out => "out",
            Self::Origin => "origin",
            Self::Network => "network",
            Self::In => "in",
        }
    }
}

/// The delays of a hop.
#[derive(Debug, Clone)]
pub struct Delays {
    /// The delays in nanoseconds with two significant digits.
    histogram: Histogram<u64>,
    /// The number of negative delays, which result only from unsynchronized clocks.
    negative: u64,
}

impl Delays {
    fn new() -> Self {
        // Two significant digits from 1 ns to 1 h: the bounds are valid constants, so the fallback
        // is never taken.
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

    /// Returns the number of recorded delays.
    #[must_use]
    pub fn count(&self) -> u64 {
        self.histogram.len()
    }

    /// Returns the number of negative delays that were not recorded because the clocks of the two
    /// hosts disagree.
    #[must_use]
    pub const fn negative(&self) -> u64 {
        self.negative
    }

    /// Returns the delay in microseconds that the share `quantile` (0..=1) of samples did not
    /// exceed; 0 without samples.
    #[must_use]
    pub fn quantile_us(&self, quantile: f64) -> f64 {
        microseconds(self.histogram.value_at_quantile(quantile))
    }

    /// Returns the largest delay in microseconds; 0 without samples.
    #[must_use]
    pub fn max_us(&self) -> f64 {
        microseconds(self.histogram.max())
    }
}

/// The newest `MOST` delays of a hop, in microseconds.
#[derive(Debug, Default)]
pub struct RecentDelays<const MOST: usize> {
    last: VecDeque<f64>,
    count: u64,
    negative: u64,
}

impl<const MOST: usize> RecentDelays<MOST> {
    /// Records a delay in nanoseconds. Delays that are negative are counted only.
    pub fn record(&mut self, nanoseconds: i128) {
        match u64::try_from(nanoseconds) {
            Ok(delay) => self.record_us(microseconds(delay)),
            Err(_) => self.negative += 1,
        }
    }

    /// Records a delay in microseconds. Delays that are negative are counted only.
    pub fn record_us(&mut self, microseconds: f64) {
        if microseconds < 0.0 {
            self.negative += 1;
            return;
        }
        self.count += 1;
        if self.last.len() >= MOST {
            self.last.pop_front();
        }
        self.last.push_back(microseconds);
    }

    /// Returns the delays in microseconds, oldest first.
    #[must_use]
    pub const fn last(&self) -> &VecDeque<f64> {
        &self.last
    }

    /// Returns the number of all recorded delays that are not negative.
    #[must_use]
    pub const fn count(&self) -> u64 {
        self.count
    }

    /// Returns the number of negative delays, which result from clocks that differ.
    #[must_use]
    pub const fn negative(&self) -> u64 {
        self.negative
    }

    /// Returns for each share the smallest delay in microseconds that at least so many
    /// `thousandths` of the newest delays do not exceed; 0 without delays.
    #[must_use]
    pub fn quantiles_us<const N: usize>(&self, thousandths: [usize; N]) -> [f64; N] {
        let mut sorted: Vec<f64> = self.last.iter().copied().collect();
        sorted.sort_by(f64::total_cmp);
        thousandths.map(|share| {
            let rank = (sorted.len() * share).div_ceil(1000);
            let delay = sorted.get(rank.saturating_sub(1)).copied();
            delay.unwrap_or_default()
        })
    }
}

/// The delays of all hops that this program can measure.
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

    /// Returns the delays of a hop.
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
