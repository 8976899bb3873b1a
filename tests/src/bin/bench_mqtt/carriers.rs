//! Two carriers at a broker: the messages of one are sent back by the other.

use std::time::{Duration, Instant};

use broker::{BrokerIdentity, Mqtt};
use mappings::{Broker, BrokerAddress};
use tokio::runtime::Runtime;
use tokio::time::timeout;
use transport::{BUFFER, Carrier, OutgoingMessage};
use uadp::{
    DataSetHeader, GroupHeader, NetworkHeader, NetworkMessage, NetworkMessageEncoder, PublisherId,
    Scalar, Variant,
};

/// Two carriers. The second runs in a thread of its own until the program ends.
pub(crate) struct CarrierPair {
    runtime: Runtime,
    carrier: Mqtt,
    number: u32,
}

impl CarrierPair {
    /// Connects both with a broker.
    pub(crate) fn connect(broker: &str) -> Self {
        let address = broker.to_owned();
        std::thread::spawn(move || {
            let runtime = runtime();
            runtime.block_on(async { echo(&mut open(&address, ECHOES)).await });
        });
        let runtime = runtime();
        let carrier = runtime.block_on(async { open(broker, ASKS) });
        let mut carriers = Self {
            runtime,
            carrier,
            number: 0,
        };
        carriers.meet();
        carriers
    }

    /// Waits until a message comes back.
    fn meet(&mut self) {
        let start = Instant::now();
        while self.round_trip(0, Duration::from_millis(200)).is_none() {
            assert!(start.elapsed() < SOON, "the carriers meet");
        }
    }

    /// Returns the times of round trips of messages of a size in bytes.
    pub(crate) fn round_trips(&mut self, count: usize, size: usize) -> Vec<Duration> {
        let all = (0..count).map(|_| self.round_trip(size, SOON));
        all.map(|of| of.expect("each message comes back")).collect()
    }

    fn round_trip(&mut self, size: usize, limit: Duration) -> Option<Duration> {
        self.number += 1;
        let number = self.number;
        let message = value(ASKS, number, size);
        let carrier = &mut self.carrier;
        self.runtime.block_on(async {
            let _change = carrier.follow();
            let start = Instant::now();
            carrier.try_send(&OutgoingMessage::new(&message)).ok()?;
            let back = async { while next(carrier).await.0 != (ECHOES, number) {} };
            timeout(limit, back).await.ok()?;
            Some(start.elapsed())
        })
    }
}

fn runtime() -> Runtime {
    let runtime = tokio::runtime::Builder::new_current_thread();
    { runtime }.enable_all().build().unwrap()
}

/// Joins a space at a broker. Called in a runtime.
fn open(address: &str, publisher: u16) -> Mqtt {
    let broker = Broker::new(BrokerAddress::parse(address).unwrap());
    let identity = BrokerIdentity {
        program: "bench".to_owned(),
        publisher: Some(publisher),
    };
    Mqtt::open(&broker, &identity).unwrap()
}

/// Sends each message of the other carrier back.
async fn echo(carrier: &mut Mqtt) {
    loop {
        let ((publisher, number), size) = next(carrier).await;
        if publisher == ASKS {
            let _change = carrier.follow();
            let message = value(ECHOES, number, size);
            let _lost = carrier.try_send(&OutgoingMessage::new(&message));
        }
    }
}

/// Returns the sender and the number of the next message, and its size.
async fn next(carrier: &mut Mqtt) -> ((u16, u32), usize) {
    let mut buffer = vec![0; BUFFER];
    let received = carrier.recv(&mut buffer).await.unwrap();
    let message = NetworkMessage::decode(&buffer[..received.length]).unwrap();
    let data = message.messages().next().unwrap().unwrap();
    let field = data.fields().unwrap().next().unwrap().unwrap();
    match (message.publisher_id(), field) {
        (Some(PublisherId::UInt16(publisher)), Variant::Scalar(Scalar::UInt32(number))) => {
            ((publisher, number), received.length)
        }
        other => panic!("{other:?}"),
    }
}

/// Returns a message of a size in bytes with a number.
fn value(publisher: u16, number: u32, size: usize) -> Vec<u8> {
    let empty = padded(publisher, number, 0).len();
    padded(publisher, number, size.saturating_sub(empty))
}

fn padded(publisher: u16, number: u32, padding: usize) -> Vec<u8> {
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

const ASKS: u16 = 1;
const ECHOES: u16 = 2;
const SOON: Duration = Duration::from_secs(30);
