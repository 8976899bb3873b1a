//! Client of the skills of other components: finds skills by their types and runs them.
//!
//! Reading order:
//!
//! - this module
//! - `packed`: structures that hold numbers
//! - `find`: the skills of a server
//! - `grip`: the grip point of a skill
//! - `handle`: a skill of a server
//! - `fields`: the configured fields of a component
//! - `states`: the states of the skills of a server
//! - `stations`: the components behind a station
//! - `mirror`: the skills of a server, presented like local skills
//! - `detector`: the skills of all servers
//! - `peers`: how the skills of a component reach other components
//! - `choice`: the robot, the tool and the object of a pick and place
//! - `remote`: a composite of the skills of several servers

mod choice;
#[cfg(test)]
mod choice_tests;
mod detector;
mod fields;
mod find;
mod found;
mod grip;
mod handle;
mod mirror;
pub(crate) mod packed;
mod peers;
mod remote;
#[cfg(test)]
mod secured_tests;
mod states;
mod stations;

use std::path::PathBuf;
use std::time::Duration;

use plant_opcua::client::{
    CallError, ClientConfig, ClientError, ClientUser, Link, OpcUaClient, SecurityChoice,
};
use plant_opcua::types::StatusCode;

pub use choice::{Chosen, Needs, plate_between};
pub use detector::{Detected, Detector};
pub use fields::{ConfigurationHandle, FoundConfiguration, SetFieldsFault};
pub use found::{FoundParameter, FoundSkill, FoundType};
pub use handle::{RemoteState, SkillHandle};
pub use mirror::{MirroredSkill, Mirrors, StartCondition, Watchable};
pub use peers::PeerAccess;
pub use remote::Remote;
pub use states::SkillStates;
pub use stations::StationChanges;

use crate::parameters::ParameterType;
pub use crate::partner_error::{
    AttachedElsewhere, FailedLocator, LocatorError, NotLocated, PartnerError, Unchosen, UnfitGrasp,
};
use crate::skill_fault::SkillFault;

/// Identity and settings of a client.
#[derive(Debug, Clone)]
pub struct ClientOptions {
    /// The ApplicationUri of the client.
    pub application_uri: String,
    /// The ApplicationName of the client.
    pub application_name: String,
    /// The directory of certificates; without it, connections are not secured.
    pub pki: Option<PathBuf>,
    /// The user; `None` for anonymous.
    pub user: Option<ClientUser>,
    /// The required security of an endpoint.
    pub security: SecurityChoice,
    /// Time limit for a response of the server.
    pub within: Duration,
}

impl Default for ClientOptions {
    fn default() -> Self {
        Self {
            application_uri: "urn:ua-bridge:skills:client".to_owned(),
            application_name: "skills client".to_owned(),
            pki: None,
            user: None,
            security: SecurityChoice::Best,
            within: Duration::from_secs(2),
        }
    }
}

/// A connection to one server. It reconnects by itself. Clones share the connection.
///
/// The first write or call of a session acquires the lease of the component until that session
/// closes. Reading does not acquire the lease. Use separate connections for observing and for
/// running skills, and close the connection that runs skills when it is done.
#[derive(Clone)]
pub struct SkillClient {
    client: OpcUaClient,
    endpoint: String,
    /// The ApplicationUri of the component behind a station to which the client is restricted.
    behind: Option<String>,
}

impl SkillClient {
    /// Connects to the server at `endpoint`. An endpoint that ends with `#` and an ApplicationUri
    /// is that of a component behind a station: the client sees only the skills of this component.
    ///
    /// # Errors
    /// - [`SkillFault::Refused`] if the certificate of the server is not accepted
    /// - [`SkillFault::Lost`] if the connection is not established in time
    pub async fn connect(endpoint: &str, options: &ClientOptions) -> Result<Self, SkillFault> {
        let config = ClientConfig {
            pki: options.pki.clone(),
            user: options.user.clone(),
            security: options.security,
            timeout: options.within,
            ..ClientConfig::new(&options.application_uri, &options.application_name)
        };
        let (url, behind) = match endpoint.split_once(stations::BEHIND) {
            Some((url, uri)) => (url, Some(uri.to_owned())),
            None => (endpoint, None),
        };
        let client = OpcUaClient::open(config, url);
        connected(&client, options).await?;
        Ok(Self {
            client,
            endpoint: endpoint.to_owned(),
            behind,
        })
    }

    /// Uses an existing client and shares its connection. Dropping the result keeps the connection
    /// open; [`close`](Self::close) closes it for all clones.
    #[must_use]
    pub fn over(client: &OpcUaClient, endpoint: &str) -> Self {
        Self {
            client: client.clone(),
            endpoint: endpoint.to_owned(),
            behind: None,
        }
    }

    /// Returns the URL of the endpoint.
    #[must_use]
    pub fn endpoint(&self) -> &str {
        &self.endpoint
    }

    /// Returns the ApplicationUri of the server, or of the component behind it to which the client
    /// is restricted; empty while disconnected.
    #[must_use]
    pub fn application_uri(&self) -> String {
        if let Some(behind) = &self.behind {
            return behind.clone();
        }
        match &*self.client.link().borrow() {
            Link::Up {
                application_uri, ..
            } => application_uri.clone(),
            Link::Connecting | Link::Down { .. } | Link::Closed => String::new(),
        }
    }

    /// Returns all skills of the server: instances of SkillType and its subtypes, in any namespace.
    ///
    /// A server without SkillType has no skills.
    ///
    /// # Errors
    /// No response.
    pub async fn skills(&self) -> Result<Vec<FoundSkill>, SkillFault> {
        self.skills_of(&ParameterType::own(crate::model::SKILL_TYPE))
            .await
    }

    /// Returns all skills of the server, and the configurations that can be set, also of components
    /// without skills.
    ///
    /// # Errors
    /// No response.
    pub async fn skills_and_configurations(
        &self,
    ) -> Result<(Vec<FoundSkill>, Vec<FoundConfiguration>), SkillFault> {
        let (skills, mut configurations) = find::skills_and_configurations(&self.client).await?;
        if self.behind.is_some() {
            configurations.retain(|found| found.behind == self.behind);
        }
        Ok((self.of_component(skills), configurations))
    }

    /// Returns all Programs of the server, including Programs that are not skills.
    ///
    /// # Errors
    /// No response.
    pub async fn programs(&self) -> Result<Vec<FoundSkill>, SkillFault> {
        let found = find::all_programs(&self.client).await?;
        Ok(self.of_component(found))
    }

    fn of_component(&self, mut found: Vec<FoundSkill>) -> Vec<FoundSkill> {
        if self.behind.is_some() {
            found.retain(|skill| skill.behind == self.behind);
        }
        found
    }

    /// Returns the skills of a type and its subtypes. A type of the earlier system
    /// ([`alias`](crate::model::alias)) and its equivalent in this crate match each other.
    ///
    /// A server without the type has no such skills.
    ///
    /// # Errors
    /// No response.
    pub async fn skills_of(&self, wanted: &ParameterType) -> Result<Vec<FoundSkill>, SkillFault> {
        let found = find::skills(&self.client, wanted).await?;
        Ok(self.of_component(found))
    }

    /// Waits for changes of a station: the skills behind it come and go. `None` for other servers.
    ///
    /// # Errors
    /// No response.
    pub async fn station_changes(&self) -> Result<Option<StationChanges>, SkillFault> {
        StationChanges::of(&self.client).await
    }

    /// Returns a handle to run a skill.
    #[must_use]
    pub fn handle(&self, found: &FoundSkill) -> SkillHandle {
        SkillHandle::new(self.client.clone(), found.clone())
    }

    /// Completes when the connection is lost, with the reason.
    pub async fn lost(&self) -> String {
        let mut link = self.client.link();
        let down = link
            .wait_for(|link| matches!(link, Link::Down { .. } | Link::Closed))
            .await;
        match down.as_deref() {
            Ok(Link::Down { reason, .. }) => reason.clone(),
            Ok(_) | Err(_) => "the connection is closed".to_owned(),
        }
    }

    /// Closes the session, which releases the lease.
    pub async fn close(&self) {
        self.client.close().await;
    }
}

/// Waits for the first connection. A refused certificate is reported at once, because it stays
/// refused until an operator trusts it.
async fn connected(client: &OpcUaClient, options: &ClientOptions) -> Result<(), SkillFault> {
    let mut link = client.link();
    let refused = async {
        while let Ok(()) = link.changed().await {
            let now = link.borrow_and_update().clone();
            if let Link::Down {
                reason,
                certificate: Some(status),
            } = now
            {
                return (reason, status);
            }
        }
        std::future::pending().await
    };
    tokio::select! {
        up = client.up(options.within) => up.map_err(|error| not_connected(&error, options)),
        (reason, status) = refused => Err(self::refused(status, &reason)),
    }
}

/// Adds the next step of the operator if the server refuses this client.
fn not_connected(error: &ClientError, options: &ClientOptions) -> SkillFault {
    let text = error.to_string();
    let refuses_user = ["BadIdentityToken", "BadUserAccessDenied"];
    let hint = if text.contains("BadSecurityChecksFailed") {
        format!(
            "; the server has to trust the certificate of {}",
            options.application_uri
        )
    } else if refuses_user.iter().any(|status| text.contains(status)) {
        let user = options.user.as_ref().map_or("anonymous", |user| &user.name);
        format!("; the server does not admit the user {user}")
    } else {
        return lost(error);
    };
    SkillFault::Lost(text + &hint)
}

fn lost(error: &ClientError) -> SkillFault {
    if let ClientError::Status(status) = error {
        return refused(*status, "the server refuses");
    }
    SkillFault::Lost(error.to_string())
}

fn called(error: &CallError, what: &str) -> SkillFault {
    match error {
        // A station sent the call on, or the server gave it up: it is unknown whether it was
        // executed.
        CallError::Refused {
            status: status @ (StatusCode::BadRequestInterrupted | StatusCode::BadTimeout),
            ..
        } => SkillFault::Lost(format!("{what}: {status}")),
        CallError::Refused { status, .. } => refused(*status, what),
        CallError::Client(error) => lost(error),
    }
}

fn refused(status: StatusCode, what: &str) -> SkillFault {
    SkillFault::Refused {
        status: status.to_string(),
        text: what.to_owned(),
    }
}

#[cfg(test)]
mod tests;
