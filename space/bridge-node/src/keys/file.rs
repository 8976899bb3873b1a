//! A file with keys: a JSON list in the order of use.

use std::fs::File;
use std::io::Read as _;
use std::os::unix::fs::PermissionsExt as _;
use std::path::{Path, PathBuf};
use std::time::Duration;

use bridge_core::{KeyDelivery, policy_of};
use mappings::{KeySource, SecurityGroup};
use serde::Deserialize;
use service::{Failure, FailureKind};
use uadp::{KeyError, SecurityPolicy, TokenKeys};

/// One key of a SecurityGroup, in its parts; keys and nonce are hexadecimal text.
#[derive(Deserialize)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
struct Written {
    /// SecurityPolicyUri.
    policy: String,
    security_token_id: u32,
    signing_key: String,
    encrypting_key: String,
    key_nonce: String,
}

/// The reason why a text is no list of keys. It contains no key.
#[derive(Debug, thiserror::Error)]
enum KeyFileFault {
    /// Other users can access the file.
    #[error("mode {mode:04o} lets others read or change the keys; chmod 600 {}", path.display())]
    Open {
        /// The file.
        path: PathBuf,
        /// Its mode.
        mode: u32,
    },
    /// The text has another form.
    #[error("line {0}: not a list of keys as `ua-space keys` writes it")]
    Form(usize),
    /// The list is empty.
    #[error("it contains no key")]
    Empty,
    /// The list is too long.
    #[error("{0} keys; at most {MOST_KEYS} are allowed")]
    TooMany(usize),
    /// A key is not the successor of the key before.
    #[error("key {at}: its securityTokenId is {id}, but the ids must ascend by 1")]
    Order {
        /// The index of the key.
        at: u32,
        /// Its SecurityTokenId.
        id: u32,
    },
    /// A key is invalid.
    #[error("key {at}: {fault}")]
    Key {
        /// The index of the key.
        at: u32,
        /// The reason.
        fault: WrittenKeyFault,
    },
}

/// The reason why a key is invalid.
#[derive(Debug, thiserror::Error)]
enum WrittenKeyFault {
    /// The SecurityTokenId is 0.
    #[error("0 is not a valid securityTokenId")]
    Zero,
    /// The group has this policy, and the key another.
    #[error("its policy differs from {}, the policy of the group in the mapping", .0.uri())]
    Policy(SecurityPolicy),
    /// The text of this member is invalid.
    #[error("{0} is not hexadecimal")]
    NotHexadecimal(&'static str),
    /// The key has a wrong length.
    #[error(transparent)]
    Data(#[from] KeyError),
}

/// Reads the keys of a group, in the order of the file.
///
/// # Errors
/// The file cannot be read, other users can access it, or its content is not a list of keys of the
/// group. The message contains no key.
pub(super) fn read(path: &Path, group: &SecurityGroup) -> Result<KeyDelivery, Failure> {
    let name = path.display();
    let unreadable = |error: std::io::Error| {
        Failure::new(
            FailureKind::Configuration,
            format!(
                "the keys of the group `{}`: cannot read {name}: {error}",
                group.id
            ),
        )
    };
    let wrong = |why: KeyFileFault| {
        Failure::new(
            FailureKind::Configuration,
            format!("the keys of the group `{}`: {name}: {why}", group.id),
        )
    };
    let mut file = File::open(path).map_err(unreadable)?;
    let about = file.metadata().map_err(unreadable)?;
    // systemd controls the access to credentials.
    let handed = matches!(group.keys, Some(KeySource::Credential(_)));
    let mode = about.permissions().mode() & 0o777;
    if !handed && mode & 0o077 != 0 {
        let path = path.to_owned();
        return Err(wrong(KeyFileFault::Open { path, mode }));
    }
    let mut text = String::new();
    let mut bounded = (&mut file).take(MOST_BYTES);
    bounded.read_to_string(&mut text).map_err(unreadable)?;
    parse(&text, policy_of(group.policy)).map_err(wrong)
}

fn parse(text: &str, policy: SecurityPolicy) -> Result<KeyDelivery, KeyFileFault> {
    let written = if text.trim_start().starts_with('[') {
        serde_json::from_str(text)
    } else {
        serde_json::from_str(text).map(|one| vec![one])
    };
    // The content of the file is not shown.
    let written: Vec<Written> = written.map_err(|error| KeyFileFault::Form(error.line()))?;
    let first = written.first().map(|key| key.security_token_id);
    let first = first.ok_or(KeyFileFault::Empty)?;
    let mut keys = Vec::new();
    for (at, key) in (0_u32..).zip(&written) {
        let expected = first.checked_add(at);
        if expected != Some(key.security_token_id) {
            let id = key.security_token_id;
            return Err(KeyFileFault::Order { at, id });
        }
        let read = key.keys(policy);
        keys.push(read.map_err(|fault| KeyFileFault::Key { at, fault })?);
    }
    if keys.len() > MOST_KEYS {
        return Err(KeyFileFault::TooMany(keys.len()));
    }
    Ok(KeyDelivery {
        first_token_id: first,
        keys,
        time_to_next: None,
        lifetime: Duration::ZERO,
    })
}

impl Written {
    fn keys(&self, policy: SecurityPolicy) -> Result<TokenKeys, WrittenKeyFault> {
        if self.security_token_id == 0 {
            return Err(WrittenKeyFault::Zero);
        }
        if SecurityPolicy::from_uri(&self.policy) != Some(policy) {
            return Err(WrittenKeyFault::Policy(policy));
        }
        let parts = [
            ("signingKey", &self.signing_key),
            ("encryptingKey", &self.encrypting_key),
            ("keyNonce", &self.key_nonce),
        ];
        let mut data = Vec::new();
        for (name, text) in parts {
            let bytes = bytes(text).ok_or(WrittenKeyFault::NotHexadecimal(name))?;
            data.extend(bytes);
        }
        Ok(TokenKeys::from_bytes(policy, &data)?)
    }
}

fn bytes(hex: &str) -> Option<Vec<u8>> {
    let digits: Option<Vec<u8>> = hex
        .chars()
        .map(|digit| u8::try_from(digit.to_digit(16)?).ok())
        .collect();
    let digits = digits?;
    let pairs = digits.chunks_exact(2);
    if !pairs.remainder().is_empty() {
        return None;
    }
    let pairs = pairs.map(|pair| match pair {
        [high, low] => Some(high << 4 | low),
        _ => None,
    });
    pairs.collect()
}

/// Far above the size of any valid file.
const MOST_BYTES: u64 = 64 * 1024;
const MOST_KEYS: usize = 64;

#[cfg(test)]
mod tests {
    use mappings::{GroupMode, GroupPolicy, Replay};

    use super::*;

    fn key(token: u32, policy: &str, signing: &str) -> String {
        format!(
            r#"{{"policy": "http://opcfoundation.org/UA/SecurityPolicy#PubSub-{policy}-CTR", "securityTokenId": {token},
            "signingKey": "{signing}", "encryptingKey": "{}", "keyNonce": "00112233"}}"#,
            "0b".repeat(16)
        )
    }

    fn signing() -> String {
        "0A".repeat(32)
    }

    fn group(file: &Path) -> SecurityGroup {
        SecurityGroup {
            id: "cell".to_owned(),
            mode: GroupMode::Sign,
            policy: GroupPolicy::Aes128,
            keys: Some(KeySource::File(file.to_owned())),
            namespaces: Vec::new(),
            replay: Replay::Sender,
        }
    }

    #[test]
    fn the_first_key_of_a_file_is_the_one_that_is_used() {
        let text = format!(
            "[{}, {}]",
            key(7, "Aes128", &signing()),
            key(8, "Aes128", &signing())
        );
        let delivery = parse(&text, SecurityPolicy::PubSubAes128Ctr).unwrap();
        assert_eq!((delivery.first_token_id, delivery.keys.len()), (7, 2));
        assert_eq!(delivery.time_to_next, None);
        let one = parse(
            &key(3, "Aes128", &signing()),
            SecurityPolicy::PubSubAes128Ctr,
        );
        assert_eq!(one.unwrap().first_token_id, 3);
    }

    #[test]
    fn what_is_no_key_is_told_without_telling_what_stands_there() {
        let (good, policy) = (signing(), SecurityPolicy::PubSubAes128Ctr);
        for (text, told) in [
            ("[]".to_owned(), "no key"),
            ("{\"policy\": 1}".to_owned(), "line 1"),
            (key(1, "Aes256", &good), "its policy differs from"),
            (key(0, "Aes128", &good), "0 is not a valid securityTokenId"),
            (key(1, "Aes128", "0a0a"), "22 bytes of key data"),
            (
                key(1, "Aes128", &"xy".repeat(32)),
                "signingKey is not hexadecimal",
            ),
            (
                format!("[{}, {}]", key(1, "Aes128", &good), key(3, "Aes128", &good)),
                "the ids must ascend by 1",
            ),
        ] {
            let why = parse(&text, policy).unwrap_err().to_string();
            assert!(why.contains(told), "{why}");
            assert!(!why.contains("0a0a") && !why.contains("xyxy"), "{why}");
        }
    }

    #[test]
    fn a_file_that_others_can_read_is_not_used() {
        let path = std::env::temp_dir().join(format!("ua-keys-{}.json", std::process::id()));
        std::fs::write(&path, key(1, "Aes128", &signing())).unwrap();
        let set = |mode| {
            let mode = std::fs::Permissions::from_mode(mode);
            std::fs::set_permissions(&path, mode).unwrap();
        };
        set(0o640);
        let refused = read(&path, &group(&path)).unwrap_err();
        assert!(refused.to_string().contains("chmod 600"), "{refused}");
        set(0o600);
        assert_eq!(read(&path, &group(&path)).unwrap().first_token_id, 1);
        std::fs::remove_file(&path).unwrap();
        let gone = read(&path, &group(&path)).unwrap_err();
        assert!(gone.to_string().contains("cannot read"), "{gone}");
    }
}
