use std::time::{Duration, SystemTime};

use super::*;
use crate::carrier::{BUFFER, Carrier};

fn on_loopback(address: &str) -> UdpOptions {
    UdpOptions {
        interface: Some("127.0.0.1".into()),
        ttl: 0,
        ..UdpOptions::new(address.parse().unwrap())
    }
}

fn run<T>(future: impl Future<Output = T>) -> T {
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .unwrap();
    runtime.block_on(async {
        tokio::time::timeout(Duration::from_secs(5), future)
            .await
            .expect("in time")
    })
}

/// Returns an unused port. Multicast ports are shared, so each test needs a separate group.
fn free_port() -> u16 {
    std::net::UdpSocket::bind("127.0.0.1:0")
        .unwrap()
        .local_addr()
        .unwrap()
        .port()
}

#[test]
fn every_member_of_the_group_hears_a_datagram_with_its_sender() {
    run(async {
        let options = on_loopback(&format!("239.255.40.1:{}", free_port()));
        let own = UdpOptions {
            own: true,
            ..options.clone()
        };
        let (mut a, mut b) = (Udp::open(&own).unwrap(), Udp::open(&options).unwrap());
        a.try_send(b"cover").unwrap();
        let sender = a.source();
        for member in [&mut a, &mut b] {
            let mut buffer = [0; 64];
            let (len, from) = member.recv(&mut buffer).await.unwrap();
            assert_eq!((&buffer[..len], from), (&b"cover"[..], sender));
        }
    });
}

#[test]
#[expect(clippy::disallowed_methods, reason = "the kernel stamps by this clock")]
fn the_kernel_stamps_a_datagram_at_its_arrival_and_not_when_it_is_read() {
    run(async {
        let mut listener = Udp::open(&on_loopback(&format!("127.0.0.1:{}", free_port()))).unwrap();
        let mut options = on_loopback(&format!("239.255.40.9:{}", free_port()));
        options.peers = vec![listener.receiver.local_addr().unwrap()];
        let sender = Udp::open(&options).unwrap();
        let mut buffer = vec![0; BUFFER];
        let stamped = async {
            loop {
                let before = SystemTime::now();
                sender.try_send(b"1").unwrap();
                listener.receiver.readable().await.unwrap();
                let arrived = SystemTime::now();
                // The datagram waits in the socket.
                tokio::time::sleep(Duration::from_millis(20)).await;
                let carrier: &mut dyn Carrier = &mut listener;
                let received = carrier.recv(&mut buffer).await.unwrap();
                let stamp = received.stamp.unwrap();
                assert!(before <= stamp, "{stamp:?}");
                // The kernel stamps at the arrival soon after the first socket asks for it.
                if stamp <= arrived {
                    break;
                }
            }
        };
        let in_time = tokio::time::timeout(Duration::from_secs(10), stamped).await;
        assert!(in_time.is_ok(), "datagrams are stamped when they are read");
    });
}

#[test]
fn unicast_peers_get_what_the_group_would() {
    run(async {
        let mut listener = Udp::open(&on_loopback(&format!("127.0.0.1:{}", free_port()))).unwrap();
        let mut options = on_loopback(&format!("239.255.40.2:{}", free_port()));
        options.peers = vec![listener.receiver.local_addr().unwrap()];
        Udp::open(&options).unwrap().try_send(b"1").unwrap();
        let mut buffer = [0; 8];
        assert_eq!(listener.recv(&mut buffer).await.unwrap().0, 1);
    });
}

#[test]
fn with_another_hosts_unicast_address_its_port_is_listened_at_here() {
    run(async {
        let port = free_port();
        // A documentation address, which is not assigned to any host; nothing is sent to it.
        let mut udp = Udp::open(&on_loopback(&format!("203.0.113.7:{port}"))).unwrap();
        let other = std::net::UdpSocket::bind("127.0.0.1:0").unwrap();
        other.send_to(b"cover", ("127.0.0.1", port)).unwrap();
        let mut buffer = [0; 8];
        let (len, from) = udp.recv(&mut buffer).await.unwrap();
        assert_eq!(
            (&buffer[..len], from),
            (&b"cover"[..], other.local_addr().unwrap())
        );
        assert_eq!(udp.targets, [SocketAddr::from(([203, 0, 113, 7], port))]);
    });
}

#[test]
fn a_port_that_is_not_shared_is_named() {
    run(async {
        let holder = std::net::UdpSocket::bind("127.0.0.1:0").unwrap();
        let address = holder.local_addr().unwrap();
        let error = Udp::open(&on_loopback(&address.to_string())).unwrap_err();
        assert!(
            matches!(&error, UdpOpenError::PortTaken(at) if *at == address),
            "{error}"
        );
        assert!(
            error.to_string().contains(&address.port().to_string()),
            "{error}"
        );
    });
}

#[test]
fn a_datagram_too_big_is_refused_and_the_next_one_goes() {
    run(async {
        let options = UdpOptions {
            own: true,
            ..on_loopback(&format!("239.255.40.3:{}", free_port()))
        };
        let mut udp = Udp::open(&options).unwrap();
        assert_eq!(udp.try_send(&vec![0; 70_000]), Err(SendError::TooBig));
        udp.try_send(b"small").unwrap();
        let mut buffer = [0; 16];
        assert_eq!(udp.recv(&mut buffer).await.unwrap().0, 5);
    });
}

#[test]
fn a_missing_interface_is_an_error_that_lists_the_present_ones() {
    run(async {
        let mut options = on_loopback("239.255.40.4:4840");
        options.interface = Some("nosuch0".into());
        let error = Udp::open(&options).unwrap_err().to_string();
        assert!(
            error.contains("nosuch0") && error.contains("127.0.0.1"),
            "{error}"
        );
    });
}

/// Returns the datagrams of `from` that a member receives, up to a datagram `end`.
async fn received(member: &mut Udp, from: SocketAddr) -> Vec<Vec<u8>> {
    let mut buffer = vec![0; BUFFER];
    let mut datagrams = Vec::new();
    loop {
        let carrier: &mut dyn Carrier = member;
        let received = carrier.recv(&mut buffer).await.unwrap();
        assert!(buffer.len() >= BUFFER, "{}", buffer.len());
        if &buffer[..received.length] == b"end" {
            return datagrams;
        }
        if received.from == from {
            datagrams.push(buffer[..received.length].to_vec());
        }
    }
}

#[test]
fn own_datagrams_are_dropped_by_the_kernel_and_received_on_request() {
    run(async {
        for interface in [Some("127.0.0.1".to_owned()), None] {
            // Without an interface, a unicast address of this host replaces the group, since a
            // host need not have a route for groups.
            let address = match interface {
                Some(_) => format!("239.255.40.5:{}", free_port()),
                None => format!("127.0.0.1:{}", free_port()),
            };
            for own in [false, true] {
                let options = UdpOptions {
                    own,
                    interface: interface.clone(),
                    ..on_loopback(&address)
                };
                let mut member = Udp::open(&options).unwrap();
                let source = SocketAddr::from(([127, 0, 0, 1], member.source().port()));
                member.try_send(b"1").unwrap();
                member.try_send(b"2").unwrap();
                let other = std::net::UdpSocket::bind("127.0.0.1:0").unwrap();
                let here = socket2::SockRef::from(&other);
                here.set_multicast_if_v4(&Ipv4Addr::LOCALHOST).unwrap();
                other
                    .send_to(b"end", address.parse::<SocketAddr>().unwrap())
                    .unwrap();
                let datagrams = received(&mut member, source).await;
                let expected: &[Vec<u8>] = if own {
                    &[b"1".to_vec(), b"2".to_vec()]
                } else {
                    &[]
                };
                assert_eq!(datagrams, expected, "{options:?}");
            }
        }
    });
}

#[test]
fn a_burst_is_received_in_order_and_the_datagram_behind_it_too() {
    run(async {
        let options = on_loopback(&format!("239.255.40.6:{}", free_port()));
        let (sender, mut receiver) = (Udp::open(&options).unwrap(), Udp::open(&options).unwrap());
        // Bursts that fill no batch, exactly one batch, and several batches.
        for burst in [
            1,
            batch::AT_ONCE - 1,
            2 * batch::AT_ONCE - 1,
            5 * batch::AT_ONCE,
        ] {
            // Small datagrams: all of them fit a receive buffer of the usual size.
            let datagrams = (0..burst).map(|n| vec![u8::try_from(n).unwrap(); n % 7]);
            let datagrams: Vec<Vec<u8>> = datagrams.collect();
            let mut messages: Vec<_> = datagrams
                .iter()
                .map(|of| OutgoingMessage::new(of))
                .collect();
            messages.push(OutgoingMessage::new(b"end"));
            assert_eq!(sender.try_send_all(&messages), BTreeMap::new());
            assert_eq!(received(&mut receiver, sender.source()).await, datagrams);
        }
    });
}

#[test]
fn a_message_that_cannot_be_sent_is_reported_and_the_others_go() {
    run(async {
        let options = on_loopback(&format!("239.255.40.7:{}", free_port()));
        let (sender, mut receiver) = (Udp::open(&options).unwrap(), Udp::open(&options).unwrap());
        let large = vec![0; 70_000];
        let messages = [&b"1"[..], &large, b"2", b"3", &large, b"end"];
        let messages = messages.map(OutgoingMessage::new);
        let errors = sender.try_send_all(&messages);
        let expected = [(1, SendError::TooBig), (4, SendError::TooBig)];
        assert_eq!(errors, BTreeMap::from(expected));
        let datagrams = received(&mut receiver, sender.source()).await;
        assert_eq!(datagrams, [b"1", b"2", b"3"].map(|of| of.to_vec()));
    });
}
