//! Notifications to the service manager of the host: readiness, reload, end and watchdog.
//!
//! The protocol is that of systemd (`sd_notify(3)`): a datagram of `KEY=value` lines to the Unix
//! socket that `NOTIFY_SOCKET` names. Without the variable nothing is sent.

use std::env;
use std::ffi::OsString;
use std::io;
use std::os::linux::net::SocketAddrExt as _;
use std::os::unix::ffi::OsStrExt as _;
use std::os::unix::net::{SocketAddr, UnixDatagram};
use std::process;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use tokio::time::{MissedTickBehavior, interval};
use tracing::warn;

use crate::restart;

/// Reports that the program is ready: it has read its configuration, and its sockets are open.
/// Peers may still be missing.
pub fn ready() {
    send("READY=1");
}

/// Reports the end of the program, or a restart in the same process, which ends with another
/// [`ready`].
pub fn ending() {
    if restart::is_requested() {
        send("RELOADING=1")
    } else {
        send("STOPPING=1")
    }
}

/// Sends keep-alives while the runtime makes progress, if the service manager asks for them. A run
/// loop that hangs stops them, because it uses the only thread.
pub fn start_watchdog() {
    watch_over(Vec::new());
}

/// As [`start_watchdog`], while the threads of all pulses make progress, too.
pub fn watch_over(mut pulses: Vec<Pulse>) {
    let variable = |name: &str| env::var_os(name);
    let Some(period) = watchdog_period(variable, process::id()) else {
        return;
    };
    let Some(manager) = manager() else { return };
    tokio::spawn(async move {
        let mut ticks = interval(period);
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            ticks.tick().await;
            // Every pulse is read, so that each counts from this keep-alive on.
            let beating = pulses
                .iter_mut()
                .map(Pulse::has_beaten)
                .filter(|beaten| *beaten)
                .count();
            if beating == pulses.len() {
                // The next keep-alive follows before the deadline.
                let _sent = manager.send("WATCHDOG=1");
            }
        }
    });
}

/// Shows that a thread makes progress.
#[derive(Debug, Clone, Default)]
pub struct Pulse {
    beats: Arc<AtomicU64>,
    /// The number of beats that were read.
    seen: u64,
}

impl Pulse {
    /// Beats while the current runtime makes progress, several times between two keep-alives.
    pub fn start(&self) {
        let variable = |name: &str| env::var_os(name);
        let Some(period) = watchdog_period(variable, process::id()) else {
            return;
        };
        let beats = Arc::clone(&self.beats);
        tokio::spawn(async move {
            let mut ticks = interval(period / 4);
            ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
            loop {
                ticks.tick().await;
                beats.fetch_add(1, Ordering::Relaxed);
            }
        });
    }

    /// Returns whether the thread has made progress since the last call.
    fn has_beaten(&mut self) -> bool {
        let beats = self.beats.load(Ordering::Relaxed);
        let is_new = beats != self.seen;
        self.seen = beats;
        is_new
    }
}

/// Returns the interval of keep-alives: half of the deadline of the service manager.
fn watchdog_period(variable: impl Fn(&str) -> Option<OsString>, process: u32) -> Option<Duration> {
    let number = |name| -> Option<u64> { variable(name)?.to_str()?.parse().ok() };
    // Programs started by a service inherit its variables, and the watchdog expects only one.
    if variable("WATCHDOG_PID").is_some() && number("WATCHDOG_PID") != Some(process.into()) {
        return None;
    }
    let deadline = number("WATCHDOG_USEC").filter(|deadline| *deadline >= 2)?;
    Some(Duration::from_micros(deadline / 2))
}

fn send(state: &str) {
    let Some(manager) = manager() else { return };
    if let Err(error) = manager.send(state) {
        warn!(%error, state, "cannot notify the service manager");
    }
}

/// Returns the service manager of `NOTIFY_SOCKET`.
fn manager() -> Option<ServiceManager> {
    let name = env::var_os("NOTIFY_SOCKET")?;
    match ServiceManager::at(&name) {
        Ok(manager) => Some(manager),
        Err(error) => {
            warn!(%error, socket = %name.display(), "cannot notify the service manager");
            None
        }
    }
}

/// The socket of a service manager.
#[derive(Debug)]
struct ServiceManager {
    socket: UnixDatagram,
    address: SocketAddr,
}

impl ServiceManager {
    /// Opens a socket to the service manager. `name` is a path, or `@` and an abstract name.
    fn at(name: &std::ffi::OsStr) -> io::Result<Self> {
        let address = match name.as_bytes().split_first() {
            Some((b'@', name)) => SocketAddr::from_abstract_name(name)?,
            Some((b'/', _)) => SocketAddr::from_pathname(name)?,
            _ => return Err(io::ErrorKind::InvalidInput.into()),
        };
        let socket = UnixDatagram::unbound()?;
        // A service manager that does not read must not stop the run loop.
        socket.set_nonblocking(true)?;
        Ok(Self { socket, address })
    }

    fn send(&self, state: &str) -> io::Result<()> {
        let sent = self.socket.send_to_addr(state.as_bytes(), &self.address)?;
        if sent == state.len() {
            Ok(())
        } else {
            Err(io::ErrorKind::WriteZero.into())
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn received(socket: &UnixDatagram) -> String {
        let mut buffer = [0; 64];
        let length = socket.recv(&mut buffer).unwrap();
        String::from_utf8_lossy(&buffer[..length]).into_owned()
    }

    #[test]
    fn notifications_reach_a_socket_by_path_and_by_abstract_name() {
        let path = env::temp_dir().join(format!("service-manager-{}", process::id()));
        let _absent = std::fs::remove_file(&path);
        let by_path = UnixDatagram::bind(&path).unwrap();
        let manager = ServiceManager::at(path.as_os_str()).unwrap();
        manager.send("READY=1").unwrap();
        assert_eq!(received(&by_path), "READY=1");
        std::fs::remove_file(&path).unwrap();
        assert!(
            ServiceManager::at(path.as_os_str())
                .unwrap()
                .send("READY=1")
                .is_err()
        );

        let name = format!("ua-service-manager-{}", process::id());
        let address = SocketAddr::from_abstract_name(&name).unwrap();
        let abstract_socket = UnixDatagram::bind_addr(&address).unwrap();
        let manager = ServiceManager::at(format!("@{name}").as_ref()).unwrap();
        manager.send("STOPPING=1").unwrap();
        assert_eq!(received(&abstract_socket), "STOPPING=1");
    }

    #[test]
    fn a_name_that_is_neither_a_path_nor_abstract_is_refused() {
        for name in ["", "run/notify", "vsock:2:1"] {
            assert!(ServiceManager::at(name.as_ref()).is_err(), "{name}");
        }
    }

    #[test]
    fn a_service_manager_that_does_not_read_blocks_nothing() {
        let name = format!("ua-full-service-manager-{}", process::id());
        let address = SocketAddr::from_abstract_name(&name).unwrap();
        let _never_read = UnixDatagram::bind_addr(&address).unwrap();
        let manager = ServiceManager::at(format!("@{name}").as_ref()).unwrap();
        let sent = (0..100_000).map(|_| manager.send("WATCHDOG=1"));
        let refused = sent.into_iter().find_map(Result::err).unwrap();
        assert_eq!(refused.kind(), io::ErrorKind::WouldBlock);
    }

    #[test]
    fn a_thread_that_hangs_has_no_pulse() {
        let mut pulse = Pulse::default();
        assert!(!pulse.has_beaten());
        pulse.beats.fetch_add(3, Ordering::Relaxed);
        assert!(pulse.has_beaten());
        assert!(!pulse.has_beaten());
    }

    #[test]
    fn keep_alives_are_sent_twice_within_the_deadline_of_this_process() {
        let period = |usec: &'static str, pid: Option<&'static str>| {
            let variable = move |name: &str| match name {
                "WATCHDOG_USEC" => Some(usec.into()),
                "WATCHDOG_PID" => pid.map(OsString::from),
                _ => None,
            };
            watchdog_period(variable, 7)
        };
        assert_eq!(period("3000000", None), Some(Duration::from_millis(1500)));
        assert_eq!(period("10", Some("7")), Some(Duration::from_micros(5)));
        assert_eq!(period("10", Some("8")), None);
        assert_eq!(period("10", Some("")), None);
        for usec in ["", "0", "1", "-5", "soon"] {
            assert_eq!(period(usec, None), None, "{usec}");
        }
        assert_eq!(watchdog_period(|_| None, 7), None);
    }
}
