//! Preconditions of a scenario: the other programs in the directory, and free ports.

use std::net::{Ipv4Addr, TcpListener};
use std::path::PathBuf;

use super::DemoFailure;

/// Returns the paths of this program and of other programs in the same directory, in the order of
/// their names.
pub(crate) fn find<const N: usize>(
    names: [&str; N],
) -> Result<(PathBuf, [PathBuf; N]), DemoFailure> {
    let demo = std::env::current_exe().map_err(DemoFailure::io("the demo cannot find itself"))?;
    let suffix = std::env::consts::EXE_SUFFIX;
    let beside = names.map(|name| demo.with_file_name(format!("{name}{suffix}")));
    let missing: Vec<PathBuf> = beside
        .iter()
        .filter(|path| !path.is_file())
        .cloned()
        .collect();
    if missing.is_empty() {
        Ok((demo, beside))
    } else {
        Err(DemoFailure::Missing(missing))
    }
}

/// Checks that a port is free, before the program that needs it fails with a longer message.
pub(crate) fn must_be_free(port: u16, program: &'static str) -> Result<(), DemoFailure> {
    TcpListener::bind((Ipv4Addr::LOCALHOST, port))
        .map(drop)
        .map_err(|_| DemoFailure::PortTaken { port, program })
}

/// Returns a port that is free at this moment.
pub(crate) fn free_port() -> Result<u16, DemoFailure> {
    let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0));
    let address = listener.and_then(|listener| listener.local_addr());
    Ok(address
        .map_err(DemoFailure::io("no free port on 127.0.0.1"))?
        .port())
}
