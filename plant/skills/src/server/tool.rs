//! The state of a tool changer, for clients: properties of each skill that changes tools.

use std::sync::Arc;

use plant_opcua::server::OpcUaServer;
use plant_opcua::types::{DataValue, StatusCode, Variant};
use tokio::sync::watch;

use super::show::SkillNodes;
use crate::model::{CURRENT_TOOL, MOVER_ENDPOINT, TOOL_PLATE_OFFSET};
use crate::tool_state::ToolState;
use crate::value::SkillValue;
use crate::variant::to_variant;

/// The optional properties of the skills of a tool changer.
pub(super) const PROPERTIES: [&str; 3] = [TOOL_PLATE_OFFSET, CURRENT_TOOL, MOVER_ENDPOINT];

/// Shows each change of the state.
pub(super) async fn show(
    server: OpcUaServer,
    skills: Vec<Arc<SkillNodes>>,
    mut state: watch::Receiver<ToolState>,
) {
    loop {
        let now = state.borrow_and_update().clone();
        for nodes in &skills {
            show_at(&server, nodes, &now);
        }
        if state.changed().await.is_err() {
            return;
        }
    }
}

fn show_at(server: &OpcUaServer, nodes: &SkillNodes, state: &ToolState) {
    let current = match &state.current {
        Some(tool) => DataValue::new_now(Variant::from(tool.as_str())),
        None => DataValue::new_now_status(Variant::Empty, StatusCode::BadNoCommunication),
    };
    let values = [
        (
            TOOL_PLATE_OFFSET,
            DataValue::new_now(to_variant(&SkillValue::from(state.plate))),
        ),
        (CURRENT_TOOL, current),
        (
            MOVER_ENDPOINT,
            DataValue::new_now(Variant::from(state.mover.as_str())),
        ),
    ];
    let values = values.into_iter().filter_map(|(name, value)| {
        let node = nodes.named(name)?;
        Some((node.clone(), value))
    });
    if let Err(status) = server.show_all(values.collect()) {
        tracing::debug!(%status, "cannot show the state of the tool changer");
    }
}
