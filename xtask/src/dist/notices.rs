//! The crates in the programs: their licences as a text, and the bill of materials (SBOM).

use std::{
    collections::{BTreeMap, BTreeSet},
    fmt::Write as _,
    fs,
    path::{Path, PathBuf},
};

use anyhow::{Context as _, ensure};
use miniz_oxide::deflate::compress_to_vec_zlib;
use serde_json::{Value, json};

use super::sysroot::Machine;
use crate::{links, workspace::Workspace};

/// A crate of the programs.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct Crate {
    id: String,
    name: String,
    version: String,
    license: String,
    repository: Option<String>,
    /// The published crate; `None` for a crate of the workspace.
    source: Option<String>,
    folder: PathBuf,
    /// The ids of the crates that it uses.
    uses: Vec<String>,
}

impl Crate {
    fn purl(&self) -> String {
        // `+` has a meaning in URLs.
        format!(
            "pkg:cargo/{}@{}",
            self.name,
            self.version.replace('+', "%2B")
        )
    }

    /// Returns the version of OpenSSL that the crate contains, if it is its source.
    fn openssl(&self) -> Option<&str> {
        let (_, version) = self.version.split_once('+')?;
        (self.name == "openssl-src").then_some(version)
    }
}

/// Returns the crates that the packaged program is linked from, by name and version.
///
/// # Errors
/// Returns an error if `cargo metadata` fails.
pub(crate) fn crates(workspace: &Workspace, machine: Machine) -> anyhow::Result<Vec<Crate>> {
    let mut command = workspace.cargo(&["metadata", "--format-version", "1", "--locked"]);
    command.args(["--filter-platform", machine.triple]);
    command.args(["--features", "ua-bridge/vendored"]);
    let output = command.output().context("cargo metadata does not start")?;
    ensure!(
        output.status.success(),
        "cargo metadata: {}",
        String::from_utf8_lossy(&output.stderr)
    );
    linked(&serde_json::from_slice(&output.stdout)?)
}

/// Returns the crates that `ua-bridge` reaches by normal dependencies, and the source of OpenSSL.
fn linked(metadata: &Value) -> anyhow::Result<Vec<Crate>> {
    let list = |value: &Value, key: &str| -> Vec<Value> {
        let list = value.get(key).and_then(Value::as_array);
        list.cloned().unwrap_or_default()
    };
    let text = |value: &Value, key: &str| -> Option<String> {
        value.get(key)?.as_str().map(str::to_owned)
    };
    let resolve = metadata.get("resolve").context("metadata has no resolve")?;
    let nodes = list(resolve, "nodes");
    let uses: BTreeMap<String, Vec<String>> = nodes
        .iter()
        .filter_map(|node| {
            let linked = list(node, "deps").into_iter().filter(|dependency| {
                let kinds = list(dependency, "dep_kinds");
                let is_normal = kinds
                    .iter()
                    .any(|kind| kind.get("kind") == Some(&Value::Null));
                // The build script of openssl-sys links what this crate compiles.
                is_normal || text(dependency, "name").as_deref() == Some("openssl_src")
            });
            let ids = linked.filter_map(|dependency| text(&dependency, "pkg"));
            Some((text(node, "id")?, ids.collect()))
        })
        .collect();
    let packages = list(metadata, "packages");
    let root = packages
        .iter()
        .find(|package| text(package, "name").as_deref() == Some(links::TARGET))
        .and_then(|package| text(package, "id"))
        .context("metadata has no ua-bridge")?;
    let mut reached = BTreeSet::new();
    let mut open = vec![root];
    while let Some(id) = open.pop() {
        if let Some(next) = uses.get(&id)
            && reached.insert(id)
        {
            open.extend(next.iter().cloned());
        }
    }
    let mut crates: Vec<Crate> = packages
        .iter()
        .filter_map(|package| {
            let id = text(package, "id").filter(|id| reached.contains(id))?;
            let manifest = PathBuf::from(text(package, "manifest_path")?);
            Some(Crate {
                name: text(package, "name")?,
                version: text(package, "version")?,
                license: text(package, "license").unwrap_or_default(),
                repository: text(package, "repository"),
                source: text(package, "source"),
                folder: manifest.parent()?.to_owned(),
                uses: uses.get(&id).cloned().unwrap_or_default(),
                id,
            })
        })
        .collect();
    crates.sort_by(|a, b| (&a.name, &a.version).cmp(&(&b.name, &b.version)));
    Ok(crates)
}

/// Returns the licences of the crates of others with their texts.
///
/// # Errors
/// Returns an error if a text cannot be read.
pub(crate) fn licences(crates: &[Crate], patched: &[String]) -> anyhow::Result<String> {
    let mut page = String::from(
        "Third-party notices of UA bridge\n\n\
         The programs contain the crates below under their licences; the texts follow. The source \
         of each crate is at https://crates.io/crates/NAME/VERSION.\n\n\
         Changed crates: UA bridge builds these crates with the patches in \
         /usr/share/doc/ua-bridge/patches.tar.gz, which are under the licence of their crate (for \
         the async-opcua crates the Mozilla Public License 2.0, whose source form is the published \
         crate with these patches):\n",
    );
    for name in patched {
        // Writing to a string does not fail.
        let _written = writeln!(page, "  {name}");
    }
    page.push_str("\nCrates:\n");
    let mut texts: BTreeMap<String, Vec<String>> = BTreeMap::new();
    for third in crates.iter().filter(|third| third.source.is_some()) {
        let name = format!("{} {}", third.name, third.version);
        let license = &third.license;
        let _written = match &third.repository {
            Some(repository) => writeln!(page, "  {name}: {license}, {repository}"),
            None => writeln!(page, "  {name}: {license}"),
        };
        for text in texts_of(&third.folder)? {
            texts.entry(text).or_default().push(name.clone());
        }
        if let Some(version) = third.openssl() {
            let _written = writeln!(page, "  OpenSSL {version}: Apache-2.0, https://openssl.org");
            for text in texts_of(&third.folder.join("openssl"))? {
                let names = texts.entry(text).or_default();
                names.push(format!("OpenSSL {version}"));
            }
        }
    }
    let mut texts: Vec<_> = texts.into_iter().collect();
    texts.sort_by_key(|(_, names)| std::cmp::Reverse(names.len()));
    for (text, names) in texts {
        let line = "-".repeat(78);
        let _written = write!(page, "\n{line}\n{}\n{line}\n\n{text}\n", names.join(", "));
    }
    Ok(page)
}

/// Returns the texts of licences and notices in the folder of a crate.
fn texts_of(folder: &Path) -> anyhow::Result<Vec<String>> {
    const NAMES: [&str; 6] = [
        "license",
        "licence",
        "copying",
        "notice",
        "copyright",
        "unlicense",
    ];
    let entries = fs::read_dir(folder).with_context(|| folder.display().to_string())?;
    let mut paths = Vec::new();
    for entry in entries {
        let entry = entry?;
        let name = entry.file_name().to_string_lossy().to_lowercase();
        if NAMES.iter().any(|start| name.starts_with(start)) && entry.path().is_file() {
            paths.push(entry.path());
        }
    }
    paths.sort();
    let read = paths.iter().map(|path| {
        let bytes = fs::read(path).with_context(|| path.display().to_string())?;
        let text = String::from_utf8_lossy(&bytes).replace("\r\n", "\n");
        let lines: Vec<&str> = text.trim().lines().map(str::trim_end).collect();
        Ok(lines.join("\n"))
    });
    read.collect()
}

/// Returns the bill of materials in the JSON of CycloneDX 1.5. `lock` is the text of Cargo.lock,
/// and `patched` has `NAME-VERSION` of the patched crates. The last argument is the version of the
/// package and its time.
pub(crate) fn bill(
    crates: &[Crate],
    lock: &str,
    patched: &[String],
    (version, time): (&str, &str),
) -> Value {
    let sums = checksums(lock);
    let reference = |id: &str| crates.iter().find(|found| found.id == id).map(Crate::purl);
    let root = crates.iter().find(|found| found.name == links::TARGET);
    let mut components: Vec<Value> = Vec::new();
    for found in crates.iter().filter(|found| found.name != links::TARGET) {
        let key = format!("{}-{}", found.name, found.version);
        let hashes = sums
            .get(&key)
            .map(|sum| json!({"alg": "SHA-256", "content": sum}));
        let is_patched = patched.contains(&key);
        let pedigree = is_patched.then(|| {
            json!({
                "notes": format!("with the patches of patches/{key}"),
                "patches": [{"type": "unofficial"}],
            })
        });
        let mut component = json!({
            "type": "library",
            "bom-ref": found.purl(),
            "name": &found.name,
            "version": &found.version,
            "purl": found.purl(),
            "licenses": [{"expression": found.license.replace('/', " OR ")}],
            "hashes": hashes.into_iter().collect::<Vec<_>>(),
        });
        if let (Some(pedigree), Some(component)) = (pedigree, component.as_object_mut()) {
            component.insert("pedigree".to_owned(), pedigree);
        }
        components.push(component);
        if let Some(openssl) = found.openssl() {
            components.push(json!({
                "type": "library",
                "bom-ref": format!("pkg:generic/openssl@{openssl}"),
                "name": "openssl",
                "version": openssl,
                "purl": format!("pkg:generic/openssl@{openssl}"),
                "cpe": format!("cpe:2.3:a:openssl:openssl:{openssl}:*:*:*:*:*:*:*"),
                "licenses": [{"expression": "Apache-2.0"}],
            }));
        }
    }
    let dependencies: Vec<Value> = crates
        .iter()
        .map(|found| {
            let mut on: Vec<String> = found.uses.iter().filter_map(|id| reference(id)).collect();
            on.extend(
                found
                    .openssl()
                    .map(|openssl| format!("pkg:generic/openssl@{openssl}")),
            );
            json!({"ref": found.purl(), "dependsOn": on})
        })
        .collect();
    json!({
        "bomFormat": "CycloneDX",
        "specVersion": "1.5",
        "version": 1,
        "metadata": {
            "timestamp": time,
            "component": {
                "type": "application",
                "bom-ref": root.map(Crate::purl),
                "name": links::TARGET,
                "version": version,
                "licenses": [{"expression": "MIT OR Apache-2.0"}],
            },
        },
        "components": components,
        "dependencies": dependencies,
    })
}

/// Returns the list of crates that scanners read from a program: JSON in the format of
/// cargo-auditable, compressed by zlib.
///
/// # Errors
/// Returns an error if the list cannot be encoded.
pub(crate) fn audit(crates: &[Crate]) -> anyhow::Result<Vec<u8>> {
    let place = |id: &String| crates.iter().position(|found| found.id == *id);
    let packages: Vec<Value> = crates
        .iter()
        .map(|found| {
            let uses: BTreeSet<usize> = found.uses.iter().filter_map(place).collect();
            let source = match found.source {
                Some(_) => "crates.io",
                None => "local",
            };
            json!({
                "name": &found.name,
                "version": &found.version,
                "source": source,
                "dependencies": uses,
                "root": found.name == links::TARGET,
            })
        })
        .collect();
    let list = serde_json::to_vec(&json!({ "packages": packages }))?;
    Ok(compress_to_vec_zlib(&list, 9))
}

/// Returns the checksums of published crates by `NAME-VERSION`.
fn checksums(lock: &str) -> BTreeMap<String, String> {
    let value = |block: &str, key: &str| -> Option<String> {
        let mut lines = block.lines().filter_map(|line| line.split_once(" = "));
        let (_, value) = lines.find(|(name, _)| *name == key)?;
        Some(value.trim_matches('"').to_owned())
    };
    let blocks = lock.split("[[package]]");
    let sums = blocks.filter_map(|block| {
        let key = format!("{}-{}", value(block, "name")?, value(block, "version")?);
        Some((key, value(block, "checksum")?))
    });
    sums.collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn metadata(folder: &Path) -> Value {
        let package = |name: &str, version: &str, source: Value| {
            json!({
                "id": name, "name": name, "version": version, "license": "MIT/Apache-2.0",
                "repository": null, "source": source,
                "manifest_path": folder.join(name).join("Cargo.toml"),
            })
        };
        let uses = |name: &str, package: &str, kind: Value| json!({"name": name, "pkg": package, "dep_kinds": [{"kind": kind}]});
        json!({
            "packages": [
                package("ua-bridge", "0.1.0", Value::Null),
                package("openssl-sys", "0.9.1", json!("registry")),
                package("openssl-src", "300.6.1+3.6.3", json!("registry")),
                package("cc", "1.0.0", json!("registry")),
                package("proptest", "1.0.0", json!("registry")),
            ],
            "resolve": {"nodes": [
                {"id": "ua-bridge", "deps": [
                    uses("openssl_sys", "openssl-sys", Value::Null), uses("proptest", "proptest", json!("dev")),
                ]},
                {"id": "openssl-sys", "deps": [
                    uses("openssl_src", "openssl-src", json!("build")), uses("cc", "cc", json!("build")),
                ]},
                {"id": "openssl-src", "deps": [uses("cc", "cc", json!("build"))]},
                {"id": "cc", "deps": []},
                {"id": "proptest", "deps": []},
            ]},
        })
    }

    #[test]
    fn linked_crates_and_the_compiled_openssl_are_in_the_bill_and_the_notices() {
        let folder = std::env::temp_dir().join(format!("xtask-notices-{}", std::process::id()));
        for name in ["openssl-sys", "openssl-src/openssl"] {
            fs::create_dir_all(folder.join(name)).unwrap();
        }
        fs::write(folder.join("openssl-sys/LICENSE-MIT"), "text of MIT\r\n").unwrap();
        fs::write(
            folder.join("openssl-src/openssl/LICENSE.txt"),
            "text of Apache",
        )
        .unwrap();
        let crates = linked(&metadata(&folder)).unwrap();
        let names: Vec<&str> = crates.iter().map(|found| found.name.as_str()).collect();
        assert_eq!(names, ["openssl-src", "openssl-sys", "ua-bridge"]);

        let patched = ["openssl-sys-0.9.1".to_owned()];
        let notices = licences(&crates, &patched).unwrap();
        for expected in [
            "  openssl-sys-0.9.1\n",
            "  openssl-sys 0.9.1: MIT/Apache-2.0\n",
            "  OpenSSL 3.6.3: Apache-2.0, https://openssl.org\n",
            "\nOpenSSL 3.6.3\n",
            "\n\ntext of MIT\n",
        ] {
            assert!(notices.contains(expected), "{expected:?} in\n{notices}");
        }

        let lock = "[[package]]\nname = \"openssl-sys\"\nversion = \"0.9.1\"\nchecksum = \"abc\"\n";
        let bill = bill(&crates, lock, &patched, ("0.1.0+1", "2026-01-02T03:04:05Z"));
        let purls: Vec<&str> = bill["components"]
            .as_array()
            .unwrap()
            .iter()
            .map(|component| component["purl"].as_str().unwrap())
            .collect();
        assert_eq!(
            purls,
            [
                "pkg:cargo/openssl-src@300.6.1%2B3.6.3",
                "pkg:generic/openssl@3.6.3",
                "pkg:cargo/openssl-sys@0.9.1"
            ]
        );
        let patched = &bill["components"][2];
        assert_eq!(patched["hashes"][0]["content"], "abc");
        assert_eq!(patched["licenses"][0]["expression"], "MIT OR Apache-2.0");
        assert!(
            patched["pedigree"]["notes"]
                .as_str()
                .unwrap()
                .contains("patches/openssl-sys-0.9.1")
        );
        assert_eq!(
            bill["dependencies"][2]["dependsOn"],
            json!(["pkg:cargo/openssl-sys@0.9.1"])
        );
        fs::remove_dir_all(&folder).unwrap();
    }

    #[test]
    fn a_program_has_the_list_of_its_crates_for_scanners() {
        let crates = linked(&metadata(Path::new("/nowhere"))).unwrap();
        let list = audit(&crates).unwrap();
        let list = miniz_oxide::inflate::decompress_to_vec_zlib(&list).unwrap();
        let list: Value = serde_json::from_slice(&list).unwrap();
        let root = &list["packages"][2];
        assert_eq!(
            (&root["name"], &root["root"]),
            (&json!("ua-bridge"), &json!(true))
        );
        assert_eq!(root["source"], "local");
        assert_eq!(root["dependencies"], json!([1]));
        assert_eq!(list["packages"][1]["source"], "crates.io");
    }
}
