//! Sessions that have called or written something: who they are, and when they are gone.

use std::collections::HashMap;
use std::sync::{Arc, Weak};
use std::time::Duration;

use opcua::server::node_manager::RequestContext;
use opcua::sync::{Mutex, RwLock};
use opcua::types::MessageSecurityMode;

type Told = Arc<dyn Fn(u32) + Send + Sync>;

/// Who calls or writes.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Caller {
    /// The session, unique while the server runs.
    pub session: u32,
    /// The user, `anonymous` for anonymous ones.
    pub user: String,
    /// The ApplicationUri the client gave. Anybody can give any: see `proven`.
    pub application_uri: String,
    /// Whether the certificate of the client, which the server trusts, has that ApplicationUri.
    pub proven: bool,
    /// Whether nobody else can read what is said: signed and encrypted.
    pub encrypted: bool,
    /// The DER of the client's certificate, whose key it has; `None` without security.
    pub certificate: Option<Arc<[u8]>>,
}

impl Caller {
    /// Who is behind a request.
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

/// Whether the session of a request is still there.
#[derive(Clone)]
pub struct Presence(Arc<dyn Fn() -> bool + Send + Sync>);

impl std::fmt::Debug for Presence {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_tuple("Presence").field(&self.lasts()).finish()
    }
}

impl Presence {
    pub(crate) fn of(context: &RequestContext) -> Self {
        // The type of the library's sessions has no public name.
        let session = Arc::downgrade(&context.session);
        Self::while_(move || Weak::upgrade(&session).is_some_and(|one| one.read().is_activated()))
    }

    pub(crate) fn while_(lasts: impl Fn() -> bool + Send + Sync + 'static) -> Self {
        Self(Arc::new(lasts))
    }

    /// Whether it is there now.
    #[must_use]
    pub fn lasts(&self) -> bool {
        (self.0)()
    }
}

/// The sessions that are looked after.
#[derive(Default)]
pub(crate) struct Sessions {
    watched: Mutex<HashMap<u32, Presence>>,
    told: RwLock<Vec<Told>>,
}

impl Sessions {
    /// Who is behind a request, and looks after that session from now on.
    pub(crate) fn caller(&self, context: &RequestContext) -> Caller {
        let mut watched = self.watched.lock();
        watched
            .entry(context.session_id)
            .or_insert_with(|| Presence::of(context));
        drop(watched);
        Caller::of(context)
    }

    pub(crate) fn tell(&self, told: Told) {
        self.told.write().push(told);
    }

    /// Tells of the sessions that are gone since the last look.
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

/// The name of users without a name; no other user has it.
pub(crate) const ANONYMOUS: &str = "anonymous";
/// How often it is looked.
pub(crate) const LOOK: Duration = Duration::from_millis(50);
