//! The servers, with the same nodes in each, and the client of all.

use std::fmt::Write as _;
use std::path::PathBuf;
use std::time::Duration;

use plant_opcua::client::{ClientConfig, OpcUaClient, SecurityChoice};
use plant_opcua::types::NodeId;
use system_tests::{Cell, Child, Executes, Executor, SERVER_ENDPOINT, processor_time};

use crate::feed::ValueFeed;

/// A running server.
pub(crate) struct BenchServer {
    pub(crate) name: &'static str,
    pub(crate) endpoint: &'static str,
    child: Child,
    /// The space of our own server, in which its variables are changed and its method is called.
    space: Option<(ValueFeed, Executor)>,
}

impl BenchServer {
    /// Returns the processor time of the server so far.
    pub(crate) fn used(&self) -> Duration {
        processor_time(self.child.id())
    }

    pub(crate) fn id(&self) -> u32 {
        self.child.id()
    }

    /// Starts or stops changes of all its variables.
    pub(crate) fn change(&mut self, on: bool) {
        match &mut self.space {
            Some((feed, _)) => feed.change(on),
            None => {
                self.child.ask(&format!("{{\"change\": {on}}}"), START);
            }
        }
    }
}

/// Starts all servers, with this number of changing variables.
pub(crate) fn all(cell: &Cell, variables: usize) -> Vec<BenchServer> {
    let pairs = pairs(cell);
    vec![
        ours(cell, variables),
        asyncua(cell, variables, &pairs),
        node_opcua(cell, variables, &pairs),
    ]
}

/// Creates the keys and certificates of the other servers, if they are missing.
pub(crate) fn pairs(cell: &Cell) -> String {
    let pairs = cell.folder().join("pairs").to_string_lossy().into_owned();
    if !cell.folder().join("pairs").is_dir() {
        let made = cell.asyncua_once("opcua_access.py", &["pairs", &pairs]);
        assert_eq!(made.len(), 1, "{made:?}");
    }
    pairs
}

pub(crate) fn ours(cell: &Cell, variables: usize) -> BenchServer {
    let mapping = cell.file("bench.yaml", &mapping(variables));
    let executor = Executor::start((1, SPACE, METHOD), "Answer", Executes::AtOnce, 1);
    let child = cell.ua_server(&[
        mapping.to_string_lossy().as_ref(),
        "--trust-any-client-certificate",
    ]);
    BenchServer {
        name: "ua-server",
        endpoint: SERVER_ENDPOINT,
        child,
        space: Some((ValueFeed::of(variables), executor)),
    }
}

pub(crate) fn asyncua(cell: &Cell, variables: usize, pairs: &str) -> BenchServer {
    let endpoint = "opc.tcp://127.0.0.1:4841";
    let count = variables.to_string();
    let args = [endpoint, "--count", &count, "--pairs", pairs];
    let started = cell.asyncua_started("opcua_bench.py", &args).told();
    BenchServer {
        name: "asyncua",
        endpoint,
        child: started.start().ready(START),
        space: None,
    }
}

pub(crate) fn node_opcua(cell: &Cell, variables: usize, pairs: &str) -> BenchServer {
    let count = variables.to_string();
    let started = cell.node_opcua_started("bench.js", &["4842", &count, pairs]);
    BenchServer {
        name: "node-opcua",
        endpoint: "opc.tcp://127.0.0.1:4842",
        child: started.told().start().ready(START),
        space: None,
    }
}

/// Returns a mapping with a variable that clients write, variables that change in space 2, and a
/// call that the space executes.
fn mapping(variables: usize) -> String {
    let mut text = format!(
        "namespaces: {{2: '{NAMESPACE}'}}\nspaces: [{{id: 1}}, {{id: 2}}]\n\
         server:\n  security: [None, Basic256Sha256, Aes128_Sha256_RsaOaep, Aes256_Sha256_RsaPss]\n\
         calls:\n  - {{node: ns=2;i={METHOD}, name: Answer, origin: 1, ros: {{service: /answer, type: std_srvs/Trigger}}}}\n\
         variables:\n  - {{node: ns=2;i={WRITTEN}, name: written, type: Double, origin: 0}}\n"
    );
    for number in 0..variables {
        let node = FIRST as usize + number;
        // Every change is reported, as by the other servers.
        writeln!(
            text,
            "  - {{node: ns=2;i={node}, name: v{number}, type: Double, origin: 2, queue: {{drop_oldest: 100}}}}"
        )
        .unwrap();
    }
    text
}

/// Returns a connected client.
pub(crate) async fn connected(
    cell: &Cell,
    endpoint: &str,
    security: SecurityChoice,
) -> OpcUaClient {
    let client = OpcUaClient::open(config(cell, security), endpoint);
    client.up(START).await.unwrap();
    client
}

/// Returns the configuration of a client of any server.
pub(crate) fn config(cell: &Cell, security: SecurityChoice) -> ClientConfig {
    ClientConfig {
        pki: (security != SecurityChoice::None).then(|| store(cell)),
        accept_untrusted: true,
        security,
        ..plain()
    }
}

/// Returns the configuration of a client without security.
pub(crate) fn plain() -> ClientConfig {
    ClientConfig {
        security: SecurityChoice::None,
        timeout: START,
        // Insignificant for the measurement.
        keep_alive: Duration::from_secs(5),
        ..ClientConfig::new("urn:ua-bridge:bench:client", "bench")
    }
}

fn store(cell: &Cell) -> PathBuf {
    cell.folder().join("client")
}

/// Returns the NodeId of a changing variable.
pub(crate) fn variable(number: usize) -> NodeId {
    NodeId::new(SPACE, FIRST + u32::try_from(number).unwrap())
}

pub(crate) const NAMESPACE: &str = "urn:ua-bridge:bench";
/// The index of the namespace in each of the servers, and the number of the group in the space.
pub(crate) const SPACE: u16 = 2;
pub(crate) const WRITTEN: u32 = 5;
pub(crate) const METHOD: u16 = 6;
/// The first number of the changing variables.
pub(crate) const FIRST: u32 = 10;
/// Number of changing variables.
pub(crate) const ITEMS: usize = 1000;
/// asyncua makes a thousand variables in three seconds.
pub(crate) const START: Duration = Duration::from_secs(180);
