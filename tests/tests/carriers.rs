//! The carriers: each passes the same tests, UDP multicast, Ethernet, an MQTT broker, and UDP and
//! MQTT together.

mod ethernet;
#[cfg(feature = "shm")]
mod shared_memory;

use std::process::Command;
use std::sync::Arc;
use std::time::{Duration, Instant};

use bridge_node::carrier_rules;
use broker::{BrokerIdentity, Mqtt};
use mappings::{Broker, BrokerAddress, Mapping, MqttVersion, PubSub};
use system_tests::{
    BROKER, Bridged, Cell, Child, GROUP, HERE, NatsCluster, Peer, UadpSocket, WIRE,
};
use tokio::time::timeout;
use transport::{BUFFER, Carrier, Carriers, OutgoingMessage, SendError, Udp, UdpOptions};
use uadp::{
    DataSetHeader, GroupHeader, NetworkHeader, NetworkMessage, NetworkMessageEncoder, PublisherId,
    Scalar, Variant,
};

const SOON: Duration = Duration::from_secs(30);

/// A network to test.
trait Network {
    /// Joins the network as a program of the space.
    fn join(&self, publisher: u16) -> Box<dyn Carrier>;
    /// Takes the network away.
    fn cut(&mut self);
    /// Returns the network.
    fn mend(&mut self);
}

struct Multicast;

impl Network for Multicast {
    fn join(&self, _publisher: u16) -> Box<dyn Carrier> {
        let options = UdpOptions {
            interface: Some("lo".to_owned()),
            ..UdpOptions::new(PubSub::ADDRESS)
        };
        Box::new(Udp::open(&options).unwrap())
    }

    fn cut(&mut self) {
        link("down");
    }

    fn mend(&mut self) {
        link("up");
        let route = ["route", "add", "224.0.0.0/4", "dev", "lo"];
        assert!(Command::new("ip").args(route).status().unwrap().success());
    }
}

fn link(state: &str) {
    let set = ["link", "set", "lo", state];
    assert!(Command::new("ip").args(set).status().unwrap().success());
}

struct Mosquitto<'c> {
    cell: &'c Cell,
    version: MqttVersion,
    broker: Option<Child>,
}

impl Network for Mosquitto<'_> {
    fn join(&self, publisher: u16) -> Box<dyn Carrier> {
        mqtt(BROKER, self.version, publisher)
    }

    fn cut(&mut self) {
        self.broker = None;
    }

    fn mend(&mut self) {
        self.broker = Some(self.cell.mosquitto());
    }
}

/// Joins a space at a broker.
fn mqtt(address: &str, version: MqttVersion, publisher: u16) -> Box<dyn Carrier> {
    let mut broker = Broker::new(BrokerAddress::parse(address).unwrap());
    broker.version = Some(version);
    let identity = BrokerIdentity {
        program: "test".to_owned(),
        publisher: Some(publisher),
    };
    Box::new(Mqtt::open(&broker, &identity).unwrap())
}

/// Programs at different nodes of a cluster.
impl Network for NatsCluster<'_> {
    fn join(&self, publisher: u16) -> Box<dyn Carrier> {
        let address = Self::address(publisher);
        mqtt(&address, MqttVersion::V3_1_1, publisher)
    }

    fn cut(&mut self) {
        self.kill_all();
    }

    fn mend(&mut self) {
        self.start(&[]);
    }
}

/// Programs at different brokers of a bridge.
impl Network for Bridged<'_> {
    fn join(&self, publisher: u16) -> Box<dyn Carrier> {
        let address = if publisher.is_multiple_of(2) {
            Self::FAR
        } else {
            BROKER
        };
        mqtt(address, MqttVersion::V5, publisher)
    }

    fn cut(&mut self) {
        self.kill();
    }

    fn mend(&mut self) {
        self.start();
    }
}

/// Programs with both carriers.
struct Both<'c> {
    udp: Multicast,
    mqtt: Mosquitto<'c>,
}

impl Network for Both<'_> {
    fn join(&self, publisher: u16) -> Box<dyn Carrier> {
        let text = format!("pubsub: [{{udp: {{}}}}, {{mqtt: {{address: \"{BROKER}\"}}}}]");
        let mapping = Mapping::from_yaml(&text, "cell.yaml").mapping.unwrap();
        let members = vec![self.udp.join(publisher), self.mqtt.join(publisher)];
        Box::new(Carriers::new(members, carrier_rules(&Arc::new(mapping))))
    }

    fn cut(&mut self) {
        self.udp.cut();
        self.mqtt.cut();
    }

    fn mend(&mut self) {
        self.udp.mend();
        self.mqtt.mend();
    }
}

/// Returns a value of `ua_<publisher>_2_10`, with padding.
fn value(publisher: u16, number: u32, padding: usize) -> Vec<u8> {
    let network = NetworkHeader {
        publisher_id: Some(PublisherId::UInt16(publisher)),
        group: Some(GroupHeader {
            writer_group_id: Some(2),
            ..GroupHeader::default()
        }),
        ..NetworkHeader::default()
    };
    let mut bytes = Vec::new();
    let mut message = NetworkMessageEncoder::new(&mut bytes, &network, Some(&[10])).unwrap();
    let mut frame = message.key_frame(&DataSetHeader::default()).unwrap();
    frame.scalar(Scalar::UInt32(number)).unwrap();
    frame
        .scalar(Scalar::ByteString(Some(&vec![7; padding])))
        .unwrap();
    frame.finish().unwrap();
    message.finish().unwrap();
    bytes
}

/// Returns the sender and number of a value.
fn read(bytes: &[u8]) -> (PublisherId<'_>, u32) {
    let message = NetworkMessage::decode(bytes).unwrap();
    let data = message.messages().next().unwrap().unwrap();
    let field = data.fields().unwrap().next().unwrap().unwrap();
    match field {
        Variant::Scalar(Scalar::UInt32(number)) => (message.publisher_id().unwrap(), number),
        other => panic!("{other:?}"),
    }
}

/// Returns the numbers that `from` sends until `last` arrives. Own messages are left out.
async fn numbers(carrier: &mut dyn Carrier, from: u16, last: u32) -> Vec<u32> {
    let mut buffer = vec![0; BUFFER];
    let mut numbers = Vec::new();
    let all = async {
        loop {
            let received = carrier.recv(&mut buffer).await.unwrap();
            if Some(received.from) == carrier.source() {
                continue;
            }
            let (publisher, number) = read(&buffer[..received.length]);
            if publisher == PublisherId::UInt16(from) {
                numbers.push(number);
                if number == last {
                    return;
                }
            }
        }
    };
    timeout(SOON, all).await.expect("the last number arrives");
    numbers
}

/// Sends numbers of a warm-up until each receiver has one: then all have joined.
async fn meet(sender: &mut dyn Carrier, publisher: u16, receivers: &mut [&mut Box<dyn Carrier>]) {
    let mut buffer = vec![0; BUFFER];
    for receiver in receivers {
        let start = Instant::now();
        loop {
            assert!(
                start.elapsed() < SOON,
                "the receiver joins: {:?}",
                receiver.lost()
            );
            let _not_yet = sender.try_send(&OutgoingMessage::new(&value(publisher, WARM_UP, 0)));
            let _change = (sender.follow(), receiver.follow());
            let wait = timeout(Duration::from_millis(50), receiver.recv(&mut buffer));
            if let Ok(Ok(received)) = wait.await {
                let (from, _) = read(&buffer[..received.length]);
                if from == PublisherId::UInt16(publisher)
                    && Some(received.from) != receiver.source()
                {
                    break;
                }
            }
        }
    }
}

const WARM_UP: u32 = u32::MAX;

fn send(
    carrier: &mut dyn Carrier,
    publisher: u16,
    number: u32,
    padding: usize,
) -> Result<(), SendError> {
    carrier.try_send(&OutgoingMessage::new(&value(publisher, number, padding)))
}

/// The faults of a network that the suite allows.
#[derive(Clone, Copy)]
struct Faults {
    /// Messages of a burst may be lost.
    loses: bool,
    /// Messages of a burst may arrive in another order.
    reorders: bool,
}

/// Runs the suite.
async fn conforms(network: &mut dyn Network, faults: Faults) {
    let (a, b) = delivers(network, faults).await;
    heals(network, a, b).await;
}

/// Runs the part of the suite in which the network is there. Returns two of its programs.
async fn delivers(
    network: &dyn Network,
    Faults { loses, reorders }: Faults,
) -> (Box<dyn Carrier>, Box<dyn Carrier>) {
    let (mut a, mut b, mut c) = (network.join(1), network.join(2), network.join(3));
    meet(a.as_mut(), 1, &mut [&mut b, &mut c]).await;

    // Several programs receive each message, in the order of sending, and own messages are either
    // not returned or have the own source.
    for number in 0..100 {
        send(a.as_mut(), 1, number, 0).unwrap();
    }
    for receiver in [&mut b, &mut c] {
        let got = numbers(receiver.as_mut(), 1, 99).await;
        let got: Vec<u32> = got
            .into_iter()
            .filter(|number| *number != WARM_UP)
            .collect();
        assert_eq!(got, (0..100).collect::<Vec<_>>());
    }
    meet(b.as_mut(), 2, &mut [&mut a]).await;

    // A large message arrives whole, and one that is too large is refused.
    let overhead = value(1, 100, 0).len();
    let limit = a.limit().filter(|limit| *limit < 60_000);
    let largest = limit.unwrap_or(60_000) - overhead;
    if limit.is_some() {
        let too_large = send(a.as_mut(), 1, 100, largest + 1);
        assert_eq!(too_large, Err(SendError::TooBig));
    }
    send(a.as_mut(), 1, 100, largest).unwrap();
    numbers(b.as_mut(), 1, 100).await;

    // A program that joins late gets nothing that was sent before.
    let mut late = network.join(4);
    meet(a.as_mut(), 1, &mut [&mut late]).await;
    send(a.as_mut(), 1, 101, 0).unwrap();
    let got = numbers(late.as_mut(), 1, 101).await;
    assert!(
        got.iter().all(|number| [WARM_UP, 101].contains(number)),
        "{got:?}"
    );

    // A flood does not block the sender: messages are refused at most. Afterwards all goes on.
    for number in 1000..21_000 {
        match send(a.as_mut(), 1, number, 1000) {
            Ok(()) | Err(SendError::Busy) => {}
            Err(other) => panic!("{other}"),
        }
    }
    let mut number = 30_000;
    let start = Instant::now();
    loop {
        assert!(start.elapsed() < SOON, "messages arrive after the flood");
        number += 1;
        let _may_be_busy = send(a.as_mut(), 1, number, 0);
        let next = timeout(Duration::from_millis(100), numbers(b.as_mut(), 1, number)).await;
        if let Ok(got) = next {
            let of_flood = got.iter().filter(|number| (1000..21_000).contains(*number));
            let is_kept = reorders || of_flood.clone().is_sorted();
            assert!(is_kept, "the order is kept");
            assert!(loses || of_flood.count() > 0, "the flood arrives in part");
            break;
        }
    }
    (a, b)
}

/// The network is lost and comes back: nothing that was sent meanwhile arrives.
async fn heals(network: &mut dyn Network, mut a: Box<dyn Carrier>, mut b: Box<dyn Carrier>) {
    network.cut();
    until(SOON, || {
        let _change = (a.follow(), b.follow());
        a.lost().is_some() && b.lost().is_some()
    })
    .await;
    for number in 40_000..40_010 {
        let _refused = send(a.as_mut(), 1, number, 0);
    }
    network.mend();
    until(SOON, || {
        let _change = (a.follow(), b.follow());
        a.lost().is_none() && b.lost().is_none()
    })
    .await;
    meet(a.as_mut(), 1, &mut [&mut b]).await;
    send(a.as_mut(), 1, 50_000, 0).unwrap();
    let got = numbers(b.as_mut(), 1, 50_000).await;
    assert!(
        !got.iter().any(|number| (40_000..40_010).contains(number)),
        "{got:?}"
    );
}

/// Polls a condition without blocking the runtime.
async fn until(deadline: Duration, mut condition: impl FnMut() -> bool) {
    let start = Instant::now();
    while !condition() {
        assert!(start.elapsed() < deadline, "the network changes");
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
}

fn run(test: impl Future<Output = ()>) {
    let runtime = tokio::runtime::Builder::new_current_thread();
    let runtime = { runtime }.enable_all().build().unwrap();
    runtime.block_on(test);
}

#[test]
fn udp_multicast_conforms() {
    let Some(_cell) = Cell::with(&[]) else {
        return;
    };
    let faults = Faults {
        loses: true,
        reorders: false,
    };
    run(conforms(&mut Multicast, faults));
}

fn mosquitto_conforms(version: MqttVersion) {
    let Some(cell) = Cell::with(&[Peer::Mosquitto]) else {
        return;
    };
    let broker = Some(cell.mosquitto());
    let mut network = Mosquitto {
        cell: &cell,
        version,
        broker,
    };
    let faults = Faults {
        loses: false,
        reorders: false,
    };
    run(conforms(&mut network, faults));
}

/// amqtt, a broker of another maker.
struct Amqtt<'c> {
    cell: &'c Cell,
    broker: Option<Child>,
}

impl Network for Amqtt<'_> {
    fn join(&self, publisher: u16) -> Box<dyn Carrier> {
        mqtt(BROKER, MqttVersion::V3_1_1, publisher)
    }

    fn cut(&mut self) {
        self.broker = None;
    }

    fn mend(&mut self) {
        let started = self.cell.mqtt_python_started("mqtt_broker.py", &[]);
        self.broker = Some(started.start().ready(SOON));
    }
}

/// Returns a network with both carriers.
fn both(cell: &Cell) -> Both<'_> {
    Both {
        udp: Multicast,
        mqtt: Mosquitto {
            cell,
            version: MqttVersion::V5,
            broker: Some(cell.mosquitto()),
        },
    }
}

#[test]
fn udp_and_mqtt_together_conform_and_deliver_each_message_once() {
    let Some(cell) = Cell::with(&[Peer::Mosquitto]) else {
        return;
    };
    // The broker delivers messages of a burst that UDP has lost, later than the next messages.
    let faults = Faults {
        loses: true,
        reorders: true,
    };
    run(conforms(&mut both(&cell), faults));
}

#[test]
fn a_dead_broker_does_not_stop_udp_beside_it() {
    let Some(cell) = Cell::with(&[Peer::Mosquitto]) else {
        return;
    };
    let mut network = both(&cell);
    run(async {
        let (mut a, mut b) = (network.join(1), network.join(2));
        meet(a.as_mut(), 1, &mut [&mut b]).await;
        network.mqtt.cut();
        for number in 0..200 {
            send(a.as_mut(), 1, number, 0).unwrap();
            if number % 50 == 49 {
                let got = numbers(b.as_mut(), 1, number).await;
                let got: Vec<u32> = got.into_iter().filter(|of| *of != WARM_UP).collect();
                assert_eq!(got, (number - 49..=number).collect::<Vec<_>>());
            }
        }
        until(SOON, || {
            let _change = a.follow();
            a.states().iter().any(|state| state.lost.is_some())
        })
        .await;
        assert_eq!(a.lost(), None);
        let states = a.states();
        let lost: Vec<bool> = states.iter().map(|state| state.lost.is_some()).collect();
        assert_eq!(lost, [false, true]);
        send(a.as_mut(), 1, 200, 0).unwrap();
        numbers(b.as_mut(), 1, 200).await;
        let unsent = a.states()[1]
            .dropped
            .iter()
            .any(|(reason, count)| *reason == "not_sent_unreachable" && *count > 0);
        assert!(unsent, "{states:?}");
    });
}

#[test]
fn mqtt_3_1_1_conforms() {
    mosquitto_conforms(MqttVersion::V3_1_1);
}

#[test]
fn mqtt_5_conforms() {
    mosquitto_conforms(MqttVersion::V5);
}

#[test]
fn programs_at_a_broker_of_amqtt_conform() {
    let Some(cell) = Cell::with(&[Peer::MqttPython]) else {
        return;
    };
    let mut network = Amqtt {
        cell: &cell,
        broker: None,
    };
    network.mend();
    // amqtt delivers the flood for longer than the suite looks for it.
    let faults = Faults {
        loses: true,
        reorders: false,
    };
    run(conforms(&mut network, faults));
}

#[test]
fn programs_at_three_nodes_of_nats_conform() {
    let Some(cell) = Cell::with(&[Peer::Nats]) else {
        return;
    };
    // A node disconnects a client that reads too slowly, and discards the rest of the flood.
    let faults = Faults {
        loses: true,
        reorders: false,
    };
    run(conforms(&mut cell.nats("", &[]), faults));
}

#[test]
fn programs_at_two_bridged_brokers_conform() {
    let Some(cell) = Cell::with(&[Peer::Mosquitto]) else {
        return;
    };
    // The bridge has a bounded queue.
    let faults = Faults {
        loses: true,
        reorders: false,
    };
    run(conforms(&mut cell.bridged(), faults));
}

/// Returns the datagrams that a carrier receives from another host, up to `last`. Fails for an own
/// datagram.
async fn from_others(carrier: &mut Udp, last: &[u8]) -> Vec<Vec<u8>> {
    let mut buffer = vec![0; BUFFER];
    let mut datagrams = Vec::new();
    let own = carrier.source().port();
    let all = async {
        loop {
            let carrier: &mut dyn Carrier = carrier;
            let received = carrier.recv(&mut buffer).await.unwrap();
            assert_ne!(received.from.port(), own, "an own datagram");
            let datagram = buffer[..received.length].to_vec();
            let is_last = datagram == last;
            datagrams.push(datagram);
            if is_last {
                return;
            }
        }
    };
    timeout(SOON, all).await.expect("the last datagram arrives");
    datagrams
}

/// Returns datagrams of unequal sizes, the last of them small. Some of them are fragmented by a
/// network with an MTU of 1500. All of them fit the usual receive buffer of 208 KiB.
fn burst() -> Vec<Vec<u8>> {
    let sizes = (0..20).map(|number| match number % 10 {
        0 => 60_000,
        1 => 1_472,
        2 => 1_473,
        _ => 100 + number,
    });
    let datagrams = sizes.zip(0..).map(|(size, number)| vec![number; size]);
    datagrams.chain([b"last".to_vec()]).collect()
}

/// Sends a burst in both directions of a cable, and expects no own datagram.
async fn exchange(here: &mut Udp, there: &UadpSocket) {
    let burst = burst();
    let messages: Vec<OutgoingMessage<'_>> =
        burst.iter().map(|of| OutgoingMessage::new(of)).collect();
    let errors = Carrier::try_send_all(here, &messages);
    assert!(errors.is_empty(), "{errors:?}");
    for datagram in &burst {
        let received = there.receive(SOON).expect("each datagram arrives");
        assert!(received == *datagram, "{} bytes", received.len());
    }
    for datagram in &burst {
        there.send(datagram);
    }
    assert!(from_others(here, b"last").await == burst);
    // The other host is a member too.
    for datagram in &burst {
        assert!(there.receive(SOON).as_ref() == Some(datagram));
    }
}

#[test]
fn bursts_of_fragmented_datagrams_cross_a_cable_without_echo() {
    let Some(cell) = Cell::with(&[]) else {
        return;
    };
    let cable = cell.cable();
    cable.lay(HERE);
    cable.route();
    let there = cable.socket();
    run(async {
        for interface in [Some(WIRE.to_owned()), None] {
            let options = UdpOptions {
                interface,
                ..UdpOptions::new(GROUP.into())
            };
            let mut here = Udp::open(&options).unwrap();
            exchange(&mut here, &there).await;
        }
        // The address of the host changes.
        let mut here = Udp::open(&UdpOptions::new(GROUP.into())).unwrap();
        let new = format!("{NEW_ADDRESS}/24");
        let old = format!("{HERE}/24");
        for args in [
            &["address", "delete", &old, "dev", WIRE][..],
            &["address", "add", &new, "dev", WIRE],
        ] {
            assert!(Command::new("ip").args(args).status().unwrap().success());
        }
        cable.route();
        until(SOON, || {
            here.follow();
            here.interface() == WIRE && here.lost().is_none()
        })
        .await;
        exchange(&mut here, &there).await;
    });
}

/// Another address of this host on the cable.
const NEW_ADDRESS: &str = "10.77.0.9";
