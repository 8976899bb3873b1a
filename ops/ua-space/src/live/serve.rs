//! `ua-space live`: serves the values of a group to viewers of robot data, by the Foxglove
//! WebSocket protocol. Viewers only read.
//!
//! Reading order: this module (values from the group), `hub` (channels and clients), `client` (one
//! connection), `assets` (meshes of robots).

mod assets;
mod client;
mod hub;

use std::io::{self, Write as _};
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use bridge_node::RosEnvironment;
use tokio::net::TcpListener;

use self::assets::Assets;
use self::hub::{Publication, ViewerHub};
use super::book::{DatagramContent, NameKind};
use super::channels::{ChannelMismatch, TopicChannels, is_value};
use super::copies::Copies;
use super::robot::RobotModelMessage;
use super::{Go, in_group, until, utc};
use crate::arguments::Viewers;
use crate::exit::CommandFailure;
use crate::report::warn;

/// Runs `ua-space live`.
pub(crate) fn serve(arguments: &Viewers) -> Result<(), CommandFailure> {
    in_group(&arguments.group, async |mut live| {
        let address = SocketAddr::new(arguments.host, arguments.port);
        let listener = TcpListener::bind(address).await.map_err(|error| {
            CommandFailure::Unavailable(format!(
                "cannot listen at {address}: {error}\n  = help: is another viewer server running? --port names another port"
            ))
        })?;
        let address = listener.local_addr().unwrap_or(address);
        if !arguments.host.is_loopback() {
            warn(&format!(
                "every host that reaches {address} sees all values, without sign-in"
            ));
        }
        let assets = Assets::new(RosEnvironment::from_env());
        let hub = Arc::new(ViewerHub::new(live.group(), assets));
        let start = live.start_utc();
        let mut channels = TopicChannels::new();
        let mut copies = Copies::default();
        for source in &arguments.models.model {
            let model = source.load().await?;
            offer(&model, (&mut channels, &hub), utc(start, live.now()));
        }
        let accepting = tokio::spawn(client::accept(
            listener,
            Arc::clone(&hub),
            arguments.origin.clone().into(),
        ));
        writeln!(io::stdout(), "{} at ws://{address}", live.group())?;
        let end = until(live.now(), arguments.seconds);
        let mut each = |news: DatagramContent<'_>, now: Duration| {
            let is_copy = match &news {
                DatagramContent::Sample(sample) => copies.is_copy(sample, now),
                DatagramContent::Announced { .. } | DatagramContent::Response(..) => false,
            };
            if !is_copy {
                take(&news, (&mut channels, &hub), (start, now));
            }
            Go::On
        };
        let ended = live.listen(end, &mut each).await;
        accepting.abort();
        hub.close();
        // Viewers are told that the connection ends; a viewer that does not read is left.
        for _ in 0..MOST_WAITS {
            if hub.is_empty() {
                break;
            }
            tokio::time::sleep(WAIT).await;
        }
        live.tell_dropped();
        ended.map(|_| ())
    })
}

/// Offers the model of a robot, which does not change.
fn offer(model: &RobotModelMessage, (channels, hub): (&mut TopicChannels, &ViewerHub), now: i128) {
    match channels.of_model(model) {
        Ok(channel) => {
            let time = u64::try_from(now).unwrap_or_default();
            hub.keep(&channel, (time, model.data.clone()));
        }
        Err(unfit) => hub.leave_out(unfit),
    }
}

/// Handles a value or description of the group.
fn take(
    news: &DatagramContent<'_>,
    (channels, hub): (&mut TopicChannels, &ViewerHub),
    (start, now): (i128, Duration),
) {
    let (topic, described) = match news {
        DatagramContent::Sample(sample) => (sample.topic, sample.described.as_ref()),
        DatagramContent::Announced {
            topic,
            kind: NameKind::Value,
            described,
            ..
        } => (*topic, Some(*described)),
        DatagramContent::Announced { .. } | DatagramContent::Response(..) => return,
    };
    let channel = match channels.channel(topic, described, now) {
        Ok(channel) => channel,
        Err(ChannelMismatch::Undescribed) => return,
        Err(unfit) => return hub.leave_out(unfit),
    };
    hub.offer(Some(topic), &channel);
    let DatagramContent::Sample(sample) = news else {
        return;
    };
    let message = &sample.message;
    if !is_value(message) || !hub.is_wanted(channel.id) {
        return;
    }
    let mut data = Vec::new();
    match channel.encode(message, &mut data) {
        Ok(()) => hub.publish(&Publication {
            channel: channel.id,
            time: u64::try_from(utc(start, now)).unwrap_or_default(),
            data: &data,
        }),
        Err(unfit) => hub.leave_out(unfit),
    }
}

/// Time to wait for the ends of the connections.
const WAIT: Duration = Duration::from_millis(20);
const MOST_WAITS: u32 = 25;
