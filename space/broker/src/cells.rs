//! The cells that share a broker, each with a prefix of its own.

use std::net::SocketAddr;
use std::sync::Arc;

use mappings::Broker;
use tokio::sync::mpsc;
use uadp::discovery::ConnectionState;
use uadp::{NetworkMessage, Timestamp};

use crate::address;
use crate::carrier::utc;
use crate::connection::{BrokerLink, ConnectionShared, run};
use crate::packets::ReceivedPublish;
use crate::producers::time_left;
use crate::settings::{BrokerIdentity, BrokerSettings, OpenError};
use crate::topics::{self, TopicFilter};

/// Receives the status of each publisher of several cells.
#[derive(Debug)]
pub struct CellWatch {
    shared: Arc<ConnectionShared>,
    received: mpsc::Receiver<(ReceivedPublish, SocketAddr)>,
}

/// The status of a publisher.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CellStatus {
    /// Prefix of the topics of the cell.
    pub cell: String,
    /// PublisherId.
    pub publisher: u16,
    /// The reported state.
    pub state: ConnectionState,
    /// Whether the next status is overdue: the publisher has ended without a report.
    pub is_overdue: bool,
}

impl CellWatch {
    /// Starts to connect with the broker. `+` stands for any level of the prefixes, such as
    /// `plant/+`. Only the status messages are subscribed.
    ///
    /// Must be called within a tokio runtime.
    ///
    /// # Errors
    /// An [`OpenError`] if a file with certificates or the log-in cannot be used.
    pub fn open(broker: &Broker, prefixes: &str) -> Result<Self, OpenError> {
        let identity = BrokerIdentity {
            program: "ua-space".to_owned(),
            publisher: None,
        };
        let mut settings = BrokerSettings::read(broker, &identity)?;
        settings.filters = vec![TopicFilter {
            name: format!("{prefixes}{STATUS}+"),
            confirmed: false,
        }];
        let shared = Arc::new(ConnectionShared::default());
        let (out, received) = mpsc::channel(MAX_RECEIVED);
        // The task ends when the watch is dropped.
        let task = run(Arc::new(settings), Arc::clone(&shared), out);
        drop(tokio::spawn(task));
        Ok(Self { shared, received })
    }

    /// Waits for the next status. Returns `None` if the connection is closed. Cancel-safe.
    pub async fn next(&mut self) -> Option<CellStatus> {
        loop {
            let (message, _) = self.received.recv().await?;
            if let Some(status) = read(&message, utc()) {
                return Some(status);
            }
        }
    }

    /// Returns the reason why nothing is received.
    #[must_use]
    pub fn lost(&self) -> Option<String> {
        match &self.shared.state().link {
            BrokerLink::Connected { .. } => None,
            BrokerLink::Waiting(why) => Some(why.clone()),
        }
    }

    /// Returns the number of messages that were dropped because the caller is too slow.
    #[must_use]
    pub fn overflow(&self) -> u64 {
        self.shared.state().overflow
    }
}

impl Drop for CellWatch {
    fn drop(&mut self) {
        self.shared.close();
    }
}

/// Reads a status; `None` for another message.
fn read(message: &ReceivedPublish, now: Timestamp) -> Option<CellStatus> {
    let (cell, publisher) = message.topic.rsplit_once(STATUS)?;
    let publisher = topics::number(publisher)?;
    let network = NetworkMessage::decode(&message.payload).ok()?;
    if address::publisher(&network) != Some(publisher) {
        return None;
    }
    let (state, cyclic) = address::status(&network)?;
    let left = cyclic.map(|cyclic| time_left(cyclic.next_report_time, now));
    Some(CellStatus {
        cell: cell.to_owned(),
        publisher,
        state,
        is_overdue: state == ConnectionState::OPERATIONAL && left == Some(None),
    })
}

/// The levels of a status between the prefix and the PublisherId. Every program sends its status as
/// UADP, also beside JSON.
const STATUS: &str = "/uadp/status/";
/// The most messages that wait for the caller.
const MAX_RECEIVED: usize = 4096;

#[cfg(test)]
mod tests {
    use crate::reports::BrokerReports;

    use super::*;

    fn message(topic: &str) -> ReceivedPublish {
        ReceivedPublish {
            topic: topic.to_owned(),
            payload: BrokerReports::default().failed(1).unwrap(),
            retained: true,
        }
    }

    #[test]
    fn a_status_names_its_cell() {
        let status = read(&message("plant/cell-4/uadp/status/1"), utc()).unwrap();
        assert_eq!(status.cell, "plant/cell-4");
        assert_eq!(status.publisher, 1);
        assert_eq!(status.state, ConnectionState::ERROR);
        assert!(!status.is_overdue);
    }

    #[test]
    fn a_status_at_the_topic_of_another_publisher_is_ignored() {
        for topic in [
            "plant/cell-4/uadp/status/2",
            "plant/cell-4/uadp/status/x",
            "plant/cell-4/uadp/data/1",
        ] {
            assert_eq!(read(&message(topic), utc()), None, "{topic}");
        }
    }
}
