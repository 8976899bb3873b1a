//! `ua-space pea`: simulates the process module of a manifest as an OPC UA server.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use ::mtp::pea::{Pea, PeaFaults, PeaRefusal, PeaValue};
use ::mtp::state::State;
use ::mtp::{Module, NodeIdentifier, OpcUaNode};
use plant_opcua::server::{
    EndpointUrl, ObjectSpec, OpcUaServer, ServerBuilder, ServerConfig, VariableSpec, WriteRequest,
    write as write_handler,
};
use plant_opcua::types::{
    DataTypeId, DataValue, LocalizedText, NodeId, ObjectId, ObjectTypeId, QualifiedName,
    ReferenceTypeId, StatusCode, UAString, VariableTypeId, Variant,
};
use tokio::time::{Instant, MissedTickBehavior};

use crate::arguments::PeaArguments;
use crate::exit::CommandFailure;
use crate::interrupt::SignalGuard;
use crate::report::say;
use crate::survey::look;

/// Runs `ua-space pea` until SIGINT or SIGTERM.
pub(crate) fn pea(arguments: &PeaArguments) -> Result<(), CommandFailure> {
    let module = crate::manifest::read(&arguments.file)?;
    let endpoint: EndpointUrl = arguments
        .listen
        .parse()
        .map_err(|error| CommandFailure::Usage(format!("{}: {error}", arguments.listen)))?;
    let stuck_in = match &arguments.stuck_in {
        Some(name) => Some(State::of_name(name).ok_or_else(|| {
            let known: Vec<&str> = State::ALL.iter().map(|state| state.name()).collect();
            CommandFailure::Usage(format!(
                "`{name}` is no state; there are {}",
                known.join(", ")
            ))
        })?),
        None => None,
    };
    let pea = Pea::new(&module)
        .with_times(seconds(arguments.acting), seconds(arguments.executing))
        .with_faults(PeaFaults {
            keeps_command: arguments.keeps_command,
            enables_late: arguments.enables_late,
            resetting_word: arguments.resetting_word,
            stays_in_operator_mode: arguments.operator_mode,
            ignores_procedure: arguments.ignores_procedure,
            stuck_in,
        });
    look(async {
        let mut interrupt = SignalGuard::catch()?;
        let server = serve(&module, pea, endpoint)?;
        say(&format!("{} is at {}", module.name, server.url()))?;
        interrupt.received().await;
        server.stop().await;
        Ok(())
    })
}

/// The simulated module, and the values to publish.
struct Simulated {
    pea: Pea,
    advanced: Instant,
    /// The remaining number of times that a changed item is published. The server stores a written
    /// value after its handler, so the value of the module is published again.
    pending: BTreeMap<String, u8>,
}

impl Simulated {
    fn advance(&mut self) {
        let now = Instant::now();
        self.pea.advance(now - self.advanced);
        self.advanced = now;
        for item in self.pea.take_changes() {
            self.pending.insert(item, PUBLISHED);
        }
    }
}

fn serve(module: &Module, pea: Pea, endpoint: EndpointUrl) -> Result<OpcUaServer, CommandFailure> {
    let uri = format!("urn:ua-bridge:pea:{}", ::mtp::escaped(&module.name));
    let config = ServerConfig::new(&uri, &module.name, endpoint);
    let mut builder = ServerBuilder::new(config);
    for namespace in namespaces(module)? {
        builder = builder.namespace(&namespace);
    }
    let server = builder
        .build()
        .map_err(|error| CommandFailure::Unavailable(error.to_string()))?;
    let wrong =
        |error: &dyn std::fmt::Display| CommandFailure::Data(format!("the address space: {error}"));
    let folder = NodeId::new(1, "Module");
    server
        .add_object(&ObjectSpec {
            node_id: folder.clone(),
            browse_name: QualifiedName::new(1, module.name.as_str()),
            display_name: LocalizedText::from(module.name.as_str()),
            type_definition: ObjectTypeId::FolderType.into(),
            parent: ObjectId::ObjectsFolder.into(),
            reference: ReferenceTypeId::Organizes.into(),
            event_notifier: false,
        })
        .map_err(|error| wrong(&error))?;
    let mut ids: BTreeMap<String, NodeId> = BTreeMap::new();
    let mut made = BTreeSet::new();
    let simulated = Arc::new(Mutex::new(Simulated {
        pea,
        advanced: Instant::now(),
        pending: BTreeMap::new(),
    }));
    for item in &module.items {
        let Some(id) = node_id(&server, &item.node) else {
            continue;
        };
        // Two items may describe one node.
        if !made.insert(id.to_string()) {
            continue;
        }
        let Some(value) = lock(&simulated).pea.value(&item.node.item).cloned() else {
            continue;
        };
        server
            .add_variable(&VariableSpec {
                node_id: id.clone(),
                browse_name: QualifiedName::new(id.namespace, item.name.as_str()),
                display_name: LocalizedText::from(item.name.as_str()),
                type_definition: VariableTypeId::BaseDataVariableType.into(),
                parent: folder.clone(),
                reference: ReferenceTypeId::HasComponent.into(),
                data_type: data_type(&value),
                value_rank: -1,
                value: DataValue::new_now(variant(&value)),
                writable: item.node.access.writes,
            })
            .map_err(|error| wrong(&error))?;
        if item.node.access.writes {
            let simulated = Arc::clone(&simulated);
            let key = item.node.item.clone();
            let handler = move |request: WriteRequest| written(&simulated, &key, &request);
            server.on_write(&id, write_handler(handler));
        }
        ids.insert(item.node.item.clone(), id);
    }
    server.start();
    drop(tokio::spawn(run(server.clone(), simulated, ids)));
    Ok(server)
}

/// Returns the namespaces to register. Indexes in place of URIs are filled up with names.
fn namespaces(module: &Module) -> Result<Vec<String>, CommandFailure> {
    let mut uris: Vec<String> = Vec::new();
    let mut highest: u16 = 0;
    for item in &module.items {
        let namespace = &item.node.namespace;
        match namespace.parse::<u16>() {
            Ok(index) if index > MOST_NAMESPACES => {
                let why = format!("{}: the namespace index {index} is too large", item.name);
                return Err(CommandFailure::Data(why));
            }
            Ok(index) => highest = highest.max(index),
            Err(_) if !uris.contains(namespace) => uris.push(namespace.clone()),
            Err(_) => {}
        }
    }
    // Index 0 is OPC UA, and 1 the ApplicationUri.
    for index in 2..=highest {
        if uris.len() + 2 <= usize::from(index) {
            uris.push(format!("urn:ua-bridge:pea:namespace:{index}"));
        }
    }
    Ok(uris)
}

fn node_id(server: &OpcUaServer, node: &OpcUaNode) -> Option<NodeId> {
    let index = match node.namespace.parse() {
        Ok(index) => index,
        Err(_) => server.namespace(&node.namespace)?,
    };
    Some(match &node.identifier {
        NodeIdentifier::Numeric(number) => NodeId::new(index, *number),
        NodeIdentifier::Text(text) => NodeId::new(index, text.as_str()),
    })
}

fn written(
    simulated: &Mutex<Simulated>,
    item: &str,
    request: &WriteRequest,
) -> Result<(), StatusCode> {
    let mut simulated = lock(simulated);
    simulated.advance();
    let known = simulated.pea.value(item).cloned();
    let given = request.value.value.as_ref();
    let value = known
        .zip(given)
        .and_then(|(known, given)| read_as(&known, given));
    let value = value.ok_or(StatusCode::BadTypeMismatch)?;
    let written = simulated.pea.write(item, value);
    written.map_err(|refusal| match refusal {
        PeaRefusal::Unknown => StatusCode::BadNodeIdUnknown,
        PeaRefusal::ReadOnly => StatusCode::BadNotWritable,
        PeaRefusal::WrongType => StatusCode::BadTypeMismatch,
    })?;
    simulated.pending.insert(item.to_owned(), PUBLISHED);
    simulated.advance();
    Ok(())
}

/// Advances the module, and publishes changed values.
async fn run(server: OpcUaServer, simulated: Arc<Mutex<Simulated>>, ids: BTreeMap<String, NodeId>) {
    let mut tick = tokio::time::interval(TICK);
    tick.set_missed_tick_behavior(MissedTickBehavior::Delay);
    loop {
        tick.tick().await;
        let changed: Vec<(NodeId, DataValue)> = {
            let mut simulated = lock(&simulated);
            simulated.advance();
            let items: Vec<String> = simulated.pending.keys().cloned().collect();
            simulated.pending.retain(|_, times| {
                *times = times.saturating_sub(1);
                *times > 0
            });
            items
                .iter()
                .filter_map(|item| {
                    let value = simulated.pea.value(item)?;
                    Some((ids.get(item)?.clone(), DataValue::new_now(variant(value))))
                })
                .collect()
        };
        if !changed.is_empty() && server.show_all(changed).is_err() {
            return;
        }
    }
}

fn lock(simulated: &Mutex<Simulated>) -> MutexGuard<'_, Simulated> {
    simulated.lock().unwrap_or_else(PoisonError::into_inner)
}

fn variant(value: &PeaValue) -> Variant {
    match value {
        PeaValue::Boolean(value) => Variant::Boolean(*value),
        PeaValue::Byte(value) => Variant::Byte(*value),
        PeaValue::Word(value) => Variant::UInt32(*value),
        PeaValue::Integer(value) => Variant::Int32(*value),
        PeaValue::Number(value) => Variant::Float(*value),
        PeaValue::Text(value) => Variant::String(UAString::from(value.as_str())),
    }
}

fn data_type(value: &PeaValue) -> NodeId {
    match value {
        PeaValue::Boolean(_) => DataTypeId::Boolean,
        PeaValue::Byte(_) => DataTypeId::Byte,
        PeaValue::Word(_) => DataTypeId::UInt32,
        PeaValue::Integer(_) => DataTypeId::Int32,
        PeaValue::Number(_) => DataTypeId::Float,
        PeaValue::Text(_) => DataTypeId::String,
    }
    .into()
}

/// Returns a written value in the type of a node; `None` for another type.
fn read_as(known: &PeaValue, given: &Variant) -> Option<PeaValue> {
    Some(match (known, given) {
        (PeaValue::Boolean(_), Variant::Boolean(value)) => PeaValue::Boolean(*value),
        (PeaValue::Byte(_), Variant::Byte(value)) => PeaValue::Byte(*value),
        (PeaValue::Word(_), Variant::UInt32(value)) => PeaValue::Word(*value),
        (PeaValue::Integer(_), Variant::Int32(value)) => PeaValue::Integer(*value),
        (PeaValue::Number(_), Variant::Float(value)) => PeaValue::Number(*value),
        (PeaValue::Text(_), Variant::String(value)) => PeaValue::Text(value.as_ref().to_owned()),
        _ => return None,
    })
}

fn seconds(seconds: f64) -> Duration {
    Duration::try_from_secs_f64(seconds).unwrap_or_default()
}

const TICK: Duration = Duration::from_millis(10);
const PUBLISHED: u8 = 3;
const MOST_NAMESPACES: u16 = 1000;
