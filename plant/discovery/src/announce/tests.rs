use plant_opcua::supervision::Registrar;

use super::*;

#[test]
fn a_discovery_server_is_embedded_where_the_option_says_so() {
    let written = |text: &str| {
        let settings = AnnounceSettings::registering(Some(text));
        (settings.lds.unwrap_or_default(), settings.embed)
    };
    let elsewhere = "opc.tcp://10.0.0.2:4841";
    assert_eq!(written("embed"), (crate::DEFAULT_LDS.to_owned(), true));
    assert_eq!(
        written(&format!("embed={elsewhere}")),
        (elsewhere.to_owned(), true)
    );
    for text in [elsewhere, "any", "name=embed", "embedded"] {
        assert_eq!(written(text), (text.to_owned(), false));
    }
    assert_eq!(AnnounceSettings::registering(None).lds, None);
    assert!(same_port(elsewhere, "opc.tcp://10.0.0.2:4841/server"));
    assert!(!same_port(elsewhere, "opc.tcp://10.0.0.2:4840/server"));
}

/// Returns the announcement of a server that is registered with a discovery server.
fn registered(lds: &str) -> Telling {
    let server = ServerDescription {
        application_uri: "urn:arm".to_owned(),
        product_uri: String::new(),
        name: "arm".to_owned(),
        url: "opc.tcp://127.0.0.1:43121/".to_owned(),
        capabilities: Vec::new(),
        number: None,
    };
    let state = AnnounceState {
        registered: Some(clock::wall()),
        ..AnnounceState::default()
    };
    Telling {
        settings: AnnounceSettings::registering(Some(lds)),
        mdns: None,
        found: None,
        server: watch::channel(server).1,
        state: watch::channel(state).0,
        start_time: 0,
        instance: None,
        lds_run: None,
        register_at: Instant::now() + MOST_WAIT,
        wait: FIRST_WAIT,
        here: None,
        there: None,
        look_from: Instant::now(),
        look_wait: FIRST_WAIT,
    }
}

#[test]
fn a_server_registers_again_when_its_discovery_server_starts_again() {
    let lds = "opc.tcp://127.0.0.1:4840/";
    let instance = || "lds".to_owned();
    let started = |start_time| MdnsEvent::Announced {
        announcement: AnnouncedServer {
            instance: instance(),
            url: lds.to_owned(),
            capabilities: Vec::new(),
        },
        aside: Aside {
            start_time,
            number: None,
        },
    };
    let mut telling = registered(lds);
    let mut registers = |event| {
        telling.register_at = Instant::now() + MOST_WAIT;
        telling.hear(event);
        telling.register_at <= Instant::now()
    };
    assert!(!registers(started(None)));
    assert!(!registers(started(None)), "with other capabilities");
    let left = MdnsEvent::Withdrawn {
        instance: instance(),
    };
    assert!(!registers(left));
    assert!(registers(started(None)), "another run without a start time");
    assert!(registers(started(Some(1))));
    assert!(!registers(started(Some(1))));
    assert!(registers(started(Some(2))));
    // Without mDNS packets, the server does not wait for such an announcement.
    assert_eq!(telling.register_every(), MOST_UNHEARD);
}

#[test]
fn a_server_registers_again_soon_with_a_discovery_server_that_did_not_describe_itself() {
    let mut telling = registered("opc.tcp://127.0.0.1:4840/");
    let mut wait = |registrar| {
        telling.registered(Ok(Done::Registered(registrar)));
        (telling.register_at - Instant::now()).as_secs()
    };
    // Each wait is extended by up to its own length. The last wait is that of a described server.
    let waits: Vec<u64> = (0..4).map(|_| wait(None)).collect();
    let every = MOST_UNHEARD.as_secs() - 1;
    assert!(waits[0] < 2 && waits[1] < 4 && waits[2] < 8, "{waits:?}");
    assert!(waits.is_sorted() && waits[3] == every, "{waits:?}");
    let known = Registrar {
        application_uri: "urn:lds".to_owned(),
        proven: false,
    };
    assert_eq!(wait(Some(known)), every);
}

#[test]
fn five_hundred_servers_that_failed_at_once_come_again_one_after_the_other_and_nobody_too_soon() {
    let urls = (0..500).map(|number| format!("opc.tcp://127.0.0.1:{}/", 40_000 + number));
    let waits: Vec<Duration> = urls.map(|url| spread(FIRST_WAIT, &url)).collect();
    let too_soon = waits.iter().filter(|wait| **wait < FIRST_WAIT);
    assert_eq!(too_soon.count(), 0, "{waits:?}");
    let too_late = waits.iter().filter(|wait| **wait > FIRST_WAIT * 2);
    assert_eq!(too_late.count(), 0, "{waits:?}");
    for tenth in 1..10 {
        let from = FIRST_WAIT + FIRST_WAIT / 10 * tenth;
        let within = from..from + FIRST_WAIT / 10;
        let at_once = waits.iter().filter(|wait| within.contains(wait)).count();
        assert!(at_once < 150, "{at_once} in {within:?}");
    }
}
