//! The skills that a run has opened.

use std::sync::Arc;

use async_trait::async_trait;
use skills::{RunnableSkill, SkillClient};

use crate::execute::Opened;

/// Skills over the connections to their components.
pub(super) struct OpenedSkills {
    pub(super) clients: Vec<SkillClient>,
    pub(super) skills: Vec<Arc<dyn RunnableSkill>>,
}

#[async_trait]
impl Opened for OpenedSkills {
    fn skills(&self) -> Vec<Arc<dyn RunnableSkill>> {
        self.skills.clone()
    }

    async fn close(self: Box<Self>) {
        drop(self.skills);
        for client in self.clients {
            client.close().await;
        }
    }
}
