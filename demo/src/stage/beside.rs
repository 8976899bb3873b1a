//! What is there before anything starts: programs beside this one, and free ports.

use std::net::{Ipv4Addr, TcpListener};
use std::path::PathBuf;

use super::Failure;

/// This program, and others in the same directory, in the order of their names.
pub(crate) fn find<const N: usize>(names: [&str; N]) -> Result<(PathBuf, [PathBuf; N]), Failure> {
    let demo = std::env::current_exe().map_err(Failure::io("the demo cannot find itself"))?;
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
        Err(Failure::Missing(missing))
    }
}

/// Finds out whether a port is free where it can still be said in one line.
pub(crate) fn must_be_free(port: u16, program: &'static str) -> Result<(), Failure> {
    TcpListener::bind((Ipv4Addr::LOCALHOST, port))
        .map(drop)
        .map_err(|_| Failure::PortTaken { port, program })
}

/// A port that nobody listens on now.
pub(crate) fn free_port() -> Result<u16, Failure> {
    let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0));
    let address = listener.and_then(|listener| listener.local_addr());
    Ok(address
        .map_err(Failure::io("no free port on 127.0.0.1"))?
        .port())
}
