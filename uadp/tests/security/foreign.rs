//! Datagrams of another stack: opened, and encoded again byte for byte.

use std::path::Path;

use serde_json::Value;
use uadp::{
    DataSetHeader, DecodeError, Extras, NetworkMessage, NetworkMessageEncoder, Opener, Seal,
    SecurityError, SecurityMode, SecurityPolicy, TokenKeys,
};

use super::START;

struct Foreign {
    name: &'static str,
    datagram: Vec<u8>,
    json: Value,
}

const NAMES: [&str; 6] = [
    "wire_encrypt_aes128_r0",
    "wire_encrypt_aes128_r1",
    "wire_encrypt_aes128_r2",
    "wire_encrypt_aes256",
    "wire_encrypt_raw_aes128",
    "wire_sign_aes128",
];

impl Foreign {
    fn all() -> impl Iterator<Item = Self> {
        NAMES.into_iter().map(Self::load)
    }

    fn load(name: &'static str) -> Self {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/vectors");
        let read = |extension| {
            std::fs::read_to_string(folder.join(name).with_extension(extension)).unwrap()
        };
        Self {
            name,
            datagram: bytes(read("hex").trim()),
            json: serde_json::from_str(&read("json")).unwrap(),
        }
    }

    fn said(&self, what: &str) -> &str {
        self.json["security"][what].as_str().unwrap()
    }

    fn keys(&self) -> TokenKeys {
        let policy = SecurityPolicy::from_uri(self.said("policy")).unwrap();
        let parts = ["signingKey", "encryptingKey", "keyNonce"].map(|part| bytes(self.said(part)));
        TokenKeys::from_bytes(policy, &parts.concat()).unwrap()
    }

    fn mode(&self) -> SecurityMode {
        match self.said("mode") {
            "Sign" => SecurityMode::Sign,
            "SignAndEncrypt" => SecurityMode::SignAndEncrypt,
            other => unreachable!("mode {other}"),
        }
    }

    fn token(&self) -> u32 {
        self.json["security"]["securityTokenId"].as_u64().unwrap() as u32
    }

    /// Returns the payload before encryption.
    fn payload(&self) -> Vec<u8> {
        let offset = |what| self.json["security"][what].as_u64().unwrap() as usize;
        match self.mode() {
            SecurityMode::Sign => {
                self.datagram[offset("payloadOffset")..offset("signatureOffset")].to_vec()
            }
            SecurityMode::SignAndEncrypt => bytes(self.said("decryptedPayload")),
        }
    }

    fn opener(&self) -> Opener {
        let mut opener = Opener::new(self.mode());
        opener.update_keys(self.token(), [self.keys()]).unwrap();
        opener
    }
}

fn bytes(hex: &str) -> Vec<u8> {
    let digit = |c: char| c.to_digit(16).unwrap() as u8;
    let digits: Vec<u8> = hex.chars().map(digit).collect();
    digits
        .chunks_exact(2)
        .map(|pair| pair[0] << 4 | pair[1])
        .collect()
}

#[test]
fn every_secured_vector_is_among_those_tested() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/vectors");
    let mut found: Vec<String> = std::fs::read_dir(folder)
        .unwrap()
        .map(|file| file.unwrap().path())
        .filter(|path| {
            path.extension()
                .is_some_and(|extension| extension == "json")
        })
        .filter(|path| {
            let json: Value = serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap();
            json["security"].is_object()
        })
        .map(|path| path.file_stem().unwrap().to_str().unwrap().to_owned())
        .collect();
    found.sort();
    assert_eq!(found, NAMES);
}

#[test]
fn datagrams_of_open62541_are_opened() {
    for foreign in Foreign::all() {
        let message = NetworkMessage::decode(&foreign.datagram).unwrap();
        let mut scratch = Vec::new();
        let opened = foreign
            .opener()
            .open(&message, START, &mut scratch)
            .unwrap();
        assert_eq!(
            opened.message.payload(),
            foreign.payload(),
            "{}",
            foreign.name
        );
        assert!(opened.message.footer().is_empty());
        assert!(!opened.force_key_reset && !opened.key_changed && !opened.constant_sequence);
        assert_eq!(opened.message.header(), message.header());
        assert_eq!(opened.message.datagram(), foreign.datagram);
        let data_set_message = opened.message.messages().next().unwrap().unwrap();
        let said = foreign.json["dataSetMessages"][0]["sequenceNumber"].as_u64();
        assert_eq!(
            data_set_message.header().sequence_number.map(u64::from),
            said
        );
        assert_eq!(data_set_message.writer_id, Some(1));
    }
}

#[test]
fn a_sealed_message_cannot_be_read_before_it_is_opened() {
    let sealed = DecodeError::Misread("secured, to be opened with its keys first");
    for foreign in Foreign::all() {
        let message = NetworkMessage::decode(&foreign.datagram).unwrap();
        assert!(message.is_sealed());
        assert_eq!(message.messages().next().unwrap().unwrap_err(), sealed);
        assert_eq!(message.chunk().unwrap_err(), sealed);
        assert_eq!(message.data_set_message_at(24, 3).unwrap_err(), sealed);
    }
}

#[test]
fn what_is_only_signed_is_read_where_it_is() {
    let foreign = Foreign::load("wire_sign_aes128");
    let message = NetworkMessage::decode(&foreign.datagram).unwrap();
    let mut scratch = Vec::new();
    let opened = foreign
        .opener()
        .open(&message, START, &mut scratch)
        .unwrap();
    assert_eq!(
        opened.message.payload().as_ptr(),
        message.payload().as_ptr()
    );
    assert_eq!(scratch.capacity(), 0);
}

#[test]
fn sealed_with_the_same_nonce_they_are_the_same_datagrams() {
    for foreign in Foreign::all() {
        let keys = foreign.keys();
        let message = NetworkMessage::decode(&foreign.datagram).unwrap();
        let nonce = message.security().unwrap().nonce.try_into().unwrap();
        let payload = foreign.payload();
        let headers = foreign.datagram.len() - message.payload().len();
        let seal = || Seal::with_nonce(&keys, foreign.token(), foreign.mode(), nonce);

        let mut applied = vec![0xAA; 3];
        applied.extend(&foreign.datagram[..headers]);
        applied.extend(&payload);
        seal().apply(&mut applied, 3).unwrap();
        assert_eq!(applied[3..], foreign.datagram, "{}", foreign.name);

        let seal = seal();
        let extras = Extras {
            security: Some(seal.header()),
            ..Extras::default()
        };
        let mut written = vec![0xAA; 7];
        let ids: Vec<u16> = message.writer_ids().unwrap().collect();
        let mut encoder =
            NetworkMessageEncoder::with(&mut written, &message.header(), Some(&ids), &extras)
                .unwrap();
        let header = DataSetHeader {
            sequence_number: Some(u16::from_le_bytes([payload[1], payload[2]])),
            ..DataSetHeader::default()
        };
        let fields = &payload[3..];
        if foreign.name == "wire_encrypt_raw_aes128" {
            encoder
                .raw_key_frame(&header, |out| {
                    out.extend(fields);
                    Ok(())
                })
                .unwrap();
        } else {
            let mut block = encoder.key_frame(&header).unwrap();
            block.fields_block(fields).unwrap();
            block.finish().unwrap();
        }
        encoder.finish_sealed(seal).unwrap();
        assert_eq!(written[7..], foreign.datagram, "{}", foreign.name);
    }
}

#[test]
fn a_changed_bit_anywhere_is_refused_and_leaves_no_trace() {
    for foreign in Foreign::all() {
        let mut opener = foreign.opener();
        let before = format!("{opener:?}");
        for bit in 0..foreign.datagram.len() * 8 {
            let mut datagram = foreign.datagram.clone();
            datagram[bit / 8] ^= 1 << (bit % 8);
            let Ok(message) = NetworkMessage::decode(&datagram) else {
                continue;
            };
            let refused = opener.open(&message, START, &mut Vec::new()).map(|_| ());
            assert!(refused.is_err(), "{}: bit {bit}", foreign.name);
            assert_eq!(format!("{opener:?}"), before, "{}: bit {bit}", foreign.name);
        }
        let message = NetworkMessage::decode(&foreign.datagram).unwrap();
        assert!(opener.open(&message, START, &mut Vec::new()).is_ok());
    }
}

#[test]
fn a_datagram_cut_short_or_with_a_tail_is_refused() {
    for foreign in Foreign::all() {
        let mut opener = foreign.opener();
        let mut longer = foreign.datagram.clone();
        longer.push(0);
        for len in 0..=longer.len() {
            let opened = NetworkMessage::decode(&longer[..len])
                .is_ok_and(|message| opener.open(&message, START, &mut Vec::new()).is_ok());
            assert_eq!(opened, len == foreign.datagram.len(), "{} bytes", len);
        }
    }
}

#[test]
fn open62541_1_5_is_refused_after_its_first_message_unless_told_otherwise() {
    let foreign: Vec<Foreign> = Foreign::all().take(3).collect();
    let messages: Vec<_> = foreign
        .iter()
        .map(|foreign| NetworkMessage::decode(&foreign.datagram).unwrap())
        .collect();
    let results = |opener: &mut Opener| -> Vec<_> {
        let mut open = |message| {
            let mut scratch = Vec::new();
            let opened = opener.open(message, START, &mut scratch);
            opened.map(|opened| opened.constant_sequence)
        };
        let results = messages.iter().map(&mut open).collect();
        assert_eq!(open(&messages[2]), Err(SecurityError::Replayed(1)));
        results
    };
    let again = Err(SecurityError::Replayed(1));
    assert_eq!(results(&mut foreign[0].opener()), [Ok(false), again, again]);

    let mut lenient = Opener::with(
        SecurityMode::SignAndEncrypt,
        uadp::OpenerOptions {
            accept_constant_sequence: true,
            ..uadp::OpenerOptions::default()
        },
    );
    lenient.update_keys(1, [foreign[0].keys()]).unwrap();
    assert_eq!(results(&mut lenient), [Ok(false), Ok(true), Ok(true)]);

    let mut forged = foreign[0].datagram.clone();
    *forged.last_mut().unwrap() ^= 1;
    let forged = NetworkMessage::decode(&forged).unwrap();
    let refused = lenient.open(&forged, START, &mut Vec::new()).map(|_| ());
    assert_eq!(refused, Err(SecurityError::Signature));
}
