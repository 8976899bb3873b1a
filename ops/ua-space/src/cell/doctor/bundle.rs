//! The file for a report: a gzip-compressed tar archive without secrets.

use std::fs;
use std::io::Write as _;
use std::path::Path;

use flate2::Compression;
use flate2::write::GzEncoder;

use super::facts::Facts;
use super::findings::Finding;
use super::host;

/// Packs findings, facts, configuration and logs. A part that cannot be read is left out.
pub(super) fn pack(facts: &Facts, findings: &[Finding]) -> Vec<u8> {
    let mut files: Vec<(String, String)> = Vec::new();
    let mut add = |name: &str, text: String| files.push((name.to_owned(), text));
    add("versions.txt", versions(facts));
    add("findings.json", pretty(findings));
    add("facts.json", pretty(facts));
    for (at, page) in facts.pages.iter().enumerate() {
        let name = format!("status/{at}-{}-{}.json", plain(&page.program), page.space);
        add(&name, pretty(page));
        if let Some(file) = &page.mapping.file
            && let Ok(text) = fs::read_to_string(file)
        {
            let short = Path::new(file).file_name().unwrap_or_default();
            let short = plain(&short.to_string_lossy());
            add(
                &format!("configuration/{at}-{short}"),
                without_secrets(&text),
            );
        }
    }
    let journal = [
        "--no-pager",
        "--lines=2000",
        "--unit=ua-*",
        "--unit=bridge-*",
    ];
    if let Some(log) = host::output("journalctl", &journal) {
        add("log.txt", without_secrets(&log));
    }
    let mut archive = Vec::new();
    for (name, text) in &files {
        append(&mut archive, name, text.as_bytes(), facts.now);
    }
    // Two empty blocks end an archive.
    archive.extend([0; 2 * BLOCK]);
    let mut packed = GzEncoder::new(Vec::new(), Compression::default());
    // Writing to memory does not fail.
    let _written = packed.write_all(&archive);
    packed.finish().unwrap_or_default()
}

fn versions(facts: &Facts) -> String {
    let system = fs::read_to_string("/proc/version").unwrap_or_default();
    let release = fs::read_to_string("/etc/os-release").unwrap_or_default();
    let mut text = format!("ua-space {}\n", facts.version);
    for page in &facts.pages {
        let version = page.version.as_deref().unwrap_or("unknown");
        text.push_str(&format!("{} {version}\n", page.label()));
    }
    text.push_str(&format!("{system}{release}"));
    text
}

fn pretty(value: &(impl serde::Serialize + ?Sized)) -> String {
    serde_json::to_string_pretty(value).unwrap_or_default()
}

/// Returns a text without characters that a path may not have.
fn plain(name: &str) -> String {
    let allowed = |c: char| c.is_ascii_alphanumeric() || matches!(c, '.' | '-' | '_');
    let name = name.chars().take(60);
    name.map(|c| if allowed(c) { c } else { '_' }).collect()
}

/// Replaces the values of keys that name a secret, and passwords in URLs.
fn without_secrets(text: &str) -> String {
    let lines = text.lines().map(|line| {
        let lower = line.to_lowercase();
        let secret = SECRETS.iter().filter_map(|word| lower.find(word)).min();
        // Lower case may have another length, so the key is taken from the lower-case line.
        let value = secret.and_then(|at| {
            let behind = lower.get(at..)?;
            let colon = behind.find([':', '='])?;
            lower.get(..at + colon + 1)
        });
        match value {
            Some(kept) => format!("{kept} (removed)"),
            None => without_password(line),
        }
    });
    let mut text: String = lines.flat_map(|line| [line, "\n".to_owned()]).collect();
    if text.trim().is_empty() {
        text.clear();
    }
    text
}

/// Removes the user and the password of a URL.
fn without_password(line: &str) -> String {
    let Some((scheme, rest)) = line.split_once("://") else {
        return line.to_owned();
    };
    let end = rest.find(['/', ' ', '"', '\'']).unwrap_or(rest.len());
    let (authority, behind) = rest.split_at(end);
    match authority.rsplit_once('@') {
        Some((_, host)) => format!("{scheme}://(removed)@{host}{behind}"),
        None => line.to_owned(),
    }
}

const SECRETS: [&str; 6] = [
    "password",
    "secret",
    "token",
    "signingkey",
    "encryptingkey",
    "private",
];

/// Appends a file to an archive in the format of POSIX (ustar).
fn append(archive: &mut Vec<u8>, name: &str, content: &[u8], seconds: u64) {
    let mut header = [0_u8; BLOCK];
    let mut put = |at: usize, text: &[u8]| {
        if let Some(place) = header.get_mut(at..at + text.len()) {
            place.copy_from_slice(text);
        }
    };
    let path = format!("ua-bridge-report/{name}");
    put(0, path.as_bytes().get(..100).unwrap_or(path.as_bytes()));
    put(100, b"0000644\0");
    put(108, b"0000000\0");
    put(116, b"0000000\0");
    put(124, format!("{:011o}\0", content.len()).as_bytes());
    put(136, format!("{seconds:011o}\0").as_bytes());
    put(148, b"        ");
    put(156, b"0");
    put(257, b"ustar\x0000");
    let sum: u32 = header.iter().map(|byte| u32::from(*byte)).sum();
    let sum = format!("{sum:06o}\0 ");
    if let Some(place) = header.get_mut(148..156) {
        place.copy_from_slice(sum.as_bytes());
    }
    archive.extend(header);
    archive.extend(content);
    archive.resize(archive.len().next_multiple_of(BLOCK), 0);
}

const BLOCK: usize = 512;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn secrets_of_a_configuration_are_removed() {
        let text = "users:\n  - {name: a, password: hunter2}\nurl: mqtt://me:pw@host:1883/x\nsigningKey: 0102\naddress: 239.0.0.1\n";
        let kept = without_secrets(text);
        for secret in ["hunter2", "me:pw", "0102"] {
            assert!(!kept.contains(secret), "{kept}");
        }
        assert!(kept.contains("mqtt://(removed)@host:1883/x"), "{kept}");
        assert!(kept.contains("address: 239.0.0.1"), "{kept}");
    }

    #[test]
    fn a_file_is_a_header_and_whole_blocks() {
        let mut archive = Vec::new();
        append(&mut archive, "a.txt", b"content", 1);
        assert_eq!(archive.len(), 2 * BLOCK);
        assert!(archive.starts_with(b"ua-bridge-report/a.txt\0"));
        assert_eq!(&archive[124..135], b"00000000007");
        assert_eq!(&archive[BLOCK..BLOCK + 7], b"content");
    }
}
