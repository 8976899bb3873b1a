//! Writes a value at a ua-server, as an OPC UA client.

use std::path::PathBuf;
use std::time::Duration;

use opcua::types::{
    Array, BinaryDecodable as _, ContextOwned, Identifier, NodeClass, NodeId, QualifiedName,
    StatusCode, Variant, VariantScalarTypeId,
};
use plant_opcua::client::{Browse, ClientConfig, ClientError, ClientUser, Link, OpcUaClient};
use plant_opcua::pki;
use tokio::time::{MissedTickBehavior, interval};
use uadp::Fields;

use super::super::text::harmless;
use super::{ServedValue, Tally, WriteOutcome, pace, value};
use crate::arguments::Write;
use crate::exit::CommandFailure;
use crate::interrupt::SignalGuard;
use crate::live::unix_nanos;

/// Writes the value, once or at the rate of the command line. The session ends with the command, so
/// `on_loss` of the value follows then.
pub(super) async fn write(arguments: &Write, found: &ServedValue) -> Result<(), CommandFailure> {
    let fields = found.described.fields();
    let encode = || {
        let block = value::encoded(&arguments.values, fields, unix_nanos());
        block.map_err(|wrong| CommandFailure::Usage(format!("{}: {wrong}", found.label())))
    };
    // A wrong value is reported before a connection is made.
    let mut block = encode()?;
    // Ctrl-C is caught from here on.
    let mut pace = Pace::new(arguments)?;
    let (client, url) = tokio::select! {
        connected = connect(arguments, &found.urls) => connected?,
        () = pace.interrupted() => return Err(CommandFailure::Interrupted),
    };
    let written = async {
        let node = node(&client, found, &url).await?;
        let at = (found.topic, found.described.name.as_str(), "ua-server");
        let mut tally = Tally::default();
        while pace.next().await {
            if tally.written > 0 {
                block = encode()?;
            }
            let value = variant(&block).ok_or_else(|| {
                CommandFailure::Data(format!("{}: the value cannot be written", found.label()))
            })?;
            let outcome = tokio::select! {
                outcome = one(&client, &node, value) => outcome,
                () = pace.interrupted() => WriteOutcome::Unknown("interrupted".to_owned()),
            };
            tally.take(at, &outcome, arguments.json)?;
        }
        match (tally.written, pace.is_interrupted) {
            (0, true) => Err(CommandFailure::Interrupted),
            _ => tally.end(at, arguments.json),
        }
    };
    let written = written.await;
    client.close().await;
    written
}

/// The times at which values are due.
struct Pace {
    ticks: Option<tokio::time::Interval>,
    left: Option<u64>,
    interrupt: SignalGuard,
    is_interrupted: bool,
}

impl Pace {
    fn new(arguments: &Write) -> Result<Self, CommandFailure> {
        let (period, left) = pace(arguments);
        let ticks = period.map(|period| {
            let mut ticks = interval(period);
            ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
            ticks
        });
        Ok(Self {
            ticks,
            left,
            interrupt: SignalGuard::catch()?,
            is_interrupted: false,
        })
    }

    /// Waits for the next value. Returns false at the end.
    async fn next(&mut self) -> bool {
        if self.is_interrupted || self.left == Some(0) {
            return false;
        }
        let ticks = self.ticks.as_mut();
        let tick = async {
            if let Some(ticks) = ticks {
                ticks.tick().await;
            }
        };
        tokio::select! {
            biased;
            () = self.interrupt.received() => self.is_interrupted = true,
            () = tick => {}
        }
        self.left = self.left.map(|left| left.saturating_sub(1));
        !self.is_interrupted
    }

    /// Completes when the user interrupts the command.
    async fn interrupted(&mut self) {
        self.interrupt.received().await;
        self.is_interrupted = true;
    }
}

/// Connects to the first URL that answers.
async fn connect(
    arguments: &Write,
    urls: &[String],
) -> Result<(OpcUaClient, String), CommandFailure> {
    let user = arguments.user.as_ref().map(|name| ClientUser {
        name: name.clone(),
        password: arguments.password.clone().unwrap_or_default(),
    });
    let store = || pki::default_named("ua-space");
    // A password is sent encrypted only, which needs certificates.
    let pki: Option<PathBuf> = arguments.pki.clone();
    let pki = pki.or_else(|| user.is_some().then(store));
    let timeout = Duration::try_from_secs_f64(arguments.timeout).unwrap_or(LONGEST);
    let config = ClientConfig {
        pki: pki.clone(),
        user,
        timeout: timeout.min(LONGEST),
        ..ClientConfig::new("urn:ua-bridge:ua-space", "ua-space")
    };
    let mut why = "the server announced no URL of opc.tcp".to_owned();
    for url in urls {
        let client = OpcUaClient::open(config.clone(), url);
        match reached(&client).await {
            Ok(()) => return Ok((client, url.clone())),
            Err(reason) => why = format!("{}: {}", harmless(url), harmless(&reason.to_string())),
        }
    }
    let help = match pki {
        Some(pki) => format!(
            "each side trusts the certificate of the other: `ua-server trust` for the certificate in \
             {0}/own, and the certificate of the server belongs into {0}/trusted",
            pki.display()
        ),
        None => "name a user with --user, or the certificates of a secured session with --pki"
            .to_owned(),
    };
    Err(CommandFailure::Unavailable(format!(
        "cannot write at the ua-server: {why}: nothing was sent\n  = help: {help}"
    )))
}

/// The reason why there is no connection to a server.
#[derive(Debug, thiserror::Error)]
enum NotReached {
    #[error("{0}")]
    Down(String),
    #[error("the client is closed")]
    Closed,
    #[error("no answer within {CONNECT:?}")]
    NoAnswer,
}

/// Waits for the connection; returns the first reason why there is none.
async fn reached(client: &OpcUaClient) -> Result<(), NotReached> {
    let mut link = client.link();
    let settled = link.wait_for(|link| !matches!(link, Link::Connecting));
    match tokio::time::timeout(CONNECT, settled).await {
        Ok(Ok(link)) => match &*link {
            Link::Up { .. } => Ok(()),
            Link::Down { reason, .. } => Err(NotReached::Down(reason.clone())),
            Link::Connecting | Link::Closed => Err(NotReached::Closed),
        },
        Ok(Err(_)) => Err(NotReached::Closed),
        Err(_) => Err(NotReached::NoAnswer),
    }
}

/// Returns the node of the value in the folders of the server.
async fn node(
    client: &OpcUaClient,
    found: &ServedValue,
    url: &str,
) -> Result<NodeId, CommandFailure> {
    let failed = |why: String| {
        CommandFailure::Unavailable(format!(
            "{}: the ua-server at {} does not show it: {why}: nothing was sent",
            found.label(),
            harmless(url)
        ))
    };
    let (name, folders) = parts(&found.described.name);
    let root = NodeId::new(APPLICATION, format!("UaSpace.{}", found.topic.space));
    let folder = if folders.is_empty() {
        root
    } else {
        let path = folders
            .iter()
            .map(|name| QualifiedName::new(APPLICATION, *name));
        let path: Vec<QualifiedName> = path.collect();
        let folder = client.translate(&root, &path).await;
        folder.map_err(|error| failed(error.to_string()))?
    };
    let (_, namespace, identifier) = found.topic.triple();
    let below = client.browse(&folder, Browse::hierarchical()).await;
    let below = below.map_err(|error| failed(error.to_string()))?;
    let nodes = below.into_iter().filter(|reference| {
        let of = &reference.browse_name;
        reference.node_class == NodeClass::Variable
            && (of.namespace_index, of.name.as_ref()) == (namespace, name)
    });
    let nodes: Vec<NodeId> = nodes.map(|reference| reference.node_id.node_id).collect();
    let wanted = Identifier::from(u32::from(identifier));
    let same = |node: &&NodeId| node.identifier == wanted;
    match nodes.as_slice() {
        [only] => Ok(only.clone()),
        [] => Err(failed("there is no node of this name".to_owned())),
        several => {
            let found = several.iter().find(same).cloned();
            found.ok_or_else(|| failed("several nodes have this name".to_owned()))
        }
    }
}

/// Returns the name of a node in its folder, and the names of the folders, as ua-server makes them
/// of a name with dots.
fn parts(name: &str) -> (&str, Vec<&str>) {
    let parts = name.splitn(MOST_PARTS, '.').map(str::trim);
    let mut parts: Vec<&str> = parts.filter(|part| !part.is_empty()).collect();
    (parts.pop().unwrap_or(name), parts)
}

/// Returns the value of the node: the only field, or an array of all fields. `None` if the OPC UA
/// library cannot have the value.
fn variant(block: &[u8]) -> Option<Variant> {
    let count = Fields::parse(block).ok()?.len();
    let mut rest = block.get(2..)?;
    let context = ContextOwned::default();
    let context = context.context();
    let mut values = Vec::with_capacity(count);
    for _ in 0..count {
        values.push(Variant::decode(&mut rest, &context).ok()?);
    }
    if values.len() == 1 {
        return values.pop();
    }
    let values = values.into_iter();
    Some(Variant::Array(Box::new(Array {
        value_type: VariantScalarTypeId::Variant,
        values: values
            .map(|value| Variant::Variant(Box::new(value)))
            .collect(),
        dimensions: None,
    })))
}

async fn one(client: &OpcUaClient, node: &NodeId, value: Variant) -> WriteOutcome {
    let mut results = client.write_each(&[(node.clone(), value)]).await;
    match results.pop() {
        Some(Ok(status) | Err(ClientError::Status(status))) => judged(status),
        Some(Err(ClientError::NotConnected(why))) => WriteOutcome::Refused(format!(
            "there is no connection: {}: nothing was sent",
            harmless(&why)
        )),
        Some(Err(error)) => WriteOutcome::Unknown(harmless(&error.to_string())),
        None => WriteOutcome::Unknown("the server did not answer".to_owned()),
    }
}

/// Returns the outcome of a write from its status, as docs/server.md lists them.
fn judged(status: StatusCode) -> WriteOutcome {
    match status {
        StatusCode::GoodCompletesAsynchronously => WriteOutcome::Unknown(
            "the server of this variable is not connected: it gets the value when it returns"
                .to_owned(),
        ),
        StatusCode::BadTimeout => {
            WriteOutcome::Unknown("BadTimeout, the value was not confirmed in time".to_owned())
        }
        StatusCode::BadRequestCancelledByRequest => WriteOutcome::Unknown(
            "BadRequestCancelledByRequest, a newer write replaced the value".to_owned(),
        ),
        // The last four tell of a fault while or after the value was handled.
        StatusCode::BadNoCommunication
        | StatusCode::BadShutdown
        | StatusCode::BadInternalError
        | StatusCode::BadUnexpectedError
        | StatusCode::BadDecodingError
        | StatusCode::BadUnknownResponse => WriteOutcome::Unknown(status.to_string()),
        StatusCode::BadUserAccessDenied => WriteOutcome::Refused(
            "BadUserAccessDenied: the user may not write it (--user)".to_owned(),
        ),
        status if status.is_good() => WriteOutcome::Arrived,
        // An uncertain status.
        status if !status.is_bad() => WriteOutcome::Unknown(status.to_string()),
        status => WriteOutcome::Refused(status.to_string()),
    }
}

/// The namespace of the application in a server.
const APPLICATION: u16 = 1;
/// The largest number of parts of a name, as in ua-server.
const MOST_PARTS: usize = 9;
const CONNECT: Duration = Duration::from_secs(5);
const LONGEST: Duration = Duration::from_secs(600);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn dots_of_a_name_are_folders() {
        assert_eq!(parts("Setpoint"), ("Setpoint", vec![]));
        assert_eq!(parts("Line.Belt. Speed"), ("Speed", vec!["Line", "Belt"]));
    }

    #[test]
    fn a_message_is_an_array_of_its_fields() {
        let mut block = vec![1, 0, 1, 1];
        assert_eq!(variant(&block), Some(Variant::Boolean(true)));
        block = vec![2, 0, 1, 1, 1, 0];
        let Some(Variant::Array(array)) = variant(&block) else {
            panic!("no array");
        };
        let one = |value| Variant::Variant(Box::new(Variant::Boolean(value)));
        assert_eq!(array.values, [one(true), one(false)]);
        assert_eq!(variant(&[2, 0, 1]), None);
    }

    #[test]
    fn a_value_that_may_have_been_sent_is_unknown_and_never_refused() {
        for status in [
            StatusCode::BadTimeout,
            StatusCode::BadRequestCancelledByRequest,
            StatusCode::BadNoCommunication,
            StatusCode::BadShutdown,
            StatusCode::BadInternalError,
            StatusCode::BadUnexpectedError,
            StatusCode::BadDecodingError,
            StatusCode::BadUnknownResponse,
            StatusCode::UncertainLastUsableValue,
            StatusCode::GoodCompletesAsynchronously,
        ] {
            assert!(
                matches!(judged(status), WriteOutcome::Unknown(_)),
                "{status}"
            );
        }
        for status in [StatusCode::BadOutOfRange, StatusCode::BadUserAccessDenied] {
            assert!(
                matches!(judged(status), WriteOutcome::Refused(_)),
                "{status}"
            );
        }
        assert_eq!(judged(StatusCode::Good), WriteOutcome::Arrived);
    }
}
