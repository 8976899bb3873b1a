//! The version of the programs.
//!
//! `cargo xtask dist` sets `UA_COMMIT` for the compiler. Other builds have no commit, so that a new
//! commit does not compile all programs again.

use std::sync::LazyLock;

/// The version of the workspace, such as `0.1.0`.
pub const VERSION: &str = env!("CARGO_PKG_VERSION");
/// The abbreviated commit of a packaged build.
pub const COMMIT: Option<&str> = option_env!("UA_COMMIT");

/// Returns the version with the commit as build metadata of Semantic Versioning, such as
/// `0.1.0+1a2b3c4d5e6f`; without a commit [`VERSION`].
#[must_use]
pub fn version() -> &'static str {
    static FULL: LazyLock<String> = LazyLock::new(|| with_commit(COMMIT));
    &FULL
}

fn with_commit(commit: Option<&str>) -> String {
    match commit.filter(|commit| !commit.is_empty()) {
        Some(commit) => format!("{VERSION}+{commit}"),
        None => VERSION.to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_commit_follows_the_version_as_build_metadata() {
        assert_eq!(with_commit(Some("1a2b3c")), format!("{VERSION}+1a2b3c"));
        assert_eq!(with_commit(None), VERSION);
        assert_eq!(with_commit(Some("")), VERSION);
    }
}
