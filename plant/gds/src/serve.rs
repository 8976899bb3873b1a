//! The server of the Directory.

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use bridge_node::{Failure, FailureKind};
use discovery::{AnnounceSettings, Announced, Interface, announce};
use opcua::sync::Mutex;
use opcua::types::{NodeId, Variant};
use plant_opcua::certificates;
use plant_opcua::file::FileMethod;
use plant_opcua::server::{
    EndpointUrl, MethodHandler, MethodRequest, Security, Server, ServerBuilder, ServerConfig,
    method,
};
use plant_opcua::trust_file::TrustFile;
use plant_opcua::users::{self, Access, Permissions, Roles, Rules};
use tokio::time::{MissedTickBehavior, interval};
use tracing::{info, warn};

use crate::manager::{self, StartNewKeyPair, TRUST_LIST};
use crate::records::Records;
use crate::service::{Answer, Gds, GroupList, now};
use crate::store::{Store, StoreFault, claim};
use crate::{directory, service};
use plant_opcua::directory::{NAMESPACE, Types};

/// How it runs.
#[derive(Debug)]
pub(crate) struct Settings {
    pub(crate) endpoint: EndpointUrl,
    pub(crate) pki: PathBuf,
    pub(crate) authority: PathBuf,
    pub(crate) life: Duration,
    pub(crate) lds: Option<String>,
    pub(crate) interface: Option<Interface>,
}

/// Serves until it is told to stop.
pub(crate) async fn serve(
    settings: Settings,
    stop: impl Future<Output = ()>,
) -> Result<(), Failure> {
    let store = Store::open(&settings.authority).map_err(|fault| of_store(&fault))?;
    let _claimed = claim(&settings.authority).map_err(|fault| of_store(&fault))?;
    let server = Serving::start(&settings, store)?;
    let told = server.tell(&settings)?;
    let mut look = interval(LOOK);
    look.set_missed_tick_behavior(MissedTickBehavior::Delay);
    tokio::pin!(stop);
    loop {
        tokio::select! {
            () = &mut stop => break,
            _ = look.tick() => {
                if let Err(fault) = server.gds.know(now()) {
                    warn!("{fault}; whoever has the last revocation list goes on with that");
                }
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
    server: Server,
}

impl Serving {
    fn start(settings: &Settings, store: Store) -> Result<Self, Failure> {
        let failed = |kind| move |error: String| Failure::new(kind, error);
        let io = failed(FailureKind::Io);
        // Those whom the authority issued certificates are let in. The door of the server stands where an authority is trusted.
        let authority = store.certificate_path();
        let trusted = plant_opcua::pki::Pki::open(settings.pki.clone())
            .map_err(|error| io(error.to_string()))
            .and_then(|pki| {
                let given = authority.display().to_string();
                certificates::trust(pki.root(), &given).map_err(|error| io(error.to_string()))
            });
        trusted?;
        let access = Access::new(Some(settings.pki.join(users::FOLDER)), false);
        let access = Arc::new(access.map_err(|error| io(error.to_string()))?);
        let host = discovery::host_name();
        let uri = format!("urn:{host}:ua-gds");
        let config = ServerConfig {
            product_uri: "urn:ua-bridge:gds".to_owned(),
            security: vec![
                Security::None,
                Security::Basic256Sha256,
                Security::Aes128Sha256RsaOaep,
                Security::Aes256Sha256RsaPss,
            ],
            pki: Some(settings.pki.clone()),
            ..ServerConfig::new(&uri, NAME, settings.endpoint.clone())
        };
        let server = ServerBuilder::new(config)
            .nodeset_str("the NodeSet of the GDS", include_str!("gds.xml"))
            .users(Arc::clone(&access))
            .types(Arc::new(Types))
            .build();
        let server =
            server.map_err(|error| Failure::new(FailureKind::Unavailable, error.to_string()))?;
        let namespace = server.namespace(NAMESPACE).unwrap_or_default();
        let path = settings.authority.join("applications.json");
        let records = Records::open(path, now().as_secs());
        let records = records.map_err(|error| io(error.to_string()))?;
        info!(
            authority = ?store.certificate().name(), applications = records.len(), url = server.url(),
            "the global discovery server listens"
        );
        let gds = Arc::new(Gds {
            store: Mutex::new(store),
            records: Mutex::new(records),
            requests: Mutex::default(),
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

    /// Has each method carried out, and says that everybody may call them: each looks itself at who calls.
    fn methods(&self) -> Rules {
        let mut rules = Rules::default();
        let mut add = |object: u32, ids: &[u32], handler: Arc<dyn MethodHandler>| {
            let id = |number| NodeId::new(self.gds.namespace, number);
            for number in ids {
                self.server
                    .on_call(&id(object), &id(*number), Arc::clone(&handler));
                let permissions = Permissions {
                    call: Roles::ALL,
                    ..Permissions::default()
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

    /// Values of the nodes that say what there is.
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
                warn!(number, %status, "a node of the NodeSet cannot be shown");
            }
        }
    }

    fn tell(&self, settings: &Settings) -> Result<Option<Announced>, Failure> {
        if settings.lds.is_none() && settings.interface.is_none() {
            return Ok(None);
        }
        let server = discovery::Server {
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

/// As a failure of the program.
pub(crate) fn of_store(fault: &StoreFault) -> Failure {
    let kind = match fault {
        StoreFault::Io { .. } | StoreFault::Key(_) => FailureKind::Io,
        StoreFault::Claimed(_) => FailureKind::Unavailable,
        StoreFault::Missing(_) | StoreFault::Unfit { .. } | StoreFault::Open(_) => {
            FailureKind::Configuration
        }
        StoreFault::Present(_) | StoreFault::Unknown(_) | StoreFault::Request(_) => {
            FailureKind::Usage
        }
    };
    Failure::new(kind, fault.to_string())
}

type CarryOut = fn(&Gds, &MethodRequest) -> Answer;

const NAME: &str = "UA bridge global discovery server";
/// The object of the NodeSet.
const DIRECTORY: u32 = 141;
/// The object's own node of each method and that of its type, and what carries it out.
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
/// Of the trust list.
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
/// How often it is looked whether the revocation list is another, or is to be signed anew.
const LOOK: Duration = Duration::from_secs(2);
