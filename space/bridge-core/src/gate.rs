//! Publishing rules of a topic: publish on change, deadband, and maximum rate.

use std::time::Instant;

use mappings::Publish;
use uadp::{Array, BuiltinType, DecodeError, Fields, Scalar, Variant};

use crate::message::EncodedSample;
use crate::output::PublisherKey;
use crate::writer::MAX_KEPT;

/// Holds back samples of a topic according to the rule of its variable.
#[derive(Debug)]
pub(crate) struct Gate {
    rule: Publish,
    /// The fields of the last published sample; empty before the first.
    last: Vec<u8>,
    /// The publisher of the last published sample, if it latches.
    last_by: Option<PublisherKey>,
    /// The latched publishers with a published sample.
    met: Vec<PublisherKey>,
    /// The earliest time of the next sample.
    opens: Option<Instant>,
    /// The newest sample that was too early.
    held: Option<Waiting>,
}

/// A sample and its publisher, if the publisher latches.
pub(crate) type Waiting = (EncodedSample, Option<PublisherKey>);

/// The decision for a sample.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Passage {
    Passes,
    /// The sample equals the last published sample.
    Unchanged,
    /// The sample waits, unless a newer sample replaces it.
    TooEarly,
}

impl Gate {
    /// Returns `None` if the rule passes all samples.
    pub(crate) fn new(rule: Publish) -> Option<Box<Self>> {
        let gate = Self {
            rule,
            last: Vec::new(),
            last_by: None,
            met: Vec::new(),
            opens: None,
            held: None,
        };
        (rule != Publish::default()).then(|| Box::new(gate))
    }

    /// Decides about a sample and stores it as the last published sample if it passes. A waiting
    /// sample is outdated and returned if the new sample passes or is unchanged.
    ///
    /// The first sample of a latched publisher always passes, because late joiners receive the last
    /// sample of each publisher.
    pub(crate) fn judge(
        &mut self,
        sample: &EncodedSample,
        latched_by: Option<PublisherKey>,
        now: Instant,
    ) -> (Passage, Option<Waiting>) {
        let fields = sample.fields().unwrap_or_default();
        let first =
            latched_by.is_some_and(|key| self.met.len() < MAX_KEPT && !self.met.contains(&key));
        if !first {
            let same = self.last_by == latched_by && self.says_the_same(fields);
            if self.rule.on_change && same {
                return (Passage::Unchanged, self.held.take());
            }
            if self.opens.is_some_and(|opens| now < opens) {
                return (Passage::TooEarly, None);
            }
        }
        self.say(fields, latched_by, now);
        // A waiting sample of another publisher is still valid.
        let outpaced = self.held.take_if(|(_, by)| !first || *by == latched_by);
        (Passage::Passes, outpaced)
    }

    fn say(&mut self, fields: &[u8], latched_by: Option<PublisherKey>, now: Instant) {
        self.last.clear();
        self.last.extend_from_slice(fields);
        self.last_by = latched_by;
        if let Some(key) = latched_by.filter(|key| !self.met.contains(key))
            && self.met.len() < MAX_KEPT
        {
            self.met.push(key);
        }
        self.opens = (!self.rule.period.is_zero()).then(|| now + self.rule.period);
    }

    /// Returns the waiting sample for immediate publication, because no sample may follow it.
    pub(crate) fn hurry(&mut self, now: Instant) -> Option<Waiting> {
        let (sample, latched_by) = self.held.take()?;
        self.say(sample.fields().unwrap_or_default(), latched_by, now);
        Some((sample, latched_by))
    }

    /// Removes a latched publisher. Returns its waiting sample for immediate publication.
    pub(crate) fn left(&mut self, publisher: PublisherKey, now: Instant) -> Option<Waiting> {
        let waits = matches!(self.held, Some((_, by)) if by == Some(publisher));
        let held = if waits { self.hurry(now) } else { None };
        self.met.retain(|key| *key != publisher);
        held
    }

    /// Stores a sample as the waiting sample and returns the previous waiting sample.
    pub(crate) fn hold(&mut self, sample: Waiting) -> Option<Waiting> {
        self.held.replace(sample)
    }

    /// Removes the waiting sample and returns it.
    pub(crate) fn drop_held(&mut self) -> Option<Waiting> {
        self.held.take()
    }

    /// Records that a published sample was not sent: the next one differs from it.
    pub(crate) fn forget_last(&mut self) {
        self.last.clear();
    }

    /// Returns whether a sample waits.
    pub(crate) const fn holds(&self) -> bool {
        self.held.is_some()
    }

    /// Returns the time at which the waiting sample may be published.
    pub(crate) fn due(&self) -> Option<Instant> {
        self.held.as_ref().and(self.opens)
    }

    /// Returns the waiting sample if its time has come.
    pub(crate) fn release(&mut self, now: Instant) -> Option<Waiting> {
        if self.due().is_none_or(|due| now < due) {
            return None;
        }
        self.hurry(now)
    }

    fn says_the_same(&self, fields: &[u8]) -> bool {
        if self.last.is_empty() {
            return false;
        }
        if self.last == fields {
            return true;
        }
        let deadband = self.rule.deadband();
        deadband > 0.0 && within(&self.last, fields, deadband).unwrap_or(false)
    }
}

/// Returns whether all numbers differ by at most `deadband` and all other values are equal.
fn within(one: &[u8], other: &[u8], deadband: f64) -> Result<bool, DecodeError> {
    let (mut one, mut other) = (Fields::parse(one)?, Fields::parse(other)?);
    loop {
        match (one.next().transpose()?, other.next().transpose()?) {
            (None, None) => return Ok(true),
            (Some(a), Some(b)) if near(&a, &b, deadband) => {}
            _ => return Ok(false),
        }
    }
}

fn near(one: &Variant<'_>, other: &Variant<'_>, deadband: f64) -> bool {
    match (one, other) {
        (Variant::Scalar(a), Variant::Scalar(b)) => near_scalars(*a, *b, deadband),
        (Variant::Array(a), Variant::Array(b)) => {
            let alike = |a: &Array<'_>| (a.element(), a.len());
            alike(a) == alike(b)
                && a.element() != BuiltinType::ExtensionObject
                && a.iter()
                    .zip(b.iter())
                    .all(|(a, b)| near_scalars(a, b, deadband))
        }
        (one, other) => one == other,
    }
}

fn near_scalars(one: Scalar<'_>, other: Scalar<'_>, deadband: f64) -> bool {
    match (number(one), number(other)) {
        // The difference of two equal infinities is NaN, so equality is checked first.
        (Some(a), Some(b)) => a == b || (a - b).abs() <= deadband || (a.is_nan() && b.is_nan()),
        _ => one == other,
    }
}

#[expect(
    clippy::wildcard_enum_match_arm,
    clippy::cast_precision_loss,
    reason = "only numbers are near each other, and whether 64 bits are is known to 53 of them"
)]
fn number(value: Scalar<'_>) -> Option<f64> {
    Some(match value {
        Scalar::SByte(value) => value.into(),
        Scalar::Byte(value) => value.into(),
        Scalar::Int16(value) => value.into(),
        Scalar::UInt16(value) => value.into(),
        Scalar::Int32(value) => value.into(),
        Scalar::UInt32(value) => value.into(),
        Scalar::Int64(value) => value as f64,
        Scalar::UInt64(value) => value as f64,
        Scalar::Float(value) => value.into(),
        Scalar::Double(value) => value,
        _ => return None,
    })
}
