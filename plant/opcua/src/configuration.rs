//! The ServerConfiguration object, with which clients manage the certificates of a server (OPC
//! 10000-12, 7.10).
//!
//! An administrator requests a signing request of the server ([`Configuration`]:
//! CreateSigningRequest), installs the certificate that an authority issued (UpdateCertificate),
//! and edits the trust list (a file). The library reads its certificate and key only once. Changes
//! that require a restart are therefore reported to the embedding program, which restarts the
//! server.
//!
//! Reading order: `store` (the trust list in the files of the store), then this module.

mod store;

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use opcua::crypto::{CertificateStore, PrivateKey};
use opcua::sync::Mutex;
use opcua::types::{
    ByteString, MethodId, NodeId, ObjectId, ObjectTypeId, StatusCode, UAString, VariableId, Variant,
};
use tokio::sync::Notify;
use tracing::{info, warn};
use trust::{Certificate, CertificateSigningRequest};

pub(crate) use self::store::StoreList;

use crate::file::{FileMethod, LARGEST, LONGEST_UNUSED};
use crate::known;
use crate::own::{self, CertificateCause};
use crate::pair;
use crate::pki::{OWN_CERTIFICATE, OWN_KEY};
use crate::server::{CoreMethod, MethodHandler, MethodRefusal, MethodRequest, method};
use crate::trust_file::TrustFile;

/// The ServerConfiguration object of a server with a certificate store.
#[derive(Debug)]
pub struct Configuration {
    root: PathBuf,
    application_uri: String,
    /// Whether the running server admits clients with certificates of a trusted authority.
    has_door: bool,
    state: Mutex<State>,
    file: TrustFile,
    store: StoreList,
    applied: Notify,
}

#[derive(Default)]
struct State {
    /// The new private key of a signing request, as DER of PKCS #8.
    next_key: Option<Vec<u8>>,
    /// The certificate and key that ApplyChanges installs.
    waiting: Option<(Certificate, Option<Vec<u8>>)>,
}

impl std::fmt::Debug for State {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("State")
            .field(
                "waiting",
                &self.waiting.as_ref().map(|(certificate, _)| certificate),
            )
            .finish_non_exhaustive()
    }
}

type Answer = Result<Vec<Variant>, MethodRefusal>;

impl Configuration {
    /// Creates the object of the server `application_uri` with the store at `root`, which contains
    /// the server's certificate and key.
    #[must_use]
    pub fn new(root: &Path, application_uri: &str) -> Arc<Self> {
        let store = StoreList::new(root);
        Arc::new(Self {
            root: root.to_owned(),
            application_uri: application_uri.to_owned(),
            has_door: known::trusts_authorities(root),
            state: Mutex::default(),
            file: TrustFile::new(store.clone(), true),
            store,
            applied: Notify::new(),
        })
    }

    /// Waits until applied changes require a restart of the server. The delay leaves time for the
    /// response to the client.
    pub async fn applied(&self) {
        self.applied.notified().await;
    }

    /// Makes [`applied`](Self::applied) return: the server has a new certificate.
    pub fn restart(&self) {
        self.applied.notify_one();
    }

    /// Returns the methods, for the node manager of the core namespace.
    #[must_use]
    pub fn methods(self: &Arc<Self>) -> Vec<CoreMethod> {
        let mut all = Vec::new();
        for (id, of_type, name, carry_out) in METHODS {
            let this = Arc::clone(self);
            let handler = method(move |request: MethodRequest| {
                is_unread(&request)?;
                carry_out(&this, &request)
            });
            all.push(CoreMethod::new(
                ObjectId::ServerConfiguration,
                [id.into(), of_type.into()],
                name,
                handler,
            ));
        }
        all.push(CoreMethod::new(
            ObjectId::ServerConfiguration,
            [
                MethodId::ServerConfiguration_CreateSigningRequest.into(),
                MethodId::ServerConfigurationType_CreateSigningRequest.into(),
            ],
            "CreateSigningRequest",
            Arc::new(CreateSigningRequest(Arc::clone(self))),
        ));
        for (id, of_type, name, what) in FILE {
            let this = Arc::clone(self);
            let handler = method(move |request: MethodRequest| {
                is_unread(&request)?;
                this.in_file(what, &request)
            });
            all.push(CoreMethod::new(
                TRUST_LIST,
                [id.into(), of_type.into()],
                name,
                handler,
            ));
        }
        for (id, of_type, name, carry_out) in LIST {
            let this = Arc::clone(self);
            let handler = method(move |request: MethodRequest| {
                is_unread(&request)?;
                carry_out(&this, &request)
            });
            all.push(CoreMethod::new(
                TRUST_LIST,
                [id.into(), of_type.into()],
                name,
                handler,
            ));
        }
        all
    }

    /// Returns the nodes of the methods, which only security administrators may call.
    pub fn nodes() -> impl Iterator<Item = NodeId> {
        let own = METHODS.iter().map(|(id, ..)| *id);
        let file = FILE.iter().map(|(id, ..)| *id);
        let list = LIST.iter().map(|(id, ..)| *id);
        let all = own.chain(file).chain(list);
        all.chain([MethodId::ServerConfiguration_CreateSigningRequest])
            .map(NodeId::from)
    }

    /// Returns the values of the variables. `is_announced` states whether mDNS announces the
    /// server.
    #[must_use]
    pub fn values(is_announced: bool) -> Vec<(VariableId, Variant)> {
        let largest = u32::try_from(LARGEST).unwrap_or(u32::MAX);
        let kinds = vec![kind()];
        let none: Vec<UAString> = Vec::new();
        vec![
            (
                VariableId::ServerConfiguration_SupportedPrivateKeyFormats,
                Variant::from(vec![UAString::from(PEM)]),
            ),
            (
                VariableId::ServerConfiguration_ServerCapabilities,
                Variant::from(none),
            ),
            (
                VariableId::ServerConfiguration_MaxTrustListSize,
                Variant::UInt32(largest),
            ),
            (
                VariableId::ServerConfiguration_MulticastDnsEnabled,
                Variant::Boolean(is_announced),
            ),
            (
                VariableId::ServerConfiguration_CertificateGroups_DefaultApplicationGroup_CertificateTypes,
                Variant::from(kinds),
            ),
            (
                VariableId::ServerConfiguration_CertificateGroups_DefaultApplicationGroup_TrustList_Writable,
                Variant::Boolean(true),
            ),
            (
                VariableId::ServerConfiguration_CertificateGroups_DefaultApplicationGroup_TrustList_UserWritable,
                Variant::Boolean(true),
            ),
            (
                VariableId::ServerConfiguration_CertificateGroups_DefaultApplicationGroup_TrustList_ActivityTimeout,
                Variant::Double(LONGEST_UNUSED.as_secs_f64() * 1e3),
            ),
        ]
    }

    fn in_file(&self, what: FileMethod, request: &MethodRequest) -> Answer {
        let answered = self.file.call(what, request)?;
        match what {
            FileMethod::CloseAndUpdate => {
                info!(by = ?request.caller.user, "the trust list was replaced");
                // The first trusted authority takes effect after a restart of the server.
                Ok(vec![Variant::Boolean(self.wants_door())])
            }
            FileMethod::Open
            | FileMethod::OpenWithMasks
            | FileMethod::Read
            | FileMethod::Write
            | FileMethod::Close
            | FileMethod::GetPosition
            | FileMethod::SetPosition => Ok(answered),
        }
    }

    fn wants_door(&self) -> bool {
        !self.has_door && known::trusts_authorities(&self.root)
    }

    /// UpdateCertificate. The result requires ApplyChanges.
    fn update(&self, request: &MethodRequest) -> Answer {
        let [
            Variant::NodeId(group),
            Variant::NodeId(wanted),
            Variant::ByteString(certificate),
            issuers,
            Variant::String(format),
            Variant::ByteString(key),
        ] = request.arguments.as_slice()
        else {
            return Err(StatusCode::BadInvalidArgument.into());
        };
        is_ours(group, wanted)?;
        let read = certificate
            .value
            .as_deref()
            .and_then(|der| Certificate::read(der).ok());
        let certificate = read.ok_or(StatusCode::BadCertificateInvalid)?;
        if certificate.application_uri().as_deref() != Some(&self.application_uri) {
            return Err(self.unfit("the certificate has another ApplicationUri"));
        }
        if !certificate.is_valid_at(known::now()) {
            return Err(self.unfit("the certificate is not valid now"));
        }
        let given = match key.value.as_deref().unwrap_or_default() {
            [] => None,
            _ if format.as_ref() != PEM => return Err(StatusCode::BadNotSupported.into()),
            pem => Some(pair::from_pem(pem).ok_or(StatusCode::BadInvalidArgument)?),
        };
        let key = self.key_of(&certificate, given)?;
        self.store.judge(&certificate, issuers)?;
        self.store.keep_issuers(issuers).inspect_err(
            |status| warn!(%status, "cannot store the issuers of the new certificate"),
        )?;
        info!(
            name = ?certificate.name(), issuer = ?certificate.issuer_name(), serial = %certificate.serial(), by = ?request.caller.user,
            "received a new certificate of the server; it is used after ApplyChanges"
        );
        self.state.lock().waiting = Some((certificate, key));
        Ok(vec![Variant::Boolean(true)])
    }

    /// Returns the private key of a new certificate: the given key or the key of the signing
    /// request. `None` is the server's present key.
    fn key_of(
        &self,
        certificate: &Certificate,
        given: Option<Vec<u8>>,
    ) -> Result<Option<Vec<u8>>, MethodRefusal> {
        let next = self.state.lock().next_key.clone();
        let fits = |key: &Vec<u8>| certificate.is_of_private_key(key);
        if let Some(given) = given {
            return match fits(&given) {
                true => Ok(Some(given)),
                false => Err(self.unfit("the private key does not match the certificate")),
            };
        }
        if let Some(next) = next.filter(fits) {
            return Ok(Some(next));
        }
        let own = self.own_key()?;
        match fits(&own) {
            true => Ok(None),
            false => Err(self.unfit("the certificate does not match a key of the server")),
        }
    }

    fn own_key(&self) -> Result<Vec<u8>, StatusCode> {
        let key = CertificateStore::read_pkey(&self.root.join(OWN_KEY));
        let key = key.map_err(|error| {
            warn!(error, "cannot read the key of the server");
            StatusCode::BadInternalError
        })?;
        let der = key.to_der().map_err(|_| StatusCode::BadInternalError)?;
        Ok(der.as_bytes().to_vec())
    }

    /// ApplyChanges: installs the new certificate and key, and requests a restart.
    fn apply(self: &Arc<Self>, request: &MethodRequest) -> Answer {
        let waiting = self.state.lock().waiting.take();
        let is_new = waiting.is_some();
        if let Some((certificate, key)) = waiting {
            let written = pair::write(&self.root, certificate.der(), key.as_deref());
            if let Err(error) = written {
                warn!(%error, "cannot write the new certificate of the server");
                self.state.lock().waiting = Some((certificate, key));
                return Err(StatusCode::BadResourceUnavailable.into());
            }
            own::report(&self.root, &CertificateCause::Administrator);
            self.state.lock().next_key = None;
        }
        if is_new || self.wants_door() {
            info!(by = ?request.caller.user, "applying changes of certificates: the server restarts");
            let this = Arc::clone(self);
            drop(tokio::spawn(async move {
                tokio::time::sleep(ANSWER_LEAVES).await;
                this.applied.notify_one();
            }));
        }
        Ok(Vec::new())
    }

    /// GetRejectedList: the rejected certificates, newest first, at most 100.
    fn rejected(&self) -> Vec<Variant> {
        let entries = fs::read_dir(self.root.join("rejected"))
            .into_iter()
            .flatten();
        let mut all: Vec<_> = entries
            .flatten()
            .filter_map(|entry| Some((entry.metadata().ok()?.modified().ok()?, entry.path())))
            .collect();
        all.sort();
        let latest = all.iter().rev().take(MOST_REJECTED);
        let read: Vec<ByteString> = latest
            .filter_map(|(_, path)| {
                let certificate = CertificateStore::read_cert(path).ok()?;
                certificate.to_der().ok().map(ByteString::from)
            })
            .collect();
        vec![Variant::from(read)]
    }

    fn unfit(&self, why: &str) -> MethodRefusal {
        warn!("rejected a new certificate of the server: {why}");
        StatusCode::BadInvalidArgument.into()
    }
}

/// CreateSigningRequest for the present key or for a new key, whose generation takes some time.
struct CreateSigningRequest(Arc<Configuration>);

#[async_trait]
impl MethodHandler for CreateSigningRequest {
    async fn call(&self, request: MethodRequest) -> Answer {
        let this = &self.0;
        is_unread(&request)?;
        let [
            Variant::NodeId(group),
            Variant::NodeId(wanted),
            Variant::String(subject),
            Variant::Boolean(is_anew),
            Variant::ByteString(nonce),
        ] = request.arguments.as_slice()
        else {
            return Err(StatusCode::BadInvalidArgument.into());
        };
        is_ours(group, wanted)?;
        let key = if *is_anew {
            // The nonce is not used, because the system has enough entropy. The standard still
            // requires it (7.10.10).
            if nonce.value.as_deref().unwrap_or_default().len() < SHORTEST_NONCE {
                return Err(StatusCode::BadInvalidArgument.into());
            }
            let made = tokio::task::spawn_blocking(|| {
                let der = PrivateKey::new(KEY_BITS).ok()?.to_der().ok()?;
                Some(der.as_bytes().to_vec())
            });
            let made = made.await.ok().flatten();
            made.ok_or(StatusCode::BadInternalError)?
        } else {
            this.own_key()?
        };
        let own = fs::read(this.root.join(OWN_CERTIFICATE)).ok();
        let own = own.and_then(|bytes| Certificate::read(&bytes).ok());
        let own = own.ok_or(StatusCode::BadInternalError)?;
        let named = |name: &str| part(subject.as_ref(), name);
        let name = named("CN").unwrap_or_else(|| own.name());
        let organization = named("O").unwrap_or_default();
        let made = CertificateSigningRequest::make(
            &key,
            &this.application_uri,
            (&name, &organization),
            &own.hosts(),
        );
        let made = made.map_err(|why| this.unfit(&why.to_string()))?;
        if *is_anew {
            this.state.lock().next_key = Some(key);
        }
        info!(is_anew, by = ?request.caller.user, "the server requests a certificate");
        Ok(vec![Variant::ByteString(ByteString::from(
            made.der().to_vec(),
        ))])
    }
}

/// # Errors
/// Returns an error if the connection is not encrypted.
fn is_unread(request: &MethodRequest) -> Result<(), StatusCode> {
    match request.caller.encrypted {
        true => Ok(()),
        false => Err(StatusCode::BadSecurityModeInsufficient),
    }
}

/// Checks that the certificate group and the certificate type are supported; a null NodeId means
/// any.
fn is_ours(group: &NodeId, wanted: &NodeId) -> Result<(), StatusCode> {
    let own: NodeId =
        ObjectId::ServerConfiguration_CertificateGroups_DefaultApplicationGroup.into();
    let all: NodeId = ObjectTypeId::ApplicationCertificateType.into();
    let is_group = group.is_null() || *group == own;
    let is_kind = wanted.is_null() || *wanted == kind() || *wanted == all;
    match is_group && is_kind {
        true => Ok(()),
        false => Err(StatusCode::BadInvalidArgument),
    }
}

/// Returns RsaSha256ApplicationCertificateType.
fn kind() -> NodeId {
    ObjectTypeId::RsaSha256ApplicationCertificateType.into()
}

/// Returns a field of a subject such as `CN=Robot,O=Plant` or `CN=Robot/O=Plant`.
fn part(subject: &str, wanted: &str) -> Option<String> {
    let each = subject.split([',', '/', ';']);
    let mut pairs = each.filter_map(|one| one.trim().split_once('='));
    let found = pairs.find(|(key, _)| key.trim().eq_ignore_ascii_case(wanted));
    found.map(|(_, value)| value.trim().to_owned())
}

type CarryOut = fn(&Arc<Configuration>, &MethodRequest) -> Answer;

/// The methods of the object: method of the instance, method of the type, name, handler.
const METHODS: [(MethodId, MethodId, &str, CarryOut); 3] = [
    (
        MethodId::ServerConfiguration_UpdateCertificate,
        MethodId::ServerConfigurationType_UpdateCertificate,
        "UpdateCertificate",
        |this, request| this.update(request),
    ),
    (
        MethodId::ServerConfiguration_ApplyChanges,
        MethodId::ServerConfigurationType_ApplyChanges,
        "ApplyChanges",
        |this, request| this.apply(request),
    ),
    (
        MethodId::ServerConfiguration_GetRejectedList,
        MethodId::ServerConfigurationType_GetRejectedList,
        "GetRejectedList",
        |this, _| Ok(this.rejected()),
    ),
];

/// The methods of the trust list, in the same form.
const LIST: [(MethodId, MethodId, &str, CarryOut); 2] = [
    (
        MethodId::ServerConfiguration_CertificateGroups_DefaultApplicationGroup_TrustList_AddCertificate,
        MethodId::TrustListType_AddCertificate,
        "AddCertificate",
        |this, request| this.store.add(request),
    ),
    (
        MethodId::ServerConfiguration_CertificateGroups_DefaultApplicationGroup_TrustList_RemoveCertificate,
        MethodId::TrustListType_RemoveCertificate,
        "RemoveCertificate",
        |this, request| this.store.remove(request),
    ),
];

const FILE: [(MethodId, MethodId, &str, FileMethod); 8] = [
    (
        MethodId::ServerConfiguration_CertificateGroups_DefaultApplicationGroup_TrustList_Open,
        MethodId::FileType_Open,
        "Open",
        FileMethod::Open,
    ),
    (
        MethodId::ServerConfiguration_CertificateGroups_DefaultApplicationGroup_TrustList_Close,
        MethodId::FileType_Close,
        "Close",
        FileMethod::Close,
    ),
    (
        MethodId::ServerConfiguration_CertificateGroups_DefaultApplicationGroup_TrustList_Read,
        MethodId::FileType_Read,
        "Read",
        FileMethod::Read,
    ),
    (
        MethodId::ServerConfiguration_CertificateGroups_DefaultApplicationGroup_TrustList_Write,
        MethodId::FileType_Write,
        "Write",
        FileMethod::Write,
    ),
    (
        MethodId::ServerConfiguration_CertificateGroups_DefaultApplicationGroup_TrustList_GetPosition,
        MethodId::FileType_GetPosition,
        "GetPosition",
        FileMethod::GetPosition,
    ),
    (
        MethodId::ServerConfiguration_CertificateGroups_DefaultApplicationGroup_TrustList_SetPosition,
        MethodId::FileType_SetPosition,
        "SetPosition",
        FileMethod::SetPosition,
    ),
    (
        MethodId::ServerConfiguration_CertificateGroups_DefaultApplicationGroup_TrustList_OpenWithMasks,
        MethodId::TrustListType_OpenWithMasks,
        "OpenWithMasks",
        FileMethod::OpenWithMasks,
    ),
    (
        MethodId::ServerConfiguration_CertificateGroups_DefaultApplicationGroup_TrustList_CloseAndUpdate,
        MethodId::TrustListType_CloseAndUpdate,
        "CloseAndUpdate",
        FileMethod::CloseAndUpdate,
    ),
];

const TRUST_LIST: ObjectId =
    ObjectId::ServerConfiguration_CertificateGroups_DefaultApplicationGroup_TrustList;
const PEM: &str = "PEM";
const KEY_BITS: u32 = 2048;
/// Bytes (OPC 10000-12, 7.10.10).
const SHORTEST_NONCE: usize = 32;
const MOST_REJECTED: usize = 100;
/// The time for the last response to reach its client before the server restarts.
const ANSWER_LEAVES: Duration = Duration::from_millis(500);
