//! A second host: a separate network, joined to the cell's network by a wire that can lose and
//! delay frames.

mod wire;

use std::{
    fs::File,
    os::fd::AsRawFd,
    path::PathBuf,
    process::Command,
    sync::{Arc, atomic::Ordering},
    thread::JoinHandle,
};

use nix::sched::{CloneFlags, setns, unshare};

pub use wire::WireEffect;
use wire::WireOrders;

use crate::{Cell, StartedChild, UaSide, UadpSocket};

/// The address of the cell's end of the wire.
pub const HERE: &str = "10.77.0.1";
/// The address of the other host's end.
pub const THERE: &str = "10.77.0.2";
/// The interface name of both ends.
pub const WIRE: &str = "wire0";

/// The other host. [`StartedChild::on`] starts programs on it.
pub struct Host {
    namespace: Namespace,
    orders: Arc<WireOrders>,
    wire: Option<JoinHandle<()>>,
}

impl Cell {
    /// Creates a second host at the end of a wire with an MTU of 1500 that carries multicast. The
    /// cell keeps its loopback.
    ///
    /// # Panics
    /// Panics if the network cannot be created.
    #[must_use]
    pub fn host(&self, wire: WireEffect) -> Host {
        let (here, middle, there) = (Namespace::current(), Namespace::fresh(), Namespace::fresh());
        here.join("near", &middle, HERE);
        there.join("far", &middle, THERE);
        there.ip(&["route", "add", "224.0.0.0/4", "dev", WIRE]);
        for host in [&here, &there] {
            // A segment is not longer than a frame.
            host.ip(&["link", "set", WIRE, "gso_max_segs", "1"]);
        }
        for end in ["near", "far"] {
            middle.ip(&["link", "set", end, "mtu", "1500", "up"]);
        }
        let orders = Arc::new(WireOrders::default());
        let asked = Arc::clone(&orders);
        let wire = std::thread::Builder::new()
            .name("wire".to_owned())
            .spawn(move || {
                setns(&middle.0, CloneFlags::CLONE_NEWNET).unwrap();
                wire.carry(["near", "far"], &asked);
            })
            .unwrap();
        Host {
            namespace: there,
            orders,
            wire: Some(wire),
        }
    }
}

/// A second host at the end of a plain cable. Pulling the cable removes the interfaces of both
/// ends.
pub struct Cable {
    here: Namespace,
    there: Namespace,
}

impl Cell {
    /// Creates a second host without a cable to it.
    #[must_use]
    pub fn cable(&self) -> Cable {
        Cable {
            here: Namespace::current(),
            there: Namespace::fresh(),
        }
    }
}

impl Cable {
    /// Creates [`WIRE`] on this host with `address`, and its end on the other host with [`THERE`].
    ///
    /// # Panics
    /// Panics if the cable is laid already.
    pub fn lay(&self, address: &str) {
        self.here.join("far", &self.there, address);
        let there = format!("{THERE}/24");
        for args in [
            &["link", "set", "far", "name", WIRE][..],
            &["address", "add", &there, "dev", WIRE],
            &["link", "set", WIRE, "multicast", "on", "up"],
        ] {
            self.there.ip(args);
        }
    }

    /// Deletes both ends.
    ///
    /// # Panics
    /// Panics if there is no cable.
    pub fn pull(&self) {
        self.here.ip(&["link", "delete", WIRE]);
    }

    /// Sets the link down at its far end: no frames pass, and the addresses stay.
    ///
    /// # Panics
    /// Panics if there is no cable.
    pub fn cut(&self) {
        self.there.ip(&["link", "set", WIRE, "down"]);
    }

    /// Ends [`cut`](Self::cut).
    ///
    /// # Panics
    /// Panics if there is no cable.
    pub fn mend(&self) {
        self.there.ip(&["link", "set", WIRE, "up"]);
    }

    /// Returns the path of the other host's namespace, for programs that run in it.
    pub(crate) fn path(&self) -> PathBuf {
        self.there.path()
    }

    /// Routes multicast without a named interface through the cable instead of loopback.
    ///
    /// # Panics
    /// Panics if there is no cable.
    pub fn route(&self) {
        let group = "224.0.0.0/4";
        self.here.ip(&["route", "replace", group, "dev", WIRE]);
    }

    /// Creates a member of the UADP group on the other host, which works while the cable lies.
    ///
    /// # Panics
    /// Panics if there is no cable.
    #[must_use]
    pub fn ua_side(&self) -> UaSide {
        UaSide::on(self.socket())
    }

    /// Creates a socket in the UADP group on the other host, which works while the cable lies.
    ///
    /// # Panics
    /// Panics if there is no cable.
    #[must_use]
    pub fn socket(&self) -> UadpSocket {
        self.there
            .within(|| UadpSocket::join_on(THERE.parse().unwrap()))
    }
}

impl Host {
    /// Cuts the wire: every frame is lost until [`mend`](Self::mend).
    pub fn cut(&self) {
        self.orders.cut.store(true, Ordering::Relaxed);
    }

    /// Ends [`cut`](Self::cut).
    pub fn mend(&self) {
        self.orders.cut.store(false, Ordering::Relaxed);
    }

    /// Returns the path of the namespace, for programs that run in it.
    pub(crate) fn path(&self) -> PathBuf {
        self.namespace.path()
    }

    /// Returns the Fast DDS peer on this host, in domain 2, not started yet.
    #[must_use]
    pub fn fastdds_started(&self, cell: &Cell, args: &[&str]) -> StartedChild {
        cell.fastdds_started(args)
            .args(["--interface", THERE])
            .on(self)
    }

    /// Returns the Cyclone DDS peer in C on this host, in domain 2, not started yet.
    #[must_use]
    pub fn cyclone_c_started(&self, cell: &Cell, args: &[&str]) -> StartedChild {
        self.cyclone_c_with(cell, "", args)
    }

    /// Returns the Cyclone DDS peer in C with more XML elements in the section `Discovery` of its
    /// configuration.
    #[must_use]
    pub fn cyclone_c_with(&self, cell: &Cell, discovery: &str, args: &[&str]) -> StartedChild {
        cell.cyclone_c_started(args)
            .env("CYCLONEDDS_URI", crate::peers::cyclone_uri(WIRE, discovery))
            .on(self)
    }
}

impl Drop for Host {
    fn drop(&mut self) {
        self.orders.end.store(true, Ordering::Relaxed);
        if let Some(wire) = self.wire.take()
            && wire.join().is_err()
        {
            eprintln!("the wire between the hosts had failed");
        }
    }
}

/// A network namespace, which exists until this is dropped.
pub(crate) struct Namespace(File);

impl Namespace {
    fn current() -> Self {
        Self(File::open("/proc/thread-self/ns/net").unwrap())
    }

    pub(crate) fn fresh() -> Self {
        let made = std::thread::spawn(|| {
            unshare(CloneFlags::CLONE_NEWNET).unwrap();
            Self::current()
        });
        let made = made.join().unwrap();
        made.ip(&["link", "set", "lo", "multicast", "on", "up"]);
        made
    }

    pub(crate) fn path(&self) -> PathBuf {
        PathBuf::from(format!(
            "/proc/{}/fd/{}",
            std::process::id(),
            self.0.as_raw_fd()
        ))
    }

    /// Runs a function in the namespace, on a separate thread.
    pub(crate) fn within<T: Send>(&self, what: impl FnOnce() -> T + Send) -> T {
        std::thread::scope(|scope| {
            let done = scope.spawn(|| {
                setns(&self.0, CloneFlags::CLONE_NEWNET).unwrap();
                what()
            });
            done.join().unwrap()
        })
    }

    /// Creates a wire from this namespace to `other`, where its end has the name `name`.
    fn join(&self, name: &str, other: &Self, address: &str) {
        self.ip(&["link", "add", WIRE, "type", "veth", "peer", "name", name]);
        let path = other.path();
        self.ip(&["link", "set", name, "netns", &path.to_string_lossy()]);
        self.ip(&["address", "add", &format!("{address}/24"), "dev", WIRE]);
        self.ip(&["link", "set", WIRE, "mtu", "1500", "multicast", "on", "up"]);
    }

    pub(crate) fn ip(&self, args: &[&str]) {
        let output = Command::new("nsenter")
            .arg(format!("--net={}", self.path().display()))
            .args(["--", "ip"])
            .args(args)
            .output()
            .unwrap();
        assert!(
            output.status.success(),
            "ip {}: {}",
            args.join(" "),
            String::from_utf8_lossy(&output.stderr)
        );
    }
}
