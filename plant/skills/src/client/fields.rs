//! Sets the configured fields of another component.

use plant_opcua::client::{Browse, OpcUaClient};
use plant_opcua::types::{EUInformation, NodeId, Variant};

use super::{SkillHandle, called, lost};
use crate::configuration::FieldChange;
use crate::server::{CONFIGURATION, CONFIGURED, SET_FIELDS};
use crate::skill_fault::SkillFault;
use crate::variant::{from_optional_pairs, from_variant, to_optional_pairs};

/// The reason why fields are not set.
#[derive(Debug, thiserror::Error)]
pub enum SetFieldsFault {
    /// The component has no fields that clients can set.
    #[error("it has no configurable fields that are set by {SET_FIELDS}")]
    None,
    /// The component refuses a field. Nothing is set.
    #[error("{field}: {reason}")]
    Refused {
        /// The first wrong field; empty if the fault is not that of a field.
        field: String,
        /// The reason.
        reason: String,
    },
    /// The request was refused, or there is no response. After [`SkillFault::Lost`] it is unknown
    /// whether the fields are set.
    #[error(transparent)]
    Request(#[from] SkillFault),
}

impl SkillHandle {
    /// Checks that fields of the component have these units: symbols, with the names of the fields.
    /// Fields without a unit, and fields that the component does not show, have any unit.
    ///
    /// # Errors
    /// [`SetFieldsFault`].
    pub async fn check_units(&self, units: &[(String, String)]) -> Result<(), SetFieldsFault> {
        let client = self.client();
        let object = child(client, self.component(), CONFIGURATION).await?;
        let object = object.ok_or(SetFieldsFault::None)?;
        for (field, unit) in units {
            let Some(variable) = child(client, &object, field).await? else {
                continue;
            };
            let Some(property) = child(client, &variable, "EngineeringUnits").await? else {
                continue;
            };
            let read = client.read(&[property]).await;
            let read = read.map_err(|error| lost(&error))?;
            let Some(Some(Variant::ExtensionObject(shown))) = read.first().map(|one| &one.value)
            else {
                continue;
            };
            let Some(shown) = shown.inner_as::<EUInformation>() else {
                continue;
            };
            let symbol = shown.display_name.text.as_ref();
            if symbol != unit {
                return Err(SetFieldsFault::Refused {
                    field: field.clone(),
                    reason: format!("expected the unit {symbol}, found {unit}"),
                });
            }
        }
        Ok(())
    }

    /// Sets configured fields of the component of the skill, or only checks them. A missing value
    /// removes the configured value of a field. Returns the values before.
    ///
    /// # Errors
    /// [`SetFieldsFault`]. Nothing is set, except after [`SkillFault::Lost`].
    pub async fn set_fields(
        &self,
        fields: &[(String, Option<crate::value::SkillValue>)],
        checks_only: bool,
    ) -> Result<FieldChange, SetFieldsFault> {
        let client = self.client();
        let component = self.component();
        let object = child(client, component, CONFIGURATION).await?;
        let object = object.ok_or(SetFieldsFault::None)?;
        let method = child(client, &object, SET_FIELDS).await?;
        let method = method.ok_or(SetFieldsFault::None)?;
        let [names, values] = to_optional_pairs(fields);
        let arguments = vec![names, values, checks_only.into()];
        let what = format!("{SET_FIELDS} of {}", self.found().component);
        let answer = client.call(&object, &method, arguments).await;
        let answer = answer.map_err(|error| called(&error, &what))?;
        let wrong = || SkillFault::Unexpected(format!("{what} has another response"));
        let [status, field, reason, names, values] = answer.as_slice() else {
            return Err(wrong().into());
        };
        let text = |of: &Variant| {
            let text = from_variant(of);
            text.and_then(|text| text.as_str().map(str::to_owned))
                .unwrap_or_default()
        };
        if text(status) != CONFIGURED {
            return Err(SetFieldsFault::Refused {
                field: text(field),
                reason: text(reason),
            });
        }
        Ok(from_optional_pairs(names, values).ok_or_else(wrong)?)
    }
}

async fn child(
    client: &OpcUaClient,
    node: &NodeId,
    name: &str,
) -> Result<Option<NodeId>, SkillFault> {
    let below = client.browse(node, Browse::hierarchical()).await;
    let mut below = below.map_err(|error| lost(&error))?.into_iter();
    let found = below.find(|child| child.browse_name.name.as_ref() == name);
    Ok(found.map(|child| child.node_id.node_id))
}
