//! `cargo xtask dist`: builds the shipped programs.

mod completion;
mod manual;
mod notices;
mod package;
mod pages;
mod sysroot;
mod tree;
mod units;

use std::{
    fs,
    path::{Path, PathBuf},
    process::Command,
};

use anyhow::{Context as _, ensure};

use self::{
    package::{DebianPackage, MAINTAINER},
    pages::ShippedSources,
    sysroot::Machine,
    tree::PackageFiles,
};
use crate::{
    help::{Help, output},
    links,
    patches::Patched,
    shell::{CommandOutcome, run as must, step},
    workspace::{SHIPPED, Workspace},
};

/// The shipped programs, named like their packages. All other programs are links to the last.
const PROGRAMS: [&str; 3] = ["bridge-ros1", "bridge-ros2", links::TARGET];

/// Builds the programs without optimisation into `target/debug`, and an example of `ua-component`
/// into `target/debug/examples`.
pub(crate) fn build(
    workspace: &Workspace,
    example: Option<&str>,
) -> anyhow::Result<CommandOutcome> {
    let patched = Patched::prepare(workspace)?;
    step("building the programs (some minutes the first time)");
    let mut build = patched.cargo(workspace, &["build", "--locked", "--bins"]);
    for package in PROGRAMS {
        build.args(["--package", package]);
    }
    must(&mut build)?;
    links::make(&workspace.target.join("debug"))?;
    if let Some(name) = example {
        let example = [
            "build",
            "--locked",
            "--package",
            "ua-component",
            "--example",
            name,
        ];
        must(&mut patched.cargo(workspace, &example))?;
    }
    Ok(CommandOutcome::WELL)
}

/// Builds the programs with optimisation and puts them into `target/dist`, as packages if the
/// arguments name formats.
///
/// # Errors
/// Returns an error if a program cannot be built, or a package cannot be written.
pub(crate) fn run(workspace: &Workspace, arguments: &[&str]) -> anyhow::Result<CommandOutcome> {
    let Some(wanted) = DistArguments::parse(arguments) else {
        eprintln!("xtask: dist takes {USAGE}, not `{}`", arguments.join(" "));
        return Ok(CommandOutcome::USAGE);
    };
    if wanted.formats.is_empty() {
        return programs(workspace);
    }
    let patched = Patched::prepare(workspace)?;
    let commit = Commit::read(workspace)?;
    let program = match &wanted.program {
        Some(program) => program.clone(),
        None => packaged(workspace, &patched, (wanted.machine, &commit))?,
    };
    let tree = tree(workspace, &patched, (wanted.machine, &commit), &program)?;
    let folder = workspace.target.join("dist");
    fs::create_dir_all(&folder).with_context(|| folder.display().to_string())?;
    let package = DebianPackage {
        workspace,
        machine: wanted.machine,
        version: commit.version(),
        time: commit.seconds,
        tree: &tree,
    };
    for format in wanted.formats {
        let path = match format {
            Format::Deb => package.deb(&folder)?,
            Format::Rpm => package.rpm(&folder)?,
            Format::Tar => package.tar(&folder)?,
            Format::Container => package.container(&folder)?,
        };
        println!("{}", path.display());
    }
    println!("installed: {:.1} MB", tree.size() as f64 / 1e6);
    Ok(CommandOutcome::WELL)
}

const USAGE: &str =
    "--deb, --rpm, --tar, --container, --machine amd64, arm64 or armhf, and --program FILE";

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Format {
    Deb,
    Rpm,
    Tar,
    Container,
}

/// The command line.
#[derive(Debug, PartialEq, Eq)]
struct DistArguments {
    formats: Vec<Format>,
    machine: Machine,
    /// An `ua-bridge` that was built elsewhere.
    program: Option<PathBuf>,
}

impl DistArguments {
    fn parse(arguments: &[&str]) -> Option<Self> {
        let mut wanted = Self {
            formats: Vec::new(),
            machine: Machine::host()?,
            program: None,
        };
        let mut rest = arguments.iter();
        while let Some(argument) = rest.next() {
            match *argument {
                "--deb" => wanted.formats.push(Format::Deb),
                "--rpm" => wanted.formats.push(Format::Rpm),
                "--tar" => wanted.formats.push(Format::Tar),
                "--container" => wanted.formats.push(Format::Container),
                "--machine" => wanted.machine = Machine::named(rest.next()?)?,
                "--program" => wanted.program = Some(PathBuf::from(rest.next()?)),
                _ => return None,
            }
        }
        let is_complete = !wanted.formats.is_empty() || arguments.is_empty();
        is_complete.then_some(wanted)
    }
}

/// The commit of the sources.
struct Commit {
    /// The abbreviated hash, with `.dirty` if the sources have other changes.
    hash: String,
    /// The time in seconds, and in the formats `202601020304`, `2026-01-02`, of ISO 8601 and of
    /// mail.
    seconds: String,
    minutes: String,
    date: String,
    iso: String,
    mail: String,
}

impl Commit {
    fn read(workspace: &Workspace) -> anyhow::Result<Self> {
        let git = |arguments: &[&str]| -> anyhow::Result<String> {
            let mut command = Command::new("git");
            command.current_dir(&workspace.root).env("TZ", "UTC0");
            let output = command.args(arguments).output();
            let output = output.context("git does not start")?;
            ensure!(
                output.status.success(),
                "git: {}",
                String::from_utf8_lossy(&output.stderr)
            );
            Ok(String::from_utf8(output.stdout)?.trim().to_owned())
        };
        let time = |format: &str| {
            let date = format!("--date=format-local:{format}");
            git(&["log", "-1", "--format=%cd", &date])
        };
        let hash = git(&["rev-parse", "--short=12", "HEAD"])?;
        let changes = git(&["status", "--porcelain", "--untracked-files=no"])?;
        Ok(Self {
            hash: match changes.is_empty() {
                true => hash,
                false => format!("{hash}.dirty"),
            },
            seconds: git(&["log", "-1", "--format=%ct"])?,
            minutes: time("%Y%m%d%H%M")?,
            date: time("%Y-%m-%d")?,
            iso: time("%Y-%m-%dT%H:%M:%SZ")?,
            mail: time("%a, %d %b %Y %H:%M:%S +0000")?,
        })
    }

    /// Returns the version of a package. Packages of later commits are newer.
    fn version(&self) -> String {
        let version = env!("CARGO_PKG_VERSION");
        format!("{version}+{}.{}", self.minutes, self.hash)
    }
}

/// Builds the program that acts as all programs, for packages, and returns its path.
fn packaged(
    workspace: &Workspace,
    patched: &Patched,
    (machine, commit): (Machine, &Commit),
) -> anyhow::Result<PathBuf> {
    step("building the program of the packages (long the first time)");
    let mut build = patched.cargo(
        workspace,
        &["build", "--profile", SHIPPED, "--locked", "--bins"],
    );
    let features = format!("{}/vendored", links::TARGET);
    build.args(["--package", links::TARGET, "--features", &features]);
    build.env("UA_COMMIT", &commit.hash);
    machine.configure(workspace, &mut build)?;
    must(&mut build)?;
    let folder = workspace.target.join(machine.triple).join(SHIPPED);
    let built = folder.join(links::TARGET);
    let listed = workspace
        .target
        .join(format!("{}-{}", links::TARGET, machine.debian));
    let crates = notices::crates(workspace, machine)?;
    let list = listed.with_extension("crates");
    fs::write(&list, notices::audit(&crates)?).with_context(|| list.display().to_string())?;
    let mut objcopy = Command::new(machine.tool("objcopy"));
    objcopy
        .arg("--strip-all")
        .arg(format!("--add-section=.dep-v0={}", list.display()))
        .arg("--set-section-flags=.dep-v0=noload,readonly")
        .args([&built, &listed]);
    must(&mut objcopy)?;
    fs::remove_file(&list).with_context(|| list.display().to_string())?;
    Ok(listed)
}

/// Collects the files of a package.
fn tree(
    workspace: &Workspace,
    patched: &Patched,
    (machine, commit): (Machine, &Commit),
    program: &Path,
) -> anyhow::Result<PackageFiles> {
    let mut tree = PackageFiles::default();
    let read = |path: &Path| fs::read(path).with_context(|| path.display().to_string());
    let text = |path: &str| {
        let path = workspace.root.join(path);
        fs::read_to_string(&path).with_context(|| path.display().to_string())
    };
    tree.program(format!("usr/bin/{}", links::TARGET), read(program)?);
    for name in links::BRIDGES.into_iter().chain(links::NAMES) {
        tree.link(format!("usr/bin/{name}"), links::TARGET);
    }
    pages(workspace, (machine, commit), program, &mut tree)?;
    for (name, unit) in units::all(&text("packages/systemd/program.service")?) {
        tree.file(format!("usr/lib/systemd/system/{name}"), unit);
    }
    for name in ["environment", "cell.yaml"] {
        tree.file(
            format!("etc/ua-bridge/{name}"),
            text(&format!("packages/etc/{name}"))?,
        );
    }
    tree.folder("etc/ua-bridge/components", 0o755);
    tree.folder("etc/ua-bridge/keys", 0o750);
    let sources = shipped(&workspace.root, pages::repository(workspace)?)?;
    for (source, to) in sources.files() {
        let path = workspace.root.join(source);
        let contents = read(&path)?;
        let is_page = source.extension().is_some_and(|end| end == "md");
        let page = is_page.then(|| str::from_utf8(&contents).ok());
        let page = page.flatten().and_then(|text| sources.page(source, text));
        match page {
            Some(page) => tree.file(to, page),
            None if is_script(source) => tree.program(to, contents),
            None => tree.file(to, contents),
        }
    }
    documents(workspace, patched, (machine, commit), &mut tree)?;
    Ok(tree)
}

/// Returns the files of the sources that a package has.
fn shipped(root: &Path, repository: Option<String>) -> anyhow::Result<ShippedSources> {
    let mut sources = ShippedSources::new(repository);
    for (from, to) in FILES {
        sources.add(from, to);
    }
    let ros = ROS_FOLDERS.map(|folder| {
        let to = format!("usr/share/ua-bridge/ros/{folder}/");
        (format!("ros/{folder}"), to)
    });
    let documents = DOCUMENTS.map(|(from, to)| (from.to_owned(), format!("{DOC}/{to}")));
    for (from, to) in ros.into_iter().chain(documents) {
        for path in files(&root.join(&from))? {
            let name = path.file_name().unwrap_or_default().to_string_lossy();
            sources.add(Path::new(&from).join(&*name), format!("{to}{name}"));
        }
    }
    Ok(sources)
}

fn is_script(source: &Path) -> bool {
    let folder = source.parent().and_then(Path::file_name);
    source.starts_with("ros") && folder.is_some_and(|folder| folder == "scripts")
}

const DOC: &str = "usr/share/doc/ua-bridge";
/// Files with places of their own in a package.
const FILES: [(&str, &str); 2] = [
    ("mappings/schema.json", "usr/share/ua-bridge/schema.json"),
    (
        "docs/wireshark/uadp.lua",
        "usr/share/ua-bridge/wireshark/uadp.lua",
    ),
];
/// Folders of the ROS packages below `ros/`.
const ROS_FOLDERS: [&str; 7] = [
    "ua_bridge",
    "ua_bridge/launch",
    "ua_bridge/scripts",
    "ua_msgs",
    "ua_msgs/action",
    "ua_msgs/msg",
    "ua_msgs/srv",
];
/// Folders with pages and examples, and their places below the documents of a package.
const DOCUMENTS: [(&str, &str); 8] = [
    ("docs", ""),
    ("docs/reference", "reference/"),
    ("docs/decisions", "decisions/"),
    ("docs/images", "images/"),
    ("packages/examples", "examples/"),
    ("packages/examples/robots", "examples/robots/"),
    ("mappings", "examples/mappings/"),
    ("examples/plant", "examples/plant/"),
];

/// Returns the files of a folder with text for users, without folders below.
fn files(folder: &Path) -> anyhow::Result<Vec<PathBuf>> {
    let entries = fs::read_dir(folder).with_context(|| folder.display().to_string())?;
    let paths = entries.map(|entry| entry.map(|entry| entry.path()));
    let mut paths: Vec<PathBuf> = paths.collect::<Result<_, _>>()?;
    paths.retain(|path| {
        let name = path.file_name().unwrap_or_default();
        path.is_file() && name != "Cargo.toml" && name != "schema.json"
    });
    paths.sort();
    Ok(paths)
}

/// Returns a folder with programs that have the help texts of the packaged program: links to it, or
/// the programs of this machine if the packaged program does not run here.
fn runnable(workspace: &Workspace, machine: Machine, program: &Path) -> anyhow::Result<PathBuf> {
    if !machine.is_host() {
        build(workspace, None)?;
        return Ok(workspace.target.join("debug"));
    }
    let folder = workspace.target.join(format!("names-{}", machine.debian));
    fs::create_dir_all(&folder).with_context(|| folder.display().to_string())?;
    let target = folder.join(links::TARGET);
    fs::copy(program, &target).with_context(|| program.display().to_string())?;
    links::make_all(&folder)?;
    let [bridge, _] = links::BRIDGES;
    ensure!(
        output(&folder, &[bridge, "--version"])?.starts_with(bridge),
        "{} does not act as the bridges: give an `ua-bridge`",
        program.display()
    );
    Ok(folder)
}

/// Adds manual pages and completions.
fn pages(
    workspace: &Workspace,
    (machine, commit): (Machine, &Commit),
    program: &Path,
    tree: &mut PackageFiles,
) -> anyhow::Result<()> {
    let folder = runnable(workspace, machine, program)?;
    let all = Help::all(&folder)?;
    let version = env!("CARGO_PKG_VERSION");
    for help in &all {
        let page = manual::page(help, version, &commit.date);
        let path = format!("usr/share/man/man1/{}.1", help.words.join("-"));
        tree.compressed(&path, page.as_bytes())?;
    }
    tree.compressed(
        &format!("usr/share/man/man1/{}.1", links::TARGET),
        manual::overview(version, &commit.date).as_bytes(),
    )?;
    for name in links::BRIDGES.into_iter().chain(links::NAMES) {
        let own: Vec<&Help> = all
            .iter()
            .filter(|help| help.words.first().is_some_and(|first| first == name))
            .collect();
        let mut scripts = completion::scripts(name, &own);
        // ua-space knows the names of the running space.
        if name == "ua-space" {
            let shell = |shell| output(&folder, &[name, "completion", shell]);
            scripts.bash = shell("bash")?;
            scripts.zsh = format!("#compdef {name}\n{}_ua_space \"$@\"\n", shell("zsh")?);
            scripts.fish = shell("fish")?;
        }
        tree.file(
            format!("usr/share/bash-completion/completions/{name}"),
            scripts.bash,
        );
        tree.file(
            format!("usr/share/zsh/vendor-completions/_{name}"),
            scripts.zsh,
        );
        tree.file(
            format!("usr/share/fish/vendor_completions.d/{name}.fish"),
            scripts.fish,
        );
    }
    match machine.is_host() {
        true => fs::remove_dir_all(&folder).with_context(|| folder.display().to_string()),
        false => Ok(()),
    }
}

/// Adds licences, the bill of materials, patches and changes.
fn documents(
    workspace: &Workspace,
    patched: &Patched,
    (machine, commit): (Machine, &Commit),
    tree: &mut PackageFiles,
) -> anyhow::Result<()> {
    let text = |path: &str| {
        let path = workspace.root.join(path);
        fs::read_to_string(&path).with_context(|| path.display().to_string())
    };
    let crates = notices::crates(workspace, machine)?;
    let names: Vec<String> = patched
        .sources()
        .iter()
        .map(|source| source.name().to_owned())
        .collect();
    let notices = notices::licences(&crates, &names)?;
    tree.compressed(&format!("{DOC}/THIRD-PARTY"), notices.as_bytes())?;
    let bill = notices::bill(
        &crates,
        &text("Cargo.lock")?,
        &names,
        (&commit.version(), &commit.iso),
    );
    let bill = serde_json::to_vec_pretty(&bill)?;
    tree.compressed(&format!("{DOC}/sbom.cdx.json"), &bill)?;
    let mut tar = Command::new("tar");
    tar.args(["--sort=name", "--owner=0", "--group=0", "--numeric-owner"])
        .arg(format!("--mtime=@{}", commit.seconds))
        .args(["-cf", "-", "patches"])
        .current_dir(&workspace.root);
    let archive = tar.output().context("tar does not start")?;
    ensure!(
        archive.status.success(),
        "tar ended with {}",
        archive.status
    );
    tree.compressed(&format!("{DOC}/patches.tar"), &archive.stdout)?;
    tree.file(
        format!("{DOC}/copyright"),
        text("packages/debian/copyright")?,
    );
    tree.compressed(
        &format!("{DOC}/changelog"),
        text("CHANGELOG.md")?.as_bytes(),
    )?;
    let debian = format!(
        "ua-bridge ({}-1) unstable; urgency=medium\n\n  * Package of commit {}.\n\n -- {MAINTAINER}  {}\n",
        commit.version(),
        commit.hash,
        commit.mail,
    );
    tree.compressed(&format!("{DOC}/changelog.Debian"), debian.as_bytes())?;
    tree.file(
        "usr/share/lintian/overrides/ua-bridge",
        text("packages/debian/lintian-overrides")?,
    );
    Ok(())
}

/// Builds the programs as separate files, for this machine.
fn programs(workspace: &Workspace) -> anyhow::Result<CommandOutcome> {
    let patched = Patched::prepare(workspace)?;
    step("building the programs with optimisation (some minutes the first time)");
    let mut build = patched.cargo(
        workspace,
        &["build", "--profile", SHIPPED, "--locked", "--bins"],
    );
    for package in PROGRAMS {
        build.args(["--package", package]);
    }
    must(&mut build)?;
    let folder = workspace.target.join("dist");
    fs::create_dir_all(&folder).with_context(|| folder.display().to_string())?;
    for program in PROGRAMS {
        let target = folder.join(program);
        fs::copy(workspace.target.join(SHIPPED).join(program), &target)
            .with_context(|| target.display().to_string())?;
        println!("{}", target.display());
    }
    links::make(&folder)?;
    for link in links::paths(&folder) {
        println!("{} -> {}", link.display(), links::TARGET);
    }
    Ok(CommandOutcome::WELL)
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;
    use crate::markdown::{joined, links};

    /// All links of the packaged pages lead to files of the package.
    #[test]
    fn packaged_pages_link_to_packaged_files() {
        let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
        let sources = shipped(&root, None).unwrap();
        let packaged: BTreeSet<&Path> = sources.files().map(|(_, to)| Path::new(to)).collect();
        let has = |target: &Path| packaged.iter().any(|file| file.starts_with(target));
        let (mut broken, mut checked) = (Vec::new(), 0);
        for (source, to) in sources.files() {
            if source.extension().is_none_or(|end| end != "md") {
                continue;
            }
            let text = fs::read_to_string(root.join(source)).unwrap();
            let page = sources.page(source, &text).unwrap();
            let folder = Path::new(to).parent().unwrap();
            for link in links(&page).filter(|link| !link.contains("://")) {
                let (path, _) = link.split_once('#').unwrap_or((link, ""));
                checked += 1;
                if !path.is_empty() && !has(&joined(folder, path)) {
                    broken.push(format!("{to}: {link}"));
                }
            }
        }
        assert!(broken.is_empty(), "{broken:#?}");
        assert!(checked > 100, "{checked} links");
    }
}
