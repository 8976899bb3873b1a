//! Queries the environment for the topics, types and nodes of a mapping.

use std::collections::BTreeMap;
use std::time::Duration;

use mappings::{
    Access, Environment, ExecutedBy, ExpandedNodeIdText, Mapping, MethodTarget, SpaceId,
};
use serde::Serialize;

use crate::arguments::{CheckArguments, EnvironmentPart};
use crate::exit::CommandFailure;
use crate::survey::{self, look};

/// The queried environment, with the parts that were not available.
#[derive(Default)]
pub(crate) struct QueriedEnvironment {
    pub(crate) environment: Environment,
    pub(crate) asked: Vec<EnvironmentQuery>,
}

/// A queried part of the environment.
#[derive(Debug, Serialize)]
#[serde(rename_all = "camelCase")]
pub(crate) struct EnvironmentQuery {
    /// The name of the part, as `ROS 1 master http://localhost:11311`.
    pub(crate) whom: String,
    pub(crate) there: bool,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) why: Option<String>,
}

impl QueriedEnvironment {
    /// Queries the graphs of the spaces and the servers of the mapping, as selected by
    /// `--environment`.
    ///
    /// # Errors
    /// The arguments or the configuration of the environment are wrong. An unavailable part is not
    /// an error.
    pub(crate) fn look(
        mapping: &Mapping,
        arguments: &CheckArguments,
    ) -> Result<Self, CommandFailure> {
        let mut seen = Self::default();
        let wished = |part| arguments.environment.contains(&part);
        for space in mapping.spaces() {
            if space.id == SpaceId::ROS1 && wished(EnvironmentPart::Ros1) {
                let uri = survey::ros1::master_uri();
                let live = look(survey::ros1::survey(&uri));
                if let Some(live) = seen.asked(format!("ROS 1 master {uri}"), live)? {
                    seen.environment.spaces.insert(space.id, live);
                }
            }
            if let Some(domain) = space.domain.filter(|_| wished(EnvironmentPart::Ros2)) {
                let wait = Duration::from_secs(arguments.wait.into());
                let live = look(survey::ros2::survey(domain, wait));
                if let Some(live) = seen.asked(format!("DDS domain {domain}"), live)? {
                    seen.environment.spaces.insert(space.id, live);
                }
            }
        }
        if wished(EnvironmentPart::Opcua) {
            let url = mapping.server().first_endpoint().to_string();
            let server = look(survey::opcua::check(&url, mapping));
            seen.environment.server = seen.asked(format!("OPC UA server {url}"), server)?;
            seen.methods(mapping)?;
            seen.remote(mapping)?;
        }
        Ok(seen)
    }

    /// Queries each server that has Methods of the mapping.
    fn methods(&mut self, mapping: &Mapping) -> Result<(), CommandFailure> {
        let mut by_server: BTreeMap<String, (&Access, Vec<&MethodTarget>)> = BTreeMap::new();
        for call in mapping.executed_in(SpaceId::UA) {
            if let ExecutedBy::OpcUa(target) = &call.executed {
                let user = target.access.user.as_ref().map(|user| &user.name);
                let key = format!("{} {user:?}", target.access.endpoint);
                let (_, targets) = by_server
                    .entry(key)
                    .or_insert_with(|| (&target.access, Vec::new()));
                targets.push(target);
            }
        }
        for (access, targets) in by_server.into_values() {
            let told = look(survey::opcua::methods(access, &targets));
            let told = self.asked(format!("OPC UA server {}", access.endpoint), told)?;
            let methods = targets.into_iter().cloned().zip(told.unwrap_or_default());
            self.environment.methods.extend(methods);
        }
        Ok(())
    }

    /// Queries each server that is a source or target of variables.
    fn remote(&mut self, mapping: &Mapping) -> Result<(), CommandFailure> {
        for server in mapping.servers() {
            let mut nodes: Vec<&ExpandedNodeIdText> = Vec::new();
            for variable in mapping.variables() {
                let from = variable.from.as_deref();
                let from = from.map(|from| (&from.server, &from.node));
                let to = variable.to.as_deref().map(|to| (&to.server, &to.node));
                let here = [from, to].into_iter().flatten();
                let here = here.filter(|(name, _)| **name == server.name);
                nodes.extend(here.map(|(_, node)| node));
            }
            if nodes.is_empty() {
                continue;
            }
            let told = look(survey::opcua::remote(&server.access, &nodes));
            let whom = format!("OPC UA server {} ({})", server.access.endpoint, server.name);
            let told = self.asked(whom, told)?.unwrap_or_default();
            let told = nodes.into_iter().zip(told);
            let told = told.map(|(node, live)| ((server.name.clone(), node.to_string()), live));
            self.environment.remote.extend(told);
        }
        Ok(())
    }

    fn asked<T>(
        &mut self,
        whom: String,
        answer: Result<T, CommandFailure>,
    ) -> Result<Option<T>, CommandFailure> {
        let (there, why) = match answer {
            Ok(found) => (Some(found), None),
            Err(CommandFailure::Unavailable(why)) => (None, Some(why)),
            Err(other) => return Err(other),
        };
        self.asked.push(EnvironmentQuery {
            whom,
            there: there.is_some(),
            why,
        });
        Ok(there)
    }

    /// Returns true if all parts were available.
    pub(crate) fn is_whole(&self) -> bool {
        self.asked.iter().all(|asked| asked.there)
    }
}
