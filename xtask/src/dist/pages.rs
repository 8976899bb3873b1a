//! The pages of a package: links to files that the package lacks become plain text, or links to the
//! repository.

use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
};

use anyhow::{Context as _, ensure};
use serde_json::Value;

use crate::{links, markdown::joined, workspace::Workspace};

/// The files of the sources that a package has: their paths below the root of the sources, and
/// their paths in the package.
#[derive(Debug, Default)]
pub(super) struct ShippedSources {
    paths: BTreeMap<PathBuf, String>,
    /// The URL of the files of the repository, if the project has a repository.
    repository: Option<String>,
}

impl ShippedSources {
    pub(super) fn new(repository: Option<String>) -> Self {
        Self {
            paths: BTreeMap::new(),
            repository,
        }
    }

    /// Adds a file.
    pub(super) fn add(&mut self, source: impl Into<PathBuf>, packaged: impl Into<String>) {
        self.paths.insert(source.into(), packaged.into());
    }

    /// Returns the files with their places in the package.
    pub(super) fn files(&self) -> impl Iterator<Item = (&Path, &str)> {
        let paths = self.paths.iter();
        paths.map(|(source, packaged)| (source.as_path(), packaged.as_str()))
    }

    /// Returns a page as it is in the package; `None` if the package does not have it.
    pub(super) fn page(&self, source: &Path, text: &str) -> Option<String> {
        let own = Path::new(self.paths.get(source)?);
        let folder = source.parent().unwrap_or_else(|| Path::new(""));
        let mut page = String::new();
        for (number, block) in text.split("```").enumerate() {
            if number > 0 {
                page.push_str("```");
            }
            match number % 2 {
                0 => self.prose(block, (folder, own), &mut page),
                _ => page.push_str(block),
            }
        }
        Some(page)
    }

    /// Appends text outside of code blocks.
    fn prose(&self, text: &str, (folder, own): (&Path, &Path), page: &mut String) {
        let mut rest = text;
        while let Some(link) = InlineLink::first(rest) {
            page.push_str(link.before);
            let (path, anchor) = match link.target.split_once('#') {
                Some((path, anchor)) => (path, format!("#{anchor}")),
                None => (link.target, String::new()),
            };
            let target = (!path.is_empty() && !path.contains("://")).then(|| joined(folder, path));
            match target.map(|target| self.place(&target, own)) {
                None => page.push_str(link.whole),
                Some(LinkTarget::Shipped(place)) => {
                    page.push_str(&format!("[{}]({place}{anchor})", link.text));
                }
                Some(LinkTarget::Repository(url)) => {
                    page.push_str(&format!("[{}]({url}{anchor})", link.text));
                }
                Some(LinkTarget::Text) => page.push_str(link.text),
            }
            rest = link.after;
        }
        page.push_str(rest);
    }

    /// Returns the place of a file or folder of the sources for a page of the package.
    fn place(&self, target: &Path, own: &Path) -> LinkTarget {
        let exact = self.paths.get(target).map(PathBuf::from);
        // A folder is where its first file is.
        let folder = || {
            let mut below = self.paths.iter();
            let (file, packaged) = below.find(|(file, _)| file.starts_with(target))?;
            let depth = file.strip_prefix(target).ok()?.components().count();
            let mut packaged = Path::new(packaged).ancestors();
            packaged.nth(depth).map(Path::to_owned)
        };
        if let Some(packaged) = exact.or_else(folder) {
            return LinkTarget::Shipped(relative(&packaged, own));
        }
        match &self.repository {
            Some(url) => LinkTarget::Repository(format!("{url}/{}", target.display())),
            None => LinkTarget::Text,
        }
    }
}

/// The target of a link in a package.
enum LinkTarget {
    Shipped(String),
    Repository(String),
    Text,
}

/// The first link of a text: `[text](target)`.
struct InlineLink<'a> {
    before: &'a str,
    whole: &'a str,
    text: &'a str,
    target: &'a str,
    after: &'a str,
}

impl<'a> InlineLink<'a> {
    fn first(all: &'a str) -> Option<Self> {
        let middle = all.find("](")?;
        let (head, tail) = all.split_at(middle);
        let mut depth = 0_usize;
        let opening = head.char_indices().rev().find(|(_, char)| match char {
            ']' => {
                depth += 1;
                false
            }
            '[' if depth == 0 => true,
            '[' => {
                depth -= 1;
                false
            }
            _ => false,
        });
        let begin = opening.map_or(middle, |(begin, _)| begin);
        let (target, after) = tail.strip_prefix("](")?.split_once(')')?;
        let whole = all.get(begin..all.len().checked_sub(after.len())?)?;
        Some(Self {
            before: all.get(..begin)?,
            whole,
            text: head.get(begin..)?.strip_prefix('[').unwrap_or_default(),
            target,
            after,
        })
    }
}

/// Returns the path of a file of the package as a link of a page of the package.
fn relative(file: &Path, page: &Path) -> String {
    let from: Vec<_> = page
        .parent()
        .into_iter()
        .flat_map(Path::components)
        .collect();
    let to: Vec<_> = file.components().collect();
    let pairs = from.iter().zip(&to);
    let shared = pairs.take_while(|(one, other)| one == other).count();
    let up = std::iter::repeat_n("..".to_owned(), from.len() - shared);
    let down = to.iter().skip(shared);
    let down = down.map(|part| part.as_os_str().to_string_lossy().into_owned());
    up.chain(down).collect::<Vec<_>>().join("/")
}

/// Returns the URL of the files of the repository, if the manifest of the packaged program has one.
///
/// # Errors
/// Returns an error if the manifest cannot be read.
pub(super) fn repository(workspace: &Workspace) -> anyhow::Result<Option<String>> {
    let mut command = workspace.cargo(&["metadata", "--no-deps", "--format-version", "1"]);
    let output = command.output().context("cargo metadata does not start")?;
    ensure!(
        output.status.success(),
        "cargo metadata: {}",
        String::from_utf8_lossy(&output.stderr)
    );
    repository_of(&output.stdout, links::TARGET)
}

fn repository_of(metadata: &[u8], package: &str) -> anyhow::Result<Option<String>> {
    let metadata: Value = serde_json::from_slice(metadata).context("cargo metadata")?;
    let packages = metadata.get("packages").and_then(Value::as_array);
    let mut packages = packages.into_iter().flatten();
    let text = |of: &'_ Value, key: &str| Some(of.get(key)?.as_str()?.to_owned());
    let own = packages.find(|of| text(of, "name").is_some_and(|name| name == package));
    let url = own.and_then(|own| text(own, "repository"));
    Ok(url.map(|url| format!("{}/blob/HEAD", url.trim_end_matches('/'))))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sources(repository: Option<&str>) -> ShippedSources {
        let mut sources = ShippedSources::new(repository.map(str::to_owned));
        sources.add("docs/types.md", "usr/share/doc/own/types.md");
        sources.add("docs/reference/a.md", "usr/share/doc/own/reference/a.md");
        sources.add(
            "mappings/calls.yaml",
            "usr/share/doc/own/examples/calls.yaml",
        );
        sources.add("ros/msg/A.msg", "usr/share/own/ros/msg/A.msg");
        sources
    }

    fn page(repository: Option<&str>, text: &str) -> String {
        let page = sources(repository).page(Path::new("docs/types.md"), text);
        page.expect("the page is shipped")
    }

    #[test]
    fn links_lead_to_the_files_of_the_package() {
        for (text, expected) in [
            ("[a](reference/a.md#b) c", "[a](reference/a.md#b) c"),
            ("[c](../mappings/calls.yaml)", "[c](examples/calls.yaml)"),
            ("[m](../ros/msg)", "[m](../../own/ros/msg)"),
            ("[m](../ros)", "[m](../../own/ros)"),
            (
                "[x](https://x.org/a) [y](#z)",
                "[x](https://x.org/a) [y](#z)",
            ),
            (
                "```\n[c](../mappings/calls.yaml)\n```\n",
                "```\n[c](../mappings/calls.yaml)\n```\n",
            ),
        ] {
            assert_eq!(page(None, text), expected);
        }
        assert!(sources(None).page(Path::new("docs/b.md"), "").is_none());
    }

    #[test]
    fn links_to_other_files_are_text_or_lead_to_the_repository() {
        let text = "see [the `driver` [2]](../plant/driver.rs), or [b](b.md#c).";
        assert_eq!(page(None, text), "see the `driver` [2], or b.");
        let url = "https://example.org/own/blob/HEAD";
        let expected =
            format!("see [the `driver` [2]]({url}/plant/driver.rs), or [b]({url}/docs/b.md#c).");
        assert_eq!(page(Some(url), text), expected);
    }

    #[test]
    fn the_repository_is_that_of_the_package() {
        let metadata = br#"{"packages": [{"name": "a", "repository": "https://example.org/a/"},
            {"name": "b", "repository": null}]}"#;
        let of = |name| repository_of(metadata, name).expect("it can be read");
        assert_eq!(of("a").as_deref(), Some("https://example.org/a/blob/HEAD"));
        assert_eq!(of("b"), None);
    }
}
