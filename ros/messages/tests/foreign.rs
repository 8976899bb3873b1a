//! Messages in both directions between this crate and other serializers, live, by means of
//! `data/judge.py`.
//!
//! `UA_JUDGE_MESSAGES` sets the number of messages of each type per direction, `UA_JUDGE_SEED`
//! their seed.
use crate::inventor;
use crate::support;

use std::collections::BTreeMap;
use std::io::{Read as _, Write as _};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};

use inventor::{invent, unnamed};
use messages::{Dialect, MessagePlan, Selection, TypeName, TypeRegistry, Wire};
use proptest::prelude::Rng as _;
use proptest::test_runner::{RngAlgorithm, TestRng};
use serde_json::json;
use support::{EventPlayer, RecordedEvent, RecordedValue, Recorder};

/// Every kind of field: alone, in arrays of each kind, and in messages in arrays. No type of the
/// bundle has all of them.
const ROS1: &str = "bool t\nint8 a\nuint8 b\nint16 c\nuint16 d\nint32 e\nuint32 f\nint64 g\nuint64 h\nfloat32 i\nfloat64 j\n\
    string k\ntime l\nduration m\nchar n\nbyte o\nstd_msgs/Empty p\nstd_msgs/Header q\nbool[] ta\nint8[] aa\nuint8[] ba\n\
    int16[] ca\nuint16[] da\nint32[] ea\nuint32[] fa\nint64[] ga\nuint64[] ha\nfloat32[] ia\nfloat64[] ja\nstring[] ka\n\
    time[] la\nduration[] ma\nstd_msgs/Header[] qa\nbool[3] tf\nint8[3] af\nuint8[5] bf\nint16[3] cf\nuint16[3] df\n\
    int32[3] ef\nuint32[3] ff\nint64[3] gf\nuint64[3] hf\nfloat32[3] if_\nfloat64[3] jf\nstring[2] kf\ntime[2] lf\n\
    duration[2] mf\nstd_msgs/Header[2] qf\ngeometry_msgs/PolygonStamped[] ra\ndiagnostic_msgs/DiagnosticArray[2] rf\n\
    bool last";
const ROS2: &str = "bool t\nint8 a\nuint8 b\nint16 c\nuint16 d\nint32 e\nuint32 f\nint64 g\nuint64 h\nfloat32 i\nfloat64 j\n\
    string k\nbuiltin_interfaces/Time l\nbuiltin_interfaces/Duration m\nchar n\nstd_msgs/Empty p\nstd_msgs/Header q\n\
    bool[] ta\nint8[] aa\nuint8[] ba\nint16[] ca\nuint16[] da\nint32[] ea\nuint32[] fa\nint64[] ga\nuint64[] ha\n\
    float32[] ia\nfloat64[] ja\nstring[] ka\nbuiltin_interfaces/Time[] la\nbuiltin_interfaces/Duration[] ma\n\
    std_msgs/Header[] qa\nstd_msgs/Empty[] pa\nbool[3] tf\nint8[3] af\nuint8[5] bf\nint16[3] cf\nuint16[3] df\nint32[3] ef\n\
    uint32[3] ff\nint64[3] gf\nuint64[3] hf\nfloat32[3] if_\nfloat64[3] jf\nstring[2] kf\nbuiltin_interfaces/Time[2] lf\n\
    std_msgs/Header[2] qf\nstd_msgs/Empty[2] pf\nint8[<=3] ab\nfloat64[<=2] jb\nstring[<=2] kb\nstd_msgs/Header[<=2] qb\n\
    geometry_msgs/PolygonStamped[] ra\ndiagnostic_msgs/DiagnosticArray[2] rf\nbool last";
const WIDE: &str = "int8 a\nwstring w\nint8 b\nwstring[] wa\nfloat64 c\nwstring[2] wf\nbool last";

struct Judge {
    child: Child,
    to: ChildStdin,
    from: ChildStdout,
}

impl Judge {
    /// Starts the judge, or prints the reason for which the test is skipped.
    fn start(library: &str, python: &Path, module: &str) -> Option<Self> {
        let has = Command::new(python)
            .args(["-c", &format!("import {module}")])
            .stderr(Stdio::null())
            .status();
        if !has.is_ok_and(|status| status.success()) {
            let reason = format!("{} has no module {module}", python.display());
            assert!(
                std::env::var_os("CI").is_none(),
                "with CI=true nothing is skipped, and {reason}: `cargo xtask peers` installs it"
            );
            eprintln!("skipped: {reason}");
            return None;
        }
        let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/judge.py");
        let mut child = Command::new(python)
            .arg("-B")
            .args([&script, Path::new(library)])
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let (to, from) = (child.stdin.take().unwrap(), child.stdout.take().unwrap());
        Some(Self { child, to, from })
    }

    fn tell(&mut self, frame: &[u8]) {
        let size = u32::try_from(frame.len()).unwrap();
        self.to.write_all(&size.to_le_bytes()).unwrap();
        self.to.write_all(frame).unwrap();
    }

    fn hear(&mut self) -> Vec<u8> {
        self.to.flush().unwrap();
        let mut size = [0; 4];
        self.from
            .read_exact(&mut size)
            .unwrap_or_else(|error| panic!("the judge said no more: {error}"));
        let mut frame = vec![0; u32::from_le_bytes(size) as usize];
        self.from.read_exact(&mut frame).unwrap();
        frame
    }

    /// Returns messages with their fields.
    fn answers(&mut self) -> Vec<(Vec<u8>, Vec<u8>)> {
        let frame = self.hear();
        let mut rest = &frame[..];
        let mut next = || {
            let (size, after) = rest.split_first_chunk().unwrap();
            let (blob, after) = after.split_at(u32::from_le_bytes(*size) as usize);
            rest = after;
            (blob.to_vec(), rest.is_empty())
        };
        let mut answers = Vec::new();
        let mut over = frame.is_empty();
        while !over {
            let (message, _) = next();
            let (fields, last) = next();
            answers.push((message, fields));
            over = last;
        }
        answers
    }
}

impl Drop for Judge {
    fn drop(&mut self) {
        drop(self.child.kill());
        drop(self.child.wait());
    }
}

/// Packs events in the format of `packed` in `data/fields.py`.
fn packed(events: &[RecordedEvent]) -> Vec<u8> {
    let mut out = Vec::new();
    for event in events {
        let (letter, count): (u8, _) = match event {
            RecordedEvent::Scalar(RecordedValue::Bytes(bytes)) => (b'O', Some(bytes.len())),
            RecordedEvent::Scalar(RecordedValue::Text(text)) => (b'S', Some(text.len())),
            RecordedEvent::Element(RecordedValue::Text(text)) => (b'E', Some(text.len())),
            RecordedEvent::Scalar(_) => (b'S', None),
            RecordedEvent::Element(_) => (b'E', None),
            RecordedEvent::Packed(_, count, _) => (b'P', Some(*count)),
            RecordedEvent::Array(_, count) => (b'A', Some(*count)),
            RecordedEvent::Structures(_, count) => (b'T', Some(*count)),
            RecordedEvent::Begin(_) => (b'B', None),
            RecordedEvent::End => (b'N', None),
        };
        out.push(letter);
        out.extend(count.into_iter().flat_map(|count| {
            let count = u32::try_from(count).unwrap();
            count.to_le_bytes()
        }));
        match event {
            RecordedEvent::Scalar(value) | RecordedEvent::Element(value) => {
                out.extend_from_slice(match value {
                    RecordedValue::Fixed(_, bytes) | RecordedValue::Bytes(bytes) => bytes,
                    RecordedValue::Text(text) => text.as_bytes(),
                })
            }
            RecordedEvent::Packed(_, _, bytes) => out.extend_from_slice(bytes),
            RecordedEvent::Array(..)
            | RecordedEvent::Structures(..)
            | RecordedEvent::Begin(_)
            | RecordedEvent::End => {}
        }
    }
    out
}

fn number(variable: &str, default: usize) -> usize {
    std::env::var(variable).map_or(default, |text| text.parse().unwrap())
}

/// Pads a message as CDR does; other formats have no padding.
fn padded(mut bytes: Vec<u8>, wire: Wire) -> Vec<u8> {
    if wire == Wire::Cdr {
        bytes.resize(bytes.len().next_multiple_of(4), 0);
    }
    bytes
}

fn read(plan: &MessagePlan, bytes: &[u8], what: &str) -> Vec<RecordedEvent> {
    let mut recorder = Recorder::default();
    plan.read(bytes, &mut recorder)
        .unwrap_or_else(|error| panic!("{what}: {error}: {bytes:02x?}"));
    recorder.events
}

/// Checks messages of the judge: this crate reads the same fields, and writes the same bytes.
fn theirs_to_ours(
    judge: &mut Judge,
    (name, plan, wire): (&TypeName, &MessagePlan, Wire),
    count: usize,
) {
    for (at, (message, fields)) in judge.answers().into_iter().enumerate() {
        let what = format!("{name}, message {at} of {count}");
        let events = read(plan, &message, &what);
        assert!(
            packed(&events) == fields,
            "{what} is read otherwise: {message:02x?}\n{events:?}"
        );
        let mut again = Vec::new();
        plan.write(&mut EventPlayer::new(&events), &mut again)
            .unwrap_or_else(|error| panic!("{what}: {error}"));
        assert!(
            again == padded(message.clone(), wire),
            "{what} is written otherwise: {message:02x?}\n{again:02x?}"
        );
    }
}

/// Checks messages of this crate: the judge reads the same fields, and writes the same bytes.
fn ours_to_theirs(
    judge: &mut Judge,
    (name, plan, wire): (&TypeName, &MessagePlan, Wire),
    (count, rng): (usize, &mut TestRng),
) {
    let mut made = Vec::new();
    let mut frame = Vec::new();
    for _ in 0..count {
        let seed = TestRng::from_seed(RngAlgorithm::ChaCha, &{
            let mut seed = [0; 32];
            rng.fill_bytes(&mut seed);
            seed
        });
        let (events, message) = invent(plan, &seed);
        frame.extend(u32::try_from(message.len()).unwrap().to_le_bytes());
        frame.extend(&message);
        made.push((events, message));
    }
    let question = json!({"read": name.to_string(), "count": count});
    judge.tell(question.to_string().as_bytes());
    judge.tell(&frame);
    let answers = judge.answers();
    assert_eq!(answers.len(), made.len(), "{name}");
    for ((events, message), (again, fields)) in made.into_iter().zip(answers) {
        assert!(
            packed(&unnamed(events)) == fields,
            "{name} is read otherwise by the judge: {message:02x?}"
        );
        assert!(
            padded(again.clone(), wire) == message,
            "{name} is written otherwise by the judge: {message:02x?}\n{again:02x?}"
        );
    }
}

/// Compares every type of the bundle and the test's own types, including the md5s that the judge
/// knows.
fn all_types(judge: &mut Judge, dialect: Dialect, made: &[(&str, &str)], least: usize) {
    let wire = match dialect {
        Dialect::Ros1 => Wire::Ros1,
        Dialect::Ros2 => Wire::Cdr,
    };
    let mut registry = TypeRegistry::bundle(dialect);
    for (name, text) in made {
        registry.add(&name.parse().unwrap(), text).unwrap();
    }
    let types: Vec<_> = registry
        .names()
        .map(|name| registry.get(name).unwrap())
        .collect();
    // For types that the judge cannot know it gets the plain text; genpy also needs the texts of
    // nested types.
    let text =
        |name: &TypeName, whole| match made.iter().find(|(made, _)| name.to_string() == *made) {
            Some((_, text)) if dialect == Dialect::Ros2 => *text,
            Some(_) | None => whole,
        };
    let texts: Vec<(String, &str)> = types
        .iter()
        .map(|each| {
            (
                each.name().to_string(),
                text(each.name(), each.definition()),
            )
        })
        .collect();
    judge.tell(json!(texts).to_string().as_bytes());
    let known: BTreeMap<String, Option<String>> = serde_json::from_slice(&judge.hear()).unwrap();
    let count = number("UA_JUDGE_MESSAGES", 10);
    let seed = number("UA_JUDGE_SEED", 1);
    let mut rng = TestRng::from_seed(
        RngAlgorithm::ChaCha,
        &[u8::try_from(seed % 256).unwrap(); 32],
    );
    let mut judged = 0;
    for message_type in types {
        let name = message_type.name();
        let Some(md5) = known.get(&name.to_string()) else {
            continue;
        };
        if let Some(md5) = md5 {
            assert_eq!(message_type.md5(), md5, "{name}");
        }
        let plan = MessagePlan::compile(&message_type, &Selection::Whole, wire).unwrap();
        for first in (0..count).step_by(BATCH) {
            let some = BATCH.min(count - first);
            let question =
                json!({"make": name.to_string(), "seed": format!("{seed} {first}"), "count": some});
            judge.tell(question.to_string().as_bytes());
            theirs_to_ours(judge, (name, &plan, wire), some);
            ours_to_theirs(judge, (name, &plan, wire), (some, &mut rng));
        }
        judged += 1;
    }
    assert!(judged >= least, "{judged} types were judged");
    eprintln!("{judged} types, {count} messages of each, both ways");
}

/// Number of messages in a frame.
const BATCH: usize = 500;

fn debian() -> PathBuf {
    PathBuf::from("/usr/bin/python3")
}

fn venv() -> PathBuf {
    let here = Path::new(env!("CARGO_MANIFEST_DIR"));
    let own = || here.join("../../target/peers/venv/bin/python");
    std::env::var_os("UA_PEERS_PYTHON").map_or_else(own, PathBuf::from)
}

#[test]
fn genpy_reads_what_is_written_here_and_writes_what_is_read_here() {
    if let Some(mut judge) = Judge::start("genpy", &debian(), "genpy") {
        let made = [("judge_msgs/Everything", ROS1)];
        all_types(&mut judge, Dialect::Ros1, &made, 125);
    }
}

#[test]
fn rosbags_reads_ros_1_as_written_here_and_writes_it_as_read_here() {
    if let Some(mut judge) = Judge::start("rosbags1", &venv(), "rosbags") {
        let made = [("judge_msgs/Everything", ROS1)];
        all_types(&mut judge, Dialect::Ros1, &made, 120);
    }
}

#[test]
fn rosbags_reads_cdr_as_written_here_and_writes_it_as_read_here() {
    if let Some(mut judge) = Judge::start("rosbags2", &venv(), "rosbags") {
        let made = [("judge_msgs/Everything", ROS2)];
        all_types(&mut judge, Dialect::Ros2, &made, 140);
    }
}

#[test]
fn cyclone_dds_reads_what_is_written_here_and_writes_what_is_read_here() {
    if let Some(mut judge) = Judge::start("cyclone", &venv(), "cyclonedds") {
        let made = [("judge_msgs/Everything", ROS2), ("judge_msgs/Wide", WIDE)];
        all_types(&mut judge, Dialect::Ros2, &made, 140);
    }
}
