//! Reads the voltage of a tool changer.

use std::sync::Arc;

use skills::Work;
use tokio::time::{Instant, sleep};

use super::error::KelvinError;
use super::volts::{ChangerReading, InvalidVoltage, VoltageDetector};
use super::{Converter, POLL, SWITCHED};
use crate::modbus::{Modbus, ModbusFault};

/// Reads the voltage of the changer.
pub(super) struct Look {
    converter: Converter,
    modbus: Arc<Modbus>,
    detector: VoltageDetector,
}

impl Look {
    /// Creates a reader of a converter, without previous voltages.
    pub(super) fn new(converter: &Converter, modbus: &Arc<Modbus>) -> Self {
        Self {
            converter: converter.clone(),
            modbus: Arc::clone(modbus),
            detector: VoltageDetector::default(),
        }
    }

    /// Returns the reading of a voltage, which depends on the previous voltages.
    pub(super) fn reading(&mut self, volts: f64) -> Result<ChangerReading, InvalidVoltage> {
        self.detector.feed(volts)
    }

    async fn once(&mut self) -> Result<ChangerReading, KelvinError> {
        let volts = self.volts().await?;
        Ok(self.reading(volts)?)
    }

    /// Returns the voltage at the changer.
    pub(super) async fn volts(&self) -> Result<f64, ModbusFault> {
        let Converter {
            register,
            divider: (line, ground),
            ..
        } = self.converter;
        let words = self.modbus.input(register, 1).await?;
        let millivolts = words.first().copied().unwrap_or_default();
        Ok(f64::from(millivolts) / 1000.0 * (line + ground) / ground)
    }

    /// Returns the reading of two equal consecutive measurements.
    pub(super) async fn steady(&mut self) -> Result<ChangerReading, KelvinError> {
        let mut last = self.once().await?;
        for _ in 0..MOST_LOOKS {
            sleep(POLL).await;
            let now = self.once().await?;
            if now == last {
                return Ok(now);
            }
            last = now;
        }
        Err(KelvinError::Unsteady)
    }

    /// Waits until the changer has switched.
    pub(super) async fn until(
        &mut self,
        wanted: ChangerReading,
        work: &Work,
    ) -> Result<(), KelvinError> {
        let until = Instant::now() + SWITCHED;
        // The voltage passes the levels of other tools while it rises.
        let mut last = None;
        loop {
            let now = self.once().await?;
            if now == wanted || (wanted == ChangerReading::NoTool && now == ChangerReading::Ready) {
                return Ok(());
            }
            let is_steady = last.replace(now) == Some(now);
            if let (ChangerReading::Tool(wanted), ChangerReading::Tool(found)) = (wanted, now)
                && is_steady
            {
                return Err(KelvinError::OtherTool { wanted, found });
            }
            if Instant::now() >= until {
                return Err(KelvinError::NotSwitched);
            }
            tokio::select! {
                () = work.stopped() => return Err(KelvinError::Stopped),
                () = sleep(POLL) => {}
            }
        }
    }
}

/// Number of measurements after which an unsteady voltage is an error.
const MOST_LOOKS: u32 = 20;
