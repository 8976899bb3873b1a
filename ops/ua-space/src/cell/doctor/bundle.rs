//! The file for a report: a gzip-compressed tar archive without secrets.

use std::fs;
use std::io::Write as _;
use std::path::Path;

use flate2::Compression;
use flate2::write::GzEncoder;

use super::facts::CellFacts;
use super::findings::DoctorFinding;
use super::host;

/// Packs findings, facts, configuration and logs. A part that cannot be read is left out.
pub(super) fn pack(facts: &CellFacts, findings: &[DoctorFinding]) -> Vec<u8> {
    let mut files: Vec<(String, String)> = Vec::new();
    let mut add = |name: &str, text: String| files.push((name.to_owned(), text));
    add("versions.txt", versions(facts));
    add("findings.json", pretty(findings));
    add("facts.json", pretty(facts));
    for (at, page) in facts.pages.iter().enumerate() {
        let name = format!("status/{at}-{}-{}.json", plain(&page.program), page.space);
        add(&name, pretty(page));
        // A program of another host would name a file of this host.
        if let (Some(file), Some(_)) = (&page.mapping.file, page.pid)
            && let Some(text) = configuration(Path::new(file))
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

/// Reads a configuration. Any user may serve a status, so only regular files of YAML are read.
fn configuration(file: &Path) -> Option<String> {
    let file = fs::canonicalize(file).ok()?;
    let is_yaml = file
        .extension()
        .is_some_and(|end| end == "yaml" || end == "yml");
    let found = fs::metadata(&file).ok()?;
    let is_small = found.is_file() && found.len() <= MOST_CONFIGURATION;
    (is_yaml && is_small).then(|| fs::read_to_string(&file).ok())?
}

const MOST_CONFIGURATION: u64 = 32 << 20;

fn versions(facts: &CellFacts) -> String {
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

/// Removes the rest of each line that names a secret, the deeper lines below it, and passwords in
/// URLs.
fn without_secrets(text: &str) -> String {
    let mut kept = String::new();
    // The indentation of a key whose value may continue in deeper lines.
    let mut inside: Option<usize> = None;
    for line in text.lines() {
        let indent = line.len() - line.trim_start().len();
        if inside.is_some_and(|key| line.trim().is_empty() || indent > key) {
            continue;
        }
        let lower = line.to_lowercase();
        let secret = SECRETS.iter().filter_map(|word| lower.find(word)).min();
        // Lower case may have another length, so the start is taken from the lower-case line.
        let start = secret.and_then(|at| {
            let is_name = |c: char| c.is_alphanumeric() || matches!(c, '_' | '-');
            let end = lower.get(at..)?.find(|c| !is_name(c))?;
            lower.get(..at + end)
        });
        inside = start.is_some().then_some(indent);
        match start {
            Some(start) => kept.push_str(&format!("{start} (removed)")),
            None => kept.push_str(&mappings::masked(line)),
        }
        kept.push('\n');
    }
    if kept.trim().is_empty() {
        kept.clear();
    }
    kept
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
        let text = "users:\n  - {name: a, password: hunter2}\nurl: [http://h, mqtt://me:pw@host:1883/x]\nsigningKey: 0102\n\
                    exec: [run, --password, swordfish]\npassword: |\n  open\n  sesame\naddress: 239.0.0.1\n";
        let kept = without_secrets(text);
        for secret in ["hunter2", "me:pw", "0102", "swordfish", "open", "sesame"] {
            assert!(!kept.contains(secret), "{kept}");
        }
        assert!(kept.contains("mqtt://me:**@host:1883/x"), "{kept}");
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
