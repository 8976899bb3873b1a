//! Who still answers: a connection is opened to the endpoint and closed again.

use std::io::ErrorKind;
use std::time::Duration;

use registry::Outcome;
use tokio::net::{TcpStream, lookup_host};
use tokio::time::timeout;

use crate::url::Url;

/// Tries an endpoint, for half a second at most: two tries that wait fit into the time in which a loss is to be told.
pub(crate) async fn probe(url: String) -> (String, Outcome) {
    let outcome = match Url::parse(&url) {
        Some(place) => connect(&place).await,
        // Another kind of endpoint, such as one of HTTPS.
        None => Outcome::Untried,
    };
    (url, outcome)
}

#[expect(
    clippy::wildcard_enum_match_arm,
    reason = "there are many ways to fail, and few say something of the server"
)]
async fn connect(place: &Url) -> Outcome {
    let looked_up = timeout(LIMIT, lookup_host((place.host.as_str(), place.port))).await;
    let Some(address) = looked_up
        .ok()
        .and_then(Result::ok)
        .and_then(|mut all| all.next())
    else {
        return Outcome::Untried;
    };
    match timeout(LIMIT, TcpStream::connect(address)).await {
        Ok(Ok(_open)) => Outcome::Alive { start_time: None },
        Ok(Err(error)) => match error.kind() {
            ErrorKind::ConnectionRefused => Outcome::Refused,
            // Reset is what a server does that has no room: it is there.
            ErrorKind::ConnectionReset => Outcome::Alive { start_time: None },
            // Our own want of descriptors, say, is nothing that the server did.
            ErrorKind::HostUnreachable | ErrorKind::NetworkUnreachable | ErrorKind::TimedOut => {
                Outcome::Silent
            }
            _ => Outcome::Untried,
        },
        Err(_late) => Outcome::Silent,
    }
}

const LIMIT: Duration = Duration::from_millis(500);
