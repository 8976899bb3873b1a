//! The C library that packages are linked with: that of Debian 11, so that the programs run from
//! Debian 11 and Ubuntu 20.04 on.

use std::{
    fs,
    os::unix::fs::symlink,
    path::{Path, PathBuf},
    process::Command,
};

use anyhow::{Context as _, ensure};

use crate::{
    shell::{run as must, step, succeeds},
    workspace::Workspace,
};

/// The release whose C library is linked. glibc 2.31.
const RELEASE: &str = "bullseye";
/// The mirror of Debian; `UA_DEBIAN_MIRROR` names another one.
const MIRROR: &str = "http://deb.debian.org/debian";

/// A machine that packages are made for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Machine {
    /// The target of rustc.
    pub(crate) triple: &'static str,
    /// The architecture in names of Debian.
    pub(crate) debian: &'static str,
    /// The architecture in names of RPM and of containers' base systems.
    pub(crate) rpm: &'static str,
}

/// All machines that packages can be made for, each on a machine of its kind.
const MACHINES: [Machine; 2] = [
    Machine {
        triple: "x86_64-unknown-linux-gnu",
        debian: "amd64",
        rpm: "x86_64",
    },
    Machine {
        triple: "aarch64-unknown-linux-gnu",
        debian: "arm64",
        rpm: "aarch64",
    },
];

impl Machine {
    /// Returns the machine that this program runs on.
    pub(crate) fn host() -> Option<Self> {
        let here = std::env::consts::ARCH;
        MACHINES.into_iter().find(|machine| machine.rpm == here)
    }

    /// Adds the settings to `build` that compile and link for this machine and the old C library.
    ///
    /// # Errors
    /// Returns an error if a tool is missing or Debian's mirror cannot be reached.
    pub(crate) fn configure(
        self,
        workspace: &Workspace,
        build: &mut Command,
    ) -> anyhow::Result<()> {
        ensure!(
            succeeds("gcc", &["--version"]),
            "gcc is missing: install it (on Debian `apt-get install gcc libc6-dev`)"
        );
        let sysroot = self.sysroot(workspace)?;
        let sysroot = sysroot.display();
        let variable = self.triple.replace('-', "_");
        let prefix = format!("CARGO_TARGET_{}", variable.to_uppercase());
        // gcc searches the folders of this host, too, and those of `-B` before them.
        let mut flags = vec![format!("-Clink-arg=--sysroot={sysroot}")];
        for folder in ["usr/lib", "lib"] {
            let folder = format!("{sysroot}/{folder}/{}-linux-gnu/", self.rpm);
            flags.push(format!("-Clink-arg=-B{folder}"));
        }
        build
            .args(["--target", self.triple])
            .env(format!("{prefix}_LINKER"), "gcc")
            .env(format!("{prefix}_RUSTFLAGS"), flags.join(" "))
            .env(format!("CC_{variable}"), "gcc")
            .env(format!("CFLAGS_{variable}"), format!("--sysroot={sysroot}"));
        Ok(())
    }

    /// Returns a folder with the C library and its headers, which is made once.
    fn sysroot(self, workspace: &Workspace) -> anyhow::Result<PathBuf> {
        let folder = workspace.target.join(format!("sysroot-{}", self.debian));
        if folder.exists() {
            return Ok(folder);
        }
        step(&format!(
            "unpacking the C library of Debian {RELEASE} into {}",
            folder.display()
        ));
        let root = folder.with_extension("debootstrap");
        let new = folder.with_extension("new");
        for folder in [&root, &new] {
            if folder.exists() {
                fs::remove_dir_all(folder).with_context(|| folder.display().to_string())?;
            }
        }
        let mirror = std::env::var("UA_DEBIAN_MIRROR");
        let mut debootstrap = Command::new("debootstrap");
        // The first stage downloads packages, checks their signature, and runs none of their
        // programs.
        debootstrap
            .args(["--foreign", "--variant=minbase", "--include=libc6-dev"])
            .arg(format!("--arch={}", self.debian))
            .arg(RELEASE)
            .arg(&root)
            .arg(mirror.as_deref().unwrap_or(MIRROR));
        must(&mut debootstrap).context("debootstrap makes the folder, as root")?;
        for package in packages(&root.join("var/cache/apt/archives"))? {
            must(Command::new("dpkg-deb").arg("-x").arg(&package).arg(&new))?;
        }
        relate_links(&new, 0)?;
        fs::remove_dir_all(&root).with_context(|| root.display().to_string())?;
        fs::rename(&new, &folder).with_context(|| folder.display().to_string())?;
        Ok(folder)
    }
}

/// Makes all absolute links below a folder relative, because they would lead to the libraries of
/// this host. `depth` is the number of folders above `folder` in the root.
fn relate_links(folder: &Path, depth: usize) -> anyhow::Result<()> {
    let entries = fs::read_dir(folder).with_context(|| folder.display().to_string())?;
    for entry in entries {
        let path = entry?.path();
        if let Ok(target) = fs::read_link(&path) {
            if let Ok(below) = target.strip_prefix("/") {
                let relative = Path::new(&"../".repeat(depth)).join(below);
                fs::remove_file(&path).with_context(|| path.display().to_string())?;
                symlink(relative, &path).with_context(|| path.display().to_string())?;
            }
        } else if path.is_dir() {
            relate_links(&path, depth + 1)?;
        }
    }
    Ok(())
}

/// Returns the downloaded packages with files for linking.
fn packages(folder: &Path) -> anyhow::Result<Vec<PathBuf>> {
    let entries = fs::read_dir(folder).with_context(|| folder.display().to_string())?;
    let paths = entries.map(|entry| entry.map(|entry| entry.path()));
    let mut paths: Vec<PathBuf> = paths.collect::<Result<_, _>>()?;
    paths.retain(|path| {
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        let package = name.split('_').next().unwrap_or_default();
        package.ends_with("-dev") || package.starts_with("libc6") || package == "libgcc-s1"
    });
    paths.sort();
    Ok(paths)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn absolute_links_lead_to_files_of_the_folder() {
        let folder = std::env::temp_dir().join(format!("xtask-sysroot-{}", std::process::id()));
        for below in ["lib", "usr/lib/x"] {
            fs::create_dir_all(folder.join(below)).unwrap();
        }
        fs::write(folder.join("lib/libc.so.6"), "old").unwrap();
        symlink("/lib/libc.so.6", folder.join("usr/lib/x/libc.so")).unwrap();
        symlink("libc.so", folder.join("usr/lib/x/other.so")).unwrap();
        symlink("/lib/libc.so.6", folder.join("top")).unwrap();
        relate_links(&folder, 0).unwrap();
        for link in ["usr/lib/x/libc.so", "usr/lib/x/other.so", "top"] {
            assert_eq!(
                fs::read_to_string(folder.join(link)).unwrap(),
                "old",
                "{link}"
            );
        }
        fs::remove_dir_all(&folder).unwrap();
    }
}
