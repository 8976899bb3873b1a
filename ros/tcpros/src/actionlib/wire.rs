//! The messages of the five topics. Little endian; a string is its length as UInt32 and its bytes.
//!
//! - goal: Header, GoalID, body
//! - cancel: GoalID
//! - status: Header, count as UInt32, that many GoalStatus
//! - feedback and result: Header, GoalStatus, body
//!
//! Header is seq, stamp (seconds, nanoseconds) and frame id; GoalID is stamp and id; GoalStatus is
//! GoalID, a code byte and a text. Reading checks every length and never panics; a body is a slice
//! of the message.

use bytes::Bytes;
use thiserror::Error;

use super::{ActionlibGoalId, GoalStatus};
use crate::time::Ros1Time;

/// Error for a message of an action that cannot be decoded: the message ends within the named
/// field, or the field is not UTF-8.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Error)]
#[error("the {0} of the message is truncated or not a text")]
pub(super) struct MalformedAction(&'static str);

/// A received GoalStatus with an unchecked code.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct StatusEntry {
    pub(super) id: String,
    pub(super) code: u8,
    pub(super) text: String,
}

/// Reads a goal. The id must be UTF-8, because the server sends it back unchanged.
pub(super) fn read_goal(message: &Bytes) -> Result<(ActionlibGoalId, Bytes), MalformedAction> {
    let mut reader = Reader(message);
    reader.header()?;
    let id = reader.goal_id()?;
    Ok((id, rest(message, &reader)))
}

/// Reads a cancel request. The id must be UTF-8, as in the goal that it names.
pub(super) fn read_cancel(message: &[u8]) -> Result<ActionlibGoalId, MalformedAction> {
    Reader(message).goal_id()
}

/// Reads a status array. Ids of other clients need not be UTF-8.
pub(super) fn read_status_array(message: &[u8]) -> Result<Vec<StatusEntry>, MalformedAction> {
    let mut reader = Reader(message);
    reader.header()?;
    let count = reader.u32("status count")?;
    // No memory is reserved for a count that may exceed the message.
    (0..count).map(|_| reader.status()).collect()
}

/// Reads feedback or a result.
pub(super) fn read_reply(message: &Bytes) -> Result<(StatusEntry, Bytes), MalformedAction> {
    let mut reader = Reader(message);
    reader.header()?;
    let status = reader.status()?;
    Ok((status, rest(message, &reader)))
}

/// Writes a goal.
pub(super) fn goal(seq: u32, stamp: Ros1Time, id: &ActionlibGoalId, body: &[u8]) -> Bytes {
    let mut out = header(seq, stamp);
    put_goal_id(&mut out, id);
    out.extend_from_slice(body);
    out.into()
}

/// Writes a cancel request.
pub(super) fn cancel(id: &ActionlibGoalId) -> Bytes {
    let mut out = Vec::new();
    put_goal_id(&mut out, id);
    out.into()
}

/// Writes a status array.
pub(super) fn status_array<'a>(
    seq: u32,
    stamp: Ros1Time,
    list: impl Iterator<Item = &'a GoalStatus>,
) -> Bytes {
    let mut out = header(seq, stamp);
    let at = out.len();
    out.extend_from_slice(&[0; 4]);
    let mut count = 0u32;
    for status in list {
        put_status(&mut out, status);
        count += 1;
    }
    if let Some(place) = out.get_mut(at..at + 4) {
        place.copy_from_slice(&count.to_le_bytes());
    }
    out.into()
}

/// Writes feedback or a result.
pub(super) fn reply(seq: u32, stamp: Ros1Time, status: &GoalStatus, body: &[u8]) -> Bytes {
    let mut out = header(seq, stamp);
    put_status(&mut out, status);
    out.extend_from_slice(body);
    out.into()
}

fn rest(message: &Bytes, reader: &Reader<'_>) -> Bytes {
    message.slice_ref(reader.0)
}

fn header(seq: u32, stamp: Ros1Time) -> Vec<u8> {
    let mut out = Vec::with_capacity(128);
    out.extend_from_slice(&seq.to_le_bytes());
    put_time(&mut out, stamp);
    put_string(&mut out, "");
    out
}

fn put_time(out: &mut Vec<u8>, time: Ros1Time) {
    out.extend_from_slice(&time.secs.to_le_bytes());
    out.extend_from_slice(&time.nsecs.to_le_bytes());
}

fn put_string(out: &mut Vec<u8>, text: &str) {
    // A text that is too long for the wire can only come from this process; it is sent as an empty
    // text.
    let (len, text) = u32::try_from(text.len()).map_or((0, ""), |len| (len, text));
    out.extend_from_slice(&len.to_le_bytes());
    out.extend_from_slice(text.as_bytes());
}

fn put_goal_id(out: &mut Vec<u8>, id: &ActionlibGoalId) {
    put_time(out, id.stamp);
    put_string(out, &id.id);
}

fn put_status(out: &mut Vec<u8>, status: &GoalStatus) {
    put_goal_id(out, &status.goal_id);
    out.push(status.status.code());
    put_string(out, &status.text);
}

/// The rest of a message.
struct Reader<'a>(&'a [u8]);

impl<'a> Reader<'a> {
    fn u8(&mut self, field: &'static str) -> Result<u8, MalformedAction> {
        let (first, rest) = self.0.split_first().ok_or(MalformedAction(field))?;
        self.0 = rest;
        Ok(*first)
    }

    fn u32(&mut self, field: &'static str) -> Result<u32, MalformedAction> {
        let (first, rest) = self.0.split_first_chunk().ok_or(MalformedAction(field))?;
        self.0 = rest;
        Ok(u32::from_le_bytes(*first))
    }

    fn time(&mut self, field: &'static str) -> Result<Ros1Time, MalformedAction> {
        let time = Ros1Time {
            secs: self.u32(field)?,
            nsecs: self.u32(field)?,
        };
        if time.nsecs < 1_000_000_000 {
            Ok(time)
        } else {
            Err(MalformedAction(field))
        }
    }

    fn string(&mut self, field: &'static str) -> Result<&'a [u8], MalformedAction> {
        let len = usize::try_from(self.u32(field)?).map_err(|_| MalformedAction(field))?;
        let (text, rest) = self.0.split_at_checked(len).ok_or(MalformedAction(field))?;
        self.0 = rest;
        Ok(text)
    }

    fn header(&mut self) -> Result<(), MalformedAction> {
        self.u32("header")?;
        self.time("header")?;
        self.string("header").map(drop)
    }

    fn goal_id(&mut self) -> Result<ActionlibGoalId, MalformedAction> {
        let stamp = self.time("goal id")?;
        let id =
            std::str::from_utf8(self.string("goal id")?).map_err(|_| MalformedAction("goal id"))?;
        Ok(ActionlibGoalId {
            stamp,
            id: id.to_owned(),
        })
    }

    fn status(&mut self) -> Result<StatusEntry, MalformedAction> {
        self.time("goal id")?;
        let text = |bytes| String::from_utf8_lossy(bytes).into_owned();
        Ok(StatusEntry {
            id: text(self.string("goal id")?),
            code: self.u8("status")?,
            text: text(self.string("status text")?),
        })
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::super::ActionlibStatus;
    use super::*;

    fn id(secs: u32, text: &str) -> ActionlibGoalId {
        ActionlibGoalId {
            stamp: Ros1Time { secs, nsecs: 7 },
            id: text.to_owned(),
        }
    }

    #[test]
    fn a_goal_of_genpy_reads_to_its_id_and_body() {
        // actionlib/TestActionGoal with seq 3, stamp 10.5, frame "map", id "/a-1-10.5" at 10.5 and
        // goal 42, from genpy.
        let wire = b"\x03\0\0\0\x0a\0\0\0\x00\x65\xcd\x1d\x03\0\0\0map\x0a\0\0\0\x00\x65\xcd\x1d\
            \x09\0\0\0/a-1-10.5\x2a\0\0\0";
        let (id, body) = read_goal(&Bytes::from_static(wire)).unwrap();
        assert_eq!(id.id, "/a-1-10.5");
        assert_eq!((id.stamp.secs, id.stamp.nsecs), (10, 500_000_000));
        assert_eq!(body, [42, 0, 0, 0].as_slice());
    }

    #[test]
    fn an_id_that_is_not_utf8_is_refused_by_a_server_and_passed_over_by_a_client() {
        let cancel = b"\0\0\0\0\0\0\0\0\x01\0\0\0\xff";
        assert_eq!(read_cancel(cancel), Err(MalformedAction("goal id")));
        let mut array = header(1, Ros1Time::default());
        array.extend_from_slice(b"\x01\0\0\0\0\0\0\0\0\0\0\0\x01\0\0\0\xff\x01\0\0\0\0");
        assert_eq!(read_status_array(&array).unwrap()[0].id, "\u{fffd}");
    }

    #[test]
    fn a_stamp_of_a_second_or_more_of_nanoseconds_is_malformed() {
        let cancel = |nsecs: u32| {
            let mut wire = vec![0; 4];
            wire.extend_from_slice(&nsecs.to_le_bytes());
            wire.extend_from_slice(&[0; 4]);
            wire
        };
        let last = read_cancel(&cancel(999_999_999)).unwrap();
        assert_eq!(last.stamp.nsecs, 999_999_999);
        assert_eq!(
            read_cancel(&cancel(1_000_000_000)),
            Err(MalformedAction("goal id"))
        );
    }

    #[test]
    fn a_count_beyond_the_message_is_malformed_and_reserves_nothing() {
        let mut array = header(1, Ros1Time::default());
        array.extend_from_slice(&u32::MAX.to_le_bytes());
        assert_eq!(read_status_array(&array), Err(MalformedAction("goal id")));
    }

    proptest! {
        #[test]
        fn random_bytes_never_panic(bytes in prop::collection::vec(any::<u8>(), 0..120)) {
            let message = Bytes::from(bytes);
            if let Ok((_, body)) = read_goal(&message) {
                prop_assert!(body.len() + 28 <= message.len());
            }
            if let Ok((_, body)) = read_reply(&message) {
                prop_assert!(body.len() + 33 <= message.len());
            }
            if let Ok(list) = read_status_array(&message) {
                prop_assert!(list.len() * 17 + 20 <= message.len());
            }
            prop_assert!(read_cancel(&message).is_err() || message.len() >= 12);
        }

        #[test]
        fn what_is_written_reads_back_and_any_cut_of_it_is_an_error(
            (secs, text, body) in (any::<u32>(), ".{0,12}", prop::collection::vec(any::<u8>(), 0..20)),
            (code, said) in (0u8..10, ".{0,12}"),
            cut in 1usize..200,
        ) {
            let now = Ros1Time { secs: 5, nsecs: 6 };
            let goal_id = id(secs, &text);
            let sent = goal(1, now, &goal_id, &body);
            prop_assert_eq!(read_goal(&sent).unwrap(), (goal_id.clone(), body.clone().into()));
            prop_assert_eq!(&read_cancel(&cancel(&goal_id)).unwrap(), &goal_id);
            let status = GoalStatus { goal_id, status: ActionlibStatus::from_code(code).unwrap(), text: said.clone() };
            let entry = StatusEntry { id: text, code, text: said };
            let sent = reply(2, now, &status, &body);
            prop_assert_eq!(read_reply(&sent).unwrap(), (entry.clone(), body.into()));
            let sent = status_array(3, now, [&status, &status].into_iter());
            prop_assert_eq!(read_status_array(&sent).unwrap(), vec![entry.clone(), entry]);
            let cut = sent.len() - cut.min(sent.len());
            prop_assert!(read_status_array(&sent[..cut]).is_err());
        }
    }
}
