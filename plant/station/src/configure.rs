//! The method by which a component is told its place: `Configure(Place, SupervisorUri, DiscoveryUrl)`, three Strings, nothing
//! back, on an object below Objects.

use plant_opcua::supervision::CONFIGURE;
use plant_opcua::types::{Argument, DataTypeId, NodeId, Variant};

/// What a component is told.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Told {
    /// Where it is in the plant.
    pub(crate) place: String,
    /// The ApplicationUri of whoever tells it.
    pub(crate) supervisor_uri: String,
    /// The discovery server of its level.
    pub(crate) discovery_url: String,
}

impl Told {
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

    /// Of the arguments of a call, which has them all.
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

/// Whether a method is the one.
pub(crate) fn is_configure(name: &str, takes: &[Argument], gives: &[Argument]) -> bool {
    let text: NodeId = DataTypeId::String.into();
    name == CONFIGURE
        && gives.is_empty()
        && takes.len() == 3
        && takes
            .iter()
            .all(|one| one.data_type == text && one.value_rank == -1)
}
