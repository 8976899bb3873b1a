//! Several programs of a cell in one process.
//!
//! The programs of a thread share a runtime, so a value passes between two bridges of a thread
//! without a change of threads. A program that fails leaves the others at work: it is started again
//! in the process, as a service manager starts a program again. A crash of the process ends all.

use std::ffi::OsString;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::pin::Pin;
use std::process::ExitCode;
use std::time::{Duration, SystemTime};

use mappings::{Mapping, SpaceId};
use service::service_manager::Pulse;
use service::{Failure, FailureKind, LogFormat, descriptors, logging, restart, service_manager};
use tokio::signal::unix::SignalKind;
use tokio::sync::{oneshot, watch};
use tokio::task::{LocalSet, spawn_blocking, spawn_local};
use tokio::time::{Instant, interval, sleep};
use tracing::{Instrument as _, error, info, warn};

use crate::host::ProcessHost;
use crate::mapping_file::{MappingFile, NodeSetReader};
use crate::program::{Program, carry, open};

/// The programs of a cell that run in one process.
#[derive(Debug)]
pub struct ProgramSet {
    /// The format of the log.
    pub log: LogFormat,
    /// The address of the pages of all programs.
    pub metrics: Option<SocketAddr>,
    /// The mapping of the cell. A program that cannot run with it is started again when the file
    /// changes.
    pub mapping: Option<PathBuf>,
    /// The programs of each thread.
    pub threads: Vec<Vec<SharedProgram>>,
}

/// A program that shares its process with others.
#[derive(Debug)]
pub struct SharedProgram {
    name: &'static str,
    quiet: &'static str,
    arguments: Vec<OsString>,
    run: fn(Vec<OsString>, ProcessHost, Stop) -> ProgramRun,
}

/// A run of a program.
type ProgramRun = Pin<Box<dyn Future<Output = Result<(), Failure>>>>;
/// True as soon as the process is to end.
type Stop = watch::Receiver<bool>;

impl SharedProgram {
    /// Returns a program with its arguments, which start with its name.
    ///
    /// # Errors
    /// The exit code if the arguments are invalid or ask for help; the message was printed.
    pub fn new<P: Program + Send + 'static>(arguments: Vec<OsString>) -> Result<Self, ExitCode> {
        let _valid: P = service::parse(arguments.clone())?;
        Ok(Self {
            name: P::NAME,
            quiet: P::QUIET,
            arguments,
            run: |arguments, host, stop| {
                let run = run::<P>(arguments, host, stop);
                Box::pin(run.instrument(logging::program_span(P::NAME)))
            },
        })
    }
}

/// Runs a program until the process is to end.
async fn run<P: Program + Send + 'static>(
    arguments: Vec<OsString>,
    host: ProcessHost,
    mut stop: Stop,
) -> Result<(), Failure> {
    let program = P::try_parse_from(arguments)
        .map_err(|usage| Failure::new(FailureKind::Usage, usage.to_string()))?;
    let span = tracing::Span::current();
    // Another thread reads the files, because the programs of this thread go on.
    let opened =
        spawn_blocking(move || span.in_scope(|| open(&program).map(|file| (program, file))));
    let (program, file) = opened.await.map_err(|error| failed(&error))??;
    let Some(file) = file else {
        return Ok(());
    };
    let stopped = async move {
        let _told_or_alone = stop.wait_for(|stop| *stop).await;
    };
    carry(&program, file, (&host, stopped)).await
}

/// Checks a mapping for all its spaces, prints the findings, and returns the exit code.
#[must_use]
pub fn check_mapping(
    mapping: Option<&Path>,
    nodesets: Option<NodeSetReader>,
    log: LogFormat,
) -> ExitCode {
    logging::start(log, "");
    let all_spaces = |_: &Mapping| -> Result<Vec<SpaceId>, Failure> {
        Err(Failure::new(FailureKind::Usage, "all spaces"))
    };
    match MappingFile::open((mapping, nodesets), true, all_spaces) {
        Ok(_) => ExitCode::SUCCESS,
        Err(failure) => {
            error!("{failure}");
            failure.kind().into()
        }
    }
}

/// Runs several programs in this process until the process is to end, and returns the exit code.
#[must_use]
pub fn run_together(programs: ProgramSet) -> ExitCode {
    let quiet: Vec<&str> = programs.all().map(|program| program.quiet).collect();
    logging::start(programs.log, &quiet.join(","));
    descriptors::raise();
    restart::executed_again(match serve(programs) {
        Ok(()) => ExitCode::SUCCESS,
        Err(failure) => {
            error!("{failure}");
            failure.kind().into()
        }
    })
}

impl ProgramSet {
    fn all(&self) -> impl Iterator<Item = &SharedProgram> {
        self.threads.iter().flatten()
    }
}

fn serve(programs: ProgramSet) -> Result<(), Failure> {
    idle_ticks::start();
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .map_err(cannot_start)?;
    let ended = runtime.block_on(supervise(programs));
    runtime.shutdown_background();
    ended
}

/// Starts the threads of the programs, and ends them at the first signal.
async fn supervise(programs: ProgramSet) -> Result<(), Failure> {
    let signal = service::signals::stopped()?;
    let names: Vec<&'static str> = programs.all().map(|program| program.name).collect();
    info!(
        version = build_info::version(),
        "one process runs {}",
        names.join(", ")
    );
    let host = ProcessHost::of_cell(&names);
    host.pages().listen(programs.metrics).await?;
    let (stopping, stop) = watch::channel(false);
    let (mut threads, mut pulses) = (Vec::new(), Vec::new());
    for programs_of_thread in programs.threads {
        let pulse = Pulse::default();
        pulses.push(pulse.clone());
        let thread = ProgramThread {
            programs: programs_of_thread,
            host: host.clone(),
            stop: stop.clone(),
            mapping: programs.mapping.clone(),
            pulse,
        };
        threads.push(thread.start()?);
    }
    service_manager::watch_over(pulses);
    let ended = watch_programs(&host, signal).await;
    service_manager::ending();
    stopping.send_replace(true);
    for thread in threads {
        let crashed = || Failure::new(FailureKind::Io, "a thread of the programs has failed");
        // A failure at the end is reported by the thread.
        thread.await.map_err(|_| crashed())??;
    }
    ended
}

/// Reports the readiness of the programs. Completes at a signal, or when no program can run before
/// a change of the configuration.
async fn watch_programs(
    host: &ProcessHost,
    signal: impl Future<Output = ()>,
) -> Result<(), Failure> {
    let Some(mut states) = host.states() else {
        return Ok(());
    };
    let watching = async {
        let mut is_ready = false;
        loop {
            let (have_started, refusal) = {
                let states = states.borrow_and_update();
                (states.have_started(), states.refusal())
            };
            if let Some(failure) = refusal {
                return failure;
            }
            if have_started && !is_ready {
                is_ready = true;
                service_manager::ready();
            }
            if states.changed().await.is_err() {
                return Failure::new(FailureKind::Io, "the programs have ended");
            }
        }
    };
    tokio::select! {
        () = signal => Ok(()),
        failure = watching => Err(failure),
    }
}

/// A thread with programs.
struct ProgramThread {
    programs: Vec<SharedProgram>,
    host: ProcessHost,
    stop: Stop,
    mapping: Option<PathBuf>,
    pulse: Pulse,
}

impl ProgramThread {
    /// Starts the thread. Its outcome is sent when all its programs have ended.
    fn start(self) -> Result<oneshot::Receiver<Result<(), Failure>>, Failure> {
        let (done, ended) = oneshot::channel();
        let names: Vec<&str> = self.programs.iter().map(|program| program.name).collect();
        std::thread::Builder::new()
            .name(names.join("+"))
            .spawn(move || drop(done.send(self.run())))
            .map_err(cannot_start)?;
        Ok(ended)
    }

    fn run(self) -> Result<(), Failure> {
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_all()
            .build()
            .map_err(cannot_start)?;
        let local = LocalSet::new();
        let Self {
            programs,
            host,
            stop,
            mapping,
            pulse,
        } = self;
        let ended = local.block_on(&runtime, async move {
            pulse.start();
            let keep =
                |program| spawn_local(keep(program, host.clone(), stop.clone(), mapping.clone()));
            let keepers: Vec<_> = programs.into_iter().map(keep).collect();
            let mut ended = Ok(());
            for keeper in keepers {
                let kept = keeper.await.unwrap_or_else(|error| Err(failed(&error)));
                ended = ended.and(kept);
            }
            ended
        });
        runtime.shutdown_background();
        ended
    }
}

/// Logs the failure of a program: as an error if only a change of its configuration helps.
fn log_failure(program: &str, failure: &Failure, (next, is_refused): (&str, bool)) {
    if is_refused {
        error!(program, "{failure}; {next}");
    } else {
        warn!(program, "{failure}; {next}");
    }
}

/// Runs a program, and starts it again after a failure, until the process is to end.
async fn keep(
    program: SharedProgram,
    host: ProcessHost,
    mut stop: Stop,
    mapping: Option<PathBuf>,
) -> Result<(), Failure> {
    let mut pause = FIRST_PAUSE;
    loop {
        let started = Instant::now();
        let before = stamp(mapping.as_deref());
        let run = (program.run)(program.arguments.clone(), host.clone(), stop.clone());
        // A task of its own: a panic ends the run only.
        let ended = spawn_local(run).await;
        let Err(failure) = ended.unwrap_or_else(|error| Err(failed(&error))) else {
            return Ok(());
        };
        if *stop.borrow() {
            error!(program = program.name, "{failure}");
            return Err(failure);
        }
        if started.elapsed() >= STABLE {
            pause = FIRST_PAUSE;
        }
        let name = program.name;
        let is_refused = matches!(
            failure.kind(),
            FailureKind::Usage | FailureKind::Configuration
        );
        let next = if is_refused {
            "it is started again when the mapping changes".to_owned()
        } else {
            format!("it is started again in {pause:?}")
        };
        log_failure(name, &failure, (&next, is_refused));
        host.failed(name, &failure, &next);
        let mut hangup = service::signals::listen(SignalKind::hangup())?;
        let again = async {
            if is_refused {
                changed(mapping.as_deref(), before).await
            } else {
                sleep(pause).await
            }
        };
        tokio::select! {
            _ = stop.wait_for(|stop| *stop) => return Ok(()),
            _ = hangup.recv() => {}
            () = again => {}
        }
        pause = LONGEST_PAUSE.min(pause * 2);
    }
}

/// Completes when the mapping file differs from its stamp of `before`.
async fn changed(mapping: Option<&Path>, before: Option<SystemTime>) {
    let mut looks = interval(LOOK);
    loop {
        looks.tick().await;
        let stamp = stamp(mapping);
        if stamp.is_some() && stamp != before {
            return;
        }
    }
}

fn stamp(mapping: Option<&Path>) -> Option<SystemTime> {
    mapping?.metadata().ok()?.modified().ok()
}

fn failed(error: &tokio::task::JoinError) -> Failure {
    Failure::new(FailureKind::Io, format!("the program failed: {error}"))
}

fn cannot_start(error: std::io::Error) -> Failure {
    Failure::new(FailureKind::Io, format!("cannot start: {error}"))
}

/// The pause before a failed program is started again. It doubles after each failure.
const FIRST_PAUSE: Duration = Duration::from_secs(1);
const LONGEST_PAUSE: Duration = Duration::from_secs(30);
/// A program that has run for this time starts with the first pause again.
const STABLE: Duration = Duration::from_secs(60);
/// Interval of the polls of a mapping that no program can run with.
const LOOK: Duration = Duration::from_secs(1);
