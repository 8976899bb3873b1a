use std::net::Ipv4Addr;

use super::*;

const OWN: (&str, u16, &str) = ("own", 4841, "ua-own.local.");

fn network() -> Subnets {
    Subnets::of(Ipv4Addr::new(10, 0, 0, 1), Ipv4Addr::new(255, 255, 255, 0))
}

fn from(port: u16) -> SocketAddr {
    SocketAddr::from(([10, 0, 0, 9], port))
}

fn name(labels: &[&str]) -> Vec<u8> {
    let labels = labels.iter().flat_map(|label| {
        let length = u8::try_from(label.len()).unwrap();
        [&[length][..], label.as_bytes()].concat()
    });
    labels.chain([0]).collect()
}

fn record(owner: &[u8], kind: u8, lifetime: u8, data: &[u8]) -> Vec<u8> {
    let length = u16::try_from(data.len()).unwrap().to_be_bytes();
    [owner, &[0, kind, 0, 1, 0, 0, 0, lifetime], &length, data].concat()
}

/// Returns the SRV record of a server.
fn server((instance, port, host): (&str, u16, &str)) -> Vec<u8> {
    let instance = name(&[instance, "_opcua-tcp", "_tcp", "local"]);
    let host = name(&[host.trim_end_matches(".local."), "local"]);
    let server = [&[0, 0, 0, 0][..], &port.to_be_bytes(), &host].concat();
    record(&instance, 33, 120, &server)
}

/// Returns the announcement of a server of the host 10.0.0.7, or its goodbye.
fn announced((instance, port, host): (&str, u16, &str), start: &str, lifetime: u8) -> Vec<u8> {
    let instance = name(&[instance, "_opcua-tcp", "_tcp", "local"]);
    let host = name(&[host.trim_end_matches(".local."), "local"]);
    let server = [&[0, 0, 0, 0][..], &port.to_be_bytes(), &host].concat();
    let start = format!("start={start}");
    let text = [&[u8::try_from(start.len()).unwrap()], start.as_bytes()].concat();
    [
        vec![0, 0, 0x84, 0, 0, 0, 0, 4, 0, 0, 0, 0],
        record(
            &name(&["_opcua-tcp", "_tcp", "local"]),
            12,
            lifetime,
            &instance,
        ),
        record(&instance, 33, lifetime, &server),
        record(&instance, 16, lifetime, &text),
        record(&host, 1, lifetime, &[10, 0, 0, 7]),
    ]
    .concat()
}

fn query() -> Vec<u8> {
    let header = vec![0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0];
    let service = name(&["_opcua-tcp", "_tcp", "local"]);
    [header, service, vec![0, 12, 0, 1]].concat()
}

/// The servers near a program with one server.
struct Program {
    nearby: NearbyServers,
    now: Instant,
}

impl Program {
    fn new() -> Self {
        Self {
            nearby: NearbyServers::default(),
            now: Instant::now(),
        }
    }

    fn take(&mut self, packet: &[u8], port: u16) -> Vec<Sighting> {
        let own = |name: &str| (name == OWN.0).then_some((OWN.1, OWN.2));
        self.nearby
            .take((packet, from(port)), own, &network(), self.now)
    }
}

#[test]
fn announcements_of_a_hundred_others_are_counted_and_cause_no_announcement() {
    let mut program = Program::new();
    let others: Vec<Vec<u8>> = (0..100)
        .map(|number| {
            let instance = format!("device-{number}");
            announced((&instance, 20_000 + number, &instance), "1", 120)
        })
        .collect();
    let mut newcomers = 0;
    for packet in &others {
        newcomers += program.take(packet, MDNS_PORT).len();
    }
    assert_eq!(newcomers, 8, "the first few are answered");
    assert_eq!(program.nearby.count(), 100);
    for packet in &others {
        assert_eq!(program.take(packet, MDNS_PORT), []);
    }
    assert_eq!(program.take(&query(), MDNS_PORT), []);
    assert_eq!(program.nearby.count(), 100);
}

#[test]
fn a_program_that_may_not_receive_responses_is_announced_to() {
    let mut program = Program::new();
    assert_eq!(program.take(&query(), 40_000), [Sighting::Newcomer]);
    for number in 0..20 {
        let instance = format!("device-{number}");
        let packet = announced((&instance, 1, "host"), "1", 120);
        assert_eq!(program.take(&packet, 40_000), [Sighting::Newcomer]);
        assert_eq!(program.take(&packet, 40_000), []);
    }
}

#[test]
fn servers_that_left_or_fell_silent_are_not_counted() {
    let mut program = Program::new();
    for instance in ["a", "b"] {
        program.take(&announced((instance, 1, instance), "1", 120), MDNS_PORT);
    }
    program.take(&announced(("A", 1, "a"), "1", 0), MDNS_PORT);
    assert_eq!(program.nearby.count(), 1);
    program
        .nearby
        .forget(program.now + VALID - Duration::from_secs(1));
    assert_eq!(program.nearby.count(), 1);
    program.nearby.forget(program.now + VALID);
    assert_eq!(program.nearby.count(), 0);
}

#[test]
fn another_server_with_the_name_of_this_program_is_a_rival() {
    let mut program = Program::new();
    assert_eq!(program.take(&announced(OWN, "1", 120), MDNS_PORT), []);
    let rival = |sightings: Vec<Sighting>| match &sightings[..] {
        [Sighting::Rival { announcement }] => announcement.url.clone(),
        _ => panic!("{sightings:?}"),
    };
    for (other, url) in [
        ((OWN.0, OWN.1, "other.local."), "opc.tcp://10.0.0.7:4841"),
        ((OWN.0, 4842, OWN.2), "opc.tcp://10.0.0.7:4842"),
    ] {
        let packet = announced(other, "1", 120);
        assert_eq!(rival(program.take(&packet, MDNS_PORT)), url);
    }
    let goodbye = announced((OWN.0, 4842, OWN.2), "1", 0);
    assert_eq!(program.take(&goodbye, MDNS_PORT), []);
    let elsewhere = Subnets::of(Ipv4Addr::new(10, 9, 0, 1), Ipv4Addr::new(255, 255, 255, 0));
    let own = |_: &str| Some((1, "own.local."));
    let packet = announced((OWN.0, 4842, OWN.2), "1", 120);
    let seen = program
        .nearby
        .take((&packet, from(MDNS_PORT)), own, &elsewhere, program.now);
    assert_eq!(seen, [], "its address is in no subnet of the interface");
}

#[test]
fn a_rival_that_announces_its_address_apart_is_at_the_address_of_the_sender() {
    let mut program = Program::new();
    let header = |records: u8| vec![0, 0, 0x84, 0, 0, 0, 0, records, 0, 0, 0, 0];
    let url = |sightings: Vec<Sighting>| match &sightings[..] {
        [Sighting::Rival { announcement }] => announcement.url.clone(),
        _ => panic!("{sightings:?}"),
    };
    let other = (OWN.0, 4842, "other.local.");
    let alone = [header(1), server(other)].concat();
    assert_eq!(
        url(program.take(&alone, MDNS_PORT)),
        "opc.tcp://10.0.0.9:4842"
    );
    // A withdrawn address is not that of the server.
    let host = name(&["other", "local"]);
    let withdrawn = record(&host, 1, 0, &[10, 0, 0, 8]);
    let packet = [header(2), server(other), withdrawn].concat();
    assert_eq!(
        url(program.take(&packet, MDNS_PORT)),
        "opc.tcp://10.0.0.9:4842"
    );
    let address = record(&host, 1, 120, &[10, 0, 0, 8]);
    let packet = [header(2), server(other), address].concat();
    assert_eq!(
        url(program.take(&packet, MDNS_PORT)),
        "opc.tcp://10.0.0.8:4842"
    );
}

#[test]
fn packets_of_hosts_outside_the_subnets_are_ignored() {
    let mut program = Program::new();
    let packet = announced(("device", 4842, "device"), "1", 120);
    let outside = SocketAddr::from(([10, 0, 1, 9], 40_000));
    let none = |_: &str| None;
    for packet in [&packet, &query()] {
        let seen = program
            .nearby
            .take((packet, outside), none, &network(), program.now);
        assert_eq!(seen, []);
    }
    assert!(!program.nearby.knows("device"));
    program.take(&packet, MDNS_PORT);
    assert!(program.nearby.knows("Device"));
}

#[test]
fn the_discovery_server_is_reported_once_for_each_run() {
    let mut program = Program::new();
    program.nearby.heed(Some("opc.tcp://10.0.0.7:4840"));
    let lds = ("ua-lds", 4840, "lds");
    let started = |program: &mut Program, start: &str| {
        let seen = program.take(&announced(lds, start, 120), MDNS_PORT);
        let heeded = seen.iter().find_map(|sighting| match sighting {
            Sighting::Heeded { aside, .. } => Some(aside.start_time),
            Sighting::Left { .. } | Sighting::Rival { .. } | Sighting::Newcomer => None,
        });
        heeded.map(Option::unwrap)
    };
    assert_eq!(started(&mut program, "1"), Some(1));
    assert_eq!(started(&mut program, "1"), None);
    assert_eq!(started(&mut program, "2"), Some(2));
    // It is another run, even with the same start time, as of a server without a clock.
    let left = program.take(&announced(lds, "2", 0), MDNS_PORT);
    let instance = lds.0.to_owned();
    assert_eq!(left, [Sighting::Left { instance }]);
    assert_eq!(started(&mut program, "2"), Some(2));
    program.now += VALID;
    assert_eq!(started(&mut program, "2"), Some(2));
    // The same port at another host is not the discovery server.
    program.nearby.heed(Some("opc.tcp://10.0.0.8:4840"));
    assert_eq!(started(&mut program, "3"), None);
    program.nearby.heed(None);
    assert_eq!(started(&mut program, "4"), None);
}
