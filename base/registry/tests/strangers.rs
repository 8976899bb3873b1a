//! A registry on a network with hosts that announce and register anything, with a simulated clock.
#![expect(
    clippy::disallowed_methods,
    clippy::panic,
    reason = "a test needs some instant to count from, and fails by a panic"
)]

use std::net::{IpAddr, Ipv4Addr};
use std::time::{Duration, Instant};

use registry::{
    AnnouncedServer, ApplicationType, Channel, ProbeOutcome, RegisterFault, Registered,
    RegistrationRequest, RegistryEvent, RegistrySettings, ServerLoss, ServerRegistry,
};

const SECOND: Duration = Duration::from_secs(1);
const ALIVE: ProbeOutcome = ProbeOutcome::Alive { start_time: None };
const ROBOT: &str = "opc.tcp://10.9.0.2:4840/";

fn announcement(instance: &str, url: &str) -> AnnouncedServer {
    AnnouncedServer {
        instance: instance.to_owned(),
        url: url.to_owned(),
        capabilities: vec!["DA".to_owned()],
    }
}

/// Settings of a small registry, for short floods.
const SETTINGS: fn() -> RegistrySettings = || RegistrySettings {
    most: 128,
    ..RegistrySettings::default()
};

/// Returns a registry with a robot that has answered.
fn start() -> (ServerRegistry, Instant) {
    let (mut registry, now) = (ServerRegistry::new(SETTINGS()), Instant::now());
    registry.announced(announcement("robot", ROBOT), now);
    registry.probed(ROBOT, ALIVE, now);
    (registry, now)
}

fn names(registry: &ServerRegistry) -> Vec<String> {
    let records = registry.find_servers_on_network(0, 0, &[]).into_iter();
    records
        .map(|record| record.announcement.instance.clone())
        .collect()
}

/// Advances the time. Each probe gets its result at once. Returns the probed URLs.
fn pass(
    registry: &mut ServerRegistry,
    (from, to): (Instant, Instant),
    outcome: impl Fn(&str) -> ProbeOutcome,
) -> Vec<String> {
    let mut probed = Vec::new();
    let mut now = from;
    while now < to {
        while let Some(probe) = registry.poll_probe(now) {
            registry.probed(&probe.url, outcome(&probe.url), now);
            probed.push(probe.url);
        }
        registry.handle_timeout(now);
        now += SECOND / 20;
    }
    probed
}

#[test]
fn forged_names_of_many_hosts_keep_no_live_server_off_the_list() {
    let (mut registry, now) = start();
    for number in 0..600 {
        let url = format!("opc.tcp://10.9.{}.{}:4840", number / 200 + 1, number % 200);
        registry.announced(announcement(&format!("forged {number}"), &url), now);
    }
    let plc = "opc.tcp://10.9.0.3:4840";
    registry.announced(announcement("plc", plc), now);
    assert!(names(&registry).contains(&"plc".to_owned()));
    registry.probed(plc, ALIVE, now + SECOND);
    for number in 0..600 {
        let url = format!("opc.tcp://10.8.{}.{}:4840", number / 200 + 1, number % 200);
        registry.announced(announcement(&format!("again {number}"), &url), now + SECOND);
    }
    let all = names(&registry);
    assert!(all.len() <= SETTINGS().most, "{}", all.len());
    for live in ["robot", "plc"] {
        assert!(all.contains(&live.to_owned()), "{live}");
    }
    let lost = |event: &RegistryEvent| {
        matches!(event, RegistryEvent::Vanished { record, loss }
            if *loss != ServerLoss::Displaced || record.announcement.instance == "robot")
    };
    let wrong: Vec<RegistryEvent> = std::iter::from_fn(|| registry.poll_event())
        .filter(lost)
        .collect();
    assert!(wrong.is_empty(), "{wrong:?}");
}

#[test]
fn forged_names_at_the_endpoint_of_a_live_server_displace_neither_it_nor_a_new_one() {
    let (mut registry, now) = start();
    for number in 0..1150 {
        let url = format!("{ROBOT}{number}");
        let at = now + SECOND / 250 * number;
        registry.announced(announcement(&format!("forged {number}"), &url), at);
    }
    assert!(names(&registry).len() < 32, "{:?}", names(&registry));
    let later = now + SECOND * 10;
    registry.announced(announcement("gripper", "opc.tcp://10.9.0.2:4841"), later);
    registry.announced(announcement("further name", &format!("{ROBOT}plc")), later);
    let all = names(&registry);
    for name in ["robot", "gripper", "further name"] {
        assert!(all.contains(&name.to_owned()), "{name} of {all:?}");
    }
    // An endpoint with many names is probed once, and its loss is reported in the same time.
    let probed = pass(&mut registry, (later, later + SECOND * 4), |_| ALIVE);
    let robot = probed.iter().filter(|url| *url == ROBOT).count();
    assert!((3..=6).contains(&robot), "{robot}");
    let killed = later + SECOND * 5;
    let refused = |url: &str| {
        if url == ROBOT {
            ProbeOutcome::Refused
        } else {
            ALIVE
        }
    };
    pass(&mut registry, (killed, killed + SECOND * 2), refused);
    assert_eq!(names(&registry), ["gripper"]);
}

#[test]
fn an_endpoint_that_never_answers_is_probed_with_growing_pauses_whatever_its_names() {
    for outcome in [
        ProbeOutcome::Silent,
        ProbeOutcome::Refused,
        ProbeOutcome::Hanging,
    ] {
        let (mut registry, now) = (ServerRegistry::new(SETTINGS()), Instant::now());
        let mut probed = 0;
        for second in 0..120 {
            let at = now + SECOND * second;
            let url = format!("opc.tcp://10.9.0.7:22/{second}");
            registry.announced(announcement(&format!("ssh {second}"), &url), at);
            probed += pass(&mut registry, (at, at + SECOND), |_| outcome).len();
        }
        assert!((3..=9).contains(&probed), "{probed} times, {outcome:?}");
    }
}

#[test]
fn an_announcement_proves_no_life() {
    let (mut registry, now) = (ServerRegistry::new(SETTINGS()), Instant::now());
    registry.announced(announcement("forged", ROBOT), now);
    registry.announced_start("forged", 17);
    assert!(!registry.has_answered(ROBOT));
    registry.probed(ROBOT, ALIVE, now);
    assert!(registry.has_answered(ROBOT));
    // A further name of the endpoint cannot restart it.
    while registry.poll_event().is_some() {}
    registry.announced(announcement("second", &format!("{ROBOT}x")), now);
    registry.announced_start("second", 18);
    let restarted = |event: RegistryEvent| matches!(event, RegistryEvent::Restarted { .. });
    assert!(!std::iter::from_fn(|| registry.poll_event()).any(restarted));
    registry.announced_start("forged", 19);
    assert!(std::iter::from_fn(|| registry.poll_event()).any(restarted));
}

fn asked(uri: &str, url: &str) -> RegistrationRequest {
    RegistrationRequest {
        server_uri: uri.to_owned(),
        product_uri: String::new(),
        names: vec![("en".to_owned(), uri.to_owned())],
        application_type: ApplicationType::Server,
        gateway_server_uri: String::new(),
        discovery_urls: vec![url.to_owned()],
        semaphore_file_path: String::new(),
        is_online: true,
        mdns: None,
    }
}

fn channel(certificate_uri: Option<&str>) -> Channel {
    Channel {
        is_secured: true,
        certificate_uri: certificate_uri.map(str::to_owned),
        peer: Some(IpAddr::V4(Ipv4Addr::LOCALHOST)),
    }
}

#[test]
fn registrations_that_nothing_verifies_give_way_and_others_stay() {
    let (mut registry, now) = (ServerRegistry::new(SETTINGS()), Instant::now());
    let register = |registry: &mut ServerRegistry, uri: &str, port: u16, certified: bool| {
        let url = format!("opc.tcp://127.0.0.1:{port}");
        let channel = channel(certified.then_some(uri));
        registry.register(asked(uri, &url), &channel, None, now)
    };
    assert_eq!(
        register(&mut registry, "urn:certified", 1, true),
        Ok(Registered::New)
    );
    assert_eq!(
        register(&mut registry, "urn:live", 2, false),
        Ok(Registered::New)
    );
    registry.probed("opc.tcp://127.0.0.1:2", ALIVE, now);
    for number in 0..600 {
        let uri = format!("urn:forged:{number}");
        let registered = register(&mut registry, &uri, 1000 + number, false);
        assert_eq!(registered, Ok(Registered::New), "{number}");
    }
    assert_eq!(
        register(&mut registry, "urn:new", 3, false),
        Ok(Registered::New)
    );
    for uri in ["urn:certified", "urn:live", "urn:new"] {
        assert_eq!(registry.find_servers(&[uri]).count(), 1, "{uri}");
    }
    assert!(registry.find_servers(&[]).count() <= SETTINGS().most);
}

#[test]
fn one_endpoint_has_few_registrations_without_a_certificate() {
    let (mut registry, now) = (ServerRegistry::new(SETTINGS()), Instant::now());
    let mut full = 0;
    for number in 0..100 {
        let url = format!("opc.tcp://127.0.0.1:6000/{number}");
        let asked = asked(&format!("urn:forged:{number}"), &url);
        if let Err(fault) = registry.register(asked, &channel(None), None, now) {
            assert!(matches!(fault, RegisterFault::Full { .. }), "{fault}");
            full += 1;
        }
    }
    assert_eq!((registry.find_servers(&[]).count(), full), (16, 84));
    let own = asked("urn:certified", "opc.tcp://127.0.0.1:6000/own");
    let registered = registry.register(own, &channel(Some("urn:certified")), None, now);
    assert_eq!(registered, Ok(Registered::New));
}

#[test]
fn a_url_that_no_server_is_at_cannot_be_registered() {
    let (mut registry, now) = (ServerRegistry::new(SETTINGS()), Instant::now());
    for url in [
        "file:///etc/passwd",
        "opc.tcp://host:0",
        "opc.tcp://:4840",
        "opc.tcp://host:70000",
        "urn:host",
        "javascript:alert(1)",
    ] {
        let fault = registry.register(asked("urn:a", url), &channel(None), None, now);
        assert!(matches!(fault, Err(RegisterFault::Invalid { .. })), "{url}");
    }
    for url in [
        "opc.tcp://host",
        "opc.tcp://[fe80::1]",
        "opc.tcp://[fe80::1]:4840/a",
        "opc.wss://host:443/ua",
        "https://host",
    ] {
        let registered = registry.register(asked("urn:a", url), &channel(None), None, now);
        assert!(registered.is_ok(), "{url}: {registered:?}");
    }
}

/// Lets the probes of an endpoint fail, each after a second, until its loss. Returns the event of
/// the loss and its time.
fn lost(
    registry: &mut ServerRegistry,
    from: Instant,
    outcome: ProbeOutcome,
) -> (RegistryEvent, Instant) {
    let mut now = from;
    while now < from + SECOND * 10 {
        if let Some(probe) = registry.poll_probe(now) {
            now += SECOND;
            registry.probed(&probe.url, outcome, now);
        }
        let is_loss = |event: &RegistryEvent| {
            matches!(
                event,
                RegistryEvent::Vanished { .. } | RegistryEvent::Gone { .. }
            )
        };
        if let Some(event) = std::iter::from_fn(|| registry.poll_event()).find(is_loss) {
            return (event, now);
        }
        now += SECOND / 100;
    }
    panic!("no loss within 10 s");
}

#[test]
fn a_server_that_fails_before_its_first_answer_is_missed_as_soon_as_any_other() {
    for port in 4840..4940 {
        let url = format!("opc.tcp://10.9.0.2:{port}/");
        for (outcome, loss, most) in [
            (ProbeOutcome::Silent, ServerLoss::Unreachable, SECOND * 3),
            (ProbeOutcome::Hanging, ServerLoss::Hanging, SECOND * 4),
        ] {
            let (mut registry, now) = (ServerRegistry::new(SETTINGS()), Instant::now());
            registry.announced(announcement("gripper", &url), now);
            registry.answers_during_calls(&url);
            registry.announced_start("gripper", 17);
            let (event, at) = lost(&mut registry, now, outcome);
            assert!(
                matches!(&event, RegistryEvent::Vanished { loss: told, .. } if *told == loss),
                "{event:?}"
            );
            assert!(at - now < most, "{url}: {loss:?} after {:?}", at - now);
        }
    }
}

#[test]
fn a_program_that_hangs_before_its_first_answer_is_registered_again_when_it_goes_on() {
    let url = "opc.tcp://127.0.0.1:4841/";
    for (outcome, is_kept) in [(ProbeOutcome::Hanging, true), (ProbeOutcome::Silent, false)] {
        let (mut registry, now) = (ServerRegistry::new(SETTINGS()), Instant::now());
        let gripper = RegistrationRequest {
            product_uri: "urn:ua-bridge:gripper".to_owned(),
            ..asked("urn:gripper", url)
        };
        let registered = registry.register(gripper, &channel(None), None, now);
        assert_eq!(registered, Ok(Registered::New));
        registry.announced(announcement("gripper", url), now);
        registry.announced_start("gripper", 17);
        let (_, at) = lost(&mut registry, now, outcome);
        assert_eq!(registry.find_servers(&[]).count(), 0);
        registry.probed(url, ALIVE, at + SECOND);
        assert_eq!(registry.find_servers(&[]).count(), usize::from(is_kept));
    }
}
