//! The path of a topic into a relay and out of it.

use std::io::Write;
use std::net::TcpStream;
use std::time::{Duration, Instant};

use system_tests::{BareNode, BareSubscription, PATIENCE, Times, eventually, string_frame};

/// The two ends of a path.
pub(crate) struct PathLane {
    input: TcpStream,
    output: BareSubscription,
    /// The number of the next message, which distinguishes it from late messages of an earlier
    /// measurement.
    number: u64,
    start: Instant,
}

impl PathLane {
    pub(crate) fn of(input: TcpStream, output: BareSubscription) -> Self {
        Self {
            input,
            output,
            number: 0,
            start: Instant::now(),
        }
    }

    /// Returns the established lanes through a relay that republishes the first topic of each pair
    /// as the second.
    pub(crate) fn through(node: &BareNode, pairs: &[(String, String)]) -> Vec<Self> {
        let inputs: Vec<String> = pairs.iter().map(|(input, _)| input.clone()).collect();
        let inputs = node.publish(&inputs).into_iter();
        let lanes = inputs.zip(pairs).map(|(mut input, (_, output))| {
            // Some relays advertise their output only when they have received a message.
            let mut output = eventually("the relay advertises", START, || {
                input.write_all(&string_frame("are you there")).unwrap();
                node.subscribe(output)
            });
            // Other relays send to a subscriber only after the handshake with it.
            output.wait_at_most(Duration::from_millis(200));
            eventually("the relay carries a message", START, || {
                input.write_all(&string_frame("are you there")).unwrap();
                output.receive().ok().map(drop)
            });
            output.wait_at_most(PATIENCE);
            let mut lane = Self::of(input, output);
            // Discards the messages of the start.
            lane.pass(&string_frame("now"));
            lane
        });
        lanes.collect()
    }

    /// Sends a frame, waits until it arrives, and returns the elapsed time.
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

    /// Sends numbered messages on a separate thread, at a pace or all at once. Returns the times of
    /// the messages that arrive before a silence of `SILENCE`.
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

/// Sends at absolute times. A message's time starts when it is sent, so that the sender's own delay
/// does not count.
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

/// Returns a text of `size` characters that ends with its number and the time of sending.
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

/// Digits of a number at the end of a text.
pub(crate) const DIGITS: usize = 16;
/// Silence after which no more messages are expected.
const SILENCE: Duration = Duration::from_millis(700);
const START: Duration = Duration::from_secs(30);
