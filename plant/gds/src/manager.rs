//! The certificates of applications (OPC 10000-12, 7.9): asked for, finished, revoked.

use std::collections::VecDeque;
use std::net::IpAddr;
use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use opcua::types::{ByteString, NodeId, ObjectTypeId, StatusCode, UAString, Variant};
use plant_opcua::server::{Caller, MethodHandler, MethodRequest, Refusal};
use tracing::info;
use trust::{Certificate, Fault, Known, Renewal, Request, Step};

use crate::records::Record;
use crate::service::{Answer, Gds, OWN, now, refused, texts, time};
use crate::store::{new_key, pem_of};

/// What is asked for and not fetched yet.
#[derive(Debug, Default)]
pub(crate) struct Requests {
    last: u32,
    waiting: VecDeque<Waiting>,
}

#[derive(Debug)]
struct Waiting {
    number: u32,
    application: u32,
    since: Duration,
    request: Request,
    /// In PEM, where the authority was to make it.
    key: Option<String>,
    /// What was issued. It is kept for a client that did not get the answer.
    issued: Option<Certificate>,
}

impl Requests {
    /// Keeps a request. Of those that nobody fetches the oldest give way.
    fn put(&mut self, application: u32, request: Request, key: Option<String>) -> NodeId {
        let since = now();
        self.waiting
            .retain(|one| since.saturating_sub(one.since) < LONGEST_WAIT);
        if self.waiting.len() >= MOST_WAITING {
            self.waiting.pop_front();
        }
        self.last = self.last.wrapping_add(1);
        self.waiting.push_back(Waiting {
            number: self.last,
            application,
            since,
            request,
            key,
            issued: None,
        });
        NodeId::new(OWN, format!("request-{}", self.last))
    }

    fn find(&mut self, application: u32, id: &NodeId) -> Option<&mut Waiting> {
        let now = now();
        self.waiting.iter_mut().find(|one| {
            one.application == application
                && now.saturating_sub(one.since) < LONGEST_WAIT
                && *id == NodeId::new(OWN, format!("request-{}", one.number))
        })
    }
}

/// StartSigningRequest: keeps what is asked for, and answers with the RequestId.
pub(crate) fn start_signing(gds: &Gds, request: &MethodRequest) -> Answer {
    let [
        Variant::NodeId(application),
        Variant::NodeId(group),
        Variant::NodeId(kind),
        Variant::ByteString(wanted),
    ] = request.arguments.as_slice()
    else {
        return Err(StatusCode::BadInvalidArgument.into());
    };
    let record = gds.own(&request.caller, application)?;
    is_ours(gds, group, kind)?;
    let wanted = wanted.value.as_deref().unwrap_or_default();
    let wanted = Request::read(wanted).map_err(|why| unfit(&record, &why.to_string()))?;
    if wanted.application_uri() != record.uri {
        return Err(unfit(&record, "it is for another ApplicationUri"));
    }
    gds.may_have_hosts(&request.caller, &record, wanted.hosts())?;
    Ok(vec![Variant::from(gds.requests.lock().put(
        record.number,
        wanted,
        None,
    ))])
}

/// StartNewKeyPairRequest: makes a key, too.
pub(crate) struct StartNewKeyPair(pub(crate) Arc<Gds>);

#[async_trait]
impl MethodHandler for StartNewKeyPair {
    async fn call(&self, request: MethodRequest) -> Answer {
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
            return Err(unfit(&record, "keys are made as PEM without a password"));
        }
        let (name, organization) = parts(subject, &record);
        let hosts = texts(hosts);
        gds.may_have_hosts(&request.caller, &record, &hosts)?;
        let made = tokio::task::spawn_blocking(|| new_key(KEY_BITS)).await;
        let key = made.map_err(|_| StatusCode::BadInternalError)?;
        let key = key.map_err(|fault| refused(&fault))?;
        let wanted = Request::make(&key, &record.uri, (&name, &organization), &hosts);
        let wanted = wanted.map_err(|why| unfit(&record, &why.to_string()))?;
        let key = pem_of(&key).map_err(|fault| refused(&fault))?;
        let mut requests = gds.requests.lock();
        Ok(vec![Variant::from(requests.put(
            record.number,
            wanted,
            Some(key),
        ))])
    }
}

/// FinishRequest: issues the certificate, and answers with it, the key where that was asked for, and the authority.
pub(crate) fn finish(gds: &Gds, request: &MethodRequest) -> Answer {
    let [Variant::NodeId(application), Variant::NodeId(id)] = request.arguments.as_slice() else {
        return Err(StatusCode::BadInvalidArgument.into());
    };
    let caller = &request.caller;
    let record = gds.own(caller, application)?;
    let mut requests = gds.requests.lock();
    let waiting = requests.find(record.number, id);
    let waiting = waiting.ok_or(StatusCode::BadNotFound)?;
    let store = gds.store.lock();
    let authority = ByteString::from(store.certificate().der().to_vec());
    let issued = match &waiting.issued {
        Some(issued) => issued.clone(),
        None => {
            let issued = store.issue(&waiting.request, now(), gds.life);
            let issued = issued.map_err(|fault| refused(&fault))?;
            info!(
                application = ?record.uri, name = ?issued.name(), hosts = ?issued.hosts(), serial = %issued.serial(), by = ?caller.user,
                "a certificate is issued"
            );
            waiting.issued.insert(issued).clone()
        }
    };
    let key = waiting.key.as_ref().map_or_else(ByteString::null, |key| {
        ByteString::from(key.clone().into_bytes())
    });
    Ok(vec![
        Variant::ByteString(ByteString::from(issued.der().to_vec())),
        Variant::ByteString(key),
        Variant::from(vec![authority]),
    ])
}

/// RevokeCertificate: one that the application has.
pub(crate) fn revoke(gds: &Gds, request: &MethodRequest) -> Answer {
    let [Variant::NodeId(application), Variant::ByteString(bytes)] = request.arguments.as_slice()
    else {
        return Err(StatusCode::BadInvalidArgument.into());
    };
    let record = gds.own(&request.caller, application)?;
    let certificate = certificate(bytes).ok_or(StatusCode::BadInvalidArgument)?;
    let issued = gds.store.lock().of_application(&record.uri);
    let issued = issued.map_err(|fault| refused(&fault))?;
    if !issued.contains(&certificate) {
        return Err(unfit(&record, "it has no such certificate"));
    }
    gds.revoke(&[certificate], now())
        .map_err(|fault| refused(&fault))?;
    Ok(Vec::new())
}

/// GetCertificateGroups: there is one.
pub(crate) fn groups(gds: &Gds, request: &MethodRequest) -> Answer {
    let [Variant::NodeId(application)] = request.arguments.as_slice() else {
        return Err(StatusCode::BadInvalidArgument.into());
    };
    gds.own(&request.caller, application)?;
    Ok(vec![Variant::from(vec![gds.group()])])
}

/// GetTrustList: where the trust list of a group is.
pub(crate) fn trust_list(gds: &Gds, request: &MethodRequest) -> Answer {
    let [Variant::NodeId(application), Variant::NodeId(group)] = request.arguments.as_slice()
    else {
        return Err(StatusCode::BadInvalidArgument.into());
    };
    gds.own(&request.caller, application)?;
    is_ours(gds, group, &NodeId::null())?;
    Ok(vec![Variant::from(NodeId::new(gds.namespace, TRUST_LIST))])
}

/// GetCertificates: the latest that the application has.
pub(crate) fn certificates(gds: &Gds, request: &MethodRequest) -> Answer {
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

/// GetCertificateStatus: whether the application is to ask for another one.
pub(crate) fn status(gds: &Gds, request: &MethodRequest) -> Answer {
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
        !matches!(step, Step::Wait { .. })
    });
    Ok(vec![Variant::Boolean(is_due)])
}

/// CheckRevocationStatus: how a certificate stands by what the authority knows.
pub(crate) fn check(gds: &Gds, request: &MethodRequest) -> Answer {
    let [Variant::ByteString(bytes)] = request.arguments.as_slice() else {
        return Err(StatusCode::BadInvalidArgument.into());
    };
    gds.is_unread(&request.caller)?;
    let certificate = certificate(bytes).ok_or(StatusCode::BadCertificateInvalid)?;
    let store = gds.store.lock();
    let list = store.current_list(now());
    let known = Known {
        trusted: vec![store.certificate().clone()],
        issuers: Vec::new(),
        crls: list.iter().cloned().collect(),
    };
    drop(store);
    let list = list.map_err(|fault| refused(&fault))?;
    let status = match trust::check(&certificate, &[], &known, now()) {
        Ok(()) => StatusCode::Good,
        // Of another authority: nothing is known of it.
        Err(Fault::Incomplete | Fault::Untrusted) => StatusCode::BadCertificateRevocationUnknown,
        Err(fault) => StatusCode::from(fault.status()),
    };
    let until = list.times().1.unwrap_or_default();
    Ok(vec![Variant::StatusCode(status), time(until.as_secs())])
}

impl Gds {
    /// Checks the hosts that a certificate is to name: those of the DiscoveryUrls of the application and of the certificate that
    /// it has, and the computer itself. A security administrator may ask for others.
    fn may_have_hosts(
        &self,
        caller: &Caller,
        record: &Record,
        hosts: &[String],
    ) -> Result<(), Refusal> {
        if self.is_administrator(caller) {
            return Ok(());
        }
        let current = self.store.lock().of_application(&record.uri);
        let current = current.map_err(|fault| refused(&fault))?;
        let current = current.first().map(Certificate::hosts).unwrap_or_default();
        let own = record.hosts();
        let is_own = |host: &String| {
            let mut known = own.iter().chain(&current);
            is_loopback(host) || known.any(|one| one.eq_ignore_ascii_case(host))
        };
        match hosts.iter().find(|host| !is_own(host)) {
            None => Ok(()),
            Some(host) => Err(unfit(
                record,
                &format!(
                    "the host {host:?} is in none of its DiscoveryUrls; register the application with it, or ask as a user with \
                     the role security_admin"
                ),
            )),
        }
    }

    fn group(&self) -> NodeId {
        NodeId::new(self.namespace, GROUP)
    }

    /// Whether somebody may read the trust list: whoever is registered, and administrators.
    ///
    /// # Errors
    /// What the caller is told.
    pub(crate) fn may_read_list(&self, caller: &Caller) -> Result<(), StatusCode> {
        self.is_unread(caller)?;
        let registered = {
            let records = self.records.lock();
            records.of_uri(&caller.application_uri).next().is_some()
        };
        match caller.proven && registered {
            true => Ok(()),
            false => self.may(caller, ""),
        }
    }
}

/// Whether a group and a type of certificates are those that there are; null is any (OPC 10000-12, 7.9.3).
fn is_ours(gds: &Gds, group: &NodeId, wanted: &NodeId) -> Result<(), StatusCode> {
    let is = |given: &NodeId, own: &NodeId| given.is_null() || given == own;
    let all: NodeId = ObjectTypeId::ApplicationCertificateType.into();
    match is(group, &gds.group()) && (is(wanted, &kind()) || *wanted == all) {
        true => Ok(()),
        false => Err(StatusCode::BadInvalidArgument),
    }
}

/// RsaSha256ApplicationCertificateType.
pub(crate) fn kind() -> NodeId {
    ObjectTypeId::RsaSha256ApplicationCertificateType.into()
}

/// Returns whether a host is the computer itself, wherever that is.
fn is_loopback(host: &str) -> bool {
    match host.parse::<IpAddr>() {
        Ok(address) => address.is_loopback(),
        Err(_) => host.eq_ignore_ascii_case("localhost"),
    }
}

fn unfit(record: &Record, why: &str) -> Refusal {
    info!(application = ?record.uri, "what is asked for a certificate is refused: {why}");
    StatusCode::BadInvalidArgument.into()
}

fn certificate(bytes: &ByteString) -> Option<Certificate> {
    let bytes = bytes.value.as_deref()?;
    Certificate::read(bytes).ok()
}

/// The common name and the organization of a subject, as `CN=Robot,O=Plant` or `CN=Robot/O=Plant`.
fn parts(subject: &UAString, record: &Record) -> (String, String) {
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
/// Its trust list.
pub(crate) const TRUST_LIST: u32 = 616;
const KEY_BITS: u32 = 2048;
const MOST_WAITING: usize = 100;
const LONGEST_WAIT: Duration = Duration::from_secs(3600);
