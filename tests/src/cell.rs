//! A separate network for each test.

use std::{
    env, fs,
    marker::PhantomData,
    path::{Path, PathBuf},
    process::Command,
    sync::{
        Mutex, MutexGuard, PoisonError,
        atomic::{AtomicU32, Ordering},
    },
};

use nix::{
    mount::{MntFlags, MsFlags, mount, umount2},
    sched::{CloneFlags, unshare},
};

use crate::mosquitto::{MOSQUITTO, MOSQUITTO_SUB};
use crate::nats::NATS;

/// Third-party software that a test needs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Peer {
    /// rosmaster, rospy and roscpp's `topic_tools`, from Debian or Ubuntu.
    Ros1,
    /// Cyclone DDS and asyncua, in the Python environment that `cargo xtask test` makes.
    Python,
    /// pySHACL, SPARQLWrapper, xmlschema, SpiffWorkflow and lxml, in the same environment. An
    /// environment of an earlier version of the tests may lack them.
    PythonJudges,
    /// Fast DDS from Debian or Ubuntu, in a program that `cargo xtask test` compiles.
    FastDds,
    /// Cyclone DDS from Debian or Ubuntu, in a program that `cargo xtask test` compiles.
    CycloneC,
    /// roscpp from Debian or Ubuntu, in a program that `cargo xtask test` compiles.
    Roscpp,
    /// rclpy over Fast DDS, of each [`Distribution`], in Python environments that `cargo xtask
    /// test` makes.
    Ros2,
    /// node-opcua, which `cargo xtask test` installs from npm.
    NodeOpcua,
    /// node-opcua-pubsub-expander, which `cargo xtask test` installs from npm.
    NodeOpcuaPubSub,
    /// A library that shifts the wall clock of a program, which `cargo xtask test` compiles.
    Clock,
    /// Wireshark's tshark, from Debian or Ubuntu.
    Tshark,
    /// The MQTT broker mosquitto and its command-line clients, from Debian or Ubuntu.
    Mosquitto,
    /// nats-server, which speaks MQTT, from Debian or Ubuntu.
    Nats,
    /// The MQTT clients aiomqtt and paho and the broker amqtt, in a Python environment that `cargo
    /// xtask test` makes.
    MqttPython,
}

/// A distribution of ROS 2 that is available as a peer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Distribution {
    /// Jazzy Jalisco, over Fast DDS 2.14.
    Jazzy,
    /// Kilted Kaiju, over Fast DDS 3.2.
    Kilted,
}

impl Distribution {
    /// All distributions.
    pub const ALL: [Self; 2] = [Self::Jazzy, Self::Kilted];

    /// Returns the folder with the files of a package, such as its definitions.
    #[must_use]
    pub fn share(self, package: &str) -> PathBuf {
        self.prefix().join("share").join(package)
    }

    /// Returns the Python interpreter with rclpy.
    #[must_use]
    pub fn python(self) -> PathBuf {
        self.prefix().join("bin/python")
    }

    fn prefix(self) -> PathBuf {
        compiled(match self {
            Self::Jazzy => "ros2-jazzy",
            Self::Kilted => "ros2-kilted",
        })
    }
}

/// A network namespace with only a loopback interface that carries multicast, and a folder for
/// files.
///
/// Processes have to be started from the thread that made the cell, because the namespace belongs
/// to the thread. Only a single cell exists at a time: peers that start in parallel on a small
/// machine slow each other down.
pub struct Cell {
    folder: PathBuf,
    pub(crate) python: PathBuf,
    not_send: PhantomData<*const ()>,
    _only: MutexGuard<'static, ()>,
}

static ONLY: Mutex<()> = Mutex::new(());

pub(crate) const TSHARK: &str = "/usr/bin/tshark";
pub(crate) const FASTDDS: &str = "fastdds-peer";
pub(crate) const CYCLONE: &str = "cyclone-peer";
pub(crate) const ROSCPP: &str = "roscpp-peer";
pub(crate) const CLOCK: &str = "clock-shift.so";
pub(crate) const NODE_OPCUA: &str = "node-opcua";
/// Programs of pySHACL, SPARQLWrapper and xmlschema beside the Python of the environment.
const PYTHON_JUDGES: [&str; 3] = ["pyshacl", "rqw", "xmlschema-validate"];
pub(crate) const NODE_OPCUA_PUBSUB: &str = "node-opcua-pubsub";
pub(crate) const MQTT_PYTHON: &str = "mqtt/bin/python";

impl Cell {
    /// Puts this thread into a new network, or logs why the test is skipped and returns `None`.
    ///
    /// # Panics
    /// Panics if a peer is missing and `CI=true`, or if this process may not create network
    /// namespaces.
    #[must_use]
    pub fn with(peers: &[Peer]) -> Option<Self> {
        let python = python();
        if let Some(reason) = env::var_os("UA_NO_NETWORK") {
            test_data::skip(&reason.to_string_lossy());
            return None;
        }
        for peer in peers {
            if let Err(reason) = find(*peer, &python) {
                test_data::skip(&reason);
                return None;
            }
        }
        Some(Self::enter(python))
    }

    /// Reports a test that cannot run with the programs as they were built.
    ///
    /// # Panics
    /// Panics if `CI=true`.
    pub fn skip(reason: &str) {
        test_data::skip(reason);
    }

    fn enter(python: PathBuf) -> Self {
        static COUNT: AtomicU32 = AtomicU32::new(0);
        // A test that failed while it held the lock leaves nothing behind that disturbs the next
        // test.
        let only = ONLY.lock().unwrap_or_else(PoisonError::into_inner);
        let parts = CloneFlags::CLONE_NEWNET | CloneFlags::CLONE_NEWNS;
        if let Err(error) = unshare(parts).and_then(|()| own_shared_memory()) {
            panic!(
                "this process may not make a network of its own ({error}): run `cargo xtask test`, \
                 which arranges for that"
            );
        }
        ip(&["link", "set", "lo", "up"]);
        ip(&["link", "set", "lo", "multicast", "on"]);
        ip(&["route", "add", "224.0.0.0/4", "dev", "lo"]);
        let folder = env::temp_dir().join(format!(
            "ua-bridge-test-{}-{}",
            std::process::id(),
            COUNT.fetch_add(1, Ordering::Relaxed)
        ));
        fs::create_dir_all(&folder).unwrap();
        Self {
            folder,
            python,
            not_send: PhantomData,
            _only: only,
        }
    }

    /// Returns the folder of this test, which is removed when the test passes.
    #[must_use]
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// Writes a file into the folder and returns its path.
    ///
    /// # Panics
    /// Panics if the file cannot be written.
    #[must_use]
    pub fn file(&self, name: &str, text: &str) -> PathBuf {
        let path = self.folder.join(name);
        fs::write(&path, text).unwrap();
        path
    }
}

/// A file or folder that programs of a cell see at the path of another one, until this is dropped.
///
/// It is dropped by the thread that made the cell, because the mount belongs to its namespace.
#[derive(Debug)]
pub struct CoveredPath {
    path: PathBuf,
    not_send: PhantomData<*const ()>,
}

impl Cell {
    /// Shows `source`, a file or a folder, to the programs of this cell at `path`, which exists.
    /// Files of the kernel can be covered too, as `/proc/sys/net/core/rmem_max`.
    ///
    /// # Panics
    /// Panics if the path cannot be covered.
    #[must_use]
    pub fn cover(&self, path: &str, source: &Path) -> CoveredPath {
        const NOTHING: Option<&str> = None;
        mount(Some(source), path, NOTHING, MsFlags::MS_BIND, NOTHING)
            .unwrap_or_else(|error| panic!("{path} cannot be covered: {error}"));
        CoveredPath {
            path: path.into(),
            not_send: PhantomData,
        }
    }
}

impl Drop for CoveredPath {
    fn drop(&mut self) {
        if let Err(error) = umount2(&self.path, MntFlags::MNT_DETACH) {
            eprintln!("{} stays covered: {error}", self.path.display());
        }
    }
}

impl Drop for Cell {
    fn drop(&mut self) {
        if std::thread::panicking() {
            eprintln!("its files are kept in {}", self.folder.display());
        } else if let Err(error) = fs::remove_dir_all(&self.folder) {
            eprintln!("{} stays: {error}", self.folder.display());
        }
    }
}

/// Mounts a separate `/dev/shm`. Fast DDS passes samples through files there that are named after
/// its ports, so tests that run in parallel would receive each other's samples.
fn own_shared_memory() -> nix::Result<()> {
    const NOTHING: Option<&str> = None;
    mount(
        NOTHING,
        "/",
        NOTHING,
        MsFlags::MS_REC | MsFlags::MS_PRIVATE,
        NOTHING,
    )?;
    mount(
        NOTHING,
        "/dev/shm",
        Some("tmpfs"),
        MsFlags::empty(),
        NOTHING,
    )
}

fn ip(args: &[&str]) {
    let output = Command::new("ip")
        .args(args)
        .output()
        .unwrap_or_else(|error| panic!("`ip` (package iproute2) does not start: {error}"));
    assert!(
        output.status.success(),
        "ip {}: {}",
        args.join(" "),
        String::from_utf8_lossy(&output.stderr)
    );
}

fn python() -> PathBuf {
    env::var_os("UA_PEERS_PYTHON").map_or_else(
        || Path::new(env!("CARGO_MANIFEST_DIR")).join("../target/peers/venv/bin/python"),
        PathBuf::from,
    )
}

/// Returns the path of a peer that `cargo xtask test` compiles or installs.
pub(crate) fn compiled(name: &str) -> PathBuf {
    env::var_os("UA_PEERS")
        .map_or_else(
            || Path::new(env!("CARGO_MANIFEST_DIR")).join("../target/peers"),
            PathBuf::from,
        )
        .join(name)
}

fn find(peer: Peer, python: &Path) -> Result<(), String> {
    let [fastdds, cyclone, roscpp, clock] = [FASTDDS, CYCLONE, ROSCPP, CLOCK].map(compiled);
    let [jazzy, kilted] = Distribution::ALL.map(Distribution::python);
    let node_opcua = compiled(NODE_OPCUA).join("node_modules/node-opcua-client");
    let [pyshacl, sparqlwrapper, xmlschema] =
        PYTHON_JUDGES.map(|program| python.with_file_name(program));
    let node_opcua_pubsub =
        compiled(NODE_OPCUA_PUBSUB).join("node_modules/node-opcua-pubsub-expander");
    let mqtt_python = compiled(MQTT_PYTHON);
    let needed: &[&Path] = match peer {
        Peer::Ros1 => &[
            Path::new("/usr/bin/rosmaster"),
            Path::new("/usr/bin/rosparam"),
            Path::new("/usr/lib/python3/dist-packages/rospy/__init__.py"),
            Path::new("/usr/lib/python3/dist-packages/sensor_msgs/__init__.py"),
            Path::new("/usr/lib/topic_tools/relay"),
            Path::new("/usr/bin/rosnode"),
            Path::new("/usr/bin/rostopic"),
            Path::new("/usr/lib/rosbag/record"),
        ],
        Peer::Python => &[python],
        Peer::PythonJudges => &[python, &pyshacl, &sparqlwrapper, &xmlschema],
        Peer::FastDds => &[&fastdds],
        Peer::CycloneC => &[&cyclone],
        Peer::Roscpp => &[&roscpp],
        Peer::Clock => &[&clock],
        Peer::Ros2 => &[&jazzy, &kilted],
        Peer::NodeOpcua => &[&node_opcua],
        Peer::NodeOpcuaPubSub => &[&node_opcua_pubsub],
        Peer::Tshark => &[Path::new(TSHARK)],
        Peer::Mosquitto => &[Path::new(MOSQUITTO), Path::new(MOSQUITTO_SUB)],
        Peer::Nats => &[Path::new(NATS)],
        Peer::MqttPython => &[&mqtt_python],
    };
    match needed.iter().find(|path| !path.exists()) {
        None => Ok(()),
        Some(path) => Err(format!(
            "the {peer:?} peer is not on this machine ({} is missing); `cargo xtask test` installs it",
            path.display()
        )),
    }
}
