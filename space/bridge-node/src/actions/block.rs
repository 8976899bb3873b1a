//! Calls and values of an action as blocks of OPC UA fields. The content of goals, feedback and
//! results is opaque.
//!
//! A block is the number of its fields (UInt16) followed by a Variant for each field (OPC 10000-6,
//! 5.2.2.16). An id is a ByteString of 16 bytes.

use bytes::{BufMut, Bytes, BytesMut};
use uadp::{DateTime, Fields, Scalar, Timestamp, Variant};

use super::graph::{GraphCancelResponse, GraphGoalId, NO_GOAL};
use super::wire::{CancelSelection, GoalAnswer};

/// Splits a block into the id and the block of the fields behind it. A missing, null or empty id is
/// [`NO_GOAL`].
pub(super) fn split(block: &[u8]) -> Option<(GraphGoalId, Bytes)> {
    let (count, rest) = block.split_first_chunk()?;
    let Some(count) = u16::from_le_bytes(*count).checked_sub(1) else {
        return Some((NO_GOAL, Bytes::copy_from_slice(block)));
    };
    let (tag, rest) = rest.split_first()?;
    let (id, rest) = match *tag {
        NULL => (NO_GOAL, rest),
        BYTE_STRING => {
            let (length, rest) = rest.split_first_chunk()?;
            match i32::from_le_bytes(*length) {
                ..=0 => (NO_GOAL, rest),
                ID => {
                    let (id, rest) = rest.split_first_chunk()?;
                    (*id, rest)
                }
                _ => return None,
            }
        }
        _ => return None,
    };
    let mut body = BytesMut::with_capacity(rest.len() + 2);
    body.put_u16_le(count);
    body.put_slice(rest);
    Some((id, body.freeze()))
}

/// Returns the block of the id and the fields behind it.
pub(super) fn join(id: GraphGoalId, body: &[u8]) -> Option<Bytes> {
    let (count, rest) = body.split_first_chunk()?;
    let mut block = Writer::of(u16::from_le_bytes(*count).checked_add(1)?);
    block.bytes(&id);
    block.0.put_slice(rest);
    Some(block.0.freeze())
}

pub(super) fn goal_answer(answer: &GoalAnswer) -> Bytes {
    let mut block = Writer::of(4);
    block.boolean(answer.accepted);
    block.bytes(&answer.id);
    block.time(answer.stamp);
    block.text(&answer.message);
    block.0.freeze()
}

pub(super) fn read_cancel_request(block: &[u8]) -> Option<CancelSelection> {
    let (id, rest) = split(block)?;
    let stamp = Fields::parse(&rest).ok()?.next().transpose().ok()?;
    let until = match stamp {
        None | Some(Variant::Null) => None,
        Some(Variant::Scalar(Scalar::DateTime(DateTime(0)))) => None,
        Some(Variant::Scalar(Scalar::DateTime(time))) => Some(Timestamp::from(time)),
        Some(Variant::Scalar(_) | Variant::Array(_) | Variant::Matrix(_)) => return None,
    };
    // In a ROS message a time that is not set is the beginning of 1970.
    let until = until.filter(|until| until.unix_nanos() != 0);
    Some(CancelSelection { id, until })
}

pub(super) fn cancel_answer(answer: &GraphCancelResponse) -> Bytes {
    let mut block = Writer::of(2);
    block.signed(answer.code);
    block.bytes(answer.goals.as_flattened());
    block.0.freeze()
}

/// Encodes the response with a result, which is a block itself.
pub(super) fn result_answer((status, message): (i8, &str), result: &[u8]) -> Option<Bytes> {
    let (count, rest) = result.split_first_chunk()?;
    let mut block = Writer::of(u16::from_le_bytes(*count).checked_add(2)?);
    block.signed(status);
    block.text(message);
    block.0.put_slice(rest);
    Some(block.0.freeze())
}

/// Encodes the value with the goal statuses.
pub(super) fn statuses(goals: &[(GraphGoalId, i8)]) -> Bytes {
    let ids: Vec<GraphGoalId> = goals.iter().map(|(id, _)| *id).collect();
    let of_goals = goals.iter().map(|(_, status)| status.cast_unsigned());
    let statuses: Vec<u8> = of_goals.collect();
    let mut block = Writer::of(2);
    block.bytes(ids.as_flattened());
    block.bytes(&statuses);
    block.0.freeze()
}

struct Writer(BytesMut);

impl Writer {
    fn of(fields: u16) -> Self {
        let mut bytes = BytesMut::new();
        bytes.put_u16_le(fields);
        Self(bytes)
    }

    fn boolean(&mut self, value: bool) {
        self.0.put_slice(&[BOOLEAN, value.into()]);
    }

    fn signed(&mut self, value: i8) {
        self.0.put_slice(&[SBYTE, value.cast_unsigned()]);
    }

    fn time(&mut self, at: Timestamp) {
        self.0.put_u8(DATE_TIME);
        self.0.put_i64_le(at.time.0);
    }

    fn text(&mut self, text: &str) {
        self.counted(STRING, text.as_bytes());
    }

    fn bytes(&mut self, bytes: &[u8]) {
        self.counted(BYTE_STRING, bytes);
    }

    fn counted(&mut self, tag: u8, bytes: &[u8]) {
        self.0.put_u8(tag);
        self.0
            .put_i32_le(i32::try_from(bytes.len()).unwrap_or(i32::MAX));
        self.0.put_slice(bytes);
    }
}

/// Encoding bytes of Variants.
const NULL: u8 = 0;
const BOOLEAN: u8 = 1;
const SBYTE: u8 = 2;
const STRING: u8 = 12;
const DATE_TIME: u8 = 13;
const BYTE_STRING: u8 = 15;
/// Length of an id in bytes.
const ID: i32 = 16;

#[cfg(test)]
mod tests {
    use super::*;

    fn values(block: &[u8]) -> Vec<Variant<'_>> {
        let fields = Fields::parse(block).unwrap();
        fields.map(Result::unwrap).collect()
    }

    #[test]
    fn what_is_written_is_read_as_fields_of_the_types_of_an_action() {
        let stamp = Timestamp::from_unix_nanos(1_700_000_000_123_456_700);
        let answer = GoalAnswer {
            accepted: true,
            id: [7; 16],
            stamp,
            message: "why".to_owned(),
        };
        let wanted = [
            Variant::Scalar(Scalar::Boolean(true)),
            Variant::Scalar(Scalar::ByteString(Some(&[7; 16]))),
            Variant::Scalar(Scalar::DateTime(stamp.time)),
            Variant::Scalar(Scalar::String(Some("why"))),
        ];
        assert_eq!(values(&goal_answer(&answer)), wanted);
        let goals = [[1; 16], [2; 16]];
        let answer = GraphCancelResponse {
            code: -3,
            goals: goals.to_vec(),
        };
        let wanted = [
            Variant::Scalar(Scalar::SByte(-3)),
            Variant::Scalar(Scalar::ByteString(Some(goals.as_flattened()))),
        ];
        assert_eq!(values(&cancel_answer(&answer)), wanted);
        let result = [1, 0, BOOLEAN, 1];
        let wanted = [
            Variant::Scalar(Scalar::SByte(4)),
            Variant::Scalar(Scalar::String(Some(""))),
            Variant::Scalar(Scalar::Boolean(true)),
        ];
        assert_eq!(values(&result_answer((4, ""), &result).unwrap()), wanted);
        let wanted = [
            Variant::Scalar(Scalar::ByteString(Some(goals.as_flattened()))),
            Variant::Scalar(Scalar::ByteString(Some(&[2, 255]))),
        ];
        assert_eq!(values(&statuses(&[([1; 16], 2), ([2; 16], -1)])), wanted);
    }

    #[test]
    fn an_id_stands_in_front_of_a_goal_and_may_be_left_out() {
        let body = [1, 0, BOOLEAN, 1];
        let joined = join([5; 16], &body).unwrap();
        assert_eq!(
            split(&joined),
            Some(([5; 16], Bytes::copy_from_slice(&body)))
        );
        let without = [2, 0, NULL, BOOLEAN, 1];
        assert_eq!(
            split(&without),
            Some((NO_GOAL, Bytes::copy_from_slice(&body)))
        );
        let nothing = Bytes::from_static(&[0, 0]);
        assert_eq!(split(&nothing), Some((NO_GOAL, nothing.clone())));
        assert_eq!(split(&[1, 0, BYTE_STRING, 3, 0, 0, 0, 1, 2, 3]), None);
        for short in 0..joined.len() - 2 {
            let _any = (
                split(&joined[..short]),
                read_cancel_request(&joined[..short]),
            );
        }
        assert_eq!(split(&[1, 0, BOOLEAN, 1]), None);
    }

    #[test]
    fn a_request_to_cancel_means_all_where_it_says_nothing() {
        let any = CancelSelection {
            id: NO_GOAL,
            until: None,
        };
        assert_eq!(read_cancel_request(&[0, 0]), Some(any));
        let stamp = Timestamp::from_unix_nanos(1_700_000_000_000_000_000);
        for (time, until) in [
            (stamp.time, Some(stamp)),
            (DateTime(0), None),
            (Timestamp::from_unix_nanos(0).time, None),
        ] {
            let mut block = Writer::of(2);
            block.bytes(&[9; 16]);
            block.time(Timestamp::from(time));
            let read = read_cancel_request(&block.0);
            assert_eq!(read, Some(CancelSelection { id: [9; 16], until }));
        }
    }
}
