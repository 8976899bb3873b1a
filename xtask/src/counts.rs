//! Two counts that may only fall: wide comment lines, which `rustfmt` of the stable toolchain does
//! not wrap, and names of types that stand for more than one visible type.

use std::{
    collections::{BTreeMap, BTreeSet},
    fs,
    path::{Path, PathBuf},
};

use anyhow::Context as _;

use crate::{shell::step, workspace::Workspace};

/// The columns at which the lines of a comment end.
const COLUMNS: usize = 100;
/// The number of wider lines that remain: help texts of commands, descriptions in the schema of the
/// mapping, examples and tables. The number may only fall.
const WIDER: usize = 60;
/// The number of names that more than one visible type has: the same term of ROS in both client
/// libraries. The number may only fall.
const SHARED_NAMES: usize = 9;

/// Returns whether no more comment lines than [`WIDER`] are wider than [`COLUMNS`], and no more
/// names than [`SHARED_NAMES`] stand for several types. Prints the places otherwise.
///
/// # Errors
/// Returns an error if a folder or a source cannot be read.
pub(crate) fn have_not_risen(workspace: &Workspace) -> anyhow::Result<bool> {
    step("width of comments, names of types");
    let mut paths = Vec::new();
    collect(&workspace.root, &mut paths)?;
    let mut sources = Vec::new();
    for path in paths {
        let text = fs::read_to_string(&path).with_context(|| path.display().to_string())?;
        sources.push((path, text));
    }
    let are_narrow = are_narrow(&sources);
    Ok(are_unique(&sources) && are_narrow)
}

/// Returns whether few enough comment lines are wide, and prints their counts per file otherwise.
fn are_narrow(sources: &[(PathBuf, String)]) -> bool {
    let counts = sources.iter().map(|(path, text)| (wide_lines(text), path));
    let mut files: Vec<_> = counts.filter(|(count, _)| *count > 0).collect();
    let all: usize = files.iter().map(|(count, _)| count).sum();
    if all <= WIDER {
        return true;
    }
    files.sort_by(|one, other| other.cmp(one));
    for (count, file) in &files {
        println!("{count:5} {}", file.display());
    }
    eprintln!(
        "xtask: {all} comment lines are wider than {COLUMNS} columns, {WIDER} are allowed: wrap the new ones"
    );
    false
}

/// Returns whether few enough names stand for several types, and prints their files otherwise.
fn are_unique(sources: &[(PathBuf, String)]) -> bool {
    let mut files: BTreeMap<&str, BTreeSet<&Path>> = BTreeMap::new();
    for (path, text) in sources {
        for name in text.lines().filter_map(visible_type) {
            files.entry(name).or_default().insert(path);
        }
    }
    files.retain(|_, files| files.len() > 1);
    if files.len() <= SHARED_NAMES {
        return true;
    }
    for (name, files) in &files {
        let files: Vec<String> = files
            .iter()
            .map(|file| file.display().to_string())
            .collect();
        println!("{name}: {}", files.join(", "));
    }
    eprintln!(
        "xtask: {} names stand for several types, {SHARED_NAMES} are allowed: rename the new ones by \
         what they are for",
        files.len()
    );
    false
}

/// Collects the Rust sources below a folder, without hidden folders and folders of built files.
fn collect(folder: &Path, sources: &mut Vec<PathBuf>) -> anyhow::Result<()> {
    let entries = fs::read_dir(folder).with_context(|| folder.display().to_string())?;
    for entry in entries {
        let path = entry?.path();
        let name = path.file_name().unwrap_or_default();
        if path.is_symlink() || name == "target" || name.as_encoded_bytes().starts_with(b".") {
            continue;
        }
        if path.is_dir() {
            collect(&path, sources)?;
        } else if path.extension().is_some_and(|end| end == "rs") {
            sources.push(path);
        }
    }
    Ok(())
}

/// Returns the number of comment lines that are too wide.
fn wide_lines(text: &str) -> usize {
    text.lines()
        .filter(|line| line.trim_start().starts_with("//") && line.chars().count() > COLUMNS)
        .count()
}

/// Returns the name of the type that a line defines, if the type is visible outside its module.
fn visible_type(line: &str) -> Option<&str> {
    let public = line.trim_start().strip_prefix("pub")?;
    let rest = match public.strip_prefix('(') {
        Some(limited) => limited.split_once(')')?.1,
        None => public,
    };
    let (kind, rest) = rest.strip_prefix(' ')?.split_once(' ')?;
    if !["struct", "enum", "trait", "type", "union"].contains(&kind) {
        return None;
    }
    let name = rest
        .split(|next: char| !next.is_alphanumeric() && next != '_')
        .next();
    name.filter(|name| !name.is_empty())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn comments_beyond_the_last_column_are_counted_and_code_is_not() {
        let comment = |columns: usize| format!("    // {}", "x".repeat(columns - 7));
        let code = format!("    let x = \"{}\";", "x".repeat(120));
        let text = [comment(100), comment(101), code].join("\n");
        assert_eq!(wide_lines(&text), 1);
    }

    #[test]
    fn only_types_that_other_modules_see_have_names_to_compare() {
        assert_eq!(
            visible_type("    pub(crate) struct Topic<T> {"),
            Some("Topic")
        );
        assert_eq!(visible_type("pub enum State {"), Some("State"));
        for line in ["struct Topic;", "pub fn topic() {", "// pub struct Topic;"] {
            assert_eq!(visible_type(line), None, "{line}");
        }
    }
}
