//! The server of the Directory.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use ::service::{Failure, FailureKind};
use discovery::{AnnounceSettings, MdnsInterface, ServerAnnouncement, announce};
use log_limit::LogLimit;
use opcua::sync::Mutex;
use opcua::types::{NodeId, Variant};
use plant_opcua::certificates;
use plant_opcua::door::UnknownClients;
use plant_opcua::enrolment::own_key;
use plant_opcua::file::FileMethod;
use plant_opcua::judge::CertificateJudge;
use plant_opcua::own::{self, CertificateCause};
use plant_opcua::pki::Pki;
use plant_opcua::server::{
    EndpointUrl, MethodHandler, MethodRequest, OpcUaServer, ServerBuilder, ServerConfig,
    ServerSecurity, method,
};
use plant_opcua::trust_file::TrustFile;
use plant_opcua::users::{self, NodePermissions, PermissionRules, Roles, UserAccess};
use tokio::time::{MissedTickBehavior, interval};
use tracing::{info, warn};
use trust::{CertificateSigningRequest, Renewal, RenewalStep};

use crate::kept;
use crate::manager::{self, StartNewKeyPair, TRUST_LIST};
use crate::records::Records;
use crate::service::{Gds, GroupList, MethodResult, now};
use crate::store::{AuthorityStore, AuthorityStoreFault, claim};
use crate::{directory, service};
use plant_opcua::directory::{NAMESPACE, RecordTypes};

/// The settings of the server.
#[derive(Debug)]
pub(crate) struct GdsSettings {
    pub(crate) endpoint: EndpointUrl,
    pub(crate) pki: PathBuf,
    pub(crate) authority: PathBuf,
    pub(crate) life: Duration,
    pub(crate) lds: Option<String>,
    pub(crate) interface: Option<MdnsInterface>,
}

/// Runs the server until `stop` is ready.
pub(crate) async fn serve(
    settings: GdsSettings,
    stop: impl Future<Output = ()>,
) -> Result<(), Failure> {
    let store = AuthorityStore::open(&settings.authority).map_err(|fault| of_store(&fault))?;
    let _claimed = claim(&settings.authority).map_err(|fault| of_store(&fault))?;
    let server = Serving::start(&settings, store)?;
    let told = server.tell(&settings)?;
    ::service::service_manager::ready();
    let mut look = interval(LOOK);
    look.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let mut warned = None;
    tokio::pin!(stop);
    loop {
        tokio::select! {
            () = &mut stop => break,
            _ = look.tick() => {
                if let Err(fault) = server.gds.know(now()) {
                    warn!("{fault}; programs continue with the last revocation list");
                }
                server.look_at_certificates(&settings, &mut warned);
            }
        }
    }
    if let Some(told) = told {
        told.leave().await;
    }
    server.server.stop().await;
    Ok(())
}

struct Serving {
    gds: Arc<Gds>,
    server: OpcUaServer,
}

impl Serving {
    fn start(settings: &GdsSettings, store: AuthorityStore) -> Result<Self, Failure> {
        let failed = |kind| move |error: String| Failure::new(kind, error);
        let io = failed(FailureKind::Io);
        // Clients with a certificate of the authority are admitted. The door of the server is
        // active if an authority is trusted.
        let authority = store.certificate_path();
        let trusted = Pki::open(settings.pki.clone())
            .map_err(|error| io(error.to_string()))
            .and_then(|pki| {
                let given = authority.display().to_string();
                certificates::trust(pki.root(), &given).map_err(|error| io(error.to_string()))
            });
        trusted?;
        let uri = own_uri();
        ensure_own(&store, &settings.pki, &settings.endpoint, now())?;
        let access = UserAccess::new(Some(settings.pki.join(users::FOLDER)), false);
        let access = Arc::new(access.map_err(|error| io(error.to_string()))?);
        let config = ServerConfig {
            product_uri: "urn:ua-bridge:gds".to_owned(),
            security: vec![
                ServerSecurity::None,
                ServerSecurity::Basic256Sha256,
                ServerSecurity::Aes128Sha256RsaOaep,
                ServerSecurity::Aes256Sha256RsaPss,
            ],
            pki: Some(settings.pki.clone()),
            // An application without a certificate of the plant requests its certificate here.
            unknown_clients: UnknownClients::Admit,
            ..ServerConfig::new(&uri, NAME, settings.endpoint.clone())
        };
        let server = ServerBuilder::new(config)
            .nodeset_str("the NodeSet of the GDS", include_str!("gds.xml"))
            .users(Arc::clone(&access))
            .types(Arc::new(RecordTypes))
            .build();
        let server =
            server.map_err(|error| Failure::new(FailureKind::Unavailable, error.to_string()))?;
        let namespace = server.namespace(NAMESPACE).unwrap_or_default();
        let path = settings.authority.join("applications.json");
        let records = Records::open(path, now().as_secs());
        let records = records.map_err(|error| io(error.to_string()))?;
        info!(
            authority = ?store.certificate().name(), applications = records.len(), url = server.url(),
            "the global discovery server is listening"
        );
        let gds = Arc::new(Gds {
            store: Mutex::new(store),
            records: Mutex::new(records),
            applicants: Mutex::default(),
            keys: Mutex::default(),
            folder: settings.authority.clone(),
            judge: CertificateJudge::of(&settings.pki, false),
            logged: Mutex::new(LogLimit::every(LOGGED_EVERY)),
            known: Mutex::default(),
            access: Arc::clone(&access),
            pki: settings.pki.clone(),
            life: settings.life,
            namespace,
        });
        gds.know(now()).map_err(|fault| of_store(&fault))?;
        let serving = Self { gds, server };
        access.set_rules(serving.methods());
        serving.show();
        serving.server.start();
        Ok(serving)
    }

    /// Renews the server's own certificate, which restarts the program. Warns once a day before the
    /// certificate of the authority expires.
    fn look_at_certificates(&self, settings: &GdsSettings, warned: &mut Option<Duration>) {
        let now = now();
        let store = self.gds.store.lock();
        match renew_own(&store, &settings.pki, &settings.endpoint, now) {
            Ok(true) => ::service::restart::restart(),
            Ok(false) => {}
            Err(fault) => {
                if let Some(suppressed) = self.gds.another("own certificate") {
                    warn!(
                        suppressed,
                        "cannot renew the certificate of this server: {fault}"
                    );
                }
            }
        }
        let due = warned.is_none_or(|at| now.saturating_sub(at) >= DAY);
        if due && trust::is_near_end(store.certificate(), now) {
            *warned = Some(now);
            let until = store.certificate().validity().1;
            warn!(
                until = own::day(until),
                days_left = until.saturating_sub(now).as_secs() / DAY.as_secs(),
                "the certificate of the authority expires soon, and its certificates expire with it: make a \
                 new authority (`ua-gds ca init` with another --authority), and trust it in all programs"
            );
        }
    }

    /// Registers the handler of each method. Every client may call the methods; each handler checks
    /// its caller itself.
    fn methods(&self) -> PermissionRules {
        let mut rules = PermissionRules::default();
        let mut add = |object: u32, ids: &[u32], handler: Arc<dyn MethodHandler>| {
            let id = |number| NodeId::new(self.gds.namespace, number);
            for number in ids {
                self.server
                    .on_call(&id(object), &id(*number), Arc::clone(&handler));
                let permissions = NodePermissions {
                    call: Roles::ALL,
                    ..NodePermissions::default()
                };
                rules.nodes.insert(id(*number), permissions);
            }
        };
        for (ids, carry_out) in METHODS {
            let gds = Arc::clone(&self.gds);
            add(
                DIRECTORY,
                ids,
                method(move |request| carry_out(&gds, &request)),
            );
        }
        let pair = StartNewKeyPair(Arc::clone(&self.gds));
        add(DIRECTORY, &START_NEW_KEY_PAIR, Arc::new(pair));
        let file = Arc::new(TrustFile::new(GroupList(Arc::clone(&self.gds)), false));
        let closing = Arc::clone(&file);
        self.server
            .on_session_closed(move |session| closing.close_session(session));
        for (id, what) in FILE {
            let (file, gds) = (Arc::clone(&file), Arc::clone(&self.gds));
            let handler = method(move |request: MethodRequest| {
                gds.may_read_list(&request.caller)?;
                file.call(what, &request)
            });
            add(TRUST_LIST, &[id], handler);
        }
        rules
    }

    /// Shows the values of the informational nodes.
    fn show(&self) {
        let node = |number: u32| NodeId::new(self.gds.namespace, number);
        let values = [
            (CERTIFICATE_TYPES, Variant::from(vec![manager::kind()])),
            (WRITABLE, Variant::Boolean(false)),
            (USER_WRITABLE, Variant::Boolean(false)),
            (SIZE, Variant::UInt64(0)),
            (OPEN_COUNT, Variant::UInt16(0)),
            (LAST_UPDATE, service::time(now().as_secs())),
        ];
        for (number, value) in values {
            if let Err(status) = self.server.show(&node(number), value) {
                warn!(number, %status, "cannot show a node of the NodeSet");
            }
        }
    }

    fn tell(&self, settings: &GdsSettings) -> Result<Option<ServerAnnouncement>, Failure> {
        if settings.lds.is_none() && settings.interface.is_none() {
            return Ok(None);
        }
        let server = discovery::ServerDescription {
            application_uri: self.server.application_uri().to_owned(),
            product_uri: "urn:ua-bridge:gds".to_owned(),
            name: NAME.to_owned(),
            url: self.server.url().to_owned(),
            capabilities: vec!["GDS".to_owned()],
            number: None,
        };
        let told = AnnounceSettings {
            mdns: settings.interface.clone(),
            pki: Some(settings.pki.clone()),
            ..AnnounceSettings::registering(settings.lds.as_deref())
        };
        let told = announce(server, told);
        told.map(Some)
            .map_err(|error| Failure::new(FailureKind::Unavailable, error.to_string()))
    }
}

/// The ApplicationUri of the server.
pub(crate) fn own_uri() -> String {
    format!("urn:{}:ua-gds", discovery::host_name())
}

/// Creates the key and the certificate of the server at its first start. Its own authority issues
/// the certificate, so that all programs that trust the authority trust the server. An existing
/// certificate stays until its renewal.
pub(crate) fn ensure_own(
    store: &AuthorityStore,
    pki: &Path,
    endpoint: &EndpointUrl,
    now: Duration,
) -> Result<(), Failure> {
    let io = |error: String| Failure::new(FailureKind::Io, error);
    // The server and `ua-gds invite` may start at the same time, and an invitation names the
    // certificate that is kept.
    let alone = kept::lock(&store.folder().join(OWN_LOCK));
    let _alone = alone.map_err(|error| io(error.to_string()))?;
    let is_new = own::read(pki).is_none();
    let opened = Pki::open(pki.to_owned()).map_err(|error| io(error.to_string()))?;
    let made = opened.ensure_own_at(&own_uri(), &endpoint.hosts());
    made.map_err(|error| io(error.to_string()))?;
    if is_new {
        issue_own(store, pki, endpoint, now).map_err(|fault| of_store(&fault))
    } else {
        Ok(())
    }
}

/// Renews the certificate of the server after four fifths of its life. A self-signed certificate,
/// which clients may trust by its file, is renewed near its end. Returns true if there is a new
/// certificate.
fn renew_own(
    store: &AuthorityStore,
    pki: &Path,
    endpoint: &EndpointUrl,
    now: Duration,
) -> Result<bool, AuthorityStoreFault> {
    let Some(certificate) = own::read(pki) else {
        return Ok(false);
    };
    let is_due = if certificate.is_self_signed() {
        trust::is_near_end(&certificate, now)
    } else {
        !matches!(
            Renewal::of(&certificate).step(now),
            RenewalStep::Wait { .. }
        )
    };
    // If the authority expires first, a renewal would not extend the certificate and be repeated
    // without end.
    let (_, last) = store.certificate().validity();
    if !is_due || certificate.validity().1 >= last {
        return Ok(false);
    }
    issue_own(store, pki, endpoint, now).map(|()| true)
}

fn issue_own(
    store: &AuthorityStore,
    pki: &Path,
    endpoint: &EndpointUrl,
    now: Duration,
) -> Result<(), AuthorityStoreFault> {
    let key = own_key(pki).map_err(|fault| AuthorityStoreFault::Key(fault.to_string()))?;
    let mut hosts = endpoint.hosts();
    for host in ["localhost", "127.0.0.1", "::1"] {
        if !hosts.iter().any(|one| one == host) {
            hosts.push(host.to_owned());
        }
    }
    let request = CertificateSigningRequest::make(&key, &own_uri(), (NAME, ""), &hosts);
    let request = request.map_err(AuthorityStoreFault::Request)?;
    let issued = store.issue(&request, now, OWN_LIFE)?;
    own::replace(pki, &issued, &CertificateCause::Authority).map_err(|source| {
        AuthorityStoreFault::Io {
            path: pki.to_owned(),
            source,
        }
    })
}

/// Converts a fault of the store into a failure of the program.
pub(crate) fn of_store(fault: &AuthorityStoreFault) -> Failure {
    let kind = match fault {
        AuthorityStoreFault::Io { .. } | AuthorityStoreFault::Key(_) => FailureKind::Io,
        AuthorityStoreFault::Claimed(_) => FailureKind::Unavailable,
        AuthorityStoreFault::Missing(_)
        | AuthorityStoreFault::Unfit { .. }
        | AuthorityStoreFault::Open(_) => FailureKind::Configuration,
        AuthorityStoreFault::Present(_)
        | AuthorityStoreFault::Unknown(_)
        | AuthorityStoreFault::Request(_) => FailureKind::Usage,
    };
    Failure::new(kind, fault.to_string())
}

type CarryOut = fn(&Gds, &MethodRequest) -> MethodResult;

const NAME: &str = "UA bridge global discovery server";
/// The Directory object of the NodeSet.
const DIRECTORY: u32 = 141;
/// The methods: node of the object, node of the type, and handler.
const METHODS: [(&[u32], CarryOut); 15] = [
    (&[143, 15], directory::find),
    (&[146, 18], directory::register),
    (&[200, 188], directory::update),
    (&[149, 21], directory::unregister),
    (&[216, 210], directory::get),
    (&[992, 868], directory::query),
    (&[151, 23], directory::query_servers),
    (&[157, 79], manager::start_signing),
    (&[163, 85], manager::finish),
    (&[15_005, 15_003], manager::revoke),
    (&[508, 369], manager::groups),
    (&[174, 89], manager::certificates),
    (&[204, 197], manager::trust_list),
    (&[225, 222], manager::status),
    (&[177, 126], manager::check),
];
const START_NEW_KEY_PAIR: [u32; 2] = [154, 76];
/// The methods of the trust list.
const FILE: [(u32, FileMethod); 7] = [
    (622, FileMethod::Open),
    (625, FileMethod::Close),
    (627, FileMethod::Read),
    (630, FileMethod::Write),
    (632, FileMethod::GetPosition),
    (635, FileMethod::SetPosition),
    (638, FileMethod::OpenWithMasks),
];
const SIZE: u32 = 617;
const WRITABLE: u32 = 618;
const USER_WRITABLE: u32 = 619;
const OPEN_COUNT: u32 = 620;
const LAST_UPDATE: u32 = 637;
const CERTIFICATE_TYPES: u32 = 648;
const DAY: Duration = Duration::from_secs(86_400);
/// Locked while the server's own certificate is created.
const OWN_LOCK: &str = "own.lock";
/// The life of the server's own certificate.
const OWN_LIFE: Duration = Duration::from_secs(365 * 86_400);
/// Interval in which the same cause is logged once.
const LOGGED_EVERY: Duration = Duration::from_secs(60);
/// Interval of checking if the revocation list has changed or needs a new signature.
const LOOK: Duration = Duration::from_secs(2);

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    #[test]
    fn a_server_and_an_invitation_that_start_at_once_have_one_certificate() {
        let folder = std::env::temp_dir().join(format!("ua-gds-own-{}", std::process::id()));
        drop(fs::remove_dir_all(&folder));
        let (authority, pki) = (folder.join("authority"), folder.join("pki"));
        let life = OWN_LIFE * 10;
        AuthorityStore::init(&authority, ("Plant authority", ""), now(), life).unwrap();
        let endpoint: EndpointUrl = "opc.tcp://127.0.0.1:4841".parse().unwrap();
        let start = std::sync::Barrier::new(2);
        let made = || {
            let store = AuthorityStore::open(&authority).unwrap();
            start.wait();
            ensure_own(&store, &pki, &endpoint, now()).unwrap();
            own::read(&pki).unwrap()
        };
        let [first, second] = std::thread::scope(|scope| {
            [scope.spawn(made), scope.spawn(made)].map(|one| one.join().unwrap())
        });
        assert_eq!(first, second);
        assert_eq!(first.issuer_name(), "Plant authority");
        let store = AuthorityStore::open(&authority).unwrap();
        let renewed = |later| renew_own(&store, &pki, &endpoint, now() + later).unwrap();
        assert!(!renewed(OWN_LIFE / 5 * 3) && renewed(OWN_LIFE / 5 * 4));
        assert_ne!(own::read(&pki).unwrap(), first);
        fs::remove_dir_all(folder).unwrap();
    }
}
