//! Sets the configured fields of another component.

use plant_opcua::client::{Browse, OpcUaClient};
use plant_opcua::types::{DataValue, EUInformation, NodeId, StatusCode, Variant};

use super::stations::BEHIND;
use super::{SkillClient, called, lost};
use crate::configuration::FieldChange;
use crate::server::{CONFIGURED, SET_FIELDS};
use crate::skill_fault::SkillFault;
use crate::variant::{from_optional_pairs, from_variant, to_optional_pairs};

/// The configuration of a component that was found at a server. The component may have no skills.
#[derive(Debug, Clone, PartialEq)]
pub struct FoundConfiguration {
    /// The name of its component.
    pub component: String,
    /// The ApplicationUri of the component behind a station; `None` for a component of the server
    /// itself.
    pub behind: Option<String>,
    /// The number of the component in the space, if the server provides it.
    pub namespace: Option<u16>,
    pub(super) object: NodeId,
}

impl FoundConfiguration {
    /// Returns the endpoint of the component of a configuration that was found at a server.
    #[must_use]
    pub fn endpoint(&self, server: &str) -> String {
        match &self.behind {
            Some(uri) => format!("{server}{BEHIND}{uri}"),
            None => server.to_owned(),
        }
    }
}

/// The fields of a component that can be set. Clones share the connection.
#[derive(Clone)]
pub struct ConfigurationHandle {
    client: OpcUaClient,
    found: FoundConfiguration,
}

impl SkillClient {
    /// Returns a handle to set the fields of a component.
    #[must_use]
    pub fn configuration(&self, found: &FoundConfiguration) -> ConfigurationHandle {
        ConfigurationHandle {
            client: self.client.clone(),
            found: found.clone(),
        }
    }
}

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

impl ConfigurationHandle {
    /// Checks that fields of the component have these units: symbols, with the names of the fields.
    /// Fields without a unit, and fields that the component does not show, have any unit. A unit
    /// that cannot be read is an error.
    ///
    /// # Errors
    /// [`SetFieldsFault`].
    pub async fn check_units(&self, units: &[(String, String)]) -> Result<(), SetFieldsFault> {
        let client = &self.client;
        for (field, unit) in units {
            let Some(variable) = child(client, &self.found.object, field).await? else {
                continue;
            };
            let Some(property) = child(client, &variable, "EngineeringUnits").await? else {
                continue;
            };
            let read = client.read(&[property]).await;
            let read = read.map_err(|error| lost(&error))?;
            check_unit(unit, read.first()).map_err(|reason| SetFieldsFault::Refused {
                field: field.clone(),
                reason,
            })?;
        }
        Ok(())
    }

    /// Sets configured fields of the component, or only checks them. A missing value removes the
    /// configured value of a field. Returns the values before.
    ///
    /// # Errors
    /// [`SetFieldsFault`]. Nothing is set, except after [`SkillFault::Lost`].
    pub async fn set_fields(
        &self,
        fields: &[(String, Option<crate::value::SkillValue>)],
        checks_only: bool,
    ) -> Result<FieldChange, SetFieldsFault> {
        let (client, object) = (&self.client, &self.found.object);
        let method = child(client, object, SET_FIELDS).await?;
        let method = method.ok_or(SetFieldsFault::None)?;
        let [names, values] = to_optional_pairs(fields);
        let arguments = vec![names, values, checks_only.into()];
        let what = format!("{SET_FIELDS} of {}", self.found.component);
        let answer = client.call(object, &method, arguments).await;
        let answer = answer.map_err(|error| may_not(called(&error, &what)))?;
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

/// Adds the missing role to the reason of a denied request.
fn may_not(fault: SkillFault) -> SkillFault {
    match fault {
        SkillFault::Refused { status, text } if status == DENIED.to_string() => {
            let text = format!(
                "{text}: the user needs the role configure_admin at this component, or at the \
                 station before it"
            );
            SkillFault::Refused { status, text }
        }
        SkillFault::Refused { .. }
        | SkillFault::Lost(_)
        | SkillFault::TimedOut(_)
        | SkillFault::NotHalted(_)
        | SkillFault::Unexpected(_) => fault,
    }
}

/// Checks that the value of a property EngineeringUnits is a unit, a symbol. Returns the reason if
/// it is not, or cannot be read.
fn check_unit(unit: &str, shown: Option<&DataValue>) -> Result<(), String> {
    let value = shown.and_then(|shown| shown.value.as_ref());
    let status = shown.map_or(StatusCode::BadNoData, DataValue::status);
    let symbol = match value {
        Some(Variant::ExtensionObject(value)) if !status.is_bad() => value
            .inner_as::<EUInformation>()
            .map(|shown| shown.display_name.text.as_ref()),
        _ => None,
    };
    let Some(symbol) = symbol else {
        let why = match status.is_bad() {
            true => status.to_string(),
            false => "no EUInformation".to_owned(),
        };
        return Err(format!(
            "cannot read its unit ({why}), so the unit {unit} of the file cannot be checked"
        ));
    };
    match symbol == unit {
        true => Ok(()),
        false => Err(format!("expected the unit {symbol}, found {unit}")),
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

const DENIED: StatusCode = StatusCode::BadUserAccessDenied;

#[cfg(test)]
mod tests {
    use plant_opcua::types::{Argument, ExtensionObject};

    use super::*;

    #[test]
    fn a_unit_that_cannot_be_read_is_no_unit_that_fits() {
        let newton = ExtensionObject::from_message(EUInformation {
            display_name: "N".into(),
            ..EUInformation::default()
        });
        let of = |value: Variant| DataValue::value_only(value);
        let shown = of(newton.into());
        let mut bad = shown.clone();
        bad.status = Some(StatusCode::BadUserAccessDenied);
        let mut uncertain = shown.clone();
        uncertain.status = Some(StatusCode::UncertainLastUsableValue);
        let unread = |why: &str| {
            format!("cannot read its unit ({why}), so the unit kN of the file cannot be checked")
        };
        let other = ExtensionObject::from_message(Argument::default());
        let differs = "expected the unit N, found kN".to_owned();
        for (value, reason) in [
            (Some(&shown), differs.clone()),
            (Some(&uncertain), differs),
            (Some(&bad), unread("BadUserAccessDenied")),
            (Some(&of("N".into())), unread("no EUInformation")),
            (Some(&of(other.into())), unread("no EUInformation")),
            (Some(&DataValue::default()), unread("no EUInformation")),
            (None, unread("BadNoData")),
        ] {
            assert_eq!(check_unit("kN", value), Err(reason));
        }
        assert_eq!(check_unit("N", Some(&shown)), Ok(()));
        assert_eq!(check_unit("N", Some(&uncertain)), Ok(()));
    }
}
