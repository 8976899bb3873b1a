//! The shared state of the methods: permissions, the register and the authority.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use log_limit::LogLimit;
use opcua::server::ANONYMOUS_USER_TOKEN_ID;
use opcua::server::authenticator::UserToken;
use opcua::sync::Mutex;
use opcua::types::{
    ByteString, DateTime, Identifier, NodeId, StatusCode, TrustListDataType, Variant,
};
use plant_opcua::judge::CertificateJudge;
use plant_opcua::server::{MethodRefusal, SessionCaller};
use plant_opcua::trust_file::{TrustList, masks};
use plant_opcua::users::{UserAccess, UserRole};
use tracing::{info, warn};
use trust::{Certificate, Fingerprint};

use crate::applicants::{Applicants, OWN};
use crate::records::{GdsRecord, RecordFault, Records};
use crate::store::{AuthorityStore, AuthorityStoreFault};

/// The result of a method.
pub(crate) type MethodResult = Result<Vec<Variant>, MethodRefusal>;

/// The register and the authority.
pub(crate) struct Gds {
    pub(crate) store: Mutex<AuthorityStore>,
    pub(crate) records: Mutex<Records>,
    /// Applications that wait for their first certificate and are not registered.
    pub(crate) applicants: Mutex<Applicants>,
    /// The private keys that were created for requests, in PEM, by the numbers of the requests.
    /// They are never stored.
    pub(crate) keys: Mutex<BTreeMap<u32, String>>,
    /// The folder of the authority, with the lists that the command line shares.
    pub(crate) folder: PathBuf,
    /// Checks the certificates of callers with the store of the server.
    pub(crate) judge: CertificateJudge,
    /// Limits the log entries that unauthenticated clients can cause.
    pub(crate) logged: Mutex<LogLimit>,
    /// The revocation list in the store of the server itself.
    pub(crate) known: Mutex<Vec<u8>>,
    pub(crate) access: Arc<UserAccess>,
    /// The certificate store of the server itself.
    pub(crate) pki: PathBuf,
    /// The life of issued certificates.
    pub(crate) life: Duration,
    /// The index of the GDS namespace.
    pub(crate) namespace: u16,
}

impl Gds {
    /// Checks if a caller may change an application or request its certificates. Allowed are a
    /// security administrator, and the application itself if its certificate proves its identity.
    ///
    /// # Errors
    /// Returns the status for the caller.
    pub(crate) fn may(&self, caller: &SessionCaller, uri: &str) -> Result<(), StatusCode> {
        match self.standing(caller, uri)? {
            CallerStanding::Administrator | CallerStanding::Itself => Ok(()),
            CallerStanding::Applicant(_) | CallerStanding::Stranger => {
                Err(StatusCode::BadUserAccessDenied)
            }
        }
    }

    /// Returns the standing of a caller for the application with a URI.
    ///
    /// # Errors
    /// Returns `BadSecurityModeInsufficient` if the channel is not encrypted.
    pub(crate) fn standing(
        &self,
        caller: &SessionCaller,
        uri: &str,
    ) -> Result<CallerStanding, StatusCode> {
        self.is_unread(caller)?;
        if self.is_administrator(caller) {
            return Ok(CallerStanding::Administrator);
        }
        let Some(certificate) = Self::proof(caller, uri) else {
            return Ok(CallerStanding::Stranger);
        };
        let key = certificate.key_fingerprint();
        if self.is_trusted(&certificate) || self.has_issued(uri, key) {
            Ok(CallerStanding::Itself)
        } else {
            Ok(CallerStanding::Applicant(key))
        }
    }

    /// Returns the certificate of a caller if it has the ApplicationUri. It may be untrusted.
    pub(crate) fn proof(caller: &SessionCaller, uri: &str) -> Option<Certificate> {
        let shown = caller.certificate.as_deref();
        let shown = shown.filter(|_| caller.proven && caller.application_uri == uri);
        Certificate::read(shown?).ok()
    }

    /// Returns whether the store of the server trusts a certificate.
    pub(crate) fn is_trusted(&self, certificate: &Certificate) -> bool {
        trust::check(certificate, &[], &self.judge.known(), now()).is_ok()
    }

    /// Returns whether the authority has issued a certificate to an application with that key, and
    /// revoked none of the key.
    fn has_issued(&self, uri: &str, key: Fingerprint) -> bool {
        let all = self.store.lock().list().unwrap_or_default();
        let mut own = all.iter().filter(|one| {
            one.certificate.key_fingerprint() == key
                && one.certificate.application_uri().as_deref() == Some(uri)
        });
        let first = own.next();
        first.is_some_and(|one| one.revoked.is_none()) && own.all(|one| one.revoked.is_none())
    }

    /// Requires an encrypted channel.
    ///
    /// # Errors
    /// Returns `BadSecurityModeInsufficient` if others could read the messages.
    pub(crate) fn is_unread(&self, caller: &SessionCaller) -> Result<(), StatusCode> {
        if caller.encrypted {
            Ok(())
        } else {
            Err(StatusCode::BadSecurityModeInsufficient)
        }
    }

    pub(crate) fn is_administrator(&self, caller: &SessionCaller) -> bool {
        // No user can have the name of this token.
        let name = match caller.user.as_str() {
            "anonymous" => ANONYMOUS_USER_TOKEN_ID,
            name => name,
        };
        let token = UserToken(name.to_owned());
        self.access.roles(&token).contains(UserRole::SecurityAdmin)
    }

    /// Returns the application with an ApplicationId that the caller may change.
    ///
    /// # Errors
    /// Returns the status for the caller.
    pub(crate) fn own(&self, caller: &SessionCaller, id: &NodeId) -> Result<GdsRecord, StatusCode> {
        self.is_unread(caller)?;
        let known = number(id).and_then(|number| self.records.lock().get(number).cloned());
        let Some(record) = known else {
            return Err(StatusCode::BadNotFound);
        };
        self.may(caller, &record.uri)?;
        Ok(record)
    }

    /// Revokes certificates of an application, and updates the revocation list of the server
    /// itself.
    pub(crate) fn revoke(
        &self,
        gone: &[Certificate],
        now: Duration,
    ) -> Result<(), AuthorityStoreFault> {
        let store = self.store.lock();
        for one in gone {
            store.revoke(&one.serial(), now)?;
            info!(name = ?one.name(), application = ?one.application_uri().unwrap_or_default(), serial = %one.serial(), "revoked a certificate");
        }
        drop(store);
        self.know(now)
    }

    /// Copies the current revocation list to the store of the server itself, so that it refuses
    /// revoked certificates.
    pub(crate) fn know(&self, now: Duration) -> Result<(), AuthorityStoreFault> {
        let list = self.store.lock().current_list(now)?;
        let mut known = self.known.lock();
        if *known == list.der() {
            return Ok(());
        }
        list.der().clone_into(&mut known);
        drop(known);
        if let Err(error) = plant_opcua::known::put_crl(&self.pki, &list) {
            warn!(%error, "cannot add the revocation list to the store of the server");
        }
        Ok(())
    }
}

/// The standing of a caller for an application.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum CallerStanding {
    /// A user with the role SecurityAdmin.
    Administrator,
    /// The application, with a trusted certificate or with a key that has a certificate of the
    /// authority.
    Itself,
    /// A client with an untrusted certificate that names the application. Contains the SHA-256 of
    /// its key.
    Applicant(Fingerprint),
    /// Any other client.
    Stranger,
}

/// The certificate and the revocation list of the authority, as a trust list for applications.
pub(crate) struct GroupList(pub(crate) Arc<Gds>);

impl TrustList for GroupList {
    fn list(&self, masks: u32) -> TrustListDataType {
        let store = self.0.store.lock();
        let lists = store.current_list(now());
        let authority = ByteString::from(store.certificate().der().to_vec());
        drop(store);
        let revoked = match lists {
            Ok(list) => vec![ByteString::from(list.der().to_vec())],
            Err(error) => {
                warn!(%error, "cannot read the revocation list");
                Vec::new()
            }
        };
        let wanted = |mask: u32, all: Vec<ByteString>| (masks & mask != 0).then_some(all);
        TrustListDataType {
            specified_lists: masks,
            trusted_certificates: wanted(masks::TRUSTED_CERTIFICATES, vec![authority]),
            trusted_crls: wanted(masks::TRUSTED_CRLS, revoked),
            issuer_certificates: wanted(masks::ISSUER_CERTIFICATES, Vec::new()),
            issuer_crls: wanted(masks::ISSUER_CRLS, Vec::new()),
        }
    }

    fn replace(&self, _list: TrustListDataType) -> Result<bool, StatusCode> {
        Err(StatusCode::BadNotWritable)
    }
}

/// Returns the ApplicationId of a number.
pub(crate) fn id(number: u32) -> NodeId {
    NodeId::new(OWN, number)
}

/// Returns the number in an ApplicationId.
pub(crate) fn number(id: &NodeId) -> Option<u32> {
    match (id.namespace, &id.identifier) {
        (OWN, Identifier::Numeric(number)) => Some(*number),
        _ => None,
    }
}

/// Logs a fault of the authority and returns the status for the caller.
pub(crate) fn refused(fault: &AuthorityStoreFault) -> StatusCode {
    warn!("{fault}");
    if fault.is_io() {
        StatusCode::BadResourceUnavailable
    } else {
        StatusCode::BadInvalidArgument
    }
}

/// Logs a fault of the register and returns the status for the caller.
pub(crate) fn unregistered(fault: &RecordFault, caller: &SessionCaller) -> StatusCode {
    warn!(application = ?caller.application_uri, user = ?caller.user, "refused data of an application from a client: {fault}");
    match fault {
        RecordFault::Present => StatusCode::BadEntryExists,
        RecordFault::Unknown => StatusCode::BadNotFound,
        RecordFault::Unfit(_) => StatusCode::BadInvalidArgument,
        RecordFault::Full => StatusCode::BadResourceUnavailable,
        RecordFault::Io { .. } => StatusCode::BadResourceUnavailable,
    }
}

/// Returns the time since 1970.
pub(crate) fn now() -> Duration {
    plant_opcua::known::now()
}

/// Converts a time in seconds since 1970 into a DateTime.
pub(crate) fn time(seconds: u64) -> Variant {
    let ticks = i64::try_from(seconds).unwrap_or_default();
    let ticks = ticks.saturating_mul(TICKS).saturating_add(TICKS_TO_1970);
    Variant::from(DateTime::from(ticks))
}

/// Returns the texts of an argument, up to a limit.
pub(crate) fn texts(argument: &Variant) -> Vec<String> {
    let Variant::Array(array) = argument else {
        return Vec::new();
    };
    let each = array.values.iter().take(MOST_TEXTS);
    each.filter_map(|one| {
        let Variant::String(text) = one else {
            return None;
        };
        Some(text.as_ref().to_owned())
    })
    .collect()
}

/// Ticks of 100 ns in a second.
const TICKS: i64 = 10_000_000;
/// Ticks from 1601 to 1970.
const TICKS_TO_1970: i64 = 116_444_736_000_000_000;
const MOST_TEXTS: usize = 32;
