//! Calls and values of an action as ROS 1 or ROS 2 messages. The content of goals, feedback and
//! results is opaque.
//!
//! The Router writes and reads the messages, in little endian.

use std::sync::Arc;

use bytes::{BufMut, Bytes, BytesMut};
use messages::{ActionCalls, Literal, MessagePlan, NoFields, Selection, Wire};
use uadp::Timestamp;

use super::graph::{GraphCancelResponse, GraphGoalId};
use crate::GraphError;

/// The response to a goal.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct GoalAnswer {
    pub(super) accepted: bool,
    pub(super) id: GraphGoalId,
    /// Time of acceptance.
    pub(super) stamp: Timestamp,
    pub(super) message: String,
}

/// A result as a facade forwards it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct ForwardedResult {
    pub(super) status: i8,
    pub(super) message: String,
    /// As in [`GraphGoalEvent::Ended`](super::GraphGoalEvent::Ended).
    pub(super) result: Bytes,
}

/// The goals that a request to cancel selects.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct CancelSelection {
    /// All zero: any goal.
    pub(super) id: GraphGoalId,
    /// `None`: any goal; else goals that were accepted at this time or before.
    pub(super) until: Option<Timestamp>,
}

/// Joins an id and the goal or feedback behind it.
pub(super) fn join(wire: Wire, id: GraphGoalId, body: &[u8]) -> Option<Bytes> {
    let (head, rest) = body.split_at_checked(header(wire))?;
    let mut bytes = BytesMut::with_capacity(body.len() + id.len());
    bytes.put_slice(head);
    bytes.put_slice(&id);
    bytes.put_slice(rest);
    Some(bytes.freeze())
}

/// Splits a message into the id and the goal or feedback behind it. 16 bytes do not change the
/// alignment of CDR.
pub(super) fn split(wire: Wire, message: &[u8]) -> Option<(GraphGoalId, Bytes)> {
    let (head, rest) = message.split_at_checked(header(wire))?;
    let (id, rest) = rest.split_first_chunk()?;
    let body = [head, rest].concat();
    Some((*id, body.into()))
}

/// Encodes a request for the result of a goal.
pub(super) fn result_request(wire: Wire, id: GraphGoalId) -> Bytes {
    let mut out = Writer::new(wire);
    out.raw(&id);
    out.finish()
}

/// Returns the goal of a request for a result.
pub(super) fn read_result_request(wire: Wire, message: &[u8]) -> Option<GraphGoalId> {
    Reader::new(wire, message)?.id()
}

pub(super) fn goal_answer(wire: Wire, answer: &GoalAnswer) -> Bytes {
    let mut out = Writer::new(wire);
    out.raw(&[answer.accepted.into()]);
    out.raw(&answer.id);
    out.time(answer.stamp);
    out.text(&answer.message);
    out.finish()
}

pub(super) fn read_goal_answer(wire: Wire, message: &[u8]) -> Option<GoalAnswer> {
    let mut read = Reader::new(wire, message)?;
    Some(GoalAnswer {
        accepted: read.byte()? != 0,
        id: read.id()?,
        stamp: read.time()?,
        message: read.text()?,
    })
}

pub(super) fn cancel_request(wire: Wire, request: CancelSelection) -> Bytes {
    let mut out = Writer::new(wire);
    out.raw(&request.id);
    match request.until {
        Some(until) => out.time(until),
        None => {
            out.number(0);
            out.number(0);
        }
    }
    out.finish()
}

pub(super) fn read_cancel_request(wire: Wire, message: &[u8]) -> Option<CancelSelection> {
    let mut read = Reader::new(wire, message)?;
    let id = read.id()?;
    let until = read.time()?;
    let until = (until.unix_nanos() != 0).then_some(until);
    Some(CancelSelection { id, until })
}

pub(super) fn cancel_answer(wire: Wire, answer: &GraphCancelResponse) -> Bytes {
    let mut out = Writer::new(wire);
    out.raw(&answer.code.to_le_bytes());
    out.sequence(answer.goals.as_flattened());
    out.finish()
}

pub(super) fn read_cancel_answer(wire: Wire, message: &[u8]) -> Option<GraphCancelResponse> {
    let mut read = Reader::new(wire, message)?;
    let code = read.code()?;
    let (goals, _) = read.sequence()?.as_chunks();
    let goals = goals.to_vec();
    Some(GraphCancelResponse { code, goals })
}

/// Encodes the response with a result. In ROS 2 the fields behind the status of an
/// `X_GetResult_Response` start at an offset of 1 modulo 8. The message text is padded to a
/// multiple of 8 bytes, so that the fields behind it have the same offset and are copied unchanged.
pub(super) fn result_answer(
    wire: Wire,
    (status, message): (i8, &str),
    result: &[u8],
) -> Option<Bytes> {
    let mut out = Writer::new(wire);
    out.raw(&status.to_le_bytes());
    match wire {
        Wire::Ros1 => {
            out.text(message);
            out.raw(result);
        }
        Wire::Cdr => {
            let padded = message.len().next_multiple_of(8);
            out.text(&format!("{message:padded$}"));
            out.raw(result.get(header(wire) + 1..)?);
        }
    }
    Some(out.finish())
}

/// Encodes the response without a result of a server: all fields of the result are zero or empty.
///
/// # Errors
/// The reason why the response cannot be encoded.
pub(super) fn empty_result_answer(
    wire: Wire,
    calls: &Arc<ActionCalls>,
    (status, message): (i8, &str),
) -> Result<Bytes, GraphError> {
    let one = |text: String| Literal::One(text);
    let template = Selection::Template {
        fields: Vec::new(),
        rest: [
            ("status".to_owned(), one(status.to_string())),
            ("message".to_owned(), one(message.to_owned())),
        ]
        .into(),
    };
    let plan = MessagePlan::compile(calls.result().response(), &template, wire)?;
    let mut bytes = Vec::new();
    plan.write(&mut NoFields, &mut bytes)?;
    Ok(bytes.into())
}

/// Decodes the response to a facade: the type [`ActionCalls::result`] in ROS 1,
/// [`ActionCalls::outcome`] in ROS 2.
pub(super) fn read_outcome(wire: Wire, message: &Bytes) -> Option<ForwardedResult> {
    let mut read = Reader::new(wire, message)?;
    let status = read.code()?;
    Some(match wire {
        Wire::Ros1 => {
            let text = read.text()?;
            let result = message.slice(read.at..);
            ForwardedResult {
                status,
                message: text,
                result,
            }
        }
        Wire::Cdr => ForwardedResult {
            status,
            message: String::new(),
            result: message.clone(),
        },
    })
}

/// Encodes the value with the goal statuses.
pub(super) fn statuses(wire: Wire, goals: &[(GraphGoalId, i8)]) -> Bytes {
    let ids: Vec<GraphGoalId> = goals.iter().map(|(id, _)| *id).collect();
    let statuses: Vec<u8> = goals
        .iter()
        .map(|(_, status)| status.cast_unsigned())
        .collect();
    let mut out = Writer::new(wire);
    out.sequence(ids.as_flattened());
    out.sequence(&statuses);
    out.finish()
}

/// Returns the number of header bytes in front of a message.
const fn header(wire: Wire) -> usize {
    match wire {
        Wire::Ros1 => 0,
        Wire::Cdr => ENCAPSULATION.len(),
    }
}

/// CDR in little endian (DDSI-RTPS 2.5, 10.5).
const ENCAPSULATION: [u8; 4] = [0, 1, 0, 0];

struct Writer {
    wire: Wire,
    bytes: BytesMut,
}

impl Writer {
    fn new(wire: Wire) -> Self {
        let mut bytes = BytesMut::new();
        if wire == Wire::Cdr {
            bytes.put_slice(&ENCAPSULATION);
        }
        Self { wire, bytes }
    }

    fn raw(&mut self, bytes: &[u8]) {
        self.bytes.put_slice(bytes);
    }

    fn number(&mut self, number: u32) {
        if self.wire == Wire::Cdr {
            let len = self.bytes.len().next_multiple_of(4);
            self.bytes.resize(len, 0);
        }
        self.bytes.put_u32_le(number);
    }

    fn length(&mut self, length: usize) {
        self.number(u32::try_from(length).unwrap_or(u32::MAX));
    }

    fn time(&mut self, at: Timestamp) {
        let (seconds, nanos) = (at.unix_nanos() / NANOS, at.unix_nanos() % NANOS);
        // Neither ROS has times before 1970 or, in these fields, after 2106.
        self.number(u32::try_from(seconds).unwrap_or_default());
        self.number(u32::try_from(nanos).unwrap_or_default());
    }

    fn text(&mut self, text: &str) {
        match self.wire {
            Wire::Ros1 => self.sequence(text.as_bytes()),
            Wire::Cdr => {
                // A string of CDR ends with a zero byte, and so contains none.
                let text = text.replace('\0', " ");
                self.length(text.len() + 1);
                self.raw(text.as_bytes());
                self.raw(&[0]);
            }
        }
    }

    fn sequence(&mut self, bytes: &[u8]) {
        self.length(bytes.len());
        self.raw(bytes);
    }

    fn finish(self) -> Bytes {
        self.bytes.freeze()
    }
}

struct Reader<'m> {
    wire: Wire,
    message: &'m [u8],
    /// Position of the next read.
    at: usize,
}

impl<'m> Reader<'m> {
    fn new(wire: Wire, message: &'m [u8]) -> Option<Self> {
        let at = header(wire);
        let little = message.get(..at)?.get(1).is_none_or(|kind| *kind == 1);
        little.then_some(Self { wire, message, at })
    }

    fn take(&mut self, count: usize) -> Option<&'m [u8]> {
        let bytes = self.message.get(self.at..)?.get(..count)?;
        self.at += count;
        Some(bytes)
    }

    fn byte(&mut self) -> Option<u8> {
        self.take(1)?.first().copied()
    }

    fn code(&mut self) -> Option<i8> {
        self.byte().map(u8::cast_signed)
    }

    fn id(&mut self) -> Option<GraphGoalId> {
        self.take(size_of::<GraphGoalId>())?.try_into().ok()
    }

    fn number(&mut self) -> Option<u32> {
        if self.wire == Wire::Cdr {
            self.at = self.at.next_multiple_of(4);
        }
        let bytes = self.take(4)?.try_into().ok()?;
        Some(u32::from_le_bytes(bytes))
    }

    fn sequence(&mut self) -> Option<&'m [u8]> {
        let length = usize::try_from(self.number()?).ok()?;
        self.take(length)
    }

    fn time(&mut self) -> Option<Timestamp> {
        let (seconds, nanos) = (self.number()?, self.number()?);
        let nanos = i128::from(seconds) * NANOS + i128::from(nanos);
        Some(Timestamp::from_unix_nanos(nanos))
    }

    fn text(&mut self) -> Option<String> {
        let bytes = self.sequence()?;
        let text = match self.wire {
            Wire::Ros1 => bytes,
            Wire::Cdr => bytes.strip_suffix(&[0]).unwrap_or(bytes),
        };
        Some(String::from_utf8_lossy(text).into_owned())
    }
}

const NANOS: i128 = 1_000_000_000;

#[cfg(test)]
mod tests {
    use messages::{Dialect, TypeRegistry};

    use super::*;

    const WIRES: [Wire; 2] = [Wire::Ros1, Wire::Cdr];

    #[test]
    fn what_is_written_of_calls_is_read_by_their_types_and_by_us() {
        let name = "demo_msgs/Count".parse().unwrap();
        for (dialect, wire) in [Dialect::Ros1, Dialect::Ros2].into_iter().zip(WIRES) {
            let mut registry = TypeRegistry::bundle(dialect);
            let text = "float64 x\n---\nint32[] sequence\nfloat64 y\n---\nint32 n\n";
            registry.add_action(&name, text).unwrap();
            let calls = Arc::new(registry.action_calls(&name).unwrap());
            let reads = |of: &Arc<messages::MessageType>, bytes: &[u8]| {
                let plan = MessagePlan::compile(of, &Selection::Whole, wire).unwrap();
                plan.read(bytes, &mut Seen::default()).unwrap();
            };
            let stamp = Timestamp::from_unix_nanos(1_700_000_000_123_456_700);
            let answer = GoalAnswer {
                accepted: true,
                id: [7; 16],
                stamp,
                message: "why not".to_owned(),
            };
            let bytes = goal_answer(wire, &answer);
            reads(calls.goal().response(), &bytes);
            assert_eq!(read_goal_answer(wire, &bytes), Some(answer));
            let request = CancelSelection {
                id: [1; 16],
                until: Some(stamp),
            };
            let bytes = cancel_request(wire, request);
            reads(calls.cancel().request(), &bytes);
            assert_eq!(read_cancel_request(wire, &bytes), Some(request));
            let answer = GraphCancelResponse {
                code: 3,
                goals: vec![[1; 16], [2; 16]],
            };
            let bytes = cancel_answer(wire, &answer);
            reads(calls.cancel().response(), &bytes);
            assert_eq!(read_cancel_answer(wire, &bytes), Some(answer));
            reads(
                calls.status(),
                &statuses(wire, &[([3; 16], 2), ([4; 16], -1)]),
            );
            let bytes = empty_result_answer(wire, &calls, (6, "gone")).unwrap();
            reads(calls.result().response(), &bytes);
            for truncated in 0..bytes.len() {
                let head = bytes.slice(..truncated);
                let _any = (read_outcome(wire, &head), read_goal_answer(wire, &head));
                let _any = (read_cancel_answer(wire, &head), split(wire, &head));
            }
        }
    }

    #[test]
    fn a_result_of_ros_2_is_the_same_behind_any_text() {
        // The response is the status, 7 bytes of padding, and y, without a sequence before it.
        let response = [&[0, 1, 0, 0, 4][..], &[0; 7], &1.5_f64.to_le_bytes()].concat();
        let name = "demo_msgs/Y".parse().unwrap();
        let mut registry = TypeRegistry::bundle(Dialect::Ros2);
        let text = "int32 a\n---\nfloat64 y\n---\nint32 b\n";
        registry.add_action(&name, text).unwrap();
        let calls = registry.action_calls(&name).unwrap();
        let plan =
            MessagePlan::compile(calls.result().response(), &Selection::Whole, Wire::Cdr).unwrap();
        for message in ["", "short", "eight of", "more than eight"] {
            let bytes = result_answer(Wire::Cdr, (5, message), &response).unwrap();
            let mut seen = Seen::default();
            plan.read(&bytes, &mut seen).unwrap();
            assert_eq!(seen.0, 1.5, "{message}");
        }
    }

    /// Keeps the last Double.
    #[derive(Default)]
    struct Seen(f64);

    impl messages::FieldSink for Seen {
        type Error = std::convert::Infallible;

        fn scalar(&mut self, value: uadp::Scalar<'_>) -> Result<(), Self::Error> {
            if let uadp::Scalar::Double(value) = value {
                self.0 = value;
            }
            Ok(())
        }

        fn packed_array(
            &mut self,
            _: uadp::BuiltinType,
            _: usize,
            _: &[u8],
        ) -> Result<(), Self::Error> {
            Ok(())
        }

        fn array(&mut self, _: uadp::BuiltinType, _: usize) -> Result<(), Self::Error> {
            Ok(())
        }

        fn element(&mut self, _: uadp::Scalar<'_>) -> Result<(), Self::Error> {
            Ok(())
        }

        fn structures(&mut self, _: &messages::TypeName, _: usize) -> Result<(), Self::Error> {
            Ok(())
        }

        fn begin_structure(&mut self, _: &messages::TypeName) -> Result<(), Self::Error> {
            Ok(())
        }

        fn end_structure(&mut self) -> Result<(), Self::Error> {
            Ok(())
        }
    }

    #[test]
    fn an_id_stands_in_front_of_a_body() {
        for wire in WIRES {
            let body = [0, 1, 0, 0, 9, 8, 7];
            let bytes = join(wire, [5; 16], &body).unwrap();
            assert_eq!(
                split(wire, &bytes),
                Some(([5; 16], Bytes::copy_from_slice(&body)))
            );
        }
    }
}
