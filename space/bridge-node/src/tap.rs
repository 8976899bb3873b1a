//! Tapped topics: the way of each sample, at `/tap` of the status pages. A topic is tapped while it
//! is asked for.

use std::collections::{BTreeMap, VecDeque};
use std::net::SocketAddr;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use bridge_core::{Crossing, Now, Tapped};
use mappings::{SpaceId, TopicId};
use serde::Serialize;
use serde_json::{Value, json};
use service::{LiveAnswer, LivePage, StatusCode};

use crate::clock;

/// The tapped topics of a program, shared by its run loops and its pages.
#[derive(Debug, Default)]
pub(crate) struct Taps {
    /// Whether topics are tapped. The run loops look at nothing else while it is false.
    is_on: AtomicBool,
    topics: Mutex<BTreeMap<TopicId, Line>>,
}

/// The events of a topic.
#[derive(Debug)]
struct Line {
    /// The topic is tapped until this time.
    until: Instant,
    /// The number of the next event.
    next: u64,
    events: VecDeque<(u64, Value)>,
    lost: u64,
}

/// A request for the events of a topic.
#[derive(Debug, Clone, PartialEq, Eq)]
struct TapRequest {
    topic: TopicId,
    /// The number of the first wanted event.
    from: u64,
}

/// The events of a topic, and whether it was not tapped before.
#[derive(Debug)]
struct TapAnswer {
    json: String,
    is_new: bool,
}

impl LivePage for Taps {
    fn path(&self) -> &'static str {
        "/tap"
    }

    /// Returns the events of a tapped topic. Only programs on this host may ask, because the
    /// details of a drop may have values.
    fn answer(&self, query: &str, peer: SocketAddr) -> LiveAnswer {
        if !peer.ip().to_canonical().is_loopback() {
            let why = "topics are tapped from this host only\n".to_owned();
            return LiveAnswer::new(StatusCode::FORBIDDEN, why);
        }
        let wanted = match TapRequest::parse(query) {
            Ok(wanted) => wanted,
            Err(why) => return LiveAnswer::new(StatusCode::BAD_REQUEST, format!("{why}\n")),
        };
        match self.events(&wanted, clock::now().monotonic) {
            // Each run loop records events before the response is sent.
            Some(answer) => LiveAnswer {
                status: StatusCode::OK,
                body: answer.json,
                wakes: answer.is_new,
            },
            None => {
                let why = "too many topics are tapped\n".to_owned();
                LiveAnswer::new(StatusCode::TOO_MANY_REQUESTS, why)
            }
        }
    }
}

/// A fault of the query of a request.
#[derive(Debug, thiserror::Error)]
enum WrongTap {
    #[error("from={0}: expected a number")]
    From(String),
    #[error("expected a topic, such as /tap?topic=ua_1_2_10")]
    NoTopic,
}

impl TapRequest {
    /// Parses the query of a request, as `topic=ua_1_2_10&from=17`.
    ///
    /// # Errors
    /// [`WrongTap`].
    fn parse(query: &str) -> Result<Self, WrongTap> {
        let (mut topic, mut from) = (None, 0);
        for pair in query.split('&') {
            match pair.split_once('=') {
                Some(("topic", text)) => topic = text.parse().ok(),
                Some(("from", text)) => {
                    let number = text.parse();
                    from = number.map_err(|_| WrongTap::From(text.to_owned()))?;
                }
                _ => {}
            }
        }
        let topic = topic.ok_or(WrongTap::NoTopic)?;
        Ok(Self { topic, from })
    }
}

impl Taps {
    fn topics(&self) -> MutexGuard<'_, BTreeMap<TopicId, Line>> {
        self.topics.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Returns whether a run loop has to look at the tapped topics.
    pub(crate) fn is_on(&self) -> bool {
        self.is_on.load(Ordering::Relaxed)
    }

    /// Taps a topic for a while, and returns its events since the last request. `None` if too many
    /// topics are tapped.
    fn events(&self, request: &TapRequest, now: Instant) -> Option<TapAnswer> {
        let mut topics = self.topics();
        topics.retain(|_, line| line.until > now);
        let is_new = !topics.contains_key(&request.topic);
        if is_new && topics.len() >= MOST_TOPICS {
            return None;
        }
        let line = topics.entry(request.topic).or_insert_with(|| Line {
            until: now,
            next: 1,
            events: VecDeque::new(),
            lost: 0,
        });
        line.until = now + TAPPED;
        let events = line.events.iter();
        let events = events.filter(|(number, _)| *number >= request.from);
        let events: Vec<&Value> = events.map(|(_, event)| event).collect();
        let json = json!({
            "topic": request.topic.to_string(), "next": line.next, "lost": line.lost, "events": events,
        });
        self.is_on.store(true, Ordering::Relaxed);
        Some(TapAnswer {
            json: json.to_string(),
            is_new,
        })
    }

    /// Returns the topics that are tapped.
    pub(crate) fn wanted(&self, now: Instant) -> Vec<TopicId> {
        let mut topics = self.topics();
        topics.retain(|_, line| line.until > now);
        if topics.is_empty() {
            self.is_on.store(false, Ordering::Relaxed);
        }
        topics.keys().copied().collect()
    }

    /// Adds an event of a run loop.
    pub(crate) fn add(&self, space: SpaceId, tapped: &Tapped, now: Now) {
        let mut topics = self.topics();
        let Some(line) = topics.get_mut(&tapped.topic) else {
            return;
        };
        let event = Shown {
            space: space.get(),
            at_us: i64::try_from(now.utc.unix_nanos() / 1_000).unwrap_or_default(),
            step: Step::of(&tapped.crossing),
        };
        let Ok(event) = serde_json::to_value(event) else {
            return;
        };
        if line.events.len() >= MOST_EVENTS {
            line.events.pop_front();
        }
        line.events.push_back((line.next, event));
        line.next += 1;
    }

    /// Counts events that were lost before they were added, for all topics.
    pub(crate) fn lost(&self, count: u64) {
        for line in self.topics().values_mut() {
            line.lost += count;
        }
    }
}

/// An event as JSON.
#[derive(Debug, Serialize)]
struct Shown<'a> {
    space: u8,
    /// Microseconds since 1970.
    at_us: i64,
    #[serde(flatten)]
    step: Step<'a>,
}

#[derive(Debug, Serialize)]
#[serde(tag = "step", rename_all = "snake_case")]
enum Step<'a> {
    Taken {
        bytes: usize,
    },
    Sent {
        repeated: bool,
    },
    Received {
        from: String,
        sequence: Option<u16>,
        keep_alive: bool,
    },
    Forwarded {
        #[serde(skip_serializing_if = "Option::is_none")]
        refused: Option<&'static str>,
    },
    Published {
        after_us: f64,
    },
    Measured {
        hop: &'static str,
        delay_us: f64,
    },
    Dropped {
        reason: &'static str,
        meaning: &'static str,
        case: &'static str,
        detail: &'a str,
        #[serde(skip_serializing_if = "Option::is_none")]
        from: Option<String>,
        count: u64,
    },
}

impl<'a> Step<'a> {
    fn of(crossing: &'a Crossing) -> Self {
        match crossing {
            Crossing::Taken { bytes } => Self::Taken { bytes: *bytes },
            Crossing::Sent { repeated } => Self::Sent {
                repeated: *repeated,
            },
            Crossing::Received {
                from,
                sequence,
                keep_alive,
            } => Self::Received {
                from: from.to_string(),
                sequence: *sequence,
                keep_alive: *keep_alive,
            },
            Crossing::Forwarded { refused } => Self::Forwarded { refused: *refused },
            Crossing::Published { after } => Self::Published {
                after_us: microseconds(*after),
            },
            Crossing::Measured { hop, nanos } => Self::Measured {
                hop: hop.label(),
                delay_us: microseconds(*nanos),
            },
            Crossing::Dropped {
                reason,
                case,
                detail,
                from,
                count,
            } => Self::Dropped {
                reason: reason.label(),
                meaning: reason.meaning(),
                case,
                detail,
                from: from.map(|from| from.to_string()),
                count: *count,
            },
        }
    }
}

#[expect(clippy::cast_precision_loss, reason = "a delay shown to people")]
fn microseconds(nanos: i128) -> f64 {
    nanos as f64 / 1_000.0
}

/// A topic is tapped for this time after a request.
const TAPPED: Duration = Duration::from_secs(5);
const MOST_TOPICS: usize = 8;
/// The largest number of stored events of a topic.
const MOST_EVENTS: usize = 2_000;

#[cfg(test)]
mod tests {
    use bridge_core::Reason;

    use super::*;

    fn request(query: &str) -> TapRequest {
        TapRequest::parse(query).unwrap()
    }

    fn answered(taps: &Taps, request: &TapRequest, now: Instant) -> Value {
        serde_json::from_str(&taps.events(request, now).unwrap().json).unwrap()
    }

    #[test]
    fn a_query_names_the_topic() {
        let found = request("topic=ua_1_2_10&from=17");
        assert_eq!(
            (found.topic.to_string().as_str(), found.from),
            ("ua_1_2_10", 17)
        );
        for wrong in ["", "topic=speed", "topic=ua_1_2_10&from=x"] {
            assert!(TapRequest::parse(wrong).is_err(), "{wrong}");
        }
    }

    #[test]
    fn a_topic_is_tapped_while_it_is_asked_for_and_events_are_given_once() {
        let (taps, now) = (Taps::default(), clock::now());
        let at = now.monotonic;
        assert!(!taps.is_on());
        let first = request("topic=ua_1_2_10");
        assert!(taps.events(&first, at).unwrap().is_new);
        assert!(taps.is_on());
        assert_eq!(taps.wanted(at), [first.topic]);
        let tapped = |crossing| Tapped {
            topic: first.topic,
            crossing,
        };
        taps.add(
            SpaceId::ROS1,
            &tapped(Crossing::Sent { repeated: false }),
            now,
        );
        let dropped = Crossing::Dropped {
            reason: Reason::Duplicate,
            case: "",
            detail: String::new(),
            from: None,
            count: 1,
        };
        taps.add(SpaceId::ROS1, &tapped(dropped), now);
        let answer = answered(&taps, &first, at);
        assert_eq!(
            (&answer["next"], answer["events"].as_array().unwrap().len()),
            (&json!(3), 2)
        );
        assert_eq!(answer["events"][1]["reason"], "duplicate");
        assert!(
            answer["events"][1]["meaning"]
                .as_str()
                .unwrap()
                .contains("sequence number")
        );
        let answer = answered(&taps, &request("topic=ua_1_2_10&from=3"), at);
        assert!(answer["events"].as_array().unwrap().is_empty());
        assert_eq!(taps.wanted(at + 2 * TAPPED), []);
        assert!(!taps.is_on());
    }

    #[test]
    fn topics_and_events_are_bounded() {
        let (taps, now) = (Taps::default(), clock::now());
        for id in 1..=8 {
            let asked = request(&format!("topic=ua_1_2_{id}"));
            assert!(taps.events(&asked, now.monotonic).is_some());
        }
        let more = request("topic=ua_1_2_9");
        assert!(taps.events(&more, now.monotonic).is_none());
        let topic = request("topic=ua_1_2_1");
        for _ in 0..MOST_EVENTS + 10 {
            let crossing = Crossing::Taken { bytes: 1 };
            let topic = topic.topic;
            taps.add(SpaceId::ROS1, &Tapped { topic, crossing }, now);
        }
        let answer = answered(&taps, &topic, now.monotonic);
        assert_eq!(answer["events"].as_array().unwrap().len(), MOST_EVENTS);
    }
}
