//! Values of a component: variables that a sensor measures or that are computed from the runs of
//! its skills.
//!
//! A [`ValueSensor`] measures until an error occurs; [`watch`] restarts it with growing pauses. The
//! newest [`NewestState`] of each value is kept: a number with the time of the measurement, or the
//! reason why it is unknown.

mod statistics;

use std::fmt::Debug;
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use async_trait::async_trait;
use log_limit::Throttle;
use serde_json::Value as Json;
use tokio::sync::watch;
use tokio::time::{Instant, sleep};

pub use self::statistics::{Measure, Statistics, Tally};
use crate::value::{SkillValue, ValueError, ValueShape};

/// The constant description of a value.
#[derive(Debug, Clone, PartialEq)]
pub struct ValueFacts {
    /// The name of the value in its component.
    pub name: String,
    /// Type and rank.
    pub shape: ValueShape,
    /// The symbol of the unit, as `mbar`.
    pub unit: Option<String>,
    /// The lowest and the highest expected value of a number.
    pub range: Option<(f64, f64)>,
    /// Description for people.
    pub about: String,
}

/// A value that a device measures.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DeviceValue {
    /// The name.
    pub name: &'static str,
    /// Type and rank.
    pub shape: ValueShape,
    /// The symbol of the unit.
    pub unit: Option<&'static str>,
    /// The lowest and the highest value.
    pub range: Option<(f64, f64)>,
    /// Description for people.
    pub about: &'static str,
}

/// A source of values outside of the component.
#[async_trait]
pub trait ValueSensor: Debug + Send + Sync + 'static {
    /// Measures until an error occurs, about once in `period`. Each measurement is passed to `out`.
    /// Returns the reason why there are no further measurements, as text for people.
    async fn measure(&self, period: Duration, out: &Measured) -> String;

    /// Returns the address of the source, for display.
    fn source(&self) -> String;

    /// Returns the time after which a sensor without a measurement is restarted.
    fn within(&self, period: Duration) -> Duration {
        (period * MISSED_PERIODS).max(SHORTEST_WITHIN)
    }
}

/// The newest state of a value.
#[derive(Debug, Clone, PartialEq)]
pub struct NewestState {
    /// The value, or the reason why it is unknown.
    pub value: Result<SkillValue, UnknownValue>,
    /// Time of the measurement, or of the loss.
    pub at: SystemTime,
}

/// The reason why a value is unknown.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum UnknownValue {
    /// There is no measurement yet.
    #[error("not measured yet")]
    NotMeasured,
    /// The value is computed from successful runs, and there is none.
    #[error("there is no successful run yet")]
    NoRun,
    /// The source states that it does not know the value.
    #[error("the source does not know the value")]
    NotAtSource,
    /// The JSON of the source is no value of the described shape.
    #[error(transparent)]
    Json(#[from] ValueError),
    /// The value of the source has another shape than its description.
    #[error("the source gives {found}, and the value is {expected}")]
    OtherShape {
        /// The shape of the value of the source.
        found: ValueShape,
        /// The described shape.
        expected: ValueShape,
    },
    /// The sensor has measured nothing for too long.
    #[error("{sensor} has measured nothing for {within:?}")]
    Overdue {
        /// The address of the source.
        sensor: String,
        /// The time without a measurement.
        within: Duration,
    },
    /// The sensor, device or program gave this reason.
    #[error("{0}")]
    Reported(String),
}

impl From<String> for UnknownValue {
    fn from(why: String) -> Self {
        Self::Reported(why)
    }
}

/// A value with its newest reading. Clones share the reading.
#[derive(Debug, Clone)]
pub struct LiveValue {
    facts: Arc<ValueFacts>,
    reading: watch::Receiver<NewestState>,
}

impl LiveValue {
    /// Returns the description.
    #[must_use]
    pub fn facts(&self) -> &Arc<ValueFacts> {
        &self.facts
    }

    /// Returns the newest reading.
    #[must_use]
    pub fn reading(&self) -> NewestState {
        self.reading.borrow().clone()
    }

    /// Returns the readings. Only the newest of rapid changes is delivered.
    #[must_use]
    pub fn watch(&self) -> watch::Receiver<NewestState> {
        self.reading.clone()
    }
}

/// Receives the measurements of a source.
#[derive(Debug, Default)]
pub struct Measured {
    slots: Vec<Slot>,
    /// Time of the newest measurement.
    newest: watch::Sender<Option<Instant>>,
}

#[derive(Debug)]
struct Slot {
    /// The name of the value at its source.
    key: String,
    facts: Arc<ValueFacts>,
    reading: watch::Sender<NewestState>,
}

impl Measured {
    /// Adds a value, which has the name `key` at the source.
    pub fn add(&mut self, key: &str, facts: &Arc<ValueFacts>) -> LiveValue {
        let first = NewestState {
            value: Err(UnknownValue::NotMeasured),
            at: now(),
        };
        let (reading, watch) = watch::channel(first);
        self.slots.push(Slot {
            key: key.to_owned(),
            facts: Arc::clone(facts),
            reading,
        });
        LiveValue {
            facts: Arc::clone(facts),
            reading: watch,
        }
    }

    /// Returns the names at the source of the values that are needed.
    pub fn keys(&self) -> impl Iterator<Item = &str> {
        self.slots.iter().map(|slot| slot.key.as_str())
    }

    /// Returns the names of the values in the component.
    pub(crate) fn names(&self) -> Vec<String> {
        self.slots
            .iter()
            .map(|slot| slot.facts.name.clone())
            .collect()
    }

    /// Takes a measured value, or the reason why it is unknown. Other names are ignored.
    pub fn put(&self, key: &str, value: Result<SkillValue, UnknownValue>) {
        self.touch();
        for slot in self.slots.iter().filter(|slot| slot.key == key) {
            slot.put(value.clone());
        }
    }

    /// Takes a measured value as JSON; `null` if it is unknown. Other names are ignored.
    pub fn put_json(&self, key: &str, json: &Json) {
        self.touch();
        for slot in self.slots.iter().filter(|slot| slot.key == key) {
            slot.put_json(json);
        }
    }

    /// Takes the value of a source with a single value as JSON.
    pub fn put_single_json(&self, json: &Json) {
        self.touch();
        self.slots.iter().for_each(|slot| slot.put_json(json));
    }

    /// Takes the reason why all values are unknown.
    pub fn put_fault(&self, why: &str) {
        self.touch();
        self.lose(&UnknownValue::Reported(why.to_owned()));
    }

    /// Takes the value of a source with a single value.
    pub fn put_single(&self, value: Result<SkillValue, UnknownValue>) {
        self.touch();
        for slot in &self.slots {
            slot.put(value.clone());
        }
    }

    /// Notes that the source answers, although no value has changed.
    pub fn touch(&self) {
        self.newest.send_replace(Some(Instant::now()));
    }

    /// Marks all values as unknown.
    fn lose(&self, why: &UnknownValue) {
        for slot in &self.slots {
            slot.put(Err(why.clone()));
        }
    }

    /// Returns when the source has measured nothing for `within`.
    async fn overdue(&self, began: Instant, within: Duration) {
        loop {
            let newest = *self.newest.borrow();
            let until = newest.unwrap_or(began).max(began) + within;
            if until <= Instant::now() {
                return;
            }
            tokio::time::sleep_until(until).await;
        }
    }
}

impl Slot {
    fn put_json(&self, json: &Json) {
        self.put(match json.is_null() {
            true => Err(UnknownValue::NotAtSource),
            false => self.facts.shape.read_json(json).map_err(Into::into),
        });
    }

    fn put(&self, value: Result<SkillValue, UnknownValue>) {
        let expected = self.facts.shape;
        let value = value.and_then(|value| {
            let found = value.shape();
            let taken = expected.take(value);
            taken.ok_or(UnknownValue::OtherShape { found, expected })
        });
        self.reading.send_if_modified(|reading| {
            // A lost value keeps the time of its loss.
            let is_new = reading.value != value || value.is_ok();
            if is_new {
                *reading = NewestState { value, at: now() };
            }
            is_new
        });
    }
}

/// Measures as long as the future is polled. A sensor that fails is started again after a pause,
/// which grows while it fails. A changed period starts it again at once.
pub(crate) async fn watch(
    sensor: Arc<dyn ValueSensor>,
    mut periods: watch::Receiver<Duration>,
    out: Measured,
) {
    let mut pause = SHORTEST_PAUSE;
    let mut logged: Option<UnknownValue> = None;
    let mut losses = Throttle::new(TOLD_EVERY);
    let mut is_fixed = false;
    loop {
        let began = Instant::now();
        let period = *periods.borrow_and_update();
        let within = sensor.within(period);
        let why = tokio::select! {
            // The values stay known while the sensor starts with its new period.
            changed = periods.changed(), if !is_fixed => {
                is_fixed = changed.is_err();
                continue;
            }
            why = sensor.measure(period, &out) => UnknownValue::Reported(why),
            () = out.overdue(began, within) => {
                let sensor = sensor.source();
                UnknownValue::Overdue { sensor, within }
            }
        };
        let has_measured = out.newest.borrow().is_some_and(|newest| newest > began);
        out.lose(&why);
        if has_measured {
            pause = SHORTEST_PAUSE;
        }
        if (has_measured || logged.as_ref() != Some(&why))
            && let Some(suppressed) = losses.admit(Instant::now().into_std())
        {
            tracing::warn!(
                source = sensor.source(),
                suppressed,
                "cannot read a value: {why}"
            );
            logged = Some(why);
        }
        sleep(pause).await;
        pause = (pause * 2).min(LONGEST_PAUSE);
    }
}

#[expect(
    clippy::disallowed_methods,
    reason = "clients compare the time of a measurement with their clocks"
)]
fn now() -> SystemTime {
    SystemTime::now()
}

/// Default period of measurements.
pub(crate) const PERIOD: Duration = Duration::from_millis(200);
/// Number of periods without a measurement after which a sensor is restarted.
const MISSED_PERIODS: u32 = 10;
const SHORTEST_WITHIN: Duration = Duration::from_secs(3);
const SHORTEST_PAUSE: Duration = Duration::from_millis(250);
const LONGEST_PAUSE: Duration = Duration::from_secs(4);
/// Shortest time between two log messages about the losses of a sensor.
const TOLD_EVERY: Duration = Duration::from_secs(10);

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicU32, Ordering};

    use tokio::sync::Semaphore;

    use super::*;
    use crate::value::Builtin;

    fn facts(name: &str, builtin: Builtin) -> Arc<ValueFacts> {
        Arc::new(ValueFacts {
            name: name.to_owned(),
            shape: ValueShape::scalar(builtin),
            unit: None,
            range: None,
            about: String::new(),
        })
    }

    /// Measures once for each permit. Every third measurement fails.
    #[derive(Debug)]
    struct Counter {
        count: AtomicU32,
        permits: Arc<Semaphore>,
    }

    #[async_trait]
    impl ValueSensor for Counter {
        async fn measure(&self, _period: Duration, out: &Measured) -> String {
            loop {
                self.permits.acquire().await.unwrap().forget();
                let count = self.count.fetch_add(1, Ordering::Relaxed) + 1;
                if count.is_multiple_of(3) {
                    return "unplugged".to_owned();
                }
                out.put("Count", Ok(count.into()));
            }
        }

        fn source(&self) -> String {
            "a counter".to_owned()
        }
    }

    const WITHIN: Duration = Duration::from_millis(100);

    #[derive(Debug)]
    struct Silent;

    #[async_trait]
    impl ValueSensor for Silent {
        async fn measure(&self, _period: Duration, _out: &Measured) -> String {
            std::future::pending().await
        }

        fn source(&self) -> String {
            "a wire".to_owned()
        }

        fn within(&self, _period: Duration) -> Duration {
            WITHIN
        }
    }

    #[tokio::test]
    async fn a_value_is_unknown_with_its_reason_until_the_sensor_measures_again() {
        let mut out = Measured::default();
        let value = out.add("Count", &facts("Count", Builtin::UInt32));
        assert_eq!(value.reading().value, Err(UnknownValue::NotMeasured));
        let mut watch_value = value.watch();
        let permits = Arc::new(Semaphore::new(0));
        let counter = Counter {
            count: AtomicU32::new(0),
            permits: Arc::clone(&permits),
        };
        let task = tokio::spawn(watch(
            Arc::new(counter),
            watch::Sender::new(PERIOD).subscribe(),
            out,
        ));
        let mut seen = Vec::new();
        while seen.len() < 4 {
            permits.add_permits(1);
            watch_value.changed().await.unwrap();
            seen.push(watch_value.borrow_and_update().value.clone());
        }
        let expected = [
            Ok(SkillValue::UInt32(1)),
            Ok(SkillValue::UInt32(2)),
            Err(UnknownValue::Reported("unplugged".to_owned())),
            Ok(SkillValue::UInt32(4)),
        ];
        assert_eq!(seen, expected);
        task.abort();
    }

    #[tokio::test]
    async fn a_sensor_that_measures_nothing_is_not_waited_for_and_tried_again() {
        let mut out = Measured::default();
        let value = out.add("Level", &facts("Level", Builtin::Double));
        let mut watch_value = value.watch();
        let began = Instant::now();
        let task = tokio::spawn(watch(
            Arc::new(Silent),
            watch::Sender::new(PERIOD).subscribe(),
            out,
        ));
        watch_value.changed().await.unwrap();
        let lost = watch_value.borrow_and_update().value.clone().unwrap_err();
        assert_eq!(lost.to_string(), "a wire has measured nothing for 100ms");
        assert!(began.elapsed() >= WITHIN);
        task.abort();
    }

    #[test]
    fn a_value_of_another_type_is_refused_and_a_wider_number_is_taken() {
        let mut out = Measured::default();
        let level = out.add("", &facts("Level", Builtin::Double));
        out.put_single(Ok(SkillValue::Float(0.5)));
        assert_eq!(level.reading().value, Ok(SkillValue::Double(0.5)));
        out.put_single(Ok("full".into()));
        let refused = level.reading().value.unwrap_err().to_string();
        assert_eq!(refused, "the source gives String, and the value is Double");
        out.put("Other", Ok(1.0.into()));
        assert!(level.reading().value.is_err());
    }
}
