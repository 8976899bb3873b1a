//! Packages of Debian, of RPM, and as a tarball, all with the same files.

use std::{
    fmt::Write as _,
    fs,
    os::unix::fs::PermissionsExt as _,
    path::{Path, PathBuf},
    process::Command,
};

use anyhow::{Context as _, ensure};

use super::{sysroot::Machine, tree::PackageFiles, units};
use crate::{shell::run as must, workspace::Workspace};

const SUMMARY: &str = "gateway between ROS 1, ROS 2 and OPC UA PubSub";
const DESCRIPTION: [&str; 2] = [
    "Carries topics, services and actions of ROS 1 and ROS 2 robots into an OPC UA PubSub space and \
     back, and shows their values and calls in an OPC UA server.",
    "Contains the bridges, the server, components with skills, discovery servers, the semantic MES \
     and the tool ua-space. The hosts need no ROS installation.",
];
pub(crate) const MAINTAINER: &str = "The authors of the UA bridge <maintainers@example.org>";

/// A package to be written.
pub(crate) struct DebianPackage<'a> {
    pub(crate) workspace: &'a Workspace,
    pub(crate) machine: Machine,
    /// The version, such as `0.1.0+202601020304.1a2b3c4d5e6f`.
    pub(crate) version: String,
    /// The time of the commit in seconds.
    pub(crate) time: String,
    pub(crate) tree: &'a PackageFiles,
}

impl DebianPackage<'_> {
    /// Writes the package of Debian and returns its path.
    ///
    /// # Errors
    /// Returns an error if dpkg-deb is missing or fails.
    pub(crate) fn deb(&self, folder: &Path) -> anyhow::Result<PathBuf> {
        let root = self.staged(folder, "deb")?;
        let control = root.join("DEBIAN");
        fs::create_dir_all(&control)?;
        let write = |name: &str, text: &str, mode: u32| -> anyhow::Result<()> {
            let path = control.join(name);
            fs::write(&path, text).with_context(|| path.display().to_string())?;
            fs::set_permissions(&path, fs::Permissions::from_mode(mode))?;
            Ok(())
        };
        write("control", &self.control(), 0o644)?;
        let configuration: Vec<String> = self
            .tree
            .configuration()
            .map(|path| format!("/{path}\n"))
            .collect();
        write("conffiles", &configuration.concat(), 0o644)?;
        write("md5sums", &self.sums(&root)?, 0o644)?;
        for script in ["postinst", "prerm", "postrm"] {
            let path = self.workspace.root.join("packages/debian").join(script);
            let text = fs::read_to_string(&path).with_context(|| path.display().to_string())?;
            write(script, &text.replace("@UNITS@", &units::names()), 0o755)?;
        }
        let path = folder.join(format!(
            "ua-bridge_{}-1_{}.deb",
            self.version, self.machine.debian
        ));
        let mut build = Command::new("dpkg-deb");
        build
            .args(["-Zxz", "--root-owner-group", "--build"])
            .arg(&root)
            .arg(&path)
            .env("SOURCE_DATE_EPOCH", &self.time);
        must(&mut build).context("dpkg-deb is in the package dpkg")?;
        fs::remove_dir_all(&root)?;
        Ok(path)
    }

    fn control(&self) -> String {
        let mut control = format!(
            "Package: ua-bridge\nVersion: {}-1\nArchitecture: {}\nMaintainer: {MAINTAINER}\n\
             Installed-Size: {}\nDepends: libc6 (>= 2.31), libgcc-s1, adduser\nSection: net\n\
             Priority: optional\nDescription: {SUMMARY}\n",
            self.version,
            self.machine.debian,
            self.tree.size().div_ceil(1024),
        );
        // Writing to a string does not fail.
        let paragraphs = DESCRIPTION.map(|paragraph| {
            let lines: Vec<String> = wrapped(paragraph, 78)
                .iter()
                .map(|line| format!(" {line}\n"))
                .collect();
            lines.concat()
        });
        let _written = write!(control, "{}", paragraphs.join(" .\n"));
        control
    }

    /// Returns the MD5 sums of all files except the configuration, as dpkg expects them.
    fn sums(&self, root: &Path) -> anyhow::Result<String> {
        let files = self.tree.files().filter(|path| !path.starts_with("etc/"));
        let files = files.filter(|path| !root.join(path).is_symlink());
        let mut command = Command::new("md5sum");
        command.current_dir(root).args(files);
        let output = command.output().context("md5sum does not start")?;
        ensure!(
            output.status.success(),
            "md5sum ended with {}",
            output.status
        );
        Ok(String::from_utf8(output.stdout)?)
    }

    /// Writes the folder that a container is built from, and returns its path.
    ///
    /// # Errors
    /// Returns an error if the package of Debian cannot be written.
    pub(crate) fn container(&self, folder: &Path) -> anyhow::Result<PathBuf> {
        let package = self.deb(folder)?;
        let context = folder.join("container");
        fs::create_dir_all(&context).with_context(|| context.display().to_string())?;
        let file = self.workspace.root.join("packages/Containerfile");
        for (from, to) in [(&package, "ua-bridge.deb"), (&file, "Containerfile")] {
            fs::copy(from, context.join(to)).with_context(|| from.display().to_string())?;
        }
        Ok(context)
    }

    /// Writes the tarball and returns its path.
    ///
    /// # Errors
    /// Returns an error if tar fails.
    pub(crate) fn tar(&self, folder: &Path) -> anyhow::Result<PathBuf> {
        let name = format!("ua-bridge-{}-{}", self.version, self.machine.rpm);
        let root = self.staged(folder, "tar")?;
        let path = folder.join(format!("{name}.tar.gz"));
        let mut tar = Command::new("tar");
        tar.args(["--sort=name", "--owner=0", "--group=0", "--numeric-owner"])
            .arg(format!("--mtime=@{}", self.time))
            // Links keep their targets.
            .arg(format!("--transform=flags=r;s,^\\.,{name},"))
            .arg("-C")
            .arg(&root)
            .args(["-czf"])
            .arg(&path)
            .arg(".");
        must(&mut tar)?;
        fs::remove_dir_all(&root)?;
        Ok(path)
    }

    /// Writes the package of RPM and returns its path.
    ///
    /// # Errors
    /// Returns an error if rpmbuild is missing or fails.
    pub(crate) fn rpm(&self, folder: &Path) -> anyhow::Result<PathBuf> {
        let root = self.staged(folder, "rpm")?;
        let spec = folder.join("ua-bridge.spec");
        fs::write(&spec, self.spec(&root)?)?;
        let work = folder.join("rpm-work");
        let mut build = Command::new("rpmbuild");
        build
            .args(["-bb", "--quiet", "--target", self.machine.rpm])
            .args(["--define", &format!("_topdir {}", work.display())])
            .args(["--define", &format!("_rpmdir {}", folder.display())])
            .args([
                "--define",
                "_build_name_fmt %%{NAME}-%%{VERSION}-%%{RELEASE}.%%{ARCH}.rpm",
            ])
            .args(["--define", "_buildhost localhost"])
            .args(["--define", "_binary_payload w19.zstdio"])
            .arg(&spec)
            .env("SOURCE_DATE_EPOCH", &self.time);
        must(&mut build).context("rpmbuild is in the package rpm")?;
        for path in [&root, &work] {
            fs::remove_dir_all(path)?;
        }
        fs::remove_file(&spec)?;
        Ok(folder.join(format!(
            "ua-bridge-{}-1.{}.rpm",
            self.version, self.machine.rpm
        )))
    }

    fn spec(&self, root: &Path) -> anyhow::Result<String> {
        let path = self.workspace.root.join("packages/rpm.spec");
        let spec = fs::read_to_string(&path).with_context(|| path.display().to_string())?;
        let mut files = String::new();
        for (folder, mode) in self.tree.folders() {
            let owner = if mode == 0o750 {
                "root, ua-bridge"
            } else {
                "root, root"
            };
            // Writing to a string does not fail.
            let _written = writeln!(files, "%dir %attr({mode:04o}, {owner}) /{folder}");
        }
        for file in self.tree.files() {
            let kind = if file.starts_with("etc/") {
                "%config(noreplace) "
            } else {
                ""
            };
            let _written = writeln!(files, "{kind}/{file}");
        }
        Ok(spec
            .replace("@VERSION@", &self.version)
            .replace("@SUMMARY@", SUMMARY)
            .replace("@DESCRIPTION@", &DESCRIPTION.join("\n\n"))
            .replace("@UNITS@", &units::names())
            .replace("@ROOT@", &root.display().to_string())
            .replace("@FILES@", &files))
    }

    /// Writes the files below a folder for the format.
    fn staged(&self, folder: &Path, format: &str) -> anyhow::Result<PathBuf> {
        let root = folder.join(format!("root-{format}"));
        self.tree.write(&root)?;
        fs::set_permissions(&root, fs::Permissions::from_mode(0o755))?;
        Ok(root)
    }
}

/// Breaks a paragraph into lines.
fn wrapped(text: &str, width: usize) -> Vec<String> {
    let mut lines: Vec<String> = Vec::new();
    for word in text.split_whitespace() {
        match lines.last_mut() {
            Some(line) if line.len() + word.len() < width => {
                line.push(' ');
                line.push_str(word);
            }
            _ => lines.push(word.to_owned()),
        }
    }
    lines
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_of_a_description_end_before_the_width() {
        assert_eq!(wrapped("one two  three", 8), ["one two", "three"]);
        assert_eq!(wrapped("", 8), [""; 0]);
    }
}
