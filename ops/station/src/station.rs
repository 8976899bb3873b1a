//! A complete station: the discovery server of the level below, both faces, and the supervised
//! servers.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use discovery::lds::{self, Gated, LdsEmbedding, LdsSettings, LdsStatus, OnLevel};
use discovery::{
    AnnounceSettings, MdnsFault, MdnsInterface, ServerAnnouncement, ServerChange,
    ServerDescription, ServerWatcher, WatchSettings, announce, find_lds, watch as watch_level,
};
use plant_opcua::client::{ClientConfig, HostNames, SecurityChoice};
use plant_opcua::enrolment::{Applicant, Enrolment, Invitation};
use plant_opcua::limits::ClientLimits;
use plant_opcua::pki::Pki;
use plant_opcua::server::{
    EndpointUrl, MethodRefusal, MethodRequest, MethodSpec, ServerError, method,
};
use plant_opcua::supervision::{CONFIGURE, Supervision, configure_takes};
use plant_opcua::types::{ObjectId, QualifiedName, StatusCode};
use plant_opcua::users::{Roles, UserAccess};
use registry::hierarchy::{PlantLocation, Roster, RosterChange, ServerChoice};
use service::{Failure, FailureKind, Requests};
use tokio::sync::{mpsc, watch};
use tokio::task::AbortHandle;
use tracing::{info, warn};

use crate::board::{Board, Level};
use crate::budget::NodeBudget;
use crate::callers::CallerCheck;
use crate::configure::ConfigureArguments;
use crate::face::{Face, FaceSettings, id};
use crate::looks::StationSearches;
use crate::marks::SearchSession;
use crate::tend::Tending;

/// The settings of a station.
#[derive(Debug, Clone)]
pub struct StationSettings {
    /// Its name on the level above.
    pub name: String,
    /// The place of the level, used until a supervisor above sets it.
    pub place: Option<PlantLocation>,
    /// The discovery server of the level below.
    pub lds: LdsSettings,
    /// The endpoint of the face below; `None` for a free port of the interface below.
    pub devices_endpoint: Option<EndpointUrl>,
    /// The level above; `None` for the top level.
    pub upper: Option<Upper>,
    /// The roles of callers without a user name. Calls of operators and engineers are forwarded.
    pub anonymous: Roles,
    /// The rule for servers at hosts that are missing in their trusted certificates.
    pub host_names: HostNames,
    /// The Global Discovery Server that issues its certificate. Needs the store of `lds`.
    pub gds: Option<Invitation>,
    /// The limits of the clients of each face.
    pub clients: ClientLimits,
}

/// The level above.
#[derive(Debug, Clone)]
pub struct Upper {
    /// The network interface.
    pub interface: MdnsInterface,
    /// The endpoint of the face above; `None` for a free port of the interface.
    pub endpoint: Option<EndpointUrl>,
    /// The discovery server at which the station registers.
    pub discovery: ServerChoice,
}

/// Runs a station until `stop` completes.
///
/// # Errors
/// An endpoint, an interface or the certificate store cannot be used.
pub async fn run(
    settings: StationSettings,
    pages: Requests<LdsStatus>,
    stop: impl Future<Output = ()>,
) -> Result<(), Failure> {
    let uri = format!(
        "urn:{}:ua-station:{}",
        discovery::host_name(),
        settings.name
    );
    let pki = certificates(&settings, &uri)?;
    let (board, added) = Board::new();
    let board = Arc::new(board);
    let users = UserAccess::of_store(pki.as_deref(), settings.anonymous);
    let users = users.map_err(|error| Failure::new(FailureKind::Io, error.to_string()))?;
    board.place(settings.place.as_ref().map(PlantLocation::to_string));
    let (place, places) = watch::channel(settings.place.clone());
    let client = client(&settings, &uri, pki.clone());
    let common = Common {
        settings: &settings,
        uri: &uri,
        pki,
        board: Arc::clone(&board),
        users: Arc::new(users),
        client: client.clone(),
    };
    let mut levels = Levels::default();
    let faces = match &settings.upper {
        Some(upper) => Some(common.open(upper, &place, &mut levels)?),
        None => None,
    };
    levels.enrolled = enrol(&settings, &uri, faces.as_ref());
    let (tell, events) = mpsc::channel(MOST_EVENTS);
    let tending = Tending {
        level: Level::Below,
        board,
        face: faces.as_ref().map(|faces| faces.above.clone()),
        client,
        place: Some(places),
        discovery_url: settings.lds.endpoint.clone(),
        own_uri: uri.clone(),
        registered: watch::Sender::default(),
        nodes: NodeBudget::default(),
        looks: StationSearches::default(),
    };
    levels.below = Some(Abort(
        tokio::spawn(tend_below(events, tending)).abort_handle(),
    ));
    let around = LdsEmbedding {
        program: "ua-station",
        events: tell,
        added,
    };
    let lds = LdsSettings {
        application_uri: Some(uri),
        ..settings.lds
    };
    let ended = lds::run_around(lds, Some(around), pages, stop).await;
    // The sender of the place is kept until no server can be configured any more.
    drop(place);
    levels.leave().await;
    if let Some(Faces { above, below }) = faces {
        above.server.stop().await;
        below.server.stop().await;
    }
    ended
}

/// The faces of a station between two levels.
struct Faces {
    above: Face,
    below: Face,
}

/// Data that the faces and the levels share.
struct Common<'a> {
    settings: &'a StationSettings,
    uri: &'a str,
    pki: Option<PathBuf>,
    board: Arc<Board>,
    users: Arc<UserAccess>,
    client: ClientConfig,
}

impl Common<'_> {
    /// Opens both faces, follows the level above, and registers there.
    fn open(
        &self,
        upper: &Upper,
        place: &watch::Sender<Option<PlantLocation>>,
        levels: &mut Levels,
    ) -> Result<Faces, Failure> {
        let Self {
            settings,
            uri,
            board,
            client,
            ..
        } = self;
        let below = open_below(
            settings,
            uri,
            self.callers(Level::Below, Supervision::default()),
        )?;
        board.own(Gated {
            application_uri: (*uri).to_owned(),
            name: settings.name.clone(),
            gateway_uri: String::new(),
            url: below.server.url().to_owned(),
        });
        let supervision = Supervision::default();
        let callers = self.callers(Level::Above, supervision.clone());
        let above = open_above(settings, upper, uri, callers)?;
        let by = (supervision.clone(), Arc::clone(&self.users));
        configurable(&above, &settings.name, (board, place.clone()), by)?;
        above.server.start();
        below.server.start();
        let tending = Tending {
            level: Level::Above,
            board: Arc::clone(board),
            face: Some(below.clone()),
            client: client.clone(),
            place: None,
            discovery_url: String::new(),
            own_uri: (*uri).to_owned(),
            registered: watch::Sender::default(),
            nodes: NodeBudget::default(),
            looks: StationSearches::default(),
        };
        levels.above = Some(follow(upper, tending)?);
        levels.announced = tell(settings, upper, uri, (&above, &below))?;
        let told = (Arc::clone(board), supervision);
        levels.registered = Some(register(settings, upper, &above, client, told)?);
        Ok(Faces { above, below })
    }

    /// Returns the certificate store of a face, and the check of its callers.
    fn callers(&self, level: Level, supervision: Supervision) -> (Option<PathBuf>, CallerCheck) {
        let admission = CallerCheck {
            users: Arc::clone(&self.users),
            board: Arc::clone(&self.board),
            level,
            supervision,
        };
        (self.pki.clone(), admission)
    }
}

/// Returns the configuration of the clients of the station.
fn client(settings: &StationSettings, uri: &str, pki: Option<PathBuf>) -> ClientConfig {
    ClientConfig {
        accept_untrusted: settings.lds.trust_any,
        security: match (&pki, settings.lds.allow_unsecured) {
            (Some(_), false) => SecurityChoice::Basic256Sha256,
            (Some(_), true) => SecurityChoice::Best,
            (None, _) => SecurityChoice::None,
        },
        pki,
        host_names: settings.host_names,
        patience: BUSY_FOR,
        ..ClientConfig::new(uri, &settings.name)
    }
}

/// Aborts a task when it is dropped.
struct Abort(AbortHandle);

impl Drop for Abort {
    fn drop(&mut self) {
        self.0.abort();
    }
}

/// The tasks that run beside the discovery server.
#[derive(Default)]
struct Levels {
    /// Keeps the certificate current.
    enrolled: Option<Abort>,
    above: Option<Abort>,
    below: Option<Abort>,
    announced: Vec<ServerAnnouncement>,
    /// Dropping the sender ends the registration. The task ends when the server is unregistered.
    registered: Option<(mpsc::Sender<()>, tokio::task::JoinHandle<()>)>,
}

impl Levels {
    async fn leave(self) {
        drop((self.above, self.below, self.enrolled));
        if let Some((stop, task)) = self.registered {
            drop(stop);
            drop(tokio::time::timeout(LEAVE_LIMIT, task).await);
        }
        for announced in self.announced {
            announced.leave().await;
        }
    }
}

/// Creates the certificate of the station, for the addresses of both interfaces.
fn certificates(settings: &StationSettings, uri: &str) -> Result<Option<PathBuf>, Failure> {
    let Some(root) = &settings.lds.pki else {
        return Ok(None);
    };
    let failed = |error: plant_opcua::pki::PkiError| {
        Failure::new(FailureKind::Io, format!("{error} (--pki)"))
    };
    let mut hosts = Vec::new();
    let levels = settings.upper.iter().map(|upper| &upper.interface);
    for interface in levels.chain([&settings.lds.interface]) {
        hosts.extend(interface.addresses().iter().map(ToString::to_string));
    }
    let pki = Pki::open(root.clone()).map_err(failed)?;
    pki.ensure_own_at(uri, &hosts).map_err(failed)?;
    Ok(Some(root.clone()))
}

/// Keeps the certificate of the station current at the Global Discovery Server, for the addresses
/// of all its interfaces.
fn enrol(settings: &StationSettings, uri: &str, faces: Option<&Faces>) -> Option<Abort> {
    let (root, gds) = (settings.lds.pki.as_ref()?, settings.gds.clone()?);
    let faces = faces
        .into_iter()
        .flat_map(|faces| [&faces.above, &faces.below]);
    let mut urls: Vec<String> = faces.map(|face| face.server.url().to_owned()).collect();
    if let Ok(lds) = settings.lds.endpoint.parse::<EndpointUrl>() {
        let port = lds.port();
        urls.extend(lds.urls(port));
        let addresses = settings.lds.interface.addresses().into_iter();
        urls.extend(addresses.map(|address| format!("opc.tcp://{address}:{port}")));
    }
    urls.sort();
    urls.dedup();
    let applicant = Applicant {
        application_uri: uri.to_owned(),
        name: settings.name.clone(),
        product_uri: "urn:ua-bridge:station".to_owned(),
        urls,
        capabilities: vec!["LDS".to_owned()],
    };
    let enrolment = Enrolment::new(root, applicant, gds);
    let kept = tokio::spawn(enrolment.keep(service::restart::restart));
    Some(Abort(kept.abort_handle()))
}

fn open_below(
    settings: &StationSettings,
    uri: &str,
    (pki, admission): (Option<PathBuf>, CallerCheck),
) -> Result<Face, Failure> {
    let endpoint = endpoint(
        settings.devices_endpoint.as_ref(),
        &settings.lds.interface,
        "--devices-endpoint",
    )?;
    let settings = FaceSettings {
        application_uri: uri.to_owned(),
        name: settings.name.clone(),
        endpoint,
        pki,
        allow_unsecured: settings.lds.allow_unsecured,
        trust_any: settings.lds.trust_any,
        admission,
        clients: settings.clients,
    };
    Face::open(settings, "Neighbours").map_err(|error| unavailable(&error))
}

fn open_above(
    settings: &StationSettings,
    upper: &Upper,
    uri: &str,
    (pki, admission): (Option<PathBuf>, CallerCheck),
) -> Result<Face, Failure> {
    let endpoint = endpoint(
        upper.endpoint.as_ref(),
        &upper.interface,
        "--upper-endpoint",
    )?;
    let settings = FaceSettings {
        application_uri: uri.to_owned(),
        name: settings.name.clone(),
        endpoint,
        pki,
        allow_unsecured: settings.lds.allow_unsecured,
        trust_any: settings.lds.trust_any,
        admission,
        clients: settings.clients,
    };
    Face::open(settings, "Devices").map_err(|error| unavailable(&error))
}

fn unavailable(error: &ServerError) -> Failure {
    Failure::new(FailureKind::Unavailable, error.to_string())
}

/// Returns the given endpoint, or a free port of the first address of an interface.
fn endpoint(
    given: Option<&EndpointUrl>,
    interface: &MdnsInterface,
    option: &str,
) -> Result<EndpointUrl, Failure> {
    if let Some(given) = given {
        return Ok(given.clone());
    }
    let address = interface.addresses().into_iter().next().ok_or_else(|| {
        let message = format!(
            "the interface {interface} has no IPv4 address to listen at: give the interface an address, or \
             give {option}"
        );
        Failure::new(FailureKind::Unavailable, message)
    })?;
    format!("opc.tcp://{address}:0/")
        .parse()
        .map_err(|error| Failure::new(FailureKind::Unavailable, format!("{error}")))
}

/// Adds the object of the station itself, on which the supervisor above sets its place.
fn configurable(
    face: &Face,
    name: &str,
    (board, place): (&Arc<Board>, watch::Sender<Option<PlantLocation>>),
    (supervision, users): (Supervision, Arc<UserAccess>),
) -> Result<(), Failure> {
    let failed = |error: plant_opcua::server::InstanceError| {
        Failure::new(FailureKind::Unavailable, error.to_string())
    };
    let told = place.borrow().as_ref().map(PlantLocation::to_string);
    let told = told.unwrap_or_default();
    face.object(STATION, &ObjectId::ObjectsFolder.into(), name)
        .map_err(failed)?;
    let shown = face.property(STATION, "Place", &told).map_err(failed)?;
    let by = face.property(STATION, "Supervisor", "").map_err(failed)?;
    let (server, board) = (face.server.clone(), Arc::clone(board));
    let handler = method(move |request: MethodRequest| {
        let caller = &request.caller;
        supervision
            .admits(caller, users.roles_of(caller))
            .inspect_err(|_| {
                warn!(
                    application = ?caller.application_uri, user = ?caller.user, proven = caller.proven,
                    "refused Configure: the station is not registered with this client"
                );
            })?;
        let invalid = MethodRefusal::Status(StatusCode::BadInvalidArgument);
        let told = ConfigureArguments::read(&request.arguments).ok_or_else(|| invalid.clone())?;
        let new: PlantLocation = told.place.parse().map_err(|_| invalid)?;
        info!(place = %new, supervisor = told.supervisor_uri, "configured by the supervisor");
        server.show(&shown, told.place.as_str())?;
        server.show(&by, told.supervisor_uri.as_str())?;
        board.place(Some(told.place));
        place.send_replace(Some(new));
        Ok(Vec::new())
    });
    let path = format!("{STATION}/{}", CONFIGURE);
    let spec = MethodSpec {
        node_id: id(&path),
        browse_name: QualifiedName::new(1, CONFIGURE),
        object: id(STATION),
        arguments: (id(&format!("{path}.in")), id(&format!("{path}.out"))),
        takes: configure_takes(),
        gives: Vec::new(),
    };
    face.server.add_method(spec, handler).map_err(failed)
}

/// Announces each face on its own level only.
fn tell(
    settings: &StationSettings,
    upper: &Upper,
    uri: &str,
    (above, below): (&Face, &Face),
) -> Result<Vec<ServerAnnouncement>, Failure> {
    let faces = [(above, &upper.interface), (below, &settings.lds.interface)];
    let told = faces.map(|(face, interface)| {
        let how = AnnounceSettings {
            lds: None,
            mdns: Some(interface.clone()),
            ..AnnounceSettings::default()
        };
        announce(server(&settings.name, uri, face), how)
    });
    told.into_iter().collect::<Result<_, _>>().map_err(no_mdns)
}

fn server(name: &str, uri: &str, face: &Face) -> ServerDescription {
    ServerDescription {
        application_uri: uri.to_owned(),
        product_uri: "urn:ua-bridge:plant".to_owned(),
        name: name.to_owned(),
        url: face.server.url().to_owned(),
        capabilities: vec!["NA".to_owned()],
        number: None,
    }
}

fn no_mdns(fault: MdnsFault) -> Failure {
    Failure::new(FailureKind::Unavailable, fault.to_string())
}

/// Registers the face above at the chosen discovery server, and again at each change of the choice.
fn register(
    settings: &StationSettings,
    upper: &Upper,
    face: &Face,
    client: &ClientConfig,
    (board, supervision): (Arc<Board>, Supervision),
) -> Result<(mpsc::Sender<()>, tokio::task::JoinHandle<()>), Failure> {
    let marks = Arc::new(SearchSession(client.clone()));
    let chosen = find_lds(upper.discovery.clone(), &upper.interface, Some(marks));
    let mut chosen = chosen.map_err(no_mdns)?;
    let server = server(&settings.name, face.server.application_uri(), face);
    let pki = settings.lds.pki.clone();
    let (stop, mut stopped) = mpsc::channel::<()>(1);
    let task = tokio::spawn(async move {
        loop {
            let lds = chosen.borrow_and_update().clone();
            board.discovery_above(lds.clone());
            let how = AnnounceSettings {
                lds: lds.clone(),
                // The faces are announced separately.
                mdns: None,
                pki: pki.clone(),
                supervision: supervision.clone(),
                ..AnnounceSettings::default()
            };
            let registered = lds.and_then(|_| announce(server.clone(), how).ok());
            let changed = tokio::select! {
                changed = chosen.changed() => changed.is_ok(),
                _ = stopped.recv() => false,
            };
            if !changed && !stopped.is_closed() {
                // The choice is final.
                stopped.recv().await;
            }
            if let Some(registered) = registered {
                registered.leave().await;
            }
            if !changed {
                return;
            }
        }
    });
    Ok((stop, task))
}

/// Supervises the servers that are announced on the level above.
fn follow(upper: &Upper, tending: Tending) -> Result<Abort, Failure> {
    let settings = WatchSettings {
        mdns: Some(upper.interface.clone()),
        ..WatchSettings::default()
    };
    let watcher = watch_level(settings).map_err(no_mdns)?;
    Ok(Abort(
        tokio::spawn(tend_above(watcher, tending)).abort_handle(),
    ))
}

async fn tend_above(mut watcher: ServerWatcher, tending: Tending) {
    let mut tended = Tended::new(tending);
    while let Some(found) = watcher.next().await {
        match found {
            ServerChange::Seen(known) if !known.is_lds() => tended.told(&known.name, &known.url),
            ServerChange::Seen(_) | ServerChange::Restarted(_) => {}
            ServerChange::Gone { known, .. } => tended.left(&known.name),
        }
    }
}

async fn tend_below(mut events: mpsc::Receiver<OnLevel>, tending: Tending) {
    let mut tended = Tended::new(tending);
    while let Some(event) = events.recv().await {
        match event {
            OnLevel::Told {
                source,
                url,
                registered,
            } => {
                if registered {
                    tended.registered(&source, &url);
                }
                tended.told(&source, &url);
            }
            OnLevel::Left { source } => {
                tended.unregistered(&source);
                tended.left(&source);
            }
            // The client detects the restart itself.
            OnLevel::Restarted { .. } => {}
        }
    }
}

/// The supervised servers of a level.
struct Tended {
    tending: Arc<Tending>,
    roster: Roster,
    tasks: BTreeMap<String, Abort>,
    /// The URLs of the registered servers, by their ApplicationUris.
    registered: BTreeMap<String, String>,
}

impl Tended {
    fn new(tending: Tending) -> Self {
        Self {
            tending: Arc::new(tending),
            roster: Roster::new(MOST_TENDED),
            tasks: BTreeMap::new(),
            registered: BTreeMap::new(),
        }
    }

    fn registered(&mut self, source: &str, url: &str) {
        // The same form as in the roster.
        let url = url.trim_end_matches('/').to_owned();
        self.registered.insert(source.to_owned(), url);
        self.tell_registered();
    }

    fn unregistered(&mut self, source: &str) {
        if self.registered.remove(source).is_some() {
            self.tell_registered();
        }
    }

    fn tell_registered(&self) {
        let urls = self.registered.values().cloned().collect();
        self.tending.registered.send_replace(urls);
    }

    fn told(&mut self, source: &str, url: &str) {
        let changes = self.roster.put(source, url);
        self.take(changes);
    }

    fn left(&mut self, source: &str) {
        let changes = self.roster.remove(source);
        self.take(changes);
    }

    fn take(&mut self, changes: Vec<RosterChange>) {
        for change in changes {
            match change {
                RosterChange::Joined(url) => {
                    let task = tokio::spawn(Arc::clone(&self.tending).tend(url.clone()));
                    self.tasks.insert(url, Abort(task.abort_handle()));
                }
                RosterChange::Left(url) => {
                    self.tasks.remove(&url);
                    self.tending.leave(&url);
                }
            }
        }
        if self.tasks.len() >= MOST_TENDED {
            warn!("the limit of {MOST_TENDED} supervised servers of a level is reached");
        }
    }
}

/// The path of the station's own object.
const STATION: &str = "Station";
const MOST_EVENTS: usize = 1024;
const MOST_TENDED: usize = 256;
const LEAVE_LIMIT: Duration = Duration::from_secs(1);
/// Time that a server may be unresponsive while its host is reachable, because it may be executing
/// a method.
const BUSY_FOR: Duration = Duration::from_secs(60);
