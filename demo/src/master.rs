//! The ROS master of the demo.

use std::net::{Ipv4Addr, SocketAddr};

use anyhow::Context as _;
use tcpros::Core;

use crate::event::{MasterEvent, tell};
use crate::stop::EndSignal;

/// Runs a master on a free port of 127.0.0.1 until the process is stopped.
pub(crate) async fn run() -> anyhow::Result<()> {
    let mut stop = EndSignal::new()?;
    let core = Core::start(SocketAddr::from((Ipv4Addr::LOCALHOST, 0)))
        .context("cannot listen on 127.0.0.1")?;
    tell(MasterEvent::Listening {
        uri: core.uri().to_owned(),
    })?;
    stop.wait().await;
    Ok(())
}
