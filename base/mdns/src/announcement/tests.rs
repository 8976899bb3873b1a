use mdns_sd::ServiceInfo;

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
