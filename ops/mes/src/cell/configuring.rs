//! The components of a product configuration, as discovery found them.

use async_trait::async_trait;
use mtp::ConfiguredComponent;
use skills::{FieldChange, SetFieldsFault, SkillClient, SkillHandle};

use super::PlantState;
use crate::product_configuration::{ConfigurationTarget, ProductComponent, fields};

/// A connected component.
struct ConnectedTarget {
    handle: SkillHandle,
    /// The units of the fields in the file.
    units: Vec<(String, String)>,
    /// Keeps the connection.
    _client: SkillClient,
}

#[async_trait]
impl ConfigurationTarget for ConnectedTarget {
    async fn set(
        &self,
        fields: &FieldChange,
        checks_only: bool,
    ) -> Result<FieldChange, SetFieldsFault> {
        if checks_only {
            self.handle.check_units(&self.units).await?;
        }
        self.handle.set_fields(fields, checks_only).await
    }
}

impl PlantState {
    /// Connects to a component of a product configuration.
    pub(crate) async fn configured(&self, of: &ConfiguredComponent) -> ProductComponent {
        let target = self.target(of).await;
        ProductComponent {
            application_uri: of.application_uri.clone(),
            fields: fields(of),
            target: target.map(|target| Box::new(target) as Box<dyn ConfigurationTarget>),
        }
    }

    async fn target(&self, of: &ConfiguredComponent) -> Result<ConnectedTarget, String> {
        let found = {
            let present = self.present();
            let mut all = present.components.values();
            let component = all.find(|one| one.application_uri == of.application_uri);
            component
                .and_then(|one| Some((one.endpoint.clone(), one.found.values().next()?.clone())))
        };
        let (endpoint, skill) = found.ok_or("it is not in the plant, or has no skills")?;
        let client = SkillClient::connect(&endpoint, &self.client).await;
        let client = client.map_err(|fault| format!("{endpoint}: {fault}"))?;
        Ok(ConnectedTarget {
            handle: client.handle(&skill),
            units: of.units.clone(),
            _client: client,
        })
    }
}
