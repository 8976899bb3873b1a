use super::*;

#[tokio::test]
async fn of_two_servers_with_one_name_one_is_called_otherwise() {
    // On a port of its own, so that no other program on this host takes part.
    // The tests of announcers use higher ports.
    let port = 10_000 + u16::try_from(std::process::id() % 10_000).unwrap();
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
    assert!(!first, "the server with the later URL gives way");
}
