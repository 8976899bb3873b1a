//! What is published once when the commander of a topic is lost.

use std::sync::Arc;
use std::time::{Duration, Instant};

use mappings::{LossAction, Mapping, ServiceRole, TopicId, Trigger};
use messages::{Literal, MessageType, NoFields, Plan, PlanError, Selected, Selection, Wire};
use uadp::{BuiltinType, DateTime, Fields, Timestamp};

use crate::fields;

/// The reaction to the loss of the commander of one topic, and whether it is due.
#[derive(Debug)]
pub(crate) struct Loss {
    reaction: Reaction,
    /// How long a value holds that is not renewed.
    hold: Option<Duration>,
    /// When the last value since the last reaction was delivered; `None` while nothing of the commander moves the robot.
    delivered: Option<Instant>,
}

#[derive(Debug, Clone)]
pub(crate) enum Reaction {
    /// Publishes this message of the topic.
    Publish(Stop),
    /// Delivers the value of another topic that calls its service.
    Call(TopicId),
}

/// A message of constants.
#[derive(Debug, Clone)]
pub(crate) struct Stop {
    plan: Arc<Plan>,
    /// Whether the stamp of its header is the time of the loss.
    is_stamped: bool,
}

impl Stop {
    fn new(
        message_type: &Arc<MessageType>,
        template: Selection,
        wire: Wire,
    ) -> Result<Self, PlanError> {
        let Selection::Template { mut fields, rest } = template else {
            let plan = Arc::new(Plan::compile(message_type, &template, wire)?);
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
        let plan = Arc::new(Plan::compile(message_type, &template, wire)?);
        Ok(Self { plan, is_stamped })
    }

    /// Writes the message.
    ///
    /// # Errors
    /// The reason in words.
    pub(crate) fn write(&self, now: Timestamp, out: &mut Vec<u8>) -> Result<(), String> {
        if !self.is_stamped {
            let written = self.plan.write(&mut NoFields, out);
            return written.map_err(|error| error.to_string());
        }
        let DateTime(ticks) = now.time;
        let mut block = 1_u16.to_le_bytes().to_vec();
        block.push(BuiltinType::DateTime.id());
        block.extend_from_slice(&ticks.to_le_bytes());
        let stamp = Fields::parse(&block).map_err(|error| error.to_string())?;
        fields::write(&self.plan, stamp, out).map_err(|(_, detail)| detail)
    }
}

impl Loss {
    /// What the mapping says of a topic, in its local type; `None` where it says nothing.
    ///
    /// # Errors
    /// [`PlanError`] when the message cannot be made in that type.
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
                Reaction::Publish(Stop::new(message_type, template, wire)?)
            }
        };
        Ok(Some(Self {
            reaction,
            hold: loss.hold,
            delivered: None,
        }))
    }

    /// The same, after another mapping or type: the last value was delivered when it was.
    pub(crate) fn following(self, before: Option<&Self>) -> Self {
        let delivered = before.and_then(|before| before.delivered);
        Self { delivered, ..self }
    }

    /// Takes note of a value that is delivered.
    pub(crate) const fn deliver(&mut self, now: Instant) {
        self.delivered = Some(now);
    }

    /// When the last value is over.
    pub(crate) fn due(&self) -> Option<Instant> {
        Some(self.delivered? + self.hold?)
    }

    /// The reaction, if a value was delivered since the last one.
    pub(crate) fn take(&mut self) -> Option<Reaction> {
        self.delivered.take()?;
        Some(self.reaction.clone())
    }
}

/// The value that makes a topic call its service, where some topic has that for a reaction.
///
/// # Errors
/// [`PlanError`] when the value cannot be made in the type it comes in.
pub(crate) fn trigger(
    mapping: &Mapping,
    topic: TopicId,
    message_type: &Arc<MessageType>,
    wire: Wire,
) -> Result<Option<Stop>, PlanError> {
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
    Stop::new(message_type, Selection::Template { fields, rest }, wire).map(Some)
}

/// The stamp of a header, in messages that begin with one.
const STAMP: &str = "header.stamp";
