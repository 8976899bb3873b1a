//! Accepted and dropped messages of a reader, the schedule of a writer, and the states of both.

mod machine;
mod properties;
mod reader;
mod sequence;
mod table;
mod writer;

use std::path::PathBuf;
use std::time::Duration;

use serde_json::Value;
use uadp::{
    Arrival, DataSetHeader, DataSetReaderState, DateTime, GroupHeader, MessageKind, PubSubState,
    ReaderSettings,
};

fn ms(millis: u64) -> Duration {
    Duration::from_millis(millis)
}

fn datagram(name: &str) -> Vec<u8> {
    let path: PathBuf = [env!("CARGO_MANIFEST_DIR"), "tests/vectors", name]
        .iter()
        .collect();
    let hex = std::fs::read_to_string(path.with_extension("hex")).unwrap();
    let digits: Vec<u32> = hex.chars().filter_map(|c| c.to_digit(16)).collect();
    let pairs = digits
        .chunks(2)
        .map(|pair| pair.iter().fold(0, |byte, digit| byte << 4 | digit));
    pairs.map(|byte| u8::try_from(byte).unwrap()).collect()
}

fn description(name: &str) -> Value {
    let path: PathBuf = [env!("CARGO_MANIFEST_DIR"), "tests/vectors", name]
        .iter()
        .collect();
    serde_json::from_str(&std::fs::read_to_string(path.with_extension("json")).unwrap()).unwrap()
}

const TIMEOUT: Duration = Duration::from_secs(1);

fn settings() -> ReaderSettings {
    ReaderSettings {
        message_receive_timeout: TIMEOUT,
        ..ReaderSettings::default()
    }
}

/// Returns a reader that is enabled at time 0, below a group that is Operational.
fn start_reader(settings: ReaderSettings) -> DataSetReaderState {
    let mut reader = DataSetReaderState::new(settings, PubSubState::Operational);
    assert_eq!(reader.enable(ms(0)), Ok(PubSubState::PreOperational));
    reader
}

fn message(kind: MessageKind, number: u16) -> Arrival {
    Arrival {
        header: DataSetHeader {
            sequence_number: Some(number),
            ..DataSetHeader::default()
        },
        ..Arrival::of_kind(kind)
    }
}

fn stamped(kind: MessageKind, number: u16, ticks: i64) -> Arrival {
    Arrival {
        timestamp: Some(DateTime(ticks).into()),
        ..message(kind, number)
    }
}

/// Returns a key frame with a group header, and without header fields of its own.
fn in_group(number: u16, position: usize) -> Arrival {
    Arrival {
        group: GroupHeader {
            sequence_number: Some(number),
            ..GroupHeader::default()
        },
        position,
        ..Arrival::of_kind(MessageKind::KeyFrame)
    }
}

fn versioned(kind: MessageKind, number: u16, major: u32, minor: u32) -> Arrival {
    let mut arrival = message(kind, number);
    arrival.header.major_version = Some(major);
    arrival.header.minor_version = Some(minor);
    arrival
}
