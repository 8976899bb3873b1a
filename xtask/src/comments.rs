//! The width of comments: `rustfmt` of the stable toolchain does not wrap them.

use std::{
    fs,
    path::{Path, PathBuf},
};

use anyhow::Context as _;

use crate::{shell::step, workspace::Workspace};

/// The columns at which the lines of a comment end.
const COLUMNS: usize = 100;
/// The number of wider lines that remain: help texts of commands, descriptions in the schema of the
/// mapping, examples and tables. The number may only fall.
const WIDER: usize = 83;

/// Returns whether no more comment lines than [`WIDER`] are wider than [`COLUMNS`]. Prints the
/// counts per file otherwise.
///
/// # Errors
/// Returns an error if a folder or a source cannot be read.
pub(crate) fn are_narrow(workspace: &Workspace) -> anyhow::Result<bool> {
    step("width of comments");
    let mut sources = Vec::new();
    collect(&workspace.root, &mut sources)?;
    let mut files = Vec::new();
    for file in sources {
        let text = fs::read_to_string(&file).with_context(|| file.display().to_string())?;
        let count = wide_lines(&text);
        if count > 0 {
            files.push((count, file));
        }
    }
    let all: usize = files.iter().map(|(count, _)| count).sum();
    if all <= WIDER {
        return Ok(true);
    }
    files.sort_by(|one, other| other.cmp(one));
    for (count, file) in &files {
        println!("{count:5} {}", file.display());
    }
    eprintln!(
        "xtask: {all} comment lines are wider than {COLUMNS} columns, {WIDER} are allowed: wrap the new ones"
    );
    Ok(false)
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
}
