//! Both ends of discovery in a terminal: `who announce NAME` is a server that can do nothing but be there, `who watch`
//! prints who comes and goes, a JSON object a line.

use std::net::{Ipv4Addr, SocketAddr};
use std::process::ExitCode;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use bridge_node::{Failure, FailureKind, LogFormat, Service, run_service};
use discovery::{AnnounceSettings, Found, Interface, Server, WatchSettings, announce, watch};
use serde_json::{Value, json};
use tokio::net::TcpListener;

/// Tells of a server that is not one, or watches who is there.
#[derive(Debug, clap::Parser)]
struct Who {
    #[command(subcommand)]
    what: What,
}

#[derive(Debug, clap::Subcommand)]
enum What {
    /// Be there: listen, announce by mDNS, register
    Announce {
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
        /// Codes of what it can do
        #[arg(long, default_value = "DA", value_delimiter = ',')]
        capabilities: Vec<String>,
    },
    /// Print who comes and goes
    Watch,
}

fn main() -> ExitCode {
    run_service::<Who>()
}

impl Service for Who {
    fn log(&self) -> LogFormat {
        LogFormat::Text
    }

    async fn serve(self, stop: impl Future<Output = ()> + Send + 'static) -> Result<(), Failure> {
        let unavailable = |error: &dyn std::fmt::Display| {
            Failure::new(FailureKind::Unavailable, error.to_string())
        };
        match self.what {
            What::Announce {
                name,
                address,
                port,
                path,
                lds,
                no_mdns,
                register_period,
                pki,
                uri,
                capabilities,
            } => {
                let listener = TcpListener::bind(SocketAddr::from((address, port))).await;
                let listener = listener.map_err(|error| unavailable(&error))?;
                let at = listener.local_addr().map_err(|error| unavailable(&error))?;
                let server = Server {
                    application_uri: uri.unwrap_or_else(|| format!("urn:who:{name}")),
                    product_uri: String::new(),
                    name,
                    url: format!("opc.tcp://{at}{path}"),
                    capabilities,
                };
                let settings = AnnounceSettings {
                    lds,
                    register_every: Duration::from_secs(register_period),
                    pki,
                    mdns: (!no_mdns).then(|| Interface::parse(&address.to_string())),
                };
                let told = announce(server, settings).map_err(|error| unavailable(&error))?;
                say(&json!({"ready": true, "port": at.port()}));
                tokio::pin!(stop);
                loop {
                    tokio::select! {
                        () = &mut stop => break,
                        client = listener.accept() => drop(client),
                    }
                }
                told.leave().await;
                Ok(())
            }
            What::Watch => {
                let mut watcher =
                    watch(WatchSettings::default()).map_err(|error| unavailable(&error))?;
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

fn line(found: &Found) -> Value {
    let (what, loss) = match found {
        Found::Seen(_) => ("seen", None),
        Found::Restarted(_) => ("restarted", None),
        Found::Gone { loss, .. } => ("gone", Some(loss.label())),
    };
    let known = found.known();
    json!({
        "found": what,
        "loss": loss,
        "name": known.name,
        "url": known.url,
        "capabilities": known.capabilities,
        "uri": known.application_uri,
        "at_ms": millis(),
    })
}

#[expect(clippy::disallowed_methods, reason = "the lines say when")]
fn millis() -> u128 {
    SystemTime::now()
        .duration_since(UNIX_EPOCH)
        .unwrap_or_default()
        .as_millis()
}

#[expect(clippy::print_stdout, reason = "this is what it is for")]
fn say(line: &Value) {
    println!("{line}");
}
