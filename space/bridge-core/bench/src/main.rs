//! Measures a message through the Router among 10 and among 10 000 topics, which all have a value.
//! Without arguments it prints wall time; `count CASE N` only does the work, for an instruction
//! counter.

use std::hint::black_box;
use std::process::ExitCode;
use std::sync::Arc;
use std::time::{Duration, Instant};

use bridge_core::{Local, LocalMessage, Now, Output, Router, RouterSettings};
use mappings::{Mapping, SpaceId, TopicId};
use messages::{Dialect, Selection, TypeRegistry};
use uadp::Timestamp;

/// Number of rounds, of which the fastest counts: slower rounds were disturbed.
const ROUNDS: u32 = 15;
const MESSAGES: u32 = 20_000;
const MANY: u16 = 10_000;
/// The time between two messages of a topic, for any number of topics. It is too short for a value
/// to be repeated.
const ROUND: Duration = Duration::from_millis(1);

/// A measured case, with a name for tables and the command line.
struct Case {
    way: &'static str,
    topics: u16,
}

const CASES: [Case; 4] = [
    Case {
        way: "send",
        topics: 10,
    },
    Case {
        way: "send",
        topics: MANY,
    },
    Case {
        way: "receive",
        topics: 10,
    },
    Case {
        way: "receive",
        topics: MANY,
    },
];

impl Case {
    fn name(&self) -> String {
        format!("{} among {} topics", self.way, self.topics)
    }

    fn bench(&self) -> Bench {
        Bench::new(self.topics, self.way == "receive")
    }
}

fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let arguments: Vec<&str> = arguments.iter().map(String::as_str).collect();
    match arguments[..] {
        [] => {
            wall();
            ExitCode::SUCCESS
        }
        ["list"] => {
            for case in &CASES {
                println!("{}", case.name());
            }
            ExitCode::SUCCESS
        }
        ["count", name, messages] => {
            let case = CASES.iter().find(|case| case.name() == name);
            match (case, messages.parse()) {
                (Some(case), Ok(messages)) => {
                    case.bench().pass(messages);
                    ExitCode::SUCCESS
                }
                _ => usage(),
            }
        }
        _ => usage(),
    }
}

fn usage() -> ExitCode {
    eprintln!("usage: bridge-core-bench [list | count CASE MESSAGES]");
    ExitCode::from(64)
}

/// A Router of space 1 with a value for each topic, and the messages for it.
struct Bench {
    router: Router,
    now: Now,
    topics: Vec<TopicId>,
    /// The time between two messages.
    step: Duration,
    /// A datagram for each topic of another space; empty if the topics are of the own space.
    datagrams: Vec<Vec<u8>>,
    next: usize,
    /// The number of sent and delivered messages.
    passed: u32,
}

impl Bench {
    fn new(count: u16, receives: bool) -> Self {
        let now = Now {
            monotonic: Instant::now(),
            utc: Timestamp::from_unix_nanos(1_700_000_000_000_000_000),
        };
        let ids =
            || (1..=count).map(|id| TopicId::new(if receives { 2 } else { 1 }, 5, id).unwrap());
        let mut bench = Self {
            router: router(1),
            now,
            topics: ids().collect(),
            step: ROUND / u32::from(count),
            datagrams: Vec::new(),
            next: 0,
            passed: 0,
        };
        bind(&mut bench.router, &bench.topics, now);
        if receives {
            let mut other = router(2);
            bind(&mut other, &bench.topics, now);
            for topic in &bench.topics {
                say(&mut other, *topic, now);
                while let Some(output) = other.poll_output(now) {
                    if let Output::Datagram { bytes, .. } = output {
                        bench.datagrams.push(bytes);
                    }
                }
            }
            assert_eq!(bench.datagrams.len(), bench.topics.len());
        }
        bench.pass(u32::from(count) * 2);
        assert_eq!(bench.passed, u32::from(count) * 2, "messages were dropped");
        bench
    }

    /// Passes messages, one after the other, of all topics in turn.
    fn pass(&mut self, messages: u32) {
        for _ in 0..messages {
            self.now.monotonic += self.step;
            let at = self.next;
            self.next = (at + 1) % self.topics.len();
            match self.datagrams.get_mut(at) {
                None => say(&mut self.router, self.topics[at], self.now),
                Some(datagram) => {
                    renumber(datagram);
                    self.router
                        .handle_datagram(datagram, SENDER.into(), self.now);
                }
            }
            if self
                .router
                .poll_timeout()
                .is_some_and(|due| due <= self.now.monotonic)
            {
                self.router.handle_timeout(self.now);
            }
            while let Some(output) = self.router.poll_output(self.now) {
                match black_box(output) {
                    Output::Datagram { bytes, .. } => {
                        self.passed += 1;
                        self.router.recycle(bytes);
                    }
                    Output::Delivery(delivery) => {
                        self.passed += 1;
                        self.router
                            .published(delivery.topic, delivery.arrived, self.now);
                        self.router.recycle(delivery.payload);
                    }
                    _ => {}
                }
            }
        }
    }
}

fn router(space: u16) -> Router {
    let settings = RouterSettings {
        own: SpaceId::new(space).unwrap(),
        local: Local::Ros1,
        source: None,
    };
    Router::new(settings, Arc::new(Mapping::default()))
}

fn bind(router: &mut Router, topics: &[TopicId], now: Now) {
    let message = TypeRegistry::bundle(Dialect::Ros1)
        .get(&"geometry_msgs/Twist".parse().unwrap())
        .unwrap();
    for topic in topics {
        router
            .bind(*topic, &message, &Selection::Whole, now)
            .unwrap();
    }
}

/// Gives a Router a Twist.
fn say(router: &mut Router, topic: TopicId, now: Now) {
    let heard = LocalMessage {
        topic,
        payload: &[0; 48],
        received: now.utc,
        latched_by: None,
    };
    let _verdict = black_box(router.handle_local(heard, now));
}

/// Increments the sequence number of the DataSetMessage, so that the message is new.
fn renumber(datagram: &mut [u8]) {
    // Behind the flags of the DataSetMessage, which the six Doubles of a Twist end with.
    let at = datagram.len() - FIELDS - HEADER;
    let number = u16::from_le_bytes([datagram[at], datagram[at + 1]]).wrapping_add(1);
    datagram[at..at + 2].copy_from_slice(&number.to_le_bytes());
}

/// Bytes of the fields of a Twist: their number, and six Variants.
const FIELDS: usize = 2 + 6 * 9;
/// Bytes of the DataSetMessage header from the sequence number on: that number, Timestamp,
/// PicoSeconds, Status.
const HEADER: usize = 2 + 8 + 2 + 2;
const SENDER: ([u8; 4], u16) = ([127, 0, 0, 1], 50_001);

/// Measures the cases in turn, so that all cases have the same conditions.
fn wall() {
    let mut benches: Vec<Bench> = CASES.iter().map(Case::bench).collect();
    let mut best = [Duration::MAX; CASES.len()];
    for _ in 0..ROUNDS {
        for (bench, best) in benches.iter_mut().zip(&mut best) {
            let start = Instant::now();
            bench.pass(MESSAGES);
            *best = start.elapsed().min(*best);
        }
    }
    for (case, best) in CASES.iter().zip(best) {
        let nanos = best.as_secs_f64() * 1e9 / f64::from(MESSAGES);
        println!("{:<32} {nanos:10.1} ns", case.name());
    }
}
