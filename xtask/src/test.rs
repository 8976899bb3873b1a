//! `cargo xtask test`: installs the peers, then runs all tests.
//!
//! Tests of the package `system-tests` run as separate processes, some of them concurrently,
//! because they mostly wait for peers. All other test programs run as with `cargo test`.

mod job;
mod outcome;
mod programs;

use std::{
    env, fs,
    io::ErrorKind,
    path::{Path, PathBuf},
    process::Command,
    time::{Duration, Instant},
};

use anyhow::Context as _;

use crate::{
    links,
    namespace::{NamespacePermission, REFUSED},
    patches::{Patched, PatchedCrate},
    peers,
    shell::{CommandOutcome, is_ci, step},
    workspace::Workspace,
};
use job::{JobReport, JobSlots, TestJob};
use outcome::TestOutcome;
use programs::TestProgram;

/// The targets of a test run. All commands build the same packages, so nothing is built twice.
const TARGETS: &[&str] = &["--workspace", "--locked"];
const SYSTEM_TESTS: &str = "system-tests";
/// The option that builds everything with the carrier in shared memory, which needs libclang.
const SHARED_MEMORY: &str = "--shm";
const SHARED_MEMORY_FEATURES: &str =
    "transport/shm,system-tests/shm,ua-bridge/shm,bridge-ros1/shm,bridge-ros2/shm";
/// Modules of the system tests that measure the load of the machine; concurrent tests would be
/// measured too.
const ALONE: &[&str] = &["large", "rate", "ros2_fuzz", "ros2_large", "sharing"];
/// Number of concurrent system tests, chosen for two cores. The tests mostly wait; higher numbers
/// were not tried.
const BESIDE: usize = 3;
/// Maximum number of flaky tests. Peers of other vendors fail occasionally even without this
/// project; more failures indicate a fault.
const MOST_FLAKY: usize = 2;

pub(crate) fn run(workspace: &Workspace, arguments: &[&str]) -> anyhow::Result<CommandOutcome> {
    let (options, filters): (Vec<&str>, Vec<&str>) = arguments
        .iter()
        .copied()
        .partition(|argument| argument.starts_with('-'));
    let is_known = |option: &&str| ["--no-install", SHARED_MEMORY].contains(option);
    if let Some(unknown) = options.iter().find(|option| !is_known(option)) {
        eprintln!(
            "xtask: test takes --no-install, {SHARED_MEMORY} and names of tests, not {unknown}"
        );
        return Ok(CommandOutcome::USAGE);
    }
    if !options.contains(&"--no-install") {
        // Tests of missing peers skip themselves, or fail with CI=true; the other tests run.
        peers::install(workspace);
    }
    step("building the programs and the tests (some minutes the first time)");
    let patched = Patched::prepare(workspace)?;
    let built = ["--bins", "--tests", "--examples"];
    let mut build = patched.cargo(workspace, &[&["build"][..], TARGETS, &built].concat());
    if options.contains(&SHARED_MEMORY) {
        build.args(["--features", SHARED_MEMORY_FEATURES]);
    }
    let programs = programs::build(build)?;
    links::make(&workspace.target.join("debug"))?;

    let skipped = workspace.target.join("skipped-tests.txt");
    remove(&skipped)?;
    #[expect(clippy::disallowed_methods, reason = "how long it took is told")]
    let start = Instant::now();
    let report = Plan::of(workspace, &patched, &programs, &filters, &skipped)?.run()?;
    let reasons = match fs::read_to_string(&skipped) {
        Ok(reasons) => reasons,
        Err(error) if error.kind() == ErrorKind::NotFound => String::new(),
        Err(error) => return Err(error).with_context(|| format!("{}", skipped.display())),
    };
    let outcome = TestOutcome::new(&report, reasons.lines().collect(), MOST_FLAKY);
    step(&format!("tested in {}", minutes(start.elapsed())));
    print!("{outcome}");
    Ok(outcome.ended())
}

/// Runs only the tests that the patches add to their crates.
pub(crate) fn of_all_patches(workspace: &Workspace) -> anyhow::Result<CommandOutcome> {
    let patched = Patched::prepare(workspace)?;
    let programs = of_patches(workspace, &patched)?;
    let namespaces = NamespacePermission::try_out();
    let jobs = programs.iter();
    let jobs = jobs.map(|(source, program)| job_of_patches(source, program, namespaces));
    let mut report = JobReport::default();
    report.take(JobSlots(1).run(jobs.collect())?);
    let outcome = TestOutcome::new(&report, Vec::new(), 0);
    print!("{outcome}");
    Ok(outcome.ended())
}

/// Builds the test programs of the patched crates to which the patches add tests.
fn of_patches<'a>(
    workspace: &Workspace,
    patched: &'a Patched,
) -> anyhow::Result<Vec<(&'a PatchedCrate, TestProgram)>> {
    let mut all = Vec::new();
    for source in patched.sources() {
        // Without test names the program would run all tests of the crate.
        if !source.tests().is_empty() {
            let built = programs::build(source.build_of_own_tests(workspace, patched))?;
            all.extend(built.into_iter().map(|program| (source, program)));
        }
    }
    Ok(all)
}

/// The jobs, grouped by their concurrency.
struct Plan {
    /// Jobs that run in sequence, because they use all cores themselves.
    programs: Vec<TestJob>,
    /// Jobs that run with the concurrency [`BESIDE`].
    beside: Vec<TestJob>,
    alone: Vec<TestJob>,
}

impl Plan {
    fn of(
        workspace: &Workspace,
        patched: &Patched,
        programs: &[TestProgram],
        filters: &[&str],
        skipped: &Path,
    ) -> anyhow::Result<Self> {
        let namespaces = NamespacePermission::try_out();
        if namespaces == NamespacePermission::Refused {
            eprintln!("xtask: {REFUSED}");
            if is_ci() {
                eprintln!("xtask: with CI=true no test is skipped, so the system tests fail");
            }
        }
        // The variable names other programs to test, such as those of a package.
        let binaries = env::var_os("UA_BIN_DIR");
        let binaries = binaries.map_or_else(|| workspace.target.join("debug"), PathBuf::from);
        let surround = |mut command: Command| {
            command
                .env("UA_BIN_DIR", &binaries)
                .env("UA_PEERS_PYTHON", peers::python(workspace))
                .env("UA_PEERS", workspace.peers())
                .env("UA_SKIPPED", skipped);
            if namespaces == NamespacePermission::Refused {
                command.env("UA_NO_NETWORK", REFUSED);
            }
            command
        };
        let mut plan = Self {
            programs: Vec::new(),
            beside: Vec::new(),
            alone: Vec::new(),
        };
        for program in programs {
            let command = || surround(program.command(namespaces));
            if program.package != SYSTEM_TESTS {
                let mut command = command();
                command.args(filters);
                plan.programs.push(TestJob::new(program.label(), command));
                continue;
            }
            for test in program.tests(filters)? {
                let mut command = command();
                command.args(["--exact", &test]);
                let module = test.split("::").next().unwrap_or_default();
                let alone = ALONE.contains(&module);
                let job = TestJob::new(test, command).with_peers();
                match alone {
                    true => plan.alone.push(job),
                    false => plan.beside.push(job),
                }
            }
        }
        let mut documents = surround(patched.cargo(workspace, &[&["test"][..], TARGETS].concat()));
        documents.args(["--doc", "--"]).args(filters);
        plan.programs.push(TestJob::new(
            "examples in the documentation".to_owned(),
            documents,
        ));
        Ok(plan)
    }

    fn run(self) -> anyhow::Result<JobReport> {
        let mut report = JobReport::default();
        step("tests without peers");
        report.take(JobSlots(1).run(self.programs)?);
        step(&format!(
            "tests with peers, each in a network of its own, {BESIDE} at a time"
        ));
        report.take(JobSlots(BESIDE).run(self.beside)?);
        step("tests that take the machine for themselves");
        report.take(JobSlots(1).run(self.alone)?);
        let again = report.failed_with_peers(MOST_RETRIED);
        if !again.is_empty() {
            step("tests with peers that failed, once more and alone");
            report.retry(JobSlots(1).run(again)?);
        }
        Ok(report)
    }
}

fn job_of_patches(
    source: &PatchedCrate,
    program: &TestProgram,
    namespaces: NamespacePermission,
) -> TestJob {
    let mut command = program.alone(namespaces);
    command.args(source.tests());
    TestJob::new(format!("{}, what patches/ adds", source.name()), command)
}

/// Maximum number of failures that are retried. More failures are not accidents of a peer, and
/// retrying them would take the time of CI.
const MOST_RETRIED: usize = 10;

fn minutes(time: Duration) -> String {
    let seconds = time.as_secs();
    format!("{} min {} s", seconds / 60, seconds % 60)
}

fn remove(file: &Path) -> anyhow::Result<()> {
    match fs::remove_file(file) {
        Err(error) if error.kind() != ErrorKind::NotFound => {
            Err(error).with_context(|| format!("{} cannot be removed", file.display()))
        }
        _ => Ok(()),
    }
}
