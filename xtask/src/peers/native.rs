//! The compiled peers: Fast DDS, Cyclone DDS and roscpp with their own libraries, from
//! `tests/peers/dds` and `tests/peers/calls`, and the library that shifts clocks, from
//! `tests/peers/clock`.

use std::{fs, path::Path, process::Command};

use anyhow::Context as _;

use crate::{
    shell::{line, run as must, step},
    workspace::Workspace,
};

/// A program with its sources.
struct Program {
    name: &'static str,
    /// The source files, relative to `tests/peers/dds`.
    sources: &'static [&'static str],
    /// The IDL file of its types, which the compiler of Cyclone DDS translates to C.
    types: Option<&'static str>,
    libraries: &'static [&'static str],
}

const PROGRAMS: &[Program] = &[
    Program {
        name: "fastdds-peer",
        sources: &[
            "fastdds.cpp",
            "fastdds_action.cpp",
            "commands.cpp",
            "measure.cpp",
        ],
        types: None,
        libraries: &["-lfastrtps", "-lfastcdr", "-pthread"],
    },
    Program {
        name: "cyclone-peer",
        sources: &["cyclone.cpp", "commands.cpp", "measure.cpp"],
        types: Some("ros_types"),
        libraries: &["-lddsc", "-pthread"],
    },
    Program {
        name: "roscpp-peer",
        sources: &["../calls/roscpp.cpp"],
        types: None,
        libraries: &[
            "-lroscpp",
            "-lroscpp_serialization",
            "-lrosconsole",
            "-lrostime",
            "-lboost_system",
            "-pthread",
        ],
    },
    // Preloaded into tested programs.
    Program {
        name: "clock-shift.so",
        sources: &["../clock/shift.cpp"],
        types: None,
        libraries: &["-shared", "-fPIC", "-ldl"],
    },
];

const HEADERS: &[&str] = &[
    "arguments.hpp",
    "body.hpp",
    "domain.hpp",
    "fastdds.hpp",
    "fastdds_action.hpp",
    "lines.hpp",
];

/// Compiles the programs that are missing or have changed sources.
///
/// # Errors
/// Returns an error if a source cannot be read or compiled. The other programs are still built.
pub(super) fn build(workspace: &Workspace) -> anyhow::Result<()> {
    let mut first = Ok(());
    for program in PROGRAMS {
        let built = program.build(&workspace.root.join("tests/peers/dds"), &workspace.peers());
        let built = built.with_context(|| program.name);
        first = first.and(built);
    }
    first
}

impl Program {
    fn build(&self, source: &Path, target: &Path) -> anyhow::Result<()> {
        fs::create_dir_all(target)
            .with_context(|| format!("{} cannot be made", target.display()))?;
        let made = target.join(self.name);
        let stamp = target.join(format!("{}.source", self.name));
        let wanted = self.source(source)?;
        if made.is_file() && fs::read_to_string(&stamp).is_ok_and(|there| there == wanted) {
            return Ok(());
        }
        step(&format!("compiling {}", made.display()));
        for mut command in self.commands(source, target) {
            println!("    {}", line(&command));
            must(&mut command)?;
        }
        fs::write(&stamp, wanted).with_context(|| format!("{} cannot be written", stamp.display()))
    }

    /// Returns all sources of the program in one text.
    fn source(&self, folder: &Path) -> anyhow::Result<String> {
        let types = self.types.map(|types| format!("{types}.idl"));
        let names = self.sources.iter().chain(HEADERS).copied();
        names
            .chain(types.as_deref())
            .map(|name| {
                let path = folder.join(name);
                fs::read_to_string(&path)
                    .with_context(|| format!("{} cannot be read", path.display()))
            })
            .collect()
    }

    fn commands(&self, source: &Path, target: &Path) -> Vec<Command> {
        let mut commands = Vec::new();
        let object = |types: &str| target.join(format!("{types}.o"));
        if let Some(types) = self.types {
            let mut idlc = Command::new("idlc");
            idlc.args(["-l", "c", "-o"])
                .arg(target)
                .arg(source.join(format!("{types}.idl")));
            let mut gcc = Command::new("gcc");
            gcc.args(["-O2", "-c", "-o"])
                .arg(object(types))
                .arg(target.join(format!("{types}.c")));
            commands.extend([idlc, gcc]);
        }
        let mut gxx = Command::new("g++");
        gxx.args(["-std=c++17", "-O2", "-Wall", "-Wextra"])
            .arg("-I")
            .arg(target)
            .arg("-I")
            .arg(source)
            .arg("-o")
            .arg(target.join(self.name))
            .args(self.sources.iter().map(|name| source.join(name)))
            .args(self.types.map(object))
            .args(self.libraries);
        commands.push(gxx);
        commands
    }
}
