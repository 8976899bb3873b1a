//! A registry with hand-made servers and a simulated clock.
#![expect(
    clippy::disallowed_methods,
    reason = "a test needs some instant to count from"
)]

use std::time::{Duration, Instant};

use registry::{
    AnnouncedServer, ApplicationType, Channel, MdnsConfiguration, ProbeOutcome, RegisterFault,
    Registered, RegistrationRequest, RegistryEvent, RegistrySettings, ServerLoss, ServerRegistry,
};

const SECOND: Duration = Duration::from_secs(1);

fn secured(uri: &str) -> Channel {
    Channel {
        is_secured: true,
        certificate_uri: Some(uri.to_owned()),
        peer: None,
    }
}

fn gripper() -> RegistrationRequest {
    RegistrationRequest {
        server_uri: "urn:cell:gripper".to_owned(),
        product_uri: "urn:maker:2f85".to_owned(),
        names: vec![("en".to_owned(), "Gripper".to_owned())],
        application_type: ApplicationType::Server,
        gateway_server_uri: String::new(),
        discovery_urls: vec!["opc.tcp://127.0.0.1:4841".to_owned()],
        semaphore_file_path: String::new(),
        is_online: true,
        mdns: Some(MdnsConfiguration {
            name: "gripper-pc-4841".to_owned(),
            capabilities: vec!["DA".to_owned()],
        }),
    }
}

fn robot() -> AnnouncedServer {
    AnnouncedServer {
        instance: "robot-pc-4842".to_owned(),
        url: "opc.tcp://pc:4842/robot".to_owned(),
        capabilities: vec!["NA".to_owned(), "Skills".to_owned()],
    }
}

fn register(
    registry: &mut ServerRegistry,
    asked: &RegistrationRequest,
    now: Instant,
) -> Result<Registered, RegisterFault> {
    let channel = secured("urn:cell:gripper");
    registry.register(asked.clone(), &channel, None, now)
}

fn events(registry: &mut ServerRegistry) -> Vec<RegistryEvent> {
    std::iter::from_fn(|| registry.poll_event()).collect()
}

fn start() -> (ServerRegistry, Instant) {
    (
        ServerRegistry::new(RegistrySettings::default()),
        Instant::now(),
    )
}

#[test]
fn a_server_that_registers_is_listed_announced_and_looked_after() {
    let (mut registry, now) = start();
    assert_eq!(
        register(&mut registry, &gripper(), now),
        Ok(Registered::New)
    );
    assert_eq!(
        register(&mut registry, &gripper(), now),
        Ok(Registered::Again)
    );
    let happened = events(&mut registry);
    assert!(
        matches!(&*happened, [RegistryEvent::Registered { .. }, RegistryEvent::Announce(wish)] if wish.instance == "gripper-pc-4841"),
        "{happened:?}"
    );
    assert_eq!(registry.find_servers(&[]).count(), 1);
    assert_eq!(registry.find_servers(&["urn:other"]).count(), 0);
    assert_eq!(
        registry.find_servers_on_network(0, 0, &["da"]).len(),
        1,
        "whatever the case"
    );
    assert_eq!(registry.poll_probe(now), None, "it has just been heard of");
    let probe = registry.poll_probe(now + SECOND).unwrap();
    assert_eq!(probe.url, "opc.tcp://127.0.0.1:4841");
    assert_eq!(registry.poll_probe(now + SECOND), None, "one try at a time");
}

#[test]
fn each_fault_has_its_status() {
    let (mut registry, now) = start();
    let mut fault = |change: &dyn Fn(&mut RegistrationRequest), channel: &Channel, semaphore| {
        let mut asked = gripper();
        change(&mut asked);
        registry
            .register(asked, channel, semaphore, now)
            .unwrap_err()
            .status()
    };
    let channel = secured("urn:cell:gripper");
    let open = Channel {
        is_secured: false,
        certificate_uri: None,
        peer: None,
    };
    assert_eq!(
        fault(&|_| {}, &open, None),
        0x80E6_0000,
        "BadSecurityModeInsufficient"
    );
    assert_eq!(
        fault(&|_| {}, &secured("urn:other"), None),
        0x804F_0000,
        "BadServerUriInvalid"
    );
    assert_eq!(
        fault(&|asked| asked.server_uri.clear(), &channel, None),
        0x804F_0000
    );
    assert_eq!(
        fault(&|asked| asked.names.clear(), &channel, None),
        0x8050_0000,
        "BadServerNameMissing"
    );
    assert_eq!(
        fault(&|asked| asked.discovery_urls.clear(), &channel, None),
        0x8051_0000,
        "BadDiscoveryUrlMissing"
    );
    assert_eq!(
        fault(&|_| {}, &channel, Some(false)),
        0x8052_0000,
        "BadSempahoreFileMissing"
    );
    let urls = vec!["opc.tcp://h:1".to_owned(); 768];
    assert_eq!(
        fault(&|asked| asked.discovery_urls = urls.clone(), &channel, None),
        0x80AB_0000
    );
    let long = "x".repeat(2000);
    assert_eq!(
        fault(&|asked| asked.product_uri = long.clone(), &channel, None),
        0x80AB_0000
    );
    assert_eq!(
        fault(
            &|asked| asked.application_type = ApplicationType::Client,
            &channel,
            None
        ),
        0x80AB_0000
    );
    assert_eq!(
        registry.find_servers(&[]).count(),
        0,
        "nothing of it was taken"
    );
    assert_eq!(registry.poll_event(), None);
}

#[test]
fn taking_the_registration_back_removes_it_at_once() {
    let (mut registry, now) = start();
    register(&mut registry, &gripper(), now).unwrap();
    events(&mut registry);
    let offline = RegistrationRequest {
        is_online: false,
        ..gripper()
    };
    assert_eq!(
        register(&mut registry, &offline, now),
        Ok(Registered::Withdrawn)
    );
    let happened = events(&mut registry);
    assert_eq!(
        happened,
        [
            RegistryEvent::Withdraw {
                instance: "gripper-pc-4841".to_owned()
            },
            RegistryEvent::Gone {
                server_uri: "urn:cell:gripper".to_owned(),
                loss: ServerLoss::Unregistered
            }
        ]
    );
    assert!(registry.find_servers_on_network(0, 0, &[]).is_empty());
    assert_eq!(registry.poll_timeout(), None, "nobody is looked after");
}

#[test]
fn who_registers_no_more_is_forgotten_unless_a_semaphore_file_keeps_it() {
    let (mut registry, now) = start();
    register(&mut registry, &gripper(), now).unwrap();
    let installed = RegistrationRequest {
        server_uri: "urn:cell:installed".to_owned(),
        semaphore_file_path: "/run/installed".to_owned(),
        mdns: None,
        discovery_urls: vec!["opc.tcp://127.0.0.1:5000".to_owned()],
        ..gripper()
    };
    let channel = secured("urn:cell:installed");
    registry
        .register(installed, &channel, Some(true), now)
        .unwrap();
    events(&mut registry);
    let later = now + RegistrySettings::default().forget_after;
    registry.handle_timeout(later - SECOND);
    assert_eq!(registry.find_servers(&[]).count(), 2);
    registry.handle_timeout(later);
    let left: Vec<_> = registry
        .find_servers(&[])
        .map(|(asked, _)| &*asked.server_uri)
        .collect();
    assert_eq!(left, ["urn:cell:installed"]);
    assert!(events(&mut registry).contains(&RegistryEvent::Gone {
        server_uri: "urn:cell:gripper".to_owned(),
        loss: ServerLoss::Expired
    }));
    registry.semaphore_gone("urn:cell:installed");
    assert_eq!(registry.find_servers(&[]).count(), 0);
}

#[test]
fn a_killed_server_is_lost_within_two_seconds_without_a_goodbye() {
    let (mut registry, now) = start();
    registry.announced(robot(), now);
    assert!(matches!(&*events(&mut registry), [RegistryEvent::Seen(_)]));
    // It is probed each second. It is killed right after the first answer, and its host disappears,
    // too.
    let mut lost_after = None;
    for tenth in 1..100_u32 {
        let time = now + SECOND / 10 * tenth;
        while let Some(probe) = registry.poll_probe(time) {
            let outcome = if time <= now + SECOND {
                ProbeOutcome::Alive { start_time: None }
            } else {
                ProbeOutcome::Silent
            };
            registry.probed(&probe.url, outcome, time);
        }
        if let Some(RegistryEvent::Vanished { loss, .. }) = registry.poll_event() {
            assert_eq!(loss, ServerLoss::Unreachable);
            lost_after.get_or_insert(time - now - SECOND);
        }
    }
    // From the last answer on, which came up to a second before it was killed.
    let lost_after = lost_after.unwrap();
    assert!(
        (SECOND..=SECOND * 2).contains(&lost_after),
        "{lost_after:?}"
    );
    assert!(registry.find_servers_on_network(0, 0, &[]).is_empty());
}

#[test]
fn a_program_that_takes_connections_and_says_nothing_hangs() {
    let (mut registry, now) = start();
    registry.announced(robot(), now);
    events(&mut registry);
    let url = robot().url;
    registry.answers_during_calls(&url);
    registry.probed(&url, ProbeOutcome::Alive { start_time: None }, now);
    registry.probed(&url, ProbeOutcome::Hanging, now + SECOND * 2);
    assert_eq!(registry.poll_event(), None, "it may compute");
    registry.probed(&url, ProbeOutcome::Hanging, now + SECOND * 3);
    let happened = events(&mut registry);
    assert!(
        matches!(
            &*happened,
            [RegistryEvent::Vanished {
                loss: ServerLoss::Hanging,
                ..
            }]
        ),
        "{happened:?}"
    );
}

#[test]
fn a_server_that_may_be_busy_with_a_method_is_kept_while_its_host_accepts_connections() {
    let (mut registry, now) = start();
    register(&mut registry, &gripper(), now).unwrap();
    events(&mut registry);
    let url = gripper().discovery_urls[0].clone();
    registry.probed(&url, ProbeOutcome::Alive { start_time: None }, now);
    for second in 1..59 {
        registry.probed(&url, ProbeOutcome::Hanging, now + SECOND * second);
        assert_eq!(registry.poll_event(), None, "after {second} s");
    }
    // Its host has disappeared: that is detected as fast as for any other server.
    let answered = now + SECOND * 59;
    registry.probed(&url, ProbeOutcome::Alive { start_time: None }, answered);
    registry.probed(&url, ProbeOutcome::Silent, answered + SECOND * 2);
    let happened = events(&mut registry);
    let is_gone = |event: &RegistryEvent| {
        matches!(
            event,
            RegistryEvent::Gone {
                loss: ServerLoss::Unreachable,
                ..
            }
        )
    };
    assert!(happened.iter().any(is_gone), "{happened:?}");
}

#[test]
fn a_server_of_ours_answers_during_calls_and_hangs_after_three_seconds() {
    let (mut registry, now) = start();
    let ours = RegistrationRequest {
        product_uri: "urn:ua-bridge:plant".to_owned(),
        ..gripper()
    };
    register(&mut registry, &ours, now).unwrap();
    events(&mut registry);
    let url = ours.discovery_urls[0].clone();
    registry.probed(&url, ProbeOutcome::Alive { start_time: None }, now);
    registry.probed(&url, ProbeOutcome::Hanging, now + SECOND * 3);
    let happened = events(&mut registry);
    let hangs = |event: &RegistryEvent| {
        matches!(
            event,
            RegistryEvent::Gone {
                loss: ServerLoss::Hanging,
                ..
            }
        )
    };
    assert!(happened.iter().any(hangs), "{happened:?}");
}

#[test]
fn one_that_listens_and_has_never_answered_is_given_time_to_start() {
    let (mut registry, now) = start();
    registry.announced(robot(), now);
    events(&mut registry);
    let url = robot().url;
    registry.answers_during_calls(&url);
    for second in 1..30 {
        registry.probed(&url, ProbeOutcome::Hanging, now + SECOND * second);
        assert_eq!(registry.poll_event(), None, "after {second} s");
    }
    registry.probed(&url, ProbeOutcome::Hanging, now + SECOND * 30);
    assert_eq!(events(&mut registry).len(), 1, "it hangs");
}

#[test]
fn the_time_in_which_nobody_listened_is_held_against_nobody() {
    let (mut registry, now) = start();
    registry.announced(robot(), now);
    events(&mut registry);
    let url = robot().url;
    registry.probed(&url, ProbeOutcome::Alive { start_time: None }, now);
    registry.stood_still(SECOND * 10);
    registry.probed(&url, ProbeOutcome::Silent, now + SECOND * 11);
    assert_eq!(registry.poll_event(), None, "a second of it counts");
    registry.probed(&url, ProbeOutcome::Silent, now + SECOND * 12);
    assert_eq!(events(&mut registry).len(), 1, "two seconds do");
}

#[test]
fn a_connection_that_broke_off_has_its_server_tried_at_once() {
    let (mut registry, now) = start();
    registry.announced(robot(), now);
    let url = robot().url;
    registry.probed(&url, ProbeOutcome::Alive { start_time: None }, now);
    assert_eq!(registry.poll_probe(now), None);
    registry.suspect(&url);
    assert_eq!(registry.poll_probe(now).unwrap().url, url);
    assert!(registry.watches(&url));
    registry.withdrawn(&robot().instance);
    assert!(!registry.watches(&url));
}

#[test]
fn many_servers_are_tried_in_turn_and_less_often() {
    let settings = RegistrySettings {
        most: 2000,
        ..RegistrySettings::default()
    };
    let (mut registry, now) = (ServerRegistry::new(settings), Instant::now());
    let tries_in = |registry: &mut ServerRegistry, from: u32, to: u32| {
        let mut most_at_once = 0;
        let mut tries = 0;
        for tick in from..to {
            let time = now + SECOND / 100 * tick;
            let due = std::iter::from_fn(|| registry.poll_probe(time)).count();
            most_at_once = most_at_once.max(due);
            tries += due;
        }
        (tries, most_at_once)
    };
    for (from, to) in [(0, 100), (100, 2000)] {
        for number in from..to {
            let announcement = AnnouncedServer {
                instance: format!("robot-{number}"),
                url: format!("opc.tcp://10.0.0.1:{}", 10_000 + number),
                capabilities: Vec::new(),
            };
            registry.announced(announcement, now);
        }
        match to {
            100 => {
                let (tries, at_once) = tries_in(&mut registry, 0, 1000);
                assert!((900..=1100).contains(&tries), "{tries}, once a second each");
                assert!(at_once <= 20, "{at_once} of them at once");
            }
            _ => {
                tries_in(&mut registry, 1000, 2000);
                let (tries, _) = tries_in(&mut registry, 2000, 3000);
                assert!((4500..=5100).contains(&tries), "{tries}, 500 a second");
            }
        }
    }
}

#[test]
fn what_is_announced_for_a_server_follows_when_it_is_called_otherwise() {
    let (mut registry, now) = start();
    register(&mut registry, &gripper(), now).unwrap();
    events(&mut registry);
    let before = registry.find_servers_on_network(0, 0, &[])[0].clone();
    registry.renamed("gripper-pc-4841", "gripper-pc-4841 (2)", now);
    let records = registry.find_servers_on_network(0, 0, &[]);
    assert_eq!(records.len(), 1);
    assert_eq!(records[0].announcement.instance, "gripper-pc-4841 (2)");
    assert!(records[0].record_id > before.record_id);
    let offline = RegistrationRequest {
        is_online: false,
        ..gripper()
    };
    register(&mut registry, &offline, now).unwrap();
    assert!(events(&mut registry).contains(&RegistryEvent::Withdraw {
        instance: "gripper-pc-4841 (2)".to_owned()
    }));
    assert!(registry.find_servers_on_network(0, 0, &[]).is_empty());
}

#[test]
fn a_host_that_refuses_the_connection_tells_at_once() {
    let (mut registry, now) = start();
    register(&mut registry, &gripper(), now).unwrap();
    registry.announced(robot(), now);
    events(&mut registry);
    registry.probed("opc.tcp://127.0.0.1:4841", ProbeOutcome::Refused, now);
    let happened = events(&mut registry);
    assert!(
        happened.contains(&RegistryEvent::Gone {
            server_uri: "urn:cell:gripper".to_owned(),
            loss: ServerLoss::Unreachable
        }),
        "{happened:?}"
    );
    assert_eq!(
        registry.find_servers_on_network(0, 0, &[]).len(),
        1,
        "the robot is still there"
    );
    assert_eq!(
        register(&mut registry, &gripper(), now),
        Ok(Registered::New),
        "it came back"
    );
}

#[test]
fn a_server_with_two_endpoints_is_there_while_one_answers() {
    let (mut registry, now) = start();
    let urls = ["opc.tcp://10.0.0.1:4841", "opc.tcp://10.1.0.1:4841"];
    let asked = RegistrationRequest {
        discovery_urls: urls.map(str::to_owned).to_vec(),
        ..gripper()
    };
    register(&mut registry, &asked, now).unwrap();
    registry.probed(urls[0], ProbeOutcome::Refused, now);
    assert_eq!(registry.find_servers(&[]).count(), 1);
    registry.probed(urls[1], ProbeOutcome::Refused, now);
    assert_eq!(registry.find_servers(&[]).count(), 0);
}

#[test]
fn another_start_time_is_a_restart() {
    let (mut registry, now) = start();
    registry.announced(robot(), now);
    events(&mut registry);
    let url = robot().url;
    let alive = |start_time| ProbeOutcome::Alive { start_time };
    registry.probed(&url, alive(Some(5)), now);
    registry.probed(&url, alive(None), now);
    registry.probed(&url, alive(Some(5)), now);
    assert_eq!(registry.poll_event(), None);
    registry.probed(&url, alive(Some(6)), now);
    assert_eq!(
        registry.poll_event(),
        Some(RegistryEvent::Restarted { url: url.clone() })
    );
    registry.started(&url, 4);
    registry.probed(&url, alive(Some(4)), now);
    assert_eq!(
        registry.poll_event(),
        None,
        "the same run, told another way"
    );
    registry.probed(&url, alive(Some(7)), now);
    assert_eq!(
        registry.poll_event(),
        Some(RegistryEvent::Restarted { url })
    );
}

#[test]
fn goodbye_takes_a_record_away_and_ids_are_never_given_twice() {
    let (mut registry, now) = start();
    registry.announced(robot(), now);
    registry.announced(robot(), now);
    let first = registry.find_servers_on_network(0, 0, &[])[0].record_id;
    registry.withdrawn(&robot().instance);
    let happened = events(&mut registry);
    assert!(
        matches!(
            &*happened,
            [
                RegistryEvent::Seen(_),
                RegistryEvent::Vanished {
                    loss: ServerLoss::Goodbye,
                    ..
                }
            ]
        ),
        "{happened:?}"
    );
    registry.announced(robot(), now);
    let second = registry.find_servers_on_network(0, 0, &[])[0].record_id;
    assert!(second > first);
    assert!(
        registry
            .find_servers_on_network(second + 1, 0, &[])
            .is_empty()
    );
    assert_eq!(
        registry
            .find_servers_on_network(0, 0, &["na", "SKILLS"])
            .len(),
        1
    );
    assert!(
        registry
            .find_servers_on_network(0, 0, &["na", "HD"])
            .is_empty()
    );
}

#[test]
fn nobody_takes_back_on_the_network_what_a_registered_server_has_us_announce() {
    let (mut registry, now) = start();
    register(&mut registry, &gripper(), now).unwrap();
    events(&mut registry);
    let forged = AnnouncedServer {
        instance: "gripper-pc-4841".to_owned(),
        url: "opc.tcp://10.9.9.9:1".to_owned(),
        capabilities: Vec::new(),
    };
    registry.announced(forged, now);
    registry.withdrawn("gripper-pc-4841");
    assert_eq!(registry.poll_event(), None);
    let records = registry.find_servers_on_network(0, 0, &[]);
    assert_eq!(records[0].announcement.url, "opc.tcp://127.0.0.1:4841");
}

#[test]
fn nobody_takes_the_record_of_another_by_registering_under_its_name() {
    let (mut registry, now) = start();
    registry.announced(robot(), now);
    register(&mut registry, &gripper(), now).unwrap();
    events(&mut registry);
    let named = |uri: &str, name: &str, url: &str| {
        let mut asked = gripper();
        asked.server_uri = uri.to_owned();
        asked.discovery_urls = vec![url.to_owned()];
        asked.mdns.as_mut().unwrap().name = name.to_owned();
        asked
    };
    let urls = |registry: &ServerRegistry| -> Vec<(String, String)> {
        let found = registry.find_servers_on_network(0, 0, &[]).into_iter();
        found
            .map(|record| {
                let AnnouncedServer { instance, url, .. } = record.announcement.clone();
                (instance, url)
            })
            .collect()
    };
    let before = urls(&registry);
    // The name of an announced server, and the name of a registered server; the case of names does
    // not matter.
    for (uri, name, counted) in [
        ("urn:a", "ROBOT-pc-4842", "ROBOT-pc-4842 (2)"),
        ("urn:b", "gripper-PC-4841", "gripper-PC-4841 (2)"),
        ("urn:c", "gripper-pc-4841", "gripper-pc-4841 (3)"),
    ] {
        let asked = named(uri, name, "opc.tcp://10.9.9.9:1");
        registry.register(asked, &secured(uri), None, now).unwrap();
        let happened = events(&mut registry);
        assert!(
            matches!(&*happened, [RegistryEvent::Registered { .. }, RegistryEvent::Announce(wish)] if wish.instance == counted),
            "{happened:?}"
        );
        let offline = RegistrationRequest {
            is_online: false,
            ..named(uri, name, "opc.tcp://10.9.9.9:1")
        };
        if uri != "urn:b" {
            registry
                .register(offline, &secured(uri), None, now)
                .unwrap();
            assert!(events(&mut registry).contains(&RegistryEvent::Withdraw {
                instance: counted.to_owned()
            }));
        }
    }
    let after = urls(&registry);
    assert!(
        before.iter().all(|record| after.contains(record)),
        "{after:?}"
    );
    // A server that announces itself is not announced a second time, and leaves by its own goodbye.
    let itself = named("urn:robot", &robot().instance, &robot().url);
    registry
        .register(itself, &secured("urn:robot"), None, now)
        .unwrap();
    assert!(matches!(
        &*events(&mut registry),
        [RegistryEvent::Registered { .. }]
    ));
    registry.withdrawn(&robot().instance);
    assert!(matches!(
        &*events(&mut registry),
        [RegistryEvent::Vanished { .. }]
    ));
}

#[test]
fn what_cannot_be_tried_is_not_lost_for_it() {
    let (mut registry, now) = start();
    registry.announced(robot(), now);
    for second in 1..10_u32 {
        registry.probed(&robot().url, ProbeOutcome::Untried, now + SECOND * second);
    }
    assert!(matches!(&*events(&mut registry), [RegistryEvent::Seen(_)]));
}

#[test]
fn made_up_servers_take_no_more_room_than_there_is() {
    let settings = RegistrySettings {
        most: 3,
        ..RegistrySettings::default()
    };
    let (mut registry, now) = (ServerRegistry::new(settings), Instant::now());
    register(&mut registry, &gripper(), now).unwrap();
    for number in 0..10 {
        let announcement = AnnouncedServer {
            instance: format!("made-up-{number}"),
            ..robot()
        };
        registry.announced(announcement, now);
    }
    assert_eq!(registry.find_servers_on_network(0, 0, &[]).len(), 3);
    assert_eq!((registry.refused(), registry.displaced()), (0, 8));
    assert_eq!(
        register(&mut registry, &gripper(), now),
        Ok(Registered::Again),
        "present servers stay"
    );
}

#[test]
fn who_was_behind_a_cut_cable_is_listed_again_and_who_ended_is_not() {
    let url = &gripper().discovery_urls[0];
    let alive = ProbeOutcome::Alive { start_time: None };
    for (what, then, back) in [
        ("it answers again", alive, 1),
        ("its program has ended by then", ProbeOutcome::Refused, 0),
    ] {
        let (mut registry, now) = start();
        register(&mut registry, &gripper(), now).unwrap();
        registry.probed(url, ProbeOutcome::Silent, now + SECOND * 3);
        assert_eq!(registry.find_servers(&[]).count(), 0, "{what}");
        events(&mut registry);
        let again = registry
            .poll_probe(now + SECOND * 4)
            .expect("it is tried on");
        registry.probed(&again.url, then, now + SECOND * 4);
        // A program at the port of an ended server is not the same server.
        registry.probed(&again.url, alive, now + SECOND * 5);
        assert_eq!(registry.find_servers(&[]).count(), back, "{what}");
        let announced = |event: &RegistryEvent| matches!(event, RegistryEvent::Announce(_));
        let happened = events(&mut registry);
        assert_eq!(happened.iter().filter(|one| announced(one)).count(), back);
        registry.handle_timeout(now + RegistrySettings::default().forget_after);
        assert_eq!(
            registry.find_servers(&[]).count(),
            0,
            "as long as it counts"
        );
    }
}

#[test]
fn who_is_away_for_longer_than_the_registration_counts_is_forgotten() {
    let (mut registry, now) = start();
    register(&mut registry, &gripper(), now).unwrap();
    let url = &gripper().discovery_urls[0];
    registry.probed(url, ProbeOutcome::Silent, now + SECOND * 3);
    let later = now + RegistrySettings::default().forget_after;
    registry.handle_timeout(later);
    assert_eq!(registry.poll_probe(later), None);
    registry.probed(url, ProbeOutcome::Alive { start_time: None }, later);
    assert_eq!(registry.find_servers(&[]).count(), 0);
}

#[test]
fn what_a_certificate_registered_nobody_changes_without_one() {
    let (mut registry, now) = start();
    register(&mut registry, &gripper(), now).unwrap();
    let on_this_host = Channel {
        is_secured: true,
        certificate_uri: None,
        peer: None,
    };
    let offline = RegistrationRequest {
        is_online: false,
        ..gripper()
    };
    for asked in [gripper(), offline.clone()] {
        let fault = registry.register(asked, &on_this_host, None, now);
        let fault = fault.unwrap_err();
        assert_eq!(fault.status(), 0x80E6_0000, "{fault}");
    }
    assert_eq!(registry.find_servers(&[]).count(), 1);
    // A withdrawal contains the URI, and some servers send nothing else.
    let bare = RegistrationRequest {
        names: Vec::new(),
        discovery_urls: Vec::new(),
        ..offline
    };
    assert_eq!(
        register(&mut registry, &bare, now),
        Ok(Registered::Withdrawn)
    );
    assert_eq!(
        registry.register(gripper(), &on_this_host, None, now),
        Ok(Registered::New)
    );
}
