//! The requests and responses to send, and the outputs for the port about calls.

use mappings::TopicId;
use uadp::action::{ActionAddress, ActionToSend};
use uadp::{EncodeError, Extras, NetworkHeader, PublisherId};

use super::super::late::timed_header;
use super::CallTraffic;
use super::chunks::{Chunking, FirstTimes, Of};
use crate::counters::Reason;
use crate::output::Output;
use crate::settings::Now;

impl CallTraffic<'_> {
    /// Returns the maximum size of a datagram in bytes.
    fn most(&self) -> usize {
        self.values.sizes().0.into()
    }

    /// Queues a request or response that is larger than a datagram.
    fn cut_up(&mut self, topic: TopicId, of: Of, bytes: Vec<u8>) {
        if let Some(calls) = &mut self.calls {
            calls.chunking.push(topic, of, bytes);
        }
    }

    /// Returns the next chunk if the pace allows it, alternating with the chunks of values.
    fn next_chunk(&mut self, now: Now) -> Option<Output> {
        let values_wait = !self.values.paced.is_empty();
        let most = self.most();
        let header = timed_header(now);
        let calls = self.calls.as_mut()?;
        let chunking = &mut calls.chunking;
        if chunking.is_empty() || !self.values.pace.is_open(now.monotonic) {
            return None;
        }
        if values_wait && !std::mem::replace(&mut chunking.gave_way, true) {
            return None;
        }
        chunking.gave_way = false;
        let mut bytes = Vec::new();
        let (topic, written) = chunking.write(most, &header, &mut bytes)?;
        match written {
            Ok(()) => {
                self.values.pace.spend(bytes.len(), now.monotonic);
                Some(Output::Action { topic, bytes })
            }
            Err(error) => {
                self.count_call(topic, None, Reason::TooBig, || error.to_string());
                None
            }
        }
    }

    /// Returns the next output for the port about calls, or the next request or response to send.
    pub(in super::super) fn next_action(&mut self, now: Now) -> Option<Output> {
        loop {
            if let Some(chunk) = self.next_chunk(now) {
                return Some(chunk);
            }
            let mut bytes = self.values.buffer();
            match self.write_action(&mut bytes, now) {
                Some(CallOutput::Datagram(topic, _)) if bytes.len() <= self.most() => {
                    return Some(Output::Action { topic, bytes });
                }
                Some(CallOutput::Datagram(topic, of)) => self.cut_up(topic, of, bytes),
                Some(CallOutput::News(output)) => {
                    self.values.recycle(bytes);
                    return Some(output);
                }
                None => {
                    self.values.recycle(bytes);
                    return None;
                }
            }
        }
    }

    fn write_action(&mut self, bytes: &mut Vec<u8>, now: Now) -> Option<CallOutput> {
        let headers = Headers {
            timed: timed_header(now),
            dates_repetitions: self.values.dates_repetitions(),
            most: self.most(),
        };
        loop {
            let calls = self.calls.as_mut()?;
            if let Some(news) = calls.news.pop_front() {
                return Some(CallOutput::News(news));
            }
            if calls.due.is_none_or(|due| due > now.monotonic) {
                return None;
            }
            let since = calls.since_start(now);
            let answer = calls.responder.poll_transmit(since);
            let action = match answer {
                Some((_, answer)) => Some(answer),
                None => calls.requestor.poll_transmit(since),
            };
            let next = action.map(|action| {
                let written = headers.encode(&action, &mut calls.chunking, bytes);
                (Of::message(&action), written)
            });
            match next {
                // Timeouts that occurred in the meantime are output.
                None => {
                    self.settle(now);
                    let calls = self.calls.as_mut()?;
                    return calls.news.pop_front().map(CallOutput::News);
                }
                Some((of, (Some(topic), Ok(())))) if !self.values.is_withheld(topic) => {
                    return Some(CallOutput::Datagram(topic, of));
                }
                Some((_, (Some(topic), Ok(())))) => {
                    self.count_call(topic, None, (Reason::SpaceTaken, "withheld"), String::new);
                }
                Some((_, (topic, Err(error)))) => {
                    if let Some(topic) = topic {
                        self.count_call(topic, None, Reason::TooBig, || error.to_string());
                    }
                }
                Some((_, (None, Ok(())))) => {}
            }
            bytes.clear();
        }
    }
}

/// The next output about calls.
enum CallOutput {
    News(Output),
    Datagram(TopicId, Of),
}

/// The headers of requests and responses.
struct Headers {
    /// The headers with the time of sending.
    timed: NetworkHeader<'static>,
    /// Whether each repetition in chunks has its own time of sending.
    dates_repetitions: bool,
    /// The maximum size of a datagram in bytes.
    most: usize,
}

impl Headers {
    /// Encodes the NetworkMessage. The time of sending and the TimeoutHint of a request say how
    /// long its requestor waits. On UDP the repetitions in chunks are equal to the first
    /// transmission, and the chunks of responses have no time.
    fn encode(
        &self,
        action: &ActionToSend<'_>,
        chunking: &mut Chunking,
        bytes: &mut Vec<u8>,
    ) -> Written {
        let written = encode(&action.with_time_left(), &self.timed, bytes);
        if bytes.len() <= self.most || self.dates_repetitions {
            return written;
        }
        let of = Of::message(action);
        let header = match of {
            Of::Request(_) => self.timed,
            // A caller waits for a response of any age: only requests are dropped when they are
            // old.
            Of::Response(_) => NetworkHeader::default(),
        };
        let now = FirstTimes {
            header,
            left: action.left,
        };
        let first = chunking.first_times(of, now);
        if first == now && header == self.timed {
            return written;
        }
        bytes.clear();
        let repetition = ActionToSend {
            left: first.left,
            ..*action
        };
        encode(&repetition.with_time_left(), &first.header, bytes)
    }
}

/// Encodes the NetworkMessage and returns the topic of its call.
fn encode(action: &ActionToSend<'_>, header: &NetworkHeader<'_>, bytes: &mut Vec<u8>) -> Written {
    let ActionAddress {
        publisher_id,
        writer_group_id,
        writer_id,
        ..
    } = action.address;
    let topic = match publisher_id.as_id() {
        PublisherId::UInt16(space) => {
            TopicId::new(space, writer_group_id.unwrap_or_default(), *writer_id)
        }
        PublisherId::Byte(_)
        | PublisherId::UInt32(_)
        | PublisherId::UInt64(_)
        | PublisherId::String(_) => None,
    };
    let written = action
        .encode(bytes, header, &Extras::default())
        .and_then(uadp::action::ActionEncoder::finish);
    (topic, written)
}

/// The topic of the call of a NetworkMessage, and whether the message was encoded.
type Written = (Option<TopicId>, Result<(), EncodeError>);
