//! Data for tests. The project's own data is in this folder: manifests of modules, NodeSets, models
//! and definitions of a robot that exist only here. Third-party data is a peer: it has its own
//! licences, is no part of the project, and may be missing.
#![expect(
    clippy::panic,
    clippy::print_stderr,
    reason = "a test fails so, and says why it is left out"
)]

use std::fs::OpenOptions;
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::{env, fs, thread};

/// Third-party data that tests read, by its folder.
pub const FOREIGN: &[(&str, &str)] = &[
    ("b2mml", "schemas of B2MML and BatchML (MESA International)"),
    ("mtp", "manifests of eight modules (MIT, ISC)"),
    ("nodesets", "NodeSets of the OPC Foundation (MIT 1.00)"),
    ("ontologies", "CSS and CaSk ontologies (MIT)"),
    (
        "rml",
        "test cases of RML with XML sources (imec and contributors, CC BY 4.0)",
    ),
    ("ros1-niryo", "ROS definitions of ned_ros (GPL-3.0)"),
];

/// Returns the path of a file of the project's own data, such as `mtp/stage.aml`.
#[must_use]
pub fn own(file: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join(file)
}

/// Reads a file of the project's own data.
///
/// # Panics
/// Panics if the file cannot be read.
#[must_use]
pub fn read_own(file: &str) -> String {
    read(&own(file))
}

/// Returns the path of third-party data, such as `nodesets/Opc.Ua.Di.NodeSet2.xml`. If it is
/// missing, the test is reported as left out. The folder is `UA_DATA`, or `shared/data` beside the
/// repository.
///
/// # Panics
/// Panics if the data is missing and `CI=true`, or if [`FOREIGN`] does not declare its folder.
#[must_use]
pub fn foreign(file: &str) -> Option<PathBuf> {
    let folder = file.split('/').next().unwrap_or_default();
    let Some((_, what)) = FOREIGN.iter().find(|(known, _)| *known == folder) else {
        panic!("{file} is in no folder of FOREIGN");
    };
    let path = foreign_root().join(file);
    if path.exists() {
        return Some(path);
    }
    skip(&format!(
        "the peer {folder}, {what}, is not on this machine ({} is missing); UA_DATA names the folder that has it",
        path.display()
    ));
    None
}

/// Reads a file of third-party data.
///
/// # Panics
/// Panics as [`foreign`] does, and if the file cannot be read.
#[must_use]
pub fn read_foreign(file: &str) -> Option<String> {
    foreign(file).map(|path| read(&path))
}

/// Reports a test that is left out. The test runner captures the output of a passing test, so the
/// reason is also written to the file `UA_SKIPPED`, which `cargo xtask test` shows at the end.
///
/// # Panics
/// Panics if `CI=true`, where no test is left out.
pub fn skip(reason: &str) {
    assert!(
        env::var_os("CI").is_none_or(|ci| ci != "true"),
        "with CI=true nothing is skipped, and {reason}"
    );
    leave_out(reason);
}

/// Reports a test that is left out, also with `CI=true`, because this build has nothing to test.
pub fn leave_out(reason: &str) {
    let thread = thread::current();
    let test = thread.name().unwrap_or("a test");
    eprintln!("skipped: {test}: {reason}");
    let Some(path) = env::var_os("UA_SKIPPED") else {
        return;
    };
    let report = OpenOptions::new().create(true).append(true).open(path);
    let report =
        report.and_then(|mut file| file.write_all(format!("{test}: {reason}\n").as_bytes()));
    if let Err(error) = report {
        eprintln!("and this could not be written down: {error}");
    }
}

fn foreign_root() -> PathBuf {
    env::var_os("UA_DATA").map_or_else(|| own("../../../shared/data"), PathBuf::from)
}

fn read(path: &Path) -> String {
    match fs::read_to_string(path) {
        Ok(text) => text,
        Err(error) => panic!("{}: {error}", path.display()),
    }
}
