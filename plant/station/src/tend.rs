//! One server of a level: who it is, its place told to it, its methods shown, for as long as it is there.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::time::Duration;

use discovery::client::{Application, find_servers};
use plant_opcua::client::{
    CallError, Client, ClientConfig, ClientError, Link, Notice, Select, Subscription, Watch,
};
use plant_opcua::types::{ObjectId, ObjectTypeId};
use registry::hierarchy::Place;
use tokio::sync::watch;
use tokio::time::sleep;
use tracing::{info, warn};

use crate::board::{BUSY, Board, CONNECTED, Level};
use crate::callers::Callers;
use crate::configure::Told;
use crate::face::{Face, Shown};
use crate::mirror::{self, Mirror};

/// What all who tend servers of one level share.
pub(crate) struct Tending {
    pub(crate) level: Level,
    pub(crate) board: Arc<Board>,
    /// On the other level; `None` where there is none.
    pub(crate) face: Option<Face>,
    pub(crate) client: ClientConfig,
    /// The place of the station, for servers that are to be told theirs.
    pub(crate) place: Option<watch::Receiver<Option<Place>>>,
    /// The discovery server of this level.
    pub(crate) discovery_url: String,
    /// Us: our own servers are not tended.
    pub(crate) own_uri: String,
    /// The URLs of the servers that registered here. Only these are told their place.
    pub(crate) registered: watch::Sender<BTreeSet<String>>,
}

impl Tending {
    /// Tends the server at a URL. Never ends while it is there; whoever aborts it calls [`leave`](Self::leave).
    pub(crate) async fn tend(self: Arc<Self>, url: String) {
        let Some(application) = self.ask(&url).await else {
            return;
        };
        let name = self.board.enter(self.level, &url, &application.name);
        self.board.note(self.level, &url, |peer| {
            peer.uri.clone_from(&application.application_uri);
            peer.state = "waiting";
        });
        let client = Client::open(self.client.clone(), &url);
        let callers = Arc::new(Callers::new(client.clone()));
        if let Some(face) = &self.face {
            face.follow(&callers);
        }
        let mut link = client.link();
        let mut place = self.place.clone();
        loop {
            let now = link.borrow_and_update().clone();
            match now {
                Link::Up {
                    connects,
                    application_uri,
                    secured,
                    ..
                } => {
                    if application_uri == application.application_uri {
                        let of = Connected {
                            client: &client,
                            callers: &callers,
                            connects,
                            secured,
                            url: &url,
                            name: &name,
                            uri: &application_uri,
                            told: tokio::sync::Mutex::default(),
                        };
                        self.connected(&of, &mut place, &mut link).await;
                        continue;
                    }
                    let fault = format!("it is {application_uri}, and said to be another");
                    self.fault(&url, "refused", fault);
                }
                Link::Down {
                    reason,
                    certificate,
                } => {
                    let refused = client.certificates_refused();
                    self.board.note(self.level, &url, |peer| {
                        peer.certificates_refused = refused;
                    });
                    let state = certificate.map_or("away", |_| "refused");
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

    /// The server is gone.
    pub(crate) fn leave(&self, url: &str) {
        if let Some(name) = self.board.leave(self.level, url)
            && let Some(face) = &self.face
        {
            face.remove(&name);
        }
    }

    /// Who is at a URL; `None` for discovery servers, which have nothing of their own, and for ourselves.
    async fn ask(&self, url: &str) -> Option<Application> {
        let mut wait = FIRST_WAIT;
        loop {
            if let Ok(found) = find_servers(url, ASK_LIMIT).await {
                let port = |url: &str| {
                    url.trim_end_matches('/')
                        .rsplit(':')
                        .next()
                        .map(str::to_owned)
                };
                let here = |one: &&Application| {
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

    /// While there is that connection.
    async fn connected(
        &self,
        of: &Connected<'_>,
        place: &mut Option<watch::Receiver<Option<Place>>>,
        link: &mut watch::Receiver<Link>,
    ) {
        let mut known = None;
        let mut changes = of.client.subscribe(vec![model_changes()], TOLD_EVERY, 10);
        loop {
            // A server that executes a method may answer nothing else meanwhile.
            if known.is_none() || !of.client.is_calling() {
                match mirror::look(of.client).await {
                    Ok(looked) if known.as_ref() != Some(&looked) => {
                        self.show(of, &looked);
                        known = Some(looked);
                    }
                    Ok(_) => self.answers_again(of),
                    Err(_) if of.client.is_calling() => {}
                    Err(ClientError::Lost(_)) if known.is_some() => {
                        self.fault(of.url, BUSY, ANSWERS_NOTHING.to_owned());
                    }
                    Err(error) => self.fault(of.url, "waiting", error.to_string()),
                }
            }
            // Being told its place may change a server: it is not told again for that.
            let is_told = match (&*place, &known) {
                (
                    Some(place),
                    Some(Mirror {
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
                    return;
                }
                () = told => {}
                // What a server has may change: that of another station does whenever a device comes or goes.
                () = changed(&mut changes), if is_told => {}
                // Not every server says so.
                () = sleep(LOOK_AGAIN) => {}
            }
        }
    }

    /// Shows the methods of a server.
    fn show(&self, of: &Connected<'_>, looked: &Mirror) {
        if let Some(face) = &self.face {
            let shown = face.show(&Shown {
                name: of.name,
                application_uri: of.uri,
                mirror: looked,
                callers: of.callers,
                connects: of.connects,
            });
            if let Err(error) = shown {
                warn!(name = of.name, %error, "its methods are not shown");
            }
        }
        self.board.note(self.level, of.url, |peer| {
            peer.state = CONNECTED;
            peer.secured = of.secured;
            peer.fault = None;
            peer.methods = looked.methods.len();
            peer.methods_kept_back = looked.kept_back;
        });
        let methods = looked.methods.len();
        info!(
            name = of.name,
            url = of.url,
            methods,
            "its methods are shown"
        );
    }

    /// A server that was busy answers as before.
    fn answers_again(&self, of: &Connected<'_>) {
        self.board.note(self.level, of.url, |peer| {
            if peer.state == BUSY {
                info!(name = peer.name, url = of.url, "answers again");
                peer.state = CONNECTED;
                peer.fault = None;
            }
        });
    }

    /// Tells the server its place, until it has heard it; then waits for another place. Servers that did not register here
    /// belong to another supervisor.
    async fn keep_told(
        &self,
        of: &Connected<'_>,
        mirror: &Mirror,
        place: &mut watch::Receiver<Option<Place>>,
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

    /// Calls its `Configure`. Whether there is nothing more to be done.
    async fn configure(&self, of: &Connected<'_>, mirror: &Mirror, station: &Place) -> bool {
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
        let told = Told {
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
                self.note_fault(of, format!("not configured: {error}"));
                false
            }
            // The connection is gone: the next one is told.
            Err(error @ CallError::Client(_)) => {
                self.note_fault(of, format!("not configured: {error}"));
                false
            }
        }
    }

    fn note_fault(&self, of: &Connected<'_>, fault: String) {
        self.fault(of.url, CONNECTED, fault);
    }

    /// Each reason is told once.
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

/// That nodes of a server are others than before.
fn model_changes() -> Watch {
    Watch::Events {
        node: ObjectId::Server.into(),
        select: vec![Select::new(ObjectTypeId::BaseEventType, "EventType")],
        of_type: Some(ObjectTypeId::BaseModelChangeEventType.into()),
    }
}

/// Ready when the server says that it has changed.
async fn changed(changes: &mut Subscription) {
    loop {
        match changes.next().await {
            Some(Notice::Event { .. }) => return,
            Some(Notice::Subscribed | Notice::Value { .. } | Notice::Refused { .. }) => {}
            None => std::future::pending().await,
        }
    }
}

/// A connection to the server that it is said to be.
struct Connected<'a> {
    client: &'a Client,
    callers: &'a Arc<Callers>,
    connects: u64,
    secured: bool,
    url: &'a str,
    name: &'a str,
    uri: &'a str,
    /// The place of the station by which it was told its own.
    told: tokio::sync::Mutex<Option<Place>>,
}

/// The fault of a server that executes a method for somebody, as far as is known.
const ANSWERS_NOTHING: &str =
    "it answers no requests, and its host is reachable: it may execute a method";
const ASK_LIMIT: Duration = Duration::from_secs(2);
/// How soon a server is to tell of a change.
const TOLD_EVERY: Duration = Duration::from_millis(50);
const LOOK_AGAIN: Duration = Duration::from_secs(2);
const FIRST_WAIT: Duration = Duration::from_millis(250);
const MOST_WAIT: Duration = Duration::from_secs(30);
