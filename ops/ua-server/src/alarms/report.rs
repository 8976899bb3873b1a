//! Conditions as diagnostics of ROS: a `diagnostic_msgs/DiagnosticArray` with a status for each
//! condition. Times are inputs.

use std::time::{Duration, Instant};

use bytes::Bytes;
use mappings::{Mapping, TopicId};
use opcua::types::StatusCode;
use uadp::Timestamp;

use super::condition::AlarmConditionState;
use super::event::{ConditionIdentity, ConditionType};
use super::page;

/// A variable with the conditions of the server.
#[derive(Debug, PartialEq)]
struct Target {
    topic: TopicId,
    /// The fields of the message.
    paths: Vec<String>,
}

/// The variables with the conditions of the server, and the time of their next value.
#[derive(Debug, Default)]
pub(super) struct ConditionReports {
    targets: Vec<Target>,
    last: Option<Instant>,
    due: Option<Instant>,
}

impl ConditionReports {
    /// Switches to the variables of a mapping.
    pub(super) fn follow(&mut self, mapping: &Mapping, now: Instant) {
        let variables = mapping.variables().iter();
        let targets = variables.filter(|variable| variable.reports_alarms);
        let targets = targets.map(|variable| Target {
            topic: variable.topic,
            paths: variable
                .fields
                .iter()
                .map(|leaf| leaf.path.clone())
                .collect(),
        });
        self.targets = targets.collect();
        self.due = (!self.targets.is_empty()).then_some(now);
    }

    /// Returns the time of the next values.
    pub(super) const fn due(&self) -> Option<Instant> {
        self.due
    }

    /// Notes that a condition has changed. Returns true if the next values are due earlier.
    pub(super) fn changed(&mut self, now: Instant) -> bool {
        let Some(due) = self.due else { return false };
        let soon = self.last.and_then(|last| last.checked_add(SHORTEST));
        let soon = soon.map_or(now, |soon| soon.max(now));
        self.due = Some(soon.min(due));
        soon < due
    }

    /// Returns the values if they are due.
    pub(super) fn take<'a>(
        &mut self,
        conditions: impl Iterator<Item = (&'a ConditionIdentity, &'a AlarmConditionState)>,
        (now, time): (Instant, Timestamp),
    ) -> Vec<(TopicId, Bytes)> {
        if self.due.is_none_or(|due| due > now) {
            return Vec::new();
        }
        self.last = Some(now);
        self.due = now.checked_add(PERIOD);
        let mut conditions: Vec<(&ConditionIdentity, &AlarmConditionState)> = conditions
            .filter(|(identity, state)| {
                // A robot reports its own diagnostics.
                identity.kind != ConditionType::SystemDiagnostic && state.enabled.on
            })
            .collect();
        // The most important conditions, if there are too many.
        conditions.sort_by(|(one, state), (other, of_other)| {
            let key =
                |state: &AlarmConditionState| (!state.retain(), std::cmp::Reverse(state.severity));
            let order = key(state).cmp(&key(of_other));
            order.then_with(|| one.name.cmp(&other.name))
        });
        conditions.truncate(MOST_STATUSES);
        let targets = self.targets.iter();
        let values = targets.map(|target| (target.topic, target.block(&conditions, time)));
        values.collect()
    }
}

impl Target {
    /// Encodes the fields of the message as a key frame carries them.
    fn block(
        &self,
        conditions: &[(&ConditionIdentity, &AlarmConditionState)],
        time: Timestamp,
    ) -> Bytes {
        let mut block = Vec::new();
        let count = u16::try_from(self.paths.len()).unwrap_or(u16::MAX);
        block.extend(count.to_le_bytes());
        for path in &self.paths {
            match path.as_str() {
                "header.stamp" => {
                    block.push(DATE_TIME);
                    block.extend(time.time.0.to_le_bytes());
                }
                "status" => {
                    block.push(EXTENSION_OBJECT | ARRAY);
                    put_length(&mut block, conditions.len());
                    for (identity, state) in conditions {
                        put_status(&mut block, self.topic, identity, state);
                    }
                }
                // The frame_id.
                _ => {
                    block.push(STRING);
                    put(&mut block, "");
                }
            }
        }
        Bytes::from(block)
    }
}

/// Returns the level of a condition: stale while its value is bad.
fn level(state: &AlarmConditionState) -> u8 {
    if state.quality.0.is_bad() && state.quality.0 != StatusCode::BadWaitingForInitialData {
        return 3;
    }
    match (state.active.on, state.severity) {
        (false, _) => 0,
        (true, ..=ERROR_ABOVE) => 1,
        (true, _) => 2,
    }
}

fn put_status(
    block: &mut Vec<u8>,
    topic: TopicId,
    identity: &ConditionIdentity,
    state: &AlarmConditionState,
) {
    // The TypeId is the name of the message in the namespace of the topic.
    block.push(STRING_NODE_ID);
    block.extend(topic.namespace.get().to_le_bytes());
    put(block, "diagnostic_msgs/DiagnosticStatus");
    block.push(BINARY_BODY);
    let mut body = vec![level(state)];
    put(&mut body, &identity.name);
    let message = match (state.active.on, state.acked.on) {
        (false, false) => format!("{} (not acknowledged)", state.message),
        (_, _) => state.message.clone(),
    };
    put(&mut body, &message);
    put(&mut body, &identity.source_name);
    let values = [
        ("severity", state.severity.to_string()),
        ("acknowledged", state.acked.on.to_string()),
        ("condition", identity.node.to_string()),
        ("event_id", page::hexadecimal(&state.event.id)),
    ];
    put_length(&mut body, values.len());
    for (key, value) in values {
        put(&mut body, key);
        put(&mut body, &value);
    }
    put_length(block, body.len());
    block.extend(body);
}

fn put(block: &mut Vec<u8>, text: &str) {
    put_length(block, text.len());
    block.extend(text.as_bytes());
}

fn put_length(block: &mut Vec<u8>, length: usize) {
    let length = i32::try_from(length).unwrap_or(i32::MAX);
    block.extend(length.to_le_bytes());
}

/// The time between two values without changes.
const PERIOD: Duration = Duration::from_secs(1);
/// The shortest time between two values.
const SHORTEST: Duration = Duration::from_millis(200);
/// Largest number of statuses in a value.
const MOST_STATUSES: usize = 500;
/// Alarms of a higher severity are errors, others are warnings.
const ERROR_ABOVE: u16 = 600;
/// Encoding bytes of Variants, NodeIds and ExtensionObjects (OPC 10000-6, 5.2.2).
const STRING: u8 = 12;
const DATE_TIME: u8 = 13;
const EXTENSION_OBJECT: u8 = 22;
const ARRAY: u8 = 0x80;
const STRING_NODE_ID: u8 = 3;
const BINARY_BODY: u8 = 1;

#[cfg(test)]
mod tests {
    use opcua::types::{ByteString, DateTime, NodeId};
    use uadp::{ExtensionBody, Fields, Scalar};

    use super::super::condition::{AlarmCondition, EventStamp, Levels, SourceReport};
    use super::super::diagnostics;
    use super::*;

    fn identity(name: &str, kind: ConditionType) -> ConditionIdentity {
        ConditionIdentity {
            node: NodeId::new(1, "ua_0_2_30.alarm"),
            kind,
            source: NodeId::new(2, 30),
            source_name: "line".to_owned(),
            name: name.to_owned(),
            input: NodeId::null(),
            limits: [None; 4],
            normal: NodeId::null(),
            confirms: false,
            delay: Duration::ZERO,
        }
    }

    fn condition(levels: Levels, severity: u16) -> AlarmCondition {
        let stamp = EventStamp {
            time: DateTime::from(1_000),
            id: ByteString::from(vec![1]),
        };
        let mut condition = AlarmCondition::new(false, 500, stamp.clone());
        let report = SourceReport {
            levels,
            severity,
            message: "beyond".to_owned(),
            quality: StatusCode::Good,
        };
        condition.report(report, stamp);
        condition
    }

    fn reports(now: Instant) -> ConditionReports {
        let paths = ["header.stamp", "header.frame_id", "status"];
        ConditionReports {
            targets: vec![Target {
                topic: TopicId::new(0, 2, 90).unwrap(),
                paths: paths.map(str::to_owned).to_vec(),
            }],
            last: None,
            due: Some(now),
        }
    }

    #[test]
    fn each_condition_but_the_diagnostics_of_robots_is_a_status() {
        let now = bridge_node::now();
        let (fine, hot) = (
            condition(Levels::NONE, 500),
            condition(Levels::HIGH_HIGH, 750),
        );
        let warm = condition(Levels::HIGH, 500);
        let all = [
            (identity("fine", ConditionType::OffNormal), &fine),
            (identity("hot", ConditionType::ExclusiveLevel), &hot),
            (identity("motor", ConditionType::SystemDiagnostic), &hot),
            (identity("warm", ConditionType::ExclusiveLevel), &warm),
        ];
        let conditions = all.iter().map(|(identity, one)| (identity, one.state()));
        let mut reports = reports(now.monotonic);
        let mut values = reports.take(conditions, (now.monotonic, now.utc));
        let (topic, block) = values.pop().unwrap();
        assert_eq!(topic.to_string(), "ua_0_2_90");
        let fields: Vec<_> = Fields::parse(&block).unwrap().map(Result::unwrap).collect();
        assert_eq!(fields.len(), 3);
        let uadp::Variant::Array(array) = fields[2] else {
            panic!("{:?}", fields[2])
        };
        let statuses = array.iter().map(|element| {
            let Scalar::ExtensionObject(object) = element else {
                panic!("{element:?}")
            };
            let ExtensionBody::Binary(body) = object.body else {
                panic!("{object:?}")
            };
            diagnostics::summary(body).unwrap()
        });
        let found: Vec<(u8, &str, &str)> = statuses.collect();
        assert_eq!(
            found,
            [(2, "hot", "line"), (1, "warm", "line"), (0, "fine", "line")]
        );
    }

    #[test]
    fn a_report_comes_once_a_second_and_soon_after_a_change() {
        let now = bridge_node::now();
        let at = |milliseconds| now.monotonic + Duration::from_millis(milliseconds);
        let mut reports = reports(at(0));
        let take = |reports: &mut ConditionReports, milliseconds| {
            let none = std::iter::empty();
            reports.take(none, (at(milliseconds), now.utc)).len()
        };
        assert_eq!(take(&mut reports, 0), 1);
        assert_eq!(take(&mut reports, 999), 0);
        assert_eq!(take(&mut reports, 1_000), 1);
        assert!(reports.changed(at(1_050)));
        assert_eq!(
            reports.due(),
            Some(at(1_200)),
            "not more often than five times a second"
        );
        assert!(!reports.changed(at(1_100)));
        assert_eq!(take(&mut reports, 1_200), 1);
        assert_eq!(reports.due(), Some(at(2_200)));
    }
}
