//! Redundant bridges of a space between a reader and a commander, with a manual clock: each value
//! arrives at most once and in order, whatever stops.

use std::collections::VecDeque;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use bridge_core::{
    KeyDelivery, Local, LocalMessage, Now, Output, Reason, RedundancyRank, RedundancyRole, Router,
    RouterSettings, ValueRelation,
};
use mappings::{Mapping, SpaceId, TopicId};
use messages::{Dialect, Selection, TypeRegistry};
use uadp::{BuiltinType, NetworkMessage, SecurityPolicy, Timestamp, TokenKeys};

const A: usize = 0;
const B: usize = 1;
/// The bridge of space 1.
const READER: usize = 2;
/// A program of space 0.
const COMMANDER: usize = 3;

const MEASURED: &str = "ua_2_5_10";
const COMMAND: &str = "ua_0_5_20";
/// A command with a reaction to the loss of its commander.
const DRIVE: &str = "ua_0_5_21";
const STATE: &str = "ua_2_5_11";
const TARGET: &str = "ua_1_5_12";

const CELL: &str = "
spaces: [{id: 1}, {id: 2}]
namespaces: {5: urn:x}
variables:
  - {node: ns=5;i=10, name: Measured, origin: 2, queue: {drop_oldest: 1000}, ros: [{topic: /a, type: std_msgs/UInt32}, {space: 1, topic: /a, type: std_msgs/UInt32}]}
  - {node: ns=5;i=11, name: State, origin: 2, queue: keep_latest, ros: [{topic: /b, type: std_msgs/UInt32}, {space: 1, topic: /b, type: std_msgs/UInt32}]}
  - {node: ns=5;i=12, name: Target, origin: 1, queue: keep_latest, ros: [{topic: /c, type: std_msgs/UInt32}, {space: 2, topic: /c, type: std_msgs/UInt32}]}
  - {node: ns=5;i=20, name: Command, origin: 0, ros: [{space: 1, topic: /d, type: std_msgs/UInt32}, {space: 2, topic: /d, type: std_msgs/UInt32}]}
  - {node: ns=5;i=21, name: Drive, origin: 0, on_loss: {data: 0}, ros: {space: 2, topic: /e, type: std_msgs/UInt32}}
";

fn topic(text: &str) -> TopicId {
    text.parse().unwrap()
}

fn mapping(text: &str) -> Arc<Mapping> {
    let checked = Mapping::from_yaml(text, "cell.yaml");
    let told = checked.render_all();
    Arc::new(checked.mapping.unwrap_or_else(|| panic!("{told}")))
}

/// A deterministic sequence of random numbers.
struct Random(u64);

impl Random {
    fn below(&mut self, limit: u64) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut mixed = self.0;
        mixed = (mixed ^ (mixed >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        mixed = (mixed ^ (mixed >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        (mixed ^ (mixed >> 31)) % limit
    }
}

/// A value that a program published on its local side.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Published {
    at: u64,
    by: usize,
    topic: TopicId,
    value: u32,
    kept: ValueRelation,
}

struct Program {
    router: Router,
    address: SocketAddr,
    /// The difference between its clock and true time in nanoseconds.
    skew: i128,
    /// It does not run before this time.
    stopped: u64,
    is_dead: bool,
    socket: Vec<(u64, SocketAddr, Vec<u8>)>,
    local: VecDeque<(TopicId, Vec<u8>)>,
    sent: u64,
}

struct World {
    started: Instant,
    passed: u64,
    programs: Vec<Program>,
    published: Vec<Published>,
    random: Random,
    /// Every n-th datagram is lost for a receiver; 0 for none.
    losses: u64,
}

fn program(space: u16, port: u16, mapping: &Arc<Mapping>, now: Now) -> Program {
    let address = SocketAddr::from(([127, 0, 0, 1], port));
    let local = match space {
        0 => Local::Fields,
        1 => Local::Ros1,
        _ => Local::Cdr,
    };
    let settings = RouterSettings {
        own: SpaceId::new(space).unwrap(),
        local,
        source: Some(address),
    };
    let mut router = Router::new(settings, Arc::clone(mapping));
    let [low, high] = port.to_le_bytes();
    router.set_instance([
        low, high, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, low, high,
    ]);
    let dialect = match space {
        1 => Dialect::Ros1,
        _ => Dialect::Ros2,
    };
    if space != 0 {
        let number = TypeRegistry::bundle(dialect).get(&"std_msgs/UInt32".parse().unwrap());
        let number = number.unwrap();
        let only = [DRIVE].into_iter().filter(|_| space == 2);
        for of in [MEASURED, STATE, TARGET, COMMAND].into_iter().chain(only) {
            router
                .bind(topic(of), &number, &Selection::Whole, now)
                .unwrap();
        }
    }
    Program {
        router,
        address,
        skew: 0,
        stopped: 0,
        is_dead: false,
        socket: Vec::new(),
        local: VecDeque::new(),
        sent: 0,
    }
}

#[expect(clippy::disallowed_methods, reason = "some instant to count from")]
fn instant() -> Instant {
    Instant::now()
}

impl World {
    fn new(text: &str, seed: u64) -> Self {
        let started = instant();
        let mapping = mapping(text);
        let mut world = Self {
            started,
            passed: 0,
            programs: Vec::new(),
            published: Vec::new(),
            random: Random(seed),
            losses: 0,
        };
        let now = world.time(0);
        world.programs = vec![
            program(2, 10_002, &mapping, now),
            program(2, 10_012, &mapping, now),
            program(1, 10_001, &mapping, now),
            program(0, 10_000, &mapping, now),
        ];
        for (at, rank) in [(A, 1), (B, 2)] {
            let rank = RedundancyRank::new(rank).unwrap();
            world.programs[at].router.set_redundancy(rank, now);
        }
        world.programs[B].skew = 3_000_000;
        world
    }

    fn time(&self, skew: i128) -> Now {
        let passed = Duration::from_millis(self.passed);
        let nanos = i128::try_from(passed.as_nanos()).unwrap() + skew;
        Now {
            monotonic: self.started + passed,
            utc: Timestamp::from_unix_nanos(1_700_000_000_000_000_000 + nanos),
        }
    }

    fn now(&self, of: usize) -> Now {
        self.time(self.programs[of].skew)
    }

    /// Publishes a value on the local side of a space.
    fn say(&mut self, of: &str, value: u32) {
        let of = topic(of);
        for program in &mut self.programs {
            let space = program.router.redundancy().map_or(0, |_| 2);
            let own = match program.address.port() {
                10_001 => 1,
                _ => space,
            };
            if u16::from(of.space.get()) != own || program.is_dead {
                continue;
            }
            let payload = match own {
                0 => field(value),
                1 => value.to_le_bytes().to_vec(),
                _ => [&[0, 1, 0, 0], &value.to_le_bytes()[..]].concat(),
            };
            program.local.push_back((of, payload));
        }
    }

    fn run(&mut self, milliseconds: u64) {
        for _ in 0..milliseconds {
            self.passed += 1;
            for at in 0..self.programs.len() {
                if self.programs[at].stopped <= self.passed && !self.programs[at].is_dead {
                    self.step(at);
                }
            }
        }
    }

    fn step(&mut self, at: usize) {
        let now = self.now(at);
        for _ in 0..32 {
            let socket = &mut self.programs[at].socket;
            let Some(first) = socket.iter().position(|(time, ..)| *time <= self.passed) else {
                break;
            };
            let (_, from, bytes) = socket.remove(first);
            self.programs[at].router.handle_datagram(&bytes, from, now);
            self.drain(at);
        }
        while let Some((topic, payload)) = self.programs[at].local.pop_front() {
            let heard = LocalMessage {
                topic,
                payload: &payload,
                received: now.utc,
                latched_by: None,
            };
            let _verdict = self.programs[at].router.handle_local(heard, now);
            self.drain(at);
        }
        let due = self.programs[at].router.poll_timeout();
        if due.is_some_and(|due| due <= now.monotonic) {
            self.programs[at].router.handle_timeout(now);
        }
        self.drain(at);
    }

    fn drain(&mut self, at: usize) {
        let now = self.now(at);
        while let Some(output) = self.programs[at].router.poll_output(now) {
            match output {
                Output::Heartbeat { bytes } => {
                    // A value has a group.
                    let message = NetworkMessage::decode(&bytes).unwrap();
                    assert!(message.group().is_none(), "a heartbeat without a value");
                    self.send(at, &bytes);
                    self.programs[at].router.heartbeat_sent(true, now);
                }
                Output::Datagram { bytes, .. } => {
                    self.programs[at].sent += 1;
                    self.send(at, &bytes);
                }
                Output::Discovery { bytes } | Output::Action { bytes, .. } => self.send(at, &bytes),
                Output::Delivery(delivery) => {
                    let bytes = *delivery.payload.last_chunk().unwrap();
                    self.published.push(Published {
                        at: self.passed,
                        by: at,
                        topic: delivery.topic,
                        value: u32::from_le_bytes(bytes),
                        kept: delivery.kept,
                    });
                    let router = &mut self.programs[at].router;
                    router.published(delivery.topic, delivery.arrived, now);
                }
                _ => {}
            }
        }
    }

    fn send(&mut self, from: usize, bytes: &[u8]) {
        let sender = self.programs[from].address;
        for to in 0..self.programs.len() {
            if self.losses != 0 && to != from && self.random.below(self.losses) == 0 {
                continue;
            }
            let arrival = self.passed + 1;
            self.programs[to]
                .socket
                .push((arrival, sender, bytes.to_vec()));
        }
    }

    fn role(&self, of: usize) -> RedundancyRole {
        self.programs[of].router.redundancy().unwrap().role()
    }

    /// Returns the first datagram of a command, which no program has received yet.
    fn command(&mut self, value: u32) -> Vec<u8> {
        let now = self.now(COMMANDER);
        let heard = LocalMessage {
            topic: topic(COMMAND),
            payload: &field(value),
            received: now.utc,
            latched_by: None,
        };
        let router = &mut self.programs[COMMANDER].router;
        let _verdict = router.handle_local(heard, now);
        let mut first = Vec::new();
        while let Some(output) = router.poll_output(now) {
            if let Output::Datagram { bytes, .. } = output {
                first = bytes;
            }
        }
        first
    }

    /// Returns the active bridge. A stopped bridge still has its former role.
    fn active(&self) -> usize {
        let runs = !self.programs[A].is_dead && self.programs[A].stopped <= self.passed;
        match self.role(A) {
            RedundancyRole::Active if runs || self.role(B) != RedundancyRole::Active => A,
            _ => B,
        }
    }

    /// Returns the values that were published for a topic, for present subscribers.
    fn values(&self, of: &str) -> Vec<u32> {
        let of = topic(of);
        let new = self.published.iter().filter(|one| {
            one.by != COMMANDER && one.topic == of && one.kept != ValueRelation::Again
        });
        new.map(|one| one.value).collect()
    }

    fn dropped(&self, at: usize, reason: Reason) -> u64 {
        let router = &self.programs[at].router;
        let topics: u64 = router
            .topics()
            .map(|(_, counters)| counters.dropped(reason))
            .sum();
        topics + router.others().dropped(reason)
    }
}

fn field(value: u32) -> Vec<u8> {
    let mut block = 1_u16.to_le_bytes().to_vec();
    block.push(BuiltinType::UInt32.id());
    block.extend_from_slice(&value.to_le_bytes());
    block
}

fn assert_rising(values: &[u32], about: &str) {
    for pair in values.windows(2) {
        assert!(pair[0] < pair[1], "{about}: {} after {}", pair[1], pair[0]);
    }
}

#[test]
fn random_stops_double_no_value_and_no_command_and_keep_their_order() {
    let mut gaps = Vec::new();
    for seed in 0..60 {
        let mut world = World::new(CELL, seed);
        // Some worlds lose datagrams.
        world.losses = [0, 0, 50][usize::try_from(seed % 3).unwrap()];
        world.run(700);
        assert_eq!(world.active(), A);
        let mut value = 0;
        let mut unserved = Vec::new();
        for _ in 0..6 {
            let passed = world.passed;
            let at = world.active();
            let stop = [40, 75, 90, 130, 400, 1_500];
            let index = usize::try_from(world.random.below(6)).unwrap();
            let begin = world.random.below(200);
            let end = 700 + world.random.below(1_500);
            for millisecond in 0..end {
                if millisecond == begin {
                    world.programs[at].stopped = passed + begin + stop[index];
                }
                value += 1;
                world.say(MEASURED, value);
                if [A, B]
                    .iter()
                    .all(|of| world.programs[*of].stopped > passed + millisecond)
                {
                    unserved.push(value);
                }
                if millisecond % 7 == 0 {
                    world.say(COMMAND, value);
                }
                world.run(1);
            }
        }
        let measured = world.values(MEASURED);
        let commands = world.values(COMMAND);
        assert_rising(&measured, &format!("seed {seed}, values"));
        let of_robots: Vec<u32> = (world.published.iter())
            .filter(|one| one.topic == topic(COMMAND) && one.by != READER)
            .map(|one| one.value)
            .collect();
        assert_rising(&of_robots, &format!("seed {seed}, commands"));
        assert!(
            commands.len() > of_robots.len(),
            "space 1 receives them too"
        );
        assert!(measured.len() > usize::try_from(value).unwrap() / 2);
        // No bridge can take over while both are stopped.
        let is_served = |pair: &&[u32]| !unserved.iter().any(|of| pair[0] < *of && *of < pair[1]);
        gaps.extend(
            measured
                .windows(2)
                .filter(is_served)
                .map(|pair| pair[1] - pair[0])
                .filter(|gap| *gap > 10),
        );
    }
    gaps.sort_unstable();
    assert!(gaps.len() > 100, "{}", gaps.len());
    println!(
        "{} gaps: median {} values, largest {} values at 1 kHz",
        gaps.len(),
        gaps[gaps.len() / 2],
        gaps[gaps.len() - 1]
    );
    assert!(gaps[gaps.len() - 1] <= 400, "{gaps:?}");
}

#[test]
fn a_standby_sends_only_heartbeats_and_probes_and_continues_the_numbers() {
    let mut world = World::new(CELL, 1);
    world.run(700);
    for value in 1..=500 {
        world.say(MEASURED, value);
        world.say(STATE, value);
        world.run(1);
    }
    assert_eq!(
        (world.role(A), world.role(B)),
        (RedundancyRole::Active, RedundancyRole::Standby)
    );
    assert_eq!(world.programs[B].sent, 0);
    let muted = world.programs[B].router.muted_samples().unwrap();
    assert!(muted.sent >= 900, "{muted:?}");
    world.programs[A].is_dead = true;
    for value in 501..=1_000 {
        world.say(MEASURED, value);
        world.run(1);
    }
    assert_eq!(world.role(B), RedundancyRole::Active);
    let measured = world.values(MEASURED);
    assert_rising(&measured, "values");
    assert_eq!(measured.last(), Some(&999));
    let lost = 999 - measured.len();
    assert!((50..=150).contains(&lost), "{lost} values lost");
    let counted = world.dropped(B, Reason::Takeover);
    assert!(
        counted >= u64::try_from(lost).unwrap() && counted <= 160,
        "{counted} for {lost}"
    );
    assert_eq!(world.dropped(READER, Reason::Stale), 0);
}

#[test]
fn a_state_is_repeated_by_the_new_bridge_and_delivered_once() {
    let mut world = World::new(CELL, 2);
    world.run(700);
    world.say(STATE, 7);
    world.say(TARGET, 70);
    world.run(2_500);
    assert_eq!(world.values(STATE), [7]);
    world.programs[A].is_dead = true;
    world.run(4_000);
    assert_eq!(world.role(B), RedundancyRole::Active);
    // The new bridge repeats it under the stamp of the former one.
    assert_eq!(world.values(STATE), [7]);
    assert!(world.programs[B].sent > 0);
    // The state of the other space is there for late joiners of the new bridge.
    let target = topic(TARGET);
    let of_b = world
        .published
        .iter()
        .filter(|one| one.by == B && one.topic == target);
    let kept: Vec<(u32, ValueRelation)> = of_b.map(|one| (one.value, one.kept)).collect();
    assert_eq!(kept, [(70, ValueRelation::Again)]);
}

#[test]
fn a_bridge_that_is_active_again_has_the_states_for_late_joiners() {
    let mut world = World::new(CELL, 13);
    world.run(700);
    world.say(TARGET, 70);
    world.run(2_500);
    let of_a = |world: &World| -> Vec<(u32, ValueRelation)> {
        let published = world.published.iter();
        let published = published.filter(|one| one.by == A && one.topic == topic(TARGET));
        published.map(|one| (one.value, one.kept)).collect()
    };
    assert_eq!(of_a(&world), [(70, ValueRelation::Alone)]);
    // The other bridge takes over, and ends later.
    world.programs[A].stopped = world.passed + 500;
    world.run(3_000);
    assert_eq!(
        (world.role(A), world.role(B)),
        (RedundancyRole::Standby, RedundancyRole::Active)
    );
    world.programs[B].is_dead = true;
    world.run(3_000);
    assert_eq!(world.role(A), RedundancyRole::Active);
    assert_eq!(
        of_a(&world),
        [(70, ValueRelation::Alone), (70, ValueRelation::Again)]
    );
    // No other bridge takes over.
    world.programs[A].stopped = world.passed + 500;
    world.run(3_000);
    assert_eq!(world.role(A), RedundancyRole::Active);
    assert_eq!(of_a(&world).len(), 3);
    assert_eq!(of_a(&world).last(), Some(&(70, ValueRelation::Again)));
}

/// Two redundant servers with clients that write [`STATE`].
fn servers(text: &str, seed: u64) -> World {
    let mut world = World::new(text, seed);
    for at in [A, B] {
        let now = world.now(at);
        let router = &mut world.programs[at].router;
        router.show_values_at_standby();
        router.set_live(topic(STATE), true, now);
    }
    world
}

/// Writes a value as a client of a server. Clients write to the active server only.
fn write(world: &mut World, at: usize, value: u32) {
    let payload = [&[0, 1, 0, 0], &value.to_le_bytes()[..]].concat();
    world.programs[at].local.push_back((topic(STATE), payload));
}

#[test]
fn a_server_that_is_active_again_repeats_no_value_that_its_clients_wrote_before() {
    let mut world = servers(CELL, 17);
    world.run(700);
    write(&mut world, A, 5);
    world.run(500);
    world.programs[A].stopped = world.passed + 500;
    world.run(3_000);
    assert_eq!(
        (world.role(A), world.role(B)),
        (RedundancyRole::Standby, RedundancyRole::Active)
    );
    write(&mut world, B, 9);
    world.run(2_500);
    world.programs[B].is_dead = true;
    world.run(3_000);
    assert_eq!(world.role(A), RedundancyRole::Active);
    assert_eq!(world.values(STATE), [5, 9]);
}

#[test]
fn a_robot_stops_when_the_active_server_ends_with_the_session_of_its_commander() {
    let text = CELL.replace(
        "queue: keep_latest, ros: [{topic: /b",
        "queue: keep_latest, on_loss: {data: 0}, ros: [{topic: /b",
    );
    let mut world = servers(&text, 18);
    world.run(700);
    write(&mut world, A, 5);
    world.run(2_500);
    world.programs[A].is_dead = true;
    world.run(5_000);
    assert_eq!(world.role(B), RedundancyRole::Active);
    assert_eq!(world.values(STATE), [5, 0]);
}

#[test]
fn a_state_that_changes_while_no_bridge_is_active_arrives() {
    let mut world = World::new(CELL, 3);
    world.run(700);
    world.say(STATE, 7);
    world.say(TARGET, 70);
    world.run(2_500);
    world.programs[A].is_dead = true;
    world.run(30);
    world.say(STATE, 8);
    world.say(TARGET, 80);
    world.run(400);
    assert_eq!(world.values(STATE), [7, 8]);
    assert_eq!(world.values(TARGET), [70, 80]);
}

#[test]
fn a_command_that_may_have_been_delivered_is_not_delivered_by_the_new_bridge() {
    // Its repetitions reach the other bridge before and after the takeover.
    for pause in [70, 200] {
        let mut world = World::new(CELL, 4);
        world.run(700);
        world.say(COMMAND, 1);
        world.run(200);
        // The standby misses the command.
        let first = world.command(2);
        let from = world.programs[COMMANDER].address;
        let passed = world.passed;
        world.programs[A].socket.push((passed + 1, from, first));
        world.run(2);
        assert_eq!(world.values(COMMAND), [1, 1, 2]);
        world.programs[A].is_dead = true;
        world.programs[COMMANDER].stopped = world.passed + pause;
        world.run(1_000);
        assert_eq!(world.role(B), RedundancyRole::Active);
        let of_robots: Vec<u32> = (world.published.iter())
            .filter(|one| one.topic == topic(COMMAND) && one.by != READER)
            .map(|one| one.value)
            .collect();
        assert_eq!(of_robots, [1, 2], "{pause} ms");
        assert!(world.dropped(B, Reason::Takeover) > 0 || pause == 70);
        // The next command is delivered.
        world.say(COMMAND, 3);
        world.run(100);
        assert_eq!(
            world
                .values(COMMAND)
                .iter()
                .filter(|value| **value == 3)
                .count(),
            2
        );
    }
}

/// Returns the commands that the robots of space 2 receive.
fn of_robots(world: &World) -> Vec<u32> {
    let commands = world.published.iter();
    let commands = commands.filter(|one| one.topic == topic(COMMAND) && one.by != READER);
    commands.map(|one| one.value).collect()
}

#[test]
fn a_command_that_the_network_holds_back_for_a_bridge_is_delivered_once() {
    // The commander is known to the standby, or it sends for the first time.
    for (is_known, held) in [(true, 160), (true, 3_000), (false, 160), (false, 800)] {
        let mut world = World::new(CELL, 11);
        // Its clock does not matter to a bridge that knows it.
        let skew = if is_known { 7_200_000_000_000 } else { 0 };
        world.programs[COMMANDER].skew = skew;
        world.programs[COMMANDER].is_dead = !is_known;
        world.run(700);
        if is_known {
            world.say(COMMAND, 1);
            world.run(200);
        }
        let first = world.command(2);
        let (from, passed) = (world.programs[COMMANDER].address, world.passed);
        world.programs[A]
            .socket
            .push((passed + 1, from, first.clone()));
        world.run(2);
        world.programs[A].is_dead = true;
        world.programs[COMMANDER].is_dead = true;
        world.run(held);
        assert_eq!(world.role(B), RedundancyRole::Active);
        let passed = world.passed;
        world.programs[B].socket.push((passed + 1, from, first));
        world.run(50);
        let expected: &[u32] = if is_known { &[1, 2] } else { &[2] };
        assert_eq!(of_robots(&world), expected, "{held} ms");
        assert_eq!(world.dropped(B, Reason::Takeover), 1, "{held} ms");
    }
}

#[test]
fn a_commander_that_starts_after_a_takeover_is_heard_after_a_second() {
    for (pause, arrives) in [(300, false), (1_500, true)] {
        let mut world = World::new(CELL, 12);
        world.programs[COMMANDER].is_dead = true;
        world.run(700);
        world.programs[A].is_dead = true;
        world.run(pause);
        assert_eq!(world.role(B), RedundancyRole::Active);
        world.programs[COMMANDER].is_dead = false;
        world.say(COMMAND, 5);
        world.run(100);
        assert_eq!(of_robots(&world) == [5], arrives, "{pause} ms");
        // A later command of the same commander is dated by its messages.
        world.run(1_500);
        world.say(COMMAND, 6);
        world.run(100);
        assert_eq!(of_robots(&world).last(), Some(&6));
    }
}

#[test]
fn a_command_that_is_received_in_the_pass_of_the_takeover_is_not_delivered() {
    for delay in 60.. {
        let mut world = World::new(CELL, 10);
        world.run(700);
        world.say(COMMAND, 1);
        world.run(200);
        world.programs[A].is_dead = true;
        world.programs[COMMANDER].is_dead = true;
        let bytes = world.command(2);
        world.run(delay);
        if world.role(B) == RedundancyRole::Active {
            assert!(delay > 80, "the takeover was in an earlier pass");
            break;
        }
        // A pass of a run loop that takes no outputs before the timer.
        world.passed += 1;
        let (now, from) = (world.now(B), world.programs[COMMANDER].address);
        let router = &mut world.programs[B].router;
        router.handle_datagram(&bytes, from, now);
        router.handle_timeout(now);
        world.drain(B);
        world.run(50);
        let by_standby = |one: &Published| one.by == B && one.value == 2;
        assert!(!world.published.iter().any(by_standby), "{delay} ms");
    }
}

#[test]
fn the_reaction_to_a_lost_commander_is_published_once_and_also_in_the_gap() {
    for pause in [500, 2_950] {
        let mut world = World::new(CELL, 8);
        world.run(700);
        world.say(DRIVE, 9);
        world.run(100);
        world.programs[COMMANDER].is_dead = true;
        world.run(pause);
        world.programs[A].is_dead = true;
        world.run(5_000);
        assert_eq!(world.values(DRIVE), [9, 0], "{pause} ms");
        let stops = world
            .published
            .iter()
            .filter(|one| one.topic == topic(DRIVE) && one.value == 0);
        assert!(stops.clone().all(|one| one.by == B));
    }
    let mut world = World::new(CELL, 9);
    world.run(700);
    world.say(DRIVE, 9);
    world.run(100);
    world.programs[COMMANDER].is_dead = true;
    world.run(5_000);
    world.programs[A].is_dead = true;
    world.run(2_000);
    assert_eq!(world.values(DRIVE), [9, 0], "not again at a takeover");
}

#[test]
fn a_late_message_of_the_former_bridge_is_dropped_by_readers_of_heartbeats() {
    let mut world = World::new(CELL, 5);
    world.run(700);
    for value in 1..=100 {
        world.say(MEASURED, value);
        world.run(1);
    }
    // A message that is under way while the bridge is stopped.
    let now = world.now(A);
    world.programs[A].stopped = world.passed + 1_000;
    let heard = LocalMessage {
        topic: topic(MEASURED),
        payload: &[0, 1, 0, 0, 101, 0, 0, 0],
        received: now.utc,
        latched_by: None,
    };
    let _verdict = world.programs[A].router.handle_local(heard, now);
    let mut late = Vec::new();
    while let Some(output) = world.programs[A].router.poll_output(now) {
        if let Output::Datagram { bytes, .. } = output {
            late = bytes;
        }
    }
    for value in 101..=400 {
        world.say(MEASURED, value);
        world.run(1);
    }
    assert_eq!(world.active(), B);
    let (from, passed) = (world.programs[A].address, world.passed);
    world.programs[READER].socket.push((passed + 1, from, late));
    world.run(10);
    assert_rising(&world.values(MEASURED), "values");
    assert_eq!(world.dropped(READER, Reason::Takeover), 1);
}

#[test]
fn a_heartbeat_in_the_name_of_a_bridge_from_another_address_changes_no_role() {
    let mut world = World::new(CELL, 1);
    world.run(700);
    let now = world.now(A);
    world.programs[A].router.switch_over(now).unwrap();
    world.programs[B].socket.clear();
    world.drain(A);
    let mut sent = world.programs[B].socket.iter().map(|(.., bytes)| bytes);
    let released = sent.find(|bytes| NetworkMessage::decode(bytes).unwrap().group().is_none());
    let released = released.unwrap().clone();

    let mut world = World::new(CELL, 1);
    world.run(700);
    let forger = SocketAddr::from(([127, 0, 0, 1], 9));
    for _ in 0..20 {
        for at in [B, READER] {
            let arrival = (world.passed + 1, forger, released.clone());
            world.programs[at].socket.push(arrival);
        }
        world.run(10);
    }
    assert_eq!(
        (world.role(A), world.role(B)),
        (RedundancyRole::Active, RedundancyRole::Standby)
    );
    for at in [B, READER] {
        assert_eq!(world.dropped(at, Reason::Forged), 20, "at {at}");
    }
    let takeovers = |world: &World| world.programs[B].router.redundancy().unwrap().counts();
    assert_eq!(takeovers(&world).takeovers, 0);

    // The interface of the active bridge gets another address.
    world.programs[A].address.set_port(9_999);
    let source = world.programs[A].address;
    world.programs[A].router.set_source(source);
    world.run(1_000);
    assert_eq!(
        (world.role(A), world.role(B)),
        (RedundancyRole::Active, RedundancyRole::Standby)
    );
    assert_eq!(takeovers(&world).takeovers, 0);
}

#[test]
fn a_planned_switch_and_the_end_of_a_program_lose_less_than_a_loss() {
    let mut world = World::new(CELL, 6);
    world.run(700);
    let mut value = 0;
    for turn in 0..4 {
        let active = world.active();
        for millisecond in 0..1_000 {
            if millisecond == 500 {
                let now = world.now(active);
                world.programs[active].router.switch_over(now).unwrap();
            }
            value += 1;
            world.say(MEASURED, value);
            world.run(1);
        }
        assert_ne!(world.active(), active, "turn {turn}");
    }
    let measured = world.values(MEASURED);
    assert_rising(&measured, "values");
    let lost = value - 1 - u32::try_from(measured.len()).unwrap();
    assert!(lost <= 4 * 80, "{lost} values lost in 4 switches");
}

const SECURED: &str = "security: [{group: cell, keys: {file: k}}]\n";

fn keys(byte: u8) -> KeyDelivery {
    let key = TokenKeys::from_bytes(SecurityPolicy::PubSubAes256Ctr, &[byte; 68]).unwrap();
    KeyDelivery {
        first_token_id: 1,
        keys: vec![key],
        time_to_next: None,
        lifetime: Duration::ZERO,
    }
}

#[test]
fn in_a_secured_group_a_bridge_without_keys_never_becomes_active() {
    let mut world = World::new(&format!("{CELL}{SECURED}"), 7);
    let now = world.now(B);
    for at in [B, READER, COMMANDER] {
        world.programs[at]
            .router
            .set_keys("cell", &keys(1), now)
            .unwrap();
    }
    world.run(2_000);
    assert_eq!(
        (world.role(A), world.role(B)),
        (RedundancyRole::Starting, RedundancyRole::Active)
    );
    for value in 1..=100 {
        world.say(MEASURED, value);
        world.run(1);
    }
    assert_eq!(world.programs[A].sent, 0);
    let now = world.now(A);
    world.programs[A]
        .router
        .set_keys("cell", &keys(1), now)
        .unwrap();
    world.run(500);
    assert_eq!(
        (world.role(A), world.role(B)),
        (RedundancyRole::Standby, RedundancyRole::Active)
    );
    world.programs[B].is_dead = true;
    for value in 101..=500 {
        world.say(MEASURED, value);
        world.run(1);
    }
    assert_eq!(world.role(A), RedundancyRole::Active);
    let measured = world.values(MEASURED);
    assert_rising(&measured, "values");
    assert_eq!(measured.last(), Some(&499));
    assert_eq!(
        world.dropped(READER, Reason::Replayed),
        0,
        "no nonce is used twice"
    );
}

#[test]
fn in_a_secured_group_a_heartbeat_in_clear_changes_no_role() {
    let mut world = World::new(&format!("{CELL}{SECURED}"), 8);
    let now = world.now(B);
    for program in &mut world.programs {
        program.router.set_keys("cell", &keys(1), now).unwrap();
    }
    world.run(700);
    assert_eq!(world.role(A), RedundancyRole::Active);
    // The heartbeat of an active bridge in a group without security.
    let mut other = World::new(CELL, 8);
    other.programs[A].is_dead = true;
    other.run(700);
    other.passed += 25;
    let now = other.now(B);
    let mut clear = Vec::new();
    other.programs[B].router.handle_timeout(now);
    while let Some(output) = other.programs[B].router.poll_output(now) {
        if let Output::Heartbeat { bytes } = output {
            clear = bytes;
        }
    }
    assert!(!clear.is_empty());
    let (from, passed) = (other.programs[B].address, world.passed);
    for at in [A, READER] {
        let socket = &mut world.programs[at].socket;
        socket.push((passed + 1, from, clear.clone()));
    }
    world.run(2);
    for at in [A, READER] {
        assert_eq!(world.dropped(at, Reason::Unsecured), 1);
    }
    assert_eq!(
        (world.role(A), world.role(B)),
        (RedundancyRole::Active, RedundancyRole::Standby)
    );
}
