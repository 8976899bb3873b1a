//! The address under which a server registers: [`reachable`].

use std::net::{IpAddr, SocketAddr};
use std::time::Duration;

use tokio::net::{TcpStream, UdpSocket, lookup_host};
use tokio::time::timeout;

use crate::description::ServerDescription;
use mdns::MdnsInterface;
use mdns::Url;
use mdns::is_own;

/// Returns the server with a URL that other hosts can use. The URL of a server that listens on all
/// addresses has the name of its host, which few networks resolve. Such a server registers with the
/// address of the interface towards the discovery server. A URL with an address or another name is
/// not changed.
pub(crate) async fn reachable(
    server: ServerDescription,
    lds: &str,
    interface: Option<&MdnsInterface>,
) -> ServerDescription {
    let Some(place) = Url::parse(&server.url) else {
        return server;
    };
    let is_named_as_the_host = match place.ip() {
        Some(ip) => ip.is_unspecified(),
        None => is_own(&place.host),
    };
    if !is_named_as_the_host {
        return server;
    }
    let Some(address) = address(&place, lds, interface).await else {
        return server;
    };
    let url = Url::of(address, place.port, &place.path).to_string();
    ServerDescription { url, ..server }
}

async fn address(place: &Url, lds: &str, interface: Option<&MdnsInterface>) -> Option<IpAddr> {
    let towards = towards(lds).await?;
    let address = if towards.is_loopback() {
        let addresses = interface.map(MdnsInterface::addresses).unwrap_or_default();
        let mut others = addresses.into_iter().filter(|one| !one.is_loopback());
        match others.next() {
            Some(address) => IpAddr::V4(address),
            // Other hosts may query this discovery server, and could not use a loopback address.
            None if place.ip().is_none() && resolves(place).await => return None,
            None => towards,
        }
    } else {
        towards
    };
    // The server may listen on another address of the host only.
    let listens = TcpStream::connect(SocketAddr::new(address, place.port));
    let listens = timeout(LIMIT, listens).await.is_ok_and(|one| one.is_ok());
    listens.then_some(address)
}

/// Returns the address of this host towards a discovery server. Sends nothing.
async fn towards(lds: &str) -> Option<IpAddr> {
    let lds = Url::parse(lds)?;
    let looked_up = timeout(LIMIT, lookup_host((lds.host.as_str(), lds.port))).await;
    let to = looked_up.ok()?.ok()?.next()?;
    let any: IpAddr = match to {
        SocketAddr::V4(_) => IpAddr::V4(std::net::Ipv4Addr::UNSPECIFIED),
        SocketAddr::V6(_) => IpAddr::V6(std::net::Ipv6Addr::UNSPECIFIED),
    };
    let socket = UdpSocket::bind(SocketAddr::new(any, 0)).await.ok()?;
    socket.connect(to).await.ok()?;
    Some(socket.local_addr().ok()?.ip().to_canonical())
}

async fn resolves(place: &Url) -> bool {
    let looked_up = timeout(LIMIT, lookup_host((place.host.as_str(), place.port))).await;
    looked_up.is_ok_and(|found| found.is_ok_and(|mut all| all.next().is_some()))
}

const LIMIT: Duration = Duration::from_millis(500);

#[cfg(test)]
mod tests {
    use tokio::net::TcpListener;

    use super::*;
    use mdns::host_name;

    #[tokio::test]
    async fn a_server_on_all_addresses_is_registered_with_the_one_towards_the_discovery_server() {
        let listener = TcpListener::bind("0.0.0.0:0").await.unwrap();
        let port = listener.local_addr().unwrap().port();
        let server = |host: &str| ServerDescription {
            application_uri: "urn:here".to_owned(),
            product_uri: String::new(),
            name: "here".to_owned(),
            url: format!("opc.tcp://{host}:{port}/a"),
            capabilities: Vec::new(),
            number: None,
        };
        // Towards another loopback address the address is a loopback address too.
        let registered = reachable(server("0.0.0.0"), "opc.tcp://127.0.0.1:4840", None).await;
        assert_eq!(registered.url, format!("opc.tcp://127.0.0.1:{port}/a"));
        for host in ["192.0.2.7", "other-host.example"] {
            let registered = reachable(server(host), "opc.tcp://127.0.0.1:4840", None).await;
            assert_eq!(registered.url, server(host).url);
        }
        // No server listens under the name of the host.
        drop(listener);
        let named = server(&host_name());
        let registered = reachable(named.clone(), "opc.tcp://127.0.0.1:4840", None).await;
        assert_eq!(registered.url, named.url);
    }
}
