//! Property tests of calls with any set of programs in a group that loses, duplicates, delays and
//! reorders datagrams.
//!
//! A program may end at any time and may be restarted. A request is executed at most once in all
//! instances of a program, only by the program in its name, and never by the requesting program
//! itself. The requestor receives the true outcome, and no requests or responses are sent
//! afterwards. The programs are bridges of ROS 1 and ROS 2, which offer and request calls with the
//! type of a service, and programs with fields as payload.
use crate::cell;

use std::collections::BTreeMap;
use std::sync::Arc;

use bridge_core::{
    AskErrorKind, AskId, CallDescription, CallField, CallRole, Executed, Local, OfferedCall,
    OfferedType, Reason,
};
use cell::{SimulatedCell, SimulatedProgram, block, is_action, ms, topic};
use mappings::TopicId;
use messages::{Dialect, ServiceType, TypeRegistry};
use proptest::prelude::*;
use uadp::{BuiltinType, Scalar, Variant};

/// The behavior of the group: lost, duplicated and delayed datagrams per mille, and whether
/// datagrams are reordered.
#[derive(Debug, Clone, Copy)]
struct Weather {
    lost: u32,
    doubled: u32,
    late: u32,
    reorders: bool,
    seed: u32,
}

/// Returns a pseudorandom number below 1000 (xorshift).
const fn drawn(seed: &mut u32) -> u32 {
    *seed ^= *seed << 13;
    *seed ^= *seed >> 17;
    *seed ^= *seed << 5;
    *seed % 1_000
}

fn weather() -> impl Strategy<Value = Weather> {
    let fair = Just((0, 0, 0));
    let rough = (0_u32..400, 0_u32..400, 0_u32..400);
    (prop_oneof![fair, rough], any::<bool>(), 1_u32..).prop_map(
        |((lost, doubled, late), reorders, seed)| Weather {
            lost,
            doubled,
            late,
            reorders,
            seed,
        },
    )
}

impl Weather {
    fn fill(self, cell: &mut SimulatedCell) {
        let Self {
            lost,
            doubled,
            late,
            reorders,
            mut seed,
        } = self;
        let mut other = !seed | 1;
        cell.reorders = reorders;
        cell.copies = Box::new(move |_| match drawn(&mut seed) {
            drawn if drawn < lost => 0,
            drawn if drawn < lost + doubled => 2,
            _ => 1,
        });
        cell.delay = Box::new(move || match drawn(&mut other) {
            drawn if drawn < late => ms(u64::from(drawn) + 1),
            _ => ms(0),
        });
    }
}

fn description() -> CallDescription {
    CallDescription {
        name: "Echo".to_owned(),
        about: String::new(),
        role: CallRole::Call,
        request: vec![CallField::scalar("number", BuiltinType::UInt32)],
        response: vec![CallField::scalar("number", BuiltinType::UInt32)],
    }
}

/// Returns a request or response in the encoding of the local side. Each ends with the four bytes
/// of the number.
fn number(local: Local, number: u32) -> Vec<u8> {
    match local {
        Local::Fields => block(&[Variant::Scalar(Scalar::UInt32(number))]),
        Local::Ros1 => number.to_le_bytes().to_vec(),
        Local::Cdr => [[0, 1, 0, 0], number.to_le_bytes()].concat(),
    }
}

fn service(dialect: Dialect) -> Arc<ServiceType> {
    let name = "t/Echo".parse().unwrap();
    let mut registry = TypeRegistry::empty(dialect);
    registry
        .add_service(&name, "uint32 number\n---\nuint32 number\n")
        .unwrap();
    registry.service(&name).unwrap()
}

/// Offers the call of a program, and binds the calls of the other programs with the type of its
/// local side.
fn join(cell: &mut SimulatedCell, (at, local): (usize, Local), own: TopicId, others: &[TopicId]) {
    let dialect = match local {
        Local::Fields => {
            let description = description();
            return cell.offer(
                at,
                own,
                OfferedCall {
                    description,
                    open: false,
                },
            );
        }
        Local::Ros1 => Dialect::Ros1,
        Local::Cdr => Dialect::Ros2,
    };
    let now = cell.now();
    let offered = OfferedType {
        service_type: service(dialect),
        name: "Echo".to_owned(),
        about: String::new(),
        role: CallRole::Call,
        open: false,
    };
    let router = &mut cell.programs[at].router;
    router.offer_type(own, &offered, now).unwrap();
    for other in others.iter().filter(|other| **other != own) {
        let bound = router.bind_call(*other, (&offered.service_type, &Arc::default()), now);
        bound.unwrap();
    }
    cell.drain(at);
}

fn actions(cell: &mut SimulatedCell) -> usize {
    let all = 0..cell.programs.len();
    all.map(|at| {
        let sent = cell.datagrams_of(at);
        sent.iter().filter(|bytes| is_action(bytes)).count()
    })
    .sum()
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    #[test]
    fn a_request_is_executed_at_most_once_and_where_its_name_says(
        spaces in proptest::collection::btree_set(0_u16..=232, 1..=5),
        asked in proptest::collection::vec((any::<proptest::sample::Index>(), any::<proptest::sample::Index>()), 1..12),
        sides in proptest::array::uniform5(prop_oneof![Just(Local::Fields), Just(Local::Ros1), Just(Local::Cdr)]),
        weather in weather(),
        death in proptest::option::of((any::<proptest::sample::Index>(), 0_u32..20, any::<bool>())),
    ) {
        let death = death.map(|(who, when, again)| (who.index(spaces.len()), when, again));
        let dies = |at: usize| death.is_some_and(|(who, ..)| who == at);
        let spaces: Vec<u16> = spaces.into_iter().collect();
        let programs = spaces.iter().zip(sides).map(|(space, local)| SimulatedProgram::new(*space, local));
        let mut cell = SimulatedCell::new(programs.collect());
        let call = |at: usize| topic(spaces[at], 5, 61);
        let all: Vec<TopicId> = (0..spaces.len()).map(call).collect();
        for (at, (own, local)) in all.iter().zip(sides).enumerate() {
            join(&mut cell, (at, local), *own, &all);
        }
        cell.run(ms(300));
        for at in 0..spaces.len() {
            prop_assert_eq!(cell.known(at).len(), spaces.len() - 1);
        }
        weather.fill(&mut cell);

        let mut answers: BTreeMap<u32, Vec<_>> = BTreeMap::new();
        // By request: the executing program and its instance.
        let mut executed: BTreeMap<u32, Vec<(usize, u32)>> = BTreeMap::new();
        let mut lives = vec![0_u32; spaces.len()];
        let mut wanted = BTreeMap::new();
        for (id, (asker, executor)) in (0_u32..).zip(&asked) {
            let (asker, executor) = (asker.index(spaces.len()), executor.index(spaces.len()));
            cell.ask(asker, AskId(id.into()), (call(executor), &number(sides[asker], id)), ms(3_000));
            wanted.insert(id, (asker, executor));
        }
        for turn in 0..100 {
            cell.run(ms(50));
            match death {
                Some((who, when, _)) if turn == when => cell.kill(who),
                Some((who, when, true)) if turn == when + 5 => {
                    let port = 30_000 + u16::try_from(who).unwrap();
                    cell.start(who, SimulatedProgram::new(spaces[who], sides[who]).at_port(port));
                    join(&mut cell, (who, sides[who]), all[who], &all);
                    lives[who] += 1;
                }
                _ => {}
            }
            for (at, life) in lives.iter().enumerate() {
                for execution in cell.executions(at) {
                    prop_assert_eq!(execution.topic, call(at), "never anywhere else");
                    let id = u32::from_le_bytes(*execution.request.last_chunk().unwrap());
                    prop_assert_eq!(execution.requestor.map(|space| u16::from(space.get())), Some(spaces[wanted[&id].0]));
                    executed.entry(id).or_default().push((at, *life));
                    cell.executed(at, execution.id, Executed::Answered(execution.request));
                }
                for (ask, answer) in cell.answers(at) {
                    let id = u32::try_from(ask.0).unwrap();
                    prop_assert_eq!(wanted[&id].0, at, "nobody else is told");
                    answers.entry(id).or_default().push(answer);
                }
            }
        }
        for (id, (asker, executor)) in wanted {
            let told = answers.get(&id).cloned().unwrap_or_default();
            let done = executed.get(&id).cloned().unwrap_or_default();
            prop_assert!(done.len() <= 1, "at most once in all lives: {:?}", done);
            prop_assert!(told.len() == 1 || told.is_empty() && dies(asker));
            let Some(told) = told.first() else { continue };
            match told {
                Ok(response) => {
                    prop_assert_eq!(response, &number(sides[asker], id));
                    prop_assert!(done.iter().any(|(at, _)| *at == executor));
                }
                Err(error) if asker == executor => {
                    prop_assert_eq!(error.kind, AskErrorKind::Refused);
                    prop_assert!(done.is_empty(), "never at home");
                }
                Err(error) => {
                    prop_assert_eq!(error.kind, AskErrorKind::Unknown);
                    prop_assert!(weather.lost > 0 || dies(executor), "{}", error);
                }
            }
        }
        for at in 0..spaces.len() {
            // Announcements of a program that was restarted at another port are accepted only after
            // its previous instance is lost.
            let doubts = death.is_some_and(|(who, _, again)| again && who != at);
            prop_assert!(cell.dropped(at, Reason::Forged) == 0 || doubts);
        }
        // Responses without acknowledgement are repeated for a while.
        cell.run(ms(15_000));
        let before = actions(&mut cell);
        cell.run(ms(10_000));
        prop_assert_eq!(actions(&mut cell), before, "silence");
    }
}
