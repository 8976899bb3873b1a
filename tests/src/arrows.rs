//! The dependency rules of the workspace, checked with `cargo tree`.

use std::process::Command;

/// Returns the crates that `package` reaches through normal dependencies, its own name included, as
/// `cargo tree` prints them.
///
/// # Panics
/// Panics if cargo fails.
#[must_use]
pub fn tree(package: &str) -> String {
    let output = Command::new(env!("CARGO"))
        .current_dir(concat!(env!("CARGO_MANIFEST_DIR"), "/.."))
        .args(["tree", "--offline", "--locked", "--edges", "normal"])
        .args(["--prefix", "none", "--package", package])
        .output()
        .unwrap();
    assert!(
        output.status.success(),
        "cargo tree for {package}: {}",
        String::from_utf8_lossy(&output.stderr)
    );
    String::from_utf8(output.stdout).unwrap()
}

/// Returns the crates of `tree` that are in `banned`, each once and sorted. A banned name ending in
/// `*` stands for all crates with this prefix.
#[must_use]
pub fn forbidden(tree: &str, banned: &[&str]) -> Vec<String> {
    let mut found: Vec<String> = tree
        .lines()
        .filter_map(|line| line.split_whitespace().next())
        .filter(|name| banned.iter().any(|rule| matches(rule, name)))
        .map(str::to_owned)
        .collect();
    found.sort();
    found.dedup();
    found
}

fn matches(rule: &str, name: &str) -> bool {
    rule.strip_suffix('*')
        .map_or(rule == name, |start| name.starts_with(start))
}

#[cfg(test)]
mod tests {
    use super::*;

    const TREE: &str = "bridge-core v0.1.0 (/somewhere/bridge-core)\n\
                        hdrhistogram v7.6.0\n\
                        tokio v1.47.0\n\
                        mio v1.0.4\n\
                        tokio v1.47.0 (*)\n\
                        tokio-util v0.7.1\n\
                        async-opcua-server v0.19.0\n";

    #[test]
    fn a_crate_that_is_reached_is_found_once() {
        assert_eq!(forbidden(TREE, &["tokio", "mio"]), ["mio", "tokio"]);
    }

    #[test]
    fn a_name_that_only_begins_alike_is_another_crate() {
        assert_eq!(forbidden(TREE, &["async-opcua", "hdr"]), [""; 0]);
    }

    #[test]
    fn a_rule_with_a_star_stands_for_a_family() {
        assert_eq!(
            forbidden(TREE, &["async-opcua-*", "tokio*"]),
            ["async-opcua-server", "tokio", "tokio-util"]
        );
    }
}
