//! Detects whether the OPC UA libraries are built with the patches of this project, and restricts
//! the listening addresses of a server without patches.
//!
//! The unpatched libraries do not limit the memory, sessions and connections of a client without
//! credentials.

use std::net::SocketAddr;
use std::sync::{LazyLock, Once};

use opcua::server::Limits;
use tracing::warn;

/// The environment variable that permits a server with unpatched libraries to serve other hosts, if
/// its value is `1`.
pub const SERVE_AS_PUBLISHED: &str = "UA_SERVE_AS_PUBLISHED";

/// An address that unpatched libraries do not serve.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error(
    "{library} has no limits for clients, so it serves loopback only, not {0}: build with `cargo xtask \
     build`, which applies the patches, or set {SERVE_AS_PUBLISHED}=1",
    library = library()
)]
pub struct OtherHosts(pub SocketAddr);

/// Returns whether the libraries are built with the patches. The limits of a server have fields
/// that only a patch adds.
#[must_use]
pub fn are_applied() -> bool {
    static APPLIED: LazyLock<bool> = LazyLock::new(|| {
        serde_json::to_value(Limits::default())
            .is_ok_and(|limits| limits.get("max_queued_bytes").is_some())
    });
    *APPLIED
}

/// Returns the name and version of the libraries, and whether they have the patches.
#[must_use]
pub fn library() -> &'static str {
    match are_applied() {
        true => "async-opcua 0.19.0 with patches",
        false => "async-opcua 0.19.0 as published",
    }
}

/// Returns the version of a program of this workspace, with the version of the libraries.
#[must_use]
pub fn version() -> &'static str {
    static VERSION: LazyLock<String> =
        LazyLock::new(|| format!("{} ({})", build_info::version(), library()));
    &VERSION
}

/// Checks the listening addresses of a server. Logs one warning if the libraries are unpatched.
///
/// # Errors
/// Returns an error for an address that other hosts reach, if the libraries are unpatched and
/// [`SERVE_AS_PUBLISHED`] is not set.
pub fn check(addresses: &[SocketAddr]) -> Result<(), OtherHosts> {
    if are_applied() {
        return Ok(());
    }
    static WARNED: Once = Once::new();
    WARNED.call_once(|| {
        warn!(
            library = library(),
            hint = "build with `cargo xtask build`",
            "the OPC UA libraries of this build have no limits for clients"
        );
    });
    let is_allowed = std::env::var_os(SERVE_AS_PUBLISHED).is_some_and(|value| value == "1");
    served(addresses, is_allowed)
}

/// Checks that unpatched libraries serve only loopback addresses, unless other addresses are
/// allowed.
fn served(addresses: &[SocketAddr], is_allowed: bool) -> Result<(), OtherHosts> {
    let other = |address: &&SocketAddr| !address.ip().to_canonical().is_loopback();
    match addresses.iter().find(other) {
        Some(address) if !is_allowed => Err(OtherHosts(*address)),
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn libraries_as_published_serve_loopback_only_unless_allowed() {
        let address = |text: &str| text.parse::<SocketAddr>().unwrap();
        for loopback in ["127.0.0.1:4840", "[::1]:4840", "[::ffff:127.0.0.2]:1"] {
            assert_eq!(served(&[address(loopback)], false), Ok(()), "{loopback}");
        }
        for other in ["0.0.0.0:4840", "[::]:4840", "10.0.0.1:4840"] {
            let other = address(other);
            let addresses = [address("127.0.0.1:4840"), other];
            assert_eq!(served(&addresses, false), Err(OtherHosts(other)));
            assert_eq!(served(&addresses, true), Ok(()));
        }
        let message = OtherHosts(address("10.0.0.1:4840")).to_string();
        assert!(
            message.contains("10.0.0.1:4840") && message.contains("UA_SERVE_AS_PUBLISHED=1"),
            "{message}"
        );
    }

    #[test]
    fn the_text_names_the_version_that_is_locked() {
        let lock = include_str!("../../../Cargo.lock");
        let (_, package) = lock
            .split_once("name = \"async-opcua\"\nversion = \"")
            .unwrap();
        let (locked, _) = package.split_once('"').unwrap();
        assert!(library().starts_with(&format!("async-opcua {locked} ")));
        assert!(version().ends_with(&format!("({})", library())));
    }
}
