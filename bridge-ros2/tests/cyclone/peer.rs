//! A peer process that speaks JSON lines, and waiting for things to happen.
use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::{Receiver, sync_channel};
use std::time::{Duration, Instant};

use serde_json::Value;

/// A running `ros2_peer.py`; killed when dropped.
pub(crate) struct Peer {
    process: Child,
    lines: Receiver<Value>,
}

impl Peer {
    /// Starts it with arguments separated by spaces.
    pub(crate) fn start(arguments: &str) -> Self {
        let python = std::env::var("CYCLONE_PYTHON").unwrap_or_else(|_| "python3".into());
        let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/peers/ros2_peer.py");
        let mut process = Command::new(python)
            .arg(script)
            .args(arguments.split(' '))
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let output = BufReader::new(process.stdout.take().unwrap());
        let (sender, lines) = sync_channel(100_000);
        std::thread::spawn(move || {
            for line in output.lines().map_while(Result::ok) {
                if sender.send(serde_json::from_str(&line).unwrap()).is_err() {
                    break;
                }
            }
        });
        Self { process, lines }
    }

    /// What it has printed next, if it has.
    pub(crate) fn try_line(&mut self) -> Option<Value> {
        self.lines.try_recv().ok()
    }

    /// What it prints next.
    pub(crate) fn line(&mut self) -> Value {
        self.lines.recv_timeout(Duration::from_secs(20)).unwrap()
    }
}

impl Drop for Peer {
    fn drop(&mut self) {
        self.process.kill().unwrap();
        self.process.wait().unwrap();
    }
}

/// Asks until it is so; fails after 10 s.
pub(crate) fn eventually(what: &str, mut so: impl FnMut() -> bool) {
    let begin = Instant::now();
    while !so() {
        assert!(
            begin.elapsed() < Duration::from_secs(10),
            "{what}: not in 10 s"
        );
        std::thread::park_timeout(Duration::from_millis(5));
    }
}

/// A `std_msgs/String` in little endian CDR.
pub(crate) fn string(text: &str) -> Vec<u8> {
    let mut bytes = vec![0, 1, 0, 0];
    bytes.extend_from_slice(&u32::try_from(text.len() + 1).unwrap().to_le_bytes());
    bytes.extend_from_slice(text.as_bytes());
    bytes.push(0);
    bytes
}
