//! What is there of what a mapping names.

use std::time::Duration;

use mappings::{Environment, Mapping, SpaceId};
use serde::Serialize;

use crate::arguments::{Check, Part};
use crate::exit::Failure;
use crate::survey::{self, look};

/// What was found, and what was not there to be asked.
#[derive(Default)]
pub(crate) struct Seen {
    pub(crate) environment: Environment,
    pub(crate) asked: Vec<Asked>,
}

/// Somebody who was asked.
#[derive(Debug, Serialize)]
#[serde(rename_all = "camelCase")]
pub(crate) struct Asked {
    /// As `ROS 1 master http://localhost:11311`.
    pub(crate) whom: String,
    pub(crate) there: bool,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) why: Option<String>,
}

impl Seen {
    /// Asks the graphs of the mapping's spaces and its server, as far as that is wished.
    ///
    /// # Errors
    /// What was typed, or the environment's own configuration, is wrong; who is not there is no error.
    pub(crate) fn look(mapping: &Mapping, arguments: &Check) -> Result<Self, Failure> {
        let mut seen = Self::default();
        let wished = |part| arguments.environment.contains(&part);
        for space in mapping.spaces() {
            if space.id == SpaceId::ROS1 && wished(Part::Ros1) {
                let uri = survey::ros1::master_uri();
                let live = look(survey::ros1::survey(&uri));
                if let Some(live) = seen.asked(format!("ROS 1 master {uri}"), live)? {
                    seen.environment.spaces.insert(space.id, live);
                }
            }
            if let Some(domain) = space.domain.filter(|_| wished(Part::Ros2)) {
                let wait = Duration::from_secs(arguments.wait.into());
                let live = look(survey::ros2::survey(domain, wait));
                if let Some(live) = seen.asked(format!("DDS domain {domain}"), live)? {
                    seen.environment.spaces.insert(space.id, live);
                }
            }
        }
        if wished(Part::Opcua) {
            let url = mapping.server().endpoint.to_string();
            let server = look(survey::opcua::check(&url, mapping));
            seen.environment.server = seen.asked(format!("OPC UA server {url}"), server)?;
        }
        Ok(seen)
    }

    fn asked<T>(&mut self, whom: String, answer: Result<T, Failure>) -> Result<Option<T>, Failure> {
        let (there, why) = match answer {
            Ok(found) => (Some(found), None),
            Err(Failure::Unavailable(why)) => (None, Some(why)),
            Err(other) => return Err(other),
        };
        self.asked.push(Asked {
            whom,
            there: there.is_some(),
            why,
        });
        Ok(there)
    }

    /// Whether everybody was there.
    pub(crate) fn is_whole(&self) -> bool {
        self.asked.iter().all(|asked| asked.there)
    }
}
