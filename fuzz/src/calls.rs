//! Fuzzes a Requestor and a Responder with an attacker between them, which delays, changes,
//! duplicates and forges messages.

use std::collections::BTreeMap;
use std::time::Duration;

use uadp::action::{
    ActionAddress, ActionDialect, ActionEncoding, ActionFields, ActionMessage, ActionOutcome,
    ActionRequest, ActionToSend, CallId, ExecutionId, Refusal, Requestor, RequestorSettings,
    RequiredAction, Responder, ResponderSettings, ResponseMeaning,
};
use uadp::{Extras, NetworkHeader, NetworkMessage, OwnedPublisherId, StatusCode};

use crate::input::Input;

/// Maximum number of messages; more messages add no coverage.
const MESSAGES: usize = 256;
const REQUESTS: usize = 6;
const BYTES: usize = 4000;
/// Maximum number of completed requests that are remembered, and the bytes of all of them.
const OVER: usize = 4;
const OVER_BYTES: usize = OVER * 100;
/// Longer than the time of any input.
const REMEMBER: Duration = Duration::from_secs(3600);

/// Runs operations, each a byte: call, send, deliver, deliver changed, deliver arbitrary bytes,
/// finish, refuse, abandon, let time pass.
///
/// Each call ends at most once, stored data stays within the limits, no timeout is in the past, and
/// without changed messages each request is executed at most once.
pub fn calls(data: &[u8]) {
    let mut input = Input::new(data);
    let mut world = World::new(input.byte());
    while !input.is_empty() {
        match input.byte() % 10 {
            0 | 1 => world.call(&mut input),
            2 => world.send(),
            3 => {
                let index = usize::from(input.byte());
                if let Some(datagram) = world.sent.get(index).cloned() {
                    world.deliver(&datagram);
                }
            }
            4 => {
                let index = usize::from(input.byte());
                if let Some(mut datagram) = world.sent.get(index).cloned() {
                    let at = usize::from(input.u16()) % datagram.len();
                    datagram[at] ^= input.byte();
                    world.changed = true;
                    world.deliver(&datagram);
                }
            }
            5 => {
                world.changed = true;
                world.deliver(input.bytes());
            }
            6 => world.finish(&mut input, None),
            7 => world.finish(&mut input, Some(Refusal::NotAllowed)),
            8 => {
                let index = usize::from(input.byte());
                if let Some(id) = world.calls.get(index).copied()
                    && world.requestor.abandon(id, world.now)
                {
                    world.end(id);
                }
            }
            _ => world.now += Duration::from_millis(10 * u64::from(input.byte())),
        }
        world.check();
    }
    world.run_out();
}

struct World {
    dialect: ActionDialect,
    requestor: Requestor,
    responder: Responder<()>,
    now: Duration,
    sent: Vec<Vec<u8>>,
    calls: Vec<CallId>,
    ended: BTreeMap<CallId, u32>,
    executions: Vec<ExecutionId>,
    /// The number of executions, by the number in the arguments.
    executed: BTreeMap<u8, u32>,
    changed: bool,
}

impl World {
    fn new(choice: u8) -> Self {
        let one_shot = ActionDialect::UaNetStandard(ActionEncoding::Variant);
        Self {
            dialect: match choice & 1 {
                0 => ActionDialect::Standard,
                _ => one_shot,
            },
            requestor: Requestor::new(
                OwnedPublisherId::UInt16(1),
                [7; 16],
                RequestorSettings {
                    max_calls: REQUESTS,
                    max_bytes: BYTES,
                    ..RequestorSettings::default()
                },
            ),
            responder: Responder::new(ResponderSettings {
                max_requests: REQUESTS,
                max_requests_per_sender: REQUESTS - 1,
                max_executing: 3,
                max_bytes: BYTES,
                max_bytes_per_sender: BYTES - 500,
                max_over: OVER,
                max_over_per_sender: OVER - 1,
                remember: REMEMBER,
                ..ResponderSettings::default()
            }),
            now: Duration::ZERO,
            sent: Vec::new(),
            calls: Vec::new(),
            ended: BTreeMap::new(),
            executions: Vec::new(),
            executed: BTreeMap::new(),
            changed: false,
        }
    }

    fn call(&mut self, input: &mut Input<'_>) {
        let Ok(number) = u8::try_from(self.calls.len()) else {
            return;
        };
        let fields = [1, 0, 3, number];
        let request = ActionRequest {
            address: ActionAddress {
                publisher_id: OwnedPublisherId::Byte(2),
                writer_group_id: Some(5),
                writer_id: 61,
                target_id: 1,
            },
            dialect: self.dialect,
            fields: ActionFields::Variants(&fields),
            timeout: Duration::from_millis(10 * u64::from(input.byte())),
        };
        if let Ok(id) = self.requestor.call(request, self.now) {
            self.calls.push(id);
        }
    }

    fn send(&mut self) {
        while let Some(request) = self.requestor.poll_transmit(self.now) {
            keep(&mut self.sent, &request);
        }
        while let Some((_, response)) = self.responder.poll_transmit(self.now) {
            keep(&mut self.sent, &response);
        }
        while let Some((id, _)) = self.requestor.poll_given_up() {
            self.end(id);
        }
        let waits = [self.requestor.poll_timeout(), self.responder.poll_timeout()];
        let past = waits.into_iter().flatten().find(|at| *at <= self.now);
        assert_eq!(past, None, "a wait that is over at {:?}", self.now);
    }

    fn deliver(&mut self, datagram: &[u8]) {
        let Ok(network) = NetworkMessage::decode(datagram) else {
            return;
        };
        let Ok(actions) = network.actions(self.dialect) else {
            return;
        };
        for message in actions.flatten() {
            self.hear(&message);
        }
    }

    fn hear(&mut self, message: &ActionMessage<'_>) {
        if let Ok(RequiredAction::Execute(id)) =
            self.responder.handle_request(message, (), self.now)
        {
            self.executions.push(id);
            let number = message.fields.bytes().get(3).copied().unwrap_or_default();
            *self.executed.entry(number).or_default() += 1;
        }
        if let Ok(ResponseMeaning::Done(id, _)) = self.requestor.handle_response(message, self.now)
        {
            self.end(id);
        }
    }

    fn finish(&mut self, input: &mut Input<'_>, refusal: Option<Refusal>) {
        let index = usize::from(input.byte());
        let Some(id) = self.executions.get(index).copied() else {
            return;
        };
        let outcome = match refusal {
            Some(refusal) => ActionOutcome::Refused(refusal),
            None => ActionOutcome::Answered {
                status: StatusCode(u32::from(input.byte()) << 24),
                fields: ActionFields::Variants(input.bytes()),
            },
        };
        let _ = self.responder.finish(id, outcome, self.now);
    }

    fn end(&mut self, id: CallId) {
        let ended = self.ended.entry(id).or_default();
        *ended += 1;
        assert_eq!(*ended, 1, "{id:?} ended again");
        assert!(self.calls.contains(&id), "{id:?} was never begun");
    }

    fn check(&self) {
        assert!(self.requestor.open_calls() <= REQUESTS);
        let (requests, bytes) = self.responder.held();
        assert!(
            requests <= REQUESTS + OVER && bytes <= BYTES + OVER_BYTES,
            "{requests} requests, {bytes} bytes"
        );
        let twice = self.executed.values().any(|executed| *executed > 1);
        assert!(
            self.changed || !twice,
            "executed twice: {:?}",
            self.executed
        );
    }

    /// Runs until all calls have ended and no message is due.
    fn run_out(&mut self) {
        for _ in 0..100_000 {
            self.sent.clear();
            self.send();
            let waits = [self.requestor.poll_timeout(), self.responder.poll_timeout()];
            let Some(next) = waits.into_iter().flatten().min() else {
                assert_eq!(self.ended.len(), self.calls.len(), "a call without an end");
                // No timeout is scheduled for the release of completed requests.
                self.responder.handle_timeout(self.now + REMEMBER);
                assert_eq!(self.responder.held(), (0, 0));
                return;
            };
            self.now = next;
        }
        panic!("they never fall silent");
    }
}

/// Stores a sent message, up to the limit.
fn keep(sent: &mut Vec<Vec<u8>>, message: &ActionToSend<'_>) {
    let mut datagram = Vec::new();
    message
        .encode(&mut datagram, &NetworkHeader::default(), &Extras::default())
        .and_then(|encoder| encoder.finish())
        .expect("what is due can be written");
    if sent.len() < MESSAGES {
        sent.push(datagram);
    }
}
