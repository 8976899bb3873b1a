//! Values that are computed from the runs of skills.

use std::collections::BTreeSet;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use async_trait::async_trait;
use program::ProgramMachineState;
use tokio::sync::watch;
use tokio::time::{Instant, MissedTickBehavior, interval};

use super::{Measured, UnknownValue, ValueSensor};
use crate::shown::{SkillEvent, SkillObserver, SkillSnapshot};
use crate::value::{Builtin, SkillValue, ValueShape};

/// A computed value.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Measure {
    /// The number of runs that have ended.
    Runs,
    /// The number of runs that have ended without success.
    Failures,
    /// The mean duration of the successful runs, s.
    MeanDuration,
    /// The share of the time since the start during which no failed run waited for a Reset, %.
    Availability,
}

impl Measure {
    /// All measures with their keys in YAML.
    pub(crate) const ALL: [(Self, &'static str); 4] = [
        (Self::Runs, "runs"),
        (Self::Failures, "failures"),
        (Self::MeanDuration, "mean_duration"),
        (Self::Availability, "availability"),
    ];

    /// Returns the key in YAML.
    pub(crate) fn key(self) -> &'static str {
        let known = Self::ALL.iter().find(|(measure, _)| *measure == self);
        known.map_or("", |(_, key)| key)
    }

    /// Returns the type.
    #[must_use]
    pub fn shape(self) -> ValueShape {
        ValueShape::scalar(match self {
            Self::Runs | Self::Failures => Builtin::UInt32,
            Self::MeanDuration | Self::Availability => Builtin::Double,
        })
    }

    /// Returns the symbol of the unit.
    #[must_use]
    pub fn unit(self) -> Option<&'static str> {
        match self {
            Self::Runs | Self::Failures => None,
            Self::MeanDuration => Some("s"),
            Self::Availability => Some("%"),
        }
    }

    /// Returns the lowest and the highest value.
    #[must_use]
    pub fn range(self) -> Option<(f64, f64)> {
        (self == Self::Availability).then_some((0.0, 100.0))
    }

    /// Returns the description for people.
    #[must_use]
    pub fn about(self) -> &'static str {
        match self {
            Self::Runs => "The number of runs that have ended since the start.",
            Self::Failures => "The number of runs since the start that have ended without success.",
            Self::MeanDuration => "The mean duration of the successful runs since the start.",
            Self::Availability => {
                "The share of the time since the start during which no failed run waited for a Reset."
            }
        }
    }
}

/// Counts the runs of one or several skills. Time is an input.
#[derive(Debug, Clone)]
pub struct Statistics {
    since: Instant,
    runs: u32,
    failures: u32,
    succeeded: u32,
    worked: Duration,
    /// The skills with a failed run that waits for a Reset.
    down: BTreeSet<u16>,
    down_since: Option<Instant>,
    downtime: Duration,
    /// The running skills with the starts of their runs.
    running: Vec<(u16, Instant)>,
}

impl Statistics {
    /// Starts counting.
    #[must_use]
    pub fn new(now: Instant) -> Self {
        Self {
            since: now,
            runs: 0,
            failures: 0,
            succeeded: 0,
            worked: Duration::ZERO,
            down: BTreeSet::new(),
            down_since: None,
            downtime: Duration::ZERO,
            running: Vec::new(),
        }
    }

    /// Notes a transition of a skill.
    pub fn moved(
        &mut self,
        skill: u16,
        (from, to): (ProgramMachineState, ProgramMachineState),
        now: Instant,
    ) {
        match (from, to) {
            (ProgramMachineState::Ready, ProgramMachineState::Running) => {
                self.running.retain(|(known, _)| *known != skill);
                self.running.push((skill, now));
            }
            (ProgramMachineState::Halted, ProgramMachineState::Ready) => {
                self.down.remove(&skill);
                if self.down.is_empty()
                    && let Some(since) = self.down_since.take()
                {
                    self.downtime += now.duration_since(since);
                }
            }
            (
                ProgramMachineState::Halted
                | ProgramMachineState::Ready
                | ProgramMachineState::Running
                | ProgramMachineState::Suspended,
                _,
            ) => {}
        }
    }

    /// Notes the end of a run of a skill.
    pub fn ended(&mut self, skill: u16, succeeded: bool, now: Instant) {
        self.runs = self.runs.saturating_add(1);
        let at = self.running.iter().position(|(known, _)| *known == skill);
        let began = at.map(|at| self.running.swap_remove(at).1);
        if succeeded {
            self.succeeded = self.succeeded.saturating_add(1);
            self.worked += began.map_or(Duration::ZERO, |began| now.duration_since(began));
        } else {
            self.failures = self.failures.saturating_add(1);
            self.down.insert(skill);
            self.down_since.get_or_insert(now);
        }
    }

    /// Returns a computed value; `None` if it needs a successful run, and there is none yet.
    #[must_use]
    pub fn value(&self, of: Measure, now: Instant) -> Option<SkillValue> {
        Some(match of {
            Measure::Runs => self.runs.into(),
            Measure::Failures => self.failures.into(),
            Measure::MeanDuration => match self.succeeded {
                0 => return None,
                count => (self.worked.as_secs_f64() / f64::from(count)).into(),
            },
            Measure::Availability => {
                let whole = now.duration_since(self.since).as_secs_f64();
                let since_down = self.down_since.map(|since| now.duration_since(since));
                let down = self.downtime + since_down.unwrap_or_default();
                match whole > 0.0 {
                    true => (100.0 * (1.0 - down.as_secs_f64() / whole)).into(),
                    false => 100.0.into(),
                }
            }
        })
    }
}

/// The statistics of one or several skills, shared by their observers and the computed values.
#[derive(Debug, Clone)]
pub struct Tally {
    statistics: Arc<Mutex<Statistics>>,
    changed: watch::Sender<u64>,
    of: String,
}

impl Tally {
    /// Starts counting for skills with this name.
    #[must_use]
    pub fn new(of: &str) -> Self {
        Self {
            statistics: Arc::new(Mutex::new(Statistics::new(Instant::now()))),
            changed: watch::Sender::new(0),
            of: of.to_owned(),
        }
    }

    /// Returns an observer of the skill with this number.
    #[must_use]
    pub fn observer(&self, skill: u16) -> Box<dyn SkillObserver> {
        Box::new(Counting {
            tally: self.clone(),
            skill,
        })
    }

    fn lock(&self) -> MutexGuard<'_, Statistics> {
        // Each change is complete before the lock is released.
        self.statistics
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
    }
}

#[async_trait]
impl ValueSensor for Tally {
    /// Computes the values after each change, and once in each period.
    async fn measure(&self, period: Duration, out: &Measured) -> String {
        let mut changed = self.changed.subscribe();
        let mut ticks = interval(period);
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            {
                let statistics = self.lock();
                let now = Instant::now();
                for (measure, key) in Measure::ALL {
                    if out.keys().any(|wanted| wanted == key) {
                        let value = statistics.value(measure, now);
                        out.put(key, value.ok_or(UnknownValue::NoRun));
                    }
                }
            }
            tokio::select! {
                // This sensor holds the sender.
                _changed = changed.changed() => {}
                _ = ticks.tick() => {}
            }
        }
    }

    fn source(&self) -> String {
        format!("the runs of {}", self.of)
    }
}

struct Counting {
    tally: Tally,
    skill: u16,
}

impl SkillObserver for Counting {
    fn told(&self, what: SkillEvent<'_>, _shown: &SkillSnapshot) {
        let now = Instant::now();
        match what {
            SkillEvent::Transition(happened) => {
                let transition = happened.transition;
                let states = (transition.from, transition.to);
                self.tally.lock().moved(self.skill, states, now);
            }
            SkillEvent::Outcome(outcome) => {
                self.tally.lock().ended(self.skill, outcome.succeeded, now)
            }
            SkillEvent::Parameters(_)
            | SkillEvent::Step
            | SkillEvent::Progress
            | SkillEvent::Pending(_)
            | SkillEvent::Called => {
                return;
            }
        }
        self.tally.changed.send_modify(|count| *count += 1);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn seconds(count: u64) -> Duration {
        Duration::from_secs(count)
    }

    #[test]
    fn runs_are_counted_and_a_failed_skill_is_not_available_until_its_reset() {
        let start = Instant::now();
        let mut statistics = Statistics::new(start);
        let at = |count| start + seconds(count);
        let run = (ProgramMachineState::Ready, ProgramMachineState::Running);
        let value = |statistics: &Statistics, of, now| {
            let value = statistics.value(of, now);
            value.map(|value| value.as_f64().unwrap())
        };
        assert!(value(&statistics, Measure::MeanDuration, start).is_none());
        assert_eq!(
            value(&statistics, Measure::Availability, start),
            Some(100.0)
        );
        statistics.moved(
            1,
            (ProgramMachineState::Halted, ProgramMachineState::Ready),
            at(1),
        );
        statistics.moved(1, run, at(2));
        statistics.ended(1, true, at(4));
        statistics.moved(2, run, at(4));
        statistics.ended(2, true, at(10));
        assert_eq!(value(&statistics, Measure::MeanDuration, at(10)), Some(4.0));
        statistics.moved(1, run, at(10));
        statistics.ended(1, false, at(20));
        // A second failure meanwhile is not counted twice as time.
        statistics.moved(2, run, at(21));
        statistics.ended(2, false, at(24));
        statistics.moved(
            1,
            (ProgramMachineState::Halted, ProgramMachineState::Ready),
            at(26),
        );
        assert_eq!(
            value(&statistics, Measure::Availability, at(40)),
            Some(50.0)
        );
        statistics.moved(
            2,
            (ProgramMachineState::Halted, ProgramMachineState::Ready),
            at(40),
        );
        assert_eq!(
            value(&statistics, Measure::Availability, at(80)),
            Some(75.0)
        );
        assert_eq!(value(&statistics, Measure::Runs, at(80)), Some(4.0));
        assert_eq!(value(&statistics, Measure::Failures, at(80)), Some(2.0));
        assert_eq!(value(&statistics, Measure::MeanDuration, at(80)), Some(4.0));
    }
}
