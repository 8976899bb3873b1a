//! Notifications of the programs to a service manager.

use std::{io::ErrorKind, os::unix::net::UnixDatagram, time::Duration};

use system_tests::{Cell, Child, StartedChild, program};

const SOON: Duration = Duration::from_secs(60);

/// The socket of a service manager that expects a keep-alive every two seconds.
struct ServiceManager {
    socket: UnixDatagram,
    path: String,
}

impl ServiceManager {
    fn listen(cell: &Cell) -> Self {
        let path = cell.folder().join("notify");
        let socket = UnixDatagram::bind(&path).unwrap();
        socket.set_read_timeout(Some(SOON)).unwrap();
        Self {
            socket,
            path: path.display().to_string(),
        }
    }

    fn start(&self, program: StartedChild) -> Child {
        program
            .env("NOTIFY_SOCKET", &self.path)
            .env("WATCHDOG_USEC", "2000000")
            .start()
    }

    /// Waits for a notification, and skips keep-alives before it.
    fn expect(&self, expected: &str) {
        let mut buffer = [0; 256];
        loop {
            let length = self.socket.recv(&mut buffer).unwrap_or_else(|error| {
                assert_eq!(error.kind(), ErrorKind::WouldBlock);
                panic!("no {expected} within {SOON:?}")
            });
            let text = str::from_utf8(&buffer[..length]).unwrap();
            if text == expected {
                return;
            }
            assert_eq!(text, "WATCHDOG=1", "instead of {expected}");
        }
    }

    /// Runs a program until it is ready and has sent a keep-alive, and ends it.
    fn follows(&self, program: StartedChild) {
        let mut child = self.start(program);
        self.expect("READY=1");
        self.expect("WATCHDOG=1");
        assert!(child.end().success());
        self.expect("STOPPING=1");
    }
}

#[test]
fn a_bridge_and_a_discovery_server_notify_when_they_are_ready_and_when_they_end() {
    let Some(cell) = Cell::with(&[]) else { return };
    let manager = ServiceManager::listen(&cell);
    manager.follows(cell.bridge_ros1_started(&[]));
    manager.follows(cell.bridge_ros2_started(&[]));
    manager.follows(cell.ua_server_started(&[]));
    let endpoint = ["--endpoint", "opc.tcp://127.0.0.1:4841"];
    manager.follows(StartedChild::new("ua-lds", &program("ua-lds")).args(endpoint));
}
