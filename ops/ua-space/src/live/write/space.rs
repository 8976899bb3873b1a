//! Writes a value without a server: this process is the program of space 0 that sends it.

use std::ffi::OsString;
use std::net::SocketAddr;
use std::path::Path;
use std::process::ExitCode;
use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use std::time::Duration;

use bridge_node::{
    Arguments, ConfirmedArrival, Context, FailureKind, LocalDelivery, NodeSetReader, Owned, Port,
    PortEvent, Program, TopicMetaData, TypePaths, now,
};
use bytes::Bytes;
use mappings::{Mapping, SpaceId, TopicId, Variable};
use tokio::time::{Instant, sleep_until};
use uadp::{BuiltinType, Timestamp};

use super::super::names::mapped;
use super::super::text::harmless;
use super::value::NoFieldValue;
use super::{Tally, WriteOutcome, label, pace, value};
use crate::arguments::Write;
use crate::exit::CommandFailure;
use crate::live::unix_nanos;
use crate::report::warn;

/// Sends the value to the group by the mapping.
pub(super) fn write(arguments: &Write, mapping: &Path) -> Result<ExitCode, CommandFailure> {
    if arguments.user.is_some() {
        warn("no ua-server has the value: --user has no effect");
    }
    let (period, count) = pace(arguments);
    let order = Order {
        target: arguments.target.clone(),
        values: arguments.values.clone(),
        period,
        count,
        json: arguments.json,
        topic: OnceLock::new(),
        outcome: Mutex::default(),
    };
    // The process has a single order.
    let order = ORDER.get_or_init(|| order);
    let mut words: Vec<OsString> = vec![Writer::NAME.into(), mapping.into()];
    let options = [
        ("--interface", &arguments.group.interface),
        ("--address", &arguments.group.address),
    ];
    for (option, given) in options {
        if let Some(given) = given {
            words.extend([option.into(), given.into()]);
        }
    }
    let code = bridge_node::run::<Writer>(words);
    let mut outcome = order.outcome.lock().unwrap_or_else(PoisonError::into_inner);
    match outcome.take() {
        Some(outcome) => outcome.map(|()| ExitCode::SUCCESS),
        // The program could not start, which was logged.
        None => Ok(code),
    }
}

/// The value to write, and the outcome.
#[derive(Debug)]
struct Order {
    target: crate::arguments::NamedTarget,
    values: Vec<String>,
    /// The time between two values.
    period: Option<Duration>,
    /// The number of values; `None` until the user interrupts the command.
    count: Option<u64>,
    json: bool,
    /// The topic, once the mapping is read.
    topic: OnceLock<TopicId>,
    outcome: Mutex<Option<Result<(), CommandFailure>>>,
}

static ORDER: OnceLock<Order> = OnceLock::new();

/// The program that sends the value.
#[derive(Debug, clap::Parser)]
#[command(name = "ua-space write", version = build_info::version())]
struct Writer {
    #[command(flatten)]
    arguments: Arguments,
}

/// Returns the order of this process.
fn order() -> Result<&'static Order, bridge_node::Failure> {
    let missing = || bridge_node::Failure::new(FailureKind::Usage, "there is nothing to write");
    ORDER.get().ok_or_else(missing)
}

impl Program for Writer {
    type Port = WritePort;

    const NAME: &'static str = "ua-space write";
    const LOCAL: bridge_core::Local = bridge_core::Local::Fields;
    const CLAIMS: bool = true;
    const QUIET: &'static str = "bridge_node=warn,bridge_core=warn,service=warn";
    const NODESETS: Option<NodeSetReader> = Some(plant_nodesets::read);

    fn arguments(&self) -> &Arguments {
        &self.arguments
    }

    /// Only the namespace of the value is written, so that other programs of space 0 are not
    /// disturbed.
    fn owned(_mapping: &Mapping) -> Owned {
        let topic = ORDER.get().and_then(|order| order.topic.get());
        Owned::Only(
            topic
                .map(|topic| topic.namespace.get())
                .into_iter()
                .collect(),
        )
    }

    fn spaces(&self, mapping: &Mapping) -> Result<Vec<SpaceId>, bridge_node::Failure> {
        let order = order()?;
        let variable = find(order, mapping)?;
        // The same for each reading of the mapping.
        let _known = order.topic.set(variable.topic);
        Ok(vec![SpaceId::UA])
    }

    async fn start(&self, context: Context) -> Result<WritePort, bridge_node::Failure> {
        let order = order()?;
        let variable = find(order, &context.mapping)?;
        let port = WritePort::new(order, variable);
        // A wrong value is reported before anything is sent.
        port.block()
            .map_err(|wrong| bridge_node::Failure::new(FailureKind::Usage, port.unfit(&wrong)))?;
        if variable.loss.is_some() && order.period.is_none() {
            let label = label(variable.topic, &variable.name);
            warn(&format!(
                "{label} has `on_loss`, which follows when this command ends; --rate keeps the value \
                 in effect"
            ));
        }
        Ok(port)
    }
}

/// Returns the variable of the order, if this process may send its value.
fn find<'m>(order: &Order, mapping: &'m Mapping) -> Result<&'m Variable, bridge_node::Failure> {
    let usage = |text: String| bridge_node::Failure::new(FailureKind::Usage, text);
    let target = harmless(&order.target.to_string());
    let found = mapped(mapping, &order.target);
    let variable = match found.as_slice() {
        [only] => *only,
        [] => {
            let names = mapping.variables().iter().map(|one| one.name.as_str());
            let near = mappings::nearest(&target, names);
            let near = near.map(|near| format!("; did you mean `{}`?", harmless(near)));
            let near = near.unwrap_or_default();
            return Err(usage(format!("the mapping has no value {target}{near}")));
        }
        several => {
            let topics = several.iter().map(|one| label(one.topic, &one.name));
            let topics: Vec<String> = topics.take(MOST_SHOWN).collect();
            let topics = topics.join(", ");
            return Err(usage(format!(
                "{target} is the name of {topics}: give the topic"
            )));
        }
    };
    let name = label(variable.topic, &variable.name);
    let by_server = |why: &str| Err(usage(format!("{name} {why}: it is written at a ua-server")));
    match variable {
        one if one.topic.space != SpaceId::UA => {
            let space = one.topic.space;
            Err(usage(format!(
                "{name} is a value of ROS space {space}: publish it in ROS"
            )))
        }
        one if one.from.is_some() || one.to.is_some() => by_server("belongs to an OPC UA server"),
        one if one.reports_alarms => by_server("is made of the alarms of a ua-server"),
        one if one.confirm.is_some() => by_server("is confirmed by another value"),
        one => Ok(one),
    }
}

/// The phase of a write.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Phase {
    Start,
    /// Other writers of the namespace answer until this time.
    Claiming(Instant),
    /// The next value is due at this time.
    Sending(Instant),
    /// The outcome of the last value is known at this time.
    Waiting(Instant),
    Over,
}

/// The local side of this process: the value.
struct WritePort {
    order: &'static Order,
    variable: Box<Variable>,
    phase: Phase,
    sent: u64,
    /// Whether the outcome of the last value is still missing.
    is_open: bool,
    tally: Tally,
    /// Ends the program.
    stop: fn(),
}

impl WritePort {
    fn new(order: &'static Order, variable: &Variable) -> Self {
        Self {
            order,
            variable: Box::new(variable.clone()),
            phase: Phase::Start,
            sent: 0,
            is_open: false,
            tally: Tally::default(),
            stop: bridge_node::stop,
        }
    }

    /// Encodes the value.
    fn block(&self) -> Result<Bytes, NoFieldValue> {
        let fields = value::fields_of(&self.variable);
        let block = value::encoded(&self.order.values, &fields, unix_nanos());
        block.map(Bytes::from)
    }

    /// Returns the text about a value that does not fit the variable.
    fn unfit(&self, fault: &NoFieldValue) -> String {
        let label = label(self.variable.topic, &self.variable.name);
        format!("{label}: {fault}")
    }

    /// Records the outcome of the last value.
    fn settle(&mut self, written: &WriteOutcome) {
        if !std::mem::replace(&mut self.is_open, false) {
            return;
        }
        let at = (self.variable.topic, self.variable.name.as_str(), BY);
        let taken = self.tally.take(at, written, self.order.json);
        match taken {
            Err(failure) => self.finish(Err(failure)),
            Ok(()) if matches!(self.phase, Phase::Waiting(_)) => self.end(),
            Ok(()) => {}
        }
    }

    fn end(&mut self) {
        let at = (self.variable.topic, self.variable.name.as_str(), BY);
        let outcome = self.tally.end(at, self.order.json);
        self.finish(outcome);
    }

    fn finish(&mut self, outcome: Result<(), CommandFailure>) {
        self.phase = Phase::Over;
        let mut place = self
            .order
            .outcome
            .lock()
            .unwrap_or_else(PoisonError::into_inner);
        if place.is_none() {
            *place = Some(outcome);
            (self.stop)();
        }
    }

    /// Returns the next value.
    fn sample(&mut self) -> Option<PortEvent> {
        let payload = match self.block() {
            Ok(block) => block,
            Err(wrong) => {
                self.finish(Err(CommandFailure::Usage(self.unfit(&wrong))));
                return None;
            }
        };
        // A newer value ends the repetition of the value before.
        self.settle(&match self.variable.confirmed_within {
            Some(_) => WriteOutcome::Unknown("a newer value replaced it".to_owned()),
            None => WriteOutcome::Arrived,
        });
        self.sent += 1;
        self.is_open = true;
        let is_last = self.order.count == Some(self.sent);
        self.phase = match (self.order.period, is_last) {
            (Some(period), false) => Phase::Sending(Instant::now() + period),
            (_, _) => {
                let within = self.variable.confirmed_within;
                Phase::Waiting(Instant::now() + within.map_or(REPEATED, |within| within + GRACE))
            }
        };
        Some(PortEvent::Sample {
            topic: self.variable.topic,
            payload,
            received: now().utc,
            latched_by: None,
        })
    }
}

impl Port for WritePort {
    async fn recv(&mut self) -> PortEvent {
        loop {
            match self.phase {
                Phase::Start => {
                    self.phase = Phase::Claiming(Instant::now() + CLAIM);
                    let topic = self.variable.topic;
                    return PortEvent::Live { topic, live: true };
                }
                Phase::Claiming(until) => {
                    sleep_until(until).await;
                    self.phase = Phase::Sending(until);
                }
                Phase::Sending(due) => {
                    sleep_until(due).await;
                    if let Some(event) = self.sample() {
                        return event;
                    }
                }
                Phase::Waiting(until) => {
                    sleep_until(until).await;
                    self.settle(&match self.variable.confirmed_within {
                        Some(_) => WriteOutcome::Unknown("no bridge answered in time".to_owned()),
                        None => WriteOutcome::Arrived,
                    });
                }
                Phase::Over => std::future::pending().await,
            }
        }
    }

    fn publish(&mut self, _sample: LocalDelivery) -> Result<(), &'static str> {
        // Values of other programs are not shown.
        Ok(())
    }

    fn settled(&mut self, topic: TopicId, arrival: &ConfirmedArrival) {
        if topic != self.variable.topic {
            return;
        }
        let written = match arrival {
            ConfirmedArrival::Confirmed => WriteOutcome::Arrived,
            ConfirmedArrival::NotSent => {
                WriteOutcome::Refused("the network took no message: nothing was sent".to_owned())
            }
            ConfirmedArrival::Unknown(spaces) => {
                let spaces: Vec<String> = spaces.iter().map(ToString::to_string).collect();
                let spaces = spaces.join(", ");
                WriteOutcome::Unknown(format!(
                    "not confirmed in time by the bridge of space {spaces}"
                ))
            }
        };
        self.settle(&written);
    }

    fn wanted(
        &mut self,
        _topic: TopicId,
        _shape: &[(BuiltinType, bool)],
        _described: Option<&TopicMetaData>,
    ) {
        // Values of other programs are not shown.
    }

    fn silent(&mut self, _topic: TopicId, _silent: bool) {
        // Values of other programs are not shown.
    }

    fn retired(&mut self, _topic: TopicId, _instance: Timestamp) {
        // Values of other programs are not shown.
    }

    fn taken(&mut self, namespace: u16, by: Option<SocketAddr>) {
        let Some(by) = by.filter(|_| namespace == self.variable.topic.namespace.get()) else {
            return;
        };
        let label = label(self.variable.topic, &self.variable.name);
        self.finish(Err(CommandFailure::Failed(format!(
            "{label}: another program at {by} writes namespace {namespace} of origin 0: nothing was \
             sent\n  = help: write at its ua-server, with --server opc.tcp://HOST:PORT, or end it"
        ))));
    }

    fn reload(&mut self, _mapping: &Arc<Mapping>, _types: &Arc<TypePaths>) -> Vec<String> {
        Vec::new()
    }

    async fn shutdown(mut self) {
        if self.phase == Phase::Over {
            return;
        }
        // The user interrupted the command.
        if self.sent == 0 {
            return self.finish(Err(CommandFailure::Interrupted));
        }
        match (self.variable.confirmed_within, self.order.count) {
            (None, _) => self.settle(&WriteOutcome::Arrived),
            // The usual end of a stream. Its last value is not waited for.
            (Some(_), None) if self.tally.written > 0 => self.is_open = false,
            (Some(_), _) => self.settle(&WriteOutcome::Unknown("interrupted".to_owned())),
        }
        if self.phase != Phase::Over {
            self.end();
        }
    }
}

/// The sender of the value in the output.
const BY: &str = "this process";
/// The time in which other writers of the namespace answer, with a margin.
const CLAIM: Duration = Duration::from_millis(400);
/// The time in which an event without confirmation is repeated, with a margin.
const REPEATED: Duration = Duration::from_millis(250);
/// The time after the limit of a confirmation in which its outcome is reported.
const GRACE: Duration = Duration::from_millis(500);
const MOST_SHOWN: usize = 12;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::arguments::NamedTarget;

    const MAPPING: &str = "
spaces: [{id: 1}]
namespaces: {2: urn:test}
variables:
  - {node: ns=2;i=10, name: Line.Speed, type: Double, origin: 1, ros: {topic: /speed, type: std_msgs/Float64, field: data}}
  - {node: ns=2;i=30, name: Line.Setpoint, type: Double, range: [0, 5], origin: 0, ros: {space: 1, topic: /setpoint, type: std_msgs/Float64, field: data}}
  - {node: ns=2;i=31, name: Arm.Setpoint, type: Double, origin: 0, confirm: {by: ns=2;i=10}, ros: {space: 1, topic: /arm, type: std_msgs/Float64, field: data}}
  - {node: ns=2;i=32, name: Light, type: Boolean, origin: 0, confirm: none, ros: {space: 1, topic: /light, type: std_msgs/Bool, field: data}}
";

    fn mapping() -> Mapping {
        let checked = Mapping::from_yaml(MAPPING, "cell.yaml");
        checked
            .mapping
            .unwrap_or_else(|| panic!("{:?}", checked.findings))
    }

    /// A rate has no limit of values if its number is 0.
    fn ordered(target: &str, value: &str, rate: Option<(f64, u64)>) -> &'static Order {
        Box::leak(Box::new(Order {
            target: target.parse::<NamedTarget>().unwrap(),
            values: vec![value.to_owned()],
            period: rate.map(|(rate, _)| Duration::from_secs_f64(1.0 / rate)),
            count: Some(rate.map_or(1, |(_, count)| count)).filter(|count| *count > 0),
            json: true,
            topic: OnceLock::new(),
            outcome: Mutex::default(),
        }))
    }

    fn port(order: &'static Order) -> WritePort {
        let mapping = mapping();
        let mut port = WritePort::new(order, find(order, &mapping).unwrap());
        port.stop = || {};
        port
    }

    fn outcome(order: &Order) -> Result<(), CommandFailure> {
        order.outcome.lock().unwrap().take().unwrap()
    }

    /// Receives events until the value has been given out.
    async fn sample(port: &mut WritePort) -> Bytes {
        loop {
            if let PortEvent::Sample { payload, .. } = port.recv().await {
                return payload;
            }
        }
    }

    /// Receives events until the outcome is known.
    async fn ended(port: &mut WritePort) -> Result<(), CommandFailure> {
        let order = port.order;
        let deadline = Instant::now() + Duration::from_secs(60);
        while order.outcome.lock().unwrap().is_none() {
            assert!(Instant::now() < deadline, "there is no outcome");
            let turn = tokio::time::timeout(Duration::from_millis(20), port.recv());
            // Dropping the future loses nothing.
            let _event = turn.await;
        }
        outcome(order)
    }

    #[test]
    fn only_values_of_origin_0_that_need_no_server_are_sent_by_this_process() {
        let mapping = mapping();
        let topic = |target: &str| {
            let found = find(ordered(target, "1", None), &mapping);
            found
                .map(|one| one.topic.to_string())
                .map_err(|error| error.to_string())
        };
        assert_eq!(topic("Line.Setpoint").unwrap(), "ua_0_2_30");
        assert_eq!(topic("/setpoint").unwrap(), "ua_0_2_30");
        assert_eq!(topic("ua_0_2_32").unwrap(), "ua_0_2_32");
        for (target, why) in [
            ("Speed", "is a value of ROS space 1: publish it in ROS"),
            (
                "Arm.Setpoint",
                "is confirmed by another value: it is written at a ua-server",
            ),
            (
                "Setpoint",
                "Setpoint is the name of ua_0_2_30 Line.Setpoint, ua_0_2_31",
            ),
            (
                "Lihgt",
                "the mapping has no value Lihgt; did you mean `Light`?",
            ),
        ] {
            let wrong = topic(target).unwrap_err();
            assert!(wrong.contains(why), "{target}: {wrong}");
        }
    }

    #[tokio::test]
    async fn a_value_that_is_not_confirmed_is_unknown() {
        let order = ordered("Line.Setpoint", "1.5", None);
        let mut port = port(order);
        assert_eq!(sample(&mut port).await.as_ref()[..3], [1, 0, 11]);
        // Without any answer of the Router.
        assert!(matches!(
            ended(&mut port).await,
            Err(CommandFailure::Unavailable(_))
        ));
    }

    #[tokio::test]
    async fn a_confirmed_value_ends_the_command_at_once() {
        let order = ordered("Line.Setpoint", "1.5", None);
        let mut port = port(order);
        let topic = port.variable.topic;
        sample(&mut port).await;
        port.settled(topic, &ConfirmedArrival::Confirmed);
        outcome(order).unwrap();
        // A later answer changes nothing.
        port.settled(topic, &ConfirmedArrival::Unknown(vec![SpaceId::ROS1]));
        assert!(order.outcome.lock().unwrap().is_none());
    }

    #[tokio::test]
    async fn a_stream_keeps_its_rate_and_counts_what_a_newer_value_replaced() {
        let order = ordered("Line.Setpoint", "1.5", Some((10.0, 3)));
        let mut port = port(order);
        let topic = port.variable.topic;
        sample(&mut port).await;
        port.settled(topic, &ConfirmedArrival::Confirmed);
        let before = Instant::now();
        sample(&mut port).await;
        sample(&mut port).await;
        assert!(before.elapsed() >= Duration::from_millis(190));
        port.settled(topic, &ConfirmedArrival::Confirmed);
        let wrong = outcome(order).unwrap_err().to_string();
        assert!(
            wrong.contains("1 of 3 values: a newer value replaced it"),
            "{wrong}"
        );
    }

    #[tokio::test]
    async fn an_interrupted_stream_is_unknown_until_a_value_is_written() {
        for is_confirmed in [false, true] {
            let order = ordered("Line.Setpoint", "1.5", Some((100.0, 0)));
            let mut port = port(order);
            let topic = port.variable.topic;
            sample(&mut port).await;
            if is_confirmed {
                port.settled(topic, &ConfirmedArrival::Confirmed);
                sample(&mut port).await;
            }
            port.shutdown().await;
            let ended = outcome(order);
            assert_eq!(ended.is_ok(), is_confirmed, "{ended:?}");
            assert!(
                matches!(ended, Ok(()) | Err(CommandFailure::Unavailable(_))),
                "{ended:?}"
            );
        }
    }

    #[tokio::test]
    async fn a_namespace_of_another_program_is_left_alone() {
        let order = ordered("Light", "true", None);
        let mut port = port(order);
        assert!(matches!(
            port.recv().await,
            PortEvent::Live { live: true, .. }
        ));
        let other = Some("192.168.0.5:4840".parse().unwrap());
        port.taken(3, other);
        assert!(order.outcome.lock().unwrap().is_none());
        port.taken(2, other);
        assert_eq!(port.phase, Phase::Over, "it is sent");
        assert!(matches!(outcome(order), Err(CommandFailure::Failed(_))));
    }

    #[tokio::test]
    async fn a_value_without_confirmation_ends_after_its_repetitions() {
        let order = ordered("Light", "true", None);
        let mut port = port(order);
        assert_eq!(sample(&mut port).await.as_ref(), [1, 0, 1, 1]);
        ended(&mut port).await.unwrap();
    }
}
