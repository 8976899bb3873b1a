//! `cargo xtask bench skills lock`: the time from the start of a component, or from the lock of a
//! tool, until another component has found its skills.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use discovery::{MdnsInterface, ServerChange, WatchSettings, watch};
use skills::{
    ClientOptions, Detector, ParameterType, RunOutcome, RunnableSkill as _, SkillClient, SkillValue,
};
use system_tests::{Cell, Child, StartedChild, Times, program};
use tokio::task::JoinHandle;
use tokio::time::timeout;

/// A component of the example plant.
struct PlantComponent {
    name: &'static str,
    uri: &'static str,
    /// The published time, in ms.
    paper: f64,
}

const fn component(name: &'static str, uri: &'static str, paper: f64) -> PlantComponent {
    PlantComponent { name, uri, paper }
}

/// The components that run all the time.
const STARTED: [PlantComponent; 3] = [
    component("ur5", "urn:example:ur5", 313.0),
    component("handling", "urn:example:handling", 211.0),
    component("tool-changer", CHANGER_URI, 253.0),
];
/// The tools, by their numbers at the changer, from 1. They run while they are locked.
const TOOLS: [PlantComponent; 2] = [
    component("robotiq-2f85", "urn:example:robotiq-2f85", 8422.0),
    component("schmalz-ecbpi", "urn:example:schmalz-ecbpi", 9635.0),
];
const CHANGER_URI: &str = "urn:example:tool-changer";

/// Measures all components, and prints a table. `boot` is the boot delay of the tools in s.
pub(crate) fn all(runs: usize, boot: usize) -> Option<()> {
    let _cell = Cell::with(&[])?;
    let simulators = simulators(boot);
    // The runtime's threads are in the network of this thread.
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(2)
        .enable_all()
        .build()
        .ok()?;
    runtime.block_on(async {
        let finder = Finder::start();
        println!(
            "\n{runs} runs of each, tools with a boot delay of {boot} s; milliseconds until a detector in another \
             program has the skills:\n"
        );
        println!("| component | since | mean | median | worst | published (mean of 5) |");
        println!("|---|---|---|---|---|---|");
        for one in &STARTED {
            let mut times = Times::default();
            for _ in 0..runs {
                let began = Instant::now();
                let child = start(one.name);
                times.add(finder.found(one.uri).await - began);
                drop(child);
                finder.gone(one.uri).await;
            }
            row(one, "start of the program", &mut times);
        }
        let _parts = ["ur5", "tool-changer"].map(start);
        finder.found(CHANGER_URI).await;
        let mut times = [(); 2].map(|()| (Times::default(), Times::default()));
        for _ in 0..runs {
            for (at, times) in times.iter_mut().enumerate() {
                let (found, ready) = lock(&finder, &simulators, at).await;
                times.0.add(found);
                times.1.add(ready);
            }
        }
        for (one, (found, ready)) in TOOLS.iter().zip(&mut times) {
            row(one, "lock of the tool", found);
            let what = "the changer reads the lock, until it has read the states of its skills";
            println!("| {} | {what} | {} | - |", one.name, figures(ready));
        }
        run("DetachTool", Vec::new()).await;
    });
    Some(())
}

fn row(one: &PlantComponent, since: &str, times: &mut Times) {
    let (name, paper) = (one.name, one.paper);
    println!("| {name} | {since} | {} | {paper} |", figures(times));
}

/// Returns the mean, the median and the highest of the times in ms, as cells of a table.
fn figures(times: &mut Times) -> String {
    let all = [times.mean(), times.at(0.5), times.at(1.0)];
    all.map(|time| format!("{:.0}", time / 1e3)).join(" | ")
}

/// Locks a tool, which puts the other one back. Returns the times from the lock until its skills
/// are found, and until the changer has read their states.
async fn lock(finder: &Finder, simulators: &[Child], at: usize) -> (Duration, Duration) {
    let tool = &TOOLS[at];
    finder.gone(tool.uri).await;
    let given = vec![("ToolAppUri".to_owned(), SkillValue::from(tool.uri))];
    let (found, outcome) = tokio::join!(finder.found(tool.uri), run("ChangeTool", given));
    let line = format!("tool {} is locked", at + 1);
    let locked = simulators.iter().flat_map(|one| one.times_of(&line)).max();
    // The trace has `URI is ready N ms after it was locked`.
    let before = format!("{} is ready ", tool.uri);
    let noted = outcome.trace.iter().find_map(|line| {
        let (_, after) = line.split_once(&before)?;
        after.split(' ').next()?.parse().ok()
    });
    let ready = noted.unwrap_or_else(|| panic!("{:?}", outcome.trace));
    (found - locked.unwrap(), Duration::from_millis(ready))
}

/// Runs a skill of the tool changer.
async fn run(skill: &str, given: Vec<(String, SkillValue)>) -> RunOutcome {
    let client = SkillClient::connect(CHANGER, &ClientOptions::default()).await;
    let client = client.unwrap();
    let all = client.skills().await.unwrap();
    let found = all.iter().find(|one| one.name == skill).unwrap();
    let outcome = client.handle(found).run(given, SOON).await.unwrap();
    client.close().await;
    assert!(outcome.succeeded, "{skill}: {}", outcome.message);
    outcome
}

/// Finds skills as a component does that depends on others.
struct Finder {
    detector: Detector,
    task: JoinHandle<()>,
}

impl Finder {
    fn start() -> Self {
        let detector = Detector::new(ClientOptions::default());
        let settings = WatchSettings {
            mdns: Some(MdnsInterface::LOOPBACK),
            ..WatchSettings::default()
        };
        let mut watcher = watch(settings).unwrap();
        let index = detector.clone();
        let task = tokio::spawn(async move {
            while let Some(change) = watcher.next().await {
                let known = change.known();
                match &change {
                    ServerChange::Gone { .. } => index.gone(&known.name),
                    ServerChange::Seen(_) => index.seen(&known.name, &known.url),
                    ServerChange::Restarted(_) => {
                        index.gone(&known.name);
                        index.seen(&known.name, &known.url);
                    }
                }
            }
        });
        Self { detector, task }
    }

    /// Waits until the skills of a component are found, and returns when that was.
    async fn found(&self, uri: &str) -> Instant {
        let any = ParameterType::own("SkillType");
        let is_it = |one: &skills::Detected| one.application_uri == uri;
        let found = self.detector.one(&any, SOON, is_it).await;
        let at = Instant::now();
        found.unwrap_or_else(|fault| panic!("{uri}: {fault}"));
        at
    }

    /// Waits until the skills of a component are not found any more.
    async fn gone(&self, uri: &str) {
        let mut changes = self.detector.changes();
        let gone = async {
            let is_there = || {
                let all = self.detector.all();
                all.iter().any(|one| one.application_uri == uri)
            };
            while is_there() {
                changes.changed().await.unwrap();
            }
        };
        let waited = timeout(SOON, gone).await;
        waited.unwrap_or_else(|_| panic!("{uri} is still found after {SOON:?}"));
    }
}

impl Drop for Finder {
    fn drop(&mut self) {
        self.task.abort();
    }
}

fn yaml(name: &str) -> PathBuf {
    let examples = Path::new(env!("CARGO_MANIFEST_DIR")).join("../examples/plant");
    examples.join(format!("{name}.yaml"))
}

fn start(name: &str) -> Child {
    StartedChild::new(name, &program("ua-component"))
        .args([yaml(name)])
        .args(FLAGS)
        .start()
}

/// Starts the simulated devices. The changer supplies the programs of the tools.
fn simulators(boot: usize) -> Vec<Child> {
    let boot = boot.to_string();
    let mut changer = vec!["kelvin-tool-changer".to_owned()];
    for (number, (tool, dock)) in (1..).zip(TOOLS.iter().zip(DOCKS)) {
        let program = program("ua-component");
        let command = [
            format!("{number}={}", program.display()),
            yaml(tool.name).display().to_string(),
            FLAGS.join(" "),
        ];
        changer.extend(["--tool".to_owned(), format!("{number}@{dock}")]);
        changer.extend(["--power".to_owned(), command.join(" ")]);
    }
    changer.extend(["--boot-delay".to_owned(), boot]);
    let robots = ["universal-robot", "robotiq-2f85", "schmalz-ecbpi"];
    let fast = |name: &str| [name, "--speed", SPEED].map(str::to_owned).to_vec();
    let all = robots.map(fast).into_iter().chain([changer]);
    let started = all.map(|arguments| {
        let mut child = StartedChild::new(&arguments[0], &program("ua-component"))
            .args(["simulate".to_owned()])
            .args(&arguments)
            .start();
        child.wait_for_line(" at ", SOON);
        child
    });
    started.collect()
}

const FLAGS: [&str; 4] = ["--lds", "none", "--interface", "lo"];
const CHANGER: &str = "opc.tcp://127.0.0.1:14840";
/// The docks of `examples/plant/tool-changer.yaml`.
const DOCKS: [&str; 2] = ["0.3,0.35,0.2,0,0,0", "-0.3,0.35,0.2,0,0,0"];
/// How many times faster than time the devices move.
const SPEED: &str = "16";
const SOON: Duration = Duration::from_secs(60);
