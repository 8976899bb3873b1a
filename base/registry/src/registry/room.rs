//! Space for new servers and names: unverified entries are displaced.

use std::collections::BTreeSet;
use std::time::Instant;

use super::ServerRegistry;
use crate::asked::{RegisterFault, RegistrationRequest};
use crate::loss::ServerLoss;
use crate::network::{AnnouncedServer, host, place};
use crate::share::{AdmissionVerdict, Newcomer, ShareEntry, admit};

impl ServerRegistry {
    /// Makes space for a server that is not registered. An unverified registration may be
    /// displaced.
    pub(super) fn make_room(
        &mut self,
        asked: &RegistrationRequest,
        sender: &str,
        certified: bool,
        now: Instant,
    ) -> Result<(), RegisterFault> {
        let most = self.settings.most;
        // A server with a certificate is not limited by the share of an endpoint.
        let place = if certified {
            String::new()
        } else {
            place_of(asked)
        };
        let newcomer = Newcomer {
            place: &place,
            sender,
        };
        let entries: Vec<ShareEntry<'_>> = self
            .servers
            .values()
            .map(|server| ShareEntry {
                key: &server.asked.server_uri,
                place: &server.place,
                sender: &server.sender,
                arrival: (server.arrival, server.since),
                is_certified: server.certified,
                is_live: self.is_live(&server.asked),
            })
            .collect();
        match admit(&entries, &newcomer, most, now) {
            AdmissionVerdict::Room => Ok(()),
            AdmissionVerdict::InsteadOf(uri) => {
                self.displaced += 1;
                self.end(&uri, ServerLoss::Displaced);
                Ok(())
            }
            AdmissionVerdict::Full => {
                self.refused += 1;
                Err(RegisterFault::Full { most })
            }
        }
    }

    /// Returns whether one of the endpoints of a server has answered.
    fn is_live(&self, asked: &RegistrationRequest) -> bool {
        let mut urls = asked.discovery_urls.iter();
        urls.any(|url| self.watch.has_answered(url))
    }

    /// Makes space for a name that was not announced. Names announced by this program and the URLs
    /// of registered servers stay.
    pub(super) fn make_room_on_network(
        &mut self,
        announcement: &AnnouncedServer,
        now: Instant,
    ) -> bool {
        let place = place(&announcement.url);
        let newcomer = Newcomer {
            sender: host(&place),
            place: &place,
        };
        let registered: BTreeSet<&str> = self
            .servers
            .values()
            .flat_map(|server| &server.asked.discovery_urls)
            .map(|url| url.trim_end_matches('/'))
            .collect();
        let entries: Vec<ShareEntry<'_>> = self
            .network
            .arrivals()
            .map(|(record, arrival)| {
                let AnnouncedServer { instance, url, .. } = &record.announcement;
                ShareEntry {
                    key: instance,
                    place: &arrival.place,
                    sender: host(&arrival.place),
                    arrival: (arrival.order, arrival.since),
                    is_certified: registered.contains(url.trim_end_matches('/')),
                    is_live: self.watch.has_answered_at(&arrival.place),
                }
            })
            .collect();
        match admit(&entries, &newcomer, self.settings.most, now) {
            AdmissionVerdict::Room => true,
            AdmissionVerdict::InsteadOf(instance) => {
                self.displaced += 1;
                self.vanish(&instance, ServerLoss::Displaced);
                true
            }
            AdmissionVerdict::Full => {
                self.refused += 1;
                false
            }
        }
    }
}

/// Returns host and port of the first endpoint of a server.
pub(super) fn place_of(asked: &RegistrationRequest) -> String {
    let first = asked.discovery_urls.first();
    first.map(|url| place(url)).unwrap_or_default()
}
