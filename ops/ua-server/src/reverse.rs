//! Connections to clients that wait for the server (ReverseHello, OPC 10000-6, 7.1.2.6).

use std::net::SocketAddr;
use std::time::Duration;

use mappings::Endpoint;
use opcua::server::{ReverseConnectTargetConfig, ServerHandle};
use tokio::net::lookup_host;
use tokio::time::{sleep, timeout};
use tracing::{info, warn};

/// Lets the server connect to a client, as soon as its host name has an address. The library keeps
/// one connection to the client, and tries again after a pause.
pub(crate) async fn connect(handle: ServerHandle, client: Endpoint, url: String) {
    let address = address(&client).await;
    info!(%client, %address, "connecting to a client");
    handle.add_reverse_connect_target(ReverseConnectTargetConfig {
        address,
        endpoint_url: url,
        id: client.to_string(),
    });
}

/// Returns the address of a client. A name without an address is looked up again every ten seconds.
async fn address(client: &Endpoint) -> SocketAddr {
    let mut is_logged = false;
    loop {
        let host = (client.host.as_str(), client.port);
        let found = timeout(LOOKUP, lookup_host(host)).await;
        let why = match found {
            Ok(Ok(mut addresses)) => match addresses.next() {
                Some(address) => return address,
                None => "the name has no address".to_owned(),
            },
            Ok(Err(error)) => error.to_string(),
            Err(_) => "no answer in time".to_owned(),
        };
        if !is_logged {
            is_logged = true;
            warn!(%client, error = why, "cannot resolve the host of server.reverse_connect");
        }
        sleep(LOOKUP).await;
    }
}

/// Time limit of a lookup, and the pause behind a lookup without an address.
const LOOKUP: Duration = Duration::from_secs(10);
