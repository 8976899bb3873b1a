//! The method that sets the place of a component: `Configure(Place, SupervisorUri, DiscoveryUrl)`,
//! with three Strings, without results, on an object below Objects.

use plant_opcua::supervision::CONFIGURE;
use plant_opcua::types::{Argument, DataTypeId, NodeId, Variant};

/// The arguments of the method.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct ConfigureArguments {
    /// The place of the component in the plant.
    pub(crate) place: String,
    /// The ApplicationUri of the supervisor.
    pub(crate) supervisor_uri: String,
    /// The discovery server of the component's level.
    pub(crate) discovery_url: String,
}

impl ConfigureArguments {
    pub(crate) fn arguments(&self) -> Vec<Variant> {
        let Self {
            place,
            supervisor_uri,
            discovery_url,
        } = self;
        [place, supervisor_uri, discovery_url]
            .map(|text| Variant::from(text.as_str()))
            .to_vec()
    }

    /// Reads the arguments of a call; `None` if an argument is missing or is not a String.
    pub(crate) fn read(arguments: &[Variant]) -> Option<Self> {
        let mut texts = arguments.iter().map(|argument| {
            let Variant::String(text) = argument else {
                return None;
            };
            Some(text.as_ref().to_owned())
        });
        Some(Self {
            place: texts.next()??,
            supervisor_uri: texts.next()??,
            discovery_url: texts.next()??,
        })
    }
}

/// Returns whether a method has the name and the arguments of `Configure`.
pub(crate) fn is_configure(name: &str, takes: &[Argument], gives: &[Argument]) -> bool {
    let text: NodeId = DataTypeId::String.into();
    name == CONFIGURE
        && gives.is_empty()
        && takes.len() == 3
        && takes
            .iter()
            .all(|one| one.data_type == text && one.value_rank == -1)
}
