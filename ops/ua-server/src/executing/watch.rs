//! Watches a server with Methods: its connection, and the signatures of its Methods.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use mappings::TopicId;
use plant_opcua::client::{Link, OpcUaClient};
use tokio::sync::{mpsc, watch};
use tracing::warn;

use super::MappedMethod;
use super::signature::{self, Signature};

/// A Method that can be called.
pub(crate) struct CallableMethod {
    pub(super) wanted: Arc<MappedMethod>,
    pub(super) client: OpcUaClient,
    /// Number of the connection for which the NodeIds are valid.
    pub(super) connects: u64,
    pub(super) signature: Signature,
}

/// A change of a Method.
pub(super) enum News {
    /// The Method can be called, or it has changed.
    Found(CallableMethod),
    /// The Method cannot be called.
    Lost(TopicId),
}

/// Checks the server at each change of the connection or of the wanted Methods, and periodically.
pub(super) async fn run(
    client: OpcUaClient,
    url: String,
    mut wanted: watch::Receiver<Vec<Arc<MappedMethod>>>,
    tell: mpsc::Sender<News>,
) {
    let mut link = client.link();
    let mut watcher = Watcher {
        client,
        url,
        tell,
        known: HashMap::new(),
        troubles: HashMap::new(),
        away: false,
    };
    loop {
        let now = link.borrow_and_update().clone();
        let all = wanted.borrow_and_update().clone();
        let told = match now {
            Link::Up { connects, .. } => watcher.look(&all, connects).await,
            Link::Down { reason, .. } => watcher.lose(&all, &reason).await,
            Link::Connecting | Link::Closed => Ok(()),
        };
        if told.is_err() {
            // The receiver has stopped.
            return;
        }
        let again = tokio::time::timeout(LOOK_AGAIN, async {
            tokio::select! {
                changed = link.changed() => changed.is_ok(),
                changed = wanted.changed() => changed.is_ok(),
            }
        });
        if again.await == Ok(false) {
            return;
        }
    }
}

struct Watcher {
    client: OpcUaClient,
    url: String,
    tell: mpsc::Sender<News>,
    /// The last reported state of each Method, with its connection.
    known: HashMap<TopicId, (Arc<MappedMethod>, u64, Signature)>,
    /// The last logged error of each Method.
    troubles: HashMap<TopicId, String>,
    /// True if the loss of the server was logged.
    away: bool,
}

type Told = Result<(), mpsc::error::SendError<News>>;

impl Watcher {
    async fn look(&mut self, all: &[Arc<MappedMethod>], connects: u64) -> Told {
        self.away = false;
        self.known
            .retain(|topic, _| all.iter().any(|wanted| wanted.topic == *topic));
        for wanted in all {
            match signature::read(&self.client, &wanted.target).await {
                Ok(signature) => self.find(wanted, connects, signature).await?,
                Err(error) => self.miss(wanted.topic, &error.to_string()).await?,
            }
        }
        Ok(())
    }

    async fn find(
        &mut self,
        wanted: &Arc<MappedMethod>,
        connects: u64,
        signature: Signature,
    ) -> Told {
        let topic = wanted.topic;
        self.troubles.remove(&topic);
        let known = self.known.get(&topic);
        let is_known = known.is_some_and(|(of, at, known)| {
            Arc::ptr_eq(of, wanted) && *at == connects && *known == signature
        });
        if is_known {
            return Ok(());
        }
        let entry = (Arc::clone(wanted), connects, signature.clone());
        self.known.insert(topic, entry);
        let found = CallableMethod {
            wanted: Arc::clone(wanted),
            client: self.client.clone(),
            connects,
            signature,
        };
        self.tell.send(News::Found(found)).await
    }

    /// Reports all Methods as lost. The loss is logged once until the server is connected again.
    async fn lose(&mut self, all: &[Arc<MappedMethod>], reason: &str) -> Told {
        self.troubles.clear();
        if !std::mem::replace(&mut self.away, true) {
            let methods = all.len();
            warn!(
                url = self.url,
                methods, "cannot call the Methods of the server: {reason}"
            );
        }
        for (topic, _) in std::mem::take(&mut self.known) {
            self.tell.send(News::Lost(topic)).await?;
        }
        Ok(())
    }

    async fn miss(&mut self, topic: TopicId, reason: &str) -> Told {
        let before = self.troubles.insert(topic, reason.to_owned());
        if before.is_none_or(|before| before != reason) {
            warn!(%topic, url = self.url, "cannot call the Method: {reason}");
        }
        match self.known.remove(&topic) {
            Some(_) => self.tell.send(News::Lost(topic)).await,
            None => Ok(()),
        }
    }
}

/// Interval between two reads of the Methods of a server.
const LOOK_AGAIN: Duration = Duration::from_secs(30);
