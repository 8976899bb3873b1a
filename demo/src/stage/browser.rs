//! The page of the cell, as a scenario serves it.

use std::net::Ipv4Addr;
use std::process::Stdio;
use std::time::Duration;

use tokio::net::TcpStream;
use tokio::process::Command;

/// Returns the address of the page at a port.
pub(crate) fn address(port: u16) -> String {
    format!("http://{}:{port}/", Ipv4Addr::LOCALHOST)
}

/// Returns the arguments that show the programs with their status at these ports.
pub(crate) fn status_of(ports: &[u16]) -> Vec<String> {
    let each = ports.iter().flat_map(|port| {
        let url = format!("http://{}:{port}", Ipv4Addr::LOCALHOST);
        ["--status".to_owned(), url]
    });
    each.collect()
}

/// Opens the page in a browser once it is served, if `wanted`. Without a desktop there is no
/// browser, and the scenario goes on.
pub(crate) fn open_when_served(port: u16, wanted: bool) {
    if !wanted {
        return;
    }
    drop(tokio::spawn(async move {
        for _ in 0..ATTEMPTS {
            if TcpStream::connect((Ipv4Addr::LOCALHOST, port))
                .await
                .is_ok()
            {
                break;
            }
            tokio::time::sleep(BETWEEN).await;
        }
        let opened = Command::new("xdg-open")
            .arg(address(port))
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .status()
            .await;
        if let Err(error) = opened {
            tracing::warn!("cannot open a browser: xdg-open: {error}");
        }
    }));
}

const ATTEMPTS: u32 = 100;
const BETWEEN: Duration = Duration::from_millis(100);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_status_is_an_argument() {
        let arguments = status_of(&[1, 2]);
        assert_eq!(
            arguments,
            [
                "--status",
                "http://127.0.0.1:1",
                "--status",
                "http://127.0.0.1:2"
            ]
        );
    }
}
