//! Child processes: starts them, reads their events, and stops them in order.

use std::fs::{self, File};
use std::io;
use std::path::{Path, PathBuf};
use std::process::{ExitStatus, Stdio};
use std::sync::Arc;
use std::time::Duration;

use rustix::process::{Pid, Signal, kill_process};
use tokio::io::{AsyncBufReadExt as _, AsyncWriteExt as _, BufReader};
use tokio::process::{Child, ChildStdin, ChildStdout, Command};
use tokio::sync::{Notify, mpsc, watch};
use tokio::task::JoinSet;
use tokio::time::timeout;

use super::failure::DemoFailure;
use crate::clock::wall_nanos;
use crate::event::Stamped;

/// A report of a child process.
#[derive(Debug)]
pub(crate) enum ChildReport {
    Told(Stamped),
    /// A line that is not an event.
    Garbled {
        name: &'static str,
        line: String,
    },
    Ended {
        name: &'static str,
        status: ExitStatus,
    },
    /// The process was killed on request; the time is the time of the signal.
    Killed {
        name: &'static str,
        at_ns: i64,
    },
}

/// A program to start.
pub(crate) struct ProgramStart {
    pub(crate) name: &'static str,
    pub(crate) path: PathBuf,
    pub(crate) arguments: Vec<String>,
    pub(crate) environment: Vec<(&'static str, String)>,
    /// Whether it prints events on its standard output; otherwise the output goes to its log.
    pub(crate) tells: bool,
    /// Whether its standard input is used; otherwise it is closed.
    pub(crate) hears: bool,
    /// The stage in which it ends.
    pub(crate) stage: Stage,
}

impl ProgramStart {
    /// Returns a program that prints no events and reads no input.
    pub(crate) fn new(
        (name, path): (&'static str, PathBuf),
        arguments: &[&str],
        environment: &[(&'static str, &str)],
        stage: Stage,
    ) -> Self {
        let environment = environment.iter();
        Self {
            name,
            path,
            arguments: arguments.iter().map(|&text| text.to_owned()).collect(),
            environment: environment
                .map(|&(key, value)| (key, value.to_owned()))
                .collect(),
            tells: false,
            hears: false,
            stage,
        }
    }
}

/// The order in which programs end. Each program needs the programs of later stages for its
/// shutdown.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Stage {
    Robots,
    Components,
    Bridges,
    Master,
}

struct Running {
    name: &'static str,
    stage: Stage,
    tasks: JoinSet<()>,
    kill: Arc<Notify>,
    stdin: Option<ChildStdin>,
}

/// The running programs. Dropping this value kills them.
pub(crate) struct RunningPrograms {
    directory: PathBuf,
    reports: mpsc::Sender<ChildReport>,
    end: watch::Sender<Option<Stage>>,
    running: Vec<Running>,
    listeners: JoinSet<()>,
}

impl RunningPrograms {
    /// Creates the directory for logs, and the receiver of the reports. If reports are not
    /// received, the children block on sending them.
    pub(crate) fn prepare() -> io::Result<(Self, mpsc::Receiver<ChildReport>)> {
        // Process identifiers are reused, and the logs of failed runs are kept.
        let name = format!(
            "ua-bridge-demo-{}-{}",
            wall_nanos() / 1_000_000,
            std::process::id()
        );
        let directory = std::env::temp_dir().join(name);
        fs::create_dir(&directory)?;
        let (reports, receiver) = mpsc::channel(1024);
        let end = watch::Sender::new(None);
        Ok((
            Self {
                directory,
                reports,
                end,
                running: Vec::new(),
                listeners: JoinSet::new(),
            },
            receiver,
        ))
    }

    /// Returns the directory for logs and for the input files of the programs.
    pub(crate) fn directory(&self) -> &Path {
        &self.directory
    }

    /// Starts a program. Returns the time of the start, in nanoseconds since 1970.
    pub(crate) fn start(&mut self, program: ProgramStart) -> Result<i64, DemoFailure> {
        let log =
            File::create(self.log(program.name)).map_err(DemoFailure::io("cannot write a log"))?;
        let stdout = if program.tells {
            Stdio::piped()
        } else {
            log.try_clone()
                .map_err(DemoFailure::io("cannot write a log"))?
                .into()
        };
        let stdin = if program.hears {
            Stdio::piped()
        } else {
            Stdio::null()
        };
        let started = wall_nanos();
        let mut child = command(&program.path)
            .args(&program.arguments)
            .envs(program.environment)
            .stdin(stdin)
            .stdout(stdout)
            .stderr(log)
            .spawn()
            .map_err(DemoFailure::io("cannot start a program"))?;
        let mut tasks = JoinSet::new();
        if let Some(stdout) = child.stdout.take() {
            self.listeners
                .spawn(listen(program.name, stdout, self.reports.clone()));
        }
        let kill = Arc::new(Notify::new());
        let stdin = child.stdin.take();
        let end = self.end.subscribe();
        tasks.spawn(attend(
            program.name,
            child,
            (program.stage, end, Arc::clone(&kill)),
            self.reports.clone(),
        ));
        self.running.push(Running {
            name: program.name,
            stage: program.stage,
            tasks,
            kill,
            stdin,
        });
        Ok(started)
    }

    /// Starts a program that prints no events and reads no input.
    pub(crate) fn launch(
        &mut self,
        name: &'static str,
        path: PathBuf,
        arguments: &[&str],
        stage: Stage,
    ) -> Result<(), DemoFailure> {
        let program = ProgramStart::new((name, path), arguments, &[], stage);
        self.start(program).map(drop)
    }

    /// Sends SIGKILL to a program, as in a power failure. [`ChildReport::Killed`] contains the
    /// time. Does nothing if the program has ended.
    pub(crate) fn kill(&self, name: &str) {
        for running in self.running.iter().filter(|running| running.name == name) {
            running.kill.notify_one();
        }
    }

    /// Writes a line to the standard input of a program, if it is used.
    pub(crate) async fn tell(&mut self, name: &str, line: &str) -> io::Result<()> {
        let mut running = self.running.iter_mut();
        let stdin = running
            .find(|running| running.name == name)
            .and_then(|running| running.stdin.as_mut())
            .ok_or(io::ErrorKind::NotFound)?;
        stdin.write_all(line.as_bytes()).await?;
        stdin.write_all(b"\n").await?;
        stdin.flush().await
    }

    /// Stops all programs in order. Each has [`GRACE`] from SIGTERM to SIGKILL.
    pub(crate) async fn end(&mut self) {
        for stage in [
            Stage::Robots,
            Stage::Components,
            Stage::Bridges,
            Stage::Master,
        ] {
            self.end.send_replace(Some(stage));
            let of_stage = self.running.iter_mut().filter(|of| of.stage == stage);
            for running in of_stage {
                while running.tasks.join_next().await.is_some() {}
            }
        }
        self.running.clear();
        // Processes started by a child may still hold its standard output open.
        self.listeners.shutdown().await;
    }

    /// Returns the last lines of a program's log.
    pub(crate) fn last_lines(&self, name: &str) -> String {
        let log = fs::read(self.log(name)).unwrap_or_default();
        let text = String::from_utf8_lossy(&log);
        let lines: Vec<&str> = text.lines().collect();
        lines
            .get(lines.len().saturating_sub(LAST_LINES)..)
            .unwrap_or_default()
            .join("\n")
    }

    /// Removes the logs.
    pub(crate) fn clean_up(&self) -> io::Result<()> {
        fs::remove_dir_all(&self.directory)
    }

    fn log(&self, name: &str) -> PathBuf {
        self.directory.join(format!("{name}.log"))
    }
}

/// Returns the command of a program that is independent of the terminal's signals and of its
/// environment variables for ROS and OPC UA.
pub(crate) fn command(path: &Path) -> Command {
    let mut command = Command::new(path);
    for (key, _) in std::env::vars_os() {
        if key
            .to_str()
            .is_some_and(|key| key.starts_with("ROS_") || key.starts_with("UA_"))
        {
            command.env_remove(key);
        }
    }
    // Ctrl-C is handled by the demo, which stops the programs in order.
    command.process_group(0).kill_on_drop(true);
    command
}

/// Forwards the events of a child until it closes its standard output.
async fn listen(name: &'static str, stdout: ChildStdout, reports: mpsc::Sender<ChildReport>) {
    let mut lines = BufReader::new(stdout).lines();
    while let Ok(Some(line)) = lines.next_line().await {
        let report = match serde_json::from_str(&line) {
            Ok(stamped) => ChildReport::Told(stamped),
            Err(_) => ChildReport::Garbled { name, line },
        };
        if reports.send(report).await.is_err() {
            return;
        }
    }
}

/// Waits for the end of a child, by itself or in its stage.
async fn attend(
    name: &'static str,
    mut child: Child,
    (stage, mut end, kill): (Stage, watch::Receiver<Option<Stage>>, Arc<Notify>),
    reports: mpsc::Sender<ChildReport>,
) {
    let ended = async {
        // The sender lives as long as this task.
        end.wait_for(|reached| reached.is_some_and(|reached| stage <= reached))
            .await
            .is_ok()
    };
    tokio::select! {
        status = child.wait() => {
            if let Ok(status) = status {
                // If the receiver is closed, the scenario has ended.
                reports.send(ChildReport::Ended { name, status }).await.ok();
            }
        }
        () = kill.notified() => {
            let at_ns = wall_nanos();
            if child.kill().await.is_ok() {
                reports.send(ChildReport::Killed { name, at_ns }).await.ok();
            }
        }
        _ = ended => {
            terminate(&mut child);
            if timeout(GRACE, child.wait()).await.is_err() && child.kill().await.is_err() {
                // The child has ended in between.
            }
        }
    }
}

/// Sends SIGTERM to a child that has not been waited for, so its process identifier has not been
/// reused.
fn terminate(child: &mut Child) {
    let pid = child
        .id()
        .and_then(|id| i32::try_from(id).ok())
        .and_then(Pid::from_raw);
    if let Some(pid) = pid
        && let Err(error) = kill_process(pid, Signal::TERM)
    {
        tracing::debug!(%error, "a child has ended already");
    }
}

/// Time that a program has to end.
const GRACE: Duration = Duration::from_secs(3);
const LAST_LINES: usize = 15;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::event::{ChildEvent, MasterEvent};

    fn shell(name: &'static str, script: &str, tells: bool) -> ProgramStart {
        ProgramStart {
            name,
            path: "/bin/sh".into(),
            arguments: vec!["-c".to_owned(), script.to_owned()],
            environment: Vec::new(),
            tells,
            hears: false,
            stage: Stage::Robots,
        }
    }

    async fn next(reports: &mut mpsc::Receiver<ChildReport>) -> ChildReport {
        timeout(Duration::from_secs(10), reports.recv())
            .await
            .unwrap()
            .unwrap()
    }

    #[tokio::test]
    async fn children_are_heard_missed_and_ended() {
        let (mut programs, mut reports) = RunningPrograms::prepare().unwrap();
        let line = r#"{"at_ns":7,"event":{"master":"listening","uri":"http://127.0.0.1:1/"}}"#;
        programs
            .start(shell(
                "teller",
                &format!("echo '{line}'; echo ?; sleep 60"),
                true,
            ))
            .unwrap();
        let event = ChildEvent::Master(MasterEvent::Listening {
            uri: "http://127.0.0.1:1/".to_owned(),
        });
        let expected = Stamped { at_ns: 7, event };
        assert!(matches!(next(&mut reports).await, ChildReport::Told(told) if told == expected));
        let garbled = next(&mut reports).await;
        assert!(matches!(garbled, ChildReport::Garbled { name: "teller", line } if line == "?"));

        programs
            .start(shell("mortal", "echo out; echo last >&2; exit 3", false))
            .unwrap();
        let ended = next(&mut reports).await;
        assert!(
            matches!(ended, ChildReport::Ended { name: "mortal", status } if status.code() == Some(3))
        );
        assert_eq!(programs.last_lines("mortal"), "out\nlast");

        programs
            .start(shell(
                "stubborn",
                "trap '' TERM; echo '\"up\"'; exec sleep 60",
                true,
            ))
            .unwrap();
        assert!(matches!(
            next(&mut reports).await,
            ChildReport::Garbled {
                name: "stubborn",
                ..
            }
        ));
        programs
            .start(ProgramStart {
                hears: true,
                ..shell(
                    "listener",
                    "read line; echo \"\\\"$line\\\"\"; sleep 60",
                    true,
                )
            })
            .unwrap();
        programs.tell("listener", "grasp").await.unwrap();
        let heard = next(&mut reports).await;
        assert!(
            matches!(heard, ChildReport::Garbled { name: "listener", line } if line == "\"grasp\"")
        );
        programs.kill("listener");
        let killed = next(&mut reports).await;
        assert!(matches!(killed, ChildReport::Killed { name: "listener", at_ns } if at_ns > 0));

        timeout(GRACE * 3, programs.end())
            .await
            .expect("all are ended, one way or another");
        programs.clean_up().unwrap();
        assert!(!programs.directory().exists());
    }
}
