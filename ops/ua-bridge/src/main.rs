//! `ua-bridge`: the programs of the plant and the two bridges in one file.
//!
//! The program acts as `ua-server`, `ua-component` and so on. It chooses by the name under which it
//! is called, which a link sets, or by its first argument: `ua-bridge server` is `ua-server`.

mod called;
mod cell;

use std::env;
use std::ffi::OsString;
use std::io::{self, Write};
use std::process::ExitCode;

use crate::called::Called;

/// One of the programs.
struct Program {
    /// The name of its link.
    name: &'static str,
    about: &'static str,
    run: fn(Vec<OsString>) -> ExitCode,
}

/// All programs. The first argument of `ua-bridge` is a name without `ua-`.
const PROGRAMS: &[Program] = &[
    Program {
        name: "bridge-ros1",
        about: "carries topics between a ROS 1 graph and the space",
        run: bridge_ros1::entry::run,
    },
    Program {
        name: "bridge-ros2",
        about: "carries topics between a ROS 2 domain and the space",
        run: bridge_ros2::entry::run,
    },
    Program {
        name: "ua-server",
        about: "the OPC UA server of the cell",
        run: ua_server::run,
    },
    Program {
        name: "ua-cell",
        about: "both bridges and the server of a small cell in one process",
        run: cell::run,
    },
    Program {
        name: "ua-component",
        about: "a component of the cell: an OPC UA server with skills",
        run: ua_component::entry::run,
    },
    Program {
        name: "ua-lds",
        about: "a Local Discovery Server with multicast extension",
        run: discovery::ua_lds::run,
    },
    Program {
        name: "ua-gds",
        about: "the Global Discovery Server of a plant",
        run: ua_gds::run,
    },
    Program {
        name: "ua-station",
        about: "one level of a plant",
        run: ua_station::entry::run,
    },
    Program {
        name: "ua-mes",
        about: "the semantic MES",
        run: ua_mes::run,
    },
    Program {
        name: "ua-space",
        about: "shows and checks what is in the space",
        run: ua_space::run,
    },
];

fn main() -> ExitCode {
    // Writing fails when stdout or stderr is closed; the exit code still reports the outcome.
    match Called::by(env::args_os().collect()) {
        Called::Program(program, arguments) => (program.run)(arguments),
        Called::Help => {
            let _written = write!(io::stdout(), "{}", help());
            ExitCode::SUCCESS
        }
        Called::Version => {
            let _written = writeln!(io::stdout(), "ua-bridge {}", build_info::version());
            ExitCode::SUCCESS
        }
        Called::Nothing => {
            let _written = write!(io::stderr(), "{}", help());
            ExitCode::from(USAGE)
        }
        Called::Unknown(word) => {
            let word = word.to_string_lossy();
            let message = format!("error: unknown program `{}`", word.escape_debug());
            let _written = write!(io::stderr(), "{message}\n\n{}", help());
            ExitCode::from(USAGE)
        }
    }
}

fn help() -> String {
    let mut help = String::from(
        "The programs of the plant in one file\n\nUsage: ua-bridge <PROGRAM> [ARGUMENTS]\n\nPrograms (each with --help):\n",
    );
    for program in PROGRAMS {
        let word = called::word(program);
        help.push_str(&format!("  {word:<11} {}\n", program.about));
    }
    help.push_str(
        "\nA link with the name of a program acts as that program: `ln -s ua-bridge ua-server`.\n\
         `cargo xtask build` makes all links in target/debug, `cargo xtask dist` in target/dist.\n",
    );
    help
}

/// `EX_USAGE` of `sysexits.h`.
const USAGE: u8 = 64;
