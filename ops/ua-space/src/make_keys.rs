//! `ua-space keys`: creates key files, and changes them so that running programs can follow.

use std::fs::{File, OpenOptions};
use std::io::Write as _;
use std::os::unix::fs::OpenOptionsExt as _;
use std::path::{Path, PathBuf};

use serde_json::{Value, json};
use uadp::SecurityPolicy;

use crate::arguments::{KeyPolicy, MakeKeys};
use crate::exit::CommandFailure;
use crate::keys::{self, KeyFile};
use crate::report::warn;
use crate::{hex, json_file};

pub(crate) fn make_keys(arguments: &MakeKeys) -> Result<(), CommandFailure> {
    let file = &arguments.file;
    let name = file.display();
    let told = if arguments.next {
        let mut all = listed(file)?;
        let last = all
            .last()
            .and_then(|key| key.get("securityTokenId")?.as_u64());
        let last = last.and_then(|token| u32::try_from(token).ok());
        let policy = all.last().and_then(|key| key.get("policy")?.as_str());
        let policy = policy.and_then(SecurityPolicy::from_uri);
        let (Some(last), Some(policy)) = (last, policy) else {
            return Err(CommandFailure::Data(format!(
                "{name}: there is no key in it"
            )));
        };
        let token = last.checked_add(1).unwrap_or(1);
        all.push(made(token, policy)?);
        replace(file, &all)?;
        format!(
            "{name}: key {token} comes next; copy the file to all programs, then --drop the first"
        )
    } else if arguments.drop {
        let mut all = listed(file)?;
        if all.len() < 2 {
            let why = format!("{name}: there is no other key in it; --next makes one");
            return Err(CommandFailure::Data(why));
        }
        let gone = all.remove(0);
        replace(file, &all)?;
        let token = gone.get("securityTokenId").map(ToString::to_string);
        format!(
            "{name}: removed key {}; copy the file to all programs",
            token.unwrap_or_default()
        )
    } else {
        let policy = match arguments.policy {
            KeyPolicy::Aes128 => SecurityPolicy::PubSubAes128Ctr,
            KeyPolicy::Aes256 => SecurityPolicy::PubSubAes256Ctr,
        };
        write(file, &[made(1, policy)?])?;
        format!("{name}: key 1; copy the file to all programs of the group, and to no other place")
    };
    let mut out = std::io::stdout().lock();
    writeln!(out, "{told}")?;
    Ok(())
}

/// Returns the keys of a file as JSON.
fn listed(file: &Path) -> Result<Vec<Value>, CommandFailure> {
    // Invalid keys are reported as by the programs that read the file.
    KeyFile::read(file, warn)?;
    let name = file.display().to_string();
    let text = json_file::read(file)?;
    json_file::one_or_many(&text).map_err(|error| json_file::explain(&name, &error))
}

fn made(token: u32, policy: SecurityPolicy) -> Result<Value, CommandFailure> {
    let part = |len: usize| {
        let mut bytes = vec![0; len];
        keys::random(&mut bytes).map(|()| hex::text(&bytes))
    };
    // The bytes besides the encrypting key.
    let others = SIGNING + NONCE;
    Ok(json!({
        "policy": policy.uri(),
        "securityTokenId": token,
        "signingKey": part(SIGNING)?,
        "encryptingKey": part(policy.key_data_length() - others)?,
        "keyNonce": part(NONCE)?,
    }))
}

/// Writes a new file that only its owner can access.
fn write(file: &Path, keys: &[Value]) -> Result<(), CommandFailure> {
    let mut made = create(file)?;
    put(&mut made, keys).map_err(|error| writing(file, &error))
}

/// Replaces an existing file atomically.
fn replace(file: &Path, keys: &[Value]) -> Result<(), CommandFailure> {
    let mut beside = file.as_os_str().to_owned();
    beside.push(".new");
    let beside = PathBuf::from(beside);
    let mut made = create(&beside)?;
    let done = put(&mut made, keys).and_then(|()| std::fs::rename(&beside, file));
    done.map_err(|error| {
        drop(std::fs::remove_file(&beside));
        writing(file, &error)
    })
}

fn create(file: &Path) -> Result<File, CommandFailure> {
    let made = OpenOptions::new()
        .write(true)
        .create_new(true)
        .mode(0o600)
        .open(file);
    made.map_err(|error| writing(file, &error))
}

fn put(file: &mut File, keys: &[Value]) -> std::io::Result<()> {
    let text = serde_json::to_string_pretty(keys).map_err(std::io::Error::other)?;
    file.write_all(text.as_bytes())?;
    file.write_all(b"\n")?;
    file.sync_all()
}

fn writing(file: &Path, error: &std::io::Error) -> CommandFailure {
    CommandFailure::Io(format!("cannot write {}: {error}", file.display()))
}

/// Bytes of the SigningKey and of the KeyNonce (OPC 10000-14, 7.2.4.4.3.1).
const SIGNING: usize = 32;
const NONCE: usize = 4;
