//! The voltage levels of the tool changer.

use std::fmt;

/// State of the changer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ChangerReading {
    /// The ring is open, without a tool.
    Ready,
    /// The ring is between open and locked.
    Intermediate,
    /// No tool is attached.
    NoTool,
    /// The tool with this number, from 1 to 10, is locked.
    Tool(u8),
}

impl fmt::Display for ChangerReading {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Ready => f.write_str("its ring is open"),
            Self::Intermediate => f.write_str("its ring is between open and locked"),
            Self::NoTool => f.write_str("no tool is attached"),
            Self::Tool(number) => write!(f, "tool {number} is attached"),
        }
    }
}

/// A voltage that is no level of the tool changer.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[error("{0:.2} V is no voltage of the tool changer")]
pub struct InvalidVoltage(pub f64);

/// The voltages at the changer in V, ascending.
pub const LEVELS: [(f64, ChangerReading); 13] = [
    (0.0, ChangerReading::Ready),
    (2.1, ChangerReading::Intermediate),
    (4.9, ChangerReading::NoTool),
    (5.7, ChangerReading::Tool(1)),
    (6.7, ChangerReading::Tool(2)),
    (7.4, ChangerReading::Tool(3)),
    (8.4, ChangerReading::Tool(4)),
    (9.5, ChangerReading::Tool(5)),
    (10.8, ChangerReading::Tool(6)),
    (11.7, ChangerReading::Tool(7)),
    (12.4, ChangerReading::Tool(8)),
    (13.2, ChangerReading::Tool(9)),
    (14.1, ChangerReading::Tool(10)),
];

/// Returns the voltage of a reading.
#[must_use]
pub fn volts(of: ChangerReading) -> f64 {
    LEVELS
        .iter()
        .find(|(_, reading)| *reading == of)
        .map_or(0.0, |(volts, _)| *volts)
}

/// Converts voltages to readings. Near the border of two readings the previous reading stays.
#[derive(Debug, Clone, Default)]
pub struct VoltageDetector {
    /// Index of the last reading in the table.
    now: Option<usize>,
}

impl VoltageDetector {
    /// Returns the reading of a voltage, which depends on the previous voltages.
    ///
    /// # Errors
    /// [`InvalidVoltage`].
    pub fn feed(&mut self, volts: f64) -> Result<ChangerReading, InvalidVoltage> {
        if !(LOWEST..=HIGHEST).contains(&volts) {
            self.now = None;
            return Err(InvalidVoltage(volts));
        }
        let mut place = LEVELS
            .windows(2)
            .filter(|pair| volts > border(pair))
            .count();
        if let Some(now) = self.now
            && now.abs_diff(place) == 1
        {
            let border = LEVELS.windows(2).nth(now.min(place)).map_or(0.0, border);
            if (volts - border).abs() < HYSTERESIS {
                place = now;
            }
        }
        self.now = Some(place);
        let level = LEVELS.get(place).map(|(_, reading)| *reading);
        level.ok_or(InvalidVoltage(volts))
    }
}

fn border(pair: &[(f64, ChangerReading)]) -> f64 {
    pair.iter().map(|(volts, _)| volts / 2.0).sum()
}

/// Less than half of the smallest distance of two levels, which is 0.35 V.
const HYSTERESIS: f64 = 0.15;
const LOWEST: f64 = -0.5;
const HIGHEST: f64 = 15.0;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_level_is_told_and_nothing_beyond_them() {
        for (volts, reading) in LEVELS {
            assert_eq!(VoltageDetector::default().feed(volts), Ok(reading));
            assert_eq!(super::volts(reading), volts);
        }
        assert_eq!(
            VoltageDetector::default().feed(-1.0),
            Err(InvalidVoltage(-1.0))
        );
        assert_eq!(
            InvalidVoltage(-1.0).to_string(),
            "-1.00 V is no voltage of the tool changer"
        );
        assert!(VoltageDetector::default().feed(f64::NAN).is_err());
        assert!(VoltageDetector::default().feed(24.0).is_err());
    }

    #[test]
    fn a_voltage_that_flutters_at_a_border_tells_one_reading() {
        let mut detector = VoltageDetector::default();
        // The border between no tool and tool 1 is at 5.3 V.
        assert_eq!(detector.feed(5.7), Ok(ChangerReading::Tool(1)));
        for volts in [5.31, 5.29, 5.2, 5.44, 5.16] {
            assert_eq!(detector.feed(volts), Ok(ChangerReading::Tool(1)), "{volts}");
        }
        assert_eq!(detector.feed(5.14), Ok(ChangerReading::NoTool));
        assert_eq!(detector.feed(5.4), Ok(ChangerReading::NoTool));
        assert_eq!(detector.feed(5.46), Ok(ChangerReading::Tool(1)));
        // Hysteresis has no effect on a distant level.
        assert_eq!(detector.feed(13.7), Ok(ChangerReading::Tool(10)));
    }
}
