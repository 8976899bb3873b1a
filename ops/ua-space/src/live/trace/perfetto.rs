//! A trace file of Perfetto: a track for each hop of a topic, and a flow for each sample. The
//! format is a protobuf message `Trace`, written by hand because few fields are needed.

use std::collections::BTreeMap;

use mappings::TopicId;

use super::Times;
use super::protobuf::ProtobufMessage;

/// Returns the bytes of a trace, and the number of samples that are left out because too many
/// others were in flight at the same time.
pub(super) fn trace(
    samples: &[Times],
    name_of: &dyn Fn(TopicId) -> Option<String>,
) -> (Vec<u8>, u64) {
    let mut trace = Trace::default();
    trace.packet(|packet| {
        packet.message(TRACK_DESCRIPTOR, |track| {
            track.number(UUID, PROCESS_UUID);
            track.message(PROCESS, |process| {
                process.number(PID, 1);
                process.text(PROCESS_NAME, "UA space");
            });
        });
    });
    let mut hops: BTreeMap<(TopicId, Hop), Lanes> = BTreeMap::new();
    let mut left_out = 0;
    for (times, flow) in samples.iter().zip(1_u64..) {
        let Some(sent) = times.sent else {
            continue;
        };
        let mut slice = |hop: Hop, (from, to): (i128, i128), flows: (u32, u64)| {
            // Clocks that differ make negative delays, which no slice can show.
            let (Ok(from), Ok(to)) = (u64::try_from(from), u64::try_from(to)) else {
                return;
            };
            if to < from {
                return;
            }
            let lanes = hops.entry((times.topic, hop)).or_default();
            let Some(lane) = lanes.lane(from, to) else {
                left_out += 1;
                return;
            };
            let track = uuid(times.topic, hop, lane);
            if lanes.announced <= lane {
                lanes.announced = lane + 1;
                let name = name_of(times.topic).unwrap_or_else(|| times.topic.to_string());
                let name = match lane {
                    0 => format!("{name}: {}", hop.name()),
                    _ => format!("{name}: {} ({})", hop.name(), lane + 1),
                };
                trace.track(track, &name);
            }
            trace.slice((track, hop.name()), (from, to), (flows, times.sequence));
        };
        if let Some(taken) = times.taken {
            slice(Hop::Origin, (taken, sent), (FLOW_IDS, flow));
        }
        slice(
            Hop::Network,
            (sent, times.arrived),
            (TERMINATING_FLOW_IDS, flow),
        );
    }
    (trace.trace.into_bytes(), left_out)
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Hop {
    Origin,
    Network,
}

impl Hop {
    const fn name(self) -> &'static str {
        match self {
            Self::Origin => super::ORIGIN,
            Self::Network => super::NETWORK,
        }
    }
}

/// The tracks of a hop. Slices of a track may not overlap, so samples in flight at the same time
/// have tracks of their own.
#[derive(Debug, Default)]
struct Lanes {
    /// The end of the last slice of each track.
    ends: Vec<u64>,
    /// The number of tracks in the file.
    announced: usize,
}

impl Lanes {
    fn lane(&mut self, from: u64, to: u64) -> Option<usize> {
        let free = self.ends.iter().position(|end| *end <= from);
        let lane = match free {
            Some(lane) => lane,
            None if self.ends.len() < MOST_LANES => {
                self.ends.push(0);
                self.ends.len() - 1
            }
            None => return None,
        };
        *self.ends.get_mut(lane)? = to;
        Some(lane)
    }
}

/// Returns the id of a track, which is not the id of the process.
fn uuid(topic: TopicId, hop: Hop, lane: usize) -> u64 {
    let (space, namespace, identifier) = topic.triple();
    let parts = [space, namespace, identifier];
    let topic = parts
        .iter()
        .fold(0_u64, |all, part| (all << 16) | u64::from(*part));
    let lane = u64::try_from(lane).unwrap_or_default();
    // 48 bits of the triple, a bit of the hop, and 8 bits of the track.
    (topic << 9) | (u64::from(hop == Hop::Network) << 8) | (lane + 2)
}

/// The encoded packets.
#[derive(Debug, Default)]
struct Trace {
    trace: ProtobufMessage,
    /// Whether the first packet is written, which starts the sequence.
    is_started: bool,
}

impl Trace {
    fn packet(&mut self, fill: impl FnOnce(&mut ProtobufMessage)) {
        let is_first = !std::mem::replace(&mut self.is_started, true);
        let mut packet = ProtobufMessage::default();
        packet.number(SEQUENCE_ID, 1);
        if is_first {
            packet.number(SEQUENCE_FLAGS, INCREMENTAL_STATE_CLEARED);
        }
        fill(&mut packet);
        self.trace.bytes(PACKET, packet.encoded());
    }

    fn track(&mut self, track: u64, name: &str) {
        self.packet(|packet| {
            packet.message(TRACK_DESCRIPTOR, |descriptor| {
                descriptor.number(UUID, track);
                descriptor.text(NAME, name);
                descriptor.number(PARENT_UUID, PROCESS_UUID);
            });
        });
    }

    fn slice(
        &mut self,
        (track, name): (u64, &str),
        (from, to): (u64, u64),
        ((flow_field, flow), sequence): ((u32, u64), Option<u16>),
    ) {
        self.packet(|packet| {
            packet.number(TIMESTAMP, from);
            packet.message(TRACK_EVENT, |event| {
                event.number(EVENT_TYPE, SLICE_BEGIN);
                event.number(TRACK_UUID, track);
                event.text(EVENT_NAME, name);
                event.fixed(flow_field, flow);
                if let Some(sequence) = sequence {
                    event.message(DEBUG_ANNOTATIONS, |annotation| {
                        annotation.text(ANNOTATION_NAME, "sequence number");
                        annotation.number(ANNOTATION_UINT, sequence.into());
                    });
                }
            });
        });
        self.packet(|packet| {
            packet.number(TIMESTAMP, to);
            packet.message(TRACK_EVENT, |event| {
                event.number(EVENT_TYPE, SLICE_END);
                event.number(TRACK_UUID, track);
            });
        });
    }
}

/// The track of the process that contains all tracks.
const PROCESS_UUID: u64 = 1;
const MOST_LANES: usize = 64;

/// Fields of the messages in perfetto/trace.
const PACKET: u32 = 1;
const TIMESTAMP: u32 = 8;
const SEQUENCE_ID: u32 = 10;
const TRACK_EVENT: u32 = 11;
const SEQUENCE_FLAGS: u32 = 13;
const TRACK_DESCRIPTOR: u32 = 60;
const INCREMENTAL_STATE_CLEARED: u64 = 1;
/// Fields of TrackDescriptor and ProcessDescriptor.
const UUID: u32 = 1;
const NAME: u32 = 2;
const PROCESS: u32 = 3;
const PARENT_UUID: u32 = 5;
const PID: u32 = 1;
const PROCESS_NAME: u32 = 6;
/// Fields of TrackEvent and DebugAnnotation.
const DEBUG_ANNOTATIONS: u32 = 4;
const EVENT_TYPE: u32 = 9;
const TRACK_UUID: u32 = 11;
const EVENT_NAME: u32 = 23;
const FLOW_IDS: u32 = 47;
const TERMINATING_FLOW_IDS: u32 = 48;
const SLICE_BEGIN: u64 = 1;
const SLICE_END: u64 = 2;
const ANNOTATION_UINT: u32 = 3;
const ANNOTATION_NAME: u32 = 10;

#[cfg(test)]
mod tests {
    use super::super::protobuf::tests::{Value, fields};
    use super::*;

    fn inner<'a>(fields: &[(u64, Value<'a>)], field: u32) -> Option<Vec<(u64, Value<'a>)>> {
        let found = fields.iter().find(|(of, _)| *of == u64::from(field));
        match found? {
            (_, Value::Bytes(bytes)) => Some(super::super::protobuf::tests::fields(bytes)),
            (_, Value::Number(_)) => None,
        }
    }

    fn number(fields: &[(u64, Value<'_>)], field: u32) -> Option<u64> {
        let found = fields.iter().find(|(of, _)| *of == u64::from(field));
        match found? {
            (_, Value::Number(number)) => Some(*number),
            (_, Value::Bytes(_)) => None,
        }
    }

    fn sample(taken: Option<i128>, sent: i128, arrived: i128) -> Times {
        Times {
            topic: "ua_1_2_10".parse().unwrap(),
            sequence: Some(7),
            stamp: taken,
            taken,
            sent: Some(sent),
            arrived,
        }
    }

    #[test]
    fn each_hop_has_a_track_and_a_flow_leads_from_the_first_to_the_second() {
        let name = |_| Some("Left.Speed".to_owned());
        let (bytes, left_out) = trace(&[sample(Some(1_000), 3_000, 10_000)], &name);
        assert_eq!(left_out, 0);
        let packets: Vec<_> = fields(&bytes)
            .into_iter()
            .map(|(field, value)| {
                assert_eq!(field, u64::from(PACKET));
                match value {
                    Value::Bytes(bytes) => fields(bytes),
                    Value::Number(_) => panic!("a packet is a message"),
                }
            })
            .collect();
        assert_eq!(
            number(&packets[0], SEQUENCE_FLAGS),
            Some(INCREMENTAL_STATE_CLEARED)
        );
        assert!(
            packets
                .iter()
                .all(|packet| number(packet, SEQUENCE_ID) == Some(1))
        );
        let tracks: Vec<String> = packets
            .iter()
            .filter_map(|packet| inner(packet, TRACK_DESCRIPTOR))
            .filter_map(|track| {
                let name = track
                    .into_iter()
                    .find(|(field, _)| *field == u64::from(NAME))?
                    .1;
                match name {
                    Value::Bytes(bytes) => Some(String::from_utf8(bytes.to_vec()).unwrap()),
                    Value::Number(_) => None,
                }
            })
            .collect();
        assert_eq!(tracks, ["Left.Speed: origin", "Left.Speed: network"]);
        let events: Vec<_> = packets
            .iter()
            .filter_map(|packet| Some((number(packet, TIMESTAMP)?, inner(packet, TRACK_EVENT)?)))
            .collect();
        let times: Vec<u64> = events.iter().map(|(at, _)| *at).collect();
        assert_eq!(times, [1_000, 3_000, 3_000, 10_000]);
        let flow = |at: usize, field| number(&events[at].1, field);
        assert_eq!(flow(0, FLOW_IDS), Some(1));
        assert_eq!(flow(2, TERMINATING_FLOW_IDS), Some(1));
        assert_ne!(flow(0, TRACK_UUID), flow(2, TRACK_UUID));
    }

    #[test]
    fn samples_in_flight_at_once_have_tracks_of_their_own_and_their_number_is_bounded() {
        let all: Vec<Times> = (0..70).map(|at| sample(None, at, 1_000)).collect();
        let (_, left_out) = trace(&all, &|_| None);
        assert_eq!(left_out, 6);
        // A negative delay makes no slice.
        let (bytes, _) = trace(&[sample(None, 1_000, 10)], &|_| None);
        assert_eq!(fields(&bytes).len(), 1);
    }
}
