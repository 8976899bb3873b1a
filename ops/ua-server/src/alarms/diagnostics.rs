//! Conditions from `diagnostic_msgs/DiagnosticArray`: each status is a condition of its own, by
//! its hardware id and name.

use std::collections::HashMap;
use std::sync::Arc;

use mappings::{Alarm, TopicId, Variable};
use opcua::types::{NodeId, StatusCode};
use tracing::warn;
use uadp::{ExtensionBody, Scalar};

use super::condition::{Levels, SourceReport};
use super::event::{ConditionIdentity, ConditionType};
use super::{Entry, Inner, Place, stamp};
use crate::layout::node_id;
use crate::values::ShownValue;

/// A variable with a DiagnosticArray.
#[derive(Debug, Clone)]
pub(super) struct Origin {
    topic: TopicId,
    node: NodeId,
    /// The index of `status` among the fields.
    at: usize,
    severity: u16,
    confirms: bool,
}

impl Origin {
    pub(super) fn of(variable: &Variable, alarm: &Alarm) -> Self {
        let at = variable
            .fields
            .iter()
            .position(|leaf| leaf.path == "status");
        Self {
            topic: variable.topic,
            node: node_id(&variable.node),
            at: at.unwrap_or(usize::MAX),
            severity: alarm.severity,
            confirms: alarm.confirm,
        }
    }

    /// Returns true if a condition is of this variable.
    pub(super) fn has(&self, identity: &ConditionIdentity) -> bool {
        identity.kind == ConditionType::SystemDiagnostic
            && identity.source == self.node
            && identity.confirms == self.confirms
    }

    fn identity(&self, status: &Status<'_>) -> ConditionIdentity {
        let Status { name, hardware, .. } = status;
        let (source_name, shown) = match *hardware {
            "" => (*name, (*name).to_owned()),
            hardware => (hardware, format!("{hardware}: {name}")),
        };
        // The first slash ends the hardware id.
        let part = hardware.replace('%', "%25").replace('/', "%2F");
        ConditionIdentity {
            node: NodeId::new(1, format!("{}.alarm/{part}/{name}", self.topic)),
            kind: ConditionType::SystemDiagnostic,
            source: self.node.clone(),
            source_name: source_name.to_owned(),
            name: shown,
            input: self.node.clone(),
            limits: [None; 4],
            normal: NodeId::null(),
            confirms: self.confirms,
            delay: std::time::Duration::ZERO,
        }
    }
}

/// The last level and message of each status.
#[derive(Debug, Default)]
pub(super) struct StatusLevels {
    last: HashMap<NodeId, (u8, String)>,
    /// Number of statuses without a condition.
    refused: u64,
}

impl StatusLevels {
    /// Keeps the statuses of these conditions only.
    pub(super) fn retain(&mut self, is_kept: impl Fn(&NodeId) -> bool) {
        self.last.retain(|node, _| is_kept(node));
    }
}

/// A `diagnostic_msgs/DiagnosticStatus`.
#[derive(Debug, PartialEq, Eq)]
struct Status<'a> {
    level: u8,
    name: &'a str,
    message: &'a str,
    hardware: &'a str,
    values: Vec<(&'a str, &'a str)>,
}

impl Status<'_> {
    fn levels(&self) -> Levels {
        match self.level {
            OK => Levels::NONE,
            WARN | STALE => Levels::HIGH,
            // ERROR, and levels that the message type does not have.
            _ => Levels::HIGH_HIGH,
        }
    }

    /// Returns the severity: warnings half of the configured severity, stale statuses this
    /// severity, errors halfway between it and 1000.
    fn severity(&self, configured: u16) -> u16 {
        match self.level {
            OK | STALE => configured,
            WARN => (configured / 2).max(1),
            _ => configured.midpoint(1000),
        }
    }

    fn text(&self) -> String {
        let level = match self.level {
            OK => "OK",
            WARN => "warning",
            ERROR => "error",
            STALE => "stale",
            _ => "unknown level",
        };
        let mut text = format!("{level}: {}", self.message);
        for (key, value) in &self.values {
            if text.len() + key.len() + value.len() > LONGEST_TEXT {
                break;
            }
            text.push_str(&format!("; {key}: {value}"));
        }
        text
    }
}

impl Inner {
    /// Applies a DiagnosticArray. Returns the new conditions and the displaced conditions.
    pub(super) fn diagnosed(
        &mut self,
        origin: &Origin,
        shown: &ShownValue,
        place: &Place,
    ) -> (Vec<Arc<ConditionIdentity>>, Vec<Arc<ConditionIdentity>>) {
        let (mut new, mut gone) = (Vec::new(), Vec::new());
        let quality = shown.stamp.status;
        let field = shown
            .fields()
            .and_then(|mut fields| fields.nth(origin.at)?.ok());
        let array = match field {
            Some(uadp::Variant::Array(array)) if !quality.is_bad() => array,
            Some(_) | None => {
                self.qualify(origin, quality, place);
                return (new, gone);
            }
        };
        if !quality.is_good() {
            self.qualify(origin, quality, place);
        }
        for element in array.iter().take(MOST_STATUSES) {
            let Scalar::ExtensionObject(object) = element else {
                continue;
            };
            let ExtensionBody::Binary(body) = object.body else {
                continue;
            };
            let Some(status) = decode(body) else {
                self.refuse("it cannot be decoded");
                continue;
            };
            if status.name.len() + status.hardware.len() > LONGEST_NAME {
                self.refuse("its name and hardware_id are longer than 512 bytes");
                continue;
            }
            let identity = origin.identity(&status);
            let node = identity.node.clone();
            if !self.conditions.contains_key(&node) {
                if self.diagnostics.last.len() >= MOST_STATUSES {
                    match self.oldest_done() {
                        Some(entry) => {
                            // A status of the same array may give way.
                            new.retain(|one: &Arc<ConditionIdentity>| {
                                one.node != entry.identity.node
                            });
                            gone.push(entry.identity);
                        }
                        None => {
                            self.refuse("1000 other statuses need attention");
                            continue;
                        }
                    }
                }
                let entry = Entry {
                    is_public: place.space.inner().is_public(&origin.node),
                    ..Entry::new(identity, origin.severity)
                };
                new.push(Arc::clone(&entry.identity));
                self.conditions.insert(node.clone(), entry);
            }
            let said = (status.level, status.message.to_owned());
            let is_new = self.diagnostics.last.get(&node) != Some(&said);
            self.diagnostics.last.insert(node.clone(), said);
            let Some(entry) = self.conditions.get_mut(&node) else {
                continue;
            };
            let message = match (is_new, entry.is_public) {
                (true, true) => status.text(),
                (true, false) => entry.message(status.levels(), None),
                // The values of a status change all the time.
                (false, _) => entry.condition.state().message.clone(),
            };
            let report = SourceReport {
                levels: status.levels(),
                severity: status.severity(origin.severity),
                message,
                quality,
            };
            let effect = entry.condition.report(report, stamp());
            place.show(entry, effect);
        }
        (new, gone)
    }

    /// Shows the status of the value in all conditions of a variable.
    fn qualify(&mut self, origin: &Origin, quality: StatusCode, place: &Place) {
        let all = self.conditions.values_mut();
        for entry in all.filter(|entry| origin.has(&entry.identity)) {
            let state = entry.condition.state();
            let report = SourceReport {
                levels: state.levels,
                severity: state.severity,
                message: state.message.clone(),
                quality,
            };
            let effect = entry.condition.report(report, stamp());
            place.show(entry, effect);
        }
    }

    /// Removes the condition of the status that is done for the longest time.
    fn oldest_done(&mut self) -> Option<Entry> {
        let done = self.diagnostics.last.keys().filter_map(|node| {
            let state = self.conditions.get(node)?.condition.state();
            (!state.retain()).then_some((state.event.time, node))
        });
        let (_, node) = done.min_by_key(|(time, _)| *time)?;
        let node = node.clone();
        self.diagnostics.last.remove(&node);
        self.conditions.remove(&node)
    }

    /// Counts a status without a condition. It is logged at the 1st, 10th, 100th ... time.
    fn refuse(&mut self, why: &'static str) {
        self.diagnostics.refused += 1;
        let total = self.diagnostics.refused;
        if 10_u64.pow(total.ilog10()) == total {
            warn!(
                total,
                why, "cannot show a status of a DiagnosticArray as a condition"
            );
        }
    }
}

/// Returns the beginning of a text, at most [`LONGEST_TEXT`] bytes.
fn begin_of(text: &str) -> &str {
    let mut ends = (0..=LONGEST_TEXT.min(text.len())).rev();
    let end = ends.find(|end| text.is_char_boundary(*end));
    text.get(..end.unwrap_or_default()).unwrap_or_default()
}

/// Decodes a DiagnosticStatus (OPC 10000-6, 5.2.6). Returns `None` for a malformed status.
fn decode(body: &[u8]) -> Option<Status<'_>> {
    let mut rest = body;
    let (level, after) = rest.split_first()?;
    rest = after;
    let name = text(&mut rest)?;
    let message = begin_of(text(&mut rest)?);
    let hardware = text(&mut rest)?;
    let count = length(&mut rest)?;
    let mut values = Vec::new();
    for _ in 0..count {
        let key = text(&mut rest)?;
        values.push((key, text(&mut rest)?));
    }
    Some(Status {
        level: *level,
        name,
        message,
        hardware,
        values,
    })
}

/// Returns the level, the name and the hardware id of an encoded status.
#[cfg(test)]
pub(super) fn summary(body: &[u8]) -> Option<(u8, &str, &str)> {
    decode(body).map(|status| (status.level, status.name, status.hardware))
}

/// Reads a length; null is 0.
fn length(rest: &mut &[u8]) -> Option<usize> {
    let (bytes, after) = rest.split_first_chunk::<4>()?;
    *rest = after;
    let length = i32::from_le_bytes(*bytes);
    usize::try_from(length.max(0)).ok()
}

fn text<'a>(rest: &mut &'a [u8]) -> Option<&'a str> {
    let length = length(rest)?;
    let (bytes, after) = rest.split_at_checked(length)?;
    *rest = after;
    std::str::from_utf8(bytes).ok()
}

const OK: u8 = 0;
const WARN: u8 = 1;
const ERROR: u8 = 2;
const STALE: u8 = 3;
/// Largest number of statuses with a condition.
const MOST_STATUSES: usize = 1_000;
/// Largest name and hardware id together, in bytes.
const LONGEST_NAME: usize = 512;
/// Largest message of a condition, in bytes.
const LONGEST_TEXT: usize = 1_000;

#[cfg(test)]
mod tests {
    use super::*;

    fn put(body: &mut Vec<u8>, text: &str) {
        body.extend(i32::try_from(text.len()).unwrap().to_le_bytes());
        body.extend(text.as_bytes());
    }

    fn body() -> Vec<u8> {
        let mut body = vec![ERROR];
        for text in ["motor 3", "over temperature", "arm-7"] {
            put(&mut body, text);
        }
        body.extend(1_i32.to_le_bytes());
        put(&mut body, "temperature");
        put(&mut body, "91");
        body
    }

    #[test]
    fn a_status_is_decoded_and_each_shorter_body_is_refused() {
        let body = body();
        let status = decode(&body).unwrap();
        assert_eq!((status.name, status.hardware), ("motor 3", "arm-7"));
        assert_eq!(status.text(), "error: over temperature; temperature: 91");
        assert_eq!(status.levels(), Levels::HIGH_HIGH);
        assert_eq!(status.severity(500), 750);
        for end in 0..body.len() {
            assert_eq!(decode(&body[..end]), None, "{end} bytes");
        }
        let mut many = vec![OK];
        for _ in 0..3 {
            many.extend((-1_i32).to_le_bytes());
        }
        many.extend(i32::MAX.to_le_bytes());
        assert_eq!(decode(&many), None, "a count without its values");
    }
}
