//! Two carriers at a broker: the messages of one are sent back by the other.

use std::time::{Duration, Instant};

use broker::{BrokerIdentity, Mqtt};
use mappings::{Broker, BrokerAddress};
use system_tests::Times;
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
    carrier: Box<dyn Carrier>,
    buffer: Vec<u8>,
    number: u64,
}

impl CarrierPair {
    /// Connects both with a broker.
    pub(crate) fn connect(broker: &str) -> Self {
        let address = broker.to_owned();
        std::thread::spawn(move || {
            runtime().block_on(async { echo(open(&address, ECHOES).as_mut()).await });
        });
        let runtime = runtime();
        let carrier = runtime.block_on(async { open(broker, ASKS) });
        let mut carriers = Self {
            runtime,
            carrier,
            buffer: vec![0; BUFFER],
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

    /// Adds the times of round trips of a value of a size in bytes.
    pub(crate) fn round_trips(&mut self, count: usize, size: usize, times: &mut Times) {
        for _ in 0..count {
            let time = self.round_trip(size, SOON);
            times.add(time.expect("each message comes back"));
        }
    }

    fn round_trip(&mut self, size: usize, limit: Duration) -> Option<Duration> {
        self.number += 1;
        let number = self.number;
        let (carrier, buffer) = (self.carrier.as_mut(), &mut self.buffer);
        self.runtime.block_on(async {
            let _change = carrier.follow();
            let start = Instant::now();
            let message = encode(ASKS, number, size);
            if carrier.try_send(&OutgoingMessage::new(&message)).is_err() {
                // The connection needs time.
                tokio::time::sleep(Duration::from_millis(10)).await;
                return None;
            }
            let back = async { while next(carrier, buffer).await.0 != (ECHOES, number) {} };
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
fn open(address: &str, publisher: u16) -> Box<dyn Carrier> {
    let broker = Broker::new(BrokerAddress::parse(address).unwrap());
    let identity = BrokerIdentity {
        program: "bench".to_owned(),
        publisher: Some(publisher),
    };
    Box::new(Mqtt::open(&broker, &identity).unwrap())
}

/// Sends each value of the other carrier back.
async fn echo(carrier: &mut dyn Carrier) {
    let mut buffer = vec![0; BUFFER];
    let mut followed = Instant::now();
    loop {
        let ((publisher, number), size) = next(carrier, &mut buffer).await;
        if publisher == ASKS {
            let message = encode(ECHOES, number, size);
            let _lost = carrier.try_send(&OutgoingMessage::new(&message));
        }
        if followed.elapsed() > Duration::from_secs(1) {
            let _change = carrier.follow();
            followed = Instant::now();
        }
    }
}

/// Returns the sender and the number of the next value, and its size in bytes.
async fn next(carrier: &mut dyn Carrier, buffer: &mut Vec<u8>) -> ((u16, u64), usize) {
    loop {
        let received = carrier.recv(buffer).await.unwrap();
        let message = NetworkMessage::decode(&buffer[..received.length]).unwrap();
        let Some(PublisherId::UInt16(publisher)) = message.publisher_id() else {
            continue;
        };
        let Some(Ok(data)) = message.messages().next() else {
            continue;
        };
        let mut fields = data.fields().unwrap().flatten();
        if let (
            Some(Variant::Scalar(Scalar::UInt64(number))),
            Some(Variant::Scalar(Scalar::ByteString(Some(rest)))),
        ) = (fields.next(), fields.next())
        {
            return ((publisher, number), NUMBER + rest.len());
        }
    }
}

/// Encodes a value: a number, and as many bytes as are missing to the size.
fn encode(publisher: u16, number: u64, size: usize) -> Vec<u8> {
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
    frame.scalar(Scalar::UInt64(number)).unwrap();
    let rest = vec![7; size.saturating_sub(NUMBER)];
    frame.scalar(Scalar::ByteString(Some(&rest))).unwrap();
    frame.finish().unwrap();
    message.finish().unwrap();
    bytes
}

const ASKS: u16 = 1;
const ECHOES: u16 = 2;
/// Bytes of a number.
const NUMBER: usize = 8;
const SOON: Duration = Duration::from_secs(30);
