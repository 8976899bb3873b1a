//! The conveyor as a ROS 1 node, with a service to switch it.

use anyhow::Context as _;
use bytes::Bytes;
use tcpros::{Node, NodeOptions, ServiceOptions, ServiceTypeSum};

use super::fact::MachineEvent;
use crate::event::tell;
use crate::line::SWITCH;
use crate::robots::niryo_node::{SET_BOOL, read_bool, set_bool_response};
use crate::stop::EndSignal;

/// Runs the node until the process is stopped.
pub(crate) async fn run() -> anyhow::Result<()> {
    let mut stop = EndSignal::new()?;
    let node = Node::start(NodeOptions::from_env("conveyor"))?;
    let service_type = ServiceTypeSum {
        name: SET_BOOL.0.to_owned(),
        md5sum: SET_BOOL.1.to_owned(),
        request_type: format!("{}Request", SET_BOOL.0),
        response_type: format!("{}Response", SET_BOOL.0),
    };
    let serve = |request: tcpros::ServiceRequest| {
        let answer: Result<Bytes, String> = match read_bool(&request.bytes) {
            Some(runs) => switch(runs),
            None => Err("the request is no std_srvs/SetBool".to_owned()),
        };
        async move { answer }
    };
    let options = ServiceOptions::default();
    let _switch = node
        .advertise_service(&format!("/{SWITCH}"), service_type, options, serve)
        .context("the conveyor cannot offer its switch")?;
    stop.wait().await;
    node.shutdown().await;
    Ok(())
}

fn switch(runs: bool) -> Result<Bytes, String> {
    let told = tell(MachineEvent::Belt { runs });
    told.map_err(|_| "the demo does not listen any more".to_owned())?;
    Ok(set_bool_response(if runs {
        "the conveyor runs"
    } else {
        "the conveyor stands still"
    }))
}
