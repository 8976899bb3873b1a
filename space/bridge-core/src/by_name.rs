//! Conversion of values by the names of their fields.

use std::sync::Arc;

use mappings::FieldMap;
use messages::{MessagePlan, MessageType, Selection};
use uadp::Fields;

use crate::call::{CallDescription, CallField, CallRole, CallTypeError, FieldOrigin};
use crate::call_plan;
use crate::counters::DropCause;
use crate::description::TopicMetaData;
use crate::fields;

/// Converts the fields of a value of another space to a message, in any order of the fields.
#[derive(Debug)]
pub(crate) struct ByName {
    message_type: Arc<MessageType>,
    /// The assignments of fields that are not assigned by name.
    map: FieldMap,
    /// The description from the writer, and the indexes of the used fields in the order of the
    /// message.
    arranged: Option<(Arc<TopicMetaData>, Vec<FieldOrigin>)>,
}

impl ByName {
    /// Creates a conversion to the type. `map` assigns the fields that are not assigned by name.
    pub(crate) fn new(message_type: &Arc<MessageType>, map: FieldMap) -> Self {
        Self {
            message_type: Arc::clone(message_type),
            map,
            arranged: None,
        }
    }

    /// Assigns the described fields to the message. Returns the type and the selection to bind, or
    /// `None` for the known description.
    ///
    /// # Errors
    /// Returns the reason if the fields do not fit the message.
    pub(crate) fn arrange(
        &mut self,
        described: Arc<TopicMetaData>,
    ) -> Result<Option<(Arc<MessageType>, Selection)>, CallTypeError> {
        if let Some((known, _)) = &self.arranged
            && *known == described
        {
            return Ok(None);
        }
        let (selection, order) = order(&described, (&self.message_type, &self.map))?;
        self.arranged = Some((described, order));
        Ok(Some((Arc::clone(&self.message_type), selection)))
    }

    /// Appends the message of the fields.
    pub(crate) fn write(
        &self,
        plan: &MessagePlan,
        fields: &[u8],
        out: &mut Vec<u8>,
    ) -> Result<(), (DropCause, String)> {
        let order = self.arranged.as_ref();
        let order = order.map_or(&[][..], |(_, order)| order);
        let fields = call_plan::arrange(fields, order)?;
        fields::write(
            plan,
            Fields::parse(&fields).map_err(fields::undecodable)?,
            out,
        )
    }
}

/// Returns the selection of fields in the message, and the index of the source field for each.
fn order(
    described: &TopicMetaData,
    (message_type, map): (&MessageType, &FieldMap),
) -> Result<(Selection, Vec<FieldOrigin>), CallTypeError> {
    let fields = described.fields.iter().map(CallField::of).collect();
    let call = CallDescription {
        name: String::new(),
        about: String::new(),
        role: CallRole::Call,
        request: Vec::new(),
        response: fields,
    };
    let (selection, order) = call.response_order(message_type, map)?;
    Ok((
        selection,
        order.into_iter().map(FieldOrigin::Leaf).collect(),
    ))
}
