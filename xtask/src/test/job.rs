//! Test processes: started with limited concurrency, monitored, and counted.

use std::{
    collections::VecDeque,
    process::{Child, Command, ExitStatus, Stdio},
    sync::{Mutex, PoisonError},
    thread,
    time::{Duration, Instant},
};

use anyhow::Context as _;

/// Time limit of a test, after which it counts as hung; the longest test takes a minute. Peers that
/// a hung test has started are not stopped.
const LONGEST: Duration = Duration::from_secs(600);
const LOOK_EVERY: Duration = Duration::from_millis(20);

/// A process with one test or more.
pub(super) struct TestJob {
    name: String,
    command: Command,
    has_peers: bool,
}

impl TestJob {
    pub(super) fn new(name: String, command: Command) -> Self {
        Self {
            name,
            command,
            has_peers: false,
        }
    }

    /// Marks the job as a test with software of other vendors.
    pub(super) fn with_peers(mut self) -> Self {
        self.has_peers = true;
        self
    }

    /// Runs the job to its end, or to its time limit.
    fn run(mut self) -> anyhow::Result<EndedJob> {
        #[expect(
            clippy::disallowed_methods,
            reason = "how long a test takes is told, and it may not hang"
        )]
        let start = Instant::now();
        let mut child = self
            .command
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .with_context(|| format!("{} does not start", self.name))?;
        let (mut stdout, mut stderr) = (child.stdout.take(), child.stderr.take());
        let (printed, status) = thread::scope(|scope| {
            let read = |pipe: &mut dyn std::io::Read| {
                let mut bytes = Vec::new();
                // A read error is not a fault of the test; the output read so far is shown.
                let _read = pipe.read_to_end(&mut bytes);
                String::from_utf8_lossy(&bytes).into_owned()
            };
            let out = scope.spawn(move || stdout.as_mut().map(|pipe| read(pipe)));
            let err = scope.spawn(move || stderr.as_mut().map(|pipe| read(pipe)));
            let status = wait(&mut child, start);
            let texts = [out.join(), err.join()].map(|text| text.ok().flatten());
            (texts.map(Option::unwrap_or_default).concat(), status)
        });
        let ended = status.with_context(|| format!("{} cannot be waited for", self.name))?;
        let mut counts = ResultCounts::of(&printed);
        let passed = ended.is_some_and(|status| status.success());
        if !passed && counts.failed == 0 {
            // The program ended without a result, for example by a signal.
            counts.failed = 1;
        }
        Ok(EndedJob {
            counts,
            passed,
            hung: ended.is_none(),
            took: start.elapsed(),
            printed,
            job: self,
        })
    }
}

/// Returns the exit status, or `None` if the process was killed at the time limit.
#[expect(
    clippy::disallowed_methods,
    reason = "waiting for a process with a deadline is looking again and again"
)]
fn wait(child: &mut Child, start: Instant) -> std::io::Result<Option<ExitStatus>> {
    loop {
        if let Some(status) = child.try_wait()? {
            return Ok(Some(status));
        }
        if start.elapsed() > LONGEST {
            let group = format!("-{}", child.id());
            Command::new("kill")
                .args(["-KILL", "--", &group])
                .status()?;
            // The process may lead no group, and may have ended meanwhile.
            let _killed = child.kill();
            child.wait()?;
            return Ok(None);
        }
        thread::sleep(LOOK_EVERY);
    }
}

/// The counts in the results of test programs.
#[derive(Debug, Default, Clone, Copy, PartialEq, Eq)]
pub(super) struct ResultCounts {
    pub(super) passed: u64,
    pub(super) failed: u64,
    pub(super) ignored: u64,
}

impl ResultCounts {
    fn of(printed: &str) -> Self {
        let mut counts = Self::default();
        let results = printed
            .lines()
            .filter_map(|line| line.strip_prefix("test result: "));
        for (count, what) in results
            .flat_map(|result| result.split([';', '.']))
            .filter_map(|part| part.trim().split_once(' '))
        {
            let total = match what {
                "passed" => &mut counts.passed,
                "failed" => &mut counts.failed,
                "ignored" => &mut counts.ignored,
                _ => continue,
            };
            *total += count.parse::<u64>().unwrap_or_default();
        }
        counts
    }
}

/// A job that ended.
pub(super) struct EndedJob {
    job: TestJob,
    pub(super) counts: ResultCounts,
    pub(super) passed: bool,
    hung: bool,
    pub(super) took: Duration,
    printed: String,
}

impl EndedJob {
    pub(super) fn name(&self) -> &str {
        &self.job.name
    }

    fn print(&self) {
        let took = self.took.as_secs_f64();
        if self.passed {
            if self.counts == ResultCounts::default() {
                // A program without tests, or without tests that match the filters.
                return;
            }
            let count = match self.counts.passed {
                1 => String::new(),
                passed => format!(" ({passed} tests)"),
            };
            println!("{} ... ok{count}, {took:.1} s", self.job.name);
            return;
        }
        println!("{}", self.printed);
        let why = match self.hung {
            true => "HUNG, it was ended",
            false => "FAILED",
        };
        println!("{} ... {why}, {took:.1} s", self.job.name);
    }
}

/// The number of concurrent jobs.
pub(super) struct JobSlots(pub(super) usize);

impl JobSlots {
    /// Runs all jobs and prints each result as it ends, for failures with the whole output.
    pub(super) fn run(self, jobs: Vec<TestJob>) -> anyhow::Result<Vec<EndedJob>> {
        let waiting = Mutex::new(VecDeque::from(jobs));
        let next = || {
            let mut waiting = waiting.lock().unwrap_or_else(PoisonError::into_inner);
            waiting.pop_front()
        };
        let lane = || -> anyhow::Result<Vec<EndedJob>> {
            let mut all = Vec::new();
            while let Some(job) = next() {
                let done = job.run()?;
                done.print();
                all.push(done);
            }
            Ok(all)
        };
        thread::scope(|scope| {
            let lanes: Vec<_> = (0..self.0).map(|_| scope.spawn(lane)).collect();
            let mut all = Vec::new();
            for lane in lanes {
                let done = lane
                    .join()
                    .map_err(|_| anyhow::anyhow!("a lane of tests panicked"))?;
                all.extend(done?);
            }
            Ok(all)
        })
    }
}

/// The results of all jobs.
#[derive(Default)]
pub(super) struct JobReport {
    pub(super) done: Vec<EndedJob>,
    /// Tests that failed and then passed.
    pub(super) flaky: Vec<String>,
}

impl JobReport {
    pub(super) fn take(&mut self, done: Vec<EndedJob>) {
        self.done.extend(done);
    }

    /// Removes and returns the failed jobs that may be retried; returns no jobs if there are more
    /// than `most`.
    pub(super) fn failed_with_peers(&mut self, most: usize) -> Vec<TestJob> {
        let may = |done: &EndedJob| !done.passed && done.job.has_peers;
        if self.done.iter().filter(|done| may(done)).count() > most {
            return Vec::new();
        }
        let (again, done): (Vec<_>, _) = std::mem::take(&mut self.done).into_iter().partition(may);
        self.done = done;
        again.into_iter().map(|done| done.job).collect()
    }

    /// Adds the results of a retry.
    pub(super) fn retry(&mut self, done: Vec<EndedJob>) {
        let passed = done.iter().filter(|done| done.passed);
        self.flaky.extend(passed.map(|done| done.name().to_owned()));
        self.take(done);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn shell(name: &str, script: &str) -> TestJob {
        let mut command = Command::new("sh");
        command.args(["-c", script]);
        TestJob::new(name.to_owned(), command)
    }

    const WELL: &str = "echo 'test result: ok. 7 passed; 0 failed; 1 ignored; 0 measured'";
    const BADLY: &str = "echo 'test result: FAILED. 3 passed; 2 failed; 0 ignored'; exit 101";

    #[test]
    fn what_test_programs_say_in_the_end_is_counted() {
        let done = JobSlots(2)
            .run(vec![shell("a", WELL), shell("b", BADLY)])
            .unwrap();
        let mut counts: Vec<_> = done.iter().map(|done| (done.passed, done.counts)).collect();
        counts.sort_by_key(|(passed, _)| *passed);
        let (well, badly) = (
            ResultCounts {
                passed: 7,
                failed: 0,
                ignored: 1,
            },
            ResultCounts {
                passed: 3,
                failed: 2,
                ignored: 0,
            },
        );
        assert_eq!(counts, [(false, badly), (true, well)]);
    }

    #[test]
    fn a_program_that_dies_without_a_word_has_failed() {
        let done = JobSlots(1)
            .run(vec![shell("dies", "kill -KILL $$")])
            .unwrap();
        assert_eq!(
            done.first().map(|done| (done.passed, done.counts.failed)),
            Some((false, 1))
        );
    }

    #[test]
    fn only_tests_with_peers_are_tried_again_and_are_flaky_then() {
        let mut report = JobReport::default();
        report.take(
            JobSlots(1)
                .run(vec![
                    shell("ours", BADLY),
                    shell("theirs", BADLY).with_peers(),
                    shell("well", WELL),
                ])
                .unwrap(),
        );
        assert!(
            report.failed_with_peers(0).is_empty(),
            "one is more than none"
        );
        let again = report.failed_with_peers(1);
        let names: Vec<_> = again.iter().map(|job| job.name.clone()).collect();
        assert_eq!(names, ["theirs"]);
        report.retry(JobSlots(1).run(vec![shell("theirs", WELL)]).unwrap());
        assert_eq!(report.flaky, ["theirs"]);
        let failed: Vec<_> = report.done.iter().filter(|done| !done.passed).collect();
        assert_eq!(
            failed.iter().map(|done| done.name()).collect::<Vec<_>>(),
            ["ours"]
        );
    }
}
