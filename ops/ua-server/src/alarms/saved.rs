//! Conditions as they are stored over a restart: an acknowledged alarm stays acknowledged, and a
//! disabled condition disabled.

use opcua::types::{ByteString, DateTime, LocalizedText, NodeId, StatusCode, UAString};
use serde::{Deserialize, Serialize};

use super::condition::{
    AlarmCondition, AlarmConditionState, EventStamp, Levels, StoredCondition, TwoState,
};
use super::{Entry, Place};

/// The stored form of a condition. Times are ticks of 100 ns.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Saved {
    /// The alarm of the mapping, to recognize another one.
    alarm: String,
    enabled: (bool, i64),
    active: (bool, i64),
    levels: u8,
    acked: (bool, i64),
    confirmed: (bool, i64),
    severity: u16,
    last_severity: (u16, i64),
    quality: (u32, i64),
    comment: (Option<String>, Option<String>, i64),
    user: String,
    message: String,
    event: (Vec<u8>, i64),
    events: Vec<Vec<u8>>,
    unacknowledged: Vec<Vec<u8>>,
}

impl Entry {
    /// Returns the text that distinguishes the alarm from other alarms of its variable; `None` for
    /// conditions that are not stored.
    pub(super) fn alarm_text(&self) -> Option<String> {
        let (alarm, _) = self.alarm.as_ref()?;
        Some(format!("{alarm:?}"))
    }

    /// Continues with the condition before a restart, if it is that of the same alarm. Returns
    /// false otherwise.
    pub(super) fn restore(&mut self, bytes: &[u8]) -> bool {
        let text = self.alarm_text().unwrap_or_default();
        let Some(parts) = decoded(bytes, &text) else {
            return false;
        };
        let Some((_, trigger)) = &mut self.alarm else {
            return false;
        };
        trigger.restore(parts.state.levels);
        self.condition.restore(parts);
        true
    }
}

impl Place {
    /// Continues with the stored condition of the same alarm. Any other stored condition of the
    /// node is removed: if its alarm returned, it would continue with an outdated state.
    pub(super) fn restore(&self, entry: &mut Entry) {
        let mut stored = self.stored.lock();
        let bytes = stored.take(&entry.identity.node);
        if !bytes.is_some_and(|bytes| entry.restore(&bytes)) {
            stored.remove(&entry.identity.node);
        }
    }

    /// Removes stored conditions of alarms that do not exist any more.
    pub(super) fn remove_stored<'n>(&self, nodes: impl Iterator<Item = &'n NodeId>) {
        let stored = self.stored.lock();
        for node in nodes {
            stored.remove(node);
        }
    }
}

/// Encodes a condition of an alarm.
pub(super) fn encoded(condition: &AlarmCondition, alarm: &str) -> Vec<u8> {
    let StoredCondition {
        state,
        events,
        unacknowledged,
    } = condition.parts();
    let two = |state: TwoState| (state.on, state.at.ticks());
    let text = |text: &UAString| text.value().clone();
    let (comment, commented) = &state.comment;
    let ids = |ids: &[ByteString]| -> Vec<Vec<u8>> { ids.iter().map(bytes).collect() };
    let saved = Saved {
        alarm: alarm.to_owned(),
        enabled: two(state.enabled),
        active: two(state.active),
        levels: state.levels.bits(),
        acked: two(state.acked),
        confirmed: two(state.confirmed),
        severity: state.severity,
        last_severity: (state.last_severity.0, state.last_severity.1.ticks()),
        quality: (state.quality.0.bits(), state.quality.1.ticks()),
        comment: (
            text(&comment.locale),
            text(&comment.text),
            commented.ticks(),
        ),
        user: state.user.clone(),
        message: state.message.clone(),
        event: (bytes(&state.event.id), state.event.time.ticks()),
        events: ids(&events),
        unacknowledged: ids(&unacknowledged),
    };
    serde_json::to_vec(&saved).unwrap_or_default()
}

/// Decodes a condition of an alarm. Returns `None` for the condition of another alarm, and for
/// bytes that are no condition.
fn decoded(bytes: &[u8], alarm: &str) -> Option<StoredCondition> {
    let saved: Saved = serde_json::from_slice(bytes).ok()?;
    if saved.alarm != alarm {
        return None;
    }
    let two = |(on, at): (bool, i64)| TwoState {
        on,
        at: DateTime::from(at),
    };
    let text = |text: Option<String>| text.map_or_else(UAString::null, UAString::from);
    let ids = |ids: Vec<Vec<u8>>| ids.into_iter().map(ByteString::from).collect();
    let (locale, comment, commented) = saved.comment;
    let (id, time) = saved.event;
    Some(StoredCondition {
        state: AlarmConditionState {
            enabled: two(saved.enabled),
            active: two(saved.active),
            levels: Levels::from_bits(saved.levels),
            acked: two(saved.acked),
            confirmed: two(saved.confirmed),
            severity: saved.severity,
            last_severity: (saved.last_severity.0, DateTime::from(saved.last_severity.1)),
            quality: (
                StatusCode::from(saved.quality.0),
                DateTime::from(saved.quality.1),
            ),
            comment: (
                LocalizedText {
                    locale: text(locale),
                    text: text(comment),
                },
                DateTime::from(commented),
            ),
            user: saved.user,
            message: saved.message,
            event: EventStamp {
                time: DateTime::from(time),
                id: ByteString::from(id),
            },
        },
        events: ids(saved.events),
        unacknowledged: ids(saved.unacknowledged),
    })
}

fn bytes(id: &ByteString) -> Vec<u8> {
    id.value.clone().unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::super::condition::{Action, SourceReport};
    use super::*;

    fn stamp(number: u8) -> EventStamp {
        EventStamp {
            time: DateTime::from(i64::from(number)),
            id: ByteString::from(vec![number]),
        }
    }

    #[test]
    fn a_condition_goes_on_as_it_was_stored() {
        let mut condition = AlarmCondition::new(true, 500, stamp(1));
        let report = SourceReport {
            levels: Levels::HIGH,
            severity: 700,
            message: "hot".to_owned(),
            quality: StatusCode::Good,
        };
        condition.report(report, stamp(2));
        let action = Action {
            user: "anna".to_owned(),
            comment: LocalizedText::new("en", "on my way"),
        };
        let id = stamp(2).id;
        condition.acknowledge(&id, action, stamp(3)).unwrap();
        let stored = encoded(&condition, "the alarm");
        let mut restored = AlarmCondition::new(true, 500, stamp(9));
        restored.restore(decoded(&stored, "the alarm").unwrap());
        assert_eq!(restored.state(), condition.state());
        // The last event can still be confirmed.
        let id = condition.state().event.id.clone();
        let action = Action {
            user: "bert".to_owned(),
            comment: LocalizedText::null(),
        };
        restored.confirm(&id, action, stamp(10)).unwrap();
    }

    #[test]
    fn conditions_of_other_alarms_and_damaged_bytes_are_left_out() {
        let stored = encoded(&AlarmCondition::new(false, 500, stamp(1)), "high: 70");
        assert!(decoded(&stored, "high: 80").is_none());
        assert!(decoded(&stored[1..], "high: 70").is_none());
    }
}
