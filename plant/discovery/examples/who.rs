//! Both ends of discovery in a terminal: `who announce NAME` announces a server without services,
//! `who watch` prints servers that appear and disappear as JSON objects, each in a line.

use std::net::{Ipv4Addr, SocketAddr};
use std::process::ExitCode;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use discovery::{
    AnnounceSettings, MdnsInterface, ServerAnnouncement, ServerChange, ServerDescription,
    WatchSettings, announce, be_there, watch,
};
use serde_json::{Value, json};
use service::{Failure, FailureKind, LogFormat, ServiceProgram, run_service};
use tokio::net::TcpListener;

/// Announces simulated servers, or watches the announced servers.
#[derive(Debug, clap::Parser)]
struct WhoArguments {
    #[command(subcommand)]
    what: WhoVerb,
}

#[derive(Debug, clap::Subcommand)]
enum WhoVerb {
    /// Be there: listen, announce by mDNS, register
    Announce(Presence),
    /// Print who comes and goes
    Watch {
        /// Where to hear
        #[arg(long, default_value = "127.0.0.1")]
        interface: String,
    },
}

#[derive(Debug, Clone, clap::Args)]
struct Presence {
    /// The ApplicationName; the ApplicationUri is `urn:who:` with it
    name: String,
    /// Where to listen, and on which interface to be announced
    #[arg(long, default_value = "127.0.0.1")]
    address: Ipv4Addr,
    #[arg(long, default_value = "0")]
    port: u16,
    /// The path of the URL
    #[arg(long, default_value = "/")]
    path: String,
    /// The discovery server to register with
    #[arg(long)]
    lds: Option<String>,
    /// Leave mDNS to the discovery server
    #[arg(long)]
    no_mdns: bool,
    /// How often to register, in seconds
    #[arg(long, default_value = "60")]
    register_period: u64,
    /// The certificate store, with a pair, to register over a secured channel
    #[arg(long)]
    pki: Option<std::path::PathBuf>,
    /// The ApplicationUri
    #[arg(long)]
    uri: Option<String>,
    /// Capability codes of the simulated servers
    #[arg(long, default_value = "DA", value_delimiter = ',')]
    capabilities: Vec<String>,
    /// Be so many servers, `NAME-0` and so on, each at a port of its own
    #[arg(long, conflicts_with_all = ["port", "uri"])]
    count: Option<u16>,
}

impl Presence {
    /// Returns the servers to announce.
    fn all(&self) -> Vec<Self> {
        let numbered = |number| Self {
            name: format!("{}-{number}", self.name),
            ..self.clone()
        };
        match self.count {
            None => vec![self.clone()],
            Some(count) => (0..count).map(numbered).collect(),
        }
    }

    /// Starts to listen and to announce. Returns the announcement and the port.
    async fn begin(self) -> Result<(ServerAnnouncement, u16), Failure> {
        let address = SocketAddr::from((self.address, self.port));
        let listener = TcpListener::bind(address).await.map_err(unavailable)?;
        let at = listener.local_addr().map_err(unavailable)?;
        let server = ServerDescription {
            application_uri: self.uri.unwrap_or_else(|| format!("urn:who:{}", self.name)),
            product_uri: String::new(),
            name: self.name,
            url: format!("opc.tcp://{at}{}", self.path),
            capabilities: self.capabilities,
            number: None,
        };
        let settings = AnnounceSettings {
            register_every: Duration::from_secs(self.register_period),
            pki: self.pki,
            mdns: (!self.no_mdns).then(|| MdnsInterface::parse(&self.address.to_string())),
            ..AnnounceSettings::registering(self.lds.as_deref())
        };
        let told = announce(server.clone(), settings).map_err(unavailable)?;
        tokio::spawn(async move { be_there(listener, &server).await });
        Ok((told, at.port()))
    }
}

fn main() -> ExitCode {
    run_service::<WhoArguments>(std::env::args_os())
}

impl ServiceProgram for WhoArguments {
    fn log(&self) -> LogFormat {
        LogFormat::Text
    }

    async fn serve(self, stop: impl Future<Output = ()> + Send + 'static) -> Result<(), Failure> {
        match self.what {
            WhoVerb::Announce(presence) => {
                let mut told = Vec::new();
                let mut port = 0;
                for presence in presence.all() {
                    let (announced, at) = presence.begin().await?;
                    told.push(announced);
                    port = at;
                }
                say(&json!({"ready": true, "port": port}));
                stop.await;
                for announced in told {
                    announced.leave().await;
                }
                Ok(())
            }
            WhoVerb::Watch { interface } => {
                let settings = WatchSettings {
                    mdns: Some(MdnsInterface::parse(&interface)),
                    ..WatchSettings::default()
                };
                let mut watcher = watch(settings).map_err(unavailable)?;
                say(&json!({"ready": true}));
                tokio::pin!(stop);
                loop {
                    tokio::select! {
                        () = &mut stop => return Ok(()),
                        Some(found) = watcher.next() => say(&line(&found)),
                    }
                }
            }
        }
    }
}

fn unavailable(error: impl std::fmt::Display) -> Failure {
    Failure::new(FailureKind::Unavailable, error.to_string())
}

fn line(found: &ServerChange) -> Value {
    let (what, loss) = match found {
        ServerChange::Seen(_) => ("seen", None),
        ServerChange::Restarted(_) => ("restarted", None),
        ServerChange::Gone { loss, .. } => ("gone", Some(loss.label())),
    };
    let known = found.known();
    json!({
        "found": what,
        "loss": loss,
        "name": known.name,
        "url": known.url,
        "capabilities": known.capabilities,
        "uri": known.application_uri,
        "started_ms": known.started.map(since_1970),
        "at_ms": millis(),
    })
}

#[expect(clippy::disallowed_methods, reason = "the lines say when")]
fn millis() -> u128 {
    since_1970(SystemTime::now())
}

fn since_1970(at: SystemTime) -> u128 {
    at.duration_since(UNIX_EPOCH)
        .unwrap_or_default()
        .as_millis()
}

#[expect(clippy::print_stdout, reason = "this is what it is for")]
fn say(line: &Value) {
    println!("{line}");
}
