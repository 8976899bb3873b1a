//! Properties that hold for all sequences of events.

use std::collections::BTreeSet;
use std::time::Duration;

use proptest::collection::vec;
use proptest::prelude::*;
use uadp::MessageKind::{DeltaFrame, Event, KeepAlive, KeyFrame};
use uadp::PubSubState::Operational;
use uadp::{
    Accepted, Arrival, DataSetReaderState, DateTime, MessageKind, PubSubState, ReaderDrop,
    ReaderSettings,
};

use crate::state::machine::STATES;
use crate::state::writer::start_writer;
use crate::state::{TIMEOUT, ms, start_reader, versioned};

/// Events between a publisher and a reader.
#[derive(Debug, Clone)]
enum Step {
    /// The publisher creates a message, which arrives or is lost.
    Send {
        kind: MessageKind,
        arrives: bool,
    },
    /// An earlier message of the present run arrives, repeated or late. `back` counts messages
    /// backwards.
    Again {
        back: usize,
    },
    Wait(u64),
    /// The publisher restarts.
    Restart,
    /// The DataSet of the publisher changes.
    Version(u32),
    Parent(PubSubState),
    Disable,
    Enable,
    Timeout,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Numbered {
    Own,
    Group,
}

/// Sent and received messages, with their invariants.
struct Scene {
    reader: DataSetReaderState,
    numbered: Numbered,
    stamps: bool,
    now: Duration,
    sent: Vec<Arrival>,
    next: u16,
    ticks: i64,
    version: u32,
    /// Timestamps of the accepted messages that the reader must remember. They are unique in this
    /// scene.
    accepted: BTreeSet<i64>,
    /// Time at which the reader last accepted a message, or was reset.
    accepted_at: Duration,
}

impl Scene {
    fn new(numbered: Numbered, stamps: bool, settings: ReaderSettings) -> Self {
        Self {
            reader: start_reader(settings),
            numbered,
            stamps,
            now: ms(0),
            sent: Vec::new(),
            next: 0,
            ticks: 1,
            version: 1,
            accepted: BTreeSet::new(),
            accepted_at: ms(0),
        }
    }

    fn make(&mut self, kind: MessageKind) -> Arrival {
        self.ticks += 1;
        let number = self.next;
        let mut arrival = versioned(kind, number, self.version, self.version);
        arrival.timestamp = Some(DateTime(self.ticks).into());
        if self.numbered == Numbered::Group {
            arrival.header.sequence_number = None;
            arrival.group.sequence_number = Some(number);
        }
        if self.numbered == Numbered::Group || kind != KeepAlive {
            self.next = self.next.wrapping_add(1);
            self.sent.push(arrival);
        }
        arrival
    }

    fn deliver(&mut self, arrival: Arrival) -> Result<Accepted, ReaderDrop> {
        let id = arrival.timestamp.unwrap().time.0;
        let seen = Arrival {
            timestamp: arrival.timestamp.filter(|_| self.stamps),
            ..arrival
        };
        let forgotten = self.now - self.accepted_at >= self.reader.settings().forget_after();
        let verdict = self.reader.receive(&seen, self.now);
        if verdict.is_ok() {
            if forgotten {
                self.accepted.clear();
            }
            self.accepted_at = self.now;
            if arrival.kind != KeepAlive {
                assert!(self.accepted.insert(id), "accepted twice: {arrival:?}");
            }
        }
        verdict
    }

    fn play(&mut self, step: Step) {
        let before = self.reader.state();
        match step {
            Step::Send { kind, arrives } => {
                let arrival = self.make(kind);
                if arrives {
                    // `deliver` checks whether the message may be accepted.
                    self.deliver(arrival).ok();
                }
            }
            Step::Again { back } => {
                let at = self.sent.len().checked_sub(back + 1);
                if let Some(arrival) = at.and_then(|at| self.sent.get(at)) {
                    self.deliver(*arrival).ok();
                }
            }
            Step::Wait(millis) => self.now += ms(millis),
            Step::Restart => {
                self.next = 0;
                self.sent.clear();
            }
            Step::Version(version) => self.version = version,
            Step::Parent(parent) => {
                self.reader.set_parent(parent, self.now);
            }
            Step::Disable => {
                self.reader.disable().ok();
            }
            Step::Enable => {
                self.reader.enable(self.now).ok();
            }
            Step::Timeout => {
                self.reader.handle_timeout(self.now);
                assert!(self.reader.poll_timeout().is_none_or(|at| at > self.now));
            }
        }
        if !before.is_active() && self.reader.state().is_active() {
            self.accepted.clear();
            self.accepted_at = self.now;
        }
    }

    /// The publisher continues with key frames. Returns the time until a key frame is accepted.
    fn recover(&mut self) -> Duration {
        self.reader.enable(self.now).ok();
        self.reader.set_parent(Operational, self.now);
        let since = self.now;
        for _ in 0..1000 {
            let arrival = self.make(KeyFrame);
            if self.deliver(arrival).is_ok() {
                return self.now - since;
            }
            self.now += ms(100);
        }
        panic!("dropped for ever: {:?}", self.reader);
    }
}

fn step() -> impl Strategy<Value = Step> {
    let kind = prop_oneof![
        3 => Just(KeyFrame),
        3 => Just(DeltaFrame),
        1 => Just(Event),
        1 => Just(KeepAlive),
    ];
    prop_oneof![
        20 => (kind, prop::bool::weighted(0.8))
            .prop_map(|(kind, arrives)| Step::Send { kind, arrives }),
        8 => (0..100_usize).prop_map(|back| Step::Again { back }),
        4 => (0..1500_u64).prop_map(Step::Wait),
        1 => Just(Step::Restart),
        1 => (1..3_u32).prop_map(Step::Version),
        1 => proptest::sample::select(&STATES[..]).prop_map(Step::Parent),
        1 => Just(Step::Disable),
        2 => Just(Step::Enable),
        3 => Just(Step::Timeout),
    ]
}

fn reader_settings() -> impl Strategy<Value = ReaderSettings> {
    (prop::bool::weighted(0.8), any::<bool>()).prop_map(|(timeout, accept_late)| ReaderSettings {
        message_receive_timeout: if timeout { TIMEOUT } else { ms(0) },
        accept_late,
        ..ReaderSettings::default()
    })
}

proptest! {
    #[test]
    fn no_message_is_accepted_twice_and_every_reader_recovers(
        steps in vec(step(), 1..300),
        first in any::<u16>(),
        own in any::<bool>(),
        stamps in any::<bool>(),
        settings in reader_settings(),
    ) {
        let numbered = if own { Numbered::Own } else { Numbered::Group };
        let mut scene = Scene::new(numbered, stamps, settings);
        scene.next = first;
        for step in steps {
            scene.play(step);
        }
        let took = scene.recover();
        prop_assert!(took <= settings.forget_after(), "{:?}", took);
        prop_assert_eq!(scene.reader.state(), Operational);
        if stamps {
            prop_assert_eq!(took, ms(0));
        }
    }

    #[test]
    fn a_writer_polled_when_it_asks_keeps_its_times_and_numbers(
        interval in 1..200_u64,
        keep_alive in 0..500_u64,
        key_frames in 1..6_u32,
        steps in vec((0..300_u64, any::<bool>(), prop::bool::weighted(0.9)), 1..200),
    ) {
        let keep_alive = interval + keep_alive;
        let mut writer = start_writer(interval, keep_alive, key_frames);
        let mut now = ms(0);
        let mut next = 0;
        let mut spoken = now;
        let mut key_frame = None;
        for (late, changed, works) in steps {
            // Mostly in time, sometimes late.
            let asked = writer.poll_timeout().unwrap();
            prop_assert!(asked >= now);
            let late = if late > 250 { ms(late) } else { ms(0) };
            now = asked.max(now) + late;
            if let Some(kind) = writer.poll(now, changed) {
                prop_assert!(now - spoken <= ms(keep_alive) + late);
                spoken = now;
                prop_assert!(kind != DeltaFrame || changed);
                prop_assert_eq!(writer.header().sequence_number, Some(next));
                if kind == DeltaFrame {
                    let since: Duration = now - key_frame.unwrap();
                    prop_assert!(since < ms(interval * u64::from(key_frames)));
                }
                if works {
                    writer.sent(kind, now);
                    next += u16::from(kind != KeepAlive);
                    if kind == KeyFrame {
                        key_frame = Some(now);
                    }
                }
            }
            // After a message that could not be sent, a keep-alive is due once.
            let again = writer.poll(now, changed);
            prop_assert!(again.is_none() || !works && again == Some(KeepAlive));
            prop_assert_eq!(writer.poll(now, changed), None);
            prop_assert!(writer.poll_timeout().unwrap() > now);
        }
    }
}
