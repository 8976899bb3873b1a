//! Values that are not in the mapping, bound by the names of their fields.

use std::sync::Arc;

use mappings::{FieldMap, Lasting, TopicId};
use messages::{MessageType, Plan, PlanError, Selection};
use uadp::Fields;

use super::{About, Router, Values};
use crate::call::{CallDescription, CallField, CallRole, Origin, ValueDescription, ValueNote};
use crate::call_plan;
use crate::counters::{Cause, Reason};
use crate::description::Described;
use crate::fields;
use crate::settings::Now;
use crate::topic::{Role, Topic};

/// Converts the fields of a value of another space to a message, in any order of the fields.
#[derive(Debug)]
pub(crate) struct ByName {
    message_type: Arc<MessageType>,
    /// The assignments of fields that are not assigned by name.
    map: FieldMap,
    /// The description from the writer, and the indexes of the used fields in the order of the
    /// message.
    arranged: Option<(Arc<Described>, Vec<Origin>)>,
}

impl ByName {
    /// Appends the message of the fields.
    pub(crate) fn write(
        &self,
        plan: &Plan,
        fields: &[u8],
        out: &mut Vec<u8>,
    ) -> Result<(), (Cause, String)> {
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

impl Router {
    /// Binds a value that is not in the mapping. Otherwise it works as [`bind`](Self::bind).
    ///
    /// An own value is the whole message, and `note` is announced with it. A value of another space
    /// is converted by the names of its fields, or by the assignments in `note`. The conversion
    /// starts when the description of its writer is known; the writer is probed for it.
    ///
    /// # Errors
    /// Returns a [`PlanError`] if the type cannot be read.
    pub fn bind_as(
        &mut self,
        topic: TopicId,
        (message_type, note): (&Arc<MessageType>, ValueNote),
        now: Now,
    ) -> Result<(), PlanError> {
        let ValueNote {
            name,
            about,
            overflow,
            map,
        } = note;
        let Some(entry) = self.values.follow(topic, None, now) else {
            return Ok(());
        };
        let ours = matches!(entry.role, Role::Ours(_));
        if ours {
            entry.said = Some(Box::new(ValueDescription {
                name,
                message_type: None,
                about,
                fields: Vec::new(),
                overflow,
            }));
        } else {
            entry.plan = None;
            entry.by_name = Some(Box::new(ByName {
                message_type: Arc::clone(message_type),
                map,
                arranged: None,
            }));
        }
        let rules = (overflow, Lasting::from(overflow));
        if (entry.overflow, entry.lasting) != rules {
            self.values.requeue(topic, rules);
        }
        if ours {
            return self.bind(topic, message_type, &Selection::Whole, now);
        }
        self.values.arrange(topic, now);
        self.inquire(now);
        Ok(())
    }
}

impl Values {
    /// Assigns the fields of a value to its message, if the value is bound by name. Returns false
    /// for other values.
    pub(super) fn arrange(&mut self, topic: TopicId, now: Now) -> bool {
        let described = self.learned.get(topic, now.monotonic);
        let Some(Topic {
            by_name: Some(by_name),
            ..
        }) = self.topics.get_mut(&topic)
        else {
            return false;
        };
        let Some(described) = described.cloned() else {
            self.ask_what(topic);
            return true;
        };
        if let Some((known, _)) = &by_name.arranged
            && *known == described
        {
            return true;
        }
        let message_type = Arc::clone(&by_name.message_type);
        let bound = match order(&described, (&message_type, &by_name.map)) {
            Ok((selection, order)) => {
                by_name.arranged = Some((described, order));
                let bound = self.bind_type(topic, (&message_type, &selection), now);
                bound.map_err(|error| error.to_string())
            }
            Err(why) => Err(why),
        };
        if let Err(why) = bound {
            let cause = (Reason::Mismatch, "type");
            self.count(About::topic(topic), cause, 1, || why);
        }
        true
    }
}

/// Returns the selection of fields in the message, and the index of the source field for each.
fn order(
    described: &Described,
    (message_type, map): (&MessageType, &FieldMap),
) -> Result<(Selection, Vec<Origin>), String> {
    let fields = described.fields.iter().map(CallField::of).collect();
    let call = CallDescription {
        name: String::new(),
        about: String::new(),
        role: CallRole::Call,
        request: Vec::new(),
        response: fields,
    };
    let (selection, order) = call.response_order(message_type, map)?;
    Ok((selection, order.into_iter().map(Origin::Leaf).collect()))
}
