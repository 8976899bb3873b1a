//! Types that publishers brought with their connection headers: bounded, and released when nobody publishes them.

use std::sync::{Arc, Weak};

use messages::{MessageType, PeerDefinitions, TypeName};

/// What is kept of the types that publishers brought, the oldest first.
#[derive(Debug, Default)]
pub(crate) struct Brought {
    entries: Vec<Entry>,
}

/// A type and what the registry was given of it.
#[derive(Debug)]
pub(crate) struct Entry {
    pub(crate) name: TypeName,
    pub(crate) definitions: PeerDefinitions,
    md5: String,
    /// Alive as long as a topic crosses as it.
    message_type: Weak<MessageType>,
    bytes: usize,
}

/// What is done about a type that a publisher brings.
#[derive(Debug)]
pub(crate) enum Room {
    /// It is known, and this is it.
    Known(Arc<MessageType>),
    /// It is new, and those are to be forgotten, as nobody publishes them.
    After(Vec<Entry>),
    /// All that is kept is in use.
    None,
}

impl Brought {
    /// Finds a place for a type with this text. One that `must` have it gets it in any case.
    pub(crate) fn room_for(&mut self, found: &Arc<MessageType>, names: usize, must: bool) -> Room {
        let mut entries = self.entries.iter_mut();
        let same = |entry: &&mut Entry| entry.name == *found.name() && entry.md5 == found.md5();
        if let Some(known) = entries.find(same) {
            // The same fields and constants, whatever the comments around them.
            let message_type = known.message_type.upgrade().unwrap_or_else(|| {
                known.message_type = Arc::downgrade(found);
                Arc::clone(found)
            });
            return Room::Known(message_type);
        }
        let mut bytes = weight(found);
        let mut names = names;
        for entry in &self.entries {
            bytes += entry.bytes;
            names += entry.definitions.len();
        }
        let mut unused = Vec::new();
        for (at, entry) in self.entries.iter().enumerate() {
            if bytes <= MAX_BYTES && names <= MAX_NAMES {
                break;
            }
            if entry.message_type.strong_count() == 0 {
                bytes -= entry.bytes;
                names -= entry.definitions.len();
                unused.push(at);
            }
        }
        if !must && (bytes > MAX_BYTES || names > MAX_NAMES) {
            return Room::None;
        }
        // From the back, so that the places of the others stay.
        let gone = unused.into_iter().rev().map(|at| self.entries.remove(at));
        Room::After(gone.collect())
    }

    /// Takes in a type that there was room for.
    pub(crate) fn take(&mut self, found: &Arc<MessageType>, definitions: PeerDefinitions) {
        self.entries.push(Entry {
            name: found.name().clone(),
            md5: found.md5().to_owned(),
            message_type: Arc::downgrade(found),
            bytes: weight(found),
            definitions,
        });
    }

    pub(crate) fn definitions(&self) -> impl Iterator<Item = &PeerDefinitions> {
        self.entries.iter().map(|entry| &entry.definitions)
    }

    #[cfg(test)]
    pub(crate) const fn len(&self) -> usize {
        self.entries.len()
    }
}

/// What a type is counted as, in bytes. Read, its text takes some six times as much memory.
fn weight(found: &MessageType) -> usize {
    found.name().to_string().len() + found.definition().len()
}

/// Text that publishers can have kept. A type that is not built in has about 4 kB with all it needs.
pub(crate) const MAX_BYTES: usize = 4 * 1024 * 1024;
/// Likewise names of types.
const MAX_NAMES: usize = 4096;
