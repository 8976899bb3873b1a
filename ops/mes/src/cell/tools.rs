//! The tools of the tool changers of the plant.

use std::time::Duration;

use futures_util::future::join_all;
use skills::choosing::Attachment;
use skills::{ParameterType, SkillClient, ToolState, Unchosen, plate_between};
use tokio::time::timeout;

use super::PlantState;
use super::component::ListedComponent;
use crate::plan::ShownTools;

impl PlantState {
    /// Returns the attachment of a component, as the tool changers showed last.
    pub(super) fn attachment_of(&self, component: &str) -> Attachment {
        let present = self.present();
        let endpoint = present.components.get(component).map(|of| &*of.endpoint);
        let all = present.components.values();
        let states = all.flat_map(ListedComponent::tool_states);
        let mut all = states.map(|(_, state)| state.attachment(component, endpoint));
        let attached = all.find(|attachment| *attachment != Attachment::None);
        attached.unwrap_or_default()
    }

    /// Returns the tool plate of a gripper in the frame of the flange of a robot, as the tool
    /// changers showed last.
    ///
    /// # Errors
    /// The gripper is not at this robot, or it is not known whether it is.
    pub(super) fn plate_of(&self, robot: &str, gripper: &str) -> Result<[f64; 6], Unchosen> {
        let present = self.present();
        let changers = present.components.iter();
        let changers = changers.filter_map(|(iri, of)| Some((iri.clone(), of.tool_state()?)));
        let changers: Vec<(String, ToolState)> = changers.collect();
        let endpoint = present.components.get(robot);
        let endpoint = endpoint.map_or("", |of| &of.endpoint);
        plate_between(&changers, (robot, endpoint), gripper)
    }

    /// Returns whether a robot carries a tool changer; both are given by their components.
    pub(super) fn carries(&self, robot: &str, changer: &str) -> bool {
        let present = self.present();
        let endpoint = present.components.get(robot);
        let endpoint = endpoint.map_or("", |of| &of.endpoint);
        let changer = present.components.get(changer);
        let mut states = changer.into_iter().flat_map(ListedComponent::tool_states);
        states.any(|(_, state)| state.is_at((robot, endpoint)))
    }

    /// Reads the tools of the tool changers.
    pub(super) async fn read_changers(&self) {
        let changers: Vec<(String, String, String)> = {
            let present = self.present();
            let all = present.components.iter();
            let states = all.flat_map(|(iri, of)| of.tool_states().map(move |one| (iri, of, one)));
            let changers = states
                .map(|(iri, of, (skill, _))| (iri.clone(), of.endpoint.clone(), skill.clone()));
            changers.collect()
        };
        let read = changers.iter().map(|(_, endpoint, skill)| async move {
            let state = timeout(TOOL_WITHIN, self.read_changer(endpoint, skill)).await;
            state.ok().flatten()
        });
        let states = join_all(read).await;
        let mut present = self.present();
        for ((iri, _, skill), state) in changers.into_iter().zip(states) {
            let Some(component) = present.components.get_mut(&iri) else {
                continue;
            };
            let found = component.found.get_mut(&skill);
            if let Some(known) = found.and_then(|found| found.tool_state.as_mut()) {
                // The tool of a changer that does not respond is unknown.
                let unknown = || ToolState {
                    current: None,
                    ..known.clone()
                };
                *known = state.unwrap_or_else(unknown);
            }
            component.keep_tools();
        }
    }

    /// Reads the state of the tool changer with a skill.
    async fn read_changer(&self, endpoint: &str, skill: &str) -> Option<ToolState> {
        let node = self.found(skill).ok()?.node;
        let client = SkillClient::connect(endpoint, &self.client).await.ok()?;
        let found = client.skills_of(&ParameterType::own("ToolSkillType")).await;
        client.close().await;
        let mut found = found.ok()?.into_iter();
        found.find(|found| found.node == node)?.tool_state
    }

    /// Returns the tools of the tool changers, as they were read last.
    pub(super) fn shown_tools(&self) -> ShownTools {
        let present = self.present();
        let mut shown = ShownTools::default();
        for (iri, component) in &present.components {
            shown.tools.extend(component.tools.iter().cloned());
            if let Some(state) = component.tool_state() {
                shown.attached.insert(iri.clone(), state.current);
            }
        }
        shown
    }
}

impl ListedComponent {
    /// Returns the states of its tool changer, with the IRIs of their skills.
    fn tool_states(&self) -> impl Iterator<Item = (&String, &ToolState)> {
        let found = self.found.iter();
        found.filter_map(|(skill, found)| Some((skill, found.tool_state.as_ref()?)))
    }

    /// Returns the state of its tool changer, with the tool that the first of its skills shows.
    fn tool_state(&self) -> Option<ToolState> {
        let states = || self.tool_states().map(|(_, state)| state);
        let first = states().next()?.clone();
        let current = states().find_map(|state| state.current.clone());
        Some(ToolState { current, ..first })
    }

    /// Adds the tools that its tool changer shows to the known tools.
    pub(super) fn keep_tools(&mut self) {
        let current = self
            .tool_states()
            .filter_map(|(_, state)| state.current.clone());
        let tools: Vec<String> = current.filter(|tool| !tool.is_empty()).collect();
        let room = MOST_TOOLS.saturating_sub(self.tools.len());
        self.tools.extend(tools.into_iter().take(room));
    }
}

/// Time limit to read the tool of a tool changer.
const TOOL_WITHIN: Duration = Duration::from_secs(2);
/// Maximum number of known tools of a tool changer.
const MOST_TOOLS: usize = 100;
