//! The resources that a process uses, from `/proc`.

use std::{
    fs,
    time::{Duration, Instant},
};

/// Returns the number of threads of a process.
///
/// # Panics
/// Panics if the process has ended.
#[must_use]
pub fn threads(process: u32) -> u64 {
    status(process, "Threads:")
}

/// Returns the resident memory of a process, in bytes.
///
/// # Panics
/// Panics if the process has ended.
#[must_use]
pub fn resident(process: u32) -> u64 {
    status(process, "VmRSS:") * 1024
}

/// Returns the resident memory that belongs to a process alone, without the pages of its program
/// file, in bytes.
///
/// # Panics
/// Panics if the process has ended.
#[must_use]
pub fn anonymous(process: u32) -> u64 {
    status(process, "RssAnon:") * 1024
}

/// Returns the peak resident memory of a process, in bytes.
///
/// # Panics
/// Panics if the process has ended.
#[must_use]
pub fn peak(process: u32) -> u64 {
    status(process, "VmHWM:") * 1024
}

/// Returns the share of a processor that a process uses within `window`.
///
/// # Panics
/// Panics if the process has ended.
#[must_use]
pub fn cpu_share(process: u32, window: Duration) -> f64 {
    let (start, before) = (Instant::now(), cpu_time(process));
    std::thread::sleep(window);
    (cpu_time(process) - before).as_secs_f64() / start.elapsed().as_secs_f64()
}

fn status(process: u32, field: &str) -> u64 {
    let text = fs::read_to_string(format!("/proc/{process}/status")).unwrap();
    let value = text.lines().find_map(|line| line.strip_prefix(field));
    let number = value.and_then(|value| value.split_whitespace().next());
    number.unwrap().parse().unwrap()
}

fn cpu_time(process: u32) -> Duration {
    // The name may contain spaces. After it, user and system time are the 12th and 13th field, in
    // 1/100 s.
    let text = fs::read_to_string(format!("/proc/{process}/stat")).unwrap();
    let (_, fields) = text.rsplit_once(')').unwrap();
    let fields: Vec<&str> = fields.split_whitespace().collect();
    let ticks: u64 = [fields[11], fields[12]]
        .iter()
        .map(|ticks| ticks.parse::<u64>().unwrap())
        .sum();
    Duration::from_millis(ticks * 10)
}

/// Returns how often the threads of a process went to sleep and were woken, over its living
/// threads.
#[must_use]
pub fn wake_ups(process: u32) -> u64 {
    let threads = fs::read_dir(format!("/proc/{process}/task"));
    let threads = threads.into_iter().flatten().flatten();
    let counts = threads.filter_map(|thread| {
        // A thread may end between the listing and the read.
        let text = fs::read_to_string(thread.path().join("status")).ok()?;
        let line = |line: &str| {
            let count = line.strip_prefix("voluntary_ctxt_switches:")?;
            count.trim().parse::<u64>().ok()
        };
        text.lines().find_map(line)
    });
    counts.sum()
}

/// Counts the system calls of a process with `perf stat`, which hardly slows it down.
pub struct SystemCalls(std::process::Child);

impl SystemCalls {
    /// Starts to count. Returns `None` if `perf` cannot be started, or may not count.
    #[must_use]
    pub fn count(process: u32) -> Option<Self> {
        let mut perf = std::process::Command::new("perf")
            .args(["stat", "-x", ",", "-e", "raw_syscalls:sys_enter", "-p"])
            .arg(process.to_string())
            .stdout(std::process::Stdio::null())
            .stderr(std::process::Stdio::piped())
            .spawn()
            .ok()?;
        // It has no sign that it counts; it ends at once if it may not.
        std::thread::sleep(Duration::from_millis(300));
        matches!(perf.try_wait(), Ok(None)).then_some(Self(perf))
    }

    /// Stops, and returns the number of calls.
    #[must_use]
    pub fn stop(self) -> Option<u64> {
        let pid = nix::unistd::Pid::from_raw(i32::try_from(self.0.id()).ok()?);
        nix::sys::signal::kill(pid, nix::sys::signal::Signal::SIGINT).ok()?;
        let output = self.0.wait_with_output().ok()?;
        let report = String::from_utf8(output.stderr).ok()?;
        report.lines().find_map(|line| {
            let (count, rest) = line.split_once(',')?;
            rest.contains("sys_enter").then(|| count.parse().ok())?
        })
    }
}
