//! Conversion of requests and responses between a ROS service type and the fields of a call.

use std::sync::Arc;

use messages::{MessagePlan, MessageType, Selection, ServiceType, Wire};
use uadp::{Fields, Variant};

use crate::block::{NO_FIELDS, block, too_big};
use crate::call::{CallDescription, CallMap, CallTypeError, FieldOrigin};
use crate::counters::{DropCause, Reason};
use crate::fields::{self, LocalPayload};
use crate::plans::Plans;

/// Converts between the bytes of a service type and the fields of a call of another program.
#[derive(Debug)]
pub(crate) struct CallPlan {
    request: Arc<MessagePlan>,
    response: Arc<MessagePlan>,
    /// The source of each field of the request; `None` for a request without fields.
    request_order: Option<Vec<FieldOrigin>>,
    /// The index in the response for each field of the ROS message.
    response_order: Vec<FieldOrigin>,
}

impl CallPlan {
    /// Compiles the conversion between a call and a service type.
    ///
    /// # Errors
    /// Returns the reason if they do not fit.
    pub(crate) fn compile(
        description: &CallDescription,
        (service, map): (&ServiceType, &CallMap),
        (wire, plans): (Wire, &mut Plans),
    ) -> Result<Self, CallTypeError> {
        let mut plan = |message, selection: &Selection| plans.plan(message, selection, wire);
        let request_order = description.request_order(service.request(), &map.request)?;
        let (made, order) = description.response_order(service.response(), &map.response)?;
        Ok(Self {
            request: plan(service.request(), &Selection::Whole)?,
            response: plan(service.response(), &made)?,
            request_order,
            response_order: order.into_iter().map(FieldOrigin::Leaf).collect(),
        })
    }

    /// Converts the ROS bytes of a request to a block of fields.
    pub(crate) fn request(
        &self,
        message: &[u8],
        namespace: u16,
    ) -> Result<Vec<u8>, (DropCause, String)> {
        let payload = LocalPayload::Ros(&self.request, message);
        let read = block(|frame| fields::read(&payload, namespace, frame))?;
        match &self.request_order {
            None => Ok(NO_FIELDS.to_vec()),
            Some(order) if is_identity(order) => Ok(read),
            Some(order) => arrange(&read, order),
        }
    }

    /// Appends the ROS bytes of a response.
    pub(crate) fn response(
        &self,
        fields: &[u8],
        out: &mut Vec<u8>,
    ) -> Result<(), (DropCause, String)> {
        let count = Fields::parse(fields).map_err(fields::undecodable)?.len();
        let order = &self.response_order;
        let arranged = if is_identity(order) && count == order.len() {
            None
        } else {
            Some(arrange(fields, order)?)
        };
        let fields = Fields::parse(arranged.as_deref().unwrap_or(fields));
        fields::write(&self.response, fields.map_err(fields::undecodable)?, out)
    }
}

/// Returns a block with the fields of the given origins in their order.
pub(crate) fn arrange(
    fields: &[u8],
    order: &[FieldOrigin],
) -> Result<Vec<u8>, (DropCause, String)> {
    let fields = Fields::parse(fields).map_err(fields::undecodable)?;
    let all: Vec<Variant<'_>> = fields
        .collect::<Result<_, _>>()
        .map_err(fields::undecodable)?;
    block(|frame| {
        for origin in order {
            let place = match origin {
                FieldOrigin::Leaf(place) => *place,
                FieldOrigin::Constant(block) => {
                    for field in Fields::parse(block).map_err(fields::undecodable)? {
                        let field = field.map_err(fields::undecodable)?;
                        frame.variant(&field).map_err(too_big)?;
                    }
                    continue;
                }
            };
            let missing = || {
                let detail = format!("field {place} is missing: {} fields are present", all.len());
                ((Reason::Mismatch, "missing").into(), detail)
            };
            let field = all.get(place).ok_or_else(missing)?;
            frame.variant(field).map_err(too_big)?;
        }
        Ok(())
    })
}

/// Converts between the bytes of a service type and the fields of a call that the local side
/// executes.
#[derive(Debug)]
pub(crate) struct ExecutedPlan {
    request: Arc<MessagePlan>,
    response: Arc<MessagePlan>,
}

impl ExecutedPlan {
    /// Compiles the conversion for a call with the fields of the type.
    ///
    /// # Errors
    /// Returns the reason if a plan cannot be compiled.
    pub(crate) fn compile(
        service: &ServiceType,
        (wire, plans): (Wire, &mut Plans),
    ) -> Result<Self, CallTypeError> {
        let mut plan = |message: &Arc<MessageType>| plans.plan(message, &Selection::Whole, wire);
        Ok(Self {
            request: plan(service.request())?,
            response: plan(service.response())?,
        })
    }

    /// Appends the ROS bytes of a request.
    pub(crate) fn request(
        &self,
        fields: &[u8],
        out: &mut Vec<u8>,
    ) -> Result<(), (DropCause, String)> {
        let fields = Fields::parse(fields).map_err(fields::undecodable)?;
        fields::write(&self.request, fields, out)
    }

    /// Converts the ROS bytes of a response to a block of fields.
    pub(crate) fn response(
        &self,
        message: &[u8],
        namespace: u16,
    ) -> Result<Vec<u8>, (DropCause, String)> {
        let payload = LocalPayload::Ros(&self.response, message);
        block(|frame| fields::read(&payload, namespace, frame))
    }
}

fn is_identity(order: &[FieldOrigin]) -> bool {
    let mut origins = order.iter().enumerate();
    origins.all(|(at, origin)| *origin == FieldOrigin::Leaf(at))
}
