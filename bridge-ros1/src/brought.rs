//! Types from the connection headers of publishers: bounded, and released when no publisher uses
//! them.

use std::sync::{Arc, Weak};

use messages::{MessageType, PeerDefinitions, TypeName};

/// The types received from publishers, the oldest first.
#[derive(Debug, Default)]
pub(crate) struct Brought {
    entries: Vec<TypeEntry>,
}

/// A type, with its definitions in the registry.
#[derive(Debug)]
pub(crate) struct TypeEntry {
    pub(crate) name: TypeName,
    pub(crate) definitions: PeerDefinitions,
    md5: String,
    /// Alive as long as a topic is bridged with this type.
    message_type: Weak<MessageType>,
    bytes: usize,
}

/// The result of a request for room for a type.
#[derive(Debug)]
pub(crate) enum TypeRoom {
    /// The type is already stored.
    Known(Arc<MessageType>),
    /// The type is new, and these unused entries are to be removed from the registry.
    After(Vec<TypeEntry>),
    /// All stored types are in use.
    None,
}

impl Brought {
    /// Makes room for a type with `names` definitions. With `must`, there is always room.
    pub(crate) fn room_for(
        &mut self,
        found: &Arc<MessageType>,
        names: usize,
        must: bool,
    ) -> TypeRoom {
        let mut entries = self.entries.iter_mut();
        let same = |entry: &&mut TypeEntry| entry.name == *found.name() && entry.md5 == found.md5();
        if let Some(known) = entries.find(same) {
            // Types with the same MD5 sum have the same fields and constants; only their comments
            // may differ.
            let message_type = known.message_type.upgrade().unwrap_or_else(|| {
                known.message_type = Arc::downgrade(found);
                Arc::clone(found)
            });
            return TypeRoom::Known(message_type);
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
            return TypeRoom::None;
        }
        // Removal from the back keeps the other positions valid.
        let gone = unused.into_iter().rev().map(|at| self.entries.remove(at));
        TypeRoom::After(gone.collect())
    }

    /// Stores a type after room was made for it.
    pub(crate) fn take(&mut self, found: &Arc<MessageType>, definitions: PeerDefinitions) {
        self.entries.push(TypeEntry {
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

/// Returns the size with which a type counts, in bytes. A parsed type uses about six times as much
/// memory.
fn weight(found: &MessageType) -> usize {
    found.name().to_string().len() + found.definition().len()
}

/// Maximum size of the stored definitions. A type that is not built in has about 4 kB with its
/// dependencies.
pub(crate) const MAX_BYTES: usize = 4 * 1024 * 1024;
/// Maximum number of stored type names.
const MAX_NAMES: usize = 4096;
