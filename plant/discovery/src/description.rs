//! The description of a server: [`ServerDescription`].

use std::num::NonZeroU16;

use plant_opcua::enrolment::Applicant;

/// The description of a server for announcement and registration.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ServerDescription {
    /// The ApplicationUri.
    pub application_uri: String,
    /// The ProductUri; may be empty.
    pub product_uri: String,
    /// The ApplicationName. The mDNS instance name consists of it, the host and the port.
    pub name: String,
    /// The URL, for example `opc.tcp://127.0.0.1:43121/`.
    pub url: String,
    /// The server capabilities: codes of OPC 10000-12, Annex D.
    pub capabilities: Vec<String>,
    /// The number of the server in the space, which is the namespace of its publications; `None` if
    /// it publishes nothing there.
    pub number: Option<NonZeroU16>,
}

impl ServerDescription {
    /// Returns the applicant for a Global Discovery Server, with these DiscoveryUrls in addition to
    /// the URL of the server.
    #[must_use]
    pub fn applicant(&self, urls: impl IntoIterator<Item = String>) -> Applicant {
        let mut all = vec![self.url.clone()];
        for url in urls {
            if !all.contains(&url) {
                all.push(url);
            }
        }
        Applicant {
            application_uri: self.application_uri.clone(),
            name: self.name.clone(),
            product_uri: self.product_uri.clone(),
            urls: all,
            capabilities: self.capabilities.clone(),
        }
    }
}
