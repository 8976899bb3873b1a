//! A second host: a network of its own, joined to the cell's by a wire that can lose and delay.

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

use wire::Orders;
pub use wire::Wire;

use crate::{Cell, Started, UaSide, UadpSocket};

/// The cell's end of the wire.
pub const HERE: &str = "10.77.0.1";
/// The other host's end.
pub const THERE: &str = "10.77.0.2";
/// What both ends are called.
pub const WIRE: &str = "wire0";

/// The other host. Programs are started on it by [`Started::on`].
pub struct Host {
    namespace: Namespace,
    orders: Arc<Orders>,
    wire: Option<JoinHandle<()>>,
}

impl Cell {
    /// A second host at the end of a wire of MTU 1500 that carries multicast. The cell keeps its loopback beside it.
    ///
    /// # Panics
    /// When the network cannot be made.
    #[must_use]
    pub fn host(&self, wire: Wire) -> Host {
        let (here, middle, there) = (Namespace::current(), Namespace::fresh(), Namespace::fresh());
        here.join("near", &middle, HERE);
        there.join("far", &middle, THERE);
        there.ip(&["route", "add", "224.0.0.0/4", "dev", WIRE]);
        for end in ["near", "far"] {
            middle.ip(&["link", "set", end, "mtu", "1500", "up"]);
        }
        let orders = Arc::new(Orders::default());
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

/// A second host at the end of a plain cable. Pulling it takes the interfaces of both ends away.
pub struct Cable {
    here: Namespace,
    there: Namespace,
}

impl Cell {
    /// A second host, with no cable to it yet.
    #[must_use]
    pub fn cable(&self) -> Cable {
        Cable {
            here: Namespace::current(),
            there: Namespace::fresh(),
        }
    }
}

impl Cable {
    /// Makes [`WIRE`] here, with that address, and its end there, with [`THERE`].
    ///
    /// # Panics
    /// When it is there already.
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
    /// When there is none.
    pub fn pull(&self) {
        self.here.ip(&["link", "delete", WIRE]);
    }

    /// Takes the link down at its far end: nothing crosses, and the addresses stay.
    ///
    /// # Panics
    /// When there is no cable.
    pub fn cut(&self) {
        self.there.ip(&["link", "set", WIRE, "down"]);
    }

    /// Ends [`cut`](Self::cut).
    ///
    /// # Panics
    /// When there is no cable.
    pub fn mend(&self) {
        self.there.ip(&["link", "set", WIRE, "up"]);
    }

    /// The other host's namespace, for programs that are to run in it.
    pub(crate) fn path(&self) -> PathBuf {
        self.there.path()
    }

    /// Has multicast without a named interface leave the cell by the cable, and no longer by loopback.
    ///
    /// # Panics
    /// When there is no cable.
    pub fn route(&self) {
        let group = "224.0.0.0/4";
        self.here.ip(&["route", "replace", group, "dev", WIRE]);
    }

    /// A member of the UADP group on the other host, for as long as the cable lies.
    ///
    /// # Panics
    /// When there is no cable.
    #[must_use]
    pub fn ua_side(&self) -> UaSide {
        std::thread::scope(|scope| {
            let joined = scope.spawn(|| {
                setns(&self.there.0, CloneFlags::CLONE_NEWNET).unwrap();
                UaSide::on(UadpSocket::join_on(THERE.parse().unwrap()))
            });
            joined.join().unwrap()
        })
    }
}

impl Host {
    /// Cuts the wire: every frame is lost until it is mended.
    pub fn cut(&self) {
        self.orders.cut.store(true, Ordering::Relaxed);
    }

    /// Ends [`cut`](Self::cut).
    pub fn mend(&self) {
        self.orders.cut.store(false, Ordering::Relaxed);
    }

    /// The namespace, for programs that are to run in it.
    pub(crate) fn path(&self) -> PathBuf {
        self.namespace.path()
    }

    /// The Fast DDS peer on this host, in domain 2, not started yet.
    #[must_use]
    pub fn fastdds_started(&self, cell: &Cell, args: &[&str]) -> Started {
        cell.fastdds_started(args)
            .args(["--interface", THERE])
            .on(self)
    }

    /// The Cyclone DDS peer in C on this host, in domain 2, not started yet.
    #[must_use]
    pub fn cyclone_c_started(&self, cell: &Cell, args: &[&str]) -> Started {
        self.cyclone_c_with(cell, "", args)
    }

    /// The same with more elements of XML in the section `Discovery` of its configuration.
    #[must_use]
    pub fn cyclone_c_with(&self, cell: &Cell, discovery: &str, args: &[&str]) -> Started {
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

/// A network namespace, which lives as long as this.
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

    /// Does something in it, on a thread of its own.
    pub(crate) fn within<T: Send>(&self, what: impl FnOnce() -> T + Send) -> T {
        std::thread::scope(|scope| {
            let done = scope.spawn(|| {
                setns(&self.0, CloneFlags::CLONE_NEWNET).unwrap();
                what()
            });
            done.join().unwrap()
        })
    }

    /// Lays a wire from here to `other`, where its end is called `name`.
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
