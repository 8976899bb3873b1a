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
