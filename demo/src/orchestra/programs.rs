//! The child processes: started, listened to, and ended in order.

use std::fs::{self, File};
use std::io;
use std::path::{Path, PathBuf};
use std::process::{ExitStatus, Stdio};
use std::time::Duration;

use rustix::process::{Pid, Signal, kill_process};
use tokio::io::{AsyncBufReadExt as _, BufReader};
use tokio::process::{Child, ChildStdout, Command};
use tokio::sync::{mpsc, watch};
use tokio::task::JoinSet;
use tokio::time::timeout;

use super::failure::Failure;
use crate::clock::wall_nanos;
use crate::event::Stamped;

/// What comes from the children.
#[derive(Debug)]
pub(crate) enum Report {
    Told(Stamped),
    /// A line that is no event.
    Garbled {
        name: &'static str,
        line: String,
    },
    Ended {
        name: &'static str,
        status: ExitStatus,
    },
}

/// One program to start.
pub(crate) struct Program {
    pub(crate) name: &'static str,
    pub(crate) path: PathBuf,
    pub(crate) arguments: Vec<String>,
    pub(crate) environment: Vec<(&'static str, String)>,
    /// It tells events on its standard output; else that goes into its log.
    pub(crate) tells: bool,
    /// When it is to end.
    pub(crate) stage: Stage,
}

/// The order in which programs end: each needs those of the later stages to say goodbye.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Stage {
    Robots,
    Bridges,
    Master,
}

/// The running programs. Dropping it kills what still runs.
pub(crate) struct Programs {
    directory: PathBuf,
    reports: mpsc::Sender<Report>,
    end: watch::Sender<Option<Stage>>,
    running: Vec<(Stage, JoinSet<()>)>,
    listeners: JoinSet<()>,
}

impl Programs {
    /// Makes the directory for logs and the receiver of the reports. When nobody takes reports, children wait with
    /// telling them.
    pub(crate) fn prepare() -> io::Result<(Self, mpsc::Receiver<Report>)> {
        // Process ids come again; logs of a run that failed stay.
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

    /// Where logs are, and room for what the programs need.
    pub(crate) fn directory(&self) -> &Path {
        &self.directory
    }

    pub(crate) fn start(&mut self, program: Program) -> Result<(), Failure> {
        let log =
            File::create(self.log(program.name)).map_err(Failure::io("cannot write a log"))?;
        let stdout = if program.tells {
            Stdio::piped()
        } else {
            log.try_clone()
                .map_err(Failure::io("cannot write a log"))?
                .into()
        };
        let mut command = Command::new(&program.path);
        for (key, _) in std::env::vars_os() {
            // The demo's ROS and OPC UA sides are its own, whatever this terminal is set up for.
            if key
                .to_str()
                .is_some_and(|key| key.starts_with("ROS_") || key.starts_with("UA_"))
            {
                command.env_remove(key);
            }
        }
        let mut child = command
            .args(&program.arguments)
            .envs(program.environment)
            .stdin(Stdio::null())
            .stdout(stdout)
            .stderr(log)
            // Ctrl-C is for the demo, which then ends them in order.
            .process_group(0)
            .kill_on_drop(true)
            .spawn()
            .map_err(Failure::io("cannot start a program"))?;
        let mut tasks = JoinSet::new();
        if let Some(stdout) = child.stdout.take() {
            self.listeners
                .spawn(listen(program.name, stdout, self.reports.clone()));
        }
        let end = self.end.subscribe();
        tasks.spawn(attend(
            program.name,
            child,
            (program.stage, end),
            self.reports.clone(),
        ));
        self.running.push((program.stage, tasks));
        Ok(())
    }

    /// Ends all programs, in order; each has [`GRACE`] from SIGTERM to SIGKILL.
    pub(crate) async fn end(&mut self) {
        for stage in [Stage::Robots, Stage::Bridges, Stage::Master] {
            self.end.send_replace(Some(stage));
            for (_, tasks) in self.running.iter_mut().filter(|(of, _)| *of == stage) {
                while tasks.join_next().await.is_some() {}
            }
        }
        self.running.clear();
        // What a child has started may still hold its standard output open.
        self.listeners.shutdown().await;
    }

    /// The last lines of a program's log.
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

/// Passes on what a child tells, until it closes its standard output.
async fn listen(name: &'static str, stdout: ChildStdout, reports: mpsc::Sender<Report>) {
    let mut lines = BufReader::new(stdout).lines();
    while let Ok(Some(line)) = lines.next_line().await {
        let report = match serde_json::from_str(&line) {
            Ok(stamped) => Report::Told(stamped),
            Err(_) => Report::Garbled { name, line },
        };
        if reports.send(report).await.is_err() {
            return;
        }
    }
}

/// Waits for a child to end, by itself or because its stage has come.
async fn attend(
    name: &'static str,
    mut child: Child,
    (stage, mut end): (Stage, watch::Receiver<Option<Stage>>),
    reports: mpsc::Sender<Report>,
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
                // When nobody listens, nobody wonders.
                reports.send(Report::Ended { name, status }).await.ok();
            }
        }
        _ = ended => {
            terminate(&mut child);
            if timeout(GRACE, child.wait()).await.is_err() && child.kill().await.is_err() {
                // It ended just now.
            }
        }
    }
}

/// SIGTERM to a child that has not been waited for, so that its process id is its own.
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

/// How long a program may take to end.
const GRACE: Duration = Duration::from_secs(3);
const LAST_LINES: usize = 15;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::event::{Event, MasterEvent};

    fn shell(name: &'static str, script: &str, tells: bool) -> Program {
        Program {
            name,
            path: "/bin/sh".into(),
            arguments: vec!["-c".to_owned(), script.to_owned()],
            environment: Vec::new(),
            tells,
            stage: Stage::Robots,
        }
    }

    async fn next(reports: &mut mpsc::Receiver<Report>) -> Report {
        timeout(Duration::from_secs(10), reports.recv())
            .await
            .unwrap()
            .unwrap()
    }

    #[tokio::test]
    async fn children_are_heard_missed_and_ended() {
        let (mut programs, mut reports) = Programs::prepare().unwrap();
        let line = r#"{"at_ns":7,"event":{"master":"listening","uri":"http://127.0.0.1:1/"}}"#;
        programs
            .start(shell(
                "teller",
                &format!("echo '{line}'; echo ?; sleep 60"),
                true,
            ))
            .unwrap();
        let event = Event::Master(MasterEvent::Listening {
            uri: "http://127.0.0.1:1/".to_owned(),
        });
        let expected = Stamped { at_ns: 7, event };
        assert!(matches!(next(&mut reports).await, Report::Told(told) if told == expected));
        let garbled = next(&mut reports).await;
        assert!(matches!(garbled, Report::Garbled { name: "teller", line } if line == "?"));

        programs
            .start(shell("mortal", "echo out; echo last >&2; exit 3", false))
            .unwrap();
        let ended = next(&mut reports).await;
        assert!(
            matches!(ended, Report::Ended { name: "mortal", status } if status.code() == Some(3))
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
            Report::Garbled {
                name: "stubborn",
                ..
            }
        ));
        timeout(GRACE * 3, programs.end())
            .await
            .expect("all are ended, one way or another");
        programs.clean_up().unwrap();
        assert!(!programs.directory().exists());
    }
}
