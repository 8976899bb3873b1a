//! Nodes of existing OPC UA servers as values of the cell, read from and written to these servers.
//!
//! Each server has two tasks: `reading` monitors its subscriptions and `writing` empties its
//! outbox. If a server is offline, its values are bad, without any other effect. The connection is
//! retried without limit, so a server may start after this program.

mod outbox;
mod reading;
mod state;
mod writing;

use std::collections::{HashMap, HashSet};
use std::sync::Arc;

use bridge_node::{LinkState, now};
use bytes::Bytes;
use mappings::{Access, Mapping, NodeSource, NodeTarget, Overflow, TopicId, Variable};
use opcua::types::{DataValue, NodeId, StatusCode, Variant};
use tokio::sync::{mpsc, oneshot, watch};
use tokio::task::AbortHandle;
use uadp::{Fields, Timestamp};

use self::outbox::ServerOutbox;
use self::state::ServerState;
use crate::clients::Clients;
use crate::value;

/// A value of a node of another server.
pub(crate) struct Sourced {
    pub(crate) topic: TopicId,
    /// The fields of the DataSet; a StatusCode in place of a bad value.
    pub(crate) block: Bytes,
    pub(crate) taken: Timestamp,
    pub(crate) status: StatusCode,
}

/// The servers of the mapping.
pub(crate) struct MappedServers {
    servers: HashMap<String, Running>,
    /// Names of the servers in the order of the mapping.
    order: Vec<String>,
    /// The topics that are read from servers.
    reads: HashMap<TopicId, Arc<Read>>,
    /// The topics that are written to servers.
    writes: HashMap<TopicId, Arc<ServerOutbox>>,
    heard: mpsc::Receiver<News>,
    tell: mpsc::Sender<News>,
}

/// A variable that is read from a node.
#[derive(Debug, PartialEq)]
struct Read {
    topic: TopicId,
    name: String,
    source: NodeSource,
}

/// A variable that is written to a node.
#[derive(Debug, PartialEq)]
struct Write {
    topic: TopicId,
    name: String,
    target: NodeTarget,
    overflow: Overflow,
}

/// The variables of a server.
#[derive(Debug, Default, PartialEq)]
struct Plan {
    reads: Vec<Arc<Read>>,
    writes: Vec<Arc<Write>>,
}

/// A server in use.
struct Running {
    access: Access,
    plan: watch::Sender<Arc<Plan>>,
    outbox: Arc<ServerOutbox>,
    state: Arc<ServerState>,
    tasks: [AbortHandle; 2],
}

impl Drop for Running {
    fn drop(&mut self) {
        for task in &self.tasks {
            task.abort();
        }
    }
}

/// A new value of a variable.
struct News {
    read: Arc<Read>,
    value: DataValue,
}

impl MappedServers {
    /// Starts the tasks of the servers of `mapping`.
    pub(crate) fn new(mapping: &Mapping, clients: &mut Clients) -> Self {
        let (tell, heard) = mpsc::channel(MOST_NEWS);
        let mut sources = Self {
            servers: HashMap::new(),
            order: Vec::new(),
            reads: HashMap::new(),
            writes: HashMap::new(),
            heard,
            tell,
        };
        drop(sources.reload(mapping, clients));
        sources
    }

    /// Switches to another mapping; unchanged variables stay undisturbed. Returns the topics with a
    /// new or changed source, which have no value yet.
    pub(crate) fn reload(&mut self, mapping: &Mapping, clients: &mut Clients) -> Vec<TopicId> {
        let plans = self.plans(mapping);
        let named = |name: &String| mapping.servers().iter().find(|one| one.name == *name);
        let mut moved: HashSet<String> = HashSet::new();
        self.servers.retain(|name, running| {
            let stays = named(name).is_some_and(|server| server.access == running.access);
            if !stays {
                moved.insert(name.clone());
            }
            stays
        });
        self.order.clear();
        self.writes.clear();
        let mut reads: HashMap<TopicId, Arc<Read>> = HashMap::new();
        for (server, plan) in mapping.servers().iter().zip(plans) {
            for read in &plan.reads {
                reads.insert(read.topic, Arc::clone(read));
            }
            let name = &server.name;
            let written: Vec<TopicId> = plan.writes.iter().map(|write| write.topic).collect();
            let plan = Arc::new(plan);
            match self.servers.get(name) {
                Some(running) => {
                    running.state.keep(&plan);
                    running.plan.send_if_modified(|before| {
                        let differs = *before != plan;
                        *before = Arc::clone(&plan);
                        differs
                    });
                }
                None => {
                    let running = self.run(name, &server.access, plan, clients);
                    self.servers.insert(name.clone(), running);
                }
            }
            if let Some(running) = self.servers.get(name) {
                let outbox = |topic| (topic, Arc::clone(&running.outbox));
                self.writes.extend(written.into_iter().map(outbox));
            }
            self.order.push(name.clone());
        }
        let is_new = |(topic, read): &(&TopicId, &Arc<Read>)| {
            let before = self.reads.get(*topic);
            moved.contains(&read.source.server)
                || before.is_none_or(|before| !Arc::ptr_eq(before, read))
        };
        let new = reads
            .iter()
            .filter(is_new)
            .map(|(topic, _)| *topic)
            .collect();
        self.reads = reads;
        new
    }

    /// Returns the variables of each server. Unchanged variables keep their object.
    fn plans(&self, mapping: &Mapping) -> Vec<Plan> {
        let names = mapping.servers().iter().zip(0..);
        let places: HashMap<&str, usize> = names
            .map(|(server, at)| (server.name.as_str(), at))
            .collect();
        let mut plans: Vec<Plan> = mapping.servers().iter().map(|_| Plan::default()).collect();
        let mut plan = |server: &str, put: &mut dyn FnMut(&mut Plan)| {
            if let Some(plan) = places.get(server).and_then(|at| plans.get_mut(*at)) {
                put(plan);
            }
        };
        for variable in mapping.variables() {
            if let Some(from) = &variable.from {
                let read = self.read(variable, from);
                plan(&from.server, &mut |plan| plan.reads.push(Arc::clone(&read)));
            }
            if let Some(to) = &variable.to {
                let write = Arc::new(Write {
                    topic: variable.topic,
                    name: variable.name.clone(),
                    target: NodeTarget::clone(to),
                    overflow: variable.overflow,
                });
                plan(&to.server, &mut |plan| plan.writes.push(Arc::clone(&write)));
            }
        }
        plans
    }

    fn read(&self, variable: &Variable, from: &NodeSource) -> Arc<Read> {
        let read = Read {
            topic: variable.topic,
            name: variable.name.clone(),
            source: from.clone(),
        };
        let before = self.reads.get(&variable.topic).filter(|one| ***one == read);
        before.cloned().unwrap_or_else(|| Arc::new(read))
    }

    fn run(&self, name: &str, access: &Access, plan: Arc<Plan>, clients: &mut Clients) -> Running {
        let client = clients.of(access);
        let state = Arc::new(ServerState::new(name, access));
        let outbox = Arc::new(ServerOutbox::new(Arc::clone(&state)));
        let (sender, receiver) = watch::channel(plan);
        let reading = reading::run(
            client.clone(),
            receiver.clone(),
            Arc::clone(&state),
            self.tell.clone(),
        );
        let writing = writing::run(client, receiver, Arc::clone(&outbox));
        Running {
            access: access.clone(),
            plan: sender,
            outbox,
            state,
            tasks: [
                tokio::spawn(reading).abort_handle(),
                tokio::spawn(writing).abort_handle(),
            ],
        }
    }

    /// Waits for the next value of any server. Cancel-safe.
    pub(crate) async fn next(&mut self) -> Sourced {
        loop {
            let Some(News { read, value }) = self.heard.recv().await else {
                return std::future::pending().await;
            };
            let wanted = self.reads.get(&read.topic);
            if wanted.is_some_and(|wanted| Arc::ptr_eq(wanted, &read)) {
                return sourced(read.topic, &value);
            }
        }
    }

    /// Forwards a value of the cell to another server, if the mapping requests it.
    pub(crate) fn put(&self, topic: TopicId, block: &[u8]) {
        if let Some(outbox) = self.writes.get(&topic) {
            outbox.put(topic, block);
        }
    }

    /// Forwards a value that a client wrote. `answer` receives the result of the other server, and
    /// is dropped if there is no such server.
    pub(crate) fn write(&self, topic: TopicId, block: &[u8], answer: oneshot::Sender<StatusCode>) {
        if let Some(outbox) = self.writes.get(&topic) {
            outbox.write(topic, block, answer);
        }
    }

    /// Drops all values that wait to be written, because another redundant server is active.
    pub(crate) fn drop_waiting(&self) {
        for running in self.servers.values() {
            running.outbox.clear();
        }
    }

    /// Handles that the writer of a value is silent: its last value is not repeated to a server
    /// that reconnects.
    pub(crate) fn set_silent(&self, topic: TopicId) {
        if let Some(outbox) = self.writes.get(&topic) {
            outbox.forget(topic);
        }
    }

    /// Returns the state of the connection to each server.
    pub(crate) fn links(&self) -> Vec<LinkState> {
        let running = self.order.iter().filter_map(|name| self.servers.get(name));
        running.map(|running| running.state.told()).collect()
    }
}

/// Converts a value of a server into a value of the cell.
fn sourced(topic: TopicId, value: &DataValue) -> Sourced {
    let time = value.source_timestamp.or(value.server_timestamp);
    let taken = match time {
        Some(time) => Timestamp {
            time: value::ticks(time),
            picoseconds: value.source_picoseconds.unwrap_or_default().min(9_999),
        },
        None => now().utc,
    };
    let status = value.status.unwrap_or(StatusCode::Good);
    let good = match &value.value {
        Some(one) if !status.is_bad() && is_carried(one) => {
            value::fields_block(std::slice::from_ref(one)).ok()
        }
        Some(_) | None => None,
    };
    let (block, status) = match good {
        Some(block) => (block, status),
        None => {
            let status = match (status.is_bad(), &value.value) {
                (true, _) => status,
                (false, None) => StatusCode::BadNoData,
                (false, Some(_)) => StatusCode::BadDataEncodingUnsupported,
            };
            (no_value(status), status)
        }
    };
    Sourced {
        topic,
        block: Bytes::from(block),
        taken,
        status,
    }
}

/// Returns the fields of a missing value, with the status in its place (OPC 10000-14, 7.2.4.5.5).
pub(crate) fn no_value(status: StatusCode) -> Vec<u8> {
    value::fields_block(&[Variant::StatusCode(status)]).unwrap_or_default()
}

/// Returns true if a value has the same meaning here as at its server. Structures and NodeIds
/// depend on the namespaces of that server.
fn is_carried(value: &Variant) -> bool {
    let known = |node: &NodeId| node.namespace == 0;
    match value {
        Variant::NodeId(node) => known(node),
        Variant::ExpandedNodeId(node) => known(&node.node_id) && node.server_index == 0,
        Variant::QualifiedName(name) => name.namespace_index == 0,
        Variant::ExtensionObject(object) => known(&object.binary_type_id().node_id),
        Variant::Variant(inner) => is_carried(inner),
        Variant::DataValue(inner) => inner.value.as_ref().is_none_or(is_carried),
        Variant::Array(array) => array.values.iter().all(is_carried),
        Variant::Empty
        | Variant::Boolean(_)
        | Variant::SByte(_)
        | Variant::Byte(_)
        | Variant::Int16(_)
        | Variant::UInt16(_)
        | Variant::Int32(_)
        | Variant::UInt32(_)
        | Variant::Int64(_)
        | Variant::UInt64(_)
        | Variant::Float(_)
        | Variant::Double(_)
        | Variant::String(_)
        | Variant::DateTime(_)
        | Variant::Guid(_)
        | Variant::StatusCode(_)
        | Variant::ByteString(_)
        | Variant::XmlElement(_)
        | Variant::LocalizedText(_)
        | Variant::DiagnosticInfo(_) => true,
    }
}

/// Returns the single value in the fields of a DataSet, or `None` if there is no value or several.
fn one_value(block: &[u8]) -> Option<Variant> {
    let mut fields = Fields::parse(block).ok()?;
    if fields.len() != 1 {
        return None;
    }
    let field = fields.next()?.ok()?;
    let value = value::from_field(&field);
    (!matches!(value, Variant::Empty)).then_some(value)
}

/// Largest number of values that wait for the run loop. Beyond it, reading is delayed and values
/// stay in the queues of the servers.
const MOST_NEWS: usize = 1_024;

#[cfg(test)]
mod tests {
    use opcua::types::DateTime;

    use super::*;

    fn topic() -> TopicId {
        TopicId::new(0, 2, 10).unwrap()
    }

    fn only(block: &[u8]) -> Variant {
        let field = Fields::parse(block).unwrap().next().unwrap().unwrap();
        value::from_field(&field)
    }

    #[test]
    fn a_value_keeps_its_time_and_its_quality() {
        let at = DateTime::from(134_234_948_967_890_000);
        let value = DataValue {
            value: Some(Variant::Double(1.5)),
            status: Some(StatusCode::UncertainLastUsableValue),
            source_timestamp: Some(at),
            ..DataValue::default()
        };
        let told = sourced(topic(), &value);
        assert_eq!(only(&told.block), Variant::Double(1.5));
        assert_eq!(told.status, StatusCode::UncertainLastUsableValue);
        assert_eq!(told.taken.time.0, 134_234_948_967_890_000);
    }

    #[test]
    fn what_is_no_value_says_why() {
        let bad = |value: Option<Variant>, status: Option<StatusCode>| {
            let told = sourced(
                topic(),
                &DataValue {
                    value,
                    status,
                    ..DataValue::default()
                },
            );
            assert_eq!(only(&told.block), Variant::StatusCode(told.status));
            told.status
        };
        let failed = StatusCode::BadSensorFailure;
        assert_eq!(bad(Some(Variant::Double(7.0)), Some(failed)), failed);
        assert_eq!(bad(None, None), StatusCode::BadNoData);
        // The NodeId depends on the namespaces of that server.
        let node = Variant::from(NodeId::new(3, "x"));
        assert_eq!(
            bad(Some(node), None),
            StatusCode::BadDataEncodingUnsupported
        );
    }
}
