//! The commands of the project: `cargo xtask <verb>`.
#![expect(
    clippy::print_stdout,
    clippy::print_stderr,
    reason = "a command line speaks to the person who typed it"
)]

mod bench;
mod chart;
mod counts;
mod demo;
mod dist;
mod docs;
mod help;
mod instructions;
mod links;
mod lint;
mod markdown;
mod module;
mod namespace;
mod page;
mod patches;
mod peers;
mod shell;
mod test;
mod workspace;

use std::process::ExitCode;

use crate::{shell::CommandOutcome, workspace::Workspace};

const VERBS: &str = "\
cargo xtask <verb>

  demo [ARGS]                    build the programs and run the assembly line; ARGS go to it (--help lists them)
  test [--no-install] [--shm] [FILTER..]
                                 install the peers of the tests (apt, pip), then run all tests whose name contains a FILTER;
                                 --shm builds the programs with messages in shared memory (needs libclang)
  page                           drive the page of the cell in Chromium (apt, pip); screenshots are in target/page
  mtp2                           judge our reader and executor of MTP 2.0 by MTPPy2.0 (pip; needs Python 3.13)
  rml                            count the published cases of RML that `ua-space rml` and morph-kgc pass (pip; needs UA_DATA)
  peers [--build]                only install the peers; of those only what the programs are built with
  lint [--dependencies]          formatting, clippy, documentation; or licences, sources and advisories of dependencies, and the
                                 workspace with all crates as published
  build [--example NAME]         build the programs without optimisation into target/debug, with the links of ua-bridge;
                                 and an example of ua-component, as own_component, into target/debug/examples
  dist [--deb] [--rpm] [--tar] [--container] [--program FILE]
                                 build the programs that are handed out, with optimisation, into target/dist, with the links;
                                 or packages of them with units, manual pages and completions (docs/packages.md)
  docs [--check] [--no-build]    build the programs and write docs/reference from them; or only check that its pages are current
  patches [--test]               only patch the crates of patches/, which all verbs build with, and print the flags to do so by hand;
                                 or run the tests that the patches add, which `test` leaves out
  soak [HOURS]                   run all programs of a cell with a random fault each minute, 2 hours unless told
  bench hop [ARGS]               measure one hop beside the floor and roscpp's relay
  bench ros1 [ARGS]              measure relays of ROS 1 messages beside a raw echo; bridge-ros1 with 50 topics (--help)
  bench ros2 [ARGS]              measure relays of DDS samples beside a UDP echo; both bridges from ROS 1 to ROS 2 and back
  bench work [ARGS]              count system calls, wake-ups and CPU of both bridges per message, and of idle programs (perf)
  bench images [ARGS]            measure images and point clouds through both bridges beside Fast DDS and Cyclone DDS over UDP
  bench opcua [ARGS]             measure ua-server beside servers of asyncua and node-opcua, and what comes from the space to clients
  bench redundancy [FAULTS]      measure the gaps of random faults of two redundant bridges at 1 kHz, 200 unless told
  bench knowledge [ARGS]         measure manifests, NodeSets, questions, the journal and plans of the knowledge of the plant
  bench mqtt [ROUND_TRIPS]       measure round trips over an MQTT broker beside those of paho
  bench plant [CELLS]            measure many cells at one MQTT broker, 100 cells of 1000 topics unless told
  bench skills [ARGS]            measure what clients wait for of skills and of servers that are plugged in (finding), round trips (rtt), and locked tools (lock)
  bench charts [--check]         draw the pictures of docs/benchmarks.md from its tables; or only check that they are current
  bench uadp [--instructions]    measure the codec beside another one; only count instructions and hold them against the list
  bench bridge-core [--instructions]  measure a message among 10 and among 10 000 topics; only count instructions
  bench messages [--instructions]  measure messages on their way to fields and back, beside memcpy, a tree of values and Python
";

fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let arguments: Vec<&str> = arguments.iter().map(String::as_str).collect();
    match run(&arguments) {
        Ok(ended) => ended.into(),
        Err(error) => {
            eprintln!("xtask: {error:#}");
            ExitCode::FAILURE
        }
    }
}

fn run(arguments: &[&str]) -> anyhow::Result<CommandOutcome> {
    match arguments {
        [] | ["help" | "--help" | "-h"] => {
            print!("{VERBS}");
            Ok(CommandOutcome::WELL)
        }
        ["demo", rest @ ..] => demo::run(&Workspace::find()?, rest),
        ["test", rest @ ..] => test::run(&Workspace::find()?, rest),
        ["mtp2"] => module::run(&Workspace::find()?),
        ["rml"] => module::rml(&Workspace::find()?),
        ["page"] => page::run(&Workspace::find()?),
        ["peers"] => Ok(peers::run(&Workspace::find()?)),
        ["peers", "--build"] => peers::for_building(),
        ["build"] => dist::build(&Workspace::find()?, None),
        ["build", "--example", name] => dist::build(&Workspace::find()?, Some(name)),
        ["dist", rest @ ..] => dist::run(&Workspace::find()?, rest),
        ["docs", rest @ ..] => docs::run(&Workspace::find()?, rest),
        ["patches"] => patches::run(&Workspace::find()?),
        ["patches", "--test"] => test::of_all_patches(&Workspace::find()?),
        ["lint"] => lint::run(&Workspace::find()?),
        ["lint", "--dependencies"] => lint::dependencies(&Workspace::find()?),
        ["bench", of @ ("uadp" | "bridge-core"), rest @ ..] => {
            instructions::run(&Workspace::find()?, of, rest, |_| Ok(()))
        }
        ["bench", "charts", rest @ ..] => chart::run(&Workspace::find()?, rest),
        ["bench", "messages", rest @ ..] => bench::messages(&Workspace::find()?, rest),
        ["bench", "hop", rest @ ..] => bench::hop(&Workspace::find()?, rest),
        ["bench", "ros1", rest @ ..] => bench::ros1(&Workspace::find()?, rest),
        ["bench", part @ ("work" | "images"), rest @ ..] => {
            let arguments = [&[*part], rest].concat();
            bench::ros2(&Workspace::find()?, &arguments)
        }
        ["bench", "knowledge", rest @ ..] => bench::knowledge(&Workspace::find()?, rest),
        ["bench", "opcua", rest @ ..] => bench::opcua(&Workspace::find()?, rest),
        ["bench", "redundancy", rest @ ..] => bench::redundancy(&Workspace::find()?, rest),
        ["soak", rest @ ..] => bench::soak(&Workspace::find()?, rest),
        ["bench", "mqtt", rest @ ..] => bench::mqtt(&Workspace::find()?, rest),
        ["bench", "plant", rest @ ..] => bench::plant(&Workspace::find()?, rest),
        ["bench", "skills", rest @ ..] => bench::skills(&Workspace::find()?, rest),
        ["bench", "ros2", rest @ ..] => bench::ros2(&Workspace::find()?, rest),
        _ => {
            eprint!("xtask: there is no `{}`\n\n{VERBS}", arguments.join(" "));
            Ok(CommandOutcome::USAGE)
        }
    }
}
