//! Secured groups between Routers: only programs with the keys are accepted.
use crate::cell;

use std::sync::Arc;
use std::time::Duration;

use bridge_core::{
    AskId, CallDescription, CallField, CallRole, Executed, Guard, KeyDelivery, Local, OfferedCall,
    Reason, ValueDescription,
};
use cell::{SimulatedCell, SimulatedProgram, component, ms, topic};
use mappings::{Mapping, TopicId};
use proptest::prelude::*;
use uadp::{BuiltinType, NetworkMessage, Scalar, SecurityPolicy, TokenKeys, Variant};

const WRITER: usize = 0;
const READER: usize = 1;
/// A program without a key, or with another key.
const THIRD: usize = 2;

const ENCRYPTED: &str = "security: [{group: cell, keys: {file: k}}]";
const SIGNED: &str = "security: [{group: cell, mode: sign, keys: {file: k}}]";
/// Namespace 9 is not secured.
const MIXED: &str =
    "security: [{group: cell, keys: {file: k}}, {group: all, mode: none, namespaces: [9]}]";

fn key(byte: u8) -> TokenKeys {
    TokenKeys::from_bytes(SecurityPolicy::PubSubAes256Ctr, &[byte; 68]).unwrap()
}

fn delivery(first_token_id: u32, keys: &[u8]) -> KeyDelivery {
    KeyDelivery {
        first_token_id,
        keys: keys.iter().map(|byte| key(*byte)).collect(),
        time_to_next: None,
        lifetime: Duration::ZERO,
    }
}

/// Applies the mapping to a program.
fn follows(cell: &mut SimulatedCell, at: usize, yaml: &str) {
    let mapping = Mapping::from_yaml(yaml, "cell.yaml").mapping.unwrap();
    let now = cell.now();
    cell.programs[at]
        .router
        .replace_mapping(Arc::new(mapping), now);
}

fn give(cell: &mut SimulatedCell, at: usize, delivery: &KeyDelivery) {
    let now = cell.now();
    cell.programs[at]
        .router
        .set_keys("cell", delivery, now)
        .unwrap();
}

/// Creates components of the namespaces 7, 8 and 9 with fields as payload. The first two have the
/// key.
fn secured(yaml: &str) -> SimulatedCell {
    let mut cell = SimulatedCell::new(vec![component(7), component(8), component(9)]);
    for at in [WRITER, READER] {
        follows(&mut cell, at, yaml);
        give(&mut cell, at, &delivery(1, &[1]));
    }
    cell
}

fn said() -> TopicId {
    topic(0, 7, 10)
}

/// Returns the newest value that a program received.
fn last(cell: &mut SimulatedCell, at: usize, topic: TopicId) -> Option<String> {
    cell.texts(at, topic).pop()
}

#[test]
fn who_has_the_key_hears_and_who_has_none_neither_hears_nor_is_heard() {
    for yaml in [ENCRYPTED, SIGNED] {
        let mut cell = secured(yaml);
        cell.say(WRITER, said(), "secret");
        cell.run(ms(100));
        assert_eq!(last(&mut cell, READER, said()).as_deref(), Some("secret"));
        assert_eq!(last(&mut cell, THIRD, said()), None, "{yaml}");
        let forged = topic(0, 9, 10);
        cell.say(THIRD, forged, "forged");
        cell.run(ms(100));
        assert_eq!(last(&mut cell, READER, forged), None);
        assert!(cell.dropped(READER, Reason::Unsecured) > 0);
        assert_eq!(cell.dropped(READER, Reason::Signature), 0);
        let clear = cell.datagrams_of(WRITER);
        let encrypted = !clear.iter().any(|datagram| contains(datagram, b"secret"));
        assert_eq!(encrypted, yaml == ENCRYPTED);
        for datagram in clear {
            assert!(NetworkMessage::decode(&datagram).unwrap().is_sealed());
        }
    }
}

fn contains(bytes: &[u8], part: &[u8]) -> bool {
    bytes.windows(part.len()).any(|window| window == part)
}

#[test]
fn what_is_no_message_is_not_sent_in_clear_either() {
    let mapping = Mapping::from_yaml(MIXED, "cell.yaml").mapping.unwrap();
    let mut guard = Guard::new(mapping.security()).unwrap();
    guard.set_mark([1; 4]);
    let mut sealed = Vec::new();
    let refused = guard.seal(&[0xFF; 3], &mut sealed).unwrap_err();
    assert_eq!((refused.reason, sealed.len()), (Reason::Malformed, 0));
}

#[test]
fn what_is_wrong_with_a_message_is_counted_by_its_reason() {
    for (yaml, given, reason) in [
        (ENCRYPTED, delivery(1, &[2]), Reason::Signature),
        (ENCRYPTED, delivery(5, &[1]), Reason::UnknownKey),
        (SIGNED, delivery(1, &[1]), Reason::Downgraded),
    ] {
        let mut cell = secured(ENCRYPTED);
        follows(&mut cell, THIRD, yaml);
        give(&mut cell, THIRD, &given);
        let forged = topic(0, 9, 10);
        cell.say(THIRD, forged, "forged");
        cell.run(ms(100));
        assert_eq!(last(&mut cell, READER, forged), None, "{reason}");
        assert!(cell.dropped(READER, reason) > 0, "{reason}");
        assert_eq!(cell.dropped(READER, Reason::Unsecured), 0);
    }
}

#[test]
fn what_was_recorded_is_refused_also_after_its_sender_restarted() {
    let mut cell = secured(ENCRYPTED);
    cell.say(WRITER, said(), "old");
    cell.run(ms(50));
    assert_eq!(last(&mut cell, READER, said()).as_deref(), Some("old"));
    let recorded = cell.datagrams_of(WRITER);
    let from = cell.programs[WRITER].address;
    // Another instance has other random bytes, and counts from 1.
    let mut instance = [9; 16];
    instance[0] = 77;
    cell.start(WRITER, component(7));
    cell.programs[WRITER].router.set_instance(instance);
    follows(&mut cell, WRITER, ENCRYPTED);
    give(&mut cell, WRITER, &delivery(1, &[1]));
    cell.say(WRITER, said(), "new");
    cell.run(ms(3_500));
    assert_eq!(last(&mut cell, READER, said()).as_deref(), Some("new"));
    for datagram in &recorded {
        cell.hear(READER, datagram, from);
    }
    let refused = cell.dropped(READER, Reason::Replayed);
    assert_eq!(refused, recorded.len() as u64);
    assert_eq!(last(&mut cell, READER, said()), None);
}

#[test]
fn a_program_is_not_driven_out_of_its_namespace_by_its_own_messages() {
    let mut cell = secured(ENCRYPTED);
    cell.say(WRITER, said(), "mine");
    cell.run(ms(50));
    let from = "192.0.2.9:4000".parse().unwrap();
    for datagram in cell.datagrams_of(WRITER) {
        cell.hear(WRITER, &datagram, from);
    }
    assert!(cell.dropped(WRITER, Reason::Replayed) > 0);
    assert_eq!(cell.dropped(WRITER, Reason::SpaceTaken), 0);
}

#[test]
fn keys_change_while_values_run_and_none_is_lost() {
    let mut cell = secured(ENCRYPTED);
    let mut delivered = delivery(1, &[1, 2, 3, 4]);
    delivered.time_to_next = Some(ms(200));
    delivered.lifetime = ms(200);
    give(&mut cell, WRITER, &delivered);
    cell.run(ms(30));
    give(&mut cell, READER, &delivered);
    let mut tokens = Vec::new();
    for number in 0..60 {
        let text = number.to_string();
        cell.say(WRITER, said(), &text);
        cell.run(ms(10));
        assert_eq!(last(&mut cell, READER, said()), Some(text));
        let token = cell.programs[WRITER]
            .router
            .groups()
            .next()
            .unwrap()
            .token_id;
        tokens.push(token.unwrap());
    }
    tokens.dedup();
    assert_eq!(tokens, [1, 2, 3, 4]);
    // Without new keys the last key stays in use, and this is reported.
    cell.run(ms(1_000));
    cell.say(WRITER, said(), "late");
    cell.run(ms(10));
    assert_eq!(last(&mut cell, READER, said()).as_deref(), Some("late"));
    let state = cell.programs[WRITER].router.groups().next().unwrap();
    assert_eq!((state.token_id, state.overdue), (Some(4), true));
    let wanted = cell.outputs(WRITER);
    let wanted = wanted.iter().any(
        |output| matches!(output, bridge_core::Output::KeysWanted { group } if group == "cell"),
    );
    assert!(wanted);
}

#[test]
fn programs_whose_times_differ_a_little_use_each_key_for_its_lifetime_and_no_shorter() {
    let mut cell = secured(ENCRYPTED);
    let timed = |first, keys: &[u8], to_next| KeyDelivery {
        time_to_next: Some(to_next),
        lifetime: ms(100),
        ..delivery(first, keys)
    };
    let token = |cell: &SimulatedCell, at: usize| {
        let state = cell.programs[at].router.groups().next().unwrap();
        (state.token_id.unwrap(), state.overdue)
    };
    let says = |cell: &mut SimulatedCell, for_ms: u64| {
        for _ in 0..for_ms / 10 {
            cell.say(WRITER, said(), "on");
            cell.say(READER, topic(0, 8, 10), "too");
            cell.run(ms(10));
        }
    };
    let keys = [1, 2, 3, 4, 5];
    give(&mut cell, WRITER, &timed(1, &keys, ms(104)));
    give(&mut cell, READER, &timed(1, &keys, ms(97)));
    says(&mut cell, 350);
    assert_eq!(token(&cell, WRITER), (4, false));
    assert_eq!(token(&cell, READER), (4, false));
    // The program waits for a key service that is behind.
    give(&mut cell, WRITER, &timed(3, &[3, 4, 5, 6, 7], ms(50)));
    give(&mut cell, READER, &timed(3, &[3, 4, 5, 6, 7], ms(50)));
    says(&mut cell, 140);
    assert_eq!(token(&cell, READER), (4, false));
    says(&mut cell, 20);
    assert_eq!(token(&cell, READER), (5, false));
    assert_eq!(cell.dropped(READER, Reason::UnknownKey), 0);
}

#[test]
fn without_keys_nothing_is_said_and_what_was_said_last_comes_with_them() {
    let mut cell = secured(ENCRYPTED);
    cell.start(WRITER, component(7));
    follows(&mut cell, WRITER, ENCRYPTED);
    let state = ValueDescription {
        name: "gripper.State".to_owned(),
        message_type: Some("std_msgs/String".parse().unwrap()),
        about: String::new(),
        fields: Vec::new(),
        overflow: mappings::Overflow::KeepLatest,
    };
    cell.describe(WRITER, said(), state);
    cell.say(WRITER, said(), "early");
    cell.run(ms(100));
    assert_eq!(last(&mut cell, READER, said()), None);
    assert!(cell.datagrams_of(WRITER).is_empty());
    assert!(cell.dropped(WRITER, Reason::NoKeys) > 0);
    give(&mut cell, WRITER, &delivery(1, &[1]));
    cell.run(ms(1_500));
    assert_eq!(last(&mut cell, READER, said()).as_deref(), Some("early"));
}

#[test]
fn a_namespace_for_everybody_stays_so_beside_a_secured_one() {
    let mut cell = secured(MIXED);
    let open = topic(0, 9, 10);
    cell.say(THIRD, open, "hello");
    cell.say(WRITER, said(), "secret");
    cell.run(ms(100));
    assert_eq!(last(&mut cell, READER, open).as_deref(), Some("hello"));
    assert_eq!(last(&mut cell, READER, said()).as_deref(), Some("secret"));
    // Its messages in another namespace are rejected.
    let forged = topic(0, 4, 10);
    cell.programs[THIRD] = component(4);
    cell.say(THIRD, forged, "forged");
    cell.run(ms(100));
    assert_eq!(last(&mut cell, READER, forged), None);
    assert!(cell.dropped(READER, Reason::Unsecured) > 0);
}

fn start() -> TopicId {
    topic(0, 7, 105)
}

fn offer(cell: &mut SimulatedCell) {
    let description = CallDescription {
        name: "gripper.Grasp.Start".to_owned(),
        about: String::new(),
        role: CallRole::Call,
        request: vec![CallField::scalar("Text", BuiltinType::String)],
        response: vec![CallField::scalar("Text", BuiltinType::String)],
    };
    let offered = OfferedCall {
        description,
        open: false,
    };
    cell.offer(WRITER, start(), offered);
    cell.run(ms(300));
}

/// Sends a request of a program and returns the response, if it is received.
fn ask(cell: &mut SimulatedCell, at: usize, text: &str) -> Option<Vec<u8>> {
    let request = cell::block(&[Variant::Scalar(Scalar::String(Some(text)))]);
    cell.ask(at, AskId(1), (start(), &request), ms(2_000));
    cell.run(ms(500));
    for execution in cell.executions(WRITER) {
        cell.executed(WRITER, execution.id, Executed::Answered(execution.request));
    }
    cell.run(ms(3_000));
    cell.answers(at).pop().and_then(|(_, answer)| answer.ok())
}

#[test]
fn a_call_is_executed_for_who_has_the_key_wherever_it_is_and_for_nobody_else() {
    let mut cell = secured(ENCRYPTED);
    // Another host.
    cell.programs[READER].address = "192.0.2.7:4000".parse().unwrap();
    cell.programs[THIRD].address = "192.0.2.8:4000".parse().unwrap();
    offer(&mut cell);
    assert_eq!(cell.known(READER), [start()]);
    assert!(cell.known(THIRD).is_empty());
    let large = "x".repeat(200_000);
    for text in ["short", &large] {
        let answer = ask(&mut cell, READER, text);
        let expected = cell::block(&[Variant::Scalar(Scalar::String(Some(text)))]);
        assert_eq!(answer, Some(expected));
    }
    assert_eq!(cell.counters(WRITER, start()).executed, 2);
    assert_eq!(ask(&mut cell, THIRD, "forged"), None);
    assert_eq!(cell.counters(WRITER, start()).executed, 2);
}

#[test]
fn without_a_secured_group_a_call_of_another_host_stays_refused() {
    let mut cell = SimulatedCell::new(vec![component(7), component(8), component(9)]);
    cell.programs[READER].address = "192.0.2.7:4000".parse().unwrap();
    offer(&mut cell);
    assert_eq!(ask(&mut cell, READER, "short"), None);
    assert_eq!(cell.counters(WRITER, start()).executed, 0);
}

#[test]
fn a_group_that_is_no_longer_secured_speaks_in_clear_after_a_reload() {
    let mut cell = secured(ENCRYPTED);
    for at in [WRITER, READER] {
        follows(&mut cell, at, "variables: []");
    }
    cell.say(WRITER, said(), "plain");
    cell.run(ms(100));
    assert_eq!(last(&mut cell, THIRD, said()).as_deref(), Some("plain"));
    // An unchanged group keeps its keys.
    let mut cell = secured(ENCRYPTED);
    let other = "security: [{group: cell, namespaces: [7, 8], keys: {file: other}}]";
    follows(&mut cell, WRITER, other);
    cell.say(WRITER, said(), "still");
    cell.run(ms(100));
    assert_eq!(last(&mut cell, READER, said()).as_deref(), Some("still"));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(200))]

    /// A sender without a key changes, truncates or repeats received messages without any effect.
    #[test]
    fn nothing_that_was_changed_is_believed(
        text in "[a-z]{1,40}",
        changes in proptest::collection::vec((any::<proptest::sample::Index>(), 1_u8.., any::<bool>()), 1..6),
        signed in any::<bool>(),
    ) {
        let yaml = if signed { SIGNED } else { ENCRYPTED };
        let mut cell = secured(yaml);
        cell.say(WRITER, said(), &text);
        cell.run(ms(20));
        prop_assert_eq!(last(&mut cell, READER, said()), Some(text));
        let from = "192.0.2.9:4000".parse().unwrap();
        let topics = cell.programs[READER].router.topics().count();
        for datagram in cell.datagrams_of(WRITER) {
            for (place, by, cut) in &changes {
                let mut changed = datagram.clone();
                let at = place.index(changed.len());
                if *cut { changed.truncate(at) } else { changed[at] ^= by }
                cell.hear(READER, &changed, from);
            }
        }
        cell.run(ms(20));
        prop_assert_eq!(last(&mut cell, READER, said()), None);
        prop_assert_eq!(cell.programs[READER].router.topics().count(), topics);
        prop_assert!(cell.known(READER).is_empty());
    }
}

#[test]
fn bridges_of_both_ros_are_as_closed() {
    let mut cell = SimulatedCell::new(vec![component(7), SimulatedProgram::new(1, Local::Ros1)]);
    for at in [WRITER, READER] {
        follows(&mut cell, at, ENCRYPTED);
        give(&mut cell, at, &delivery(1, &[1]));
    }
    offer(&mut cell);
    assert_eq!(cell.known(READER), [start()]);
}

#[test]
fn each_copy_of_an_event_is_sealed_anew_under_a_nonce_of_its_own() {
    let mut cell = secured(ENCRYPTED);
    cell.say(WRITER, said(), "stop");
    cell.run(ms(200));
    let copies = cell.datagrams_of(WRITER);
    let of_value = |datagram: &&Vec<u8>| {
        let message = NetworkMessage::decode(datagram).unwrap();
        message.message_type() == uadp::NetworkMessageType::DataSet
    };
    let copies: Vec<_> = copies.iter().filter(of_value).collect();
    let nonces: std::collections::BTreeSet<Vec<u8>> = copies
        .iter()
        .map(|datagram| {
            let message = NetworkMessage::decode(datagram).unwrap();
            message.security().unwrap().nonce.to_vec()
        })
        .collect();
    assert!(copies.len() >= 3, "{}", copies.len());
    assert_eq!(nonces.len(), copies.len());
    assert_eq!(cell.texts(READER, said()), ["stop"]);
}

const COMMAND: &str = "
security: [{group: cell, keys: {file: k}}]
namespaces: {7: urn:cell}
spaces: [{id: 1}]
variables:
  - {node: ns=7;i=10, name: Stop, origin: 0, ros: {space: 1, topic: /stop, type: std_msgs/String}}
";

#[test]
fn the_repetitions_of_a_sealed_command_have_the_time_of_its_first_transmission() {
    for (yaml, is_kept) in [(COMMAND, true), (ENCRYPTED, false)] {
        let mut cell = secured(yaml);
        cell.say(WRITER, said(), "stop");
        cell.run(ms(200));
        let mut times = Vec::new();
        for datagram in cell.datagrams_of(WRITER) {
            let message = NetworkMessage::decode(&datagram).unwrap();
            if message.message_type() == uadp::NetworkMessageType::DataSet {
                times.push(message.header().timestamp.unwrap());
            }
        }
        assert!(times.len() >= 3, "{}", times.len());
        times.dedup();
        assert_eq!(times.len() == 1, is_kept, "{times:?}");
    }
}
