//! Discovery of applications in the group: announcements in response to probes, and the limits of
//! stored applications.

use crate::cell;

use std::net::SocketAddr;
use std::time::Duration;

use bridge_core::{Application, ApplicationEndpoint, Local, MessageSecurityMode, Reason};
use cell::{SimulatedCell, SimulatedProgram, component};
use uadp::discovery::{AnnouncedContent, Announcement, ApplicationDescription, Probe, WireArray};
use uadp::{NetworkMessage, NetworkMessageType, PublisherId, SecurityHeader, StatusCode};

const SECOND: Duration = Duration::from_secs(1);

fn application(name: &str, url: Option<&str>) -> Application {
    let endpoint = |url: &str| ApplicationEndpoint {
        url: url.to_owned(),
        policy_uri: "http://opcfoundation.org/UA/SecurityPolicy#None".to_owned(),
        mode: MessageSecurityMode::NONE,
    };
    Application {
        uri: format!("urn:{name}"),
        product_uri: String::new(),
        name: name.to_owned(),
        urls: url.map(str::to_owned).into_iter().collect(),
        capabilities: vec!["DA".to_owned()],
        endpoints: url.map(endpoint).into_iter().collect(),
    }
}

/// Creates a bridge and a component in the same group, which announce their applications.
fn cell() -> SimulatedCell {
    let mut cell = SimulatedCell::new(vec![SimulatedProgram::new(1, Local::Ros1), component(7)]);
    let now = cell.now();
    let [bridge, gripper] = &mut cell.programs[..] else {
        panic!("two programs")
    };
    bridge.router.introduce(application("bridge", None), now);
    let url = Some("opc.tcp://127.0.0.1:4841/");
    gripper.router.introduce(application("gripper", url), now);
    cell
}

fn asked(probe: &Probe<'_>, publisher: Option<PublisherId<'_>>) -> Vec<u8> {
    let mut datagram = Vec::new();
    let encoded = probe.encode(publisher, SecurityHeader::NONE, &mut datagram);
    encoded.unwrap();
    datagram
}

#[test]
fn who_begins_learns_who_is_there_and_is_told_of_once() {
    let mut cell = cell();
    cell.run(3 * SECOND);
    let known = |at: usize| -> Vec<(u8, String, Vec<String>)> {
        let all = cell.programs[at].router.applications();
        all.map(|(space, _, one)| (space.get(), one.uri.clone(), one.urls.clone()))
            .collect()
    };
    let url = "opc.tcp://127.0.0.1:4841/".to_owned();
    assert_eq!(known(0), [(0, "urn:gripper".to_owned(), vec![url])]);
    assert_eq!(known(1), [(1, "urn:bridge".to_owned(), Vec::new())]);
    let before = cell.datagrams_of(0).len();
    cell.run(60 * SECOND);
    assert_eq!(cell.datagrams_of(0).len(), before, "nobody asks any more");
}

/// Returns the announcements of a program.
fn announced(cell: &mut SimulatedCell, at: usize) -> Vec<Vec<u8>> {
    let mut all = cell.datagrams_of(at);
    all.retain(|datagram| {
        let message = NetworkMessage::decode(datagram).unwrap();
        message.message_type() == NetworkMessageType::Announcement
    });
    all
}

/// Sends a datagram from another host to all programs.
fn say(cell: &mut SimulatedCell, port: u16, datagram: &[u8]) {
    let from = SocketAddr::from(([10, 0, 0, 9], port));
    for at in 0..cell.programs.len() {
        cell.hear(at, datagram, from);
    }
}

#[test]
fn a_flood_of_questions_is_answered_at_most_twice_a_second() {
    let mut cell = cell();
    cell.run(3 * SECOND);
    let before = announced(&mut cell, 1).len();
    let question = asked(&Probe::FindApplications, None);
    for _ in 0..1_000 {
        say(&mut cell, 1, &question);
        cell.run(Duration::from_millis(2));
    }
    let answers = announced(&mut cell, 1).len() - before;
    assert!((1..=5).contains(&answers), "{answers} in 2 s");
}

#[test]
fn endpoints_are_told_by_servers_and_others_say_that_they_have_none() {
    let mut cell = cell();
    for (space, urls, status) in [(0, 1, StatusCode::GOOD), (1, 0, StatusCode(0x803D_0000))] {
        let question = asked(&Probe::PublisherEndpoints, Some(PublisherId::UInt16(space)));
        say(&mut cell, 1, &question);
        cell.run(SECOND);
        let at = usize::from(space == 0);
        let all = announced(&mut cell, at);
        let told = all.iter().rev().find_map(|datagram| {
            let message = NetworkMessage::decode(datagram).unwrap();
            match Announcement::decode(&message).unwrap().announced {
                AnnouncedContent::PublisherEndpoints { endpoints, status } => {
                    Some((endpoints.len(), status))
                }
                _ => None,
            }
        });
        assert_eq!(told, Some((urls, status)), "space {space}");
    }
}

/// Returns the announcement of an application.
fn told(uri: &str) -> Vec<u8> {
    let description = ApplicationDescription {
        application_uri: Some(uri),
        ..ApplicationDescription::default()
    };
    let announcement = Announcement {
        sequence_number: 0,
        announced: AnnouncedContent::ApplicationDescription {
            description,
            capabilities: WireArray::null(),
        },
    };
    let mut datagram = Vec::new();
    let encoded = announcement.encode(PublisherId::UInt16(9), SecurityHeader::NONE, &mut datagram);
    encoded.unwrap();
    datagram
}

#[test]
fn what_cannot_be_shown_is_counted_and_whoever_makes_up_applications_takes_no_room() {
    let mut cell = cell();
    cell.run(3 * SECOND);
    for number in 0..2_000 {
        say(
            &mut cell,
            30_000 + number,
            &told(&format!("urn:forged:{number}")),
        );
    }
    say(&mut cell, 29_999, &told("urn:a\u{1b}[2J"));
    let bridge = &cell.programs[0].router;
    assert_eq!(bridge.applications().count(), 256);
    let shown = bridge
        .applications()
        .all(|(_, _, one)| !one.uri.contains('\u{1b}'));
    assert!(shown);
    assert_eq!(bridge.others().dropped(Reason::MetaData), 1);
}
