//! The programs of the soak, and their faults.

use std::process::Command;
use std::thread::sleep;
use std::time::{Duration, Instant};

use nix::sys::signal::Signal;
use system_tests::{
    Cell, Child, METRICS_ROS1, METRICS_ROS2, METRICS_SERVER, StartedChild, WallClock, anonymous,
    eventually, http_answer, program,
};

/// A fault of a round.
#[derive(Debug, Clone, Copy)]
pub(crate) enum RoundFault {
    Killed,
    Stopped,
    Cut,
    ClockJump,
    Reloaded,
    SwitchedOver,
    BrokerKilled,
    /// Ended and started again, as an upgrade of the package does.
    Upgraded,
}

impl RoundFault {
    pub(crate) const ALL: [Self; 8] = [
        Self::Killed,
        Self::Stopped,
        Self::Cut,
        Self::ClockJump,
        Self::Reloaded,
        Self::SwitchedOver,
        Self::BrokerKilled,
        Self::Upgraded,
    ];
}

/// A deterministic sequence of random numbers.
pub(crate) struct Random(pub(crate) u64);

impl Random {
    pub(crate) fn below(&mut self, limit: u64) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut mixed = self.0;
        mixed = (mixed ^ (mixed >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        mixed = (mixed ^ (mixed >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        (mixed ^ (mixed >> 31)) % limit
    }
}

/// A program of the project.
pub(crate) struct SoakProgram<'c> {
    pub(crate) name: &'static str,
    metrics: &'static str,
    start: Box<dyn Fn() -> StartedChild + 'c>,
    child: Option<Child>,
    /// Memory since the last start.
    memory: Vec<(Instant, u64)>,
    /// The growth of memory in percent an hour, over the longest time without a restart.
    pub(crate) growth: Option<(Duration, f64)>,
}

impl SoakProgram<'_> {
    fn launch(&mut self) {
        self.note_growth();
        self.memory.clear();
        self.child = Some((self.start)().start());
    }

    fn child(&self) -> &Child {
        self.child.as_ref().unwrap()
    }

    /// Records the memory of the program.
    pub(crate) fn sample(&mut self) {
        let used = anonymous(self.child().id());
        self.memory.push((Instant::now(), used));
    }

    /// Computes the growth of memory since the last start. The first samples are the start.
    pub(crate) fn note_growth(&mut self) {
        let samples = self.memory.get(WARM_UP..).unwrap_or_default();
        let (Some(first), Some(last)) = (samples.first(), samples.last()) else {
            return;
        };
        let span = last.0 - first.0;
        if span < SHORTEST || self.growth.is_some_and(|(longest, _)| longest >= span) {
            return;
        }
        self.growth = Some((span, slope(samples) / first.1 as f64 * 100.0));
    }

    fn is_ready(&self) -> bool {
        matches!(http_answer(self.metrics, "/readyz"), Some((200, _)))
    }
}

/// Returns the slope of a line through the samples, in bytes an hour.
fn slope(samples: &[(Instant, u64)]) -> f64 {
    let start = samples[0].0;
    let points: Vec<(f64, f64)> = samples
        .iter()
        .map(|(at, bytes)| ((*at - start).as_secs_f64() / 3600.0, *bytes as f64))
        .collect();
    let count = points.len() as f64;
    let x = points.iter().map(|(x, _)| x).sum::<f64>() / count;
    let y = points.iter().map(|(_, y)| y).sum::<f64>() / count;
    let of = points
        .iter()
        .map(|(px, py)| (px - x) * (py - y))
        .sum::<f64>();
    let by = points.iter().map(|(px, _)| (px - x).powi(2)).sum::<f64>();
    if by == 0.0 { 0.0 } else { of / by }
}

/// All programs.
pub(crate) struct SoakPlant<'c> {
    cell: &'c Cell,
    pub(crate) programs: Vec<SoakProgram<'c>>,
    broker: Option<Child>,
    clock: &'c WallClock,
}

impl<'c> SoakPlant<'c> {
    /// Starts the bridges of ROS 1 and ROS 2, two of each, a server that also forwards to a broker,
    /// the broker, a discovery server, a component and an MES that runs its skill.
    pub(crate) fn start(cell: &'c Cell, clock: &'c WallClock) -> Self {
        let mapping = cell.file("cell.yaml", MAPPING).display().to_string();
        let server = cell.file("server.yaml", SERVER).display().to_string();
        let broker = Some(cell.mosquitto());
        let mut programs: Vec<SoakProgram<'c>> = Vec::new();
        let mut add = |name, metrics, start: Box<dyn Fn() -> StartedChild + 'c>| {
            programs.push(SoakProgram {
                name,
                metrics,
                start,
                child: None,
                memory: Vec::new(),
                growth: None,
            });
        };
        for (name, rank, metrics) in [
            ("bridge-ros1 1", "1", METRICS_ROS1),
            ("bridge-ros1 2", "2", "127.0.0.1:9111"),
        ] {
            let mapping = mapping.clone();
            let start = move || {
                cell.bridge_ros1_at(&[&mapping, "--rank", rank], metrics)
                    .by(clock)
            };
            add(name, metrics, Box::new(start));
        }
        for (name, rank, metrics) in [
            ("bridge-ros2 1", "1", METRICS_ROS2),
            ("bridge-ros2 2", "2", "127.0.0.1:9112"),
        ] {
            let mapping = mapping.clone();
            let start = move || {
                let arguments = [&mapping[..], "--rank", rank, "--domain", "2"];
                cell.bridge_ros2_at(&arguments, metrics).by(clock)
            };
            add(name, metrics, Box::new(start));
        }
        let start = move || cell.ua_server_started(&[&server]).by(clock);
        add("ua-server", METRICS_SERVER, Box::new(start));
        let start = move || {
            StartedChild::new("ua-lds", &program("ua-lds"))
                .args([
                    "--interface",
                    "lo",
                    "--endpoint",
                    "opc.tcp://127.0.0.1:4841",
                ])
                .args(["--metrics", METRICS_LDS])
                .by(clock)
        };
        add("ua-lds", METRICS_LDS, Box::new(start));
        let gripper = cell.file("gripper.yaml", GRIPPER).display().to_string();
        let start = move || {
            StartedChild::new("ua-component", &program("ua-component"))
                .args([&gripper[..], "--interface", "lo", "--lds", "none"])
                .args(["--endpoint", "opc.tcp://127.0.0.1:4842"])
                .args(["--metrics", METRICS_COMPONENT])
                .by(clock)
        };
        add("ua-component", METRICS_COMPONENT, Box::new(start));
        let mes = cell.file("mes.yaml", MES).display().to_string();
        let start = move || {
            StartedChild::new("ua-mes", &program("ua-mes"))
                .args([&mes[..], "--interface", "lo", "--lds", "none"])
                .args(["--metrics", METRICS_MES])
                .by(clock)
        };
        add("ua-mes", METRICS_MES, Box::new(start));
        for program in &mut programs {
            program.launch();
        }
        Self {
            cell,
            programs,
            broker,
            clock,
        }
    }

    /// Waits until all programs are ready. Returns the time that it took.
    pub(crate) fn heal(&self) -> Duration {
        let start = Instant::now();
        for program in &self.programs {
            eventually(&format!("{} is ready", program.name), SOON, || {
                program.is_ready().then_some(())
            });
        }
        start.elapsed()
    }

    /// Starts the process of the MES, with `ua-space` that ends when it has ended.
    pub(crate) fn start_process() -> Child {
        StartedChild::new("ua-space", &program("ua-space"))
            .args(["skills", "start", "mes.ExecuteProcess"])
            .args(["ProcessIri=urn:soak:hold", "--interface", "lo"])
            .start()
    }

    /// Causes a fault. Returns its description.
    pub(crate) fn strike(&mut self, fault: RoundFault, random: &mut Random) -> String {
        let count = u64::try_from(self.programs.len()).unwrap();
        let at = usize::try_from(random.below(count)).unwrap();
        let name = self.programs[at].name;
        match fault {
            RoundFault::Killed => {
                let program = &mut self.programs[at];
                let mut child = program.child.take().unwrap();
                child.signal(Signal::SIGKILL);
                child.wait_for_end(SOON);
                sleep(Duration::from_millis(random.below(3_000)));
                program.launch();
                format!("kill -9 of {name}")
            }
            RoundFault::Stopped => {
                let time = Duration::from_millis(200 + random.below(5_000));
                self.programs[at].child().signal(Signal::SIGSTOP);
                sleep(time);
                self.programs[at].child().signal(Signal::SIGCONT);
                format!("SIGSTOP of {name} for {time:?}")
            }
            RoundFault::Cut => {
                let time = Duration::from_millis(500 + random.below(3_000));
                ip(&["link", "set", "lo", "down"]);
                sleep(time);
                ip(&["link", "set", "lo", "up"]);
                ip(&["route", "replace", "224.0.0.0/4", "dev", "lo"]);
                format!("network cut for {time:?}")
            }
            RoundFault::ClockJump => {
                let seconds = i64::try_from(random.below(7_200)).unwrap() - 3_600;
                self.clock.set(seconds);
                format!("clocks of all programs set to {seconds} s beside the time")
            }
            RoundFault::Reloaded => {
                let name = format!("# {}\n{MAPPING}", random.below(u64::MAX));
                let _mapping = self.cell.file("cell.yaml", &name);
                for program in &self.programs[..4] {
                    program.child().signal(Signal::SIGHUP);
                }
                "reload of the mapping by all bridges".to_owned()
            }
            RoundFault::SwitchedOver => {
                let at = at % 4;
                self.programs[at].child().signal(Signal::SIGUSR1);
                format!("switch-over asked of {}", self.programs[at].name)
            }
            RoundFault::BrokerKilled => {
                if let Some(broker) = self.broker.take() {
                    broker.signal(Signal::SIGKILL);
                }
                sleep(Duration::from_millis(random.below(3_000)));
                self.broker = Some(self.cell.mosquitto());
                "kill -9 of the broker".to_owned()
            }
            RoundFault::Upgraded => {
                let program = &mut self.programs[at];
                let mut child = program.child.take().unwrap();
                child.signal(Signal::SIGTERM);
                child.wait_for_end(SOON);
                program.launch();
                format!("end and start of {name}, as for an upgrade")
            }
        }
    }
}

fn ip(args: &[&str]) {
    let done = Command::new("ip").args(args).status().unwrap();
    assert!(done.success(), "ip {args:?}");
}

const MAPPING: &str = "spaces: [{id: 1}, {id: 2}]\n";
const SERVER: &str = "
pubsub:
  - udp: {}
    forward: [ua_1_5, ua_2_5]
  - mqtt: {address: \"mqtt://127.0.0.1:1883\"}
spaces: [{id: 1}, {id: 2}]
namespaces: {2: urn:ua-bridge:soak}
server: {security: [None]}
";
const GRIPPER: &str = "
component: gripper
application_uri: urn:soak:gripper
namespace: 9
security: [None]
skills:
  - {name: Grasp, type: GraspSkillType, capabilities: [urn:soak:grasp], driver: {simulated: {duration: 200 ms}}}
";
const MES: &str = "
mes: mes
application_uri: urn:soak:mes
namespace: 50
endpoint: opc.tcp://127.0.0.1:4843
security: [None]
processes:
  - process: urn:soak:hold
    wait: 60 s
    steps:
      - {step: grip, needs: {skill: urn:soak:grasp}}
";
const METRICS_LDS: &str = "127.0.0.1:9104";
const METRICS_COMPONENT: &str = "127.0.0.1:9105";
const METRICS_MES: &str = "127.0.0.1:9106";
const SOON: Duration = Duration::from_secs(120);
/// Samples of memory that belong to the start of a program.
const WARM_UP: usize = 5;
/// The shortest time over which the growth of memory is computed.
const SHORTEST: Duration = Duration::from_secs(20 * 60);
