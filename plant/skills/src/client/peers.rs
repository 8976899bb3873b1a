//! How the skills of a component reach the skills of other components.

use std::path::Path;

use plant_opcua::client::SecurityChoice;

use super::remote::FOUND_WITHIN;
use super::{ClientOptions, Detector, PartnerError, SkillClient};
use crate::component::{Component, ComponentSecurity, Partner};
use crate::model::SKILL_TYPE;
use crate::parameters::ParameterType;
use crate::skill_fault::SkillFault;

/// The identity with which the skills of a component connect to other components, and the index of
/// discovered components.
#[derive(Debug, Clone, Default)]
pub struct PeerAccess {
    /// The identity: the certificate and the user of the component.
    pub options: ClientOptions,
    /// Finds components; `None` if the component needs no discovery.
    pub detector: Option<Detector>,
}

impl ClientOptions {
    /// Returns the identity of a component as a client: its certificate, and the user of its YAML.
    /// A component that serves secured endpoints only connects to secured endpoints only.
    #[must_use]
    pub fn of_component(component: &Component, pki: Option<&Path>) -> Self {
        let is_open = component.security.contains(&ComponentSecurity::None);
        Self {
            // Servers refuse a session with another ApplicationUri than that of the certificate.
            application_uri: component.application_uri.clone(),
            application_name: component.name.clone(),
            pki: pki.map(Path::to_owned),
            user: component.user.clone(),
            security: match pki {
                Some(_) if !is_open => SecurityChoice::Basic256Sha256,
                // A password is sent over an unsecured channel only if nothing else is configured.
                None if component.user.is_some() => SecurityChoice::None,
                Some(_) | None => SecurityChoice::Best,
            },
            ..Self::default()
        }
    }
}

impl PeerAccess {
    /// Creates the access of a component. A detector is created if a skill finds its partners by
    /// discovery.
    #[must_use]
    pub fn of_component(component: &Component, pki: Option<&Path>) -> Self {
        let options = ClientOptions::of_component(component, pki);
        let detector = component
            .looks_for_others()
            .then(|| Detector::new(options.clone()));
        Self { options, detector }
    }

    /// Connects to a server.
    ///
    /// # Errors
    /// [`PartnerError::Component`].
    pub async fn connect(&self, endpoint: &str) -> Result<SkillClient, PartnerError> {
        let connected = SkillClient::connect(endpoint, &self.options).await;
        connected.map_err(|fault| PartnerError::Component {
            endpoint: endpoint.to_owned(),
            fault,
        })
    }

    /// Waits for a partner and returns its endpoint.
    ///
    /// # Errors
    /// The partner is not found; with the reasons of the servers that could not be read.
    pub async fn endpoint(&self, partner: &Partner) -> Result<String, PartnerError> {
        let (uri, detector) = match (partner, &self.detector) {
            (Partner::At(endpoint), _) => return Ok(endpoint.clone()),
            (Partner::Called(uri), Some(detector)) => (uri, detector),
            (Partner::Called(uri), None) => {
                return Err(PartnerError::Undiscoverable { uri: uri.clone() });
            }
        };
        let any = ParameterType::own(SKILL_TYPE);
        let found = detector.one(&any, FOUND_WITHIN, |one| one.application_uri == *uri);
        match found.await {
            Ok(found) => Ok(found.endpoint),
            Err(SkillFault::Unexpected(_)) => Err(PartnerError::NotFound {
                uri: uri.clone(),
                unreadable: detector.unreadable(),
            }),
            Err(fault) => Err(fault.into()),
        }
    }
}
