//! The certificates of applications (OPC 10000-12, 7.9): requests, issue and revocation.

use std::io;
use std::sync::Arc;

use async_trait::async_trait;
use opcua::types::{ByteString, Identifier, NodeId, ObjectTypeId, StatusCode, UAString, Variant};
use plant_opcua::server::{MethodHandler, MethodRefusal, MethodRequest, SessionCaller};
use tokio::time::Instant;
use tracing::{info, warn};
use trust::{
    Certificate, CertificateFault, CertificateSigningRequest, Fingerprint, Renewal, RenewalStep,
    TrustedCertificates,
};

use crate::applicants::OWN;
use crate::invitations::{self, Invitations, Shows};
use crate::kept;
use crate::records::GdsRecord;
use crate::requests::{self, NewRequest, RequestState, SigningRequest, SigningRequests};
use crate::service::{CallerStanding, Gds, MethodResult, now, number, refused, texts, time};
use crate::store::{new_key, pem_of};

/// StartSigningRequest: stores the request and returns the RequestId.
pub(crate) fn start_signing(gds: &Gds, request: &MethodRequest) -> MethodResult {
    let [
        Variant::NodeId(application),
        Variant::NodeId(group),
        Variant::NodeId(kind),
        Variant::ByteString(wanted),
    ] = request.arguments.as_slice()
    else {
        return Err(StatusCode::BadInvalidArgument.into());
    };
    let caller = &request.caller;
    let (record, standing) = gds.asking(caller, application)?;
    is_ours(gds, group, kind)?;
    let wanted = wanted.value.as_deref().unwrap_or_default();
    let wanted =
        CertificateSigningRequest::read(wanted).map_err(|why| unfit(&record, &why.to_string()))?;
    if wanted.application_uri() != record.uri {
        return Err(unfit(&record, "it is for another ApplicationUri"));
    }
    let number = gds.ask(caller, (&record, standing), wanted)?;
    Ok(vec![Variant::from(request_id(number))])
}

/// StartNewKeyPairRequest: also creates the key.
pub(crate) struct StartNewKeyPair(pub(crate) Arc<Gds>);

#[async_trait]
impl MethodHandler for StartNewKeyPair {
    async fn call(&self, request: MethodRequest) -> MethodResult {
        let gds = &self.0;
        let [
            Variant::NodeId(application),
            Variant::NodeId(group),
            Variant::NodeId(kind),
            Variant::String(subject),
            hosts,
            Variant::String(format),
            Variant::String(password),
        ] = request.arguments.as_slice()
        else {
            return Err(StatusCode::BadInvalidArgument.into());
        };
        let record = gds.own(&request.caller, application)?;
        is_ours(gds, group, kind)?;
        if format.as_ref() != "PEM" || !password.as_ref().is_empty() {
            return Err(unfit(
                &record,
                "only keys as PEM without a password are supported",
            ));
        }
        let (name, organization) = parts(subject, &record);
        let hosts = texts(hosts);
        let waiting = gds.unconfirmed_hosts(&request.caller, &record, &hosts)?;
        let made = tokio::task::spawn_blocking(|| new_key(KEY_BITS)).await;
        let key = made.map_err(|_| StatusCode::BadInternalError)?;
        let key = key.map_err(|fault| refused(&fault))?;
        let wanted =
            CertificateSigningRequest::make(&key, &record.uri, (&name, &organization), &hosts);
        let wanted = wanted.map_err(|why| unfit(&record, &why.to_string()))?;
        let key = pem_of(&key).map_err(|fault| refused(&fault))?;
        let number = gds.keep_checked(&request.caller, &record, (wanted, &waiting))?;
        let mut keys = gds.keys.lock();
        while keys.len() >= MOST_KEYS {
            keys.pop_first();
        }
        keys.insert(number, key);
        Ok(vec![Variant::from(request_id(number))])
    }
}

/// FinishRequest: issues the certificate. Returns it with its key, if the key was created here, and
/// with the authority.
pub(crate) fn finish(gds: &Gds, request: &MethodRequest) -> MethodResult {
    let [Variant::NodeId(application), Variant::NodeId(id)] = request.arguments.as_slice() else {
        return Err(StatusCode::BadInvalidArgument.into());
    };
    let caller = &request.caller;
    let (record, standing) = gds.asking(caller, application)?;
    let number = number_of_request(id).ok_or(StatusCode::BadNotFound)?;
    let issued = gds.fetch(caller, (&record, standing), number)?;
    let key = gds.keys.lock().get(&number).cloned();
    let authority = ByteString::from(gds.store.lock().certificate().der().to_vec());
    let key = key.map_or_else(ByteString::null, |key| ByteString::from(key.into_bytes()));
    Ok(vec![
        Variant::ByteString(ByteString::from(issued.der().to_vec())),
        Variant::ByteString(key),
        Variant::from(vec![authority]),
    ])
}

/// RevokeCertificate: revokes a certificate of the application.
pub(crate) fn revoke(gds: &Gds, request: &MethodRequest) -> MethodResult {
    let [Variant::NodeId(application), Variant::ByteString(bytes)] = request.arguments.as_slice()
    else {
        return Err(StatusCode::BadInvalidArgument.into());
    };
    let record = gds.own(&request.caller, application)?;
    let certificate = certificate(bytes).ok_or(StatusCode::BadInvalidArgument)?;
    let issued = gds.store.lock().of_application(&record.uri);
    let issued = issued.map_err(|fault| refused(&fault))?;
    if !issued.contains(&certificate) {
        return Err(unfit(&record, "the application has no such certificate"));
    }
    gds.revoke(&[certificate], now())
        .map_err(|fault| refused(&fault))?;
    Ok(Vec::new())
}

/// GetCertificateGroups: returns the only group.
pub(crate) fn groups(gds: &Gds, request: &MethodRequest) -> MethodResult {
    let [Variant::NodeId(application)] = request.arguments.as_slice() else {
        return Err(StatusCode::BadInvalidArgument.into());
    };
    gds.own(&request.caller, application)?;
    Ok(vec![Variant::from(vec![gds.group()])])
}

/// GetTrustList: returns the node of the group's trust list.
pub(crate) fn trust_list(gds: &Gds, request: &MethodRequest) -> MethodResult {
    let [Variant::NodeId(application), Variant::NodeId(group)] = request.arguments.as_slice()
    else {
        return Err(StatusCode::BadInvalidArgument.into());
    };
    gds.own(&request.caller, application)?;
    is_ours(gds, group, &NodeId::null())?;
    Ok(vec![Variant::from(NodeId::new(gds.namespace, TRUST_LIST))])
}

/// GetCertificates: returns the latest certificate of the application.
pub(crate) fn certificates(gds: &Gds, request: &MethodRequest) -> MethodResult {
    let [Variant::NodeId(application), Variant::NodeId(group)] = request.arguments.as_slice()
    else {
        return Err(StatusCode::BadInvalidArgument.into());
    };
    let record = gds.own(&request.caller, application)?;
    is_ours(gds, group, &NodeId::null())?;
    let issued = gds.store.lock().of_application(&record.uri);
    let issued = issued.map_err(|fault| refused(&fault))?;
    let latest: Vec<ByteString> = issued
        .first()
        .map(|one| ByteString::from(one.der().to_vec()))
        .into_iter()
        .collect();
    let kinds: Vec<NodeId> = latest.iter().map(|_| kind()).collect();
    Ok(vec![Variant::from(kinds), Variant::from(latest)])
}

/// GetCertificateStatus: returns true if the application has to request a new certificate.
pub(crate) fn status(gds: &Gds, request: &MethodRequest) -> MethodResult {
    let [
        Variant::NodeId(application),
        Variant::NodeId(group),
        Variant::NodeId(kind),
    ] = request.arguments.as_slice()
    else {
        return Err(StatusCode::BadInvalidArgument.into());
    };
    let record = gds.own(&request.caller, application)?;
    is_ours(gds, group, kind)?;
    let issued = gds.store.lock().of_application(&record.uri);
    let issued = issued.map_err(|fault| refused(&fault))?;
    let is_due = issued.first().is_none_or(|latest| {
        let step = Renewal::of(latest).step(now());
        !matches!(step, RenewalStep::Wait { .. })
    });
    Ok(vec![Variant::Boolean(is_due)])
}

/// CheckRevocationStatus: returns the revocation status of a certificate, as far as the authority
/// knows it.
pub(crate) fn check(gds: &Gds, request: &MethodRequest) -> MethodResult {
    let [Variant::ByteString(bytes)] = request.arguments.as_slice() else {
        return Err(StatusCode::BadInvalidArgument.into());
    };
    gds.is_unread(&request.caller)?;
    let certificate = certificate(bytes).ok_or(StatusCode::BadCertificateInvalid)?;
    let store = gds.store.lock();
    let list = store.current_list(now());
    let known = TrustedCertificates {
        trusted: vec![store.certificate().clone()],
        issuers: Vec::new(),
        crls: list.iter().cloned().collect(),
    };
    drop(store);
    let list = list.map_err(|fault| refused(&fault))?;
    let status = match trust::check(&certificate, &[], &known, now()) {
        Ok(()) => StatusCode::Good,
        // The status of certificates of another authority is unknown.
        Err(CertificateFault::Incomplete | CertificateFault::Untrusted) => {
            StatusCode::BadCertificateRevocationUnknown
        }
        Err(fault) => StatusCode::from(fault.status()),
    };
    let until = list.times().1.unwrap_or_default();
    Ok(vec![Variant::StatusCode(status), time(until.as_secs())])
}

impl Gds {
    /// Returns the application for which a caller requests a certificate: a registered application,
    /// or an applicant for its first certificate.
    fn asking(
        &self,
        caller: &SessionCaller,
        id: &NodeId,
    ) -> Result<(GdsRecord, CallerStanding), StatusCode> {
        self.is_unread(caller)?;
        let known = number(id).and_then(|number| self.records.lock().get(number).cloned());
        let record = match known {
            Some(record) => record,
            None => {
                let applies = self.applicants.lock().get(id).cloned();
                applies.ok_or(StatusCode::BadNotFound)?
            }
        };
        match self.standing(caller, &record.uri)? {
            CallerStanding::Stranger => Err(StatusCode::BadUserAccessDenied),
            standing @ (CallerStanding::Administrator
            | CallerStanding::Itself
            | CallerStanding::Applicant(_)) => Ok((record, standing)),
        }
    }

    /// Keeps the request of an application, and returns its number.
    ///
    /// # Errors
    /// The refusal for the caller.
    pub(crate) fn ask(
        &self,
        caller: &SessionCaller,
        (record, standing): (&GdsRecord, CallerStanding),
        wanted: CertificateSigningRequest,
    ) -> Result<u32, MethodRefusal> {
        match standing {
            CallerStanding::Applicant(key) => self.apply(record, wanted, key),
            CallerStanding::Administrator | CallerStanding::Itself | CallerStanding::Stranger => {
                let waiting = self.unconfirmed_hosts(caller, record, wanted.hosts())?;
                if wanted.challenge().is_some() {
                    return Err(unfit(
                        record,
                        "a challengePassword is allowed only for the first certificate of an application",
                    ));
                }
                self.keep_checked(caller, record, (wanted, &waiting))
            }
        }
    }

    /// Keeps the request of an administrator or a known application. It is approved unless some of
    /// its hosts wait for an administrator.
    fn keep_checked(
        &self,
        caller: &SessionCaller,
        record: &GdsRecord,
        (wanted, waiting): (CertificateSigningRequest, &[String]),
    ) -> Result<u32, MethodRefusal> {
        let approved = waiting.is_empty();
        let by = approved.then(|| format!("{} {}", caller.user, caller.application_uri));
        let number = self.keep_request(wanted, (None, by))?;
        self.report_unconfirmed(record, number, waiting);
        Ok(number)
    }

    /// Returns the certificate of a request. It is issued if the request is approved.
    ///
    /// # Errors
    /// The refusal for the caller.
    pub(crate) fn fetch(
        &self,
        caller: &SessionCaller,
        (record, standing): (&GdsRecord, CallerStanding),
        number: u32,
    ) -> Result<Certificate, MethodRefusal> {
        let requests: SigningRequests =
            kept::read(&self.folder.join(requests::FILE)).map_err(|error| unkept(&error))?;
        let asked = requests.get(number, now());
        let asked = asked.filter(|one| one.uri == record.uri);
        let asked = asked.ok_or(StatusCode::BadNotFound)?;
        if let CallerStanding::Applicant(key) = standing
            && !asked.is_of_key(key)
        {
            return Err(StatusCode::BadUserAccessDenied.into());
        }
        match (&asked.state, standing) {
            (RequestState::Issued { .. }, _) => {
                Ok(asked.certificate().ok_or(StatusCode::BadNotFound)?)
            }
            (RequestState::Approved { by }, _) => self.issue(asked, by),
            // An administrator approves a request by fetching the certificate.
            (RequestState::Waiting | RequestState::Refused, CallerStanding::Administrator) => {
                self.issue(asked, &caller.user)
            }
            // Trust in an application approves its request, but no further hosts.
            (RequestState::Waiting, CallerStanding::Itself) => {
                let wanted = asked.request().ok_or(StatusCode::BadNotFound)?;
                if self.are_confirmed(caller, &record.uri, wanted.hosts())? {
                    self.issue(asked, &caller.user)
                } else {
                    Err(StatusCode::BadRequestNotComplete.into())
                }
            }
            (RequestState::Waiting, _) => Err(StatusCode::BadRequestNotComplete.into()),
            (RequestState::Refused, _) => Err(StatusCode::BadUserAccessDenied.into()),
        }
    }

    /// Handles the request of an application without a trusted certificate. With the token of an
    /// invitation it is approved, otherwise it waits for an administrator.
    fn apply(
        &self,
        record: &GdsRecord,
        wanted: CertificateSigningRequest,
        key: Fingerprint,
    ) -> Result<u32, MethodRefusal> {
        if wanted.key_fingerprint() != key {
            return Err(unfit(record, "its key differs from the key of the channel"));
        }
        match wanted.challenge().map(str::to_owned) {
            Some(token) => self.redeem(record, &wanted, (&token, key)),
            None => self.wait(record, wanted, key),
        }
    }

    /// Stores a request until an administrator decides.
    fn wait(
        &self,
        record: &GdsRecord,
        wanted: CertificateSigningRequest,
        key: Fingerprint,
    ) -> Result<u32, MethodRefusal> {
        let number = self.keep_request(wanted, (Some(record.clone()), None))?;
        if let Some(suppressed) = self.another(&format!("waits {number}")) {
            info!(
                application = ?record.uri, number, %key, suppressed,
                "a certificate request waits: `ua-gds approve {number}` or `ua-gds reject {number}`"
            );
        }
        Ok(number)
    }

    /// Issues a certificate for the token of an invitation.
    fn redeem(
        &self,
        record: &GdsRecord,
        wanted: &CertificateSigningRequest,
        (token, key): (&str, Fingerprint),
    ) -> Result<u32, MethodRefusal> {
        self.require_registered_hosts(record, wanted.hosts())?;
        let shows = Shows {
            uri: &record.uri,
            names: &record.names,
            key,
        };
        let path = self.folder.join(invitations::FILE);
        let redeemed = kept::change(&path, |all: &mut Invitations| {
            all.redeem(token, shows, now())
        });
        let invitation = redeemed.map_err(|error| unkept(&error))?.map_err(|why| {
            if let Some(suppressed) = self.another(&format!("token {why}")) {
                warn!(application = ?record.uri, suppressed, "refused the token of an application: {why}");
            }
            StatusCode::BadUserAccessDenied
        })?;
        info!(application = ?record.uri, %key, invitation, "an application has used an invitation");
        let issued =
            self.register_and_issue(Some(record), wanted, &format!("invitation {invitation}"))?;
        let path = self.folder.join(requests::FILE);
        // The token is a secret: the request is not stored.
        let kept = kept::change(&path, |all: &mut SigningRequests| {
            all.put_issued((wanted, &issued), now())
        });
        Ok(kept.map_err(|error| unkept(&error))?)
    }

    /// Stores a request in the file and returns its number.
    fn keep_request(
        &self,
        request: CertificateSigningRequest,
        (record, approved): (Option<GdsRecord>, Option<String>),
    ) -> Result<u32, MethodRefusal> {
        let wanted = NewRequest {
            request,
            record,
            approved,
        };
        let path = self.folder.join(requests::FILE);
        let kept = kept::change(&path, |all: &mut SigningRequests| all.put(wanted, now()));
        kept.map_err(|error| unkept(&error))?.map_err(|full| {
            if let Some(suppressed) = self.another("full") {
                warn!(suppressed, "refused a certificate request: {full}");
            }
            StatusCode::BadTooManyOperations.into()
        })
    }

    /// Issues the certificate of an approved request.
    fn issue(&self, asked: &SigningRequest, by: &str) -> Result<Certificate, MethodRefusal> {
        let request = asked.request().ok_or(StatusCode::BadNotFound)?;
        let issued = self.register_and_issue(asked.record.as_ref(), &request, by)?;
        let path = self.folder.join(requests::FILE);
        let kept = kept::change(&path, |all: &mut SigningRequests| {
            all.issued(asked.number, &issued, now());
        });
        kept.map_err(|error| unkept(&error))?;
        Ok(issued)
    }

    /// Registers an application that was approved, confirms the hosts of its request, and issues
    /// its certificate.
    fn register_and_issue(
        &self,
        record: Option<&GdsRecord>,
        request: &CertificateSigningRequest,
        by: &str,
    ) -> Result<Certificate, MethodRefusal> {
        let uri = request.application_uri();
        let mut records = self.records.lock();
        let known = records.of_uri(uri).next().cloned();
        let number = known.as_ref().map(|one| one.number);
        let approved = record.map(|record| GdsRecord {
            number: number.unwrap_or_default(),
            confirmed: Vec::new(),
            ..record.clone()
        });
        if let Some(mut approved) = approved.or(known) {
            approved.confirm(request.hosts());
            let registered = match number {
                Some(_) => records.update(approved),
                None => records.register(approved).map(drop),
            };
            registered.map_err(|fault| {
                warn!(application = ?uri, "cannot register an application: {fault}");
                StatusCode::BadInvalidArgument
            })?;
        }
        drop(records);
        let issued = self.store.lock().issue(request, now(), self.life);
        let issued = issued.map_err(|fault| refused(&fault))?;
        info!(
            application = ?request.application_uri(), name = ?issued.name(), hosts = ?issued.hosts(), serial = %issued.serial(), by = ?by,
            "issued a certificate"
        );
        Ok(issued)
    }

    /// Returns the number of suppressed messages if this message should be logged, or `None` if it
    /// is suppressed too.
    pub(crate) fn another(&self, message: &str) -> Option<u64> {
        self.logged.lock().admit(message, Instant::now())
    }

    fn group(&self) -> NodeId {
        NodeId::new(self.namespace, GROUP)
    }

    /// Checks if a caller may read the trust list: registered applications and administrators may.
    ///
    /// # Errors
    /// Returns the status for the caller.
    pub(crate) fn may_read_list(&self, caller: &SessionCaller) -> Result<(), StatusCode> {
        self.is_unread(caller)?;
        let uri = &caller.application_uri;
        let registered = self.records.lock().of_uri(uri).next().is_some();
        match self.standing(caller, uri)? {
            CallerStanding::Administrator => Ok(()),
            CallerStanding::Itself if registered => Ok(()),
            CallerStanding::Itself | CallerStanding::Applicant(_) | CallerStanding::Stranger => {
                Err(StatusCode::BadUserAccessDenied)
            }
        }
    }
}

/// Checks that a certificate group and type are supported. A null NodeId stands for any (OPC
/// 10000-12, 7.9.3).
fn is_ours(gds: &Gds, group: &NodeId, wanted: &NodeId) -> Result<(), StatusCode> {
    let is = |given: &NodeId, own: &NodeId| given.is_null() || given == own;
    let all: NodeId = ObjectTypeId::ApplicationCertificateType.into();
    if is(group, &gds.group()) && (is(wanted, &kind()) || *wanted == all) {
        Ok(())
    } else {
        Err(StatusCode::BadInvalidArgument)
    }
}

/// RsaSha256ApplicationCertificateType.
pub(crate) fn kind() -> NodeId {
    ObjectTypeId::RsaSha256ApplicationCertificateType.into()
}

pub(crate) fn unfit(record: &GdsRecord, why: &str) -> MethodRefusal {
    info!(application = ?record.uri, "refused a certificate request: {why}");
    StatusCode::BadInvalidArgument.into()
}

/// Logs that a list cannot be read or written, and returns the status for the caller.
fn unkept(error: &io::Error) -> StatusCode {
    warn!(%error, "cannot read or write the requests or invitations");
    StatusCode::BadResourceUnavailable
}

/// Returns the RequestId of a number.
fn request_id(number: u32) -> NodeId {
    NodeId::new(OWN, format!("request-{number}"))
}

fn number_of_request(id: &NodeId) -> Option<u32> {
    match (id.namespace, &id.identifier) {
        (OWN, Identifier::String(text)) => text.as_ref().strip_prefix("request-")?.parse().ok(),
        _ => None,
    }
}

fn certificate(bytes: &ByteString) -> Option<Certificate> {
    let bytes = bytes.value.as_deref()?;
    Certificate::read(bytes).ok()
}

/// Returns the common name and the organization of a subject, as `CN=Robot,O=Plant` or
/// `CN=Robot/O=Plant`.
fn parts(subject: &UAString, record: &GdsRecord) -> (String, String) {
    let text = subject.as_ref();
    let part = |wanted: &str| {
        let each = text.split([',', '/', ';']);
        let mut pairs = each.filter_map(|one| one.trim().split_once('='));
        let found = pairs.find(|(key, _)| key.trim().eq_ignore_ascii_case(wanted));
        found.map(|(_, value)| value.trim().to_owned())
    };
    let named = || record.names.first().map(|(_, text)| text.clone());
    let name = part("CN").or_else(named).unwrap_or_default();
    (name, part("O").unwrap_or_default())
}

/// DefaultApplicationGroup.
const GROUP: u32 = 615;
/// The trust list of the DefaultApplicationGroup.
pub(crate) const TRUST_LIST: u32 = 616;
const KEY_BITS: u32 = 2048;
/// Largest number of private keys that wait to be fetched.
const MOST_KEYS: usize = 100;
