//! Methods of our objects: which handler a call goes to, and what is checked before.

use std::collections::HashMap;
use std::future::Future;
use std::sync::{Arc, OnceLock};
use std::time::Duration;

use async_trait::async_trait;
use opcua::nodes::{NodeType, TypeTree};
use opcua::server::node_manager::{MethodCall, RequestContext};
use opcua::sync::RwLock;
use opcua::types::{
    Argument, DataEncoding, DataTypeId, DataValue, NodeId, NumericRange, StatusCode,
    TimestampsToReturn, Variant,
};
use tokio::time::{Instant, timeout_at};

use super::nodes::Spaces;
use super::sessions::{Caller, Presence, Sessions};
use crate::client::CallResult;
use crate::limits::LONGEST_REQUEST;

/// A call that has passed the checks of number and types of its arguments.
#[derive(Debug, Clone)]
pub struct MethodRequest {
    /// Who calls.
    pub caller: Caller,
    /// Whether its session is still there.
    pub presence: Presence,
    /// The object.
    pub object: NodeId,
    /// The method of the object, also where the client gave that of its type.
    pub method: NodeId,
    /// The name in the BrowseName of the method.
    pub name: String,
    /// One for each input argument the method declares.
    pub arguments: Vec<Variant>,
}

/// Why a call is refused.
#[derive(Debug, Clone, PartialEq)]
pub enum Refusal {
    /// With this status.
    Status(StatusCode),
    /// With `BadInvalidArgument` and this status for each argument.
    Arguments(Vec<StatusCode>),
    /// The result of a call at another server, which reaches the client unchanged: its status may also be Good or Uncertain.
    PassedOn(Box<CallResult>),
}

impl From<StatusCode> for Refusal {
    fn from(status: StatusCode) -> Self {
        Self::Status(status)
    }
}

/// What carries out the calls of a method. A call that takes longer than [`longest`](Self::longest) is given up.
#[async_trait]
pub trait MethodHandler: Send + Sync + 'static {
    /// How long a call may take.
    fn longest(&self) -> Duration {
        LONGEST_REQUEST
    }

    /// The output arguments.
    ///
    /// # Errors
    /// Why the call is refused.
    async fn call(&self, request: MethodRequest) -> Result<Vec<Variant>, Refusal>;
}

struct Function<F>(F);

#[async_trait]
impl<F> MethodHandler for Function<F>
where
    F: Fn(MethodRequest) -> Result<Vec<Variant>, Refusal> + Send + Sync + 'static,
{
    async fn call(&self, request: MethodRequest) -> Result<Vec<Variant>, Refusal> {
        (self.0)(request)
    }
}

/// A handler that answers at once.
pub fn method<F>(function: F) -> Arc<dyn MethodHandler>
where
    F: Fn(MethodRequest) -> Result<Vec<Variant>, Refusal> + Send + Sync + 'static,
{
    Arc::new(Function(function))
}

/// A method of an object.
struct Route {
    name: String,
    handler: Option<Arc<dyn MethodHandler>>,
}

/// Object and method.
type Key = (NodeId, NodeId);

#[derive(Default)]
pub(crate) struct Calls {
    routes: RwLock<HashMap<Key, Route>>,
    /// The methods the types of an object declare, and which of its own each is.
    declared: RwLock<HashMap<Key, NodeId>>,
    pub(crate) sessions: Arc<Sessions>,
    pub(crate) spaces: OnceLock<Arc<Spaces>>,
}

impl Calls {
    /// Takes up a method of an object, also under the declarations it was made from.
    pub(crate) fn add(&self, object: &NodeId, method: &NodeId, name: &str, declared: &[NodeId]) {
        let route = Route {
            name: name.to_owned(),
            handler: None,
        };
        let key = (object.clone(), method.clone());
        self.routes.write().insert(key, route);
        let mut table = self.declared.write();
        for declaration in declared {
            table.insert((object.clone(), declaration.clone()), method.clone());
        }
    }

    pub(crate) fn remove(&self, node: &NodeId) {
        let gone = |(object, method): &Key| object == node || method == node;
        self.routes.write().retain(|key, _| !gone(key));
        self.declared
            .write()
            .retain(|key, method| !gone(key) && method != node);
    }

    pub(crate) fn handle(&self, object: &NodeId, method: &NodeId, handler: Arc<dyn MethodHandler>) {
        let mut routes = self.routes.write();
        let route = routes
            .entry((object.clone(), method.clone()))
            .or_insert_with(|| Route {
                name: String::new(),
                handler: None,
            });
        route.handler = Some(handler);
    }

    /// Answers the calls of methods of our objects, one after the other, and gives back the rest.
    pub(crate) async fn answer<'a>(
        &self,
        context: &RequestContext,
        methods: &'a mut [&mut MethodCall],
    ) -> Vec<&'a mut MethodCall> {
        let mut others = Vec::new();
        let begun = Instant::now();
        for call in methods {
            let call: &'a mut MethodCall = call;
            match self.route(call) {
                Some(Err(status)) => call.set_status(status),
                Some(Ok((method, name, handler))) => {
                    let checked = self.check(context, &method, call.arguments());
                    let request = MethodRequest {
                        caller: self.sessions.caller(context),
                        presence: Presence::of(context),
                        object: call.object_id().clone(),
                        method,
                        name,
                        arguments: call.arguments().to_vec(),
                    };
                    let ended = match checked {
                        Ok(()) => {
                            let until = begun + handler.longest();
                            within(until, handler.call(request)).await
                        }
                        Err(refusal) => Err(refusal),
                    };
                    end(call, ended);
                }
                None => others.push(call),
            }
        }
        others
    }

    /// Where a call goes; `None` for objects that are not ours.
    #[expect(
        clippy::type_complexity,
        reason = "said in one place, taken apart in one place"
    )]
    fn route(
        &self,
        call: &MethodCall,
    ) -> Option<Result<(NodeId, String, Arc<dyn MethodHandler>), StatusCode>> {
        let object = call.object_id();
        let spaces = self.spaces.get()?;
        if !spaces.owns(object) {
            return None;
        }
        if !spaces.own().read().node_exists(object) {
            return Some(Err(StatusCode::BadNodeIdUnknown));
        }
        let given = (object.clone(), call.method_id().clone());
        let method = self.declared.read().get(&given).cloned();
        let key = method.map_or(given, |method| (object.clone(), method));
        let routes = self.routes.read();
        let route = routes.get(&key)?;
        Some(match &route.handler {
            Some(handler) => Ok((key.1, route.name.clone(), Arc::clone(handler))),
            // A handler is asked even where Executable is false: it says why it cannot be done now.
            None if !spaces.executable(&key.1) => Err(StatusCode::BadNotExecutable),
            None => Err(StatusCode::BadNotImplemented),
        })
    }

    fn check(
        &self,
        context: &RequestContext,
        method: &NodeId,
        given: &[Variant],
    ) -> Result<(), Refusal> {
        let Some(spaces) = self.spaces.get() else {
            return Err(Refusal::Status(StatusCode::BadShutdown));
        };
        let declared = spaces.input_arguments(method)?;
        let types = context.type_tree.read();
        check_arguments(&declared, given, &*types)
    }
}

/// Tells a client what became of its call.
pub(crate) fn end(call: &mut MethodCall, ended: Result<Vec<Variant>, Refusal>) {
    match ended {
        Ok(outputs) => {
            call.set_outputs(outputs);
            call.set_status(StatusCode::Good);
        }
        Err(Refusal::Status(status)) => call.set_status(status),
        Err(Refusal::Arguments(each)) => call.set_argument_error(each),
        Err(Refusal::PassedOn(result)) => {
            // There is nothing to say of arguments that are all good (OPC 10000-4, 5.12.2.2).
            if result.arguments.iter().any(|one| !one.is_good()) {
                // Also sets the status, which is replaced below.
                call.set_argument_error(result.arguments);
            }
            call.set_outputs(result.outputs);
            call.set_status(result.status);
        }
    }
}

/// Whether arguments are as many as are declared, and of their types (OPC 10000-4, 5.12.2).
///
/// # Errors
/// What is wrong with them.
pub(crate) fn check_arguments(
    declared: &[Argument],
    given: &[Variant],
    types: &dyn TypeTree,
) -> Result<(), Refusal> {
    if given.len() < declared.len() {
        return Err(Refusal::Status(StatusCode::BadArgumentsMissing));
    }
    if given.len() > declared.len() {
        return Err(Refusal::Status(StatusCode::BadTooManyArguments));
    }
    let each: Vec<StatusCode> = declared
        .iter()
        .zip(given)
        .map(|(declared, value)| {
            if fits(value, &declared.data_type, declared.value_rank, types) {
                StatusCode::Good
            } else {
                StatusCode::BadTypeMismatch
            }
        })
        .collect();
    if each.contains(&StatusCode::BadTypeMismatch) {
        return Err(Refusal::Arguments(each));
    }
    Ok(())
}

pub(crate) async fn within<T>(
    end: Instant,
    call: impl Future<Output = Result<T, Refusal>>,
) -> Result<T, Refusal> {
    match timeout_at(end, call).await {
        Ok(ended) => ended,
        Err(_) => Err(Refusal::Status(StatusCode::BadTimeout)),
    }
}

/// Whether a value may be that of a variable or an argument of this DataType and ValueRank (OPC 10000-3, 5.6.2).
pub(crate) fn fits(value: &Variant, data_type: &NodeId, rank: i32, types: &dyn TypeTree) -> bool {
    if matches!(value, Variant::Empty) {
        return *data_type == DataTypeId::BaseDataType;
    }
    let fits_rank = if let Variant::Array(array) = value {
        let dimensions = array
            .dimensions
            .as_ref()
            .map_or(1, |sizes| sizes.len().max(1));
        match rank {
            -2 | 0 => true,
            -3 => dimensions == 1,
            _ => usize::try_from(rank).is_ok_and(|rank| rank == dimensions),
        }
    } else {
        matches!(rank, -3..=-1)
    };
    if !fits_rank {
        return false;
    }
    let given = if let Variant::Array(array) = value
        && array.values.is_empty()
    {
        // The library knows no type of an array without elements; its own says it.
        Some(NodeId::new(0, array.value_type as u32).into())
    } else {
        value.data_type()
    };
    let Some(given) = given else {
        return false;
    };
    let Some(given) = given.try_resolve(types.namespaces()) else {
        return false;
    };
    types.is_subtype_of(&given, data_type)
        // Enumerations travel as Int32 (OPC 10000-6, 5.2.4).
        || (*given == DataTypeId::Int32
            && types.is_subtype_of(data_type, &DataTypeId::Enumeration.into()))
        // Subtypes of the builtin types travel as those.
        || types.is_subtype_of(data_type, &given)
}

/// Returns the arguments of an InputArguments property.
pub(crate) fn arguments(property: &NodeType) -> Option<Vec<Argument>> {
    let NodeType::Variable(variable) = property else {
        return None;
    };
    arguments_in(Some(variable.value(
        TimestampsToReturn::Neither,
        &NumericRange::None,
        &DataEncoding::Binary,
        0.0,
    )))
}

/// Returns the arguments that an InputArguments or OutputArguments property has for its value.
#[must_use]
pub fn arguments_in(value: Option<DataValue>) -> Option<Vec<Argument>> {
    let Variant::Array(array) = value?.value? else {
        return None;
    };
    let each = array.values.into_iter().map(|value| {
        let Variant::ExtensionObject(object) = value else {
            return None;
        };
        object.into_inner_as::<Argument>().map(|one| *one)
    });
    each.collect()
}
