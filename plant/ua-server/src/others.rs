//! What the cell has of servers that exist already: their Methods as calls, their nodes as values, their skills as those of
//! components.

use std::path::Path;

use bridge_node::LinkState;
use mappings::{Mapping, TopicId};
use ua_component::{Foreign, ForeignSkills};

use crate::clients::Clients;
use crate::executing::Executing;
use crate::sources::Sources;

/// The other servers.
pub(crate) struct Others {
    pub(crate) executing: Executing,
    pub(crate) sources: Sources,
    pub(crate) skills: ForeignSkills,
    clients: Clients,
}

impl Others {
    /// Those of `mapping`, for a client with that ApplicationUri and the certificates in `pki`.
    pub(crate) fn new(mapping: &Mapping, application_uri: &str, pki: &Path) -> Self {
        let mut clients = Clients::new(application_uri, pki);
        let mut others = Self {
            executing: Executing::new(mapping, &mut clients),
            sources: Sources::new(mapping, &mut clients),
            skills: ForeignSkills::default(),
            clients,
        };
        others.follow(mapping);
        others
    }

    /// Goes over to those of another mapping. Gives the topics whose source is new or another.
    pub(crate) fn reload(&mut self, mapping: &Mapping) -> Vec<TopicId> {
        self.executing.reload(mapping, &mut self.clients);
        let new = self.sources.reload(mapping, &mut self.clients);
        self.follow(mapping);
        self.clients.keep(mapping);
        new
    }

    /// Speaks for the skills of the servers that the mapping gives a place in the space.
    fn follow(&mut self, mapping: &Mapping) {
        let with_skills = mapping.servers().iter().filter_map(|server| {
            let place = server.skills?;
            Some(Foreign {
                name: server.name.clone(),
                namespace: place.namespace,
                open: place.open,
                endpoint: server.access.endpoint.to_string(),
                client: self.clients.of(&server.access),
            })
        });
        let with_skills = with_skills.collect();
        self.skills.follow(with_skills);
    }

    /// What there is to tell of each server.
    pub(crate) fn links(&self) -> Vec<LinkState> {
        let mut links = self.sources.links();
        for (name, faults) in self.skills.faults() {
            if let Some(link) = links.iter_mut().find(|link| link.name == name) {
                let faults = faults.iter().map(|(of, why)| (of.clone(), why.clone()));
                link.faults.extend(faults);
            }
        }
        links
    }
}
