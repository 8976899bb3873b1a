//! The Local Discovery Server of a host, embedded in another program while no other discovery
//! server runs: [`Embedded`].
//!
//! The first program that listens on the port becomes the discovery server. When it ends, [`lost`]
//! completes in the other programs, and one of them takes over.

use std::path::PathBuf;
use std::time::Duration;

use opcua::types::StatusCode;
use registry::{ApplicationType, Channel, MdnsConfiguration, RegistrationRequest};
use tokio::sync::{mpsc, oneshot};
use tokio::task::JoinHandle;
use tokio::time::{Instant, sleep, sleep_until, timeout};
use tracing::{debug, info};

use crate::client::DiscoveryQueryFault;
use crate::connection::RegistryRequest;
use crate::description::ServerDescription;
use crate::lds::{DiscoveryServer, EmbeddedIn, LdsSettings};
use crate::line::{OpenChannel, Reached};
use crate::listen::listen;
use crate::services::{RegistryAnswer, RegistryQuery};
use mdns::MdnsInterface;
use mdns::Url;

/// The settings of an embedded discovery server.
#[derive(Debug)]
pub(crate) struct Embedding {
    /// The URL of the discovery server.
    pub(crate) lds: String,
    /// The interface for mDNS.
    pub(crate) interface: MdnsInterface,
    /// The certificate store of the program. The discovery server has a separate store below it.
    pub(crate) pki: Option<PathBuf>,
    /// The name of the program.
    pub(crate) name: String,
}

impl Embedding {
    /// Creates the certificate of the discovery server in advance, so that a takeover is fast.
    pub(crate) async fn prepare(self) {
        if let Err(error) = self.settings().prepare().await {
            debug!(%error, "cannot make the certificate of the embedded discovery server yet");
        }
    }

    fn settings(&self) -> LdsSettings {
        LdsSettings {
            interface: self.interface.clone(),
            pki: self.pki.as_ref().map(|root| root.join(STORE)),
            embedded: Some(EmbeddedIn {
                name: self.name.clone(),
                trusts: self.pki.clone(),
            }),
            ..LdsSettings::at(self.lds.clone())
        }
    }

    /// Starts the discovery server. `absent` is the error of the connection attempt to another
    /// discovery server.
    pub(crate) async fn start(
        self,
        absent: std::io::Error,
    ) -> Result<Embedded, DiscoveryQueryFault> {
        let at = self.lds.clone();
        let settings = self.settings();
        // The certificate is created before clients can connect.
        let prepared = settings.prepare().await;
        prepared.map_err(|fault| DiscoveryQueryFault::Embed(fault.to_string()))?;
        let listening = match listen(&at).await {
            Ok(listening) => listening,
            // Another program was faster; the next registration goes to its discovery server.
            Err(fault) if fault.is_taken() => return Err(DiscoveryQueryFault::Connect(absent)),
            Err(fault) => {
                return Err(DiscoveryQueryFault::Embed(format!(
                    "cannot listen at {at}: {fault}"
                )));
            }
        };
        info!(
            lds = at,
            "no discovery server runs: this program is the discovery server now"
        );
        let started = DiscoveryServer::start(&settings, listening).await;
        let (mut lds, questions) =
            started.map_err(|fault| DiscoveryQueryFault::Embed(fault.to_string()))?;
        let ask = lds.asking();
        let (stop, stopped) = oneshot::channel::<()>();
        let task = tokio::spawn(async move {
            // An embedded discovery server has no status page.
            let mut pages = mpsc::channel(1).1;
            lds.run(questions, &mut pages, async { drop(stopped.await) })
                .await;
            let counters = lds.counters().into_iter();
            let counted: Vec<_> = counters.filter(|(_, count)| *count > 0).collect();
            info!(?counted, "the embedded discovery server has stopped");
        });
        Ok(Embedded { ask, stop, task })
    }
}

/// A discovery server in this program. Dropping this value is like [`leave`](Self::leave) without
/// waiting.
#[derive(Debug)]
pub(crate) struct Embedded {
    ask: mpsc::Sender<RegistryRequest>,
    /// Dropping the sender stops the discovery server.
    stop: oneshot::Sender<()>,
    task: JoinHandle<()>,
}

/// Sends requests of the program to its embedded discovery server.
#[derive(Debug, Clone)]
pub(crate) struct EmbeddedAsking(mpsc::Sender<RegistryRequest>);

impl Embedded {
    pub(crate) fn asking(&self) -> EmbeddedAsking {
        EmbeddedAsking(self.ask.clone())
    }

    /// Waits until the discovery server has ended. Cancel safe.
    pub(crate) async fn ended(&mut self) {
        // A failure counts as an end too.
        let _ended = (&mut self.task).await;
    }

    /// Stops the discovery server: withdraws its announcement and closes the port.
    pub(crate) async fn leave(self) {
        let Self { stop, task, .. } = self;
        drop(stop);
        // A failure has been logged.
        let _ended = task.await;
    }
}

impl EmbeddedAsking {
    /// Registers or unregisters the server of the program. With `mdns_name` the discovery server
    /// announces the server.
    pub(crate) fn register(
        &self,
        server: &ServerDescription,
        mdns_name: Option<String>,
        is_online: bool,
    ) -> impl Future<Output = Result<(), DiscoveryQueryFault>> + Send + use<> {
        let asked = RegistrationRequest {
            server_uri: server.application_uri.clone(),
            product_uri: server.product_uri.clone(),
            names: vec![("en".to_owned(), server.name.clone())],
            application_type: ApplicationType::Server,
            gateway_server_uri: String::new(),
            discovery_urls: vec![server.url.clone()],
            semaphore_file_path: String::new(),
            is_online,
            mdns: mdns_name.map(|name| MdnsConfiguration {
                name,
                capabilities: server.capabilities.clone(),
            }),
        };
        // No other client can unregister the server.
        let channel = Channel {
            is_secured: true,
            certificate_uri: Some(server.application_uri.clone()),
            peer: None,
        };
        let ask = self.0.clone();
        async move {
            let asking = async {
                let (reply, answer) = oneshot::channel();
                let question = RegistryQuery::Register {
                    asked: Box::new(asked),
                    semaphore_is_there: None,
                };
                ask.send((question, channel, reply)).await.ok()?;
                answer.await.ok()
            };
            match timeout(ANSWER_LIMIT, asking).await {
                Err(_) => Err(DiscoveryQueryFault::Late(ANSWER_LIMIT)),
                Ok(Some(RegistryAnswer::Registered)) => Ok(()),
                Ok(Some(RegistryAnswer::Refused(status))) => {
                    Err(DiscoveryQueryFault::Refused(StatusCode::from(status)))
                }
                Ok(None | Some(RegistryAnswer::Servers(_) | RegistryAnswer::OnNetwork { .. })) => {
                    Err(DiscoveryQueryFault::Embed("it has ended".to_owned()))
                }
            }
        }
    }
}

/// Completes when the discovery server of another program no longer answers. Watches it from the
/// time `from` on.
pub(crate) async fn lost(lds: String, from: Instant) {
    sleep_until(from).await;
    let Some(place) = Url::parse(&lds) else {
        return;
    };
    loop {
        match OpenChannel::reach(&lds, &place, true, LIMIT).await {
            Reached::Line(mut line) => {
                line.broken().await;
                // A program that ends closes its sockets one after another; its listener may be
                // next.
                sleep(SETTLE).await;
                return;
            }
            Reached::Refused | Reached::Nobody => return,
            // The port is in use, even if the program does not answer.
            Reached::Answers | Reached::Accepts | Reached::Untried => sleep(LOOK_EVERY).await,
        }
    }
}

/// The folder of the discovery server's store below the certificate store of the program.
const STORE: &str = "lds";
const ANSWER_LIMIT: Duration = Duration::from_secs(5);
const LIMIT: Duration = Duration::from_secs(1);
const SETTLE: Duration = Duration::from_millis(30);
const LOOK_EVERY: Duration = Duration::from_secs(2);
