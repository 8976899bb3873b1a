//! Supervises a server of a level: identifies it, configures its place and shows its nodes, until
//! it is lost.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::time::Duration;

use discovery::client::{FoundServer, find_servers};
use plant_opcua::changes::Became;
use plant_opcua::client::{
    CallError, ClientConfig, ClientError, ClientSubscription, Link, MonitoredWatch, Notice,
    OpcUaClient, Select,
};
use plant_opcua::types::{DateTime, ObjectId, ObjectTypeId, StatusCode};
use registry::hierarchy::PlantLocation;
use tokio::sync::watch;
use tokio::task::JoinHandle;
use tokio::time::sleep;
use tracing::{info, warn};

use crate::board::{BUSY, Board, CONNECTED, Level, REFUSED};
use crate::budget::NodeBudget;
use crate::callers::Callers;
use crate::configure::ConfigureArguments;
use crate::copy::{CopiedVariable, ServerCopy};
use crate::face::Face;
use crate::feed::{self, FeedTarget};
use crate::looks::StationSearches;
use crate::mirror::MirroredServer;

/// Data that the supervisors of all servers of a level share.
pub(crate) struct Tending {
    pub(crate) level: Level,
    pub(crate) board: Arc<Board>,
    /// The face on the other level; `None` without another level.
    pub(crate) face: Option<Face>,
    pub(crate) client: ClientConfig,
    /// The place of the station, for servers that are configured with their place.
    pub(crate) place: Option<watch::Receiver<Option<PlantLocation>>>,
    /// The discovery server of this level.
    pub(crate) discovery_url: String,
    /// The ApplicationUri of the station: its own servers are not supervised.
    pub(crate) own_uri: String,
    /// The URLs of the servers that registered here. Only these are configured with their place.
    pub(crate) registered: watch::Sender<BTreeSet<String>>,
    /// The nodes that the face shows of all servers.
    pub(crate) nodes: NodeBudget,
    /// The searches for the nodes of all servers.
    pub(crate) looks: StationSearches,
}

impl Tending {
    /// Supervises the server at a URL. Does not return while the server exists; a caller that
    /// aborts it must call [`leave`](Self::leave).
    pub(crate) async fn tend(self: Arc<Self>, url: String) {
        let Some(application) = self.ask(&url).await else {
            return;
        };
        let name = self.board.enter(self.level, &url, &application.name);
        self.board.note(self.level, &url, |peer| {
            peer.uri.clone_from(&application.application_uri);
            peer.state = "waiting";
        });
        let client = OpcUaClient::open(self.client.clone(), &url);
        let callers = Arc::new(Callers::new(client.clone()));
        if let Some(face) = &self.face {
            face.follow(&callers);
        }
        let mut link = client.link();
        let mut place = self.place.clone();
        let mut copy = self.face.as_ref().map(|face| {
            let identity = (name.as_str(), application.application_uri.as_str());
            ServerCopy::new(face, identity, &callers)
        });
        loop {
            let now = link.borrow_and_update().clone();
            match now {
                Link::Up {
                    application_uri,
                    secured,
                    ..
                } => {
                    if application_uri == application.application_uri {
                        let of = Connected {
                            client: &client,
                            callers: &callers,
                            secured,
                            url: &url,
                            name: &name,
                            told: tokio::sync::Mutex::default(),
                        };
                        self.connected(&of, &mut copy, &mut place, &mut link).await;
                        if let Some(copy) = &copy {
                            copy.lose(StatusCode::BadNoCommunication);
                        }
                        continue;
                    }
                    let fault = format!(
                        "its ApplicationUri is {application_uri}, but another was announced"
                    );
                    self.fault(&url, REFUSED, fault);
                }
                Link::Down {
                    reason,
                    certificate,
                } => {
                    let refused = client.certificates_refused();
                    self.board.note(self.level, &url, |peer| {
                        peer.certificates_refused = refused;
                    });
                    let state = certificate.map_or("away", |_| REFUSED);
                    self.fault(&url, state, reason);
                }
                Link::Connecting => {}
                Link::Closed => return,
            }
            if link.changed().await.is_err() {
                return;
            }
        }
    }

    /// Removes the server.
    pub(crate) fn leave(&self, url: &str) {
        self.nodes.release(url);
        if let Some(name) = self.board.leave(self.level, url)
            && let Some(face) = &self.face
        {
            face.remove(&name);
        }
    }

    /// Identifies the application at a URL; `None` for discovery servers and for the station
    /// itself.
    async fn ask(&self, url: &str) -> Option<FoundServer> {
        let mut wait = FIRST_WAIT;
        loop {
            if let Ok(found) = find_servers(url, ASK_LIMIT).await {
                let port = |url: &str| {
                    url.trim_end_matches('/')
                        .rsplit(':')
                        .next()
                        .map(str::to_owned)
                };
                let here = |one: &&FoundServer| {
                    let mut urls = one.discovery_urls.iter();
                    urls.any(|its| port(its) == port(url))
                };
                let application = found.iter().find(here).or_else(|| found.first()).cloned()?;
                let ours = application.application_uri == self.own_uri;
                return (!application.is_discovery_server && !ours).then_some(application);
            }
            sleep(wait).await;
            wait = (wait * 2).min(MOST_WAIT);
        }
    }

    /// Supervises a server for the lifetime of a connection.
    async fn connected(
        &self,
        of: &Connected<'_>,
        copy: &mut Option<ServerCopy>,
        place: &mut Option<watch::Receiver<Option<PlantLocation>>>,
        link: &mut watch::Receiver<Link>,
    ) {
        let mut known = None;
        let mut feeds = Feeds::default();
        let mut searched = self.looks.enter();
        let mut changes = of.client.subscribe(vec![model_changes()], TOLD_EVERY, 10);
        loop {
            // The run before the search: its NodeIds are not valid for a later run.
            let run = of.client.started();
            // A server that executes a method may not respond to other requests.
            if known.is_none() || !of.client.is_calling() {
                let Some(looked) = searched.look(of.client, link).await else {
                    feeds.stop().await;
                    return;
                };
                match looked.map(|looked| self.within_budget(of.url, looked)) {
                    Ok(looked) if known.as_ref() != Some(&looked) => {
                        self.show((of, run), &looked, copy.as_mut(), &mut feeds)
                            .await;
                        known = Some(looked);
                    }
                    Ok(_) => self.answers_again(of, copy.as_ref()),
                    Err(_) if of.client.is_calling() => {}
                    Err(ClientError::Lost(_)) if known.is_some() => {
                        if let Some(copy) = &copy {
                            copy.doubt();
                        }
                        self.fault(of.url, BUSY, ANSWERS_NOTHING.to_owned());
                    }
                    Err(error) => self.fault(of.url, "waiting", error.to_string()),
                }
            }
            // Configuring a server may change its nodes: it is not configured again for that
            // change.
            let is_told = match (&*place, &known) {
                (
                    Some(place),
                    Some(MirroredServer {
                        configure: Some(_), ..
                    }),
                ) => {
                    let station = place.borrow().clone();
                    let is_registered = self.registered.borrow().contains(of.url);
                    !is_registered || station.is_none() || *of.told.lock().await == station
                }
                _ => true,
            };
            let told = async {
                match (&mut *place, &known) {
                    (Some(place), Some(mirror)) => self.keep_told(of, mirror, place).await,
                    _ => std::future::pending().await,
                }
            };
            tokio::select! {
                changed = link.changed() => {
                    drop(changed);
                    feeds.stop().await;
                    return;
                }
                () = told => {}
                // The nodes of a server may change, for example when a device of another station
                // appears or disappears.
                () = changed(&mut changes), if is_told => {}
                // Not every server notifies model changes.
                () = sleep(searched.pause()) => {}
            }
        }
    }

    /// Keeps the nodes of a server that the face can show beside the nodes of other servers.
    fn within_budget(&self, url: &str, mut mirror: MirroredServer) -> MirroredServer {
        let wanted = mirror.nodes.len();
        let granted = self.nodes.grant(url, wanted);
        mirror.keep(granted);
        mirror
    }

    /// Shows the nodes of a server, and repeats its values and events.
    async fn show(
        &self,
        (of, run): (&Connected<'_>, Option<DateTime>),
        looked: &MirroredServer,
        copy: Option<&mut ServerCopy>,
        feeds: &mut Feeds,
    ) {
        let shown = copy.map(|copy| (copy.show(looked), copy));
        // The nodes of an earlier run are replaced: no call reaches this run by their NodeIds.
        of.callers.serve(run);
        match shown {
            Some((Ok((added, changed)), copy)) => {
                // A busy server may respond again with other nodes.
                copy.trust_again();
                let target = FeedTarget {
                    face: copy.face().server.clone(),
                    translation: copy.translation(),
                    root: copy.root(),
                    name: of.name.to_owned(),
                };
                target.read(of.client, &added).await;
                self.feed(of, looked, (copy, added, target), feeds);
                if changed {
                    copy.face().tell(&copy.root(), Became::Added);
                }
            }
            Some((Err(error), _)) => warn!(name = of.name, %error, "cannot show a server"),
            None => {}
        }
        let (methods, variables) = (looked.methods(), looked.variables());
        self.board.note(self.level, of.url, |peer| {
            peer.state = CONNECTED;
            peer.secured = of.secured;
            peer.fault = None;
            peer.methods = methods;
            peer.variables = variables;
            peer.methods_kept_back = looked.methods_kept_back;
            peer.variables_kept_back = looked.variables_kept_back;
        });
        let (methods_kept_back, variables_kept_back) =
            (looked.methods_kept_back, looked.variables_kept_back);
        info!(
            name = of.name,
            url = of.url,
            methods,
            variables,
            methods_kept_back,
            variables_kept_back,
            "showing the methods and values of a server"
        );
    }

    /// Starts to repeat the values that were added and, once for a connection, the events.
    fn feed(
        &self,
        of: &Connected<'_>,
        looked: &MirroredServer,
        (copy, added, target): (&ServerCopy, Vec<CopiedVariable>, FeedTarget),
        feeds: &mut Feeds,
    ) {
        let lost = || {
            let (board, level, url) = (Arc::clone(&self.board), self.level, of.url.to_owned());
            move |lost: u64| {
                board.note(level, &url, |peer| {
                    peer.notifications_lost = peer.notifications_lost.saturating_add(lost);
                });
            }
        };
        if feeds.events_of.as_ref() != Some(&looked.event_fields) {
            let (client, fields) = (of.client.clone(), looked.event_fields.clone());
            let events = feed::events(client, fields.clone(), target.clone(), lost());
            feeds.events = Some(FeedTask::spawn(events));
            feeds.events_of = Some(fields);
        }
        // After a reconnect all variables are requested; of a changed server only the new ones.
        let is_first = feeds.values.is_empty();
        let variables = match is_first || feeds.values.len() >= MOST_FEEDS {
            true => copy.variables(),
            false => added,
        };
        if variables.is_empty() {
            return;
        }
        if feeds.values.len() >= MOST_FEEDS {
            feeds.values.clear();
        }
        let values = feed::values(of.client.clone(), variables, target, lost());
        feeds.values.push(FeedTask::spawn(values));
    }

    /// Records that a busy server responds again.
    fn answers_again(&self, of: &Connected<'_>, copy: Option<&ServerCopy>) {
        let mut was_busy = false;
        self.board.note(self.level, of.url, |peer| {
            if peer.state == BUSY {
                info!(name = peer.name, url = of.url, "the server responds again");
                peer.state = CONNECTED;
                peer.fault = None;
                was_busy = true;
            }
        });
        if let Some(copy) = copy.filter(|_| was_busy) {
            copy.trust_again();
        }
    }

    /// Configures the place of the server until that succeeds, then waits for another place.
    /// Servers that did not register here belong to another supervisor.
    async fn keep_told(
        &self,
        of: &Connected<'_>,
        mirror: &MirroredServer,
        place: &mut watch::Receiver<Option<PlantLocation>>,
    ) {
        let mut registered = self.registered.subscribe();
        let is_gone = {
            let is_registered = registered.wait_for(|urls| urls.contains(of.url));
            is_registered.await.is_err()
        };
        if is_gone {
            std::future::pending::<()>().await;
        }
        let station = place.borrow().clone();
        let told = of.told.lock().await.clone();
        if let Some(station) = station.filter(|station| told.as_ref() != Some(station)) {
            let mut wait = FIRST_WAIT;
            while !self.configure(of, mirror, &station).await {
                sleep(wait).await;
                wait = (wait * 2).min(MOST_WAIT);
            }
            *of.told.lock().await = Some(station);
        }
        if place.changed().await.is_err() {
            std::future::pending::<()>().await;
        }
    }

    /// Calls `Configure` of the server. Returns whether there is nothing left to do.
    async fn configure(
        &self,
        of: &Connected<'_>,
        mirror: &MirroredServer,
        station: &PlantLocation,
    ) -> bool {
        let Some((object, method)) = &mirror.configure else {
            return true;
        };
        let place = match station.of(of.name) {
            Ok(place) => place.to_string(),
            Err(fault) => {
                self.note_fault(of, fault.to_string());
                return true;
            }
        };
        let told = ConfigureArguments {
            place: place.clone(),
            supervisor_uri: self.own_uri.clone(),
            discovery_url: self.discovery_url.clone(),
        };
        match of.client.call(object, method, told.arguments()).await {
            Ok(_) => {
                info!(name = of.name, place, secured = of.secured, "configured");
                self.board.note(self.level, of.url, |peer| {
                    peer.place = Some(place);
                    peer.fault = None;
                });
                true
            }
            Err(error @ CallError::Refused { .. }) => {
                self.note_fault(of, format!("cannot configure it: {error}"));
                false
            }
            // The connection is lost: the server is configured after the reconnection.
            Err(error @ CallError::Client(_)) => {
                self.note_fault(of, format!("cannot configure it: {error}"));
                false
            }
        }
    }

    fn note_fault(&self, of: &Connected<'_>, fault: String) {
        self.fault(of.url, CONNECTED, fault);
    }

    /// Logs each reason only once.
    fn fault(&self, url: &str, state: &'static str, fault: String) {
        self.board.note(self.level, url, |peer| {
            if peer.fault.as_ref() != Some(&fault) {
                warn!(name = peer.name, url, "{fault}");
            }
            peer.state = state;
            peer.fault = Some(fault);
        });
    }
}

/// Returns a subscription to model changes of a server.
fn model_changes() -> MonitoredWatch {
    MonitoredWatch::Events {
        node: ObjectId::Server.into(),
        select: vec![Select::new(ObjectTypeId::BaseEventType, "EventType")],
        of_type: Some(ObjectTypeId::BaseModelChangeEventType.into()),
    }
}

/// Completes when the server reports a model change.
async fn changed(changes: &mut ClientSubscription) {
    loop {
        match changes.next().await {
            Some(Notice::Event { .. }) => return,
            Some(Notice::Subscribed | Notice::Value { .. } | Notice::Refused { .. }) => {}
            None => std::future::pending().await,
        }
    }
}

/// A connection to the server with the registered identity.
struct Connected<'a> {
    client: &'a OpcUaClient,
    callers: &'a Arc<Callers>,
    secured: bool,
    url: &'a str,
    name: &'a str,
    /// The place of the station with which the server was last configured.
    told: tokio::sync::Mutex<Option<PlantLocation>>,
}

/// The tasks that repeat the values and events of a server for the lifetime of a connection.
#[derive(Default)]
struct Feeds {
    events: Option<FeedTask>,
    /// The declared fields that the events are requested with.
    events_of: Option<Vec<Select>>,
    values: Vec<FeedTask>,
}

impl Feeds {
    /// Ends the tasks. None of them shows a value afterwards.
    async fn stop(&mut self) {
        for task in self.values.drain(..).chain(self.events.take()) {
            task.stop().await;
        }
    }
}

/// A task that ends with its owner.
struct FeedTask(JoinHandle<()>);

impl FeedTask {
    fn spawn(task: impl Future<Output = ()> + Send + 'static) -> Self {
        Self(tokio::spawn(task))
    }

    async fn stop(mut self) {
        self.0.abort();
        // The error of a cancelled task.
        let _cancelled = (&mut self.0).await;
    }
}

impl Drop for FeedTask {
    fn drop(&mut self) {
        self.0.abort();
    }
}

/// The fault of a server that is probably executing a method.
const ANSWERS_NOTHING: &str =
    "it does not respond, but its host is reachable: it may be executing a method";
const ASK_LIMIT: Duration = Duration::from_secs(2);
/// Publishing interval of the subscription to model changes.
const TOLD_EVERY: Duration = Duration::from_millis(50);
/// Number of subscriptions at a server that grows, before they become one again.
const MOST_FEEDS: usize = 16;
const FIRST_WAIT: Duration = Duration::from_millis(250);
const MOST_WAIT: Duration = Duration::from_secs(30);
