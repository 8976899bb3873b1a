//! Requestors and a Responder over a network that loses, duplicates, delays and reorders messages.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use proptest::prelude::*;
use uadp::action::{
    ActionFields, ActionOutcome, CallId, ExecutionId, FinishRefusal, Refusal, Requestor,
    RequestorSettings, RequiredAction, Responder, ResponderSettings, ResponseMeaning,
};
use uadp::{OwnedPublisherId, StatusCode};

use super::STANDARD;
use super::peers::{block, message, number, request, requests, responses};

#[derive(Debug, Clone, Copy)]
struct Network {
    /// Probability of loss in percent.
    loss: u64,
    doubled: u64,
    /// Maximum delay in milliseconds.
    delay: u64,
}

/// Random numbers for the next event of the network.
struct Dice(u64);

impl Dice {
    fn roll(&mut self, sides: u64) -> u64 {
        self.0 = self
            .0
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 33) % sides
    }
}

#[derive(Debug, Clone)]
struct Call {
    requestor: usize,
    /// Start and timeout in milliseconds.
    at: u64,
    timeout: u64,
    work: Work,
}

#[derive(Debug, Clone, Copy)]
enum Work {
    Answer { takes: u64 },
    Fail { takes: u64 },
    Refuse,
    NeverEnds,
}

struct World {
    requestors: Vec<Requestor>,
    responder: Responder<u16>,
    network: Network,
    dice: Dice,
    now: Duration,
    /// Datagrams under way, by arrival: to the Responder, or to all Requestors.
    under_way: BTreeMap<(Duration, u64), (bool, Vec<u8>)>,
    sent: u64,
    /// Running executions, by their end.
    working: BTreeSet<(Duration, ExecutionId, usize)>,
    calls: Vec<Call>,
    begun: usize,
    ids: BTreeMap<(usize, CallId), usize>,
    executed: Vec<u32>,
    outcomes: Vec<Vec<LinkEvent>>,
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum LinkEvent {
    Answered(StatusCode, i32),
    Failed(StatusCode),
    Refused(Refusal),
    Unknown,
}

const BAD_DEVICE_FAILURE: StatusCode = StatusCode(0x808B_0000);

impl World {
    fn new(network: Network, seed: u64, mut calls: Vec<Call>) -> Self {
        calls.sort_by_key(|call| call.at);
        let requestor = |id: u16| {
            Requestor::new(
                OwnedPublisherId::UInt16(id),
                [7; 16],
                RequestorSettings::default(),
            )
        };
        Self {
            requestors: vec![requestor(1), requestor(3)],
            responder: Responder::new(ResponderSettings {
                max_executing: 4,
                ..ResponderSettings::default()
            }),
            network,
            dice: Dice(seed),
            now: Duration::ZERO,
            under_way: BTreeMap::new(),
            sent: 0,
            working: BTreeSet::new(),
            executed: vec![0; calls.len()],
            outcomes: vec![Vec::new(); calls.len()],
            calls,
            begun: 0,
            ids: BTreeMap::new(),
        }
    }

    /// Runs until no further event is due. Returns the number of steps.
    fn run(&mut self) -> usize {
        for step in 0..100_000 {
            self.transmit();
            let Some(next) = self.next_time() else {
                return step;
            };
            self.now = self.now.max(next);
            self.begin_calls();
            self.deliver();
            self.work();
            self.tell_given_up();
        }
        panic!("it never ends");
    }

    fn next_time(&self) -> Option<Duration> {
        let call = self
            .calls
            .get(self.begun)
            .map(|call| Duration::from_millis(call.at));
        let arrival = self.under_way.first_key_value().map(|((at, _), _)| *at);
        let work = self.working.first().map(|(at, ..)| *at);
        let requestors = self.requestors.iter().filter_map(Requestor::poll_timeout);
        let times = [call, arrival, work, self.responder.poll_timeout()];
        times.into_iter().flatten().chain(requestors).min()
    }

    fn begin_calls(&mut self) {
        while let Some(call) = self.calls.get(self.begun)
            && Duration::from_millis(call.at) <= self.now
        {
            let arguments = block(i32::try_from(self.begun).unwrap());
            let request = request(&arguments, Duration::from_millis(call.timeout));
            let id = self.requestors[call.requestor]
                .call(request, self.now)
                .unwrap();
            self.ids.insert((call.requestor, id), self.begun);
            self.begun += 1;
        }
    }

    fn transmit(&mut self) {
        for index in 0..self.requestors.len() {
            for datagram in requests(&mut self.requestors[index], self.now) {
                self.send(true, datagram);
            }
        }
        for datagram in responses(&mut self.responder, self.now) {
            self.send(false, datagram);
        }
    }

    fn send(&mut self, to_responder: bool, datagram: Vec<u8>) {
        let copies = match self.dice.roll(100) {
            roll if roll < self.network.loss => 0,
            roll if roll < self.network.loss + self.network.doubled => 2,
            _ => 1,
        };
        for _ in 0..copies {
            let delay = Duration::from_millis(self.dice.roll(self.network.delay + 1));
            self.sent += 1;
            let key = (self.now + delay, self.sent);
            self.under_way.insert(key, (to_responder, datagram.clone()));
        }
    }

    fn deliver(&mut self) {
        while let Some(first) = self.under_way.first_entry()
            && first.key().0 <= self.now
        {
            let (to_responder, datagram) = first.remove();
            if to_responder {
                self.request_arrives(&datagram)
            } else {
                self.response_arrives(&datagram)
            }
        }
    }

    fn request_arrives(&mut self, datagram: &[u8]) {
        let now = self.now;
        let responder = &mut self.responder;
        let (requested, call) = message(datagram, STANDARD, |request| {
            let call = match request.fields {
                ActionFields::NONE => None,
                ActionFields::Variants(_) | ActionFields::RawData { .. } => {
                    Some(usize::try_from(number(request.fields)).unwrap())
                }
            };
            (responder.handle_request(request, 0, now), call)
        });
        let Ok(RequiredAction::Execute(execution)) = requested else {
            return;
        };
        let call = call.unwrap();
        match self.calls[call].work {
            Work::Refuse => {
                self.responder
                    .refuse(execution, Refusal::NotAllowed, now)
                    .unwrap();
                return;
            }
            Work::Answer { takes } | Work::Fail { takes } => {
                let end = now + Duration::from_millis(takes);
                self.working.insert((end, execution, call));
            }
            Work::NeverEnds => {}
        }
        self.executed[call] += 1;
    }

    fn work(&mut self) {
        while let Some((end, execution, call)) = self.working.first().copied()
            && end <= self.now
        {
            self.working.pop_first();
            let result = block(-i32::try_from(call).unwrap());
            let outcome = match self.calls[call].work {
                Work::Fail { .. } => ActionOutcome::Answered {
                    status: BAD_DEVICE_FAILURE,
                    fields: ActionFields::NONE,
                },
                Work::Answer { .. } | Work::Refuse | Work::NeverEnds => ActionOutcome::Answered {
                    status: StatusCode::GOOD,
                    fields: ActionFields::Variants(&result),
                },
            };
            match self.responder.finish(execution, outcome, self.now) {
                // The Requestor has stopped waiting.
                Ok(()) | Err(FinishRefusal::Abandoned | FinishRefusal::Forgotten) => {}
                Err(refusal) => panic!("{refusal}"),
            }
        }
    }

    fn response_arrives(&mut self, datagram: &[u8]) {
        for (index, requestor) in self.requestors.iter_mut().enumerate() {
            let now = self.now;
            message(datagram, STANDARD, |response| {
                if let Ok(ResponseMeaning::Done(id, outcome)) =
                    requestor.handle_response(response, now)
                {
                    let call = self.ids[&(index, id)];
                    let told = match outcome {
                        ActionOutcome::Answered { status, fields }
                            if fields == ActionFields::NONE =>
                        {
                            LinkEvent::Failed(status)
                        }
                        ActionOutcome::Answered { status, fields } => {
                            LinkEvent::Answered(status, number(fields))
                        }
                        ActionOutcome::Refused(refusal) => LinkEvent::Refused(refusal),
                        ActionOutcome::Unknown(_) => LinkEvent::Unknown,
                    };
                    self.outcomes[call].push(told);
                }
            });
        }
    }

    fn tell_given_up(&mut self) {
        for (index, requestor) in self.requestors.iter_mut().enumerate() {
            requestor.handle_timeout(self.now);
            while let Some((id, _)) = requestor.poll_given_up() {
                self.outcomes[self.ids[&(index, id)]].push(LinkEvent::Unknown);
            }
        }
    }

    fn check(&self) {
        for (call, outcomes) in self.outcomes.iter().enumerate() {
            let executed = self.executed[call];
            assert!(executed <= 1, "call {call} executed {executed} times");
            let [told] = outcomes[..] else {
                panic!("call {call} told {outcomes:?}")
            };
            let work = self.calls[call].work;
            match told {
                LinkEvent::Answered(status, result) => {
                    assert!(matches!(work, Work::Answer { .. }), "{work:?}");
                    assert_eq!(status, StatusCode::GOOD);
                    assert_eq!(result, -i32::try_from(call).unwrap());
                    assert_eq!(executed, 1);
                }
                LinkEvent::Failed(status) => {
                    assert!(matches!(work, Work::Fail { .. }), "{work:?}");
                    assert_eq!((status, executed), (BAD_DEVICE_FAILURE, 1));
                }
                LinkEvent::Refused(Refusal::NotAllowed) => {
                    assert!(matches!(work, Work::Refuse), "{work:?}");
                    assert_eq!(executed, 0);
                }
                LinkEvent::Refused(refusal) => {
                    assert_eq!((refusal, executed), (Refusal::Busy, 0), "call {call}");
                }
                LinkEvent::Unknown => {}
            }
        }
        for requestor in &self.requestors {
            assert_eq!(
                (requestor.open_calls(), requestor.poll_timeout()),
                (0, None)
            );
        }
        assert_eq!(self.responder.held(), (0, 0));
        assert_eq!(self.responder.poll_timeout(), None);
    }
}

fn call() -> impl Strategy<Value = Call> {
    let work = prop_oneof![
        4 => (0..1500_u64).prop_map(|takes| Work::Answer { takes }),
        1 => (0..500_u64).prop_map(|takes| Work::Fail { takes }),
        1 => Just(Work::Refuse),
        1 => Just(Work::NeverEnds),
    ];
    (0..2_usize, 0..4000_u64, 1..5000_u64, work).prop_map(|(requestor, at, timeout, work)| Call {
        requestor,
        at,
        timeout,
        work,
    })
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(200))]

    #[test]
    fn every_call_is_executed_once_at_most_and_told_right_however_bad_the_network(
        loss in 0..70_u64,
        doubled in 0..30_u64,
        // Shorter than the memory of the Responder.
        delay in prop_oneof![0..50_u64, 0..1000_u64, 0..9000_u64],
        seed in any::<u64>(),
        calls in prop::collection::vec(call(), 1..12),
    ) {
        let mut world = World::new(Network { loss, doubled, delay }, seed, calls);
        let steps = world.run();
        prop_assert!(steps < 20_000, "{steps}");
        world.check();
    }

    #[test]
    fn a_good_network_answers_every_call_in_time(
        delay in 0..20_u64,
        seed in any::<u64>(),
        calls in prop::collection::vec(call(), 1..5),
    ) {
        let mut calls = calls;
        for call in &mut calls {
            call.timeout += 2000;
            if let Work::NeverEnds = call.work {
                call.work = Work::Refuse;
            }
        }
        let network = Network { loss: 0, doubled: 0, delay };
        let mut world = World::new(network, seed, calls);
        world.run();
        world.check();
        let unknown = world.outcomes.iter().filter(|told| told.contains(&LinkEvent::Unknown));
        prop_assert_eq!(unknown.count(), 0);
    }
}
