//! Captures made from the vectors.

use std::net::Ipv6Addr;

use serde_json::{Value, json};

use crate::program::{ProgramEnd, file, run, run_on};
use crate::vectors::DatagramVector;

const ETHERNET: u16 = 1;
const LINUX_SLL2: u16 = 276;
const RAW: u16 = 101;

/// 2026-05-17T12:34:56Z.
const SECONDS: u32 = 1_779_021_296;

/// Returns a pcap file of packets, one microsecond apart.
fn pcap(link_type: u16, packets: &[Vec<u8>]) -> Vec<u8> {
    let mut file = vec![0xD4, 0xC3, 0xB2, 0xA1, 2, 0, 4, 0];
    for number in [0, 0, 65_535, u32::from(link_type)] {
        file.extend(number.to_le_bytes());
    }
    for (packet, micros) in packets.iter().zip(0_u32..) {
        let length = u32::try_from(packet.len()).unwrap();
        for number in [SECONDS, micros, length, length] {
            file.extend(number.to_le_bytes());
        }
        file.extend(packet);
    }
    file
}

/// Returns a pcapng file in big endian, with an interface for each packet.
fn pcapng(packets: &[(u16, Vec<u8>)]) -> Vec<u8> {
    let block = |kind: u32, body: &[u8]| {
        let mut body = body.to_vec();
        body.resize(body.len().next_multiple_of(4), 0);
        let length = u32::try_from(body.len() + 12).unwrap().to_be_bytes();
        [&kind.to_be_bytes(), &length[..], &body, &length].concat()
    };
    let version = [0x1A, 0x2B, 0x3C, 0x4D, 0, 1, 0, 0];
    let mut file = block(0x0A0D_0D0A, &[&version[..], &[0xFF; 8]].concat());
    for ((link_type, packet), index) in packets.iter().zip(0_u32..) {
        let [a, b] = link_type.to_be_bytes();
        // Time stamps in nanoseconds.
        let interface = [a, b, 0, 0, 0, 0, 0, 0, 0, 9, 0, 1, 9, 0, 0, 0, 0, 0, 0, 0];
        file.extend(block(1, &interface));
        // A block of names, which has no effect.
        file.extend(block(4, &[0; 8]));
        let time = u64::from(SECONDS) * 1_000_000_000 + 7 + u64::from(index);
        let length = u32::try_from(packet.len()).unwrap().to_be_bytes();
        let head = [
            &index.to_be_bytes()[..],
            &time.to_be_bytes(),
            &length,
            &length,
        ]
        .concat();
        file.extend(block(6, &[head, packet.clone()].concat()));
    }
    file
}

fn udp(port: u16, payload: &[u8]) -> Vec<u8> {
    let length = u16::try_from(payload.len() + 8).unwrap();
    let header = [40_000, port, length, 0].map(u16::to_be_bytes);
    [header.as_flattened(), payload].concat()
}

fn ipv4(fragment: u16, body: &[u8]) -> Vec<u8> {
    let total = u16::try_from(body.len() + 20).unwrap().to_be_bytes();
    let fragment = fragment.to_be_bytes();
    let mut packet = vec![
        0x45,
        0,
        total[0],
        total[1],
        0,
        77,
        fragment[0],
        fragment[1],
        1,
        17,
        0,
        0,
    ];
    packet.extend([10, 0, 0, 1, 224, 0, 0, 22]);
    packet.extend(body);
    packet
}

fn ipv6(body: &[u8]) -> Vec<u8> {
    let length = u16::try_from(body.len()).unwrap().to_be_bytes();
    let mut packet = vec![0x60, 0, 0, 0, length[0], length[1], 17, 1];
    packet.extend("fe80::1".parse::<Ipv6Addr>().unwrap().octets());
    packet.extend("ff02::40".parse::<Ipv6Addr>().unwrap().octets());
    packet.extend(body);
    packet
}

fn ethernet(packet: &[u8]) -> Vec<u8> {
    let ether_type = if packet[0] >> 4 == 4 {
        [0x08, 0x00]
    } else {
        [0x86, 0xDD]
    };
    [&[0; 12][..], &ether_type, packet].concat()
}

/// Returns a vector as a frame to port 4840.
fn frame(name: &str) -> Vec<u8> {
    ethernet(&ipv4(0, &udp(4840, &DatagramVector::load(name).bytes())))
}

/// Returns the decoded output of a vector without a capture.
fn shown(name: &str) -> Value {
    let shown = run_on(&["decode", "-"], DatagramVector::load(name).hex.as_bytes()).quiet();
    serde_json::from_str(&shown).unwrap()
}

/// Removes the keys that a capture adds to an object.
fn alone(mut object: Value) -> Value {
    for key in ["time", "source", "destination"] {
        assert!(
            object.as_object_mut().unwrap().remove(key).is_some(),
            "{object}"
        );
    }
    object
}

fn decode(name: &str, capture: &[u8], more: &[&str]) -> ProgramEnd {
    let file = file(name, capture);
    run(&[&["decode", &file][..], more].concat())
}

#[test]
fn every_datagram_of_a_pcap_is_a_line_with_time_and_addresses() {
    let names = [
        "wire_tutorial_layout",
        "wire_two_writers",
        "composite_probe_metadata",
    ];
    let capture = pcap(ETHERNET, &names.map(frame));
    let ended = decode("three.pcap", &capture, &[]);
    let lines = ended.lines();
    assert_eq!((ended.code, ended.stderr.as_str(), lines.len()), (0, "", 3));
    assert_eq!(lines[1]["time"], "2026-05-17T12:34:56.000001000Z");
    assert_eq!(lines[1]["source"], "10.0.0.1:40000");
    assert_eq!(lines[1]["destination"], "224.0.0.22:4840");
    assert!(ended.stdout.starts_with("{\"time\":"), "time comes first");
    for (line, name) in lines.into_iter().zip(names) {
        assert_eq!(alone(line), shown(name));
    }
    let piped = run_on(&["decode", "-"], &capture);
    assert_eq!(piped.quiet(), ended.stdout);
}

#[test]
fn a_pcapng_may_mix_link_layers_and_address_families() {
    let payload = |name: &str| DatagramVector::load(name).bytes();
    let vlan = [
        &[0; 12][..],
        &[0x81, 0, 0, 5, 0x08, 0],
        &ipv4(0, &udp(4840, &payload("pubid_byte"))),
    ]
    .concat();
    let capture = pcapng(&[
        (ETHERNET, vlan),
        (RAW, ipv6(&udp(4840, &payload("pubid_uint16")))),
        (
            LINUX_SLL2,
            [&[0; 20][..], &ipv4(0, &udp(4840, &payload("pubid_string")))].concat(),
        ),
    ]);
    let ended = decode("mixed.pcapng", &capture, &[]);
    assert_eq!((ended.code, ended.stderr.as_str()), (0, ""));
    let lines = ended.lines();
    assert_eq!(lines[1]["time"], "2026-05-17T12:34:56.000000008Z");
    assert_eq!(lines[1]["source"], "[fe80::1]:40000");
    assert_eq!(lines[1]["destination"], "[ff02::40]:4840");
    for (line, name) in lines
        .into_iter()
        .zip(["pubid_byte", "pubid_uint16", "pubid_string"])
    {
        assert_eq!(alone(line), shown(name));
    }
}

#[test]
fn one_bad_datagram_does_not_stop_the_others_and_ends_with_65() {
    let names = [
        "pubid_byte",
        "asyncua_pubid_uint64",
        "asyncua_promoted",
        "pubid_uint16",
    ];
    let ended = decode("bad.pcap", &pcap(ETHERNET, &names.map(frame)), &[]);
    assert_eq!(ended.code, 65);
    let lines = ended.lines();
    assert_eq!(lines.len(), 4);
    assert_eq!(alone(lines[0].clone()), shown("pubid_byte"));
    assert_eq!(alone(lines[3].clone()), shown("pubid_uint16"));
    let said = "offset 1, PublisherId type: the reserved value 0x6";
    assert_eq!(
        alone(lines[1].clone()),
        json!({ "malformed": said, "datagramHex": DatagramVector::load(names[1]).hex })
    );
    let place = "packet 2, 10.0.0.1:40000 to 224.0.0.22:4840";
    assert!(
        ended
            .stderr
            .contains(&format!("bad.pcap: {place}: {said}\n")),
        "{}",
        ended.stderr
    );
    assert!(
        lines[2]["malformed"]
            .as_str()
            .unwrap()
            .starts_with("offset 14, in the PromotedFields")
    );
}

#[test]
fn the_port_says_what_is_looked_at() {
    let to = |port, name| ethernet(&ipv4(0, &udp(port, &DatagramVector::load(name).bytes())));
    // A name query, and a malformed datagram to an unusual port.
    let dns = [
        0x31, 0x01, 1, 0, 0, 1, 0, 0, 0, 0, 0, 0, 4, b'r', b'o', b's', b'1', 0, 0, 1, 0, 1,
    ];
    let capture = pcap(
        ETHERNET,
        &[
            to(4840, "pubid_byte"),
            to(5000, "pubid_uint16"),
            ethernet(&ipv4(0, &udp(53, &dns))),
            to(5000, "asyncua_promoted"),
        ],
    );
    let any = decode("ports.pcap", &capture, &[]);
    assert_eq!(any.code, 0);
    assert_eq!(any.lines().len(), 2);
    assert!(
        any.stderr.ends_with(
            "2 datagrams of other ports than 4840 are no NetworkMessages; --port shows why\n"
        ),
        "{}",
        any.stderr
    );
    let one = decode("ports.pcap", &capture, &["--port", "5000"]);
    assert_eq!((one.code, one.lines().len()), (65, 2));
    assert!(one.stderr.contains("packet 4, "), "{}", one.stderr);
    let none = decode("ports.pcap", &capture, &["--port", "1"]);
    assert_eq!((none.code, none.stdout.as_str()), (0, ""));
    assert!(
        none.stderr
            .ends_with("nothing to show in 4 packets, 4 of them UDP\n"),
        "{}",
        none.stderr
    );
}

#[test]
fn fragments_are_put_together_and_missing_ones_told() {
    let body = udp(4840, &DatagramVector::load("bench_bytestring_1k").bytes());
    let (first, rest) = body.split_at(800);
    let pieces = [ipv4(0x2000, first), ipv4(100, rest)];
    let ended = decode("pieces.pcap", &pcap(RAW, &pieces), &[]);
    assert_eq!(
        alone(ended.lines()[0].clone()),
        shown("bench_bytestring_1k")
    );
    assert_eq!((ended.code, ended.stderr.as_str()), (0, ""));
    let ended = decode("piece.pcap", &pcap(RAW, &pieces[..1]), &[]);
    assert_eq!((ended.code, ended.stdout.as_str()), (0, ""));
    assert!(
        ended.stderr.contains("1 IP datagrams lack fragments"),
        "{}",
        ended.stderr
    );
}

#[test]
fn chunks_are_shown_and_put_together() {
    let names = [
        "composite_chunk_2",
        "composite_chunk_0",
        "composite_chunk_0",
        "composite_chunk_1",
    ];
    let ended = decode("chunks.pcap", &pcap(ETHERNET, &names.map(frame)), &[]);
    assert_eq!((ended.code, ended.stderr.as_str()), (0, ""));
    let lines = ended.lines();
    assert_eq!(lines.len(), 5, "each chunk, and the whole");
    for (line, name) in lines.iter().zip(names) {
        assert_eq!(alone(line.clone()), shown(name));
    }
    let whole = &lines[4];
    assert_eq!(
        whole["reassembled"],
        json!({ "messageSequenceNumber": 77, "totalSize": 610 })
    );
    assert_eq!(
        whole["time"], "2026-05-17T12:34:56.000003000Z",
        "that of the last chunk"
    );
    assert_eq!(whole["dataSetWriterIds"], json!([5]));
    let message = &whole["dataSetMessages"][0];
    assert_eq!(message["sequenceNumber"], 77);
    let bytes: Vec<u8> = (0..600_u16)
        .map(|n| u8::try_from((n * 3) & 255).unwrap())
        .collect();
    use base64::Engine as _;
    let text = base64::engine::general_purpose::STANDARD.encode(bytes);
    assert_eq!(
        message["fields"],
        json!([{ "value": { "UaType": 15, "Value": text } }])
    );
    // The output is a NetworkMessage that can be encoded unchanged.
    let hex = run_on(&["encode", "-"], whole.to_string().as_bytes()).quiet();
    assert!(
        hex.starts_with("f101ba080164000105 00094d00".replace(' ', "").as_str()),
        "{hex}"
    );

    let ended = decode(
        "chunk.pcap",
        &pcap(
            ETHERNET,
            &names[..2]
                .iter()
                .map(|name| frame(name))
                .collect::<Vec<_>>(),
        ),
        &[],
    );
    assert_eq!((ended.code, ended.lines().len()), (0, 2));
    assert!(
        ended
            .stderr
            .contains("not every message has all its chunks"),
        "{}",
        ended.stderr
    );
}

#[test]
fn an_announcement_in_chunks_is_read_as_a_whole() {
    let json = DatagramVector::load("composite_announce_metadata").json;
    let body = DatagramVector::load("composite_announce_metadata").hex[22..].to_owned();
    let (first, second) = body.split_at(200);
    let chunk = |offset: usize, data: &str| {
        json!({
            "publisherId": json["publisherId"],
            "networkMessageType": "discoveryAnnouncement",
            "securityHeader": json["securityHeader"],
            "chunk": {
                "messageSequenceNumber": 7,
                "chunkOffset": offset,
                "totalSize": body.len() / 2,
                "chunkDataHex": data,
            },
        })
    };
    let chunks = json!([chunk(0, first), chunk(100, second)]);
    let hex = run_on(&["encode", "-"], chunks.to_string().as_bytes()).quiet();
    let ended = run_on(&["decode", "--lines", "-"], hex.as_bytes());
    let lines = ended.lines();
    assert_eq!((ended.code, ended.stderr.as_str(), lines.len()), (0, "", 3));
    assert_eq!(
        lines[2]["announcement"],
        shown("composite_announce_metadata")["announcement"]
    );
}

#[test]
fn a_datagram_that_was_not_captured_whole_says_so() {
    let mut packet = frame("wire_two_writers");
    packet.truncate(packet.len() - 10);
    let ended = decode("snapped.pcap", &pcap(ETHERNET, &[packet]), &[]);
    assert_eq!(ended.code, 65);
    assert!(
        ended
            .stderr
            .contains(" (10 bytes were not captured): offset "),
        "{}",
        ended.stderr
    );
}

#[test]
fn a_capture_that_is_cut_off_shows_what_it_has() {
    let capture = pcap(ETHERNET, &["pubid_byte", "pubid_uint16"].map(frame));
    let ended = decode("cut.pcap", &capture[..capture.len() - 1], &["--array"]);
    assert_eq!(ended.code, 65);
    let shown: Value = serde_json::from_str(&ended.stdout).unwrap();
    assert_eq!(shown.as_array().unwrap().len(), 1);
    assert!(
        ended
            .stderr
            .ends_with("cut.pcap: the capture ends inside of what starts at byte 102\n"),
        "{}",
        ended.stderr
    );
}

#[test]
fn a_link_layer_that_is_not_read_is_named() {
    let ended = decode("link.pcap", &pcap(147, &[vec![1, 2, 3]]), &[]);
    assert_eq!((ended.code, ended.stdout.as_str()), (0, ""));
    assert!(
        ended
            .stderr
            .contains("1 packets of LINKTYPE 147, which is not read"),
        "{}",
        ended.stderr
    );
}

#[test]
fn secured_datagrams_of_a_capture_are_opened_each_with_its_keys() {
    let names = [
        "wire_encrypt_aes128_r0",
        "wire_sign_aes128",
        "wire_encrypt_aes256",
        "pubid_byte",
    ];
    let capture = pcap(ETHERNET, &names.map(frame));
    let keys: Vec<_> = names[..3]
        .iter()
        .map(|name| DatagramVector::load(name).json["security"].clone())
        .collect();
    let keys = file("capture.keys.json", json!(keys).to_string());
    let ended = decode("secured.pcap", &capture, &["--keys", &keys]);
    assert_eq!((ended.code, ended.stderr.as_str()), (0, ""));
    assert!(
        ended
            .lines()
            .iter()
            .all(|line| line["dataSetMessages"].is_array())
    );
    let ended = decode("secured.pcap", &capture, &[]);
    assert_eq!(ended.code, 0);
    assert!(
        ended
            .stderr
            .ends_with("3 secured, and shown as they are without --keys\n"),
        "{}",
        ended.stderr
    );
}
