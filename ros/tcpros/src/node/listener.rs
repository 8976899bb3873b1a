//! The ports of a node.

use std::net::{IpAddr, SocketAddr};

use socket2::{Domain, Socket, Type};
use tokio::net::TcpListener;

use super::NodeError;

/// Listens on a port chosen by the system.
pub(super) fn listen(address: IpAddr) -> Result<(TcpListener, u16), NodeError> {
    let open = || {
        let address = SocketAddr::from((address, 0));
        let socket = Socket::new(Domain::for_address(address), Type::STREAM, None)?;
        socket.bind(&address.into())?;
        socket.listen(BACKLOG)?;
        socket.set_nonblocking(true)?;
        let listener = TcpListener::from_std(socket.into())?;
        let port = listener.local_addr()?.port();
        Ok((listener, port))
    };
    open().map_err(|source| NodeError::Listen { address, source })
}

/// Number of peers that may connect at the same moment: a launch file starts a whole graph at once,
/// and a refused peer tries again after a second.
const BACKLOG: i32 = 1024;
