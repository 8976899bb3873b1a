//! The names of `ua-bridge`: links to the program, which select the program of the plant that it
//! runs as.

use std::{
    fs,
    io::ErrorKind,
    os::unix::fs::symlink,
    path::{Path, PathBuf},
};

use anyhow::Context as _;

/// The target of the links.
pub(crate) const TARGET: &str = "ua-bridge";
/// The names of the links.
pub(crate) const NAMES: [&str; 8] = [
    "ua-cell",
    "ua-component",
    "ua-gds",
    "ua-lds",
    "ua-mes",
    "ua-server",
    "ua-space",
    "ua-station",
];

/// The bridges, which are programs of their own, and names of `ua-bridge` in packages.
pub(crate) const BRIDGES: [&str; 2] = ["bridge-ros1", "bridge-ros2"];

/// Creates the links in a folder with `ua-bridge`. A file with the name of a link is replaced. Each
/// link is replaced atomically, because tests may run at the same time.
///
/// # Errors
/// Returns an error if the folder cannot be written.
pub(crate) fn make(folder: &Path) -> anyhow::Result<()> {
    make_named(folder, &NAMES)
}

/// Creates the links in a folder without the programs of the bridges, for which there are links,
/// too.
///
/// # Errors
/// Returns an error if the folder cannot be written.
pub(crate) fn make_all(folder: &Path) -> anyhow::Result<()> {
    make_named(folder, &BRIDGES)?;
    make(folder)
}

fn make_named(folder: &Path, names: &[&str]) -> anyhow::Result<()> {
    for name in names {
        let link = folder.join(name);
        if fs::read_link(&link).is_ok_and(|target| target == Path::new(TARGET)) {
            continue;
        }
        let new = folder.join(format!("{name}.{}", std::process::id()));
        remove(&new)?;
        symlink(TARGET, &new).with_context(|| new.display().to_string())?;
        fs::rename(&new, &link).with_context(|| link.display().to_string())?;
    }
    Ok(())
}

/// Returns the paths of all links in a folder.
pub(crate) fn paths(folder: &Path) -> impl Iterator<Item = PathBuf> {
    NAMES.into_iter().map(|name| folder.join(name))
}

fn remove(path: &Path) -> anyhow::Result<()> {
    match fs::remove_file(path) {
        Err(error) if error.kind() != ErrorKind::NotFound => {
            Err(error).with_context(|| path.display().to_string())
        }
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn links_replace_programs_of_the_same_name_and_stay() {
        let folder = std::env::temp_dir().join(format!("xtask-links-{}", std::process::id()));
        fs::create_dir_all(&folder).unwrap();
        fs::write(folder.join(TARGET), "new").unwrap();
        fs::write(folder.join("ua-server"), "old").unwrap();
        for _ in 0..2 {
            make(&folder).unwrap();
            for link in paths(&folder) {
                assert_eq!(fs::read_link(&link).unwrap(), Path::new(TARGET));
                assert_eq!(fs::read_to_string(&link).unwrap(), "new");
            }
            let all = fs::read_dir(&folder).unwrap().count();
            assert_eq!(all, 1 + NAMES.len());
        }
        fs::remove_dir_all(&folder).unwrap();
    }
}
