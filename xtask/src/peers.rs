//! The peers of the system tests, software of other vendors: ROS 1 and the DDS libraries from
//! Debian or Ubuntu, node-opcua from npm, and the rest, including ROS 2, from PyPI.

mod native;

use std::{
    fs,
    path::{Path, PathBuf},
    process::Command,
};

use anyhow::{Context as _, ensure};

use crate::{
    shell::{CommandOutcome, line, run as must, step, succeeds},
    workspace::Workspace,
};

/// Build dependencies of the programs besides Rust.
const APT_BUILD: &[&str] = &["libssl-dev", "pkg-config"];

const APT: &[&str] = &[
    "python3-roslaunch",
    "python3-rosmaster",
    "python3-rospy",
    "python3-rostopic",
    "python3-rosnode",
    "python3-rosservice",
    "python3-rosparam",
    "python3-rosbag",
    "python3-actionlib",
    "python3-std-msgs",
    "python3-geometry-msgs",
    "python3-sensor-msgs",
    "python3-std-srvs",
    "python3-tf2-msgs",
    "python3-trajectory-msgs",
    "topic-tools",
    "tshark",
    // The MQTT broker and its command-line clients.
    "mosquitto",
    "mosquitto-clients",
    // A cluster of brokers that speak MQTT 3.1.1.
    "nats-server",
    "iproute2",
    "valgrind",
    "python3-venv",
    // Creates the keystores for the tests of DDS Security.
    "openssl",
];

/// Packages of the compiled peers.
const APT_COMPILED: &[&str] = &[
    "g++",
    "libfastrtps-dev",
    "libfastcdr-dev",
    "cyclonedds-dev",
    "cyclonedds-tools",
    "libroscpp-dev",
];

/// Python environments of the peers, and the lists of their packages in `tests/peers`.
/// Distributions of ROS 2 have the same packages in different versions.
const VENVS: [(&str, &str); 4] = [
    (PYTHON, "requirements.txt"),
    // Clients and a broker of MQTT.
    ("mqtt", "mqtt.txt"),
    ("ros2-jazzy", "ros2-jazzy.txt"),
    ("ros2-kilted", "ros2-kilted.txt"),
];

const PYTHON: &str = "venv";
/// Folders of the peers from npm in `tests/peers`. The second has another version of node-opcua.
const NODE_PEERS: [&str; 2] = ["node-opcua", "node-opcua-pubsub"];
const LOCK: &str = "package-lock.json";
/// Packages that are installed if npm is missing.
const APT_NODE: &[&str] = &["nodejs", "npm"];

/// The browser of the judge of the page; tests do not need it.
const APT_BROWSER: &[&str] = &["chromium", "chromium-driver"];

/// The judge of the page.
pub(crate) struct PageJudge {
    /// The Python that drives the browser.
    pub(crate) python: PathBuf,
    /// The script with the accessibility rules.
    pub(crate) axe: PathBuf,
    /// The validator of HTML.
    pub(crate) validator: PathBuf,
}

/// Installs the browser that judges the page, and the rules of accessibility and of HTML.
///
/// # Errors
/// Returns an error if a package cannot be installed.
pub(crate) fn browser(workspace: &Workspace) -> anyhow::Result<PageJudge> {
    apt_install(APT_BROWSER)?;
    venv(workspace, "browser", "page.txt")?;
    if !succeeds("npm", &["--version"]) {
        apt_install(APT_NODE)?;
    }
    let folder = workspace.peers().join("axe");
    let (axe, validator) = (folder.join(AXE_SCRIPT), folder.join(VALIDATOR_PROGRAM));
    if !axe.is_file() || !validator.exists() {
        step("installing from npm: axe-core, html-validate");
        let mut npm = Command::new("npm");
        npm.args(["install", "--ignore-scripts", "--no-audit", "--no-fund"])
            .args(["--loglevel=error", "--prefix"])
            .arg(&folder)
            .args([AXE, VALIDATOR]);
        must(&mut npm)?;
    }
    Ok(PageJudge {
        python: python_of(&workspace.peers().join("browser")),
        axe,
        validator,
    })
}

/// Installs MTPPy2.0, which needs a newer Python than the other peers. Returns the Python with it.
///
/// # Errors
/// Returns an error if Python 3.13 is missing, or a package cannot be installed.
pub(crate) fn mtppy2(workspace: &Workspace) -> anyhow::Result<PathBuf> {
    let folder = "mtppy2";
    let python =
        newer_python().context("Python 3.13 is missing, which MTPPy2.0 needs: install it")?;
    venv_of(workspace, &python, (folder, "mtppy2.txt"))?;
    Ok(python_of(&workspace.peers().join(folder)))
}

/// Installs morph-kgc, which needs older versions of its libraries than the other peers. Returns
/// the Python with it.
///
/// # Errors
/// Returns an error if a package cannot be installed.
pub(crate) fn morph_kgc(workspace: &Workspace) -> anyhow::Result<PathBuf> {
    let folder = "morph-kgc";
    venv(workspace, folder, "rml.txt")?;
    Ok(python_of(&workspace.peers().join(folder)))
}

/// Finds Python 3.13 in PATH, or among the versions of pyenv, whose links work only for the chosen
/// version.
fn newer_python() -> Option<PathBuf> {
    const NAME: &str = "python3.13";
    if succeeds(NAME, &["--version"]) {
        return Some(NAME.into());
    }
    let root = std::env::var_os("PYENV_ROOT").map(PathBuf::from);
    let root = root.or_else(|| Some(Path::new(&std::env::var_os("HOME")?).join(".pyenv")))?;
    let versions = fs::read_dir(root.join("versions")).ok()?;
    let mut found = versions.map_while(Result::ok);
    found.find_map(|version| {
        let python = version.path().join("bin").join(NAME);
        python.exists().then_some(python)
    })
}

/// The accessibility rules of the judge of the page.
const AXE: &str = "axe-core@4.14.0";
const AXE_SCRIPT: &str = "node_modules/axe-core/axe.min.js";
/// The validator of HTML. Node.js 18 of Debian 12 runs its versions up to 9.
const VALIDATOR: &str = "html-validate@9.7.1";
const VALIDATOR_PROGRAM: &str = "node_modules/.bin/html-validate";

/// Installs missing peers. Failures are printed; the tests of these peers then skip themselves, or
/// fail with `CI=true`.
pub(crate) fn install(workspace: &Workspace) -> CommandOutcome {
    let mut ended = CommandOutcome::WELL;
    let mut told = |which: &str, result: anyhow::Result<()>| {
        if let Err(error) = result {
            eprintln!("xtask: the peers {which} are not complete: {error:#}");
            ended = CommandOutcome::BADLY;
        }
    };
    told("from apt", apt());
    for (folder, requirements) in VENVS {
        told("from PyPI", venv(workspace, folder, requirements));
    }
    for folder in NODE_PEERS {
        told("from npm", node_peer(workspace, folder));
    }
    told("that are compiled", native::build(workspace));
    ended
}

/// `cargo xtask peers`: installs the peers and prints whether all are installed.
pub(crate) fn run(workspace: &Workspace) -> CommandOutcome {
    let ended = install(workspace);
    if ended == CommandOutcome::WELL {
        step("all peers of the tests are there");
    }
    ended
}

/// `cargo xtask peers --build`: installs the build dependencies of the programs only.
///
/// # Errors
/// Returns an error if a package cannot be installed.
pub(crate) fn for_building() -> anyhow::Result<CommandOutcome> {
    apt_install(APT_BUILD).map(|()| CommandOutcome::WELL)
}

/// Installs packages from npm in the versions of a folder of `tests/peers`, without the install
/// scripts of packages.
fn node_peer(workspace: &Workspace, name: &str) -> anyhow::Result<()> {
    let wanted = workspace.root.join("tests/peers").join(name);
    let folder = workspace.peers().join(name);
    let lock = fs::read_to_string(wanted.join(LOCK))
        .with_context(|| format!("{} cannot be read", wanted.join(LOCK).display()))?;
    let installed = folder.join("installed");
    if fs::read_to_string(&installed).is_ok_and(|there| there == lock) {
        return Ok(());
    }
    if !succeeds("npm", &["--version"]) {
        apt_install(APT_NODE)?;
    }
    step(&format!(
        "installing from npm into {}: {name}",
        folder.display()
    ));
    fs::create_dir_all(&folder).with_context(|| format!("{}", folder.display()))?;
    for file in ["package.json", LOCK] {
        fs::copy(wanted.join(file), folder.join(file))
            .with_context(|| format!("{file} cannot be copied to {}", folder.display()))?;
    }
    let mut npm = Command::new("npm");
    npm.current_dir(&folder).args([
        "ci",
        "--ignore-scripts",
        "--omit=dev",
        "--no-audit",
        "--no-fund",
        "--loglevel=error",
    ]);
    must(&mut npm)?;
    fs::write(&installed, lock).with_context(|| format!("{}", installed.display()))
}

/// Returns the Python with the peers of PyPI, except ROS 2.
pub(crate) fn python(workspace: &Workspace) -> PathBuf {
    python_of(&workspace.peers().join(PYTHON))
}

fn python_of(venv: &Path) -> PathBuf {
    venv.join("bin/python")
}

fn apt() -> anyhow::Result<()> {
    // The lists are installed separately: if a distribution lacks a package of a list, the other
    // lists are still installed.
    [APT_BUILD, APT, APT_COMPILED]
        .into_iter()
        .map(apt_install)
        .fold(Ok(()), Result::and)
}

fn apt_install(packages: &[&'static str]) -> anyhow::Result<()> {
    let missing: Vec<&str> = packages
        .iter()
        .copied()
        .filter(|name| !is_installed(name))
        .collect();
    if missing.is_empty() {
        return Ok(());
    }
    ensure!(
        succeeds("apt-get", &["--version"]),
        "this is no Debian or Ubuntu (no apt-get), and these are missing: {}",
        missing.join(" ")
    );
    step(&format!("installing with apt: {}", missing.join(" ")));
    for arguments in [
        &["update"][..],
        &[&["install", "-y", "--no-install-recommends"][..], &missing].concat(),
    ] {
        let mut command = as_root("env");
        command
            .args(["DEBIAN_FRONTEND=noninteractive", "apt-get"])
            .args(arguments);
        println!("    {}", line(&command));
        must(&mut command)?;
    }
    Ok(())
}

fn is_installed(package: &str) -> bool {
    let output = Command::new("dpkg-query")
        .args(["--show", "--showformat=${db:Status-Status}", package])
        .output();
    output.is_ok_and(|output| output.status.success() && output.stdout == b"installed")
}

fn as_root(program: &str) -> Command {
    let id = Command::new("id").arg("-u").output();
    if id.is_ok_and(|output| output.stdout.trim_ascii() == b"0") {
        return Command::new(program);
    }
    let mut command = Command::new("sudo");
    command.arg(program);
    command
}

fn venv(workspace: &Workspace, folder: &str, requirements: &str) -> anyhow::Result<()> {
    // The system Python is preferred, because ROS 1 is built for it; PATH may have another Python
    // first.
    let system = Path::new("/usr/bin/python3");
    let python3 = if system.exists() {
        system
    } else {
        Path::new("python3")
    };
    venv_of(workspace, python3, (folder, requirements))
}

/// Makes an environment of a Python with the packages of a list, if it is not there.
fn venv_of(
    workspace: &Workspace,
    python3: &Path,
    (folder, requirements): (&str, &str),
) -> anyhow::Result<()> {
    let folder = workspace.peers().join(folder);
    let requirements = workspace.root.join("tests/peers").join(requirements);
    let wanted = fs::read_to_string(&requirements)
        .with_context(|| format!("{} cannot be read", requirements.display()))?;
    let installed = folder.join("requirements.txt");
    if fs::read_to_string(&installed).is_ok_and(|there| there == wanted) {
        return Ok(());
    }
    step(&format!(
        "installing from PyPI into {}: {}",
        folder.display(),
        wanted.split_whitespace().collect::<Vec<_>>().join(" ")
    ));
    must(
        Command::new(python3)
            .args(["-m", "venv", "--clear"])
            .arg(&folder),
    )?;
    must(
        Command::new(python_of(&folder))
            .args([
                "-m",
                "pip",
                "install",
                "--disable-pip-version-check",
                "--requirement",
            ])
            .arg(&requirements),
    )?;
    fs::write(&installed, wanted)
        .with_context(|| format!("{} cannot be written", installed.display()))
}
