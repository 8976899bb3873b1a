//! A server with two NodeSets, and its clients.

#![allow(
    dead_code,
    clippy::allow_attributes,
    clippy::expect_used,
    reason = "each test takes what it needs"
)]

use std::time::Duration;

use opcua::types::{
    DataTypeId, DataValue, LocalizedText, NodeId, ObjectId, QualifiedName, ReferenceTypeId,
    StatusCode, VariableTypeId, Variant,
};
use plant_opcua::client::{ClientConfig, ClientSubscription, Notice, OpcUaClient};
use plant_opcua::server::{
    IdRange, Instance, InstanceSpec, OpcUaServer, ServerBuilder, ServerConfig, VariableSpec,
};

pub(crate) const MACHINES: &str = "urn:test:machines";
pub(crate) const VENDOR: &str = "urn:test:vendor";
/// A timeout that is long enough on a busy machine.
pub(crate) const PATIENCE: Duration = Duration::from_secs(20);

pub(crate) struct OpcuaCell {
    pub(crate) server: OpcUaServer,
}

impl OpcuaCell {
    pub(crate) fn new() -> Self {
        Self::at("opc.tcp://127.0.0.1:0")
    }

    pub(crate) fn at(url: &str) -> Self {
        Self::with(ServerConfig::new(
            "urn:test:cell",
            "Cell",
            url.parse().unwrap(),
        ))
    }

    pub(crate) fn with(config: ServerConfig) -> Self {
        let server = ServerBuilder::new(config)
            .nodeset_str("vendor.xml", include_str!("../data/vendor.xml"))
            .nodeset_str("machines.xml", include_str!("../data/machines.xml"))
            .build()
            .unwrap();
        server.start();
        Self { server }
    }

    pub(crate) async fn client(&self) -> OpcUaClient {
        let client = OpcUaClient::open(config(), self.server.url());
        client.up(PATIENCE).await.unwrap();
        client
    }
}

pub(crate) fn config() -> ClientConfig {
    let mut config = ClientConfig::new("urn:test:client", "Client");
    config.timeout = PATIENCE;
    config
}

/// Creates a press with the NodeIds from `first`.
pub(crate) fn press(server: &OpcUaServer, first: u32, optional: &[&str]) -> Instance {
    let type_id = server.find_type(VENDOR, "PressType").unwrap();
    let mut spec = InstanceSpec::new(
        type_id,
        NodeId::new(1, first),
        QualifiedName::new(1, format!("Press {first}")),
        ObjectId::ObjectsFolder.into(),
    );
    spec.reference = ReferenceTypeId::Organizes.into();
    spec.optional = optional.iter().map(|path| (*path).to_owned()).collect();
    spec.interfaces = vec![server.find_type(MACHINES, "INameplateType").unwrap()];
    spec.event_notifier = true;
    let mut ids = IdRange::new(1, first + 1);
    server.instantiate(&spec, &mut |_| ids.next()).unwrap()
}

pub(crate) fn variable(node: &NodeId, parent: &NodeId, n: usize) -> VariableSpec {
    VariableSpec {
        node_id: node.clone(),
        browse_name: QualifiedName::new(1, format!("v{n}")),
        display_name: LocalizedText::from(format!("v{n}")),
        type_definition: VariableTypeId::BaseDataVariableType.into(),
        parent: parent.clone(),
        reference: ReferenceTypeId::Organizes.into(),
        data_type: DataTypeId::UInt32.into(),
        value_rank: -1,
        value: DataValue::new_now(u32::try_from(n).unwrap()),
        writable: false,
    }
}

pub(crate) async fn next(subscription: &mut ClientSubscription) -> Notice {
    let next = tokio::time::timeout(PATIENCE, subscription.next());
    next.await
        .expect("nothing comes")
        .expect("the client is closed")
}

/// Waits for the next value.
pub(crate) async fn next_value(subscription: &mut ClientSubscription) -> (usize, Option<Variant>) {
    loop {
        match next(subscription).await {
            Notice::Value { watch, value } => return (watch, value.value),
            Notice::Refused { watch, status } => panic!("watch {watch} is refused: {status}"),
            Notice::Subscribed | Notice::Event { .. } => {}
        }
    }
}

/// Waits for the status of the next value.
pub(crate) async fn next_status(subscription: &mut ClientSubscription) -> StatusCode {
    loop {
        if let Notice::Value { value, .. } = next(subscription).await {
            return value.status.unwrap_or(StatusCode::Good);
        }
    }
}

/// Waits for the next event, until the timeout.
pub(crate) async fn next_event(
    subscription: &mut ClientSubscription,
    within: Duration,
) -> Option<(usize, Vec<Variant>)> {
    loop {
        match tokio::time::timeout(within, subscription.next()).await {
            Ok(Some(Notice::Event { watch, fields })) => return Some((watch, fields)),
            Ok(Some(Notice::Refused { watch, status })) => panic!("watch {watch}: {status}"),
            Ok(Some(_)) => {}
            Ok(None) => panic!("the client is closed"),
            Err(_) => return None,
        }
    }
}
