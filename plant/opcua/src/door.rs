//! Checks clients before they reach the server, because the library compares certificates with
//! files only and supports neither authorities nor revocation lists.
//!
//! A [`Door`] listens on the public address, and the server listens for the door only. The door
//! forwards the Hello message and checks the certificate in the OpenSecureChannel request
//! ([`trust::check`]). It then forwards the connection in both directions, or sends an error to the
//! client. Each admitted certificate is copied into a temporary trust store of the library, and
//! removed when its last connection closes. Changes of the store also apply to open connections.
//!
//! Only a store that trusts an authority has a door, because a door adds a hop to each message.

use std::collections::HashMap;
use std::fs;
use std::io;
use std::net::{Ipv4Addr, SocketAddr};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use log_limit::LogLimit;
use opcua::crypto::{CertificateStore, X509};
use opcua::sync::{Mutex, RwLock};
use opcua::types::StatusCode;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::watch;
use tokio::task::JoinSet;
use tokio::time::{Instant, timeout};
use tracing::{debug, info, warn};
use trust::{Certificate, CertificateFault, TrustedCertificates};

use self::connections::Connections;
use crate::certificates;
use crate::judge::{self, PresentedChain};
use crate::known::{self, StoreStamp};
use crate::limits::ClientLimits;
use crate::pki::{OWN_CERTIFICATE, OWN_KEY};

mod connections;

/// The front of a server that admits clients with certificates of a trusted authority.
#[derive(Debug)]
pub struct Door {
    shared: Arc<Shared>,
}

/// The rule for clients with a valid certificate if neither the certificate nor its authority is
/// trusted.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum UnknownClients {
    /// The channel is refused, and the certificate is kept in `rejected`.
    #[default]
    Refuse,
    /// The channel is opened. The server decides on the rights of such clients by
    /// [`SessionCaller::certificate`].
    ///
    /// [`SessionCaller::certificate`]: crate::server::SessionCaller::certificate
    Admit,
}

/// The configuration of the library behind a door.
#[derive(Debug, Clone)]
pub struct Behind {
    /// The certificate store of the library.
    pub pki: PathBuf,
    /// The path of the server's own certificate.
    pub certificate: PathBuf,
    /// The path of the server's private key.
    pub key: PathBuf,
    /// The limits of clients.
    pub clients: ClientLimits,
}

impl Behind {
    /// Applies the configuration to the builder of a library server.
    #[must_use]
    pub fn used_by(
        &self,
        mut builder: opcua::server::ServerBuilder,
    ) -> opcua::server::ServerBuilder {
        let limits = self.clients.behind_door();
        let limits = limits.bound(builder.limits_mut().clone());
        builder
            .limits(limits)
            .pki_dir(&self.pki)
            .certificate_path(&self.certificate)
            .private_key_path(&self.key)
    }
}

#[derive(Debug)]
struct Shared {
    root: PathBuf,
    behind: Behind,
    unknown: UnknownClients,
    /// The address of the server behind the door.
    inner: SocketAddr,
    known: RwLock<Arc<TrustedCertificates>>,
    /// The state of the files of the store before they were read first.
    first: StoreStamp,
    /// The number of connections per admitted certificate, by the path of its copy.
    admitted: Mutex<HashMap<PathBuf, usize>>,
    /// Counts the changes of the store.
    changes: watch::Sender<u64>,
    /// Limits the log messages per refused certificate and reason.
    refused: Mutex<LogLimit>,
}

impl Door {
    /// Creates the door of the store at `root`, which contains the server's own certificate, and
    /// the listening socket of the server behind the door. Returns `None` if the store trusts no
    /// authority.
    ///
    /// # Errors
    /// Returns an error if the store or the address behind the door cannot be used.
    pub fn of(
        root: &Path,
        clients: ClientLimits,
        unknown: UnknownClients,
    ) -> io::Result<Option<(Self, std::net::TcpListener)>> {
        if !known::trusts_authorities(root) {
            return Ok(None);
        }
        let root = std::path::absolute(root)?;
        let pki = root.join(BEHIND);
        // Certificates that an earlier run admitted do not count.
        match fs::remove_dir_all(&pki) {
            Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
            Ok(()) | Err(_) => {}
        }
        for folder in [known::TRUSTED, "rejected"] {
            fs::create_dir_all(pki.join(folder))?;
        }
        let behind = Behind {
            pki,
            certificate: root.join(OWN_CERTIFICATE),
            key: root.join(OWN_KEY),
            clients,
        };
        let listener = std::net::TcpListener::bind((Ipv4Addr::LOCALHOST, 0))?;
        listener.set_nonblocking(true)?;
        socket2::SockRef::from(&listener).set_tcp_nodelay(true)?;
        // The stamp is taken before reading, so that changes during the reading are detected later.
        let first = known::stamp(&root);
        let shared = Shared {
            first,
            known: RwLock::new(Arc::new(known::read(&root))),
            root,
            behind,
            unknown,
            inner: listener.local_addr()?,
            admitted: Mutex::default(),
            changes: watch::Sender::new(0),
            refused: Mutex::new(LogLimit::every(TOLD_EVERY)),
        };
        info!("accepting clients with certificates of trusted authorities");
        Ok(Some((
            Self {
                shared: Arc::new(shared),
            },
            listener,
        )))
    }

    /// Returns the configuration of the library.
    #[must_use]
    pub fn behind(&self) -> &Behind {
        &self.shared.behind
    }

    /// Accepts clients until the future is dropped.
    pub async fn stand(self, listener: TcpListener) {
        let shared = self.shared;
        let limits = shared.behind.clients;
        let mut connections = Connections::new(limits.connections, limits.connections_per_address);
        let mut tasks = JoinSet::new();
        let mut look = tokio::time::interval(LOOK);
        look.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
        let mut stamp = shared.first.clone();
        loop {
            tokio::select! {
                accepted = listener.accept() => match accepted {
                    Ok((client, peer)) => {
                        shared.take(&mut tasks, &mut connections, (client, peer));
                    }
                    Err(error) => {
                        if let Some(suppressed) = shared.another_now("accept") {
                            warn!(%error, suppressed, "cannot accept a connection");
                        }
                        // The process may have no free file descriptor.
                        connections.give_way(|_| true);
                        tokio::time::sleep(PAUSE).await;
                    }
                },
                _ = look.tick() => shared.look(&mut stamp),
                Some(ended) = tasks.join_next() => {
                    if let Ok(number) = ended {
                        connections.remove(number);
                    }
                }
            }
        }
    }
}

impl Shared {
    /// Serves a client in a task, unless admitted clients use all connections.
    fn take(
        self: &Arc<Self>,
        tasks: &mut JoinSet<u64>,
        connections: &mut Connections,
        (client, peer): (TcpStream, SocketAddr),
    ) {
        if !connections.make_room(peer.ip()) {
            if let Some(suppressed) = self.another_now("connections") {
                warn!(%peer, suppressed, "refused a connection: the limit of connections is reached");
            }
            return;
        }
        let number = connections.next();
        let admitted = Arc::new(AtomicBool::new(false));
        let (shared, is_admitted) = (Arc::clone(self), Arc::clone(&admitted));
        let task = tasks.spawn(async move {
            if let Err(error) = shared.serve(client, peer, &is_admitted).await {
                debug!(%peer, %error, "a connection has ended");
            }
            number
        });
        connections.insert(number, peer.ip(), (admitted, task));
    }

    /// Returns the number of messages that were suppressed, if this message is to be logged.
    fn another_now(&self, message: &str) -> Option<u64> {
        self.refused.lock().admit(message, Instant::now())
    }

    /// Reads the store again if its files changed, and makes each connection judge its certificate
    /// again.
    fn look(&self, stamp: &mut StoreStamp) {
        let now = known::stamp(&self.root);
        if now == *stamp {
            return;
        }
        *stamp = now;
        *self.known.write() = Arc::new(known::read(&self.root));
        self.changes.send_modify(|changes| *changes += 1);
    }

    async fn serve(
        &self,
        mut client: TcpStream,
        peer: SocketAddr,
        is_admitted: &AtomicBool,
    ) -> io::Result<()> {
        client.set_nodelay(true)?;
        let mut server = TcpStream::connect(self.inner).await?;
        server.set_nodelay(true)?;
        let greeted = timeout(GREETING, async {
            let hello = message(&mut client).await?;
            server.write_all(&hello).await?;
            let answer = message(&mut server).await?;
            client.write_all(&answer).await?;
            message(&mut client).await
        });
        let open = greeted
            .await
            .map_err(|_| io::Error::from(io::ErrorKind::TimedOut))??;
        let mut changes = self.changes.subscribe();
        let shown = match shown(&open) {
            Ok(shown) => shown,
            Err(status) => return refuse(&mut client, status).await,
        };
        let admitted = match &shown {
            None => None,
            Some(shown) => match self.admit(shown, peer) {
                Ok(admitted) => Some(admitted),
                Err(status) => return refuse(&mut client, status).await,
            },
        };
        is_admitted.store(admitted.is_some(), Ordering::Relaxed);
        server.write_all(&open).await?;
        let said =
            tokio::io::copy_bidirectional_with_sizes(&mut client, &mut server, AT_ONCE, AT_ONCE);
        tokio::pin!(said);
        loop {
            tokio::select! {
                ended = &mut said => return ended.map(drop),
                Ok(()) = changes.changed() => {
                    if let Some(shown) = &shown
                        && let Err(fault) = self.judge(shown)
                    {
                        self.tell(&shown.0, fault, peer, "is cut off");
                        // The library ends the session when the connection closes.
                        break;
                    }
                }
            }
        }
        drop(admitted);
        Ok(())
    }

    fn judge(&self, (certificate, sent): &PresentedChain) -> Result<(), CertificateFault> {
        let known = Arc::clone(&self.known.read());
        let checked = trust::check(certificate, sent, &known, known::now());
        match (checked, self.unknown) {
            (
                Err(CertificateFault::Untrusted | CertificateFault::Incomplete),
                UnknownClients::Admit,
            ) => {
                let mut known = known;
                Arc::make_mut(&mut known).trusted.push(certificate.clone());
                trust::check(certificate, sent, &known, known::now())
            }
            (checked, _) => checked,
        }
    }

    /// Judges a certificate, and adds it to the trust store of the library if it is trusted.
    fn admit(&self, shown: &PresentedChain, peer: SocketAddr) -> Result<Admitted<'_>, StatusCode> {
        let certificate = &shown.0;
        let Ok(of_library) = X509::from_der(certificate.der()) else {
            return Err(StatusCode::BadCertificateInvalid);
        };
        let file = CertificateStore::cert_file_name(&of_library);
        if let Err(fault) = self.judge(shown) {
            let unknown = matches!(
                fault,
                CertificateFault::Untrusted | CertificateFault::Incomplete
            );
            if unknown {
                // `Pki::report_rejected` logs the certificate together with the command that trusts
                // it.
                if let Err(error) = certificates::keep_refused(&self.root, certificate) {
                    warn!(%error, "cannot store a rejected certificate");
                }
            } else {
                self.tell(certificate, fault, peer, "is refused");
            }
            // An untrusted client does not learn which check failed (OPC 10000-4, 6.1.3).
            let status = match fault.may_be_told() {
                true => StatusCode::from(fault.status()),
                false => StatusCode::BadSecurityChecksFailed,
            };
            return Err(status);
        }
        if !shown.1.is_empty() {
            // The library does not support certificate chains.
            self.tell_chain(certificate, peer);
            return Err(StatusCode::BadCertificateInvalid);
        }
        let path = self.behind.pki.join(known::TRUSTED).join(file);
        let mut all = self.admitted.lock();
        let count = all.entry(path.clone()).or_default();
        if *count == 0
            && let Err(error) = fs::write(&path, certificate.der())
        {
            warn!(path = %path.display(), %error, "cannot admit a client");
            all.remove(&path);
            return Err(StatusCode::BadInternalError);
        }
        *count += 1;
        Ok(Admitted { shared: self, path })
    }
    fn tell(
        &self,
        certificate: &Certificate,
        fault: CertificateFault,
        peer: SocketAddr,
        what: &str,
    ) {
        let help = judge::help(fault);
        let why = format!("{what}: {fault}; {help}");
        if let Some(suppressed) = self.another(certificate, &why) {
            warn!(
                name = ?certificate.name(), issuer = ?certificate.issuer_name(), serial = %certificate.serial(), %peer, suppressed,
                "a client {why}"
            );
        }
    }

    fn tell_chain(&self, certificate: &Certificate, peer: SocketAddr) {
        if let Some(suppressed) = self.another(certificate, "chain") {
            warn!(
                name = ?certificate.name(), %peer, suppressed,
                "rejected a client: it sends issuer certificates together with its own; configure it to \
                 send only its own certificate"
            );
        }
    }

    /// Returns the number of rejections of this certificate that were not logged since the last log
    /// entry, if this rejection is to be logged.
    fn another(&self, certificate: &Certificate, why: &str) -> Option<u64> {
        let what = format!(
            "{} {} {why}",
            certificate.issuer_name(),
            certificate.serial()
        );
        self.another_now(&what)
    }
}

/// A certificate that the library trusts until this value is dropped.
struct Admitted<'s> {
    shared: &'s Shared,
    path: PathBuf,
}

impl Drop for Admitted<'_> {
    fn drop(&mut self) {
        let mut all = self.shared.admitted.lock();
        let Some(count) = all.get_mut(&self.path) else {
            return;
        };
        *count -= 1;
        if *count == 0 {
            all.remove(&self.path);
            if let Err(error) = fs::remove_file(&self.path) {
                warn!(path = %self.path.display(), %error, "cannot remove the certificate of a disconnected client from the temporary trust store: remove the file");
            }
        }
    }
}

/// Returns the certificate in an OpenSecureChannel request; `None` for a channel without security.
fn shown(open: &[u8]) -> Result<Option<PresentedChain>, StatusCode> {
    // Message type, size and SecureChannelId (OPC 10000-6, 6.7.2).
    let Some(after) = open.get(12..).filter(|_| open.starts_with(b"OPN")) else {
        // The server answers a wrong message type with an error.
        return Ok(None);
    };
    let bad = StatusCode::BadTcpMessageTypeInvalid;
    let (_policy, rest) = bytes(after).ok_or(bad)?;
    let (certificate, _) = bytes(rest).ok_or(bad)?;
    if certificate.is_empty() {
        return Ok(None);
    }
    let read = Certificate::read_chain(certificate);
    read.map(Some)
        .map_err(|_| StatusCode::BadCertificateInvalid)
}

/// Splits a ByteString from the rest of the bytes.
fn bytes(from: &[u8]) -> Option<(&[u8], &[u8])> {
    let (length, rest) = from.split_first_chunk::<4>()?;
    let length = i32::from_le_bytes(*length);
    // A null ByteString counts as empty.
    rest.split_at_checked(usize::try_from(length.max(0)).ok()?)
}

/// Receives a message of the protocol that consists of a single chunk.
async fn message(from: &mut TcpStream) -> io::Result<Vec<u8>> {
    let mut head = [0; 8];
    from.read_exact(&mut head).await?;
    let [.., a, b, c, d] = head;
    let size = usize::try_from(u32::from_le_bytes([a, b, c, d])).unwrap_or(usize::MAX);
    if !(head.len()..=LARGEST_OPENING).contains(&size) {
        return Err(io::ErrorKind::InvalidData.into());
    }
    let mut all = vec![0; size];
    let (first, rest) = all.split_at_mut(head.len());
    first.copy_from_slice(&head);
    from.read_exact(rest).await?;
    Ok(all)
}

/// Sends an Error message to a client, and closes the connection (OPC 10000-6, 7.1.2.5).
async fn refuse(client: &mut TcpStream, status: StatusCode) -> io::Result<()> {
    let mut error = b"ERRF".to_vec();
    error.extend(16_u32.to_le_bytes());
    error.extend(status.bits().to_le_bytes());
    // A null reason.
    error.extend((-1_i32).to_le_bytes());
    client.write_all(&error).await?;
    client.shutdown().await
}

/// The folder of the library's store behind a door, below the store of the server.
const BEHIND: &str = "admitted";
/// Shortest interval between two log messages for the same client.
const TOLD_EVERY: Duration = Duration::from_secs(10);
const GREETING: Duration = Duration::from_secs(5);
const LOOK: Duration = Duration::from_secs(1);
const PAUSE: Duration = Duration::from_millis(100);
/// Largest OpenSecureChannel request in bytes: a certificate, a signature, and little else.
const LARGEST_OPENING: usize = 64 << 10;
/// Bytes of the buffer for each direction.
const AT_ONCE: usize = 16 << 10;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_certificate_is_found_in_what_opens_a_channel() {
        let text =
            |text: &[u8]| [&i32::try_from(text.len()).unwrap().to_le_bytes()[..], text].concat();
        let open = |certificate: &[u8]| {
            [
                &b"OPNF\0\0\0\0\0\0\0\0"[..],
                &text(b"http://policy"),
                &text(certificate),
                &text(b""),
            ]
            .concat()
        };
        assert_eq!(shown(&open(b"")), Ok(None));
        assert_eq!(shown(b"MSGF\0\0\0\0\0\0\0\0"), Ok(None));
        assert_eq!(
            shown(&open(b"nothing")),
            Err(StatusCode::BadCertificateInvalid)
        );
        let whole = open(b"nothing");
        for cut in 12..whole.len() - 4 {
            assert!(shown(&whole[..cut]).is_err(), "{cut}");
        }
        // A length beyond the end of the message.
        let mut long = open(b"");
        long[12] = 0xff;
        long[14] = 0x7f;
        assert_eq!(shown(&long), Err(StatusCode::BadTcpMessageTypeInvalid));
    }
}
