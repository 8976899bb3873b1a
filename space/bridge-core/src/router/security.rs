//! The security of messages.

use std::time::Instant;

use mappings::SecurityGroup;
use uadp::{KeyError, NetworkMessage, NetworkMessageType};

use super::about::DropSite;
use super::values::TopicQueues;
use crate::guard::{GroupState, Guard, KeyDelivery, Unopened};
use crate::output::Output;

/// The secured groups, and the security of the message in processing.
#[derive(Debug)]
pub(super) struct MessageSecurity {
    /// The secured groups; `None` without secured groups.
    guard: Option<Box<Guard>>,
    /// Random bytes of this program instance, if they are known.
    mark: Option<[u8; 4]>,
    /// Whether the message in processing was received unsecured.
    in_clear: bool,
}

impl MessageSecurity {
    pub(super) fn new(groups: &[SecurityGroup]) -> Self {
        Self {
            guard: Guard::new(groups).map(Box::new),
            mark: None,
            in_clear: true,
        }
    }

    /// Returns whether there are secured groups.
    pub(super) const fn is_on(&self) -> bool {
        self.guard.is_some()
    }

    /// Returns the number of bytes that security adds to a datagram.
    pub(super) fn overhead(&self) -> usize {
        self.guard.as_ref().map_or(0, |_| Guard::OVERHEAD)
    }

    /// Sets the random bytes of this program instance. Zeros stand for unknown bytes.
    pub(super) fn set_instance(&mut self, instance: [u8; 16]) {
        let [a, b, c, d, ..] = instance;
        let random = instance.iter().any(|byte| *byte != 0);
        self.mark = random.then_some([a, b, c, d]);
        self.apply_mark();
    }

    fn apply_mark(&mut self) {
        if let (Some(guard), Some(mark)) = (&mut self.guard, self.mark) {
            guard.set_mark(mark);
        }
    }

    /// Applies the groups of a mapping.
    pub(super) fn replace(&mut self, groups: &[SecurityGroup]) {
        match &mut self.guard {
            Some(guard) => {
                if !guard.replace(groups) {
                    self.guard = None;
                }
            }
            None => {
                self.guard = Guard::new(groups).map(Box::new);
                self.apply_mark();
            }
        }
    }

    /// Sets the keys of a secured group. Keys of other groups are ignored.
    pub(super) fn set_keys(
        &mut self,
        group: &str,
        delivery: &KeyDelivery,
        now: Instant,
    ) -> Result<(), KeyError> {
        match &mut self.guard {
            Some(guard) => guard.set_keys(group, delivery, now),
            None => Ok(()),
        }
    }

    pub(super) fn states(&self) -> impl Iterator<Item = GroupState> {
        self.guard.iter().flat_map(|guard| guard.states())
    }

    /// Returns whether messages in a namespace are secured.
    fn is_secured(&self, namespace: u16) -> bool {
        let guard = self.guard.as_ref();
        guard.is_some_and(|guard| guard.is_secured(namespace))
    }

    /// Returns the index of the secured group of a namespace.
    pub(super) fn group_of(&self, namespace: u16) -> Option<usize> {
        self.guard.as_ref()?.group_of(namespace)
    }

    /// Returns whether the message in processing is unsecured but concerns a secured namespace.
    /// `None` stands for a message about all namespaces.
    pub(super) fn is_unsaid(&self, namespace: Option<u16>) -> bool {
        let secured = namespace.is_none_or(|namespace| self.is_secured(namespace));
        self.is_on() && self.in_clear && secured
    }

    /// Returns whether the message in processing was secured.
    pub(super) const fn is_authentic(&self) -> bool {
        self.is_on() && !self.in_clear
    }

    /// Returns whether a message was sent in chunks of a namespace with another security than its
    /// own namespace.
    pub(super) fn is_smuggled(&self, message: &NetworkMessage<'_>, chunked_in: u16) -> bool {
        let Some(guard) = &self.guard else {
            return false;
        };
        let data = message.message_type() == NetworkMessageType::DataSet;
        let namespace = message.group().and_then(|group| group.writer_group_id);
        let alike = namespace.is_some_and(|namespace| guard.is_alike(namespace, chunked_in));
        !data || !alike
    }

    /// Opens a secured message into `scratch`. Returns `None` for an unsecured message.
    pub(super) fn open<'a>(
        &mut self,
        message: &NetworkMessage<'a>,
        now: Instant,
        scratch: &'a mut Vec<u8>,
    ) -> Result<Option<NetworkMessage<'a>>, Unopened> {
        let opened = match &mut self.guard {
            Some(guard) => guard.open(message, now, scratch)?,
            None => None,
        };
        self.in_clear = opened.is_none();
        Ok(opened)
    }

    /// Seals an output. Returns `None` for a message that cannot be sent, and counts it.
    pub(super) fn seal(&mut self, values: &mut TopicQueues, mut output: Output) -> Option<Output> {
        let Some(guard) = &mut self.guard else {
            return Some(output);
        };
        let Some((bytes, topic)) = output.message_mut() else {
            return Some(output);
        };
        let mut sealed = values.buffer();
        match guard.seal(bytes, &mut sealed) {
            Ok(is_sealed) => {
                if is_sealed {
                    std::mem::swap(bytes, &mut sealed);
                }
                values.recycle(sealed);
                Some(output)
            }
            Err(Unopened {
                reason,
                case,
                detail,
            }) => {
                values.recycle(sealed);
                let about = DropSite { topic, from: None };
                values.count(about, (reason, case), 1, || detail);
                None
            }
        }
    }

    /// Returns the time of the next [`turn`](Self::turn).
    pub(super) fn due(&self) -> Option<Instant> {
        self.guard.as_ref()?.due()
    }

    /// Changes to the keys that are due.
    pub(super) fn turn(&mut self, now: Instant) {
        if let Some(guard) = &mut self.guard {
            guard.turn(now);
        }
    }

    /// Returns a group that needs its keys.
    pub(super) fn wanted(&mut self, now: Instant) -> Option<String> {
        self.guard.as_mut()?.wanted(now)
    }
}
