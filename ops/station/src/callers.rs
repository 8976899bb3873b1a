//! The callers of a station: their permissions, and their sessions at each server.
//!
//! A lock, a lease or a run of a server belongs to a session. So each caller has its own session at
//! each server that it calls, for the lifetime of its session at the station.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError, Weak};
use std::time::Duration;

use plant_opcua::client::{ClientError, OpcUaClient};
use plant_opcua::server::SessionCaller;
use plant_opcua::supervision::Supervision;
use plant_opcua::types::{DateTime, StatusCode};
use plant_opcua::users::{Roles, UserAccess, UserRole};
use tokio::time::Instant;

use crate::board::{Board, Level};

/// Checks callers on a level.
#[derive(Clone)]
pub(crate) struct CallerCheck {
    pub(crate) users: Arc<UserAccess>,
    pub(crate) board: Arc<Board>,
    /// The level of the callers.
    pub(crate) level: Level,
    /// The supervisor of the station, which may configure the servers behind it.
    pub(crate) supervision: Supervision,
}

impl CallerCheck {
    /// Checks that the calls of a caller are forwarded. The caller must be a server of its level
    /// with a verified certificate, or a user with the role operator or engineer.
    ///
    /// # Errors
    /// BadUserAccessDenied for other callers.
    pub(crate) fn check(&self, caller: &SessionCaller) -> Result<(), StatusCode> {
        let is_peer = caller.proven
            && caller.encrypted
            && self.board.knows(self.level, &caller.application_uri);
        let calls = Roles::of(&[UserRole::Operator, UserRole::Engineer]);
        match is_peer || self.users.roles_of(caller).meets(calls) {
            true => Ok(()),
            false => Err(StatusCode::BadUserAccessDenied),
        }
    }

    /// Checks that a caller may configure the servers behind the station, which accept what the
    /// station sends them: only the supervisor of the station, and users with the role
    /// ConfigureAdmin.
    ///
    /// # Errors
    /// BadUserAccessDenied for other callers.
    pub(crate) fn check_configures(&self, caller: &SessionCaller) -> Result<(), StatusCode> {
        let roles = self.users.roles_of(caller);
        self.supervision.admits(caller, roles)
    }
}

/// The sessions at a server.
pub(crate) struct Callers {
    /// The session of the station itself.
    client: OpcUaClient,
    /// The run of the server for which the shown NodeIds are valid, by its start time.
    run: Mutex<Option<DateTime>>,
    sessions: Mutex<BTreeMap<u32, OpcUaClient>>,
}

impl Callers {
    pub(crate) fn new(client: OpcUaClient) -> Self {
        Self {
            client,
            run: Mutex::default(),
            sessions: Mutex::default(),
        }
    }

    /// Sets the run of the server for which the shown NodeIds are valid. Without a run, no call is
    /// forwarded.
    pub(crate) fn serve(&self, run: Option<DateTime>) {
        *self.run.lock().unwrap_or_else(PoisonError::into_inner) = run;
    }

    /// Returns the client of a caller, connected to the same run of the server as the station
    /// itself. The server of the station drops this future at the timeout of the caller, and
    /// nothing is forwarded then.
    ///
    /// # Errors
    /// There is no such connection.
    pub(crate) async fn client_of(&self, session: u32) -> Result<OpcUaClient, ClientError> {
        let client = {
            let mut sessions = self.lock();
            let own = sessions.entry(session);
            own.or_insert_with(|| self.client.another()).clone()
        };
        let until = Instant::now() + LONGEST_WAIT;
        while let Err(error) = client.up(CONNECT_LIMIT).await {
            // A server that executes the call of another caller does not create sessions meanwhile.
            if !client.is_calling() || Instant::now() >= until {
                return Err(error);
            }
        }
        let run = *self.run.lock().unwrap_or_else(PoisonError::into_inner);
        let is_current = run.is_some() && client.started() == run;
        // NodeIds are valid as long as the namespaces are the same. A server may have added further
        // namespaces between the two connections.
        let (ours, theirs) = (self.client.namespaces(), client.namespaces());
        if is_current && ours.iter().zip(&theirs).all(|(our, their)| our == their) {
            return Ok(client);
        }
        let another = "the server was restarted".to_owned();
        Err(ClientError::NotConnected(another))
    }

    /// Closes the session of a caller at the server after its session at the station has closed.
    pub(crate) fn gone(&self, session: u32) {
        // Dropping the last handle closes the client.
        let _closed = self.lock().remove(&session);
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, BTreeMap<u32, OpcUaClient>> {
        self.sessions.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// The sessions at all servers that a face shows.
#[derive(Clone, Default)]
pub(crate) struct AllCallers(Arc<Mutex<Vec<Weak<Callers>>>>);

impl AllCallers {
    pub(crate) fn add(&self, callers: &Arc<Callers>) {
        let mut all = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        all.retain(|known| known.strong_count() > 0);
        all.push(Arc::downgrade(callers));
    }

    pub(crate) fn gone(&self, session: u32) {
        let all = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        for callers in all.iter().filter_map(Weak::upgrade) {
            callers.gone(session);
        }
    }
}

const CONNECT_LIMIT: Duration = Duration::from_secs(4);
/// Longest wait of a caller without a timeout.
const LONGEST_WAIT: Duration = Duration::from_secs(60);

#[cfg(test)]
mod tests {
    use plant_opcua::supervision::Registrar;

    use super::*;
    use crate::board::CONNECTED;

    #[test]
    fn calls_of_servers_of_the_level_and_of_operators_are_passed_on_and_of_nobody_else() {
        let (board, _added) = Board::new();
        let board = Arc::new(board);
        let observer = Roles::of(&[UserRole::Observer]);
        let admission = |anonymous| CallerCheck {
            users: Arc::new(UserAccess::of_store(None, anonymous).unwrap()),
            board: Arc::clone(&board),
            level: Level::Above,
            supervision: Supervision::default(),
        };
        let strict = admission(observer);
        let caller = |proven: bool| SessionCaller {
            session: 1,
            user: "anonymous".to_owned(),
            application_uri: "urn:b".to_owned(),
            proven,
            encrypted: true,
            certificate: None,
        };
        let denied = Err(StatusCode::BadUserAccessDenied);
        assert_eq!(
            strict.check(&caller(true)),
            denied,
            "a certificate is no role"
        );
        let name = board.enter(Level::Above, "u", "b");
        board.note(Level::Above, "u", |peer| {
            peer.uri = "urn:b".to_owned();
            peer.state = CONNECTED;
        });
        assert_eq!(name, "b");
        assert_eq!(strict.check(&caller(true)), denied, "it was not checked");
        board.note(Level::Above, "u", |peer| peer.secured = true);
        assert_eq!(strict.check(&caller(true)), Ok(()));
        assert_eq!(strict.check(&caller(false)), denied, "anybody says so");
        let operator = Roles::of(&[UserRole::Operator]);
        assert_eq!(admission(operator).check(&caller(false)), Ok(()));

        // Devices accept what their station sends, so an operator configures nothing through it.
        for check in [&strict, &admission(operator)] {
            assert_eq!(check.check_configures(&caller(true)), denied);
        }
        strict.supervision.registered_with(Registrar {
            application_uri: "urn:b".to_owned(),
            proven: true,
        });
        assert_eq!(strict.check_configures(&caller(true)), Ok(()));
        assert_eq!(strict.check_configures(&caller(false)), denied);
        let admin = Roles::of(&[UserRole::ConfigureAdmin]);
        assert_eq!(admission(admin).check_configures(&caller(false)), Ok(()));
    }
}
