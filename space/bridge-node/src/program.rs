//! The main function of every program, from the command line to the exit code.

use std::collections::{BTreeMap, BTreeSet};
use std::ffi::OsString;
use std::fs::File;
use std::io::Read;
use std::net::SocketAddr;
use std::process::ExitCode;
use std::sync::Arc;
use std::time::Duration;

use bridge_core::{Application, Local, Owned, RedundancyRank, Router, RouterSettings};
use clap::Parser;
use mappings::{Mapping, SecurityGroup, SpaceId};
use service::{
    Failure, FailureKind, Requests, RunLoops, Site, descriptors, logging, restart, service_manager,
};
use tokio::signal::unix::SignalKind;
use tokio::sync::watch;
use tokio::task::{JoinError, JoinSet};
use tracing::{Instrument, Span, error, info, info_span};
use transport::Carrier;
use type_files::TypePaths;

use crate::arguments::Arguments;
use crate::awaited::PeerWatch;
use crate::busy_poll::BusyPoll;
use crate::carrier;
use crate::clock::now;
use crate::host::ProcessHost;
use crate::keys::{KeyRing, KeyService};
use crate::mapping_file::{ConfigurationFile, MappingFile, NodeSetReader, RunningMapping};
use crate::observer::Observer;
use crate::port::Port;
use crate::redundancy;
use crate::run::{DatagramOutbox, Fixed, LinkLoss, Shell, SideInterfaces, Turn};
use crate::signals;
use crate::status::{AnnouncedNames, StatusSnapshot};

/// The parts of a program, for [`run`].
pub trait Program: Parser {
    /// The local side of the program.
    type Port: Port;

    /// The name of the program on the command line.
    const NAME: &'static str;
    /// The payload encoding of the local side.
    const LOCAL: Local;
    /// Log directives that suppress noisy messages of a library, such as `rustdds=warn`.
    const QUIET: &'static str = "";

    /// The reader of the NodeSet2 files that a mapping names, if the program reads them.
    const NODESETS: Option<NodeSetReader> = None;

    /// Returns the library of the local side with its version and patches, for the status.
    #[must_use]
    fn library() -> Option<&'static str> {
        None
    }

    /// Returns the arguments that all programs have.
    fn arguments(&self) -> &Arguments;

    /// Whether the program listens for other writers in its namespaces for a moment before it sends
    /// in them.
    const CLAIMS: bool = false;

    /// Returns a mapping made in code instead of a file, for programs with a configuration of their
    /// own.
    ///
    /// # Errors
    /// The configuration cannot run. Its faults have been printed.
    fn made(&self) -> Result<Option<Made>, Failure> {
        Ok(None)
    }

    /// Returns the file of the configuration of [`made`](Self::made), which is followed like a
    /// mapping. Called after `made`.
    fn configuration(&self) -> Option<Arc<dyn ConfigurationFile>> {
        None
    }

    /// Returns the namespaces of its space that only this program writes. Called again when the
    /// mapping changes.
    #[must_use]
    fn owned(mapping: &Mapping) -> Owned {
        let _whole_space = mapping;
        Owned::All
    }

    /// Whether the local side takes values while the program is a standby, as a server that shows
    /// them to its clients.
    const SHOWS_VALUES_AT_STANDBY: bool = false;

    /// Returns the rank of the program among the redundant programs of its spaces; `None` without
    /// redundancy.
    fn rank(&self) -> Option<RedundancyRank> {
        None
    }

    /// Returns the namespaces that the program carries because other programs of its space carry
    /// the others; empty for all namespaces.
    fn part(&self) -> BTreeSet<u16> {
        BTreeSet::new()
    }

    /// Returns the client of Security Key Services; `None` if the program has none.
    fn key_service(&self, mapping: &Mapping) -> Option<Arc<dyn KeyService>> {
        let _none = mapping;
        None
    }

    /// Announces a carried space outside the group, for example by mDNS, until the returned value
    /// is dropped. Returns `None` if the program does not announce it.
    fn tell(&self, carried: &Carried<'_>) -> Option<Box<dyn Send + Sync>> {
        let _nobody = carried;
        None
    }

    /// Returns the observer of the run loops, if the program has a page.
    fn observer(&self) -> Option<Arc<dyn Observer>> {
        None
    }

    /// Returns the pages that the program serves beside its status.
    ///
    /// # Errors
    /// The arguments for the pages contradict each other.
    fn site(&self) -> Result<Option<Arc<dyn Site>>, Failure> {
        Ok(None)
    }

    /// Returns the spaces that the program serves, without duplicates. Each has a local side, a
    /// Router and a socket in the group.
    ///
    /// # Errors
    /// Neither the arguments nor the mapping name the spaces, or they contradict each other.
    fn spaces(&self, mapping: &Mapping) -> Result<Vec<SpaceId>, Failure>;

    /// Starts the local side of a space.
    ///
    /// # Errors
    /// The reason why the local side cannot run at all. A missing peer is not an error; the local
    /// side waits for it.
    fn start(&self, context: Context) -> impl Future<Output = Result<Self::Port, Failure>>;
}

/// The result of a program with a configuration of its own.
#[derive(Debug)]
#[expect(
    clippy::large_enum_variant,
    reason = "there is one, and it is moved once"
)]
pub enum Made {
    /// The mapping to run.
    Run(Mapping),
    /// The configuration was only to be checked, and can run.
    Checked,
}

/// A space that a program carries, and its PubSub group.
#[derive(Debug, Clone, Copy)]
pub struct Carried<'a> {
    /// The description of the program.
    pub application: &'a Application,
    /// The space.
    pub own: SpaceId,
    /// The PubSub group.
    pub group: SocketAddr,
    /// The network interface of the group, by name or address, if it is set.
    pub interface: Option<&'a str>,
}

/// The parameters for the start of a port.
#[derive(Debug, Clone)]
pub struct Context {
    /// The mapping of the cell.
    pub mapping: Arc<Mapping>,
    /// The definitions of its `type_paths`.
    pub types: Arc<TypePaths>,
    /// The space to serve.
    pub own: SpaceId,
}

/// Runs a program from its command line to its end. `arguments` start with the name of the program,
/// as in [`std::env::args_os`].
#[must_use]
pub fn run<P: Program>(arguments: impl IntoIterator<Item = OsString>) -> ExitCode {
    let program: P = match service::parse(arguments) {
        Ok(program) => program,
        Err(code) => return code,
    };
    logging::start(program.arguments().flags.log.format, P::QUIET);
    descriptors::raise();
    let ended = match open(&program) {
        Ok(Some(mapping)) => serve(program, mapping),
        Ok(None) => Ok(()),
        Err(failure) => Err(failure),
    };
    restart::executed_again(match ended {
        Ok(()) => ExitCode::SUCCESS,
        Err(failure) => {
            error!("{failure}");
            failure.kind().into()
        }
    })
}

/// Returns the mapping of a program; `None` if the mapping was only to be checked, and can run.
///
/// # Errors
/// The mapping cannot be read or cannot run, or contradicts the arguments.
pub(crate) fn open<P: Program>(program: &P) -> Result<Option<MappingFile>, Failure> {
    let arguments = program.arguments();
    let mapping = arguments.mapping.as_deref();
    let mut refused = None;
    let spaces = |mapping: &Mapping| {
        let spaces = program.spaces(mapping)?;
        refused = check_redundancy(program, mapping, &spaces).err();
        Ok(spaces)
    };
    let mapping = match program.made() {
        Ok(Some(Made::Run(made))) => Ok(Some(MappingFile::made(made, program.configuration()))),
        Ok(Some(Made::Checked)) => Ok(None),
        Ok(None) => MappingFile::open((mapping, P::NODESETS), arguments.check, spaces),
        Err(failure) => Err(failure),
    };
    match refused {
        Some(failure) => Err(failure),
        None => mapping,
    }
}

/// Checks that a redundant program can carry the mapping.
fn check_redundancy<P: Program>(
    program: &P,
    mapping: &Mapping,
    spaces: &[SpaceId],
) -> Result<(), Failure> {
    match program.rank() {
        Some(_) => redundancy::check(&program.arguments().flags, mapping, spaces),
        None => Ok(()),
    }
}

fn serve<P: Program>(program: P, file: MappingFile) -> Result<(), Failure> {
    // A single thread: samples pass from the socket to ROS and back without a change of threads,
    // and the state needs no lock.
    idle_ticks::start();
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .map_err(|error| Failure::new(FailureKind::Io, format!("cannot start: {error}")))?;
    let host = ProcessHost::alone(P::NAME);
    let ended = runtime.block_on(async move {
        let signal = service::signals::stopped()?;
        service_manager::start_watchdog();
        carry(&program, file, (&host, signal)).await
    });
    // A poll of files on a disk that does not answer is not awaited.
    runtime.shutdown_background();
    ended
}

/// Runs a program until `stop` completes.
///
/// # Errors
/// The reason why the program cannot run or has ended.
pub(crate) async fn carry<P: Program>(
    program: &P,
    file: MappingFile,
    (host, stop): (&ProcessHost, impl Future<Output = ()>),
) -> Result<(), Failure> {
    let arguments = program.arguments();
    let running = file.running().clone();
    let spaces = program.spaces(&running.mapping)?;
    check_redundancy(program, &running.mapping, &spaces)?;
    let hangup = service::signals::listen(SignalKind::hangup())?;
    let (switch, switches) = watch::channel(0);
    let switching = signals::switches(program.rank().is_some(), switch)?;
    let (changed, changes) = watch::channel(running);
    let site = program.site()?;
    let RunLoops { asks, mut requests } = service::loops(spaces.len());
    host.starting(P::NAME, (&asks, site.as_ref()), arguments.flags.metrics)
        .await?;
    let several = spaces.len() > 1;
    let (stopping, stopped) = watch::channel(false);
    let mut shells = JoinSet::new();
    for own in spaces.iter().copied() {
        // The span names the space of a log line, which matters only with several spaces.
        let span = if several {
            info_span!("bridge", space = %own)
        } else {
            Span::none()
        };
        let requests = requests.pop().unwrap_or_else(service::never);
        let changes = (&changes, &switches);
        let shell = prepare(program, changes, (own, several), (requests, host));
        let shell = shell.instrument(span.clone());
        let ended = shell.await?.run(told(stopped.clone()));
        // Run as separate tasks: waking the future given to `block_on` costs a system call each
        // time.
        shells.spawn(ended.instrument(span).in_current_span());
    }
    host.started(P::NAME, (asks, site));
    let mut ended = Ok(());
    tokio::select! {
        () = stop => {}
        first = shells.join_next() => ended = how(first),
        () = file.follow(hangup, changed) => {}
        () = switching => {}
    }
    host.ending();
    stopping.send_replace(true);
    while let Some(next) = shells.join_next().await {
        ended = ended.and(how(Some(next)));
    }
    ended
}

/// Prepares the run loop of a space.
async fn prepare<P: Program>(
    program: &P,
    (changes, switches): (&watch::Receiver<RunningMapping>, &watch::Receiver<u64>),
    (own, several): (SpaceId, bool),
    (requests, host): (Requests<StatusSnapshot>, &ProcessHost),
) -> Result<Shell<P::Port>, Failure> {
    let arguments = program.arguments();
    let RunningMapping {
        mapping,
        types,
        about,
    } = changes.borrow().clone();
    log_start::<P>(arguments, own, about.hash());
    let hub = host.hub(several);
    let name = (P::NAME, own);
    let (carrier, group) = carrier::open(name, (arguments, &mapping), changes, (several, hub))?;
    let settings = RouterSettings {
        own,
        local: P::LOCAL,
        source: Some(carrier.source().unwrap_or(carrier::NO_SOURCE)),
    };
    let mut keys = KeyRing::new(groups(arguments)?, program.key_service(&mapping));
    let taken = mapping;
    let mapping = keys.applied(Arc::clone(&taken));
    let mut router = router_of(program, settings, &mapping, carrier.as_ref())?;
    keys.start(&mapping, &mut router)?;
    let context = Context {
        mapping: Arc::clone(&mapping),
        types,
        own,
    };
    let observer = program.observer();
    let observer = observer.inspect(|observer| observer.mapped(&taken));
    let port = program.start(context).await?;
    look_around(&mut router, &port);
    let application = port.application().unwrap_or_else(|| plain(P::NAME, own));
    let told = group.and_then(|options| {
        program.tell(&Carried {
            application: &application,
            own,
            group: options.address,
            interface: options.interface.as_deref(),
        })
    });
    router.introduce(application, now());
    Ok(Shell {
        program: P::NAME,
        started: now().monotonic,
        library: P::library(),
        own,
        router,
        side: SideInterfaces::start(port.addresses()),
        links: LinkLoss::default(),
        port,
        carrier,
        interest: None,
        outbox: DatagramOutbox::default(),
        owned: P::owned,
        claims: P::CLAIMS,
        requests,
        names: AnnouncedNames::default(),
        taps: Arc::clone(host.taps()),
        changes: changes.clone(),
        switches: switches.clone(),
        keys,
        fixed: Fixed {
            started: mapping,
            taken,
            address: arguments.flags.address.is_none(),
            interface: arguments.flags.interface.is_none(),
        },
        restart: Vec::new(),
        taken: BTreeMap::new(),
        awaited: PeerWatch::new(now().monotonic),
        busy: BusyPoll::new(Duration::from_micros(arguments.flags.busy_poll.into())),
        turn: match hub {
            Some(_) => Turn::Shared,
            None => Turn::Whole,
        },
        dry_run: arguments.flags.dry_run,
        observer,
        _told: told,
    })
}

/// Limits the Router to the topics that the port uses, and probes for the calls of other programs.
fn look_around(router: &mut Router, port: &impl Port) {
    if let Some(topics) = port.used_topics() {
        router.limit_to(topics);
    }
    router.call_the_roll(now());
}

/// Returns the Router of a space, which has no keys yet.
fn router_of<P: Program>(
    program: &P,
    settings: RouterSettings,
    mapping: &Arc<Mapping>,
    carrier: &dyn Carrier,
) -> Result<Router, Failure> {
    let own = settings.own;
    let mut router = Router::new(settings, Arc::clone(mapping));
    router.set_owned(P::owned(mapping), now());
    router.set_relay(carrier::relay(carrier));
    router.set_limit(carrier::limit(carrier));
    router.set_link(carrier::link(carrier));
    identify(&mut router, program.rank())?;
    if P::SHOWS_VALUES_AT_STANDBY {
        router.show_values_at_standby();
    }
    let part = program.part();
    if !part.is_empty() {
        router.set_part(part, plain(P::NAME, own).name, now());
    }
    Ok(router)
}

fn log_start<P: Program>(arguments: &Arguments, own: SpaceId, hash: &str) {
    info!(
        version = build_info::version(),
        space = %own,
        mapping = arguments.mapping.as_ref().map(|file| tracing::field::display(file.display())),
        hash,
        "{} starts",
        P::NAME
    );
}

/// Sets the instance of a program, and its rank among the redundant bridges of its space.
fn identify(router: &mut Router, rank: Option<RedundancyRank>) -> Result<(), Failure> {
    router.set_instance(instance()?);
    if let Some(rank) = rank {
        router.set_redundancy(rank, now());
    }
    Ok(())
}

/// Completes when the program is to stop, or when the sender is dropped.
async fn told(mut stop: watch::Receiver<bool>) {
    let _told_or_alone = stop.wait_for(|stop| *stop).await;
}

/// Returns the description of a program that is not a server. Its ApplicationUri is the URI of the
/// certificate with which it fetches keys.
fn plain(program: &str, own: SpaceId) -> Application {
    let host = std::fs::read_to_string(HOST_NAME).unwrap_or_default();
    let host = match host.trim() {
        "" => "localhost",
        host => host,
    };
    Application {
        uri: format!("urn:{host}:ua-bridge:{program}"),
        product_uri: format!("urn:ua-bridge:{program}"),
        name: format!("{program}, space {own}, on {host}"),
        capabilities: vec!["NA".to_owned()],
        ..Application::default()
    }
}

const HOST_NAME: &str = "/proc/sys/kernel/hostname";

/// Returns random bytes that distinguish the requests of this run from requests of other runs.
fn instance() -> Result<[u8; 16], Failure> {
    let mut bytes = [0; 16];
    File::open(RANDOM)
        .and_then(|mut random| random.read_exact(&mut bytes))
        .map_err(|error| Failure::new(FailureKind::Io, format!("cannot read {RANDOM}: {error}")))?;
    Ok(bytes)
}

const RANDOM: &str = "/dev/urandom";

/// Returns the secured groups of the mapping that the command line names for them.
fn groups(arguments: &Arguments) -> Result<Option<Vec<SecurityGroup>>, Failure> {
    let Some(path) = &arguments.flags.security else {
        return Ok(None);
    };
    let name = path.display().to_string();
    let text = type_files::read_text_file(path).map_err(|error| {
        let message = format!("--security: cannot read {name}: {error}");
        Failure::new(FailureKind::Configuration, message)
    })?;
    let checked = Mapping::from_yaml(&text, &name);
    let Some(mapping) = checked.outline() else {
        let message = format!("--security: {name} has errors: `ua-space check {name}` shows them");
        return Err(Failure::new(FailureKind::Configuration, message));
    };
    if mapping.security().is_empty() {
        let message = format!("--security: {name} has no section `security`");
        return Err(Failure::new(FailureKind::Configuration, message));
    }
    Ok(Some(mapping.security().to_vec()))
}

/// Returns how the run loop of a space ended.
fn how(ended: Option<Result<Result<(), Failure>, JoinError>>) -> Result<(), Failure> {
    ended.unwrap_or(Ok(Ok(()))).unwrap_or_else(|error| {
        Err(Failure::new(
            FailureKind::Io,
            format!("the program failed: {error}"),
        ))
    })
}
