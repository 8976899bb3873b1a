//! The calls of clients: Methods of other spaces, and methods of Programs.

use opcua::server::node_manager::{MethodCall, RequestContext};
use opcua::types::{NodeId, StatusCode, Variant};
use tracing::info;

use crate::asking::{CallFailure, Drive, Drives, Questions, Table};

/// The Methods and Programs that clients can call.
pub(crate) struct Callables {
    methods: Table,
    programs: Drives,
    questions: Questions,
}

impl Callables {
    pub(super) fn new(questions: Questions) -> Self {
        Self {
            methods: Table::default(),
            programs: Drives::default(),
            questions,
        }
    }

    /// Returns the Methods by their nodes.
    pub(crate) const fn methods(&self) -> &Table {
        &self.methods
    }

    /// Returns the Programs that clients can control, by their methods.
    pub(crate) const fn programs(&self) -> &Drives {
        &self.programs
    }

    /// Returns the channel for calls of clients.
    pub(crate) const fn questions(&self) -> &Questions {
        &self.questions
    }

    /// Calls a Method or a method of a Program. Returns `None` for any other node.
    pub(super) async fn call(
        &self,
        context: &RequestContext,
        (method, arguments): (&NodeId, &[Variant]),
        gone: impl Fn() -> bool,
    ) -> Option<Result<Vec<Variant>, CallFailure>> {
        // The Method may have been removed after the check of the server.
        let callable = self.methods.lock().get(method).cloned();
        if let Some(callable) = callable {
            let arguments = arguments.to_vec();
            return Some(callable.call(&arguments, &self.questions, gone).await);
        }
        let asked = self.programs.lock().get(method).cloned()?;
        Some(drive(context, asked, arguments).await)
    }
}

/// Calls a method of a Program. The call continues if its client is lost.
async fn drive(
    context: &RequestContext,
    asked: Drive,
    arguments: &[Variant],
) -> Result<Vec<Variant>, CallFailure> {
    // Clients with permission to send goals may call the method.
    let may = context
        .authenticator
        .is_user_executable(&context.token, &asked.goal);
    if !may {
        return Err(CallFailure::Status(StatusCode::BadUserAccessDenied));
    }
    let ended = tokio::spawn((asked.carry_out)(arguments.to_vec())).await;
    ended.unwrap_or(Err(CallFailure::Status(StatusCode::BadInternalError)))
}

/// Sets the outputs of a call, or the status with which it failed.
pub(super) fn set_result(method: &mut MethodCall, called: Result<Vec<Variant>, CallFailure>) {
    match called {
        Ok(outputs) => {
            method.set_outputs(outputs);
            method.set_status(StatusCode::Good);
        }
        Err(CallFailure::Arguments(statuses)) => {
            method.set_argument_error(statuses);
            method.set_status(StatusCode::BadInvalidArgument);
        }
        Err(CallFailure::Asked(error)) => {
            info!(method = %method.method_id(), "cannot execute a call of a Method: {error}");
            method.set_status(StatusCode::from(error.status.0));
        }
        Err(CallFailure::Status(status)) => method.set_status(status),
    }
}
