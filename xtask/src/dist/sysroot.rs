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

/// The release of the C library that is linked. glibc 2.31.
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
    /// The name of GNU, which begins those of the tools and names the folders of libraries.
    gnu: &'static str,
}

/// All machines that packages can be made for.
const MACHINES: [Machine; 3] = [
    Machine {
        triple: "x86_64-unknown-linux-gnu",
        debian: "amd64",
        rpm: "x86_64",
        gnu: "x86_64-linux-gnu",
    },
    Machine {
        triple: "aarch64-unknown-linux-gnu",
        debian: "arm64",
        rpm: "aarch64",
        gnu: "aarch64-linux-gnu",
    },
    Machine {
        triple: "armv7-unknown-linux-gnueabihf",
        debian: "armhf",
        rpm: "armv7hl",
        gnu: "arm-linux-gnueabihf",
    },
];

impl Machine {
    /// Returns the machine that this program runs on.
    pub(crate) fn host() -> Option<Self> {
        let here = std::env::consts::ARCH;
        let begins = |machine: &Self| machine.triple.split('-').next() == Some(here);
        MACHINES.into_iter().find(begins)
    }

    /// Returns the machine with this architecture of Debian.
    pub(crate) fn named(debian: &str) -> Option<Self> {
        MACHINES
            .into_iter()
            .find(|machine| machine.debian == debian)
    }

    /// Returns whether this machine runs the programs.
    pub(crate) fn is_host(self) -> bool {
        Self::host() == Some(self)
    }

    /// Returns the name of a tool of the compiler for this machine, as `gcc`.
    pub(crate) fn tool(self, name: &str) -> String {
        match self.is_host() {
            true => name.to_owned(),
            false => format!("{}-{name}", self.gnu),
        }
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
        let gcc = self.tool("gcc");
        ensure!(
            succeeds(&gcc, &["--version"]),
            "{gcc} is missing: install it (on Debian `apt-get install {}`)",
            match self.is_host() {
                true => "gcc libc6-dev".to_owned(),
                false => format!("gcc-{}", self.gnu),
            }
        );
        let standard = printed(&["target-libdir", "--target", self.triple])?;
        ensure!(
            standard.is_dir(),
            "Rust's standard library for {0} is missing: `rustup target add {0}`, or with Debian's rustc-web \
             `dpkg --add-architecture {1} && apt-get update && apt-get install libstd-rust-web-dev:{1}`",
            self.triple,
            self.debian
        );
        let sysroot = self.sysroot(workspace)?;
        let sysroot = sysroot.display();
        let variable = self.triple.replace('-', "_");
        let prefix = format!("CARGO_TARGET_{}", variable.to_uppercase());
        // gcc searches the folders of this host, too, and those of `-B` before them.
        let mut flags = vec![format!("-Clink-arg=--sysroot={sysroot}")];
        for folder in ["usr/lib", "lib"] {
            let folder = format!("{sysroot}/{folder}/{}/", self.gnu);
            flags.push(format!("-Clink-arg=-B{folder}"));
        }
        flags.extend(fold()?);
        build
            .args(["--target", self.triple])
            .env(format!("{prefix}_LINKER"), &gcc)
            .env(format!("{prefix}_RUSTFLAGS"), flags.join(" "))
            .env(format!("CC_{variable}"), &gcc)
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

/// Returns the flags for a linker that keeps one copy of functions with the same instructions, such
/// as conversions, drops and formatting of similar types.
///
/// Folded functions have the same address. Rust does not promise different addresses of functions.
/// Of the C code in the programs, OpenSSL compares addresses of functions to recognise its own
/// defaults, such as the allocator, whose instructions no other function has. A backtrace shows one
/// name for all functions that were folded into one.
fn fold() -> anyhow::Result<Vec<String>> {
    let mut flags = Vec::new();
    // The linker that comes with rustc, else that of the system.
    let host = printed(&["host-tuple"])?;
    let own = printed(&["sysroot"])?
        .join("lib/rustlib")
        .join(host)
        .join("bin/gcc-ld");
    if own.join("ld.lld").exists() {
        flags.push(format!("-Clink-arg=-B{}", own.display()));
    } else {
        ensure!(
            succeeds("ld.lld", &["--version"]),
            "ld.lld is missing: install it (on Debian `apt-get install lld`)"
        );
    }
    flags.extend(["-Clink-arg=-fuse-ld=lld", "-Clink-arg=-Wl,--icf=all"].map(str::to_owned));
    Ok(flags)
}

/// Returns what rustc prints for `--print` and these words, as a path.
fn printed(words: &[&str]) -> anyhow::Result<PathBuf> {
    let rustc = std::env::var_os("RUSTC").unwrap_or_else(|| "rustc".into());
    let output = Command::new(rustc).arg("--print").args(words).output();
    let output = output.context("rustc does not start")?;
    ensure!(
        output.status.success(),
        "rustc --print {}: {}",
        words.join(" "),
        String::from_utf8_lossy(&output.stderr)
    );
    let text = String::from_utf8(output.stdout)?;
    Ok(PathBuf::from(text.trim()))
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
    fn equal_functions_are_folded_by_the_linker() {
        let folder = std::env::temp_dir().join(format!("xtask-fold-{}", std::process::id()));
        fs::create_dir_all(&folder).unwrap();
        let source = folder.join("main.rs");
        let code = "#[inline(never)] fn a(x: usize) -> usize { x * 3 + 1 }\n\
                    #[inline(never)] fn b(x: usize) -> usize { x * 3 + 1 }\n\
                    fn main() { let n = std::env::args().count(); \
                    assert_eq!((a as *const (), a(n)), (b as *const (), b(n))); }";
        fs::write(&source, code).unwrap();
        let program = folder.join("main");
        let mut rustc = Command::new("rustc");
        // The compiler itself folds functions at higher levels.
        let plain = ["-Copt-level=1", "-Clinker=gcc"];
        rustc.args(plain).args(fold().unwrap());
        let built = rustc.arg(&source).arg("-o").arg(&program).status().unwrap();
        assert!(built.success());
        assert!(Command::new(&program).status().unwrap().success());
        fs::remove_dir_all(&folder).unwrap();
    }

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
