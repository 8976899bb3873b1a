//! What the cell has of servers that exist already: their Methods as calls, their nodes as values.

use std::path::Path;

use mappings::{Mapping, TopicId};

use crate::clients::Clients;
use crate::executing::Executing;
use crate::sources::Sources;

/// The other servers.
pub(crate) struct Others {
    pub(crate) executing: Executing,
    pub(crate) sources: Sources,
    clients: Clients,
}

impl Others {
    /// Those of `mapping`, for a client with that ApplicationUri and the certificates in `pki`.
    pub(crate) fn new(mapping: &Mapping, application_uri: &str, pki: &Path) -> Self {
        let mut clients = Clients::new(application_uri, pki);
        Self {
            executing: Executing::new(mapping, &mut clients),
            sources: Sources::new(mapping, &mut clients),
            clients,
        }
    }

    /// Goes over to those of another mapping. Gives the topics whose source is new or another.
    pub(crate) fn reload(&mut self, mapping: &Mapping) -> Vec<TopicId> {
        self.executing.reload(mapping, &mut self.clients);
        let new = self.sources.reload(mapping, &mut self.clients);
        self.clients.keep(mapping);
        new
    }
}
