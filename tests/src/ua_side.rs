//! The OPC UA side of a cell, built on the codec alone.

use std::time::{Duration, Instant};

use uadp::{
    DataSetHeader, GroupHeader, NetworkHeader, NetworkMessage, NetworkMessageEncoder, PublisherId,
    Scalar, Variant,
};

use crate::UadpSocket;

/// PublisherId, WriterGroupId and DataSetWriterId of a value.
pub type TopicTriple = (u16, u16, u16);

/// The time that Python peers need on a busy machine.
const PATIENCE: Duration = Duration::from_secs(30);

/// Receives all values of a cell and writes values of other spaces.
pub struct UaSide {
    socket: UadpSocket,
    sequence: u16,
}

impl UaSide {
    /// Joins the group.
    ///
    /// # Panics
    /// Panics if the socket cannot be created.
    #[must_use]
    pub fn join() -> Self {
        Self::on(UadpSocket::join())
    }

    /// Creates the side on this socket.
    #[must_use]
    pub const fn on(socket: UadpSocket) -> Self {
        Self {
            socket,
            sequence: 0,
        }
    }

    /// Returns the first result of `pick`, other than `None`, for the values of the triple.
    ///
    /// # Panics
    /// Panics if there is no such value in time, with the text `what` in the message.
    pub fn hear<T>(
        &self,
        triple: TopicTriple,
        what: &str,
        pick: impl Fn(&[Variant<'_>]) -> Option<T>,
    ) -> T {
        let start = Instant::now();
        while start.elapsed() < PATIENCE {
            let Some(datagram) = self.socket.receive(PATIENCE) else {
                break;
            };
            let message = NetworkMessage::decode(&datagram).unwrap();
            for (found, fields) in values(&message) {
                if found == triple
                    && let Some(found) = pick(&fields)
                {
                    return found;
                }
            }
        }
        panic!("{triple:?} was not heard: {what}");
    }

    /// Waits for a value with a single field.
    ///
    /// # Panics
    /// Panics if the value does not arrive in time.
    pub fn hear_scalar(&self, triple: TopicTriple, expected: Scalar<'_>) {
        self.hear(triple, &format!("{expected:?}"), |fields| {
            matches!(fields, [Variant::Scalar(found)] if *found == expected).then_some(())
        });
    }

    /// Writes a value with a single field.
    ///
    /// # Panics
    /// Panics if the value cannot be sent.
    pub fn write(&mut self, triple: TopicTriple, value: Scalar<'_>) {
        self.write_fields(triple, &[value]);
    }

    /// Writes a value with several fields.
    ///
    /// # Panics
    /// Panics if the value cannot be sent.
    pub fn write_fields(&mut self, (space, namespace, id): TopicTriple, values: &[Scalar<'_>]) {
        self.sequence = self.sequence.wrapping_add(1);
        let header = NetworkHeader {
            publisher_id: Some(PublisherId::UInt16(space)),
            group: Some(GroupHeader {
                writer_group_id: Some(namespace),
                ..GroupHeader::default()
            }),
            ..NetworkHeader::default()
        };
        let mut datagram = Vec::new();
        let mut message = NetworkMessageEncoder::new(&mut datagram, &header, Some(&[id])).unwrap();
        let header = DataSetHeader {
            sequence_number: Some(self.sequence),
            ..DataSetHeader::default()
        };
        let mut frame = message.key_frame(&header).unwrap();
        for value in values {
            frame.scalar(*value).unwrap();
        }
        frame.finish().unwrap();
        message.finish().unwrap();
        self.socket.send(&datagram);
    }

    /// Discards the waiting datagrams.
    pub fn drain(&self) {
        self.socket.drain();
    }

    /// Returns the triples of all values received within `window`.
    #[must_use]
    pub fn triples_for(&self, window: Duration) -> Vec<TopicTriple> {
        let datagrams = self.socket.receive_for(window);
        let messages = datagrams.iter().map(|d| NetworkMessage::decode(d).unwrap());
        messages
            .flat_map(|message| {
                values(&message)
                    .into_iter()
                    .map(|(triple, _)| triple)
                    .collect::<Vec<_>>()
            })
            .collect()
    }
}

/// Returns the values of a NetworkMessage; a keep-alive has no fields.
fn values<'a>(message: &NetworkMessage<'a>) -> Vec<(TopicTriple, Vec<Variant<'a>>)> {
    let header = message.header();
    let group = header.group.and_then(|group| group.writer_group_id);
    let (Some(PublisherId::UInt16(space)), Some(group)) = (header.publisher_id, group) else {
        return Vec::new();
    };
    let all = message.messages().map(Result::unwrap);
    all.filter_map(|message| {
        let fields = message.fields();
        let fields = fields.map(|fields| fields.map(Result::unwrap).collect());
        Some((
            (space, group, message.writer_id?),
            fields.unwrap_or_default(),
        ))
    })
    .collect()
}
