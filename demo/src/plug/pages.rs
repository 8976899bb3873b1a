//! Reads facts about components from the status pages of the programs, and detects changes.

use std::collections::{BTreeMap, BTreeSet};

use serde::Deserialize;
use serde_json::Value;

use super::STATE;
use super::fact::{Fact, MesRun, PlugComponent, VisibilityLevel};

/// A fact and its time, in nanoseconds since 1970.
pub(crate) type Dated = (i64, Fact);

/// The kind of a status page.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum StatusPageKind {
    Lds,
    Mes,
    Server,
    /// A page of a bridge, which only shows whether the bridge is ready.
    Bridge,
}

/// The last state of a status page.
#[derive(Debug)]
pub(crate) struct StatusPageReader {
    program: &'static str,
    page: StatusPageKind,
    ready: bool,
    there: BTreeSet<(PlugComponent, VisibilityLevel)>,
    runs: BTreeMap<usize, MesRun>,
}

#[derive(Debug, Default, Deserialize)]
#[serde(default)]
struct LdsPage {
    servers: Vec<Registered>,
    network: Vec<Announced>,
}

#[derive(Debug, Deserialize)]
struct Registered {
    uri: String,
    since_ms: u64,
}

#[derive(Debug, Deserialize)]
struct Announced {
    name: String,
    since_ms: u64,
}

#[derive(Debug, Default, Deserialize)]
#[serde(default)]
struct MesPage {
    components: Vec<Component>,
    runs: Vec<MesRun>,
}

#[derive(Debug, Deserialize)]
struct Component {
    application_uri: String,
    since_ms: u64,
    #[serde(default)]
    listed_ms: Option<u64>,
}

#[derive(Debug, Default, Deserialize)]
#[serde(default)]
struct ServerPage {
    topics: BTreeMap<String, Topic>,
}

#[derive(Debug, Default, Deserialize)]
#[serde(default)]
struct Topic {
    delivered: u64,
}

impl StatusPageReader {
    pub(crate) const fn new(program: &'static str, page: StatusPageKind) -> Self {
        Self {
            program,
            page,
            ready: false,
            there: BTreeSet::new(),
            runs: BTreeMap::new(),
        }
    }

    /// Returns whether the page provides no further facts.
    pub(crate) fn is_done(&self) -> bool {
        self.page == StatusPageKind::Bridge && self.ready
    }

    /// Returns the changes of the page at `now_ns`.
    pub(crate) fn read(&mut self, now_ns: i64, page: &Value) -> Vec<Dated> {
        let mut facts = Vec::new();
        // A bridge with several spaces has an object for each.
        let objects = page
            .as_array()
            .map_or_else(|| std::slice::from_ref(page), Vec::as_slice);
        let is_ready = objects.iter().all(|object| {
            let reasons = object.get("not_ready").and_then(Value::as_array);
            reasons.is_none_or(Vec::is_empty)
        });
        if is_ready && !self.ready {
            self.ready = true;
            facts.push((now_ns, Fact::Ready(self.program)));
        }
        match self.page {
            StatusPageKind::Lds => self.read_lds(now_ns, &part(page), &mut facts),
            StatusPageKind::Mes => self.read_mes(now_ns, part(page), &mut facts),
            StatusPageKind::Server => self.read_server(now_ns, &part(page), &mut facts),
            StatusPageKind::Bridge => {}
        }
        facts
    }

    fn read_lds(&mut self, now_ns: i64, page: &LdsPage, facts: &mut Vec<Dated>) {
        let registered = page
            .servers
            .iter()
            .filter_map(|server| Some((PlugComponent::of_uri(&server.uri)?, server.since_ms)));
        self.tell(now_ns, VisibilityLevel::Registered, registered, facts);
        // The mDNS name is the name of the server with a suffix that makes it unique.
        let announced = page.network.iter().filter_map(|record| {
            let part = PlugComponent::ALL.into_iter().find(|part| {
                let rest = record.name.strip_prefix(part.name());
                rest.is_some_and(|rest| rest.is_empty() || rest.starts_with('-'))
            })?;
            Some((part, record.since_ms))
        });
        self.tell(now_ns, VisibilityLevel::Announced, announced, facts);
    }

    fn read_mes(&mut self, now_ns: i64, page: MesPage, facts: &mut Vec<Dated>) {
        let of = |component: &Component| PlugComponent::of_uri(&component.application_uri);
        let listed = page.components.iter().filter_map(|component| {
            Some((
                of(component)?,
                component.listed_ms.unwrap_or(component.since_ms),
            ))
        });
        self.tell(now_ns, VisibilityLevel::Listed, listed, facts);
        let known = page
            .components
            .iter()
            .filter_map(|component| Some((of(component)?, component.since_ms)));
        self.tell(now_ns, VisibilityLevel::InGraph, known, facts);
        for (number, run) in page.runs.into_iter().enumerate() {
            if self.runs.get(&number) != Some(&run) {
                facts.push((now_ns, Fact::Run(number, run.clone())));
                self.runs.insert(number, run);
            }
        }
    }

    fn read_server(&mut self, now_ns: i64, page: &ServerPage, facts: &mut Vec<Dated>) {
        for part in PlugComponent::ALL {
            let topic = format!("ua_0_{}_{STATE}", part.namespace());
            let has_value = page
                .topics
                .get(&topic)
                .is_some_and(|topic| topic.delivered > 0);
            if has_value && self.there.insert((part, VisibilityLevel::AtServer)) {
                facts.push((now_ns, Fact::Reached(part, VisibilityLevel::AtServer)));
            }
        }
    }

    fn tell(
        &mut self,
        now_ns: i64,
        level: VisibilityLevel,
        there: impl Iterator<Item = (PlugComponent, u64)>,
        facts: &mut Vec<Dated>,
    ) {
        let there: BTreeMap<PlugComponent, u64> = there.collect();
        for (part, since_ms) in &there {
            if self.there.insert((*part, level)) {
                facts.push((nanos(*since_ms), Fact::Reached(*part, level)));
            }
        }
        for part in PlugComponent::ALL {
            if !there.contains_key(&part) && self.there.remove(&(part, level)) {
                facts.push((now_ns, Fact::Left(part, level)));
            }
        }
    }
}

/// Reads a page; returns the default if its format is unexpected.
fn part<T: Default + for<'de> Deserialize<'de>>(page: &Value) -> T {
    T::deserialize(page).unwrap_or_else(|error| {
        tracing::debug!(%error, "a page was not understood");
        T::default()
    })
}

pub(crate) fn nanos(ms: u64) -> i64 {
    i64::try_from(ms)
        .unwrap_or(i64::MAX)
        .saturating_mul(1_000_000)
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn a_component_comes_once_and_goes_once() {
        let mut lds = StatusPageReader::new("ua-lds", StatusPageKind::Lds);
        let page = json!({
            "program": "ua-lds", "not_ready": [], "since_ms": 1,
            "servers": [{"uri": "urn:example:gripper", "name": "parallel-gripper", "urls": [], "since_ms": 5}],
            "network": [{"record_id": 1, "name": "parallel-gripper-host-4711", "url": "", "since_ms": 4}],
        });
        let gripper = PlugComponent::Gripper;
        assert_eq!(
            lds.read(9, &page),
            [
                (9, Fact::Ready("ua-lds")),
                (
                    5_000_000,
                    Fact::Reached(gripper, VisibilityLevel::Registered)
                ),
                (
                    4_000_000,
                    Fact::Reached(gripper, VisibilityLevel::Announced)
                ),
            ]
        );
        assert_eq!(lds.read(10, &page), []);
        let gone = json!({"not_ready": [], "servers": [], "network": []});
        assert_eq!(
            lds.read(11, &gone),
            [
                (11, Fact::Left(gripper, VisibilityLevel::Registered)),
                (11, Fact::Left(gripper, VisibilityLevel::Announced)),
            ]
        );
        assert_eq!(lds.read(12, &gone), []);
    }

    #[test]
    fn names_that_only_begin_alike_are_others() {
        let mut lds = StatusPageReader::new("ua-lds", StatusPageKind::Lds);
        let page = json!({"network": [{"name": "robotics-host-1", "since_ms": 4}]});
        assert_eq!(lds.read(9, &page), [(9, Fact::Ready("ua-lds"))]);
    }

    #[test]
    fn a_program_that_says_why_it_is_not_ready_is_not() {
        let mut bridge = StatusPageReader::new("bridge-ros2", StatusPageKind::Bridge);
        let page = |why: &[&str]| json!([{"not_ready": []}, {"not_ready": why}]);
        assert_eq!(bridge.read(1, &page(&["no master"])), []);
        assert!(!bridge.is_done());
        assert_eq!(
            bridge.read(2, &page(&[])),
            [(2, Fact::Ready("bridge-ros2"))]
        );
        assert!(bridge.is_done());
    }

    #[test]
    fn a_run_is_told_when_it_changes() {
        let mut mes = StatusPageReader::new("ua-mes", StatusPageKind::Mes);
        let page = |outcome: &str| {
            json!({
                "components": [{"application_uri": "urn:example:robot", "name": "robot", "skills": 2, "since_ms": 8, "listed_ms": 7}],
                "runs": [{"run": "urn:run:1", "process": "urn:p", "started_ms": 9, "ended_ms": null, "outcome": outcome,
                    "plans": [{"number": 1, "retreated": null, "ran": [{"step": "Grasp", "component": "urn:example:gripper"}]}]}],
            })
        };
        let facts = mes.read(1, &page("running"));
        assert!(facts.contains(&(
            7_000_000,
            Fact::Reached(PlugComponent::Robot, VisibilityLevel::Listed)
        )));
        assert!(facts.contains(&(
            8_000_000,
            Fact::Reached(PlugComponent::Robot, VisibilityLevel::InGraph)
        )));
        let run = facts.iter().find_map(|(_, fact)| {
            if let Fact::Run(0, run) = fact {
                Some(run)
            } else {
                None
            }
        });
        assert_eq!(run.unwrap().plans[0].ran[0].step, "Grasp");
        assert_eq!(mes.read(2, &page("running")), []);
        assert!(matches!(
            mes.read(3, &page("done")).as_slice(),
            [(3, Fact::Run(0, _))]
        ));
    }

    #[test]
    fn the_server_has_seen_a_component_when_it_has_a_value_of_it() {
        let mut server = StatusPageReader::new("ua-server", StatusPageKind::Server);
        let page =
            |delivered: u64| json!({"topics": {"ua_0_8_101": {"delivered": delivered, "sent": 0}}});
        assert_eq!(server.read(1, &page(0)), [(1, Fact::Ready("ua-server"))]);
        assert_eq!(
            server.read(2, &page(1)),
            [(
                2,
                Fact::Reached(PlugComponent::Vacuum, VisibilityLevel::AtServer)
            )]
        );
    }
}
