//! Type definitions for a port: those built in, those in files, and those that peers bring.

use std::collections::BTreeMap;
use std::sync::Arc;

use messages::{
    DefinitionError, Dialect, Library, MessageType, Noted, Registry, ServiceType, TextKind,
    TypeName,
};
use tracing::{info, warn};
use type_files::{Environment, TypeFiles, TypePaths};

/// Finds types by name; a definition once read stays until all are read again.
#[derive(Debug)]
pub struct Definitions {
    library: Library,
    files: TypeFiles,
    /// Who brought those that are from peers.
    peers: BTreeMap<TypeName, String>,
}

impl Definitions {
    /// With the built-in definitions of one ROS, those of the mapping's `type_paths`, and the ROS installations there are.
    #[must_use]
    pub fn new(dialect: Dialect, types: Arc<TypePaths>, environment: Environment) -> Self {
        Self {
            library: Library::new(Registry::bundle(dialect)),
            files: TypeFiles::new(types, environment),
            peers: BTreeMap::new(),
        }
    }

    /// Takes what the `type_paths` have by now. What peers brought stays.
    pub fn replace(&mut self, types: &Arc<TypePaths>) {
        if self.files.paths().is_none() && types.is_none() {
            return;
        }
        self.library.forget_texts();
        self.files.replace(Arc::clone(types));
    }

    /// What is known by now.
    #[must_use]
    pub const fn registry(&self) -> &Registry {
        self.library.registry()
    }

    /// For definitions that come another way than by files.
    pub const fn registry_mut(&mut self) -> &mut Registry {
        self.library.registry_mut()
    }

    /// The type of that name with all it needs; files are read, once.
    ///
    /// # Errors
    /// [`DefinitionError`]; a file that does not parse is logged and counts as not there.
    pub fn find(&mut self, name: &TypeName) -> Result<Arc<MessageType>, DefinitionError> {
        let found = self.library.message(name, &mut self.files);
        self.tell();
        found
    }

    /// The service of that name, found likewise.
    ///
    /// # Errors
    /// As [`find`](Self::find).
    pub fn find_service(&mut self, name: &TypeName) -> Result<Arc<ServiceType>, DefinitionError> {
        let found = self.library.service(name, &mut self.files);
        self.tell();
        found
    }

    /// Notes that a peer brought the definition that counts, as `type description of /camera`.
    pub fn learned(&mut self, name: &TypeName, from: impl FnOnce() -> String) {
        if self.peers.len() < MOST_PEERS {
            self.peers.insert(name.clone(), from());
        }
    }

    /// Where the definition of a type is from, for people.
    #[must_use]
    pub fn source(&self, name: &TypeName) -> &str {
        let file = || {
            self.library
                .file(TextKind::Message, name)
                .map(AsRef::as_ref)
        };
        let peer = self.peers.get(name).map(String::as_str);
        peer.or_else(file).unwrap_or("built in")
    }

    fn tell(&mut self) {
        for noted in self.library.take_noted() {
            tell(noted);
        }
    }
}

fn tell(noted: Noted) {
    match noted {
        Noted::Read { name, file } => info!(definition = %name, %file, "definition read"),
        Noted::Refused { name, file, error } => {
            warn!(definition = %name, %file, "definition file does not count: {error}");
        }
        Noted::Differs {
            name,
            file,
            only_file,
            only_built_in,
        } => tell_differing(&name, &file, &only_file, &only_built_in),
    }
}

fn tell_differing(name: &TypeName, file: &str, only_file: &[String], only_built_in: &[String]) {
    warn!(
        definition = %name,
        file,
        ?only_file,
        ?only_built_in,
        "the file counts, and differs from the definition that is built in"
    );
}

/// Types of peers whose origin is kept in mind.
const MOST_PEERS: usize = 4096;
