//! Encodes and decodes the messages that every action has. The module is pure, and validates all
//! received bytes.

use bytes::{Bytes, BytesMut};

use super::types::{CancelAnswer, CancelCode, CancelWhat, GoalId, GoalInfo, GoalStatusCode};
use crate::cdr::{CdrReader, CdrWriter, Malformed};
use crate::clock::Ros2Time;

/// Splits `X_SendGoal_Request` or `X_FeedbackMessage` into the id and the rest, which keeps an
/// encapsulation header. The id has 16 bytes, so its removal keeps the alignment of the rest.
pub(super) fn split(message: &Bytes) -> Result<(GoalId, Bytes), Malformed> {
    let mut reader = CdrReader::new(message)?;
    let id = read_id(&mut reader)?;
    let (header, rest) = message
        .split_first_chunk::<ENCAPSULATION>()
        .ok_or(Malformed)?;
    let (_, body) = rest.split_first_chunk::<ID>().ok_or(Malformed)?;
    let mut bytes = BytesMut::with_capacity(ENCAPSULATION + body.len());
    bytes.extend_from_slice(header);
    bytes.extend_from_slice(body);
    Ok((id, bytes.freeze()))
}

/// Joins an id and a body; the inverse of [`split`]. Returns `None` if the body is not
/// little-endian CDR.
pub(super) fn join(id: GoalId, body: &[u8]) -> Option<Bytes> {
    let body = little_endian(body)?;
    let mut bytes = BytesMut::with_capacity(ENCAPSULATION + ID + body.len());
    bytes.extend_from_slice(&LITTLE_ENDIAN);
    bytes.extend_from_slice(&id.to_bytes());
    bytes.extend_from_slice(body);
    Some(bytes.freeze())
}

/// Encodes `X_SendGoal_Response`.
pub(super) fn goal_answer(accepted: bool, stamp: Ros2Time) -> Bytes {
    let mut writer = CdrWriter::new();
    writer.bool(accepted);
    write_stamp(&mut writer, stamp);
    writer.finish()
}

/// Decodes `X_SendGoal_Response`: the time of acceptance, or `None` if the goal was rejected.
pub(super) fn read_goal_answer(message: &[u8]) -> Result<Option<Ros2Time>, Malformed> {
    let mut reader = CdrReader::new(message)?;
    let accepted = reader.bool()?;
    let stamp = read_stamp(&mut reader)?;
    Ok(accepted.then_some(stamp))
}

/// Encodes `X_GetResult_Request`.
pub(super) fn result_request(id: GoalId) -> Bytes {
    let mut writer = CdrWriter::new();
    write_id(&mut writer, id);
    writer.finish()
}

/// Decodes `X_GetResult_Request`.
pub(super) fn read_result_request(message: &[u8]) -> Result<GoalId, Malformed> {
    read_id(&mut CdrReader::new(message)?)
}

/// Replaces the status in `X_GetResult_Response`. Returns `None` if the message is not
/// little-endian CDR.
pub(super) fn with_status(result: &[u8], status: GoalStatusCode) -> Option<Bytes> {
    let (_, fields) = little_endian(result)?.split_first()?;
    let mut bytes = BytesMut::with_capacity(result.len());
    bytes.extend_from_slice(&LITTLE_ENDIAN);
    bytes.extend_from_slice(&status.code().to_le_bytes());
    bytes.extend_from_slice(fields);
    Some(bytes.freeze())
}

/// Decodes the status in `X_GetResult_Response`, which has to be terminal or unknown.
pub(super) fn result_status(message: &[u8]) -> Result<GoalStatusCode, Malformed> {
    let status = read_code(&mut CdrReader::new(message)?)?;
    GoalStatusCode::from_code(status)
        .filter(|status| status.is_terminal() || *status == GoalStatusCode::Unknown)
        .ok_or(Malformed)
}

/// Encodes the request of `action_msgs/CancelGoal`.
pub(super) fn cancel_request(what: CancelWhat) -> Bytes {
    let (id, stamp) = match what {
        CancelWhat::All => (NO_ID, Ros2Time::default()),
        CancelWhat::Goal(id) => (id, Ros2Time::default()),
        CancelWhat::Until(stamp) => (NO_ID, stamp),
        CancelWhat::GoalAndUntil(id, stamp) => (id, stamp),
    };
    let mut writer = CdrWriter::new();
    write_info(&mut writer, &GoalInfo { id, stamp });
    writer.finish()
}

/// Decodes the request of `action_msgs/CancelGoal`.
pub(super) fn read_cancel_request(message: &[u8]) -> Result<CancelWhat, Malformed> {
    let GoalInfo { id, stamp } = read_info(&mut CdrReader::new(message)?)?;
    Ok(match (id == NO_ID, stamp == Ros2Time::default()) {
        (true, true) => CancelWhat::All,
        (true, false) => CancelWhat::Until(stamp),
        (false, true) => CancelWhat::Goal(id),
        (false, false) => CancelWhat::GoalAndUntil(id, stamp),
    })
}

/// Encodes the response of `action_msgs/CancelGoal`.
pub(super) fn cancel_answer(answer: &CancelAnswer) -> Bytes {
    let mut writer = CdrWriter::new();
    write_code(&mut writer, answer.code.code());
    writer.sequence(&answer.goals, write_info);
    writer.finish()
}

/// Decodes the response of `action_msgs/CancelGoal`.
pub(super) fn read_cancel_answer(message: &[u8]) -> Result<CancelAnswer, Malformed> {
    let mut reader = CdrReader::new(message)?;
    Ok(CancelAnswer {
        code: CancelCode::from_code(read_code(&mut reader)?).ok_or(Malformed)?,
        goals: reader.sequence(read_info)?,
    })
}

/// Encodes `action_msgs/GoalStatusArray`.
pub(super) fn status_array(goals: &[(GoalInfo, GoalStatusCode)]) -> Bytes {
    let mut writer = CdrWriter::new();
    writer.sequence(goals, |writer, (info, status)| {
        write_info(writer, info);
        write_code(writer, status.code());
    });
    writer.finish()
}

/// Decodes `action_msgs/GoalStatusArray` and drops goals with an unknown status code.
pub(super) fn read_status_array(
    message: &[u8],
) -> Result<Vec<(GoalInfo, GoalStatusCode)>, Malformed> {
    let goals = CdrReader::new(message)?.sequence(|reader| {
        let info = read_info(reader)?;
        Ok((info, GoalStatusCode::from_code(read_code(reader)?)))
    })?;
    let known = |(info, status): (GoalInfo, Option<GoalStatusCode>)| Some((info, status?));
    Ok(goals.into_iter().filter_map(known).collect())
}

fn little_endian(payload: &[u8]) -> Option<&[u8]> {
    match payload.split_first_chunk::<ENCAPSULATION>()? {
        ([0, 1, ..], body) => Some(body),
        _ => None,
    }
}

fn read_id(reader: &mut CdrReader<'_>) -> Result<GoalId, Malformed> {
    let mut bytes = [0; ID];
    for byte in &mut bytes {
        *byte = reader.u8()?;
    }
    Ok(GoalId::from_bytes(bytes))
}

fn write_id(writer: &mut CdrWriter, id: GoalId) {
    for byte in id.to_bytes() {
        writer.u8(byte);
    }
}

fn read_stamp(reader: &mut CdrReader<'_>) -> Result<Ros2Time, Malformed> {
    Ok(Ros2Time {
        sec: reader.i32()?,
        nanosec: reader.u32()?,
    })
}

fn write_stamp(writer: &mut CdrWriter, stamp: Ros2Time) {
    writer.i32(stamp.sec);
    writer.u32(stamp.nanosec);
}

fn read_info(reader: &mut CdrReader<'_>) -> Result<GoalInfo, Malformed> {
    Ok(GoalInfo {
        id: read_id(reader)?,
        stamp: read_stamp(reader)?,
    })
}

fn write_info(writer: &mut CdrWriter, info: &GoalInfo) {
    write_id(writer, info.id);
    write_stamp(writer, info.stamp);
}

fn read_code(reader: &mut CdrReader<'_>) -> Result<i8, Malformed> {
    reader.u8().map(|byte| i8::from_le_bytes([byte]))
}

fn write_code(writer: &mut CdrWriter, code: i8) {
    let [byte] = code.to_le_bytes();
    writer.u8(byte);
}

const ENCAPSULATION: usize = 4;
const LITTLE_ENDIAN: [u8; ENCAPSULATION] = [0, 1, 0, 0];
const ID: usize = 16;
/// The id that selects any goal.
const NO_ID: GoalId = GoalId::from_bytes([0; ID]);

#[cfg(test)]
mod tests {
    use super::*;

    const SEVEN: GoalId = GoalId::from_bytes([7; 16]);

    fn stamp(sec: i32) -> Ros2Time {
        Ros2Time { sec, nanosec: 5 }
    }

    #[test]
    fn an_id_stands_before_goals_and_feedback() {
        let message = join(SEVEN, &[0, 1, 0, 0, 3, 0, 0, 0]).unwrap();
        assert_eq!(
            message.as_ref(),
            [&[0, 1, 0, 0][..], &[7; 16], &[3, 0, 0, 0]].concat()
        );
        let (id, body) = split(&message).unwrap();
        assert_eq!((id, body.as_ref()), (SEVEN, &[0, 1, 0, 0, 3, 0, 0, 0][..]));
        // From a client that writes big endian, as the header states.
        let big = Bytes::from([&[0, 0, 0, 0][..], &[7; 16], &[0, 0, 0, 3]].concat());
        let (id, body) = split(&big).unwrap();
        assert_eq!((id, body.as_ref()), (SEVEN, &[0, 0, 0, 0, 0, 0, 0, 3][..]));
    }

    #[test]
    fn what_is_cut_short_or_no_cdr_is_refused() {
        let message = Bytes::from([&[0, 1, 0, 0][..], &[7; 15]].concat());
        assert_eq!(split(&message), Err(Malformed));
        assert_eq!(read_result_request(&message), Err(Malformed));
        assert_eq!(read_cancel_request(&message), Err(Malformed));
        assert_eq!(read_goal_answer(&[0, 1, 0, 0, 1]), Err(Malformed));
        assert_eq!(result_status(&[0, 1, 0, 0]), Err(Malformed));
        assert_eq!(result_status(&[0, 9, 0, 0, 4]), Err(Malformed));
        assert_eq!(join(SEVEN, &[0, 0, 0, 0, 1]), None);
        assert_eq!(with_status(&[0, 1, 0, 0], GoalStatusCode::Unknown), None);
    }

    #[test]
    fn a_result_is_of_a_goal_that_has_ended_or_is_unknown() {
        let result = with_status(&[0, 1, 0, 0, 0, 9, 9], GoalStatusCode::Aborted).unwrap();
        assert_eq!(result.as_ref(), [0, 1, 0, 0, 6, 9, 9]);
        assert_eq!(result_status(&result), Ok(GoalStatusCode::Aborted));
        assert_eq!(result_status(&[0, 1, 0, 0, 0]), Ok(GoalStatusCode::Unknown));
        assert_eq!(result_status(&[0, 1, 0, 0, 2]), Err(Malformed));
        assert_eq!(result_status(&[0, 1, 0, 0, 7]), Err(Malformed));
    }

    #[test]
    fn an_answer_to_a_goal_tells_when_it_was_accepted() {
        let accepted = goal_answer(true, stamp(3));
        assert_eq!(
            accepted.as_ref(),
            [0, 1, 0, 0, 1, 0, 0, 0, 3, 0, 0, 0, 5, 0, 0, 0]
        );
        assert_eq!(read_goal_answer(&accepted), Ok(Some(stamp(3))));
        assert_eq!(read_goal_answer(&goal_answer(false, stamp(3))), Ok(None));
    }

    #[test]
    fn each_way_to_say_what_to_cancel_is_read_again() {
        for what in [
            CancelWhat::All,
            CancelWhat::Goal(SEVEN),
            CancelWhat::Until(stamp(1)),
            CancelWhat::GoalAndUntil(SEVEN, stamp(1)),
        ] {
            let request = cancel_request(what);
            assert_eq!(request.len(), 4 + 16 + 8);
            assert_eq!(read_cancel_request(&request), Ok(what));
        }
        let answer = CancelAnswer {
            code: CancelCode::None,
            goals: vec![GoalInfo {
                id: SEVEN,
                stamp: stamp(1),
            }],
        };
        let bytes = cancel_answer(&answer);
        assert_eq!(read_cancel_answer(&bytes), Ok(answer));
        assert_eq!(read_cancel_answer(&bytes[..20]), Err(Malformed));
    }

    #[test]
    fn goals_of_a_status_are_aligned_each() {
        let info = GoalInfo {
            id: SEVEN,
            stamp: stamp(1),
        };
        let bytes = status_array(&[
            (info, GoalStatusCode::Executing),
            (info, GoalStatusCode::Aborted),
        ]);
        // Header, count, the first goal, and the second goal with three bytes of padding before its
        // stamp.
        assert_eq!(bytes.len(), 4 + 4 + 25 + 28);
        assert_eq!(
            read_status_array(&bytes),
            Ok(vec![
                (info, GoalStatusCode::Executing),
                (info, GoalStatusCode::Aborted)
            ])
        );
        assert_eq!(read_status_array(&bytes[..30]), Err(Malformed));
        assert_eq!(
            read_status_array(&[0, 1, 0, 0, 0xff, 0xff, 0xff, 0xff]),
            Err(Malformed)
        );
    }

    proptest::proptest! {
        #[test]
        fn whatever_bytes_come_nothing_panics(bytes in proptest::collection::vec(0u8.., 0..120)) {
            let bytes = Bytes::from([&[0, 1, 0, 0][..], &bytes].concat());
            for cut in [&bytes, &bytes.slice(1..), &bytes.slice(3..)] {
                let read = [
                    split(cut).is_ok(),
                    read_goal_answer(cut).is_ok(),
                    read_result_request(cut).is_ok(),
                    result_status(cut).is_ok(),
                    read_cancel_request(cut).is_ok(),
                    read_cancel_answer(cut).is_ok(),
                    read_status_array(cut).is_ok(),
                ];
                // No message is as short as its header.
                proptest::prop_assert!(cut.len() > 4 || !read.contains(&true));
            }
        }
    }
}
