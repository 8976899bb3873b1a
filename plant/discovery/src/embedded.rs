//! The Local Discovery Server of a host in a program that is another, for as long as no other is there: [`Embedded`].
//!
//! Who listens at its port first is it; when that one ends, [`lost`] tells the others, of whom one is it next.

use std::path::PathBuf;
use std::time::Duration;

use opcua::types::StatusCode;
use registry::{ApplicationType, Asked, Channel, MdnsConfiguration};
use tokio::sync::{mpsc, oneshot};
use tokio::task::JoinHandle;
use tokio::time::{Instant, sleep, sleep_until, timeout};
use tracing::{debug, info};

use crate::announce::Server;
use crate::client::AskFault;
use crate::connection::Asking;
use crate::lds::{EmbeddedIn, Lds, LdsSettings, listen};
use crate::line::{Line, Reached};
use crate::services::{Answer, Question};
use mdns::Interface;
use mdns::Url;

/// What it takes to embed one.
#[derive(Debug)]
pub(crate) struct Embedding {
    /// Where it belongs.
    pub(crate) lds: String,
    /// Where it announces and hears by mDNS.
    pub(crate) interface: Interface,
    /// The certificate store of the program; it has a pair of its own in there.
    pub(crate) pki: Option<PathBuf>,
    /// What the program is called.
    pub(crate) name: String,
}

impl Embedding {
    /// Makes the certificate of the discovery server while there is another one, so that it can be replaced at once.
    pub(crate) async fn prepare(self) {
        if let Err(error) = self.settings().prepare().await {
            debug!(%error, "the certificate of the embedded discovery server is made later");
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

    /// Serves a discovery server, where nobody answered because of `absent`.
    pub(crate) async fn start(self, absent: std::io::Error) -> Result<Embedded, AskFault> {
        let at = self.lds.clone();
        let settings = self.settings();
        // Before others can connect.
        let prepared = settings.prepare().await;
        prepared.map_err(|fault| AskFault::Embed(fault.to_string()))?;
        let listening = match listen(&at).await {
            Ok(listening) => listening,
            // Another one was faster, and is asked next.
            Err(fault) if fault.is_taken() => return Err(AskFault::Connect(absent)),
            Err(fault) => return Err(AskFault::Embed(format!("cannot listen at {at}: {fault}"))),
        };
        info!(
            lds = at,
            "no discovery server is there: it is in this program from now on"
        );
        let started = Lds::start(&settings, listening).await;
        let (mut lds, questions) = started.map_err(|fault| AskFault::Embed(fault.to_string()))?;
        let ask = lds.asking();
        let (stop, stopped) = oneshot::channel::<()>();
        let task = tokio::spawn(async move {
            // Nobody asks for pages.
            let mut pages = mpsc::channel(1).1;
            lds.run(questions, &mut pages, async { drop(stopped.await) })
                .await;
            let counters = lds.counters().into_iter();
            let counted: Vec<_> = counters.filter(|(_, count)| *count > 0).collect();
            info!(?counted, "the embedded discovery server has ended");
        });
        Ok(Embedded { ask, stop, task })
    }
}

/// A discovery server in this program. Whoever drops it instead of letting it [leave](Self::leave) has the same done without
/// waiting.
#[derive(Debug)]
pub(crate) struct Embedded {
    ask: mpsc::Sender<Asking>,
    /// Closed, it ends the serving.
    stop: oneshot::Sender<()>,
    task: JoinHandle<()>,
}

/// Where the program itself asks the discovery server in it.
#[derive(Debug, Clone)]
pub(crate) struct EmbeddedAsking(mpsc::Sender<Asking>);

impl Embedded {
    pub(crate) fn asking(&self) -> EmbeddedAsking {
        EmbeddedAsking(self.ask.clone())
    }

    /// Waits until it has ended by itself. Whoever drops it before loses nothing.
    pub(crate) async fn ended(&mut self) {
        // Whether it failed or not: it is not there.
        let _ended = (&mut self.task).await;
    }

    /// Lets go of the port, and says goodbye.
    pub(crate) async fn leave(self) {
        let Self { stop, task, .. } = self;
        drop(stop);
        // A failure of it has been told.
        let _ended = task.await;
    }
}

impl EmbeddedAsking {
    /// Registers the program's own server, or takes that back. It is announced under `mdns_name` where one is given.
    pub(crate) fn register(
        &self,
        server: &Server,
        mdns_name: Option<String>,
        is_online: bool,
    ) -> impl Future<Output = Result<(), AskFault>> + Send + use<> {
        let asked = Asked {
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
        // Nobody from outside can take it back.
        let channel = Channel {
            is_secured: true,
            certificate_uri: Some(server.application_uri.clone()),
            peer: None,
        };
        let ask = self.0.clone();
        async move {
            let asking = async {
                let (reply, answer) = oneshot::channel();
                let question = Question::Register {
                    asked: Box::new(asked),
                    semaphore_is_there: None,
                };
                ask.send((question, channel, reply)).await.ok()?;
                answer.await.ok()
            };
            match timeout(ANSWER_LIMIT, asking).await {
                Err(_) => Err(AskFault::Late(ANSWER_LIMIT)),
                Ok(Some(Answer::Registered)) => Ok(()),
                Ok(Some(Answer::Refused(status))) => {
                    Err(AskFault::Refused(StatusCode::from(status)))
                }
                Ok(None | Some(Answer::Servers(_) | Answer::OnNetwork { .. })) => {
                    Err(AskFault::Embed("it has ended".to_owned()))
                }
            }
        }
    }
}

/// Ready when the discovery server of another program does not answer any more; it is looked for from that time on.
pub(crate) async fn lost(lds: String, from: Instant) {
    sleep_until(from).await;
    let Some(place) = Url::parse(&lds) else {
        return;
    };
    loop {
        match Line::reach(&lds, &place, true, LIMIT).await {
            Reached::Line(mut line) => {
                line.broken().await;
                // A program that ends closes one thing after the other; its listener may be next.
                sleep(SETTLE).await;
                return;
            }
            Reached::Refused | Reached::Nobody => return,
            // Its place is taken, whether or not it says something.
            Reached::Answers | Reached::Accepts | Reached::Untried => sleep(LOOK_EVERY).await,
        }
    }
}

/// The folder in the certificate store of a program where the discovery server has its pair.
const STORE: &str = "lds";
const ANSWER_LIMIT: Duration = Duration::from_secs(5);
const LIMIT: Duration = Duration::from_secs(1);
const SETTLE: Duration = Duration::from_millis(30);
const LOOK_EVERY: Duration = Duration::from_secs(2);
