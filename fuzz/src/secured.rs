//! Fuzzes a publisher and a subscriber of a SecurityGroup with an attacker between them.

use std::time::Duration;

use uadp::{
    DataSetHeader, Extras, NetworkHeader, NetworkMessage, NetworkMessageEncoder, Opener,
    PublisherId, Scalar, Sealer, SecurityMode, SecurityPolicy, TokenKeys,
};

use crate::input::Input;

/// Maximum number of messages; more messages add no coverage.
const MESSAGES: usize = 64;

/// Runs operations, each a byte: seal, deliver, deliver changed, change the key, deliver arbitrary
/// bytes. A message is accepted once, and only unchanged; a refused message leaves no trace.
pub fn secured(data: &[u8]) {
    let mut input = Input::new(data);
    let (policy, mode) = match input.byte() & 3 {
        0 => (SecurityPolicy::PubSubAes128Ctr, SecurityMode::Sign),
        1 => (
            SecurityPolicy::PubSubAes128Ctr,
            SecurityMode::SignAndEncrypt,
        ),
        2 => (SecurityPolicy::PubSubAes256Ctr, SecurityMode::Sign),
        _ => (
            SecurityPolicy::PubSubAes256Ctr,
            SecurityMode::SignAndEncrypt,
        ),
    };
    let own = hash(data);
    let mut sealer = Sealer::new(mode);
    let mut opener = Opener::new(mode);
    sealer
        .update_keys(7, keys(policy, own))
        .expect("a token and keys");
    opener
        .update_keys(7, keys(policy, own))
        .expect("a token and keys");
    let mut sent: Vec<Sent> = Vec::new();
    let mut scratch = Vec::new();
    while !input.is_empty() {
        match input.byte() % 5 {
            0 if sent.len() < MESSAGES => sent.push(Sent::seal(&mut sealer, &mut input)),
            1 => {
                let index = usize::from(input.byte());
                if let Some(message) = sent.get_mut(index) {
                    message.deliver(&mut opener, &mut scratch);
                }
            }
            2 => {
                let index = usize::from(input.byte());
                if let Some(message) = sent.get(index) {
                    deliver_changed(message, &mut input, &mut opener);
                }
            }
            3 => {
                sealer.next_key();
            }
            4 => {
                let anything = input.bytes();
                if sent.iter().all(|message| message.datagram != anything) {
                    refuse(anything, &mut opener);
                }
            }
            _ => {}
        }
    }
}

struct Sent {
    datagram: Vec<u8>,
    payload: Vec<u8>,
    accepted: bool,
}

impl Sent {
    fn seal(sealer: &mut Sealer, input: &mut Input<'_>) -> Self {
        let random = [input.byte(), input.byte(), 0, 0];
        let payload = input.bytes().to_vec();
        let seal = sealer.seal(random).expect("few messages for a key");
        let header = NetworkHeader {
            publisher_id: Some(PublisherId::Byte(random[0] & 3)),
            ..NetworkHeader::default()
        };
        let mut datagram = Vec::new();
        let extras = Extras {
            security: Some(seal.header()),
            ..Extras::default()
        };
        let mut message =
            NetworkMessageEncoder::with(&mut datagram, &header, Some(&[1]), &extras).expect("fits");
        let mut fields = message
            .key_frame(&DataSetHeader::default())
            .expect("announced");
        fields
            .scalar(Scalar::ByteString(Some(&payload)))
            .expect("fits");
        fields.finish().expect("complete");
        message.finish_sealed(seal).expect("complete");
        Self {
            datagram,
            payload,
            accepted: false,
        }
    }

    fn deliver(&mut self, opener: &mut Opener, scratch: &mut Vec<u8>) {
        let message = NetworkMessage::decode(&self.datagram).expect("our own");
        let Ok(opened) = opener.open(&message, Duration::ZERO, scratch) else {
            return;
        };
        assert!(!self.accepted, "accepted twice");
        self.accepted = true;
        let message = opened
            .message
            .messages()
            .next()
            .expect("one")
            .expect("ours");
        let field = message.fields().expect("ours").next().expect("one");
        let expected = Scalar::ByteString(Some(&self.payload)).into();
        assert_eq!(field, Ok(expected), "opened to something else");
    }
}

fn deliver_changed(message: &Sent, input: &mut Input<'_>, opener: &mut Opener) {
    let mut datagram = message.datagram.clone();
    let at = input.u16() as usize % datagram.len();
    datagram[at] ^= input.byte().max(1);
    refuse(&datagram, opener);
}

fn refuse(datagram: &[u8], opener: &mut Opener) {
    let before = format!("{opener:?}");
    let mut scratch = Vec::new();
    if let Ok(message) = NetworkMessage::decode(datagram) {
        let opened = opener.open(&message, Duration::ZERO, &mut scratch);
        assert!(opened.is_err(), "what nobody sent was accepted");
    }
    assert_eq!(before, format!("{opener:?}"), "refusing left a trace");
}

/// Returns keys that depend on the input: a fuzzer combines parts of inputs, and a message sealed
/// in another input would be genuine with common keys.
fn keys(policy: SecurityPolicy, own: u64) -> Vec<TokenKeys> {
    (0..3_u8)
        .map(|token| {
            let own = own.to_le_bytes();
            let data: Vec<u8> = (0..policy.key_data_length())
                .map(|at| own[at % own.len()] ^ token.wrapping_mul(37).wrapping_add(at as u8))
                .collect();
            TokenKeys::from_bytes(policy, &data).expect("the length the policy asks for")
        })
        .collect()
}

/// Returns the FNV-1a hash.
fn hash(data: &[u8]) -> u64 {
    data.iter().fold(0xCBF2_9CE4_8422_2325, |hash, byte| {
        (hash ^ u64::from(*byte)).wrapping_mul(0x100_0000_01B3)
    })
}
