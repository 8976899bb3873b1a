//! Announcements: by mDNS, by a Global Discovery Server, and by this program for registered
//! servers.

use std::collections::BTreeMap;
use std::time::Instant;

use super::{RegistryEvent, ServerRegistry};
use crate::asked::RegistrationRequest;
use crate::loss::ServerLoss;
use crate::name::{label, renamed};
use crate::network::{AnnouncedServer, RecordSource, place};

impl ServerRegistry {
    /// Handles an announcement by mDNS, new or repeated.
    pub fn announced(&mut self, announcement: AnnouncedServer, now: Instant) {
        let instance = &announcement.instance;
        if self.is_ours(instance) {
            // An announcement of this program itself.
            return;
        }
        let known = self.network.get(instance);
        if known.is_some_and(|known| {
            known.announcement == announcement && known.source == RecordSource::Multicast
        }) {
            return;
        }
        if known.is_none() && !self.make_room_on_network(&announcement, now) {
            return;
        }
        let instance = announcement.instance.clone();
        let url = announcement.url.clone();
        let before = self.network.put(announcement, RecordSource::Multicast, now);
        if let Some(before) = before {
            self.unwatch(&before.announcement.url);
        }
        self.watch.add(&url, self.settings.probe_every, now);
        let record = self.network.get(&instance).cloned();
        self.events.extend(record.map(RegistryEvent::Seen));
        self.supersede_at(&place(&url));
    }

    /// Handles a goodbye by mDNS, or the expiry of an announcement.
    pub fn withdrawn(&mut self, instance: &str) {
        let known = self.network.get(instance);
        if known.is_some_and(|known| known.source == RecordSource::Multicast) {
            self.vanish(instance, ServerLoss::Goodbye);
        }
    }

    /// Replaces the servers that a Global Discovery Server lists, at most one for each host and
    /// port. They are probed. FindServersOnNetwork returns the servers that answer, unless a server
    /// of the same host and port is registered or announced by mDNS.
    pub fn listed(&mut self, servers: Vec<AnnouncedServer>, now: Instant) {
        let servers = servers.into_iter().map(|one| (place(&one.url), one));
        let servers: BTreeMap<String, AnnouncedServer> = servers.collect();
        let before = std::mem::replace(&mut self.listed, servers);
        for (at, old) in before {
            if self.listed.get(&at) != Some(&old) {
                self.hide_listed(|record_at, _| record_at == at, ServerLoss::Unlisted);
                self.unwatch(&old.url);
            }
        }
        let places: Vec<String> = self.listed.keys().cloned().collect();
        for at in places {
            if let Some(listed) = self.listed.get(&at) {
                self.watch.add(&listed.url, self.settings.probe_every, now);
            }
            if self.watch.has_answered_at(&at) {
                self.show_listed(&at, now);
            }
        }
    }

    /// Shows the listed server of a host and port that answers, unless another source reports a
    /// server there. The name gets a number if it is taken.
    pub(super) fn show_listed(&mut self, at: &str, now: Instant) {
        let Some(mut listed) = self.listed.get(at).cloned() else {
            return;
        };
        let is_on_network = self.network.arrivals().any(|(_, known)| known.place == at);
        let mut registered = self.servers.values();
        if is_on_network
            || self.network.len() >= self.settings.most
            || registered.any(|server| server.is_at(at))
        {
            return;
        }
        // Each turn skips one of the existing names.
        for _ in 0..=self.network.len() {
            if self.network.get(&listed.instance).is_none() {
                break;
            }
            listed.instance = renamed(&listed.instance);
        }
        let instance = listed.instance.clone();
        self.network.put(listed, RecordSource::Gds, now);
        let record = self.network.get(&instance).cloned();
        self.events.extend(record.map(RegistryEvent::Seen));
    }

    /// Hides the listed server of a host and port that another source reports.
    pub(super) fn supersede_at(&mut self, at: &str) {
        self.hide_listed(|record_at, _| record_at == at, ServerLoss::Superseded);
    }

    /// Hides the listed server with a name that a registered server gets.
    pub(super) fn supersede(&mut self, instance: &str) {
        let has_name = |_: &str, name: &str| name.eq_ignore_ascii_case(instance);
        self.hide_listed(has_name, ServerLoss::Superseded);
    }

    /// Removes the records of listed servers, by host and port and instance name.
    fn hide_listed(&mut self, which: impl Fn(&str, &str) -> bool, loss: ServerLoss) {
        let shown = self.network.arrivals();
        let shown = shown.filter(|(record, known)| {
            record.source == RecordSource::Gds && which(&known.place, &record.announcement.instance)
        });
        let shown: Vec<String> = shown
            .map(|(record, _)| record.announcement.instance.clone())
            .collect();
        for instance in shown {
            self.vanish(&instance, loss);
        }
    }

    /// Renames an announcement of this program: another host has the name (RFC 6762, 9).
    pub fn renamed(&mut self, from: &str, to: &str, now: Instant) {
        let mut announced = self
            .servers
            .values_mut()
            .filter_map(|server| server.announced.as_mut());
        let Some(ours) = announced.find(|ours| ours.instance.eq_ignore_ascii_case(from)) else {
            return;
        };
        to.clone_into(&mut ours.instance);
        let ours = ours.clone();
        self.network.remove(from);
        self.supersede(to);
        self.network.put(ours, RecordSource::Registration, now);
    }

    /// Returns whether this program announces that name for a registered server.
    pub(super) fn is_ours(&self, instance: &str) -> bool {
        let mut announced = self
            .servers
            .values()
            .filter_map(|server| server.announced.as_ref());
        announced.any(|ours| ours.instance.eq_ignore_ascii_case(instance))
    }

    /// Returns the announcement for a server: the requested name, with a number if another server
    /// has that name (RFC 6762, 9). Returns `None` if the server already announces itself with this
    /// name and URL.
    pub(super) fn free(&self, asked: &RegistrationRequest) -> Option<AnnouncedServer> {
        let mut wish = asked.announcement()?;
        let others = |name: &str| {
            self.servers
                .values()
                .filter(|server| server.asked.server_uri != asked.server_uri)
                .filter_map(|server| server.announced.as_ref())
                .any(|announced| announced.instance.eq_ignore_ascii_case(name))
        };
        // Each turn skips one of the existing names.
        for _ in 0..=self.servers.len() + self.network.len() {
            let heard = self
                .network
                .get(&wish.instance)
                .filter(|_| !self.is_ours(&wish.instance))
                .filter(|heard| heard.source != RecordSource::Gds);
            match heard {
                Some(heard) if heard.announcement.url == wish.url => return None,
                None if !others(&wish.instance) => return Some(wish),
                Some(_) | None => wish.instance = renamed(&wish.instance),
            }
        }
        None
    }
}

impl RegistrationRequest {
    /// Returns the requested announcement, if any.
    fn announcement(&self) -> Option<AnnouncedServer> {
        let mdns = self.mdns.as_ref()?;
        let instance = label(&mdns.name);
        if instance.is_empty() {
            return None;
        }
        Some(AnnouncedServer {
            instance,
            url: self.discovery_urls.first()?.clone(),
            capabilities: mdns.capabilities.clone(),
        })
    }
}
