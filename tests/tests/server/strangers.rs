//! Unknown clients and clients that vanish: they neither lock other clients out nor use memory
//! permanently.

use std::fs;
use std::io::{self, Write as _};
use std::path::Path;

use serde_json::json;
use system_tests::{Cell, Peer, eventually, resident};

use super::malformed::{BODY, Stranger, answer};
use super::{MAPPING, SOON, read, serving, write};

/// Starts the server, and creates a client with recorded frames.
fn site(mapping: &str) -> Option<(Cell, system_tests::Child, Stranger)> {
    let cell = Cell::with(&[Peer::Python])?;
    let server = serving(&cell, mapping);
    Some((cell, server, Stranger::new(1)))
}

fn answers(cell: &Cell) {
    assert_eq!(read(cell, "ns=0;i=2258")["status"], "Good");
}

#[test]
fn sessions_that_are_never_activated_lock_nobody_out() {
    let Some((cell, _server, stranger)) = site(MAPPING) else {
        return;
    };
    let mut open = Vec::new();
    for _ in 0..60 {
        let (mut stream, mut channel) = stranger.connected().unwrap();
        stranger.create_session(&mut stream, &mut channel).unwrap();
        open.push((stream, channel));
    }
    answers(&cell);
    // The newest session is still open. Its activation response has a nonce of 32 bytes (OPC
    // 10000-4, 5.7.3).
    let (mut stream, mut channel) = open.pop().unwrap();
    let activated = stranger
        .activate_session(&mut stream, &mut channel)
        .unwrap();
    let nonce = &activated[BODY + 4 + 24..];
    assert_eq!(nonce[..4], 32_u32.to_le_bytes());
    assert_ne!(nonce[4..36], [0; 32]);
}

#[test]
fn a_server_without_an_endpoint_for_it_has_no_session_without_security() {
    let mapping = MAPPING.replace("[None, Basic256Sha256]", "[Basic256Sha256]");
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let mapping = cell.file("server.yaml", &mapping);
    let _server = cell.ua_server(&[mapping.to_str().unwrap()]);
    let stranger = Stranger::new(1);
    let (mut stream, mut channel) =
        eventually("the server listens", SOON, || stranger.connected().ok());
    let refused = stranger.create_session(&mut stream, &mut channel);
    assert!(refused.is_err());
}

#[test]
fn idle_connections_give_way() {
    let Some((cell, server, stranger)) = site(MAPPING) else {
        return;
    };
    let open: Vec<_> = (0..400).map(|_| stranger.connected().unwrap()).collect();
    answers(&cell);
    let descriptors = fs::read_dir(format!("/proc/{}/fd", server.id())).unwrap();
    let descriptors = descriptors.count();
    assert!(descriptors < 250, "{descriptors} descriptors");
    drop(open);
    answers(&cell);
}

#[test]
fn a_client_without_a_session_takes_little_memory() {
    let Some((cell, server, stranger)) = site(MAPPING) else {
        return;
    };
    let before = resident(server.id());
    let mebibyte = vec![0; 1 << 20];
    let mut open = Vec::new();
    for number in 0..20 {
        let (mut stream, mut channel) = stranger.connected().unwrap();
        let sent = if number % 2 == 0 {
            // A chunk of almost 4 GiB.
            let begun = stream.write_all(b"MSGF\xf0\xff\xff\xff");
            (0..20).fold(begun, |sent, _| {
                sent.and_then(|()| stream.write_all(&mebibyte))
            })
        } else {
            (0..300).try_for_each(|_| {
                let mut chunk = vec![0; 60_000];
                chunk[..8].copy_from_slice(b"MSGC\x60\xea\0\0");
                stream.write_all(&channel.addressed(&chunk))
            })
        };
        // The server has closed the connection before all was sent.
        assert!(is_closed(sent), "connection {number}");
        open.push(stream);
    }
    let grown = resident(server.id()).saturating_sub(before);
    assert!(grown < 32 << 20, "{grown} bytes");
    answers(&cell);
}

/// Returns whether the server has closed a connection.
fn is_closed(sent: io::Result<()>) -> bool {
    let Err(error) = sent else { return false };
    let closed = [io::ErrorKind::ConnectionReset, io::ErrorKind::BrokenPipe];
    closed.contains(&error.kind())
}

#[test]
fn subscriptions_of_vanished_clients_end() {
    let Some((cell, _server, stranger)) = site(MAPPING) else {
        return;
    };
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../fuzz/corpus/opcua");
    let mut subscribe = fs::read(folder.join("create_subscription")).unwrap();
    // The request ends with the publishing interval (100 ms), the lifetime (30 intervals), the
    // keep-alive count, the maximum number of notifications, whether publishing is enabled, and the
    // priority.
    let begin = subscribe.len() - 22;
    subscribe[begin..begin + 8].copy_from_slice(&100_f64.to_le_bytes());
    subscribe[begin + 8..begin + 12].copy_from_slice(&30_u32.to_le_bytes());
    subscribe[begin + 12..begin + 16].copy_from_slice(&10_u32.to_le_bytes());
    for _ in 0..10 {
        let (mut stream, mut channel) = stranger.connected().unwrap();
        stranger.create_session(&mut stream, &mut channel).unwrap();
        stranger
            .activate_session(&mut stream, &mut channel)
            .unwrap();
        stream.write_all(&channel.addressed(&subscribe)).unwrap();
        answer(&mut stream).unwrap();
    }
    let count = || read(&cell, CURRENT_SUBSCRIPTIONS)["value"].clone();
    assert_eq!(count(), json!(10));
    eventually("the lifetime is over", SOON, || {
        (count() == json!(0)).then_some(())
    });
}

/// CurrentSubscriptionCount of the ServerDiagnosticsSummary.
const CURRENT_SUBSCRIPTIONS: &str = "ns=0;i=2285";

#[test]
fn arrays_are_written_without_elements() {
    let mapping =
        format!("{MAPPING}  - {{node: ns=2;i=40, name: profile, type: \"Double[]\", origin: 0}}\n");
    let mapping = mapping.replace("server:\n  security: [None, Basic256Sha256]\n", "");
    let Some((cell, _server, _)) = site(&mapping) else {
        return;
    };
    for value in ["[1.5, 2.5]", "[]"] {
        assert_eq!(
            write(&cell, "ns=2;i=40", "Double", value),
            "Good",
            "{value}"
        );
        let found = read(&cell, "ns=2;i=40");
        let wanted: serde_json::Value = value.parse().unwrap();
        assert_eq!(found["value"], wanted, "{found}");
    }
}
