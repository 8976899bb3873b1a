//! The C library that packages are linked with: that of Debian 11, so that the programs run from
//! Debian 11 and Ubuntu 20.04 on.

use std::{
    fs,
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
        let mut flags = vec![format!("-Clink-arg=--sysroot={sysroot}")];
        // The linker folds functions with equal code, which generics produce in numbers. Rust links
        // with LLD on this machine only.
        if self.rpm == "x86_64" {
            flags.push("-Clink-arg=-Wl,--icf=all".to_owned());
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
        if folder.join("usr/include/stdio.h").exists() {
            return Ok(folder);
        }
        step(&format!(
            "unpacking the C library of Debian {RELEASE} into {}",
            folder.display()
        ));
        let mirror = std::env::var("UA_DEBIAN_MIRROR");
        let mut debootstrap = Command::new("debootstrap");
        // The first stage unpacks packages and runs none of their programs.
        debootstrap
            .args(["--foreign", "--variant=minbase", "--include=libc6-dev"])
            .arg(format!("--arch={}", self.debian))
            .arg(RELEASE)
            .arg(&folder)
            .arg(mirror.as_deref().unwrap_or(MIRROR));
        must(&mut debootstrap).context("debootstrap makes the folder, as root")?;
        for package in packages(&folder.join("var/cache/apt/archives"))? {
            must(
                Command::new("dpkg-deb")
                    .arg("-x")
                    .arg(&package)
                    .arg(&folder),
            )?;
        }
        Ok(folder)
    }
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
