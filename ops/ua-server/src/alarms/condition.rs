//! The state machine of a condition (OPC 10000-9, 5.5 to 5.8). It has no clock, nodes or events:
//! times and event ids are inputs.

use std::collections::VecDeque;

use opcua::types::{ByteString, DateTime, LocalizedText, StatusCode};

/// The limits that a value exceeds, or that a value without limits is active.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(crate) struct Levels(u8);

impl Levels {
    pub(crate) const NONE: Self = Self(0);
    pub(crate) const LOW_LOW: Self = Self(1);
    pub(crate) const LOW: Self = Self(2);
    pub(crate) const HIGH: Self = Self(4);
    pub(crate) const HIGH_HIGH: Self = Self(8);
    /// An alarm without limits is active.
    pub(crate) const ON: Self = Self(16);

    pub(crate) const fn is_active(self) -> bool {
        self.0 != 0
    }

    pub(crate) const fn has(self, level: Self) -> bool {
        self.0 & level.0 != 0
    }

    pub(crate) const fn with(self, level: Self) -> Self {
        Self(self.0 | level.0)
    }

    /// Returns the levels with the inner limits of the outer limits that are exceeded.
    pub(crate) const fn filled(self) -> Self {
        let mut filled = self;
        if self.has(Self::LOW_LOW) {
            filled = filled.with(Self::LOW);
        }
        if self.has(Self::HIGH_HIGH) {
            filled = filled.with(Self::HIGH);
        }
        filled
    }

    /// Returns the outermost level only.
    pub(crate) const fn outermost(self) -> Self {
        if self.has(Self::HIGH_HIGH) {
            Self::HIGH_HIGH
        } else if self.has(Self::LOW_LOW) {
            Self::LOW_LOW
        } else {
            self
        }
    }

    /// Returns true if a limit is exceeded that was not exceeded before.
    pub(crate) const fn is_worse_than(self, before: Self) -> bool {
        self.0 & !before.filled().0 != 0
    }

    /// Returns the levels as bits.
    pub(crate) const fn bits(self) -> u8 {
        self.0
    }

    /// Returns the levels of known bits.
    pub(crate) const fn from_bits(bits: u8) -> Self {
        Self(bits & 31)
    }

    /// Returns the name of the outermost level.
    pub(crate) const fn name(self) -> &'static str {
        match self.outermost() {
            Self::HIGH_HIGH => "HighHigh",
            Self::LOW_LOW => "LowLow",
            Self::HIGH => "High",
            Self::LOW => "Low",
            Self::NONE => "Inactive",
            _ => "Active",
        }
    }
}

/// The time and the id of an event.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct EventStamp {
    pub(crate) time: DateTime,
    pub(crate) id: ByteString,
}

/// The state of the source of a condition.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct SourceReport {
    pub(crate) levels: Levels,
    pub(crate) severity: u16,
    pub(crate) message: String,
    /// The status of the value.
    pub(crate) quality: StatusCode,
}

/// The action of a user on a condition.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Action {
    pub(crate) user: String,
    /// A comment without text and locale leaves the comment of the condition as it is.
    pub(crate) comment: LocalizedText,
}

/// The effect of a report.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum ReportEffect {
    Nothing,
    /// The nodes change; there is no event, because clients do not track the condition.
    Shown,
    /// The nodes change, and there is an event.
    Reported,
}

/// A state with two values, and the time of its last transition.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct TwoState {
    pub(crate) on: bool,
    pub(crate) at: DateTime,
}

impl TwoState {
    fn set(&mut self, on: bool, at: DateTime) {
        if self.on != on {
            *self = Self { on, at };
        }
    }
}

/// The state of a condition that events and nodes show.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct AlarmConditionState {
    pub(crate) enabled: TwoState,
    pub(crate) active: TwoState,
    pub(crate) levels: Levels,
    pub(crate) acked: TwoState,
    pub(crate) confirmed: TwoState,
    pub(crate) severity: u16,
    pub(crate) last_severity: (u16, DateTime),
    pub(crate) quality: (StatusCode, DateTime),
    pub(crate) comment: (LocalizedText, DateTime),
    pub(crate) user: String,
    pub(crate) message: String,
    pub(crate) event: EventStamp,
}

impl AlarmConditionState {
    /// Returns true if clients have to track the condition (OPC 10000-9, 5.5.2).
    pub(crate) const fn retain(&self) -> bool {
        self.enabled.on && (self.active.on || !self.acked.on || !self.confirmed.on)
    }
}

/// A condition that is enabled, acknowledged and confirmed by users.
#[derive(Debug)]
pub(crate) struct AlarmCondition {
    state: AlarmConditionState,
    /// True if acknowledged conditions have to be confirmed.
    confirms: bool,
    /// The last report while the condition is disabled.
    missed: Option<SourceReport>,
    /// The ids of the last events, oldest first.
    events: VecDeque<ByteString>,
    /// The ids of the events since the condition became unacknowledged.
    unacknowledged: VecDeque<ByteString>,
}

/// The content of a condition that survives a restart.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct StoredCondition {
    pub(crate) state: AlarmConditionState,
    pub(crate) events: Vec<ByteString>,
    pub(crate) unacknowledged: Vec<ByteString>,
}

impl AlarmCondition {
    /// Returns the content that survives a restart.
    pub(crate) fn parts(&self) -> StoredCondition {
        StoredCondition {
            state: self.state.clone(),
            events: self.events.iter().cloned().collect(),
            unacknowledged: self.unacknowledged.iter().cloned().collect(),
        }
    }

    /// Replaces the state by the state before a restart.
    pub(crate) fn restore(&mut self, parts: StoredCondition) {
        let last = |ids: Vec<ByteString>| {
            let over = ids.len().saturating_sub(MOST_EVENTS);
            ids.into_iter().skip(over).collect()
        };
        self.state = parts.state;
        self.events = last(parts.events);
        self.unacknowledged = last(parts.unacknowledged);
    }

    /// Creates a condition that is enabled, inactive and acknowledged.
    pub(crate) fn new(confirms: bool, severity: u16, stamp: EventStamp) -> Self {
        let at = stamp.time;
        let state = |on| TwoState { on, at };
        Self {
            state: AlarmConditionState {
                enabled: state(true),
                active: state(false),
                levels: Levels::NONE,
                acked: state(true),
                confirmed: state(true),
                severity,
                last_severity: (severity, at),
                quality: (StatusCode::BadWaitingForInitialData, at),
                comment: (LocalizedText::null(), at),
                user: String::new(),
                message: String::new(),
                event: stamp,
            },
            confirms,
            missed: None,
            events: VecDeque::new(),
            unacknowledged: VecDeque::new(),
        }
    }

    pub(crate) const fn state(&self) -> &AlarmConditionState {
        &self.state
    }

    /// Applies the state of the source.
    pub(crate) fn report(&mut self, report: SourceReport, stamp: EventStamp) -> ReportEffect {
        if !self.state.enabled.on {
            self.missed = Some(report);
            return ReportEffect::Nothing;
        }
        self.apply(report, stamp)
    }

    fn apply(&mut self, report: SourceReport, stamp: EventStamp) -> ReportEffect {
        let state = &mut self.state;
        let was_retained = state.retain();
        let is_same = state.levels == report.levels
            && state.severity == report.severity
            && state.quality.0 == report.quality
            && state.message == report.message;
        if is_same {
            return ReportEffect::Nothing;
        }
        let at = stamp.time;
        if report.levels.is_worse_than(state.levels) {
            // An operator has not seen this state yet.
            state.acked.set(false, at);
            state.confirmed.set(true, at);
            self.unacknowledged.clear();
        }
        state.levels = report.levels;
        state.active.set(report.levels.is_active(), at);
        if state.severity != report.severity {
            state.last_severity = (state.severity, at);
            state.severity = report.severity;
        }
        if state.quality.0 != report.quality {
            state.quality = (report.quality, at);
        }
        state.message = report.message;
        if !was_retained && !state.retain() {
            return ReportEffect::Shown;
        }
        self.happened(stamp);
        ReportEffect::Reported
    }

    /// Notes the event of a change.
    fn happened(&mut self, stamp: EventStamp) {
        remember(&mut self.events, &stamp.id);
        if !self.state.acked.on {
            remember(&mut self.unacknowledged, &stamp.id);
        }
        self.state.event = stamp;
    }

    /// Enables the condition and applies the state of the source that it missed.
    ///
    /// # Errors
    /// Returns `BadConditionAlreadyEnabled` for an enabled condition.
    pub(crate) fn enable(&mut self, user: &str, stamp: EventStamp) -> Result<(), StatusCode> {
        if self.state.enabled.on {
            return Err(StatusCode::BadConditionAlreadyEnabled);
        }
        self.state.enabled.set(true, stamp.time);
        user.clone_into(&mut self.state.user);
        if let Some(report) = self.missed.take() {
            let _effect = self.apply(report, stamp.clone());
        }
        self.happened(stamp);
        Ok(())
    }

    /// Disables the condition.
    ///
    /// # Errors
    /// Returns `BadConditionAlreadyDisabled` for a disabled condition.
    pub(crate) fn disable(&mut self, user: &str, stamp: EventStamp) -> Result<(), StatusCode> {
        if !self.state.enabled.on {
            return Err(StatusCode::BadConditionAlreadyDisabled);
        }
        self.state.enabled.set(false, stamp.time);
        user.clone_into(&mut self.state.user);
        self.happened(stamp);
        Ok(())
    }

    /// Acknowledges the state that an event showed. An event from before the condition became
    /// worse acknowledges nothing.
    ///
    /// # Errors
    /// Returns the status of OPC 10000-9, 5.7.3.
    pub(crate) fn acknowledge(
        &mut self,
        event: &ByteString,
        action: Action,
        stamp: EventStamp,
    ) -> Result<(), StatusCode> {
        self.check(event)?;
        if self.state.acked.on {
            return Err(StatusCode::BadConditionBranchAlreadyAcked);
        }
        if !self.unacknowledged.contains(event) {
            return Err(StatusCode::BadEventIdUnknown);
        }
        self.state.acked.set(true, stamp.time);
        if self.confirms {
            self.state.confirmed.set(false, stamp.time);
        }
        self.unacknowledged.clear();
        self.act(action, stamp);
        Ok(())
    }

    /// Confirms an acknowledged condition.
    ///
    /// # Errors
    /// Returns the status of OPC 10000-9, 5.7.4, and `BadMethodInvalid` for a condition without
    /// confirmation.
    pub(crate) fn confirm(
        &mut self,
        event: &ByteString,
        action: Action,
        stamp: EventStamp,
    ) -> Result<(), StatusCode> {
        if !self.confirms {
            return Err(StatusCode::BadMethodInvalid);
        }
        self.check(event)?;
        if self.state.confirmed.on {
            return Err(StatusCode::BadConditionBranchAlreadyConfirmed);
        }
        self.state.confirmed.set(true, stamp.time);
        self.act(action, stamp);
        Ok(())
    }

    /// Adds a comment.
    ///
    /// # Errors
    /// Returns the status of OPC 10000-9, 5.5.6.
    pub(crate) fn add_comment(
        &mut self,
        event: &ByteString,
        action: Action,
        stamp: EventStamp,
    ) -> Result<(), StatusCode> {
        self.check(event)?;
        self.act(action, stamp);
        Ok(())
    }

    /// Returns true if an event of the condition has that id and is recent.
    pub(crate) fn has_event(&self, event: &ByteString) -> bool {
        self.events.contains(event)
    }

    fn check(&self, event: &ByteString) -> Result<(), StatusCode> {
        if !self.state.enabled.on {
            return Err(StatusCode::BadConditionDisabled);
        }
        if !self.has_event(event) {
            return Err(StatusCode::BadEventIdUnknown);
        }
        Ok(())
    }

    fn act(&mut self, action: Action, stamp: EventStamp) {
        let Action { user, comment } = action;
        if !(comment.text.is_null() && comment.locale.is_null()) {
            self.state.comment = (comment, stamp.time);
        }
        self.state.user = user;
        self.happened(stamp);
    }
}

fn remember(ids: &mut VecDeque<ByteString>, id: &ByteString) {
    if ids.back() == Some(id) {
        return;
    }
    if ids.len() >= MOST_EVENTS {
        ids.pop_front();
    }
    ids.push_back(id.clone());
}

/// Number of events of a condition that clients can refer to.
const MOST_EVENTS: usize = 16;

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the stamp of the event with this number, at as many seconds.
    fn stamp(number: u8) -> EventStamp {
        EventStamp {
            time: DateTime::from(i64::from(number) * 10_000_000),
            id: event(number),
        }
    }

    fn event(number: u8) -> ByteString {
        ByteString::from(vec![number])
    }

    fn at(levels: Levels) -> SourceReport {
        let outer = levels.has(Levels::HIGH_HIGH) || levels.has(Levels::LOW_LOW);
        SourceReport {
            levels,
            severity: if outer { 750 } else { 500 },
            message: levels.name().to_owned(),
            quality: StatusCode::Good,
        }
    }

    fn anna(comment: &str) -> Action {
        Action {
            user: "anna".to_owned(),
            comment: LocalizedText::new("en", comment),
        }
    }

    fn condition(confirms: bool) -> AlarmCondition {
        let mut condition = AlarmCondition::new(confirms, 500, stamp(0));
        assert_eq!(
            condition.report(at(Levels::NONE), stamp(1)),
            ReportEffect::Shown,
            "a normal value is no event"
        );
        condition
    }

    /// Returns active, acknowledged, confirmed, retain.
    fn states(condition: &AlarmCondition) -> [bool; 4] {
        let state = condition.state();
        [
            state.active.on,
            state.acked.on,
            state.confirmed.on,
            state.retain(),
        ]
    }

    /// The example of OPC 10000-9, B.1.2.
    #[test]
    fn a_condition_is_retained_until_it_is_inactive_acknowledged_and_confirmed() {
        let mut condition = condition(true);
        assert_eq!(states(&condition), [false, true, true, false]);
        assert_eq!(
            condition.report(at(Levels::HIGH), stamp(2)),
            ReportEffect::Reported
        );
        assert_eq!(states(&condition), [true, false, true, true]);
        condition
            .acknowledge(&event(2), anna("seen"), stamp(3))
            .unwrap();
        assert_eq!(states(&condition), [true, true, false, true]);
        assert_eq!(
            condition.report(at(Levels::NONE), stamp(4)),
            ReportEffect::Reported
        );
        assert_eq!(states(&condition), [false, true, false, true]);
        condition
            .confirm(&event(4), anna("repaired"), stamp(5))
            .unwrap();
        assert_eq!(states(&condition), [false, true, true, false]);
        let state = condition.state();
        assert_eq!(state.user, "anna");
        assert_eq!(state.comment.0.text.as_ref(), "repaired");
        assert_eq!(state.event, stamp(5));
    }

    #[test]
    fn an_event_before_the_condition_became_worse_acknowledges_nothing() {
        let mut condition = condition(false);
        condition.report(at(Levels::HIGH), stamp(2));
        condition.report(at(Levels::HIGH_HIGH), stamp(3));
        let early = condition.acknowledge(&event(2), anna(""), stamp(4));
        assert_eq!(early, Err(StatusCode::BadEventIdUnknown));
        condition
            .acknowledge(&event(3), anna(""), stamp(4))
            .unwrap();
        assert_eq!(
            condition.report(at(Levels::HIGH), stamp(5)),
            ReportEffect::Reported
        );
        assert!(condition.state().acked.on, "a step back needs no attention");
        condition.report(at(Levels::LOW), stamp(6));
        assert!(!condition.state().acked.on, "the other side does");
        assert_eq!(condition.state().last_severity.0, 750);
    }

    #[test]
    fn refusals_have_the_status_of_the_standard() {
        let mut condition = condition(true);
        condition.report(at(Levels::HIGH), stamp(2));
        let other = event(99);
        let comment = condition.add_comment(&other, anna("x"), stamp(3));
        assert_eq!(comment, Err(StatusCode::BadEventIdUnknown));
        let acked = condition.acknowledge(&other, anna("x"), stamp(3));
        assert_eq!(acked, Err(StatusCode::BadEventIdUnknown));
        let confirmed = condition.confirm(&event(2), anna("x"), stamp(3));
        assert_eq!(
            confirmed,
            Err(StatusCode::BadConditionBranchAlreadyConfirmed)
        );
        condition
            .acknowledge(&event(2), anna(""), stamp(3))
            .unwrap();
        let again = condition.acknowledge(&event(2), anna(""), stamp(4));
        assert_eq!(again, Err(StatusCode::BadConditionBranchAlreadyAcked));
        let enabled = condition.enable("anna", stamp(4));
        assert_eq!(enabled, Err(StatusCode::BadConditionAlreadyEnabled));
        condition.disable("anna", stamp(4)).unwrap();
        assert!(!condition.state().retain());
        let comment = condition.add_comment(&event(3), anna("x"), stamp(5));
        assert_eq!(comment, Err(StatusCode::BadConditionDisabled));
        let disabled = condition.disable("anna", stamp(5));
        assert_eq!(disabled, Err(StatusCode::BadConditionAlreadyDisabled));
    }

    #[test]
    fn a_condition_without_confirmation_is_done_when_it_is_acknowledged() {
        let mut condition = condition(false);
        condition.report(at(Levels::ON), stamp(2));
        condition.report(at(Levels::NONE), stamp(3));
        assert_eq!(states(&condition), [false, false, true, true]);
        condition
            .acknowledge(&event(3), anna(""), stamp(4))
            .unwrap();
        assert_eq!(states(&condition), [false, true, true, false]);
        let confirmed = condition.confirm(&event(4), anna(""), stamp(5));
        assert_eq!(confirmed, Err(StatusCode::BadMethodInvalid));
    }

    #[test]
    fn an_enabled_condition_has_the_last_state_of_its_source() {
        let mut condition = condition(false);
        condition.disable("anna", stamp(2)).unwrap();
        let missed = condition.report(at(Levels::HIGH), stamp(3));
        assert_eq!(missed, ReportEffect::Nothing);
        assert!(!condition.state().active.on);
        condition.enable("anna", stamp(4)).unwrap();
        assert_eq!(states(&condition), [true, false, true, true]);
        condition
            .acknowledge(&event(4), anna(""), stamp(5))
            .unwrap();
    }

    #[test]
    fn a_null_comment_keeps_the_comment_and_the_ids_of_old_events_expire() {
        let mut condition = condition(false);
        condition.report(at(Levels::HIGH), stamp(2));
        condition
            .add_comment(&event(2), anna("watch it"), stamp(3))
            .unwrap();
        let null = Action {
            comment: LocalizedText::null(),
            ..anna("")
        };
        for number in 4..24 {
            condition
                .add_comment(&event(number - 1), null.clone(), stamp(number))
                .unwrap();
        }
        assert_eq!(condition.state().comment.0.text.as_ref(), "watch it");
        let old = condition.add_comment(&event(2), null, stamp(24));
        assert_eq!(old, Err(StatusCode::BadEventIdUnknown));
    }

    #[test]
    fn the_status_of_the_value_is_an_event_while_the_condition_is_retained() {
        let mut condition = condition(false);
        let mut lost = at(Levels::NONE);
        lost.quality = StatusCode::BadNoCommunication;
        assert_eq!(condition.report(lost, stamp(2)), ReportEffect::Shown);
        condition.report(at(Levels::HIGH), stamp(3));
        let mut lost = at(Levels::HIGH);
        lost.quality = StatusCode::BadNoCommunication;
        assert_eq!(
            condition.report(lost.clone(), stamp(4)),
            ReportEffect::Reported
        );
        assert_eq!(condition.report(lost, stamp(5)), ReportEffect::Nothing);
        assert!(condition.state().active.on);
    }
}
