//! Sessions with other servers. Users of the same access data share a session.

use std::collections::{HashMap, HashSet};
use std::path::Path;
use std::time::Duration;

use mappings::{Access, ExecutedBy, Mapping, Server, ServerSecurityPolicy};
use plant_opcua::client::{ClientConfig, ClientUser, HostNames, Link, OpcUaClient, SecurityChoice};

/// The clients of other servers.
pub(crate) struct Clients {
    config: ClientConfig,
    open: HashMap<Access, OpcUaClient>,
}

impl Clients {
    /// Creates clients with the ApplicationUri of the server and the certificates in `pki`.
    pub(crate) fn new(server: &Server, pki: &Path) -> Self {
        Self {
            config: ClientConfig {
                pki: Some(pki.to_owned()),
                timeout: ANSWERS_WITHIN,
                keep_alive: KEEP_ALIVE,
                host_names: if server.refuse_other_hosts {
                    HostNames::Refuse
                } else {
                    HostNames::Warn
                },
                ..ClientConfig::new(&server.application_uri, "UA bridge server")
            },
            open: HashMap::new(),
        }
    }

    /// Returns the client of a server. The client connects at once, and reconnects until it is
    /// dropped.
    pub(crate) fn of(&mut self, access: &Access) -> OpcUaClient {
        if let Some(open) = self.open.get(access) {
            return open.clone();
        }
        let config = ClientConfig {
            security: match access.security {
                None => SecurityChoice::Best,
                Some(ServerSecurityPolicy::None) => SecurityChoice::None,
                Some(ServerSecurityPolicy::Basic256Sha256) => SecurityChoice::Basic256Sha256,
                Some(ServerSecurityPolicy::Aes128Sha256RsaOaep) => {
                    SecurityChoice::Aes128Sha256RsaOaep
                }
                Some(ServerSecurityPolicy::Aes256Sha256RsaPss) => {
                    SecurityChoice::Aes256Sha256RsaPss
                }
            },
            user: access.user.as_ref().map(|user| ClientUser {
                name: user.name.clone(),
                password: user.password.reveal().to_owned(),
            }),
            ..self.config.clone()
        };
        let client = OpcUaClient::open(config, &access.endpoint.to_string());
        self.open.insert(access.clone(), client.clone());
        client
    }

    /// Returns the state of the connection to a server, if there is a client for it.
    pub(crate) fn link(&self, access: &Access) -> Option<Link> {
        let open = self.open.get(access);
        open.map(|client| client.link().borrow().clone())
    }

    /// Returns how often the certificate of a server was refused.
    pub(crate) fn refused(&self, access: &Access) -> u64 {
        let open = self.open.get(access);
        open.map_or(0, OpcUaClient::certificates_refused)
    }

    /// Closes the sessions that neither the mapping nor `found` uses.
    pub(crate) fn keep<'s>(
        &mut self,
        mapping: &'s Mapping,
        found: impl Iterator<Item = &'s Access>,
    ) {
        let servers = mapping.servers().iter().map(|server| &server.access);
        let methods = mapping
            .calls()
            .iter()
            .filter_map(|call| match &call.executed {
                ExecutedBy::OpcUa(target) => Some(&target.access),
                ExecutedBy::Ros(_) | ExecutedBy::Acknowledging | ExecutedBy::Elsewhere => None,
            });
        let wanted: HashSet<&Access> = servers.chain(methods).chain(found).collect();
        self.open.retain(|access, _| wanted.contains(access));
    }
}

/// Time limit of requests other than Method calls. A server that executes Methods and nothing else
/// meanwhile may take long.
const ANSWERS_WITHIN: Duration = Duration::from_secs(5);
const KEEP_ALIVE: Duration = Duration::from_secs(2);
