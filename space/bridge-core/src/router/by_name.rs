//! Values that are not in the mapping, bound by the names of their fields.

use std::sync::Arc;

use mappings::{Lasting, TopicId};
use messages::{MessageType, PlanError, Selection};

use super::{DropSite, Router, TopicQueues};
use crate::by_name::ByName;
use crate::call::{ValueDescription, ValueNote};
use crate::counters::Reason;
use crate::settings::Now;
use crate::topic::{Topic, TopicSide};

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
        let at = self.values.follow(topic, now);
        let Some(entry) = self.values.topics.at_mut(at) else {
            return Ok(());
        };
        let ours = matches!(entry.role, TopicSide::Ours(_));
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
            entry.by_name = Some(Box::new(ByName::new(message_type, map)));
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

impl TopicQueues {
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
        let bound = match by_name.arrange(described) {
            Ok(None) => return true,
            Ok(Some((message_type, selection))) => self
                .bind_type(topic, (&message_type, &selection), now)
                .map_err(|error| error.to_string()),
            Err(why) => Err(why.to_string()),
        };
        if let Err(why) = bound {
            let cause = (Reason::Mismatch, "type");
            self.count(DropSite::topic(topic), cause, 1, || why);
        }
        true
    }
}
