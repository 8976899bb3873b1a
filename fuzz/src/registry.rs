//! Fuzzes a registry of servers with operations: registrations, announcements, probes and passing
//! time.

use std::collections::BTreeSet;
use std::net::{IpAddr, Ipv4Addr};
use std::time::{Duration, Instant};

use registry::{
    AnnouncedServer, ApplicationType, Channel, MdnsConfiguration, ProbeOutcome,
    RegistrationRequest, RegistryEvent, RegistrySettings, ServerRegistry,
};

use crate::input::Input;

const MOST: usize = 6;

/// Runs operations on the registry. Each server is reported once when it is registered and once
/// when it is removed, lists are bounded, record ids rise, and no timeout is in the past.
pub fn registry(operations: &[u8]) {
    let settings = RegistrySettings {
        allow_unsecured: true,
        forget_after: Duration::from_secs(20),
        most: MOST,
        ..RegistrySettings::default()
    };
    let mut played = Played {
        registry: ServerRegistry::new(settings),
        now: begin(),
        registered: BTreeSet::new(),
        seen: BTreeSet::new(),
        ours: BTreeSet::new(),
        ids: BTreeSet::new(),
        last_id: 0,
    };
    let mut input = Input::new(operations);
    // Each operation takes two bytes or more.
    while !input.is_empty() {
        played.operate(&mut input);
        played.take_events();
        played.check();
    }
}

#[expect(
    clippy::disallowed_methods,
    reason = "there is no other way to make one, and what it is changes nothing"
)]
fn begin() -> Instant {
    Instant::now()
}

struct Played {
    registry: ServerRegistry,
    now: Instant,
    /// The registered servers, according to the events.
    registered: BTreeSet<String>,
    /// The servers on the network, according to the events.
    seen: BTreeSet<String>,
    /// The announcements for servers, according to the events.
    ours: BTreeSet<String>,
    /// The previous record ids, and the largest id assigned.
    ids: BTreeSet<u32>,
    last_id: u32,
}

impl Played {
    fn operate(&mut self, input: &mut Input<'_>) {
        let (what, which) = (input.byte(), input.byte());
        let now = self.now;
        match what % 10 {
            0 => {
                let how = input.byte();
                let channel = Channel {
                    is_secured: how & 1 != 0,
                    certificate_uri: (how & 2 != 0).then(|| uri(which)),
                    peer: (how & 16 != 0).then_some(IpAddr::V4(Ipv4Addr::LOCALHOST)),
                };
                let there = (how & 4 != 0).then_some(how & 8 != 0);
                let asked = asked(which, how, input);
                // The registration may be refused; the events must fit either result.
                drop(self.registry.register(asked, &channel, there, now));
            }
            1 => {
                let announcement = AnnouncedServer {
                    instance: name(which),
                    url: url(input.byte()),
                    capabilities: Vec::new(),
                };
                self.registry.announced(announcement, now);
            }
            2 => self.registry.withdrawn(&name(which)),
            3 => self
                .registry
                .probed(&url(which), outcome(input.byte()), now),
            4 => self.renamed(&name(which), &name(input.byte())),
            5 => self.registry.suspect(&url(which)),
            6 => self.registry.semaphore_gone(&uri(which)),
            7 => self
                .registry
                .stood_still(Duration::from_millis(which.into())),
            8 => self.listed(which, input),
            _ => self.pass(Duration::from_millis(u64::from(which) * 40), input),
        }
    }

    /// Replaces the servers that a Global Discovery Server lists.
    fn listed(&mut self, which: u8, input: &mut Input<'_>) {
        let servers = (0..which % 4).map(|_| AnnouncedServer {
            instance: name(input.byte()),
            url: url(input.byte()),
            capabilities: Vec::new(),
        });
        let servers = servers.collect();
        self.registry.listed(servers, self.now);
    }

    /// Renames an announcement; mDNS uses another name only if it is free.
    fn renamed(&mut self, from: &str, to: &str) {
        let is_free = !self.ours.contains(to) && !self.seen.contains(to);
        if is_free && self.ours.remove(from) {
            self.registry.renamed(from, to, self.now);
            self.ours.insert(to.to_owned());
        }
    }

    fn pass(&mut self, how_long: Duration, input: &mut Input<'_>) {
        self.now += how_long;
        let now = self.now;
        self.registry.handle_timeout(now);
        let mut tries = 0;
        while let Some(probe) = self.registry.poll_probe(now) {
            assert!(self.registry.watches(&probe.url), "{}", probe.url);
            self.registry.probed(&probe.url, outcome(input.byte()), now);
            tries += 1;
            assert!(tries <= 16, "no end of tries");
        }
        let due = self.registry.poll_timeout();
        assert!(due.is_none_or(|due| due > now), "a wait in the past");
    }

    fn take_events(&mut self) {
        while let Some(event) = self.registry.poll_event() {
            match event {
                RegistryEvent::Registered { server_uri, .. } => {
                    self.registered.insert(server_uri);
                }
                RegistryEvent::Gone { server_uri, .. } => {
                    assert!(self.registered.remove(&server_uri), "{server_uri} was not");
                }
                RegistryEvent::Seen(record) => {
                    self.seen.insert(record.announcement.instance);
                }
                RegistryEvent::Vanished { record, .. } => {
                    let name = record.announcement.instance;
                    assert!(self.seen.remove(&name), "{name} was not seen");
                }
                RegistryEvent::Announce(announcement) => {
                    self.ours.insert(announcement.instance);
                }
                RegistryEvent::Withdraw { instance } => {
                    assert!(self.ours.remove(&instance), "{instance} was not announced");
                }
                _ => {}
            }
        }
    }

    fn check(&mut self) {
        let servers = self.registry.find_servers(&[]);
        let servers: BTreeSet<String> =
            servers.map(|(asked, _)| asked.server_uri.clone()).collect();
        assert_eq!(servers, self.registered, "listed and told");
        assert!(servers.len() <= MOST);
        let records = self.registry.find_servers_on_network(0, 0, &[]);
        assert!(records.len() <= 2 * MOST, "{} records", records.len());
        let ids: Vec<u32> = records.iter().map(|record| record.record_id).collect();
        assert!(ids.is_sorted_by(|one, next| one < next), "{ids:?}");
        let names = records
            .iter()
            .map(|record| record.announcement.instance.clone());
        let names: BTreeSet<String> = names.collect();
        let told: BTreeSet<String> = self.seen.union(&self.ours).cloned().collect();
        assert_eq!(names, told, "on the network and told");
        for id in &ids {
            assert!(self.ids.contains(id) || *id > self.last_id, "{id} again");
        }
        self.last_id = self.last_id.max(ids.last().copied().unwrap_or_default());
        self.ids = ids.into_iter().collect();
    }
}

fn uri(which: u8) -> String {
    format!("urn:{}", which % 8)
}

fn name(which: u8) -> String {
    format!("n{}", which % 8)
}

fn url(which: u8) -> String {
    format!("opc.tcp://10.0.0.{}:4840", which % 8)
}

fn outcome(which: u8) -> ProbeOutcome {
    match which % 6 {
        0 => ProbeOutcome::Refused,
        1 => ProbeOutcome::Silent,
        2 => ProbeOutcome::Hanging,
        3 => ProbeOutcome::Untried,
        4 => ProbeOutcome::Alive { start_time: None },
        _ => ProbeOutcome::Alive {
            start_time: Some(i64::from(which)),
        },
    }
}

fn asked(which: u8, how: u8, input: &mut Input<'_>) -> RegistrationRequest {
    let urls = usize::from(input.byte() % 3);
    RegistrationRequest {
        server_uri: uri(which),
        product_uri: String::new(),
        names: vec![(String::new(), "n".to_owned())],
        application_type: ApplicationType::Server,
        gateway_server_uri: String::new(),
        discovery_urls: (0..urls).map(|_| url(input.byte())).collect(),
        semaphore_file_path: match how & 4 {
            0 => String::new(),
            _ => "/there".to_owned(),
        },
        is_online: how & 0x30 != 0,
        mdns: (how & 0x40 != 0).then(|| MdnsConfiguration {
            name: name(input.byte()),
            capabilities: Vec::new(),
        }),
    }
}
