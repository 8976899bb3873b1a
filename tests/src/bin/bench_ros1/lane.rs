//! One topic's way into a relay and out of it again.

use std::io::Write;
use std::net::TcpStream;
use std::time::{Duration, Instant};

use system_tests::{BareNode, BareSubscription, PATIENCE, Times, eventually, string_frame};

/// The two ends of a way.
pub(crate) struct Lane {
    input: TcpStream,
    output: BareSubscription,
    /// Of the next message: late ones of an earlier measurement are told apart by it.
    number: u64,
    start: Instant,
}

impl Lane {
    pub(crate) fn of(input: TcpStream, output: BareSubscription) -> Self {
        Self {
            input,
            output,
            number: 0,
            start: Instant::now(),
        }
    }

    /// The lanes through a relay that repeats the first topic of each pair as the second, once they stand.
    pub(crate) fn through(node: &BareNode, pairs: &[(String, String)]) -> Vec<Self> {
        let inputs: Vec<String> = pairs.iter().map(|(input, _)| input.clone()).collect();
        let inputs = node.publish(&inputs).into_iter();
        let lanes = inputs.zip(pairs).map(|(mut input, (_, output))| {
            // Some relays advertise their output only when they have seen a message.
            let mut output = eventually("the relay advertises", START, || {
                input.write_all(&string_frame("are you there")).unwrap();
                node.subscribe(output)
            });
            // Others take a subscriber in only after they have shaken hands with it.
            output.wait_at_most(Duration::from_millis(200));
            eventually("the relay carries a message", START, || {
                input.write_all(&string_frame("are you there")).unwrap();
                output.receive().ok().map(drop)
            });
            output.wait_at_most(PATIENCE);
            let mut lane = Self::of(input, output);
            // What is left of the beginning is read away.
            lane.pass(&string_frame("now"));
            lane
        });
        lanes.collect()
    }

    /// Sends a frame, waits until it comes out, and says how long that took.
    pub(crate) fn pass(&mut self, frame: &[u8]) -> Duration {
        let start = Instant::now();
        self.input.write_all(frame).unwrap();
        let tail = &frame[frame.len().saturating_sub(DIGITS).max(4)..];
        loop {
            let heard = self
                .output
                .receive()
                .unwrap_or_else(|error| panic!("a message was lost: {error}"));
            if heard.len() + 4 == frame.len() && heard.ends_with(tail) {
                return start.elapsed();
            }
        }
    }

    /// Sends numbered messages in a thread of their own, at a pace or all in one piece, and gives the times of those
    /// that come out before all is silent for `silence`.
    pub(crate) fn stream(&mut self, count: u64, size: usize, pace: Option<Duration>) -> Times {
        let first = self.number;
        self.number += count;
        let (start, mut input) = (self.start, &self.input);
        let output = &mut self.output;
        output.wait_at_most(SILENCE);
        let mut times = Times::default();
        std::thread::scope(|scope| {
            scope.spawn(move || match pace {
                Some(pace) => paced(input, first..first + count, size, pace, start),
                None => {
                    let frames = first..first + count;
                    let frames: Vec<u8> = frames
                        .flat_map(|number| stamped(number, start.elapsed(), size))
                        .collect();
                    input.write_all(&frames).unwrap();
                }
            });
            while let Ok(frame) = output.receive() {
                let Some((number, sent)) = stamp(frame) else {
                    continue;
                };
                if (first..first + count).contains(&number) {
                    times.add(start.elapsed().saturating_sub(sent));
                }
                if number + 1 == first + count {
                    break;
                }
            }
        });
        output.wait_at_most(PATIENCE);
        times
    }
}

/// Sends at absolute times. A message's time begins when it is sent, so that the sender's own lateness does not count.
fn paced(
    mut input: &TcpStream,
    numbers: std::ops::Range<u64>,
    size: usize,
    pace: Duration,
    start: Instant,
) {
    let mut due = Instant::now();
    for number in numbers {
        std::thread::sleep(due.saturating_duration_since(Instant::now()));
        let frame = stamped(number, start.elapsed(), size);
        input.write_all(&frame).unwrap();
        due += pace;
    }
}

/// A text of `size` characters that ends with its number and when it was sent.
fn stamped(number: u64, sent: Duration, size: usize) -> Vec<u8> {
    let sent = sent.as_nanos();
    let padding = size.saturating_sub(2 * DIGITS);
    string_frame(&format!("{:padding$}{number:0DIGITS$}{sent:0DIGITS$}", ""))
}

fn stamp(frame: &[u8]) -> Option<(u64, Duration)> {
    let (rest, sent) = frame.split_last_chunk::<DIGITS>()?;
    let (_, number) = rest.split_last_chunk::<DIGITS>()?;
    let digits = |text: &[u8]| std::str::from_utf8(text).ok()?.parse().ok();
    Some((digits(number)?, Duration::from_nanos(digits(sent)?)))
}

/// Of a number at the end of a text.
pub(crate) const DIGITS: usize = 16;
/// Nothing more comes after this long without a message.
const SILENCE: Duration = Duration::from_millis(700);
const START: Duration = Duration::from_secs(30);
