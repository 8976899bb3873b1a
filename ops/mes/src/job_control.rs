//! Job Control (OPC 10031-4) in the OPC UA server of the MES: a receiver of job orders, and a
//! provider of job responses.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use plant_opcua::job_control::{
    JobOrder, JobOrderAndState, JobResponse, JobTypes, NAMESPACE, NODESET, OptionalArray,
    Parameter, State,
};
use plant_opcua::server::{
    IdRange, Instance, InstanceError, InstanceSpec, MethodRefusal, MethodRequest, OpcUaServer,
    ServerBuilder, method,
};
use plant_opcua::types::{
    DataValue, DateTime, ExtensionObject, LocalizedText, NodeId, QualifiedName, RelativePath,
    StatusCode, Variant,
};
use plant_opcua::users::UserAccess;
use serde_json::Value as Json;
use tokio::runtime::Handle;
use tracing::{info, warn};

use crate::job_order::{KeptJobOrder, MOST_ORDERS};
use crate::job_orders::{CommandStatus, JobCommand, JobRuns, Orders};
use crate::jobs::ProcessJobs;

/// The objects of Job Control.
#[derive(Clone)]
pub(crate) struct JobControl(Arc<Inner>);

struct Inner {
    jobs: Arc<ProcessJobs>,
    orders: Mutex<Orders>,
    runtime: Handle,
}

impl std::fmt::Debug for JobControl {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("JobControl").finish_non_exhaustive()
    }
}

/// A place where the job orders are shown.
#[derive(Clone)]
struct Shown {
    server: OpcUaServer,
    list: Option<NodeId>,
}

impl JobControl {
    /// Creates the objects for the jobs and the job orders of the MES.
    pub(crate) fn new(jobs: Arc<ProcessJobs>, orders: Orders, runtime: Handle) -> Self {
        Self(Arc::new(Inner {
            jobs,
            orders: Mutex::new(orders),
            runtime,
        }))
    }

    fn orders(&self) -> MutexGuard<'_, Orders> {
        let orders = self.0.orders.lock();
        orders.unwrap_or_else(PoisonError::into_inner)
    }

    fn jobs(&self) -> &dyn JobRuns {
        &*self.0.jobs
    }

    /// Executes a method with a job order.
    fn with_order(
        &self,
        (name, request): (&str, &MethodRequest),
        shown: &Shown,
    ) -> Result<Vec<Variant>, MethodRefusal> {
        let order = match request.arguments.first() {
            Some(Variant::ExtensionObject(object)) => object.inner_as::<JobOrder>().cloned(),
            _ => None,
        };
        let order = order.ok_or_else(|| {
            MethodRefusal::Arguments(vec![StatusCode::BadInvalidArgument, StatusCode::Good])
        })?;
        let (runs, id) = (self.jobs(), order.id.clone());
        let status = {
            let mut orders = self.orders();
            match name {
                "Update" => orders.update(order, runs),
                "Store" => orders.store(order, runs),
                _ => {
                    let stored = orders.store(order, runs);
                    if stored == CommandStatus::Good {
                        orders.command(id.as_ref(), JobCommand::Start, runs)
                    } else {
                        stored
                    }
                }
            }
        };
        info!(order = id.as_ref(), ?status, "{name} of a job order");
        self.show(shown);
        Ok(vec![Variant::from(status.bits())])
    }

    /// Executes a method with the ID of a job order.
    fn with_id(
        &self,
        command: JobCommand,
        request: &MethodRequest,
        shown: &Shown,
    ) -> Result<Vec<Variant>, MethodRefusal> {
        let id = text(request)?;
        let status = self.orders().command(&id, command, self.jobs());
        info!(order = id, ?status, "{command:?} of a job order");
        self.show(shown);
        Ok(vec![Variant::from(status.bits())])
    }

    /// Returns the response of a job order by its ID.
    fn response_by_id(&self, request: &MethodRequest) -> Result<Vec<Variant>, MethodRefusal> {
        let id = text(request)?;
        let orders = self.orders();
        let (response, status) = match orders.order(&id) {
            Some(order) => (response(order), CommandStatus::Good),
            None => (JobResponse::default(), CommandStatus::UnknownOrder),
        };
        let response = ExtensionObject::from_message(response);
        Ok(vec![Variant::from(response), Variant::from(status.bits())])
    }

    /// Returns the responses of the job orders in a state.
    fn responses_by_state(&self, request: &MethodRequest) -> Result<Vec<Variant>, MethodRefusal> {
        let wanted = match request.arguments.first() {
            Some(Variant::Array(states)) => states.values.first(),
            _ => None,
        };
        let wanted = match wanted {
            Some(Variant::ExtensionObject(object)) => object.inner_as::<State>(),
            _ => None,
        };
        let Some(wanted) = wanted else {
            return Ok(vec![
                Variant::from(Vec::<ExtensionObject>::new()),
                Variant::from(CommandStatus::InvalidRequest.bits()),
            ]);
        };
        let orders = self.orders();
        let of_state = orders.all().iter();
        let of_state = of_state.filter(|order| order.state.number() == wanted.number);
        let responses: Vec<ExtensionObject> = of_state
            .map(|order| ExtensionObject::from_message(response(order)))
            .collect();
        Ok(vec![
            Variant::from(responses),
            Variant::from(CommandStatus::Good.bits()),
        ])
    }

    /// Shows the job orders.
    fn show(&self, shown: &Shown) {
        let Some(list) = &shown.list else { return };
        // Locked until the list is shown, so that no older list replaces it.
        let orders = self.orders();
        let one = |order: &KeptJobOrder| {
            ExtensionObject::from_message(JobOrderAndState {
                order: order.order.clone(),
                states: Some(vec![state(order)]),
            })
        };
        let all: Vec<ExtensionObject> = orders.all().iter().map(one).collect();
        let value = DataValue::new_now(Variant::from(all));
        if let Err(status) = shown.server.show_value(list, value) {
            warn!(%status, "cannot show the job orders");
        }
        drop(orders);
    }

    /// Follows the runs of the job orders.
    async fn follow(self, shown: Shown) {
        loop {
            tokio::time::sleep(POLL).await;
            let has_changed = self.orders().poll(self.jobs());
            if has_changed {
                self.show(&shown);
            }
        }
    }
}

impl skills::server::Extension for JobControl {
    fn prepare(&self, builder: ServerBuilder) -> ServerBuilder {
        builder
            .nodeset_str(NAMESPACE, NODESET)
            .types(Arc::new(JobTypes))
    }

    fn serve(
        &self,
        (server, _): (&OpcUaServer, &UserAccess),
        component: &NodeId,
        ids: &mut IdRange,
    ) -> Result<(), InstanceError> {
        let index = server.namespace(NAMESPACE).unwrap_or_default();
        let mut object = |type_name: &str, name: &str| -> Result<Instance, InstanceError> {
            let of_type = server
                .find_type(NAMESPACE, type_name)
                .ok_or_else(|| InstanceError::NoType(NodeId::null()))?;
            let name = QualifiedName::new(index, name);
            let spec = InstanceSpec::new(of_type, ids.next(), name, component.clone());
            server.instantiate(&spec, &mut |_| ids.next())
        };
        let receiver = object("ISA95JobOrderReceiverObjectType", "JobOrderReceiver")?;
        let provider = object("ISA95JobResponseProviderObjectType", "JobResponseProvider")?;
        let shown = Shown {
            server: server.clone(),
            list: receiver.node("JobOrderList").cloned(),
        };
        if let Some(most) = receiver.node("MaxDownloadableJobOrders") {
            let count = u16::try_from(MOST_ORDERS).unwrap_or(u16::MAX);
            if let Err(status) = server.show(most, count) {
                warn!(%status, "cannot show the number of job orders");
            }
        }
        for name in ["Store", "StoreAndStart", "Update"] {
            let (own, shown) = (self.clone(), shown.clone());
            on_call(server, &receiver, name, move |request| {
                own.with_order((name, request), &shown)
            });
        }
        for (name, command) in COMMANDS {
            let (own, shown) = (self.clone(), shown.clone());
            on_call(server, &receiver, name, move |request| {
                own.with_id(command, request, &shown)
            });
        }
        let own = self.clone();
        on_call(
            server,
            &provider,
            "RequestJobResponseByJobOrderID",
            move |request| own.response_by_id(request),
        );
        let own = self.clone();
        on_call(
            server,
            &provider,
            "RequestJobResponseByJobOrderState",
            move |request| own.responses_by_state(request),
        );
        self.show(&shown);
        drop(self.0.runtime.spawn(self.clone().follow(shown)));
        Ok(())
    }
}

fn on_call(
    server: &OpcUaServer,
    object: &Instance,
    name: &str,
    call: impl Fn(&MethodRequest) -> Result<Vec<Variant>, MethodRefusal> + Send + Sync + 'static,
) {
    match object.node(name) {
        Some(node) => server.on_call(&object.node_id, node, method(move |request| call(&request))),
        None => warn!(method = name, "a method of Job Control has no node"),
    }
}

/// Returns the text of the first argument.
fn text(request: &MethodRequest) -> Result<String, MethodRefusal> {
    match request.arguments.first() {
        Some(Variant::String(text)) => Ok(text.as_ref().to_owned()),
        _ => Err(StatusCode::BadInvalidArgument.into()),
    }
}

fn state(order: &KeptJobOrder) -> State {
    State {
        path: RelativePath::default(),
        text: LocalizedText::new("en", order.state.name()),
        number: order.state.number(),
    }
}

fn response(order: &KeptJobOrder) -> JobResponse {
    let progress = order.progress.as_ref();
    let time = |ms: u64| {
        DateTime::from(
            i64::try_from(ms)
                .unwrap_or(i64::MAX)
                .saturating_mul(10_000)
                .saturating_add(TICKS_TO_1970),
        )
    };
    let mut data: Vec<Parameter> = progress
        .iter()
        .flat_map(|progress| &progress.results)
        .map(|(name, value)| parameter(name, value))
        .collect();
    if let Some(reason) = &order.reason {
        data.push(parameter("Reason", &Json::from(reason.as_str())));
    }
    JobResponse {
        id: order.order.id.clone(),
        order_id: order.order.id.clone(),
        start: progress.map(|progress| time(progress.started_ms)),
        end: progress.and_then(|progress| progress.ended_ms).map(time),
        states: Some(vec![state(order)]),
        data: Some(OptionalArray(data)),
        ..JobResponse::default()
    }
}

/// Returns a named value; structured values are texts of JSON.
fn parameter(name: &str, value: &Json) -> Parameter {
    let value = match value {
        Json::Bool(value) => Variant::from(*value),
        Json::Number(number) => Variant::from(number.as_f64().unwrap_or(f64::NAN)),
        Json::String(text) => Variant::from(text.as_str()),
        Json::Null | Json::Array(_) | Json::Object(_) => Variant::from(value.to_string().as_str()),
    };
    Parameter {
        id: name.into(),
        value,
        ..Parameter::default()
    }
}

const COMMANDS: [(&str, JobCommand); 8] = [
    ("Start", JobCommand::Start),
    ("RevokeStart", JobCommand::RevokeStart),
    ("Pause", JobCommand::Pause),
    ("Resume", JobCommand::Resume),
    ("Stop", JobCommand::Stop),
    ("Abort", JobCommand::Abort),
    ("Cancel", JobCommand::Cancel),
    ("Clear", JobCommand::Clear),
];
const POLL: Duration = Duration::from_millis(200);
/// Ticks of 100 ns from 1601 to 1970.
const TICKS_TO_1970: i64 = 116_444_736_000_000_000;
