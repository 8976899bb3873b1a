//! `ua-component simulate`: simulated devices behind the protocols of real devices.

use std::io::{self, Write as _};
use std::process::ExitCode;
use std::sync::Arc;
use std::time::Duration;

use devices::{LineFaults, ModbusLine, Registers, ServedDevice, kelvin, robotiq, schmalz, ur};
use skills::simulated::Hole;
use tokio::process::{Child, Command};
use tokio::signal::unix::{SignalKind, signal};
use tokio::task::JoinSet;
use tokio::time::Instant;

use crate::verb;

/// The argument that selects the simulation.
pub(crate) const VERB: &str = "simulate";

/// Simulates a device behind its protocol, until SIGINT or SIGTERM. Says on standard output where it is
#[derive(Debug, clap::Parser)]
#[command(name = "ua-component simulate", version = build_info::version())]
struct Simulate {
    #[command(subcommand)]
    device: Device,
}

#[derive(Debug, clap::Subcommand)]
enum Device {
    /// The parallel gripper 2F-85 of Robotiq: Modbus
    #[command(name = "robotiq-2f85")]
    Robotiq {
        /// tcp://host:port, rtu+tcp://host:port, or serial:PATH, which is made a link to a new pseudo-terminal
        #[arg(long, value_name = "LINE", default_value = "tcp://127.0.0.1:1502")]
        listen: ModbusLine,
        /// The number of the unit
        #[arg(long, default_value_t = robotiq::UNIT)]
        unit: u8,
        /// How wide the thing between the fingers is, m; 0 for none
        #[arg(long, value_name = "METRES", default_value_t = 0.04, value_parser = width)]
        object: f64,
        #[command(flatten)]
        pace: Pace,
    },
    /// The vacuum gripper ECBPi of Schmalz behind an IO-Link master: JSON over HTTP
    #[command(name = "schmalz-ecbpi")]
    Schmalz {
        /// host:port of the master
        #[arg(long, value_name = "ADDRESS", default_value = "127.0.0.1:8090")]
        listen: String,
        /// The alias of the gripper's port
        #[arg(long, default_value = "master1port1")]
        alias: String,
        /// There is no part below its cups
        #[arg(long)]
        no_part: bool,
        #[command(flatten)]
        pace: Pace,
    },
    /// A robot of Universal Robots: RTDE and the secondary interface
    #[command(name = "universal-robot")]
    Robot {
        /// host:port of RTDE
        #[arg(long, value_name = "ADDRESS", default_value = "127.0.0.1:30004")]
        rtde: String,
        /// host:port of the secondary interface
        #[arg(long, value_name = "ADDRESS", default_value = "127.0.0.1:30002")]
        secondary: String,
        /// The height of a surface that pushes the tool back, m
        #[arg(long, value_name = "METRES", allow_negative_numbers = true)]
        surface: Option<f64>,
        /// A hole in that surface: x, y and its radius, m
        #[arg(long, value_name = "X,Y,RADIUS", requires = "surface", allow_hyphen_values = true, value_parser = hole)]
        hole: Option<Hole>,
        #[command(flatten)]
        pace: Pace,
    },
    /// The Kelvin tool changer: an analog converter, Modbus, whose voltage follows the flange of a robot
    #[command(name = "kelvin-tool-changer")]
    Changer {
        /// tcp://host:port, rtu+tcp://host:port, or serial:PATH
        #[arg(long, value_name = "LINE", default_value = "tcp://127.0.0.1:1503")]
        listen: ModbusLine,
        /// The number of the unit
        #[arg(long, default_value_t = 1)]
        unit: u8,
        /// host:port of the robot's RTDE
        #[arg(long, value_name = "ADDRESS", default_value = "127.0.0.1:30004")]
        robot: String,
        /// A tool in its dock: its number and x, y, z (m) and the rotations about them (rad) of the flange there
        #[arg(long = "tool", value_name = "N@X,Y,Z,A,B,C", required = true, value_parser = docked, allow_hyphen_values = true)]
        tools: Vec<kelvin::simulator::Docked>,
        /// An empty dock: x, y, z (m) and the rotations about them (rad) of the flange there
        #[arg(long = "dock", value_name = "X,Y,Z,A,B,C", value_parser = empty_dock, allow_hyphen_values = true)]
        docks: Vec<kelvin::simulator::Docked>,
        /// The program of a tool, as `1=ua-component gripper.yaml`: it is started when the tool is
        /// locked, and killed when the tool is unlocked, as its supply is switched
        #[arg(long = "power", value_name = "N=COMMAND", value_parser = powered)]
        powered: Vec<Powered>,
        /// The time that a tool needs to boot, s
        #[arg(long, value_name = "SECONDS", default_value_t = 0.0, value_parser = seconds)]
        boot_delay: f64,
    },
}

#[derive(Debug, clap::Args)]
struct Pace {
    /// How many times faster than time it works
    #[arg(long, value_name = "FACTOR", default_value_t = 1.0, value_parser = factor)]
    speed: f64,
}

fn factor(text: &str) -> Result<f64, &'static str> {
    within(text, 0.01, 1000.0).ok_or("a number from 0.01 to 1000")
}

fn width(text: &str) -> Result<f64, &'static str> {
    within(text, 0.0, robotiq::STROKE).ok_or("a number from 0 to 0.085")
}

fn within(text: &str, low: f64, high: f64) -> Option<f64> {
    let number: f64 = text.parse().ok()?;
    (low..=high).contains(&number).then_some(number)
}

fn seconds(text: &str) -> Result<f64, &'static str> {
    within(text, 0.0, 600.0).ok_or("a number from 0 to 600")
}

/// The program of a tool.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Powered {
    number: u8,
    command: Vec<String>,
}

fn powered(text: &str) -> Result<Powered, &'static str> {
    let read = || {
        let (number, command) = text.split_once('=')?;
        let number = number.parse().ok();
        let number = number.filter(|number| (1..=10).contains(number))?;
        let command: Vec<String> = command.split_whitespace().map(str::to_owned).collect();
        (!command.is_empty()).then_some(Powered { number, command })
    };
    read().ok_or("a number from 1 to 10, =, and a command with its arguments")
}

fn empty_dock(text: &str) -> Result<kelvin::simulator::Docked, &'static str> {
    let tool = docked(&format!("1@{text}")).map_err(|_| "six numbers with commas")?;
    Ok(kelvin::simulator::Docked { number: 0, ..tool })
}

/// Switches the programs of tools: each runs while its tool is locked.
async fn supply(changer: kelvin::simulator::KelvinSimulator, tools: Vec<Powered>, boot: Duration) {
    let mut running: Option<(u8, Child)> = None;
    let mut locked: Option<(u8, Instant)> = None;
    loop {
        tokio::time::sleep(SUPPLY_LOOK).await;
        let now = match changer.reading() {
            kelvin::ChangerReading::Tool(number) => Some(number),
            // The contacts are still closed while the ring turns.
            kelvin::ChangerReading::Intermediate => locked.map(|(number, _)| number),
            kelvin::ChangerReading::Ready | kelvin::ChangerReading::NoTool => None,
        };
        if locked.map(|(number, _)| number) != now {
            locked = now.map(|number| (number, Instant::now()));
            if let Some(number) = now {
                report(&format!("tool {number} is locked"));
            }
            if let Some((number, mut child)) = running.take() {
                // An error means that the program has ended by itself.
                let _killed = child.kill().await;
                report(&format!("tool {number} is off"));
            }
        }
        let Some((number, since)) = locked.filter(|_| running.is_none()) else {
            continue;
        };
        let tool = tools.iter().find(|tool| tool.number == number);
        let Some(tool) = tool.filter(|_| since.elapsed() >= boot) else {
            continue;
        };
        let Some((program, arguments)) = tool.command.split_first() else {
            continue;
        };
        let started = Command::new(program)
            .args(arguments)
            .kill_on_drop(true)
            .spawn();
        match started {
            Ok(child) => {
                report(&format!("tool {number} is on"));
                running = Some((number, child));
            }
            Err(error) => {
                report(&format!(
                    "tool {number} cannot be started: {program}: {error}"
                ));
                return;
            }
        }
    }
}

/// Prints a line; an error is ignored, because standard output may be closed.
fn report(line: &str) {
    let _printed = told(line);
}

/// Interval of the checks of the supply of tools.
const SUPPLY_LOOK: Duration = Duration::from_millis(10);

fn hole(text: &str) -> Result<Hole, &'static str> {
    let read = numbers(text).map(Hole::new);
    let read = read.filter(|hole| hole.radius > 0.0);
    read.ok_or("three numbers with commas, the last above 0")
}

/// Returns numbers with commas between them, each from -10 to 10.
fn numbers<const N: usize>(text: &str) -> Option<[f64; N]> {
    let numbers = text.split(',').map(|part| within(part, -10.0, 10.0));
    let numbers: Vec<f64> = numbers.collect::<Option<_>>()?;
    numbers.try_into().ok()
}

fn docked(text: &str) -> Result<kelvin::simulator::Docked, &'static str> {
    let read = || {
        let (number, dock) = text.split_once('@')?;
        let number = number
            .parse()
            .ok()
            .filter(|number| (1..=10).contains(number))?;
        let dock = numbers(dock)?;
        Some(kelvin::simulator::Docked { number, dock })
    };
    read().ok_or("a number from 1 to 10, @, and six numbers with commas")
}

/// Simulates the device of the arguments. `arguments` begin with `simulate`.
pub(crate) fn run(arguments: impl Iterator<Item = std::ffi::OsString>) -> ExitCode {
    verb::run(arguments, |simulate: Simulate| simulated(simulate.device))
}

async fn simulated(device: Device) -> io::Result<()> {
    let (mut interrupt, mut terminate) = (
        signal(SignalKind::interrupt())?,
        signal(SignalKind::terminate())?,
    );
    // The simulated device stops when this value is dropped.
    let _served: Box<dyn std::any::Any> = match device {
        Device::Robotiq {
            listen,
            unit,
            object,
            pace,
        } => {
            let settings = robotiq::simulator::RobotiqSettings {
                object: (object > 0.0).then_some(object),
                time_scale: pace.speed,
            };
            let simulator = robotiq::simulator::RobotiqSimulator::new(settings);
            Box::new(modbus("robotiq-2f85", &listen, unit, Arc::new(simulator)).await?)
        }
        Device::Schmalz {
            listen,
            alias,
            no_part,
            pace,
        } => {
            let settings = schmalz::simulator::SchmalzSettings {
                alias,
                part: !no_part,
                time_scale: pace.speed,
            };
            let simulator = schmalz::simulator::SchmalzSimulator::new(settings);
            let serving = schmalz::simulator::ServedMaster::start(&simulator, &listen).await?;
            told(&format!("schmalz-ecbpi at http://{}", serving.address()))?;
            Box::new(serving)
        }
        Device::Robot {
            rtde,
            secondary,
            surface,
            hole,
            pace,
        } => {
            let settings = ur::simulator::UrSimulatorSettings {
                time_scale: pace.speed,
                surface,
                hole,
                ..ur::simulator::UrSimulatorSettings::default()
            };
            let simulator = ur::simulator::UrSimulator::new(settings);
            let serving = ur::simulator::ServedRobot::start(&simulator, &rtde, &secondary).await?;
            let (rtde, secondary) = (serving.rtde(), serving.secondary());
            let at = format!("universal-robot at rtde {rtde}, secondary {secondary}");
            told(&at)?;
            Box::new(serving)
        }
        Device::Changer {
            listen,
            unit,
            robot,
            tools,
            docks,
            powered,
            boot_delay,
        } => {
            let docks = tools.into_iter().chain(docks).collect();
            let simulator = kelvin::simulator::KelvinSimulator::new(docks);
            let boot = Duration::from_secs_f64(boot_delay);
            let mut supplying = JoinSet::new();
            supplying.spawn(supply(simulator.clone(), powered, boot));
            let following = simulator.follow(&robot);
            let serving = modbus("kelvin-tool-changer", &listen, unit, Arc::new(simulator)).await?;
            Box::new((serving, following, supplying))
        }
    };
    tokio::select! {
        _ = interrupt.recv() => {}
        _ = terminate.recv() => {}
    }
    Ok(())
}

async fn modbus(
    name: &str,
    listen: &ModbusLine,
    unit: u8,
    registers: Arc<dyn Registers>,
) -> io::Result<ServedDevice> {
    let serving = ServedDevice::start(listen, unit, registers, LineFaults::default()).await?;
    told(&format!("{name} at {} unit {unit}", serving.line()))?;
    Ok(serving)
}

fn told(line: &str) -> io::Result<()> {
    let mut out = io::stdout().lock();
    writeln!(out, "{line}")?;
    out.flush()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_arguments_are_as_clap_wants_them() {
        use clap::CommandFactory as _;
        Simulate::command().debug_assert();
    }

    #[test]
    fn a_hole_is_read() {
        assert_eq!(hole("0.4,-0.15,0.002"), Ok(Hole::new([0.4, -0.15, 0.002])));
        for wrong in ["", "0.4,0.1", "0.4,0.1,0", "0.4,0.1,0.1,0.1"] {
            assert!(hole(wrong).is_err(), "{wrong}");
        }
    }

    #[test]
    fn a_tool_in_its_dock_is_read() {
        let tool = docked("2@-0.3,0.3,0.2,0,0,0.5").unwrap();
        assert_eq!(
            (tool.number, tool.dock),
            (2, [-0.3, 0.3, 0.2, 0.0, 0.0, 0.5])
        );
        for wrong in [
            "",
            "2",
            "0@0,0,0,0,0,0",
            "11@0,0,0,0,0,0",
            "1@0,0,0,0,0",
            "1@0,0,0,0,0,nan",
        ] {
            assert!(docked(wrong).is_err(), "{wrong}");
        }
    }
}
