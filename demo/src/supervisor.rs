//! The supervisor: an OPC UA client that calls the switch of the conveyor, a service of Niryo Ned,
//! and monitors all values.

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context as _, anyhow, bail};
use opcua::client::{ClientBuilder, DataChangeCallback, IdentityToken, MonitoredItem, Session};
use opcua::types::{
    BrowseDescription, BrowseDirection, CallMethodResult, DataValue, Identifier,
    MessageSecurityMode, MonitoredItemCreateRequest, MonitoringMode, MonitoringParameters, NodeId,
    ReferenceTypeId, StatusCode, TimestampsToReturn, UserTokenPolicy, Variant,
};
use tokio::sync::mpsc;
use tokio::time::{Instant, sleep, sleep_until, timeout};

use crate::clock::wall_nanos;
use crate::event::{LineValue, SupervisorEvent, tell, tell_at};
use crate::line::{ENDPOINT, LineValueName, NAMESPACE, SWITCH_NODE};
use crate::stop::EndSignal;

/// Starts the line when the server has all its values and its switch. Switches the conveyor off
/// after `off_after`, and monitors the values until the process is stopped.
pub(crate) async fn run(off_after: Duration, pki: PathBuf) -> anyhow::Result<()> {
    let mut stop = EndSignal::new()?;
    tokio::select! {
        result = supervise(off_after, pki) => result,
        () = stop.wait() => Ok(()),
    }
}

async fn supervise(off_after: Duration, pki: PathBuf) -> anyhow::Result<()> {
    let session = connect(pki).await?;
    let namespace = namespace_index(&session).await?;
    tell(SupervisorEvent::Connected)?;
    let mut values = subscribe(&session, namespace).await?;
    let mut watch = Watch::new();

    while !watch.complete() {
        let (name, value) = values.recv().await.ok_or_else(subscription_ended)?;
        watch.see(name, &value)?;
    }
    let switch = Switch::find(&session, namespace).await?;
    let off_at = Instant::now() + off_after;
    if !off_after.is_zero() {
        switch.turn(&session, true).await?;
    }
    let mut switched_off = false;
    loop {
        tokio::select! {
            value = values.recv() => {
                let (name, value) = value.ok_or_else(subscription_ended)?;
                watch.see(name, &value)?;
            }
            () = sleep_until(off_at), if !switched_off => {
                switch.turn(&session, false).await?;
                switched_off = true;
            }
        }
    }
}

fn subscription_ended() -> anyhow::Error {
    anyhow!("the OPC UA server has ended the subscription")
}

/// Connects when the server listens.
async fn connect(pki: PathBuf) -> anyhow::Result<Arc<Session>> {
    let mut client = ClientBuilder::new()
        .application_name("Supervisor of the assembly line")
        .application_uri("urn:ua-bridge:demo:supervisor")
        .product_uri("urn:ua-bridge:demo")
        .pki_dir(pki)
        .create_sample_keypair(false)
        .trust_server_certs(false)
        .session_retry_initial(Duration::from_millis(100))
        .session_retry_max(Duration::from_secs(1))
        .session_retry_limit(-1)
        .request_timeout(REQUEST_LIMIT)
        .min_publish_interval(PUBLISHING_INTERVAL)
        .client()
        .map_err(|errors| {
            anyhow!(
                "the OPC UA client is not set up well: {}",
                errors.join("; ")
            )
        })?;
    let (session, events) = client
        .connect_to_endpoint_directly(
            (
                ENDPOINT,
                "None",
                MessageSecurityMode::None,
                UserTokenPolicy::anonymous(),
            ),
            IdentityToken::Anonymous,
        )
        .map_err(|error| anyhow!("{ENDPOINT} is no endpoint to connect to: {error}"))?;
    // The task ends with the session, and the session ends with the process.
    drop(events.spawn());
    match timeout(CONNECT_LIMIT, session.wait_for_connection()).await {
        Ok(true) => Ok(session),
        Ok(false) => bail!("the connection to {ENDPOINT} was given up"),
        Err(_) => bail!("no OPC UA session at {ENDPOINT} within {CONNECT_LIMIT:?}"),
    }
}

async fn namespace_index(session: &Session) -> anyhow::Result<u16> {
    let namespaces = session
        .read_namespace_array()
        .await
        .map_err(|error| anyhow!("the namespaces of the OPC UA server cannot be read: {error}"))?;
    namespaces
        .get_index(NAMESPACE)
        .ok_or_else(|| anyhow!("the OPC UA server has no namespace {NAMESPACE}"))
}

/// Subscribes to all values of the line. The queue holds more changes than a line produces while
/// the timeline is written.
async fn subscribe(
    session: &Session,
    namespace: u16,
) -> anyhow::Result<mpsc::Receiver<(LineValueName, DataValue)>> {
    let (sender, receiver) = mpsc::channel(1024);
    let callback = DataChangeCallback::new(move |value, item: &MonitoredItem| {
        let node = &item.item_to_monitor().node_id;
        let name = LineValueName::ALL.into_iter().find(|name| is(node, *name));
        if let Some(name) = name
            && sender.try_send((name, value)).is_err()
        {
            tracing::warn!(%name, "a change was lost: the timeline is not read");
        }
    });
    let subscription = session
        .create_subscription(PUBLISHING_INTERVAL, 1000, 100, 0, 0, true, callback)
        .await
        .map_err(|error| anyhow!("no subscription at the OPC UA server: {error}"))?;
    let items = LineValueName::ALL.into_iter().map(|name| {
        MonitoredItemCreateRequest::new(
            NodeId::new(namespace, name.node()).into(),
            MonitoringMode::Reporting,
            MonitoringParameters {
                // Report every change immediately.
                sampling_interval: 0.0,
                queue_size: 100,
                discard_oldest: true,
                ..MonitoringParameters::default()
            },
        )
    });
    let created = session
        .create_monitored_items(subscription, TimestampsToReturn::Both, items.collect())
        .await
        .map_err(|error| anyhow!("the values cannot be monitored: {error}"))?;
    for (name, item) in LineValueName::ALL.into_iter().zip(created) {
        let status = item.result.status_code;
        if !status.is_good() {
            bail!("{name} cannot be monitored: {status}");
        }
    }
    Ok(receiver)
}

fn is(node: &NodeId, name: LineValueName) -> bool {
    matches!(&node.identifier, Identifier::Numeric(number) if *number == name.node())
}

/// The Method that switches the conveyor, and its object.
struct Switch {
    object: NodeId,
    method: NodeId,
}

impl Switch {
    /// Waits until the server has the Method, which exists while Niryo Ned's service is available.
    async fn find(session: &Session, namespace: u16) -> anyhow::Result<Self> {
        let method = NodeId::new(namespace, SWITCH_NODE);
        let mut told = false;
        loop {
            if let Some(object) = object_of(session, &method).await? {
                return Ok(Self { object, method });
            }
            if !told {
                tell(SupervisorEvent::AwaitsSwitch)?;
                told = true;
            }
            sleep(LOOK_AGAIN).await;
        }
    }

    /// Switches the conveyor. A failed call is repeated, because the scenario depends on it. A call
    /// with an unknown result is repeated too, because the call is idempotent.
    async fn turn(&self, session: &Session, on: bool) -> anyhow::Result<()> {
        let mut problem = String::new();
        for _ in 0..CALL_ATTEMPTS {
            let stamp = wall_nanos();
            let arguments = Some(vec![Variant::Boolean(on)]);
            let request = (self.object.clone(), self.method.clone(), arguments);
            match session.call_one(request).await {
                Ok(result) if result.status_code.is_good() => {
                    follow(&result, on)?;
                    let answered_after_ns = wall_nanos() - stamp;
                    tell_at(
                        stamp,
                        SupervisorEvent::Switched {
                            on,
                            answered_after_ns,
                        },
                    )?;
                    return Ok(());
                }
                Ok(result) => problem = result.status_code.to_string(),
                Err(error) => problem = error.to_string(),
            }
            tracing::warn!(problem, "cannot switch the conveyor");
            sleep(LOOK_AGAIN).await;
        }
        Err(anyhow!("{problem}")).context("Conveyor.Switch of the OPC UA server was not executed")
    }
}

/// Checks that the response of std_srvs/SetBool reports success.
fn follow(result: &CallMethodResult, on: bool) -> anyhow::Result<()> {
    match result.output_arguments.as_deref() {
        Some([Variant::Boolean(true), _]) => Ok(()),
        Some([Variant::Boolean(false), Variant::String(message)]) => {
            bail!("Niryo Ned does not switch the conveyor to {on}: {message}")
        }
        answer => bail!("Conveyor.Switch answers {answer:?}, no Boolean and text"),
    }
}

/// Returns the object that has a Method as its component; `None` if the Method does not exist.
async fn object_of(session: &Session, method: &NodeId) -> anyhow::Result<Option<NodeId>> {
    let description = BrowseDescription {
        node_id: method.clone(),
        browse_direction: BrowseDirection::Inverse,
        reference_type_id: ReferenceTypeId::HasComponent.into(),
        include_subtypes: true,
        node_class_mask: 0,
        result_mask: 0,
    };
    let results = session
        .browse(&[description], 1, None)
        .await
        .map_err(|error| anyhow!("cannot browse the OPC UA server: {error}"))?;
    let references = results.into_iter().next();
    let references = references.and_then(|result| result.references);
    let object = references.and_then(|references| references.into_iter().next());
    Ok(object.map(|reference| reference.node_id.node_id))
}

/// The last value of each variable.
struct Watch {
    last: std::collections::BTreeMap<LineValueName, LineValue>,
}

impl Watch {
    const fn new() -> Self {
        Self {
            last: std::collections::BTreeMap::new(),
        }
    }

    /// Returns whether the server has all values of the robots.
    fn complete(&self) -> bool {
        self.missing().is_empty()
    }

    fn missing(&self) -> Vec<LineValueName> {
        LineValueName::ALL
            .into_iter()
            .filter(|name| !self.last.contains_key(name))
            .collect()
    }

    /// Reports a value if it is good and new.
    fn see(&mut self, name: LineValueName, data: &DataValue) -> anyhow::Result<()> {
        let status = data.status.unwrap_or(StatusCode::Good);
        if !status.is_good() {
            tracing::info!(%name, %status, "received a value that is not Good");
            if !self.complete() {
                tell(SupervisorEvent::Awaits {
                    names: self.missing(),
                })?;
            }
            return Ok(());
        }
        let value = match data.value {
            Some(Variant::Boolean(value)) => LineValue::Boolean(value),
            Some(Variant::UInt32(value)) => LineValue::Number(value),
            _ => bail!(
                "{name} is {:?} at the OPC UA server, no Boolean or UInt32",
                data.value
            ),
        };
        if self.last.insert(name, value) != Some(value) {
            let stamp = server_time(data).unwrap_or_else(wall_nanos);
            tell_at(stamp, SupervisorEvent::Saw { name, value })?;
        }
        Ok(())
    }
}

/// Returns the server timestamp in nanoseconds since 1970, with a resolution of 100 ns.
fn server_time(data: &DataValue) -> Option<i64> {
    let ticks = data.server_timestamp.as_ref()?.ticks();
    ticks.checked_sub(UNIX_EPOCH_TICKS)?.checked_mul(100)
}

/// 1970 in units of 100 ns since 1601.
const UNIX_EPOCH_TICKS: i64 = 116_444_736_000_000_000;
const PUBLISHING_INTERVAL: Duration = Duration::from_millis(10);
const CONNECT_LIMIT: Duration = Duration::from_secs(60);
/// More than the mapping's `timeout` of the call, after which the server responds.
const REQUEST_LIMIT: Duration = Duration::from_secs(8);
const CALL_ATTEMPTS: u32 = 10;
/// Interval between polls and between calls.
const LOOK_AGAIN: Duration = Duration::from_millis(200);

#[cfg(test)]
mod tests {
    use super::*;
    use opcua::types::DateTime;

    #[test]
    fn server_time_counts_from_1970() {
        let data = DataValue {
            server_timestamp: Some(DateTime::ymd_hms_nano(2001, 9, 9, 1, 46, 40, 123_456_700)),
            ..DataValue::default()
        };
        assert_eq!(server_time(&data), Some(1_000_000_000_123_456_700));
        assert_eq!(server_time(&DataValue::default()), None);
    }

    #[test]
    fn the_line_starts_when_all_values_are_there() {
        let mut watch = Watch::new();
        for name in LineValueName::ALL {
            assert!(!watch.complete(), "{name}");
            watch.last.insert(name, LineValue::Number(0));
        }
        assert!(watch.complete());
    }

    #[test]
    fn an_answer_that_says_no_is_told_with_its_reason() {
        let answer = |arguments| CallMethodResult {
            output_arguments: arguments,
            ..CallMethodResult::default()
        };
        let said = |yes: bool| Some(vec![Variant::Boolean(yes), Variant::from("jammed")]);
        assert!(follow(&answer(said(true)), true).is_ok());
        let refused = follow(&answer(said(false)), true).unwrap_err();
        assert!(refused.to_string().contains("jammed"), "{refused}");
        assert!(follow(&answer(None), true).is_err());
    }
}
