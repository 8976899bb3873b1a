//! Reads keys of secured messages from a file.

use std::io::Read as _;
use std::path::Path;
use std::time::Duration;

use serde::Deserialize;
use serde::de::IgnoredAny;
use uadp::{
    KeyError, NetworkMessage, Opener, SecurityError, SecurityMode, SecurityPolicy, TokenKeys,
};

use crate::exit::CommandFailure;
use crate::shape::PublisherIdJson;
use crate::{hex, json_file, selector};

/// The reason why no key of a file opens a sealed message.
#[derive(Debug, thiserror::Error)]
pub(crate) enum NoFittingKey {
    #[error("no keys of SecurityTokenId {token_id} for this publisher in {file}")]
    NoToken { token_id: u32, file: String },
    #[error(
        "the signature is wrong: {file} has other keys of SecurityTokenId {token_id}, or the datagram was changed"
    )]
    Signature { token_id: u32, file: String },
    #[error("not to be opened: {0}")]
    Other(SecurityError),
}

/// A fault of a key in a file.
#[derive(Debug, thiserror::Error)]
enum WrongKey {
    #[error("`{0}` is no SecurityPolicy of PubSub")]
    Policy(String),
    #[error("{part}: {error}")]
    Hex {
        part: &'static str,
        error: hex::HexError,
    },
    #[error(transparent)]
    Length(#[from] KeyError),
}

/// The keys of a file.
#[derive(Debug)]
pub(crate) struct KeyFile {
    name: String,
    entries: Vec<KeyFileEntry>,
}

#[derive(Debug)]
struct KeyFileEntry {
    written: WrittenKey,
    keys: TokenKeys,
}

/// The parts of a key of a SecurityGroup; texts are hexadecimal.
#[derive(Debug, Deserialize)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
struct WrittenKey {
    /// The SecurityPolicyUri.
    policy: String,
    security_token_id: u32,
    signing_key: String,
    encrypting_key: String,
    key_nonce: String,
    /// Limits the key to this publisher and WriterGroup.
    publisher_id: Option<selector::PublisherSelector>,
    writer_group_id: Option<u16>,
    /// Keys of test vectors that are ignored: values that the messages contain, and expected
    /// results.
    #[serde(default, rename = "mode")]
    _mode: IgnoredAny,
    #[serde(default, rename = "payloadOffset")]
    _payload_offset: IgnoredAny,
    #[serde(default, rename = "signatureOffset")]
    _signature_offset: IgnoredAny,
    #[serde(default, rename = "signatureLength")]
    _signature_length: IgnoredAny,
    #[serde(default, rename = "decryptedPayload")]
    _decrypted_payload: IgnoredAny,
    #[serde(default, rename = "signatureVerifiedIndependently")]
    _verified: IgnoredAny,
}

impl KeyFile {
    /// Reads the keys; warns if other users can read the file.
    pub(crate) fn read(path: &Path, warn: impl FnOnce(&str)) -> Result<Self, CommandFailure> {
        let name = path.display().to_string();
        let text = json_file::read(path)?;
        if let Some(mode) = others_may_read(path) {
            warn(&format!(
                "{name}: mode {mode:04o} lets others read the keys; chmod 600 {name}"
            ));
        }
        let written: Vec<WrittenKey> =
            json_file::one_or_many(&text).map_err(|error| json_file::explain(&name, &error))?;
        let mut entries = Vec::new();
        for (written, at) in written.into_iter().zip(0..) {
            let keys = written.keys();
            let keys =
                keys.map_err(|error| CommandFailure::Data(format!("{name}: key {at}: {error}")))?;
            entries.push(KeyFileEntry { written, keys });
        }
        Ok(Self { name, entries })
    }

    /// Returns all keys that match the signature of a sealed message, at least one.
    ///
    /// Each message is verified independently, so a message that was sent twice is shown twice.
    pub(crate) fn find(
        &self,
        message: &NetworkMessage<'_>,
    ) -> Result<Vec<&TokenKeys>, NoFittingKey> {
        let token_id = message.security().map_or(0, |security| security.token_id);
        let mut found = Vec::new();
        let mut why = None;
        for entry in self.entries.iter().filter(|entry| entry.fits(message)) {
            match open(&entry.keys, message, &mut Vec::new()) {
                Ok(_) => found.push(&entry.keys),
                Err(error) => why = Some(error),
            }
        }
        if !found.is_empty() {
            return Ok(found);
        }
        let file = self.name.clone();
        Err(match why {
            None => NoFittingKey::NoToken { token_id, file },
            Some(SecurityError::Signature) => NoFittingKey::Signature { token_id, file },
            Some(error) => NoFittingKey::Other(error),
        })
    }

    /// Returns the keys to secure a message with.
    pub(crate) fn of(
        &self,
        token_id: u32,
        publisher_id: Option<&PublisherIdJson>,
        writer_group_id: Option<u16>,
    ) -> Option<&TokenKeys> {
        let wanted = |entry: &&KeyFileEntry| entry.is_of(token_id, publisher_id, writer_group_id);
        self.entries.iter().find(wanted).map(|entry| &entry.keys)
    }

    /// Returns the first key, with its SecurityTokenId.
    pub(crate) fn first(&self) -> Option<(u32, &TokenKeys)> {
        let first = self.entries.first()?;
        Some((first.written.security_token_id, &first.keys))
    }

    pub(crate) fn name(&self) -> &str {
        &self.name
    }
}

/// Fills `bytes` with random bytes.
pub(crate) fn random(bytes: &mut [u8]) -> Result<(), CommandFailure> {
    std::fs::File::open(RANDOM)
        .and_then(|mut random| random.read_exact(bytes))
        .map_err(|error| CommandFailure::reading(RANDOM, &error))
}

const RANDOM: &str = "/dev/urandom";

/// Verifies a message and decrypts it into `scratch` if it is encrypted.
pub(crate) fn open<'a>(
    keys: &TokenKeys,
    message: &NetworkMessage<'a>,
    scratch: &'a mut Vec<u8>,
) -> Result<NetworkMessage<'a>, SecurityError> {
    let token_id = message.security().map_or(0, |security| security.token_id);
    let mut opener = Opener::new(SecurityMode::Sign);
    opener
        .update_keys(token_id, [keys.clone()])
        .map_err(|_| SecurityError::UnknownToken(token_id))?;
    Ok(opener.open(message, Duration::ZERO, scratch)?.message)
}

impl KeyFileEntry {
    fn fits(&self, message: &NetworkMessage<'_>) -> bool {
        let header = message.header();
        let publisher_id = header.publisher_id.map(PublisherIdJson::from);
        self.is_of(
            message.security().map_or(0, |security| security.token_id),
            publisher_id.as_ref(),
            header.group.and_then(|group| group.writer_group_id),
        )
    }

    fn is_of(
        &self,
        token_id: u32,
        publisher_id: Option<&PublisherIdJson>,
        writer_group_id: Option<u16>,
    ) -> bool {
        let written = &self.written;
        written.security_token_id == token_id
            && selector::publisher_fits(written.publisher_id.as_ref(), publisher_id)
            && selector::number_fits(written.writer_group_id, writer_group_id)
    }
}

impl WrittenKey {
    fn keys(&self) -> Result<TokenKeys, WrongKey> {
        let policy = SecurityPolicy::from_uri(&self.policy)
            .ok_or_else(|| WrongKey::Policy(self.policy.clone()))?;
        let mut key_data = Vec::new();
        let parts = [
            ("signingKey", &self.signing_key),
            ("encryptingKey", &self.encrypting_key),
            ("keyNonce", &self.key_nonce),
        ];
        for (part, text) in parts {
            let bytes = hex::parse(text).map_err(|error| WrongKey::Hex { part, error })?;
            key_data.extend(bytes);
        }
        Ok(TokenKeys::from_bytes(policy, &key_data)?)
    }
}

/// Returns the mode of the file if other users may access it.
#[cfg(unix)]
fn others_may_read(path: &Path) -> Option<u32> {
    use std::os::unix::fs::MetadataExt as _;

    let metadata = std::fs::metadata(path).ok()?;
    let mode = metadata.mode() & 0o7777;
    (metadata.is_file() && mode & 0o077 != 0).then_some(mode)
}

#[cfg(not(unix))]
const fn others_may_read(_path: &Path) -> Option<u32> {
    None
}
