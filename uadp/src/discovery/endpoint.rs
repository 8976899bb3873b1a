//! The servers beside a Publisher and how to reach them.

use super::list::List;
use super::wire::{enumeration, structure};
use crate::LocalizedText;

structure! {
    /// An Endpoint of a Server (OPC 10000-4, 7.14).
    EndpointDescription<'a> {
        /// Where to connect to.
        endpoint_url: Option<&'a str> = "EndpointUrl",
        /// Whose Endpoint it is.
        server: ApplicationDescription<'a> = "Server",
        /// The server's certificate, DER.
        server_certificate: Option<&'a [u8]> = "ServerCertificate",
        /// What is done to messages.
        security_mode: MessageSecurityMode = "SecurityMode",
        /// With which algorithms.
        security_policy_uri: Option<&'a str> = "SecurityPolicyUri",
        /// How users can say who they are.
        user_identity_tokens: List<'a, UserTokenPolicy<'a>> = "UserIdentityTokens",
        /// The protocol stack.
        transport_profile_uri: Option<&'a str> = "TransportProfileUri",
        /// The higher, the more secure among the Endpoints of the server; 0 is advised against.
        security_level: u8 = "SecurityLevel",
    }

    /// An application (OPC 10000-4, 7.2).
    ApplicationDescription<'a> {
        /// Identity of this instance, which its certificate repeats.
        application_uri: Option<&'a str> = "ApplicationUri",
        /// Identity of the product.
        product_uri: Option<&'a str> = "ProductUri",
        /// Its name, for people.
        application_name: LocalizedText<'a> = "ApplicationName",
        /// Server, client, or both.
        application_type: ApplicationType = "ApplicationType",
        /// The gateway through which the discovery URLs lead.
        gateway_server_uri: Option<&'a str> = "GatewayServerUri",
        /// Which discovery the URLs support.
        discovery_profile_uri: Option<&'a str> = "DiscoveryProfileUri",
        /// Where to ask for Endpoints.
        discovery_urls: List<'a, Option<&'a str>> = "DiscoveryUrls",
    }

    /// One way in which users say who they are (OPC 10000-4, 7.41).
    UserTokenPolicy<'a> {
        /// Name of the policy within the server.
        policy_id: Option<&'a str> = "PolicyId",
        /// What the user shows.
        token_type: UserTokenType = "TokenType",
        /// Kind of an issued token.
        issued_token_type: Option<&'a str> = "IssuedTokenType",
        /// Who issues tokens.
        issuer_endpoint_url: Option<&'a str> = "IssuerEndpointUrl",
        /// With which algorithms the token is protected; null for those of the Endpoint.
        security_policy_uri: Option<&'a str> = "SecurityPolicyUri",
    }
}

enumeration! {
    /// What is done to messages (OPC 10000-4, 7.20).
    MessageSecurityMode {
        /// The default, which names no mode.
        INVALID = 0,
        /// Nothing.
        NONE = 1,
        /// They are signed.
        SIGN = 2,
        /// They are signed and encrypted.
        SIGN_AND_ENCRYPT = 3,
    }

    /// What kind of application one is (OPC 10000-4, 7.2).
    ApplicationType {
        /// A server.
        SERVER = 0,
        /// A client.
        CLIENT = 1,
        /// Both.
        CLIENT_AND_SERVER = 2,
        /// A server of nothing but discovery.
        DISCOVERY_SERVER = 3,
    }

    /// What a user shows (OPC 10000-4, 7.41).
    UserTokenType {
        /// Nothing.
        ANONYMOUS = 0,
        /// Name and password.
        USER_NAME = 1,
        /// A certificate.
        CERTIFICATE = 2,
        /// A token of an authorization service.
        ISSUED_TOKEN = 3,
    }
}
