//! Clients of other hosts: their connections are secured, and each of them is a user.

use std::collections::BTreeMap;
use std::io;
use std::net::IpAddr;
use std::pin::Pin;
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};

use hyper::body::Incoming;
use hyper::header::{AUTHORIZATION, HOST, HeaderValue, ORIGIN};
use hyper::{Request, StatusCode};
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::TcpStream;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio::task::AbortHandle;
use tokio::time::Instant;
use tracing::debug;
use uri_text::{is_loopback_host, without_port};

use crate::http::{HttpRefusal, ServedSite};
use crate::sign_ins::{LOCKED_FOR, PasswordCheck, WrongPasswords, network};
use crate::writes::{May, basic_user, failed};

/// A secured connection, such as a TLS stream.
pub trait SecuredStream: AsyncRead + AsyncWrite + Send + Unpin {}

impl<S: AsyncRead + AsyncWrite + Send + Unpin> SecuredStream for S {}

/// The handshake of a connection: the secured connection, or the reason why there is none.
pub type SecuringConnection =
    Pin<Box<dyn Future<Output = io::Result<Box<dyn SecuredStream>>> + Send>>;

/// The reason why the password of a client is refused.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PasswordRefusal {
    /// The user does not exist, or has another password.
    Wrong,
    /// The client has sent too many wrong passwords. The password was not checked.
    TooMany,
}

/// Secures the connections of clients of other hosts.
pub trait ConnectionSecurity: Send + Sync {
    /// Secures a connection, such as by a handshake of TLS.
    fn secure(&self, stream: TcpStream) -> SecuringConnection;

    /// Returns whether the server has a name or an address, without a port.
    fn is_for(&self, host: &str) -> bool;

    /// Counts a refused password of a client.
    fn refused(&self, client: IpAddr, refusal: PasswordRefusal);
}

/// The access of a client of another host, by one connection.
#[derive(Clone)]
pub(crate) struct RemoteAccess {
    pub(crate) security: Arc<dyn ConnectionSecurity>,
    /// The Authorization header of the first user that signed in on this connection.
    signed_in: Arc<OnceLock<HeaderValue>>,
    /// The wrong passwords of all clients.
    wrong: Arc<Mutex<WrongPasswords>>,
    /// The passwords that are being checked, and those that wait for their check.
    checks: Arc<Semaphore>,
}

impl RemoteAccess {
    pub(crate) fn new(security: Arc<dyn ConnectionSecurity>) -> Self {
        Self {
            security,
            signed_in: Arc::default(),
            wrong: Arc::default(),
            checks: Arc::new(Semaphore::new(MOST_CONNECTIONS)),
        }
    }

    /// Returns the access by a new connection.
    pub(crate) fn of_connection(&self) -> Self {
        Self {
            signed_in: Arc::default(),
            ..self.clone()
        }
    }

    /// Returns the number of an attempt to sign in, and its place among the checks.
    ///
    /// # Errors
    /// The client has sent too many wrong passwords, or passwords that are being checked, or too
    /// many passwords of all clients are being checked.
    fn attempt(&self, client: IpAddr) -> Result<(u64, OwnedSemaphorePermit), HttpRefusal> {
        let busy = |why| HttpRefusal::new(StatusCode::SERVICE_UNAVAILABLE, "busy", why);
        let place = Arc::clone(&self.checks).try_acquire_owned();
        let place = place.map_err(|_full| busy("many passwords are being checked; ask again"))?;
        let decided = self.wrong().begin(client, Instant::now());
        match decided {
            PasswordCheck::Check(number) => Ok((number, place)),
            PasswordCheck::Busy => {
                let why = "other passwords of this client are being checked; ask again";
                Err(busy(why))
            }
            PasswordCheck::Locked => {
                self.security.refused(client, PasswordRefusal::TooMany);
                let seconds = LOCKED_FOR.as_secs();
                let why = format!("too many wrong passwords: try again in {seconds} s");
                let status = StatusCode::TOO_MANY_REQUESTS;
                Err(HttpRefusal::new(status, "passwords", &why))
            }
        }
    }

    fn wrong(&self) -> MutexGuard<'_, WrongPasswords> {
        self.wrong.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl ServedSite {
    /// Checks whether a request of a client may be answered. On loopback it has to name loopback: a
    /// page of another site in a user's browser can reach loopback by a name that resolves to it.
    /// Over a secured connection it names the server, and has the name and the password of a user.
    pub(crate) async fn admit(
        &self,
        request: &Request<Incoming>,
        client: IpAddr,
    ) -> Result<(), HttpRefusal> {
        let host = host(request);
        let Some(remote) = &self.remote else {
            return match host {
                Some(host) if !is_loopback_host(host) => Err(HttpRefusal::new(
                    StatusCode::MISDIRECTED_REQUEST,
                    "host",
                    "questions are answered on loopback, by 127.0.0.1, [::1] or localhost",
                )),
                Some(_) | None => Ok(()),
            };
        };
        if !host.is_some_and(|host| remote.security.is_for(without_port(host))) {
            return Err(HttpRefusal::new(
                StatusCode::MISDIRECTED_REQUEST,
                "host",
                "the certificate of the MES does not have the name or address in the request",
            ));
        }
        let given = request.headers().get(AUTHORIZATION);
        // The password of a connection is checked once: a check takes processor time and memory.
        if given.is_some() && remote.signed_in.get() == given {
            return Ok(());
        }
        let refused = || {
            let why = "clients of other hosts need the name and the password of a user";
            HttpRefusal::new(StatusCode::UNAUTHORIZED, "user", why)
        };
        let user = basic_user(request).ok_or_else(refused)?;
        let writes = self.writes.as_ref().ok_or_else(refused)?;
        let (attempt, place) = remote.attempt(client)?;
        let (checked, may_read) = (remote.clone(), Arc::clone(&writes.may_read));
        // In a task of its own: a wrong password counts too if the client closes the connection
        // during the check.
        let check = tokio::spawn(async move {
            let _place = place;
            let is_right = may_read(Some(user)).await;
            checked.wrong().end(attempt, is_right);
            if !is_right {
                checked.security.refused(client, PasswordRefusal::Wrong);
            }
            is_right
        });
        if !check.await.map_err(|error| failed(&error))? {
            return Err(refused());
        }
        if let Some(given) = given {
            // Another user of the same connection is checked for each request.
            let _first = remote.signed_in.set(given.clone());
        }
        Ok(())
    }

    /// Checks whether a client may do something: the request does not come from a page of another
    /// site in a browser, and the user has the role.
    pub(crate) async fn require(
        &self,
        may: &May,
        request: &Request<Incoming>,
        why: &str,
    ) -> Result<(), HttpRefusal> {
        let origin = request.headers().get(ORIGIN);
        let is_own = origin.is_none_or(|origin| {
            let origin = origin.to_str().unwrap_or_default();
            let of_page = origin.split_once("://").map_or("", |(_, host)| host);
            match self.remote {
                None => is_loopback_host(of_page),
                Some(_) => host(request) == Some(of_page),
            }
        });
        if !is_own {
            let why = "pages of other sites cannot change what is known";
            return Err(HttpRefusal::new(StatusCode::FORBIDDEN, "origin", why));
        }
        if may(basic_user(request)).await {
            Ok(())
        } else {
            Err(HttpRefusal::new(StatusCode::UNAUTHORIZED, "user", why))
        }
    }
}

/// The open connections of clients of other hosts, oldest first. At a limit a connection without a
/// user gives way, so that clients without a password keep no user away.
#[derive(Debug, Default)]
pub(crate) struct RemoteConnections(Vec<RemoteConnection>);

#[derive(Debug)]
struct RemoteConnection {
    client: IpAddr,
    signed_in: Arc<OnceLock<HeaderValue>>,
    task: AbortHandle,
}

impl RemoteConnection {
    /// Returns whether no user has signed in on the connection.
    fn is_of_stranger(&self) -> bool {
        self.signed_in.get().is_none()
    }
}

impl RemoteConnections {
    /// Makes room for a connection of a client. At the limit of the client or its network, closes
    /// its oldest connection without a user; at the limit of all connections, the oldest of the
    /// network that has most connections without a user. Returns false if all have users.
    pub(crate) fn make_room(&mut self, client: IpAddr) -> bool {
        let client = network(client);
        self.0.retain(|open| !open.task.is_finished());
        let of_client = self.0.iter().filter(|open| open.client == client);
        let has_share = of_client.count() >= MOST_OF_CLIENT;
        if !has_share && self.0.len() < MOST_CONNECTIONS {
            return true;
        }
        let mut of_strangers: BTreeMap<IpAddr, usize> = BTreeMap::new();
        for open in self.0.iter().filter(|open| open.is_of_stranger()) {
            *of_strangers.entry(open.client).or_default() += 1;
        }
        let share = |open: &RemoteConnection| of_strangers.get(&open.client).copied();
        let mut most = None;
        for (at, open) in self.0.iter().enumerate() {
            let may_close = open.is_of_stranger() && (!has_share || open.client == client);
            if may_close && most.is_none_or(|(_, most)| share(open) > most) {
                most = Some((at, share(open)));
            }
        }
        let Some((oldest, _)) = most else {
            return false;
        };
        let open = self.0.remove(oldest);
        debug!(client = %open.client, "closed a connection without a user for a new connection");
        open.task.abort();
        true
    }

    /// Adds a connection after [`Self::make_room`].
    pub(crate) fn add(&mut self, client: IpAddr, access: &RemoteAccess, task: AbortHandle) {
        self.0.push(RemoteConnection {
            client: network(client),
            signed_in: Arc::clone(&access.signed_in),
            task,
        });
    }
}

/// Returns the host that a request names.
fn host(request: &Request<Incoming>) -> Option<&str> {
    let host = request.headers().get(HOST)?;
    Some(host.to_str().unwrap_or_default())
}

const MOST_CONNECTIONS: usize = 256;
/// Maximum number of connections of a client, or of an IPv6 network.
const MOST_OF_CLIENT: usize = 64;

#[cfg(test)]
mod tests {
    use std::future::pending;

    use tokio::task::JoinHandle;

    use super::*;

    struct NoSecurity;

    impl ConnectionSecurity for NoSecurity {
        fn secure(&self, _stream: TcpStream) -> SecuringConnection {
            Box::pin(async { Err(io::ErrorKind::Unsupported.into()) })
        }

        fn is_for(&self, _host: &str) -> bool {
            false
        }

        fn refused(&self, _client: IpAddr, _refusal: PasswordRefusal) {}
    }

    /// Adds a connection, if there is room for it.
    fn add_to(
        open: &mut RemoteConnections,
        all: &RemoteAccess,
        client: &str,
        is_signed_in: bool,
    ) -> Option<JoinHandle<()>> {
        let client = client.parse().unwrap();
        open.make_room(client).then(|| {
            let access = all.of_connection();
            if is_signed_in {
                let header = HeaderValue::from_static("Basic x");
                access.signed_in.set(header).unwrap();
            }
            let task = tokio::spawn(pending::<()>());
            open.add(client, &access, task.abort_handle());
            task
        })
    }

    /// Lets all tasks of connections run, so that closed ones end.
    async fn all_run() {
        for _ in 0..2 * MOST_CONNECTIONS {
            tokio::task::yield_now().await;
        }
    }

    #[tokio::test]
    async fn a_connection_without_a_user_gives_way_and_one_of_a_user_stays() {
        let all = RemoteAccess::new(Arc::new(NoSecurity));
        let mut open = RemoteConnections::default();
        let mut add = |client: &str, is_signed_in: bool| -> Option<JoinHandle<()>> {
            add_to(&mut open, &all, client, is_signed_in)
        };
        // The first of a client is a user's.
        let user = add("192.0.2.7", true).unwrap();
        let second = add("192.0.2.7", false).unwrap();
        let more: Vec<_> = (2..MOST_OF_CLIENT)
            .map(|_| add("192.0.2.7", false).unwrap())
            .collect();
        let other = add("192.0.2.8", false).unwrap();
        assert!(add("192.0.2.7", true).is_some());
        assert!(second.await.unwrap_err().is_cancelled());
        for _ in &more {
            assert!(add("192.0.2.7", true).is_some());
        }
        for ended in more {
            assert!(ended.await.unwrap_err().is_cancelled());
        }
        // All connections of this client have users; the share of another client is free.
        assert!(add("192.0.2.7", false).is_none());
        assert!(add("192.0.2.8", false).is_some());
        tokio::task::yield_now().await;
        assert!(!user.is_finished() && !other.is_finished());
    }

    #[tokio::test]
    async fn the_network_with_most_connections_without_a_user_gives_way() {
        let all = RemoteAccess::new(Arc::new(NoSecurity));
        let mut open = RemoteConnections::default();
        let mut add = |client: &str, is_signed_in: bool| -> Option<JoinHandle<()>> {
            add_to(&mut open, &all, client, is_signed_in)
        };
        // A client in its handshake, a network of users, and three networks of strangers.
        let honest = add("192.0.2.1", false).unwrap();
        let of_users: Vec<_> = (0..MOST_OF_CLIENT)
            .map(|_| add("192.0.2.2", true).unwrap())
            .collect();
        let mut strangers = Vec::new();
        for (client, number) in [
            ("2001:db8:0:1::1", MOST_OF_CLIENT - 1),
            ("192.0.2.3", MOST_OF_CLIENT),
            ("192.0.2.4", MOST_OF_CLIENT),
        ] {
            strangers.extend((0..number).map(|_| add(client, false).unwrap()));
        }
        assert_eq!(1 + of_users.len() + strangers.len(), MOST_CONNECTIONS);
        all_run().await;
        assert!(!strangers.iter().any(JoinHandle::is_finished));
        // Of the networks with most connections, the oldest connections are closed in turn.
        let first = MOST_OF_CLIENT - 1;
        for closed in [first, first + MOST_OF_CLIENT, 0, first + 1] {
            assert!(add("192.0.2.5", true).is_some());
            all_run().await;
            assert!(strangers[closed].is_finished(), "{closed}");
        }
        let ended = strangers.iter().filter(|task| task.is_finished()).count();
        assert_eq!(ended, 4);
        assert!(!honest.is_finished());
        assert!(!of_users.iter().any(JoinHandle::is_finished));
    }

    #[tokio::test]
    async fn a_connection_is_refused_if_all_have_users() {
        let all = RemoteAccess::new(Arc::new(NoSecurity));
        let mut open = RemoteConnections::default();
        let mut add = |client: &str| add_to(&mut open, &all, client, true);
        for client in ["192.0.2.1", "192.0.2.2", "192.0.2.3", "192.0.2.4"] {
            for _ in 0..MOST_CONNECTIONS / 4 {
                assert!(add(client).is_some(), "{client}");
            }
        }
        assert!(add("192.0.2.5").is_none());
    }
}
