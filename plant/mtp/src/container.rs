//! The ZIP containers of manifests: `.mtp` (VDI/VDE/NAMUR 2658) and `.amlx` (AutomationML
//! container, IEC 62714-1).

use miniz_oxide::inflate::TINFLStatus;
use quick_xml::XmlVersion;
use quick_xml::events::Event;
use quick_xml::reader::Reader;
use rawzip::{CompressionMethod, ZipArchive, ZipArchiveEntryWayfinder, ZipVerification};

use crate::caex::{MAX_FILE, ManifestError};

/// Returns whether a file is a ZIP archive.
pub(crate) fn is_container(file: &[u8]) -> bool {
    file.starts_with(b"PK\x03\x04")
}

/// Returns the AutomationML document of a container: `manifest.aml`, else the root document that
/// the container names, else its only document.
///
/// # Errors
/// [`ManifestError::Container`] without such a document, and if the archive is damaged.
pub(crate) fn document(file: &[u8]) -> Result<Vec<u8>, ManifestError> {
    let members = members(file)?;
    let documents: Vec<&Member> = members.iter().filter(|one| one.has_end(".aml")).collect();
    let manifest = documents.iter().find(|one| {
        let name = one.path.rsplit('/').next().unwrap_or_default();
        name.eq_ignore_ascii_case("manifest.aml")
    });
    let chosen = match (manifest, documents.as_slice()) {
        (Some(manifest), _) => manifest,
        (None, [only]) => only,
        (None, []) => return Err(fault("it holds no .aml file")),
        (None, several) => {
            let root = root_document(file, &members)?;
            let named = |one: &&&Member| root.as_deref() == Some(one.path.as_str());
            several.iter().find(named).ok_or_else(|| {
                let names: Vec<&str> = several.iter().map(|one| one.path.as_str()).collect();
                fault(format!(
                    "it does not say which of these is the manifest: {}",
                    names.join(", ")
                ))
            })?
        }
    };
    unpack(file, chosen)
}

/// Returns the document with a path, or with the name at the end of the path.
///
/// # Errors
/// [`ManifestError::Container`] if the archive is damaged.
pub(crate) fn named(file: &[u8], path: &str) -> Result<Option<Vec<u8>>, ManifestError> {
    let members = members(file)?;
    let name = format!("/{}", path.rsplit('/').next().unwrap_or_default());
    let exact = members.iter().find(|one| one.path == path);
    let found = exact.or_else(|| {
        let mut members = members.iter();
        members.find(|one| format!("/{}", one.path).ends_with(&name))
    });
    found.map(|one| unpack(file, one)).transpose()
}

/// A file in an archive.
struct Member {
    path: String,
    method: CompressionMethod,
    place: ZipArchiveEntryWayfinder,
}

impl Member {
    fn has_end(&self, end: &str) -> bool {
        let start = self.path.len().checked_sub(end.len());
        let tail = start.and_then(|start| self.path.get(start..));
        tail.is_some_and(|tail| tail.eq_ignore_ascii_case(end))
    }
}

fn members(file: &[u8]) -> Result<Vec<Member>, ManifestError> {
    let archive = ZipArchive::from_slice(file).map_err(|error| fault(error.to_string()))?;
    let mut entries = archive.entries();
    let mut members = Vec::new();
    while let Some(entry) = entries
        .next_entry()
        .map_err(|error| fault(error.to_string()))?
    {
        if members.len() >= MAX_MEMBERS {
            return Err(fault(format!("it holds more than {MAX_MEMBERS} files")));
        }
        let path = String::from_utf8_lossy(entry.file_path().as_bytes()).replace('\\', "/");
        members.push(Member {
            path: path.trim_start_matches('/').to_owned(),
            method: entry.compression_method(),
            place: entry.wayfinder(),
        });
    }
    Ok(members)
}

/// Unpacks a file up to a limit of [`MAX_FILE`] bytes, and verifies its checksum.
fn unpack(file: &[u8], member: &Member) -> Result<Vec<u8>, ManifestError> {
    let path = &member.path;
    let damaged = |error: &dyn std::fmt::Display| fault(format!("{path} is damaged: {error}"));
    let archive = ZipArchive::from_slice(file).map_err(|error| damaged(&error))?;
    let entry = archive
        .get_entry(member.place)
        .map_err(|error| damaged(&error))?;
    let packed = entry.data();
    let too_large = || fault(format!("{path} has more than {} MiB", MAX_FILE >> 20));
    let unpacked = match member.method {
        CompressionMethod::STORE if packed.len() > MAX_FILE => return Err(too_large()),
        CompressionMethod::STORE => packed.to_vec(),
        CompressionMethod::DEFLATE => {
            let inflated = miniz_oxide::inflate::decompress_to_vec_with_limit(packed, MAX_FILE);
            inflated.map_err(|error| {
                let is_too_large = error.status == TINFLStatus::HasMoreOutput;
                if is_too_large {
                    too_large()
                } else {
                    damaged(&error)
                }
            })?
        }
        other => {
            return Err(fault(format!(
                "{path} is packed by {other:?}; pack it by Deflate"
            )));
        }
    };
    let found = ZipVerification {
        crc: rawzip::crc32(&unpacked),
        uncompressed_size: u64::try_from(unpacked.len()).unwrap_or(u64::MAX),
    };
    entry
        .claim_verifier()
        .valid(found)
        .map_err(|error| damaged(&error))?;
    Ok(unpacked)
}

/// Returns the path of the root document in the relationships of an AutomationML container.
fn root_document(file: &[u8], members: &[Member]) -> Result<Option<String>, ManifestError> {
    let Some(relations) = members.iter().find(|one| one.path == "_rels/.rels") else {
        return Ok(None);
    };
    let relations = unpack(file, relations)?;
    let wrong = |error: &dyn std::fmt::Display| fault(format!("_rels/.rels: {error}"));
    let text = xml_text::decode(&relations).map_err(|error| wrong(&error))?;
    let mut reader = Reader::from_str(&text);
    loop {
        let event = reader.read_event().map_err(|error| wrong(&error))?;
        if matches!(event, Event::Eof) {
            return Ok(None);
        }
        let (Event::Start(element) | Event::Empty(element)) = event else {
            continue;
        };
        let value = |name: &str| {
            let attribute = element.try_get_attribute(name).ok().flatten()?;
            let value = attribute.normalized_value(XmlVersion::Implicit1_0).ok()?;
            Some(value.into_owned())
        };
        if value("Type").is_some_and(|kind| kind.ends_with("/RootDocument")) {
            let target = value("Target").unwrap_or_default();
            return Ok(Some(target.trim_start_matches('/').to_owned()));
        }
    }
}

fn fault(what: impl Into<String>) -> ManifestError {
    ManifestError::Container(what.into())
}

/// Limit of files in an archive.
const MAX_MEMBERS: usize = 10_000;

#[cfg(test)]
mod tests {
    use std::io::Write as _;

    use rawzip::ZipArchiveWriter;

    use super::*;

    /// Returns an archive of files, deflated unless the path begins with `stored`.
    fn archive(files: &[(&str, &[u8])]) -> Vec<u8> {
        let mut out = Vec::new();
        let mut archive = ZipArchiveWriter::new(&mut out);
        for (path, content) in files {
            let stored = path.starts_with("stored");
            let method = if stored {
                CompressionMethod::STORE
            } else {
                CompressionMethod::DEFLATE
            };
            let (mut entry, config) = archive
                .new_file(path)
                .compression_method(method)
                .start()
                .unwrap();
            // The writer counts the bytes before compression.
            let mut writer = config.wrap(Vec::new());
            writer.write_all(content).unwrap();
            let (plain, descriptor) = writer.finish().unwrap();
            let packed = if stored {
                plain
            } else {
                miniz_oxide::deflate::compress_to_vec(&plain, 6)
            };
            entry.write_all(&packed).unwrap();
            entry.finish(descriptor).unwrap();
        }
        archive.finish().unwrap();
        out
    }

    #[test]
    fn the_document_of_a_container_is_found() {
        let types: (&str, &[u8]) = ("[Content_Types].xml", b"<Types/>");
        let only = |path| archive(&[types, (path, b"<a/>")]);
        for path in [
            "manifest.aml",
            "Manifest/Manifest.AML",
            "lib/dosing.aml",
            "stored.aml",
        ] {
            assert_eq!(document(&only(path)).unwrap(), b"<a/>", "{path}");
        }
        let manifest = archive(&[("library.aml", b"<l/>"), ("x/manifest.aml", b"<m/>")]);
        assert_eq!(document(&manifest).unwrap(), b"<m/>");
        let relations = br#"<Relationships><Relationship Id="1" Target="/lib/b.aml"
            Type="http://schemas.automationml.org/container/relationship/RootDocument"/></Relationships>"#;
        let named = archive(&[
            ("lib/a.aml", b"<a/>"),
            ("lib/b.aml", b"<b/>"),
            ("_rels/.rels", relations),
        ]);
        assert_eq!(document(&named).unwrap(), b"<b/>");
    }

    #[test]
    fn containers_without_one_document_are_refused() {
        let said = |file: &[u8]| document(file).unwrap_err().to_string();
        assert!(said(&archive(&[("a.txt", b"")])).ends_with("it holds no .aml file"));
        let several = archive(&[("a.aml", b"<a/>"), ("b.aml", b"<b/>")]);
        assert!(said(&several).ends_with("which of these is the manifest: a.aml, b.aml"));
        assert!(is_container(&several) && !is_container(b"<CAEXFile/>"));
    }

    #[test]
    fn damaged_archives_are_refused_and_bombs_are_bounded() {
        let whole = archive(&[("manifest.aml", &[b'x'; 1000])]);
        for end in 0..whole.len() {
            assert!(document(&whole[..end]).is_err(), "{end}");
        }
        for at in 0..whole.len() {
            let mut other = whole.clone();
            other[at] ^= 0xFF;
            // A changed byte is detected, or has no effect.
            if let Ok(text) = document(&other) {
                assert_eq!(text, [b'x'; 1000], "{at}");
            }
        }
        let bomb = archive(&[("manifest.aml", &vec![0; MAX_FILE + 1])]);
        assert!(bomb.len() < 100_000);
        assert!(
            document(&bomb)
                .unwrap_err()
                .to_string()
                .ends_with("has more than 64 MiB")
        );
    }
}
