//! Method calls on instances: selects the handler of a call, and checks the arguments.

use std::collections::HashMap;
use std::future::Future;
use std::sync::{Arc, OnceLock};
use std::time::Duration;

use async_trait::async_trait;
use opcua::nodes::TypeTree;
use opcua::server::node_manager::{MethodCall, RequestContext};
use opcua::sync::RwLock;
use opcua::types::{Argument, DataTypeId, NodeId, StatusCode, Variant};
use tokio::time::{Instant, timeout_at};

use super::address_spaces::AddressSpaces;
use super::sessions::{SessionCaller, SessionPresence, Sessions};
use crate::client::CallResult;
use crate::limits::LONGEST_REQUEST;

/// A method call with arguments of the declared number and types.
#[derive(Debug, Clone)]
pub struct MethodRequest {
    /// The caller.
    pub caller: SessionCaller,
    /// The state of the caller's session.
    pub presence: SessionPresence,
    /// The object.
    pub object: NodeId,
    /// The method of the object, also if the client used the method of the type.
    pub method: NodeId,
    /// The name in the BrowseName of the method.
    pub name: String,
    /// The input arguments.
    pub arguments: Vec<Variant>,
}

/// The refusal of a call.
#[derive(Debug, Clone, PartialEq)]
pub enum MethodRefusal {
    /// Refused with this status code.
    Status(StatusCode),
    /// Refused with `BadInvalidArgument` and a status code for each argument.
    Arguments(Vec<StatusCode>),
    /// The result of a call at another server, which is forwarded unchanged. Its status may also be
    /// Good or Uncertain.
    PassedOn(Box<CallResult>),
}

impl From<StatusCode> for MethodRefusal {
    fn from(status: StatusCode) -> Self {
        Self::Status(status)
    }
}

/// Executes the calls of a method. A call that takes longer than [`longest`](Self::longest) is
/// cancelled.
#[async_trait]
pub trait MethodHandler: Send + Sync + 'static {
    /// Returns the timeout of a call.
    fn longest(&self) -> Duration {
        LONGEST_REQUEST
    }

    /// Executes a call, and returns the output arguments.
    ///
    /// # Errors
    /// Returns the refusal of the call.
    async fn call(&self, request: MethodRequest) -> Result<Vec<Variant>, MethodRefusal>;
}

struct Function<F>(F);

#[async_trait]
impl<F> MethodHandler for Function<F>
where
    F: Fn(MethodRequest) -> Result<Vec<Variant>, MethodRefusal> + Send + Sync + 'static,
{
    async fn call(&self, request: MethodRequest) -> Result<Vec<Variant>, MethodRefusal> {
        (self.0)(request)
    }
}

/// Creates a handler from a function that returns at once.
pub fn method<F>(function: F) -> Arc<dyn MethodHandler>
where
    F: Fn(MethodRequest) -> Result<Vec<Variant>, MethodRefusal> + Send + Sync + 'static,
{
    Arc::new(Function(function))
}

/// A method of an object and its handler.
struct Route {
    name: String,
    handler: Option<Arc<dyn MethodHandler>>,
}

/// The object and the method.
type Key = (NodeId, NodeId);

#[derive(Default)]
pub(crate) struct MethodCalls {
    routes: RwLock<HashMap<Key, Route>>,
    /// The methods that the types of an object declare, and the method of the object for each
    /// declaration.
    declared: RwLock<HashMap<Key, NodeId>>,
    pub(crate) sessions: Arc<Sessions>,
    pub(crate) spaces: OnceLock<Arc<AddressSpaces>>,
}

impl MethodCalls {
    /// Adds a method of an object, and its declarations in the types of the object.
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

    /// Executes the calls of methods of instances sequentially, and returns all other calls.
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
                        presence: SessionPresence::of(context),
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

    /// Returns the handler of a call; `None` for calls of other node managers. An own method of an
    /// object in namespace 0, such as Objects, has a route as well.
    #[expect(
        clippy::type_complexity,
        reason = "set in one place and read in one place"
    )]
    fn route(
        &self,
        call: &MethodCall,
    ) -> Option<Result<(NodeId, String, Arc<dyn MethodHandler>), StatusCode>> {
        let object = call.object_id();
        let spaces = self.spaces.get()?;
        if spaces.owns(object) && !spaces.own().read().node_exists(object) {
            return Some(Err(StatusCode::BadNodeIdUnknown));
        }
        let given = (object.clone(), call.method_id().clone());
        let method = self.declared.read().get(&given).cloned();
        let key = method.map_or(given, |method| (object.clone(), method));
        let routes = self.routes.read();
        let route = routes.get(&key)?;
        Some(match &route.handler {
            Some(handler) => Ok((key.1, route.name.clone(), Arc::clone(handler))),
            // A handler is called even if Executable is false, because it returns the reason.
            None if !spaces.executable(&key.1) => Err(StatusCode::BadNotExecutable),
            None => Err(StatusCode::BadNotImplemented),
        })
    }

    fn check(
        &self,
        context: &RequestContext,
        method: &NodeId,
        given: &[Variant],
    ) -> Result<(), MethodRefusal> {
        let Some(spaces) = self.spaces.get() else {
            return Err(MethodRefusal::Status(StatusCode::BadShutdown));
        };
        let declared = spaces.input_arguments(method)?;
        let types = context.type_tree.read();
        check_arguments(&declared, given, &*types)
    }
}

/// Sets the result of a call.
pub(crate) fn end(call: &mut MethodCall, ended: Result<Vec<Variant>, MethodRefusal>) {
    match ended {
        Ok(outputs) => {
            call.set_outputs(outputs);
            call.set_status(StatusCode::Good);
        }
        Err(MethodRefusal::Status(status)) => call.set_status(status),
        Err(MethodRefusal::Arguments(each)) => call.set_argument_error(each),
        Err(MethodRefusal::PassedOn(result)) => {
            // Results of arguments are sent only if an argument is invalid (OPC 10000-4, 5.12.2.2).
            if result.arguments.iter().any(|one| !one.is_good()) {
                // This also sets the status, which is replaced below.
                call.set_argument_error(result.arguments);
            }
            call.set_outputs(result.outputs);
            call.set_status(result.status);
        }
    }
}

/// Checks the number and the types of arguments (OPC 10000-4, 5.12.2).
///
/// # Errors
/// Returns the faults of the arguments.
pub(crate) fn check_arguments(
    declared: &[Argument],
    given: &[Variant],
    types: &dyn TypeTree,
) -> Result<(), MethodRefusal> {
    if given.len() < declared.len() {
        return Err(MethodRefusal::Status(StatusCode::BadArgumentsMissing));
    }
    if given.len() > declared.len() {
        return Err(MethodRefusal::Status(StatusCode::BadTooManyArguments));
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
        return Err(MethodRefusal::Arguments(each));
    }
    Ok(())
}

pub(crate) async fn within<T>(
    end: Instant,
    call: impl Future<Output = Result<T, MethodRefusal>>,
) -> Result<T, MethodRefusal> {
    match timeout_at(end, call).await {
        Ok(ended) => ended,
        Err(_) => Err(MethodRefusal::Status(StatusCode::BadTimeout)),
    }
}

/// Returns whether a value fits a variable or an argument with this DataType and ValueRank (OPC
/// 10000-3, 5.6.2).
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
        // The library does not return a type for an empty array; the element type is in the array
        // itself.
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
        // Enumerations are encoded as Int32 (OPC 10000-6, 5.2.4).
        || (*given == DataTypeId::Int32
            && types.is_subtype_of(data_type, &DataTypeId::Enumeration.into()))
        // Subtypes of a built-in type are encoded as the built-in type.
        || types.is_subtype_of(data_type, &given)
}
