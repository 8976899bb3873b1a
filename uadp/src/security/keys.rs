//! Keys of a SecurityTokenId, and the algorithms initialized with them.

use alloc::boxed::Box;
use alloc::vec::Vec;
use core::fmt;

use aes::{Aes128Enc, Aes256Enc};
use ctr::CtrCore;
use ctr::cipher::{
    BlockCipherEncrypt, BlockSizeUser, InnerIvInit, KeyInit, StreamCipherCore, StreamCipherError,
    consts::U16,
};
use hmac::{Hmac, Mac};
use sha2::Sha256;
use subtle::ConstantTimeEq;
use zeroize::Zeroizing;

use super::{KEY_NONCE, KeyError, MESSAGE_NONCE, Nonce, SIGNATURE, SIGNING_KEY, SecurityPolicy};

/// Key data of a SecurityTokenId, ready for use (OPC 10000-14, 7.2.4.4.3.1).
///
/// Comparison takes constant time. The key data is overwritten with zeros on drop; `Debug` shows
/// the policy only.
#[derive(Clone)]
pub struct TokenKeys(Box<Prepared>);

#[derive(Clone)]
struct Prepared {
    policy: SecurityPolicy,
    key_data: Zeroizing<Vec<u8>>,
    key_nonce: Zeroizing<[u8; KEY_NONCE]>,
    mac: Hmac<Sha256>,
    cipher: Cipher,
}

#[derive(Clone)]
enum Cipher {
    Aes128(Aes128Enc),
    Aes256(Aes256Enc),
}

impl TokenKeys {
    /// Reads SigningKey (32 bytes), EncryptingKey (16 or 32) and KeyNonce (4) from a ByteString of
    /// GetSecurityKeys.
    ///
    /// # Errors
    /// [`KeyError::Length`].
    pub fn from_bytes(policy: SecurityPolicy, key_data: &[u8]) -> Result<Self, KeyError> {
        Prepared::from_bytes(policy, key_data)
            .map(|prepared| Self(Box::new(prepared)))
            .ok_or_else(|| KeyError::Length {
                policy,
                expected: policy.key_data_length(),
                found: key_data.len(),
            })
    }

    /// Returns the policy of the keys.
    #[must_use]
    pub const fn policy(&self) -> SecurityPolicy {
        self.0.policy
    }

    pub(super) fn signature(&self, signed: &[u8]) -> [u8; SIGNATURE] {
        let mut mac = self.0.mac.clone();
        mac.update(signed);
        mac.finalize().into_bytes().into()
    }

    /// Verifies a signature in constant time.
    pub(super) fn verify(&self, signed: &[u8], signature: &[u8]) -> bool {
        let mut mac = self.0.mac.clone();
        mac.update(signed);
        mac.verify_slice(signature).is_ok()
    }

    /// Encrypts or decrypts; both are the same operation. Fails only beyond 64 GiB, at the end of
    /// the block counter.
    pub(super) fn apply_keystream(
        &self,
        nonce: Nonce,
        bytes: &mut [u8],
    ) -> Result<(), StreamCipherError> {
        let block = self.0.counter_block(nonce);
        match &self.0.cipher {
            Cipher::Aes128(cipher) => apply(cipher, block, bytes),
            Cipher::Aes256(cipher) => apply(cipher, block, bytes),
        }
    }
}

impl Prepared {
    fn from_bytes(policy: SecurityPolicy, key_data: &[u8]) -> Option<Self> {
        let (signing, rest) = key_data.split_at_checked(SIGNING_KEY)?;
        let (encrypting, key_nonce) = rest.split_at_checked(policy.encrypting_key_length())?;
        Some(Self {
            policy,
            key_data: Zeroizing::new(key_data.to_vec()),
            key_nonce: Zeroizing::new(key_nonce.try_into().ok()?),
            mac: Hmac::new_from_slice(signing).ok()?,
            cipher: match policy {
                SecurityPolicy::PubSubAes128Ctr => {
                    Cipher::Aes128(Aes128Enc::new_from_slice(encrypting).ok()?)
                }
                SecurityPolicy::PubSubAes256Ctr => {
                    Cipher::Aes256(Aes256Enc::new_from_slice(encrypting).ok()?)
                }
            },
        })
    }

    /// Returns the first counter block: KeyNonce, MessageNonce, and 1 as big-endian UInt32
    /// (OPC 10000-14, 7.2.4.4.3.2).
    fn counter_block(&self, nonce: Nonce) -> [u8; 16] {
        let mut block = [0; 16];
        let parts = self.key_nonce.iter().copied().chain(nonce.to_bytes());
        for (place, byte) in block.iter_mut().zip(parts.chain(1_u32.to_be_bytes())) {
            *place = byte;
        }
        block
    }
}

fn apply<C: BlockCipherEncrypt + BlockSizeUser<BlockSize = U16>>(
    cipher: &C,
    block: [u8; 16],
    bytes: &mut [u8],
) -> Result<(), StreamCipherError> {
    CtrCore::<&C, ctr::flavors::Ctr32BE>::inner_iv_init(cipher, &block.into())
        .try_apply_keystream_partial(bytes.into())
}

impl PartialEq for TokenKeys {
    fn eq(&self, other: &Self) -> bool {
        // Each policy has a different length of key data, so the policies need no comparison.
        self.0.key_data.ct_eq(&other.0.key_data).into()
    }
}

impl Eq for TokenKeys {}

impl fmt::Debug for TokenKeys {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Keys")
            .field("policy", &self.policy())
            .finish_non_exhaustive()
    }
}

const _: () = assert!(KEY_NONCE + MESSAGE_NONCE + size_of::<u32>() == 16);

#[cfg(test)]
mod tests {
    use super::*;

    fn bytes(hex: &str) -> Vec<u8> {
        let digits: Vec<u32> = hex.chars().map(|c| c.to_digit(16).unwrap()).collect();
        digits
            .chunks_exact(2)
            .map(|pair| u8::try_from(pair[0] << 4 | pair[1]).unwrap())
            .collect()
    }

    /// Test vectors 1 to 3 and 7 to 9 of RFC 3686; vectors 4 to 6 are for AES with 192 bits.
    #[test]
    fn the_counter_block_is_that_of_rfc_3686() {
        let counting: Vec<u8> = (0..36).collect();
        for (key, key_nonce, nonce, plain, cipher) in [
            (
                "AE6852F8121067CC4BF7A5765577F39E",
                "00000030",
                "0000000000000000",
                &b"Single block msg"[..],
                "E4095D4FB7A7B3792D6175A3261311B8",
            ),
            (
                "7E24067817FAE0D743D6CE1F32539163",
                "006CB6DB",
                "C0543B59DA48D90B",
                &counting[..32],
                "5104A106168A72D9790D41EE8EDAD388EB2E1EFC46DA57C8FCE630DF9141BE28",
            ),
            (
                "7691BE035E5020A8AC6E618529F9A0DC",
                "00E0017B",
                "27777F3F4A1786F0",
                &counting,
                "C1CF48A89F2FFDD9CF4652E9EFDB72D74540A42BDE6D7836D59A5CEAAEF3105325B2072F",
            ),
            (
                "776BEFF2851DB06F4C8A0542C8696F6C6A81AF1EEC96B4D37FC1D689E6C1C104",
                "00000060",
                "DB5672C97AA8F0B2",
                b"Single block msg",
                "145AD01DBF824EC7560863DC71E3E0C0",
            ),
            (
                "F6D66D6BD52D59BB0796365879EFF886C66DD51A5B6A99744B50590C87A23884",
                "00FAAC24",
                "C1585EF15A43D875",
                &counting[..32],
                "F05E231B3894612C49EE000B804EB2A9B8306B508F839D6A5530831D9344AF1C",
            ),
            (
                "FF7A617CE69148E4F1726E2F43581DE2AA62D9F805532EDFF1EED687FB54153D",
                "001CC5B7",
                "51A51D70A1C11148",
                &counting,
                "EB6C52821D0BBBF7CE7594462ACA4FAAB407DF866569FD07F48CC0B583D6071F1EC0E6B8",
            ),
        ] {
            let policy = match key.len() {
                32 => SecurityPolicy::PubSubAes128Ctr,
                _ => SecurityPolicy::PubSubAes256Ctr,
            };
            let key_data = [vec![0; 32], bytes(key), bytes(key_nonce)].concat();
            let keys = TokenKeys::from_bytes(policy, &key_data).unwrap();
            let nonce = Nonce::from_bytes(bytes(nonce).try_into().unwrap());
            let mut text = plain.to_vec();
            keys.apply_keystream(nonce, &mut text).unwrap();
            assert_eq!(text, bytes(cipher));
            keys.apply_keystream(nonce, &mut text).unwrap();
            assert_eq!(text, plain);
        }
    }
}
