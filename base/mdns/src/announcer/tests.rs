use registry::AnnouncedServer;
use tokio::time::timeout;

use super::*;
use crate::announcement::{Aside, SERVICE};
use crate::packet::DnsPacket;
use crate::servers::Mdns;

const LIMIT: Duration = Duration::from_secs(20);

/// Returns a port for a test, so that no other program of this host takes part.
fn port(test: u16) -> u16 {
    20_000 + u16::try_from(std::process::id() % 10_000).unwrap() + test * 10_000
}

fn own(instance: &str, url: &str) -> OwnAnnouncement {
    OwnAnnouncement {
        announcement: AnnouncedServer {
            instance: instance.to_owned(),
            url: url.to_owned(),
            capabilities: Vec::new(),
        },
        aside: Aside::default(),
    }
}

/// Returns the names in queries on the network until there were `wanted` responses.
async fn asked(mut group: GroupSocket, wanted: usize) -> Vec<String> {
    let (mut asked, mut responses) = (Vec::new(), 0);
    let counting = async {
        while responses < wanted {
            let (packet, _) = group.recv().await;
            let packet = DnsPacket::new(packet).unwrap();
            if packet.is_response() {
                responses += 1;
            } else {
                asked.extend(packet.questions().map(|name| name.text().unwrap()));
            }
        }
    };
    timeout(LIMIT, counting).await.unwrap();
    asked
}

#[tokio::test]
async fn a_program_that_only_announces_asks_for_its_own_name_and_for_no_others() {
    let interface = MdnsInterface::LOOPBACK;
    let port = port(0);
    let group = GroupSocket::open(&interface, port);
    let mut announcer = MdnsAnnouncer::open_at(&interface, port).unwrap();
    announcer.put(own("arm", "opc.tcp://127.0.0.1:1001/"));
    // Two announcements at the start, and their repetition.
    let seen = tokio::select! {
        seen = asked(group, 3) => seen,
        event = announcer.next() => panic!("{event:?}"),
    };
    assert_eq!(seen, ["arm._opcua-tcp._tcp.local."; 2]);
    let group = GroupSocket::open(&interface, port);
    let _browser = Mdns::open_at(&interface, port).unwrap();
    let seen = asked(group, 1).await;
    assert!(seen.contains(&SERVICE.to_owned()), "{seen:?}");
    drop(announcer);
}

/// Returns the event of a program at port 1002 whose name was announced before with this URL, by a
/// responder that repeats and changes nothing.
async fn announced_before(url: &str, port: u16) -> MdnsEvent {
    let interface = MdnsInterface::LOOPBACK;
    let group = GroupSocket::open(&interface, port);
    let mut before = OwnServers::open(&interface, port).unwrap();
    before.put(own("arm", url), &interface.subnets());
    assert!(asked(group, 2).await.is_empty());
    let mut announcer = MdnsAnnouncer::open_at(&interface, port).unwrap();
    announcer.put(own("arm", "opc.tcp://127.0.0.1:1002/"));
    timeout(LIMIT, announcer.next()).await.unwrap()
}

#[tokio::test]
async fn a_server_that_announced_its_name_before_and_does_not_give_way_keeps_it() {
    let renamed = MdnsEvent::Renamed {
        from: "arm".to_owned(),
        to: "arm (2)".to_owned(),
    };
    let (first, later) = tokio::join!(
        announced_before("opc.tcp://127.0.0.1:1001/", port(2)),
        announced_before("opc.tcp://127.0.0.1:1003/", port(3)),
    );
    assert_eq!([first, later], [renamed.clone(), renamed]);
}

#[tokio::test]
async fn of_two_programs_with_one_name_the_later_url_is_announced_otherwise() {
    let interface = MdnsInterface::LOOPBACK;
    let port = port(1);
    let open = |url: &str| {
        let mut announcer = MdnsAnnouncer::open_at(&interface, port).unwrap();
        announcer.put(own("arm", url));
        announcer
    };
    let mut one = open("opc.tcp://127.0.0.1:1001/");
    let mut other = open("opc.tcp://127.0.0.1:1002/");
    let renamed = async {
        tokio::select! {
            event = one.next() => panic!("the first URL keeps the name: {event:?}"),
            event = other.next() => event,
        }
    };
    let event = timeout(LIMIT, renamed).await.unwrap();
    let (from, to) = ("arm".to_owned(), "arm (2)".to_owned());
    assert_eq!(event, MdnsEvent::Renamed { from, to });
}
