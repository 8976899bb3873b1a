//! Processes that a test starts, their output, and their end.

use std::{
    fmt,
    io::{BufRead, BufReader, Read, Write},
    path::Path,
    process::{Command, ExitStatus, Stdio},
    sync::{Arc, Condvar, Mutex},
    thread::JoinHandle,
    time::{Duration, Instant},
};

use nix::{
    sys::signal::{Signal, kill},
    unistd::Pid,
};
use serde_json::Value;

use crate::{Cable, Host, PlantSite};

/// Time between the signal that asks a process to end and SIGKILL. A bridge waits 5 s for pending
/// cancellations; the rest is for a loaded machine.
const GRACE: Duration = Duration::from_secs(10);
/// Lines kept per process. Later lines are read and counted only, so that the process never blocks
/// on its pipe.
const KEPT: usize = 200_000;
/// Lines shown when a test fails.
const SHOWN: usize = 60;

/// A process to start: its program, arguments and environment.
pub struct StartedChild {
    name: String,
    command: Command,
    ends_on: Signal,
    told: bool,
}

impl StartedChild {
    /// Creates a process that runs `program`; `name` is its name in messages of a failing test.
    #[must_use]
    pub fn new(name: &str, program: &Path) -> Self {
        // The kernel ends the process together with the thread that started it, so a killed test
        // leaves no processes behind.
        let mut command = Command::new("setpriv");
        command.args(["--pdeathsig", "KILL", "--"]).arg(program);
        Self {
            name: name.to_owned(),
            command,
            ends_on: Signal::SIGTERM,
            told: false,
        }
    }

    /// Adds arguments.
    #[must_use]
    pub fn args<S: AsRef<std::ffi::OsStr>>(mut self, args: impl IntoIterator<Item = S>) -> Self {
        self.command.args(args);
        self
    }

    /// Sets a variable of the process's environment.
    #[must_use]
    pub fn env(mut self, key: &str, value: impl AsRef<std::ffi::OsStr>) -> Self {
        self.command.env(key, value);
        self
    }

    /// Sets the working folder of the process.
    #[must_use]
    pub fn in_folder(mut self, folder: &Path) -> Self {
        self.command.current_dir(folder);
        self
    }

    /// Sets the signal that ends the process in order, if it is not SIGTERM.
    #[must_use]
    pub fn ends_on(mut self, signal: Signal) -> Self {
        self.ends_on = signal;
        self
    }

    /// Runs the process on `host` instead of the cell's host.
    #[must_use]
    pub fn on(self, host: &Host) -> Self {
        self.in_network(&host.path())
    }

    /// Runs the process at the far end of `cable` instead of on the cell's host.
    #[must_use]
    pub fn beyond(self, cable: &Cable) -> Self {
        self.in_network(&cable.path())
    }

    /// Runs the process at `site` instead of on the cell's host.
    #[must_use]
    pub fn at(self, site: &PlantSite) -> Self {
        self.in_network(&site.path())
    }

    fn in_network(mut self, path: &Path) -> Self {
        // nsenter replaces itself with setpriv, and setpriv with the program: a single process with
        // the same id.
        let mut command = Command::new("nsenter");
        command
            .arg(format!("--net={}", path.display()))
            .arg("--")
            .arg(self.command.get_program())
            .args(self.command.get_args())
            .envs(
                self.command
                    .get_envs()
                    .filter_map(|(key, value)| Some((key, value?))),
            );
        self.command = command;
        self
    }

    /// Gives the process a standard input, for [`Child::tell`].
    #[must_use]
    pub fn told(mut self) -> Self {
        self.told = true;
        self
    }

    /// Starts the process.
    ///
    /// # Panics
    /// Panics if the process cannot be started.
    #[must_use]
    pub fn start(mut self) -> Child {
        self.command
            .stdin(if self.told {
                Stdio::piped()
            } else {
                Stdio::null()
            })
            .stdout(Stdio::piped())
            .stderr(Stdio::piped());
        let mut process = self
            .command
            .spawn()
            .unwrap_or_else(|error| panic!("{} does not start: {error}", self.name));
        let output = Arc::new(Output::default());
        let readers = vec![
            collect(process.stdout.take().unwrap(), Stream::Out, &output),
            collect(process.stderr.take().unwrap(), Stream::Err, &output),
        ];
        Child {
            name: self.name,
            process,
            ends_on: self.ends_on,
            output,
            readers,
        }
    }
}

/// A process of this test. Dropping it ends the process; if the test is failing, the last lines are
/// printed.
pub struct Child {
    name: String,
    process: std::process::Child,
    ends_on: Signal,
    output: Arc<Output>,
    readers: Vec<JoinHandle<()>>,
}

impl Child {
    /// Returns the first line, of both streams, that contains `pattern`, whether printed before or
    /// after the call.
    ///
    /// # Panics
    /// Panics after `deadline`, or if the process ends without such a line.
    pub fn wait_for_line(&mut self, pattern: &str, deadline: Duration) -> String {
        self.wait_for(&format!("a line with `{pattern}`"), deadline, |line| {
            line.text.contains(pattern).then(|| line.text.clone())
        })
    }

    /// Returns the first result of `pick` for the JSON lines of standard output that is not `None`.
    ///
    /// # Panics
    /// Panics as [`Self::wait_for_line`] does.
    pub fn wait_for_json<T>(
        &mut self,
        what: &str,
        deadline: Duration,
        mut pick: impl FnMut(&Value) -> Option<T>,
    ) -> T {
        self.wait_for(what, deadline, |line| {
            line.json().and_then(|value| pick(&value))
        })
    }

    /// Waits until the peer has reported that it is ready.
    ///
    /// # Panics
    /// Panics as [`Self::wait_for_line`] does.
    #[must_use]
    pub fn ready(mut self, deadline: Duration) -> Self {
        self.wait_for_json("it says that it is ready", deadline, |line| {
            line.get("ready").map(drop)
        });
        self
    }

    /// Writes a line to the process and returns its answer: the first JSON line after the present
    /// lines.
    ///
    /// # Panics
    /// Panics as [`Self::wait_for_line`] does.
    pub fn ask(&mut self, line: &str, deadline: Duration) -> Value {
        let before = self.output.lines.lock().unwrap().kept.len();
        self.tell(line);
        self.wait_after(
            before,
            &format!("an answer to `{line}`"),
            deadline,
            OutputLine::json,
        )
    }

    fn wait_for<T>(
        &mut self,
        what: &str,
        deadline: Duration,
        pick: impl FnMut(&OutputLine) -> Option<T>,
    ) -> T {
        self.wait_after(0, what, deadline, pick)
    }

    fn wait_after<T>(
        &mut self,
        mut seen: usize,
        what: &str,
        deadline: Duration,
        mut pick: impl FnMut(&OutputLine) -> Option<T>,
    ) -> T {
        let start = Instant::now();
        loop {
            // Checked before the lines are read, so that the last lines of an ended process are
            // seen.
            let ended = self.process.try_wait().unwrap();
            if ended.is_some() {
                self.join_readers();
            }
            let waited = start.elapsed();
            {
                let lines = self.output.lines.lock().unwrap();
                if let Some(found) = lines.kept[seen..].iter().find_map(&mut pick) {
                    return found;
                }
                seen = lines.kept.len();
                if ended.is_none() && waited < deadline {
                    let rest = (deadline - waited).min(Duration::from_millis(100));
                    drop(self.output.changed.wait_timeout(lines, rest).unwrap());
                    continue;
                }
            }
            match ended {
                Some(status) => panic!("{} ended ({status}) before: {what}", self.name),
                None => panic!("{} within {deadline:?} not so: {what}", self.name),
            }
        }
    }

    /// Writes a line to the process's standard input.
    ///
    /// # Panics
    /// Panics if the process has no standard input, or has closed it.
    pub fn tell(&mut self, line: &str) {
        let input = self.process.stdin.as_mut().unwrap();
        writeln!(input, "{line}").unwrap();
    }

    /// Returns all lines so far, of both streams.
    #[must_use]
    pub fn lines(&self) -> Vec<String> {
        let lines = self.output.lines.lock().unwrap();
        lines.kept.iter().map(|line| line.text.clone()).collect()
    }

    /// Returns the JSON objects printed to standard output so far.
    #[must_use]
    pub fn json_lines(&self) -> Vec<Value> {
        let lines = self.output.lines.lock().unwrap();
        lines.kept.iter().filter_map(OutputLine::json).collect()
    }

    /// Returns the `value`s of the JSON lines so far: the values that a subscriber received.
    #[must_use]
    pub fn values(&self) -> Vec<Value> {
        self.json_lines()
            .iter()
            .filter_map(|line| line.get("value").cloned())
            .collect()
    }

    /// Returns when each JSON object with a value arrived.
    #[must_use]
    pub fn arrivals(&self) -> Vec<Instant> {
        let lines = self.output.lines.lock().unwrap();
        let values = lines.kept.iter().filter(|line| {
            let json = line.json();
            json.is_some_and(|json| json.get("value").is_some())
        });
        values.map(|line| line.at).collect()
    }

    /// Returns when each line that contains `pattern` arrived, of both streams.
    #[must_use]
    pub fn times_of(&self, pattern: &str) -> Vec<Instant> {
        let lines = self.output.lines.lock().unwrap();
        let lines = lines.kept.iter().filter(|line| line.text.contains(pattern));
        lines.map(|line| line.at).collect()
    }

    /// Returns the process id.
    #[must_use]
    pub fn id(&self) -> u32 {
        self.process.id()
    }

    /// Returns whether the process is running.
    #[must_use]
    pub fn runs(&mut self) -> bool {
        self.process.try_wait().unwrap().is_none()
    }

    /// Sends the process a signal.
    ///
    /// # Panics
    /// Panics if the process has ended.
    pub fn signal(&self, signal: Signal) {
        kill(self.pid(), signal).unwrap();
    }

    /// Waits for the end of the process.
    ///
    /// # Panics
    /// Panics after `deadline`.
    pub fn wait_for_end(&mut self, deadline: Duration) -> ExitStatus {
        let name = self.name.clone();
        let status = crate::eventually(&format!("{name} ends"), deadline, || {
            self.process.try_wait().unwrap()
        });
        self.join_readers();
        status
    }

    /// Ends the process with the signal a user would send, and waits for its end.
    ///
    /// # Panics
    /// Panics if the process has not ended after ten seconds.
    pub fn end(&mut self) -> ExitStatus {
        self.signal(self.ends_on);
        self.wait_for_end(GRACE)
    }

    fn pid(&self) -> Pid {
        Pid::from_raw(i32::try_from(self.process.id()).unwrap())
    }

    fn join_readers(&mut self) {
        for reader in self.readers.drain(..) {
            reader.join().unwrap();
        }
    }

    /// Ends the process without a panic, because this also runs while a test is failing.
    fn put_away(&mut self) {
        let Ok(None) = self.process.try_wait() else {
            return;
        };
        if kill(self.pid(), self.ends_on).is_ok() {
            let start = Instant::now();
            while start.elapsed() < GRACE {
                let Ok(None) = self.process.try_wait() else {
                    return;
                };
                std::thread::sleep(Duration::from_millis(5));
            }
        }
        eprintln!("{} did not end when asked to: it is killed", self.name);
        if let Err(error) = self.process.kill().and_then(|()| self.process.wait()) {
            eprintln!("{} could not be killed: {error}", self.name);
        }
    }
}

impl Drop for Child {
    fn drop(&mut self) {
        self.put_away();
        if std::thread::panicking() {
            eprintln!("{self}");
        }
    }
}

impl fmt::Display for Child {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Ok(lines) = self.output.lines.lock() else {
            return writeln!(f, "---- {}: its output is lost", self.name);
        };
        let before = lines.kept.len().saturating_sub(SHOWN);
        writeln!(f, "---- {} printed:", self.name)?;
        if before > 0 {
            writeln!(f, "  ... {before} lines before these")?;
        }
        for line in &lines.kept[before..] {
            writeln!(f, "  {} {}", line.stream.mark(), line.text)?;
        }
        if lines.not_kept > 0 {
            writeln!(f, "  ... {} lines after these", lines.not_kept)?;
        }
        Ok(())
    }
}

#[derive(Clone, Copy, PartialEq)]
enum Stream {
    Out,
    Err,
}

impl Stream {
    const fn mark(self) -> char {
        match self {
            Self::Out => '|',
            Self::Err => '!',
        }
    }
}

struct OutputLine {
    stream: Stream,
    text: String,
    at: Instant,
}

impl OutputLine {
    fn json(&self) -> Option<Value> {
        if self.stream == Stream::Out && self.text.starts_with('{') {
            serde_json::from_str(&self.text).ok()
        } else {
            None
        }
    }
}

#[derive(Default)]
struct Lines {
    kept: Vec<OutputLine>,
    not_kept: usize,
}

#[derive(Default)]
struct Output {
    lines: Mutex<Lines>,
    changed: Condvar,
}

fn collect(
    pipe: impl Read + Send + 'static,
    stream: Stream,
    output: &Arc<Output>,
) -> JoinHandle<()> {
    let output = Arc::clone(output);
    std::thread::spawn(move || {
        let mut pipe = BufReader::new(pipe);
        let mut bytes = Vec::new();
        while pipe
            .read_until(b'\n', &mut bytes)
            .is_ok_and(|read| read > 0)
        {
            let text = String::from_utf8_lossy(&bytes).trim_end().to_owned();
            bytes.clear();
            let mut lines = output.lines.lock().unwrap();
            if lines.kept.len() < KEPT {
                let at = Instant::now();
                lines.kept.push(OutputLine { stream, text, at });
            } else {
                lines.not_kept += 1;
            }
            drop(lines);
            output.changed.notify_all();
        }
    })
}
