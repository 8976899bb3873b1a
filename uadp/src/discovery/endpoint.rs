//! The Servers associated with a Publisher, and their Endpoints.

use super::list::WireArray;
use super::wire::{enumeration, structure};
use crate::LocalizedText;

structure! {
    /// An Endpoint of a Server (OPC 10000-4, 7.14).
    EndpointDescription<'a> {
        /// Address of the Endpoint.
        endpoint_url: Option<&'a str> = "EndpointUrl",
        /// Server of the Endpoint.
        server: ApplicationDescription<'a> = "Server",
        /// Certificate of the Server, DER.
        server_certificate: Option<&'a [u8]> = "ServerCertificate",
        /// Security mode of the messages.
        security_mode: MessageSecurityMode = "SecurityMode",
        /// Algorithms of the security policy.
        security_policy_uri: Option<&'a str> = "SecurityPolicyUri",
        /// Supported user identity tokens.
        user_identity_tokens: WireArray<'a, UserTokenPolicy<'a>> = "UserIdentityTokens",
        /// The protocol stack.
        transport_profile_uri: Option<&'a str> = "TransportProfileUri",
        /// Security level among the Endpoints of the Server; a higher level is more secure, 0 is
        /// not recommended.
        security_level: u8 = "SecurityLevel",
    }

    /// An application (OPC 10000-4, 7.2).
    ApplicationDescription<'a> {
        /// Identity of this instance, as in its certificate.
        application_uri: Option<&'a str> = "ApplicationUri",
        /// Identity of the product.
        product_uri: Option<&'a str> = "ProductUri",
        /// Its name, for people.
        application_name: LocalizedText<'a> = "ApplicationName",
        /// Server, client, or both.
        application_type: ApplicationType = "ApplicationType",
        /// Gateway of the discovery URLs.
        gateway_server_uri: Option<&'a str> = "GatewayServerUri",
        /// Discovery profile that the URLs support.
        discovery_profile_uri: Option<&'a str> = "DiscoveryProfileUri",
        /// Addresses of the discovery Endpoints.
        discovery_urls: WireArray<'a, Option<&'a str>> = "DiscoveryUrls",
    }

    /// A user identity token that an Endpoint accepts (OPC 10000-4, 7.41).
    UserTokenPolicy<'a> {
        /// Name of the policy within the server.
        policy_id: Option<&'a str> = "PolicyId",
        /// Type of the token.
        token_type: UserTokenType = "TokenType",
        /// Kind of an issued token.
        issued_token_type: Option<&'a str> = "IssuedTokenType",
        /// Endpoint of the token issuer.
        issuer_endpoint_url: Option<&'a str> = "IssuerEndpointUrl",
        /// Algorithms that protect the token; null for the algorithms of the Endpoint.
        security_policy_uri: Option<&'a str> = "SecurityPolicyUri",
    }
}

enumeration! {
    /// Security mode of messages (OPC 10000-4, 7.20).
    MessageSecurityMode {
        /// The default, which is not a valid mode.
        INVALID = 0,
        /// Messages are neither signed nor encrypted.
        NONE = 1,
        /// Messages are signed.
        SIGN = 2,
        /// Messages are signed and encrypted.
        SIGN_AND_ENCRYPT = 3,
    }

    /// Kind of an application (OPC 10000-4, 7.2).
    ApplicationType {
        /// A server.
        SERVER = 0,
        /// A client.
        CLIENT = 1,
        /// A client and server.
        CLIENT_AND_SERVER = 2,
        /// A server for discovery only.
        DISCOVERY_SERVER = 3,
    }

    /// Type of a user identity token (OPC 10000-4, 7.41).
    UserTokenType {
        /// No identity.
        ANONYMOUS = 0,
        /// Name and password.
        USER_NAME = 1,
        /// A certificate.
        CERTIFICATE = 2,
        /// A token of an authorization service.
        ISSUED_TOKEN = 3,
    }
}
