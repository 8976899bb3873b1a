//! Scenarios with simulated robots and the released programs: the fault-tolerant product assembly
//! line with skills, the same line with topics, plug and produce, the tool change, a batch, the
//! insertion of fuses, terminal blocks on a rail, and a process with two tools.
//!
//! All processes of the demo use the same binary. Without a subcommand it starts the others, which
//! are hidden subcommands, and the other programs in its directory. The robots and the components
//! communicate through the space only; their standard output is for the timeline.
//!
//! Reading order:
//!
//! - `robots::niryo` and `robots::turtlebot`: the logic of the robots
//! - `line`: their shared values
//! - `supervisor` and `orchestra`: the OPC UA client, and the process that starts and watches all
//!   others
//! - `skilled`, `plug`, `tools`, `batch`, `fuses`, `terminals` and `tool_process`: the other
//!   scenarios
//! - `stage`: the shared parts of the scenarios

mod batch;
mod clock;
mod event;
mod fuses;
mod line;
mod master;
mod orchestra;
mod pace;
mod plug;
mod robots;
mod ros2;
mod skilled;
mod stage;
mod stop;
mod supervisor;
mod terminals;
mod tool_process;
mod tools;

use std::io::Write as _;
use std::path::PathBuf;
use std::process::ExitCode;

use clap::{Args, Parser, Subcommand};

use crate::orchestra::OrchestraOptions;
use crate::pace::Speed;

/// Plays a story with simulated robots on this machine. Nothing leaves the loopback interface.
#[derive(Debug, Parser)]
#[command(name = "demo", version, args_conflicts_with_subcommands = true)]
struct Arguments {
    #[command(subcommand)]
    role: Option<Role>,
    #[command(flatten)]
    plan: PlanArguments,
}

#[derive(Debug, Args)]
struct PlanArguments {
    /// Which story
    #[arg(long, value_enum, default_value_t = Scenario::AssemblyLine)]
    scenario: Scenario,
    /// Divides all times of the robots' and components' work
    #[arg(long, value_name = "FACTOR", default_value = "1")]
    speed: Speed,
    /// Of both lines: how many covers lie in the storage
    #[arg(long, value_name = "N", default_value_t = 4, value_parser = clap::value_parser!(u32).range(1..=1000))]
    covers: u32,
    /// Of the line by topics: the second of the story at which the supervisor switches the conveyor off
    #[arg(long, value_name = "SECONDS", default_value = "25", value_parser = seconds)]
    conveyor_off_at: f64,
    /// Of plug and produce: the manifest (MTP) of the module that is imported, in place of that of the example plant
    #[arg(long, value_name = "FILE")]
    manifest: Option<PathBuf>,
    /// Of the tool change and the process: the tools are in each other's docks
    #[arg(long)]
    swap_tools: bool,
    /// Of the process: how often it runs
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=1000))]
    runs: u32,
    /// Open the page of the cell in a browser
    #[arg(long)]
    open: bool,
    /// Print one JSON object on standard output, and the timeline on standard error
    #[arg(long)]
    json: bool,
}

/// A story.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum Scenario {
    /// A composite of skills that are done by robots of both ROS; its conveyor dies
    AssemblyLine,
    /// The line without skills: a ROS 1 arm and a ROS 2 robot that know one another through topics of the space alone
    LineByTopics,
    /// Components that are plugged in, found, started from ROS, run by the MES, lost and replaced
    PlugAndProduce,
    /// A robot that changes its tools, with devices behind their protocols; one is lost and plugged in again
    ToolChange,
    /// Three simulated process modules that a recipe of BatchML runs: dose, stir and react
    Batch,
    /// An arm that inserts a fuse with a limited force and tries again; then an arm of another make
    /// does the same
    Fuses,
    /// A robot, a tool changer and a gripper that place terminal blocks onto a rail
    Terminals,
    /// A process of the graph that moves a part and a cover with two tools; a tool is unplugged
    Process,
}

/// The demo's own processes.
#[derive(Debug, Subcommand)]
enum Role {
    #[command(hide = true)]
    Master,
    #[command(hide = true)]
    Niryo {
        #[arg(long)]
        covers: u32,
        #[arg(long)]
        speed: Speed,
    },
    #[command(hide = true)]
    Turtlebot {
        #[arg(long)]
        speed: Speed,
    },
    #[command(hide = true)]
    Supervisor {
        #[arg(long, value_parser = seconds)]
        conveyor_off_at: f64,
        #[arg(long)]
        speed: Speed,
        #[arg(long)]
        pki: PathBuf,
    },
    #[command(hide = true)]
    Ros1Node,
    #[command(hide = true)]
    Ros2Node,
    #[command(hide = true)]
    LineArm {
        #[arg(long)]
        speed: Speed,
    },
    #[command(hide = true)]
    LineBelt,
    #[command(hide = true)]
    LineBase {
        #[arg(long)]
        speed: Speed,
    },
}

fn seconds(text: &str) -> Result<f64, &'static str> {
    let seconds: f64 = text.parse().map_err(|_| "not a number")?;
    if (0.0..=86_400.0).contains(&seconds) {
        Ok(seconds)
    } else {
        Err("from 0 to 86400 seconds")
    }
}

fn main() -> ExitCode {
    let arguments = match Arguments::try_parse() {
        Ok(arguments) => arguments,
        Err(error) => {
            let code = if error.use_stderr() { USAGE } else { 0 };
            // If nothing can be printed, the exit code still reports the error.
            error.print().ok();
            return ExitCode::from(code);
        }
    };
    let runtime = match tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
    {
        Ok(runtime) => runtime,
        Err(error) => return complain(&anyhow::Error::new(error)),
    };
    match arguments.role {
        None => ExitCode::from(play(arguments.plan, &runtime)),
        Some(role) => match runtime.block_on(Box::pin(play_role(role))) {
            Ok(()) => ExitCode::SUCCESS,
            Err(error) => complain(&error),
        },
    }
}

/// Plays a story. Returns the exit code.
fn play(plan: PlanArguments, runtime: &tokio::runtime::Runtime) -> u8 {
    let PlanArguments {
        scenario,
        speed,
        covers,
        conveyor_off_at,
        manifest,
        swap_tools,
        runs,
        open,
        json,
    } = plan;
    match scenario {
        Scenario::LineByTopics => {
            let plan = OrchestraOptions {
                covers,
                speed,
                conveyor_off_at,
                open,
                json,
            };
            runtime.block_on(Box::pin(orchestra::play(plan)))
        }
        Scenario::PlugAndProduce => {
            let plan = plug::PlugOptions {
                speed,
                open,
                json,
                manifest,
            };
            runtime.block_on(Box::pin(plug::play(plan)))
        }
        Scenario::AssemblyLine => {
            let plan = skilled::SkilledOptions {
                covers,
                speed,
                open,
                json,
            };
            runtime.block_on(Box::pin(skilled::play(plan)))
        }
        Scenario::Batch => {
            let plan = batch::BatchOptions { speed, json };
            runtime.block_on(Box::pin(batch::play(plan)))
        }
        Scenario::Fuses => {
            let plan = fuses::FusesOptions { speed, json };
            runtime.block_on(Box::pin(fuses::play(plan)))
        }
        Scenario::Terminals => {
            let plan = terminals::TerminalsOptions { speed, json };
            runtime.block_on(Box::pin(terminals::play(plan)))
        }
        Scenario::Process => {
            let plan = tool_process::ProcessOptions {
                speed,
                json,
                runs,
                swapped: swap_tools,
            };
            runtime.block_on(Box::pin(tool_process::play(plan)))
        }
        Scenario::ToolChange => {
            let plan = tools::ToolsOptions {
                speed,
                open,
                json,
                swapped: swap_tools,
            };
            runtime.block_on(Box::pin(tools::play(plan)))
        }
    }
}

async fn play_role(role: Role) -> anyhow::Result<()> {
    // RustDDS logs at level error during every regular shutdown.
    let filter = tracing_subscriber::EnvFilter::new("info,rustdds=off,ros2_client=warn,opcua=warn");
    tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_writer(std::io::stderr)
        .init();
    match role {
        Role::Master => master::run().await,
        Role::Niryo { covers, speed } => robots::niryo_node::run(covers, speed).await,
        Role::Turtlebot { speed } => robots::turtlebot_node::run(speed).await,
        Role::Supervisor {
            conveyor_off_at,
            speed,
            pki,
        } => supervisor::run(speed.real(conveyor_off_at), pki).await,
        Role::Ros1Node => Box::pin(plug::ros1_node::run()).await,
        Role::Ros2Node => Box::pin(plug::ros2_node::run()).await,
        Role::LineArm { speed } => skilled::arm_node::run(speed).await,
        Role::LineBelt => skilled::belt_node::run().await,
        Role::LineBase { speed } => Box::pin(skilled::base_node::run(speed)).await,
    }
}

fn complain(error: &anyhow::Error) -> ExitCode {
    // If nothing can be printed, the exit code still reports the error.
    writeln!(std::io::stderr(), "error: {error:#}").ok();
    ExitCode::FAILURE
}

/// `EX_USAGE` of `sysexits.h`.
const USAGE: u8 = 64;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_arguments_are_as_clap_wants_them() {
        use clap::CommandFactory as _;
        Arguments::command().debug_assert();
    }

    #[test]
    fn what_makes_no_story_is_refused() {
        for arguments in [
            ["--covers", "0"],
            ["--speed", "0"],
            ["--conveyor-off-at", "-1"],
            ["--conveyor-off-at", "nan"],
        ] {
            let refused = Arguments::try_parse_from(["demo"].into_iter().chain(arguments));
            assert!(refused.is_err(), "{arguments:?}");
        }
    }
}
