//! Conversion between OPC UA services and the registry (OPC 10000-4, 5.5).

#![expect(
    clippy::wildcard_enum_match_arm,
    reason = "discovery uses some of the messages of all services"
)]

use std::path::Path;
use std::time::SystemTime;

use opcua::core::{RequestMessage, ResponseMessage};
use opcua::types::{
    ApplicationDescription, ApplicationType, ByteString, DateTime, EndpointDescription,
    FindServersOnNetworkResponse, FindServersRequest, FindServersResponse, GetEndpointsRequest,
    GetEndpointsResponse, LocalizedText, MdnsDiscoveryConfiguration, MessageSecurityMode,
    RegisterServer2Response, RegisterServerResponse, RegisteredServer, ResponseHeader,
    ServerOnNetwork, ServiceFault, StatusCode, UAString,
};
use registry::{MdnsConfiguration, NetworkRecord, RegistrationRequest};

use crate::clock;

/// A query of the registry.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum RegistryQuery {
    FindServers {
        uris: Vec<String>,
    },
    FindOnNetwork {
        from: u32,
        most: u32,
        capabilities: Vec<String>,
    },
    Register {
        asked: Box<RegistrationRequest>,
        semaphore_is_there: Option<bool>,
    },
}

/// The answer of the registry.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum RegistryAnswer {
    Servers(Vec<RegistrationRequest>),
    OnNetwork {
        records: Vec<NetworkRecord>,
        reset: SystemTime,
    },
    Registered,
    Refused(u32),
}

/// The description of the server that answers.
#[derive(Debug, Clone)]
pub(crate) struct OwnDescription {
    pub(crate) application_uri: String,
    pub(crate) name: String,
    /// The URL for clients.
    pub(crate) url: String,
    pub(crate) application_type: ApplicationType,
    /// Null without secured channels.
    pub(crate) certificate: ByteString,
}

impl OwnDescription {
    fn description(&self) -> ApplicationDescription {
        ApplicationDescription {
            application_uri: self.application_uri.as_str().into(),
            application_name: LocalizedText::new("en", &self.name),
            application_type: self.application_type,
            discovery_urls: Some(vec![self.url.as_str().into()]),
            ..ApplicationDescription::default()
        }
    }

    /// Returns the GetEndpoints response.
    pub(crate) fn endpoints(&self, request: &GetEndpointsRequest) -> ResponseMessage {
        let profiles = request.profile_uris.as_deref().unwrap_or_default();
        let wanted =
            profiles.is_empty() || profiles.iter().any(|profile| profile.as_ref() == UATCP);
        let endpoint =
            |(mode, policy, level): (MessageSecurityMode, &str, u8)| EndpointDescription {
                endpoint_url: self.url.as_str().into(),
                server: self.description(),
                server_certificate: self.certificate.clone(),
                security_mode: mode,
                security_policy_uri: policy.into(),
                // An empty list: there are no sessions.
                user_identity_tokens: Some(Vec::new()),
                transport_profile_uri: UATCP.into(),
                security_level: level,
            };
        let secured = [
            (MessageSecurityMode::Sign, POLICY_BASIC256SHA256, 1),
            (
                MessageSecurityMode::SignAndEncrypt,
                POLICY_BASIC256SHA256,
                2,
            ),
        ];
        let all = [(MessageSecurityMode::None, POLICY_NONE, 0)].into_iter();
        let all = all.chain(secured.into_iter().filter(|_| !self.certificate.is_null()));
        let endpoints = all.filter(|_| wanted).map(endpoint);
        let response = GetEndpointsResponse {
            response_header: ResponseHeader::new_good(&request.request_header),
            endpoints: Some(endpoints.collect()),
        };
        response.into()
    }
}

/// Returns the query of a request; `None` if the service is not a discovery service.
pub(crate) fn question(request: &RequestMessage) -> Option<RegistryQuery> {
    Some(match request {
        RequestMessage::FindServers(request) => RegistryQuery::FindServers {
            uris: texts(request.server_uris.as_deref()),
        },
        RequestMessage::FindServersOnNetwork(request) => RegistryQuery::FindOnNetwork {
            from: request.starting_record_id,
            most: request.max_records_to_return,
            capabilities: texts(request.server_capability_filter.as_deref()),
        },
        RequestMessage::RegisterServer(request) => register(&request.server, None),
        RequestMessage::RegisterServer2(request) => {
            let all = request.discovery_configuration.iter().flatten();
            let mut known = all.filter_map(|one| one.inner_as::<MdnsDiscoveryConfiguration>());
            let mdns = known.next().map(|known| MdnsConfiguration {
                name: text(&known.mdns_server_name),
                capabilities: texts(known.server_capabilities.as_deref()),
            });
            register(&request.server, mdns)
        }
        _ => return None,
    })
}

fn register(server: &RegisteredServer, mdns: Option<MdnsConfiguration>) -> RegistryQuery {
    let names = server.server_names.iter().flatten();
    let asked = RegistrationRequest {
        server_uri: text(&server.server_uri),
        product_uri: text(&server.product_uri),
        names: names
            .map(|name| (text(&name.locale), text(&name.text)))
            .collect(),
        application_type: match server.server_type {
            ApplicationType::Server => registry::ApplicationType::Server,
            ApplicationType::Client => registry::ApplicationType::Client,
            ApplicationType::ClientAndServer => registry::ApplicationType::ClientAndServer,
            ApplicationType::DiscoveryServer => registry::ApplicationType::DiscoveryServer,
        },
        gateway_server_uri: text(&server.gateway_server_uri),
        discovery_urls: texts(server.discovery_urls.as_deref()),
        semaphore_file_path: text(&server.semaphore_file_path),
        is_online: server.is_online,
        mdns,
    };
    RegistryQuery::Register {
        semaphore_is_there: semaphore(&asked.semaphore_file_path),
        asked: Box::new(asked),
    }
}

/// Returns whether the semaphore file exists; `None` without a path.
pub(crate) fn semaphore(path: &str) -> Option<bool> {
    (!path.is_empty()).then(|| Path::new(path).is_file())
}

/// Returns the response to a request that [`question`] converted.
pub(crate) fn response(
    request: &RequestMessage,
    answer: RegistryAnswer,
    own: &OwnDescription,
) -> ResponseMessage {
    let good = || ResponseHeader::new_good(request.request_header());
    match (request, answer) {
        (_, RegistryAnswer::Refused(status)) => fault(request, StatusCode::from(status)),
        (RequestMessage::FindServers(find), RegistryAnswer::Servers(servers)) => {
            let itself = own.description();
            let uris = find.server_uris.as_deref().unwrap_or_default();
            let wanted = uris.is_empty() || uris.contains(&itself.application_uri);
            let others = servers.iter().map(|server| description(server, find));
            let response = FindServersResponse {
                response_header: good(),
                servers: Some(wanted.then_some(itself).into_iter().chain(others).collect()),
            };
            response.into()
        }
        (RequestMessage::FindServersOnNetwork(_), RegistryAnswer::OnNetwork { records, reset }) => {
            let response = FindServersOnNetworkResponse {
                response_header: good(),
                last_counter_reset_time: DateTime::from(clock::ticks(reset)),
                servers: Some(records.iter().map(on_network).collect()),
            };
            response.into()
        }
        (RequestMessage::RegisterServer(_), RegistryAnswer::Registered) => RegisterServerResponse {
            response_header: good(),
        }
        .into(),
        (RequestMessage::RegisterServer2(request), RegistryAnswer::Registered) => {
            // Only the first MdnsDiscoveryConfiguration is used.
            let mut taken = false;
            let all = request.discovery_configuration.iter().flatten();
            let results = all.map(|one| {
                let counts = one.inner_is::<MdnsDiscoveryConfiguration>() && !taken;
                taken |= counts;
                if counts {
                    StatusCode::Good
                } else {
                    StatusCode::BadNotSupported
                }
            });
            let response = RegisterServer2Response {
                response_header: good(),
                configuration_results: Some(results.collect()),
                diagnostic_infos: None,
            };
            response.into()
        }
        _ => fault(request, StatusCode::BadInternalError),
    }
}

/// Returns a ServiceFault.
pub(crate) fn fault(request: &RequestMessage, status: StatusCode) -> ResponseMessage {
    ServiceFault::new(request.request_header(), status).into()
}

fn description(
    server: &RegistrationRequest,
    request: &FindServersRequest,
) -> ApplicationDescription {
    let wanted = request.locale_ids.as_deref().unwrap_or_default();
    let in_locale = wanted.iter().find_map(|locale| {
        let mut names = server.names.iter();
        names.find(|(of, _)| of.eq_ignore_ascii_case(locale.as_ref()))
    });
    let (locale, name) = match in_locale.or_else(|| server.names.first()) {
        Some((locale, name)) => (locale.as_str(), name.as_str()),
        None => ("", ""),
    };
    ApplicationDescription {
        application_uri: server.server_uri.as_str().into(),
        product_uri: server.product_uri.as_str().into(),
        application_name: LocalizedText::new(locale, name),
        application_type: match server.application_type {
            registry::ApplicationType::Server => ApplicationType::Server,
            registry::ApplicationType::Client => ApplicationType::Client,
            registry::ApplicationType::ClientAndServer => ApplicationType::ClientAndServer,
            registry::ApplicationType::DiscoveryServer => ApplicationType::DiscoveryServer,
        },
        gateway_server_uri: server.gateway_server_uri.as_str().into(),
        discovery_profile_uri: UAString::null(),
        discovery_urls: Some(
            server
                .discovery_urls
                .iter()
                .map(|url| url.as_str().into())
                .collect(),
        ),
    }
}

fn on_network(record: &NetworkRecord) -> ServerOnNetwork {
    let announcement = &record.announcement;
    let capabilities = announcement.capabilities.iter();
    ServerOnNetwork {
        record_id: record.record_id,
        server_name: announcement.instance.as_str().into(),
        discovery_url: announcement.url.as_str().into(),
        server_capabilities: Some(capabilities.map(|code| code.as_str().into()).collect()),
    }
}

fn text(text: &UAString) -> String {
    text.as_ref().to_owned()
}

fn texts(all: Option<&[UAString]>) -> Vec<String> {
    all.unwrap_or_default().iter().map(text).collect()
}

const UATCP: &str = "http://opcfoundation.org/UA-Profile/Transport/uatcp-uasc-uabinary";
const POLICY_NONE: &str = "http://opcfoundation.org/UA/SecurityPolicy#None";
const POLICY_BASIC256SHA256: &str = "http://opcfoundation.org/UA/SecurityPolicy#Basic256Sha256";
