//! The reaction to the loss of the commander of a topic, which is published once.

use std::sync::Arc;
use std::time::{Duration, Instant};

use mappings::{LossAction, Mapping, ServiceRole, TopicId, Trigger};
use messages::{
    Literal, MessagePlan, MessageType, NoFields, PlanError, Selected, Selection, Wire, WriteError,
};
use uadp::{BuiltinType, DateTime, DecodeError, Fields, Timestamp};

use crate::fields;

/// The reaction to the loss of the commander of a topic, and whether it is due.
#[derive(Debug)]
pub(crate) struct LossReaction {
    reaction: Reaction,
    /// The time for which a value is valid without renewal.
    hold: Option<Duration>,
    /// The time of the last delivered value after the last reaction; `None` while no value of the
    /// commander is in effect.
    delivered: Option<Instant>,
}

#[derive(Debug, Clone)]
pub(crate) enum Reaction {
    /// Publishes this message of the topic.
    Publish(ConstantMessage),
    /// Delivers the value of another topic that calls its service.
    Call(TopicId),
}

/// Reason for which the reaction to a loss cannot be delivered.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub(crate) enum ReactionFault {
    #[error("the service of {0} is unknown here")]
    UnknownService(TopicId),
    #[error(transparent)]
    Write(#[from] WriteError),
    #[error(transparent)]
    Stamp(#[from] DecodeError),
    /// The message with the time stamp cannot be written.
    #[error("{0}")]
    Stamped(String),
}

/// A message of constants.
#[derive(Debug, Clone)]
pub(crate) struct ConstantMessage {
    plan: Arc<MessagePlan>,
    /// Whether the stamp of its header is the time of the loss.
    is_stamped: bool,
}

impl ConstantMessage {
    fn new(
        message_type: &Arc<MessageType>,
        template: Selection,
        wire: Wire,
    ) -> Result<Self, PlanError> {
        let Selection::Template { mut fields, rest } = template else {
            let plan = Arc::new(MessagePlan::compile(message_type, &template, wire)?);
            let is_stamped = false;
            return Ok(Self { plan, is_stamped });
        };
        let is_stamped = !rest.contains_key(STAMP)
            && message_type
                .leaves()
                .iter()
                .any(|leaf| leaf.path == STAMP && leaf.builtin == BuiltinType::DateTime);
        if is_stamped {
            fields.push(Selected::whole(STAMP));
        }
        let template = Selection::Template { fields, rest };
        let plan = Arc::new(MessagePlan::compile(message_type, &template, wire)?);
        Ok(Self { plan, is_stamped })
    }

    /// Writes the message.
    ///
    /// # Errors
    /// Returns the reason if the message cannot be written.
    pub(crate) fn write(&self, now: Timestamp, out: &mut Vec<u8>) -> Result<(), ReactionFault> {
        if !self.is_stamped {
            return Ok(self.plan.write(&mut NoFields, out)?);
        }
        let DateTime(ticks) = now.time;
        let mut block = 1_u16.to_le_bytes().to_vec();
        block.push(BuiltinType::DateTime.id());
        block.extend_from_slice(&ticks.to_le_bytes());
        let stamp = Fields::parse(&block)?;
        let written = fields::write(&self.plan, stamp, out);
        written.map_err(|(_, detail)| ReactionFault::Stamped(detail))
    }
}

impl LossReaction {
    /// Returns the reaction from the mapping in the local type of the topic; `None` if the mapping
    /// has no reaction.
    ///
    /// # Errors
    /// Returns a [`PlanError`] if the message cannot be made in this type.
    pub(crate) fn new(
        mapping: &Mapping,
        topic: TopicId,
        (message_type, selection): (&Arc<MessageType>, &Selection),
        wire: Wire,
    ) -> Result<Option<Self>, PlanError> {
        let loss = mapping.variable(topic).and_then(|of| of.loss.as_deref());
        let Some(loss) = loss else {
            return Ok(None);
        };
        let reaction = match &loss.action {
            LossAction::Call(by) => Reaction::Call(*by),
            action @ (LossAction::Message(_) | LossAction::Field(_)) => {
                let Some(template) = action.template(selection) else {
                    return Ok(None);
                };
                Reaction::Publish(ConstantMessage::new(message_type, template, wire)?)
            }
        };
        Ok(Some(Self {
            reaction,
            hold: loss.hold,
            delivered: None,
        }))
    }

    /// Keeps the time of the last delivered value after a change of the mapping or the type.
    pub(crate) fn following(self, before: Option<&Self>) -> Self {
        let delivered = before.and_then(|before| before.delivered);
        Self { delivered, ..self }
    }

    /// Records a delivered value.
    pub(crate) const fn deliver(&mut self, now: Instant) {
        self.delivered = Some(now);
    }

    /// Returns the time at which the last value expires.
    pub(crate) fn due(&self) -> Option<Instant> {
        Some(self.delivered? + self.hold?)
    }

    /// Returns the reaction if a value was delivered after the last reaction.
    pub(crate) fn take(&mut self) -> Option<Reaction> {
        self.delivered.take()?;
        Some(self.reaction.clone())
    }
}

/// Returns the value with which a topic calls its service, if this call is the reaction of another
/// topic.
///
/// # Errors
/// Returns a [`PlanError`] if the value cannot be made in its type.
pub(crate) fn trigger(
    mapping: &Mapping,
    topic: TopicId,
    message_type: &Arc<MessageType>,
    wire: Wire,
) -> Result<Option<ConstantMessage>, PlanError> {
    let role = mapping
        .variable(topic)
        .and_then(|variable| variable.service.as_ref())
        .map(|service| &service.role);
    let Some(ServiceRole::Call { when, .. }) = role else {
        return Ok(None);
    };
    let is_reaction = mapping.variables().iter().any(|variable| {
        let loss = variable.loss.as_deref();
        loss.is_some_and(|loss| loss.action == LossAction::Call(topic))
    });
    if !is_reaction {
        return Ok(None);
    }
    let rest = match when {
        Trigger::Equals(text) => [("data".to_owned(), Literal::One(text.clone()))].into(),
        Trigger::Any => std::collections::BTreeMap::new(),
    };
    let fields = Vec::new();
    ConstantMessage::new(message_type, Selection::Template { fields, rest }, wire).map(Some)
}

/// The header stamp of messages that start with a header.
const STAMP: &str = "header.stamp";
