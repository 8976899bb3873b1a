//! Methods and writes of the clients of a skill.

use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use plant_opcua::server::{
    MethodHandler, MethodRefusal as CallRefusal, MethodRequest, OpcUaServer, WriteHandler,
    WriteRequest, method,
};
use plant_opcua::types::{StatusCode, UAString, Variant};
use program::ProgramMethod;

use super::show::{SkillNodes, texts};
use crate::authority::SkillOwner;
use crate::client::packed::frame;
use crate::refusal::SkillRefusal;
use crate::skill::Skill;
use crate::variant::{from_pairs, from_variant, to_pairs, to_variant};

/// Registers the handlers for writes of parameters and calls of methods.
pub(super) fn serve(server: &OpcUaServer, nodes: &SkillNodes, skill: &Skill) {
    for (name, node) in nodes.parameters() {
        let handler = Given {
            skill: skill.clone(),
            name: name.to_owned(),
        };
        server.on_write(node, Arc::new(handler));
    }
    for method in ProgramMethod::ALL {
        if let Some(node) = nodes.method(method) {
            let handler = Call {
                skill: skill.clone(),
                method,
            };
            server.on_call(nodes.skill(), node, Arc::new(handler));
        }
    }
    if let Some(node) = nodes.named("Execute") {
        let handler = Execute {
            skill: skill.clone(),
        };
        server.on_call(nodes.skill(), node, Arc::new(handler));
    }
    if let Some(node) = nodes.named("ReadOutcome") {
        let skill = skill.clone();
        let handler = method(move |request| read_outcome(&skill, &request));
        server.on_call(nodes.skill(), node, handler);
    }
}

/// Takes the values that clients write to a parameter.
struct Given {
    skill: Skill,
    name: String,
}

#[async_trait]
impl WriteHandler for Given {
    async fn write(&self, request: WriteRequest) -> Result<(), StatusCode> {
        let value = request.value.value.as_ref().and_then(from_variant);
        let value = value.ok_or(StatusCode::BadTypeMismatch)?;
        let by = SkillOwner::Session(request.caller.session);
        let written = self.skill.write(&by, &self.name, value);
        written.map_err(|refusal| status(&refusal))
    }

    /// A 3DFrame is the six numbers of a position.
    fn converted(&self, value: Variant) -> Variant {
        frame(&value).map_or(value, |six| to_variant(&six))
    }
}

struct Execute {
    skill: Skill,
}

#[async_trait]
impl MethodHandler for Execute {
    async fn call(&self, request: MethodRequest) -> Result<Vec<Variant>, CallRefusal> {
        let [names, values, timeout] = request.arguments.as_slice() else {
            return Err(StatusCode::BadArgumentsMissing.into());
        };
        let parameters = from_pairs(names, values).ok_or(StatusCode::BadInvalidArgument)?;
        let Variant::Double(ms) = timeout else {
            return Err(StatusCode::BadInvalidArgument.into());
        };
        let within = Duration::try_from_secs_f64(*ms / 1_000.0)
            .map_err(|_| StatusCode::BadInvalidArgument)?;
        let within = (!within.is_zero()).then_some(within);
        let by = SkillOwner::Session(request.caller.session);
        match self.skill.execute(by, parameters, within).await {
            Ok(run) => Ok(vec![run.into()]),
            Err(refusal) => Err(status(&refusal).into()),
        }
    }
}

fn read_outcome(skill: &Skill, request: &MethodRequest) -> Result<Vec<Variant>, CallRefusal> {
    let Some(Variant::UInt32(run)) = request.arguments.first() else {
        return Err(StatusCode::BadArgumentsMissing.into());
    };
    let outcome = skill
        .outcome_of(*run)
        .map_err(|refusal| CallRefusal::from(status(&refusal)))?;
    let ended = outcome.is_some();
    let (succeeded, message, results, trace, unknown) = match &outcome {
        Some(outcome) => (
            outcome.succeeded,
            outcome.message.as_str(),
            outcome.results.as_slice(),
            outcome.trace.as_slice(),
            outcome.unknown,
        ),
        None => (false, "", &[][..], &[][..], false),
    };
    let [names, values] = to_pairs(results);
    Ok(vec![
        ended.into(),
        succeeded.into(),
        Variant::String(UAString::from(message)),
        names,
        values,
        texts(trace),
        unknown.into(),
    ])
}

struct Call {
    skill: Skill,
    method: ProgramMethod,
}

#[async_trait]
impl MethodHandler for Call {
    async fn call(&self, request: MethodRequest) -> Result<Vec<Variant>, CallRefusal> {
        let by = SkillOwner::Session(request.caller.session);
        match self.skill.call(by, self.method).await {
            Ok(_) => Ok(Vec::new()),
            Err(refusal) => Err(status(&refusal).into()),
        }
    }
}

pub(super) fn status(refusal: &SkillRefusal) -> StatusCode {
    StatusCode::from(refusal.code.number())
}
