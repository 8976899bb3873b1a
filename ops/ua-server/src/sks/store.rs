//! The file with the keys of the groups for which this server creates keys.

use std::collections::{BTreeMap, VecDeque};
use std::fs::File;
use std::io::{self, Read as _};
use std::os::unix::fs::PermissionsExt as _;
use std::path::PathBuf;
use std::time::Duration;

use bridge_core::Now;
use bridge_node::{Failure, FailureKind};
use plant_opcua::synced::replace;
use serde::{Deserialize, Serialize};
use uadp::SecurityPolicy;

use super::ring::Ring;

/// The key file, which only its owner can read.
#[derive(Debug)]
pub(super) struct Store {
    file: PathBuf,
}

/// The stored keys of a group.
#[derive(Serialize, Deserialize)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
struct Kept {
    /// SecurityPolicyUri.
    policy: String,
    lifetime_ms: u64,
    /// The SecurityTokenId of the first key.
    first_token_id: u32,
    /// Number of keys before the current key.
    past: usize,
    /// Start of use of the current key, in milliseconds since 1970.
    since: i64,
    /// The key data, hexadecimal.
    keys: Vec<String>,
}

impl Store {
    pub(super) const fn new(file: PathBuf) -> Self {
        Self { file }
    }

    /// Loads the keys. Returns no keys if the file does not exist.
    ///
    /// # Errors
    /// Returns the fault of the file, without key data.
    pub(super) fn load(&self, now: Now) -> Result<Vec<(String, SecurityPolicy, Ring)>, Failure> {
        let name = self.file.display();
        let unusable =
            |error: io::Error| failed(format!("the keys in {name} cannot be read: {error}"));
        let file = match File::open(&self.file) {
            Ok(file) => file,
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(Vec::new()),
            Err(error) => return Err(unusable(error)),
        };
        let mode = file.metadata().map_err(unusable)?.permissions().mode() & 0o777;
        if mode & 0o077 != 0 {
            return Err(failed(format!(
                "mode {mode:04o} lets others read or change the keys in {name}; chmod 600 {name}, and remove it for new \
                 keys if somebody may have"
            )));
        }
        let mut text = String::new();
        file.take(MOST_BYTES)
            .read_to_string(&mut text)
            .map_err(unusable)?;
        let kept: BTreeMap<String, Kept> = serde_json::from_str(&text).map_err(|error| {
            // The content of the file is not logged.
            failed(format!(
                "{name}, line {}: no keys as this program keeps them; remove it for new ones",
                error.line()
            ))
        })?;
        let rings = kept.into_iter().map(|(id, kept)| {
            let (policy, ring) = kept.ring(now).ok_or_else(|| {
                failed(format!("{name}: no keys of `{id}`; remove it for new ones"))
            })?;
            Ok((id, policy, ring))
        });
        rings.collect()
    }

    /// Replaces the content of the file.
    ///
    /// # Errors
    /// Returns the reason why the file cannot be written.
    pub(super) fn save<'a>(
        &self,
        rings: impl Iterator<Item = (&'a str, SecurityPolicy, &'a Ring)>,
        now: Now,
    ) -> Result<(), Failure> {
        let kept: BTreeMap<&str, Kept> = rings
            .map(|(id, policy, ring)| (id, Kept::of(policy, ring, now)))
            .collect();
        self.write(&kept).map_err(|error| {
            failed(format!(
                "the keys cannot be kept in {}: {error}",
                self.file.display()
            ))
        })
    }

    fn write(&self, kept: &BTreeMap<&str, Kept>) -> io::Result<()> {
        let mut text = serde_json::to_string_pretty(kept).map_err(io::Error::other)?;
        text.push('\n');
        replace(&self.file, text.as_bytes())
    }
}

fn failed(message: String) -> Failure {
    Failure::new(FailureKind::Io, message)
}

impl Kept {
    fn of(policy: SecurityPolicy, ring: &Ring, now: Now) -> Self {
        let (first_token_id, keys) = ring.keys();
        let used = i64::try_from(ring.used(now.monotonic).as_millis()).unwrap_or(i64::MAX);
        Self {
            policy: policy.uri().to_owned(),
            lifetime_ms: u64::try_from(ring.lifetime().as_millis()).unwrap_or(u64::MAX),
            first_token_id,
            past: ring.past(),
            since: unix(now).saturating_sub(used),
            keys: keys.iter().map(|key| hex(key)).collect(),
        }
    }

    fn ring(&self, now: Now) -> Option<(SecurityPolicy, Ring)> {
        let policy = SecurityPolicy::from_uri(&self.policy)?;
        let keys: VecDeque<Vec<u8>> = self
            .keys
            .iter()
            .map(|key| bytes(key).filter(|key| key.len() == policy.key_data_length()))
            .collect::<Option<_>>()?;
        let whole = !keys.is_empty() && self.first_token_id > 0 && self.lifetime_ms > 0;
        // If the clock was set back, the use of the key starts at the current time.
        let used = unix(now).saturating_sub(self.since);
        let used = Duration::from_millis(u64::try_from(used).unwrap_or_default());
        let lifetime = Duration::from_millis(self.lifetime_ms);
        whole.then(|| {
            let keys = (self.first_token_id, keys);
            (policy, Ring::kept(lifetime, keys, self.past, used, now))
        })
    }
}

/// Returns the milliseconds since 1970.
fn unix(now: Now) -> i64 {
    i64::try_from(now.utc.unix_nanos() / 1_000_000).unwrap_or(i64::MAX)
}

fn hex(bytes: &[u8]) -> String {
    use std::fmt::Write as _;
    let mut text = String::with_capacity(bytes.len() * 2);
    for byte in bytes {
        // Writing to a String cannot fail.
        let _written = write!(text, "{byte:02x}");
    }
    text
}

fn bytes(hex: &str) -> Option<Vec<u8>> {
    let digits: Vec<u8> = hex
        .chars()
        .map(|digit| u8::try_from(digit.to_digit(16)?).ok())
        .collect::<Option<_>>()?;
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

/// Size limit of the file, far above the size of the keys of all groups.
const MOST_BYTES: u64 = 1 << 20;

#[cfg(test)]
mod tests {
    use std::fs;

    use bridge_node::now;

    use super::*;

    fn store(name: &str) -> Store {
        let file = std::env::temp_dir().join(format!("ua-sks-{}-{name}", std::process::id()));
        drop(fs::remove_file(&file));
        Store::new(file)
    }

    fn later(now: Now, by: Duration) -> Now {
        let nanos = now.utc.unix_nanos() + i128::try_from(by.as_nanos()).unwrap();
        Now {
            // Simulates another run of the program with a restarted monotonic clock.
            monotonic: now.monotonic,
            utc: uadp::Timestamp::from_unix_nanos(nanos),
        }
    }

    #[test]
    fn after_a_restart_the_keys_are_the_same_and_their_time_has_gone_on() {
        let store = store("same");
        let (start, hour) = (now(), Duration::from_secs(3600));
        assert_eq!(store.load(start), Ok(Vec::new()));
        let policy = SecurityPolicy::PubSubAes256Ctr;
        let mut ring = Ring::new(hour, start);
        let mut count = 0;
        ring.advance(start.monotonic, || {
            count += 1;
            vec![count; policy.key_data_length()]
        });
        store
            .save([("cell", policy, &ring)].into_iter(), start)
            .unwrap();
        let mode = fs::metadata(&store.file).unwrap().permissions().mode();
        assert_eq!(mode & 0o777, 0o600);

        let again = later(start, hour + hour / 4);
        let mut loaded = store.load(again).unwrap();
        let (id, _, mut ring) = loaded.remove(0);
        ring.advance(again.monotonic, || vec![99; policy.key_data_length()]);
        let handed = ring.hand_out(0, 0, again.monotonic).unwrap();
        assert_eq!(
            (id.as_str(), handed.first_token_id, handed.keys[0][0]),
            ("cell", 2, 2)
        );
        let quarter = handed.time_to_next.as_secs_f64() / hour.as_secs_f64();
        assert!((quarter - 0.75).abs() < 0.01, "{quarter}");
        fs::remove_file(&store.file).unwrap();
    }

    #[test]
    fn a_file_that_others_can_read_or_that_is_none_is_told_without_its_keys() {
        let store = store("wrong");
        let secret = "5e".repeat(40);
        for (text, mode, told) in [
            ("{}", 0o644, "chmod 600"),
            (&*format!("{{\"cell\": \"{secret}\"}}"), 0o600, "line 1"),
            (
                &*format!(
                    "{{\"cell\": {{\"policy\": \"x\", \"lifetimeMs\": 1, \"firstTokenId\": 1, \"past\": 0, \"since\": 0, \
                     \"keys\": [\"{secret}\"]}}}}"
                ),
                0o600,
                "no keys of `cell`",
            ),
        ] {
            fs::write(&store.file, text).unwrap();
            fs::set_permissions(&store.file, fs::Permissions::from_mode(mode)).unwrap();
            let why = store.load(now()).unwrap_err().to_string();
            assert!(why.contains(told) && !why.contains("5e5e"), "{why}");
        }
        fs::remove_file(&store.file).unwrap();
    }
}
