//! The status of a program: counters per topic and delays per hop, as JSON and for Prometheus.

mod carriers;
mod names;
mod redundancy;

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;
use std::time::Duration;

use bridge_core::{CallCounters, Counters, Delays, Hop, Reason, Router};
use mappings::{SpaceId, TopicId, Variable};
use serde::Serialize;
use service::PageState;
use uadp::Timestamp;

use self::carriers::CarrierStatus;
pub(crate) use self::names::AnnouncedNames;
pub(crate) use self::redundancy::RedundancyStatus;
use crate::mapping_file::About;
use crate::port::LinkState;

/// A snapshot of a program's counters and delays.
#[derive(Debug, Clone, Serialize)]
pub(crate) struct StatusSnapshot {
    program: &'static str,
    /// The version, with the commit of a packaged build.
    version: &'static str,
    /// Seconds since the start of the program.
    uptime_s: u64,
    /// The time of this status by the clock of the host, in microseconds since 1970.
    time_us: u64,
    #[serde(skip_serializing_if = "Option::is_none")]
    library: Option<&'static str>,
    space: u8,
    #[serde(flatten)]
    readiness: Readiness,
    mapping: MappingStatus,
    /// The secured groups by SecurityGroupId.
    groups: BTreeMap<String, GroupStatus>,
    topics: BTreeMap<String, TopicStatus>,
    /// Names of topics without a value so far, of the mapping and of other programs.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    topics_without_values: BTreeMap<String, TopicNames>,
    /// Calls that are known, requested or executed here.
    calls: BTreeMap<String, CallStatus>,
    /// Topics and calls whose announced names are left out of the figures for Prometheus.
    #[serde(skip)]
    names_left_out: BTreeSet<String>,
    /// The number of names that were left out.
    names_left_out_total: u64,
    /// Other servers to which the program is a client.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    servers: Vec<LinkState>,
    /// The application's own OPC UA certificate.
    #[serde(skip_serializing_if = "Option::is_none")]
    certificate: Option<serde_json::Value>,
    /// Goals and runs that are being cancelled, until their end is known.
    cancellations_pending: Vec<String>,
    /// Other applications of the group, as they describe themselves.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    applications: Vec<ApplicationStatus>,
    /// The MQTT broker; `None` with UDP.
    #[serde(skip_serializing_if = "Option::is_none")]
    broker: Option<BrokerStatus>,
    /// The carriers in the order of the mapping.
    carriers: Vec<CarrierStatus>,
    /// The role among the redundant bridges of the space; `None` without redundancy.
    #[serde(skip_serializing_if = "Option::is_none")]
    redundancy: Option<RedundancyStatus>,
    /// Datagrams and messages without a topic.
    others: TopicStatus,
    hops: BTreeMap<&'static str, HopStatus>,
}

/// The readiness of the program.
#[derive(Debug, Clone, Serialize)]
pub(crate) struct Readiness {
    /// The reasons why the program is not ready, as text for the user; empty if it is ready.
    pub(crate) not_ready: Vec<String>,
    /// The peers that are missing, each with the reason. The program works without them.
    pub(crate) waiting_for: Vec<String>,
    pub(crate) interfaces: Interfaces,
}

/// For each side, 1 if its network interfaces are present, else 0.
#[derive(Debug, Clone, Copy, Serialize)]
pub(crate) struct Interfaces {
    pub(crate) pubsub: u8,
    /// `None` if the side uses no particular interface.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) local: Option<u8>,
}

#[derive(Debug, Clone, Serialize)]
struct ApplicationStatus {
    space: u8,
    from: String,
    uri: String,
    name: String,
    urls: Vec<String>,
    capabilities: Vec<String>,
}

#[derive(Debug, Clone, Serialize)]
struct BrokerStatus {
    address: String,
    /// Messages that were not passed on, by reason.
    dropped: BTreeMap<&'static str, u64>,
}

#[derive(Debug, Clone, Serialize)]
struct MappingStatus {
    #[serde(flatten)]
    about: About,
    /// Keys of the mapping that take effect only after a restart.
    restart_needed: Vec<String>,
}

#[derive(Debug, Clone, Serialize)]
struct GroupStatus {
    mode: &'static str,
    /// The SecurityTokenId of the key in use.
    token: Option<u32>,
    /// The SecurityTokenId of the next key.
    next_token: Option<u32>,
    /// Whether the next key should be present already.
    overdue: bool,
}

#[derive(Debug, Clone, Serialize)]
struct TopicStatus {
    #[serde(flatten)]
    names: TopicNames,
    sent: u64,
    delivered: u64,
    repeated: u64,
    announced: u64,
    described: u64,
    keep_alives: u64,
    missing: u64,
    sender_changed: u64,
    /// Values that came later than the deadline of the mapping.
    deadline_missed: u64,
    /// Own datagrams that the group looped back, and values that the local side received from
    /// itself. They are not drops.
    looped: u64,
    dropped: BTreeMap<&'static str, u64>,
}

/// The names that people gave a topic.
#[derive(Debug, Clone, Default, Serialize)]
struct TopicNames {
    /// The name in the mapping, or the name that its writer announced.
    #[serde(skip_serializing_if = "Option::is_none")]
    name: Option<String>,
    /// ROS topics and services of the value, each with its space.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    ros_topics: Vec<RosTopic>,
}

#[derive(Debug, Clone, Serialize)]
struct RosTopic {
    space: u8,
    topic: String,
}

#[derive(Debug, Clone, Serialize)]
struct CallStatus {
    /// Display name of the call.
    #[serde(skip_serializing_if = "Option::is_none")]
    name: Option<String>,
    /// Whether another program executes it at the moment.
    known: bool,
    asked: u64,
    answered: u64,
    refused: u64,
    unknown: u64,
    executed: u64,
    dropped: BTreeMap<&'static str, u64>,
}

#[derive(Debug, Clone, Serialize)]
struct HopStatus {
    count: u64,
    negative: u64,
    p50_us: f64,
    p99_us: f64,
    p999_us: f64,
    max_us: f64,
}

impl StatusSnapshot {
    pub(crate) fn of(
        (program, space): (&'static str, SpaceId),
        router: &Router,
        (about, restart): (&About, &[String]),
        readiness: Readiness,
    ) -> Self {
        let topics = router
            .topics()
            .map(|(topic, counters)| {
                let mut status = TopicStatus::from(counters);
                status.names = TopicNames::of(router, topic);
                (topic.to_string(), status)
            })
            .collect();
        let topics_without_values = router
            .names_without_values(crate::clock::now().monotonic)
            .map(|(topic, _)| (topic.to_string(), TopicNames::of(router, topic)))
            .collect();
        let groups = router.groups().map(|state| {
            let status = GroupStatus {
                mode: state.mode.name(),
                token: state.token_id,
                next_token: state.next_token_id,
                overdue: state.overdue,
            };
            (state.group, status)
        });
        let calls = router
            .calls()
            .map(|(topic, counters)| {
                let is_known = router.described_call(topic).is_some();
                let mut status = CallStatus::of(counters, is_known);
                status.name = router.name_of(topic).map(str::to_owned);
                (topic.to_string(), status)
            })
            .collect();
        let hops = HOPS
            .into_iter()
            .map(|hop| (hop.label(), router.hops().of(hop).into()))
            .collect();
        Self {
            program,
            version: build_info::version(),
            uptime_s: 0,
            time_us: 0,
            library: None,
            space: space.get(),
            readiness,
            mapping: MappingStatus {
                about: about.clone(),
                restart_needed: restart.to_vec(),
            },
            groups: groups.collect(),
            topics,
            topics_without_values,
            calls,
            names_left_out: BTreeSet::new(),
            names_left_out_total: 0,
            servers: Vec::new(),
            certificate: None,
            cancellations_pending: Vec::new(),
            applications: applications(router),
            broker: None,
            carriers: Vec::new(),
            redundancy: None,
            others: router.others().into(),
            hops,
        }
    }

    pub(crate) const fn with_library(mut self, library: Option<&'static str>) -> Self {
        self.library = library;
        self
    }

    pub(crate) fn with_time(mut self, utc: Timestamp) -> Self {
        self.time_us = u64::try_from(utc.unix_nanos() / 1000).unwrap_or_default();
        self
    }

    pub(crate) const fn with_uptime(mut self, uptime: Duration) -> Self {
        self.uptime_s = uptime.as_secs();
        self
    }

    pub(crate) fn with_links(mut self, links: Vec<LinkState>) -> Self {
        self.servers = links;
        self
    }

    pub(crate) fn with_certificate(mut self, certificate: Option<serde_json::Value>) -> Self {
        self.certificate = certificate;
        self
    }

    pub(crate) fn with_pending(mut self, pending: Vec<String>) -> Self {
        self.cancellations_pending = pending;
        self
    }

    /// Limits the announced names in the figures for Prometheus.
    pub(crate) fn with_names(mut self, router: &Router, names: &mut AnnouncedNames) -> Self {
        names.follow(router);
        self.names_left_out = names.left_out();
        self.names_left_out_total = names.left_out_total();
        self
    }

    /// Returns a figure for Prometheus with the names of each topic and call that has a name, but
    /// no announced names beyond their limit.
    fn names(&self, own: &str) -> String {
        let is_shown = |topic: &String| !self.names_left_out.contains(topic);
        let topics = self.topics.iter().filter(|(topic, _)| is_shown(topic));
        let topics = topics.filter_map(|(topic, status)| {
            let labels = status.names.labels(topic)?;
            Some(format!("ua_topic_info{{{own},{labels}}} 1\n"))
        });
        let calls = self.calls.iter().filter(|(topic, _)| is_shown(topic));
        let calls = calls.filter_map(|(topic, status)| {
            let name = escaped(status.name.as_deref()?);
            Some(format!(
                "ua_call_info{{{own},call=\"{topic}\",name=\"{name}\"}} 1\n"
            ))
        });
        topics.chain(calls).collect()
    }

    pub(crate) fn with_carrier(
        mut self,
        address: String,
        dropped: Vec<(&'static str, u64)>,
    ) -> Self {
        self.broker = (!dropped.is_empty()).then(|| BrokerStatus {
            address,
            dropped: dropped.into_iter().collect(),
        });
        self
    }

    pub(crate) fn with_carriers(mut self, states: Vec<transport::CarrierState>) -> Self {
        self.carriers = states.into_iter().map(CarrierStatus::from).collect();
        self
    }

    pub(crate) fn with_redundancy(mut self, redundancy: Option<RedundancyStatus>) -> Self {
        self.redundancy = redundancy;
        self
    }

    /// Returns the number of topics, and the numbers of samples sent, delivered and dropped. Drops
    /// of normal traffic, such as repetitions, are not counted.
    pub(crate) fn summary(&self) -> [u64; 4] {
        let all = || self.topics.values().chain([&self.others]);
        let routine = Reason::ALL.into_iter().filter(|reason| reason.is_routine());
        let routine: Vec<&str> = routine.map(Reason::label).collect();
        let dropped = all().flat_map(|topic| &topic.dropped);
        let dropped = dropped.filter(|(reason, _)| !routine.contains(reason));
        [
            self.topics.len().try_into().unwrap_or(u64::MAX),
            all().map(|topic| topic.sent).sum(),
            all().map(|topic| topic.delivered).sum(),
            dropped.map(|(_, count)| count).sum(),
        ]
    }
}

fn applications(router: &Router) -> Vec<ApplicationStatus> {
    let all = router.applications();
    let shown = all.map(|(space, from, application)| ApplicationStatus {
        space: space.get(),
        from: from.to_string(),
        uri: application.uri.clone(),
        name: application.name.clone(),
        urls: application.urls.clone(),
        capabilities: application.capabilities.clone(),
    });
    shown.collect()
}

impl PageState for StatusSnapshot {
    fn not_ready(&self) -> Vec<String> {
        let (program, space) = (self.program, self.space);
        let reasons = self.readiness.not_ready.iter();
        reasons
            .map(|why| format!("{program}, space {space}: {why}\n"))
            .collect()
    }

    fn waiting_for(&self) -> Vec<String> {
        let (program, space) = (self.program, self.space);
        let peers = self.readiness.waiting_for.iter();
        peers
            .map(|peer| format!("{program}, space {space}: waiting for {peer}\n"))
            .collect()
    }

    fn json(&self) -> String {
        // All keys are strings and all numbers are finite, so serialization does not fail.
        serde_json::to_string(self).unwrap_or_default()
    }

    fn prometheus(&self) -> String {
        let mut text = String::new();
        let mut line = |name: &str, labels: &str, value: &dyn std::fmt::Display| {
            // Writing to a string does not fail.
            let _written = writeln!(text, "ua_{name}{{{labels}}} {value}");
        };
        let own = format!("program=\"{}\",space=\"{}\"", self.program, self.space);
        let Readiness {
            not_ready,
            waiting_for,
            interfaces: Interfaces { pubsub, local },
        } = &self.readiness;
        line("ready", &own, &u8::from(not_ready.is_empty()));
        line("awaited_peers", &own, &waiting_for.len());
        let sides = [("pubsub", Some(*pubsub)), ("local", *local)];
        for (side, up) in sides {
            if let Some(up) = up {
                line("interface_up", &format!("{own},side=\"{side}\""), &up);
            }
        }
        for (name, value) in self.mapping.about.figures() {
            line(name, &own, &value);
        }
        for (group, status) in &self.groups {
            let labels = format!("{own},group=\"{}\"", escaped(group));
            let token = status.token.unwrap_or_default();
            line("group_security_token", &labels, &token);
            line("group_keys_overdue", &labels, &u8::from(status.overdue));
        }
        let restart = u8::from(!self.mapping.restart_needed.is_empty());
        line("mapping_restart_needed", &own, &restart);
        let none = [("none".to_owned(), &self.others)];
        let all = self
            .topics
            .iter()
            .map(|(topic, status)| (topic.clone(), status))
            .chain(none);
        for (topic, status) in all {
            let labels = format!("{own},topic=\"{topic}\"");
            line("samples_sent_total", &labels, &status.sent);
            line("samples_delivered_total", &labels, &status.delivered);
            line("key_frames_repeated_total", &labels, &status.repeated);
            line("metadata_announced_total", &labels, &status.announced);
            line("metadata_learned_total", &labels, &status.described);
            line("keep_alives_total", &labels, &status.keep_alives);
            line("messages_missing_total", &labels, &status.missing);
            line("sender_changed_total", &labels, &status.sender_changed);
            line("deadline_missed_total", &labels, &status.deadline_missed);
            line("samples_looped_total", &labels, &status.looped);
            for (reason, count) in &status.dropped {
                line(
                    "samples_dropped_total",
                    &format!("{labels},reason=\"{reason}\""),
                    count,
                );
            }
        }
        for (topic, call) in &self.calls {
            let labels = format!("{own},call=\"{topic}\"");
            call.figures(&labels, &mut line);
        }
        for carrier in &self.carriers {
            carrier.figures(&own, &mut line);
        }
        for (reason, count) in self.broker.iter().flat_map(|broker| &broker.dropped) {
            let labels = format!("{own},reason=\"{reason}\"");
            line("broker_dropped_total", &labels, count);
        }
        if let Some(redundancy) = &self.redundancy {
            redundancy.figures(&own, &mut line);
        }
        let pending = self.cancellations_pending.len();
        line("cancellations_pending", &own, &pending);
        for link in &self.servers {
            link.figures(&own, &mut line);
        }
        line("names_left_out_total", &own, &self.names_left_out_total);
        for (hop, delays) in &self.hops {
            delays.figures(&format!("{own},hop=\"{hop}\""), &mut line);
        }
        text.push_str(&self.names(&own));
        text
    }
}

impl CallStatus {
    /// Passes the name, the labels and the value of each figure to `line`.
    fn figures(&self, labels: &str, line: &mut impl FnMut(&str, &str, &dyn std::fmt::Display)) {
        line("call_known", labels, &u8::from(self.known));
        line("calls_asked_total", labels, &self.asked);
        line("calls_answered_total", labels, &self.answered);
        line("calls_refused_total", labels, &self.refused);
        line("calls_unknown_total", labels, &self.unknown);
        line("calls_executed_total", labels, &self.executed);
        for (reason, count) in &self.dropped {
            line(
                "calls_dropped_total",
                &format!("{labels},reason=\"{reason}\""),
                count,
            );
        }
    }
}

impl HopStatus {
    /// Passes the name, the labels and the value of each figure to `line`.
    fn figures(&self, labels: &str, line: &mut impl FnMut(&str, &str, &dyn std::fmt::Display)) {
        line("hop_count", labels, &self.count);
        line("hop_negative_total", labels, &self.negative);
        line("hop_p50_microseconds", labels, &self.p50_us);
        line("hop_p99_microseconds", labels, &self.p99_us);
        line("hop_p999_microseconds", labels, &self.p999_us);
        line("hop_max_microseconds", labels, &self.max_us);
    }
}

impl LinkState {
    /// Passes the name, the labels (including `own`) and the value of each figure to `line`.
    fn figures(&self, own: &str, line: &mut impl FnMut(&str, &str, &dyn std::fmt::Display)) {
        let labels = format!("{own},server=\"{}\"", self.name);
        line("server_up", &labels, &u8::from(self.up));
        line("server_connects_total", &labels, &self.connects);
        line(
            "server_certificates_refused_total",
            &labels,
            &self.certificates_refused,
        );
        line("server_values_total", &labels, &self.values);
        line("server_written_total", &labels, &self.written);
        line("server_not_written_total", &labels, &self.not_written);
        line("server_faults", &labels, &self.faults.len());
    }
}

/// Escapes a text for the value of a label.
fn escaped(text: &str) -> String {
    let quoted = text.replace('\\', "\\\\").replace('"', "\\\"");
    quoted.replace('\n', "\\n")
}

impl CallStatus {
    fn of(counters: &CallCounters, known: bool) -> Self {
        let CallCounters {
            asked,
            answered,
            refused,
            unknown,
            executed,
            drops,
        } = counters;
        Self {
            known,
            name: None,
            asked: *asked,
            answered: *answered,
            refused: *refused,
            unknown: *unknown,
            executed: *executed,
            dropped: drops
                .drops()
                .filter(|(reason, _)| *reason != Reason::Looped)
                .map(|(reason, count)| (reason.label(), count))
                .collect(),
        }
    }
}

impl TopicNames {
    fn of(router: &Router, topic: TopicId) -> Self {
        let variable = router.mapping().variable(topic);
        let ros_topics = variable.into_iter().flat_map(Variable::ros_names);
        let ros_topics = ros_topics.map(|(space, topic)| RosTopic {
            space: space.get(),
            topic: topic.to_owned(),
        });
        Self {
            name: router.name_of(topic).map(str::to_owned),
            ros_topics: ros_topics.collect(),
        }
    }

    /// Returns the labels of a topic with its names; `None` without a name.
    fn labels(&self, topic: &str) -> Option<String> {
        let name = self.name.as_deref()?;
        let of = |ros: &RosTopic| format!("{} {}", ros.space, ros.topic);
        let ros: Vec<String> = self.ros_topics.iter().map(of).collect();
        let (name, ros) = (escaped(name), escaped(&ros.join(", ")));
        Some(format!(
            "topic=\"{topic}\",name=\"{name}\",ros_topics=\"{ros}\""
        ))
    }
}

impl From<&Counters> for TopicStatus {
    fn from(counters: &Counters) -> Self {
        Self {
            names: TopicNames::default(),
            sent: counters.sent,
            delivered: counters.delivered,
            repeated: counters.repeated,
            announced: counters.announced,
            described: counters.described,
            keep_alives: counters.keep_alives,
            missing: counters.missing,
            sender_changed: counters.sender_changed,
            deadline_missed: counters.deadline_missed,
            looped: counters.dropped(Reason::Looped),
            dropped: counters
                .drops()
                .filter(|(reason, _)| *reason != Reason::Looped)
                .map(|(reason, count)| (reason.label(), count))
                .collect(),
        }
    }
}

impl From<&Delays> for HopStatus {
    fn from(delays: &Delays) -> Self {
        Self {
            count: delays.count(),
            negative: delays.negative(),
            p50_us: delays.quantile_us(0.5),
            p99_us: delays.quantile_us(0.99),
            p999_us: delays.quantile_us(0.999),
            max_us: delays.max_us(),
        }
    }
}

const HOPS: [Hop; 4] = [Hop::Out, Hop::Origin, Hop::Network, Hop::In];

#[cfg(test)]
mod tests;
