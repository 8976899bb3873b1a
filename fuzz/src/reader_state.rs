//! Fuzzes a DataSetReader with arbitrary messages.

use std::time::Duration;

use uadp::{
    Arrival, ConfigurationVersion, DataSetHeader, DataSetReaderState, DateTime, MessageKind,
    PubSubState, ReaderSettings, Timestamp,
};

use crate::input::Input;

/// Runs operations, each a byte: receive, let time pass, enable, disable, change the parent state,
/// change the metadata.
///
/// A message is not accepted twice in a row, no message is accepted in a state without reception,
/// every message is counted, and the next timeout is not in the past.
pub fn reader_state(data: &[u8]) {
    let mut input = Input::new(data);
    let settings = ReaderSettings {
        message_receive_timeout: Duration::from_millis(input.byte().into()),
        accept_late: input.byte() & 1 == 1,
        ..ReaderSettings::default()
    };
    let mut reader = DataSetReaderState::new(settings, PubSubState::Operational);
    let mut now = Duration::ZERO;
    let mut received = 0;
    let mut last = None;
    while !input.is_empty() {
        let operation = input.byte() % 6;
        match operation {
            0 => {
                let arrival = arrival(&mut input);
                received += 1;
                let active = matches!(
                    reader.state(),
                    PubSubState::Operational | PubSubState::PreOperational | PubSubState::Error
                );
                let taken = reader.receive(&arrival, now);
                assert!(active || taken.is_err(), "taken in {:?}", reader.state());
                let number = arrival.header.sequence_number;
                let plain = arrival.timestamp.is_none() && arrival.kind != MessageKind::KeepAlive;
                if taken.is_ok() && plain && number.is_some() {
                    assert_ne!(last, number, "one message was taken twice");
                    last = number;
                } else if taken.is_ok() || number.is_none() {
                    // Messages that count with other numbers reset the sequence.
                    last = None;
                }
            }
            1 => now += Duration::from_millis(input.byte().into()),
            2 => drop(reader.enable(now)),
            3 => drop(reader.disable()),
            4 => drop(reader.set_parent(state(input.byte()), now)),
            _ => reader.set_metadata(version(&mut input)),
        }
        if operation != 0 {
            last = None;
        }
        reader.handle_timeout(now);
        assert!(reader.poll_timeout().is_none_or(|at| at > now));
        let counters = reader.counters();
        let counted = [
            counters.accepted,
            counters.inactive,
            counters.invalid,
            counters.other_layout,
            counters.duplicates,
            counters.stale,
            counters.out_of_window,
            counters.major_version,
            counters.needs_key_frame,
        ];
        assert_eq!(counted.iter().sum::<u64>(), received, "{counters:?}");
    }
}

fn arrival(input: &mut Input<'_>) -> Arrival {
    let bits = input.byte();
    let kind = match bits & 3 {
        0 => MessageKind::KeyFrame,
        1 => MessageKind::DeltaFrame,
        2 => MessageKind::Event,
        _ => MessageKind::KeepAlive,
    };
    let number = match bits & 4 {
        0 => None,
        _ => Some(input.u16()),
    };
    let time = match bits & 8 {
        0 => None,
        _ => Some(DateTime(input.u16().into())),
    };
    let version = match bits & 16 {
        0 => None,
        _ => version(input),
    };
    let header = DataSetHeader {
        valid: bits & 96 != 96,
        sequence_number: number,
        timestamp: time,
        major_version: version.map(|version| version.major),
        minor_version: version.map(|version| version.minor),
        ..DataSetHeader::default()
    };
    let mut arrival = Arrival {
        header,
        timestamp: time.map(Timestamp::from),
        ..Arrival::of_kind(kind)
    };
    if bits & 128 != 0 {
        arrival.group.sequence_number = Some(input.u16());
    }
    arrival
}

fn version(input: &mut Input<'_>) -> Option<ConfigurationVersion> {
    let byte = input.byte();
    (byte & 1 == 1).then(|| ConfigurationVersion {
        major: u32::from(byte >> 1 & 3),
        minor: u32::from(byte >> 3 & 3),
    })
}

const fn state(byte: u8) -> PubSubState {
    match byte % 5 {
        0 => PubSubState::Disabled,
        1 => PubSubState::Paused,
        2 => PubSubState::PreOperational,
        3 => PubSubState::Error,
        _ => PubSubState::Operational,
    }
}
