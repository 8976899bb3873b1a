//! `ua-space bw`: measures the bandwidth of a topic.

use std::collections::VecDeque;
use std::io::{self, Write as _};
use std::time::Duration;

use serde::Serialize;

use super::received::measured;
use super::text::json;
use crate::arguments::Hz;
use crate::exit::CommandFailure;

/// Runs `ua-space bw`.
pub(crate) fn bandwidth(arguments: &Hz) -> Result<(), CommandFailure> {
    measured(arguments, |received| match Load::of(&received.newest) {
        Some(load) => load.print(arguments.json).map(|()| true),
        None => Ok(false),
    })
}

/// The bandwidth of the values of a topic, without the headers of the network.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
struct Load {
    bytes_per_second: f64,
    mean_bytes: f64,
    min_bytes: usize,
    max_bytes: usize,
    /// Number of values in the statistics.
    window: usize,
}

impl Load {
    #[expect(clippy::cast_precision_loss, reason = "figures shown to people")]
    fn of(sizes: &VecDeque<(Duration, usize)>) -> Option<Self> {
        let (first, last) = (sizes.front()?.0, sizes.back()?.0);
        let span = last.saturating_sub(first).as_secs_f64();
        if span <= 0.0 {
            return None;
        }
        let all = || sizes.iter().map(|(_, size)| *size);
        let total: usize = all().sum();
        let count = sizes.len();
        let mean = total as f64 / count as f64;
        Some(Self {
            // The first value starts the time, so its bytes are not of the time.
            bytes_per_second: mean * (count - 1) as f64 / span,
            mean_bytes: mean,
            min_bytes: all().min()?,
            max_bytes: all().max()?,
            window: count,
        })
    }

    fn print(&self, as_json: bool) -> Result<(), CommandFailure> {
        let mut out = io::stdout().lock();
        if as_json {
            writeln!(out, "{}", json(self)?)?;
        } else {
            let rate = bytes(self.bytes_per_second);
            writeln!(out, "average: {rate}/s")?;
            let mean = bytes(self.mean_bytes);
            let Self {
                min_bytes,
                max_bytes,
                window,
                ..
            } = self;
            writeln!(
                out,
                "\tmean: {mean} min: {min_bytes} B max: {max_bytes} B window: {window}"
            )?;
        }
        out.flush()?;
        Ok(())
    }
}

/// Formats bytes as `120 B`, `1.50 KB` or `3.20 MB`.
fn bytes(count: f64) -> String {
    if count < 1_000.0 {
        format!("{count:.0} B")
    } else if count < 1_000_000.0 {
        format!("{:.2} KB", count / 1_000.0)
    } else {
        format!("{:.2} MB", count / 1_000_000.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_bandwidth_is_that_of_the_bytes_between_the_first_and_the_last_value() {
        let at = |ms, size| (Duration::from_millis(ms), size);
        let load = Load::of(&[at(0, 100), at(500, 300), at(1000, 200)].into()).unwrap();
        assert!((load.bytes_per_second - 400.0).abs() < 1e-9, "{load:?}");
        assert_eq!((load.min_bytes, load.max_bytes, load.window), (100, 300, 3));
        assert_eq!(Load::of(&[at(0, 100)].into()), None);
        assert_eq!(
            [12.0, 1500.0, 3.2e6].map(bytes),
            ["12 B", "1.50 KB", "3.20 MB"]
        );
    }
}
