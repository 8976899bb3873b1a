//! The life of one server with Methods: whether it is there, and what they take and give.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use mappings::TopicId;
use plant_opcua::client::{Client, Link};
use tokio::sync::{mpsc, watch};
use tracing::warn;

use super::Wanted;
use super::signature::{self, Signature};

/// A Method that can be called.
pub(crate) struct Found {
    pub(super) wanted: Arc<Wanted>,
    pub(super) client: Client,
    /// The connection that its NodeIds are of.
    pub(super) connects: u64,
    pub(super) signature: Signature,
}

/// What is new of a Method.
pub(super) enum News {
    /// It can be called, or is another one.
    Found(Found),
    /// It cannot be called.
    Lost(TopicId),
}

/// Looks at the server whenever there is another connection or something else is wanted, and from time to time.
pub(super) async fn run(
    client: Client,
    url: String,
    mut wanted: watch::Receiver<Vec<Arc<Wanted>>>,
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
            // Nobody executes any longer.
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
    client: Client,
    url: String,
    tell: mpsc::Sender<News>,
    /// What was told of each Method, by its connection.
    known: HashMap<TopicId, (Arc<Wanted>, u64, Signature)>,
    /// What was said for people.
    troubles: HashMap<TopicId, String>,
    /// Whether it was said that the server is not there.
    away: bool,
}

type Told = Result<(), mpsc::error::SendError<News>>;

impl Watcher {
    async fn look(&mut self, all: &[Arc<Wanted>], connects: u64) -> Told {
        self.away = false;
        self.known
            .retain(|topic, _| all.iter().any(|wanted| wanted.topic == *topic));
        for wanted in all {
            match signature::read(&self.client, &wanted.target).await {
                Ok(signature) => self.find(wanted, connects, signature).await?,
                Err(reason) => self.miss(wanted.topic, &reason).await?,
            }
        }
        Ok(())
    }

    async fn find(&mut self, wanted: &Arc<Wanted>, connects: u64, signature: Signature) -> Told {
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
        let found = Found {
            wanted: Arc::clone(wanted),
            client: self.client.clone(),
            connects,
            signature,
        };
        self.tell.send(News::Found(found)).await
    }

    /// None of its Methods can be called, which is told once until they can.
    async fn lose(&mut self, all: &[Arc<Wanted>], reason: &str) -> Told {
        self.troubles.clear();
        if !std::mem::replace(&mut self.away, true) {
            let methods = all.len();
            warn!(
                url = self.url,
                methods, "no Method of the server can be called: {reason}"
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
            warn!(%topic, url = self.url, "its Method cannot be called: {reason}");
        }
        match self.known.remove(&topic) {
            Some(_) => self.tell.send(News::Lost(topic)).await,
            None => Ok(()),
        }
    }
}

/// How often a server is asked for its Methods anew.
const LOOK_AGAIN: Duration = Duration::from_secs(30);
