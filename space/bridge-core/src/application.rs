//! The application of a Publisher (OPC 10000-14, 7.2.4.6.5 and 7.2.4.6.6): the own announcement,
//! and the announcements of other programs.

use mappings::SpaceId;
use uadp::discovery::{
    AnnouncedContent, Announcement, ApplicationDescription, ApplicationType, EndpointDescription,
    MessageSecurityMode, WireArray,
};
use uadp::{EncodeError, LocalizedText, PublisherId, SecurityHeader, StatusCode};

/// An application as announced in the group.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Application {
    /// The ApplicationUri.
    pub uri: String,
    /// The ProductUri; may be empty.
    pub product_uri: String,
    /// The ApplicationName.
    pub name: String,
    /// The DiscoveryUrls, at which its server listens; empty for a program without a server.
    pub urls: Vec<String>,
    /// The ServerCapability identifiers (OPC 10000-12, Annex D).
    pub capabilities: Vec<String>,
    /// The Endpoints of its server.
    pub endpoints: Vec<ApplicationEndpoint>,
}

/// An Endpoint of the server of an [`Application`].
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ApplicationEndpoint {
    /// The EndpointUrl.
    pub url: String,
    /// The SecurityPolicyUri.
    pub policy_uri: String,
    /// The MessageSecurityMode.
    pub mode: MessageSecurityMode,
}

impl Application {
    /// Adds an Endpoint for each URL and each of the security settings. A security setting is the
    /// SecurityPolicyUri, and whether messages are encrypted in addition to signed; `None` for
    /// neither.
    #[must_use]
    pub fn talked_to<'a>(
        mut self,
        ways: impl IntoIterator<Item = (&'a str, Option<bool>)>,
    ) -> Self {
        for (policy_uri, encrypts) in ways {
            let each = self.urls.iter().map(|url| ApplicationEndpoint {
                url: url.clone(),
                policy_uri: policy_uri.to_owned(),
                mode: match encrypts {
                    None => MessageSecurityMode::NONE,
                    Some(false) => MessageSecurityMode::SIGN,
                    Some(true) => MessageSecurityMode::SIGN_AND_ENCRYPT,
                },
            });
            self.endpoints.extend(each);
        }
        self
    }

    /// Reads the announcement of another application. Returns `None` if a text is too long or has
    /// control characters, or if the ApplicationUri is empty.
    pub(crate) fn read(
        description: &ApplicationDescription<'_>,
        capabilities: WireArray<'_, Option<&str>>,
    ) -> Option<Self> {
        let texts = |list: WireArray<'_, Option<&str>>| -> Option<Vec<String>> {
            let some = list.iter().take(MOST_TEXTS).flatten();
            some.map(|text| kept(Some(text))).collect()
        };
        let uri = kept(description.application_uri)?;
        (!uri.is_empty()).then_some(())?;
        Some(Self {
            uri,
            product_uri: kept(description.product_uri)?,
            name: kept(description.application_name.text)?,
            urls: texts(description.discovery_urls)?,
            capabilities: texts(capabilities)?,
            endpoints: Vec::new(),
        })
    }

    /// Appends the complete announcement of the application.
    pub(crate) fn announce(
        &self,
        (space, sequence_number): (SpaceId, u16),
        out: &mut Vec<u8>,
    ) -> Result<(), EncodeError> {
        let urls = some(&self.urls);
        let capabilities = some(&self.capabilities);
        let announcement = Announcement {
            sequence_number,
            announced: AnnouncedContent::ApplicationDescription {
                description: self.description(&urls),
                capabilities: WireArray::new(&capabilities),
            },
        };
        let publisher = PublisherId::UInt16(space.into());
        announcement.encode(publisher, SecurityHeader::NONE, out)
    }

    /// Appends the complete announcement of the Endpoints. A program without a server announces
    /// Bad_NotSupported.
    pub(crate) fn announce_endpoints(
        &self,
        (space, sequence_number): (SpaceId, u16),
        out: &mut Vec<u8>,
    ) -> Result<(), EncodeError> {
        let urls = some(&self.urls);
        let endpoints = self.endpoints.iter().map(|endpoint| EndpointDescription {
            endpoint_url: Some(&endpoint.url),
            server: self.description(&urls),
            security_mode: endpoint.mode,
            security_policy_uri: Some(&endpoint.policy_uri),
            transport_profile_uri: Some(UA_TCP),
            ..EndpointDescription::default()
        });
        let endpoints: Vec<EndpointDescription<'_>> = endpoints.collect();
        let announcement = Announcement {
            sequence_number,
            announced: AnnouncedContent::PublisherEndpoints {
                endpoints: WireArray::new(&endpoints),
                status: if endpoints.is_empty() {
                    BAD_NOT_SUPPORTED
                } else {
                    StatusCode::GOOD
                },
            },
        };
        let publisher = PublisherId::UInt16(space.into());
        announcement.encode(publisher, SecurityHeader::NONE, out)
    }

    fn description<'a>(&'a self, urls: &'a [Option<&'a str>]) -> ApplicationDescription<'a> {
        ApplicationDescription {
            application_uri: Some(&self.uri),
            product_uri: (!self.product_uri.is_empty()).then_some(&self.product_uri),
            application_name: LocalizedText {
                locale: None,
                text: Some(&self.name),
            },
            application_type: if self.urls.is_empty() {
                ApplicationType::CLIENT
            } else {
                ApplicationType::SERVER
            },
            discovery_urls: WireArray::new(urls),
            ..ApplicationDescription::default()
        }
    }
}

fn some(texts: &[String]) -> Vec<Option<&str>> {
    texts.iter().map(|text| Some(text.as_str())).collect()
}

/// Returns the text if it is short enough and has no control characters.
fn kept(text: Option<&str>) -> Option<String> {
    let text = text.unwrap_or_default();
    let fits = text.len() <= LONGEST_TEXT && !text.chars().any(char::is_control);
    fits.then(|| text.to_owned())
}

const UA_TCP: &str = "http://opcfoundation.org/UA-Profile/Transport/uatcp-uasc-uabinary";
/// Bad_NotSupported (OPC 10000-6, A.2).
const BAD_NOT_SUPPORTED: StatusCode = StatusCode(0x803D_0000);
const LONGEST_TEXT: usize = 512;
const MOST_TEXTS: usize = 16;
