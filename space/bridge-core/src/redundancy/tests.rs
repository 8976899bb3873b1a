//! Bridges on a simulated network with a manual clock.

use std::collections::BTreeMap;

use mappings::SpaceId;
use uadp::{NetworkMessage, Timestamp};

use super::*;

const STEP: Duration = Duration::from_millis(1);

#[expect(clippy::disallowed_methods, reason = "some instant to count from")]
fn start() -> Now {
    Now {
        monotonic: Instant::now(),
        utc: Timestamp::from_unix_nanos(1_700_000_000_000_000_000),
    }
}

/// A deterministic sequence of random numbers.
struct Random(u64);

impl Random {
    fn below(&mut self, limit: u64) -> u64 {
        // SplitMix64.
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut mixed = self.0;
        mixed = (mixed ^ (mixed >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        mixed = (mixed ^ (mixed >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        (mixed ^ (mixed >> 31)) % limit
    }
}

struct Bridge {
    state: Redundancy,
    /// The process does not run before this time.
    stopped: u64,
    is_dead: bool,
    /// The heartbeats in its socket: time of arrival, sender and heartbeat.
    socket: Vec<(u64, usize, Heartbeat)>,
    changes: Vec<RoleChange>,
}

struct Network {
    start: Now,
    passed: u64,
    bridges: Vec<Bridge>,
    random: Random,
    /// Whether the heartbeats between two bridges are lost.
    is_cut: bool,
    /// The number of heartbeats that were lost in a row, by sender and receiver.
    lost: BTreeMap<(usize, usize), u32>,
    /// The bridge of each sent value, by time.
    sent: Vec<(u64, usize)>,
}

fn address(of: usize) -> SocketAddr {
    ([127, 0, 0, 1], 10_000 + u16::try_from(of).unwrap()).into()
}

impl Network {
    fn new(ranks: &[u8], seed: u64) -> Self {
        let start = start();
        let bridges = (1..).zip(ranks).map(|(instance, rank)| Bridge {
            state: Redundancy::new(RedundancyRank::new(*rank).unwrap(), instance, start),
            stopped: 0,
            is_dead: false,
            socket: Vec::new(),
            changes: Vec::new(),
        });
        Self {
            start,
            passed: 0,
            bridges: bridges.collect(),
            random: Random(seed),
            is_cut: false,
            lost: BTreeMap::new(),
            sent: Vec::new(),
        }
    }

    fn now(&self) -> Now {
        let passed = STEP * u32::try_from(self.passed).unwrap();
        let nanos = i128::try_from(passed.as_nanos()).unwrap();
        Now {
            monotonic: self.start.monotonic + passed,
            utc: Timestamp::from_unix_nanos(self.start.utc.unix_nanos() + nanos),
        }
    }

    /// Runs all bridges that are not stopped, once a millisecond.
    fn run(&mut self, milliseconds: u64) {
        for _ in 0..milliseconds {
            self.passed += 1;
            for at in 0..self.bridges.len() {
                if self.bridges[at].stopped <= self.passed && !self.bridges[at].is_dead {
                    self.step(at);
                }
            }
        }
    }

    /// A pass of a run loop: the socket, the timer, and a value of the local side.
    fn step(&mut self, at: usize) {
        let now = self.now();
        // A run loop takes a limited number of datagrams at a time.
        for _ in 0..8 {
            let arrived =
                (self.bridges[at].socket.iter()).position(|(time, ..)| *time <= self.passed);
            let Some(first) = arrived else { break };
            let (_, from, heartbeat) = self.bridges[at].socket.remove(first);
            let change = self.bridges[at].state.hear(heartbeat, address(from), now);
            self.bridges[at].changes.extend(change);
        }
        let checked = self.bridges[at].state.check(now);
        let (heartbeat, change) = self.bridges[at].state.poll(now);
        self.bridges[at]
            .changes
            .extend(checked.into_iter().chain(change));
        if let Some(heartbeat) = heartbeat {
            self.send(at, heartbeat);
            let change = self.bridges[at].state.sent(now);
            self.bridges[at].changes.extend(change);
        }
        // The lease is checked before each value.
        let checked = self.bridges[at].state.check(now);
        self.bridges[at].changes.extend(checked);
        if !self.bridges[at].state.mutes_group() {
            self.sent.push((self.passed, at));
        }
    }

    fn send(&mut self, from: usize, heartbeat: Heartbeat) {
        for to in 0..self.bridges.len() {
            let lost = self.lost.entry((from, to)).or_default();
            // A single loss now and then, and never several in a row.
            if to != from && (self.is_cut || (*lost == 0 && self.random.below(20) == 0)) {
                *lost += 1;
                continue;
            }
            *lost = 0;
            let delay = self.random.below(3);
            self.bridges[to]
                .socket
                .push((self.passed + delay, from, heartbeat));
        }
    }

    fn active(&self) -> Vec<usize> {
        let states = (0..).zip(&self.bridges);
        states
            .filter(|(_, bridge)| !bridge.is_dead && bridge.state.role() == RedundancyRole::Active)
            .map(|(at, _)| at)
            .collect()
    }

    fn switch_over(&mut self, at: usize) -> Result<RoleChange, SwitchRefusal> {
        let now = self.now();
        self.bridges[at].state.switch_over(now)
    }

    /// Returns the changes of the sender: the time without values, from sender to sender.
    fn changes(&self) -> Vec<(usize, usize, u64)> {
        let pairs = self.sent.windows(2);
        pairs
            .filter(|pair| pair[0].1 != pair[1].1)
            .map(|pair| (pair[0].1, pair[1].1, pair[1].0 - pair[0].0))
            .collect()
    }

    /// Fails if two bridges sent in the same millisecond, or alternately.
    fn assert_one_sender(&self) {
        for pair in self.sent.windows(2) {
            let [(before, one), (after, other)] = pair else {
                continue;
            };
            assert!(one == other || before < after, "both at {before} ms");
        }
    }
}

#[test]
fn of_two_bridges_that_start_at_once_the_first_rank_is_active() {
    for seed in 0..200 {
        let mut network = Network::new(&[2, 1], seed);
        network.run(600);
        assert_eq!(network.active(), [1]);
        assert_eq!(network.bridges[0].state.role(), RedundancyRole::Standby);
        network.assert_one_sender();
        assert!(network.changes().is_empty());
    }
}

#[test]
fn a_killed_bridge_is_replaced_in_150_ms_and_returns_as_a_standby() {
    for seed in 0..500 {
        let mut network = Network::new(&[1, 2, 3], seed);
        network.run(700 + seed % 20);
        network.bridges[0].is_dead = true;
        network.run(400);
        assert_eq!(network.active(), [1], "seed {seed}");
        let [(0, 1, gap)] = network.changes()[..] else {
            panic!("{:?}", network.changes());
        };
        assert!(gap <= 150, "{gap} ms");
        let now = network.now();
        network.bridges[0] = Bridge {
            state: Redundancy::new(RedundancyRank::new(1).unwrap(), 9, now),
            ..Network::new(&[1], 0).bridges.remove(0)
        };
        network.run(1_000);
        assert_eq!(
            network.active(),
            [1],
            "the restarted bridge does not take over"
        );
        assert_eq!(network.bridges[0].state.epoch(), 2);
        network.assert_one_sender();
    }
}

#[test]
fn thousands_of_stops_and_kills_never_make_two_senders() {
    let mut gaps = Vec::new();
    for seed in 0..300 {
        let mut network = Network::new(&[1, 2], seed);
        network.run(700);
        for _ in 0..12 {
            let now = network.passed;
            let at = usize::try_from(network.random.below(2)).unwrap();
            // As SIGSTOP and SIGCONT, or a busy machine.
            let time = [5, 30, 75, 95, 110, 130, 300, 2_000];
            let index = usize::try_from(network.random.below(8)).unwrap();
            network.bridges[at].stopped = now + time[index];
            let pause = 200 + network.random.below(2_600);
            network.run(pause);
        }
        network.run(3_000);
        network.assert_one_sender();
        assert_eq!(network.active().len(), 1, "seed {seed}");
        let rivals: u64 = (network.bridges.iter())
            .map(|of| of.state.counts().rivals)
            .sum();
        assert_eq!(rivals, 0, "seed {seed}");
        gaps.extend(
            network
                .sent
                .windows(2)
                .map(|pair| pair[1].0 - pair[0].0)
                .filter(|gap| *gap > 3),
        );
    }
    gaps.sort_unstable();
    assert!(gaps.len() > 1_000, "{}", gaps.len());
    let at = |share: usize| gaps[gaps.len() * share / 1_000];
    println!(
        "{} gaps of more than 3 ms: median {} ms, 99 % {} ms, largest {} ms",
        gaps.len(),
        at(500),
        at(990),
        gaps[gaps.len() - 1]
    );
}

#[test]
fn a_stopped_bridge_sends_nothing_after_its_return_and_follows_the_new_one() {
    let mut network = Network::new(&[1, 2], 1);
    network.run(700);
    let stopped = network.passed;
    network.bridges[0].stopped = stopped + 500;
    network.run(1_000);
    assert_eq!(network.active(), [1]);
    assert!(
        network
            .sent
            .iter()
            .all(|(at, of)| *of == 1 || *at <= stopped)
    );
    assert_eq!(network.bridges[0].state.counts().stalls, 1);
    assert!(network.bridges[0].changes.contains(&RoleChange::Muted {
        cause: MuteCause::Stalled
    }));
}

#[test]
fn a_clock_that_jumps_mutes_the_active_bridge_and_steps_back_do_not() {
    let now = start();
    let mut state = Redundancy::new(RedundancyRank::new(1).unwrap(), 1, now);
    let later = |milliseconds: u64, clock: i128| Now {
        monotonic: now.monotonic + Duration::from_millis(milliseconds),
        utc: Timestamp::from_unix_nanos(now.utc.unix_nanos() + clock * 1_000_000),
    };
    let mut at = 0;
    while state.role() != RedundancyRole::Active {
        let (_, _) = state.poll(later(at, i128::from(at)));
        state.sent(later(at, i128::from(at)));
        at += 20;
    }
    let clock = i128::from(at);
    assert_eq!(state.check(later(at, clock)), None);
    assert_eq!(state.check(later(at + 1, clock - 3_600_000)), None);
    let muted = state.check(later(at + 2, clock + 500));
    assert_eq!(
        muted,
        Some(RoleChange::Muted {
            cause: MuteCause::Stalled
        })
    );
    assert!(state.mutes_group() && state.mutes_local());
}

#[test]
fn a_planned_switch_is_shorter_than_a_loss() {
    for seed in 0..100 {
        let mut network = Network::new(&[1, 2], seed);
        assert_eq!(network.switch_over(0), Err(SwitchRefusal::NotActive));
        network.run(700 + seed % 20);
        assert_eq!(network.switch_over(1), Err(SwitchRefusal::NotActive));
        network.switch_over(0).unwrap();
        network.run(500);
        assert_eq!(network.active(), [1]);
        let [(0, 1, gap)] = network.changes()[..] else {
            panic!("{:?}", network.changes());
        };
        assert!(gap <= 125, "{gap} ms");
        network.assert_one_sender();
        let last = network.bridges[1].state.last_takeover().unwrap();
        assert_eq!(last.cause, TakeoverCause::Released);
    }
    let mut alone = Network::new(&[1], 0);
    alone.run(700);
    assert_eq!(alone.switch_over(0), Err(SwitchRefusal::NoStandby));
    assert_eq!(alone.active(), [0]);
}

#[test]
fn a_bridge_without_its_ros_side_hands_over_only_to_a_bridge_that_has_it() {
    let mut network = Network::new(&[1, 2], 3);
    network.run(700);
    network.bridges[0].state.set_side(LocalSide::Silent);
    network.bridges[1].state.set_side(LocalSide::Silent);
    network.run(2_000);
    assert_eq!(network.active(), [0], "neither reaches the ROS side");
    network.bridges[1].state.set_side(LocalSide::Reached);
    network.run(1_000);
    assert_eq!(network.active(), [1]);
    network.bridges[0].state.set_side(LocalSide::Reached);
    network.run(1_000);
    assert_eq!(network.active(), [1], "it does not return by itself");
}

#[test]
fn a_bridge_without_a_link_to_its_ros_side_hands_over_soon_unless_the_standby_has_none_either() {
    let mut network = Network::new(&[1, 2], 3);
    network.run(700);
    network.bridges[0].state.set_side(LocalSide::NoLink);
    // The standby looks later.
    network.run(25);
    network.bridges[1].state.set_side(LocalSide::NoLink);
    network.run(2_000);
    assert_eq!(network.active(), [0], "the switch of both is down");
    network.bridges[1].state.set_side(LocalSide::Reached);
    network.run(200);
    assert_eq!(network.active(), [1]);
    network.assert_one_sender();
    // The time from the loss of the link to the takeover.
    network.bridges[0].state.set_side(LocalSide::Reached);
    network.run(1_000);
    network.bridges[1].state.set_side(LocalSide::NoLink);
    network.run(150);
    assert_eq!(network.active(), [0]);
}

#[test]
fn of_three_bridges_that_with_a_link_to_its_ros_side_takes_over() {
    for seed in 0..20 {
        let mut network = Network::new(&[1, 2, 3], seed);
        network.run(700);
        for at in 0..2 {
            network.bridges[at].state.set_side(LocalSide::NoLink);
        }
        network.run(1_000);
        assert_eq!(network.active(), [2], "{seed}");
        network.assert_one_sender();
    }
}

#[test]
fn a_standby_takes_over_when_its_side_has_been_reached_for_as_long_as_the_active_waits() {
    for (side, flap, steady) in [(LocalSide::NoLink, 40, 200), (LocalSide::Silent, 300, 800)] {
        let mut network = Network::new(&[1, 2], 3);
        network.run(700);
        for at in 0..2 {
            network.bridges[at].state.set_side(side);
        }
        network.run(1_000);
        for _ in 0..20 {
            network.bridges[1].state.set_side(LocalSide::Reached);
            network.run(flap);
            network.bridges[1].state.set_side(side);
            network.run(flap);
        }
        assert_eq!(network.active(), [0], "the side of the standby flaps");
        assert!(network.changes().is_empty());
        // Both sides return together, that of the standby a little earlier.
        network.bridges[1].state.set_side(LocalSide::Reached);
        network.run(flap);
        network.bridges[0].state.set_side(LocalSide::Reached);
        network.run(1_000);
        assert_eq!(network.active(), [0], "both reach their sides");
        network.bridges[0].state.set_side(side);
        network.run(steady);
        assert_eq!(network.active(), [1]);
        network.assert_one_sender();
    }
}

#[test]
fn the_heartbeats_of_a_peer_that_was_out_of_reach_are_counted_anew() {
    let start = start();
    let at = |ms: u64| start.monotonic + Duration::from_millis(ms);
    let fit = Redundancy::new(RedundancyRank::new(2).unwrap(), 2, start).heartbeat();
    let unfit = Heartbeat {
        is_fit: false,
        ..fit
    };
    let mut peer = RedundantPeer::new(fit, address(1), at(0));
    for (heartbeat, ms, in_row) in [
        (fit, 20, 2),
        // A lost heartbeat says nothing.
        (fit, 60, 3),
        (fit, 180, 1),
        (unfit, 200, 0),
        (fit, 220, 1),
    ] {
        let _before = peer.note(heartbeat, address(1), at(ms));
        assert_eq!(peer.fit_in_row, in_row, "{ms} ms");
    }
}

#[test]
fn a_split_is_counted_and_ends_with_the_higher_epoch() {
    let mut network = Network::new(&[1, 2], 5);
    network.run(700);
    network.is_cut = true;
    network.run(1_000);
    assert_eq!(network.active(), [0, 1]);
    network.is_cut = false;
    network.run(100);
    assert_eq!(network.active(), [1]);
    let rivals: u64 = (network.bridges.iter())
        .map(|of| of.state.counts().rivals)
        .sum();
    assert!(rivals >= 1);
}

#[test]
fn a_standby_that_is_cut_off_does_not_take_over_and_an_active_bridge_listens_when_it_is_back() {
    let now = start();
    let at = |count: u32| Now {
        monotonic: now.monotonic + PERIOD * count,
        ..now
    };
    let mut state = Redundancy::new(RedundancyRank::new(1).unwrap(), 1, now);
    for count in 0..100 {
        let (heartbeat, change) = state.poll(at(count));
        assert!(heartbeat.is_some() && change.is_none());
        assert_eq!(state.not_sent(at(count)), None);
    }
    assert_eq!(state.role(), RedundancyRole::Starting);
    let mut count = 100;
    while state.role() != RedundancyRole::Active {
        let (_, _) = state.poll(at(count));
        assert_eq!(state.sent(at(count)), None);
        count += 1;
    }
    assert_eq!(state.not_sent(at(count)), Some(RoleChange::CutOff));
    assert_eq!(state.not_sent(at(count)), None);
    assert!(state.mutes_group() && !state.mutes_local());
    let back = state.sent(at(count + 50));
    assert_eq!(
        back,
        Some(RoleChange::Muted {
            cause: MuteCause::Reconnected
        })
    );
    assert!(state.mutes_local());
}

#[test]
fn a_heartbeat_is_read_as_it_was_written_and_nothing_else_is_one() {
    let now = start();
    let state = Redundancy::new(RedundancyRank::new(2).unwrap(), 77, now);
    let space = SpaceId::new(3).unwrap();
    // The heartbeat of a bridge, and that of an OPC UA server.
    for service_level in [None, Some(199)] {
        let heartbeat = Heartbeat {
            epoch: 7,
            is_released: true,
            service_level,
            ..state.heartbeat()
        };
        let mut bytes = Vec::new();
        heartbeat.encode(space, now.utc, &mut bytes).unwrap();
        let message = NetworkMessage::decode(&bytes).unwrap();
        assert_eq!(Heartbeat::decode(&message), Some((space, heartbeat)));
        for length in 0..bytes.len() {
            if let Ok(message) = NetworkMessage::decode(&bytes[..length]) {
                assert_eq!(Heartbeat::decode(&message), None, "{length} bytes");
            }
        }
    }
}

#[test]
fn the_service_level_of_a_server_is_known_to_the_others() {
    let now = start();
    let mut server = Redundancy::new(RedundancyRank::new(1).unwrap(), 1, now);
    let mut other = Redundancy::new(RedundancyRank::new(2).unwrap(), 2, now);
    server.set_service_level(Some(199));
    let _change = other.hear(server.heartbeat(), address(1), now);
    let level = |at: Instant| {
        let mut present = other.peers(at).filter(|peer| peer.is_present(at));
        let server = present.next()?;
        Some((server.rank().get(), server.service_level()))
    };
    assert_eq!(level(now.monotonic), Some((1, Some(199))));
    assert_eq!(level(now.monotonic + PRESENT), None);
}

#[test]
fn a_takeover_waits_for_messages_that_have_arrived_but_not_for_ever() {
    let start = start();
    let at = |ms: u64| Now {
        monotonic: start.monotonic + STEP * u32::try_from(ms).unwrap(),
        utc: Timestamp::from_unix_nanos(start.utc.unix_nanos() + i128::from(ms) * 1_000_000),
    };
    let mut state = Redundancy::new(RedundancyRank::new(2).unwrap(), 2, start);
    let active = Heartbeat {
        rank: RedundancyRank::new(1).unwrap(),
        role: RedundancyRole::Active,
        epoch: 1,
        instance: 1,
        is_fit: true,
        is_released: false,
        service_level: None,
    };
    let step = |state: &mut Redundancy, ms: u64, waits: bool| {
        let _none = state.check(at(ms));
        if waits {
            state.defer(at(ms).monotonic);
        }
        let _heartbeat = state.poll(at(ms));
        state.role()
    };
    state.hear(active, address(1), at(1));
    for ms in 2..=100 {
        assert_eq!(step(&mut state, ms, false), RedundancyRole::Standby);
    }
    // The heartbeat is behind other messages.
    for ms in 101..=400 {
        assert_eq!(
            step(&mut state, ms, true),
            RedundancyRole::Standby,
            "{ms} ms"
        );
    }
    state.hear(active, address(1), at(401));
    for ms in 402..=500 {
        assert_eq!(
            step(&mut state, ms, false),
            RedundancyRole::Standby,
            "{ms} ms"
        );
    }
    // A flood does not end.
    let taken = (501..2_000).find(|ms| step(&mut state, *ms, true) == RedundancyRole::Active);
    assert!(
        taken.is_some_and(|ms| (1_500..=1_510).contains(&ms)),
        "{taken:?}"
    );
}

#[test]
fn invented_heartbeats_do_not_displace_a_bridge_that_is_known() {
    let now = start();
    let mut state = Redundancy::new(RedundancyRank::new(2).unwrap(), 2, now);
    let known = Redundancy::new(RedundancyRank::new(1).unwrap(), 1, now).heartbeat();
    state.hear(known, address(1), now);
    for instance in 100..120 {
        let invented = Heartbeat { instance, ..known };
        state.hear(invented, address(2), now);
    }
    assert_eq!(state.peers(now.monotonic).count(), MOST_PEERS);
    assert!(state.is_peer(address(1)));
    assert!(state.is_forged(&known, address(2), now.monotonic));
}
