//! Checks links between the Markdown pages of the project.

use std::{
    collections::BTreeSet,
    fs,
    path::{Component, Path, PathBuf},
};

use anyhow::Context as _;

/// Folders with pages.
const FOLDERS: [&str; 6] = [
    "",
    "docs",
    "docs/decisions",
    "docs/reference",
    "docs/wireshark",
    "uadp",
];

/// Returns the broken links of all pages, each with its page: links to missing files or headings.
///
/// # Errors
/// Returns an error if a folder or page cannot be read.
pub(crate) fn broken_links(root: &Path) -> anyhow::Result<Vec<String>> {
    let mut broken = Vec::new();
    for folder in FOLDERS.map(Path::new) {
        let entries = fs::read_dir(root.join(folder)).context(folder.display().to_string())?;
        for entry in entries {
            let name = folder.join(entry?.file_name());
            if name.extension().is_some_and(|end| end == "md") {
                let text = read(&root.join(&name))?;
                for link in links(&text).filter(|link| !link.contains("://")) {
                    if !has_target(root, &name, &text, link)? {
                        broken.push(format!(
                            "{} links to {link}, which is missing",
                            name.display()
                        ));
                    }
                }
            }
        }
    }
    Ok(broken)
}

/// Returns true if the file and the heading of a link exist.
fn has_target(root: &Path, page: &Path, text: &str, link: &str) -> anyhow::Result<bool> {
    let (path, anchor) = link.split_once('#').unwrap_or((link, ""));
    if path.is_empty() {
        return Ok(anchors(text).contains(anchor));
    }
    let target = root.join(joined(page.parent().unwrap_or_else(|| Path::new("")), path));
    if anchor.is_empty() || target.extension().is_none_or(|end| end != "md") {
        return Ok(target.exists());
    }
    Ok(target.exists() && anchors(&read(&target)?).contains(anchor))
}

fn read(file: &Path) -> anyhow::Result<String> {
    fs::read_to_string(file).with_context(|| file.display().to_string())
}

/// Returns the lines of a page outside of code blocks.
fn prose(text: &str) -> impl Iterator<Item = &str> {
    let blocks = text.split("```").step_by(2);
    blocks.flat_map(str::lines)
}

/// Returns the targets of all links `[text](target)`.
pub(crate) fn links(text: &str) -> impl Iterator<Item = &str> {
    prose(text).flat_map(|line| {
        let behind = line.split("](").skip(1);
        behind.filter_map(|rest| rest.split_once(')').map(|(target, _)| target))
    })
}

/// Returns the anchors of all headings, in the form that the usual hosts generate.
fn anchors(text: &str) -> BTreeSet<String> {
    let headings = prose(text).filter(|line| line.starts_with('#'));
    let titles = headings.map(|line| line.trim_start_matches('#').trim().to_lowercase());
    let kept = |c: char| c.is_alphanumeric() || c == '-' || c == '_' || c == ' ';
    titles
        .map(|title| title.chars().filter(|c| kept(*c)).collect::<String>())
        .map(|title| title.replace(' ', "-"))
        .collect()
}

/// Returns a path relative to a folder, without `..`.
pub(crate) fn joined(folder: &Path, path: &str) -> PathBuf {
    let mut joined = folder.to_path_buf();
    for component in Path::new(path).components() {
        match component {
            Component::ParentDir => {
                joined.pop();
            }
            Component::Normal(name) => joined.push(name),
            Component::CurDir | Component::RootDir | Component::Prefix(_) => {}
        }
    }
    joined
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn links_are_read_outside_of_code_and_headings_are_anchors() {
        let text =
            "# The `ua-space` page\n[a](b.md#c), [d](#e)\n```sh\n[f](g)\n```\n## Limits, all\n";
        assert_eq!(links(text).collect::<Vec<_>>(), ["b.md#c", "#e"]);
        let anchors = anchors(text);
        assert!(anchors.contains("the-ua-space-page"), "{anchors:?}");
        assert!(anchors.contains("limits-all"), "{anchors:?}");
    }

    #[test]
    fn links_are_relative_to_the_folder_of_their_page() {
        let docs = Path::new("docs");
        assert_eq!(joined(docs, "../README.md"), Path::new("README.md"));
        assert_eq!(joined(docs, "a/b.md"), Path::new("docs/a/b.md"));
    }

    #[test]
    fn links_to_missing_files_and_headings_are_found() {
        let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
        let page = Path::new("docs/README.md");
        let fits = |link: &str| has_target(&root, page, "# Title\n", link).unwrap();
        assert!(fits("#title") && fits("../README.md") && fits("../README.md#limits"));
        assert!(!fits("#limits") && !fits("none.md") && !fits("../README.md#none"));
    }
}
