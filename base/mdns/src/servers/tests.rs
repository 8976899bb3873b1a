use super::*;

fn here() -> Subnets {
    Subnets::of(Ipv4Addr::LOCALHOST, Ipv4Addr::new(255, 0, 0, 0))
}

fn network() -> Subnets {
    Subnets::of(Ipv4Addr::new(10, 0, 0, 1), Ipv4Addr::new(255, 255, 255, 0))
}

fn resolved(instance: &str, address: &str, texts: &[(&str, &str)]) -> ResolvedService {
    let info = ServiceInfo::new(SERVICE, instance, "host.local.", address, 4841, texts);
    info.unwrap().as_resolved_service()
}

#[test]
fn an_announcement_is_read_as_a_url_and_capabilities() {
    let texts = [
        ("path", "/arm"),
        ("caps", "DA, HD,,AC"),
        ("start", "17"),
        ("ns", "7"),
    ];
    let (announcement, aside) = heard(&resolved("arm.left", "127.0.0.1", &texts), &here()).unwrap();
    assert_eq!(announcement.instance, "arm.left");
    assert_eq!(announcement.url, "opc.tcp://127.0.0.1:4841/arm");
    assert_eq!(announcement.capabilities, ["DA", "HD", "AC"]);
    assert_eq!(aside.start_time, Some(17));
    assert_eq!(aside.number, NonZeroU16::new(7));
}

#[test]
fn hostile_records_are_not_heard() {
    let plain = [("path", "/")];
    for (what, service, subnets) in [
        (
            "a line break in the name",
            resolved("a\nb", "127.0.0.1", &plain),
            here(),
        ),
        (
            "a line break in the path",
            resolved("a", "127.0.0.1", &[("path", "/\r\nX: y")]),
            here(),
        ),
        (
            "our own host, from the network",
            resolved("a", "127.0.0.1", &plain),
            network(),
        ),
        (
            "an address outside the subnets of the interface",
            resolved("a", "10.0.1.9", &plain),
            network(),
        ),
        (
            "no address of a host",
            resolved("a", "224.0.0.1", &plain),
            network(),
        ),
    ] {
        assert_eq!(heard(&service, &subnets), None, "{what}");
    }
    let many = vec!["X"; 200].join(",");
    let (kept, _) = heard(
        &resolved("a", "10.0.0.1", &[("caps", many.get(..250).unwrap())]),
        &network(),
    )
    .unwrap();
    assert_eq!(kept.capabilities.len(), MOST_CAPABILITIES);
    assert_eq!(instance("._opcua-tcp._tcp.local."), None);
    assert_eq!(instance("x._http._tcp.local."), None);
}

#[test]
fn of_several_addresses_that_of_the_network_is_taken() {
    let all = || ["127.0.0.1", "169.254.7.7", "10.0.0.2"].map(|ip| ip.parse().unwrap());
    assert_eq!(address(all(), &network()), Some(Ipv4Addr::new(10, 0, 0, 2)));
    assert_eq!(address(all(), &here()), Some(Ipv4Addr::LOCALHOST));
}

#[tokio::test]
async fn of_two_servers_with_one_name_one_is_called_otherwise() {
    // On a port of its own, so that no other program on this host takes part.
    let port = 20_000 + u16::try_from(std::process::id() % 20_000).unwrap();
    let open = |url: &str| {
        let mut mdns = Mdns::open_at(&MdnsInterface::LOOPBACK, port).unwrap();
        mdns.put(OwnAnnouncement {
            announcement: AnnouncedServer {
                instance: "arm".to_owned(),
                url: url.to_owned(),
                capabilities: Vec::new(),
            },
            aside: Aside::default(),
        });
        mdns
    };
    let (mut one, mut other) = (
        open("opc.tcp://127.0.0.1:1001/"),
        open("opc.tcp://127.0.0.1:1002/"),
    );
    let renamed = async {
        loop {
            let (heard, first) = tokio::select! {
                heard = one.next() => (heard, true),
                heard = other.next() => (heard, false),
            };
            if let MdnsEvent::Renamed { from, to } = heard {
                return (from, to, first);
            }
        }
    };
    let limit = Duration::from_secs(20);
    let (from, to, first) = tokio::time::timeout(limit, renamed).await.unwrap();
    assert_eq!((&*from, &*to), ("arm", "arm (2)"));
    assert!(!first, "the one whose URL comes later gives way");
}

#[test]
fn announcements_become_less_frequent_with_the_number_of_servers() {
    let ms = Duration::from_millis;
    let soon = |servers| shared(SETTLE..=SETTLE_LATE, servers);
    assert_eq!([0, 8, 100].map(soon), [ms(200), ms(200), ms(2_500)]);
    // Invented servers do not silence this program.
    assert_eq!(soon(usize::MAX), SETTLE_LATE);
    let again = |servers| shared(ANNOUNCE_EVERY..=ANNOUNCE_SELDOM, servers);
    assert_eq!([1, 100].map(again), [ms(5_000), ms(60_000)]);
}
