//! Measures the conversion of ROS messages to UADP fields and back. Without arguments it prints
//! wall time, with `count CASE N` it only does the work for an instruction counter, and with `dump`
//! it prints the messages in hexadecimal for other serializers.

mod payload;
mod tree;

use std::hint::black_box;
use std::process::ExitCode;
use std::time::{Duration, Instant};

use bridge_core::{decode_fields, encode_fields};
use messages::{Dialect, MessagePlan};
use payload::BenchPayload;
use tree::MessageTree;
use uadp::{
    DataSetHeader, Fields, GroupHeader, NetworkHeader, NetworkMessage, NetworkMessageEncoder,
    PublisherId,
};

/// Number of rounds, of which the fastest counts: slower rounds were disturbed.
const ROUNDS: u32 = 15;
/// Duration of a round of a case.
const ROUND: Duration = Duration::from_millis(8);

/// A measured case, with a name for tables and the command line.
struct Case {
    name: String,
    /// Whether the case is measured by an instruction counter.
    counted: bool,
    work: Box<dyn FnMut(u32)>,
}

fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let arguments: Vec<&str> = arguments.iter().map(String::as_str).collect();
    match arguments[..] {
        [] => {
            wall(&mut cases());
            ExitCode::SUCCESS
        }
        ["list"] => {
            for case in cases().iter().filter(|case| case.counted) {
                println!("{}", case.name);
            }
            ExitCode::SUCCESS
        }
        ["dump"] => {
            dump();
            ExitCode::SUCCESS
        }
        ["count", name, messages] => {
            let mut cases = cases();
            let case = cases.iter_mut().find(|case| case.name == name);
            match (case, messages.parse()) {
                (Some(case), Ok(messages)) => {
                    (case.work)(messages);
                    ExitCode::SUCCESS
                }
                _ => usage(),
            }
        }
        _ => usage(),
    }
}

fn usage() -> ExitCode {
    eprintln!("usage: messages-bench [list | dump | count CASE MESSAGES]");
    ExitCode::from(64)
}

const WIRES: [(Dialect, &str); 2] = [(Dialect::Ros1, "ROS 1"), (Dialect::Ros2, "CDR")];

/// Prints type, wire, name and bytes of each payload.
fn dump() {
    for payload in payload::ALL {
        for (dialect, wire) in WIRES {
            let (_, message) = payload.make(dialect);
            let hex: String = message.iter().map(|byte| format!("{byte:02x}")).collect();
            println!("{}\t{wire}\t{}\t{hex}", payload.type_name(), payload.name);
        }
    }
}

fn cases() -> Vec<Case> {
    let mut cases = Vec::new();
    for payload in payload::ALL {
        for (dialect, wire) in WIRES {
            there(&mut cases, payload, dialect, wire);
            back(&mut cases, payload, dialect, wire);
        }
    }
    cases
}

/// Adds the cases from ROS bytes to a NetworkMessage.
fn there(cases: &mut Vec<Case>, payload: BenchPayload, dialect: Dialect, wire: &str) {
    let (plan, message) = payload.make(dialect);
    let mut datagram = Vec::new();
    let (bytes, by) = (message.clone(), plan.clone());
    let mut push = |what: &str, counted, work: Box<dyn FnMut(u32)>| {
        cases.push(Case {
            name: format!("{} {wire} > UADP{what}", payload.name),
            counted,
            work,
        });
    };
    push(
        "",
        !payload.large,
        Box::new(move |messages| {
            for _ in 0..messages {
                datagram.clear();
                encode(&by, black_box(&bytes), &mut datagram);
                black_box(&datagram);
            }
        }),
    );
    let (bytes, mut datagram) = (message.clone(), Vec::new());
    push(
        ", memcpy",
        false,
        Box::new(move |messages| copy(&bytes, &mut datagram, messages)),
    );
    // A tree of structures in arrays needs the schema for the way back, which this benchmark lacks.
    if payload.large {
        return;
    }
    let mut datagram = Vec::new();
    push(
        ", tree",
        false,
        Box::new(move |messages| {
            for _ in 0..messages {
                datagram.clear();
                let tree = MessageTree::read(&plan, black_box(&message));
                into_datagram(&mut datagram, |frame| tree.encode(frame));
                black_box(&datagram);
            }
        }),
    );
}

/// Adds the cases from the fields of a DataSetMessage to ROS bytes.
fn back(cases: &mut Vec<Case>, payload: BenchPayload, dialect: Dialect, wire: &str) {
    let (plan, message) = payload.make(dialect);
    let mut datagram = Vec::new();
    encode(&plan, &message, &mut datagram);
    let mut returned = Vec::new();
    decode_fields(&plan, fields(&datagram), &mut returned).unwrap();
    assert_eq!(returned, message, "{} {wire}", payload.name);
    let mut push = |what: &str, counted, work: Box<dyn FnMut(u32)>| {
        cases.push(Case {
            name: format!("{} UADP > {wire}{what}", payload.name),
            counted,
            work,
        });
    };
    let (bytes, by, mut out) = (datagram.clone(), plan.clone(), Vec::new());
    push(
        "",
        !payload.large,
        Box::new(move |messages| {
            for _ in 0..messages {
                out.clear();
                decode_fields(&by, fields(black_box(&bytes)), &mut out).unwrap();
                black_box(&out);
            }
        }),
    );
    let mut out = Vec::new();
    push(
        ", memcpy",
        false,
        Box::new(move |messages| copy(&message, &mut out, messages)),
    );
    if payload.large {
        return;
    }
    let mut out = Vec::new();
    push(
        ", tree",
        false,
        Box::new(move |messages| {
            for _ in 0..messages {
                out.clear();
                MessageTree::decode(fields(black_box(&datagram))).write(&plan, &mut out);
                black_box(&out);
            }
        }),
    );
}

fn copy(from: &[u8], to: &mut Vec<u8>, messages: u32) {
    for _ in 0..messages {
        to.clear();
        to.extend_from_slice(black_box(from));
        black_box(&to);
    }
}

fn encode(plan: &MessagePlan, message: &[u8], datagram: &mut Vec<u8>) {
    into_datagram(datagram, |frame| {
        encode_fields(plan, message, 5, frame).unwrap();
    });
}

/// Encodes a NetworkMessage with the headers of the bridges.
fn into_datagram(datagram: &mut Vec<u8>, fill: impl FnOnce(&mut uadp::FieldEncoder<'_>)) {
    let time = uadp::DateTime(134_234_948_967_890_123);
    let network = black_box(NetworkHeader {
        publisher_id: Some(PublisherId::UInt16(2)),
        group: Some(GroupHeader {
            writer_group_id: Some(5),
            ..GroupHeader::default()
        }),
        timestamp: Some(time),
        picoseconds: Some(0),
        ..NetworkHeader::default()
    });
    let header = black_box(DataSetHeader {
        sequence_number: Some(7),
        timestamp: Some(time),
        picoseconds: Some(0),
        status: Some(0),
        ..DataSetHeader::default()
    });
    let mut message = NetworkMessageEncoder::new(datagram, &network, Some(&[10])).unwrap();
    let mut frame = message.key_frame(&header).unwrap();
    fill(&mut frame);
    frame.finish().unwrap();
    message.finish().unwrap();
}

fn fields(datagram: &[u8]) -> Fields<'_> {
    let network = NetworkMessage::decode(datagram).unwrap();
    let message = network.messages().next().unwrap().unwrap();
    message.fields().unwrap()
}

/// Measures the cases in turn, so that all cases have the same conditions.
fn wall(cases: &mut [Case]) {
    let counts: Vec<u32> = cases.iter_mut().map(count).collect();
    let mut best = vec![Duration::MAX; cases.len()];
    for _ in 0..ROUNDS {
        for ((case, best), count) in cases.iter_mut().zip(&mut best).zip(&counts) {
            let start = Instant::now();
            (case.work)(*count);
            *best = start.elapsed().min(*best);
        }
    }
    for ((case, best), count) in cases.iter().zip(best).zip(counts) {
        let nanos = best.as_secs_f64() * 1e9 / f64::from(count);
        println!("{:<44} {nanos:10.1} ns", case.name);
    }
}

/// Returns the number of messages that fill a round.
fn count(case: &mut Case) -> u32 {
    let mut count = 1;
    loop {
        let start = Instant::now();
        (case.work)(count);
        if start.elapsed() * 2 > ROUND {
            return count;
        }
        count *= 2;
    }
}
