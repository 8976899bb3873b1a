use registry::AnnouncedServer;
use tokio::time::timeout;

use super::*;
use crate::announcement::Aside;
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

/// Returns the number of queries on the network until there were `wanted` responses.
async fn queries(mut group: GroupSocket, wanted: usize) -> usize {
    let (mut queries, mut responses) = (0, 0);
    let counting = async {
        while responses < wanted {
            let (packet, _) = group.recv().await;
            if DnsPacket::new(packet).unwrap().is_response() {
                responses += 1;
            } else {
                queries += 1;
            }
        }
    };
    timeout(LIMIT, counting).await.unwrap();
    queries
}

#[tokio::test]
async fn a_program_that_only_announces_sends_no_query() {
    let interface = MdnsInterface::LOOPBACK;
    let port = port(0);
    let group = GroupSocket::open(&interface, port);
    let mut announcer = MdnsAnnouncer::open_at(&interface, port).unwrap();
    announcer.put(own("arm", "opc.tcp://127.0.0.1:1001/"));
    // The second announcement follows after a second.
    assert_eq!(queries(group, 2).await, 0);
    let group = GroupSocket::open(&interface, port);
    let _browser = Mdns::open_at(&interface, port).unwrap();
    assert!(queries(group, 1).await > 0, "a browser does");
    drop(announcer);
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
