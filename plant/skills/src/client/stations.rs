//! The components behind a station, which shows their skills as its own.

use std::time::Duration;

use plant_opcua::client::{ClientSubscription, MonitoredWatch, Notice, OpcUaClient, Select};
use plant_opcua::types::{NodeId, ObjectId, ObjectTypeId, QualifiedName};

use super::found::FoundSkill;
use super::lost;
use crate::skill_fault::SkillFault;

/// Reports that the components behind a station have changed.
pub struct StationChanges {
    events: ClientSubscription,
}

impl std::fmt::Debug for StationChanges {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("StationChanges").finish_non_exhaustive()
    }
}

impl StationChanges {
    /// Subscribes to the changes of a station; `None` for other servers. Changes after the return
    /// are reported.
    pub(super) async fn of(client: &OpcUaClient) -> Result<Option<Self>, SkillFault> {
        let objects: NodeId = ObjectId::ObjectsFolder.into();
        let mut is_station = false;
        for folder in STATION_FOLDERS {
            let path = [QualifiedName::new(1, folder)];
            is_station |= client.translate(&objects, &path).await.is_ok();
        }
        if !is_station {
            return Ok(None);
        }
        let watch = MonitoredWatch::Events {
            node: ObjectId::Server.into(),
            select: vec![Select::new(ObjectTypeId::BaseEventType, "EventType")],
            of_type: Some(ObjectTypeId::BaseModelChangeEventType.into()),
        };
        let mut events = client.subscribe(vec![watch], PUBLISHING, MOST_EVENTS);
        // Without the subscription no change would be reported.
        let made = tokio::time::timeout(MADE_WITHIN, events.next()).await;
        match made {
            Ok(Some(Notice::Subscribed)) => Ok(Some(Self { events })),
            Ok(_) | Err(_) => {
                let why = "the station does not report its changes".to_owned();
                Err(lost(&plant_opcua::client::ClientError::Lost(why)))
            }
        }
    }

    /// Completes after a change. Changes that follow each other closely are one.
    pub async fn next(&mut self) {
        loop {
            match self.events.next().await {
                Some(Notice::Event { .. }) => break,
                Some(Notice::Subscribed | Notice::Value { .. } | Notice::Refused { .. }) => {}
                None => return std::future::pending().await,
            }
        }
        tokio::time::sleep(SETTLED).await;
    }
}

impl FoundSkill {
    /// Returns the endpoint of the component of a skill that was found at a server.
    #[must_use]
    pub fn endpoint(&self, server: &str) -> String {
        match &self.behind {
            Some(uri) => format!("{server}{BEHIND}{uri}"),
            None => server.to_owned(),
        }
    }
}

/// The folders in which a station shows the servers of the other level.
pub(super) const STATION_FOLDERS: [&str; 2] = ["Devices", "Neighbours"];
/// Separates the URL of a station from the ApplicationUri of a component behind it.
pub(super) const BEHIND: char = '#';
const PUBLISHING: Duration = Duration::from_millis(50);
const MADE_WITHIN: Duration = Duration::from_secs(5);
/// Time in which further changes of a station are awaited.
const SETTLED: Duration = Duration::from_millis(50);
/// Maximum number of waiting events. A lost event is one of many that all mean the same.
const MOST_EVENTS: usize = 16;
