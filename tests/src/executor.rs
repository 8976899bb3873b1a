//! A responder that executes a call in a space, built on the codec alone.

use std::net::Ipv4Addr;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use uadp::action::{
    ActionDialect, ActionFields, ActionOutcome, ExecutionId, RequiredAction, Responder,
    ResponderSettings,
};
use uadp::discovery::{
    ActionMetaData, ActionTargetDataType, AnnouncedContent, Announcement, DataSetMetaDataType,
    FieldMetaData, WireArray,
};
use uadp::{
    BuiltinType, ConfigurationVersion, Extras, NetworkHeader, NetworkMessage, NodeId, PublisherId,
    SecurityHeader, StatusCode,
};

use crate::{TopicTriple, UadpSocket};

/// Announces a call without inputs and with the outputs `success`, `message` and `run`, and
/// executes it.
pub struct Executor {
    stop: Arc<AtomicBool>,
    executed: Arc<AtomicU32>,
    abandoned: Arc<AtomicU32>,
    thread: Option<JoinHandle<()>>,
}

/// The ways in which an [`Executor`] executes requests.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Executes {
    /// Answers each request at once: `message` is the name of the call, and `run` the number of
    /// requests so far.
    AtOnce,
    /// Never ends an execution.
    Forever,
}

struct Work {
    triple: TopicTriple,
    name: String,
    socket: UadpSocket,
    responder: Responder<()>,
    executes: Executes,
    /// Number of times that each datagram is received and sent.
    copies: usize,
    executed: Arc<AtomicU32>,
    abandoned: Arc<AtomicU32>,
    start: Instant,
}

impl Executor {
    /// Announces the call at once and every `ANNOUNCED_EVERY`, until this is dropped. With `copies`
    /// above 1, every datagram in both directions is duplicated.
    #[must_use]
    pub fn start(triple: TopicTriple, name: &str, executes: Executes, copies: usize) -> Self {
        let stop = Arc::<AtomicBool>::default();
        let [executed, abandoned] = [(), ()].map(|()| Arc::<AtomicU32>::default());
        let mut work = Work {
            triple,
            name: name.to_owned(),
            socket: UadpSocket::join_on(Ipv4Addr::LOCALHOST),
            responder: Responder::new(ResponderSettings::default()),
            executes,
            copies,
            executed: Arc::clone(&executed),
            abandoned: Arc::clone(&abandoned),
            start: Instant::now(),
        };
        let stopped = Arc::clone(&stop);
        let thread = std::thread::spawn(move || work.run(&stopped));
        Self {
            stop,
            executed,
            abandoned,
            thread: Some(thread),
        }
    }

    /// Returns the number of requests that were executed or started.
    #[must_use]
    pub fn executed(&self) -> u32 {
        self.executed.load(Ordering::Relaxed)
    }

    /// Returns the number of started requests that were abandoned by their requestors.
    #[must_use]
    pub fn abandoned(&self) -> u32 {
        self.abandoned.load(Ordering::Relaxed)
    }

    /// Stops the executor in the middle of its work, as a killed process: it sends nothing more.
    pub fn kill(self) {
        drop(self);
    }
}

impl Drop for Executor {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take()
            && thread.join().is_err()
            && !std::thread::panicking()
        {
            panic!("the executor has failed");
        }
    }
}

impl Work {
    fn run(&mut self, stop: &AtomicBool) {
        let announcement = self.announcement();
        let mut announce_at = self.start;
        while !stop.load(Ordering::Relaxed) {
            if Instant::now() >= announce_at {
                announce_at = Instant::now() + ANNOUNCED_EVERY;
                self.socket.send(&announcement);
            }
            if let Some(datagram) = self.socket.receive(TURN) {
                for _ in 0..self.copies {
                    self.hear(&datagram);
                }
            }
            self.answer();
        }
    }

    fn hear(&mut self, datagram: &[u8]) {
        let Ok(message) = NetworkMessage::decode(datagram) else {
            return;
        };
        let Ok(requests) = message.actions(ActionDialect::Standard) else {
            return;
        };
        let (space, namespace, id) = self.triple;
        for request in requests.flatten() {
            let ours = request.publisher_id == PublisherId::UInt16(space)
                && request.writer_group_id == Some(namespace)
                && request.writer_id == id;
            let now = self.start.elapsed();
            if !ours {
                continue;
            }
            // Messages that the responder does not take, such as its own responses, are ignored.
            match self.responder.handle_request(&request, (), now) {
                Ok(RequiredAction::Execute(execution)) => self.execute(execution, now),
                Ok(RequiredAction::Abandoned(_)) => {
                    self.abandoned.fetch_add(1, Ordering::Relaxed);
                }
                Ok(_) | Err(_) => {}
            }
        }
    }

    fn execute(&mut self, execution: ExecutionId, now: Duration) {
        let run = self.executed.fetch_add(1, Ordering::Relaxed) + 1;
        if self.executes == Executes::Forever {
            return;
        }
        let mut fields = vec![3, 0, 1, 1, 12];
        fields.extend(u32::try_from(self.name.len()).unwrap().to_le_bytes());
        fields.extend(self.name.as_bytes());
        fields.push(7);
        fields.extend(run.to_le_bytes());
        let outcome = ActionOutcome::Answered {
            status: StatusCode::GOOD,
            fields: ActionFields::Variants(&fields),
        };
        self.responder.finish(execution, outcome, now).unwrap();
    }

    fn answer(&mut self) {
        while let Some((_, response)) = self.responder.poll_transmit(self.start.elapsed()) {
            let mut datagram = Vec::new();
            let (header, extras) = (NetworkHeader::default(), Extras::default());
            let encoder = response.encode(&mut datagram, &header, &extras);
            encoder.unwrap().finish().unwrap();
            for _ in 0..self.copies {
                self.socket.send(&datagram);
            }
        }
    }

    fn announcement(&self) -> Vec<u8> {
        let (space, namespace, id) = self.triple;
        let name = format!("ua_{space}_{namespace}_{id} {}", self.name);
        let field = |name, builtin: BuiltinType| FieldMetaData {
            name: Some(name),
            built_in_type: builtin as u8,
            data_type: NodeId::numeric(0, u32::from(builtin as u8)),
            value_rank: -1,
            ..FieldMetaData::default()
        };
        let fields = [
            field("success", BuiltinType::Boolean),
            field("message", BuiltinType::String),
            field("run", BuiltinType::UInt32),
        ];
        let of = |fields| DataSetMetaDataType {
            name: Some(&name),
            fields: WireArray::new(fields),
            configuration_version: ConfigurationVersion { major: 1, minor: 1 },
            ..DataSetMetaDataType::default()
        };
        let target = [ActionTargetDataType {
            action_target_id: 1,
            ..ActionTargetDataType::default()
        }];
        let announcement = Announcement {
            sequence_number: 0,
            announced: AnnouncedContent::ActionMetaData(ActionMetaData {
                writer_id: id,
                action_targets: WireArray::new(&target),
                request: of(&[]),
                response: of(&fields),
                action_methods: WireArray::default(),
            }),
        };
        let mut datagram = Vec::new();
        let publisher = PublisherId::UInt16(space);
        announcement
            .encode(publisher, SecurityHeader::NONE, &mut datagram)
            .unwrap();
        datagram
    }
}

/// Interval between two announcements.
const ANNOUNCED_EVERY: Duration = Duration::from_millis(500);
/// Time of listening between two checks for due work.
const TURN: Duration = Duration::from_millis(5);
