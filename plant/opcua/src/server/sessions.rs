//! Sessions that called or wrote something: their clients, and the detection of their end.

use std::collections::HashMap;
use std::sync::{Arc, Weak};
use std::time::Duration;

use opcua::server::node_manager::RequestContext;
use opcua::sync::{Mutex, RwLock};
use opcua::types::MessageSecurityMode;
use tokio::sync::Notify;

type Told = Arc<dyn Fn(u32) + Send + Sync>;

/// The client and user of a request.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SessionCaller {
    /// The session id, unique while the server runs.
    pub session: u32,
    /// The user name; `anonymous` for anonymous users.
    pub user: String,
    /// The ApplicationUri that the client sent. It is not verified; see `proven`.
    pub application_uri: String,
    /// Whether the trusted certificate of the client contains the ApplicationUri.
    pub proven: bool,
    /// Whether the channel is signed and encrypted.
    pub encrypted: bool,
    /// The certificate of the client in DER. The client proved to have its private key. `None`
    /// without security.
    pub certificate: Option<Arc<[u8]>>,
}

impl SessionCaller {
    /// Returns the client and user of a request.
    #[must_use]
    pub fn of(context: &RequestContext) -> Self {
        let user = match context.token.0.as_str() {
            opcua::server::ANONYMOUS_USER_TOKEN_ID => ANONYMOUS.to_owned(),
            user => user.to_owned(),
        };
        let session = context.session.read();
        let described = session.application_description();
        let application_uri = described.application_uri.as_ref().to_owned();
        let certificate = session.client_certificate();
        Self {
            session: context.session_id,
            user,
            proven: certificate
                .as_ref()
                .is_some_and(|one| one.is_application_uri_valid(&application_uri).is_ok()),
            certificate: certificate.and_then(|one| one.to_der().ok()).map(Arc::from),
            encrypted: session.message_security_mode() == MessageSecurityMode::SignAndEncrypt,
            application_uri,
        }
    }
}

/// Reports whether the session of a request is still active.
#[derive(Clone)]
pub struct SessionPresence(Arc<dyn Fn() -> bool + Send + Sync>);

impl std::fmt::Debug for SessionPresence {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_tuple("Presence").field(&self.lasts()).finish()
    }
}

impl SessionPresence {
    pub(crate) fn of(context: &RequestContext) -> Self {
        // The library does not export the type of its sessions.
        let session = Arc::downgrade(&context.session);
        Self::while_(move || Weak::upgrade(&session).is_some_and(|one| one.read().is_activated()))
    }

    pub(crate) fn while_(lasts: impl Fn() -> bool + Send + Sync + 'static) -> Self {
        Self(Arc::new(lasts))
    }

    /// Returns whether the session is active.
    #[must_use]
    pub fn lasts(&self) -> bool {
        (self.0)()
    }
}

/// The supervised sessions.
#[derive(Default)]
pub(crate) struct Sessions {
    watched: Mutex<HashMap<u32, SessionPresence>>,
    /// Notified when a session is added.
    added: Notify,
    told: RwLock<Vec<Told>>,
}

impl Sessions {
    /// Returns the client and user of a request, and starts to supervise the session. What ended
    /// sessions held is released first, so that a client that closes its session and opens the next
    /// one is not refused because of itself.
    pub(crate) fn caller(&self, context: &RequestContext) -> SessionCaller {
        self.look();
        let mut watched = self.watched.lock();
        watched.entry(context.session_id).or_insert_with(|| {
            self.added.notify_one();
            SessionPresence::of(context)
        });
        drop(watched);
        SessionCaller::of(context)
    }

    pub(crate) fn tell(&self, told: Told) {
        self.told.write().push(told);
    }

    /// Waits until the sessions have to be checked: for [`LOOK`], or for at most `longest` while
    /// there are none. Returns the time that has to be counted.
    pub(crate) async fn wait(&self, longest: Duration) -> Duration {
        if !self.watched.lock().is_empty() {
            tokio::time::sleep(LOOK).await;
            return LOOK;
        }
        match tokio::time::timeout(longest, self.added.notified()).await {
            Ok(()) => Duration::ZERO,
            Err(_) => longest,
        }
    }

    /// Runs the callbacks for sessions that ended since the last call.
    pub(crate) fn look(&self) {
        let mut gone: Vec<u32> = Vec::new();
        self.watched.lock().retain(|session, presence| {
            let stays = presence.lasts();
            if !stays {
                gone.push(*session);
            }
            stays
        });
        if gone.is_empty() {
            return;
        }
        let told: Vec<Told> = self.told.read().clone();
        gone.sort_unstable();
        for session in gone {
            for one in &told {
                one(session);
            }
        }
    }
}

/// The user name of anonymous users; reserved.
pub(crate) const ANONYMOUS: &str = "anonymous";
/// Interval of checking sessions.
const LOOK: Duration = Duration::from_millis(50);

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicBool, Ordering};

    use super::*;

    #[tokio::test]
    async fn sessions_are_checked_often_only_while_there_are_any() {
        let sessions = Sessions::default();
        let longest = Duration::from_millis(1);
        assert_eq!(sessions.wait(longest).await, longest);
        let presence = SessionPresence::while_(|| true);
        sessions.watched.lock().insert(1, presence);
        assert_eq!(sessions.wait(longest).await, LOOK);
    }

    #[test]
    fn the_end_of_a_session_is_reported_once() {
        let sessions = Sessions::default();
        let ended = Arc::new(Mutex::new(Vec::new()));
        let told = Arc::clone(&ended);
        sessions.tell(Arc::new(move |session| told.lock().push(session)));
        let lasts = Arc::new(AtomicBool::new(true));
        let present = Arc::clone(&lasts);
        let presence = SessionPresence::while_(move || present.load(Ordering::Relaxed));
        sessions.watched.lock().insert(7, presence);
        sessions.look();
        assert!(ended.lock().is_empty());
        lasts.store(false, Ordering::Relaxed);
        sessions.look();
        sessions.look();
        assert_eq!(*ended.lock(), [7]);
    }
}
