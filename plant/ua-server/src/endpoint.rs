//! What clients may choose of the server: its endpoints and their security.

use mappings::Server;
use opcua::crypto::SecurityPolicy;
use opcua::server::{ANONYMOUS_USER_TOKEN_ID, ServerBuilder, ServerEndpoint};
use opcua::types::{BuildInfo, MessageSecurityMode, UAString};
use plant_opcua::endpoint::EndpointUrl;
use plant_opcua::limits;
use plant_opcua::pki::{OWN_CERTIFICATE, OWN_KEY};

/// The server the mapping describes, reached at `url`, for anonymous users. `port` is the one that is listened on, which differs from the URL's when that is 0.
pub(crate) fn server(described: &Server, url: &EndpointUrl, port: u16) -> ServerBuilder {
    let host = url.advertised_host();
    let anonymous = [ANONYMOUS_USER_TOKEN_ID.to_owned()];
    let mut builder = ServerBuilder::new()
        .without_node_managers()
        .application_name(APPLICATION_NAME)
        .application_uri(described.application_uri.as_str())
        .product_uri(PRODUCT_URI)
        .build_info(BuildInfo {
            product_uri: UAString::from(PRODUCT_URI),
            manufacturer_name: UAString::null(),
            product_name: UAString::from(APPLICATION_NAME),
            software_version: UAString::from(env!("CARGO_PKG_VERSION")),
            build_number: UAString::null(),
            build_date: opcua::types::DateTime::null(),
        })
        .discovery_urls(vec![url.advertised(port)])
        .host(host)
        .port(port)
        .certificate_path(OWN_CERTIFICATE)
        .private_key_path(OWN_KEY)
        .subscription_poll_interval_ms(limits::POLL_MS)
        // The library lets a request take the longer one of this and of what its client says, and what a client says is to
        // hold. Each call has an end of its own.
        .max_timeout_ms(0)
        .limits(limits::server());
    for policy in &described.security {
        let (policy, modes) = match policy {
            mappings::SecurityPolicy::None => {
                (SecurityPolicy::None, [MessageSecurityMode::None].as_slice())
            }
            mappings::SecurityPolicy::Basic256Sha256 => (
                SecurityPolicy::Basic256Sha256,
                [
                    MessageSecurityMode::Sign,
                    MessageSecurityMode::SignAndEncrypt,
                ]
                .as_slice(),
            ),
        };
        for mode in modes {
            let endpoint = ServerEndpoint::new(url.path(), policy, *mode, &anonymous);
            builder = builder.add_endpoint(format!("{policy} {mode}"), endpoint);
        }
    }
    builder
}

const APPLICATION_NAME: &str = "UA bridge server";
pub(crate) const PRODUCT_URI: &str = "urn:ua-bridge:server";
