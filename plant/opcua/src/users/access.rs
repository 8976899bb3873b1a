//! Authentication and authorization: the library calls this module for each session and each
//! request.

use std::collections::{HashMap, HashSet};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use async_trait::async_trait;
use opcua::crypto::{SecurityPolicy, Thumbprint};
use opcua::server::address_space::AccessLevel;
use opcua::server::authenticator::{
    AuthManager, CoreServerPermissions, Password, UserToken, user_pass_security_policy_id,
};
use opcua::server::{ANONYMOUS_USER_TOKEN_ID, ServerEndpoint};
use opcua::sync::{Mutex, RwLock};
use opcua::types::{
    DateTime, Error, MessageSecurityMode, NodeId, StatusCode, UAString, UserTokenPolicy,
    UserTokenType,
};
use tokio::sync::Semaphore;
use tracing::{info, warn};

use super::file::{Credential, FOLDER, LARGEST_PASSWORD, LIST, UserFault, Users};
use super::password::has_hash;
use super::{Roles, UserRole};
use crate::server::{ANONYMOUS, SessionCaller};

/// A right of a user on a node.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Right {
    /// Read and subscribe.
    Read,
    /// Write.
    Write,
    /// Call.
    Call,
}

/// The roles with rights on a node.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct NodePermissions {
    /// The roles that may read the node.
    pub read: Roles,
    /// The roles that may write the node.
    pub write: Roles,
    /// The roles that may call the node.
    pub call: Roles,
}

impl Default for NodePermissions {
    /// Grants reading to all roles, and writing and calling to operators and engineers.
    fn default() -> Self {
        let runs = Roles::of(&[UserRole::Operator, UserRole::Engineer]);
        Self {
            read: Roles::ALL,
            write: runs,
            call: runs,
        }
    }
}

impl NodePermissions {
    /// Grants every right to all roles.
    pub const OPEN: Self = Self {
        read: Roles::ALL,
        write: Roles::ALL,
        call: Roles::ALL,
    };

    const fn of(&self, right: Right) -> Roles {
        match right {
            Right::Read => self.read,
            Right::Write => self.write,
            Right::Call => self.call,
        }
    }
}

/// The rights of anonymous users.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum AnonymousRights {
    /// The role Observer. Also Operator if the server listens on loopback only and has no users.
    #[default]
    Usual,
    /// The given roles.
    Has(Roles),
    /// Anonymous users are refused.
    Refused,
}

/// The configured permissions of nodes and of anonymous users.
#[derive(Debug, Clone, Default)]
pub struct PermissionRules {
    /// The rights of anonymous users.
    pub anonymous: AnonymousRights,
    /// The nodes with other permissions than the default.
    pub nodes: HashMap<NodeId, NodePermissions>,
    /// The methods that can be called over encrypted connections only.
    pub encrypted: HashSet<NodeId>,
}

/// A login attempt, for audits.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Login {
    /// The given user name; empty for anonymous users and unknown certificates.
    pub user: String,
    /// The kind of user identity: `anonymous`, `password` or `certificate`.
    pub by: &'static str,
    /// The security policy and mode of the endpoint.
    pub endpoint: String,
    /// The reason of a refusal; `None` for a successful login.
    pub fault: Option<LoginFault>,
}

/// The reason of a refused login.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum LoginFault {
    /// Anonymous users are refused.
    #[error("anonymous users are not allowed")]
    Anonymous,
    /// The user does not exist, or the password is wrong.
    #[error("unknown user or wrong password")]
    Password,
    /// No user has the certificate.
    #[error("no user has that certificate (`ua-server user add NAME --certificate FILE`)")]
    Certificate,
    /// The certificate is not valid at the moment.
    #[error("the certificate of the user is not valid at this time")]
    Expired,
}

impl LoginFault {
    /// Returns the status code for the client.
    #[must_use]
    pub const fn status(self) -> StatusCode {
        match self {
            Self::Anonymous | Self::Certificate => StatusCode::BadIdentityTokenRejected,
            Self::Password => StatusCode::BadUserAccessDenied,
            Self::Expired => StatusCode::BadCertificateTimeInvalid,
        }
    }
}

type Told = Arc<dyn Fn(&Login) + Send + Sync>;

/// The users of a server and their permissions.
pub struct UserAccess {
    /// The folder of the users; `None` for a server without users.
    folder: Option<PathBuf>,
    /// Whether the server listens on loopback only.
    is_loopback: bool,
    users: RwLock<Users>,
    /// The state of the file when it was read last.
    stamp: Mutex<Option<Stamp>>,
    rules: RwLock<PermissionRules>,
    /// Limits concurrent password checks: each check uses a CPU core for some time, and memory.
    checking: Arc<Semaphore>,
    told: RwLock<Vec<Told>>,
}

impl std::fmt::Debug for UserAccess {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Access").finish_non_exhaustive()
    }
}

/// The length and the modification time of a file.
type Stamp = (u64, Option<SystemTime>);

impl UserAccess {
    /// Reads the users in a folder.
    ///
    /// # Errors
    /// Returns an error if other users can read the file or if its content is invalid.
    pub fn new(folder: Option<PathBuf>, is_loopback: bool) -> Result<Self, UserFault> {
        let users = folder.as_deref().map(Users::read).transpose()?;
        let access = Self {
            stamp: Mutex::new(folder.as_deref().and_then(stamp)),
            folder,
            is_loopback,
            users: RwLock::new(users.unwrap_or_default()),
            rules: RwLock::default(),
            checking: Arc::new(Semaphore::new(MOST_CHECKS)),
            told: RwLock::default(),
        };
        Ok(access)
    }

    /// Reads the users of a certificate store. Anonymous users have the roles `anonymous`.
    ///
    /// # Errors
    /// Returns an error if other users can read the file or if its content is invalid.
    pub fn of_store(pki: Option<&Path>, anonymous: Roles) -> Result<Self, UserFault> {
        let access = Self::new(pki.map(|pki| pki.join(FOLDER)), false)?;
        access.set_rules(PermissionRules {
            anonymous: AnonymousRights::Has(anonymous),
            ..PermissionRules::default()
        });
        Ok(access)
    }

    /// Replaces the rules, also for open sessions.
    pub fn set_rules(&self, rules: PermissionRules) {
        *self.rules.write() = rules;
    }

    /// Sets the permissions on a node, also for open sessions.
    pub fn permit(&self, node: NodeId, permissions: NodePermissions) {
        self.rules.write().nodes.insert(node, permissions);
    }

    /// Registers a callback for login attempts.
    pub fn on_login(&self, told: impl Fn(&Login) + Send + Sync + 'static) {
        self.told.write().push(Arc::new(told));
    }

    /// Reads the users again if their file changed. If the file is invalid, the previous users
    /// stay.
    pub fn look(&self) {
        let Some(folder) = &self.folder else { return };
        let now = stamp(folder);
        let mut before = self.stamp.lock();
        if *before == now {
            return;
        }
        *before = now;
        match Users::read(folder) {
            Ok(users) => {
                info!(users = users.iter().count(), "reloaded the users");
                *self.users.write() = users;
            }
            Err(error) => warn!("{error}; the previous users stay in use"),
        }
    }

    /// Returns the current roles of a user.
    #[must_use]
    pub fn roles(&self, token: &UserToken) -> Roles {
        if token.is_anonymous() {
            return self.anonymous().unwrap_or(Roles::NONE);
        }
        let users = self.users.read();
        users.get(&token.0).map_or(Roles::NONE, |user| user.roles)
    }

    /// Returns whether the server has users.
    #[must_use]
    pub fn has_users(&self) -> bool {
        !self.users.read().is_empty()
    }

    /// Returns the current roles of a user by name; `None` if there is no such user.
    #[must_use]
    pub fn roles_of_user(&self, name: &str) -> Option<Roles> {
        self.users.read().get(name).map(|user| user.roles)
    }

    /// Checks the password of a user and reports the attempt, as for a session. A wrong password
    /// takes a second. `endpoint` describes how the user has reached the server.
    pub async fn sign_in(&self, name: &str, password: String, endpoint: &str) -> bool {
        let mut login = Login {
            user: name.chars().take(64).collect(),
            by: "password",
            endpoint: endpoint.to_owned(),
            fault: None,
        };
        self.log_in(&mut login, name, &password).await;
        self.tell(&login);
        login.fault.is_none()
    }

    /// Checks a password and notes a fault.
    async fn log_in(&self, login: &mut Login, name: &str, password: &str) {
        if !self.check(name, password).await {
            login.fault = Some(LoginFault::Password);
            // Delays repeated attempts; a connection has a single attempt at a time.
            tokio::time::sleep(AFTER_A_WRONG_ONE).await;
        }
    }

    /// Returns the roles of the user of a caller.
    #[must_use]
    pub fn roles_of(&self, caller: &SessionCaller) -> Roles {
        if caller.user == ANONYMOUS {
            return self.anonymous().unwrap_or(Roles::NONE);
        }
        let users = self.users.read();
        users
            .get(&caller.user)
            .map_or(Roles::NONE, |user| user.roles)
    }

    /// Returns the roles of anonymous clients.
    #[must_use]
    pub fn roles_of_anonymous(&self) -> Roles {
        self.anonymous().unwrap_or(Roles::NONE)
    }

    /// Returns the roles of a user with a password; none if the password is wrong, see
    /// [`sign_in`](Self::sign_in).
    pub async fn roles_by_password(&self, name: &str, password: &str, endpoint: &str) -> Roles {
        if self.sign_in(name, password.to_owned(), endpoint).await {
            self.roles_of_user(name).unwrap_or(Roles::NONE)
        } else {
            Roles::NONE
        }
    }

    /// Returns whether a user has a right on a node at the moment. Nodes of the core namespace are
    /// open to all users unless the rules contain them.
    #[must_use]
    pub fn allows(&self, token: &UserToken, node: &NodeId, right: Right) -> bool {
        let rules = self.rules.read();
        let permissions = match rules.nodes.get(node) {
            Some(permissions) => *permissions,
            None if node.namespace == 0 => return true,
            None => NodePermissions::default(),
        };
        drop(rules);
        self.roles(token).meets(permissions.of(right))
    }

    /// Returns the permissions on a node.
    #[must_use]
    pub fn permissions(&self, node: &NodeId) -> NodePermissions {
        let rules = self.rules.read();
        let usual = || match node.namespace {
            0 => NodePermissions::OPEN,
            _ => NodePermissions::default(),
        };
        rules.nodes.get(node).copied().unwrap_or_else(usual)
    }

    /// Returns whether a method can be called over encrypted connections only.
    #[must_use]
    pub fn is_encrypted(&self, node: &NodeId) -> bool {
        self.rules.read().encrypted.contains(node)
    }

    /// Returns the users with a role: their names, and the thumbprints of their certificates.
    #[must_use]
    pub fn users_of(&self, role: UserRole) -> Vec<(String, Option<String>)> {
        let users = self.users.read();
        let has_role = users.iter().filter(|(_, user)| user.roles.contains(role));
        let identity = has_role.map(|(name, user)| match &user.credential {
            Credential::Password(_) => (name.to_owned(), None),
            Credential::Certificate(thumbprint) => (name.to_owned(), Some(thumbprint.clone())),
        });
        identity.collect()
    }

    /// Returns whether all admitted users may read a node.
    #[must_use]
    pub fn is_public(&self, node: &NodeId) -> bool {
        let rules = self.rules.read();
        let permissions = rules.nodes.get(node);
        permissions.is_none_or(|permissions| permissions.read == Roles::ALL)
    }

    /// Returns the roles of anonymous users; `None` if they are refused.
    fn anonymous(&self) -> Option<Roles> {
        match self.rules.read().anonymous {
            AnonymousRights::Has(roles) => Some(roles),
            AnonymousRights::Refused => None,
            AnonymousRights::Usual if self.is_loopback && self.users.read().is_empty() => {
                Some(Roles::of(&[UserRole::Observer, UserRole::Operator]))
            }
            AnonymousRights::Usual => Some(Roles::of(&[UserRole::Observer])),
        }
    }

    fn tell(&self, login: &Login) {
        let told: Vec<Told> = self.told.read().clone();
        for one in told {
            one(login);
        }
    }

    /// Reports a login attempt, and returns its result for the library.
    fn answered(&self, login: &Login, token: UserToken) -> Result<UserToken, Error> {
        self.tell(login);
        match login.fault {
            None => Ok(token),
            Some(fault) => Err(Error::new(fault.status(), fault.to_string())),
        }
    }

    /// Checks the password of a user. The check takes the same time if the user does not exist.
    async fn check(&self, name: &str, password: &str) -> bool {
        let hash = match self.users.read().get(name).map(|user| &user.credential) {
            Some(Credential::Password(hash)) => Some(hash.clone()),
            Some(Credential::Certificate(_)) | None => None,
        };
        let password = password.as_bytes().to_vec();
        if password.len() > LARGEST_PASSWORD {
            return false;
        }
        let Ok(permit) = Arc::clone(&self.checking).acquire_owned().await else {
            return false;
        };
        let known = hash.is_some();
        let checked = tokio::task::spawn_blocking(move || {
            let _held = permit;
            let hash = hash.as_deref().unwrap_or(NOBODYS);
            has_hash(&password, hash)
        });
        checked.await.unwrap_or(false) && known
    }
}

/// Returns a value that changes when the file of users changes.
fn stamp(folder: &Path) -> Option<Stamp> {
    let about = std::fs::metadata(folder.join(LIST)).ok()?;
    Some((about.len(), about.modified().ok()))
}

fn is_secured(endpoint: &ServerEndpoint) -> bool {
    endpoint.message_security_mode() != MessageSecurityMode::None
}

fn login(by: &'static str, user: &str, endpoint: &ServerEndpoint) -> Login {
    Login {
        user: user.to_owned(),
        by,
        endpoint: format!("{} {}", endpoint.security_policy, endpoint.security_mode),
        fault: None,
    }
}

#[async_trait]
impl AuthManager for UserAccess {
    async fn authenticate_anonymous_token(&self, endpoint: &ServerEndpoint) -> Result<(), Error> {
        let mut login = login("anonymous", "", endpoint);
        if self.anonymous().is_none() {
            login.fault = Some(LoginFault::Anonymous);
        }
        let token = UserToken(ANONYMOUS_USER_TOKEN_ID.to_owned());
        self.answered(&login, token).map(drop)
    }

    async fn authenticate_username_identity_token(
        &self,
        endpoint: &ServerEndpoint,
        username: &str,
        password: &Password,
    ) -> Result<UserToken, Error> {
        let told: String = username.chars().take(64).collect();
        let mut login = login("password", &told, endpoint);
        self.log_in(&mut login, username, password.get()).await;
        self.answered(&login, UserToken(username.to_owned()))
    }

    async fn authenticate_x509_identity_token(
        &self,
        endpoint: &ServerEndpoint,
        signing_thumbprint: &Thumbprint,
    ) -> Result<UserToken, Error> {
        let thumbprint = signing_thumbprint.as_hex_string().to_lowercase();
        let user = {
            let users = self.users.read();
            users
                .of_certificate(&thumbprint)
                .map(|(name, _)| name.to_owned())
        };
        let mut login = login("certificate", user.as_deref().unwrap_or_default(), endpoint);
        let kept = self
            .folder
            .as_deref()
            .map(|folder| Users::certificate(folder, &thumbprint));
        login.fault = match (&user, kept) {
            (Some(_), Some(Ok(certificate))) => {
                let now = DateTime::now().as_chrono();
                let valid = certificate.is_time_valid(&now).is_ok();
                (!valid).then_some(LoginFault::Expired)
            }
            (Some(name), Some(Err(error))) => {
                warn!(user = name, "{error}");
                Some(LoginFault::Certificate)
            }
            (None, _) | (_, None) => Some(LoginFault::Certificate),
        };
        self.answered(&login, UserToken(user.unwrap_or_default()))
    }

    fn effective_user_access_level(
        &self,
        token: &UserToken,
        user_access_level: AccessLevel,
        node_id: &NodeId,
    ) -> AccessLevel {
        let mut level = user_access_level;
        if !self.allows(token, node_id, Right::Read) {
            level.remove(AccessLevel::CURRENT_READ | AccessLevel::HISTORY_READ);
        }
        if !self.allows(token, node_id, Right::Write) {
            level.remove(AccessLevel::CURRENT_WRITE | AccessLevel::HISTORY_WRITE);
        }
        level
    }

    fn is_user_executable(&self, token: &UserToken, method_id: &NodeId) -> bool {
        self.allows(token, method_id, Right::Call)
    }

    /// Passwords and signatures are requested only on secured endpoints.
    fn user_token_policies(&self, endpoint: &ServerEndpoint) -> Vec<UserTokenPolicy> {
        let policy = |id: UAString, token_type, security: Option<SecurityPolicy>| UserTokenPolicy {
            policy_id: id,
            token_type,
            issued_token_type: UAString::null(),
            issuer_endpoint_url: UAString::null(),
            security_policy_uri: security
                .map_or_else(UAString::null, |one| UAString::from(one.to_uri())),
        };
        let mut policies = Vec::new();
        if self.anonymous().is_some() {
            policies.push(policy(
                ANONYMOUS_POLICY.into(),
                UserTokenType::Anonymous,
                None,
            ));
        }
        if self.folder.is_some() && is_secured(endpoint) {
            let own = Some(endpoint.security_policy());
            let by_name = user_pass_security_policy_id(endpoint);
            policies.push(policy(by_name, UserTokenType::UserName, own));
            policies.push(policy(X509_POLICY.into(), UserTokenType::Certificate, own));
        }
        policies
    }

    fn core_permissions(&self, token: &UserToken) -> CoreServerPermissions {
        let sees = Roles::of(&[
            UserRole::Operator,
            UserRole::Engineer,
            UserRole::SecurityAdmin,
        ]);
        CoreServerPermissions {
            read_diagnostics: self.roles(token).meets(sees),
        }
    }
}

/// The policy ids of the library.
const ANONYMOUS_POLICY: &str = "anonymous";
const X509_POLICY: &str = "x509";
/// Maximum number of concurrent password checks.
const MOST_CHECKS: usize = 2;
const AFTER_A_WRONG_ONE: Duration = Duration::from_secs(1);
/// The hash that is compared if the user does not exist.
const NOBODYS: &str = "$argon2id$v=19$m=19456,t=2,p=1$bm9ib2R5LWhhcy1pdC4uLg$AAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAA";

#[cfg(test)]
mod tests {
    use super::*;

    fn anonymous() -> UserToken {
        UserToken(ANONYMOUS_USER_TOKEN_ID.to_owned())
    }

    fn scratch(name: &str) -> PathBuf {
        let path =
            std::env::temp_dir().join(format!("plant-opcua-access-{}-{name}", std::process::id()));
        drop(std::fs::remove_dir_all(&path));
        path
    }

    #[test]
    fn anonymous_users_read_and_where_nobody_else_is_they_write() {
        let folder = scratch("anonymous");
        let node = NodeId::new(2, 10);
        for (is_loopback, has_users, writes) in [
            (true, false, true),
            (true, true, false),
            (false, false, false),
            (false, true, false),
        ] {
            let mut users = Users::default();
            if has_users {
                let user = super::super::StoredUser {
                    roles: Roles::of(&[UserRole::Operator]),
                    credential: Credential::Certificate("0".repeat(40)),
                };
                users.put("plc", user).unwrap();
            }
            users.write(&folder).unwrap();
            let access = UserAccess::new(Some(folder.clone()), is_loopback).unwrap();
            assert!(access.allows(&anonymous(), &node, Right::Read));
            assert_eq!(access.allows(&anonymous(), &node, Right::Write), writes);
            assert_eq!(access.allows(&anonymous(), &node, Right::Call), writes);
        }
        std::fs::remove_dir_all(folder).unwrap();
    }

    #[test]
    fn a_user_who_is_taken_away_may_nothing_more() {
        let folder = scratch("gone");
        let mut users = Users::default();
        let user = super::super::StoredUser {
            roles: Roles::of(&[UserRole::Engineer]),
            credential: Credential::Certificate("0".repeat(40)),
        };
        users.put("anna", user).unwrap();
        users.write(&folder).unwrap();
        let access = UserAccess::new(Some(folder.clone()), true).unwrap();
        let anna = UserToken("anna".to_owned());
        let node = NodeId::new(2, 10);
        assert!(access.allows(&anna, &node, Right::Write));
        users.remove("anna").unwrap();
        users.write(&folder).unwrap();
        access.look();
        assert!(!access.allows(&anna, &node, Right::Write));
        assert!(!access.allows(&anna, &node, Right::Read));
        std::fs::remove_dir_all(folder).unwrap();
    }

    #[test]
    fn a_node_has_permissions_of_its_own() {
        let access = UserAccess::new(None, true).unwrap();
        let node = NodeId::new(2, 10);
        let engineers = NodePermissions {
            write: Roles::of(&[UserRole::Engineer]),
            ..NodePermissions::default()
        };
        access.set_rules(PermissionRules {
            anonymous: AnonymousRights::Has(Roles::of(&[UserRole::Operator])),
            nodes: HashMap::from([(node.clone(), engineers)]),
            ..PermissionRules::default()
        });
        assert!(!access.allows(&anonymous(), &node, Right::Write));
        assert!(access.allows(&anonymous(), &NodeId::new(2, 11), Right::Write));
        let level = AccessLevel::CURRENT_READ | AccessLevel::CURRENT_WRITE;
        let left = access.effective_user_access_level(&anonymous(), level, &node);
        assert_eq!(left.bits(), AccessLevel::CURRENT_READ.bits());
    }

    #[tokio::test]
    async fn a_password_opens_for_its_user_alone() {
        let folder = scratch("password");
        let mut users = Users::default();
        let user = super::super::StoredUser {
            roles: Roles::of(&[UserRole::Operator]),
            credential: super::super::hashed(b"correct horse").unwrap(),
        };
        users.put("anna", user).unwrap();
        users.write(&folder).unwrap();
        let access = UserAccess::new(Some(folder.clone()), true).unwrap();
        assert!(access.check("anna", "correct horse").await);
        assert!(!access.check("anna", "correct house").await);
        assert!(!access.check("bert", "correct horse").await);
        assert!(
            access
                .sign_in("anna", "correct horse".to_owned(), "page")
                .await
        );
        assert!(
            !access
                .sign_in("anna", "correct house".to_owned(), "page")
                .await
        );
        assert_eq!(
            access.roles_of_user("anna"),
            Some(Roles::of(&[UserRole::Operator]))
        );
        assert_eq!(
            (access.roles_of_user("bert"), access.has_users()),
            (None, true)
        );
        let roles = access
            .roles_by_password("anna", "correct horse", "SPARQL")
            .await;
        assert_eq!(roles, Roles::of(&[UserRole::Operator]));
        let none = access
            .roles_by_password("anna", "correct house", "SPARQL")
            .await;
        assert_eq!(none, Roles::NONE);
        std::fs::remove_dir_all(folder).unwrap();
    }
}
