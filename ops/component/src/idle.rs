//! The restart of the program, which waits until no client uses the component.

use std::sync::Arc;
use std::time::Duration;

use skills::server::ComponentServer;
use skills::{Authority, Skill};
use tokio::time::Instant;
use tracing::info;

use crate::reload::ComponentFile;

/// The use of the component by clients.
#[derive(Clone)]
pub(crate) struct Usage {
    skills: Vec<Skill>,
    authority: Authority,
    /// The YAML file, which the restarted program reads.
    file: Option<Arc<ComponentFile>>,
}

impl Usage {
    pub(crate) fn of(server: &ComponentServer, file: Option<Arc<ComponentFile>>) -> Self {
        Self {
            skills: server.skills().to_vec(),
            authority: server.authority().clone(),
            file,
        }
    }

    /// Reserves the component for its restart, if it is idle and its file on disk is the latest
    /// version without findings: the program would not start with another file. The restart would
    /// forget that the outcome of a run is unknown, so such a skill is reset first.
    async fn reserve(&self) -> bool {
        if let Some(file) = self.file.clone() {
            let is_saved = tokio::task::spawn_blocking(move || file.is_saved());
            if !is_saved.await.unwrap_or(false) {
                return false;
            }
        }
        // A skill that ends a run shows its need of a Reset first, and then leaves the authority.
        let runs = self.authority.idle(Instant::now()).is_none();
        let mut skills = self.skills.iter();
        !runs && !skills.any(|skill| skill.shown().needs_reset) && self.authority.reserve()
    }
}

/// Restarts the program when no skill runs or needs a Reset, no client holds the lease and its file
/// is valid, because a restart must not stop a machine, part a composite or end in a program that
/// does not start. No run starts after that.
pub(crate) async fn restart_when_idle(usage: Usage, why: String) {
    if !usage.reserve().await {
        info!(
            "the program restarts {why} when no skill runs or needs a Reset, no client holds the lease and its file is valid"
        );
        while !usage.reserve().await {
            tokio::time::sleep(IDLE_LOOK).await;
        }
    }
    info!("the program restarts {why}");
    bridge_node::restart();
}

/// Interval between two checks of the component before a restart.
const IDLE_LOOK: Duration = Duration::from_millis(500);
