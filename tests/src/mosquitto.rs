//! mosquitto, the MQTT broker, and its command-line clients, from Debian or Ubuntu.

use std::fs;
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::Duration;

use nix::sys::signal::Signal;

use crate::{Cell, Child, StartedChild};

pub(crate) const MOSQUITTO: &str = "/usr/sbin/mosquitto";
pub(crate) const MOSQUITTO_SUB: &str = "/usr/bin/mosquitto_sub";

/// The address of a cell's broker.
pub const BROKER: &str = "mqtt://127.0.0.1:1883";

const FOR_EVERYBODY: &str = "listener 1883 127.0.0.1\nallow_anonymous true\n";
const START: Duration = Duration::from_secs(20);

impl Cell {
    /// Starts mosquitto with a listener on port 1883 for everybody, and waits until it is ready.
    #[must_use]
    pub fn mosquitto(&self) -> Child {
        self.mosquitto_with(FOR_EVERYBODY)
    }

    /// Starts mosquitto with this configuration, and waits until it is ready.
    ///
    /// # Panics
    /// Panics if mosquitto does not start.
    #[must_use]
    pub fn mosquitto_with(&self, configuration: &str) -> Child {
        self.mosquitto_named("mosquitto", configuration, &["-v"])
    }

    /// Starts mosquitto like [`Self::mosquitto`], without a log of each message.
    #[must_use]
    pub fn mosquitto_without_log(&self) -> Child {
        self.mosquitto_named("mosquitto", FOR_EVERYBODY, &[])
    }

    fn mosquitto_named(&self, name: &str, configuration: &str, args: &[&str]) -> Child {
        let text = format!("user root\nlog_dest stderr\n{configuration}");
        let file = self.file(&format!("{name}.conf"), &text);
        let mut broker = StartedChild::new("mosquitto", Path::new(MOSQUITTO))
            .args(args)
            .args(["-c", file.to_str().unwrap()])
            .start();
        broker.wait_for_line("running", START);
        broker
    }

    /// Starts two brokers with a bridge between them, which forwards all messages of the space in
    /// both directions.
    #[must_use]
    pub fn bridged(&self) -> Bridged<'_> {
        let mut bridged = Bridged {
            cell: self,
            near: None,
            far: None,
        };
        bridged.start();
        bridged
    }

    /// Starts mosquitto_sub with these arguments. It prints a JSON object for each message, without
    /// its payload.
    #[must_use]
    pub fn mosquitto_sub(&self, args: &[&str]) -> Child {
        let format = r#"{"topic":"%t","retain":%r,"type":"%P","content":"%C"}"#;
        self.mosquitto_sub_as(format, args)
    }

    /// Starts mosquitto_sub, which prints a JSON object with its payload, a text, for each message.
    #[must_use]
    pub fn mosquitto_sub_texts(&self, args: &[&str]) -> Child {
        self.mosquitto_sub_as("%j", args)
    }

    fn mosquitto_sub_as(&self, format: &str, args: &[&str]) -> Child {
        StartedChild::new("mosquitto_sub", Path::new(MOSQUITTO_SUB))
            .args(["-h", "127.0.0.1", "-V", "5", "-F", format])
            .args(args)
            .ends_on(Signal::SIGINT)
            .start()
    }

    /// Returns the topics of the retained messages at the broker that match a filter.
    ///
    /// # Panics
    /// Panics if mosquitto_sub does not start.
    #[must_use]
    pub fn retained(&self, filter: &str) -> Vec<String> {
        let output = Command::new(MOSQUITTO_SUB)
            .args(["-h", "127.0.0.1", "-V", "5", "-F", "%t", "-W", "1"])
            .args(["--retained-only", "-t", filter])
            .stdin(Stdio::null())
            .output()
            .unwrap();
        let text = String::from_utf8_lossy(&output.stdout);
        let mut topics: Vec<String> = text.lines().map(str::to_owned).collect();
        topics.sort();
        topics.dedup();
        topics
    }

    /// Makes an authority, and certificates of it for a broker at 127.0.0.1 and for a client.
    ///
    /// # Panics
    /// Panics if openssl does not start, or refuses an argument.
    pub fn broker_certificates(&self) {
        let folder = self.folder();
        fs::write(
            folder.join("names.ext"),
            "subjectAltName=IP:127.0.0.1,DNS:localhost\n",
        )
        .unwrap();
        let openssl = |args: &str| {
            let output = Command::new("openssl")
                .args(args.split_whitespace())
                .current_dir(folder)
                .output()
                .unwrap();
            let told = String::from_utf8_lossy(&output.stderr);
            assert!(output.status.success(), "openssl {args}: {told}");
        };
        let key = "-newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -nodes";
        openssl(&format!(
            "req -x509 {key} -keyout ca.key -out ca.pem -days 2 -subj /CN=authority"
        ));
        for name in ["broker", "client"] {
            openssl(&format!(
                "req {key} -keyout {name}.key -out {name}.csr -subj /CN={name}"
            ));
            openssl(&format!(
                "x509 -req -in {name}.csr -CA ca.pem -CAkey ca.key -CAcreateserial -days 2 -extfile names.ext -out {name}.pem"
            ));
        }
    }
}

/// Two brokers with a bridge between them.
pub struct Bridged<'c> {
    cell: &'c Cell,
    near: Option<Child>,
    far: Option<Child>,
}

impl Bridged<'_> {
    /// The address of the broker that keeps the bridge.
    pub const FAR: &'static str = "mqtt://127.0.0.1:1884";

    /// Starts the brokers that do not run.
    pub fn start(&mut self) {
        self.near.get_or_insert_with(|| self.cell.mosquitto());
        self.far.get_or_insert_with(|| {
            // The session of the bridge ends with its connection, so nothing is queued for it.
            let text = "listener 1884 127.0.0.1\nallow_anonymous true\n\
                        connection near\naddress 127.0.0.1:1883\ntopic opcua/# both 1\n\
                        bridge_protocol_version mqttv50\ncleansession true\nnotifications false\n\
                        restart_timeout 1\n";
            self.cell.mosquitto_named("far", text, &["-v"])
        });
    }

    /// Kills the broker that keeps the bridge.
    pub fn kill_far(&mut self) {
        if let Some(far) = self.far.take() {
            far.signal(Signal::SIGKILL);
        }
    }

    /// Kills both brokers.
    pub fn kill(&mut self) {
        self.kill_far();
        if let Some(near) = self.near.take() {
            near.signal(Signal::SIGKILL);
        }
    }

    /// Sends the broker that keeps the bridge a signal.
    ///
    /// # Panics
    /// Panics if the broker does not run.
    pub fn signal_far(&self, signal: Signal) {
        self.far.as_ref().unwrap().signal(signal);
    }
}
