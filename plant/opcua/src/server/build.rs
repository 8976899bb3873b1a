//! Creates a listening server from its configuration.

use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Arc, OnceLock};
use std::time::Duration;

use opcua::crypto::SecurityPolicy;
use opcua::server::address_space::AddressSpace;
use opcua::server::authenticator::AuthManager;
use opcua::server::diagnostics::NamespaceMetadata;
use opcua::server::node_manager::memory::{
    CoreNodeManager, CoreNodeManagerBuilder, InMemoryNodeManager, InMemoryNodeManagerBuilder,
};
use opcua::server::node_manager::{DynNodeManager, NodeManagerBuilder, ServerContext};
use opcua::server::{ANONYMOUS_USER_TOKEN_ID, ServerEndpoint};
use opcua::sync::Mutex;
use opcua::types::{BuildInfo, DateTime, MessageSecurityMode, TypeLoader, UAString};

use super::address_spaces::AddressSpaces;
use super::calls::MethodCalls;
use super::capabilities::{Facets, capabilities};
use super::nodes::ServerNodes;
use super::roles;
use super::routed::{Front, Routed};
use super::supplement::Supplement;
use super::{Inner, OpcUaServer, Waiting};
use crate::door::{Door, UnknownClients};
use crate::endpoint::{BindError, EndpointUrl};
use crate::limits::{self, ClientLimits};
use crate::nodeset::{self, ImportedNodeSet, NodeSetError, NodeSetSource};
use crate::pki::{NO_PKI, OWN_CERTIFICATE, OWN_KEY, Pki, PkiError};
use crate::users::UserAccess;

/// A security policy of a server.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ServerSecurity {
    /// SecurityPolicy None.
    None,
    /// Sign and SignAndEncrypt with Basic256Sha256.
    Basic256Sha256,
    /// Sign and SignAndEncrypt with Aes128_Sha256_RsaOaep.
    Aes128Sha256RsaOaep,
    /// Sign and SignAndEncrypt with Aes256_Sha256_RsaPss.
    Aes256Sha256RsaPss,
}

impl ServerSecurity {
    fn policy(self) -> SecurityPolicy {
        match self {
            Self::None => SecurityPolicy::None,
            Self::Basic256Sha256 => SecurityPolicy::Basic256Sha256,
            Self::Aes128Sha256RsaOaep => SecurityPolicy::Aes128Sha256RsaOaep,
            Self::Aes256Sha256RsaPss => SecurityPolicy::Aes256Sha256RsaPss,
        }
    }

    /// Returns the endpoints of the policy: the URI of the policy, and whether messages are
    /// encrypted in addition to signing; `None` for neither.
    pub fn ways(self) -> impl Iterator<Item = (&'static str, Option<bool>)> + use<> {
        let ways: &[Option<bool>] = match self {
            Self::None => &[None],
            Self::Basic256Sha256 | Self::Aes128Sha256RsaOaep | Self::Aes256Sha256RsaPss => {
                &[Some(false), Some(true)]
            }
        };
        let uri = self.policy().to_uri();
        ways.iter().map(move |way| (uri, *way))
    }

    /// Returns the endpoints at a path: a single endpoint without security, or an endpoint for Sign
    /// and an endpoint for SignAndEncrypt.
    pub fn endpoints(self, path: &str) -> impl Iterator<Item = (String, ServerEndpoint)> + use<> {
        let modes: &[MessageSecurityMode] = match self {
            Self::None => &[MessageSecurityMode::None],
            Self::Basic256Sha256 | Self::Aes128Sha256RsaOaep | Self::Aes256Sha256RsaPss => &[
                MessageSecurityMode::Sign,
                MessageSecurityMode::SignAndEncrypt,
            ],
        };
        let (policy, path) = (self.policy(), path.to_owned());
        modes.iter().map(move |mode| {
            // The authenticator decides on user identities, so the library ignores this list.
            let anonymous = [ANONYMOUS_USER_TOKEN_ID.to_owned()];
            let endpoint = ServerEndpoint::new(&path, policy, *mode, &anonymous);
            (format!("{policy} {mode}"), endpoint)
        })
    }
}

/// The identity and the security of a server. All users are anonymous without
/// [`ServerBuilder::users`].
#[derive(Debug, Clone)]
pub struct ServerConfig {
    /// The ApplicationUri of the server.
    pub application_uri: String,
    /// The application name.
    pub application_name: String,
    /// The ProductUri of the server.
    pub product_uri: String,
    /// The version of the program.
    pub software_version: String,
    /// The endpoint URL; port 0 selects any free port.
    pub endpoint: EndpointUrl,
    /// The security policies.
    pub security: Vec<ServerSecurity>,
    /// The directory of the certificate store. Required by all policies except
    /// [`ServerSecurity::None`].
    pub pki: Option<PathBuf>,
    /// Trusts every client certificate, and stores it as trusted. For tests and demonstrations
    /// only.
    pub trust_unknown_clients: bool,
    /// The rule for clients without a trusted certificate, if the server trusts an authority.
    pub unknown_clients: UnknownClients,
    /// The longest session timeout.
    pub session_timeout: Duration,
    /// The limits of clients.
    pub clients: ClientLimits,
    /// Cancels a request at the timeout of its caller (TimeoutHint of OPC 10000-4, 7.33), so that
    /// a request that waits takes no effect after its caller has given up. Otherwise the timeouts
    /// of the server apply.
    pub obeys_timeout_hints: bool,
}

impl ServerConfig {
    /// Creates the configuration of a server without security.
    #[must_use]
    pub fn new(application_uri: &str, application_name: &str, endpoint: EndpointUrl) -> Self {
        Self {
            application_uri: application_uri.to_owned(),
            application_name: application_name.to_owned(),
            product_uri: "urn:ua-bridge:plant".to_owned(),
            software_version: env!("CARGO_PKG_VERSION").to_owned(),
            endpoint,
            security: vec![ServerSecurity::None],
            pki: None,
            trust_unknown_clients: false,
            unknown_clients: UnknownClients::Refuse,
            session_timeout: Duration::from_secs(60),
            clients: ClientLimits::default(),
            obeys_timeout_hints: false,
        }
    }
}

/// An error of creating a server.
#[derive(Debug, thiserror::Error)]
pub enum ServerError {
    /// The listening socket cannot be opened.
    #[error(transparent)]
    Bind(#[from] BindError),
    /// The certificate store cannot be used.
    #[error(transparent)]
    Pki(#[from] PkiError),
    /// A NodeSet cannot be used.
    #[error(transparent)]
    NodeSet(#[from] NodeSetError),
    /// The security policies require certificates, but no directory is configured.
    #[error(
        "security policies other than None need a directory for certificates: give one (--pki)"
    )]
    NoPki,
    /// The server has no security policy.
    #[error("the endpoint has no security policy, not even None")]
    NoSecurity,
    /// An error of the operating system.
    #[error("cannot use the listening socket: {0}")]
    Io(#[from] io::Error),
    /// The library refused the configuration.
    #[error("cannot configure the OPC UA server: {0}")]
    Configuration(String),
}

/// Builds a server.
pub struct ServerBuilder {
    config: ServerConfig,
    sources: Vec<NodeSetSource>,
    namespaces: Vec<String>,
    users: Option<Arc<UserAccess>>,
    loaders: Vec<Arc<dyn TypeLoader>>,
}

impl std::fmt::Debug for ServerBuilder {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("ServerBuilder")
            .field("config", &self.config)
            .finish_non_exhaustive()
    }
}

impl ServerBuilder {
    /// Creates a builder with the core namespace and the namespace of the ApplicationUri.
    #[must_use]
    pub fn new(config: ServerConfig) -> Self {
        Self {
            namespaces: vec![config.application_uri.clone()],
            config,
            sources: Vec::new(),
            users: None,
            loaders: Vec::new(),
        }
    }

    /// Sets the users, which are read again when their file changes.
    #[must_use]
    pub fn users(mut self, users: Arc<UserAccess>) -> Self {
        self.users = Some(users);
        self
    }

    /// Registers a type loader for structures that clients send.
    #[must_use]
    pub fn types(mut self, loader: Arc<dyn TypeLoader>) -> Self {
        self.loaders.push(loader);
        self
    }

    /// Adds a NodeSet2 document, with `name` for error messages. The order of NodeSets does not
    /// matter.
    #[must_use]
    pub fn nodeset_str(mut self, name: &str, xml: &str) -> Self {
        self.sources.push(NodeSetSource::Text {
            name: name.to_owned(),
            xml: xml.to_owned(),
        });
        self
    }

    /// Adds a NodeSet2 file. The order of NodeSets does not matter.
    #[must_use]
    pub fn nodeset_file(mut self, path: impl Into<PathBuf>) -> Self {
        self.sources.push(NodeSetSource::File(path.into()));
        self
    }

    /// Adds a namespace for instances.
    #[must_use]
    pub fn namespace(mut self, uri: &str) -> Self {
        self.namespaces.push(uri.to_owned());
        self
    }

    /// Loads the NodeSets and opens the listening socket. Clients are served after
    /// [`OpcUaServer::start`].
    ///
    /// # Errors
    /// Returns an error if a NodeSet cannot be used, if listening on the port fails, or if
    /// certificates cannot be created.
    pub fn build(self) -> Result<OpcUaServer, ServerError> {
        let sets = nodeset::load(self.sources)?;
        let config = self.config;
        if config.security.is_empty() {
            return Err(ServerError::NoSecurity);
        }
        let secured = config
            .security
            .iter()
            .any(|one| *one != ServerSecurity::None);
        let pki = match &config.pki {
            Some(root) => {
                let pki = Pki::open(root.clone())?;
                pki.ensure_own_at(&config.application_uri, &config.endpoint.hosts())?;
                Some(pki)
            }
            None if secured => return Err(ServerError::NoPki),
            None => None,
        };
        let listener = config.endpoint.bind()?;
        let port = listener.local_addr()?.port();
        let mut listener = tokio::net::TcpListener::from_std(listener)?;
        let root = pki.as_ref().filter(|_| !config.trust_unknown_clients);
        let door = root.map(|pki| Door::of(pki.root(), config.clients, config.unknown_clients));
        let door = door.transpose()?.flatten();
        let door = match door {
            Some((door, behind)) => {
                let behind = tokio::net::TcpListener::from_std(behind)?;
                Some((door, std::mem::replace(&mut listener, behind)))
            }
            None => None,
        };
        let made = Arc::new(Made::default());
        let calls = Arc::new(MethodCalls::default());
        let builder = with(described(&config, port), &self.users, self.loaders);
        let builder = match &door {
            Some((door, _)) => door.behind().used_by(builder),
            None => builder.pki_dir(pki.as_ref().map_or_else(|| Path::new(NO_PKI), Pki::root)),
        };
        let builder = builder
            .with_node_manager(Core {
                made: Arc::clone(&made),
                calls: Arc::clone(&calls),
                supplement: supplement(&config, self.users.as_ref()),
            })
            .with_node_manager(Own {
                made: Arc::clone(&made),
                calls: Arc::clone(&calls),
                sets,
                namespaces: self.namespaces,
                users: self.users.clone(),
            });
        let (server, handle) = built(builder, secured)?;
        if let Some(error) = made.error.lock().take() {
            return Err(error.into());
        }
        let (Some(manager), Some(spaces)) = (made.own.get(), calls.spaces.get()) else {
            return Err(ServerError::Configuration(
                "it has no address space".to_owned(),
            ));
        };
        Ok(OpcUaServer {
            inner: Arc::new(Inner {
                handle,
                manager: Arc::clone(manager),
                spaces: Arc::clone(spaces),
                calls: Arc::clone(&calls),
                application_uri: config.application_uri,
                url: config.endpoint.advertised(port),
                port,
                making: Mutex::new(()),
                waiting: Mutex::new(Some(Waiting {
                    server,
                    listener,
                    pki,
                    door,
                    users: self.users,
                })),
                running: Mutex::default(),
            }),
        })
    }
}

/// Builds the server of the library. Without security, its messages about missing certificates are
/// not logged.
fn built(
    builder: opcua::server::ServerBuilder,
    secured: bool,
) -> Result<(opcua::server::Server, opcua::server::ServerHandle), ServerError> {
    if secured {
        return builder.build().map_err(ServerError::Configuration);
    }
    let silent = tracing::subscriber::NoSubscriber::new();
    tracing::subscriber::with_default(silent, || builder.build())
        .map_err(ServerError::Configuration)
}

fn described(config: &ServerConfig, port: u16) -> opcua::server::ServerBuilder {
    let timeout = u64::try_from(config.session_timeout.as_millis()).unwrap_or(u64::MAX);
    let mut builder = opcua::server::ServerBuilder::new()
        .without_node_managers()
        .application_name(&config.application_name)
        .application_uri(&config.application_uri)
        .product_uri(&config.product_uri)
        .build_info(BuildInfo {
            product_uri: UAString::from(&config.product_uri),
            manufacturer_name: UAString::null(),
            product_name: UAString::from(&config.application_name),
            software_version: UAString::from(&config.software_version),
            build_number: UAString::null(),
            build_date: DateTime::null(),
        })
        .discovery_urls(vec![config.endpoint.advertised(port)])
        .host(config.endpoint.advertised_host())
        .port(port)
        .certificate_path(OWN_CERTIFICATE)
        .private_key_path(OWN_KEY)
        .trust_client_certs(config.trust_unknown_clients)
        .subscription_poll_interval_ms(limits::POLL_MS)
        .max_session_timeout_ms(timeout)
        .limits(limits::server(config.clients));
    if config.obeys_timeout_hints {
        // The library cancels a request at this time or at the timeout of its caller, whichever is
        // later.
        builder = builder.max_timeout_ms(0);
    }
    for security in &config.security {
        for (name, endpoint) in security.endpoints(config.endpoint.path()) {
            builder = builder.add_endpoint(name, endpoint);
        }
    }
    builder
}

fn with(
    mut builder: opcua::server::ServerBuilder,
    users: &Option<Arc<UserAccess>>,
    loaders: Vec<Arc<dyn TypeLoader>>,
) -> opcua::server::ServerBuilder {
    if let Some(users) = users {
        builder = builder.with_authenticator(Arc::clone(users) as Arc<dyn AuthManager>);
    }
    for loader in loaders {
        builder = builder.with_type_loader(loader);
    }
    builder
}

/// The node managers, for code that needs more than the library's interface provides.
#[derive(Default)]
struct Made {
    core: OnceLock<Arc<CoreNodeManager>>,
    own: OnceLock<Arc<InMemoryNodeManager<ServerNodes>>>,
    error: Mutex<Option<NodeSetError>>,
}

/// Returns the values and attributes that the library does not serve.
fn supplement(config: &ServerConfig, users: Option<&Arc<UserAccess>>) -> Supplement {
    let facets = Facets {
        is_secured: config
            .security
            .iter()
            .any(|one| *one != ServerSecurity::None),
        ..Facets::default()
    };
    let mut values = capabilities(&limits::server(config.clients), facets);
    values.extend(users.into_iter().flat_map(roles::values));
    Supplement::new(values, users.cloned())
}

/// Builds the node manager of the core namespace.
struct Core {
    made: Arc<Made>,
    calls: Arc<MethodCalls>,
    supplement: Supplement,
}

impl NodeManagerBuilder for Core {
    fn build(self: Box<Self>, context: ServerContext) -> Arc<DynNodeManager> {
        let builder = Box::new(InMemoryNodeManagerBuilder::new(CoreNodeManagerBuilder));
        let inner = builder.build(context);
        let core: Result<Arc<CoreNodeManager>, _> = Arc::clone(&inner).into_any_arc().downcast();
        if let Ok(core) = core {
            roles::prepare(&mut core.address_space().write());
            self.made.core.get_or_init(|| core);
        }
        Arc::new(Routed {
            inner,
            front: Front::Calls(self.calls),
            last: None,
            supplement: self.supplement,
        })
    }
}

/// Builds the node manager of all other namespaces.
struct Own {
    made: Arc<Made>,
    calls: Arc<MethodCalls>,
    sets: Vec<ImportedNodeSet>,
    namespaces: Vec<String>,
    users: Option<Arc<UserAccess>>,
}

impl NodeManagerBuilder for Own {
    fn build(self: Box<Self>, context: ServerContext) -> Arc<DynNodeManager> {
        let Self {
            made,
            calls,
            sets,
            namespaces,
            users,
        } = *self;
        let sessions = Arc::clone(&calls.sessions);
        let fill = |context: ServerContext, address_space: &mut AddressSpace| {
            let mut types = context.type_tree.write();
            let map = types.namespaces_mut();
            for uri in namespaces
                .iter()
                .map(String::as_str)
                .chain(sets.iter().flat_map(ImportedNodeSet::provides))
            {
                address_space.add_namespace(uri, map.add_namespace(uri));
            }
            let imported = sets
                .iter()
                .try_for_each(|set| set.import(address_space, map));
            if let Err(error) = imported {
                *made.error.lock() = Some(error);
            }
            let known = address_space.namespaces().iter();
            let metadata = known.map(|(index, uri)| NamespaceMetadata {
                namespace_uri: uri.clone(),
                namespace_index: *index,
                ..NamespaceMetadata::default()
            });
            ServerNodes::new(metadata.collect(), sessions)
        };
        let inner = Box::new(InMemoryNodeManagerBuilder::new(fill)).build(context);
        let own: Option<Arc<InMemoryNodeManager<ServerNodes>>> =
            Arc::clone(&inner).into_any_arc().downcast().ok();
        if let (Some(core), Some(own)) = (made.core.get(), own) {
            let address_space = Arc::clone(own.address_space());
            made.own.get_or_init(|| own);
            let spaces = AddressSpaces::new(Arc::clone(core), address_space);
            calls.spaces.get_or_init(|| Arc::new(spaces));
        }
        let last = calls.spaces.get().cloned();
        let front = Front::Calls(calls);
        Arc::new(Routed {
            inner,
            front,
            last,
            supplement: Supplement::new(Vec::new(), users),
        })
    }
}
