//! Servers that a Global Discovery Server lists, beside those that are announced and registered.
#![expect(
    clippy::disallowed_methods,
    reason = "a test needs some instant to count from"
)]

use std::time::{Duration, Instant};

use registry::{
    AnnouncedServer, ApplicationType, Channel, MdnsConfiguration, ProbeOutcome, RecordSource,
    RegistrationRequest, RegistryEvent, RegistrySettings, ServerLoss, ServerRegistry,
};

const SECOND: Duration = Duration::from_secs(1);
const ALIVE: ProbeOutcome = ProbeOutcome::Alive { start_time: None };
const URL: &str = "opc.tcp://10.1.0.5:4840/arm";

fn start() -> (ServerRegistry, Instant) {
    (
        ServerRegistry::new(RegistrySettings::default()),
        Instant::now(),
    )
}

fn arm(url: &str) -> AnnouncedServer {
    AnnouncedServer {
        instance: "arm".to_owned(),
        url: url.to_owned(),
        capabilities: vec!["DA".to_owned()],
    }
}

fn shown(registry: &ServerRegistry) -> Vec<(String, RecordSource)> {
    let records = registry.find_servers_on_network(0, 0, &[]).into_iter();
    records
        .map(|record| (record.announcement.instance.clone(), record.source))
        .collect()
}

fn losses(registry: &mut ServerRegistry) -> Vec<ServerLoss> {
    let mut losses = Vec::new();
    while let Some(event) = registry.poll_event() {
        if let RegistryEvent::Vanished { loss, .. } = event {
            losses.push(loss);
        }
    }
    losses
}

fn of_gds(name: &str) -> Vec<(String, RecordSource)> {
    vec![(name.to_owned(), RecordSource::Gds)]
}

#[test]
fn a_listed_server_is_shown_while_it_answers_and_is_listed() {
    let (mut registry, now) = start();
    registry.listed(vec![arm(URL)], now);
    assert_eq!(shown(&registry), [], "a list does not prove that it runs");
    assert_eq!(registry.poll_probe(now + SECOND).unwrap().url, URL);
    registry.probed(URL, ALIVE, now + SECOND);
    assert_eq!(shown(&registry), of_gds("arm"));
    registry.withdrawn("arm");
    assert_eq!(shown(&registry), of_gds("arm"), "mDNS does not withdraw it");
    registry.probed(URL, ProbeOutcome::Refused, now + SECOND);
    assert_eq!(losses(&mut registry), [ServerLoss::Unreachable]);
    let again = registry.poll_probe(now + 4 * SECOND).unwrap();
    assert_eq!(again.url, URL, "a listed server is still probed");
    registry.probed(URL, ALIVE, now + 4 * SECOND);
    assert_eq!(shown(&registry), of_gds("arm"));
    registry.listed(Vec::new(), now + 5 * SECOND);
    assert_eq!(losses(&mut registry), [ServerLoss::Unlisted]);
    assert_eq!(shown(&registry), []);
    assert!(!registry.watches(URL));
}

#[test]
fn multicast_takes_the_place_of_the_list_and_the_list_returns_afterwards() {
    let (mut registry, now) = start();
    registry.listed(vec![arm(URL)], now);
    registry.probed(URL, ALIVE, now);
    let announced = AnnouncedServer {
        instance: "arm-pc".to_owned(),
        ..arm(URL)
    };
    registry.announced(announced, now);
    let multicast = |name: &str| vec![(name.to_owned(), RecordSource::Multicast)];
    assert_eq!(shown(&registry), multicast("arm-pc"));
    assert_eq!(losses(&mut registry), [ServerLoss::Superseded]);
    registry.probed(URL, ALIVE, now);
    registry.listed(vec![arm(URL)], now);
    assert_eq!(shown(&registry), multicast("arm-pc"), "one record each");
    registry.withdrawn("arm-pc");
    registry.probed(URL, ALIVE, now + SECOND);
    assert_eq!(shown(&registry), of_gds("arm"));
    // The same name and URL by mDNS is the same server from another source.
    registry.announced(arm(URL), now + SECOND);
    assert_eq!(shown(&registry), multicast("arm"));
    // Another server of this name does not hide the listed server.
    registry.withdrawn("arm");
    registry.announced(arm("opc.tcp://10.0.0.9:4840"), now + SECOND);
    registry.probed(URL, ALIVE, now + SECOND);
    let both = [multicast("arm"), of_gds("arm (2)")].concat();
    assert_eq!(shown(&registry), both);
}

#[test]
fn a_server_that_registers_takes_the_place_of_the_list() {
    let (mut registry, now) = start();
    registry.listed(vec![arm(URL)], now);
    registry.probed(URL, ALIVE, now);
    let asked = RegistrationRequest {
        server_uri: "urn:arm".to_owned(),
        product_uri: String::new(),
        names: vec![("en".to_owned(), "Arm".to_owned())],
        application_type: ApplicationType::Server,
        gateway_server_uri: String::new(),
        discovery_urls: vec![URL.to_owned()],
        semaphore_file_path: String::new(),
        is_online: true,
        mdns: Some(MdnsConfiguration {
            name: "arm".to_owned(),
            capabilities: Vec::new(),
        }),
    };
    let channel = Channel {
        is_secured: true,
        certificate_uri: Some("urn:arm".to_owned()),
        peer: None,
    };
    registry
        .register(asked.clone(), &channel, None, now)
        .unwrap();
    let registered = vec![("arm".to_owned(), RecordSource::Registration)];
    assert_eq!(shown(&registry), registered);
    assert_eq!(losses(&mut registry), [ServerLoss::Superseded]);
    registry.probed(URL, ALIVE, now);
    assert_eq!(shown(&registry), registered, "one record each");
    let offline = RegistrationRequest {
        is_online: false,
        ..asked
    };
    registry.register(offline, &channel, None, now).unwrap();
    registry.probed(URL, ALIVE, now + SECOND);
    assert_eq!(shown(&registry), of_gds("arm"));
}

#[test]
fn a_full_table_of_announced_servers_has_no_listed_server() {
    let settings = RegistrySettings {
        most: 4,
        ..RegistrySettings::default()
    };
    let (now, mut registry) = (Instant::now(), ServerRegistry::new(settings));
    for number in 0..4 {
        let announcement = AnnouncedServer {
            instance: format!("robot-{number}"),
            ..arm(&format!("opc.tcp://10.0.{number}.1:4840"))
        };
        registry.announced(announcement, now);
    }
    let before = shown(&registry);
    registry.listed(vec![arm(URL)], now);
    registry.probed(URL, ALIVE, now);
    assert_eq!(shown(&registry), before);
}
