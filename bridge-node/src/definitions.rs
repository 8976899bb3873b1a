//! Message definitions for a port: those built in, and those in files beside a ROS installation.

use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use messages::{DefinitionError, Dialect, MessageType, Registry, ServiceType, TypeName};
use tracing::{info, warn};

/// Finds message types by name; a definition once read stays.
#[derive(Debug)]
pub struct Definitions {
    registry: Registry,
}

impl Definitions {
    /// With the built-in definitions of one ROS.
    #[must_use]
    pub fn new(dialect: Dialect) -> Self {
        Self {
            registry: Registry::bundle(dialect),
        }
    }

    /// What is known by now.
    #[must_use]
    pub const fn registry(&self) -> &Registry {
        &self.registry
    }

    /// For definitions that come another way than by files.
    pub const fn registry_mut(&mut self) -> &mut Registry {
        &mut self.registry
    }

    /// The type of that name with all it needs. `locate` says where the definition of a type that is not known yet
    /// could be: a few small files are read, once.
    ///
    /// # Errors
    /// [`DefinitionError`]; a file that cannot be read is logged and counts as not there.
    pub fn find(
        &mut self,
        name: &TypeName,
        locate: impl Fn(Wanted<'_>) -> Option<PathBuf>,
    ) -> Result<Arc<MessageType>, DefinitionError> {
        self.search(|registry| registry.get(name), |_| "msg", locate)
    }

    /// The service of that name, found likewise.
    ///
    /// # Errors
    /// As [`find`](Self::find).
    pub fn find_service(
        &mut self,
        name: &TypeName,
        locate: impl Fn(Wanted<'_>) -> Option<PathBuf>,
    ) -> Result<Arc<ServiceType>, DefinitionError> {
        // What nothing needs is the service itself.
        let kind = |by: Option<&TypeName>| if by.is_none() { "srv" } else { "msg" };
        self.search(|registry| registry.service(name), kind, locate)
    }

    fn search<T>(
        &mut self,
        ask: impl Fn(&Registry) -> Result<T, DefinitionError>,
        kind_of: impl Fn(Option<&TypeName>) -> &'static str,
        locate: impl Fn(Wanted<'_>) -> Option<PathBuf>,
    ) -> Result<T, DefinitionError> {
        for _ in 0..MAX_FILES {
            let unknown = match ask(&self.registry) {
                Err(unknown @ DefinitionError::Unknown { .. }) => unknown,
                found => return found,
            };
            let DefinitionError::Unknown {
                name, needed_by, ..
            } = &unknown
            else {
                return Err(unknown);
            };
            let kind = kind_of(needed_by.as_ref());
            let file = locate(Wanted { name, kind });
            let Some((text, file)) = file.and_then(|file| Some((read(&file)?, file))) else {
                return Err(unknown);
            };
            if kind == "srv" {
                self.registry.add_service(name, &text)?;
            } else {
                self.registry.add(name, &text)?;
            }
            info!(definition = %name, file = %file.display(), "definition read");
        }
        ask(&self.registry)
    }
}

/// A definition that is not known yet.
#[derive(Debug, Clone, Copy)]
pub struct Wanted<'a> {
    /// Package and name.
    pub name: &'a TypeName,
    /// `msg` or `srv`: the folder in its package, and the ending of the file's name.
    pub kind: &'static str,
}

fn read(file: &Path) -> Option<String> {
    let mut text = String::new();
    match File::open(file).and_then(|open| open.take(MAX_BYTES).read_to_string(&mut text)) {
        Ok(_) => Some(text),
        Err(error) => {
            warn!(file = %file.display(), %error, "definition not readable");
            None
        }
    }
}

/// More types than any message needs.
const MAX_FILES: usize = 512;
/// More than any `.msg` file has.
const MAX_BYTES: u64 = 1 << 20;
