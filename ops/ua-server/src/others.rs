//! Existing OPC UA servers in the cell: their Methods as calls, their nodes as values, and their
//! skills as skills of components.

use std::path::Path;
use std::sync::Arc;

use bridge_node::LinkState;
use discovery::{AnnounceSettings, ServerChange};
use mappings::{Mapping, TopicId};
use plant_opcua::client::Link;
use tracing::warn;
use ua_component::{Foreign, ForeignSkills};

use crate::alarms::Alarms;
use crate::clients::Clients;
use crate::executing::ForeignMethods;
use crate::finding::{DiscoveredServers, Placed};
use crate::sources::MappedServers;

/// The other servers.
pub(crate) struct Others {
    pub(crate) executing: ForeignMethods,
    pub(crate) sources: MappedServers,
    pub(crate) skills: ForeignSkills,
    pub(crate) finding: DiscoveredServers,
    placed: Vec<Placed>,
    clients: Clients,
    mapping: Arc<Mapping>,
}

impl Others {
    /// Connects to the servers of `mapping`, with the certificates in `pki`. Other servers are
    /// discovered with the settings for announcing this server.
    pub(crate) fn new(
        mapping: &Arc<Mapping>,
        told: Option<&AnnounceSettings>,
        (pki, alarms): (&Path, &Arc<Alarms>),
    ) -> Self {
        let mut clients = Clients::new(mapping.server(), pki);
        let lds = told.and_then(|told| told.lds.as_deref());
        let mut others = Self {
            executing: ForeignMethods::new(mapping, &mut clients, Arc::clone(alarms)),
            sources: MappedServers::new(mapping, &mut clients),
            skills: ForeignSkills::default(),
            finding: DiscoveredServers::new(mapping, lds, told.and_then(|told| told.mdns.clone())),
            placed: Vec::new(),
            clients,
            mapping: Arc::clone(mapping),
        };
        if mapping.server().find_skills.is_some() && told.is_none() {
            warn!(
                "server.find_skills has no effect: give --announce or --lds, so that ua-server discovers other servers"
            );
        }
        others.follow();
        others
    }

    /// Switches to the servers of another mapping. Returns the topics with a new or changed source.
    pub(crate) fn reload(&mut self, mapping: &Arc<Mapping>) -> Vec<TopicId> {
        self.mapping = Arc::clone(mapping);
        self.executing.reload(mapping, &mut self.clients);
        let new = self.sources.reload(mapping, &mut self.clients);
        self.finding.reload(mapping);
        self.look();
        self.follow();
        new
    }

    /// Handles a change of a server in the network.
    pub(crate) fn heard(&mut self, found: &ServerChange) {
        self.finding.heard(found);
        self.found();
    }

    /// Offers the skills of discovered servers, and withdraws the skills of lost servers.
    pub(crate) fn found(&mut self) {
        if self.look() {
            self.follow();
        }
    }

    /// Updates the numbers of discovered servers. Returns true if they have changed.
    fn look(&mut self) -> bool {
        for name in self.skills.speaking() {
            let mut placed = self.placed.iter();
            if let Some(placed) = placed.find(|placed| placed.name == name) {
                self.finding.leave_alone(&placed.access);
            }
        }
        let clients = &self.clients;
        let is_up = |access: &_| matches!(clients.link(access), Some(Link::Up { .. }));
        let found = self.finding.look(is_up);
        let is_new = found != self.placed;
        if is_new {
            self.placed = found.to_vec();
        }
        is_new
    }

    /// Offers the skills of the servers to which the mapping assigns a namespace, and of discovered
    /// servers.
    fn follow(&mut self) {
        let clients = &mut self.clients;
        let named = self.mapping.servers().iter().filter_map(|server| {
            let place = server.skills?;
            Some(Foreign {
                name: server.name.clone(),
                namespace: place.namespace,
                open: place.open,
                is_found: false,
                endpoint: server.access.endpoint.to_string(),
                client: clients.of(&server.access),
            })
        });
        let mut all: Vec<Foreign> = named.collect();
        let found = self.placed.iter().map(|placed| Foreign {
            name: placed.name.clone(),
            namespace: placed.namespace,
            open: placed.open,
            is_found: true,
            endpoint: placed.access.endpoint.to_string(),
            client: clients.of(&placed.access),
        });
        all.extend(found);
        self.skills.follow(all);
        let found = self.placed.iter().map(|placed| &placed.access);
        self.clients.keep(&self.mapping, found);
    }

    /// Returns the state of the connection to each server.
    pub(crate) fn links(&self) -> Vec<LinkState> {
        let mut links = self.sources.links();
        links.extend(self.placed.iter().map(|placed| self.link(placed)));
        for (name, faults) in self.skills.faults() {
            if let Some(link) = links.iter_mut().find(|link| link.name == name) {
                let faults = faults.iter().map(|(of, why)| (of.clone(), why.clone()));
                link.faults.extend(faults);
            }
        }
        links
    }

    fn link(&self, placed: &Placed) -> LinkState {
        let told = LinkState {
            name: placed.name.clone(),
            url: placed.access.endpoint.to_string(),
            certificates_refused: self.clients.refused(&placed.access),
            ..LinkState::default()
        };
        match self.clients.link(&placed.access) {
            Some(Link::Up {
                connects, secured, ..
            }) => LinkState {
                up: true,
                secured,
                connects,
                ..told
            },
            Some(Link::Down { reason, .. }) => LinkState {
                why: Some(reason),
                ..told
            },
            Some(Link::Connecting | Link::Closed) | None => told,
        }
    }
}
